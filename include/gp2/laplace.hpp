#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/training.hpp"

namespace gp2 {

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
  /// stopped too early for these figures.
  double distance_from_optimum = 0;
};

/// H by central differences of the exact gradient, two or four evaluations for each hyperparameter that is not held.
///
/// @param hyperparameters  fitted, as a FitReport has them
/// @param n_threads        0: as many as the machine has; results do not depend on it
/// @throws InputError, NumericalError  as Likelihood; NumericalError when the likelihood is not finite about the fit
LaplaceUncertainty laplace_uncertainty(const Prior& prior, const std::vector<Observations>& observations,
                                       const std::vector<Hyperparameter>& hyperparameters, int n_threads = 0);

}  // namespace gp2
