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
/// what slips beyond what the other rows of the state say of it. They hold the hyperparameters. Costs as much as the posterior
/// and its inverse.
///
/// Draws of a mixture are of the density given all values; given all but y_k draw i counts in proportion to 1/p_i(y_k | others), and
/// these are the moments of the components so weighed:
///
///     mean_k = Σ_i w_i mean_ki,    variance_k = Σ_i w_i (variance_ki + (mean_ki − mean_k)²),
///     w_i ∝ 1/p_i(y_k | others),    Σ_i w_i = 1.
///
/// @throws InputError and NumericalError, as Posterior.
std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior);

/// Every value as predicted without itself, without its row, and without the stretch of time around it.
struct LeftOut {
  static constexpr int n_stretches = 5;  // that are known through inducing points

  std::vector<LeaveOneOut> values;     // leave_one_out
  std::vector<LeaveOneOut> rows;       // what all but those of its own state say of each value, in another view too; NaN where
                                       // double precision cannot tell
  std::vector<LeaveOneOut> stretches;  // what all but those of its own stretch say of each value; empty where not asked for,
                                       // where double precision cannot tell, and where what was learned through inducing points
                                       // was read from a file or got more observations
};

/// The states of each Observations are taken in time order: by t where all of them have one, else in their own. They are cut into
/// `n_stretches` parts of equal number; the first parts of all Observations are left out together, then the second parts, … A part
/// B of whole states, or a state, is left out as a value is, by the same inversion:
///
///     ỹ_B − mean_B = P_BB⁻¹ α̃_B,    covariance_B = P_BB⁻¹ − I,
///
/// which Q brings to the whitened values e and S^{1/2} to the values. The variance holds what slips where constraints are soft. Of a
/// mixture all components count alike where a stretch is left out, and draw i as 1/p_i(y_B | others) where a state is.
/// @param n_stretches  0: none; through inducing points none, or LeftOut::n_stretches
/// @throws InputError and NumericalError, as Posterior.
LeftOut leave_out(const Posterior& posterior, int n_stretches);

}  // namespace gp2
