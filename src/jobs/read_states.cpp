#include "jobs/read_states.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/simulation/projected_states.hpp"
#include "inference/inverse_dynamics.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/observation_noise.hpp"
#include "jobs/reading_notes.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd read_states(const Prior& prior, const View& view, LogReader& reader, bool needs_residuals) {
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

MatrixXd stated_state_deviations(const System& system, LogReader& reader) {
  const std::vector<std::string> names = system.state_names();
  MatrixXd stddevs = MatrixXd::Constant(2 * system.nq(), reader.table().n_rows(), not_a_number);
  bool is_stated = false;
  for (Index k = 0; k < stddevs.rows(); ++k) {
    const std::string& name = names[static_cast<std::size_t>(k)];
    if (reader.stddev_column(name).empty()) continue;
    stddevs.row(k) = reader.stddevs({name});
    is_stated = true;
  }
  return is_stated ? stddevs : MatrixXd();
}

void move_onto_constraints(const System& system, const VectorXd& parameters, const CsvTable& log, const MatrixXd& stddevs,
                           MatrixXd& states, std::vector<std::string>& notes) {
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

LogStates read_log_states(const Prior& prior, const View& view, const Model& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations,
                          const std::optional<std::vector<Actuator>>& actuators, const std::optional<VectorXd>& given,
                          bool projects) {
  LogReader reader = open_log(model, log, columns);
  LogStates out{read_states(prior, view, reader, projects), reader.measurements(accelerations), {}, {}};
  const std::vector<std::string> stated = stated_accelerations(accelerations, reader);
  if (!stated.empty()) out.stated_stddev = stated_stddevs(model, accelerations, reader, log.n_rows());
  const std::optional<CommandedRows> commanded =
      take_commands(*prior.system, without_estimates(actuators.value_or(model.actuators)), reader, std::nullopt, columns,
                    out.states, out.notes);
  if (commanded) clear_unknown(*commanded, log, out.accelerations, out.notes);
  const MatrixXd state_stddevs = projects ? stated_state_deviations(*prior.system, reader) : MatrixXd();
  note_reading(reader, out.notes);
  const VectorXd parameters = given.value_or(prior.system->parameter_values());
  if (projects) move_onto_constraints(*prior.system, parameters, log, state_stddevs, out.states, out.notes);
  note_violation(*prior.system, out.states, parameters, log.name(), out.notes);
  if (!accelerations.empty()) note_rest(model, parameters, out.states, out.accelerations, log.name(), out.notes);
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
  note_violation(system, out.states, parameters, log.name(), out.notes);
  return out;
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
