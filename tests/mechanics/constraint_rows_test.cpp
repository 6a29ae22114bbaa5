#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/mechanics/callable_system.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "mechanics/known_multipliers.hpp"
#include "test_models.hpp"

// A and b against the motion they come from.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t constraint_rows_seed = 20202;

class ConstraintRows : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, ConstraintRows, testing::ValuesIn(test::every_model()), test::model_test_name);

// Along q(τ) = q + dq τ + ½ ddq τ², with any ddq: d/dτ of a velocity-level residual (or of ċ) is A ddq − b.
TEST_P(ConstraintRows, TheirResidualChangesAlongTheMotionAsAAndBSay) {
  const System& system = *test::model(GetParam()).system;
  const StateLayout layout = system.layout();
  const VectorXd parameters = system.parameter_values();
  RandomStream random(constraint_rows_seed);
  int n_compared = 0;
  for (const test::StateFamily& family : test::state_families(GetParam(), constraint_rows_seed)) {
    const SystemValues values = system.evaluate(family.states, parameters);
    for (int i = 0; i < values.n_states(); ++i) {
      SCOPED_TRACE(fmt::format("{}, state {} of those {}, seed {}", GetParam(), i, family.name, constraint_rows_seed));
      const VectorXd x = family.states.col(i);
      const VectorXd ddq = test::random_vector(layout.nq, random);
      const auto residuals_at = [&](double tau) -> VectorXd {
        VectorXd moved = x;
        moved.head(layout.nq) += tau * x.segment(layout.nq, layout.nq) + 0.5 * tau * tau * ddq;
        moved.segment(layout.nq, layout.nq) += tau * ddq;
        moved[layout.t()] += tau;
        return system.residuals(moved, parameters).col(0);
      };
      // the trigonometric functions turn by |dq| τ; faster states change over shorter times
      const double speed =
          x.segment(layout.nq, layout.nq).array().isNaN().select(0, x.segment(layout.nq, layout.nq).array().abs()).maxCoeff();
      // intermediate terms of a residual are larger than the residual, which is zero on the constraint
      const double precision = 64 * test::eps * (1 + x.array().isNaN().select(0, x.array().abs()).maxCoeff());
      const VectorXd now = residuals_at(0);
      test::Difference difference = test::central_difference(residuals_at, 0, 1 / (1 + 2 * speed), precision);
      difference.error.array() += precision * (1 + speed) * (1 + speed) / std::pow(test::eps, 0.2);
      for (std::size_t k = 0; k < system.residual_labels().size(); ++k) {
        const System::Residual& label = system.residual_labels()[k];
        const auto index = static_cast<Eigen::Index>(k);
        if (label.velocity) {
          const double expected = values.A(i).row(label.row) * ddq - values.b(i)[label.row];
          EXPECT_NEAR(difference.value[index], expected, difference.error[index]) << label.text;
          EXPECT_LE(difference.error[index], 1e-4 * (1 + std::abs(expected)) * (1 + speed) * (1 + speed))
              << "the quotient is too coarse to test anything";
          ++n_compared;
        } else {
          // the residual after a position is its rate
          EXPECT_NEAR(difference.value[index], now[index + 1], difference.error[index]) << label.text;
        }
      }
    }
  }
  EXPECT_GT(n_compared, 0);
}

// Measured states are off the constraints, where rows that follow from others on them do not.
TEST(ConstraintRowsTest, RedundantOnesStaySoAtMeasuredStates) {
  const System& system = *test::model("models/slider_crank.toml").system;
  EXPECT_EQ(system.nc(), 3);
  EXPECT_EQ(system.largest_rank(), 2);
  const VectorXd parameters = system.parameter_values();
  const MatrixXd exact = test::draw(test::model("models/slider_crank.toml"), 20, constraint_rows_seed).states;
  const MechanicsBatch there = require_mechanics(system, exact, parameters);
  for (const double error : {1e-9, 1e-6, 1e-3}) {
    SCOPED_TRACE(error);
    RandomStream random(constraint_rows_seed);
    MatrixXd measured = exact;
    for (double& entry : measured.topRows(6).reshaped()) entry += error * (2 * random.uniform() - 1);
    const MechanicsBatch here = require_mechanics(system, measured, parameters);
    for (std::size_t i = 0; i < there.projections.size(); ++i) {
      EXPECT_EQ(here.projections[i].rank(), 2);
      // lengths are 0.1 m and more, velocities below 10 rad/s
      const MatrixXd &T = there.projections[i].T(), &moved = here.projections[i].T();
      EXPECT_LE(test::largest(moved - T), 100 * error * (1 + test::largest(T)));
      EXPECT_LE(test::largest(here.projections[i].Lb() - there.projections[i].Lb()),
                1000 * error * (1 + test::largest(there.projections[i].Lb())));
    }
    // which of the rows are taken hangs on no last bit: columns of equal lengths have an order
    const MechanicsBatch beside = require_mechanics(system, measured * (1 + 4 * test::eps), parameters);
    for (std::size_t i = 0; i < here.projections.size(); ++i) {
      const VectorXd a_bar = here.projections[i].solve_mass(here.values.F(static_cast<int>(i)));
      const VectorXd ddq = here.projections[i].Lb() + here.projections[i].T() * a_bar;
      const double rounding = 1e-10 * (1 + test::largest(ddq));
      EXPECT_LE(test::largest(beside.projections[i].constrain(a_bar) - ddq), rounding);
    }
  }
}

