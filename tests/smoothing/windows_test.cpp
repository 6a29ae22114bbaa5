#include "gp2/smoothing/windows.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numbers>

#include <gtest/gtest.h>

#include "base/random.hpp"

// What positions tell of accelerations over windows of time.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t windows_seed = 61801;
const SmootherModel model{.noise_stddev = 0.01, .time_stddev = 0};

// at times that are not even, some near to each other
VectorXd uneven_times(int n, std::uint64_t stream) {
  RandomStream random(windows_seed, stream);
  VectorXd times(n);
  double at = 0;
  for (double& time : times) time = at += 0.01 * (0.2 + 1.6 * random.uniform());
  return times;
}

template <typename Motion>
std::vector<Measurement> positions_of(const VectorXd& times, const Motion& motion) {
  std::vector<Measurement> positions;
  for (const double time : times) positions.push_back({.time = time, .value = motion(time)});
  return positions;
}

std::vector<int> up_to(int n) {
  std::vector<int> numbers;
  for (int k = 0; k < n; ++k) numbers.push_back(k);
  return numbers;
}

VectorXd every(const VectorXd& times, Index step) {
  VectorXd some((times.size() + step - 1) / step);
  for (Index i = 0; i < some.size(); ++i) some[i] = times[i * step];
  return some;
}

double applied(const WeightedSum& sum, const VectorXd& times, double (*acceleration)(double)) {
  double value = 0;
  for (Index i = 0; i < sum.weights.size(); ++i) value += sum.weights[i] * acceleration(times[sum.first + i]);
  return value;
}

TEST(WindowedAccelerations, AreExactWhereTheAccelerationIsACubic) {
  const VectorXd times = uneven_times(300, 1), states = every(times, 3);
  const auto position = [](double t) { return 7 - 2 * t + t * t + std::pow(t, 4) / 12 - std::pow(t, 5) / 20; };
  const WindowGrid grid{-0.2, 0.1};
  const std::vector<WeightedSum> sums =
      windowed_accelerations(positions_of(times, position), model, grid, up_to(30), states, 1, 0);
  ASSERT_GT(sums.size(), 20U);
  for (const WeightedSum& sum : sums) {
    EXPECT_EQ(sum.row, 1);
    // differences over a step of a hundredth lose four digits, twice
    EXPECT_NEAR(sum.value, applied(sum, states, [](double t) { return 2 + t * t - t * t * t; }), 1e-9);
  }
  // as accelerations: a window that is inside weighs them by about 1
  EXPECT_NEAR(sums[sums.size() / 2].weights.sum(), 1, 0.01);
}

TEST(WindowedAccelerations, ConvergeWithTheFourthPowerOfTheStep) {
  double before = 0;
  for (const int step : {8, 4, 2}) {
    const VectorXd times = VectorXd::LinSpaced(801, 0, 4), states = every(times, step);
    const std::vector<WeightedSum> sums = windowed_accelerations(
        positions_of(times, [](double t) { return -std::sin(5 * t) / 25; }), model, {-0.4, 0.2}, up_to(20), states, 0, 0);
    double worst = 0;
    for (const WeightedSum& sum : sums) {
      worst = std::max(worst, std::abs(sum.value - applied(sum, states, [](double t) { return std::sin(5 * t); })));
    }
    if (before > 0) {
      EXPECT_LT(worst, before / 8) << step;
    }
    before = worst;
  }
  EXPECT_LT(before, 1e-6);
}

