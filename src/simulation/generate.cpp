#include "gp2/generate.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <Eigen/QR>
#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/mechanics.hpp"
#include "training/random.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// Coordinates (or velocities) that a set of equations r(x) = 0 decides, by Newton's method
class Completion {
 public:
  // `equations` of the model's constraints, solved for those of `candidates` that [sampling] does not give
  Completion(const ModelFile& model, const std::vector<Expression>& equations, const std::vector<Expression>& candidates,
             int first_index, const std::vector<bool>& given, const std::vector<Expression>& tape_inputs) {
    ExpressionGraph& graph = *model.system->definition().graph;
    std::vector<Expression> outputs;
    for (std::size_t j = 0; j < candidates.size(); ++j) {
      const int index = first_index + static_cast<int>(j);
      const bool decided = std::any_of(equations.begin(), equations.end(),
                                       [&](Expression equation) { return graph.depends_on(equation, candidates[j]); });
      if (given[static_cast<std::size_t>(index)] || !decided) continue;
      unknowns_.push_back(index);
      const auto start = model.newton_start.find(candidates[j].variable_name());
      start_.push_back(start == model.newton_start.end() ? 0 : start->second);
      names_.push_back(candidates[j].variable_name());
    }
    outputs = equations;
    for (int unknown : unknowns_) {
      for (Expression equation : equations) {
        outputs.push_back(graph.differentiate(equation, candidates[static_cast<std::size_t>(unknown - first_index)]));
      }
    }
    n_equations_ = static_cast<Index>(equations.size());
    tape_ = Tape(outputs, tape_inputs);
  }

  [[nodiscard]] const std::vector<int>& unknowns() const { return unknowns_; }

  void solve(MatrixXd& state, const VectorXd& parameters, int sample) const {
    if (unknowns_.empty()) return;
    for (std::size_t k = 0; k < unknowns_.size(); ++k) state(unknowns_[k], 0) = start_[k];
    const Index n_unknowns = static_cast<Index>(unknowns_.size());
    MatrixXd values;
    constexpr int max_iterations = 100;
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      tape_.evaluate(state, parameters, values);
      const VectorXd residual = values.col(0).head(n_equations_);
      const MatrixXd jacobian = values.col(0).tail(n_equations_ * n_unknowns).reshaped(n_equations_, n_unknowns);
      if (!residual.allFinite() || !jacobian.allFinite()) break;
      Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
      decomposition.setThreshold(1e-10);
      decomposition.compute(jacobian);
      if (decomposition.rank() < n_unknowns) {
        throw InputError(fmt::format("[sampling]: the constraints do not decide {} of {} ({}); draw some of them", n_unknowns,
                                     n_unknowns == 1 ? "it" : "them", fmt::join(names_, ", ")));
      }
      const VectorXd step = decomposition.solve(residual);
      double size = 1;
      for (std::size_t k = 0; k < unknowns_.size(); ++k) {
        state(unknowns_[k], 0) -= step[static_cast<Index>(k)];
        size = std::max(size, std::abs(state(unknowns_[k], 0)));
      }
      // quadratic convergence: after a step this small the next would be rounding
      if (step.lpNorm<Eigen::Infinity>() <= 1e-9 * size) {
        polish(state, parameters);
        return;
      }
    }
    throw NumericalError(fmt::format("[sampling]: Newton's method did not reach the constraints for {} at sample {}; give a better "
                                     "[sampling] start = {{ {} = … }}",
                                     fmt::join(names_, ", "), sample + 1, names_.front()));
  }

 private:
  // two more steps, to rounding
  void polish(MatrixXd& state, const VectorXd& parameters) const {
    MatrixXd values;
    for (int step = 0; step < 2; ++step) {
      tape_.evaluate(state, parameters, values);
      const MatrixXd jacobian =
          values.col(0).tail(n_equations_ * static_cast<Index>(unknowns_.size())).reshaped(n_equations_, unknowns_.size());
      const VectorXd correction = jacobian.completeOrthogonalDecomposition().solve(values.col(0).head(n_equations_));
      for (std::size_t k = 0; k < unknowns_.size(); ++k) state(unknowns_[k], 0) -= correction[static_cast<Index>(k)];
    }
  }

  std::vector<int> unknowns_;  // entries of the state
  std::vector<double> start_;
  std::vector<std::string> names_;
  Index n_equations_ = 0;
  Tape tape_;  // r, then ∂r/∂unknown column by column
};

}  // namespace

MatrixXd true_acceleration(const ModelFile& model, const Eigen::Ref<const MatrixXd>& states) {
  const SymbolicSystem& system = *model.system;
  if (model.truth.empty()) throw InputError(fmt::format("{}: missing [truth] acceleration = [ … ]", model.name));
  const SystemSymbols symbols(*system.definition().graph, system.coordinates(), system.inputs(), system.parameters());
  const VectorXd parameters = system.parameter_values();
  const MechanicsBatch mechanics = require_mechanics(system, states, parameters);
  MatrixXd truth;
  Tape(model.truth, symbols.state_and_parameters()).evaluate(states, parameters, truth);
  MatrixXd accelerations(system.nq(), states.cols());
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    accelerations.col(i) = projection.constrain(projection.solve_mass(mechanics.values.F(i)) + truth.col(i));
    if (!accelerations.col(i).allFinite()) {
      throw InputError(fmt::format("{}: the true acceleration is not a finite number at sample {}", model.name, i + 1));
    }
  }
  return accelerations;
}

