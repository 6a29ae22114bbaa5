#include "jobs/read_observations.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/random.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/projected_states.hpp"
#include "inference/inverse_dynamics.hpp"
#include "jobs/observation_noise.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::map<std::string, std::string> columns_of(const Model& model, std::map<std::string, std::string> columns) {
  columns.insert(model.columns.begin(), model.columns.end());
  return columns;
}

}  // namespace

bool is_empty_column(const CsvTable& log, int column) {
  for (int row = 0; row < log.n_rows(); ++row) {
    if (!log.is_empty(row, column)) return false;
  }
  return true;
}

namespace {

// Whether a log has a column for this, with something in it.
bool has_values(LogReader& reader, const CsvTable& log, const std::string& name) {
  const int column = reader.column(name);
  return column >= 0 && !is_empty_column(log, column);
}

void note_reading(const LogReader& reader, const CsvTable& log, std::vector<std::string>& notes) {
  std::ranges::move(reader.notes(), std::back_inserter(notes));
  std::vector<std::string> unused = reader.unused_columns();
  // an empty one may be needed where it has values
  std::erase_if(unused, [&](const std::string& name) { return is_empty_column(log, log.find(name)); });
  if (!unused.empty()) notes.push_back(fmt::format("{}: columns not needed: {}", log.name(), fmt::join(unused, ", ")));
}

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

// @param fit  the options of the fit that the log is read for: values of parameters that it estimates are not known yet; null: none
void note_violation(const System& system, const MatrixXd& states, const VectorXd& parameters, const CsvTable& log,
                    std::vector<std::string>& notes, const FitProblemOptions* fit = nullptr) {
  const auto violation = largest_violation(system, states, parameters);
  if (!violation || violation->relative <= large_constraint_violation) return;
  if (fit != nullptr && reads_estimates(system, states.col(violation->state), parameters, violation->constraint, *fit)) return;
  notes.push_back(
      fmt::format("warning: {}: states are off the constraint: '{}' is {:.3g} at data row {}, {:.1e} of its scale; see gp2 check",
                  log.name(), violation->constraint, violation->value, violation->state + 1, violation->relative));
}

// The states, of the columns that a prior and a view need, and of those that only tell whether a state or a prediction is on the
// constraint where the log has them.
/// @param needs_residuals  whether what the constraints' residuals read is needed too
MatrixXd states_of(const Prior& prior, const View& view, LogReader& reader, bool needs_residuals = false) {
  std::vector<bool> reads = prior.reads();
  const std::vector<bool> of_view = view.reads(*prior.system);
  std::vector<bool> judged = prior.reference_system().reads(SystemPart::residuals);
  if (prior.reference) {
    const std::vector<bool> constraints = prior.reference->reads(SystemPart::mechanics);
    for (std::size_t k = 0; k < judged.size(); ++k) judged[k] = judged[k] || constraints[k];
  }
  const std::vector<std::string> names = prior.system->state_names();
  for (std::size_t k = 0; k < reads.size(); ++k) {
    reads[k] = reads[k] || of_view[k] || (judged[k] && (needs_residuals || reader.has(names[k])));
  }
  return reader.states(reads);
}

double reach_of(const CommandedRows& rows) {
  double reach = 0;
  for (const int k : rows.record->inputs()) reach = std::max(reach, rows.actuators[static_cast<std::size_t>(k)].reach());
  return reach;
}

// Whether what acts is known at a row, not resting on commands before the log.
bool is_known(const CommandedRows& rows, std::size_t row) { return rows.record->knows(rows.places[row], reach_of(rows)); }

std::string unknown_text(const CsvTable& log, std::size_t n, const char* consequence) {
  return fmt::format("{}: {} of {} rows {}: what acts there depends on commands before the log", log.name(), n, log.n_rows(),
                     consequence);
}

// The rows at which what acts is known.
void keep_known(const std::optional<CommandedRows>& commanded, const CsvTable& log, std::vector<int>& rows,
                std::vector<std::string>& notes) {
  if (!commanded) return;
  const std::size_t n = std::erase_if(rows, [&](int row) { return !is_known(*commanded, static_cast<std::size_t>(row)); });
  if (n == 0) return;
  if (rows.empty()) {
    throw InputError(
        fmt::format("{}: the acting inputs are not known at any row: they all depend on commands before the log; give the whole "
                    "log as `commands`, a longer one, or narrower bounds of delays and lags",
                    log.name()));
  }
  notes.push_back(unknown_text(log, n, "left out"));
}

// Of chosen rows; only what is estimated need be known any more.
std::optional<CommandedRows> of_rows(std::optional<CommandedRows> commanded, const std::vector<int>& rows) {
  const auto is_estimated = [](const Actuator& actuator) { return actuator.is_estimated(); };
  if (!commanded || std::ranges::none_of(commanded->actuators, is_estimated)) return std::nullopt;
  std::vector<CommandRecord::Place> places;
  for (const int row : rows) places.push_back(commanded->places[static_cast<std::size_t>(row)]);
  commanded->places = std::move(places);
  return commanded;
}

std::vector<int> all_rows(Index n) {
  std::vector<int> numbers(static_cast<std::size_t>(n));
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

// n of `rows`, chosen at random; all when n is no less
std::vector<int> chosen_rows(const std::vector<int>& rows, int n, std::uint64_t seed) {
  const int size = static_cast<int>(rows.size());
  if (n >= size) return rows;
  std::vector<int> chosen;
  for (const int k : RandomStream(seed).permutation(size)) chosen.push_back(rows[static_cast<std::size_t>(k)]);
  chosen.resize(static_cast<std::size_t>(n));
  std::ranges::sort(chosen);
  return chosen;
}

// Rows of a shuffled log in the order of its time, which tells whether they share their errors. Episodes stay together. Where time is
// a part of the state, rows may well be drawn at any time.
std::vector<int> in_order_of_time(std::vector<int> rows, const Prior& prior, const CsvTable& log,
                                  const std::map<std::string, std::string>& columns) {
  LogReader reader(log, *prior.system, columns);
  if (!reader.has("t") || prior.reads()[static_cast<std::size_t>(prior.system->layout().t())]) return rows;
  VectorXd times;
  try {
    times = reader.values({"t"}).row(0).transpose();
  } catch (const InputError&) {
    return rows;  // not numbers: a fit that does not read them accepts that
  }
  const int episode_column = reader.episode_column();
  struct Episode {
    std::size_t number;
    double time;  // of its last row
  };
  std::map<std::string, Episode> episodes;
  std::vector<std::size_t> episode_of(static_cast<std::size_t>(log.n_rows()));
  std::size_t n_falls = 0;
  for (const int row : rows) {
    const std::string name = episode_column < 0 ? "" : log.cell(row, episode_column);
    const auto [found, is_new] = episodes.emplace(name, Episode{episodes.size(), times[row]});
    if (times[row] < found->second.time) ++n_falls;
    found->second.time = times[row];
    episode_of[static_cast<std::size_t>(row)] = found->second.number;
  }
  // in a log of several runs without a column for them time falls once per run
  if (n_falls * 10 <= rows.size()) return rows;
  std::ranges::stable_sort(rows, {}, [&](int row) { return std::pair(episode_of[static_cast<std::size_t>(row)], times[row]); });
  return rows;
}

// The rows of a log with something measured. Values without a stated deviation where others of the column have one count as
// not measured.
std::vector<int> measured_rows(Readings& readings, const std::vector<std::string>& names, const CsvTable& log,
                               std::vector<std::string>& notes) {
  MatrixXd& values = readings.values;
  std::vector<std::string> missing;
  for (Index k = 0; k < values.rows(); ++k) {
    Index n_without = 0;
    if (readings.states_noise(k)) {
      for (Index i = 0; i < values.cols(); ++i) {
        if (std::isnan(values(k, i)) || !std::isnan(readings.stated_stddev(k, i))) continue;
        values(k, i) = not_a_number;
        ++n_without;
      }
    }
    const Index n = values.row(k).array().isNaN().count();
    if (n == 0) continue;
    missing.push_back(fmt::format("{} of {} of {}{}", n, log.n_rows(), names[static_cast<std::size_t>(k)],
                                  n_without > 0 ? fmt::format(" ({} without a standard deviation)", n_without) : ""));
  }
  if (missing.empty()) return all_rows(log.n_rows());
  notes.push_back(fmt::format("{}: values not measured (empty cells): {}", log.name(), fmt::join(missing, ", ")));
  std::vector<int> rows;
  for (int i = 0; i < log.n_rows(); ++i) {
    if (!values.col(i).array().isNaN().all()) rows.push_back(i);
  }
  if (rows.empty()) {
    throw InputError(fmt::format("{}: no row has a value and, where the log has a column for it, its standard deviation: {}",
                                 log.name(), fmt::join(missing, ", ")));
  }
  const std::size_t n_left_out = static_cast<std::size_t>(log.n_rows()) - rows.size();
  if (n_left_out > 0) notes.push_back(fmt::format("{}: {} rows left out: they have no measured value", log.name(), n_left_out));
  return rows;
}

std::vector<int> lines_of(const std::vector<int>& rows, const CsvTable& log) {
  std::vector<int> lines;
  for (const int row : rows) lines.push_back(log.line(row));
  return lines;
}

// the likelihood would refuse these states too, but it does not know their rows in the log. Where a constraint lets go at some of
// them is counted
void require_mechanics_at(const LoggedSystem& logged, const View& view, const MatrixXd& states, const std::vector<int>& rows,
                          const CsvTable& log, std::vector<std::string>& notes) {
  const auto data_row = [&](int state) { return rows[static_cast<std::size_t>(state)] + 1; };
  std::vector<StateRank> ranks(rows.size());
  const auto fault =
      for_each_mechanics(logged.prior, view, states, logged.parameters, [&](Index first, const MechanicsBatch& block) {
        const std::vector<StateRank> here = ranks_of(logged.system(), block);
        std::copy(here.begin(), here.end(), ranks.begin() + first);
      });
  if (fault) {
    throw InputError(fmt::format("{}: data row {}: {} ('{}' with the model's parameters; see gp2 check)", log.name(),
                                 data_row(fault->state), fault->text, logged.system().name()));
  }
  const LowerRank lower = states_of_lower_rank(ranks);
  if (lower.states.empty()) return;
  notes.push_back(
      fmt::format("warning: {}: the constraints have rank {} but at {} of {} rows, where it is as low as {}, first at "
                  "data row {}; see gp2 check",
                  log.name(), lower.usual, lower.states.size(), rows.size(), lower.lowest, data_row(lower.states.front())));
}

// Loads of which nothing tells whose they are, at some states.
void note_shared_loads(const LoggedSystem& logged, const MatrixXd& states, const CsvTable& log, std::vector<std::string>& notes) {
  constexpr Index enough = 300;
  if (logged.system().nc() < 2 || logged.model.graph == nullptr || states.cols() == 0) return;
  std::vector<Index> some;
  for (Index i = 0; i < states.cols(); i += std::max<Index>(1, states.cols() / enough)) some.push_back(i);
  MechanicsBatch mechanics;
  evaluate_mechanics(logged.prior, View::constrained_acceleration(logged.system()), states(Eigen::all, some), logged.parameters,
                     mechanics);
  if (mechanics.fault) return;
  for (const std::string& text : shared_load_texts(logged.model, logged.system(), mechanics))
    notes.push_back(fmt::format("warning: {}: {}", log.name(), text));
}

// Deviations of coordinates and velocities, of columns NAME_std; NaN where there are none. Empty where there is no such column.
MatrixXd stated_state_deviations(const System& system, LogReader& reader, const CsvTable& log) {
  const std::vector<std::string> names = system.state_names();
  MatrixXd stddevs = MatrixXd::Constant(2 * system.nq(), log.n_rows(), not_a_number);
  bool is_stated = false;
  for (Index k = 0; k < stddevs.rows(); ++k) {
    const std::string& name = names[static_cast<std::size_t>(k)];
    if (reader.stddev_column(name).empty()) continue;
    stddevs.row(k) = reader.stddevs({name});
    is_stated = true;
  }
  return is_stated ? stddevs : MatrixXd();
}

// --project: the states of a log moved onto the constraints, at the model's parameters
void project(const System& system, const VectorXd& parameters, const CsvTable& log, const MatrixXd& stddevs, MatrixXd& states,
             std::vector<std::string>& notes) {
  if (system.residual_labels().empty()) {
    notes.push_back(
        fmt::format("{}: nothing to project: '{}' has no position or velocity constraints", log.name(), system.name()));
    return;
  }
  ProjectedStates projected = [&] {
    try {
      return project_states(system, parameters, states, stddevs);
    } catch (const InputError& error) {
      throw InputError(fmt::format("`project`: {}: {}", log.name(), error.what()));
    }
  }();
  if (!projected.failures.empty()) {
    std::vector<std::string> lines;
    for (const ProjectedStates::Failure& failure : projected.failures) {
      if (lines.size() < 12) lines.push_back(std::to_string(log.line(failure.state)));
    }
    if (lines.size() < projected.failures.size()) lines.emplace_back("…");
    throw InputError(fmt::format(
        "`project`: {}: {} of {} states have no state on the constraints near them (line {}): {}; correct or leave out these "
        "rows, or see gp2 check",
        log.name(), projected.failures.size(), log.n_rows(), fmt::join(lines, ", "), projected.failures.front().text));
  }
  const std::vector<std::string> names = system.state_names();
  std::vector<std::string> shifts;
  for (Index k = 0; k < projected.shift.rows(); ++k) {
    const SizeSummary size = summarise_sizes(projected.shift.row(k));
    if (size.largest == 0) continue;
    shifts.push_back(fmt::format("{} by {:.2g} on average, {:.2g} at most (line {})", names[static_cast<std::size_t>(k)],
                                 size.mean, size.largest, log.line(size.at)));
  }
  notes.push_back(fmt::format("{}: states projected onto the constraints: {}", log.name(),
                              shifts.empty() ? "none moved" : fmt::format("{}", fmt::join(shifts, ", "))));
  states = std::move(projected.states);
}

// which accelerations a fit observes
std::vector<std::string> observed_accelerations(const System& system, const FitProblemOptions& options, const LogReader& reader,
                                                const CsvTable& log, std::vector<std::string>& notes) {
  if (!options.observe.empty() || options.baseline) return options.observe;
  std::vector<std::string> stated = stated_accelerations(system.acceleration_names(), reader);
  // of accelerations that are independent here or there a choice of rows may have none
  const auto is_empty = [&](const std::string& name) {
    const int column = log.find(reader.stddev_column(name));
    return std::ranges::all_of(all_rows(log.n_rows()), [&](int row) { return log.is_empty(row, column); });
  };
  if (!std::all_of(stated.begin(), stated.end(), is_empty)) std::erase_if(stated, is_empty);
  if (!stated.empty() && stated.size() < system.coordinates().size()) {
    notes.push_back(fmt::format("{}: observes {}: the log has standard deviations of these only; others with `observe`",
                                log.name(), fmt::join(stated, ", ")));
  }
  return stated;
}

// all accelerations, where the log has them and something constrains them; else empty
MatrixXd all_accelerations(const System& system, LogReader& reader, const CsvTable& log) {
  const std::vector<std::string> every = system.acceleration_names();
  const auto all = [&](const auto& has) { return std::all_of(every.begin(), every.end(), has); };
  const bool complete = system.nc() > 0 && all([&](const std::string& name) { return reader.has(name); }) &&
                        all([&](const std::string& name) { return has_values(reader, log, name); });
  return complete ? reader.measurements(every) : MatrixXd();
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

// accelerations that follow from others are no measurements; which of them count may change from row to row
void note_dependence(const LoggedSystem& logged, const Readings& readings, const FitProblemOptions& options,
                     const MatrixXd& accelerations, const CsvTable& log, std::vector<std::string>& notes) {
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
                  log.name(), every.size(), independent->size(), fmt::join(names, ",")));
}

// rows that are copies are no measurements
void note_repeats(const Readings& readings, const CsvTable& log, std::vector<std::string>& notes) {
  const int n_repeated = n_repeated_rows({{readings.states, readings.values}});
  if (n_repeated * 20 <= log.n_rows()) return;
  notes.push_back(fmt::format(
      "warning: {}: {} of {} rows repeat another one to twelve digits: standard deviations will be too small; keep each once",
      log.name(), n_repeated, log.n_rows()));
}

// friction at rest is whatever holds, up to a limit
void note_rest(const LoggedSystem& logged, const Readings& readings, const CsvTable& log, std::vector<std::string>& notes) {
  if (logged.other) return;
  const std::string text = text_of_rest(logged.model, logged.parameters, readings.states, readings.values);
  if (!text.empty()) notes.push_back(fmt::format("warning: {}: {}", log.name(), text));
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
  for (int row = 0; row <= system.layout().t(); ++row) {
    const auto k = static_cast<std::size_t>(row);
    reads[k] = reader.has(names[k]);
  }
  try {
    LoggedMotion motion{reader.states_with_gaps(reads), {}};
    motion.accelerations = MatrixXd::Constant(system.nq(), motion.states.cols(), not_a_number);
    Index row = 0;
    for (const std::string& name : system.acceleration_names()) {
      if (has_values(reader, log, name)) motion.accelerations.row(row) = reader.measurements({name});
      ++row;
    }
    return motion;
  } catch (const InputError&) {
    return std::nullopt;
  }
}

void note_rates(const LoggedSystem& logged, const CsvTable& log, const std::map<std::string, std::string>& columns,
                std::vector<std::string>& notes) {
  for (const std::string& text : wrong_rates_of(logged.system(), logged.prior, log, columns))
    notes.push_back(fmt::format("warning: {}: {}", log.name(), text));
}

// the rows of a view whose columns are there
std::vector<int> side_information_rows(const View& view, const std::vector<std::string>& every, const LogReader& reader,
                                       const std::string& option, const CsvTable& table, const System& system) {
  std::vector<int> rows;
  for (std::size_t k = 0; k < every.size(); ++k) {
    if (reader.has(every[k])) rows.push_back(view.rows[k]);
  }
  if (every.empty()) throw InputError(fmt::format("{}: '{}' has no constraints", option, system.name()));
  if (rows.empty()) {
    throw InputError(fmt::format("{}: {} has none of the columns {}; it has: {}", option, table.name(), fmt::join(every, ", "),
                                 fmt::join(table.header(), ", ")));
  }
  return rows;
}

}  // namespace

