#pragma once

#include <string>
#include <vector>

#include "gp2/robots/robot.hpp"

namespace gp2 {

/// A number of a robot as a fit has it.
struct FittedNumber {
  std::string name;  // as in robot_numbers: mass("link7")
  double value = 0;  // in SI units
  bool is_estimated = false;
  double stddev = 0;  // standard error of an estimate; not finite where it is not known
};

struct FittedRobot {
  std::string text;
  RobotDescription robot;   // as the text now has it
  bool is_physical = true;  // whether all inertias written are those of rigid bodies
  std::vector<std::string> notes;
};

/// The text of a MJCF file with fitted numbers in place of its own, each with a comment behind its element; every other byte stays.
/// Numbers of joints are attributes of <joint>. Numbers of a body stand in its <inertial>, which a body without one gets; where a
/// component of an inertia I is fitted, I stands as moments and axes, I = R(quat) diag(diaginertia) Rᵀ, to rounding.
///
/// @param file   of the text, for messages
/// @param robot  as the text has it
/// @throws InputError naming a joint or body that the text itself does not have by name, or where inertias are of shapes whatever
///   <inertial> says.
FittedRobot fitted_mjcf(const std::string& text, const std::string& file, RobotDescription robot,
                        const std::vector<FittedNumber>& numbers);

/// The same of a URDF file: damping and friction in <dynamics> of a joint; mass, centre and inertia in <inertial> of a link, whose
/// axes become those of the link where a component of the inertia is fitted. Notes name what the format has no place for, armature and
/// stiffness, which is left out of the text and of `robot`.
FittedRobot fitted_urdf(const std::string& text, const std::string& file, RobotDescription robot,
                        const std::vector<FittedNumber>& numbers);

}  // namespace gp2
