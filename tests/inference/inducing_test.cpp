#include "gp2/inference/inducing.hpp"

#include <cmath>
#include <functional>
#include <numeric>
#include <stdexcept>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"

// Latents known through inducing points: with a point at every state all is as without, with fewer it is what the bound says.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t inducing_seed = 51117;

std::vector<Problem> exact_problems(int n = 9) { return test::problems(n, inducing_seed); }

InducingChoice chosen(const Problem& p, int most) {
  return choose_inducing_points(p.prior, p.observations, p.values, {.most = most, .left_out = 1e-12});
}

Problem with_points(Problem p, int most) {
  p.values.inducing = chosen(p, most).points;
  return p;
}

constexpr int all = 100'000;

TEST(Inducing, PointsAtEveryStateChangeNothing) {
  for (const Problem& p : exact_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    const Problem through = with_points(p, all);
    const test::Evaluated exact = test::evaluate(p), bound = test::evaluate(through);
    const double tolerance = test::rounding(p);
    EXPECT_NEAR(bound.value, exact.value, tolerance * (1 + std::abs(exact.value)));
    const auto expect_alike = [&](const auto& left, const auto& right) {
      for (std::size_t k = 0; k < left.size(); ++k) {
        EXPECT_LE(largest(left[k] - right[k]), 1e4 * tolerance * (1 + largest(right[k]) + std::abs(exact.value)));
      }
    };
    expect_alike(bound.gradient.log_kernel, exact.gradient.log_kernel);
    expect_alike(bound.gradient.log_signal_stddev, exact.gradient.log_signal_stddev);
    expect_alike(bound.gradient.log_noise_stddev, exact.gradient.log_noise_stddev);
    expect_alike(std::vector{bound.gradient.parameters}, std::vector{exact.gradient.parameters});

    const Posterior posterior = test::posterior_of(through), exact_posterior = test::posterior_of(p);
    EXPECT_NEAR(posterior.negative_log_likelihood(), exact.value, 1e2 * tolerance * (1 + std::abs(exact.value)));
    const View view = View::constrained_acceleration(*p.prior.system);
    const Posterior::Joint joint = posterior.joint(view, p.queries), expected = exact_posterior.joint(view, p.queries);
    EXPECT_LE(largest(joint.mean - expected.mean), 1e2 * tolerance * (1 + largest(expected.mean)));
    EXPECT_LE(largest(joint.covariance - expected.covariance), 1e2 * tolerance * (1 + largest(expected.covariance)));
    const VectorXd distance = posterior.distance_from_data(view, p.queries),
                   exact_distance = exact_posterior.distance_from_data(view, p.queries);
    if (exact_distance.allFinite()) {
      EXPECT_LE(largest(distance - exact_distance), 1e-9 * (1 + largest(exact_distance)));
    }
    constexpr int n_stretches = LeftOut::n_stretches;
    const LeftOut left_out = leave_out(posterior, n_stretches), expected_left_out = leave_out(exact_posterior, n_stretches);
    const auto expect_alike_left_out = [&](const std::vector<LeaveOneOut>& left, const std::vector<LeaveOneOut>& right) {
      ASSERT_EQ(left.size(), right.size());
      for (std::size_t g = 0; g < left.size(); ++g) {
        for (const auto part : {&LeaveOneOut::mean, &LeaveOneOut::variance}) {
          const MatrixXd& exactly = right[g].*part;
          const MatrixXd apart = exactly.array().isNaN().select(0, left[g].*part - exactly);
          EXPECT_LE(largest(apart), 1e4 * tolerance * (1 + largest(exactly.array().isNaN().select(0, exactly))));
        }
      }
    };
    expect_alike_left_out(left_out.values, expected_left_out.values);
    expect_alike_left_out(left_out.rows, expected_left_out.rows);
    if (!expected_left_out.stretches.empty()) expect_alike_left_out(left_out.stretches, expected_left_out.stretches);
    EXPECT_NEAR(left_out_by_points(p.prior, p.observations, through.values).sum(), 0, tolerance * (1 + std::abs(exact.value)));
  }
}

