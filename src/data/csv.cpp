#include "gp2/data/csv.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cmath>
#include <numeric>
#include <optional>
#include <set>
#include <system_error>
#include <utility>

#include <fmt/format.h>

#include "base/checksum.hpp"
#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "base/suggestion.hpp"
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

// What from_chars makes of a whole cell.
struct Parsed {
  double value = 0;
  bool is_whole = false;  // nothing is left over
  std::errc error = {};

  [[nodiscard]] bool is_number() const { return is_whole && error == std::errc() && std::isfinite(value); }
};

Parsed parse_number(std::string_view cell) {
  std::string_view digits = trim(cell);
  // from_chars knows no plus sign
  if (digits.starts_with('+') && !digits.starts_with("+-")) digits.remove_prefix(1);
  Parsed parsed;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), parsed.value);
  parsed.is_whole = end == digits.data() + digits.size();
  parsed.error = error;
  return parsed;
}

// the number in a cell; NaN when it holds none
double number_in(std::string_view cell) {
  const Parsed parsed = parse_number(cell);
  return parsed.is_number() ? parsed.value : not_a_number;
}

// throws the reason why a cell of a column is no number
void refuse_cell(const std::string& cell, const std::string& column, const std::string& place, bool may_be_empty = false) {
  const auto fail = [&](const std::string& what) { throw InputError(fmt::format("{}: {}", place, what)); };
  const Parsed parsed = parse_number(cell);
  if (trim(cell).empty()) fail("the cell is empty; a number is needed here");
  if (parsed.is_whole && parsed.error == std::errc::result_out_of_range)
    fail(fmt::format("'{}' does not fit a double (5e-324 to 1.8e308)", shortened(cell)));
  const bool is_nan = parsed.is_whole && parsed.error == std::errc() && std::isnan(parsed.value);
  fail(fmt::format("'{}' is not a finite number{}", shortened(cell),
                   cell == column           ? ": the header again: are these files that were joined? Remove the line"
                   : may_be_empty && is_nan ? "; leave the cell empty where nothing is measured"
                                            : ""));
}

// names that are there, once each, and not too many
void check_header(const std::vector<std::string>& header, const std::string& where) {
  if (header.size() > CsvTable::max_columns) {
    throw InputError(fmt::format("{}: the header has {} columns; at most {} are read: split the table, or is it no table?", where,
                                 header.size(), CsvTable::max_columns));
  }
  const bool is_json = !header.empty() && header[0].starts_with('{');
  if (is_json || where.find(".toml:") != std::string::npos) {
    throw InputError(fmt::format("{}: not a table but {}: a CSV log is wanted here", where,
                                 is_json ? "JSON, as gp2 fit writes it" : "a model file, by its name"));
  }
  if (header.size() == 1 && !header[0].starts_with('#') && header[0].find_first_of(";\t ") != std::string::npos) {
    throw InputError(
        fmt::format("{}: the header is not separated by commas but by '{}'; write commas, and '.' as the decimal point", where,
                    header[0].find(';') != std::string::npos    ? ";"
                    : header[0].find('\t') != std::string::npos ? "tab"
                                                                : "space"));
  }
  std::set<std::string_view> seen;
  for (std::size_t k = 0; k < header.size(); ++k) {
    if (header[k].empty()) {
      throw InputError(fmt::format("{}: column {} of the header has no name; name it, or remove a comma too many", where, k + 1));
    }
    if (header[k].size() > CsvTable::max_name_length) {
      throw InputError(
          fmt::format("{}: the name of column {} has {} bytes, at most {} are allowed: is this no table? It begins '{}'", where,
                      k + 1, header[k].size(), CsvTable::max_name_length, shortened(header[k])));
    }
    if (!seen.insert(header[k]).second) {
      throw InputError(fmt::format("{}: the column '{}' stands twice in the header; rename or remove one", where, header[k]));
    }
  }
}

/// Texts of some cells, or of all, in the order of the cells.
class CellTexts {
 public:
  void reserve(std::size_t n_bytes) { bytes_.reserve(n_bytes); }

