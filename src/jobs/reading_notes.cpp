#include "jobs/reading_notes.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>
#include <set>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/simulate.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/rate_check.hpp"
#include "jobs/series_checks.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// Whether a constraint reads parameters that a fit is to estimate.
bool reads_estimates(const System& system, const VectorXd& state, const VectorXd& parameters, const std::string& constraint,
                     const FitProblemOptions& options) {
  VectorXd others = parameters;
  for (Index k = 0; k < others.size(); ++k) {
    const Parameter& one = system.parameters()[static_cast<std::size_t>(k)];
    const bool is_estimated = options.estimate ? std::ranges::count(*options.estimate, one.name) > 0 : one.estimate;
    if (is_estimated) others[k] += 1e-3 * (1 + std::abs(others[k]));
  }
  const VectorXd change = system.residuals(state, others) - system.residuals(state, parameters);
  for (std::size_t k = 0; k < system.residual_labels().size(); ++k) {
    if (system.residual_labels()[k].text == constraint && change[static_cast<Index>(k)] != 0) return true;
  }
  return false;
}

// σ of every acceleration where it is known before the fit (nq × N)
MatrixXd known_noise(const LoggedSystem& logged, const Readings& readings, const FitProblemOptions& options) {
  const Model::Noise& noise = logged.model.noise;
  MatrixXd stddev = MatrixXd::Constant(logged.system().nq(), readings.states.cols(), not_a_number);
  if (options.estimate_noise) return stddev;
  for (Index j = 0; j < stddev.rows(); ++j) {
    if (options.noise_stddev) {
      stddev.row(j).setConstant(*options.noise_stddev);
    } else if (!noise.estimate && !noise.stddev.empty()) {
      stddev.row(j).setConstant(noise.stddev[static_cast<std::size_t>(j)]);
    }
  }
  for (Index k = 0; k < readings.view.size() && readings.states_noise(); ++k) {
    if (readings.states_noise(k)) stddev.row(readings.view.rows[static_cast<std::size_t>(k)]) = readings.stated_stddev.row(k);
  }
  return stddev;
}

// What a log measures of a motion, of which a fit need not read all.
struct LoggedMotion {
  MatrixXd states, accelerations;
};

// Nothing without a time, or if columns hold other things than numbers, which a fit that does not read them accepts.
std::optional<LoggedMotion> read_motion(const System& system, const CsvTable& log,
                                        const std::map<std::string, std::string>& columns) {
  LogReader reader(log, system, columns);
  if (!reader.has("t")) return std::nullopt;
  const std::vector<std::string> names = system.state_names();
  std::vector<bool> reads(names.size());
  for (std::size_t k = 0; k < names.size(); ++k) reads[k] = reader.has(names[k]);
  try {
    LoggedMotion motion{reader.states_with_gaps(reads), {}};
    motion.accelerations = MatrixXd::Constant(system.nq(), motion.states.cols(), not_a_number);
    Index row = 0;
    for (const std::string& name : system.acceleration_names()) {
      if (has_values(reader, name)) motion.accelerations.row(row) = reader.measurements({name});
      ++row;
    }
    return motion;
  } catch (const InputError&) {
    return std::nullopt;
  }
}

// Stretches of eight values or more that are the same, of a column that else changes from row to row; none of one that is held or coarsely
// rounded, or the same in most rows.
std::vector<EqualRun> still_stretches(const Eigen::RowVectorXd& values) {
  constexpr std::size_t fewest = 8;
  constexpr double rarely = 0.02, most = 0.5;
  const std::vector<EqualRun> runs = equal_runs({values.begin(), values.end()});
  std::vector<EqualRun> still;
  std::size_t n_still = 0, n_other = 0, n_equal = 0;  // values in still stretches, others, and those equal to the one before
  for (const EqualRun& run : runs) {
    if (run.n >= fewest) {
      still.push_back(run);
      n_still += run.n;
    } else {
      n_other += run.n;
      n_equal += run.n - 1;
    }
  }
  const auto share = static_cast<double>(n_still) / static_cast<double>(n_still + n_other);
  if (still.empty() || share > most || static_cast<double>(n_equal) > rarely * static_cast<double>(n_other)) return {};
  return still;
}

