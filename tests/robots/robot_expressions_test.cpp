// The expressions of a robot against MuJoCo's numbers, and its models as a whole.

#include <cmath>
#include <filesystem>
#include <map>
#include <tuple>

#include <fmt/format.h>
#include <gtest/gtest.h>
#include <Eigen/QR>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/model.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "robots/mujoco_oracle.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::VectorXd;
using test::MujocoOracle;

// every kind of joint, several on one body, anchors off the origin, a branch, a body fixed to another, springs and rotors
constexpr const char* tree = R"(<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0.3 -0.4 -9.7"/>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="0.2 -0.3 0.4">
      <inertial pos="0.02 0.01 -0.03" mass="2.5" fullinertia="0.02 0.03 0.04 0.001 -0.002 0.003"/>
      <joint name="a1" type="hinge" axis="1 2 3" pos="0.05 -0.04 0.03" damping="0.3" armature="0.01"/>
      <joint name="a2" type="slide" axis="-1 0.5 2" pos="0.01 0.02 0.03" stiffness="7" springref="0.1"/>
      <joint name="a3" type="hinge" axis="0 1 0" ref="0.2"/>
      <site name="on_base" pos="0.1 0 0.2" euler="0.5 0 0.1"/>
      <body name="fixed" pos="0 0.1 0.2" euler="0 0.7 0">
        <inertial pos="0.05 0 0" mass="0.7" diaginertia="0.001 0.002 0.0015"/>
        <site name="on_fixed" pos="0 0.1 0"/>
        <body name="left" pos="0.2 0 0" euler="0.1 0.2 0.3">
          <inertial pos="0 0.1 0" mass="1.1" fullinertia="0.01 0.012 0.008 0.0005 0 0.0003"/>
          <joint name="b1" type="hinge" axis="0 0 1" pos="0 -0.1 0" damping="0.1" stiffness="2"/>
          <body name="tip" pos="0 0.3 0">
            <inertial pos="0 0 0.1" mass="0.4" diaginertia="0.001 0.001 0.0005"/>
            <joint name="b2" type="slide" axis="0 1 0"/>
            <site name="on_tip" pos="0.02 0.1 0.03"/>
          </body>
        </body>
      </body>
      <body name="right" pos="-0.2 0 0.1">
        <inertial pos="0 0 -0.2" mass="0.9" diaginertia="0.01 0.01 0.002"/>
        <joint name="c1" type="hinge" axis="1 0 0"/>
        <joint name="c2" type="hinge" axis="0 1 0" pos="0 0 0.05"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rope">
      <site site="on_base"/><site site="on_fixed"/><site site="on_tip"/><pulley divisor="2"/><site site="on_tip"/><site site="on_base"/>
    </spatial>
    <fixed name="sum"><joint joint="b1" coef="0.3"/><joint joint="c2" coef="-0.7"/></fixed>
  </tendon>
  <equality>
    <connect name="loop" body1="tip" body2="right" anchor="0.02 0.03 0.04"/>
    <joint name="gear" joint1="b2" joint2="c1" polycoef="0.1 0.4 0.2 0.05 0.01"/>
    <tendon name="hoist" tendon1="rope" tendon2="sum" polycoef="0 0.8 0.3 0 0"/>
  </equality>
</mujoco>)";

// in a folder of this process: tests of one file run side by side
std::filesystem::path written(const std::string& text, const char* name) {
  static const test::TemporaryFolder folder;
  return folder.write(name, text);
}

std::filesystem::path source_path(const char* path) { return std::filesystem::path(GP2_SOURCE_DIR) / path; }

Model model_of(const std::filesystem::path& robot, const std::string& more = "") {
  return Model::parse(fmt::format("robot = '{}'\n{}", robot.string(), more), "robot model");
}

VectorXd random_vector(RandomStream& random, Eigen::Index n) {
  VectorXd v(n);
  for (double& value : v) value = random.normal();
  return v;
}

double largest_difference(const MatrixXd& a, const MatrixXd& b) { return (a - b).cwiseAbs().maxCoeff(); }

class RobotOfFile : public testing::TestWithParam<const char*> {
 protected:
  static std::filesystem::path path() {
    return std::string(GetParam()) == "tree" ? written(tree, "tree.xml") : source_path(GetParam());
  }
};

