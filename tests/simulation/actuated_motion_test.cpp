#include <cmath>
#include <limits>

#include <gtest/gtest.h>

#include "gp2/jobs/simulate_job.hpp"
#include "gp2/simulate.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;

Actuator late_by(double delay, double lag) {
  Actuator actuator = Actuator::direct("u");
  actuator.delay.value = delay;
  actuator.lag.value = lag;
  return actuator;
}

double at(const InputSignal& signal, double t) {
  VectorXd u(signal.size());
  signal.evaluate(t, u);
  return u[0];
}

/// Uneven times, and what is commanded there.
const VectorXd command_times = (VectorXd(6) << 0, 0.1, 0.13, 0.2, 0.5, 0.8).finished();
const MatrixXd commands = (MatrixXd(1, 6) << 1, 3, -2, -2, 4, 0).finished();

TEST(ActuatedSignal, WithoutDelayAndLagHasTheBitsOfTheCommands) {
  const InputSignal plain(command_times, commands), direct(command_times, commands, {Actuator::direct("u")});
  for (int i = -10; i < 120; ++i) {
    const double t = 0.00937 * i;
    EXPECT_EQ(at(direct, t), at(plain, t)) << t;
    EXPECT_EQ(direct.next_kink(t), plain.next_kink(t)) << t;
  }
}

TEST(ActuatedSignal, IsTheCommandOfADelayAgo) {
  const InputSignal plain(command_times, commands), late(command_times, commands, {late_by(0.25, 0)});
  for (int i = -10; i < 150; ++i) EXPECT_NEAR(at(late, 0.01 * i), at(plain, 0.01 * i - 0.25), 1e-14) << i;
  EXPECT_DOUBLE_EQ(late.next_kink(0.3), 0.35);
}

TEST(ActuatedSignal, OfAConstantCommandIsThat) {
  const InputSignal signal(command_times, MatrixXd::Constant(1, 6, 0.1), {late_by(0.03, 0.2)});
  for (int i = -10; i < 150; ++i) EXPECT_EQ(at(signal, 0.01 * i), 0.1);
}

TEST(ActuatedSignal, SolvesTheDifferentialEquationFromRest) {
  const double delay = 0.04, lag = 0.07, step = 1e-5;
  const InputSignal plain(command_times, commands), late(command_times, commands, {late_by(delay, lag)});
  double v = 1;  // by the trapezoidal rule, which errs by h² v‴/12
  for (int i = 0; i < 120000; ++i) {
    const double t = i * step, c = (at(plain, t - delay) + at(plain, t + step - delay)) / 2;
    v = (v * (1 - step / (2 * lag)) + c * step / lag) / (1 + step / (2 * lag));
    if (i % 5000 != 4999) continue;
    ASSERT_NEAR(at(late, t + step), v, 2e-7) << t;
  }
}

TEST(ActuatedSignal, EachInputHasAnActuatorOfItsOwn) {
  MatrixXd two(2, 6);
  two << commands, commands;
  const InputSignal both(command_times, two, {late_by(0.1, 0), late_by(0, 0.1)});
  VectorXd u(2);
  both.evaluate(0.33, u);
  EXPECT_EQ(u[0], at(InputSignal(command_times, commands, {late_by(0.1, 0)}), 0.33));
  EXPECT_EQ(u[1], at(InputSignal(command_times, commands, {late_by(0, 0.1)}), 0.33));
  EXPECT_EQ(input_error_of([&] { InputSignal(command_times, two, {late_by(0.1, 0)}); }), "inputs: 1 actuators for 2 inputs");
}

// ẍ = v, and v answers a ramp c = r t by v = r (t − τ − T + T e^(−(t − τ)/T))
TEST(ActuatedMotion, IsThatOfAMassUnderALateForce) {
  const double delay = 0.2, lag = 0.3, r = 2, t_end = 2;
  const Model model = Model::parse(
      "coordinates = [\"x\"]\ninputs = [{ name = \"f\", delay = 0.2, lag = 0.3 }]\n[mechanics]\nmass = [[1]]\nforce = [\"f\"]\n",
      "late mass.toml");
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"x", 0}, {"dx", 0}};
  request.times = VectorXd::LinSpaced(5, 0, t_end);
  request.relative_tolerance = 1e-10;
  request.inputs = CsvTable::from_columns("ramp", {{"t", {0, t_end}}, {"f", {0, r * t_end}}});
  const Trajectory motion = run_simulation(prepare_simulation(model, request)).front();
  const double s = t_end - delay, forgotten = -std::expm1(-s / lag);
  EXPECT_NEAR(motion.accelerations(0, 4), r * (s - lag * forgotten), 1e-12);
  EXPECT_NEAR(motion.states(1, 4), r * (s * s / 2 - lag * s + lag * lag * forgotten), 1e-9);
  EXPECT_EQ(motion.states(3, 1), motion.accelerations(0, 1));  // the input of a state is what acts
  EXPECT_LE((motion.commands.row(0) - r * motion.times.transpose()).cwiseAbs().maxCoeff(), 1e-15);
}

}  // namespace
}  // namespace gp2
