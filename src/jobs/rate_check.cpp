#include "jobs/rate_check.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <iterator>
#include <limits>
#include <numbers>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "jobs/fit_notes.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::RowVectorXd;

namespace {

constexpr double surely_correlated = 0.95;
constexpr Index enough_steps = 50;    // that a lag, or a small factor, stands out
constexpr double worth_a_word = 0.1;  // share of a rate
constexpr double few_tell = 0.3;      // the same, of fewer steps than enough: their deviation is hardly known
constexpr double surely_apart = 5;    // deviations

// What nine of ten numbers are not above, by size; NaN does not count.
double most_are_below(const ArrayXd& numbers) {
  std::vector<double> sizes;
  for (const double number : numbers)
    if (!std::isnan(number)) sizes.push_back(std::abs(number));
  if (sizes.empty()) return 0;
  const auto at = sizes.begin() + static_cast<std::ptrdiff_t>(0.9 * static_cast<double>(sizes.size() - 1));
  std::nth_element(sizes.begin(), at, sizes.end());
  return *at;
}

// Column and rate over steps of some rows: y = Δvalue, x = ∫ rate dt, d = Δrate, h = Δt.
struct Steps {
  ArrayXd y, x, d, h;
  Index n_turns = 0;  // of an angle, rows that are more than a quarter turn apart

  [[nodiscard]] Index n() const { return y.size(); }
  /// One wrong value in a thousand may make more than all others together: steps go that are far larger than those before and behind.
  void leave_out_jumps() {
    constexpr double far = 5,
                     alone = 3;  // times what nine of ten steps are below; times the neighbours, past the step next to it
    ArrayXd size = ArrayXd::Zero(n());
    for (const ArrayXd* const one : {&x, &y, &d}) {
      const double usual = most_are_below(*one);
      if (usual > 0) size = size.max(one->abs() / usual);
    }
    std::vector<Index> kept;
    for (Index i = 0; i < n(); ++i) {
      double beside = 0;
      for (const Index k : {i - 3, i - 2, i + 2, i + 3}) beside = std::max(beside, k < 0 || k >= n() ? 0 : size[k]);
      if (size[i] <= std::max(far, alone * beside)) kept.push_back(i);
    }
    for (ArrayXd* const one : {&y, &x, &d, &h}) *one = ArrayXd((*one)(kept));
  }
  [[nodiscard]] double correlation() const {
    const double scale = std::sqrt(x.square().sum() * y.square().sum());
    return scale > 0 ? (x * y).sum() / scale : 0;
  }
  [[nodiscard]] double slope() const { return (x * y).sum() / x.square().sum(); }
  /// Whether they tell anything: many count, and the rate changes by less than a share of its size from step to step. With all of it an
  /// oscillation has six steps a period, with half of it twelve.
  [[nodiscard]] bool tell(double share) const {
    const double xx = x.square().sum();
    return n() >= 20 && xx * xx > 8 * x.pow(4).sum() && (d * h).square().sum() < share * share * xx && 10 * n_turns < n();
  }
};

class RateRows {
 public:
  explicit RateRows(const RateColumns& columns) : columns_(columns) {
    const RowVectorXd& t = columns.t;
    const Index n = t.size() - 1;
    lengths_ = (t.tail(n) - t.head(n)).transpose();
    usual_length_ = median({lengths_.begin(), lengths_.end()});
    changes_ = (columns.value.tail(n) - columns.value.head(n)).transpose();
    if (columns.may_jump) leave_out_impacts();
    constexpr double turn = 2 * std::numbers::pi, noise = 0.5;
    if (!columns.is_angle || columns.value.maxCoeff() - columns.value.minCoeff() > turn + noise) return;
    for (double& change : changes_) change = std::remainder(change, turn);
    is_large_turn_ = changes_.abs() > turn / 4;
  }

  [[nodiscard]] double usual_length() const { return usual_length_; }
  /// Whether so many rows are so long a time.
  [[nodiscard]] bool are_regular() const { return 10 * ((lengths_ / usual_length_ - 1).abs() > 0.1).count() < lengths_.size(); }

