// GiNaC, an independent computer algebra system, evaluates the same random expressions and their derivatives with 40 digits.

#include <algorithm>
#include <limits>
#include <unordered_map>

#include <ginac/ginac.h>
#include <gtest/gtest.h>

#include "gp2/symbolic/expression.hpp"
#include "random_expression.hpp"

// CLN, below GiNaC, keeps a string of its own until the end. The sanitizer's library finds this function only if it is visible.
extern "C" [[gnu::visibility("default")]] const char* __lsan_default_suppressions();
extern "C" const char* __lsan_default_suppressions() { return "leak:libcln\n"; }

namespace gp2 {
namespace {

/// A value and a bound on its distance from the exact one, to first order in the unit of rounding.
struct Bounded {
  double value = 0;
  double error = 0;
};

/// Running error analysis (Higham 2002, section 3.3): every operation passes on the errors of its operands through its partial
/// derivatives and adds its own rounding.
class BoundedEvaluation {
 public:
  explicit BoundedEvaluation(std::map<std::string, double> values) : values_(std::move(values)) {}

  Bounded operator()(Expression e) {
    if (const auto found = known_.find(e.id()); found != known_.end()) return found->second;
    return known_[e.id()] = compute(e);
  }

 private:
  Bounded compute(Expression e) {
    constexpr double epsilon = std::numeric_limits<double>::epsilon();
    const auto op = e.operation();
    // constants may be folded, each with a rounding of its own
    if (op == Operation::constant) return {e.constant_value(), 4 * epsilon * std::abs(e.constant_value())};
    if (op == Operation::variable) return {values_.at(e.variable_name()), 0};
    const Bounded a = (*this)(e.left());
    const double u = a.value;
    // |f'(u)| δ + 4ε |f|: libm rounds within a few units in the last place
    const auto function = [&](double value, double slope) {
      return Bounded{value, std::abs(slope) * a.error + 4 * epsilon * std::abs(value)};
    };
    switch (op) {
      case Operation::negate:
        return {-u, a.error};
      case Operation::sin:
        return function(std::sin(u), std::cos(u));
      case Operation::cos:
        return function(std::cos(u), std::sin(u));
      case Operation::tan:
        return function(std::tan(u), 1 + std::pow(std::tan(u), 2));
      case Operation::asin:
        return function(std::asin(u), 1 / std::sqrt(1 - u * u));
      case Operation::acos:
        return function(std::acos(u), 1 / std::sqrt(1 - u * u));
      case Operation::atan:
        return function(std::atan(u), 1 / (1 + u * u));
      case Operation::sinh:
        return function(std::sinh(u), std::cosh(u));
      case Operation::cosh:
        return function(std::cosh(u), std::sinh(u));
      case Operation::tanh:
        return function(std::tanh(u), 1);
      case Operation::exp:
        return function(std::exp(u), std::exp(u));
      case Operation::log:
        return function(std::log(u), 1 / u);
      case Operation::sqrt:
        return function(std::sqrt(u), 0.5 / std::sqrt(u));
      default:
        break;
    }
    const Bounded b = (*this)(e.right());
    const double v = b.value;
    const auto rounded = [&](double value, double passed_on) { return Bounded{value, passed_on + epsilon * std::abs(value)}; };
    switch (op) {
      case Operation::add:
        return rounded(u + v, a.error + b.error);
      case Operation::subtract:
        return rounded(u - v, a.error + b.error);
      case Operation::multiply:
        return rounded(u * v, std::abs(u) * b.error + std::abs(v) * a.error);
      case Operation::multiply_or_zero:
        return rounded(std::abs(u) < 1e-100 ? 0 : u * v, std::abs(u) * b.error + std::abs(v) * a.error);
      case Operation::divide:
        return rounded(u / v, (a.error + std::abs(u / v) * b.error) / std::abs(v));
      case Operation::power: {
        const double value = std::pow(u, v);
        const double by_base = std::abs(v * std::pow(u, v - 1)) * a.error;
        const double by_exponent = e.right().is_constant() ? 0 : std::abs(value * std::log(u)) * b.error;
        return {value, by_base + by_exponent + (4 + std::abs(v)) * epsilon * std::abs(value)};
      }
      default:
        ADD_FAILURE() << "an operation that these random expressions do not hold";
        return {};
    }
  }

