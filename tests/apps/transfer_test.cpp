#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/report_job.hpp"

// Other systems, several logs and other views, from the command line: what it writes is what the library computes.
namespace gp2::test {
namespace {

using Eigen::MatrixXd;
using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;

class Transfer : public testing::Test {
 protected:
  void SetUp() override {
    // a heavier particle on another surface
    std::string other = replaced(desk.read("models/surface.toml"), "p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1) - q3",
                                 "0.1*q1 - 0.15*q2 - p4*cos(p5*q1) - q3");
    other = replaced(other, "m  = 3.0", "m  = 4.0");
    desk.write("other.toml", other);
    desk.done("gp2 generate models/surface.toml --n 25 --seed 1 -o train.csv");
    desk.done("gp2 generate other.toml --n 15 --seed 2 -o other.csv");
    desk.done("gp2 generate other.toml --n 10 --seed 3 --noise-std 0 -o test.csv");
  }

  /// A short fit; the report.
  [[nodiscard]] nlohmann::json fit(const std::string& options) const {
    return desk.done("gp2 fit models/surface.toml --restarts 1 --max-iterations 8 --json -o fit.json " + options).json();
  }
  [[nodiscard]] std::string refusal(const std::string& line) const {
    const Outcome outcome = desk.run(line);
    EXPECT_EQ(outcome.status, 2) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    return outcome.err;
  }

