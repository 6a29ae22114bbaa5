#include "jobs/rollout.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "jobs/shooting_log.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

struct RolloutLimits {
  static constexpr Index least_rows = 8, most_rows = 400;  // of the picture
  static constexpr int n_samples = 16;
  // of one motion, by one component of a mixture or by many: a report is to take seconds
  static constexpr int most_steps = 3000, least_steps = 1000;
  static constexpr double window = 30;  // of rms displacement / rms velocity: five oscillations of the slowest coordinate
  // of the measured range: below it is the noise of a start, above it what an eye sees
  static constexpr double visible_share = 0.05;
};

// Entries of the state that a motion needs and the data lack.
std::vector<std::string> missing_entries(const Model& model, const MatrixXd& states) {
  const StateLayout layout = model.system->layout();
  const std::vector<std::string> names = model.system->state_names(), driving = driving_inputs(model);
  std::vector<std::string> missing;
  for (int k = 0; k < layout.size(); ++k) {
    const std::string& name = names[static_cast<std::size_t>(k)];
    const bool is_needed = k <= layout.t() || std::ranges::count(driving, name) > 0;
    if (is_needed && !states.row(k).allFinite()) missing.push_back(name);
  }
  return missing;
}

// How much of a part is simulated: errors of a start grow, and of more oscillations a picture shows nothing.
Index rows_to_follow(const System& system, const Eigen::Ref<const MatrixXd>& states) {
  double duration = 0;
  for (int j = 0; j < system.nq(); ++j) {
    const double speed = std::sqrt(states.row(system.layout().dq(j)).squaredNorm() / static_cast<double>(states.cols()));
    if (speed > 0) duration = std::max(duration, RolloutLimits::window * row_stddev(states.row(system.layout().q(j)))[0] / speed);
  }
  const auto times = states.row(system.layout().t());
  const Index rows = std::upper_bound(times.begin(), times.end(), times[0] + duration) - times.begin();
  return std::clamp(rows, std::min<Index>(RolloutLimits::least_rows, states.cols()), states.cols());
}

// An angle that a sensor wraps goes on.
void unwrap(Eigen::Ref<Eigen::RowVectorXd, 0, Eigen::InnerStride<>> angles) {
  double last = angles[0], whole = 0;
  for (Index i = 1; i < angles.size(); ++i) {
    const double step = angles[i] - last;
    last = angles[i];
    whole += std::remainder(step, 2 * std::numbers::pi) - step;
    angles[i] += whole;
  }
}

// A motion at all times, NaN beyond what it reached; empty where it did not begin.
struct Reached {
  MatrixXd states, multipliers;
  int steps = 0;
  std::string ended;
};
Reached follow(SimulateJob job, std::size_t motion) {
  job.motions = {job.motions[motion]};
  const auto placed = [&](const MatrixXd& values) {
    MatrixXd all = MatrixXd::Constant(values.rows(), job.options.times.size(), not_a_number);
    all.leftCols(values.cols()) = values;
    return all;
  };
  // an unfinished motion also holds the state at which it stopped, which is at none of the times
  const auto reached = [&](const Trajectory& one, const std::string& ended) -> Reached {
    Index n = 0;
    while (n < one.times.size() && n < job.options.times.size() && one.times[n] == job.options.times[n]) ++n;
    return {placed(one.states.leftCols(n)), placed(one.records.leftCols(std::min(n, one.records.cols()))),
            one.steps + one.rejected_steps, ended};
  };
  try {
    return reached(run_simulation(job).front(), "");
  } catch (const UnfinishedMotion& unfinished) {
    return reached(unfinished.motions.front(), unfinished.what());
  }
}

// Of a robot without [drawing]: its bodies, its sites and where loops close, each with a line from the bodies that carry it.
std::optional<Model::Drawing> drawing_of(const Model& model) {
  if (model.drawing || !model.robot) return model.drawing;
  const RobotDescription& robot = *model.robot;
  Model::Drawing drawing;
  const auto add = [&](const std::string& name, const std::string& symbol, std::initializer_list<int> carriers) {
    for (const int body : carriers) {
      if (body >= 0) drawing.lines.push_back({body, static_cast<int>(drawing.points.size())});
    }
    drawing.names.push_back(name);
    drawing.points.emplace_back();
    for (const char axis : {'x', 'y', 'z'}) drawing.points.back().push_back(model.expression(fmt::format("{}.{}", symbol, axis)));
  };
  for (const RobotDescription::Body& body : robot.bodies) add(body.name, fmt::format("body(\"{}\")", body.name), {body.parent});
  for (const RobotDescription::Site& site : robot.sites) add(site.name, fmt::format("site(\"{}\")", site.name), {site.body});
  for (const RobotDescription::Connect& joint : robot.connects) {
    const std::size_t of = joint.bodies[0] >= 0 ? 0 : 1;
    const std::string& body = robot.bodies[static_cast<std::size_t>(joint.bodies[of])].name;
    add(joint.name, fmt::format("point(\"{}\", {})", body, fmt::join(joint.anchors[of], ", ")),
        {joint.bodies[0], joint.bodies[1]});
  }
  return drawing;
}