  std::map<std::string, double> values_;
  std::unordered_map<std::uint32_t, Bounded> known_;
};

using Symbols = std::map<std::string, GiNaC::realsymbol>;

/// Mantissa · 2^exponent as a fraction: a float would lower the precision of all it touches.
GiNaC::numeric exact_number(double value) {
  int exponent = 0;
  const double mantissa = std::frexp(value, &exponent);
  return GiNaC::numeric(static_cast<long>(std::ldexp(mantissa, 53))) *
         GiNaC::pow(GiNaC::numeric(2), GiNaC::numeric(exponent - 53));
}

GiNaC::ex to_ginac(Expression e, const Symbols& symbols) {
  const auto leaf = [&](Expression x) {
    return x.is_constant() ? GiNaC::ex(exact_number(x.constant_value())) : symbols.at(x.variable_name());
  };
  const auto other = [](Expression) {
    ADD_FAILURE() << "an operation that these random expressions do not hold";
    return GiNaC::ex(0);
  };
  return test::evaluate_as<GiNaC::ex>(e, leaf, other);
}

/// The real value of e, or NaN.
double value_of(const GiNaC::ex& e, const GiNaC::exmap& point) {
  try {
    const GiNaC::ex value = e.subs(point).evalf();
    if (!GiNaC::is_a<GiNaC::numeric>(value)) return NAN;
    const auto& number = GiNaC::ex_to<GiNaC::numeric>(value);
    return number.is_real() ? number.to_double() : NAN;
  } catch (const std::exception&) {
    return NAN;  // a pole
  }
}

TEST(GinacOracle, ValuesAndFirstAndSecondDerivativesOfRandomExpressionsAgree) {
  constexpr unsigned seed = 20240611;
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  constexpr int n_expressions = 320;
  constexpr int n_points = 2;
  GiNaC::Digits = 40;

  int compared = 0, skipped = 0, not_zero = 0;
  std::vector<double> relative_bounds;
  for (int k = 0; k < n_expressions; ++k) {
    ExpressionGraph graph;
    test::RandomExpressions random(graph, seed + static_cast<unsigned>(k), false);
    const Expression f = random.draw(1 + k % 6);
    Symbols symbols;
    for (const Expression& x : random.variables) symbols.emplace(x.variable_name(), GiNaC::realsymbol(x.variable_name()));

    // f, ∂f/∂x_i, ∂²f/∂x_i∂x_j by both roads
    std::vector<Expression> ours{f};
    std::vector<GiNaC::ex> theirs{to_ginac(f, symbols)};
    for (std::size_t i = 0; i < 4; ++i) {
      const Expression df = graph.differentiate(f, random.variables[i]);
      const GiNaC::ex df_ginac = theirs[0].diff(symbols.at(random.variables[i].variable_name()));
      ours.push_back(df);
      theirs.push_back(df_ginac);
      for (std::size_t j = 0; j <= i; ++j) {
        ours.push_back(graph.differentiate(df, random.variables[j]));
        theirs.push_back(df_ginac.diff(symbols.at(random.variables[j].variable_name())));
      }
    }

    for (int p = 0; p < n_points; ++p) {
      std::map<std::string, double> values;
      GiNaC::exmap point;
      for (const Expression& x : random.variables) {
        const int numerator = random.integer(-2048, 2048);
        values[x.variable_name()] = numerator / 1024.0;
        point[symbols.at(x.variable_name())] = GiNaC::ex(GiNaC::numeric(numerator, 1024)).evalf();
      }
      BoundedEvaluation bounded(values);
      for (std::size_t m = 0; m < ours.size(); ++m) {
        const Bounded our = bounded(ours[m]);
        const double exact = value_of(theirs[m], point);
        if (!std::isfinite(our.value) || !std::isfinite(our.error) || !std::isfinite(exact)) {
          ++skipped;
          continue;
        }
        ++compared;
        not_zero += exact != 0;
        relative_bounds.push_back(our.error / (1 + std::abs(exact)));
        EXPECT_LE(std::abs(our.value - exact), 2 * our.error + 1e-15 * std::abs(exact) + 1e-300)
            << "expression " << k << ", output " << m << ": " << to_string(f);
      }
    }
  }
  EXPECT_GE(compared, 0.8 * (compared + skipped)) << compared << " compared, " << skipped << " skipped";
  EXPECT_GE(not_zero, 0.3 * compared);

  // the bounds must themselves be small, or the comparison would mean nothing
  std::sort(relative_bounds.begin(), relative_bounds.end());
  EXPECT_LE(relative_bounds[relative_bounds.size() * 99 / 100], 1e-10);
}

}  // namespace
}  // namespace gp2
