#include "gp2/simulate.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/inference/pathwise.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string subject, start, output, map, project = "on";
  std::optional<std::string> inputs;
  std::optional<double> t_start, t_end, time_step;
  double relative_tolerance = 1e-6, absolute_tolerance = 1e-9;
  std::optional<int> n_samples;
  std::uint64_t seed = 0;
  bool json = false;
};

constexpr int default_rows = 100;
constexpr double most_rows = 1e7;

/// What is simulated: a model by its own equations, or a fit by its posterior.
struct Subject {
  Model model;
  std::optional<Posterior> posterior;  // of a fit
  Eigen::VectorXd parameters;

  [[nodiscard]] const System& system() const { return *model.system; }
  [[nodiscard]] View view() const { return View::constrained_acceleration(system()); }
};

Subject read_subject(const std::string& file) {
  const std::string text = read_file(file);
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  if (first == std::string::npos || text[first] != '{') {
    Model model = Model::read(file);
    const Eigen::VectorXd parameters = model.system->parameter_values();
    return {std::move(model), std::nullopt, parameters};
  }
  FitFile fit = FitFile::read(file);
  Posterior posterior = fit.posterior();
  const Eigen::VectorXd parameters = posterior.values().parameters;
  return {std::move(fit.model), std::move(posterior), parameters};
}

std::map<std::string, std::string> columns_of(const Model& model, const std::string& map) {
  std::map<std::string, std::string> columns = parse_map(map);
  columns.insert(model.columns.begin(), model.columns.end());  // --map wins
  return columns;
}

// "q1=0.4,dq1=0.8"
StartingPoint parse_start(const std::string& text, const System& system) {
  const std::vector<std::string> names = system.state_names();
  const std::ptrdiff_t n_motion = system.layout().t();  // coordinates and velocities come first
  StartingPoint start{Eigen::VectorXd::Zero(system.layout().size()), std::vector<bool>(names.size(), false)};
  for (const std::string& item : parse_list(text)) {
    const std::size_t equals = item.find('=');
    if (equals == std::string::npos) throw InputError(fmt::format("--start: '{}' is not NAME=VALUE, say q1=0.4", item));
    const std::string name = item.substr(0, equals), written = item.substr(equals + 1);
    const auto found = std::find(names.begin(), names.begin() + n_motion, name);
    const auto entry = found - names.begin();
    if (entry == n_motion) {
      throw InputError(fmt::format("--start: '{}' is no coordinate or velocity of '{}'; there are: {}", name, system.name(),
                                   fmt::join(names.begin(), names.begin() + n_motion, ", ")));
    }
    if (start.given[static_cast<std::size_t>(entry)]) throw InputError(fmt::format("--start: '{}' is given twice", name));
    char* end = nullptr;
    const double value = std::strtod(written.c_str(), &end);
    if (written.empty() || *end != '\0' || !std::isfinite(value)) {
      throw InputError(fmt::format("--start: {} = '{}' is not a finite number", name, written));
    }
    start.state[entry] = value;
    start.given[static_cast<std::size_t>(entry)] = true;
  }
  return start;
}

// the first row of a log: what it has of coordinates, velocities and t
StartingPoint read_start(const std::string& file, const Model& model, const std::string& map) {
  const CsvTable table = CsvTable::read(file, CsvTable::Keep::numbers);
  LogReader reader(table, *model.system, columns_of(model, map));
  const std::vector<std::string> names = model.system->state_names();
  StartingPoint start{Eigen::VectorXd::Zero(model.system->layout().size()), std::vector<bool>(names.size(), false)};
  std::vector<std::string> found;
  for (int k = 0; k <= model.system->layout().t(); ++k) {
    if (!reader.has(names[static_cast<std::size_t>(k)])) continue;
    start.given[static_cast<std::size_t>(k)] = true;
    found.push_back(names[static_cast<std::size_t>(k)]);
  }
  if (found.empty()) {
    throw InputError(fmt::format("--start: {} has none of the columns {}", file,
                                 fmt::join(names.begin(), names.begin() + model.system->layout().t(), ", ")));
  }
  const Eigen::VectorXd row = reader.values(found).col(0);
  Eigen::Index next = 0;
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (start.given[k]) start.state[static_cast<Eigen::Index>(k)] = row[next++];
  }
  return start;
}

