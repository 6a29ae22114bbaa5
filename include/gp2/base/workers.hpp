#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Processes that work on one fit together: each has all data, does a share of the work, and gets what the others have found.
/// All of them do the same in the same order.
class Ranks {
 public:
  virtual ~Ranks() = default;
  [[nodiscard]] virtual int rank() const = 0;  // 0 … size() − 1
  [[nodiscard]] virtual int size() const = 0;
  /// The numbers of one rank, to all.
  virtual void broadcast(std::span<double> numbers, int from) const = 0;
  /// What each rank has for each other: to[k] goes to rank k, and what rank k has for this one into from[k], which has its size.
  virtual void exchange(const std::vector<std::vector<double>>& to, std::vector<std::vector<double>>& from) const = 0;

  /// The rank that works on one of so many parts.
  [[nodiscard]] int owner(int part, int n_parts) const { return size() < n_parts ? part * size() / n_parts : part; }
};

/// Who may work on parts that do not wait for each other: threads and other processes. Results are the same bits whoever does.
struct Workers {
  int n_threads = 1;
  std::shared_ptr<const Ranks> ranks = nullptr;  // null: this process alone

  Workers(int threads = 1, std::shared_ptr<const Ranks> others = nullptr) : n_threads(threads), ranks(std::move(others)) {}

  /// Whether a part is this process' to work on.
  [[nodiscard]] bool owns(int part, int n_parts) const { return !ranks || ranks->owner(part, n_parts) == ranks->rank(); }
  /// Whether the same process works on two parts and all between them.
  [[nodiscard]] bool have_one_owner(int first, int last, int n_parts) const {
    return !ranks || ranks->owner(first, n_parts) == ranks->owner(last, n_parts);
  }
  /// The sum of whole numbers, of which each process has one.
  [[nodiscard]] double sum(double own) const {
    double sum = ranks ? 0 : own;
    for (int rank = 0; ranks && rank < ranks->size(); ++rank) {
      double of_rank = own;
      ranks->broadcast({&of_rank, 1}, rank);
      sum += of_rank;
    }
    return sum;
  }
  /// Numbers of a part, from who works on it to all.
  void share(std::span<double> numbers, int part, int n_parts) const {
    if (ranks) ranks->broadcast(numbers, ranks->owner(part, n_parts));
  }
};

}  // namespace gp2
