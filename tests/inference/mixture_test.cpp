#include <algorithm>
#include <cmath>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "allocation_count.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;

constexpr std::uint64_t mixture_seed = 40508;

// three draws about the values of a problem; those of the system stay, where the problem cannot bear others
std::vector<ModelValues> drawn_values(const Problem& p) {
  std::vector<ModelValues> values;
  for (const double factor : {1.0, 1.7, 0.6}) {
    ModelValues& one = values.emplace_back(p.values);
    for (VectorXd& kernel : one.kernel) kernel *= factor;
    for (VectorXd& signal : one.signal_stddev) signal /= factor;
  }
  return values;
}

Posterior mixture_of(const Problem& p) { return Posterior::mixture(p.prior, p.observations, drawn_values(p)); }

View constrained(const Problem& p) { return View::constrained_acceleration(*p.prior.system); }

// Each component has its own noise for what is added with the noise of the mixture.
TEST(Mixture, WhatIsAddedWithItsNoiseJoinsTheGroupAndOldDataLeaveIt) {
  int n_problems = 0;
  for (const Problem& p : test::problems(9, mixture_seed)) {
    const Observations& all = p.observations.front();
    if (p.observations.size() > 1 || all.n_data() < 3) continue;
    ++n_problems;
    SCOPED_TRACE(p.name);
    std::vector<ModelValues> values = drawn_values(p);
    for (std::size_t k = 0; k < values.size(); ++k) values[k].noise_stddev.front() *= 1 + 0.2 * static_cast<double>(k);
    const auto mixture = [&](int first, int n) { return Posterior::mixture(p.prior, {all.slice(first, n)}, values); };
    const int n = all.n_data() - 1;
    Posterior grown = mixture(0, n);
    Observations last = all.slice(n, 1);
    last = last.with_noise(Noise(grown.noise_stddev(0), false, last.noise().scale()));
    grown = update(std::move(grown), last);
    ASSERT_EQ(grown.observations().size(), 1U);
    const View view = test::every_acceleration(p);
    const auto expect_same = [&](const Posterior& is, const Posterior& expected) {
      const auto a = is.marginal(view, p.queries), b = expected.marginal(view, p.queries);
      EXPECT_LE(test::largest(a.mean - b.mean), test::rounding(p) * (1 + test::largest(b.mean)));
      EXPECT_LE(test::largest(a.covariance - b.covariance), test::rounding(p) * (1 + test::largest(b.covariance)));
    };
    expect_same(grown, mixture(0, n + 1));
    expect_same(remove_oldest(std::move(grown), n), mixture(n, 1));
  }
  EXPECT_GT(n_problems, 5);
}

TEST(Mixture, OfOneComponentIsItToTheBit) {
  for (const Problem& p : test::problems(9, mixture_seed)) {
    SCOPED_TRACE(p.name);
    const Posterior one = test::posterior_of(p), mixture = Posterior::mixture(p.prior, p.observations, {p.values});
    const View view = constrained(p);
    EXPECT_EQ(mixture.mean(view, p.queries), one.mean(view, p.queries));
    EXPECT_EQ(mixture.marginal(view, p.queries).covariance, one.marginal(view, p.queries).covariance);
    EXPECT_EQ(mixture.joint(view, p.queries).covariance, one.joint(view, p.queries).covariance);
    EXPECT_EQ(mixture.sample({{view, p.queries}}, 3, 1), one.sample({{view, p.queries}}, 3, 1));
  }
}

TEST(Mixture, HasTheMomentsOfItsComponents) {
  for (const Problem& p : test::problems(9, mixture_seed)) {
    SCOPED_TRACE(p.name);
    const Posterior mixture = mixture_of(p);
    const View view = constrained(p);
    VectorXd mean = VectorXd::Zero(view.size() * p.queries.cols());
    MatrixXd square = MatrixXd::Zero(mean.size(), mean.size());
    for (int k = 0; k < mixture.n_components(); ++k) {
      const Posterior::Joint one = mixture.component(k).joint(view, p.queries);
      mean += one.mean / 3;
      square += (one.covariance + one.mean * one.mean.transpose()) / 3;
    }
    const MatrixXd covariance = square - mean * mean.transpose();
    const double tolerance = 1e-12 * (1 + test::largest(square));
    const Posterior::Joint joint = mixture.joint(view, p.queries);
    EXPECT_LE(test::largest(joint.mean - mean), tolerance);
    EXPECT_LE(test::largest(joint.covariance - covariance), tolerance);
    EXPECT_LE(test::largest(mixture.mean(view, p.queries).reshaped() - mean), tolerance);
    const Posterior::Marginal marginal = mixture.marginal(view, p.queries, 2);
    EXPECT_LE(test::largest(marginal.mean.reshaped() - mean), tolerance);
    EXPECT_LE(test::largest(marginal.stddev().reshaped().cwiseAbs2() - joint.covariance.diagonal()),
              test::rounding(p) * (1 + test::largest(square)));
  }
}

