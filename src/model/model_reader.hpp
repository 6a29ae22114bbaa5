#pragma once

#include <string>
#include <vector>

#include "gp2/model.hpp"
#include "model/toml.hpp"

namespace gp2 {

/// Fills a model, which has its name and text already, from the tables of its file.
/// @param mechanics  the code that gives M, A, b and F; null where they stand in the file
/// @param robot      reads the robot that the file names
/// @throws InputError with line and key, but for what SymbolicSystem and the code say.
void read_model(const toml::table& root, const MechanicsSource* mechanics, const RobotSource& robot, Model& model);

/// A feature that is an angle becomes its sine and cosine; another stays.
std::vector<std::string> expand_angle(const std::string& feature, const std::vector<Coordinate>& coordinates);

}  // namespace gp2
