#include <fmt/format.h>
#include <gmock/gmock.h>
#include <Eigen/Dense>

#include "export/fitted_robot.hpp"
#include "export/xml_text.hpp"
#include "gp2/base/file.hpp"
#include "gp2/jobs/export_job.hpp"
#include "gp2/robots/robot.hpp"
#include "gp2/training/hyperparameter.hpp"
#include "io_testing.hpp"
#include "robots/robot_expressions.hpp"

namespace gp2 {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using test::input_error_of;
using test::TemporaryFolder;
using testing::ElementsAre;
using testing::EndsWith;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

// ---- where things stand in a XML text

TEST(XmlText, ElementsAndAttributesAreFoundWhatEverStandsBetween) {
  const std::string text = R"(<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]>
<!-- <joint name="no"/> --><a x = '1 > 0'><![CDATA[<b>]]><b y="&lt;&quot;&amp;lt;"/><c
  z="2"
  ><d/></c></a>)";
  XmlText xml(text, "a.xml");
  ASSERT_EQ(xml.elements().size(), 4U);
  EXPECT_EQ(xml.elements()[0].tag, "a");
  EXPECT_EQ(xml.elements()[0].attribute("x")->value, "1 > 0");
  EXPECT_EQ(xml.elements()[1].attribute("y")->value, "<\"&lt;");
  EXPECT_TRUE(xml.elements()[1].is_empty);
  EXPECT_EQ(xml.elements()[2].attribute("z")->value, "2");
  EXPECT_EQ(xml.elements()[2].attribute("w"), nullptr);
  EXPECT_EQ(xml.elements()[3].parent, 2);
  EXPECT_TRUE(xml.is_within(xml.elements()[3], "a"));
  EXPECT_FALSE(xml.is_within(xml.elements()[3], "b"));
  EXPECT_EQ(xml.changed(), text);
  xml.set(xml.elements()[0], "x", "3");
  xml.set(xml.elements()[1], "w", "4");
  xml.remove(xml.elements()[2], "z");
  xml.remove(xml.elements()[2], "none");
  xml.insert(xml.elements()[3].end, "!");
  std::string expected = text;
  expected.replace(expected.find("1 > 0"), 5, "3");
  expected.replace(expected.find("/><c"), 2, " w=\"4\"/>");
  expected.replace(expected.find("\n  z=\"2\""), 8, "");
  expected.replace(expected.find("<d/>"), 4, "<d/>!");
  EXPECT_EQ(xml.changed(), expected);
}

TEST(XmlText, WhatHasNoEndIsNamedWithItsLine) {
  for (const auto& [given, missing] : std::vector<std::pair<std::string, std::string>>{
           {"<a>\n<!-- b", "-->"}, {"<a>\n<b", ">"}, {"<a>\n<b c=\"d", "\""}, {"<a>\n<b c", "="}, {"<a>\n<b c=", "\""}}) {
    EXPECT_EQ(input_error_of([text = given] { XmlText(text, "a.xml"); }),
              fmt::format("a.xml:2: not XML ({} is missing); a robot is a MJCF or URDF file", missing));
  }
}

// ---- fitted numbers in the text of a robot

constexpr const char* robot_text = R"(<mujoco model="arm">  <!-- joint name="a" -->
	<compiler angle="degree"/>
  <default><joint damping='0.5'/><default class="stiff"><joint armature="0.01"/></default></default>
  <worldbody>
    <body name="upper" pos="0 0 0.1">
      <joint name="a" axis="0 1 0" class="stiff"/>
      <inertial pos="0 0 0.15" mass="1.5" diaginertia="0.02 0.03 0.025"/>
      <site name="b"/>
      <body name="lower" pos="0 0 0.3"><joint name='b' axis="0 1 0" damping="0.25"  />
        <geom type="capsule" fromto="0 0 0 0 0.1 0.3" size="0.02" density="800"/></body>
      <body name="tool" pos="0 0.1 0"><joint name="c" axis="1 0 0"/>
        <inertial pos="0.01 0 0" quat="1 0.2 0 0" mass="0.2" diaginertia="0.001 0.002 0.0015" /></body>
    </body>
  </worldbody>
  <equality><joint name="e" joint1="a" joint2="b" active="false"/></equality>
</mujoco>
)";

RobotDescription described(const std::string& text) {
  const TemporaryFolder folder;
  return read_robot(folder.write("robot.xml", text));
}

FittedRobot fitted(const std::vector<FittedNumber>& numbers, const std::string& text = robot_text) {
  return fitted_mjcf(text, "robot.xml", described(text), numbers);
}

