#pragma once

#include <limits>

#include <fmt/format.h>
#include <Eigen/Core>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

/// The directions of a latent with Latent::Base::admissible, one state after the other: with B = diag(s), W = B² and L and T those of
/// a system whose mass matrix is W⁻¹,
///
///     E = B Π = T B,    dE = T dB − (L dA E + E B dAᵀ Lᵀ B⁻¹), where dB is a multiple of B
///
/// Allocates nothing where the sizes are those of the call before.
class AdmissibleDirections {
 public:
  using Matrix = Eigen::Ref<const Eigen::MatrixXd>;

  /// @param A             (nc × nq)
  /// @param B             diagonal (nq × nq), positive
  /// @param largest_rank  System::largest_rank_of(A)
  /// @returns E (nq × nq), NaN where B is not finite
  /// @throws NumericalError where W⁻¹ overflows or underflows.
  const Eigen::MatrixXd& compute(const Matrix& A, const Matrix& B, int largest_rank = std::numeric_limits<int>::max()) {
    if (b_.size() != A.rows()) b_.setZero(A.rows());
    stddev_ = B.diagonal();
    if (!stddev_.allFinite()) {  // as B is where an entry of the state is not known: who asked tells of it
      E_.setConstant(B.rows(), B.cols(), not_a_number);
      return E_;
    }
    mass_ = stddev_.cwiseAbs2().cwiseInverse().asDiagonal();
    projection_.compute(mass_, A, b_, largest_rank);
    if (!projection_.motion_is_determined()) {
      throw NumericalError(fmt::format(
          "directions that the constraints leave: deviations from {:.3g} to {:.3g} have no squares to compute with in "
          "double precision",
          stddev_.minCoeff(), stddev_.maxCoeff()));
    }
    E_ = projection_.T() * stddev_.asDiagonal();
    return E_;
  }

  /// T (nq × nq)
  [[nodiscard]] const Eigen::MatrixXd& projector() const { return projection_.T(); }

  /// dE where A, of the call before, changes by dA.
  [[nodiscard]] Eigen::MatrixXd differentiate(const Matrix& dA) const {
    const Eigen::MatrixXd L = projection_.L();
    return -(L * dA * E_ + E_ * (stddev_.asDiagonal() * dA.transpose() * L.transpose() * stddev_.cwiseInverse().asDiagonal()));
  }

  /// What dE f needs of f (nq), and then adds to `out` where A_ij changes by `change`.
  void set_functions(const Eigen::VectorXd& f) {
    L_.resize(stddev_.size(), b_.size());
    projection_.write_L(L_);
    Ef_.noalias() = E_ * f;
    scaled_ = f.cwiseQuotient(stddev_);
    multipliers_.noalias() = L_.transpose() * scaled_;
  }
  void add_change(Eigen::Index i, Eigen::Index j, double change, Eigen::Ref<Eigen::VectorXd> out) const {
    out -= change * (Ef_[j] * L_.col(i) + multipliers_[i] * stddev_[j] * E_.col(j));
  }

 private:
  Eigen::VectorXd stddev_, b_;
  Eigen::MatrixXd mass_, E_, L_;
  Eigen::VectorXd Ef_, scaled_, multipliers_;
  UdwadiaKalaba projection_;
};

}  // namespace gp2
