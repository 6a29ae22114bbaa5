#include "training/lbfgsb.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <string_view>
#include <vector>

// setulb of L-BFGS-B, renamed by cmake/QuietLBFGSB.cmake and not exported; Fortran passes the lengths of task and csave last
extern "C" [[gnu::visibility("hidden")]] void gp2_setulb_(const int* n, const int* m, double* x, const double* l, const double* u,
                                                          const int* nbd, double* f, double* g, const double* factr,
                                                          const double* pgtol, double* wa, int* iwa, char* task,
                                                          const int* iprint, char* csave, int* lsave, int* isave, double* dsave,
                                                          std::size_t task_length, std::size_t csave_length);

namespace gp2 {

using Eigen::VectorXd;

namespace {

// A line search that fails after an iteration with at most this relative reduction has met the rounding errors of the objective.
constexpr double rounding_level = 1e-9;

double relative_reduction(double from, double to) { return (from - to) / std::max({std::abs(from), std::abs(to), 1.0}); }

}  // namespace

LbfgsbResult minimise(const std::function<double(const VectorXd&, VectorXd&)>& f, const VectorXd& start, const VectorXd& lower,
                      const VectorXd& upper, const LbfgsbOptions& options) {
  const int n = static_cast<int>(start.size());
  LbfgsbResult result;
  result.x = start.cwiseMax(lower).cwiseMin(upper);
  VectorXd gradient = VectorXd::Zero(n);
  result.value = f(result.x, gradient);
  result.evaluations = 1;
  if (!std::isfinite(result.value) || !gradient.allFinite()) {
    result.value = std::numeric_limits<double>::infinity();
    result.termination = "no finite value at the start";
    return result;
  }
  if (options.max_iterations == 0 || n == 0) {
    result.termination = "not optimised: no iterations asked for";
    return result;
  }

  // the state of the reverse communication
  constexpr std::size_t text_length = 60;
  const int m = options.memory;
  const int quiet = -1;
  const std::vector<int> both_bounds(static_cast<std::size_t>(n), 2);
  std::vector<double> wa(static_cast<std::size_t>(2 * m * n + 5 * n + 11 * m * m + 8 * m));
  std::vector<int> iwa(static_cast<std::size_t>(3 * n));
  std::array<char, text_length> task{}, csave{};
  std::array<int, 4> lsave{};
  std::array<int, 44> isave{};
  std::array<double, 29> dsave{};
  const double factr = options.reduction_tolerance / std::numeric_limits<double>::epsilon();
  task.fill(' ');
  csave.fill(' ');
  std::memcpy(task.data(), "START", 5);
  const auto task_is = [&](std::string_view name) { return std::string_view(task.data(), name.size()) == name; };

  VectorXd x = result.x;
  double value = result.value;
  VectorXd best_gradient = gradient;
  bool first_evaluation = true;
  double last_reduction = std::numeric_limits<double>::infinity();
  int failed_before_search = 0;
  while (true) {
    gp2_setulb_(&n, &m, x.data(), lower.data(), upper.data(), both_bounds.data(), &value, gradient.data(), &factr,
                &options.gradient_tolerance, wa.data(), iwa.data(), task.data(), &quiet, csave.data(), lsave.data(), isave.data(),
                dsave.data(), text_length, text_length);
    if (task_is("FG")) {
      // the first request is for the start, which is known
      if (first_evaluation) {
        first_evaluation = false;
        continue;
      }
      if (options.stop()) {
        result.termination = "stopped on request";
        return result;
      }
      value = f(x, gradient);
      ++result.evaluations;
      if (!std::isfinite(value) || !gradient.allFinite()) {
        // answer with the parabola along the step that has the known value and slope at the last iterate and its minimum at a
        // tenth of the step: the line search goes there
        ++result.failed_evaluations;
        const VectorXd step = x - result.x;
        const double slope = std::min(best_gradient.dot(step), -std::numeric_limits<double>::min());
        value = result.value - 4 * slope;
        gradient = step * (-9 * slope / step.squaredNorm());
      }
    } else if (task_is("NEW_X")) {
      // only an f that answers differently at the same x can rise; L-BFGS-B stops on the next call, the better point is kept
      if (value > result.value) continue;
      last_reduction = relative_reduction(result.value, value);
      failed_before_search = result.failed_evaluations;
      result.x = x;
      result.value = value;
      best_gradient = gradient;
      result.iterations = isave[29];
      if (!options.iteration(result.iterations, value)) {
        result.termination = "stopped on request";
        return result;
      }
      if (result.iterations >= options.max_iterations) {
        result.termination = "the limit of iterations was reached";
        return result;
      }
    } else {
      break;
    }
  }

  const std::string_view text(task.data(), text_length);
  if (task_is("CONVERGENCE: NORM")) {
    result.converged = true;
    result.termination = "the projected gradient fell below its tolerance";
  } else if (task_is("CONVERGENCE: REL")) {
    result.converged = true;
    result.termination = "the relative reduction of the objective fell below its tolerance";
  } else if (last_reduction <= rounding_level && result.failed_evaluations == failed_before_search) {
    result.converged = true;
    result.termination = "the objective cannot be lowered further in double precision";
  } else {
    result.termination = "the line search could not lower the objective further (" +
                         std::string(text.substr(0, text.find_last_not_of(' ') + 1)) + ")";
  }
  return result;
}

}  // namespace gp2
