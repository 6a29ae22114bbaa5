#pragma once

#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <vector>

#include "gp2/posterior.hpp"
#include "inference/gram.hpp"
#include "inference/inducing_summary.hpp"

namespace gp2 {

/// The latents given the observations, which of these are in it, and what views of the latents need.
struct Posterior::Implementation {
  /// An observed state.
  struct Sample {
    int group = 0;            // Observations it is of
    std::int64_t number = 0;  // rising in the order of adding
    double constant = 0;      // what it adds to −log p(y) beside N(ỹ; 0, K̃ + I)
  };

  /// Not conditioned.
  /// @throws InputError when they do not fit each other.
  Implementation(Prior prior, std::vector<Observations> observations, ModelValues values);

  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  std::vector<Eigen::MatrixXd> C;            // per latent: loading (p × F)
  std::vector<Sample> samples;               // in the order of adding to `latents`; none through inducing points
  std::shared_ptr<LatentPosterior> latents;  // not shared: see own_components
  std::int64_t next_number = 0;
  std::shared_ptr<std::once_flag> conditioning;  // of a lazy posterior: whether `latents` stand; null: they do
  std::size_t n_given_groups = 0;                // of `observations`, that the constructor was given: the first ones

  std::shared_ptr<const Linearisation> about;  // of a nonlinear prior: the posterior mean of its signals

  std::optional<KeptStates> kept;  // through inducing points: which `observations` still are here

  /// The latents given `observations`.
  /// @throws as add_samples
  void condition(const Workers& workers);
  /// What condition is of a nonlinear prior: Gauss–Newton steps, each of which conditions a linear one (theory.md, T47).
  void condition_nonlinear();
  /// Samples of more observations; `observations` stay as they are. On an error nothing has changed.
  /// @param noise_stddev  per group
  /// @param first_group   the group of `observations` that groups[0] is, or is going to be
  /// @throws as the constructor of Posterior.
  void add_samples(const std::vector<Observations>& groups, const std::vector<Eigen::VectorXd>& noise_stddev, int first_group);
  /// What condition and add_samples are through inducing points: of many observations some are kept. What is added to a nonlinear prior
  /// is linearised at the posterior mean of all; what was there stays as it was.
  void condition_through_points(const Workers& workers);
  void add_through_points(const Observations& more, std::size_t group);
  /// Lets the likelihood of all observations count as its power `share`, through inducing points.
  void forget(double share);
  /// Sets `about` for the observations that are here, of a nonlinear prior through points.
  void linearise_kept(const Workers& workers);
  /// Groups without states go, but for those that the constructor was given.
  void erase_empty_groups();
};

[[noreturn]] void throw_not_definite();

/// Where a nonlinear prior is linearised under these values: at its posterior mean, through their inducing points where they have some.
/// @throws as Posterior
std::shared_ptr<const Linearisation> linearisation_of(const Prior& prior, const std::vector<Observations>& observations,
                                                      const ModelValues& values, const Workers& workers = {});

/// Where a nonlinear prior is linearised about whitened inducing variables m; null where some state has no motion.
std::shared_ptr<const Linearisation> linearise_through_points(const Prior& prior, const std::vector<Observations>& observations,
                                                              const ModelValues& values, const InducingLatents& latents,
                                                              const Eigen::VectorXd& m, const Workers& workers);

/// Which samples are of which component: each of one that chance chooses, by the seed and its number alone.
std::vector<std::vector<Eigen::Index>> samples_of_components(int n_components, int n_samples, std::uint64_t seed);

}  // namespace gp2