// Whether a value moves on from that of a stretch's first row otherwise than a rate says that is the same in it, or, where the value is,
// than its rate says: by more than a tenth of how far the usual rate would take it. Columns that are not known contradict nothing.
bool contradicts_rate(const Eigen::RowVectorXd& t, const Eigen::RowVectorXd& value, const Eigen::RowVectorXd& rate, bool is_angle,
                      const EqualRun& run) {
  constexpr double small = 0.1;
  const auto first = static_cast<Index>(run.first), n = static_cast<Index>(run.n);
  const auto is_known = rate.array().isFinite();
  const double n_known = static_cast<double>(is_known.count());
  const double mean = is_known.select(rate, 0).sum() / n_known;
  const double usual = std::sqrt(is_known.select(rate.array() - mean, 0).square().sum() / n_known);
  // how much farther the value moves to row i than its rate says
  const auto beyond_rate = [&](Index i) {
    const double difference = value[i] - value[i - 1];
    const double moved = is_angle ? std::remainder(difference, 2 * std::numbers::pi) : difference;
    return moved - (t[i] - t[i - 1]) * (rate[i] + rate[i - 1]) / 2;
  };
  std::vector<double> offsets;  // a rate that is too large throughout is told elsewhere
  for (Index i = 1; i < t.size(); ++i) {
    const double by = beyond_rate(i), step = t[i] - t[i - 1];
    if (std::isfinite(by) && step > 0) offsets.push_back(by / step);
  }
  const double offset = offsets.empty() ? 0 : median(std::move(offsets));
  double apart = 0, largest = 0;
  for (Index i = first + 1; i < first + n; ++i) {
    const double step = t[i] - t[i - 1];
    if (!(step > 0)) return false;
    apart += beyond_rate(i) - step * offset;
    largest = std::max(largest, std::isnan(apart) ? 0 : std::abs(apart));
  }
  return largest > small * usual * (t[first + n - 1] - t[first]);
}

// What a person should know of a column that is the same in a stretch; nothing where there is none.
std::optional<std::string> stuck_text(const std::string& name, const std::optional<EqualRun>& run) {
  if (!run) return std::nullopt;
  return fmt::format("{} is the same in data rows {} to {}, while the system moves: was its channel stuck? Leave these rows out",
                     name, run->first + 1, run->first + run->n);
}

// Whether velocities of a stretch are more than a tenth of their usual size.
bool moves_in(const System& system, const MatrixXd& states, const EqualRun& run) {
  constexpr double small = 0.1;
  const StateLayout layout = system.layout();
  for (int j = 0; j < layout.nq; ++j) {
    const Eigen::RowVectorXd dq = states.row(layout.dq(j)).array().isNaN().select(0, states.row(layout.dq(j)));
    const auto of_run = dq.segment(static_cast<Index>(run.first), static_cast<Index>(run.n));
    const auto rms = [](const auto& of) { return std::sqrt(of.squaredNorm() / static_cast<double>(of.size())); };
    if (rms(of_run) > small * rms(dq)) return true;
  }
  return false;
}

// Whether an input comes to a stretch in which it is the same by a usual step, and leaves it by a large one: what was held went on
// meanwhile. An input that dwells, or is set, does neither within a motion.
bool was_held(const Eigen::RowVectorXd& t, const Eigen::RowVectorXd& u, const EqualRun& run) {
  constexpr double large = 1.5, long_step = 1.5;  // times what nine of ten steps are below; times the usual step of time
  const auto first = static_cast<Index>(run.first), end = first + static_cast<Index>(run.n);
  if (first < 1 || end >= u.size()) return false;
  std::vector<double> steps;
  for (Index i = 1; i < u.size(); ++i) {
    const double step = std::abs(u[i] - u[i - 1]);
    if (step > 0 && i != end) steps.push_back(step);
  }
  if (steps.empty()) return false;
  const double longest = long_step * usual_step(t.transpose());
  const auto goes_on = [&](Index i) { return t[i] > t[i - 1] && t[i] - t[i - 1] < longest; };
  std::ranges::sort(steps);
  const double usual = steps[steps.size() * 9 / 10];
  return goes_on(first) && goes_on(end) && std::abs(u[first] - u[first - 1]) <= large * usual &&
         std::abs(u[end] - u[end - 1]) > large * usual;
}

}  // namespace

