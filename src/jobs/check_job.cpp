#include "gp2/jobs/check_job.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <mutex>
#include <numbers>
#include <tuple>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/decompositions.hpp"
#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/prior.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/projected_states.hpp"
#include "gp2/training/default_hyperparameters.hpp"
#include "inference/nonlinear_motion.hpp"
#include "jobs/acting_states.hpp"
#include "jobs/rate_check.hpp"
#include "jobs/reading_notes.hpp"
#include "jobs/repeated_rows.hpp"
#include "mechanics/in_blocks.hpp"
#include "mechanics/known_multipliers.hpp"
#include "prior/code_function.hpp"

namespace gp2 {

namespace {

using Level = Finding::Level;

constexpr int all_threads = 0;

void append(std::vector<Finding>& findings, std::vector<Finding> more) {
  for (Finding& finding : more) findings.push_back(std::move(finding));
}

bool has_error(const std::vector<Finding>& findings) {
  return std::any_of(findings.begin(), findings.end(), [](const Finding& one) { return one.level == Level::error; });
}

// Priors that a fit refuses, or that it cannot follow.
void check_priors(const System& system, std::vector<Finding>& findings) {
  constexpr double far = 3;  // deviations
  for (const Parameter& parameter : system.parameters()) {
    if (!parameter.prior || !parameter.bounds) continue;
    auto [lower, upper] = *parameter.bounds;
    auto [middle, stddev, of_logarithm] = *parameter.prior;
    const std::string bounds = fmt::format("[{}, {}]", lower, upper);
    if (of_logarithm && !(lower > 0)) {
      findings.push_back(
          {parameter.estimate ? Level::error : Level::warning,
           fmt::format("parameter '{}': a prior of the logarithm needs bounds above 0, got {}; a fit that estimates "
                       "it refuses them",
                       parameter.name, bounds)});
      continue;
    }
    if (of_logarithm) std::tie(lower, upper, middle) = std::tuple(std::log(lower), std::log(upper), std::log(middle));
    const double beyond = std::max(lower - middle, middle - upper) / stddev;
    if (!(beyond > far)) continue;
    findings.push_back({Level::warning, fmt::format("parameter '{}': the centre of its prior, {}, lies {:.2g} standard "
                                                    "deviations outside the bounds {}: an estimate would end at the bound",
                                                    parameter.name, parameter.prior->median, beyond, bounds)});
  }
}

// Parameters marked for a fit that it refuses to estimate.
void check_marks(const Model& model, std::vector<Finding>& findings) {
  std::vector<std::string> marked;
  for (const Parameter& parameter : model.system->parameters()) {
    if (parameter.estimate) marked.push_back(parameter.name);
  }
  if (marked.empty()) return;
  const Prior prior = make_prior(model);
  for (const std::string& name : marked) {
    try {
      require_estimable(prior, name);
    } catch (const InputError& error) {
      const bool is_zero = model.system->parameters()[static_cast<std::size_t>(model.system->parameter_index(name))].value == 0;
      findings.push_back(is_zero
                             ? Finding{Level::warning, fmt::format("{}; a fit by the default protocol refuses it", error.what())}
                             : Finding{Level::error, error.what()});
    }
  }
}

void check_model(const Model& model, std::vector<Finding>& findings) {
  const System& system = *model.system;
  findings.push_back({Level::good, fmt::format("{}: '{}', {}, {}", model.name, system.name(), counted(system.nq(), "coordinate"),
                                               counted(system.nc(), "constraint"))});
  check_priors(system, findings);
  check_marks(model, findings);
  if (!model.robot) return;
  for (const std::string& note : model.robot->notes) findings.push_back({Level::good, note});
}

// A column that is missing is an error only where the model cannot do without.
void check_columns_of(const CsvTable& table, const LogReader& reader, const WholeLog& log, const System& system,
                      std::vector<Finding>& findings) {
  const std::vector<std::string> accelerations = system.acceleration_names();
  const auto good = [&](std::string text) { findings.push_back({Level::good, std::move(text)}); };
  good(fmt::format("{}: {} rows; all columns that the model reads were found", table.name(), table.n_rows()));
  if (std::ssize(log.missing) == system.nq()) {
    findings.push_back(
        {Level::warning,
         fmt::format("not in the log: {}; a fit needs at least one of them; gp2 derive computes them from positions over t",
                     fmt::join(log.missing, ", "))});
  } else if (!log.missing.empty()) {
    findings.push_back(
        {Level::warning, fmt::format("not in the log: {}; fit with `observe` for the others", fmt::join(log.missing, ", "))});
  }
  if (!log.stated.empty()) {
    std::vector<std::string> names;
    for (const int row : log.stated) names.push_back(accelerations[static_cast<std::size_t>(row)]);
    good(fmt::format("noise of each value: {}, which a fit observes", fmt::join(names, ", ")));
  }
  for (int row = 0; row < system.nq(); ++row) {
    const auto values = log.accelerations.row(row).array();
    const auto n_missing = values.isNaN().count();
    if (n_missing == 0 || n_missing == values.size()) continue;
    good(fmt::format("{} of {} values of {} are not measured: their cells are empty", n_missing, values.size(),
                     accelerations[static_cast<std::size_t>(row)]));
  }
  constexpr std::string_view warning = "warning: ";
  for (const std::string& note : reader.notes()) {
    if (note.starts_with(warning)) {
      findings.push_back({Level::warning, note.substr(warning.size())});
    } else {
      good(note);
    }
  }
  const std::vector<std::string> unused = reader.unused_columns();
  if (!unused.empty()) good(fmt::format("columns not needed: {}", fmt::join(unused, ", ")));
}

// The first state at which M is singular, −1: none.
int first_singular_mass(const System& system, const Eigen::MatrixXd& states) {
  std::mutex mutex;
  int first_of_all = -1;
  for_each_mechanics(system, states, system.parameter_values(), all_threads,
                     [&](Eigen::Index first, const MechanicsBatch& mechanics) {
                       const int here = mechanics.first_singular(), state = static_cast<int>(first) + here;
                       const std::scoped_lock lock(mutex);
                       if (here >= 0 && (first_of_all < 0 || state < first_of_all)) first_of_all = state;
                     });
  return first_of_all;
}

/// Latents whose directions read the load of the constraints, at states.
class LoadCheck {
 public:
  /// @param rows  of the log, that the states are
  LoadCheck(const Model& model, Prior prior, Eigen::MatrixXd states, std::vector<Eigen::Index> rows)
      : model_(model),
        prior_(std::move(prior)),
        states_(std::move(states)),
        rows_(std::move(rows)),
        parameters_(prior_.system->parameter_values()),
        mechanics_(require_mechanics(*prior_.system, states_, parameters_)),
        values_(evaluate_prior(prior_, states_, parameters_, mechanics_)) {}

