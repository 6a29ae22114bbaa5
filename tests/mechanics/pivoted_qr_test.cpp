#include "mechanics/pivoted_qr.hpp"

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;

constexpr std::uint64_t pivoted_qr_seed = 20302;

struct Decomposition {
  MatrixXd W;  // in place
  VectorXd reflection;
  Eigen::VectorXi order;
  Index rank;

  explicit Decomposition(const MatrixXd& matrix)
      : W(matrix), reflection(std::min(matrix.rows(), matrix.cols())), order(matrix.cols()) {
    rank = internal::pivoted_qr(W, reflection, order, 1e-10);
  }
  MatrixXd thin_Q() const {
    MatrixXd Q = MatrixXd::Identity(W.rows(), rank);
    internal::apply_Q(W, reflection, rank, Q);
    return Q;
  }
  MatrixXd R() const { return W.topRows(rank).triangularView<Eigen::Upper>(); }
};

MatrixXd random_of_rank(Index rows, Index cols, Index rank, RandomStream& random) {
  MatrixXd left(rows, rank), right(rank, cols);
  for (double& entry : left.reshaped()) entry = random.normal();
  for (double& entry : right.reshaped()) entry = random.normal();
  return left * right;
}

TEST(PivotedQrTest, DecomposesMatricesOfAnyShapeAndRank) {
  SCOPED_TRACE(fmt::format("seed {}", pivoted_qr_seed));
  RandomStream random(pivoted_qr_seed);
  for (const auto& [rows, cols, rank] : {std::tuple<Index, Index, Index>{1, 1, 1},
                                         {3, 1, 1},
                                         {1, 4, 1},
                                         {4, 3, 2},
                                         {3, 6, 3},
                                         {6, 6, 6},
                                         {20, 11, 7},
                                         {60, 40, 30}}) {
    SCOPED_TRACE(fmt::format("{} × {} of rank {}", rows, cols, rank));
    const MatrixXd W = random_of_rank(rows, cols, rank, random);
    const Decomposition qr(W);
    ASSERT_EQ(qr.rank, rank);
    const MatrixXd Q = qr.thin_Q();
    const double tolerance = 16 * eps * static_cast<double>(rows + cols);
    EXPECT_LE((Q.transpose() * Q - MatrixXd::Identity(rank, rank)).cwiseAbs().maxCoeff(), tolerance);
    const MatrixXd WP = W(Eigen::all, qr.order);
    EXPECT_LE((Q * qr.R() - WP).cwiseAbs().maxCoeff(), tolerance * W.norm());
    // Qᵀ is the inverse of Q
    MatrixXd QtW = W;
    internal::apply_Q_transposed(qr.W, qr.reflection, qr.rank, QtW);
    EXPECT_LE((QtW.topRows(rank) - Q.transpose() * W).cwiseAbs().maxCoeff(), tolerance * W.norm());
    EXPECT_LE(QtW.bottomRows(rows - rank).norm(), tolerance * W.norm());
    // pivots descend
    for (Index k = 1; k < rank; ++k) EXPECT_LE(std::abs(qr.W(k, k)), (1 + tolerance) * std::abs(qr.W(k - 1, k - 1)));
  }
}

TEST(PivotedQrTest, TheRankIsRelativeToTheLargestColumn) {
  const MatrixXd W = Eigen::Vector3d(1e-30, 1e-35, 1e-45).asDiagonal();
  EXPECT_EQ(Decomposition(W).rank, 2);
  EXPECT_EQ(Decomposition(MatrixXd::Zero(3, 2)).rank, 0);
  EXPECT_EQ(Decomposition(MatrixXd::Zero(3, 0)).rank, 0);
}

TEST(PivotedQrTest, WhatIsNotANumberHasNoRank) {
  EXPECT_EQ(Decomposition(MatrixXd::Constant(3, 2, std::numeric_limits<double>::quiet_NaN())).rank, 0);
}

}  // namespace
}  // namespace gp2
