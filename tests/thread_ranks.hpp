#pragma once

#include <algorithm>
#include <barrier>
#include <span>

#include "gp2/base/workers.hpp"

namespace gp2::test {

/// Threads that stand for the processes of mpirun.
class ThreadRanks final : public Ranks {
 public:
  struct Meeting {
    explicit Meeting(int n) : size(n), barrier(n) {}
    const int size;
    std::barrier<> barrier;
    std::span<double> sent;
  };
  ThreadRanks(Meeting& meeting, int rank) : meeting_(meeting), rank_(rank) {}
  [[nodiscard]] int rank() const override { return rank_; }
  [[nodiscard]] int size() const override { return meeting_.size; }
  void broadcast(std::span<double> numbers, int from) const override {
    if (rank_ == from) meeting_.sent = numbers;
    meeting_.barrier.arrive_and_wait();
    if (rank_ != from) std::copy(meeting_.sent.begin(), meeting_.sent.end(), numbers.begin());
    meeting_.barrier.arrive_and_wait();
  }

 private:
  Meeting& meeting_;
  const int rank_;
};

}  // namespace gp2::test
