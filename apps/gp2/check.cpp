#include "gp2/jobs/check_job.hpp"

#include <memory>
#include <optional>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct CheckArguments {
  std::string model, data;
  CheckOptions options;
};

int print(const std::vector<Finding>& findings) {
  int n_errors = 0;
  for (const Finding& finding : findings) {
    const char* mark = finding.level == Finding::Level::good      ? "ok     "
                       : finding.level == Finding::Level::warning ? "warning"
                                                                  : "ERROR  ";
    print_result("{}  {}\n", mark, with_flags(finding.text));
    if (finding.level == Finding::Level::error) ++n_errors;
  }
  return n_errors;
}

void run(const CheckArguments& arguments) {
  const Model model = Model::read(arguments.model);
  std::optional<CsvTable> log;
  if (!arguments.data.empty()) log = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  const int n_errors = print(check(model, log ? &*log : nullptr, arguments.options));
  if (n_errors > 0) throw InputError(fmt::format("{}: {} of the checks failed", arguments.model, n_errors));
}

}  // namespace

Command check_command() {
  const auto a = std::make_shared<CheckArguments>();
  Command command{
      "check",
      "Is a model well-posed, and does a log fit it? Rank, definiteness, derivatives, data on the constraint, dependent columns",
      "gp2 check models/double_pendulum.toml --data train.csv",
      {},
      {}};
  command.options = {argument("MODEL", a->model, "model file"),
                     {"data", &a->data, "CSV", "CSV log", "states of the model's [sampling] or [motion]"}};
  for (Option& option : options(a->options)) command.options.push_back(std::move(option));
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
