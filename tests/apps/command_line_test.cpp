#include "apps/command_line.hpp"

#include <algorithm>

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
  const bool may_say_more = !GetParam().empty() && GetParam() != "help";
  EXPECT_EQ(outcome.out.find("-q, --quiet") != std::string::npos, may_say_more);
}

INSTANTIATE_TEST_SUITE_P(OfEveryCommand, Help,
                         testing::Values("", "show", "check", "generate", "fit", "predict", "evaluate", "help"),
                         [](const auto& one) { return one.param.empty() ? "gp2" : one.param; });

TEST(Units, StandBehindTheValuesThatACommandPrints) {
  Desk desk;
  desk.write("cart.toml",
             "name = 'cart'\ncoordinates = ['x']\ninputs = ['f']\n[parameters]\nm = { value = 1, bounds = [0.5, 4], estimate = "
             "true }\n[mechanics]\nmass = [['m']]\nforce = ['f']\n[[latent]]\nname = 'drag'\nkernel = 'se'\nfeatures = ['dx']\n"
             "directions = 'force'\n[truth]\nforce = ['-dx^3']\n[noise]\nddq = 0.05\n[sampling]\ndx = [-1, 1]\nf = [-1, 1]\n"
             "[units]\nx = 'm'\nf = 'N'\nm = 'kg'\n");
  desk.done("gp2 generate cart.toml --n 30 -o train.csv");
  const Outcome fit = desk.done("gp2 fit cart.toml --data train.csv --mean force --restarts 1 -o fit.json");
  EXPECT_THAT(fit.out, testing::ContainsRegex("m  +[0-9.]+ ± [0-9.]+ kg   \\[0.5, 4\\]"));
  EXPECT_THAT(fit.out, testing::ContainsRegex("lengthscale\\(dx\\) +[0-9.]+ m/s  "));
  const std::string shown = desk.done("gp2 show cart.toml").out;
  EXPECT_THAT(shown, testing::AllOf(HasSubstr("\n  m            1 kg   in [0.5, 4]"),
                                    HasSubstr("\nunits\n  x            m\n  dx           m/s\n")));
  EXPECT_EQ(desk.done("gp2 show cart.toml --json").json()["units"]["ddx"], "m/s²");
  desk.done("gp2 plot fit.json -o drag.svg");
  EXPECT_THAT(desk.read("drag.svg"), testing::AllOf(HasSubstr(">dx [m/s]<"), HasSubstr(">force_x [N]<")));
  desk.done("gp2 export fit.json --to c --name cart -o .");
  EXPECT_THAT(desk.read("cart.h"), testing::AllOf(HasSubstr("] x [m]\n"), HasSubstr("] dx [m/s]\n"), HasSubstr("] ddx [m/s²]\n"),
                                                  HasSubstr("] f [N]")));
  desk.done("gp2 report fit.json -o report.html");
  EXPECT_THAT(desk.read("report.html"), HasSubstr("\"m\":\"kg\""));
}

TEST(CommandLine, VersionIsTheLibrarys) {
  for (const char* line : {"gp2 --version", "gp2 -V"}) {
    const Outcome outcome = Desk().run(line);
    EXPECT_EQ(outcome.status, 0);
    EXPECT_EQ(outcome.out, std::string(version()) + "\n");
  }
}

TEST(CommandLine, HelpOfACommandIsTheSameEitherWay) {
  const Desk desk;
  EXPECT_EQ(desk.done("gp2 help fit").out, desk.done("gp2 fit --help").out);
  EXPECT_EQ(desk.done("gp2 help").out, desk.done("gp2 --help").out);
}

TEST(CommandLine, HelpIsGroupedAndNoLineIsWiderThanTheTerminal) {
  const Desk desk;
  const std::string line = "gp2 fit --help";
  const auto widest = [](const std::string& text) {
    std::size_t most = 0, now = 0;
    for (const char c : text.substr(0, text.find("Example:"))) {  // which is to be copied as it is
      if ((c & 0xC0) != 0x80 && c != '\r') now = c == '\n' ? 0 : now + 1;
      most = std::max(most, now);
    }
    return most;
  };
  const std::string piped = desk.done(line).out;
  EXPECT_LE(widest(piped), 80u);
  for (const char* part : {"\nArguments:\n  MODEL", "\nData:\n  --data", "\nHow it is learned:\n", "\nRaw logs:\n",
                           "--restarts R", "-o, --output FIT.json", "(required)", "--mean zero|force", "(default: zero)"}) {
    EXPECT_THAT(piped, HasSubstr(part));
  }
  if (desk.run("command -v script").status != 0) GTEST_SKIP() << "no command 'script' to make a terminal with";
  EXPECT_LE(widest(desk.done("script -qec 'stty cols 60; " + line + "' /dev/null").out), 60u);
  EXPECT_GT(widest(desk.done("script -qec 'stty cols 200; " + line + "' /dev/null").out), 80u);
}

