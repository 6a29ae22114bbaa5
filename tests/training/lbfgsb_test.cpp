#include "training/lbfgsb.hpp"

#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <thread>
#include <vector>

#include <unistd.h>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace gp2 {
namespace {

using Eigen::VectorXd;
using testing::HasSubstr;

constexpr double infinity = std::numeric_limits<double>::infinity();

// minimum 0 at (1, …, 1)
double rosenbrock(const VectorXd& x, VectorXd& gradient) {
  double value = 0;
  gradient.setZero();
  for (Eigen::Index i = 0; i + 1 < x.size(); ++i) {
    const double a = 1 - x[i], b = x[i + 1] - x[i] * x[i];
    value += a * a + 100 * b * b;
    gradient[i] += -2 * a - 400 * x[i] * b;
    gradient[i + 1] += 200 * b;
  }
  return value;
}

VectorXd constant(int n, double value) { return VectorXd::Constant(n, value); }

// The Fortran of the authors reports an ascent direction with a print statement: here for every fifth seed
TEST(LbfgsbDeathTest, NeverWritesToStandardOutput) {
  const auto run = [] {
    // in a process of its own, because what is written may come out when the process ends
    std::fflush(stdout);
    if (dup2(STDERR_FILENO, STDOUT_FILENO) < 0) std::exit(1);
    LbfgsbOptions options;
    options.gradient_tolerance = 0;
    options.reduction_tolerance = 0;
    for (int seed = 0; seed < 100; ++seed) {
      // a narrow valley, some of whose minima lie on a bound, with a small error in the gradient
      const auto valley = [&](const VectorXd& x, VectorXd& gradient) {
        const double along = x[0] - std::sin(seed), across = x[1] - 0.9 * x[0] - std::sin(seed + 1);
        gradient = Eigen::Vector2d(along - 0.9e10 * across, 1e10 * across);
        gradient[0] += 1e-6 * std::sin(1e3 * (2 * x[0] + x[1]));
        gradient[1] += 1e-6 * std::sin(1e3 * (x[0] + 2 * x[1]) + seed);
        return 1 + 0.5 * along * along + 0.5e10 * across * across;
      };
      minimise(valley, constant(2, -0.5), constant(2, -1), constant(2, 1), options);
    }
    std::exit(0);
  };
  EXPECT_EXIT(run(), testing::ExitedWithCode(0), testing::IsEmpty());
}

TEST(LbfgsbTest, FindsTheMinimumInsideTheBox) {
  for (int n : {2, 5, 20}) {
    const LbfgsbResult result = minimise(rosenbrock, constant(n, -0.5), constant(n, -3), constant(n, 3), {});
    EXPECT_TRUE(result.converged) << result.termination;
    // a gradient below 1e-5 on a Hessian whose smallest eigenvalue is near 0.4
    EXPECT_LE((result.x - constant(n, 1)).cwiseAbs().maxCoeff(), 1e-4);
    EXPECT_GT(result.iterations, 5);
    EXPECT_GE(result.evaluations, result.iterations);
    EXPECT_EQ(result.failed_evaluations, 0);
  }
}

TEST(LbfgsbTest, FindsTheMinimumOnABound) {
  // with x₁ ≤ ½ the minimum is at (½, ¼), where (1 − ½)² remains
  const LbfgsbResult result = minimise(rosenbrock, constant(2, -1), constant(2, -2), Eigen::Vector2d(0.5, 2), {});
  EXPECT_TRUE(result.converged) << result.termination;
  EXPECT_EQ(result.x[0], 0.5);
  EXPECT_NEAR(result.x[1], 0.25, 1e-6);
  EXPECT_NEAR(result.value, 0.25, 1e-9);
}

TEST(LbfgsbTest, StaysInTheBoxFromTheFirstEvaluationOn) {
  const VectorXd lower = constant(3, -0.2), upper = constant(3, 0.4);
  const auto checked = [&](const VectorXd& x, VectorXd& gradient) {
    EXPECT_TRUE((x.array() >= lower.array()).all() && (x.array() <= upper.array()).all()) << x.transpose();
    return rosenbrock(x, gradient);
  };
  minimise(checked, constant(3, -7), lower, upper, {});
}

TEST(LbfgsbTest, StepsBackWhereTheFunctionIsInfinite) {
  int n_infinite = 0;
  const auto half = [&](const VectorXd& x, VectorXd& gradient) {
    // the first steps from the start overshoot into the forbidden part
    if (x[0] > 1.2 || x[1] > 1.3) {
      ++n_infinite;
      return infinity;
    }
    return rosenbrock(x, gradient);
  };
  const LbfgsbResult result = minimise(half, Eigen::Vector2d(-1.2, -2.9), constant(2, -3), constant(2, 30), {});
  EXPECT_TRUE(result.converged) << result.termination;
  EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-4);
  EXPECT_GT(n_infinite, 0) << "nothing was tested";
  EXPECT_EQ(result.failed_evaluations, n_infinite);
  EXPECT_TRUE(std::isfinite(result.value));
}

