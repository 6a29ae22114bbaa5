#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/training/hyperparameter.hpp"

namespace gp2 GP2_API {

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
    static constexpr double lengthscale_correlation = 0.8;  // of one feature, between directions and terms of the kernel
    static constexpr double signal_initial = 1, signal_lower = 1e-3, signal_upper = 1e5;
    static constexpr double signal_median = 1, signal_log_stddev = 3;
    static constexpr double shape_log_stddev = 1.5;  // of α, periods and relative amplitudes
    static constexpr double noise_lower = 1e-6, noise_upper = 2;
    static constexpr double noise_log_stddev = 2;
    static constexpr double noise_correlation = 0.95;        // of one log, between its accelerations
    static constexpr double discrepancy_lengthscale = 1.25;  // of the feature's spread
    static constexpr double discrepancy_lower = 1e-3, discrepancy_upper = 10;
    static constexpr double discrepancy_median = 0.45, discrepancy_log_stddev = 0.15;  // of the noise
    static constexpr double discrepancy_log_stddev_of_many = 1;                        // rows, which tell its size themselves
    static constexpr double start_log_stddev = 1.5;                                    // of random starts about the first one
  };
};

/// The default scales of a data set, from which hyperparameters start and by which they are bounded.
struct Scales {
  std::vector<Eigen::VectorXd> feature_mean;    // per latent (D)
  std::vector<Eigen::VectorXd> feature_stddev;  // per latent (D)
  std::vector<Eigen::VectorXd> feature_range;   // per latent (D), largest minus smallest
  std::vector<Eigen::VectorXd> feature_centre;  // per latent (D), in the middle between them
  std::vector<Eigen::VectorXd> signal_stddev;  // per latent (p): σ_j, M_jj σ_j, or σ̄ / rms(E column); of a potential all alike
  std::vector<Eigen::VectorXd> output_stddev;  // per Observations (d)
  Eigen::VectorXd acceleration_stddev;         // σ (nq)
};

/// σ_j = std of the observed ddq_j, or the size of its values where they do not vary; where there are none, or all are 0,
/// σ_j = √(mean over observed i of M_ii σ_i²/M_jj), M at its median.
/// @throws InputError when the observations are not of the prior, or nothing is measured.
Scales default_scales(const Prior& prior, const std::vector<Observations>& observations);

/// That a fit by the standard protocol can estimate a parameter of the system.
/// @throws InputError for an unknown name, a parameter in a feature of a latent, and one of value 0 without bounds
void require_estimable(const Prior& prior, const std::string& name);

/// Everything tunable: kernels and signals of every latent, noise where it is estimated, and the named parameters of the system.
///
/// @param estimated  names of system parameters to estimate
/// @throws InputError for an unknown name, or a parameter of value 0 without bounds; and as default_scales.
std::vector<Hyperparameter> default_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                                                    const std::vector<std::string>& estimated, const Protocol& protocol);

}  // namespace gp2
