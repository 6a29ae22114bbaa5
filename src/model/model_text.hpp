#pragma once

#include <string>
#include <vector>

#include "gp2/prior/latent_spec.hpp"
#include "gp2/system.hpp"

namespace gp2 {

/// The model file that declares a system and its latents, and leaves to code what is code.
std::string model_text(const System& system, const std::vector<LatentSpec>& latents);

}  // namespace gp2
