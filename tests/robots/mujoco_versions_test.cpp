// What newer versions of MuJoCo have, by arrays as they would hold: the version at hand need not be one of them.

#include <array>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "io_testing.hpp"
#include "robots/mujoco_description.hpp"
#include "robots/mujoco_oracle.hpp"

namespace gp2 {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using mujoco::LaterFields;
using test::input_error_of;
using test::MujocoOracle;
using test::TemporaryFolder;
using testing::ElementsAre;
using testing::IsEmpty;

std::string robot_with(const std::string& rest) {
  constexpr const char* inertial = R"(<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.02 0.015"/>)";
  return fmt::format(R"(<mujoco><compiler angle="radian"/><worldbody><site name="home" pos="1 2 3"/>
      <body name="upper"><joint name="a" axis="0 1 0"/>{0}<site name="p" pos="0 0 0.1" euler="0.3 0 0"/>
      <body name="lower" pos="0 0 0.5"><joint name="b" axis="0 1 0"/>{0}<site name="s" pos="0 0 0.3" euler="0 0.2 0.1"/></body></body>
      </worldbody>{1}</mujoco>)",
                     inertial, rest);
}

// a robot of this MuJoCo, with later fields in place
class Later : public testing::Test {
 protected:
  void load(const std::string& rest) {
    const TemporaryFolder folder;
    robot_ = std::make_unique<MujocoOracle>(folder.write("robot.xml", robot_with(rest)));
    fields_ = mujoco::later_fields(robot_->model());
  }
  [[nodiscard]] RobotDescription description() const { return describe(robot_->model(), fields_, "robot.xml"); }
  [[nodiscard]] std::string error() const {
    return input_error_of([this] { static_cast<void>(description()); });
  }

  std::unique_ptr<MujocoOracle> robot_;
  LaterFields fields_;
};

TEST_F(Later, ARobotWithoutThemIsReadAsEver) {
  load("");
  EXPECT_THAT(description().notes, IsEmpty());
  const std::array<mjtNum, 6> zeros = {};
  fields_.n_poly = 2;
  fields_.body_gravcomp = fields_.jnt_stiffnesspoly = fields_.dof_dampingpoly = zeros.data();
  EXPECT_THAT(description().notes, IsEmpty());
}

TEST_F(Later, AConnectOfSitesHoldsTheirBodies) {
  load(R"(<equality><connect name="c" body1="upper" body2="lower" anchor="0 0 0"/>
      <weld name="w" body1="upper" body2="lower"/></equality>)");
  mjModel& model = const_cast<mjModel&>(robot_->model());
  const std::array<int, 2> types = {mjOBJ_SITE, mjOBJ_SITE};
  fields_.eq_objtype = types.data();
  for (int id = 0; id < 2; ++id) {
    model.eq_obj1id[id] = robot_->site("p");
    model.eq_obj2id[id] = robot_->site(id == 0 ? "home" : "s");
    std::fill_n(model.eq_data + mjNEQDATA * id, 10, 0);
  }
  const RobotDescription robot = description();
  ASSERT_EQ(robot.connects.size(), 1U);
  EXPECT_THAT(robot.connects[0].bodies, ElementsAre(0, -1));
  EXPECT_EQ(robot.connects[0].anchors[0], Vector3d(0, 0, 0.1));
  EXPECT_EQ(robot.connects[0].anchors[1], Vector3d(1, 2, 3));

  ASSERT_EQ(robot.welds.size(), 1U);
  const auto& [connect, rotation] = robot.welds[0];
  EXPECT_THAT(connect.bodies, ElementsAre(0, 1));
  EXPECT_EQ(connect.anchors[1], Vector3d(0, 0, 0.3));
  // the axes of the sites fall together where the bodies have this rotation: R₂ = R₁ R, R₂ S₂ = R₁ S₁
  EXPECT_LT((rotation * robot.sites[2].rotation - robot.sites[1].rotation).norm(), 1e-15);
  EXPECT_GT((rotation - Matrix3d::Identity()).norm(), 0.1);
}

TEST_F(Later, EqualitiesOfUnknownKindsAreRefused) {
  load(R"(<equality><joint name="gear" joint1="a" joint2="b"/></equality>)");
  const_cast<mjModel&>(robot_->model()).eq_type[0] = 99;
  EXPECT_EQ(error(), "robot.xml: equality 'gear' is of a kind that is not known; there is: connect, weld, joint, tendon");
}

