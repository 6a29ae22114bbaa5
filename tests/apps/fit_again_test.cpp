#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;

class FitAgain : public testing::Test {
 protected:
  FitAgain() { desk.done("gp2 generate models/surface.toml --n 24 --seed 3 -o train.csv"); }

  // fits with these options, then again from the file alone and from the log
  void expect_same_bits(const std::string& model, const std::string& data, const std::string& options) {
    desk.done("gp2 fit models/" + model + " " + data + " " + options + " -o fit.json");
    desk.done("gp2 fit --again fit.json -o again.json");
    EXPECT_EQ(desk.read("again.json"), desk.read("fit.json")) << options;
    desk.done("gp2 fit --again fit.json " + data + " -o from_log.json");
    EXPECT_EQ(desk.read("from_log.json"), desk.read("fit.json")) << options;
  }

  Desk desk;
};

TEST_F(FitAgain, GivesTheSameBitsFromItsFileAndFromItsLog) {
  const std::string quick = "--restarts 2 --max-iterations 15 ";
  for (const std::string options :
       {"", "--mean force --estimate p1 --seed 7", "--noise-std estimate --max-points 12 --seed 3",
        "--protocol paper --observe ddq1,ddq3", "--hyperprior none --discrepancy none --prior force --no-standard-errors",
        "--baseline se", "--project --max-escapes 1 --gradient-tolerance 1e-3 --reduction-tolerance 1e-6"}) {
    expect_same_bits("surface.toml", "--data train.csv", quick + options);
  }
}

TEST_F(FitAgain, SaysWhichLogIsNotTheOneThatWasLearnedFrom) {
  desk.done("gp2 generate models/surface.toml --n 10 --seed 5 -o more.csv");
  desk.done("gp2 fit models/surface.toml --data train.csv --data more.csv --max-iterations 0 -o fit.json");
  const std::string again = "gp2 fit --again fit.json -o again.json ";
  EXPECT_THAT(desk.done(again + "--data train.csv --data more.csv").err, Not(HasSubstr("warning")));
  desk.done("cp more.csv copy.csv");
  EXPECT_THAT(desk.done(again + "--data train.csv --data copy.csv").err, Not(HasSubstr("copy.csv is not")));
  EXPECT_THAT(desk.done(again + "--data train.csv").err, HasSubstr("warning: more.csv, a log of the fit, is not given"));
  desk.done("gp2 generate models/surface.toml --n 12 --seed 6 -o more.csv");
  const std::string err = desk.done(again + "--data train.csv --data more.csv --data copy.csv").err;
  EXPECT_THAT(err, testing::ContainsRegex(
                       "warning: more.csv has changed since the fit: now [0-9]+ bytes, 12 rows; then [0-9]+ bytes, 10 rows"));
  desk.done("gp2 generate models/surface.toml --n 12 --seed 7 -o new.csv");
  EXPECT_THAT(desk.done(again + "--data train.csv --data copy.csv --data new.csv").err,
              HasSubstr("warning: new.csv is not a log of the fit"));

  // a fit, of what it is given twice; an update, of what was learned and what it adds
  EXPECT_THAT(desk.done("gp2 fit models/surface.toml --data more.csv --data copy.csv --max-iterations 0 -o two.json").err,
              Not(HasSubstr("already")));
  EXPECT_THAT(desk.done("gp2 fit models/surface.toml --data copy.csv --data copy.csv --max-iterations 0 -o two.json").err,
              HasSubstr("warning: copy.csv is already in the fit: its rows count twice"));
  EXPECT_THAT(desk.done("gp2 update fit.json --data new.csv -o more.json").err, Not(HasSubstr("already")));
  for (const std::string log : {"new.csv", "copy.csv"}) {
    EXPECT_THAT(desk.done("gp2 update more.json --data " + log + " -o twice.json").err,
                HasSubstr("warning: " + log + " is already in the fit: its rows count twice"));
  }
  // but not of what the window leaves behind, under this name or another
  desk.done("head -1 new.csv > sorted.csv && tail -n +2 new.csv | sort >> sorted.csv");
  for (const std::string data : {"--data new.csv", "--data sorted.csv", "--data more.csv --data new.csv"}) {
    EXPECT_THAT(desk.done("gp2 update more.json " + data + " --window 12 -o twice.json").err, Not(HasSubstr("warning"))) << data;
  }
  EXPECT_THAT(desk.done("gp2 update more.json --data new.csv --window 20 -o twice.json").err,
              HasSubstr("warning: new.csv is already in the fit: its rows count twice"));
  EXPECT_THAT(desk.done("gp2 update more.json --data sorted.csv --window 20 -o twice.json").err,
              HasSubstr("rows are also in another log"));
}

