#include "gp2/simulate.hpp"

#include <cmath>
#include <limits>
#include <numbers>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <nlohmann/json.hpp>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/posterior.hpp"
#include "io_testing.hpp"
#include "reference_data.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;

/// What f throws as NumericalError, or "" when it does not throw.
template <class F>
std::string numerical_error_of(F f) {
  try {
    f();
  } catch (const NumericalError& error) {
    return error.what();
  }
  return "";
}

VectorXd times(double t_end, int n, double t_start = 0) { return VectorXd::LinSpaced(n, t_start, t_end); }

/// A state of a model from a few of its entries; the rest is 0.
VectorXd state_of(const Model& model, const std::vector<std::pair<std::string, double>>& entries) {
  const std::vector<std::string> names = model.system->state_names();
  VectorXd state = VectorXd::Zero(model.system->layout().size());
  for (const auto& [name, value] : entries) {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) throw std::runtime_error(name);
    state[found - names.begin()] = value;
  }
  return state;
}

/// The same, where entries not given are solved from the constraints.
VectorXd solved_state(const Model& model, const std::vector<std::pair<std::string, double>>& entries) {
  std::vector<bool> held;
  for (const std::string& name : model.system->state_names()) {
    held.push_back(std::any_of(entries.begin(), entries.end(), [&](const auto& entry) { return entry.first == name; }));
  }
  return project_onto_constraints(*model.system, model.system->parameter_values(), state_of(model, entries), held);
}

Trajectory simulate_model(const Model& model, const VectorXd& start, const SimulateOptions& options) {
  return simulate(*model.system, model.system->parameter_values(), model_acceleration(model), start, options);
}

SimulateOptions with_tolerance(const VectorXd& times, double tolerance, bool project = true) {
  SimulateOptions options;
  options.times = times;
  options.relative_tolerance = options.absolute_tolerance = tolerance;
  options.project = project;
  return options;
}

const Model& surface() { return test::model("models/surface.toml"); }
const Model& published_surface() { return test::model("experiments/surface_published.toml"); }

/// The start of the paper's figure 3 c.
VectorXd figure_start() { return solved_state(surface(), {{"q1", 0.4}, {"q2", 0.8}, {"dq1", 0.8}, {"dq2", 1}}); }

// ---- a body without constraints

Model oscillator(double damping = 0) {
  return Model::parse(fmt::format("coordinates = [\"x\"]\ninputs = [\"f\"]\n[mechanics]\nmass = [[1]]\n"
                                  "force = [\"f - x - {}*dx\"]\npotential = \"x^2/2\"\n",
                                  damping),
                      "oscillator.toml");
}

TEST(Simulate, FollowsAnOscillatorThatHasNoConstraint) {
  const Model model = oscillator();
  const Trajectory out = simulate_model(model, state_of(model, {{"x", 1}}), with_tolerance(times(10, 101), 1e-10));
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = out.times[i];
    EXPECT_EQ(out.states(2, i), t);
    EXPECT_NEAR(out.states(0, i), std::cos(t), 1e-8);
    EXPECT_NEAR(out.states(1, i), -std::sin(t), 1e-8);
    EXPECT_EQ(out.accelerations(0, i), -out.states(0, i));
  }
  EXPECT_EQ(out.max_position_drift, 0);
  EXPECT_EQ(out.max_velocity_drift, 0);
  EXPECT_GT(out.steps, 20);
  EXPECT_GE(out.evaluations, 6 * out.steps);
}

TEST(Simulate, CountsTheTimesAtWhichAConstraintLetsGo) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass  = [[1, 0], [0, 1]]
force = ["0", "1"]
[constraints]
acceleration = ["x*(ddx - ddy)"]
)toml",
                                   "lets go");
  const Trajectory out = simulate_model(model, state_of(model, {{"dx", 1}}), with_tolerance(times(1, 11), 1e-8));
  EXPECT_EQ(out.lower_rank.usual, 1);
  EXPECT_EQ(out.lower_rank.lowest, 0);
  EXPECT_EQ(out.lower_rank.states, std::vector<int>{0});
  const Trajectory away = simulate_model(model, state_of(model, {{"x", 1}, {"dx", 1}}), with_tolerance(times(1, 11), 1e-8));
  EXPECT_TRUE(away.lower_rank.states.empty());
}

TEST(Simulate, InterpolatesBetweenStepsAsWellAsItSteps) {
  const Model model = oscillator();
  const auto error = [&](double tolerance) {
    const Trajectory out = simulate_model(model, state_of(model, {{"x", 1}}), with_tolerance(times(10, 1001), tolerance));
    EXPECT_LT(out.steps, 500);  // most times lie within a step
    return (out.states.row(0).transpose().array() - out.times.array().cos()).abs().maxCoeff();
  };
  for (const double tolerance : {1e-4, 1e-6, 1e-8}) EXPECT_LT(error(tolerance), 30 * tolerance);
}

TEST(Simulate, ReachesTheSameStateWhateverIsWritten) {
  const Model& model = surface();
  const Trajectory few = simulate_model(model, figure_start(), with_tolerance(times(6, 2), 1e-6));
  const Trajectory many = simulate_model(model, figure_start(), with_tolerance(times(6, 301), 1e-6));
  EXPECT_EQ(few.states.col(1), many.states.col(300));
  EXPECT_EQ(few.steps, many.steps);
}

// Between the stages of a long step nothing acts.
TEST(Simulate, SeesAForceThatActsForAFewRows) {
  const Model pulse =
      Model::parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\nforce = [\"50*exp(-((t - 5)/0.05)^2)\"]\n", "pulse");
  const Trajectory pushed = simulate_model(pulse, state_of(pulse, {{"x", 0}}), with_tolerance(times(20, 1001), 1e-6));
  EXPECT_NEAR(pushed.states(1, 1000), 50 * 0.05 * std::sqrt(std::numbers::pi), 1e-3);
  const Model bump = Model::parse(R"toml(
coordinates = ["x", "z"]
[mechanics]
mass      = [["1", "0"], ["0", "1"]]
force     = ["0", "-9.81"]
potential = "9.81*z"
[constraints]
position = ["z - 0.05*exp(-((x - 5)/0.1)^2)"]
)toml",
                                  "bump");
  const Trajectory over = simulate_model(bump, solved_state(bump, {{"x", 0}, {"dx", 2}}), with_tolerance(times(5, 501), 1e-6));
  double slowest = 2;
  for (Eigen::Index i = 0; i < over.states.cols(); ++i) slowest = std::min(slowest, over.states(2, i));
  EXPECT_LT(slowest, 1.8) << "up the bump";
  EXPECT_NEAR(over.states(2, 500), 2, 1e-3) << "and down again";
}

// One of them says of a velocity that is 0 what two others say of each other.
TEST(Simulate, RedundantConstraintsMayHoldABodyStill) {
  for (const char* const coordinates : {R"("x", "z", "y")", R"("x", "y", "z")"}) {
    const bool is_z_last = std::string(coordinates).ends_with(R"("z")");
    const Model model = Model::parse(fmt::format(R"toml(
coordinates = [{}]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = [{}]
[constraints]
position = ["z - 1", "x - y", "x - y*z"]
)toml",
                                                 coordinates, is_z_last ? R"("0", "-y", "-1")" : R"("0", "-1", "-y")"),
                                     "held");
    const Trajectory out = simulate_model(model, state_of(model, {{"x", 0.3}, {"y", 0.3}, {"z", 1}, {"dx", 0.5}, {"dy", 0.5}}),
                                          with_tolerance(times(2, 5), 1e-8));
    ASSERT_EQ(out.states.cols(), 5);
    // ẍ = ÿ = −y/2
    const double w = std::sqrt(0.5);
    EXPECT_NEAR(out.states(0, 4), 0.3 * std::cos(2 * w) + 0.5 / w * std::sin(2 * w), 1e-6);
  }
}

// ---- dry friction

/// A model of one body or several without constraints, force[j] on coordinate j of mass 1.
Model bodies(const std::vector<std::string>& coordinates, const std::vector<std::string>& force, const std::string& more = "") {
  nlohmann::json mass = nlohmann::json::array();
  for (std::size_t j = 0; j < force.size(); ++j) {
    mass.push_back(std::vector<int>(force.size(), 0));
    mass[j][j] = 1;
  }
  return Model::parse(fmt::format("coordinates = {}\n[mechanics]\nmass = {}\nforce = {}\n{}", nlohmann::json(coordinates).dump(),
                                  mass.dump(), nlohmann::json(force).dump(), more),
                      "bodies.toml");
}

Trajectory simulate_switching(const Model& model, const VectorXd& start, SimulateOptions options) {
  options.switching = switching_functions(model, false);
  return simulate_model(model, start, options);
}

