#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/training/default_hyperparameters.hpp"
#include "gp2/training/hyperparameter.hpp"

namespace gp2 GP2_API {

/// What the optimiser tells while it runs.
struct Progress {
  int restart = 0, n_restarts = 0;
  int iteration = 0;
  double best = 0;  // lowest objective so far, over all restarts
  double seconds = 0;
  double fraction = 0;  // of the work, estimated
};

struct FitOptions {
  int n_restarts = 5;                             // runs of the optimiser; the first starts at the hyperparameters' own values
  int max_iterations = 1000;                      // per restart; 0: condition at the starting values
  std::uint64_t seed = 0;                         // of the other starting points
  int n_threads = 0;                              // 0: as many as the machine has; results do not depend on it
  int max_side_by_side = 0;                       // evaluations at a time, each with a matrix of its own; 0: n_threads
  double gradient_tolerance = 1e-5;               // stop when the projected gradient's largest entry is below; that in a
                                                  // parameter is per deviation it would have were all else known
  double reduction_tolerance = 1e-12;             // stop when an iteration lowers the objective by less, relatively
  int max_escapes = 5;                            // scans for lower optima from the best one
  bool standard_errors = true;                    // FitReport::uncertainty, where parameters are estimated
  std::function<void(const Progress&)> progress;  // called from worker threads, one at a time
  /// Set: return the best so far, as not converged: interrupted. The evaluations under way are given up within a second or so,
  /// and the posterior is conditioned when it is first asked (Posterior::lazy).
  const std::atomic<bool>* stop = nullptr;
};

/// A value that a robust fit distrusts (robust.hpp): number `row` of the view of Observations `group`, at state `state`.
struct DistrustedValue {
  int group = 0, row = 0, state = 0;
  double distance = 0;      // from what all others predict, in standard deviations of that and its noise
  double noise_factor = 0;  // its noise was taken to be as many times larger
};

/// How one run of the optimiser ended.
struct RestartReport {
  double objective = 0;  // negative log likelihood plus hyper-priors; +∞ where no finite start was found
  double negative_log_likelihood = 0;
  int iterations = 0, evaluations = 0, failed_evaluations = 0;
  bool converged = false;
  std::string termination;  // which inequality stopped it
};

/// How well data determine what was fitted to them: Laplace's approximation. About its minimum the objective of `fit` is
/// J(x) ≈ J(x̂) + ½ (x − x̂)ᵀH(x − x̂), which makes x̂ the mean and H⁻¹ the covariance of x given the data. x_k is the logarithm of a
/// positive hyperparameter, and one that may be negative (θ, entries of a loading) itself. The deviation of one allows for not
/// knowing the others.
struct LaplaceUncertainty {
  Eigen::VectorXd stddev;       // of x_k: 0 where held, ∞ where not determined (n)
  Eigen::MatrixXd correlation;  // of x_k and x_l; 0 where one is held, NaN where one is not determined (n × n)
  std::vector<int> held;        // at a bound, and taken as known
  /// Combinations of x that the data do not determine, a unit vector in the units of `stddev` per column: parameters that enter
  /// by their ratio only, say (n × number of combinations).
  Eigen::MatrixXd undetermined;
  /// √(gᵀH⁻¹g) of what is determined: how many standard deviations the optimum is away. Where it is not small, the optimiser
  /// stopped too early for these figures; ∞ where it stopped on a slope that bends downwards.
  double distance_from_optimum = 0;
};

struct FitReport {
  static constexpr const char* interrupted = "interrupted";  // termination of a fit that was stopped on request

  std::vector<Hyperparameter> hyperparameters;  // fitted values
  double negative_log_likelihood = 0;           // physical units, all constants, without hyper-prior
  double objective = 0;
  bool converged = false;
  std::string termination;
  int iterations = 0;  // of the best restart
  int best_restart = 0;
  int n_escapes = 0;  // times the scan from the best optimum found a lower one
  std::vector<RestartReport> restarts;
  std::optional<LaplaceUncertainty> uncertainty;  // of the hyperparameters, in their order
  std::vector<DistrustedValue> distrusted;        // of a robust fit, the farthest first
  double seconds = 0;
};

struct Fit {
  Posterior posterior;
  FitReport report;
};

/// Maximises the posterior density of the hyperparameters (marginal likelihood times hyper-priors) by L-BFGS-B from several
/// starting points. From the best optimum each hyperparameter is then scanned over its box by itself, the others held, and the
/// optimiser runs again from the lowest point found: an optimum in a corner of the box often hides a lower one. The prior is
/// conditioned there. Loadings that start at zero, a stationary point, stay there in every run and are let go from the best.
/// Same seed, same bits, for any number of threads.
///
/// @throws InputError, NumericalError  as Likelihood, Posterior and require_hyperparameters; InputError when nothing is measured,
/// a start lies outside its bounds, or an option has no meaning; NumericalError when no restart reached a finite likelihood, or
/// `stop` was set before one did.
Fit fit(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
        const FitOptions& options = {});

}  // namespace gp2
