#include "simulation/controlled_motion.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <fmt/format.h>
#include <Eigen/QR>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

/// How far along a line, from 0 to 1, with its first two derivatives in the fraction x of its time.
struct Progress {
  double s = 0, ds = 0, dds = 0;
};

Progress progress(Model::Motion::Profile profile, double x) {
  if (profile == Model::Motion::Profile::smooth) {
    // the least jerk with rest at both ends: 10 x³ − 15 x⁴ + 6 x⁵
    return {x * x * x * (10 + x * (6 * x - 15)), 30 * x * x * (1 - x) * (1 - x), 60 * x * (1 - x) * (1 - 2 * x)};
  }
  // a quarter of the time gaining speed, a quarter losing it
  constexpr double ramp = 0.25, top_speed = 1 / (1 - ramp), gain = top_speed / ramp;
  if (x < ramp) return {gain * x * x / 2, gain * x, gain};
  if (x > 1 - ramp) return {1 - gain * (1 - x) * (1 - x) / 2, gain * (1 - x), -gain};
  return {top_speed * (x - ramp / 2), top_speed, 0};
}

/// y(q) of the task, its velocity, and what its acceleration is made of: ÿ = J ddq + bias.
struct TaskState {
  VectorXd y, dy, bias;
  MatrixXd J;
};

class Controller {
 public:
  Controller(const Model& model, const VectorXd& start, RandomStream& random)
      : model_(model), motion_(*model.motion), parameters_(model.system->parameter_values()), start_(start), random_(random) {
    std::vector<Expression> outputs;
    for (const Model::Motion::Target& target : motion_.targets) {
      outputs.insert(outputs.end(), target.row.residuals.begin(), target.row.residuals.end());
      outputs.push_back(-target.row.b);
      outputs.insert(outputs.end(), target.row.A.begin(), target.row.A.end());
    }
    task_ = Tape(outputs, model.symbols().state_and_parameters());
    from_ = to_ = task_at(start).y;
  }

  /// Inputs at a state whose t is that of the sample.
  VectorXd inputs(const VectorXd& state) {
    const System& system = *model_.system;
    const StateLayout layout = system.layout();
    const int nq = layout.nq, nu = layout.nu;
    const TaskState task = task_at(state);
    const double omega = motion_.natural_frequency, zeta = motion_.damping_ratio;

    // where the task should be
    const double t = state[layout.t()];
    if (t >= begin_ + duration_) next_line(t);
    const Progress along = progress(motion_.profile, (t - begin_) / duration_);
    const VectorXd line = to_ - from_;
    const VectorXd position_error = from_ + along.s * line - task.y, velocity_error = along.ds / duration_ * line - task.dy;
    const VectorXd wanted =
        along.dds / (duration_ * duration_) * line + 2 * zeta * omega * velocity_error + omega * omega * position_error;

    // states with no input and with each alone: F is affine in u
    MatrixXd states = state.replicate(1, 1 + nu);
    states.bottomRows(nu).setZero();
    for (int k = 0; k < nu; ++k) states(layout.u(k), 1 + k) = 1;
    const SystemValues values = system.evaluate(states, parameters_);
    const VectorXd F = values.F(0);

    // the acceleration
    const int nc = system.nc();
    MatrixXd rows(nc + task.J.rows(), nq);
    rows << values.A(0), task.J;
    VectorXd right(nc + task.J.rows());
    right << values.b(0), wanted - task.bias;
    const double omega0 = omega / 10;
    const VectorXd posture = -2 * zeta * omega0 * state.segment(nq, nq) - omega0 * omega0 * (state - start_).head(nq);
    const VectorXd ddq = UdwadiaKalaba(values.M(0), rows, right).constrain(posture);

    // what it takes
    MatrixXd acting(nq, nu + nc);
    for (int k = 0; k < nu; ++k) acting.col(k) = values.F(1 + k) - F;
    acting.rightCols(nc) = values.A(0).transpose();
    const VectorXd solution = acting.completeOrthogonalDecomposition().solve(values.M(0) * ddq - F);
    return solution.head(nu);
  }