TEST_F(FitAgain, StartsWhereTheFitStarted) {
  desk.write("start.json", R"json({"lengthscale(q1)": 2.5})json");
  desk.done("gp2 fit models/surface.toml --data train.csv --start start.json --max-iterations 3 --restarts 1 -o fit.json");
  EXPECT_EQ(desk.json("fit.json")["options"]["start"]["lengthscale(q1)"], 2.5);
  std::filesystem::remove(desk / "start.json");
  desk.done("gp2 fit --again fit.json -o again.json");
  EXPECT_EQ(desk.read("again.json"), desk.read("fit.json"));
}

TEST_F(FitAgain, TakesOtherSystemsAndSideInformationAlong) {
  desk.write("other.toml", replaced(desk.read("models/surface.toml"), "value = 0.08", "value = 0.09"));
  desk.done("gp2 generate other.toml --n 10 --seed 5 -o other.csv");
  desk.write("rest.csv", "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3,abar_q1\n0,0,0,0,0,0,0,0,0,0\n1,0,0,0,0,0,0,0,0,0\n");
  expect_same_bits("surface.toml", "--data train.csv --data other.csv@other.toml --also unconstrained:rest.csv",
                   "--also-noise-std 0.01 --restarts 1 --max-iterations 5");
}

TEST_F(FitAgain, RobustFitsNeedTheirLog) {
  desk.done("gp2 fit models/surface.toml --data train.csv --robust --restarts 1 --max-iterations 5 -o fit.json");
  const Outcome refused = desk.run("gp2 fit --again fit.json -o again.json");
  EXPECT_EQ(refused.status, 2);
  EXPECT_THAT(refused.err,
              HasSubstr("--again: the file of a robust fit has changed noise in its data; give its logs with --data"));
  desk.done("gp2 fit --again fit.json --data train.csv -o again.json");
  EXPECT_EQ(desk.read("again.json"), desk.read("fit.json"));
}

TEST_F(FitAgain, RefusesWhatItDoesNotTake) {
  desk.done("gp2 fit models/surface.toml --data train.csv --max-iterations 0 -o fit.json");
  const auto refusal = [&](const std::string& arguments) {
    const Outcome outcome = desk.run("gp2 fit " + arguments + " -o again.json");
    EXPECT_EQ(outcome.status, 2) << arguments;
    return outcome.err;
  };
  EXPECT_THAT(refusal("models/surface.toml --again fit.json"),
              HasSubstr("--again: fit.json contains its model and options: leave out"));
  EXPECT_THAT(refusal("--again fit.json --noise-std 0.1"), HasSubstr("leave out --noise-std"));
  EXPECT_THAT(refusal("--again fit.json --also unconstrained:train.csv"), HasSubstr("--again: --also goes with --data"));
  EXPECT_THAT(refusal("--again absent.json"), HasSubstr("absent.json: cannot be read"));
  EXPECT_THAT(refusal("--data train.csv"), HasSubstr("MODEL is required"));
  EXPECT_THAT(refusal("models/surface.toml"), HasSubstr("--data or --raw is required, or --also alone"));
  EXPECT_THAT(desk.run("gp2 fit --again fit.json -o fit.json").err, HasSubstr("that is the input fit.json"));
}

}  // namespace
}  // namespace gp2::test
