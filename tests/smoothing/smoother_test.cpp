#include "gp2/smoothing/smoother.hpp"

#include <cmath>
#include <limits>
#include <numbers>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/Cholesky>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "input_error.hpp"

namespace gp2::test {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::ElementsAre;
using testing::HasSubstr;

constexpr double eps = std::numeric_limits<double>::epsilon();
const std::vector<Smoothness> all_orders = {Smoothness::matern52, Smoothness::matern72, Smoothness::matern92};

// cov(q⁽ⁱ⁾(t), q⁽ʲ⁾(t′)) of s² e^(−r) P(r), P as the header prints it, by differentiating: (e^(−r) P)′ = e^(−r) (P′ − P)
double kernel(const SmootherModel& model, double t, double t2, int i, int j) {
  std::vector<double> P;
  switch (model.smoothness) {
    case Smoothness::matern52:
      P = {1, 1, 1 / 3.0};
      break;
    case Smoothness::matern72:
      P = {1, 1, 2 / 5.0, 1 / 15.0};
      break;
    case Smoothness::matern92:
      P = {1, 1, 3 / 7.0, 2 / 21.0, 1 / 105.0};
      break;
  }
  for (int d = 0; d < i + j; ++d) {
    for (std::size_t k = 0; k < P.size(); ++k) P[k] = (k + 1 < P.size() ? static_cast<double>(k + 1) * P[k + 1] : 0) - P[k];
  }
  const double rate = std::sqrt(2.0 * static_cast<int>(model.smoothness) + 1) / model.lengthscale;
  const double r = rate * std::abs(t - t2);
  double value = 0;
  for (std::size_t k = P.size(); k-- > 0;) value = value * r + P[k];
  const double sign = (t < t2 && (i + j) % 2 == 1 ? -1 : 1) * (j % 2 == 1 ? -1 : 1);
  return model.signal_stddev * model.signal_stddev * sign * std::pow(rate, i + j) * std::exp(-r) * value;
}

/// Gaussian process regression as in the books.
struct Dense {
  Dense(const SmootherModel& smoother_model, const std::vector<Measurement>& measured)
      : model(smoother_model), measurements(measured) {
    const auto n = static_cast<Index>(measured.size());
    MatrixXd K(n, n);
    values.resize(n);
    for (Index a = 0; a < n; ++a) {
      const Measurement& one = at(a);
      values[a] = one.value;
      for (Index b = 0; b < n; ++b) K(a, b) = kernel(model, one.time, at(b).time, one.velocity, at(b).velocity);
      const double read = one.noise_factor * (one.velocity ? model.velocity_noise_stddev : model.noise_stddev);
      const double late = one.velocity ? 0 : model.time_stddev * one.rate;
      K(a, a) += read * read + late * late;
    }
    factor.compute(K);
  }
  [[nodiscard]] const Measurement& at(Index k) const { return measurements[static_cast<std::size_t>(k)]; }
  [[nodiscard]] double log_likelihood() const {
    const double log_det = 2 * factor.matrixLLT().diagonal().array().log().sum();
    return -0.5 *
           (values.dot(factor.solve(values)) + log_det + static_cast<double>(values.size()) * std::log(2 * std::numbers::pi));
  }
  [[nodiscard]] std::pair<Eigen::Vector3d, Eigen::Matrix3d> predict(double t) const {
    MatrixXd cross(values.size(), 3);
    Eigen::Matrix3d prior;
    for (int d = 0; d < 3; ++d) {
      for (Index a = 0; a < values.size(); ++a) cross(a, d) = kernel(model, at(a).time, t, at(a).velocity, d);
      for (int e = 0; e < 3; ++e) prior(d, e) = kernel(model, t, t, d, e);
    }
    return {cross.transpose() * factor.solve(values), prior - cross.transpose() * factor.solve(cross)};
  }

