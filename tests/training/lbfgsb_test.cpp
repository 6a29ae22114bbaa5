#include "training/lbfgsb.hpp"

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <thread>

#include <unistd.h>

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

// L-BFGS-B as its authors wrote it reports an ascent direction with a print statement: here for every fifth seed
TEST(LbfgsbDeathTest, NeverWritesToStandardOutput) {
  const auto run = [] {
    // in a process of its own, because the Fortran runtime writes when the process ends
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

TEST(LbfgsbTest, EndsAtTheEdgeOfAnInfiniteRegionWithTheBestPointItSaw) {
  // the minimum lies beyond the edge; there is no stationary point to converge to
  double best = infinity;
  const auto cut = [&](const VectorXd& x, VectorXd& gradient) {
    if (x[0] > 0.5) return infinity;
    const double value = rosenbrock(x, gradient);
    best = std::min(best, value);
    return value;
  };
  const LbfgsbResult result = minimise(cut, constant(2, -0.5), constant(2, -3), constant(2, 3), {});
  EXPECT_FALSE(result.converged) << result.termination;
  EXPECT_LE(result.x[0], 0.5);
  VectorXd gradient(2);
  EXPECT_EQ(result.value, rosenbrock(result.x, gradient)) << "value and point belong together";
  EXPECT_LT(result.value, 0.5) << "close to the edge, where it is a quarter";
  EXPECT_GE(result.value, best);
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
    options.iteration = [&](int, double value) {
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
  options.iteration = [&](int, double value) {
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
  options.iteration = [&](int iteration, double value) {
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
