#include <gmock/gmock.h>

#include "gp2/robots/robot.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

TEST(WithoutMujoco, ReadingARobotSaysWhatToInstall) {
  EXPECT_EQ(
      test::input_error_of([] { read_robot("arm.xml"); }),
      "arm.xml: this gp2 was built without MuJoCo, which reads MJCF and URDF files: install libmujoco-dev and build it again");
}

}  // namespace
}  // namespace gp2
