#pragma once

#include <memory>

#include "gp2/model.hpp"

namespace gp2 {

/// @param fitted_prior, there  priors of the two models
/// @throws InputError naming what differs: coordinates, inputs, the number of latents, or a latent's kernel, features or
///   directions.
void require_same_latents(const Model& fitted, const Prior& fitted_prior, const Model& other, const Prior& there);

/// The prior there, and which of its parameters are those of the fitted system (make_other_system).
/// @throws InputError when a parameter that is one and the same stands in a feature of the prior there.
std::shared_ptr<const OtherSystem> share_parameters(const Model& fitted, const Prior& fitted_prior, const Model& other,
                                                    Prior there);

}  // namespace gp2