// Both sides sum some hundred products of numbers of the size of the largest: 1e-12 of it leaves a factor of 20 above rounding.
TEST_P(RobotOfFile, HasTheMassMatrixAndTheForcesOfMujoco) {
  const Model model = model_of(path());
  const System& system = *model.system;
  MujocoOracle oracle(path());
  RandomStream random(1);
  for (int i = 0; i < 20; ++i) {
    VectorXd state = VectorXd::Zero(system.layout().size());
    const VectorXd q = oracle.reference() + random_vector(random, system.nq()), dq = 2 * random_vector(random, system.nq());
    state << q, dq, 0.0;
    oracle.set_state(q, dq);
    const SystemValues values = system.evaluate(state, system.parameter_values());
    const VectorXd force = oracle.passive() - oracle.bias();
    EXPECT_LE(largest_difference(values.M(0), oracle.mass()), 1e-12 * oracle.mass().cwiseAbs().maxCoeff());
    EXPECT_LE(largest_difference(values.F(0), force), 1e-12 * force.cwiseAbs().maxCoeff());
    EXPECT_EQ(values.M(0), values.M(0).transpose());
  }
}

TEST_P(RobotOfFile, HasTheConstraintRowsOfMujoco) {
  const Model model = model_of(path());
  const System& system = *model.system;
  if (system.nc() == 0) GTEST_SKIP() << "no loops";
  MujocoOracle oracle(path());
  RandomStream random(2);
  for (int i = 0; i < 10; ++i) {
    VectorXd state = VectorXd::Zero(system.layout().size());
    state.head(system.nq()) = oracle.reference() + random_vector(random, system.nq());
    oracle.set_state(state.head(system.nq()), VectorXd::Zero(system.nq()));
    const MujocoOracle::Rows rows = oracle.equality_rows();
    const VectorXd residuals = system.residuals(state, system.parameter_values());
    for (int row = 0; row < system.nc(); ++row) EXPECT_NEAR(residuals[2 * row], rows.violation[row], 1e-12);
    EXPECT_LE(largest_difference(system.evaluate(state, system.parameter_values()).A(0), rows.jacobian), 1e-12);
  }
}

TEST_P(RobotOfFile, HasConstraintVectorsThatAreTheSecondDerivativeAlongAMotion) {
  const Model model = model_of(path());
  const System& system = *model.system;
  if (system.nc() == 0) GTEST_SKIP() << "no loops";
  RandomStream random(3);
  VectorXd state = VectorXd::Zero(system.layout().size());
  state.head(2 * system.nq()) = random_vector(random, 2 * system.nq());
  const VectorXd ddq = random_vector(random, system.nq()), parameters = system.parameter_values();
  const SystemValues values = system.evaluate(state, parameters);
  // central differences of ċ over h: truncation h²/6 c⁗, rounding ε/h
  constexpr double h = 1e-5;
  const auto rates_at = [&](double dt) {
    VectorXd moved = state;
    moved.head(system.nq()) += dt * state.segment(system.nq(), system.nq()) + dt * dt / 2 * ddq;
    moved.segment(system.nq(), system.nq()) += dt * ddq;
    return VectorXd(system.residuals(moved, parameters));
  };
  const VectorXd difference = (rates_at(h) - rates_at(-h)) / (2 * h);
  const VectorXd expected = values.A(0) * ddq - values.b(0);
  for (int row = 0; row < system.nc(); ++row) {
    EXPECT_NEAR(difference[2 * row + 1], expected[row], 1e-7 * (1 + std::abs(expected[row])));
  }
  EXPECT_GT(expected.cwiseAbs().maxCoeff(), 1e-3);
}

INSTANTIATE_TEST_SUITE_P(Files, RobotOfFile,
                         testing::Values("tree", "models/four_bar.xml", "experiments/arm_on_surface/iiwa7.xml"),
                         [](const auto& file) { return std::filesystem::path(file.param).stem().string(); });