TEST(LbfgsbTest, ShortensAStepIntoTheInfiniteTenfold) {
  // ½(x − 10)²: the first step goes to the minimum, where the function is infinite
  std::vector<double> visited;
  const auto parabola = [&](const VectorXd& x, VectorXd& gradient) {
    visited.push_back(x[0]);
    gradient[0] = x[0] - 10;
    return x[0] > 3 ? infinity : 0.5 * gradient[0] * gradient[0];
  };
  LbfgsbOptions options;
  options.max_iterations = 1;
  minimise(parabola, constant(1, 0), constant(1, -100), constant(1, 100), options);
  ASSERT_EQ(visited.size(), 3u);
  EXPECT_NEAR(visited[1], 10, 1e-12);
  EXPECT_NEAR(visited[2], 1, 1e-12);
}

TEST(LbfgsbTest, DoesNotLeapIntoACornerThatIsBetterThanTheStart) {
  // a wall at the start, a minimum near it and a plateau below the wall in the corner
  const auto plateau = [](const VectorXd& x, VectorXd& gradient) {
    const double e = std::exp(-10 * (x[0] + 1)), well = std::exp(-0.5 * (x[0] - 1) * (x[0] - 1));
    gradient[0] = -10000 * e + 100 * (x[0] - 1) * well;
    return 1000 * e - 100 * well;
  };
  const LbfgsbResult result = minimise(plateau, constant(1, -1), constant(1, -2), constant(1, 50), {});
  EXPECT_NEAR(result.x[0], 1, 1e-3);
}

TEST(LbfgsbTest, EndsAtTheEdgeOfAnInfiniteRegionWithTheBestPointItSaw) {
  // the minimum lies beyond the edge; there is no stationary point to converge to, from wherever the edge is reached
  for (int k = 0; k < 200; ++k) {
    double best = infinity;
    const auto cut = [&](const VectorXd& x, VectorXd& gradient) {
      if (x[0] > 0.5) return infinity;
      const double value = rosenbrock(x, gradient);
      best = std::min(best, value);
      return value;
    };
    const Eigen::Vector2d start(-0.5 + 0.004 * k, -0.5);
    const LbfgsbResult result = minimise(cut, start, constant(2, -3), constant(2, 3), {});
    EXPECT_FALSE(result.converged) << "start " << k << ": " << result.termination;
    EXPECT_EQ(result.termination, "the objective cannot be computed just beyond the best point, where it still falls");
    EXPECT_LE(result.x[0], 0.5);
    VectorXd gradient(2);
    EXPECT_EQ(result.value, rosenbrock(result.x, gradient)) << "value and point belong together";
    EXPECT_LT(result.value, 0.5) << "close to the edge, where it is a quarter";
    EXPECT_GE(result.value, best);
  }
}

TEST(LbfgsbTest, AnOptimumAtTheEdgeOfAnInfiniteRegionIsOne) {
  LbfgsbOptions options;
  options.gradient_tolerance = 0;
  for (int k = 0; k < 50; ++k) {
    const auto half = [](const VectorXd& x, VectorXd& gradient) { return x[0] > 1 ? infinity : rosenbrock(x, gradient); };
    const LbfgsbResult result = minimise(half, Eigen::Vector2d(-1.2 + 0.01 * k, -2.9), constant(2, -3), constant(2, 30), options);
    EXPECT_GT(result.failed_evaluations, 0) << "nothing was tested";
    EXPECT_TRUE(result.converged) << "start " << k << ": " << result.termination;
    EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-2);
  }
}

