#include "gp2/data/csv.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <iterator>
#include <limits>
#include <numeric>
#include <optional>
#include <set>
#include <system_error>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

constexpr std::string_view byte_order_mark = "\xef\xbb\xbf";  // with which some spreadsheets begin a file

std::string_view trim(std::string_view text) {
  const auto is_space = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && is_space(text.front())) text.remove_prefix(1);
  while (!text.empty() && is_space(text.back())) text.remove_suffix(1);
  return text;
}

// the cell at the front of `line`, which is left with what follows its comma; nothing when a quote is not closed properly
std::optional<std::string> take_cell(std::string_view& line) {
  const std::size_t start = std::min(line.find_first_not_of(" \t"), line.size());
  if (line.substr(start, 1) != "\"") {
    const std::size_t end = std::min(line.find(','), line.size());
    std::string cell(trim(line.substr(0, end)));
    line.remove_prefix(end);
    return cell;
  }
  line.remove_prefix(start + 1);
  std::string cell;
  while (true) {
    const std::size_t quote = line.find('"');
    if (quote == std::string_view::npos) return std::nullopt;
    cell += line.substr(0, quote);
    line.remove_prefix(quote + 1);
    if (!line.starts_with('"')) break;
    cell += '"';  // two quotes stand for one
    line.remove_prefix(1);
  }
  const std::size_t end = std::min(line.find(','), line.size());
  if (!trim(line.substr(0, end)).empty()) return std::nullopt;
  line.remove_prefix(end);
  return cell;
}

// the cells of a line; nothing when a quote is not closed properly
std::optional<std::vector<std::string>> split(std::string_view line) {
  std::vector<std::string> cells;
  while (true) {
    std::optional<std::string> cell = take_cell(line);
    if (!cell) return std::nullopt;
    cells.push_back(std::move(*cell));
    if (line.empty()) return cells;
    line.remove_prefix(1);  // the comma
  }
}

// a cell to show in a message
std::string shown(const std::string& cell) { return cell.size() <= 60 ? cell : cell.substr(0, 57) + "..."; }

// names that are there, once each, and not too many
void check_header(const std::vector<std::string>& header, const std::string& where) {
  if (header.size() > CsvTable::max_columns) {
    throw InputError(fmt::format("{}: the header has {} columns; at most {} are read: split the table, or is it no table?", where,
                                 header.size(), CsvTable::max_columns));
  }
  if (header.size() == 1 && header[0].find_first_of(";\t") != std::string::npos) {
    throw InputError(
        fmt::format("{}: the header is not separated by commas but by '{}'; write commas, and '.' as the decimal point", where,
                    header[0].find(';') != std::string::npos ? ";" : "tab"));
  }
  std::set<std::string_view> seen;
  for (std::size_t k = 0; k < header.size(); ++k) {
    if (header[k].empty()) {
      throw InputError(fmt::format("{}: column {} of the header has no name; name it, or remove a comma too many", where, k + 1));
    }
    if (header[k].size() > CsvTable::max_name_length) {
      throw InputError(
          fmt::format("{}: the name of column {} has {} bytes, at most {} are allowed: is this no table? It begins '{}'", where,
                      k + 1, header[k].size(), CsvTable::max_name_length, shown(header[k])));
    }
    if (!seen.insert(header[k]).second) {
      throw InputError(fmt::format("{}: the column '{}' stands twice in the header; rename or remove one", where, header[k]));
    }
  }
}

}  // namespace

CsvTable CsvTable::read(const std::filesystem::path& path) { return parse(read_file(path), path.string()); }

CsvTable CsvTable::parse(std::string_view text, std::string name) {
  CsvTable table;
  table.name_ = std::move(name);
  if (text.starts_with(byte_order_mark)) text.remove_prefix(byte_order_mark.size());
  int line_number = 0;
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    const std::string_view line = text.substr(0, end);
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    ++line_number;
    if (trim(line).empty()) continue;
    const std::string where = fmt::format("{}:{}", table.name_, line_number);
    std::optional<std::vector<std::string>> cells = split(trim(line));
    if (!cells) throw InputError(fmt::format("{}: a quote \" is not closed before the comma or the end of the line", where));
    if (table.header_.empty()) {
      check_header(*cells, where);
      table.header_ = std::move(*cells);
      continue;
    }
    if (cells->size() != table.header_.size()) {
      throw InputError(
          fmt::format("{}: ragged row: {} cells, but the header has {} columns", where, cells->size(), table.header_.size()));
    }
    table.cells_.insert(table.cells_.end(), std::make_move_iterator(cells->begin()), std::make_move_iterator(cells->end()));
    table.lines_.push_back(line_number);
  }
  if (table.header_.empty()) {
    throw InputError(fmt::format("{}: the file is empty; expected a header line and data rows", table.name_));
  }
  if (table.lines_.empty()) throw InputError(fmt::format("{}: no data rows after the header", table.name_));
  return table;
}

