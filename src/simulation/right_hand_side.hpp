#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "simulation/motion_mode.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

using Phase = std::vector<double>;  // [q; dq], as odeint keeps it

/// A point of a motion that is integrated.
struct PhasePoint {
  double t = 0;
  Phase x, dxdt;
};

/// There is no acceleration at a stage of a step, which is tried again, smaller.
struct StageFault {
  std::string text;
};

/// An acceleration does not have as many entries as the system has coordinates.
struct WrongSize {
  Eigen::Index size;
};

/// d[q; dq]/dt of a motion in the mode that it is in.
class RightHandSide {
 public:
  /// @param instant  a state whose velocities alone move, its coordinates, time and inputs as they are; none: all of it moves
  RightHandSide(StateLayout layout, const Acceleration& acceleration, const SimulateOptions& options,
                const ConstraintProjection& projection, MotionMode& mode, std::optional<Eigen::VectorXd> instant);

  /// [q; dq; t; u(t)], the inputs of contacts among u as the mode has them.
  [[nodiscard]] Eigen::VectorXd state(const Phase& x, double t) const;
  /// The same where the acceleration is asked for: on the constraints where states or stages are put there.
  [[nodiscard]] Eigen::VectorXd projected_state(const Phase& x, double t) const;
  /// Puts x onto the constraints, with the option `project`. @return whether it changed
  bool project(Phase& x, double t) const;
  /// From now on stages are put onto the constraints, as redundant rows need.
  void project_stages(bool project) { projects_stages_ = project; }
  void put_stage(Eigen::VectorXd& state) const;

  /// The acceleration, each call of which counts. @throws WrongSize
  [[nodiscard]] Acceleration counted();
  /// ddq on the sides of the surfaces that the motion is on.
  [[nodiscard]] Acceleration on_its_sides();
  /// The same on the sides that a state is on, whatever the motion was on before.
  [[nodiscard]] Acceleration on_sides_anew();
  [[nodiscard]] int evaluations() const { return evaluations_; }

  /// @throws StageFault
  void operator()(const Phase& x, Phase& dxdt, double t);
  /// Sets dxdt of a point at which no smaller step can be tried. @throws NumericalError where there is no acceleration
  void evaluate(PhasePoint& at);
  /// @throws NumericalError, that there is no acceleration at t
  [[noreturn]] void fail(double t, const std::string& text) const;

 private:
  const StateLayout layout_;
  const Acceleration& acceleration_;
  const SimulateOptions& options_;
  const ConstraintProjection& projection_;
  MotionMode& mode_;
  const std::optional<Eigen::VectorXd> instant_;
  bool projects_stages_ = false;
  int evaluations_ = 0;
};

}  // namespace gp2