TEST_F(Later, ForcesAndInertiasAreRefusedByName) {
  const std::string tendon = R"(<tendon><fixed name="f"><joint joint="a" coef="2"/></fixed></tendon>)";
  const std::string motor = R"(<actuator><motor name="m" joint="a"/></actuator>)";
  const std::array<mjtNum, 3> second = {0, 1.5, 0}, first = {1.5, 0, 0};
  const std::array<mjtNum, 6> polynomial = {0, 0, 0, 1.5, 0, 0};
  struct Case {
    std::string rest;
    const mjtNum* LaterFields::*field;
    const mjtNum* numbers;
    std::string error;
  };
  const auto poly = [](const char* of, const char* what) {
    return fmt::format(
        "robot.xml: {} has a {} of more than one number, a polynomial, which is not known: give one number and write the rest as "
        "mechanics.force",
        of, what);
  };
  for (const Case& c : {
           Case{"", &LaterFields::body_gravcomp, second.data(),
                "robot.xml: body 'upper' has gravcomp = 1.5, but a force against gravity is not known: set it to 0 and write it "
                "as "
                "mechanics.force"},
           Case{tendon, &LaterFields::tendon_armature, first.data(),
                "robot.xml: tendon 'f' has armature = 1.5, but inertias of tendons are not known: set it to 0"},
           Case{"", &LaterFields::jnt_stiffnesspoly, polynomial.data(), poly("joint 'b'", "stiffness")},
           Case{"", &LaterFields::dof_dampingpoly, polynomial.data(), poly("joint 'b'", "damping")},
           Case{tendon, &LaterFields::tendon_stiffnesspoly, second.data(), poly("tendon 'f'", "stiffness")},
           Case{tendon, &LaterFields::tendon_dampingpoly, second.data(), poly("tendon 'f'", "damping")},
           Case{motor, &LaterFields::actuator_dampingpoly, second.data(), poly("actuator 'm'", "damping")},
           Case{motor, &LaterFields::actuator_armature, first.data(),
                "robot.xml: actuator 'm' has an armature or a damping of its own, but actuators are left out: give them to its "
                "joint, times the square of gear"},
           Case{motor, &LaterFields::actuator_damping, first.data(),
                "robot.xml: actuator 'm' has an armature or a damping of its own, but actuators are left out: give them to its "
                "joint, times the square of gear"},
       }) {
    load(c.rest);
    fields_.n_poly = 2;
    fields_.*c.field = c.numbers;
    EXPECT_EQ(error(), c.error);
  }
}

TEST_F(Later, WhatTheFileSwitchesOffIsNoObstacle) {
  load("");
  mjModel& model = const_cast<mjModel&>(robot_->model());
  const std::array<mjtNum, 3> gravcomp = {0, 1, 1};
  fields_.body_gravcomp = gravcomp.data();
  model.opt.disableflags = mjDSBL_GRAVITY;
  EXPECT_EQ(error(), "");
  model.opt.disableflags = mujoco::springs_off | mujoco::dampers_off;
  EXPECT_EQ(error(), "");
  const std::array<mjtNum, 4> polynomial = {0, 0, 1, 1};
  fields_.n_poly = 2;
  fields_.jnt_stiffnesspoly = fields_.dof_dampingpoly = polynomial.data();
  EXPECT_EQ(error(), "");
}

TEST_F(Later, SoftBodiesAndPluginsAreRefusedOrNoted) {
  load("");
  fields_.n_plugins = 1;
  EXPECT_THAT(description().notes, ElementsAre("plugins are left out"));
  const std::array<int, 3> plugins = {-1, -1, 0};
  fields_.body_plugin = plugins.data();
  EXPECT_EQ(error(), "robot.xml: body 'lower' has a plugin, whose forces are not known: remove it");
  fields_.n_flexes = 1;
  EXPECT_EQ(error(), "robot.xml: it has soft bodies (flex), which no joint coordinates describe: remove them");
}

// ---- the fields are found by their names in whatever version

TEST(LaterFieldsOfAModel, AreThoseThatItHas) {
  const mjtByte on = 1;
  const struct {
    int nu = 5, nplugin = 2;
    const mjtNum* body_gravcomp = nullptr;
    const mjtByte* eq_active = nullptr;
  } earlier{5, 2, nullptr, &on};
  EXPECT_EQ(mujoco::later_fields(earlier).n_actuators, 5);
  EXPECT_EQ(mujoco::later_fields(earlier).n_plugins, 2);
  EXPECT_EQ(mujoco::later_fields(earlier).eq_objtype, nullptr);
  EXPECT_TRUE(mujoco::equality_is_active(earlier, 0));
  const std::array<mjtNum, 1> number = {0};
  const bool off = false;
  const struct {
    const mjtNum *body_gravcomp, *tendon_armature;
    std::ptrdiff_t nu = 5, nactuator = 4, nflex = 3;
    const bool* eq_active0 = nullptr;
  } later{number.data(), number.data(), 5, 4, 3, &off};
  const LaterFields fields = mujoco::later_fields(later);
  EXPECT_EQ(fields.body_gravcomp, number.data());
  EXPECT_EQ(fields.tendon_armature, number.data());
  EXPECT_EQ(fields.n_actuators, 4);
  EXPECT_EQ(fields.n_flexes, 3);
  EXPECT_FALSE(mujoco::equality_is_active(later, 0));
}

}  // namespace
}  // namespace gp2
