#include "gp2/jobs/simulate_job.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/view.hpp"
#include "interruption.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct SimulateArguments {
  std::string file, system, start, inputs, output;
  std::optional<double> t_start, t_end, time_step;
  SimulateRequest request;
  bool json = false;
};

/// What is simulated: a model by its own equations, or a fit by its posterior.
struct Subject {
  std::shared_ptr<const Model> model;  // of what moves
  std::optional<Posterior> posterior;  // of a fit …
  std::optional<FitSystem> asked;      // … and the system that moves

  [[nodiscard]] const System& system() const { return *model->system; }
};

Subject read_subject(const SimulateArguments& arguments) {
  std::string text = read_file(arguments.file);
  if (!is_fit(text)) {
    if (!arguments.system.empty()) {
      throw InputError(
          fmt::format("--system goes with a FIT.json; {} is a model: simulate {} itself", arguments.file, arguments.system));
    }
    return {std::make_shared<const Model>(Model::parse(std::move(text), arguments.file)), {}, {}};
  }
  const auto fit = std::make_shared<const FitFile>(FitFile::parse(text, arguments.file));
  const Posterior posterior = fit->posterior();
  const std::shared_ptr<const Model> other = read_other_system(arguments.system);
  FitSystem asked = system_of(*fit, posterior.prior(), other);
  // keeps alive what it is part of
  const std::shared_ptr<const Model> model = asked.model == other.get() ? other : std::shared_ptr<const Model>(fit, &fit->model);
  return {model, posterior, std::move(asked)};
}

/// The file reads as a log does: inputs are as commanded.
void print_motions(const std::vector<SimulatedMotion>& motions, const System& system, bool with_sample, bool with_stddev,
                   CsvWriter& csv) {
  const StateLayout layout = system.layout();
  const std::vector<std::string> names = system.state_names();
  const std::vector<std::string> accelerations = system.acceleration_names();
  if (with_sample) csv.add("episode");
  csv.add("t");
  for (int k = 0; k < layout.t(); ++k) csv.add(names[static_cast<std::size_t>(k)]);
  for (const std::string& name : accelerations) csv.add(name);
  for (const std::string& name : system.inputs()) csv.add(name);
  const bool with_multipliers = motions.front().trajectory.records.rows() > 0;  // not of a baseline
  if (with_multipliers) {
    for (const std::string& name : View::multipliers(system).names(system)) csv.add(name);
  }
  for (std::size_t j = 0; with_stddev && j < accelerations.size(); ++j) csv.add(accelerations[j] + "_std");
  if (with_stddev) csv.add("distance_from_data");
  if (motions.front().energy) csv.add("energy");
  const bool with_energy_stddev = motions[0].energy && motions[0].energy->stddev.size() > 0;
  if (with_energy_stddev) csv.add("energy_std");
  csv.end_line();

  for (std::size_t k = 0; k < motions.size(); ++k) {
    const Trajectory& trajectory = motions[k].trajectory;
    const auto add = [&](const auto& values) {
      for (const double value : values) csv.add(value);
    };
    for (Eigen::Index i = 0; i < trajectory.states.cols(); ++i) {
      if (with_sample) csv.add(std::to_string(k));
      csv.add(trajectory.times[i]);
      add(trajectory.states.col(i).head(2 * layout.nq));
      add(trajectory.accelerations.col(i));
      add(trajectory.commands.col(i));
      if (with_multipliers) add(trajectory.records.col(i));
      if (with_stddev) {
        add(motions[k].uncertainty->stddev.col(i));
        csv.add(motions[k].uncertainty->distance[i]);
      }
      if (motions[k].energy) csv.add(motions[k].energy->values[i]);
      if (with_energy_stddev) csv.add(motions[k].energy->stddev[i]);
      csv.end_line();
    }
  }
}

const char* word_of(ContactEvent::Kind kind) {
  return kind == ContactEvent::Kind::impact ? "impact" : kind == ContactEvent::Kind::made ? "made" : "released";
}

