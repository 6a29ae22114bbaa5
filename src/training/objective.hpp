#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/fit.hpp"

namespace gp2 {

/// What the optimiser sees of a hyperparameter: its logarithm, θ measured in widths of its box, an entry of W in its unit.
double to_internal(const Hyperparameter& h, double value);
/// Within the bounds.
double from_internal(const Hyperparameter& h, double x);

/// ½ Σ (log(value/median)/log_stddev)² + ½ Σ ((value − median)/stddev)², and its derivative in x added to `gradient`.
double hyperprior(const std::vector<Hyperparameter>& hyperparameters, Eigen::VectorXd* gradient);

/// What training minimises: the negative log likelihood plus hyper-priors. Thread-safe.
class Objective {
 public:
  /// @param prior, observations  outlive it
  Objective(const Prior& prior, const std::vector<Observations>& observations,
            const std::vector<Hyperparameter>& hyperparameters);

  /// @param x         as the optimiser sees hyperparameters
  /// @param gradient  in x, of the size of x; not computed when null; left as it was when the value is +∞
  double operator()(const Eigen::VectorXd& x, Eigen::VectorXd* gradient, Likelihood::Workspace& workspace) const;

  /// The hyperparameters at x.
  [[nodiscard]] std::vector<Hyperparameter> at(const Eigen::VectorXd& x) const;

 private:
  const Prior& prior_;
  const std::vector<Observations>& observations_;
  std::vector<Hyperparameter> hyperparameters_;
  Likelihood likelihood_;
};

/// Their own values as the optimiser sees them.
Eigen::VectorXd internal_values(const std::vector<Hyperparameter>& hyperparameters);

}  // namespace gp2