// Rounding of what is left of an immense variance would be worth thousands of nats, to an optimiser that looks for them.
TEST(Inducing, NothingIsGainedByRounding) {
  for (Problem p : exact_problems(40)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    for (VectorXd& stddev : p.values.signal_stddev) stddev *= 1e6;
    for (std::size_t a = 0; a < p.values.free_loading.size(); ++a) p.values.free_loading[a] *= 1e6;
    p = with_points(p, all);
    const VectorXd left_out = left_out_by_points(p.prior, p.observations, p.values);
    EXPECT_GE(left_out.minCoeff(), 0);
  }
}

TEST(Inducing, FewPointsGiveABoundThatRisesWithTheirNumber) {
  for (const Problem& p : exact_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    const double exact = test::evaluate(p).value, tolerance = test::rounding(p) * (1 + std::abs(exact));
    double before = std::numeric_limits<double>::infinity(), left_before = before;
    for (const int most : {4, 8, 16, 40, all}) {
      const InducingChoice choice = chosen(p, most);
      EXPECT_LE(choice.n_variables, most);
      EXPECT_LE(choice.left_out, left_before + tolerance);
      Problem through = p;
      through.values.inducing = choice.points;
      const double value = test::evaluate(through).value;
      EXPECT_GE(value, exact - tolerance);
      EXPECT_LE(value, before + tolerance);
      before = value;
      left_before = choice.left_out;
    }
  }
}

/// Problems of a discrepancy that is 0.7 of the noise in every direction.
std::vector<Problem> problems_of_a_discrepancy(double lengthscale) {
  std::vector<Problem> problems;
  for (Problem& p : exact_problems()) {
    if (!p.name.ends_with(", a discrepancy") || p.observations.size() > 1) continue;
    p.prior.latents.back().kernel_is_fixed = true;
    p.values.kernel.back().setConstant(lengthscale);
    p.values.signal_stddev.back().setConstant(0.7);
    p.values.noise_stddev[0] = VectorXd::LinSpaced(p.prior.system->nq(), 0.3, 1.7);  // as the discrepancy's deviations
    problems.push_back(std::move(p));
  }
  return problems;
}

/// With points at every state for the model's latents, and n for the discrepancy.
Problem with_points_of_discrepancy(Problem p, Index n) {
  p = with_points(p, all);
  auto points = std::make_shared<InducingPoints>(*p.values.inducing);
  points->features.back() = evaluate_features(p.prior, p.prior.latents.size() - 1, p.observations[0].states()).topRows(n).eval();
  p.values.inducing = points;
  return p;
}

// A discrepancy that no two states share is a larger noise: that is what becomes of it where it has no points.
TEST(Inducing, WhatPointsLeaveOutOfADiscrepancyIsNoise) {
  const std::vector<Problem> problems = problems_of_a_discrepancy(1e-3);
  EXPECT_EQ(problems.size(), 3U);
  for (const Problem& p : problems) {
    for (const Index n : {0, 3}) {
      SCOPED_TRACE(fmt::format("{}, {} points, seed {}", p.name, n, inducing_seed));
      const Problem through = with_points_of_discrepancy(p, n);
      const test::Evaluated exact = test::evaluate(p), bound = test::evaluate(through);
      const double tolerance = 1e2 * test::rounding(p) * (1 + std::abs(exact.value));
      EXPECT_NEAR(bound.value, exact.value, tolerance);
      for (std::size_t a = 0; a < p.prior.latents.size(); ++a)
        EXPECT_NEAR(bound.gradient.log_signal_stddev[a].sum(), exact.gradient.log_signal_stddev[a].sum(), 1e2 * tolerance);
      EXPECT_LE(largest(bound.gradient.log_kernel[0] - exact.gradient.log_kernel[0]), 1e2 * tolerance);
      EXPECT_LE(largest(bound.gradient.parameters - exact.gradient.parameters),
                1e2 * tolerance * (1 + largest(exact.gradient.parameters)));

      const Posterior posterior = test::posterior_of(through), exact_posterior = test::posterior_of(p);
      EXPECT_NEAR(posterior.negative_log_likelihood(), exact.value, tolerance);
      const View view = View::constrained_acceleration(*p.prior.system);
      const Posterior::Joint joint = posterior.joint(view, p.queries), expected = exact_posterior.joint(view, p.queries);
      EXPECT_LE(largest(joint.mean - expected.mean), tolerance * (1 + largest(expected.mean)));
      EXPECT_LE(largest(joint.covariance - expected.covariance), tolerance * (1 + largest(expected.covariance)));
      const LeftOut left_out = leave_out(posterior, LeftOut::n_stretches),
                    wanted = leave_out(exact_posterior, LeftOut::n_stretches);
      for (const auto part : {&LeaveOneOut::mean, &LeaveOneOut::variance}) {
        EXPECT_LE(largest(left_out.values[0].*part - wanted.values[0].*part),
                  1e2 * tolerance * (1 + largest(wanted.values[0].*part)));
        EXPECT_LE(largest(left_out.rows[0].*part - wanted.rows[0].*part), 1e2 * tolerance * (1 + largest(wanted.rows[0].*part)));
      }
    }
  }
}

