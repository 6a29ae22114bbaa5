#include <cmath>
#include <numbers>
#include <thread>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <Eigen/Geometry>

#include "gp2/robots/robot.hpp"
#include "io_testing.hpp"
#include "reference_data.hpp"
#include "robots/mujoco_oracle.hpp"

namespace gp2 {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::VectorXd;
using test::input_error_of;
using test::MujocoOracle;
using test::TemporaryFolder;
using testing::AllOf;
using testing::Contains;
using testing::ElementsAre;
using testing::EndsWith;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;
using testing::StartsWith;

constexpr double epsilon = std::numeric_limits<double>::epsilon();
using Type = RobotDescription::Joint::Type;

const std::filesystem::path source = GP2_SOURCE_DIR;

std::string mjcf(const std::string& world, const std::string& rest = "") {
  return fmt::format("<mujoco><compiler angle=\"radian\"/><worldbody>{}</worldbody>{}</mujoco>", world, rest);
}

RobotDescription read(const std::string& text, const char* name = "robot.xml") {
  const TemporaryFolder folder;
  return read_robot(folder.write(name, text));
}

// the folder's name left out
std::string error_of(const std::string& text, const char* name = "robot.xml") {
  const TemporaryFolder folder;
  const std::string path = folder.write(name, text).string();
  std::string error = input_error_of([&] { read_robot(path); });
  if (error.rfind(path, 0) == 0) error.replace(0, path.size(), name);
  return error;
}

constexpr const char* inertial = R"(<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.02 0.015"/>)";

// two hinges, one in the other
std::string two_links(const std::string& rest = "") {
  return mjcf(fmt::format(R"(<site name="home" pos="1 0 0"/>
    <body name="upper"><joint name="a" axis="0 1 0"/>{0}<site name="p" pos="0 0 0.1"/>
    <body name="lower" pos="0 0 0.5"><joint name="b" axis="0 1 0"/>{0}<site name="s" pos="0 0 0.3"/></body></body>)",
                          inertial),
              rest);
}

// ---- poses of a description by the words of robot.hpp, against MuJoCo's

struct Pose {
  Vector3d position = Vector3d::Zero();
  Matrix3d rotation = Matrix3d::Identity();
};

std::vector<Pose> poses(const RobotDescription& robot, const VectorXd& q) {
  std::vector<Pose> poses;
  Eigen::Index coordinate = 0;
  for (const auto& body : robot.bodies) {
    Pose pose = body.parent < 0 ? Pose{} : poses[static_cast<std::size_t>(body.parent)];
    pose.position += pose.rotation * body.position;
    pose.rotation *= body.rotation;
    for (const auto& joint : body.joints) {
      const double moved = q[coordinate++] - joint.reference;
      if (joint.type == Type::slide) {
        pose.position += moved * (pose.rotation * joint.axis);
      } else {
        const Vector3d anchor = pose.position + pose.rotation * joint.anchor;
        pose.rotation *= Matrix3d(Eigen::AngleAxisd(moved, joint.axis));
        pose.position = anchor - pose.rotation * joint.anchor;
      }
    }
    poses.push_back(pose);
  }
  return poses;
}

// poses, masses and inertias are those of MuJoCo
void expect_same_robot(const RobotDescription& robot, MujocoOracle& oracle, double tolerance) {
  ASSERT_EQ(static_cast<int>(robot.joints().size()), oracle.n());
  ASSERT_EQ(static_cast<int>(robot.bodies.size()) + 1, oracle.model().nbody);
  for (int trial = 0; trial < 3; ++trial) {
    const VectorXd q = VectorXd::LinSpaced(oracle.n(), 0.3 - trial, 1.7 * trial - 1);
    oracle.set_state(q, VectorXd::Zero(oracle.n()));
    const std::vector<Pose> all = poses(robot, q);
    for (std::size_t k = 0; k < all.size(); ++k) {
      const auto& body = robot.bodies[k];
      const int id = static_cast<int>(k) + 1;
      EXPECT_LT((all[k].position - oracle.point(id)).norm(), tolerance) << body.name;
      EXPECT_LT((all[k].rotation - oracle.rotation(id)).norm(), tolerance) << body.name;
      EXPECT_EQ(body.mass, oracle.model().body_mass[id]);
      const Vector3d com = all[k].position + all[k].rotation * body.com;
      EXPECT_LT((com - Eigen::Map<const Vector3d>(oracle.data().xipos + 3 * id)).norm(), tolerance) << body.name;
      const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> axes(oracle.data().ximat + 9 * id);
      const Eigen::Map<const Vector3d> moments(oracle.model().body_inertia + 3 * id);
      const Matrix3d inertia = axes * moments.asDiagonal() * axes.transpose();
      EXPECT_LE((all[k].rotation * body.inertia * all[k].rotation.transpose() - inertia).norm(), tolerance * moments.sum())
          << body.name;
    }
    for (std::size_t k = 0; k < robot.sites.size(); ++k) {
      const auto& site = robot.sites[k];
      const Pose pose = site.body < 0 ? Pose{} : all[static_cast<std::size_t>(site.body)];
      const int id = static_cast<int>(k);
      EXPECT_LT((pose.position + pose.rotation * site.position - oracle.site_position(id)).norm(), tolerance) << site.name;
      EXPECT_LT((pose.rotation * site.rotation - oracle.site_rotation(id)).norm(), tolerance) << site.name;
    }
  }
}

void expect_same_robot(const std::string& text) {
  const TemporaryFolder folder;
  const auto path = folder.write("robot.xml", text);
  MujocoOracle oracle(path);
  // a few dozen operations with numbers of the order of 1
  expect_same_robot(read_robot(path), oracle, 100 * epsilon);
}

// ---- the arm

const std::filesystem::path arm_file = source / "experiments/arm_on_surface/iiwa7.xml";

TEST(Arm, HasSevenJointsWithDampingAndASite) {
  const RobotDescription arm = read_robot(arm_file);
  EXPECT_EQ(arm.name, "iiwa7");
  EXPECT_EQ(arm.gravity, Vector3d(0, 0, -9.8));
  EXPECT_THAT(arm.notes, IsEmpty());
  ASSERT_EQ(arm.bodies.size(), 8U);
  const auto joints = arm.joints();
  ASSERT_EQ(joints.size(), 7U);
  for (std::size_t k = 0; k < 7; ++k) {
    EXPECT_EQ(joints[k]->name, fmt::format("q{}", k + 1));
    EXPECT_EQ(joints[k]->axis, Vector3d::UnitZ());
    EXPECT_EQ(joints[k]->damping, 0.5);
    EXPECT_EQ(arm.bodies[k + 1].parent, static_cast<int>(k));
  }
  const auto& link7 = arm.bodies[7];
  EXPECT_EQ(link7.name, "link7");
  EXPECT_EQ(link7.mass, 2);
  EXPECT_EQ(link7.com, Vector3d(0, 0, 0.02));
  EXPECT_TRUE(link7.inertia.isApprox(Matrix3d(Vector3d(0.005, 0.0036, 0.0047).asDiagonal()), 1e-15));
  ASSERT_EQ(arm.sites.size(), 1U);
  EXPECT_EQ(arm.sites[0].name, "tip");
  EXPECT_EQ(arm.sites[0].body, 7);
  EXPECT_EQ(arm.sites[0].position, Vector3d(0, 0, 0.1));
}

