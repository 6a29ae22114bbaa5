#include "gp2/jobs/fit_job.hpp"

#include <algorithm>
#include <cmath>
#include <exception>
#include <iterator>
#include <map>
#include <numeric>
#include <optional>
#include <set>
#include <string_view>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/actuator_fit.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_time.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "inference/cross_validation.hpp"
#include "inference/inducing_summary.hpp"
#include "jobs/doubts.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/repeated_rows.hpp"

namespace gp2 {

void require_in_range(const FitRequest& request) {
  const auto require_positive = [](const char* name, const auto& value) {
    if (value && !(*value > 0)) throw InputError(fmt::format("`{}`: must be positive, got {}", name, *value));
  };
  const auto require_not_negative = [](const char* name, const std::optional<int>& value) {
    if (value && *value < 0) throw InputError(fmt::format("`{}`: must not be negative, got {}", name, *value));
  };
  require_positive("restarts", request.restarts);
  constexpr int most_restarts = 100'000;
  if (request.restarts.value_or(0) > most_restarts) {
    throw InputError(fmt::format("`restarts`: must be at most {}, got {}", most_restarts, *request.restarts));
  }
  require_not_negative("max_iterations", request.max_iterations);
  require_positive("max_points", request.problem.max_points);
  require_positive("train_on", request.train_on);
  require_threads(request.threads);
  const std::optional<double>& noise = request.problem.noise_stddev;
  if (noise && (!(*noise > 0) || !std::isfinite(*noise))) {
    throw InputError(fmt::format("`noise_std`: expected a positive number, 'estimate' or 'stated', got '{}'", *noise));
  }
  require_not_negative("max_escapes", request.max_escapes);
  require_positive("gradient_tolerance", request.gradient_tolerance);
  require_positive("reduction_tolerance", request.reduction_tolerance);
  if (request.inducing &&
      !(*request.inducing >= 1 && *request.inducing <= 1e5 && std::floor(*request.inducing) == *request.inducing)) {
    throw InputError(
        fmt::format("`inducing`: expected a whole number from 1 to 100000, 'auto' or 'none', got '{}'", *request.inducing));
  }
}

namespace {

// The options of the optimiser: those asked for or, where nothing was, those of the problem, which the request then says too.
FitOptions optimiser_options(FitRequest& request, const FitProblem& problem) {
  FitOptions options = default_fit_options(problem);
  const auto settle = [](auto& asked, auto& value) { value = asked.value_or(value), asked = value; };
  settle(request.restarts, options.n_restarts);
  settle(request.max_escapes, options.max_escapes);
  settle(request.gradient_tolerance, options.gradient_tolerance);
  settle(request.reduction_tolerance, options.reduction_tolerance);
  options.max_iterations = request.max_iterations;
  options.seed = request.problem.seed;
  options.n_threads = request.threads;
  options.standard_errors = request.standard_errors;
  options.n_train = request.train_on.value_or(0);
  return options;
}

// The rule of `auto`: the directions of a latent have hyperparameters of their own, as in the default prior, or it is a potential; the
// reduced size is small enough, it is no baseline, and the optimiser runs.
bool integration_pays(const FitProblem& problem, const FitOptions& options) {
  const bool has_many = std::any_of(problem.prior.latents.begin(), problem.prior.latents.end(),
                                    [](const Latent& latent) { return !latent.direction.empty() || latent.is_potential; });
  return has_many && options.max_iterations > 0 && !problem.prior_options.baseline &&
         fit_memory(problem, options).reduced_size <= largest_integrated_size;
}

// How many inducing variables there may be; 0: none, exact.
int settled_inducing(const FitRequest& request, const FitProblem& problem, const FitOptions& options) {
  const bool of_windows = has_sums(problem.observations);
  if (request.train_on && of_windows) {
    throw InputError("`train_on` is not for windows of a raw log: `windows=none` learns from its rows");
  }
  if (request.inducing) {
    if (problem.prior_options.baseline) throw InputError("`inducing` is not for a `baseline`");
    if (of_windows) throw InputError("`inducing` is not for windows of a raw log: `windows=none` learns from its rows");
    const auto most = static_cast<int>(*request.inducing);
    return most < fit_memory(problem, options).reduced_size ? most : 0;  // else it is exact that takes less
  }
  const bool is_possible =
      !problem.prior_options.baseline && !of_windows && request.problem.protocol.name == Protocol::Name::standard;
  if (request.is_exact || !is_possible) return 0;
  return fit_memory(problem, options).reduced_size > largest_exact_size
             ? automatic_inducing_variables(n_states(problem.observations))
             : 0;
}

// How many hyperparameters are drawn.
int settled_draws(const FitRequest& request, const FitProblem& problem, const FitOptions& options) {
  switch (request.hyperparameters) {
    case HyperparameterChoice::optimise:
      return 0;
    case HyperparameterChoice::automatic:
      return options.n_inducing == 0 && integration_pays(problem, options) ? n_mixed_draws : 0;
    case HyperparameterChoice::integrate:
      break;
  }
  if (problem.prior_options.baseline) {
    throw InputError("`hyperparameters=integrate` is not for a `baseline`, whose hyperparameters are optimised");
  }
  if (options.max_iterations == 0) {
    throw InputError("`hyperparameters=integrate` samples around the optimum: leave out `max_iterations=0`");
  }
  return options.n_inducing > 0 ? n_mixed_draws_through_points : n_mixed_draws;
}

std::string source_of(const FitRequest& request) {
  if (!request.data_source.empty()) return request.data_source;
  std::vector<std::string> names;
  for (const Log& log : request.logs) names.push_back(log.table.name());
  for (const SideInformation& one : request.also) names.push_back(one.log.table.name());
  return fmt::format("{}", fmt::join(names, ", "));
}

void take_logs(const FitRequest& request, const std::vector<Observations>& observations, FitFile& file,
               std::vector<std::string>& notes) {
  bool is_known = false;
  for (const Log& log : request.logs) {
    if (!log.table.file()) continue;
    if (file.has_learned(*log.table.file())) {
      is_known = true;
      notes.push_back(fmt::format("warning: {} is already in the fit: its rows count twice", log.table.name()));
    }
    file.logs.push_back(*log.table.file());
  }
  for (const SideInformation& one : request.also) {
    if (one.log.table.file()) file.logs.push_back(*one.log.table.file());
  }
  if (!is_known) note_shared_rows({}, observations, notes);
}

constexpr int rows_of_stretch = 200;

bool is_short(const Observations& group) { return group.n_data() <= 2 * rows_of_stretch; }

// Whether a stretch of a log may tell what its rows are worth.
bool asks_a_stretch(const FitOptions& options, const std::vector<Observations>& observations) {
  return options.max_iterations > 0 && !std::all_of(observations.begin(), observations.end(), is_short);
}

// Under mean zero the constraint forces λ that a latent reads are those of the latents alone, and λ₀ those of a force that does not act.
void note_load_without_force(const FitProblem& problem, std::vector<std::string>& notes) {
  const Prior& prior = problem.prior;
  const auto reads_load = [&](const Latent& one) {
    Prior alone = prior;
    alone.latents = {one};
    return reads_loads(alone);
  };
  auto latent = std::ranges::find_if(prior.latents, &Latent::reads_multipliers);
  if (latent == prior.latents.end()) latent = std::ranges::find_if(prior.latents, reads_load);
  if (prior.mean != Prior::Mean::zero || latent == prior.latents.end()) return;
  const Eigen::VectorXd parameters = model_values(prior, problem.observations, problem.hyperparameters).parameters;
  const auto has_force = [&](const Observations& group) {
    return !group.view().other_system && !prior.system->evaluate(group.states(), parameters).force.isZero(0);
  };
  if (std::ranges::none_of(problem.observations, has_force)) return;
  notes.push_back(
      fmt::format("warning: {} reads constraint forces ({}), but the known force of [mechanics], which causes them, is not "
                  "used: fit with `mean=force`, unless other latents are to learn that force",
                  latent->name, latent->reads_multipliers() ? "lambda" : "lambda0"));
}

// Start values that were given for other rows, within the bounds that these give.
void clamp_start(FitRequest& request, const std::vector<Hyperparameter>& hyperparameters) {
  for (const Hyperparameter& h : hyperparameters) {
    const auto start = request.start.values.find(h.name);
    if (start == request.start.values.end() || request.max_iterations == 0) continue;
    start->second = std::clamp(start->second, h.lower, h.upper);
  }
}

// What both kinds of preparation end with.
FitJob job_of(FitRequest request, FitProblem problem) {
  // a file of starting values may change: the record has the values
  if (!request.start.empty()) {
    read_start(request.start, request.max_iterations, request.model.actuators, problem);
    request.start.file.clear();
    for (const Hyperparameter& h : problem.hyperparameters) request.start.values[h.name] = h.value;
    for (const Parameter& late : problem.late) request.start.values[late.name] = late.value;
  }
  FitJob job;
  job.checkpoint = request.checkpoint;
  FitOptions asked = optimiser_options(request, problem);
  asked.n_inducing = settled_inducing(request, problem, asked);
  asked.n_draws = settled_draws(request, problem, asked);
  job.notes = problem.notes;
  note_load_without_force(problem, job.notes);
  job.thin = request.thin && !has_sums(problem.observations) && !problem.robust &&
             request.problem.protocol.name == Protocol::Name::standard;
  job.file.options = options_json(options(request));
  try {
    job.options = within_memory(problem, asked, free_memory(), job.notes);
    note_time(problem, job.options, fit_memory(problem, job.options).reduced_size, job.notes);
  } catch (const InputError& error) {
    if (!job.thin || !asks_a_stretch(asked, problem.observations)) throw;
    job.options = asked;
    job.unaffordable = error.what();
  }
  job.file.prior_options = problem.prior_options;
  job.file.systems = problem.systems;
  job.file.data_source = source_of(request);
  take_logs(request, problem.observations, job.file, job.notes);
  job.file.model = std::move(request.model);
  job.problem = std::move(problem);
  return job;
}

// Of many states every k-th is kept; their numbers and lines are those of the log.
TrustedData trusted_data(const Posterior& posterior, const FitReport& report, const std::vector<std::vector<int>>& lines = {}) {
  TrustedData trusted{posterior.observations(), {}};
  const std::shared_ptr<const InducingSummary> summary = posterior.summary();
  const int step = summary ? summary->kept.step : 1;
  for (const std::vector<int>& of_log : lines) {
    std::vector<int>& kept = trusted.lines.emplace_back();
    for (std::size_t i = 0; i < of_log.size(); i += static_cast<std::size_t>(step)) kept.push_back(of_log[i]);
  }
  for (std::size_t g = 0; g < trusted.observations.size(); ++g) {
    Eigen::MatrixXd values = trusted.observations[g].values();
    for (const DistrustedValue& one : report.distrusted) {
      const bool is_kept = one.group == static_cast<int>(g) && one.state % step == 0 && one.state / step < values.cols();
      if (is_kept) values(one.row, one.state / step) = not_a_number;
    }
    if (!report.distrusted.empty()) trusted.observations[g] = trusted.observations[g].with_values(std::move(values));
  }
  return trusted;
}

// What residuals say of how many rows are worth one measurement.
struct Worth {
  std::vector<int> rows;  // of each Observations
  std::string text;       // which residuals say so
  double left = 0;        // the largest correlation of residuals of the rows kept, where more are not left out

