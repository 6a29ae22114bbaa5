#include "gp2/jobs/simulate_job.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <string_view>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "jobs/log_columns.hpp"
#include "simulation/contacts.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

void require_in_range(const SimulateRequest& request) {
  if (request.n_samples && *request.n_samples < 1) {
    throw InputError(fmt::format("`samples`: must be at least 1, got {}", *request.n_samples));
  }
  for (const auto& [name, tolerance] :
       {std::pair("rtol", request.relative_tolerance), std::pair("atol", request.absolute_tolerance)}) {
    if (!(tolerance > 0) || !std::isfinite(tolerance))
      throw InputError(fmt::format("`{}`: must be positive, got {}", name, tolerance));
  }
  if (request.relative_tolerance < least_relative_tolerance) {
    throw InputError(fmt::format("`rtol`: must be at least {}, near the rounding of doubles, got {}", least_relative_tolerance,
                                 request.relative_tolerance));
  }
  if (request.max_steps < 1) throw InputError(fmt::format("`max_steps`: must be at least 1, got {}", request.max_steps));
  if (request.times.size() == 0) {
    throw InputError("`times`: expected the times [s] at which states are wanted; the first is the start");
  }
}

StartingPoint empty_start(const System& system) {
  const int size = system.layout().size();
  return {VectorXd::Zero(size), std::vector<bool>(static_cast<std::size_t>(size), false)};
}

// All of q and dq.
StartingPoint start_by_values(const System& system, const VectorXd& values) {
  const Index n = 2 * system.nq();
  if (values.size() != n) throw InputError(fmt::format("`start`: expected {} numbers, got {}", n, values.size()));
  if (!values.allFinite()) throw InputError("`start`: not all numbers are finite");
  StartingPoint start = empty_start(system);
  start.state.head(n) = values;
  std::fill_n(start.given.begin(), n, true);
  return start;
}

StartingPoint start_by_names(const System& system, const std::map<std::string, double>& given) {
  const std::vector<std::string> names = system.state_names();
  const auto end = names.begin() + system.layout().t();  // coordinates and velocities come first
  StartingPoint start = empty_start(system);
  for (const auto& [name, value] : given) {
    const auto found = std::find(names.begin(), end, name);
    if (found == end) {
      throw InputError(fmt::format("`start`: '{}' is no coordinate or velocity of '{}'; there are: {}", name, system.name(),
                                   fmt::join(names.begin(), end, ", ")));
    }
    if (!std::isfinite(value)) throw InputError(fmt::format("`start`: {} = {} is not a finite number", name, value));
    const auto entry = found - names.begin();
    start.state[entry] = value;
    start.given[static_cast<std::size_t>(entry)] = true;
  }
  return start;
}

// What the first row of a log has of coordinates, velocities and t.
StartingPoint start_of_log(const Model& model, const CsvTable& table, const std::map<std::string, std::string>& columns) {
  const System& system = *model.system;
  const CsvTable first_row = table.first_rows(1);
  LogReader reader(first_row, system, columns);
  const std::vector<std::string> names = system.state_names();
  StartingPoint start = empty_start(system);
  std::vector<std::string> found;
  for (int k = 0; k <= system.layout().t(); ++k) {
    const auto entry = static_cast<std::size_t>(k);
    if (!reader.has(names[entry])) continue;
    start.given[entry] = true;
    found.push_back(names[entry]);
  }
  if (found.empty() || found.front() == "t") {
    throw InputError(fmt::format("`start`: {} has none of the columns {}", table.name(),
                                 fmt::join(names.begin(), names.begin() + system.layout().t(), ", ")));
  }
  const VectorXd row = reader.values(found).col(0);
  Index next = 0;
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (start.given[k]) start.state[static_cast<Index>(k)] = row[next++];
  }
  return start;
}

