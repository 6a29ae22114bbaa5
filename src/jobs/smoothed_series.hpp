#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/jobs/derive.hpp"
#include "gp2/smoothing/smoother.hpp"
#include "jobs/raw_log.hpp"
#include "smoothing/smooth_each.hpp"

namespace gp2 {

/// The accelerations that were learned for one coordinate, at the samples of one episode (n each).
struct LearnedSeries {
  Eigen::VectorXd times;
  Eigen::RowVectorXd mean, stddev;
};

/// A coordinate of one episode: what was measured, and the model that it is smoothed with.
struct SmoothedSeries {
  int coordinate = 0, episode = 0;
  Channel channel;
  SmootherFit fit;            // about the course where there is one
  SmootherModel model;        // of the positions about their mean
  bool shared_model = false;  // whether the model is that of other episodes
  double kurtosis = 0;
  Eigen::Matrix3Xd course;                               // the learned motion that the fit is about; empty: the mean
  double gain = 0;                                       // by it, in log likelihood
  std::vector<Eigen::Matrix3d> covariance_without = {};  // that of the motion smoothed without the course, where there is one

  /// @param measurements  of the channel
  void fit_to(std::vector<Measurement> measurements, const SmootherFitOptions& options);
  /// Smooths about the learned motion where that makes the samples likelier. Reads the channel's measurements.
  /// @param options  as of fit_to
  void take_learned(const LearnedSeries& learned, const SmootherFitOptions& options);

  /// Whether the samples are too few to tell their own smoothness.
  [[nodiscard]] bool is_short() const;
  void share_model(const SmootherModel& other);

  /// The motion, and its covariance without the course, from the last time to the first.
  /// @param times  those of the samples, where there is a course
  void smooth_at(const Eigen::VectorXd& times, const WriteMotion& write) const;
  /// The positions that are trusted, as they were logged but for turns.
  /// @param times  as of smooth_at
  [[nodiscard]] std::vector<Measurement> positions(const Eigen::VectorXd& times) const;
  /// All but `start` and `positions`.
  [[nodiscard]] DerivedSeries report() const;
};

}  // namespace gp2
