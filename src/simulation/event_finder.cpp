#include "simulation/event_finder.hpp"

#include <algorithm>
#include <numeric>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

EventFinder::Place EventFinder::place(const DormandPrince& step, double t) const {
  Place out{step.at(t), {}};
  out.state = rhs_.state(out.x, t);
  out.has_turned = mode_.conditions.end_steps() && mode_.conditions.have_turned(out.state);
  // a contact that is released leaves at rate 0, not at what interpolation makes of it
  if (!out.has_turned && !mode_.contacts.is_empty() && rhs_.project(out.x, t)) out.state = rhs_.state(out.x, t);
  return out;
}

bool EventFinder::has_left(const Place& at, bool may_be_let_go) {
  return at.has_turned || (!mode_.switching.is_empty() && mode_.switching.has_crossed(at.state)) ||
         (!mode_.contacts.is_empty() && mode_.contacts.is_hit(at.state)) || (may_be_let_go && is_let_go(at.state));
}

// whether a surface that the motion slides on, or a contact, does not hold it
bool EventFinder::is_let_go(VectorXd state) {
  Switching& switching = mode_.switching;
  if (!switching.is_sliding() && mode_.contacts.is_empty()) return false;
  try {
    rhs_.put_stage(state);
    if (mode_.contacts.is_released(state, rhs_.on_its_sides())) return true;
    return switching.is_sliding() && switching.is_let_go(state, rhs_.counted());
  } catch (const Error&) {
    return false;
  }
}

// Where constraints come and go the written times are among them, so that what is written is under the constraints that the motion is
// under.
std::vector<double> EventFinder::times_to_look_at(const DormandPrince& step, std::span<const double> written) const {
  constexpr int parts = 8;
  const double start = step.start().t, end = step.end().t;
  std::vector<double> out;
  for (int k = 1; k < parts; ++k) out.push_back(start + (end - start) * k / parts);
  if (mode_.conditions.end_steps()) {
    out.insert(out.end(), written.begin(), written.end());
    std::sort(out.begin(), out.end());
  }
  out.push_back(end);
  return out;
}

std::optional<EventFinder::Event> EventFinder::find(const DormandPrince& step, std::span<const double> written) {
  if (mode_.switching.is_empty() && mode_.contacts.is_empty() && !mode_.conditions.end_steps()) return std::nullopt;
  double before = step.start().t, after = before;
  const std::vector<double> times = times_to_look_at(step, written);
  for (std::size_t k = 0; k < times.size(); ++k) {
    const bool is_end = k + 1 == times.size();
    const double start = after;
    before = is_end ? step.start().t : start;  // whether the motion is let go is asked at the end alone
    after = times[k];
    if (has_left(place(step, after), is_end)) break;
    if (const std::optional<double> dip = find_dip(step, start, after)) {
      before = start;
      after = *dip;
      break;
    }
    if (is_end) return std::nullopt;
  }
  for (double middle = std::midpoint(before, after); before < middle && middle < after; middle = std::midpoint(before, after)) {
    (has_left(place(step, middle), true) ? after : before) = middle;
  }
  Place at = place(step, after);
  has_left(at, true);  // the mixture of the sides that hold the motion goes on from there
  return Event{after, std::move(at.x)};
}

// A time between two at which a gap that opens again is past its surface, where it is least.
std::optional<double> EventFinder::find_dip(const DormandPrince& step, double start, double end) const {
  if (mode_.contacts.is_empty()) return std::nullopt;
  const auto rates_at = [&](double t) { return mode_.contacts.rates(place(step, t).state); };
  const VectorXd at_start = rates_at(start), at_end = rates_at(end);
  for (Index k = 0; k < at_start.size(); ++k) {
    if (!(at_start[k] < 0 && at_end[k] > 0)) continue;
    double before = start, after = end;
    for (double middle = std::midpoint(before, after); before < middle && middle < after; middle = std::midpoint(before, after)) {
      (rates_at(middle)[k] < 0 ? before : after) = middle;
    }
    if (mode_.contacts.is_hit(place(step, before).state)) return before;
  }
  return std::nullopt;
}

VectorXd EventFinder::margins(const VectorXd& state) {
  const VectorXd of_contacts = mode_.contacts.margins(state, rhs_.on_its_sides());
  const VectorXd of_surfaces = mode_.switching.margins(state, rhs_.counted());
  VectorXd out(of_contacts.size() + of_surfaces.size());
  out << of_contacts, of_surfaces;
  return out;
}

bool EventFinder::is_let_go_at(const PhasePoint& point) {
  constexpr double rounding = 1e-9;
  try {
    return is_held() && (margins(rhs_.projected_state(point.x, point.t)).array() < -rounding).any();
  } catch (const Error&) {
    return false;
  }
}

// The margins of what holds the motion are looked at at both ends and between.
bool EventFinder::is_hold_unresolved(const DormandPrince& step, double smallest_step) {
  constexpr double rounding = 1e-6, shortest = 1e3;
  const double t = step.start().t, t_new = step.end().t;
  if (!is_held()) return false;
  if (t_new - t <= shortest * smallest_step) return false;
  const auto margins_at = [&](double time) { return margins(rhs_.projected_state(step.at(time), time)); };
  try {
    const VectorXd start = margins_at(t), middle = margins_at(std::midpoint(t, t_new)), end = margins_at(t_new);
    const VectorXd bend = (middle - (start + end) / 2).cwiseAbs(), least = start.cwiseMin(middle).cwiseMin(end);
    const VectorXd size = start.cwiseAbs().cwiseMax(middle.cwiseAbs()).cwiseMax(end.cwiseAbs());
    return (bend.array() > rounding * size.array() && least.array() < 2 * bend.array()).any();
  } catch (const Error&) {
    return false;
  }
}

}  // namespace gp2
