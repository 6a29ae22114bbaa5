#include <cmath>
#include <set>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/jobs/simulate_job.hpp"

namespace gp2::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

const std::string figure_start = "--start q1=0.4,q2=0.8,dq1=0.8,dq2=1";

double number(const CsvTable& table, int row, const std::string& column) { return table.number(row, table.find(column)); }

/// A desk with a small log of the surface, and a fit at its starting values.
class SimulateFit : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/surface.toml --n 60 --seed 1 -o train.csv");
    desk.done("gp2 fit models/surface.toml --data train.csv --max-iterations 0 --restarts 1 -o fit.json");
  }
  Desk desk;
};

TEST(SimulateModelCommand, WritesAHundredRowsOnTheConstraint) {
  const Desk desk;
  const Outcome outcome = desk.done("gp2 simulate models/surface.toml " + figure_start + " --t-end 6 --json -o motion.csv");
  EXPECT_TRUE(outcome.said("gp2: start: from the constraints q3 = 0.0970358, dq3 = -0.0404894")) << outcome.err;
  const auto report = outcome.json();
  EXPECT_LE(report["max_position_drift"], 1e-12);
  EXPECT_LE(report["max_velocity_drift"], 1e-12);
  EXPECT_GT(report["steps"], 10);
  EXPECT_GE(report["seconds"], 0);
  EXPECT_EQ(report["n_lower_rank"], 0);
  EXPECT_EQ(report["leaves_data_at"], nullptr);

  const CsvTable motion = desk.table("motion.csv");
  EXPECT_THAT(motion.header(), ElementsAre("t", "q1", "q2", "q3", "dq1", "dq2", "dq3", "ddq1", "ddq2", "ddq3", "u1", "u2", "u3",
                                           "lambda1", "energy"));
  ASSERT_EQ(motion.n_rows(), 100);
  EXPECT_EQ(number(motion, 0, "t"), 0);
  EXPECT_EQ(number(motion, 99, "t"), 6);
  EXPECT_EQ(number(motion, 0, "q1"), 0.4);
  EXPECT_EQ(number(motion, 0, "dq2"), 1);
  // ½ m |dq|² + m g q3; friction takes of it
  EXPECT_NEAR(number(motion, 0, "energy"), 1.5 * (0.8 * 0.8 + 1 + 0.0404894 * 0.0404894) + 3 * 9.81 * 0.0970358, 1e-5);
  EXPECT_LT(number(motion, 99, "energy"), number(motion, 0, "energy"));
  EXPECT_GT(report["max_energy_drift"], 0);
}

