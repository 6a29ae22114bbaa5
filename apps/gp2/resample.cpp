#include "gp2/jobs/resample.hpp"

#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string log, model, features, map, output;
  int n = 0;
  std::optional<std::uint64_t> seed;
};

// as parse_list, but a comma between parentheses, atan2(dq2, dq1), separates nothing
std::vector<std::string> parse_expressions(const std::string& text) {
  std::vector<std::string> expressions;
  int depth = 0;
  std::string expression;
  for (const char c : text + ",") {
    if (c == '(') ++depth;
    if (c == ')') --depth;
    if (c != ',' || depth > 0) {
      expression += c;
    } else {
      const std::size_t first = expression.find_first_not_of(' ');
      if (first != std::string::npos)
        expressions.push_back(expression.substr(first, expression.find_last_not_of(' ') + 1 - first));
      expression.clear();
    }
  }
  if (!expression.empty()) throw InputError(fmt::format("--features: a parenthesis is not closed in '{}'", text));
  return expressions;
}

void run(const Arguments& arguments) {
  require_output(arguments.output, {arguments.log, arguments.model});
  const Model model = Model::read(arguments.model);
  const CsvTable log = CsvTable::read(arguments.log);
  ResampleOptions options;
  options.n = arguments.n;
  options.features = parse_expressions(arguments.features);
  options.seed = arguments.seed;
  options.columns = parse_map(arguments.map);
  const Resample chosen = resample(model, log, options);
  write_file(arguments.output, log.take(chosen.rows).text());
  if (chosen.n_skipped > 0)
    talk({fmt::format("{}: {} rows skipped: no number in some feature", arguments.log, chosen.n_skipped)});
  talk({fmt::format("measured by {}, each in its standard deviations", fmt::join(chosen.features, ", ")),
        fmt::format("{}: {} of {} rows; every other row is within {:.3g} of one of them", arguments.output, chosen.rows.size(),
                    log.n_rows(), chosen.radius)});
}

}  // namespace

void add_resample(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "resample", "Choose the rows of a log that cover its states best: farthest points in the model's features");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("LOG", arguments->log, "CSV log")->required();
  command->add_option("--model", arguments->model, "model file")->required();
  command->add_option("-n,--n", arguments->n, "number of rows")->required();
  command->add_option("--features", arguments->features,
                      "expressions to measure by, \"q1,dq1,u1\" (default: the features of the model's first latent)");
  command->add_option("--seed", arguments->seed, "start at a random row (default: at the row nearest to the mean)")
      ->check(not_negative());
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_option("-o,--output", arguments->output, "CSV file to write: whole rows in the order of choice")->required();
  command->footer("Example:\n  gp2 resample log.csv --model models/surface.toml -n 50 -o subset.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
