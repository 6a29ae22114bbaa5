#pragma once

#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/fit.hpp"

namespace gp2 GP2_API {

/// How well data determine hyperparameters; H by differences of the exact gradient, two evaluations for each that is not held and
/// six for each θ.
///
/// @param hyperparameters  fitted, as a FitReport has them
/// @param n_threads        0: as many as the machine has; results do not depend on it
/// @throws InputError and NumericalError, as Likelihood; NumericalError when the likelihood is not finite about the fit
LaplaceUncertainty laplace_uncertainty(const Prior& prior, const std::vector<Observations>& observations,
                                       const std::vector<Hyperparameter>& hyperparameters, int n_threads = 0);

/// How well the data know estimated parameters of the system: by the draws of the hyperparameters, where every parameter that is
/// free was drawn; else by Laplace's approximation.
struct ParameterUncertainty {
  bool is_of_draws = false;
  double stddev = 0;  // NaN where it is not known, ∞ where the data do not determine it
  // of draws only
  double mean = 0;
  double lower = 0, upper = 0;  // of the 95 % interval
};
/// @param k  index in report.hyperparameters
/// @throws InputError when there is none of that number.
ParameterUncertainty parameter_uncertainty(const FitReport& report, std::size_t k);
/// Of two of them; NaN where it is not known. @throws as parameter_uncertainty.
double parameter_correlation(const FitReport& report, std::size_t k, std::size_t l);

/// What a person should know of an uncertainty, and what to do about it.
struct UncertaintyNote {
  bool is_warning = true;
  std::string text, mend;
};

/// Of the parameters of a fit: those that the data do not determine, pairs that they hardly tell apart, and standard errors that
/// are not to be trusted.
std::vector<UncertaintyNote> uncertainty_notes(const FitReport& report);

}  // namespace gp2
