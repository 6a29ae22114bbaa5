#pragma once

#include <vector>

#include "gp2/export.hpp"
#include "gp2/fit.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 GP2_API {

/// The delays and lags that a problem wants estimated (FitProblem::late), by the posterior density of them and the hyperparameters
/// together: of rows at most so large a reduced problem, evenly taken, tells, of windows of time all.
inline constexpr int largest_actuator_size = 400;

/// Finds where delays, lags and hyperparameters together are likeliest. The box of each delay and lag is scanned first and last, since
/// with fast commands there may be more than one optimum. Derivatives in the hyperparameters are exact, those in delays and lags
/// differences over a hundredth of their deviations. Standard errors are those of Laplace's approximation, the hyperparameters
/// not known; NaN at a bound, and where the density has no peak, as of a lag near 0.
/// @throws InputError and NumericalError, as fit()
std::vector<ActuatorEstimate> estimate_actuators(const FitProblem& problem, const FitOptions& options);

/// What a person should know of them: at a bound, or not determined.
std::vector<std::string> actuator_notes(const std::vector<ActuatorEstimate>& estimates);

}  // namespace gp2
