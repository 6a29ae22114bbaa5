#include <cmath>
#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/predictor.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

// A massless coordinate is learned from, and predicts, as a model that does without it.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Quantity;
using testing::HasSubstr;
using Status = Predictor::Status;

constexpr std::uint64_t massless_coordinate_seed = 50606;

// models/massless_rod.toml with what is unknown at the hinge alone, and the pendulum that it is
const Model& rod() {
  static const Model model =
      Model::parse(test::changed(test::model("models/massless_rod.toml").text,
                                 {{"directions = \"force\"", "directions = { force = [[\"0\"], [\"0\"], [\"1\"]] }"}}),
                   "rod");
  return model;
}
const Model& pendulum() {
  static const Model model = Model::parse(R"toml(
name        = "pendulum"
coordinates = [{ name = "theta", angle = true }]
inputs      = ["u1"]
[parameters]
m = { value = 0.5, bounds = [0.3, 0.8] }
l = { value = 0.6, bounds = [0.5, 0.7] }
g = 9.81
[mechanics]
mass  = [["m*l^2"]]
force = ["u1 - m*g*l*sin(theta)"]
[[latent]]
kernel     = "se"
features   = ["theta", "dtheta", "u1"]
directions = { force = [["1"]] }
)toml",
                                          "pendulum");
  return model;
}

const PriorOptions force_as_mean{Prior::Mean::force, std::nullopt};

// θ, θ̇, t and u1 of the rod's states
MatrixXd of_pendulum(const MatrixXd& states) {
  const std::vector<int> rows = {2, 5, 6, 7};
  return states(rows, Eigen::all);
}

// θ̈ measured
Observations angle_observed(const View& view, const MatrixXd& states, const MatrixXd& values) {
  return {states, view, values, VectorXd::Constant(1, 0.2), false};
}

ModelValues some_values(const Observations& group) {
  ModelValues values;
  values.kernel = {VectorXd::Constant(4, 1.5)};
  values.signal_stddev = {VectorXd::Constant(1, 0.3)};
  values.noise_stddev = {group.noise().stddev()};
  values.parameters = rod().system->parameter_values();
  return values;
}

TEST(MasslessCoordinate, HasTheLikelihoodTheGradientTheFitAndThePredictionsOfTheModelWithoutIt) {
  SCOPED_TRACE(fmt::format("seed {}", massless_coordinate_seed));
  const GeneratedData data = generate(rod(), {30, massless_coordinate_seed, VectorXd::Constant(3, 0.2)});
  const MatrixXd values = data.accelerations.row(2);
  const Observations here = angle_observed({Quantity::constrained_acceleration, {2}}, data.states, values);
  const Observations there = angle_observed({Quantity::constrained_acceleration, {0}}, of_pendulum(data.states), values);
  const Prior prior = make_prior(rod(), force_as_mean), without = make_prior(pendulum(), force_as_mean);

  const ModelValues start = some_values(here);
  Likelihood::Options options;
  options.noise_gradient = true;
  options.gradient_parameters = {0, 1, 2};
  ModelGradient gradient, expected;
  Likelihood::Workspace workspace, other_workspace;
  const double nll = Likelihood(prior, {here}, start, options).evaluate(start, &gradient, workspace);
  const double expected_nll = Likelihood(without, {there}, start, options).evaluate(start, &expected, other_workspace);
  // both are the same numbers, rounded on other ways: ε times the condition of K̃ + I, below 30 (0.3/0.2)²
  const double rounding = 1e5 * eps;
  EXPECT_NEAR(nll, expected_nll, rounding * std::abs(nll));
  EXPECT_LE(test::largest(gradient.log_kernel[0] - expected.log_kernel[0]),
            rounding * (1 + test::largest(expected.log_kernel[0])));
  EXPECT_LE(test::largest(gradient.log_signal_stddev[0] - expected.log_signal_stddev[0]),
            rounding * (1 + test::largest(expected.log_signal_stddev[0])));
  EXPECT_LE(test::largest(gradient.log_noise_stddev[0] - expected.log_noise_stddev[0]),
            rounding * (1 + test::largest(expected.log_noise_stddev[0])));
  EXPECT_LE(test::largest(gradient.parameters - expected.parameters), rounding * (1 + test::largest(expected.parameters)));
  EXPECT_GT(expected.parameters.cwiseAbs().minCoeff(), 0.01);

  // fitted from the same start within the same bounds
  std::vector<Hyperparameter> hyperparameters = default_hyperparameters(without, {there}, {"m"}, {});
  FitOptions fit_options;
  fit_options.n_restarts = 2;
  fit_options.n_threads = 1;
  const Fit fitted = fit(prior, {here}, hyperparameters, fit_options);
  const Fit fitted_without = fit(without, {there}, hyperparameters, fit_options);
  // the optimiser stops at a gradient of 1e-5 in logarithms: the objective is then within about its square, what it depends on
  // within about itself
  EXPECT_NEAR(fitted.report.negative_log_likelihood, fitted_without.report.negative_log_likelihood, 1e-7);
  const MatrixXd states = test::draw(rod(), 20, massless_coordinate_seed + 1).states;
  const Posterior::Marginal marginal = fitted.posterior.marginal(here.view(), states);
  const Posterior::Marginal other = fitted_without.posterior.marginal(there.view(), of_pendulum(states));
  EXPECT_LE(test::largest(marginal.mean - other.mean), 1e-4 * (1 + test::largest(other.mean)));
  EXPECT_LE(test::largest(marginal.stddev() - other.stddev()), 1e-4);
}

