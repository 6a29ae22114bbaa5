#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/robots/robot.hpp"
#include "robots/robot_xml.hpp"

namespace gp2 {

bool can_read_robots() { return false; }

RobotDescription read_robot(const std::filesystem::path& path) {
  throw InputError(fmt::format(
      "{}: this gp2 was built without MuJoCo, which reads MJCF and URDF files: install libmujoco-dev and build it again",
      path.string()));
}

RobotDescription read_robot(const std::filesystem::path& path, const std::string&) { return read_robot(path); }

}  // namespace gp2
