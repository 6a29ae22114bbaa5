#include <cstdio>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

std::vector<std::string> parse_list(const std::string& text) {
  std::vector<std::string> items;
  std::size_t first = 0;
  while (first < text.size()) {
    const std::size_t end = std::min(text.find(',', first), text.size());
    if (end > first) items.push_back(text.substr(first, end - first));
    first = end + 1;
  }
  return items;
}

std::map<std::string, std::string> parse_map(const std::string& text) {
  std::map<std::string, std::string> columns;
  for (const std::string& item : parse_list(text)) {
    const std::size_t equals = item.find('=');
    if (equals == std::string::npos || equals == 0 || equals + 1 == item.size()) {
      throw InputError(fmt::format("--map: '{}' is not LOGNAME=MODELNAME, say theta1=q3", item));
    }
    columns[item.substr(equals + 1)] = item.substr(0, equals);
  }
  return columns;
}

void talk(const std::vector<std::string>& notes) {
  for (const std::string& note : notes) fmt::print(stderr, "gp2: {}\n", note);
}

}  // namespace gp2::command
