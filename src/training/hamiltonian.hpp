#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <vector>

#include <Eigen/Core>

#include "gp2/fit.hpp"
#include "training/objective.hpp"

namespace gp2 {

struct HamiltonianOptions {
  int max_evaluations = draw_evaluations;  // of all chains together
  std::uint64_t seed = 0;
  Evaluators evaluators;  // chains go on side by side
  const std::atomic<bool>* stop = nullptr;
  std::function<void(double fraction)> progress = {};  // called from worker threads, one at a time
};

/// Where a chain starts, and its metric: W Wᵀ is about the covariance of x. A row of zeros holds its coordinate.
struct HamiltonianStart {
  Eigen::VectorXd x;
  Eigen::MatrixXd W;  // (n × n)
};

struct HamiltonianDraws {
  std::vector<Eigen::MatrixXd> chains;     // x of each step that is kept (n × steps), as many of each chain
  std::vector<Eigen::VectorXd> objective;  // J there
  double acceptance = 0;                   // mean over these steps
  int evaluations = 0;

  [[nodiscard]] Eigen::VectorXd r_hat() const;           // as in HyperparameterDraws
  [[nodiscard]] Eigen::VectorXd effective_size() const;  // likewise
};

/// Draws x from the density exp(−J(x)) within a box by Hamiltonian Monte Carlo (Neal 2011; theory.md, T31), one chain from each
/// start. The first three tenths of the evaluations of a chain adapt the length of its steps and are dropped. Same seed, same bits.
/// @throws NumericalError when stopped
HamiltonianDraws draw_coordinates(const Objective& objective, const std::vector<HamiltonianStart>& starts,
                                  const Eigen::VectorXd& lower, const Eigen::VectorXd& upper, const HamiltonianOptions& options);

/// Draws about optima, the best of them first: eight chains, shared out among the optima by their masses in Laplace's approximation,
/// each in the metric of the curvature there. Of all their steps n_draws are kept, evenly.
/// @param held  hyperparameters that stay at their value in optima.front()
/// @throws NumericalError  as curvature_at at the best; when stopped
HyperparameterDraws draw_about(const Objective& objective, const std::vector<std::vector<Hyperparameter>>& optima,
                               const std::vector<bool>& held, int n_draws, const HamiltonianOptions& options);

/// posterior_of the draws under which there is one: of a nonlinear prior next to a jam there may be none. The others are dropped
/// from the report, and counted.
/// @throws as posterior_of, where all are such.
Posterior possible_posterior(const Prior& prior, const std::vector<Observations>& observations, FitReport& report,
                             const Workers& workers);

}  // namespace gp2
