// More data for a fit, as a command and Python ask for it.
#include "gp2/jobs/update_job.hpp"

#include <cstdint>
#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "data_of_model.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using test::input_error_of;
using testing::HasSubstr;

constexpr const char* surface = "models/surface.toml";

CsvTable log_of(int n, std::uint64_t seed) { return test::drawn_log(surface, n, seed).table(); }

FitFile fit_of(const CsvTable& log) {
  FitRequest request;
  request.model = test::model(surface);
  request.logs = {{log, nullptr}};
  request.restarts = 1;
  request.max_iterations = 5;
  request.max_escapes = 0;
  return run_fit(prepare_fit(std::move(request))).file;
}

Observations more_of(const FitFile& fit, const CsvTable& log) {
  std::vector<std::string> notes;
  return more_observations(fit, fit.posterior(), log, {}, notes);
}

TEST(UpdateJob, AFitOfMoreIsThatOfAllUnderTheSameHyperparameters) {
  const FitFile fit = fit_of(log_of(30, 1));
  const UpdateOutcome updated = update(fit, {log_of(10, 2), log_of(5, 3)}, {});
  EXPECT_EQ(updated.n_added, 15);
  EXPECT_EQ(updated.n_states, 45);
  const test::TemporaryFolder folder;
  updated.fit.write(folder / "fit.json");
  const Posterior read = FitFile::read(folder / "fit.json").posterior();
  EXPECT_EQ(read.observations().size(), 1u) << "of one noise";
  EXPECT_EQ(read.observations().front().n_data(), 45);
  const Posterior grown = update(update(fit.posterior(), more_of(fit, log_of(10, 2))), more_of(fit, log_of(5, 3)));
  const View view = View::constrained_acceleration(*fit.model.system);
  const MatrixXd states = read.observations().front().states(), mean = grown.mean(view, states);
  EXPECT_LE((read.mean(view, states) - mean).cwiseAbs().maxCoeff(), 1e-8 * mean.cwiseAbs().maxCoeff());
}

TEST(UpdateJob, AWindowLeavesTheNewest) {
  const FitFile fit = fit_of(log_of(30, 1));
  const CsvTable log = log_of(10, 2);
  UpdateRequest request;
  request.window = 8;
  const UpdateOutcome updated = update(fit, {log}, request);
  EXPECT_EQ(updated.n_states, 8);
  EXPECT_EQ(updated.fit.observations.front().values(), more_of(fit, log).values().rightCols(8));
}

// of every draw of the hyperparameters, each with a noise of its own
TEST(UpdateJob, AWindowLetsTheFirstRowsGoWhereHyperparametersAreIntegrated) {
  FitRequest request;
  request.model = test::model(surface);
  request.logs = {{log_of(30, 1), nullptr}};
  request.restarts = 1;
  request.hyperparameters = HyperparameterChoice::integrate;
  request.problem.estimate_noise = true;
  const test::TemporaryFolder folder;
  FitFile fit = run_fit(prepare_fit(std::move(request))).file;
  UpdateRequest newest;
  newest.window = 12;
  for (std::uint64_t seed = 2; seed < 4; ++seed) {
    UpdateOutcome updated = update(std::move(fit), {log_of(12, seed)}, newest);
    EXPECT_EQ(updated.n_states, 12);
    ASSERT_EQ(updated.fit.observations.size(), 1U);
    updated.fit.write(folder / "fit.json");
    fit = FitFile::read(folder / "fit.json");
  }
}

TEST(UpdateJob, WhatCannotBeIsAnError) {
  const FitFile fit = fit_of(log_of(30, 1));
  const auto refused = [&](const UpdateRequest& request) {
    return input_error_of([&] { static_cast<void>(update(fit, {log_of(3, 2)}, request)); });
  };
  UpdateRequest none_left, fading, other, silent, unknown;
  silent.noise_stddev = 0;
  unknown.observe = {"ddq9"};
  EXPECT_EQ(refused(silent), "`noise_std`: must be positive and finite, got 0");
  EXPECT_THAT(refused(unknown), HasSubstr("`observe`: 'ddq9' is not an acceleration of "));
  none_left.window = 0;
  fading.forget = 0.5;
  other.observe = {"ddq1"};
  EXPECT_EQ(refused(none_left), "`window`: must be positive, got 0");
  EXPECT_THAT(refused(fading), HasSubstr("the oldest go by `window`"));
  EXPECT_THAT(refused(other), HasSubstr("give their noise standard deviation"));
}

}  // namespace
}  // namespace gp2
