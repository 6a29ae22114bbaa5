#include "gp2/jobs/check_job.hpp"

#include <algorithm>
#include <memory>
#include <optional>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct CheckArguments {
  std::string model, data;
  bool json = false;
  CheckOptions options;
};

const char* word_of(Finding::Level level) {
  return level == Finding::Level::good ? "ok" : level == Finding::Level::warning ? "warning" : "error";
}

int count(const std::vector<Finding>& findings, Finding::Level level) {
  return static_cast<int>(
      std::count_if(findings.begin(), findings.end(), [&](const Finding& one) { return one.level == level; }));
}

void print_as_json(const std::vector<Finding>& findings) {
  nlohmann::ordered_json list = nlohmann::ordered_json::array();
  for (const Finding& finding : findings) list.push_back({{"level", word_of(finding.level)}, {"text", with_flags(finding.text)}});
  print_json({{"errors", count(findings, Finding::Level::error)},
              {"warnings", count(findings, Finding::Level::warning)},
              {"findings", list}});
}

void print(const std::vector<Finding>& findings) {
  for (const Finding& finding : findings) {
    const char* mark = finding.level == Finding::Level::good      ? "ok     "
                       : finding.level == Finding::Level::warning ? "warning"
                                                                  : "ERROR  ";
    print_result("{}  {}\n", mark, with_flags(finding.text));
  }
}

void run(const CheckArguments& arguments) {
  const Model model = Model::read(arguments.model);
  std::optional<CsvTable> log;
  if (!arguments.data.empty()) log = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  const std::vector<Finding> findings = check(model, log ? &*log : nullptr, arguments.options);
  (arguments.json ? print_as_json : print)(findings);
  if (const int n_errors = count(findings, Finding::Level::error); n_errors > 0)
    throw InputError(fmt::format("{}: {} of the checks failed", arguments.model, n_errors));
}

}  // namespace

Command check_command() {
  const auto a = std::make_shared<CheckArguments>();
  return {"check",
          "Check a model, and a log against it: rank, definiteness, derivatives, constraint residuals, dependent columns",
          "gp2 check models/double_pendulum.toml --data train.csv",
          joined({{argument("MODEL", a->model, "model file"),
                   {"data", &a->data, "CSV", "CSV log", "states of the model's [sampling] or [motion]"}},
                  options(a->options),
                  {{"json", &a->json, "", "print the findings as JSON"}}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