  void run(std::vector<Finding>& findings) const {
    for (std::string& text : shared_load_texts(model_, *prior_.system, mechanics_))
      findings.push_back({Level::warning, std::move(text)});
    if (values_.fault) {
      const Eigen::Index row = rows_[static_cast<std::size_t>(values_.fault->state)];
      findings.push_back({Level::error, fmt::format("{} at state {}", values_.fault->text, row + 1)});
      return;
    }
    for (std::size_t a = 0; a < prior_.latents.size(); ++a) {
      const Latent& latent = prior_.latents[a];
      if (!latent.directions || !reads_load(*latent.directions, parameters_)) continue;
      for (int l = 0; l < latent.size(); ++l) {
        const std::string name =
            latent.size() == 1 ? fmt::format("latent '{}'", latent.name)
                               : fmt::format("latent '{}', {}", latent.name, latent.column_names[static_cast<std::size_t>(l)]);
        if (latent.reads_multipliers()) {
          add_jam(name, a, l, findings);
        } else {
          add_left_out(name, a, l, findings);
        }
      }
    }
  }

  /// Whether features or directions read λ₀ or λ.
  static bool reads_load(const Latent& latent, const Eigen::VectorXd& parameters) {
    return reads_load(*latent.features, Eigen::VectorXd()) || (latent.directions && reads_load(*latent.directions, parameters));
  }

