#pragma once

#include <algorithm>
#include <barrier>
#include <span>
#include <stdexcept>
#include <vector>

#include "gp2/base/workers.hpp"

namespace gp2::test {

/// Threads that stand for the processes of mpirun.
class ThreadRanks final : public Ranks {
 public:
  struct Meeting {
    explicit Meeting(int n) : size(n), barrier(n), exchanged(static_cast<std::size_t>(n)) {}
    const int size;
    std::barrier<> barrier;
    std::span<double> sent;
    std::vector<const std::vector<std::vector<double>>*> exchanged;
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
  void exchange(const std::vector<std::vector<double>>& to, std::vector<std::vector<double>>& from) const override {
    const auto own = static_cast<std::size_t>(rank_);
    meeting_.exchanged[own] = &to;
    meeting_.barrier.arrive_and_wait();
    for (std::size_t rank = 0; rank < from.size(); ++rank) {
      const std::vector<double>& message = (*meeting_.exchanged[rank])[own];
      if (message.size() != from[rank].size()) throw std::logic_error("a message of another size than expected");
      from[rank] = message;
    }
    meeting_.barrier.arrive_and_wait();
  }

 private:
  Meeting& meeting_;
  const int rank_;
};

}  // namespace gp2::test
