// Many rows learned through inducing points, as it is asked of a fit.
#include <algorithm>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "data_of_model.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/update_job.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using test::input_error_of;
using testing::Contains;
using testing::HasSubstr;

constexpr const char* surface = "models/surface.toml";  // two of three directions are free

FitRequest request_of_rows(int n, const char* model = surface) {
  FitRequest request = test::fit_request(test::model(model), {test::drawn_log(model, n, 4).table()});
  request.max_escapes = 0;
  request.threads = 2;
  return request;
}

int n_inducing(int n, const std::function<void(FitRequest&)>& change) {
  FitRequest request = request_of_rows(n);
  change(request);
  return prepare_fit(std::move(request)).options.n_inducing;
}

TEST(InducingFit, AutoIsExactWhereThatTakesMinutes) {
  const auto as_it_is = [](FitRequest&) {};
  const int n = largest_exact_size / 2;
  EXPECT_EQ(n_inducing(n, as_it_is), 0);
  EXPECT_EQ(n_inducing(n + 1, as_it_is), most_inducing_variables);
  EXPECT_EQ(n_inducing(n + 1, [](FitRequest& request) { request.is_exact = true; }), 0);
  EXPECT_EQ(n_inducing(n + 1, [](FitRequest& request) { request.problem.protocol.name = Protocol::Name::paper; }), 0);
  EXPECT_EQ(n_inducing(n + 1, [](FitRequest& request) { request.problem.robust = true; }), most_inducing_variables);
  EXPECT_EQ(n_inducing(n + 1, [](FitRequest& request) { request.problem.max_points = 20; }), 0);
}

