// What is compared, and by which noise.
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <numbers>
#include <optional>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/base/statistics.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

Model sledge() {
  return Model::parse(R"toml(
name        = "sledge"
coordinates = ["x", "y", "heading"]
[mechanics]
mass = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.3"]]
[constraints]
velocity = ["dx*sin(heading) - dy*cos(heading)"]
[noise]
ddq = 0.1
[[latent]]
name       = "drag"
kernel     = "se"
features   = ["dx", "dy", "heading", "dheading"]
directions = "acceleration"
)toml",
                      "sledge.toml");
}

// states on the constraint, those of `straight` rows with a heading of exactly 0; ddq of the observed columns only
CsvTable log_of(const std::string& name, int n, const std::string& columns, bool straight, const std::string& more = "") {
  std::string text = "heading,dx,dy,dheading" + columns + "\n";
  for (int i = 0; i < n; ++i) {
    const double heading = straight ? 0 : 0.3 * std::sin(1.7 * i), speed = 1 + 0.5 * std::cos(2.3 * i);
    text += fmt::format("{},{},{},{}", heading, speed * std::cos(heading), speed * std::sin(heading), std::sin(0.9 * i));
    for (std::size_t k = 0; k < static_cast<std::size_t>(std::count(columns.begin(), columns.end(), ',')); ++k) {
      text += fmt::format(",{}", more.empty() || k == 0 ? -0.5 * speed + 0.1 * std::sin(31.0 * i + static_cast<double>(k)) : 0.7);
    }
    text += '\n';
  }
  return CsvTable::parse(text, name);
}

FitOutcome fit_of(std::vector<Log> logs, Model model = sledge()) {
  FitRequest request;
  request.model = std::move(model);
  request.logs = std::move(logs);
  request.restarts = 1;
  request.max_iterations = 3;
  return run_fit(prepare_fit(std::move(request)));
}

TEST(EvaluateJob, ComparesAllThatAnyLogObservedAndSaysWhatItLeavesOut) {
  FitOutcome fit = fit_of({{log_of("a.csv", 20, ",ddx,ddy,ddheading", false)}});
  // the same fit, had its first log observed ẍ and its second the heading's acceleration alone
  const Observations& all = fit.file.observations.front();
  const auto observed = [&](int row) {
    return Observations(all.states(), View{View::Quantity::constrained_acceleration, {row}}, all.values().row(row),
                        VectorXd::Constant(1, 0.1));
  };
  ModelValues values = fit.posterior.values();
  values.noise_stddev = {VectorXd::Constant(1, 0.1), VectorXd::Constant(1, 0.2)};
  const Posterior posterior(fit.posterior.prior(), {observed(0), observed(2)}, values);

  EvaluateOutcome outcome = evaluate(fit.file, posterior, log_of("test.csv", 9, ",ddx,ddy,ddheading", false), {});
  EXPECT_THAT(outcome.evaluation.outputs, ElementsAre("ddx", "ddheading"));
  EXPECT_THAT(outcome.notes, Contains(HasSubstr("test.csv: not compared: ddy, which the fit did not observe; `outputs` of an "
                                                "evaluation chooses others")));

  outcome = evaluate(fit.file, posterior, log_of("test.csv", 9, ",ddheading", false), {});
  EXPECT_THAT(outcome.evaluation.outputs, ElementsAre("ddheading"));
  EXPECT_THAT(outcome.notes, Contains(HasSubstr("test.csv: not compared: ddx, which it lacks")));
  EXPECT_THAT(test::input_error_of([&] { evaluate(fit.file, posterior, log_of("test.csv", 9, ",ddy", false), {}); }),
              HasSubstr("missing column 'ddx'"));
}