// What a log computed from its measurements by other parameters is off the constraints now, and is to be solved for again; projecting
// would move the measurements too. Measured are the entries that [sampling] draws or, where it draws none, the angles.
void free_what_depends(const Model& model, const VectorXd& parameters, StartingPoint& start) {
  const System& system = *model.system;
  const auto violation = largest_violation(system, start.state, parameters);
  const auto n = static_cast<std::size_t>(2 * system.nq());
  const bool is_whole = std::all_of(start.given.begin(), start.given.begin() + 2 * system.nq(), std::identity());
  if (!is_whole || !violation || violation->relative <= constraint_violation_tolerance) return;
  const std::vector<std::string> names = system.state_names();
  std::vector<bool> is_measured(n, false);
  for (std::size_t k = 0; k < n; ++k) {
    const auto is_drawn = [&](const Model::SamplingRule& rule) { return rule.range && rule.name == names[k]; };
    is_measured[k] = model.sampling.empty() ? system.coordinates()[k % static_cast<std::size_t>(system.nq())].angle
                                            : std::ranges::any_of(model.sampling, is_drawn);
  }
  if (std::ranges::none_of(is_measured, std::identity())) return;
  std::copy(is_measured.begin(), is_measured.end(), start.given.begin());
}

// What is not given follows from the constraints; where that would be below the surface of a contact, from the contact too.
VectorXd complete_above_surfaces(const Model& model, const VectorXd& parameters, const StartingPoint& start,
                                 std::vector<std::string>& notes) {
  constexpr double rounding = 1e-9;
  const System& system = *model.system;
  const std::vector<Contact> contacts = contacts_of(model, parameters);
  std::vector<std::string> said, said_on_surface;
  VectorXd state = complete_start(model, parameters, start, said);
  const MatrixXd gaps = gaps_of(system, contacts, state, parameters);
  StartingPoint touching = start;
  for (std::size_t k = 0; k < contacts.size(); ++k) {
    if (gaps(static_cast<Index>(k), 0) < 0) touching.state[system.layout().u(contacts[k].input)] = 1;
  }
  if ((gaps.array() < 0).any()) {
    VectorXd on_surface = complete_start(model, parameters, touching, said_on_surface);
    const bool is_solved =
        std::ranges::none_of(said_on_surface, [](const std::string& note) { return note.starts_with("warning"); });
    if (is_solved && gaps_of(system, contacts, on_surface, parameters).minCoeff() > -rounding) {
      state.head(2 * system.nq()) = on_surface.head(2 * system.nq());  // which contacts are closed the motion tells
      said = std::move(said_on_surface);
    }
  }
  notes.insert(notes.end(), said.begin(), said.end());
  return state;
}

VectorXd start_state(const Model& model, const VectorXd& parameters, const SimulateRequest& request,
                     const std::map<std::string, std::string>& columns, std::vector<std::string>& notes) {
  const System& system = *model.system;
  StartingPoint start =
      std::visit(Overloaded{[&](const VectorXd& values) { return start_by_values(system, values); },
                            [&](const CsvTable& table) { return start_of_log(model, table, columns); },
                            [&](const std::map<std::string, double>& given) { return start_by_names(system, given); }},
                 request.start);
  start.state[system.layout().t()] = request.times[0];
  if (std::holds_alternative<CsvTable>(request.start)) free_what_depends(model, parameters, start);
  return complete_above_surfaces(model, parameters, start, notes);
}

// Inputs must cover the motion: they are not extrapolated.
InputSignal input_signal(const Model& model, const std::vector<Actuator>& actuators, const SimulateRequest& request,
                         const std::map<std::string, std::string>& columns, std::vector<std::string>& notes) {
  if (!request.inputs) return {};
  const System& system = *model.system;
  const CsvTable& table = *request.inputs;
  if (system.inputs().empty()) throw InputError(fmt::format("`inputs`: '{}' has no inputs", system.name()));
  LogReader reader(table, system, columns);
  const VectorXd times = reader.values({"t"}).row(0).transpose();
  const std::vector<std::string> given = driving_inputs(model);
  const MatrixXd read = reader.values(given);
  MatrixXd values = MatrixXd::Zero(system.layout().nu, times.size());
  for (std::size_t k = 0; k < given.size(); ++k) {
    const auto row = std::find(system.inputs().begin(), system.inputs().end(), given[k]) - system.inputs().begin();
    values.row(row) = read.row(static_cast<Index>(k));
  }
  const double t_start = request.times[0], t_end = request.times[request.times.size() - 1];
  try {
    InputSignal signal(times, values, actuators);
    const double slack = 1e-9 * (t_end - t_start);
    if (times[0] > t_start + slack || times[times.size() - 1] < t_end - slack) {
      throw InputError(
          fmt::format("times {} to {} do not cover the motion from {} to {}", times[0], times[times.size() - 1], t_start, t_end));
    }
    if (const double step = usual_step(times); step > t_end - t_start && times.size() > 2) {
      notes.push_back(fmt::format("warning: {}: its rows are {:.3g} s apart and the motion lasts {:.3g} s: is its t in s?",
                                  table.name(), step, t_end - t_start));
    }
    return signal;
  } catch (const InputError& error) {
    if (std::string_view(error.what()).starts_with(table.name() + ": ")) throw;  // a table of arrays is called 'inputs'
    throw InputError(fmt::format("{}: {}", table.name(), error.what()));
  }
}