 private:
  [[nodiscard]] TaskState task_at(const VectorXd& state) const {
    MatrixXd values;
    task_.evaluate(state, parameters_, values);
    const auto n = static_cast<Index>(motion_.targets.size());
    const MatrixXd columns = values.reshaped(values.size() / n, n);
    return {columns.row(0), columns.row(1), columns.row(2), columns.bottomRows(columns.rows() - 3).transpose()};
  }

  void next_line(double t) {
    begin_ = t;
    duration_ = motion_.segment.first + random_.uniform() * (motion_.segment.second - motion_.segment.first);
    from_ = to_;
    for (std::size_t k = 0; k < motion_.targets.size(); ++k) {
      const auto& range = motion_.targets[k].range;
      if (range) to_[static_cast<Index>(k)] = range->first + random_.uniform() * (range->second - range->first);
    }
  }

  const Model& model_;
  const Model::Motion& motion_;
  VectorXd parameters_, start_;
  RandomStream& random_;
  Tape task_;
  VectorXd from_, to_;
  double begin_ = 0, duration_ = 0;
};

VectorXd start_of(const Model& model) {
  const System& system = *model.system;
  const std::vector<std::string> names = system.state_names();
  VectorXd state = VectorXd::Zero(system.layout().size());
  for (const int qw : quaternion_real_parts(model)) state[qw] = 1;
  for (int k = 0; k < 2 * system.nq(); ++k) {
    const auto start = model.motion->start.find(names[static_cast<std::size_t>(k)]);
    if (start != model.motion->start.end()) state[k] = start->second;
  }
  return project_onto_constraints(system, system.parameter_values(), state);
}

}  // namespace

std::vector<int> quaternion_real_parts(const Model& model) {
  std::vector<int> entries;
  int next = 0;
  for (const RobotDescription::Joint* joint :
       model.robot ? model.robot->joints() : std::vector<const RobotDescription::Joint*>()) {
    next += static_cast<int>(joint->coordinates().size());
    if (joint->has_quaternion()) entries.push_back(next - 4);
  }
  return entries;
}

DrivenMotion generate_motion(const Model& model, int n, RandomStream& random) {
  const System& system = *model.system;
  const StateLayout layout = system.layout();
  const VectorXd parameters = system.parameter_values();
  const Acceleration acceleration = model_acceleration(model);

  VectorXd state = start_of(model);
  Controller controller(model, state, random);
  SimulateOptions step;
  step.times.resize(2);
  step.switching = switching_functions(model, /*of_latents=*/false);
  step.initial_step = 1 / model.motion->rate;
  step.max_steps = 20'000;  // from one sample to the next
  step.max_steps_advice =
      "[truth] is stiff there, or the controller needs very large forces (a target that cannot be reached from this posture): "
      "choose other targets of [motion], longer segments, a higher rate, or a smoother [truth]";
  DrivenMotion motion{MatrixXd(layout.size(), n), MatrixXd(layout.nq, n)};
  for (int i = 0; i < n; ++i) {
    state[layout.t()] = i / model.motion->rate;
    state.tail(layout.nu) = controller.inputs(state);
    if (!state.allFinite())
      throw NumericalError(fmt::format("{}: [motion]: the inputs are not finite at sample {}", model.name, i + 1));
    motion.states.col(i) = state;
    step.times << state[layout.t()], (i + 1) / model.motion->rate;
    step.inputs = InputSignal(step.times, state.tail(layout.nu).replicate(1, 2));
    const Trajectory moved = simulate(system, parameters, acceleration, state, step);
    motion.accelerations.col(i) = moved.accelerations.col(0);
    state = moved.states.col(1);
  }
  return motion;
}

}  // namespace gp2