class Roll {
 public:
  Roll(const FitSystem& asked, const Posterior& posterior)
      : asked_(asked), posterior_(posterior), system_(*asked.model->system) {}

  void run(const MatrixXd& states, const std::vector<std::string>& episodes, Rollout& out) {
    const StateLayout layout = system_.layout();
    const VectorXd& fitted = posterior_.values().parameters;
    const VectorXd parameters = asked_.other_system ? asked_.other_system->parameters(fitted) : fitted;
    if (const std::vector<std::string> missing = missing_entries(*asked_.model, states); !missing.empty()) {
      out.reason = fmt::format("the data lack {}", fmt::join(missing, ", "));
      return;
    }
    const std::vector<UnbrokenRows> parts = unbroken_parts(states.row(layout.t()).transpose(), [&](Index i) {
      return episodes.empty() || episodes[static_cast<std::size_t>(i)] == episodes[static_cast<std::size_t>(i - 1)];
    });
    const auto longest = std::ranges::max_element(parts, {}, &UnbrokenRows::n);
    if (longest == parts.end() || longest->n < RolloutLimits::least_rows) {
      out.reason = fmt::format("the rows are no motion: no {} of them follow each other in time without a break",
                               RolloutLimits::least_rows);
      return;
    }
    const MatrixXd whole = states.middleCols(longest->first, longest->n);
    const MatrixXd followed = whole.leftCols(rows_to_follow(system_, whole));
    const Index stride = (followed.cols() + RolloutLimits::most_rows - 1) / RolloutLimits::most_rows;
    const MatrixXd measured = followed(Eigen::all, Eigen::seqN(0, (followed.cols() - 1) / stride + 1, stride));
    out.times = measured.row(layout.t()).transpose();
    out.measured = measured.topRows(layout.nq);
    for (int j = 0; j < layout.nq; ++j) {
      if (system_.coordinates()[static_cast<std::size_t>(j)].angle) unwrap(out.measured.row(j));
    }
    simulate_beside(measured, followed, out);
    if (!out.reason.empty()) return;
    find_horizon(out);
    add_forces(measured, out);
    add_energies(measured, out);
    add_points(measured, parameters, out);
  }

 private:
  [[nodiscard]] SimulateJob job(const MatrixXd& measured, const MatrixXd& followed, std::optional<int> samples) const {
    const StateLayout layout = system_.layout();
    SimulateRequest request;
    request.start = VectorXd(measured.col(0).head(2 * layout.nq));
    request.times = measured.row(layout.t()).transpose();
    request.max_steps = std::max(RolloutLimits::most_steps / posterior_.n_components(), RolloutLimits::least_steps);
    request.n_samples = samples;
    SimulateJob job = prepare_simulation(asked_, posterior_, request);
    job.options.max_steps_advice = "gp2 simulate goes on, with more steps";  // a report lets nobody choose their number
    // states hold what acts, not what was commanded
    if (layout.nu > 0) {
      MatrixXd acting = followed.middleRows(layout.u(0), layout.nu);
      for (const Contact& contact : job.motions.front().contacts) acting.row(contact.input).setZero();
      job.options.inputs = {followed.row(layout.t()).transpose(), std::move(acting)};
    }
    return job;
  }

  void simulate_beside(const MatrixXd& measured, const MatrixXd& followed, Rollout& out) {
    const Index nq = system_.nq();
    const SimulateJob of_mean = job(measured, followed, std::nullopt);
    energy_ = of_mean.motions.front().energy;
    Reached mean = follow(of_mean, 0);
    out.ended = mean.ended;
    simulated_ = std::move(mean.states);
    if (simulated_.rows() == 0 || !simulated_.col(0).head(nq).allFinite()) {
      out.reason = out.ended;
      return;
    }
    out.simulated = simulated_.topRows(nq);
    // a measured angle is beside the simulated one, not a turn away
    for (Index j = 0; j < nq; ++j) {
      if (!system_.coordinates()[static_cast<std::size_t>(j)].angle) continue;
      const double turn = out.measured(j, 0) - out.simulated(j, 0);
      out.measured.row(j).array() -= turn - std::remainder(turn, 2 * std::numbers::pi);
    }
    out.simulated_multipliers = std::move(mean.multipliers);
    SimulateJob samples = job(measured, followed, RolloutLimits::n_samples);
    samples.options.max_steps = std::min(samples.options.max_steps, 100 + 3 * mean.steps);
    std::vector<MatrixXd> squares(RolloutLimits::n_samples);
    parallel_for(RolloutLimits::n_samples, thread_count(0), [&](int s, int) {
      const MatrixXd one = follow(samples, static_cast<std::size_t>(s)).states;
      squares[static_cast<std::size_t>(s)] = one.rows() > 0 ? MatrixXd((one.topRows(nq) - out.simulated).cwiseAbs2())
                                                            : MatrixXd::Constant(nq, out.times.size(), not_a_number);
    });
    MatrixXd sum = MatrixXd::Zero(nq, out.times.size());
    for (const MatrixXd& one : squares) sum += one;
    out.stddev = (sum / RolloutLimits::n_samples).cwiseSqrt();
  }

