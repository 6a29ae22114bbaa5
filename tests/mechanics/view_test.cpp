#include "gp2/view.hpp"

#include <gtest/gtest.h>

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
  const ViewValues values = evaluate_view(View::all(Quantity::constrained_acceleration, system), mechanics);
  for (int i = 0; i < 4; ++i) {
    EXPECT_EQ(MatrixXd(values.G(i)), mechanics.projections[static_cast<std::size_t>(i)].T());
    EXPECT_EQ(VectorXd(values.offset.col(i)), mechanics.projections[static_cast<std::size_t>(i)].Lb());
  }
}

TEST_F(Views, OfTheUnconstrainedAccelerationAreTheIdentityWhateverTheParameters) {
  const View view = View::all(Quantity::unconstrained_acceleration, system);
  const ViewValues values = evaluate_view(view, mechanics);
  EXPECT_EQ(MatrixXd(values.G(2)), MatrixXd::Identity(3, 3));
  EXPECT_TRUE(values.offset.isZero(0));
  const ViewValues derivative = differentiate_view(view, mechanics, system.differentiate(states, parameters, 2));
  EXPECT_TRUE(derivative.matrix.isZero(0));
  EXPECT_TRUE(derivative.offset.isZero(0));
}

TEST_F(Views, OfSomeRowsAreThoseRowsInTheirOrder) {
  const View all = View::all(Quantity::constrained_acceleration, system);
  const View some{Quantity::constrained_acceleration, {2, 0}};
  const ViewValues whole = evaluate_view(all, mechanics), part = evaluate_view(some, mechanics);
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

}  // namespace
}  // namespace gp2