std::vector<std::string> wrong_rates_of(const System& system, const Prior& prior, const CsvTable& log,
                                        const std::map<std::string, std::string>& columns, double* unit) {
  const std::optional<LoggedMotion> motion = read_motion(system, log, columns);
  if (!motion) return {};
  const bool reads_time = prior.reads()[static_cast<std::size_t>(system.layout().t())];
  return wrong_rates(system, motion->states, motion->accelerations, reads_time, unit);
}

void check_columns(const System& system, const std::vector<const CsvTable*>& logs,
                   const std::map<std::string, std::string>& columns) {
  std::vector<std::string> known = system.state_names();
  for (const std::string& name : system.acceleration_names()) known.push_back(name);
  for (const auto& [name, column] : columns) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      throw InputError(fmt::format("`map={}={}`: '{}' is neither a state nor an acceleration of '{}'; it has: {}", column, name,
                                   name, system.name(), fmt::join(known, ", ")));
    }
    // a log may lack a coordinate that nothing reads, but then it has the coordinate's derivatives
    std::vector<std::string> meant = {column};
    const auto& coordinates = system.coordinates();
    if (std::any_of(coordinates.begin(), coordinates.end(), [&name = name](const auto& one) { return one.name == name; })) {
      meant = {column, "d" + column, "dd" + column, column + "_dot", column + "_ddot"};
    }
    std::vector<std::string> lacking;
    for (const CsvTable* log : logs) {
      if (std::any_of(meant.begin(), meant.end(), [&](const std::string& one) { return log->find(one) >= 0; })) break;
      lacking.push_back(fmt::format("{} has no column '{}'; it has: {}", log->name(), column, fmt::join(log->header(), ", ")));
    }
    if (!logs.empty() && lacking.size() == logs.size())
      throw InputError(fmt::format("`map={}={}`: {}", column, name, fmt::join(lacking, "; ")));
  }
}

