#include "base/simd.hpp"

#include <cmath>

#include <gtest/gtest.h>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t seed = 5150;

// every instruction set that runs here
class SimdLoops : public testing::TestWithParam<int> {
 protected:
  [[nodiscard]] static const simd::Target& target() {
    int count = 0;
    return *simd::targets(count)[GetParam()];
  }
};
INSTANTIATE_TEST_SUITE_P(Each, SimdLoops, testing::Range(0, [] {
                           int count = 0;
                           simd::targets(count);
                           return count;
                         }()));

TEST_P(SimdLoops, ExponentialsAreRightToAUnitInTheLastPlace) {
  const Index n = 1 << 16;
  VectorXd x(n);
  for (Index i = 0; i < n; ++i) x[i] = -708 + 1417 * static_cast<double>(i) / static_cast<double>(n);
  VectorXd y = x;
  target().loops.exponential(n, y.data());
  for (Index i = 0; i < n; ++i) {
    const long double expected = std::exp(static_cast<long double>(x[i]));
    ASSERT_NEAR(static_cast<double>(y[i] / expected - 1), 0, test::eps) << x[i];
  }
}

TEST_P(SimdLoops, ExponentialsOfZeroAreOneAndOfVeryLittleNothing) {
  VectorXd x = VectorXd::Zero(simd::lanes<double>);
  x[1] = -709;
  x[2] = -1e308;
  x[3] = -std::numeric_limits<double>::infinity();
  x[4] = -1e-300;
  target().loops.exponential(x.size(), x.data());
  EXPECT_EQ(x[0], 1);
  EXPECT_EQ(x[1], 0);
  EXPECT_EQ(x[2], 0);
  EXPECT_EQ(x[3], 0);
  EXPECT_EQ(x[4], 1);
}

TEST_P(SimdLoops, ExponentialsOfNaNAreNaN) {
  VectorXd x = VectorXd::Constant(simd::lanes<double>, std::numeric_limits<double>::quiet_NaN());
  VectorXd r2 = x;
  target().loops.squared_exponential(x.size(), 1, x.data(), x.size(), x.data(), r2.data());
  target().loops.exponential(x.size(), x.data());
  // the kernel of a state that is not a number must not pass for one
  EXPECT_TRUE(r2.array().isNaN().all() && x.array().isNaN().all()) << r2.transpose() << '\n' << x.transpose();
}

TEST_P(SimdLoops, SinglePrecisionExponentialsAreRightToAUnitInTheLastPlace) {
  const Index n = 1 << 14;
  Eigen::VectorXf x(n);
  for (Index i = 0; i < n; ++i) x[i] = -87 + 174 * static_cast<float>(i) / static_cast<float>(n);
  Eigen::VectorXf y = x;
  target().loops_single.exponential(n, y.data());
  for (Index i = 0; i < n; ++i) {
    ASSERT_NEAR(y[i] / std::exp(static_cast<double>(x[i])) - 1, 0, std::numeric_limits<float>::epsilon()) << x[i];
  }
}

// a problem of n points, D features and m columns of weights, in numbers of order one
struct Case {
  Index n, D, m;
  MatrixXd x, B;
  VectorXd p, w, b;

  Case(Index n_points, Index n_features, Index n_columns)
      : n(simd::padded(n_points)), D(n_features), m(n_columns), x(n + 8, D), B(n + 16, m), p(D), w(n), b(m) {
    RandomStream random(seed, static_cast<std::uint64_t>(n_points));
    for (double& entry : x.reshaped()) entry = random.normal();
    for (double& entry : B.reshaped()) entry = random.normal();
    for (VectorXd* v : {&p, &w, &b}) {
      for (double& entry : *v) entry = random.normal();
    }
  }
  [[nodiscard]] auto points() const { return x.topRows(n); }
  [[nodiscard]] auto columns() const { return B.topRows(n); }
};

const std::vector<std::pair<Index, Index>> sizes = {{8, 1}, {16, 2}, {40, 3}, {64, 4}, {104, 7}};  // points, columns

