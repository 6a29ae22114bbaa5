#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

#include "gp2/base/file.hpp"

namespace gp2 {

/// A table of comma-separated values with one header line. Cells may be quoted; blank lines are skipped. Cells stay text until
/// they are asked for as numbers, so columns that are not needed may hold anything. A table has at most `max_columns`, their
/// names at most `max_name_length` bytes: what has more is no table.
class CsvTable {
 public:
  static constexpr std::size_t max_columns = 10'000;
  static constexpr std::size_t max_name_length = 1000;

  /// @throws InputError naming file and line: unreadable or empty file, no data rows, ragged row, too many columns, a column
  ///   name that is empty, repeated or too long.
  static CsvTable read(const std::filesystem::path& path);
  /// @param name  stands for the file in messages
  static CsvTable parse(std::string_view text, std::string name);
  /// From cells, row after row; a row's place in messages is the line it would have in a file.
  /// @throws InputError as parse, and when the cells do not fill the last row.
  static CsvTable from_cells(std::string name, std::vector<std::string> header, std::vector<std::string> cells);

  /// The table without the rows after the first n.
  [[nodiscard]] CsvTable first_rows(int n) const;
  /// These rows, in this order.
  [[nodiscard]] CsvTable take(const std::vector<int>& rows) const;
  /// As a file has it.
  [[nodiscard]] std::string text() const;

  [[nodiscard]] const std::string& name() const { return name_; }
  [[nodiscard]] const std::vector<std::string>& header() const { return header_; }
  [[nodiscard]] int n_rows() const { return static_cast<int>(cells_.size() / header_.size()); }
  [[nodiscard]] int n_columns() const { return static_cast<int>(header_.size()); }
  [[nodiscard]] int find(std::string_view column) const;  // −1 when there is none
  [[nodiscard]] const std::string& cell(int row, int column) const;
  [[nodiscard]] int line(int row) const { return lines_[static_cast<std::size_t>(row)]; }  // in the file

  /// "log.csv:7: column 'q1'", for messages.
  [[nodiscard]] std::string place(int row, int column) const;

  /// @throws InputError naming file, line and column when the cell is not a finite number.
  [[nodiscard]] double number(int row, int column) const;
  /// NaN where the cell is empty. @throws InputError as number, when it holds something else.
  [[nodiscard]] double number_or_empty(int row, int column) const;
  /// NaN where the cell is empty or not finite. @throws InputError when it is something else.
  [[nodiscard]] double number_or_nan(int row, int column) const;

 private:
  std::string name_;
  std::vector<std::string> header_;
  std::vector<std::string> cells_;  // row after row
  std::vector<int> lines_;          // line in the file of each row
};

/// A cell of a CSV file that reads back as `text`.
std::string csv_cell(const std::string& text);

}  // namespace gp2