  /// By how much the value changes, from each row over so many steps, beyond what its rates at the first and the last row say. NaN
  /// over a pause.
  [[nodiscard]] ArrayXd unexplained(Index n_steps) const {
    const RowVectorXd& rate = columns_.rates[columns_.own];
    ArrayXd out(changes_.size() + 1 - n_steps);
    for (Index i = 0; i < out.size(); ++i) {
      double time = 0;
      for (Index k = i; k < i + n_steps; ++k) time += length(k);
      out[i] = changes_.segment(i, n_steps).sum() - 0.5 * (rate[i] + rate[i + n_steps]) * time;
    }
    return out;
  }

  /// @param lag  rows by which the rate is late
  [[nodiscard]] Steps steps(std::size_t rate, Index lag, Index rows) const {
    const RowVectorXd& r = columns_.rates[rate];
    const bool jumps = columns_.just_before != nullptr && rate == columns_.own;
    const RowVectorXd& to = jumps ? *columns_.just_before : r;
    // every lag cuts the changes into the same steps, among which a wrong value counts alike
    const Index first = (std::max<Index>(0, -lag) + rows - 1) / rows * rows;
    const Index end = changes_.size() - std::max<Index>(0, lag);
    Steps steps;
    for (ArrayXd* const one : {&steps.y, &steps.x, &steps.d, &steps.h}) one->resize(changes_.size() / rows);
    Index n = 0;
    for (Index i = first; i + rows <= end; i += rows) {
      double integral = 0;
      for (Index k = i; k < i + rows; ++k) integral += 0.5 * (r[k + lag] + to[k + 1 + lag]) * length(k);
      const double change = changes_.segment(i, rows).sum();
      if (!std::isfinite(integral) || !std::isfinite(change)) continue;
      if (is_large_turn_.size() > 0) steps.n_turns += is_large_turn_.segment(i, rows).count();
      steps.y[n] = change;
      steps.x[n] = integral;
      steps.d[n] = r[i + rows + lag] - r[i + lag];
      steps.h[n] = lengths_.segment(i, rows).sum();
      ++n;
    }
    for (ArrayXd* const one : {&steps.y, &steps.x, &steps.d, &steps.h}) one->conservativeResize(n);
    steps.leave_out_jumps();
    return steps;
  }

 private:
  /// Steps that the rate is much farther from explaining than it is from most others. A wrong rate is far from all.
  void leave_out_impacts() {
    constexpr double far = 4;
    const auto rate = columns_.rates[columns_.own].transpose().array();
    const Index n = changes_.size();
    const ArrayXd beyond_rate = (changes_ - 0.5 * (rate.head(n) + rate.tail(n)) * lengths_).abs();
    lengths_ = (beyond_rate > far * most_are_below(beyond_rate)).select(not_a_number, lengths_);
  }

  /// NaN where the log pauses, or begins anew, and at impacts
  [[nodiscard]] double length(Index row) const {
    return lengths_[row] > 1.5 * usual_length_ || !(lengths_[row] > 0) ? not_a_number : lengths_[row];
  }

