#include <algorithm>
#include <cmath>
#include <set>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "base/random.hpp"
#include "gp2/files/fit_file.hpp"

namespace gp2::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

class FitCommand : public testing::Test {
 protected:
  void SetUp() override { desk.done("gp2 generate models/surface.toml --n 30 --seed 1 -o train.csv"); }

  /// A short fit of the surface with more options; its report.
  nlohmann::json fit(const std::string& options, const std::string& output = "fit.json") const {
    return desk.done("gp2 fit models/surface.toml --data train.csv --json " + options + " -o " + output).json();
  }
  nlohmann::json short_fit(const std::string& options, const std::string& output = "fit.json") const {
    return fit("--restarts 1 --max-iterations 6 " + options, output);
  }
  /// A FIT.json but for what was asked.
  nlohmann::json what_was_fitted(const std::string& file) const {
    nlohmann::json json = desk.json(file);
    for (const char* of_files : {"options", "logs", "checksum"}) json.erase(of_files);
    return json;
  }
  /// The message with which options are refused.
  std::string refusal(const std::string& options) const {
    const Outcome outcome = desk.run("gp2 fit models/surface.toml --data train.csv " + options + " -o fit.json");
    EXPECT_EQ(outcome.status, 2) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_FALSE(desk.has("fit.json"));
    return outcome.err;
  }
  static std::set<std::string> names(const nlohmann::json& report) {
    std::set<std::string> all;
    for (const auto& one : report["hyperparameters"]) all.insert(one["name"]);
    return all;
  }
  static double value(const nlohmann::json& report, const std::string& name) {
    for (const auto& one : report["hyperparameters"]) {
      if (one["name"] == name) return one["value"];
    }
    throw std::runtime_error("no hyperparameter " + name);
  }

  Desk desk;
};

TEST_F(FitCommand, WithoutIterationsItConditionsAtTheStartingValues) {
  const nlohmann::json report = fit("--max-iterations 0");
  EXPECT_EQ(report["iterations"], 0);
  EXPECT_THAT(report["termination"], HasSubstr("no iterations asked for"));
  const nlohmann::json longer = short_fit("", "longer.json");
  EXPECT_LT(longer["nll"], report["nll"]);
  const double nll = report["nll"];
  EXPECT_NEAR(FitFile::read(desk / "fit.json").posterior().negative_log_likelihood(), nll, 1e-12 * std::abs(nll));
}

TEST_F(FitCommand, IterationsStopAtTheirLimitAndItIsSaid) {
  const nlohmann::json report = fit("--restarts 1 --max-iterations 2");
  EXPECT_THAT(report["termination"], HasSubstr("limit of iterations"));
}

TEST_F(FitCommand, IsNotLostWhenItCannotBeWritten) {
  const Outcome full = desk.run("gp2 fit models/surface.toml --data train.csv --max-iterations 0 -o /dev/full");
  EXPECT_EQ(full.status, 2);
  EXPECT_TRUE(full.said("/dev/full: cannot be written: No space left on device"));
  EXPECT_THAT(full.out, HasSubstr("lengthscale(q1)"));
}

TEST_F(FitCommand, IsRefusedUnderALimitOfMemoryInsteadOfWaitingForEver) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "a sanitizer maps more than any limit";
#endif
  // what OpenBLAS maps grows with its threads
  const std::string limited = "ulimit -v 300000; export OPENBLAS_NUM_THREADS=2; ";
  if (desk.run(limited + "gp2 --version").status != 0) GTEST_SKIP() << "the command does not load within this limit here";
  const Outcome outcome = desk.run(limited + "timeout -s KILL 60 gp2 fit models/surface.toml --data train.csv -o fit.json");
  EXPECT_EQ(outcome.status, 2) << outcome.err;
  // what the limit leaves differs from processor to processor
  EXPECT_TRUE(outcome.said("which the system does not give however few rows there are: raise the limit (ulimit -v)") ||
              outcome.said("OpenBLAS needs a buffer of 134 MB, which the system does not give: raise the limit on memory"))
      << outcome.err;
}

