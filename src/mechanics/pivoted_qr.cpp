#include "mechanics/pivoted_qr.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "mechanics/dot.hpp"

namespace gp2::internal {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Eigen::VectorXi;

namespace {

// x := (I − τ v vᵀ) x, where v = [1; tail] has `size` entries
void reflect(const double* tail, double tau, Index size, double* x) {
  const double projection = tau * (x[0] + dot(tail, x + 1, size - 1));
  x[0] -= projection;
  for (Index i = 1; i < size; ++i) x[i] -= projection * tail[i - 1];
}

void apply_reflection(const Ref<const MatrixXd>& W, const Ref<const VectorXd>& reflection, Index k, Ref<MatrixXd>& X) {
  const double* const tail = W.data() + k * W.outerStride() + k + 1;
  for (Index column = 0; column < X.cols(); ++column) {
    reflect(tail, reflection[k], W.rows() - k, X.data() + column * X.outerStride() + k);
  }
}

}  // namespace

Index pivoted_qr(Ref<MatrixXd> W, Ref<VectorXd> reflection, Ref<VectorXi> order, double tolerance) {
  const Index d = W.rows(), n = W.cols();
  const auto column = [&](Index j) { return W.data() + j * W.outerStride(); };
  std::iota(order.begin(), order.end(), 0);
  double smallest_pivot = 0;
  for (Index k = 0; k < std::min(d, n); ++k) {
    // the longest of the columns that are left; their lengths are computed anew, which is safer than updating them. Of equal ones the
    // first: rounding decides nothing
    constexpr double beyond_rounding = 1 + 1e-10;
    Index longest = k;
    double square = -1;
    for (Index j = k; j < n; ++j) {
      const double candidate = dot(column(j) + k, column(j) + k, d - k);
      if (candidate > beyond_rounding * square) {
        square = candidate;
        longest = j;
      }
    }
    const double length = std::sqrt(std::max(square, 0.0));
    if (k == 0) smallest_pivot = tolerance * length;
    if (!(length > smallest_pivot)) return k;
    if (longest != k) {
      std::swap_ranges(column(k), column(k) + d, column(longest));
      std::swap(order[k], order[longest]);
    }

    // H [x₀; x] = [β; 0] with β = −sign(x₀) ‖[x₀; x]‖, v = [1; x/(x₀ − β)], τ = (β − x₀)/β. A column that is zero below the
    // diagonal is left as it is
    double* const w = column(k);
    double below = 0;
    for (Index i = k + 1; i < d; ++i) below = std::max(below, std::abs(w[i]));
    if (below == 0) {
      reflection[k] = 0;
      continue;
    }
    const double beta = w[k] > 0 ? -length : length;
    const double scale = 1 / (w[k] - beta);
    reflection[k] = (beta - w[k]) / beta;
    w[k] = beta;
    for (Index i = k + 1; i < d; ++i) w[i] *= scale;
    for (Index j = k + 1; j < n; ++j) reflect(w + k + 1, reflection[k], d - k, column(j) + k);
  }
  return std::min(d, n);
}

void apply_Q_transposed(const Ref<const MatrixXd>& W, const Ref<const VectorXd>& reflection, Index rank, Ref<MatrixXd> X) {
  for (Index k = 0; k < rank; ++k) apply_reflection(W, reflection, k, X);
}

void apply_Q(const Ref<const MatrixXd>& W, const Ref<const VectorXd>& reflection, Index rank, Ref<MatrixXd> X) {
  for (Index k = rank - 1; k >= 0; --k) apply_reflection(W, reflection, k, X);
}

}  // namespace gp2::internal