  // As many rows as it takes for correlated residuals to forget, but not so many that hardly any are left.
  Worth(const std::vector<TrainingResidual>& residuals, const FitProblem& problem)
      : rows(problem.observations.size(), 1),
        text((last_beyond_noise(residuals) ? "warning: " : "") +
             correlated_text(residuals, problem.prior_options.baseline.has_value())) {
    const std::vector<Observations>& observations = problem.observations;
    constexpr double forgotten = 0.3;
    constexpr int fewest = 40;  // of all logs together
    int n_rows = 0;
    for (const Observations& group : observations) n_rows += group.view().is_of_ddq() ? group.n_data() : 0;
    for (const TrainingResidual& one : residuals) {
      if (!one.is_correlated()) continue;
      // each log keeps a row at least
      const int most = std::max(1, std::min(n_rows / fewest, observations[one.group].n_data()));
      const double needed = std::ceil(std::log(forgotten) / std::log(std::min(one.serial_correlation, 0.999)));
      rows[one.group] = std::max(rows[one.group], std::min(most, static_cast<int>(needed)));
      if (needed > most) left = std::max(left, std::pow(one.serial_correlation, most));
    }
    if (left > 0 && !text.starts_with("warning: ")) text = "warning: " + text;
  }
  [[nodiscard]] bool is_less() const {
    return std::any_of(rows.begin(), rows.end(), [](int n) { return n > 1; });
  }
};

// How a checkpoint ended that was written without all rows.
constexpr const char* has_some_rows = "interrupted, with some of the rows";

// The best so far, with the rows that it was found from: of many as many as any file of a fit has.
void save_checkpoint(const FitJob& job, const FitReport& report, const std::vector<Observations>& observations) {
  FitFile file = job.file;
  file.observations = n_states(observations) > KeptStates::most ? evenly(observations, KeptStates::most) : observations;
  file.report = report;
  file.notes.reset();
  file.report.actuators = job.actuators;
  if (n_states(file.observations) < n_states(job.problem.observations)) file.report.termination = has_some_rows;
  file.write(job.checkpoint);
}

// A fit that fails where single values are far off fails for them more often than for what it says.
Fit fit_and_name_gross_errors(const FitProblem& problem, const FitOptions& options) {
  try {
    return fit(problem, options);
  } catch (const NumericalError& error) {
    const std::string text = problem.robust || is_set(options.stop) ? "" : gross_errors_text(problem);
    if (text.empty()) throw;
    throw NumericalError(fmt::format("{}; the reason may be that {}", error.what(), text));
  }
}

// Tests of a fit, each by itself: a fit that has taken hours is not lost to what is said of it, nor one test to another.
class Tests {
 public:
  template <typename Test>
  void run(const char* subject, const Test& test) {
    try {
      test();
    } catch (const std::exception& error) {
      untested_[error.what()].emplace_back(subject);
    }
  }
  /// What could not be tested, by the reason.
  void add_notes(std::vector<std::string>& notes) const {
    for (const auto& [reason, subjects] : untested_)
      notes.push_back(fmt::format("warning: tests of the fit failed, of {}: {}", fmt::join(subjects, ", "), reason));
  }