// everything observed that can be, with the model's own prior on all three forces
struct MasslessProblem {
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  MatrixXd queries;
};

MasslessProblem problem(Prior::Mean mean) {
  const Model& model = test::model("models/massless_rod.toml");
  const MatrixXd states = test::draw(model, 24, massless_coordinate_seed).states;
  MasslessProblem p{make_prior(model, {mean, std::nullopt}), {}, {}, states.rightCols(3)};
  RandomStream random(massless_coordinate_seed, mean == Prior::Mean::force ? 1 : 2);
  Index first = 0;
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::constraint_force, Quantity::multipliers}) {
    const View view = View::all(quantity, *model.system);
    p.observations.push_back(test::observe(model, view, states.middleCols(first, 7), random));
    first += 7;
  }
  p.values = test::random_values(p.prior, p.observations, random);
  return p;
}

// M is singular and Mā is not the force: only the force itself, of which M'⁻¹ is ā, is left
TEST(MasslessCoordinate, TheLearnedForceIsThatOfTheLatents) {
  const MasslessProblem p = problem(Prior::Mean::force);
  const Posterior prior = Posterior(p.prior, p.observations, p.values).without_data();
  const MatrixXd stddev = prior.marginal(View::learned_force(*p.prior.system), p.queries).stddev();
  // three independent forces along the coordinates
  EXPECT_LE(test::largest(stddev.colwise() - p.values.signal_stddev[0]), 1e-13 * test::largest(stddev));
}

TEST(MasslessCoordinate, HasTheExactGradientOfTheLikelihoodInEveryParameter) {
  for (const Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const MasslessProblem p = problem(mean);
    Likelihood::Options options;
    options.noise_gradient = true;
    options.gradient_parameters = {0, 1, 2};
    const Likelihood likelihood(p.prior, p.observations, p.values, options);
    Likelihood::Workspace workspace;
    ModelGradient gradient;
    likelihood.evaluate(p.values, &gradient, workspace);
    const auto expect = [&](double analytic, const auto& member, bool positive) {
      const double value = member(p.values);
      const auto at = [&](double x) -> VectorXd {
        ModelValues moved = p.values;
        member(moved) = positive ? std::exp(x) : x;
        return VectorXd::Constant(1, likelihood.evaluate(moved, nullptr, workspace));
      };
      const test::Difference difference =
          test::central_difference(at, positive ? std::log(value) : value, positive ? 0.5 : 0.05 * value, 1e3 * eps);
      EXPECT_TRUE(test::matches(VectorXd::Constant(1, analytic), difference));
      EXPECT_GT(std::abs(analytic), difference.error[0]);
    };
    const int n_parameters = mean == Prior::Mean::force ? 3 : 2;  // without F nothing depends on g
    for (int k = 0; k < n_parameters; ++k) {
      SCOPED_TRACE(p.prior.system->parameters()[static_cast<std::size_t>(k)].name);
      expect(
          gradient.parameters[k], [k](auto& values) -> auto& { return values.parameters[k]; }, false);
    }
    for (int k = 0; k < 3; ++k) {
      expect(
          gradient.log_signal_stddev[0][k], [k](auto& values) -> auto& { return values.signal_stddev[0][k]; }, true);
      expect(
          gradient.log_noise_stddev[1][k], [k](auto& values) -> auto& { return values.noise_stddev[1][k]; }, true);
    }
  }
}

