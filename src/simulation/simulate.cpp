#include "gp2/simulate.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>
#include <string>

#include <fmt/format.h>
#include <boost/numeric/odeint/stepper/controlled_runge_kutta.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_dopri5.hpp>

#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "simulation/contacts.hpp"
#include "simulation/projection.hpp"
#include "simulation/switching.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

namespace odeint = boost::numeric::odeint;

// [q; dq] and its derivative, as odeint keeps them
using Phase = std::vector<double>;
using Stepper = odeint::runge_kutta_dopri5<Phase>;
using ErrorChecker = odeint::default_error_checker<double, Stepper::algebra_type, Stepper::operations_type>;
using ControlledStepper = odeint::controlled_runge_kutta<Stepper, ErrorChecker>;

// a stage at which there is no acceleration: the step is tried again, smaller
struct StageFault {
  std::string text;
};

// an acceleration that is not of the system
struct WrongSize {
  Index size;
};

bool is_finite(const Phase& phase) {
  return std::all_of(phase.begin(), phase.end(), [](double x) { return std::isfinite(x); });
}

// whether some rows of A follow from the others; they show it on the constraint
bool has_redundant_rows(const System& system, const VectorXd& parameters, const ConstraintProjection& projection,
                        VectorXd state) {
  if (system.nc() < 2) return false;
  projection.apply(state);
  const MechanicsBatch mechanics = evaluate_mechanics(system, state, parameters);
  return !mechanics.projections.empty() && mechanics.projections[0].motion_is_determined() &&
         ranks_of(system, mechanics)[0].rank < system.nc();
}

class Integration {
 public:
  Integration(const System& system, const VectorXd& parameters, const Acceleration& acceleration, const SimulateOptions& options)
      : system_(system),
        parameters_(parameters),
        layout_(system.layout()),
        acceleration_(acceleration),
        options_(options),
        projection_(system, parameters),
        switching_(options.switching, parameters, layout_, options.absolute_tolerance),
        contacts_(system, parameters, options),
        stepper_(ErrorChecker(options.absolute_tolerance, options.relative_tolerance, 1, 0)),
        state_(VectorXd::Zero(layout_.size())) {
    if (options.pushed) contacts_.jump_by([this](const VectorXd& state, const VectorXd& r) { return jump(state, r); });
  }

  Trajectory run(const Ref<const VectorXd>& start, bool redundant) {
    project_stages_ = redundant;
    switching_.move_along([this](const VectorXd& state) { return tangent_at(state); });
    if (redundant) switching_.put_onto([this](VectorXd& state) { projection_.apply(state); });
    const Index n = options_.times.size();
    out_.times = options_.times;
    out_.states.resize(layout_.size(), n);
    out_.accelerations.resize(layout_.nq, n);
    out_.commands.resize(layout_.nu, n);
    t_ = options_.times[0];
    x_.assign(start.begin(), start.begin() + layout_.t());  // t follows q and dq
    dxdt_.resize(x_.size());
    Index next = 0;
    try {
      if (!contacts_.is_empty()) settle_contacts(/*at_start=*/true);
      switch_or_throw([&] { switching_.start(state_, counted()); });
      derivative_or_throw();
      write(next++, t_, x_, dxdt_);
      note_extent();
      is_active_ = active_conditions();
      integrate(next);
    } catch (const WrongSize& wrong) {
      throw InputError(
          fmt::format("simulate: the acceleration has {} entries, the system {} coordinates", wrong.size, layout_.nq));
    } catch (const NumericalError& error) {
      keep(next);
      throw UnfinishedMotion(error.what(), {std::move(out_)});
    }
    return std::move(out_);
  }

 private:
  // To the end; `next` is the time that is to be written next.
  void integrate(Index& next) {
    const Index n = options_.times.size();
    double step = options_.initial_step > 0 ? options_.initial_step : first_step();
    while (next < n) {
      require_progress();
      // a step ends where an input has a kink, and at the end
      const double limit = std::min(options_.inputs.next_kink(t_), t_end());
      const bool to_limit = step >= limit - t_;
      double t_new = t_, tried = to_limit ? limit - t_ : step;
      if (!try_step(t_new, tried)) {
        step = tried;
        require_step(step);
        continue;
      }
      if (to_limit) t_new = limit;
      const std::optional<double> crossing = find_crossing(t_new, next);
      if (!crossing && is_hold_unresolved(t_new)) {
        step = longest_holding_step_ = (t_new - t_) / 2;
        --out_.steps;
        ++out_.rejected_steps;
        continue;
      }
      if (crossing && is_to_stop_before(*crossing, t_new)) {
        step = (1 - shortfall_) * (*crossing - t_);
        shortfall_ *= 10;
        --out_.steps;
        ++out_.rejected_steps;
        continue;
      }
      shortfall_ = least_shortfall;
      step = to_limit ? std::max(step, tried) : tried;
      constexpr double growth = 1.5;
      step = std::min(step, longest_holding_step_ *= growth);
      const Index first = next;
      if (!write_within(next, crossing.value_or(t_new), t_new)) {
        next = first;
        step = (t_new - t_) / 2;
        --out_.steps;
        ++out_.rejected_steps;
        continue;
      }
      if (crossing) {
        x_new_ = x_crossing_;
        t_new = *crossing;
      }
      advance(t_new, crossing.has_value());
      if (next < n && options_.times[next] == t_new) write(next++, t_, x_, dxdt_);
    }
  }

