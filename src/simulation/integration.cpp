#include "simulation/integration.hpp"

#include <algorithm>
#include <limits>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "simulation/event_finder.hpp"
#include "simulation/mode_changes.hpp"
#include "simulation/recorder.hpp"
#include "simulation/step_limits.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// T, or I where the mechanics have a fault, which the acceleration tells of
MatrixXd tangent_at(const System& system, const VectorXd& parameters, const VectorXd& state) {
  const MechanicsBatch mechanics = evaluate_mechanics(system, state, parameters);
  return mechanics.fault ? MatrixXd::Identity(system.nq(), system.nq()) : mechanics.projections[0].T();
}

// The loop over the steps of a motion: where each ends, whether it is taken again, and what is written of it.
class Integration {
 public:
  // is_instant: integrate_velocities
  Integration(const System& system, const VectorXd& parameters, const Acceleration& acceleration, const VectorXd& start,
              const SimulateOptions& options, bool is_instant)
      : options_(options),
        projection_(system, parameters),
        conditional_rows_(conditional_rows(system, options.contacts)),
        mode_{{options.switching, parameters, system.layout(), options.absolute_tolerance},
              {system, parameters, options},
              {system, parameters, is_instant ? std::vector<int>() : conditional_rows_}},
        rhs_(system.layout(), acceleration, options, projection_, mode_,
             is_instant ? std::optional<VectorXd>(start) : std::nullopt),
        step_([this](const Phase& x, Phase& dxdt, double t) { rhs_(x, dxdt, t); }, options.absolute_tolerance,
              options.relative_tolerance),
        limits_(options, !conditional_rows_.empty()),
        events_(rhs_, mode_),
        changes_(projection_, rhs_, mode_),
        recorder_(options, system.layout()) {
    mode_.switching.move_along([&](const VectorXd& state) { return tangent_at(system, parameters, state); });
    step_.start().t = options.times[0];
    step_.start().x.assign(start.begin(), start.begin() + system.layout().t());  // t follows q and dq
  }

  void jump_by(Contacts::Jump jump) { mode_.contacts.jump_by(std::move(jump)); }
  void put_stages_onto_redundant_rows() {
    rhs_.project_stages(true);
    mode_.switching.put_onto([this](VectorXd& state) { projection_.apply(state); });
  }

  Trajectory run() {
    PhasePoint& now = step_.start();
    try {
      changes_.start(now);
      write(now);
      mode_.conditions.start(rhs_.state(now.x, now.t));
      integrate();
    } catch (const WrongSize& wrong) {
      throw InputError(
          fmt::format("simulate: the acceleration has {} entries, the system {} coordinates", wrong.size, now.x.size() / 2));
    } catch (const NumericalError& error) {
      write_reached();
      throw UnfinishedMotion(error.what(), {finish()});
    }
    return finish();
  }

 private:
  void integrate() {
    constexpr double growth = 1.5;
    const PhasePoint &now = step_.start(), &end = step_.end();
    step_.set_size(options_.initial_step > 0 ? options_.initial_step : step_.first_size(limits_.end() - now.t));
    while (!recorder_.is_done()) {
      limits_.require_progress(now.t, step_.accepted(), step_.rejected());
      // a step ends where an input has a kink, and at the end
      if (!step_.try_step(std::min(options_.inputs.next_kink(now.t), limits_.end()))) {
        limits_.require_size(step_.size(), now.t, step_.accepted(), step_.fault());
        continue;
      }
      const std::optional<EventFinder::Event> event = events_.find(step_, recorder_.times_before(end.t));
      if (!event && events_.is_hold_unresolved(step_, limits_.smallest(now.t))) {
        step_.take_again(longest_holding_step_ = (end.t - now.t) / 2);
        continue;
      }
      if (event && is_to_stop_before(*event)) {
        step_.take_again((1 - shortfall_) * (event->t - now.t));
        shortfall_ *= 10;
        continue;
      }
      shortfall_ = least_shortfall;
      step_.set_size(std::min(step_.size(), longest_holding_step_ *= growth));
      if (!write_before(event ? event->t : end.t)) {
        step_.take_again((end.t - now.t) / 2);
        continue;
      }
      if (event) step_.end_at(event->t, event->x);
      advance(event.has_value());
      if (recorder_.is_due(now.t)) write(now);
    }
  }

