#pragma once

#include <functional>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/simulate.hpp"

namespace gp2 {

/// A motion across the surfaces g(x) = 0 at which its acceleration jumps (Filippov 1988, Differential Equations with Discontinuous
/// Righthand Sides). On each side of a surface the acceleration f₊ or f₋ of that side holds, continued smoothly over the surface
/// until the motion is found to have crossed it. A motion that both sides drive onto the surface slides along it, as a body that
/// dry friction holds at rest does: by f₊ − ½ (1 − σ)(f₊ − f₋), with σ ∈ [−1, 1] such that ġ = 0. On n surfaces at a time it is
/// the mean of the accelerations of all 2ⁿ combinations of sides, weighed by Π ½ (1 ± σ_k) (Alexander & Seidman 1998, blending).
/// Where friction changes the loads that it is proportional to, each face σ_k = ±1 is Coulomb's limit of contact k exactly.
///
/// A surface of several functions g, as the velocities (v, w) of friction in a plane, is a point of their space. Beside it a state is
/// toward a direction d, |d| = 1, of which ±1 are those of one function. A motion that is held there is so by f_d and f₋d, mixed with σ,
/// along the d that leaves nothing across it. One that is let go creeps at first, faster at right angles to its way than any step
/// resolves: as long as it does, it moves in the direction in which it is accelerated.
class Switching {
 public:
  using Function = std::function<Eigen::VectorXd(const Eigen::Ref<const Eigen::VectorXd>& state)>;

  /// @param tolerance  of velocities: a part of it is how far from a surface its sides are evaluated
  Switching(const SwitchingFunctions& functions, Eigen::VectorXd parameters, StateLayout layout, double tolerance);

  /// T at a state: velocities change within what the constraints allow. Changed in any way and put back onto the constraints
  /// they would be no more where they were wanted: near a dead centre hardly moved at all.
  void move_along(std::function<Eigen::MatrixXd(const Eigen::VectorXd& state)> tangent) { tangent_ = std::move(tangent); }
  /// States beside a surface are put onto the constraints too: of redundant rows b means nothing off them, at rest least of all.
  void put_onto(std::function<void(Eigen::VectorXd& state)> constraints) { constraints_ = std::move(constraints); }

  [[nodiscard]] int size() const { return functions_.size(); }
  [[nodiscard]] bool is_empty() const { return size() == 0; }
  [[nodiscard]] bool is_sliding() const;
  /// Whether the motion slides on a surface, or creeps from one.
  [[nodiscard]] bool is_guided() const;

