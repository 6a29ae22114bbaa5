#include "gp2/actuator.hpp"

#include <cmath>
#include <numbers>

#include <gtest/gtest.h>

namespace gp2::test {
namespace {

// T dv/dt + v = c₀ + (c₁ − c₀) s/h by classical Runge–Kutta in n steps
double integrated(double v, double c0, double c1, double h, double lag, int n) {
  const auto rate = [&](double s, double at) { return (c0 + (c1 - c0) * s / h - at) / lag; };
  const double step = h / n;
  for (int i = 0; i < n; ++i) {
    const double s = i * step;
    const double k1 = rate(s, v), k2 = rate(s + step / 2, v + step / 2 * k1), k3 = rate(s + step / 2, v + step / 2 * k2),
                 k4 = rate(s + step, v + step * k3);
    v += step / 6 * (k1 + 2 * k2 + 2 * k3 + k4);
  }
  return v;
}

TEST(Lagged, SolvesItsDifferentialEquationToRounding) {
  for (const double lag : {0.003, 0.05, 2.0}) {
    for (const double h : {1e-3, 0.01, 0.1})
      EXPECT_NEAR(lagged(0.7, -1.0, 2.5, h, lag), integrated(0.7, -1.0, 2.5, h, lag, 20000), 1e-12) << lag << ' ' << h;
  }
}

TEST(Lagged, LosesNoDigitsWhereTheStepIsShort) {
  // v₀ + h (c₀ − v₀)/T + h² ((c₁ − c₀)/h − (c₀ − v₀)/T)/(2 T) + O(h³)
  const double h = 1e-6, lag = 1, v = 1, c0 = 1 + 1e-3, c1 = 1 + 2e-3;
  const double change = h * (c0 - v) / lag + h * h / (2 * lag) * ((c1 - c0) / h - (c0 - v) / lag);
  EXPECT_NEAR(lagged(v, c0, c1, h, lag) - v, change, 5e-16);
}

TEST(Lagged, IsTheCommandWithoutALagAndNearlyThatWithAShortOne) {
  EXPECT_EQ(lagged(5, 1, 2, 0.01, 0), 2);
  EXPECT_NEAR(lagged(5, 1, 2, 0.01, 1e-9), 2 - 1e-9 * 100, 1e-12);
  EXPECT_EQ(lagged(5, 1, 2, 0.01, 1e-320), 2);
}

TEST(Lagged, LeavesAConstantCommandAsItIs) {
  for (const double h : {0.0, 1e-9, 0.3}) EXPECT_EQ(lagged(0.1, 0.1, 0.1, h, 0.05), 0.1);
}

TEST(Lagged, InTwoStepsIsInOne) {
  const double whole = lagged(0.2, 1, 3, 0.02, 0.05), half = lagged(0.2, 1, 2, 0.01, 0.05);
  EXPECT_NEAR(lagged(half, 2, 3, 0.01, 0.05), whole, 1e-15);
}

TEST(Actuator, KnowsHowLateItsInputMayBe) {
  Actuator actuator = Actuator::direct("u");
  EXPECT_EQ(actuator.delay.name, "u.delay");
  EXPECT_TRUE(actuator.is_direct());
  EXPECT_EQ(actuator.reach(), 0);
  actuator.delay.value = 0.02;
  actuator.lag.value = 0.03;
  EXPECT_FALSE(actuator.is_direct());
  EXPECT_DOUBLE_EQ(actuator.reach(), 0.17);
  actuator.delay.estimate = true;  // in [0, 0.1]
  EXPECT_DOUBLE_EQ(actuator.reach(), 0.25);
  actuator.delay.bounds = {0, 0.05};
  EXPECT_DOUBLE_EQ(actuator.reach(), 0.2);
}

}  // namespace
}  // namespace gp2::test
