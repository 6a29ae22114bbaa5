#pragma once

#include <span>

#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/prior.hpp"

namespace gp2 {

/// The tapes of a latent's features φ(x), expressions of the state, and of their derivatives in it.
inline void set_features(Latent& latent, std::span<const Expression> features, const SystemSymbols& symbols) {
  const std::vector<Expression> state = symbols.state();
  latent.features = Tape(features, state);
  latent.feature_state_derivatives = StateDerivatives(features, state, static_cast<int>(state.size()));
}

/// The tapes of a latent's directions B(x), expressions of the state and the parameters, column-major, and of their derivatives
/// in the state.
inline void set_directions(Latent& latent, std::span<const Expression> directions, const SystemSymbols& symbols) {
  const std::vector<Expression> inputs = symbols.state_and_parameters();
  latent.directions_are_identity = false;
  latent.directions = Tape(directions, inputs);
  latent.direction_state_derivatives = StateDerivatives(directions, inputs, static_cast<int>(symbols.state().size()));
}

}  // namespace gp2
