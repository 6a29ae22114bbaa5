#pragma once

#include <vector>

#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/report_job.hpp"

namespace gp2 {

/// Simulates the motion that states were measured on. Never throws InputError or NumericalError: why there is no motion is a value.
/// @param system    that was measured
/// @param states    rows of a log, NaN where not known (layout size × N)
/// @param episodes  of each row; empty: all of one
Rollout roll_out(const FitSystem& system, const Posterior& posterior, const Eigen::MatrixXd& states,
                 const std::vector<std::string>& episodes);

}  // namespace gp2