// Distinguishes the moments of a motion however far from 0 its times are.
std::string moment_text(const Trajectory& motion, double t) {
  const double range = motion.times[motion.times.size() - 1] - motion.times[0];
  const double beyond = range > 0 ? std::ceil(std::log10(std::max(1.0, std::abs(t) / range))) : 0;
  return fmt::format("{:.{}g}", t, static_cast<int>(std::min(17.0, 6 + beyond)));
}

// "contacts: 12 rebounds, made 1 and released 0 times, the first at t = 0.45; the impacts took 3.2 J"
std::optional<std::string> contacts_note(const Trajectory& motion, const System& system) {
  if (motion.events.empty()) return std::nullopt;
  const auto count = [&](ContactEvent::Kind kind) {
    return std::count_if(motion.events.begin(), motion.events.end(), [&](const ContactEvent& one) { return one.kind == kind; });
  };
  double loss = 0;
  for (const ContactEvent& event : motion.events) loss += event.energy_loss;
  const ContactEvent& last = motion.events.back();
  const auto least = std::min_element(motion.events.begin(), motion.events.end(),
                                      [](const auto& one, const auto& other) { return one.energy_loss < other.energy_loss; });
  constexpr double rounding = 1e-9;
  const bool moves = system.reads(SystemPart::residuals)[static_cast<std::size_t>(system.layout().t())];
  const std::string gain =
      least->energy_loss < -rounding * (1 + std::abs(loss))
          ? fmt::format("; the one at t = {} gave {:.3g} J, as {}", moment_text(motion, least->time), -least->energy_loss,
                        moves ? "a surface that moves does, or Newton's restitution where friction turns the slip"
                              : "Newton's restitution does where friction turns the slip: a smaller restitution gives none")
          : "";
  return fmt::format(
      "contacts: {} rebounds, made {} and released {} times, the first event at t = {}, the last, {}, at {}; "
      "impacts took {:.6g} J{}",
      count(ContactEvent::Kind::impact), count(ContactEvent::Kind::made), count(ContactEvent::Kind::released),
      moment_text(motion, motion.events.front().time), word_of(last.kind), moment_text(motion, last.time), loss, gain);
}

double largest_change(const Eigen::VectorXd& energy) { return (energy.array() - energy[0]).abs().maxCoeff(); }

// The worst of several motions, their sums where that says more.
Trajectory total_of(const std::vector<SimulatedMotion>& motions) {
  Trajectory total;
  for (const SimulatedMotion& motion : motions) {
    const Trajectory& one = motion.trajectory;
    total.max_position_drift = std::max(total.max_position_drift, one.max_position_drift);
    total.max_velocity_drift = std::max(total.max_velocity_drift, one.max_velocity_drift);
    total.steps += one.steps;
    total.rejected_steps += one.rejected_steps;
    total.evaluations += one.evaluations;
    total.seconds += one.seconds;
  }
  return total;
}

