#include "export/fill_template.hpp"

#include <algorithm>

#include <fmt/format.h>

namespace gp2::c_export {

bool Filling::has(const std::string& condition) const {
  return conditions.contains(condition) || (outer != nullptr && outer->has(condition));
}

const std::string& Filling::text(const std::string& name) const {
  const auto found = texts.find(name);
  return found == texts.end() && outer != nullptr ? outer->text(name) : texts.at(name);
}

namespace {

// whether all of "a,!b" hold
bool holds(std::string_view list, const Filling& with) {
  while (!list.empty()) {
    const std::size_t comma = std::min(list.find(','), list.size());
    const bool negated = list.front() == '!';
    if (with.has(std::string(list.substr(negated ? 1 : 0, comma - (negated ? 1 : 0)))) == negated) return false;
    list.remove_prefix(std::min(comma + 1, list.size()));
  }
  return true;
}

}  // namespace

std::string filled(std::string_view form, const Filling& with) {
  std::string out;
  int depth = 0, left_out_from = 0;  // blocks around the line, and the outermost of them that does not hold, or 0
  for (std::size_t begin = 0; begin < form.size();) {
    const std::size_t end = std::min(form.find('\n', begin), form.size());
    std::string_view line = form.substr(begin, end - begin);
    begin = end + 1;
    if (line == "{end}") {
      if (left_out_from == depth--) left_out_from = 0;
      continue;
    }
    const std::size_t close = line.starts_with('{') ? line.find('}') : std::string_view::npos;
    if (line.starts_with("{if ")) {
      ++depth;
      if (left_out_from == 0 && !holds(line.substr(4, close - 4), with)) left_out_from = depth;
      continue;
    }
    if (left_out_from > 0) continue;
    if (close != std::string_view::npos && close > 1) {
      if (!holds(line.substr(1, close - 1), with)) continue;
      line.remove_prefix(close + 1);
    }
    std::string text(line);
    for (std::size_t at = text.find('@'); at != std::string::npos; at = text.find('@', at)) {
      const std::size_t last = text.find('@', at + 1);
      const std::string& value = with.text(text.substr(at + 1, last - at - 1));
      text.replace(at, last + 1 - at, value);
      at += value.size();
    }
    while (text.ends_with('\n')) text.pop_back();
    if (text.empty() && !line.empty()) continue;
    out += text + '\n';
  }
  return out;
}

std::string called_pieces(std::span<const Piece> pieces, std::string users) {
  std::string out;
  for (auto piece = pieces.rbegin(); piece != pieces.rend(); ++piece) {
    if (users.find(std::string(piece->name) + "(") == std::string::npos) continue;
    out = fmt::format("\n{}{}", piece->text, out);
    users += piece->text;
  }
  return out;
}

}  // namespace gp2::c_export
