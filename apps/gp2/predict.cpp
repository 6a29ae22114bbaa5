#include <algorithm>
#include <memory>
#include <optional>
#include <utility>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
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

void run(PredictArguments& arguments) {
  require_output(arguments.output, {arguments.fit, arguments.states, arguments.system});
  PredictRequest& request = arguments.request;
  const FitFile fit = FitFile::read(arguments.fit);
  // a file is read a second time for what is written in it, so that no more than numbers are in memory
  const std::optional<FileVersion> version = file_version(arguments.states);
  CsvTable table = CsvTable::read(arguments.states, version ? CsvTable::Keep::numbers : CsvTable::Keep::text);
  const CsvTable text = version ? CsvTable() : table;
  const std::vector<std::string> header = table.header();
  const int n_rows = table.n_rows();
  request.view.system = read_other_system(arguments.system);
  const PredictOutcome predictions = predict(fit, std::move(table), request);
  print_notes(predictions.notes);

  write_csv(arguments.output, [&](CsvWriter& csv) {
    for (const std::string& name : kept_names(header, predictions.names)) csv.add(name);
    for (const std::string& name : predictions.names) csv.add(name);
    csv.end_line();
    int row = 0;
    const auto add_predictions = [&] {
      for (const double value : predictions.values.col(row)) csv.add(value);
      csv.end_line();
      ++row;
    };
    if (!version) {
      while (row < n_rows) {
        for (int column = 0; column < text.n_columns(); ++column) csv.add(text.cell(row, column));
        add_predictions();
      }
      return;
    }
    for_each_row(arguments.states, [&](std::string_view cells) {
      if (row == n_rows) throw_changed(arguments.states);
      csv.add_printed(cells);
      add_predictions();
    });
    if (row != n_rows || file_version(arguments.states) != version) throw_changed(arguments.states);
  });
  if (request.potential) return print_notes({fmt::format("{}: the potential at {} states", arguments.output, n_rows)});
  print_notes({request.inverse_dynamics
                   ? fmt::format("{}: inputs at {} states", arguments.output, n_rows)
                   : fmt::format("{}: {} predictions, view {}", arguments.output, n_rows, request.view.quantity->word())});
}

}  // namespace

Command predict_command() {
  const auto a = std::make_shared<PredictArguments>();
  return {"predict", "Predict accelerations at given states, with their uncertainty",
          "gp2 predict fit.json --states states.csv --cov std -o prediction.csv",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit"),
                   required({"states", &a->states, "CSV", "CSV with the states; one output row per input row"}),
                   {"system", &a->system, "OTHER.toml", system_help}},
                  options(a->request),
                  {output(a->output, "CSV", "CSV file to write")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
