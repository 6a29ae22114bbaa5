#include "gp2/training/robust.hpp"

#include <set>

#include <gmock/gmock.h>

#include "gp2/inference/evaluation.hpp"
#include "gp2/simulation/generate.hpp"
#include "test_models.hpp"

// Fits of data some of which are wrong.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t robust_seed = 40731;

struct Data {
  const Model& model;
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
  std::set<std::pair<Index, Index>> wrong;  // (row, state)

  void set_hyperparameters() { hyperparameters = default_hyperparameters(prior, without_gross_errors(observations), {}, {}); }
};

// accelerations of a system with the noise of its model file
Data data_of(const std::string& file, int n) {
  const Model& model = test::model(file);
  Data data{model, make_prior(model), {}, {}, {}};
  const VectorXd noise = Eigen::Map<const VectorXd>(model.noise.stddev.data(), static_cast<Index>(model.noise.stddev.size()));
  const GeneratedData drawn = generate(model, {n, robust_seed, noise});
  data.observations.push_back(
      {drawn.states, View::all(View::Quantity::constrained_acceleration, *model.system), drawn.accelerations, noise});
  data.set_hyperparameters();
  return data;
}

// a share of the values, or of the states with all values, moved by 5 to 15 spreads of their row, either way
Data with_outliers(Data data, double share, bool whole_states) {
  MatrixXd values = data.observations.front().values();
  const VectorXd spread = row_stddev(values);
  RandomStream random(robust_seed);
  for (Index i = 0; i < values.cols(); ++i) {
    const bool is_wrong = random.uniform() < share;
    for (Index k = 0; k < values.rows(); ++k) {
      if (!(whole_states ? is_wrong : random.uniform() < share)) continue;
      values(k, i) += (random.uniform() < 0.5 ? -1 : 1) * (5 + 10 * random.uniform()) * spread[k];
      data.wrong.emplace(k, i);
    }
  }
  data.observations.front() = data.observations.front().with_values(values);
  data.set_hyperparameters();
  return data;
}

FitOptions quick_robust() {
  FitOptions options;
  options.n_restarts = 1;
  options.max_escapes = 1;
  return options;
}

double error_of(const Data& data, const Posterior& posterior) {
  const GeneratedData truth = generate(data.model, {200, robust_seed + 1, VectorXd::Zero(data.model.system->nq())});
  std::vector<int> rows = data.observations.front().view().rows;
  return evaluate_predictions(posterior, truth.states, rows, truth.accelerations).nrmse;
}

TEST(RobustTest, AValueThatHasNoSquareIsLeftOut) {
  const Data data = data_of("models/unicycle.toml", 40);
  for (const double absurd : {1e101, 1e160, 1e300}) {
    MatrixXd values = data.observations.front().values();
    values(1, 7) = -absurd;
    const auto fit_of = [&](const std::vector<Observations>& observations) {
      const std::vector<Observations> usual = without_gross_errors(observations);
      return fit_robust(data.prior, observations, default_hyperparameters(data.prior, usual, {}, {}), quick_robust());
    };
    const Fit found = fit_of({data.observations.front().with_values(values)});
    ASSERT_FALSE(found.report.distrusted.empty()) << absurd;
    const DistrustedValue& first = found.report.distrusted.front();
    EXPECT_EQ(std::pair(first.row, first.state), std::pair(1, 7));
    EXPECT_GT(first.distance, absurd);
    EXPECT_TRUE(std::isnan(found.posterior.observations().front().values()(1, 7)));

    values(1, 7) = std::numeric_limits<double>::quiet_NaN();
    EXPECT_EQ(found.report.objective, fit_of({data.observations.front().with_values(values)}).report.objective) << absurd;
  }
}

TEST(RobustTest, OutliersAreFoundAndTheFitIsNearlyThatOfCleanData) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml"}) {
    SCOPED_TRACE(fmt::format("{}, seed {}", file, robust_seed));
    const Data clean = data_of(file, 100);
    const double error_clean =
        error_of(clean, fit(clean.prior, clean.observations, clean.hyperparameters, quick_robust()).posterior);
    for (const bool whole_states : {false, true}) {
      SCOPED_TRACE(whole_states ? "all values of some states" : "some values");
      const Data dirty = with_outliers(clean, 0.05, whole_states);
      ASSERT_GT(dirty.wrong.size(), 5U);
      const double error_plain =
          error_of(dirty, fit(dirty.prior, dirty.observations, dirty.hyperparameters, quick_robust()).posterior);
      const Fit robust = fit_robust(dirty.prior, dirty.observations, dirty.hyperparameters, quick_robust());
      const double error_robust = error_of(dirty, robust.posterior);
      std::set<std::pair<Index, Index>> found;
      for (const DistrustedValue& value : robust.report.distrusted) found.emplace(value.row, value.state);
      int n_missed = 0;
      for (const auto& value : dirty.wrong) n_missed += found.contains(value) ? 0 : 1;
      const int n_false = static_cast<int>(found.size() - dirty.wrong.size()) + n_missed;
      EXPECT_LE(error_robust, 1.3 * error_clean);
      EXPECT_GE(error_plain, 2 * error_robust) << "the outliers do no harm: nothing is tested";
      EXPECT_LE(n_missed, 1);
      EXPECT_LE(n_false, 2);
    }
  }
}

