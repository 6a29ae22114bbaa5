#pragma once

#include <string>

#include "gp2/robots/robot.hpp"
#include "robots/mujoco_versions.hpp"

namespace gp2 {

/// From MuJoCo's arrays to the description of a robot.
///
/// @param later  what only some versions of MuJoCo have of the model
/// @param file   stands for the model in messages, and names a robot without a name
/// @throws InputError naming what has no place in a RobotDescription.
RobotDescription describe(const mjModel& model, const mujoco::LaterFields& later, std::string file);

}  // namespace gp2