// All but the motions.
SimulateJob prepare(const Model& model, const std::vector<Actuator>& actuators, const VectorXd& parameters,
                    const SimulateRequest& request) {
  require_in_range(request);
  std::vector<const CsvTable*> tables;
  if (const auto* table = std::get_if<CsvTable>(&request.start)) tables.push_back(table);
  if (request.inputs) tables.push_back(&*request.inputs);
  const std::map<std::string, std::string> columns = checked_columns(model, tables, request.columns);
  if (tables.empty() && !request.columns.empty())
    throw InputError("`map` goes with a table, but neither `start` nor the inputs are one");
  SimulateJob job;
  job.system = model.system;
  job.options.times = request.times;
  job.options.relative_tolerance = request.relative_tolerance;
  job.options.absolute_tolerance = request.absolute_tolerance;
  job.options.max_steps = request.max_steps;
  job.options.project = request.project;
  job.options.inputs = input_signal(model, actuators, request, columns, job.notes);
  job.start = start_state(model, parameters, request, columns, job.notes);
  return job;
}

}  // namespace

std::vector<Option> options(SimulateRequest& request) {
  return {
      {"rtol", &request.relative_tolerance, "R", "relative error tolerance per step, for q and dq each"},
      {"atol", &request.absolute_tolerance, "A", "absolute error tolerance per step"},
      {"max_steps", &request.max_steps, "N", "maximum number of steps, accepted and rejected; rows up to there are written"},
      {"project", Switch{&request.project, "on", "off"}, "",
       "project onto the constraints, after each step and at each written state; off: shows the drift of the integrator"},
      {"samples", &request.n_samples, "S",
       "number of motions, each under functions sampled from the posterior, instead of one under its mean", "", "n_samples"},
      {"seed", &request.seed, "K", "random seed of the samples", "", "", "", "samples"},
      columns_option(request.columns, "columns by other names, in all logs"),
  };
}

std::vector<std::string> driving_inputs(const Model& model) {
  const System& system = *model.system;
  std::vector<std::string> driving = system.inputs();
  for (const Contact& contact : contacts_of(model, system.parameter_values()))
    std::erase(driving, system.inputs()[static_cast<std::size_t>(contact.input)]);
  return driving;
}

std::optional<double> start_time(const Model& model, const MotionStart& start,
                                 const std::map<std::string, std::string>& columns) {
  const auto* table = std::get_if<CsvTable>(&start);
  if (table == nullptr) return std::nullopt;
  const StartingPoint point = start_of_log(model, *table, checked_columns(model, {}, columns));
  const int t = model.system->layout().t();
  return point.given[static_cast<std::size_t>(t)] ? std::optional(point.state[t]) : std::nullopt;
}

VectorXd motion_times(double t_start, double t_end, const std::optional<double>& time_step) {
  constexpr int default_rows = 100;
  constexpr double most_rows = 1e7;
  if (!std::isfinite(t_start)) throw InputError(fmt::format("`t_start`: must be a finite number, got {}", t_start));
  if (!(t_end > t_start) || !std::isfinite(t_end)) {
    throw InputError(fmt::format("`t_end`: must be after the start {}, got {}", t_start, t_end));
  }
  if (!time_step) return VectorXd::LinSpaced(default_rows, t_start, t_end);
  if (!(*time_step > 0)) throw InputError(fmt::format("`dt`: must be positive, got {}", *time_step));
  const double span = t_end - t_start;
  if (span / *time_step > most_rows) {
    throw InputError(
        fmt::format("`dt`: {} would write {:.3g} rows; at most {:.0e} are written", *time_step, span / *time_step, most_rows));
  }
  const auto n_full = static_cast<int>(std::floor(span / *time_step * (1 + 1e-12) + 1e-9));
  std::vector<double> times;
  for (int k = 0; k <= n_full; ++k) times.push_back(t_start + k * *time_step);
  if (times.size() > 1 && t_end - times.back() < 1e-6 * *time_step) {
    times.back() = t_end;
  } else {
    times.push_back(t_end);
  }
  return Eigen::Map<const VectorXd>(times.data(), static_cast<Index>(times.size()));
}