  // Leaves what was written, and the state that was reached.
  void keep(Index next) {
    if (next > 0 && t_ > options_.times[next - 1]) {
      try {
        write(next, t_, x_, dxdt_);
        out_.times[next++] = t_;
      } catch (const Error&) {
        // there is nothing to record where there is no motion
      }
    }
    out_.times.conservativeResize(next);
    out_.states.conservativeResize(Eigen::NoChange, next);
    out_.accelerations.conservativeResize(Eigen::NoChange, next);
    out_.commands.conservativeResize(Eigen::NoChange, next);
    if (options_.record) out_.records.conservativeResize(Eigen::NoChange, next);
  }

  void require_progress() {
    if (options_.stop != nullptr && *options_.stop) throw NumericalError(fmt::format("simulate: stopped at t = {:.6g}", t_));
    const int taken = out_.steps + out_.rejected_steps;
    if (taken <= options_.max_steps / 2) t_halfway_ = t_;
    if (taken >= options_.max_steps) {
      // steps that shrink: the second half of them came a quarter as far as the first, or less
      const bool is_held_up = t_ - t_halfway_ < 0.25 * (t_halfway_ - options_.times[0]);
      if (is_held_up) {
        throw NumericalError(fmt::format(
            "simulate: {} steps reach no further than t = {:.6g} of {:.6g}, half of them from t = {:.6g} on: a force that "
            "jumps where a body comes to rest is to be written with sign(v) or v/sqrt(v^2 + w^2), or smoothed, say "
            "tanh(v/0.01){}; else loosen the tolerances, or allow more steps (`max_steps`)",
            options_.max_steps, t_, t_end(), t_halfway_,
            !conditions_.empty() ? "; a constraint that holds at the very edge of its condition is to be a contact" : ""));
      }
      throw NumericalError(
          fmt::format("simulate: {} steps reach no further than t = {:.6g} of {:.6g}: loosen the tolerances, or "
                      "allow more steps (`max_steps`)",
                      options_.max_steps, t_, t_end()));
    }
    constexpr int enough = 1000;
    if (out_.steps == enough) require_resolved();
  }
  // an end at which doubles are farther apart than the steps so far
  void require_resolved() const {
    const double step = (t_ - options_.times[0]) / std::max(out_.steps, 1);
    if (step > smallest_step() || step == 0) return;
    throw NumericalError(
        fmt::format("simulate: at t = {:.6g} the motion needs steps of {:.2g} s; the end, {:.6g}, is so far that times there are "
                    "not told apart so well: let the motion end sooner",
                    t_, step, t_end()));
  }
  static double resolution(double t) { return 16 * std::numeric_limits<double>::epsilon() * std::abs(t); }
  [[nodiscard]] double smallest_step() const { return std::max(resolution(t_), resolution(t_end())); }

  [[nodiscard]] double t_end() const { return options_.times[options_.times.size() - 1]; }

  // the acceleration, each call of which counts
  [[nodiscard]] Acceleration counted() {
    return [this](const Ref<const VectorXd>& state) -> VectorXd {
      VectorXd ddq = acceleration_(state);
      ++out_.evaluations;
      if (ddq.size() != layout_.nq) throw WrongSize{ddq.size()};
      return ddq;
    };
  }

  // [q; dq; t; u(t)] in state_
  void expand(const Phase& x, double t) {
    if (instant_) {
      state_ = *instant_;
      std::copy(x.begin() + layout_.nq, x.end(), state_.begin() + layout_.dq(0));
      return;
    }
    std::copy(x.begin(), x.end(), state_.begin());
    state_[layout_.t()] = t;
    options_.inputs.evaluate(t, state_.tail(layout_.nu));
    if (!contacts_.is_empty()) contacts_.mark(state_);
  }

  // ddq of the motion, on the sides that it is on
  [[nodiscard]] Acceleration of_motion() {
    return [this](const Ref<const VectorXd>& state) -> VectorXd {
      return switching_.is_empty() ? counted()(state) : switching_.acceleration(state, counted());
    };
  }

