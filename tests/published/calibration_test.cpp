#include <ostream>

#include <gtest/gtest.h>

#include "published/acceptance.hpp"

// How often the truth lies within the 95 % intervals of the default protocol.
namespace gp2::test {
namespace {

struct Calibrated {
  std::string system;
  double floor_zero, floor_force;  // of the mean over the published runs, without and with the force as prior mean
};

void PrintTo(const Calibrated& one, std::ostream* out) { *out << one.system; }

class Calibration : public testing::TestWithParam<Calibrated> {
 protected:
  void SetUp() override {
    if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  }

  /// Share of noise-free grid points inside the intervals, mean over the published runs.
  static double coverage(Prior::Mean mean_of_prior) {
    FitProblemOptions options;
    options.mean = mean_of_prior;
    options.estimate = std::vector<std::string>{};
    const std::string& system = GetParam().system;
    std::vector<double> coverages;
    for (int run = 0; run < 5; ++run) {
      const Score result = score(model(model_of(system)), reference_file(fmt::format("train/{}_run{}.csv", system, run)),
                                 reference_file("grid/" + system + "_grid.csv"), options, 5);
      coverages.push_back(result.evaluation.coverage95_latent);
    }
    return mean(coverages);
  }
};

// Measured, zero and force: surface 0.976 and 0.959, unicycle 0.846 and 0.981, Duffing 0.985 and 0.973. The unicycle without a
// prior mean misses an effect of its turning rate that is as large as the noise, which is the one cell below 0.90; the default prior
// has 0.875 there.
TEST_P(Calibration, TheTruthIsWithinTheIntervalsAsOftenAsTheySay) {
  const double zero = coverage(Prior::Mean::zero), force = coverage(Prior::Mean::force);
  RecordProperty("zero", fmt::format("{:.4f}", zero));
  RecordProperty("force", fmt::format("{:.4f}", force));
  EXPECT_GE((zero + force) / 2, 0.90);
  EXPECT_LE((zero + force) / 2, 0.99);
  EXPECT_GE(zero, GetParam().floor_zero);
  EXPECT_GE(force, GetParam().floor_force);
}

INSTANTIATE_TEST_SUITE_P(OfEverySystem, Calibration,
                         testing::Values(Calibrated{"surface", 0.90, 0.90}, Calibrated{"unicycle", 0.80, 0.90},
                                         Calibrated{"duffing", 0.90, 0.90}),
                         [](const auto& instance) { return instance.param.system; });

}  // namespace
}  // namespace gp2::test
