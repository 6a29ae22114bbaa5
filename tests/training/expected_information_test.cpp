#include "training/expected_information.hpp"

#include <cmath>

#include <gtest/gtest.h>

#include "gp2/fit.hpp"
#include "gp2/training/laplace.hpp"
#include "inference/problems.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t information_seed = 8161;

/// Two masses on a wire, pulled; p and r enter the accelerations linearly.
const Model& wire() {
  static const Model model = Model::parse(R"toml(
name        = "wire"
coordinates = ["x", "y"]
[parameters]
p = { value = 0.7, bounds = [-50, 50] }
r = { value = 0.2, bounds = [-50, 50] }
unread = { value = 1, bounds = [-1, 3] }
[mechanics]
mass  = [["1", "0"], ["0", "2"]]
force = ["p*x + r + 0*unread", "-9.81"]
[constraints]
position = ["y - 0.3*x^2"]
[[latent]]
kernel     = "se"
features   = ["dx"]
directions = { force = [["1"], ["0"]] }
[noise]
ddq = [0.3, 0.1]
[truth]
force = ["-0.4*tanh(dx)", "0"]
[sampling]
x  = [-1, 1]
dx = [-2, 2]
)toml",
                                          "wire.toml");
  return model;
}

Prior with_force_mean() { return make_prior(wire(), {Prior::Mean::force, std::nullopt}); }

/// A prior with known hyperparameters, and measurements.
struct Problem {
  Prior prior = with_force_mean();
  std::vector<Hyperparameter> hyperparameters;

  explicit Problem(const std::vector<int>& theta) {
    Hyperparameter scale = Hyperparameter::of(Kind::signal_stddev, 0, 0), length = Hyperparameter::of(Kind::kernel, 0, 0);
    scale.value = scale.lower = scale.upper = 0.5;
    length.value = length.lower = length.upper = 0.9;
    hyperparameters = {scale, length};
    for (const int k : theta) {
      Hyperparameter h = Hyperparameter::of(Kind::parameter, 0, static_cast<std::size_t>(k));
      h.name = wire().system->parameters()[static_cast<std::size_t>(k)].name;
      h.value = wire().system->parameter_values()[k];
      h.lower = h.value - 50;
      h.upper = h.value + 50;
      hyperparameters.push_back(h);
    }
  }

  [[nodiscard]] Observations measured(int n, std::uint64_t seed) const {
    const VectorXd noise = Eigen::Vector2d(0.3, 0.1);
    GeneratedData data = generate(wire(), {n, seed, noise});
    return {data.states, View::constrained_acceleration(*prior.system), data.accelerations, noise};
  }
};

MatrixXd none(const Problem& problem) { return MatrixXd(problem.prior.system->layout().size(), 0); }

TEST(ExpectedInformation, OfParametersThatEnterLinearlyIsWhatTheLikelihoodOfAllDataHas) {
  const Problem problem({0, 1});
  const Observations first = problem.measured(15, information_seed), second = problem.measured(12, information_seed + 1);
  const ExpectedInformation information(problem.prior, {first}, problem.hyperparameters, nullptr, 1, nullptr);
  const auto is_of = [&](const ExpectedInformation::Known& known, const std::vector<Observations>& data) {
    const LaplaceUncertainty laplace = laplace_uncertainty(problem.prior, data, problem.hyperparameters, 1);
    for (int k = 0; k < 2; ++k) EXPECT_NEAR(known.stddev[k] / laplace.stddev[2 + k], 1, 2e-4) << k;
  };
  const ExpectedInformation::Known now = information.after(none(problem), none(problem));
  const ExpectedInformation::Known after = information.after(second.states(), none(problem));
  is_of(now, {first});
  is_of(after, {first, second});
  EXPECT_LT(after.stddev[0], 0.9 * now.stddev[0]);
  EXPECT_LT(after.log_volume, now.log_volume);
}

// Friction that presses on what it rubs on is not linear in what is learned: to first order about what is known already.
TEST(ExpectedInformation, OfLatentsThatAreNotLinearIsNearlyWhatTheLikelihoodOfAllDataHas) {
  const Model model = Model::parse(
      test::changed(wire().text, {{"force = [[\"1\"], [\"0\"]] }", "force = [[\"-0.1*abs(lambda(1))*dx\"], [\"0\"]] }"},
                                  {"-0.4*tanh(dx)", "-0.05*abs(lambda(1))*dx"}}),
      "wire.toml");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const std::vector<Hyperparameter> hyperparameters = Problem({0, 1}).hyperparameters;
  const VectorXd noise = Eigen::Vector2d(0.03, 0.01);
  const auto measured = [&](int n, std::uint64_t seed) {
    const GeneratedData data = generate(model, {n, seed, noise});
    return Observations{data.states, View::constrained_acceleration(*prior.system), data.accelerations, noise};
  };
  const Observations first = measured(40, information_seed), second = measured(40, information_seed + 1);
  const ExpectedInformation information(prior, {first}, hyperparameters, nullptr, 1, nullptr);
  const MatrixXd nowhere(prior.system->layout().size(), 0);
  const ExpectedInformation::Known now = information.after(nowhere, nowhere), after = information.after(second.states(), nowhere);
  const LaplaceUncertainty of_first = laplace_uncertainty(prior, {first}, hyperparameters, 1),
                           of_both = laplace_uncertainty(prior, {first, second}, hyperparameters, 1);
  for (int k = 0; k < 2; ++k) {
    EXPECT_NEAR(now.stddev[k] / of_first.stddev[2 + k], 1, 1e-3) << k;
    EXPECT_NEAR(after.stddev[k] / of_both.stddev[2 + k], 1, 0.1) << k;
    EXPECT_LT(after.stddev[k], 0.9 * now.stddev[k]) << k;
  }
}

