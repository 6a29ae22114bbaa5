#include "training/optimum.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <map>
#include <mutex>
#include <numeric>
#include <set>
#include <span>
#include <utility>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "base/random.hpp"
#include "gp2/error.hpp"
#include "training/constraint_parameters.hpp"
#include "training/curvature.hpp"
#include "training/hamiltonian.hpp"
#include "training/lbfgsb.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

// latents whose loading stands at the stationary point 0
std::set<int> latents_at_zero(const std::vector<Hyperparameter>& hyperparameters) {
  std::set<int> at_zero;
  for (const Hyperparameter& h : hyperparameters) {
    if (h.is_stationary_at_zero()) at_zero.insert(h.owner);
  }
  for (const Hyperparameter& h : hyperparameters) {
    if (h.is_stationary_at_zero() && h.value != 0) at_zero.erase(h.owner);
  }
  return at_zero;
}

// A random start: about the size where the box is no more than a limit, log-normal about the first start where the hyper-prior is
// log-normal, else even in the box of the coordinate. Where `common` is not null, half of the variance of a log-normal one is its.
double draw(const Hyperparameter& h, const double* common, RandomStream& random) {
  if (h.size > 0) {
    const double relative = random.normal();
    return std::clamp(h.size * (h.positive ? std::exp(relative) : relative), h.lower, h.upper);
  }
  if (h.hyperprior.form == HyperPrior::Form::log_normal) {
    const double own = random.normal(), deviate = common == nullptr ? own : std::sqrt(0.5) * (own + *common);
    return std::clamp(h.value * std::exp(Protocol::Standard::start_log_stddev * deviate), h.lower, h.upper);
  }
  const double lower = h.lower_coordinate();
  return h.value_at(lower + random.uniform() * (h.upper_coordinate() - lower));
}

// Whether all directions of its latent share this lengthscale.
bool is_shared_lengthscale(const Prior& prior, const Hyperparameter& h) {
  if (h.kind != Hyperparameter::Kind::kernel) return false;
  const Latent& latent = prior.latents[static_cast<std::size_t>(h.owner)];
  const Kernel::Parameter& parameter = latent.kernel.parameters()[static_cast<std::size_t>(h.index)];
  return latent.direction.empty() && parameter.kind == Kernel::ParameterKind::lengthscale;
}

// Loadings that are zero at the first start stay zero (see Training::release). An optimum of short lengthscales wants all short that
// matter, so that those of one latent have a part in common.
std::vector<Hyperparameter> draw_start(const Prior& prior, std::vector<Hyperparameter> hyperparameters, RandomStream& random) {
  const std::set<int> at_zero = latents_at_zero(hyperparameters);
  std::map<int, double> common;  // by latent
  for (Hyperparameter& h : hyperparameters) {
    if (h.is_stationary_at_zero() && at_zero.contains(h.owner)) continue;
    const bool is_shared = is_shared_lengthscale(prior, h);
    if (is_shared && !common.contains(h.owner)) common[h.owner] = random.normal();
    h.value = draw(h, is_shared ? &common[h.owner] : nullptr, random);
  }
  return hyperparameters;
}

class Training {
 public:
  Training(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
           const FitOptions& options, Approximation approximation = {})
      : prior_(prior),
        observations_(observations),
        hyperparameters_(hyperparameters),
        options_(options),
        evaluators_(options, approximation.points != nullptr),
        objective_(prior, observations, hyperparameters, std::move(approximation), evaluators_.alone),
        box_(hyperparameters),
        reports_(static_cast<std::size_t>(n_restarts())),
        results_(static_cast<std::size_t>(n_restarts())),
        fractions_(static_cast<std::size_t>(n_restarts()), 0.0) {
    for (int restart = 0; restart < n_restarts(); ++restart)
      n_own_ += evaluators_.side_by_side.owns(restart, n_restarts()) ? 1 : 0;
  }

  [[nodiscard]] int n_restarts() const {
    return options_.max_iterations == 0 || hyperparameters_.empty() ? 1 : std::max(1, options_.n_restarts);
  }

