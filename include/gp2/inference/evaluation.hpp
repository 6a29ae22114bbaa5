#pragma once

#include <memory>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

/// How well a posterior predicts measured constrained accelerations.
struct Evaluation {
  std::vector<std::string> outputs;
  Eigen::VectorXd rmse;                    // per output, physical units
  double rmse_normalised = 0;              // mean over outputs of rmse / training std (Geist & Trimpe 2020, table 1); NaN when an
                                           // output was not observed in training
  double nrmse = 0;                        // rms over outputs and points / rms of the test stds
  double max_constraint_error = 0;         // max |A ddq − b| over points and rows, with the parameters as in the model file
  double max_constraint_error_fitted = 0;  // the same with the fitted parameters
  // per-output Gaussian marginals; NaN when there is nothing to average
  double nlpd = 0, coverage95 = 0;                // of measurements: noise included
  double nlpd_latent = 0, coverage95_latent = 0;  // of noise-free targets
  int n_zero_variance = 0;  // marginals without variance (the constraint decides them), left out of the latent figures
  int n = 0;                // points
  int n_missing = 0;        // targets that are not measured (NaN), left out of all figures
};

/// @param states   (layout size × N)
/// @param rows     of ddq that are compared
/// @param targets  (rows × N); NaN: not measured
/// @param other_system  the other system under which they were measured; null: the prior's own
/// @param n_threads  as in Posterior::marginal
Evaluation evaluate_predictions(const Posterior& posterior, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                const std::vector<int>& rows, const Eigen::Ref<const Eigen::MatrixXd>& targets,
                                const std::shared_ptr<const OtherSystem>& other_system = nullptr, int n_threads = 1);

/// max |A ddq − b| over states and rows of A.
/// @param accelerations  (nq × N)
double max_constraint_error(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                            const Eigen::Ref<const Eigen::VectorXd>& parameters,
                            const Eigen::Ref<const Eigen::MatrixXd>& accelerations);

}  // namespace gp2
