#include "gp2/simulation/generate.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>
#include <optional>
#include <span>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/QR>

#include "base/decompositions.hpp"
#include "base/not_a_number.hpp"
#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulate.hpp"
#include "mechanics/known_multipliers.hpp"
#include "simulation/controlled_motion.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Level = ConstraintRow::Level;

namespace {

struct Linearisation {
  VectorXd residual;  // r
  MatrixXd jacobian;  // ∂r/∂x, a column for each of the variables
};

/// Equations r(x) = 0 in coordinates, or in velocities.
struct Equations {
  std::vector<std::string> texts;  // one per equation
  std::vector<bool> come_and_go;   // whether it holds under a condition alone
  std::vector<int> variables;      // the coordinates, or velocities, that the equations depend on: entries of the state
  std::function<Linearisation(const MatrixXd& state, const VectorXd& parameters)> linearise;
};

/// An equation given by an expression.
struct WrittenEquation {
  Expression residual;
  std::string text;
  bool comes_and_goes = false;
};

/// Equations given by expressions.
/// @param candidates   the coordinates, or the velocities, in the order of the state
/// @param first_index  of the candidates in the state
Equations equations_of(const std::vector<WrittenEquation>& equations, const std::vector<Expression>& candidates, int first_index,
                       const std::vector<Expression>& tape_inputs, ExpressionGraph& graph) {
  Equations out;
  std::vector<Expression> outputs;
  for (const WrittenEquation& equation : equations) {
    outputs.push_back(equation.residual);
    out.texts.push_back(equation.text);
    out.come_and_go.push_back(equation.comes_and_goes);
  }
  for (std::size_t j = 0; j < candidates.size(); ++j) {
    const bool decided = std::any_of(equations.begin(), equations.end(),
                                     [&](const auto& equation) { return graph.depends_on(equation.residual, candidates[j]); });
    if (!decided) continue;
    for (const auto& equation : equations) outputs.push_back(graph.differentiate(equation.residual, candidates[j]));
    out.variables.push_back(first_index + static_cast<int>(j));
  }
  const auto n_equations = static_cast<Index>(equations.size()), n_variables = static_cast<Index>(out.variables.size());
  out.linearise = [tape = Tape(outputs, tape_inputs), n_equations, n_variables](const MatrixXd& state,
                                                                                const VectorXd& parameters) -> Linearisation {
    MatrixXd values;
    tape.evaluate(state, parameters, values);
    return {values.col(0).head(n_equations), values.col(0).tail(n_equations * n_variables).reshaped(n_equations, n_variables)};
  };
  return out;
}

/// The position residuals of any system, or its velocity residuals. Their rows of A are ∂c/∂q, which is also ∂ċ/∂dq.
Equations equations_of(const System& system, bool velocity) {
  Equations out;
  std::vector<int> residuals, rows, columns;
  for (std::size_t k = 0; k < system.residual_labels().size(); ++k) {
    const System::Residual& label = system.residual_labels()[k];
    if (label.velocity != velocity) continue;
    out.texts.push_back(label.text);
    out.come_and_go.push_back(system.is_conditional(label.row));
    residuals.push_back(static_cast<int>(k));
    rows.push_back(label.row);
  }
  if (residuals.empty()) return out;
  const StateLayout layout = system.layout();
  const std::vector<bool> reads = system.reads(SystemPart::residuals);
  for (int j = 0; j < system.nq(); ++j) {
    const int entry = velocity ? layout.dq(j) : layout.q(j);
    if (!reads[static_cast<std::size_t>(entry)]) continue;
    out.variables.push_back(entry);
    columns.push_back(j);
  }
  out.linearise = [&system, residuals, rows, columns](const MatrixXd& state, const VectorXd& parameters) -> Linearisation {
    // what is not known yet does not matter to these residuals, but code need not bear a NaN
    const VectorXd head = state.col(0).head(system.layout().size());
    const MatrixXd known = head.array().isNaN().select(0, head);
    const SystemValues values = system.evaluate(known, parameters);
    return {system.residuals(known, parameters)(residuals, 0), values.A(0)(rows, columns)};
  };
  return out;
}

/// Coordinates (or velocities) that a set of equations decides, by Newton's method.
class Completion {
 public:
  /// @param given  which entries of the state [sampling] gives; what it does not, but an equation has, is solved for
  Completion(const Model& model, Equations equations, const std::vector<bool>& given)
      : model_(model), equations_(std::move(equations)) {
    const std::vector<std::string> state_names = model.system->state_names();
    for (std::size_t k = 0; k < equations_.variables.size(); ++k) {
      const auto entry = static_cast<std::size_t>(equations_.variables[k]);
      if (given[entry]) continue;
      const auto start = model.newton_start.find(state_names[entry]);
      unknown_columns_.push_back(static_cast<int>(k));
      unknowns_.push_back(equations_.variables[k]);
      start_.push_back(start == model.newton_start.end() ? 0 : start->second);
      names_.push_back(state_names[entry]);
    }
  }

