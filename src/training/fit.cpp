#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <mutex>
#include <random>
#include <thread>

#include "gp2/error.hpp"
#include "gp2/training.hpp"
#include "inference/lapack.hpp"
#include "training/lbfgsb.hpp"
#include "training/random.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

namespace {

// what the optimiser sees of a hyperparameter: its logarithm, or θ measured in widths of its box
double to_internal(const Hyperparameter& h, double value) {
  return h.is_positive() ? std::log(value) : (value - h.lower) / (h.upper - h.lower);
}

double from_internal(const Hyperparameter& h, double x) {
  const double value = h.is_positive() ? std::exp(x) : h.lower + x * (h.upper - h.lower);
  return std::clamp(value, h.lower, h.upper);
}

// ½ Σ (log(value/median)/log_stddev)², and its derivative in log value added to `gradient`
double hyperprior(const std::vector<Hyperparameter>& hyperparameters, VectorXd* gradient) {
  double sum = 0;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const Hyperparameter& h = hyperparameters[k];
    if (h.log_stddev == 0) continue;
    const double distance = std::log(h.value / h.median) / h.log_stddev;
    sum += 0.5 * distance * distance;
    if (gradient != nullptr) (*gradient)[static_cast<Index>(k)] += distance / h.log_stddev;
  }
  return sum;
}

// ∂NLL/∂x of one hyperparameter, from the gradient in model values
double gather(const Hyperparameter& h, const ModelValues& gradient) {
  const auto owner = static_cast<std::size_t>(h.owner);
  switch (h.kind) {
    case Kind::kernel:
      return gradient.kernel[owner][h.index];
    case Kind::signal_stddev:
      return gradient.signal_stddev[owner][h.index];
    case Kind::shared_signal_stddev:
      return gradient.signal_stddev[owner].sum();
    case Kind::noise_stddev:
      return gradient.noise_stddev[owner][h.index];
    case Kind::parameter:
      return gradient.parameters[h.index] * (h.upper - h.lower);
  }
  return 0;
}

// a random start: from the hyper-prior where there is one, else even in the box (in logarithms for positive values)
std::vector<Hyperparameter> draw_start(std::vector<Hyperparameter> hyperparameters, RandomStream& random) {
  for (Hyperparameter& h : hyperparameters) {
    if (h.log_stddev > 0) {
      h.value = std::clamp(h.median * std::exp(h.log_stddev * random.normal()), h.lower, h.upper);
    } else {
      const double lower = to_internal(h, h.lower);
      h.value = from_internal(h, lower + random.uniform() * (to_internal(h, h.upper) - lower));
    }
  }
  return hyperparameters;
}

class Training {
 public:
  Training(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
           const FitOptions& options)
      : prior_(prior),
        observations_(observations),
        hyperparameters_(hyperparameters),
        options_(options),
        likelihood_(prior, observations, model_values(prior, observations, hyperparameters), likelihood_options(hyperparameters)),
        reports_(static_cast<std::size_t>(n_restarts())),
        results_(static_cast<std::size_t>(n_restarts())),
        fractions_(static_cast<std::size_t>(n_restarts()), 0.0) {}

  [[nodiscard]] int n_restarts() const {
    return options_.max_iterations == 0 || hyperparameters_.empty() ? 1 : std::max(1, options_.n_restarts);
  }

  void run() {
    const lapack::SingleThread single_thread;
    int n_threads = options_.n_threads > 0 ? options_.n_threads : static_cast<int>(std::thread::hardware_concurrency());
    n_threads = std::clamp(n_threads, 1, n_restarts());
    std::atomic<int> next = 0;
    const auto work = [&] {
      for (int restart = next++; restart < n_restarts(); restart = next++) {
        try {
          run_restart(restart);
        } catch (...) {
          const std::scoped_lock lock(mutex_);
          if (!failure_) failure_ = std::current_exception();
        }
      }
    };
    std::vector<std::jthread> helpers;
    for (int k = 1; k < n_threads; ++k) helpers.emplace_back(work);
    work();
    helpers.clear();
    if (failure_) std::rethrow_exception(failure_);
  }

  // the lowest objective; of equal ones the first
  [[nodiscard]] std::size_t best() const {
    return static_cast<std::size_t>(std::min_element(reports_.begin(), reports_.end(),
                                                     [](const auto& a, const auto& b) { return a.objective < b.objective; }) -
                                    reports_.begin());
  }
  [[nodiscard]] const std::vector<RestartReport>& reports() const { return reports_; }
  [[nodiscard]] const std::vector<Hyperparameter>& result(std::size_t restart) const { return results_[restart]; }

 private:
  static Likelihood::Options likelihood_options(const std::vector<Hyperparameter>& hyperparameters) {
    Likelihood::Options options;
    for (const Hyperparameter& h : hyperparameters) {
      if (h.kind == Kind::parameter) options.gradient_parameters.push_back(h.index);
      if (h.kind == Kind::noise_stddev) options.noise_gradient = true;
    }
    return options;
  }

