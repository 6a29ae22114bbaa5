#include <cmath>
#include <numbers>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/jobs/fit_problem.hpp"

// generate, fit, predict, evaluate: what the command writes is what the library computes.
namespace gp2::test {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::StartsWith;

class MainJob : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/surface.toml --n 30 --seed 1 -o train.csv");
    desk.done("gp2 generate models/surface.toml --n 12 --seed 2 --noise-std 0 -o test.csv");
    desk.done("gp2 fit models/surface.toml --data train.csv --restarts 1 --max-iterations 15 -o fit.json");
  }

  /// The fit and the states of a file, as the library reads them.
  struct Read {
    FitFile fit;
    MatrixXd states;
  };
  [[nodiscard]] Read read(const std::string& states) const {
    FitFile fit = FitFile::read(desk / "fit.json");
    const View view = View::all(View::Quantity::constrained_acceleration, *fit.model.system);
    MatrixXd values = read_log_states(fit.prior(), view, fit.model, desk.table(states), {}).states;
    return {std::move(fit), std::move(values)};
  }

  const std::vector<std::string> inputs = {"q1", "q2", "q3", "dq1", "dq2", "dq3", "u1", "u2", "u3"};
  const std::vector<std::string> outputs = {"ddq1", "ddq2", "ddq3"};
  Desk desk;
};

TEST_F(MainJob, PredictsEveryRowInOrderAfterTheInputColumns) {
  desk.done("gp2 predict fit.json --states test.csv -o prediction.csv");
  const CsvTable test = desk.table("test.csv"), prediction = desk.table("prediction.csv");
  EXPECT_THAT(prediction.header(), ElementsAre("q1", "q2", "q3", "dq1", "dq2", "dq3", "u1", "u2", "u3", "ddq1_input",
                                               "ddq2_input", "ddq3_input", "ddq1", "ddq2", "ddq3", "distance_from_data"));
  ASSERT_EQ(prediction.n_rows(), test.n_rows());
  for (int i = 0; i < test.n_rows(); ++i) {
    for (int column = 0; column < test.n_columns(); ++column) EXPECT_EQ(prediction.cell(i, column), test.cell(i, column));
  }
}

TEST_F(MainJob, WritesTheLibrarysDoublesToTheLastBit) {
  desk.done("gp2 predict fit.json --states test.csv --cov full -o prediction.csv");
  const CsvTable prediction = desk.table("prediction.csv");
  const std::vector<std::string> header(prediction.header().begin() + 12, prediction.header().end());
  EXPECT_THAT(header, ElementsAre("ddq1", "ddq2", "ddq3", "ddq1_std", "ddq2_std", "ddq3_std", "cov_ddq1_ddq1", "cov_ddq1_ddq2",
                                  "cov_ddq1_ddq3", "cov_ddq2_ddq2", "cov_ddq2_ddq3", "cov_ddq3_ddq3", "distance_from_data"));
  const Read in = read("test.csv");
  const View view = View::all(View::Quantity::constrained_acceleration, *in.fit.model.system);
  const Posterior::Marginal expected = in.fit.posterior().marginal(view, in.states);
  EXPECT_EQ(columns(prediction, outputs), expected.mean);
  EXPECT_EQ(columns(prediction, {"ddq1_std", "ddq2_std", "ddq3_std"}), expected.stddev());
  EXPECT_EQ(columns(prediction, {"cov_ddq1_ddq1", "cov_ddq1_ddq2", "cov_ddq1_ddq3"}),
            expected.covariance(std::vector{0, 3, 6}, Eigen::all));
  EXPECT_EQ(columns(prediction, {"cov_ddq2_ddq2", "cov_ddq2_ddq3"}), expected.covariance(std::vector{4, 7}, Eigen::all));
  EXPECT_EQ(columns(prediction, {"cov_ddq3_ddq3"}), expected.covariance(std::vector{8}, Eigen::all));
  // the shortest form that reads back to the same double
  for (int column = 12; column < prediction.n_columns(); ++column) {
    EXPECT_EQ(prediction.cell(0, column), shortest(prediction.number(0, column)));
  }
}