TEST(RobotExpressions, PointsAndAxesAreThoseOfMujoco) {
  const std::filesystem::path path = written(tree, "tree.xml");
  MujocoOracle oracle(path);
  const std::vector<std::string> quantities = {
      R"(site("on_fixed").x)", R"(site("on_base").rot_yz)",           R"(body("tip").z)",
      R"(body("tip").rot_xx)", R"(point("right", 0.1, -0.2, 0.3).y)", R"(point("world", 1, 2, 3).z + 0*a1)"};
  std::string rows;
  for (const std::string& quantity : quantities) rows += fmt::format("'{} - 0*a1', ", quantity);
  // each as a constraint: residual and its rate, A = J, b = −J̇ dq
  const Model model = model_of(path, fmt::format("[constraints]\nacceleration = [{}]\n",
                                                 R"('ddsite("on_fixed").x', 'ddsite("on_base").rot_yz', 'ddbody("tip").z',)"
                                                 R"('ddbody("tip").rot_xx', 'ddpoint("right", 0.1, -0.2, 0.3).y')"));
  const System& system = *model.system;
  RandomStream random(4);
  const VectorXd q = random_vector(random, system.nq()), dq = random_vector(random, system.nq());
  VectorXd state = VectorXd::Zero(system.layout().size());
  state << q, dq, 0.0;
  oracle.set_state(q, dq);
  const auto value_of = [&](const std::string& text) {
    const Expression e = model.expression(text);
    MatrixXd value;
    Tape(std::span(&e, 1), model.symbols().state_and_parameters()).evaluate(state, system.parameter_values(), value);
    return value(0, 0);
  };
  const int tip = oracle.body("tip"), right = oracle.body("right"), base = oracle.body("base"), fixed = oracle.body("fixed");
  const Vector3d local(0.1, -0.2, 0.3), on_fixed(0, 0.1, 0);
  const Vector3d own_axis = oracle.rotation(base).transpose() * oracle.site_rotation(oracle.site("on_base")).col(2);
  EXPECT_NEAR(value_of(quantities[0]), oracle.site_position(oracle.site("on_fixed")).x(), 1e-13);
  EXPECT_NEAR(value_of(quantities[1]), oracle.site_rotation(oracle.site("on_base"))(1, 2), 1e-13);
  EXPECT_NEAR(value_of(quantities[2]), oracle.point(tip).z(), 1e-13);
  EXPECT_NEAR(value_of(quantities[3]), oracle.rotation(tip)(0, 0), 1e-13);
  EXPECT_NEAR(value_of(quantities[4]), oracle.point(right, local).y(), 1e-13);
  EXPECT_EQ(value_of(quantities[5]), 3);

  // the velocity of a direction e fixed to a body is ω × e; its acceleration where ddq = 0 is α × e + ω × (ω × e)
  const auto axis_rate = [&](int body, const Vector3d& e) -> Vector3d {
    const Vector3d omega = oracle.jacobian(body).bottomRows(3) * dq;
    return omega.cross(e);
  };
  EXPECT_NEAR(value_of(R"(dsite("on_fixed").x)"), oracle.jacobian(fixed, on_fixed).row(0).dot(dq), 1e-12);
  EXPECT_NEAR(value_of(R"(dpoint('right', 0.1, -0.2, 0.3).y)"), oracle.jacobian(right, local).row(1).dot(dq), 1e-12);
  EXPECT_NEAR(value_of(R"(dsite("on_base").rot_yz)"), axis_rate(base, oracle.rotation(base) * own_axis).y(), 1e-12);

  const SystemValues values = system.evaluate(state, system.parameter_values());
  const int first = static_cast<int>(values.b(0).size()) - 5;  // after the loops
  const VectorXd b = values.b(0).tail(5);
  const auto bias = [&](int body, const Vector3d& at) { return oracle.jacobian_rate_times_velocity(body, at); };
  const auto axis_bias = [&](int body, const Vector3d& e) -> Vector3d {
    const Vector3d omega = oracle.jacobian(body).bottomRows(3) * dq, alpha = bias(body, Vector3d::Zero()).tail<3>();
    return alpha.cross(e) + omega.cross(omega.cross(e));
  };
  EXPECT_NEAR(b[0], -bias(fixed, on_fixed)[0], 1e-11);
  EXPECT_NEAR(b[1], -axis_bias(base, oracle.rotation(base) * own_axis).y(), 1e-11);
  EXPECT_NEAR(b[2], -bias(tip, Vector3d::Zero())[2], 1e-11);
  EXPECT_NEAR(b[3], -axis_bias(tip, oracle.rotation(tip).col(0)).x(), 1e-11);
  EXPECT_NEAR(b[4], -bias(right, local)[1], 1e-11);
  EXPECT_LE(largest_difference(values.A(0).row(first + 2), oracle.jacobian(tip).row(2)), 1e-12);
  EXPECT_LE(largest_difference(values.A(0).row(first + 4), oracle.jacobian(right, local).row(1)), 1e-12);
}

// A body that floats, an arm on a ball on it and a hinge, off all centres; a pendulum on a ball on a rail.
constexpr const char* floating = R"(<mujoco>
  <compiler angle="radian"/>
  <option gravity="0.3 -0.4 -9.7"/>
  <worldbody>
    <body name="trunk" pos="1 2 3" euler="0.2 -0.3 0.4">
      <inertial pos="0.02 0.01 -0.03" mass="2.5" fullinertia="0.02 0.03 0.04 0.001 -0.002 0.003"/>
      <joint name="root" type="free" damping="0.2" armature="0.03"/>
      <body name="upper" pos="0.1 0.05 0.2" euler="0.3 0.1 -0.2">
        <inertial pos="0.05 -0.1 0.02" mass="0.7" fullinertia="0.004 0.005 0.006 0.0003 -0.0002 0.0001"/>
        <joint name="shoulder" type="ball" pos="0.02 -0.01 0.03" damping="0.1" armature="0.01"/>
        <body name="lower" pos="0 0.3 0">
          <inertial pos="0 0.1 0.02" mass="0.4" diaginertia="0.002 0.001 0.0015"/>
          <joint name="elbow" type="hinge" axis="1 0.2 0" pos="0 0.02 0" stiffness="2" springref="0.1"/>
          <site name="hand" pos="0.02 0.2 0.03"/>
        </body>
      </body>
    </body>
    <body name="pendulum" pos="0 -1 1" euler="0.5 0.6 0.7">
      <inertial pos="0 0 -0.4" mass="1.2" diaginertia="0.03 0.02 0.01"/>
      <joint name="rail" type="slide" axis="0 1 1"/>
      <joint name="pivot" type="ball" pos="0.01 0.02 0.05"/>
    </body>
  </worldbody>