GeneratedData generate(const ModelFile& model, const GenerateOptions& options) {
  const SymbolicSystem& system = *model.system;
  if (model.sampling.empty()) throw InputError(fmt::format("{}: missing [sampling]: where states are drawn from", model.name));
  if (model.truth.empty()) throw InputError(fmt::format("{}: missing [truth] acceleration = [ … ]", model.name));
  ExpressionGraph& graph = *system.definition().graph;
  const SystemSymbols symbols(graph, system.coordinates(), system.inputs(), system.parameters());
  const StateLayout layout = system.layout();
  const std::vector<std::string> names = system.state_names();
  const VectorXd parameters = system.parameter_values();

  // tape inputs: the state, the auxiliary draws, the parameters
  GeneratedData data;
  data.known.assign(names.size(), false);
  std::vector<Expression> tape_inputs = symbols.state();
  std::vector<int> target;  // of each rule: its row among the tape inputs
  for (const ModelFile::SamplingRule& rule : model.sampling) {
    const auto of_state = std::find(names.begin(), names.end(), rule.name);
    if (of_state != names.end()) {
      target.push_back(static_cast<int>(of_state - names.begin()));
      data.known[static_cast<std::size_t>(target.back())] = true;
    } else {
      target.push_back(static_cast<int>(tape_inputs.size()));
      tape_inputs.push_back(graph.variable(rule.name));
    }
  }
  const Index n_varying = static_cast<Index>(tape_inputs.size());
  tape_inputs.insert(tape_inputs.end(), symbols.parameters.begin(), symbols.parameters.end());

  // rules that need a coordinate or velocity solved from the constraints wait until it is there
  std::vector<Expression> position_equations, velocity_equations;
  for (const ConstraintRow& row : system.definition().constraints) {
    if (row.level == ConstraintRow::Level::position) {
      position_equations.push_back(row.residuals[0]);
      velocity_equations.push_back(row.residuals[1]);
    } else if (row.level == ConstraintRow::Level::velocity) {
      velocity_equations.push_back(row.residuals[0]);
    }
  }
  const Completion positions(model, position_equations, symbols.q, layout.q(0), data.known, tape_inputs);
  const Completion velocities(model, velocity_equations, symbols.dq, layout.dq(0), data.known, tape_inputs);
  const auto solved_later = [&](const ModelFile::SamplingRule& rule, const Completion& completion) {
    return !rule.range && std::any_of(completion.unknowns().begin(), completion.unknowns().end(), [&](int unknown) {
      return graph.depends_on(rule.value, tape_inputs[static_cast<std::size_t>(unknown)]);
    });
  };
  std::vector<int> stage;  // 0: before positions are solved, 1: after them, 2: after velocities
  std::vector<Tape> tapes;
  for (std::size_t r = 0; r < model.sampling.size(); ++r) {
    const ModelFile::SamplingRule& rule = model.sampling[r];
    int needed = solved_later(rule, velocities) ? 2 : solved_later(rule, positions) ? 1 : 0;
    for (std::size_t earlier = 0; earlier < r; ++earlier) {
      if (!rule.range && graph.depends_on(rule.value, graph.variable(model.sampling[earlier].name))) {
        needed = std::max(needed, stage[earlier]);
      }
    }
    stage.push_back(needed);
    tapes.push_back(rule.range ? Tape() : Tape(std::span(&rule.value, 1), tape_inputs));
  }
  for (const Completion* completion : {&positions, &velocities}) {
    for (int unknown : completion->unknowns()) data.known[static_cast<std::size_t>(unknown)] = true;
  }

  // everything the true motion reads must be known
  const Tape truth(model.truth, symbols.state_and_parameters());
  const std::vector<bool> mechanics_reads = system.reads(SystemPart::mechanics);
  const std::vector<bool> force_reads = system.reads(SystemPart::force);
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!data.known[k] && (mechanics_reads[k] || force_reads[k] || truth.uses_input(static_cast<int>(k)))) {
      throw InputError(fmt::format("{}: [sampling] says nothing of '{}', which the model reads, and no constraint decides it",
                                   model.name, names[k]));
    }
  }

  RandomStream random(options.seed);
  data.states.resize(layout.size(), options.n);
  for (int i = 0; i < options.n; ++i) {
    MatrixXd sample = MatrixXd::Constant(n_varying, 1, std::numeric_limits<double>::quiet_NaN());
    MatrixXd value;
    const auto apply_rules = [&](int current_stage) {
      for (std::size_t r = 0; r < model.sampling.size(); ++r) {
        if (stage[r] != current_stage) continue;
        if (const auto& range = model.sampling[r].range) {
          sample(target[r], 0) = range->first + random.uniform() * (range->second - range->first);
        } else {
          tapes[r].evaluate(sample, parameters, value);
          sample(target[r], 0) = value(0, 0);
        }
      }
    };
    apply_rules(0);
    positions.solve(sample, parameters, i);
    apply_rules(1);
    velocities.solve(sample, parameters, i);
    apply_rules(2);
    data.states.col(i) = sample.col(0).head(layout.size());
  }
  data.accelerations = true_acceleration(model, data.states);
  for (int i = 0; i < options.n; ++i) {
    for (Index j = 0; j < data.accelerations.rows(); ++j) {
      if (options.noise_stddev[j] > 0) data.accelerations(j, i) += options.noise_stddev[j] * random.normal();
    }
  }
  return data;
}

}  // namespace gp2
