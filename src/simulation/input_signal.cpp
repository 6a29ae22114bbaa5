#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

InputSignal::InputSignal(VectorXd times, MatrixXd values) : times_(std::move(times)), values_(std::move(values)) {
  const Index n = times_.size();
  if (n == 0 || values_.cols() != n) {
    throw InputError(fmt::format("inputs: {} times for {} columns of values; give as many, at least one", n, values_.cols()));
  }
  if (!times_.allFinite() || !values_.allFinite()) throw InputError("inputs: a time or a value is not a finite number");
  for (Index k = 1; k < n; ++k) {
    if (times_[k] > times_[k - 1]) continue;
    throw InputError(fmt::format("inputs: times must increase, but {} follows {}", times_[k], times_[k - 1]));
  }

  // where the slope changes by more than rounding; it is zero outside the table
  constexpr double rounding = 1e-9;
  const VectorXd size = values_.cwiseAbs().rowwise().maxCoeff();
  VectorXd slope_before = VectorXd::Zero(values_.rows());
  for (Index k = 0; k < n; ++k) {
    VectorXd slope_after = VectorXd::Zero(values_.rows());
    if (k + 1 < n) slope_after = (values_.col(k + 1) - values_.col(k)) / (times_[k + 1] - times_[k]);
    double span = std::numeric_limits<double>::infinity();
    if (k > 0) span = std::min(span, times_[k] - times_[k - 1]);
    if (k + 1 < n) span = std::min(span, times_[k + 1] - times_[k]);
    if (n > 1 && ((slope_after - slope_before).array().abs() * span > rounding * size.array()).any()) kinks_.push_back(times_[k]);
    slope_before = slope_after;
  }
}

void InputSignal::evaluate(double t, Eigen::Ref<VectorXd> u) const {
  const Index n = times_.size();
  if (n == 0) {
    u.setZero();
    return;
  }
  const Index after = std::upper_bound(times_.begin(), times_.end(), t) - times_.begin();
  if (after == 0 || after == n) {
    u = values_.col(after == 0 ? 0 : n - 1);
    return;
  }
  const double share = (t - times_[after - 1]) / (times_[after] - times_[after - 1]);
  u = (1 - share) * values_.col(after - 1) + share * values_.col(after);
}

double InputSignal::next_kink(double t) const {
  const auto kink = std::upper_bound(kinks_.begin(), kinks_.end(), t);
  return kink == kinks_.end() ? std::numeric_limits<double>::infinity() : *kink;
}

}  // namespace gp2
