#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace gp2 {

/// How many threads to use: `wanted`, or as many as the machine has where that is 0.
inline int thread_count(int wanted) {
  return wanted > 0 ? wanted : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

/// Whether a stop was requested; null: never.
inline bool is_set(const std::atomic<bool>* stop) { return stop != nullptr && stop->load(); }

/// Calls work(task, thread) once for every task 0 … n_tasks − 1, in an order that differs from run to run, on the calling thread
/// and up to n_threads − 1 others; thread 0 … n_threads − 1 is the one that works.
/// The first exception is thrown again when all are done.
template <typename Work>
void parallel_for(int n_tasks, int n_threads, const Work& work) {
  n_threads = std::clamp(n_threads, 1, std::max(n_tasks, 1));
  if (n_threads == 1) {
    for (int task = 0; task < n_tasks; ++task) work(task, 0);
    return;
  }
  std::atomic<int> next = 0;
  std::mutex mutex;
  std::exception_ptr failure;
  const auto run = [&](int thread) {
    for (int task = next++; task < n_tasks; task = next++) {
      try {
        work(task, thread);
      } catch (...) {
        const std::scoped_lock lock(mutex);
        if (!failure) failure = std::current_exception();
      }
    }
  };
  {
    std::vector<std::jthread> helpers;
    for (int thread = 1; thread < n_threads; ++thread) helpers.emplace_back(run, thread);
    run(0);
  }
  if (failure) std::rethrow_exception(failure);
}

/// work(first, n, thread) for every block of at most `size` of n_all things, as parallel_for.
template <typename Work>
void for_each_block(std::ptrdiff_t n_all, std::ptrdiff_t size, int n_threads, const Work& work) {
  const auto n_blocks = static_cast<int>((n_all + size - 1) / size);
  parallel_for(n_blocks, n_threads, [&](int block, int thread) {
    const std::ptrdiff_t first = block * size;
    work(first, std::min(size, n_all - first), thread);
  });
}

}  // namespace gp2
