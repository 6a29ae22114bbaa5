#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "decompositions.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "test_models.hpp"

// Laws of ddq = L b + T ā, for every model at every kind of state.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;

constexpr std::uint64_t laws_seed = 20201;

/// What a law sees of one state.
struct Case {
  MatrixXd M, A;
  VectorXd b;
  UdwadiaKalaba projection;
  double
      rounding;  // of T and L: each comes from a handful of products and triangular solves with the factor of M: ε · 32 n · κ(M)
};

double condition(const MatrixXd& M) {
  const VectorXd values = Eigen::SelfAdjointEigenSolver<MatrixXd>(M).eigenvalues();
  return values[values.size() - 1] / values[0];
}

MatrixXd with_row(const MatrixXd& A, const Eigen::RowVectorXd& row) {
  MatrixXd extended(A.rows() + 1, A.cols());
  extended << A, row;
  return extended;
}

VectorXd with_entry(const VectorXd& b, double entry) {
  VectorXd extended(b.size() + 1);
  extended << b, entry;
  return extended;
}

// a row that vanishes stays
MatrixXd unit_rows(MatrixXd A) {
  for (auto row : A.rowwise()) row.normalize();
  return A;
}

class MechanicsLaws : public testing::TestWithParam<std::string> {
 protected:
  template <typename Law>
  void for_every_state(const Law& law) {
    const System& system = *test::model(GetParam()).system;
    for (const test::StateFamily& family : test::state_families(GetParam(), laws_seed)) {
      const MechanicsBatch batch = require_mechanics(system, family.states, system.parameter_values());
      for (int i = 0; i < batch.values.n_states(); ++i) {
        SCOPED_TRACE(fmt::format("{}, state {} of those {}, seed {}", GetParam(), i, family.name, laws_seed));
        const MatrixXd M = batch.values.M(i);
        law(Case{M, batch.values.A(i), batch.values.b(i), batch.projections[static_cast<std::size_t>(i)],
                 32 * eps * static_cast<double>(M.rows()) * condition(M)});
        if (HasFatalFailure()) return;
      }
    }
  }
};

