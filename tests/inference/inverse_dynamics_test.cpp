#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/QR>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/predictor.hpp"
#include "inference/inverse_dynamics.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

// Inverse dynamics, then forward, is what was wanted.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;
using testing::HasSubstr;

constexpr std::uint64_t inverse_seed = 30517;

MatrixXd with_inputs(MatrixXd states, const MatrixXd& inputs) {
  states.bottomRows(inputs.rows()) = inputs;
  return states;
}

// J of the inputs
MatrixXd slope_at(const Posterior& posterior, const View& view, const VectorXd& state, Index nu) {
  const Predictor predictor(posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd mean(view.size());
  MatrixXd jacobian(view.size(), state.size());
  EXPECT_EQ(predictor.mean_and_jacobian(state, mean, jacobian, workspace), Predictor::Status::ok);
  return jacobian.rightCols(nu);
}

// what some inputs make is wanted, and looked for from others near them: latents may read inputs, and be anything farther off
TEST(InverseDynamicsTest, ForwardOfTheInputsFoundIsWhatWasWanted) {
  int n = 0;
  for (const Problem& p : test::problems(15, inverse_seed)) {
    const Index nu = p.prior.system->layout().nu;
    if (nu == 0) continue;
    ++n;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inverse_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    const View view = View::constrained_acceleration(*p.prior.system);
    const MatrixXd states = p.queries.array().isNaN().select(0, p.queries);
    const MatrixXd wanted = posterior.mean(view, states);
    RandomStream random(inverse_seed, static_cast<std::uint64_t>(n));
    const MatrixXd off = 0.01 * test::random_matrix(nu, states.cols(), random);
    const InverseDynamics found = inverse_dynamics(posterior, view, with_inputs(states, states.bottomRows(nu) + off), wanted);
    const MatrixXd reached = posterior.mean(view, with_inputs(states, found.inputs));
    const double tolerance = (1e-12 + 1e-3 * test::rounding(p)) * (1 + largest(wanted));
    EXPECT_LE(largest(reached - wanted), 1e3 * tolerance);
    EXPECT_LE(largest(wanted - reached - found.missed), tolerance);
  }
  EXPECT_GT(n, 20);
}

// The arm: two motors for one free direction, latents that read no input: affine in the inputs.
struct Arm {
  const Model& model = test::model("models/arm_on_moving_plane.toml");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  const MatrixXd states = test::draw(model, 4, inverse_seed + 1).states;
  const Posterior posterior = [this] {
    RandomStream random(inverse_seed);
    const std::vector<Observations> observations = {
        test::observe(model, view, test::draw(model, 12, inverse_seed).states, random)};
    return Posterior(prior, observations, test::random_values(prior, observations, random));
  }();

  [[nodiscard]] InverseDynamics inverse(const MatrixXd& wanted) const {
    return inverse_dynamics(posterior, view, with_inputs(states, MatrixXd::Constant(2, states.cols(), std::nan(""))), wanted);
  }
};

TEST(InverseDynamicsTest, OfInputsThatDoTheSameIsTheLeastChange) {
  const Arm arm;
  const MatrixXd wanted = arm.posterior.mean(arm.view, arm.states);
  const InverseDynamics found = arm.inverse(wanted);
  EXPECT_LE(largest(found.missed), 1e-11 * (1 + largest(wanted)));
  const VectorXd usual = arm.posterior.observations()[0].states().bottomRows(2).rowwise().squaredNorm() / 12;  // squared
  for (int i = 0; i < 4; ++i) {
    const MatrixXd J = slope_at(arm.posterior, arm.view, arm.states.col(i), 2);
    const VectorXd idle = Eigen::FullPivLU<MatrixXd>(J).setThreshold(1e-9).kernel().col(0);
    const VectorXd u = found.inputs.col(i).cwiseQuotient(usual);
    EXPECT_LE(std::abs(u.dot(idle)), 1e-11 * u.norm() * idle.norm());
  }
}

// Two forces on x, the first in a unit of so many newtons, and one on y.
struct Forces {
  Model model;
  Posterior posterior;

  Forces(double unit, const Eigen::Vector3d& usual)
      : model(Model::parse(fmt::format(R"toml(
name        = "three forces"
coordinates = ["x", "y"]
inputs      = ["u", "v", "w"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["{}*u + 1e-6*v", "w"]
[[latent]]
kernel   = "se"
features = ["dx"]
)toml",
                                       unit),
                           "forces.toml")),
        posterior(posterior_of(model, usual)) {}

  static Posterior posterior_of(const Model& model, const Eigen::Vector3d& usual) {
    MatrixXd states = MatrixXd::Zero(8, 2);
    states.bottomRows(3) << usual, -usual;
    const View view = View::constrained_acceleration(*model.system);
    return {make_prior(model, {Prior::Mean::force, std::nullopt}),
            {Observations(states, view, MatrixXd::Zero(2, 2), VectorXd::Ones(2))},
            {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {VectorXd::Ones(2)}, {}}};
  }

  // for so much more than comes at rest without inputs
  [[nodiscard]] InverseDynamics inverse(const std::vector<int>& rows, const VectorXd& more) const {
    const View view{Quantity::constrained_acceleration, rows};
    const MatrixXd rest = MatrixXd::Zero(8, 1);
    return inverse_dynamics(posterior, view, rest, posterior.mean(view, rest) + more);
  }
};

TEST(InverseDynamicsTest, AnInputThatDoesNextToNothingIsNotAskedForWhatAnotherDoes) {
  const Forces forces(1, {1, 1, 1});
  const InverseDynamics found = forces.inverse({0}, VectorXd::Constant(1, 0.5));
  EXPECT_NEAR(found.inputs(0, 0), 0.5, 1e-11);
  EXPECT_NEAR(found.inputs(1, 0), 0.5e-6, 1e-11);
  EXPECT_LE(std::abs(found.missed(0, 0)), 1e-14);
  EXPECT_TRUE(found.open(1, 0));
}

TEST(InverseDynamicsTest, UnitsOfInputsDoNotDecideWhichOfThemAct) {
  const VectorXd more = VectorXd::Constant(1, 0.5);
  const MatrixXd in_newtons = Forces(1, {2e-6, 3, 1}).inverse({0}, more).inputs;
  const MatrixXd in_nanonewtons = Forces(1e-9, {2e3, 3, 1}).inverse({0}, more).inputs;
  EXPECT_GT(std::abs(in_newtons(0, 0)), 0.1) << "both act";
  EXPECT_GT(std::abs(in_newtons(1, 0)), 1e4) << "both act";
  EXPECT_NEAR(in_nanonewtons(0, 0), 1e9 * in_newtons(0, 0), 1e-3);
  EXPECT_NEAR(in_nanonewtons(1, 0), in_newtons(1, 0), 1e-6);
}

TEST(InverseDynamicsTest, AnInputThatTheDataHoldAtZeroIsAskedForLittleButWhatTheOthersCannotDo) {
  const Forces forces(1, {0, 1e6, 0});
  // the second makes nearly all of x
  const InverseDynamics found = forces.inverse({0, 1}, Eigen::Vector2d(0.5, 0.25));
  EXPECT_NEAR(found.inputs(0, 0), 0, 0.02);
  EXPECT_NEAR(found.inputs(1, 0), 0.5e6, 0.02e6);
  EXPECT_NEAR(found.inputs(2, 0), 0.25, 1e-7);
  EXPECT_LE(largest(found.missed), 1e-14);
}

TEST(InverseDynamicsTest, WhatNoInputsProduceIsMissedByTheLeastInTheSenseOfGauss) {
  const Arm arm;
  RandomStream random(inverse_seed, 2);
  // off the constraint by chance
  const MatrixXd wanted = test::random_matrix(2, 4, random);
  const InverseDynamics found = arm.inverse(wanted);
  const MatrixXd states = with_inputs(arm.states, found.inputs);
  const MechanicsBatch mechanics = require_mechanics(*arm.model.system, states, arm.posterior.values().parameters);
  for (int i = 0; i < 4; ++i) {
    EXPECT_GT(found.missed.col(i).norm(), 1e-3);
    const MatrixXd J = slope_at(arm.posterior, arm.view, states.col(i), 2);
    EXPECT_LE(largest(J.transpose() * mechanics.values.M(i) * found.missed.col(i)), 1e-11 * (1 + largest(J)));
    const VectorXd reached = arm.posterior.mean(arm.view, states.col(i));
    EXPECT_LE(largest(mechanics.values.A(i) * reached - mechanics.values.b(i)), 1e-11 * (1 + largest(reached)));
  }
}

// u is affine in w and in the latents, so that its covariance is that of ddq through the slope in w
TEST(InverseDynamicsTest, TheDeviationIsThatOfTheAccelerations) {
  const Arm arm;
  const MatrixXd wanted = arm.posterior.mean(arm.view, arm.states);
  const InverseDynamics found = arm.inverse(wanted);
  const Posterior::Marginal ddq = arm.posterior.marginal(arm.view, with_inputs(arm.states, found.inputs));
  std::vector<MatrixXd> slope(4, MatrixXd(2, 2));  // du/dw
  for (Index k = 0; k < 2; ++k) {
    MatrixXd more = wanted;
    more.row(k).array() += 1;
    const MatrixXd change = arm.inverse(more).inputs - found.inputs;
    for (Index i = 0; i < 4; ++i) slope[static_cast<std::size_t>(i)].col(k) = change.col(i);
  }
  for (Index i = 0; i < 4; ++i) {
    const MatrixXd& J = slope[static_cast<std::size_t>(i)];
    const MatrixXd expected = J * ddq.covariance.col(i).reshaped(2, 2) * J.transpose();
    EXPECT_LE(largest(found.covariance.col(i).reshaped(2, 2) - expected), 1e-9 * largest(expected));
    EXPECT_NEAR(found.stddev()(0, i), std::sqrt(expected(0, 0)), 1e-9 * std::sqrt(largest(expected)));
  }
}

TEST(InverseDynamicsTest, OfSomeAccelerationsUnderAnotherSystem) {
  const Arm arm;
  std::string text = arm.model.text;
  text = test::changed(text, {{"w  = 4.0", "w  = 5.0"}});
  const Model faster = Model::parse(text, "faster.toml");
  View elbow = test::under({Quantity::constrained_acceleration, {1}},
                           make_other_system(arm.model, faster, {Prior::Mean::force, std::nullopt}));
  MatrixXd wanted = MatrixXd::Constant(1, 4, 2.5);
  wanted(0, 3) = 0;  // no scale of its own
  const InverseDynamics found = inverse_dynamics(arm.posterior, elbow, arm.states, wanted);
  const MatrixXd reached = arm.posterior.mean(elbow, with_inputs(arm.states, found.inputs));
  EXPECT_LE(largest(reached - wanted), 1e-11);
  elbow.other_system = nullptr;
  EXPECT_GT(largest(arm.posterior.mean(elbow, with_inputs(arm.states, found.inputs)) - wanted), 1e-6);
}

TEST(InverseDynamicsTest, SaysWhichInputsAreLeftOpen) {
  // two forces on a, in another proportion on b, and a torque
  const Model model = Model::parse(R"toml(
name        = "three inputs"
coordinates = ["a", "b", "c"]
inputs      = ["u", "v", "w"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.1"]]
force = ["u + 1e-3*v", "1e4*u - v", "w - c"]
)toml",
                                   "three_inputs.toml");
  const Prior by_force = make_prior(model, {Prior::Mean::force, std::nullopt});
  RandomStream random(inverse_seed, 6);
  const Posterior prior(by_force, {}, test::random_values(by_force, {}, random));
  const MatrixXd states = MatrixXd::Ones(10, 2);
  const auto open = [&](const std::vector<int>& rows) {
    const MatrixXd wanted = MatrixXd::Constant(std::ssize(rows), 2, 0.5);
    return inverse_dynamics(prior, {Quantity::constrained_acceleration, rows}, states, wanted).open;
  };
  const auto expected = [](bool u, bool v, bool w) -> decltype(InverseDynamics::open) {
    return Eigen::Array<bool, 3, 1>(u, v, w).replicate(1, 2);
  };
  EXPECT_TRUE((open({0, 1, 2}) == expected(false, false, false)).all());
  EXPECT_TRUE((open({0, 1}) == expected(false, false, true)).all());
  EXPECT_TRUE((open({1, 2}) == expected(true, true, false)).all());
  EXPECT_TRUE((open({2}) == expected(true, true, false)).all());
  const Arm arm;
  EXPECT_TRUE(arm.inverse(arm.posterior.mean(arm.view, arm.states)).open.all());
}

// A body on a floor that a sensor tells of, and a brake that a comparison of its own input closes.
constexpr const char* sensed = R"toml(
name        = "sensed"
coordinates = ["x", "z"]
inputs      = ["u", "touch", "load", "push"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["u", "push - 9.81"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
velocity = [{ expr = "dx - 1", when = "abs(load) > 3" }, { expr = "dx + dz", when = "push > 100" }]
[[latent]]
kernel   = "se"
features = ["dx", "touch", "load"]
)toml";

TEST(InverseDynamicsTest, InputsOfSensorsStayWhereTheyAre) {
  const Model model = Model::parse(sensed, "sensed.toml");
  EXPECT_TRUE((inputs_of_sensors(*model.system) == Eigen::Array<bool, 4, 1>(false, true, true, false)).all());
  EXPECT_FALSE(inputs_of_sensors(*test::model("models/arm_on_moving_plane.toml").system).any());
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  RandomStream random(inverse_seed, 8);
  MatrixXd states = test::random_matrix(9, 12, random);
  states.row(6) = (states.row(6).array() > 0).cast<double>();
  const Posterior posterior(prior, {test::observe(model, view, states, random)},
                            {{VectorXd::Ones(3)}, {VectorXd::Ones(2)}, {}, {VectorXd::Constant(2, 0.1)}, {}});
  for (const double touch : {0.0, 1.0}) {
    MatrixXd there = test::random_matrix(9, 4, random), start = there;
    there.row(6).setConstant(touch);
    start.row(6).setConstant(touch);
    const MatrixXd wanted = posterior.mean(view, there);
    start.row(5).setZero();
    start.row(8).setZero();
    const InverseDynamics found = inverse_dynamics(posterior, view, start, wanted);
    EXPECT_EQ(found.inputs.middleRows(1, 2), there.middleRows(6, 2));
    EXPECT_LE(largest(found.inputs.row(0) - there.bottomRows(4).row(0)), 1e-9);
    EXPECT_LE(largest(found.missed), 1e-11 * (1 + largest(wanted)));
    EXPECT_FALSE(found.open.middleRows(1, 2).any());
    EXPECT_EQ(largest(found.stddev().middleRows(1, 2)), 0);
  }
}

Model cart(const std::string& force) {
  return Model::parse(R"toml(
name        = "cart"
coordinates = ["x"]
inputs      = ["u"]
[mechanics]
mass  = [["2"]]
force = [")toml" + force + R"toml("]
[[latent]]
kernel   = "se"
features = ["dx"]
)toml",
                      "cart.toml");
}

TEST(InverseDynamicsTest, AnEffectOfRoundingIsNotTakenForOne) {
  const Model model = cart("1e-14*u - x");
  const View view = View::constrained_acceleration(*model.system);
  const std::vector<Observations> observations = {
      {MatrixXd(Eigen::Vector4d(0, 0, 0, 1)), view, MatrixXd::Zero(1, 1), VectorXd::Ones(1)}};
  const Posterior posterior(make_prior(model, {Prior::Mean::force, std::nullopt}), observations,
                            {{VectorXd::Ones(1)}, {VectorXd::Ones(1)}, {}, {VectorXd::Ones(1)}, {}});
  const InverseDynamics found = inverse_dynamics(posterior, view, MatrixXd::Zero(4, 1), MatrixXd::Ones(1, 1));
  EXPECT_EQ(found.inputs(0, 0), 0);
  EXPECT_NEAR(found.missed(0, 0), 1, 1e-12);
  EXPECT_TRUE(found.open(0, 0));
}

TEST(InverseDynamicsTest, IsFoundByNewtonsMethodWhereTheInputsAreNotAffine) {
  const Model model = cart("u + 5*u^3 - x");
  const Posterior prior(make_prior(model, {Prior::Mean::force, std::nullopt}), {},
                        {{VectorXd::Ones(1)}, {VectorXd::Ones(1)}, {}, {}, {}});
  const View view = View::constrained_acceleration(*model.system);
  MatrixXd states = MatrixXd::Zero(4, 3), wanted(1, 3);
  states.row(0) << 0, 1, -2;
  wanted << 40, -3, 1e-3;
  const InverseDynamics found = inverse_dynamics(prior, view, states, wanted);
  for (Index i = 0; i < 3; ++i) {
    const double u = found.inputs(0, i);
    EXPECT_NEAR((u + 5 * u * u * u - states(0, i)) / 2, wanted(0, i), 1e-12 * (1 + std::abs(wanted(0, i))));
    // δu = δddq / (dddq/du), and the prior's deviation of ddq is 1
    EXPECT_NEAR(found.stddev()(0, i), 2 / (1 + 15 * u * u), 1e-9);
  }
  EXPECT_FALSE(found.open.any());
}

using Solver = InverseDynamicsSolver;

// one state at a time gives what many give, and allocates nothing
void expect_the_same_of_one_state(const Posterior& posterior, const View& view, const MatrixXd& states, const MatrixXd& wanted,
                                  double tolerance) {
  const InverseDynamics expected = inverse_dynamics(posterior, view, states, wanted);
  const Solver solver(posterior, view);
  Solver::Workspace workspace = solver.make_workspace();
  const Index nu = expected.inputs.rows();
  VectorXd inputs(nu), again(nu);
  MatrixXd covariance(nu, nu);
  // covariances are differences of numbers of the size of the prior's
  const MatrixXd before = inverse_dynamics(posterior.without_data(), view, with_inputs(states, expected.inputs),
                                           posterior.without_data().mean(view, with_inputs(states, expected.inputs)))
                              .covariance;
  for (Index i = 0; i < states.cols(); ++i) {
    Solver::Status of_inputs{}, of_both{};
    EXPECT_EQ(test::allocations_of([&] {
                of_inputs = solver.inputs(states.col(i), wanted.col(i), again, workspace);
                of_both = solver.inputs_and_covariance(states.col(i), wanted.col(i), inputs, covariance, workspace);
              }),
              0U);
    ASSERT_EQ(of_inputs, Solver::Status::ok);
    ASSERT_EQ(of_both, Solver::Status::ok);
    EXPECT_EQ(inputs, again);
    EXPECT_LE(largest(inputs - expected.inputs.col(i)), tolerance * (1 + largest(expected.inputs)));
    EXPECT_LE(largest(covariance.reshaped() - expected.covariance.col(i)), tolerance * (1 + largest(before)));
    EXPECT_LE(largest(workspace.missed() - expected.missed.col(i)), tolerance * (1 + largest(wanted)));
  }
}

TEST(InverseDynamicsSolverTest, IsInverseDynamicsOfOneStateAndAllocatesNothing) {
  int n = 0;
  for (const Problem& p : test::problems(15, inverse_seed)) {
    if (p.prior.system->layout().nu == 0) continue;
    ++n;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, inverse_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    const View view = View::constrained_acceleration(*p.prior.system);
    const MatrixXd states = p.queries.array().isNaN().select(0, p.queries);
    expect_the_same_of_one_state(posterior, view, states, posterior.mean(view, states), 1e-11 + 100 * test::rounding(p));
  }
  EXPECT_GT(n, 20);
}

TEST(InverseDynamicsSolverTest, StartsAtZeroWhereInputsAreNotKnownAndMissesTheLeast) {
  const Arm arm;
  RandomStream random(inverse_seed, 5);
  const MatrixXd states = with_inputs(arm.states, MatrixXd::Constant(2, arm.states.cols(), std::nan("")));
  expect_the_same_of_one_state(arm.posterior, arm.view, states, arm.posterior.mean(arm.view, arm.states), 1e-11);
  expect_the_same_of_one_state(arm.posterior, arm.view, states, test::random_matrix(2, 4, random), 1e-11);
}

TEST(InverseDynamicsSolverTest, OfSomeAccelerationsUnderAnotherSystem) {
  const Arm arm;
  const Model faster = Model::parse(test::changed(arm.model.text, {{"w  = 4.0", "w  = 5.0"}}), "faster.toml");
  const View elbow = test::under({Quantity::constrained_acceleration, {1}},
                                 make_other_system(arm.model, faster, {Prior::Mean::force, std::nullopt}));
  expect_the_same_of_one_state(arm.posterior, elbow, arm.states, MatrixXd::Constant(1, 4, 2.5), 1e-11);
}

TEST(InverseDynamicsSolverTest, OfAMixtureProducesItsMean) {
  const Arm arm;
  std::vector<ModelValues> values(3, arm.posterior.values());
  values[1].kernel[0] *= 1.7;
  values[2].signal_stddev[0] *= 0.6;
  const Posterior mixture = Posterior::mixture(arm.prior, arm.posterior.observations(), values);
  const MatrixXd wanted = mixture.mean(arm.view, arm.states);
  MatrixXd states = arm.states;
  states.bottomRows(2).array() += 1;
  expect_the_same_of_one_state(mixture, arm.view, states, wanted, 1e-9);
  const InverseDynamics found = inverse_dynamics(mixture, arm.view, states, wanted);
  EXPECT_LE(largest(mixture.mean(arm.view, with_inputs(states, found.inputs)) - wanted), 1e-10 * (1 + largest(wanted)));
}

TEST(InverseDynamicsSolverTest, FindsInputsByNewtonsMethodAndSaysWhyThereAreNone) {
  const auto posterior_of = [](const std::string& force) {
    const Model model = cart(force);
    return Posterior(make_prior(model, {Prior::Mean::force, std::nullopt}), {},
                     {{VectorXd::Ones(1)}, {VectorXd::Ones(1)}, {}, {}, {}});
  };
  const Posterior cubic = posterior_of("u + 5*u^3 - x");
  const View view = View::constrained_acceleration(*cubic.prior().system);
  expect_the_same_of_one_state(cubic, view, Eigen::Vector4d(1, 0, 0, 0), MatrixXd::Constant(1, 1, 40), 1e-11);

  const auto status_of = [&](const std::string& force, const Eigen::Vector4d& state, double wanted) {
    const Solver solver(posterior_of(force));
    Solver::Workspace workspace = solver.make_workspace();
    VectorXd inputs(1);
    MatrixXd covariance(1, 1);
    const VectorXd accelerations = VectorXd::Constant(1, wanted);
    Solver::Status status{};
    EXPECT_EQ(
        test::allocations_of([&] { status = solver.inputs_and_covariance(state, accelerations, inputs, covariance, workspace); }),
        0U);
    EXPECT_EQ(std::isnan(inputs[0]), status != Solver::Status::ok);
    EXPECT_EQ(std::isnan(covariance(0, 0)), status != Solver::Status::ok);
    EXPECT_EQ(std::isnan(workspace.missed()[0]), status != Solver::Status::ok);
    return status;
  };
  const double unknown = std::nan("");
  EXPECT_EQ(status_of("u", {0, 0, 0, 0}, 1), Solver::Status::ok);
  EXPECT_EQ(status_of("u", {0, 0, 0, unknown}, 1), Solver::Status::ok);
  EXPECT_EQ(status_of("u^2", {0, 0, 0, 1}, -1), Solver::Status::ok);
  EXPECT_EQ(status_of("u^2", {0, 0, 0, 0}, 1), Solver::Status::ok);
  EXPECT_EQ(status_of("u", {0, 0, 0, 0}, 1e200), Solver::Status::not_found) << "its square overflows";
  EXPECT_EQ(status_of("u", {0, 0, 0, 0}, unknown), Solver::Status::not_finite);
  EXPECT_EQ(status_of("u - x", {unknown, 0, 0, 0}, 1), Solver::Status::no_prediction);
}

// The thrust of a propeller is even in its speed: at rest it does nothing, and Newton's method would stay there.
TEST(InverseDynamicsSolverTest, LeavesAStartAtWhichAnInputDoesNothingYet) {
  const Model model = cart("3*u^2");
  const Posterior posterior(make_prior(model, {Prior::Mean::force, std::nullopt}), {},
                            {{VectorXd::Ones(1)}, {VectorXd::Ones(1)}, {}, {}, {}});
  const View view = View::constrained_acceleration(*model.system);
  const MatrixXd at_rest = MatrixXd::Zero(model.system->layout().size(), 1);
  const InverseDynamics found = inverse_dynamics(posterior, view, at_rest, MatrixXd::Constant(1, 1, 6));
  EXPECT_NEAR(found.inputs(0, 0), 2, 1e-12);
  EXPECT_NEAR(found.missed(0, 0), 0, 1e-12);
  EXPECT_EQ(inverse_dynamics(posterior, view, at_rest, MatrixXd::Zero(1, 1)).inputs(0, 0), 0) << "all is produced";
  const InverseDynamics idle =
      inverse_dynamics(Posterior(make_prior(cart("2"), {Prior::Mean::force, std::nullopt}), {}, posterior.values()), view,
                       at_rest, MatrixXd::Constant(1, 1, 6));
  EXPECT_EQ(idle.inputs(0, 0), 0) << "it never does anything";
}

// What a sine cannot produce is missed by the least, where its slope vanishes. The other input still produces all of y, on which the
// first acts too: at the turn both columns of J are parallel.
TEST(InverseDynamicsSolverTest, ComesNearestWhereAnInputTurnsAround) {
  const Model model = Model::parse(R"toml(
name        = "two carts"
coordinates = ["x", "y"]
inputs      = ["u", "v"]
[mechanics]
mass  = [["2", "0"], ["0", "1"]]
force = ["2*sin(u)", "v + v^3 - exp(-(u - 1)^2)"]
[[latent]]
kernel   = "se"
features = ["dx"]
)toml",
                                   "carts.toml");
  const View view = View::constrained_acceleration(*model.system);
  // what the data say at rest is what the model says: they tell the usual sizes of the inputs, and nothing else
  MatrixXd states = MatrixXd::Zero(7, 1);
  states.bottomRows(2) << 0.3, 2;
  const Prior by_force = make_prior(model, {Prior::Mean::force, std::nullopt});
  const Posterior prior(by_force, {}, {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {}, {}});
  const Posterior with_data(by_force, {Observations(states, view, prior.mean(view, states), VectorXd::Ones(2))},
                            {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {VectorXd::Ones(2)}, {}});
  RandomStream random(inverse_seed, 7);
  for (int k = 0; k < 200; ++k) {
    const VectorXd state = test::random_vector(model.system->layout().size(), random);
    const double v = 2 * random.normal(), u = std::numbers::pi / 2;
    const Eigen::Vector2d wanted(3, v + v * v * v - std::exp(-(u - 1) * (u - 1)));
    const InverseDynamics found = inverse_dynamics(k % 2 == 0 ? prior : with_data, view, state, wanted);
    // sin(u) is 1, to rounding, as far from u as the root of rounding
    const double at = found.inputs(0, 0);
    EXPECT_NEAR(std::sin(at), 1, 1e-12) << k;
    EXPECT_NEAR(found.missed(0, 0), 2, 1e-12) << k;
    EXPECT_NEAR(found.missed(1, 0), 0, 1e-6) << k;
    EXPECT_FALSE(found.stddev()(0, 0) < 1e3) << k;  // immense, or not known
  }
}

