#include <algorithm>
#include <cmath>
#include <filesystem>
#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/raw_fit.hpp"
#include "gp2/jobs/show_job.hpp"
#include "gp2/training/laplace.hpp"
#include "interruption.hpp"
#include "jobs/hyperparameters_json.hpp"
#include "ranks.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

using Eigen::Index;
using Json = nlohmann::ordered_json;

struct FitArguments {
  std::string model, again, output;
  std::vector<std::string> data, also;
  std::string raw, smoothed, commands;
  RawFitOptions raw_options;
  bool json = false;
  FitRequest request;
};

// LOG or LOG@OTHER.toml
Log read_log(const std::string& text, const Workers& workers) {
  const auto [path, model] = split_at_system(text);
  return {CsvTable::read(path, CsvTable::Keep::numbers, workers),
          model.empty() ? nullptr : std::make_shared<const Model>(Model::read(model))};
}

// VIEW:LOG or VIEW@LATENT:LOG
SideInformation read_side_information(const std::string& text, const Workers& workers) {
  const std::size_t colon = text.find(':');
  const std::string view = text.substr(0, std::min(colon, text.size()));
  const std::size_t at = view.find('@');
  const std::optional<View::Quantity> quantity = View::Quantity::of_word(view.substr(0, at));
  if (colon == std::string::npos || !quantity) {
    throw InputError(fmt::format("`also`: '{}' is not VIEW:FILE.csv or VIEW@LATENT:FILE.csv with VIEW one of {}", text,
                                 fmt::join(View::Quantity::words(), ", ")));
  }
  return {*quantity, at == std::string::npos ? "" : view.substr(at + 1), read_log(text.substr(colon + 1), workers)};
}

void say_how_far(const Progress& p) {
  if (!progress_is_due()) return;
  const double left = p.fraction > 0 ? p.seconds * (1 - p.fraction) / p.fraction : 0;
  const std::string place = p.is_drawing ? "drawing hyperparameters"
                                         : fmt::format("restart {}/{}  iteration {}", p.restart + 1, p.n_restarts, p.iteration);
  const std::string rows = p.n_states > 0 ? fmt::format("{} rows  ", p.n_states) : "";
  const std::string best = std::isfinite(p.best) ? fmt::format("{:.4f}", p.best) : "none yet";
  print_progress(fmt::format("{}{}  best {}  about {:.0f} s left", rows, place, best, left));
}

Json draws_json(const FitReport& report) {
  const HyperparameterDraws& draws = *report.draws;
  Json of_each = Json::array();
  for (std::size_t h = 0; h < report.hyperparameters.size(); ++h) {
    const auto k = static_cast<Index>(h);
    of_each.push_back({{"name", report.hyperparameters[h].name},
                       {"mean", draws.mean[k]},
                       {"stddev", draws.stddev[k]},
                       {"lower95", draws.lower[k]},
                       {"upper95", draws.upper[k]},
                       {"r_hat", draws.r_hat[k]},
                       {"effective_size", draws.effective_size[k]}});
  }
  return {{"n_draws", draws.size()},
          {"n_chains", draws.n_chains},
          {"evaluations", draws.evaluations},
          {"acceptance", draws.acceptance},
          {"hyperparameters", of_each}};
}

Json to_json(const Evaluation::Part& scores) {
  return {{"nrmse", scores.nrmse},
          {"coverage50", scores.coverage50},
          {"coverage80", scores.coverage80},
          {"coverage95", scores.coverage95}};
}