TEST(WindowedAccelerations, HaveTheNoiseThatPositionsHave) {
  const VectorXd times = uneven_times(120, 2), states = every(times, 3);
  std::vector<Measurement> positions = positions_of(times, [](double) { return 0.0; });
  RandomStream random(windows_seed, 3);
  for (Measurement& one : positions) one.noise_factor = 0.5 + random.uniform(), one.rate = random.normal();
  const SmootherModel late{.noise_stddev = 0.01, .time_stddev = 0.02};
  const auto sums_of = [&] { return windowed_accelerations(positions, late, {-0.2, 0.1}, up_to(12), states, 0, 0); };
  const auto n = static_cast<Index>(sums_of().size());
  ASSERT_GT(n, 8);
  MatrixXd L = MatrixXd::Zero(n, n), covariance = MatrixXd::Zero(n, n);
  for (Index r = 0; r < n; ++r) {
    const WeightedSum sum = sums_of()[static_cast<std::size_t>(r)];
    L.row(r).segment(r - sum.noise.size() + 1, sum.noise.size()) = sum.noise.transpose();
    EXPECT_LE(sum.noise.size(), 5) << "windows farther apart have no sample in common";
  }
  // what each position adds, one by one
  for (Measurement& one : positions) {
    one.value = std::hypot(one.noise_factor * 0.01, one.rate * 0.02);
    VectorXd z(n);
    for (Index r = 0; r < n; ++r) z[r] = sums_of()[static_cast<std::size_t>(r)].value;
    covariance += z * z.transpose();
    one.value = 0;
  }
  EXPECT_LE((L * L.transpose() - covariance).norm(), 1e-10 * covariance.norm());
}

MatrixXd covariance_of(const std::vector<WeightedSum>& sums) {
  const Index n = std::ssize(sums);
  MatrixXd L = MatrixXd::Zero(n, n);
  for (Index r = 0; r < n; ++r) {
    const VectorXd& noise = sums[static_cast<std::size_t>(r)].noise;
    L.row(r).segment(r - noise.size() + 1, noise.size()) = noise.transpose();
  }
  return L * L.transpose();
}

// An oscillator's acceleration −ω²q − ωq̇/2 is asked for at states that are smoothed from the positions of the sums. The noise of each
// position goes through both sides.
TEST(WindowedAccelerations, CountWhatErrorsOfTheStatesMakeOfThem) {
  const SmootherModel motion{.lengthscale = 0.5, .noise_stddev = 0.01, .time_stddev = 0};
  const VectorXd times = VectorXd::LinSpaced(301, 0, 3);
  const double bandwidth = bandwidth_of(motion, 0.01);
  const VectorXd states = every(times, std::lround(0.25 / bandwidth / 0.01));
  WindowGrid grid{-0.8 / bandwidth, 0.4 / bandwidth};
  std::vector<Measurement> positions = positions_of(times, [](double) { return 0.0; });
  const auto sums_of = [&] {
    return windowed_accelerations(positions, motion, grid, up_to(static_cast<int>(3 / grid.spacing) + 2), states, 0, 0);
  };
  const MatrixXd of_exact_states = covariance_of(sums_of());
  const Index n = of_exact_states.rows();
  // what the noise of each position changes: the sums, and the positions and velocities that are summed over
  MatrixXd measured(n, times.size()), position(n, times.size()), velocity(n, times.size());
  for (Index k = 0; k < times.size(); ++k) {
    positions[static_cast<std::size_t>(k)].value = motion.noise_stddev;
    const Eigen::Matrix3Xd smoothed = smooth(motion, positions, states).mean;
    const std::vector<WeightedSum> sums = sums_of();
    positions[static_cast<std::size_t>(k)].value = 0;
    for (Index r = 0; r < n; ++r) {
      const WeightedSum& sum = sums[static_cast<std::size_t>(r)];
      measured(r, k) = sum.value;
      position(r, k) = smoothed.row(0).segment(sum.first, sum.weights.size()).dot(sum.weights);
      velocity(r, k) = smoothed.row(1).segment(sum.first, sum.weights.size()).dot(sum.weights);
    }
  }
  // what changes slowly, to which many windows add up
  const VectorXd taper = Eigen::ArrayXd::LinSpaced(n, 0, std::numbers::pi).sin().square();
  for (const double frequency : {0.1, 0.3}) {  // of the oscillator, in units of the bandwidth
    const double w = 2 * std::numbers::pi * frequency * bandwidth;
    const MatrixXd off = measured + w * w * position + 0.5 * w * velocity, expected = off * off.transpose();
    const VectorXd ones = VectorXd::Ones(states.size());
    grid.sensitivity = {states, -w * w * ones, -0.5 * w * ones};
    const MatrixXd covariance = covariance_of(sums_of());
    EXPECT_LT((covariance.diagonal() - expected.diagonal()).cwiseQuotient(expected.diagonal()).cwiseAbs().maxCoeff(), 0.04);
    const auto slow = [&](const MatrixXd& of_sums) { return taper.dot(of_sums * taper); };
    EXPECT_NEAR(slow(covariance) / slow(expected), 1, 0.05);
    EXPECT_LT(slow(of_exact_states), 0.6 * slow(expected));
  }
}

