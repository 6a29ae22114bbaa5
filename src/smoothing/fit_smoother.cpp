#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/smoothing/smoother.hpp"
#include "training/lbfgsb.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

constexpr int least_positions = 5;
constexpr int reach = 3;                     // measurements on either side whose residuals an outlier spoils
constexpr double median_of_normal = 0.6745;  // of |x|, x standard normal

double square(double x) { return x * x; }

/// How far each inner position is off the cubic through two neighbours on either side,
/// in units that noise of deviation 1 gives it.
struct Roughness {
  std::vector<int> measurement;
  std::vector<double> residual;
};

Roughness roughness_of(const std::vector<Measurement>& all, const std::vector<int>& positions) {
  Roughness out;
  for (std::size_t k = 2; k + 2 < positions.size(); ++k) {
    const auto at = [&](std::size_t i) -> const Measurement& { return all[static_cast<std::size_t>(positions[i])]; };
    const std::array<std::size_t, 4> nodes = {k - 2, k - 1, k + 1, k + 2};
    double predicted = 0, variance = 1;
    bool distinct = true;
    for (const std::size_t i : nodes) {
      double weight = 1;
      for (const std::size_t j : nodes) {
        if (j == i) continue;
        distinct = distinct && at(i).time != at(j).time;
        weight *= (at(k).time - at(j).time) / (at(i).time - at(j).time);
      }
      predicted += weight * at(i).value;
      variance += weight * weight;
    }
    if (!distinct) continue;
    out.measurement.push_back(positions[k]);
    out.residual.push_back((at(k).value - predicted) / std::sqrt(variance));
  }
  return out;
}

/// Measurements above a threshold that stand out most among those within reach of them.
std::vector<int> peaks(const std::vector<double>& sizes, double threshold) {
  std::vector<int> out;
  const int n = static_cast<int>(sizes.size());
  for (int k = 0; k < n; ++k) {
    const double size = sizes[static_cast<std::size_t>(k)];
    if (!(size > threshold)) continue;
    const auto first = sizes.begin() + std::max(0, k - reach), last = sizes.begin() + std::min(n, k + reach + 1);
    if (*std::max_element(first, last) <= size &&
        (out.empty() || k - out.back() > reach || sizes[static_cast<std::size_t>(out.back())] < size)) {
      out.push_back(k);
    }
  }
  return out;
}

/// What values and differences say before anything is fitted, by medians: outliers do not matter.
SmootherModel rough_model(const std::vector<Measurement>& all, const std::vector<int>& positions, const Roughness& roughness,
                          const SmootherFitOptions& options) {
  std::vector<double> values, rates, rough;
  for (const int k : positions) values.push_back(all[static_cast<std::size_t>(k)].value);
  const double centre = median(values);
  double spread = 0;
  for (const double value : values) spread += square(value - centre);
  SmootherModel model;
  model.smoothness = options.smoothness;
  model.signal_stddev = std::sqrt(spread / static_cast<double>(values.size()));
  for (std::size_t k = 1; k < positions.size(); ++k) {
    const Measurement &here = all[static_cast<std::size_t>(positions[k])],
                      &before = all[static_cast<std::size_t>(positions[k - 1])];
    if (here.time > before.time) rates.push_back(std::abs((here.value - before.value) / (here.time - before.time)));
  }
  const double span = all.back().time - all.front().time;
  double rate = rates.empty() ? 0 : median(rates) / median_of_normal;
  if (!(rate > 0)) rate = model.signal_stddev * 10 / span;
  // var dq = s² 2ν/ℓ² E ω², E ω² = 1/(2ν − 2)
  const double twice_order = 2.0 * static_cast<int>(options.smoothness) + 1;
  model.lengthscale = std::min(model.signal_stddev / rate * std::sqrt(twice_order / (twice_order - 2)), span);
  for (const double residual : roughness.residual) rough.push_back(std::abs(residual));
  model.noise_stddev = std::clamp(rough.empty() ? 0 : median(rough) / median_of_normal,
                                  std::max(options.least_noise_stddev, 1e-6 * model.signal_stddev), model.signal_stddev);
  model.velocity_noise_stddev = std::max(options.least_velocity_noise_stddev, 1e-2 * rate);
  return model;
}

VectorXd logarithms(double lengthscale, double signal, double noise, double velocity_noise, double time) {
  VectorXd values(SmootherModel::n_parameters);
  values << lengthscale, signal, noise, velocity_noise, time;
  return values.array().log();
}

SmootherModel of_logarithms(const VectorXd& x, Smoothness smoothness) {
  const VectorXd values = x.array().exp();
  return {smoothness, values[0], values[1], values[2], values[3], values[4]};
}