TEST_F(FitCommand, LeavesAFileThatNoCommandReadsForEverUnderALimitOfMemory) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "a sanitizer maps more than any limit";
#endif
  const std::string limited = "ulimit -v 300000; export OPENBLAS_NUM_THREADS=2; ";
  if (desk.run(limited + "gp2 --version").status != 0) GTEST_SKIP() << "the command does not load within this limit here";
  desk.done("gp2 fit models/surface.toml --data train.csv --max-iterations 0 -o limited.json");
  for (const char* command :
       {"predict limited.json --states train.csv --cov std -o out.csv", "evaluate limited.json --data train.csv",
        "simulate limited.json --start q1=0.4,q2=0.8 --t-end 1 -o out.csv", "report limited.json -o out.html",
        "check models/surface.toml --data train.csv"}) {
    const Outcome outcome = desk.run(limited + "timeout -s KILL 60 gp2 " + command);
    const bool refused = outcome.status == 2 && outcome.said("OpenBLAS needs a buffer of 134 MB, which the system does not give");
    EXPECT_TRUE(refused || outcome.status == 0) << command << ": " << outcome.status << ", " << outcome.err;
  }
}

TEST_F(FitCommand, TellsWhatItWasAskedAndTheFileDoesToo) {
  const nlohmann::json report = short_fit("--mean force --observe ddq1,ddq3 --noise-std 0.2 --seed 7 --estimate none");
  const nlohmann::json expected = {{"discrepancy", "default"},
                                   {"estimate", nlohmann::json::array()},
                                   {"gradient_tolerance", 1e-5},
                                   {"hyperparameters", "auto"},
                                   {"hyperprior", "default"},
                                   {"max_escapes", 5},
                                   {"max_iterations", 6},
                                   {"mean", "force"},
                                   {"noise_std", 0.2},
                                   {"observe", {"ddq1", "ddq3"}},
                                   {"protocol", "default"},
                                   {"reduction_tolerance", 1e-12},
                                   {"restarts", 1},
                                   {"seed", 7},
                                   {"standard_errors", true},
                                   {"thin", "auto"}};
  EXPECT_EQ(report["options"], expected);
  EXPECT_EQ(desk.json("fit.json")["options"], expected);
  // where it was told to start, too: the values can be given again as they are
  const nlohmann::json again = fit("--start fit.json --max-iterations 0", "again.json");
  desk.write("start.json", again["options"]["start"].dump());
  EXPECT_EQ(fit("--start start.json --max-iterations 0")["hyperparameters"], again["hyperparameters"]);
}

TEST_F(FitCommand, TellsOfTheHyperparametersThatItDrew) {
  const nlohmann::json report =
      fit("--restarts 1 --max-escapes 0 --max-points 12 --estimate none --noise-std estimate --hyperparameters integrate");
  const nlohmann::json& draws = report.at("draws");
  EXPECT_EQ(draws.at("n_draws"), 25);
  EXPECT_EQ(draws.at("n_chains"), 8);
  ASSERT_EQ(draws.at("hyperparameters").size(), report.at("hyperparameters").size());
  for (const nlohmann::json& one : draws.at("hyperparameters")) {
    EXPECT_LE(one.at("lower95"), one.at("mean"));
    EXPECT_GE(one.at("upper95"), one.at("mean"));
    EXPECT_GE(one.at("r_hat"), 1);
    EXPECT_GT(one.at("effective_size"), 0);
  }
  EXPECT_TRUE(desk.json("fit.json").at("report").contains("draws"));
  const nlohmann::json& noise = draws.at("hyperparameters").back();
  EXPECT_EQ(noise.at("name"), "noise_stddev(ddq3)");
  EXPECT_THAT(desk.done("gp2 show fit.json").out, HasSubstr(fmt::format("(mean {:.6g}, ", noise.at("mean").get<double>())));
  EXPECT_EQ(desk.done("gp2 show fit.json --json").json()["fit"]["stddev"]["noise_stddev(ddq3)"], noise.at("stddev"));
  EXPECT_FALSE(short_fit("").contains("draws"));
}