 private:
  static constexpr double enough = 0.1;  // of the load, that a coefficient of 1 makes

  static bool reads_load(const StateFunction& function, const Eigen::VectorXd& parameters) {
    return function.make_evaluator(parameters)->tapes().n_loads > 0;
  }

  // how much of the load under the known force a coefficient of 1 changes (theory.md, T46: κ)
  void add_left_out(const std::string& name, std::size_t a, int l, std::vector<Finding>& findings) const {
    const ViewValues multipliers = evaluate_view(View::multipliers(*prior_.system), mechanics_, states_);
    const Eigen::MatrixXd known = with_known_multipliers(*prior_.system, states_, parameters_).bottomRows(prior_.system->nc());
    // beside a load that is hardly there everything is large
    const double least = 0.1 * std::sqrt(known.colwise().squaredNorm().mean());
    double largest = 0;
    for (int i = 0; i < states_.cols(); ++i) {
      const double load = known.col(i).norm();
      if (load > least) largest = std::max(largest, (multipliers.G(i) * values_.E(a, i).col(l)).norm() / load);
    }
    if (largest < 1e-6) return;
    findings.push_back(
        {largest > enough ? Level::warning : Level::good,
         fmt::format(
             "{}: a value of 1 changes lambda0, the load that it reads, by up to {:.2g} of it; lambda includes this change", name,
             largest)});
  }

  // the least coefficient that leaves a state without a motion
  void add_jam(const std::string& name, std::size_t a, int l, std::vector<Finding>& findings) const {
    const NonlinearMotion motion(prior_, states_, parameters_, mechanics_, values_);
    const auto fault = [&](double coefficient) {
      Linearisation::OfGroup at = motion.without_signals();
      at.signals[a].row(l).setConstant(prior_.latents[a].is_positive ? std::log(coefficient) : coefficient);
      return motion.solve(at);
    };
    constexpr double most = 1e3;
    double free = 0, jammed = 1e-3;
    while (jammed < most && !fault(jammed)) free = std::exchange(jammed, 2 * jammed);
    if (jammed >= most) {
      findings.push_back({Level::good, fmt::format("{}: no coefficient makes it jam", name)});
      return;
    }
    for (int step = 0; step < 20; ++step) (fault(0.5 * (free + jammed)) ? jammed : free) = 0.5 * (free + jammed);
    findings.push_back(
        {Level::good, fmt::format("{}: coefficients of {:.3g} or more make it jam (Painlevé's paradox), first at state {}", name,
                                  jammed, rows_[static_cast<std::size_t>(fault(jammed)->state)] + 1)});
  }