TEST(Arm, RightAnglesAreExact) {
  for (const auto& body : read_robot(arm_file).bodies) {
    EXPECT_TRUE((body.rotation.array() == body.rotation.array().round()).all()) << body.name;
    EXPECT_TRUE((body.inertia - Matrix3d(body.inertia.diagonal().asDiagonal())).isZero(0)) << body.name;
  }
}

TEST(Arm, IsTheOneOfMujoco) {
  MujocoOracle oracle(arm_file);
  expect_same_robot(read_robot(arm_file), oracle, 100 * epsilon);
}

TEST(Arm, IsTheOneOfThePublishedUrdf) {
  if (const auto absent = test::why_robots_are_absent()) GTEST_SKIP() << *absent;
  const auto path = test::robot_file("iiwa7.urdf");
  // the URDF's right angles have eleven decimals; read by us they are right angles, so that the numbers are the same
  const RobotDescription ours = read_robot(arm_file);
  const RobotDescription published = read_robot(path);
  ASSERT_EQ(published.bodies.size(), ours.bodies.size());
  for (std::size_t k = 0; k < ours.bodies.size(); ++k) {
    EXPECT_EQ(published.bodies[k].rotation, ours.bodies[k].rotation) << k;
    if (k == 0) continue;  // the base, which stands at z = 0.05 m and does not move
    EXPECT_LT((published.bodies[k].position - ours.bodies[k].position).norm(), epsilon) << k;
    EXPECT_EQ(published.bodies[k].mass, ours.bodies[k].mass) << k;
    EXPECT_LT((published.bodies[k].com - ours.bodies[k].com).norm(), epsilon) << k;
    EXPECT_LT((published.bodies[k].inertia - ours.bodies[k].inertia).norm(), epsilon) << k;
    EXPECT_EQ(published.bodies[k].joints[0].axis, ours.bodies[k].joints[0].axis) << k;
    EXPECT_EQ(published.bodies[k].joints[0].damping, 0.5) << k;
  }
  EXPECT_THAT(published.notes, Contains(HasSubstr("are taken as right angles; the farthest was 4.9e-12 off")));

  // as MuJoCo sees the two files: six angles 4.9e-12 rad off, arms of 1 m, M of the order of 3 kg m², 10 kg of arm
  MujocoOracle of_urdf(path);
  MujocoOracle of_ours(arm_file);
  of_urdf.set_gravity({0, 0, -9.8});
  constexpr double off = 6 * 4.9e-12;
  for (int trial = 0; trial < 5; ++trial) {
    const VectorXd q = VectorXd::LinSpaced(7, -trial, 0.7 * trial + 0.3);
    const VectorXd dq = VectorXd::LinSpaced(7, 1, -1);
    of_urdf.set_state(q, dq);
    of_ours.set_state(q, dq);
    EXPECT_LT((of_urdf.mass() - of_ours.mass()).cwiseAbs().maxCoeff(), 3 * 2 * off);
    EXPECT_LT((of_urdf.bias() - of_ours.bias()).cwiseAbs().maxCoeff(), 100 * 2 * off);
    EXPECT_LT((of_urdf.passive() - of_ours.passive()).cwiseAbs().maxCoeff(), epsilon);
    const Vector3d tip = of_urdf.point(of_urdf.body("lbr_iiwa_link_7"), {0, 0, 0.1}) + Vector3d(0, 0, 0.05);
    EXPECT_LT((tip - of_ours.site_position(of_ours.site("tip"))).norm(), off);
  }
}

// ---- the four-bar linkage

TEST(FourBar, IsClosedWhereAllCoordinatesAreZero) {
  const RobotDescription robot = read_robot(source / "models/four_bar.xml");
  EXPECT_THAT(robot.notes, IsEmpty());
  ASSERT_EQ(robot.joints().size(), 3U);
  ASSERT_EQ(robot.connects.size(), 1U);
  const auto& connect = robot.connects[0];
  EXPECT_EQ(connect.name, "joint of coupler and rocker");
  EXPECT_EQ(connect.bodies[0], robot.body_index("coupler"));
  EXPECT_EQ(connect.bodies[1], robot.body_index("rocker"));
  const auto at = poses(robot, VectorXd::Zero(3));
  const auto end = [&](std::size_t k) {
    const Pose& pose = at[static_cast<std::size_t>(connect.bodies.at(k))];
    return Vector3d(pose.position + pose.rotation * connect.anchors.at(k));
  };
  EXPECT_LT((end(0) - end(1)).norm(), 4 * epsilon);
  EXPECT_LT((end(0) - Vector3d(0.24, 0, 0.28)).norm(), 4 * epsilon);

  // nothing leaves the plane, not even by rounding
  for (const auto& body : robot.bodies) {
    EXPECT_EQ(body.com.y(), 0);
    EXPECT_EQ(body.inertia(0, 1), 0);
    EXPECT_EQ(body.inertia(1, 2), 0);
    EXPECT_GT(body.mass, 0.05);
  }
  for (const Vector3d& anchor : connect.anchors) EXPECT_EQ(anchor.y(), 0);
}

TEST(FourBar, HasThreeRowsOfRankTwo) {
  MujocoOracle oracle(source / "models/four_bar.xml");
  oracle.set_state(VectorXd::Zero(3), VectorXd::Zero(3));
  const auto rows = oracle.equality_rows();
  ASSERT_EQ(rows.jacobian.rows(), 3);
  EXPECT_LT(rows.violation.norm(), 4 * epsilon);
  EXPECT_EQ(Eigen::FullPivLU<Eigen::MatrixXd>(rows.jacobian).rank(), 2);
}

// ---- bodies and joints

TEST(Reader, PosesAreThoseOfMujocoForEveryKindOfTree) {
  const std::string body = fmt::format(R"(<body pos="0.1 0.2 0.3" euler="0.3 0.2 0.1">{}{})", "{}", inertial);
  const auto with = [&](const char* joints) { return mjcf(fmt::format(fmt::runtime(body), joints) + "</body>"); };
  expect_same_robot(with(R"(<joint type="hinge" axis="1 2 3"/>)"));
  expect_same_robot(with(R"(<joint type="slide" axis="1 2 3"/>)"));
  expect_same_robot(with(R"(<joint type="hinge" axis="0 1 0" pos="0.3 -0.1 0.2"/>)"));
  expect_same_robot(with(R"(<joint type="hinge" axis="0 1 0" pos="0.3 -0.1 0.2" ref="0.7"/>)"));
  // several joints on one body act one after the other
  expect_same_robot(
      with(R"(<joint type="slide" axis="1 0 1"/><joint axis="0 1 0" pos="0.1 0 0"/><joint axis="1 0 0" ref="1"/>)"));
  expect_same_robot(with(R"(<joint axis="0 1 0" pos="0.1 0 0"/><joint type="slide" axis="0 0 1" ref="-0.4"/>)"));
  // a body fixed to its parent, and a child of that
  expect_same_robot(mjcf(fmt::format(
      R"(<body euler="0.1 0 0"><joint/>{0}<body pos="1 0 0" euler="0 0.4 0">{0}<site pos="0.1 0 0" euler="0 0 0.3"/>
         <body pos="0 1 0"><joint axis="1 1 0"/>{0}</body></body></body>)",
      inertial)));
}

