#include "gp2/fit.hpp"

#include <chrono>
#include <utility>

#include <fmt/format.h>

#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "inference/requirements.hpp"
#include "training/hamiltonian.hpp"
#include "training/optimum.hpp"

namespace gp2 {

namespace {

void require_options(const FitOptions& options) {
  const auto require = [](const char* name, auto got, auto least) {
    if (!(got >= least)) throw InputError(fmt::format("fit: {} must be at least {}, got {}", name, least, got));
  };
  require("n_restarts", options.n_restarts, 1);
  require("max_iterations", options.max_iterations, 0);
  require("n_threads", options.n_threads, 0);
  require("max_side_by_side", options.max_side_by_side, 0);
  require("gradient_tolerance", options.gradient_tolerance, 0.0);
  require("reduction_tolerance", options.reduction_tolerance, 0.0);
  require("max_escapes", options.max_escapes, 0);
  require("n_draws", options.n_draws, 0);
  require("n_inducing", options.n_inducing, 0);
  require("n_train", options.n_train, 0);
}

void require_starts(const std::vector<Hyperparameter>& hyperparameters) {
  constexpr double rounding = 1e-9;
  for (const Hyperparameter& h : hyperparameters) {
    const double tolerance = rounding * (h.positive ? h.value : h.upper - h.lower);
    if (h.value >= h.lower - tolerance && h.value <= h.upper + tolerance) continue;
    throw InputError(
        fmt::format("hyperparameter '{}' starts at {}, outside its bounds [{}, {}]", h.name, h.value, h.lower, h.upper));
  }
}

}  // namespace

Posterior possible_posterior(const Prior& prior, const std::vector<Observations>& observations, FitReport& report,
                             const Workers& workers) {
  try {
    return posterior_of(prior, observations, report, workers);
  } catch (const Error&) {
    if (!report.draws) throw;
    const std::vector<ModelValues> values = values_of(prior, observations, report);
    std::vector<Eigen::Index> possible;
    for (std::size_t k = 0; k < values.size(); ++k) {
      try {
        static_cast<void>(Posterior(prior, observations, values[k], workers));
        possible.push_back(static_cast<Eigen::Index>(k));
      } catch (const Error&) {  // one more that is impossible
      }
    }
    if (possible.empty() || possible.size() == values.size()) throw;
    report.draws->values = Eigen::MatrixXd(report.draws->values(Eigen::all, possible));
    report.draws->n_impossible = static_cast<int>(values.size() - possible.size());
  }
  return posterior_of(prior, observations, report, workers);
}

Fit fit(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
        const FitOptions& options) {
  const auto start = std::chrono::steady_clock::now();
  require_options(options);
  require_observations(prior, observations);
  require_measured(observations, "fit");
  require_hyperparameters(prior, observations, hyperparameters);
  require_starts(hyperparameters);
  const bool is_part = options.n_train > 0 && options.n_train < n_states(observations);
  if (has_sums(observations) && (options.n_inducing > 0 || is_part)) {
    throw InputError(
        "fit: observations that have sums over states are learned from all together; leave out n_inducing and n_train");
  }
  FitReport report = [&] {
    if (options.n_inducing > 0) return trained_through_points(prior, observations, hyperparameters, options);
    return trained_exactly(prior, is_part ? evenly(observations, options.n_train) : observations, hyperparameters, options);
  }();
  const Workers workers(thread_count(options.n_threads), options.ranks);
  Posterior posterior = report.termination == FitReport::interrupted && !report.draws
                            ? Posterior::lazy(prior, observations, values_of(prior, observations, report).front())
                            : possible_posterior(prior, observations, report, workers);
  if (report.inducing) report.inducing->summary = posterior.summary();
  // what is said is of all rows, not of the part or of the few that a fit begins with, and of the hyperparameters that are told, not
  // of the likeliest draw
  if (is_part || prior.is_nonlinear() || (report.inducing && report.termination == FitReport::interrupted)) {
    FitReport optimum = report;
    optimum.draws.reset();
    if (optimum.inducing) optimum.inducing->summary = nullptr;
    const Posterior told = report.draws ? posterior_of(prior, observations, optimum, workers) : posterior;
    const double of_part = std::exchange(report.negative_log_likelihood, told.negative_log_likelihood());
    report.objective += report.negative_log_likelihood - of_part;
  }
  report.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return {std::move(posterior), std::move(report)};
}

}  // namespace gp2