TEST_F(MainJob, PredictsEveryViewUnderItsName) {
  struct Case {
    std::string options;
    View::Quantity quantity;
    std::optional<double> time_step;
    std::optional<int> latent;
    std::vector<std::string> names;
  };
  const std::string latent = "'unconstrained acceleration'";
  const std::vector<Case> cases = {
      {"--view constraint-force", View::Quantity::constraint_force, {}, {}, {"fc_q1", "fc_q2", "fc_q3"}},
      {"--view multipliers", View::Quantity::multipliers, {}, {}, {"lambda1"}},
      {"--view next-velocity --dt 0.01", View::Quantity::next_velocity, 0.01, {}, {"dq1_next", "dq2_next", "dq3_next"}},
      {"--view unconstrained --latent " + latent,
       View::Quantity::unconstrained_acceleration,
       {},
       0,
       {"abar_q1@unconstrained acceleration", "abar_q2@unconstrained acceleration", "abar_q3@unconstrained acceleration"}}};
  for (const Case& one : cases) {
    SCOPED_TRACE(one.options);
    desk.done("gp2 predict fit.json --states test.csv --cov std -o view.csv " + one.options);
    const Read in = read("test.csv");
    View view = View::all(one.quantity, *in.fit.model.system);
    view.time_step = one.time_step;
    view.latent = one.latent;
    const Posterior::Marginal expected = in.fit.posterior().marginal(view, in.states);
    const CsvTable prediction = desk.table("view.csv");
    EXPECT_EQ(columns(prediction, one.names), expected.mean);
    std::vector<std::string> stddevs;
    for (const std::string& name : one.names) stddevs.push_back(name + "_std");
    EXPECT_EQ(columns(prediction, stddevs), expected.stddev());
  }
}

TEST_F(MainJob, PredictsTheSameWithAndWithoutCovariance) {
  desk.done("gp2 predict fit.json --states test.csv -o none.csv");
  desk.done("gp2 predict fit.json --states test.csv --cov std -o std.csv");
  EXPECT_EQ(desk.table("std.csv").n_columns(), desk.table("none.csv").n_columns() + 3);
  EXPECT_EQ(columns(desk.table("std.csv"), outputs), columns(desk.table("none.csv"), outputs));
}

TEST_F(MainJob, PredictsTheUnconstrainedAccelerationUnderItsOwnNames) {
  desk.done("gp2 predict fit.json --states test.csv --view unconstrained --cov full -o abar.csv");
  const CsvTable prediction = desk.table("abar.csv");
  EXPECT_EQ(prediction.find("ddq1_input"), -1);
  EXPECT_GE(prediction.find("ddq1"), 0);
  EXPECT_GE(prediction.find("cov_abar_q1_abar_q3"), 0);
  const Read in = read("test.csv");
  const View view = View::all(View::Quantity::unconstrained_acceleration, *in.fit.model.system);
  EXPECT_EQ(columns(prediction, {"abar_q1", "abar_q2", "abar_q3"}), in.fit.posterior().mean(view, in.states));
}

TEST_F(MainJob, KeepsTextColumnsAsTheyAreAndQuotesThemWhereNeeded) {
  const CsvTable test = desk.table("test.csv");
  std::string csv = "\"note, free\",q3,q2,q1,dq3,dq2,dq1,u1,u2,u3\n";
  const std::vector<std::string> notes = {"plain", "\"a, b\"", "\"said \"\"go\"\"\"", "", "\" padded \""};
  for (std::size_t i = 0; i < notes.size(); ++i) {
    csv += notes[i];
    for (const char* name : {"q3", "q2", "q1", "dq3", "dq2", "dq1", "u1", "u2", "u3"}) {
      csv += "," + test.cell(static_cast<int>(i), test.find(name));
    }
    csv += "\n";
  }
  desk.write("states.csv", csv);
  const Outcome outcome = desk.done("gp2 predict fit.json --states states.csv -o prediction.csv");
  EXPECT_THAT(outcome.err, HasSubstr("columns not needed: note, free"));
  const CsvTable prediction = desk.table("prediction.csv");
  EXPECT_THAT(desk.read("prediction.csv"), StartsWith("\"note, free\",q3,q2,q1,"));
  ASSERT_EQ(prediction.n_rows(), static_cast<int>(notes.size()));
  for (int i = 0; i < prediction.n_rows(); ++i) EXPECT_EQ(prediction.cell(i, 0), desk.table("states.csv").cell(i, 0));
  // the order of columns is of no importance
  const Read in = read("test.csv");
  const View view = View::all(View::Quantity::constrained_acceleration, *in.fit.model.system);
  EXPECT_LE((columns(prediction, outputs) - in.fit.posterior().mean(view, in.states).leftCols(5)).cwiseAbs().maxCoeff(), 1e-14);
}

