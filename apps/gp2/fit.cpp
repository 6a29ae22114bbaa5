#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>

#include <unistd.h>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "interruption.hpp"

namespace gp2::command {

namespace {

using Eigen::Index;
using Json = nlohmann::ordered_json;

struct Arguments {
  std::string model, map, observe, mean = "zero", prior, baseline, noise, protocol = "default", hyperprior = "default",
                                   discrepancy = "default", start, output;
  std::vector<std::string> data, also;
  std::optional<double> also_noise, time_step;
  std::optional<std::string> estimate;
  std::optional<int> restarts;
  int max_iterations = 1000, threads = 0;
  std::optional<int> max_points;
  std::uint64_t seed = 0;
  bool project = false, robust = false, json = false, no_standard_errors = false;
};

FitProblemOptions problem_options(const Arguments& arguments) {
  FitProblemOptions options;
  options.columns = parse_map(arguments.map);
  options.observe = parse_list(arguments.observe);
  options.mean = arguments.mean == "force" ? Prior::Mean::force : Prior::Mean::zero;
  if (!arguments.prior.empty()) options.base = arguments.prior == "force" ? Latent::Base::force : Latent::Base::acceleration;
  if (!arguments.baseline.empty()) options.baseline = Baseline::kind_of(arguments.baseline);
  if (arguments.estimate) {
    options.estimate = *arguments.estimate == "none" ? std::vector<std::string>{} : parse_list(*arguments.estimate);
  }
  if (arguments.noise == "estimate") {
    options.estimate_noise = true;
  } else if (arguments.noise == "stated") {
    options.trust_stated_noise = true;
  } else if (!arguments.noise.empty()) {
    double value = 0;
    if (!CLI::detail::lexical_cast(arguments.noise, value) || !(value > 0) || !std::isfinite(value)) {
      throw InputError(fmt::format("--noise-std: expected a positive number, 'estimate' or 'stated', got '{}'", arguments.noise));
    }
    options.noise_stddev = value;
  }
  options.protocol.name = arguments.protocol == "paper" ? Protocol::Name::paper : Protocol::Name::standard;
  options.protocol.hyperprior = arguments.hyperprior == "default";
  options.discrepancy = arguments.discrepancy == "default";
  options.max_points = arguments.max_points;
  options.also_noise_stddev = arguments.also_noise;
  options.time_step = arguments.time_step;
  options.seed = arguments.seed;
  options.project = arguments.project;
  options.robust = arguments.robust;
  return options;
}

// LOG or LOG@OTHER.toml
Log read_log(const std::string& text) {
  const auto [path, model] = split_at_system(text);
  return {CsvTable::read(path, CsvTable::Keep::numbers),
          model.empty() ? nullptr : std::make_shared<const Model>(Model::read(model))};
}

// VIEW:LOG or VIEW@LATENT:LOG
SideInformation read_knowledge(const std::string& text) {
  const std::size_t colon = text.find(':');
  const std::string view = text.substr(0, std::min(colon, text.size()));
  const std::size_t at = view.find('@');
  const std::optional<View::Quantity> quantity = View::Quantity::of_word(view.substr(0, at));
  if (colon == std::string::npos || !quantity) {
    throw InputError(fmt::format("--also: '{}' is not VIEW:FILE.csv or VIEW@LATENT:FILE.csv with VIEW one of {}", text,
                                 fmt::join(View::Quantity::words(), ", ")));
  }
  return {*quantity, at == std::string::npos ? "" : view.substr(at + 1), read_log(text.substr(colon + 1))};
}

// one line that rewrites itself, on a terminal only, ten times a second
void print_progress(const Progress& p) {
  static double last = -1;
  if (last >= 0 && p.seconds - last < 0.1) return;
  last = p.seconds;
  const double left = p.fraction > 0 ? p.seconds * (1 - p.fraction) / p.fraction : 0;
  fmt::print(stderr, "\rgp2: restart {}/{}  iteration {}  best {:.4f}  about {:.0f} s left   ", p.restart + 1, p.n_restarts,
             p.iteration, p.best, left);
  std::fflush(stderr);
}

Json number_or_null(double value) { return std::isfinite(value) ? Json(value) : Json(); }

// of a parameter; NaN where it is not known, ∞ where the data do not determine it
double stddev_of(const FitReport& report, std::size_t k) {
  if (!report.uncertainty || report.hyperparameters[k].at_bound()) return std::numeric_limits<double>::quiet_NaN();
  return report.uncertainty->stddev[static_cast<Index>(k)];
}

Json to_json(const FitProblem& problem, const FitReport& report, const std::string& options) {
  Json hyperparameters = Json::array();
  Json errors = Json::array();  // of parameters, with their correlations
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    hyperparameters.push_back({{"name", h.name},
                               {"value", h.value},
                               {"lower", h.lower},
                               {"upper", h.upper},
                               {"unit", h.unit},
                               {"at_bound", h.at_bound()}});
    if (h.kind != Hyperparameter::Kind::parameter || !report.uncertainty) continue;
    Json correlation = Json::object();
    for (std::size_t l = 0; l < report.hyperparameters.size(); ++l) {
      const Hyperparameter& other = report.hyperparameters[l];
      if (other.kind != Hyperparameter::Kind::parameter) continue;
      correlation[other.name] = number_or_null(report.uncertainty->correlation(static_cast<Index>(k), static_cast<Index>(l)));
    }
    errors.push_back({{"name", h.name}, {"stddev", number_or_null(stddev_of(report, k))}, {"correlation", correlation}});
  }
  Json json = {{"nll", report.negative_log_likelihood}, {"termination", report.termination},
               {"iterations", report.iterations},       {"seconds", report.seconds},
               {"options", Json::parse(options)},       {"hyperparameters", hyperparameters}};
  if (report.uncertainty) {
    json["standard_errors"] = {{"parameters", errors},
                               {"distance_from_optimum", number_or_null(report.uncertainty->distance_from_optimum)}};
  }
  if (!problem.robust) return json;
  json["distrusted"] = Json::array();
  for (const DistrustedValue& value : report.distrusted) {
    const auto group = static_cast<std::size_t>(value.group);
    const View& view = problem.observations[group].view();
    json["distrusted"].push_back(
        {{"log", value.group + 1},
         {"line", problem.lines[group][static_cast<std::size_t>(value.state)]},
         {"value", view.names(*prior_of(problem.prior, view).system)[static_cast<std::size_t>(value.row)]},
         {"distance", value.distance},
         {"noise_factor", value.noise_factor}});
  }
  return json;
}

void print_text(const FitReport& report) {
  fmt::print("negative log likelihood {:.6f}\n", report.negative_log_likelihood);
  fmt::print("{} after {} iterations ({} restarts, best: {}), {:.2f} s\n", report.termination, report.iterations,
             report.restarts.size(), report.best_restart + 1, report.seconds);
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    const double stddev = h.kind == Hyperparameter::Kind::parameter ? stddev_of(report, k) : std::nan("");
    const std::string error = std::isfinite(stddev) ? fmt::format(" ± {:.2g}", stddev) : std::isinf(stddev) ? " ± ∞" : "";
    fmt::print("  {:<34} {:>13.6g}{}   [{:.3g}, {:.3g}]{}\n", h.name, h.value, error, h.lower, h.upper,
               h.at_bound() ? "   at its bound" : "");
  }
}