  const RateColumns& columns_;
  ArrayXd lengths_, changes_;
  Eigen::Array<bool, Eigen::Dynamic, 1> is_large_turn_;
  double usual_length_ = 0;
};

// The deviation of the sum of these errors. Neighbours of one sign count as one error: where a motion is sampled too coarsely errors go
// together.
double deviation(const ArrayXd& errors) {
  double variance = 0, run = 0;
  for (const double error : errors) {
    if (error * run < 0) {
      variance += run * run;
      run = 0;
    }
    run += error;
  }
  return std::sqrt(variance + run * run);
}

// The time τ by which a rate is late: y = s (x + τ d), to first order. Nothing where it does not stand out of its deviation, changes
// the rate by less than a tenth of its size, or is no longer than the least: where a rate jumps, rows do not tell when between them.
std::optional<double> lateness(const Steps& steps, double least) {
  if (steps.n() < enough_steps) return std::nullopt;
  const double xx = steps.x.square().sum();
  const auto beside = [&](const ArrayXd& of) -> ArrayXd { return of - (of * steps.x).sum() / xx * steps.x; };
  const ArrayXd y = beside(steps.y) / steps.slope(), d = beside(steps.d);
  const double dd = d.square().sum(), tau = (y * d).sum() / dd;
  const double changed = std::abs(tau) * std::sqrt(dd / xx);
  if (!(changed > worth_a_word && std::abs(tau) > std::max(least, surely_apart * deviation((y - tau * d) * d / dd))))
    return std::nullopt;
  return tau;
}

// Whether y = s x with s far from 1: beyond its deviation, and what noise of x, and integrals by trapezoids, make of it.
bool is_scaled(const Steps& steps) {
  const double xx = steps.x.square().sum(), s = steps.slope();
  const double of_noise = 1 - std::pow(steps.correlation(), 2);
  const double of_trapezoids = (steps.d * steps.h).square().sum() / (12 * xx);
  const double by_chance = surely_apart * deviation((steps.y - s * steps.x) * steps.x / xx);
  const double least = steps.n() < enough_steps ? few_tell : worth_a_word;
  return std::abs(s - 1) > std::max(least, by_chance) + 2 * (of_noise + of_trapezoids);
}

const char* cause_of_factor(double factor, bool is_angle) {
  struct Cause {
    double factor;
    const char* text;
  };
  constexpr double degrees = 180 / std::numbers::pi;
  const char* const of_degrees = is_angle ? "degrees instead of radians" : "degrees instead of radians, if it is an angle";
  const std::array<Cause, 6> causes = {{{degrees, of_degrees},
                                        {1 / degrees, of_degrees},
                                        {60, "t in minutes instead of seconds"},
                                        {1 / 60.0, "a rate per minute instead of per second"},
                                        {3600, "t in hours instead of seconds"},
                                        {1 / 3600.0, "a rate per hour instead of per second"}}};
  if (std::abs(factor + 1) < 0.1) return "a wrong sign";
  // degrees and minutes are a twentieth apart
  const auto distance = [&](const Cause& cause) { return std::abs(factor / cause.factor - 1); };
  const Cause& nearest = *std::ranges::min_element(causes, {}, distance);
  return distance(nearest) < 0.03 ? nearest.text : "a unit or a sign, or the clock";
}

// By how much a rate is too large throughout: y = x − o h. Nothing where that does not make it the right one, does not stand out of its
// deviation, or is less than a tenth of the rate.
std::optional<double> offset(const Steps& steps) {
  if (steps.n() < enough_steps) return std::nullopt;
  const double time = steps.h.sum(), o = (steps.x - steps.y).sum() / time;
  Steps without = steps;
  without.x -= o * steps.h;
  if (!without.tell(1) || !(without.correlation() > surely_correlated) || is_scaled(without)) return std::nullopt;
  const double usual = std::sqrt(without.x.square().sum() / steps.h.square().sum());
  if (!(std::abs(o) > std::max(worth_a_word * usual, surely_apart * deviation((without.y - without.x) / time))))
    return std::nullopt;
  return o;
}

// That a rate does not explain what is measured, and noise of neither of them hides it: of the right rate y = s x + noise for some s,
// and noise does not go on from step to step. The least that any y − s x goes on is an eigenvalue.
std::string unrelated(const Steps& steps) {
  constexpr double much = 0.1, lasting = 0.5;  // share of the squares; correlation from step to step
  const double unexplained = 1 - std::pow(steps.correlation(), 2);
  if (steps.n() < enough_steps || !(unexplained > much)) return "";
  const auto to_next = [](const ArrayXd& a, const ArrayXd& b) {
    return (a.head(a.size() - 1) * b.tail(b.size() - 1)).sum() / std::sqrt(a.square().sum() * b.square().sum());
  };
  const double yy = to_next(steps.y, steps.y), xx = to_next(steps.x, steps.x);
  const double yx = (to_next(steps.y, steps.x) + to_next(steps.x, steps.y)) / 2, c = steps.correlation();
  // the smaller root λ of (yy − λ) (xx − λ) = (yx − c λ)²
  const double middle = ((yy + xx) / 2 - c * yx) / unexplained;
  const double least = middle - std::sqrt(std::max(0.0, middle * middle - (yy * xx - yx * yx) / unexplained));
  if (!(least > lasting)) return "";
  return fmt::format(
      "{:.0f} % of what is measured is neither this rate nor noise: another column, or a sensor that was stuck for a time?",
      100 * unexplained);
}

}  // namespace

