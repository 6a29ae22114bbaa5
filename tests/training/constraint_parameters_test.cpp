// Parameters that vanish from A and b are found where the logged states are, or stay where they started.
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "gp2/fit.hpp"
#include "gp2/model.hpp"
#include "gp2/training/laplace.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

// a bead on a wire about (0, h), of radius l; nothing depends on p
Model bead(const std::string& constraint) {
  return Model::parse(fmt::format(R"toml(
name        = "bead"
coordinates = ["x", "y"]
[parameters]
l = {{ value = 1.3, bounds = [0.5, 2], estimate = true }}
h = {{ value = 0.4, bounds = [-1, 1] }}
p = {{ value = 0.7, bounds = [0.1, 3] }}
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[constraints]
position = ["{}"]
[[latent]]
kernel     = "se"
features   = ["x", "y", "dx", "dy"]
directions = "acceleration"
)toml",
                                  constraint),
                      "bead");
}

Observations observe(const Model& model, double position_noise, std::uint64_t seed, double h = 0, int n = 40) {
  RandomStream random(seed);
  MatrixXd states = MatrixXd::Zero(model.system->layout().size(), n), values(2, n);
  for (int i = 0; i < n; ++i) {
    const double angle = 6 * random.uniform(), rate = random.normal(), ddq = -9.81 * std::cos(angle) - 0.2 * rate;
    states.col(i).head(4) << std::cos(angle) + position_noise * random.normal(),
        h + std::sin(angle) + position_noise * random.normal(), -rate * std::sin(angle), rate * std::cos(angle);
    values.col(i) << -ddq * std::sin(angle) - rate * rate * std::cos(angle),
        ddq * std::cos(angle) - rate * rate * std::sin(angle);
    for (double& value : values.col(i)) value += 0.05 * random.normal();
  }
  return {std::move(states), View::constrained_acceleration(*model.system), std::move(values), VectorXd::Constant(2, 0.05)};
}

struct Found {
  double value, stddev;
};

std::vector<Found> fit_of(const Model& model, const Observations& data, const std::vector<std::string>& estimated) {
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  FitOptions fit_options;
  fit_options.n_restarts = 2;
  fit_options.max_iterations = 60;
  const FitReport report = fit(prior, {data}, default_hyperparameters(prior, {data}, estimated, Protocol()), fit_options).report;
  std::vector<Found> found;
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    if (h.is_system_parameter()) found.push_back({h.value, report.uncertainty->stddev[static_cast<Eigen::Index>(k)]});
  }
  return found;
}

TEST(ConstraintParameters, AreFoundFromTheStatesWhereAccelerationsAreSilent) {
  const Model model = bead("x^2 + y^2 - l^2");
  for (const std::uint64_t seed : {1U, 2U, 3U}) {
    const std::vector<Found> exact = fit_of(model, observe(model, 0, seed), {"l"});
    EXPECT_NEAR(exact[0].value, 1, 1e-5);
    const std::vector<Found> noisy = fit_of(model, observe(model, 0.02, seed), {"l"});
    EXPECT_NEAR(noisy[0].value, 1, 4 * noisy[0].stddev);
    EXPECT_GT(noisy[0].stddev, 0.3 * 0.02 / std::sqrt(40));
    EXPECT_LT(noisy[0].stddev, 3 * 0.02 / std::sqrt(40));
  }
}

TEST(ConstraintParameters, AreFoundBesideOthersThatTheConstraintHas) {
  // h enters A, l does not: a wrong h must not spoil l
  const Model model = bead("x^2 + (y - h)^2 - l^2");
  const std::vector<Found> found = fit_of(model, observe(model, 1e-3, 4, 0.25), {"l", "h"});
  EXPECT_NEAR(found[0].value, 1, 0.01);
  EXPECT_NEAR(found[1].value, 0.25, 0.05);
}

// Whole steps of Newton's method lead from 1.3 ever farther away.
TEST(ConstraintParameters, AreFoundWhereResidualsBendAway) {
  const Model model = bead("x^2 + y^2 - 1 + atan(10*(l - 1))");
  const std::vector<Found> found = fit_of(model, observe(model, 1e-3, 5), {"l"});
  EXPECT_NEAR(found[0].value, 1, 4 * found[0].stddev);
  EXPECT_LT(found[0].stddev, 1e-3);
}

// Of the radius p + l the data tell nothing but the sum: with p held at 0.3 they tell l.
TEST(ConstraintParameters, AreFoundBesideOneThatIsHeld) {
  const Model text = bead("x^2 + y^2 - (p + l)^2");
  SymbolicSystem::Definition definition = text.symbolic_system()->definition();
  for (Parameter& parameter : definition.parameters) {
    if (parameter.name != "p") continue;
    parameter.value = 0.3;
    parameter.bounds = {0.3, 0.3};
  }
  Prior prior = make_prior(text, {Prior::Mean::force, std::nullopt});
  prior.system = std::make_shared<const SymbolicSystem>(std::move(definition));
  const Observations data = observe(text, 1e-3, 6);
  FitOptions fit_options;
  fit_options.n_restarts = 1;
  fit_options.max_iterations = 60;
  std::vector<double> found;
  const FitReport report = fit(prior, {data}, default_hyperparameters(prior, {data}, {"l", "p"}, Protocol()), fit_options).report;
  for (const Hyperparameter& h : report.hyperparameters) {
    if (h.is_system_parameter()) found.push_back(h.value);
  }
  ASSERT_EQ(found.size(), 2U);
  EXPECT_NEAR(found[0], 0.7, 1e-3);
  EXPECT_EQ(found[1], 0.3);
}

