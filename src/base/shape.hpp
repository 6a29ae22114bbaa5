#pragma once

#include <fmt/format.h>
#include <Eigen/Core>

#include "gp2/error.hpp"

namespace gp2 {

/// @param what  the function and its argument, for the message
/// @throws InputError where an argument has another shape.
template <typename Matrix>
void require_shape(const char* what, const Matrix& given, Eigen::Index rows, Eigen::Index columns) {
  if (given.rows() == rows && given.cols() == columns) return;
  throw InputError(fmt::format("{} must be {} × {}, got {} × {}", what, rows, columns, given.rows(), given.cols()));
}

}  // namespace gp2
