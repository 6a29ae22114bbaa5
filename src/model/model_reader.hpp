#pragma once

#include <map>
#include <string>

#include "gp2/model.hpp"
#include "model/toml.hpp"

namespace gp2 {

/// Fills a model, which has its name, text and code already, from the tables of its file.
/// @param robot  reads the robot that the file names
/// @throws InputError with line and key, but for what SymbolicSystem and the code say.
void read_model(const toml::table& root, const RobotSource& robot, Model& model);

/// What the text of a model with a robot says of it.
struct RobotNames {
  std::string file;                               // of the robot
  std::map<std::string, std::string> parameters;  // number of the robot, mass("link7") say -> parameter in its place
};
RobotNames robot_names(const Model& model);

}  // namespace gp2