SimulateJob prepare_simulation(const Model& model, const SimulateRequest& request) {
  require_in_range(request);
  if (request.n_samples) throw InputError("`samples`: a model has no posterior to draw from; give a FIT.json");
  const VectorXd parameters = model.system->parameter_values();
  SimulateJob job = prepare(model, model.actuators, parameters, request);
  job.options.switching = switching_functions(model, /*of_latents=*/false);
  SimulateJob::Motion motion{parameters, model_acceleration(model)};
  motion.contacts = contacts_of(model, parameters);
  motion.pushed = pushed_acceleration(model);
  if (model.potential) {
    motion.energy = [&model, parameters](const MatrixXd& states) -> MotionEnergy {
      return {mechanical_energy(model, parameters, states), {}};
    };
  }
  if (model.system->nc() > 0) {
    motion.multipliers = [motion = ModelMotion(model)](const Eigen::Ref<const VectorXd>& x) -> VectorXd {
      return motion.multipliers(x).col(0);
    };
  }
  job.motions = {std::move(motion)};
  return job;
}

namespace {

/// What a component of a posterior, or a sample, says of energies.
struct LearnedEnergy {
  VectorXd parameters;
  std::function<Posterior::Potential(int latent, const MatrixXd& states)> potential;  // against the first state
};

/// T22 with what each of the latents numbered adds to V. The known potential acts beside it only where the prior's mean has its force.
MotionEnergy energy_with_learned(const Model& model, const LearnedEnergy& learned, Prior::Mean mean,
                                 const std::vector<int>& latents, const MatrixXd& states) {
  MotionEnergy out;
  const bool is_known = model.potential && (latents.empty() || mean == Prior::Mean::force);
  out.values =
      is_known ? mechanical_energy(model, learned.parameters, states) : kinetic_energy(*model.system, learned.parameters, states);
  for (const int latent : latents) {
    const Posterior::Potential V = learned.potential(latent, states);
    out.values += V.mean;
    if (latents.size() == 1) out.stddev = V.stddev;
  }
  return out;
}

/// Whether the prior's mean has a force that is not known to have a potential, at rest and without inputs.
bool acts_at_rest(const Model& model, const Posterior& posterior, const VectorXd& parameters, const VectorXd& start) {
  if (posterior.prior().mean != Prior::Mean::force || model.potential) return false;
  constexpr Index enough = 100;
  MatrixXd states = start;
  const std::vector<Observations>& learned = posterior.observations();
  if (!learned.empty() && learned.front().n_data() > 0)
    states = learned.front().states().leftCols(std::min<Index>(enough, learned.front().states().cols()));
  const StateLayout layout = model.system->layout();
  states.middleRows(layout.nq, layout.nq).setZero();
  states.bottomRows(layout.nu).setZero();
  states.row(layout.t()) = states.row(layout.t()).array().isNaN().select(0, states.row(layout.t()));
  return (model.system->evaluate(states, parameters).force.array().abs() > 0).any();
}

/// Mean and deviation of a mixture of equal weights (theory.md, T31).
MotionEnergy mixed(const std::vector<MotionEnergy>& components) {
  if (components.size() == 1) return components.front();
  const double n = static_cast<double>(components.size());
  MotionEnergy out{VectorXd::Zero(components.front().values.size()), {}};
  for (const MotionEnergy& one : components) out.values += one.values / n;
  if (components.front().stddev.size() == 0) return out;
  VectorXd variance = VectorXd::Zero(out.values.size());
  for (const MotionEnergy& one : components) {
    variance += (one.stddev.cwiseAbs2() + (one.values - out.values).cwiseAbs2()) / n;
  }
  out.stddev = variance.cwiseSqrt();
  return out;
}

}  // namespace

