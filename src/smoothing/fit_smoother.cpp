#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>

#include <fmt/format.h>

#include "base/stop.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/smoothing/smoother.hpp"
#include "smoothing/smooth_each.hpp"
#include "training/lbfgsb.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

constexpr int least_positions = 5;
constexpr int reach = 3;  // measurements on either side whose residuals an outlier spoils

double square(double x) { return x * x; }

/// How far each inner position is off the cubic through those of the two times before and the two after,
/// in units that noise of deviation 1 gives it.
struct Roughness {
  std::vector<int> measurement;
  std::vector<double> residual;

  /// The noise, and what of the motion is no cubic.
  [[nodiscard]] double noise_stddev() const { return quantile_size(0.5) / median_of_normal; }
  /// What the noise cannot be above: the motion is a cubic nearly somewhere.
  [[nodiscard]] double most_noise_stddev() const {
    constexpr double quartile_of_normal = 0.3186, margin = 2;  // of |x|, x standard normal
    return margin * quantile_size(0.25) / quartile_of_normal;
  }

 private:
  [[nodiscard]] double quantile_size(double share) const {
    std::vector<double> sizes;
    // an encoder at rest makes no residual, which tells nothing
    for (const double one : residual) {
      if (one != 0) sizes.push_back(std::abs(one));
    }
    if (sizes.empty()) return 0;
    const auto at = sizes.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(sizes.size()));
    std::nth_element(sizes.begin(), at, sizes.end());
    return *at;
  }
};

/// The usual time from one measurement to the next, and how long the motion is without the pauses [s].
struct Spacing {
  double usual = 0, duration = 0;
};

Spacing spacing_of(const std::vector<Measurement>& measurements) {
  std::vector<double> steps;
  for (std::size_t k = 1; k < measurements.size(); ++k) {
    const double step = measurements[k].time - measurements[k - 1].time;
    if (step > 0) steps.push_back(step);
  }
  constexpr double pause = 100;
  Spacing out{steps.empty() ? 0 : median(steps), 0};
  for (const double step : steps) out.duration += std::min(step, pause * out.usual);
  return out;
}

