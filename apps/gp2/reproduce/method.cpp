#include <algorithm>
#include <chrono>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/baselines/baseline.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/simulation/generate.hpp"
#include "reproduce/experiment.hpp"

namespace gp2::command {

using Eigen::Index;
using Eigen::MatrixXd;

Method method_of(const Section& section) {
  Method method;
  method.name = section.text("name");
  method.is_truth = section.flag("truth");
  if (section.has("baseline")) {
    method.baseline = Baseline::kind_of(section.text("baseline"));
    if (!method.baseline) {
      throw InputError(fmt::format("method {}: there is no baseline '{}'; there are: {}", method.name, section.text("baseline"),
                                   fmt::join(Baseline::words(), ", ")));
    }
  }
  method.mean = section.mean();
  method.wide = section.flag("wide");
  method.estimate = section.flag("estimate");
  return method;
}

Method method_of(const Section& section, const Section& restarts) {
  Method method = method_of(section);
  method.n_restarts = {{Protocol::Name::paper, restarts.integer(method.baseline ? "baseline" : "paper")},
                       {Protocol::Name::standard, restarts.integer(method.baseline ? "baseline" : "default")}};
  return method;
}

std::vector<Method> methods_of(const Section& definition) {
  std::vector<Method> methods;
  for (const Section& section : definition.sections("method")) {
    methods.push_back(method_of(section, definition.section("restarts")));
    if (definition.has("reduction_tolerance")) methods.back().reduction_tolerance = definition.number("reduction_tolerance");
  }
  return methods;
}

namespace {

// mean over outputs of the root mean square error in training standard deviations
double normalised_error(const MatrixXd& prediction, const MatrixXd& truth, const Eigen::VectorXd& training_stddev) {
  const Eigen::VectorXd rms = (prediction - truth).rowwise().squaredNorm() / static_cast<double>(truth.cols());
  return rms.cwiseSqrt().cwiseQuotient(training_stddev).mean();
}

}  // namespace

Score score_of(const ExperimentSystem& system, const Method& method, Protocol::Name protocol, const CsvTable& log, int run,
               int n_threads, std::optional<int> train_at_most) {
  const auto start = std::chrono::steady_clock::now();
  const System& mechanics = *system.model.system;
  Score score;
  MatrixXd prediction = system.grid_truth;
  if (!method.is_truth) {
    const std::vector<std::string> estimate = method.estimate ? system.parameters.at(method.mean) : std::vector<std::string>{};
    const int n_training = std::min(train_at_most.value_or(log.n_rows()), log.n_rows());
    const Trained trained = train(system.model, estimate, method, protocol, log.first_rows(n_training), run, n_threads);
    std::vector<Observations> observations = trained.problem.observations;
    Posterior posterior = trained.fit.posterior;
    if (n_training < log.n_rows()) {
      FitProblemOptions everything;
      everything.estimate = estimate;
      observations = make_fit_problem(system.model, log, everything).observations;
      const Prior& prior = trained.problem.prior;
      posterior = Posterior(prior, observations, model_values(prior, observations, trained.fit.report.hyperparameters));
    }
    prediction = posterior.mean(View::constrained_acceleration(mechanics), system.grid_states);
    score.rmse_normalised = normalised_error(prediction, system.grid_truth, row_stddev(observations.front().values()));
    score.negative_log_likelihood = trained.fit.report.negative_log_likelihood;
  }
  score.max_constraint_error = max_constraint_error(mechanics, system.grid_states, mechanics.parameter_values(), prediction);
  score.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return score;
}

namespace {

// the published bounds of lengthscales and signals, of which the upper ones keep a function from being almost linear
void widen(std::vector<Hyperparameter>& hyperparameters) {
  constexpr double lower = 0.1, upper = 1e3;
  for (Hyperparameter& h : hyperparameters) {
    if (h.kind != Hyperparameter::Kind::kernel && h.kind != Hyperparameter::Kind::signal_stddev) continue;
    h.lower *= lower;
    h.upper *= upper;
  }
}

void start_from(const std::vector<Hyperparameter>& start, std::vector<Hyperparameter>& hyperparameters) {
  for (Hyperparameter& h : hyperparameters) {
    const auto same =
        std::find_if(start.begin(), start.end(), [&](const Hyperparameter& s) { return s.name == h.name && s.owner == h.owner; });
    if (same != start.end()) h.value = std::clamp(same->value, h.lower, h.upper);
  }
}

}  // namespace

Trained train(const Model& model, const std::vector<std::string>& estimate, const Method& method, Protocol::Name protocol,
              const CsvTable& log, int run, int n_threads, const std::vector<Hyperparameter>& start) {
  FitProblemOptions options;
  options.mean = method.mean == "force" ? Prior::Mean::force : Prior::Mean::zero;
  options.estimate = estimate;
  options.protocol.name = protocol;
  options.baseline = method.baseline;
  options.seed = static_cast<std::uint64_t>(run);
  FitProblem problem = make_fit_problem(model, log, options);
  if (method.wide) widen(problem.hyperparameters);
  start_from(start, problem.hyperparameters);
  FitOptions fit_options = default_fit_options(problem);
  fit_options.n_restarts = method.n_restarts.at(protocol);
  fit_options.seed = options.seed;
  fit_options.n_threads = n_threads;
  fit_options.max_iterations = method.max_iterations;
  fit_options.max_escapes = method.max_escapes;
  fit_options.n_inducing = method.n_inducing;
  fit_options.standard_errors = method.standard_errors;
  if (!method.baseline) fit_options.reduction_tolerance = method.reduction_tolerance;
  Fit result = fit(problem, fit_options);
  return {std::move(problem), std::move(result)};
}

}  // namespace gp2::command
