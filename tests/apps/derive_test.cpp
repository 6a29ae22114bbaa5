#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "reference_data.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;

// a double pendulum's angles at 200 Hz in two episodes, as encoders of 1e-4 rad would log them
std::string encoder_log(const Desk& desk) {
  std::string log = "episode,time,theta1,theta2\n";
  for (int episode = 0; episode < 2; ++episode) {
    desk.done(fmt::format("gp2 simulate models/double_pendulum.toml --start q3={},q6=3.6 --t-end 1 --dt 0.005 -o motion.csv",
                          3.5 - episode));
    const CsvTable motion = desk.table("motion.csv");
    for (int row = 0; row < motion.n_rows(); ++row) {
      log += fmt::format("{},{}", episode, motion.cell(row, 0));
      for (const char* angle : {"q3", "q6"}) log += fmt::format(",{:.4f}", motion.number(row, motion.find(angle)));
      log += "\n";
    }
  }
  return log;
}

TEST(DeriveCommand, MakesOfAnEncoderLogWhatFitNeeds) {
  const Desk desk;
  desk.write("log.csv", encoder_log(desk));
  const Outcome outcome =
      desk.done("gp2 derive log.csv --model models/double_pendulum.toml --map theta1=q3,theta2=q6 -o data.csv");
  EXPECT_TRUE(outcome.said("column 'theta1' taken as q3")) << outcome.err;
  EXPECT_TRUE(outcome.said("column 'time' taken as t"));
  EXPECT_TRUE(outcome.said("from the constraints: q1, q2, q4, q5"));
  EXPECT_TRUE(outcome.said("q6: 402 samples at "));
  EXPECT_TRUE(outcome.said("resolution 0.0001"));
  EXPECT_TRUE(outcome.said("data.csv: 402 rows, 2 episodes; independent accelerations: ddq3, ddq6"));
  const CsvTable data = desk.table("data.csv");
  EXPECT_EQ(data.n_rows(), 402);
  EXPECT_GE(data.find("ddq3_std"), 0);

  // fit learns from the rows that have a deviation
  desk.done(
      "gp2 fit models/double_pendulum.toml --data data.csv --prior force --max-points 20 --max-iterations 0 --restarts 1 -o "
      "fit.json");
  const Outcome checked = desk.done("gp2 check models/double_pendulum.toml --data data.csv");
  EXPECT_THAT(checked.out + checked.err, Not(HasSubstr("ERROR")));
}

TEST(DeriveCommand, ChoosesEpisodesAndRows) {
  const Desk desk;
  desk.write("log.csv", encoder_log(desk));
  const std::string derive = "gp2 derive log.csv --model models/double_pendulum.toml --map theta1=q3,theta2=q6 -o data.csv ";
  desk.done(derive + "--episodes 1-1 --every 4 --keep theta2");
  EXPECT_EQ(desk.table("data.csv").n_rows(), 51);
  EXPECT_EQ(desk.table("data.csv").cell(0, 0), "1");
  EXPECT_EQ(desk.table("data.csv").header().back(), "theta2");
  desk.done(derive + "--rate 30");
  EXPECT_EQ(desk.table("data.csv").n_rows(), 62);
}

TEST(DeriveCommand, WritesNothingWhereTheLogIsBad) {
  const Desk desk;
  const std::string log = encoder_log(desk);
  const auto fails = [&](const std::string& content, const std::string& options, const std::string& text) {
    desk.write("log.csv", content);
    const Outcome outcome =
        desk.run("gp2 derive log.csv --model models/double_pendulum.toml --map theta1=q3,theta2=q6 -o data.csv " + options);
    EXPECT_EQ(outcome.status, 2) << text;
    EXPECT_TRUE(outcome.said(text)) << outcome.err;
    EXPECT_FALSE(desk.has("data.csv"));
  };
  fails(replaced(log, "\n1,0.005,", "\n1,0.5,"), "",
        "column 'time': time runs backwards in episode 1 at data row 204: 0.01 after 0.5");
  fails(log.substr(0, log.find('\n', 40) + 1), "",
        "1 samples are too few to find a motion in; 5 are needed; leave that episode out");
  fails(replaced(log, "time,", "clock,"), "", "missing column 't'");
  fails(log, "--episode run", "--episode: log.csv has no column 'run'");
  fails(log, "--episodes 5-3", "--episodes: '5-3' is not a range FIRST-LAST");
  fails(log, "--episodes 7", "--episodes: log.csv has no episode '7'; it has: 0, 1");
  fails(log, "--smoothness 3/2", "--smoothness");
  fails(replaced(log, "theta2", "phi"), "", "phi");
}

