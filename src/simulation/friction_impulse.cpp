#include "simulation/friction_impulse.hpp"

#include <algorithm>

#include "gp2/error.hpp"
#include "simulation/integration.hpp"

namespace gp2 {

using Eigen::Ref;
using Eigen::VectorXd;

VectorXd friction_impulse(const System& system, const VectorXd& parameters, SimulateOptions options, const VectorXd& at,
                          const VectorXd& r, int& evaluations) {
  constexpr double duration = 1e-12, same = 1e-6;
  const StateLayout layout = system.layout();
  if (r.isZero(0)) return VectorXd::Zero(layout.nq);
  const double large = 1e3 / duration / r.norm();
  const auto between = [&](double less, double more) -> Acceleration {
    return [below = options.pushed(less * r), above = options.pushed(more * r), scale = duration * (more - less)](
               const Ref<const VectorXd>& state) -> VectorXd { return (above(state) - below(state)) / scale; };
  };
  const Acceleration impulse = between(large, 2 * large);
  const VectorXd ddq = impulse(at);
  if (!((ddq - between(2 * large, 4 * large)(at)).norm() <= same * ddq.norm())) {
    throw NumericalError("the friction of an impact grows faster than its load, so that its impulse is not finite");
  }
  options.times = Eigen::Vector2d(0, duration);
  options.relative_tolerance = std::min(options.relative_tolerance, 1e-9);
  options.project = false;
  options.contacts.clear();
  options.record = {};
  options.initial_step = 0;
  try {
    const Trajectory velocities = integrate_velocities(system, parameters, impulse, at, options);
    evaluations += 2 * velocities.evaluations;
    return velocities.states.col(1).segment(layout.dq(0), layout.nq) - at.segment(layout.dq(0), layout.nq);
  } catch (const UnfinishedMotion& unfinished) {
    throw NumericalError(unfinished.what());
  }
}

}  // namespace gp2
