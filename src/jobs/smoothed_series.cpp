#include "jobs/smoothed_series.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "gp2/base/statistics.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Matrix3Xd;
using Eigen::RowVectorXd;
using Eigen::VectorXd;

namespace {

std::vector<double> spaces_of(const std::vector<Measurement>& used) {
  std::vector<double> spaces;
  for (std::size_t k = 1; k < used.size(); ++k) {
    if (used[k].time > used[k - 1].time) spaces.push_back(used[k].time - used[k - 1].time);
  }
  return spaces;
}

/// A model whose noise is that of the readings and of their times together, at the usual speed.
SmootherModel with_noise_of_times(SmootherModel model, const std::vector<Measurement>& used) {
  double squares = 0, n = 0;
  for (const Measurement& one : used) {
    if (!one.velocity) squares += one.rate * one.rate, ++n;
  }
  model.noise_stddev = std::hypot(model.noise_stddev, model.time_stddev * std::sqrt(squares / std::max(1.0, n)));
  return model;
}

/// p = q̂ − r with r̈ + 2ω ṙ + ω² r = misfit, which is linear between the times; r is at rest at the first.
/// @param motion  q̂ and its derivatives
Matrix3Xd motion_without(const Matrix3Xd& motion, const VectorXd& times, const RowVectorXd& misfit, double w) {
  Matrix3Xd course = motion;
  double r = 0, v = 0;
  for (Index i = 0; i < times.size(); ++i) {
    if (i > 0) {
      // a + b t solves it but for its start, which (A + B t) e^(−ωt) makes good
      const double h = times[i] - times[i - 1];
      const double b = (misfit[i] - misfit[i - 1]) / h / (w * w), a = misfit[i - 1] / (w * w) - 2 * b / w;
      const double A = r - a, B = v - b + w * A, decay = std::exp(-w * h);
      r = a + b * h + (A + B * h) * decay;
      v = b + (B - w * (A + B * h)) * decay;
    }
    course.col(i) -= Eigen::Vector3d(r, v, misfit[i] - 2 * w * v - w * w * r);
  }
  return course;
}

/// Positions about a course and their own mean there, velocities about its.
std::pair<std::vector<Measurement>, double> measurements_about(const Matrix3Xd& course, const VectorXd& times,
                                                               const Channel& channel) {
  std::vector<Measurement> measurements = channel.measurements;
  Index at = 0;
  double sum = 0, n = 0;
  for (Measurement& one : measurements) {
    while (times[at] < one.time) ++at;
    one.value += one.velocity ? -course(1, at) : channel.mean - course(0, at);
    if (!one.velocity) sum += one.value, ++n;
  }
  for (Measurement& one : measurements) one.value -= one.velocity ? 0 : sum / n;
  return {std::move(measurements), sum / n};
}

/// Log likelihood, in which an outlier counts as a sample that is just trusted.
double score(const SmootherFit& fit, const SmootherFitOptions& options) {
  const double just_trusted = -0.5 * options.outlier_threshold * options.outlier_threshold -
                              std::log(fit.model.noise_stddev * std::sqrt(2 * std::numbers::pi));
  return fit.log_likelihood + static_cast<double>(fit.outliers.size()) * just_trusted;
}

}  // namespace

void SmoothedSeries::fit_to(std::vector<Measurement> measurements, const SmootherFitOptions& options) {
  fit = fit_smoother(std::move(measurements), options);
  model = fit.model;
  kurtosis = fit.kurtosis;
}