Json to_json(const FitProblem& problem, const FitOutcome& outcome) {
  const FitReport& report = outcome.file.report;
  Json errors = Json::array();  // of parameters, with their correlations
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    if (h.kind != Hyperparameter::Kind::parameter || !(report.uncertainty || report.draws)) continue;
    Json correlation = Json::object();
    for (std::size_t l = 0; l < report.hyperparameters.size(); ++l) {
      const Hyperparameter& other = report.hyperparameters[l];
      if (other.kind != Hyperparameter::Kind::parameter) continue;
      correlation[other.name] = parameter_correlation(report, k, l);
    }
    const ParameterUncertainty known = parameter_uncertainty(report, k);
    errors.push_back({{"name", h.name}, {"stddev", known.stddev}, {"correlation", correlation}});
    if (known.is_of_draws) errors.back().update(Json{{"mean", known.mean}, {"lower95", known.lower}, {"upper95", known.upper}});
  }
  Json json = {{"nll", report.negative_log_likelihood},
               {"termination", report.termination},
               {"iterations", report.iterations},
               {"seconds", report.seconds},
               {"options", Json::parse(outcome.file.options)},
               {"hyperparameters", hyperparameters_json(report, outcome.file.model)}};
  if (report.uncertainty) {
    json["standard_errors"] = {{"parameters", errors}, {"distance_from_optimum", report.uncertainty->distance_from_optimum}};
  } else if (!errors.empty()) {
    json["standard_errors"] = {{"parameters", errors}};
  }
  if (report.draws) json["draws"] = draws_json(report);
  if (report.inducing) {
    json["inducing"] = {
        {"n_variables", report.inducing->n_variables}, {"left_out", Json::object()}, {"n_start", report.inducing->n_start}};
    for (std::size_t a = 0; a < problem.prior.latents.size(); ++a) {
      const Latent& latent = problem.prior.latents[a];
      const std::string name = latent.direction.empty() ? latent.name : latent.name + "." + latent.direction;
      json["inducing"]["left_out"][name] = report.inducing->left_out[static_cast<Index>(a)];
    }
  }
  for (const ActuatorEstimate& one : report.actuators) {
    json["actuators"].push_back({{"name", one.name},
                                 {"value", one.value},
                                 {"std", one.stddev},
                                 {"lower", one.lower},
                                 {"upper", one.upper},
                                 {"at_bound", one.at_lower() || one.at_upper()},
                                 {"moves", one.moves}});
  }
  if (outcome.cross_validation) {
    const auto scores = [](const LeftOutScores& of) {
      return Json{{"one_by_one", to_json(of.one_by_one)}, {"stretches", of.stretches ? to_json(*of.stretches) : Json()}};
    };
    json["left_out"] = scores(*outcome.cross_validation);
    for (const LeftOutScores& other : outcome.cross_validation->other_views) json["left_out"]["also"][other.view] = scores(other);
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

// what a fit reads and must not replace; where it starts from may be where it ends
std::vector<std::string> inputs_of(const FitArguments& arguments) {
  std::vector<std::string> inputs = {arguments.model, arguments.again};
  const auto add = [&](const std::string& log) {
    const auto [path, model] = split_at_system(log);
    inputs.insert(inputs.end(), {path, model});
  };
  for (const std::string& log : arguments.data) add(log);
  for (const std::string& log : arguments.also) add(log.substr(log.find(':') + 1));
  inputs.insert(inputs.end(), {arguments.raw, arguments.commands});
  return inputs;
}

// What work() gives; where a signal asked for its end before there was anything to give it is said, and the command ends.
template <typename Work>
auto unless_interrupted(const Interruption& interruption, const Work& work) {
  try {
    return work();
  } catch (const NumericalError&) {
    if (interruption.signal() == 0) throw;
    print_notes({fmt::format("{} before there was a fit: nothing is written", interruption.text())});
    throw Interrupted{interruption.signal()};
  }
}

std::string data_source_of(const FitArguments& arguments) {
  std::vector<std::string> sources = arguments.data;
  if (!arguments.raw.empty()) sources.push_back(arguments.raw);
  sources.insert(sources.end(), arguments.also.begin(), arguments.also.end());
  return fmt::format("{}", fmt::join(sources, ", "));
}

void read_data(FitArguments& arguments, const Workers& workers) {
  FitRequest& request = arguments.request;
  request.data_source = data_source_of(arguments);
  for (const std::string& text : arguments.data) request.logs.push_back(read_log(text, workers));
  if (!arguments.commands.empty()) {
    request.problem.commands = CsvTable::read(arguments.commands, CsvTable::Keep::numbers, workers);
  }
  for (const std::string& text : arguments.also) request.also.push_back(read_side_information(text, workers));
  require_use_of_commands(request);
}

// The fit to a raw log, which learning and smoothing by turns prepares.
FitJob read_raw(FitArguments& arguments, const std::atomic<bool>* stop) {
  const FitRequest& request = arguments.request;
  LearnedLog log = learn_and_smooth(request, CsvTable::read(arguments.raw), arguments.raw_options, stop);
  print_notes(log.data.notes);
  print_smoothing(log.data, *request.model.system);
  print_notes(log.notes);
  if (!arguments.smoothed.empty()) {
    as_table(log.data, *request.model.system, arguments.smoothed).write(arguments.smoothed);
    // what went into a pipe cannot be read again
    if (arguments.smoothed != "/dev/stdout" && std::filesystem::is_regular_file(arguments.smoothed))
      log.files = {*CsvTable::read(arguments.smoothed, CsvTable::Keep::numbers).file()};
  }
  return prepare_raw_fit(log, std::move(arguments.request), arguments.raw);
}

FitJob prepare(FitArguments& arguments, const std::shared_ptr<const Ranks>& ranks, const Interruption& interruption) {
  const Workers readers(arguments.request.threads, ranks);
  if (arguments.again.empty()) {
    arguments.request.model = Model::read(arguments.model);
    read_data(arguments, readers);
    if (!arguments.raw.empty()) return read_raw(arguments, interruption.stop());
    return prepare_fit(std::move(arguments.request));
  }
  const FitFile fit = FitFile::read(arguments.again);
  const int threads = arguments.request.threads;
  if (arguments.data.empty()) return prepare_fit_again(fit, threads);
  arguments.request = request_of(fit);
  arguments.request.threads = threads;
  read_data(arguments, readers);
  return prepare_fit_again(fit, std::move(arguments.request));
}

// Hyper-priors and a discrepancy that are asked for, but that another option leaves out.
void require_what_is_asked(const FitProblemOptions& options, const std::set<std::string>& given) {
  const bool is_baseline = options.baseline.has_value();
  const bool is_paper = options.protocol.name == Protocol::Name::paper;
  const std::string fit = is_baseline ? fmt::format("`baseline={}`", Baseline::word(*options.baseline)) : "`protocol=paper`";
  const bool has_hyperpriors = !is_baseline && !is_paper;
  if (given.contains("hyperprior") && options.protocol.hyperprior && !has_hyperpriors) {
    throw InputError(fmt::format("{} has no hyper-priors: leave out `hyperprior=default`", fit));
  }
  if (given.contains("discrepancy") && options.discrepancy && !(has_hyperpriors && options.protocol.hyperprior)) {
    throw InputError(
        fmt::format("{} has no discrepancy: leave out `discrepancy=default`", has_hyperpriors ? "`hyperprior=none`" : fit));
  }
}

// A fit needs a model and data, or another fit whose options it takes.
void require_inputs(const FitArguments& arguments, const std::set<std::string>& given) {
  if (arguments.again.empty()) {
    if (arguments.model.empty()) throw UsageError{"MODEL is required"};
    if (!arguments.raw.empty() && !arguments.data.empty()) throw UsageError{"--raw replaces --data: leave out one of them"};
    if (!arguments.raw.empty() && !arguments.commands.empty()) throw UsageError{"--raw is the whole log: leave out --commands"};
    if (arguments.data.empty() && arguments.also.empty() && arguments.raw.empty())
      throw UsageError{"--data or --raw is required, or --also alone"};
    return;
  }
  const std::set<std::string> allowed = {"again", "data", "commands", "also", "threads", "checkpoint", "json", "quiet", "output"};
  for (const std::string& name : given) {
    if (!allowed.contains(name)) {
      throw InputError(fmt::format("`again`: {} contains its model and options: leave out {}", arguments.again,
                                   name == "model" ? "MODEL" : "`" + name + "`"));
    }
  }
  if (arguments.data.empty() && !arguments.also.empty()) throw InputError("`again`: `also` goes with `data`");
  if (arguments.data.empty() && !arguments.commands.empty()) throw InputError("`again`: `commands` goes with `data`");
}

void run(FitArguments& arguments, const std::set<std::string>& given) {
  require_inputs(arguments, given);
  require_what_is_asked(arguments.request.problem, given);
  require_output(arguments.output, inputs_of(arguments));
  if (!arguments.smoothed.empty()) require_output(arguments.smoothed, inputs_of(arguments), "--smoothed");
  std::error_code unknown;  // of a path that is no file yet
  if (!arguments.smoothed.empty() && std::filesystem::weakly_canonical(arguments.smoothed, unknown) ==
                                         std::filesystem::weakly_canonical(arguments.output, unknown)) {
    throw InputError(fmt::format("--smoothed {}: the fit goes there (-o); write to another file", arguments.smoothed));
  }
  const std::string checkpoint = arguments.request.checkpoint;
  if (!checkpoint.empty()) require_output(checkpoint, inputs_of(arguments), "--checkpoint");
  const std::shared_ptr<const Ranks> ranks = join_ranks();
  const LastWord last_word(checkpoint);
  const Interruption interruption(!ranks, checkpoint.empty() ? nullptr : &last_word);  // mpirun ends its processes
  FitJob job = unless_interrupted(interruption, [&] { return prepare(arguments, ranks, interruption); });
  if (ranks) require_same_data(*ranks, job.problem.observations);
  job.options.ranks = ranks;
  job.checkpoint = checkpoint;
  print_notes(job.notes);
  const FitOutcome outcome = unless_interrupted(interruption, [&] {
    try {
      return run_fit(job, say_how_far, interruption.stop());
    } catch (...) {
      last_word.say();
      throw;
    }
  });
  end_progress();

  print_notes(outcome.notes);
  const FitFile& file = outcome.file;
  const auto print = [&] {
    if (arguments.json) {
      print_json(to_json(job.problem, outcome));
    } else {
      print_result("{}", text_of(file.report, file.model));
      if (outcome.cross_validation) print_result("{}\n", outcome.cross_validation->text());
    }
  };
  if (ranks && ranks->rank() > 0) return;
  try {
    file.write(arguments.output);
  } catch (const InputError&) {
    print();  // what an hour has found is not lost to a full disk
    throw;
  }
  print_notes(
      {fmt::format("{}: fit of '{}' to {} rows", arguments.output, file.model.system->name(), outcome.posterior.n_states())});
  print();
  if (file.report.termination == FitReport::interrupted) {
    print_notes({fmt::format("{}: {} holds the best so far, not converged; --start {} continues from there", interruption.text(),
                             arguments.output, arguments.output)});
    if (file.report.iterations == 0) print_notes({"the best so far are the starting values: no run has improved on them yet"});
    throw Interrupted{interruption.signal()};
  }
}

}  // namespace