  [[nodiscard]] const std::vector<int>& unknowns() const { return unknowns_; }  // entries of the state

  /// Solves for the unknowns from their start values, to rounding.
  void solve(MatrixXd& state, const VectorXd& parameters, int sample) const {
    if (equations_.texts.empty()) return;
    state(unknowns_, 0) = Eigen::Map<const VectorXd>(start_.data(), static_cast<Index>(start_.size()));
    if (!unknowns_.empty()) iterate(state, parameters, sample);
    check(state, parameters, sample);
  }

 private:
  void iterate(MatrixXd& state, const VectorXd& parameters, int sample) const {
    constexpr int max_iterations = 100;
    int polishing = 0;
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      const Linearisation at = equations_.linearise(state, parameters);
      if (!at.residual.allFinite() || !at.jacobian.allFinite()) break;
      Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
      decomposition.setThreshold(1e-10);
      decomposition.compute(at.jacobian(Eigen::all, unknown_columns_));
      if (decomposition.rank() < static_cast<Index>(unknowns_.size())) {
        require_present(at, sample);
        throw InputError(fmt::format(
            "{}: [sampling]: at {} the constraints decide only {} of the {} unknowns {}: draw some of them, "
            "or start elsewhere, start = {{ {} = … }}",
            model_.name, describe(state), decomposition.rank(), unknowns_.size(), fmt::join(names_, ", "), names_.front()));
      }
      const VectorXd step = decomposition.solve(at.residual);
      state(unknowns_, 0) -= step;
      // quadratic convergence: after a step this small the next is rounding; two of those, to reach it
      const double size = std::max(1.0, state(unknowns_, 0).lpNorm<Eigen::Infinity>());
      if (step.lpNorm<Eigen::Infinity>() <= 1e-9 * size && polishing++ == 2) return;
    }
    throw NumericalError(
        fmt::format("{}: [sampling]: Newton's method did not reach the constraints for {} at sample {}; give a "
                    "better start = {{ {} = … }}",
                    model_.name, fmt::join(names_, ", "), sample + 1, names_.front()));
  }

  // With fewer unknowns than equations, Newton's method ends where they are violated least.
  void check(const MatrixXd& state, const VectorXd& parameters, int sample) const {
    const Linearisation at = equations_.linearise(state, parameters);
    const VectorXd size = state(equations_.variables, 0).cwiseAbs().cwiseMax(1);
    const VectorXd scale = at.jacobian.cwiseAbs() * size;
    for (Index k = 0; k < at.residual.size(); ++k) {
      if (std::abs(at.residual[k]) <= 1e-9 * scale[k]) continue;
      if (const auto equation = static_cast<std::size_t>(k); equations_.come_and_go[equation]) {
        std::vector<int> read;
        for (std::size_t j = 0; j < equations_.variables.size(); ++j) {
          if (at.jacobian(k, static_cast<Index>(j)) != 0) read.push_back(equations_.variables[j]);
        }
        refuse_conditional(equation, names_of(read.empty() ? equations_.variables : read), sample);
      }
      throw InputError(
          fmt::format("{}: [sampling]: sample {} ({}) is off the constraint \"{}\" by {:.3g}: leave one more of {} to be "
                      "solved from the constraints",
                      model_.name, sample + 1, describe(state), equations_.texts[static_cast<std::size_t>(k)], at.residual[k],
                      fmt::join(names_of(equations_.variables), ", ")));
    }
  }