std::string better_rate(const RateColumns& columns) {
  const std::size_t own = columns.own;
  const RateRows rows(columns);
  // noise hides less of a longer step
  Index length = 1;
  while (columns.t.size() > 2 * length * enough_steps && rows.steps(own, 0, 2 * length).tell(0.5)) length *= 2;
  const Steps now = rows.steps(own, 0, length);
  if (const std::optional<double> o = offset(now)) {
    return fmt::format("the column lies {:.3g} {} it throughout: a sensor offset, or measured gravity", std::abs(*o),
                       *o > 0 ? "above" : "below");
  }
  if (!now.tell(1)) return "";
  const auto is_sure = [](const Steps& steps) { return steps.tell(1) && std::abs(steps.correlation()) > surely_correlated; };
  const auto other_column = [&](const auto& is_better) -> std::string {
    for (std::size_t other = 0; other < columns.rates.size(); ++other) {
      if (other == own || columns.rates[other].hasNaN()) continue;
      const Steps steps = rows.steps(other, 0, length);
      if (is_sure(steps) && is_better(steps, other))
        return fmt::format("it is measured by the column of {}: swapped?", columns.names[other]);
    }
    return "";
  };
  // of coordinates that move together a wrong column goes along, and noise may hide the right one: the other must be the rate itself
  const auto unexplained = [](const Steps& steps) { return 1 - std::pow(steps.correlation(), 2); };
  // where they move in a fixed ratio both columns explain the value alike, and each must be the rate of the other coordinate
  const auto is_rate_of = [&](const Steps& steps) { return is_sure(steps) && std::abs(steps.slope() - 1) < 0.01; };
  const auto are_exchanged = [&](const Steps& steps, std::size_t other) {
    if (columns.values == nullptr || (*columns.values)[other].hasNaN() || !is_rate_of(steps)) return false;
    const RateColumns of_other{columns.t, columns.names[other], (*columns.values)[other], false, columns.rates, columns.names,
                               own};
    return is_rate_of(RateRows(of_other).steps(own, 0, length));
  };
  const std::string swapped = other_column([&](const Steps& steps, std::size_t other) {
    constexpr double rounding = 1e-12;
    return std::abs(steps.slope() - 1) < 0.1 && std::abs(now.slope() - 1) > 0.1 &&
           (unexplained(now) > 10 * unexplained(steps) + rounding || are_exchanged(steps, other));
  });
  if (!swapped.empty()) return swapped;
  std::optional<Index> lag;
  if (is_sure(now)) lag = 0;
  double best = 1 - 0.1 * (1 - now.correlation());
  const Index stride = std::max<Index>(1, length / 2);
  for (Index other = -12 * stride; other <= 12 * stride && lag != 0 && rows.are_regular(); other += stride) {
    const Steps steps = rows.steps(own, other, length);
    // half a period and the other sign are alike: the sign is believed
    if (steps.n() < enough_steps || !is_sure(steps) || steps.correlation() <= std::max(best, 0.0)) continue;
    best = steps.correlation();
    lag = other;
  }
  if (lag) {
    const Steps steps = rows.steps(own, *lag, length);
    const double least = 0.75 * rows.usual_length();
    const double tau = static_cast<double>(*lag) * rows.usual_length() + lateness(steps, least).value_or(0);
    std::vector<std::string> texts;
    if (is_scaled(steps))
      texts.push_back(
          fmt::format("the rate is {:.3g} × the column: {}", steps.slope(), cause_of_factor(steps.slope(), columns.is_angle)));
    if (std::abs(tau) > least) {
      texts.push_back(fmt::format("the column {} by {:.2g} s, {:.2g} of the log's steps, or {} {}", tau > 0 ? "lags" : "leads",
                                  std::abs(tau), std::abs(tau) / rows.usual_length(), columns.name, tau > 0 ? "leads" : "lags"));
    }
    return fmt::format("{}", fmt::join(texts, "; "));
  }
  const std::string other = std::abs(now.correlation()) < 0.5 ? other_column([](const Steps&, std::size_t) { return true; }) : "";
  return other.empty() ? unrelated(now) : other;
}

