#pragma once

#include <vector>

#include <Eigen/Core>

#include "prior/kernel_columns.hpp"

namespace gp2 {

/// Whether the functions of a kernel have a gradient that is known here: it is a sum of se, matern52, rq and linear.
[[nodiscard]] bool has_gradient(const Kernel& kernel);

/// The gradient g = ∇f of a function f ~ GP(k), between n points and one more at a time (theory.md, T44). Of a term k(s) of the
/// kernel, s = ½ δᵀδ, δ = Λ^{1/2}(φ − φ'), Λ = diag(1/ℓ²):
///
///     cov(g(φ), g(φ')) = Λ^{1/2}(k₁ I + k₂ δδᵀ)Λ^{1/2},    cov(g(φ), f(φ')) = −k₁ Λ^{1/2}δ,    k₁ = −dk/ds, k₂ = dk₁/ds
///
/// and k₁ = 1, k₂ = 0 of the term that is linear, whose f is meant up to a constant.
class GradientColumns {
 public:
  /// Memory of the functions below, and the point that `evaluate` moved to; one per thread.
  struct Workspace {
    struct Term {
      Eigen::ArrayXXd delta;              // δ (n × D)
      Eigen::ArrayXd k1, k2, k3;          // times the amplitude's square; k₃ = dk₂/ds
      Eigen::ArrayXd k1_alpha, k2_alpha;  // derivatives in log α of rq
    };
    std::vector<Term> terms;
    Eigen::ArrayXd along, across, product, half_square, base;
    Eigen::ArrayXXd scaled;
    Eigen::ArrayXXd out;  // what multiply() gave last (n × D)
  };

  /// @param columns  the points and the kernel; must outlive this
  explicit GradientColumns(const KernelColumns& columns) : columns_(&columns) {}

  [[nodiscard]] Eigen::Index n_features() const { return columns_->kernel().n_features(); }

  /// Moves to the pairs of the points first … first + n − 1 and φ'. Before anything below.
  /// @param point  as KernelColumns::scale gives it
  void evaluate(Eigen::Index first, Eigen::Index n, const Eigen::VectorXd& point, Workspace& w) const;

  /// cov(g(φ_i), g(φ')) ℓ for every point, to w.out (n × D).
  void multiply(const Eigen::Ref<const Eigen::VectorXd>& loading, Workspace& w) const;

  /// Adds Σ_i cov(g(φ'), g(φ_i)) β_i to the sums (D).
  /// @param beta  (n × D)
  void add_sums(const Eigen::Ref<const Eigen::MatrixXd>& beta, Eigen::Ref<Eigen::VectorXd> sums, Workspace& w) const;

  /// Adds the derivative of those sums in φ', symmetric (D × D).
  void add_derivative(const Eigen::Ref<const Eigen::MatrixXd>& beta, Eigen::Ref<Eigen::MatrixXd> derivative, Workspace& w) const;

  /// Adds Σ_i u_iᵀ ∂cov(g(φ_i), g(φ'))/∂log v ℓ for every parameter v of the kernel.
  /// @param u  (n × D)
  void add_gradient(const Eigen::Ref<const Eigen::MatrixXd>& u, const Eigen::Ref<const Eigen::VectorXd>& loading,
                    Eigen::Ref<Eigen::VectorXd> gradient, Workspace& w) const;

  /// cov(g(φ_i), f(φ')) for every point, but for a constant of each point, to w.out (n × D).
  void of_function(Workspace& w) const;

  /// The variance of f(φ) − f(φ'), to a relative error of ε where 2 k(0) − 2 k would cancel; of matern52 6 ε/r, r = √5 ‖φ − φ'‖/ℓ.
  /// @param difference  φ − φ' (D)
  [[nodiscard]] double variance_of_difference(const Eigen::Ref<const Eigen::VectorXd>& difference) const;

  /// cov(g, g) at a point, a diagonal (D).
  [[nodiscard]] Eigen::VectorXd variance() const;

 private:
  [[nodiscard]] Eigen::Map<const Eigen::ArrayXd> inverse_lengthscales(const Kernel::Term& term) const;
  /// visit(term of the kernel, of the workspace, its inverse lengthscales) for every term.
  template <typename Visit>
  void for_each_term(const Workspace& w, const Visit& visit) const;

  const KernelColumns* columns_;
};

}  // namespace gp2
