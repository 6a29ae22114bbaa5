#include <algorithm>
#include <chrono>
#include <clocale>
#include <limits>

#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "random_expression.hpp"

namespace gp2 {
namespace {

const std::vector<std::string> known{"q1", "q2", "dq1", "dq2", "dq3", "mass"};

class ParserTest : public testing::Test {
 protected:
  Expression read(std::string_view text) {
    const auto resolve = [&](std::string_view name) -> std::optional<Expression> {
      if (std::find(known.begin(), known.end(), name) == known.end()) return std::nullopt;
      return graph.variable(name);
    };
    return parse_expression(text, graph, resolve, known);
  }

  double value(const std::string& text) {
    return test::evaluate(read(text), {{"q1", 2}, {"q2", 3}, {"dq1", 0.5}, {"dq2", -1}, {"dq3", 0.1}, {"mass", 7}});
  }

  std::string error(std::string_view text) {
    try {
      read(text);
    } catch (const InputError& e) {
      return e.what();
    }
    return "";
  }

  ExpressionGraph graph;
};

TEST_F(ParserTest, OperatorsBindAsInMathematics) {
  EXPECT_EQ(value("q1 + q2*mass"), 23);
  EXPECT_EQ(value("(q1 + q2)*mass"), 35);
  EXPECT_EQ(value("mass - q2 - q1"), 2);
  EXPECT_EQ(value("mass/q1/q1"), 1.75);
  EXPECT_EQ(value("-q1^2"), -4);
  EXPECT_EQ(value("(-q1)^2"), 4);
  EXPECT_EQ(value("q1^q2^q1"), 512) << "right-associative";
  EXPECT_EQ(value("q1^-1"), 0.5);
  EXPECT_EQ(value("2*-q1"), -4);
  EXPECT_EQ(value("+q1 - -q2"), 5);
  EXPECT_EQ(value(" q1\t*\n q2 \r"), 6);
}

TEST_F(ParserTest, NumbersAreReadInEveryUsualForm) {
  EXPECT_EQ(value("2"), 2);
  EXPECT_EQ(value("2."), 2);
  EXPECT_EQ(value(".5"), 0.5);
  EXPECT_EQ(value("1e-3"), 1e-3);
  EXPECT_EQ(value("1.5E+2"), 150);
  EXPECT_EQ(value("0.1"), 0.1);
  EXPECT_EQ(value("pi"), 3.141592653589793);
}

TEST_F(ParserTest, NumbersDoNotDependOnTheLocale) {
  const std::string before = std::setlocale(LC_ALL, nullptr);
  for (const char* name : {"de_DE.UTF-8", "fr_FR.UTF-8", "de_DE"}) std::setlocale(LC_ALL, name);  // where installed
  EXPECT_EQ(value("1.5"), 1.5);
  EXPECT_EQ(to_string(read("1.5*q1")), "1.5*q1");
  std::setlocale(LC_ALL, before.c_str());
}

TEST_F(ParserTest, FunctionsAreApplied) {
  EXPECT_EQ(value("sin(q1)"), std::sin(2.0));
  EXPECT_EQ(value("atan2(q1, q2)"), std::atan2(2.0, 3.0));
  EXPECT_EQ(value("min(q1, q2)"), 2);
  EXPECT_EQ(value("max(q1, mass, q2, dq1)"), 7);
  EXPECT_EQ(value("abs(dq2) + sign(dq2)"), 0);
  EXPECT_EQ(value("sqrt (q1^2)"), 2);
  const std::vector<std::pair<std::string, double (*)(double)>> table{
      {"cos", std::cos},   {"tan", std::tan},   {"asin", std::asin}, {"acos", std::acos},
      {"atan", std::atan}, {"sinh", std::sinh}, {"cosh", std::cosh}, {"tanh", std::tanh},
      {"exp", std::exp},   {"log", std::log},   {"sqrt", std::sqrt}};
  for (const auto& [name, function] : table) EXPECT_EQ(value(name + "(dq1)"), function(0.5)) << name;
}

TEST_F(ParserTest, ErrorsSayWhereWhatTheRuleAndTheMend) {
  const std::string functions = "sin cos tan asin acos atan atan2 sinh cosh tanh exp log sqrt abs sign min max";
  const std::string allowed = "allowed are letters a-z A-Z, digits, _ and + - * / ^ ( ) , .";
  const std::vector<std::pair<std::string, std::string>> table{
      {"", "column 1: the expression is empty; write a number, a symbol or a formula such as 2*q1"},
      {"  ", "column 1: the expression is empty; write a number, a symbol or a formula such as 2*q1"},
      {"2q1", "column 2: found 'q1' right after a number; a product needs its sign, write 2*q1"},
      {"2(q1)", "column 2: found '(...)' right after a number; a product needs its sign, write 2*(...)"},
      {"q1**2", "column 3: found '**'; a power is written ^"},
      {"q1 q2", "column 4: found 'q2' where an operator must stand; a product is written with *"},
      {"(q1)(q2)", "column 5: found '(' where an operator must stand; a product is written with *"},
      {"(q1 q2)", "column 5: found 'q2' where an operator must stand; a product is written with *"},
      {"2 3", "column 3: found '3' where an operator must stand; a product is written with *"},
      {"q1(q2)", "column 3: found '(' right after 'q1', which is not a function; a product is written q1*(...)"},
      {"pi(2)", "column 3: found '(' right after 'pi', which is not a function; a product is written pi*(...)"},
      {"q1 +", "column 5: found the end of the text where a number, a symbol, a function or '(' must stand"},
      {"q1 * / q2", "column 6: found '/' where a number, a symbol, a function or '(' must stand"},
      {"()", "column 2: found ')' where a number, a symbol, a function or '(' must stand"},
      {"q1)", "column 3: found ')' without a '(' before it; remove it or add the '('"},
      {"2*(q1 + 1", "column 10: found the end of the text where ')' must close the '(' of column 3"},
      {"(q1, q2)", "column 4: found ',' where ')' must close the '(' of column 1"},
      {"1,5", "column 2: found ',' outside a function; write one expression, with '.' as the decimal point"},
      {"1.2.3", "column 4: found a second '.' in the number 1.2.; write one decimal point"},
      {"1 + .", "column 5: found '.' without digits; a number is written as 2, 0.5, .5 or 1e-3"},
      {"1e999", "column 1: the number 1e999 does not fit a double (2.2e-308 to 1.8e308 in size)"},
      {"dq4", "column 1: unknown symbol 'dq4', did you mean 'dq3'?"},
      {"q3", "column 1: unknown symbol 'q3', did you mean 'q2'?"},
      {"2*mas", "column 3: unknown symbol 'mas', did you mean 'mass'?"},
      {"temperature", "column 1: unknown symbol 'temperature'; known here: q1, q2, dq1, dq2, dq3, mass"},
      {"sin + 1", "column 1: the function 'sin' has no argument; write sin(...)"},
      {"sqr(q1)", "column 1: unknown function 'sqr', did you mean 'sqrt'? Functions are " + functions},
      {"frobnicate(q1)", "column 1: unknown function 'frobnicate'. Functions are " + functions},
      {"site(tip).x - 1", "column 1: the name in site(...) stands in quotes: write 'site(\"NAME\").x'"},
      {"2*dpoint(arm, 0, 0, 0.1).x", "column 3: the name in dpoint(...) stands in quotes: write 'dpoint(\"NAME\", 0, 0, 0.1).x'"},
      {"geom(\"tip\").x",
       "column 1: unknown symbol 'geom(\"tip\").x'; a model with a robot has the points site(\"NAME\").x, body(\"NAME\").x and "
       "point(\"BODY\", 0, 0, 0.1).x"},
      {"atan2(q1)", "column 1: atan2 takes 2 arguments, got 1"},
      {"1 + sin(q1, q2)", "column 5: sin takes 1 argument, got 2"},
      {"sin()", "column 1: sin takes 1 argument, got 0"},
      {"min(q1)", "column 1: min takes 2 or more arguments, got 1"},
      {"max()", "column 1: max takes 2 or more arguments, got 0"},
      {"q1^2 > 0",
       "column 6: found '>'; an expression has no comparison: a constraint that comes and goes is the equation that holds while "
       "there is contact, with when = \"gap <= 0\" beside it"},
      {"q1² - 1", "column 3: found '²'; a power is written ^2"},
      {"g", "column 1: unknown symbol 'g'; known here: q1, q2, dq1, dq2, dq3, mass"},
      {"q1 = q2", "column 4: found '='; write an equation left = right as the expression left - (right)"},
      {"[q1]", "column 1: found '['; group with ( )"},
      {"q1 + é·q2", "column 6: character 'é' has no meaning here; " + allowed},
      {"é", "column 1: character 'é' has no meaning here; " + allowed},
      {"q1 − q2", "column 4: character '−' has no meaning here; " + allowed},
      {"(q1 + 1) ·q2", "column 10: character '·' has no meaning here; " + allowed},
      {"q1 & q2", "column 4: character '&' has no meaning here; " + allowed},
      {"q1 \x01", "column 4: control character 0x01 has no meaning here; " + allowed},
      {"q1 \xff", "column 4: byte 0xFF is not UTF-8 text; " + allowed}};
  for (const auto& [text, message] : table) EXPECT_EQ(error(text), message) << text;
  EXPECT_EQ(error(std::string_view("q1\0", 3)), "column 3: control character 0x00 has no meaning here; " + allowed);
}

TEST_F(ParserTest, WithoutKnownNamesNoneIsSuggested) {
  try {
    parse_expression("x", graph, [](std::string_view) { return std::nullopt; }, {});
    FAIL();
  } catch (const InputError& e) {
    EXPECT_STREQ(e.what(), "column 1: unknown symbol 'x'; known here: none");
  }
}

TEST_F(ParserTest, LongNamesAreShortenedInErrors) {
  const std::string message = error(std::string(60'000, 'a'));
  EXPECT_EQ(message.substr(0, 63), "column 1: unknown symbol '" + std::string(37, 'a'));
  EXPECT_LT(message.size(), 200U);
}

TEST_F(ParserTest, HostileTextsAreRefusedAtOnce) {
  const auto start = std::chrono::steady_clock::now();
  EXPECT_EQ(error(std::string(1'000'000, '(')),
            "the expression has 1000000 characters, at most 65536 are allowed; give its parts names of their own");
  const std::string too_deep =
      "column 201: parentheses, functions, signs and powers are nested deeper than 200; give inner parts names of their own";
  EXPECT_EQ(error(std::string(65'000, '(')), too_deep);
  EXPECT_EQ(error(std::string(65'000, '-') + "q1"), too_deep);
  std::string tower = "q1", calls, points;
  for (int k = 0; k < 20'000; ++k) tower += "^q1";
  for (int k = 0; k < 10'000; ++k) calls += "sin(";
  for (int k = 0; k < 10'000; ++k) points += "p('',";
  EXPECT_NE(error(tower).find("nested deeper than 200"), std::string::npos);
  EXPECT_NE(error(calls).find("nested deeper than 200"), std::string::npos);
  EXPECT_NE(error(points).find("nested deeper than 200"), std::string::npos);
  EXPECT_EQ(error("((((q1^99)^99)^99)^99)"), "");
  EXPECT_EQ(error("((((9^99)^99)^99)^99)"), "");
  std::string sum = "q1";
  while (sum.size() < 65'000) sum += "+q1*q2";
  EXPECT_EQ(error(sum), "");
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(5));
}

TEST_F(ParserTest, NestingUpToTheBoundIsRead) {
  EXPECT_EQ(read(std::string(200, '(') + "q1" + std::string(200, ')')), graph.variable("q1"));
  EXPECT_NE(error(std::string(201, '(') + "q1" + std::string(201, ')')), "");
}

// -------------------------------------------------------------------------------------------------------------------- printing

TEST_F(ParserTest, TextReadsBackToTheSameNode) {
  constexpr unsigned seed = 3;
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  test::RandomExpressions random(graph, seed, true);
  const auto read_back = [&](const std::string& text) {
    return parse_expression(text, graph, [&](std::string_view name) { return graph.variable(name); }, {});
  };
  for (int k = 0; k < 2000; ++k) {
    const Expression e = random.draw(k % 7);
    const std::string text = to_string(e);
    ASSERT_EQ(read_back(text), e) << text << "\nwas read as\n" << to_string(read_back(text));
  }
  for (const char* text : {"x - (y - z)", "x/(y*z)",    "x/(y/z)",  "(x^y)^z", "x^(-y)",    "(-x)^y",      "(-2)^x",
                           "-2^x",        "-(x + y)*z", "-3/x",     "-x - y",  "x^(y + z)", "x - (y + z)", "pi*x",
                           "x^(-pi)",     "-pi - x",    "1e-300*x", "2^x^y",   "x*(y/z)",   "-(0/0)",      "y - (0/0*x)/2"}) {
    const Expression e = read_back(text);
    EXPECT_EQ(read_back(to_string(e)), e) << text << " printed as " << to_string(e);
  }
}

TEST_F(ParserTest, TextHasNoMoreParenthesesThanNeeded) {
  for (const char* text : {"q1 + q2 + dq1", "q1 - (q2 - dq1)", "q1*q2/dq1", "q1/(q2*dq1)", "-q1^2", "q1^q2^dq1", "(q1^q2)^dq1",
                           "q1 - 3", "-q1*q2", "-(q1 + q2)", "(q1 + q2)*dq1", "atan2(q1 + q2, -q1)"}) {
    EXPECT_EQ(to_string(read(text)), text);
  }
}

TEST_F(ParserTest, LatexIsWrittenAsInTextbooks) {
  const auto latex = [&](std::string_view text) {
    return to_string(parse_expression(text, graph, [&](std::string_view name) { return graph.variable(name); }, {}),
                     Notation::latex);
  };
  const std::vector<std::pair<std::string, std::string>> table{
      {"q1", "q_{1}"},
      {"dq3", "\\dot{q}_{3}"},
      {"ddq12", "\\ddot{q}_{12}"},
      {"theta1", "\\theta_{1}"},
      {"dtheta", "\\dot{\\theta}"},
      {"ddelta2", "\\dot{\\delta}_{2}"},
      {"delta", "\\delta"},
      {"q_1", "q_{1}"},
      {"d", "d"},
      {"damping", "\\mathrm{damping}"},
      {"mass_rod", "\\mathrm{mass\\_rod}"},
      {"mass2", "\\mathrm{mass}_{2}"},
      {"_", "\\mathrm{\\_}"},
      {"q1/q2", "\\frac{q_{1}}{q_{2}}"},
      {"sin(q1)^2", "\\sin\\left(q_{1}\\right)^{2}"},
      {"sqrt(x + y)", "\\sqrt{x + y}"},
      {"(q1 + q2)*x", "\\left(q_{1} + q_{2}\\right) \\, x"},
      {"x^2*y", "x^{2} \\, y"},
      {"x*2^y", "x \\cdot 2^{y}"},
      {"-x - 3", "-x - 3"},
      {"(x/y)^2", "\\left(\\frac{x}{y}\\right)^{2}"},
      {"abs(x)", "\\left|x\\right|"},
      {"asin(x) + sign(y)", "\\arcsin\\left(x\\right) + \\operatorname{sign}\\left(y\\right)"},
      {"atan2(x, y)", "\\operatorname{atan2}\\left(x, y\\right)"},
      {"max(x, y)", "\\max\\left(x, y\\right)"},
      {"pi^x", "\\pi^{x}"},
      {"1e-10*x", "1 \\cdot 10^{-10} \\, x"},
      {"1e30^x", "\\left(1 \\cdot 10^{30}\\right)^{x}"}};
  for (const auto& [text, expected] : table) EXPECT_EQ(latex(text), expected) << text;
  EXPECT_EQ(to_string(graph.variable("site(\"nut & bolt #1\").x"), Notation::latex), "\\mathrm{site(\"nut \\& bolt \\#1\").x}");
}

TEST_F(ParserTest, AProductOrZeroIsWrittenAsAProduct) {
  EXPECT_EQ(to_string(graph.apply(Operation::multiply_or_zero, read("q1"), read("q2"))), "q1*q2");
}

TEST_F(ParserTest, AComponentOverItsLengthIsZeroAtZero) {
  for (const std::string text :
       {"q1/abs(q1)", "-q2*q1/sqrt(q1^2 + q2^2)", "3*(q1/q2*dq1)/sqrt(q1*q1 + 4*dq1^2)", "q1*dq1/sqrt(q2^2*q1^2/3 + dq1^2)"}) {
    SCOPED_TRACE(text);
    const auto value = [&](double q1, double q2, double dq1) {
      return test::evaluate(read(text), {{"q1", q1}, {"q2", q2}, {"dq1", dq1}});
    };
    EXPECT_EQ(value(0, 0.5, 0), 0);
    EXPECT_EQ(value(0, 2, 0), 0);
    EXPECT_FALSE(std::isnan(value(1e-200, 1, 1e-200)));
    EXPECT_EQ(read(to_string(read(text))), read(text));
    EXPECT_EQ(read(to_string(graph.constant(3) * (read(text) * read("q2")))), graph.constant(3) * (read(text) * read("q2")));
  }
  EXPECT_DOUBLE_EQ(test::evaluate(read("-2*q2*q1/sqrt(q1^2 + q2^2)"), {{"q1", 3}, {"q2", 4}}), -24.0 / 5);
  // its slope is that of sign there
  const auto slope = [&](const std::string& text, double q1, double q2) {
    return test::evaluate(graph.differentiate(read(text), graph.variable("q1")), {{"q1", q1}, {"q2", q2}});
  };
  for (const std::string text : {"q1/abs(q1)", "q1/sqrt(q1^2 + q2^2)", "q2/sqrt(q1^2 + q2^2)"}) EXPECT_EQ(slope(text, 0, 0), 0);
  EXPECT_DOUBLE_EQ(slope("q1/sqrt(q1^2 + q2^2)", 0, 2), 0.5);
  // a velocity that dies away has a direction all the way, though its square is 0 before it is
  for (double v = 1e-3; v > 0; v /= 2) {
    for (const std::string text : {"q1/abs(q1)", "q1/sqrt(q1^2 + q2^2)"}) {
      for (const double w : {0.0, v}) {
        const double value = test::evaluate(read(text), {{"q1", v}, {"q2", w}});
        EXPECT_TRUE(value >= 0 && value <= 1 + 1e-15) << text << " at " << v << ", " << w << ": " << value;
        EXPECT_TRUE(std::isfinite(slope(text, v, w))) << text << " at " << v << ", " << w << ": " << slope(text, v, w);
      }
    }
    EXPECT_NEAR(slope("q1/abs(q1)", v, 0), 0, 4 * std::numeric_limits<double>::epsilon() / v);
  }
  EXPECT_NEAR(slope("q1/sqrt(q1^2 + q2^2)", 3, 4), 16.0 / 125, 1e-15);
  // parts that are shared are looked at once
  Expression shared = graph.variable("q1");
  for (int k = 0; k < 100; ++k) shared = shared * shared + shared;
  const auto resolve = [&](std::string_view name) { return std::optional(name == "s" ? shared : graph.variable("q1")); };
  EXPECT_EQ(parse_expression("s*q1/sqrt(s + q1^2)", graph, resolve, {}).operation(), Operation::multiply_or_zero);
  // the time of a long quotient grows with its length, whether its denominators are the same or not
  const auto start = std::chrono::steady_clock::now();
  std::string same = "q1", other = "q1";
  for (int k = 0; k < 8000; ++k) same += "/abs(q2)";
  for (int k = 0; k < 4000; ++k) other += "/abs(q2*" + std::to_string(k) + ".5)";
  EXPECT_EQ(error(same) + error(other), "");
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(2));
  // other quotients have no value there
  for (const std::string text : {"sin(q1)/abs(q1)", "q1/sqrt(q1)", "(q1 + q2)/abs(q1)", "2*sin(q1)/abs(2*q1)",
                                 "q1/abs(q1)/abs(q1)", "q1/(3 + abs(q1) - 3)"}) {
    EXPECT_TRUE(std::isnan(test::evaluate(read(text), {{"q1", 0}, {"q2", 0}}))) << text;
  }
}

TEST_F(ParserTest, AComponentOverItsLengthMayHaveFactors) {
  for (const std::string text : {"q1/(2*abs(q1))", "q1/(mass*sqrt(q1^2 + q2^2))", "q1/abs(2*q1)", "q1/abs(-q1)",
                                 "mass*q1/sqrt((mass*q1)^2 + q2^2)", "-q1/(-abs(q1))", "q1/-abs(q1)", "q1/(abs(q1)/mass)",
                                 "3*q1/mass/(-mass*abs(q1/mass))", "mass*q1/(q2 - q1 + 2)/abs(-2*mass*q1)"}) {
    SCOPED_TRACE(text);
    EXPECT_EQ(test::evaluate(read(text), {{"q1", 0}, {"q2", 0}, {"mass", 7}}), 0);
    EXPECT_EQ(read(to_string(read(text))), read(text)) << to_string(read(text));
  }
  EXPECT_DOUBLE_EQ(value("q1/(mass*sqrt(q1^2 + q2^2))"), 2 / (7 * std::sqrt(13)));
  EXPECT_DOUBLE_EQ(value("dq2/(-2*abs(3*dq2))"), 1.0 / 6);
  EXPECT_DOUBLE_EQ(value("dq2/(abs(-dq2)/mass)"), -7);
}

}  // namespace
}  // namespace gp2
