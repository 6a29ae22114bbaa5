#pragma once

// The inside of an ExpressionGraph, and the arithmetic that constant folding and the evaluation tape share.

#include <array>
#include <bit>
#include <cmath>
#include <cstdlib>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#include "gp2/symbolic/expression.hpp"

namespace gp2 {

namespace internal {

/// While one lives, what its thread does with expressions must end within so many steps: nodes made or visited, inputs of tapes.
/// A file can ask for more than anyone can wait for within all limits of size (many derivatives of one large expression, say).
/// One inside another changes nothing.
class StepLimit {
 public:
  /// About ten seconds, and 1 GB where every step is one of a tape.
  static constexpr std::uint64_t max_steps = 50'000'000;

  explicit StepLimit(std::uint64_t steps = max_steps);
  ~StepLimit();
  StepLimit(const StepLimit&) = delete;
  StepLimit& operator=(const StepLimit&) = delete;

  /// @throws InputError past the limit of this thread; without one it does nothing.
  static void count(std::size_t steps);

 private:
  bool is_outermost_;
};

/// Values that are added at the end and never change: what has been added is read while another thread adds more. Block k holds
/// 64·2ᵏ of them.
template <typename Value>
class Growing {
 public:
  [[nodiscard]] std::size_t size() const { return size_; }
  const Value& operator[](std::size_t i) const {
    const std::size_t block = block_of(i);
    return blocks_[block][i - first_of(block)];
  }
  /// By one thread at a time.
  void push_back(Value value) {
    const std::size_t block = block_of(size_);
    std::unique_ptr<Value[]>& values = blocks_.at(block);
    if (!values) values = std::make_unique<Value[]>(first << block);
    values[size_ - first_of(block)] = std::move(value);
    ++size_;
  }