namespace {

// The accelerations just before each row where inputs are held from row to row, as a controller does: by what the known force changes
// there. Empty where that is not known.
MatrixXd just_before_rows(const System& system, const Ref<const MatrixXd>& states, const Ref<const MatrixXd>& accelerations) {
  constexpr Index enough = 20'000;
  const Index nu = system.layout().nu, n = states.cols();
  if (nu == 0 || n > enough) return {};
  MatrixXd held = states;
  held.bottomRows(nu).rightCols(n - 1) = states.bottomRows(nu).leftCols(n - 1);
  const Eigen::VectorXd parameters = system.parameter_values();
  const auto known = [&](const MatrixXd& at) -> MatrixXd {
    const MechanicsBatch mechanics = evaluate_mechanics(system, at, parameters);
    if (mechanics.fault) return {};
    MatrixXd ddq(system.nq(), n);
    for (Index i = 0; i < n; ++i) {
      const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
      ddq.col(i) = projection.constrain(projection.solve_mass(mechanics.values.F(static_cast<int>(i))));
    }
    return ddq;
  };
  try {
    const MatrixXd after = known(states), before = known(held);
    if (after.size() > 0 && before.size() > 0) return accelerations + before - after;
  } catch (const Error&) {  // code that is not defined there
  }
  return {};
}

// The columns of a log in the order of time.
struct LoggedRates {
  RowVectorXd t;
  std::vector<RowVectorXd> q, dq, ddq;
  std::vector<std::string> velocities, accelerations;  // their names
};

// Nothing where t is not known, or goes back at many rows.
std::optional<LoggedRates> logged_rates(const Ref<const RowVectorXd>& times, const System& system,
                                        const Ref<const MatrixXd>& states, const Ref<const MatrixXd>& accelerations) {
  const StateLayout layout = system.layout();
  constexpr Index fewest = 30, enough = 300'000;
  const Index n = std::min(states.cols(), enough);
  const RowVectorXd t = times.head(n);
  if (t.hasNaN() || t.size() < fewest) return std::nullopt;
  constexpr Index few = 10;  // one step in so many may go back, as from episode to episode, or stand still
  if (few * ((t.tail(t.size() - 1) - t.head(t.size() - 1)).array() <= 0).count() > t.size()) return std::nullopt;
  LoggedRates out{t, {}, {}, {}, {}, system.acceleration_names()};
  for (int j = 0; j < system.nq(); ++j) {
    out.q.emplace_back(states.row(layout.q(j)).head(n));
    out.dq.emplace_back(states.row(layout.dq(j)).head(n));
    out.ddq.emplace_back(accelerations.row(j).head(n));
    out.velocities.push_back(system.coordinates()[static_cast<std::size_t>(j)].velocity());
  }
  return out;
}

std::vector<std::string> wrong_rates_over(const Ref<const RowVectorXd>& times, const System& system,
                                          const Ref<const MatrixXd>& states, const Ref<const MatrixXd>& accelerations) {
  const std::optional<LoggedRates> logged = logged_rates(times, system, states, accelerations);
  if (!logged) return {};
  const auto& [t, q, dq, ddq, velocities, acceleration_names] = *logged;
  std::optional<MatrixXd> just_before;
  const auto follows_held_inputs = [&](RateColumns columns) {
    const Index n = columns.t.size();
    if (!just_before) just_before = just_before_rows(system, states.leftCols(n), accelerations.leftCols(n));
    if (just_before->size() == 0) return false;
    const RowVectorXd row = just_before->row(static_cast<Index>(columns.own));
    columns.just_before = &row;
    return better_rate(columns).empty() && RateRows(columns).steps(columns.own, 0, 1).correlation() > surely_correlated;
  };
  std::vector<std::string> notes;
  const auto add_if_wrong = [&](const RateColumns& columns) {
    const std::string text = columns.value.hasNaN() ? "" : better_rate(columns);
    if (text.empty()) return false;
    if (&columns.rates == &logged->ddq && follows_held_inputs(columns)) return false;
    notes.push_back(fmt::format("{} is not the rate of {} over t: {}", columns.names[columns.own], columns.name, text));
    return true;
  };
  const bool may_jump = system.has_conditional_constraints();
  for (std::size_t j = 0; j < q.size(); ++j) {
    const Coordinate& coordinate = system.coordinates()[j];
    // a velocity that is wrong says nothing of the acceleration
    if (!add_if_wrong({t, coordinate.name, q[j], coordinate.angle, dq, velocities, j, false, nullptr, &q}))
      add_if_wrong({t, velocities[j], dq[j], false, ddq, acceleration_names, j, may_jump, nullptr, &dq});
  }
  return notes;
}

// How the steps to and from a row differ from what the rate of a column says: a wrong value makes them differ to opposite sides, a wrong
// rate to the same side.
class StepsAbout {
 public:
  explicit StepsAbout(const RateColumns& columns) : value_(columns.value), rate_(columns.rates[columns.own]) {
    if (value_.hasNaN()) return;
    const RateRows rows(columns);
    one_ = rows.unexplained(1), two_ = rows.unexplained(2);
    usual_ = most_are_below(one_), usual_two_ = most_are_below(two_);
    step_of_value_ = smallest_step(value_), step_of_rate_ = smallest_step(rate_);
  }

