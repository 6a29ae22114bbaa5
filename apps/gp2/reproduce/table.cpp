#include "reproduce/table.hpp"

#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"

namespace gp2::command {

namespace {

std::string cell(const Table::Row& value) {
  if (value.is_null()) return "";
  if (value.is_number_float()) return shortest(value.get<double>());
  return value.is_string() ? csv_cell(value.get<std::string>()) : value.dump();
}

}  // namespace

void Table::write(const std::filesystem::path& stem) const {
  std::string csv;
  nlohmann::ordered_json json = nlohmann::ordered_json::array();
  for (const Row& row : rows_) {
    std::vector<std::string> names, cells;
    for (const auto& [name, value] : row.items()) {
      names.push_back(name);
      cells.push_back(cell(value));
    }
    if (csv.empty()) csv = fmt::format("{}\n", fmt::join(names, ","));
    csv += fmt::format("{}\n", fmt::join(cells, ","));
    json.push_back(row);
  }
  write_file(stem.string() + ".csv", csv);
  write_file(stem.string() + ".json", json.dump(1) + "\n");
}

nlohmann::ordered_json number_or_null(double value) {
  return std::isfinite(value) ? nlohmann::ordered_json(value) : nlohmann::ordered_json();
}

}  // namespace gp2::command