TEST(WindowedAccelerations, LeaveOutWindowsWithAPause) {
  VectorXd times = VectorXd::LinSpaced(200, 0, 1.99);
  times.tail(100).array() += 0.5;
  const WindowGrid grid{-0.2, 0.1};
  const std::vector<WeightedSum> sums =
      windowed_accelerations(positions_of(times, [](double t) { return t * t; }), model, grid, up_to(30), times, 0, 0);
  for (const WeightedSum& sum : sums) {
    // the cubic at the first sample after the pause is through the last one before it
    const auto n_before = std::clamp<Index>(100 - sum.first, 0, sum.weights.size());
    const double before = sum.weights.head(n_before).cwiseAbs().sum(), all = sum.weights.cwiseAbs().sum();
    EXPECT_LT(std::min(before, all - before), 0.001 * all) << times[sum.first];
    EXPECT_NEAR(sum.weights.sum() * 2, sum.value, 1e-8);
  }
  EXPECT_GT(sums.size(), 10U);
}

// Rows are left out where an input is not known, or a value is missing: what a cubic makes of the nearest ones is no acceleration.
TEST(WindowedAccelerations, LeaveOutWindowsWhoseStatesAreLeftOut) {
  const VectorXd times = VectorXd::LinSpaced(401, 0, 4);
  std::vector<double> kept;
  std::ranges::copy_if(times, std::back_inserter(kept), [](double t) { return t >= 0.5 && (t < 2 || t >= 2.3); });
  const VectorXd states = Eigen::Map<const VectorXd>(kept.data(), std::ssize(kept));
  const auto sums_of = [&](const VectorXd& of_states) {
    return windowed_accelerations(positions_of(times, [](double t) { return -std::sin(5 * t) / 25; }), model, {-0.2, 0.1},
                                  up_to(40), of_states, 0, 0);
  };
  const std::vector<WeightedSum> some = sums_of(states);
  EXPECT_GT(some.size(), 20U);
  EXPECT_LT(some.size(), sums_of(times).size() - 8);
  for (const WeightedSum& sum : some)
    EXPECT_NEAR(sum.value, applied(sum, states, [](double t) { return std::sin(5 * t); }), 1e-6) << states[sum.first];
}

TEST(WindowedAccelerations, TakeTheMeanOfWhatIsMeasuredAtOneTime) {
  const VectorXd times = VectorXd::LinSpaced(60, 0, 0.59);
  const auto position = [](double t) { return std::cos(t); };
  std::vector<Measurement> twice;
  for (const Measurement& one : positions_of(times, position)) {
    for (const double off : {-0.1, 0.1}) twice.push_back({.time = one.time, .value = one.value + off});
  }
  const std::vector<WeightedSum> once = windowed_accelerations(positions_of(times, position), model, {-0.2, 0.1}, up_to(8), times,
                                                               0, 0),
                                 mean = windowed_accelerations(twice, model, {-0.2, 0.1}, up_to(8), times, 0, 0);
  ASSERT_EQ(once.size(), mean.size());
  for (std::size_t r = 0; r < once.size(); ++r) {
    EXPECT_NEAR(once[r].value, mean[r].value, 1e-9);
    EXPECT_LE((once[r].noise - std::sqrt(2) * mean[r].noise).norm(), 1e-12 * once[r].noise.norm());
  }
}

}  // namespace
}  // namespace gp2
