#include "gp2/mechanics/symbolic_system.hpp"

#include <algorithm>
#include <array>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "mechanics/largest_rank.hpp"
#include "symbolic/graph.hpp"
#include "symbolic/state_derivatives.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

SystemSymbols::SystemSymbols(ExpressionGraph& graph, const std::vector<Coordinate>& coordinates,
                             const std::vector<std::string>& inputs, const std::vector<Parameter>& system_parameters)
    : t(graph.variable("t")) {
  for (const Coordinate& coordinate : coordinates) {
    q.push_back(graph.variable(coordinate.name));
    dq.push_back(graph.variable(coordinate.velocity()));
    ddq.push_back(graph.variable(coordinate.acceleration()));
  }
  for (const std::string& input : inputs) u.push_back(graph.variable(input));
  for (const Parameter& parameter : system_parameters) parameters.push_back(graph.variable(parameter.name));
}

std::vector<Expression> SystemSymbols::state() const {
  std::vector<Expression> state = q;
  state.insert(state.end(), dq.begin(), dq.end());
  state.push_back(t);
  state.insert(state.end(), u.begin(), u.end());
  return state;
}

std::vector<Expression> SystemSymbols::state_and_parameters(std::span<const Expression> between) const {
  std::vector<Expression> all = state();
  all.insert(all.end(), between.begin(), between.end());
  all.insert(all.end(), parameters.begin(), parameters.end());
  return all;
}

namespace {

void forbid(Expression c, const std::vector<Expression>& symbols, const char* level, const char* allowed) {
  for (Expression symbol : symbols) {
    if (c.graph().depends_on(c, symbol)) {
      throw InputError(fmt::format("a {}-level constraint may depend on {} only, but this one depends on '{}'", level, allowed,
                                   symbol.variable_name()));
    }
  }
}

// Σ_j ∂e/∂x_j ẋ_j
Expression rate(Expression e, const std::vector<Expression>& x, const std::vector<Expression>& dx) {
  ExpressionGraph& graph = e.graph();
  Expression sum = graph.constant(0);
  for (std::size_t j = 0; j < x.size(); ++j) sum = sum + graph.differentiate(e, x[j]) * dx[j];
  return sum;
}

}  // namespace

ConstraintRow derive_constraint(ConstraintLevel level, Expression c, std::string text, const SystemSymbols& symbols) {
  ExpressionGraph& graph = c.graph();
  ConstraintRow row{level, std::move(text), {}, c, {}, 0};
  Expression bias = c;  // the part of the differentiated constraint that has no ddq
  const std::vector<Expression>* acted_on = &symbols.ddq;
  switch (level) {
    case ConstraintLevel::position: {
      forbid(c, symbols.dq, "position", "coordinates, t and parameters");
      forbid(c, symbols.ddq, "position", "coordinates, t and parameters");
      forbid(c, symbols.u, "position", "coordinates, t and parameters");
      // ċ = c_q dq + c_t,  c̈ = c_q ddq + (ċ)_q dq + (ċ)_t
      const Expression c_rate = rate(c, symbols.q, symbols.dq) + graph.differentiate(c, symbols.t);
      bias = rate(c_rate, symbols.q, symbols.dq) + graph.differentiate(c_rate, symbols.t);
      row.residuals = {c, c_rate};
      acted_on = &symbols.q;
      break;
    }
    case ConstraintLevel::velocity:
      forbid(c, symbols.ddq, "velocity", "coordinates, velocities, t and parameters");
      forbid(c, symbols.u, "velocity", "coordinates, velocities, t and parameters");
      // ċ = c_dq ddq + c_q dq + c_t
      bias = rate(c, symbols.q, symbols.dq) + graph.differentiate(c, symbols.t);
      row.residuals = {c};
      acted_on = &symbols.dq;
      break;
    case ConstraintLevel::acceleration: {
      std::map<std::string, Expression> at_rest;
      for (Expression acceleration : symbols.ddq) at_rest.emplace(acceleration.variable_name(), graph.constant(0));
      bias = graph.substitute(c, at_rest);
      break;
    }
  }

  bool acts = false;
  for (Expression symbol : *acted_on) {
    const Expression entry = graph.differentiate(c, symbol);
    for (Expression acceleration : symbols.ddq) {
      if (graph.depends_on(entry, acceleration)) {
        throw InputError(
            fmt::format("an acceleration-level constraint must be linear in the accelerations, but the factor of '{}' "
                        "depends on '{}'",
                        symbol.variable_name(), acceleration.variable_name()));
      }
    }
    acts = acts || !entry.is_constant(0);
    row.A.push_back(entry);
  }
  if (!acts) {
    throw InputError(fmt::format("the constraint does not depend on any {}: it cannot act on the motion",
                                 level == ConstraintLevel::position   ? "coordinate"
                                 : level == ConstraintLevel::velocity ? "velocity"
                                                                      : "acceleration"));
  }
  row.b = -bias;
  return row;
}

