#include <cmath>
#include <exception>
#include <limits>
#include <optional>
#include <utility>

#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "inference/posterior_implementation.hpp"
#include "training/optimum.hpp"

namespace gp2 {

namespace {

// The linear prior about the posterior mean, found anew at each optimum of the hyperparameters.
class LinearisationAtMean {
 public:
  LinearisationAtMean(const Prior& prior, const std::vector<Observations>& observations, const FitOptions& options,
                      Approximation approximation, std::vector<Hyperparameter> start)
      : prior_(prior),
        observations_(observations),
        options_(options),
        workers_(Evaluators(options, approximation.points != nullptr).alone),
        approximation_(std::move(approximation)),
        last_(std::move(start)) {}

  [[nodiscard]] const Approximation& approximation() const { return approximation_; }
  [[nodiscard]] bool has_mean() const { return has_mean_; }
  /// The last hyperparameters under which there was a mean; without one the start.
  [[nodiscard]] const std::vector<Hyperparameter>& last() const { return last_; }

  /// False where there is no mean, and the last linearisation stays.
  bool move_to(const std::vector<Hyperparameter>& hyperparameters) {
    ModelValues values = model_values(prior_, observations_, hyperparameters);
    values.inducing = approximation_.points;
    try {
      approximation_.about = linearisation_of(prior_, observations_, values, workers_);
    } catch (const NumericalError&) {
      why_none_ = std::current_exception();
      return false;
    }
    has_mean_ = true;
    last_ = hyperparameters;
    return true;
  }

  enum class Found { as_it_is, elsewhere, nowhere };
  /// What is found about another mean may have none itself: then that of another restart is taken, else half of the way from the last
  /// that had one, and again.
  Found move_near(std::vector<Hyperparameter>& hyperparameters, const std::vector<std::vector<Hyperparameter>>& optima) {
    constexpr int most_halvings = 6;
    if (move_to(hyperparameters)) return Found::as_it_is;
    for (std::size_t k = 1; k < optima.size() && !is_set(options_.stop); ++k) {
      if (!move_to(optima[k])) continue;
      hyperparameters = optima[k];
      return Found::elsewhere;
    }
    for (int halvings = 0; halvings < most_halvings && !is_set(options_.stop); ++halvings) {
      for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
        Hyperparameter& h = hyperparameters[k];
        h.value = h.value_at(0.5 * (h.coordinate() + last_[k].coordinate()));
      }
      if (move_to(hyperparameters)) return Found::elsewhere;
    }
    if (!has_mean_) std::rethrow_exception(why_none_);
    hyperparameters = last_;
    return Found::nowhere;
  }

 private:
  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const FitOptions& options_;
  Workers workers_;
  Approximation approximation_;
  std::vector<Hyperparameter> last_;
  bool has_mean_ = false;
  std::exception_ptr why_none_;
};

}  // namespace

FitReport trained_nonlinear(const Prior& prior, const std::vector<Observations>& observations,
                            std::vector<Hyperparameter> hyperparameters, const FitOptions& options, Approximation approximation) {
  constexpr int most = 20;
  constexpr double enough = 1e-3;  // nats
  using Found = LinearisationAtMean::Found;
  LinearisationAtMean linearisation(prior, observations, options, std::move(approximation), hyperparameters);
  FitOptions once = options;
  once.n_draws = 0;
  once.standard_errors = false;
  std::optional<FitReport> first, last;
  double objective = std::numeric_limits<double>::infinity();
  bool stands = options.max_iterations == 0, is_stuck = false;
  // Where no latent acts the load is that of known forces. Beside it what presses on a constraint and what rubs there are found both
  // wrong, and each holds the other so. Without a mean at the start there is nothing better.
  if (!linearisation.approximation().about) linearisation.move_to(hyperparameters);
  for (int round = 0; round < most && !stands && !is_stuck; ++round) {
    std::vector<std::vector<Hyperparameter>> optima;
    FitReport report = trained(prior, observations, hyperparameters, once, linearisation.approximation(), &optima);
    hyperparameters = report.hyperparameters;
    stands = std::abs(report.objective - objective) < enough;
    objective = report.objective;
    if (!first) first = report;
    last = std::move(report);
    if (is_set(options.stop)) break;
    const Found found = linearisation.move_near(hyperparameters, optima);
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
  FitReport report = last && is_set(options.stop)
                         ? *std::move(last)
                         : trained(prior, observations, hyperparameters, once, linearisation.approximation());
  if (!first) return report;
  // the last run may leave the hyperparameters that have a mean
  if (linearisation.has_mean() && !is_set(options.stop) && !linearisation.move_to(report.hyperparameters)) {
    report.hyperparameters = linearisation.last();
    report.objective = report.negative_log_likelihood + negative_log_hyperpriors(report.hyperparameters, nullptr);
    report.uncertainty.reset();
    report.draws.reset();
    stands = false;
  }
  // the run that searched is told of, not those that stood where it ended
  report.restarts = std::move(first->restarts);
  report.best_restart = first->best_restart;
  report.iterations = first->iterations;
  report.n_escapes = first->n_escapes;
  report.converged = report.converged && stands && !is_set(options.stop);
  if (is_set(options.stop))
    report.termination = FitReport::interrupted;
  else if (!stands)
    report.termination = FitReport::unsettled;
  return report;
}

FitReport trained_exactly(const Prior& prior, const std::vector<Observations>& observations,
                          const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  return prior.is_nonlinear() ? trained_nonlinear(prior, observations, hyperparameters, options)
                              : trained(prior, observations, hyperparameters, options);
}

}  // namespace gp2