TEST(SimulateDryFriction, BringsABodyToRestAndHoldsItThere) {
  const Model model = bodies({"x"}, {"-2*sign(3*dx)"});
  const Trajectory out = simulate_switching(model, state_of(model, {{"dx", 1}}), with_tolerance(times(10, 101), 1e-9));
  EXPECT_LT(out.steps + out.rejected_steps, 100);
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = std::min(out.times[i], 0.5);
    EXPECT_NEAR(out.states(0, i), t - t * t, 1e-9);
    EXPECT_NEAR(out.states(1, i), 1 - 2 * t, 1e-9);
    EXPECT_NEAR(out.accelerations(0, i), out.times[i] < 0.5 ? -2 : 0, out.times[i] == 0.5 ? 2 : 1e-9);
  }
}

TEST(SimulateDryFriction, OfAVelocityOverItsSizeIsThatOfItsSign) {
  const Model sign = bodies({"x"}, {"-x - 0.3*sign(dx)"}), size = bodies({"x"}, {"-x - 0.3*dx/abs(dx)"});
  const SimulateOptions options = with_tolerance(times(20, 201), 1e-9);
  const Trajectory of_sign = simulate_switching(sign, state_of(sign, {{"x", 1}}), options);
  const Trajectory of_size = simulate_switching(size, state_of(size, {{"x", 1}}), options);
  EXPECT_LT((of_sign.states - of_size.states).cwiseAbs().maxCoeff(), 1e-8);
  EXPECT_LT(of_size.steps + of_size.rejected_steps, 500);
}

TEST(SimulateDryFriction, OfAVelocityOverAMultipleOfItsSizeRestsToo) {
  for (const std::string friction : {"2*dx/(3*abs(dx))", "2*dx/(k*sqrt(dx^2))", "2*dx/abs(-3*dx)", "2*k*dx/(k*sqrt((k*dx)^2))"}) {
    const Model model = bodies({"x"}, {"-" + friction}, "[parameters]\nk = 3\n");
    const Trajectory out = simulate_switching(model, state_of(model, {{"dx", 1}}), with_tolerance(times(3, 31), 1e-9));
    EXPECT_NEAR(out.states(0, 30), 0.75, 1e-9) << friction;
    EXPECT_NEAR(out.states(1, 30), 0, 1e-9) << friction;
    EXPECT_EQ(simulate_switching(model, state_of(model, {}), with_tolerance(times(1, 2), 1e-9)).states(0, 1), 0) << friction;
  }
}

TEST(SimulateDryFriction, ASpringPullsABodyToWhereItSticks) {
  // half swings about ±μ/k, each shorter by 2 μ/k: 1, −0.4, −0.2, which is within ±0.3
  const Model model = bodies({"x"}, {"-x - 0.3*sign(dx)"});
  const Trajectory out = simulate_switching(model, state_of(model, {{"x", 1}}), with_tolerance(times(20, 201), 1e-9));
  EXPECT_LT(out.steps + out.rejected_steps, 500);
  EXPECT_NEAR(out.states.row(0).minCoeff(), -0.4, 1e-3);
  EXPECT_NEAR(out.states(0, 200), -0.2, 1e-8);
  EXPECT_NEAR(out.states(1, 200), 0, 1e-12);
}

TEST(SimulateDryFriction, LetsABodyGoWhenTheForceIsLargeEnough) {
  const Model model = bodies({"x"}, {"t - 2*sign(dx)"});
  const Trajectory out = simulate_switching(model, state_of(model, {}), with_tolerance(times(4, 41), 1e-9));
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = std::max(out.times[i] - 2, 0.0);
    EXPECT_NEAR(out.states(1, i), t * t / 2, 1e-7) << out.times[i];
    EXPECT_NEAR(out.states(0, i), t * t * t / 6, 1e-7) << out.times[i];
  }
}

TEST(SimulateDryFriction, LetsABodyGoByAPulseOverAFewRows) {
  const Model model = bodies({"x"}, {"-4.905*sign(dx) + 60*exp(-((t - 3.7)/0.1)^2)"});
  const Trajectory out = simulate_switching(model, state_of(model, {{"x", 0}}), with_tolerance(times(10, 101), 1e-8));
  ASSERT_EQ(out.sticks.size(), 2U);
  EXPECT_NEAR(out.sticks[0].time, 3.7 - 0.1 * std::sqrt(std::log(60 / 4.905)), 1e-6);
  EXPECT_GT(out.states(0, 100), 9);
}

// A body that turns on while one friction holds it crosses the surface of another, be that as weak as can be.
TEST(SimulateDryFriction, HoldsABodyWhileAnotherChangesItsSide) {
  for (const double c : {0.0, 1e-6, 0.5}) {
    const std::string stuck = "9*sign(dx + 0.3*da)", weak = fmt::format("{}*sign(dx + 0.35*da)", c);
    const Model model = Model::parse(fmt::format("coordinates = [\"x\", \"a\"]\n[mechanics]\nmass = [[1, 0], [0, 0.05]]\n"
                                                 "force = [\"-{0} - {1}\", \"1 - 0.3*{0} - 0.35*{1}\"]\n",
                                                 stuck, weak),
                                     "two frictions");
    const Trajectory out =
        simulate_switching(model, state_of(model, {{"dx", 0.09}, {"da", -0.3}}), with_tolerance(times(0.5, 6), 1e-8));
    ASSERT_EQ(out.states.cols(), 6) << c;
    EXPECT_LT(out.steps, 100) << c;
    for (int i = 0; i < 6; ++i) EXPECT_NEAR(out.states(2, i) + 0.3 * out.states(3, i), 0, 1e-10) << c;
    // (0.05 + 0.3²) ä = 1, less c
    EXPECT_NEAR(out.states(3, 5), -0.3 + 0.5 / 0.14, c < 0.1 ? 1e-4 : 1) << c;
  }
}

TEST(SimulateDryFriction, TwoBodiesMoveAsOneUntilOneIsTornOff) {
  // friction between both; the first is slowed by the ground as well, until it rests while the second slides on
  const Model model = bodies({"x", "y"}, {"-sign(dx - dy) - 0.5*sign(dx)", "sign(dx - dy)"});
  const Trajectory out = simulate_switching(model, state_of(model, {{"dx", 2}}), with_tolerance(times(10, 1001), 1e-9));
  // 2 − 1.5 t = t at 0.8; from there as one with −0.25 until both rest at 0.8 + 3.2
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = out.times[i], together = std::max(0.8 - 0.25 * (t - 0.8), 0.0);
    EXPECT_NEAR(out.states(2, i), t < 0.8 ? 2 - 1.5 * t : together, 1e-8) << t;
    EXPECT_NEAR(out.states(3, i), t < 0.8 ? t : together, 1e-8) << t;
  }
  EXPECT_LT(out.steps + out.rejected_steps, 200);
}

TEST(SimulateDryFriction, HoldsABodyOnASlopeWithTheMultiplierOfRest) {
  const std::string slope = "[constraints]\nposition = [\"y + x/4\"]\n";
  const Model steep = bodies({"x", "y"}, {"-0.5*sign(dx)", "-1"}, slope), rough = bodies({"x", "y"}, {"-sign(dx)", "-1"}, slope);
  SimulateOptions options = with_tolerance(times(5, 11), 1e-9);
  // down the slope: −1/4 against friction
  const Trajectory held = simulate_switching(rough, state_of(rough, {}), options);
  EXPECT_EQ(held.states.topRows(4).cwiseAbs().maxCoeff(), 0);
  EXPECT_LT(held.accelerations.cwiseAbs().maxCoeff(), 1e-12);
  const Model slippery = bodies({"x", "y"}, {"-0.1*sign(dx)", "-1"}, slope);
  const Trajectory slid = simulate_switching(slippery, state_of(slippery, {}), options);
  // ddx (1 + 1/16) = 1/4 − 0.1
  EXPECT_NEAR(slid.accelerations(0, 10), 0.15 / 1.0625, 1e-9);
  EXPECT_NEAR(slid.states(0, 10), 0.5 * 25 * 0.15 / 1.0625, 1e-7);

  // at rest the constraint bears all but friction: Aᵀλ = ddq − F with F = (−1/4 of friction, −1)
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"x", 0}};
  request.times = options.times;
  const Trajectory motion = run_simulation(prepare_simulation(steep, request)).front();
  ASSERT_EQ(motion.records.rows(), 1);
  EXPECT_NEAR(motion.records(0, 5), 1, 1e-9);
}

TEST(SimulateDryFriction, BringsAMechanismOfRedundantConstraintsToRest) {
  const auto slider_crank = [](const std::string& friction) {
    std::string text = test::model("models/slider_crank.toml").text;
    const std::string smooth = "tanh(20*dq3)";
    return Model::parse(text.replace(text.find(smooth), smooth.size(), friction), "slider_crank.toml");
  };
  const Model dry = slider_crank("sign(dq3)"), steep = slider_crank("tanh(3000*dq3)");
  const VectorXd start = solved_state(dry, {{"q1", 0.3}, {"dq1", 20}});
  const Trajectory out = simulate_switching(dry, start, with_tolerance(times(3, 101), 1e-9));
  const Trajectory nearly = simulate_model(steep, start, with_tolerance(times(3, 101), 1e-9));
  EXPECT_LT((out.states - nearly.states).cwiseAbs().maxCoeff(), 0.1);
  EXPECT_LT((out.states - nearly.states).topRows(3).cwiseAbs().maxCoeff(), 1e-3);
  EXPECT_LT(out.states.col(100).segment(3, 3).cwiseAbs().maxCoeff(), 1e-9);
  EXPECT_LT(out.accelerations.col(100).cwiseAbs().maxCoeff(), 1e-6);
  EXPECT_LT(out.steps, nearly.steps);
}