/// The maximum of the likelihood near a start.
void maximise(const std::vector<Measurement>& measurements, const SmootherModel& rough, const SmootherFitOptions& options,
              SmootherFit& fit) {
  const double span = measurements.back().time - measurements.front().time;
  const double least_noise = std::max(options.least_noise_stddev, 1e-7 * rough.signal_stddev);
  const double least_velocity_noise =
      std::max(options.least_velocity_noise_stddev, 1e-6 * rough.signal_stddev / rough.lengthscale);
  const double shortest = 0.1 * span / static_cast<double>(measurements.size());
  const double size = rough.signal_stddev, rate = size / rough.lengthscale;
  // no τ that is felt, or none at all where no rate is known
  double fastest = 0;
  for (const Measurement& one : measurements) fastest = std::max(fastest, std::abs(one.rate));
  const bool with_time = fastest > 0;
  const double least_time = with_time ? 0.01 * least_noise / fastest : 1;
  const VectorXd lower = logarithms(shortest, 1e-3 * size, least_noise, least_velocity_noise, least_time);
  const VectorXd upper = logarithms(100 * span, 1e4 * size, 10 * size + 2 * least_noise, 10 * rate + 2 * least_velocity_noise,
                                    with_time ? 0.1 * span : 1);
  const SmootherModel& from = fit.model;
  const VectorXd start = logarithms(from.lengthscale, from.signal_stddev, from.noise_stddev, from.velocity_noise_stddev,
                                    with_time && !(from.time_stddev > 0) ? 0.5 * from.noise_stddev / fastest
                                    : with_time                          ? from.time_stddev
                                                                         : 1)
                             .cwiseMax(lower)
                             .cwiseMin(upper);
  const auto n = static_cast<double>(measurements.size());
  const auto objective = [&](const VectorXd& x, VectorXd& gradient) {
    VectorXd by_logarithm;
    const double value = log_likelihood(of_logarithms(x, options.smoothness), measurements, &by_logarithm);
    gradient = -by_logarithm / n;
    return -value / n;
  };
  LbfgsbOptions optimiser;
  optimiser.max_iterations = 200;
  optimiser.gradient_tolerance = 1e-6;
  optimiser.reduction_tolerance = 1e-11;
  const LbfgsbResult result = minimise(objective, start, lower, upper, optimiser);
  fit.model = of_logarithms(result.x, options.smoothness);
  if (!with_time) fit.model.time_stddev = 0;
  fit.log_likelihood = -result.value * n;
  fit.converged = result.converged;
  fit.evaluations += result.evaluations;
  fit.noise_at_least = result.x[2] <= lower[2] + 1e-9;
}

std::vector<Measurement> those_used(const std::vector<Measurement>& measurements, const std::vector<bool>& used) {
  std::vector<Measurement> out;
  for (std::size_t k = 0; k < measurements.size(); ++k) {
    if (used[k]) out.push_back(measurements[k]);
  }
  return out;
}

/// What the smoother says of each measurement.
struct Hindsight {
  std::vector<double> rates;  // dq
  std::vector<double> sizes;  // how far it is off what the others say, in standard deviations of that difference
};

Hindsight hindsight_of(const std::vector<Measurement>& measurements, const std::vector<bool>& used, const SmootherModel& model) {
  std::vector<double> times;
  for (const Measurement& one : measurements) {
    if (times.empty() || one.time > times.back()) times.push_back(one.time);
  }
  const SmoothedMotion motion =
      smooth(model, those_used(measurements, used), Eigen::Map<const VectorXd>(times.data(), static_cast<Index>(times.size())));
  Hindsight out;
  Index at = 0;
  for (std::size_t k = 0; k < measurements.size(); ++k) {
    const Measurement& one = measurements[k];
    while (times[static_cast<std::size_t>(at)] < one.time) ++at;
    const int row = one.velocity ? 1 : 0;
    const double read = one.noise_factor * (one.velocity ? model.velocity_noise_stddev : model.noise_stddev);
    const double noise = square(read) + (one.velocity ? 0 : square(model.time_stddev * one.rate));
    const double known = motion.covariance[static_cast<std::size_t>(at)](row, row);
    const double residual = one.value - motion.mean(row, at);
    // without y the rest says m + (m − y) V/(R − V) with variance R V/(R − V)
    const double variance = used[k] ? noise - known : noise + known;
    constexpr double alone = 1e-3;  // the others say next to nothing
    out.sizes.push_back(variance > alone * noise ? std::abs(residual) / std::sqrt(variance) : 0);
    out.rates.push_back(motion.mean(1, at));
  }
  return out;
}