TEST(LbfgsbTest, AnInfiniteRegionThatWasLeftBehindIsNoHindranceToConvergence) {
  LbfgsbOptions options;
  options.gradient_tolerance = 0;
  for (int k = 0; k < 50; ++k) {
    const auto half = [](const VectorXd& x, VectorXd& gradient) {
      return x[0] > 1.2 || x[1] > 1.3 ? infinity : rosenbrock(x, gradient);
    };
    const LbfgsbResult result = minimise(half, Eigen::Vector2d(-1.2 + 0.01 * k, -2.9), constant(2, -3), constant(2, 30), options);
    EXPECT_GT(result.failed_evaluations, 0) << "nothing was tested";
    EXPECT_TRUE(result.converged) << "start " << k << ": " << result.termination;
    EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-4);
  }
}

// Rosenbrock's function of six variables, two of which end at a bound; four pairs are kept of 28
struct Bounded {
  VectorXd start = constant(6, -1), lower = constant(6, -3), upper = constant(6, 3);
  LbfgsbOptions options;

  Bounded() {
    upper[1] = 0.5;
    lower[4] = 0.25;
    options.memory = 4;
  }
};

// its path must differ from the authors' by rounding errors only: values after each iteration of their Fortran 3.0
TEST(LbfgsbTest, TakesTheStepsOfTheFortran) {
  Bounded problem;
  std::vector<double> values;
  problem.options.iteration = [&](int, const VectorXd&, double value) {
    values.push_back(value);
    return true;
  };
  const LbfgsbResult result = minimise(rosenbrock, problem.start, problem.lower, problem.upper, problem.options);
  constexpr std::array expected = {
      272.71179330157588, 61.452967497838898, 42.073978767687713, 16.96579196776457,  12.327274105065092, 11.090694149994201,
      10.831232181174588, 10.806112325730027, 10.741664894167029, 10.635307468491122, 10.497583754857704, 10.297134663436202,
      9.8331549702017167, 9.7474473964538326, 9.5427437653355334, 9.3431731955382542, 8.9901917218887029, 8.6031103640492912,
      8.3452895189085332, 7.8641838540288722, 7.8449411402655791, 7.8441034678096697, 7.8440559077689134, 7.8440544359957443,
      7.8440540908457352, 7.844054066335044,  7.8440540659132543, 7.8440540659123661};
  ASSERT_EQ(values.size(), expected.size());
  for (std::size_t k = 0; k < expected.size(); ++k) EXPECT_NEAR(values[k], expected[k], 1e-11 * expected[k]) << "iteration " << k;
  EXPECT_EQ(result.evaluations, 34);
  EXPECT_EQ(result.termination, "the projected gradient fell below its tolerance");
}

// no library may have a say in the path: the bits of all points that are visited, and of the last one
TEST(LbfgsbTest, TakesTheSameStepsToTheBitOnEveryMachine) {
  struct Expected {
    double edge;  // infinite where x₁ + x₆ is above it
    int evaluations;
    std::uint64_t path;
    std::array<double, 6> x;
  };
  const std::array<Expected, 2> all = {
      {{infinity,
        34,
        0xfcb1cb619c839996,
        {0x1.6ac84f6bd557dp-1, 0x1p-1, 0x1.3f491bbf15bbbp-2, 0x1.7b79400278fe7p-3, 0x1p-2, 0x1.fffffb3aa8bd6p-5}},
       {0.3,
        160,
        0xa23244b5b5c07a99,
        {0x1.f03235a25bffdp-3, 0x1.86f6a3122161dp-5, 0x1.f0e6a1d9042c8p-8, 0x1.80b5bfccf1626p-5, 0x1p-2, 0x1.d8d0c31026fe7p-5}}}};
  for (const Expected& expected : all) {
    SCOPED_TRACE(expected.edge);
    std::uint64_t path = 14695981039346656037U;  // FNV-1a, of doubles instead of bytes
    const auto cut = [&](const VectorXd& x, VectorXd& gradient) {
      for (const double entry : x) path = (path ^ std::bit_cast<std::uint64_t>(entry)) * 1099511628211U;
      return x[0] + x[5] > expected.edge ? infinity : rosenbrock(x, gradient);
    };
    const Bounded problem;
    const LbfgsbResult result = minimise(cut, problem.start, problem.lower, problem.upper, problem.options);
    EXPECT_EQ(result.evaluations, expected.evaluations);
    EXPECT_EQ(path, expected.path) << std::hex << path;
    for (int i = 0; i < 6; ++i) {
      EXPECT_EQ(result.x[i], expected.x[static_cast<std::size_t>(i)]) << fmt::format("x[{}] = {:a}", i, result.x[i]);
    }
  }
}

