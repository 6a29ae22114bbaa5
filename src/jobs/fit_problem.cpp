#include "gp2/jobs/fit_problem.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulation/projected_states.hpp"
#include "gp2/training/laplace.hpp"
#include "gp2/training/robust.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// A renaming that finds nothing is a slip of the pen: the model's [columns] may name columns that these logs lack, --map may not.
void check_columns(const System& system, const std::vector<const CsvTable*>& logs,
                   const std::map<std::string, std::string>& columns) {
  std::vector<std::string> known = system.state_names();
  for (const std::string& name : system.acceleration_names()) known.push_back(name);
  for (const auto& [name, column] : columns) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      throw InputError(fmt::format("--map {}={}: '{}' is neither a state nor an acceleration of '{}'; it has: {}", column, name,
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
    if (lacking.size() == logs.size()) throw InputError(fmt::format("--map {}={}: {}", column, name, fmt::join(lacking, "; ")));
  }
}

std::map<std::string, std::string> columns_of(const Model& model, std::map<std::string, std::string> columns) {
  columns.insert(model.columns.begin(), model.columns.end());
  return columns;
}

// whether a log has a column for this, with something in it
bool has_values(LogReader& reader, const CsvTable& log, const std::string& name) {
  const int column = reader.column(name);
  for (int row = 0; column >= 0 && row < log.n_rows(); ++row) {
    if (log.cell(row, column).find_first_not_of(" \t") != std::string::npos) return true;
  }
  return false;
}

void note_reading(const LogReader& reader, const CsvTable& log, std::vector<std::string>& notes) {
  for (const auto& [name, found] : reader.aliases_used()) notes.push_back(fmt::format("column '{}' taken as {}", found, name));
  const std::vector<std::string> unused = reader.unused_columns();
  if (!unused.empty()) notes.push_back(fmt::format("{}: columns not needed: {}", log.name(), fmt::join(unused, ", ")));
}

void note_violation(const System& system, const MatrixXd& states, const VectorXd& parameters, const CsvTable& log,
                    std::vector<std::string>& notes) {
  const auto violation = largest_violation(system, states, parameters);
  if (!violation || violation->relative <= constraint_violation_tolerance) return;
  notes.push_back(
      fmt::format("warning: {}: states are off the constraint: '{}' is {:.3g} at data row {}, {:.1e} of its scale; see gp2 check",
                  log.name(), violation->constraint, violation->value, violation->state + 1, violation->relative));
}

// columns a prior and a view need, and those that only tell whether a state or a prediction is on the constraint
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

std::vector<int> every_row(const CsvTable& log) {
  std::vector<int> rows(static_cast<std::size_t>(log.n_rows()));
  std::iota(rows.begin(), rows.end(), 0);
  return rows;
}

// the first n of a shuffle of `rows`; all in order when n is no less
std::vector<int> chosen_rows(const std::vector<int>& rows, int n, std::uint64_t seed) {
  const int size = static_cast<int>(rows.size());
  if (n >= size) return rows;
  std::vector<int> chosen;
  for (const int k : RandomStream(seed).permutation(size)) chosen.push_back(rows[static_cast<std::size_t>(k)]);
  chosen.resize(static_cast<std::size_t>(n));
  return chosen;
}

// these states of a group
void keep_rows(Observations& group, const std::vector<int>& rows) {
  group.states = MatrixXd(group.states(Eigen::all, rows));
  group.values = MatrixXd(group.values(Eigen::all, rows));
  if (group.has_noise_scale()) group.noise_scale = MatrixXd(group.noise_scale(Eigen::all, rows));
}

// The rows of a log with something measured. Values without a stated deviation where others of the column have one count as
// not measured.
std::vector<int> measured_rows(Observations& group, const std::vector<std::string>& names, const CsvTable& log,
                               std::vector<std::string>& notes) {
  std::vector<std::string> missing;
  for (Index k = 0; k < group.values.rows(); ++k) {
    Index n_without = 0;
    if (group.has_noise_scale() && !group.noise_scale.row(k).array().isNaN().all()) {
      for (Index i = 0; i < group.values.cols(); ++i) {
        if (std::isnan(group.values(k, i)) || !std::isnan(group.noise_scale(k, i))) continue;
        group.values(k, i) = std::numeric_limits<double>::quiet_NaN();
        ++n_without;
      }
    }
    const Index n = group.values.row(k).array().isNaN().count();
    if (n == 0) continue;
    missing.push_back(fmt::format("{} of {} of {}{}", n, log.n_rows(), names[static_cast<std::size_t>(k)],
                                  n_without > 0 ? fmt::format(" ({} for want of a deviation)", n_without) : ""));
  }
  if (missing.empty()) return every_row(log);
  notes.push_back(fmt::format("{}: values not measured, their cells being empty: {}", log.name(), fmt::join(missing, ", ")));
  std::vector<int> rows;
  for (int i = 0; i < log.n_rows(); ++i) {
    if (!group.values.col(i).array().isNaN().all()) rows.push_back(i);
  }
  const std::size_t n_left_out = static_cast<std::size_t>(log.n_rows()) - rows.size();
  if (n_left_out > 0) notes.push_back(fmt::format("{}: {} rows left out: they measure nothing", log.name(), n_left_out));
  return rows;
}

std::vector<int> lines_of(const std::vector<int>& rows, const CsvTable& log) {
  std::vector<int> lines;
  for (const int row : rows) lines.push_back(log.line(row));
  return lines;
}

// The system that a log was taken on, as its observations see it.
struct Place {
  const Model& model;
  std::shared_ptr<const Model> other;               // null: at home
  std::shared_ptr<const OtherSystem> other_system;  // null: at home
  const Prior& prior;
  VectorXd parameters;

  [[nodiscard]] const System& system() const { return *prior.system; }
};

Place place_of(const Model& home, const Prior& prior, const FitPriorOptions& options, const Log& log) {
  if (!log.model) return {home, nullptr, nullptr, prior, home.system->parameter_values()};
  std::shared_ptr<const OtherSystem> other_system = make_other_system(home, *log.model, options);
  const Prior& there = other_system->prior;
  VectorXd parameters = other_system->parameters(home.system->parameter_values());
  return {*log.model, log.model, std::move(other_system), there, std::move(parameters)};
}

// the likelihood would refuse these states too, but it does not know their rows in the log. Where a constraint lets go at some of
// them is counted
void require_mechanics_at(const Place& place, const View& view, const MatrixXd& states, const std::vector<int>& rows,
                          const CsvTable& log, std::vector<std::string>& notes) {
  MechanicsBatch mechanics;
  evaluate_mechanics(place.prior, view, states, place.parameters, mechanics);
  const auto data_row = [&](int state) { return rows[static_cast<std::size_t>(state)] + 1; };
  if (mechanics.fault) {
    throw InputError(fmt::format("{}: data row {}: {} ('{}' with the model's parameters; see gp2 check)", log.name(),
                                 data_row(mechanics.fault->state), mechanics.fault->text, place.system().name()));
  }
  const LowerRank lower = states_of_lower_rank(mechanics);
  if (lower.states.empty()) return;
  notes.push_back(
      fmt::format("warning: {}: the constraints have rank {} but at {} of {} rows, where it is as low as {}, first at "
                  "data row {}; see gp2 check",
                  log.name(), lower.usual, lower.states.size(), rows.size(), lower.lowest, data_row(lower.states.front())));
}

// --project: the states of a log moved onto the constraints, at the model's parameters
void project(const Place& place, const CsvTable& log, MatrixXd& states, std::vector<std::string>& notes) {
  const System& system = place.system();
  if (system.residual_labels().empty()) {
    notes.push_back(
        fmt::format("{}: nothing to project: '{}' has no position or velocity constraints", log.name(), system.name()));
    return;
  }
  ProjectedStates projected = [&] {
    try {
      return project_states(system, place.parameters, states);
    } catch (const InputError& error) {
      throw InputError(fmt::format("--project: {}: {}", log.name(), error.what()));
    }
  }();
  if (!projected.failures.empty()) {
    std::vector<std::string> lines;
    for (const ProjectedStates::Failure& failure : projected.failures) {
      if (lines.size() < 12) lines.push_back(std::to_string(log.line(failure.state)));
    }
    if (lines.size() < projected.failures.size()) lines.emplace_back("…");
    throw InputError(fmt::format(
        "--project: {}: {} of {} states have no state on the constraints near them (line {}): {}; mend or leave out "
        "these rows, or see gp2 check",
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

// σ of a row of a group; refused where ε‖K̃‖ ≪ 1 could not hold at a signal of the given size
struct NoiseRule {
  std::string source, name;  // where σ comes from; the row
  double signal = 0;         // its size
  int n_data = 0;

  // ‖K̃‖ ≤ Σ_i (signal/noise_i)²; a hundredth of the digits must be left
  static constexpr double largest_norm = 0.01 / std::numeric_limits<double>::epsilon();

  [[nodiscard]] double smallest() const { return signal * std::sqrt(static_cast<double>(n_data) / largest_norm); }

  /// @param stddev  ∞ where nothing is measured
  /// @param rows    of the log, of each value
  void require_each(const Eigen::RowVectorXd& stddev, const std::vector<int>& rows) const {
    if (!((signal / stddev.array()).square().sum() > largest_norm)) return;
    Index worst = 0;
    const double least = stddev.minCoeff(&worst);
    throw InputError(
        fmt::format("{}: data row {}: the noise standard deviation {} of {} is too small for double precision beside a spread of "
                    "{:.3g}; the smallest usable value is {:.2g}",
                    source, rows[static_cast<std::size_t>(worst)] + 1, least, name, signal, smallest()));
  }

  void require(double stddev, bool estimated) const {
    if (!(stddev > 0) || !std::isfinite(stddev)) {
      throw InputError(fmt::format("{}: the noise standard deviation of {} must be positive, got {}", source, name, stddev));
    }
    if (!estimated && stddev < smallest()) {
      throw InputError(
          fmt::format("{}: the noise standard deviation {} of {} is too small for double precision beside a spread "
                      "of {:.3g}; the smallest usable value is {:.2g}",
                      source, stddev, name, signal, smallest()));
    }
  }
};

// the accelerations whose standard deviations the log states, for each value
std::vector<std::string> stated_accelerations(const System& system, const LogReader& reader) {
  std::vector<std::string> stated = system.acceleration_names();
  std::erase_if(stated, [&](const std::string& name) { return reader.stddev_column(name).empty(); });
  return stated;
}

std::vector<std::string> stddev_columns(const std::vector<std::string>& names, const LogReader& reader) {
  std::vector<std::string> columns;
  for (const std::string& name : names) columns.push_back(reader.stddev_column(name));
  return columns;
}

// of the deviations that a log states
bool estimates_factor(const FitProblemOptions& options) {
  const bool can_estimate = options.protocol.name != Protocol::Name::paper && !options.baseline;
  return can_estimate && (options.estimate_noise || !options.trust_stated_noise);
}

// σ of each value where the log states it, NaN elsewhere (d × N); empty when it states none, or --noise-std overrides them
MatrixXd stated_noise(const std::vector<std::string>& observed, const FitProblemOptions& options, LogReader& reader,
                      const CsvTable& log, std::vector<std::string>& notes) {
  std::vector<std::string> stated;
  for (const std::string& name : observed) {
    if (!reader.stddev_column(name).empty()) stated.push_back(name);
  }
  if (stated.empty()) return {};
  const std::vector<std::string> columns = stddev_columns(stated, reader);
  if (options.noise_stddev) {
    notes.push_back(fmt::format("{}: --noise-std {} stands for the deviations in {}", log.name(), *options.noise_stddev,
                                fmt::join(columns, ", ")));
    return {};
  }
  MatrixXd stddev =
      MatrixXd::Constant(static_cast<Index>(observed.size()), log.n_rows(), std::numeric_limits<double>::quiet_NaN());
  for (std::size_t k = 0; k < observed.size(); ++k) {
    if (!reader.stddev_column(observed[k]).empty()) stddev.row(static_cast<Index>(k)) = reader.stddevs({observed[k]});
  }
  notes.push_back(fmt::format("{}: the noise of each value is that in {}{}", log.name(), fmt::join(columns, ", "),
                              estimates_factor(options) ? ", times a factor that is estimated" : ""));
  return stddev;
}

// of the values that a robust fit does not distrust at sight
VectorXd spread_of(const Observations& group, const FitProblemOptions& options) {
  return row_stddev(options.robust ? without_gross_errors({group}).front().values : group.values);
}

// σ of each row or, where the log states it, a factor of it
VectorXd noise_of(const Model& model, const FitProblemOptions& options, const Observations& group, bool estimate) {
  const VectorXd spread = spread_of(group, options);
  const std::vector<std::string> names = group.view.names(*model.system);
  const std::string source = options.noise_stddev ? "--noise-std" : model.name + ": [noise] ddq";
  VectorXd stddev(group.view.size());
  for (Index k = 0; k < stddev.size(); ++k) {
    const auto row = static_cast<std::size_t>(group.view.rows[static_cast<std::size_t>(k)]);
    const std::string& name = names[static_cast<std::size_t>(k)];
    if (group.has_noise_scale() && !group.noise_scale.row(k).array().isNaN().all()) {
      stddev[k] = 1;
      continue;
    }
    if (options.noise_stddev) {
      stddev[k] = *options.noise_stddev;
    } else if (!model.noise.stddev.empty()) {
      stddev[k] = model.noise.stddev[row];
    } else if (estimate) {
      stddev[k] = 0.05 * (spread[k] > 0 ? spread[k] : 1);
    } else {
      throw InputError(
          fmt::format("{}: the noise of {} is not known: write [noise] ddq = … in the model, or give --noise-std S or "
                      "--noise-std estimate",
                      model.name, name));
    }
    NoiseRule{source, name, spread[k], group.n_data()}.require(stddev[k], estimate);
  }
  return stddev;
}

// Size of G ā in each row of a view: the spread of the values or, for those that hardly vary, as exact zeros, what the prior
// expects: its standard deviation, root mean square over the states, with the signals at their default scales.
VectorXd signal_size(const Place& place, const Observations& group, const std::vector<VectorXd>& signal_stddev) {
  const MechanicsBatch mechanics = require_mechanics(place.prior, group.view, group.states, place.parameters);
  const ViewValues view = evaluate_view(group.view, mechanics, group.states);
  PriorValues prior = evaluate_prior(place.prior, group.states, place.parameters, mechanics);
  if (group.view.latent >= 0) prior.keep_only(static_cast<std::size_t>(group.view.latent));
  VectorXd variance = VectorXd::Zero(group.view.size());
  for (int i = 0; i < group.n_data(); ++i) {
    for (std::size_t a = 0; a < signal_stddev.size(); ++a) {
      variance += (view.G(i) * prior.E(a, i) * signal_stddev[a].asDiagonal()).rowwise().squaredNorm();
    }
  }
  return (variance / group.n_data()).cwiseSqrt().cwiseMax(row_stddev(group.values - view.offset));
}

// accelerations measured
/// @param lines  receives the line of each state in the log
Observations read_log(const Place& place, const Log& log, const FitProblemOptions& options, std::vector<int>& lines,
                      std::vector<std::string>& notes) {
  const System& system = place.system();
  LogReader reader(log.table, system, columns_of(place.model, options.columns));
  Observations group;
  std::vector<std::string> observe = options.observe;
  if (observe.empty() && !options.baseline) {
    observe = stated_accelerations(system, reader);
    if (!observe.empty() && observe.size() < system.coordinates().size()) {
      notes.push_back(fmt::format("{}: observes {}: the log gives the deviations of these alone; others with --observe",
                                  log.table.name(), fmt::join(observe, ", ")));
    }
  }
  group.view = {View::Quantity::constrained_acceleration, acceleration_rows(system, observe, "--observe"), 0, -1,
                place.other_system};
  group.states = states_of(place.prior, group.view, reader, options.project);
  const std::vector<std::string> observed = group.view.names(system);
  const std::vector<std::string> every = system.acceleration_names();
  const auto all = [&](const auto& has) { return std::all_of(every.begin(), every.end(), has); };
  const bool complete = system.nc() > 0 && all([&](const std::string& name) { return reader.has(name); }) &&
                        all([&](const std::string& name) { return has_values(reader, log.table, name); });
  group.values = reader.measurements(observed);
  group.noise_scale = stated_noise(observed, options, reader, log.table, notes);
  const MatrixXd all_values = complete ? reader.measurements(every) : MatrixXd();
  note_reading(reader, log.table, notes);
  if (options.project) project(place, log.table, group.states, notes);
  note_violation(system, group.states, place.parameters, log.table, notes);
  if (all_values.size() > 0) {
    const auto independent = dependent_columns(system, group.states, place.parameters, all_values);
    if (independent && observed.size() > independent->size()) {
      std::vector<std::string> names;
      for (int row : *independent) names.push_back(every[static_cast<std::size_t>(row)]);
      notes.push_back(
          fmt::format("warning: {}: the accelerations obey A ddq = b to rounding: they are not {} independent "
                      "measurements but {}; observe independent rows only, say --observe {}",
                      log.table.name(), every.size(), independent->size(), fmt::join(names, ",")));
    }
  }
  const int n_rows = log.table.n_rows();
  const std::vector<int> measured = measured_rows(group, observed, log.table, notes);
  const std::vector<int> rows = chosen_rows(measured, options.max_points.value_or(n_rows), options.seed);
  if (rows.size() < measured.size()) {
    notes.push_back(
        fmt::format("{}: {} of {} rows taken, by seed {}", log.table.name(), rows.size(), measured.size(), options.seed));
  }
  if (static_cast<int>(rows.size()) < n_rows) keep_rows(group, rows);
  lines = lines_of(rows, log.table);
  require_mechanics_at(place, group.view, group.states, rows, log.table, notes);

  const bool model_estimates = place.model.noise.estimate && !options.noise_stddev && !group.has_noise_scale();
  group.estimate_noise = options.protocol.name != Protocol::Name::paper && (options.estimate_noise || model_estimates);
  if (group.has_noise_scale()) group.estimate_noise = estimates_factor(options);
  group.noise_stddev = noise_of(place.model, options, group, group.estimate_noise);
  if (!group.has_noise_scale()) return group;
  const VectorXd spread = spread_of(group, options);
  for (Index k = 0; k < spread.size(); ++k) {
    const std::string& name = observed[static_cast<std::size_t>(k)];
    auto scale = group.noise_scale.row(k);
    if (scale.array().isNaN().all()) {
      scale.setOnes();
    } else {
      const auto is_measured = !group.values.row(k).array().isNaN();
      NoiseRule{fmt::format("{}: column '{}'", log.table.name(), reader.stddev_column(name)), name, spread[k], group.n_data()}
          .require_each(is_measured.select(scale, std::numeric_limits<double>::infinity()), rows);
    }
  }
  return group;
}

// what else is measured or known, its noise not yet
Observations read_knowledge(const Place& place, const Prior& home, const SideInformation& knowledge,
                            const FitProblemOptions& options, std::vector<int>& lines, std::vector<std::string>& notes) {
  const System& system = place.system();
  const CsvTable& table = knowledge.log.table;
  const std::string option = "--also " + View::word(knowledge.quantity);
  Observations group;
  group.view = View::all(knowledge.quantity, system);
  group.view.other_system = place.other_system;
  if (!knowledge.latent.empty()) group.view.latent = latent_index(home, knowledge.latent, option);
  if (knowledge.quantity == View::Quantity::next_velocity) {
    if (!options.time_step) throw InputError(option + " needs the time step: --dt SECONDS");
    if (!(*options.time_step > 0)) throw InputError(fmt::format("--dt: must be positive, got {}", *options.time_step));
    group.view.time_step = *options.time_step;
  }

  // the rows whose columns are there
  LogReader reader(table, system, columns_of(place.model, options.columns));
  const std::vector<std::string> every = group.view.names(system, knowledge.latent);
  std::vector<std::string> names;
  std::vector<int> rows;
  for (std::size_t k = 0; k < every.size(); ++k) {
    if (!reader.has(every[k])) continue;
    names.push_back(every[k]);
    rows.push_back(group.view.rows[k]);
  }
  if (every.empty()) throw InputError(fmt::format("{}: '{}' has no constraints", option, system.name()));
  if (rows.empty()) {
    throw InputError(fmt::format("{}: {} has none of the columns {}; it has: {}", option, table.name(), fmt::join(every, ", "),
                                 fmt::join(table.header(), ", ")));
  }
  group.view.rows = std::move(rows);
  group.values = reader.measurements(names);
  group.states = states_of(place.prior, group.view, reader, options.project);
  note_reading(reader, table, notes);
  if (options.project) project(place, table, group.states, notes);
  note_violation(system, group.states, place.parameters, table, notes);
  const std::vector<int> measured = measured_rows(group, names, table, notes);
  keep_rows(group, measured);
  lines = lines_of(measured, table);
  require_mechanics_at(place, group.view, group.states, measured, table, notes);
  return group;
}

VectorXd noise_of_knowledge(const Place& place, const SideInformation& knowledge, const FitProblemOptions& options,
                            const Observations& group, const std::vector<VectorXd>& signal_stddev) {
  using Quantity = View::Quantity;
  const bool is_acceleration =
      knowledge.quantity == Quantity::constrained_acceleration || knowledge.quantity == Quantity::unconstrained_acceleration;
  const std::vector<double>& of_model = place.model.noise.stddev;
  if (!options.also_noise_stddev && (!is_acceleration || of_model.empty())) {
    throw InputError(fmt::format("--also {}: {}: its noise is not known: give --also-noise-std S", View::word(knowledge.quantity),
                                 knowledge.log.table.name()));
  }
  const std::string source = options.also_noise_stddev ? "--also-noise-std" : place.model.name + ": [noise] ddq";
  const std::vector<std::string> names = group.view.names(place.system(), knowledge.latent);
  const VectorXd signal = signal_size(place, group, signal_stddev);
  VectorXd stddev(group.view.size());
  for (Index k = 0; k < stddev.size(); ++k) {
    const auto row = static_cast<std::size_t>(k);
    stddev[k] = options.also_noise_stddev ? *options.also_noise_stddev : of_model[static_cast<std::size_t>(group.view.rows[row])];
    NoiseRule{source, names[row], signal[k], group.n_data()}.require(stddev[k], false);
  }
  return stddev;
}

// what a baseline cannot have
void require_baseline_options(const FitProblemOptions& options, const std::vector<Log>& logs,
                              const std::vector<SideInformation>& also) {
  const auto refuse = [&](bool asked, const char* rule, const char* option) {
    if (asked) throw InputError(fmt::format("--baseline {} {}: leave out {}", Baseline::word(*options.baseline), rule, option));
  };
  refuse(options.mean != Prior::Mean::zero, "has the mean of the training data as prior mean", "--mean");
  refuse(options.base.has_value(), "has its prior on ddq", "--prior");
  refuse(options.estimate && !options.estimate->empty(), "knows no parameters of the system", "--estimate");
  refuse(!options.observe.empty(), "learns every acceleration", "--observe");
  refuse(options.estimate_noise, "has fixed noise", "--noise-std estimate");
  refuse(options.project, "knows no constraints", "--project");
  refuse(options.robust, "is fitted as published", "--robust");
  refuse(!also.empty() || options.time_step || options.also_noise_stddev, "knows ddq only", "--also");
  const bool elsewhere = std::any_of(logs.begin(), logs.end(), [](const Log& log) { return log.model != nullptr; });
  refuse(elsewhere, "knows no system", "@OTHER.toml");
}

// the same under every protocol
FitProblem make_baseline_problem(const Model& model, const std::vector<Log>& logs, FitProblemOptions options) {
  options.protocol.name = Protocol::Name::paper;  // fixed noise
  FitProblem problem;
  problem.prior_options.raw_angles = true;
  problem.prior_options.baseline = unstandardised(model, *options.baseline);
  problem.prior = make_prior(model, problem.prior_options);
  for (const Log& log : logs) {
    const Place place = place_of(model, problem.prior, problem.prior_options, log);
    problem.observations.push_back(read_log(place, log, options, problem.lines.emplace_back(), problem.notes));
    problem.systems.push_back(nullptr);
  }
  problem.prior_options.baseline = standardised_by(problem.observations, problem.prior.latents.front(), *options.baseline);
  problem.prior = make_prior(model, problem.prior_options);
  problem.hyperparameters = baseline_hyperparameters(problem.prior, problem.observations);
  return problem;
}

// which parameters the systems have in common is decided by other files: worth a word
void note_parameters(const Model& home, const Place& place, const std::vector<std::string>& estimated,
                     std::vector<std::string>& notes) {
  if (!place.other_system) return;
  const std::vector<Parameter>& parameters = place.system().parameters();
  for (std::size_t k = 0; k < parameters.size(); ++k) {
    const std::string& name = parameters[k].name;
    if (parameters[k].estimate && place.other_system->shared[k] < 0) {
      notes.push_back(fmt::format("{}: parameter '{}' is marked estimate = true, but '{}' has none of that name: it stays {}",
                                  place.model.name, name, home.name, parameters[k].value));
    }
    const bool tuned = std::find(estimated.begin(), estimated.end(), name) != estimated.end();
    if (tuned && place.other_system->shared[k] < 0) {
      notes.push_back(
          fmt::format("{}: parameter '{}' stays {} there while it is estimated in '{}'; mark it estimate = true "
                      "there if it is one and the same",
                      place.model.name, name, parameters[k].value, home.name));
    }
  }
}

// so that there is no ā for a discrepancy to act on
bool has_singular_mass(const FitProblem& problem) {
  const VectorXd parameters = problem.prior.system->parameter_values();
  return std::any_of(problem.observations.begin(), problem.observations.end(), [&](const Observations& group) {
    const Prior& there = prior_of(problem.prior, group.view);
    return evaluate_mechanics(*there.system, group.states, parameters_of(group.view, parameters)).first_singular() >= 0;
  });
}

// what scales, starts and bounds are taken from
std::vector<Observations> trusted_observations(const FitProblem& problem) {
  return problem.robust ? without_gross_errors(problem.observations) : problem.observations;
}

bool has_discrepancy(const FitProblem& problem, const FitProblemOptions& options) {
  const bool standard = options.protocol.name == Protocol::Name::standard && options.protocol.hyperprior;
  return options.discrepancy && standard && problem.prior.latents.size() == 1 &&
         problem.prior.latents.front().directions_are_identity && !has_singular_mass(problem);
}

// a share of the noise, as the fit starts with it, in each acceleration; where one is not measured, of its spread the same share
// as in the others
Discrepancy discrepancy_of(const FitProblem& problem) {
  const Scales scales = default_scales(problem.prior, trusted_observations(problem));
  VectorXd noise = VectorXd::Zero(scales.acceleration_stddev.size());
  double share = 0;
  int n_shares = 0;
  for (const Observations& group : problem.observations) {
    if (group.view.quantity != View::Quantity::constrained_acceleration) continue;
    const VectorXd usual = group.usual_noise(group.noise_stddev);
    for (Index k = 0; k < usual.size(); ++k) {
      const int row = group.view.rows[static_cast<std::size_t>(k)];
      noise[row] = std::max(noise[row], usual[k]);
      share += usual[k] / scales.acceleration_stddev[row];
      ++n_shares;
    }
  }
  for (Index j = 0; j < noise.size(); ++j) {
    if (noise[j] == 0) noise[j] = share / n_shares * scales.acceleration_stddev[j];
  }
  return {Protocol::Standard::discrepancy_lengthscale * scales.feature_stddev.front(),
          Protocol::Standard::discrepancy_stddev * noise};
}

}  // namespace

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

int latent_index(const Prior& prior, const std::string& name, const std::string& option) {
  std::vector<std::string> names;
  for (const Latent& latent : prior.latents) names.push_back(latent.name);
  const auto found = std::find(names.begin(), names.end(), name);
  if (found == names.end()) {
    throw InputError(fmt::format("{}: no latent is called '{}'; there is: {}", option, name, fmt::join(names, ", ")));
  }
  return static_cast<int>(found - names.begin());
}

void read_start(const std::filesystem::path& path, int max_iterations, FitProblem& problem) {
  if (max_iterations > 0) {
    read_start_values(path, problem.hyperparameters);
    return;
  }
  const std::vector<Hyperparameter> bounded = problem.hyperparameters;
  for (Hyperparameter& h : problem.hyperparameters) {
    h.lower = h.positive ? std::numeric_limits<double>::min() : std::numeric_limits<double>::lowest();
    h.upper = std::numeric_limits<double>::max();
  }
  read_start_values(path, problem.hyperparameters);
  for (std::size_t k = 0; k < bounded.size(); ++k) {
    Hyperparameter& h = problem.hyperparameters[k];
    h.lower = std::min(bounded[k].lower, h.value);
    h.upper = std::max(bounded[k].upper, h.value);
    if (h.lower == bounded[k].lower && h.upper == bounded[k].upper) continue;
    problem.notes.push_back(fmt::format("{}: {} = {} is outside its bounds [{:.6g}, {:.6g}]; taken, as nothing is optimised",
                                        path.string(), h.name, h.value, bounded[k].lower, bounded[k].upper));
  }
}

std::vector<std::string> notes_of(const FitReport& report) {
  std::vector<std::string> collapsed;
  for (const Hyperparameter& h : report.hyperparameters) {
    const bool at_lower = h.at_bound() && h.value < 2 * h.lower;
    if (h.kind == Hyperparameter::Kind::noise_stddev && at_lower) collapsed.push_back(h.name);
  }
  std::vector<std::string> notes;
  for (const Hyperparameter& h : report.hyperparameters) {
    if (h.kind != Hyperparameter::Kind::parameter || !h.at_bound() || report.iterations == 0) continue;
    notes.push_back(
        fmt::format("warning: {} ended at its bound, {:.6g}. It may lie beyond, or the model lacks something", h.name, h.value));
  }
  for (const UncertaintyNote& note : uncertainty_notes(report)) {
    notes.push_back(fmt::format("{}{}. {}", note.is_warning ? "warning: " : "", note.text, note.mend));
  }
  if (!collapsed.empty()) {
    notes.push_back(
        fmt::format("warning: {} ended at the lower bound: the columns may not be independent measurements; see gp2 check",
                    fmt::join(collapsed, ", ")));
  }
  return notes;
}

FitOptions default_fit_options(const FitProblem& problem) {
  return problem.prior_options.baseline ? baseline_fit_options() : FitOptions{};
}

std::string fit_options_json(const FitProblemOptions& asked, const FitOptions& options,
                             const std::vector<Hyperparameter>& start) {
  nlohmann::json json = {{"mean", asked.mean == Prior::Mean::force ? "force" : "zero"},
                         {"protocol", asked.protocol.name == Protocol::Name::paper ? "paper" : "default"},
                         {"hyperprior", asked.protocol.hyperprior ? "default" : "none"},
                         {"discrepancy", asked.discrepancy ? "default" : "none"},
                         {"restarts", options.n_restarts},
                         {"max_iterations", options.max_iterations},
                         {"max_escapes", options.max_escapes},
                         {"gradient_tolerance", options.gradient_tolerance},
                         {"reduction_tolerance", options.reduction_tolerance},
                         {"standard_errors", options.standard_errors},
                         {"seed", options.seed}};
  if (!asked.observe.empty()) json["observe"] = asked.observe;
  if (asked.base) json["prior"] = *asked.base == Latent::Base::force ? "force" : "acceleration";
  if (asked.baseline) json["baseline"] = Baseline::word(*asked.baseline);
  if (asked.estimate) json["estimate"] = *asked.estimate;
  if (asked.noise_stddev) json["noise_std"] = *asked.noise_stddev;
  if (asked.estimate_noise) json["noise_std"] = "estimate";
  if (asked.trust_stated_noise) json["noise_std"] = "stated";
  if (asked.max_points) json["max_points"] = *asked.max_points;
  if (asked.also_noise_stddev) json["also_noise_std"] = *asked.also_noise_stddev;
  if (asked.project) json["project"] = true;
  if (asked.robust) json["robust"] = true;
  if (asked.time_step) json["dt"] = *asked.time_step;
  for (const auto& [name, column] : asked.columns) json["map"] += fmt::format("{}={}", column, name);
  for (const Hyperparameter& h : start) json["start"][h.name] = h.value;
  return json.dump();
}

std::vector<std::string> distrust_notes(const FitProblem& problem, const FitReport& report) {
  if (!problem.robust) return {};
  std::ptrdiff_t n_values = 0;
  for (const Observations& group : problem.observations) n_values += (!group.values.array().isNaN()).count();
  constexpr std::size_t max_shown = 12;
  std::vector<std::string> worst;
  for (const DistrustedValue& value : report.distrusted) {
    if (worst.size() == max_shown) break;
    const auto group = static_cast<std::size_t>(value.group);
    const View& view = problem.observations[group].view;
    worst.push_back(fmt::format("{} in line {}{} ({:.3g} σ)",
                                view.names(*prior_of(problem.prior, view).system)[static_cast<std::size_t>(value.row)],
                                problem.lines[group][static_cast<std::size_t>(value.state)],
                                problem.observations.size() > 1 ? fmt::format(" of log {}", group + 1) : "", value.distance));
  }
  if (worst.size() < report.distrusted.size()) worst.emplace_back("…");
  return {fmt::format("robust: {} of {} values distrusted{}{}", report.distrusted.size(), n_values, worst.empty() ? "" : ": ",
                      fmt::join(worst, ", "))};
}

Fit fit(const FitProblem& problem, const FitOptions& options) {
  if (problem.robust) return fit_robust(problem.prior, problem.observations, problem.hyperparameters, options);
  const std::optional<Baseline>& baseline = problem.prior_options.baseline;
  return baseline ? fit_baseline(baseline->kind, problem.prior, problem.observations, problem.hyperparameters, options)
                  : fit(problem.prior, problem.observations, problem.hyperparameters, options);
}

LogReader open_log(const Model& model, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  check_columns(*model.system, {&log}, columns);
  return {log, *model.system, columns_of(model, columns)};
}

LogStates read_log_states(const Prior& prior, const View& view, const Model& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations) {
  LogReader reader = open_log(model, log, columns);
  LogStates out{states_of(prior, view, reader), reader.measurements(accelerations), {}};
  note_reading(reader, log, out.notes);
  note_violation(*prior.system, out.states, prior.system->parameter_values(), log, out.notes);
  return out;
}

WholeLog read_whole_log(const Model& model, LogReader& reader) {
  const System& system = *model.system;
  std::vector<bool> reads = make_prior(model).reads();
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || reader.has(names[k]);
  WholeLog log;
  log.states = reader.states(reads);
  log.accelerations = MatrixXd::Constant(system.nq(), log.states.cols(), std::numeric_limits<double>::quiet_NaN());
  Index row = 0;
  for (const std::string& name : system.acceleration_names()) {
    if (reader.has(name)) {
      log.accelerations.row(row) = reader.measurements({name});
    } else {
      log.missing.push_back(name);
    }
    if (!reader.stddev_column(name).empty()) {
      static_cast<void>(reader.stddevs({name}));
      log.stated.push_back(static_cast<int>(row));
    }
    ++row;
  }
  return log;
}

FitProblem make_fit_problem(const Model& model, const std::vector<Log>& logs, const std::vector<SideInformation>& also,
                            const FitProblemOptions& options) {
  if (options.baseline) {
    require_baseline_options(options, logs, also);
    std::vector<const CsvTable*> tables;
    for (const Log& log : logs) tables.push_back(&log.table);
    check_columns(*model.system, tables, options.columns);
    return make_baseline_problem(model, logs, options);
  }
  const bool paper = options.protocol.name == Protocol::Name::paper;
  if (paper && options.estimate_noise) throw InputError("--protocol paper has fixed noise: leave out --noise-std estimate");
  if (paper && options.base == Latent::Base::force) {
    throw InputError("--protocol paper has its prior on the acceleration: leave out --prior force");
  }
  FitProblem problem;
  problem.robust = options.robust;
  problem.prior_options.mean = options.mean;
  problem.prior_options.base = paper ? std::optional(Latent::Base::acceleration) : options.base;
  problem.prior_options.raw_angles = paper;
  problem.prior = make_prior(model, problem.prior_options);
  std::vector<const CsvTable*> tables;
  for (const Log& log : logs) tables.push_back(&log.table);
  for (const SideInformation& knowledge : also) tables.push_back(&knowledge.log.table);
  check_columns(*model.system, tables, options.columns);

  // what is tuned
  std::vector<std::string> estimate;
  if (options.estimate) {
    estimate = *options.estimate;
  } else {
    for (const Parameter& parameter : model.system->parameters()) {
      if (parameter.estimate) estimate.push_back(parameter.name);
    }
  }

  // what is measured
  const auto place_at = [&](const Log& log) {
    Place place = place_of(model, problem.prior, problem.prior_options, log);
    note_parameters(model, place, estimate, problem.notes);
    problem.systems.push_back(place.other);
    return place;
  };
  for (const Log& log : logs) {
    problem.observations.push_back(read_log(place_at(log), log, options, problem.lines.emplace_back(), problem.notes));
  }

  // what else is known; its noise is judged by the size of the measured signals
  const bool needs_step = std::any_of(also.begin(), also.end(), [](const SideInformation& knowledge) {
    return knowledge.quantity == View::Quantity::next_velocity;
  });
  if (options.time_step && !needs_step) throw InputError("--dt goes with --also next-velocity:FILE.csv");
  if (options.also_noise_stddev && also.empty()) throw InputError("--also-noise-std goes with --also VIEW:FILE.csv");
  if (!also.empty()) {
    const std::vector<VectorXd> signal_stddev = default_scales(problem.prior, trusted_observations(problem)).signal_stddev;
    for (const SideInformation& knowledge : also) {
      const Place place = place_at(knowledge.log);
      Observations group = read_knowledge(place, problem.prior, knowledge, options, problem.lines.emplace_back(), problem.notes);
      group.noise_stddev = noise_of_knowledge(place, knowledge, options, group, signal_stddev);
      problem.observations.push_back(std::move(group));
    }
  }
  if (has_discrepancy(problem, options)) {
    problem.prior_options.discrepancy = discrepancy_of(problem);
    problem.prior = make_prior(model, problem.prior_options);
    for (std::size_t g = 0; g < problem.observations.size(); ++g) {
      const std::shared_ptr<const Model>& other = problem.systems[g];
      if (other) problem.observations[g].view.other_system = make_other_system(model, *other, problem.prior_options);
    }
  }
  problem.hyperparameters = default_hyperparameters(problem.prior, trusted_observations(problem), estimate, options.protocol);
  return problem;
}

FitProblem make_fit_problem(const Model& model, const CsvTable& log, const FitProblemOptions& options) {
  return make_fit_problem(model, {Log{log}}, {}, options);
}

}  // namespace gp2