  [[nodiscard]] bool shows_wrong_value(Index row) const {
    constexpr double about = 0.05;
    if (!stands_out(row) || one_[row - 1] * one_[row] > 0) return false;
    for (const double turn : {2 * std::numbers::pi, 360.0})
      if (std::abs(std::abs(one_[row]) / turn - 1) < about) return false;  // an angle that wraps
    return leaps(value_, row, step_of_value_);
  }
  [[nodiscard]] bool shows_wrong_rate(Index row) const {
    return stands_out(row) && one_[row - 1] * one_[row] > 0 && leaps(rate_, row, step_of_rate_);
  }
  /// Whether the rows beside it go with each other, as far as is known: at an impact, or where a motion is too fast, they do not.
  [[nodiscard]] bool go_on_without(Index row) const {
    constexpr double usually = 5;
    return one_.size() == 0 || !(std::abs(two_[row - 1]) > usually * usual_two_);
  }

 private:
  // Both steps differ far more than most do, and than those beside them; the two together hardly do without the row.
  [[nodiscard]] bool stands_out(Index row) const {
    constexpr double far = 50, alone = 2, little = 0.2;
    if (one_.size() == 0) return false;
    const double least = std::min(std::abs(one_[row - 1]), std::abs(one_[row]));
    double beside = 0;
    for (const Index k : {row - 2, row + 1}) beside = std::max(beside, k < 0 || k >= one_.size() ? 0 : std::abs(one_[k]));
    return least > std::max(far * usual_, alone * beside) && std::abs(two_[row - 1]) < little * least && go_on_without(row);
  }
  // That of an encoder, say.
  [[nodiscard]] static double smallest_step(const RowVectorXd& column) {
    double smallest = std::numeric_limits<double>::infinity();
    for (Index i = 1; i < column.size(); ++i) {
      const double step = std::abs(column[i] - column[i - 1]);
      if (step > 0) smallest = std::min(smallest, step);
    }
    return smallest;
  }
  // Whether a column leaps at a row and back, by many such steps, and farther than beside it, as a body that bounces does not.
  [[nodiscard]] static bool leaps(const RowVectorXd& column, Index row, double smallest) {
    constexpr double many = 20, farther = 2;
    double beside = 0;
    for (const Index k : {row - 1, row + 2})
      if (k > 0 && k < column.size()) beside = std::max(beside, std::abs(column[k] - column[k - 1]));
    const double to = column[row] - column[row - 1], from = column[row + 1] - column[row];
    return to * from < 0 && std::min(std::abs(to), std::abs(from)) > std::max(many * smallest, farther * beside);
  }

  const RowVectorXd &value_, &rate_;
  ArrayXd one_, two_;  // RateRows::unexplained; empty: the value is not known
  double usual_ = 0, usual_two_ = 0, step_of_value_ = 0, step_of_rate_ = 0;
};

// Which values of a column are alone wrong, if there are some and they are few.
std::optional<std::string> single_values_text(const std::string& name, const std::string& other, const RowVectorXd& values,
                                              const std::vector<Index>& wrong) {
  constexpr std::ptrdiff_t one_in = 50, most = 5;  // rows, that are named
  if (wrong.empty() || std::ssize(wrong) > std::max<Index>(1, values.size() / one_in)) return std::nullopt;
  std::vector<std::string> places;
  for (const Index row : wrong) {
    if (std::ssize(places) == most) break;
    places.push_back(fmt::format("{:.4g} at data row {}", values[row], row + 1));
  }
  if (std::ssize(wrong) > most) places.push_back(fmt::format("and {} more", std::ssize(wrong) - most));
  return fmt::format("single values of {} contradict {} and the rows beside them: {}. Correct them, or leave these rows out",
                     name, other, fmt::join(places, ", "));
}

}  // namespace

