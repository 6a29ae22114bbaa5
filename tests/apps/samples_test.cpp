#include <cmath>
#include <string>
#include <vector>

#include <fmt/core.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::ElementsAreArray;
using testing::HasSubstr;

class PredictSamples : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/surface.toml --n 30 --seed 1 -o train.csv");
    desk.done("gp2 generate models/surface.toml --n 12 --seed 2 --noise-std 0 -o states.csv");
    desk.done("gp2 fit models/surface.toml --data train.csv --max-iterations 0 -o fit.json");
  }
  CsvTable predict(const std::string& options) const {
    desk.done("gp2 predict fit.json --states states.csv " + options + " -o out.csv");
    return desk.table("out.csv");
  }
  static std::vector<double> column(const CsvTable& table, const std::string& name) {
    std::vector<double> numbers;
    for (int i = 0; i < table.n_rows(); ++i) numbers.push_back(table.number(i, table.find(name)));
    return numbers;
  }

  Desk desk;
};

TEST_F(PredictSamples, AddAColumnForEachOutputAndSample) {
  const CsvTable table = predict("--cov std --samples 2");
  std::vector<std::string> expected = {"ddq1", "ddq2", "ddq3", "ddq1_std", "ddq2_std", "ddq3_std"};
  for (int s = 1; s <= 2; ++s) {
    for (int k = 1; k <= 3; ++k) expected.push_back(fmt::format("ddq{}_sample{}", k, s));
  }
  expected.emplace_back("distance_from_data");
  const std::vector<std::string> added(table.header().end() - 13, table.header().end());
  EXPECT_THAT(added, ElementsAreArray(expected));
  // the draws stand about the mean, some standard deviations off at most, and are not the mean
  double largest = 0;
  for (int k = 1; k <= 3; ++k) {
    const auto mean = column(table, fmt::format("ddq{}", k)), stddev = column(table, fmt::format("ddq{}_std", k));
    for (int s = 1; s <= 2; ++s) {
      const auto sample = column(table, fmt::format("ddq{}_sample{}", k, s));
      for (std::size_t i = 0; i < mean.size(); ++i) {
        EXPECT_LE(std::abs(sample[i] - mean[i]), 6 * stddev[i]);
        largest = std::max(largest, std::abs(sample[i] - mean[i]) / stddev[i]);
      }
    }
  }
  EXPECT_GT(largest, 1);
}

TEST_F(PredictSamples, LeaveThePredictionAsItIs) {
  const CsvTable without = predict("--cov full"), with = predict("--cov full --samples 3");
  for (const std::string& name : without.header()) EXPECT_EQ(column(without, name), column(with, name)) << name;
}

TEST_F(PredictSamples, DependOnTheSeedAlone) {
  const CsvTable first = predict("--samples 2 --seed 5"), again = predict("--samples 2 --seed 5");
  const CsvTable other = predict("--samples 2 --seed 6");
  EXPECT_EQ(column(first, "ddq2_sample2"), column(again, "ddq2_sample2"));
  EXPECT_NE(column(first, "ddq2_sample2"), column(other, "ddq2_sample2"));
}

TEST_F(PredictSamples, ComeFromThePriorWhenUnconditioned) {
  // mean zero of ā: what is left of ddq is L b, and more uncertain
  const CsvTable prior = predict("--view unconstrained --cov std --samples 1 --unconditioned");
  const CsvTable posterior = predict("--view unconstrained --cov std --samples 1");
  for (const double mean : column(prior, "abar_q1")) EXPECT_EQ(mean, 0);
  const auto prior_std = column(prior, "abar_q1_std"), posterior_std = column(posterior, "abar_q1_std");
  for (std::size_t i = 0; i < prior_std.size(); ++i) EXPECT_LT(posterior_std[i], prior_std[i]);
  EXPECT_NE(column(prior, "abar_q1_sample1"), column(posterior, "abar_q1_sample1"));
}

TEST_F(PredictSamples, RefuseWrongNumbers) {
  const auto refusal = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 predict fit.json --states states.csv " + options + " -o none.csv");
    EXPECT_EQ(outcome.status, 2);
    EXPECT_FALSE(desk.has("none.csv"));
    return outcome.err;
  };
  EXPECT_THAT(refusal("--samples 0"), HasSubstr("--samples: must be at least 1, got 0"));
  EXPECT_THAT(refusal("--samples -3"), HasSubstr("--samples: must be at least 1, got -3"));
  EXPECT_THAT(refusal("--samples 2 --seed -1"), HasSubstr("--seed"));
  EXPECT_THAT(refusal("--seed 1"), HasSubstr("--seed requires --samples"));
}

}  // namespace
}  // namespace gp2::test