  /// @param cell  beyond all that were added before
  void add(std::size_t cell, std::string_view text) {
    // as long as no cell is left out, the k-th text is that of cell k
    if (cell != ends_.size() || !cells_.empty()) cells_.push_back(cell);
    bytes_ += text;
    ends_.push_back(bytes_.size());
  }

  /// Nothing where no text is kept.
  [[nodiscard]] std::optional<std::string_view> find(std::size_t cell) const {
    std::size_t k = cell;
    const std::size_t n_consecutive = ends_.size() - cells_.size();
    if (cell >= n_consecutive) {
      const auto found = std::lower_bound(cells_.begin(), cells_.end(), cell);
      if (found == cells_.end() || *found != cell) return std::nullopt;
      k = n_consecutive + static_cast<std::size_t>(found - cells_.begin());
    }
    const std::size_t start = k == 0 ? 0 : ends_[k - 1];
    return std::string_view(bytes_).substr(start, ends_[k] - start);
  }

 private:
  std::string bytes_;               // text after text
  std::vector<std::size_t> ends_;   // of each text in `bytes_`
  std::vector<std::size_t> cells_;  // of each text behind those of the first cells, ascending
};

}  // namespace

struct CsvTable::Content {
  std::string name;
  std::optional<LogFile> file;
  std::vector<std::string> header;
  std::vector<std::vector<double>> columns;  // NaN where a cell is empty or no finite number
  std::vector<int> lines;                    // line in the file of each row
  bool has_lines = true;                     // false where the rows were never lines of a text
  CellTexts texts;                           // by row · n_columns + column

  [[nodiscard]] std::optional<std::string_view> text(int row, int column) const {
    return texts.find(static_cast<std::size_t>(row) * header.size() + static_cast<std::size_t>(column));
  }
  [[nodiscard]] double number(int row, int column) const {
    return columns[static_cast<std::size_t>(column)][static_cast<std::size_t>(row)];
  }
};

/// Takes a table in line by line.
class CsvTable::Builder {
 public:
  Builder(std::string name, Keep keep) : keep_(keep) { content_.name = std::move(name); }

  /// A line of the text, in its order, without its end.
  void add_line(std::string_view line) {
    ++line_number_;
    if (line_number_ == 1 && line.starts_with(byte_order_mark)) line.remove_prefix(byte_order_mark.size());
    line = trim(line);
    if (line.empty()) return;
    if (line.find('\0') != std::string_view::npos) {
      throw InputError(fmt::format(
          "{}: a zero byte is in no text; the file is damaged, binary, or UTF-16 (iconv -f UTF-16LE -t UTF-8)", where()));
    }
    if (content_.header.empty()) {
      read_header(line);
    } else {
      read_row(line);
      content_.lines.push_back(line_number_);
    }
  }

  /// The lines that follow, of rows as plain_cells finds them.
  void add_rows(const std::vector<double>& cells) {
    const std::size_t n_columns = content_.columns.size();
    for (std::size_t k = 0; k < cells.size(); ++k) content_.columns[k % n_columns].push_back(cells[k]);
    for (std::size_t row = 0; row < cells.size() / n_columns; ++row) content_.lines.push_back(++line_number_);
  }
  /// 0 before there is a header.
  [[nodiscard]] std::size_t n_columns() const { return content_.columns.size(); }

  /// @param file  that the lines are of
  CsvTable finish(std::optional<LogFile> file = std::nullopt) {
    if (content_.header.empty()) {
      throw InputError(fmt::format("{}: the file is empty; expected a header line and data rows", content_.name));
    }
    if (content_.lines.empty()) throw InputError(fmt::format("{}: no data rows after the header", content_.name));
    if (file) file->rows = std::ssize(content_.lines);
    content_.file = std::move(file);
    return CsvTable(std::make_shared<const Content>(std::move(content_)));
  }

 private:
  [[nodiscard]] std::string where() const { return fmt::format("{}:{}", content_.name, line_number_); }

  [[nodiscard]] std::string take_cell_or_throw(std::string_view& line) const {
    std::optional<std::string> cell = take_cell(line);
    if (!cell) throw InputError(fmt::format("{}: a quote \" is not closed before the comma or the end of the line", where()));
    return std::move(*cell);
  }