TEST(CommandLine, WhatIsMisspeltIsSuggested) {
  const Desk desk;
  for (const auto& [line, said] : std::vector<std::pair<const char*, const char*>>{
           {"gp2 fitt", "error: there is no command 'fitt', did you mean 'fit'?"},
           {"gp2 learn", "error: there is no command 'learn'; there are: show, "},
           {"gp2 help fitt", "help, did you mean 'fit'?"},
           {"gp2 show models/surface.toml --latx", "error: gp2 show has no option --latx, did you mean '--latex'?"},
           {"gp2 fit models/surface.toml --data a.csv --restart=3 --ouput b.json",
            "error: gp2 fit has no option --restart, did you mean '--restarts'?"},
           {"gp2 show models/surface.toml --colour", "error: gp2 show has no option --colour\n"},
           {"gp2 fit models/surface.toml --data a.csv --mean forec -o b.json",
            "'forec' is none of zero, force, did you mean 'force'?"}}) {
    const Outcome outcome = desk.run(line);
    EXPECT_EQ(outcome.status, 2);
    EXPECT_THAT(outcome.err, HasSubstr(said));
  }
}

TEST(CommandLine, CompletionOfBashOffersCommandsOptionsAndWords) {
  const Desk desk;
  const auto offered = [&](const std::string& words, const std::string& current, const std::string& before) {
    return desk
        .done("bash -ec 'source <(gp2 completion bash); compopt() { :; }; COMP_WORDS=(" + words +
              "); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); "
              "_gp2 gp2 \"" +
              current + "\" \"" + before + "\"; echo ${COMPREPLY[@]}'")
        .out;
  };
  EXPECT_EQ(offered("gp2 ex", "ex", "gp2"), "excite export\n");
  EXPECT_EQ(offered("gp2 --v", "--v", "gp2"), "--version --verbose\n");
  EXPECT_EQ(offered("gp2 fit m.toml --rest", "--rest", "m.toml"), "--restarts\n");
  EXPECT_EQ(offered("gp2 fit --mean \"\"", "", "--mean"), "zero force\n");
  EXPECT_EQ(offered("gp2 fit --data \"\"", "", "--data"), "\n");  // files, by bash itself
  EXPECT_EQ(offered("gp2 help ev", "ev", "help"), "evaluate\n");
}

TEST(CommandLine, CompletionsAndManPagesAreFreeOfErrors) {
  const Desk desk;
  desk.done("gp2 completion all -o share");
  EXPECT_EQ(desk.read("share/bash-completion/completions/gp2"), desk.done("gp2 completion bash").out);
  EXPECT_THAT(desk.read("share/man/man1/gp2-fit.1"), HasSubstr(".B \\-\\-restarts R\n"));
  EXPECT_THAT(desk.read("share/man/man1/gp2.1"), HasSubstr(".BR gp2\\-fit (1)"));
  for (const auto& [tool, line] : std::vector<std::pair<std::string, std::string>>{
           {"bash", "bash -n share/bash-completion/completions/gp2"},
           {"zsh", "zsh -n share/zsh/site-functions/_gp2"},
           {"fish", "fish --no-execute share/fish/vendor_completions.d/gp2.fish"},
           {"man", "for page in share/man/man1/*; do man --warnings -E UTF-8 -l -Tutf8 $page >/dev/null; done"}}) {
    if (desk.run("command -v " + tool).status != 0) continue;
    EXPECT_EQ(desk.done(line).err, "") << line;
  }
  EXPECT_TRUE(desk.run("gp2 completion fish -o share").said("-o goes with 'all'"));
  EXPECT_TRUE(desk.run("gp2 completion all").said("'all' needs -o DIR"));
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

TEST(CommandLine, ShowTakesAnEmptyFileForAModel) {
  const Desk desk;
  desk.write("empty.toml", "");
  const Outcome outcome = desk.run("gp2 show empty.toml");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("empty.toml:1: coordinates: missing"));
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
  ASSERT_EQ(report["hyperparameters"].size(), 13u);
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
  const Outcome of_training = desk.done("gp2 evaluate fit.json --data log.csv");
  EXPECT_THAT(of_training.out, HasSubstr("max |A ddq - b|"));
  EXPECT_THAT(of_training.err, HasSubstr("log.csv: the fit has learned from this log"));
}

TEST(CommandLine, QuietKeepsWarningsAndDropsNotesAndProgress) {
  const Desk desk;
  EXPECT_EQ(desk.done("gp2 generate models/surface.toml --n 20 -q -o train.csv").err, "");
  const std::string line = "gp2 fit models/surface.toml --data train.csv --restarts 1 --max-iterations 3 -o fit.json";
  const Outcome loud = desk.done(line), quiet = desk.done(line + " -q");
  EXPECT_TRUE(loud.said("fit.json: fit of"));
  EXPECT_EQ(quiet.err, "");
  EXPECT_THAT(quiet.out, HasSubstr("negative log likelihood"));
  EXPECT_TRUE(desk.run("gp2 fit models/surface.toml --data none.csv --quiet -o fit.json").said("error: none.csv"));
  desk.done("gp2 fit --again fit.json -q -o again.json");
  EXPECT_EQ(desk.done("gp2 predict fit.json --states train.csv -q -o prediction.csv").err, "");
  EXPECT_EQ(desk.done("gp2 simulate fit.json --start q1=0.1 --t-end 0.1 --quiet -o motion.csv").err, "");
}

TEST(CommandLine, CheckTellsItsFindingsAsJson) {
  const Desk desk;
  const nlohmann::json good = desk.done("gp2 check models/unicycle.toml --json").json();
  EXPECT_EQ(good["errors"], 0);
  EXPECT_FALSE(good["findings"].empty());
  EXPECT_THAT(keys(good["findings"][0]), ElementsAre("level", "text"));
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