// Two carts side by side, one of which carries a mast that may touch.
Model carts(const std::string& rows) {
  return Model::parse(fmt::format(R"toml(
name        = "carts"
coordinates = ["x", "y", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "2", "0"], ["0", "0", "1"]]
force = ["-x", "1", "-9.81"]
[constraints]
{}
[[latent]]
kernel     = "se"
features   = ["dx"]
directions = "acceleration"
)toml",
                                  rows),
                      "carts");
}

// As above, where a row comes and goes.
TEST(ConstraintRowsTest, RedundantOnesStaySoBesideConditionalOnes) {
  const std::string contact = "{ expr = 'z - 0.1*x', contact = 'touch' }", when = "{ expr = 'z - 0.1*x', when = 'touch > 0.5' }",
                    acceleration = "acceleration = [{ expr = 'ddz - 0.1*ddx', when = 'touch > 0.5' }]";
  struct Rows {
    std::string once, twice;
  };
  for (const auto& [once, twice] :
       {Rows{"position = ['x - y', " + contact + "]", "position = ['x - y', " + contact + ", 'sin(x) - sin(y)']"},
        Rows{"position = [" + when + ", 'x - y']", "position = [" + when + ", 'x - y', 'sin(x) - sin(y)']"},
        Rows{"position = ['x - y']\n" + acceleration, "position = ['x - y', 'sin(x) - sin(y)']\n" + acceleration}}) {
    SCOPED_TRACE(fmt::format("{}, seed {}", twice, constraint_rows_seed));
    const Model less = carts(once), more = carts(twice);
    EXPECT_EQ(less.system->largest_rank(), 2);
    EXPECT_EQ(more.system->largest_rank(), 2);
    const VectorXd parameters = more.system->parameter_values();
    RandomStream random(constraint_rows_seed);
    MatrixXd exact(8, 20);  // x y z dx dy dz t touch
    for (double& entry : exact.reshaped()) entry = 2 * random.uniform() - 1;
    exact.row(1) = exact.row(0);
    exact.row(4) = exact.row(3);
    for (Eigen::Index i = 0; i < exact.cols(); ++i) {
      exact(7, i) = static_cast<double>(i % 2);
      if (i % 2 == 0) continue;
      exact(2, i) = 0.1 * exact(0, i);
      exact(5, i) = 0.1 * exact(3, i);
    }
    for (const double error : {1e-6, 1e-5, 1e-4}) {
      SCOPED_TRACE(error);
      MatrixXd measured = exact;
      for (double& entry : measured.topRows(6).reshaped()) entry += error * (2 * random.uniform() - 1);
      const MechanicsBatch expected = require_mechanics(*less.system, measured, parameters);
      const MechanicsBatch got = require_mechanics(*more.system, measured, parameters);
      const MatrixXd expected_lambda = with_known_multipliers(*less.system, measured, parameters).bottomRows(2);
      const MatrixXd lambda = with_known_multipliers(*more.system, measured, parameters).bottomRows(3);
      for (int i = 0; i < got.values.n_states(); ++i) {
        const UdwadiaKalaba& of_less = expected.projections[static_cast<std::size_t>(i)];
        const UdwadiaKalaba& of_more = got.projections[static_cast<std::size_t>(i)];
        EXPECT_EQ(of_more.rank(), 1 + i % 2);
        EXPECT_EQ(more.system->largest_rank_of(got.values.A(i)), 1 + i % 2);
        // entries of A and b have slopes below 10, and the force is about 10
        EXPECT_LE(test::largest(of_more.T() - of_less.T()), 10 * error);
        EXPECT_LE(test::largest(of_more.Lb() - of_less.Lb()), 10 * error);
        const VectorXd force = got.values.A(i).transpose() * lambda.col(i);
        EXPECT_LE(test::largest(force - expected.values.A(i).transpose() * expected_lambda.col(i)), 100 * error);
      }
      const std::string text = "constraints: rank 2 of 3 rows: 1 redundant, which is allowed";
      const std::vector<Finding> findings = check_system(*more.system, measured, parameters);
      EXPECT_TRUE(std::ranges::any_of(findings, [&](const Finding& one) { return one.text == text; }));
    }
  }
}

