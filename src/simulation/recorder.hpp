#pragma once

#include <span>

#include "simulation/right_hand_side.hpp"

namespace gp2 {

/// Writes the rows of a trajectory at the times asked for.
class Recorder {
 public:
  Recorder(const SimulateOptions& options, StateLayout layout);

  [[nodiscard]] bool is_done() const { return next_ == options_.times.size(); }
  [[nodiscard]] bool is_due(double t) const { return !is_done() && options_.times[next_] == t; }
  /// The times before `end` that are not written yet.
  [[nodiscard]] std::span<const double> times_before(double end) const;

  /// @param recorded  options.record there; empty without
  void write(const Eigen::VectorXd& state, const PhasePoint& at, const Eigen::VectorXd& recorded);
  [[nodiscard]] Eigen::Index n_written() const { return next_; }
  /// Only the first n rows stay.
  void keep(Eigen::Index n) { next_ = n; }
  /// Whether a motion has come beyond what is written.
  [[nodiscard]] bool is_behind(double t) const { return next_ > 0 && t > options_.times[next_ - 1]; }

  /// The rows that are written.
  Trajectory take();

 private:
  const SimulateOptions& options_;
  const StateLayout layout_;
  Trajectory out_;
  Eigen::Index next_ = 0;  // the row that is to be written next
};

}  // namespace gp2
