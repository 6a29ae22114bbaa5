#include "gp2/view.hpp"

#include <cmath>

#include <gtest/gtest.h>
#include <Eigen/QR>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using Quantity = View::Quantity;

class Views : public testing::Test {
 protected:
  const System& system = *test::model("models/surface.toml").system;
  const MatrixXd states = test::draw(test::model("models/surface.toml"), 4, 1).states;
  const VectorXd parameters = system.parameter_values();
  const MechanicsBatch mechanics = require_mechanics(system, states, parameters);
};

TEST_F(Views, OfTheConstrainedAccelerationAreTAndLb) {
  const ViewValues values = evaluate_view(View::all(Quantity::constrained_acceleration, system), mechanics, states);
  for (int i = 0; i < 4; ++i) {
    EXPECT_EQ(MatrixXd(values.G(i)), mechanics.projections[static_cast<std::size_t>(i)].T());
    EXPECT_EQ(VectorXd(values.offset.col(i)), mechanics.projections[static_cast<std::size_t>(i)].Lb());
  }
}

TEST_F(Views, OfTheUnconstrainedAccelerationAreTheIdentityWhateverTheParameters) {
  const View view = View::all(Quantity::unconstrained_acceleration, system);
  const ViewValues values = evaluate_view(view, mechanics, states);
  EXPECT_EQ(MatrixXd(values.G(2)), MatrixXd::Identity(3, 3));
  EXPECT_TRUE(values.offset.isZero(0));
  const ViewValues derivative = differentiate_view(view, mechanics, system.differentiate(states, parameters, 2));
  EXPECT_TRUE(derivative.matrix.isZero(0));
  EXPECT_TRUE(derivative.offset.isZero(0));
}

TEST_F(Views, OfSomeRowsAreThoseRowsInTheirOrder) {
  const View all = View::all(Quantity::constrained_acceleration, system);
  const View some{Quantity::constrained_acceleration, {2, 0}};
  const ViewValues whole = evaluate_view(all, mechanics, states), part = evaluate_view(some, mechanics, states);
  EXPECT_EQ(VectorXd(part.G(1).row(0)), VectorXd(whole.G(1).row(2)));
  EXPECT_EQ(VectorXd(part.G(1).row(1)), VectorXd(whole.G(1).row(0)));
  EXPECT_EQ(part.offset(0, 3), whole.offset(2, 3));
  const SystemValues d = system.differentiate(states, parameters, 2);
  EXPECT_EQ(VectorXd(differentiate_view(some, mechanics, d).G(1).row(0)),
            VectorXd(differentiate_view(all, mechanics, d).G(1).row(2)));
}

TEST_F(Views, AreNamedAfterTheirCoordinates) {
  EXPECT_EQ((View{Quantity::constrained_acceleration, {1, 0}}.names(system)), (std::vector<std::string>{"ddq2", "ddq1"}));
  EXPECT_EQ((View{Quantity::unconstrained_acceleration, {2}}.names(system)), (std::vector<std::string>{"abar_q3"}));
}

TEST_F(Views, OfOtherQuantitiesCarryTheirNames) {
  const auto first = [&](Quantity quantity) { return View{quantity, {0}}.names(system).front(); };
  EXPECT_EQ(first(Quantity::constraint_force), "fc_q1");
  EXPECT_EQ(first(Quantity::multipliers), "lambda1");
  EXPECT_EQ(first(Quantity::next_velocity), "dq1_next");
  EXPECT_EQ(first(Quantity::learned_force), "force_q1");
  EXPECT_EQ((View{Quantity::unconstrained_acceleration, {1}, std::nullopt, 0}.names(system, "drag")),
            std::vector<std::string>{"abar_q2@drag"});
  for (const std::string& word : View::Quantity::words()) EXPECT_EQ((*View::Quantity::of_word(word))->word(), word);
  EXPECT_FALSE(View::Quantity::of_word("sideways"));
}

// what each quantity is, by its definition, for every model and some ā
class ViewsOfEveryModel : public testing::TestWithParam<std::string> {
 protected:
  const System& system = *test::model(GetParam()).system;
  const MatrixXd states = test::draw(test::model(GetParam()), 5, 3).states;
  const VectorXd parameters = system.parameter_values();
  const MechanicsBatch mechanics = require_mechanics(system, states, parameters);
  // an unconstrained acceleration of the size of M⁻¹(forces around 1)
  VectorXd a_bar(int i) const {
    const VectorXd force = VectorXd::LinSpaced(system.nq(), -1, 2);
    return mechanics.projections[static_cast<std::size_t>(i)].solve_mass(force);
  }
  VectorXd of(Quantity quantity, int i, double time_step = 0) const {
    View view = View::all(quantity, system);
    view.time_step = time_step;
    const ViewValues values = evaluate_view(view, mechanics, states);
    return values.G(i) * a_bar(i) + values.offset.col(i);
  }
};