std::optional<CommandedRows> take_commands(const System& system, const std::vector<Actuator>& actuators, LogReader& reader,
                                           const std::optional<CsvTable>& whole,
                                           const std::map<std::string, std::string>& columns, MatrixXd& states,
                                           std::vector<std::string>& notes) {
  std::vector<int> late;
  double lateness = 0;
  for (int k = 0; k < static_cast<int>(actuators.size()); ++k) {
    const Actuator& actuator = actuators[static_cast<std::size_t>(k)];
    if ((actuator.is_direct() && !actuator.is_estimated()) || states.row(system.layout().u(k)).array().isNaN().all()) continue;
    late.push_back(k);
    lateness = std::max(lateness, actuator.largest_delay() + actuator.largest_lag());
  }
  if (late.empty()) return std::nullopt;
  CommandedRows out{nullptr, {}, actuators};
  if (whole) {
    LogReader of_whole(*whole, system, columns);
    out.record = std::make_shared<const CommandRecord>(system, of_whole, late);
  } else {
    out.record = std::make_shared<const CommandRecord>(system, reader, late);
    constexpr double little = 0.01;  // of the spread of what acts
    const double step = out.record->usual_step();
    if (step > lateness && out.record->usual_change() * lateness > little * step) {
      notes.push_back(
          fmt::format("warning: {}: rows are usually {:.3g} s apart, inputs at most {:.3g} s late: what acts in between is not "
                      "known; log faster, or, if these are rows of a longer log, give that as `commands`",
                      reader.table().name(), out.record->usual_step(), lateness));
    }
  }
  out.places = out.record->places(reader);
  out.record->act(actuators, out.places, system.layout(), states);
  return out;
}

