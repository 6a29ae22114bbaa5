#include <algorithm>
#include <cmath>
#include <exception>
#include <limits>
#include <optional>
#include <utility>

#include <fmt/format.h>

#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "inference/posterior_implementation.hpp"
#include "training/optimum.hpp"

namespace gp2 {

FitReport trained_nonlinear(const Prior& prior, const std::vector<Observations>& observations,
                            std::vector<Hyperparameter> hyperparameters, const FitOptions& options, Approximation approximation) {
  constexpr int most = 20;
  constexpr double enough = 1e-3;  // nats
  FitOptions once = options;
  once.n_draws = 0;
  once.standard_errors = false;
  const Workers workers = Evaluators(options, approximation.points != nullptr).alone;
  // The linear prior about the posterior mean; false where there is none, and the last one stays.
  bool has_mean = false;
  std::exception_ptr why_none;
  std::vector<Hyperparameter> last_with_mean = hyperparameters;
  const auto linearise_at_mean = [&](const std::vector<Hyperparameter>& at) {
    ModelValues values = model_values(prior, observations, at);
    values.inducing = approximation.points;
    try {
      approximation.about = linearisation_of(prior, observations, values, workers);
    } catch (const NumericalError&) {
      why_none = std::current_exception();
      return false;
    }
    has_mean = true;
    last_with_mean = at;
    return true;
  };
  // What is found about another mean may have none itself: then that of another restart, else half of the way from the best to the last
  // that had one, and again.
  enum class Found { as_it_is, elsewhere, nowhere };
  const auto linearise = [&](std::vector<Hyperparameter>& at, const std::vector<std::vector<Hyperparameter>>& optima) {
    constexpr int most_halvings = 6;
    if (linearise_at_mean(at)) return Found::as_it_is;
    for (std::size_t k = 1; k < optima.size() && !is_set(options.stop); ++k) {
      if (!linearise_at_mean(optima[k])) continue;
      at = optima[k];
      return Found::elsewhere;
    }
    for (int halvings = 0; halvings < most_halvings && !is_set(options.stop); ++halvings) {
      for (std::size_t k = 0; k < at.size(); ++k) {
        const double middle = at[k].value_at(0.5 * (at[k].coordinate() + last_with_mean[k].coordinate()));
        at[k].value = std::clamp(middle, at[k].lower, at[k].upper);
      }
      if (linearise_at_mean(at)) return Found::elsewhere;
    }
    if (!has_mean) std::rethrow_exception(why_none);
    at = last_with_mean;
    return Found::nowhere;
  };
  std::optional<FitReport> first, last;
  double objective = std::numeric_limits<double>::infinity();
  bool stands = options.max_iterations == 0, is_stuck = false;
  // Where no latent acts the load is that of known forces. Beside it what presses on a constraint and what rubs there are found both wrong, and
  // each holds the other so. Without a mean at the start there is nothing better.
  if (!approximation.about) linearise_at_mean(hyperparameters);
  for (int round = 0; round < most && !stands && !is_stuck; ++round) {
    std::vector<std::vector<Hyperparameter>> optima;
    FitReport report = trained(prior, observations, hyperparameters, once, approximation, &optima);
    hyperparameters = report.hyperparameters;
    stands = std::abs(report.objective - objective) < enough;
    objective = report.objective;
    if (!first) first = report;
    last = std::move(report);
    if (is_set(options.stop)) break;
    const Found found = linearise(hyperparameters, optima);
    if (found != Found::as_it_is) {
      objective = std::numeric_limits<double>::infinity();
      stands = false;
    }
    is_stuck = found == Found::nowhere;
    once.n_restarts = 1;
    once.max_escapes = 0;
  }
  once.n_draws = options.n_draws;
  once.standard_errors = options.standard_errors;
  FitReport report =
      last && is_set(options.stop) ? *std::move(last) : trained(prior, observations, hyperparameters, once, approximation);
  if (!first) return report;
  // the last run may leave the hyperparameters that have a mean
  if (has_mean && !is_set(options.stop) && !linearise_at_mean(report.hyperparameters)) {
    report.hyperparameters = last_with_mean;
    report.objective = report.negative_log_likelihood + negative_log_hyperpriors(last_with_mean, nullptr);
    report.uncertainty.reset();
    stands = false;
  }
  // the run that searched is told of, not those that stood where it ended
  report.restarts = std::move(first->restarts);
  report.best_restart = first->best_restart;
  report.iterations = first->iterations;
  report.n_escapes = first->n_escapes;
  report.converged = first->converged && stands;
  report.termination = is_set(options.stop) ? FitReport::interrupted : stands ? first->termination : FitReport::unsettled;
  return report;
}

FitReport trained_exactly(const Prior& prior, const std::vector<Observations>& observations,
                          const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  return prior.is_nonlinear() ? trained_nonlinear(prior, observations, hyperparameters, options)
                              : trained(prior, observations, hyperparameters, options);
}

}  // namespace gp2
