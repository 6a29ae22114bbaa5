#include "simulation/mode_changes.hpp"

#include <algorithm>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::VectorXd;

void ModeChanges::start(PhasePoint& now) {
  if (!mode_.contacts.is_empty()) settle_contacts(now, /*at_start=*/true);
  settle_switching(now, /*anew=*/true);
  rhs_.evaluate(now);
}

void ModeChanges::settle(PhasePoint& now, bool has_left) {
  Switching& switching = mode_.switching;
  const bool switches = !switching.is_empty() && (has_left || switching.is_guided());
  const std::vector<bool> was_held = held_surfaces();
  if (!switching.is_empty()) {
    if (switches) {
      switching.cross(rhs_.state(now.x, now.t));
      put_on_surfaces(now);
    }
    switching.turn(rhs_.state(now.x, now.t));
  }
  const std::size_t n_events = events_.size();
  if (has_left && !mode_.contacts.is_empty()) settle_contacts(now, /*at_start=*/false);
  const bool has_met = events_.size() > n_events;
  const bool has_stuck = has_met && !switching.is_empty();
  if (has_stuck) switching.take_sides(rhs_.state(now.x, now.t));
  const bool has_moved = project(now);
  // a contact that stays closed without a rebound stops the motion, but lets nothing slip
  if (has_stuck) put_on_surfaces(now);
  if (switches) {
    settle_switching(now, /*anew=*/has_met || (has_moved && mode_.conditions.has_turned()));
    note_sticks(was_held, now.t);
  }
  if (has_moved || switches || has_left) rhs_.evaluate(now);
}

// impacts and releases
void ModeChanges::settle_contacts(PhasePoint& now, bool at_start) {
  VectorXd state = rhs_.state(now.x, now.t);
  try {
    if (at_start) {
      mode_.contacts.start(state, rhs_.on_sides_anew(), events_);
    } else {
      mode_.contacts.settle(state, rhs_.on_sides_anew(), events_);
    }
  } catch (const InputError& error) {
    if (at_start) throw;
    throw NumericalError(fmt::format("simulate: at t = {:.6g}: {}", now.t, error.what()));
  } catch (const Error& error) {
    if (at_start) throw;
    rhs_.fail(now.t, error.what());
  }
  rhs_.project_stages(projection_.has_redundant_rows(state));
  std::copy_n(state.begin(), now.x.size(), now.x.begin());
  if (at_start) rhs_.project(now.x, now.t);
}

void ModeChanges::settle_switching(const PhasePoint& now, bool anew) {
  if (mode_.switching.is_empty()) return;
  VectorXd state = rhs_.state(now.x, now.t);
  try {
    rhs_.put_stage(state);
    if (anew) {
      mode_.switching.start(state, rhs_.counted());
    } else {
      mode_.switching.settle(state, rhs_.counted());
    }
  } catch (const Error& error) {
    rhs_.fail(now.t, error.what());
  }
}

void ModeChanges::put_on_surfaces(PhasePoint& now) const {
  VectorXd state = rhs_.state(now.x, now.t);
  mode_.switching.put(state);
  std::copy_n(state.begin(), now.x.size(), now.x.begin());
}

// whether the projection changed the state
bool ModeChanges::project(PhasePoint& now) {
  if (mode_.conditions.is_empty()) return rhs_.project(now.x, now.t);
  const VectorXd before = rhs_.state(now.x, now.t);
  mode_.conditions.turn(before);
  const bool has_moved = rhs_.project(now.x, now.t);
  mode_.conditions.move(before, rhs_.state(now.x, now.t));
  return has_moved;
}

// where the motion is on a surface now, and was beside it, or the other way round
void ModeChanges::note_sticks(const std::vector<bool>& before, double t) {
  const std::vector<bool> after = held_surfaces();
  for (std::size_t k = 0; k < after.size(); ++k) {
    if (before[k] != after[k]) sticks_.push_back({t, static_cast<int>(k), after[k]});
  }
}

std::vector<bool> ModeChanges::held_surfaces() const {
  std::vector<bool> out;
  for (int k = 0; k < mode_.switching.size(); ++k) out.push_back(mode_.switching.is_held(k));
  return out;
}

}  // namespace gp2