// Whether the learned motion helps is asked of u as it is: a motion that goes by variances has the noise of the samples wherever
// little is learned. What is taken then has as little of u, beside q̂, as their variances say.
void SmoothedSeries::take_learned(const LearnedSeries& learned, const SmootherFitOptions& options) {
  const VectorXd& times = learned.times;
  SmoothedMotion plain = smooth(fit.model, fit.trusted, times);
  Matrix3Xd motion = plain.mean;
  motion.row(0).array() += channel.mean;
  RowVectorXd misfit = plain.mean.row(2) - learned.mean;
  // as slow as drift needs: what follows the samples below ω has their noise
  constexpr double share = 0.01;
  const double bandwidth = bandwidth_of(with_noise_of_times(model, fit.trusted), median(spaces_of(fit.trusted)));
  const double w = 2 * std::numbers::pi * share * std::max(bandwidth, 1 / times[times.size() - 1]);

  const SmootherFit tried =
      fit_smoother(measurements_about(motion_without(motion, times, misfit, w), times, channel).first, options);
  const double by_learned = score(tried, options) - score(fit, options);
  if (!(by_learned > 0)) return;
  for (Index i = 0; i < times.size(); ++i) {
    const double known = plain.covariance[static_cast<std::size_t>(i)](2, 2), stddev = learned.stddev[i];
    misfit[i] *= known / (known + stddev * stddev);
  }
  course = motion_without(motion, times, misfit, w);
  const auto [measurements, mean] = measurements_about(course, times, channel);
  fit = fit_smoother(measurements, options);
  channel.mean = mean;
  gain = by_learned;
  covariance_without = std::move(plain.covariance);
}

bool SmoothedSeries::is_short() const {
  constexpr std::size_t least_for_own_model = 40;
  return fit.trusted.size() + fit.outliers.size() < least_for_own_model;
}

void SmoothedSeries::share_model(const SmootherModel& other) {
  model = fit.model = other;
  shared_model = true;
}

void SmoothedSeries::smooth_at(const VectorXd& times, const WriteMotion& write) const {
  const bool has_course = course.size() > 0;
  smooth_each(fit.model, fit.trusted, times, [&](Index i, const Eigen::Vector3d& smoothed, const Eigen::Matrix3d& covariance) {
    Eigen::Vector3d motion = smoothed;
    motion[0] += channel.mean;
    if (has_course) motion += course.col(i);
    write(i, motion, has_course ? covariance_without[static_cast<std::size_t>(i)] : covariance);
  });
}

std::vector<Measurement> SmoothedSeries::positions(const VectorXd& times) const {
  std::vector<Measurement> positions;
  Index at = 0;
  for (const Measurement& one : fit.trusted) {
    if (one.velocity) continue;
    positions.push_back(one);
    positions.back().value += channel.mean;
    if (course.size() == 0) continue;
    while (times[at] < one.time) ++at;
    positions.back().value += course(0, at);
  }
  return positions;
}

DerivedSeries SmoothedSeries::report() const {
  const std::vector<Measurement>& used = fit.trusted;
  DerivedSeries out;
  out.coordinate = coordinate;
  out.episode = episode;
  out.model = model;
  const SmootherModel usual_model = with_noise_of_times(model, used);
  // what the times add may be noise of the readings, which at one speed cannot be distinguished
  const bool noise_at_least = fit.noise_at_least && usual_model.noise_stddev < 2 * model.noise_stddev;
  out.noise_at_least = noise_at_least && channel.resolution > 0;
  out.noise_unseen = noise_at_least && channel.resolution == 0;
  out.shared_model = shared_model;
  out.kurtosis = kurtosis;
  out.gain = gain;
  out.resolution = channel.resolution;
  out.used = static_cast<int>(used.size());
  out.has_velocities = std::ranges::any_of(used, &Measurement::velocity);
  out.missing = channel.missing;
  out.repeated = channel.repeated;
  out.outliers = static_cast<int>(fit.outliers.size());
  out.wraps = channel.wraps;
  const std::vector<double> spaces = spaces_of(used);
  const double usual = median(spaces);
  for (const double space : spaces) {
    if (space <= 3 * usual) continue;
    ++out.gaps;
    out.longest_gap = std::max(out.longest_gap, space);
  }
  out.rate = 1 / usual;
  out.bandwidth = bandwidth_of(usual_model, usual);
  return out;
}

}  // namespace gp2