std::vector<Actuator> found(std::vector<Actuator> actuators) {
  for (Actuator& actuator : actuators) actuator.delay.estimate = actuator.lag.estimate = false;
  return actuators;
}

std::string text_of_rest(const Model& model, const VectorXd& parameters, const MatrixXd& states, const MatrixXd& values) {
  const SwitchingFunctions surfaces = switching_functions(model, /*of_latents=*/true);
  if (surfaces.size() == 0) return {};
  const StateLayout layout = model.system->layout();
  VectorXd small = VectorXd::Zero(values.rows());
  for (Index k = 0; k < values.rows(); ++k) {
    for (const double value : values.row(k)) small[k] = std::max(small[k], std::isnan(value) ? 0 : std::abs(value) / 4);
  }
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

int n_repeated_rows(const std::vector<MeasuredRows>& logs) {
  struct Row {
    const MeasuredRows* log;
    Index i;
    std::uint64_t hash = 0;
    // NaN is not equal to itself, and −0 is 0; the last digits may not be those of another program that read and wrote a log
    [[nodiscard]] double entry(Index k) const {
      const double one = k < log->states.rows() ? log->states(k, i) : log->values(k - log->states.rows(), i);
      if (std::isnan(one) || one == 0) return 0;
      constexpr std::uint64_t last = (std::uint64_t{1} << 12) - 1;  // bits, which leaves twelve digits
      return std::bit_cast<double>((std::bit_cast<std::uint64_t>(one) + (last + 1) / 2) & ~last);
    }
    [[nodiscard]] Index size() const { return log->states.rows() + log->values.rows(); }
  };
  // negative, 0 or positive as row a comes before b, repeats it, or comes behind it: rows are sorted by a hash of their bits first
  const auto compare = [](const Row& a, const Row& b) {
    if (a.hash != b.hash) return a.hash < b.hash ? -1 : 1;
    if (a.size() != b.size()) return a.size() < b.size() ? -1 : 1;
    for (Index k = 0; k < a.size(); ++k) {
      if (a.entry(k) != b.entry(k)) return a.entry(k) < b.entry(k) ? -1 : 1;
    }
    return 0;
  };
  std::vector<Row> rows;
  std::ptrdiff_t n_rows = 0;
  for (const MeasuredRows& log : logs) n_rows += log.states.cols();
  rows.reserve(static_cast<std::size_t>(n_rows));
  for (const MeasuredRows& log : logs) {
    for (Index i = 0; i < log.states.cols(); ++i) {
      Row& row = rows.emplace_back(Row{&log, i});
      for (Index k = 0; k < row.size(); ++k) {
        row.hash = (std::rotl(row.hash, 23) ^ std::bit_cast<std::uint64_t>(row.entry(k))) * 0x9e3779b97f4a7c15U;
      }
    }
  }
  std::sort(rows.begin(), rows.end(), [&](const Row& a, const Row& b) { return compare(a, b) < 0; });
  int n = 0;
  for (std::size_t k = 1; k < rows.size(); ++k) n += compare(rows[k - 1], rows[k]) == 0 ? 1 : 0;
  return n;
}

void note_shared_rows(const std::vector<Observations>& known, const std::vector<Observations>& more,
                      std::vector<std::string>& notes) {
  const auto n_shared = [](const std::vector<const Observations*>& groups) {
    std::vector<MeasuredRows> all;
    int n = 0;
    for (const Observations* const group : groups) {
      if (group->has_sums()) continue;
      all.push_back({group->states(), group->values()});
      n -= n_repeated_rows({all.back()});
    }
    return all.size() < 2 ? 0 : n + n_repeated_rows(all);
  };
  if (known.size() + more.size() < 2) return;
  std::vector<const Observations*> groups;
  for (const Observations& group : known) groups.push_back(&group);
  const int n_before = n_shared(groups);
  for (const Observations& group : more) groups.push_back(&group);
  const int n = n_shared(groups) - n_before;
  if (n * 20 <= n_states(more)) return;
  notes.push_back(fmt::format(
      "warning: {} of {} rows are also in another log, to twelve digits: standard deviations will be too small; give each once",
      n, n_states(more)));
}

LoggedSystem logged_system(const Model& fitted, const std::vector<Actuator>& actuators, const Prior& prior,
                           const FitPriorOptions& options, const Log& log) {
  const std::vector<Actuator> there = !log.is_commanded ? std::vector<Actuator>()
                                      : log.model       ? shared_actuators(actuators, *log.model)
                                                        : actuators;
  if (!log.model) return {fitted, nullptr, nullptr, prior, fitted.system->parameter_values(), there};
  std::shared_ptr<const OtherSystem> other_system = make_other_system(fitted, *log.model, options);
  const Prior& prior_there = other_system->prior;
  VectorXd parameters = other_system->parameters(fitted.system->parameter_values());
  return {*log.model, log.model, std::move(other_system), prior_there, std::move(parameters), there};
}

Observations read_log(const LoggedSystem& logged, const Log& log, const FitProblemOptions& options, LogRows& of_log,
                      std::vector<std::string>& notes) {
  const System& system = logged.system();
  const std::map<std::string, std::string> columns = columns_of(logged.model, options.columns);
  LogReader reader(log.table, system, columns);
  Readings readings;
  const std::vector<std::string> observe = observed_accelerations(system, options, reader, log.table, notes);
  readings.view = {
      View::Quantity::constrained_acceleration, acceleration_rows(system, observe, "`observe`"), {}, {}, logged.other_system};
  readings.states = states_of(logged.prior, readings.view, reader, options.project);
  std::optional<CommandedRows> commanded =
      take_commands(system, logged.actuators, reader, options.commands, columns, readings.states, notes);
  const std::vector<std::string> observed = readings.view.names(system);
  readings.values = reader.measurements(observed);
  readings.stated_stddev = stated_noise(logged.model, observed, options, reader, log.table, notes);
  const MatrixXd all_values = all_accelerations(system, reader, log.table);
  const MatrixXd state_stddevs = options.project ? stated_state_deviations(system, reader, log.table) : MatrixXd();
  // a smoothed log has more columns than its windows need
  if (!log.windows) note_reading(reader, log.table, notes);
  if (options.project) project(system, logged.parameters, log.table, state_stddevs, readings.states, notes);
  note_violation(system, readings.states, logged.parameters, log.table, notes, &options);
  note_repeats(readings, log.table, notes);
  note_rest(logged, readings, log.table, notes);
  if (!log.windows) note_rates(logged, log.table, columns, notes);

  const int n_rows = log.table.n_rows();
  std::vector<int> measured = measured_rows(readings, observed, log.table, notes);
  // what is learned from windows are sums over each position by itself, not these rows
  if (!log.windows) note_dependence(logged, readings, options, all_values, log.table, notes);
  keep_known(commanded, log.table, measured, notes);
  const std::vector<int> rows = in_order_of_time(chosen_rows(measured, options.max_points.value_or(n_rows), options.seed),
                                                 logged.prior, log.table, columns);
  if (rows.size() < measured.size()) {
    notes.push_back(
        fmt::format("{}: {} of {} rows taken, by seed {}", log.table.name(), rows.size(), measured.size(), options.seed));
  }
  if (static_cast<int>(rows.size()) < n_rows || !std::ranges::is_sorted(rows)) readings.keep(rows);
  of_log = {lines_of(rows, log.table), of_rows(std::move(commanded), rows)};
  require_mechanics_at(logged, readings.view, readings.states, rows, log.table, notes);
  note_shared_loads(logged, readings.states, log.table, notes);

  const bool model_estimates = logged.model.noise.estimate && !options.noise_stddev;
  const bool estimate = readings.states_noise()
                            ? estimates_factor(options)
                            : options.protocol.name != Protocol::Name::paper && (options.estimate_noise || model_estimates);
  VectorXd stddev = noise_of(logged.model, options, readings, estimate);
  MatrixXd scale = noise_scale_of(readings, observed, options, reader, log.table, rows);
  return {std::move(readings.states),
          std::move(readings.view),
          std::move(readings.values),
          std::move(stddev),
          estimate,
          std::move(scale)};
}

Observations read_side_information(const LoggedSystem& logged, const Prior& fitted, const SideInformation& side_information,
                                   const FitProblemOptions& options, const std::vector<VectorXd>& signal_stddev, LogRows& of_log,
                                   std::vector<std::string>& notes) {
  const System& system = logged.system();
  const CsvTable& table = side_information.log.table;
  const std::string option = "`also=" + side_information.quantity->word() + "`";
  Readings readings;
  View& view = readings.view;
  view = View::all(side_information.quantity, system);
  view.other_system = logged.other_system;
  if (!side_information.latent.empty()) view.latent = latents_called(fitted, side_information.latent, option);
  if (side_information.quantity->needs_time_step()) {
    if (!options.time_step) throw InputError(option + " needs the time step: `dt=SECONDS`");
    if (!(*options.time_step > 0)) throw InputError(fmt::format("`dt`: must be positive, got {}", *options.time_step));
    view.time_step = options.time_step;
  }
  const std::map<std::string, std::string> columns = columns_of(logged.model, options.columns);
  LogReader reader(table, system, columns);
  view.rows = side_information_rows(view, view.names(system, side_information.latent), reader, option, table, system);
  const std::vector<std::string> names = view.names(system, side_information.latent);
  readings.values = reader.measurements(names);
  readings.states = states_of(logged.prior, view, reader, options.project);
  std::optional<CommandedRows> commanded =
      take_commands(system, logged.actuators, reader, options.commands, columns, readings.states, notes);
  const MatrixXd state_stddevs = options.project ? stated_state_deviations(system, reader, table) : MatrixXd();
  note_reading(reader, table, notes);
  if (options.project) project(system, logged.parameters, table, state_stddevs, readings.states, notes);
  note_violation(system, readings.states, logged.parameters, table, notes, &options);
  std::vector<int> measured = measured_rows(readings, names, table, notes);
  keep_known(commanded, table, measured, notes);
  readings.keep(measured);
  of_log = {lines_of(measured, table), of_rows(std::move(commanded), measured)};
  require_mechanics_at(logged, view, readings.states, measured, table, notes);
  VectorXd stddev = noise_of_side_information(logged, side_information, options, readings, signal_stddev);
  return {std::move(readings.states), std::move(readings.view), std::move(readings.values), std::move(stddev)};
}

std::vector<int> acceleration_rows(const System& system, const std::vector<std::string>& names, const std::string& option) {
  const std::vector<std::string> known = system.acceleration_names();
  std::vector<int> rows;
  for (const std::string& name : names.empty() ? known : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      throw InputError(fmt::format("{}: '{}' is not an acceleration of '{}'; it has: {}", option, name, system.name(),
                                   fmt::join(known, ", ")));
    }
    const int row = static_cast<int>(found - known.begin());
    if (std::find(rows.begin(), rows.end(), row) != rows.end())
      throw InputError(fmt::format("{}: '{}' stands twice", option, name));
    rows.push_back(row);
  }
  return rows;
}

