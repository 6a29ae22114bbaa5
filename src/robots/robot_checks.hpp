#pragma once

#include "gp2/robots/robot.hpp"

namespace gp2 {

/// What must hold for any description, wherever it comes from: finite numbers, unit axes, right-handed orthonormal rotations,
/// masses ≥ 0, symmetric positive semidefinite inertias, parents before their children, names that are there and stand once.
/// @throws InputError naming the first entry that breaks a rule.
void check_robot(const RobotDescription& robot);

/// Whether none of the principal moments is larger than the sum of the other two, as those of a rigid body are.
bool is_of_rigid_body(const Eigen::Matrix3d& inertia);

}  // namespace gp2