TEST(RobustTest, NoiseThatIsEstimatedIsThatOfAllOtherValues) {
  Data clean = data_of("models/surface.toml", 60);
  const Observations group = clean.observations.front();
  clean.observations.front() = group.with_noise(Noise(group.noise().stddev(), /*estimated=*/true));
  Data dirty = clean;
  MatrixXd values = group.values();
  const double spread = row_stddev(values)[0];
  values(0, 5) += 1.5 * spread, values(0, 20) -= 2 * spread, values(0, 40) += 3 * spread;
  dirty.observations.front() = clean.observations.front().with_values(values);
  const auto noise_of = [](Data& data) {
    data.set_hyperparameters();
    const Fit robust = fit_robust(data.prior, data.observations, data.hyperparameters, quick_robust());
    return std::pair(robust.posterior.values().noise_stddev.front()[0], robust.report.distrusted.size());
  };
  const auto of_clean = noise_of(clean), of_dirty = noise_of(dirty);
  EXPECT_EQ(of_dirty.second, of_clean.second + 3);
  EXPECT_NEAR(of_dirty.first / of_clean.first, 1, 0.2);
}

TEST(RobustTest, NoValueIsDistrustedThatItsNoiseExplains) {
  const Data dirty = with_outliers(data_of("models/surface.toml", 40), 0.05, false);
  const Fit robust = fit_robust(dirty.prior, dirty.observations, dirty.hyperparameters, quick_robust(), {.threshold = 0.5});
  ASSERT_FALSE(robust.report.distrusted.empty());
  for (const DistrustedValue& value : robust.report.distrusted) EXPECT_GT(value.noise_factor, 1);
}

TEST(RobustTest, ThroughInducingPointsEachDrawHasSumsOfItsOwn) {
  const Data clean = data_of("models/surface.toml", 40);
  FitOptions options = quick_robust();
  options.max_iterations = 10;
  options.n_inducing = 20;
  options.n_draws = 2;
  const Fit robust = fit_robust(clean.prior, clean.observations, clean.hyperparameters, options);
  ASSERT_TRUE(robust.report.draws.has_value());
  EXPECT_EQ(robust.posterior.n_components(), robust.report.draws->size());
  EXPECT_EQ(posterior_of(clean.prior, robust.posterior.observations(), robust.report).negative_log_likelihood(),
            robust.posterior.negative_log_likelihood());
}

// Parameters of constraints are not drawn: they are those of the report in every draw, under which the fit has its posterior.
TEST(RobustTest, WhatIsNotDrawnIsTheSameInReportAndDraws) {
  Data data = with_outliers(data_of("models/surface.toml", 40), 0.03, false);
  data.hyperparameters = default_hyperparameters(data.prior, without_gross_errors(data.observations), {"p1", "p2"}, {});
  FitOptions options = quick_robust();
  options.max_iterations = 15;
  options.n_draws = 4;
  const FitReport report = fit_robust(data.prior, data.observations, data.hyperparameters, options).report;
  ASSERT_TRUE(report.draws.has_value());
  int n_held = 0;
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const auto at = static_cast<Index>(k);
    if (!report.hyperparameters[k].is_system_parameter()) continue;
    ++n_held;
    EXPECT_TRUE((report.draws->values.row(at).array() == report.hyperparameters[k].value).all());
    EXPECT_EQ(report.draws->r_hat[at], 1);
  }
  EXPECT_EQ(n_held, 2);
}

TEST(RobustTest, OfCleanDataNextToNothingIsDistrusted) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml"}) {
    SCOPED_TRACE(fmt::format("{}, seed {}", file, robust_seed));
    const Data clean = data_of(file, 100);
    const Fit plain = fit(clean.prior, clean.observations, clean.hyperparameters, quick_robust());
    const Fit robust = fit_robust(clean.prior, clean.observations, clean.hyperparameters, quick_robust());
    // 300 Gaussian values have one beyond 4 σ in one of fifty data sets
    EXPECT_LE(robust.report.distrusted.size(), 1U);
    EXPECT_LE(error_of(clean, robust.posterior), 1.05 * error_of(clean, plain.posterior));
  }
}

}  // namespace
}  // namespace gp2
