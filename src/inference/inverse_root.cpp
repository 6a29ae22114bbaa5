#include "inference/inverse_root.hpp"

#include <algorithm>
#include <cmath>

#include "base/lapack.hpp"
#include "base/simd.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

Index InverseRoot::begin_of(Index i) {
  const Index width = simd::padded(1), whole = i / width;  // `width` rows of each padded length
  return width * width * whole * (whole + 1) / 2 + (i - whole * width) * width * (whole + 1);
}

void InverseRoot::append(const Ref<const MatrixXd>& L) {
  constexpr Index block = 64;
  const Index n = L.rows();
  numbers_.resize(static_cast<std::size_t>(begin_of(n)), 0);
  for (Index first = size_; first < n; first += block) {
    // rows of L⁻¹: Lᵀ y = e
    const Index m = std::min(block, n - first), size = first + m;
    MatrixXd rows = MatrixXd::Zero(size, m);
    rows.bottomRows(m).setIdentity();
    lapack::solve_lower(L.topLeftCorner(size, size), true, rows);
    for (Index j = 0; j < m; ++j) std::copy_n(rows.col(j).data(), first + j + 1, numbers_.data() + begin_of(first + j));
  }
  size_ = n;
}

void InverseRoot::erase(const std::vector<Index>& rows) {
  for (auto row = rows.rbegin(); row != rows.rend(); ++row) erase(*row);
  numbers_.resize(static_cast<std::size_t>(begin_of(size_)));
}

// Rotations of row r with each row below it, one after another, leave column r in none of those but the last, x. With k and κ the
// column and the entry of K⁻¹ that belong to r, the inverse of what stays of K is K⁻¹ − k kᵀ/κ, and k kᵀ/κ = x xᵀ: the others are X.
void InverseRoot::erase(Index r) {
  VectorXd carried = VectorXd::Zero(size_), turned(size_);
  carried.head(r + 1) = Map<const VectorXd>(row(r), r + 1);
  for (Index j = r; j + 1 < size_; ++j) {
    const Index n = j + 2;
    const Map<const VectorXd> below(row(j + 1), n);
    const double length = std::hypot(carried[r], below[r]);
    const double c = length > 0 ? carried[r] / length : 1, s = length > 0 ? below[r] / length : 0;
    turned.head(n) = c * below - s * carried.head(n);
    carried.head(n) = c * carried.head(n) + s * below;
    // row j, without column r
    double* const to = numbers_.data() + begin_of(j);
    std::copy_n(turned.data(), r, to);
    std::copy_n(turned.data() + r + 1, n - r - 1, to + r);
    std::fill(to + n - 1, numbers_.data() + begin_of(j + 1), 0.0);
  }
  --size_;
}

}  // namespace gp2
