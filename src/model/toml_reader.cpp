#include "model/toml_reader.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <sstream>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/suggestion.hpp"

namespace gp2 {

int line_of(const toml::node& node) { return static_cast<int>(node.source().begin.line); }

void require_safe(std::string_view text, const std::string& file_name) {
  constexpr int max_depth = 32, max_dots = 16;
  int line = 1, depth = 0, dots = 0;
  const auto fail = [&](const std::string& what) { throw LocatedError(fmt::format("{}:{}: {}", file_name, line, what)); };
  char within = '\0';                                           // '#': a comment, '"' or '\'': a text in quotes
  std::size_t n_quotes = 0;                                     // that end it: 1, or 3 of a text of several lines
  if (text.starts_with("\xef\xbb\xbf")) text.remove_prefix(3);  // the byte order mark of some editors
  for (std::size_t at = 0; at < text.size(); ++at) {
    const char c = text[at];
    const std::string_view next = text.substr(at, 5);
    const std::size_t run = std::min(next.find_first_not_of(c), next.size());  // of this character, up to 5
    if (within == '#') {
      if (c == '\n') within = '\0';
    } else if (within != '\0') {
      if (c == '\\' && within == '"') ++at;
      if (c == within && run >= n_quotes) {
        // up to two quotes may stand right before the three that end a text
        at += n_quotes == 1 ? 0 : run - 1;
        within = '\0';
      } else if (c == '\n' && n_quotes == 1) {
        within = '\0';
      }
    } else if (c == '#' || c == '"' || c == '\'') {
      within = c;
      n_quotes = run >= 3 ? 3 : 1;
      if (c != '#') at += n_quotes - 1;
    } else if (c == '.') {
      if (++dots > max_dots) fail(fmt::format("a key with more than {} dots", max_dots));
    } else if (c == '[' || c == '{') {
      dots = 0;
      if (++depth > max_depth) fail(fmt::format("arrays and tables are nested deeper than {}", max_depth));
    } else if (c == ']' || c == '}') {
      dots = 0;
      --depth;
    } else if (c == ',' || c == '=') {
      dots = 0;
    } else if (static_cast<unsigned char>(c) >= 0x80) {
      fail("letters beyond ASCII stand in quotes and comments only");
    }
    if (at < text.size() && text[at] == '\n') {
      ++line;
      dots = 0;
    }
  }
}

std::string written(const toml::node& node) {
  if (node.is_table()) return "a table";
  if (const toml::array* const array = node.as_array()) {
    // toml++ 3.3 computes the width of numbers below 1 by an undefined cast when it writes arrays
    std::vector<std::string> elements;
    for (const toml::node& element : *array) elements.push_back(written(element));
    return shortened(fmt::format("[{}]", fmt::join(elements, ", ")));
  }
  std::ostringstream text;
  node.visit([&](const auto& value) { text << value; });
  return shortened(text.str());
}

std::vector<std::pair<std::string, const toml::node*>> entries_of(const toml::table& table) {
  std::vector<std::pair<std::string, const toml::node*>> entries;
  for (const auto& [name, node] : table) entries.emplace_back(name.str(), &node);
  std::stable_sort(entries.begin(), entries.end(), [](const auto& a, const auto& b) {
    const auto& from = a.second->source().begin;
    const auto& to = b.second->source().begin;
    return std::pair(from.line, from.column) < std::pair(to.line, to.column);
  });
  return entries;
}

void TomlReader::fail(const toml::node& node, const std::string& key, const std::string& message) const {
  fail(line_of(node), key, message);
}

void TomlReader::fail(int line, const std::string& key, const std::string& message) const {
  // names and texts of the file may be as long as the file
  constexpr std::size_t enough = 200, enough_words = 4000;
  throw LocatedError(fmt::format("{}:{}: {}: {}", name_, line, shortened(key, enough), shortened(message, enough_words)));
}

void TomlReader::only_keys(const toml::table& table, const std::string& where, const std::vector<std::string>& known) const {
  for (const auto& [key, node] : entries_of(table)) {
    if (std::find(known.begin(), known.end(), key) == known.end()) {
      fail(*node, where.empty() ? key : fmt::format("{}.{}", where, key),
           fmt::format("unknown key; known here: {}", fmt::join(known, ", ")));
    }
  }
}

const toml::table& TomlReader::table(const toml::node& node, const std::string& key) const {
  if (!node.is_table()) fail(node, key, fmt::format("expected a table, got {}", written(node)));
  return *node.as_table();
}

const toml::array& TomlReader::array(const toml::node& node, const std::string& key) const {
  if (!node.is_array()) fail(node, key, fmt::format("expected an array [ … ], got {}", written(node)));
  return *node.as_array();
}

std::string TomlReader::text(const toml::node& node, const std::string& key) const {
  if (!node.is_string()) fail(node, key, fmt::format("expected a text in quotes, got {}", written(node)));
  return node.as_string()->get();
}

double TomlReader::number(const toml::node& node, const std::string& key) const {
  const std::optional<double> value = node.is_number() ? node.value<double>() : std::nullopt;
  if (!value || !std::isfinite(*value)) fail(node, key, fmt::format("expected a finite number, got {}", written(node)));
  return *value;
}

bool TomlReader::boolean(const toml::node& node, const std::string& key) const {
  if (!node.is_boolean()) fail(node, key, fmt::format("expected true or false, got {}", written(node)));
  return node.as_boolean()->get();
}

std::pair<double, double> TomlReader::range(const toml::node& node, const std::string& key, bool may_be_equal) const {
  const toml::array& pair = array(node, key);
  if (pair.size() != 2) fail(node, key, fmt::format("expected [lower, upper], got {}", written(node)));
  const double lower = number(*pair.get(0), key);
  const double upper = number(*pair.get(1), key);
  if (!(lower < upper || (may_be_equal && lower == upper)))
    fail(node, key, fmt::format("the lower end {} must be below the upper end {}", lower, upper));
  return {lower, upper};
}

}  // namespace gp2
