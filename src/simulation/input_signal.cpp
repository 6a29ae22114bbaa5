#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

InputSignal::InputSignal(VectorXd times, MatrixXd values, const std::vector<Actuator>& actuators)
    : times_(std::move(times)),
      values_(std::move(values)),
      delay_(VectorXd::Zero(values_.rows())),
      lag_(VectorXd::Zero(values_.rows())),
      acting_(values_) {
  const Index n = times_.size();
  if (n == 0 || values_.cols() != n) {
    throw InputError(fmt::format("inputs: {} times for {} columns of values; give as many, at least one", n, values_.cols()));
  }
  if (!times_.allFinite() || !values_.allFinite()) throw InputError("inputs: a time or a value is not a finite number");
  for (Index k = 1; k < n; ++k) {
    if (times_[k] > times_[k - 1]) continue;
    throw InputError(fmt::format("inputs: times must increase, but {} follows {}", times_[k], times_[k - 1]));
  }
  if (!actuators.empty() && std::ssize(actuators) != values_.rows()) {
    throw InputError(fmt::format("inputs: {} actuators for {} inputs", actuators.size(), values_.rows()));
  }
  for (Index j = 0; j < std::ssize(actuators); ++j) {
    const Actuator& actuator = actuators[static_cast<std::size_t>(j)];
    delay_[j] = actuator.delay.value;
    lag_[j] = actuator.lag.value;
    for (Index k = 1; k < n; ++k)
      acting_(j, k) = lagged(acting_(j, k - 1), values_(j, k - 1), values_(j, k), times_[k] - times_[k - 1], lag_[j]);
  }
  find_kinks();
}

// where the slope of a command changes by more than rounding; it is zero outside the table
void InputSignal::find_kinks() {
  constexpr double rounding = 1e-9;
  const Index n = times_.size();
  const VectorXd size = values_.cwiseAbs().rowwise().maxCoeff();
  VectorXd slope_before = VectorXd::Zero(values_.rows());
  for (Index k = 0; k < n; ++k) {
    VectorXd slope_after = VectorXd::Zero(values_.rows());
    if (k + 1 < n) slope_after = (values_.col(k + 1) - values_.col(k)) / (times_[k + 1] - times_[k]);
    double span = std::numeric_limits<double>::infinity();
    if (k > 0) span = std::min(span, times_[k] - times_[k - 1]);
    if (k + 1 < n) span = std::min(span, times_[k + 1] - times_[k]);
    for (Index j = 0; n > 1 && j < values_.rows(); ++j) {
      if (std::abs(slope_after[j] - slope_before[j]) * span > rounding * size[j]) kinks_.push_back(times_[k] + delay_[j]);
    }
    slope_before = slope_after;
  }
  std::sort(kinks_.begin(), kinks_.end());
  kinks_.erase(std::unique(kinks_.begin(), kinks_.end()), kinks_.end());
}

InputSignal::Place InputSignal::place(Index input, double t) const {
  const Index after = std::upper_bound(times_.begin(), times_.end(), t) - times_.begin();
  if (after == 0) return {0, t - times_[0], values_(input, 0)};
  const double since = t - times_[after - 1], before = values_(input, after - 1);
  if (after == times_.size()) return {after - 1, since, before};
  const double share = since / (times_[after] - times_[after - 1]);
  return {after - 1, since, (1 - share) * before + share * values_(input, after)};
}

void InputSignal::evaluate(double t, Eigen::Ref<VectorXd> u) const {
  if (is_zero()) return u.setZero(), void();
  require_shape("inputs: u", u, values_.rows(), 1);
  for (Index j = 0; j < values_.rows(); ++j) {
    const Place arriving = place(j, t - delay_[j]);
    u[j] = arriving.since < 0
               ? arriving.command
               : lagged(acting_(j, arriving.before), values_(j, arriving.before), arriving.command, arriving.since, lag_[j]);
  }
}

void InputSignal::command(double t, Eigen::Ref<VectorXd> u) const {
  if (is_zero()) return u.setZero(), void();
  require_shape("inputs: u", u, values_.rows(), 1);
  for (Index j = 0; j < values_.rows(); ++j) u[j] = place(j, t).command;
}

double InputSignal::next_kink(double t) const {
  const auto kink = std::upper_bound(kinks_.begin(), kinks_.end(), t);
  return kink == kinks_.end() ? std::numeric_limits<double>::infinity() : *kink;
}

}  // namespace gp2