TEST_F(FitCommand, StartTakesValuesByName) {
  desk.write("values.json", R"json({"lengthscale(q2)": 2.5, "signal_stddev(ddq3)": 4})json");
  const nlohmann::json standard = fit("--max-iterations 0"), report = fit("--max-iterations 0 --start values.json");
  EXPECT_EQ(value(report, "lengthscale(q2)"), 2.5);
  EXPECT_EQ(value(report, "signal_stddev(ddq3)"), 4);
  EXPECT_EQ(value(report, "lengthscale(q1)"), value(standard, "lengthscale(q1)"));
}

TEST_F(FitCommand, StartContinuesFromAFit) {
  const nlohmann::json first = short_fit("", "first.json");
  const nlohmann::json again = fit("--max-iterations 0 --start first.json");
  EXPECT_EQ(again["nll"], first["nll"]);
  EXPECT_EQ(again["hyperparameters"], first["hyperparameters"]);
}

TEST_F(FitCommand, StartMayLieOutsideTheBoundsWhereNothingIsOptimised) {
  desk.write("far.json", R"json({"lengthscale(q2)": 500})json");
  const std::string line = "gp2 fit models/surface.toml --data train.csv --protocol paper --start far.json --json -o fit.json";
  EXPECT_EQ(desk.run(line).status, 2);
  const Outcome taken = desk.done(line + " --max-iterations 0");
  EXPECT_THAT(taken.err, HasSubstr("lengthscale(q2) = 500 is outside its bounds"));
  EXPECT_EQ(value(taken.json(), "lengthscale(q2)"), 500);
  EXPECT_EQ(FitFile::read(desk / "fit.json").report.hyperparameters.at(1).value, 500);
  desk.write("negative.json", R"json({"lengthscale(q2)": -1})json");
  EXPECT_EQ(desk.run("gp2 fit models/surface.toml --data train.csv --start negative.json --max-iterations 0 -o no.json").status,
            2);
}

TEST_F(FitCommand, StartRefusesWhatItDoesNotKnowOrMayNotTake) {
  desk.write("unknown.json", R"json({"lengthscale(q9)": 1})json");
  EXPECT_THAT(refusal("--start unknown.json"),
              testing::AllOf(HasSubstr("unknown.json"), HasSubstr("'lengthscale(q9)'"), HasSubstr("lengthscale(q1)")));
  desk.write("outside.json", R"json({"lengthscale(q1)": -1})json");
  EXPECT_THAT(refusal("--start outside.json"), testing::AllOf(HasSubstr("outside.json"), HasSubstr("-1 is outside its bounds")));
  desk.write("text.json", R"json({"lengthscale(q1)": "long"})json");
  EXPECT_THAT(refusal("--start text.json"), HasSubstr("not a number"));
  EXPECT_THAT(refusal("--start absent.json"), HasSubstr("absent.json: cannot be read"));
}

TEST_F(FitCommand, MaxPointsTakesTheFirstRowsOfAShuffleBySeedInTheOrderOfTheLog) {
  std::vector<int> order = RandomStream(7).permutation(30);
  std::sort(order.begin(), order.begin() + 8);
  const Outcome outcome =
      desk.done("gp2 fit models/surface.toml --data train.csv --max-points 8 --seed 7 --max-iterations 0 -o fit.json");
  EXPECT_THAT(outcome.err, HasSubstr("8 of 30 rows taken, by seed 7"));
  const Observations group = FitFile::read(desk / "fit.json").observations.at(0);
  ASSERT_EQ(group.n_data(), 8);
  const CsvTable table = desk.table("train.csv");
  for (int i = 0; i < 8; ++i) EXPECT_EQ(group.states()(0, i), table.number(order[static_cast<std::size_t>(i)], table.find("q1")));

  fit("--max-points 8 --seed 7 --max-iterations 0", "same.json");
  EXPECT_EQ(desk.read("same.json"), desk.read("fit.json"));
  fit("--max-points 8 --seed 8 --max-iterations 0", "other.json");
  EXPECT_NE(desk.json("other.json")["observations"], desk.json("fit.json")["observations"]);
}