TEST(EvaluateJob, CountsWhatTheConstraintDecidesAsDecided) {
  const FitOutcome fit = fit_of({{log_of("a.csv", 20, ",ddx,ddy,ddheading", false)}});
  // straight ahead ÿ follows from the constraint, and what is left of its deviation is rounding of sin 0
  const Evaluation straight = evaluate(fit.file, fit.posterior, log_of("s.csv", 8, ",ddx,ddy,ddheading", true), {}).evaluation;
  EXPECT_EQ(straight.n_zero_variance, 8);
  EXPECT_LT(straight.nlpd_latent, 50);
  const Evaluation turned = evaluate(fit.file, fit.posterior, log_of("t.csv", 8, ",ddx,ddy,ddheading", false), {}).evaluation;
  EXPECT_EQ(turned.n_zero_variance, 1) << "the first row of this log is straight";
}

TEST(EvaluateJob, CountsForcesThatCancelAsDecided) {
  Model carts = Model::parse(
      "coordinates = [\"x\", \"y\"]\ninputs = [\"clutch\"]\n[mechanics]\nmass = [[1, 0], [0, 2.3]]\n[constraints]\nvelocity = [{ "
      "expr = "
      "\"dx - dy\", when = \"clutch > 0.5\" }]\n[[latent]]\nfeatures = [\"x - y\"]\nkernel = \"se\"\ndirections = { force = "
      "[[\"1\"], "
      "[\"-1\"]] }\n[noise]\nddq = 0.03\n",
      "carts.toml");
  const auto log = [](double clutch) {
    std::string text = "x,y,dx,dy,clutch,ddx,ddy\n";
    for (int i = 0; i < 20; ++i) {
      const double e = std::sin(1.7 * i);
      text +=
          fmt::format("{},0.3,0.2,0.2,{},{},{}\n", 0.3 + e, clutch, clutch > 0.5 ? 0 : -3 * e, clutch > 0.5 ? 0 : 3 * e / 2.3);
    }
    return CsvTable::parse(text, "log.csv");
  };
  const FitOutcome fit = fit_of({{log(0)}}, std::move(carts));
  EXPECT_EQ(evaluate(fit.file, fit.posterior, log(0), {}).evaluation.n_zero_variance, 0);
  EXPECT_EQ(evaluate(fit.file, fit.posterior, log(1), {}).evaluation.n_zero_variance, 40);
}

TEST(EvaluateJob, ScoresPointsNearTheDataAndFarFromThemApart) {
  const FitOutcome fit = fit_of({{log_of("a.csv", 40, ",ddx,ddy,ddheading", false)}});
  // without the first, which is straight
  MatrixXd states = fit.posterior.observations().front().states().middleCols(1, 30);
  const MatrixXd targets = MatrixXd::Random(3, 30);
  states.rightCols(10).middleRows(3, 3) *= 30;
  const Evaluation both = evaluate_predictions(fit.posterior, states, {0, 1, 2}, targets);
  EXPECT_EQ(both.near.n, 20);
  EXPECT_EQ(both.far.n, 10);
  // the parts make the whole, output by output where those are alike
  for (const auto share : {&Calibration::coverage50, &Calibration::coverage80, &Calibration::coverage95}) {
    EXPECT_NEAR(both.*share, (20 * both.near.*share + 10 * both.far.*share) / 30, 1e-12);
  }
  EXPECT_LE(both.coverage50, both.coverage80);
  EXPECT_LE(both.coverage80, both.coverage95);
  EXPECT_NEAR(both.pit.sum(), 1, 1e-12);
  EXPECT_LE((both.pit - (20 * both.near.pit + 10 * both.far.pit) / 30).norm(), 1e-12);
  const Evaluation near = evaluate_predictions(fit.posterior, states.leftCols(20), {0, 1, 2}, targets.leftCols(20));
  EXPECT_NEAR(both.near.nrmse * row_stddev(targets).norm(), near.rmse.norm(), 1e-12);
  EXPECT_EQ(near.far.n, 0);
  EXPECT_TRUE(std::isnan(near.far.nrmse));
  EXPECT_TRUE(std::isnan(near.far.coverage50) && near.far.pit.array().isNaN().all());
}

