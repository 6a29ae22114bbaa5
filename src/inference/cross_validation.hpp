#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "gp2/inference/evaluation.hpp"

namespace gp2 {

/// Whether fewer of n values lie within their intervals of 95 % than chance, and hyperparameters fitted to few rows, make it.
inline bool is_coverage_low(double coverage95, int n) {
  constexpr double deviations = 5;  // of sound fits at most 2.6
  return coverage95 < 0.9 && 0.95 - coverage95 > deviations * std::sqrt(0.95 * 0.05 / n);
}

/// Whether half of what values that were left out do beyond their noise, or more, is not predicted.
inline bool is_little_predicted(const Evaluation::Part& left_out, double nrmse_of_noise) {
  const double noise = nrmse_of_noise * nrmse_of_noise, chance = 3 * noise * std::sqrt(2.0 / left_out.n);
  return left_out.nrmse * left_out.nrmse > noise + chance + 0.25 * std::max(0.0, 1 - noise);
}

/// cross_validate by some of the values.
/// @param trusted  the observations of the posterior; of values that do not count NaN
CrossValidation cross_validate(const Posterior& posterior, const std::vector<Observations>& trusted, bool has_time_order);

}  // namespace gp2