TEST(Mixture, SamplesAreOfItsComponents) {
  const Problem p = test::problems(1, mixture_seed).front();
  const Posterior mixture = mixture_of(p);
  const View view = constrained(p);
  constexpr int n = 6000;
  const MatrixXd samples = mixture.sample({{view, p.queries}}, n, 3);
  const Posterior::Joint joint = mixture.joint(view, p.queries);
  const VectorXd mean = samples.rowwise().mean();
  const VectorXd variance = (samples.colwise() - mean).rowwise().squaredNorm() / n;
  for (Index k = 0; k < mean.size(); ++k) {
    EXPECT_NEAR(mean[k], joint.mean[k], 5 * std::sqrt(joint.covariance(k, k) / n) + 1e-12);
    EXPECT_NEAR(variance[k], joint.covariance(k, k), 0.2 * joint.covariance(k, k) + 1e-12);
  }
  // whole functions too, and each by its number alone
  const PathwiseSamples few = sample_paths(mixture, 3, {200, 5}), more = sample_paths(mixture, 9, {200, 5});
  for (int s = 0; s < 3; ++s) EXPECT_EQ(few.evaluate(s, view, p.queries), more.evaluate(s, view, p.queries));
}

TEST(Mixture, ThePredictorSaysTheSameAndAllocatesNothing) {
  for (const Problem& p : test::problems(9, mixture_seed)) {
    SCOPED_TRACE(p.name);
    const Posterior mixture = mixture_of(p);
    const View view = constrained(p);
    const Posterior::Marginal marginal = mixture.marginal(view, p.queries);
    const MatrixXd expected = marginal.stddev();
    const Predictor predictor(mixture);
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(view.size()), stddev(view.size());
    MatrixXd jacobian(view.size(), p.queries.rows());
    for (Index i = 0; i < p.queries.cols(); ++i) {
      const VectorXd state = p.queries.col(i);
      Predictor::Status status{};
      EXPECT_EQ(test::allocations_of([&] { status = predictor.mean_and_stddev(state, mean, stddev, workspace); }), 0);
      ASSERT_EQ(status, Predictor::Status::ok);
      const double tolerance = test::rounding(p) * (1 + test::largest(expected) + test::largest(marginal.mean));
      EXPECT_LE(test::largest(mean - marginal.mean.col(i)), tolerance);
      EXPECT_LE(test::largest(stddev - expected.col(i)), std::sqrt(tolerance) * 1e-3 + tolerance);
      MatrixXd covariance(view.size(), view.size());
      EXPECT_EQ(test::allocations_of([&] { status = predictor.mean_and_covariance(state, mean, covariance, workspace); }), 0);
      EXPECT_LE(test::largest(covariance.reshaped() - marginal.covariance.col(i)),
                test::rounding(p) * (1 + test::largest(marginal.covariance)));
      EXPECT_EQ(test::allocations_of([&] { status = predictor.mean_and_jacobian(state, mean, jacobian, workspace); }), 0);
      MatrixXd sum = MatrixXd::Zero(jacobian.rows(), jacobian.cols());
      for (int k = 0; k < 3; ++k) {
        const Predictor one(mixture.component(k));
        Predictor::Workspace own = one.make_workspace();
        MatrixXd of_one(jacobian.rows(), jacobian.cols());
        ASSERT_EQ(one.mean_and_jacobian(state, mean, of_one, own), Predictor::Status::ok);
        sum += of_one / 3;
      }
      EXPECT_LE(test::largest(jacobian - sum), 1e-13 * (1 + test::largest(sum)));
    }
  }
}

TEST(Mixture, GrowsAndShrinksWithItsData) {
  const Problem p = test::problems(1, mixture_seed).front();
  const View view = constrained(p);
  Posterior mixture = mixture_of(p);
  const Posterior kept = mixture;
  const MatrixXd before = kept.mean(view, p.queries);
  const Observations& group = p.observations.front();
  mixture = update(std::move(mixture), group);
  EXPECT_EQ(mixture.n_components(), 3);
  EXPECT_EQ(kept.mean(view, p.queries), before);
  for (int k = 0; k < 3; ++k) {
    const Posterior one = update(kept.component(k), group);
    EXPECT_EQ(mixture.component(k).mean(view, p.queries), one.mean(view, p.queries));
  }
  mixture = remove_oldest(std::move(mixture), group.n_data());
  EXPECT_EQ(mixture.n_components(), 3);
}

