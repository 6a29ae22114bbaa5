#pragma once

#include <cstdint>
#include <memory>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

struct PathwiseOptions {
  int n_features = 2000;  // random features of each latent function and term of its kernel; the error falls as 1/√n_features
  std::uint64_t seed = 0;
};

/// Whole functions drawn from a posterior: each is a vector field that can be evaluated at any state, in any view, and simulated.
/// A ddq = b holds to rounding, as it does for the mean, since views are applied last. Immutable, cheap to copy, thread-safe. Every
/// member function throws InputError when the samples were moved away.
class PathwiseSamples {
 public:
  [[nodiscard]] int n_samples() const;

  /// A sample's view at N states (d × N). The same state gives the same bits, whatever is evaluated along with it.
  ///
  /// @param sample  0 … n_samples() − 1
  /// @throws InputError when there is no such sample, or as Posterior::mean.
  [[nodiscard]] Eigen::MatrixXd evaluate(int sample, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  /// The parameters that a sample was drawn under: of a mixture those of its component.
  /// @throws InputError when there is no such sample.
  [[nodiscard]] const Eigen::VectorXd& parameters(int sample) const;

  /// A sample of a potential at N states, less that at a reference: what `evaluate` gives is the force of this function (N).
  /// @throws InputError as Posterior::potential, or when there is no such sample.
  [[nodiscard]] Eigen::VectorXd potential(int sample, int latent, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                          const Eigen::Ref<const Eigen::VectorXd>& reference) const;

 private:
  struct Implementation;
  explicit PathwiseSamples(std::shared_ptr<const Implementation> implementation);
  [[nodiscard]] const Implementation& implementation() const;  // throws when it was moved away
  friend PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options);

  std::shared_ptr<const Implementation> implementation_;
};

/// Draws functions from a posterior, or from the prior (Posterior::without_data), by pathwise conditioning (Wilson et al. 2021,
/// "Pathwise Conditioning of Gaussian Processes"): a function f̃ of the prior, made of random features, is moved onto the data by
/// the weights of its own misfit,
///
///     f_a(φ) = f̃_a(φ) + Σ_j k_a(φ, φ_j) Z_j,aᵀ α̃_j,    α̃ = (K̃ + I)⁻¹(ỹ − Σ_a Z_a f̃_a − ε),  ε ~ N(0, I).
///
/// Every sample has features of its own, so mean and covariance over samples are those of the posterior for any number of
/// features; only that a sample is Gaussian needs many. A sample depends on the seed and its number alone, to the bit.
///
/// @throws InputError when n_samples or n_features is below 1.
PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options = {});

}  // namespace gp2