InputSignal read_inputs(const Arguments& arguments, const Model& model, double t_start, double t_end) {
  if (!arguments.inputs) return {};
  const System& system = *model.system;
  if (system.inputs().empty()) throw InputError(fmt::format("--inputs: '{}' has no inputs", system.name()));
  const CsvTable table = CsvTable::read(*arguments.inputs, CsvTable::Keep::numbers);
  LogReader reader(table, system, columns_of(model, arguments.map));
  const Eigen::VectorXd times = reader.values({"t"}).row(0).transpose();
  const Eigen::MatrixXd values = reader.values(system.inputs());
  try {
    InputSignal signal(times, values);
    const double slack = 1e-9 * (t_end - t_start);
    if (times[0] > t_start + slack || times[times.size() - 1] < t_end - slack) {
      throw InputError(
          fmt::format("times {} to {} do not cover the motion from {} to {}", times[0], times[times.size() - 1], t_start, t_end));
    }
    return signal;
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", table.name(), error.what()));
  }
}

// from the start to the end, both written
Eigen::VectorXd times_of(double t_start, double t_end, const std::optional<double>& time_step) {
  if (!std::isfinite(t_start)) throw InputError(fmt::format("--t-start: must be a finite number, got {}", t_start));
  if (!(t_end > t_start) || !std::isfinite(t_end)) {
    throw InputError(fmt::format("--t-end: must be after the start {}, got {}", t_start, t_end));
  }
  if (!time_step) return Eigen::VectorXd::LinSpaced(default_rows, t_start, t_end);
  if (!(*time_step > 0)) throw InputError(fmt::format("--dt: must be positive, got {}", *time_step));
  const double span = t_end - t_start;
  if (span / *time_step > most_rows) {
    throw InputError(
        fmt::format("--dt: {} would write {:.3g} rows; at most {:.0e} are written", *time_step, span / *time_step, most_rows));
  }
  const auto n_full = static_cast<int>(std::floor(span / *time_step * (1 + 1e-12) + 1e-9));
  std::vector<double> times;
  for (int k = 0; k <= n_full; ++k) times.push_back(t_start + k * *time_step);
  if (times.size() > 1 && t_end - times.back() < 1e-6 * *time_step) {
    times.back() = t_end;
  } else {
    times.push_back(t_end);
  }
  return Eigen::Map<const Eigen::VectorXd>(times.data(), static_cast<Eigen::Index>(times.size()));
}

/// The uncertainty of ddq along a motion, and where it leaves the region of the data.
struct Uncertainty {
  Eigen::MatrixXd stddev;             // (nq × N)
  std::optional<double> leaves_data;  // first time at which a standard deviation exceeds half the prior's
  std::string coordinate;             // whose acceleration it is
};

Uncertainty uncertainty_of(const Subject& subject, const Trajectory& trajectory) {
  Uncertainty out;
  out.stddev = subject.posterior->marginal(subject.view(), trajectory.states).stddev();
  const Eigen::MatrixXd prior = subject.posterior->without_data().marginal(subject.view(), trajectory.states).stddev();
  for (Eigen::Index i = 0; i < prior.cols() && !out.leaves_data; ++i) {
    for (Eigen::Index j = 0; j < prior.rows() && !out.leaves_data; ++j) {
      if (!(out.stddev(j, i) > prior(j, i) / 2)) continue;
      out.leaves_data = trajectory.times[i];
      out.coordinate = subject.system().coordinates()[static_cast<std::size_t>(j)].acceleration();
    }
  }
  return out;
}

/// One motion and what goes with it.
struct Motion {
  Trajectory trajectory;
  std::optional<Uncertainty> uncertainty;  // of a fit
  std::optional<Eigen::VectorXd> energy;   // of a model with a potential
};

std::string csv_of(const std::vector<Motion>& motions, const Subject& subject, bool with_sample, bool with_stddev) {
  const System& system = subject.system();
  const StateLayout layout = system.layout();
  const std::vector<std::string> names = system.state_names();
  std::string csv;
  std::vector<std::string> line;
  const auto end_line = [&] {
    csv += fmt::format("{}\n", fmt::join(line, ","));
    line.clear();
  };
  const std::vector<std::string> accelerations = system.acceleration_names();
  if (with_sample) line.emplace_back("sample");
  line.emplace_back("t");
  line.insert(line.end(), names.begin(), names.begin() + layout.t());
  line.insert(line.end(), accelerations.begin(), accelerations.end());
  line.insert(line.end(), system.inputs().begin(), system.inputs().end());
  for (std::size_t j = 0; with_stddev && j < accelerations.size(); ++j) line.push_back(accelerations[j] + "_std");
  if (subject.model.potential) line.emplace_back("energy");
  end_line();

  for (std::size_t k = 0; k < motions.size(); ++k) {
    const Trajectory& trajectory = motions[k].trajectory;
    const auto add = [&](const auto& values) {
      for (const double value : values) line.push_back(shortest(value));
    };
    for (Eigen::Index i = 0; i < trajectory.states.cols(); ++i) {
      if (with_sample) line.push_back(std::to_string(k));
      line.push_back(shortest(trajectory.times[i]));
      add(trajectory.states.col(i).head(2 * layout.nq));
      add(trajectory.accelerations.col(i));
      add(trajectory.states.col(i).tail(layout.nu));
      if (with_stddev) add(motions[k].uncertainty->stddev.col(i));
      if (motions[k].energy) line.push_back(shortest((*motions[k].energy)[i]));
      end_line();
    }
  }
  return csv;
}

