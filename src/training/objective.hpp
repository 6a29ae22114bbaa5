#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/training/hyperparameter.hpp"

namespace gp2 {

/// −log of the hyper-priors at the hyperparameters' own values, and its derivative in their coordinates added to `gradient`.
double negative_log_hyperpriors(const std::vector<Hyperparameter>& hyperparameters, Eigen::VectorXd* gradient);

/// What training minimises: the negative log likelihood plus hyper-priors. Thread-safe.
class Objective {
 public:
  /// @param prior, observations  outlive it
  /// @param points   through which all is learned; null: exact
  /// @param workers  as Likelihood::Options
  Objective(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
            std::shared_ptr<const InducingPoints> points = nullptr, const Workers& workers = {});

  /// @param x         the hyperparameters' coordinates
  /// @param gradient  in x, of the size of x; not computed when null; left as it was when the value is +∞
  double operator()(const Eigen::VectorXd& x, Eigen::VectorXd* gradient, Likelihood::Workspace& workspace) const;

  /// The hyperparameters at x.
  [[nodiscard]] std::vector<Hyperparameter> at(const Eigen::VectorXd& x) const;

 private:
  [[nodiscard]] ModelValues values(const std::vector<Hyperparameter>& hyperparameters) const;

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  std::vector<Hyperparameter> hyperparameters_;
  std::shared_ptr<const InducingPoints> points_;
  Likelihood likelihood_;
};

/// x: where hyperparameters stand, in their coordinates.
Eigen::VectorXd coordinates(const std::vector<Hyperparameter>& hyperparameters);

}  // namespace gp2