TEST(Calibration, CountsTheErrorsWithinAndTheTenthsTheyFallInto) {
  VectorXd z(7);  // of Φ: .5, .691, .159, .992, NaN, 0 and 1 to rounding
  z << 0, 0.5, -1, 2.4, std::numeric_limits<double>::quiet_NaN(), -50, 50;
  EXPECT_LE((central_coverage(z, Eigen::Vector4d(0.3, 0.5, 0.8, 0.99)) - Eigen::Vector4d(1, 2, 3, 4) / 6).norm(), 1e-12);
  VectorXd expected(10);
  expected << 1, 1, 0, 0, 0, 1, 1, 0, 0, 2;
  EXPECT_LE((pit_histogram(z, 10) - expected / 6).norm(), 1e-12);
  EXPECT_TRUE(central_coverage(VectorXd(), Eigen::Vector2d(0.5, 0.9)).array().isNaN().all());
  EXPECT_TRUE(pit_histogram(VectorXd::Constant(1, std::nan("")), 10).array().isNaN().all());
}

// a slow motion: the state of a row is nearly that of the next
FitOutcome fit_of_slow_motion(std::optional<int> max_points = std::nullopt) {
  std::string text = "heading,dx,dy,dheading,ddx,ddheading\n";
  for (int i = 0; i < 60; ++i) {
    const double heading = 1.2 * std::sin(0.1 * i), speed = 1 + 0.9 * std::cos(0.07 * i), turn = std::cos(0.05 * i);
    text +=
        fmt::format("{},{},{},{},{},{}\n", heading, speed * std::cos(heading), speed * std::sin(heading), turn,
                    -speed * speed * std::cos(heading) - turn * speed * std::sin(heading), -std::sin(2 * turn) + 0.5 * heading);
  }
  FitRequest request;
  request.model = sledge();
  request.logs = {{CsvTable::parse(text, "slow.csv")}};
  request.problem.observe = {"ddx", "ddheading"};
  request.restarts = 1;
  request.problem.max_points = max_points;
  return run_fit(prepare_fit(std::move(request)));
}

TEST(CrossValidation, OfStretchesIsWorseThanOfSingleRowsOfASlowMotion) {
  const FitOutcome fit = fit_of_slow_motion();
  ASSERT_TRUE(fit.cross_validation && fit.cross_validation->stretches);
  const Evaluation::Part &rows = fit.cross_validation->one_by_one, &stretches = *fit.cross_validation->stretches;
  EXPECT_EQ(rows.n, 60);
  EXPECT_GT(stretches.nrmse, 1.2 * rows.nrmse);
  EXPECT_EQ(fit.cross_validation->text(),
            fmt::format("left out row by row: nrmse {:.3g}, 95 % coverage {:.3g}; in 5 stretches of the log: {:.3g}, {:.3g}",
                        rows.nrmse, rows.coverage95, stretches.nrmse, stretches.coverage95));

  // the same figures by a posterior that has not seen the stretch
  const Observations& all = fit.posterior.observations().front();
  double squares = 0;
  for (int b = 0; b < 5; ++b) {
    MatrixXd values = all.values();
    values.middleCols(12 * b, 12).setConstant(std::nan(""));
    const Posterior without(fit.posterior.prior(), {all.with_values(values)}, fit.posterior.values());
    squares += (without.mean(all.view(), all.states()) - all.values()).middleCols(12 * b, 12).squaredNorm();
  }
  EXPECT_NEAR(stretches.nrmse, std::sqrt(squares / 60) / row_stddev(all.values()).norm(), 1e-6);
}

TEST(CrossValidation, HasNoStretchesWithoutTimeOrder) {
  // rows that are chosen at random stay in the order of the log
  const FitOutcome some = fit_of_slow_motion(40);
  EXPECT_TRUE(some.cross_validation->stretches);
  const CrossValidation without = cross_validate(some.posterior, /*has_time_order=*/false);
  EXPECT_FALSE(without.stretches);
  EXPECT_THAT(without.text(), Not(HasSubstr("stretches")));
}