double number_of(const RobotDescription& robot, const std::string& name) {
  for (const auto& [other, value] : robot_numbers(robot)) {
    if (other == name) return value;
  }
  ADD_FAILURE() << name;
  return 0;
}

// the text without its comments of fits, and with `from` back in the place of `to`
std::string undone(std::string text, const std::vector<std::pair<std::string, std::string>>& changes) {
  for (std::size_t at = text.find(" <!-- fitted: "); at != std::string::npos; at = text.find(" <!-- fitted: ")) {
    text.erase(at, text.find("-->", at) + 3 - at);
  }
  for (const auto& [from, to] : changes) {
    EXPECT_THAT(text, HasSubstr(to));
    if (text.find(to) != std::string::npos) text.replace(text.find(to), to.size(), from);
  }
  return text;
}

TEST(FittedRobot, NumbersOfJointsAreAttributesAndEveryOtherByteStays) {
  const FittedRobot out = fitted({{R"(damping("a"))", 1.0 / 3, true, 0.0123},
                                  {R"(armature("a"))", 0.1 + 0.2, false, 0},
                                  {R"(damping("b"))", 2.0 / 7, true, std::nan("")},
                                  {R"(friction("b"))", 1e-7 / 3, true, 1},
                                  {R"(stiffness("c"))", 12.5, true, 0.5}});
  EXPECT_EQ(undone(out.text, {{"", R"( damping="0.3333333333333333" armature="0.30000000000000004")"},
                              {"0.25", "0.2857142857142857"},
                              {"", R"( frictionloss="3.3333333333333334e-08")"},
                              {"", R"( stiffness="12.5")"}}),
            robot_text);
  EXPECT_THAT(out.text,
              HasSubstr(R"(armature="0.30000000000000004"/> <!-- fitted: damping = 0.3333333333333333 (standard error 0.012), )"
                        "armature = 0.30000000000000004 (held) -->\n"));
  EXPECT_THAT(out.text, HasSubstr("damping = 0.2857142857142857 (standard error not known)"));
  EXPECT_TRUE(out.is_physical);
  EXPECT_THAT(out.notes, IsEmpty());
  const RobotDescription robot = described(out.text);
  EXPECT_EQ(number_of(robot, R"(damping("a"))"), 1.0 / 3);
  EXPECT_EQ(number_of(robot, R"(armature("a"))"), 0.1 + 0.2);
  EXPECT_EQ(number_of(robot, R"(damping("b"))"), 2.0 / 7);
  EXPECT_EQ(number_of(robot, R"(friction("b"))"), 1e-7 / 3);
  EXPECT_EQ(number_of(robot, R"(stiffness("c"))"), 12.5);
  EXPECT_EQ(to_json(robot), to_json(out.robot));
}

TEST(FittedRobot, MassAndCentreStandInTheInertial) {
  const FittedRobot out = fitted({{R"(mass("upper"))", 1.6180339887498949, true, 0.01},
                                  {R"(com("upper").x)", 0.1 / 3, true, 0.002},
                                  {R"(com("upper").z)", 0.2, false, 0}});
  EXPECT_EQ(undone(out.text, {{"0 0 0.15", "0.03333333333333333 0 0.2"}, {"\"1.5\"", "\"1.618033988749895\""}}), robot_text);
  EXPECT_EQ(to_json(described(out.text)), to_json(out.robot));
}

// the inertia as MuJoCo has it, and that which was fitted
void expect_inertia(const FittedRobot& out, const char* body) {
  const RobotDescription robot = described(out.text);
  const auto k = static_cast<std::size_t>(robot.body_index(body));
  const Matrix3d& expected = out.robot.bodies[k].inertia;
  EXPECT_LT((robot.bodies[k].inertia - expected).cwiseAbs().maxCoeff(), 1e-15 * expected.trace()) << body;
  RobotDescription same = robot;
  same.bodies[k].inertia = expected;
  EXPECT_EQ(to_json(same), to_json(out.robot)) << body;
}

