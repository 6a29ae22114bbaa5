#pragma once

#include <atomic>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// The kernel of a motion q(t): Matérn of order ν, in time, so that q has ν − ½ derivatives.
enum class Smoothness { matern52 = 2, matern72 = 3, matern92 = 4 };

/// "5/2", "7/2", "9/2": the words of commands.
const std::vector<std::string>& smoothness_words();
std::optional<Smoothness> smoothness_of(const std::string& word);

/// A prior on one motion, q(t) = a stationary Gaussian process of mean zero, and the noise of what is measured of it. With
/// r = √(2ν) |t − t′| / ℓ the covariance of q(t) and q(t′) is s² e^(−r) times
///
///     1 + r + r²/3  (5/2),    1 + r + 2r²/5 + r³/15  (7/2),    1 + r + 3r²/7 + 2r³/21 + r⁴/105  (9/2).
struct SmootherModel {
  Smoothness smoothness = Smoothness::matern92;
  double lengthscale = 1;            // ℓ [s]
  double signal_stddev = 1;          // s, of q
  double noise_stddev = 1;           // of a measured q, > 0
  double velocity_noise_stddev = 1;  // of a measured dq, > 0
  double time_stddev = 0;            // τ, of the instant at which a q is read, ≥ 0 [s]

  static constexpr int n_parameters = 5;
};

/// Up to which frequency a motion stands out of the noise of positions that are so far apart in time [Hz].
double bandwidth_of(const SmootherModel& model, double time_step);

/// One number read off a motion.
struct Measurement {
  double time = 0;          // [s]
  double value = 0;         // q or dq
  bool velocity = false;    // dq
  double noise_factor = 1;  // its noise, in multiples of the model's
  double rate = 0;          // about dq where q is measured: with τ it makes noise of variance (noise_factor σ)² + (τ rate)²
};

/// log p(values) of a model, exactly, in time and memory that grow with the number of measurements only.
/// @param measurements  in order of time; several at one time are several measurements of one motion
/// @param gradient      where given: by the logarithms of lengthscale, signal_stddev, noise_stddev, velocity_noise_stddev,
/// time_stddev (5)
/// @throws InputError when there is none, times run backwards, or a number is not finite or not positive where it must be.
double log_likelihood(const SmootherModel& model, const std::vector<Measurement>& measurements,
                      Eigen::VectorXd* gradient = nullptr);

/// (q, dq, ddq) at each of the times asked for: what all measurements, before and after, say of it.
struct SmoothedMotion {
  Eigen::Matrix3Xd mean;
  std::vector<Eigen::Matrix3d> covariance;
};

/// The posterior of q, dq and ddq: a Kalman filter and a Rauch–Tung–Striebel smoother on the linear stochastic differential
/// equation that the kernel is the covariance of (Hartikainen & Särkkä 2010), covariances as square roots throughout. It is the
/// Gaussian process regression, to rounding, and has no phase: reversing time reverses it.
/// @param times  increasing; any, between the measurements or beyond them [s]
/// @throws InputError as log_likelihood.
SmoothedMotion smooth(const SmootherModel& model, const std::vector<Measurement>& measurements, const Eigen::VectorXd& times);

struct SmootherFitOptions {
  std::optional<Smoothness> smoothness = {};  // none: the likelier of 7/2 and 9/2
  std::optional<SmootherModel> model = {};    // known: measurements are judged by it; none: it is found
  double least_noise_stddev = 0;              // of a measured q
  double least_velocity_noise_stddev = 0;     // of a measured dq
  /// A measurement that is farther from what the others say of it than this many standard deviations of that difference is
  /// distrusted; 0: none is.
  double outlier_threshold = 5;
  /// Also estimates τ: the faster a joint, the more a sample suffers from being taken a little early or late. Not where the motion
  /// stands out of the noise up to half the Nyquist frequency: its fast places, where τ is felt, would pass for noise.
  bool estimate_time_stddev = true;
  const std::atomic<bool>* stop = nullptr;  // set: ends before long, by throwing
};

/// A model and what it was told.
struct SmootherFit {
  SmootherModel model;
  double log_likelihood = 0;  // of those that are trusted
  bool converged = false;
  bool noise_at_least = false;       // the noise of q ended at the least that the options allow
  double kurtosis = 0;               // of how far measurements are off the others; 3 where the motion is as rough everywhere
  std::vector<Measurement> trusted;  // measurements that are not outliers, with their rates
  std::vector<int> outliers;         // numbers of those that are distrusted, in order
  int evaluations = 0;               // of the likelihood
};

/// Lengthscale, size and noise of a motion by maximum likelihood, without the measurements that the others contradict. The
/// farthest of its neighbourhood is taken away first, the model fitted anew, and a measurement taken back that agrees after all.
/// @throws InputError as log_likelihood, for fewer than 5 positions, and when all positions are the same.
/// @throws NumericalError when stopped.
SmootherFit fit_smoother(std::vector<Measurement> measurements, const SmootherFitOptions& options = {});

/// The step of an encoder: of whole multiples of it 95 of 100 values are off the one that is there most often; 0 where there is
/// none.
double resolution_of(const std::vector<double>& values);

}  // namespace gp2