TEST(Inducing, TheNoiseOfADiscrepancyHasDerivatives) {
  for (Problem p : problems_of_a_discrepancy(1)) {
    p.values.noise_stddev[0].reverseInPlace();  // no longer in proportion to the deviations
    p = with_points_of_discrepancy(std::move(p), 3);
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    const test::Evaluated at = test::evaluate(p);
    const auto expect_slope = [&](const char* what, double slope, const std::function<void(Problem&, double)>& move) {
      const auto moved = [&](double step) {
        Problem q = p;
        move(q, step);
        return test::evaluate(q).value;
      };
      // rounding of 1e-12 over a step of 1e-5, and its square
      EXPECT_NEAR((moved(1e-5) - moved(-1e-5)) / 2e-5, slope, 1e-6 * (1 + std::abs(slope) + std::abs(at.value))) << what;
    };
    expect_slope("size", at.gradient.log_signal_stddev.back().sum(),
                 [](Problem& q, double step) { q.values.signal_stddev.back() *= std::exp(step); });
    expect_slope("noise", at.gradient.log_noise_stddev[0][0],
                 [](Problem& q, double step) { q.values.noise_stddev[0][0] *= std::exp(step); });
    expect_slope("signal", at.gradient.log_signal_stddev[0][0],
                 [](Problem& q, double step) { q.values.signal_stddev[0][0] *= std::exp(step); });
  }
}

TEST(Inducing, PredictorsAndSamplesSeeThePosterior) {
  for (const Problem& p : exact_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    test::expect_predictor_and_paths(test::posterior_of(with_points(p, 12)), p, {200, inducing_seed});
  }
}

TEST(Inducing, PosteriorsGrowByMoreObservations) {
  int n_grown = 0;
  for (const Problem& p : exact_problems()) {
    if (p.observations.size() > 1) continue;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    const Problem through = with_points(p, 20);
    const Observations& group = p.observations.front();
    if (group.noise().has_scale()) continue;
    const std::vector<int> first = {0, 1, 2, 3}, rest = {4, 5, 6, 7, 8};
    Observations added = group.take(rest);
    added = Observations(added.states(), added.view(), added.values(), p.values.noise_stddev.front());
    Posterior grown = update(Posterior(p.prior, {group.take(first)}, through.values), added);
    const Posterior anew = test::posterior_of(through);
    const double tolerance = 1e2 * test::rounding(p);
    EXPECT_NEAR(grown.negative_log_likelihood(), anew.negative_log_likelihood(),
                tolerance * (1 + std::abs(anew.negative_log_likelihood())));
    const View view = View::constrained_acceleration(*p.prior.system);
    EXPECT_LE(largest(grown.mean(view, p.queries) - anew.mean(view, p.queries)),
              tolerance * (1 + largest(anew.mean(view, p.queries))));
    try {
      static_cast<void>(remove_oldest(std::move(grown), 1));
      ADD_FAILURE() << "removed";
    } catch (const InputError& error) {
      EXPECT_STREQ(
          error.what(),
          "remove_oldest: what was learned through inducing points cannot be taken away, since the observations themselves "
          "are not kept; `forget` discounts it");
    }
    ++n_grown;
  }
  EXPECT_GT(n_grown, 5);
}