// Friction that reads its load, learned from rows that slip: the motion of the fit sticks where that of the truth does.
TEST(SimulateCommand, OfAFitSticksAndSlipsUnderTheLoadOfItsContact) {
  const Desk desk;
  desk.write("belt.toml", R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["-5*x", "-(9.81 - 4*sin(2.2*t))"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
[truth]
force = ["-0.5*abs(lambda(1))*sign(dx - 0.6)", "0"]
[sampling]
x = [-1, 1]
z = 0
dx = [-1, 1]
dz = 0
t = [0, 3]
touch = 1
[noise]
ddq = 0.001
[[latent]]
kernel = "constant"
features = ["1"]
directions = { force = [["-0.1*abs(lambda(1))*sign(lambda(1)*(dx - 0.6))"], ["0"]] }
)toml");
  desk.done("gp2 generate belt.toml --n 40 --seed 1 -o train.csv");
  desk.done("gp2 fit belt.toml --data train.csv --mean force -o fit.json");
  const std::string motion = " --start x=0,z=0,dx=0.6,dz=0 --t-end 10 --json -o motion.csv";
  const auto truth = desk.done("gp2 simulate belt.toml" + motion).json()["stick_events"];
  const auto learned = desk.done("gp2 simulate fit.json" + motion).json()["stick_events"];
  ASSERT_EQ(truth.size(), 5U);
  ASSERT_EQ(learned.size(), truth.size());
  for (std::size_t k = 0; k < truth.size(); ++k) {
    EXPECT_EQ(learned[k]["kind"], k % 2 == 0 ? "slips" : "sticks");
    EXPECT_EQ(learned[k]["surface"], "dx - 0.6");
    // μ is known to 0.001/√40 of m/s² in a friction of 5, and events move by it in parts
    EXPECT_NEAR(learned[k]["t"], truth[k]["t"], 1e-3) << k;
  }
}

TEST(SimulateModelCommand, WithoutProjectionDriftsAndSaysSo) {
  const Desk desk;
  const auto drift = [&](const std::string& options) -> double {
    return desk.done("gp2 simulate models/surface.toml " + figure_start + " --t-end 6 --json -o motion.csv " + options)
        .json()["max_position_drift"];
  };
  const double loose = drift("--project off --rtol 1e-4 --atol 1e-4"), tight = drift("--project off --rtol 1e-7 --atol 1e-7");
  EXPECT_GT(loose, 1e-6);
  EXPECT_GT(tight, 1e-9);
  EXPECT_LT(tight, loose / 100);
  EXPECT_LE(drift("--rtol 1e-4 --atol 1e-4"), 1e-12);
}

TEST(SimulateModelCommand, WritesTheTimesAskedForAndTheEnd) {
  const Desk desk;
  const auto times = [&](const std::string& options) {
    desk.done("gp2 simulate models/unicycle.toml --start dq1=1 -o motion.csv " + options);
    const CsvTable motion = desk.table("motion.csv");
    std::vector<double> t;
    for (int i = 0; i < motion.n_rows(); ++i) t.push_back(number(motion, i, "t"));
    return t;
  };
  EXPECT_THAT(times("--t-end 1 --dt 0.25"), ElementsAre(0, 0.25, 0.5, 0.75, 1));
  EXPECT_THAT(times("--t-end 1 --dt 0.4"), ElementsAre(0, 0.4, 0.8, 1));
  EXPECT_THAT(times("--t-end 1 --dt 4"), ElementsAre(0, 1));
  EXPECT_THAT(times("--t-start 2 --t-end 3 --dt 0.5"), ElementsAre(2, 2.5, 3));
  EXPECT_EQ(times("--t-end 0.3 --dt 0.1").size(), 4);
}

TEST(SimulateModelCommand, StartsFromTheFirstRowOfALog) {
  const Desk desk;
  desk.write("log.csv", "time,theta,q2,q3,dq1,dq2,dq3,note\n2,0.1,0.5,0,1,0,0,7\n9,9,9,9,9,9,9,9\n");
  desk.done("gp2 simulate models/unicycle.toml --start log.csv --map theta=q1 --t-end 3 -o motion.csv");
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_EQ(number(motion, 0, "t"), 2);
  EXPECT_EQ(number(motion, 0, "q1"), 0.1);
  EXPECT_EQ(number(motion, 0, "q2"), 0.5);
  EXPECT_EQ(number(motion, 0, "dq1"), 1);
  // a motion may be continued from its own last row: ddq, u and energy are not of a start
  desk.done("{ head -1 motion.csv; tail -1 motion.csv; } > last.csv");
  desk.done("gp2 simulate models/unicycle.toml --start last.csv --t-end 4 -o second.csv");
  desk.done("gp2 simulate models/unicycle.toml --start log.csv --map theta=q1 --t-end 4 -o whole.csv");
  const CsvTable second = desk.table("second.csv"), whole = desk.table("whole.csv");
  for (const char* name : {"q1", "q2", "q3", "dq1", "dq2"}) {
    EXPECT_NEAR(number(second, 99, name), number(whole, 99, name), 1e-5) << name;
  }
}

TEST(SimulateModelCommand, AStartOffTheConstraintsIsProjectedOrLeftAndReported) {
  const Desk desk;
  const std::string command = "gp2 simulate models/surface.toml --start q1=0.4,q2=0.8,q3=0.2 --t-end 0.1 --json -o motion.csv ";
  const Outcome projected = desk.done(command);
  EXPECT_TRUE(projected.said("leaves no solution of the constraints")) << projected.err;
  EXPECT_FALSE(projected.said("start: projected")) << projected.err;  // which the warning has said
  EXPECT_GT(projected.json()["start_displacement"], 0.01);
  EXPECT_NEAR(projected.json()["start_position_residual"], 0.2 - 0.0970358, 1e-6);
  const Outcome left = desk.done(command + "--project off");
  EXPECT_TRUE(left.said("start: off the constraints by |c| = 0.103, |dc/dt| = 0, and left there")) << left.err;
  EXPECT_EQ(number(desk.table("motion.csv"), 0, "q3"), 0.2);
  EXPECT_EQ(left.json()["start_displacement"], 0);
}

TEST(SimulateModelCommand, AWholeStartOffTheConstraintsIsAWarningUnlessItIsOfRoundedDigits) {
  const Desk desk;
  desk.write("sphere.toml",
             "coordinates = [\"x\", \"y\", \"z\"]\n[mechanics]\nmass = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
             "force = [\"0\", \"0\", \"-9.81\"]\n[constraints]\nposition = [\"x^2 + y^2 + z^2 - 1\"]\n");
  const auto simulated = [&](const std::string& start) {
    return desk.done("gp2 simulate sphere.toml --start " + start + " --t-end 0.1 -o motion.csv");
  };
  const Outcome moved = simulated("x=0.3,y=0.3,z=-0.2,dx=1,dy=1,dz=1");
  EXPECT_TRUE(moved.said("warning: --start: what is given leaves no solution of the constraints")) << moved.err;
  EXPECT_TRUE(moved.said("x = 0.639602149 for 0.3, y = 0.639602149 for 0.3, z = -0.426401433 for -0.2")) << moved.err;
  EXPECT_FALSE(moved.said("start: projected")) << moved.err;
  const Outcome fast = simulated("x=0,y=0,z=-1,dx=1,dy=0,dz=0.01");
  EXPECT_TRUE(fast.said("the nearest that has one is dz = 0 for 0.01") ||
              fast.said("the nearest that has one is dz = -0 for 0.01"))
      << fast.err;
  const Outcome rounded = simulated("x=0.6,y=0.6,z=-0.5292,dx=0,dy=0,dz=0");
  EXPECT_FALSE(rounded.said("warning")) << rounded.err;
  EXPECT_TRUE(rounded.said("start: projected onto the constraints, which moves it by up to")) << rounded.err;
}

TEST(SimulateModelCommand, RefusesASeedOfNoSamples) {
  const Desk desk;
  const Outcome outcome = desk.run("gp2 simulate models/surface.toml --start q1=0.4,q2=0.8 --t-end 0.1 --seed 3 -o motion.csv");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_TRUE(outcome.said("--seed requires --samples")) << outcome.err;
}

TEST(SimulateModelCommand, AssemblesAMechanismFromTheStartOfItsSampling) {
  const Desk desk;
  desk.done("gp2 simulate models/slider_crank.toml --start q1=0.5,dq1=4 --t-end 1 -o motion.csv");
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_EQ(number(motion, 0, "q1"), 0.5);
  EXPECT_NEAR(number(motion, 0, "q2"), -std::asin(std::sin(0.5) / 3), 1e-12);
  EXPECT_NEAR(number(motion, 0, "q3"), 0.1 * std::cos(0.5) + std::sqrt(0.09 - 0.01 * std::pow(std::sin(0.5), 2)), 1e-12);
}

TEST(SimulateModelCommand, FollowsTheInputsOfATable) {
  const Desk desk;
  desk.write("inputs.csv", "t,u1,u2\n0,1,0\n1,1,0\n2,0,0.01\n5,0,0\n");
  desk.done("gp2 simulate models/unicycle.toml --start q3=0 --inputs inputs.csv --t-end 4 --dt 0.5 -o motion.csv");
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_EQ(number(motion, 0, "u1"), 1);
  EXPECT_EQ(number(motion, 3, "u1"), 0.5);
  EXPECT_EQ(number(motion, 4, "u2"), 0.01);
  EXPECT_GT(number(motion, 8, "q1"), 1);
  EXPECT_GT(number(motion, 8, "q3"), 0.01);
  desk.write("milliseconds.csv", "t,u1,u2\n0,1,0\n1000,1,0\n2000,0,0.01\n5000,0,0\n");
  const Outcome late =
      desk.done("gp2 simulate models/unicycle.toml --start q3=0 --inputs milliseconds.csv --t-end 4 -o motion.csv");
  EXPECT_THAT(late.err, HasSubstr("its rows are 1e+03 s apart and the motion lasts 4 s: is its t in s?"));
}

TEST_F(SimulateFit, StaysOnTheConstraintAndWritesItsUncertainty) {
  const auto report = desk.done("gp2 simulate fit.json " + figure_start + " --t-end 6 --json -o motion.csv").json();
  EXPECT_LE(report["max_position_drift"], 1e-12);
  EXPECT_LE(report["max_velocity_drift"], 1e-12);
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_THAT(motion.header(), ElementsAre("t", "q1", "q2", "q3", "dq1", "dq2", "dq3", "ddq1", "ddq2", "ddq3", "u1", "u2", "u3",
                                           "lambda1", "ddq1_std", "ddq2_std", "ddq3_std", "distance_from_data", "energy"));
  EXPECT_GT(number(motion, 50, "ddq1_std"), 0);
  // the same numbers as predict's
  desk.done("gp2 predict fit.json --states motion.csv --cov std -o prediction.csv");
  const CsvTable prediction = desk.table("prediction.csv");
  for (const int row : {0, 42, 99}) {
    for (const char* name : {"ddq1", "ddq2", "ddq3"}) {
      EXPECT_NEAR(number(motion, row, name), number(prediction, row, name), 1e-12);
    }
    EXPECT_NEAR(number(motion, row, "ddq2_std"), number(prediction, row, "ddq2_std"), 1e-12);
  }
}

TEST_F(SimulateFit, SaysWhenTheMotionLeavesTheData) {
  const Outcome inside = desk.done("gp2 simulate fit.json --start q1=0,q2=0 --t-end 0.01 --json -o motion.csv");
  EXPECT_EQ(inside.json()["leaves_data_at"], nullptr) << inside.err;
  EXPECT_FALSE(inside.said("leaves the region"));
  const Outcome outside = desk.done("gp2 simulate fit.json --start q1=20,q2=30 --t-end 0.01 --json -o motion.csv");
  EXPECT_EQ(outside.json()["leaves_data_at"], 0);
  EXPECT_TRUE(outside.said("warning: the motion leaves the region of the data at t = 0: at its farthest")) << outside.err;
}

TEST(MotionNotes, NameTheSampleThatLeavesTheDataFirst) {
  std::vector<SimulatedMotion> motions(3);
  motions[1].uncertainty = MotionUncertainty{{}, Eigen::VectorXd::Ones(1), 0.41};
  motions[2].uncertainty = MotionUncertainty{{}, Eigen::VectorXd::Ones(1), 0.4};
  EXPECT_EQ(first_to_leave(motions), &motions[2]);
  EXPECT_THAT(motion_notes(motions), ElementsAre(HasSubstr("sample 2 leaves the region of the data at t = 0.4:")));
  motions.resize(1);
  EXPECT_EQ(first_to_leave(motions), nullptr);
}

TEST_F(SimulateFit, AnEnsembleOfSamplesStaysOnTheConstraint) {
  const std::string command = "gp2 simulate fit.json " + figure_start + " --t-end 0.5 --dt 0.1 --samples 3 --json ";
  const auto report = desk.done(command + "--seed 4 -o a.csv").json();
  EXPECT_LE(report["max_position_drift"], 1e-12);
  EXPECT_LE(report["max_velocity_drift"], 1e-12);
  const CsvTable ensemble = desk.table("a.csv");
  EXPECT_EQ(ensemble.header()[0], "episode");
  ASSERT_EQ(ensemble.n_rows(), 18);
  std::set<double> ends;
  for (int k = 0; k < 3; ++k) {
    EXPECT_EQ(number(ensemble, 6 * k, "episode"), k);
    EXPECT_EQ(number(ensemble, 6 * k, "t"), 0);
    EXPECT_EQ(number(ensemble, 6 * k, "q1"), 0.4);
    ends.insert(number(ensemble, 6 * k + 5, "q1"));
  }
  EXPECT_EQ(ends.size(), 3);
  desk.done(command + "--seed 4 -o b.csv");
  desk.done(command + "--seed 5 -o c.csv");
  EXPECT_EQ(desk.read("a.csv"), desk.read("b.csv"));
  EXPECT_NE(desk.read("a.csv"), desk.read("c.csv"));
}

TEST(SimulateRefusals, NameTheOptionTheRuleAndTheValue) {
  const Desk desk;
  desk.write("short.csv", "t,u1,u2\n0,0,0\n1,0,0\n");
  desk.write("back.csv", "t,u1,u2\n0,0,0\n1,0,0\n1,0,0\n");
  desk.write("one.csv", "t,u1\n0,0\n1,0\n");
  desk.write("other.csv", "a,b\n0,0\n");
  const std::vector<std::pair<std::string, std::string>> refusals = {
      {"--start q9=1 --t-end 1",
       "--start: 'q9' is no coordinate or velocity of 'unicycle'; there are: q1, q2, q3, dq1, dq2, dq3"},
      {"--start u1=1 --t-end 1", "--start: 'u1' is no coordinate or velocity"},
      {"--start q1=1x --t-end 1", "--start: q1 = '1x' is not a finite number"},
      {"--start q1=inf --t-end 1", "--start: q1 = 'inf' is not a finite number"},
      {"--start q1= --t-end 1", "--start: q1 = '' is not a finite number"},
      {"--start q1=1,q1=2 --t-end 1", "--start: 'q1' is given twice"},
      {"--start q1=1,q2 --t-end 1", "--start: 'q2' is not NAME=VALUE, say q1=0.4"},
      {"--start missing.csv --t-end 1", "missing.csv"},
      {"--start other.csv --t-end 1", "--start: other.csv has none of the columns q1, q2, q3, dq1, dq2, dq3"},
      {"--start q1=0 --t-end 0", "--t-end: must be after the start 0, got 0"},
      {"--start q1=0 --t-start 2 --t-end 1", "--t-end: must be after the start 2, got 1"},
      {"--start q1=0 --t-start nan --t-end 1", "--t-start: must be a finite number, got nan"},
      {"--start q1=0 --t-end 1 --dt 0", "--dt: must be positive, got 0"},
      {"--start q1=0 --t-end 1 --dt 1e-9", "--dt: 1e-09 would write 1e+09 rows; at most 1e+07 are written"},
      {"--start q1=0 --t-end 1 --rtol 0", "--rtol: must be positive, got 0"},
      {"--start q1=0 --t-end 1 --atol -1", "--atol: must be positive, got -1"},
      {"--start q1=0 --t-end 1 --rtol 1e-30", "--rtol: must be at least 1e-14, near the rounding of doubles, got 1e-30"},
      {"--start q1=0 --t-end 1 --max-steps 0", "--max-steps: must be at least 1, got 0"},
      {"--start q1=0 --t-end 1 --samples 0", "--samples: must be at least 1, got 0"},
      {"--start q1=0 --t-end 1 --samples 3", "--samples: a model has no posterior to draw from; give a FIT.json"},
      {"--start q1=0 --t-end 2 --inputs short.csv", "short.csv: times 0 to 1 do not cover the motion from 0 to 2"},
      {"--start q1=0 --t-end 1 --inputs back.csv", "back.csv: inputs: times must increase, but 1 follows 1"},
      {"--start q1=0 --t-end 1 --inputs one.csv", "one.csv: missing column 'u2'"},
  };
  for (const auto& [options, text] : refusals) {
    const Outcome outcome = desk.run("gp2 simulate models/unicycle.toml " + options + " -o motion.csv");
    EXPECT_EQ(outcome.status, 2) << options;
    EXPECT_THAT(outcome.err, HasSubstr(text)) << options;
    EXPECT_FALSE(desk.has("motion.csv")) << options;
  }
  const Outcome folder = desk.run("gp2 simulate models/unicycle.toml --start q1=0 --t-end 1 -o no/such/motion.csv");
  EXPECT_EQ(folder.status, 2);
  EXPECT_THAT(folder.err, HasSubstr("there is no folder 'no/such'"));
  const Outcome inputs = desk.run("gp2 simulate models/duffing.toml --start q1=0 --t-end 1 --inputs short.csv -o motion.csv");
  EXPECT_THAT(inputs.err, HasSubstr("--inputs: 'controlled Duffing oscillator' has no inputs"));
}

TEST(SimulateRefusals, AMotionThatCannotBeContinuedExitsWith1AndNamesTheTime) {
  const Desk desk;
  // ẍ = 2 x ẋ from x = ẋ = 1 is infinite at t = 1
  desk.write("blow.toml", "coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\nforce = [\"2*x*dx\"]\n");
  const Outcome outcome = desk.run("gp2 simulate blow.toml --start x=1,dx=1 --t-end 3 -o motion.csv");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("numerical failure: simulate: the step size fell to"));
  EXPECT_THAT(outcome.err, HasSubstr("at t = 1:"));
  EXPECT_THAT(outcome.err, HasSubstr("; motion.csv holds the motion up to there"));
  const CsvTable motion = desk.table("motion.csv");
  ASSERT_GT(motion.n_rows(), 30);
  // x = 1/(1 − t)
  EXPECT_NEAR(number(motion, 30, "x"), 1 / (1 - number(motion, 30, "t")), 1e-2);
  EXPECT_GT(number(motion, motion.n_rows() - 1, "x"), 1e6);
}