/// The measurements that are positions.
/// @throws InputError when they are too few, or nothing moves.
std::vector<int> positions_among(const std::vector<Measurement>& measurements) {
  std::vector<int> positions;
  for (std::size_t k = 0; k < measurements.size(); ++k) {
    if (!measurements[k].velocity) positions.push_back(static_cast<int>(k));
  }
  if (static_cast<int>(positions.size()) < least_positions) {
    throw InputError(fmt::format("fit_smoother: {} positions are too few to find smoothness and noise from; give at least {}",
                                 positions.size(), least_positions));
  }
  const double first = measurements[static_cast<std::size_t>(positions.front())].value;
  if (std::all_of(positions.begin(), positions.end(),
                  [&](int k) { return measurements[static_cast<std::size_t>(k)].value == first; })) {
    throw InputError(fmt::format("fit_smoother: all {} positions are {}: nothing moves, so that there is no smoothness to find",
                                 positions.size(), first));
  }
  return positions;
}

/// Leaves out outliers far above everything else, which would hide the smaller ones.
void drop_gross_errors(const Roughness& roughness, double noise_stddev, double threshold, std::vector<bool>& used) {
  constexpr double gross = 20;
  std::vector<double> sizes(used.size(), 0);
  for (std::size_t k = 0; k < roughness.measurement.size(); ++k) {
    sizes[static_cast<std::size_t>(roughness.measurement[k])] = std::abs(roughness.residual[k]) / noise_stddev;
  }
  for (const int k : peaks(sizes, std::max(gross, threshold))) used[static_cast<std::size_t>(k)] = false;
}

/// Leaves out what hindsight distrusts, and takes back, once, what it trusts after all. Returns whether anything changed.
bool choose_again(std::vector<double> sizes, double threshold, std::vector<bool>& used, std::vector<bool>& taken_back) {
  bool changed = false;
  for (std::size_t k = 0; k < sizes.size(); ++k) {
    if (used[k]) continue;
    if (sizes[k] <= threshold && !taken_back[k]) used[k] = taken_back[k] = changed = true;
    sizes[k] = 0;
  }
  for (const int k : peaks(sizes, threshold)) {
    used[static_cast<std::size_t>(k)] = false;
    changed = true;
  }
  return changed;
}

}  // namespace

SmootherFit fit_smoother(const std::vector<Measurement>& measurements, const SmootherFitOptions& options) {
  log_likelihood({}, measurements);  // checks them
  const std::vector<int> positions = positions_among(measurements);
  const Roughness roughness = roughness_of(measurements, positions);
  const SmootherModel rough = rough_model(measurements, positions, roughness, options);
  const double threshold = options.outlier_threshold;
  std::vector<bool> used(measurements.size(), true);
  if (threshold > 0) drop_gross_errors(roughness, rough.noise_stddev, threshold, used);

  SmootherFit fit;
  fit.model = rough;
  std::vector<Measurement> all = measurements;
  std::vector<bool> taken_back(all.size(), false);
  constexpr int max_rounds = 20;
  for (int round = 0; round < max_rounds; ++round) {
    maximise(those_used(all, used), rough, options, fit);
    const Hindsight hindsight = hindsight_of(all, used, fit.model);
    bool changed = threshold > 0 && choose_again(hindsight.sizes, threshold, used, taken_back);
    if (options.estimate_time_stddev) {
      for (std::size_t k = 0; k < all.size(); ++k) all[k].rate = hindsight.rates[k];
      changed = changed || round == 0;
    }
    if (!changed) break;
  }
  for (std::size_t k = 0; k < all.size(); ++k) {
    if (!used[k]) fit.outliers.push_back(static_cast<int>(k));
  }
  fit.trusted = those_used(all, used);
  return fit;
}

double resolution_of(const std::vector<double>& values) {
  std::vector<double> sorted = values;
  std::sort(sorted.begin(), sorted.end());
  sorted.erase(std::unique(sorted.begin(), sorted.end()), sorted.end());
  constexpr std::size_t least_values = 5;
  if (sorted.size() < least_values) return 0;
  double step = std::numeric_limits<double>::infinity();
  for (std::size_t k = 1; k < sorted.size(); ++k) step = std::min(step, sorted[k] - sorted[k - 1]);
  constexpr double tolerance = 0.05;  // of a step: numbers in a log are rounded
  for (std::size_t k = 1; k < sorted.size(); ++k) {
    const double steps = (sorted[k] - sorted[k - 1]) / step;
    if (std::abs(steps - std::round(steps)) > tolerance) return 0;
  }
  return step;
}

}  // namespace gp2
