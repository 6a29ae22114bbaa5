#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/inference/inducing.hpp"
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
  double fraction = 0;      // of the work, estimated
  bool is_drawing = false;  // hyperparameters, after the restarts
  int n_states = 0;         // of those of a long log that are fitted by turns, with a best of their own; 0: all at once
};

struct FitReport;

struct FitOptions {
  static constexpr double seconds_between_improvements = 5;

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
  int n_draws = 0;                                // of hyperparameters, over which the posterior is then the mixture; 0: none
  int n_inducing = 0;                             // inducing variables at most, through which all is learned; 0: none, exact
  std::shared_ptr<const Ranks> ranks = nullptr;   // other processes that work on the same fit
  int n_train = 0;                                // states at most that hyperparameters are found from, evenly taken; 0: all
  std::function<void(const Progress&)> progress;  // called from worker threads, one at a time
  /// Told of the best so far, as if the fit were interrupted there, with the observations that it was found from: whenever a run of the
  /// optimiser has got lower, and while one does every `seconds_between_improvements`. Called as `progress` is.
  std::function<void(const FitReport&, const std::vector<Observations>&)> improved = {};
  /// Set: return the best so far, as not converged: interrupted. The evaluations under way are given up within a second or so,
  /// draws that are not complete are dropped, and the posterior is conditioned when it is first asked (Posterior::lazy).
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

/// Draws of the hyperparameters given the data, by Hamiltonian Monte Carlo about the optima that the restarts found (theory.md,
/// T31). Parameters that A or b depends on are held at the optimum, so that means and samples of the mixture obey one constraint.
struct HyperparameterDraws {
  /// Beyond, chains disagree so far that predictions may depend on the seed (docs/priors.md).
  static constexpr double largest_r_hat = 2;

  Eigen::MatrixXd values;  // physical units, the likeliest first (n × draws)
  // over all steps of the chains, of which `values` are some: each (n), in the units of the hyperparameters
  Eigen::VectorXd mean, stddev;    // 0 where held
  Eigen::VectorXd lower, upper;    // of what 95 % of the steps lie within
  Eigen::VectorXd r_hat;           // split R̂ (Gelman et al. 2013, sec. 11.4): near 1 where the chains agree
  Eigen::VectorXd effective_size;  // how many independent draws the steps are worth (ibid. sec. 11.5)
  Eigen::MatrixXd correlation;     // 0 where one is held (n × n)
  int n_chains = 0, evaluations = 0;
  double acceptance = 0;
  int n_impossible = 0;  // draws that `values` has not, for there is no posterior under them; told by `fit`, in no file

  [[nodiscard]] int size() const { return static_cast<int>(values.cols()); }
  /// Whether hyperparameter k was drawn, not held.
  [[nodiscard]] bool is_drawn(Eigen::Index k) const { return stddev[k] > 0; }
};

/// A delay or lag of an input (gp2/actuator.hpp), estimated before all else.
struct ActuatorEstimate {
  std::string name;
  double value = 0;             // [s]
  double stddev = 0;            // [s] NaN at a bound, ∞ where the data do not determine it
  double lower = 0, upper = 0;  // bounds [s]
  /// By how much its error moves estimated parameters: a column, with an entry for each of them, of a factor of what the errors of
  /// all delays and lags add to their covariance. Counted by parameter_uncertainty.
  std::map<std::string, double> moves = {};

  [[nodiscard]] bool at_lower() const { return value - lower <= 1e-6 * (upper - lower); }
  [[nodiscard]] bool at_upper() const { return upper - value <= 1e-6 * (upper - lower); }
};

/// Of a fit through inducing points (theory.md, T37), whose likelihood is a lower bound of the exact one.
struct InducingReport {
  std::shared_ptr<const InducingPoints> points;
  std::shared_ptr<const InducingSummary> summary;  // Posterior::summary
  int n_variables = 0;                             // M
  Eigen::VectorXd left_out;                        // t of all observations, per latent: left_out_by_points
  int n_start = 0;                                 // states that the hyperparameters were fitted to before all of them
  int n_starts = 1;                                // optimiser runs of that: through points there is one
  std::optional<Evaluation::Part> stretches;       // CrossValidation::stretches of all observations, which no file can tell again
};

struct FitReport {
  static constexpr const char* interrupted = "interrupted";  // termination of a fit that was stopped on request
  /// … of one whose hyperparameters and mean of latents that are not linear, found in turn, did not settle
  static constexpr const char* unsettled = "the posterior mean of the latents still changed";

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
  std::optional<HyperparameterDraws> draws;       // of FitOptions::n_draws
  std::vector<ActuatorEstimate> actuators;        // known from then on: of their errors `moves` alone tells
  std::vector<DistrustedValue> distrusted;        // of a robust fit, the farthest first
  std::optional<InducingReport> inducing;         // of FitOptions::n_inducing
  double seconds = 0;
};

struct Fit {
  Posterior posterior;
  FitReport report;
};

/// The fitted hyperparameters' values or, where there are draws, those of each of them.
/// @throws InputError  as model_values, and where draws are not of the hyperparameters.
std::vector<ModelValues> values_of(const Prior& prior, const std::vector<Observations>& observations, const FitReport& report);

/// The posterior under the fitted hyperparameters, or the mixture over their draws.
/// @throws InputError and NumericalError, as Posterior and model_values.
/// @param observations  where the report has a summary those that the posterior has kept
Posterior posterior_of(const Prior& prior, const std::vector<Observations>& observations, const FitReport& report,
                       const Workers& workers = {});

/// Evaluations of the likelihood, with gradients, that drawing takes at most beside those of the curvature at the optima.
inline constexpr int draw_evaluations = 3600;

/// Maximises the posterior density of the hyperparameters (marginal likelihood times hyper-priors) by L-BFGS-B from several
/// starting points. From the best optimum each hyperparameter is then scanned over its box by itself, the others held, and the
/// optimiser runs again from the lowest point found: an optimum in a corner of the box often hides a lower one. The prior is
/// conditioned there. Loadings that start at zero, a stationary point, stay there in every run and are let go from the best.
/// Same seed, same bits, for any number of threads. With n_draws hyperparameters are drawn about the optima then, at the cost of
/// at most `draw_evaluations` more gradients, and the posterior is the mixture.
///
/// A hyperparameter of equal bounds is held at their value.
///
/// @throws InputError and NumericalError, as Likelihood, Posterior and require_hyperparameters; InputError when nothing is measured,
/// a start lies outside its bounds, an option has no meaning, or there are sums over states beside `n_inducing` or `n_train`;
/// NumericalError when no restart reached a finite likelihood, or `stop` was set before one did.
Fit fit(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
        const FitOptions& options = {});

}  // namespace gp2
