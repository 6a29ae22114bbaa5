#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;

std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  for (std::size_t first = 0; first < text.size();) {
    const std::size_t end = text.find('\n', first);
    lines.push_back(text.substr(first, end - first));
    first = end + 1;
  }
  return lines;
}

TEST(ResampleCommand, WritesWholeRowsOfTheLogInTheOrderOfChoice) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 80 -o log.csv");
  const Outcome outcome = desk.done("gp2 resample log.csv --model models/surface.toml -n 30 -o subset.csv");
  EXPECT_TRUE(outcome.said("distances are in q1, q2, q3, dq1, dq2, dq3, u1, u2, u3, each divided by its standard deviation"));
  EXPECT_TRUE(outcome.said("subset.csv: 30 of 80 rows; every other row is within "));
  EXPECT_EQ(outcome.out, "");
  const std::vector<std::string> log = lines_of(desk.read("log.csv")), subset = lines_of(desk.read("subset.csv"));
  ASSERT_EQ(subset.size(), 31U);
  EXPECT_EQ(subset.front(), log.front());
  for (const std::string& line : subset) EXPECT_THAT(log, testing::Contains(line));

  desk.done("gp2 resample log.csv --model models/surface.toml -n 10 -o fewer.csv");
  EXPECT_TRUE(desk.read("subset.csv").starts_with(desk.read("fewer.csv"))) << "a smaller choice begins a larger one";
}

TEST(ResampleCommand, MeasuresByTheFeaturesAskedForFromTheSeedGiven) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 80 -o log.csv");
  const std::string line = "gp2 resample log.csv --model models/surface.toml -n 10 ";
  EXPECT_TRUE(desk.done(line + "--features 'atan2(q1, q2), dq1' -o a.csv").said("distances are in atan2(q1, q2), dq1, each"));
  desk.done(line + "--seed 1 -o b.csv");
  desk.done(line + "--seed 2 -o c.csv");
  desk.done(line + "--seed 2 -o d.csv");
  EXPECT_NE(desk.read("b.csv"), desk.read("c.csv"));
  EXPECT_EQ(desk.read("c.csv"), desk.read("d.csv"));
}

TEST(ResampleCommand, LeavesCellsAsTheyAreAndSkipsGaps) {
  const Desk desk;
  desk.write("log.csv", "t,remark,place\n0,\"a, \"\"b\"\"\",1.50\n1,,nan\n2,c,+2e0\n");
  desk.write("model.toml",
             "coordinates = [\"x\"]\n[mechanics]\nmass = [[\"1\"]]\n[[latent]]\nname = \"f\"\nkernel = \"se\"\n"
             "features = [\"x\"]\ndirections = \"acceleration\"\n");
  const Outcome outcome = desk.done("gp2 resample log.csv --model model.toml --map place=x -n 2 -o subset.csv");
  EXPECT_TRUE(outcome.said("log.csv: 1 row skipped: a feature has no value"));
  EXPECT_EQ(desk.read("subset.csv"), "t,remark,place\n0,\"a, \"\"b\"\"\",1.50\n2,c,+2e0\n");
}

TEST(ResampleCommand, RefusesWhatCannotBeAndWritesNothing) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 5 -o log.csv");
  const auto refused = [&](const std::string& arguments, const std::string& text) {
    const Outcome outcome = desk.run("gp2 resample log.csv --model models/surface.toml -o subset.csv " + arguments);
    EXPECT_EQ(outcome.status, 2) << arguments;
    EXPECT_THAT(outcome.err, HasSubstr(text));
    EXPECT_FALSE(desk.has("subset.csv"));
  };
  refused("-n 6", "log.csv: has 5 rows, fewer than the n = 6 asked for");
  refused("-n 0", "n must be positive, got 0");
  refused("-n 2 --features q9", "--features: 'q9': ");
  refused("-n 2 --features 'sin(q1'", "--features: a parenthesis is not closed in 'sin(q1'");
  refused("-n 2 --seed -1", "must not be negative");
  refused("-n 2 --map nothing=q1", "log.csv has no column 'nothing'");
  refused("", "-n");
}

TEST(StatedNoiseCommand, FitsEvaluatesAndChecksALogWithDeviations) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 --noise-std 0.05 -o plain.csv");
  // q3 depends on the others: a derived log completes its acceleration and marks the two that were measured
  std::string csv;
  for (const std::string& line : lines_of(desk.read("plain.csv"))) {
    csv += line + (csv.empty() ? ",ddq1_std,ddq2_std,q1_std" : ",0.05,0.04,0.001") + "\n";
  }
  desk.write("log.csv", csv);
  desk.write("model.toml", replaced(desk.read("models/surface.toml"), "[noise]\nddq = 0.1 ", ""));
  const Outcome fit = desk.done("gp2 fit model.toml --data log.csv --restarts 1 --max-iterations 20 -o fit.json");
  EXPECT_TRUE(fit.said("log.csv: observes ddq1, ddq2: the log has standard deviations of these only; others with --observe"));
  EXPECT_TRUE(fit.said("log.csv: columns not needed: q1_std"));
  EXPECT_EQ(desk.json("fit.json")["observations"][0]["noise_scale"]["ddq2"][0], 0.04);
  const Outcome evaluation = desk.done("gp2 evaluate fit.json --data log.csv --json");
  EXPECT_LT(evaluation.json()["nrmse"], 0.5);
  desk.done("gp2 predict fit.json --states log.csv --cov std -o prediction.csv");
  EXPECT_THAT(desk.done("gp2 check model.toml --data log.csv").out,
              HasSubstr("ok       noise of each value: ddq1, ddq2, which a fit observes"));
  EXPECT_TRUE(desk.done("gp2 fit model.toml --data log.csv --noise-std 0.1 --max-iterations 0 -o fit.json")
                  .said("log.csv: --noise-std 0.1 replaces the standard deviations in ddq1_std, ddq2_std"));
  EXPECT_FALSE(desk.json("fit.json")["observations"][0].contains("noise_scale"));
  desk.done("gp2 fit model.toml --data log.csv --noise-std estimate --restarts 1 --max-iterations 5 -o fit.json");
  EXPECT_NE(desk.read("fit.json").find("stated deviation of ddq1"), std::string::npos);
}

}  // namespace
}  // namespace gp2::test