  // Whether there would be enough equations, were it not for a condition that does not hold.
  void require_present(const Linearisation& at, int sample) const {
    std::optional<std::size_t> absent;
    std::size_t n_present = 0;
    for (std::size_t k = 0; k < equations_.texts.size(); ++k) {
      if (!at.jacobian.row(static_cast<Index>(k)).isZero(0)) {
        ++n_present;
      } else if (equations_.come_and_go[k] && !absent) {
        absent = k;
      }
    }
    if (absent && n_present < unknowns_.size()) refuse_conditional(*absent, names_, sample);
  }

  // A constraint that is not there at every sample can neither be left to decide something, nor drawn past.
  [[noreturn]] void refuse_conditional(std::size_t equation, const std::vector<std::string>& names, int sample) const {
    throw InputError(fmt::format(
        "{}: [sampling]: sample {}: the constraint \"{}\" is there at some of the samples only: give {}{} by an expression that "
        "satisfies it, {} = \"…\"",
        model_.name, sample + 1, equations_.texts[equation], names.size() > 1 ? "one of " : "", fmt::join(names, ", "),
        names.front()));
  }

  [[nodiscard]] std::vector<std::string> names_of(const std::vector<int>& entries) const {
    const std::vector<std::string> all = model_.system->state_names();
    std::vector<std::string> names;
    for (int entry : entries) names.push_back(all[static_cast<std::size_t>(entry)]);
    return names;
  }

  // "q1 = 0.1, q2 = 2"
  [[nodiscard]] std::string describe(const MatrixXd& state) const {
    const std::vector<std::string> names = names_of(equations_.variables);
    std::vector<std::string> parts;
    for (std::size_t k = 0; k < names.size(); ++k) {
      parts.push_back(fmt::format("{} = {:.6g}", names[k], state(equations_.variables[k], 0)));
    }
    return fmt::format("{}", fmt::join(parts, ", "));
  }

  const Model& model_;
  Equations equations_;
  std::vector<int> unknowns_;         // entries of the state to solve for
  std::vector<int> unknown_columns_;  // their positions among the variables of the equations
  std::vector<double> start_;         // per unknown
  std::vector<std::string> names_;    // per unknown
};

/// Draws one state after the other by the rules of [sampling].
class Sampler {
 public:
  explicit Sampler(const Model& model) : model_(model), parameters_(model.system->parameter_values()), symbols_(model.symbols()) {
    place_rules();
    add_completions();
    schedule_rules();
    check_known();
  }

  [[nodiscard]] const std::vector<bool>& known() const { return known_; }

  /// Where in its range, from 0 to 1, a rule of the model's sampling is drawn.
  using Fraction = std::function<double(std::size_t rule)>;

  [[nodiscard]] VectorXd draw(const Fraction& fraction, int sample) const {
    MatrixXd state = MatrixXd::Constant(n_varying_, 1, not_a_number);
    apply_rules(Stage::before_positions, fraction, state, sample);
    positions_->solve(state, parameters_, sample);
    apply_rules(Stage::after_positions, fraction, state, sample);
    velocities_->solve(state, parameters_, sample);
    apply_rules(Stage::after_velocities, fraction, state, sample);
    return state.col(0).head(model_.system->layout().size());
  }

