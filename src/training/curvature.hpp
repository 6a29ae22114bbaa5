#pragma once

#include <atomic>
#include <vector>

#include <Eigen/Core>

#include "gp2/fit.hpp"
#include "training/objective.hpp"

namespace gp2 {

/// The objective about x to second order, in the hyperparameters that are free: those that are not at a bound.
///
/// Curvatures differ by many orders of magnitude (data may know a mass to 1e-6 of its box, and of a lengthscale only that it is
/// long), so directions are told apart in units of what each x_k would be uncertain by, were the others known.
struct Curvature {
  std::vector<int> free;        // indices in x
  Eigen::VectorXd gradient;     // of the free ones
  Eigen::VectorXd unit;         // 1/√|H_kk|
  Eigen::VectorXd eigenvalues;  // of D H D, D = diag(unit): ascending
  Eigen::MatrixXd eigenvectors;

  /// Below this an eigenvalue may be zero: what differences leave of one, and what a slope across a curved valley adds. Where
  /// parameters enter by their ratio the bottom of the valley is a curve, and the objective is flat along it only at the minimum.
  double zero = 0;

  /// √(gᵀH⁻¹g), how many standard deviations the minimum is away, without directions of no curvature; ∞ where the objective
  /// curves downwards along a direction, so that there is no minimum near.
  [[nodiscard]] double distance_from_optimum() const;
  /// H of the free hyperparameters without what may be zero: positive semidefinite.
  [[nodiscard]] Eigen::MatrixXd information() const;
};

/// Parameters at a bound are held, or free where the objective is flat along a direction that they have a part in: then they are
/// at the bound by chance, and those beside them are as little known.
enum class AtBound { held, free_if_open };

/// H by differences of the exact gradient: two evaluations for each free hyperparameter, six for each θ, nine at a bound.
/// @param stop  where it is given, and set: no further evaluation is begun
/// @throws NumericalError when the objective is not finite about x, or on a stop
Curvature curvature_at(const Objective& objective, const Eigen::VectorXd& x, const std::vector<Hyperparameter>& hyperparameters,
                       const Evaluators& evaluators, const std::atomic<bool>* stop = nullptr, AtBound at_bound = AtBound::held);

LaplaceUncertainty laplace_uncertainty(const Curvature& curvature, const std::vector<Hyperparameter>& hyperparameters);

/// For the optimiser, whose steps stall where curvatures differ much: 1/√|∂²J/∂x_k²| of each θ, by a difference, and 1 for the
/// others, which are logarithms. Also 1 from when it is stopped on.
Eigen::VectorXd scales_of_parameters(const Objective& objective, const Eigen::VectorXd& x,
                                     const std::vector<Hyperparameter>& hyperparameters, const std::atomic<bool>* stop,
                                     Likelihood::Workspace& workspace);

}  // namespace gp2
