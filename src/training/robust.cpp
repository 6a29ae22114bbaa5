#include "gp2/training/robust.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <tuple>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "base/number_range.hpp"
#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "inference/requirements.hpp"
#include "training/constraint_parameters.hpp"
#include "training/hamiltonian.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// s of each value, 1 where it has no noise of its own
MatrixXd scale_of(const Observations& group) {
  return group.noise().has_scale() ? group.noise().scale() : MatrixXd::Ones(group.values().rows(), group.values().cols());
}

Observations with_scale(const Observations& group, MatrixXd scale) {
  return group.with_noise(Noise(group.noise().stddev(), group.noise().is_estimated(), std::move(scale)));
}

struct Choice {
  std::vector<Observations> observations;  // the distrusted values with a noise of their own
  std::vector<DistrustedValue> distrusted;

  [[nodiscard]] std::map<std::tuple<int, int, int>, double> factors() const {
    std::map<std::tuple<int, int, int>, double> factors;
    for (const DistrustedValue& value : distrusted) factors[{value.group, value.row, value.state}] = value.noise_factor;
    return factors;
  }
};

// Whether the same values are distrusted, by nearly the same factors: these are of a noise that may be estimated, which falls once
// outliers add less to it.
bool are_near(const Choice& a, const Choice& b) {
  constexpr double near = 1.1;
  return std::ranges::equal(a.factors(), b.factors(), [](const auto& one, const auto& other) {
    return one.first == other.first && std::max(one.second, other.second) <= near * std::min(one.second, other.second);
  });
}

// What all other values say of each, as leave_one_out. A posterior that keeps some of many states (KeptStates) says of each value with
// it, y ~ N(m, v + σ²), what it says without: with h = v/σ², y − m and v are (1 − h) times what they are then.
std::vector<LeaveOneOut> left_out_of(const std::vector<Observations>& fitted, const Posterior& posterior) {
  if (posterior.n_states() == n_states(posterior.observations())) return leave_one_out(posterior);
  constexpr double most = 0.99;  // of h, of which a discrepancy that counts as noise is no part
  std::vector<LeaveOneOut> out;
  for (std::size_t g = 0; g < fitted.size(); ++g) {
    const Observations& group = fitted[g];
    const Posterior::Marginal given = posterior.marginal(group.view(), group.states(), /*n_threads=*/0);
    const MatrixXd variance = given.stddev().cwiseAbs2();
    const MatrixXd noise = group.noise_of_values(posterior.values().noise_stddev[g]);
    const Eigen::ArrayXXd rest = 1 - (variance.array() / noise.array().square()).min(most);
    out.push_back({group.values().array() - (group.values() - given.mean).array() / rest, variance.array() / rest});
  }
  return out;
}

// what to distrust in the light of a posterior under whatever noise
// @param fitted  the observations with the noise that the posterior was found with
Choice choose(const std::vector<Observations>& observations, const std::vector<Observations>& fitted, const Posterior& posterior,
              double threshold) {
  const std::vector<LeaveOneOut> left_out = left_out_of(fitted, posterior);
  Choice choice{observations, {}};
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    const MatrixXd noise = group.noise_of_values(posterior.values().noise_stddev[g]);
    MatrixXd scale = scale_of(group);
    const std::size_t n_before = choice.distrusted.size();
    const MatrixXd residual = group.values() - left_out[g].mean;
    const MatrixXd stddev = (left_out[g].variance.array() + noise.array().square()).sqrt();
    for (Index k = 0; k < noise.rows(); ++k) {
      std::vector<double> distances = measured_entries((residual.array() / stddev.array()).abs(), k);
      if (distances.empty()) continue;
      const double usual = std::max(1.0, median(std::move(distances)) / median_of_normal);
      for (Index i = 0; i < noise.cols(); ++i) {
        const double r = residual(k, i), distance = std::abs(r) / (usual * stddev(k, i));
        const double likeliest = r * r - left_out[g].variance(k, i);  // variance of its noise
        if (!(distance > threshold && likeliest > noise(k, i) * noise(k, i))) continue;
        const double factor = std::sqrt(likeliest) / noise(k, i);
        scale(k, i) *= factor;
        choice.distrusted.push_back({static_cast<int>(g), static_cast<int>(k), static_cast<int>(i), distance, factor});
      }
    }
    if (choice.distrusted.size() > n_before) choice.observations[g] = with_scale(group, std::move(scale));
  }
  std::stable_sort(choice.distrusted.begin(), choice.distrusted.end(),
                   [](const DistrustedValue& a, const DistrustedValue& b) { return a.distance > b.distance; });
  return choice;
}

