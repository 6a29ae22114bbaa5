#include <ostream>

#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "published/acceptance.hpp"

// The default protocol with known parameters: errors far below those of the paper's box, and no bad optimum among many data sets.
namespace gp2::test {
namespace {

struct Promise {
  std::string system;
  Prior::Mean mean;
  double error;            // rmse_normalised, of the mean over published runs and of the median over new data sets
  double published_worst;  // of a published run; 0: not promised
};

void PrintTo(const Promise& one, std::ostream* out) { *out << one.system << " within " << one.error; }

std::string promise_name(const testing::TestParamInfo<Promise>& info) {
  return info.param.system + (info.param.mean == Prior::Mean::force ? "_mean_force" : "_mean_zero");
}

class DefaultProtocol : public testing::TestWithParam<Promise> {
 protected:
  void SetUp() override {
    if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  }

  /// rmse_normalised on the published grid.
  static double error_on_grid(const std::filesystem::path& train) {
    const Promise& promise = GetParam();
    FitProblemOptions options;
    options.mean = promise.mean;
    options.estimate = std::vector<std::string>{};
    const Score result =
        score(model(model_of(promise.system)), train, reference_file("grid/" + promise.system + "_grid.csv"), options, 5);
    EXPECT_LE(result.evaluation.max_constraint_error, published_system(promise.system).constraint_error) << train;
    return result.evaluation.rmse_normalised;
  }
};

TEST_P(DefaultProtocol, KeepsItsErrorOnThePublishedRuns) {
  std::vector<double> errors;
  for (int run = 0; run < 5; ++run) {
    errors.push_back(error_on_grid(reference_file(fmt::format("train/{}_run{}.csv", GetParam().system, run))));
  }
  EXPECT_LE(mean(errors), GetParam().error);
  if (GetParam().published_worst > 0) {
    EXPECT_LE(worst(errors), GetParam().published_worst);
  }
  RecordProperty("mean", fmt::format("{:.5f}", mean(errors)));
}

TEST_P(DefaultProtocol, HasNoBadOptimumAmongTwentyNewDataSets) {
  const Desk desk;
  std::vector<double> errors;
  for (int seed = 1000; seed < 1020; ++seed) {
    desk.done(fmt::format("gp2 generate {} --n 100 --seed {} -o train.csv", model_of(GetParam().system), seed));
    errors.push_back(error_on_grid(desk / "train.csv"));
  }
  RecordProperty("median", fmt::format("{:.5f}", median(errors)));
  RecordProperty("worst", fmt::format("{:.5f}", worst(errors)));
  EXPECT_LE(median(errors), GetParam().error);
  EXPECT_LE(worst(errors), 2 * GetParam().error);
  // The worst Duffing data set has no samples in a part of the range of q2 that the grid covers, so it is worse than twice the
  // median by right. What seeds draw such a set depends on the generator.
  if (GetParam().system != "duffing") {
    EXPECT_LE(worst(errors), 2 * median(errors));
  }
}

INSTANTIATE_TEST_SUITE_P(
    OfEverySystem, DefaultProtocol,
    testing::Values(Promise{"surface", Prior::Mean::zero, 0.035, 0}, Promise{"unicycle", Prior::Mean::zero, 0.031, 0},
                    Promise{"duffing", Prior::Mean::zero, 0.0008, 0}, Promise{"surface", Prior::Mean::force, 0.025, 0},
                    Promise{"unicycle", Prior::Mean::force, 0.027, 0.035}, Promise{"duffing", Prior::Mean::force, 0.0010, 0}),
    promise_name);

}  // namespace
}  // namespace gp2::test
