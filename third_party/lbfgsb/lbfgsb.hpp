#pragma once

#include <functional>

#include <Eigen/Core>

/// L-BFGS-B 3.0 of Zhu, Byrd, Lu, Nocedal and Morales in C++; README.md says how it differs from the Fortran.
namespace gp2::lbfgsb {

struct Point {
  Eigen::VectorXd x;
  double value = 0;
  Eigen::VectorXd gradient;
};

/// min f(x) subject to lower ≤ x ≤ upper.
struct Problem {
  Eigen::VectorXd lower, upper;
  std::function<bool(Point&)> evaluate;           // sets value and gradient at x; false stops
  std::function<bool(const Point&, int)> accept;  // is told of each iterate and its number, from 1 on; false stops
};

struct Options {
  int memory = 10;                 // pairs of steps and changes of the gradient that are kept
  double gradient_tolerance = 0;   // of the largest entry of the projected gradient
  double reduction_tolerance = 0;  // of (f − f') / max(|f|, |f'|, 1) in an iteration
};

enum class Outcome { gradient_below_tolerance, reduction_below_tolerance, line_search_failed, stopped };

/// Moves a point, whose value and gradient are known, to a minimum. When stopped, the point is the last one asked for.
Outcome minimise(const Problem& problem, const Options& options, Point& point);

/// Σ aᵢbᵢ, from the first to the last: the same bits on every machine.
double dot(const Eigen::Ref<const Eigen::VectorXd>& a, const Eigen::Ref<const Eigen::VectorXd>& b);

}  // namespace gp2::lbfgsb
