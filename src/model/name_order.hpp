#pragma once

#include <cstddef>
#include <set>
#include <string>
#include <string_view>
#include <vector>

namespace gp2 {

/// Letters, digits and _, beginning with a letter or _.
bool is_identifier(std::string_view name);

/// The names in an expression's text.
std::set<std::string> words_of(std::string_view text);

/// Positions 0 … n−1 such that each comes after those it uses, or the positions of a circle.
struct Order {
  std::vector<std::size_t> positions;
  std::vector<std::size_t> circle;
};

/// @param uses  of each position, the positions it uses
Order order_by_use(const std::vector<std::vector<std::size_t>>& uses);

}  // namespace gp2
