#include <algorithm>
#include <cstdint>
#include <memory>
#include <optional>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/predict_job.hpp"

namespace gp2::command {

namespace {

struct PredictArguments {
  std::string fit, states, output, system;
  PredictRequest request;
};

// Input columns of the names of new ones become NAME_input; NAME_input_input where the input is itself such an output.
std::vector<std::string> kept_names(const std::vector<std::string>& input, const std::vector<std::string>& added) {
  const auto holds = [](const std::vector<std::string>& names, const std::string& name) {
    return std::find(names.begin(), names.end(), name) != names.end();
  };
  std::vector<std::string> kept = input;
  for (std::string& name : kept) {
    if (!holds(added, name)) continue;
    std::string other = name + "_input";
    while (holds(kept, other) || holds(added, other)) other += "_input";
    name = other;
  }
  return kept;
}

// the input as it was, then the new columns
void print_joined(const CsvTable& input, const PredictOutcome& added, CsvWriter& csv) {
  for (const std::string& name : kept_names(input.header(), added.names)) csv.add(name);
  for (const std::string& name : added.names) csv.add(name);
  csv.end_line();
  for (int i = 0; i < input.n_rows(); ++i) {
    for (int column = 0; column < input.n_columns(); ++column) csv.add(input.cell(i, column));
    for (const double value : added.values.col(i)) csv.add(value);
    csv.end_line();
  }
}

void run(PredictArguments& arguments) {
  require_output(arguments.output, {arguments.fit, arguments.states, arguments.system});
  PredictRequest& request = arguments.request;
  const FitFile fit = FitFile::read(arguments.fit);
  const CsvTable table = CsvTable::read(arguments.states);
  request.view.system = read_other_system(arguments.system);
  const PredictOutcome predictions = predict(fit, table, request);
  print_notes(predictions.notes);
  write_csv(arguments.output, [&](CsvWriter& csv) { print_joined(table, predictions, csv); });
  print_notes({fmt::format("{}: {} predictions, view {}", arguments.output, table.n_rows(), request.view.quantity->word())});
}

}  // namespace

Command predict_command() {
  const auto a = std::make_shared<PredictArguments>();
  Command command{"predict",
                  "Predict accelerations at given states, with their uncertainty",
                  "gp2 predict fit.json --states states.csv --cov std -o prediction.csv",
                  {},
                  {}};
  command.options = {argument("FIT.json", a->fit, "file written by gp2 fit"),
                     required({"states", &a->states, "CSV", "CSV with the states; one output row per input row"}),
                     {"system", &a->system, "OTHER.toml", system_help}};
  for (Option& option : options(a->request)) command.options.push_back(std::move(option));
  command.options.push_back(output(a->output, "CSV", "CSV file to write"));
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
