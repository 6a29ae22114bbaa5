#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/likelihood.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 {

/// A prior conditioned on observations (Geist & Trimpe 2020, eq. 6 and 7 under the prior of eq. 8, through the reduced form of
/// likelihood.hpp). Every quantity is noise-free: the latent one, not the next measurement. Projections are applied last, so
/// constrained means obey A ddq = b, and their covariances A Σ Aᵀ = 0, to rounding. Immutable, cheap to copy, thread-safe.
class Posterior {
 public:
  /// @throws InputError when M is not positive definite or the constraints contradict each other at an observed state.
  /// @throws NumericalError when the covariance cannot be factored in double precision (noise too small).
  Posterior(Prior prior, std::vector<Observations> observations, ModelValues values);

  /// E[view] at N states (d × N).
  [[nodiscard]] Eigen::MatrixXd mean(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  struct Marginal {
    Eigen::MatrixXd mean;        // (d × N)
    Eigen::MatrixXd covariance;  // (d·d × N): column i is the covariance at state i, column-major
    int n_clipped = 0;           // variances that rounding made negative; they are set to 0

    [[nodiscard]] Eigen::MatrixXd stddev() const;  // (d × N)
  };
  /// Mean and covariance of the view at each state by itself.
  [[nodiscard]] Marginal marginal(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  struct Joint {
    Eigen::VectorXd mean;        // (d·N): state after state
    Eigen::MatrixXd covariance;  // (d·N × d·N)
  };
  /// Mean and covariance of the view at all states together.
  [[nodiscard]] Joint joint(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  [[nodiscard]] const Prior& prior() const;
  [[nodiscard]] const std::vector<Observations>& observations() const;
  [[nodiscard]] const ModelValues& values() const;
  [[nodiscard]] double negative_log_likelihood() const;  // −log p(y), physical units, all constants
  [[nodiscard]] int reduced_size() const;                // rows of the factored matrix

  struct Implementation;  // posterior.cpp

 private:
  std::shared_ptr<const Implementation> implementation_;
};

}  // namespace gp2
