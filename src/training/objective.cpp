#include "training/objective.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <string_view>
#include <utility>

#include "inference/posterior_implementation.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

// ½ zᵀ ((1 − ρ) I + ρ 1 1ᵀ)⁻¹ z of each family of n, = ½ (zᵀz − ρ (1ᵀz)²/(1 + (n − 1) ρ))/(1 − ρ)
double negative_log_hyperpriors(const std::vector<Hyperparameter>& hyperparameters, VectorXd* gradient) {
  struct Family {
    int n = 0;
    double sum = 0, correlation = 0;
    [[nodiscard]] double of_all() const { return correlation * sum / (1 + (n - 1) * correlation); }
  };
  std::map<std::string_view, Family> families;
  for (const Hyperparameter& h : hyperparameters) {
    const HyperPrior& prior = h.hyperprior;
    if (prior.form == HyperPrior::Form::none || prior.family.empty()) continue;
    Family& family = families[prior.family];
    ++family.n;
    family.sum += prior.standardised(h.value);
    family.correlation = prior.correlation;
  }
  double sum = 0;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const HyperPrior& prior = hyperparameters[k].hyperprior;
    if (prior.form == HyperPrior::Form::none) continue;
    const double z = prior.standardised(hyperparameters[k].value);
    const double slope = prior.family.empty() ? z : (z - families[prior.family].of_all()) / (1 - prior.correlation);
    sum += 0.5 * z * slope;
    if (gradient != nullptr) {
      (*gradient)[static_cast<Index>(k)] += slope * prior.standardised_slope(hyperparameters[k].value, hyperparameters[k].map());
    }
  }
  return sum;
}

namespace {

Likelihood::Options likelihood_options(const std::vector<Hyperparameter>& hyperparameters, const Workers& workers) {
  Likelihood::Options options;
  options.workers = workers;
  for (const Hyperparameter& h : hyperparameters) h.ask_for_gradient(options);
  return options;
}

}  // namespace

Approximation about_posterior_mean(const Prior& prior, const std::vector<Observations>& observations,
                                   const std::vector<Hyperparameter>& hyperparameters) {
  if (!prior.is_nonlinear()) return {};
  return {.points = nullptr, .about = linearisation_of(prior, observations, model_values(prior, observations, hyperparameters))};
}

Objective::Objective(const Prior& prior, const std::vector<Observations>& observations,
                     const std::vector<Hyperparameter>& hyperparameters, Approximation approximation, const Workers& workers)
    : prior_(prior),
      observations_(observations),
      hyperparameters_(hyperparameters),
      approximation_(std::move(approximation)),
      likelihood_(prior, observations, values(hyperparameters), likelihood_options(hyperparameters, workers)) {}

ModelValues Objective::values(const std::vector<Hyperparameter>& hyperparameters) const {
  ModelValues values = model_values(prior_, observations_, hyperparameters);
  values.inducing = approximation_.points;
  values.about = approximation_.about;
  return values;
}

std::vector<Hyperparameter> Objective::at(const VectorXd& x) const {
  std::vector<Hyperparameter> hyperparameters = hyperparameters_;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    hyperparameters[k].value = hyperparameters[k].value_at(x[static_cast<Index>(k)]);
  }
  return hyperparameters;
}

double Objective::operator()(const VectorXd& x, VectorXd* gradient, Likelihood::Workspace& workspace) const {
  const std::vector<Hyperparameter> hyperparameters = at(x);
  ModelGradient model_gradient;
  const double value = likelihood_.evaluate(values(hyperparameters), gradient == nullptr ? nullptr : &model_gradient, workspace);
  if (!std::isfinite(value)) return value;
  for (std::size_t k = 0; gradient != nullptr && k < hyperparameters.size(); ++k) {
    (*gradient)[static_cast<Index>(k)] = hyperparameters[k].likelihood_slope(model_gradient);
  }
  return value + negative_log_hyperpriors(hyperparameters, gradient);
}

void share(std::string& text, const Workers& workers, int part, int n_parts) {
  auto size = static_cast<double>(text.size());
  workers.share({&size, 1}, part, n_parts);
  text.resize(static_cast<std::size_t>(size));
  std::vector<double> characters(text.begin(), text.end());
  workers.share(characters, part, n_parts);
  std::transform(characters.begin(), characters.end(), text.begin(), [](double one) { return static_cast<char>(one); });
}

Evaluators::Evaluators(const FitOptions& options, bool through_points) : Evaluators(thread_count(options.n_threads)) {
  const int most = options.max_side_by_side;
  if (most > 0) side_by_side.n_threads = std::min(most, side_by_side.n_threads);
  if (options.ranks && through_points) side_by_side = 1;
  (through_points ? alone : side_by_side).ranks = options.ranks;
}

VectorXd coordinates(const std::vector<Hyperparameter>& hyperparameters) {
  VectorXd x(static_cast<Index>(hyperparameters.size()));
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) x[static_cast<Index>(k)] = hyperparameters[k].coordinate();
  return x;
}

CoordinateBox::CoordinateBox(const std::vector<Hyperparameter>& hyperparameters)
    : lower(static_cast<Index>(hyperparameters.size())), upper(lower.size()) {
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    lower[static_cast<Index>(k)] = hyperparameters[k].lower_coordinate();
    upper[static_cast<Index>(k)] = hyperparameters[k].upper_coordinate();
  }
}

}  // namespace gp2
