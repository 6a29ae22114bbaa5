#include "model/name_order.hpp"

#include <algorithm>
#include <utility>

namespace gp2 {

bool is_identifier(std::string_view name) {
  const auto letter = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; };
  if (name.empty() || !letter(name.front())) return false;
  return std::all_of(name.begin(), name.end(), [&](char c) { return letter(c) || (c >= '0' && c <= '9'); });
}

std::set<std::string> words_of(std::string_view text) {
  const auto in_word = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_';
  };
  std::set<std::string> words;
  for (std::size_t at = 0; at < text.size();) {
    // site("tip").z speaks of no symbol 'tip' or 'z'
    if (text[at] == '"' || text[at] == '\'') at = std::min(text.find(text[at], at + 1), text.size());
    const bool is_component = text.substr(at, 2) == ").";
    if (is_component) at += 2;
    std::size_t end = at;
    while (end < text.size() && in_word(text[end])) ++end;
    if (const std::string_view word = text.substr(at, end - at); is_identifier(word) && !is_component) words.emplace(word);
    at = std::max(end, at + 1);
  }
  return words;
}

Order order_by_use(const std::vector<std::vector<std::size_t>>& uses) {
  enum class Mark { untouched, open, done };
  std::vector<Mark> marks(uses.size(), Mark::untouched);
  Order order;
  // depth first, on a stack of our own: a chain of names may be as long as the file
  std::vector<std::pair<std::size_t, std::size_t>> path;  // position, how many of its uses have been visited
  for (std::size_t root = 0; root < uses.size(); ++root) {
    if (marks[root] == Mark::untouched) path.emplace_back(root, 0);
    while (!path.empty()) {
      const std::size_t at = path.back().first;
      marks[at] = Mark::open;
      if (path.back().second == uses[at].size()) {
        marks[at] = Mark::done;
        order.positions.push_back(at);
        path.pop_back();
        continue;
      }
      const std::size_t next = uses[at][path.back().second++];
      if (marks[next] == Mark::untouched) path.emplace_back(next, 0);
      if (marks[next] == Mark::open) {
        const auto start = std::find_if(path.begin(), path.end(), [&](const auto& step) { return step.first == next; });
        for (auto step = start; step != path.end(); ++step) order.circle.push_back(step->first);
        return order;
      }
    }
  }
  return order;
}

}  // namespace gp2
