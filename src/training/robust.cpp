#include "gp2/robust.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <tuple>

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double normal_median = 0.6744897501960817;  // of |z|, z ~ N(0, 1)

double median(std::vector<double> values) {
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// the values of row k that are measured
std::vector<double> measured(const MatrixXd& values, Index k) {
  std::vector<double> some;
  for (const double value : values.row(k)) {
    if (!std::isnan(value)) some.push_back(value);
  }
  return some;
}

struct Choice {
  std::vector<Observations> observations;  // the distrusted values with a noise of their own
  std::vector<DistrustedValue> distrusted;

  [[nodiscard]] std::set<std::tuple<int, int, int>> values() const {
    std::set<std::tuple<int, int, int>> set;
    for (const DistrustedValue& value : distrusted) set.emplace(value.group, value.row, value.state);
    return set;
  }
};

// what to distrust in the light of a posterior under whatever noise
Choice choose(const std::vector<Observations>& observations, const Posterior& posterior, double threshold) {
  const std::vector<LeaveOneOut> left_out = leave_one_out(posterior);
  Choice choice{observations, {}};
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    const VectorXd& sigma = posterior.values().noise_stddev[g];
    MatrixXd noise(group.values.rows(), group.values.cols());
    for (Index i = 0; i < noise.cols(); ++i) noise.col(i) = group.noise_at(sigma, i);
    const MatrixXd residual = group.values - left_out[g].mean;
    const MatrixXd stddev = (left_out[g].variance.array() + noise.array().square()).sqrt();
    for (Index k = 0; k < noise.rows(); ++k) {
      std::vector<double> distances = measured((residual.array() / stddev.array()).abs(), k);
      if (distances.empty()) continue;
      const double usual = std::max(1.0, median(std::move(distances)) / normal_median);
      for (Index i = 0; i < noise.cols(); ++i) {
        const double distance = std::abs(residual(k, i)) / (usual * stddev(k, i));
        if (!(distance > threshold)) continue;
        const double r = residual(k, i);
        const double factor = std::sqrt(r * r - left_out[g].variance(k, i)) / noise(k, i);
        MatrixXd& scale = choice.observations[g].noise_scale;
        if (scale.size() == 0) scale.setOnes(noise.rows(), noise.cols());
        scale(k, i) *= factor;
        choice.distrusted.push_back({static_cast<int>(g), static_cast<int>(k), static_cast<int>(i), distance, factor});
      }
    }
  }
  std::stable_sort(choice.distrusted.begin(), choice.distrusted.end(),
                   [](const DistrustedValue& a, const DistrustedValue& b) { return a.distance > b.distance; });
  return choice;
}

// what to distrust at sight, under a noise to start with
Choice choose_at_sight(const std::vector<Observations>& observations, const std::vector<VectorXd>& noise_stddev) {
  const std::vector<Observations> usual = without_gross_errors(observations);
  Choice choice{observations, {}};
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const MatrixXd& values = observations[g].values;
    const VectorXd mean = row_mean(usual[g].values);
    MatrixXd& scale = choice.observations[g].noise_scale;
    for (Index i = 0; i < values.cols(); ++i) {
      for (Index k = 0; k < values.rows(); ++k) {
        if (std::isnan(values(k, i)) || !std::isnan(usual[g].values(k, i))) continue;
        const double noise = observations[g].noise_at(noise_stddev[g], i)[k];
        const double factor = std::max(1.0, std::abs(values(k, i) - mean[k]) / noise);
        if (scale.size() == 0) scale.setOnes(values.rows(), values.cols());
        scale(k, i) *= factor;
        choice.distrusted.push_back({static_cast<int>(g), static_cast<int>(k), static_cast<int>(i), factor, factor});
      }
    }
  }
  return choice;
}

}  // namespace

std::vector<Observations> without_gross_errors(std::vector<Observations> observations) {
  constexpr double gross = 10;
  for (Observations& group : observations) {
    for (Index k = 0; k < group.values.rows(); ++k) {
      std::vector<double> values = measured(group.values, k);
      if (values.empty()) continue;
      const double middle = median(values);
      for (double& value : values) value = std::abs(value - middle);
      const double spread = median(std::move(values)) / normal_median;
      if (spread == 0) continue;  // most values are the same
      for (double& value : group.values.row(k)) {
        if (std::abs(value - middle) > gross * spread) value = std::numeric_limits<double>::quiet_NaN();
      }
    }
  }
  return observations;
}

Fit fit_robust(const Prior& prior, const std::vector<Observations>& observations,
               const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options, const RobustOptions& robust) {
  const auto stopped = [&] { return options.stop != nullptr && options.stop->load(); };
  // a choice to start with, by single runs of the optimiser
  FitOptions quick = options;
  quick.n_restarts = 1;
  quick.max_escapes = 0;
  Choice choice = choose_at_sight(observations, model_values(prior, observations, hyperparameters).noise_stddev);
  std::vector<Hyperparameter> start = hyperparameters;
  const auto turn = [&](const FitOptions& how, const std::vector<Hyperparameter>& from, bool& is_settled) {
    Fit fitted = fit(prior, choice.observations, from, how);
    Choice next = choose(observations, fitted.posterior, robust.threshold);
    is_settled = next.values() == choice.values();
    fitted.report.distrusted = choice.distrusted;
    if (!is_settled) choice = std::move(next);
    return fitted;
  };
  bool is_settled = false;
  for (int round = 0; round < robust.max_rounds && !is_settled && !stopped(); ++round) {
    start = turn(quick, start, is_settled).report.hyperparameters;
  }
  // the fit, and another where its optimum is so different that the choice changes
  Fit fitted = turn(options, hyperparameters, is_settled);
  for (int round = 1; round < robust.max_rounds && !is_settled && !stopped(); ++round) {
    fitted = turn(options, fitted.report.hyperparameters, is_settled);
  }
  return fitted;
}

}  // namespace gp2