Command fit_command() {
  const auto a = std::make_shared<FitArguments>();
  Option model = argument("MODEL", a->model, "model file");
  model.is_required = false;  // --again stands for it
  std::vector<Option> inputs = {
      std::move(model),
      {"data", Repeated{&a->data}, "LOG[@OTHER.toml]",
       "CSV log, with columns in any order; may be repeated. LOG@OTHER.toml: measured on the system of another model file"},
      {"also", Repeated{&a->also}, "VIEW[@LATENT]:CSV[@OTHER.toml]",
       "another measured or known quantity, such as unconstrained:rest.csv with abar_q1 …; all columns present are observed. May "
       "be repeated, and used without --data"},
      {"commands", &a->commands, "CSV",
       "complete log of t and inputs (and episode, if any) from which the rows of --data are taken; for inputs with a delay or "
       "lag"},
      {"raw", &a->raw, "LOG",
       "instead of --data: CSV log of t and positions, smoothed and learned from in turn (docs/raw-logs.md)"},
      {"smoothed", &a->smoothed, "CSV", "CSV file to write: q, dq and ddq of the raw log with standard deviations", "", "", "",
       "raw"},
  };
  return {"fit", "Fit a model to a log of states and accelerations",
          "gp2 fit models/surface.toml --data train.csv --mean force -o fit.json",
          joined({in_group("Data", std::move(inputs)),
                  options(a->request, a->raw_options),
                  {{"again", &a->again, "FIT.json",
                    "repeat an earlier fit: its model, its options and, unless --data is given, its data; the result is the same "
                    "to the bit"},
                   {"json", &a->json, "", "print the report as JSON"},
                   output(a->output, "FIT.json", "fitted model to write (JSON)")}}),
          [a](const std::set<std::string>& given) { run(*a, given); }};
}

}  // namespace gp2::command
