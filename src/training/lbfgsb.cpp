#include "training/lbfgsb.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "lbfgsb/lbfgsb.hpp"

namespace gp2 {

using Eigen::VectorXd;
using lbfgsb::Outcome;
using lbfgsb::Point;

namespace {

using Objective = std::function<double(const VectorXd&, VectorXd&)>;

// A relative reduction of the objective that is no more than its rounding errors.
constexpr double rounding_level = 1e-9;

double relative_reduction(double from, double to) { return (from - to) / std::max({std::abs(from), std::abs(to), 1.0}); }

// What L-BFGS-B calls, and what becomes of it.
class Minimisation {
 public:
  Minimisation(const Objective& f, const VectorXd& lower, const VectorXd& upper, const LbfgsbOptions& options)
      : f_(f), lower_(lower), upper_(upper), options_(options) {}

  /// Evaluates the objective at the start; false when there is nothing to be done from there.
  bool start(const VectorXd& x) {
    best_ = {.x = x, .gradient = VectorXd::Zero(x.size())};
    if (!evaluate_objective(best_)) {
      best_.value = std::numeric_limits<double>::infinity();
      result_.termination = options_.stop() ? "stopped on request" : "no finite value at the start";
      return false;
    }
    if (options_.max_iterations == 0 || x.size() == 0) {
      result_.termination = "not optimised: no iterations asked for";
      return false;
    }
    return true;
  }

  bool evaluate(Point& trial) {
    if (options_.stop()) return stop_on_request();
    if (!evaluate_objective(trial)) {
      if (options_.stop()) return stop_on_request();
      ++result_.failed_evaluations;
      failed_in_search_ = is_at_edge_ = true;
      turn_back(trial);
    } else if (leaps(trial)) {
      turn_back(trial);
    }
    return true;
  }

  bool accept(const Point& iterate, int iteration) {
    // only an objective that answers differently at the same x can rise; L-BFGS-B then ends, and the better point is kept
    if (iterate.value > best_.value) return true;
    last_reduction_ = relative_reduction(best_.value, iterate.value);
    if (!failed_in_search_ && last_reduction_ > rounding_level) is_at_edge_ = false;
    failed_in_search_ = false;
    best_ = iterate;
    result_.iterations = iteration;
    if (!options_.iteration(iteration, iterate.x, iterate.value)) return stop_on_request();
    if (iteration >= options_.max_iterations) {
      result_.termination = "the limit of iterations was reached";
      return false;
    }
    return true;
  }

  void conclude(Outcome outcome) {
    if (outcome == Outcome::stopped) return;  // which was explained
    result_.converged = true;
    if (outcome == Outcome::gradient_below_tolerance) {
      result_.termination = "the projected gradient fell below its tolerance";
    } else if (is_at_edge_ && !is_flat()) {
      result_.converged = false;
      result_.termination = "the objective cannot be computed just beyond the best point, where it still falls";
    } else if (outcome == Outcome::reduction_below_tolerance) {
      result_.termination = "the relative reduction of the objective fell below its tolerance";
    } else if (last_reduction_ <= rounding_level) {
      result_.termination = "the objective cannot be lowered further in double precision";
    } else {
      result_.converged = false;
      result_.termination = "the line search could not lower the objective further";
    }
  }

  [[nodiscard]] const Point& best() const { return best_; }
  [[nodiscard]] LbfgsbResult result() const {
    LbfgsbResult result = result_;
    result.x = best_.x;
    result.value = best_.value;
    return result;
  }

 private:
  bool evaluate_objective(Point& point) {
    point.value = f_(point.x, point.gradient);
    ++result_.evaluations;
    return std::isfinite(point.value) && point.gradient.allFinite();
  }

  // Whether the projected gradient says that this is an optimum, if not as exactly as was asked for.
  [[nodiscard]] bool is_flat() const {
    constexpr double flat = 1e-2;  // nats for a factor e of a hyperparameter, whose deviation is mostly less
    const VectorXd descended = (best_.x - best_.gradient).cwiseMax(lower_).cwiseMin(upper_);
    return (descended - best_.x).lpNorm<Eigen::Infinity>() <= flat;
  }

  // Little is known of curvature at first, and a steep slope points into a corner of the box: where even that is better than the
  // start, what is on the way is better still.
  [[nodiscard]] bool leaps(const Point& trial) const {
    constexpr int first_steps = 5;
    constexpr double far = 5;
    return result_.iterations < first_steps && trial.value < best_.value && (trial.x - best_.x).lpNorm<Eigen::Infinity>() > far;
  }

  // Answers with the parabola along the step that has the known value and slope at the last iterate and its minimum at a tenth of
  // the step: the line search goes there.
  void turn_back(Point& trial) const {
    const VectorXd step = trial.x - best_.x;
    const double slope = std::min(lbfgsb::dot(best_.gradient, step), -std::numeric_limits<double>::min());
    trial.value = best_.value - 4 * slope;
    trial.gradient = step * (-9 * slope / lbfgsb::dot(step, step));
  }

  bool stop_on_request() {
    result_.termination = "stopped on request";
    return false;
  }

  const Objective& f_;
  const VectorXd& lower_;
  const VectorXd& upper_;
  const LbfgsbOptions& options_;
  LbfgsbResult result_;
  Point best_;
  double last_reduction_ = std::numeric_limits<double>::infinity();
  bool failed_in_search_ = false;
  bool is_at_edge_ = false;  // an evaluation failed, and since then no iteration without a failure made progress
};

}  // namespace

LbfgsbResult minimise(const Objective& f, const VectorXd& start, const VectorXd& lower, const VectorXd& upper,
                      const LbfgsbOptions& options) {
  Minimisation minimisation(f, lower, upper, options);
  if (minimisation.start(start.cwiseMax(lower).cwiseMin(upper))) {
    const lbfgsb::Problem problem = {
        lower, upper, [&](Point& trial) { return minimisation.evaluate(trial); },
        [&](const Point& iterate, int iteration) { return minimisation.accept(iterate, iteration); }};
    Point point = minimisation.best();
    minimisation.conclude(
        lbfgsb::minimise(problem, {options.memory, options.gradient_tolerance, options.reduction_tolerance}, point));
  }
  return minimisation.result();
}

}  // namespace gp2