TEST(Mixture, OfFewComponentsIsWithinTheErrorThatIsAsked) {
  for (const Problem& p : test::problems(9, mixture_seed)) {
    SCOPED_TRACE(p.name);
    std::vector<ModelValues> values;
    for (const double factor : {1.0, 1.02, 1.3, 0.98, 0.8, 1.05, 1.01}) {
      ModelValues& one = values.emplace_back(p.values);
      for (VectorXd& signal : one.signal_stddev) signal *= factor;
      for (VectorXd& noise : one.noise_stddev) noise /= factor;
    }
    const Posterior all = Posterior::mixture(p.prior, p.observations, values);
    VectorXd square = VectorXd::Zero(p.values.noise_stddev[0].size());
    for (const ModelValues& one : values) square += one.noise_stddev[0].cwiseAbs2() / 7;
    EXPECT_TRUE(all.noise_stddev(0).isApprox(square.cwiseSqrt(), 1e-14));
    const Observations& group = p.observations.front();
    if (p.observations.size() > 1 || group.view().other_system || group.n_data() > 300) continue;
    for (const View& view : {constrained(p), View::learned_force(*p.prior.system)}) {
      const Posterior::Marginal exact = all.marginal(view, group.states());
      std::size_t n_before = 8;
      for (const double largest : {1e-9, 0.01, 0.1, 1e9}) {
        const std::vector<int> few = all.fewest_components(largest, view);
        EXPECT_TRUE(std::is_sorted(few.begin(), few.end()));
        EXPECT_LE(few.size(), n_before);
        n_before = few.size();
        if (few.size() == 7) continue;
        const Posterior::Marginal got = all.components(few).marginal(view, group.states());
        double sum = 0;
        int n = 0;
        for (Index i = 0; i < exact.mean.size(); ++i) {
          const double s = exact.stddev().reshaped()[i];
          if (s < 1e-9) continue;
          const double mean = (got.mean - exact.mean).reshaped()[i] / s, stddev = got.stddev().reshaped()[i] / s - 1;
          sum += mean * mean + stddev * stddev;
          ++n;
        }
        EXPECT_LE(std::sqrt(sum / n), 1.001 * largest);
      }
    }
    EXPECT_EQ(all.fewest_components(0.1), all.fewest_components(0.1, constrained(p)));
    EXPECT_EQ(all.fewest_components(1e-9).size(), 7U);
    EXPECT_EQ(all.fewest_components(1e9).size(), 1U);
  }
}

// A carriage that a screw drives as it likes, whose acceleration is known to rounding, and a mass on it.
TEST(Mixture, AValueThatAConstraintDecidesHasNoSayInWhichComponentsStandForAll) {
  const Model model = Model::parse(R"toml(
name        = "driven carriage"
coordinates = ["x", "y"]
[mechanics]
mass  = [["2", "0.3"], ["0.3", "1"]]
force = ["0", "-3*y"]
[constraints]
velocity = ["0.7*dx - 3*sin(8*t)"]
[[latent]]
features = ["y"]
[truth]
acceleration = ["0", "sin(2*y)"]
[sampling]
y = [-1, 1]
t = [0, 2]
)toml",
                                   "carriage");
  const Prior prior = make_prior(model, {});
  const MatrixXd states = test::draw(model, 20, mixture_seed).states;
  const View view = View::constrained_acceleration(*model.system);
  const std::vector<Observations> observations{
      {states, view, ModelMotion(model).acceleration(states), VectorXd::Constant(2, 0.1)}};
  const std::vector<Hyperparameter> start = default_hyperparameters(prior, observations, {}, {});
  const std::vector<ModelValues> values(7, model_values(prior, observations, start));
  const Posterior all = Posterior::mixture(prior, observations, values);
  EXPECT_LT(all.marginal(view, states).stddev().row(0).maxCoeff(), 1e-6) << "nothing was tested";
  EXPECT_EQ(all.fewest_components(1e-6).size(), 1U);
}

TEST(Mixture, OfNothingIsRefused) {
  const Problem p = test::problems(1, mixture_seed).front();
  EXPECT_EQ(test::input_error_of([&] { Posterior::mixture(p.prior, p.observations, {}); }),
            "Posterior::mixture: there are no values");
  EXPECT_EQ(test::input_error_of([&] { static_cast<void>(mixture_of(p).component(3)); }),
            "Posterior: component 3: there are 3, 0 is the first");
  EXPECT_EQ(test::input_error_of([&] { static_cast<void>(mixture_of(p).components({})); }),
            "Posterior::components: there are none");
  EXPECT_EQ(test::input_error_of([&] { static_cast<void>(mixture_of(p).fewest_components(0)); }),
            "fewest_components: the largest error must be above 0");
}

}  // namespace
}  // namespace gp2
