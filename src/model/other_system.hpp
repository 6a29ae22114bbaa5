#pragma once

#include <memory>

#include "gp2/model.hpp"

namespace gp2 {

/// @param at_home, there  priors of the two models
/// @throws InputError naming what differs: coordinates, inputs, the number of latents, or a latent's kernel, features or
///   directions.
void require_same_latents(const Model& home, const Prior& at_home, const Model& other, const Prior& there);

/// The prior there, and which of its parameters are those at home (make_other_system).
/// @throws InputError when a parameter that is one and the same stands in a feature of the prior there.
std::shared_ptr<const OtherSystem> share_parameters(const Model& home, const Prior& at_home, const Model& other, Prior there);

}  // namespace gp2
