#include "simulation/conditional_constraints.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

std::vector<int> conditional_rows(const System& system, const std::vector<Contact>& contacts) {
  std::vector<int> rows;
  for (int row = 0; row < system.nc(); ++row) {
    const bool is_contact = std::ranges::any_of(contacts, [&](const Contact& one) { return one.row == row; });
    if (system.is_conditional(row) && !is_contact) rows.push_back(row);
  }
  return rows;
}

ConditionalConstraints::ConditionalConstraints(const System& system, const VectorXd& parameters, std::vector<int> rows)
    : system_(system), parameters_(parameters), rows_(std::move(rows)) {}

std::vector<bool> ConditionalConstraints::active_at(const VectorXd& state) const {
  std::vector<bool> active;
  const SystemValues values = system_.evaluate(state, parameters_);
  for (const int row : rows_) active.push_back(!values.A(0).row(row).isZero(0));
  return active;
}

void ConditionalConstraints::start(const VectorXd& state) {
  if (is_empty()) return;
  note_extent(state);
  is_active_ = active_at(state);
}

void ConditionalConstraints::turn(const VectorXd& state) {
  const std::vector<bool> was_active = std::exchange(is_active_, active_at(state));
  has_turned_ = is_active_ != was_active;
  takes_hold_ = false;
  for (std::size_t k = 0; k < is_active_.size(); ++k) takes_hold_ = takes_hold_ || (is_active_[k] && !was_active[k]);
}

void ConditionalConstraints::move(const VectorXd& before, const VectorXd& after) {
  constexpr double much = 1e-3;  // of the way that a coordinate has come
  note_extent(after);
  if (after == before) return;
  is_active_ = active_at(after);
  for (Index j = 0; takes_hold_ && j < lowest_.size(); ++j) {
    const double jump = std::abs(after[j] - before[j]);
    if (jump <= std::max(largest_jump_, much * (highest_[j] - lowest_[j]))) continue;
    largest_jump_ = jump;
    jump_time_ = after[system_.layout().t()];
  }
}

void ConditionalConstraints::count_turns(bool is_at_once) {
  const bool is_one_more = has_turned_ && (!end_steps() || is_at_once);
  const int change = is_one_more ? 1 : is_at_once ? 0 : -1;
  turns_at_once_ = std::clamp(turns_at_once_ + change, 0, most_turns_at_once());
}

void ConditionalConstraints::note_extent(const VectorXd& state) {
  const auto q = state.head(system_.nq());
  lowest_ = lowest_.size() == 0 ? VectorXd(q) : VectorXd(lowest_.cwiseMin(q));
  highest_ = highest_.size() == 0 ? VectorXd(q) : VectorXd(highest_.cwiseMax(q));
}

}  // namespace gp2