  void run() {
    const lapack::SingleThread single_thread;
    const std::vector<LbfgsbResult> results = run_side_by_side(n_restarts(), [&](int restart) { return run_restart(restart); });
    for (int restart = 0; restart < n_restarts(); ++restart) {
      store(static_cast<std::size_t>(restart), results[static_cast<std::size_t>(restart)]);
    }
    release();
    while (report_.n_escapes < options_.max_escapes && !stopped() && escape()) ++report_.n_escapes;
    if (options_.standard_errors && options_.max_iterations > 0 && !stopped() && estimates_parameters()) estimate_errors();
    if (options_.n_draws > 0 && options_.max_iterations > 0 && !stopped()) draw_from_posterior();
  }

  /// @throws NumericalError where no restart reached a finite likelihood.
  [[nodiscard]] FitReport report() const {
    FitReport report = report_;
    const std::size_t best = this->best();
    const RestartReport& winner = reports_[best];
    if (!std::isfinite(winner.objective)) {
      if (stopped()) throw NumericalError("stopped before the likelihood was evaluated once: there is no fit");
      throw NumericalError("no restart reached a finite likelihood: check the bounds of the estimated parameters and the noise");
    }
    report.hyperparameters = results_[best];
    report.negative_log_likelihood = winner.negative_log_likelihood;
    report.objective = winner.objective;
    // the best so far may have converged, but not all that was asked for was tried
    const bool interrupted = stopped();
    report.converged = winner.converged && !interrupted;
    report.termination = interrupted ? FitReport::interrupted : winner.termination;
    report.iterations = winner.iterations;
    report.best_restart = static_cast<int>(best);
    report.restarts = reports_;
    return report;
  }
  // results of finite objectives, the best first
  [[nodiscard]] std::vector<std::vector<Hyperparameter>> optima() const {
    std::vector<std::size_t> order(reports_.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(), [&](auto a, auto b) { return reports_[a].objective < reports_[b].objective; });
    std::vector<std::vector<Hyperparameter>> optima;
    for (const std::size_t restart : order) {
      if (std::isfinite(reports_[restart].objective)) optima.push_back(results_[restart]);
    }
    return optima;
  }

 private:
  [[nodiscard]] bool stopped() const { return is_set(options_.stop); }

  // the lowest objective; of equal ones the first
  [[nodiscard]] std::size_t best() const {
    return static_cast<std::size_t>(std::ranges::min_element(reports_, {}, &RestartReport::objective) - reports_.begin());
  }

  [[nodiscard]] bool estimates_parameters() const {
    return std::any_of(hyperparameters_.begin(), hyperparameters_.end(), [](const auto& h) { return h.is_system_parameter(); });
  }

  // A parameter that data know to a millionth of its box bends the objective 10¹² times as much as a lengthscale, and
  // quasi-Newton steps stall: the optimiser sees it in units of what is known of it.
  LbfgsbResult optimise(int restart, const std::vector<Hyperparameter>& from, Likelihood::Workspace& workspace) {
    return optimise(restart, from, scales_of_parameters(objective_, coordinates(from), from, options_.stop, workspace),
                    workspace);
  }

  LbfgsbResult optimise(int restart, const std::vector<Hyperparameter>& from, const VectorXd& scales,
                        Likelihood::Workspace& workspace) {
    LbfgsbOptions options;
    options.max_iterations =
        options_.max_iterations - reports_[static_cast<std::size_t>(restart)].iterations;  // an escape goes on
    options.gradient_tolerance = options_.gradient_tolerance;
    options.reduction_tolerance = options_.reduction_tolerance;
    options.iteration = [&](int iteration, const VectorXd& scaled, double value) {
      tell_improvement(scaled.cwiseProduct(scales), value, FitOptions::seconds_between_improvements);
      return report_iteration(restart, iteration, value);
    };
    options.stop = [&] { return stopped(); };
    LbfgsbResult result = minimise(
        [&](const VectorXd& scaled, VectorXd& gradient) {
          const double value = objective_(scaled.cwiseProduct(scales), &gradient, workspace);
          gradient = gradient.cwiseProduct(scales);
          return value;
        },
        coordinates(from).cwiseQuotient(scales), box_.lower.cwiseQuotient(scales), box_.upper.cwiseQuotient(scales), options);
    result.x = result.x.cwiseProduct(scales);
    return result;
  }

