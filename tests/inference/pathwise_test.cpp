#include "gp2/inference/pathwise.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::evaluate_all;
using test::largest;
using test::Problem;
using test::Quantity;
using testing::AllOf;
using testing::HasSubstr;

constexpr std::uint64_t pathwise_seed = 70707;

const System& surface() { return *test::model("models/surface.toml").system; }
MatrixXd surface_states(int n) { return test::draw(test::model("models/surface.toml"), n, pathwise_seed + 1).states; }

TEST(PathwiseTest, HasTheMeanAndCovarianceOfThePosterior) {
  // over samples with features of their own they are exact, however few the features
  for (const Problem& p : test::problems(9, pathwise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, pathwise_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    const auto quantities = test::both_accelerations(*p.prior.system, p.queries);
    test::expect_moments(evaluate_all(sample_paths(posterior, 400, {40, pathwise_seed}), quantities),
                         posterior.joint(quantities));
  }
}

TEST(PathwiseTest, WithoutDataHasTheMeanAndCovarianceOfThePrior) {
  for (const Problem& p : test::problems(9, pathwise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, pathwise_seed));
    const Posterior prior = Posterior(p.prior, p.observations, p.values).without_data();
    const auto quantities = test::both_accelerations(*p.prior.system, p.queries);
    test::expect_moments(evaluate_all(sample_paths(prior, 400, {40, pathwise_seed}), quantities), prior.joint(quantities));
  }
}

TEST(PathwiseTest, ObeysGaussPrincipleSampleBySample) {
  for (const Problem& p : test::problems(9, pathwise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, pathwise_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    const auto quantities = test::both_accelerations(*p.prior.system, p.queries);
    test::expect_gauss_principle(evaluate_all(sample_paths(posterior, 10, {100, pathwise_seed}), quantities),
                                 require_mechanics(*p.prior.system, p.queries, p.values.parameters));
  }
}

TEST(PathwiseTest, ObeysTheConstraintAsTheMeanDoes) {
  const Posterior posterior = test::surface_posterior(pathwise_seed);
  const View ddq = View::all(Quantity::constrained_acceleration, surface());
  const MatrixXd states = surface_states(30);
  const VectorXd parameters = posterior.values().parameters;
  const double of_mean = max_constraint_error(surface(), states, parameters, posterior.mean(ddq, states));
  const PathwiseSamples paths = sample_paths(posterior, 1000, {200, pathwise_seed});
  double of_samples = 0;
  for (int s = 0; s < paths.n_samples(); ++s) {
    of_samples = std::max(of_samples, max_constraint_error(surface(), states, parameters, paths.evaluate(s, ddq, states)));
  }
  EXPECT_LE(of_samples, 10 * of_mean);
  RecordProperty("of_mean", fmt::format("{:.3g}", of_mean));
  RecordProperty("of_samples", fmt::format("{:.3g}", of_samples));
}

TEST(PathwiseTest, MeetsDataThatAreNearlyFreeOfNoise) {
  const double noise = 1e-4;
  const Posterior posterior = test::surface_posterior(pathwise_seed, noise);
  const Observations& data = posterior.observations()[0];
  const PathwiseSamples paths = sample_paths(posterior, 20, {500, pathwise_seed});
  for (int s = 0; s < paths.n_samples(); ++s) {
    // a sample is off the data by no more than the noise in them and what is left of the variance
    EXPECT_LE(largest(paths.evaluate(s, data.view(), data.states()) - data.values()), 8 * noise);
  }
  const MatrixXd away = surface_states(5);
  EXPECT_GT(largest(paths.evaluate(0, data.view(), away) - paths.evaluate(1, data.view(), away)), 100 * noise);
}

TEST(PathwiseTest, LatentsAddUpAndLeaveTheMean) {
  for (const Problem& p : test::problems(9, pathwise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, pathwise_seed));
    const System& system = *p.prior.system;
    const PathwiseSamples paths = sample_paths(Posterior(p.prior, p.observations, p.values), 2, {100, pathwise_seed});
    View view = View::all(Quantity::unconstrained_acceleration, system);
    const MatrixXd whole = paths.evaluate(1, view, p.queries);
    MatrixXd sum =
        evaluate_prior(p.prior, p.queries, p.values.parameters, require_mechanics(system, p.queries, p.values.parameters)).mean;
    for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
      view.latent = static_cast<int>(a);
      sum += paths.evaluate(1, view, p.queries);
    }
    EXPECT_LE(largest(sum - whole), 1e-13 * (1 + largest(whole) + largest(sum)));
  }
}