</mujoco>)";

Eigen::Vector4d product(const Eigen::Vector4d& a, const Eigen::Vector4d& b) {
  Eigen::Vector4d out;
  out << a[0] * b[0] - a.tail<3>().dot(b.tail<3>()),
      a[0] * b.tail<3>() + b[0] * a.tail<3>() + Vector3d(a.tail<3>()).cross(Vector3d(b.tail<3>()));
  return out;
}

// a state with unit quaternions, for MuJoCo as (q, v) and for us as (q, dq)
struct FloatingState {
  static constexpr int first_coordinate[] = {3, 7, 13}, first_axis[] = {3, 6, 11}, nq = 17, nv = 14;

  explicit FloatingState(RandomStream& random) : q(random_vector(random, nq)), v(random_vector(random, nv)) {
    for (const int k : first_coordinate) q.segment<4>(k).normalize();
    dq = to_coordinates(v);
  }

  // of velocities along the axes: dp = ½ p (0, ω)
  [[nodiscard]] VectorXd to_coordinates(const VectorXd& along_axes) const {
    VectorXd out(nq);
    out << along_axes.head(3), VectorXd::Zero(8), along_axes.segment(9, 2), VectorXd::Zero(4);
    for (int ball = 0; ball < 3; ++ball) {
      Eigen::Vector4d omega(0, 0, 0, 0);
      omega.tail<3>() = along_axes.segment<3>(first_axis[ball]);
      out.segment<4>(first_coordinate[ball]) = 0.5 * product(q.segment<4>(first_coordinate[ball]), omega);
    }
    return out;
  }

  // of accelerations along the axes: d²p = ½ p (0, dω) − ¼ |ω|² p
  [[nodiscard]] VectorXd acceleration(const VectorXd& along_axes) const {
    VectorXd out = to_coordinates(along_axes);
    for (int ball = 0; ball < 3; ++ball) {
      const double square = v.segment<3>(first_axis[ball]).squaredNorm();
      out.segment<4>(first_coordinate[ball]) -= 0.25 * square * q.segment<4>(first_coordinate[ball]);
    }
    return out;
  }

  VectorXd q, v, dq;
};

// What M of a quaternion has along it is ours (T43): the motion is the same, and the constraint has nothing to do.
TEST(QuaternionJoints, AccelerateAsInMujoco) {
  const std::filesystem::path path = written(floating, "floating.xml");
  std::string inputs;
  for (int k = 0; k < FloatingState::nv; ++k) inputs += fmt::format("'u{}', ", k);
  const Model model = model_of(path, fmt::format("inputs = [{}]", inputs));
  const System& system = *model.system;
  ASSERT_EQ(system.nq(), FloatingState::nq);
  ASSERT_EQ(system.nc(), 3);
  EXPECT_EQ(system.coordinates()[3].name, "root_qw");
  EXPECT_EQ(system.coordinates()[10].name, "shoulder_qz");
  MujocoOracle oracle(path);
  RandomStream random(11);
  for (int i = 0; i < 100; ++i) {
    const FloatingState at(random);
    const VectorXd u = random_vector(random, FloatingState::nv);
    oracle.set_state(at.q, at.v);
    const VectorXd force = u + oracle.passive() - oracle.bias();
    const VectorXd expected = at.acceleration(oracle.mass().ldlt().solve(force));
    VectorXd state(system.layout().size());
    state << at.q, at.dq, 0.0, u;
    const SystemValues values = system.evaluate(state, system.parameter_values());
    EXPECT_EQ(values.M(0), values.M(0).transpose());
    const VectorXd free = values.M(0).llt().solve(values.F(0));
    EXPECT_LE(largest_difference(free, expected), 1e-11 * (1 + expected.cwiseAbs().maxCoeff()));
    EXPECT_LE(largest_difference(values.A(0) * expected, values.b(0)), 1e-12 * (1 + values.b(0).cwiseAbs().maxCoeff()));
    EXPECT_LE(system.residuals(state, system.parameter_values()).cwiseAbs().maxCoeff(), 1e-14);
  }
}

