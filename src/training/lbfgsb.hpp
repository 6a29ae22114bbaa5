#pragma once

#include <functional>
#include <string>

#include <Eigen/Core>

namespace gp2 {

struct LbfgsbOptions {
  int max_iterations = 1000;
  int memory = 30;  // pairs kept for the Hessian; with as many as there are hyperparameters a fit takes a quarter of the steps
  double gradient_tolerance = 1e-5;
  double reduction_tolerance = 1e-12;
  /// Called after each iteration with its number, its point and its value; false stops.
  std::function<bool(int, const Eigen::VectorXd&, double)> iteration = [](int, const Eigen::VectorXd&, double) { return true; };
  /// Asked before each evaluation but that of the start; true stops.
  std::function<bool()> stop = [] { return false; };
};

struct LbfgsbResult {
  Eigen::VectorXd x;  // the best accepted iterate
  double value = 0;   // +∞ when it was +∞ at the start
  int iterations = 0, evaluations = 0, failed_evaluations = 0;
  bool converged = false;  // a tolerance was met, or the objective was lowered down to its rounding errors
  std::string termination;
};

/// Minimises f over the box [lower, upper] with L-BFGS-B 3.0 (Zhu, Byrd, Lu, Nocedal 1997; Morales, Nocedal 2011). The path
/// depends on nothing but the values of f, to the bit. Every run owns its memory: re-entrant. f(x, gradient) may be +∞ or not a
/// number away from the start: such a step is shortened tenfold, and a run that ends at the edge of such a region has not
/// converged.
LbfgsbResult minimise(const std::function<double(const Eigen::VectorXd&, Eigen::VectorXd&)>& f, const Eigen::VectorXd& start,
                      const Eigen::VectorXd& lower, const Eigen::VectorXd& upper, const LbfgsbOptions& options);

}  // namespace gp2
