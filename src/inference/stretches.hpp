#pragma once

#include <algorithm>
#include <cstddef>
#include <numeric>
#include <vector>

#include "gp2/observations.hpp"

namespace gp2 {

/// The states of n stretches of equal number, in time order: by t where all have one, else in their own.
/// @param t  row of the states
inline std::vector<std::vector<int>> states_of_stretches(const Observations& group, int t, int n) {
  std::vector<int> order(static_cast<std::size_t>(group.n_data()));
  std::iota(order.begin(), order.end(), 0);
  const auto times = group.states().row(t);
  if (times.allFinite()) std::stable_sort(order.begin(), order.end(), [&](int i, int j) { return times[i] < times[j]; });
  std::vector<std::vector<int>> stretches(static_cast<std::size_t>(n));
  for (std::size_t k = 0; k < order.size(); ++k) stretches[k * stretches.size() / order.size()].push_back(order[k]);
  return stretches;
}

/// The stretch of each state.
inline std::vector<int> stretch_of_states(const std::vector<std::vector<int>>& stretches) {
  std::size_t n = 0;
  for (const std::vector<int>& states : stretches) n += states.size();
  std::vector<int> stretch_of(n);
  for (std::size_t k = 0; k < stretches.size(); ++k) {
    for (const int i : stretches[k]) stretch_of[static_cast<std::size_t>(i)] = static_cast<int>(k);
  }
  return stretch_of;
}

}  // namespace gp2