Roughness roughness_of(const std::vector<Measurement>& all, const std::vector<int>& positions) {
  Roughness out;
  const auto n = static_cast<int>(positions.size());
  const auto at = [&](int i) -> const Measurement& {
    return all[static_cast<std::size_t>(positions[static_cast<std::size_t>(i)])];
  };
  // the next position in a direction of another time, beyond the ends where there is none: where all times are there twice, what
  // stands next to a position in the list tells nothing of its motion
  const auto of_another_time = [&](int from, int direction) {
    int i = from;
    while (i >= 0 && i < n && at(i).time == at(from).time) i += direction;
    return i;
  };
  for (int k = 0; k < n; ++k) {
    std::array<int, 4> nodes{};
    nodes[1] = of_another_time(k, -1);
    nodes[2] = of_another_time(k, 1);
    if (nodes[1] < 0 || nodes[2] >= n) continue;
    nodes[0] = of_another_time(nodes[1], -1);
    nodes[3] = of_another_time(nodes[2], 1);
    if (nodes[0] < 0 || nodes[3] >= n) continue;
    double predicted = 0, variance = 1;
    for (const int i : nodes) {
      double weight = 1;
      for (const int j : nodes) {
        if (j != i) weight *= (at(k).time - at(j).time) / (at(i).time - at(j).time);
      }
      predicted += weight * at(i).value;
      variance += weight * weight;
    }
    out.measurement.push_back(positions[static_cast<std::size_t>(k)]);
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

/// Of the positions about their median.
double spread_of(const std::vector<Measurement>& measurements) {
  std::vector<double> values;
  for (const Measurement& one : measurements) {
    if (!one.velocity) values.push_back(one.value);
  }
  const double centre = median(values);
  double sum = 0;
  for (const double value : values) sum += square(value - centre);
  return std::sqrt(sum / static_cast<double>(values.size()));
}

/// What values and differences say before anything is fitted, by medians: outliers do not matter.
SmootherModel rough_model(const std::vector<Measurement>& all, const std::vector<int>& positions, const Roughness& roughness,
                          const SmootherFitOptions& options) {
  std::vector<double> rates;
  SmootherModel model;
  if (options.smoothness) model.smoothness = *options.smoothness;
  model.signal_stddev = spread_of(all);
  for (std::size_t k = 1; k < positions.size(); ++k) {
    const Measurement &here = all[static_cast<std::size_t>(positions[k])],
                      &before = all[static_cast<std::size_t>(positions[k - 1])];
    if (here.time > before.time) rates.push_back(std::abs((here.value - before.value) / (here.time - before.time)));
  }
  const double duration = spacing_of(all).duration;
  double rate = rates.empty() ? 0 : median(rates) / median_of_normal;
  if (!(rate > 0)) rate = model.signal_stddev * 10 / duration;
  // var dq = s² 2ν/ℓ² E ω², E ω² = 1/(2ν − 2)
  const double twice_order = 2.0 * static_cast<int>(model.smoothness) + 1;
  model.lengthscale = std::min(model.signal_stddev / rate * std::sqrt(twice_order / (twice_order - 2)), duration);
  model.noise_stddev =
      std::clamp(roughness.noise_stddev(), std::max(options.least_noise_stddev, 1e-6 * model.signal_stddev), model.signal_stddev);
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

/// What lengthscale, size and noises may be, in logarithms.
struct Box {
  VectorXd lower, upper;
  double time_stddev = 1;  // a τ that makes half of the noise, to start at
};

Box box_of(const std::vector<Measurement>& measurements, const SmootherModel& rough, double most_noise,
           const SmootherFitOptions& options) {
  const Spacing spacing = spacing_of(measurements);
  const double size = rough.signal_stddev, rate = size / rough.lengthscale;
  const double least_noise = std::max(options.least_noise_stddev, 1e-7 * size);
  const double least_velocity_noise = std::max(options.least_velocity_noise_stddev, 1e-6 * rate);
  // a motion's corner frequency, √(2ν)/ℓ, is at most half of what samples can tell
  const double order = static_cast<int>(rough.smoothness) + 0.5;
  const double shortest = 2 * std::sqrt(2 * order) * spacing.usual / std::numbers::pi;
  // no τ that is felt, or none at all where no rate is known
  double fastest = 0;
  for (const Measurement& one : measurements) fastest = std::max(fastest, std::abs(one.rate));
  const double least_time = fastest > 0 ? 0.01 * least_noise / fastest : 1;
  return {logarithms(shortest, 1e-3 * size, least_noise, least_velocity_noise, least_time),
          logarithms(std::max(100 * spacing.duration, 2 * shortest), 1e4 * size, std::max(most_noise, 2 * least_noise),
                     10 * rate + 2 * least_velocity_noise, fastest > 0 ? std::max(spacing.usual, 2 * least_time) : 1),
          fastest > 0 ? 0.5 * rough.noise_stddev / fastest : 1};
}

/// The maximum of the likelihood near fit.model.
void maximise(const std::vector<Measurement>& measurements, const Box& box, const std::atomic<bool>* stop, SmootherFit& fit) {
  const bool with_time = box.upper[4] > box.lower[4];
  const SmootherModel from = fit.model;
  const VectorXd start = logarithms(from.lengthscale, from.signal_stddev, from.noise_stddev, from.velocity_noise_stddev,
                                    from.time_stddev > 0 ? from.time_stddev : box.time_stddev)
                             .cwiseMax(box.lower)
                             .cwiseMin(box.upper);
  const auto n = static_cast<double>(measurements.size());
  const auto objective = [&](const VectorXd& x, VectorXd& gradient) {
    require_not_stopped(stop);
    VectorXd by_logarithm;
    const double value = log_likelihood(of_logarithms(x, from.smoothness), measurements, &by_logarithm);
    gradient = -by_logarithm / n;
    return -value / n;
  };
  LbfgsbOptions optimiser;
  optimiser.max_iterations = 200;
  optimiser.gradient_tolerance = 1e-6;
  optimiser.reduction_tolerance = 1e-11;
  const LbfgsbResult result = minimise(objective, start, box.lower, box.upper, optimiser);
  fit.model = of_logarithms(result.x, from.smoothness);
  if (!with_time) fit.model.time_stddev = 0;
  fit.log_likelihood = -result.value * n;
  fit.converged = result.converged;
  fit.evaluations += result.evaluations;
  fit.noise_at_least = result.x[2] <= box.lower[2] + 1e-9;
}

/// Without a τ that the measurements do not need: at a speed that is nearly constant it stands for the noise as well as σ does, and
/// where σ is at its least it may stand for all of it.
void leave_out_needless_time_noise(const std::vector<Measurement>& measurements, Box box, const std::atomic<bool>* stop,
                                   SmootherFit& fit) {
  constexpr double much = 2;      // of log likelihood, by one more parameter
  constexpr double steady = 0.9;  // of the mean square, by the mean
  const auto n = static_cast<double>(measurements.size());
  double mean = 0, mean_square = 0;  // of speeds
  for (const Measurement& one : measurements) {
    mean += std::abs(one.rate) / n;
    mean_square += square(one.rate) / n;
  }
  const bool is_steady = square(mean) > steady * mean_square;
  if (fit.model.time_stddev == 0 || !(fit.noise_at_least || is_steady)) return;
  SmootherFit without = fit;
  without.model.noise_stddev = std::hypot(fit.model.noise_stddev, fit.model.time_stddev * std::sqrt(mean_square));
  box.upper[4] = box.lower[4];
  maximise(measurements, box, stop, without);
  fit.evaluations = without.evaluations;
  if (without.log_likelihood > fit.log_likelihood - much) fit = without;
}

/// Stretches of consecutive measurements, evenly spread, about so many in all.
std::vector<Measurement> excerpt(const std::vector<Measurement>& measurements, std::size_t most) {
  if (measurements.size() <= most) return measurements;
  constexpr std::size_t n_stretches = 8;
  std::vector<Measurement> out;
  for (std::size_t k = 0; k < n_stretches; ++k) {
    const std::size_t first = k * (measurements.size() - most / n_stretches) / (n_stretches - 1);
    out.insert(out.end(), measurements.begin() + static_cast<std::ptrdiff_t>(first),
               measurements.begin() + static_cast<std::ptrdiff_t>(first + most / n_stretches));
  }
  return out;
}

/// The likeliest of the maxima near several lengthscales: one alone may end where all motion is noise, or all noise motion.
void search(const std::vector<Measurement>& measurements, const Box& box, const SmootherModel& rough,
            const SmootherFitOptions& options, SmootherFit& fit) {
  constexpr std::size_t most = 2000;
  const std::vector<Measurement> some = excerpt(measurements, most);
  SmootherFit best;
  best.log_likelihood = -std::numeric_limits<double>::infinity();
  std::vector<SmootherModel> starts;
  if (fit.evaluations > 0) starts.push_back(fit.model);
  std::vector<Smoothness> orders = {Smoothness::matern92, Smoothness::matern72};
  if (options.smoothness) orders = {*options.smoothness};
  for (const Smoothness order : orders) {
    for (const double factor : {1.0, 0.25, 4.0}) {
      SmootherModel& start = starts.emplace_back(rough);
      start.smoothness = order;
      start.lengthscale *= factor;
      start.signal_stddev *= factor;  // the same velocities
    }
  }
  best.evaluations = fit.evaluations;
  for (const SmootherModel& start : starts) {
    SmootherFit one;
    one.model = start;
    one.evaluations = best.evaluations;
    maximise(some, box, options.stop, one);
    best.evaluations = one.evaluations;
    if (one.log_likelihood > best.log_likelihood) best = one;
  }
  fit = best;
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
  double log_likelihood = 0;  // of those that are used
};

Hindsight hindsight_of(const std::vector<Measurement>& measurements, const std::vector<bool>& used, const SmootherModel& model) {
  std::vector<double> times;
  for (const Measurement& one : measurements) {
    if (times.empty() || one.time > times.back()) times.push_back(one.time);
  }
  Hindsight out{std::vector<double>(measurements.size()), std::vector<double>(measurements.size())};
  std::size_t k = measurements.size();
  const auto look_back = [&](Index at, const Eigen::Vector3d& mean, const Eigen::Matrix3d& covariance) {
    while (k > 0 && measurements[k - 1].time == times[static_cast<std::size_t>(at)]) {
      const Measurement& one = measurements[--k];
      const int row = one.velocity ? 1 : 0;
      const double read = one.noise_factor * (one.velocity ? model.velocity_noise_stddev : model.noise_stddev);
      const double noise = square(read) + (one.velocity ? 0 : square(model.time_stddev * one.rate));
      const double known = covariance(row, row);
      const double residual = one.value - mean[row];
      // without y the rest says m + (m − y) V/(R − V) with variance R V/(R − V)
      const double variance = used[k] ? noise - known : noise + known;
      constexpr double alone = 1e-3;  // the others say next to nothing
      out.sizes[k] = variance > alone * noise ? std::abs(residual) / std::sqrt(variance) : 0;
      out.rates[k] = mean[1];
    }
  };
  out.log_likelihood =
      smooth_each(model, those_used(measurements, used), Eigen::Map<const VectorXd>(times.data(), std::ssize(times)), look_back);
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

/// Which measurements are used. All but those that the others contradict.
class Trust {
 public:
  Trust(const std::vector<Measurement>& measurements, const std::vector<int>& positions, double noise_stddev, double threshold)
      : threshold_(threshold),
        used_(measurements.size(), true),
        accused_(measurements.size(), false),
        gross_(accused_),
        settled_(accused_) {
    if (!(threshold > 0)) return;
    drop_gross_errors(measurements, positions, noise_stddev);
    // nothing beyond the ends says whether they are right: they are taken back, inner ones first, if all others agree with them
    constexpr std::size_t least = 20;
    const std::size_t n = positions.size();
    if (n < least) return;
    for (const auto& [inner, outer] : {std::pair(positions[1], positions[0]), std::pair(positions[n - 2], positions[n - 1])}) {
      ends_.emplace_back(inner, outer);
      for (const int k : {inner, outer}) used_[static_cast<std::size_t>(k)] = false;
    }
  }

  [[nodiscard]] const std::vector<bool>& used() const { return used_; }

  /// Leaves out what hindsight distrusts, and takes back, once, what it trusts after all. Returns whether anything changed.
  bool choose_again(const std::vector<double>& sizes) {
    if (!(threshold_ > 0)) return false;
    const std::vector<bool> before = used_;
    std::vector<double> suspected = sizes;
    for (std::size_t k = 0; k < sizes.size(); ++k) {
      if (!used_[k] && sizes[k] <= limit(k) && !settled_[k]) {
        used_[k] = true;
        settled_[k] = accused_[k];
      }
      if (settled_[k] || !before[k] || sizes[k] <= limit(k)) suspected[k] = 0;
    }
    // what is far from a guess may be near, and yet contradict its neighbour
    for (const auto& [inner, outer] : ends_) {
      if (used_[inner] && !before[inner]) used_[outer] = before[outer];
    }
    for (const int k : peaks(suspected, threshold_)) leave_out(static_cast<std::size_t>(k));
    take_back_what_is_not_alone(sizes);
    return used_ != before;
  }

 private:
  /// Leaves out errors far above everything else, which would hide the smaller ones: the largest of each neighbourhood, and again.
  void drop_gross_errors(const std::vector<Measurement>& all, std::vector<int> positions, double noise_stddev) {
    constexpr int max_rounds = 5;
    for (int round = 0; round < max_rounds; ++round) {
      const Roughness roughness = roughness_of(all, positions);
      std::vector<double> sizes(used_.size(), 0);
      for (std::size_t k = 0; k < roughness.measurement.size(); ++k)
        sizes[static_cast<std::size_t>(roughness.measurement[k])] = std::abs(roughness.residual[k]) / noise_stddev;
      const std::vector<int> dropped = peaks(sizes, std::max(gross, threshold_));
      if (dropped.empty()) break;
      for (const int k : dropped) leave_out(static_cast<std::size_t>(k));
      std::erase_if(positions, [&](int k) { return !used_[static_cast<std::size_t>(k)]; });
    }
    // many together may be a rough place: hindsight decides
    gross_ = accused_;
    for (const std::vector<std::size_t>& together : neighbourhoods_left_out()) {
      for (const std::size_t k : together) gross_[k] = accused_[k] = together.size() <= 2;
    }
  }

  /// In standard deviations; beyond an end a motion is guessed.
  [[nodiscard]] double limit(std::size_t k) const {
    const bool is_end = std::ranges::any_of(ends_, [k](const auto& end) { return k == end.first || k == end.second; });
    return (is_end ? 2 : 1) * threshold_;
  }

  void leave_out(std::size_t k) {
    used_[k] = false;
    accused_[k] = true;
  }

  /// Trusts for good what stands out a little and not alone: errors are single, but where a motion is rougher than elsewhere, or
  /// begins, each sample that is left out leaves the next one to stand out.
  void take_back_what_is_not_alone(const std::vector<double>& sizes) {
    for (const std::vector<std::size_t>& together : neighbourhoods_left_out()) {
      const bool little =
          std::all_of(together.begin(), together.end(), [&](std::size_t k) { return !gross_[k] && sizes[k] <= gross; });
      if (!little || together.size() == 1) continue;
      for (const std::size_t k : together) used_[k] = settled_[k] = true;
    }
  }

  [[nodiscard]] std::vector<std::vector<std::size_t>> neighbourhoods_left_out() const {
    constexpr std::size_t gap = 2;
    std::vector<std::vector<std::size_t>> out;
    for (std::size_t k = 0; k < used_.size(); ++k) {
      if (used_[k]) continue;
      if (out.empty() || k - out.back().back() > gap) out.emplace_back();
      out.back().push_back(k);
    }
    return out;
  }

  static constexpr double gross = 20;  // standard deviations: what is no end of a distribution

  double threshold_;
  std::vector<std::pair<std::size_t, std::size_t>> ends_;  // the last but one and the last
  std::vector<bool> used_, accused_, gross_, settled_;
};

/// The kurtosis of how far measurements are off what the others say.
double kurtosis_of(const std::vector<double>& sizes, const std::vector<bool>& used) {
  double n = 0, second = 0, fourth = 0;
  for (std::size_t k = 0; k < sizes.size(); ++k) {
    if (!used[k]) continue;
    ++n;
    second += square(sizes[k]);
    fourth += square(square(sizes[k]));
  }
  return second > 0 ? n * fourth / square(second) : 0;
}

/// What is said of measurements before anything is fitted.
struct FirstLook {
  SmootherModel rough;
  double most_noise_stddev;
  Trust trust;
};

FirstLook first_look(const std::vector<Measurement>& measurements, const SmootherFitOptions& options) {
  const std::vector<int> positions = positions_among(measurements);
  const Roughness roughness = roughness_of(measurements, positions);
  const SmootherModel rough = rough_model(measurements, positions, roughness, options);
  return {rough, roughness.most_noise_stddev(), Trust(measurements, positions, rough.noise_stddev, options.outlier_threshold)};
}

}  // namespace

SmootherFit fit_smoother(std::vector<Measurement> measurements, const SmootherFitOptions& options) {
  check_measurements({}, measurements, "fit_smoother");
  auto [rough, most_noise_stddev, trust] = first_look(measurements, options);
  // of a long log a part tells the model if it moves as the whole does, and all that is left is to judge the samples
  constexpr std::size_t most_fitted = 20'000;
  constexpr double as_much = 0.5;
  const std::vector<Measurement> part = excerpt(measurements, most_fitted);
  const bool is_long = part.size() < measurements.size() &&
                       std::ranges::count(part, false, &Measurement::velocity) >= least_positions &&
                       spread_of(part) > as_much * rough.signal_stddev;
  const bool is_known = options.model.has_value() || is_long;
  SmootherFit fit;
  if (options.model) {
    fit.model = *options.model;
  } else if (is_long) {
    fit = fit_smoother(part, options);
  }
  bool with_time = options.estimate_time_stddev;
  constexpr int max_rounds = 20;
  for (int round = 0; round < max_rounds; ++round) {
    require_not_stopped(options.stop);
    if (!is_known) {
      const std::vector<Measurement> some = those_used(measurements, trust.used());
      const Box box = box_of(some, rough, most_noise_stddev, options);
      // errors that are gone by the second round have led the first astray
      if (round < 2) search(some, box, rough, options, fit);
      maximise(some, box, options.stop, fit);
      leave_out_needless_time_noise(some, box, options.stop, fit);
    }
    const Hindsight hindsight = hindsight_of(measurements, trust.used(), fit.model);
    fit.kurtosis = kurtosis_of(hindsight.sizes, trust.used());
    if (is_known) fit.log_likelihood = hindsight.log_likelihood;  // of all, not of a part
    bool changed = trust.choose_again(hindsight.sizes);
    // the first round knows no rates, and so has no τ
    constexpr double share = 0.5;  // of the Nyquist frequency
    if (round == 0 && !is_known) {
      const double step = spacing_of(measurements).usual;
      if (bandwidth_of(fit.model, step) > share / (2 * step)) with_time = false;
    }
    if (with_time) {
      for (std::size_t k = 0; k < measurements.size(); ++k) measurements[k].rate = hindsight.rates[k];
      changed = changed || (round == 0 && !is_long);
    }
    if (!changed) break;
  }
  fit.outliers.clear();
  for (std::size_t k = 0; k < measurements.size(); ++k) {
    if (!trust.used()[k]) fit.outliers.push_back(static_cast<int>(k));
  }
  fit.trusted = those_used(measurements, trust.used());
  return fit;
}

double resolution_of(const std::vector<double>& values) {
  std::vector<double> sorted = values;
  std::sort(sorted.begin(), sorted.end());
  if (sorted.empty()) return 0;
  constexpr double rounding = 1e-12, tolerance = 0.05;  // of the values, of a step
  constexpr double share = 0.95;                        // the rest are errors
  constexpr std::size_t least_differences = 4;
  double usual = sorted.front();  // the value that is there most often
  std::vector<double> values_seen, seen_often;
  std::size_t longest = 0;
  for (std::size_t first = 0, last = 0; first < sorted.size(); first = last) {
    const double same = sorted[first] + rounding * std::max(std::abs(sorted.front()), std::abs(sorted.back()));
    while (last < sorted.size() && sorted[last] <= same) ++last;
    values_seen.push_back(sorted[first]);
    if (last - first > 1) seen_often.push_back(sorted[first]);
    if (last - first > longest) usual = sorted[first];
    longest = std::max(longest, last - first);
  }
  if (values_seen.size() <= least_differences) return 0;
  // an error is seldom there twice
  if (seen_often.size() > least_differences) values_seen = seen_often;
  std::vector<double> differences;
  for (std::size_t k = 1; k < values_seen.size(); ++k) differences.push_back(values_seen[k] - values_seen[k - 1]);
  std::sort(differences.begin(), differences.end());
  const auto is_step = [&](double step) {
    const auto on_grid = std::count_if(sorted.begin(), sorted.end(), [&](double value) {
      return std::abs((value - usual) / step - std::round((value - usual) / step)) <= tolerance;
    });
    return static_cast<double>(on_grid) >= share * static_cast<double>(sorted.size());
  };
  // the smallest differences are one step where values are many, errors aside
  for (const double at : {0.0, 0.02, 0.05, 0.1, 0.2}) {
    const double least = differences[static_cast<std::size_t>(at * static_cast<double>(differences.size()))];
    for (const int parts : {1, 2, 3}) {
      if (is_step(least / parts)) return least / parts;
    }
  }
  return 0;
}

}  // namespace gp2
