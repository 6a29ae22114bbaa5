#include "gp2/jobs/check_job.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/jobs/fit_problem.hpp"
#include "gp2/prior.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/projected_states.hpp"

namespace gp2 {

namespace {

using Level = Finding::Level;

void append(std::vector<Finding>& findings, std::vector<Finding> more) {
  for (Finding& finding : more) findings.push_back(std::move(finding));
}

bool has_error(const std::vector<Finding>& findings) {
  return std::any_of(findings.begin(), findings.end(), [](const Finding& one) { return one.level == Level::error; });
}

void check_model(const Model& model, std::vector<Finding>& findings) {
  const System& system = *model.system;
  findings.push_back({Level::good, fmt::format("{}: '{}', {} coordinates, {} constraints", model.name, system.name(), system.nq(),
                                               system.nc())});
  if (!model.robot) return;
  for (const std::string& note : model.robot->notes) findings.push_back({Level::good, note});
}

// A column that is missing is an error only where the model cannot do without.
void check_columns_of(const CsvTable& table, const LogReader& reader, const WholeLog& log, const System& system,
                      std::vector<Finding>& findings) {
  const std::vector<std::string> accelerations = system.acceleration_names();
  const auto good = [&](std::string text) { findings.push_back({Level::good, std::move(text)}); };
  good(fmt::format("{}: {} rows, every column found that the model reads", table.name(), table.n_rows()));
  if (!log.missing.empty()) {
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
  for (const auto& [name, found] : reader.aliases_used()) good(fmt::format("column '{}' taken as {}", found, name));
  const std::vector<std::string> unused = reader.unused_columns();
  if (!unused.empty()) good(fmt::format("columns not needed: {}", fmt::join(unused, ", ")));
}

// The system, and where that is sound what the prior asks of it.
void check_mechanics(const Model& model, const Eigen::MatrixXd& states, std::vector<Finding>& findings) {
  const System& system = *model.system;
  append(findings, check_system(system, states, system.parameter_values()));
  if (has_error(findings)) return;
  MechanicsBatch mechanics;
  evaluate_mechanics(make_prior(model), View::constrained_acceleration(system), states, system.parameter_values(), mechanics);
  if (!mechanics.fault) return;
  findings.push_back({Level::error, fmt::format("{} at state {}", mechanics.fault->text, mechanics.fault->state + 1)});
}

void check_log(const Model& model, const CsvTable& table, const CheckOptions& options, std::vector<Finding>& findings) {
  const System& system = *model.system;
  LogReader reader = open_log(model, table, options.columns);
  const WholeLog log = read_whole_log(model, reader);
  check_columns_of(table, reader, log, system, findings);
  check_mechanics(model, log.states, findings);
  if (has_error(findings)) return;
  append(findings, check_data(system, log.states, system.parameter_values(), log.accelerations, log.stated));
  append(findings, check_states(system, log.states, system.parameter_values()));
}

}  // namespace

std::vector<Option> options(CheckOptions& options) {
  return {{"map", &options.columns, "LOGNAME=NAME,…", "columns by other names: theta1 for q3 also brings dtheta1, ddtheta1", "",
           "columns"}};
}

std::vector<Finding> check(const Model& model, const CsvTable* log, const CheckOptions& options) {
  std::vector<Finding> findings;
  check_model(model, findings);
  if (log != nullptr) {
    check_log(model, *log, options, findings);
  } else if ((!model.sampling.empty() || model.motion) && !model.truth.empty()) {
    check_mechanics(model, generate(model, {100, 1, Eigen::VectorXd::Zero(model.system->nq())}).states, findings);
  } else {
    findings.push_back(
        {Level::warning, "no `data`, and neither [sampling] nor [motion] in the model: nothing to evaluate it at"});
  }
  return findings;
}

}  // namespace gp2
