#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"
#include "observations_testing.hpp"

// Observations of which sums over states are measured: all that is inferred from them is that of the textbook's Gaussian.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;
using testing::HasSubstr;

constexpr std::uint64_t sums_seed = 40717;

// half of them with sums in every group, half beside groups without
std::vector<Problem> summed_problems() {
  std::vector<Problem> all;
  for (const Problem& p : test::problems(9, sums_seed)) {
    if (!p.prior.system->has_constraint_noise()) all.push_back(test::with_sums(p, all.size() % 2 == 0, sums_seed + all.size()));
  }
  return all;
}

TEST(Sums, HaveTheLikelihoodAndThePosteriorOfTheTextbook) {
  for (const Problem& p : summed_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sums_seed));
    const Posterior posterior = test::posterior_of(p);
    const double expected = test::dense_negative_log_likelihood(p), tolerance = test::rounding(p);
    EXPECT_NEAR(posterior.negative_log_likelihood(), expected, tolerance * (1 + std::abs(expected)));
    EXPECT_NEAR(test::evaluate(p).value, expected, tolerance * (1 + std::abs(expected)));
    for (const Quantity quantity : {Quantity::unconstrained_acceleration, Quantity::constrained_acceleration}) {
      const View view = View::all(quantity, *p.prior.system);
      const auto [mean, covariance] = test::dense_posterior(p, view, p.queries);
      const Posterior::Joint joint = posterior.joint(view, p.queries);
      EXPECT_LE(largest(joint.mean - mean), tolerance * (1 + largest(mean)));
      EXPECT_LE(largest(joint.covariance - covariance), tolerance * (1 + largest(covariance)));
    }
  }
}

TEST(Sums, OfOneValueEachAreThatValue) {
  for (const Problem& p : test::problems(9, sums_seed)) {
    if (p.prior.system->has_constraint_noise()) continue;
    Problem summed = p;
    for (Observations& group : summed.observations) {
      std::vector<WeightedSum> sums;
      for (int i = 0; i < group.n_data(); ++i) {
        for (int k = 0; k < group.view().size(); ++k) {
          sums.push_back({k, i, VectorXd::Ones(1), group.values()(k, i), VectorXd::Ones(1)});
        }
      }
      group = group.with_sums(std::move(sums));
    }
    const test::Evaluated one = test::evaluate(p), other = test::evaluate(summed);
    const double tolerance = test::rounding(p);
    EXPECT_NEAR(other.value, one.value, tolerance * (1 + std::abs(one.value)));
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      const VectorXd& noise = one.gradient.log_noise_stddev[g];
      EXPECT_LE(largest(other.gradient.log_noise_stddev[g] - noise), 100 * tolerance * (1 + largest(noise)));
    }
  }
}

TEST(Sums, AreSeenByPredictorsAndSamplesAlike) {
  for (const Problem& p : summed_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sums_seed));
    test::expect_predictor_and_paths(test::posterior_of(p), p, {40, sums_seed});
  }
}

TEST(Sums, GrowByOrdinaryValuesAndDoNotShrink) {
  for (const Problem& p : test::problems(9, sums_seed)) {
    if (p.prior.system->has_constraint_noise() || p.observations.size() > 1) continue;
    Problem both = p;
    both.observations = {test::with_sums(p, true, sums_seed).observations.front(), p.observations.front()};
    both.values.noise_stddev = {p.values.noise_stddev.front(), p.values.noise_stddev.front()};
    const Observations added(p.observations.front().states(), p.observations.front().view(), p.observations.front().values(),
                             p.values.noise_stddev.front());
    Posterior grown = update(Posterior(p.prior, {both.observations.front()},
                                       [&] {
                                         ModelValues values = both.values;
                                         values.noise_stddev.pop_back();
                                         return values;
                                       }()),
                             added);
    const Posterior anew = test::posterior_of(both);
    EXPECT_NEAR(grown.negative_log_likelihood(), anew.negative_log_likelihood(),
                test::rounding(both) * (1 + std::abs(anew.negative_log_likelihood())));
    const View view = test::every_acceleration(p);
    EXPECT_LE(largest(grown.mean(view, p.queries) - anew.mean(view, p.queries)),
              test::rounding(both) * (1 + largest(anew.mean(view, p.queries))));
    EXPECT_THROW(static_cast<void>(remove_oldest(std::move(grown), 1)), InputError);
  }
}