// the values without those that lie farther than `threshold` robust standard deviations from the median of their row, and those
// that have no square
MatrixXd without_far_values(MatrixXd near, double threshold) {
  near = (near.array().abs() > largest_number).select(not_a_number, near);
  for (Index k = 0; k < near.rows(); ++k) {
    std::vector<double> values = measured_entries(near, k);
    if (values.empty()) continue;
    const double middle = median(values);
    for (double& value : values) value = std::abs(value - middle);
    const double spread = median(std::move(values)) / median_of_normal;
    if (spread == 0) continue;  // most values are the same
    for (double& value : near.row(k)) {
      if (std::abs(value - middle) > threshold * spread) value = not_a_number;
    }
  }
  return near;
}

// Values that have no square are nothing but errors: they are distrusted and not measured.
std::vector<DistrustedValue> leave_out_impossible(std::vector<Observations>& observations,
                                                  const std::vector<VectorXd>& noise_stddev) {
  std::vector<DistrustedValue> impossible;
  for (std::size_t g = 0; g < observations.size(); ++g) {
    MatrixXd values = observations[g].values();
    const std::size_t n_before = impossible.size();
    for (Index i = 0; i < values.cols(); ++i) {
      for (Index k = 0; k < values.rows(); ++k) {
        if (!(std::abs(values(k, i)) > largest_number)) continue;
        const double distance = std::abs(values(k, i)) / observations[g].noise_at(noise_stddev[g], i)[k];
        const double factor = std::min(distance, std::numeric_limits<double>::max());
        impossible.push_back({static_cast<int>(g), static_cast<int>(k), static_cast<int>(i), factor, factor});
        values(k, i) = not_a_number;
      }
    }
    if (impossible.size() > n_before) observations[g] = observations[g].with_values(std::move(values));
  }
  return impossible;
}

// what to distrust at sight, under a noise to start with
Choice choose_at_sight(const std::vector<Observations>& observations, const std::vector<VectorXd>& noise_stddev,
                       double threshold) {
  Choice choice{observations, {}};
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const MatrixXd& values = observations[g].values();
    MatrixXd scale = scale_of(observations[g]);
    const std::size_t n_before = choice.distrusted.size();
    const MatrixXd usual = without_far_values(values, threshold);
    const VectorXd mean = row_mean(usual);
    for (Index i = 0; i < values.cols(); ++i) {
      for (Index k = 0; k < values.rows(); ++k) {
        if (std::isnan(values(k, i)) || !std::isnan(usual(k, i))) continue;
        const double noise = observations[g].noise_at(noise_stddev[g], i)[k];
        const double factor = std::max(1.0, std::abs(values(k, i) - mean[k]) / noise);
        scale(k, i) *= factor;
        choice.distrusted.push_back({static_cast<int>(g), static_cast<int>(k), static_cast<int>(i), factor, factor});
      }
    }
    if (choice.distrusted.size() > n_before) choice.observations[g] = with_scale(observations[g], std::move(scale));
  }
  return choice;
}

// Turns of fit and choice.
class Search {
 public:
  Search(const Prior& prior, const std::vector<Observations>& observations, const FitOptions& options,
         const RobustOptions& robust)
      : prior_(prior), observations_(observations), options_(options), robust_(robust) {}

  /// Fits until the choice stays. Stopped on request, the best is that so far.
  void run(Choice choice, std::vector<Hyperparameter> start, const FitOptions& options) {
    for (int round = 0; round < robust_.max_rounds && (!best_ || !stopped()); ++round) {
      std::optional<Fit> next_fit = fit_unless_stopped(choice, start, options);
      if (!next_fit) break;
      Fit& fitted = *next_fit;
      start = fitted.report.hyperparameters;
      std::optional<Choice> next;
      if (!stopped()) next = choose(observations_, choice.observations, fitted.posterior, robust_.threshold);
      fitted.report.distrusted = choice.distrusted;
      const double cost = fitted.report.objective + price() * static_cast<double>(choice.distrusted.size());
      if (cost < lowest_cost_) {
        lowest_cost_ = cost;
        best_ = std::move(fitted);
        best_choice_ = choice;
      }
      if (!next || are_near(*next, choice)) break;
      choice = std::move(*next);
    }
    if (!stopped()) return;
    best_->report.converged = false;
    best_->report.termination = FitReport::interrupted;
  }

  [[nodiscard]] const Fit& best() const { return *best_; }
  /// The observations of this fit.
  [[nodiscard]] const Choice& best_choice() const { return best_choice_; }
  void forget_cost() { lowest_cost_ = std::numeric_limits<double>::infinity(); }