LatentRange latents_called(const Prior& prior, const std::string& name, const std::string& option) {
  std::vector<std::string> all;
  for (const Latent& latent : prior.latents) all.push_back(latent.name);
  const auto first = std::find(all.begin(), all.end(), name);
  if (first != all.end()) {
    return {static_cast<int>(first - all.begin()), static_cast<int>(std::count(first, all.end(), name))};
  }
  all.erase(std::unique(all.begin(), all.end()), all.end());
  throw InputError(fmt::format("{}: no latent is called '{}'; there are: {}", option, name, fmt::join(all, ", ")));
}

std::map<std::string, std::string> checked_columns(const Model& model, const std::vector<const CsvTable*>& logs,
                                                   const std::map<std::string, std::string>& columns) {
  check_columns(*model.system, logs, columns);
  return columns_of(model, columns);
}

LogReader open_log(const Model& model, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  return {log, *model.system, checked_columns(model, {&log}, columns)};
}

LogStates read_log_states(const Prior& prior, const View& view, const Model& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations,
                          const std::optional<std::vector<Actuator>>& actuators, const std::optional<VectorXd>& given,
                          bool projects) {
  LogReader reader = open_log(model, log, columns);
  LogStates out{states_of(prior, view, reader, projects), reader.measurements(accelerations), {}, {}};
  const std::vector<std::string> stated = stated_accelerations(accelerations, reader);
  if (!stated.empty()) out.stated_stddev = stated_stddevs(model, accelerations, reader, log.n_rows());
  const std::optional<CommandedRows> commanded = take_commands(*prior.system, found(actuators.value_or(model.actuators)), reader,
                                                               std::nullopt, columns, out.states, out.notes);
  std::size_t n_unknown = 0;
  bool begins_at_rest = true;
  for (std::size_t i = 0; commanded && i < commanded->places.size(); ++i) {
    if (is_known(*commanded, i)) continue;
    ++n_unknown;
    begins_at_rest = begins_at_rest && commanded->record->begins_at_rest(commanded->places[i], reach_of(*commanded));
    out.accelerations.col(static_cast<Index>(i)).setConstant(not_a_number);
  }
  if (n_unknown > 0 && accelerations.empty() && !begins_at_rest) {
    out.notes.push_back(
        fmt::format("warning: {}: {} of {} rows are predicted as if the inputs had been at rest before, but the log does not "
                    "begin at rest: what acts there depends on commands before the log",
                    log.name(), n_unknown, log.n_rows()));
  } else if (n_unknown > 0) {
    out.notes.push_back(
        unknown_text(log, n_unknown, accelerations.empty() ? "as if the inputs had been at rest before" : "left out"));
  }
  const MatrixXd state_stddevs = projects ? stated_state_deviations(*prior.system, reader, log) : MatrixXd();
  note_reading(reader, log, out.notes);
  const VectorXd parameters = given.value_or(prior.system->parameter_values());
  if (projects) project(*prior.system, parameters, log, state_stddevs, out.states, out.notes);
  note_violation(*prior.system, out.states, parameters, log, out.notes);
  if (accelerations.empty()) return out;
  if (const std::string text = text_of_rest(model, parameters, out.states, out.accelerations); !text.empty()) {
    out.notes.push_back(fmt::format("warning: {}: {}", log.name(), text));
  }
  return out;
}

