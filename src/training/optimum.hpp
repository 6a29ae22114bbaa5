#pragma once

#include <vector>

#include "gp2/fit.hpp"
#include "training/objective.hpp"

namespace gp2 {

// Hyperparameters where the objective is lowest, and what else is asked of them; without the posterior.

// Of a prior that is linear in its latents, or is made so by the approximation: restarts, escapes, standard errors, draws.
// @param optima  not null: becomes where the restarts ended, the best first, without those that found no finite objective
FitReport trained(const Prior& prior, const std::vector<Observations>& observations,
                  const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options, Approximation approximation = {},
                  std::vector<std::vector<Hyperparameter>>* optima = nullptr);

// Of a nonlinear prior: the hyperparameters under the linear one about the posterior mean of the latents, then that mean under these, and
// so on. Where they stand still the objective is Laplace's evidence, its own dependence on the mean left out (theory.md, T47).
// Hyperparameters without a posterior mean give way to the best restart that has one; where none has, the last that had ends the search.
// @param approximation  may have inducing points, and where the prior is linear at first
FitReport trained_nonlinear(const Prior& prior, const std::vector<Observations>& observations,
                            std::vector<Hyperparameter> hyperparameters, const FitOptions& options,
                            Approximation approximation = {});

// Of either, without inducing points.
FitReport trained_exactly(const Prior& prior, const std::vector<Observations>& observations,
                          const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options);

// Through at most options.n_inducing variables.
FitReport trained_through_points(const Prior& prior, const std::vector<Observations>& observations,
                                 const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options);

}  // namespace gp2