TEST_F(MainJob, PredictsAtItsOwnOutputWithoutNamingTwoColumnsAlike) {
  desk.done("gp2 predict fit.json --states test.csv -o once.csv");
  desk.done("gp2 predict fit.json --states once.csv -o twice.csv");
  const CsvTable twice = desk.table("twice.csv");  // refuses a repeated name
  EXPECT_EQ(columns(twice, {"ddq1_input"}), columns(desk.table("test.csv"), {"ddq1"}));
  EXPECT_EQ(columns(twice, {"ddq1_input_input"}), columns(desk.table("once.csv"), {"ddq1"}));
  EXPECT_EQ(columns(twice, {"ddq1"}), columns(desk.table("once.csv"), {"ddq1"}));
}

TEST_F(MainJob, PredictsWhereOnlyTheStateIsKnown) {
  std::string csv = "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3\n";
  csv += "0.5,0.1,0.2,0.1,0,0,1,0,0\n";
  desk.write("state.csv", csv);
  EXPECT_EQ(desk.run("gp2 predict fit.json --states state.csv -o prediction.csv").status, 0);
}

double average_log_density(const MatrixXd& error, const MatrixXd& stddev) {
  return (0.5 * (error.array() / stddev.array()).square() + stddev.array().log() + 0.5 * std::log(2 * std::numbers::pi)).mean();
}
double share_inside(const MatrixXd& error, const MatrixXd& stddev) {
  return (error.array().abs() <= 1.959963984540054 * stddev.array()).cast<double>().mean();
}
/// Of the population: divided by N.
Eigen::VectorXd spread(const MatrixXd& values) {
  return (values.colwise() - values.rowwise().mean()).cwiseAbs2().rowwise().mean().cwiseSqrt();
}

TEST_F(MainJob, EvaluatesFiguresThatFollowFromThePredictions) {
  desk.done("gp2 predict fit.json --states test.csv --cov std -o prediction.csv");
  const nlohmann::json figures = desk.done("gp2 evaluate fit.json --data test.csv --json").json();
  const CsvTable prediction = desk.table("prediction.csv");
  const MatrixXd mean = columns(prediction, outputs), target = columns(desk.table("test.csv"), outputs);
  const MatrixXd stddev = columns(prediction, {"ddq1_std", "ddq2_std", "ddq3_std"});
  const MatrixXd error = target - mean;
  const Eigen::VectorXd rmse = error.cwiseAbs2().rowwise().mean().cwiseSqrt();
  const auto near = [](double value) { return testing::DoubleNear(value, 1e-12 * std::abs(value)); };
  for (std::size_t k = 0; k < outputs.size(); ++k) {
    EXPECT_THAT(figures["rmse"][outputs[k]].get<double>(), near(rmse[static_cast<Index>(k)]));
  }
  const Eigen::VectorXd training = spread(columns(desk.table("train.csv"), outputs));
  EXPECT_THAT(figures["rmse_normalised"].get<double>(), near(rmse.cwiseQuotient(training).mean()));
  EXPECT_THAT(figures["nrmse"].get<double>(), near(std::sqrt(error.cwiseAbs2().mean() / spread(target).cwiseAbs2().mean())));
  EXPECT_THAT(figures["nlpd_latent"].get<double>(), near(average_log_density(error, stddev)));
  EXPECT_THAT(figures["coverage95_latent"].get<double>(), near(share_inside(error, stddev)));
  const MatrixXd noisy = (stddev.array().square() + 0.1 * 0.1).sqrt();  // [noise] of the model
  EXPECT_THAT(figures["nlpd"].get<double>(), near(average_log_density(error, noisy)));
  EXPECT_THAT(figures["coverage95"].get<double>(), near(share_inside(error, noisy)));
  EXPECT_EQ(figures["n"], 12);
  EXPECT_EQ(figures["n_zero_variance"], 0);

  // A ddq − b of the surface, written by hand
  const MatrixXd x = columns(desk.table("test.csv"), inputs);
  double worst = 0;
  for (Index i = 0; i < x.cols(); ++i) {
    const double q1 = x(0, i), q2 = x(1, i), v1 = x(3, i), v2 = x(4, i);
    const double A1 = 2 * 0.08 * q1 + 0.05 * q2 - 0.1 * 3 * std::sin(3 * q1), A2 = 2 * 0.05 * q2 + 0.05 * q1;
    const double b = -2 * 0.08 * v1 * v1 - 2 * 0.05 * v2 * v2 - 2 * 0.05 * v1 * v2 + 0.1 * 9 * v1 * v1 * std::cos(3 * q1);
    worst = std::max(worst, std::abs(A1 * mean(0, i) + A2 * mean(1, i) - mean(2, i) - b));
  }
  EXPECT_LE(worst, 5e-15);
  EXPECT_LE(figures["max_constraint_error"].get<double>(), 5e-15);
  EXPECT_EQ(figures["max_constraint_error"], figures["max_constraint_error_fitted"]);
}