SimulateJob prepare_simulation(const FitSystem& system, const Posterior& posterior, const SimulateRequest& request) {
  const Model& model = *system.model;
  View ddq = View::constrained_acceleration(*model.system), multipliers = View::multipliers(*model.system);
  ddq.other_system = multipliers.other_system = system.other_system;
  const VectorXd likeliest = parameters_of(ddq, posterior.values().parameters);
  SimulateJob job = prepare(model, system.actuators, likeliest, request);
  job.notes.insert(job.notes.begin(), system.notes.begin(), system.notes.end());
  job.options.switching = switching_functions(model, /*of_latents=*/true);
  std::vector<int> potentials;
  for (int a = 0; a < static_cast<int>(posterior.prior().latents.size()); ++a) {
    if (posterior.prior().latents[static_cast<std::size_t>(a)].is_potential) potentials.push_back(a);
  }
  // learned potentials are functions of states of the fit's own system
  const bool lacks_potential = !potentials.empty() && acts_at_rest(model, posterior, likeliest, job.start);
  if (lacks_potential) {
    job.notes.push_back(
        fmt::format("warning: no energy: {} has a learned potential, but the known force acts at rest and has no [mechanics] "
                    "potential = \"…\"",
                    model.name));
  }
  const bool has_energy = potentials.empty() ? model.potential.has_value() : system.other_system == nullptr && !lacks_potential;
  const auto add = [&](const VectorXd& parameters, const auto& function, std::vector<LearnedEnergy> energies) {
    const auto of_view = [&](const View& view) -> Acceleration {
      return [function, view](const Eigen::Ref<const VectorXd>& x) -> VectorXd { return function(view, x).col(0); };
    };
    SimulateJob::Motion motion{parameters, of_view(ddq)};
    motion.contacts = contacts_of(model, parameters);
    motion.pushed = pushed_acceleration(posterior.prior(), ddq, function);
    // a baseline knows no constraints
    if (model.system->nc() > 0 && !posterior.prior().reference) motion.multipliers = of_view(multipliers);
    if (has_energy) {
      motion.energy = [&model, mean = posterior.prior().mean, potentials,
                       energies = std::move(energies)](const MatrixXd& states) {
        std::vector<MotionEnergy> all;
        for (const LearnedEnergy& one : energies) all.push_back(energy_with_learned(model, one, mean, potentials, states));
        return mixed(all);
      };
    }
    job.motions.push_back(std::move(motion));
  };
  if (!request.n_samples) {
    std::vector<LearnedEnergy> components;
    for (int k = 0; k < posterior.n_components(); ++k) {
      const Posterior component = posterior.component(k);
      components.push_back({parameters_of(ddq, component.values().parameters),
                            [component](int a, const MatrixXd& at) { return component.potential(a, at, at.col(0)); }});
    }
    add(
        likeliest, [posterior](const View& view, const Eigen::Ref<const MatrixXd>& x) { return posterior.mean(view, x); },
        std::move(components));
    return job;
  }
  const auto samples =
      std::make_shared<const PathwiseSamples>(sample_paths(posterior, *request.n_samples, {.seed = request.seed}));
  for (int k = 0; k < samples->n_samples(); ++k) {
    const VectorXd parameters = parameters_of(ddq, samples->parameters(k));
    const auto potential = [samples, k](int a, const MatrixXd& at) -> Posterior::Potential {
      return {samples->potential(k, a, at, at.col(0)), {}};
    };
    add(parameters, [samples, k](const View& view, const Eigen::Ref<const MatrixXd>& x) { return samples->evaluate(k, view, x); },
        {{parameters, potential}});
  }
  return job;
}

std::vector<Trajectory> run_simulation(const SimulateJob& job, const std::atomic<bool>* stop) {
  std::vector<Trajectory> motions;
  SimulateOptions options = job.options;
  options.stop = stop;
  for (const SimulateJob::Motion& motion : job.motions) {
    options.record = motion.multipliers;
    options.contacts = motion.contacts;
    options.pushed = motion.pushed;
    try {
      motions.push_back(simulate(*job.system, motion.parameters, motion.acceleration, job.start, options));
    } catch (UnfinishedMotion& unfinished) {
      const std::string which = job.motions.size() > 1 ? fmt::format("sample {}: ", motions.size()) : "";
      motions.push_back(std::move(unfinished.motions.front()));
      throw UnfinishedMotion(which + unfinished.what(), std::move(motions));
    }
  }
  return motions;
}