  // Whether stages of the step are under constraints that come or go at the event, so that the motion up to there is found less well
  // than the tolerances ask: the step is to be taken again, to just before.
  [[nodiscard]] bool is_to_stop_before(const EventFinder::Event& event) const {
    constexpr double at_start = 0.01;
    const double start = step_.start().t;
    if (!mode_.conditions.end_steps() || shortfall_ >= 1 || limits_.is_at_once(event.t - start, start) ||
        event.t - start < at_start * (step_.end().t - start))
      return false;
    return mode_.conditions.have_turned(rhs_.state(event.x, event.t));
  }

  void advance(bool has_left) {
    const double duration = step_.advance();
    changes_.settle(step_.start(), has_left);
    mode_.conditions.count_turns(limits_.is_at_once(duration, step_.start().t));
  }

  // The times before `end`, from the dense output of the step. False where its stages missed something: a force that acts for a few rows
  // between them, or that lets go what is held at its end again.
  bool write_before(double end) {
    constexpr std::size_t few = 3;  // rows that a step may well leave to its error estimate
    const double start = step_.start().t;
    const Index first = recorder_.n_written();
    const std::span<const double> times = recorder_.times_before(end);
    const bool may_miss = mode_.conditions.is_empty() && times.size() >= few;
    const bool may_let_go = !limits_.is_at_once(end - start, start);
    for (const double t : times) {
      PhasePoint at{t, step_.at(t), {}};
      rhs_.project(at.x, t);
      const bool is_let_go = may_let_go && events_.is_let_go_at(at);
      rhs_.evaluate(at);
      if (is_let_go || (may_miss && step_.is_missed(at))) {
        recorder_.keep(first);
        return false;
      }
      write(at);
    }
    return true;
  }

  // after the acceleration at the same state
  void write(const PhasePoint& at) {
    const VectorXd state = rhs_.state(at.x, at.t);
    recorder_.write(state, at, options_.record ? mode_.switching.mixed(state, options_.record) : VectorXd());
  }

  // the state that was reached, after what was written
  void write_reached() {
    if (!recorder_.is_behind(step_.start().t)) return;
    try {
      write(step_.start());
    } catch (const Error&) {
      // there is nothing to record where there is no motion
    }
  }

  Trajectory finish() {
    Trajectory out = recorder_.take();
    out.events = changes_.events();
    out.sticks = changes_.sticks();
    out.largest_jump = mode_.conditions.largest_jump();
    out.jump_time = mode_.conditions.jump_time();
    out.steps = step_.accepted();
    out.rejected_steps = step_.rejected();
    out.evaluations = rhs_.evaluations();
    return out;
  }

  const SimulateOptions& options_;
  const ConstraintProjection projection_;
  const std::vector<int> conditional_rows_;
  MotionMode mode_;
  RightHandSide rhs_;
  DormandPrince step_;
  StepLimits limits_;
  EventFinder events_;
  ModeChanges changes_;
  Recorder recorder_;
  double longest_holding_step_ = std::numeric_limits<double>::infinity();
  static constexpr double least_shortfall = 1e-4;
  double shortfall_ = least_shortfall;  // of a step that is to end before a condition turns
};

}  // namespace

Trajectory integrate_motion(const System& system, const VectorXd& parameters, const Acceleration& acceleration,
                            const VectorXd& start, const SimulateOptions& options, Contacts::Jump jump) {
  const bool is_redundant = ConstraintProjection(system, parameters).has_redundant_rows(start);
  Integration integration(system, parameters, acceleration, start, options, /*is_instant=*/false);
  integration.jump_by(std::move(jump));
  if (is_redundant) integration.put_stages_onto_redundant_rows();
  return integration.run();
}

Trajectory integrate_velocities(const System& system, const VectorXd& parameters, const Acceleration& acceleration,
                                const VectorXd& start, const SimulateOptions& options) {
  return Integration(system, parameters, acceleration, start, options, /*is_instant=*/true).run();
}

}  // namespace gp2
