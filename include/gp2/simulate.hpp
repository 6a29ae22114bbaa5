#pragma once

#include <atomic>
#include <functional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/actuator.hpp"
#include "gp2/error.hpp"
#include "gp2/export.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/model.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// ddq at one state [q; dq; t; u]: a model's own, a posterior mean, or one sample of a posterior.
using Acceleration = std::function<Eigen::VectorXd(const Eigen::Ref<const Eigen::VectorXd>& state)>;

/// The same under A ddq = b + push, given a push of each row of A (nc), which is 0 of those that are not there.
using PushedAcceleration = std::function<Acceleration(const Eigen::VectorXd& push)>;

/// Inputs over time: zero, or a table of commands that is linear in between and held at its ends, as their actuators follow it,
/// exactly; before the table they are constant, at its first values.
class InputSignal {
 public:
  InputSignal() = default;  // zero
  /// @param times      (K), strictly increasing
  /// @param values     (nu × K)
  /// @param actuators  of each input; empty: the commands act themselves
  /// @throws InputError when the sizes differ, K = 0, times do not increase, or a number is not finite.
  InputSignal(Eigen::VectorXd times, Eigen::MatrixXd values, const std::vector<Actuator>& actuators = {});

  [[nodiscard]] bool is_zero() const { return times_.size() == 0; }
  [[nodiscard]] int size() const { return static_cast<int>(values_.rows()); }  // nu; 0 of the zero signal

  /// What acts at t.
  void evaluate(double t, Eigen::Ref<Eigen::VectorXd> u) const;
  /// What is commanded at t.
  void command(double t, Eigen::Ref<Eigen::VectorXd> u) const;
  /// The first time after t at which a slope changes; +∞ when there is none.
  [[nodiscard]] double next_kink(double t) const;

 private:
  void find_kinks();
  /// At t, between two commands of the table.
  struct Place {
    Eigen::Index before = 0;
    double since = 0;    // that one [s]; negative: before the table
    double command = 0;  // there
  };
  [[nodiscard]] Place place(Eigen::Index input, double t) const;

  Eigen::VectorXd times_;
  Eigen::MatrixXd values_;
  Eigen::VectorXd delay_, lag_;  // of each input (nu)
  Eigen::MatrixXd acting_;       // when each command arrives, at times_ + delay_ (nu × K)
  std::vector<double> kinks_;
};

/// Surfaces of the state at which an acceleration jumps: zeros of a function g(x), as of v where dry friction is −μ sign(v), or common
/// zeros of several, as of v and w where dry friction in a plane is −μ (v, w)/√(v² + w²).
class SwitchingFunctions {
 public:
  SwitchingFunctions() = default;  // none
  /// @param surfaces  the functions g of each, which read velocities and no input
  SwitchingFunctions(std::span<const std::vector<Expression>> surfaces, const SystemSymbols& symbols);

  [[nodiscard]] int size() const { return static_cast<int>(names_.size()); }
  /// Of each surface: its functions as texts, "v" or "v, w".
  [[nodiscard]] const std::vector<std::string>& names() const { return names_; }
  /// The functions of surface k are those from first[k] on, before first[k + 1].  (size + 1)
  [[nodiscard]] const std::vector<int>& first() const { return first_; }
  /// @param values     g of all surfaces, one after the other (first[size])
  /// @param gradients  ∂g/∂[q; dq; t] (first[size] × 2 nq + 1)
  void evaluate(const Eigen::Ref<const Eigen::VectorXd>& state, const Eigen::Ref<const Eigen::VectorXd>& parameters,
                Eigen::VectorXd& values, Eigen::MatrixXd& gradients) const;

 private:
  Tape tape_;
  std::vector<int> first_ = {0};
  std::vector<std::string> names_;
};

/// The arguments of sign() that read velocities, and those that stand over their own length, v/|v| or v/√(v² + w²), in a model's force,
/// and in its [truth] or in features and directions of its latents.
/// @param of_latents  the latter, for the motion of a fit; else [truth], for that of a model
SwitchingFunctions switching_functions(const Model& model, bool of_latents);

/// A constraint c(q, t) = 0 that can only push: the gap c is never negative. The input that its row of A and b is switched by says
/// whether there is contact; in a motion it follows from the motion.
struct Contact {
  int row = 0;             // of A
  int input = 0;           // of the inputs: 1 in contact, 0 apart
  double restitution = 0;  // e ∈ [0, 1]: an impact changes the rate of the gap from ċ to −e ċ
  /// e where it depends on the state before the impact, in the place of the number.
  std::function<double(const Eigen::Ref<const Eigen::VectorXd>& state)> restitution_at = {};
};