  const Model& model_;
  Prior prior_;
  Eigen::MatrixXd states_;
  std::vector<Eigen::Index> rows_;
  Eigen::VectorXd parameters_;
  MechanicsBatch mechanics_;
  PriorValues values_;
};

// Directions of latents, at the states that are known.
void check_latents(const Model& model, const Eigen::MatrixXd& states, std::vector<Finding>& findings) {
  constexpr Eigen::Index enough = 300;  // states, evenly taken, for what is sought at each
  PriorOptions options;
  options.mean = Prior::Mean::force;
  const Prior prior = make_prior(model, options);
  const Eigen::VectorXd parameters = prior.system->parameter_values();
  const std::vector<bool> reads = prior.reads();
  std::vector<Eigen::Index> rows;
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    bool is_known = true;
    for (std::size_t k = 0; k < reads.size(); ++k)
      is_known = is_known && !(reads[k] && std::isnan(states(static_cast<Eigen::Index>(k), i)));
    if (is_known) rows.push_back(i);
  }
  const Eigen::MatrixXd known = states(Eigen::all, rows);
  if (auto mixed = mixed_states_text(prior, known, parameters)) findings.push_back({Level::error, *std::move(mixed)});
  ActingStates acting(prior);
  acting.count(prior, known, parameters);
  for (std::string& text : acting.idle_texts()) findings.push_back({Level::warning, std::move(text)});
  if (std::ranges::none_of(prior.latents, [&](const Latent& one) { return LoadCheck::reads_load(one, parameters); })) return;
  const auto stride = std::max<Eigen::Index>(1, std::ssize(rows) / enough);
  std::vector<Eigen::Index> some;
  for (Eigen::Index k = 0; k < std::ssize(rows); k += stride) some.push_back(rows[static_cast<std::size_t>(k)]);
  if (some.empty()) return;
  LoadCheck(model, prior, states(Eigen::all, some), some).run(findings);
}

// The known force, and with [truth] what acts in truth (nq × N each).
std::vector<Eigen::MatrixXd> forces_at(const Model& model, const Eigen::MatrixXd& states, const SystemValues& values) {
  const System& system = *model.system;
  std::vector<Eigen::MatrixXd> forces(1, values.force);
  if (model.truth.empty()) return forces;
  std::vector<Expression> added = model.truth;
  added.insert(added.end(), model.truth_force.begin(), model.truth_force.end());
  const Multipliers multipliers = multipliers_in(added, system);
  const Eigen::VectorXd parameters = system.parameter_values();
  Eigen::MatrixXd truth;
  Tape(added, model.symbols().state_and_parameters(multipliers.variables))
      .evaluate(multipliers.variables.empty() ? states : with_known_multipliers(system, states, parameters), parameters, truth);
  forces.push_back(values.force + truth.bottomRows(system.nq()));
  for (int i = 0; i < values.n_states(); ++i) forces.back().col(i) += values.M(i) * truth.col(i).head(system.nq());
  return forces;
}

// Whether F + ∂V/∂q is larger than F at nearly all states, and its changes from state to state are, which a constant force leaves alone.
bool contradicts(const Eigen::MatrixXd& force, const Eigen::MatrixXd& slope) {
  const Eigen::MatrixXd rest = force + slope;
  const auto n_worse = (rest.colwise().norm().array() > force.colwise().norm().array()).count();
  const auto spread = [](const Eigen::MatrixXd& of) { return (of.colwise() - of.rowwise().mean()).squaredNorm(); };
  const bool is_constant = spread(slope) < 1e-6 * slope.squaredNorm();
  return n_worse * 10 >= 9 * force.cols() && (is_constant || spread(rest) > spread(force));
}

// A potential that the force does not come from. They are compared at rest, without inputs, at one time, and along what the constraints
// admit: V may be written in the coordinates that they leave.
void check_potential(const Model& model, const Eigen::MatrixXd& states, std::vector<Finding>& findings) {
  constexpr Eigen::Index enough = 300;  // states, evenly taken
  if (!model.potential || model.robot) return;
  const System& system = *model.system;
  const StateLayout layout = system.layout();
  const Eigen::VectorXd parameters = system.parameter_values();
  const Eigen::Index stride = std::max<Eigen::Index>(1, states.cols() / enough);
  Eigen::MatrixXd at_rest = states(Eigen::all, Eigen::seq(0, Eigen::last, stride));
  at_rest.middleRows(layout.dq(0), layout.nq).setZero();
  at_rest.row(layout.t()).setConstant(states(layout.t(), 0));
  at_rest.bottomRows(layout.nu).setZero();
  const SystemValues values = system.evaluate(at_rest, parameters);
  const SystemSymbols symbols = model.symbols();
  std::vector<Expression> gradient;
  for (const Expression& q : symbols.q) gradient.push_back(model.graph->differentiate(*model.potential, q));
  Eigen::MatrixXd slope;
  Tape(gradient, symbols.state_and_parameters()).evaluate(at_rest, parameters, slope);
  bool is_wrong = true;
  Eigen::Index n_compared = 0;
  for (Eigen::MatrixXd force : forces_at(model, at_rest, values)) {
    Eigen::MatrixXd admitted_slope = slope;
    std::vector<int> compared;
    for (int i = 0; i < force.cols(); ++i) {
      if (system.nc() > 0 && values.A(i).allFinite()) {
        force.col(i) -= least_squares(values.A(i), values.A(i) * force.col(i));
        admitted_slope.col(i) -= least_squares(values.A(i), values.A(i) * slope.col(i));
      }
      constexpr double rounding = 1e-9;
      const double size = force.col(i).norm(), of_all = values.F(i).norm() + slope.col(i).norm();
      if (std::isfinite(of_all) && std::min(size, admitted_slope.col(i).norm()) > rounding * of_all) compared.push_back(i);
    }
    n_compared = std::ssize(compared);
    is_wrong = is_wrong && n_compared > 0 && contradicts(force(Eigen::all, compared), admitted_slope(Eigen::all, compared));
  }
  if (!is_wrong) return;
  findings.push_back(
      {Level::warning,
       fmt::format("potential: at rest the force is farther from -dV/dq than from 0, at nearly all of {} states: is a "
                   "sign, a factor or a term wrong? The energy that simulate reports has this potential",
                   n_compared)});
}

// The system, and where that is sound what the prior asks of it.
void check_mechanics(const Model& model, const Eigen::MatrixXd& states, std::vector<Finding>& findings) {
  const System& system = *model.system;
  append(findings, check_system(system, states, system.parameter_values(), all_threads));
  if (has_error(findings)) return;
  check_potential(model, states, findings);
  const Prior prior = make_prior(model);
  const View view = View::constrained_acceleration(system);
  const int singular = what_needs_acceleration(prior, view) ? first_singular_mass(system, states) : -1;
  if (singular < 0) {
    check_latents(model, states, findings);
    return;
  }
  MechanicsBatch mechanics;
  evaluate_mechanics(prior, view, states.col(singular), system.parameter_values(), mechanics);
  if (mechanics.fault) findings.push_back({Level::error, fmt::format("{} at state {}", mechanics.fault->text, singular + 1)});
}

// Whether constraints say at every state how coordinate j moves, as a belt does at a constant speed: it is a combination of rows of A.
bool is_led(const System& system, const Eigen::MatrixXd& states, int j) {
  if (system.nc() == 0) return false;
  const Eigen::VectorXd unit = Eigen::VectorXd::Unit(system.nq(), j);
  bool is_led_everywhere = true;
  in_blocks(states, 1, [&](Eigen::Index, const Eigen::Ref<const Eigen::MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, system.parameter_values());
    for (int i = 0; is_led_everywhere && i < values.n_states(); ++i) {
      constexpr double rounding = 1e-9;
      const Eigen::MatrixXd rows = values.A(i).transpose();
      is_led_everywhere = rows.allFinite() && (rows * least_squares(rows, unit) - unit).norm() < rounding;
    }
  });
  return is_led_everywhere;
}