// What conditional rows say against each other, or against those that hold always, is no error of the state.
TEST(ConstraintRowsTest, ConditionalOnesContradictBesideRedundantOnesToo) {
  const auto model_with = [](const std::string& conditional) {
    return carts("position = ['x - y', 'sin(x) - sin(y)']\nacceleration = [" + conditional + "]");
  };
  const std::string one = "{ expr = 'ddz - 0.5*ddx - 1', when = 'touch > 0.5' }";
  for (const double error : {0.0, 1e-6, 1e-4}) {
    SCOPED_TRACE(error);
    VectorXd state(8);  // x y z dx dy dz t touch
    state << 0.4, 0.4 + error, 0.2, 0, 0, 0, 0, 1;
    for (const double speed : {0.0, 1.0}) {
      state[3] = speed;
      state[4] = speed - error;
      const auto fault_of = [&](const Model& model) {
        MechanicsBatch batch;
        evaluate_mechanics(*model.system, state, model.system->parameter_values(), batch);
        return batch.fault;
      };
      EXPECT_FALSE(fault_of(model_with(one)).has_value());
      for (const char* other :
           {"{ expr = 'ddz - 0.5*ddx - 2', when = 'touch > 0.5' }", "{ expr = 'ddx - ddy - 1', when = 'touch > 0.5' }"}) {
        const auto fault = fault_of(model_with(one + ", " + other));
        ASSERT_TRUE(fault.has_value()) << other;
        EXPECT_THAT(fault->text, testing::HasSubstr("contradict each other"));
      }
    }
  }
}

// The functions of a text as code.
CallableSystem::Definition in_code(const Model& model) {
  const std::shared_ptr<const System> text = model.system;
  CallableSystem::Definition code;
  code.declaration = {text->name(), text->coordinates(), text->inputs(), text->parameters()};
  for (const std::string& label : text->constraint_labels()) code.constraints.push_back({label, ConstraintLevel::position});
  code.evaluate = [text](const auto& states, const auto& parameters) { return text->evaluate(states, parameters); };
  code.residuals = [text](const auto& states, const auto& parameters) { return text->residuals(states, parameters); };
  return code;
}

TEST(ConstraintRowsTest, RedundantOnesOfCodeAreThoseOfText) {
  const Model& model = test::model("models/slider_crank.toml");
  const VectorXd parameters = model.system->parameter_values();
  const CallableSystem code(in_code(model));
  EXPECT_EQ(code.largest_rank(), 2);
  RandomStream random(constraint_rows_seed);
  MatrixXd measured = test::draw(model, 20, constraint_rows_seed).states;
  for (double& entry : measured.topRows(6).reshaped()) entry += 1e-6 * (2 * random.uniform() - 1);
  const MechanicsBatch expected = require_mechanics(*model.system, measured, parameters);
  const MechanicsBatch got = require_mechanics(code, measured, parameters);
  for (std::size_t i = 0; i < expected.projections.size(); ++i) {
    EXPECT_EQ(got.projections[i].T(), expected.projections[i].T());
    EXPECT_EQ(got.projections[i].Lb(), expected.projections[i].Lb());
  }
}

