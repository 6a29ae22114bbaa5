#include "base/random.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include <gtest/gtest.h>

namespace gp2 {
namespace {

TEST(RandomStreamTest, SameSeedAndStreamGiveTheSameNumbersAndOthersDoNot) {
  RandomStream a(7, 2), b(7, 2), other_stream(7, 3), other_seed(8, 2);
  const double first = a.uniform();
  EXPECT_EQ(first, b.uniform());
  EXPECT_NE(first, other_stream.uniform());
  EXPECT_NE(first, other_seed.uniform());
}

TEST(RandomStreamTest, UniformAndNormalNumbersHaveTheirMoments) {
  RandomStream random(1);
  const int n = 100000;
  double sum = 0, normal_sum = 0, normal_squares = 0;
  for (int k = 0; k < n; ++k) {
    const double u = random.uniform(), z = random.normal();
    ASSERT_TRUE(u >= 0 && u < 1);
    sum += u;
    normal_sum += z;
    normal_squares += z * z;
  }
  // five standard errors: 1/√12, 1 and √2 over √n
  const double root_n = std::sqrt(n);
  EXPECT_NEAR(sum / n, 0.5, 5 / std::sqrt(12) / root_n);
  EXPECT_NEAR(normal_sum / n, 0, 5 / root_n);
  EXPECT_NEAR(normal_squares / n, 1, 5 * std::sqrt(2) / root_n);
}

// mean and variance of n draws within five standard errors; fourth_moment: about the mean
template <typename Draw>
void expect_moments(const Draw& draw, double mean, double variance, double fourth_moment) {
  const int n = 100000;
  double sum = 0, squares = 0;
  for (int k = 0; k < n; ++k) {
    const double x = draw();
    ASSERT_GE(x, 0);
    sum += x - mean;
    squares += (x - mean) * (x - mean);
  }
  EXPECT_NEAR(sum / n, 0, 5 * std::sqrt(variance / n));
  EXPECT_NEAR(squares / n, variance, 5 * std::sqrt((fourth_moment - variance * variance) / n));
}

TEST(RandomStreamTest, GammaNumbersHaveTheirMoments) {
  RandomStream random(4);
  for (const double shape : {0.2, 1.0, 1.5, 2.5, 40.0}) {
    SCOPED_TRACE(shape);
    expect_moments([&] { return random.gamma(shape); }, shape, shape, 3 * shape * shape + 6 * shape);
  }
}

TEST(RandomStreamTest, GammaNumbersOfTinyShapesUnderflowToZeroAtWorst) {
  RandomStream random(5);
  for (int k = 0; k < 1000; ++k) {
    const double x = random.gamma(1e-3);
    EXPECT_TRUE(x >= 0 && std::isfinite(x));
  }
}

TEST(RandomStreamTest, PoissonAndBinomialNumbersHaveTheirMoments) {
  RandomStream random(6);
  for (const double mean : {0.0, 0.3, 15.0, 17.0, 400.0, 1e9}) {
    SCOPED_TRACE(mean);
    expect_moments([&] { return random.poisson(mean); }, mean, mean, 3 * mean * mean + mean);
  }
  for (const double n : {1.0, 16.0, 17.0, 1000.0}) {
    for (const double p : {0.0, 0.3, 0.9, 1.0}) {
      SCOPED_TRACE(n);
      const double variance = n * p * (1 - p);
      expect_moments([&] { return random.binomial(n, p); }, n * p, variance,
                     3 * variance * variance + variance * (1 - 6 * p * (1 - p)));
    }
  }
}

TEST(RandomStreamTest, PoissonNumbersAreAsFrequentAsTheyShould) {
  RandomStream random(8);
  for (const double mean : {2.0, 30.0}) {
    const int n = 100000;
    std::vector<int> counts(200);
    for (int k = 0; k < n; ++k) {
      const double x = random.poisson(mean);
      ASSERT_EQ(x, std::floor(x));
      ++counts.at(static_cast<std::size_t>(x));
    }
    double probability = std::exp(-mean);
    for (std::size_t k = 0; k < counts.size(); ++k) {
      EXPECT_NEAR(counts[k], n * probability, 5 * std::sqrt(n * probability * (1 - probability)) + 1) << k << ", mean " << mean;
      probability *= mean / static_cast<double>(k + 1);
    }
  }
}

TEST(RandomStreamTest, APermutationHoldsEachNumberOnce) {
  RandomStream random(3);
  std::vector<int> order = random.permutation(50);
  EXPECT_FALSE(std::is_sorted(order.begin(), order.end()));
  std::sort(order.begin(), order.end());
  for (int k = 0; k < 50; ++k) EXPECT_EQ(order[static_cast<std::size_t>(k)], k);
}

}  // namespace
}  // namespace gp2
