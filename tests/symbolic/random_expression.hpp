#pragma once

// What the tests of this folder share: random expressions, and a plain recursive evaluation to compare with.

#include <cmath>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "gp2/symbolic/expression.hpp"

namespace gp2::test {

/// e in numbers of any kind, node by node as defined.
/// @param leaf   of a constant or a variable
/// @param other  of what is not differentiable everywhere
template <typename Number, typename Leaf, typename Other>
Number evaluate_as(Expression e, const Leaf& leaf, const Other& other) {
  const auto a = [&] { return evaluate_as<Number>(e.left(), leaf, other); };
  const auto b = [&] { return evaluate_as<Number>(e.right(), leaf, other); };
  using std::acos, std::asin, std::atan, std::cos, std::cosh, std::exp, std::log, std::pow, std::sin, std::sinh, std::sqrt,
      std::tan, std::tanh;
  switch (e.operation()) {
    case Operation::constant:
    case Operation::variable:
      return leaf(e);
    case Operation::add:
      return a() + b();
    case Operation::subtract:
      return a() - b();
    case Operation::multiply:
      return a() * b();
    case Operation::divide:
      return a() / b();
    case Operation::negate:
      return -a();
    case Operation::power:
      return pow(a(), b());
    case Operation::sin:
      return sin(a());
    case Operation::cos:
      return cos(a());
    case Operation::tan:
      return tan(a());
    case Operation::asin:
      return asin(a());
    case Operation::acos:
      return acos(a());
    case Operation::atan:
      return atan(a());
    case Operation::sinh:
      return sinh(a());
    case Operation::cosh:
      return cosh(a());
    case Operation::tanh:
      return tanh(a());
    case Operation::exp:
      return exp(a());
    case Operation::log:
      return log(a());
    case Operation::sqrt:
      return sqrt(a());
    default:
      return other(e);
  }
}

/// e at the values of the variables: the slow road that every fast one must meet.
inline double evaluate(Expression e, const std::map<std::string, double>& values) {
  const auto leaf = [&](Expression x) { return x.is_constant() ? x.constant_value() : values.at(x.variable_name()); };
  const auto other = [&](Expression f) -> double {
    const double u = evaluate(f.left(), values);
    if (f.operation() == Operation::abs) return std::abs(u);
    if (f.operation() == Operation::sign) return std::isnan(u) ? u : (u > 0) - (u < 0);
    if (f.operation() == Operation::multiply_or_zero && std::abs(u) < 1e-100) return 0;
    const double v = evaluate(f.right(), values);
    if (f.operation() == Operation::multiply_or_zero) return u * v;
    if (f.operation() == Operation::atan2) return std::atan2(u, v);
    if (std::isnan(u) || std::isnan(v)) return NAN;
    return f.operation() == Operation::min ? std::min(u, v) : std::max(u, v);
  };
  return evaluate_as<double>(e, leaf, other);
}

/// Draws expressions that are finite nearly everywhere: arguments of functions with a small domain are bounded first.
class RandomExpressions {
 public:
  RandomExpressions(ExpressionGraph& graph, unsigned seed, bool with_kinks)
      : graph_(graph), engine_(seed), with_kinks_(with_kinks) {
    for (const char* name : {"x1", "x2", "x3", "x4"}) variables.push_back(graph.variable(name));
  }

  std::vector<Expression> variables;

  int integer(int low, int high) { return std::uniform_int_distribution(low, high)(engine_); }

  Expression draw(int depth) {
    if (depth == 0 || integer(0, 9) == 0) {
      return integer(0, 3) == 0 ? number() : variables[static_cast<std::size_t>(integer(0, 3))];
    }
    const Expression a = draw(depth - 1);
    const auto f = [&](Operation operation, Expression u) { return graph_.apply(operation, u); };
    const auto bounded = [&] { return f(Operation::sin, a); };
    const auto positive = [&] { return graph_.constant(1.25) + bounded(); };
    switch (integer(0, with_kinks_ ? 23 : 20)) {
      case 0:
      case 1:
        return a + draw(depth - 1);
      case 2:
      case 3:
        return a - draw(depth - 1);
      case 4:
      case 5:
        return a * draw(depth - 1);
      case 6:
        return draw(depth - 1) / positive();
      case 7:
        return -a;
      case 8:
        return graph_.apply(Operation::power, bounded(), graph_.constant(integer(2, 4)));
      case 9:
        return graph_.apply(Operation::power, positive(), draw(depth - 1) / (graph_.constant(2) + a * a));
      case 10:
        return f(Operation::sin, a);
      case 11:
        return f(Operation::cos, a);
      case 12:
        return f(Operation::tan, bounded());
      case 13:
        return f(integer(0, 1) == 0 ? Operation::asin : Operation::acos, graph_.constant(0.75) * bounded());
      case 14:
        return f(Operation::atan, a);
      case 15:
        return f(integer(0, 1) == 0 ? Operation::sinh : Operation::cosh, bounded());
      case 16:
        return f(Operation::tanh, a);
      case 17:
        return f(Operation::exp, bounded());
      case 18:
        return f(Operation::log, positive());
      case 19:
        return f(Operation::sqrt, positive());
      case 20:
        return graph_.apply(Operation::power, positive(), graph_.constant(integer(0, 1) == 0 ? -2 : 1.5));
      case 21:
        return f(integer(0, 1) == 0 ? Operation::abs : Operation::sign, a);
      case 22:
        return graph_.apply(integer(0, 1) == 0 ? Operation::min : Operation::max, a, draw(depth - 1));
      default:
        return graph_.apply(Operation::atan2, a, draw(depth - 1));
    }
  }

  /// Eighths, so that they are exact in binary: −3, …, 3 without 0.
  Expression number() {
    const int eighths = integer(1, 24);
    return graph_.constant((integer(0, 1) == 0 ? eighths : -eighths) / 8.0);
  }

 private:
  ExpressionGraph& graph_;
  std::mt19937 engine_;
  bool with_kinks_;
};

}  // namespace gp2::test
