#include "gp2/observations.hpp"

#include <functional>
#include <limits>
#include <vector>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

const View view = {View::Quantity::constrained_acceleration, {0, 2}};

// four states of three numbers, two values at each
MatrixXd states() { return MatrixXd::Random(3, 4); }
MatrixXd values() { return (MatrixXd(2, 4) << 1, 2, 3, 4, nan, 6, 7, 8).finished(); }
MatrixXd scale() { return (MatrixXd(2, 4) << 1, 2, 3, 4, 0, 6, 5, 7).finished(); }

Observations of_one_noise() { return {states(), view, values(), Eigen::Vector2d(0.1, 0.2)}; }
Observations of_value_noise() { return {states(), view, values(), Eigen::Vector2d(0.1, 0.2), true, scale()}; }

TEST(Observations, TakesStatesInTheirOrderWithTheirNoise) {
  const Observations all = of_value_noise(), some = all.take({2, 0});
  EXPECT_EQ(some.n_data(), 2);
  EXPECT_EQ(some.states().col(0), all.states().col(2));
  EXPECT_EQ(some.states().col(1), all.states().col(0));
  EXPECT_EQ(some.values()(0, 0), 3);
  EXPECT_EQ(some.noise().scale().col(0), all.noise().scale().col(2));
  EXPECT_EQ(some.noise().stddev(), all.noise().stddev());
  EXPECT_TRUE(some.noise().is_estimated());
  EXPECT_FALSE(of_one_noise().take({1}).noise().has_scale());
}

TEST(Observations, OnePartAndTheOtherAreTheWhole) {
  const Observations all = of_value_noise();
  Observations joined = all.take({0, 1});
  joined.append(all.take({2, 3}));
  EXPECT_EQ(joined.states(), all.states());
  EXPECT_EQ(joined.noise().scale(), all.noise().scale());
  joined.remove_first(3);
  EXPECT_EQ(joined.states(), all.states().rightCols(1));
  EXPECT_EQ(joined.values(), all.values().rightCols(1));
  EXPECT_EQ(joined.noise().scale(), all.noise().scale().rightCols(1));
  EXPECT_EQ(input_error_of([&] { joined.append(of_one_noise()); }),
            "observations: some have a noise of each value and some have not; give all of them a noise_scale, or none");
  EXPECT_EQ(joined.n_data(), 1);
}

TEST(Observations, RefusesSizesThatDoNotFit) {
  const VectorXd stddev = Eigen::Vector2d(0.1, 0.2);
  const auto refused = [&](const MatrixXd& of_values, const VectorXd& of_stddev) {
    return input_error_of([&] { static_cast<void>(Observations(states(), view, of_values, of_stddev)); });
  };
  EXPECT_EQ(refused(values(), stddev), "");
  const std::string rule =
      "observations: `values` must have a row for each of the view's 2 and a column for each of the 4 states, got ";
  EXPECT_EQ(refused(values().leftCols(3), stddev), rule + "2 × 3");
  EXPECT_EQ(refused(values().topRows(1), stddev), rule + "1 × 4");
  EXPECT_EQ(refused(MatrixXd::Constant(2, 4, std::numeric_limits<double>::infinity()), stddev),
            "observations: `values` must be finite, or NaN where nothing is measured; got one that is infinite");
  EXPECT_EQ(refused(values(), VectorXd::Ones(1)),
            "observations: `noise_stddev` must have one number for each of the view's 2 rows, got 1");
  for (const double sigma : {0.0, nan, 1e101, 1e300}) {
    EXPECT_EQ(refused(values(), Eigen::Vector2d(1, sigma)),
              fmt::format("observations: `noise_stddev` must be positive and at most 1e+100, got {}", sigma));
  }
}

TEST(Observations, RefuseStatesThatTheyDoNotHave) {
  const Observations all(states(), view, values(), Eigen::Vector2d(0.1, 0.2));
  Observations fewer = all;
  const std::vector<std::function<void()>> wrong = {[&] { static_cast<void>(all.take({4})); },
                                                    [&] { static_cast<void>(all.take({-1})); },
                                                    [&] { static_cast<void>(all.slice(3, 2)); }, [&] { fewer.remove_first(5); }};
  for (const auto& one : wrong) EXPECT_THAT(input_error_of(one), testing::EndsWith("are asked for, of 4"));
  EXPECT_EQ(fewer.n_data(), 4);
}

TEST(Statistics, TheMedianOfAnEvenNumberIsTheLargerOfTheTwoInTheMiddle) {
  EXPECT_EQ(median({3, 1, 2}), 2);
  EXPECT_EQ(median({4, 1, 2, 3}), 3);
  EXPECT_EQ(measured_entries(values(), 1), (std::vector<double>{6, 7, 8}));
}

}  // namespace
}  // namespace gp2