TEST(SimulateModelCommand, DryFrictionStopsABodyInsteadOfTheCommand) {
  const Desk desk;
  desk.write("block.toml", "coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\nforce = [\"-2*sign(dx)\"]\n");
  const auto report = desk.done("gp2 simulate block.toml --start dx=1 --t-end 10 --json -o motion.csv").json();
  EXPECT_LT(report["steps"], 100);
  const CsvTable motion = desk.table("motion.csv");
  EXPECT_NEAR(number(motion, 99, "x"), 0.25, 1e-8);
  EXPECT_NEAR(number(motion, 99, "dx"), 0, 1e-12);

  // a fit whose latent jumps likewise
  desk.write(
      "learn.toml",
      "coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\nforce = [\"0\"]\n[truth]\nacceleration = [\"-2*sign(dx)\"]\n"
      "[sampling]\nx = [-1, 1]\ndx = [-1, 1]\n[[latent]]\nkernel = \"se\"\nfeatures = [\"sign(dx)\"]\n[noise]\nddq = 0.01\n");
  desk.done("gp2 generate learn.toml --n 30 -o log.csv");
  desk.done("gp2 fit learn.toml --data log.csv --restarts 1 -o fit.json");
  const auto learnt = desk.done("gp2 simulate fit.json --start dx=1 --t-end 10 --json -o learnt.csv").json();
  EXPECT_LT(learnt["steps"], 200);
  EXPECT_NEAR(number(desk.table("learnt.csv"), 99, "x"), 0.25, 1e-3);
}