  void read_header(std::string_view line) {
    if (line.find('\r') != std::string_view::npos) {
      throw InputError(
          fmt::format("{}: lines end in a carriage return alone, as of old Macs; convert them (tr '\\r' '\\n')", where()));
    }
    std::vector<std::string> names = {take_cell_or_throw(line)};
    while (!line.empty()) {
      line.remove_prefix(1);  // the comma
      names.push_back(take_cell_or_throw(line));
    }
    check_header(names, where());
    content_.columns.resize(names.size());
    content_.header = std::move(names);
  }

  void read_row(std::string_view line) {
    const bool is_comment = line.starts_with('#');
    std::size_t n_cells = 0;
    read_cell(line, n_cells++);
    while (!line.empty()) {
      line.remove_prefix(1);  // the comma
      read_cell(line, n_cells++);
    }
    if (n_cells == content_.header.size()) return;
    const bool has_comment = is_comment || content_.header.front().starts_with('#');
    throw InputError(fmt::format("{}: ragged row: {} cells, but the header has {} columns{}", where(), n_cells,
                                 content_.header.size(),
                                 has_comment ? ": a line that begins with # is not read as a comment; remove it" : ""));
  }

  // the cell at the front of `line`, which is left with what follows it
  void read_cell(std::string_view& line, std::size_t column) {
    double value = not_a_number;
    const char* const line_end = line.data() + line.size();
    const auto [end, error] = std::from_chars(line.data(), line_end, value);
    const bool is_plain = error == std::errc() && std::isfinite(value) && (end == line_end || *end == ',');
    if (is_plain) {
      const std::string_view cell = line.substr(0, static_cast<std::size_t>(end - line.data()));
      line.remove_prefix(cell.size());
      add_cell(column, value, cell);
    } else {
      const std::string cell = take_cell_or_throw(line);
      add_cell(column, number_in(cell), cell);
    }
  }

  void add_cell(std::size_t column, double value, std::string_view text) {
    if (column >= content_.columns.size()) return;  // of a ragged row
    content_.columns[column].push_back(value);
    if (keep_ == Keep::text || (std::isnan(value) && !text.empty())) {
      content_.texts.add(content_.lines.size() * content_.columns.size() + column, text);
    }
  }

  const Keep keep_;
  Content content_;
  int line_number_ = 0;
};

CsvTable::CsvTable() : content_(std::make_shared<const Content>()) {}

CsvTable::CsvTable(std::shared_ptr<const Content> content) : content_(std::move(content)) {}

namespace {

// Calls take(line) for every line of a file, without its end, and begin(block) before those of a block.
template <typename Take>
void for_each_line_of(const std::filesystem::path& path, const Take& take,
                      const std::function<void(std::string_view)>& begin = {}) {
  std::string rest;  // of a line that goes on in the next block
  read_blocks(path, [&](std::string_view block) {
    if (begin) begin(block);
    for (std::size_t end = block.find('\n'); end != std::string_view::npos; end = block.find('\n')) {
      const std::string_view line = block.substr(0, end);
      take(rest.empty() ? line : std::string_view(rest += line));
      rest.clear();
      block.remove_prefix(end + 1);
    }
    rest += block;
  });
  if (!rest.empty()) take(std::string_view(rest));
}

constexpr std::size_t piece_size = std::size_t{1} << 20;

/// The lines of a file that begin within one stretch of its bytes, and the checksum of these bytes.
struct Piece {
  std::string text;
  std::size_t begin = 0;  // of the first of these lines
  Checksum checksum;

  Piece(const FileParts& file, std::uint64_t first) {
    const std::uint64_t before = first == 0 ? 0 : 1;  // byte, which tells whether a line begins at the first
    text = file.read(first - before, piece_size + before);
    checksum.add(std::string_view(text).substr(std::min<std::size_t>(before, text.size())));  // empty where a file has shrunk
    if (before == 1) begin = std::min(text.find('\n'), text.size() - 1) + 1;
    constexpr std::size_t next = 1 << 12;
    while (begin < text.size() && text.back() != '\n') {  // the last line goes on
      std::string rest = file.read(first - before + text.size(), next);
      if (rest.empty()) break;
      rest.resize(std::min(rest.find('\n'), rest.size() - 1) + 1);
      text += rest;
    }
  }
  [[nodiscard]] std::string_view lines() const { return std::string_view(text).substr(begin); }
};

template <typename Take>
void for_each_line(std::string_view text, const Take& take) {
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    take(text.substr(0, end));
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
  }
}