TEST(SimulateDryFriction, AMechanismStopsWhereverItIsNearADeadCentreToo) {
  std::string text = test::model("models/slider_crank.toml").text;
  const std::string smooth = "tanh(20*dq3)";
  const Model dry = Model::parse(text.replace(text.find(smooth), smooth.size(), "sign(dq3)"), "slider_crank.toml");
  for (const double q1 : {0.0, 0.001, 0.3, 1.0, 3.1, 3.141592653589793, 6.2}) {
    for (const double dq1 : {-2.0, 0.01, 0.5, 3.0}) {
      SCOPED_TRACE(fmt::format("q1 = {}, dq1 = {}", q1, dq1));
      SimulateOptions options = with_tolerance(times(3, 101), 1e-9);
      options.max_steps = 5000;
      const double q2 = -std::asin(std::sin(q1) / 3), q3 = 0.1 * std::cos(q1) + 0.3 * std::cos(q2);
      const VectorXd start = solved_state(dry, {{"q1", q1}, {"q2", q2}, {"q3", q3}, {"dq1", dq1}});
      const Trajectory out = simulate_switching(dry, start, options);
      EXPECT_LT(out.steps + out.rejected_steps, 1000);
      // friction takes energy, and does not give any
      const SystemValues values = dry.system->evaluate(out.states, dry.system->parameter_values());
      double before = std::numeric_limits<double>::infinity();
      for (int i = 0; i < values.n_states(); ++i) {
        const auto dq = out.states.col(i).segment(3, 3);
        const double energy = 0.5 * dq.dot(values.M(i) * dq);
        EXPECT_LE(energy, before * (1 + 1e-6) + 1e-15) << i;
        before = energy;
      }
    }
  }
}

TEST(SimulateDryFriction, IsFoundInForcesTruthAndLatents) {
  const Model model = bodies({"x", "y"}, {"-sign(dx) - 2*sign(-3*dx/2)", "sign(x)"},
                             "[truth]\nforce = [\"-sign(dx + dy)\", \"0\"]\n"
                             "[[latent]]\nkernel = \"se\"\nfeatures = [\"x\", \"sign(dy)\"]\n");
  EXPECT_EQ(switching_functions(model, false).size(), 2);  // dx, dx + dy
  EXPECT_EQ(switching_functions(model, true).size(), 2);   // dx, dy
  EXPECT_EQ(switching_functions(oscillator(0.1), false).size(), 0);
  // over their length, of one velocity or several; not over one that is rounded off
  const Model lengths =
      bodies({"x", "y"}, {"-dx/sqrt(dx^2) - 2*dy/sqrt(4*dy*dy + (x*(dx - dy))^2/3)",
                          "-dy*(dx^2 + 1e-6)^(-1/2) + (dx^2 + dy^2)^(-1/2)/sqrt(dx^2 + x^2) + sqrt(dx^2 + dy^2)"});
  EXPECT_EQ(switching_functions(lengths, false).names(),
            (std::vector<std::string>{"dx", "2*dy, x*(dx - dy)/1.7320508075688772", "dx, dy"}));
  // with factors that do not move
  const Model scaled =
      bodies({"x", "y"}, {"-dx/(2*abs(dx)) - dx/abs(-k*dx)", "-k*dy/(k*sqrt((k*dy)^2 + dx^2)/2)"}, "[parameters]\nk = 2\n");
  EXPECT_EQ(switching_functions(scaled, false).names(), (std::vector<std::string>{"dx", "k*dy, dx"}));
  // what two bodies do to each other, written as each of them sees it
  EXPECT_EQ(switching_functions(bodies({"x", "y"}, {"-sign(dx - dy)", "-sign(dy - dx)"}), false).size(), 1);
}

TEST(SimulateDryFriction, IsLookedForInForcesOfAnyDepth) {
  // 300 000 sums below each other
  std::string let = "s0 = \"dx\"\n";
  for (int k = 1; k <= 30; ++k) {
    let += fmt::format("s{} = \"s{}", k, k - 1);
    for (int n = 0; n < 10'000; ++n) let += "+x";
    let += "\"\n";
  }
  const Model model = bodies({"x"}, {"-sign(dx) + s30"}, "[let]\n" + let);
  EXPECT_EQ(switching_functions(model, false).names(), std::vector<std::string>{"dx"});
}

// ---- dry friction in a plane

TEST(SimulateDryFriction, BringsABodyToRestInAPlaneAndHoldsItThere) {
  const Model model = bodies({"x", "y"}, {"-2*dx/sqrt(dx^2 + dy^2)", "-2*dy/sqrt(dx^2 + dy^2)"});
  const Trajectory out =
      simulate_switching(model, state_of(model, {{"dx", 0.6}, {"dy", -0.8}}), with_tolerance(times(10, 101), 1e-9));
  EXPECT_LT(out.steps + out.rejected_steps, 100);
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = std::min(out.times[i], 0.5), way = t - t * t;
    EXPECT_NEAR(out.states(0, i), 0.6 * way, 1e-9);
    EXPECT_NEAR(out.states(1, i), -0.8 * way, 1e-9);
    EXPECT_NEAR(out.accelerations.col(i).norm(), out.times[i] < 0.5 ? 2 : 0, out.times[i] == 0.5 ? 2 : 1e-9);
  }
  ASSERT_EQ(out.sticks.size(), 1);
  EXPECT_TRUE(out.sticks[0].sticks);
  EXPECT_NEAR(out.sticks[0].time, 0.5, 1e-8);
  EXPECT_EQ(switching_functions(model, false).names(), std::vector<std::string>{"dx, dy"});
}

TEST(SimulateDryFriction, LetsABodyGoInThePlaneAlongTheForce) {
  // at rest until the force 0.6 t, 0.8 t exceeds 2, though the force at the start is along another direction
  const Model model = bodies({"x", "y"}, {"max(0.6*t, 0.5) - 2*dx/sqrt(dx^2 + dy^2)", "0.8*t - 2*dy/sqrt(dx^2 + dy^2)"});
  const Trajectory out = simulate_switching(model, state_of(model, {}), with_tolerance(times(4, 41), 1e-9));
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = std::max(out.times[i] - 2, 0.0);
    EXPECT_NEAR(out.states(0, i), 0.6 * t * t * t / 6, 1e-7) << out.times[i];
    EXPECT_NEAR(out.states(1, i), 0.8 * t * t * t / 6, 1e-7) << out.times[i];
  }
}

/// A body on a slope in y, that a weight 1 pulls down it, with friction of limits `limit_x`, `limit_y` along the axes.
Model body_on_slope(double limit_x, double limit_y, double smoothing = 0) {
  const std::string length = fmt::format("sqrt({}*dx^2 + dy^2*{} + {})", limit_x * limit_x, limit_y * limit_y, smoothing);
  return bodies({"x", "y"},
                {fmt::format("-{}*dx/{}", limit_x * limit_x, length), fmt::format("-1 - {}*dy/{}", limit_y * limit_y, length)});
}

TEST(SimulateDryFriction, TurnsABodyOnASlopeDownwardsUntilItRests) {
  for (const auto& [limit_x, limit_y] : {std::pair(1.3, 1.3), {2.0, 1.5}, {0.5, 4.0}, {3.0, 1.4}}) {
    for (const double angle : {0.7, 1.57, -1.5707}) {
      SCOPED_TRACE(fmt::format("limits {}, {}, angle {}", limit_x, limit_y, angle));
      const Model rough = body_on_slope(limit_x, limit_y), nearly = body_on_slope(limit_x, limit_y, 1e-6);
      const VectorXd start = state_of(rough, {{"dx", std::cos(angle)}, {"dy", std::sin(angle)}});
      const SimulateOptions options = with_tolerance(times(5, 51), 1e-9);
      const Trajectory out = simulate_switching(rough, start, options);
      EXPECT_LT(out.steps + out.rejected_steps, 2000);
      EXPECT_LT(out.states.col(50).segment(2, 2).norm(), 1e-12);
      EXPECT_LT(out.accelerations.col(50).norm(), 1e-9);
      // with friction rounded off at 1e-3, the body creeps at some such velocity where it should rest
      const Trajectory creeping = simulate_model(nearly, start, with_tolerance(options.times, 1e-6));
      EXPECT_LT((out.states - creeping.states).cwiseAbs().maxCoeff(), 10 * 5 * 1e-3);
      EXPECT_LT(out.steps, creeping.steps);
    }
  }
}