  // T, or I where the mechanics have a fault, which the acceleration tells of
  [[nodiscard]] MatrixXd tangent_at(const VectorXd& state) const {
    const MechanicsBatch mechanics = evaluate_mechanics(system_, state, parameters_);
    return mechanics.fault ? MatrixXd::Identity(layout_.nq, layout_.nq) : mechanics.projections[0].T();
  }

  // whether the projection changed x
  bool project(Phase& x, double t) {
    expand(x, t);
    if (!projection_.apply(state_)) return false;
    std::copy_n(state_.begin(), x.size(), x.begin());
    return true;
  }

  void derivative(const Phase& x, Phase& dxdt, double t) {
    if (!is_finite(x)) throw StageFault{"the state is not finite"};
    expand(x, t);
    VectorXd ddq;
    try {
      if (project_stages_) projection_.apply(state_);
      ddq = of_motion()(state_);
    } catch (const Error& error) {
      throw StageFault{error.what()};
    }
    if (!ddq.allFinite()) throw StageFault{"the acceleration is not a finite number"};
    std::copy_n(x.begin() + layout_.nq, layout_.nq, dxdt.begin());
    std::copy(ddq.begin(), ddq.end(), dxdt.begin() + layout_.nq);
  }

  [[noreturn]] void stop(double t, const std::string& text) const {
    if (instant_) throw NumericalError(text);
    throw NumericalError(fmt::format("simulate: no acceleration at t = {:.6g}: {}", t, text));
  }

  // at (x_, t_), where there is no smaller step to try
  void derivative_or_throw() {
    try {
      derivative(x_, dxdt_, t_);
    } catch (const StageFault& fault) {
      stop(t_, fault.text);
    }
  }

  // One step of the size `step`, which becomes that of the next one, or of the next try.
  bool try_step(double& t_new, double& step) {
    x_new_.resize(x_.size());
    dxdt_new_.resize(x_.size());
    const double tried = step;
    try {
      const auto result = stepper_.try_step([this](const Phase& x, Phase& dxdt, double t) { derivative(x, dxdt, t); }, x_, dxdt_,
                                            t_new, x_new_, dxdt_new_, step);
      if (result == odeint::success) {
        ++out_.steps;
        return true;
      }
      fault_.reset();
    } catch (const StageFault& fault) {
      fault_ = fault;
      step = tried / 4;
    }
    ++out_.rejected_steps;
    return false;
  }

  void require_step(double step) const {
    if (step > smallest_step()) return;
    require_resolved();
    throw NumericalError(fmt::format("simulate: the step size fell to {:.2g} s at t = {:.6g}: {}", step, t_,
                                     fault_ ? fault_->text : "the tolerances cannot be met there"));
  }

  // Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, sec. II.4
  double first_step() {
    const double span = t_end() - t_;
    const auto size = [&](const auto& entry) {
      double largest = 0;
      for (std::size_t k = 0; k < x_.size(); ++k) {
        const double scale = options_.absolute_tolerance + options_.relative_tolerance * std::abs(x_[k]);
        largest = std::max(largest, std::abs(entry(k)) / scale);
      }
      return largest;
    };
    const double d0 = size([&](std::size_t k) { return x_[k]; });
    const double d1 = size([&](std::size_t k) { return dxdt_[k]; });
    const double h0 = std::min(span, d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1);
    Phase x1 = x_, dxdt1(x_.size());
    for (std::size_t k = 0; k < x_.size(); ++k) x1[k] += h0 * dxdt_[k];
    try {
      derivative(x1, dxdt1, t_ + h0);
    } catch (const StageFault&) {
      return h0;
    }
    const double d2 = size([&](std::size_t k) { return dxdt1[k] - dxdt_[k]; }) / h0;
    const double steepest = std::max(d1, d2);
    const double h1 = steepest <= 1e-15 ? std::max(1e-6, h0 * 1e-3) : std::pow(0.01 / steepest, 0.2);
    return std::min({100 * h0, h1, span});
  }

  // The times at which the step to t_new is looked at. Where constraints come and go the written ones are among them, so that what is
  // written is under the constraints that the motion is under.
  [[nodiscard]] std::vector<double> places(double t_new, Index next) const {
    constexpr int parts = 8;
    std::vector<double> out;
    for (int k = 1; k < parts; ++k) out.push_back(t_ + (t_new - t_) * k / parts);
    if (looks_at_conditions()) {
      for (; next < options_.times.size() && options_.times[next] < t_new; ++next) out.push_back(options_.times[next]);
      std::sort(out.begin(), out.end());
    }
    out.push_back(t_new);
    return out;
  }