TEST(SimulateModelCommand, EndsAtItsStepsAndWritesWhatTheyReach) {
  const Desk desk;
  const Outcome outcome =
      desk.run("gp2 simulate models/surface.toml " + figure_start + " --t-end 600 --max-steps 50 --json -o motion.csv");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("numerical failure: simulate: 50 steps reach no further than t = "));
  EXPECT_THAT(outcome.err, HasSubstr("allow more steps (--max-steps); motion.csv holds the motion up to there"));
  EXPECT_EQ(outcome.json()["steps"].get<int>() + outcome.json()["rejected_steps"].get<int>(), 50);
  EXPECT_GE(desk.table("motion.csv").n_rows(), 2);
}

TEST(SimulateModelCommand, TellsWhenAMultiplierChangesItsSign) {
  const Desk desk;
  // a load on a floor that turns with time, and would lift the body
  desk.write("floor.toml",
             "coordinates = [\"x\", \"y\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [\"0\", \"-9.81*cos(t)\"]\n"
             "[constraints]\nposition = [\"y\"]\n");
  const auto report = desk.done("gp2 simulate floor.toml --start dx=1 --t-end 3 --dt 0.01 --json -o motion.csv").json();
  ASSERT_EQ(report["multiplier_sign_changes"]["lambda1"].size(), 1);
  EXPECT_NEAR(report["multiplier_sign_changes"]["lambda1"][0].get<double>(), M_PI / 2, 1e-4);
  EXPECT_NEAR(number(desk.table("motion.csv"), 0, "lambda1"), 9.81, 1e-12);
}

