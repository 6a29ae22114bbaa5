#pragma once

#include <cmath>

#include <nlohmann/json.hpp>

namespace gp2::command {

/// A number, or null where it is not finite.
inline nlohmann::ordered_json number_or_null(double value) {
  return std::isfinite(value) ? nlohmann::ordered_json(value) : nlohmann::ordered_json();
}

}  // namespace gp2::command