void switch_constraint(ConstraintRow& row, Expression active, std::string condition) {
  const auto apply = [&](Expression& e) { e = active.graph().apply(Operation::multiply_or_zero, active, e); };
  for (Expression& entry : row.A) apply(entry);
  apply(row.b);
  for (Expression& residual : row.residuals) apply(residual);
  row.condition = std::move(condition);
}

namespace {

// M (column-major), A (column-major), b, F in one list
std::vector<Expression> outputs_of(const SymbolicSystem::Definition& definition) {
  std::vector<Expression> outputs;
  const std::size_t nq = definition.coordinates.size();
  for (std::size_t j = 0; j < nq; ++j) {
    for (std::size_t i = 0; i < nq; ++i) outputs.push_back(definition.mass[i][j]);
  }
  for (std::size_t j = 0; j < nq; ++j) {
    for (const ConstraintRow& row : definition.constraints) outputs.push_back(row.A[j]);
  }
  for (const ConstraintRow& row : definition.constraints) outputs.push_back(row.b);
  outputs.insert(outputs.end(), definition.force.begin(), definition.force.end());
  return outputs;
}

std::vector<std::string> labels_of(const SymbolicSystem::Definition& definition) {
  std::vector<std::string> labels;
  for (const ConstraintRow& row : definition.constraints) labels.push_back(row.text);
  return labels;
}

VectorXd noise_of(const SymbolicSystem::Definition& definition) {
  VectorXd noise(std::ssize(definition.constraints));
  std::transform(definition.constraints.begin(), definition.constraints.end(), noise.begin(),
                 [](const ConstraintRow& row) { return row.noise; });
  return noise;
}

std::vector<std::string> conditions_of(const SymbolicSystem::Definition& definition) {
  std::vector<std::string> conditions;
  for (const ConstraintRow& row : definition.constraints) conditions.push_back(row.condition);
  return conditions;
}

}  // namespace

// The derivatives are taken in a graph of their own: that of the definition may be growing elsewhere.
struct SymbolicSystem::StateTape {
  bool is_too_large = false;  // for a graph, with the derivatives
  std::unique_ptr<ExpressionGraph> graph = std::make_unique<ExpressionGraph>();
  std::vector<Expression> outputs, inputs;  // until the derivatives are taken
  std::vector<StateDerivatives::Entry> derivatives;
  Tape tape;  // M, A, b, F, then the derivatives
};

SymbolicSystem::SymbolicSystem(Definition definition)
    : System(definition.name, definition.coordinates, definition.inputs, definition.parameters, labels_of(definition),
             noise_of(definition), conditions_of(definition)),
      definition_(std::move(definition)) {
  ExpressionGraph& graph = *definition_.graph;
  const SystemSymbols symbols(graph, coordinates(), inputs(), parameters());
  const std::vector<Expression> tape_inputs = symbols.state_and_parameters();

  const std::vector<Expression> outputs = outputs_of(definition_);
  values_ = Tape(outputs, tape_inputs);
  mechanics_ = Tape(std::span(outputs).first(outputs.size() - definition_.force.size()), tape_inputs);
  force_ = Tape(definition_.force, tape_inputs);
  for (Expression parameter : symbols.parameters) {
    derivatives_.emplace_back(graph.differentiate(outputs, parameter), tape_inputs);
  }

  std::vector<Expression> residuals;
  for (std::size_t k = 0; k < definition_.constraints.size(); ++k) {
    const ConstraintRow& row = definition_.constraints[k];
    for (std::size_t r = 0; r < row.residuals.size(); ++r) {
      const bool velocity = row.level == ConstraintLevel::velocity || r == 1;
      residuals.push_back(row.residuals[r]);
      residual_labels_.push_back({static_cast<int>(k), velocity, (r == 1 ? "d/dt of " : "") + row.text});
    }
  }
  residuals_ = Tape(residuals, tape_inputs);
  largest_rank_ = internal::find_largest_rank(*this, /*rows_may_vanish=*/false);

  state_tape_ = std::make_unique<StateTape>();
  state_tape_->inputs = state_tape_->graph->copy(tape_inputs);
  state_tape_->outputs = state_tape_->graph->copy(outputs);
}

