#include "training/random.hpp"

#include <algorithm>

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

TEST(RandomStreamTest, APermutationHoldsEachNumberOnce) {
  RandomStream random(3);
  std::vector<int> order = random.permutation(50);
  EXPECT_FALSE(std::is_sorted(order.begin(), order.end()));
  std::sort(order.begin(), order.end());
  for (int k = 0; k < 50; ++k) EXPECT_EQ(order[static_cast<std::size_t>(k)], k);
}

}  // namespace
}  // namespace gp2