// A log without positions, which nothing else reads, says nothing of a distance between them.
TEST(ConstraintParameters, AreAsWellKnownBesideALogThatCannotTell) {
  const Model rod = Model::parse(R"toml(
name        = "rod"
coordinates = ["x", "y"]
[parameters]
l = { value = 0.5, bounds = [0.1, 1] }
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
[constraints]
position = ["y - x - l"]
[[latent]]
kernel     = "se"
features   = ["dx"]
directions = "acceleration"
)toml",
                                 "rod");
  constexpr int n = 30;
  RandomStream random(6);
  MatrixXd states = MatrixXd::Zero(rod.system->layout().size(), n), values(2, n);
  for (int i = 0; i < n; ++i) {
    const double x = random.normal(), dx = random.normal();
    states.col(i).head(4) << x, x + 0.4 + 0.01 * random.normal(), dx, dx;
    values.col(i).setConstant(random.normal());
  }
  const Observations with(states, View::constrained_acceleration(*rod.system), values, VectorXd::Constant(2, 0.05));
  states.topRows(2).setConstant(std::numeric_limits<double>::quiet_NaN());
  const Observations without(states, with.view(), values, VectorXd::Constant(2, 0.05));
  const Prior prior = make_prior(rod);
  const auto prior_of_l = [&](const std::vector<Observations>& observations) {
    return default_hyperparameters(prior, observations, {"l"}, {}).back().hyperprior;
  };
  const HyperPrior alone = prior_of_l({with}), beside = prior_of_l({with, without, without});
  EXPECT_NEAR(alone.median, 0.4, 0.01);
  EXPECT_NEAR(alone.stddev, 0.01 / std::sqrt(n), 0.5 * 0.01 / std::sqrt(n));
  EXPECT_NEAR(beside.median, alone.median, 1e-9);
  EXPECT_NEAR(beside.stddev, alone.stddev, 1e-9);
}

TEST(ConstraintParameters, KeepTheirStartWhereNothingKnowsThem) {
  const Model model = bead("x^2 + y^2 - l^2");
  const std::vector<Found> found = fit_of(model, observe(model, 1e-3, 5), {"l", "p"});
  EXPECT_NEAR(found[0].value, 1, 0.01);
  EXPECT_NEAR(found[1].value, 0.7, 1e-3);
  EXPECT_TRUE(std::isinf(found[1].stddev)) << "nothing is known of it";
}

TEST(ConstraintParameters, AreNotKnownFromFewerStatesThanThereAreParameters) {
  const Model model = bead("x^2 + y^2 - l^2");
  const std::vector<Found> found = fit_of(model, observe(model, 1e-3, 5, 0, /*n=*/1), {"l", "p"});
  EXPECT_TRUE(std::isinf(found[1].stddev)) << found[1].stddev;
}

TEST(ConstraintParameters, HaveTheDeviationOfTheirPriorWhereNothingElseKnowsThem) {
  const Model model = bead("x^2 + y^2 - l^2");
  for (const auto& [belief, deviation] :
       {std::pair("{ mean = 0.8, stddev = 0.1 }", 0.1), std::pair("{ median = 0.8, log_stddev = 0.1 }", 0.08),
        std::pair("{ mean = 0.8, stddev = 5 }", std::numeric_limits<double>::infinity())}) {
    std::string text = model.text;
    text.replace(text.find("bounds = [0.1, 3]"), 17, fmt::format("bounds = [0.1, 3], prior = {}", belief));
    const Model with = Model::parse(text, "bead");
    const std::vector<Found> found = fit_of(with, observe(with, 1e-3, 5), {"l", "p"});
    if (std::isfinite(deviation)) {
      EXPECT_NEAR(found[1].value, 0.8, 1e-3) << belief;
      EXPECT_NEAR(found[1].stddev, deviation, 1e-3) << belief;
    } else {
      EXPECT_EQ(found[1].stddev, deviation) << "a prior that is wider than the bounds";
    }
  }
}

// Else motions went by one draw of what is anywhere in its bounds.
TEST(ConstraintParameters, AreNotDrawnWhereNothingKnowsThem) {
  const Model model = bead("x^2 + y^2 - l^2");
  const Observations data = observe(model, 1e-3, 5);
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  FitOptions fit_options;
  fit_options.n_restarts = 1;
  fit_options.max_iterations = 20;
  fit_options.n_draws = 4;
  const Fit found = fit(prior, {data}, default_hyperparameters(prior, {data}, {"l", "p"}, Protocol()), fit_options);
  const std::vector<Hyperparameter>& hyperparameters = found.report.hyperparameters;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const auto draws = found.report.draws->values.row(static_cast<Eigen::Index>(k));
    const bool is_same = (draws.array() == hyperparameters[k].value).all();
    EXPECT_EQ(is_same, hyperparameters[k].is_system_parameter()) << hyperparameters[k].name;
  }
}

}  // namespace
}  // namespace gp2