TEST(Reader, InertiasComeInTheAxesOfTheBody) {
  const RobotDescription robot = read(mjcf(R"(<body><joint/>
    <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.02 0.03 0.025 0.001 0.002 0.003"/></body>)"));
  Matrix3d expected;
  expected << 0.02, 0.001, 0.002, 0.001, 0.03, 0.003, 0.002, 0.003, 0.025;
  // MuJoCo, which keeps moments and axes, finds these to about 1e-6
  EXPECT_LT((robot.bodies[0].inertia - expected).norm(), 1e-6 * expected.norm());
  EXPECT_EQ(robot.bodies[0].inertia, robot.bodies[0].inertia.transpose());
  EXPECT_EQ(robot.bodies[0].com, Vector3d(0.1, 0.2, 0.3));
}

TEST(Reader, WhatAJointFeelsIsRead) {
  const RobotDescription robot = read(mjcf(fmt::format(
      R"(<body><joint type="slide" axis="0 0 2" armature="0.1" damping="0.2" stiffness="3" springref="0.4" frictionloss="0.5"
          ref="0.6" pos="1 2 3"/>{}</body>)",
      inertial)));
  const auto& joint = *robot.joints()[0];
  EXPECT_EQ(joint.type, Type::slide);
  EXPECT_EQ(joint.axis, Vector3d::UnitZ());
  EXPECT_EQ(joint.anchor, Vector3d(1, 2, 3));
  EXPECT_EQ(joint.armature, 0.1);
  EXPECT_EQ(joint.damping, 0.2);
  EXPECT_EQ(joint.stiffness, 3);
  EXPECT_EQ(joint.spring_reference, 0.4);
  EXPECT_EQ(joint.dry_friction, 0.5);
  EXPECT_EQ(joint.reference, 0.6);
}

TEST(Reader, WhatTheFileSwitchesOffIsOff) {
  const std::string joint = fmt::format(R"(<body><joint damping="0.2" stiffness="3" frictionloss="0.5"/>{}</body>)", inertial);
  const RobotDescription robot =
      read(mjcf(joint, R"(<option gravity="1 2 3"><flag gravity="disable" passive="disable" frictionloss="disable"/></option>)"));
  EXPECT_EQ(robot.gravity, Vector3d::Zero());
  EXPECT_EQ(robot.joints()[0]->damping, 0);
  EXPECT_EQ(robot.joints()[0]->stiffness, 0);
  EXPECT_EQ(robot.joints()[0]->dry_friction, 0);
  EXPECT_EQ(read(mjcf(joint, R"(<option gravity="1 2 3"/>)")).gravity, Vector3d(1, 2, 3));
  const RobotDescription free = read(two_links(R"(<option><flag constraint="disable"/></option>
      <equality><joint name="gear" joint1="a" joint2="b"/></equality>)"));
  EXPECT_THAT(free.couplings, IsEmpty());
  EXPECT_THAT(free.notes, ElementsAre("equality 'gear' is switched off in the file and left out"));
}

TEST(Reader, MissingNamesAreMadeFromMujocosNumbers) {
  const std::string named =
      fmt::format(R"(<body><joint/>{0}<site/><body name="body_1"><joint name="joint_0"/>{0}</body></body>)", inertial);
  const RobotDescription robot = read(mjcf(named), "my arm.xml");
  EXPECT_EQ(robot.name, "my arm");
  // the world is number 0, and made names keep clear of given ones
  EXPECT_EQ(robot.bodies[0].name, "body_1_");
  EXPECT_EQ(robot.bodies[1].name, "body_1");
  EXPECT_EQ(robot.joints()[0]->name, "joint_0_");
  EXPECT_EQ(robot.joints()[1]->name, "joint_0");
  EXPECT_EQ(robot.sites[0].name, "site_0");
}

TEST(Reader, IncludedFilesAndDefaultsAreMujocos) {
  const TemporaryFolder folder;
  folder.write("joint.xml", R"(<mujoco><joint name="inner" class="soft"/></mujoco>)");
  const auto path =
      folder.write("robot.xml", fmt::format(R"(<mujoco><default><default class="soft"><joint stiffness="7"/></default></default>
      <worldbody><body><include file="joint.xml"/>{}</body></worldbody></mujoco>)",
                                            inertial));
  EXPECT_EQ(read_robot(path).joints()[0]->stiffness, 7);
}

// ---- equalities

TEST(Reader, AConnectHasItsAnchorInBothBodies) {
  const RobotDescription robot = read(two_links(
      R"(<equality><connect name="c" body1="lower" anchor="0 0 0.2"/><connect body1="upper" body2="lower" anchor="0.1 0 0"/></equality>)"));
  ASSERT_EQ(robot.connects.size(), 2U);
  EXPECT_EQ(robot.connects[0].name, "c");
  EXPECT_THAT(robot.connects[0].bodies, ElementsAre(1, -1));
  EXPECT_EQ(robot.connects[0].anchors[0], Vector3d(0, 0, 0.2));
  EXPECT_LT((robot.connects[0].anchors[1] - Vector3d(0, 0, 0.7)).norm(), epsilon);
  EXPECT_EQ(robot.connects[1].name, "equality_1");
  EXPECT_THAT(robot.connects[1].bodies, ElementsAre(0, 1));
  EXPECT_EQ(robot.connects[1].anchors[1], Vector3d(0.1, 0, -0.5));
}