TEST_F(MainJob, EvaluatesTheOutputsAskedForOnly) {
  const nlohmann::json all = desk.done("gp2 evaluate fit.json --data test.csv --json").json();
  const nlohmann::json some = desk.done("gp2 evaluate fit.json --data test.csv --outputs ddq3,ddq1 --json").json();
  ASSERT_EQ(some["rmse"].size(), 2u);
  EXPECT_EQ(some["rmse"]["ddq3"], all["rmse"]["ddq3"]);
  EXPECT_EQ(some["rmse"]["ddq1"], all["rmse"]["ddq1"]);
}

TEST(Evaluate, LeavesOutputsWithoutVarianceOutAndCountsThem) {
  const Desk desk;
  desk.write("driven.toml", R"toml(
name = "a mass beside a driven one"
coordinates = ["q1", "q2"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
acceleration = ["ddq2 - cos(t)"]
[[latent]]
name = "force"
kernel = "se"
features = ["q1"]
directions = "acceleration"
[noise]
ddq = 0.1
[truth]
acceleration = ["-sin(q1)", "0"]
[sampling]
q1 = [-2, 2]
t = [0, 3]
)toml");
  desk.done("gp2 generate driven.toml --n 25 -o train.csv");
  desk.done("gp2 generate driven.toml --n 10 --seed 2 -o test.csv");
  desk.done("gp2 fit driven.toml --data train.csv --restarts 1 --max-iterations 10 -o fit.json");
  desk.done("gp2 predict fit.json --states test.csv --cov std -o prediction.csv");
  const nlohmann::json figures = desk.done("gp2 evaluate fit.json --data test.csv --json").json();
  EXPECT_EQ(figures["n"], 10);
  EXPECT_EQ(figures["n_zero_variance"], 10);
  const CsvTable prediction = desk.table("prediction.csv");
  const MatrixXd error = columns(prediction, {"ddq1"}) - columns(prediction, {"ddq1_input"});
  const double expected = average_log_density(error, columns(prediction, {"ddq1_std"}));
  EXPECT_NEAR(figures["nlpd_latent"].get<double>(), expected, 1e-12 * std::abs(expected));
}

TEST(Evaluate, TellsTheConstraintErrorOfTheModelsAndOfTheFittedParametersApart) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 30 -o train.csv");
  desk.done("gp2 fit models/surface.toml --data train.csv --estimate p1,p2 --restarts 1 --max-iterations 15 -o fit.json");
  const nlohmann::json figures = desk.done("gp2 evaluate fit.json --data train.csv --json").json();
  EXPECT_LE(figures["max_constraint_error_fitted"].get<double>(), 5e-15);
  EXPECT_GT(figures["max_constraint_error"].get<double>(), 1e-9);
}

TEST(Evaluate, GivesNoNormalisedFigureForAnOutputThatTrainingDidNotSee) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 20 -o train.csv");
  desk.done("gp2 fit models/surface.toml --data train.csv --observe ddq1,ddq2 --restarts 1 --max-iterations 5 -o fit.json");
  const nlohmann::json unseen = desk.done("gp2 evaluate fit.json --data train.csv --outputs ddq3 --json").json();
  EXPECT_TRUE(unseen["rmse_normalised"].is_null());
  EXPECT_TRUE(unseen["nlpd"].is_null());
  EXPECT_TRUE(unseen["nlpd_latent"].is_number());
  // by default those that training observed
  EXPECT_EQ(desk.done("gp2 evaluate fit.json --data train.csv --json").json()["rmse"].size(), 2u);
}

}  // namespace
}  // namespace gp2::test
