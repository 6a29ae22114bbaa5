#include <cmath>
#include <random>

#include <gmock/gmock.h>
#include <Eigen/Geometry>
#include <nlohmann/json.hpp>

#include "gp2/robots/robot.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using test::input_error_of;
using testing::HasSubstr;
using Json = nlohmann::json;

// with digits in every number
RobotDescription robot_with_everything() {
  std::mt19937 engine(3);
  std::normal_distribution<double> normal;
  const auto vector = [&] { return Vector3d(normal(engine), normal(engine), normal(engine)); };
  const auto rotation = [&] { return Matrix3d(Eigen::AngleAxisd(normal(engine), vector().normalized())); };
  RobotDescription robot;
  robot.name = "Größe \"7\"\n";
  robot.gravity = vector();
  for (int k = 0; k < 3; ++k) {
    RobotDescription::Body body;
    body.name = "link " + std::to_string(k);
    body.parent = k - 1;
    body.position = vector();
    body.rotation = rotation();
    body.mass = std::abs(normal(engine));
    body.com = vector();
    body.inertia = vector().cwiseAbs().asDiagonal();
    body.inertia(0, 1) = body.inertia(1, 0) = 1e-3 * normal(engine) * body.inertia.diagonal().head<2>().minCoeff();
    body.joints.push_back({"joint/" + std::to_string(k), RobotDescription::Joint::Type::slide, vector().normalized(), vector(),
                           normal(engine), 0.1, 0.2 / 3, 1e-300, normal(engine), 5e-324});
    robot.bodies.push_back(body);
  }
  robot.bodies[1].joints[0].type = RobotDescription::Joint::Type::hinge;
  robot.bodies[2].joints.clear();
  robot.sites = {{"tip", 2, vector(), rotation()}, {"home", -1, vector(), rotation()}};
  robot.connects = {{"loop", {-1, 2}, {vector(), vector()}}};
  robot.welds = {{{"weld", {0, 2}, {vector(), vector()}}, rotation()}};
  robot.couplings = {{"gear", {{{"joint/0", 1}}, {}, 0.1}, {{{{"joint/1", 1. / 3}}, {{0, 1, 0.5}}, 0.7}}, {0.1, 2, 3, 4, 1e-17}},
                     {"held", {{{"joint/1", -0.0}}, {}, 0}, {}, {0, 0, 0, 0, 0}}};
  robot.notes = {"contacts are left out"};
  return robot;
}

std::string changed(const std::string& pointer, const Json& value) {
  Json json = Json::parse(to_json(robot_with_everything()));
  json[Json::json_pointer(pointer)] = value;
  return json.dump();
}

std::string json_error_of(const std::string& text) {
  return input_error_of([&] { robot_from_json(text); });
}

std::string error_of_changed(const std::string& pointer, const Json& value) { return json_error_of(changed(pointer, value)); }

TEST(RobotJson, ADescriptionComesBackToTheLastBit) {
  const RobotDescription robot = robot_with_everything();
  const std::string text = to_json(robot);
  const RobotDescription back = robot_from_json(text);
  // shortest digits that give the same double: equal texts are equal bits
  EXPECT_EQ(to_json(back), text);

  EXPECT_EQ(back.name, robot.name);
  EXPECT_EQ(back.gravity, robot.gravity);
  ASSERT_EQ(back.bodies.size(), robot.bodies.size());
  for (std::size_t k = 0; k < robot.bodies.size(); ++k) {
    EXPECT_EQ(back.bodies[k].rotation, robot.bodies[k].rotation);
    EXPECT_EQ(back.bodies[k].inertia, robot.bodies[k].inertia);
    EXPECT_EQ(back.bodies[k].com, robot.bodies[k].com);
    EXPECT_EQ(back.bodies[k].joints.size(), robot.bodies[k].joints.size());
  }
  EXPECT_EQ(back.bodies[0].joints[0].type, RobotDescription::Joint::Type::slide);
  EXPECT_EQ(back.bodies[1].joints[0].type, RobotDescription::Joint::Type::hinge);
  EXPECT_EQ(back.bodies[0].joints[0].dry_friction, 5e-324);
  EXPECT_EQ(back.bodies[0].joints[0].axis, robot.bodies[0].joints[0].axis);
  EXPECT_EQ(back.connects[0].bodies, robot.connects[0].bodies);
  EXPECT_EQ(back.welds[0].rotation, robot.welds[0].rotation);
  EXPECT_EQ(back.couplings[0].x[0].segments[0].factor, 0.5);
  EXPECT_EQ(back.couplings[0].polynomial, robot.couplings[0].polynomial);
  EXPECT_TRUE(std::signbit(back.couplings[1].y.joints[0].second));
  EXPECT_EQ(back.notes, robot.notes);
}

