#pragma once

#include <algorithm>
#include <numeric>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <fmt/format.h>

// What messages make of words that somebody wrote.
namespace gp2 {

/// A text for a message, its end left out where it is long, between two characters of UTF-8.
inline std::string shortened(std::string_view text, std::size_t max_size = 60) {
  if (text.size() <= max_size) return std::string(text);
  std::size_t end = max_size - 3;
  while (end > 0 && (static_cast<unsigned char>(text[end]) & 0xC0U) == 0x80U) --end;
  return std::string(text.substr(0, end)) + "...";
}

/// "1 row", "2 rows", "0 rows".
/// @param many  the plural where it is not the singular and an s
template <class Count>
std::string counted(Count n, std::string_view one, std::string_view many = "") {
  return n == 1 ? fmt::format("1 {}", one) : many.empty() ? fmt::format("{} {}s", n, one) : fmt::format("{} {}", n, many);
}

/// Levenshtein distance: the least number of characters inserted, removed or changed between a and b.
inline std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), std::size_t{0});
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = std::exchange(row[0], i);
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t change = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = std::exchange(row[j], std::min({row[j] + 1, row[j - 1] + 1, change}));
    }
  }
  return row.back();
}

/// ", did you mean 'dq3'?" for the candidate nearest to `name`; at a tie the one with more of its beginning, then the later one.
/// Empty if none is near.
/// @param prefix  what stands before each of them, and says nothing of which was meant
template <class Names>
std::string suggestion(std::string_view name, const Names& candidates, std::string_view prefix = "") {
  if (name.empty() || name.size() > 64) return "";
  // a name that shares nothing with it is none that was meant
  std::size_t nearest = std::min((name.size() + 2) / 3, name.size() - 1), longest_start = 0;
  std::string_view best;
  for (const std::string_view candidate : candidates) {
    if (candidate.size() > 64) continue;
    const std::size_t distance = edit_distance(name, candidate);
    const auto differs = std::mismatch(name.begin(), name.end(), candidate.begin(), candidate.end()).first;
    const auto start = static_cast<std::size_t>(differs - name.begin());
    if (distance > nearest || (distance == nearest && start < longest_start)) continue;
    nearest = distance;
    longest_start = start;
    best = candidate;
  }
  return best.empty() ? "" : fmt::format(", did you mean '{}{}'?", prefix, best);
}

}  // namespace gp2