  // The first time in the step to t_new at which the motion has crossed a surface where the acceleration jumps, has hit a contact,
  // or is let go by one of them, or at which a constraint has come or gone; x_crossing_ is the state then.
  std::optional<double> find_crossing(double t_new, Index next) {
    if (switching_.is_empty() && contacts_.is_empty() && !looks_at_conditions()) return std::nullopt;
    x_crossing_.resize(x_.size());
    // whether the constraints are other ones there than at the start of the step
    const auto move_to = [&](double t) {
      stepper_.stepper().calc_state(t, x_crossing_, x_, dxdt_, t_, x_new_, dxdt_new_, t_new);
      expand(x_crossing_, t);
      if (looks_at_conditions() && active_conditions() != is_active_) return true;
      // a contact that is released leaves at rate 0, not at what interpolation makes of it
      if (!contacts_.is_empty() && options_.project) project(x_crossing_, t);
      return false;
    };
    const auto has_left = [&](double t, bool is_end) {
      return move_to(t) || (!switching_.is_empty() && switching_.has_crossed(state_)) ||
             (!contacts_.is_empty() && contacts_.is_hit(state_)) || (is_end && is_let_go());
    };
    double before = t_, after = t_;
    const std::vector<double> looked_at = places(t_new, next);
    for (std::size_t k = 0; k < looked_at.size(); ++k) {
      const bool is_end = k + 1 == looked_at.size();
      const double start = after;
      before = is_end ? t_ : start;  // whether the motion is let go is asked at the end alone
      after = looked_at[k];
      if (has_left(after, is_end)) break;
      if (const std::optional<double> dip = find_dip(start, after, move_to)) {
        before = start;
        after = *dip;
        break;
      }
      if (is_end) return std::nullopt;
    }
    for (double middle = std::midpoint(before, after); before < middle && middle < after; middle = std::midpoint(before, after)) {
      (has_left(middle, true) ? after : before) = middle;
    }
    has_left(after, true);
    return after;
  }

  // Whether stages of the step are under constraints that come or go at `crossing`, so that the motion up to there is found less well
  // than the tolerances ask: the step is to be taken again, to just before.
  bool is_to_stop_before(double crossing, double t_new) {
    constexpr double at_start = 0.01;
    if (!looks_at_conditions() || shortfall_ >= 1 || is_at_once(crossing - t_) || crossing - t_ < at_start * (t_new - t_))
      return false;
    expand(x_crossing_, crossing);
    return active_conditions() != is_active_;
  }

  // A time between two at which a gap that opens again is past its surface, where it is least.
  template <typename Move>
  std::optional<double> find_dip(double start, double end, const Move& move_to) const {
    if (contacts_.is_empty()) return std::nullopt;
    const auto rates_at = [&](double t) {
      move_to(t);
      return contacts_.rates(state_);
    };
    const VectorXd at_start = rates_at(start), at_end = rates_at(end);
    for (Index k = 0; k < at_start.size(); ++k) {
      if (!(at_start[k] < 0 && at_end[k] > 0)) continue;
      double before = start, after = end;
      for (double middle = std::midpoint(before, after); before < middle && middle < after;
           middle = std::midpoint(before, after)) {
        (rates_at(middle)[k] < 0 ? before : after) = middle;
      }
      move_to(before);
      if (contacts_.is_hit(state_)) return before;
    }
    return std::nullopt;
  }

  // Whether a motion that is held may have been let go, and held again, within the step to t_new. What is held at rest has no error
  // however long the step is, and forces of time may come and go in it. Their margins are looked at at both ends and between.
  bool is_hold_unresolved(double t_new) {
    constexpr double rounding = 1e-6, shortest = 1e3;
    if (!switching_.is_sliding() && !contacts_.is_any_closed()) return false;
    if (t_new - t_ <= shortest * smallest_step()) return false;
    const auto margins_at = [&](double t) -> VectorXd {
      x_crossing_.resize(x_.size());
      stepper_.stepper().calc_state(t, x_crossing_, x_, dxdt_, t_, x_new_, dxdt_new_, t_new);
      expand(x_crossing_, t);
      if (options_.project || project_stages_) projection_.apply(state_);
      VectorXd margins(options_.contacts.size() + static_cast<std::size_t>(options_.switching.size()));
      margins << contacts_.margins(state_, of_motion()), switching_.margins(state_, counted());
      return margins;
    };
    try {
      const VectorXd start = margins_at(t_), middle = margins_at(std::midpoint(t_, t_new)), end = margins_at(t_new);
      const VectorXd bend = (middle - (start + end) / 2).cwiseAbs(), least = start.cwiseMin(middle).cwiseMin(end);
      const VectorXd size = start.cwiseAbs().cwiseMax(middle.cwiseAbs()).cwiseMax(end.cwiseAbs());
      return (bend.array() > rounding * size.array() && least.array() < 2 * bend.array()).any();
    } catch (const Error&) {
      return false;
    }
  }