TEST(SimulateDryFriction, LetsABodyGoWhereTheEllipseOfItsLimitsEnds) {
  // limits 2 along x and 1 along y: a force (0.8 t, 0.3 t) is held until (0.4 t)² + (0.3 t)² = 1
  const Model model = bodies({"x", "y"}, {"0.8*t - 4*dx/sqrt(4*dx^2 + dy^2)", "0.3*t - dy/sqrt(4*dx^2 + dy^2)"});
  const Trajectory out = simulate_switching(model, state_of(model, {}), with_tolerance(times(4, 41), 1e-9));
  ASSERT_EQ(out.sticks.size(), 1);
  EXPECT_NEAR(out.sticks[0].time, 2, 1e-7);
}

TEST(SimulateDryFriction, InAPlaneOfTwoContactsHoldsEachByItsOwnLimit) {
  // a body on a body on the ground, both free in the plane: the lower one stops first
  const std::string upper = "sqrt((dx - du)^2 + (dy - dv)^2)", lower = "sqrt(du^2 + dv^2)";
  const auto model_of = [&](const std::string& more) {
    const auto between = [&](const std::string& d) {
      return fmt::format("({})/{}", d, more.empty() ? upper : upper.substr(0, upper.size() - 1) + more);
    };
    const auto ground = [&](const std::string& d) {
      return fmt::format("{}/{}", d, more.empty() ? lower : lower.substr(0, lower.size() - 1) + more);
    };
    return bodies({"x", "y", "u", "v"},
                  {"-" + between("dx - du"), "-" + between("dy - dv"), between("dx - du") + " - 0.5*" + ground("du"),
                   between("dy - dv") + " - 0.5*" + ground("dv")});
  };
  const Model rough = model_of(""), nearly = model_of(" + 1e-8)");
  const VectorXd start = state_of(rough, {{"dx", 2}, {"dy", 1}, {"dv", -1}});
  const SimulateOptions options = with_tolerance(times(10, 101), 1e-9);
  const Trajectory out = simulate_switching(rough, start, options), creeping = simulate_model(nearly, start, options);
  EXPECT_LT(out.steps + out.rejected_steps, 1000);
  EXPECT_LT((out.states - creeping.states).cwiseAbs().maxCoeff(), 10 * 10 * 1e-4);
  EXPECT_LT(out.states.col(100).segment(4, 4).norm(), 1e-12);
  // together first, and at rest together then
  ASSERT_EQ(out.sticks.size(), 2);
}

TEST(SimulateDryFriction, AlongDirectionsThatAreNearlyOneIsThatOfOne) {
  const auto motion = [](const std::string& apart) {
    const Model model = bodies({"x", "y"}, {fmt::format("4.37*sin(2.58*t) - 2.55*sign(dx) - 0.34*sign(dx + {}*dy)", apart),
                                            "4.5*cos(1.88*t) - 1.5*y + x"});
    const Trajectory out =
        simulate_switching(model, state_of(model, {{"dx", 0.3}, {"dy", -0.2}}), with_tolerance(times(6, 61), 1e-9));
    EXPECT_LT(out.steps + out.rejected_steps, 1000) << apart;
    return MatrixXd(out.states.topRows(4));
  };
  const MatrixXd of_one = motion("0");
  for (const std::string apart : {"1e-10", "1e-8", "3e-8", "1e-7"}) {
    const MatrixXd states = motion(apart);
    ASSERT_EQ(states.cols(), of_one.cols()) << apart;
    EXPECT_LT((states - of_one).cwiseAbs().maxCoeff(), 1e-5) << apart;
  }
}

TEST(SimulateUnfinished, SaysWhatWasReached) {
  const Model model = oscillator();
  SimulateOptions options = with_tolerance(times(100, 101), 1e-9);
  options.max_steps = 200;
  try {
    simulate_model(model, state_of(model, {{"x", 1}}), options);
    FAIL();
  } catch (const UnfinishedMotion& unfinished) {
    EXPECT_THAT(unfinished.what(), StartsWith("simulate: 200 steps reach no further than t = "));
    ASSERT_EQ(unfinished.motions.size(), 1);
    const Trajectory& out = unfinished.motions[0];
    EXPECT_EQ(out.steps + out.rejected_steps, 200);
    ASSERT_GT(out.times.size(), 10);
    EXPECT_EQ(out.states.cols(), out.times.size());
    EXPECT_EQ(out.accelerations.cols(), out.times.size());
    for (int i = 0; i < out.times.size(); ++i) EXPECT_NEAR(out.states(0, i), std::cos(out.times[i]), 1e-7);
  }
}

TEST(SimulateUnfinished, AnEndThatDoublesCannotReachIsToldAtOnce) {
  const Model model = oscillator();
  EXPECT_THAT(numerical_error_of([&] {
                simulate_model(model, state_of(model, {{"x", 1}}), with_tolerance(times(1e300, 3), 1e-6));
              }),
              AllOf(StartsWith("simulate: at t = "), HasSubstr("the end, 1e+300, is so far")));
  // what rests may do so for ever
  EXPECT_NO_THROW(simulate_model(model, state_of(model, {}), with_tolerance(times(1e300, 3), 1e-6)));
  EXPECT_THAT(input_error_of([&] { simulate_model(model, state_of(model, {}), with_tolerance(times(1, 3), 1e-30)); }),
              StartsWith("simulate: the relative tolerance must be at least 1e-14"));
}

// ---- inputs

TEST(SimulateInputs, AreLinearBetweenTheTimesOfTheTableAndHeldAtItsEnds) {
  const InputSignal signal(Eigen::Vector3d(1, 2, 4), (MatrixXd(2, 3) << 0, 1, -1, 5, 5, 5).finished());
  const auto at = [&](double t) {
    VectorXd u(2);
    signal.evaluate(t, u);
    return u;
  };
  EXPECT_EQ(at(0), Eigen::Vector2d(0, 5));
  EXPECT_EQ(at(1), Eigen::Vector2d(0, 5));
  EXPECT_EQ(at(1.25), Eigen::Vector2d(0.25, 5));
  EXPECT_EQ(at(2), Eigen::Vector2d(1, 5));
  EXPECT_EQ(at(3), Eigen::Vector2d(0, 5));
  EXPECT_EQ(at(9), Eigen::Vector2d(-1, 5));
  EXPECT_EQ(signal.next_kink(0), 1);
  EXPECT_EQ(signal.next_kink(1), 2);
  EXPECT_EQ(signal.next_kink(4), std::numeric_limits<double>::infinity());
  VectorXd u = VectorXd::Ones(2);
  InputSignal().evaluate(3, u);
  EXPECT_EQ(u, VectorXd::Zero(2));
}

TEST(SimulateInputs, HaveNoKinkWhereTheTableGoesOnStraight) {
  const VectorXd t = times(10, 1001);
  const InputSignal ramp(t, 3 * t.transpose());
  EXPECT_EQ(ramp.next_kink(-1), 0);
  EXPECT_EQ(ramp.next_kink(0), 10);
}

TEST(SimulateInputs, AShortPulseIsNotSteppedOver) {
  // at rest for 50 s; then a triangle of 10 ms and area 1 N s sets the unit mass off at 1 m/s
  const Model model =
      Model::parse("coordinates = [\"x\"]\ninputs = [\"f\"]\n[mechanics]\nmass = [[1]]\nforce = [\"f\"]\n", "mass.toml");
  SimulateOptions options = with_tolerance(Eigen::Vector2d(0, 100), 1e-9);
  options.inputs = InputSignal(Eigen::Vector3d(50, 50.005, 50.01), Eigen::RowVector3d(0, 200, 0));
  const Trajectory out = simulate_model(model, VectorXd::Zero(4), options);
  EXPECT_NEAR(out.states(1, 1), 1, 1e-12);
  EXPECT_NEAR(out.states(0, 1), 49.995, 1e-10);
}

TEST(SimulateInputs, MustFitTheSystemAndBeInOrder) {
  const MatrixXd two = MatrixXd::Zero(1, 2);
  EXPECT_EQ(input_error_of([&] { InputSignal(Eigen::Vector2d(1, 1), two); }), "inputs: times must increase, but 1 follows 1");
  EXPECT_EQ(input_error_of([&] { InputSignal(Eigen::Vector3d(1, 2, 3), two); }),
            "inputs: 3 times for 2 columns of values; give as many, at least one");
  EXPECT_EQ(input_error_of([&] { InputSignal(Eigen::Vector2d(1, NAN), two); }),
            "inputs: a time or a value is not a finite number");
  SimulateOptions options = with_tolerance(times(1, 2), 1e-6);
  options.inputs = InputSignal(Eigen::Vector2d(0, 1), two);
  EXPECT_EQ(input_error_of([&] { simulate_model(surface(), figure_start(), options); }),
            "simulate: the table of inputs has 1 rows, the system 3 inputs");
}

// ---- the published trajectory