// also where the quaternions are of another length: A = ∂c/∂q, and b from the second derivative along a motion
TEST(QuaternionJoints, CarryPointsWithExactDerivatives) {
  const Model model = model_of(written(floating, "floating.xml"),
                               R"(constraints.position = ['site("hand").x + site("hand").y', 'body("lower").rot_xz'])");
  const System& system = *model.system;
  const VectorXd parameters = system.parameter_values();
  RandomStream random(12);
  VectorXd q = random_vector(random, system.nq()), dq = random_vector(random, system.nq());
  const auto state_at = [&](double time) {
    VectorXd state(system.layout().size());
    state << q + time * dq, dq, 0.0;
    return state;
  };
  const auto residuals = [&](double time) { return VectorXd(system.residuals(state_at(time), parameters)); };
  constexpr double h = 1e-5;
  const VectorXd here = residuals(0), slope = (residuals(h) - residuals(-h)) / (2 * h);
  const SystemValues values = system.evaluate(state_at(0), parameters);
  const VectorXd rate = values.A(0) * dq;
  for (int row = 0; row < system.nc(); ++row) {
    EXPECT_NEAR(rate[row], slope[2 * row], 1e-8) << row;
    EXPECT_NEAR(here[2 * row + 1], rate[row], 1e-12) << row;
    EXPECT_NEAR(-values.b(0)[row], slope[2 * row + 1], 1e-7) << row;
  }
  EXPECT_GT(rate.tail(2).cwiseAbs().minCoeff(), 1e-2);
}

// d/dt (½ dqᵀ M dq + V) = dqᵀ F of the dampers: M, F and V are of one machine
TEST(QuaternionJoints, KeepTheirEnergyButForDampers) {
  const Model model = model_of(written(floating, "floating.xml"));
  const System& system = *model.system;
  const VectorXd parameters = system.parameter_values();
  RandomStream random(13);
  const FloatingState at(random);
  const auto state_of = [&](const VectorXd& q, const VectorXd& dq) {
    VectorXd state(system.layout().size());
    state << q, dq, 0.0;
    return state;
  };
  const SystemValues values = system.evaluate(state_of(at.q, at.dq), parameters);
  const VectorXd ddq = values.M(0).llt().solve(values.F(0));
  const auto energy = [&](double t) {
    const VectorXd state = state_of(at.q + t * at.dq + t * t / 2 * ddq, at.dq + t * ddq), dq = state.segment(17, 17);
    MatrixXd potential;
    Tape(std::span(&*model.potential, 1), model.symbols().state_and_parameters()).evaluate(state, parameters, potential);
    return 0.5 * dq.dot(system.evaluate(state, parameters).M(0) * dq) + potential(0, 0);
  };
  constexpr double h = 1e-5;
  const double power = -0.2 * at.v.head(6).squaredNorm() - 0.1 * at.v.segment(6, 3).squaredNorm();
  EXPECT_NEAR((energy(h) - energy(-h)) / (2 * h), power, 1e-6 * std::abs(power));
}

// MuJoCo writes the vector of the relative quaternion, ½ θ for small angles; we write the skew part of the rotation, 2 θ
TEST(RobotExpressions, WeldHoldsWhatMujocosWeldHolds) {
  const std::filesystem::path path = written(R"(<mujoco>
  <worldbody>
    <body name="a" euler="10 20 30">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="a1" axis="1 2 3"/><joint name="a2" axis="0 1 1"/>
      <body name="b" pos="0.3 0 0.1"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="b1" axis="1 0 1"/></body>
    </body>
    <body name="c" pos="0.5 0.1 0" euler="40 50 60">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="c1" axis="0 1 0"/><joint name="c2" type="slide" axis="1 1 0"/>
    </body>
  </worldbody>
  <equality><weld name="glue" body1="b" body2="c"/></equality>
</mujoco>)",
                                             "weld.xml");
  const Model model = model_of(path);
  const System& system = *model.system;
  ASSERT_EQ(system.nc(), 6);
  MujocoOracle oracle(path);
  VectorXd state = VectorXd::Zero(system.layout().size());
  oracle.set_state(oracle.reference(), VectorXd::Zero(system.nq()));
  EXPECT_LE(system.residuals(state, VectorXd()).cwiseAbs().maxCoeff(), 1e-14);
  const MatrixXd ours = system.evaluate(state, VectorXd()).A(0), theirs = oracle.equality_rows().jacobian;
  // the same motions are free: rows of one are combinations of rows of the other
  MatrixXd both(12, system.nq());
  both << ours, theirs;
  const Eigen::Index rank = Eigen::ColPivHouseholderQR<MatrixXd>(ours).rank();
  EXPECT_EQ(Eigen::ColPivHouseholderQR<MatrixXd>(both).rank(), rank);
  EXPECT_EQ(Eigen::ColPivHouseholderQR<MatrixXd>(theirs).rank(), rank);
  EXPECT_NEAR(ours.bottomRows(3).cwiseAbs().maxCoeff(), 4 * theirs.bottomRows(3).cwiseAbs().maxCoeff(), 1e-12);
  // and away from it the rotation is missed by as much as it is turned: 2 sin θ
  state[0] = 0.3;
  EXPECT_NEAR(VectorXd(system.residuals(state, VectorXd()))({6, 8, 10}).norm(), 2 * std::sin(0.3), 1e-12);
}