 private:
  [[nodiscard]] bool stopped() const { return is_set(options_.stop); }
  /// Nothing where it is stopped before it has anything and there is a best already.
  [[nodiscard]] std::optional<Fit> fit_unless_stopped(const Choice& choice, const std::vector<Hyperparameter>& start,
                                                      const FitOptions& options) const {
    try {
      return fit(prior_, choice.observations, start, options);
    } catch (const NumericalError&) {
      if (!best_ || !stopped()) throw;
      return std::nullopt;
    }
  }
  // what distrusting a value at the threshold lowers the objective by: ½ (z² − 1 − log z²)
  [[nodiscard]] double price() const {
    const double square = robust_.threshold * robust_.threshold;
    return 0.5 * (square - 1 - std::log(square));
  }

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const FitOptions& options_;
  const RobustOptions& robust_;
  std::optional<Fit> best_;
  Choice best_choice_;
  double lowest_cost_ = std::numeric_limits<double>::infinity();
};

constexpr double gross = 10, suspicious = 3;  // robust standard deviations from the median

}  // namespace

std::vector<Observations> without_gross_errors(std::vector<Observations> observations) {
  for (Observations& group : observations) group = group.with_values(without_gross_errors(group.values()));
  return observations;
}

MatrixXd without_gross_errors(const MatrixXd& values) { return without_far_values(values, gross); }

namespace {

// Draws about a fit, under which its posterior is from then on.
void add_draws(const Prior& prior, const std::vector<Observations>& observations, const FitOptions& options, Fit& out) {
  // what is not drawn is to be the same in the report and in each of the draws
  std::vector<Hyperparameter> about = out.report.hyperparameters;
  const std::vector<bool> held = held_in_draws(prior, observations, about);
  for (std::size_t k = 0; k < held.size(); ++k) {
    if (held[k]) about[k].hold();
  }
  try {
    out.report.draws = fit(prior, observations, about, options).report.draws;
  } catch (const NumericalError&) {
    if (!is_set(options.stop)) throw;
  }
  if (is_set(options.stop)) {
    out.report.converged = false;
    out.report.termination = FitReport::interrupted;
  }
  if (!out.report.draws) return;
  if (out.report.inducing) out.report.inducing->summary = nullptr;  // which was of the optimum
  const Workers workers(thread_count(options.n_threads), options.ranks);
  out.posterior = possible_posterior(prior, observations, out.report, workers);
  if (out.report.inducing) out.report.inducing->summary = out.posterior.summary();
}

}  // namespace

Fit fit_robust(const Prior& prior, const std::vector<Observations>& observations,
               const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options, const RobustOptions& robust) {
  const auto start = std::chrono::steady_clock::now();
  require_observations(prior, observations);
  require_hyperparameters(prior, observations, hyperparameters);
  if (!(robust.threshold > 0)) {
    throw InputError(fmt::format("fit_robust: threshold must be positive, got {}", robust.threshold));
  }
  if (robust.max_rounds < 1)
    throw InputError(fmt::format("fit_robust: max_rounds must be at least 1, got {}", robust.max_rounds));
  FitOptions quick = options;
  quick.n_restarts = 1;
  quick.max_escapes = 0;
  // Outliers hide behind each other where a fit explains them all, by a signal that is large and short. From a choice that is
  // too strict at first it is not drawn there; the objective, at a price for each value distrusted, decides between them.
  const std::vector<VectorXd> noise = model_values(prior, observations, hyperparameters).noise_stddev;
  std::vector<Observations> possible = observations;
  const std::vector<DistrustedValue> impossible = leave_out_impossible(possible, noise);
  FitOptions full = options;
  full.n_draws = quick.n_draws = 0;  // drawn once, at the end
  Search search(prior, possible, full, robust);
  for (const double threshold : {gross, suspicious}) {
    search.run(choose_at_sight(possible, noise, threshold), hyperparameters, quick);
  }
  search.forget_cost();
  search.run(search.best_choice(), hyperparameters, full);
  Fit out = search.best();
  out.report.distrusted.insert(out.report.distrusted.begin(), impossible.begin(), impossible.end());
  if (options.n_draws > 0 && !is_set(options.stop)) {
    FitOptions about_best = quick;
    about_best.n_draws = options.n_draws;
    about_best.standard_errors = false;
    add_draws(prior, search.best_choice().observations, about_best, out);
  }
  out.report.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return out;
}

}  // namespace gp2