// the first problem of one Observations of ddq, with many states
Problem of_many_states(int n) {
  for (Problem& p : exact_problems(n)) {
    if (p.observations.size() == 1 && p.observations.front().view().is_of_ddq()) return with_points(std::move(p), 12);
  }
  throw std::logic_error("no such problem");
}

TEST(Inducing, AllOfManyStatesAreLearnedFromAndSomeAreKept) {
  const Problem p = of_many_states(5'200);
  const Posterior posterior(p.prior, p.observations, p.values);
  EXPECT_EQ(posterior.n_states(), 5'200);
  EXPECT_EQ(posterior.observations().front().n_data(), 2600) << "every second";
  EXPECT_EQ(posterior.observations().front().states().col(1), p.observations.front().states().col(2));
  EXPECT_NEAR(posterior.negative_log_likelihood(), test::evaluate(p).value, 1e-9 * std::abs(test::evaluate(p).value));

  const View view = View::constrained_acceleration(*p.prior.system);
  const Posterior on_threads(p.prior, p.observations, p.values, 3);
  EXPECT_EQ(on_threads.marginal(view, p.queries).covariance, posterior.marginal(view, p.queries).covariance);

  // in halves, one after the other
  std::vector<int> first(2600), rest(2600);
  std::iota(first.begin(), first.end(), 0);
  std::iota(rest.begin(), rest.end(), 2600);
  const Observations& group = p.observations.front();
  const Observations more = group.take(rest);
  const Posterior grown = update(Posterior(p.prior, {group.take(first)}, p.values),
                                 {more.states(), more.view(), more.values(), p.values.noise_stddev.front()});
  EXPECT_EQ(grown.n_states(), 5'200);
  EXPECT_LE(grown.observations().front().n_data(), 5000);
  const MatrixXd mean = posterior.mean(view, p.queries);
  EXPECT_LE(largest(grown.mean(view, p.queries) - mean), 1e-9 * (1 + largest(mean)));

  const LeftOut left_out = leave_out(posterior, LeftOut::n_stretches);
  EXPECT_EQ(left_out.stretches.front().mean.cols(), 2600);
  EXPECT_TRUE(leave_out(grown, LeftOut::n_stretches).stretches.empty()) << "what came later is of no stretch";
}

// A fast move of a few states among many slow ones, of which those taken evenly are none.
TEST(Inducing, WhatIsRareHasPointsOfItsOwn) {
  Problem p = of_many_states(4'000);
  const Observations& given = p.observations.front();
  MatrixXd states = given.states();
  const MatrixXd fast = states.middleCols(1'001, 9);
  states *= 0.02;
  states.middleCols(1'001, 9) = fast;
  p.observations = {Observations(states, given.view(), given.values(), given.noise())};
  const InducingOptions options{.n_candidates = 400};
  const auto left_out = [&](const InducingChoice& choice) {
    p.values.inducing = choice.points;
    return left_out_by_points(p.prior, p.observations, p.values).sum();
  };
  const InducingChoice choice = choose_inducing_points(p.prior, p.observations, p.values, options);
  EXPECT_LE(left_out(choice), 2 * options.left_out);
  EXPECT_NEAR(choice.left_out, left_out(choice), options.left_out);
  std::vector<int> slow;
  for (int i = 0; i < 4'000; i += 10) slow.push_back(i);
  EXPECT_GT(left_out(choose_inducing_points(p.prior, {p.observations.front().take(slow)}, p.values, options)), 10);
}

// The power of a Gaussian density is one of a larger noise, but for a constant.
TEST(Inducing, WhatIsForgottenCountsAsIfItsNoiseHadBeenLarger) {
  int n_forgotten = 0;
  for (const Problem& p : exact_problems()) {
    if (p.observations.size() > 1 || p.observations.front().view().latent) continue;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inducing_seed));
    constexpr double share = 0.25;
    Problem through = with_points(p, 12), noisier = through;
    for (VectorXd& stddev : noisier.values.noise_stddev) stddev /= std::sqrt(share);
    if (p.prior.system->has_constraint_noise()) continue;
    const Posterior faded = forget(test::posterior_of(through), share), expected = test::posterior_of(noisier);
    const View view = View::constrained_acceleration(*p.prior.system);
    const Posterior::Marginal got = faded.marginal(view, p.queries), wanted = expected.marginal(view, p.queries);
    const double tolerance = 1e2 * test::rounding(p);
    EXPECT_LE(largest(got.mean - wanted.mean), tolerance * (1 + largest(wanted.mean)));
    EXPECT_LE(largest(got.covariance - wanted.covariance), tolerance * (1 + largest(wanted.covariance)));
    constexpr int n_stretches = LeftOut::n_stretches;
    const LeftOut left_out = leave_out(faded, n_stretches), wanted_out = leave_out(expected, n_stretches);
    for (const auto values : {&LeftOut::values, &LeftOut::rows, &LeftOut::stretches}) {
      for (const auto part : {&LeaveOneOut::mean, &LeaveOneOut::variance}) {
        const MatrixXd &is = (left_out.*values).front().*part, &should_be = (wanted_out.*values).front().*part;
        EXPECT_LE(largest(is - should_be), 1e2 * tolerance * (1 + largest(should_be)));
      }
    }
    // a summary knows them together only
    const Posterior read = Posterior::of_summary(p.prior, faded.observations(), {faded.values()}, *faded.summary());
    EXPECT_TRUE(leave_out(read, n_stretches).stretches.empty());
    ++n_forgotten;
  }
  EXPECT_GT(n_forgotten, 5);
  const Problem p = exact_problems().front();
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(forget(test::posterior_of(with_points(p, 5)), 0)); }),
              testing::HasSubstr("a share is above 0 and at most 1, got 0"));
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(forget(test::posterior_of(p), 0.5)); }),
              testing::HasSubstr("the oldest go by `window`"));
}