/// The contacts of a model. @throws InputError when a restitution that no state changes is outside [0, 1].
std::vector<Contact> contacts_of(const Model& model, const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// What happened to a contact in a motion.
struct ContactEvent {
  enum class Kind { impact /* and apart again */, made, released };
  double time = 0;
  int row = 0;  // of A
  Kind kind = Kind::impact;
  double approach = 0;     // −ċ before an impact, 0 of a release
  double energy_loss = 0;  // kinetic energy that the impact took [J]
};

/// A surface at which the acceleration jumps starts to hold a motion, as dry friction does a body that sticks, or lets it go.
struct StickEvent {
  double time = 0;
  int surface = 0;     // of the switching functions
  bool sticks = true;  // or slips
};

inline constexpr double least_relative_tolerance = 1e-14;

struct SimulateOptions {
  Eigen::VectorXd times;             // at which states are written, strictly increasing; the first is the start [s]
  double relative_tolerance = 1e-6;  // of a step's error estimate, in each of q and dq
  double absolute_tolerance = 1e-9;  // in the units of q and dq
  bool project = true;               // onto position and velocity constraints, after each step and where states are written
  InputSignal inputs;                // u(t)
  int max_steps = 1'000'000;         // accepted and rejected
  SwitchingFunctions switching;      // where the acceleration jumps
  std::vector<Contact> contacts;     // that are made and released
  double shortest_flight = 1e-7;     // a rebound that would last no longer ends in contact [s]
  PushedAcceleration pushed;         // what says how the friction of an impact follows from its load; none: it has no friction
  Acceleration record;               // another function of the state, of any size, that is wanted at the times; none
  double initial_step = 0;           // [s]; 0: found from the first two accelerations
  std::string max_steps_advice =
      "loosen the tolerances, or allow more steps (`max_steps`)";  // in the error when they are reached
  const std::atomic<bool>* stop = nullptr;                         // once set the motion ends with its next step
};

/// A motion at the times asked for.
struct Trajectory {
  Eigen::VectorXd times;          // (N) [s]
  Eigen::MatrixXd states;         // [q; dq; t; u] (layout size × N)
  Eigen::MatrixXd accelerations;  // ddq there (nq × N)
  Eigen::MatrixXd commands;       // inputs as a log has them, states hold what acts; of contacts as they were (nu × N)
  Eigen::MatrixXd records;        // options.record there

  double max_position_drift = 0;       // largest |c| of position constraints at the written times
  double max_velocity_drift = 0;       // largest |dc/dt|, or |c| of velocity constraints, there
  double largest_jump = 0;             // by which a constraint that takes hold (`when`) moved a coordinate; 0: by little
  double jump_time = 0;                // then [s]
  LowerRank lower_rank;                // written times at which constraints let go, or follow from each other
  double start_position_residual = 0;  // the drift at the start as it was given
  double start_velocity_residual = 0;
  double start_displacement = 0;  // by how much the projection of the start changed an entry of q or dq, at most

  std::vector<ContactEvent> events;  // in the order of time
  std::vector<StickEvent> sticks;    // in the order of time; none of the start

  int steps = 0;           // accepted
  int rejected_steps = 0;  // error above the tolerance, or no finite acceleration
  int evaluations = 0;     // of the acceleration
  double seconds = 0;      // wall time
};

/// A motion that could not be continued to its end.
class UnfinishedMotion : public NumericalError {
 public:
  UnfinishedMotion(const std::string& text, std::vector<Trajectory> reached)
      : NumericalError(text), motions(std::move(reached)) {}

  std::vector<Trajectory> motions;  // the last of them up to the state at which it stopped
};

/// Integrates ddq = acceleration(q, dq, t, u(t)) with the adaptive Dormand–Prince pair 5(4) and its dense output.
///
/// An accepted step, its error estimated before, is projected onto the constraints: with c the residuals of position level and
/// their rows A, q ← q − M⁻¹Aᵀ(A M⁻¹Aᵀ)⁺c until |c| is rounding, then dq the same way, so that the state moves as little as can
/// be in the metric of M. The first stage is evaluated anew where that changed the state. Written states, interpolated between
/// steps, are projected too. Steps end at the kinks of the inputs, so that no pulse is stepped over. Redundant constraints mean
/// nothing off the constraint: the stages of such systems are evaluated at their projections, with `project` or without.
///
/// A zero of a switching function ends a step. There the motion crosses to the other side; or, where all sides drive it back, it
/// stays on the zero with the mixture of their accelerations that keeps it there (Filippov), until that mixture leaves what lies
/// between them: a body under dry friction rests, and breaks loose. Friction may be proportional to a load that it changes itself:
/// |λ_t| ≤ μ |λ_n| holds of each of several contacts, whose accelerations are those of all combinations of sides, mixed.
///
/// A contact ends a step where its gap closes, found on the dense output. It is an impact of Newton's law, during which all other
/// active constraints hold, along M⁻¹Aᵀ and with the friction that its load brings about. Where the rebound is over within
/// `shortest_flight` the contact stays closed, so that the accumulating bounces of a ball end. A restitution outside [0, 1] is an error.
/// A closed contact is released where the motion without it would open the gap, which is where its multiplier would pull. One at a
/// time: where several close or open together, those that would pull are let go one after the other, which is not the
/// complementarity problem of many contacts.
///
/// A constraint with a condition comes or goes at the end of a step, where the condition turns, found on the dense output at eight
/// places of a step and at the written times.
///
/// @param parameters  of the system's constraints and mass matrix (system.parameters().size())
/// @param start       [q; dq; …] (layout size), t and u are set from the options. Off the constraint it is projected, or taken as
///                    it is without `project`; the trajectory reports both.
/// @throws InputError when sizes, times or tolerances are wrong.
/// @throws UnfinishedMotion with the time, when a projection does not converge, the acceleration is not finite or cannot be
///   computed, the step size underflows, max_steps is reached, or it was to stop.
Trajectory simulate(const System& system, const Eigen::VectorXd& parameters, const Acceleration& acceleration,
                    const Eigen::Ref<const Eigen::VectorXd>& start, const SimulateOptions& options);

/// Moves a state onto the position and velocity constraints, by the least distance in the metric of M, without changing the
/// coordinates and velocities that are held.
/// @param held  entries of the state that stay as they are (layout size); none when empty
/// @throws NumericalError naming the time and the residual, when Newton's method does not reach the constraints.
Eigen::VectorXd project_onto_constraints(const System& system, const Eigen::VectorXd& parameters,
                                         const Eigen::Ref<const Eigen::VectorXd>& state, const std::vector<bool>& held = {});

/// A start of which not every coordinate and velocity is given.
struct StartingPoint {
  Eigen::VectorXd state;    // (layout size)
  std::vector<bool> given;  // (layout size)
};

/// The state at which a motion starts: coordinates and velocities that are not given follow from the constraints, the given ones
/// held; Newton's method starts for them at the model's newton_start, or at what `start` has, and where coordinates alone are given
/// and constraints have no slope there, beside it. Where what is given leaves no solution it stays as it is, for simulate() to
/// project or not; what is not given follows at the nearest coordinates that have one, with the given velocities held if they allow it.
/// @param notes  what was solved for, or why not and what is nearest, is added
Eigen::VectorXd complete_start(const Model& model, const Eigen::VectorXd& parameters, StartingPoint start,
                               std::vector<std::string>& notes);

/// The acceleration of a model as it is written: L b + T (M⁻¹F + truth), truth = 0 without [truth].
Acceleration model_acceleration(const Model& model);
/// The same under pushes; none where its truth reads no load, so that its impacts have no friction.
PushedAcceleration pushed_acceleration(const Model& model);
/// Of the mean of a posterior, or a sample; none where its prior reads no load.
/// @param function  what a view of the prior is at states: Posterior::mean, or PathwiseSamples::evaluate of one sample
/// @param view      of ddq
PushedAcceleration pushed_acceleration(
    const Prior& prior, const View& view,
    std::function<Eigen::MatrixXd(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states)> function);

/// Kinetic energy ½ dqᵀM dq of a system, at N states (N) [J].
Eigen::VectorXd kinetic_energy(const System& system, const Eigen::VectorXd& parameters,
                               const Eigen::Ref<const Eigen::MatrixXd>& states);

/// Kinetic and potential energy ½ dqᵀM dq + V of a model with [mechanics] potential, at N states (N) [J].
/// @throws InputError when the model has none.
Eigen::VectorXd mechanical_energy(const Model& model, const Eigen::VectorXd& parameters,
                                  const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