  // whether a surface that the motion slides on, or a contact, does not hold it at state_
  bool is_let_go() {
    if (!switching_.is_sliding() && contacts_.is_empty()) return false;
    try {
      if (project_stages_) projection_.apply(state_);
      if (!contacts_.is_empty() && contacts_.is_released(state_, of_motion())) return true;
      return switching_.is_sliding() && switching_.is_let_go(state_, counted());
    } catch (const Error&) {
      return false;
    }
  }

  // The times before `end`, from the dense output of the step to t_new. False where its stages missed something: a force that acts for
  // a few rows between them.
  bool write_within(Index& next, double end, double t_new) {
    Phase x(x_.size()), dxdt(x_.size());
    constexpr Index few = 3;  // rows that a step may well leave to its error estimate
    const bool is_plain = switching_.is_empty() && contacts_.is_empty() && conditions_.empty();
    const bool is_long = next + few <= options_.times.size() && options_.times[next + few - 1] < end;
    for (; next < options_.times.size() && options_.times[next] < end; ++next) {
      const double t = options_.times[next];
      stepper_.stepper().calc_state(t, x, x_, dxdt_, t_, x_new_, dxdt_new_, t_new);
      if (options_.project) project(x, t);
      try {
        derivative(x, dxdt, t);
      } catch (const StageFault& fault) {
        stop(t, fault.text);
      }
      if (is_plain && is_long && is_missed(t, dxdt, t_new)) return false;
      write(next, t, x, dxdt);
    }
    return true;
  }

  // whether the velocities of the step change at t far otherwise than the accelerations there say
  [[nodiscard]] bool is_missed(double t, const Phase& dxdt, double t_new) {
    constexpr double share = 1e-3, far = 1e4;  // of the step; tolerances
    const double h = t_new - t_, before = std::max(t_, t - share * h), after = std::min(t_new, t + share * h);
    Phase from(x_.size()), to(x_.size());
    stepper_.stepper().calc_state(before, from, x_, dxdt_, t_, x_new_, dxdt_new_, t_new);
    stepper_.stepper().calc_state(after, to, x_, dxdt_, t_, x_new_, dxdt_new_, t_new);
    for (auto k = static_cast<std::size_t>(layout_.nq); k < 2 * static_cast<std::size_t>(layout_.nq); ++k) {
      const double rate = (to[k] - from[k]) / (after - before);
      const double tolerance = options_.absolute_tolerance + options_.relative_tolerance * (std::abs(x_[k]) + h * std::abs(rate));
      if (std::abs(dxdt[k] - rate) * h > far * tolerance) return true;
    }
    return false;
  }

  void advance(double t_new, bool has_crossed) {
    std::swap(x_, x_new_);
    std::swap(dxdt_, dxdt_new_);
    const double duration = t_new - std::exchange(t_, t_new);
    const bool switches = !switching_.is_empty() && (has_crossed || switching_.is_guided());
    const std::vector<bool> was_held = held_surfaces();
    if (!switching_.is_empty()) {
      expand(x_, t_);
      if (switches) {
        switching_.cross(state_);
        switching_.put(state_);
        std::copy_n(state_.begin(), x_.size(), x_.begin());
      }
      switching_.turn(state_);
    }
    const std::size_t n_events = out_.events.size();
    if (has_crossed && !contacts_.is_empty()) settle_contacts(/*at_start=*/false);
    const bool has_met = out_.events.size() > n_events;
    const bool moved = project_and_note_jump();
    count_turns(duration);
    if (switches) {
      switch_or_throw([&] {
        if (has_met || (moved && has_turned_)) {
          switching_.start(state_, counted());
        } else {
          switching_.settle(state_, counted());
        }
      });
      note_sticks(was_held);
    }
    if (moved || switches || has_crossed) derivative_or_throw();
  }