TEST(LbfgsbTest, CallsTheRoundingErrorsOfTheObjectiveConvergence) {
  LbfgsbOptions options;
  options.gradient_tolerance = 0;
  options.reduction_tolerance = 0;
  int n_rounding = 0;
  for (int seed = 0; seed < 100; ++seed) {
    // 1 + Rosenbrock's function as it would come from a computation that loses four digits
    const auto rounded = [&](const VectorXd& x, VectorXd& gradient) {
      const double value = 1 + rosenbrock(x, gradient);
      return value + 1e-12 * std::sin(1e12 * (x[0] + 2 * x[1]) + seed);
    };
    double lowest = infinity;
    options.iteration = [&](int, const VectorXd&, double value) {
      lowest = std::min(lowest, value);
      return true;
    };
    const LbfgsbResult result = minimise(rounded, constant(2, -0.5), constant(2, -3), constant(2, 3), options);
    EXPECT_TRUE(result.converged) << "seed " << seed << ": " << result.termination;
    EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-4) << "seed " << seed;
    EXPECT_EQ(result.value, lowest) << "seed " << seed;
    VectorXd gradient(2);
    EXPECT_EQ(result.value, rounded(result.x, gradient)) << "seed " << seed << ": value and point belong together";
    n_rounding += result.termination == "the objective cannot be lowered further in double precision";
  }
  EXPECT_GT(n_rounding, 0) << "nothing was tested";
}

TEST(LbfgsbTest, AWrongGradientIsNoConvergence) {
  const auto wrong = [](const VectorXd& x, VectorXd& gradient) {
    const double value = rosenbrock(x, gradient);
    gradient = -gradient;
    return value;
  };
  const LbfgsbResult result = minimise(wrong, constant(2, -0.5), constant(2, -3), constant(2, 3), {});
  EXPECT_FALSE(result.converged);
  EXPECT_THAT(result.termination, HasSubstr("the line search could not lower the objective further"));
  EXPECT_EQ(result.x, constant(2, -0.5));
}

TEST(LbfgsbTest, KeepsTheLowestIterateOfAFunctionThatAnswersDifferentlyEachTime) {
  LbfgsbOptions options;
  options.gradient_tolerance = 0;
  options.reduction_tolerance = 0;
  double lowest = infinity;
  options.iteration = [&](int, const VectorXd&, double value) {
    EXPECT_LE(value, lowest) << "an iteration never raises the value";
    lowest = value;
    return true;
  };
  int call = 0;
  const auto drifting = [&](const VectorXd& x, VectorXd& gradient) { return rosenbrock(x, gradient) + 1e-6 * std::sin(++call); };
  const LbfgsbResult result = minimise(drifting, constant(2, -0.5), constant(2, -3), constant(2, 3), options);
  EXPECT_EQ(result.value, lowest);
}

TEST(LbfgsbTest, AGradientThatIsNotANumberCountsAsInfinite) {
  int n_broken = 0;
  const auto broken = [&](const VectorXd& x, VectorXd& gradient) {
    const double value = rosenbrock(x, gradient);
    if (x[0] > 1.2) {
      gradient[1] = std::nan("");
      ++n_broken;
    }
    return value;
  };
  const LbfgsbResult result = minimise(broken, constant(2, -1), constant(2, -3), constant(2, 30), {});
  EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-4);
  EXPECT_EQ(result.failed_evaluations, n_broken);
  EXPECT_FALSE(minimise(broken, constant(2, 2), constant(2, -3), constant(2, 30), {}).converged);
}

TEST(LbfgsbTest, ANotANumberCountsAsInfinite) {
  const auto broken = [&](const VectorXd& x, VectorXd& gradient) { return x[0] > 1.2 ? std::nan("") : rosenbrock(x, gradient); };
  const LbfgsbResult result = minimise(broken, constant(2, -1), constant(2, -3), constant(2, 30), {});
  EXPECT_LE((result.x - constant(2, 1)).cwiseAbs().maxCoeff(), 1e-4);
}

TEST(LbfgsbTest, AStartThatIsInfiniteIsReported) {
  const LbfgsbResult result =
      minimise([](const VectorXd&, VectorXd&) { return infinity; }, constant(2, 0), constant(2, -1), constant(2, 1), {});
  EXPECT_EQ(result.value, infinity);
  EXPECT_FALSE(result.converged);
  EXPECT_THAT(result.termination, HasSubstr("no finite value at the start"));
  EXPECT_EQ(result.x, constant(2, 0));
}