std::vector<std::string> single_wrong_values(const System& system, const Ref<const MatrixXd>& states,
                                             const Ref<const MatrixXd>& accelerations, double unit_of_time) {
  const std::optional<LoggedRates> logged =
      logged_rates(unit_of_time * states.row(system.layout().t()), system, states, accelerations);
  if (!logged) return {};
  const auto& [t, q, dq, ddq, velocities, acceleration_names] = *logged;
  std::vector<std::string> texts;
  for (std::size_t j = 0; j < q.size(); ++j) {
    const Coordinate& coordinate = system.coordinates()[j];
    const StepsAbout positions({t, coordinate.name, q[j], coordinate.angle, dq, velocities, j});
    const StepsAbout steps({t, velocities[j], dq[j], false, ddq, acceleration_names, j, system.has_conditional_constraints()});
    std::vector<Index> of_q, of_dq, of_dq_by_ddq, of_ddq;
    for (Index row = 1; row + 1 < t.size(); ++row) {
      if (!positions.go_on_without(row) || !steps.go_on_without(row)) continue;
      if (positions.shows_wrong_value(row)) of_q.push_back(row);
      if (steps.shows_wrong_rate(row)) of_ddq.push_back(row);
      if (positions.shows_wrong_rate(row)) {
        of_dq.push_back(row);
      } else if (steps.shows_wrong_value(row)) {
        of_dq_by_ddq.push_back(row);
      }
    }
    const auto add = [&](const std::string& name, const std::string& other, const RowVectorXd& values,
                         const std::vector<Index>& wrong) {
      if (auto text = single_values_text(name, other, values, wrong)) texts.push_back(*std::move(text));
    };
    add(coordinate.name, velocities[j], q[j], of_q);
    add(velocities[j], coordinate.name, dq[j], of_dq);
    add(velocities[j], acceleration_names[j], dq[j], of_dq_by_ddq);
    add(acceleration_names[j], velocities[j], ddq[j], of_ddq);
  }
  return texts;
}

std::vector<std::string> wrong_rates(const System& system, const Ref<const MatrixXd>& states,
                                     const Ref<const MatrixXd>& accelerations, bool reads_time, double* unit) {
  const RowVectorXd t = states.row(system.layout().t());
  std::vector<std::string> notes = wrong_rates_over(t, system, states, accelerations);
  if (unit != nullptr) *unit = 1;
  for (const double smaller : {1e-3, 1e-6, 1e-9}) {
    if (reads_time || notes.empty()) break;
    std::vector<std::string> others = wrong_rates_over(smaller * t, system, states, accelerations);
    if (others.size() >= notes.size()) continue;
    notes = std::move(others);
    if (unit != nullptr) *unit = smaller;
  }
  return notes;
}

std::optional<PileUp> pile_up(const Ref<const RowVectorXd>& values) {
  constexpr std::ptrdiff_t fewest = 8;
  constexpr double least = 0.03, continuous = 0.8;  // shares: of all rows, of different values among the others
  std::vector<double> sorted;
  std::copy_if(values.begin(), values.end(), std::back_inserter(sorted), [](double one) { return std::isfinite(one); });
  if (sorted.empty()) return std::nullopt;
  std::sort(sorted.begin(), sorted.end());
  const auto n = std::ssize(sorted);
  const auto n_least = std::upper_bound(sorted.begin(), sorted.end(), sorted.front()) - sorted.begin();
  const auto n_most = sorted.end() - std::lower_bound(sorted.begin(), sorted.end(), sorted.back());
  const auto n_others = n - n_least - n_most;
  if (n_others < n / 4) return std::nullopt;
  const auto others = sorted.begin() + n_least;
  std::ptrdiff_t n_different = 1;
  for (auto one = others + 1; one < others + n_others; ++one) n_different += *one != *(one - 1) ? 1 : 0;
  if (static_cast<double>(n_different) < continuous * static_cast<double>(n_others)) return std::nullopt;
  const auto [at_end, value] = n_most >= n_least ? std::pair(n_most, sorted.back()) : std::pair(n_least, sorted.front());
  if (value == 0 || at_end < fewest || static_cast<double>(at_end) < least * static_cast<double>(n)) return std::nullopt;
  return PileUp{value, static_cast<double>(at_end) / static_cast<double>(n)};
}