// Where a machine rests, rounding of b is all that there is of it: whether constraints contradict each other is not told by a block alone.
TEST(Inducing, AStretchAtRestIsNoContradiction) {
  const auto p = [] {
    for (Problem& one : exact_problems(600)) {
      if (one.prior.system->name().find("redundant") != std::string::npos) return std::move(one);
    }
    throw std::logic_error("no such problem");
  }();
  MatrixXd states = p.observations.front().states();
  const StateLayout layout = p.prior.system->layout();
  states.block(layout.dq(0), 0, layout.nq, 300) *= 1e-9;
  Problem resting = p;
  resting.observations = {p.observations.front().with_states(states)};
  const double exact = test::evaluate(resting).value;
  ASSERT_TRUE(std::isfinite(exact));
  const double bound = test::evaluate(with_points(resting, all)).value;
  EXPECT_GE(bound, exact - 1e-6 * std::abs(exact));
  EXPECT_TRUE(std::isfinite(bound));
}

TEST(Inducing, BadRequestsAreErrors) {
  const Problem any = exact_problems().front(), through = with_points(any, 5);
  const Likelihood likelihood(any.prior, any.observations, through.values, {});
  Likelihood::Workspace workspace;
  EXPECT_EQ(test::input_error_of([&] { likelihood.evaluate(any.values, nullptr, workspace); }),
            "values: the likelihood was made through inducing points, and these have none");
  const Problem p = exact_problems().front();
  const auto choose = [&](InducingOptions options) {
    return test::input_error_of([&] { static_cast<void>(choose_inducing_points(p.prior, p.observations, p.values, options)); });
  };
  EXPECT_THAT(choose({.most = 0}), testing::HasSubstr("must be 1 point or more"));
  EXPECT_THAT(choose({.left_out = 0}), testing::HasSubstr("left_out must be positive"));
  EXPECT_THAT(choose({.n_candidates = 0}), testing::HasSubstr("n_candidates"));
  Problem other = p;
  other.values.inducing = std::make_shared<InducingPoints>();
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(test::posterior_of(other)); }), testing::HasSubstr("inducing"));
}

}  // namespace
}  // namespace gp2
