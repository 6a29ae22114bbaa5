// Robot models from end to end: driven motion, fits that keep their robot, long simulations.

#include <cmath>
#include <filesystem>
#include <string>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/model.hpp"
#include "gp2/predictor.hpp"
#include "gp2/robots/robot.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/generate.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

Model read_model(const char* file) { return Model::read(std::filesystem::path(GP2_SOURCE_DIR) / file); }

GeneratedData motion_of(const Model& model, int n, double noise = 0, std::uint64_t seed = 1) {
  return generate(model, {n, seed, VectorXd::Constant(model.system->nq(), noise)});
}

double value_of(const Model& model, const std::string& text, const VectorXd& state) {
  const Expression e = model.expression(text);
  MatrixXd value;
  Tape(std::span(&e, 1), model.symbols().state_and_parameters()).evaluate(state, model.system->parameter_values(), value);
  return value(0, 0);
}

TEST(Motion, OfTheArmKeepsItsTipOnThePlaneAndPointingDown) {
  const Model model = read_model("experiments/arm_on_surface/arm.toml");
  const GeneratedData data = motion_of(model, 240);
  double moved = 0;
  for (Eigen::Index i = 0; i < data.states.cols(); ++i) {
    const VectorXd state = data.states.col(i);
    EXPECT_NEAR(value_of(model, "site('tip').z", state), 0.055, 1e-14);
    EXPECT_NEAR(value_of(model, "dsite('tip').z", state), 0, 1e-13);
    // what the controller does not know, friction of 1 N s/m, is small beside its gain
    EXPECT_NEAR(value_of(model, "site('tip').rot_zz", state), -1, 1e-3);
    moved = std::max(moved, std::abs(value_of(model, "site('tip').x", state)));
  }
  EXPECT_GT(moved, 0.05);
  const MechanicsBatch mechanics = require_mechanics(*model.system, data.states, model.system->parameter_values());
  for (int i = 0; i < static_cast<int>(data.states.cols()); ++i) {
    const VectorXd error = mechanics.values.A(i) * data.accelerations.col(i) - mechanics.values.b(i);
    EXPECT_LE(error.cwiseAbs().maxCoeff(), 1e-12 * (1 + data.accelerations.col(i).cwiseAbs().maxCoeff()));
  }
}

// where rounding of a hundred terms leaves no step that helps
TEST(InverseDynamicsOfTheArm, IsFoundAtEveryStateOfAMotion) {
  const Model model = read_model("experiments/arm_on_surface/arm.toml");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  const GeneratedData data = motion_of(model, 60, 0.1);
  const std::vector<Observations> observations{{data.states, view, data.accelerations, VectorXd::Constant(7, 0.1), false}};
  const Posterior posterior(prior, observations,
                            model_values(prior, observations, default_hyperparameters(prior, observations, {}, {})));
  MatrixXd states = motion_of(model, 60, 0, 2).states;
  const MatrixXd wanted = posterior.mean(view, states);
  states.bottomRows(7).setZero();
  const InverseDynamics found = inverse_dynamics(posterior, view, states, wanted);
  states.bottomRows(7) = found.inputs;
  // beside the accelerations that its light joints may have
  const double tolerance = 1e-8 * posterior.without_data().marginal(view, states).stddev().maxCoeff();
  EXPECT_LE(found.missed.cwiseAbs().maxCoeff(), tolerance);
  EXPECT_LE((posterior.mean(view, states) - wanted).cwiseAbs().maxCoeff(), tolerance);
}

TEST(Motion, ReachesItsTargetsWhereTheControllerKnowsEverything) {
  // a slider on a rail, no unknown force: the reference is followed to the order of the hold, ω⁻² of the jerk between samples
  const Model model = Model::parse(R"(
coordinates = ["q1"]
inputs = ["u1"]
[mechanics]
mass = [["2"]]
force = ["u1 - 3*q1"]
[truth]
acceleration = ["0"]
[motion]
rate = 200
segment = [1, 1.000001]
natural_frequency = 30
targets = { q1 = [2, 2.000001] }
)",
                                   "slider");
  const GeneratedData data = motion_of(model, 300);
  EXPECT_EQ(data.states(0, 0), 0);
  EXPECT_NEAR(data.states(0, 299), 2, 2e-3);
  EXPECT_NEAR(data.states(0, 100), 1, 2e-2) << "half of the way in half of the time";
}

constexpr const char* drone = R"(
robot = 'drone.xml'
inputs = ["fx", "fy", "fz", "mx", "my", "mz"]
[truth]
force = ["0", "0", "0", "0", "0", "0"]
[motion]
rate = 100
segment = [0.5, 0.500001]
natural_frequency = 20
targets = { f_x = [0.5, 0.500001], 'body("drone").rot_xz' = [0.3, 0.300001] }
hold = ['f_y', 'f_z', 'body("drone").rot_yz', 'body("drone").rot_xy']
)";

