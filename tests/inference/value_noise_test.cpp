#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"
#include "observations_testing.hpp"

// Observations whose values have a noise each.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t value_noise_seed = 40411;

std::vector<Problem> value_noise_problems() {
  std::vector<Problem> all;
  for (const Problem& p : test::problems(9, value_noise_seed))
    all.push_back(test::with_noise_scale(p, value_noise_seed + all.size()));
  return all;
}

TEST(ValueNoiseTest, TheLikelihoodIsTheDenseMultivariateNormalDensity) {
  for (const Problem& p : value_noise_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    const double dense = test::dense_negative_log_likelihood(p);
    EXPECT_NEAR(test::evaluate(p).value, dense, test::rounding(p) * (1 + std::abs(dense)));
    EXPECT_NEAR(test::posterior_of(p).negative_log_likelihood(), dense, test::rounding(p) * (1 + std::abs(dense)));
    EXPECT_LT(test::rounding(p), 1e-6) << "too badly conditioned to test anything";
  }
}

TEST(ValueNoiseTest, ThePosteriorIsTheTextbookGaussianProcess) {
  for (const Problem& p : value_noise_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    const auto [mean, covariance] = test::dense_posterior(p, test::every_acceleration(p), p.queries);
    const Posterior::Joint joint = test::posterior_of(p).joint(test::every_acceleration(p), p.queries);
    EXPECT_LE(largest(joint.mean - mean), test::rounding(p) * (1 + largest(mean)));
    EXPECT_LE(largest(joint.covariance - covariance), test::rounding(p) * (1 + largest(covariance)));
  }
}

TEST(ValueNoiseTest, AScaleOfOneChangesNoBit) {
  for (const Problem& p : test::problems(9, value_noise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    Problem scaled = p;
    for (Observations& group : scaled.observations) {
      group = test::with_scale(group, MatrixXd::Ones(group.values().rows(), group.values().cols()));
    }
    const test::Evaluated expected = test::evaluate(p), got = test::evaluate(scaled);
    EXPECT_EQ(got.value, expected.value);
    EXPECT_EQ(got.gradient.log_kernel, expected.gradient.log_kernel);
    EXPECT_EQ(got.gradient.log_noise_stddev, expected.gradient.log_noise_stddev);
    EXPECT_EQ(got.gradient.parameters, expected.gradient.parameters);
    const Posterior plain = test::posterior_of(p), of_scaled = test::posterior_of(scaled);
    EXPECT_EQ(of_scaled.negative_log_likelihood(), plain.negative_log_likelihood());
    EXPECT_EQ(of_scaled.mean(test::every_acceleration(p), p.queries), plain.mean(test::every_acceleration(p), p.queries));
  }
}

TEST(ValueNoiseTest, OnlyTheProductOfFactorAndScaleCounts) {
  for (const Problem& p : value_noise_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    Problem other = p;
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      other.observations[g] = test::with_scale(p.observations[g], 3 * p.observations[g].noise().scale());
      other.values.noise_stddev[g] /= 3;
    }
    const test::Evaluated expected = test::evaluate(p), got = test::evaluate(other);
    EXPECT_NEAR(got.value, expected.value, test::rounding(p) * (1 + std::abs(expected.value)));
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      EXPECT_LE(largest(got.gradient.log_noise_stddev[g] - expected.gradient.log_noise_stddev[g]),
                test::rounding(p) * (1 + largest(expected.gradient.log_noise_stddev[g])));
      EXPECT_FALSE(expected.gradient.log_noise_stddev[g].isZero(1e-3));
    }
    const MatrixXd mean = test::posterior_of(p).mean(test::every_acceleration(p), p.queries);
    EXPECT_LE(largest(test::posterior_of(other).mean(test::every_acceleration(p), p.queries) - mean),
              test::rounding(p) * (1 + largest(mean)));
  }
}

TEST(ValueNoiseTest, AValueOfVastNoiseSaysNothing) {
  for (Problem p : value_noise_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    Problem without = p;
    for (Problem* each : {&p, &without}) {
      each->observations.erase(each->observations.begin() + 1, each->observations.end());
      each->values.noise_stddev.resize(1);
    }
    // its pull on the mean falls with the square of the noise: 1e-14 is below rounding
    MatrixXd vast = p.observations[0].noise().scale();
    vast.col(0).setConstant(1e7);
    p.observations[0] = test::with_scale(p.observations[0], vast);
    without.observations[0].remove_first(1);
    const MatrixXd expected = test::posterior_of(without).mean(test::every_acceleration(p), p.queries);
    const MatrixXd got = test::posterior_of(p).mean(test::every_acceleration(p), p.queries);
    EXPECT_LE(largest(got - expected), (1e-11 + test::rounding(without)) * (1 + largest(expected)));
  }
}