TEST(Reader, AWeldHoldsWhereMujocosRowsAreZero) {
  const TemporaryFolder folder;
  for (const char* weld :
       {R"(<weld name="w" body1="upper" body2="lower"/>)",
        R"(<weld name="w" body1="upper" body2="lower" anchor="0.1 0.2 0.3" relpose="0.3 0 0.7 0.9 0 0.1 0.3"/>)"}) {
    const auto path = folder.write("robot.xml", mjcf(fmt::format(R"(
        <body name="upper" pos="0.2 0.1 0" euler="0.3 0 0.1"><joint/>{0}</body>
        <body name="lower" pos="0 0 0.5" euler="0 0.4 0.2"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
        <joint type="slide"/><joint axis="1 0 0"/><joint axis="0 1 0"/><joint/>{0}</body>)",
                                                                 inertial),
                                                     fmt::format("<equality>{}</equality>", weld)));
    const RobotDescription robot = read_robot(path);
    ASSERT_EQ(robot.welds.size(), 1U);
    const auto& [connect, rotation] = robot.welds[0];
    MujocoOracle oracle(path);
    const VectorXd q = VectorXd::LinSpaced(7, -0.5, 0.7);
    oracle.set_state(q, VectorXd::Zero(7));
    const auto rows = oracle.equality_rows();
    const auto at = poses(robot, q);
    const Pose& first = at[static_cast<std::size_t>(connect.bodies[0])];
    const Pose& second = at[static_cast<std::size_t>(connect.bodies[1])];
    const Vector3d gap =
        first.position + first.rotation * connect.anchors[0] - second.position - second.rotation * connect.anchors[1];
    EXPECT_LT((gap - rows.violation.head<3>()).norm(), 100 * epsilon) << weld;
    // R₂ᵀ R₁ R: its quaternion's axis part are MuJoCo's last three rows
    const Eigen::Quaterniond off(Matrix3d(second.rotation.transpose() * first.rotation * rotation));
    const double sign = off.vec().dot(rows.violation.tail<3>()) < 0 ? -1 : 1;
    EXPECT_LT((sign * off.vec() - rows.violation.tail<3>()).norm(), 100 * epsilon) << weld;
    EXPECT_GT(off.vec().norm(), 0.1);
  }
}

TEST(Reader, AWeldWithoutTorqueIsAConnect) {
  const RobotDescription robot = read(two_links(R"(<equality><weld body1="upper" body2="lower" torquescale="0"/>
      <weld name="rigid" body1="upper" body2="lower" torquescale="0.5"/></equality>)"));
  ASSERT_EQ(robot.connects.size(), 1U);
  EXPECT_EQ(robot.connects[0].anchors[0], Vector3d(0, 0, 0.5));
  EXPECT_EQ(robot.connects[0].anchors[1], Vector3d::Zero());
  ASSERT_EQ(robot.welds.size(), 1U);
  EXPECT_THAT(robot.notes, ElementsAre("the torquescale of weld 'rigid' is left out: the weld is rigid"));
}

TEST(Reader, JointsAreCoupledByAPolynomial) {
  const std::string coupled =
      mjcf(fmt::format(R"(<body><joint name="a" ref="0.5"/>{0}</body><body><joint name="b" ref="0.25"/>{0}</body>)", inertial),
           R"(<equality><joint name="gear" joint1="a" joint2="b" polycoef="0.1 2 3 4 5"/><joint joint1="b" polycoef="1 2 0 0 0"/>
                                      <joint name="off" joint1="a" active="false"/></equality>)");
  const RobotDescription robot = read(coupled);
  ASSERT_EQ(robot.couplings.size(), 2U);
  const auto& gear = robot.couplings[0];
  EXPECT_EQ(gear.name, "gear");
  EXPECT_THAT(gear.y.joints, ElementsAre(std::pair<std::string, double>("a", 1)));
  EXPECT_EQ(gear.y.reference, 0.5);
  ASSERT_EQ(gear.x.size(), 1U);
  EXPECT_THAT(gear.x[0].joints, ElementsAre(std::pair<std::string, double>("b", 1)));
  EXPECT_EQ(gear.x[0].reference, 0.25);
  EXPECT_THAT(gear.polynomial, ElementsAre(0.1, 2, 3, 4, 5));
  EXPECT_THAT(robot.couplings[1].x, IsEmpty());
  EXPECT_THAT(robot.notes, ElementsAre("equality 'off' is switched off in the file and left out"));
}

TEST(Reader, TendonsAreSumsOfJointsOrPathsThroughSites) {
  const RobotDescription robot = read(two_links(R"(
      <tendon><fixed name="f"><joint joint="a" coef="2"/><joint joint="b" coef="-1"/></fixed>
      <spatial name="rope"><site site="home"/><site site="p"/><pulley divisor="2"/><site site="p"/><site site="s"/></spatial></tendon>
      <equality><tendon tendon1="rope" tendon2="f" polycoef="0 3 0 0 0"/></equality>)"));
  ASSERT_EQ(robot.couplings.size(), 1U);
  const auto& [name, y, x, polynomial] = robot.couplings[0];
  EXPECT_EQ(name, "equality_0");
  EXPECT_THAT(y.joints, IsEmpty());
  ASSERT_EQ(y.segments.size(), 2U);
  EXPECT_EQ(robot.sites[static_cast<std::size_t>(y.segments[0].first)].name, "home");
  EXPECT_EQ(robot.sites[static_cast<std::size_t>(y.segments[0].second)].name, "p");
  EXPECT_EQ(y.segments[0].factor, 1);
  EXPECT_EQ(robot.sites[static_cast<std::size_t>(y.segments[1].second)].name, "s");
  EXPECT_EQ(y.segments[1].factor, 0.5);
  EXPECT_NEAR(y.reference, std::hypot(1, 0.1) + 0.5 * 0.7, 4 * epsilon);
  ASSERT_EQ(x.size(), 1U);
  EXPECT_THAT(x[0].joints, ElementsAre(std::pair<std::string, double>("a", 2), std::pair<std::string, double>("b", -1)));
  EXPECT_EQ(x[0].reference, 0);
  EXPECT_THAT(polynomial, ElementsAre(0, 3, 0, 0, 0));
}

// ---- notes

TEST(Reader, WhatIsLeftOutIsNoted) {
  const RobotDescription robot =
      read(mjcf(R"(<geom type="plane" size="1 1 1"/><body><joint name="a" limited="true" range="-1 1"/><geom size="0.1"/></body>
      <body mocap="true"/>)",
                R"(<actuator><motor joint="a"/></actuator><sensor><jointpos joint="a"/></sensor>)"));
  EXPECT_THAT(robot.notes, ElementsAre("limits of joints and tendons are left out", "contacts between geoms are left out",
                                       "actuators are left out: inputs of the model are forces at the joints",
                                       "sensors are left out", "mocap bodies stand still"));
}

TEST(Reader, WarningsOfMujocoAreNotesAndNothingIsPrintedOrWritten) {
  const TemporaryFolder folder;
  const auto path =
      folder.write("robot.xml", mjcf(fmt::format(R"(<body><joint user="nan"/>{}</body>)", inertial), R"(<size nuser_jnt="1"/>)"));
  const auto before = std::filesystem::current_path();
  std::filesystem::current_path(folder.path());
  testing::internal::CaptureStdout();
  testing::internal::CaptureStderr();
  const RobotDescription robot = read_robot(path);
  EXPECT_NE(
      input_error_of([&] { read_robot(folder.write("bad.xml", "<mujoco><worldbody><body/><joint/></worldbody></mujoco>")); }),
      "");
  EXPECT_EQ(testing::internal::GetCapturedStdout(), "");
  EXPECT_EQ(testing::internal::GetCapturedStderr(), "");
  std::filesystem::current_path(before);
  EXPECT_THAT(robot.notes, ElementsAre("MuJoCo warns: XML contains a 'NaN'. Please check it carefully."));
  EXPECT_FALSE(std::filesystem::exists(folder / "MUJOCO_LOG.TXT"));
}

TEST(Reader, HandlersOfTheProgramComeBack) {
  const auto warning = +[](const char*) {};
  const auto error = +[](const char*) {};
  mju_user_warning = warning;
  mju_user_error = error;
  read_robot(arm_file);
  EXPECT_TRUE(mju_user_warning == warning && mju_user_error == error);
  error_of("<mujoco><worldbody><body/><joint/></worldbody></mujoco>");
  EXPECT_TRUE(mju_user_warning == warning && mju_user_error == error);
  mju_clearHandlers();
}

TEST(Reader, ThreadsMayReadAtTheSameTime) {
  const std::string expected = to_json(read_robot(arm_file));
  std::vector<std::thread> threads;
  std::vector<std::string> results(4);
  for (std::string& result : results) {
    threads.emplace_back([&result] {
      for (int k = 0; k < 5; ++k) result = to_json(read_robot(arm_file));
    });
  }
  for (std::thread& thread : threads) thread.join();
  for (const std::string& result : results) EXPECT_EQ(result, expected);
}

TEST(Reader, AFileReadComesBackFromJsonToTheLastBit) {
  for (const char* file : {"experiments/arm_on_surface/iiwa7.xml", "models/four_bar.xml"}) {
    const std::string text = to_json(read_robot(source / file));
    EXPECT_EQ(to_json(robot_from_json(text)), text) << file;
  }
}

// ---- files that only give shapes

// a body with its inertia, and what one sees of it
std::string visible(const char* compiler = "", const char* inertia = inertial) {
  return fmt::format(R"(<mujoco><compiler angle="radian" meshdir="shapes" {}/>
      <default><default class="seen"><geom type="mesh" contype="0" conaffinity="0"/></default></default><include file="assets.xml"/>
      <worldbody><geom name="ground" type="hfield" hfield="hills"/>
        <body name="arm"><joint name="a" axis="0 1 0"/>{}<geom class="seen" mesh="arm" material="steel"/>
          <site name="tip" pos="0 0 0.3"/></body></worldbody></mujoco>)",
                     compiler, inertia);
}

