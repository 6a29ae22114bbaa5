#pragma once

#include <algorithm>
#include <vector>

#include <Eigen/Core>

#include "base/simd.hpp"

// Matrices with one row per point, and rows of zeros that pad them to whole vectors (simd.hpp).
namespace gp2 {

/// Makes room for n_points rows; those behind the ones there were are zero.
inline void resize_points(Eigen::MatrixXd& rows, Eigen::Index n_points) {
  if (rows.rows() == simd::padded(n_points)) return;
  rows.conservativeResizeLike(Eigen::MatrixXd::Zero(simd::padded(n_points), rows.cols()));
}

/// Moves what stays of n values to their front, and returns how many that are.
/// @param gone  rising indices
template <typename Value>
Eigen::Index close_gaps(Value* values, Eigen::Index n, const std::vector<Eigen::Index>& gone) {
  if (gone.empty()) return n;
  Value* end = values + gone.front();
  for (std::size_t k = 0; k < gone.size(); ++k) {
    end = std::copy(values + gone[k] + 1, values + (k + 1 < gone.size() ? gone[k + 1] : n), end);
  }
  return end - values;
}

/// Takes rows away, of n_points that there are; those behind move up.
/// @param gone  rising indices
inline void erase_points(Eigen::MatrixXd& rows, Eigen::Index n_points, const std::vector<Eigen::Index>& gone) {
  const Eigen::Index n_gone = static_cast<Eigen::Index>(gone.size());
  for (auto column : rows.colwise()) {
    close_gaps(column.data(), n_points, gone);
    column.segment(n_points - n_gone, n_gone).setZero();
  }
  resize_points(rows, n_points - n_gone);
}

}  // namespace gp2