  std::vector<Hyperparameter> at(const VectorXd& x) const {
    std::vector<Hyperparameter> hyperparameters = hyperparameters_;
    for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
      hyperparameters[k].value = from_internal(hyperparameters[k], x[static_cast<Index>(k)]);
    }
    return hyperparameters;
  }

  double objective(const VectorXd& x, VectorXd& gradient, Likelihood::Workspace& workspace) const {
    const std::vector<Hyperparameter> hyperparameters = at(x);
    ModelValues model_gradient;
    const double value = likelihood_.evaluate(model_values(prior_, observations_, hyperparameters), &model_gradient, workspace);
    if (!std::isfinite(value)) return value;
    for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
      gradient[static_cast<Index>(k)] = gather(hyperparameters[k], model_gradient);
    }
    return value + hyperprior(hyperparameters, &gradient);
  }

  void run_restart(int restart) {
    const auto index = static_cast<std::size_t>(restart);
    const Index n = static_cast<Index>(hyperparameters_.size());
    VectorXd lower(n), upper(n), start(n);
    RandomStream random(options_.seed, static_cast<std::uint64_t>(restart));
    Likelihood::Workspace workspace;
    LbfgsbOptions options;
    options.max_iterations = options_.max_iterations;
    options.gradient_tolerance = options_.gradient_tolerance;
    options.reduction_tolerance = options_.reduction_tolerance;
    options.iteration = [&](int iteration, double value) { return report_iteration(restart, iteration, value); };

    // a random start may lie where M is not positive definite: draw again, a few times
    constexpr int max_draws = 20;
    LbfgsbResult result;
    for (int draw = 0; draw < max_draws; ++draw) {
      const std::vector<Hyperparameter> from = restart == 0 ? hyperparameters_ : draw_start(hyperparameters_, random);
      for (Index k = 0; k < n; ++k) {
        const Hyperparameter& h = from[static_cast<std::size_t>(k)];
        lower[k] = to_internal(h, h.lower);
        upper[k] = to_internal(h, h.upper);
        start[k] = to_internal(h, h.value);
      }
      result = minimise([&](const VectorXd& x, VectorXd& gradient) { return objective(x, gradient, workspace); }, start, lower, upper,
                        options);
      if (std::isfinite(result.value) || restart == 0) break;
    }

    results_[index] = options_.max_iterations == 0 ? hyperparameters_ : at(result.x);
    const double without_prior = result.value - hyperprior(results_[index], nullptr);
    reports_[index] = {result.value,       without_prior,    result.iterations, result.evaluations, result.failed_evaluations,
                       result.converged, result.termination};
    const std::scoped_lock lock(mutex_);
    fractions_[index] = 1;
  }

  bool report_iteration(int restart, int iteration, double value) {
    if (options_.progress) {
      const std::scoped_lock lock(mutex_);
      best_ = std::min(best_, value);
      // few runs take more than some hundred iterations; the estimate of what is left need not be better than that
      fractions_[static_cast<std::size_t>(restart)] = iteration / (iteration + 100.0);
      double done = 0;
      for (double fraction : fractions_) done += fraction;
      const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
      options_.progress({restart, n_restarts(), iteration, best_, seconds, done / static_cast<double>(fractions_.size())});
    }
    return options_.stop == nullptr || !options_.stop->load();
  }

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const std::vector<Hyperparameter>& hyperparameters_;
  const FitOptions& options_;
  Likelihood likelihood_;
  std::vector<RestartReport> reports_;
  std::vector<std::vector<Hyperparameter>> results_;

  std::mutex mutex_;  // guards what follows
  std::vector<double> fractions_;
  double best_ = std::numeric_limits<double>::infinity();
  std::exception_ptr failure_;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace

Fit fit(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
        const FitOptions& options) {
  const auto start = std::chrono::steady_clock::now();
  Training training(prior, observations, hyperparameters, options);
  training.run();
  const std::size_t best = training.best();
  const RestartReport& winner = training.reports()[best];
  if (!std::isfinite(winner.objective)) {
    throw NumericalError("no restart reached a finite likelihood: check the bounds of the estimated parameters and the noise");
  }
  FitReport report;
  report.hyperparameters = training.result(best);
  report.negative_log_likelihood = winner.negative_log_likelihood;
  report.objective = winner.objective;
  report.converged = winner.converged;
  report.termination = winner.termination;
  report.iterations = winner.iterations;
  report.best_restart = static_cast<int>(best);
  report.restarts = training.reports();
  Posterior posterior(prior, observations, model_values(prior, observations, report.hyperparameters));
  report.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return {std::move(posterior), std::move(report)};
}

}  // namespace gp2