  // Projects the state; by a constraint that takes hold off its surface a body is moved there at once. That may undo its condition:
  // the motion goes on under those that are there afterwards.
  bool project_and_note_jump() {
    if (conditions_.empty() || instant_) return options_.project && project(x_, t_);
    const Phase before = x_;
    expand(x_, t_);
    const std::vector<bool> is_active = active_conditions(), was_active = std::exchange(is_active_, is_active);
    has_turned_ = is_active != was_active;
    if (!options_.project) return false;
    const bool has_moved = project(x_, t_);
    if (has_moved) is_active_ = active_conditions();
    note_extent();
    bool takes_hold = false;
    for (std::size_t k = 0; k < is_active.size(); ++k) takes_hold = takes_hold || (is_active[k] && !was_active[k]);
    constexpr double much = 1e-3;  // of the way that a coordinate has come
    for (Index j = 0; has_moved && takes_hold && j < layout_.nq; ++j) {
      const auto k = static_cast<std::size_t>(j);
      const double jump = std::abs(x_[k] - before[k]);
      if (jump <= std::max(out_.largest_jump, much * (highest_[j] - lowest_[j]))) continue;
      out_.largest_jump = jump;
      out_.jump_time = t_;
    }
    return has_moved;
  }

  // Whether steps end where a constraint comes or goes. One that turns again and again within no time, as it does at the very edge of
  // its condition, would hold the motion up: then a step is taken across all that.
  [[nodiscard]] bool looks_at_conditions() const {
    return !conditions_.empty() && !instant_ && turns_at_once_ < most_turns_at_once();
  }
  [[nodiscard]] int most_turns_at_once() const { return 10 * static_cast<int>(conditions_.size()); }
  void count_turns(double duration) {
    const bool is_one_more = has_turned_ && (!looks_at_conditions() || is_at_once(duration));
    const int change = is_one_more ? 1 : is_at_once(duration) ? 0 : -1;
    turns_at_once_ = std::clamp(turns_at_once_ + change, 0, most_turns_at_once());
  }
  // of the motion what the tolerance is of a state
  [[nodiscard]] bool is_at_once(double duration) const {
    constexpr double shortest = 1e3;
    return duration <= std::max(shortest * smallest_step(), options_.relative_tolerance * (t_end() - options_.times[0]));
  }

  void note_extent() {
    const Eigen::Map<const VectorXd> q(x_.data(), layout_.nq);
    lowest_ = lowest_.size() == 0 ? VectorXd(q) : VectorXd(lowest_.cwiseMin(q));
    highest_ = highest_.size() == 0 ? VectorXd(q) : VectorXd(highest_.cwiseMax(q));
  }

  // which of conditions_ hold at state_
  [[nodiscard]] std::vector<bool> active_conditions() const {
    std::vector<bool> active;
    if (conditions_.empty()) return active;
    const SystemValues values = system_.evaluate(state_, parameters_);
    for (const int row : conditions_) active.push_back(!values.A(0).row(row).isZero(0));
    return active;
  }

  // rows of A that come and go by themselves, not as contacts
  [[nodiscard]] std::vector<int> conditional_rows() const {
    std::vector<int> rows;
    for (int row = 0; row < system_.nc(); ++row) {
      const bool is_contact = std::ranges::any_of(options_.contacts, [&](const Contact& one) { return one.row == row; });
      if (system_.is_conditional(row) && !is_contact) rows.push_back(row);
    }
    return rows;
  }

  // where the motion is on a surface now, and was beside it, or the other way round
  void note_sticks(const std::vector<bool>& before) {
    const std::vector<bool> after = held_surfaces();
    for (std::size_t k = 0; k < after.size(); ++k) {
      if (before[k] != after[k]) out_.sticks.push_back({t_, static_cast<int>(k), after[k]});
    }
  }

  [[nodiscard]] std::vector<bool> held_surfaces() const {
    std::vector<bool> out;
    for (int k = 0; k < options_.switching.size(); ++k) out.push_back(switching_.is_held(k));
    return out;
  }

  [[nodiscard]] Acceleration of_sides_anew() {
    return [this](const Ref<const VectorXd>& state) -> VectorXd {
      return switching_.is_empty() ? counted()(state) : switching_.acceleration_anew(state, counted());
    };
  }

  // Δdq of an impact with friction, whose gaps open at rates that change evenly by r: a motion of the velocities alone, within a
  // time so short that no surface moves, under loads so large that no other force counts (theory.md, T49).
  VectorXd jump(const VectorXd& at, const VectorXd& r) {
    constexpr double duration = 1e-12, same = 1e-6;
    if (r.isZero(0)) return VectorXd::Zero(layout_.nq);
    const double large = 1e3 / duration / r.norm();
    const auto between = [this, &r](double less, double more) -> Acceleration {
      return [below = options_.pushed(less * r), above = options_.pushed(more * r), scale = duration * (more - less)](
                 const Ref<const VectorXd>& state) -> VectorXd { return (above(state) - below(state)) / scale; };
    };
    const Acceleration impulse = between(large, 2 * large);
    const VectorXd ddq = impulse(at);
    if (!((ddq - between(2 * large, 4 * large)(at)).norm() <= same * ddq.norm())) {
      throw NumericalError("the friction of an impact grows faster than its load, so that its impulse is not finite");
    }
    SimulateOptions options = options_;
    options.times = Eigen::Vector2d(0, duration);
    options.relative_tolerance = std::min(options.relative_tolerance, 1e-9);
    options.project = false;
    options.contacts.clear();
    options.record = {};
    options.initial_step = 0;
    Integration motion(system_, parameters_, impulse, options);
    motion.instant_ = at;
    try {
      const Trajectory velocities = motion.run(at, /*redundant=*/false);
      out_.evaluations += 2 * velocities.evaluations;
      return velocities.states.col(1).segment(layout_.dq(0), layout_.nq) - at.segment(layout_.dq(0), layout_.nq);
    } catch (const UnfinishedMotion& unfinished) {
      throw NumericalError(unfinished.what());
    }
  }

