#include "simulation/right_hand_side.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Ref;
using Eigen::VectorXd;

RightHandSide::RightHandSide(StateLayout layout, const Acceleration& acceleration, const SimulateOptions& options,
                             const ConstraintProjection& projection, MotionMode& mode, std::optional<VectorXd> instant)
    : layout_(layout),
      acceleration_(acceleration),
      options_(options),
      projection_(projection),
      mode_(mode),
      instant_(std::move(instant)) {}

VectorXd RightHandSide::state(const Phase& x, double t) const {
  if (instant_) {
    VectorXd state = *instant_;
    std::copy(x.begin() + layout_.nq, x.end(), state.begin() + layout_.dq(0));
    return state;
  }
  VectorXd state(layout_.size());
  std::copy(x.begin(), x.end(), state.begin());
  state[layout_.t()] = t;
  options_.inputs.evaluate(t, state.tail(layout_.nu));
  mode_.contacts.mark(state);
  return state;
}

VectorXd RightHandSide::projected_state(const Phase& x, double t) const {
  VectorXd out = state(x, t);
  if (options_.project || projects_stages_) projection_.apply(out);
  return out;
}

bool RightHandSide::project(Phase& x, double t) const {
  if (!options_.project) return false;
  VectorXd projected = state(x, t);
  if (!projection_.apply(projected)) return false;
  std::copy_n(projected.begin(), x.size(), x.begin());
  return true;
}

void RightHandSide::put_stage(VectorXd& state) const {
  if (projects_stages_) projection_.apply(state);
}

Acceleration RightHandSide::counted() {
  return [this](const Ref<const VectorXd>& state) -> VectorXd {
    VectorXd ddq = acceleration_(state);
    ++evaluations_;
    if (ddq.size() != layout_.nq) throw WrongSize{ddq.size()};
    return ddq;
  };
}

Acceleration RightHandSide::on_its_sides() {
  if (mode_.switching.is_empty()) return counted();
  return [this](const Ref<const VectorXd>& state) -> VectorXd { return mode_.switching.acceleration(state, counted()); };
}

Acceleration RightHandSide::on_sides_anew() {
  if (mode_.switching.is_empty()) return counted();
  return [this](const Ref<const VectorXd>& state) -> VectorXd { return mode_.switching.acceleration_anew(state, counted()); };
}

void RightHandSide::operator()(const Phase& x, Phase& dxdt, double t) {
  if (!std::all_of(x.begin(), x.end(), [](double entry) { return std::isfinite(entry); }))
    throw StageFault{"the state is not finite"};
  VectorXd at = state(x, t), ddq;
  try {
    put_stage(at);
    ddq = on_its_sides()(at);
  } catch (const Error& error) {
    throw StageFault{error.what()};
  }
  if (!ddq.allFinite()) throw StageFault{"the acceleration is not a finite number"};
  std::copy_n(x.begin() + layout_.nq, layout_.nq, dxdt.begin());
  std::copy(ddq.begin(), ddq.end(), dxdt.begin() + layout_.nq);
}

void RightHandSide::evaluate(PhasePoint& at) {
  at.dxdt.resize(at.x.size());
  try {
    (*this)(at.x, at.dxdt, at.t);
  } catch (const StageFault& fault) {
    fail(at.t, fault.text);
  }
}

void RightHandSide::fail(double t, const std::string& text) const {
  if (instant_) throw NumericalError(text);
  throw NumericalError(fmt::format("simulate: no acceleration at t = {:.6g}: {}", t, text));
}

}  // namespace gp2
