#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>
#include <random>
#include <vector>

namespace gp2 {

/// Random numbers that are the same on every platform: the standard fixes std::mt19937_64, but not its distributions.
class RandomStream {
 public:
  /// Streams of one seed are independent of each other.
  explicit RandomStream(std::uint64_t seed, std::uint64_t stream = 0) {
    const auto half = [](std::uint64_t word, int k) { return static_cast<std::uint32_t>(word >> (32 * k)); };
    std::seed_seq sequence{half(seed, 0), half(seed, 1), half(stream, 0), half(stream, 1)};
    engine_.seed(sequence);
  }

  /// Even in [0, 1).
  double uniform() { return static_cast<double>(engine_() >> 11) * 0x1.0p-53; }

  /// Standard normal, by the transform of Box and Muller.
  double normal() {
    const double radius = std::sqrt(-2 * std::log(1 - uniform()));
    return radius * std::cos(2 * std::numbers::pi * uniform());
  }

  /// 0 … n − 1 in random order (Fisher and Yates).
  std::vector<int> permutation(int n) {
    std::vector<int> order(static_cast<std::size_t>(n));
    for (int k = 0; k < n; ++k) order[static_cast<std::size_t>(k)] = k;
    for (int k = n - 1; k > 0; --k) {
      const int other = static_cast<int>(uniform() * (k + 1));
      std::swap(order[static_cast<std::size_t>(k)], order[static_cast<std::size_t>(other)]);
    }
    return order;
  }

 private:
  std::mt19937_64 engine_;
};

}  // namespace gp2