TEST(SimulateSurface, FollowsTheAccurateSolutionOfThePublishedFigure) {
  if (const auto absent = test::why_reference_is_absent()) GTEST_SKIP() << *absent;
  const auto figure = nlohmann::json::parse(read_file(test::reference_file("fig_c.json")));
  const auto& accurate = figure.at("accurate_analytic_states");
  const auto initial = figure.at("setup").at("initial_state_on_surface").get<std::vector<double>>();
  const int n = static_cast<int>(accurate.size());
  const double step = figure.at("setup").at("step").get<double>();
  VectorXd start = VectorXd::Zero(published_surface().system->layout().size());
  std::copy(initial.begin(), initial.end(), start.begin());
  EXPECT_LT((start - figure_start()).lpNorm<Eigen::Infinity>(), 1e-15);
  for (const bool project : {true, false}) {
    const Trajectory out = simulate_model(published_surface(), start, with_tolerance(times(n * step, n + 1), 1e-12, project));
    double error = 0;
    for (int i = 0; i < n; ++i) {
      const auto row = accurate.at(static_cast<std::size_t>(i)).get<std::vector<double>>();
      for (int k = 0; k < 6; ++k) error = std::max(error, std::abs(out.states(k, i + 1) - row[static_cast<std::size_t>(k)]));
    }
    RecordProperty(project ? "error_projected" : "error", fmt::format("{:.3g}", error));
    EXPECT_LT(error, 1e-8) << (project ? "projected" : "not projected");
  }
}

// ---- constraints

TEST(SimulateSurface, StaysOnTheConstraintToRoundingOverAnyHorizon) {
  for (const double t_end : {6.0, 600.0}) {
    for (const double tolerance : {1e-3, 1e-6}) {
      const Trajectory out = simulate_model(surface(), figure_start(), with_tolerance(times(t_end, 601), tolerance));
      EXPECT_LE(out.max_position_drift, 1e-12) << t_end;
      EXPECT_LE(out.max_velocity_drift, 1e-12) << t_end;
      const MatrixXd c = surface().system->residuals(out.states, surface().system->parameter_values());
      EXPECT_EQ(c.row(0).cwiseAbs().maxCoeff(), out.max_position_drift);
      EXPECT_EQ(c.row(1).cwiseAbs().maxCoeff(), out.max_velocity_drift);
    }
  }
}

/// log(drift₁/drift₂) / log(h₁/h₂), h the mean step, between two tolerances.
double order_of_drift(const std::function<Trajectory(double)>& run, double coarse, double fine) {
  const Trajectory a = run(coarse), b = run(fine);
  return std::log(a.max_position_drift / b.max_position_drift) / std::log(static_cast<double>(b.steps) / a.steps);
}

TEST(SimulateSurface, WithoutProjectionDriftFallsAtTheOrderOfTheIntegrator) {
  const auto run = [&](double tolerance) {
    return simulate_model(surface(), figure_start(), with_tolerance(times(6, 2), tolerance, false));
  };
  const double order = order_of_drift(run, 1e-6, 1e-10);
  EXPECT_GT(order, 4.5);
  EXPECT_LT(order, 7);  // what one step adds to c is of order 6
  EXPECT_GT(run(1e-5).max_position_drift, 1e-7);
}

class SimulateModel : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, SimulateModel, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(SimulateModel, StaysOnItsConstraintsAndProjectionChangesNothingElse) {
  const Model& model = test::model(GetParam());
  VectorXd start = test::draw(model, 1, 3).states.col(0);
  start = start.array().isNaN().select(0, start);
  const double t0 = start[model.system->layout().t()];
  const auto run = [&](double tolerance, bool project) {
    return simulate_model(model, start, with_tolerance(times(t0 + 0.5, 26, t0), tolerance, project));
  };
  const Trajectory accurate = run(1e-11, false);
  const Trajectory projected = run(1e-8, true);
  const VectorXd size = accurate.states.cwiseAbs().rowwise().maxCoeff().cwiseMax(1);
  // constraint rows of these models have entries of the size of the state at most
  EXPECT_LE(projected.max_position_drift, 50 * test::eps * size.maxCoeff() * size.maxCoeff());
  EXPECT_LE(projected.max_velocity_drift, 50 * test::eps * size.maxCoeff() * size.maxCoeff());
  for (int i = 0; i < accurate.states.cols(); ++i) {
    const VectorXd error = (projected.states.col(i) - accurate.states.col(i)).cwiseQuotient(size);
    EXPECT_LT(error.lpNorm<Eigen::Infinity>(), 3e-6) << "row " << i;
  }
  EXPECT_LT(run(1e-11, true).start_displacement, 1e-12 * size.maxCoeff());
}

TEST_P(SimulateModel, IsTheSameToTheBitEachTime) {
  const Model& model = test::model(GetParam());
  VectorXd start = test::draw(model, 1, 4).states.col(0);
  start = start.array().isNaN().select(0, start);
  const auto run = [&] { return simulate_model(model, start, with_tolerance(times(0.3, 7), 1e-7)); };
  const Trajectory a = run(), b = run();
  EXPECT_EQ(a.states, b.states);
  EXPECT_EQ(a.accelerations, b.accelerations);
}

TEST(SimulateRedundant, ASliderCrankTurnsAsItDoesWithoutTheRedundantRow) {
  const Model& redundant = test::model("models/slider_crank.toml");
  std::string text = redundant.text;
  const std::string row = ",\n            \"(q3 - r*cos(q1))^2 + (r*sin(q1))^2 - l^2\"";
  text.erase(text.find(row), row.size());
  const Model plain = Model::parse(text, "plain.toml");
  const VectorXd start = solved_state(plain, {{"q1", 0.3}, {"dq1", 5}});
  ASSERT_GT(start[2], 0.3);  // the slider is on its side of the axle
  for (const bool project : {true, false}) {
    const auto options = with_tolerance(times(2, 41), 1e-9, project);
    const Trajectory a = simulate_model(redundant, start, options), b = simulate_model(plain, start, options);
    EXPECT_LT((a.states - b.states).cwiseAbs().maxCoeff(), 1e-6) << project;
    EXPECT_GT((a.states.col(40) - a.states.col(0)).cwiseAbs().maxCoeff(), 1);
    if (project) {
      EXPECT_LE(a.max_position_drift, 1e-14);
      EXPECT_LE(a.max_velocity_drift, 1e-13);
    } else {
      EXPECT_GT(a.max_position_drift, 1e-12);
    }
  }
}

TEST(SimulateUnicycle, RollsWithoutSlipAndNeedsNoPosition) {
  const Model& model = test::model("models/unicycle.toml");
  SimulateOptions options = with_tolerance(times(20, 201), 1e-7);
  options.inputs = InputSignal(Eigen::Vector3d(0, 5, 10), (MatrixXd(2, 3) << 0.3, 0.3, 0.3, 0, 0.02, -0.02).finished());
  const Trajectory out = simulate_model(model, VectorXd::Zero(9), options);
  EXPECT_EQ(out.max_position_drift, 0);  // it has no position constraint
  EXPECT_LE(out.max_velocity_drift, 1e-14);
  EXPECT_GT(out.states.topRows(3).rowwise().maxCoeff().minCoeff(), 0.5);  // it did move
  // positions are the integral of velocities
  for (int i = 1; i + 1 < out.states.cols(); ++i) {
    const double dt = out.times[i + 1] - out.times[i];
    for (int j = 0; j < 3; ++j) {
      // Simpson's rule needs the middle; Hermite's uses accelerations: ∫dq = dt (dq₀ + dq₁)/2 + dt² (ddq₀ − ddq₁)/12 + O(dt⁵)
      const double integral = dt * (out.states(3 + j, i) + out.states(3 + j, i + 1)) / 2 +
                              dt * dt * (out.accelerations(j, i) - out.accelerations(j, i + 1)) / 12;
      EXPECT_NEAR(out.states(j, i + 1) - out.states(j, i), integral, 1e-5);
    }
  }
}

TEST(SimulateDuffing, FollowsAConstraintThatMovesWithTime) {
  const Model& model = test::model("models/duffing.toml");
  const VectorXd start = solved_state(model, {{"q2", 0.5}, {"dq2", 0}});
  EXPECT_NEAR(start[2], 2 * M_PI, 1e-12);  // d/dt of A0 exp(−αt) sin(ωt) at 0
  const Trajectory out = simulate_model(model, start, with_tolerance(times(5, 101), 1e-8));
  for (int i = 0; i < out.states.cols(); ++i) {
    EXPECT_NEAR(out.states(0, i) - out.states(1, i), std::exp(-0.3 * out.times[i]) * std::sin(2 * M_PI * out.times[i]), 1e-14);
  }
  EXPECT_LE(out.max_velocity_drift, 1e-13);
}

// ---- constraints that come and go

/// Two coordinates, unit masses, and velocity constraints.
Model switched(const std::string& force, const std::string& constraints) {
  return Model::parse("coordinates = [\"x\", \"y\"]\ninputs = [\"grip\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [" +
                          force + "]\n[constraints]\nvelocity = [" + constraints + "]\n",
                      "switched.toml");
}
Model coupled(const std::string& force, const std::string& when) {
  return switched(force, "{ expr = \"dx - dy\", when = \"" + when + "\" }");
}