TEST_P(ViewsOfEveryModel, TheConstraintForceIsWhatTheConstraintAddsToTheMotion) {
  for (int i = 0; i < 5; ++i) {
    const MatrixXd M = mechanics.values.M(i);
    const VectorXd expected = M * (of(Quantity::constrained_acceleration, i) - a_bar(i));
    // both are differences of numbers of the size of M ddq and M ā
    const double size = (M.cwiseAbs() * (of(Quantity::constrained_acceleration, i).cwiseAbs() + a_bar(i).cwiseAbs())).maxCoeff();
    EXPECT_LT((of(Quantity::constraint_force, i) - expected).cwiseAbs().maxCoeff(), 1e-12 * size) << "state " << i;
  }
}

TEST_P(ViewsOfEveryModel, MultipliersMakeTheConstraintForceAndHaveMinimumNorm) {
  if (system.nc() == 0) return;
  for (int i = 0; i < 5; ++i) {
    const MatrixXd A = mechanics.values.A(i);
    const VectorXd force = of(Quantity::constraint_force, i);
    const VectorXd lambda = of(Quantity::multipliers, i);
    EXPECT_LT((A.transpose() * lambda - force).cwiseAbs().maxCoeff(), 1e-10 * force.cwiseAbs().maxCoeff()) << "state " << i;
    // another road: the minimum-norm solution of Aᵀλ = force
    Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
    decomposition.setThreshold(1e-9);
    decomposition.compute(A.transpose());
    const VectorXd expected = decomposition.solve(force);
    EXPECT_LT((lambda - expected).cwiseAbs().maxCoeff(), 1e-8 * expected.cwiseAbs().maxCoeff()) << "state " << i;
  }
}

TEST_P(ViewsOfEveryModel, TheNextVelocityIsAnEulerStep) {
  const double dt = 1e-3;
  for (int i = 0; i < 5; ++i) {
    const VectorXd dq = states.col(i).segment(system.nq(), system.nq());
    const VectorXd expected = dq + dt * of(Quantity::constrained_acceleration, i);
    const VectorXd next = of(Quantity::next_velocity, i, dt);
    for (int j = 0; j < system.nq(); ++j) {
      if (std::isnan(dq[j])) continue;  // not read by this model
      EXPECT_NEAR(next[j], expected[j], 1e-14 * (1 + std::abs(expected[j])));
    }
  }
}

TEST_P(ViewsOfEveryModel, DerivativesInTheParametersEqualDifferences) {
  for (Quantity quantity : {Quantity::constraint_force, Quantity::multipliers, Quantity::next_velocity}) {
    View view = View::all(quantity, system);
    view.time_step = 0.5;
    for (std::size_t p = 0; p < system.parameters().size(); ++p) {
      // differences need rows that stay as independent as they are when a parameter moves
      if (mechanics.projections[0].rank() < system.nc()) continue;
      const double step = 1e-6 * std::max(std::abs(parameters[static_cast<Eigen::Index>(p)]), 1e-2);
      const auto at = [&](double change) {
        VectorXd moved = parameters;
        moved[static_cast<Eigen::Index>(p)] += change;
        return evaluate_view(view, require_mechanics(system, states, moved), states);
      };
      const ViewValues up = at(step), down = at(-step);
      const ViewValues d = differentiate_view(view, mechanics, system.differentiate(states, parameters, static_cast<int>(p)));
      const MatrixXd dG = (up.matrix - down.matrix) / (2 * step);
      // central differences: rounding ε/step of the values, truncation step² of the third derivative
      const double tolerance_G = 1e-6 * (up.matrix.cwiseAbs().maxCoeff() / step * 1e-3 + dG.cwiseAbs().maxCoeff());
      EXPECT_LT((d.matrix - dG).cwiseAbs().maxCoeff(), tolerance_G) << system.parameters()[p].name << " " << quantity->word();
      for (Eigen::Index k = 0; k < d.offset.size(); ++k) {
        const double difference = (up.offset.reshaped()[k] - down.offset.reshaped()[k]) / (2 * step);
        if (std::isnan(difference)) continue;
        const double size = std::abs(up.offset.reshaped()[k]) / step * 1e-3 + std::abs(difference);
        EXPECT_NEAR(d.offset.reshaped()[k], difference, 1e-6 * (size + 1e-3)) << system.parameters()[p].name;
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Models, ViewsOfEveryModel,
                         testing::Values("models/surface.toml", "models/unicycle.toml", "models/duffing.toml",
                                         "models/double_pendulum.toml", "models/slider_crank.toml",
                                         "models/arm_on_moving_plane.toml"),
                         [](const auto& instance) {
                           const std::string file = instance.param.substr(instance.param.find('/') + 1);
                           return file.substr(0, file.find('.'));
                         });

}  // namespace
}  // namespace gp2
