#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "gp2/robots/robot.hpp"

namespace gp2 {

/// A robot's file as it goes to MuJoCo, and what MuJoCo does not read.
struct RobotXml {
  /// A joint of a URDF file that follows another: y = offset + multiplier · x.
  struct Mimic {
    std::string joint, followed;
    double multiplier = 1;
    double offset = 0;  // [rad or m]
  };

  bool is_urdf = false;
  std::string text;  // of a URDF file: as MuJoCo shall read it; of a MJCF file: empty, it is read where it lies
  std::vector<Mimic> mimics;
};

/// Reads MJCF or URDF text. A MJCF file is only recognised. A URDF file is checked for the faults that MuJoCo words badly or does
/// not survive (a joint type it does not know), and rewritten: links that are fixed to others stay links of their own
/// (`fusestatic="false"`, unless the file says otherwise), and shapes are left out where the link has its inertia, so that
/// their mesh files need not be there.
///
/// @throws InputError naming the path and the element.
RobotXml read_robot_xml(const std::string& text, const std::filesystem::path& path);

/// As read_robot(path), of a text in place of the file; others that it names lie where they would.
RobotDescription read_robot(const std::filesystem::path& path, const std::string& text);

/// MJCF text with its includes put in and without files that only give shapes and colours: meshes and height fields of geoms on
/// bodies that have their <inertial>, or on the world; pictures of textures; skins. Nothing where the text has none of these, or
/// takes its inertias from shapes (`inertiafromgeom="true"`).
///
/// @throws InputError naming an included file that cannot be read.
std::optional<std::string> mjcf_without_shapes(const std::string& text, const std::filesystem::path& path);

}  // namespace gp2
