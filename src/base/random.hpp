#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>
#include <random>
#include <utility>
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

  /// Gamma of a shape > 0 and scale 1 (Marsaglia and Tsang 2000).
  double gamma(double shape) {
    if (shape < 1) {
      const double of_larger_shape = gamma(shape + 1);
      return of_larger_shape * std::pow(1 - uniform(), 1 / shape);
    }
    const double d = shape - 1.0 / 3, c = 1 / std::sqrt(9 * d);
    while (true) {
      const double z = normal(), root = 1 + c * z, v = root * root * root;
      if (root > 0 && std::log(1 - uniform()) < 0.5 * z * z + d * (1 - v + std::log(v))) return d * v;
    }
  }

  /// How many of n numbers, even in [0, 1), are below p. The median of many is drawn first: it leaves half of them open.
  double binomial(double n, double p) {
    double below = 0;
    while (n > 16) {
      const double rank = std::floor(n / 2) + 1;
      const double smaller = gamma(rank), larger = gamma(n + 1 - rank);
      const double median = smaller / (smaller + larger);
      if (median < p) {
        below += rank;
        n -= rank;
        p = (p - median) / (1 - median);
      } else {
        n = rank - 1;
        p /= median;
      }
    }
    for (; n > 0; --n) below += uniform() < p ? 1 : 0;
    return below;
  }

  /// Poisson: the arrivals of a process of rate 1 before time `mean` (Ahrens and Dieter 1974, by gamma and binomial numbers). A
  /// whole number, as a double: there is no largest mean.
  double poisson(double mean) {
    double before = 0;
    while (mean > 16) {
      const double rank = std::floor(7.0 / 8 * mean);
      const double arrival = gamma(rank);
      if (arrival > mean) return before + binomial(rank - 1, mean / arrival);
      before += rank;
      mean -= arrival;
    }
    // multiplied uniforms: exponential waiting times
    const double limit = std::exp(-mean);
    for (double product = 1 - uniform(); product > limit; product *= 1 - uniform()) ++before;
    return before;
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
