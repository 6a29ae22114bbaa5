#pragma once

#include <Eigen/Core>

namespace gp2::internal {

/// Σ a_i b_i over n entries: a plain loop where they are few, which is the usual case in mechanics, else Eigen's.
inline double dot(const double* a, const double* b, Eigen::Index n) {
  constexpr Eigen::Index few = 8;
  if (n > few) return Eigen::Map<const Eigen::VectorXd>(a, n).dot(Eigen::Map<const Eigen::VectorXd>(b, n));
  double sum = 0;
  for (Eigen::Index i = 0; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

}  // namespace gp2::internal