constexpr const char* assets = R"(<mujoco><asset><mesh file="arm.stl"/><hfield name="hills" file="hills.png" size="1 1 1 1"/>
    <texture file="steel.png" type="2d"/><material name="steel" texture="steel"/><skin file="arm.skn"/></asset></mujoco>)";

TEST(Reader, MissingMeshesAndPicturesAreNoObstacleWhereInertiasAre) {
  const TemporaryFolder folder;
  folder.write("assets.xml", assets);
  const auto path = folder.write("robot.xml", visible());
  const RobotDescription robot = read_robot(path);
  ASSERT_EQ(robot.bodies.size(), 1U);
  EXPECT_EQ(robot.bodies[0].mass, 1);
  EXPECT_EQ(robot.bodies[0].com, Vector3d(0, 0, 0.1));
  EXPECT_TRUE(robot.bodies[0].inertia.isApprox(Matrix3d(Vector3d(0.01, 0.02, 0.015).asDiagonal()), 1e-15));
  EXPECT_EQ(robot.sites[0].position, Vector3d(0, 0, 0.3));
  EXPECT_THAT(robot.notes, ElementsAre(AllOf(StartsWith("meshes, height fields and pictures are left out, since MuJoCo says: "),
                                             HasSubstr("'"))));
}

TEST(Reader, AMeshThatGivesAnInertiaMustBeThere) {
  const TemporaryFolder folder;
  folder.write("assets.xml", assets);
  for (const std::string& text : {visible("inertiafromgeom=\"true\""), visible("", "")}) {
    EXPECT_THAT(input_error_of([&] { read_robot(folder.write("robot.xml", text)); }),
                EndsWith(". The file of a mesh, height field or texture is missing: put it there, give its body an <inertial>, "
                         "or remove the geom"));
  }
}

TEST(Reader, WithoutShapesAFaultOfTheRobotIsFound) {
  const TemporaryFolder folder;
  folder.write("assets.xml", assets);
  const auto path = folder.write("robot.xml", visible("", R"(<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>)"));
  EXPECT_THAT(input_error_of([&] { read_robot(path); }), EndsWith(". No rigid body has such an inertia: correct it"));
}

TEST(Reader, FilesIncludedAreFoundFromTheFirstFileOrTheIncludingOne) {
  const TemporaryFolder folder;
  std::filesystem::create_directory(folder / "parts");
  folder.write("parts/assets.xml", R"(<mujoco><include file="materials.xml"/><asset><mesh file="arm.stl"/></asset></mujoco>)");
  folder.write("parts/materials.xml", R"(<mujoco><asset><material name="steel"/></asset></mujoco>)");
  std::string text = visible();
  text.replace(text.find("assets.xml"), 10, "parts/assets.xml");
  text.replace(text.find(R"(<geom name="ground" type="hfield" hfield="hills"/>)"), 50, "");
  EXPECT_EQ(read_robot(folder.write("robot.xml", text)).bodies[0].mass, 1);

  folder.write("parts/materials.xml", R"(<mujoco><include file="parts/assets.xml"/></mujoco>)");
  EXPECT_THAT(input_error_of([&] { read_robot(folder / "robot.xml"); }), HasSubstr("assets.xml"));
}

// ---- errors

TEST(Reader, JointsWithQuaternionsAreRead) {
  const RobotDescription robot =
      read(mjcf(fmt::format(R"(<body name="trunk" pos="1 2 3"><freejoint name="root"/>{}<body name="arm" pos="0 0 1">
      <joint name="neck" type="ball" pos="0 0 0.1" damping="0.2"/>{}</body></body>)",
                            inertial, inertial)));
  EXPECT_THAT(robot.coordinates(), ElementsAre("root_x", "root_y", "root_z", "root_qw", "root_qx", "root_qy", "root_qz",
                                               "neck_qw", "neck_qx", "neck_qy", "neck_qz"));
  EXPECT_EQ(robot.bodies[0].position, Eigen::Vector3d::Zero()) << "the joint says where it is";
  EXPECT_EQ(robot.bodies[1].joints[0].damping, 0.2);
  EXPECT_EQ(to_json(robot_from_json(to_json(robot))), to_json(robot));
}

TEST(ReaderErrors, SpringsOfQuaternionsAreRefused) {
  EXPECT_EQ(error_of(mjcf(fmt::format(R"(<body><joint type="ball" stiffness="2"/>{}</body>)", inertial))),
            "robot.xml: joint 0 (without a name) of body 1 (without a name) is a ball or free joint with stiffness = 2, whose "
            "spring is not known: set it to 0 and write it as mechanics.force");
}

