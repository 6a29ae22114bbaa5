#include "gp2/csv.hpp"

#include <charconv>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <fstream>
#include <iterator>
#include <set>
#include <system_error>

#include <sys/stat.h>
#include <unistd.h>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

std::string_view trim(std::string_view text) {
  const auto is_space = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && is_space(text.front())) text.remove_prefix(1);
  while (!text.empty() && is_space(text.back())) text.remove_suffix(1);
  if (text.size() >= 2 && text.front() == '"' && text.back() == '"') text = text.substr(1, text.size() - 2);
  return text;
}

std::vector<std::string> split(std::string_view line) {
  std::vector<std::string> cells;
  while (true) {
    const std::size_t end = line.find(',');
    cells.emplace_back(trim(line.substr(0, end)));
    if (end == std::string_view::npos) return cells;
    line.remove_prefix(end + 1);
  }
}

}  // namespace

CsvTable CsvTable::read(const std::filesystem::path& path) { return parse(read_file(path), path.string()); }

CsvTable CsvTable::parse(std::string_view text, std::string name) {
  CsvTable table;
  table.name_ = std::move(name);
  if (text.starts_with("\xef\xbb\xbf")) text.remove_prefix(3);
  int line_number = 0;
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    const std::string_view line = text.substr(0, end);
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    ++line_number;
    if (trim(line).empty()) continue;
    std::vector<std::string> cells = split(line);
    if (table.header_.empty()) {
      std::set<std::string_view> seen;
      for (const std::string& column : cells) {
        if (column.empty()) throw InputError(fmt::format("{}:{}: the header has an empty column name", table.name_, line_number));
        if (!seen.insert(column).second) {
          throw InputError(fmt::format("{}:{}: the column '{}' stands twice in the header", table.name_, line_number, column));
        }
      }
      table.header_ = std::move(cells);
      continue;
    }
    if (cells.size() != table.header_.size()) {
      throw InputError(fmt::format("{}:{}: ragged row: {} cells, but the header has {} columns", table.name_, line_number,
                                   cells.size(), table.header_.size()));
    }
    table.cells_.insert(table.cells_.end(), std::make_move_iterator(cells.begin()), std::make_move_iterator(cells.end()));
    table.lines_.push_back(line_number);
  }
  if (table.header_.empty()) throw InputError(fmt::format("{}: the file is empty; expected a header line and data rows", table.name_));
  if (table.lines_.empty()) throw InputError(fmt::format("{}: no data rows after the header", table.name_));
  return table;
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

double CsvTable::number(int row, int column) const {
  const std::string& text = cell(row, column);
  const char* first = text.data();
  const char* last = first + text.size();
  if (first != last && *first == '+') ++first;
  double value = 0;
  const auto [end, error] = std::from_chars(first, last, value);
  if (first == last || end != last || error != std::errc() || !std::isfinite(value)) {
    throw InputError(fmt::format("{}:{}: column '{}': '{}' is not a finite number", name_, lines_[static_cast<std::size_t>(row)],
                                 header_[static_cast<std::size_t>(column)], text));
  }
  return value;
}

std::string shortest(double value) {
  char buffer[32];
  const auto result = std::to_chars(buffer, buffer + sizeof buffer, value);
  return std::string(buffer, result.ptr);
}

void write_file(const std::filesystem::path& path, std::string_view content) {
  const auto fail = [&](const char* what) {
    throw InputError(fmt::format("{}: {}: {}", path.string(), what, std::strerror(errno)));
  };
  std::string temporary = path.string() + ".XXXXXX";
  const int file = mkstemp(temporary.data());
  if (file < 0) fail("cannot be written");
  std::size_t done = 0;
  bool good = fchmod(file, 0644) == 0;
  while (good && done < content.size()) {
    const ssize_t n = ::write(file, content.data() + done, content.size() - done);
    if (n < 0 && errno == EINTR) continue;
    good = n >= 0;
    if (good) done += static_cast<std::size_t>(n);
  }
  good = good && fsync(file) == 0;
  good = close(file) == 0 && good;
  good = good && std::rename(temporary.c_str(), path.c_str()) == 0;
  if (!good) {
    const int reason = errno;
    unlink(temporary.c_str());
    errno = reason;
    fail("cannot be written");
  }
}

std::string read_file(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file || std::filesystem::is_directory(path)) {
    throw InputError(fmt::format("{}: cannot be read; is the path right?", path.string()));
  }
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace gp2