TEST(EvaluateJob, MeasuresByTheNoiseThatTheTestLogStates) {
  const FitOutcome fit = fit_of({{log_of("a.csv", 20, ",ddx,ddy,ddheading", false)}});
  EvaluateRequest request;
  request.outputs = {"ddx"};
  const CsvTable test = log_of("test.csv", 9, ",ddx", false), stated = log_of("test.csv", 9, ",ddx,ddx_std", false, "0.7");
  const Evaluation by_training = evaluate(fit.file, fit.posterior, test, request).evaluation;
  const Evaluation by_test = evaluate(fit.file, fit.posterior, stated, request).evaluation;
  EXPECT_EQ(by_training.rmse, by_test.rmse);
  // errors are far below 0.7, so that the density is that of its normalisation
  EXPECT_NEAR(by_test.nlpd, std::log(0.7) + 0.5 * std::log(2 * std::numbers::pi), 0.2);
  EXPECT_GT(std::abs(by_training.nlpd - by_test.nlpd), 0.3);
}

TEST(EvaluateJob, WarnsOfIntervalsThatHoldFewOfTheValues) {
  const FitOutcome fit = fit_of({{log_of("a.csv", 20, ",ddx,ddy,ddheading", false)}});
  EvaluateRequest request;
  request.outputs = {"ddx"};
  const auto warned = Contains(HasSubstr("% of the values lie within their 95 % intervals"));
  const CsvTable stated = log_of("test.csv", 40, ",ddx,ddx_std", false, "0.7"), test = log_of("test.csv", 40, ",ddx", false);
  EXPECT_THAT(evaluate(fit.file, fit.posterior, stated, request).notes, Not(warned));
  ModelValues values = fit.posterior.values();
  values.noise_stddev = {VectorXd::Constant(3, 1e-6)};
  const Posterior sure(fit.posterior.prior(), fit.posterior.observations(), values);
  EXPECT_THAT(evaluate(fit.file, sure, test, request).notes, warned);
}

TEST(EvaluateJob, TakesAFactorThatTrainingFoundForStatedNoise) {
  FitOutcome fit = fit_of({{log_of("a.csv", 20, ",ddx,ddx_std", false, "0.7")}});
  ModelValues values = fit.posterior.values();
  ASSERT_TRUE(fit.posterior.observations().front().states_noise(0));
  values.noise_stddev = {VectorXd::Constant(1, 3)};
  const Posterior posterior(fit.posterior.prior(), fit.posterior.observations(), values);
  EXPECT_EQ(measurement_noise(posterior, {0, 1}, 2, MatrixXd::Constant(2, 2, 0.5)),
            (MatrixXd(2, 2) << 1.5, 1.5, 0.5, 0.5).finished());
  const MatrixXd usual = measurement_noise(posterior, {0, 1}, 2);
  EXPECT_DOUBLE_EQ(usual(0, 1), 2.1);
  EXPECT_TRUE(std::isnan(usual(1, 0))) << "never observed";
}

// The text of a model names the file of its robot, in which the numbers stand.
TEST(SystemOfAFit, IsAnotherWhereItsRobotIsThoughTheTextsAreTheSame) {
  const auto arm = [](double mass) {
    RobotDescription robot;
    RobotDescription::Body& link = robot.bodies.emplace_back();
    link.name = "link";
    link.mass = mass;
    link.com = {0, 0, -0.5};
    link.joints.emplace_back().name = "q";
    link.joints.back().axis = Eigen::Vector3d::UnitY();
    return std::make_shared<const Model>(Model::parse("robot = 'arm.urdf'\n[[latent]]\nfeatures = ['dq']\ndirections = 'force'\n",
                                                      "arm.toml", RobotSource([&](const std::string&) { return robot; })));
  };
  const std::shared_ptr<const Model> same = arm(1), heavier = arm(3);
  FitFile fit;
  fit.model = *arm(1);
  const Prior prior = fit.prior();
  ASSERT_EQ(same->text, heavier->text);
  EXPECT_EQ(system_of(fit, prior, same).other_system, nullptr);
  EXPECT_NE(system_of(fit, prior, heavier).other_system, nullptr);
}

}  // namespace
}  // namespace gp2
