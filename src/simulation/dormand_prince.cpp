#include "simulation/dormand_prince.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace gp2 {

DormandPrince::DormandPrince(Function function, double absolute_tolerance, double relative_tolerance)
    : function_(std::move(function)),
      absolute_tolerance_(absolute_tolerance),
      relative_tolerance_(relative_tolerance),
      stepper_(ErrorChecker(absolute_tolerance, relative_tolerance, 1, 0)) {}

// Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, sec. II.4
double DormandPrince::first_size(double span) {
  const Phase &x = start_.x, &dxdt = start_.dxdt;
  const auto size = [&](const auto& entry) {
    double largest = 0;
    for (std::size_t k = 0; k < x.size(); ++k) {
      const double scale = absolute_tolerance_ + relative_tolerance_ * std::abs(x[k]);
      largest = std::max(largest, std::abs(entry(k)) / scale);
    }
    return largest;
  };
  const double d0 = size([&](std::size_t k) { return x[k]; });
  const double d1 = size([&](std::size_t k) { return dxdt[k]; });
  const double h0 = std::min(span, d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1);
  Phase x1 = x, dxdt1(x.size());
  for (std::size_t k = 0; k < x.size(); ++k) x1[k] += h0 * dxdt[k];
  try {
    function_(x1, dxdt1, start_.t + h0);
  } catch (const StageFault&) {
    return h0;
  }
  const double d2 = size([&](std::size_t k) { return dxdt1[k] - dxdt[k]; }) / h0;
  const double steepest = std::max(d1, d2);
  const double h1 = steepest <= 1e-15 ? std::max(1e-6, h0 * 1e-3) : std::pow(0.01 / steepest, 0.2);
  return std::min({100 * h0, h1, span});
}

bool DormandPrince::try_step(double limit) {
  const bool to_limit = size_ >= limit - start_.t;
  const double tried = to_limit ? limit - start_.t : size_;
  double next = tried;
  end_.t = start_.t;
  end_.x.resize(start_.x.size());
  end_.dxdt.resize(start_.x.size());
  try {
    const auto stage = [this](const Phase& x, Phase& dxdt, double t) { function_(x, dxdt, t); };
    const auto result = stepper_.try_step(stage, start_.x, start_.dxdt, end_.t, end_.x, end_.dxdt, next);
    if (result == boost::numeric::odeint::success) {
      ++accepted_;
      if (to_limit) end_.t = limit;
      size_ = to_limit ? std::max(size_, next) : next;
      return true;
    }
    fault_ = "the tolerances cannot be met there";
  } catch (const StageFault& fault) {
    fault_ = fault.text;
    next = tried / 4;
  }
  size_ = next;
  ++rejected_;
  return false;
}

void DormandPrince::take_again(double size) {
  size_ = size;
  --accepted_;
  ++rejected_;
}

Phase DormandPrince::at(double t) const {
  Phase x(start_.x.size());
  stepper_.stepper().calc_state(t, x, start_.x, start_.dxdt, start_.t, end_.x, end_.dxdt, end_.t);
  return x;
}

bool DormandPrince::is_missed(const PhasePoint& point) const {
  constexpr double share = 1e-3, far = 1e4;  // of the step; tolerances
  const double h = end_.t - start_.t, before = std::max(start_.t, point.t - share * h),
               after = std::min(end_.t, point.t + share * h);
  const Phase from = at(before), to = at(after);
  for (std::size_t k = from.size() / 2; k < from.size(); ++k) {
    const double rate = (to[k] - from[k]) / (after - before);
    const double tolerance = absolute_tolerance_ + relative_tolerance_ * (std::abs(start_.x[k]) + h * std::abs(rate));
    if (std::abs(point.dxdt[k] - rate) * h > far * tolerance) return true;
  }
  return false;
}

void DormandPrince::end_at(double t, const Phase& x) {
  end_.t = t;
  end_.x = x;
}

double DormandPrince::advance() {
  std::swap(start_, end_);
  return start_.t - end_.t;
}

}  // namespace gp2
