// Copyright 2011 Ciyou Zhu, Richard Byrd, Jorge Nocedal, Jose Luis Morales. BSD 3-Clause License: see LICENSE.
//
// Translated from the Fortran of L-BFGS-B 3.0, whose routines are named in brackets. Sources:
//   [1] Byrd, Lu, Nocedal, Zhu: A limited memory algorithm for bound constrained optimization, SIAM J. Sci. Comput. 16 (1995)
//   [2] Morales, Nocedal: Remark on Algorithm 778: L-BFGS-B, ACM Trans. Math. Softw. 38 (2011)
//   [3] Moré, Thuente: Line search algorithms with guaranteed sufficient decrease, ACM Trans. Math. Softw. 20 (1994)
// Every sum is a plain loop, so that results do not depend on a BLAS or on the width of vectors.

#include "lbfgsb.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

namespace gp2::lbfgsb {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

double dot(const Eigen::Ref<const VectorXd>& a, const Eigen::Ref<const VectorXd>& b) {
  double sum = 0;
  for (Index i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

namespace {

constexpr double epsilon = std::numeric_limits<double>::epsilon();

double dot_over(const std::vector<Index>& indices, const Eigen::Ref<const VectorXd>& a, const Eigen::Ref<const VectorXd>& b) {
  double sum = 0;
  for (const Index i : indices) sum += a[i] * b[i];
  return sum;
}

// Factorises rows and columns [first, first + n) as A = UᵀU; reads and writes the upper triangle. False when A is not positive
// definite.
bool factorise(MatrixXd& a, Index first, Index n) {
  for (Index j = first; j < first + n; ++j) {
    for (Index i = first; i <= j; ++i) {
      double sum = a(i, j);
      for (Index k = first; k < i; ++k) sum -= a(k, i) * a(k, j);
      if (i < j) {
        a(i, j) = sum / a(i, i);
      } else if (sum > 0) {
        a(j, j) = std::sqrt(sum);
      } else {
        return false;
      }
    }
  }
  return true;
}

// Solves Uᵀ x = v in place, where U is the upper triangle of the leading columns of u.
void solve_transposed(const MatrixXd& u, Eigen::Ref<VectorXd> v) {
  for (Index i = 0; i < v.size(); ++i) {
    for (Index k = 0; k < i; ++k) v[i] -= u(k, i) * v[k];
    v[i] /= u(i, i);
  }
}

// Solves U x = v in place.
void solve(const MatrixXd& u, Eigen::Ref<VectorXd> v) {
  for (Index i = v.size() - 1; i >= 0; --i) {
    for (Index k = i + 1; k < v.size(); ++k) v[i] -= u(i, k) * v[k];
    v[i] /= u(i, i);
  }
}

// A step that was tried on a line.
struct Trial {
  double step, value, slope;
};

// The minimum of the cubic through two trials with their slopes is at a.step + ratio (b.step − a.step); root is zero where the
// cubic has no minimum.
struct Cubic {
  double ratio, root;

  Cubic(const Trial& a, const Trial& b) {
    const double theta = 3 * (a.value - b.value) / (b.step - a.step) + a.slope + b.slope;
    const double size = std::max({std::abs(theta), std::abs(a.slope), std::abs(b.slope)});
    const double discriminant = (theta / size) * (theta / size) - (a.slope / size) * (b.slope / size);
    root = size * std::sqrt(std::max(0.0, discriminant));
    if (b.step < a.step) root = -root;
    ratio = ((root - a.slope) + theta) / (((root - a.slope) + root) + b.slope);
  }
};

// Finds a step with f(step) ≤ f(0) + 10⁻³ step f'(0) and |f'(step)| ≤ 0.9 |f'(0)| [3; dcsrch, dcstep].
class LineSearch {
 public:
  LineSearch(double value, double slope, double longest)
      : longest_(longest),
        start_{0, value, slope},
        best_(start_),
        other_(start_),
        step_(std::min(1.0, longest)),
        above_(5 * step_),
        width_(longest),
        width_before_(2 * longest) {}

  // to be tried next
  [[nodiscard]] double step() const { return step_; }

  // Takes in value and slope at step(); false when that step is the one.
  bool refine(double value, double slope) {
    const double required_slope = sufficient_decrease * start_.slope;
    const double required = start_.value + step_ * required_slope;
    if (value <= required && slope >= 0) seeks_decrease_ = false;
    if (is_done(value, slope, required, required_slope)) return false;

    const Trial trial = {step_, value, slope};
    if (seeks_decrease_ && value <= best_.value && value > required) {
      // a step is chosen for f(step) − f(0) − 10⁻³ step f'(0)
      tilt(best_, -required_slope);
      tilt(other_, -required_slope);
      choose(tilted(trial, -required_slope));
      tilt(best_, required_slope);
      tilt(other_, required_slope);
    } else {
      choose(trial);
    }
    narrow();
    return true;
  }

 private:
  static constexpr double sufficient_decrease = 1e-3, curvature = 0.9, narrow_enough = 0.1;
  static constexpr double shrink = 0.66, least_growth = 1.1, most_growth = 4;

  static void tilt(Trial& trial, double slope) {
    trial.value += trial.step * slope;
    trial.slope += slope;
  }
  static Trial tilted(Trial trial, double slope) {
    tilt(trial, slope);
    return trial;
  }

  [[nodiscard]] bool is_done(double value, double slope, double required, double required_slope) const {
    const bool decreased = value <= required;
    if (decreased && std::abs(slope) <= curvature * -start_.slope) return true;
    if (step_ == longest_ && decreased && slope <= required_slope) return true;
    if (step_ == 0 && (!decreased || slope >= required_slope)) return true;
    // rounding errors prevent progress
    return bracketed_ && (step_ <= below_ || step_ >= above_ || above_ - below_ <= narrow_enough * above_);
  }

  // Updates the interval that holds the step sought, and sets the next one.
  void choose(const Trial& trial) {
    const bool slopes_differ = trial.slope * (best_.slope / std::abs(best_.slope)) < 0;
    double next = 0;
    if (trial.value > best_.value) {
      next = below_a_higher_value(trial);
      bracketed_ = true;
    } else if (slopes_differ) {
      const double cubic = at(trial, Cubic(trial, best_)), secant = secant_step(trial);
      next = std::abs(cubic - trial.step) > std::abs(secant - trial.step) ? cubic : secant;
      bracketed_ = true;
    } else if (std::abs(trial.slope) < std::abs(best_.slope)) {
      next = beyond_a_lesser_slope(trial);
    } else if (bracketed_) {
      next = trial.step + Cubic(trial, other_).ratio * (other_.step - trial.step);
    } else {
      next = trial.step > best_.step ? above_ : below_;
    }

    if (trial.value > best_.value) {
      other_ = trial;
    } else {
      if (slopes_differ) other_ = best_;
      best_ = trial;
    }
    step_ = next;
  }

  [[nodiscard]] double at(const Trial& trial, const Cubic& cubic) const {
    return trial.step + cubic.ratio * (best_.step - trial.step);
  }

  [[nodiscard]] double secant_step(const Trial& trial) const {
    return trial.step + trial.slope / (trial.slope - best_.slope) * (best_.step - trial.step);
  }

  [[nodiscard]] double below_a_higher_value(const Trial& trial) const {
    const double length = trial.step - best_.step;
    const double cubic = best_.step + Cubic(best_, trial).ratio * length;
    const double quadratic = best_.step + best_.slope / ((best_.value - trial.value) / length + best_.slope) / 2 * length;
    return std::abs(cubic - best_.step) < std::abs(quadratic - best_.step) ? cubic : cubic + (quadratic - cubic) / 2;
  }

  [[nodiscard]] double beyond_a_lesser_slope(const Trial& trial) const {
    const Cubic shape(trial, best_);
    const bool forward = trial.step > best_.step;
    const double cubic = shape.ratio < 0 && shape.root != 0 ? at(trial, shape) : forward ? above_ : below_;
    const double secant = secant_step(trial);
    const bool cubic_is_closer = std::abs(cubic - trial.step) < std::abs(secant - trial.step);
    if (bracketed_) {
      const double next = cubic_is_closer ? cubic : secant, limit = trial.step + shrink * (other_.step - trial.step);
      return forward ? std::min(limit, next) : std::max(limit, next);
    }
    const bool cubic_is_further = std::abs(cubic - trial.step) > std::abs(secant - trial.step);
    return std::max(below_, std::min(above_, cubic_is_further ? cubic : secant));
  }

  // Sees to it that the interval shrinks, and keeps the next step inside.
  void narrow() {
    if (bracketed_) {
      const double width = std::abs(other_.step - best_.step);
      if (width >= shrink * width_before_) step_ = best_.step + (other_.step - best_.step) / 2;
      width_before_ = std::exchange(width_, width);
      below_ = std::min(best_.step, other_.step);
      above_ = std::max(best_.step, other_.step);
    } else {
      below_ = step_ + least_growth * (step_ - best_.step);
      above_ = step_ + most_growth * (step_ - best_.step);
    }
    step_ = std::min(std::max(step_, 0.0), longest_);
    if (bracketed_ && (step_ <= below_ || step_ >= above_ || above_ - below_ <= narrow_enough * above_)) step_ = best_.step;
  }

  double longest_;
  Trial start_, best_, other_;  // the step sought is between best and other, once bracketed
  bool bracketed_ = false, seeks_decrease_ = true;
  double step_;
  double below_ = 0, above_;  // limits of the next step
  double width_, width_before_;
};

// The model of f about x is f + gᵀp + ½ pᵀBp with B = θI − W M Wᵀ, W = [Y θS], the columns of S and Y being the last steps and
// the changes of the gradient along them, the oldest first [1, section 3].
class Minimiser {
 public:
  Minimiser(const Problem& problem, const Options& options, Point& point)
      : problem_(problem), options_(options), point_(point), n_(point.x.size()) {}

  // [mainlb]
  Outcome run() {
    if (projected_gradient() <= options_.gradient_tolerance) return Outcome::gradient_below_tolerance;
    while (true) {
      find_cauchy_point();
      if (!free_.empty() && n_pairs() > 0 && !minimise_in_subspace()) {
        forget();
        continue;
      }

      const Point before = point_;
      VectorXd step = target_ - point_.x;
      const Search search = search_along(step);
      if (search.ended == Search::stopped) return Outcome::stopped;
      if (search.ended == Search::failed) {
        point_ = before;
        if (n_pairs() == 0) return Outcome::line_search_failed;
        forget();
        continue;
      }
      if (!problem_.accept(point_, ++iteration_)) return Outcome::stopped;
      if (projected_gradient() <= options_.gradient_tolerance) return Outcome::gradient_below_tolerance;
      const double size = std::max({std::abs(before.value), std::abs(point_.value), 1.0});
      if (before.value - point_.value <= options_.reduction_tolerance * size) return Outcome::reduction_below_tolerance;

      // BFGS needs sᵀy > 0
      const double sy = (search.slope - search.first_slope) * search.length;
      if (sy <= epsilon * -search.first_slope * search.length) continue;
      step *= search.length;
      if (!remember(step, point_.gradient - before.gradient, sy)) forget();
    }
  }

 private:
  struct Search {
    enum { found, failed, stopped } ended;
    double length = 0, first_slope = 0, slope = 0;
  };

  [[nodiscard]] Index n_pairs() const { return s_.cols(); }

  // the largest entry of P(x − g) − x [projgr]
  [[nodiscard]] double projected_gradient() const {
    double largest = 0;
    for (Index i = 0; i < n_; ++i) {
      const double g = point_.gradient[i];
      const double step = g < 0 ? std::max(point_.x[i] - problem_.upper[i], g) : std::min(point_.x[i] - problem_.lower[i], g);
      largest = std::max(largest, std::abs(step));
    }
    return largest;
  }

  [[nodiscard]] double clamped(double x, Index i) const { return std::min(std::max(x, problem_.lower[i]), problem_.upper[i]); }

  // M v [1, section 3.2; bmv], by the factors of
  //   M⁻¹ = [−D Lᵀ; L θSᵀS], D and L being the diagonal and what is below it of SᵀY
  [[nodiscard]] VectorXd times_m(const VectorXd& v) const {
    const Index m = n_pairs();
    VectorXd p(2 * m);
    for (Index i = 0; i < m; ++i) {
      double sum = 0;
      for (Index k = 0; k < i; ++k) sum += sy_(i, k) * v[k] / sy_(k, k);
      p[m + i] = v[m + i] + sum;
    }
    solve_transposed(j_, p.tail(m));
    solve(j_, p.tail(m));
    for (Index i = 0; i < m; ++i) {
      double sum = 0;
      for (Index k = i + 1; k < m; ++k) sum += sy_(k, i) * p[m + k] / sy_(i, i);
      p[i] = sum - v[i] / sy_(i, i);
    }
    return p;
  }

  // A variable that moves along P(x − tg), and the t at which it arrives at its bound.
  struct Break {
    double t;
    Index variable;
  };

  // The model along a segment of P(x − tg): the direction d, p = Wᵀd, first and second derivative at the start of the segment.
  struct Segment {
    VectorXd d, p;
    double f1, f2;
  };

  // Sets target to the first minimum of the model along P(x − tg), t ≥ 0, c to Wᵀ(target − x), and free to the variables that
  // have not arrived at a bound there [1, section 4; cauchy, freev].
  void find_cauchy_point() {
    target_ = point_.x;
    c_ = VectorXd::Zero(2 * n_pairs());
    is_active_.assign(static_cast<std::size_t>(n_), false);
    VectorXd d = VectorXd::Zero(n_);
    const std::vector<Break> breaks = breaks_along(d);
    Segment segment = first_segment(std::move(d));
    const double least_f2 = epsilon * -theta_ * segment.f1;
    double t = 0;
    for (const Break& next : breaks) {
      const double to_minimum = -segment.f1 / segment.f2, to_break = next.t - t;
      if (to_minimum < to_break) {
        t += std::max(to_minimum, 0.0);
        for (Index i = 0; i < n_; ++i) target_[i] = clamped(target_[i] + t * segment.d[i], i);
        c_ += std::max(to_minimum, 0.0) * segment.p;
        break;
      }
      t = next.t;
      c_ += to_break * segment.p;
      arrive(next.variable, to_break, segment);
      segment.f2 = std::max(least_f2, segment.f2);
    }

    free_.clear();
    active_.clear();
    for (Index i = 0; i < n_; ++i) (is_active_[static_cast<std::size_t>(i)] ? active_ : free_).push_back(i);
  }

  // sets d to the direction in which P(x − tg) starts
  std::vector<Break> breaks_along(VectorXd& d) {
    std::vector<Break> breaks;
    for (Index i = 0; i < n_; ++i) {
      const double x = point_.x[i], lower = problem_.lower[i], upper = problem_.upper[i], g = point_.gradient[i];
      if (upper <= lower || (x <= lower && g >= 0) || (x > lower && x >= upper && g <= 0)) {
        is_active_[static_cast<std::size_t>(i)] = true;
      } else if (g != 0) {
        d[i] = -g;
        breaks.push_back({(g > 0 ? x - lower : x - upper) / g, i});
      }
    }
    std::stable_sort(breaks.begin(), breaks.end(), [](const Break& a, const Break& b) { return a.t < b.t; });
    return breaks;
  }

  [[nodiscard]] Segment first_segment(VectorXd d) const {
    const Index m = n_pairs();
    VectorXd p(2 * m);
    for (Index j = 0; j < m; ++j) {
      p[j] = dot(y_.col(j), d);
      p[m + j] = theta_ * dot(s_.col(j), d);
    }
    const double f1 = -dot(d, d);
    double f2 = -theta_ * f1;
    if (m > 0) f2 -= dot(times_m(p), p);
    return {std::move(d), std::move(p), f1, f2};
  }

  // Leaves a segment of the given length at whose end a variable arrives at its bound.
  void arrive(Index i, double length, Segment& segment) {
    const double di = std::exchange(segment.d[i], 0.0);
    target_[i] = di > 0 ? problem_.upper[i] : problem_.lower[i];
    is_active_[static_cast<std::size_t>(i)] = true;
    segment.f1 += length * segment.f2 + di * di - theta_ * di * (target_[i] - point_.x[i]);
    segment.f2 -= theta_ * di * di;
    const Index m = n_pairs();
    if (m == 0) return;
    VectorXd w(2 * m);
    for (Index j = 0; j < m; ++j) {
      w[j] = y_(i, j);
      w[m + j] = theta_ * s_(i, j);
    }
    const VectorXd mw = times_m(w);
    segment.f1 += di * dot(c_, mw);
    segment.f2 += 2 * di * dot(segment.p, mw) - di * di * dot(w, mw);
    segment.p -= di * w;
  }

  // Factorises K = [−D − YᵀZZᵀY/θ, Lᵀ − Rᵀ; L − R, θSᵀAAᵀS] as UᵀEU with E = diag(−I, I) [1, section 5.3; formk]. The columns of
  // Z and A are the unit vectors of the free and the active variables, L is SᵀAAᵀY below its diagonal, R is SᵀZZᵀY on and above.
  bool factorise_k() {
    const Index m = n_pairs();
    k_.resize(2 * m, 2 * m);
    for (Index i = 0; i < m; ++i) {
      for (Index j = 0; j <= i; ++j) {
        k_(j, i) = dot_over(free_, y_.col(i), y_.col(j)) / theta_;
        k_(m + j, m + i) = dot_over(active_, s_.col(i), s_.col(j)) * theta_;
      }
      k_(i, i) += sy_(i, i);
      for (Index j = 0; j < m; ++j) {
        k_(j, m + i) = j < i ? -dot_over(active_, s_.col(i), y_.col(j)) : dot_over(free_, s_.col(i), y_.col(j));
      }
    }
    if (!factorise(k_, 0, m)) return false;
    for (Index i = m; i < 2 * m; ++i) solve_transposed(k_, k_.col(i).head(m));
    for (Index i = m; i < 2 * m; ++i) {
      for (Index j = i; j < 2 * m; ++j) k_(i, j) += dot(k_.col(i).head(m), k_.col(j).head(m));
    }
    return factorise(k_, m, m);
  }

  // Moves target to the minimum of the model over the free variables, projected onto the box where that descends, else shortened
  // [1, section 5; 2; cmprlb, subsm]. False when K is indefinite.
  bool minimise_in_subspace() {
    if (!factorise_k()) return false;
    const Index m = n_pairs();

    // d = −Zᵀ∇ of the model at the Cauchy point
    VectorXd d = VectorXd::Zero(n_);
    const VectorXd mc = times_m(c_);
    for (const Index i : free_) {
      d[i] = -theta_ * (target_[i] - point_.x[i]) - point_.gradient[i];
      for (Index j = 0; j < m; ++j) d[i] += y_(i, j) * mc[j] + s_(i, j) * (theta_ * mc[m + j]);
    }

    // d ← (d + Zᵀ W K⁻¹ Wᵀ Z d/θ)/θ
    VectorXd v(2 * m);
    for (Index j = 0; j < m; ++j) {
      v[j] = dot_over(free_, y_.col(j), d);
      v[m + j] = theta_ * dot_over(free_, s_.col(j), d);
    }
    solve_transposed(k_, v);
    v.head(m) *= -1;
    solve(k_, v);
    for (const Index i : free_) {
      for (Index j = 0; j < m; ++j) d[i] += y_(i, j) * v[j] / theta_ + s_(i, j) * v[m + j];
      d[i] /= theta_;
    }

    VectorXd projected = target_;
    bool at_bound = false;
    for (const Index i : free_) {
      projected[i] = clamped(target_[i] + d[i], i);
      at_bound = at_bound || projected[i] == problem_.lower[i] || projected[i] == problem_.upper[i];
    }
    if (at_bound && dot(projected - point_.x, point_.gradient) > 0) {
      shorten_to_box(d);
    } else {
      target_ = projected;
    }
    return true;
  }

  // Moves target along d as far as the box allows, at most by d.
  void shorten_to_box(const VectorXd& d) {
    double length = 1;
    Index blocking = -1;
    for (const Index i : free_) {
      if (d[i] == 0) continue;
      const double room = (d[i] > 0 ? problem_.upper[i] : problem_.lower[i]) - target_[i];
      const double possible = room / d[i];
      if (possible < length) {
        length = std::max(possible, 0.0);
        blocking = i;
      }
    }
    for (const Index i : free_) {
      target_[i] = i != blocking ? clamped(target_[i] + length * d[i], i) : d[i] > 0 ? problem_.upper[i] : problem_.lower[i];
    }
  }

  // [lnsrlb]
  Search search_along(const VectorXd& step) {
    constexpr int most_evaluations = 20;
    Search search{.ended = Search::failed, .first_slope = dot(point_.gradient, step)};
    if (!(search.first_slope < 0)) return search;
    const VectorXd from = point_.x;
    LineSearch line(point_.value, search.first_slope, longest_step(step));
    for (int evaluation = 0; evaluation < most_evaluations; ++evaluation) {
      search.length = line.step();
      for (Index i = 0; i < n_; ++i) {
        point_.x[i] = search.length == 1 ? target_[i] : clamped(search.length * step[i] + from[i], i);
      }
      if (!problem_.evaluate(point_)) {
        search.ended = Search::stopped;
        return search;
      }
      search.slope = dot(point_.gradient, step);
      if (!line.refine(point_.value, search.slope)) {
        search.ended = Search::found;
        return search;
      }
    }
    return search;
  }

  // how often the step fits into the box; once in the first iteration
  [[nodiscard]] double longest_step(const VectorXd& step) const {
    if (iteration_ == 0) return 1;
    double longest = 1e10;
    for (Index i = 0; i < n_; ++i) {
      if (step[i] == 0) continue;
      const double room = (step[i] > 0 ? problem_.upper[i] : problem_.lower[i]) - point_.x[i];
      longest = std::min(longest, room / step[i]);
    }
    return std::max(longest, 0.0);
  }

  // Takes a step and the change of the gradient along it into the model; false when that is not positive definite [matupd,
  // formt].
  bool remember(const VectorXd& step, const VectorXd& change, double sy) {
    if (n_pairs() == options_.memory) {
      const Index kept = n_pairs() - 1;
      s_ = s_.rightCols(kept).eval();
      y_ = y_.rightCols(kept).eval();
      sy_ = sy_.bottomRightCorner(kept, kept).eval();
      ss_ = ss_.bottomRightCorner(kept, kept).eval();
    }
    const Index last = n_pairs(), m = last + 1;
    theta_ = dot(change, change) / sy;
    s_.conservativeResize(n_, m);
    y_.conservativeResize(n_, m);
    s_.col(last) = step;
    y_.col(last) = change;

    // SᵀY on and below, SᵀS on and above the diagonal
    sy_.conservativeResize(m, m);
    ss_.conservativeResize(m, m);
    for (Index j = 0; j < m; ++j) {
      sy_(last, j) = j < last ? dot(step, y_.col(j)) : sy;
      ss_(j, last) = dot(s_.col(j), step);
    }

    // θSᵀS + L D⁻¹ Lᵀ = JJᵀ
    j_.resize(m, m);
    for (Index i = 0; i < m; ++i) {
      for (Index j = i; j < m; ++j) {
        double sum = 0;
        for (Index k = 0; k < i; ++k) sum += sy_(i, k) * sy_(j, k) / sy_(k, k);
        j_(i, j) = sum + theta_ * ss_(i, j);
      }
    }
    return factorise(j_, 0, m);
  }

  void forget() {
    s_.resize(n_, 0);
    y_.resize(n_, 0);
    theta_ = 1;
  }

  const Problem& problem_;
  const Options& options_;
  Point& point_;
  const Index n_;
  int iteration_ = 0;

  MatrixXd s_, y_;    // n × m
  MatrixXd sy_, ss_;  // SᵀY and SᵀS
  MatrixXd j_, k_;    // factors (upper triangles)
  double theta_ = 1;

  VectorXd target_;  // where the model has its minimum
  VectorXd c_;       // Wᵀ(Cauchy point − x)
  std::vector<bool> is_active_;
  std::vector<Index> free_, active_;
};

}  // namespace

Outcome minimise(const Problem& problem, const Options& options, Point& point) {
  return Minimiser(problem, options, point).run();
}

}  // namespace gp2::lbfgsb
