#include "simulation/recorder.hpp"

#include <algorithm>
#include <utility>

#include "base/shape.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

Recorder::Recorder(const SimulateOptions& options, StateLayout layout) : options_(options), layout_(layout) {
  const Index n = options.times.size();
  out_.times = options.times;
  out_.states.resize(layout.size(), n);
  out_.accelerations.resize(layout.nq, n);
  out_.commands.resize(layout.nu, n);
}

std::span<const double> Recorder::times_before(double end) const {
  const double *const first = options_.times.data() + next_, *const last = options_.times.data() + options_.times.size();
  return {first, std::lower_bound(first, last, end)};
}

void Recorder::write(const VectorXd& state, const PhasePoint& at, const VectorXd& recorded) {
  if (options_.record) {
    if (out_.records.size() == 0) out_.records.resize(recorded.size(), options_.times.size());
    require_shape("simulate: what is recorded", recorded, out_.records.rows(), 1);
    out_.records.col(next_) = recorded;
  }
  out_.times[next_] = at.t;
  out_.states.col(next_) = state;
  std::copy(at.dxdt.begin() + layout_.nq, at.dxdt.end(), out_.accelerations.col(next_).begin());
  options_.inputs.command(at.t, out_.commands.col(next_));
  for (const Contact& contact : options_.contacts) out_.commands(contact.input, next_) = state[layout_.u(contact.input)];
  ++next_;
}

Trajectory Recorder::take() {
  out_.times.conservativeResize(next_);
  out_.states.conservativeResize(Eigen::NoChange, next_);
  out_.accelerations.conservativeResize(Eigen::NoChange, next_);
  out_.commands.conservativeResize(Eigen::NoChange, next_);
  if (options_.record) out_.records.conservativeResize(Eigen::NoChange, next_);
  return std::move(out_);
}

}  // namespace gp2
