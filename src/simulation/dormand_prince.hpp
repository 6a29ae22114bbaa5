#pragma once

#include <functional>
#include <string>

#include <boost/numeric/odeint/stepper/controlled_runge_kutta.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_dopri5.hpp>

#include "simulation/right_hand_side.hpp"

namespace gp2 {

/// Steps of Dormand & Prince's method 5(4), their error control, and the dense output of the last one.
class DormandPrince {
 public:
  using Function = std::function<void(const Phase& x, Phase& dxdt, double t)>;

  /// @param function  dxdt, @throws StageFault where there is none
  DormandPrince(Function function, double absolute_tolerance, double relative_tolerance);

  /// Where the step starts, which may be changed between steps.
  [[nodiscard]] PhasePoint& start() { return start_; }
  [[nodiscard]] const PhasePoint& start() const { return start_; }
  [[nodiscard]] const PhasePoint& end() const { return end_; }

  /// The size of the first step in a motion that lasts no longer than `span`.
  double first_size(double span);
  /// The size of the next step.
  [[nodiscard]] double size() const { return size_; }
  void set_size(double size) { size_ = size; }

  /// Tries a step, to `limit` at most. @return whether its error is within the tolerances, so that it is one
  bool try_step(double limit);
  /// Why the last try failed.
  [[nodiscard]] const std::string& fault() const { return fault_; }
  /// The step is to be tried again with another size.
  void take_again(double size);
  /// x within the step.
  [[nodiscard]] Phase at(double t) const;
  /// Whether the velocities of the step change at t far otherwise than the accelerations there say.
  [[nodiscard]] bool is_missed(const PhasePoint& at) const;
  /// Lets the step end within it; dxdt stays that of its end.
  void end_at(double t, const Phase& x);
  /// Starts from the end. @return the time that the step took
  double advance();

  [[nodiscard]] int accepted() const { return accepted_; }
  [[nodiscard]] int rejected() const { return rejected_; }

 private:
  using Stepper = boost::numeric::odeint::runge_kutta_dopri5<Phase>;
  using ErrorChecker = boost::numeric::odeint::default_error_checker<double, Stepper::algebra_type, Stepper::operations_type>;

  const Function function_;
  const double absolute_tolerance_, relative_tolerance_;
  boost::numeric::odeint::controlled_runge_kutta<Stepper, ErrorChecker> stepper_;
  PhasePoint start_, end_;
  double size_ = 0;
  std::string fault_;
  int accepted_ = 0, rejected_ = 0;
};

}  // namespace gp2
