#include "export/fill_template.hpp"

#include <algorithm>

namespace gp2 {

std::string c_export::filled(std::string_view form, const std::set<std::string>& conditions,
                             const std::map<std::string, std::string>& texts) {
  const auto holds = [&](std::string_view list) {
    while (!list.empty()) {
      const std::size_t comma = std::min(list.find(','), list.size());
      const bool negated = list.front() == '!';
      if (conditions.contains(std::string(list.substr(negated ? 1 : 0, comma - (negated ? 1 : 0)))) == negated) return false;
      list.remove_prefix(std::min(comma + 1, list.size()));
    }
    return true;
  };
  std::string out;
  for (std::size_t begin = 0; begin < form.size();) {
    const std::size_t end = std::min(form.find('\n', begin), form.size());
    std::string_view line = form.substr(begin, end - begin);
    begin = end + 1;
    if (line.starts_with('{') && line.size() > 1) {
      const std::size_t close = line.find('}');
      if (close != std::string_view::npos && close > 1) {
        if (!holds(line.substr(1, close - 1))) continue;
        line.remove_prefix(close + 1);
      }
    }
    std::string text(line);
    for (std::size_t at = text.find('@'); at != std::string::npos; at = text.find('@', at)) {
      const std::size_t close = text.find('@', at + 1);
      const std::string& value = texts.at(text.substr(at + 1, close - at - 1));
      text.replace(at, close + 1 - at, value);
      at += value.size();
    }
    while (text.ends_with('\n')) text.pop_back();
    if (text.empty() && !line.empty()) continue;
    out += text + '\n';
  }
  return out;
}

}  // namespace gp2