 private:
  enum class Stage { before_positions, after_positions, after_velocities };

  // tape inputs: the state, the auxiliary draws, the parameters
  void place_rules() {
    const std::vector<std::string> names = model_.system->state_names();
    known_.assign(names.size(), false);
    tape_inputs_ = symbols_.state();
    for (const Model::SamplingRule& rule : model_.sampling) {
      const auto of_state = std::find(names.begin(), names.end(), rule.name);
      if (of_state != names.end()) {
        target_.push_back(static_cast<int>(of_state - names.begin()));
        known_[static_cast<std::size_t>(target_.back())] = true;
      } else {
        target_.push_back(static_cast<int>(tape_inputs_.size()));
        tape_inputs_.push_back(graph().variable(rule.name));
      }
    }
    n_varying_ = static_cast<Index>(tape_inputs_.size());
    tape_inputs_.insert(tape_inputs_.end(), symbols_.parameters.begin(), symbols_.parameters.end());
  }

  void add_completions() {
    if (const SymbolicSystem* symbolic = model_.symbolic_system()) {
      std::vector<WrittenEquation> positions, velocities;
      for (const ConstraintRow& row : symbolic->definition().constraints) {
        const bool comes_and_goes = !row.condition.empty();
        if (row.level == Level::position) {
          positions.push_back({row.residuals[0], row.text, comes_and_goes});
          velocities.push_back({row.residuals[1], "d/dt of " + row.text, comes_and_goes});
        } else if (row.level == Level::velocity) {
          velocities.push_back({row.residuals[0], row.text, comes_and_goes});
        }
      }
      const StateLayout layout = model_.system->layout();
      positions_.emplace(model_, equations_of(positions, symbols_.q, layout.q(0), tape_inputs_, graph()), known_);
      velocities_.emplace(model_, equations_of(velocities, symbols_.dq, layout.dq(0), tape_inputs_, graph()), known_);
    } else {
      positions_.emplace(model_, equations_of(*model_.system, false), known_);
      velocities_.emplace(model_, equations_of(*model_.system, true), known_);
    }
    for (const Completion* completion : {&*positions_, &*velocities_}) {
      for (int unknown : completion->unknowns()) known_[static_cast<std::size_t>(unknown)] = true;
    }
  }

  // a rule that needs what is solved from the constraints waits until it is there
  void schedule_rules() {
    std::map<std::string, Stage> available;
    for (int unknown : positions_->unknowns()) available[name_of(unknown)] = Stage::after_positions;
    for (int unknown : velocities_->unknowns()) available[name_of(unknown)] = Stage::after_velocities;
    for (const Model::SamplingRule& rule : model_.sampling) {
      Stage stage = Stage::before_positions;
      if (!rule.range) {
        for (const std::string& name : graph().variables_of(rule.value)) {
          if (const auto from = available.find(name); from != available.end()) stage = std::max(stage, from->second);
        }
      }
      available[rule.name] = stage;
      stage_.push_back(stage);
      tapes_.push_back(rule.range ? Tape() : Tape(std::span(&rule.value, 1), tape_inputs_));
    }
  }

  // everything that the true motion and the constraints read must be known
  void check_known() const {
    const System& system = *model_.system;
    std::vector<Expression> added = model_.truth;
    added.insert(added.end(), model_.truth_force.begin(), model_.truth_force.end());
    const Tape truth(added, symbols_.state_and_parameters(multipliers_in(added, system).variables));
    const std::vector<bool> mechanics = system.reads(SystemPart::mechanics);
    const std::vector<bool> force = system.reads(SystemPart::force);
    const std::vector<bool> residuals = system.reads(SystemPart::residuals);
    for (std::size_t k = 0; k < known_.size(); ++k) {
      const bool reads = mechanics[k] || force[k] || residuals[k] || truth.uses_input(static_cast<int>(k));
      if (reads && !known_[k]) {
        const std::string name = name_of(static_cast<int>(k));
        throw InputError(
            fmt::format("{}: [sampling] says nothing of '{}', which the model reads, and no constraint decides it: add {} "
                        "= [lower, upper]",
                        model_.name, name, name));
      }
    }
  }

