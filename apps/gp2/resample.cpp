#include "gp2/jobs/resample.hpp"

#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"

namespace gp2::command {

namespace {

struct ResampleArguments {
  std::string log, model, output;
  ResampleOptions options;
};

void run(const ResampleArguments& arguments) {
  require_output(arguments.output, {arguments.log, arguments.model});
  const Model model = Model::read(arguments.model);
  const CsvTable log = CsvTable::read(arguments.log);
  const Resample chosen = resample(model, log, arguments.options);
  log.take(chosen.rows).write(arguments.output);
  if (chosen.n_skipped > 0)
    print_notes({fmt::format("{}: {} rows skipped: a feature has no value", arguments.log, chosen.n_skipped)});
  print_notes({fmt::format("distances are in {}, each divided by its standard deviation", fmt::join(chosen.features, ", ")),
               fmt::format("{}: {} of {} rows; every other row is within {:.3g} of one of them", arguments.output,
                           chosen.rows.size(), log.n_rows(), chosen.radius)});
  const auto n_repeating = (chosen.distance.array() == 0).count() - 1;  // the first has none before it
  if (n_repeating > 0)
    print_notes(
        {fmt::format("the last {} rows repeat those before them in every feature: fewer cover the log as well", n_repeating)});
}

}  // namespace

Command resample_command() {
  const auto a = std::make_shared<ResampleArguments>();
  Option n = required({"n", &a->options.n, "N", "number of rows"});
  n.flag = "-n,--n";
  return {"resample", "Choose the rows of a log that best cover its states (farthest-point sampling in the model's features)",
          "gp2 resample log.csv --model models/surface.toml -n 50 -o subset.csv",
          joined({{argument("LOG", a->log, "CSV log"), required({"model", &a->model, "MODEL", "model file"}), std::move(n)},
                  options(a->options),
                  {output(a->output, "CSV", "CSV file to write: complete rows in the order chosen")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
