#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

/// What all other measured values say of each measured value of one Observations, without its noise.
struct LeaveOneOut {
  Eigen::MatrixXd mean;      // (d × N); NaN where nothing is measured
  Eigen::MatrixXd variance;  // (d × N)
};

/// Leave-one-out predictions of every value, per Observations, by one inversion: Rasmussen & Williams 2006, eq. 5.12, of the
/// covariance Q K̃ Qᵀ + I of all whitened values e, whose inverse is Q P Qᵀ + I − QQᵀ with P = (K̃ + I)⁻¹:
///
///     y_k − mean_k = σ_k α_k / p_k,    variance_k = σ_k² (1/p_k − 1),    α = Qα̃ + (I − QQᵀ) e,  p = diag(Q P Qᵀ + I − QQᵀ).
///
/// Where constraints are soft, α and the inverse are taken from values whitened by C to those in units of σ, and the variance holds
/// what slips beyond what the other rows of the state say of it. They hold the hyperparameters. Costs as much as the posterior and its inverse.
/// @throws InputError, NumericalError  as Posterior.
std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior);

}  // namespace gp2