// what a fit reads and must not replace; where it starts from may be where it ends
std::vector<std::string> inputs_of(const Arguments& arguments) {
  std::vector<std::string> inputs = {arguments.model};
  const auto add = [&](const std::string& log) {
    const auto [path, model] = split_at_system(log);
    inputs.insert(inputs.end(), {path, model});
  };
  for (const std::string& log : arguments.data) add(log);
  for (const std::string& log : arguments.also) add(log.substr(log.find(':') + 1));
  return inputs;
}

// the fit or, where a signal asked for its end before there was anything to give, nothing
std::optional<Fit> fit_until(const Interruption& interruption, const FitProblem& problem, FitOptions options) {
  options.stop = interruption.stop();
  try {
    return fit(problem, options);
  } catch (const NumericalError&) {
    if (interruption.signal() == 0) throw;
    return std::nullopt;
  }
}

std::string told(const Interruption& interruption) {
  return fmt::format("interrupted by signal {} ({})", interruption.signal(), strsignal(interruption.signal()));
}

void run(const Arguments& arguments) {
  if (arguments.restarts && *arguments.restarts < 1) {
    throw InputError(fmt::format("--restarts: must be positive, got {}", *arguments.restarts));
  }
  if (arguments.max_iterations < 0) {
    throw InputError(fmt::format("--max-iterations: must not be negative, got {}", arguments.max_iterations));
  }
  if (arguments.max_points && *arguments.max_points < 1) {
    throw InputError(fmt::format("--max-points: must be positive, got {}", *arguments.max_points));
  }
  if (arguments.threads < 0) {
    throw InputError(fmt::format("--threads: must be positive, or 0 for as many as the machine has; got {}", arguments.threads));
  }
  require_output(arguments.output, inputs_of(arguments));
  FitFile file;
  file.model = Model::read(arguments.model);
  std::vector<Log> logs;
  for (const std::string& text : arguments.data) logs.push_back(read_log(text));
  std::vector<SideInformation> also;
  for (const std::string& text : arguments.also) also.push_back(read_knowledge(text));
  const FitProblemOptions asked = problem_options(arguments);
  FitProblem problem = make_fit_problem(file.model, logs, also, asked);
  if (!arguments.start.empty()) read_start(arguments.start, arguments.max_iterations, problem);
  talk(problem.notes);

  FitOptions options = default_fit_options(problem);
  options.n_restarts = arguments.restarts.value_or(options.n_restarts);
  options.max_iterations = arguments.max_iterations;
  options.seed = arguments.seed;
  options.n_threads = arguments.threads;
  options.standard_errors = !arguments.no_standard_errors;
  file.options =
      fit_options_json(asked, options, arguments.start.empty() ? std::vector<Hyperparameter>() : problem.hyperparameters);
  std::vector<std::string> of_memory;
  options = within_memory(problem, options, free_memory(), of_memory);
  talk(of_memory);
  const bool terminal = isatty(STDERR_FILENO) != 0;
  if (terminal) options.progress = print_progress;
  const Interruption interruption;
  const std::optional<Fit> result = fit_until(interruption, problem, options);
  if (terminal) fmt::print(stderr, "\r\033[K");
  if (!result) {
    talk({fmt::format("{} before there was a fit: nothing is written", told(interruption))});
    throw Interrupted{interruption.signal()};
  }

  const FitReport& report = result->report;
  talk(distrust_notes(problem, report));
  talk(notes_of(report));
  const auto print = [&] {
    if (arguments.json) {
      fmt::print("{}\n", to_json(problem, report, file.options).dump(2));
    } else {
      print_text(report);
    }
  };
  file.prior_options = problem.prior_options;
  std::vector<std::string> sources = arguments.data;
  sources.insert(sources.end(), arguments.also.begin(), arguments.also.end());
  file.data_source = fmt::format("{}", fmt::join(sources, ", "));
  file.observations = result->posterior.observations();
  file.systems = std::move(problem.systems);
  file.report = report;
  try {
    file.write(arguments.output);
  } catch (const InputError&) {
    print();  // what an hour has found is not lost to a full disk
    throw;
  }
  int n_rows = 0;
  for (const Observations& group : file.observations) n_rows += group.n_data();
  talk({fmt::format("{}: fit of '{}' to {} rows", arguments.output, file.model.system->name(), n_rows)});
  print();
  if (report.termination == FitReport::interrupted) {
    talk({fmt::format("{}: {} holds the best so far, not converged; --start {} goes on from there", told(interruption),
                      arguments.output, arguments.output)});
    throw Interrupted{interruption.signal()};
  }
}

}  // namespace