TEST(InducingFit, AnEvaluationOfAMillionRowsTakesFewerVariables) {
  EXPECT_EQ(automatic_inducing_variables(1'000), most_inducing_variables);
  EXPECT_EQ(automatic_inducing_variables(100'000), most_inducing_variables);
  EXPECT_EQ(automatic_inducing_variables(1'000'000), 316);
}

TEST(InducingFit, AsManyAsAskedForUnlessExactTakesLess) {
  EXPECT_EQ(n_inducing(50, [](FitRequest& request) { request.inducing = 60; }), 60);
  EXPECT_EQ(n_inducing(50, [](FitRequest& request) { request.inducing = 100; }), 0);
}

TEST(InducingFit, WhatDoesNotGoWithPointsIsRefused) {
  const auto refused = [](const std::function<void(FitRequest&)>& change) {
    return input_error_of([&] {
      n_inducing(12, [&](FitRequest& request) {
        request.inducing = 5;
        change(request);
      });
    });
  };
  for (const double number : {0.0, -1.0, 2.5, 1e9}) {
    EXPECT_EQ(refused([&](FitRequest& request) { request.inducing = number; }),
              fmt::format("`inducing`: expected a whole number from 1 to 100000, 'auto' or 'none', got '{}'", number));
  }
  EXPECT_EQ(refused([](FitRequest& request) {
              request.problem.baseline = Baseline::Kind::icm, request.problem.mean = Prior::Mean::zero;
            }),
            "`inducing` is not for a `baseline`");
}

TEST(InducingFit, TellsWhatIsLeftOutAndItsFileGivesItAgain) {
  FitRequest request = request_of_rows(500);
  request.inducing = 80;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  const InducingReport& inducing = outcome.file.report.inducing.value();
  EXPECT_LE(inducing.n_variables, 80);
  EXPECT_THAT(outcome.notes, Contains(HasSubstr(fmt::format("learned with {} inducing variables", inducing.n_variables))));
  ASSERT_TRUE(outcome.cross_validation && outcome.cross_validation->stretches);
  EXPECT_NEAR(outcome.cross_validation->one_by_one.coverage95, 0.95, 0.04);
  const test::TemporaryFolder folder;
  outcome.file.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  const View view = View::constrained_acceleration(*outcome.file.model.system);
  const MatrixXd& states = outcome.posterior.observations().front().states();
  EXPECT_EQ(read.posterior().marginal(view, states).covariance, outcome.posterior.marginal(view, states).covariance);
  // and again, from its options and data
  const FitOutcome again = run_fit(prepare_fit_again(read, 1));
  EXPECT_EQ(again.posterior.mean(view, states), outcome.posterior.mean(view, states));
}

TEST(InducingFit, OfFewRowsSaysThatItStartsOnce) {
  for (const int restarts : {1, 3}) {
    FitRequest request = request_of_rows(50);
    request.inducing = 20;
    request.restarts = restarts;
    request.max_iterations = 3;
    const std::vector<std::string> notes = run_fit(prepare_fit(std::move(request))).notes;
    const auto says_so = Contains(HasSubstr("`restarts` are not used; exact (`inducing=none`) they are"));
    EXPECT_EQ(testing::Value(notes, says_so), restarts > 1);
  }
}

TEST(InducingFit, ItsCheckpointIsTheBestSoFarOfAllRows) {
  const test::TemporaryFolder folder;
  FitRequest request = request_of_rows(1200);
  request.inducing = 40;
  request.thin = false;
  request.checkpoint = folder / "last.json";
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_GT(outcome.file.report.inducing->n_start, 0);
  const FitFile last = FitFile::read(folder / "last.json");
  EXPECT_EQ(last.report.termination, FitReport::interrupted);
  EXPECT_EQ(last.n_states(), outcome.file.n_states());
  // of fits that are as good to half a nat the one through fewer points is taken
  EXPECT_LE(last.report.objective, outcome.file.report.objective);
  EXPECT_NEAR(last.report.objective, outcome.file.report.objective, 0.5);
  EXPECT_NEAR(last.posterior().negative_log_likelihood(), last.report.negative_log_likelihood, 1e-3);
}

FitOutcome fit_of_6000_rows(const char* model, int n_inducing) {
  FitRequest request = request_of_rows(6000, model);
  request.inducing = n_inducing;
  request.train_on = 300;
  return run_fit(prepare_fit(std::move(request)));
}

// A fit of 6000 rows is as good from its file as it was, and goes on from there.
void expect_goes_on_from_its_file(const FitOutcome& outcome, const char* model, const test::TemporaryFolder& folder) {
  EXPECT_EQ(outcome.posterior.n_states(), 6000);
  EXPECT_EQ(outcome.file.report.negative_log_likelihood, outcome.posterior.negative_log_likelihood()) << "of all rows";
  ASSERT_TRUE(outcome.cross_validation && outcome.cross_validation->stretches);
  EXPECT_NEAR(outcome.cross_validation->stretches->coverage95, 0.95, 0.02);
  outcome.file.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  EXPECT_THAT(read.n_states(), testing::ElementsAre(6000));
  const Posterior posterior = read.posterior();
  EXPECT_EQ(posterior.n_states(), 6000);
  const View view = View::constrained_acceleration(*outcome.file.model.system);
  const MatrixXd states = outcome.posterior.observations().front().states().leftCols(50);
  EXPECT_EQ(posterior.marginal(view, states).covariance, outcome.posterior.marginal(view, states).covariance);
  const CrossValidation scores = cross_validate(read, posterior);
  EXPECT_EQ(scores.one_by_one.nrmse, outcome.cross_validation->one_by_one.nrmse);
  EXPECT_EQ(scores.stretches->nrmse, outcome.cross_validation->stretches->nrmse);

  // more of the same, kept in a file too
  const UpdateOutcome updated = update(read, {test::drawn_log(model, 200, 5).table()}, {});
  EXPECT_EQ(updated.n_added, 200);
  EXPECT_EQ(updated.n_states, 6200);
  updated.fit.write(folder / "more.json");
  const FitFile more = FitFile::read(folder / "more.json");
  EXPECT_THAT(more.n_states(), testing::ElementsAre(6200));
  EXPECT_FALSE(more.report.inducing->stretches) << "they were of other data";
  EXPECT_LE(more.posterior().marginal(view, states).stddev().mean(), posterior.marginal(view, states).stddev().mean());
}

TEST(InducingFit, AFileOfManyRowsHoldsWhatTheySayAndSomeOfThem) {
  const test::TemporaryFolder folder;
  const FitOutcome outcome = fit_of_6000_rows(surface, 40);
  expect_goes_on_from_its_file(outcome, surface, folder);
  const FitFile read = FitFile::read(folder / "fit.json");
  EXPECT_EQ(read.observations.front().n_data(), 3000);
  const View view = View::constrained_acceleration(*outcome.file.model.system);
  const MatrixXd states = outcome.posterior.observations().front().states().leftCols(50);
  EXPECT_EQ(read.posterior().distance_from_data(view, states), outcome.posterior.distance_from_data(view, states));
  EXPECT_THAT(input_error_of([&] { static_cast<void>(prepare_fit_again(read)); }),
              HasSubstr("`again`: the file contains sums over 6000 rows, and only 3000 of the rows; give its logs with `data`"));
}

constexpr const char* bead =
    "experiments/mechanisms/rubbing_bead.toml";  // friction presses on its constraint; one direction is free

TEST(InducingFit, AutoIsThroughPointsWherePriorsAreNotLinear) {
  const auto n_inducing_of_bead = [](int n) { return prepare_fit(request_of_rows(n, bead)).options.n_inducing; };
  EXPECT_EQ(n_inducing_of_bead(largest_exact_size), 0);
  EXPECT_EQ(n_inducing_of_bead(largest_exact_size + 1), most_inducing_variables);
}

TEST(InducingFit, OfFrictionThatPressesOnItsConstraintGoesOnFromItsFile) {
  expect_goes_on_from_its_file(fit_of_6000_rows(bead, 30), bead, test::TemporaryFolder());
}

TEST(InducingFit, HyperparametersDrawnFromSomeRowsMixWhatAllTell) {
  FitRequest request = request_of_rows(300);
  request.inducing = 40;
  request.problem.estimate = {"m"};
  request.problem.estimate_noise = true;
  request.hyperparameters = HyperparameterChoice::integrate;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  const FitReport& report = outcome.file.report;
  ASSERT_TRUE(report.draws && report.inducing);
  EXPECT_EQ(report.draws->size(), n_mixed_draws_through_points);
  EXPECT_EQ(outcome.posterior.n_components(), n_mixed_draws_through_points);
  for (std::size_t h = 0; h < report.hyperparameters.size(); ++h) {
    const auto k = static_cast<Eigen::Index>(h);
    const Hyperparameter::Kind kind = report.hyperparameters[h].kind;
    const bool all_tell = kind == Hyperparameter::Kind::parameter || kind == Hyperparameter::Kind::noise_stddev;
    EXPECT_EQ(report.draws->is_drawn(k), !all_tell) << report.hyperparameters[h].name;
    EXPECT_TRUE(!all_tell || report.draws->values(k, 0) == report.hyperparameters[h].value);
  }
  EXPECT_GT(report.uncertainty.value().stddev.maxCoeff(), 0) << "what is not known of m, by all rows";
  const test::TemporaryFolder folder;
  outcome.file.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  const View view = View::constrained_acceleration(*outcome.file.model.system);
  const MatrixXd& states = outcome.posterior.observations().front().states();
  EXPECT_EQ(read.posterior().marginal(view, states).covariance, outcome.posterior.marginal(view, states).covariance);
  // each component is conditioned on all rows
  const UpdateOutcome updated = update(read, {test::drawn_log(surface, 200, 5).table()}, {});
  EXPECT_EQ(updated.n_states, 500);
  const Posterior more = updated.fit.posterior();
  for (int k = 0; k < n_mixed_draws_through_points; ++k) {
    EXPECT_LT(more.component(k).marginal(view, states).stddev().mean(),
              outcome.posterior.component(k).marginal(view, states).stddev().mean());
  }
}

int n_points_of_discrepancy(const char* model) {
  FitRequest request = request_of_rows(1000, model);
  request.inducing = 400;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_EQ(outcome.file.prior().latents.back().name, "discrepancy");
  EXPECT_LE(outcome.file.report.inducing->n_variables, 400);
  return static_cast<int>(outcome.file.report.inducing->points->features.back().rows());
}

// No latent of the arm can be its true friction, which many rows tell; the surface's can.
TEST(InducingFit, ADiscrepancyOfWhichTheRowsTellMuchHasPointsOfItsOwn) {
  EXPECT_GT(n_points_of_discrepancy("models/arm_on_moving_plane.toml"), 20);
  EXPECT_EQ(n_points_of_discrepancy(surface), 0);
}

std::vector<int> distrusted_states(int n, const std::vector<int>& wrong, double inducing, int max_iterations) {
  test::LogData log = test::drawn_log(surface, n, 4);
  for (const int i : wrong) log.accelerations(1, i) += 30;
  FitRequest request = request_of_rows(12);
  request.logs = {{log.table(), nullptr}};
  request.problem.robust = true;
  request.inducing = inducing;
  request.max_iterations = max_iterations;
  const FitReport report = run_fit(prepare_fit(std::move(request))).file.report;
  EXPECT_EQ(report.inducing.has_value(), inducing < 2 * n);
  std::vector<int> states;
  for (const DistrustedValue& value : report.distrusted) states.push_back(value.state);
  std::sort(states.begin(), states.end());
  return states;
}

TEST(InducingFit, OfARobustOneDistrustsTheSame) {
  const std::vector<int> wrong{10, 60, 110, 160};
  EXPECT_EQ(distrusted_states(200, wrong, 100, 1000), wrong);
  EXPECT_EQ(distrusted_states(200, wrong, 1000, 1000), wrong);
}

// of which every second is kept
TEST(InducingFit, OfARobustOneOf6000RowsDistrustsThoseThatAreNotKeptToo) {
  const std::vector<int> wrong{10, 1001, 2002, 5999};
  EXPECT_THAT(distrusted_states(6000, wrong, 40, 5), testing::IsSupersetOf(wrong));
}

}  // namespace
}  // namespace gp2