 private:
  static constexpr std::size_t first = 64;
  static std::size_t block_of(std::size_t i) { return static_cast<std::size_t>(std::bit_width((i + first) / first)) - 1; }
  static std::size_t first_of(std::size_t block) { return (first << block) - first; }
  std::array<std::unique_ptr<Value[]>, 15> blocks_;  // more than ExpressionGraph::max_nodes
  std::size_t size_ = 0;
};

struct Node {
  Operation operation = Operation::constant;
  std::uint32_t a = 0;  // id of the first operand; of a variable: index of its name
  std::uint32_t b = 0;  // id of the second operand
  double value = 0;     // of a constant
};

constexpr bool is_leaf(Operation operation) { return operation == Operation::constant || operation == Operation::variable; }

constexpr bool is_binary(Operation operation) {
  switch (operation) {
    case Operation::add:
    case Operation::subtract:
    case Operation::multiply:
    case Operation::divide:
    case Operation::power:
    case Operation::atan2:
    case Operation::min:
    case Operation::max:
    case Operation::multiply_or_zero:
      return true;
    default:
      return false;
  }
}

constexpr bool is_commutative(Operation operation) {
  return operation == Operation::add || operation == Operation::multiply || operation == Operation::min ||
         operation == Operation::max;
}

/// The exponent n when uⁿ is computed by repeated squaring: a non-zero integer, |n| ≤ 64.
inline std::optional<int> small_integer(double exponent) {
  if (exponent == 0 || std::abs(exponent) > 64 || exponent != std::trunc(exponent)) return std::nullopt;
  return static_cast<int>(exponent);
}

/// r_i = a_iⁿ by repeated squaring, lane by lane; r and a do not overlap.
inline void integer_power(int n, std::ptrdiff_t lanes, const double* a, double* r) {
  constexpr std::ptrdiff_t max_lanes = 64;
  double square[max_lanes];
  for (std::ptrdiff_t i = 0; i < lanes; ++i) square[i] = a[i];
  for (std::ptrdiff_t i = 0; i < lanes; ++i) r[i] = 1;
  for (int rest = std::abs(n); rest > 0; rest /= 2) {
    if (rest % 2 == 1) {
      for (std::ptrdiff_t i = 0; i < lanes; ++i) r[i] *= square[i];
    }
    for (std::ptrdiff_t i = 0; i < lanes; ++i) square[i] *= square[i];
  }
  if (n < 0) {
    for (std::ptrdiff_t i = 0; i < lanes; ++i) r[i] = 1 / r[i];
  }
}

/// multiply_or_zero takes what is smaller for 0: a velocity that dies away never is, and √(v² + w²) is 0 before v is.
inline constexpr double negligible = 1e-100;

/// Calls `use` with the arithmetic of `operation` as a function (double a, double b) -> double;
/// unary ones ignore b. NaN stays NaN.
template <class Use>
void with_arithmetic(Operation operation, Use&& use) {
  switch (operation) {
    case Operation::constant:
    case Operation::variable:
      return;
    case Operation::add:
      return use([](double a, double b) { return a + b; });
    case Operation::subtract:
      return use([](double a, double b) { return a - b; });
    case Operation::multiply:
      return use([](double a, double b) { return a * b; });
    case Operation::divide:
      return use([](double a, double b) { return a / b; });
    case Operation::negate:
      return use([](double a, double) { return -a; });
    case Operation::power:
      return use([](double a, double b) { return std::pow(a, b); });
    case Operation::sin:
      return use([](double a, double) { return std::sin(a); });
    case Operation::cos:
      return use([](double a, double) { return std::cos(a); });
    case Operation::tan:
      return use([](double a, double) { return std::tan(a); });
    case Operation::asin:
      return use([](double a, double) { return std::asin(a); });
    case Operation::acos:
      return use([](double a, double) { return std::acos(a); });
    case Operation::atan:
      return use([](double a, double) { return std::atan(a); });
    case Operation::sinh:
      return use([](double a, double) { return std::sinh(a); });
    case Operation::cosh:
      return use([](double a, double) { return std::cosh(a); });
    case Operation::tanh:
      return use([](double a, double) { return std::tanh(a); });
    case Operation::exp:
      return use([](double a, double) { return std::exp(a); });
    case Operation::log:
      return use([](double a, double) { return std::log(a); });
    case Operation::sqrt:
      return use([](double a, double) { return std::sqrt(a); });
    case Operation::abs:
      return use([](double a, double) { return std::abs(a); });
    case Operation::sign:
      return use([](double a, double) { return a > 0 ? 1.0 : a < 0 ? -1.0 : a; });
    case Operation::atan2:
      return use([](double a, double b) { return std::atan2(a, b); });
    case Operation::min:
      return use([](double a, double b) { return ((a != a) | (a < b)) ? a : b; });
    case Operation::max:
      return use([](double a, double b) { return ((a != a) | (a > b)) ? a : b; });
    case Operation::multiply_or_zero:
      return use([](double a, double b) {
        const double product = a * b;
        return std::abs(a) < negligible ? 0.0 : product;
      });
  }
}

}  // namespace internal

struct ExpressionGraph::Implementation {
  internal::Growing<internal::Node> nodes;  // operands come before what uses them
  internal::Growing<std::string> names;     // of the variables, in order of appearance

  /// The id of `node`, which is stored unless an equal one is there already; and of a variable.
  std::uint32_t intern(const internal::Node& node);
  std::uint32_t intern(std::string_view name);
  [[nodiscard]] std::size_t size() const;

  /// Ids of everything the roots are made of, themselves included, ascending: operands before what uses them.
  [[nodiscard]] std::vector<std::uint32_t> reachable(std::span<const std::uint32_t> roots) const;

 private:
  struct Key {
    Operation operation;
    std::uint32_t a, b;
    std::uint64_t value;  // bits, so that equal keys mean identical constants
    bool operator==(const Key&) const = default;
  };
  struct KeyHash {
    std::size_t operator()(const Key& key) const {
      std::uint64_t hash = key.value ^ (static_cast<std::uint64_t>(key.operation) << 56);
      for (const std::uint64_t part : {std::uint64_t{key.a}, std::uint64_t{key.b}}) {
        hash = (hash ^ (hash >> 29) ^ part) * 0x9e3779b97f4a7c15ULL;
      }
      return static_cast<std::size_t>(hash ^ (hash >> 32));
    }
  };
  std::uint32_t intern_alone(const internal::Node& node);  // while the mutex is held

  mutable std::mutex growing_;
  std::unordered_map<Key, std::uint32_t, KeyHash> ids_;  // looked up, never iterated
  std::map<std::string, std::uint32_t, std::less<>> variable_ids_;
};

}  // namespace gp2