TEST(ReaderErrors, ForcesOfFluidsAndTendonsAreRefused) {
  EXPECT_EQ(error_of(two_links(R"(<option density="1.2"/>)")),
            "robot.xml: its option sets density = 1.2 and viscosity = 0, but forces of a fluid are not known: set both to 0 (a "
            "latent can learn them)");
  for (const char* force : {R"(stiffness="1")", R"(damping="1")", R"(frictionloss="1")"}) {
    EXPECT_THAT(
        error_of(two_links(fmt::format(R"(<tendon><fixed name="f" {}><joint joint="a" coef="2"/></fixed></tendon>)", force))),
        AllOf(StartsWith("robot.xml: tendon 'f' has stiffness = "),
              EndsWith("but forces of tendons are not known: set them to 0 and write them as force or let a latent learn them")));
  }
}

TEST(ReaderErrors, ATendonAroundAGeomCannotBeHeld) {
  const std::string robot =
      mjcf(fmt::format(R"(<geom name="wheel" size="0.1" pos="0 0 2"/><site name="home" pos="1 0 0"/>
     <body><joint/>{}<site name="p" pos="0 0 0.1"/></body>)",
                       inertial),
           R"(<tendon><spatial name="rope"><site site="home"/><geom geom="wheel"/><site site="p"/></spatial></tendon>{})");
  EXPECT_EQ(error_of(fmt::format(fmt::runtime(robot), R"(<equality><tendon tendon1="rope"/></equality>)")),
            "robot.xml: tendon 'rope' wraps around geom 'wheel', which is not known for a tendon that an equality holds: lead it "
            "through sites alone");
  EXPECT_EQ(error_of(fmt::format(fmt::runtime(robot), "")), "");
}

TEST(ReaderErrors, DistancesOfGeomsCannotBeHeld) {
  EXPECT_THAT(
      error_of(mjcf(fmt::format(R"(<geom name="a" size="0.1"/><body><joint/>{}<geom name="b" size="0.1"/></body>)", inertial),
                    R"(<equality><distance name="d" geom1="a" geom2="b"/></equality>)")),
      HasSubstr("support for distance equality contraints was removed"));
}

TEST(ReaderErrors, ARobotWithoutJointsIsRefused) {
  EXPECT_EQ(error_of(mjcf("<body/>")), "robot.xml: it has no joint: nothing can move");
}

TEST(ReaderErrors, MujocosRefusalsAreQuotedWithWhatToDo) {
  EXPECT_EQ(
      error_of(mjcf(R"(<body name="arm"><joint/></body>)")),
      "robot.xml: MuJoCo 2.2.2 refuses it: mass and inertia of moving bodies must be larger than mjMINVAL; Object name = arm, "
      "id = 1, line = 1. A body that moves needs a mass and an inertia: give it <inertial> or a geom");
  EXPECT_THAT(error_of(mjcf(R"(<body><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/></body>)")),
              EndsWith(". No rigid body has such an inertia: correct it"));
  EXPECT_THAT(
      error_of(mjcf(R"(<body><joint/><geom type="mesh" mesh="m"/></body>)", R"(<asset><mesh name="m" file="m.stl"/></asset>)")),
      EndsWith(". The file of a mesh, height field or texture is missing: put it there, give its body an <inertial>, or remove "
               "the geom"));
}

TEST(ReaderErrors, AFileForAnotherMujocoIsNamedAsSuch) {
  const char* const another =
      "Where it is no slip of the pen, the file is for another version of MuJoCo: build gp2 with that one (GP2_MUJOCO_DIR)";
  for (const char* attributes : {R"(damping="1 2 3")", R"(colour="red")"}) {
    EXPECT_THAT(error_of(mjcf(fmt::format("<body><joint {}/>{}</body>", attributes, inertial))),
                AllOf(StartsWith("robot.xml: MuJoCo "), HasSubstr("line 1"), EndsWith(another)));
  }
  EXPECT_THAT(error_of(mjcf("", "<machine/>")), EndsWith(another));
  EXPECT_THAT(error_of(mjcf("", R"(<option integrator="leap"/>)")), EndsWith(another));
#if mjVERSION_HEADER < 300
  EXPECT_THAT(error_of(mjcf(fmt::format(R"(<body><joint range="0 1"/>{}</body>)", inertial))),
              EndsWith(". From 3.0 on MuJoCo does the first of these by itself"));
#endif
}

TEST(ReaderErrors, FilesThatAreNoRobotsAreRefused) {
  EXPECT_THAT(input_error_of([] { read_robot("nowhere/arm.xml"); }), HasSubstr("nowhere/arm.xml"));
  EXPECT_EQ(error_of("<html/>"),
            "robot.xml: a robot is a MJCF file (<mujoco>) or a URDF file (<robot>), but it starts with <html>");
  EXPECT_EQ(error_of(""), "robot.xml: a robot is a MJCF file (<mujoco>) or a URDF file (<robot>), but it is empty");
  EXPECT_EQ(error_of("q1,q2\n1,2\n"), "robot.xml:1: not XML (expected <); a robot is a MJCF or URDF file");
  EXPECT_EQ(error_of("<mujoco><worldbody>"), "robot.xml:1: not XML (unexpected end of data); a robot is a MJCF or URDF file");
  std::string deep;
  for (int k = 0; k < 200000; ++k) deep += "<a>";
  EXPECT_EQ(error_of(deep), "robot.xml: elements are nested more than 1000 deep");
}

// ---- URDF

std::string link(const std::string& name, const std::string& mass = "1") {
  return fmt::format(R"(<link name="{}"><inertial><origin xyz="0 0 0.1" rpy="0 0 0"/><mass value="{}"/>
      <inertia ixx="0.01" iyy="0.02" izz="0.015" ixy="0" ixz="0" iyz="0"/></inertial></link>)",
                     name, mass);
}

std::string joint(const std::string& name, const std::string& type, const std::string& parent, const std::string& child,
                  const std::string& rest = "") {
  return fmt::format(
      R"(<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="0 0 1" rpy="0 1.57079632679 0"/>
      <axis xyz="0 1 0"/>{}</joint>)",
      name, type, parent, child, rest);
}

std::string urdf(const std::string& content) {
  return fmt::format(R"(<?xml version="1.0"?><robot name="r">{}</robot>)", content);
}

