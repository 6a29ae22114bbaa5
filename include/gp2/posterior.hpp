#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/likelihood.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 {

class PathwiseSamples;
struct PathwiseOptions;

/// A view at N states: a quantity to predict, of d·N numbers.
struct ViewAt {
  View view;
  Eigen::MatrixXd states;  // (layout size × N)
};

/// A prior conditioned on observations (Geist & Trimpe 2020, eq. 6 and 7 under the prior of eq. 8, through the reduced form of
/// likelihood.hpp). Every quantity is noise-free: the latent one, not the next measurement. Projections are applied last, so
/// constrained means and samples obey A ddq = b, and covariances A Σ Aᵀ = 0, to rounding. Without observations it is the prior.
/// Immutable, cheap to copy, thread-safe.
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
    Eigen::VectorXd mean;        // quantity after quantity, in each state after state
    Eigen::MatrixXd covariance;  // as large
  };
  /// Mean and covariance of several quantities together.
  [[nodiscard]] Joint joint(const std::vector<ViewAt>& quantities) const;
  [[nodiscard]] Joint joint(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  /// Draws from the joint distribution of several quantities, one per column, rows as in Joint. Latent functions are drawn at the
  /// distinct states and viewed afterwards: what views have in common, ddq = L b + T ā, holds sample by sample, to rounding.
  /// Costs the factorisation of a matrix of (latent functions × states) rows; for functions of the state see pathwise.hpp.
  [[nodiscard]] Eigen::MatrixXd sample(const std::vector<ViewAt>& quantities, int n_samples, std::uint64_t seed) const;

  /// The prior under the same hyperparameters, before any observation.
  [[nodiscard]] Posterior without_data() const;

  [[nodiscard]] const Prior& prior() const;
  [[nodiscard]] const std::vector<Observations>& observations() const;
  [[nodiscard]] const ModelValues& values() const;
  [[nodiscard]] double negative_log_likelihood() const;  // −log p(y), physical units, all constants
  [[nodiscard]] int reduced_size() const;                // rows of the factored matrix

  struct Implementation;  // posterior.cpp

 private:
  friend PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options);

  std::shared_ptr<const Implementation> implementation_;
};

}  // namespace gp2