TEST(LbfgsbTest, NoIterationsKeepsTheStart) {
  LbfgsbOptions options;
  options.max_iterations = 0;
  const LbfgsbResult result = minimise(rosenbrock, constant(2, -1), constant(2, -2), constant(2, 2), options);
  EXPECT_EQ(result.x, constant(2, -1));
  EXPECT_EQ(result.evaluations, 1);
  EXPECT_FALSE(result.converged);
}

TEST(LbfgsbTest, TheLimitOfIterationsStopsAndIsNoConvergence) {
  LbfgsbOptions options;
  options.max_iterations = 3;
  const LbfgsbResult result = minimise(rosenbrock, constant(5, -1), constant(5, -2), constant(5, 2), options);
  EXPECT_EQ(result.iterations, 3);
  EXPECT_FALSE(result.converged);
  EXPECT_THAT(result.termination, HasSubstr("limit of iterations"));
}

TEST(LbfgsbTest, SaysWhichInequalityStoppedIt) {
  LbfgsbOptions by_gradient;
  by_gradient.reduction_tolerance = 0;
  by_gradient.gradient_tolerance = 1e-3;
  EXPECT_THAT(minimise(rosenbrock, constant(4, -1), constant(4, -2), constant(4, 2), by_gradient).termination,
              HasSubstr("gradient"));
  LbfgsbOptions by_reduction;
  by_reduction.reduction_tolerance = 1e-2;
  by_reduction.gradient_tolerance = 0;
  EXPECT_THAT(minimise(rosenbrock, constant(4, -1), constant(4, -2), constant(4, 2), by_reduction).termination,
              HasSubstr("relative reduction"));
}

TEST(LbfgsbTest, ATighterGradientToleranceIsReached) {
  for (double tolerance : {1e-2, 1e-5, 1e-8}) {
    LbfgsbOptions options;
    options.gradient_tolerance = tolerance;
    options.reduction_tolerance = 0;
    const LbfgsbResult result = minimise(rosenbrock, constant(4, -1), constant(4, -2), constant(4, 2), options);
    EXPECT_TRUE(result.converged) << result.termination;
    VectorXd gradient(4);
    rosenbrock(result.x, gradient);
    EXPECT_LE(gradient.cwiseAbs().maxCoeff(), tolerance);
  }
}

TEST(LbfgsbTest, TheCallbackSeesEveryIterationAndCanStop) {
  std::vector<int> seen;
  double last = infinity;
  LbfgsbOptions options;
  options.iteration = [&](int iteration, const VectorXd&, double value) {
    seen.push_back(iteration);
    EXPECT_LE(value, last) << "an iteration never raises the value";
    last = value;
    return seen.size() < 4;
  };
  const LbfgsbResult result = minimise(rosenbrock, constant(5, -1), constant(5, -2), constant(5, 2), options);
  EXPECT_EQ(seen, (std::vector<int>{1, 2, 3, 4}));
  EXPECT_FALSE(result.converged);
  EXPECT_EQ(result.value, last);
  EXPECT_THAT(result.termination, HasSubstr("stopped on request"));
}

TEST(LbfgsbTest, StopsBeforeTheNextEvaluationWithTheBestSoFar) {
  LbfgsbOptions options;
  int asked = 0;
  options.stop = [&] { return ++asked > 6; };
  const LbfgsbResult result = minimise(rosenbrock, constant(5, -1), constant(5, -2), constant(5, 2), options);
  EXPECT_EQ(result.evaluations, 7) << "that of the start, then six";
  EXPECT_FALSE(result.converged);
  EXPECT_THAT(result.termination, HasSubstr("stopped on request"));
  Eigen::VectorXd gradient(5);
  EXPECT_EQ(result.value, rosenbrock(result.x, gradient));
}

TEST(LbfgsbTest, RunsInSeveralThreadsAtOnceAsInOne) {
  const auto run = [](int n) { return minimise(rosenbrock, constant(n, -0.7), constant(n, -3), constant(n, 3), {}); };
  std::vector<LbfgsbResult> results(8);
  {
    std::vector<std::jthread> threads;
    for (int k = 0; k < 8; ++k) {
      threads.emplace_back([&, k] { results[static_cast<std::size_t>(k)] = run(2 + k); });
    }
  }
  for (int k = 0; k < 8; ++k) EXPECT_EQ(results[static_cast<std::size_t>(k)].x, run(2 + k).x);
}

}  // namespace
}  // namespace gp2