TEST(Urdf, LinksAndJointsAreRead) {
  const RobotDescription robot =
      read(urdf(R"(<link name="base-link"/>)" + link("arm/1") + R"(<link name="tool"/>)" + link("slider") +
                joint("joint-1", "revolute", "base-link", "arm/1",
                      R"(<dynamics damping="0.5" friction="0.1"/><limit lower="-1" upper="1"/>)") +
                joint("fixed", "fixed", "arm/1", "tool") + joint("lift", "prismatic", "tool", "slider")),
           "r.urdf");
  EXPECT_EQ(robot.name, "r");
  EXPECT_EQ(robot.gravity, Vector3d(0, 0, -9.81));
  ASSERT_EQ(robot.bodies.size(), 4U);
  // links that are fixed to others are bodies of their own
  EXPECT_EQ(robot.bodies[0].name, "base-link");
  EXPECT_EQ(robot.bodies[static_cast<std::size_t>(robot.body_index("tool"))].mass, 0);
  const auto& arm = robot.bodies[static_cast<std::size_t>(robot.body_index("arm/1"))];
  EXPECT_EQ(arm.position, Vector3d(0, 0, 1));
  Matrix3d quarter_turn;
  quarter_turn << 0, 0, 1, 0, 1, 0, -1, 0, 0;
  EXPECT_EQ(arm.rotation, quarter_turn);
  const auto joints = robot.joints();
  ASSERT_EQ(joints.size(), 2U);
  EXPECT_EQ(joints[0]->name, "joint-1");
  EXPECT_EQ(joints[0]->axis, Vector3d::UnitY());
  EXPECT_EQ(joints[0]->damping, 0.5);
  EXPECT_EQ(joints[0]->dry_friction, 0.1);
  EXPECT_EQ(joints[1]->type, Type::slide);
  EXPECT_THAT(robot.notes, Contains("limits of joints and tendons are left out"));
}

TEST(Urdf, AFileMayAskMujocoToFuseFixedLinks) {
  const RobotDescription robot =
      read(urdf(R"(<mujoco><compiler fusestatic="true"/></mujoco>)" + link("base") + link("arm") + link("tool") +
                joint("a", "continuous", "base", "arm") + joint("f", "fixed", "arm", "tool")));
  ASSERT_EQ(robot.bodies.size(), 1U);
  EXPECT_EQ(robot.bodies[0].mass, 2);
}

TEST(Urdf, MeshesNeedNotBeThereWhereInertiasAre) {
  const std::string mesh = R"(<visual><geometry><mesh filename="package://arm/arm.dae"/></geometry></visual>
      <collision><geometry><mesh filename="package://arm/arm.stl"/></geometry></collision></link>)";
  std::string arm = link("arm");
  arm.replace(arm.rfind("</link>"), std::string::npos, mesh);
  const RobotDescription robot = read(urdf(link("base") + arm + joint("a", "revolute", "base", "arm")));
  EXPECT_EQ(robot.bodies[1].mass, 1);

  // without an inertia the shape would have to give it
  const std::string bare = "<link name=\"arm\">" + mesh;
  EXPECT_THAT(error_of(urdf(link("base") + bare + joint("a", "revolute", "base", "arm"))),
              AllOf(HasSubstr("could not open STL file"), HasSubstr("The file of a mesh, height field or texture is missing")));
}

TEST(Urdf, AJointThatMimicsAnotherIsCoupled) {
  const RobotDescription robot =
      read(urdf(link("base") + link("left") + link("right") + joint("l", "prismatic", "base", "left") +
                joint("r", "prismatic", "base", "right", R"(<mimic joint="l" multiplier="-1" offset="0.1"/>)")));
  ASSERT_EQ(robot.couplings.size(), 1U);
  const auto& coupling = robot.couplings[0];
  EXPECT_EQ(coupling.name, "r mimics l");
  EXPECT_EQ(coupling.y.joints[0].first, "r");
  EXPECT_EQ(coupling.x[0].joints[0].first, "l");
  EXPECT_THAT(coupling.polynomial, ElementsAre(0.1, -1, 0, 0, 0));
}

TEST(UrdfErrors, AMissingLinkIsNamed) {
  EXPECT_EQ(error_of(urdf(link("base") + joint("a", "revolute", "base", "arm")), "r.urdf"),
            "r.urdf: joint 'a': its child link 'arm' is not in the file; add <link name=\"arm\"> or correct the name");
  EXPECT_EQ(error_of(urdf(link("arm") + joint("a", "revolute", "base", "arm")), "r.urdf"),
            "r.urdf: joint 'a': its parent link 'base' is not in the file; add <link name=\"base\"> or correct the name");
}

TEST(UrdfErrors, MassesMustBeNumbersNotNegative) {
  const auto with_mass = [](const char* mass) {
    return error_of(urdf(link("base") + link("arm", mass) + joint("a", "revolute", "base", "arm")), "r.urdf");
  };
  EXPECT_EQ(with_mass("-1"), "r.urdf: link 'arm': its mass must be ≥ 0 kg, got -1");
  EXPECT_EQ(with_mass("heavy"), "r.urdf: link 'arm': its mass must be a number, got 'heavy'");
  EXPECT_EQ(with_mass("1kg"), "r.urdf: link 'arm': its mass must be a number, got '1kg'");
  EXPECT_THAT(with_mass("0"), AllOf(StartsWith("r.urdf: MuJoCo 2.2.2 refuses it: mass and inertia of moving bodies"),
                                    HasSubstr("Object name = arm"), EndsWith("give it <inertial> or a geom")));
}

TEST(UrdfErrors, NumbersAreNamedWithTheirLinkOrJoint) {
  const auto with = [](const std::string& from, const std::string& to) {
    std::string text = urdf(link("base") + link("arm") +
                            joint("a", "revolute", "base", "arm", R"(<dynamics damping="0.5"/><limit lower="-1" upper="1"/>)"));
    const std::size_t at = text.rfind(from);
    EXPECT_NE(at, std::string::npos) << from;
    return error_of(text.replace(at, from.size(), to), "r.urdf");
  };
  const std::string of_joint = "r.urdf: joint 'a': ", of_link = "r.urdf: link 'arm', <inertial>: ";
  const std::string axis = R"(<axis xyz="0 1 0"/>)", mass = R"(<mass value="1"/>)";
  EXPECT_EQ(with("0 1 0", "0,1,0"), of_joint + "xyz of its <axis> must be 3 numbers with spaces between, got '0,1,0'");
  EXPECT_EQ(with("0 1 0", "0 1"), of_joint + "xyz of its <axis> must be 3 numbers with spaces between, got '0 1'");
  EXPECT_EQ(with(axis, "<axis/>"), of_joint + "its <axis> has no xyz");
  EXPECT_EQ(with(axis, axis + axis), of_joint + "its <axis> stands twice: remove one");
  EXPECT_EQ(with("0 1.57079632679 0", "0 90deg 0"),
            of_joint + "rpy of its <origin> must be 3 numbers with spaces between, got '0 90deg 0'");
  EXPECT_EQ(with(R"("0.5")", R"("0,5")"), of_joint + "damping of its <dynamics> must be a number, got '0,5'");
  EXPECT_EQ(with(R"("-1")", R"("-1rad")"), of_joint + "lower of its <limit> must be a number, got '-1rad'");
  EXPECT_EQ(with("0 0 0.1", "0 0"), of_link + "xyz of its <origin> must be 3 numbers with spaces between, got '0 0'");
  EXPECT_EQ(with(R"( izz="0.015")", ""), of_link + "its <inertia> has no izz");
  EXPECT_EQ(with(R"(ixy="0")", R"(ixy="O")"), of_link + "ixy of its <inertia> must be a number, got 'O'");
  EXPECT_EQ(with(mass, mass + mass), of_link + "its <mass> stands twice: remove one");
  EXPECT_EQ(with("0 1 0", " +0 1. 0e0 "), "");

  EXPECT_EQ(error_of(urdf(R"(<link name="a"><inertial><mass value="1"/></inertial></link>)")),
            "robot.xml: link 'a': its <inertial> has no <inertia>");
  const auto with_shape = [](const std::string& shape) {
    return error_of(urdf(fmt::format(R"(<link name="a"><collision>{}</collision></link>)", shape)));
  };
  const std::string of_shape = "robot.xml: link 'a', <collision>: ";
  EXPECT_EQ(with_shape(""), of_shape + "it has no <geometry>");
  EXPECT_EQ(with_shape(R"(<geometry><sphere radius="0,1"/></geometry>)"),
            of_shape + "radius of its <sphere> must be a number, got '0,1'");
}

