#pragma once

#include <vector>

#include "simulation/right_hand_side.hpp"

namespace gp2 {

/// Changes the mode of a motion where a step ends, and what that makes of the state: impacts and releases of contacts, surfaces that are
/// crossed, stuck to or left, constraints that take hold.
class ModeChanges {
 public:
  ModeChanges(const ConstraintProjection& projection, RightHandSide& rhs, MotionMode& mode)
      : projection_(projection), rhs_(rhs), mode_(mode) {}

  /// The mode in which a motion starts. `now` gets its dxdt.
  void start(PhasePoint& now);
  /// The mode after a step, whose end is projected.
  /// @param has_left  whether the motion left its mode there
  void settle(PhasePoint& now, bool has_left);

  [[nodiscard]] const std::vector<ContactEvent>& events() const { return events_; }
  [[nodiscard]] const std::vector<StickEvent>& sticks() const { return sticks_; }

 private:
  void settle_contacts(PhasePoint& now, bool at_start);
  void settle_switching(const PhasePoint& now, bool anew);
  void put_on_surfaces(PhasePoint& now) const;
  bool project(PhasePoint& now);
  void note_sticks(const std::vector<bool>& before, double t);
  [[nodiscard]] std::vector<bool> held_surfaces() const;

  const ConstraintProjection& projection_;
  RightHandSide& rhs_;
  MotionMode& mode_;
  std::vector<ContactEvent> events_;
  std::vector<StickEvent> sticks_;
};

}  // namespace gp2