// The multiplier is 0 where the floor does not hold, and of one sign where it does.
TEST(SimulateModelCommand, AConstraintThatTakesHoldOrLetsGoChangesNoSign) {
  const Desk desk;
  for (const char* load : {"-9.81", "9.81"}) {
    desk.write("floor.toml",
               std::string("coordinates = [\"x\", \"y\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [\"0\", \"") + load +
                   "\"]\n[constraints]\nvelocity = [{ expr = \"dy\", when = \"abs(x - 1) < 0.5\" }]\n");
    const auto report = desk.done("gp2 simulate floor.toml --start dx=1 --t-end 2 --dt 0.05 --json -o motion.csv").json();
    EXPECT_TRUE(report["multiplier_sign_changes"]["lambda1"].empty()) << report["multiplier_sign_changes"];
    EXPECT_EQ(number(desk.table("motion.csv"), 0, "lambda1"), 0);
    EXPECT_NEAR(std::abs(number(desk.table("motion.csv"), 20, "lambda1")), 9.81, 1e-9);
  }
}

// A rod that slides on a rough floor until its end jams: there is no motion from then on, and no load to record.
TEST(SimulateRefusals, AMotionIntoPainlevesParadoxIsWrittenUpToThere) {
  const Desk desk;
  desk.write("rod.toml", R"toml(
coordinates = ["x", "z", "th"]
inputs      = ["touch"]
[let]
slip = "dx + 0.5*sin(th)*dth"
N    = "abs(lambda(tip))"
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1/12"]]
force = ["0", "-9.81", "0"]
[constraints]
position = [{ expr = "z - 0.5*sin(th)", contact = "touch", restitution = 0.5, name = "tip" }]
[truth]
force = ["-1.6*N*sign(slip)", "0", "-0.8*sin(th)*N*sign(slip)"]
)toml");
  const Outcome outcome = desk.run(
      "gp2 simulate rod.toml --start x=0,z=0.4817790927085965,th=1.3,dx=2,dz=0,dth=0 --t-end 0.4 --dt 0.1 -o motion.csv");
  EXPECT_EQ(outcome.status, 1) << outcome.err;
  EXPECT_TRUE(outcome.said("numerical failure: simulate: no acceleration at t = 0.1")) << outcome.err;
  EXPECT_TRUE(outcome.said("Painlevé's paradox")) << outcome.err;
  EXPECT_GE(desk.table("motion.csv").n_rows(), 2);
}

