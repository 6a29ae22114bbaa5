#include "data/evenly.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace gp2 {

int n_states(const std::vector<Observations>& observations) {
  int n = 0;
  for (const Observations& group : observations) n += group.n_data();
  return n;
}

bool has_sums(const std::vector<Observations>& observations) {
  return std::any_of(observations.begin(), observations.end(), [](const Observations& group) { return group.has_sums(); });
}

std::vector<std::vector<int>> evenly_taken(const std::vector<Observations>& observations, int n) {
  const double share = static_cast<double>(n) / n_states(observations);
  std::vector<std::vector<int>> states;
  for (const Observations& group : observations) {
    const std::int64_t all = group.n_data();
    const std::int64_t taken =
        std::clamp<std::int64_t>(std::lround(share * static_cast<double>(all)), std::min<std::int64_t>(all, 1), all);
    std::vector<int>& of_group = states.emplace_back();
    for (std::int64_t k = 0; k < taken; ++k) of_group.push_back(static_cast<int>(k * all / taken));
  }
  return states;
}

std::vector<Observations> evenly(const std::vector<Observations>& observations, int n) {
  const std::vector<std::vector<int>> states = evenly_taken(observations, n);
  std::vector<Observations> some;
  for (std::size_t g = 0; g < observations.size(); ++g) some.push_back(observations[g].take(states[g]));
  return some;
}

}  // namespace gp2
