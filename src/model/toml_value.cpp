#include "model/toml_value.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/number_range.hpp"
#include "base/suggestion.hpp"

namespace gp2 {

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

namespace {

std::string written_node(const toml::node& node) {
  if (node.is_table()) return "a table";
  if (const toml::array* const array = node.as_array()) {
    // toml++ 3.3 computes the width of numbers below 1 by an undefined cast when it writes arrays
    std::vector<std::string> elements;
    for (const toml::node& element : *array) elements.push_back(written_node(element));
    return shortened(fmt::format("[{}]", fmt::join(elements, ", ")));
  }
  std::ostringstream text;
  node.visit([&](const auto& value) { text << value; });
  return shortened(text.str());
}

}  // namespace

std::string TomlValue::written() const { return written_node(*node_); }

void TomlValue::fail_at(int line, const std::string& key, const std::string& message) const {
  // names and texts of the file may be as long as the file
  constexpr std::size_t enough = 200, enough_words = 4000;
  throw LocatedError(fmt::format("{}:{}: {}: {}", *file_name_, line, shortened(key, enough), shortened(message, enough_words)));
}

std::string TomlValue::text() const {
  if (!is_text()) fail(fmt::format("expected a text in quotes, got {}", written()));
  return node_->as_string()->get();
}

double TomlValue::number() const {
  const std::optional<double> value = is_number() ? node_->value<double>() : std::nullopt;
  if (!value || !std::isfinite(*value)) fail(fmt::format("expected a finite number, got {}", written()));
  if (std::abs(*value) > largest_number) {
    fail(fmt::format("{} is too large: at most {:.0e} can be computed with", *value, largest_number));
  }
  return *value;
}

bool TomlValue::boolean() const {
  if (!node_->is_boolean()) fail(fmt::format("expected true or false, got {}", written()));
  return node_->as_boolean()->get();
}

std::pair<double, double> TomlValue::range(bool may_be_equal) const {
  const std::vector<TomlValue> ends = array();
  if (ends.size() != 2) fail(fmt::format("expected [lower, upper], got {}", written()));
  const double lower = ends[0].number(), upper = ends[1].number();
  if (!(lower < upper || (may_be_equal && lower == upper)))
    fail(fmt::format("the lower end {} must be below the upper end {}", lower, upper));
  return {lower, upper};
}

std::vector<TomlValue> TomlValue::array() const {
  if (!is_array()) fail(fmt::format("expected an array [ … ], got {}", written()));
  std::vector<TomlValue> elements;
  for (const toml::node& element : *node_->as_array()) elements.emplace_back(*file_name_, element, key_);
  return elements;
}

const toml::table& TomlValue::table() const {
  if (!is_table()) fail(fmt::format("expected a table, got {}", written()));
  return *node_->as_table();
}

std::vector<std::pair<std::string, TomlValue>> TomlValue::entries() const {
  std::vector<std::pair<std::string, TomlValue>> entries;
  for (const auto& [name, node] : table()) {
    const std::string text(name.str());
    entries.emplace_back(text, TomlValue(*file_name_, node, key_of(text)));
  }
  // toml++ sorts tables by name
  std::stable_sort(entries.begin(), entries.end(), [](const auto& a, const auto& b) {
    const auto& from = a.second.node_->source().begin;
    const auto& to = b.second.node_->source().begin;
    return std::pair(from.line, from.column) < std::pair(to.line, to.column);
  });
  return entries;
}

std::optional<TomlValue> TomlValue::get(const std::string& name) const {
  const toml::node* const node = table().get(name);
  return node == nullptr ? std::nullopt : std::optional(TomlValue(*file_name_, *node, key_of(name)));
}

void TomlValue::only_keys(const std::vector<std::string>& known) const {
  for (const auto& [name, value] : entries()) {
    if (std::find(known.begin(), known.end(), name) == known.end())
      value.fail(fmt::format("unknown key; known here: {}", fmt::join(known, ", ")));
  }
}

}  // namespace gp2
