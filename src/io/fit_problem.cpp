#include "gp2/fit_problem.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/check.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics.hpp"
#include "training/random.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::vector<std::string> all_accelerations(const System& system) {
  std::vector<std::string> names;
  for (const Coordinate& coordinate : system.coordinates()) names.push_back(coordinate.acceleration());
  return names;
}

// A renaming that finds nothing is a slip of the pen: the model's [columns] may name columns that this log lacks, --map may not.
void check_columns(const System& system, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  std::vector<std::string> known = system.state_names();
  for (const std::string& name : all_accelerations(system)) known.push_back(name);
  for (const auto& [name, column] : columns) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      throw InputError(fmt::format("--map {}={}: '{}' is neither a state nor an acceleration of '{}'; it has: {}", column, name,
                                   name, system.name(), fmt::join(known, ", ")));
    }
    // a log may lack a coordinate that nothing reads, but then it has the coordinate's derivatives
    std::vector<std::string> meant = {column};
    const auto& coordinates = system.coordinates();
    if (std::any_of(coordinates.begin(), coordinates.end(), [&name = name](const auto& one) { return one.name == name; })) {
      meant = {column, "d" + column, "dd" + column, column + "_dot", column + "_ddot"};
    }
    if (std::none_of(meant.begin(), meant.end(), [&](const std::string& one) { return log.find(one) >= 0; })) {
      throw InputError(fmt::format("--map {}={}: {} has no column '{}'; it has: {}", column, name, log.name(), column,
                                   fmt::join(log.header(), ", ")));
    }
  }
}

void note_reading(const LogReader& reader, const CsvTable& log, std::vector<std::string>& notes) {
  for (const auto& [name, found] : reader.aliases_used()) notes.push_back(fmt::format("column '{}' taken as {}", found, name));
  const std::vector<std::string> unused = reader.unused_columns();
  if (!unused.empty()) notes.push_back(fmt::format("{}: columns not needed: {}", log.name(), fmt::join(unused, ", ")));
}

void note_violation(const System& system, const MatrixXd& states, const CsvTable& log, std::vector<std::string>& notes) {
  const auto violation = largest_violation(system, states, system.parameter_values());
  if (!violation || violation->relative <= constraint_violation_tolerance) return;
  notes.push_back(
      fmt::format("warning: {}: states are off the constraint: '{}' is {:.3g} at data row {}, {:.1e} of its scale; see gp2 check",
                  log.name(), violation->constraint, violation->value, violation->state + 1, violation->relative));
}

// columns a prior and a view need, and those that only tell whether a state is on the constraint
MatrixXd states_of(const Prior& prior, const View& view, LogReader& reader) {
  std::vector<bool> reads = prior.reads();
  const std::vector<bool> of_view = view.reads(*prior.system);
  const std::vector<bool> residuals = prior.system->reads(SystemPart::residuals);
  const std::vector<std::string> names = prior.system->state_names();
  for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || of_view[k] || (residuals[k] && reader.has(names[k]));
  return reader.states(reads);
}

// the first n of a shuffle of 0 … size − 1; all in order when n is no less
std::vector<int> chosen_rows(int size, int n, std::uint64_t seed) {
  std::vector<int> rows(static_cast<std::size_t>(size));
  std::iota(rows.begin(), rows.end(), 0);
  if (n >= size) return rows;
  rows = RandomStream(seed).permutation(size);
  rows.resize(static_cast<std::size_t>(n));
  return rows;
}

// the likelihood would refuse these states too, but it does not know their rows in the log
void require_mechanics_at(const System& system, const MatrixXd& states, const std::vector<int>& rows, const CsvTable& log) {
  const MechanicsBatch mechanics = evaluate_mechanics(system, states, system.parameter_values());
  if (!mechanics.fault) return;
  throw InputError(fmt::format("{}: data row {}: {} ('{}' with the model's parameters; see gp2 check)", log.name(),
                               rows[static_cast<std::size_t>(mechanics.fault->state)] + 1, mechanics.fault->text, system.name()));
}

// σ of each observed row; refused where ε‖K̃‖ ≪ 1 could not hold at signals of the data's size
VectorXd noise_of(const ModelFile& model, const FitProblemOptions& options, const Observations& group, bool estimate) {
  const VectorXd spread = row_stddev(group.values);
  const std::vector<std::string> names = group.view.names(*model.system);
  const std::string source = options.noise_stddev ? "--noise-std" : model.name + ": [noise] ddq";
  VectorXd stddev(group.view.size());
  for (Index k = 0; k < stddev.size(); ++k) {
    const auto row = static_cast<std::size_t>(group.view.rows[static_cast<std::size_t>(k)]);
    const std::string& name = names[static_cast<std::size_t>(k)];
    if (options.noise_stddev) {
      stddev[k] = *options.noise_stddev;
    } else if (!model.noise.stddev.empty()) {
      stddev[k] = model.noise.stddev[row];
    } else if (estimate) {
      stddev[k] = 0.05 * (spread[k] > 0 ? spread[k] : 1);
    } else {
      throw InputError(
          fmt::format("{}: the noise of {} is not known: write [noise] ddq = … in the model, or give --noise-std S or "
                      "--noise-std estimate",
                      model.name, name));
    }
    if (!(stddev[k] > 0) || !std::isfinite(stddev[k])) {
      throw InputError(fmt::format("{}: the noise standard deviation of {} must be positive, got {}", source, name, stddev[k]));
    }
    // ‖K̃‖ ≤ N (signal/noise)²; a hundredth of the digits must be left
    const double smallest =
        spread[k] * std::sqrt(static_cast<double>(group.n_data()) * std::numeric_limits<double>::epsilon() / 0.01);
    if (!estimate && stddev[k] < smallest) {
      throw InputError(
          fmt::format("{}: the noise standard deviation {} of {} is too small for double precision beside a spread "
                      "of {:.3g}; the smallest usable value is {:.2g}",
                      source, stddev[k], name, spread[k], smallest));
    }
  }
  return stddev;
}

}  // namespace

