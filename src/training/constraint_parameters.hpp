#pragma once

#include <vector>

#include "gp2/training/hyperparameter.hpp"

namespace gp2 {

/// Parameters of a constraint may vanish from A and b, as the radius of a circle does: the accelerations say nothing of them, but
/// c(q, t) = 0 and c(q, dq, t) = 0 at the logged states do. Weighs each estimated parameter that M, A, b, F and the directions do not
/// depend on by what these residuals say of it: nonlinear least squares over all estimated parameters that they depend on, each
/// residual weighed by its scatter. One of which they say nothing either is held near its starting value, not left to chance, by
/// a hyper-prior as wide as its bounds.
///
/// @param hyperparameters  receive `value` and `hyperprior` of such parameters, unless they have a narrower one
void weigh_by_residuals(const Prior& prior, const std::vector<Observations>& observations,
                        std::vector<Hyperparameter>& hyperparameters);

/// Standard deviation of the value under its hyper-prior, to first order where that is of the logarithm; ∞ without one.
double stddev_of(const HyperPrior& prior);
/// Whether a parameter has a hyper-prior that tells no more than its bounds.
bool is_known_by_bounds_only(const Hyperparameter& h);

/// Which hyperparameters are parameters that A or b depend on, of the prior's own system or another one of the observations, at
/// their states; or that nothing depends on there, as on a restitution: draws of them would be chance, by which motions bounce.
std::vector<bool> held_in_draws(const Prior& prior, const std::vector<Observations>& observations,
                                const std::vector<Hyperparameter>& hyperparameters);

}  // namespace gp2
