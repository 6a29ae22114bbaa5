#pragma once

#include <vector>

#include <Eigen/Core>

#include "base/random.hpp"
#include "gp2/prior/kernel.hpp"

namespace gp2 {

/// Random functions ψ_m with E[Σ_m ψ_m(φ) ψ_m(φ')] = k(φ, φ'): with w ~ N(0, I), Σ_m w_m ψ_m is a random function that has the
/// covariance k on average, and a Gaussian process of covariance k as the number of features grows (Rahimi & Recht 2007).
///
/// A product of stationary and periodic factors is a function of Δ = φ − φ', E[cos(ωᵀΔ)] over its spectral density; frequencies
/// of factors add up. Each frequency gives the two features cos(ωᵀφ) and sin(ωᵀφ): the variance is then exact, and only
/// correlations are random. A frequency is drawn as
///
///     se        z/ℓ                       z ~ N(0, I)
///     matern    z/ℓ · √(ν/g)              g ~ Gamma(ν), ν = 3/2 or 5/2
///     rq        z/ℓ · √(g/α)              g ~ Gamma(α)
///     periodic  2π (k⁺_d − k⁻_d)/p_d      k± ~ Poisson(1/(2ℓ_d²)), since exp(κ cos x) = Σ_k I_k(κ) cos(kx), I_k Bessel functions
///
/// Linear factors multiply by a monomial Π φ_d/ℓ_d, each monomial in turn; a term of linear and constant factors alone is those
/// monomials, exactly.
class RandomFeatures {
 public:
  /// @param values      the kernel's parameters
  /// @param n_features  of each term that is not exact; rounded up to even numbers for each monomial
  RandomFeatures(const Kernel& kernel, const Eigen::Ref<const Eigen::VectorXd>& values, int n_features, RandomStream& random);

  [[nodiscard]] int size() const { return size_; }

  /// ψ(φ).
  /// @param point  φ  (D)
  /// @param out    (size())
  void evaluate(const Eigen::Ref<const Eigen::VectorXd>& point, Eigen::Ref<Eigen::VectorXd> out) const;

  /// The gradient of wᵀψ(φ), of a kernel without products (D).
  [[nodiscard]] Eigen::VectorXd gradient(const Eigen::Ref<const Eigen::VectorXd>& weights,
                                         const Eigen::Ref<const Eigen::VectorXd>& point) const;

 private:
  struct Term {
    double scale = 1;                                  // of each feature
    Eigen::MatrixXd frequencies;                       // ω/2π, one per row (F × D); none where the term is its monomials
    std::vector<Eigen::VectorXd> inverse_lengthscale;  // 1/ℓ of each linear factor (D)
    Eigen::Index n_monomials = 1;                      // D to the number of linear factors
  };

  std::vector<Term> terms_;
  int size_ = 0;
};

}  // namespace gp2