WantedMotion read_wanted_motion(const Prior& prior, const Model& model, const CsvTable& log,
                                const std::map<std::string, std::string>& columns, const VectorXd& parameters) {
  const System& system = *prior.system;
  const StateLayout layout = system.layout();
  LogReader reader = open_log(model, log, columns);
  const std::vector<std::string> every = system.acceleration_names();
  View view{View::Quantity::constrained_acceleration, {}};
  for (int j = 0; j < layout.nq; ++j) {
    if (reader.has(every[static_cast<std::size_t>(j)])) view.rows.push_back(j);
  }
  if (view.rows.empty()) {
    throw InputError(fmt::format("{}: has none of the columns {}, the desired accelerations; it has: {}", log.name(),
                                 fmt::join(every, ", "), fmt::join(log.header(), ", ")));
  }
  // inputs are what is looked for, but for those of sensors
  const auto is_given = inputs_of_sensors(system);
  std::vector<bool> reads = prior.reads();
  std::copy(is_given.begin(), is_given.end(), reads.end() - layout.nu);
  WantedMotion out{reader.states(reads), view, reader.values(view.names(system)), {}};
  for (int k = 0; k < layout.nu; ++k) {
    if (!is_given[k]) out.states.row(layout.u(k)).setZero();
  }
  note_violation(system, out.states, parameters, log, out.notes);
  return out;
}

