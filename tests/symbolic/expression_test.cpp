#include "gp2/symbolic/expression.hpp"

#include <functional>
#include <limits>

#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "input_error.hpp"
#include "random_expression.hpp"

namespace gp2 {
namespace {

class ExpressionTest : public testing::Test {
 protected:
  Expression read(const std::string& text) {
    return parse_expression(text, graph, [&](std::string_view name) { return graph.variable(name); }, {});
  }
  Expression apply(Operation operation, Expression a) { return graph.apply(operation, a); }
  Expression apply(Operation operation, Expression a, Expression b) { return graph.apply(operation, a, b); }
  Expression number(double value) { return graph.constant(value); }

  ExpressionGraph graph;
  const Expression x = graph.variable("x"), y = graph.variable("y"), z = graph.variable("z");
};

TEST_F(ExpressionTest, LocalRulesSimplify) {
  const std::vector<std::pair<std::string, std::string>> table{{"x + 0", "x"},
                                                               {"0 + x", "x"},
                                                               {"x - 0", "x"},
                                                               {"0 - x", "-x"},
                                                               {"x - x", "0"},
                                                               {"0*x", "0"},
                                                               {"x*0", "0"},
                                                               {"1*x", "x"},
                                                               {"x*1", "x"},
                                                               {"x*(-1)", "-x"},
                                                               {"-1*x", "-x"},
                                                               {"-(-x)", "x"},
                                                               {"0/x", "0"},
                                                               {"x/1", "x"},
                                                               {"x/(-1)", "-x"},
                                                               {"2*(3*x)", "6*x"},
                                                               {"x*2", "2*x"},
                                                               {"x*(2*y)", "2*x*y"},
                                                               {"(2*x)*(3*y)", "6*x*y"},
                                                               {"x*2*y*4", "8*x*y"},
                                                               {"(x*2)*3", "6*x"},
                                                               {"2*(x*(-3))", "-6*x"},
                                                               {"x - (-y)", "x + y"},
                                                               {"x + (-y)", "x - y"},
                                                               {"-x + y", "y - x"},
                                                               {"(-x)*(-y)", "x*y"},
                                                               {"(-x)*y", "-x*y"},
                                                               {"x*(-y)", "-x*y"},
                                                               {"(-x)/y", "-x/y"},
                                                               {"x/(-y)", "-x/y"},
                                                               {"(-x)/(-y)", "x/y"},
                                                               {"x^0", "1"},
                                                               {"x^1", "x"},
                                                               {"x^0.5", "sqrt(x)"},
                                                               {"x^(1/2)", "sqrt(x)"},
                                                               {"2 + 3*4", "14"},
                                                               {"-2^2", "-4"},
                                                               {"sin(0)", "0"},
                                                               {"max(1, 2, 3)", "3"},
                                                               {"atan2(0, 1)", "0"},
                                                               {"x + (-3)", "x - 3"},
                                                               {"-3 + x", "x - 3"},
                                                               {"x - (-3)", "x + 3"},
                                                               {"-3*x*y", "-3*x*y"},
                                                               {"x + (-3)*y", "x - 3*y"}};
  for (const auto& [written, simple] : table) EXPECT_EQ(to_string(read(written)), simple) << written;
}

TEST_F(ExpressionTest, WhatIsNotALocalRuleIsLeftAlone) {
  for (const char* text : {"-(x - y)", "x/x", "x + x", "x*x", "(x + y)*z", "x*y + x*z", "1^x", "x + 1 + 1", "sqrt(x^2)"}) {
    EXPECT_EQ(to_string(read(text)), text);
  }
}

TEST_F(ExpressionTest, ConstantsThatWouldFoldToInfinityOrNanStaySoThatEvaluationShowsThem) {
  EXPECT_EQ(to_string(read("1/0")), "1/0");
  EXPECT_EQ(to_string(read("0/0")), "0/0");
  EXPECT_EQ(to_string(read("log(0)")), "log(0)");
  EXPECT_EQ(to_string(read("1e300*(1e300*x)")), "1e+300*(1e+300*x)");
  EXPECT_EQ(to_string(read("1e-300*(1e-300*x)")), "1e-300*(1e-300*x)");
}

TEST_F(ExpressionTest, MultiplyOrZeroBecomesAProductWhereItsGuardIsNotNeeded) {
  const auto or_zero = [&](Expression a, Expression b) { return apply(Operation::multiply_or_zero, a, b); };
  EXPECT_EQ(or_zero(number(0), number(1) / number(0)), number(0));
  EXPECT_EQ(or_zero(x, number(3)), x * number(3));
  EXPECT_EQ(or_zero(number(3), x), number(3) * x);
  EXPECT_EQ(or_zero(x, y).operation(), Operation::multiply_or_zero);
  EXPECT_NE(or_zero(x, y), or_zero(y, x));
}

TEST_F(ExpressionTest, EqualExpressionsAreOneNode) {
  EXPECT_EQ(read("sin(x)*y + z"), read("sin(x)*y + z"));
  const std::size_t size = graph.size();
  EXPECT_EQ(read("sin(x)*y + z"), read("sin(x)*y + z"));
  EXPECT_EQ(graph.size(), size);
  EXPECT_EQ(graph.variable("x"), x);
  EXPECT_EQ(number(0.0), number(-0.0));
  EXPECT_NE(number(1), number(std::nextafter(1.0, 2.0)));
}

TEST_F(ExpressionTest, OrderDoesNotMatterToSumsProductsMinAndMax) {
  EXPECT_EQ(x + y, y + x);
  EXPECT_EQ(x * y, y * x);
  EXPECT_EQ((-x) + (-y), (-y) + (-x));
  EXPECT_EQ(number(-2) + x, x + number(-2));
  EXPECT_EQ(number(-2) * x, x * number(-2));
  EXPECT_EQ(apply(Operation::min, x, y), apply(Operation::min, y, x));
  EXPECT_EQ(apply(Operation::max, x, y), apply(Operation::max, y, x));
  EXPECT_NE(x - y, y - x);
  EXPECT_NE(x / y, y / x);
  EXPECT_NE(apply(Operation::atan2, x, y), apply(Operation::atan2, y, x));
  EXPECT_NE(apply(Operation::power, x, y), apply(Operation::power, y, x));
  // the order written first is the one printed
  EXPECT_EQ(to_string(read("z*x")), "z*x");
  EXPECT_EQ(to_string(read("x*z")), "z*x");
}

TEST_F(ExpressionTest, OperandsHaveSmallerIdsThanWhatUsesThem) {
  const Expression e = graph.differentiate(read("sin(x*y)^2/(1 + exp(z*x))"), x);
  EXPECT_LT(e.left().id(), e.id());
  EXPECT_LT(e.right().id(), e.id());
  EXPECT_EQ(&e.graph(), &graph);
}

TEST_F(ExpressionTest, TheSameTextGivesTheSameNodesInEveryGraph) {
  const std::string text = "m*l^2*ddq1 + m*9.81*l*sin(q1) - min(q1, dq1)*sqrt(dq1^2 + 0.1)";
  const auto build = [&](ExpressionGraph& into) {
    const auto e = parse_expression(text, into, [&](std::string_view name) { return into.variable(name); }, {});
    return into.differentiate(into.differentiate(e, into.variable("q1")), into.variable("dq1"));
  };
  ExpressionGraph first, second;
  const Expression a = build(first), b = build(second);
  EXPECT_EQ(a.id(), b.id());
  EXPECT_EQ(first.size(), second.size());
  EXPECT_EQ(to_string(a), to_string(b));
  EXPECT_FALSE(a == b) << "expressions of different graphs differ";
}

TEST_F(ExpressionTest, VariablesAreListedSortedAndDependenceIsStructural) {
  const Expression e = read("z*sin(y) + 0*x");
  EXPECT_EQ(graph.variables_of(e), (std::vector<std::string>{"y", "z"}));
  EXPECT_TRUE(graph.depends_on(e, z));
  EXPECT_FALSE(graph.depends_on(e, x));
}

TEST_F(ExpressionTest, SubstitutionReplacesAllVariablesAtOnce) {
  EXPECT_EQ(graph.substitute(read("x - 2*y"), {{"x", y}, {"y", x}}), read("y - 2*x"));
  EXPECT_EQ(graph.substitute(read("sin(x)*y + z"), {{"x", number(0)}}), z);
  EXPECT_EQ(graph.substitute(read("x*y"), {{"w", z}}), read("x*y"));
}

// ---------------------------------------------------------------------------------------------------------------- derivatives

TEST_F(ExpressionTest, DerivativesOfEveryOperationMatchCentralDifferences) {
  const std::vector<std::string> texts{
      "x + y*x",     "y - x*x",     "x*y*x",         "y/x",           "x/(1 + y*x)",    "-x^3",           "x^4",
      "x^(-2)",      "x^1.5",       "y^x",           "x^x",           "x^(y + 0.5)",    "sin(x*y)",       "cos(x*y)",
      "tan(x*y)",    "asin(x*y)",   "acos(x*y)",     "atan(x*y)",     "sinh(x*y)",      "cosh(x*y)",      "tanh(x*y)",
      "exp(x*y)",    "log(x*y)",    "sqrt(x*y)",     "abs(x - 2)*y",  "sign(x)*x^2",    "atan2(x, y)",    "atan2(y, x)",
      "min(x^2, y)", "min(y, x^2)", "max(x^2, 0.1)", "max(2, x^2)*x", "min(x, y, x*y)", "sqrt(x^2 + y^2)"};
  const std::map<std::string, double> at{{"x", 0.625}, {"y", 1.25}};
  const double h = 1e-6;
  for (const std::string& text : texts) {
    const Expression e = read(text);
    auto up = at, down = at;
    up["x"] += h;
    down["x"] -= h;
    const double expected = (test::evaluate(e, up) - test::evaluate(e, down)) / (2 * h);
    EXPECT_NE(expected, 0) << text;
    EXPECT_NEAR(test::evaluate(graph.differentiate(e, x), at), expected, 1e-8 * (1 + std::abs(expected))) << text;
  }
}

TEST_F(ExpressionTest, DerivativesOfRandomExpressionsWithKinksMatchCentralDifferences) {
  constexpr unsigned seed = 7;
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  test::RandomExpressions random(graph, seed, true);
  int compared = 0, not_zero = 0;
  for (int k = 0; k < 400; ++k) {
    const Expression e = random.draw(4);
    std::map<std::string, double> at;
    for (const Expression& v : random.variables) at[v.variable_name()] = random.integer(-2000, 2000) / 1000.0;
    const auto difference = [&](double h) {
      auto up = at, down = at;
      up["x1"] += h;
      down["x1"] -= h;
      return (test::evaluate(e, up) - test::evaluate(e, down)) / (2 * h);
    };
    // two step sizes that disagree mean a kink or a steep place: no reference there
    const double expected = difference(1e-5), check = difference(2e-5);
    if (!(std::abs(expected - check) < 1e-6 * (1 + std::abs(expected)))) continue;
    ++compared;
    not_zero += expected != 0;
    EXPECT_NEAR(test::evaluate(graph.differentiate(e, random.variables[0]), at), expected, 1e-5 * (1 + std::abs(expected)))
        << to_string(e);
  }
  EXPECT_GT(compared, 320);
  EXPECT_GT(not_zero, 120);
}

TEST_F(ExpressionTest, DerivativesAtSingularPointsAreZeroAlongDirectionsWithoutChange) {
  struct Case {
    std::string text, variable;
    std::map<std::string, double> at;
    double expected;
  };
  const std::vector<Case> cases{{"(dq1^2)^p", "p", {{"dq1", 0}, {"p", 0.7}}, 0},    // uᵛ log u → 0
                                {"(dq1^2)^p", "dq1", {{"dq1", 0}, {"p", 0.3}}, 0},  // p u^(p−1) u̇ with u̇ = 0
                                {"(dq1^2)^1.5", "dq1", {{"dq1", 0}}, 0},
                                {"(dq1^2)^0.25", "dq1", {{"dq1", 0}}, 0},
                                {"(dq1^2)^(-0.5)", "p", {{"dq1", 0}}, 0},
                                {"sqrt(dq1^2 + dq2^2)", "dq1", {{"dq1", 0}, {"dq2", 0}}, 0},
                                {"sqrt(p*(dq1^2 + dq2^2))", "p", {{"dq1", 0}, {"dq2", 0}, {"p", 2}}, 0},
                                {"p*sqrt(dq1^2 + dq2^2)", "p", {{"dq1", 0}, {"dq2", 0}, {"p", 2}}, 0},
                                {"asin(1 - x^2)", "x", {{"x", 0}}, 0},
                                {"acos(1 - x^2)", "x", {{"x", 0}}, 0},
                                {"atan2(x^2, y^2)", "x", {{"x", 0}, {"y", 0}}, 0},
                                {"abs(x)", "x", {{"x", 0}}, 0},
                                {"x^2", "x", {{"x", 0}}, 0},
                                {"x^1", "x", {{"x", 0}}, 1},
                                {"min(x, 2*x)", "x", {{"x", 0}}, 1.5},  // the average at a tie
                                {"max(x, 2*x)", "x", {{"x", 0}}, 1.5},
                                {"max(x, sqrt(x))", "x", {{"x", 4}}, 1},
                                {"max(1, sqrt(x))", "x", {{"x", 0}}, 0},  // the branch not taken has an infinite slope
                                {"sign(x)", "x", {{"x", 0}}, 0}};
  for (const Case& c : cases) {
    const Expression d = graph.differentiate(read(c.text), graph.variable(c.variable));
    EXPECT_EQ(test::evaluate(d, c.at), c.expected) << "d/d" << c.variable << " " << c.text << " = " << to_string(d);
  }
}

TEST_F(ExpressionTest, SecondDerivativesOfAPowerLawInItsParameterAreZeroAtRest) {
  const Expression dq1 = graph.variable("dq1"), p = graph.variable("p");
  const Expression by_p = graph.differentiate(read("(dq1^2)^p"), p);
  const std::map<std::string, double> rest{{"dq1", 0}, {"p", 0.7}};
  EXPECT_EQ(test::evaluate(graph.differentiate(by_p, p), rest), 0);
  EXPECT_EQ(test::evaluate(graph.differentiate(by_p, dq1), rest), 0);
}

TEST_F(ExpressionTest, AnInfiniteSlopeIsNotHidden) {
  EXPECT_TRUE(std::isinf(test::evaluate(graph.differentiate(read("sqrt(x)"), x), {{"x", 0}})));
  EXPECT_FALSE(std::isfinite(test::evaluate(graph.differentiate(read("atan2(x, y)"), x), {{"x", 0}, {"y", 0}})));
}

TEST_F(ExpressionTest, DerivativesReadAsWrittenByHand) {
  EXPECT_EQ(to_string(graph.differentiate(read("x^2 + 3*x + 1"), x)), "2*x + 3");
  EXPECT_EQ(to_string(graph.differentiate(read("cos(x)*y"), x)), "-sin(x)*y");
  EXPECT_EQ(to_string(graph.differentiate(read("y*z"), x)), "0");
  EXPECT_EQ(to_string(graph.differentiate(read("x^y"), y)), to_string(read("x^y*log(x)")));
}

TEST_F(ExpressionTest, DeepExpressionsCostNoStack) {
  Expression e = x;
  for (int level = 0; level < 50'000; ++level) e = apply(Operation::sin, e + number(0.5) * y);
  const Expression d = graph.differentiate(e, y);
  EXPECT_TRUE(graph.depends_on(d, x));
  EXPECT_EQ(graph.variables_of(d), (std::vector<std::string>{"x", "y"}));
  EXPECT_TRUE(graph.depends_on(graph.substitute(e, {{"x", z}}), z));
  EXPECT_GT(to_string(e).size(), 50'000U);
}

// --------------------------------------------------------------------------------------------------------------------- errors

TEST_F(ExpressionTest, GraphsRefuseToGrowPastTheirBound) {
  const std::string text = test::input_error_of([&] {
    for (std::size_t k = 0; k <= ExpressionGraph::max_nodes; ++k) graph.constant(static_cast<double>(k));
  });
  EXPECT_EQ(text, "expressions: more than 1000000 operations; use fewer or shorter expressions");
  EXPECT_EQ(graph.size(), ExpressionGraph::max_nodes);
}

TEST_F(ExpressionTest, ConstantsMustBeFinite) {
  EXPECT_EQ(test::input_error_of([&] { number(std::numeric_limits<double>::infinity()); }),
            "expressions: a constant must be finite, got inf");
}

TEST_F(ExpressionTest, GraphsDoNotMix) {
  ExpressionGraph other;
  EXPECT_EQ(test::input_error_of([&] { x + other.variable("x"); }),
            "expressions: the operands belong to different graphs; build all operands in one graph");
  const Expression foreign = other.variable("x");
  const std::function<void()> uses[] = {[&] { apply(Operation::sin, foreign); },
                                        [&] { graph.differentiate(foreign, x); },
                                        [&] { graph.differentiate(x, foreign); },
                                        [&] { graph.substitute(foreign, {}); },
                                        [&] { static_cast<void>(graph.variables_of(foreign)); },
                                        [&] { static_cast<void>(graph.depends_on(foreign, x)); },
                                        [&] { static_cast<void>(graph.depends_on(x, foreign)); },
                                        [&] { static_cast<void>(graph.size_of(foreign)); }};
  for (const auto& use : uses) {
    EXPECT_EQ(test::input_error_of(use), "expressions: the operand belongs to another graph; build all operands in one graph");
  }
}

TEST_F(ExpressionTest, ACopyReadsAsTheOriginal) {
  ExpressionGraph other;
  other.variable("z");
  const std::vector<Expression> originals{read("x^3 - 2*sin(x*y)/z"), read("-(x*y)"), graph.constant(0.25), x};
  const std::vector<Expression> copies = other.copy(originals);
  ASSERT_EQ(copies.size(), originals.size());
  for (std::size_t k = 0; k < copies.size(); ++k) {
    EXPECT_EQ(&copies[k].graph(), &other);
    EXPECT_EQ(to_string(copies[k]), to_string(originals[k]));
  }
  // in its own graph an expression is its own copy
  EXPECT_EQ(graph.copy(originals), originals);
  EXPECT_TRUE(other.copy({}).empty());
  EXPECT_EQ(test::input_error_of([&] {
              graph.copy(std::vector{x, other.variable("x")});
            }),
            "expressions: what is copied belongs to different graphs; copy each on its own");
}

TEST_F(ExpressionTest, SeveralExpressionsAreDifferentiatedAsEachAlone) {
  const std::vector<Expression> expressions{read("x^3*y"), read("sin(x*y)"), y, x};
  const std::vector<Expression> derivatives = graph.differentiate(expressions, x);
  ASSERT_EQ(derivatives.size(), expressions.size());
  for (std::size_t k = 0; k < expressions.size(); ++k) EXPECT_EQ(derivatives[k], graph.differentiate(expressions[k], x));
}

TEST_F(ExpressionTest, DerivativesAreTakenWithRespectToVariables) {
  EXPECT_EQ(test::input_error_of([&] { graph.differentiate(x * y, x + y); }),
            "expressions: a derivative is taken with respect to a variable");
}

TEST_F(ExpressionTest, TextsThatGrowWithoutBoundAreRefused) {
  Expression e = x;
  for (int level = 0; level < 40; ++level) e = e * e + x;
  EXPECT_EQ(test::input_error_of([&] { to_string(e); }),
            "expressions: written out, this one has more than 16777216 characters; print its parts");
}

}  // namespace
}  // namespace gp2
