#pragma once

#include <vector>

#include "gp2/observations.hpp"

namespace gp2 {

/// States of all observations together.
int n_states(const std::vector<Observations>& observations);
/// Whether any of them measures sums over its states.
bool has_sums(const std::vector<Observations>& observations);

/// About n states, of each Observations the same share and at least one where there are any, evenly from all; not more than there are.
std::vector<Observations> evenly(const std::vector<Observations>& observations, int n);
/// Which states of each these are.
std::vector<std::vector<int>> evenly_taken(const std::vector<Observations>& observations, int n);

}  // namespace gp2
