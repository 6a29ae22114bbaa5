#pragma once

#include <string>

#include "gp2/simulate.hpp"

namespace gp2 {

/// How small steps may be, and how many: where a motion is given up that gets no further.
class StepLimits {
 public:
  /// @param has_conditions  whether constraints come and go by their conditions, of which the advice then tells
  StepLimits(const SimulateOptions& options, bool has_conditions) : options_(options), has_conditions_(has_conditions) {}

  [[nodiscard]] double end() const { return options_.times[options_.times.size() - 1]; }
  /// The size that steps from t must exceed.
  [[nodiscard]] double smallest(double t) const;
  /// Whether a duration that ends or starts at t is of the motion what the tolerance is of a state.
  [[nodiscard]] bool is_at_once(double duration, double t) const;

  /// @throws NumericalError where the motion was told to stop, or has taken all steps that it may, or steps too small for the doubles
  /// of its end.
  void require_progress(double t, int accepted, int rejected);
  /// Of the next step. @throws NumericalError, which tells of the fault of the last try, where its size is too small.
  void require_size(double size, double t, int accepted, const std::string& fault) const;

 private:
  void require_resolved(double t, int accepted) const;

  const SimulateOptions& options_;
  const bool has_conditions_;
  double t_halfway_ = 0;  // when half of the steps were taken
};

}  // namespace gp2