TEST(MasslessCoordinate, IsPredictedByThePredictorAsByThePosteriorAndDifferentiatedExactly) {
  for (const Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const MasslessProblem p = problem(mean);
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const Quantity quantity :
         {Quantity::constrained_acceleration, Quantity::constraint_force, Quantity::next_velocity, Quantity::learned_force}) {
      for (const std::optional<int>& latent : {std::optional<int>(), std::optional(0)}) {
        View view = View::all(quantity, *p.prior.system);
        view.time_step = 0.1;
        view.latent = latent;
        SCOPED_TRACE(fmt::format("{}, latent {}", quantity->word(), latent.value_or(-1)));
        const Predictor predictor(posterior, view);
        Predictor::Workspace workspace = predictor.make_workspace();
        VectorXd got(3), again(3), stddev(3);
        MatrixXd jacobian(3, 8);
        for (const VectorXd state : p.queries.colwise()) {
          const Posterior::Marginal expected = posterior.marginal(view, state);
          ASSERT_EQ(predictor.mean_and_stddev(state, got, stddev, workspace), Status::ok);
          EXPECT_LE(test::largest(got - expected.mean), 1e4 * eps * (1 + test::largest(expected.mean)));
          const MatrixXd prior = posterior.without_data().marginal(view, state).stddev();
          for (Index r = 0; r < 3; ++r) {
            EXPECT_NEAR(stddev[r] * stddev[r], expected.covariance(4 * r, 0), 1e4 * eps * (prior(r) * prior(r) + eps));
          }
          EXPECT_EQ(test::allocations_of(
                        [&] { EXPECT_EQ(predictor.mean_and_jacobian(state, again, jacobian, workspace), Status::ok); }),
                    0U);
          EXPECT_EQ(again, got);
          for (Index k = 0; k < state.size(); ++k) {
            const auto mean_at = [&](double x) {
              VectorXd moved = state, there(3);
              moved[k] = x;
              EXPECT_EQ(predictor.mean(moved, there, workspace), Status::ok);
              return there;
            };
            EXPECT_TRUE(test::matches(jacobian.col(k), test::central_difference(mean_at, state[k], 0.02, 1e3 * eps)))
                << "entry " << k << " of the state";
          }
        }
      }
    }
  }
}

// M is singular at x = 0, where the row of A, (1, c), completes it or does not
TEST(MasslessCoordinate, ThePredictorTellsWhatIsWrongWithAStateAndGoesOn) {
  const auto expect = [](const std::string& row, const std::string& directions, Status status) {
    const Model model = Model::parse(fmt::format(R"toml(
name        = "a point"
coordinates = ["x", "y"]
[mechanics]
mass  = [["x", "0"], ["0", "1"]]
[constraints]
acceleration = ["{}"]
[[latent]]
kernel     = "se"
features   = ["y"]
directions = "{}"
)toml",
                                                 row, directions),
                                     "a point");
    ModelValues values{{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {}, VectorXd()};
    const Predictor predictor(Posterior(make_prior(model), {}, values));
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(2);
    const VectorXd zero = VectorXd::Zero(5);
    EXPECT_EQ(predictor.mean(VectorXd::Ones(5), mean, workspace), Status::ok);
    EXPECT_EQ(test::allocations_of([&] { EXPECT_EQ(predictor.mean(zero, mean, workspace), status); }), 0U);
    EXPECT_EQ(mean.array().isNaN().all(), status != Status::ok);
    EXPECT_EQ(predictor.mean(VectorXd::Ones(5), mean, workspace), Status::ok);
  };
  expect("ddx - ddy", "force", Status::ok);
  expect("ddx - ddy", "acceleration", Status::no_unconstrained_acceleration);
  expect("x*ddx - ddy", "force", Status::motion_undetermined);
}

// M_θθ = 0: the torque that the hinge can be expected to see is that of the ball on its rod
TEST(MasslessCoordinate, HasAForceScaleOfTheMassThatItsConstraintsLendIt) {
  const Model& model = test::model("models/massless_rod.toml");
  const GeneratedData data = test::draw(model, 30, massless_coordinate_seed);
  for (const int row : {0, 2}) {
    const Observations group{
        data.states, {Quantity::constrained_acceleration, {row}}, data.accelerations.row(row), VectorXd::Constant(1, 0.1), false};
    const Scales scales = default_scales(make_prior(model), {group});
    EXPECT_TRUE(scales.acceleration_stddev.allFinite()) << scales.acceleration_stddev.transpose();
    // within what one mass weighed by two rows can differ from m l²
    const double torque = 0.5 * 0.6 * 0.6 * row_stddev(data.accelerations.row(2))[0];
    EXPECT_GT(scales.signal_stddev[0][2], torque / 10) << "row " << row;
    EXPECT_LT(scales.signal_stddev[0][2], torque * 10) << "row " << row;
  }
}

TEST(MasslessCoordinate, WithAPriorOnTheAccelerationThereIsNoPosterior) {
  const Model& model = test::model("models/massless_rod.toml");
  const Prior prior = make_prior(model, {Prior::Mean::zero, Latent::Base::acceleration});
  RandomStream random(massless_coordinate_seed);
  const Observations group = test::observe(model, View::all(Quantity::constrained_acceleration, *model.system),
                                           test::draw(model, 5, massless_coordinate_seed).states, random);
  const ModelValues values = test::random_values(prior, {group}, random);
  EXPECT_THAT(test::input_error_of([&] { Posterior(prior, {group}, values); }),
              HasSubstr("M is singular, so that there is no M⁻¹, but the latent 'unknown force' acts on"));
  EXPECT_THAT(test::input_error_of([&] { const Likelihood likelihood(prior, {group}, values, {}); }),
              HasSubstr("at state 1 (x = "));
}

}  // namespace
}  // namespace gp2