  SmootherModel model;
  std::vector<Measurement> measurements;
  VectorXd values;
  Eigen::LLT<MatrixXd> factor;
};

// irregular times, a gap, several readings at one time, velocities among them
std::vector<Measurement> irregular(int n, std::uint64_t seed) {
  RandomStream random(seed);
  std::vector<Measurement> out;
  double t = -0.3;
  for (int k = 0; k < n; ++k) {
    if (k % 7 != 3) t += k == n / 2 ? 1.5 : 0.05 * random.uniform() + 1e-4;
    const bool velocity = k % 5 == 4;
    const double value = velocity ? 3 * std::cos(3 * t) + 0.1 * random.normal() : std::sin(3 * t) + 0.02 * random.normal();
    out.push_back({t, value, velocity, 1 + 0.5 * (k % 3), 3 * std::cos(3 * t)});
  }
  return out;
}

SmootherModel some_model(Smoothness order) { return {order, 0.7, 1.3, 0.02, 0.1, 0.004}; }

TEST(Smoother, IsGaussianProcessRegressionToRounding) {
  const std::vector<Measurement> measurements = irregular(60, 1);
  VectorXd times(9);
  times << -1.0, -0.3, 0.01, measurements[20].time, 0.5, 1.3, 2.0, measurements.back().time, 8.0;
  for (const Smoothness order : all_orders) {
    const SmootherModel model = some_model(order);
    const Dense dense(model, measurements);
    EXPECT_NEAR(log_likelihood(model, measurements), dense.log_likelihood(), 1e-9);
    const SmoothedMotion motion = smooth(model, measurements, times);
    for (Index k = 0; k < times.size(); ++k) {
      const auto [mean, covariance] = dense.predict(times[k]);
      const Eigen::Vector3d unit(kernel(model, 0, 0, 0, 0), kernel(model, 0, 0, 1, 1), kernel(model, 0, 0, 2, 2));
      for (int d = 0; d < 3; ++d) {
        // the dense solution loses cond(K) ε ≈ 1e6 ε of the prior's size
        EXPECT_NEAR(motion.mean(d, k), mean[d], 1e7 * eps * std::sqrt(unit[d])) << "time " << times[k];
        for (int e = 0; e < 3; ++e) {
          EXPECT_NEAR(motion.covariance[static_cast<std::size_t>(k)](d, e), covariance(d, e),
                      1e7 * eps * std::sqrt(unit[d] * unit[e]));
        }
      }
    }
  }
}

TEST(Smoother, GradientOfTheLikelihoodIsItsDerivative) {
  const std::vector<Measurement> measurements = irregular(200, 2);
  for (const Smoothness order : all_orders) {
    const SmootherModel model = some_model(order);
    VectorXd gradient;
    log_likelihood(model, measurements, &gradient);
    ASSERT_EQ(gradient.size(), SmootherModel::n_parameters);
    for (Index k = 0; k < gradient.size(); ++k) {
      const auto at = [&](double factor) {
        SmootherModel moved = model;
        double* const parameters[] = {&moved.lengthscale, &moved.signal_stddev, &moved.noise_stddev, &moved.velocity_noise_stddev,
                                      &moved.time_stddev};
        *parameters[k] *= factor;
        return log_likelihood(moved, measurements);
      };
      constexpr double h = 1e-4;
      EXPECT_NEAR(gradient[k], (at(std::exp(h)) - at(std::exp(-h))) / (2 * h), 1e-5 * (1 + std::abs(gradient[k]))) << k;
      EXPECT_GT(std::abs(gradient[k]), 0.1) << k;
    }
  }
}

TEST(Smoother, HasNoPhase) {
  const std::vector<Measurement> forward = irregular(80, 3);
  std::vector<Measurement> backward(forward.rbegin(), forward.rend());
  for (Measurement& one : backward) {
    one.time = -one.time;
    if (one.velocity) one.value = -one.value;
  }
  const VectorXd times = VectorXd::LinSpaced(40, -0.2, 3);
  const SmootherModel model = some_model(Smoothness::matern92);
  const SmoothedMotion there = smooth(model, forward, times), back = smooth(model, backward, -times.reverse());
  EXPECT_NEAR(log_likelihood(model, forward), log_likelihood(model, backward), 1e-9);
  for (Index k = 0; k < times.size(); ++k) {
    const Index mirrored = times.size() - 1 - k;
    EXPECT_NEAR(there.mean(0, k), back.mean(0, mirrored), 1e-9);
    EXPECT_NEAR(there.mean(1, k), -back.mean(1, mirrored), 1e-8);
    EXPECT_NEAR(there.mean(2, k), back.mean(2, mirrored), 1e-7);
  }
}

TEST(Smoother, KnowsNoUnits) {
  // the same motion in milliseconds and in degrees
  const double to_degrees = 180 / std::numbers::pi, to_ms = 1000;
  std::vector<Measurement> radians;
  RandomStream random(4);
  for (int k = 0; k < 400; ++k) radians.push_back({0.002 * k, std::sin(9 * 0.002 * k) + 1e-3 * random.normal()});
  std::vector<Measurement> degrees = radians;
  for (Measurement& one : degrees) {
    one.time *= to_ms;
    one.value *= to_degrees;
  }
  const SmootherFit in_radians = fit_smoother(radians), in_degrees = fit_smoother(degrees);
  EXPECT_NEAR(in_degrees.model.lengthscale / to_ms / in_radians.model.lengthscale, 1, 1e-3);
  EXPECT_NEAR(in_degrees.model.noise_stddev / to_degrees / in_radians.model.noise_stddev, 1, 1e-3);
  const VectorXd times = VectorXd::LinSpaced(30, 0, 0.79);
  const SmoothedMotion a = smooth(in_radians.model, in_radians.trusted, times),
                       b = smooth(in_degrees.model, in_degrees.trusted, times * to_ms);
  for (Index k = 0; k < times.size(); ++k) {
    const double stddev = std::sqrt(a.covariance[static_cast<std::size_t>(k)](2, 2));
    EXPECT_NEAR(b.mean(2, k) / to_degrees * to_ms * to_ms, a.mean(2, k), 0.01 * stddev);
  }
}

TEST(Smoother, StatesItsErrorsHonestlyOnMotionsOfItsOwnKind) {
  constexpr int n = 300, n_motions = 20;
  const SmootherModel truth = {Smoothness::matern92, 0.2, 1, 1e-3, 1, 0};
  RandomStream random(5);
  // joint draws of q, dq, ddq
  MatrixXd K(3 * n, 3 * n);
  const auto time = [](Index k) { return 0.004 * static_cast<double>(k); };
  for (Index a = 0; a < n; ++a) {
    for (Index b = 0; b < n; ++b) {
      for (int d = 0; d < 3; ++d) {
        for (int e = 0; e < 3; ++e) K(d * n + a, e * n + b) = kernel(truth, time(a), time(b), d, e) / std::pow(20.0, d + e);
      }
    }
  }
  K.diagonal().array() += 1e-10;
  const Eigen::LLT<MatrixXd> factor(K);
  ASSERT_EQ(factor.info(), Eigen::Success);
  Eigen::Vector3d covered = Eigen::Vector3d::Zero();
  for (int motion = 0; motion < n_motions; ++motion) {
    VectorXd z(3 * n);
    for (double& one : z) one = random.normal();
    const VectorXd path = factor.matrixL() * z;
    std::vector<Measurement> measurements;
    VectorXd times(n);
    for (Index k = 0; k < n; ++k) {
      times[k] = time(k);
      measurements.push_back({time(k), path[k] + truth.noise_stddev * random.normal()});
    }
    const SmootherFit fit = fit_smoother(measurements);
    const SmoothedMotion smoothed = smooth(fit.model, fit.trusted, times);
    for (Index k = 0; k < n; ++k) {
      for (int d = 0; d < 3; ++d) {
        const double error = smoothed.mean(d, k) - path[d * n + k] * std::pow(20.0, d);
        covered[d] += std::abs(error) < 1.96 * std::sqrt(smoothed.covariance[static_cast<std::size_t>(k)](d, d)) ? 1 : 0;
      }
    }
  }
  covered /= n * n_motions;
  for (int d = 0; d < 3; ++d) {
    EXPECT_GE(covered[d], 0.92) << d;
    EXPECT_LE(covered[d], 0.98) << d;
  }
}

TEST(Smoother, FindsLengthscaleNoiseAndTimingOfAMotion) {
  RandomStream random(6);
  std::vector<Measurement> measurements;
  for (int k = 0; k < 3000; ++k) {
    const double t = 0.002 * k + 1e-4 * random.normal();
    measurements.push_back({0.002 * k, std::sin(5 * t) + 0.3 * std::sin(11 * t + 1) + 1e-4 * random.normal()});
  }
  const SmootherFit fit = fit_smoother(measurements);
  EXPECT_TRUE(fit.converged);
  EXPECT_NEAR(fit.model.noise_stddev, 1e-4, 2e-5);
  EXPECT_NEAR(fit.model.time_stddev, 1e-4, 1e-5);
  const SmootherFit punctual = fit_smoother(measurements, {.estimate_time_stddev = false});
  EXPECT_EQ(punctual.model.time_stddev, 0);
  EXPECT_GT(fit.log_likelihood, punctual.log_likelihood + 100);
}

TEST(Smoother, FindsTheNoiseWhereEveryPositionIsMeasuredTwiceAtItsTime) {
  for (const int times : {1, 2, 3}) {
    RandomStream random(11);
    std::vector<Measurement> measurements;
    for (int k = 0; k < 1000; ++k) {
      const double t = k / 100.0, q = 0.5 * std::sin(2 * t) + 0.2 * std::sin(5 * t);
      for (int i = 0; i < times; ++i) measurements.push_back({t, q + 1e-3 * random.normal()});
    }
    measurements[400].value += 0.05;
    measurements[700].value += 1;
    const SmootherFit fit = fit_smoother(measurements);
    EXPECT_NEAR(fit.model.noise_stddev, 1e-3, 1e-4) << times;
    EXPECT_THAT(fit.outliers, ElementsAre(400, 700)) << times;
  }
}

TEST(Smoother, TakesNoiseForNoTimingWhereASpeedIsNearlyConstant) {
  for (const std::uint64_t seed : {1U, 2U, 3U}) {
    RandomStream random(seed);
    std::vector<Measurement> measurements;
    for (int k = 0; k < 1000; ++k) {
      const double t = 0.01 * k;
      measurements.push_back({t, 50 * t + 0.3 * std::sin(3 * t) + 1e-3 * random.normal()});
    }
    const SmootherFit fit = fit_smoother(measurements);
    EXPECT_NEAR(fit.model.noise_stddev, 1e-3, 1e-4) << seed;
    EXPECT_FALSE(fit.noise_at_least) << seed;
  }
}

TEST(Smoother, TakesFastPlacesOfAMotionForNoTiming) {
  // bursts between which it hardly moves, a few samples each
  std::vector<Measurement> measurements;
  for (int k = 0; k < 300; ++k) {
    const double t = 0.02 * k, burst = std::sin(1.7 * t);
    measurements.push_back({t, 3 * t + 0.5 * std::pow(burst, 7) * std::sin(45 * t)});
  }
  EXPECT_EQ(fit_smoother(measurements).model.time_stddev, 0);
}

TEST(Smoother, DistrustsWhatTheOthersContradictAndNothingElse) {
  RandomStream random(7);
  std::vector<Measurement> clean;
  for (int k = 0; k < 1000; ++k) clean.push_back({0.002 * k, std::sin(5 * 0.002 * k) + 1e-3 * random.normal()});
  EXPECT_THAT(fit_smoother(clean).outliers, ElementsAre());

  std::vector<Measurement> spoiled = clean;
  const std::vector<std::pair<int, double>> offsets = {{100, 0.5}, {101, 0.4}, {300, -0.02}, {600, 3}, {999, 0.3}};
  for (const auto& [k, offset] : offsets) spoiled[static_cast<std::size_t>(k)].value += offset;
  const SmootherFit fit = fit_smoother(spoiled);
  EXPECT_THAT(fit.outliers, ElementsAre(100, 101, 300, 600, 999));
  EXPECT_EQ(fit.trusted.size(), spoiled.size() - 5);
  EXPECT_NEAR(fit.model.noise_stddev, 1e-3, 2e-4);
  EXPECT_THAT(fit_smoother(spoiled, {.outlier_threshold = 0}).outliers, ElementsAre());
}

// more moments, and more different steps between them, than a filter keeps at once
std::vector<Measurement> long_log() {
  RandomStream random(21);
  std::vector<Measurement> out;
  double t = 0;
  for (int k = 0; k < 70'000; ++k) {
    t += 0.005 + 0.005 * random.uniform();
    out.push_back({t, std::sin(3 * t) + 0.02 * random.normal()});
  }
  return out;
}

TEST(Smoother, ALongLogIsSmoothedAsAPartOfItIsFarFromItsEnds) {
  const std::vector<Measurement> log = long_log();
  const SmootherModel model = {Smoothness::matern72, 0.1, 1, 0.02};
  // where blocks of moments meet, and hundreds of lengthscales around
  for (const std::ptrdiff_t middle : {std::ptrdiff_t{1} << 15, std::ptrdiff_t{1} << 16}) {
    const std::vector<Measurement> part(log.begin() + middle - 3000, log.begin() + middle + 3000);
    VectorXd times(20);
    for (Index k = 0; k < times.size(); ++k) times[k] = log[static_cast<std::size_t>(middle - 10 + k)].time;
    const SmoothedMotion of_all = smooth(model, log, times), of_part = smooth(model, part, times);
    EXPECT_LT((of_all.mean - of_part.mean).cwiseAbs().maxCoeff(), 1e-8);
    for (std::size_t k = 0; k < of_all.covariance.size(); ++k)
      EXPECT_TRUE(of_all.covariance[k].isApprox(of_part.covariance[k], 1e-8));
  }
}

TEST(Smoother, TheGradientOfALongLogIsThatOfDifferences) {
  const std::vector<Measurement> log = long_log();
  const SmootherModel model = {Smoothness::matern52, 0.1, 1, 0.02};
  VectorXd gradient;
  log_likelihood(model, log, &gradient);
  const auto difference = [&](double SmootherModel::*parameter) {
    constexpr double step = 1e-5;
    SmootherModel more = model, less = model;
    more.*parameter *= std::exp(step), less.*parameter *= std::exp(-step);
    return (log_likelihood(more, log) - log_likelihood(less, log)) / (2 * step);
  };
  EXPECT_NEAR(gradient[0], difference(&SmootherModel::lengthscale), 1e-6 * std::abs(gradient[0]));
  EXPECT_NEAR(gradient[2], difference(&SmootherModel::noise_stddev), 1e-6 * std::abs(gradient[2]));
}

TEST(Smoother, TheLikelihoodOfAFitIsThatOfAllThatIsTrusted) {
  const std::vector<Measurement> log = irregular(80, 12);
  const SmootherFit fit =
      fit_smoother(log, {.model = some_model(Smoothness::matern72), .outlier_threshold = 0, .estimate_time_stddev = false});
  EXPECT_EQ(fit.log_likelihood, log_likelihood(fit.model, fit.trusted)) << "of a model that is given";
}

TEST(Smoother, FindsTheMotionOfALongLogThatMostlyRests) {
  // where none of the stretches that would tell the model is
  std::vector<Measurement> log;
  for (int k = 0; k < 40000; ++k) {
    const bool moves = k > 3200 && k < 4200;
    log.push_back({0.002 * k, moves ? std::round(1e4 * (1 - std::cos(0.002 * std::numbers::pi * (k - 3200)))) / 1e4 : 0});
  }
  const SmootherFit fit = fit_smoother(log, {.smoothness = Smoothness::matern52,
                                             .least_noise_stddev = 1e-4 / std::sqrt(12.0),
                                             .outlier_threshold = 0,
                                             .estimate_time_stddev = false});
  const SmoothedMotion motion = smooth(fit.model, fit.trusted, Eigen::VectorXd{{0.002 * 3450}});
  EXPECT_NEAR(motion.mean(1, 0), std::numbers::pi, 0.01);
}

TEST(Smoother, FindsTheStepOfAnEncoder) {
  std::vector<double> counts, rounded, smooth_values;
  RandomStream random(8);
  const double step = 2 * std::numbers::pi / 4096;
  for (int k = 0; k < 500; ++k) {
    const double value = std::sin(0.01 * k) + 0.01 * random.normal();
    counts.push_back(step * std::round(value / step));
    rounded.push_back(std::round(value * 1e5) / 1e5);
    smooth_values.push_back(value);
  }
  EXPECT_NEAR(resolution_of(counts), step, 1e-9);
  EXPECT_NEAR(resolution_of(rounded), 1e-5, 1e-9);
  EXPECT_EQ(resolution_of(smooth_values), 0);
  EXPECT_EQ(resolution_of({1, 2}), 0);
}

TEST(Smoother, NoiseIsNotBelowTheLeast) {
  std::vector<Measurement> measurements;
  for (int k = 0; k < 300; ++k) measurements.push_back({0.01 * k, std::sin(0.02 * k)});
  const SmootherFit fit = fit_smoother(measurements, {.least_noise_stddev = 1e-4, .estimate_time_stddev = false});
  EXPECT_NEAR(fit.model.noise_stddev, 1e-4, 1e-9);
  EXPECT_TRUE(fit.noise_at_least);
}

TEST(Smoother, SaysWhatIsWrong) {
  const std::vector<Measurement> good = irregular(20, 9);
  const auto likelihood = [&](const SmootherModel& model, const std::vector<Measurement>& measurements) {
    return test::input_error_of([&] { log_likelihood(model, measurements); });
  };
  EXPECT_THAT(likelihood({.lengthscale = 0}, good), HasSubstr("lengthscale must be positive, got 0"));
  EXPECT_THAT(likelihood({.signal_stddev = -1}, good), HasSubstr("signal_stddev must be positive, got -1"));
  EXPECT_THAT(likelihood({.noise_stddev = 0}, good), HasSubstr("noise_stddev must be positive"));
  EXPECT_THAT(likelihood({.velocity_noise_stddev = 0}, good), HasSubstr("velocity_noise_stddev must be positive"));
  EXPECT_THAT(likelihood({.time_stddev = -1}, good), HasSubstr("time_stddev must not be negative, got -1"));
  EXPECT_THAT(likelihood({}, {}), HasSubstr("there are no measurements"));
  EXPECT_THAT(likelihood({}, {{0, 1}, {1, std::nan("")}}), HasSubstr("measurement 1 must be finite, got nan at time 1"));
  EXPECT_THAT(likelihood({}, {{0, 1}, {-1, 1}}), HasSubstr("times must not run backwards, got -1 after 0"));
  EXPECT_THAT(likelihood({}, {{0, 1, false, 0}}), HasSubstr("noise_factor must be positive, got 0"));
  EXPECT_THAT(test::input_error_of([&] { smooth({}, good, VectorXd::Zero(2)); }),
              HasSubstr("times must be finite and increase, got 0 at 1"));
  EXPECT_THAT(test::input_error_of([&] { fit_smoother({{0, 1}, {1, 2}}); }), HasSubstr("2 positions are too few"));
  EXPECT_THAT(test::input_error_of([&] {
                fit_smoother(std::vector<Measurement>{{0, 1}, {1, 1}, {2, 1}, {3, 1}, {4, 1}});
              }),
              HasSubstr("all 5 positions are 1: nothing moves"));
}

}  // namespace
}  // namespace gp2::test