TEST(ValueNoiseTest, APosteriorThatGrowsAndShrinksIsTheOneBuiltAnew) {
  for (const Problem& p : value_noise_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, value_noise_seed));
    const auto columns = [&](std::size_t g, const auto& some) {
      const Observations& all = p.observations[g];
      return Observations{MatrixXd(all.states()(Eigen::all, some)),
                          all.view(),
                          MatrixXd(all.values()(Eigen::all, some)),
                          p.values.noise_stddev[g],
                          false,
                          MatrixXd(all.noise().scale()(Eigen::all, some))};
    };
    Posterior posterior = test::posterior_of(p).without_data();
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      posterior = update(std::move(posterior), columns(g, Eigen::seq(0, 1)));
      posterior = update(std::move(posterior), columns(g, Eigen::seq(2, Eigen::last)));
    }
    ASSERT_EQ(posterior.observations().size(), p.observations.size()) << "one noise and view is one group";
    const auto expect_equal = [&](const Problem& anew) {
      const Posterior expected = test::posterior_of(anew);
      EXPECT_NEAR(posterior.negative_log_likelihood(), expected.negative_log_likelihood(),
                  test::rounding(p) * (1 + std::abs(expected.negative_log_likelihood())));
      const MatrixXd mean = expected.mean(test::every_acceleration(p), p.queries);
      EXPECT_LE(largest(posterior.mean(test::every_acceleration(p), p.queries) - mean), test::rounding(p) * (1 + largest(mean)));
      EXPECT_EQ(posterior.observations()[0].noise().scale(), anew.observations[0].noise().scale());
    };
    expect_equal(p);
    posterior = remove_oldest(std::move(posterior), 2);
    Problem rest = p;
    rest.observations[0] = columns(0, Eigen::seq(2, Eigen::last));
    expect_equal(rest);
  }
}

TEST(ValueNoiseTest, ValuesOfOneNoiseAndOfTheirOwnAreGroupsApart) {
  const Problem p = value_noise_problems().front();
  const Observations plain = p.observations[0].with_noise(Noise(p.values.noise_stddev[0]));
  Posterior posterior = update(test::posterior_of(p), plain);
  ASSERT_EQ(posterior.observations().size(), 2U);
  EXPECT_FALSE(posterior.observations()[1].noise().has_scale());
  posterior = remove_oldest(std::move(posterior), plain.n_data());
  EXPECT_EQ(posterior.observations()[0].n_data(), 0);
  EXPECT_TRUE(std::isfinite(posterior.negative_log_likelihood()));
}

TEST(ValueNoiseTest, TheUsualNoiseIsTheMedian) {
  Observations group(MatrixXd::Zero(1, 3), {Quantity::constrained_acceleration, {0, 1}}, MatrixXd::Zero(2, 3), VectorXd::Ones(2),
                     false, (MatrixXd(2, 3) << 1, 2, 9, 5, 3, 4).finished());
  EXPECT_EQ(group.usual_noise(Eigen::Vector2d(10, 1)), Eigen::Vector2d(20, 4));
  EXPECT_EQ(group.noise_at(Eigen::Vector2d(10, 1), 2), Eigen::Vector2d(90, 4));
  group = test::with_scale(group, {});
  EXPECT_EQ(group.usual_noise(Eigen::Vector2d(10, 1)), Eigen::Vector2d(10, 1));
  EXPECT_EQ(group.noise_at(Eigen::Vector2d(10, 1), 2), Eigen::Vector2d(10, 1));
}

TEST(ValueNoiseTest, AnEvaluationMeasuresByTheUsualNoise) {
  for (const Problem& p : value_noise_problems()) {
    const View every = View::all(Quantity::constrained_acceleration, *p.prior.system);
    if (!(p.observations[0].view() == every)) continue;
    const MatrixXd targets = MatrixXd::Zero(every.size(), p.queries.cols());
    const Posterior posterior = test::posterior_of(p);
    const Posterior::Marginal prediction = posterior.marginal(every, p.queries);
    const VectorXd noise = p.observations[0].usual_noise(p.values.noise_stddev[0]);
    const Eigen::ArrayXXd variance = prediction.stddev().array().square().colwise() + noise.array().square();
    const double expected =
        0.5 * (prediction.mean.array().square() / variance + variance.log() + std::log(2 * std::numbers::pi)).mean();
    EXPECT_NEAR(evaluate_predictions(posterior, p.queries, every.rows, targets).nlpd, expected, 1e-12 * (1 + std::abs(expected)));
    return;
  }
  FAIL() << "no problem observes every acceleration";
}

TEST(ValueNoiseTest, AScaleOfTheWrongShapeOrSignIsRefused) {
  const Problem p = value_noise_problems().front();
  const auto refused = [&](const auto& change) {
    MatrixXd scale = p.observations[0].noise().scale();
    change(scale);
    return test::input_error_of([&] { test::with_scale(p.observations[0], scale); });
  };
  const Index d = p.observations[0].values().rows(), n = p.observations[0].values().cols();
  EXPECT_EQ(refused([&](MatrixXd& scale) { scale = MatrixXd::Ones(d, n - 1); }),
            fmt::format("noise_scale must hold one number for each of the {} × {} values, got {} × {}; leave it empty where each "
                        "row has one noise",
                        d, n, d, n - 1));
  const std::string rule = "noise_scale must be positive and finite, got {}; a value that is worth nothing is NaN, not measured";
  EXPECT_EQ(refused([](MatrixXd& scale) { scale(0, 1) = 0; }), fmt::format(fmt::runtime(rule), 0));
  EXPECT_EQ(refused([](MatrixXd& scale) { scale(0, 1) = -2; }), fmt::format(fmt::runtime(rule), -2));
  EXPECT_EQ(refused([](MatrixXd& scale) { scale(0, 1) = std::nan(""); }), fmt::format(fmt::runtime(rule), "nan"));
}

}  // namespace
}  // namespace gp2