TEST(RobotJson, JointsAreThoseOfAllBodiesInOrder) {
  const RobotDescription robot = robot_with_everything();
  const auto joints = robot.joints();
  ASSERT_EQ(joints.size(), 2U);
  EXPECT_EQ(joints[0]->name, "joint/0");
  EXPECT_EQ(joints[1]->name, "joint/1");
  EXPECT_EQ(robot.body_index("link 2"), 2);
  EXPECT_EQ(robot.body_index("link 9"), -1);
}

TEST(RobotJson, TextThatIsNoJsonIsAnError) {
  for (const std::string text : {"", "{", "{\"name\": 1e999}", "nonsense"}) {
    EXPECT_EQ(json_error_of(text), "robot: not valid JSON: the text is cut short or damaged") << text;
  }
  EXPECT_EQ(json_error_of("[]"), "robot: array stands where an object must");
  EXPECT_EQ(json_error_of(std::string(100000, '[')), "robot: not valid JSON: the text is cut short or damaged");
  EXPECT_EQ(json_error_of(std::string(100000, '[') + std::string(100000, ']')), "robot: array stands where an object must");
}

TEST(RobotJson, AKeyThatIsMissingOrUnknownIsNamed) {
  EXPECT_EQ(json_error_of("{}"), "robot: 'name' is missing");
  Json json = Json::parse(to_json(robot_with_everything()));
  json["bodies"][1]["joints"][0].erase("damping");
  EXPECT_EQ(json_error_of(json.dump()), "robot.bodies[1].joints[0]: 'damping' is missing");
  EXPECT_EQ(error_of_changed("/sites/0/colour", "red"),
            "robot.sites[0]: 'colour' is not known; there is: name, body, position, rotation");
}

TEST(RobotJson, AValueOfAnotherKindIsNamed) {
  EXPECT_EQ(error_of_changed("/name", 3), "robot.name: 3 stands where a text must");
  EXPECT_EQ(error_of_changed("/bodies", 3), "robot.bodies: 3 stands where an array must");
  EXPECT_EQ(error_of_changed("/bodies/0/mass", "3"), "robot.bodies[0].mass: \"3\" stands where a number must");
  EXPECT_EQ(error_of_changed("/bodies/0/mass", nullptr), "robot.bodies[0].mass: null stands where a number must");
  EXPECT_EQ(error_of_changed("/bodies/0/parent", 0.5), "robot.bodies[0].parent: 0.5 stands where a whole number must");
  EXPECT_EQ(error_of_changed("/bodies/0/parent", 4294967295U),
            "robot.bodies[0].parent: 4294967295 stands where a smaller number must");
  EXPECT_EQ(error_of_changed("/gravity", {1, 2}), "robot.gravity: has 2 entries, must have 3");
  EXPECT_EQ(error_of_changed("/bodies/0/joints/0/type", "planar"),
            "robot.bodies[0].joints[0].type: \"planar\" stands where hinge, slide, ball or free must");
  EXPECT_EQ(error_of_changed("/couplings/0/polynomial", {1}), "robot.couplings[0].polynomial: has 1 entries, must have 5");
}

