#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "gp2/base/file.hpp"
#include "gp2/base/workers.hpp"
#include "gp2/export.hpp"

namespace gp2 GP2_API {

class CsvWriter;

/// A log as it was when it was read.
struct LogFile {
  std::string name;
  std::uint64_t bytes = 0;
  std::int64_t rows = 0;
  std::string checksum = {};  // CRC-64 of xz, 16 hexadecimal digits
  /// Rows that are in the fit whose log this is; not given: not known.
  std::optional<std::int64_t> n_learned = {};
};

/// A table of comma-separated values with one header line. Cells may be quoted; blank lines are skipped. Columns are kept as
/// doubles, parsed once; a cell that is no number is kept as text, and is an error only when it is asked for as a number, so
/// columns that are not needed may hold anything. A table has at most `max_columns`, their names at most `max_name_length`
/// bytes: what has more is no table. Copies share their content, which never changes.
class CsvTable {
 public:
  static constexpr std::size_t max_columns = 10'000;
  static constexpr std::size_t max_name_length = 1000;

  /// What is kept of the cells of a file beside their numbers.
  enum class Keep {
    text,     // every cell as it is written
    numbers,  // the text of those alone that are no numbers; a number is written in its shortest form then
  };

  /// A column that comes from elsewhere than a file: of numbers, NaN where a cell is empty, or of cells.
  struct Column {
    std::string name;
    std::vector<double> numbers;
    std::vector<std::string> cells = {};  // where there are no numbers
  };

  CsvTable();

  /// @param workers  share out the pieces of a long file of numbers, each process gets the whole table; 0: all threads of the machine
  /// @throws InputError naming file and line: unreadable or empty file, no data rows, ragged row, too many columns, a column
  ///   name that is empty, repeated or too long; processes that have different files.
  static CsvTable read(const std::filesystem::path& path, Keep keep = Keep::text, const Workers& workers = 0);
  /// @param name  stands for the file in messages
  static CsvTable parse(std::string_view text, std::string name, Keep keep = Keep::text);
  /// From cells, row after row; a row's place in messages is its number, from 1.
  /// @throws InputError as parse, and when the cells do not fill the last row.
  static CsvTable from_cells(std::string name, std::vector<std::string> header, const std::vector<std::string>& cells);
  /// From columns; nothing is printed or parsed of those that hold numbers.
  /// @throws InputError as parse, and when the columns differ in length.
  static CsvTable from_columns(std::string name, std::vector<Column> columns);

  /// The same table under another name, and of no file.
  [[nodiscard]] CsvTable renamed(std::string name) const;
  /// The same table, whose rows messages count from 1, as those of from_columns.
  [[nodiscard]] CsvTable without_lines() const;
  /// The table without the rows after the first n.
  [[nodiscard]] CsvTable first_rows(int n) const;
  /// These rows, in this order.
  [[nodiscard]] CsvTable take(const std::vector<int>& rows) const;
  /// As a file has it.
  [[nodiscard]] std::string text() const;
  /// @throws InputError as write_file.
  void write(const std::filesystem::path& path) const;

  [[nodiscard]] const std::string& name() const;
  /// The file that read() read; nothing of other tables, also of those that are made from it.
  [[nodiscard]] const std::optional<LogFile>& file() const;
  [[nodiscard]] const std::vector<std::string>& header() const;
  [[nodiscard]] int n_rows() const;
  [[nodiscard]] int n_columns() const { return static_cast<int>(header().size()); }
  [[nodiscard]] int find(std::string_view column) const;  // −1 when there is none
  /// A cell as it is written, without the quotes around it; where its text is not kept, a number in its shortest form.
  [[nodiscard]] std::string cell(int row, int column) const;
  /// Whether there is nothing in a cell but space.
  [[nodiscard]] bool is_empty(int row, int column) const;
  /// Whether all cells of a column are empty.
  [[nodiscard]] bool is_empty(int column) const;
  /// Whether none of its cells holds a number, and one is not empty.
  [[nodiscard]] bool is_text(int column) const;
  [[nodiscard]] int line(int row) const;  // in the file; without one in that which write() makes
  /// Whether the rows are lines of a file or text.
  [[nodiscard]] bool has_lines() const;

  /// "log.csv:7: column 'q1'", for messages; without lines "data: row 6, column 'q1'".
  [[nodiscard]] std::string place(int row, int column) const;

  /// @throws InputError naming file, line and column when the cell is not a finite number.
  [[nodiscard]] double number(int row, int column) const;
  /// NaN where the cell is empty. @throws InputError as number, when it holds something else.
  [[nodiscard]] double number_or_empty(int row, int column) const;
  /// NaN where the cell is empty or not finite. @throws InputError when it is something else.
  [[nodiscard]] double number_or_nan(int row, int column) const;

 private:
  struct Content;
  class Builder;
  static CsvTable read_pieces(const std::filesystem::path& path, const Workers& workers);
  void print(CsvWriter& csv) const;
  explicit CsvTable(std::shared_ptr<const Content> content);

  std::shared_ptr<const Content> content_;
};

/// Prints comma-separated values, cell after cell, and hands the text on in blocks.
class CsvWriter {
 public:
  explicit CsvWriter(std::function<void(std::string_view)> put) : put_(std::move(put)) {}

  void add(std::string_view cell);           // quoted where it must be to read back
  void add(double value);                    // in its shortest form
  void add_printed(std::string_view cells);  // as they are, commas between them
  void end_line();
  void flush();  // hands on what is left

 private:
  void begin_cell();

  std::function<void(std::string_view)> put_;
  std::string block_;  // whole lines and the one that is being printed
  bool is_line_begin_ = true;
};

/// Calls take(cells of a row as CsvWriter prints them) for each row of a file, those of CsvTable::read in their order: a log may be
/// too long for all of its text to be in memory.
/// @throws InputError as CsvTable::read for what is no text, and what `take` throws.
void for_each_row(const std::filesystem::path& path, const std::function<void(std::string_view)>& take);

/// Writes a file of comma-separated values whole or not at all, without ever having its text in memory.
/// @throws InputError as write_file, and what `print` throws.
void write_csv(const std::filesystem::path& path, const std::function<void(CsvWriter&)>& print);

}  // namespace gp2
