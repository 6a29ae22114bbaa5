#pragma once

#include <vector>

#include "gp2/fit.hpp"
#include "training/objective.hpp"

namespace gp2 {

// Minimises the objective over the hyperparameters: restarts, escapes, standard errors, draws. The posterior is left to fit().

// For a prior that is linear in its latents, or is made so by the approximation.
// @param optima  not null: becomes where the restarts ended, the best first, without those that found no finite objective
FitReport trained(const Prior& prior, const std::vector<Observations>& observations,
                  const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options, Approximation approximation = {},
                  std::vector<std::vector<Hyperparameter>>* optima = nullptr);

// For a nonlinear prior: by turns the hyperparameters of the prior that is linear about the posterior mean of the latents, and
// that mean under these. Where both stand still the objective is Laplace's evidence, without its own dependence on the mean
// (theory.md, T47). Hyperparameters without a posterior mean give way to the best restart that has one; where none has, the
// search ends with the last that had.
// @param approximation  may have inducing points, and say about what the prior is linear at first
FitReport trained_nonlinear(const Prior& prior, const std::vector<Observations>& observations,
                            std::vector<Hyperparameter> hyperparameters, const FitOptions& options,
                            Approximation approximation = {});

// For either, without inducing points.
FitReport trained_exactly(const Prior& prior, const std::vector<Observations>& observations,
                          const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options);

// For either, through at most options.n_inducing inducing variables.
FitReport trained_through_points(const Prior& prior, const std::vector<Observations>& observations,
                                 const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options);

}  // namespace gp2