INSTANTIATE_TEST_SUITE_P(EveryModel, MechanicsLaws, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(MechanicsLaws, TheProjectionTakesAwayWhatTheConstraintSees) {
  for_every_state([](const Case& c) {
    const MatrixXd& T = c.projection.T();
    EXPECT_LE(test::largest(c.A * T), c.rounding * test::largest(c.A) * (1 + test::largest(T)));
  });
}

TEST_P(MechanicsLaws, TheProjectionIsAProjectionThatIsSymmetricInTheMetricOfM) {
  for_every_state([](const Case& c) {
    const MatrixXd& T = c.projection.T();
    const double scale = 1 + test::largest(T);
    EXPECT_LE(test::largest(T * T - T), c.rounding * scale * scale);
    EXPECT_LE(test::largest(c.M * T - T.transpose() * c.M), c.rounding * test::largest(c.M) * scale);
    // its trace is the number of free directions
    EXPECT_NEAR(T.trace(), static_cast<double>(T.rows() - c.projection.rank()),
                c.rounding * scale * static_cast<double>(T.rows()));
  });
}

TEST_P(MechanicsLaws, LIsAGeneralisedInverseOfAWhichTurnsBIntoAnAcceleration) {
  for_every_state([](const Case& c) {
    const MatrixXd L = c.projection.L();
    const MatrixXd LA = L * c.A;
    for (Eigen::Index row = 0; row < c.A.rows(); ++row) {
      const double size = test::largest(c.A.row(row));
      EXPECT_LE(test::largest(c.A.row(row) * LA - c.A.row(row)), c.rounding * size * (1 + test::largest(LA)));
      // a redundant row agrees with the others as far as the state satisfies the constraints:
      // 16 ε times sizes of order one or less
      EXPECT_NEAR(c.A.row(row) * c.projection.Lb(), c.b[row],
                  c.rounding * (size * test::largest(c.projection.Lb()) + std::abs(c.b[row]) + test::largest(c.b)));
    }
    EXPECT_LE(test::largest(c.projection.T() - (MatrixXd::Identity(c.M.rows(), c.M.rows()) - LA)),
              c.rounding * (1 + test::largest(LA)));
  });
}

TEST_P(MechanicsLaws, ScalingTheRowsOfTheConstraintChangesNothing) {
  RandomStream random(laws_seed);
  for_every_state([&](const Case& c) {
    VectorXd scale(c.A.rows());
    for (double& entry : scale) entry = std::pow(10.0, 12 * random.uniform() - 6);
    const UdwadiaKalaba scaled(c.M, scale.asDiagonal() * c.A, scale.cwiseProduct(c.b));
    EXPECT_EQ(scaled.rank(), c.projection.rank());
    EXPECT_LE(test::largest(scaled.T() - c.projection.T()), c.rounding * (1 + test::largest(c.projection.T())));
    EXPECT_LE(test::largest(scaled.Lb() - c.projection.Lb()),
              c.rounding * (test::largest(c.projection.Lb()) + test::largest(c.b)));
  });
}

TEST_P(MechanicsLaws, ARowThatFollowsFromTheOthersChangesNothing) {
  RandomStream random(laws_seed);
  for_every_state([&](const Case& c) {
    const VectorXd weights = test::random_vector(c.A.rows(), random);
    for (const VectorXd& w : {VectorXd(VectorXd::Unit(c.A.rows(), 0)), weights}) {
      const UdwadiaKalaba extended(c.M, with_row(c.A, w.transpose() * c.A), with_entry(c.b, w.dot(c.b)));
      EXPECT_EQ(extended.rank(), c.projection.rank());
      EXPECT_LE(test::largest(extended.T() - c.projection.T()), c.rounding * (1 + test::largest(c.projection.T())));
      EXPECT_LE(test::largest(extended.Lb() - c.projection.Lb()),
                c.rounding * (test::largest(c.projection.Lb()) + test::largest(c.b)));
    }
  });
}

TEST_P(MechanicsLaws, AZeroRowIsDroppedAndCounted) {
  for_every_state([](const Case& c) {
    const UdwadiaKalaba extended(c.M, with_row(c.A, Eigen::RowVectorXd::Zero(c.A.cols())), with_entry(c.b, 0));
    EXPECT_EQ(extended.n_zero_rows(), c.projection.n_zero_rows() + 1);
    EXPECT_EQ(extended.rank(), c.projection.rank());
    EXPECT_LE(test::largest(extended.T() - c.projection.T()), c.rounding * (1 + test::largest(c.projection.T())));
    EXPECT_LE(test::largest(extended.Lb() - c.projection.Lb()), c.rounding * test::largest(c.projection.Lb()));
  });
}

TEST_P(MechanicsLaws, TheConstrainedAccelerationSolvesTheEquationsOfMotionWithMultipliers) {
  RandomStream random(laws_seed);
  for_every_state([&](const Case& c) {
    if (c.projection.rank() < c.A.rows()) return;  // the KKT matrix of a redundant set is singular
    const Eigen::Index n = c.M.rows(), m = c.A.rows();
    const VectorXd a_bar = test::random_vector(n, random);
    // rows to the size of M, so that the matrix is conditioned as the mechanics are
    const VectorXd scale = test::largest(c.M) * c.A.rowwise().norm().cwiseInverse();
    MatrixXd kkt = MatrixXd::Zero(n + m, n + m);
    kkt << c.M, (scale.asDiagonal() * c.A).transpose(), scale.asDiagonal() * c.A, MatrixXd::Zero(m, m);
    VectorXd right(n + m);
    right << c.M * a_bar, scale.cwiseProduct(c.b);
    const Eigen::JacobiSVD<MatrixXd> svd(kkt);
    const double kkt_condition = svd.singularValues()[0] / svd.singularValues()[n + m - 1];
    const VectorXd ddq = kkt.fullPivLu().solve(right).head(n);
    const double tolerance =
        (c.rounding + 8 * eps * static_cast<double>(n + m) * kkt_condition) * (test::largest(ddq) + test::largest(a_bar));
    EXPECT_LE(test::largest(c.projection.constrain(a_bar) - ddq), tolerance);
    EXPECT_LE(test::largest(c.projection.Lb() + c.projection.T() * a_bar - ddq), tolerance);
  });
}

TEST_P(MechanicsLaws, NoAdmissibleAccelerationIsCloserToTheUnconstrainedOneThanGaussPrincipleSays) {
  RandomStream random(laws_seed);
  for_every_state([&](const Case& c) {
    const VectorXd a_bar = test::random_vector(c.M.rows(), random);
    const VectorXd ddq = c.projection.constrain(a_bar);
    const auto cost = [&](const VectorXd& acceleration) -> double {
      return (acceleration - a_bar).dot(c.M * (acceleration - a_bar));
    };
    // null space of A, from its own decomposition
    const Eigen::JacobiSVD<MatrixXd> svd(unit_rows(c.A), Eigen::ComputeFullV);
    const MatrixXd free = svd.matrixV().rightCols(c.M.rows() - c.projection.rank());
    if (free.cols() == 0) return;
    for (int trial = 0; trial < 5; ++trial) {
      // of the size of the acceleration, so that the growth wᵀM w stands out of the rounding of the cost
      const VectorXd w = (1 + test::largest(ddq)) * free * test::random_vector(free.cols(), random).normalized();
      EXPECT_GT(cost(ddq + w), cost(ddq));
      EXPECT_LE(std::abs(w.dot(c.M * (ddq - a_bar))), c.rounding * test::largest(c.M) * w.norm() * (ddq.norm() + a_bar.norm()));
    }
  });
}

// With rows 0 and a combination of others among them: multipliers are the shortest, and a row that vanishes has none.
TEST(UdwadiaKalabaTest, MultipliersOfRedundantAndVanishingRowsAreThoseOfThePseudoinverse) {
  RandomStream random(laws_seed);
  for (int trial = 0; trial < 50; ++trial) {
    MatrixXd A = MatrixXd::Zero(5, 4);
    for (int row : {0, 2}) A.row(row) = test::random_vector(4, random);
    if (trial % 2 == 0) A.row(4) = 0.3 * A.row(0) - 2 * A.row(2);
    const VectorXd lambda = test::random_vector(5, random);
    const MatrixXd root = test::random_vector(16, random).reshaped(4, 4);
    const MatrixXd M = root * root.transpose() + MatrixXd::Identity(4, 4);
    const UdwadiaKalaba projection(M, A, A * test::random_vector(4, random));
    const VectorXd force = A.transpose() * lambda;
    const VectorXd expected = A.transpose().completeOrthogonalDecomposition().solve(force);
    EXPECT_LE((projection.multipliers_of_force() * force - expected).cwiseAbs().maxCoeff(),
              1e-12 * condition(M) * (1 + expected.norm()));
  }
}

TEST(UdwadiaKalabaTest, WithoutConstraintsTheMotionIsTheUnconstrainedOne) {
  const MatrixXd M = Eigen::Vector2d(2, 3).asDiagonal();
  const UdwadiaKalaba projection(M, MatrixXd(0, 2), VectorXd(0));
  EXPECT_EQ(projection.rank(), 0);
  EXPECT_LE(test::largest(projection.T() - MatrixXd::Identity(2, 2)), 4 * eps);
  EXPECT_EQ(test::largest(projection.Lb()), 0);
  EXPECT_EQ(projection.L().cols(), 0);
}

TEST(UdwadiaKalabaTest, TheConstrainedAccelerationMeetsTheConstraintToRoundingWhateverTheConditionOfM) {
  SCOPED_TRACE(fmt::format("seed {}", laws_seed));
  RandomStream random(laws_seed);
  for (int trial = 0; trial < 50; ++trial) {
    // κ(M) = 1e6
    MatrixXd V(4, 4);
    for (double& entry : V.reshaped()) entry = random.normal();
    const MatrixXd Q = V.householderQr().householderQ();
    const MatrixXd M = Q * Eigen::Vector4d(1, 1e-2, 1e-4, 1e-6).asDiagonal() * Q.transpose();
    MatrixXd A(2, 4);
    for (double& entry : A.reshaped()) entry = random.normal();
    const VectorXd b = test::random_vector(2, random);
    const UdwadiaKalaba projection(0.5 * (M + M.transpose()), A, b);
    const VectorXd ddq = projection.constrain(1e3 * test::random_vector(4, random));
    // the sums A ddq themselves round at ε of their terms
    EXPECT_LE(test::largest(A * ddq - b), 32 * eps * ((A.cwiseAbs() * ddq.cwiseAbs()).maxCoeff() + test::largest(b)));
  }
}

TEST(UdwadiaKalabaTest, AMassMatrixThatIsPositiveByRoundingOnlyIsNotPositiveDefinite) {
  const MatrixXd M = (MatrixXd(2, 2) << 1, 1, 1, 1 + 4 * eps).finished();
  EXPECT_FALSE(UdwadiaKalaba(M, MatrixXd::Ones(1, 2), VectorXd::Zero(1)).mass_is_positive_definite());
  // small by its unit is another thing
  const MatrixXd small = Eigen::Vector2d(1, 1e-20).asDiagonal();
  EXPECT_TRUE(UdwadiaKalaba(small, MatrixXd::Ones(1, 2), VectorXd::Zero(1)).mass_is_positive_definite());
}

TEST(UdwadiaKalabaTest, AFullyConstrainedSystemHasNoFreedomLeft) {
  const MatrixXd A = (MatrixXd(2, 2) << 1, 2, 0, 1).finished();
  const UdwadiaKalaba projection(MatrixXd::Identity(2, 2), A, Eigen::Vector2d(4, 1));
  EXPECT_EQ(projection.rank(), 2);
  EXPECT_LE(test::largest(projection.T()), 4 * eps);
  EXPECT_LE(test::largest(projection.Lb() - Eigen::Vector2d(2, 1)), 16 * eps);
}

}  // namespace
}  // namespace gp2
