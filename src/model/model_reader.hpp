#pragma once

#include "gp2/model.hpp"
#include "model/toml.hpp"

namespace gp2 {

/// Fills a model, which has its name, text and code already, from the tables of its file.
/// @param robot  reads the robot that the file names
/// @throws InputError with line and key, but for what SymbolicSystem and the code say.
void read_model(const toml::table& root, const RobotSource& robot, Model& model);

}  // namespace gp2