nlohmann::ordered_json report_of(const std::vector<SimulatedMotion>& motions, const System& system, const SimulateJob& job) {
  const Trajectory total = total_of(motions);
  double energy_drift = 0;
  std::size_t n_lower_rank = 0;
  for (const SimulatedMotion& motion : motions) {
    n_lower_rank += motion.trajectory.lower_rank.states.size();
    if (motion.energy) energy_drift = std::max(energy_drift, largest_change(motion.energy->values));
  }
  nlohmann::ordered_json report;
  report["max_position_drift"] = total.max_position_drift;
  report["max_velocity_drift"] = total.max_velocity_drift;
  report["steps"] = total.steps;
  report["rejected_steps"] = total.rejected_steps;
  report["evaluations"] = total.evaluations;
  report["seconds"] = total.seconds;
  report["start_position_residual"] = motions[0].trajectory.start_position_residual;
  report["start_velocity_residual"] = motions[0].trajectory.start_velocity_residual;
  report["start_displacement"] = motions[0].trajectory.start_displacement;
  report["max_energy_drift"] = motions[0].energy ? nlohmann::ordered_json(energy_drift) : nullptr;
  report["n_lower_rank"] = n_lower_rank;
  nlohmann::ordered_json events = nlohmann::ordered_json::array();
  for (const ContactEvent& event : motions[0].trajectory.events) {
    events.push_back({{"t", event.time},
                      {"contact", system.constraint_labels()[static_cast<std::size_t>(event.row)]},
                      {"kind", word_of(event.kind)},
                      {"approach", event.approach},
                      {"energy_loss", event.energy_loss}});
  }
  report["contact_events"] = std::move(events);
  nlohmann::ordered_json sticks = nlohmann::ordered_json::array();
  for (const StickEvent& event : motions[0].trajectory.sticks) {
    sticks.push_back({{"t", event.time},
                      {"surface", job.options.switching.names()[static_cast<std::size_t>(event.surface)]},
                      {"kind", event.sticks ? "sticks" : "slips"}});
  }
  report["stick_events"] = std::move(sticks);
  report["multiplier_sign_changes"] = nlohmann::ordered_json::object();
  const std::vector<std::vector<double>> changes = multiplier_sign_changes(motions[0].trajectory);
  for (std::size_t k = 0; k < changes.size(); ++k) {
    report["multiplier_sign_changes"][View::multipliers(system).names(system)[k]] = changes[k];
  }
  const SimulatedMotion* const leaving = first_to_leave(motions);
  report["leaves_data_at"] = leaving ? nlohmann::ordered_json(*leaving->uncertainty->leaves_data) : nullptr;
  return report;
}

std::vector<std::string> notes_of(const std::vector<SimulatedMotion>& motions, const System& system, const SimulateJob& job,
                                  const SimulateArguments& arguments) {
  std::vector<std::string> notes;
  const Trajectory& first = motions[0].trajectory;
  constexpr double worth_saying = 1e-9;
  // a warning that names the moves has told of the projection
  const bool is_told =
      std::ranges::any_of(job.notes, [](const std::string& note) { return note.starts_with("warning: `start`"); });
  const bool is_moved = first.start_displacement > worth_saying;
  if (is_moved && !is_told) {
    notes.push_back(
        fmt::format("start: projected onto the constraints, which moves it by up to {:.3g}; it was off by |c| = {:.3g}, "
                    "|dc/dt| = {:.3g}",
                    first.start_displacement, first.start_position_residual, first.start_velocity_residual));
  } else if (!is_moved && std::max(first.start_position_residual, first.start_velocity_residual) > worth_saying) {
    notes.push_back(fmt::format("start: off the constraints by |c| = {:.3g}, |dc/dt| = {:.3g}, and left there",
                                first.start_position_residual, first.start_velocity_residual));
  }
  for (std::string& note : motion_notes(motions)) notes.push_back(std::move(note));
  const Trajectory total = total_of(motions);
  Eigen::Index n_rows = 0;
  for (const SimulatedMotion& motion : motions) n_rows += motion.trajectory.times.size();
  notes.push_back(fmt::format("{}: {} rows, {} steps; drift |c| ≤ {:.3g}, |dc/dt| ≤ {:.3g}", arguments.output, n_rows,
                              total.steps, total.max_position_drift, total.max_velocity_drift));
  if (const std::optional<std::string> note = contacts_note(first, system)) notes.push_back(*note);
  if (motions[0].energy) {
    const Eigen::VectorXd& energy = motions[0].energy->values;
    notes.push_back(fmt::format("energy: {:.6g} J at the start, {:.6g} J at the end, largest change {:.3g} J", energy[0],
                                energy[energy.size() - 1], largest_change(energy)));
  }
  return notes;
}

