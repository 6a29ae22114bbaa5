#pragma once

#include <algorithm>
#include <functional>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/simulate.hpp"

namespace gp2 {

/// The gap c of each contact among the residuals of the system, followed by ċ.
/// @throws InputError where a contact is of no position-level constraint, or its input is none.
std::vector<int> gap_residuals(const System& system, const std::vector<Contact>& contacts);

/// c of each contact at N states, whether they are open or closed (contacts × N).
Eigen::MatrixXd gaps_of(const System& system, const std::vector<Contact>& contacts, Eigen::MatrixXd states,
                        const Eigen::VectorXd& parameters);

/// Contacts that are made and released along a motion: which of them are closed, and what an impact makes of the velocities.
class Contacts {
 public:
  Contacts(const System& system, const Eigen::VectorXd& parameters, const SimulateOptions& options);

  [[nodiscard]] bool is_empty() const { return contacts_.empty(); }
  /// Writes to the inputs of a state which contacts are closed.
  void mark(Eigen::VectorXd& state) const { mark(state, is_closed_); }

  /// What impacts with friction make of the velocities.
  /// @param jump  Δdq that changes A dq of the active rows by r (nc), given a state and r; none: it is along M⁻¹Aᵀ
  using Jump = std::function<Eigen::VectorXd(const Eigen::VectorXd& state, const Eigen::VectorXd& r)>;
  void jump_by(Jump jump) { jump_ = std::move(jump); }

  /// Closes the contacts in which a motion starts. @throws InputError where it starts beyond a surface.
  void start(Eigen::VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events);
  /// Whether a contact that is open is past its surface and moves on.
  [[nodiscard]] bool is_hit(const Eigen::VectorXd& state) const;
  /// The rates of all gaps (n).
  [[nodiscard]] Eigen::VectorXd rates(const Eigen::VectorXd& state) const { return gaps_at(state).rate; }
  /// Whether a contact that is closed would open without its constraint.
  [[nodiscard]] bool is_released(const Eigen::VectorXd& state, const Acceleration& acceleration) const;
  /// How far each contact is from being released, −c̈ of the gap without its constraint; 1 of those that are open (n).
  [[nodiscard]] Eigen::VectorXd margins(const Eigen::VectorXd& state, const Acceleration& acceleration) const;
  [[nodiscard]] bool is_any_closed() const { return std::find(is_closed_.begin(), is_closed_.end(), true) != is_closed_.end(); }
  /// Impacts of the contacts that are hit, then releases.
  void settle(Eigen::VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events);

 private:
  struct Gaps {
    Eigen::VectorXd value, rate;  // c and ċ  (n)
    Eigen::VectorXd margin;       // |c| that rounding may make of 0  (n)
    Eigen::MatrixXd A;            // their rows of A ddq = b, active or not  (n × nq)
    Eigen::VectorXd b;            // (n)
  };
  [[nodiscard]] Gaps gaps_at(Eigen::VectorXd state) const;
  void mark(Eigen::VectorXd& state, const std::vector<bool>& closed) const;
  /// c̈ of a contact that is opened, all others as they are.
  [[nodiscard]] double opening(Eigen::VectorXd state, std::size_t contact, const Acceleration& acceleration) const;
  /// Takes the rates of the gaps in `hit` to −restitution times what they are, and gives the kinetic energy that this takes.
  double impact(Eigen::VectorXd& state, const std::vector<bool>& hit, const Eigen::VectorXd& restitution);
  /// Δdq that changes A dq of the active rows by r; none where nothing determines it.
  [[nodiscard]] std::optional<Eigen::VectorXd> jump(const Eigen::VectorXd& state, const Eigen::VectorXd& r) const;
  void release(Eigen::VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events);

  const System& system_;
  const Eigen::VectorXd& parameters_;
  const StateLayout layout_;
  std::vector<Contact> contacts_;
  std::vector<int> residuals_;  // gap_residuals
  double shortest_flight_;
  Jump jump_;
  std::vector<bool> is_closed_;
};

}  // namespace gp2
