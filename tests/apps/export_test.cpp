#include <cstdio>
#include <regex>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/robots/robot.hpp"
#include "robots/robot_expressions.hpp"

namespace gp2::test {
namespace {

// examples/exported_loop, with errors of the path that do not depend on the machine
TEST(ExportedLoopExample, FollowsItsPathBetterByWhatWasLearned) {
  const Desk desk;
  desk.done("gp2 generate models/unicycle.toml --n 60 --seed 1 -o log.csv");
  desk.done("gp2 fit models/unicycle.toml --data log.csv --restarts 1 --hyperparameters optimise -o fit.json");
  desk.done("gp2 export fit.json --name unicycle --no-std -o .");
  desk.done("cc -std=c99 -O2 -Wall -Wextra -pedantic -Wconversion -Werror -I. '" GP2_SOURCE_DIR
            "/examples/exported_loop/main.c' unicycle.c -lm -o loop");
  const std::string printed = desk.done("./loop").out;
  double known = 0, learned = 0;
  ASSERT_EQ(std::sscanf(printed.c_str(), "known error %lf mm, %*[^\n] learned error %lf mm", &known, &learned), 2) << printed;
  EXPECT_NEAR(known, 3.365, 0.001);
  EXPECT_LT(learned, known / 3);
}

using testing::HasSubstr;

TEST(ExportCommand, NamesFunctionsAfterTheModelUnlessTheNameIsTaken) {
  const Desk desk;
  for (const auto& [system, name] : {std::pair("cart", "cart"), std::pair("w", "model_w"), std::pair("float", "model_float"),
                                     std::pair("2 carts", "model_2_carts")}) {
    desk.write("m.toml", fmt::format("name = '{}'\ncoordinates = ['x']\n[mechanics]\nmass = [['1']]\n[noise]\nddq = 0.1\n"
                                     "[[latent]]\nfeatures = ['dx']\n",
                                     system));
    desk.write("log.csv", "x,dx,ddx\n0,1,2\n1,2,3\n2,4,3\n");
    desk.done("gp2 fit m.toml --data log.csv --max-iterations 0 -o fit.json");
    desk.done("gp2 export fit.json --no-std -o .");
    EXPECT_THAT(desk.read(std::string(name) + ".h"), testing::HasSubstr(std::string(name) + "_mean("));
  }
}

// A header of one fit with the source of another would compile, and answer wrongly.
TEST(ExportCommand, ReplacesNoneOfItsFilesWhereOneCannotBeWritten) {
  const Desk desk;
  desk.done("gp2 generate models/duffing.toml --n 10 --seed 1 -o log.csv");
  desk.done("gp2 fit models/duffing.toml --data log.csv --restarts 1 --max-iterations 1 -o fit.json");
  desk.done("mkdir -p out/duffing.c");
  desk.write("out/duffing.h", "old");
  const Outcome outcome = desk.run("gp2 export fit.json --name duffing -o out");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("out/duffing.c: cannot be written: Is a directory"));
  EXPECT_EQ(desk.read("out/duffing.h"), "old");
}

// Off the wire the latent is unknown, so that what is known along it is a small part of its deviation.
TEST(ExportCommand, RefusesFloatsWhereTheyAreCoarserThanTheDeviationOfTheMotion) {
  const Desk desk;
  desk.write("bead.toml", R"toml(
coordinates = ["x", "z"]
inputs      = ["u"]
[mechanics]
mass  = [["0.2", "0"], ["0", "0.2"]]
force = ["u", "-9.81*0.2"]
[constraints]
position = ["z - 0.5*x^2"]
[[latent]]
features = ["x", "dx"]
[noise]
ddq = 0.02
[truth]
acceleration = ["-8*dx - 2*x - 2*sin(x)", "-8*dz"]
[sampling]
x  = [-1, 1]
dx = [-1.5, 1.5]
u  = [-1, 1]
)toml");
  desk.done("gp2 generate bead.toml --n 15 --seed 1 -o log.csv");
  desk.done("gp2 fit bead.toml --data log.csv --mean force --restarts 1 --hyperparameters optimise -o fit.json");
  const Outcome outcome = desk.run("gp2 export fit.json --float --name bead -o .");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("in single precision the mean would be off by up to"));
  desk.done("gp2 export fit.json --name bead -o .");
}

// A fitted mass and damping of a linkage in a copy of its file.
class RobotExportCommand : public testing::Test {
 protected:
  void SetUp() override {
    if (desk.run("gp2 show models/four_bar.toml").status != 0) GTEST_SKIP() << "built without MuJoCo";
    desk.write("robot.xml", desk.read("models/four_bar.xml"));
    desk.write("rocker.toml", R"toml(
name        = "four-bar linkage with a rocker of unknown mass"
robot       = "robot.xml"
coordinates = ["crank", "coupler", "rocker"]
inputs      = ["u"]
[parameters]
m = { of = 'mass("rocker")', bounds = [0.05, 1], estimate = true }
d = { of = 'damping("rocker")', value = 0.01, bounds = [0.001, 0.1], estimate = true }
[mechanics]
force = ["u", "0", "0"]
[[latent]]
features   = ["dcrank", "drocker"]
directions = "force"
[noise]
ddq = 0.05
[truth]
force = ["0", "0", "-0.02*drocker - 0.2*tanh(5*drocker)"]
[motion]
rate              = 50
segment           = [1, 2]
natural_frequency = 20
targets           = { crank = [-6, 6] }
)toml");
    desk.done("gp2 generate rocker.toml --n 40 --seed 1 -o rocker.csv");
    desk.done("gp2 fit rocker.toml --data rocker.csv --mean force --restarts 1 --hyperparameters optimise -o fit.json");
  }