TEST(InverseDynamicsSolverTest, NamesWhatIsWrongWithAnArgument) {
  const Arm arm;
  const auto refusal = [](const auto& call) { return test::input_error_of([&] { static_cast<void>(call()); }); };
  EXPECT_THAT(refusal([&] { return Solver(arm.posterior, View::unconstrained_acceleration(*arm.model.system)); }),
              HasSubstr("must be of the constrained acceleration"));
  const Solver bare(arm.posterior, arm.view, {.covariance = false});
  Solver other(arm.posterior);
  EXPECT_EQ(other.view().size(), 2);
  EXPECT_TRUE(other.options().covariance);
  Solver::Workspace workspace = other.make_workspace();
  const VectorXd state = arm.states.col(0), wanted = VectorXd::Zero(2);
  VectorXd inputs(2), three(3);
  MatrixXd covariance(2, 2), low(1, 2), narrow(2, 1);
  EXPECT_THAT(refusal([&] { return bare.inputs(state, wanted, inputs, workspace); }),
              HasSubstr("the workspace is of another solver"));
  EXPECT_THAT(refusal([&] { return bare.inputs_and_covariance(state, wanted, inputs, covariance, workspace); }),
              HasSubstr("it was made without covariances"));
  EXPECT_THAT(refusal([&] { return other.inputs(state.head(3), wanted, inputs, workspace); }),
              HasSubstr("a state is of size 7, got 3"));
  EXPECT_THAT(refusal([&] { return other.inputs(state, three, inputs, workspace); }),
              HasSubstr("the vector of accelerations is of size 2, got 3"));
  EXPECT_THAT(refusal([&] { return other.inputs(state, wanted, three, workspace); }),
              HasSubstr("the vector of inputs is of size 2, got 3"));
  EXPECT_THAT(refusal([&] { return other.inputs_and_covariance(state, wanted, inputs, low, workspace); }),
              HasSubstr("a column of the covariance is of size 2, got 1"));
  EXPECT_THAT(refusal([&] { return other.inputs_and_covariance(state, wanted, inputs, narrow, workspace); }),
              HasSubstr("a row of the covariance is of size 2, got 1"));
  // the workspace keeps its solver alive
  const Solver moved = std::move(other);
  EXPECT_EQ(moved.inputs(state, wanted, inputs, workspace), Solver::Status::ok);
  EXPECT_THAT(refusal([&] { return other.make_workspace(); }), HasSubstr("moved"));  // NOLINT(bugprone-use-after-move)
}

