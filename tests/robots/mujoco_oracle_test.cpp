#include "robots/mujoco_oracle.hpp"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "io_testing.hpp"
#include "reference_data.hpp"

// What the oracle promises, checked by other roads than MuJoCo's, so that our expressions are tested against the right thing.
namespace gp2::test {
namespace {

using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::VectorXd;

// slides and hinges off the origin, two joints on one body
constexpr const char* branched = R"(<mujoco><compiler angle="radian"/><worldbody>
  <body name="cart" pos="0.1 0.2 0.3" euler="0.3 0.2 0.1"><joint type="slide" axis="1 0 0.5"/>
    <joint type="hinge" axis="0 1 1" pos="0.1 0 0.05" ref="0.4"/>
    <inertial pos="0.02 0.01 0.03" mass="2" fullinertia="0.02 0.03 0.025 0.001 0.002 0.003"/>
    <body name="left" pos="0 0.3 0"><joint axis="1 0 0" pos="0 -0.1 0"/><inertial pos="0 0.1 0" mass="1" diaginertia="0.01 0.004 0.01"/></body>
    <body name="right" pos="0 -0.3 0.1"><joint type="slide" axis="0 0 1"/><joint axis="0 0 1" pos="0.2 0 0"/>
      <inertial pos="0.1 0 0" mass="1.5" diaginertia="0.01 0.02 0.015"/></body>
  </body></worldbody></mujoco>)";

class Oracle : public testing::Test {
 protected:
  Oracle() : oracle(folder.write("branched.xml", branched)), q(oracle.n()), dq(oracle.n()) {
    std::mt19937 engine(7);
    std::normal_distribution<double> normal;
    for (int k = 0; k < oracle.n(); ++k) {
      q[k] = normal(engine);
      dq[k] = normal(engine);
    }
    oracle.set_state(q, dq);
  }

  // central difference of f along the motion with ddq = 0
  template <class F>
  auto along_motion(F f) {
    constexpr double h = 1e-4;
    oracle.set_state(q + h * dq, dq);
    const auto after = f();
    oracle.set_state(q - h * dq, dq);
    const auto before = f();
    oracle.set_state(q, dq);
    return decltype(f())((after - before) / (2 * h));
  }

  TemporaryFolder folder;
  MujocoOracle oracle;
  VectorXd q, dq;
};

// error of a central difference: h²/6 of a third derivative of order 10², plus ε/h of rounding
constexpr double difference_tolerance = 2e-6;

TEST_F(Oracle, VelocitiesOfAPointAreItsDifferences) {
  const int body = oracle.body("right");
  const Vector3d local(0.3, -0.2, 0.1);
  const VectorXd velocity = oracle.jacobian(body, local).topRows<3>() * dq;
  const Vector3d expected = along_motion([&] { return oracle.point(body, local); });
  EXPECT_LT((velocity - expected).norm(), difference_tolerance);
  EXPECT_GT(expected.norm(), 0.1);
}

TEST_F(Oracle, AccelerationsAtRestingCoordinatesAreDifferencesOfVelocitiesWithoutGravity) {
  const Vector3d local(0.3, -0.2, 0.1);
  for (const char* name : {"cart", "left", "right"}) {
    const int body = oracle.body(name);
    const VectorXd result = oracle.jacobian_rate_times_velocity(body, local);
    const VectorXd expected = along_motion([&] { return VectorXd(oracle.jacobian(body, local) * dq); });
    EXPECT_LT((result - expected).norm(), difference_tolerance) << name;
    EXPECT_GT(expected.norm(), 0.01) << name;
  }
}

TEST_F(Oracle, AccelerationsAgreeWithDifferencesToEightDigits) {
  // Richardson's extrapolation of two steps leaves h⁴ of a fifth derivative
  const int body = oracle.body("right");
  const auto velocity_after = [&](double time) {
    oracle.set_state(q + time * dq, dq);
    return VectorXd(oracle.jacobian(body) * dq);
  };
  const auto slope = [&](double h) { return VectorXd((velocity_after(h) - velocity_after(-h)) / (2 * h)); };
  const VectorXd expected = (4 * slope(5e-4) - slope(1e-3)) / 3;
  oracle.set_state(q, dq);
  EXPECT_LT((oracle.jacobian_rate_times_velocity(body) - expected).norm(), 1e-8 * expected.norm());
}

TEST_F(Oracle, TheBiasIsTheOneOfLagrange) {
  // M ddq + bias = d/dt ∂L/∂dq − ∂L/∂q with L = ½ dqᵀ M dq − V, at ddq = 0: bias = Ṁ dq − ½ ∂(dqᵀ M dq)/∂q + ∂V/∂q
  const auto energies = [&](const VectorXd& at) {
    oracle.set_state(at, dq);
    double potential = 0;
    for (int body = 1; body < oracle.model().nbody; ++body) {
      potential += 9.81 * oracle.model().body_mass[body] * oracle.data().xipos[3 * body + 2];
    }
    return 0.5 * dq.dot(oracle.mass() * dq) - potential;
  };
  VectorXd expected = along_motion([&] { return VectorXd(oracle.mass() * dq); });
  constexpr double h = 1e-4;
  for (int k = 0; k < oracle.n(); ++k) {
    const VectorXd step = h * VectorXd::Unit(oracle.n(), k);
    expected[k] -= (energies(q + step) - energies(q - step)) / (2 * h);
  }
  oracle.set_state(q, dq);
  EXPECT_LT((oracle.bias() - expected).norm(), 1e-5);
  EXPECT_GT(expected.norm(), 1);
}

TEST(OracleOfAFourBar, RowsOfEqualitiesAreDifferencesOfTheirViolation) {
  MujocoOracle oracle(std::filesystem::path(GP2_SOURCE_DIR) / "models/four_bar.xml");
  const VectorXd q = VectorXd::Constant(3, 0.2);
  const VectorXd dq = VectorXd::LinSpaced(3, 0.5, 1);
  constexpr double h = 1e-5;
  const auto violation = [&](double time) {
    oracle.set_state(q + time * dq, dq);
    return oracle.equality_rows().violation;
  };
  const VectorXd expected = (violation(h) - violation(-h)) / (2 * h);
  oracle.set_state(q, dq);
  const MujocoOracle::Rows rows = oracle.equality_rows();
  ASSERT_EQ(rows.violation.size(), 3);
  EXPECT_LT((rows.jacobian * dq - expected).norm(), 1e-8);
  EXPECT_GT(expected.norm(), 0.01);
}

}  // namespace
}  // namespace gp2::test
