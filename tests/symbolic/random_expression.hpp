#pragma once

// What the tests of this folder share: random expressions, and a plain recursive evaluation to compare with.

#include <cmath>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "gp2/symbolic/expression.hpp"

namespace gp2::test {

/// e at the values of the variables, node by node as defined: the slow road that every fast one must meet.
inline double evaluate(Expression e, const std::map<std::string, double>& values) {
  const auto a = [&] { return evaluate(e.left(), values); };
  const auto b = [&] { return evaluate(e.right(), values); };
  switch (e.operation()) {
    case Operation::constant:
      return e.constant_value();
    case Operation::variable:
      return values.at(e.variable_name());
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
      return std::pow(a(), b());
    case Operation::sin:
      return std::sin(a());
    case Operation::cos:
      return std::cos(a());
    case Operation::tan:
      return std::tan(a());
    case Operation::asin:
      return std::asin(a());
    case Operation::acos:
      return std::acos(a());
    case Operation::atan:
      return std::atan(a());
    case Operation::sinh:
      return std::sinh(a());
    case Operation::cosh:
      return std::cosh(a());
    case Operation::tanh:
      return std::tanh(a());
    case Operation::exp:
      return std::exp(a());
    case Operation::log:
      return std::log(a());
    case Operation::sqrt:
      return std::sqrt(a());
    case Operation::abs:
      return std::abs(a());
    case Operation::sign: {
      const double u = a();
      return std::isnan(u) ? u : (u > 0) - (u < 0);
    }
    case Operation::atan2:
      return std::atan2(a(), b());
    case Operation::min: {
      const double u = a(), v = b();
      return std::isnan(u) || std::isnan(v) ? NAN : std::min(u, v);
    }
    case Operation::max: {
      const double u = a(), v = b();
      return std::isnan(u) || std::isnan(v) ? NAN : std::max(u, v);
    }
    case Operation::multiply_or_zero: {
      const double u = a();
      return u == 0 ? 0.0 : u * b();
    }
  }
  return NAN;
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
