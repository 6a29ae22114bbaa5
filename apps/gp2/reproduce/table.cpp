#include "reproduce/table.hpp"

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"

namespace gp2::command {

namespace {

void print_cell(const Table::Row& value, CsvWriter& csv) {
  if (value.is_number_float()) {
    csv.add(value.get<double>());
  } else {
    csv.add(value.is_null() ? "" : value.is_string() ? value.get<std::string>() : value.dump());
  }
}

}  // namespace

void Table::write(const std::filesystem::path& stem) const {
  write_csv(stem.string() + ".csv", [&](CsvWriter& csv) {
    if (rows_.empty()) return;
    for (const auto& [name, value] : rows_.front().items()) csv.add(name);
    csv.end_line();
    for (const Row& row : rows_) {
      for (const auto& [name, value] : row.items()) print_cell(value, csv);
      csv.end_line();
    }
  });
  write_file(stem.string() + ".json", nlohmann::ordered_json(rows_).dump(1) + "\n");
}

}  // namespace gp2::command
