#include "jobs/log_columns.hpp"

#include <algorithm>
#include <iterator>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 {

namespace {

// Whether a log has what `columns` calls this name of the model. A log may lack a coordinate that nothing reads, but then it has the
// coordinate's derivatives.
bool has_column(const System& system, const CsvTable& log, const std::string& name, const std::string& column) {
  std::vector<std::string> meant = {column};
  if (std::ranges::count(system.coordinates(), name, &Coordinate::name) > 0) {
    meant = {column, "d" + column, "dd" + column, column + "_dot", column + "_ddot"};
  }
  return std::ranges::any_of(meant, [&](const std::string& one) { return log.find(one) >= 0; });
}

}  // namespace

std::map<std::string, std::string> columns_of(const Model& model, std::map<std::string, std::string> columns) {
  columns.insert(model.columns.begin(), model.columns.end());
  return columns;
}

void check_columns(const System& system, const std::vector<const CsvTable*>& logs,
                   const std::map<std::string, std::string>& columns) {
  std::vector<std::string> known = system.state_names();
  for (const std::string& name : system.acceleration_names()) known.push_back(name);
  for (const auto& [name, column] : columns) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      throw InputError(fmt::format("`map={}={}`: '{}' is neither a state nor an acceleration of '{}'; it has: {}", column, name,
                                   name, system.name(), fmt::join(known, ", ")));
    }
    std::vector<std::string> lacking;
    for (const CsvTable* log : logs) {
      if (has_column(system, *log, name, column)) break;
      lacking.push_back(fmt::format("{} has no column '{}'; it has: {}", log->name(), column, fmt::join(log->header(), ", ")));
    }
    if (!logs.empty() && lacking.size() == logs.size())
      throw InputError(fmt::format("`map={}={}`: {}", column, name, fmt::join(lacking, "; ")));
  }
}

std::map<std::string, std::string> columns_in(const std::vector<const CsvTable*>& logs, const System& system,
                                              std::map<std::string, std::string> columns) {
  std::erase_if(columns, [&](const auto& entry) {
    return std::ranges::none_of(logs, [&](const CsvTable* log) { return has_column(system, *log, entry.first, entry.second); });
  });
  return columns;
}

std::map<std::string, std::string> checked_columns(const Model& model, const std::vector<const CsvTable*>& logs,
                                                   const std::map<std::string, std::string>& columns) {
  check_columns(*model.system, logs, columns);
  return columns_of(model, columns);
}

LogReader open_log(const Model& model, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  return {log, *model.system, checked_columns(model, {&log}, columns)};
}

bool has_values(LogReader& reader, const std::string& name) { return reader.column(name) >= 0 && reader.measures(name); }

void note_reading(const LogReader& reader, std::vector<std::string>& notes) {
  const CsvTable& log = reader.table();
  std::ranges::move(reader.notes(), std::back_inserter(notes));
  std::vector<std::string> unused = reader.unused_columns();
  // an empty one may be needed where it has values
  std::erase_if(unused, [&](const std::string& name) { return log.is_empty(log.find(name)); });
  if (!unused.empty()) notes.push_back(fmt::format("{}: columns not needed: {}", log.name(), fmt::join(unused, ", ")));
}

std::vector<std::string> outputs_to_compare(const Posterior& posterior, const Model& model, const CsvTable& log,
                                            const std::map<std::string, std::string>& columns, std::vector<std::string>& notes) {
  const System& system = *model.system;
  const LogReader reader = open_log(model, log, columns);
  const std::vector<int> observed = observed_rows(posterior);
  const std::vector<std::string> every = system.acceleration_names();
  std::vector<std::string> outputs, not_in_log, not_observed;
  for (int row = 0; row < system.nq(); ++row) {
    const std::string& name = every[static_cast<std::size_t>(row)];
    const bool is_observed = std::find(observed.begin(), observed.end(), row) != observed.end();
    const bool is_measured = reader.measures(name);
    if (is_observed) (is_measured ? outputs : not_in_log).push_back(name);
    if (!is_observed && is_measured) not_observed.push_back(name);
  }
  if (outputs.empty()) return observed.empty() ? every : not_in_log;  // what reads them names what is missing
  if (!not_in_log.empty())
    notes.push_back(fmt::format("{}: not compared: {}, which it lacks", log.name(), fmt::join(not_in_log, ", ")));
  if (!not_observed.empty()) {
    notes.push_back(fmt::format("{}: not compared: {}, which the fit did not observe; `outputs` of an evaluation chooses others",
                                log.name(), fmt::join(not_observed, ", ")));
  }
  return outputs;
}

}  // namespace gp2