  void find_horizon(Rollout& out) const {
    for (Index i = 0; i < out.times.size() && !out.leaves; ++i) {
      for (Index j = 0; j < out.measured.rows() && !out.leaves; ++j) {
        const double range = out.measured.row(j).maxCoeff() - out.measured.row(j).minCoeff();
        const double error = std::abs(out.measured(j, i) - out.simulated(j, i));
        const double band = std::isnan(out.stddev(j, i)) ? 0 : 2 * out.stddev(j, i);
        if (!(error > std::max(band, RolloutLimits::visible_share * range))) continue;
        out.leaves = out.times[i];
        out.leaving = static_cast<int>(j);
      }
    }
    const Index reached = n_reached();
    View view = View::constrained_acceleration(*posterior_.prior().system);
    view.other_system = asked_.other_system;
    const VectorXd distance = posterior_.distance_from_data(view, simulated_.leftCols(reached), /*n_threads=*/0);
    const auto far = std::find_if(distance.begin(), distance.end(), [](double d) { return d > Posterior::far_from_data; });
    if (far != distance.end()) out.far_from = out.times[far - distance.begin()];
  }

  void add_forces(const MatrixXd& measured, Rollout& out) const {
    if (system_.nc() == 0 || posterior_.prior().reference) return;
    View view = View::multipliers(system_);
    view.other_system = asked_.other_system;
    const Posterior::Marginal forces = posterior_.marginal(view, measured, /*n_threads=*/0);
    out.multipliers = forces.mean;
    out.multipliers_stddev = forces.stddev();
  }

  void add_energies(const MatrixXd& measured, Rollout& out) const {
    if (!energy_) return;
    const Index n = measured.cols(), reached = n_reached();
    MatrixXd both(measured.rows(), n + reached);  // against one and the same state
    both << measured, simulated_.leftCols(reached);
    const VectorXd energy = energy_(both).values;
    out.energy = energy.head(n);
    out.simulated_energy = VectorXd::Constant(n, not_a_number);
    out.simulated_energy.head(reached) = energy.tail(reached);
    const std::vector<Latent>& latents = posterior_.prior().latents;
    std::vector<Posterior::Potential> learned;
    for (std::size_t a = 0; a < latents.size(); ++a) {
      if (!latents[a].is_potential) continue;
      out.potentials.push_back(latents[a].name);
      learned.push_back(posterior_.potential(static_cast<int>(a), measured, measured.col(0)));
    }
    out.potential.resize(std::ssize(learned), n);
    out.potential_stddev.resize(std::ssize(learned), n);
    for (std::size_t k = 0; k < learned.size(); ++k) {
      out.potential.row(static_cast<Index>(k)) = learned[k].mean.transpose();
      out.potential_stddev.row(static_cast<Index>(k)) = learned[k].stddev.transpose();
    }
  }

  void add_points(const MatrixXd& measured, const VectorXd& parameters, Rollout& out) const {
    std::optional<Model::Drawing> drawing = drawing_of(*asked_.model);
    if (!drawing) return;
    std::vector<Expression> entries;
    for (const std::vector<Expression>& point : drawing->points) entries.insert(entries.end(), point.begin(), point.end());
    const Tape tape(entries, asked_.model->symbols().state_and_parameters());
    tape.evaluate(measured, parameters, out.measured_points);
    tape.evaluate(simulated_, parameters, out.simulated_points);
    out.points = std::move(drawing->names);
    out.lines = std::move(drawing->lines);
  }

  [[nodiscard]] Index n_reached() const {
    Index n = 0;
    while (n < simulated_.cols() && !std::isnan(simulated_(0, n))) ++n;
    return n;
  }

  const FitSystem& asked_;
  const Posterior& posterior_;
  const System& system_;
  MatrixXd simulated_;  // states of the mean motion
  std::function<MotionEnergy(const MatrixXd& states)> energy_;
};

}  // namespace

Rollout roll_out(const FitSystem& system, const Posterior& posterior, const MatrixXd& states,
                 const std::vector<std::string>& episodes) {
  Rollout out;
  try {
    Roll(system, posterior).run(states, episodes, out);
  } catch (const Error& error) {
    out = {};
    out.reason = error.what();
  }
  return out;
}

}  // namespace gp2
