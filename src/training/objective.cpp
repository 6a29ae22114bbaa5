#include "training/objective.hpp"

#include <algorithm>
#include <cmath>

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

double to_internal(const Hyperparameter& h, double value) {
  if (h.kind == Kind::mixing) return value / h.scale[0];
  return h.is_positive() ? std::log(value) : (value - h.lower) / (h.upper - h.lower);
}

double from_internal(const Hyperparameter& h, double x) {
  if (h.kind == Kind::mixing) return std::clamp(x * h.scale[0], h.lower, h.upper);
  const double value = h.is_positive() ? std::exp(x) : h.lower + x * (h.upper - h.lower);
  return std::clamp(value, h.lower, h.upper);
}

double hyperprior(const std::vector<Hyperparameter>& hyperparameters, VectorXd* gradient) {
  double sum = 0;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const Hyperparameter& h = hyperparameters[k];
    const bool normal = h.stddev > 0;
    if (!normal && h.log_stddev == 0) continue;
    const double stddev = normal ? h.stddev : h.log_stddev;
    const double distance = (normal ? h.value - h.median : std::log(h.value / h.median)) / stddev;
    sum += 0.5 * distance * distance;
    if (gradient == nullptr) continue;
    // d value/dx of a θ, and d log value/dx, which is 1 of what is optimised as a logarithm
    const double width = h.kind == Kind::parameter ? h.upper - h.lower : 1;
    const double slope = normal ? width : h.kind == Kind::parameter ? width / h.value : 1;
    (*gradient)[static_cast<Index>(k)] += distance / stddev * slope;
  }
  return sum;
}

namespace {

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
    case Kind::mixing:
      return gradient.mixing[owner].reshaped()[h.index] * h.scale[0];
    case Kind::sqrt_kappa:
      return gradient.mixing[owner].rightCols(gradient.mixing[owner].rows())(h.index, h.index) * h.value;
  }
  return 0;
}

Likelihood::Options likelihood_options(const std::vector<Hyperparameter>& hyperparameters) {
  Likelihood::Options options;
  for (const Hyperparameter& h : hyperparameters) {
    if (h.kind == Kind::parameter) options.gradient_parameters.push_back(h.index);
    if (h.kind == Kind::noise_stddev) options.noise_gradient = true;
  }
  return options;
}

}  // namespace

Objective::Objective(const Prior& prior, const std::vector<Observations>& observations,
                     const std::vector<Hyperparameter>& hyperparameters)
    : prior_(prior),
      observations_(observations),
      hyperparameters_(hyperparameters),
      likelihood_(prior, observations, model_values(prior, observations, hyperparameters), likelihood_options(hyperparameters)) {}

std::vector<Hyperparameter> Objective::at(const VectorXd& x) const {
  std::vector<Hyperparameter> hyperparameters = hyperparameters_;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    hyperparameters[k].value = from_internal(hyperparameters[k], x[static_cast<Index>(k)]);
  }
  return hyperparameters;
}

double Objective::operator()(const VectorXd& x, VectorXd* gradient, Likelihood::Workspace& workspace) const {
  const std::vector<Hyperparameter> hyperparameters = at(x);
  ModelValues model_gradient;
  const double value = likelihood_.evaluate(model_values(prior_, observations_, hyperparameters),
                                            gradient == nullptr ? nullptr : &model_gradient, workspace);
  if (!std::isfinite(value)) return value;
  for (std::size_t k = 0; gradient != nullptr && k < hyperparameters.size(); ++k) {
    (*gradient)[static_cast<Index>(k)] = gather(hyperparameters[k], model_gradient);
  }
  return value + hyperprior(hyperparameters, gradient);
}

VectorXd internal_values(const std::vector<Hyperparameter>& hyperparameters) {
  VectorXd x(static_cast<Index>(hyperparameters.size()));
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    x[static_cast<Index>(k)] = to_internal(hyperparameters[k], hyperparameters[k].value);
  }
  return x;
}

}  // namespace gp2
