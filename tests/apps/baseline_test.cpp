#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

// gp2 fit --baseline, and what is done with its fit.
namespace gp2::test {
namespace {

using testing::AllOf;
using testing::HasSubstr;
using testing::Not;

class BaselineCommand : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/surface.toml --n 25 --seed 1 -o train.csv");
    desk.done("gp2 generate models/surface.toml --n 25 --seed 2 --noise-std 0 -o test.csv");
  }

  Desk desk;
};

TEST_F(BaselineCommand, FitsPredictsAndEvaluatesLikeAnyOther) {
  for (const std::string kind : {"se", "icm", "lmc"}) {
    const Outcome fit = desk.done("gp2 fit models/surface.toml --data train.csv --baseline " + kind +
                                  " --restarts 2 --max-iterations 15 --json -o " + kind + ".json");
    EXPECT_LT(fit.json()["nll"], 200) << kind;
    EXPECT_EQ(desk.json(kind + ".json")["prior"]["baseline"]["kind"], kind);
    desk.done("gp2 predict " + kind + ".json --states test.csv --cov std -o prediction.csv");
    const CsvTable prediction = desk.table("prediction.csv");
    EXPECT_GE(prediction.find("ddq1"), 0);
    EXPECT_GE(prediction.find("ddq3_std"), 0);
    const auto figures = desk.done("gp2 evaluate " + kind + ".json --data test.csv --json").json();
    EXPECT_LT(figures["rmse_normalised"], 0.6) << kind;
    EXPECT_GT(figures["max_constraint_error"], 1e-4) << "a baseline knows no constraint, but is held against it";
  }
}

TEST_F(BaselineCommand, RefusesWhatOnlyMechanicsHas) {
  const auto refusal = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 fit models/surface.toml --data train.csv --baseline se " + options + " -o fit.json");
    EXPECT_EQ(outcome.status, 2) << outcome.err;
    return outcome.err;
  };
  EXPECT_THAT(refusal("--mean force"),
              HasSubstr("--baseline se has the mean of the training data as prior mean: leave out --mean"));
  EXPECT_THAT(refusal("--prior force"), HasSubstr("--baseline se has its prior on ddq: leave out --prior"));
  EXPECT_THAT(refusal("--estimate p1"), HasSubstr("--baseline se knows no parameters of the system: leave out --estimate"));
  EXPECT_THAT(refusal("--observe ddq1"), HasSubstr("--baseline se learns every acceleration: leave out --observe"));
  EXPECT_THAT(refusal("--noise-std estimate"), HasSubstr("--baseline se has fixed noise: leave out --noise-std estimate"));
  EXPECT_THAT(refusal("--also unconstrained:train.csv"), HasSubstr("--baseline se knows ddq only: leave out --also"));
  EXPECT_THAT(refusal("--data train.csv@models/surface.toml"), HasSubstr("--baseline se knows no system: leave out @OTHER.toml"));
  const Outcome unknown = desk.run("gp2 fit models/surface.toml --data train.csv --baseline gp -o fit.json");
  EXPECT_EQ(unknown.status, 2);
  EXPECT_THAT(unknown.err, AllOf(HasSubstr("--baseline"), HasSubstr("gp"), HasSubstr("lmc")));
  desk.done("gp2 fit models/surface.toml --data train.csv --baseline se --restarts 1 --max-iterations 2 -o fit.json");
  const Outcome force = desk.run("gp2 predict fit.json --states test.csv --view force -o force.csv");
  EXPECT_EQ(force.status, 2);
  EXPECT_THAT(force.err, HasSubstr("--view force: a baseline learns accelerations, not forces: ask for --view constrained"));
  EXPECT_FALSE(desk.has("force.csv"));
}

TEST_F(BaselineCommand, IsAdvisedOfNothingThatItRefusesOrDoesNotKnow) {
  const auto notes_under = [&](const std::string& noise) {
    return desk.done("gp2 fit models/surface.toml --data train.csv --baseline se --restarts 1 -o fit.json --noise-std " + noise)
        .err;
  };
  EXPECT_THAT(notes_under("4"), AllOf(HasSubstr("as smoothed ones do"), Not(HasSubstr("--noise-std estimate"))));
  EXPECT_THAT(notes_under("0.01"), AllOf(HasSubstr("not among the features"), Not(HasSubstr("a mass"))));
}

TEST_F(BaselineCommand, ASystemOfOtherFeaturesIsRefused) {
  desk.done("gp2 fit models/surface.toml --data train.csv --baseline icm --restarts 1 --max-iterations 2 -o fit.json");
  desk.write("more.toml", replaced(desk.read("models/surface.toml"), R"("u3"]
directions)",
                                   R"("u3", "dq1*dq2"]
directions)"));
  const Outcome outcome = desk.run("gp2 evaluate fit.json --data test.csv --system more.toml");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("the features of its latent 1, 'se', are"));
}

TEST_F(BaselineCommand, IsTheSameUnderBothProtocols) {
  for (const std::string protocol : {"default", "paper"}) {
    desk.done("gp2 fit models/surface.toml --data train.csv --baseline icm --restarts 2 --max-iterations 5 --protocol " +
              protocol + " -o " + protocol + ".json");
  }
  EXPECT_EQ(desk.json("default.json")["hyperparameters"], desk.json("paper.json")["hyperparameters"]);
}

}  // namespace
}  // namespace gp2::test
