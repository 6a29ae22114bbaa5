#include "base/lapack.hpp"

#include <gtest/gtest.h>

#include "base/random.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;

MatrixXd random_positive_definite(Index n) {
  RandomStream random(71);
  MatrixXd B(n, n);
  for (double& entry : B.reshaped()) entry = random.normal();
  return B * B.transpose() + MatrixXd::Identity(n, n);
}

MatrixXd lower(const MatrixXd& A) { return A.triangularView<Eigen::Lower>(); }

TEST(Lapack, InPiecesIsTheSameAsInOneToRounding) {
  for (const Index n : {1, 40, 200, 333}) {
    SCOPED_TRACE(n);
    const MatrixXd A = random_positive_definite(n);
    MatrixXd whole = A, pieces = A;
    const lapack::Pieces small{nullptr, 1e6};
    ASSERT_TRUE(lapack::factorise(whole));
    ASSERT_TRUE(lapack::factorise(pieces, small));
    EXPECT_LT((lower(whole) - lower(pieces)).cwiseAbs().maxCoeff(), 1e-12 * whole.cwiseAbs().maxCoeff());
    lapack::invert_factored(whole);
    lapack::invert_factored(pieces, small);
    EXPECT_LT((lower(whole) - lower(pieces)).cwiseAbs().maxCoeff(), 1e-9 * lower(whole).cwiseAbs().maxCoeff());
    const MatrixXd inverse = pieces.selfadjointView<Eigen::Lower>();
    EXPECT_LT((inverse * A - MatrixXd::Identity(n, n)).cwiseAbs().maxCoeff(), 1e-6);
  }
}

TEST(Lapack, ASymmetricProductIsTheProductInBothTriangles) {
  RandomStream random(72);
  for (const Index n : {0, 1, 63, 64, 65, 200}) {
    SCOPED_TRACE(n);
    const Index k = 50;
    MatrixXd A(n, k);
    Eigen::VectorXd weights(k);
    for (double& entry : A.reshaped()) entry = random.normal();
    for (double& weight : weights) weight = random.normal();
    const MatrixXd B = A * weights.asDiagonal();
    MatrixXd sum = n == 0 ? MatrixXd(0, 0) : random_positive_definite(n);
    const MatrixXd expected = sum + A * B.transpose();
    lapack::add_symmetric_product(A, B, sum);
    // k products of normal numbers and a sum of n: of each entry some ε times their absolute values
    EXPECT_TRUE((sum - expected).isZero(1e-12 * (1 + static_cast<double>(n))));
  }
}

TEST(Lapack, AMatrixThatIsNotPositiveDefiniteIsFoundInEveryPiece) {
  const Index n = 200;
  for (const Index bad : {0, 99, 100, 199}) {
    MatrixXd A = random_positive_definite(n);
    A(bad, bad) = -1;
    EXPECT_FALSE(lapack::factorise(A, {nullptr, 1e5})) << bad;
  }
}

TEST(Lapack, GivesUpWhenToldTo) {
  const std::atomic<bool> stop = true;
  MatrixXd A = random_positive_definite(200);
  const MatrixXd before = A;
  EXPECT_FALSE(lapack::factorise(A, {&stop, 1e5}));
  EXPECT_EQ(A, before);
}

}  // namespace
}  // namespace gp2
