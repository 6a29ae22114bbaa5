#pragma once

#include "gp2/baselines/baseline.hpp"
#include "gp2/model.hpp"

namespace gp2 {

/// A baseline of means 0 and standard deviations 1.
Baseline unstandardised(const Model& model, Baseline::Kind kind);

/// The prior of a baseline over the features of all latents of a model, angles raw.
/// @throws InputError when a mean or standard deviation has another size than outputs or features.
Prior make_baseline_prior(const Model& model, const Baseline& baseline);

}  // namespace gp2
