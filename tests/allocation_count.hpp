#pragma once

#include <cstddef>

// Counts the calls of malloc and its kin, which operator new and Eigen end in:
// a test that uses it has allocation_count.cpp among its sources.
namespace gp2::test {

/// How often this thread has allocated, and freed, so far.
std::size_t n_allocations();
std::size_t n_releases();

/// How often f() allocates.
template <typename Function>
std::size_t allocations_of(const Function& f) {
  const std::size_t before = n_allocations();
  f();
  return n_allocations() - before;
}

}  // namespace gp2::test