// The cells of lines that have n_columns each, all of them numbers or empty, row after row: nearly all lines of a log are such. Nothing
// where one is not: what is to be said or kept of it is for Builder::add_line.
std::optional<std::vector<double>> plain_cells(std::string_view lines, std::size_t n_columns) {
  std::vector<double> cells;
  bool is_plain = n_columns > 0;  // or the header is still to come
  for_each_line(lines, [&](std::string_view line) {
    line = trim(line);
    const char* at = line.data();
    const char* const end = at + line.size();
    const auto skip_space = [&] {
      while (at != end && (*at == ' ' || *at == '\t')) ++at;
    };
    is_plain = is_plain && !line.empty();
    for (std::size_t column = 0; column < n_columns && is_plain; ++column) {
      skip_space();
      double value = not_a_number;
      if (at != end && *at != ',') {
        const auto [after, error] = std::from_chars(at, end, value);
        is_plain = error == std::errc() && std::isfinite(value);
        at = after;
        skip_space();
      }
      cells.push_back(value);
      const bool is_last = column + 1 == n_columns;
      is_plain = is_plain && (is_last ? at == end : at != end && *at++ == ',');
    }
  });
  if (!is_plain) return std::nullopt;
  return cells;
}

// Result of one reader, sent to the other processes.
struct ReadPiece {
  Checksum checksum;
  std::optional<std::vector<double>> cells;

  ReadPiece() = default;
  ReadPiece(const Piece& piece, std::size_t n_columns) : checksum(piece.checksum), cells(plain_cells(piece.lines(), n_columns)) {}

  void share(const Workers& workers, int part, int n_parts) {
    std::array<double, 2> head = {std::bit_cast<double>(checksum.remainder()), cells ? static_cast<double>(cells->size()) : -1.0};
    workers.share(head, part, n_parts);
    checksum = Checksum(std::bit_cast<std::uint64_t>(head[0]));
    if (head[1] < 0) return cells.reset();
    if (!cells) cells.emplace();
    cells->resize(static_cast<std::size_t>(head[1]));
    workers.share(*cells, part, n_parts);
  }
};

// @throws InputError where one of several processes has another size of a file than the first, or has seen that another's differs
void require_one_file(const Workers& workers, const std::filesystem::path& path, double size, bool is_same = true) {
  double first = size;
  if (workers.ranks) workers.ranks->broadcast({&first, 1}, 0);
  if (workers.sum(is_same && first == size ? 0 : 1) > 0) {
    throw InputError(
        fmt::format("{}: the processes of mpirun have read different data: give all of them the same files", path.string()));
  }
}

}  // namespace

