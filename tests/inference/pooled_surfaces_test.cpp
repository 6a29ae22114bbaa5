#include <gtest/gtest.h>

#include "inference/pooled_surfaces.hpp"

namespace gp2::test {
namespace {

/// Mean of the difference between two columns over the seeds, and its standard error.
struct Paired {
  double mean = 0, standard_error = 0;

  Paired(const std::vector<PooledScore>& scores, double PooledScore::*left, double PooledScore::*right) {
    const double n = static_cast<double>(scores.size());
    double squares = 0;
    for (const PooledScore& score : scores) {
      const double difference = score.*left - score.*right;
      mean += difference / n;
      squares += difference * difference / n;
    }
    standard_error = std::sqrt((squares - mean * mean) / (n - 1));
  }
};

// As many points of the first surface, whose slopes vary most, are as good as the pool: "no worse" is meant within what twenty
// seeds can tell.
TEST(PooledSurfacesOverTwentySeeds, AreNoWorseThanAsManyPointsOfEitherAndBetterThanHalfAsMany) {
  for (const int n : {40, 100}) {
    std::vector<PooledScore> scores;
    PooledScore sum;
    for (std::uint64_t seed = 1; seed <= 20; ++seed) sum += scores.emplace_back(score_pooling(n, seed));
    SCOPED_TRACE(
        fmt::format("N = {}: mean rms error: pooled {:.4f}, first {:.4f}, second {:.4f}, half of the first {:.4f}, half of "
                    "the second {:.4f}",
                    n, sum.pooled / 20, sum.first / 20, sum.second / 20, sum.half_first / 20, sum.half_second / 20));
    for (double PooledScore::*full : {&PooledScore::first, &PooledScore::second}) {
      const Paired difference(scores, &PooledScore::pooled, full);
      EXPECT_LE(difference.mean, 2 * difference.standard_error);
    }
    for (double PooledScore::*half : {&PooledScore::half_first, &PooledScore::half_second}) {
      const Paired difference(scores, &PooledScore::pooled, half);
      EXPECT_LT(difference.mean, -2 * difference.standard_error);
    }
  }
}

}  // namespace
}  // namespace gp2::test