TEST_F(FitCommand, MaxPointsBeyondTheLogTakesItAllInOrder) {
  fit("--max-iterations 0", "all.json");
  fit("--max-points 31 --max-iterations 0");
  EXPECT_EQ(what_was_fitted("fit.json"), what_was_fitted("all.json"));
}

TEST_F(FitCommand, EstimateChoosesTheParameters) {
  const std::set<std::string> nothing = names(fit("--max-iterations 0"));
  EXPECT_EQ(nothing.count("p1"), 0u);
  const std::set<std::string> two = names(fit("--max-iterations 0 --estimate p1,p5"));
  EXPECT_EQ(two.size(), nothing.size() + 2);
  EXPECT_TRUE(two.contains("p1") && two.contains("p5"));
  // a model that wants it, and a person who does not
  desk.write("eager.toml",
             replaced(desk.read("models/surface.toml"), "bounds = [0.04, 0.16]", "bounds = [0.04, 0.16], estimate = true"));
  const std::string line = "gp2 fit eager.toml --data train.csv --max-iterations 0 --json -o fit.json";
  EXPECT_TRUE(names(desk.done(line).json()).contains("p1"));
  EXPECT_EQ(names(desk.done(line + " --estimate none").json()), nothing);
}

TEST_F(FitCommand, SaysWhichEstimatesOfTheFitItStartsFromItDoesNotTake) {
  fit("--restarts 1 --max-iterations 3 --estimate p1,p5", "before.json");
  const Outcome again = desk.done(
      "gp2 fit models/surface.toml --data train.csv --max-iterations 3 --restarts 1 "
      "--start before.json --estimate p1 -o fit.json");
  EXPECT_THAT(again.err, testing::AllOf(testing::HasSubstr("before.json: p5 = "),
                                        testing::HasSubstr(" is not taken: this fit does not estimate it and has ")));
  EXPECT_FALSE(again.said("p1 = "));
}

TEST_F(FitCommand, ParametersHaveStandardErrorsUnlessNotWanted) {
  const nlohmann::json report = fit("--restarts 1 --estimate p1,p2");
  ASSERT_EQ(report["standard_errors"]["parameters"].size(), 2U);
  const nlohmann::json& p1 = report["standard_errors"]["parameters"][0];
  EXPECT_EQ(p1["name"], "p1");
  EXPECT_GT(p1["stddev"].get<double>(), 0);
  EXPECT_LT(p1["stddev"].get<double>(), 0.01);
  EXPECT_EQ(p1["correlation"]["p1"], 1);
  EXPECT_LT(report["standard_errors"]["distance_from_optimum"].get<double>(), 0.1);
  EXPECT_FALSE(short_fit("--estimate p1 --no-standard-errors").contains("standard_errors"));
  EXPECT_FALSE(short_fit("--estimate none").contains("standard_errors"));
  const std::string text = desk.done("gp2 fit models/surface.toml --data train.csv --restarts 1 --estimate p1 -o fit.json").out;
  EXPECT_THAT(text, testing::ContainsRegex("p1 +0\\.[0-9]+ ± 0\\.[0-9]+ "));
}

