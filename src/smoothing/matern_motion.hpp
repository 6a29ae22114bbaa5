#pragma once

#include <array>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <boost/math/quadrature/gauss.hpp>

namespace gp2 {

/// Lower triangular S with S Sᵀ = M Mᵀ.
template <int D, int C>
Eigen::Matrix<double, D, D> triangular_root(const Eigen::Matrix<double, D, C>& M) {
  static_assert(C >= D);
  // Householder reflections from the right, row by row
  Eigen::Matrix<double, D, C> rest = M;
  Eigen::Matrix<double, D, D> S = Eigen::Matrix<double, D, D>::Zero();
  for (int i = 0; i < D; ++i) {
    const double norm = rest.row(i).tail(C - i).norm();
    if (norm > 0) {
      const double pivot = rest(i, i) > 0 ? -norm : norm;
      Eigen::Matrix<double, 1, C> v = Eigen::Matrix<double, 1, C>::Zero();
      v.tail(C - i) = rest.row(i).tail(C - i);
      v[i] -= pivot;
      const double factor = 1 / (norm * (norm + std::abs(rest(i, i))));  // 2 / |v|²
      for (int k = i + 1; k < D; ++k) {
        const double along = factor * rest.row(k).dot(v);
        rest.row(k) -= along * v;
      }
      rest(i, i) = pivot;
    }
    for (int k = i; k < D; ++k) S(k, i) = rest(k, i);
  }
  return S;
}

/// ∫ g² = 1 of g(s) = √intensity s^(D−1) e^(−s) / (D − 1)!
inline double matern_intensity(int D) {
  double intensity = 2;
  for (int k = 1; k < D; ++k) intensity *= 4.0 * k * k / ((2.0 * k) * (2.0 * k - 1));
  return intensity;
}

/// A Matérn process of order ν = D − ½ as the linear stochastic differential equation dx/dτ = F x + e w, x = (q, q′, …), in the
/// time τ = √(2ν) t / ℓ and of unit variance: white noise through 1/(1 + d/dτ)^D.
template <int D>
class MaternMotion {
 public:
  using Vector = Eigen::Matrix<double, D, 1>;
  using Matrix = Eigen::Matrix<double, D, D>;

  /// What happens to a state over a step.
  struct Step {
    Matrix transition;    // Φ = exp(F Δτ)
    Matrix noise_factor;  // G lower triangular, G Gᵀ = Q = ∫₀^Δτ g gᵀ, g(s) = √intensity exp(F s) e
    Vector impulse;       // g(Δτ): ∂Q/∂Δτ = g gᵀ
  };

  MaternMotion() {
    F_.setZero();
    for (int i = 0; i + 1 < D; ++i) F_(i, i + 1) = 1;
    double binomial = 1;
    for (int j = 0; j < D; ++j) {
      F_(D - 1, j) = -binomial;
      binomial *= static_cast<double>(D - j) / (j + 1);
    }
    // (F + I)^D = 0, so that exp(F s) = e^(−s) Σ_{k<D} (F + I)^k s^k / k!
    powers_[0].setIdentity();
    for (int k = 1; k < D; ++k)
      powers_[static_cast<std::size_t>(k)] = powers_[static_cast<std::size_t>(k - 1)] * (F_ + Matrix::Identity()) / k;

    // the spectrum is 1/(1 + ω²)^D up to a factor: E ω^(2m) = E ω^(2m−2) (2m − 1)/(2D − 2m − 1)
    Vector moments = Vector::Ones();
    for (int m = 1; m < D; ++m) moments[m] = moments[m - 1] * (2 * m - 1) / (2 * D - 2 * m - 1);
    stationary_.setZero();
    for (int i = 0; i < D; ++i) {
      for (int j = i % 2; j < D; j += 2) stationary_(i, j) = ((i - j) / 2 % 2 == 0 ? 1 : -1) * moments[(i + j) / 2];
    }
    stationary_root_ = stationary_.llt().matrixL();

    root_intensity_ = std::sqrt(matern_intensity(D));
  }

  [[nodiscard]] const Matrix& F() const { return F_; }
  [[nodiscard]] const Matrix& stationary_root() const { return stationary_root_; }  // of the covariance at any time, lower

  [[nodiscard]] Matrix transition(double step) const {
    Matrix sum = powers_[D - 1];
    for (int k = D - 2; k >= 0; --k) sum = (sum * step + powers_[static_cast<std::size_t>(k)]).eval();
    return std::exp(-step) * sum;
  }

  [[nodiscard]] Step step(double tau) const {
    Step out;
    out.transition = transition(tau);
    out.impulse = impulse(tau);
    // P∞ − Φ P∞ Φᵀ loses all digits of a short step, whose Q₀₀ is of order Δτ^(2D−1); a quadrature has none to lose
    if (tau <= 1) {
      out.noise_factor = quadrature<15>(tau);
    } else if (tau <= 8) {
      out.noise_factor = quadrature<30>(tau);
    } else {
      const Matrix decayed = out.transition * stationary_root_;
      const Matrix Q = stationary_ - decayed * decayed.transpose();
      out.noise_factor = Q.llt().matrixL();
    }
    return out;
  }

 private:
  [[nodiscard]] Vector impulse(double tau) const {
    Vector sum = powers_[D - 1].col(D - 1);
    for (int k = D - 2; k >= 0; --k) sum = (sum * tau + powers_[static_cast<std::size_t>(k)].col(D - 1)).eval();
    return root_intensity_ * std::exp(-tau) * sum;
  }

  /// Gauss–Legendre: the columns √w g(s) are a square root of Q.
  template <int N>
  [[nodiscard]] Matrix quadrature(double tau) const {
    using Rule = boost::math::quadrature::gauss<double, N>;
    Eigen::Matrix<double, D, N> columns;
    int next = 0;
    for (std::size_t k = 0; k < Rule::abscissa().size(); ++k) {
      const double x = Rule::abscissa()[k], weight = std::sqrt(Rule::weights()[k] * tau / 2);
      columns.col(next++) = weight * impulse(tau * (1 + x) / 2);
      if (x != 0) columns.col(next++) = weight * impulse(tau * (1 - x) / 2);
    }
    return triangular_root<D, N>(columns);
  }

  Matrix F_, stationary_, stationary_root_;
  std::array<Matrix, D> powers_;  // (F + I)^k / k!
  double root_intensity_ = 1;
};

}  // namespace gp2