TEST_P(SimdLoops, DistancesAndSumsAreWhatTheirFormulasSay) {
  const simd::Loops<double>& loops = target().loops;
  for (const auto& [n_points, n_columns] : sizes) {
    for (const Index n_features : {Index{1}, Index{9}}) {
      SCOPED_TRACE(fmt::format("{} points, {} columns, {} features", n_points, n_columns, n_features));
      const Case c(n_points, n_features, n_columns);
      const MatrixXd delta = c.points().rowwise() - c.p.transpose();
      const VectorXd r2 = delta.rowwise().squaredNorm();
      // each sum of n products is off by n ε of the sum of their sizes
      const auto tolerance = [](const auto& terms) {
        return static_cast<double>(terms.size() + 4) * test::eps * terms.cwiseAbs().sum();
      };

      VectorXd out(c.n);
      loops.squared_distance(c.n, c.D, c.x.data(), c.x.rows(), c.p.data(), out.data());
      for (Index i = 0; i < c.n; ++i) EXPECT_NEAR(out[i], r2[i], static_cast<double>(c.D + 2) * test::eps * r2[i]);
      loops.squared_exponential(c.n, c.D, c.x.data(), c.x.rows(), c.p.data(), out.data());
      for (Index i = 0; i < c.n; ++i) {
        const double expected = std::exp(-0.5 * r2[i]);
        EXPECT_NEAR(out[i], expected, expected * (2 + static_cast<double>(c.D + 2) * r2[i]) * test::eps);
      }

      VectorXd sums(c.m);
      loops.weighted_sums(c.n, c.m, c.w.data(), c.B.data(), c.B.rows(), sums.data());
      for (Index l = 0; l < c.m; ++l) {
        const VectorXd terms = c.w.cwiseProduct(c.columns().col(l));
        EXPECT_NEAR(sums[l], terms.sum(), tolerance(terms));
      }
      VectorXd differences(c.D);
      loops.weighted_differences(c.n, c.D, c.w.data(), c.x.data(), c.x.rows(), c.p.data(), differences.data());
      MatrixXd products(c.D, c.m);
      loops.difference_products(c.n, c.D, c.m, c.w.data(), c.B.data(), c.B.rows(), c.x.data(), c.x.rows(), c.p.data(),
                                products.data());
      for (Index l = 0; l < c.m; ++l) {
        for (Index d = 0; d < c.D; ++d) {
          const VectorXd terms = c.w.cwiseProduct(c.columns().col(l)).cwiseProduct(delta.col(d));
          EXPECT_NEAR(products(d, l), terms.sum(), tolerance(terms));
        }
      }
      MatrixXd squares = MatrixXd::Ones(simd::lanes<double>, c.D);
      loops.add_weighted_squares(c.n, c.D, c.w.data(), c.x.data(), c.x.rows(), c.p.data(), squares.data());
      for (Index d = 0; d < c.D; ++d) {
        const VectorXd terms = c.w.cwiseProduct(delta.col(d));
        EXPECT_NEAR(differences[d], terms.sum(), tolerance(terms));
        const VectorXd square_terms = terms.cwiseProduct(delta.col(d));
        EXPECT_NEAR(squares.col(d).sum(), simd::lanes<double> + square_terms.sum(),
                    tolerance(square_terms) + test::eps * simd::lanes<double>);
      }
    }
  }
}

TEST_P(SimdLoops, ContractionsAreWhatTheirFormulasSay) {
  const simd::Loops<double>& loops = target().loops;
  for (const auto& [n_points, n_columns] : sizes) {
    SCOPED_TRACE(fmt::format("{} points, {} columns", n_points, n_columns));
    const Case c(n_points, 2, n_columns);
    const VectorXd k = c.points().col(0), s = c.points().col(1);
    const VectorXd products = c.columns() * c.b;
    const VectorXd sizes_of_products = c.columns().cwiseAbs() * c.b.cwiseAbs();
    const double roundings = static_cast<double>(c.m + 4) * test::eps;

    VectorXd out = c.w;
    loops.add_scaled_products(c.n, c.m, k.data(), c.B.data(), c.B.rows(), c.b.data(), out.data());
    VectorXd contracted = s, h = c.w;
    MatrixXd sums = MatrixXd::Ones(simd::lanes<double>, c.m);
    loops.contract(c.n, c.m, contracted.data(), k.data(), c.B.data(), c.B.rows(), c.b.data(), h.data(), sums.data());
    for (Index i = 0; i < c.n; ++i) {
      EXPECT_NEAR(out[i], c.w[i] + k[i] * products[i], roundings * (std::abs(c.w[i]) + std::abs(k[i]) * sizes_of_products[i]));
      EXPECT_NEAR(h[i], c.w[i] + s[i] * products[i], roundings * (std::abs(c.w[i]) + std::abs(s[i]) * sizes_of_products[i]));
      EXPECT_EQ(contracted[i], s[i] * k[i]);
    }
    for (Index l = 0; l < c.m; ++l) {
      const VectorXd terms = c.b[l] * contracted.cwiseProduct(c.columns().col(l));
      EXPECT_NEAR(sums.col(l).sum(), simd::lanes<double> + terms.sum(),
                  static_cast<double>(c.n + 16) * test::eps * (terms.cwiseAbs().sum() + simd::lanes<double>));
    }
  }
}

TEST_P(SimdLoops, ATriangleIsSolvedForAnyNumberOfRowsAndColumns) {
  RandomStream random(seed);
  for (const Index n : {1, 2, 7, 8, 33, 64}) {
    for (const Index m : {1, 3, 8, 31, 32, 75}) {
      for (const bool reversed : {false, true}) {
        SCOPED_TRACE(fmt::format("{} rows, {} columns", n, m));
        Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> L(n, n);
        MatrixXd B(n + 2, m);  // the last two rows are not of it
        for (double& one : L.reshaped()) one = random.normal() / static_cast<double>(n);
        for (double& one : B.reshaped()) one = random.normal();
        L.diagonal().array() += 2;
        const MatrixXd before = B, T = L.triangularView<Eigen::Lower>();
        const MatrixXd right = reversed ? MatrixXd(before.topRows(n).colwise().reverse()) : MatrixXd(before.topRows(n));
        L.diagonal() = L.diagonal().cwiseInverse().eval();
        target().loops.solve_triangle(n, L.data(), reversed, m, B.data(), B.rows());
        const MatrixXd X = reversed ? MatrixXd(B.topRows(n).colwise().reverse()) : MatrixXd(B.topRows(n));
        // backward error of a substitution, and of the reciprocals
        const MatrixXd bound = static_cast<double>(n + 4) * test::eps * (T.cwiseAbs() * X.cwiseAbs());
        EXPECT_TRUE(((T * X - right).array().abs() <= bound.array() + 1e-300).all());
        EXPECT_EQ(B.bottomRows(2), before.bottomRows(2));
      }
    }
  }
}

}  // namespace
}  // namespace gp2