ActingStates::ActingStates(const Prior& prior) {
  for (const Latent& latent : prior.latents) {
    names_.push_back(latent.name);
    acts_.push_back(!latent.directions);
  }
  moves_ = acts_;
}

void ActingStates::count(const Prior& prior, const MatrixXd& states, const VectorXd& parameters) {
  n_states_ += states.cols();
  constexpr Index piece = 1000;      // states, of which the first tell as a rule
  constexpr double rounding = 1e-9;  // of what is projected; coordinates may be in m and in mm
  const View view = View::constrained_acceleration(*prior.system);
  for (Index from = 0; from < states.cols() && std::ranges::count(moves_, false) > 0; from += piece) {
    const MatrixXd some = states.middleCols(from, std::min(piece, states.cols() - from));
    const auto fault = for_each_mechanics(prior, view, some, parameters, [&](Index first, const MechanicsBatch& block) {
      const int n = block.values.n_states();
      const PriorValues values = evaluate_prior(prior, some.middleCols(first, n), parameters, block);
      for (std::size_t a = 0; a < acts_.size(); ++a) {
        for (int i = 0; i < n && !moves_[a]; ++i) {
          const auto E = values.E(a, i);
          acts_[a] = acts_[a] || values.fault || !E.isZero(0);
          moves_[a] = values.fault || (block.projections[static_cast<std::size_t>(i)].T() * E).norm() > rounding * E.norm();
        }
      }
    });
    // others tell
    if (fault) moves_.assign(moves_.size(), true);
    if (fault) acts_ = moves_;
  }
}