TEST(UrdfErrors, AJointFloatsUnderTheWorld) {
  EXPECT_THAT(
      error_of(urdf(link("base") + link("arm") + joint("root", "floating", "base", "arm"))),
      EndsWith(". A body that moves freely hangs on the world: in URDF name the parent link of its floating joint world, in "
               "MJCF put it straight into <worldbody>"));
}

TEST(UrdfErrors, NegativeInertiasAreRefusedByMujoco) {
  std::string arm = link("arm");
  arm.replace(arm.find("0.02"), 4, "-0.2");
  EXPECT_EQ(
      error_of(urdf(link("base") + arm + joint("a", "revolute", "base", "arm")), "r.urdf"),
      "r.urdf: MuJoCo 2.2.2 refuses it: inertia must satisfy A + B >= C; use 'balanceinertia' to fix; Object name = arm, id = 2. "
      "No rigid body has such an inertia: correct it");
}

TEST(UrdfErrors, JointsOfUnknownTypeAreNamed) {
  // MuJoCo 2.2.2 does not survive this one
  EXPECT_EQ(error_of(urdf(link("base") + link("arm") + joint("a", "revolut", "base", "arm", R"(<limit lower="0" upper="1"/>)")),
                     "r.urdf"),
            "r.urdf: joint 'a': its type is 'revolut'; there is: revolute, continuous, prismatic, fixed, floating, planar");
}

TEST(UrdfErrors, FaultsOfTheTreeAreNamed) {
  const std::string three = link("base") + link("arm") + link("hand");
  EXPECT_EQ(error_of(urdf("")), "robot.xml: it has no <link>");
  EXPECT_EQ(error_of(urdf(link("arm") + link("arm"))), "robot.xml: link 'arm': it stands twice");
  EXPECT_EQ(error_of(urdf(three + joint("a", "revolute", "base", "arm") + joint("a", "revolute", "arm", "hand"))),
            "robot.xml: joint 'a': it stands twice");
  EXPECT_EQ(error_of(urdf(three + joint("a", "revolute", "base", "hand") + joint("b", "revolute", "arm", "hand"))),
            "robot.xml: link 'hand': it is the child of two joints; a loop is closed in MJCF, with <equality><connect>");
  EXPECT_EQ(error_of(urdf(three + joint("a", "revolute", "arm", "hand") + joint("b", "revolute", "hand", "arm"))),
            "robot.xml: link 'arm': it is its own ancestor");
  EXPECT_EQ(error_of(urdf(three + link("tool") + joint("a", "revolute", "base", "arm"))),
            "robot.xml: no joint has the links base, hand, tool as its child; a URDF has one root: join the others by a <joint>, "
            "with type=\"fixed\" where they do not move, or remove them");
  EXPECT_EQ(error_of(urdf(three + R"(<joint name="a" type="fixed"><child link="arm"/></joint>)")),
            "robot.xml: joint 'a': it has no <parent link=\"…\"/>");
  EXPECT_EQ(error_of(urdf(R"(<link/>)")), "robot.xml: a <link> has no name");
  EXPECT_EQ(error_of(urdf(R"(<link name="a"><inertial/></link>)")), "robot.xml: link 'a': its <inertial> has no <mass>");
}

TEST(Urdf, JointsThatFloatAreFree) {
  const RobotDescription robot = read(urdf(R"(<link name="world"/>)" + link("arm") + joint("root", "floating", "world", "arm")));
  EXPECT_EQ(robot.joints().front()->type, RobotDescription::Joint::Type::free);
}

TEST(UrdfErrors, FaultsOfMimicAreNamed) {
  const auto with = [](const char* mimic) {
    return error_of(urdf(link("base") + link("arm") + joint("a", "revolute", "base", "arm", mimic)));
  };
  EXPECT_EQ(with(R"(<mimic joint="b"/>)"), "robot.xml: joint 'a': it mimics 'b', which is no joint of the file");
  EXPECT_EQ(with(R"(<mimic/>)"), "robot.xml: joint 'a': its <mimic> names no joint");
  EXPECT_EQ(with(R"(<mimic joint="a" multiplier="x"/>)"),
            "robot.xml: joint 'a': the multiplier of its <mimic> must be a number, got 'x'");
  EXPECT_EQ(with(R"(<mimic joint="a"/>)"), "robot.xml: joint 'a': it mimics itself; name another joint or remove the <mimic>");
  EXPECT_EQ(with(R"(<mimic joint="a"/><mimic joint="b"/>)"), "robot.xml: joint 'a': its <mimic> stands twice: remove one");
  const auto of_types = [](const char* followed, const char* follower) {
    return error_of(urdf(link("base") + link("left") + link("right") + joint("l", followed, "base", "left") +
                         joint("r", follower, "base", "right", R"(<mimic joint="l"/>)")));
  };
  const auto fault = [](const char* name, const char* type) {
    return fmt::format(
        "robot.xml: joint 'r': it mimics 'l', but the type of '{}' is {}: only revolute, continuous and prismatic "
        "joints mimic or are mimicked",
        name, type);
  };
  for (const char* type : {"fixed", "floating", "planar"}) {
    EXPECT_EQ(of_types(type, "prismatic"), fault("l", type));
    EXPECT_EQ(of_types("revolute", type), fault("r", type));
  }
  EXPECT_EQ(of_types("continuous", "prismatic"), "");
}

TEST(UrdfErrors, AXacroFileIsToBeExpandedFirst) {
  EXPECT_EQ(error_of(urdf(R"(<xacro:property name="a" value="1"/>)")),
            "robot.xml: <xacro:property> is of xacro: expand it first with: xacro FILE > robot.urdf");
}

}  // namespace
}  // namespace gp2