// Geist & Trimpe 2020, example 2: with prior mean zero R and Ic enter by R/Ic alone
TEST_F(FitCommand, TellsWhichParametersAreKnownByTheirRatioOnly) {
  desk.done("gp2 generate models/unicycle.toml --n 80 --seed 3 -o unicycle.csv");
  const Outcome outcome =
      desk.done("gp2 fit models/unicycle.toml --data unicycle.csv --restarts 1 --estimate R,Ic -o unicycle.json");
  EXPECT_THAT(outcome.err,
              HasSubstr("warning: the data determine R, Ic only together: changing R by +1 %, Ic by +1 % at once fits "
                        "as well. Hold one of them at a known value, or give it a prior"));
  EXPECT_THAT(outcome.out, testing::ContainsRegex("R +0\\.[0-9]+ ± ∞ "));
  const Outcome one = desk.done("gp2 fit models/unicycle.toml --data unicycle.csv --restarts 1 --estimate R -o unicycle.json");
  EXPECT_THAT(one.err, Not(HasSubstr("warning")));
  const Outcome force =
      desk.done("gp2 fit models/unicycle.toml --data unicycle.csv --mean force --restarts 1 --estimate R,Ic -o unicycle.json");
  EXPECT_THAT(force.err, Not(HasSubstr("only together")));
}

TEST_F(FitCommand, NoiseIsTheModelsTheGivenOrEstimated) {
  const auto noise = [&] { return desk.json("fit.json")["observations"][0]["noise_stddev"]; };
  fit("--max-iterations 0");
  EXPECT_THAT(noise(), ElementsAre(0.1, 0.1, 0.1));
  fit("--max-iterations 0 --noise-std 0.25");
  EXPECT_THAT(noise(), ElementsAre(0.25, 0.25, 0.25));
  const nlohmann::json estimated = short_fit("--noise-std estimate");
  for (const char* name : {"noise_stddev(ddq1)", "noise_stddev(ddq2)", "noise_stddev(ddq3)"}) {
    EXPECT_GT(value(estimated, name), 0.01);
    EXPECT_LT(value(estimated, name), 1);
  }
}

TEST_F(FitCommand, PaperProtocolSharesOneSignalAndHoldsToThePapersBox) {
  const nlohmann::json report = fit("--max-iterations 0 --protocol paper --estimate p1");
  const std::set<std::string> all = names(report);
  EXPECT_TRUE(all.contains("signal_stddev"));
  EXPECT_FALSE(all.contains("signal_stddev(ddq1)"));
  for (const auto& one : report["hyperparameters"]) {
    if (one["name"] == "signal_stddev") {
      EXPECT_EQ(one["lower"], 0.5);
      EXPECT_EQ(one["upper"], 10);
    } else if (one["name"] == "p1") {
      EXPECT_DOUBLE_EQ(one["lower"], 0.06);
      EXPECT_DOUBLE_EQ(one["upper"], 0.10);
    } else {
      EXPECT_DOUBLE_EQ(one["upper"].get<double>() / one["lower"].get<double>(), 40);
    }
  }
  EXPECT_THAT(what_was_fitted("fit.json").dump(), Not(HasSubstr("hyperprior")));
}

TEST_F(FitCommand, PaperProtocolRefusesWhatThePaperDidNotDo) {
  EXPECT_THAT(refusal("--protocol paper --noise-std estimate"), HasSubstr("--protocol paper has fixed noise"));
  EXPECT_THAT(refusal("--protocol paper --prior force"), HasSubstr("--protocol paper has its prior on the acceleration"));
}

TEST_F(FitCommand, HyperpriorNoneIsMaximumLikelihood) {
  short_fit("");
  EXPECT_THAT(what_was_fitted("fit.json").dump(), HasSubstr("hyperprior"));
  const nlohmann::json report = short_fit("--hyperprior none");
  EXPECT_THAT(what_was_fitted("fit.json").dump(), Not(HasSubstr("hyperprior")));
  EXPECT_EQ(desk.json("fit.json")["report"]["objective"], report["nll"]);
}

