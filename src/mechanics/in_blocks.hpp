#pragma once

#include <Eigen/Core>

#include "base/parallel.hpp"
#include "gp2/error.hpp"

namespace gp2 {

// work(first, states) for every block of states, so that a long log is looked at in the memory of a few rows. What a system has to
// say against a state it says again of all together, by the number of the state among them.
template <typename Work>
void in_blocks(const Eigen::Ref<const Eigen::MatrixXd>& states, int n_threads, const Work& work) {
  constexpr Eigen::Index block_size = 256;
  const auto visit = [&](Eigen::Index first, const Eigen::Ref<const Eigen::MatrixXd>& block) { work(first, block); };
  try {
    for_each_block(states.cols(), block_size, thread_count(n_threads),
                   [&](Eigen::Index first, Eigen::Index n, int) { visit(first, states.middleCols(first, n)); });
  } catch (const InputError&) {
    visit(0, states);
    throw;
  }
}

}  // namespace gp2
