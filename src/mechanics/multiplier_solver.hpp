#pragma once

#include <limits>

#include <Eigen/Core>
#include <Eigen/LU>

#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

/// The multipliers under forces that they change themselves (theory.md, T46), at one state after another:
///
///     λ = G ā(λ) + d,    G = −(A M⁻¹Aᵀ)⁺A,    d = (A M⁻¹Aᵀ)⁺ b,
///
/// by Newton's method on r(λ) = λ − G ā_τ(λ) − d, ā_τ(λ) = ā(0) + τ (ā(λ) − ā(0)). One step is exact where forces are proportional to
/// |λ| and no multiplier changes its sign. Allocates nothing where the sizes are those of the call before.
class MultiplierSolver {
 public:
  /// @param G       (nc × nq)
  /// @param motion  motion(λ, ā, ∂ā/∂λ) writes the last two (nq), (nq × nc)
  /// @returns whether the solution was reached from forces without load. Else det(I − G ∂ā/∂λ) ≤ 0 on the way there: the load grows with
  /// the force it causes as fast as that force, so that there is no motion, or more than one (Painlevé's paradox).
  template <typename Matrix, typename Vector, typename Motion>
  bool solve(const Matrix& G, const Vector& d, const Motion& motion) {
    const Eigen::Index nc = G.rows(), nq = G.cols();
    lambda_.resize(nc);
    if (nc == 0) return true;
    slope_.resize(nq, nc);
    a_bar_.resize(nq);
    D_.resize(nc, nc);
    start(G, d, motion);
    if (run(G, d, motion, 1)) return true;
    constexpr int n_steps = 16;  // the load is let in bit by bit
    start(G, d, motion);
    for (int step = 1; step <= n_steps; ++step) {
      if (!run(G, d, motion, static_cast<double>(step) / n_steps)) return false;
    }
    return true;
  }

  [[nodiscard]] const Eigen::VectorXd& lambda() const { return lambda_; }
  /// What is wrong where there is none.
  [[nodiscard]] MechanicsBatch::Fault fault(int state) const;

 private:
  template <typename Matrix, typename Vector, typename Motion>
  void start(const Matrix& G, const Vector& d, const Motion& motion) {
    lambda_.setZero(G.rows());
    motion(lambda_, a_bar_, slope_);
    free_ = a_bar_;
    lambda_ = d;
    lambda_.noalias() += G.lazyProduct(free_);
    // λ is rounded as its terms are, which cancel where the load is about to change its sign
    change_ = d.cwiseAbs();
    for (Eigen::Index j = 0; j < G.cols(); ++j) change_ += (free_[j] * G.col(j)).cwiseAbs();
    size_ = change_.norm();
  }

  template <typename Matrix, typename Vector, typename Motion>
  bool run(const Matrix& G, const Vector& d, const Motion& motion, double tau) {
    constexpr int most = 40;
    constexpr double enough = 64 * std::numeric_limits<double>::epsilon();
    constexpr double small =
        1e-10;  // large forces that cancel in G ā round more than λ does: steps then stop getting smaller here
    double before = std::numeric_limits<double>::infinity();
    for (int step = 0; step < most; ++step) {
      motion(lambda_, a_bar_, slope_);
      is_finite_ = a_bar_.allFinite() && slope_.allFinite();
      if (!is_finite_) return false;
      D_.setIdentity();
      D_.noalias() -= tau * G.lazyProduct(slope_);
      lu_.compute(D_);
      if (!(lu_.determinant() > 0)) return false;
      a_bar_ = free_ + tau * (a_bar_ - free_);
      residual_ = lambda_ - d;
      residual_.noalias() -= G.lazyProduct(a_bar_);
      change_ = lu_.solve(residual_);
      lambda_ -= change_;
      // where D is nearly singular steps do not get as small as what is left
      const double size = size_ + lambda_.norm();
      const double change = change_.norm();
      const bool is_rounding = change <= small * size && change >= 0.5 * before;
      if (change <= enough * size || residual_.norm() <= 0.1 * enough * size || is_rounding) return lambda_.allFinite();
      before = change;
    }
    return false;
  }

  Eigen::VectorXd free_, lambda_, a_bar_, residual_, change_;
  Eigen::MatrixXd slope_, D_;
  Eigen::PartialPivLU<Eigen::MatrixXd> lu_;
  double size_ = 0;  // of the terms of λ
  bool is_finite_ = true;
};

/// How ā answers to a change of λ where λ answers to ā: K = J D⁻¹, J = ∂ā/∂λ, D = I − G J (theory.md, T47). Allocates nothing where the
/// sizes are those of the call before.
class LoadResponse {
 public:
  /// @param J  (nq × nc)
  /// @param G  of the multipliers (nc × nq)
  void compute(const Eigen::MatrixXd& J, const Eigen::Ref<const Eigen::MatrixXd>& G) { compute(J, G, J); }
  /// @param J_part  of a part of the motion, whose K is J_part D⁻¹
  void compute(const Eigen::MatrixXd& J, const Eigen::Ref<const Eigen::MatrixXd>& G, const Eigen::MatrixXd& J_part) {
    D_transposed_.setIdentity(J.cols(), J.cols());
    D_transposed_.noalias() -= J.transpose().lazyProduct(G.transpose());
    lu_.compute(D_transposed_);
    J_transposed_ = J_part.transpose();
    K_transposed_ = lu_.solve(J_transposed_);
    K_ = K_transposed_.transpose();
  }

  [[nodiscard]] const Eigen::MatrixXd& K() const { return K_; }
  /// X D⁻¹
  [[nodiscard]] Eigen::MatrixXd over_D(const Eigen::MatrixXd& X) const { return lu_.solve(X.transpose()).transpose(); }

 private:
  Eigen::MatrixXd D_transposed_, J_transposed_, K_transposed_, K_;
  Eigen::PartialPivLU<Eigen::MatrixXd> lu_;
};

}  // namespace gp2
