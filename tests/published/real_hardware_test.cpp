#include <gtest/gtest.h>

#include "published/acceptance.hpp"

namespace gp2::test {
namespace {

// Fifty samples of slow swinging, gravity and friction not told, predict fast swinging: the mechanics extrapolate.
TEST(RealHardware, DoublePendulumIsPredictedBeyondTheEnergyItWasSeenAt) {
  if (const auto absent = why_real_is_absent()) GTEST_SKIP() << *absent;
  std::vector<double> errors;
  for (std::uint64_t seed = 0; seed < 10; ++seed) {
    FitProblemOptions options;
    options.observe = {"ddq3", "ddq6"};
    options.base = Latent::Base::force;
    options.estimate_noise = true;
    options.max_points = 50;
    options.seed = seed;
    const Score result = score(model("models/double_pendulum.toml"), real_file("double_pendulum/train.csv"),
                               real_file("double_pendulum/test.csv"), options, 5);
    errors.push_back(result.evaluation.nrmse);
    EXPECT_LE(result.evaluation.max_constraint_error, 1e-12) << "seed " << seed;
  }
  RecordProperty("median", fmt::format("{:.5f}", median(errors)));
  RecordProperty("worst", fmt::format("{:.5f}", worst(errors)));
  EXPECT_LE(median(errors), 0.012);
  EXPECT_LE(worst(errors), 0.025);
}

}  // namespace
}  // namespace gp2::test
