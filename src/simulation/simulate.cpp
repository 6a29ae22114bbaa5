#include "gp2/simulate.hpp"

#include <chrono>
#include <cmath>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "simulation/friction_impulse.hpp"
#include "simulation/integration.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

void require_options(const SimulateOptions& options, const System& system) {
  const VectorXd& times = options.times;
  if (times.size() < 2)
    throw InputError(fmt::format("simulate: at least two times are needed, the start and the end, got {}", times.size()));
  if (!times.allFinite()) throw InputError("simulate: a time is not a finite number");
  for (Index k = 1; k < times.size(); ++k) {
    if (times[k] > times[k - 1]) continue;
    throw InputError(fmt::format("simulate: times must increase, but {} follows {}", times[k], times[k - 1]));
  }
  const auto require_positive = [](const char* what, double value) {
    if (!(value > 0) || !std::isfinite(value))
      throw InputError(fmt::format("simulate: {} must be positive, got {}", what, value));
  };
  require_positive("the relative tolerance", options.relative_tolerance);
  if (options.relative_tolerance < least_relative_tolerance) {
    throw InputError(fmt::format("simulate: the relative tolerance must be at least {}, near the rounding of doubles, got {}",
                                 least_relative_tolerance, options.relative_tolerance));
  }
  require_positive("the absolute tolerance", options.absolute_tolerance);
  if (!(options.initial_step >= 0) || !std::isfinite(options.initial_step)) {
    throw InputError(fmt::format("simulate: the initial step must not be negative, got {}", options.initial_step));
  }
  if (!options.contacts.empty()) require_positive("the shortest flight", options.shortest_flight);
  if (options.max_steps < 1) throw InputError(fmt::format("simulate: max_steps must be at least 1, got {}", options.max_steps));
  if (!options.inputs.is_zero() && options.inputs.size() != system.layout().nu) {
    throw InputError(fmt::format("simulate: the table of inputs has {} rows, the system {} inputs", options.inputs.size(),
                                 system.layout().nu));
  }
}

}  // namespace

Trajectory simulate(const System& system, const VectorXd& parameters, const Acceleration& acceleration,
                    const Ref<const VectorXd>& start, const SimulateOptions& options) {
  const auto clock_start = std::chrono::steady_clock::now();
  const StateLayout layout = system.layout();
  if (parameters.size() != static_cast<Index>(system.parameters().size())) {
    throw InputError(
        fmt::format("simulate: '{}' has {} parameters, got {}", system.name(), system.parameters().size(), parameters.size()));
  }
  if (start.size() != layout.size() || !start.head(2 * layout.nq).allFinite()) {
    throw InputError(
        fmt::format("simulate: the start must be a state of {} entries, coordinates and velocities finite", layout.size()));
  }
  require_options(options, system);

  const ConstraintProjection projection(system, parameters);
  VectorXd state = start;
  state[layout.t()] = options.times[0];
  options.inputs.evaluate(options.times[0], state.tail(layout.nu));
  const double position_residual = projection.largest_residual(state, false);
  const double velocity_residual = projection.largest_residual(state, true);
  if (options.project) projection.apply(state);
  int evaluations_of_impacts = 0;
  Contacts::Jump jump;
  if (options.pushed) {
    jump = [&](const VectorXd& at, const VectorXd& r) {
      return friction_impulse(system, parameters, options, at, r, evaluations_of_impacts);
    };
  }

  const auto report = [&](Trajectory& out) {
    out.evaluations += evaluations_of_impacts;
    out.start_position_residual = position_residual;
    out.start_velocity_residual = velocity_residual;
    out.start_displacement = (state - start).head(2 * layout.nq).lpNorm<Eigen::Infinity>();
    out.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - clock_start).count();
    if (out.times.size() == 0) return;
    out.max_position_drift = projection.largest_residual(out.states, false);
    out.max_velocity_drift = projection.largest_residual(out.states, true);
    out.lower_rank = states_of_lower_rank(system, out.states, parameters);
  };
  try {
    Trajectory out = integrate_motion(system, parameters, acceleration, state, options, jump);
    report(out);
    return out;
  } catch (UnfinishedMotion& unfinished) {
    report(unfinished.motions.front());
    throw;
  }
}

Acceleration model_acceleration(const Model& model) {
  return
      [motion = ModelMotion(model)](const Ref<const VectorXd>& state) -> VectorXd { return motion.acceleration(state).col(0); };
}

PushedAcceleration pushed_acceleration(const Model& model) {
  const ModelMotion motion(model);
  if (!motion.reads_load()) return {};
  return [motion](const VectorXd& push) -> Acceleration {
    return [pushed = motion.pushed(push)](const Ref<const VectorXd>& state) -> VectorXd {
      return pushed.acceleration(state).col(0);
    };
  };
}

PushedAcceleration pushed_acceleration(const Prior& prior, const View& view,
                                       std::function<MatrixXd(const View& view, const Ref<const MatrixXd>& states)> function) {
  if (!reads_loads(prior)) return {};
  return [prior, view, function = std::move(function)](const VectorXd& push) -> Acceleration {
    return [function, view = pushed(prior, view, push)](const Ref<const VectorXd>& state) -> VectorXd {
      return function(view, state).col(0);
    };
  };
}

VectorXd kinetic_energy(const System& system, const VectorXd& parameters, const Ref<const MatrixXd>& states) {
  VectorXd energy(states.cols());
  const SystemValues values = system.evaluate(states, parameters);
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const auto dq = states.col(i).segment(system.layout().dq(0), system.nq());
    energy[i] = 0.5 * dq.dot(values.M(i) * dq);
  }
  return energy;
}

VectorXd mechanical_energy(const Model& model, const VectorXd& parameters, const Ref<const MatrixXd>& states) {
  if (!model.potential) throw InputError(fmt::format("{}: no energy without [mechanics] potential = \"…\"", model.name));
  MatrixXd potential;
  Tape(std::span(&*model.potential, 1), model.symbols().state_and_parameters()).evaluate(states, parameters, potential);
  return kinetic_energy(*model.system, parameters, states) + potential.row(0).transpose();
}

}  // namespace gp2
