#pragma once

#include "simulation/conditional_constraints.hpp"
#include "simulation/contacts.hpp"
#include "simulation/switching.hpp"

namespace gp2 {

/// What a motion has besides its state: where it is beside, or on, surfaces at which its acceleration jumps, which contacts are closed,
/// and which constraints are there by their conditions.
struct MotionMode {
  Switching switching;
  Contacts contacts;
  ConditionalConstraints conditions;

  /// Whether there is no other mode.
  [[nodiscard]] bool is_fixed() const { return switching.is_empty() && contacts.is_empty() && conditions.is_empty(); }
};

}  // namespace gp2