  void apply_rules(Stage stage, const Fraction& fraction, MatrixXd& state, int sample) const {
    MatrixXd value;
    for (std::size_t r = 0; r < model_.sampling.size(); ++r) {
      if (stage_[r] != stage) continue;
      const Model::SamplingRule& rule = model_.sampling[r];
      if (rule.range) {
        state(target_[r], 0) = rule.range->first + fraction(r) * (rule.range->second - rule.range->first);
        continue;
      }
      tapes_[r].evaluate(state, parameters_, value);
      state(target_[r], 0) = value(0, 0);
      if (!std::isfinite(value(0, 0))) {
        throw InputError(fmt::format("{}:{}: sampling.{}: {} is not a finite number at sample {}", model_.name, rule.line,
                                     rule.name, to_string(rule.value), sample + 1));
      }
    }
  }

  [[nodiscard]] ExpressionGraph& graph() const { return *model_.graph; }
  [[nodiscard]] const std::string& name_of(int entry) const {
    return tape_inputs_[static_cast<std::size_t>(entry)].variable_name();
  }

  const Model& model_;
  VectorXd parameters_;
  SystemSymbols symbols_;
  std::vector<bool> known_;              // entries of the state that are drawn or solved for
  std::vector<Expression> tape_inputs_;  // the first n_varying_ are drawn or solved for, the parameters follow
  Index n_varying_ = 0;
  std::vector<int> target_;   // of each rule: its row among the tape inputs
  std::vector<Stage> stage_;  // of each rule
  std::vector<Tape> tapes_;   // of each rule
  std::optional<Completion> positions_, velocities_;
};

// points of every range of [sampling], in its order; 0 where a rule is an expression
std::vector<int> grid_points(const Model& model, const std::map<std::string, int>& grid) {
  std::vector<int> points;
  std::vector<std::string> ranges;
  double total = 1;
  for (const Model::SamplingRule& rule : model.sampling) {
    points.push_back(0);
    if (!rule.range) continue;
    ranges.push_back(rule.name);
    const auto found = grid.find(rule.name);
    if (found == grid.end()) {
      throw InputError(fmt::format("grid: no number of points for '{}': every range of [sampling] needs one", rule.name));
    }
    if (found->second < 1) {
      throw InputError(fmt::format("grid: '{}' must have at least 1 point, got {}", rule.name, found->second));
    }
    points.back() = found->second;
    total *= found->second;
  }
  for (const auto& [name, n] : grid) {
    if (std::find(ranges.begin(), ranges.end(), name) == ranges.end()) {
      throw InputError(
          fmt::format("grid: '{}' is not a range of [sampling] in {}; ranges: {}", name, model.name, fmt::join(ranges, ", ")));
    }
  }
  constexpr double largest = 1e7;
  if (total > largest) throw InputError(fmt::format("grid: {:.3g} points are more than {:.0e}", total, largest));
  return points;
}

// even points over every range, ends included, the last range fastest; the middle where there is one point
MatrixXd grid_states(const Model& model, const Sampler& sampler, const std::map<std::string, int>& grid) {
  const std::vector<int> points = grid_points(model, grid);
  int n = 1;
  for (const int of_rule : points) n *= std::max(of_rule, 1);
  MatrixXd states(model.system->layout().size(), n);
  std::vector<int> index(points.size());
  for (int i = 0; i < n; ++i) {
    for (int rule = static_cast<int>(points.size()) - 1, rest = i; rule >= 0; --rule) {
      const auto r = static_cast<std::size_t>(rule);
      index[r] = rest % std::max(points[r], 1);
      rest /= std::max(points[r], 1);
    }
    const auto fraction = [&](std::size_t rule) {
      return points[rule] == 1 ? 0.5 : static_cast<double>(index[rule]) / (points[rule] - 1);
    };
    states.col(i) = sampler.draw(fraction, i);
  }
  return states;
}