double largest_change(const Eigen::VectorXd& energy) { return (energy.array() - energy[0]).abs().maxCoeff(); }

// the worst of several motions, their sums where that says more
nlohmann::ordered_json report_of(const std::vector<Motion>& motions) {
  Trajectory total;
  double energy_drift = 0;
  std::size_t n_lower_rank = 0;
  std::optional<double> leaves_data;
  for (const Motion& motion : motions) {
    const Trajectory& one = motion.trajectory;
    total.max_position_drift = std::max(total.max_position_drift, one.max_position_drift);
    total.max_velocity_drift = std::max(total.max_velocity_drift, one.max_velocity_drift);
    total.steps += one.steps;
    total.rejected_steps += one.rejected_steps;
    total.evaluations += one.evaluations;
    total.seconds += one.seconds;
    n_lower_rank += one.lower_rank.states.size();
    if (motion.energy) energy_drift = std::max(energy_drift, largest_change(*motion.energy));
    const std::optional<double> left = motion.uncertainty ? motion.uncertainty->leaves_data : std::nullopt;
    if (left && (!leaves_data || *left < *leaves_data)) leaves_data = left;
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
  report["leaves_data_at"] = leaves_data ? nlohmann::ordered_json(*leaves_data) : nullptr;
  return report;
}

std::vector<std::string> notes_of(const std::vector<Motion>& motions, const Arguments& arguments) {
  std::vector<std::string> notes;
  const Trajectory& first = motions[0].trajectory;
  constexpr double worth_saying = 1e-9;
  if (first.start_displacement > worth_saying) {
    notes.push_back(
        fmt::format("start: projected onto the constraints, which moves it by up to {:.3g}; it was off by |c| = {:.3g}, "
                    "|dc/dt| = {:.3g}",
                    first.start_displacement, first.start_position_residual, first.start_velocity_residual));
  } else if (std::max(first.start_position_residual, first.start_velocity_residual) > worth_saying) {
    notes.push_back(fmt::format("start: off the constraints by |c| = {:.3g}, |dc/dt| = {:.3g}, and left there",
                                first.start_position_residual, first.start_velocity_residual));
  }
  for (std::size_t k = 0; k < motions.size(); ++k) {
    if (!motions[k].uncertainty || !motions[k].uncertainty->leaves_data) continue;
    notes.push_back(
        fmt::format("warning: {}leaves the region of the data at t = {:.6g}: the standard deviation of {} exceeds half "
                    "the prior's",
                    motions.size() > 1 ? fmt::format("sample {} ", k) : "the motion ", *motions[k].uncertainty->leaves_data,
                    motions[k].uncertainty->coordinate));
    break;  // the first sample stands for the others
  }
  for (const Motion& motion : motions) {
    const LowerRank& lower = motion.trajectory.lower_rank;
    if (lower.states.empty()) continue;
    notes.push_back(
        fmt::format("warning: the constraints have rank {} but at {} of {} rows of the motion, where it is as low as {}, first "
                    "at t = {:.6g}; the motion may branch there",
                    lower.usual, lower.states.size(), motion.trajectory.times.size(), lower.lowest,
                    motion.trajectory.times[lower.states.front()]));
    break;  // as above
  }
  const nlohmann::ordered_json report = report_of(motions);
  notes.push_back(fmt::format("{}: {} rows, {} steps; drift |c| ≤ {:.3g}, |dc/dt| ≤ {:.3g}", arguments.output,
                              motions.size() * static_cast<std::size_t>(first.times.size()), report["steps"].get<int>(),
                              report["max_position_drift"].get<double>(), report["max_velocity_drift"].get<double>()));
  if (motions[0].energy) {
    const Eigen::VectorXd& energy = *motions[0].energy;
    notes.push_back(fmt::format("energy: {:.6g} J at the start, {:.6g} J at the end, largest change {:.3g} J", energy[0],
                                energy[energy.size() - 1], largest_change(energy)));
  }
  return notes;
}

void run(const Arguments& arguments) {
  if (arguments.n_samples && *arguments.n_samples < 1) {
    throw InputError(fmt::format("--samples: must be at least 1, got {}", *arguments.n_samples));
  }
  for (const auto& [option, tolerance] :
       {std::pair("--rtol", arguments.relative_tolerance), std::pair("--atol", arguments.absolute_tolerance)}) {
    if (!(tolerance > 0) || !std::isfinite(tolerance))
      throw InputError(fmt::format("{}: must be positive, got {}", option, tolerance));
  }
  require_output(arguments.output, {arguments.subject, arguments.start, arguments.inputs.value_or("")});
  const Subject subject = read_subject(arguments.subject);
  if (arguments.n_samples && !subject.posterior)
    throw InputError("--samples: a model has no posterior to draw from; give a FIT.json");

  const System& system = subject.system();
  const bool listed_start = arguments.start.find('=') != std::string::npos;
  StartingPoint start =
      listed_start ? parse_start(arguments.start, system) : read_start(arguments.start, subject.model, arguments.map);
  const double t_start = arguments.t_start.value_or(start.state[system.layout().t()]);
  SimulateOptions options;
  options.times = times_of(t_start, *arguments.t_end, arguments.time_step);
  options.relative_tolerance = arguments.relative_tolerance;
  options.absolute_tolerance = arguments.absolute_tolerance;
  options.project = arguments.project == "on";
  options.inputs = read_inputs(arguments, subject.model, t_start, *arguments.t_end);
  start.state[system.layout().t()] = t_start;
  std::vector<std::string> notes;
  const Eigen::VectorXd state = complete_start(subject.model, subject.parameters, std::move(start), notes);
  talk(notes);

  std::vector<Motion> motions;
  const auto add_motion = [&](const Acceleration& acceleration) {
    Motion& motion = motions.emplace_back();
    motion.trajectory = simulate(system, subject.parameters, acceleration, state, options);
    if (subject.posterior) motion.uncertainty = uncertainty_of(subject, motion.trajectory);
    if (subject.model.potential) motion.energy = mechanical_energy(subject.model, subject.parameters, motion.trajectory.states);
  };
  if (!subject.posterior) {
    add_motion(model_acceleration(subject.model));
  } else if (!arguments.n_samples) {
    add_motion([&, view = subject.view()](const Eigen::Ref<const Eigen::VectorXd>& x) -> Eigen::VectorXd {
      return subject.posterior->mean(view, x).col(0);
    });
  } else {
    const PathwiseSamples samples = sample_paths(*subject.posterior, *arguments.n_samples, {.seed = arguments.seed});
    for (int k = 0; k < samples.n_samples(); ++k) {
      add_motion([&, k, view = subject.view()](const Eigen::Ref<const Eigen::VectorXd>& x) -> Eigen::VectorXd {
        return samples.evaluate(k, view, x).col(0);
      });
    }
  }

  write_file(arguments.output,
             csv_of(motions, subject, arguments.n_samples.has_value(), subject.posterior.has_value() && !arguments.n_samples));
  talk(notes_of(motions, arguments));
  if (arguments.json) fmt::print("{}\n", report_of(motions).dump(2));
}

}  // namespace