  /// Takes the sides that a state is on, and the surfaces that it is on.
  void take_sides(const Eigen::VectorXd& state);
  /// The same; on a surface it slides or leaves.
  void start(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// Whether a state is past a surface, which is then no more on the side taken.
  [[nodiscard]] bool has_crossed(const Eigen::VectorXd& state) const;
  /// Takes the surfaces that a state is past as those it slides on, until settle() decides. What is fast creeps no more.
  void cross(const Eigen::VectorXd& state);
  /// Takes the directions beside surfaces that a state has.
  void turn(const Eigen::VectorXd& state);
  /// Moves velocities by the least change onto the surfaces that the motion slides on, and into the directions that it creeps in.
  void put(Eigen::VectorXd& state) const;
  /// Whether one of the surfaces slid on does not hold the motion.
  bool is_let_go(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// How far each surface is from letting the motion go, 1 − |σ|; 1 of those not slid on.
  Eigen::VectorXd margins(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// Leaves the surfaces that do not hold the motion any more.
  void settle(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// Whether the motion slides on a surface.
  [[nodiscard]] bool is_held(int surface) const { return hold(surface) == Hold::rest; }

  /// ddq on the sides taken, and on the surfaces that the motion slides on.
  Eigen::VectorXd acceleration(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// The same on the sides that a state is on, whatever it was on before: an impact may have changed them.
  Eigen::VectorXd acceleration_anew(const Eigen::VectorXd& state, const Acceleration& acceleration);
  /// Another function of the state, mixed as the last acceleration was.
  [[nodiscard]] Eigen::VectorXd mixed(const Eigen::VectorXd& state, const Function& function) const;

 private:
  enum class Hold { none /* beside it */, rest /* on it */, direction /* beside it, along its acceleration */ };
  struct Surfaces {
    Eigen::VectorXd g;        // of all surfaces
    Eigen::MatrixXd normals;  // ∂g/∂dq  (· × nq)
    Eigen::VectorXd drift;    // ∂g/∂q dq + ∂g/∂t
    Eigen::VectorXd margin;   // |g| of a state that is beside each
  };
  [[nodiscard]] Surfaces surfaces_at(const Eigen::VectorXd& state) const;
  [[nodiscard]] Eigen::VectorXd beside(Eigen::VectorXd state, const Surfaces& surfaces, const Eigen::VectorXd& toward) const;
  [[nodiscard]] bool has_crossed(const Surfaces& surfaces, int surface) const;
  /// What a function is on the sides of the surfaces that the motion slides on.
  struct Values {
    Eigen::VectorXd above;    // f₊, beyond all of them
    Eigen::MatrixXd jumps;    // ½ (f₊ − f₋) of each, above all others  (· × n)
    Eigen::MatrixXd corners;  // of every combination of sides, bit k set below surface k; empty where jumps add up  (· × 2ⁿ)
  };
  [[nodiscard]] Values evaluate(const Eigen::VectorXd& state, const Surfaces& surfaces, const Function& function) const;
  /// f for shares 1 − σ.
  static Eigen::VectorXd mixture(const Values& values, const Eigen::VectorXd& share);
  /// −∂f/∂(1 − σ).
  static Eigen::MatrixXd slopes(const Values& values, const Eigen::VectorXd& share);
  Eigen::VectorXd acceleration_along(const Surfaces& surfaces, const Values& values);
  /// Finds the surfaces slid on that are one along what the constraints allow, as those of two feet of a box that stands flat: no state
  /// is on different sides of them, so that they act as one.
  void unite(const Eigen::VectorXd& state, const Surfaces& surfaces);
  /// A search for directions: those there are, the last σd, its ġ, and ∂ġ/∂(σd).
  struct Turn {
    std::vector<Eigen::MatrixXd> ways;
    Eigen::VectorXd at, rate;
    Eigen::MatrixXd slope;
  };
  bool turn_along(const Eigen::VectorXd& state, const Surfaces& surfaces, const Values& values, const Eigen::VectorXd& ddq,
                  const Acceleration& acceleration, Turn& turn);
  std::vector<Eigen::MatrixXd> ways_out(const Eigen::VectorXd& state, const Surfaces& surfaces);
  /// The surfaces slid on, of united ones the first.
  [[nodiscard]] std::vector<int> sliding() const;
  /// The surfaces that are one with a first one, it among them.
  [[nodiscard]] std::vector<int> united_with(int first) const;
  [[nodiscard]] Hold hold(int surface) const { return hold_[static_cast<std::size_t>(surface)]; }
  Hold& hold(int surface) { return hold_[static_cast<std::size_t>(surface)]; }
  [[nodiscard]] int first_of(int surface) const { return functions_.first()[static_cast<std::size_t>(surface)]; }
  /// What belongs to the functions of one surface.
  template <typename Vector>
  auto part(Vector& of_functions, int surface) const {
    return of_functions.segment(first_of(surface), first_of(surface + 1) - first_of(surface));
  }
  auto columns(Eigen::MatrixXd& of_functions, int surface) const {
    return of_functions.middleCols(first_of(surface), first_of(surface + 1) - first_of(surface));
  }
  auto block(Eigen::MatrixXd& of_functions, int surface) const {
    return columns(of_functions, surface).middleRows(first_of(surface), first_of(surface + 1) - first_of(surface));
  }

  SwitchingFunctions functions_;
  Eigen::VectorXd parameters_;
  StateLayout layout_;
  double tolerance_;
  std::function<Eigen::MatrixXd(const Eigen::VectorXd&)> tangent_;
  std::function<void(Eigen::VectorXd&)> constraints_;
  std::vector<Hold> hold_;         // of each surface
  std::vector<int> first_united_;  // with each surface, itself where there is no other
  Eigen::VectorXd toward_;         // d of each surface, one after the other
  Eigen::VectorXd share_;          // 1 − σ of each surface slid on, within [0, 2]
  Eigen::VectorXd sigma_;          // beyond [−1, 1] where the surface does not hold the motion
};

}  // namespace gp2