  // impacts and releases at (x_, t_)
  void settle_contacts(bool at_start) {
    expand(x_, t_);
    try {
      if (at_start) {
        contacts_.start(state_, of_sides_anew(), out_.events);
      } else {
        contacts_.settle(state_, of_sides_anew(), out_.events);
      }
    } catch (const Error& error) {
      if (at_start) throw;
      stop(t_, error.what());
    }
    project_stages_ = has_redundant_rows(system_, parameters_, projection_, state_);
    if (at_start && options_.project) projection_.apply(state_);
    std::copy_n(state_.begin(), x_.size(), x_.begin());
  }

  // at (x_, t_), whose state is in state_
  template <typename Work>
  void switch_or_throw(const Work& work) {
    if (switching_.is_empty()) return;
    expand(x_, t_);
    try {
      if (project_stages_) projection_.apply(state_);
      work();
    } catch (const Error& error) {
      stop(t_, error.what());
    }
  }

  // after the acceleration at the same state
  void write(Index row, double t, const Phase& x, const Phase& dxdt) {
    expand(x, t);
    out_.states.col(row) = state_;
    std::copy(dxdt.begin() + layout_.nq, dxdt.end(), out_.accelerations.col(row).begin());
    options_.inputs.command(t, out_.commands.col(row));
    for (const Contact& contact : options_.contacts) out_.commands(contact.input, row) = state_[layout_.u(contact.input)];
    if (!options_.record) return;
    const VectorXd recorded = switching_.mixed(state_, options_.record);
    if (out_.records.size() == 0) out_.records.resize(recorded.size(), options_.times.size());
    require_shape("simulate: what is recorded", recorded, out_.records.rows(), 1);
    out_.records.col(row) = recorded;
  }

  const System& system_;
  const VectorXd& parameters_;
  const StateLayout layout_;
  const Acceleration& acceleration_;
  const SimulateOptions& options_;
  const ConstraintProjection projection_;
  Switching switching_;
  Contacts contacts_;
  ControlledStepper stepper_;
  bool project_stages_ = false;
  double longest_holding_step_ = std::numeric_limits<double>::infinity();
  VectorXd state_;                // scratch
  double t_ = 0, t_halfway_ = 0;  // … when half of the steps were taken
  Phase x_, dxdt_, x_new_, dxdt_new_, x_crossing_;
  std::optional<StageFault> fault_;  // of the last try
  std::optional<VectorXd> instant_;  // the state of which velocities alone move
  const std::vector<int> conditions_ = conditional_rows();
  std::vector<bool> is_active_;  // of conditions_, at t_
  bool has_turned_ = false;      // whether one of them did at t_
  int turns_at_once_ = 0;        // one after the other, until t_
  static constexpr double least_shortfall = 1e-4;
  double shortfall_ = least_shortfall;  // of a step that is to end before a condition turns
  VectorXd lowest_, highest_;           // coordinates up to then
  Trajectory out_;
};

void require_options(const SimulateOptions& options, const System& system) {
  const VectorXd& times = options.times;
  if (times.size() < 2)
    throw InputError(fmt::format("simulate: at least two times are needed, the start and the end, got {}", times.size()));
  if (!times.allFinite()) throw InputError("simulate: a time is not a finite number");
  for (Index k = 1; k < times.size(); ++k) {
    if (times[k] > times[k - 1]) continue;
    throw InputError(fmt::format("simulate: times must increase, but {} follows {}", times[k], times[k - 1]));
  }
  const auto require_positive = [](const char* what, double value) {
    if (!(value > 0) || !std::isfinite(value))
      throw InputError(fmt::format("simulate: {} must be positive, got {}", what, value));
  };
  require_positive("the relative tolerance", options.relative_tolerance);
  if (options.relative_tolerance < least_relative_tolerance) {
    throw InputError(fmt::format("simulate: the relative tolerance must be at least {}, near the rounding of doubles, got {}",
                                 least_relative_tolerance, options.relative_tolerance));
  }
  require_positive("the absolute tolerance", options.absolute_tolerance);
  if (!(options.initial_step >= 0) || !std::isfinite(options.initial_step)) {
    throw InputError(fmt::format("simulate: the initial step must not be negative, got {}", options.initial_step));
  }
  if (!options.contacts.empty()) require_positive("the shortest flight", options.shortest_flight);
  if (options.max_steps < 1) throw InputError(fmt::format("simulate: max_steps must be at least 1, got {}", options.max_steps));
  if (!options.inputs.is_zero() && options.inputs.size() != system.layout().nu) {
    throw InputError(fmt::format("simulate: the table of inputs has {} rows, the system {} inputs", options.inputs.size(),
                                 system.layout().nu));
  }
}

}  // namespace