// The request with the files that the arguments name.
SimulateRequest read_request(const SimulateArguments& arguments, const Model& model) {
  SimulateRequest request = arguments.request;
  request.start = read_start(arguments.start);
  const double t_start = arguments.t_start ? *arguments.t_start : start_time(model, request.start, request.columns).value_or(0);
  request.times = motion_times(t_start, *arguments.t_end, arguments.time_step);
  if (!arguments.inputs.empty()) request.inputs = CsvTable::read(arguments.inputs, CsvTable::Keep::numbers);
  return request;
}

std::vector<SimulatedMotion> with_uncertainty(std::vector<Trajectory> trajectories, const Subject& subject,
                                              const SimulateJob& job) {
  std::vector<SimulatedMotion> motions;
  for (std::size_t k = 0; k < trajectories.size(); ++k) {
    Trajectory& trajectory = trajectories[k];
    if (trajectory.times.size() == 0) continue;
    SimulatedMotion& motion = motions.emplace_back(SimulatedMotion{std::move(trajectory)});
    if (subject.posterior) {
      motion.uncertainty = motion_uncertainty(*subject.posterior, motion.trajectory, subject.asked->other_system);
    }
    if (job.motions[k].energy) motion.energy = job.motions[k].energy(motion.trajectory.states);
  }
  return motions;
}

void run(const SimulateArguments& arguments) {
  require_output(arguments.output, {arguments.file, arguments.system, arguments.start, arguments.inputs});
  const Subject subject = read_subject(arguments);
  const SimulateRequest request = read_request(arguments, *subject.model);
  const SimulateJob job = subject.posterior ? prepare_simulation(*subject.asked, *subject.posterior, request)
                                            : prepare_simulation(*subject.model, request);
  print_notes(job.notes);
  std::vector<Trajectory> trajectories;
  std::string unfinished;
  const Interruption interruption;
  try {
    trajectories = run_simulation(job, interruption.stop());
  } catch (const UnfinishedMotion& motion) {
    trajectories = motion.motions;
    unfinished = motion.what();
  }
  const std::vector<SimulatedMotion> motions = with_uncertainty(std::move(trajectories), subject, job);
  if (motions.empty()) throw NumericalError(unfinished);
  write_csv(arguments.output, [&](CsvWriter& csv) {
    print_motions(motions, subject.system(), request.n_samples.has_value(), subject.posterior.has_value() && !request.n_samples,
                  csv);
  });
  print_notes(notes_of(motions, subject.system(), job, arguments));
  if (arguments.json) print_json(report_of(motions, subject.system(), job));
  if (unfinished.empty()) return;
  if (interruption.signal() == 0) {
    throw NumericalError(fmt::format("{}; {} holds the motion up to there", unfinished, arguments.output));
  }
  print_notes({fmt::format("{}: {} holds the motion up to there", interruption.text(), arguments.output)});
  throw Interrupted{interruption.signal()};
}

}  // namespace

Command simulate_command() {
  const auto a = std::make_shared<SimulateArguments>();
  return {
      "simulate", "Simulate the motion of a fit or a model, on its constraints",
      "gp2 simulate fit.json --start q1=0.4,q2=0.8,dq1=0.8,dq2=1 --t-end 6 -o motion.csv",
      joined({{argument("FILE", a->file, "file written by gp2 fit, or a model file, to simulate its force and [truth]"),
               {"system", &a->system, "OTHER.toml", system_help},
               start_option(a->start),
               required({"t_end", &a->t_end, "SECONDS", "end of the motion [s]"}),
               {"t_start", &a->t_start, "SECONDS", "start of the motion [s]", "t of the CSV of --start, or 0"},
               {"dt", &a->time_step, "SECONDS", "time between written rows; the end is always written [s]", "100 rows"},
               {"inputs", &a->inputs, "CSV", "CSV with t and every input, interpolated linearly; must cover the motion", "zero"}},
              options(a->request),
              {{"json", &a->json, "", "print the report as JSON"}, output(a->output, "CSV", "CSV file to write")}}),
      [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
