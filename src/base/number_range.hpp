#pragma once

namespace gp2 {

/// No quantity, and the square of none, is beyond these: sums over data stay finite.
inline constexpr double largest_number = 1e100, smallest_scale = 1e-100;

}  // namespace gp2