 private:
  std::map<std::string, std::vector<std::string>> untested_;
};

// A fit, and which of its notes what fewer or more of the rows say may replace.
struct FitRun : FitOutcome {
  Doubts doubts = {};
};

// Estimated parameters that a bound or a prior holds rather than the data.
std::vector<std::string> held_parameters(const FitReport& report) {
  constexpr double most = 0.7;  // of the deviation of a prior, where the data tell of the parameter
  std::vector<std::string> held;
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    if (!h.is_system_parameter() || h.is_fixed()) continue;
    bool is_held = h.at_bound();
    if (report.uncertainty && h.hyperprior.form != HyperPrior::Form::none) {
      const double scale = h.hyperprior.form == HyperPrior::Form::normal ? 1 : std::abs(h.value);
      is_held |= report.uncertainty->stddev[static_cast<Eigen::Index>(k)] > most * scale * h.hyperprior.stddev;
    }
    if (is_held) held.push_back(h.name);
  }
  return held;
}

// Scores of what is left out, and what residuals and data say of the fit.
void add_tests(const FitJob& job, const FitOptions& options, FitReport& report, FitRun& outcome) {
  const Posterior& posterior = outcome.posterior;
  std::vector<std::string>& notes = outcome.notes;
  std::optional<CrossValidation>& scores = outcome.cross_validation;
  const TrustedData trusted = trusted_data(posterior, report, job.problem.lines);
  Tests tests;
  tests.run("the use of the known force", [&] { add_force_note(posterior, notes); });
  tests.run("the constraints", [&] { add_constraint_note(posterior, notes); });
  tests.run("the windows", [&] { add_window_note(posterior, notes); });
  tests.run("the values left out", [&] { scores = cross_validate(posterior, trusted.observations, /*has_time_order=*/true); });
  if (scores && report.inducing) report.inducing->stretches = scores->stretches;
  if (report.iterations > 0) tests.run("the noise", [&] { add_noise_notes(posterior, notes); });
  const auto add_notes_of_residuals = [&] {
    const bool is_paper = request_of(job.file).problem.protocol.name == Protocol::Name::paper;
    add_residual_notes(posterior, trusted, scores->residuals, notes, is_paper);
  };
  if (scores) tests.run("the residuals", add_notes_of_residuals);
  tests.run("values at the ends of a range", [&] { add_pile_up_notes(trusted.observations, *posterior.prior().system, notes); });
  if (scores) tests.run("the stretches", [&] { add_stretch_note(*scores, notes, posterior.prior()); });
  FitOptions quick;
  quick.n_restarts = 1;
  quick.max_iterations = 50;
  quick.max_escapes = 0;
  quick.standard_errors = false;
  quick.n_threads = options.n_threads;
  quick.stop = options.stop;
  const FittedValues fitted_values = [&](const std::vector<Observations>& some) {
    return fit(job.problem.prior, some, job.problem.hyperparameters, quick).posterior.values();
  };
  tests.run("the inputs and the logs", [&] {
    outcome.doubts =
        add_doubts(posterior, trusted.lines, held_parameters(report), fitted_values, job.problem.has_wrong_rate, notes);
  });
  const std::string correlated = scores ? correlated_text(scores->residuals, job.problem.prior_options.baseline.has_value()) : "";
  if (!correlated.empty()) notes.push_back(fmt::format("warning: {}: standard deviations are too small", correlated));
  tests.add_notes(notes);
}

// Accelerations say nothing of what acts in impacts alone.
void explain_restitution(const Model& model, std::vector<std::string>& notes) {
  const SymbolicSystem* const system = model.symbolic_system();
  if (system == nullptr) return;
  for (const ConstraintRow& row : system->definition().constraints) {
    if (!row.contact) continue;
    for (const std::string& name : model.graph->variables_of(row.contact->restitution)) {
      const std::string begin = fmt::format("warning: the data do not determine {}.", name);
      if (std::erase_if(notes, [&](const std::string& note) { return note.starts_with(begin); }) > 0)
        notes.push_back(fmt::format("the data do not determine {}, which acts in impacts alone: gp2 shoot estimates it", name));
    }
  }
}

FitRun run_once(const FitJob& job, const std::function<void(const Progress&)>& progress, const std::atomic<bool>* stop) {
  FitOptions options = job.options;
  options.progress = progress;
  options.stop = stop;
  std::string unsaved;  // why
  const bool is_first = !options.ranks || options.ranks->rank() == 0;
  if (!job.checkpoint.empty() && is_first) {
    options.improved = [&](const FitReport& report, const std::vector<Observations>& observations) {
      try {
        save_checkpoint(job, report, observations);
        unsaved.clear();
      } catch (const InputError& error) {
        unsaved = error.what();  // a fit is not lost to a disk that is full for a while
      }
    };
  }
  Fit result = fit_and_name_gross_errors(job.problem, options);
  FitRun outcome{{job.file, std::move(result.posterior), distrust_notes(job.problem, result.report), std::nullopt}};
  if (!unsaved.empty()) outcome.notes.push_back(fmt::format("warning: a checkpoint was not saved: {}", unsaved));
  for (std::string& note : notes_of(result.report, outcome.posterior)) outcome.notes.push_back(std::move(note));
  explain_restitution(job.file.model, outcome.notes);
  if (result.report.inducing) add_inducing_note(*result.report.inducing, outcome.notes);
  const bool is_once = result.report.inducing && result.report.inducing->n_start == 0 && result.report.restarts.size() == 1;
  if (is_once && options.n_restarts > 1 && options.max_iterations > 0) {
    outcome.notes.push_back(
        "through inducing points so few rows are fitted from one start, the model's values, and `restarts` are not used; exact "
        "(`inducing=none`) they are");
  }
  if (const int n_all = n_states(job.problem.observations);
      options.n_train > 0 && options.n_train < n_all && options.max_iterations > 0) {
    outcome.notes.push_back(
        fmt::format("hyperparameters and estimated parameters come from {} of {} rows (`train_on`): standard deviations may be "
                    "too small; more rows, or all, are better",
                    options.n_train, n_all));
  }
  if (result.report.termination != FitReport::interrupted && !is_set(stop)) {
    if (options.n_draws > 0) add_draw_notes(result.report, outcome.notes);
    add_tests(job, options, result.report, outcome);
  }
  if (options.max_iterations > 0) {
    for (std::string& note : actuator_notes(job.actuators)) outcome.notes.push_back(std::move(note));
  }
  outcome.file.report = std::move(result.report);
  outcome.file.take_data(outcome.posterior);
  outcome.file.report.actuators = job.actuators;
  return outcome;
}

// The job with its delays and lags estimated, and known from then on.
FitJob with_actuators(FitJob job, const std::atomic<bool>* stop) {
  if (job.problem.late.empty()) return job;
  std::map<std::string, double> values;
  if (job.options.max_iterations > 0) {
    FitOptions options = job.options;
    options.stop = stop;
    job.actuators = estimate_actuators(job.problem, options);
    for (const ActuatorEstimate& one : job.actuators) values.emplace(one.name, one.value);
  } else {
    for (const Parameter& late : job.problem.late) {
      const auto [lower, upper] = Actuator::bounds(late);
      job.actuators.push_back({late.name, late.value, not_a_number, lower, upper});
      values.emplace(late.name, late.value);
    }
  }
  set_values(values, job.file.model.actuators);
  FitProblem& problem = job.problem;
  for (std::size_t g = 0; g < problem.observations.size(); ++g) {
    if (problem.commanded[g]) problem.observations[g] = problem.commanded[g]->under(values, problem.observations[g]);
  }
  problem.late.clear();
  // hyperparameters start anew, by the spread of what acts
  FitRequest request = request_of(job.file);
  problem.hyperparameters = starting_hyperparameters(job.file.model, problem, request.problem);
  for (const auto& [name, value] : values) request.start.values.erase(name);
  clamp_start(request, problem.hyperparameters);
  if (!request.start.empty()) read_start(request.start, request.max_iterations, job.file.model.actuators, problem);
  return job;
}

// The file with some of the states of each of its Observations.
template <typename States>
FitFile with_states(FitFile file, const std::vector<Observations>& all, const States& states_of) {
  file.observations.clear();
  for (std::size_t g = 0; g < all.size(); ++g) file.observations.push_back(all[g].take(states_of(g)));
  return file;
}

FitRun run_for_what_rows_are_worth(const FitJob& job, const std::function<void(const Progress&)>& progress,
                                   const std::atomic<bool>* stop);

// The fit to every k-th row.
FitRun run_thinned(const FitJob& job, const Worth& worth, const std::function<void(const Progress&)>& progress,
                   const std::atomic<bool>* stop) {
  const std::vector<Observations>& all = job.problem.observations;
  int n_all = 0, n_taken = 0;
  std::vector<std::vector<int>> lines(all.size());
  const FitFile file = with_states(job.file, all, [&](std::size_t g) {
    std::vector<int> taken;
    for (int i = worth.rows[g] / 2; i < all[g].n_data(); i += worth.rows[g]) {
      taken.push_back(i);
      if (!job.problem.lines[g].empty()) lines[g].push_back(job.problem.lines[g][static_cast<std::size_t>(i)]);
    }
    n_all += all[g].n_data();
    n_taken += static_cast<int>(taken.size());
    return taken;
  });
  FitJob fewer = prepare_fit_again(file, job.options.n_threads);
  fewer.problem.lines = std::move(lines);
  fewer.actuators = job.actuators;
  fewer.problem.has_wrong_rate = job.problem.has_wrong_rate;
  fewer.options.ranks = job.options.ranks;
  fewer.checkpoint = job.checkpoint;
  FitRun outcome = run_for_what_rows_are_worth(fewer, progress, stop);
  std::string text;
  if (worth.left > 0) {
    text = fmt::format(
        ". More are not left out, so that enough remain: their errors are probably still correlated by about {:.2g}, "
        "and standard deviations too small by a factor of up to {:.2g}",
        worth.left, std::sqrt((1 + worth.left) / (1 - worth.left)));
  }
  outcome.notes.push_back(
      fmt::format("{}: fitted to {} of {}, evenly spaced (`thin=none` fits all){}", worth.text, n_taken, n_all, text));
  std::rotate(outcome.notes.begin(), outcome.notes.end() - 1, outcome.notes.end());
  return outcome;
}

// What a stretch of a long log says, before all of it is fitted at the cost of N³; nothing of a short one.
std::optional<Worth> worth_of_stretch(const FitJob& job, const std::atomic<bool>* stop) {
  const std::vector<Observations>& all = job.problem.observations;
  if (!asks_a_stretch(job.options, all)) return std::nullopt;
  const FitFile file = with_states(job.file, all, [&](std::size_t g) {
    const int n = all[g].n_data(), n_taken = is_short(all[g]) ? n : rows_of_stretch;
    std::vector<int> stretch(static_cast<std::size_t>(n_taken));
    std::iota(stretch.begin(), stretch.end(), (n - n_taken) / 2);
    return stretch;
  });
  FitJob quick = prepare_fit_again(file, job.options.n_threads);
  quick.options.n_restarts = 1;
  quick.options.n_draws = quick.options.max_escapes = 0;
  quick.options.standard_errors = false;
  const FitOutcome outcome = run_once(quick, {}, stop);
  if (!outcome.cross_validation) return std::nullopt;
  return Worth(outcome.cross_validation->residuals, job.problem);
}

// What all rows say takes the place of what fewer of them say of the same: notes that begin alike.
void take_notes_of_all(std::vector<std::string> of_all, std::vector<std::string>& notes) {
  const auto subject = [](const std::string& note) {
    const std::size_t begin = note.starts_with("warning: ") ? std::string_view("warning: ").size() : 0;
    return note.substr(begin, note.find(": ", begin) - begin);
  };
  std::set<std::string> known;
  for (const std::string& note : of_all) known.insert(subject(note));
  std::erase_if(notes, [&](const std::string& note) { return known.contains(subject(note)); });
  notes.insert(notes.begin(), std::make_move_iterator(of_all.begin()), std::make_move_iterator(of_all.end()));
}

// The fit to all rows, in place of one to fewer that was stopped.
FitRun interrupted(FitRun all) {
  all.file.report.termination = FitReport::interrupted;
  all.file.report.converged = false;
  return all;
}

FitRun run_for_what_rows_are_worth(const FitJob& job, const std::function<void(const Progress&)>& progress,
                                   const std::atomic<bool>* stop) {
  if (!job.thin) return run_once(job, progress, stop);
  std::optional<FitRun> all;
  try {
    const std::optional<Worth> before = worth_of_stretch(job, stop);
    if (before && before->is_less()) return run_thinned(job, *before, progress, stop);
    if (!job.unaffordable.empty()) throw InputError(job.unaffordable);
    all = run_once(job, progress, stop);
    if (!all->cross_validation) return *all;
    const Worth worth(all->cross_validation->residuals, job.problem);
    const TrustedData trusted = trusted_data(all->posterior, all->file.report, job.problem.lines);
    // that a constraint does not hold is no error that lasts
    if (!worth.is_less() || denies_constraints(all->posterior, trusted)) return *all;
    FitRun fewer = run_thinned(job, worth, progress, stop);
    if (fewer.file.report.termination == FitReport::interrupted) return interrupted(*std::move(all));
    std::vector<std::string> notes;
    add_residual_notes(all->posterior, trusted, all->cross_validation->residuals, notes);
    // rows that are left out tell of no delay that is shorter than what lies between the others
    const std::vector<std::string>& delays = all->doubts.delays;
    notes.insert(notes.end(), delays.begin(), delays.end());
    if (!delays.empty()) std::erase(fewer.notes, fewer.doubts.unexplained);
    take_notes_of_all(std::move(notes), fewer.notes);
    return fewer;
  } catch (const Error& error) {
    if (!job.unaffordable.empty()) throw;
    if (all && is_set(stop)) return interrupted(*std::move(all));
    if (!all) all = run_once(job, progress, stop);
    if (!is_set(stop))
      all->notes.push_back(fmt::format("fitted to all rows, because the fit to fewer rows failed: {}", error.what()));
    return *all;
  }
}

std::vector<Option> options_of_data(FitRequest& request) {
  FitProblemOptions& problem = request.problem;
  return in_group(
      "Data",
      {
          {"also_noise_std", &problem.also_noise_stddev, "S", "noise standard deviation of the values in `also`",
           "for accelerations: the model's [noise]"},
          {"dt", &problem.time_step, "SECONDS", "time step of next velocities in `also` [s]"},
          columns_option(problem.columns, "columns by other names, in all logs; theta1=q3 also maps dtheta1 and ddtheta1"),
          {"observe", &problem.observe, "ddq3,ddq6", "accelerations to learn from; others need not be in the log",
           "those with a column NAME_std in the log, or all"},
          {"noise_std",
           NumberOrWord{&problem.noise_stddev, {{"estimate", &problem.estimate_noise}, {"stated", &problem.trust_stated_noise}}},
           "S", "noise standard deviation of every observed ddq; estimate: estimate it; stated: use the log's NAME_std unchanged",
           "the log's NAME_std times an estimated factor, else the model's [noise]"},
          {"max_points", &problem.max_points, "N",
           "maximum number of rows per log, chosen at random by `seed`; of a raw log those that cover the motion best, or "
           "the number of states with windows",
           "all; raw log: 200, or 600 with windows"},
          {"thin", Switch{&request.thin, "auto", "none"}, "",
           "what to do if residuals are correlated from row to row; auto: refit to every k-th row, so that they are nearly "
           "uncorrelated; none: keep all rows"},
          {"project", &problem.project, "",
           "first project states onto the position and velocity constraints, with the model's parameter values"},
          {"robust", &problem.robust, "", "give outliers a larger noise, and list them (docs/command-line.md)"},
      });
}

std::vector<Option> options_of_prior(FitProblemOptions& problem) {
  return in_group(
      "What is learned",
      {
          {"mean", choice(problem.mean, {{"zero", Prior::Mean::zero}, {"force", Prior::Mean::force}}), "",
           "prior mean of the unconstrained acceleration; force: M⁻¹F of the model"},
          {"prior", choice(problem.base, {{"acceleration", Latent::Base::acceleration}, {"force", Latent::Base::force}}), "",
           "whether the model's latent acts on accelerations or forces", "as in the model"},
          {"baseline",
           choice(problem.baseline, {{"se", Baseline::Kind::se}, {"icm", Baseline::Kind::icm}, {"lmc", Baseline::Kind::lmc}}), "",
           "learn ddq without mechanics (docs/priors.md), from the features and all state entries that the model reads; se: "
           "independent outputs; icm, lmc: multi-output"},
          {"estimate", &problem.estimate, "p1,p2", "parameters to estimate; `estimate=none`: none", "those marked in the model"},
          {"protocol", choice(problem.protocol.name, {{"default", Protocol::Name::standard}, {"paper", Protocol::Name::paper}}),
           "", "initial values and bounds of hyperparameters (docs/priors.md); paper: as in Geist & Trimpe 2020"},
          {"hyperprior", Switch{&problem.protocol.hyperprior, "default", "none"}, "",
           "hyper-priors; default: weak, log-normal; none: maximum likelihood within the same bounds"},
          {"discrepancy", Switch{&problem.discrepancy, "default", "none"}, "",
           "whether to add a small latent for effects that the kernels cannot represent (docs/priors.md)"},
      });
}

std::vector<Option> options_of_training(FitRequest& request) {
  FitProblemOptions& problem = request.problem;
  return in_group(
      "How it is learned",
      {
          {"restarts", &request.restarts, "R", "number of optimiser runs; the first starts at the model's values",
           "5; baseline: 30"},
          {"max_iterations", &request.max_iterations, "K",
           "maximum iterations per run, including those after an escape; 0: no optimisation, condition at the starting "
           "values"},
          {"max_escapes", &request.max_escapes, "K",
           "maximum number of escapes: scans for a lower optimum that start at the best one", "5"},
          {"gradient_tolerance", &request.gradient_tolerance, "G",
           "stop when the largest entry of the projected gradient is below this", "1e-5"},
          {"reduction_tolerance", &request.reduction_tolerance, "R",
           "stop when the relative reduction of the objective in an iteration is below this", "1e-12; baseline: 1e-9"},
          {"start", &request.start, "FILE", "starting values: a JSON file {\"name\": value, …} or a FIT.json"},
          {"seed", &problem.seed, "S", "random seed of restarts and `max_points`"},
          {"hyperparameters",
           choice(request.hyperparameters, {{"optimise", HyperparameterChoice::optimise},
                                            {"integrate", HyperparameterChoice::integrate},
                                            {"auto", HyperparameterChoice::automatic}}),
           "",
           fmt::format(
               "point estimate or posterior of the hyperparameters; optimise: the most probable values; integrate: sample "
               "the posterior and mix the predictions of {} draws (docs/theory.md, T31), {} with inducing points, at about "
               "{} evaluations of the likelihood; auto: integrate if a latent has lengthscales per direction, as in the "
               "default prior, or is a potential, and rows times degrees of freedom are at most {}",
               n_mixed_draws, n_mixed_draws_through_points, draw_evaluations, largest_integrated_size)},
          {"standard_errors", YesByDefault{&request.standard_errors}, "",
           "standard errors of estimated parameters, which cost a few dozen gradients"},
          {"inducing", NumberOrWord{&request.inducing, {{"auto", &request.is_exact_where_small}, {"none", &request.is_exact}}},
           "M",
           fmt::format("maximum number of inducing variables, each one function of a latent at one point (docs/theory.md, "
                       "T37); the time is proportional to the number of rows. none: exact; auto: exact up to {} rows times "
                       "degrees of freedom, beyond that at most {} variables, fewer for more than 100 000 rows",
                       largest_exact_size, most_inducing_variables),
           "auto"},
          {"train_on", &request.train_on, "N",
           "find hyperparameters and parameters from N rows, evenly spaced over all logs together, then condition on all "
           "rows; fast, but standard deviations may be too small",
           "all rows"},
          threads_option(request.threads),
          not_recorded({"checkpoint", &request.checkpoint, "FILE",
                        "FIT.json with the best result so far, rewritten after each run that improves it and every few "
                        "seconds during such a run; resume with `start` (docs/command-line.md)",
                        "none"}),
      });
}

}  // namespace

