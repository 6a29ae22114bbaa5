// Constraints that hold in the mean, from a model file to a fit.
#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"
#include "jobs/data_of_model.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::Contains;
using testing::HasSubstr;
using testing::Not;

constexpr double slip = 0.2;  // m/s², 20 times the noise
constexpr const char* exact_row = "velocity = [\"dq1*sin(q3) - dq2*cos(q3)\"]";

std::string changed_unicycle(const std::string& to) {
  return test::changed(test::model("models/unicycle.toml").text, {{exact_row, to}});
}

const Model& slipping_unicycle() {
  static const Model model = Model::parse(
      changed_unicycle(fmt::format("velocity = [{{ expr = \"dq1*sin(q3) - dq2*cos(q3)\", noise = {} }}]", slip)), "slipping");
  return model;
}

test::LogData slipping_log(int n, std::uint64_t seed) { return test::drawn_log(slipping_unicycle(), n, seed); }

FitOutcome fit(const Model& model, const test::LogData& log) {
  FitRequest request = test::fit_request(model, {log.table()});
  request.problem.estimate = std::vector<std::string>{"R", "Ic"};
  return run_fit(prepare_fit(std::move(request)));
}

double rms(const MatrixXd& m) { return std::sqrt(m.squaredNorm() / static_cast<double>(m.size())); }

TEST(SoftConstraint, GeneratedDataSlipByWhatIsStatedAndNoMore) {
  const test::LogData log = slipping_log(2000, 5);
  const SystemValues values = log.model->system->evaluate(log.states, log.model->system->parameter_values());
  VectorXd residual(log.states.cols());
  for (int i = 0; i < residual.size(); ++i) residual[i] = (values.A(i) * log.accelerations.col(i) - values.b(i))[0];
  // rows of A have length 1: the noise adds 0.01² to the variance, and n values tell a deviation to 1/√(2n)
  EXPECT_NEAR(rms(residual), std::hypot(slip, 0.01), 4 * slip / std::sqrt(2.0 * 2000));
  const GeneratedData exact = generate(*log.model, {50, 5, VectorXd::Zero(3), {}});
  const SystemValues at = log.model->system->evaluate(exact.states, log.model->system->parameter_values());
  for (int i = 0; i < 50; ++i) EXPECT_NEAR((at.A(i) * exact.accelerations.col(i) - at.b(i))[0], 0, 1e-13);
}

TEST(SoftConstraint, IsTakenForNoiseInsteadOfForcesAndHeldInPredictions) {
  const test::LogData log = slipping_log(120, 6);
  const FitOutcome soft = fit(slipping_unicycle(), log);
  EXPECT_THAT(soft.notes, Not(Contains(HasSubstr("measured ddq on A ddq = b"))));
  EXPECT_THAT(soft.notes, Not(Contains(HasSubstr("values differ from their prediction by all others"))));
  const FitOutcome hard = fit(test::model("models/unicycle.toml"), log);
  EXPECT_THAT(hard.notes, Contains(HasSubstr("measured ddq on A ddq = b")));

  // the slip is as good as noise
  EXPECT_GT(soft.cross_validation->nrmse_of_noise, 5 * hard.cross_validation->nrmse_of_noise);
  const MatrixXd states = slipping_log(200, 7).states;
  const View view = View::constrained_acceleration(*slipping_unicycle().system);
  const MatrixXd truth = true_acceleration(slipping_unicycle(), states);
  const MatrixXd mean = soft.posterior.marginal(view, states).mean;
  EXPECT_LT(rms(mean - truth), 0.5 * rms(hard.posterior.marginal(view, states).mean - truth));
  EXPECT_LT(max_constraint_error(*slipping_unicycle().system, states, soft.posterior.values().parameters, mean), 1e-13);

  const Evaluation fresh = evaluate(soft.file, soft.posterior, slipping_log(2000, 8).table(), {}).evaluation;
  // one slip for the three values of a state: 2000 draws
  EXPECT_NEAR(fresh.coverage95, 0.95, 4 * std::sqrt(0.95 * 0.05 / 2000));
}

TEST(SoftConstraint, IsExpectedByCheck) {
  const test::LogData log = slipping_log(100, 9);
  const CsvTable table = log.table();
  const auto worst = [&](const Model& model) {
    Finding::Level level = Finding::Level::good;
    for (const Finding& finding : check(model, &table)) level = std::max(level, finding.level);
    return level;
  };
  EXPECT_EQ(worst(slipping_unicycle()), Finding::Level::good);
  EXPECT_GT(worst(test::model("models/unicycle.toml")), Finding::Level::good);
}

TEST(SoftConstraint, OfNoNoiseIsExact) {
  for (const char* noise : {", noise = 0", ""}) {
    const std::string row = fmt::format(R"toml(velocity = [{{ expr = "dq1*sin(q3) - dq2*cos(q3)"{} }}])toml", noise);
    const Model model = Model::parse(changed_unicycle(row), "exact");
    EXPECT_EQ(model.system->nc(), 1);
    EXPECT_FALSE(model.system->has_constraint_noise());
  }
}

TEST(SoftConstraint, OfAnotherFormIsRefused) {
  const auto message = [](const std::string& row) {
    return test::input_error_of([&] { static_cast<void>(Model::parse(changed_unicycle("velocity = [" + row + "]"), "it")); });
  };
  EXPECT_THAT(message("{ noise = 0.1 }"), HasSubstr("missing expr; write { expr = "));
  EXPECT_THAT(message("{ expr = \"dq1\", noise = -0.1 }"), HasSubstr("must not be negative"));
  EXPECT_THAT(message("{ expr = \"dq1\", noise = inf }"), HasSubstr("expected a finite number"));
  EXPECT_THAT(message("{ expr = \"dq1\", slip = 0.1 }"), HasSubstr("slip"));
}

TEST(SoftConstraint, BesideARowThatFollowsFromItIsRefused) {
  const Model model = Model::parse(
      changed_unicycle("velocity = [{ expr = \"dq1*sin(q3) - dq2*cos(q3)\", noise = 0.1 }, \"2*dq1*sin(q3) - 2*dq2*cos(q3)\"]"),
      "redundant");
  EXPECT_THAT(test::input_error_of([&] {
                static_cast<void>(generate(model, {3, 1, VectorXd::Zero(3), {}}));
              }),
              HasSubstr("the constraints are redundant, so that none of them may have a noise of its own"));
}

}  // namespace
}  // namespace gp2
