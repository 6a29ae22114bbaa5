#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

// The discrepancy latent from the command line.
namespace gp2::test {
namespace {

using testing::HasSubstr;

class DiscrepancyOption : public testing::Test {
 protected:
  void SetUp() override { desk.done("gp2 generate models/surface.toml --n 25 --seed 1 -o train.csv"); }
  void fit(const std::string& options = "") const {
    desk.done("gp2 fit models/surface.toml --data train.csv --restarts 1 --max-iterations 8 -o fit.json " + options);
  }
  [[nodiscard]] bool fit_has_one() const { return desk.json("fit.json")["prior"].contains("discrepancy"); }

  Desk desk;
};

TEST_F(DiscrepancyOption, IsOnByDefaultAndLeftOutWhereAskedTo) {
  fit();
  EXPECT_TRUE(fit_has_one());
  const auto stddevs = desk.json("fit.json")["prior"]["discrepancy"]["stddev"].get<std::vector<double>>();
  for (const double stddev : stddevs) EXPECT_NEAR(stddev, 0.1, 1e-6);  // the noise
  for (const char* options : {"--discrepancy none", "--hyperprior none", "--protocol paper", "--baseline se"}) {
    fit(options);
    EXPECT_FALSE(fit_has_one()) << options;
  }
  const auto refusal = [&](const std::string& options) {
    const Outcome refused = desk.run("gp2 fit models/surface.toml --data train.csv " + options + " -o no.json");
    EXPECT_EQ(refused.status, 2) << options;
    return refused.err;
  };
  EXPECT_THAT(refusal("--protocol paper --discrepancy default"),
              testing::HasSubstr("--protocol paper has no discrepancy: leave out --discrepancy default"));
  EXPECT_THAT(refusal("--hyperprior none --discrepancy default"), testing::HasSubstr("--hyperprior none has no discrepancy"));
  EXPECT_THAT(refusal("--baseline se --discrepancy default"), testing::HasSubstr("--baseline se has no discrepancy"));
  EXPECT_THAT(refusal("--protocol paper --hyperprior default"),
              testing::HasSubstr("--protocol paper has no hyper-priors: leave out --hyperprior default"));
  EXPECT_THAT(refusal("--baseline se --hyperprior default"), testing::HasSubstr("--baseline se has no hyper-priors"));
  const Outcome outcome = desk.run("gp2 fit models/surface.toml --data train.csv --discrepancy some -o no.json");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_TRUE(outcome.said("--discrepancy")) << outcome.err;
}

TEST_F(DiscrepancyOption, IsALatentThatCanBePredictedAlone) {
  fit();
  desk.done("gp2 predict fit.json --states train.csv --view unconstrained --latent discrepancy --cov std -o small.csv");
  desk.done("gp2 predict fit.json --states train.csv --view unconstrained --latent 'unconstrained acceleration' -o large.csv");
  desk.done("gp2 predict fit.json --states train.csv --view unconstrained -o both.csv");
  const CsvTable small = desk.table("small.csv"), large = desk.table("large.csv"), both = desk.table("both.csv");
  const int alone = small.find("abar_q1@discrepancy"), stddev = small.find("abar_q1@discrepancy_std"),
            main = large.find("abar_q1@unconstrained acceleration"), sum = both.find("abar_q1");
  ASSERT_TRUE(alone >= 0 && stddev >= 0 && main >= 0 && sum >= 0);
  double largest = 0;
  for (int i = 0; i < both.n_rows(); ++i) {
    EXPECT_NEAR(small.number(i, alone) + large.number(i, main), both.number(i, sum), 1e-12);
    // data only ever lower a standard deviation
    EXPECT_GT(small.number(i, stddev), 0);
    EXPECT_LE(small.number(i, stddev), 0.5 * 0.1);
    largest = std::max(largest, std::abs(small.number(i, alone)));
  }
  EXPECT_GT(largest, 0);
  EXPECT_LT(largest, 3 * 0.5 * 0.1) << "it hardly moves the mean";

  fit("--discrepancy none");
  const Outcome outcome = desk.run("gp2 predict fit.json --states train.csv --latent discrepancy -o no.csv");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("--latent: no latent is called 'discrepancy'; there are: unconstrained acceleration"));
}

TEST_F(DiscrepancyOption, StandsUnderEveryPooledSystem) {
  desk.write("other.toml", replaced(desk.read("models/surface.toml"), "m  = 3.0", "m  = 4.0"));
  desk.done("gp2 generate other.toml --n 15 --seed 2 -o other.csv");
  fit("--data other.csv@other.toml");
  EXPECT_TRUE(fit_has_one());
  desk.done("gp2 predict fit.json --system other.toml --states other.csv --latent discrepancy -o there.csv");
  EXPECT_GE(desk.table("there.csv").find("ddq1@discrepancy"), 0);
}

}  // namespace
}  // namespace gp2::test