TEST(RobotExpressions, ForceIsLessThePotentialsSlopeAtRest) {
  const Model model = model_of(written(tree, "tree.xml"));
  const System& system = *model.system;
  const SystemSymbols symbols = model.symbols();
  std::vector<Expression> slopes;
  for (Expression q : symbols.q) slopes.push_back(-model.graph->differentiate(*model.potential, q));
  RandomStream random(5);
  VectorXd state = VectorXd::Zero(system.layout().size());
  state.head(system.nq()) = random_vector(random, system.nq());
  MatrixXd expected;
  Tape(slopes, symbols.state_and_parameters()).evaluate(state, system.parameter_values(), expected);
  const VectorXd force = system.evaluate(state, system.parameter_values()).F(0);
  EXPECT_LE(largest_difference(force, expected), 1e-12 * force.cwiseAbs().maxCoeff());
}

TEST(RobotExpressions, NumbersOfTheRobotAreParametersWithExactDerivatives) {
  const Model model = model_of(source_path("experiments/arm_on_surface/iiwa7.xml"), R"toml(
[parameters]
m = { of = "mass('link7')", value = 1.7, estimate = true }
cx = { of = 'com("link7").x', value = 0.03 }
Ixy = { of = 'inertia("link7").xy', value = 1e-4 }
d = { of = 'damping("q3")' }
J = { of = 'armature("q2")', value = 0.2 }
k = { of = 'stiffness("q4")', value = 3 }
f = { of = 'friction("q5")', value = 0.4 }
)toml");
  const System& system = *model.system;
  EXPECT_EQ(system.parameters()[static_cast<std::size_t>(system.parameter_index("d"))].value, 0.5) << "the file's own value";
  RandomStream random(6);
  VectorXd state = VectorXd::Zero(system.layout().size());
  state.head(2 * system.nq()) = random_vector(random, 2 * system.nq());
  const VectorXd parameters = system.parameter_values();
  for (int k = 0; k < static_cast<int>(parameters.size()); ++k) {
    const double h = 1e-5;  // M and F are polynomials of second degree in each: central differences are exact but for rounding
    VectorXd above = parameters, below = parameters;
    above[k] += h;
    below[k] -= h;
    const SystemValues exact = system.differentiate(state, parameters, k), up = system.evaluate(state, above),
                       down = system.evaluate(state, below);
    const MatrixXd dM = (up.mass - down.mass) / (2 * h), dF = (up.force - down.force) / (2 * h);
    EXPECT_LE(largest_difference(exact.mass, dM), 1e-9) << system.parameters()[static_cast<std::size_t>(k)].name;
    EXPECT_LE(largest_difference(exact.force, dF), 1e-8) << system.parameters()[static_cast<std::size_t>(k)].name;
    EXPECT_GT(exact.mass.cwiseAbs().maxCoeff() + exact.force.cwiseAbs().maxCoeff(), 0.01);
  }
}

// the description with another mass is the same robot as the parameter with that value
TEST(RobotExpressions, MassAsAParameterIsTheMassOfTheBody) {
  RobotDescription robot = read_robot(source_path("experiments/arm_on_surface/iiwa7.xml"));
  const Model named = Model::parse("robot = 'x'\n[parameters]\nm = { of = \"mass('link7')\", value = 2.2 }", "named",
                                   RobotSource([&](const std::string&) { return robot; }));
  robot.bodies.back().mass = 2.2;
  const Model changed = Model::parse("robot = 'x'", "changed", RobotSource([&](const std::string&) { return robot; }));
  RandomStream random(7);
  VectorXd state = VectorXd::Zero(named.system->layout().size());
  state.head(14) = random_vector(random, 14);
  const SystemValues a = named.system->evaluate(state, named.system->parameter_values());
  const SystemValues b = changed.system->evaluate(state, VectorXd());
  EXPECT_LE(largest_difference(a.mass, b.mass), 1e-13);
  EXPECT_LE(largest_difference(a.force, b.force), 1e-12);
}