  /// run(k) for each of n, each by one of those who work on this; what all of them found, to all.
  template <typename Run>
  std::vector<LbfgsbResult> run_side_by_side(int n, const Run& run) {
    const Index n_x = std::ssize(hyperparameters_);
    std::vector<LbfgsbResult> results(static_cast<std::size_t>(n));
    Eigen::MatrixXd numbers(n_x + 5, n);  // x, and the rest
    share_out({numbers.data(), static_cast<std::size_t>(numbers.size())}, n, evaluators_.side_by_side,
              [&](int k, std::span<double> column) {
                const LbfgsbResult& one = results[static_cast<std::size_t>(k)] = run(k);
                double* const rest = std::copy(one.x.begin(), one.x.end(), column.data());
                rest[0] = one.value, rest[1] = one.converged ? 1 : 0;
                rest[2] = one.iterations, rest[3] = one.evaluations, rest[4] = one.failed_evaluations;
              });
    for (int k = 0; k < n; ++k) {
      LbfgsbResult& one = results[static_cast<std::size_t>(k)];
      one.x = numbers.col(k).head(n_x);
      const auto rest = numbers.col(k).tail(5);
      one.value = rest[0], one.converged = rest[1] == 1;
      one.iterations = static_cast<int>(rest[2]), one.evaluations = static_cast<int>(rest[3]);
      one.failed_evaluations = static_cast<int>(rest[4]);
      share(one.termination, evaluators_.side_by_side, k, n);
    }
    return results;
  }

  [[nodiscard]] LbfgsbResult not_begun() const {
    LbfgsbResult none;
    none.x = coordinates(hyperparameters_);
    none.value = std::numeric_limits<double>::infinity();
    none.termination = "not begun: stopped on request";
    return none;
  }

  // Draws about the optima of the restarts, the best one first.
  void draw_from_posterior() {
    const std::vector<std::vector<Hyperparameter>> optima = this->optima();
    if (optima.empty()) return;
    const std::vector<bool> held = held_in_draws(prior_, observations_, optima.front());
    bool is_any_drawn = false;
    for (std::size_t k = 0; k < held.size(); ++k) is_any_drawn = is_any_drawn || !(held[k] || hyperparameters_[k].is_fixed());
    if (!is_any_drawn) return;
    HamiltonianOptions options{.seed = options_.seed, .evaluators = evaluators_, .stop = options_.stop};
    options.progress = [&](double fraction) { report_drawing(fraction); };
    try {
      report_.draws = draw_about(objective_, optima, held, options_.n_draws, options);
    } catch (const NumericalError& error) {
      // the fit stands, and says why it has none
      reports_[best()].termination += fmt::format("; {}", error.what());
    }
  }

  void report_drawing(double fraction) {
    if (!options_.progress) return;
    options_.progress({.restart = n_restarts() - 1,
                       .n_restarts = n_restarts(),
                       .best = best_,
                       .seconds = seconds(),
                       .fraction = share_of_restarts() + (1 - share_of_restarts()) * fraction,
                       .is_drawing = true});
  }
  [[nodiscard]] double seconds() const {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }
  // of the evaluations, where hyperparameters are drawn too: about
  [[nodiscard]] double share_of_restarts() const { return options_.n_draws > 0 ? 0.2 : 1; }

  // Where the best run stopped short of its optimum it goes on, now that the curvatures are known, in units of them.
  void estimate_errors() {
    constexpr double near = 0.02;  // standard deviations
    constexpr int n_attempts = 2;
    const std::size_t from = best();
    try {
      Likelihood::Workspace workspace(evaluators_.alone, options_.stop);
      for (int attempt = 0;; ++attempt) {
        const std::vector<Hyperparameter>& at = results_[from];
        const Curvature curvature = curvature_at(objective_, coordinates(at), at, evaluators_, options_.stop);
        const bool may_go_on = attempt < n_attempts && reports_[from].iterations < options_.max_iterations && !stopped();
        if (curvature.distance_from_optimum() <= near || !may_go_on) {
          const bool has_bounded = std::ranges::any_of(at, [](const auto& h) { return h.is_system_parameter() && h.at_bound(); });
          report_.uncertainty = laplace_uncertainty(
              has_bounded ? curvature_at(objective_, coordinates(at), at, evaluators_, options_.stop, AtBound::free_if_open)
                          : curvature,
              at);
          // on the way to an optimum all seems undetermined
          const bool is_cut_short = stopped() || reports_[from].iterations >= options_.max_iterations;
          if (!is_cut_short || curvature.distance_from_optimum() <= near) restore_undetermined(from, workspace);
          return;
        }
        VectorXd scales = VectorXd::Ones(static_cast<Index>(at.size()));
        scales(curvature.free) = curvature.unit.cwiseMin(1);
        const LbfgsbResult further = optimise(static_cast<int>(from), at, scales, workspace);
        if (further.value < reports_[from].objective) store(from, further);
      }
    } catch (const NumericalError& error) {
      // the fit stands, and says why it has none
      reports_[from].termination += fmt::format("; {}", error.what());
    }
  }