Trajectory simulate(const System& system, const VectorXd& parameters, const Acceleration& acceleration,
                    const Ref<const VectorXd>& start, const SimulateOptions& options) {
  const auto clock_start = std::chrono::steady_clock::now();
  const StateLayout layout = system.layout();
  if (parameters.size() != static_cast<Index>(system.parameters().size())) {
    throw InputError(
        fmt::format("simulate: '{}' has {} parameters, got {}", system.name(), system.parameters().size(), parameters.size()));
  }
  if (start.size() != layout.size() || !start.head(2 * layout.nq).allFinite()) {
    throw InputError(
        fmt::format("simulate: the start must be a state of {} entries, coordinates and velocities finite", layout.size()));
  }
  require_options(options, system);

  const ConstraintProjection projection(system, parameters);
  VectorXd state = start;
  state[layout.t()] = options.times[0];
  options.inputs.evaluate(options.times[0], state.tail(layout.nu));
  const double position_residual = projection.largest_residual(state, false);
  const double velocity_residual = projection.largest_residual(state, true);
  if (options.project) projection.apply(state);
  const bool redundant = has_redundant_rows(system, parameters, projection, state);

  const auto report = [&](Trajectory& out) {
    out.start_position_residual = position_residual;
    out.start_velocity_residual = velocity_residual;
    out.start_displacement = (state - start).head(2 * layout.nq).lpNorm<Eigen::Infinity>();
    out.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - clock_start).count();
    if (out.times.size() == 0) return;
    out.max_position_drift = projection.largest_residual(out.states, false);
    out.max_velocity_drift = projection.largest_residual(out.states, true);
    out.lower_rank = states_of_lower_rank(system, out.states, parameters);
  };
  try {
    Trajectory out = Integration(system, parameters, acceleration, options).run(state, redundant);
    report(out);
    return out;
  } catch (UnfinishedMotion& unfinished) {
    report(unfinished.motions.front());
    throw;
  }
}

Acceleration model_acceleration(const Model& model) {
  return
      [motion = ModelMotion(model)](const Ref<const VectorXd>& state) -> VectorXd { return motion.acceleration(state).col(0); };
}

PushedAcceleration pushed_acceleration(const Model& model) {
  const ModelMotion motion(model);
  if (!motion.reads_load()) return {};
  return [motion](const VectorXd& push) -> Acceleration {
    return [pushed = motion.pushed(push)](const Ref<const VectorXd>& state) -> VectorXd {
      return pushed.acceleration(state).col(0);
    };
  };
}

PushedAcceleration pushed_acceleration(const Prior& prior, const View& view,
                                       std::function<MatrixXd(const View& view, const Ref<const MatrixXd>& states)> function) {
  if (!reads_loads(prior)) return {};
  return [prior, view, function = std::move(function)](const VectorXd& push) -> Acceleration {
    return [function, view = pushed(prior, view, push)](const Ref<const VectorXd>& state) -> VectorXd {
      return function(view, state).col(0);
    };
  };
}

VectorXd kinetic_energy(const System& system, const VectorXd& parameters, const Ref<const MatrixXd>& states) {
  VectorXd energy(states.cols());
  const SystemValues values = system.evaluate(states, parameters);
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const auto dq = states.col(i).segment(system.layout().dq(0), system.nq());
    energy[i] = 0.5 * dq.dot(values.M(i) * dq);
  }
  return energy;
}

VectorXd mechanical_energy(const Model& model, const VectorXd& parameters, const Ref<const MatrixXd>& states) {
  if (!model.potential) throw InputError(fmt::format("{}: no energy without [mechanics] potential = \"…\"", model.name));
  MatrixXd potential;
  Tape(std::span(&*model.potential, 1), model.symbols().state_and_parameters()).evaluate(states, parameters, potential);
  return kinetic_energy(*model.system, parameters, states) + potential.row(0).transpose();
}

}  // namespace gp2