TEST(ConstraintRowsTest, OfCodeTheLargestRankIsKnownWhereItsResidualsGiveStates) {
  const Model& model = test::model("models/slider_crank.toml");
  CallableSystem::Definition changed = in_code(model);
  changed.residuals = nullptr;
  EXPECT_EQ(CallableSystem(changed).largest_rank(), 3);

  changed = in_code(model);
  changed.constraints[2].level = ConstraintLevel::velocity;
  EXPECT_EQ(CallableSystem(changed).largest_rank(), 3);

  // functions that refuse some states, or all
  for (const double largest : {1.0, -10.0}) {  // of u1
    changed = in_code(model);
    changed.evaluate = [&, largest](const auto& states, const auto& parameters) {
      if (states.row(7).maxCoeff() > largest) throw std::range_error("out of the table");
      return model.system->evaluate(states, parameters);
    };
    changed.residuals = [&, largest](const auto& states, const auto& parameters) -> MatrixXd {
      if (states.row(7).minCoeff() < -largest) return MatrixXd::Constant(6, states.cols(), std::nan(""));
      return model.system->residuals(states, parameters);
    };
    EXPECT_EQ(CallableSystem(changed).largest_rank(), largest > 0 ? 2 : 3);
  }

  // residuals that A and b do not fit: in part, of the lengths in the file
  changed = in_code(model);
  changed.evaluate = [&](const auto& states, const auto&) {
    return model.system->evaluate(states, model.system->parameter_values());
  };
  EXPECT_EQ(CallableSystem(changed).largest_rank(), 2);
  changed.residuals = [&](const auto& states, const auto& parameters) -> MatrixXd {
    return model.system->residuals(states, parameters * 1.1);
  };
  EXPECT_EQ(CallableSystem(changed).largest_rank(), 3);

  // looked for once, and within the bounds of parameters
  int n_calls = 0;
  double smallest = 1;
  changed = in_code(model);
  changed.declaration.parameters[0].bounds = {0.004, 0.0041};
  changed.evaluate = [&](const auto& states, const auto& parameters) {
    ++n_calls;
    smallest = std::min(smallest, std::min(parameters[0] - 0.004, 0.0041 - parameters[0]));
    return model.system->evaluate(states, parameters);
  };
  const CallableSystem code(changed);
  EXPECT_EQ(n_calls, 0);
  EXPECT_EQ(code.largest_rank(), 2);
  EXPECT_GT(n_calls, 0);
  n_calls = 0;
  EXPECT_EQ(code.largest_rank(), 2);
  EXPECT_EQ(n_calls, 0);
  EXPECT_GE(smallest, 0);
}

TEST(ConstraintRowsTest, TheirLargestRankIsKnownWherePositionsDecideIt) {
  const auto largest_rank = [](const std::string& constraints) {
    return Model::parse(fmt::format(R"toml(
name        = "pendulum"
coordinates = ["x", "z", "a"]
parameters  = {{ h = 0, l = 0.7 }}
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.1"]]
force = ["0", "-9.81", "0"]
[constraints]
{}
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                    constraints),
                        "pendulum")
        .system->largest_rank();
  };
  const std::string loop = "'x - 0.7*sin(a)', 'z + 0.7*cos(a)'", rod = ", 'x^2 + z^2 - 0.49'";
  EXPECT_EQ(largest_rank("position = [" + loop + "]"), 2);
  EXPECT_EQ(largest_rank("position = [" + loop + rod + "]"), 2);
  EXPECT_EQ(largest_rank("position = ['x - sin(t)', '2*x - 2*sin(t)']"), 1);
  EXPECT_EQ(largest_rank("position = ['x - l*sin(a)', 'z + l*cos(a)', 'x^2 + z^2 - l^2']"), 2);
  EXPECT_EQ(largest_rank("position = ['z - h*x^2', 'z - h*a']"), 2) << "where h is not 0";
  EXPECT_EQ(largest_rank("position = ['x - t', 'x - 2*t']"), 2) << "they contradict each other";
  EXPECT_EQ(largest_rank("position = [" + loop + rod + "]\nvelocity = ['dx + dz']"), 4) << "not of positions alone";
  EXPECT_EQ(largest_rank("position = [" + loop + ", { expr = 'x^2 + z^2 - 0.49', when = 'x > 0' }]"), 3) << "not always there";
  EXPECT_EQ(largest_rank("position = [" + loop + rod + ", { expr = 'a - 1', when = 'x > 0' }]"), 3);
  EXPECT_EQ(largest_rank("position = [" + loop + rod + "]\nvelocity = [{ expr = 'da', when = 'x > 0' }]"), 3);
  EXPECT_EQ(largest_rank("position = [" + loop + rod + "]\nvelocity = ['da', { expr = 'dx', when = 'x > 0' }]"), 5);
}

TEST(ConstraintRowsTest, AnAccelerationLevelConstraintIsTakenAsWritten) {
  const Model model = Model::parse(R"toml(
name        = "two carts"
coordinates = ["x", "y"]
inputs      = ["u"]
[parameters]
c = 2.0
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
acceleration = ["c*ddx + sin(x)*ddy - u*dy^2 + t"]
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                   "two carts");
  const VectorXd state = (VectorXd(6) << 0.3, -1, 0.5, 2, 0.25, 1.5).finished();  // x y dx dy t u
  const SystemValues values = model.system->evaluate(state, model.system->parameter_values());
  EXPECT_EQ(values.A(0)(0, 0), 2.0);
  EXPECT_DOUBLE_EQ(values.A(0)(0, 1), std::sin(0.3));
  EXPECT_DOUBLE_EQ(values.b(0)[0], 1.5 * 4 - 0.25);
  EXPECT_TRUE(model.system->residual_labels().empty());
}

}  // namespace
}  // namespace gp2
