#include <algorithm>
#include <cmath>
#include <limits>
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
  // the linear prior about the posterior mean
  const auto linearise_at_mean = [&](const std::vector<Hyperparameter>& at) {
    ModelValues values = model_values(prior, observations, at);
    values.inducing = approximation.points;
    approximation.about = linearisation_of(prior, observations, values, workers);
  };
  // What is found about another mean may have none itself: then one step back, half of the way to the last that had, and again.
  std::vector<Hyperparameter> last_with_mean = hyperparameters;
  const auto linearise = [&](std::vector<Hyperparameter>& at) {
    constexpr int most_halvings = 6;
    for (int halvings = 0;; ++halvings) {
      try {
        linearise_at_mean(at);
        last_with_mean = at;
        return halvings == 0;
      } catch (const NumericalError&) {
        if (halvings == most_halvings || is_set(options.stop)) throw;
      }
      for (std::size_t k = 0; k < at.size(); ++k) {
        const double middle = at[k].value_at(0.5 * (at[k].coordinate() + last_with_mean[k].coordinate()));
        at[k].value = std::clamp(middle, at[k].lower, at[k].upper);
      }
    }
  };
  std::optional<FitReport> first, last;
  double objective = std::numeric_limits<double>::infinity();
  bool stands = options.max_iterations == 0;
  // Where no latent acts the load is that of known forces. Beside it what presses on a constraint and what rubs there are found both wrong, and
  // each holds the other so.
  if (!approximation.about) {
    try {
      linearise_at_mean(hyperparameters);
    } catch (const NumericalError&) {  // about no latent then
    }
  }
  for (int round = 0; round < most && !stands; ++round) {
    FitReport report = trained(prior, observations, hyperparameters, once, approximation);
    hyperparameters = report.hyperparameters;
    stands = std::abs(report.objective - objective) < enough;
    objective = report.objective;
    if (!first) first = report;
    last = std::move(report);
    if (is_set(options.stop)) break;
    if (!linearise(hyperparameters)) {
      objective = std::numeric_limits<double>::infinity();
      stands = false;
    }
    once.n_restarts = 1;
    once.max_escapes = 0;
  }
  once.n_draws = options.n_draws;
  once.standard_errors = options.standard_errors;
  FitReport report =
      last && is_set(options.stop) ? *std::move(last) : trained(prior, observations, hyperparameters, once, approximation);
  if (!first) return report;
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
