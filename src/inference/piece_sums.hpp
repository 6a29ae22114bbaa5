#pragma once

#include <algorithm>
#include <cstddef>
#include <mutex>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/base/workers.hpp"

namespace gp2 {

/// Pieces of blocks of rows that follow each other, as many whoever works on them: eight, and more where each has blocks enough that
/// its sums cost little beside them.
struct Pieces {
  static constexpr int n_parts = 8, most = 256;
  static constexpr Eigen::Index fewest_blocks = 32;  // of a piece where there are more than eight

  Eigen::Index n_blocks;
  int n = n_parts;

  explicit Pieces(Eigen::Index of_blocks) : n_blocks(of_blocks) {
    while (n < most && n_blocks >= 2 * n * fewest_blocks) n *= 2;
  }
  /// The first block of a piece; of piece n, one past the last.
  [[nodiscard]] Eigen::Index first(int piece) const { return piece * n_blocks / n; }
};

/// A sum over all pieces that has the same bits however many threads and processes there are: pieces of one eighth of all are added
/// pairwise, then the pairs, and so on; eighths one after another. As soon as two that belong together are there they become one, so
/// that few sums are in memory.
/// @tparam Sum  has add(other), and for_each(work) that calls work(first number, how many)
template <typename Sum>
class PieceSums {
 public:
  explicit PieceSums(int n_pieces, Sum zero) : n_pieces_(n_pieces), zero_(std::move(zero)), nodes_(2 * size(n_pieces)) {}

  /// What a piece sums up to. Threads may call it at the same time.
  void put(int piece, Sum sum) {
    std::size_t node = size(n_pieces_ + piece);
    for (; node >= size(2 * Pieces::n_parts); node /= 2) {
      std::optional<Sum> sibling;
      {
        const std::scoped_lock lock(mutex_);
        std::swap(sibling, nodes_[node ^ 1U]);
        if (!sibling) {
          nodes_[node] = std::move(sum);
          return;
        }
      }
      sum.add(*sibling);  // a + b has the bits of b + a
    }
    const std::scoped_lock lock(mutex_);
    nodes_[node] = std::move(sum);
  }

  /// The sum of what all processes have put.
  [[nodiscard]] Sum total(const Workers& workers) {
    Sum all = zero_;
    const int per_part = n_pieces_ / Pieces::n_parts;
    for (int part = 0; part < Pieces::n_parts; ++part) {
      all.add(take(size(Pieces::n_parts + part), part * per_part, per_part, workers));
    }
    return all;
  }

 private:
  static std::size_t size(int n) { return static_cast<std::size_t>(n); }

  // The sum of n pieces from the first on, which stand below a node: from the process that has it, or of both halves.
  Sum take(std::size_t node, int first, int n, const Workers& workers) {
    if (!workers.have_one_owner(first, first + n - 1, n_pieces_)) {
      Sum sum = take(2 * node, first, n / 2, workers);
      sum.add(take(2 * node + 1, first + n / 2, n / 2, workers));
      return sum;
    }
    Sum sum = nodes_[node] ? *std::exchange(nodes_[node], std::nullopt) : zero_;
    sum.for_each([&](double* numbers, Eigen::Index count) {
      workers.share({numbers, static_cast<std::size_t>(count)}, first, n_pieces_);
    });
    return sum;
  }

  int n_pieces_;
  Sum zero_;
  std::vector<std::optional<Sum>>
      nodes_;  // of a binary tree: node k has 2k and 2k + 1 below it, the last n_pieces are the pieces
  std::mutex mutex_;
};

/// A sum of vectors.
struct VectorSum {
  Eigen::VectorXd sum;

  void add(const VectorSum& other) { sum += other.sum; }
  template <typename Work>
  void for_each(const Work& work) {
    work(sum.data(), sum.size());
  }
};

}  // namespace gp2
