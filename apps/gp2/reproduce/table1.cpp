#include <algorithm>
#include <numeric>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "reproduce/experiment.hpp"
#include "reproduce/table.hpp"
#include "streams.hpp"

// Table 1 of Geist & Trimpe 2020.
namespace gp2::command {

namespace {

using Json = nlohmann::ordered_json;

/// One number of the table before it is averaged over runs.
struct Cell {
  std::string system, protocol, method;
  int run = 0;
  Score score;
};

Table::Row row_of(const Cell& cell) {
  return {{"system", cell.system},
          {"protocol", cell.protocol},
          {"method", cell.method},
          {"run", cell.run},
          {"rmse_normalised", number_or_null(cell.score.rmse_normalised)},
          {"max_constraint_error", cell.score.max_constraint_error},
          {"nll", number_or_null(cell.score.negative_log_likelihood)},
          {"seconds", cell.score.seconds}};
}

// what a system's published file says of a method: errors per run, as recomputed at the published hyperparameters or, where those
// were not kept, as published
std::vector<double> published_errors(const Json& published, const std::string& system, const std::string& method) {
  if (!published.contains(system) || !published[system].contains(method)) return {};
  const Json& of_method = published[system][method];
  for (const char* source : {"recomputed_at_published_hyperparameters", "published_arrays"}) {
    if (!of_method.contains(source) || !of_method[source].is_object()) continue;
    const Json& arrays = of_method[source];
    if (arrays.contains("rmse_per_run")) return arrays["rmse_per_run"].get<std::vector<double>>();
  }
  return {};
}

Json published_table(const std::optional<std::filesystem::path>& data) {
  if (!data || !std::filesystem::exists(*data / "table1.json")) return Json::object();
  Json json = Json::parse(read_file(*data / "table1.json"), nullptr, false);
  if (json.is_discarded()) throw InputError(fmt::format("{}: not valid JSON", (*data / "table1.json").string()));
  return json;
}

struct Summary {
  double mean = 0, smallest = 0, largest = 0;
};

Summary summarise(const std::vector<double>& values) {
  const auto [smallest, largest] = std::minmax_element(values.begin(), values.end());
  return {std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size()), *smallest, *largest};
}

// ours beside the printed value, and beside the published runs we used
Table::Row cell_of(const std::vector<Cell>& runs, std::size_t method_index, const Section& definition, const Json& published) {
  const Cell& first = runs.front();
  std::vector<double> errors;
  double constraint_error = 0, seconds = 0;
  for (const Cell& cell : runs) {
    errors.push_back(cell.score.rmse_normalised);
    constraint_error = std::max(constraint_error, cell.score.max_constraint_error);
    seconds += cell.score.seconds;
  }
  const Summary ours = summarise(errors);
  Table::Row row = {{"system", first.system},
                    {"protocol", first.protocol},
                    {"method", first.method},
                    {"method_index", method_index},
                    {"runs", runs.size()},
                    {"rmse_mean", number_or_null(ours.mean)},
                    {"rmse_min", number_or_null(ours.smallest)},
                    {"rmse_max", number_or_null(ours.largest)},
                    {"max_constraint_error", constraint_error},
                    {"seconds", seconds},
                    {"printed_rmse_mean", nullptr},
                    {"printed_rmse_min", nullptr},
                    {"printed_rmse_max", nullptr},
                    {"printed_max_constraint_error", nullptr},
                    {"published_rmse_mean_same_runs", nullptr},
                    {"note", ""}};
  if (definition.has("printed") && definition.section("printed").has(first.system)) {
    const Section of_system = definition.section("printed").section(first.system);
    if (of_system.has(first.method)) {
      const Section printed = of_system.section(first.method);
      if (printed.has("rmse")) {
        const std::vector<double> rmse = printed.numbers("rmse", 3);
        row["printed_rmse_mean"] = rmse[0];
        row["printed_rmse_min"] = rmse[1];
        row["printed_rmse_max"] = rmse[2];
      }
      row["printed_max_constraint_error"] = printed.number("max_constraint_error");
    }
  }
  std::vector<double> theirs = published_errors(published, first.system, first.method);
  if (theirs.size() >= runs.size()) {
    theirs.resize(runs.size());
    row["published_rmse_mean_same_runs"] = summarise(theirs).mean;
  }
  if (definition.has("note") && definition.section("note").has(first.system)) {
    row["note"] = definition.section("note").section(first.system).text(first.method, "");
  }
  return row;
}

void print(const std::vector<Table::Row>& cells) {
  const auto shown = [](const Json& value, const char* format) {
    return value.is_null() ? std::string("-") : fmt::format(fmt::runtime(format), value.get<double>());
  };
  print_result("{:<9} {:<8} {:<16} {:>28} {:>10} {:>28} {:>12}\n", "system", "protocol", "method", "rmse mean [min, max]",
               "published", "printed mean [min, max]", "|A ddq − b|");
  for (const Table::Row& row : cells) {
    const auto range = [&](const std::string& prefix) {
      if (row[prefix + "rmse_mean"].is_null()) return std::string("-");
      return fmt::format("{:.4g} [{:.4g}, {:.4g}]", row[prefix + "rmse_mean"].get<double>(),
                         row[prefix + "rmse_min"].get<double>(), row[prefix + "rmse_max"].get<double>());
    };
    print_result("{:<9} {:<8} {:<16} {:>28} {:>10} {:>28} {:>12}\n", row["system"].get<std::string>(),
                 row["protocol"].get<std::string>(), row["method"].get<std::string>(), range(""),
                 shown(row["published_rmse_mean_same_runs"], "{:.4g}"), range("printed_"),
                 shown(row["max_constraint_error"], "{:.2g}"));
  }
}

}  // namespace

