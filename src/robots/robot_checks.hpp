#pragma once

#include "gp2/robots/robot.hpp"

namespace gp2 {

/// What must hold for any description, wherever it comes from: finite numbers, unit axes, right-handed orthonormal rotations,
/// masses ≥ 0, symmetric positive semidefinite inertias, parents before their children, names that are there and stand once.
/// @throws InputError naming the first entry that breaks a rule.
void check_robot(const RobotDescription& robot);

}  // namespace gp2