TEST(RobotJson, ParentsComeBeforeTheirChildren) {
  for (const int parent : {1, 2, -2, 1000000}) {
    EXPECT_EQ(error_of_changed("/bodies/1/parent", parent), "body 'link 1': its parent is " + std::to_string(parent) +
                                                                ", but must be −1 (the world) or a body before it, which is 1");
  }
}

TEST(RobotJson, IndicesAreInRange) {
  EXPECT_EQ(error_of_changed("/sites/0/body", 3), "site 'tip': it is on body 3, but there are −1 … 2");
  EXPECT_EQ(error_of_changed("/connects/0/bodies", {0, 3}), "connect 'loop': it names body 3, but there are −1 … 2");
  EXPECT_EQ(error_of_changed("/connects/0/bodies", {1, 1}), "connect 'loop': it must hold two different bodies");
  EXPECT_EQ(error_of_changed("/welds/0/bodies", {-2, 1}), "weld 'weld': it names body -2, but there are −1 … 2");
  EXPECT_EQ(error_of_changed("/couplings/0/x/0/segments/0/first", 2), "coupling 'gear': it names site 2, but there are 2");
  EXPECT_EQ(error_of_changed("/couplings/0/y/joints/0/name", "q"), "coupling 'gear': there is no joint 'q'");
  EXPECT_EQ(error_of_changed("/couplings/1/y/joints", Json::array()),
            "coupling 'held': a length has neither joints nor segments");
  Json json = Json::parse(to_json(robot_with_everything()));
  json["couplings"][0]["x"].push_back(json["couplings"][0]["x"][0]);
  EXPECT_EQ(json_error_of(json.dump()), "coupling 'gear': x must hold one length or none, got 2");
}

TEST(RobotJson, NumbersObeyTheirLaws) {
  EXPECT_EQ(error_of_changed("/bodies/0/mass", -1), "body 'link 0': its mass must be ≥ 0, got -1");
  EXPECT_EQ(error_of_changed("/bodies/0/joints/0/damping", -1), "joint 'joint/0': its damping must be ≥ 0, got -1");
  EXPECT_EQ(error_of_changed("/bodies/0/joints/0/axis", {0, 0, 2}), "joint 'joint/0': its axis must have length 1, got 2");
  const char* rule = "its rotation must have orthonormal, right-handed columns";
  EXPECT_THAT(error_of_changed("/bodies/0/rotation", {{1, 0, 0}, {0, 1, 0}, {0, 0, -1}}), HasSubstr(rule));
  EXPECT_THAT(error_of_changed("/sites/0/rotation", {{1, 0, 0}, {0, 1, 0}, {0, 1e-6, 1}}), HasSubstr(rule));
  EXPECT_THAT(error_of_changed("/welds/0/rotation", {{2, 0, 0}, {0, 1, 0}, {0, 0, 1}}), HasSubstr(rule));
  EXPECT_EQ(error_of_changed("/bodies/0/inertia", {{1, 0.1, 0}, {0.2, 1, 0}, {0, 0, 1}}),
            "body 'link 0': its inertia must be symmetric");
  EXPECT_EQ(error_of_changed("/bodies/0/inertia", {{1, 0, 0}, {0, -1, 0}, {0, 0, 1}}),
            "body 'link 0': its inertia has the principal moment -1, but none can be negative");
}

TEST(RobotJson, NamesAreThereAndStandOnce) {
  EXPECT_EQ(error_of_changed("/bodies/1/name", ""), "body 1: it has no name");
  EXPECT_EQ(error_of_changed("/bodies/1/name", "link 0"), "body 'link 0': its name stands twice");
  EXPECT_EQ(error_of_changed("/bodies/1/joints/0/name", "joint/0"), "joint 'joint/0': its name stands twice");
  EXPECT_EQ(error_of_changed("/sites/1/name", "tip"), "site 'tip': its name stands twice");
}

}  // namespace
}  // namespace gp2