TEST(PathwiseTest, ActsUnderAnotherSystem) {
  const Model& home = test::model("models/surface.toml");
  const Model other = Model::parse(
      test::changed(home.text, {{"p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1)", "0.1*q1 - 0.15*q2 - 0.1*cos(3*q1)"}}),
      "another surface");
  const Posterior posterior = test::surface_posterior(pathwise_seed);
  const auto other_system = make_other_system(home, other);
  View there = View::all(Quantity::constrained_acceleration, *other.system);
  there.other_system = other_system;
  const View here = View::all(Quantity::constrained_acceleration, *home.system);
  const MatrixXd states = test::draw(other, 4, pathwise_seed).states;

  // the joint of both agrees with the samples, which obey the constraint there
  const std::vector<ViewAt> quantities = {{there, states}, {here, states}};
  const PathwiseSamples paths = sample_paths(posterior, 1000, {40, pathwise_seed});
  const MatrixXd samples = evaluate_all(paths, quantities);
  const Posterior::Joint joint = posterior.joint(quantities);
  test::expect_moments(samples, joint);
  test::expect_moments(posterior.sample(quantities, 1000, pathwise_seed), joint);
  const VectorXd parameters = other_system->parameters(posterior.values().parameters);
  for (const auto& sample : samples.topRows(there.size() * states.cols()).colwise()) {
    EXPECT_LE(max_constraint_error(*other.system, states, parameters, sample.reshaped(3, 4)), 1e-12);
  }
  EXPECT_GT(largest(samples.topRows(12) - samples.bottomRows(12)), 0.1) << "one and the same system";

  // the unconstrained acceleration is the same in both
  View a_bar = View::all(Quantity::unconstrained_acceleration, *home.system);
  const MatrixXd a_bar_here = paths.evaluate(0, a_bar, states);
  a_bar.other_system = other_system;
  EXPECT_EQ(paths.evaluate(0, a_bar, states), a_bar_here);
}

TEST(PathwiseTest, TheSameStateGivesTheSameBitsAloneOrAmongOthers) {
  for (const Problem& p : test::problems(9, pathwise_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, pathwise_seed));
    const View ddq = View::all(Quantity::constrained_acceleration, *p.prior.system);
    const PathwiseSamples paths = sample_paths(Posterior(p.prior, p.observations, p.values), 1, {100, pathwise_seed});
    const MatrixXd together = paths.evaluate(0, ddq, p.queries);
    EXPECT_EQ(together, paths.evaluate(0, ddq, p.queries));
    for (Index i = 0; i < p.queries.cols(); ++i) EXPECT_EQ(together.col(i), paths.evaluate(0, ddq, p.queries.col(i)));
  }
}

TEST(PathwiseTest, ASampleDependsOnTheSeedAndItsNumberAlone) {
  const Posterior posterior = test::surface_posterior(pathwise_seed);
  const View ddq = View::all(Quantity::constrained_acceleration, surface());
  const MatrixXd states = surface_states(5);
  const PathwiseSamples few = sample_paths(posterior, 3, {100, 1}), many = sample_paths(posterior, 21, {100, 1});
  const PathwiseSamples other = sample_paths(posterior, 3, {100, 2});
  for (int s = 0; s < 3; ++s) {
    EXPECT_EQ(few.evaluate(s, ddq, states), many.evaluate(s, ddq, states));
    EXPECT_NE(few.evaluate(s, ddq, states), other.evaluate(s, ddq, states));
  }
  EXPECT_NE(many.evaluate(0, ddq, states), many.evaluate(1, ddq, states));
}

TEST(PathwiseTest, ManyFeaturesMakeASampleGaussian) {
  // the fourth moment of one number over samples: 3 of a Gaussian; above it by E[(ψᵀψ)²]/k² − 1, about 1/n_features, before
  // conditioning, where the frequencies are random
  const Posterior prior = test::surface_posterior(pathwise_seed).without_data();
  const View a_bar{Quantity::unconstrained_acceleration, {0}};
  const MatrixXd states = surface_states(2);
  const PathwiseSamples paths = sample_paths(prior, 2000, {200, pathwise_seed});
  double squares = 0, fourth = 0;
  for (int s = 0; s < paths.n_samples(); ++s) {
    const MatrixXd f = paths.evaluate(s, a_bar, states);
    const double difference = f(0, 0) - f(0, 1);
    squares += difference * difference / paths.n_samples();
    fourth += std::pow(difference, 4) / paths.n_samples();
  }
  // five standard errors, √(96/S)
  EXPECT_NEAR(fourth / (squares * squares), 3, 5 * std::sqrt(96.0 / paths.n_samples()));
}

TEST(PathwiseTest, RefusesWhatMakesNoSense) {
  const Posterior posterior = test::surface_posterior(pathwise_seed);
  const View ddq = View::all(Quantity::constrained_acceleration, surface());
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(sample_paths(posterior, 0)); }),
              AllOf(HasSubstr("n_samples must be 1 or more"), HasSubstr("got 0")));
  EXPECT_THAT(test::input_error_of([&] {
                static_cast<void>(sample_paths(posterior, 1, {0, 1}));
              }),
              AllOf(HasSubstr("n_features must be 1 or more"), HasSubstr("got 0")));
  const PathwiseSamples paths = sample_paths(posterior, 2, {10, 1});
  for (const int sample : {-1, 2}) {
    EXPECT_THAT(test::input_error_of([&] { static_cast<void>(paths.evaluate(sample, ddq, surface_states(1))); }),
                AllOf(HasSubstr(fmt::format("sample {}", sample)), HasSubstr("there are 2 samples")));
  }
}

}  // namespace
}  // namespace gp2