// Columns that do not vary, and rows that repeat others.
void check_channels(const WholeLog& log, const System& system, std::vector<Finding>& findings) {
  const std::vector<std::string> accelerations = system.acceleration_names();
  const StateLayout layout = system.layout();
  const auto is_stuck = [](const Eigen::RowVectorXd& row) {
    std::vector<double> measured;
    std::copy_if(row.begin(), row.end(), std::back_inserter(measured), [](double one) { return !std::isnan(one); });
    return measured.size() > 4 &&
           std::all_of(measured.begin(), measured.end(), [&](double one) { return one == measured.front(); });
  };
  for (int j = 0; j < system.nq(); ++j) {
    const std::string velocity = system.coordinates()[static_cast<std::size_t>(j)].velocity();
    const auto q = log.states.row(layout.q(j));
    const bool moves = !q.hasNaN() && !is_stuck(q);
    const auto add = [&](const std::string& name) {
      findings.push_back(
          {Level::warning, fmt::format("{} is the same in every row, while the system moves: a channel that is stuck?", name)});
    };
    const bool has_constant_velocity = is_stuck(log.states.row(layout.dq(j)));
    if (has_constant_velocity && moves && !is_led(system, log.states, j)) add(velocity);
    if (!has_constant_velocity && is_stuck(log.accelerations.row(j)) && !is_led(system, log.states, j))
      add(accelerations[static_cast<std::size_t>(j)]);
    if (is_stuck(q) && !log.states.row(layout.dq(j)).hasNaN() && !is_stuck(log.states.row(layout.dq(j))))
      add(system.coordinates()[static_cast<std::size_t>(j)].name);
  }
  for (std::string& text : stuck_channels(system, log.states, log.accelerations))
    findings.push_back({Level::warning, std::move(text)});
  const int n_repeated = n_repeated_rows({{log.states, log.accelerations}});
  if (n_repeated * 20 > log.states.cols()) {
    findings.push_back(
        {Level::warning, fmt::format("{} of {} rows repeat another one to twelve digits: they are not independent measurements, "
                                     "and standard deviations will be too small; keep each once",
                                     n_repeated, log.states.cols())});
  }
}

