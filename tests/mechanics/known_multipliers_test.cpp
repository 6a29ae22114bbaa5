#include "mechanics/known_multipliers.hpp"

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "decompositions.hpp"
#include "test_models.hpp"

// λ₀ = (A M⁻¹Aᵀ)⁺ (b − A M⁻¹F), and its derivatives.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using Quantity = KnownMultipliers::Quantity;

constexpr std::uint64_t known_multipliers_seed = 20207;

VectorXd by_pseudo_inverse(const MatrixXd& M, const MatrixXd& A, const VectorXd& b, const VectorXd& F) {
  const Eigen::LLT<MatrixXd> factor(M);
  // rows to unit size, so that they do not decide the rank; D brings λ₀ of least norm back: λ₀ = (Aᵀ)⁺ f
  MatrixXd rows = A;
  VectorXd scaled = b;
  for (Index k = 0; k < A.rows(); ++k) {
    if (A.row(k).norm() == 0) continue;
    rows.row(k) /= A.row(k).norm();
    scaled[k] /= A.row(k).norm();
  }
  const MatrixXd gram = rows * factor.solve(rows.transpose());
  const auto inverse_of = [](const MatrixXd& matrix) -> MatrixXd {
    Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition(matrix.rows(), matrix.cols());
    decomposition.setThreshold(1e-9);
    return decomposition.compute(matrix).pseudoInverse();
  };
  const VectorXd force = rows.transpose() * (inverse_of(gram) * (scaled - rows * factor.solve(F)));
  return inverse_of(A.transpose()) * force;
}

class KnownMultipliersOf : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, KnownMultipliersOf, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(KnownMultipliersOf, AreThoseOfThePseudoinverse) {
  const System& system = *test::model(GetParam()).system;
  for (const test::StateFamily& family : test::state_families(GetParam(), known_multipliers_seed)) {
    const SystemValues values = system.evaluate(family.states, system.parameter_values());
    const MatrixXd x = with_known_multipliers(system, family.states, system.parameter_values());
    ASSERT_EQ(x.rows(), system.layout().size() + system.nc());
    for (int i = 0; i < values.n_states(); ++i) {
      SCOPED_TRACE(fmt::format("{}, state {} of those {}, seed {}", GetParam(), i, family.name, known_multipliers_seed));
      const UdwadiaKalaba projection(values.M(i), values.A(i), values.b(i));
      const VectorXd lambda0 = x.col(i).tail(system.nc());
      // those of the motion, singular M or not: M a − F = Aᵀλ₀
      const VectorXd a = projection.constrain(projection.solve_mass(values.F(i)));
      const double size = test::largest(values.M(i)) * test::largest(a) + test::largest(values.F(i));
      EXPECT_LE(test::largest(values.M(i) * a - values.F(i) - values.A(i).transpose() * lambda0), 1e5 * eps * (1 + size));
      if (!projection.mass_is_positive_definite()) continue;
      const VectorXd expected = by_pseudo_inverse(values.M(i), values.A(i), values.b(i), values.F(i));
      EXPECT_LE(test::largest(lambda0 - expected), 1e-9 * (1 + test::largest(expected)));
    }
  }
}

// Redundant rows that stay redundant, one that vanishes, and everything moving with s.
struct Family {
  MatrixXd M0, M1, A0, A1, W0, W1;
  VectorXd c0, c1, F0, F1;

  explicit Family(RandomStream& random) {
    M0 = test::random_matrix(4, 4, random);
    M0 = (M0 * M0.transpose() + MatrixXd::Identity(4, 4)).eval();
    M1 = test::random_matrix(4, 4, random);
    M1 = (M1 + M1.transpose()).eval();
    A0 = test::random_matrix(2, 4, random), A1 = test::random_matrix(2, 4, random);
    W0 = test::random_matrix(4, 2, random), W1 = test::random_matrix(4, 2, random);
    W0.row(2).setZero(), W1.row(2).setZero();
    c0 = test::random_vector(4, random), c1 = test::random_vector(4, random);
    F0 = test::random_vector(4, random), F1 = test::random_vector(4, random);
  }
  [[nodiscard]] MatrixXd M(double s) const { return M0 + s * M1; }
  [[nodiscard]] MatrixXd A(double s) const { return (W0 + s * W1) * (A0 + s * A1); }
  [[nodiscard]] VectorXd b(double s) const { return A(s) * (c0 + s * c1); }
  [[nodiscard]] VectorXd F(double s) const { return F0 + s * F1; }
};

TEST(KnownMultipliersTest, OfRedundantAndVanishingRowsAreThoseOfLeastNormAndSoAreTheirDerivatives) {
  RandomStream random(known_multipliers_seed);
  KnownMultipliers lambda0;
  for (int trial = 0; trial < 20; ++trial) {
    SCOPED_TRACE(fmt::format("trial {}, seed {}", trial, known_multipliers_seed));
    const Family f(random);
    const auto at = [&](double s) { return by_pseudo_inverse(f.M(s), f.A(s), f.b(s), f.F(s)); };
    lambda0.compute(f.M(0), f.A(0), f.b(0), f.F(0));
    EXPECT_LE(test::largest(lambda0.values() - at(0)), 1e-9 * (1 + test::largest(at(0))));
    EXPECT_EQ(lambda0.values()[2], 0) << "a row that vanishes";

    constexpr Index moving = 1;  // of two variables
    lambda0.start_derivatives(2);
    const MatrixXd dA = f.W1 * f.A0 + f.W0 * f.A1;
    const VectorXd db = dA * f.c0 + f.A(0) * f.c1;
    for (Index j = 0; j < 4; ++j) {
      for (Index i = 0; i < 4; ++i) {
        lambda0.add_derivative(Quantity::mass, i, j, moving, f.M1(i, j));
        lambda0.add_derivative(Quantity::constraint_matrix, i, j, moving, dA(i, j));
      }
      lambda0.add_derivative(Quantity::constraint_vector, j, 0, moving, db[j]);
      lambda0.add_derivative(Quantity::force, j, 0, moving, f.F1[j]);
    }
    const MatrixXd derivatives = lambda0.derivatives();
    EXPECT_EQ(test::largest(derivatives.col(0)), 0);
    EXPECT_TRUE(matches(derivatives.col(moving), test::central_difference(at, 0, 0.1, 1e5 * eps)));
    EXPECT_GT(test::largest(derivatives), 1e-2);
  }
}

TEST(KnownMultipliersTest, AreNoNumbersWhereNothingDeterminesTheMotion) {
  KnownMultipliers lambda0;
  lambda0.compute(MatrixXd::Zero(2, 2), MatrixXd::Ones(1, 2), VectorXd::Zero(1), VectorXd::Ones(2));
  EXPECT_TRUE(std::isnan(lambda0.values()[0]));
  lambda0.start_derivatives(3);
  EXPECT_TRUE(lambda0.derivatives().array().isNaN().all());
}

}  // namespace
}  // namespace gp2
