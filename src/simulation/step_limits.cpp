#include "simulation/step_limits.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

double StepLimits::smallest(double t) const {
  constexpr double resolution = 16 * std::numeric_limits<double>::epsilon();
  return std::max(resolution * std::abs(t), resolution * std::abs(end()));
}

bool StepLimits::is_at_once(double duration, double t) const {
  constexpr double shortest = 1e3;
  return duration <= std::max(shortest * smallest(t), options_.relative_tolerance * (end() - options_.times[0]));
}

void StepLimits::require_progress(double t, int accepted, int rejected) {
  if (options_.stop != nullptr && *options_.stop) throw NumericalError(fmt::format("simulate: stopped at t = {:.6g}", t));
  const int taken = accepted + rejected;
  if (taken <= options_.max_steps / 2) t_halfway_ = t;
  if (taken >= options_.max_steps) {
    // steps that shrink: the second half of them came a quarter as far as the first, or less
    const bool is_held_up = t - t_halfway_ < 0.25 * (t_halfway_ - options_.times[0]);
    if (is_held_up) {
      throw NumericalError(fmt::format(
          "simulate: {} steps reach no further than t = {:.6g} of {:.6g}, half of them from t = {:.6g} on: a force that "
          "jumps where a body comes to rest is to be written with sign(v) or v/sqrt(v^2 + w^2), or smoothed, say "
          "tanh(v/0.01){}; else {}",
          options_.max_steps, t, end(), t_halfway_,
          has_conditions_ ? "; a constraint that holds at the very edge of its condition is to be a contact" : "",
          options_.max_steps_advice));
    }
    throw NumericalError(fmt::format("simulate: {} steps reach no further than t = {:.6g} of {:.6g}: {}", options_.max_steps, t,
                                     end(), options_.max_steps_advice));
  }
  constexpr int enough = 1000;
  if (accepted == enough) require_resolved(t, accepted);
}

void StepLimits::require_size(double size, double t, int accepted, const std::string& fault) const {
  if (size > smallest(t)) return;
  require_resolved(t, accepted);
  throw NumericalError(fmt::format("simulate: the step size fell to {:.2g} s at t = {:.6g}: {}", size, t, fault));
}

// of an end at which doubles are farther apart than the steps so far
void StepLimits::require_resolved(double t, int accepted) const {
  const double step = (t - options_.times[0]) / std::max(accepted, 1);
  if (step > smallest(t) || step == 0) return;
  throw NumericalError(
      fmt::format("simulate: at t = {:.6g} the motion needs steps of {:.2g} s; the end, {:.6g}, is so far that times there are "
                  "not told apart so well: let the motion end sooner",
                  t, step, end()));
}

}  // namespace gp2
