#include "apps/command_line.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/base/version.hpp"

namespace gp2::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

std::vector<std::string> keys(const nlohmann::json& object) {
  std::vector<std::string> names;
  for (const auto& [name, value] : object.items()) names.push_back(name);
  return names;
}

class Help : public testing::TestWithParam<std::string> {};

TEST_P(Help, ExplainsTheCommandWithAnExample) {
  const Outcome outcome = Desk().run("gp2 " + GetParam() + " --help");
  EXPECT_EQ(outcome.status, 0);
  EXPECT_EQ(outcome.err, "");
  EXPECT_THAT(outcome.out, HasSubstr("Example:\n  gp2 " + (GetParam().empty() ? "generate" : GetParam())));
}

INSTANTIATE_TEST_SUITE_P(OfEveryCommand, Help, testing::Values("", "show", "check", "generate", "fit", "predict", "evaluate"),
                         [](const auto& one) { return one.param.empty() ? "gp2" : one.param; });

TEST(CommandLine, VersionIsTheLibrarys) {
  const Outcome outcome = Desk().run("gp2 --version");
  EXPECT_EQ(outcome.status, 0);
  EXPECT_EQ(outcome.out, std::string(version()) + "\n");
}

TEST(CommandLine, WhatIsNotKnownExitsWith2AndPointsAtTheHelp) {
  const Desk desk;
  for (const char* line :
       {"gp2", "gp2 fti", "gp2 show models/surface.toml --latx", "gp2 show", "gp2 generate models/surface.toml -o a.csv",
        "gp2 fit models/surface.toml --data a.csv --mean gravity -o fit.json",
        "gp2 generate models/surface.toml --n ten -o a.csv", "gp2 fit models/surface.toml --data a.csv --seed -1 -o fit.json",
        "gp2 show models/surface.toml models/duffing.toml"}) {
    SCOPED_TRACE(line);
    const Outcome outcome = desk.run(line);
    EXPECT_EQ(outcome.status, 2) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_THAT(outcome.err, HasSubstr("--help"));
  }
}

TEST(CommandLine, ShowPrintsTheDerivedConstraint) {
  const Desk desk;
  const Outcome text = desk.done("gp2 show models/unicycle.toml");
  EXPECT_EQ(text.err, "");
  for (const char* part :
       {"mass matrix M", "known force F", "constraints A ddq = b", "sin(q3)", "parameters", "Ic", "latent", "features"}) {
    EXPECT_THAT(text.out, HasSubstr(part));
  }
  EXPECT_THAT(desk.done("gp2 show models/unicycle.toml --latex").out, HasSubstr("\\begin{bmatrix}"));
}

TEST(CommandLine, JsonStandsAloneOnStdoutWithTheContractedKeys) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 20 -o train.csv");
  const Outcome fit =
      desk.done("gp2 fit models/surface.toml --data train.csv --max-iterations 3 --restarts 1 --json -o fit.json");
  const auto report = fit.json();
  EXPECT_THAT(keys(report), ElementsAre("hyperparameters", "iterations", "left_out", "nll", "options", "seconds", "termination"));
  for (const char* how : {"one_by_one", "stretches"}) {
    EXPECT_THAT(keys(report["left_out"][how]), ElementsAre("coverage50", "coverage80", "coverage95", "nrmse"));
  }
  ASSERT_EQ(report["hyperparameters"].size(), 12u);
  for (const auto& one : report["hyperparameters"]) {
    EXPECT_THAT(keys(one), ElementsAre("at_bound", "lower", "name", "unit", "upper", "value"));
  }
  const Outcome evaluation = desk.done("gp2 evaluate fit.json --data train.csv --json");
  EXPECT_THAT(keys(evaluation.json()),
              ElementsAre("coverage50", "coverage50_latent", "coverage80", "coverage80_latent", "coverage95", "coverage95_latent",
                          "far", "max_constraint_error", "max_constraint_error_fitted", "n", "n_missing", "n_zero_variance",
                          "near", "nlpd", "nlpd_latent", "nrmse", "pit", "rmse", "rmse_normalised"));
  EXPECT_THAT(keys(evaluation.json()["near"]), ElementsAre("coverage50", "coverage50_latent", "coverage80", "coverage80_latent",
                                                           "coverage95", "coverage95_latent", "n", "nrmse", "pit"));
  EXPECT_THAT(keys(evaluation.json()["rmse"]), ElementsAre("ddq1", "ddq2", "ddq3"));
}

TEST(CommandLine, TalkGoesToStderrAndResultsToStdout) {
  const Desk desk;
  const Outcome generated = desk.done("gp2 generate models/duffing.toml --n 20 -o train.csv");
  EXPECT_EQ(generated.out, "");
  EXPECT_THAT(generated.err, HasSubstr("train.csv: 20 rows"));
  desk.write("log.csv", replaced(desk.read("train.csv"), ",dq1,", ",qd1,"));
  const Outcome fit = desk.done("gp2 fit models/duffing.toml --data log.csv --max-iterations 3 -o fit.json");
  EXPECT_THAT(fit.err, HasSubstr("column 'qd1' taken as dq1"));
  EXPECT_THAT(fit.err, HasSubstr("fit.json: fit of"));
  EXPECT_THAT(fit.out, HasSubstr("negative log likelihood"));
  EXPECT_THAT(fit.out, Not(HasSubstr("qd1")));
  const Outcome predicted = desk.done("gp2 predict fit.json --states train.csv -o prediction.csv");
  EXPECT_EQ(predicted.out, "");
  EXPECT_THAT(predicted.err, HasSubstr("prediction.csv: 20 predictions"));
  EXPECT_THAT(desk.done("gp2 evaluate fit.json --data train.csv").out, HasSubstr("max |A ddq - b|"));
}

TEST(CommandLine, ProgressIsShownOnATerminalOnly) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 -o train.csv");
  const std::string line = "gp2 fit models/surface.toml --data train.csv --restarts 3 --threads 1 -o fit.json";
  const Outcome piped = desk.done(line);
  EXPECT_THAT(piped.err, Not(HasSubstr("restart ")));
  EXPECT_THAT(piped.err + piped.out, Not(HasSubstr("\r")));
  if (desk.run("command -v script").status != 0) GTEST_SKIP() << "no command 'script' to make a terminal with";
  const Outcome terminal = desk.done("script -qec '" + line + "' /dev/null");
  EXPECT_THAT(terminal.out, testing::ContainsRegex("restart [1-3]/3 +iteration [0-9]+ +best -?[0-9.]+ +about [0-9]+ s left"));
}

}  // namespace
}  // namespace gp2::test