std::vector<int> acceleration_rows(const System& system, const std::vector<std::string>& names, const std::string& option) {
  const std::vector<std::string> known = all_accelerations(system);
  std::vector<int> rows;
  for (const std::string& name : names.empty() ? known : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      throw InputError(fmt::format("{}: '{}' is not an acceleration of '{}'; it has: {}", option, name, system.name(),
                                   fmt::join(known, ", ")));
    }
    const int row = static_cast<int>(found - known.begin());
    if (std::find(rows.begin(), rows.end(), row) != rows.end())
      throw InputError(fmt::format("{}: '{}' stands twice", option, name));
    rows.push_back(row);
  }
  return rows;
}

LogReader open_log(const ModelFile& model, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  check_columns(*model.system, log, columns);
  std::map<std::string, std::string> all = columns;
  all.insert(model.columns.begin(), model.columns.end());
  return {log, *model.system, all};
}

LogStates read_log_states(const Prior& prior, const View& view, const ModelFile& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations) {
  LogReader reader = open_log(model, log, columns);
  LogStates out{states_of(prior, view, reader), reader.values(accelerations), {}};
  note_reading(reader, log, out.notes);
  note_violation(*prior.system, out.states, log, out.notes);
  return out;
}

FitProblem make_fit_problem(const ModelFile& model, const CsvTable& log, const FitProblemOptions& options) {
  const bool paper = options.protocol.name == Protocol::Name::paper;
  if (paper && options.estimate_noise) throw InputError("--protocol paper has fixed noise: leave out --noise-std estimate");
  if (paper && options.base == Latent::Base::force) {
    throw InputError("--protocol paper has its prior on the acceleration: leave out --prior force");
  }
  FitProblem problem;
  problem.prior_options = {options.mean, paper ? std::optional(Latent::Base::acceleration) : options.base, paper};
  problem.prior = make_prior(model, problem.prior_options);
  const System& system = *model.system;

  // the log
  LogReader reader = open_log(model, log, options.columns);
  Observations group;
  group.view = {View::Quantity::constrained_acceleration, acceleration_rows(system, options.observe, "--observe"), 0, -1};
  group.states = states_of(problem.prior, group.view, reader);
  const std::vector<std::string> observed = group.view.names(system);
  const std::vector<std::string> every = all_accelerations(system);
  const bool complete = std::all_of(every.begin(), every.end(), [&](const std::string& name) { return reader.has(name); });
  group.values = reader.values(observed);
  MatrixXd all_values = complete && system.nc() > 0 ? reader.values(every) : MatrixXd();
  note_reading(reader, log, problem.notes);
  note_violation(system, group.states, log, problem.notes);
  if (all_values.size() > 0) {
    const auto independent = dependent_columns(system, group.states, system.parameter_values(), all_values);
    if (independent && observed.size() > independent->size()) {
      std::vector<std::string> names;
      for (int row : *independent) names.push_back(every[static_cast<std::size_t>(row)]);
      problem.notes.push_back(
          fmt::format("warning: {}: the accelerations obey A ddq = b to rounding: they are not {} independent "
                      "measurements but {}; observe independent rows only, say --observe {}",
                      log.name(), every.size(), independent->size(), fmt::join(names, ",")));
    }
  }
  const std::vector<int> rows = chosen_rows(log.n_rows(), options.max_points.value_or(log.n_rows()), options.seed);
  if (static_cast<int>(rows.size()) < log.n_rows()) {
    group.states = MatrixXd(group.states(Eigen::all, rows));
    group.values = MatrixXd(group.values(Eigen::all, rows));
    problem.notes.push_back(fmt::format("{} of {} rows taken, by seed {}", rows.size(), log.n_rows(), options.seed));
  }
  require_mechanics_at(system, group.states, rows, log);

  // noise, and what is tuned
  const bool model_estimates = model.noise.estimate && !options.noise_stddev;
  group.estimate_noise = !paper && (options.estimate_noise || model_estimates);
  group.noise_stddev = noise_of(model, options, group, group.estimate_noise);
  problem.observations.push_back(std::move(group));
  std::vector<std::string> estimate;
  if (options.estimate) {
    estimate = *options.estimate;
  } else {
    for (const Parameter& parameter : system.parameters()) {
      if (parameter.estimate) estimate.push_back(parameter.name);
    }
  }
  problem.hyperparameters = default_hyperparameters(problem.prior, problem.observations, estimate, options.protocol);
  return problem;
}

}  // namespace gp2