int automatic_inducing_variables(std::int64_t n_rows) {
  constexpr double work = 1e11;  // N M²
  return static_cast<int>(std::min<double>(most_inducing_variables, std::sqrt(work / static_cast<double>(n_rows))));
}

std::vector<Option> options(FitRequest& request) {
  return joined({options_of_data(request), options_of_prior(request.problem), options_of_training(request)});
}

void require_use_of_commands(const FitRequest& request) {
  if (!request.problem.commands) return;
  const std::vector<std::string> estimated = request.problem.estimate.value_or(std::vector<std::string>());
  const auto is_asked_for = [&](const Parameter& one) { return one.estimate || std::ranges::count(estimated, one.name) > 0; };
  const auto has_late = [&](const Model& model) {
    return std::ranges::any_of(model.actuators, [&](const Actuator& one) {
      return !one.is_direct() || is_asked_for(one.delay) || is_asked_for(one.lag);
    });
  };
  const auto is_of_late = [&](const Log& log) { return log.model != nullptr && has_late(*log.model); };
  const bool is_late = has_late(request.model) || std::ranges::any_of(request.logs, is_of_late) ||
                       std::ranges::any_of(request.also, [&](const SideInformation& one) { return is_of_late(one.log); });
  if (!is_late) throw InputError("`commands`: no input of the model acts late: leave it out");
}