Model read_drone(const std::string& text) {
  const test::TemporaryFolder folder;
  const std::filesystem::path path =
      folder.write("drone.xml", R"(<mujoco><worldbody><body name="drone" pos="0 0 1"><freejoint name="f"/>
    <inertial pos="0.01 0 0.02" mass="1" fullinertia="0.01 0.011 0.02 0.001 0 0.002"/></body></worldbody></mujoco>)");
  return Model::parse(text, "drone", [&](const std::string&) { return read_robot(path); });
}

TEST(Motion, OfAFreeBodyReachesItsTargetsWithAQuaternionOfLengthOne) {
  const Model model = read_drone(drone);
  const GeneratedData data = motion_of(model, 60);
  for (Eigen::Index i = 0; i < 60; ++i) EXPECT_NEAR(data.states.col(i).segment<4>(3).norm(), 1, 1e-14);
  EXPECT_EQ(data.states.col(0).head(7), VectorXd::Unit(7, 3)) << "begins unturned";
  EXPECT_NEAR(data.states(0, 59), 0.5, 5e-3);
  EXPECT_NEAR(value_of(model, "body('drone').rot_xz", data.states.col(59)), 0.3, 5e-3);
}

TEST(Start, OfAFreeBodyIsUnturnedWhereNothingIsSaid) {
  const Model model = read_drone(drone);
  const auto size = model.system->layout().size();
  StartingPoint start{VectorXd::Zero(size), std::vector<bool>(static_cast<std::size_t>(size), false)};
  std::vector<std::string> notes;
  start.state[2] = 1;
  start.given[2] = true;
  const VectorXd unturned = complete_start(model, model.system->parameter_values(), start, notes);
  EXPECT_EQ(unturned.head(7), VectorXd::Unit(7, 2) + VectorXd::Unit(7, 3));
  EXPECT_TRUE(notes.empty()) << notes.front();
  start.state[4] = 0.6;
  start.given[4] = true;
  const VectorXd turned = complete_start(model, model.system->parameter_values(), start, notes);
  // the nearest by kinetic energy, in which the products of inertia couple the entries
  EXPECT_NEAR(turned.segment<4>(3).norm(), 1, 1e-14);
  EXPECT_EQ(turned[4], 0.6);
  EXPECT_NEAR(turned[3], 0.8, 0.01);
  EXPECT_EQ(turned.head(2), VectorXd::Zero(2));
}

TEST(Motion, OfAFreeBodyIsByForcesAlongItsAxes) {
  const auto message = [](const std::string& more) {
    return test::input_error_of([&] { read_drone("robot = 'drone.xml'\n" + more); });
  };
  EXPECT_NE(message("inputs = ['f1', 'f2']").find("2 inputs for 6 axes of joints: give one per axis"), std::string::npos);
  EXPECT_NE(message("[mechanics]\nforce = ['0']").find("expected 6 entries, one per axis of the joints, got 1"),
            std::string::npos);
  EXPECT_NE(message("[parameters]\nk = { of = 'stiffness(\"f\")' }").find("the robot has no number 'stiffness(\"f\")'"),
            std::string::npos);
}

TEST(Motion, IsTheSameForAnyNoiseAndTheSameSeedOnly) {
  const Model model = read_model("models/four_bar.toml");
  const GeneratedData quiet = motion_of(model, 40), noisy = motion_of(model, 40, 0.1), other = motion_of(model, 40, 0, 2);
  EXPECT_EQ(quiet.states, noisy.states);
  EXPECT_NE(quiet.accelerations, noisy.accelerations);
  EXPECT_NE(quiet.states, other.states);
}

std::string model_error_of(const std::string& text) {
  return test::input_error_of([&] { motion_of(Model::parse(text, "m"), 2); });
}

TEST(Motion, SaysWhatIsWrongWithIt) {
  const std::string head = "coordinates = ['q1']\ninputs = ['u1']\n[mechanics]\nmass = [['1']]\nforce = ['u1']\n";
  const std::string truth = "[truth]\nacceleration = ['0']\n";
  const std::string motion = "[motion]\nrate = 10\nsegment = [1, 2]\n";
  const auto expect = [&](const std::string& text, const std::string& part) {
    EXPECT_NE(model_error_of(text).find(part), std::string::npos) << model_error_of(text);
  };
  expect(head + truth + motion, "missing targets = { q1 = [lower, upper], … }");
  expect(head + truth + motion + "targets = {}\n", "a motion needs at least one target");
  expect(head + truth + motion + "targets = { dq1 = [0, 1] }\n", "must be a function of the coordinates");
  expect(head + truth + motion + "targets = { q1 = [0, 1] }\nhold = ['q2']\n", "unknown symbol 'q2'");
  expect(head + truth + motion + "targets = { q1 = [0, 1] }\nprofile = 'linear'\n", R"(expected "smooth" or "trapezoid")");
  expect(head + truth + motion + "targets = { q1 = [0, 1] }\nnatural_frequency = 0\n", "must be positive, got 0");
  expect(head + truth + motion + "targets = { q1 = [0, 1] }\nstart = { q3 = 0 }\n",
         "'q3' is neither a coordinate nor a velocity");
  expect(head + truth + motion + "targets = { q1 = [0, 1] }\n[sampling]\nq1 = [0, 1]\n", "remove one of the two");
  expect(head + truth + "[motion]\nsegment = [1, 2]\n", "missing rate = …");
  expect(head + truth + "[motion]\nrate = 10\n", "missing segment = [shortest, longest]");
  expect(head + truth + "[motion]\nrate = 10\nsegment = [-1, 2]\n", "a line takes a positive time");
  expect(head + motion + "targets = { q1 = [0, 1] }\n", "missing [truth]");
  expect("coordinates = ['q1']\n[mechanics]\nmass = [['1']]\n" + truth + motion + "targets = { q1 = [0, 1] }\n",
         "a model without inputs cannot be driven");
  const Model model = Model::parse(head + truth + motion + "targets = { q1 = [0, 1] }\n", "m");
  GenerateOptions grid{2, 1, VectorXd::Zero(1)};
  grid.grid["q1"] = 3;
  EXPECT_THROW(generate(model, grid), InputError);
}