// What takes hold by `when` is there at once, wherever the body is: that is said, and what holds at the edge of its own `when` too.
TEST(SimulateModelCommand, SaysWhatAConditionDoesThatIsAContact) {
  const Desk desk;
  const auto write = [&](const std::string& constraint) {
    desk.write("held.toml",
               "coordinates = [\"x\", \"z\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [\"0\", \"-1\"]\n"
               "[constraints]\nposition = [" +
                   constraint + "]\n");
  };
  write(R"({ expr = "z - 0.5*x", when = "x > 1" })");
  const Outcome jump = desk.done("gp2 simulate held.toml --start x=0,z=2,dx=1,dz=0 --t-end 2 --dt 0.1 -o motion.csv");
  EXPECT_TRUE(jump.said("warning: the motion jumps by 0.")) << jump.err;
  EXPECT_TRUE(jump.said("where a constraint becomes active off its surface: write what meets a surface as a contact"))
      << jump.err;
  const Outcome before = desk.done("gp2 simulate held.toml --start x=0,z=2,dx=1,dz=0 --t-end 0.9 --dt 0.1 -o motion.csv");
  EXPECT_FALSE(before.said("becomes active")) << before.err;
  // a constraint that holds all the time drifts by itself, beside a condition that is never met and one that always is
  for (const char* constraint :
       {R"("x^2 + z^2 - 4", { expr = "z - 9", when = "x > 4000" })", R"({ expr = "x^2 + z^2 - 4", when = "x < 4000" })"}) {
    write(constraint);
    const Outcome drift = desk.done("gp2 simulate held.toml --start x=2,z=0 --t-end 3 --dt 0.1 --rtol 1e-4 -o motion.csv");
    EXPECT_FALSE(drift.said("becomes active")) << drift.err;
  }
  write(R"({ expr = "x^2 + z^2 - 1", when = "x^2 + z^2 >= 1" })");
  const Outcome rope = desk.run("gp2 simulate held.toml --start x=0.5,z=0 --t-end 5 --dt 0.2 --max-steps 2000 -o motion.csv");
  EXPECT_EQ(rope.status, 1);
  EXPECT_TRUE(rope.said("a constraint that holds at the very edge of its condition is to be a contact")) << rope.err;
}