// Pieces are taken in by lines in their order, so that whoever reads them the table is the same, and so is an error.
CsvTable CsvTable::read_pieces(const std::filesystem::path& path, const Workers& workers) {
  const FileParts file(path);
  const auto n_pieces = static_cast<int>((file.size() + piece_size - 1) / piece_size);
  const auto first_of = [](int piece) { return static_cast<std::uint64_t>(piece) * piece_size; };
  const auto add_lines = [](Builder& builder, const Piece& piece) {
    for_each_line(piece.lines(), [&](std::string_view line) { builder.add_line(line); });
  };

  // whose numbers are in memory twice
  const int pieces_at_once = std::max(16, workers.ranks ? 2 * workers.ranks->size() : 0);
  Builder builder(path.string(), Keep::numbers);
  const Piece head(file, 0);
  add_lines(builder, head);
  Checksum checksum = head.checksum;
  bool is_same = true;
  for (int first = 1; first < n_pieces; first += pieces_at_once) {
    const int n = std::min(pieces_at_once, n_pieces - first);
    std::vector<ReadPiece> pieces(static_cast<std::size_t>(n));
    std::vector<std::optional<Checksum>> seen(pieces.size());  // of what the next process reads
    parallel_for(n, thread_count(workers.n_threads), [&](int k, int) {
      const auto part = static_cast<std::size_t>(k);
      if (workers.owns(k, n)) {
        pieces[part] = ReadPiece(Piece(file, first_of(first + k)), builder.n_columns());
      } else if (workers.ranks->owner(k, n) == (workers.ranks->rank() + 1) % workers.ranks->size()) {
        seen[part] = Piece(file, first_of(first + k)).checksum;
      }
    });
    for (int k = 0; k < n; ++k) {
      const auto part = static_cast<std::size_t>(k);
      ReadPiece& piece = pieces[part];
      piece.share(workers, k, n);
      is_same = is_same && (!seen[part] || *seen[part] == piece.checksum);
      checksum.append(piece.checksum, std::min<std::uint64_t>(piece_size, file.size() - first_of(first + k)));
      if (piece.cells) {
        builder.add_rows(*std::exchange(piece.cells, {}));
      } else {
        add_lines(builder, Piece(file, first_of(first + k)));
      }
    }
  }
  file.require_unchanged();
  require_one_file(workers, path, static_cast<double>(file.size()), is_same);
  return builder.finish(LogFile{path.string(), file.size(), 0, checksum.text()});
}

CsvTable CsvTable::read(const std::filesystem::path& path, Keep keep, const Workers& workers) {
  const std::optional<FileVersion> version = file_version(path);
  const std::uint64_t size = version ? version->size : 0;
  require_one_file(workers, path, static_cast<double>(size));
  if (keep == Keep::numbers && size > piece_size) return read_pieces(path, workers);

  Builder builder(path.string(), keep);
  LogFile file{path.string()};
  Checksum checksum;
  for_each_line_of(
      path, [&](std::string_view line) { builder.add_line(line); },
      [&](std::string_view block) {
        file.bytes += block.size();
        checksum.add(block);
      });
  file.checksum = checksum.text();
  return builder.finish(std::move(file));
}

CsvTable CsvTable::parse(std::string_view text, std::string name, Keep keep) {
  Builder builder(std::move(name), keep);
  for_each_line(text, [&](std::string_view line) { builder.add_line(line); });
  return builder.finish();
}

CsvTable CsvTable::from_cells(std::string name, std::vector<std::string> header, const std::vector<std::string>& cells) {
  std::vector<Column> columns;
  for (std::string& one : header) columns.push_back({std::move(one), {}, {}});
  const std::size_t n_columns = columns.size();
  if (n_columns > 0 && cells.size() % n_columns != 0) {
    throw InputError(fmt::format("{}: {} cells do not make rows of {} columns", name, cells.size(), n_columns));
  }
  for (std::size_t k = 0; k < cells.size() && n_columns > 0; ++k) columns[k % n_columns].cells.push_back(cells[k]);
  return from_columns(std::move(name), std::move(columns));
}

namespace {

std::size_t n_rows_of(const CsvTable::Column& column) { return std::max(column.numbers.size(), column.cells.size()); }

// columns of one length, and names that are there, once each
void check_columns(const std::vector<CsvTable::Column>& columns, const std::vector<std::string>& header,
                   const std::string& name) {
  for (const CsvTable::Column& column : columns) {
    if (n_rows_of(column) == n_rows_of(columns.front())) continue;
    throw InputError(fmt::format("{}: the columns differ in length: '{}' has {}, '{}' has {}", name, header.front(),
                                 n_rows_of(columns.front()), column.name, n_rows_of(column)));
  }
  if (columns.empty()) throw InputError(fmt::format("{}: there are no columns", name));
  check_header(header, name);
  if (n_rows_of(columns.front()) == 0) throw InputError(fmt::format("{}: there are no rows", name));
}

}  // namespace

