#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"

namespace gp2 {
namespace {

class MathMl : public testing::Test {
 protected:
  std::string of(const std::string& text) {
    const auto variable = [this](std::string_view name) { return std::optional(graph.variable(name)); };
    return to_string(parse_expression(text, graph, variable, {}), Notation::mathml);
  }
  ExpressionGraph graph;
};

TEST_F(MathMl, NamesBearIndicesDotsAndGreekLetters) {
  EXPECT_EQ(of("x"), "<mi>x</mi>");
  EXPECT_EQ(of("q1"), "<msub><mi>q</mi><mn>1</mn></msub>");
  EXPECT_EQ(of("q_12"), "<msub><mi>q</mi><mn>12</mn></msub>");
  EXPECT_EQ(of("dq1"), "<msub><mi mathvariant=\"italic\">q\u0307</mi><mn>1</mn></msub>");
  EXPECT_EQ(of("ddtheta"), "<mi mathvariant=\"italic\">θ\u0308</mi>");
  EXPECT_EQ(of("Omega2"), "<msub><mi>Ω</mi><mn>2</mn></msub>");
  EXPECT_EQ(of("mass_rod"), "<mi>mass_rod</mi>");
  EXPECT_EQ(of("d"), "<mi>d</mi>");
}

TEST_F(MathMl, NumbersHaveASignAndAPowerOfTen) {
  EXPECT_EQ(of("0.5"), "<mn>0.5</mn>");
  EXPECT_EQ(of("pi"), "<mi>π</mi>");
  EXPECT_EQ(of("-2"), "<mrow><mo>−</mo><mn>2</mn></mrow>");
  EXPECT_EQ(of("1.5e-20"), "<mn>1.5</mn><mo>·</mo><msup><mn>10</mn><mn>−20</mn></msup>");
}

TEST_F(MathMl, WhatBelongsTogetherIsAnElement) {
  EXPECT_EQ(of("(a + b)/c"), "<mfrac><mrow><mi>a</mi><mo>+</mo><mi>b</mi></mrow><mrow><mi>c</mi></mrow></mfrac>");
  EXPECT_EQ(of("x^(a + b)"), "<msup><mrow><mi>x</mi></mrow><mrow><mi>a</mi><mo>+</mo><mi>b</mi></mrow></msup>");
  EXPECT_EQ(of("sqrt(a + b)"), "<msqrt><mi>a</mi><mo>+</mo><mi>b</mi></msqrt>");
  EXPECT_EQ(of("abs(a)"), "<mrow><mo>|</mo><mi>a</mi><mo>|</mo></mrow>");
}

TEST_F(MathMl, ParenthesesStandWhereTheyAreNeeded) {
  const std::string open = "<mo stretchy=\"false\">(</mo>", close = "<mo stretchy=\"false\">)</mo>";
  const std::string times = "<mo lspace=\"0.16em\" rspace=\"0\">&#x2062;</mo>";
  EXPECT_EQ(of("a*(b + c)"), "<mi>a</mi>" + times + "<mrow>" + open + "<mi>b</mi><mo>+</mo><mi>c</mi>" + close + "</mrow>");
  EXPECT_EQ(of("a - (b - c)"), "<mi>a</mi><mo>−</mo><mrow>" + open + "<mi>b</mi><mo>−</mo><mi>c</mi>" + close + "</mrow>");
  EXPECT_EQ(of("(a*b)^2"), "<msup><mrow><mrow>" + open + "<mi>a</mi>" + times + "<mi>b</mi>" + close +
                               "</mrow></mrow><mrow><mn>2</mn></mrow></msup>");
  EXPECT_EQ(of("sin(a)"), "<mrow><mi>sin</mi><mo>&#x2061;</mo><mrow>" + open + "<mi>a</mi>" + close + "</mrow></mrow>");
  EXPECT_EQ(of("atan2(a, b)"),
            "<mrow><mi>atan2</mi><mo>&#x2061;</mo><mrow>" + open + "<mi>a</mi><mo>,</mo><mi>b</mi>" + close + "</mrow></mrow>");
}

// no sign rises out of what is 0 where the first factor is
TEST_F(MathMl, AMinusAfterAnotherFactorIsNoDifference) {
  const Expression a = graph.variable("a"), x = graph.variable("x");
  const std::string times = "<mo lspace=\"0.16em\" rspace=\"0\">&#x2062;</mo>";
  const std::string open = "<mrow><mo stretchy=\"false\">(</mo>", close = "<mo stretchy=\"false\">)</mo></mrow>";
  const Expression product = graph.apply(Operation::multiply_or_zero, a, -x);
  EXPECT_EQ(to_string(product, Notation::mathml), "<mi>a</mi>" + times + open + "<mrow><mo>−</mo><mi>x</mi></mrow>" + close);
  EXPECT_EQ(to_string(product, Notation::latex), "a \\, \\left(-x\\right)");
  EXPECT_EQ(to_string(graph.apply(Operation::multiply_or_zero, a, graph.constant(-2) * x), Notation::latex),
            "a \\, \\left(-2 \\, x\\right)");
}

TEST_F(MathMl, NoNameCanBecomeMarkup) {
  EXPECT_EQ(to_string(graph.variable("<b>&"), Notation::mathml), "<mi>&lt;b&gt;&amp;</mi>");
}

}  // namespace
}  // namespace gp2
