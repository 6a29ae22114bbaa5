#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::ElementsAre;

/// A desk with a weight on a spring that is pushed, and a fit of it.
class ExciteCommand : public testing::Test {
 protected:
  void SetUp() override {
    desk.write("spring.toml", R"toml(
name        = "spring"
coordinates = ["x"]
inputs      = ["u"]
[parameters]
k = { value = 9.0, bounds = [1, 30], estimate = true }
[mechanics]
mass  = [["1"]]
force = ["u - k*x"]
[[latent]]
kernel   = "se"
features = ["dx"]
[noise]
ddq = 0.1
[truth]
force = ["-0.5*dx"]
[sampling]
x  = [-0.1, 0.1]
dx = [-0.5, 0.5]
u  = [-0.2, 0.2]
)toml");
    desk.done("gp2 generate spring.toml --n 30 --seed 1 -o log.csv");
    desk.done("gp2 fit spring.toml --data log.csv --mean force --restarts 1 -o fit.json");
  }
  const std::string unlimited = "gp2 excite fit.json --start x=0 --duration 6 --inputs-within u=-1:1 --rows 60 -o next.csv ";
  const std::string command = unlimited + "--motions 80 ";
  Desk desk;
};

TEST_F(ExciteCommand, WritesAMotionThatSimulateFollows) {
  const Outcome outcome = desk.done(command + "--within x=-0.5:0.5 --json");
  const CsvTable next = desk.table("next.csv");
  EXPECT_THAT(next.header(), ElementsAre("t", "x", "dx", "ddx", "u"));
  ASSERT_EQ(next.n_rows(), 60);
  EXPECT_LE(columns(next, {"u"}).cwiseAbs().maxCoeff(), 1);
  EXPECT_LE(columns(next, {"x"}).cwiseAbs().maxCoeff(), 0.5);
  desk.done("gp2 simulate fit.json --start next.csv --inputs next.csv --t-end 6 --dt 0.1 -o motion.csv");
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_NEAR(columns(motion, {"x"})(0, 60), columns(next, {"x"})(0, 59), 1e-5);

  const auto report = outcome.json();
  EXPECT_EQ(report["for"], "parameters");
  const auto& k = report["parameters"][0];
  EXPECT_EQ(k["name"], "k");
  EXPECT_LT(k["after"], k["random"]);
  EXPECT_LT(k["random"], k["now"]);
  EXPECT_EQ(report["limits"][1]["name"], "x");
  EXPECT_LE(report["limits"][1]["share"], 1);
  EXPECT_NEAR(report["highest_frequency"], 8.0 / 6, 1e-12);
  EXPECT_TRUE(outcome.said("gp2: k: standard deviation ")) << outcome.err;
  EXPECT_TRUE(outcome.said("as large as the limits allow")) << outcome.err;
  EXPECT_TRUE(outcome.said("gp2: x goes from ")) << outcome.err;
  EXPECT_TRUE(outcome.said("gp2: warning: the motion leaves the region of the data at t = ")) << outcome.err;
}

TEST_F(ExciteCommand, IsTheSameForTheSameSeedAndAnyNumberOfThreads) {
  desk.done(command + "--threads 1");
  const std::string one = desk.read("next.csv");
  desk.done(command + "--threads 2");
  EXPECT_EQ(desk.read("next.csv"), one);
  desk.done(command + "--seed 5");
  EXPECT_NE(desk.read("next.csv"), one);
}

TEST_F(ExciteCommand, DrivesAnotherSystem) {
  desk.done("sed 's/k = {.*/k = 20.0/' spring.toml >stiff.toml");
  const Outcome outcome = desk.done(command + "--for accelerations --system stiff.toml");
  desk.done("gp2 simulate fit.json --system stiff.toml --start next.csv --inputs next.csv --t-end 6 --dt 0.1 -o motion.csv");
  EXPECT_NEAR(columns(desk.table("motion.csv"), {"x"})(0, 60), columns(desk.table("next.csv"), {"x"})(0, 59), 1e-5);
  desk.done("sed 's/\\[\"dx\"\\]/[\"x\"]/' spring.toml >other.toml");
  EXPECT_TRUE(desk.run(command + "--system other.toml").said("must have the same coordinates, inputs and latents"));
}

TEST_F(ExciteCommand, TellsWhatIsWrong) {
  const auto error = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 excite fit.json -o next.csv --duration 2 " + options);
    EXPECT_EQ(outcome.status, 2) << options;
    return outcome.err;
  };
  EXPECT_EQ(error("--start x=0 --inputs-within u=1"),
            "gp2: error: --inputs-within: 'u=1' is not NAME=LOWEST:HIGHEST, say u1=-5:5\n");
  EXPECT_EQ(error("--start x=0 --inputs-within u=1:b"), "gp2: error: --inputs-within: u = '1:b' is not two finite numbers\n");
  EXPECT_EQ(error("--start x=0 --inputs-within u=0:1,u=0:2"), "gp2: error: --inputs-within: 'u' is given twice\n");
  EXPECT_EQ(error("--start x=0 --inputs-within u=0:1 --within x=5:1"),
            "gp2: error: --within: x = 5:1 must be finite, the lower limit first\n");
  EXPECT_EQ(error("--start x=0,y --inputs-within u=0:1"), "gp2: error: --start: 'y' is not NAME=VALUE, say q1=0.4\n");
  EXPECT_FALSE(desk.has("next.csv"));
}

TEST_F(ExciteCommand, OnASignalWritesTheBestSoFar) {
  // a slow machine has no motion yet when the signal comes
  Outcome outcome;
  for (int seconds = 4; seconds < 200; seconds *= 2) {
    outcome = desk.run(unlimited + fmt::format("--motions 1000000 & sleep {}; kill -TERM $!; wait $!", seconds));
    if (!outcome.said("before there was a motion")) break;
  }
  EXPECT_EQ(outcome.status, 143) << outcome.err;
  EXPECT_TRUE(outcome.said("next.csv holds the best motion so far")) << outcome.err;
  EXPECT_EQ(desk.table("next.csv").n_rows(), 60);
}

}  // namespace
}  // namespace gp2::test
