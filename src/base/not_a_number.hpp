#pragma once

#include <limits>

namespace gp2 {

inline constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();

}  // namespace gp2