TEST(FittedRobot, AnInertiaStandsAsMomentsAndAxes) {
  const FittedRobot along = fitted({{R"(inertia("upper").yy)", 0.1 / 3, true, 0.001}});
  EXPECT_EQ(undone(along.text, {{"0.02 0.03 0.025", "0.02 0.03333333333333333 0.025"}}), robot_text);
  expect_inertia(along, "upper");
  // turned ones
  expect_inertia(fitted({{R"(inertia("upper").xz)", -0.003, true, 0.001}, {R"(inertia("upper").xx)", 0.021, true, 0.001}}),
                 "upper");
  const FittedRobot turned = fitted({{R"(inertia("tool").yz)", 0, true, 0.001}});
  expect_inertia(turned, "tool");
  EXPECT_THAT(turned.text, Not(HasSubstr("quat")));
  std::string text = robot_text;
  text.replace(text.find(R"(diaginertia="0.02)"), 29, R"(fullinertia="0.02 0.03 0.025 0.001 0.002 0.003")");
  const FittedRobot other = fitted({{R"(inertia("upper").xy)", 0.002, true, 0.001}}, text);
  EXPECT_THAT(other.text, Not(HasSubstr("fullinertia")));
  expect_inertia(other, "upper");
}

TEST(FittedRobot, ABodyOfShapesGetsAnInertial) {
  const FittedRobot out = fitted({{R"(mass("lower"))", 0.4, true, 0.01}});
  EXPECT_THAT(out.notes, ElementsAre("body 'lower' has an <inertial> now; before, its shapes gave mass and inertia"));
  EXPECT_THAT(out.text, HasSubstr(R"(<body name="lower" pos="0 0 0.3"><inertial pos=")"));
  const std::size_t begin = out.text.find("<inertial", out.text.find("lower")), end = out.text.find("<joint", begin);
  EXPECT_EQ(out.text.substr(0, begin) + out.text.substr(end), robot_text);
  expect_inertia(out, "lower");
}

TEST(FittedRobot, WhatIsNoRigidBodyIsSaidToBeNone) {
  const FittedRobot out = fitted({{R"(inertia("upper").zz)", 0.06, true, 0.01}});
  EXPECT_FALSE(out.is_physical);
  EXPECT_THAT(
      out.notes,
      ElementsAre("warning: no rigid body has the mass 1.5 and the principal moments 0.02, 0.03, 0.06 that were fitted for "
                  "body 'upper', and MuJoCo will refuse the file: hold some of them, or give them a prior"));
  EXPECT_THAT(out.text, HasSubstr("0.02 0.03 0.06"));
  EXPECT_THAT(input_error_of([&] { described(out.text); }), HasSubstr("A + B >= C"));
  EXPECT_FALSE(fitted({{R"(inertia("upper").xy)", 0.05, true, 0.01}}).is_physical);
  EXPECT_FALSE(fitted({{R"(mass("upper"))", -1, true, 0.01}}).is_physical);
  EXPECT_TRUE(fitted({{R"(inertia("upper").zz)", 0.0499, true, 0.01}}).is_physical);
}

TEST(FittedRobot, WhatTheFileItselfCannotTakeIsRefused) {
  std::string unnamed = robot_text;
  unnamed.replace(unnamed.find("name=\"c\" axis"), 9, "");
  EXPECT_EQ(
      input_error_of([&] {
        fitted({{R"(damping("joint_2"))", 1, true, 0}}, unnamed);
      }),
      "robot.xml: there is no <joint name=\"joint_2\"> in the file itself: give it this name, or put included files, <replicate> "
      "and <attach> in their places");
  std::string of_shapes = robot_text;
  of_shapes.replace(of_shapes.find("angle="), 6, "inertiafromgeom=\"true\" angle=");
  // of its own inertials alone: the other bodies have no shapes
  of_shapes.replace(of_shapes.find("<site name=\"b\"/>"), 16, "<geom size=\"0.1\"/>");
  of_shapes.replace(of_shapes.find("<inertial pos=\"0.01"), 10, "<geom size=\"0.1\"/><inertial ");
  EXPECT_EQ(
      input_error_of([&] {
        fitted({{R"(mass("upper"))", 1, true, 0}}, of_shapes);
      }),
      "robot.xml: its compiler takes masses and inertias from shapes whatever <inertial> says: set inertiafromgeom to auto");
}

// ---- of URDF

constexpr const char* urdf_text = R"(<?xml version="1.0"?>
<robot name="arm">  <!-- link name="upper" -->
  <link name="base"/>
  <link name='upper'>
	<inertial>
      <origin xyz="0 0 0.15" rpy="0.0 0 0"/>
      <mass value="1.5"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.025"/>
    </inertial>
  </link>
  <link name="lower"><inertial><origin rpy="0.5 0 0.1" xyz="0 0.01 0.1"/>
    <mass value="0.5" /><inertia ixx="0.004" ixy="0.0001" ixz="0" iyy="0.005" iyz="0" izz="0.003"></inertia></inertial>
  </link>
  <joint name="a" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="3"/><dynamics damping="0.25"/></joint>
  <transmission name="t"><joint name="a"/></transmission>
</robot>
)";

RobotDescription described_urdf(const std::string& text) {
  const TemporaryFolder folder;
  return read_robot(folder.write("robot.urdf", text));
}

FittedRobot fitted_link(const std::vector<FittedNumber>& numbers, const std::string& text = urdf_text) {
  return fitted_urdf(text, "robot.urdf", described_urdf(text), numbers);
}

void expect_read_back(const FittedRobot& out) {
  const RobotDescription robot = described_urdf(out.text);
  const auto numbers = robot_numbers(robot), expected = robot_numbers(out.robot);
  ASSERT_EQ(numbers.size(), expected.size());
  for (std::size_t k = 0; k < numbers.size(); ++k) {
    EXPECT_EQ(numbers[k].first, expected[k].first);
    // MuJoCo takes the moments and axes of an inertia from its components to some ten digits
    EXPECT_NEAR(numbers[k].second, expected[k].second, 1e-11) << numbers[k].first;
  }
}

TEST(FittedUrdf, NumbersOfJointsStandInTheirDynamicsAndEveryOtherByteStays) {
  const FittedRobot out = fitted_link({{R"(damping("a"))", 1.0 / 3, true, 0.0123},
                                       {R"(damping("b"))", 2.0 / 7, true, std::nan("")},
                                       {R"(friction("b"))", 0.125, false, 0}});
  EXPECT_EQ(undone(out.text, {{"", R"(<dynamics damping="0.3333333333333333"/>)"},
                              {"0.25\"/></joint>", R"(0.2857142857142857" friction="0.125"/></joint>)"}}),
            urdf_text);
  EXPECT_THAT(out.text, HasSubstr(R"(type="continuous"><dynamics damping="0.3333333333333333"/> <!-- fitted: damping = )"
                                  "0.3333333333333333 (standard error 0.012) --><parent"));
  EXPECT_THAT(out.text, HasSubstr("damping = 0.2857142857142857 (standard error not known), friction = 0.125 (held)"));
  EXPECT_THAT(out.notes, IsEmpty());
  const RobotDescription robot = described_urdf(out.text);
  EXPECT_EQ(number_of(robot, R"(damping("a"))"), 1.0 / 3);
  EXPECT_EQ(number_of(robot, R"(damping("b"))"), 2.0 / 7);
  EXPECT_EQ(number_of(robot, R"(friction("b"))"), 0.125);
}

TEST(FittedUrdf, MassCentreAndInertiaStandInTheInertial) {
  const FittedRobot out = fitted_link({{R"(mass("upper"))", 1.6180339887498949, true, 0.01},
                                       {R"(com("upper").x)", 0.1 / 3, true, 0.002},
                                       {R"(inertia("upper").xz)", -0.003, true, 0.001}});
  EXPECT_EQ(undone(out.text, {{"0 0 0.15", "0.03333333333333333 0 0.15"},
                              {"value=\"1.5\"", "value=\"1.618033988749895\""},
                              {"ixz=\"0\"", "ixz=\"-0.003\""}}),
            urdf_text);
  EXPECT_TRUE(out.is_physical);
  expect_read_back(out);
}

TEST(FittedUrdf, AnInertiaAboutOtherAxesIsThenAboutThoseOfTheLink) {
  const FittedRobot mass = fitted_link({{R"(mass("lower"))", 0.4, true, 0.01}});
  EXPECT_EQ(undone(mass.text, {{"\"0.5\" />", "\"0.4\" />"}}), urdf_text);
  expect_read_back(mass);
  const FittedRobot turned = fitted_link({{R"(inertia("lower").xx)", 0.0045, true, 0.001}});
  EXPECT_THAT(turned.text, HasSubstr(R"(<origin rpy="0 0 0" xyz="0 0.01 0.1"/>)"));
  EXPECT_THAT(turned.text, HasSubstr("ixx=\"0.0045\""));
  expect_read_back(turned);
}

TEST(FittedUrdf, ALinkOfShapesGetsAnInertial) {
  std::string text = urdf_text;
  const std::size_t begin = text.find("<inertial><origin rpy"), end = text.find("</inertial>", begin) + 11;
  text.replace(begin, end - begin, "<collision><geometry><sphere radius=\"0.05\"/></geometry></collision>");
  const FittedRobot out = fitted_link({{R"(mass("lower"))", 0.6, true, 0.01}}, text);
  EXPECT_THAT(out.notes, ElementsAre("link 'lower' has an <inertial> now; before, its shapes gave mass and inertia"));
  expect_read_back(out);
}

TEST(FittedUrdf, SaysWhatUrdfCannotHoldAndWhatIsNoRigidBody) {
  const FittedRobot out = fitted_link({{R"(armature("a"))", 0.25, true, 0.01}, {R"(stiffness("b"))", 2, false, 0}});
  EXPECT_EQ(out.text, urdf_text);
  EXPECT_THAT(out.notes, ElementsAre("warning: URDF has no place for armature(\"a\") = 0.25, which is left out",
                                     "warning: URDF has no place for stiffness(\"b\") = 2, which is left out"));
  const FittedRobot no_body = fitted_link({{R"(inertia("upper").zz)", 0.06, true, 0.01}});
  EXPECT_FALSE(no_body.is_physical);
  EXPECT_THAT(no_body.notes, ElementsAre(HasSubstr("that were fitted for link 'upper', and MuJoCo will refuse the file")));
}

// ---- of a fit

constexpr const char* model_text = R"toml(name = "two links and a tool"
robot = "robot.xml"
inputs = ["u1", "u2", "u3"]
[parameters]
d = { of = "damping('a')", bounds = [0.1, 1], estimate = true }
m = { of = 'mass("upper")', bounds = [1, 3], estimate = true }
i = { of = 'inertia("tool").xx', value = 0.0011 }
c = { of = 'mass("tool")' }
g = 9.81
[[latent]]
features = ["dq1"]
directions = "force"
[noise]
ddq = 0.1
)toml";

// a fit without its data: parameters with their values and standard errors
class RobotExport : public testing::Test {
 protected:
  void make(const std::string& robot = robot_text, std::string model = model_text) {
    folder_.write("robot.xml", robot);
    model.insert(model.find("inputs"), "coordinates = [\"q1\", \"q2\", \"q3\"]\n");
    fit_.model = Model::read(folder_.write("model.toml", model));
    fit_.report.uncertainty.emplace();
    fit_.report.uncertainty->stddev = Eigen::Vector2d(0.02, 0.03);
    fit_.report.hyperparameters = {hyperparameter("d", 0, 0.1, 1, 0.7), hyperparameter("m", 1, 1, 3, 1.0 / 0.7)};
    request_.to = ExportRequest::Target::mjcf;
  }
  [[nodiscard]] ExportOutcome outcome() const { return export_robot(fit_, request_); }
  [[nodiscard]] std::string error() const {
    return input_error_of([this] { static_cast<void>(outcome()); });
  }

  TemporaryFolder folder_;
  FitFile fit_;
  ExportRequest request_;

  static Hyperparameter hyperparameter(const char* name, std::size_t index, double lower, double upper, double value) {
    Hyperparameter h = Hyperparameter::of(Hyperparameter::Kind::parameter, 0, index);
    h.name = name;
    h.value = value;
    h.lower = lower;
    h.upper = upper;
    return h;
  }
};

TEST_F(RobotExport, FittedAndHeldParametersAreFoundInTheCopy) {
  make();
  const ExportOutcome out = outcome();
  EXPECT_THAT(out.notes, IsEmpty());
  ASSERT_EQ(out.files.size(), 1U);
  EXPECT_EQ(out.files[0].first, "two_links_and_a_tool.xml");
  const RobotDescription robot = described(out.files[0].second);
  EXPECT_EQ(number_of(robot, R"(damping("a"))"), 0.7);
  EXPECT_EQ(number_of(robot, R"(mass("upper"))"), 1.0 / 0.7);
  EXPECT_NEAR(number_of(robot, R"(inertia("tool").xx)"), 0.0011, 1e-17);
  EXPECT_THAT(out.files[0].second, HasSubstr("<!-- fitted: damping = 0.7 (standard error 0.02) -->"));
  EXPECT_THAT(out.files[0].second, HasSubstr("<!-- fitted: mass = 1.4285714285714286 (standard error 0.03) -->"));
  EXPECT_THAT(out.files[0].second, HasSubstr("<!-- fitted: inertia.xx = 0.0011 (held) -->"));
  // of a parameter that is held at the robot's own number nothing is written
  EXPECT_THAT(out.files[0].second, HasSubstr("mass=\"0.2\""));
}

TEST_F(RobotExport, TheRobotMayHaveMovedButNotChanged) {
  make();
  std::filesystem::rename(folder_ / "robot.xml", folder_ / "moved.xml");
  EXPECT_THAT(error(), EndsWith("robot.xml', where the model had it; say where it is"));
  request_.robot = (folder_ / "moved.xml").string();
  EXPECT_EQ(outcome().files.size(), 1U);
  std::string heavier = robot_text;
  heavier.replace(heavier.find("\"0.2\""), 5, "\"0.3\"");
  folder_.write("moved.xml", heavier);
  EXPECT_THAT(error(), EndsWith("moved.xml' is not the robot of the fit: its mass(\"tool\") is 0.3, there it is 0.2"));
}

TEST_F(RobotExport, ACompilerThatChangesTheNumbersIsFound) {
  std::string changed = robot_text;
  changed.replace(changed.find("angle="), 6, "settotalmass=\"4\" angle=");
  make(changed);
  EXPECT_THAT(error(), HasSubstr("its compiler changes it by settotalmass, boundmass, boundinertia or balanceinertia, or fuses "
                                 "bodies by fusestatic; remove these"));
}

TEST_F(RobotExport, IncludedFilesStayWhereTheyAre) {
  folder_.write("tool.xml", "<mujoco><equality/></mujoco>");
  std::string with = robot_text;
  with.insert(with.find("  <worldbody>"), "  <include file=\"tool.xml\"/>\n");
  make(with);
  const ExportOutcome out = outcome();
  EXPECT_THAT(out.notes, ElementsAre(HasSubstr("the file refers to others: put it into the folder of ")));
  EXPECT_THAT(out.files[0].second, HasSubstr("  <include file=\"tool.xml\"/>\n"));
}

TEST_F(RobotExport, WhatIsNoBodyIsWrittenWithAWarning) {
  make();
  fit_.report.hyperparameters[1].value = -1;
  EXPECT_THAT(outcome().notes, ElementsAre(HasSubstr("warning: no rigid body has the mass -1")));
}

TEST_F(RobotExport, WhatDoesNotGoTogetherIsRefused) {
  make();
  request_.single_precision = true;
  EXPECT_EQ(error(), "`to=mjcf` writes parameters, not functions: it goes with `robot` and `name` only");
  request_ = ExportRequest();
  request_.to = ExportRequest::Target::mjcf;
  std::string without = model_text;
  without.erase(without.find("d = "), without.find("g = ") - without.find("d = "));
  make(robot_text, without);
  fit_.report.hyperparameters.clear();
  EXPECT_THAT(error(), HasSubstr("`to=mjcf`: no parameter of the model changes a number of its robot"));
  fit_.model.robot.reset();
  EXPECT_EQ(error(), "`to=mjcf` writes into the file of a robot, but the model has none");
}

TEST_F(RobotExport, AUrdfFileIsWrittenInto) {
  folder_.write("robot.urdf", urdf_text);
  fit_.model = Model::read(folder_.write("model.toml", R"toml(name = "r"
robot = "robot.urdf"
coordinates = ["q1", "q2"]
[parameters]
m = { of = "mass('upper')", estimate = true, bounds = [1, 3] }
d = { of = "damping('b')", value = 0.3 }
)toml"));
  fit_.report.uncertainty.emplace();
  fit_.report.uncertainty->stddev = Eigen::VectorXd::Constant(1, 0.02);
  fit_.report.hyperparameters = {hyperparameter("m", 0, 1, 3, 1.7)};
  request_.to = ExportRequest::Target::mjcf;
  EXPECT_THAT(error(), EndsWith("robot.urdf' is a file of the other format; use `to=urdf`"));
  request_.to = ExportRequest::Target::urdf;
  const ExportOutcome out = outcome();
  EXPECT_THAT(out.notes, IsEmpty());
  ASSERT_EQ(out.files.size(), 1U);
  EXPECT_EQ(out.files[0].first, "r.urdf");
  const RobotDescription robot = described(out.files[0].second);
  EXPECT_EQ(number_of(robot, R"(mass("upper"))"), 1.7);
  EXPECT_EQ(number_of(robot, R"(damping("b"))"), 0.3);
  EXPECT_THAT(out.files[0].second, HasSubstr("<!-- fitted: mass = 1.7 (standard error 0.02) -->"));
  make();
  request_.to = ExportRequest::Target::urdf;
  EXPECT_THAT(error(), EndsWith("robot.xml' is a file of the other format; use `to=mjcf`"));
}

}  // namespace
}  // namespace gp2
