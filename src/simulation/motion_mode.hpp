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
};

}  // namespace gp2