void add_fit(CLI::App& app) {
  CLI::App* command = app.add_subcommand("fit", "Fit a model to a log of states and accelerations");
  auto a = std::make_shared<Arguments>();
  command->add_option("MODEL", a->model, "model file")->required();
  command
      ->add_option("--data", a->data,
                   "CSV log; columns are found by name, in any order. Several: --data A.csv --data B.csv@OTHER.toml, where B was "
                   "measured on the system of another model file")
      ->required()
      ->allow_extra_args(false)
      ->type_name("LOG[@OTHER.toml]");
  command
      ->add_option(
          "--also", a->also,
          "another quantity, measured or known, say unconstrained:rest.csv with abar_q1 …: the columns that are there are "
          "observed. May be given several times")
      ->allow_extra_args(false)
      ->type_name("VIEW[@LATENT]:CSV[@OTHER.toml]");
  command->add_option("--also-noise-std", a->also_noise,
                      "noise standard deviation of what --also gives (default, for accelerations: the model's [noise])");
  command->add_option("--dt", a->time_step, "time step of --also next-velocity [s]");
  command->add_option("--map", a->map, "columns by other names, LOGNAME=MODELNAME,…: theta1=q3 also brings dtheta1, ddtheta1");
  command->add_option("--observe", a->observe,
                      "accelerations to learn from, ddq3,ddq6 (default: those with a column NAME_std in the log, or all)");
  command->add_option("--mean", a->mean, "prior mean of the unconstrained acceleration: zero, or force = M⁻¹F of the model")
      ->check(CLI::IsMember({"zero", "force"}))
      ->capture_default_str();
  command
      ->add_option("--prior", a->prior, "put the model's latent on the acceleration or on the force (default: as the model says)")
      ->check(CLI::IsMember({"acceleration", "force"}));
  command
      ->add_option("--baseline", a->baseline,
                   "learn ddq without mechanics: se (independent outputs), icm or lmc (multi-output), from the model's features")
      ->check(CLI::IsMember(Baseline::words()));
  command->add_option("--estimate", a->estimate, "parameters to estimate, p1,p2, or none (default: those the model says)");
  command->add_option(
      "--noise-std", a->noise,
      "noise standard deviation of every observed ddq, or 'estimate' (default: the log's NAME_std times a factor that is "
      "estimated, 'stated' for those as they are, or as the model says)");
  command->add_option("--protocol", a->protocol, "default, or paper: the set-up of Geist & Trimpe 2020")
      ->check(CLI::IsMember({"default", "paper"}))
      ->capture_default_str();
  command->add_option("--hyperprior", a->hyperprior, "weak log-normal hyper-priors, or none: maximum likelihood")
      ->check(CLI::IsMember({"default", "none"}))
      ->capture_default_str();
  command
      ->add_option("--discrepancy", a->discrepancy, "a small latent for what the kernel would rule out (docs/priors.md), or none")
      ->check(CLI::IsMember({"default", "none"}))
      ->capture_default_str();
  command->add_flag("--project", a->project,
                    "move states onto position and velocity constraints, with the model's parameters, before anything else");
  command->add_flag("--robust", a->robust, "distrust values that disagree with all others, and say which (docs/command-line.md)");
  command->add_option("--restarts", a->restarts,
                      "runs of the optimiser; the first starts at the model's values (default: 5; of a baseline 30)");
  command->add_option("--max-iterations", a->max_iterations, "per run; 0 conditions at the starting values")
      ->capture_default_str();
  command->add_option("--start", a->start, "starting values: {\"name\": value, …} as JSON, or a FIT.json");
  command->add_option("--max-points", a->max_points, "take this many rows of each log, the first of a shuffle by --seed");
  command->add_option("--seed", a->seed, "of restarts and --max-points")->check(not_negative())->capture_default_str();
  command->add_option("--threads", a->threads, "0: as many as the machine has; results do not depend on it")
      ->capture_default_str();
  command->add_flag("--no-standard-errors", a->no_standard_errors,
                    "leave out the standard errors of estimated parameters, which take a few dozen gradients");
  command->add_flag("--json", a->json, "report as JSON on stdout");
  command->add_option("-o,--output", a->output, "fitted model to write (JSON)")->required();
  command->footer("Example:\n  gp2 fit models/surface.toml --data train.csv --mean force -o fit.json");
  command->callback([a] { run(*a); });
}

}  // namespace gp2::command