std::vector<std::string> stuck_channels(const System& system, const MatrixXd& states, const MatrixXd& accelerations) {
  const StateLayout layout = system.layout();
  const Eigen::RowVectorXd t = states.row(layout.t());
  const std::vector<std::string> acceleration_names = system.acceleration_names();
  std::vector<std::string> texts;
  for (int j = 0; j < layout.nq; ++j) {
    const Coordinate& coordinate = system.coordinates()[static_cast<std::size_t>(j)];
    const Eigen::RowVectorXd q = states.row(layout.q(j)), dq = states.row(layout.dq(j)), ddq = accelerations.row(j);
    const auto add = [&](const std::string& name, const Eigen::RowVectorXd& channel, const auto& contradicts) {
      const std::vector<EqualRun> still = still_stretches(channel);
      const auto found = std::ranges::find_if(still, contradicts);
      if (auto text = stuck_text(name, found == still.end() ? std::nullopt : std::optional(*found)))
        texts.push_back(*std::move(text));
    };
    const auto q_contradicts = [&](const EqualRun& run) { return contradicts_rate(t, q, dq, coordinate.angle, run); };
    const auto dq_contradicts = [&](const EqualRun& run) { return contradicts_rate(t, dq, ddq, false, run); };
    const bool has_position = !q.hasNaN();
    add(coordinate.name, q, q_contradicts);
    add(coordinate.velocity(), dq, [&](const EqualRun& run) { return has_position ? q_contradicts(run) : dq_contradicts(run); });
    add(acceleration_names[static_cast<std::size_t>(j)], ddq, dq_contradicts);
  }
  for (int k = 0; k < layout.nu; ++k) {
    const Eigen::RowVectorXd u = states.row(layout.u(k));
    const std::vector<EqualRun> still = still_stretches(u);
    // of several any may be held
    if (still.size() != 1) continue;
    const double value = u[static_cast<Index>(still.front().first)];
    const Eigen::RowVectorXd known = u.array().isNaN().select(value, u);
    if (value == 0 || value == known.maxCoeff() || value == known.minCoeff() || !was_held(t, u, still.front()) ||
        !moves_in(system, states, still.front()))
      continue;
    if (auto text = stuck_text(system.inputs()[static_cast<std::size_t>(k)], still.front())) texts.push_back(*std::move(text));
  }
  return texts;
}

void note_violation(const System& system, const MatrixXd& states, const VectorXd& parameters, const std::string& log,
                    std::vector<std::string>& notes, const FitProblemOptions* fit) {
  const auto violation = largest_violation(system, states, parameters);
  if (!violation || violation->relative <= large_constraint_violation) return;
  if (fit != nullptr && reads_estimates(system, states.col(violation->state), parameters, violation->constraint, *fit)) return;
  notes.push_back(
      fmt::format("warning: {}: states are off the constraint: '{}' is {:.3g} at data row {}, {:.1e} of its scale; see gp2 check",
                  log, violation->constraint, violation->value, violation->state + 1, violation->relative));
}

void require_mechanics_at(const LoggedSystem& logged, const View& view, const MatrixXd& states, const std::vector<int>& rows,
                          const std::string& log, std::vector<std::string>& notes) {
  const auto data_row = [&](int state) { return rows[static_cast<std::size_t>(state)] + 1; };
  std::vector<StateRank> ranks(rows.size());
  const auto fault =
      for_each_mechanics(logged.prior, view, states, logged.parameters, [&](Index first, const MechanicsBatch& block) {
        const std::vector<StateRank> here = ranks_of(logged.system(), block);
        std::copy(here.begin(), here.end(), ranks.begin() + first);
      });
  if (fault) {
    const bool is_of_model = logged.other || logged.parameters == logged.system().parameter_values();
    throw InputError(fmt::format("{}: data row {}: {} ('{}' with the {} parameters; see gp2 check)", log, data_row(fault->state),
                                 fault->text, logged.system().name(), is_of_model ? "model's" : "fit's"));
  }
  const LowerRank lower = states_of_lower_rank(ranks);
  if (lower.states.empty()) return;
  notes.push_back(
      fmt::format("warning: {}: the constraints have rank {} but at {} of {} rows, where it is as low as {}, first at "
                  "data row {}; see gp2 check",
                  log, lower.usual, lower.states.size(), rows.size(), lower.lowest, data_row(lower.states.front())));
}