TEST_F(FitCommand, MeanAndPriorChangeTheLikelihood) {
  const double zero = fit("--max-iterations 0")["nll"];
  EXPECT_LT(fit("--max-iterations 0 --mean force")["nll"].get<double>(), zero);
  EXPECT_EQ(fit("--max-iterations 0 --mean zero")["nll"].get<double>(), zero);
  EXPECT_EQ(fit("--max-iterations 0 --prior acceleration")["nll"].get<double>(), zero);
  fit("--max-iterations 0 --prior force");
  EXPECT_EQ(desk.json("fit.json")["prior"]["directions"], "force");
}

TEST_F(FitCommand, ObserveLearnsFromTheNamedRowsOnly) {
  fit("--max-iterations 0 --observe ddq3,ddq1");
  const nlohmann::json values = desk.json("fit.json")["observations"][0]["values"];
  EXPECT_TRUE(values.contains("ddq1") && values.contains("ddq3"));
  EXPECT_FALSE(values.contains("ddq2"));
  desk.write("train.csv", replaced(desk.read("train.csv"), ",ddq2,", ",of_no_use,"));
  fit("--max-iterations 0 --observe ddq3,ddq1", "again.json");
  EXPECT_EQ(what_was_fitted("again.json"), what_was_fitted("fit.json"));
}

TEST_F(FitCommand, MapBringsTheDerivativesAlong) {
  fit("--max-iterations 0");
  std::string log = desk.read("train.csv");
  log = replaced(log, "q1,q2,q3,dq1,dq2,dq3,", "x,q2,height,dx,dq2,height_dot,");
  log = replaced(log, "ddq1,ddq2,ddq3", "x_ddot,ddq2,ddheight");
  desk.write("train.csv", log);
  fit("--max-iterations 0 --map x=q1,height=q3", "mapped.json");
  EXPECT_EQ(what_was_fitted("mapped.json"), what_was_fitted("fit.json"));
  // predictions are at the log's names too, and are called by the model's
  desk.done("gp2 predict mapped.json --states train.csv --map x=q1,height=q3 -o prediction.csv");
  EXPECT_GE(desk.table("prediction.csv").find("ddq3"), 0);
  EXPECT_EQ(desk.done("gp2 evaluate mapped.json --data train.csv --map x=q1,height=q3 --json").json()["n"], 30);
}

TEST_F(FitCommand, MapRefusesNamesThatNobodyHas) {
  EXPECT_THAT(refusal("--map height=q3"), testing::AllOf(HasSubstr("--map height=q3"),
                                                         HasSubstr("train.csv has no column 'height'"), HasSubstr("q1, q2, q3")));
  EXPECT_THAT(refusal("--map q3=theta9"), testing::AllOf(HasSubstr("--map q3=theta9"), HasSubstr("'theta9' is neither")));
  EXPECT_THAT(refusal("--map q3"), HasSubstr("'q3' is not LOGNAME=MODELNAME"));
  EXPECT_THAT(refusal("--map q3=q1,q2=q1"), HasSubstr("'q1' is given two columns"));
  fit("--max-iterations 0");
  EXPECT_EQ(desk.run("gp2 predict fit.json --states train.csv --map height=q3 -o p.csv").status, 2);
  EXPECT_EQ(desk.run("gp2 evaluate fit.json --data train.csv --map height=q3 --json").status, 2);
  EXPECT_EQ(desk.run("gp2 check models/surface.toml --data train.csv --map height=q3").status, 2);
}

TEST_F(FitCommand, UsualOtherNamesOfColumnsAreUnderstood) {
  fit("--max-iterations 0");
  const std::string log = desk.read("train.csv");
  const std::string rows = log.substr(log.find('\n'));
  for (const char* header : {"q1,q2,q3,qd1,qd2,qd3,tau1,tau2,tau3,qdd1,qdd2,qdd3", "q1,q2,q3,v1,v2,v3,u1,u2,u3,a1,a2,a3",
                             "q1,q2,q3,qvel1,qvel2,qvel3,u1,u2,u3,qacc1,qacc2,qacc3"}) {
    desk.write("train.csv", header + rows);
    fit("--max-iterations 0", "alias.json");
    EXPECT_EQ(what_was_fitted("alias.json"), what_was_fitted("fit.json")) << header;
  }
}

