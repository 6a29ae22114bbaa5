#include "inference/growing_cholesky.hpp"

#include <Eigen/Cholesky>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t growing_cholesky_seed = 40404;

// I + X Xᵀ, well conditioned, and a right-hand side
struct Equations {
  MatrixXd K;
  VectorXd y;

  explicit Equations(Index n, std::uint64_t stream = 0) {
    RandomStream random(growing_cholesky_seed, stream);
    const MatrixXd X = test::random_vector(n * 5, random).reshaped(n, 5);
    K = MatrixXd::Identity(n, n) + X * X.transpose();
    y = test::random_vector(n, random);
  }
};

GrowingCholesky factor_of(const Equations& e, const std::vector<Index>& rows) {
  GrowingCholesky factor(static_cast<Index>(rows.size()));
  factor.lower() = e.K(rows, rows);
  EXPECT_TRUE(factor.factorise(e.y(rows)));
  return factor;
}

std::vector<Index> rows_to(Index end, Index first = 0) {
  std::vector<Index> rows;
  for (Index row = first; row < end; ++row) rows.push_back(row);
  return rows;
}

// L, z and the solution are those of the rows, as Eigen has them; κ(K) is below 1e3
void expect_factor_of(const Equations& e, const std::vector<Index>& rows, const GrowingCholesky& factor) {
  ASSERT_EQ(factor.size(), static_cast<Index>(rows.size()));
  const Eigen::LLT<MatrixXd> expected(e.K(rows, rows));
  const MatrixXd L = factor.L().triangularView<Eigen::Lower>();
  EXPECT_LE((L - MatrixXd(expected.matrixL())).norm(), 1e-12 * L.norm());
  const VectorXd y = e.y(rows);
  EXPECT_LE((factor.z() - expected.matrixL().solve(y)).norm(), 1e-12 * (1 + y.norm()));
  EXPECT_LE((factor.solve() - expected.solve(y)).norm(), 1e-12 * (1 + y.norm()));
}

[[nodiscard]] bool append(const Equations& e, const std::vector<Index>& rows, const std::vector<Index>& more,
                          GrowingCholesky& factor) {
  return factor.append(e.K(rows, more), e.K(more, more), e.y(more));
}

TEST(GrowingCholeskyTest, AppendedRowsAreFactoredWithTheOthers) {
  const Equations e(40);
  for (Index n : {0, 1, 7, 30}) {
    for (Index m : {0, 1, 2, 10}) {
      GrowingCholesky factor = factor_of(e, rows_to(n));
      ASSERT_TRUE(append(e, rows_to(n), rows_to(n + m, n), factor));
      expect_factor_of(e, rows_to(n + m), factor);
    }
  }
}

TEST(GrowingCholeskyTest, WhatIsLeftOfErasedRowsIsFactored) {
  const Equations e(30);
  for (const std::vector<Index>& gone :
       {std::vector<Index>{}, {0}, {29}, {13}, {0, 1}, {0, 15}, {3, 4, 28}, {0, 10, 20, 29}, rows_to(29), rows_to(30)}) {
    GrowingCholesky factor = factor_of(e, rows_to(30));
    factor.erase(gone);
    std::vector<Index> kept;
    for (Index row = 0; row < 30; ++row) {
      if (std::find(gone.begin(), gone.end(), row) == gone.end()) kept.push_back(row);
    }
    expect_factor_of(e, kept, factor);
  }
}

TEST(GrowingCholeskyTest, RowsComeAndGoForLong) {
  const Equations e(60);
  std::vector<Index> rows = rows_to(20);
  GrowingCholesky factor = factor_of(e, rows);
  RandomStream random(growing_cholesky_seed, 1);
  Index next = 20;
  for (int step = 0; step < 400; ++step) {
    const Index gone = static_cast<Index>(random.uniform() * static_cast<double>(rows.size()));
    factor.erase({gone});
    rows.erase(rows.begin() + gone);
    while (std::find(rows.begin(), rows.end(), next) != rows.end()) next = (next + 1) % 60;
    ASSERT_TRUE(append(e, rows, {next}, factor));
    rows.push_back(next);
  }
  expect_factor_of(e, rows, factor);
}

TEST(GrowingCholeskyTest, DrawsMemoryOnlyWhenItIsFull) {
  const Equations e(200);
  GrowingCholesky factor = factor_of(e, rows_to(10));
  EXPECT_EQ(factor.capacity(), 10 + 64);
  const double* where = factor.lower().data();
  for (Index n = 10; n < 74; ++n) ASSERT_TRUE(append(e, rows_to(n), {n}, factor));
  factor.erase({0, 5});
  EXPECT_EQ(factor.lower().data(), where);
  factor = factor_of(e, rows_to(74));
  ASSERT_TRUE(append(e, rows_to(74), rows_to(200, 74), factor));
  EXPECT_EQ(factor.capacity(), 74 + 64 + (74 + 64) / 2);
  expect_factor_of(e, rows_to(200), factor);
  EXPECT_EQ(GrowingCholesky(800).capacity(), 900);
}

TEST(GrowingCholeskyTest, ACopyIsAFactorOfItsOwn) {
  const Equations e(20);
  GrowingCholesky factor = factor_of(e, rows_to(20));
  const GrowingCholesky copy = factor;
  factor.erase({3});
  expect_factor_of(e, rows_to(20), copy);
  EXPECT_EQ(copy.capacity(), factor.capacity());
}

TEST(GrowingCholeskyTest, SaysWhereTheMatrixIsIndefiniteAndStaysAsItWas) {
  Equations e(12);
  GrowingCholesky indefinite(2);
  indefinite.lower() << 1, 2, 2, 1;
  EXPECT_FALSE(indefinite.factorise(VectorXd::Ones(2)));
  GrowingCholesky factor = factor_of(e, rows_to(10));
  const Equations good = e;
  e.K(11, 11) = -1;
  EXPECT_FALSE(append(e, rows_to(10), {10, 11}, factor));
  expect_factor_of(good, rows_to(10), factor);
  ASSERT_TRUE(append(good, rows_to(10), {10, 11}, factor));
  expect_factor_of(good, rows_to(12), factor);
}

}  // namespace
}  // namespace gp2