void note_dependence(const LoggedSystem& logged, const Readings& readings, const FitProblemOptions& options,
                     const MatrixXd& accelerations, const std::string& log, std::vector<std::string>& notes) {
  if (accelerations.size() == 0) return;
  const std::vector<std::string> every = logged.system().acceleration_names();
  const auto independent = dependent_columns(logged.system(), readings.states, logged.parameters, accelerations,
                                             known_noise(logged, readings, options));
  if (!independent || (!readings.values.array().isNaN()).colwise().count().maxCoeff() <= std::ssize(*independent)) return;
  std::vector<std::string> names;
  for (int row : *independent) names.push_back(every[static_cast<std::size_t>(row)]);
  notes.push_back(
      fmt::format("warning: {}: the accelerations satisfy A ddq = b, or part of it, far more closely than noise allows: they are "
                  "not {} independent measurements but {}; observe independent ones only, say `observe={}`",
                  log, every.size(), independent->size(), fmt::join(names, ",")));
}

std::string text_of_rest(const Model& model, const VectorXd& parameters, const MatrixXd& states, const MatrixXd& values) {
  const SwitchingFunctions surfaces = switching_functions(model, /*of_latents=*/true);
  if (surfaces.size() == 0) return {};
  const StateLayout layout = model.system->layout();
  const VectorXd small = row_size(values) / 4;
  const auto is_or_unknown = [](double value, double wanted) { return value == wanted || std::isnan(value); };
  const auto rests = [&](Index i) {
    const auto dq = states.col(i).segment(layout.dq(0), layout.nq);
    return std::all_of(dq.begin(), dq.end(), [&](double one) { return is_or_unknown(one, 0); }) &&
           !(values.col(i).array().abs() > small.array()).any();
  };
  const auto stays = [&](Index i, Index next) {
    if (next < 0 || next >= states.cols() || !rests(next)) return false;
    for (Index k = 0; k < layout.nq; ++k) {
      if (!is_or_unknown(states(k, next), states(k, i)) && !std::isnan(states(k, i))) return false;
    }
    return true;
  };
  int n = 0;
  std::set<std::string> names;
  VectorXd g;
  MatrixXd gradients;
  for (Index i = 0; i < states.cols(); ++i) {
    if (!rests(i) || !(stays(i, i - 1) || stays(i, i + 1))) continue;
    surfaces.evaluate(states.col(i), parameters, g, gradients);
    bool is_held = false;
    for (std::size_t k = 0; k < surfaces.names().size(); ++k) {
      const int first = surfaces.first()[k];
      if (!g.segment(first, surfaces.first()[k + 1] - first).isZero(0)) continue;
      names.insert(surfaces.names()[k]);
      is_held = true;
    }
    n += is_held ? 1 : 0;
  }
  if (n * 20 <= states.cols()) return {};
  return fmt::format(
      "{} of {} rows are at rest where dry friction jumps, at {} = 0: the friction force there is no function of the state; "
      "leave them out",
      n, states.cols(), fmt::join(names, "; "));
}

void note_rest(const Model& model, const VectorXd& parameters, const MatrixXd& states, const MatrixXd& values,
               const std::string& log, std::vector<std::string>& notes) {
  const std::string text = text_of_rest(model, parameters, states, values);
  if (!text.empty()) notes.push_back(fmt::format("warning: {}: {}", log, text));
}

std::optional<std::string> text_of_late_inputs(const System& system, const std::vector<bool>& reads,
                                               const std::vector<Actuator>& actuators, double unit_of_time) {
  std::vector<std::string> names;
  for (std::size_t k = 0; k < actuators.size(); ++k) {
    if (!reads[static_cast<std::size_t>(system.layout().u(static_cast<int>(k)))]) continue;
    for (const Parameter* const one : {&actuators[k].delay, &actuators[k].lag}) {
      if (one->value != 0 || one->estimate) names.push_back(one->name);
    }
  }
  if (unit_of_time == 1 || names.empty()) return std::nullopt;
  return fmt::format(
      "the rates of the coordinates say that t counts {:g} s, while delays and lags of inputs are in seconds ({}): "
      "inputs act at a wrong time; convert t",
      unit_of_time, fmt::join(names, ", "));
}

