#pragma once

#include <cmath>
#include <filesystem>
#include <initializer_list>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

namespace gp2::command {

/// A number, or null where it is not finite: an empty cell of a table.
inline nlohmann::ordered_json number_or_null(double value) {
  return std::isfinite(value) ? nlohmann::ordered_json(value) : nlohmann::ordered_json();
}

/// A table of results, written as CSV (an empty cell is nothing) and as JSON, a list of objects (null).
class Table {
 public:
  using Row = nlohmann::ordered_json;  // an object with a value per column

  void add(Row row) { rows_.push_back(std::move(row)); }
  [[nodiscard]] const std::vector<Row>& rows() const { return rows_; }
  [[nodiscard]] Row& row(std::size_t i) { return rows_[i]; }
  /// stem.csv and stem.json; the columns are those of the first row.
  void write(const std::filesystem::path& stem) const;

 private:
  std::vector<Row> rows_;
};

}  // namespace gp2::command
