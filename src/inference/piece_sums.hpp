#pragma once

#include <algorithm>
#include <cstddef>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/base/workers.hpp"

namespace gp2 {

/// Pieces of blocks of rows that follow each other, as many whoever works on them: eight, and more where each has blocks enough that
/// its sums cost little beside them.
struct Pieces {
  static constexpr int n_parts = 8, most = 256;
  static constexpr Eigen::Index fewest_blocks = 8;  // of a piece where there are more than eight

  Eigen::Index n_blocks;
  int n = n_parts;

  explicit Pieces(Eigen::Index of_blocks) : n_blocks(of_blocks) {
    while (n < most && n_blocks >= 2 * n * fewest_blocks) n *= 2;
  }
  /// The first block of a piece; of piece n, one past the last.
  [[nodiscard]] Eigen::Index first(int piece) const { return piece * n_blocks / n; }
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

/// A sum over all pieces that has the same bits however many threads and processes there are: pieces of one eighth of all are added
/// pairwise, then the pairs, and so on; eighths one after another. As soon as two that belong together are there they become one, so
/// that few sums are in memory.
/// @tparam Sum  has add(other), which adds number by number, and for_each(work) that calls work(first number, how many)
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
    if (!workers.ranks) return added_up(zero_, workers, [&](std::size_t node, int) { return take(node); });
    const VectorXd numbers = total_of_ranks(workers, *workers.ranks);
    Sum all = zero_;
    const double* next = numbers.data();
    all.for_each([&](double* values, Index count) {
      std::copy_n(next, count, values);
      next += count;
    });
    return all;
  }

 private:
  using Index = Eigen::Index;
  using VectorXd = Eigen::VectorXd;

  static std::size_t size(int n) { return static_cast<std::size_t>(n); }

  static VectorXd numbers_of(Sum sum) {
    Index n = 0;
    sum.for_each([&](const double*, Index count) { n += count; });
    VectorXd numbers(n);
    double* next = numbers.data();
    sum.for_each([&](const double* values, Index count) { next = std::copy_n(values, count, next); });
    return numbers;
  }

  // Each process adds up a slice of the numbers, and hands it to the others; few numbers each adds up by itself.
  VectorXd total_of_ranks(const Workers& workers, const Ranks& ranks) {
    constexpr Index few = 1000;
    VectorXd numbers = numbers_of(zero_);
    const bool is_sliced = numbers.size() > few;
    const auto slice = [&](VectorXd& of, std::size_t rank) {
      const auto first = [&](std::size_t k) { return static_cast<Index>(k) * of.size() / ranks.size(); };
      return is_sliced ? of.segment(first(rank), first(rank + 1) - first(rank)) : of.segment(0, of.size());
    };
    const std::size_t own = size(ranks.rank());
    const Index n_own = slice(numbers, own).size();

    // by who has the sums below nodes, and who adds them up, in the order of the tree
    std::vector<std::vector<double>> to(size(ranks.size())), from(to.size());
    added_up(VectorSum{}, workers, [&](std::size_t node, int owner) {
      std::vector<double>& expected = from[size(owner)];
      expected.resize(expected.size() + static_cast<std::size_t>(n_own));
      if (size(owner) == own) {
        VectorXd sum = numbers_of(take(node));
        for (std::size_t rank = 0; rank < to.size(); ++rank) {
          const auto part = slice(sum, rank);
          to[rank].insert(to[rank].end(), part.begin(), part.end());
        }
      }
      return VectorSum{};
    });
    ranks.exchange(to, from);
    std::vector<const double*> next;
    for (const std::vector<double>& one : from) next.push_back(one.data());
    slice(numbers, own) = added_up(VectorSum{slice(numbers, own)}, workers, [&](std::size_t, int owner) {
                            const double* const first = std::exchange(next[size(owner)], next[size(owner)] + n_own);
                            return VectorSum{Eigen::Map<const VectorXd>(first, n_own)};
                          }).sum;
    if (!is_sliced) return numbers;

    for (std::size_t rank = 0; rank < to.size(); ++rank) {
      to[rank].assign(slice(numbers, own).begin(), slice(numbers, own).end());
      from[rank].resize(static_cast<std::size_t>(slice(numbers, rank).size()));
    }
    ranks.exchange(to, from);
    for (std::size_t rank = 0; rank < from.size(); ++rank)
      std::copy(from[rank].begin(), from[rank].end(), slice(numbers, rank).begin());
    return numbers;
  }

  Sum take(std::size_t node) { return nodes_[node] ? *std::exchange(nodes_[node], std::nullopt) : zero_; }

  /// `sum` and what all parts sum up to, where of(node, owner) is what stands below a node that one process has.
  template <typename T, typename Of>
  T added_up(T sum, const Workers& workers, const Of& of) const {
    const int per_part = n_pieces_ / Pieces::n_parts;
    for (int part = 0; part < Pieces::n_parts; ++part) {
      sum.add(below<T>(size(Pieces::n_parts + part), part * per_part, per_part, workers, of));
    }
    return sum;
  }

  // n pieces from the first on stand below the node
  template <typename T, typename Of>
  T below(std::size_t node, int first, int n, const Workers& workers, const Of& of) const {
    if (workers.have_one_owner(first, first + n - 1, n_pieces_))
      return of(node, workers.ranks ? workers.ranks->owner(first, n_pieces_) : 0);
    T sum = below<T>(2 * node, first, n / 2, workers, of);
    sum.add(below<T>(2 * node + 1, first + n / 2, n / 2, workers, of));
    return sum;
  }

  int n_pieces_;
  Sum zero_;
  std::vector<std::optional<Sum>>
      nodes_;  // of a binary tree: node k has 2k and 2k + 1 below it, the last n_pieces are the pieces
  std::mutex mutex_;
};

}  // namespace gp2