CsvTable CsvTable::from_columns(std::string name, std::vector<Column> columns) {
  Content content;
  for (const Column& column : columns) content.header.push_back(column.name);
  check_columns(columns, content.header, name);
  content.name = std::move(name);
  content.has_lines = false;
  content.lines.resize(n_rows_of(columns.front()));
  std::iota(content.lines.begin(), content.lines.end(), 2);  // the header is line 1

  for (std::size_t row = 0; row < content.lines.size(); ++row) {
    for (std::size_t k = 0; k < columns.size(); ++k) {
      const std::size_t cell = row * columns.size() + k;
      if (columns[k].numbers.empty()) {
        content.texts.add(cell, columns[k].cells[row]);
      } else if (double& number = columns[k].numbers[row]; std::isinf(number)) {
        content.texts.add(cell, shortest(std::exchange(number, not_a_number)));
      }
    }
  }
  for (Column& column : columns) {
    for (const std::string& cell : column.cells) column.numbers.push_back(number_in(cell));
    content.columns.push_back(std::move(column.numbers));
  }
  return CsvTable(std::make_shared<const Content>(std::move(content)));
}

CsvTable CsvTable::renamed(std::string name) const {
  Content content = *content_;
  content.name = std::move(name);
  content.file.reset();
  return CsvTable(std::make_shared<const Content>(std::move(content)));
}

CsvTable CsvTable::without_lines() const {
  Content content = *content_;
  content.has_lines = false;
  std::iota(content.lines.begin(), content.lines.end(), 2);  // the header is line 1
  return CsvTable(std::make_shared<const Content>(std::move(content)));
}

CsvTable CsvTable::first_rows(int n) const {
  std::vector<int> rows(static_cast<std::size_t>(std::clamp(n, 0, n_rows())));
  std::iota(rows.begin(), rows.end(), 0);
  return take(rows);
}

CsvTable CsvTable::take(const std::vector<int>& rows) const {
  Content taken;
  taken.name = name();
  taken.has_lines = has_lines();
  taken.header = header();
  taken.columns.resize(header().size());
  for (const int row : rows) {
    for (int column = 0; column < n_columns(); ++column) {
      const auto k = static_cast<std::size_t>(column);
      if (const auto text = content_->text(row, column)) taken.texts.add(taken.lines.size() * header().size() + k, *text);
      taken.columns[k].push_back(content_->number(row, column));
    }
    taken.lines.push_back(line(row));
  }
  return CsvTable(std::make_shared<const Content>(std::move(taken)));
}

void CsvTable::print(CsvWriter& csv) const {
  for (const std::string& name : header()) csv.add(name);
  csv.end_line();
  for (int row = 0; row < n_rows(); ++row) {
    for (int column = 0; column < n_columns(); ++column) {
      const double value = content_->number(row, column);
      if (const std::optional<std::string_view> written = content_->text(row, column)) {
        csv.add(*written);
      } else if (std::isnan(value)) {
        csv.add("");
      } else {
        csv.add(value);
      }
    }
    csv.end_line();
  }
}

std::string CsvTable::text() const {
  std::string text;
  CsvWriter csv([&](std::string_view block) { text += block; });
  print(csv);
  csv.flush();
  return text;
}

void CsvTable::write(const std::filesystem::path& path) const {
  write_csv(path, [&](CsvWriter& csv) { print(csv); });
}

void CsvWriter::begin_cell() {
  if (!std::exchange(is_line_begin_, false)) block_ += ',';
}

void CsvWriter::add(std::string_view cell) {
  if (cell.find('\n') != std::string_view::npos) {
    throw InputError(
        fmt::format("'{}' has a line break in it, but a row of a CSV file is one line here: remove the break", shortened(cell)));
  }
  begin_cell();
  const bool plain =
      cell.find_first_of(",\"") == std::string_view::npos && trim(cell) == cell && !cell.starts_with(byte_order_mark);
  if (plain) {
    block_ += cell;
    return;
  }
  block_ += '"';
  for (const char c : cell) block_.append(c == '"' ? 2 : 1, c);  // a quote is written twice
  block_ += '"';
}

void CsvWriter::add(double value) {
  begin_cell();
  std::array<char, 32> digits{};
  block_.append(digits.data(), std::to_chars(digits.data(), digits.data() + digits.size(), value).ptr);
}

void CsvWriter::end_line() {
  constexpr std::size_t enough = std::size_t{1} << 16;
  if (block_.empty() || block_.back() == '\n') block_ += "\"\"";  // the line of one empty cell would be blank
  block_ += '\n';
  is_line_begin_ = true;
  if (block_.size() >= enough) flush();
}