FitJob prepare_fit(FitRequest request) {
  require_in_range(request);
  FitProblem problem = make_fit_problem(request.model, request.logs, request.also, request.problem);
  return job_of(std::move(request), std::move(problem));
}

FitRequest request_of(const FitFile& fit) {
  if (fit.options.empty()) {
    throw InputError("the file does not contain the options of the fit: it is older than format 6; fit again");
  }
  FitRequest request;
  request.model = fit.model;
  request.data_source = fit.data_source;
  // what formats before 7 do not say, and gp2 did not do then
  request.hyperparameters = HyperparameterChoice::optimise;
  request.thin = false;
  read_options(fit.options, options(request), "options of the fit");
  return request;
}

FitJob prepare_fit_again(const FitFile& fit, int threads) {
  FitRequest request = request_of(fit);
  request.threads = threads;
  require_in_range(request);
  if (request.problem.robust) {
    throw InputError("`again`: the file of a robust fit has changed noise in its data; give its logs with `data`");
  }
  const std::vector<std::int64_t> n = fit.n_states();
  const std::int64_t n_all = std::accumulate(n.begin(), n.end(), std::int64_t{0});
  if (n_all > n_states(fit.observations)) {
    throw InputError(
        fmt::format("`again`: the file contains sums over {} rows, and only {} of the rows; give its logs with `data`: {}", n_all,
                    n_states(fit.observations), fit.data_source));
  }
  if (fit.report.termination == has_some_rows) {
    throw InputError(
        fmt::format("`again`: the checkpoint contains only some of the rows; give its logs with `data`: {}", fit.data_source));
  }
  FitProblem problem;
  problem.prior_options = fit.prior_options;
  problem.prior = fit.prior();
  for (std::size_t g = 0; g < fit.observations.size(); ++g) {
    if (fit.observations[g].n_data() == 0) continue;  // all of which a window has left behind
    problem.observations.push_back(fit.observations[g]);
    problem.systems.push_back(g < fit.systems.size() ? fit.systems[g] : nullptr);
  }
  problem.lines.resize(problem.observations.size());
  problem.hyperparameters = starting_hyperparameters(fit.model, problem, request.problem);
  clamp_start(request, problem.hyperparameters);
  FitJob job = job_of(std::move(request), std::move(problem));
  job.file.logs = fit.logs;
  job.file.notes = fit.notes;
  job.actuators = fit.report.actuators;
  return job;
}