Fit fit_of(const Model& model, FitProblem& problem, int n) {
  const CsvTable log = as_table(motion_of(model, n, 0.05), *model.system, "log");
  FitProblemOptions options;
  options.mean = Prior::Mean::force;
  problem = make_fit_problem(model, log, options);
  FitOptions fit_options = default_fit_options(problem);
  fit_options.n_restarts = 1;
  fit_options.max_iterations = 30;
  return fit(problem, fit_options);
}

TEST(RobotFit, IsReadBackWithoutTheRobotsFileAndPredictsTheSameBits) {
  const test::TemporaryFolder folder;
  for (const char* file : {"four_bar.toml", "four_bar.xml"}) {
    std::filesystem::copy_file(std::filesystem::path(GP2_SOURCE_DIR) / "models" / file, folder / file,
                               std::filesystem::copy_options::overwrite_existing);
  }
  const Model model = Model::read(folder / "four_bar.toml");
  FitProblem problem;
  const Fit fitted = fit_of(model, problem, 40);
  FitFile file;
  file.model = model;
  file.prior_options = problem.prior_options;
  file.observations = problem.observations;
  file.report = fitted.report;
  file.write(folder / "fit.json");
  std::filesystem::remove(folder / "four_bar.xml");
  const FitFile again = FitFile::read(folder / "fit.json");
  const MatrixXd states = motion_of(model, 20, 0, 3).states;
  const View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  EXPECT_EQ(again.posterior().mean(view, states), file.posterior().mean(view, states));
  EXPECT_THROW(Model::read(folder / "four_bar.toml"), InputError) << "the model itself does need it";
}

TEST(RobotFit, OfTheFourBarStaysOnItsLoopForAMinute) {
  const Model model = read_model("models/four_bar.toml");
  FitProblem problem;
  const Fit fitted = fit_of(model, problem, 100);
  VectorXd start = VectorXd::Zero(model.system->layout().size());
  start[model.system->layout().dq(0)] = 3;
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(121, 0, 60);
  const View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  const Trajectory motion = simulate(
      *model.system, model.system->parameter_values(),
      [&](const Eigen::Ref<const VectorXd>& state) -> VectorXd { return fitted.posterior.mean(view, state); },
      project_onto_constraints(*model.system, model.system->parameter_values(), start), options);
  EXPECT_LE(motion.max_position_drift, 1e-10);
  EXPECT_LE(motion.max_velocity_drift, 1e-10);
}

// two state Jacobians: exact derivatives of the robot's expressions, and differences of the mean
TEST(RobotFit, PredictorHasTheJacobianOfItsMean) {
  const Model model = read_model("models/four_bar.toml");
  FitProblem problem;
  const Fit fitted = fit_of(model, problem, 40);
  const View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  const Predictor predictor(fitted.posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd state = motion_of(model, 30, 0, 4).states.col(29);
  MatrixXd jacobian(3, state.size());
  VectorXd mean(3), above(3), below(3);
  ASSERT_EQ(predictor.mean_and_jacobian(state, mean, jacobian, workspace), Predictor::Status::ok);
  for (int k : {0, 1, 2, 3, 4, 5, 7}) {
    const double h = 1e-6;
    VectorXd moved = state;
    moved[k] += h;
    ASSERT_EQ(predictor.mean(moved, above, workspace), Predictor::Status::ok);
    moved[k] -= 2 * h;
    ASSERT_EQ(predictor.mean(moved, below, workspace), Predictor::Status::ok);
    const VectorXd difference = (above - below) / (2 * h);
    EXPECT_LE((jacobian.col(k) - difference).cwiseAbs().maxCoeff(), 1e-5 * (1 + difference.cwiseAbs().maxCoeff())) << k;
  }
  EXPECT_GT(jacobian.cwiseAbs().maxCoeff(), 0.1);
}

}  // namespace
}  // namespace gp2
