#include "inference/growing_cholesky.hpp"

#include <algorithm>
#include <cmath>

#include "base/lapack.hpp"

extern "C" void drot_(const int* n, double* x, const int* incx, double* y, const int* incy, const double* c, const double* s);

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// the lower triangle of the first n rows, without touching what is undefined
void copy_lower(const MatrixXd& from, Index n, MatrixXd& to) {
  for (Index j = 0; j < n; ++j) to.col(j).segment(j, n - j) = from.col(j).segment(j, n - j);
}

}  // namespace

GrowingCholesky::GrowingCholesky(Index n) : z_(n), size_(n) {
  const Index capacity = n + std::max<Index>(64, n / 8);
  memory_.resize(capacity, capacity);
}

GrowingCholesky::GrowingCholesky(const GrowingCholesky& other)
    : memory_(other.memory_.rows(), other.memory_.cols()), z_(other.z_), size_(other.size_) {
  copy_lower(other.memory_, size_, memory_);
}

void GrowingCholesky::reserve(Index n) {
  if (n <= capacity()) return;
  const Index more = std::max(n, capacity() + capacity() / 2);
  MatrixXd memory(more, more);
  copy_lower(memory_, size_, memory);
  memory_.swap(memory);
}

void GrowingCholesky::resize(Index n) {
  if (capacity() != n) memory_.resize(n, n);
  size_ = n;
}

Eigen::Block<const MatrixXd> GrowingCholesky::invert(const std::atomic<bool>* stop) {
  lapack::invert_factored(lower(), {stop});
  return L();
}

VectorXd GrowingCholesky::solve() const {
  VectorXd solution = z_;
  lapack::solve_lower(L(), true, solution);
  return solution;
}

bool GrowingCholesky::factorise(const Ref<const VectorXd>& y, const std::atomic<bool>* stop) {
  if (!lapack::factorise(lower(), {stop})) return false;
  z_ = y;
  lapack::solve_lower(L(), false, z_);
  return true;
}

bool GrowingCholesky::append(MatrixXd k, MatrixXd kappa, const Ref<const VectorXd>& more) {
  const Index m = kappa.rows();
  // [K k; kᵀ κ] = [L 0; lᵀ Λ][L 0; lᵀ Λ]ᵀ: L l = k and Λ Λᵀ = κ − lᵀl
  lapack::solve_lower(L(), false, k);
  const MatrixXd& l = k;
  if (k.size() > 0) kappa.selfadjointView<Eigen::Lower>().rankUpdate(l.transpose(), -1);
  if (!lapack::factorise(kappa)) return false;

  // lᵀz + Λ ζ = υ
  VectorXd zeta = more - l.transpose() * z_;
  lapack::solve_lower(kappa, false, zeta);

  reserve(size_ + m);
  memory_.block(size_, 0, m, size_) = l.transpose();
  memory_.block(size_, size_, m, m).triangularView<Eigen::Lower>() = kappa;
  size_ += m;
  z_.conservativeResize(size_);
  z_.tail(m) = zeta;
  return true;
}

void GrowingCholesky::erase(const std::vector<Index>& rows) {
  const int n_rows = static_cast<int>(rows.size());
  // What is left of K needs L without the rows but with their columns, x_1 … x_m. Rotations of these with the columns behind
  // them, one after another, turn [L x] into a lower triangle and zeros. z, the same combination of columns, turns along.
  MatrixXd x(size_, n_rows);
  VectorXd z_of_x(n_rows);
  const int step = 1;
  int n_open = 0;  // columns taken so far
  for (Index j = 0; j < size_; ++j) {
    double* const column = memory_.col(j).data();
    const int n = static_cast<int>(size_ - j);
    for (int r = 0; r < n_open; ++r) {
      const double length = std::hypot(column[j], x(j, r));
      const double c = column[j] / length, s = x(j, r) / length;
      drot_(&n, column + j, &step, x.col(r).data() + j, &step, &c, &s);
      const double z = z_[j];
      z_[j] = c * z + s * z_of_x[r];
      z_of_x[r] = c * z_of_x[r] - s * z;
    }
    if (n_open < n_rows && rows[static_cast<std::size_t>(n_open)] == j) {
      x.col(n_open).tail(n) = memory_.col(j).segment(j, n);
      z_of_x[n_open++] = z_[j];
      continue;
    }
    // the column moves to its new place, without the rows that go
    const Index kept = j - n_open;
    double* to = memory_.col(kept).data() + kept;
    Index from = j;
    for (int r = n_open; r <= n_rows; ++r) {
      const Index end = r < n_rows ? rows[static_cast<std::size_t>(r)] : size_;
      to = to == column + from ? to + (end - from) : std::copy(column + from, column + end, to);
      from = end + 1;
    }
    z_[kept] = z_[j];
  }
  size_ -= n_rows;
  z_.conservativeResize(size_);
}

}  // namespace gp2