std::optional<std::string> pile_up_text(const std::string& name, const Ref<const RowVectorXd>& values,
                                        const std::string& meaning) {
  const std::optional<PileUp> found = pile_up(values);
  if (!found) return std::nullopt;
  return fmt::format("{} is exactly {:.4g}, its extreme, in {:.0f} % of the rows, and has many other values: {}", name,
                     found->value, 100 * found->share, meaning);
}

std::optional<std::string> clipped_input(const std::string& input, const Ref<const RowVectorXd>& values) {
  return pile_up_text(fmt::format("the input {}", input), values, "clipped? The log must contain the acting input");
}

std::optional<std::string> clipped_velocity(const std::string& name, const Ref<const RowVectorXd>& velocities,
                                            const Ref<const RowVectorXd>& accelerations) {
  constexpr double small = 0.15;
  const std::optional<PileUp> found = pile_up(velocities);
  if (!found) return std::nullopt;
  double all = 0, clipped = 0, n = 0, n_clipped = 0;
  for (Index i = 0; i + 1 < velocities.size(); ++i) {
    // products of neighbours, in which noise cancels
    const double square = accelerations[i] * accelerations[i], product = accelerations[i] * accelerations[i + 1];
    if (std::isnan(product)) continue;
    all += square, ++n;
    if (velocities[i] == found->value && velocities[i + 1] == found->value) clipped += product, ++n_clipped;
  }
  if (!(clipped * n > small * small * all * n_clipped)) return std::nullopt;
  return pile_up_text(name, velocities, "a sensor at the end of its range?");
}

std::vector<Index> far_values(const Ref<const RowVectorXd>& values) {
  constexpr double far = 30;
  constexpr Index fewest = 20, one_in = 200;
  std::vector<double> distances = measured_entries(values, 0);
  const Index n = std::ssize(distances);
  if (n < fewest) return {};
  const double middle = median(distances);
  for (double& one : distances) one = std::abs(one - middle);
  const Index most = std::max<Index>(1, n / one_in);
  std::partial_sort(distances.begin(), distances.begin() + most + 1, distances.end(), std::greater());
  std::vector<Index> rows;
  for (std::size_t k = 0; k < static_cast<std::size_t>(most); ++k) {
    const double next = distances[k + 1];
    if (!(next > 0 && distances[k] > far * next)) continue;
    for (Index i = 0; i < values.size(); ++i) {
      if (std::abs(values[i] - middle) >= distances[k]) rows.push_back(i);
    }
    break;
  }
  return rows;
}

std::optional<std::string> far_values_text(const std::string& input, const std::vector<RowVectorXd>& logs,
                                           const std::vector<std::vector<int>>& lines) {
  std::vector<std::string> far;
  for (std::size_t log = 0; log < logs.size(); ++log) {
    for (const Index i : far_values(logs[log])) {
      const std::string place = place_of(lines, log, static_cast<std::size_t>(i), logs.size() == 1);
      far.push_back(fmt::format("{:.4g} at {}", logs[log][i], place));
    }
  }
  if (far.empty()) return std::nullopt;
  return fmt::format("single values of the input {} lie far from all others: {}. Correct them, or leave these rows out", input,
                     fmt::join(far, ", "));
}

bool is_wrapped_in_degrees(const std::vector<double>& angles) {
  constexpr double turn = 360, near = 30, few = 0.02;  // degrees; share of the samples
  const auto are_ends = [&](double a, double b) {
    const auto [low, high] = std::minmax(a, b);
    return std::abs(high - low - turn) < near && (std::abs(low) < near || std::abs(low + turn / 2) < near);
  };
  int n_wraps = 0, n_others = 0;
  for (std::size_t k = 1; k < angles.size(); ++k) {
    if (are_ends(angles[k - 1], angles[k])) {
      ++n_wraps;
    } else if (std::abs(angles[k] - angles[k - 1]) > near) {
      ++n_others;
    }
  }
  return n_wraps > 0 && n_others <= few * static_cast<double>(angles.size());
}

}  // namespace gp2
