#include "jobs/read_observations.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/chosen_rows.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/observation_noise.hpp"
#include "jobs/read_states.hpp"
#include "jobs/reading_notes.hpp"
#include "jobs/repeated_rows.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// which accelerations a fit observes
std::vector<std::string> observed_accelerations(const System& system, const FitProblemOptions& options, const LogReader& reader,
                                                std::vector<std::string>& notes) {
  if (!options.observe.empty() || options.baseline) return options.observe;
  std::vector<std::string> stated = stated_accelerations(system.acceleration_names(), reader);
  // of accelerations that are independent here or there a choice of rows may have none
  const CsvTable& log = reader.table();
  const auto is_empty = [&](const std::string& name) { return log.is_empty(log.find(reader.stddev_column(name))); };
  if (!std::all_of(stated.begin(), stated.end(), is_empty)) std::erase_if(stated, is_empty);
  if (!stated.empty() && stated.size() < system.coordinates().size()) {
    notes.push_back(fmt::format("{}: observes {}: the log has standard deviations of these only; others with `observe`",
                                log.name(), fmt::join(stated, ", ")));
  }
  return stated;
}

// all accelerations, where the log has them and something constrains them; else empty
MatrixXd all_accelerations(const System& system, LogReader& reader) {
  const std::vector<std::string> every = system.acceleration_names();
  const auto all = [&](const auto& has) { return std::all_of(every.begin(), every.end(), has); };
  const bool complete = system.nc() > 0 && all([&](const std::string& name) { return reader.has(name); }) &&
                        all([&](const std::string& name) { return has_values(reader, name); });
  return complete ? reader.measurements(every) : MatrixXd();
}

// the rows of a view whose columns are there
std::vector<int> side_information_rows(const View& view, const std::vector<std::string>& every, const LogReader& reader,
                                       const std::string& option, const System& system) {
  std::vector<int> rows;
  for (std::size_t k = 0; k < every.size(); ++k) {
    if (reader.has(every[k])) rows.push_back(view.rows[k]);
  }
  if (every.empty()) throw InputError(fmt::format("{}: '{}' has no constraints", option, system.name()));
  if (rows.empty()) {
    throw InputError(fmt::format("{}: {} has none of the columns {}; it has: {}", option, reader.table().name(),
                                 fmt::join(every, ", "), fmt::join(reader.table().header(), ", ")));
  }
  return rows;
}

std::vector<int> lines_of(const std::vector<int>& rows, const CsvTable& log) {
  std::vector<int> lines;
  for (const int row : rows) lines.push_back(log.line(row));
  return lines;
}

}  // namespace

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
  const std::vector<std::string> observe = observed_accelerations(system, options, reader, notes);
  readings.view = {
      View::Quantity::constrained_acceleration, acceleration_rows(system, observe, "`observe`"), {}, {}, logged.other_system};
  readings.states = read_states(logged.prior, readings.view, reader, options.project);
  std::optional<CommandedRows> commanded =
      take_commands(system, logged.actuators, reader, options.commands, columns, readings.states, notes);
  const std::vector<std::string> observed = readings.view.names(system);
  readings.values = reader.measurements(observed);
  readings.stated_stddev = stated_noise(logged.model, observed, options, reader, log.table, notes);
  const MatrixXd all_values = all_accelerations(system, reader);
  const MatrixXd state_stddevs = options.project ? stated_state_deviations(system, reader) : MatrixXd();
  // a smoothed log has more columns than its windows need
  if (!log.windows) note_reading(reader, notes);
  if (options.project) move_onto_constraints(system, logged.parameters, log.table, state_stddevs, readings.states, notes);
  note_violation(system, readings.states, logged.parameters, log.table.name(), notes, &options);
  note_repeated_rows({readings.states, readings.values}, log.table.name(), notes);
  if (!logged.other) note_rest(logged.model, logged.parameters, readings.states, readings.values, log.table.name(), notes);
  const bool has_wrong_rate = !log.is_smoothed && note_channels(logged.prior, log.table, columns, logged.actuators, notes);

  const int n_rows = log.table.n_rows();
  std::vector<int> measured = measured_rows(readings, observed, log.table.name(), notes);
  // what is learned from windows are sums over each position by itself, not these rows
  if (!log.windows) note_dependence(logged, readings, options, all_values, log.table.name(), notes);
  if (commanded) keep_known(*commanded, log.table, measured, notes);
  std::vector<int> rows = random_rows(measured, options.max_points, options.seed, log.table.name(), notes);
  // where time is a part of the state, rows may well be drawn at any time
  const bool reads_time = logged.prior.reads()[static_cast<std::size_t>(system.layout().t())];
  if (!reads_time) rows = in_order_of_time(std::move(rows), system, log.table, columns);
  if (static_cast<int>(rows.size()) < n_rows || !std::ranges::is_sorted(rows)) readings.keep(rows);
  of_log = {lines_of(rows, log.table), estimated_at(std::move(commanded), rows), has_wrong_rate};
  require_mechanics_at(logged, readings.view, readings.states, rows, log.table.name(), notes);
  note_shared_loads(logged, readings.states, log.table.name(), notes);

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
  view.rows = side_information_rows(view, view.names(system, side_information.latent), reader, option, system);
  const std::vector<std::string> names = view.names(system, side_information.latent);
  readings.values = reader.measurements(names);
  readings.states = read_states(logged.prior, view, reader, options.project);
  std::optional<CommandedRows> commanded =
      take_commands(system, logged.actuators, reader, options.commands, columns, readings.states, notes);
  const MatrixXd state_stddevs = options.project ? stated_state_deviations(system, reader) : MatrixXd();
  note_reading(reader, notes);
  if (options.project) move_onto_constraints(system, logged.parameters, table, state_stddevs, readings.states, notes);
  note_violation(system, readings.states, logged.parameters, table.name(), notes, &options);
  std::vector<int> measured = measured_rows(readings, names, table.name(), notes);
  if (commanded) keep_known(*commanded, table, measured, notes);
  readings.keep(measured);
  of_log = {lines_of(measured, table), estimated_at(std::move(commanded), measured)};
  require_mechanics_at(logged, view, readings.states, measured, table.name(), notes);
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

}  // namespace gp2
