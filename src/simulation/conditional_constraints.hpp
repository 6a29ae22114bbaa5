#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/simulate.hpp"

namespace gp2 {

/// Rows of A that come and go by themselves (`when`), not as contacts.
std::vector<int> conditional_rows(const System& system, const std::vector<Contact>& contacts);

/// Constraints that come and go along a motion by conditions of its state: which of them are there.
class ConditionalConstraints {
 public:
  /// @param rows  of A
  ConditionalConstraints(const System& system, const Eigen::VectorXd& parameters, std::vector<int> rows);

  [[nodiscard]] bool is_empty() const { return rows_.empty(); }
  /// Takes those that are there where a motion starts.
  void start(const Eigen::VectorXd& state);
  /// Whether other ones are there at a state.
  [[nodiscard]] bool have_turned(const Eigen::VectorXd& state) const { return active_at(state) != is_active_; }
  /// Takes those that are there at a state at which a step ends.
  void turn(const Eigen::VectorXd& state);
  /// Whether one came or went then.
  [[nodiscard]] bool has_turned() const { return has_turned_; }
  /// A state at which a step ended is put onto the constraints: by one that takes hold off its surface a body is moved there at once.
  /// That may undo its condition: the motion goes on under those that are there afterwards.
  void move(const Eigen::VectorXd& before, const Eigen::VectorXd& after);

  /// Whether steps end where a constraint comes or goes. One that turns again and again within no time, as it does at the very edge of
  /// its condition, would hold the motion up: then a step is taken across all that.
  [[nodiscard]] bool end_steps() const { return turns_at_once_ < most_turns_at_once(); }
  /// @param is_at_once  whether the step that has ended took no time
  void count_turns(bool is_at_once);

  /// The largest change of a coordinate by a constraint that took hold, as the trajectory reports it, and its time.
  [[nodiscard]] double largest_jump() const { return largest_jump_; }
  [[nodiscard]] double jump_time() const { return jump_time_; }

 private:
  [[nodiscard]] std::vector<bool> active_at(const Eigen::VectorXd& state) const;
  [[nodiscard]] int most_turns_at_once() const { return 10 * static_cast<int>(rows_.size()); }
  void note_extent(const Eigen::VectorXd& state);

  const System& system_;
  const Eigen::VectorXd& parameters_;
  const std::vector<int> rows_;
  std::vector<bool> is_active_;                   // of each row
  bool has_turned_ = false, takes_hold_ = false;  // where the last step ended
  int turns_at_once_ = 0;                         // one after the other, up to now
  Eigen::VectorXd lowest_, highest_;              // coordinates up to now
  double largest_jump_ = 0, jump_time_ = 0;
};

}  // namespace gp2