// Whether a constraint of positions that the log obeys counts the turns of coordinate j in rad, as that of a rack and pinion does: it
// is linear in it, and the log would not obey it with angles of another unit.
bool counts_turns(const System& system, const Eigen::MatrixXd& states, int j) {
  const auto residuals_after = [&](double radians) {
    Eigen::MatrixXd turned = states;
    turned.row(system.layout().q(j)).array() += radians;
    return system.residuals(turned, system.parameter_values());
  };
  Eigen::MatrixXd scaled = states;
  for (int i = 0; i < system.nq(); ++i) {
    if (system.coordinates()[static_cast<std::size_t>(i)].angle) scaled.row(system.layout().q(i)) *= std::numbers::pi / 180;
  }
  const Eigen::MatrixXd of_scaled = system.residuals(scaled, system.parameter_values());
  const Eigen::MatrixXd here = residuals_after(0), once = residuals_after(1) - here, twice = residuals_after(2) - here;
  for (std::size_t k = 0; k < system.residual_labels().size(); ++k) {
    constexpr double rounding = 1e-6;
    const auto c = here.row(static_cast<Eigen::Index>(k)).array(), slope = once.row(static_cast<Eigen::Index>(k)).array();
    const auto bend = twice.row(static_cast<Eigen::Index>(k)).array() - 2 * slope;
    if (system.residual_labels()[k].velocity) continue;
    const auto other = of_scaled.row(static_cast<Eigen::Index>(k)).array();
    if ((bend.abs() < rounding * slope.abs() && c.abs() < slope.abs()).all() && !(other.abs() < slope.abs()).all()) return true;
  }
  return false;
}

// An angle that turns forth and back by more than half a turn from row to row, as one in degrees does; a wheel turns one way.
void check_turns(const WholeLog& log, const System& system, int j, std::vector<Finding>& findings) {
  constexpr double often = 0.2;  // of the rows
  const StateLayout layout = system.layout();
  const auto t = log.states.row(layout.t()), q = log.states.row(layout.q(j)), dq = log.states.row(layout.dq(j));
  const Eigen::Index n = t.size() - 1;
  if (!q.hasNaN() && q.maxCoeff() - q.minCoeff() < std::numbers::pi) return;  // its velocity, or t, is in another unit
  Eigen::Index forth = 0, back = 0;
  for (Eigen::Index i = 0; i < n; ++i) {
    const double turned = std::max(0.0, t[i + 1] - t[i]) * dq[i];  // NaN where t is not known
    if (std::abs(q[i + 1] - q[i]) < std::numbers::pi) continue;    // t is in another unit than the velocity's
    forth += turned > std::numbers::pi ? 1 : 0;
    back += turned < -std::numbers::pi ? 1 : 0;
  }
  if (forth == 0 || back == 0 || static_cast<double>(forth + back) < often * static_cast<double>(n)) return;
  if (counts_turns(system, log.states, j)) return;
  findings.push_back(
      {Level::warning, fmt::format("{} moves by more than half a turn from row to row, back and forth, at {} of {} rows{}: is it "
                                   "in rad, and sampled often enough?",
                                   system.coordinates()[static_cast<std::size_t>(j)].name, forth + back, n,
                                   q.hasNaN() ? "" : fmt::format(", over a range of {:.3g}", q.maxCoeff() - q.minCoeff()))});
}