SimulateOptions at_times(const VectorXd& times) {
  SimulateOptions options;
  options.times = times;
  return options;
}

// Free of forces a step grows past any gate. Momentum gives both coordinates half the velocity at its edge, which they keep.
TEST(SimulateConditions, AGateIsNotSteppedOverWhateverItsWidth) {
  for (const double width : {0.004, 0.02, 0.1, 0.3, 1.0}) {
    const Model model = coupled(R"("0", "0")", fmt::format("abs(x - 2.925) < {}", width / 2));
    const Trajectory out = simulate_model(model, state_of(model, {{"dx", 5}}), at_times(times(1, 1001)));
    const double t_edge = (2.925 - width / 2) / 5;
    for (int i = 0; i < out.states.cols(); ++i) {
      const double since = std::max(0.0, out.times[i] - t_edge);
      EXPECT_NEAR(out.states(0, i), 5 * out.times[i] - 2.5 * since, 1e-12) << width << ", " << out.times[i];
      EXPECT_NEAR(out.states(1, i), 2.5 * since, 1e-12) << width << ", " << out.times[i];
      if (std::abs(out.times[i] - t_edge) < 1e-12) continue;
      EXPECT_NEAR(out.states(2, i), since > 0 ? 2.5 : 5, 1e-12) << width << ", " << out.times[i];
      EXPECT_NEAR(out.states(3, i), since > 0 ? 2.5 : 0, 1e-12) << width << ", " << out.times[i];
    }
    EXPECT_LT(out.steps, 15);
    // a wide one is found between two times as well
    if (width < 1) continue;
    const Trajectory ends = simulate_model(model, state_of(model, {{"dx", 5}}), at_times(times(1, 2)));
    EXPECT_NEAR(ends.states(3, 1), 2.5, 1e-12);
  }
}

// Stages beyond an edge are under other constraints; the motion up to the edge has none of that.
TEST(SimulateConditions, UnderForcesAGateIsEnteredAndLeftWithinTheTolerances) {
  const Model model = coupled(R"("2", "-1")", "abs(x - 2) < 0.25");
  const Trajectory out = simulate_model(model, state_of(model, {{"dx", 1}}), at_times(times(2, 41)));
  // x = t + t² up to 1.75, then x″ = y″ = 1/2 up to 2.25, then as before
  const double t1 = (std::sqrt(8.0) - 1) / 2, v1 = (1 + 2 * t1 - t1) / 2, y1 = -t1 * t1 / 2;
  const double t2 = t1 + 2 * (std::sqrt(v1 * v1 + 0.5) - v1), v2 = v1 + (t2 - t1) / 2, y2 = y1 + 0.5;
  ASSERT_LT(t2, 1.9);
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = out.times[i], held = t - t1, after = t - t2;
    Eigen::Vector4d x(t + t * t, -t * t / 2, 1 + 2 * t, -t);
    if (held > 0) x << 1.75 + v1 * held + held * held / 4, y1 + v1 * held + held * held / 4, v1 + held / 2, v1 + held / 2;
    if (after > 0) x << 2.25 + v2 * after + after * after, y2 + v2 * after - after * after / 2, v2 + 2 * after, v2 - after;
    EXPECT_LT((out.states.col(i).head(4) - x).lpNorm<Eigen::Infinity>(), 1e-6) << t;
  }
}

TEST(SimulateConditions, AWindowOfTimeTakesHoldAndLetsGoAtItsEnds) {
  const Model model = coupled(R"("1", "0")", "abs(t - 1.1) < 0.1");
  const Trajectory out = simulate_model(model, state_of(model, {{"dx", 5}}), at_times(times(2, 18)));
  for (int i = 0; i < out.states.cols(); ++i) {
    const double t = out.times[i];                               // none of which is an end
    const double apart = t < 1 ? 5 + t : t < 1.2 ? 0 : t - 1.2;  // dx − dy
    EXPECT_NEAR(out.states(2, i) - out.states(3, i), apart, 1e-9) << t;
    EXPECT_NEAR(out.states(2, i) + out.states(3, i), 5 + t, 1e-9) << t;
  }
  // one that an input opens, half way up its ramp
  const Model gripped = coupled(R"("1", "0")", "grip > 0.5");
  SimulateOptions options = at_times(times(2, 21));
  options.inputs = InputSignal(Eigen::Vector3d(0, 0.5, 0.6), Eigen::RowVector3d(0, 0, 1));
  const Trajectory grip = simulate_model(gripped, state_of(gripped, {{"dx", 5}}), options);
  const double free = 0.55, v = (5 + free) / 2, held = 2 - free;
  EXPECT_NEAR(grip.states(1, 20), v * held + held * held / 4, 1e-9);
  EXPECT_NEAR(grip.states(3, 20), v + held / 2, 1e-9);
}

TEST(SimulateConditions, OneThatNeverTurnsChangesNothing) {
  const std::string force = R"x("-x - 0.3*dy", "-4*sin(y)")x";
  const auto motion = [](const Model& model) {
    return simulate_model(model, state_of(model, {{"x", 1}, {"dx", 0.5}, {"dy", 0.5}}), at_times(times(3, 31)));
  };
  const Trajectory always = motion(coupled(force, "t > -1")), never = motion(coupled(force, "t < -1"));
  const Trajectory with = motion(switched(force, R"("dx - dy")"));
  EXPECT_EQ(always.states, with.states);
  EXPECT_EQ(always.evaluations, with.evaluations);
  const Model free = Model::parse(
      "coordinates = [\"x\", \"y\"]\ninputs = [\"grip\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [" + force + "]\n",
      "free.toml");
  const Trajectory without = motion(free);
  EXPECT_EQ(never.states, without.states);
  EXPECT_EQ(never.evaluations, without.evaluations);
}

TEST(SimulateConditions, SeveralTakeHoldAtOneEdge) {
  const Model model = switched(R"("1", "0")", R"({ expr = "dx - 2", when = "x > 1" }, { expr = "dy - 1", when = "x >= 1" })");
  const Trajectory out = simulate_model(model, state_of(model, {{"dx", 1}}), at_times(times(3, 4)));
  const double t_edge = std::sqrt(3.0) - 1;
  EXPECT_NEAR(out.states(0, 3), 1 + 2 * (3 - t_edge), 1e-9);
  EXPECT_NEAR(out.states(1, 3), 3 - t_edge, 1e-9);
}

// A governor that takes away what is above 3 undoes its own condition, at once and again and again.
TEST(SimulateConditions, OneThatItsConstraintUndoesHoldsNothingUp) {
  const Model model = switched(R"("4", "0")", R"({ expr = "dx - 3", when = "dx > 3" })");
  const Trajectory out = simulate_model(model, state_of(model, {}), at_times(times(1.5, 16)));
  EXPECT_NEAR(out.states(0, 15), 1.125 + 2.25, 1e-3);
  EXPECT_NEAR(out.states(2, 15), 3, 1e-3);
  EXPECT_LT(out.steps, 10000);
}

// What is thrown back at the edge slides the other way then, and dry friction turns with it.
TEST(SimulateConditions, DryFrictionTurnsWithWhatTakesHold) {
  const Model model = coupled(R"x("-sign(dx)", "0")x", "abs(x - 1) < 0.05");
  SimulateOptions options = at_times(times(4, 401));
  options.switching = switching_functions(model, /*of_latents=*/false);
  const Trajectory out = simulate_model(model, state_of(model, {{"dx", 2.5}, {"dy", -6}}), options);
  const double back = (6 - std::sqrt(2.5 * 2.5 - 2 * 0.95)) / 2;
  EXPECT_NEAR(out.states(0, 400), 0.95 - back * back / 2, 1e-6);
  EXPECT_EQ(out.states(2, 400), 0);
  EXPECT_NEAR(out.states(3, 400), -back, 1e-6);
}

// A ball that bounces and rubs on, past the gate of a coupling.
TEST(SimulateConditions, StandBesideContactsAndDryFriction) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z", "s"]
inputs = ["touch"]
[mechanics]
mass  = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
force = ["-0.1*sign(dx)", "-9.81", "0"]
[constraints]
velocity = [{ expr = "dx - ds", when = "abs(x - 1.5) < 0.05" }]
position = [{ expr = "z", contact = "touch", restitution = 0.5 }]
)toml",
                                   "ball.toml");
  SimulateOptions options = at_times(times(2, 401));
  options.switching = switching_functions(model, /*of_latents=*/false);
  options.contacts = contacts_of(model, model.system->parameter_values());
  const Trajectory out = simulate_model(model, state_of(model, {{"z", 0.5}, {"dx", 2}}), options);
  // the deceleration of 0.1 is shared within the gate
  const double v1 = std::sqrt(4 - 0.2 * 1.45), t1 = (2 - v1) / 0.1, v2 = std::sqrt(v1 * v1 / 4 - 2 * 0.05 * 0.1);
  const double t2 = t1 + (v1 / 2 - v2) / 0.05, since = 2 - t2;
  EXPECT_NEAR(out.states(0, 400), 1.55 + v2 * since - 0.05 * since * since, 1e-7);
  EXPECT_NEAR(out.states(1, 400), 0, 1e-12);
  EXPECT_NEAR(out.states(2, 400), 0.1 + v2 * since, 1e-7);
  EXPECT_NEAR(out.states(5, 400), v2, 1e-7);
  EXPECT_EQ(out.events.size(), 23);
}