  [[nodiscard]] double fitted(const std::string& name) const {
    const nlohmann::json fit = desk.json("fit.json");
    for (const auto& one : fit["hyperparameters"]) {
      if (one["name"] == name) return one["value"];
    }
    throw std::runtime_error("no " + name);
  }
  [[nodiscard]] double number_of(const std::string& file, const std::string& name) const {
    for (const auto& [known, value] : robot_numbers(read_robot(desk / file))) {
      if (known == name) return value;
    }
    throw std::runtime_error("no " + name);
  }
  Desk desk;
};

TEST_F(RobotExportCommand, TheRobotsFileHasTheFittedNumbersAndIsElseAsItWas) {
  const Outcome outcome = desk.done("gp2 export fit.json --to mjcf -o fitted.xml");
  EXPECT_THAT(outcome.err, HasSubstr("fitted.xml ("));
  EXPECT_EQ(number_of("fitted.xml", R"(damping("rocker"))"), fitted("d"));
  EXPECT_EQ(number_of("fitted.xml", R"(mass("rocker"))"), fitted("m"));
  EXPECT_EQ(number_of("fitted.xml", R"(mass("crank"))"), number_of("robot.xml", R"(mass("crank"))"));
  // without what was added it is the robot's file, byte by byte
  std::string text = desk.read("fitted.xml");
  text = std::regex_replace(text, std::regex(" <!-- fitted: [^>]*-->"), "");
  text = std::regex_replace(text, std::regex(" damping=\"[^\"]*\""), "");
  text = std::regex_replace(text, std::regex("\\n *<inertial [^>]*/>"), "");
  EXPECT_EQ(text, desk.read("robot.xml"));
  // a model goes by it as by the other
  desk.write("again.toml", replaced(desk.read("rocker.toml"), "robot.xml", "fitted.xml"));
  desk.done("gp2 check again.toml");
  // a pipe gets the same
  EXPECT_EQ(desk.done("gp2 export fit.json --to mjcf -o -").out, desk.read("fitted.xml"));
}

// examples/mujoco_passive
TEST_F(RobotExportCommand, TheLearnedForceIsAPassiveForceOfMujoco) {
  if (desk.run("echo '#include <mujoco/mujoco.h>' | cc -E -").status != 0)
    GTEST_SKIP() << "MuJoCo is not among the system's headers";
  desk.done("gp2 export fit.json --to mjcf -o fitted.xml");
  desk.done("gp2 export fit.json --view force --name rocker --no-std -o .");
  desk.done("cc -std=c99 -O2 -Wall -Wextra -pedantic -Wconversion -Werror -I. '" GP2_SOURCE_DIR
            "/examples/mujoco_passive/main.c' rocker.c -lmujoco -lm -o passive");
  desk.done("./passive fitted.xml >motion.csv");
  desk.done("gp2 predict fit.json --states motion.csv --view unconstrained -o same.csv");
  desk.done("gp2 predict fit.json --states motion.csv --view force -o force.csv");
  const std::vector<std::string> names = {"abar_crank", "abar_coupler", "abar_rocker"};
  const Eigen::MatrixXd of_mujoco = columns(desk.table("motion.csv"), names), of_gp2 = columns(desk.table("same.csv"), names);
  ASSERT_EQ(of_mujoco.cols(), 20);
  EXPECT_LE((of_mujoco - of_gp2).cwiseAbs().maxCoeff(), 1e-11 * of_gp2.cwiseAbs().maxCoeff());
  EXPECT_GT(columns(desk.table("force.csv"), {"force_coupler", "force_rocker"}).cwiseAbs().maxCoeff(), 1e-3)
      << "the callback has something to add";
}

TEST_F(RobotExportCommand, LeavesTheRobotAndTheFitAlone) {
  const std::string robot = desk.read("robot.xml"), fit = desk.read("fit.json");
  for (const char* output : {"robot.xml", "fit.json"}) {
    const Outcome outcome = desk.run(std::string("gp2 export fit.json --to mjcf -o ") + output);
    EXPECT_EQ(outcome.status, 2);
    EXPECT_THAT(outcome.err, HasSubstr("that is the input"));
  }
  EXPECT_EQ(desk.read("robot.xml"), robot);
  EXPECT_EQ(desk.read("fit.json"), fit);
  const Outcome outcome = desk.run("gp2 export fit.json --to mjcf --view force -o fitted.xml");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("--to mjcf writes parameters, not functions: it goes with --robot and --name only"));
  EXPECT_FALSE(desk.has("fitted.xml"));
}

}  // namespace
}  // namespace gp2::test