void reproduce_table1(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "table1.toml");
  const std::vector<Method> methods = methods_of(definition);
  const Json published = published_table(options.data);
  std::vector<Cell> cells;
  // what is wrong with the definition, or too many runs asked for, is said before the first fit
  std::vector<int> n_runs;
  std::vector<ExperimentSystem> systems;
  const std::vector<Section> sections = definition.sections("system");
  for (const Section& section : sections) {
    n_runs.push_back(number_of_runs(section.text("data"), options.data, options.runs, definition.integer("runs")));
    systems.emplace_back(section, options.experiments, methods);
  }
  const int n = definition.integer("n");
  for (std::size_t s = 0; s < sections.size(); ++s) {
    const ExperimentSystem& system = systems[s];
    for (int run = 0; run < n_runs[s]; ++run) {
      const CsvTable log = observations_of(system.model, sections[s].text("data"), options.data, run, n);
      for (const Method& method : methods) {
        if (progress_is_due())
          print_progress(fmt::format("table1: {} run {}/{}: {}", system.name, run + 1, n_runs[s], method.name));
        // a method that knows no protocol is trained once, and stands under each
        std::optional<Score> score;
        for (const Protocol::Name protocol : options.protocols) {
          if (!score || method.has_protocol()) score = score_of(system, method, protocol, log, run, options.threads);
          cells.push_back({system.name, word(protocol), method.name, run, *score});
        }
      }
    }
  }
  end_progress();

  Table runs, summary;
  for (const Cell& cell : cells) runs.add(row_of(cell));
  runs.write(options.output / "table1");
  for (const Protocol::Name protocol : options.protocols) {
    for (const Section& section : sections) {
      for (std::size_t m = 0; m < methods.size(); ++m) {
        std::vector<Cell> of_cell;
        std::copy_if(cells.begin(), cells.end(), std::back_inserter(of_cell), [&](const Cell& cell) {
          return cell.system == section.text("name") && cell.method == methods[m].name && cell.protocol == word(protocol);
        });
        summary.add(cell_of(of_cell, m, definition, published));
      }
    }
  }
  summary.write(options.output / "table1_cells");
  print(summary.rows());
  plot(options, "table1");
}

}  // namespace gp2::command