std::vector<std::vector<double>> multiplier_sign_changes(const Trajectory& trajectory) {
  const auto are_opposite = [](double a, double b) { return (a < 0 && b > 0) || (a > 0 && b < 0); };
  std::vector<std::vector<double>> changes;
  for (const auto& lambda : trajectory.records.rowwise()) {
    std::vector<double>& times = changes.emplace_back();
    for (Index i = 1; i < lambda.size(); ++i) {
      const double before = lambda[i - 1], after = lambda[i];
      // a zero alone is one on the way; where a constraint does not hold, its multiplier is 0 row after row
      if (after == 0 && i + 1 < lambda.size() && are_opposite(before, lambda[i + 1])) times.push_back(trajectory.times[i]);
      if (!are_opposite(before, after)) continue;
      const double dt = trajectory.times[i] - trajectory.times[i - 1];
      times.push_back(trajectory.times[i - 1] + dt * before / (before - after));
    }
  }
  return changes;
}

MotionUncertainty motion_uncertainty(const Posterior& posterior, const Trajectory& trajectory,
                                     const std::shared_ptr<const OtherSystem>& other_system) {
  View view = View::constrained_acceleration(*posterior.prior().system);
  view.other_system = other_system;
  MotionUncertainty out;
  out.stddev = posterior.marginal(view, trajectory.states, /*n_threads=*/0).stddev();
  out.distance = posterior.distance_from_data(view, trajectory.states, /*n_threads=*/0);
  const auto far = std::find_if(out.distance.begin(), out.distance.end(), [](double d) { return d > Posterior::far_from_data; });
  // without data all is far from them
  if (posterior.n_states() > 0 && far != out.distance.end()) out.leaves_data = trajectory.times[far - out.distance.begin()];
  return out;
}

const SimulatedMotion* first_to_leave(const std::vector<SimulatedMotion>& motions) {
  const auto leaves_at = [](const SimulatedMotion& one) {
    return one.uncertainty ? one.uncertainty->leaves_data.value_or(HUGE_VAL) : HUGE_VAL;
  };
  const auto first = std::ranges::min_element(motions, {}, leaves_at);
  return first == motions.end() || leaves_at(*first) == HUGE_VAL ? nullptr : &*first;
}

std::vector<std::string> motion_notes(const std::vector<SimulatedMotion>& motions) {
  std::vector<std::string> notes;
  const SimulatedMotion* const leaving = first_to_leave(motions);
  bool has_jumped = false, has_lost_rank = false;  // one before
  for (std::size_t k = 0; k < motions.size(); ++k) {
    const Trajectory& motion = motions[k].trajectory;
    const std::string called = motions.size() > 1 ? fmt::format("sample {}", k) : "the motion";
    if (&motions[k] == leaving) {
      notes.push_back(fmt::format(
          "warning: {} leaves the region of the data at t = {:.6g}: at its farthest it is {:.3g} times as far from the "
          "observed states as those are from each other",
          called, *leaving->uncertainty->leaves_data, leaving->uncertainty->distance.maxCoeff()));
    }
    if (motion.largest_jump > 0 && !std::exchange(has_jumped, true)) {
      notes.push_back(
          fmt::format("warning: {} jumps by {:.3g} at t = {:.6g}, where a constraint becomes active off its surface: write what "
                      "meets a surface as a contact",
                      called, motion.largest_jump, motion.jump_time));
    }
    if (const LowerRank& lower = motion.lower_rank; !lower.states.empty() && !std::exchange(has_lost_rank, true)) {
      notes.push_back(
          fmt::format("warning: the constraints have rank {} but at {} of {} rows of the motion, where it is as low as {}, first "
                      "at t = {:.6g}; the motion may branch there",
                      lower.usual, lower.states.size(), motion.times.size(), lower.lowest, motion.times[lower.states.front()]));
    }
  }
  return notes;
}

}  // namespace gp2