// The encoder log of a real double pendulum: fifty rows of its slow half, chosen to cover it, predict the fast one.
TEST(DeriveCommand, RealEncodersPredictFastSwingingFromSlow) {
  if (const auto absent = why_real_is_absent()) GTEST_SKIP() << *absent;
  const Desk desk;
  desk.done("gp2 derive '" + real_file("double_pendulum/raw.csv").string() +
            "' --model models/double_pendulum.toml --map theta1=q3,theta2=q6 --episodes 13-25 -o low.csv");
  for (int seed = 0; seed < 3; ++seed) {
    desk.done(fmt::format("gp2 resample low.csv --model models/double_pendulum.toml -n 50 --seed {} -o train.csv", seed));
    desk.done(
        "gp2 fit models/double_pendulum.toml --data train.csv --observe ddq3,ddq6 --prior force -o "
        "fit.json");
    const double nrmse = desk.done("gp2 evaluate fit.json --data '" + real_file("double_pendulum/test.csv").string() +
                                   "' --outputs ddq3,ddq6 --json")
                             .json()["nrmse"];
    EXPECT_LE(nrmse, 0.012) << "seed " << seed;
  }
}

class FitRaw : public testing::Test {
 protected:
  FitRaw() { desk.write("log.csv", encoder_log(desk)); }

  const std::string fit =
      "gp2 fit models/double_pendulum.toml --map theta1=q3,theta2=q6 --prior force --mean force --restarts 1 ";
  Desk desk;
};

TEST_F(FitRaw, GoesFromPositionsToAFit) {
  const Outcome outcome = desk.done(
      fit + "--raw log.csv --max-points 40 --hyperparameters optimise --passes 2 --smoothed smoothed.csv -o fit.json --json");
  EXPECT_TRUE(outcome.said("from the constraints: q1, q2, q4, q5")) << outcome.err;
  EXPECT_TRUE(outcome.said("the learned dynamics")) << outcome.err;
  EXPECT_TRUE(outcome.said("fit.json: fit of 'double pendulum' to 40 rows")) << outcome.err;
  EXPECT_EQ(desk.table("smoothed.csv").n_rows(), 402);
  EXPECT_GE(desk.table("smoothed.csv").find("ddq6_std"), 0);
  EXPECT_LT(outcome.json()["left_out"]["stretches"]["nrmse"], 0.1);
  // the rows are in the file
  desk.done("gp2 fit --again fit.json -o again.json");
  EXPECT_EQ(desk.read("again.json"), desk.read("fit.json"));
}

TEST_F(FitRaw, KnowsTheLogsThatItLearnedFrom) {
  desk.done(fit + "--raw log.csv --max-points 40 --max-iterations 0 --passes 0 --smoothed smoothed.csv -o fit.json");
  const auto logs = desk.json("fit.json")["logs"];
  ASSERT_EQ(logs.size(), 1U);
  EXPECT_EQ(logs[0]["name"], "smoothed.csv");
  EXPECT_TRUE(desk.done("gp2 evaluate fit.json --data smoothed.csv").said("the fit has learned from this log"));
  EXPECT_TRUE(desk.done("gp2 update fit.json --data smoothed.csv -o more.json").said("smoothed.csv is already in the fit"));
}

TEST_F(FitRaw, ItsParametersMayBeEstimatedAnewFromTheMotion) {
  desk.done(
      fit +
      "--raw log.csv --max-points 40 --hyperparameters optimise --passes 0 --estimate c1 --smoothed smoothed.csv -o fit.json");
  const Outcome outcome = desk.done("gp2 shoot fit.json --data smoothed.csv --stretches 4 -o shot.json");
  EXPECT_TRUE(outcome.said("shot.json: 4 stretches of")) << outcome.err;
  EXPECT_THAT(outcome.out, testing::ContainsRegex("c1 +[0-9.e-]+ ± [0-9.e-]+ +[0-9.e-]+ ± "));
  EXPECT_THAT(outcome.out, testing::ContainsRegex("rms off in q3 +[0-9.e-]+ +[0-9.e-]+"));
  desk.done("gp2 predict shot.json --states smoothed.csv -o prediction.csv");
  EXPECT_THAT(desk.run("gp2 shoot fit.json --data log.csv -o shot.json").err, HasSubstr("missing column"));
}

TEST_F(FitRaw, RefusesWhatDoesNotGoTogether) {
  const auto refusal = [&](const std::string& options) {
    const Outcome outcome = desk.run(fit + options + " -o fit.json");
    EXPECT_EQ(outcome.status, 2) << options;
    EXPECT_FALSE(desk.has("fit.json"));
    return outcome.err;
  };
  EXPECT_THAT(refusal("--raw log.csv --data log.csv"), HasSubstr("--raw replaces --data: leave out one of them"));
  EXPECT_THAT(refusal("--data log.csv --passes 2"), HasSubstr("--raw"));
  EXPECT_THAT(refusal("--raw log.csv --smoothed log.csv"), HasSubstr("log.csv"));
  EXPECT_THAT(refusal("--raw log.csv --passes -1"), HasSubstr("--passes: must not be negative, got -1"));
  EXPECT_THAT(refusal("--raw absent.csv"), HasSubstr("absent.csv"));
}

}  // namespace
}  // namespace gp2::test