// ---- energy

Model pendulum() {
  return Model::parse(
      "coordinates = [\"x\", \"y\"]\n[parameters]\nm = 2\nl = 1\n[mechanics]\nmass = [[\"m\", 0], [0, \"m\"]]\n"
      "force = [0, \"-m*9.81\"]\npotential = \"m*9.81*y\"\n[constraints]\nposition = [\"x^2 + y^2 - l^2\"]\n",
      "pendulum.toml");
}

TEST(SimulateEnergy, OfAnUndampedPendulumIsKeptToTheTolerance) {
  const Model model = pendulum();
  const VectorXd start = solved_state(model, {{"x", 0.8}, {"y", -0.6}});
  double before = 1;
  for (const double tolerance : {1e-5, 1e-7, 1e-9}) {
    const Trajectory out = simulate_model(model, start, with_tolerance(times(20, 401), tolerance));
    const VectorXd energy = mechanical_energy(model, model.system->parameter_values(), out.states);
    EXPECT_NEAR(energy[0], -2 * 9.81 * 0.6, 1e-13);
    const double drift = (energy.array() - energy[0]).abs().maxCoeff();
    EXPECT_LT(drift, 1e4 * tolerance);
    EXPECT_LT(drift, before / 20);
    before = drift;
    EXPECT_LE(out.max_position_drift, 20 * test::eps);
  }
}

TEST_P(SimulateModel, PotentialIsTheOneOfTheForcesThatWrite) {
  // without inputs, speeds and [truth], a force field is −∂V/∂q
  const Model& model = test::model(GetParam());
  if (!model.potential || test::stem(GetParam()) == "duffing") GTEST_SKIP() << "no potential of F alone";
  VectorXd state = test::draw(model, 1, 3).states.col(0);
  state = state.array().isNaN().select(0, state);
  state.tail(state.size() - model.system->nq()).setZero();
  const VectorXd parameters = model.system->parameter_values();
  const VectorXd force = model.system->evaluate(state, parameters).F(0);
  for (int j = 0; j < model.system->nq(); ++j) {
    const auto energy = [&](double x) -> VectorXd {
      VectorXd moved = state;
      moved[j] = x;
      return mechanical_energy(model, parameters, moved);
    };
    EXPECT_TRUE(test::matches(-force.segment(j, 1), test::central_difference(energy, state[j], 1))) << j;
  }
}

TEST(SimulateEnergy, NeedsAPotential) {
  const Model& model = test::model("models/unicycle.toml");
  EXPECT_THAT(input_error_of([&] { mechanical_energy(model, model.system->parameter_values(), VectorXd::Zero(9)); }),
              HasSubstr("unicycle.toml: no energy without [mechanics] potential"));
}

// ---- the start

TEST(SimulateStart, OffTheConstraintIsProjectedAndReported) {
  VectorXd start = figure_start();
  start[2] += 1e-3;
  start[5] -= 2e-3;
  const Trajectory out = simulate_model(surface(), start, with_tolerance(times(0.1, 3), 1e-6));
  EXPECT_NEAR(out.start_position_residual, 1e-3, 1e-12);
  EXPECT_GT(out.start_velocity_residual, 1e-3);
  EXPECT_GT(out.start_displacement, 1e-4);
  EXPECT_LE(out.start_displacement, 2e-3);
  EXPECT_LE(out.max_position_drift, 1e-15);
}

TEST(SimulateStart, OffTheConstraintIsTakenAsItIsWithoutProjection) {
  VectorXd start = figure_start();
  start[2] += 1e-3;
  const Trajectory out = simulate_model(surface(), start, with_tolerance(times(0.1, 3), 1e-6, false));
  EXPECT_EQ(out.states.col(0).head(6), start.head(6));
  EXPECT_EQ(out.start_displacement, 0);
  EXPECT_NEAR(out.start_position_residual, 1e-3, 1e-12);
  EXPECT_NEAR(out.max_position_drift, 1e-3, 1e-5);
}

TEST(SimulateStart, IsMovedAsLittleAsCanBeInTheMetricOfM) {
  // a bead on a line x + y = 0 whose second coordinate is 9 times as heavy: it moves a ninth as far
  const Model model = Model::parse(
      "coordinates = [\"x\", \"y\"]\n[mechanics]\nmass = [[1, 0], [0, 9]]\n[constraints]\nposition = [\"x + y\"]\n", "line.toml");
  const VectorXd moved = project_onto_constraints(*model.system, VectorXd(), state_of(model, {{"x", 1}, {"dy", 10}}));
  EXPECT_NEAR(moved[0], 0.1, 1e-15);
  EXPECT_NEAR(moved[1], -0.1, 1e-15);
  EXPECT_NEAR(moved[2], -9, 1e-14);
  EXPECT_NEAR(moved[3], 9, 1e-14);
}

TEST(SimulateStart, KeepsWhatIsHeld) {
  const Model& model = test::model("models/double_pendulum.toml");
  const VectorXd state = solved_state(model, {{"q3", 2.5}, {"q6", 4}, {"dq3", 1}, {"dq6", -3}});
  EXPECT_EQ(state[2], 2.5);
  EXPECT_EQ(state[5], 4);
  EXPECT_EQ(state[8], 1);
  EXPECT_EQ(state[11], -3);
  EXPECT_LT(model.system->residuals(state, model.system->parameter_values()).lpNorm<Eigen::Infinity>(), 1e-15);
}

TEST(SimulateStart, ThatCannotBePutOnTheConstraintSaysWhere) {
  const Model model = pendulum();
  // x = 2 is out of reach of a rod of 1 m
  EXPECT_THAT(numerical_error_of([&] {
                solved_state(model, {{"x", 2}});
              }),
              AllOf(HasSubstr("the projection onto the constraints did not converge at t = 0: \"x^2 + y^2 - l^2\" is off by")));
  EXPECT_THAT(numerical_error_of([&] { solved_state(model, {{"x", 2}, {"y", 0}}); }), HasSubstr("is off by 3"));
  EXPECT_EQ(input_error_of([&] { project_onto_constraints(*model.system, VectorXd::Zero(2), VectorXd::Zero(3)); }),
            "project_onto_constraints: a state of 'pendulum.toml' has 5 entries, got 3");
  EXPECT_EQ(input_error_of([&] { project_onto_constraints(*model.system, VectorXd::Zero(2), VectorXd::Zero(5), {true}); }),
            "project_onto_constraints: a state of 'pendulum.toml' has 5 entries, got 5 and 1 marks of what is held");
}

// ---- faults

TEST(SimulateFaults, WrongOptionsAreRefused) {
  const Model model = oscillator();
  const VectorXd start = VectorXd::Zero(4);
  const auto refusal = [&](const std::function<void(SimulateOptions&)>& change) {
    SimulateOptions options = with_tolerance(times(1, 2), 1e-6);
    change(options);
    return input_error_of([&] { simulate_model(model, start, options); });
  };
  EXPECT_EQ(refusal([](auto& o) { o.times = times(1, 1); }),
            "simulate: at least two times are needed, the start and the end, got 1");
  EXPECT_EQ(refusal([](auto& o) { o.times = Eigen::Vector2d(1, 0.5); }), "simulate: times must increase, but 0.5 follows 1");
  EXPECT_EQ(refusal([](auto& o) { o.times[1] = NAN; }), "simulate: a time is not a finite number");
  EXPECT_EQ(refusal([](auto& o) { o.relative_tolerance = 0; }), "simulate: the relative tolerance must be positive, got 0");
  EXPECT_EQ(refusal([](auto& o) { o.absolute_tolerance = NAN; }), "simulate: the absolute tolerance must be positive, got nan");
  EXPECT_EQ(refusal([](auto& o) { o.initial_step = -1; }), "simulate: the initial step must not be negative, got -1");
  EXPECT_EQ(refusal([](auto& o) { o.max_steps = 0; }), "simulate: max_steps must be at least 1, got 0");
  const SimulateOptions good = with_tolerance(times(1, 2), 1e-6);
  EXPECT_EQ(input_error_of([&] { simulate_model(model, VectorXd::Zero(3), good); }),
            "simulate: the start must be a state of 4 entries, coordinates and velocities finite");
  EXPECT_EQ(input_error_of([&] { simulate_model(model, Eigen::Vector4d(NAN, 0, 0, 0), good); }),
            "simulate: the start must be a state of 4 entries, coordinates and velocities finite");
  EXPECT_EQ(input_error_of([&] { simulate(*model.system, VectorXd::Zero(1), model_acceleration(model), start, good); }),
            "simulate: 'oscillator.toml' has 0 parameters, got 1");
  EXPECT_EQ(input_error_of([&] {
              simulate(
                  *model.system, VectorXd(), [](const auto&) { return VectorXd::Zero(2); }, start, good);
            }),
            "simulate: the acceleration has 2 entries, the system 1 coordinates");
}