TEST(RobotExpressions, StateDerivativesAreThoseOfDifferences) {
  const Model model = model_of(source_path("experiments/arm_on_surface/iiwa7.xml"),
                               "inputs = ['u1','u2','u3','u4','u5','u6','u7']\n[constraints]\nposition = ['site(\"tip\").z - "
                               "0.1*sin(site(\"tip\").x)']\n");
  const System& system = *model.system;
  const auto exact = system.make_evaluator(system.parameter_values(), true);
  const auto differences = system.System::make_evaluator(system.parameter_values(), true);
  RandomStream random(8);
  const VectorXd state = random_vector(random, system.layout().size());
  exact->evaluate(state);
  differences->evaluate(state);
  // those of differences hold every entry that may depend on the state, zeros too
  std::map<std::tuple<int, int, int, int>, double> of_differences;
  for (std::size_t k = 0; k < differences->derivatives().size(); ++k) {
    const auto& at = differences->derivatives()[k];
    of_differences[{static_cast<int>(at.quantity), at.row, at.column, at.state_index}] =
        differences->derivative_values()[static_cast<Eigen::Index>(k)];
  }
  ASSERT_GT(exact->derivatives().size(), 200U);
  for (std::size_t k = 0; k < exact->derivatives().size(); ++k) {
    const auto& at = exact->derivatives()[k];
    const std::tuple key{static_cast<int>(at.quantity), at.row, at.column, at.state_index};
    EXPECT_NEAR(exact->derivative_values()[static_cast<Eigen::Index>(k)], of_differences.at(key), 1e-7);
  }
}

// 45 joints in a row: its derivatives would be millions of operations
TEST(RobotExpressions, OfALongChainTakeDifferencesInTheState) {
  constexpr int n = 45;
  std::string chain = "<mujoco><worldbody>";
  for (int i = 0; i < n; ++i) {
    chain += fmt::format(R"(<body pos="0 0 -0.1"><joint name="j{}" axis="0.6 {} 0.8"/>)", i, i % 2);
    chain += R"(<inertial pos="0 0.01 -0.05" mass="0.1" fullinertia="1e-4 1e-4 1e-5 1e-6 0 0"/>)";
  }
  for (int i = 0; i < n; ++i) chain += "</body>";
  const std::filesystem::path path = written(chain + "</worldbody></mujoco>", "chain.xml");
  const Model model = model_of(path);
  const System& system = *model.system;
  MujocoOracle oracle(path);
  RandomStream random(9);
  VectorXd state = random_vector(random, system.layout().size());
  oracle.set_state(state.head(n), state.segment(n, n));
  const auto evaluator = system.make_evaluator(VectorXd(), true);
  evaluator->evaluate(state);
  EXPECT_LE(largest_difference(evaluator->M(), oracle.mass()), 1e-12 * oracle.mass().cwiseAbs().maxCoeff());
  EXPECT_LE(largest_difference(evaluator->F(), -oracle.bias()), 1e-11 * oracle.bias().cwiseAbs().maxCoeff());
  EXPECT_GT(evaluator->derivatives().size(), 1000U);
}

TEST(RobotExpressions, NamesOfBodiesAndJointsMayHaveSpaces) {
  const std::string legs = R"(<mujoco><worldbody><body name="left leg"><joint name="left knee" axis="0 1 0" damping="0.2"/>
    <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.01 0.01 0.002"/></body></worldbody></mujoco>)";
  const Model model = model_of(written(legs, "legs.xml"), R"toml(
coordinates = ["q"]
[parameters]
m = { of = "mass( 'left leg' )", value = 1.7 }
d = { of = 'damping("left knee")' }
)toml");
  EXPECT_EQ(model.system->parameter_values(), Eigen::Vector2d(1.7, 0.2));
}

TEST(RobotModel, SaysHowAJointIsCalledOtherwise) {
  const std::filesystem::path path = written(
      "<mujoco><worldbody><body><joint name=\"exp\"/>"
      "<inertial pos=\"0 0 0\" mass=\"1\" diaginertia=\"1 1 1\"/></body></worldbody></mujoco>",
      "reserved.xml");
  const std::string text = fmt::format("robot = '{}'\n", path.string());
  EXPECT_EQ(test::input_error_of([&] { Model::parse(text, "arm.toml"); }),
            "arm.toml:1: robot: 'exp' is the name of a function or constant; choose another, for a joint by coordinates = "
            "[\"q1\", …], one per coordinate, in the order of the file");
  EXPECT_NO_THROW(Model::parse(text + "coordinates = ['q1']\n", "arm.toml"));
}