// A plate that goes up gives a ball energy, without friction and at every restitution.
TEST(SimulateModelCommand, AMovingSurfaceGivesEnergyInAnImpact) {
  const Desk desk;
  desk.write(
      "plate.toml",
      "coordinates = [\"z\"]\ninputs = [\"touch\"]\n[mechanics]\nmass = [[1]]\nforce = [\"-9.81\"]\npotential = \"9.81*z\"\n"
      "[constraints]\nposition = [{ expr = \"z - t\", contact = \"touch\", restitution = 0.9 }]\n");
  const Outcome outcome = desk.done("gp2 simulate plate.toml --start z=0.5,dz=0 --t-end 0.4 --dt 0.1 -o motion.csv");
  EXPECT_TRUE(outcome.said(" J, as a surface that moves does")) << outcome.err;
  EXPECT_FALSE(outcome.said("a smaller restitution")) << outcome.err;
}

TEST(SimulateModelCommand, TellsTheTimesOfContactsByAClockToo) {
  const Desk desk;
  desk.write("floor.toml",
             "coordinates = [\"z\"]\ninputs = [\"touch\"]\n[mechanics]\nmass = [[1]]\nforce = [\"-9.81\"]\n"
             "[constraints]\nposition = [{ expr = \"z\", contact = \"touch\", restitution = 0.9 }]\n");
  const Outcome outcome =
      desk.done("gp2 simulate floor.toml --start z=0.5,dz=0 --t-start 1.7e9 --t-end 1700000000.4 --dt 0.1 -o motion.csv");
  EXPECT_TRUE(outcome.said("the first event at t = 1700000000.3192")) << outcome.err;
}