TEST(ExpectedInformation, OfAccelerationsIsWhatAPosteriorWithTheMeasurementsHasWhateverTheyAre) {
  const Problem problem({});
  const Observations first = problem.measured(15, information_seed), second = problem.measured(12, information_seed + 1);
  const MatrixXd region = problem.measured(7, information_seed + 2).states();
  const ExpectedInformation information(problem.prior, {first}, problem.hyperparameters, nullptr, 1, nullptr);
  ModelValues values = information.posterior().values();
  values.noise_stddev.push_back(values.noise_stddev[0]);
  const Posterior posterior(problem.prior, {first, second.with_values(5 * second.values())}, values);
  const Posterior::Marginal expected = posterior.marginal(information.view(), region);
  const MatrixXd found = information.after(second.states(), region).region;
  for (Index i = 0; i < region.cols(); ++i) {
    for (Index j = 0; j < 2; ++j) {
      const double sigma = information.noise_stddev()[j];
      EXPECT_NEAR(found(j, i) * sigma * sigma / expected.covariance(3 * j, i), 1, 1e-9) << i << ' ' << j;
    }
  }
  EXPECT_GT(information.after(none(problem), region).region.sum(), 1.1 * found.sum());
}

TEST(ExpectedInformation, OnAnotherSystemIsWhatAPosteriorOfBothHas) {
  const Problem problem({0});
  const Model steeper = Model::parse(test::changed(wire().text, {{"0.3*x^2", "0.5*x^2"}}), "steeper.toml");
  const auto other = make_other_system(wire(), steeper, {Prior::Mean::force, std::nullopt});
  const Observations first = problem.measured(15, information_seed);
  const GeneratedData data = generate(steeper, {12, information_seed + 1, Eigen::Vector2d(0.3, 0.1)});
  const MatrixXd region = generate(steeper, {7, information_seed + 2, Eigen::Vector2d::Zero()}).states;
  const ExpectedInformation information(problem.prior, {first}, {problem.hyperparameters[0], problem.hyperparameters[1]}, other,
                                        1, nullptr);
  EXPECT_EQ(information.view().other_system, other);
  ModelValues values = information.posterior().values();
  values.noise_stddev.push_back(values.noise_stddev[0]);
  const Posterior posterior(problem.prior,
                            {first, {data.states, information.view(), data.accelerations, information.noise_stddev()}}, values);
  const Posterior::Marginal expected = posterior.marginal(information.view(), region);
  const MatrixXd found = information.after(data.states, region).region;
  for (Index i = 0; i < region.cols(); ++i) {
    for (Index j = 0; j < 2; ++j) {
      const double sigma = information.noise_stddev()[j];
      EXPECT_NEAR(found(j, i) * sigma * sigma / expected.covariance(3 * j, i), 1, 1e-9) << i << ' ' << j;
    }
  }
}

TEST(ExpectedInformation, OfAccelerationsCountsWhatIsNotKnownOfParameters) {
  const Problem with({0, 1}), without({});
  const Observations first = with.measured(15, information_seed);
  const MatrixXd region = with.measured(7, information_seed + 2).states();
  const ExpectedInformation open(with.prior, {first}, with.hyperparameters, nullptr, 1, nullptr),
      known(without.prior, {first}, without.hyperparameters, nullptr, 1, nullptr);
  EXPECT_GT(open.after(none(with), region).region.minCoeff(), 0);
  EXPECT_TRUE((open.after(none(with), region).region.array() > known.after(none(with), region).region.array()).all());
}

TEST(ExpectedInformation, AParameterOfWhichTheDataSayNothingMayBeAnywhereInItsBounds) {
  const Problem problem({0, 2});
  const Observations first = problem.measured(15, information_seed);
  const ExpectedInformation information(problem.prior, {first}, problem.hyperparameters, nullptr, 1, nullptr);
  ASSERT_EQ(information.parameters().size(), 2U);
  EXPECT_EQ(information.parameters()[1].name, "unread");
  const VectorXd stddev = information.after(first.states(), none(problem)).stddev;
  EXPECT_NEAR(stddev[1], 100 / std::sqrt(12), 1e-6);
  EXPECT_LT(stddev[0], 1);
}

}  // namespace
}  // namespace gp2
