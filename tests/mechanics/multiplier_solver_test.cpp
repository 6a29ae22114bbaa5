#include "mechanics/multiplier_solver.hpp"

#include <cmath>

#include <gtest/gtest.h>
#include <Eigen/Core>

// λ = G ā(λ) + d
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

// Forces of 10² to 10⁸ times the load that cancel in G ā: λ = λ₀ + κ λ, κ = −0.5.
TEST(MultiplierSolver, ReachesWhatRoundingOfLargeForcesAllows) {
  for (int exponent = 2; exponent <= 8; ++exponent) {
    const double large = std::pow(10., exponent) / 3, kappa = -0.5;
    const MatrixXd G = (MatrixXd(1, 2) << 0.7, 0.3).finished();
    const VectorXd d = VectorXd::Constant(1, 1.1), direction = (VectorXd(2) << large, (kappa - 0.7 * large) / 0.3).finished();
    MultiplierSolver solver;
    ASSERT_TRUE(solver.solve(G, d, [&](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
      a_bar = direction * std::abs(lambda[0]);
      slope = direction * std::copysign(1, lambda[0]);
    })) << large;
    EXPECT_NEAR(solver.lambda()[0], 1.1 / (1 - kappa), 4e-16 * large);
  }
}

// Painlevé's case: the load grows with the friction as fast as the friction.
TEST(MultiplierSolver, ReachesNothingWhereTheLoadGrowsAsFastAsItsFriction) {
  for (const double kappa : {1.0, 1.5}) {
    MultiplierSolver solver;
    EXPECT_FALSE(solver.solve(MatrixXd::Constant(1, 1, kappa), VectorXd::Ones(1),
                              [](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
                                a_bar = lambda.cwiseAbs();
                                slope = MatrixXd::Constant(1, 1, std::copysign(1, lambda[0]));
                              }));
  }
}

}  // namespace
}  // namespace gp2