TEST_F(SimulateFit, MapRefusesNamesThatNobodyHas) {
  const auto refusal = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 simulate fit.json --t-end 0.1 -o motion.csv " + options);
    EXPECT_EQ(outcome.status, 2) << options;
    return outcome.err;
  };
  EXPECT_THAT(refusal("--start train.csv --map nosuch=q99"), HasSubstr("--map nosuch=q99: 'q99' is neither a state nor"));
  EXPECT_THAT(refusal("--start train.csv --map nosuch=q1"), HasSubstr("--map nosuch=q1: train.csv has no column 'nosuch'"));
  EXPECT_THAT(refusal(figure_start + " --map nosuch=q99"), HasSubstr("'q99' is neither"));
  // of two logs one may lack the column
  desk.write("inputs.csv", "t,push,u2,u3\n0,1,0,0\n1,1,0,0\n");
  desk.done("gp2 simulate fit.json --start train.csv --inputs inputs.csv --map push=u1 --t-end 0.1 -o motion.csv");
}

// The learned potential is not all of the energy where a known force acts at rest.
TEST(SimulatePotential, ReportsNoEnergyThatLacksTheKnownForce) {
  Desk desk;
  const auto motion_with = [&](const std::string& potential) {
    desk.write("spring.toml",
               "coordinates = ['q']\n[mechanics]\nmass = [[1]]\nforce = ['-9.81*sin(q)']\n" + potential +
                   "[[latent]]\nname = 'spring'\nfeatures = ['q']\ndirections = 'potential'\n[truth]\nforce = ['-2*q']\n[noise]\n"
                   "ddq = 0.01\n[sampling]\nq = [-1.5, 1.5]\ndq = [-1, 1]\n");
    desk.done("gp2 generate spring.toml --n 20 -o train.csv");
    desk.done("gp2 fit spring.toml --data train.csv --mean force --restarts 1 --hyperparameters optimise -o fit.json");
    return desk.done("gp2 simulate fit.json --start q=1 --t-end 0.5 -o motion.csv");
  };
  EXPECT_TRUE(motion_with("").said("no energy: spring.toml has a learned potential, but the known force acts at rest"));
  EXPECT_EQ(desk.table("motion.csv").find("energy"), -1);
  EXPECT_FALSE(motion_with("potential = '-9.81*cos(q)'\n").said("no energy"));
  EXPECT_GE(desk.table("motion.csv").find("energy"), 0);
}

}  // namespace
}  // namespace gp2::test
