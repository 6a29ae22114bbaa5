#include <array>
#include <bit>
#include <cstdint>
#include <thread>
#include <tuple>

#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "input_error.hpp"
#include "random_expression.hpp"

namespace gp2 {
namespace {

constexpr unsigned seed = 11;

/// The bits of x; one pattern stands for every NaN.
std::uint64_t bits(double x) { return std::isnan(x) ? ~std::uint64_t{0} : std::bit_cast<std::uint64_t>(x); }

/// Many random outputs (and their derivatives) of x1, x2 per point and x3, x4 shared.
class TapeTest : public testing::Test {
 protected:
  TapeTest() {
    for (int k = 0; k < 60; ++k) {
      outputs.push_back(random.draw(5));
      outputs.push_back(graph.differentiate(outputs.back(), random.variables[static_cast<std::size_t>(k % 4)]));
    }
    tape = Tape(outputs, random.variables);
    for (Eigen::Index point = 0; point < n_points; ++point) {
      for (Eigen::Index row = 0; row < 2; ++row) values(row, point) = random.integer(-2000, 2000) / 1000.0;
    }
  }

  [[nodiscard]] Eigen::MatrixXd evaluate(const Eigen::MatrixXd& points) const {
    Eigen::MatrixXd results;
    tape.evaluate(points, shared, results);
    return results;
  }