SymbolicSystem::~SymbolicSystem() = default;

void SymbolicSystem::run(const Tape& tape, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                         SystemValues& values) const {
  require_states(states);
  require_parameters(parameters);
  values.mass.resize(Index{nq()} * nq(), states.cols());
  values.constraint_matrix.resize(Index{nc()} * nq(), states.cols());
  values.constraint_vector.resize(nc(), states.cols());
  values.force.resize(nq(), states.cols());
  std::array<Ref<MatrixXd>, 4> parts{values.mass, values.constraint_matrix, values.constraint_vector, values.force};
  tape.evaluate(states, parameters, parts);
}

SystemValues SymbolicSystem::evaluate(const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) const {
  SystemValues values;
  run(values_, states, parameters, values);
  return values;
}

void SymbolicSystem::evaluate_into(const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                   SystemValues& values) const {
  run(values_, states, parameters, values);
}

SystemValues SymbolicSystem::differentiate(const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                           int index) const {
  require_parameter(index);
  SystemValues values;
  run(derivatives_[static_cast<std::size_t>(index)], states, parameters, values);
  return values;
}

class SymbolicSystem::Evaluator final : public StateEvaluator {
 public:
  Evaluator(const SymbolicSystem& system, const Ref<const VectorXd>& parameters, const Tape& tape,
            std::span<const StateDerivatives::Entry> derivatives)
      : StateEvaluator(system, parameters, derivatives), tape_(tape), workspace_(tape.make_workspace(parameters)) {}

  [[nodiscard]] const Tape* tape() const override { return &tape_; }

 private:
  void evaluate_all(const Ref<const VectorXd>& state) override { tape_.evaluate_at(state, workspace_, all_values()); }

  const Tape& tape_;
  VectorXd workspace_;
};

const SymbolicSystem::StateTape& SymbolicSystem::state_tape() const {
  std::call_once(state_tape_is_filled_, [this] {
    StateTape& out = *state_tape_;
    const internal::StepLimit limit;
    try {
      const internal::DerivativeExpressions derivatives =
          internal::state_derivatives(out.outputs, std::span(out.inputs).first(static_cast<std::size_t>(layout().size())));
      std::vector<Expression> all = out.outputs;
      all.insert(all.end(), derivatives.expressions.begin(), derivatives.expressions.end());
      out.tape = Tape(all, out.inputs);
      out.derivatives = derivatives.entries;
    } catch (const InputError&) {
      out.is_too_large = true;
    }
    out.outputs.clear();
    out.inputs.clear();
    out.graph.reset();
  });
  return *state_tape_;
}

std::unique_ptr<StateEvaluator> SymbolicSystem::make_evaluator(const Ref<const VectorXd>& parameters, bool derivatives) const {
  if (!derivatives) return std::make_unique<Evaluator>(*this, parameters, values_, std::span<const StateDerivatives::Entry>());
  const StateTape& all = state_tape();
  if (all.is_too_large) return System::make_evaluator(parameters, true);
  return std::make_unique<Evaluator>(*this, parameters, all.tape, all.derivatives);
}

MatrixXd SymbolicSystem::residuals(const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) const {
  require_states(states);
  require_parameters(parameters);
  MatrixXd values;
  residuals_.evaluate(states, parameters, values);
  return values;
}

std::vector<bool> SymbolicSystem::reads(SystemPart part) const {
  const Tape& tape = part == SystemPart::mechanics ? mechanics_ : part == SystemPart::force ? force_ : residuals_;
  std::vector<bool> reads;
  for (int k = 0; k < layout().size(); ++k) reads.push_back(tape.uses_input(k));
  return reads;
}

}  // namespace gp2