  const std::vector<std::string> ddq = {"ddq1", "ddq2", "ddq3"};
  Desk desk;
};

TEST_F(Transfer, PredictsUnderAnotherSystem) {
  static_cast<void>(fit("--data train.csv"));
  const FitFile file = FitFile::read(desk / "fit.json");
  const Model other = Model::read(desk / "other.toml");
  const auto other_system = make_other_system(file.model, other, file.prior_options);
  struct Case {
    std::string word;
    View::Quantity quantity;
    std::vector<std::string> names;
  };
  for (const auto& [word, quantity, names] :
       {Case{"constrained", View::Quantity::constrained_acceleration, ddq},
        Case{"unconstrained", View::Quantity::unconstrained_acceleration, {"abar_q1", "abar_q2", "abar_q3"}},
        Case{"force", View::Quantity::learned_force, {"force_q1", "force_q2", "force_q3"}},
        Case{"multipliers", View::Quantity::multipliers, {"lambda1"}}}) {
    SCOPED_TRACE(word);
    desk.done("gp2 predict fit.json --system other.toml --states test.csv --cov std -o there.csv --view " + word);
    View view = View::all(quantity, *other.system);
    view.other_system = other_system;
    const MatrixXd states = read_log_states(other_system->prior, view, other, desk.table("test.csv"), {}).states;
    const Posterior::Marginal expected = file.posterior().marginal(view, states);
    EXPECT_EQ(columns(desk.table("there.csv"), names), expected.mean);
    std::vector<std::string> stddevs;
    for (const std::string& name : names) stddevs.push_back(name + "_std");
    EXPECT_EQ(columns(desk.table("there.csv"), stddevs), expected.stddev());
  }
}

TEST_F(Transfer, ToTheSameModelIsThePlainPredictionByteByByte) {
  static_cast<void>(fit("--data train.csv"));
  desk.done("gp2 predict fit.json --states train.csv --cov full -o plain.csv");
  desk.done("gp2 predict fit.json --states train.csv --cov full -o same.csv --system models/surface.toml");
  EXPECT_EQ(desk.read("same.csv"), desk.read("plain.csv"));
  const std::string evaluate = "gp2 evaluate fit.json --data train.csv --json";
  EXPECT_EQ(desk.done(evaluate).out, desk.done(evaluate + " --system models/surface.toml").out);
}

TEST_F(Transfer, EvaluatesWithTheConstraintOfTheOtherSystem) {
  static_cast<void>(fit("--data train.csv"));
  const std::string evaluate = "gp2 evaluate fit.json --data test.csv --json";
  const nlohmann::json there = desk.done(evaluate + " --system other.toml").json(), here = desk.done(evaluate).json();
  EXPECT_LT(there["max_constraint_error"], 1e-12);
  EXPECT_LT(there["nrmse"], here["nrmse"]);
}

// the motion is on the other constraint, and its accelerations and multipliers are those that predict tells along it
TEST_F(Transfer, SimulatesTheOtherSystem) {
  static_cast<void>(fit("--data train.csv"));
  const std::string simulate = "gp2 simulate fit.json --start q1=0.4,q2=-0.3,dq1=0.5 --t-end 0.5 --dt 0.1 --json ";
  const nlohmann::json report = desk.done(simulate + "--system other.toml -o motion.csv").json();
  EXPECT_LT(report["max_position_drift"], 1e-12);
  EXPECT_LT(report["max_velocity_drift"], 1e-11);
  desk.done("gp2 predict fit.json --system other.toml --states motion.csv --cov std -o ddq.csv");
  desk.done("gp2 predict fit.json --system other.toml --states motion.csv --view multipliers -o lambda.csv");
  const std::vector<std::string> stddevs = {"ddq1_std", "ddq2_std", "ddq3_std"}, lambda = {"lambda1"};
  const auto expect_equal = [&](const std::string& file, const std::vector<std::string>& names) {
    const MatrixXd predicted = columns(desk.table(file), names), along = columns(desk.table("motion.csv"), names);
    EXPECT_LE((predicted - along).cwiseAbs().maxCoeff(), 1e-11 * (1 + predicted.cwiseAbs().maxCoeff())) << file;
  };
  expect_equal("ddq.csv", ddq);
  expect_equal("ddq.csv", stddevs);
  expect_equal("lambda.csv", lambda);

  desk.done(simulate + "-o here.csv");
  EXPECT_GT((columns(desk.table("here.csv"), {"q3"}) - columns(desk.table("motion.csv"), {"q3"})).norm(), 0.01);
  desk.done(simulate + "--system models/surface.toml -o same.csv");
  EXPECT_EQ(desk.read("same.csv"), desk.read("here.csv"));
  EXPECT_THAT(refusal("gp2 simulate other.toml --system models/surface.toml --start q1=0 --t-end 1 -o x.csv"),
              HasSubstr("--system goes with a FIT.json; other.toml is a model: simulate models/surface.toml itself"));
}

TEST_F(Transfer, ReportsOnATestOfTheOtherSystem) {
  static_cast<void>(fit("--data train.csv"));
  const nlohmann::json figures = desk.done("gp2 evaluate fit.json --data test.csv --system other.toml --json").json();
  ReportOptions options;
  options.fits = {desk / "fit.json"};
  options.data = desk / "test.csv";
  options.system = options.truth = desk / "other.toml";
  std::vector<std::string> notes;
  const Report report = collect_reports(options, notes).front();
  ASSERT_EQ(report.data.size(), 2U);
  EXPECT_EQ(report.data[1].evaluation.nrmse, figures["nrmse"]);
  EXPECT_LT(report.data[1].constraint_error.maxCoeff(), 1e-11);
  // the measurements are without noise, and the truth is of that system alone
  EXPECT_LE((report.data[1].truth - report.data[1].measured).cwiseAbs().maxCoeff(), 1e-11);
  EXPECT_EQ(report.data[0].truth.size(), 0);
  desk.done("gp2 report fit.json --data test.csv --system other.toml --truth other.toml -o report.html");
  EXPECT_NE(desk.read("report.html").find("test.csv, of '"), std::string::npos);
  desk.run("gp2 report fit.json --system other.toml -o report.html");
  EXPECT_THAT(refusal("gp2 report fit.json --system other.toml -o report.html"), HasSubstr("--system requires --data"));
}

TEST_F(Transfer, PoolsLogsOfSeveralSystems) {
  static_cast<void>(fit("--data train.csv --data other.csv@other.toml --data train.csv --max-points 12"));
  const FitFile file = FitFile::read(desk / "fit.json");
  ASSERT_EQ(file.observations.size(), 3U);
  EXPECT_EQ(file.observations[0].view().other_system, nullptr);
  ASSERT_NE(file.observations[1].view().other_system, nullptr);
  EXPECT_EQ(file.observations[1].view().other_system->prior.system->parameter_values()[0], 4.0);
  EXPECT_EQ(file.observations[1].n_data(), 12);
  EXPECT_EQ(file.data_source, "train.csv, other.csv@other.toml, train.csv");
  // the fit needs no file but itself
  std::filesystem::remove(desk / "other.csv");
  const std::string text = desk.read("other.toml");
  std::filesystem::remove(desk / "other.toml");
  EXPECT_EQ(desk.done("gp2 predict fit.json --states test.csv -o prediction.csv").status, 0);
  EXPECT_GT(columns(desk.table("prediction.csv"), ddq).norm(), 0);
}

TEST_F(Transfer, SplitsAtTheLastAt) {
  std::filesystem::create_directory(desk / "run@home");
  std::filesystem::copy(desk / "train.csv", desk / "run@home/train.csv");
  std::filesystem::copy(desk / "other.csv", desk / "run@home/other.csv");
  static_cast<void>(fit("--data run@home/train.csv --data run@home/other.csv@other.toml"));
  EXPECT_EQ(FitFile::read(desk / "fit.json").observations.size(), 2U);
}

TEST_F(Transfer, JoinsKnowledgeToTheObservations) {
  desk.write("rest.csv", "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3,abar_q3\n0,0,0.1,0,0,0,0,0,0,-9.81\n1,0,0,0,0,0,0,0,0,-9.81\n");
  static_cast<void>(fit("--data train.csv --also unconstrained:rest.csv --also-noise-std 0.001"));
  const FitFile file = FitFile::read(desk / "fit.json");
  ASSERT_EQ(file.observations.size(), 2U);
  EXPECT_THAT(file.observations[1].view().rows, ElementsAre(2));
  desk.done("gp2 predict fit.json --states rest.csv --view unconstrained --cov std -o known.csv");
  const MatrixXd known = columns(desk.table("known.csv"), {"abar_q3", "abar_q3_std"});
  EXPECT_NEAR(known(0, 0), -9.81, 0.005);
  EXPECT_LE(known.row(1).maxCoeff(), 0.001) << "conditioning never raises a variance above the noise of what is known";

  // and alone
  static_cast<void>(fit("--also unconstrained:rest.csv --also-noise-std 0.001"));
  EXPECT_EQ(FitFile::read(desk / "fit.json").observations.size(), 1U);
  desk.done("gp2 predict fit.json --states rest.csv --view unconstrained -o known.csv");
  EXPECT_NEAR(columns(desk.table("known.csv"), {"abar_q3"})(0, 0), -9.81, 0.005);
  desk.done("gp2 evaluate fit.json --data test.csv");

  // other quantities, of one latent, under another system
  desk.write("more.csv",
             "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3,dq1_next,fc_q1,abar_q1@unconstrained acceleration\n0,0,0.1,0,0,0,0,0,0,0.1,0,0\n");
  static_cast<void>(
      fit("--data train.csv --also next-velocity:more.csv --dt 0.1 --also constraint-force:more.csv@other.toml "
          "--also 'unconstrained@unconstrained acceleration:more.csv' --also-noise-std 0.1"));
  const FitFile more = FitFile::read(desk / "fit.json");
  ASSERT_EQ(more.observations.size(), 4U);
  EXPECT_EQ(more.observations[1].view().time_step, 0.1);
  EXPECT_NE(more.observations[2].view().other_system, nullptr);
  EXPECT_EQ(more.observations[3].view().latent, 0);
}

TEST_F(Transfer, WhatTakesLogsOfTheFitsOwnSystemSaysWhy) {
  static_cast<void>(fit("--data train.csv"));
  EXPECT_THAT(
      refusal("gp2 update fit.json --data other.csv@other.toml -o next.json"),
      HasSubstr("--data: 'other.csv@other.toml' is of another system, 'other.toml', than the fit: hyperparameters are held"));
  EXPECT_THAT(refusal("gp2 shoot fit.json --data other.csv@other.toml -o next.json"),
              HasSubstr("the motion that is compared with the log is that of the fit's own system"));
  EXPECT_FALSE(desk.has("next.json"));
}

TEST_F(Transfer, AWindowMayLeaveNothingOfALog) {
  static_cast<void>(fit("--data other.csv@other.toml --data train.csv"));
  desk.done("gp2 update fit.json --data train.csv --window 10 -o next.json");
  const FitFile next = FitFile::read(desk / "next.json");
  EXPECT_EQ(next.observations[0].n_data(), 0);
  EXPECT_EQ(next.posterior().n_states(), 10);
  for (const char* command : {"show next.json", "evaluate next.json --data train.csv", "report next.json -o next.html",
                              "update next.json --data train.csv --window 12 -o last.json", "show last.json"}) {
    desk.done(std::string("gp2 ") + command);
  }
}

TEST_F(Transfer, SaysWhichEstimatesAreNotTaken) {
  static_cast<void>(fit("--data train.csv --mean force --estimate m,p4"));
  desk.write("marked.toml", replaced(desk.read("other.toml"), "m  = 4.0", "m  = { value = 4, estimate = true }"));
  const std::string there = "other.toml: parameter 'm' stays 4 there while it is estimated in 'models/surface.toml'; mark it ";
  const std::string p4 = "parameter 'p4' stays ";
  for (const std::string command : {"predict fit.json --states test.csv -o there.csv", "evaluate fit.json --data test.csv",
                                    "simulate fit.json --start q1=0.1 --t-end 0.01 -o motion.csv", "export fit.json -o .",
                                    "report fit.json --data test.csv -o report.html"}) {
    EXPECT_THAT(desk.done("gp2 " + command + " --system other.toml").err, AllOf(HasSubstr(there), HasSubstr(p4))) << command;
    EXPECT_THAT(desk.done("gp2 " + command + " --system marked.toml").err,
                AllOf(testing::Not(HasSubstr("parameter 'm'")), HasSubstr(p4)))
        << command;
    EXPECT_FALSE(desk.done("gp2 " + command).said("stays")) << command;
  }
}

TEST_F(Transfer, RefusesWhatDoesNotFit) {
  desk.write("kernel.toml", replaced(desk.read("models/surface.toml"), "kernel     = \"se\"", "kernel     = \"matern52\""));
  EXPECT_THAT(
      refusal("gp2 fit models/surface.toml --data train.csv --data other.csv@kernel.toml -o no.json"),
      AllOf(HasSubstr("kernel.toml: another system of 'models/surface.toml'"), HasSubstr("is matern52 there, but se here")));
  static_cast<void>(fit("--data train.csv"));
  EXPECT_THAT(refusal("gp2 predict fit.json --states test.csv --system models/unicycle.toml -o no.csv"),
              HasSubstr("its inputs are u1, u2 there, but u1, u2, u3 here"));
  EXPECT_THAT(refusal("gp2 evaluate fit.json --data test.csv --system models/double_pendulum.toml"),
              HasSubstr("its coordinates are"));
  const std::string also = "gp2 fit models/surface.toml --data train.csv -o no.json --also ";
  for (const std::string wrong : {"rest.csv", "abar:rest.csv", "@x:rest.csv"}) {
    EXPECT_THAT(refusal(also + wrong),
                AllOf(HasSubstr("--also: '" + wrong + "' is not VIEW:FILE.csv"), HasSubstr("multipliers")));
  }
  EXPECT_THAT(refusal("gp2 fit models/surface.toml --data train.csv --dt 0.1 -o no.json"), HasSubstr("--dt goes with --also"));
  EXPECT_FALSE(desk.has("no.json"));
}

}  // namespace
}  // namespace gp2::test
