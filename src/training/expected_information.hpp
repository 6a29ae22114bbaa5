#pragma once

#include <atomic>
#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/posterior.hpp"
#include "gp2/training/hyperparameter.hpp"

namespace gp2 {

/// What measurements that are yet to be made will tell of the parameters θ and of accelerations. To first order in θ they are
///
///     y' = E[y' | y; θ̂] + J (θ − θ̂) + e,    J = ∂E[y' | y; θ]/∂θ,    e ~ N(0, Σ' + S'),  Σ' = cov(G'ā | y; θ̂),
///
/// where the latents, and what was measured before, are marginalised. With Γ the covariance of θ now it will be
///
///     Γ' = (Γ⁻¹ + Jᵀ(Σ' + S')⁻¹J)⁻¹,                                                             (theory.md, T33)
///
/// and the variance of accelerations anywhere follows from the same joint Gaussian. The values of y' do not enter: an experiment is
/// judged before it is made. What it will tell of the other hyperparameters is left out. Γ is Laplace's; a parameter that the data
/// leave open may be anywhere in its bounds. Thread-safe.
class ExpectedInformation {
 public:
  /// @param observations     of some ddq; what is measured, and with which noise, is as in these
  /// @param hyperparameters  fitted to them
  /// @param other_system     on which is measured; null: that of the prior
  /// @param stop             set: throws NumericalError
  /// @throws InputError, NumericalError  as Posterior and laplace_uncertainty
  ExpectedInformation(const Prior& prior, const std::vector<Observations>& observations,
                      const std::vector<Hyperparameter>& hyperparameters, std::shared_ptr<const OtherSystem> other_system,
                      int n_threads, const std::atomic<bool>* stop);

  [[nodiscard]] const Posterior& posterior() const { return posterior_; }
  [[nodiscard]] const View& view() const { return view_; }                                // ddq as measured, d rows
  [[nodiscard]] const Eigen::VectorXd& noise_stddev() const { return noise_stddev_; }     // σ of that (d)
  [[nodiscard]] const std::vector<Hyperparameter>& parameters() const { return theta_; }  // those that are estimated: θ

  struct Known {
    double log_volume = 0;   // ½ log det Γ, in the coordinates of θ
    Eigen::VectorXd stddev;  // of θ, physical units
    Eigen::MatrixXd region;  // variance of the view at the region in units of σ² (d × R)
  };
  /// What is known after measurements at some states; without them, now.
  /// @param states  of the measurements (layout size × N)
  /// @param region  where accelerations are to be known (layout size × R)
  [[nodiscard]] Known after(const Eigen::MatrixXd& states, const Eigen::MatrixXd& region) const;

 private:
  [[nodiscard]] Eigen::MatrixXd slopes(const Eigen::MatrixXd& states) const;

  Posterior posterior_;
  View view_;
  Eigen::VectorXd noise_stddev_;
  std::vector<Hyperparameter> theta_;
  Eigen::MatrixXd information_;  // Γ⁻¹
  // the posterior below and above θ̂_k, for J
  struct Neighbours {
    Posterior below, above;
    double distance;
  };
  std::vector<Neighbours> neighbours_;
};

}  // namespace gp2