std::vector<std::string> note_late_inputs(const Prior& prior, const CsvTable& log,
                                          const std::map<std::string, std::string>& columns,
                                          const std::vector<Actuator>& actuators, std::vector<std::string>& notes, double* unit) {
  const System& system = *prior.system;
  const std::optional<LoggedMotion> motion = read_motion(system, log, columns);
  if (!motion) return {};
  const std::vector<bool> reads = prior.reads();
  double unit_of_time = 1;
  std::vector<std::string> wrong = wrong_rates(system, motion->states, motion->accelerations,
                                               reads[static_cast<std::size_t>(system.layout().t())], &unit_of_time);
  if (const auto text = text_of_late_inputs(system, reads, actuators, unit_of_time))
    notes.push_back(fmt::format("warning: {}: {}", log.name(), *text));
  if (unit != nullptr) *unit = unit_of_time;
  return wrong;
}

bool note_channels(const Prior& prior, const CsvTable& log, const std::map<std::string, std::string>& columns,
                   const std::vector<Actuator>& actuators, std::vector<std::string>& notes) {
  const auto warn = [&](const std::vector<std::string>& texts) {
    for (const std::string& text : texts) notes.push_back(fmt::format("warning: {}: {}", log.name(), text));
  };
  const std::size_t n_before = notes.size();
  double unit_of_time = 1;
  warn(note_late_inputs(prior, log, columns, actuators, notes, &unit_of_time));
  const bool is_wrong = notes.size() > n_before;
  if (const auto motion = read_motion(*prior.system, log, columns)) {
    warn(single_wrong_values(*prior.system, motion->states, motion->accelerations, unit_of_time));
    warn(stuck_channels(*prior.system, motion->states, motion->accelerations));
  }
  return is_wrong;
}

std::vector<std::string> shared_load_texts(const Model& model, const System& system, const MechanicsBatch& mechanics) {
  constexpr double rounding = 1e-6;
  std::set<std::string> read;
  for (const LatentSpec& latent : model.latents) {
    const auto add = [&](const std::string& text) {
      for (const std::string& variable : model.graph->variables_of(model.expression(text))) read.insert(variable);
    };
    if (!latent.feature_code) std::for_each(latent.features.begin(), latent.features.end(), add);
    if (latent.direction_code) continue;
    for (const std::vector<std::string>& row : latent.directions) std::for_each(row.begin(), row.end(), add);
  }
  std::vector<bool> is_shared(static_cast<std::size_t>(system.nc()), false);
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const auto A = mechanics.values.A(i);
    // the identity of independent rows
    const MatrixXd shares = mechanics.projections[static_cast<std::size_t>(i)].multipliers_of_force() * A.transpose();
    for (int row = 0; row < system.nc(); ++row)
      if (!A.row(row).isZero(0) && shares(row, row) < 1 - rounding) is_shared[static_cast<std::size_t>(row)] = true;
  }
  std::vector<std::string> warnings;
  for (int row = 0; row < system.nc(); ++row) {
    for (const char* name : {"lambda0", "lambda"}) {
      const std::string variable = fmt::format("{}({})", name, row + 1);
      if (!is_shared[static_cast<std::size_t>(row)] || !read.contains(variable)) continue;
      warnings.push_back(fmt::format(
          "{}: the constraint '{}' follows from others, so that its share of the load is undetermined: remove redundant rows",
          variable, system.constraint_labels()[static_cast<std::size_t>(row)]));
    }
  }
  return warnings;
}

void note_shared_loads(const LoggedSystem& logged, const MatrixXd& states, const std::string& log,
                       std::vector<std::string>& notes) {
  constexpr Index enough = 300;
  if (logged.system().nc() < 2 || logged.model.graph == nullptr || states.cols() == 0) return;
  std::vector<Index> some;
  for (Index i = 0; i < states.cols(); i += std::max<Index>(1, states.cols() / enough)) some.push_back(i);
  MechanicsBatch mechanics;
  evaluate_mechanics(logged.prior, View::constrained_acceleration(logged.system()), states(Eigen::all, some), logged.parameters,
                     mechanics);
  if (mechanics.fault) return;
  for (const std::string& text : shared_load_texts(logged.model, logged.system(), mechanics))
    notes.push_back(fmt::format("warning: {}: {}", log, text));
}

}  // namespace gp2
