#pragma once

#include <cstdint>
#include <vector>

#include "inference/inducing_latents.hpp"

namespace gp2 {

/// Which observations a posterior through inducing points still has: of many states some, evenly taken, to be looked at. What is
/// learned is in the sums over all.
struct KeptStates {
  static constexpr int most = 5000;

  std::vector<std::int64_t> n_states;        // per Observations: all that it is conditioned on
  int step = 1;                              // every step-th is kept, a power of two
  std::vector<std::vector<int>> stretch_of;  // per Observations: the stretch of each state that is kept; empty: not known
  /// Per Observations: as which share the likelihood of each state that is kept counts; empty: all wholly.
  std::vector<std::vector<double>> share_of;
};

/// A posterior through inducing points but for its prior and values, as a file holds it.
struct InducingSummary {
  struct Component {
    InducingLatents latents;
    InducingStatistics all;
  };
  std::vector<Component> components;
  KeptStates kept;
};

}  // namespace gp2