  // Parameters that the data do not determine keep their starting values, not those where chance left them, unless these fit worse:
  // of those that are known together only one alone is not free.
  void restore_undetermined(std::size_t from, Likelihood::Workspace& workspace) {
    std::vector<Hyperparameter> restored = results_[from];
    for (std::size_t k = 0; k < restored.size(); ++k) {
      if (restored[k].is_system_parameter() && std::isinf(report_.uncertainty->stddev[static_cast<Index>(k)])) {
        restored[k].value = hyperparameters_[k].value;
      }
    }
    RestartReport& report = reports_[from];
    const double objective = objective_(coordinates(restored), nullptr, workspace);
    if (!(objective <= report.objective + 1e-9 * (1 + std::abs(report.objective)))) return;
    results_[from] = std::move(restored);
    // the objective stays: one that is higher by rounding would make another restart the best
    report.negative_log_likelihood = report.objective - negative_log_hyperpriors(results_[from], nullptr);
  }

  void store(std::size_t restart, const LbfgsbResult& result) {
    results_[restart] = options_.max_iterations == 0 ? hyperparameters_ : objective_.at(result.x);
    RestartReport& report = reports_[restart];
    report.objective = result.value;
    report.negative_log_likelihood = result.value - negative_log_hyperpriors(results_[restart], nullptr);
    report.iterations += result.iterations;
    report.evaluations += result.evaluations;
    report.failed_evaluations += result.failed_evaluations;
    report.converged = result.converged;
    report.termination = result.termination;
    tell_improvement(result.x, result.value, 0);
  }

  /// @param pause  since the last time, below which this one is left out [s]
  void tell_improvement(const VectorXd& x, double value, double pause) {
    if (!options_.improved || options_.max_iterations == 0) return;
    const std::scoped_lock lock(mutex_);
    if (!(value < told_) || seconds() - told_at_ < pause) return;
    FitReport report;
    report.hyperparameters = objective_.at(x);
    report.objective = value;
    report.negative_log_likelihood = value - negative_log_hyperpriors(report.hyperparameters, nullptr);
    report.termination = FitReport::interrupted;
    options_.improved(report, observations_);
    told_ = value;
    told_at_ = seconds();
  }

  // scans each hyperparameter over its box from the best optimum; true when the optimiser got lower from the best point of the
  // scan
  bool escape() {
    const std::size_t from = best();
    if (!std::isfinite(reports_[from].objective) || hyperparameters_.empty()) return false;
    if (reports_[from].iterations >= options_.max_iterations) return false;
    constexpr int n_points = 9;
    const VectorXd x = coordinates(results_[from]);
    // a box that is no more than a limit is too wide to scan, one without width has one point
    std::vector<Index> scanned;
    for (std::size_t k = 0; k < hyperparameters_.size(); ++k) {
      if (hyperparameters_[k].size == 0 && !hyperparameters_[k].is_fixed()) scanned.push_back(static_cast<Index>(k));
    }
    if (scanned.empty()) return false;
    // many hyperparameters would cost more than all restarts
    constexpr int always = 40;
    int spent = n_points * always;
    for (const RestartReport& report : reports_) spent += report.evaluations;
    if (n_points * std::ssize(scanned) > spent) return false;
    const auto moved = [&](int trial) {
      VectorXd there = x;
      const Index k = scanned[static_cast<std::size_t>(trial / n_points)];
      there[k] = box_.lower[k] + (box_.upper[k] - box_.lower[k]) * (trial % n_points + 1) / (n_points + 1);
      return there;
    };
    std::vector<double> values(scanned.size() * n_points);
    share_out(values, static_cast<int>(values.size()), evaluators_.side_by_side, [&](int trial, std::span<double> value) {
      if (stopped()) return;
      Likelihood::Workspace workspace(evaluators_.within(), options_.stop);
      value.front() = objective_(moved(trial), nullptr, workspace);
    });
    if (stopped()) return false;
    reports_[from].evaluations += static_cast<int>(values.size());
    const auto lowest = std::min_element(values.begin(), values.end());
    const double before = reports_[from].objective;
    if (!(*lowest < before)) return false;
    Likelihood::Workspace workspace(evaluators_.alone, options_.stop);
    const LbfgsbResult result =
        optimise(static_cast<int>(from), objective_.at(moved(static_cast<int>(lowest - values.begin()))), workspace);
    if (!(result.value < before)) return false;
    store(from, result);
    // a gain below this is the tail of the same optimum
    return before - result.value > 1e-6 * (1 + std::abs(before));
  }