  static constexpr Eigen::Index n_points = 203;  // three full blocks and a part of one
  ExpressionGraph graph;
  test::RandomExpressions random{graph, seed, true};
  std::vector<Expression> outputs;
  Tape tape;
  Eigen::MatrixXd values{2, n_points};
  Eigen::VectorXd shared = Eigen::Vector2d(0.75, -1.3);
};

TEST_F(TapeTest, AgreesWithRecursiveEvaluation) {
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  const Eigen::MatrixXd results = evaluate(values);
  ASSERT_EQ(results.rows(), static_cast<Eigen::Index>(outputs.size()));
  ASSERT_EQ(results.cols(), n_points);
  int finite = 0;
  for (Eigen::Index point = 0; point < n_points; point += 20) {
    const std::map<std::string, double> at{
        {"x1", values(0, point)}, {"x2", values(1, point)}, {"x3", shared[0]}, {"x4", shared[1]}};
    for (std::size_t k = 0; k < outputs.size(); ++k) {
      const double expected = test::evaluate(outputs[k], at);
      const double got = results(static_cast<Eigen::Index>(k), point);
      if (!std::isfinite(expected)) {
        EXPECT_EQ(bits(got), bits(expected)) << to_string(outputs[k]);
        continue;
      }
      ++finite;
      // only integer powers are computed another way: a few roundings
      EXPECT_NEAR(got, expected, 1e-12 * (1 + std::abs(expected))) << to_string(outputs[k]);
    }
  }
  EXPECT_GT(finite, 1000);
}

TEST_F(TapeTest, TheResultOfAPointDependsNeitherOnTheBatchNorOnItsPlaceInIt) {
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  const Eigen::MatrixXd together = evaluate(values);
  const Eigen::MatrixXd backwards = evaluate(values.rowwise().reverse()).rowwise().reverse();
  const Eigen::MatrixXd part = evaluate(values.middleCols(5, 70));
  for (Eigen::Index point = 0; point < n_points; ++point) {
    const Eigen::MatrixXd alone = evaluate(values.col(point));
    for (Eigen::Index row = 0; row < together.rows(); ++row) {
      ASSERT_EQ(bits(together(row, point)), bits(alone(row, 0)));
      ASSERT_EQ(bits(together(row, point)), bits(backwards(row, point)));
      if (point >= 5 && point < 75) {
        ASSERT_EQ(bits(together(row, point)), bits(part(row, point - 5)));
      }
    }
  }
}

TEST_F(TapeTest, InputsMayBeSharedOrPerPointWithTheSameResult) {
  Eigen::MatrixXd all(4, n_points);
  all << values, shared.replicate(1, n_points);
  Eigen::MatrixXd results;
  tape.evaluate(all, Eigen::VectorXd(0), results);
  const Eigen::MatrixXd expected = evaluate(values);
  for (Eigen::Index k = 0; k < results.size(); ++k) ASSERT_EQ(bits(results(k)), bits(expected(k)));

  Eigen::VectorXd none_per_point(4);
  none_per_point << values.col(0), shared;
  tape.evaluate(Eigen::MatrixXd(0, 1), none_per_point, results);
  for (Eigen::Index k = 0; k < results.size(); ++k) ASSERT_EQ(bits(results(k)), bits(expected(k, 0)));
}

TEST_F(TapeTest, ThreadsShareATape) {
  const Eigen::MatrixXd expected = evaluate(values);
  std::vector<Eigen::MatrixXd> results(4);
  std::vector<std::thread> threads;
  for (Eigen::MatrixXd& result : results) threads.emplace_back([&] { tape.evaluate(values, shared, result); });
  for (std::thread& thread : threads) thread.join();
  for (const Eigen::MatrixXd& result : results) {
    for (Eigen::Index k = 0; k < result.size(); ++k) ASSERT_EQ(bits(result(k)), bits(expected(k)));
  }
}

TEST_F(TapeTest, OnePointAfterAnotherGivesTheBitsOfABatchAndAllocatesNothing) {
  const Eigen::MatrixXd expected = evaluate(values);
  Eigen::VectorXd workspace = tape.make_workspace(shared);
  Eigen::MatrixXd results(tape.n_outputs(), n_points);
  EXPECT_EQ(test::allocations_of([&] {
              for (Eigen::Index point = 0; point < n_points; ++point)
                tape.evaluate_at(values.col(point), workspace, results.col(point));
            }),
            0U);
  for (Eigen::Index k = 0; k < results.size(); ++k) EXPECT_EQ(bits(results.data()[k]), bits(expected.data()[k]));
}

TEST_F(TapeTest, OutputsMayBeSpreadOverSeveralMatrices) {
  const Eigen::MatrixXd expected = evaluate(values);
  Eigen::MatrixXd first(7, n_points), none(0, n_points), second(1, n_points), rest(tape.n_outputs() - 8, n_points);
  std::array<Eigen::Ref<Eigen::MatrixXd>, 4> parts{first, none, second, rest};
  tape.evaluate(values, shared, parts);
  Eigen::MatrixXd together(tape.n_outputs(), n_points);
  together << first, second, rest;
  for (Eigen::Index k = 0; k < together.size(); ++k) EXPECT_EQ(bits(together.data()[k]), bits(expected.data()[k]));
}

TEST_F(TapeTest, StateDerivativesAreTheEntriesOfTheJacobianThatDoNotVanish) {
  const StateDerivatives derivatives(outputs, random.variables, 2);
  Eigen::MatrixXd sparse;
  derivatives.tape.evaluate(values, shared, sparse);
  std::size_t next = 0;
  for (int k = 0; k < 2; ++k) {
    for (int i = 0; i < tape.n_outputs(); ++i) {
      const Expression derivative =
          graph.differentiate(outputs[static_cast<std::size_t>(i)], random.variables[static_cast<std::size_t>(k)]);
      if (derivative.is_constant(0)) continue;
      ASSERT_LT(next, derivatives.entries.size());
      EXPECT_EQ(derivatives.entries[next].output, i);
      EXPECT_EQ(derivatives.entries[next].state_index, k);
      Eigen::MatrixXd alone;
      Tape(std::span(&derivative, 1), random.variables).evaluate(values, shared, alone);
      for (Eigen::Index point = 0; point < n_points; ++point) {
        EXPECT_EQ(bits(sparse(static_cast<Eigen::Index>(next), point)), bits(alone(0, point)));
      }
      ++next;
    }
  }
  EXPECT_EQ(next, derivatives.entries.size());
  EXPECT_LT(next, static_cast<std::size_t>(2 * tape.n_outputs()));
}

TEST_F(TapeTest, NoPointsGiveNoResults) {
  const Eigen::MatrixXd results = evaluate(Eigen::MatrixXd(2, 0));
  EXPECT_EQ(results.rows(), tape.n_outputs());
  EXPECT_EQ(results.cols(), 0);
}

TEST(Tape, ComputesSharedSubexpressionsOnceAndNothingUnneeded) {
  ExpressionGraph graph;
  const Expression x = graph.variable("x"), y = graph.variable("y"), z = graph.variable("z");
  const Expression s = graph.apply(Operation::sin, x * y);
  graph.apply(Operation::cos, z);  // not an output
  const std::vector<Expression> outputs{s + x, s * s, x, graph.constant(2.5), s + x};
  const Tape tape(outputs, std::vector{x, y, z});
  EXPECT_EQ(tape.n_instructions(), 4U);  // x*y, sin, +, *
  EXPECT_EQ(tape.n_outputs(), 5);
  EXPECT_TRUE(tape.uses_input(0));
  EXPECT_TRUE(tape.uses_input(1));
  EXPECT_FALSE(tape.uses_input(2));
  Eigen::MatrixXd results;
  tape.evaluate(Eigen::Vector3d(0.5, 2, NAN), Eigen::VectorXd(0), results);
  const double sine = std::sin(0.5 * 2);
  EXPECT_EQ(results.col(0), (Eigen::VectorXd(5) << sine + 0.5, sine * sine, 0.5, 2.5, sine + 0.5).finished());
}

TEST(Tape, IntegerPowersAreRepeatedSquaring) {
  ExpressionGraph graph;
  const Expression x = graph.variable("x");
  std::vector<Expression> outputs;
  for (int n = -64; n <= 64; ++n) outputs.push_back(graph.apply(Operation::power, x, graph.constant(n)));
  const Tape tape(outputs, std::vector{x});
  Eigen::MatrixXd results;
  tape.evaluate(Eigen::RowVector3d(1.1, -0.7, 2), Eigen::VectorXd(0), results);
  for (int n = -64; n <= 64; ++n) {
    for (Eigen::Index k = 0; k < 3; ++k) {
      const double expected = std::pow(k == 0 ? 1.1 : k == 1 ? -0.7 : 2, n);
      EXPECT_NEAR(results(n + 64, k), expected, 2e-14 * std::abs(expected)) << n;
    }
    EXPECT_EQ(results(n + 64, 2), std::ldexp(1.0, n)) << "powers of two are exact";
  }
}

TEST(Tape, FoldsConstantsWithTheArithmeticItEvaluatesWith) {
  ExpressionGraph graph;
  const Expression x = graph.variable("x");
  const double value = 1.1;
  std::vector<Expression> outputs;
  for (const double n : {7.0, -13.0, 64.0, 65.0, 0.3}) outputs.push_back(graph.apply(Operation::power, x, graph.constant(n)));
  for (const Operation f : {Operation::sin, Operation::exp, Operation::tanh}) outputs.push_back(graph.apply(f, x));
  Eigen::MatrixXd results;
  Tape(outputs, std::vector{x}).evaluate(Eigen::MatrixXd::Constant(1, 1, value), Eigen::VectorXd(0), results);
  for (std::size_t k = 0; k < outputs.size(); ++k) {
    const Expression folded = graph.substitute(outputs[k], {{"x", graph.constant(value)}});
    EXPECT_EQ(folded.constant_value(), results(static_cast<Eigen::Index>(k), 0));
  }
}

TEST(Tape, NanIsNeverSwallowed) {
  ExpressionGraph graph;
  const Expression x = graph.variable("x"), y = graph.variable("y");
  const std::vector<Expression> outputs{graph.apply(Operation::min, x, y), graph.apply(Operation::max, x, y),
                                        graph.apply(Operation::sign, x + y)};
  const Tape tape(outputs, std::vector{x, y});
  Eigen::MatrixXd points(2, 2), results;
  points << NAN, 1, 1, NAN;
  tape.evaluate(points, Eigen::VectorXd(0), results);
  EXPECT_TRUE(results.array().isNaN().all()) << results;
}

TEST(Tape, ErrorsNameTheFault) {
  ExpressionGraph graph, other;
  const Expression x = graph.variable("x"), y = graph.variable("y");
  EXPECT_EQ(test::input_error_of([&] { Tape(std::vector{x * y}, std::vector{x}); }),
            "tape: an output depends on 'y', which is not among the inputs; add it to them");
  EXPECT_EQ(test::input_error_of([&] {
              Tape(std::vector{x}, std::vector{x, x * y});
            }),
            "tape: input 2 must be a variable of the graph of the outputs");
  EXPECT_EQ(test::input_error_of([&] {
              Tape(std::vector{x, other.variable("x")}, std::vector{x});
            }),
            "tape: all outputs must belong to one graph");
  Eigen::MatrixXd results;
  EXPECT_EQ(test::input_error_of([&] {
              Tape(std::vector{x * y}, std::vector{x, y}).evaluate(Eigen::MatrixXd(1, 3), Eigen::VectorXd(2), results);
            }),
            "tape: evaluate needs 2 inputs, got 1 per point and 2 shared");
  EXPECT_EQ(test::input_error_of([&] {
              std::ignore = Tape(std::vector{x * y}, std::vector{x, y}).make_workspace(Eigen::VectorXd::Zero(3));
            }),
            "tape: make_workspace takes at most the 2 inputs, got 3 shared");
}

TEST(Tape, RefusesNumbersThatSinglePrecisionLacks) {
  ExpressionGraph graph;
  const Expression x = graph.variable("x");
  const std::vector<std::string> input{"x"}, result{"y"};
  const Tape tape(std::vector{graph.constant(1e60) * x}, std::vector{x});
  EXPECT_EQ(tape.as_c(input, result, /*single_precision=*/false), "  y = 1e+60*x;\n");
  EXPECT_EQ(test::input_error_of([&] { static_cast<void>(tape.as_c(input, result, /*single_precision=*/true)); }),
            "the number 1e+60 does not fit single precision: leave `float` out");
}

}  // namespace
}  // namespace gp2