TEST(RobotModel, SaysWhatIsWrong) {
  const std::string arm = fmt::format("robot = '{}'\n", source_path("experiments/arm_on_surface/iiwa7.xml").string());
  const auto message = [&](const std::string& more) {
    return test::input_error_of([&] { Model::parse(arm + more, "arm.toml"); });
  };
  const auto expect = [&](const std::string& more, const std::string& part) {
    EXPECT_NE(message(more).find(part), std::string::npos) << message(more);
  };
  expect("coordinates = ['q1']", "1 names for the 7 coordinates of the robot; they are, in this order: q1, q2");
  expect("coordinates = ['q2', 'q1', 'q3', 'q4', 'q5', 'q6', 'q7']",
         "the name of another coordinate of the robot, of which this one is 'q1'; they are, in this order: q1, q2");
  expect("coordinates = ['a', 'b', 'c', 'd', 'e', 'f', 'g']\ninputs = ['u1', 'u2']", "2 inputs for");
  expect("inputs = ['u1', 'u2']", "2 inputs for 7 axes of joints: give one per axis");
  expect("[mechanics]\nforce = ['1']", "expected 7 entries, one per coordinate, got 1");
  expect("[mechanics]\nmass = [['1']]", "the mass matrix is the robot's");
  expect("[constraints]\nposition = ['site(\"tpi\").z']", "robot 'iiwa7' has no site 'tpi'; sites: tip");
  expect("[constraints]\nposition = ['body(\"link9\").z']", "has no body 'link9'; bodies: world, ");
  expect("[constraints]\nposition = ['site(\"tip\").w']", "'w' is no component; there are x, y, z and rot_xx");
  expect("[constraints]\nposition = ['site(\"tip\", 1).x']", "site takes a name only");
  expect("[constraints]\nposition = ['point(\"link7\", 1).x']", "a point needs its body and 3 numbers");
  expect("[constraints]\nposition = ['point(\"link7\", 1, 2, q1).x']", "must be numbers");
  expect("[constraints]\nposition = ['site(\"tip).x']", "this name in quotes does not end");
  expect("[constraints]\nposition = ['site(\"tip\") + 1']", "where a component must stand");
  expect("[constraints]\nposition = ['geom(\"tip\").x']",
         "unknown symbol 'geom(\"tip\").x'; a model with a robot has the points site(");
  expect("[constraints]\nposition = ['site(tip).z']", "the name in site(...) stands in quotes");
  expect("[parameters]\nm = { of = 'mass(\"link8\")' }", "the robot has no number 'mass(\"link8\")'");
  expect("[parameters]\nm = { of = 'mass(\"link7\")' }\nm2 = { of = 'mass(\"link7\")' }", "is the parameter 'm' already");
  const std::string of_inertia = "[parameters]\nI = { of = 'inertia(\"link7\")";
  expect("[parameters]\nm = { of = 'mass(\"link7\")', value = -0.3 }", "parameters.m: mass(\"link7\") must be ≥ 0, got -0.3");
  expect("[parameters]\nm = { of = 'mass(\"link7\")', bounds = [-1, 4] }",
         "parameters.m: mass(\"link7\") must be ≥ 0, and its bounds start at -1");
  expect("[parameters]\nd = { of = 'damping(\"q1\")', value = -1 }", "damping(\"q1\") must be ≥ 0, got -1");
  expect(of_inertia + ".yy', value = -0.02 }", "inertia(\"link7\").yy must be ≥ 0, got -0.02");
  expect(of_inertia + ".xy', value = 0.1, estimate = true }", "body 'link7': its inertia has the principal moment -");
  expect(of_inertia + ".yy', value = 0.1 }", "body 'link7': no rigid body has such an inertia, of which one principal moment");
  EXPECT_EQ(message(of_inertia + ".yy', value = 0.1, estimate = true }"), "") << "one moment alone acts in a plane";
  EXPECT_EQ(message(of_inertia + ".xy', value = -1e-4 }"), "");
  EXPECT_EQ(message("[parameters]\nc = { of = 'com(\"link7\").x', value = -0.1, bounds = [-1, 1] }"), "");
  expect("[truth]\nforce_on = { 'q1 + q2' = '1' }", "expected a point of the robot");
  expect("[truth]\nforce_on = { 'site(\"tpi\").x' = '1' }", "has no site 'tpi'");
  for (const char* rate : {"d", "dd"}) {
    expect(fmt::format("[truth]\nforce_on = {{ '{}site(\"tip\").x' = '1' }}", rate),
           "a force acts along site(\"tip\").x, not along its derivative");
  }
  expect("[truth]\nforce_on = { 'site(\"tip\").x' = 'ddq1' }", "a force may not depend on accelerations");
  EXPECT_THROW(Model::parse("coordinates = ['x']\n[mechanics]\nmass = [['1']]\n[constraints]\nposition = ['site(\"a\").x']", "m"),
               InputError);
}

}  // namespace
}  // namespace gp2