FitJob prepare_fit_again(const FitFile& fit, FitRequest request) {
  const auto side_information =
      std::ranges::find_if(fit.observations, [](const Observations& group) { return !group.view().is_of_ddq(); });
  if (request.also.empty() && side_information != fit.observations.end()) {
    throw InputError(fmt::format("`again`: the fit learned from {} too: give it with `also={}:FILE.csv`",
                                 side_information->view().quantity->word(), side_information->view().quantity->word()));
  }
  FitJob job = prepare_fit(std::move(request));
  // arrays alone have no file to compare with
  if (std::ranges::all_of(fit.logs, [](const LogFile& log) { return log.checksum.empty(); })) return job;
  for (const LogFile& log : job.file.logs) {
    if (fit.has_learned(log)) continue;
    const auto named = std::ranges::find(fit.logs, log.name, &LogFile::name);
    job.notes.push_back(named == fit.logs.end()
                            ? fmt::format("warning: {} is not a log of the fit", log.name)
                            : fmt::format("warning: {} has changed since the fit: now {} bytes, {} rows; then {} bytes, {} rows",
                                          log.name, log.bytes, log.rows, named->bytes, named->rows));
  }
  for (const LogFile& log : fit.logs) {
    if (log.checksum.empty()) continue;  // rows of arrays
    if (!job.file.has_learned(log) && std::ranges::find(job.file.logs, log.name, &LogFile::name) == job.file.logs.end()) {
      job.notes.push_back(fmt::format("warning: {}, a log of the fit, is not given", log.name));
    }
  }
  return job;
}

CrossValidation cross_validate(const FitFile& fit, const Posterior& posterior) {
  CrossValidation scores =
      cross_validate(posterior, trusted_data(posterior, fit.report).observations, /*has_time_order=*/!fit.options.empty());
  if (!scores.stretches && fit.report.inducing) scores.stretches = fit.report.inducing->stretches;
  return scores;
}

FitOutcome run_fit(const FitJob& job, const std::function<void(const Progress&)>& progress, const std::atomic<bool>* stop) {
  FitOutcome outcome = run_for_what_rows_are_worth(with_actuators(job, stop), progress, stop);
  // what the model lacks from the start explains what its residuals say
  if (const std::optional<std::string> note = note_of_unlearnable_force(job.problem.prior)) {
    std::erase(outcome.notes, *note);
    outcome.notes.insert(outcome.notes.begin(), *note);
  }
  // a fit again from its file keeps what was said with the logs at hand
  outcome.file.notes = job.file.notes.value_or(outcome.notes);
  if (!outcome.cross_validation) outcome.file.notes.reset();
  return outcome;
}

}  // namespace gp2