// Columns that look clipped, inputs with single values that cannot be, and angles in degrees.
void check_values(const WholeLog& log, const System& system, std::vector<Finding>& findings) {
  const StateLayout layout = system.layout();
  const auto add = [&](Level level, const std::string& name, const Eigen::RowVectorXd& values, const char* meaning) {
    if (auto text = pile_up_text(name, values, meaning)) findings.push_back({level, *std::move(text)});
  };
  for (int k = 0; k < layout.nu; ++k) {
    const std::string& name = system.inputs()[static_cast<std::size_t>(k)];
    const std::vector<Eigen::RowVectorXd> u(1, log.states.row(layout.u(k)));
    add(Level::good, name, u.front(), "clipped? The log must contain the acting input");
    if (std::optional<std::string> far = far_values_text(name, u)) findings.push_back({Level::warning, *std::move(far)});
  }
  const std::vector<std::string> accelerations = system.acceleration_names();
  for (int j = 0; j < system.nq(); ++j) {
    add(Level::warning, accelerations[static_cast<std::size_t>(j)], log.accelerations.row(j),
        "a sensor at the end of its range?");
    const Coordinate& coordinate = system.coordinates()[static_cast<std::size_t>(j)];
    if (auto text = clipped_velocity(coordinate.velocity(), log.states.row(layout.dq(j)), log.accelerations.row(j)))
      findings.push_back({Level::warning, *std::move(text)});
    const auto q = log.states.row(layout.q(j));
    if (!coordinate.angle) continue;
    if (!is_wrapped_in_degrees({q.begin(), q.end()})) {
      check_turns(log, system, j, findings);
      continue;
    }
    findings.push_back({Level::error, fmt::format("{} jumps by 360 from row to row: it is in degrees, but angles must be in rad",
                                                  coordinate.name)});
  }
}

void check_log(const Model& model, const CsvTable& table, const CheckOptions& options, std::vector<Finding>& findings) {
  const System& system = *model.system;
  LogReader reader = open_log(model, table, options.columns);
  const WholeLog log = read_whole_log(model, reader);
  check_columns_of(table, reader, log, system, findings);
  check_channels(log, system, findings);
  const std::string rest = text_of_rest(model, system.parameter_values(), log.states, log.accelerations);
  if (!rest.empty()) findings.push_back({Level::warning, rest});
  check_values(log, system, findings);
  double unit_of_time = 1;
  for (std::string& text : wrong_rates(system, log.states, log.accelerations, log.reads_time, &unit_of_time))
    findings.push_back({Level::warning, std::move(text)});
  for (std::string& text : single_wrong_values(system, log.states, log.accelerations, unit_of_time))
    findings.push_back({Level::warning, std::move(text)});
  const std::vector<bool> all_read(static_cast<std::size_t>(system.layout().size()), true);
  if (std::optional<std::string> text = text_of_late_inputs(system, all_read, model.actuators, unit_of_time)) {
    findings.push_back({Level::warning, *std::move(text)});
  } else if (unit_of_time != 1) {
    findings.push_back(
        {Level::warning,
         fmt::format("the rates of the coordinates say that t counts {:g} s, not seconds: a fit does not mind, but "
                     "motions over t would be too slow; convert it",
                     unit_of_time)});
  }
  check_mechanics(model, log.states, findings);
  if (has_error(findings)) return;
  append(findings, check_data(system, log.states, system.parameter_values(), log.accelerations, log.stddev, log.stated,
                              model.noise.estimate));
  append(findings, check_states(system, log.states, system.parameter_values()));
}

}  // namespace

std::vector<Option> options(CheckOptions& options) {
  return {columns_option(options.columns, "columns by other names; theta1=q3 also maps dtheta1 and ddtheta1")};
}

std::vector<Finding> check(const Model& model, const CsvTable* log, const CheckOptions& options) {
  if (log == nullptr && !options.columns.empty())
    throw InputError("`map` renames columns of a log, and there is none: give `data`, or leave `map` out");
  std::vector<Finding> findings;
  check_model(model, findings);
  if (log != nullptr) {
    check_log(model, *log, options, findings);
  } else if ((!model.sampling.empty() || model.motion) && !model.truth.empty()) {
    check_mechanics(model, generate(model, {100, 1, Eigen::VectorXd::Zero(model.system->nq())}).states, findings);
  } else {
    findings.push_back(
        {Level::warning, "no `data`, and the model has no [truth] with [sampling] or [motion]: there are no states to check"});
  }
  return findings;
}

}  // namespace gp2
