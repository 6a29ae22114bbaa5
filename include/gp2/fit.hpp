#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/inference/likelihood.hpp"
#include "gp2/posterior.hpp"

namespace gp2 {

/// One number that training adjusts, in physical units. All but system parameters and entries of W are positive and optimised as
/// logarithms.
struct Hyperparameter {
  enum class Kind {
    kernel,                // parameter `index` of the kernel of latent `owner`
    signal_stddev,         // s_index of latent `owner`
    shared_signal_stddev,  // one factor for all s of latent `owner`, times `scale`
    noise_stddev,          // σ_index of Observations `owner`
    parameter,             // θ_index of the system
    mixing,                // W_jl of latent `owner`, index = j + p l; optimised in units of `scale`
    sqrt_kappa,            // √κ_index of latent `owner`
  };

  Kind kind = Kind::kernel;
  int owner = 0;
  int index = 0;
  std::string name;
  std::string unit;
  double value = 0;  // where the first restart starts; the fitted value in a FitReport
  double lower = 0, upper = 0;
  Eigen::VectorXd scale;  // of a shared signal standard deviation: its unit per column; of W and √κ: their unit

  /// Log-normal hyper-prior: ½ (log(value/median)/log_stddev)² is added to the objective; none where log_stddev = 0.
  double median = 0, log_stddev = 0;
  /// Normal hyper-prior of a parameter, instead: ½ ((value − median)/stddev)²; none where stddev = 0.
  double stddev = 0;

  [[nodiscard]] bool is_positive() const { return kind != Kind::parameter && kind != Kind::mixing; }
  /// Within 1e-6 of a bound, on the scale it is optimised on.
  [[nodiscard]] bool at_bound() const;
};

/// How hyperparameters start, are bounded and weighed.
struct Protocol {
  enum class Name {
    standard,  // one signal standard deviation per column, wide bounds, weak hyper-priors
    paper,     // Geist & Trimpe 2020: one shared signal standard deviation in [0.5, 10] × output spread, lengthscales in
               // [0.5, 20] × feature spread, estimated parameters within ±0.02 of the model's value, no hyper-prior
  };
  Name name = Name::standard;
  bool hyperprior = true;  // of the standard protocol

  /// The standard protocol's ranges, relative to the default scales, and hyper-priors; docs/priors.md says how they were chosen.
  struct Standard {
    static constexpr double lengthscale_initial = 3, lengthscale_lower = 0.05, lengthscale_upper = 1e6;
    static constexpr double lengthscale_median = 300, lengthscale_log_stddev = 4;
    static constexpr double signal_initial = 1, signal_lower = 1e-3, signal_upper = 1e5;
    static constexpr double signal_median = 1, signal_log_stddev = 3;
    static constexpr double shape_log_stddev = 1.5;  // of α, periods and relative amplitudes
    static constexpr double noise_lower = 1e-6, noise_upper = 2;
    static constexpr double noise_log_stddev = 2;
    static constexpr double discrepancy_lengthscale = 1.25;  // of the feature's spread
    static constexpr double discrepancy_stddev = 0.4;        // of the noise
    static constexpr double start_log_stddev = 1.5;          // of random starts about the first one
  };
};

/// The default scales of a data set, from which hyperparameters start and by which they are bounded.
struct Scales {
  std::vector<Eigen::VectorXd> feature_stddev;  // per latent (D)
  std::vector<Eigen::VectorXd> feature_range;   // per latent (D), largest minus smallest
  std::vector<Eigen::VectorXd> signal_stddev;   // per latent (p): σ_j, M_jj σ_j, or σ̄ / rms(E column)
  std::vector<Eigen::VectorXd> output_stddev;   // per Observations (d)
  Eigen::VectorXd acceleration_stddev;          // σ (nq)
};

/// σ_j = std of the observed ddq_j, or the size of its values where they do not vary; where there are none, or all are 0,
/// σ_j = √(mean over observed i of M_ii σ_i²/M_jj), M at its median.
Scales default_scales(const Prior& prior, const std::vector<Observations>& observations);

/// Everything tunable: kernels and signals of every latent, noise where it is estimated, and the named parameters of the system.
///
/// @param estimated  names of system parameters to estimate
/// @throws InputError for an unknown name, or a parameter of value 0 without bounds.
std::vector<Hyperparameter> default_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                                                    const std::vector<std::string>& estimated, const Protocol& protocol);

/// The values that `hyperparameters` stand for; what they leave out keeps the model's value.
ModelValues model_values(const Prior& prior, const std::vector<Observations>& observations,
                         const std::vector<Hyperparameter>& hyperparameters);

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
  const std::atomic<bool>* stop = nullptr;        // set: return the best so far, as not converged: interrupted
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
/// J(x) ≈ J(x̂) + ½ (x − x̂)ᵀH(x − x̂), which makes x̂ the mean and H⁻¹ the covariance of x given the data. x is each hyperparameter
/// as it is optimised: its logarithm, or where it may be negative (θ, entries of W) itself. The deviation of one allows for not
/// knowing the others.
struct LaplaceUncertainty {
  Eigen::VectorXd stddev;  // of x_k: in the unit of θ and W, of the logarithm else; 0 where held, ∞ where not determined (n)
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
/// conditioned there. Mixing matrices that start at zero, a stationary point, stay there in every run and are let go from the
/// best. Same seed, same bits, for any number of threads.
///
/// @throws InputError, NumericalError  as Likelihood and Posterior; NumericalError when no restart reached a finite likelihood.
Fit fit(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
        const FitOptions& options = {});

}  // namespace gp2