TEST(InverseDynamicsTest, SaysWhatCannotBe) {
  const Model model = cart("u");
  const Posterior prior(make_prior(model, {Prior::Mean::force, std::nullopt}), {},
                        {{VectorXd::Ones(1)}, {VectorXd::Ones(1)}, {}, {}, {}});
  const View view = View::constrained_acceleration(*model.system);
  const VectorXd state = Eigen::Vector4d(0, 0, 0, 1);
  const MatrixXd wanted = MatrixXd::Constant(1, 1, 1e200);  // its square overflows
  try {
    static_cast<void>(inverse_dynamics(prior, view, state, wanted));
    ADD_FAILURE() << "no error";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(), HasSubstr("no inputs are found that produce the accelerations, or come nearest to them"));
  }
  const auto refusal = [&](const View& of, const MatrixXd& accelerations) {
    return test::input_error_of([&] { static_cast<void>(inverse_dynamics(prior, of, state, accelerations)); });
  };
  EXPECT_THAT(refusal(View::unconstrained_acceleration(*model.system), wanted),
              HasSubstr("must be of the constrained acceleration"));
  EXPECT_THAT(refusal(view, MatrixXd::Zero(2, 1)), HasSubstr("expected accelerations of 1 rows at 1 states, got 2 × 1"));
  EXPECT_THAT(refusal(view, MatrixXd::Constant(1, 1, std::nan(""))),
              HasSubstr("an acceleration that is wanted is not a finite number"));
  const Model& pendulum = test::model("models/double_pendulum.toml");
  const Prior without_inputs = make_prior(pendulum);
  EXPECT_THAT(test::input_error_of([&] {
                static_cast<void>(inverse_dynamics(
                    Posterior(without_inputs, {}, test::random_values(without_inputs, {}, *std::make_unique<RandomStream>(1))),
                    View::constrained_acceleration(*pendulum.system), MatrixXd(pendulum.system->layout().size(), 0),
                    MatrixXd(pendulum.system->nq(), 0)));
              }),
              HasSubstr("has no inputs"));
}

}  // namespace
}  // namespace gp2
