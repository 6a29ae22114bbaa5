#include "gp2/training/hyperparameter.hpp"

#include <algorithm>
#include <cmath>
#include <set>
#include <tuple>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

double CoordinateMap::coordinate(double value) const { return is_logarithm ? std::log(value) : (value - origin) / unit; }

double CoordinateMap::value(double x) const { return is_logarithm ? std::exp(x) : origin + x * unit; }

double CoordinateMap::value_slope(double value) const { return is_logarithm ? value : unit; }

double CoordinateMap::logarithm_slope(double value) const { return is_logarithm ? 1 : unit / value; }

double HyperPrior::standardised(double value) const {
  return (form == Form::normal ? value - median : std::log(value / median)) / stddev;
}

double HyperPrior::standardised_slope(double value, const CoordinateMap& map) const {
  return (form == Form::normal ? map.value_slope(value) : map.logarithm_slope(value)) / stddev;
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
  if (is_fixed()) return false;
  const double tolerance = 1e-6;
  if (positive) return std::log(value / lower) <= tolerance || std::log(upper / value) <= tolerance;
  const auto is_near = [&](double bound) {
    // of a box far wider than the bound is large, that part may be larger than the value
    const double within = tolerance * (upper - lower);
    return std::abs(value - bound) <= (bound == 0 ? within : std::min(within, 1e-3 * std::abs(bound)));
  };
  return is_near(lower) || is_near(upper);
}

void Hyperparameter::hold() {
  if (!positive && size == 0) size = upper - lower;
  lower = upper = value;
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
      values.signal_stddev[of].array() *= value * column_scale.array();
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
  for (const Follower& f : followers) values.signal_stddev[static_cast<std::size_t>(f.latent)][f.column] *= f.share * value;
}

double Hyperparameter::likelihood_slope(const ModelGradient& gradient) const {
  const auto of = static_cast<std::size_t>(owner);
  double by_logarithm = 0;  // ∂NLL/∂log v
  for (const Follower& f : followers) by_logarithm += gradient.log_signal_stddev[static_cast<std::size_t>(f.latent)][f.column];
  switch (kind) {
    case Kind::kernel:
      by_logarithm += gradient.log_kernel[of][index];
      break;
    case Kind::signal_stddev:
      by_logarithm += gradient.log_signal_stddev[of][index];
      break;
    case Kind::shared_signal_stddev:
      by_logarithm += gradient.log_signal_stddev[of].sum();
      break;
    case Kind::noise_stddev:
      by_logarithm += gradient.log_noise_stddev[of][index];
      break;
    case Kind::loading:
      return gradient.free_loading[of].reshaped()[index] * map().value_slope(value);
    case Kind::parameter:
      return gradient.parameters[index] * map().value_slope(value);
  }
  return by_logarithm * map().logarithm_slope(value);
}

void Hyperparameter::ask_for_gradient(Likelihood::Options& options) const {
  if (kind == Kind::parameter) options.gradient_parameters.push_back(index);
  if (kind == Kind::noise_stddev) options.noise_gradient = true;
}

CoordinateMap Hyperparameter::map() const {
  if (positive) return {};
  if (size > 0) return {false, 0, size};
  const double unit_of_held = lower == 0 ? 1 : std::abs(lower);
  return {false, lower, is_fixed() ? unit_of_held : upper - lower};
}

double Hyperparameter::value_at(double x) const { return std::clamp(map().value(x), lower, upper); }

namespace {

// how many indices its kind has at its owner; −1 where there is no such owner
Index n_places(const Hyperparameter& h, const Prior& prior, const std::vector<Observations>& observations) {
  const auto of = static_cast<std::size_t>(h.owner);
  const bool is_noise = h.kind == Kind::noise_stddev;
  if (h.kind == Kind::parameter) return std::ssize(prior.system->parameters());
  if (h.owner < 0 || of >= (is_noise ? observations.size() : prior.latents.size())) return -1;
  if (is_noise) return observations[of].view().size();
  const Latent& latent = prior.latents[of];
  switch (h.kind) {
    case Kind::kernel:
      return std::ssize(latent.kernel.parameters());
    case Kind::signal_stddev:
      return latent.size();
    case Kind::shared_signal_stddev:
      return h.column_scale.size() == latent.size() ? 1 : -1;
    case Kind::loading:
      return latent.free_loading ? Index{latent.size()} * *latent.free_loading : 0;
    default:
      return -1;
  }
}

bool is_possible(const Hyperparameter& h, double value) { return std::isfinite(value) && (!h.positive || value > 0); }

// each has a place in the model, and a value for it
void require_places(const Prior& prior, const std::vector<Observations>& observations,
                    const std::vector<Hyperparameter>& hyperparameters) {
  require_prior(prior);
  const auto has_place = [&](const Hyperparameter::Follower& f) {
    return f.latent >= 0 && f.latent < std::ssize(prior.latents) && f.column >= 0 &&
           f.column < prior.latents[static_cast<std::size_t>(f.latent)].size() && std::isfinite(f.share) && f.share > 0;
  };
  for (const Hyperparameter& h : hyperparameters) {
    const Index n = n_places(h, prior, observations);
    if (h.index < 0 || h.index >= n || !std::all_of(h.followers.begin(), h.followers.end(), has_place)) {
      throw InputError(fmt::format(
          "hyperparameter '{}' belongs to nothing of this prior and these observations: was it made for others?", h.name));
    }
    if (is_possible(h, h.value)) continue;
    throw InputError(fmt::format("hyperparameter '{}': its value must be finite{}, got {}", h.name,
                                 h.positive ? " and positive" : "", h.value));
  }
}

void require_bounds(const Hyperparameter& h) {
  if (h.lower <= h.upper && is_possible(h, h.lower) && is_possible(h, h.upper)) return;
  throw InputError(fmt::format("hyperparameter '{}': its bounds must be finite{}, the lower one below the upper, got [{}, {}]",
                               h.name, h.positive ? " and positive" : "", h.lower, h.upper));
}

void require_hyperprior(const Hyperparameter& h) {
  const HyperPrior& prior = h.hyperprior;
  if (prior.form == HyperPrior::Form::none) return;
  const bool has_median = std::isfinite(prior.median) && (prior.form == HyperPrior::Form::normal || prior.median > 0);
  if (prior.stddev > 0 && has_median && prior.correlation >= 0 && prior.correlation < 1) return;
  throw InputError(fmt::format("hyperparameter '{}': its hyper-prior has the median {}, the deviation {} and the correlation {}",
                               h.name, prior.median, prior.stddev, prior.correlation));
}

}  // namespace

void require_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                             const std::vector<Hyperparameter>& hyperparameters) {
  require_places(prior, observations, hyperparameters);
  std::set<std::tuple<Kind, int, int>> taken;
  for (const Hyperparameter& h : hyperparameters) {
    require_bounds(h);
    require_hyperprior(h);
    // the last of two would count, but both have its slope
    const int owner = h.is_system_parameter() ? 0 : h.owner;
    if (taken.emplace(h.kind, owner, h.index).second) continue;
    throw InputError(fmt::format("hyperparameter '{}' stands twice; leave out one", h.name));
  }
}

ModelValues model_values(const Prior& prior, const std::vector<Observations>& observations,
                         const std::vector<Hyperparameter>& hyperparameters) {
  require_places(prior, observations, hyperparameters);
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
