#include "gp2/mechanics/check.hpp"

#include <limits>
#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/prior.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/projected_states.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string model, data, map;
};

int print(const std::vector<Finding>& findings) {
  int n_errors = 0;
  for (const Finding& finding : findings) {
    const char* mark = finding.level == Finding::Level::good      ? "ok     "
                       : finding.level == Finding::Level::warning ? "warning"
                                                                  : "ERROR  ";
    fmt::print("{}  {}\n", mark, finding.text);
    if (finding.level == Finding::Level::error) ++n_errors;
  }
  return n_errors;
}

// a column that is missing is an error only where the model cannot do without
WholeLog read_log(const Model& model, const Arguments& arguments) {
  const CsvTable table = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  LogReader reader = open_log(model, table, parse_map(arguments.map));
  WholeLog log = read_whole_log(model, reader);
  fmt::print("ok       {}: {} rows, every column found that the model reads\n", arguments.data, table.n_rows());
  if (!log.missing.empty()) {
    fmt::print("warning  not in the log: {}; fit with --observe for the others\n", fmt::join(log.missing, ", "));
  }
  if (!log.stated.empty()) {
    std::vector<std::string> names;
    for (const int row : log.stated) names.push_back(model.system->acceleration_names()[static_cast<std::size_t>(row)]);
    fmt::print("ok       noise of each value: {}, which a fit observes\n", fmt::join(names, ", "));
  }
  for (int row = 0; row < model.system->nq(); ++row) {
    const auto values = log.accelerations.row(row).array();
    const auto n_missing = values.isNaN().count();
    const std::string name = model.system->acceleration_names()[static_cast<std::size_t>(row)];
    if (n_missing == 0 || n_missing == values.size()) continue;
    fmt::print("ok       {} of {} values of {} are not measured: their cells are empty\n", n_missing, values.size(), name);
  }
  for (const auto& [name, found] : reader.aliases_used()) fmt::print("ok       column '{}' taken as {}\n", found, name);
  const std::vector<std::string> unused = reader.unused_columns();
  if (!unused.empty()) fmt::print("ok       columns not needed: {}\n", fmt::join(unused, ", "));
  return log;
}

// the system, and where that is sound what the prior asks of it
int check_mechanics(const Model& model, const Eigen::MatrixXd& states) {
  const System& system = *model.system;
  const int n_errors = print(check_system(system, states, system.parameter_values()));
  if (n_errors > 0) return n_errors;
  MechanicsBatch mechanics;
  evaluate_mechanics(make_prior(model), View::constrained_acceleration(system), states, system.parameter_values(), mechanics);
  if (!mechanics.fault) return 0;
  return print({{Finding::Level::error, fmt::format("{} at state {}", mechanics.fault->text, mechanics.fault->state + 1)}});
}

void run(const Arguments& arguments) {
  const Model model = Model::read(arguments.model);
  const System& system = *model.system;
  fmt::print("ok       {}: '{}', {} coordinates, {} constraints\n", arguments.model, system.name(), system.nq(), system.nc());
  if (model.robot) {
    for (const std::string& note : model.robot->notes) fmt::print("ok       {}\n", note);
  }
  int n_errors = 0;
  if (!arguments.data.empty()) {
    const WholeLog log = read_log(model, arguments);
    n_errors += check_mechanics(model, log.states);
    if (n_errors == 0) {
      n_errors += print(check_data(system, log.states, system.parameter_values(), log.accelerations, log.stated));
      n_errors += print(check_states(system, log.states, system.parameter_values()));
    }
  } else if ((!model.sampling.empty() || model.motion) && !model.truth.empty()) {
    const GeneratedData data = generate(model, {100, 1, Eigen::VectorXd::Zero(system.nq())});
    n_errors += check_mechanics(model, data.states);
  } else {
    fmt::print("warning  no --data, and neither [sampling] nor [motion] in the model: nothing to evaluate it at\n");
  }
  if (n_errors > 0) throw InputError(fmt::format("{}: {} of the checks failed", arguments.model, n_errors));
}

}  // namespace

void add_check(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "check",
      "Is a model well-posed, and does a log fit it? Rank, definiteness, derivatives, data on the constraint, dependent columns");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("MODEL", arguments->model, "model file")->required();
  command->add_option("--data", arguments->data, "CSV log (default: states of the model's [sampling] or [motion])");
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->footer("Example:\n  gp2 check models/double_pendulum.toml --data train.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