GeneratedData draw_states(const Model& model, const GenerateOptions& options, RandomStream& random) {
  const Sampler sampler(model);
  GeneratedData data;
  data.known = sampler.known();
  if (!options.grid.empty()) {
    data.states = grid_states(model, sampler, options.grid);
    return data;
  }
  data.states.resize(model.system->layout().size(), options.n);
  const auto fraction = [&](std::size_t) { return random.uniform(); };
  for (int i = 0; i < options.n; ++i) data.states.col(i) = sampler.draw(fraction, i);
  return data;
}

}  // namespace

GeneratedData generate(const Model& model, const GenerateOptions& options) {
  const System& system = *model.system;
  if (model.sampling.empty() && !model.motion) {
    throw InputError(
        fmt::format("{}: missing [sampling]: where states are drawn from, say q1 = [-1, 1]; or [motion]: how the "
                    "system is driven",
                    model.name));
  }
  if (model.motion && !options.grid.empty()) {
    throw InputError(fmt::format("{}: a grid is of the ranges of [sampling], but this model has [motion]", model.name));
  }
  if (model.motion && !contacts_of(model, system.parameter_values()).empty()) {
    throw InputError(fmt::format(
        "{}: [motion] looks for no contact, so that a body would pass through its surface: draw states by [sampling], "
        "or simulate a motion",
        model.name));
  }
  require_truth(model);
  if (options.n < 1) throw InputError(fmt::format("generate: n must be at least 1, got {}", options.n));
  if (options.noise_stddev.size() != system.nq() || !(options.noise_stddev.array() >= 0).all() ||
      !options.noise_stddev.allFinite()) {
    throw InputError(fmt::format("generate: noise_stddev must hold {} finite numbers ≥ 0, one per coordinate", system.nq()));
  }

  RandomStream random(options.seed);
  GeneratedData data;
  MatrixXd held;  // what dry friction adds where it holds a driven body at rest, at which sign(0) = 0
  if (model.motion) {
    DrivenMotion motion = generate_motion(model, options.n, random);
    if (switching_functions(model, /*of_latents=*/false).size() > 0) {
      held = motion.accelerations - true_acceleration(model, motion.states);
    }
    data.states = std::move(motion.states);
    data.known.assign(static_cast<std::size_t>(system.layout().size()), true);
  } else {
    data = draw_states(model, options, random);
  }
  // noise comes last, so that states are the same for any noise
  MatrixXd noise = MatrixXd::Zero(system.nq(), data.states.cols()), slip;
  for (Index i = 0; i < noise.cols(); ++i) {
    for (Index j = 0; j < noise.rows(); ++j) {
      if (options.noise_stddev[j] > 0) noise(j, i) = options.noise_stddev[j] * random.normal();
    }
  }
  if (!options.noise_stddev.isZero(0)) {
    slip.resize((system.constraint_noise().array() > 0).count(), noise.cols());
    for (double& one : slip.reshaped()) one = random.normal();
  }
  data.accelerations = true_acceleration(model, data.states, slip) + noise;
  if (held.size() > 0) data.accelerations += held;
  return data;
}

CsvTable as_table(const GeneratedData& data, const System& system, std::string name) {
  const std::vector<std::string> names = system.state_names(), accelerations = system.acceleration_names();
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& column, const auto& values) {
    columns.push_back({column, {values.begin(), values.end()}});
  };
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (data.known[k]) add(names[k], data.states.row(static_cast<Index>(k)));
  }
  for (std::size_t k = 0; k < accelerations.size(); ++k) add(accelerations[k], data.accelerations.row(static_cast<Index>(k)));
  return CsvTable::from_columns(std::move(name), std::move(columns));
}

}  // namespace gp2