// accelerations of a free body, of a function of [x; dx; t; u]
std::string fault_of(const std::function<double(const VectorXd&)>& acceleration, const SimulateOptions& options) {
  const Model model = oscillator();
  return numerical_error_of([&] {
    simulate(
        *model.system, VectorXd(), [&](const auto& x) { return VectorXd::Constant(1, acceleration(x)); },
        Eigen::Vector4d(1, 1, 0, 0), options);
  });
}

TEST(SimulateFaults, AccelerationsThatAreNotFiniteNameTheTime) {
  const SimulateOptions options = with_tolerance(times(3, 4), 1e-6);
  EXPECT_EQ(fault_of([](const VectorXd&) { return NAN; }, options),
            "simulate: no acceleration at t = 0: the acceleration is not a finite number");
  EXPECT_THAT(
      fault_of([](const VectorXd& x) { return x[2] > 1.5 ? INFINITY : 0.0; }, options),
      AllOf(StartsWith("simulate: the step size fell to"), HasSubstr("s at t = 1.5: the acceleration is not a finite number")));
  EXPECT_THAT(fault_of([](const VectorXd& x) -> double { throw InputError(fmt::format("no mass at {:.2g}", x[2])); }, options),
              "simulate: no acceleration at t = 0: no mass at 0");
}

TEST(SimulateFaults, AMotionThatEndsInASingularityNamesTheTime) {
  // ẋ = x², from x = 1: infinite at t = 1
  EXPECT_THAT(fault_of([](const VectorXd& x) { return 2 * x[0] * x[1]; }, with_tolerance(times(3, 4), 1e-6)),
              AllOf(StartsWith("simulate: the step size fell to"), HasSubstr("s at t = 1: ")));
}

TEST(SimulateFaults, AJumpThatTheTolerancesCannotMeetIsReported) {
  // an acceleration that chatters faster than any step
  int call = 0;
  EXPECT_THAT(fault_of([&](const VectorXd&) { return ++call % 2 == 0 ? 1e12 : -1e12; }, with_tolerance(times(1, 2), 1e-12)),
              AllOf(StartsWith("simulate: the step size fell to"), HasSubstr("the tolerances cannot be met there")));
}

TEST(SimulateFaults, TooManyStepsNameTheTimeReached) {
  SimulateOptions options = with_tolerance(times(100, 2), 1e-10);
  options.max_steps = 50;
  EXPECT_THAT(fault_of([](const VectorXd& x) { return -x[0]; }, options),
              AllOf(StartsWith("simulate: 50 steps reach no further than t = "),
                    HasSubstr("of 100: loosen the tolerances, or allow more steps")));
}

TEST(SimulateFaults, AJumpThatHoldsABodyAtRestIsToldWithItsMend) {
  SimulateOptions options = with_tolerance(times(100, 3), 1e-6);
  options.max_steps = 4000;
  EXPECT_THAT(fault_of([](const VectorXd& x) { return -x[1] / std::abs(x[1]); }, options),
              AllOf(StartsWith("simulate: 4000 steps reach no further than t = 1."),
                    HasSubstr("of 100, half of them from t = 1."), HasSubstr("or smoothed, say tanh")));
}

TEST(SimulateFaults, ASmallerStepIsTriedBeforeGivingUp) {
  // stages of the first, far too large step lie where there is no acceleration
  const Model model = oscillator();
  SimulateOptions options = with_tolerance(times(1, 2), 1e-8);
  options.initial_step = 1;
  const Trajectory out = simulate(
      *model.system, VectorXd(), [](const auto& x) { return VectorXd::Constant(1, x[0] > 1.3 ? NAN : -30 * x[0]); },
      Eigen::Vector4d(1, 2, 0, 0), options);
  EXPECT_GT(out.rejected_steps, 0);
  EXPECT_NEAR(out.states(0, 1), std::cos(std::sqrt(30)) + 2 / std::sqrt(30) * std::sin(std::sqrt(30)), 1e-6);
}

// ---- a learned model

TEST(SimulatePosterior, StaysOnTheConstraintAndDriftsNoMoreThanTheAnalyticModelWithoutProjection) {
  // GP² with plausible hyperparameters, not fitted: the drift has nothing to do with how good it is
  const Model& model = surface();
  const Prior prior = make_prior(model);
  const GeneratedData data = generate(model, {100, 1, VectorXd::Constant(3, 0.1)});
  const Observations observations{data.states, View::all(View::Quantity::constrained_acceleration, *model.system),
                                  data.accelerations, VectorXd::Constant(3, 0.1)};
  ModelValues values;
  values.kernel = {VectorXd::Constant(prior.latents[0].n_features(), 3.0)};
  values.signal_stddev = {VectorXd::Constant(3, 5.0)};
  values.noise_stddev = {VectorXd::Constant(3, 0.1)};
  values.parameters = model.system->parameter_values();
  const Posterior posterior(prior, {observations}, values);
  const View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  const Acceleration learned = [&](const auto& state) -> VectorXd { return posterior.mean(view, state).col(0); };
  const auto run = [&](const Acceleration& acceleration, double t_end, double tolerance, bool project) {
    return simulate(*model.system, values.parameters, acceleration, figure_start(),
                    with_tolerance(times(t_end, 101), tolerance, project));
  };

  for (const double t_end : {6.0, 600.0}) {
    const Trajectory out = run(learned, t_end, 1e-6, true);
    EXPECT_LE(out.max_position_drift, 1e-12);
    EXPECT_LE(out.max_velocity_drift, 1e-12);
  }
  for (const double tolerance : {1e-5, 1e-6, 1e-7}) {
    const double drift = run(learned, 6, tolerance, false).max_position_drift;
    const double analytic = run(model_acceleration(model), 6, tolerance, false).max_position_drift;
    RecordProperty(fmt::format("drift_at_{}", tolerance), fmt::format("{:.3g} against {:.3g}", drift, analytic));
    EXPECT_LE(drift, 2 * analytic) << tolerance;
    EXPECT_GT(drift, 0);
  }
  const double order = order_of_drift([&](double tolerance) { return run(learned, 6, tolerance, false); }, 1e-6, 1e-10);
  EXPECT_GT(order, 4.5);
  EXPECT_LT(order, 7);
}

TEST(SimulateMasslessCoordinate, KeepsTheEnergyAndTheConstraints) {
  std::string text = test::model("models/massless_rod.toml").text;
  text.resize(text.find("[truth]"));
  const Model rod = Model::parse(text, "rod");
  const VectorXd start = solved_state(rod, {{"theta", 1.2}, {"dtheta", 2}, {"u1", 0}});
  EXPECT_NEAR(start[0], 0.6 * std::sin(1.2), 1e-12);
  EXPECT_NEAR(start[3], 0.6 * 2 * std::cos(1.2), 1e-12);
  const Trajectory out = simulate_model(rod, start, with_tolerance(times(5, 51), 1e-9));
  EXPECT_LT(out.max_position_drift, 1e-14);
  const VectorXd energy = mechanical_energy(rod, rod.system->parameter_values(), out.states);
  // some thousand steps, each within 1e-9 of its size
  EXPECT_LT((energy.array() - energy[0]).abs().maxCoeff(), 1e-6 * std::abs(energy[0]));
  EXPECT_GT((out.states.row(2).array() - 1.2).abs().maxCoeff(), 1);
}

// the position constraint says nothing of y, which only a constraint on accelerations holds
TEST(SimulateMasslessCoordinate, IsNotMovedByAConstraintThatDoesNotSeeIt) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y", "z"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "0", "0"], ["0", "0", "3"]]
force = ["1", "0", "0"]
[constraints]
position = ["x - z"]
acceleration = ["ddy - 2*ddx"]
)toml",
                                   "follower");
  VectorXd state = VectorXd::Zero(7);
  state.head(3) << 4, 7, 0;
  const VectorXd projected = project_onto_constraints(*model.system, VectorXd(), state, {});
  // the least change in the metric of M
  EXPECT_NEAR(projected[0], 1, 1e-14);
  EXPECT_EQ(projected[1], 7);
  EXPECT_NEAR(projected[2], 1, 1e-14);
  const Trajectory out = simulate_model(model, projected, with_tolerance(times(2, 3), 1e-9));
  EXPECT_NEAR(out.states(0, 2), 1 + 0.25 * 2, 1e-9);
  EXPECT_NEAR(out.states(1, 2), 7 + 2 * 0.25 * 2, 1e-9);
}

}  // namespace
}  // namespace gp2
