#pragma once

#include <optional>
#include <span>
#include <vector>

#include "simulation/dormand_prince.hpp"

namespace gp2 {

/// Finds on the dense output of a step where a motion leaves its mode: where it has crossed a surface at which its acceleration jumps,
/// has hit a contact, or is let go by one of them, or where a constraint has come or gone.
class EventFinder {
 public:
  EventFinder(RightHandSide& rhs, MotionMode& mode) : rhs_(rhs), mode_(mode) {}

  struct Event {
    double t = 0;
    Phase x;
  };
  /// The first one in the step.
  /// @param written  the times in the step at which the motion is written
  std::optional<Event> find(const DormandPrince& step, std::span<const double> written);
  /// Whether a motion that is held may have been let go, and held again, within the step. What is held at rest has no error however long
  /// the step is, and forces of time may come and go in it.
  bool is_hold_unresolved(const DormandPrince& step, double smallest_step);
  /// Whether what holds the motion would not hold it there, by more than rounding.
  bool is_let_go_at(const PhasePoint& point);

 private:
  /// The motion at a time in the step.
  struct Place {
    Phase x;
    Eigen::VectorXd state;
    bool has_turned = false;  // under other constraints than at the start of the step
  };
  [[nodiscard]] Place place(const DormandPrince& step, double t) const;
  [[nodiscard]] std::vector<double> times_to_look_at(const DormandPrince& step, std::span<const double> written) const;
  bool has_left(const Place& at, bool may_be_let_go);
  bool is_let_go(Eigen::VectorXd state);
  [[nodiscard]] bool is_held() const { return mode_.switching.is_sliding() || mode_.contacts.is_any_closed(); }
  /// How far each contact and each surface is from letting the motion go.
  Eigen::VectorXd margins(const Eigen::VectorXd& state);
  [[nodiscard]] std::optional<double> find_dip(const DormandPrince& step, double start, double end) const;

  RightHandSide& rhs_;
  MotionMode& mode_;
};

}  // namespace gp2