CsvTable CsvTable::from_cells(std::string name, std::vector<std::string> header, std::vector<std::string> cells) {
  if (header.empty()) throw InputError(fmt::format("{}: there are no columns", name));
  check_header(header, name);
  if (cells.empty()) throw InputError(fmt::format("{}: there are no rows", name));
  if (cells.size() % header.size() != 0) {
    throw InputError(fmt::format("{}: {} cells do not make rows of {} columns", name, cells.size(), header.size()));
  }
  CsvTable table;
  table.name_ = std::move(name);
  table.header_ = std::move(header);
  table.cells_ = std::move(cells);
  table.lines_.resize(table.cells_.size() / table.header_.size());
  std::iota(table.lines_.begin(), table.lines_.end(), 2);  // the header is line 1
  return table;
}

CsvTable CsvTable::first_rows(int n) const {
  CsvTable table = *this;
  const auto rows = static_cast<std::size_t>(std::clamp(n, 0, n_rows()));
  table.cells_.resize(rows * header_.size());
  table.lines_.resize(rows);
  return table;
}

CsvTable CsvTable::take(const std::vector<int>& rows) const {
  CsvTable taken = *this;
  taken.cells_.clear();
  taken.lines_.clear();
  for (const int row : rows) {
    for (int column = 0; column < n_columns(); ++column) taken.cells_.push_back(cell(row, column));
    taken.lines_.push_back(lines_[static_cast<std::size_t>(row)]);
  }
  return taken;
}

std::string csv_cell(const std::string& text) {
  const bool plain = text.find_first_of(",\"") == std::string::npos && trim(text) == text && !text.starts_with(byte_order_mark);
  if (plain) return text;
  std::string cell = "\"";
  for (char c : text) cell.append(c == '"' ? 2 : 1, c);  // a quote is written twice
  return cell += '"';
}

std::string CsvTable::text() const {
  std::string csv;
  const auto add = [&](const std::string& cell, int column) {
    // the line of one empty cell would be blank
    csv += cell.empty() && n_columns() == 1 ? "\"\"" : csv_cell(cell);
    csv += column + 1 < n_columns() ? ',' : '\n';
  };
  for (int column = 0; column < n_columns(); ++column) add(header_[static_cast<std::size_t>(column)], column);
  for (int row = 0; row < n_rows(); ++row) {
    for (int column = 0; column < n_columns(); ++column) add(cell(row, column), column);
  }
  return csv;
}

int CsvTable::find(std::string_view column) const {
  for (std::size_t k = 0; k < header_.size(); ++k) {
    if (header_[k] == column) return static_cast<int>(k);
  }
  return -1;
}

const std::string& CsvTable::cell(int row, int column) const {
  return cells_[static_cast<std::size_t>(row) * header_.size() + static_cast<std::size_t>(column)];
}

std::string CsvTable::place(int row, int column) const {
  return fmt::format("{}:{}: column '{}'", name_, lines_[static_cast<std::size_t>(row)],
                     header_[static_cast<std::size_t>(column)]);
}

double CsvTable::number(int row, int column) const {
  const auto fail = [&](const std::string& what) { throw InputError(fmt::format("{}: {}", place(row, column), what)); };
  const std::string& text = cell(row, column);
  std::string_view digits = trim(text);
  if (digits.empty()) fail("the cell is empty; a number is needed here");
  // from_chars knows no plus sign
  if (digits.starts_with('+') && !digits.starts_with("+-")) digits.remove_prefix(1);
  double value = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
  const bool whole = end == digits.data() + digits.size();
  if (whole && error == std::errc::result_out_of_range)
    fail(fmt::format("'{}' does not fit a double (5e-324 to 1.8e308)", shown(text)));
  if (!whole || error != std::errc() || !std::isfinite(value)) fail(fmt::format("'{}' is not a finite number", shown(text)));
  return value;
}

double CsvTable::number_or_empty(int row, int column) const {
  return trim(cell(row, column)).empty() ? std::numeric_limits<double>::quiet_NaN() : number(row, column);
}

double CsvTable::number_or_nan(int row, int column) const {
  std::string_view text = trim(cell(row, column));
  if (text.starts_with('+')) text.remove_prefix(1);
  double value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  const bool is_gap = text.empty() || (end == text.data() + text.size() && error == std::errc() && !std::isfinite(value));
  return is_gap ? std::numeric_limits<double>::quiet_NaN() : number(row, column);
}

}  // namespace gp2