std::vector<std::string> ActingStates::idle_texts(bool accelerations) const {
  std::vector<std::string> warnings;
  for (std::size_t a = 0; a < acts_.size() && n_states_ > 0; ++a) {
    if (acts_[a] && !moves_[a] && accelerations) {
      warnings.push_back(
          fmt::format("latent '{}' acts along the constraints, which take it up, at all of {} states: accelerations "
                      "tell nothing of it; check the signs of its directions",
                      names_[a], n_states_));
    }
    if (acts_[a]) continue;
    warnings.push_back(
        fmt::format("latent '{}' acts at 0 of {} states: its direction is 0, and nothing is learned of it; check the sign of its "
                    "load, or the condition under which it acts",
                    names_[a], n_states_));
  }
  return warnings;
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

std::vector<std::string> outputs_to_compare(const Posterior& posterior, const Model& model, const CsvTable& log,
                                            const std::map<std::string, std::string>& columns, std::vector<std::string>& notes) {
  const System& system = *model.system;
  const LogReader reader = open_log(model, log, columns);
  const std::vector<int> observed = observed_rows(posterior);
  const std::vector<std::string> every = system.acceleration_names();
  std::vector<std::string> outputs, not_in_log, not_observed;
  for (int row = 0; row < system.nq(); ++row) {
    const std::string& name = every[static_cast<std::size_t>(row)];
    const bool is_observed = std::find(observed.begin(), observed.end(), row) != observed.end();
    const bool is_measured = reader.measures(name);
    if (is_observed) (is_measured ? outputs : not_in_log).push_back(name);
    if (!is_observed && is_measured) not_observed.push_back(name);
  }
  if (outputs.empty()) return observed.empty() ? every : not_in_log;  // what reads them names what is missing
  if (!not_in_log.empty())
    notes.push_back(fmt::format("{}: not compared: {}, which it lacks", log.name(), fmt::join(not_in_log, ", ")));
  if (!not_observed.empty()) {
    notes.push_back(fmt::format("{}: not compared: {}, which the fit did not observe; choose others with `outputs`", log.name(),
                                fmt::join(not_observed, ", ")));
  }
  return outputs;
}

WholeLog read_whole_log(const Model& model, LogReader& reader) {
  const System& system = *model.system;
  const std::vector<bool> prior_reads = make_prior(model).reads();
  std::vector<bool> reads = prior_reads;
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || reader.has(names[k]);
  WholeLog log;
  log.reads_time = prior_reads[static_cast<std::size_t>(system.layout().t())];
  log.states = reader.states(reads);
  std::vector<std::string> notes;
  take_commands(system, model.actuators, reader, std::nullopt, {}, log.states, notes);
  log.accelerations = MatrixXd::Constant(system.nq(), log.states.cols(), not_a_number);
  log.stddev = log.accelerations;
  Index row = 0;
  for (const std::string& name : system.acceleration_names()) {
    if (reader.measures(name)) {
      log.accelerations.row(row) = reader.measurements({name});
    } else {
      log.missing.push_back(name);
    }
    if (!model.noise.stddev.empty()) log.stddev.row(row).setConstant(model.noise.stddev[static_cast<std::size_t>(row)]);
    if (!reader.stddev_column(name).empty()) {
      log.stddev.row(row) = stated_stddevs(model, {name}, reader, log.stddev.cols());
      log.stated.push_back(static_cast<int>(row));
    }
    ++row;
  }
  return log;
}

}  // namespace gp2