TEST_F(FitCommand, ThreadsChangeNoBitOfTheFit) {
  for (const char* threads : {"1", "2", "3"}) {
    fit(std::string("--restarts 3 --max-iterations 10 --seed 5 --threads ") + threads, std::string("fit") + threads + ".json");
  }
  EXPECT_EQ(desk.read("fit1.json"), desk.read("fit2.json"));
  EXPECT_EQ(desk.read("fit1.json"), desk.read("fit3.json"));
  EXPECT_THAT(desk.read("fit1.json"), Not(HasSubstr("seconds")));
}

TEST_F(FitCommand, NumbersOutOfRangeAreRefused) {
  EXPECT_THAT(refusal("--restarts 0"), HasSubstr("--restarts: must be positive, got 0"));
  EXPECT_THAT(refusal("--commands train.csv"), HasSubstr("--commands: no input of the model acts late: leave it out"));
  EXPECT_THAT(refusal("--max-iterations -1"), HasSubstr("--max-iterations: must not be negative, got -1"));
  EXPECT_THAT(refusal("--max-points 0"), HasSubstr("--max-points: must be positive, got 0"));
  EXPECT_THAT(refusal("--threads -2"), HasSubstr("--threads: must be positive"));
  for (const char* noise : {"0", "-0.1", "nan", "inf", "0.1m", "little"}) {
    EXPECT_THAT(refusal(std::string("--noise-std ") + noise),
                HasSubstr(std::string("--noise-std: expected a positive number, 'estimate' or 'stated', got '") + noise + "'"));
  }
}

TEST(FitOfAPositiveLatent, IsTheSameWithARedundantRowWhileAParameterIsEstimated) {
  const Desk desk;
  const auto fitted = [&](const char* more) {
    desk.write(
        "carts.toml",
        fmt::format(
            "coordinates = [\"x\", \"y\"]\ninputs = [\"u\"]\n[parameters]\nm = {{ value = 1, bounds = [0.5, 3], estimate = true "
            "}}\n[mechanics]\nmass = [[\"m\", \"0\"], [\"0\", \"1\"]]\nforce = [\"u\", \"0\"]\n[constraints]\nposition = "
            "[\"y - 2*x\"{}]\n[[latent]]\nname = \"drag\"\nfeatures = [\"dx\"]\ndirections = {{ force = [[\"-dx\"], "
            "[\"0\"]] }}\npositive = true\n[noise]\nddq = 0.05\n[truth]\nforce = [\"-0.5*dx\", \"0\"]\n[sampling]\nx = [-1, "
            "1]\ndx = [-1, 1]\nu = [-3, 3]\ny = \"2*x\"\ndy = \"2*dx\"\n",
            more));
    if (!desk.has("log.csv")) desk.done("gp2 generate carts.toml --n 30 -o log.csv");
    return desk.done("gp2 fit carts.toml --data log.csv --mean force --restarts 1 --max-iterations 4 --json -o fit.json").json();
  };
  const nlohmann::json plain = fitted(""), redundant = fitted(", \"2*y - 4*x\"");
  ASSERT_EQ(plain["hyperparameters"].size(), redundant["hyperparameters"].size());
  for (std::size_t k = 0; k < plain["hyperparameters"].size(); ++k) {
    const double value = plain["hyperparameters"][k]["value"];
    EXPECT_NEAR(redundant["hyperparameters"][k]["value"].get<double>(), value, 1e-6 * std::abs(value));
  }
}

}  // namespace
}  // namespace gp2::test