void CsvWriter::flush() {
  put_(block_);
  block_.clear();
}

void CsvWriter::add_printed(std::string_view cells) {
  begin_cell();
  block_ += cells;
}

void for_each_row(const std::filesystem::path& path, const std::function<void(std::string_view)>& take) {
  bool is_first_line = true, is_header = true;
  std::string printed;
  for_each_line_of(path, [&](std::string_view line) {
    if (std::exchange(is_first_line, false) && line.starts_with(byte_order_mark)) line.remove_prefix(byte_order_mark.size());
    line = trim(line);
    if (line.empty() || std::exchange(is_header, false)) return;
    const bool is_plain =
        std::ranges::none_of(std::string_view("\" \t\r\xef"), [&](char c) { return line.find(c) != std::string_view::npos; });
    if (is_plain) {
      take(line);
      return;
    }
    printed.clear();
    CsvWriter csv([&](std::string_view block) { printed += block; });
    while (true) {
      csv.add(take_cell(line).value_or(""));
      if (line.empty()) break;
      line.remove_prefix(1);  // the comma
    }
    csv.flush();
    take(printed);
  });
}

void write_csv(const std::filesystem::path& path, const std::function<void(CsvWriter&)>& print) {
  write_blocks(path, [&](const auto& put) {
    CsvWriter csv(put);
    print(csv);
    csv.flush();
  });
}

const std::string& CsvTable::name() const { return content_->name; }

const std::optional<LogFile>& CsvTable::file() const { return content_->file; }

const std::vector<std::string>& CsvTable::header() const { return content_->header; }

int CsvTable::n_rows() const { return static_cast<int>(content_->lines.size()); }

bool CsvTable::is_empty(int column) const {
  for (int row = 0; row < n_rows(); ++row) {
    if (!is_empty(row, column)) return false;
  }
  return true;
}

bool CsvTable::is_text(int column) const {
  bool has_text = false;
  for (int row = 0; row < n_rows(); ++row) {
    if (!std::isnan(content_->number(row, column))) return false;
    has_text = has_text || !is_empty(row, column);
  }
  return has_text;
}

int CsvTable::line(int row) const { return content_->lines[static_cast<std::size_t>(row)]; }

bool CsvTable::has_lines() const { return content_->has_lines; }

int CsvTable::find(std::string_view column) const {
  for (int k = 0; k < n_columns(); ++k) {
    if (header()[static_cast<std::size_t>(k)] == column) return k;
  }
  return -1;
}

std::string CsvTable::cell(int row, int column) const {
  if (const auto text = content_->text(row, column)) return std::string(*text);
  const double value = content_->number(row, column);
  return std::isnan(value) ? "" : shortest(value);
}

bool CsvTable::is_empty(int row, int column) const {
  return std::isnan(content_->number(row, column)) && trim(content_->text(row, column).value_or("")).empty();
}

std::string CsvTable::place(int row, int column) const {
  const std::string& of = header()[static_cast<std::size_t>(column)];
  if (!has_lines()) return fmt::format("{}: row {}, column '{}'", name(), line(row) - 1, of);  // the header is line 1
  return fmt::format("{}:{}: column '{}'", name(), line(row), of);
}

double CsvTable::number(int row, int column) const {
  const double value = content_->number(row, column);
  if (std::isnan(value)) refuse_cell(cell(row, column), header()[static_cast<std::size_t>(column)], place(row, column));
  return value;
}

double CsvTable::number_or_empty(int row, int column) const {
  const double value = content_->number(row, column);
  if (std::isnan(value) && !is_empty(row, column))
    refuse_cell(cell(row, column), header()[static_cast<std::size_t>(column)], place(row, column), true);
  return value;
}

double CsvTable::number_or_nan(int row, int column) const {
  const double value = content_->number(row, column);
  if (!std::isnan(value) || is_empty(row, column)) return value;
  const Parsed parsed = parse_number(cell(row, column));
  const bool is_gap = parsed.is_whole && parsed.error == std::errc() && !std::isfinite(parsed.value);
  return is_gap ? not_a_number : number(row, column);
}

}  // namespace gp2
