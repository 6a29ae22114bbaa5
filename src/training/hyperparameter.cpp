#include "gp2/training/hyperparameter.hpp"

#include <algorithm>
#include <cmath>

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

double CoordinateMap::coordinate(double value) const { return is_logarithm ? std::log(value) : (value - origin) / unit; }

double CoordinateMap::value(double x) const { return is_logarithm ? std::exp(x) : origin + x * unit; }

double CoordinateMap::value_slope(double value) const { return is_logarithm ? value : unit; }

double CoordinateMap::logarithm_slope(double value) const { return is_logarithm ? 1 : unit / value; }

namespace {

// z of ½ z²
double standardised(const HyperPrior& prior, double value) {
  const double distance = prior.form == HyperPrior::Form::normal ? value - prior.median : std::log(value / prior.median);
  return distance / prior.stddev;
}

}  // namespace

double HyperPrior::negative_log(double value) const {
  if (form == Form::none) return 0;
  const double z = standardised(*this, value);
  return 0.5 * z * z;
}

double HyperPrior::slope(double value, const CoordinateMap& map) const {
  if (form == Form::none) return 0;
  const double inner = form == Form::normal ? map.value_slope(value) : map.logarithm_slope(value);
  return standardised(*this, value) / stddev * inner;
}

Hyperparameter Hyperparameter::of(Kind kind, std::size_t owner, std::size_t index) {
  Hyperparameter h;
  h.kind = kind;
  h.owner = static_cast<int>(owner);
  h.index = static_cast<int>(index);
  h.positive = kind != Kind::parameter && kind != Kind::loading;
  return h;
}

bool Hyperparameter::at_bound() const {
  const double tolerance = 1e-6;
  if (positive) return std::log(value / lower) <= tolerance || std::log(upper / value) <= tolerance;
  return value - lower <= tolerance * (upper - lower) || upper - value <= tolerance * (upper - lower);
}

void Hyperparameter::write(ModelValues& values) const {
  const auto of = static_cast<std::size_t>(owner);
  switch (kind) {
    case Kind::kernel:
      values.kernel[of][index] = value;
      break;
    case Kind::signal_stddev:
      values.signal_stddev[of][index] = value;
      break;
    case Kind::shared_signal_stddev:
      values.signal_stddev[of] = value * column_scale;
      break;
    case Kind::loading:
      values.free_loading[of].reshaped()[index] = value;
      break;
    case Kind::noise_stddev:
      values.noise_stddev[of][index] = value;
      break;
    case Kind::parameter:
      values.parameters[index] = value;
      break;
  }
}

double Hyperparameter::likelihood_slope(const ModelGradient& gradient) const {
  const auto of = static_cast<std::size_t>(owner);
  switch (kind) {
    case Kind::kernel:
      return gradient.log_kernel[of][index] * map().logarithm_slope(value);
    case Kind::signal_stddev:
      return gradient.log_signal_stddev[of][index] * map().logarithm_slope(value);
    case Kind::shared_signal_stddev:
      return gradient.log_signal_stddev[of].sum() * map().logarithm_slope(value);
    case Kind::loading:
      return gradient.free_loading[of].reshaped()[index] * map().value_slope(value);
    case Kind::noise_stddev:
      return gradient.log_noise_stddev[of][index] * map().logarithm_slope(value);
    case Kind::parameter:
      return gradient.parameters[index] * map().value_slope(value);
  }
  return 0;
}

void Hyperparameter::ask_for_gradient(Likelihood::Options& options) const {
  if (kind == Kind::parameter) options.gradient_parameters.push_back(index);
  if (kind == Kind::noise_stddev) options.noise_gradient = true;
}

CoordinateMap Hyperparameter::map() const {
  if (positive) return {};
  if (size > 0) return {false, 0, size};
  return {false, lower, upper - lower};
}

double Hyperparameter::value_at(double x) const { return std::clamp(map().value(x), lower, upper); }

ModelValues model_values(const Prior& prior, const std::vector<Observations>& observations,
                         const std::vector<Hyperparameter>& hyperparameters) {
  ModelValues values;
  for (const Latent& latent : prior.latents) {
    values.kernel.emplace_back(VectorXd::Ones(static_cast<Index>(latent.kernel.parameters().size())));
    values.signal_stddev.emplace_back(VectorXd::Ones(latent.size()));
    values.free_loading.emplace_back();
    if (latent.free_loading) values.free_loading.back().setZero(latent.size(), *latent.free_loading);
  }
  for (const Observations& group : observations) values.noise_stddev.push_back(group.noise().stddev());
  values.parameters = prior.system->parameter_values();
  for (const Hyperparameter& h : hyperparameters) h.write(values);
  return values;
}

}  // namespace gp2