void add_simulate(CLI::App& app) {
  CLI::App* command = app.add_subcommand("simulate", "Integrate the motion of a fit or of a model, on its constraints");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("FILE", arguments->subject, "file written by gp2 fit, or a model file: its force and [truth]")->required();
  command
      ->add_option(
          "--start", arguments->start,
          "NAME=VALUE,… of coordinates and velocities, or a CSV whose first row is taken. What is not given follows from "
          "the constraints, or is 0")
      ->required();
  command->add_option("--t-end", arguments->t_end, "end of the motion [s]")->required();
  command->add_option("--t-start", arguments->t_start, "its start [s] (default: t of the CSV of --start, or 0)");
  command->add_option("--dt", arguments->time_step, "time between written rows [s] (default: 100 rows)");
  command->add_option("--rtol", arguments->relative_tolerance, "relative error per step")->capture_default_str();
  command->add_option("--atol", arguments->absolute_tolerance, "absolute error per step")->capture_default_str();
  command->add_option("--project", arguments->project, "onto the constraints, after each step and where rows are written")
      ->check(CLI::IsMember({"on", "off"}))
      ->capture_default_str();
  command->add_option("--inputs", arguments->inputs, "CSV with t and every input, linear in between (default: zero)");
  command->add_option("--samples", arguments->n_samples, "that many functions drawn from the posterior, instead of its mean");
  command->add_option("--seed", arguments->seed, "of --samples")->check(not_negative())->capture_default_str();
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_flag("--json", arguments->json, "report on stdout as JSON");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer("Example:\n  gp2 simulate fit.json --start q1=0.4,q2=0.8,dq1=0.8,dq2=1 --t-end 6 -o motion.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