  LbfgsbResult run_restart(int restart) {
    if (restart > 0 && stopped()) return not_begun();
    RandomStream random(options_.seed, static_cast<std::uint64_t>(restart));
    // where there is one alone its evaluations share the threads
    Likelihood::Workspace workspace(n_restarts() == 1 ? evaluators_.alone : evaluators_.within(), options_.stop);
    // a random start may lie where M is not positive definite: draw again, a few times
    constexpr int max_draws = 20;
    LbfgsbResult result;
    for (int draw = 0; draw < max_draws; ++draw) {
      result = optimise(restart, restart == 0 ? hyperparameters_ : draw_start(prior_, hyperparameters_, random), workspace);
      if (std::isfinite(result.value) || restart == 0 || stopped()) break;
    }
    tell_improvement(result.x, result.value, 0);
    const std::scoped_lock lock(mutex_);
    fractions_[static_cast<std::size_t>(restart)] = 1;
    return result;
  }

  // Where the loading of a latent is zero so is its gradient: every run stays in that smaller model, which has fewer optima. From
  // the best of them the loading is let go.
  void release() {
    const std::size_t from = best();
    const std::set<int> at_zero = latents_at_zero(results_[from]);
    if (at_zero.empty() || stopped() || reports_[from].iterations >= options_.max_iterations) return;
    constexpr int n_draws = 4;
    constexpr double share = 0.1;  // of its size
    const std::vector<LbfgsbResult> drawn = run_side_by_side(n_draws, [&](int draw) {
      if (stopped()) return not_begun();
      RandomStream random(options_.seed, static_cast<std::uint64_t>(n_restarts() + draw));
      std::vector<Hyperparameter> start = results_[from];
      for (Hyperparameter& h : start) {
        if (h.is_stationary_at_zero() && at_zero.contains(h.owner)) h.value = share * h.size * random.normal();
      }
      Likelihood::Workspace workspace(evaluators_.within(), options_.stop);
      return optimise(static_cast<int>(from), start, workspace);
    });
    const auto lowest =
        std::min_element(drawn.begin(), drawn.end(), [](const auto& a, const auto& b) { return a.value < b.value; });
    if (lowest->value < reports_[from].objective) store(from, *lowest);
  }

  bool report_iteration(int restart, int iteration, double value) {
    if (options_.progress) {
      const std::scoped_lock lock(mutex_);
      best_ = std::min(best_, value);
      // few runs take more than some hundred iterations; at an even pace the time that is left falls from the first on, and it does
      // not rise again where a run begins anew from an optimum
      double& of_run = fractions_[static_cast<std::size_t>(restart)];
      of_run = std::max(of_run, 1 - std::exp(-iteration / 100.0));
      double done = 0;
      for (double fraction : fractions_) done += fraction;
      const double fraction = share_of_restarts() * done / std::max(n_own_, 1);
      options_.progress({restart, n_restarts(), iteration, best_, seconds(), fraction});
    }
    return !stopped();
  }

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const std::vector<Hyperparameter>& hyperparameters_;
  const FitOptions& options_;
  Evaluators evaluators_;
  Objective objective_;
  CoordinateBox box_;
  int n_own_ = 0;  // restarts of this process
  std::vector<RestartReport> reports_;
  std::vector<std::vector<Hyperparameter>> results_;
  FitReport report_;  // uncertainty, draws and escapes

  std::mutex mutex_;  // guards what follows
  std::vector<double> fractions_;
  double best_ = std::numeric_limits<double>::infinity();
  double told_ = std::numeric_limits<double>::infinity(), told_at_ = 0;  // objective, and when [s]
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace

FitReport trained(const Prior& prior, const std::vector<Observations>& observations,
                  const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options, Approximation approximation,
                  std::vector<std::vector<Hyperparameter>>* optima) {
  Training training(prior, observations, hyperparameters, options, std::move(approximation));
  training.run();
  FitReport report = training.report();
  if (optima != nullptr) *optima = training.optima();
  return report;
}

}  // namespace gp2
