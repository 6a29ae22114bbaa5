#pragma once

#include <Eigen/Core>

#include "gp2/prior.hpp"
#include "inference/gram.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

/// cov(∇V at the points of a basis, V at a state − V at a reference), of a potential of signal 1.
class PotentialCross {
 public:
  /// @param basis     of the potential; it and the features must outlive this
  /// @param features  of the states (N × D)
  PotentialCross(const LatentPosterior::Basis& basis, const Eigen::MatrixXd& features, const Eigen::VectorXd& reference);

  /// With state i (n_rows × D).
  [[nodiscard]] Eigen::MatrixXd column(Eigen::Index i);

 private:
  [[nodiscard]] Eigen::MatrixXd at(const Eigen::VectorXd& features);

  const LatentPosterior::Basis& basis_;
  const Eigen::MatrixXd& features_;
  Eigen::MatrixXd of_reference_;
  Eigen::VectorXd point_;
  GradientColumns::Workspace workspace_;
};

/// cov(∇V, ∇V) at points, of a potential of signal 1: all points of one derivative after another (D·N × D·N).
/// @param features  (N × D)
/// @param values    of the kernel's parameters
Eigen::MatrixXd covariance_of_gradients(const Kernel& kernel, const Eigen::MatrixXd& features, const Eigen::VectorXd& values);

/// @throws InputError when the prior has no such latent, or it is no potential.
void require_potential(const Prior& prior, int latent);

}  // namespace gp2
