#include "training/evolution.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>

#include <gtest/gtest.h>

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// The lowest value that so many generations find.
double lowest(const std::function<double(const VectorXd&)>& f, const VectorXd& start, int n_generations, std::uint64_t seed) {
  EvolutionStrategy strategy(start, 0.5, seed);
  double best = f(start);
  for (int g = 0; g < n_generations; ++g) {
    const MatrixXd points = strategy.draw();
    VectorXd values(points.cols());
    for (Index k = 0; k < points.cols(); ++k) values[k] = f(points.col(k));
    std::vector<int> ranking(static_cast<std::size_t>(points.cols()));
    std::iota(ranking.begin(), ranking.end(), 0);
    std::sort(ranking.begin(), ranking.end(), [&](int k, int l) { return values[k] < values[l]; });
    strategy.learn(ranking);
    best = std::min(best, values.minCoeff());
  }
  return best;
}

TEST(EvolutionStrategy, FindsTheMinimumOfAnEllipsoidWhoseAxesDifferAThousandfold) {
  const auto ellipsoid = [](const VectorXd& x) {
    double sum = 0;
    for (Index i = 0; i < x.size(); ++i)
      sum += std::pow(1e6, static_cast<double>(i) / static_cast<double>(x.size() - 1)) * x[i] * x[i];
    return sum;
  };
  for (const std::uint64_t seed : {1U, 2U, 3U}) EXPECT_LT(lowest(ellipsoid, VectorXd::Ones(8), 600, seed), 1e-10) << seed;
  EXPECT_GT(lowest(ellipsoid, VectorXd::Ones(8), 20, 1), 1e-3) << "no task at all";
}

TEST(EvolutionStrategy, FollowsACurvedValley) {
  const auto rosenbrock = [](const VectorXd& x) {
    double sum = 0;
    for (Index i = 0; i + 1 < x.size(); ++i) sum += 100 * std::pow(x[i + 1] - x[i] * x[i], 2) + std::pow(1 - x[i], 2);
    return sum;
  };
  EXPECT_LT(lowest(rosenbrock, VectorXd::Zero(6), 600, 4), 1e-10);
}

TEST(EvolutionStrategy, OnlyRanksAndIsTheSameForTheSameSeed) {
  const auto sphere = [](const VectorXd& x) { return x.squaredNorm(); };
  const auto steeper = [&](const VectorXd& x) { return std::exp(sphere(x)); };  // the same order
  const auto best_of = [](const auto& f, std::uint64_t seed) { return lowest(f, VectorXd::Ones(5), 40, seed); };
  EXPECT_EQ(std::exp(best_of(sphere, 7)), best_of(steeper, 7));
  EXPECT_NE(best_of(sphere, 7), best_of(sphere, 8));
}

}  // namespace
}  // namespace gp2
