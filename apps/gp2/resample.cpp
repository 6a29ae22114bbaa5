#include "gp2/jobs/resample.hpp"

#include <memory>

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
  print_notes(resample_notes(chosen, log, arguments.output));
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