// with noise of their own the sums over a state are left out by leaving them out
TEST(Sums, OverAStateSayNothingWhereItIsLeftOut) {
  std::size_t n_left_out = 0;
  for (const Problem& p : summed_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sums_seed));
    Problem alone = p;
    std::vector<WeightedSum> sums = p.observations.front().sums();
    for (WeightedSum& sum : sums) sum.noise = sum.noise.tail(1).eval();
    alone.observations.front() = p.observations.front().with_sums(sums);
    if (p.observations.size() > 1) continue;
    const std::vector<LeaveOneOut> left_out = leave_one_out(test::posterior_of(alone));
    for (const int i : {0, 2}) {
      Problem without = alone;
      std::vector<WeightedSum> others;
      for (const WeightedSum& sum : sums) {
        if (i < sum.first || i >= sum.first + sum.weights.size()) others.push_back(sum);
      }
      n_left_out += sums.size() - others.size();
      without.observations.front() = p.observations.front().with_sums(others);
      const View& view = p.observations.front().view();
      const MatrixXd state = p.observations.front().states().col(i);
      const Posterior::Marginal expected = test::posterior_of(without).marginal(view, state);
      const double tolerance = test::rounding(p);
      EXPECT_LE(largest(left_out[0].mean.col(i) - expected.mean), tolerance * (1 + largest(expected.mean)));
      EXPECT_LE(largest(left_out[0].variance.col(i) - expected.stddev().cwiseAbs2()),
                tolerance * (1 + largest(expected.stddev().cwiseAbs2())));
    }
  }
  EXPECT_GT(n_left_out, 10U);
}

TEST(Sums, SayWhatIsWrongWithThem) {
  const Problem p = test::problems(9, sums_seed).front();
  const Observations& group = p.observations.front();
  const WeightedSum good{0, 0, VectorXd::Ones(2), 1, VectorXd::Ones(1)};
  const auto expect = [&](const WeightedSum& one, const char* text) {
    EXPECT_THAT(test::input_error_of([&] { static_cast<void>(group.with_sums({good, one})); }), HasSubstr(text));
  };
  const auto changed = [&](auto change) {
    WeightedSum one = good;
    change(one);
    return one;
  };
  expect(changed([&](auto& one) { one.row = group.view().size(); }), "observations: sum 2 is of row");
  expect(changed([&](auto& one) { one.first = group.n_data() - 1; }), "sum 2 is of row");
  expect(changed([](auto& one) { one.value = std::nan(""); }), "finite");
  expect(changed([](auto& one) { one.noise[0] = 0; }), "positive");
  expect(changed([](auto& one) { one.noise = VectorXd::Ones(3); }), "of the same row before it");
  if (group.view().size() > 1) {
    expect(changed([](auto& one) {
             one.row = 1;
             one.noise = VectorXd::Ones(2);
           }),
           "of the same row before it");
  }
  EXPECT_THROW(static_cast<void>(group.with_sums({good}).take({0})), InputError);
  FitOptions through_points, on_some;
  through_points.n_inducing = 5;
  on_some.n_train = 2;
  for (const FitOptions& options : {through_points, on_some}) {
    EXPECT_EQ(test::input_error_of([&] { fit(p.prior, {group.with_sums({good})}, {}, options); }),
              "fit: observations that have sums over states are learned from all together; leave out n_inducing and n_train");
  }
}

}  // namespace
}  // namespace gp2
