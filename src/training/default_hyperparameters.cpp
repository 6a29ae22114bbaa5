#include "gp2/training/default_hyperparameters.hpp"

#include <algorithm>
#include <set>
#include <tuple>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "training/constraint_parameters.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;
using Standard = Protocol::Standard;

namespace {

std::string unit_of(const std::string& quantity) { return fmt::format("unit of {}", quantity); }

bool has_hyperpriors(const Protocol& protocol) { return protocol.name == Protocol::Name::standard && protocol.hyperprior; }

// The model's own range, and where it says nothing the protocol's. A start lies within its bounds: the standard protocol's make
// room for it, and into the paper's box it is moved.
Latent::Range filled(const Latent::Range& own, Latent::Range defaults, const Protocol& protocol) {
  const auto choose = [](double mine, double fallback) { return mine > 0 ? mine : fallback; };
  if (own.initial > 0 && protocol.name == Protocol::Name::standard) {
    defaults.lower = std::min(defaults.lower, own.initial);
    defaults.upper = std::max(defaults.upper, own.initial);
  }
  Latent::Range range = {choose(own.initial, defaults.initial), choose(own.lower, defaults.lower),
                         choose(own.upper, defaults.upper), choose(own.median, defaults.median),
                         choose(own.log_stddev, defaults.log_stddev)};
  range.initial = std::clamp(range.initial, range.lower, std::max(range.lower, range.upper));
  return range;
}

Latent::Range scaled(const Latent::Range& range, double scale) {
  return {range.initial * scale, range.lower * scale, range.upper * scale, range.median * scale, range.log_stddev};
}

void set_range(Hyperparameter& h, const Latent::Range& range, const Protocol& protocol) {
  h.value = range.initial;
  h.lower = range.lower;
  h.upper = range.upper;
  if (has_hyperpriors(protocol) && !h.is_fixed()) {
    h.hyperprior = {HyperPrior::Form::log_normal, range.median, range.log_stddev};
  }
}

constexpr Latent::Range standard_lengthscale = {Standard::lengthscale_initial, Standard::lengthscale_lower,
                                                Standard::lengthscale_upper, Standard::lengthscale_median,
                                                Standard::lengthscale_log_stddev};
constexpr Latent::Range paper_lengthscale = {1, 0.5, 20, Standard::lengthscale_median, Standard::lengthscale_log_stddev};
constexpr Latent::Range standard_signal = {Standard::signal_initial, Standard::signal_lower, Standard::signal_upper,
                                           Standard::signal_median, Standard::signal_log_stddev};
constexpr Latent::Range positive_signal = {1, 0.05, 5, 1, 0.7};  // of a logarithm: a deviation of 1 is a factor of e
constexpr Latent::Range paper_signal = {1, 0.5, 10, 0, 0};
constexpr Latent::Range size_of_discrepancy = {Standard::discrepancy_median, Standard::discrepancy_lower,
                                               Standard::discrepancy_upper, Standard::discrepancy_median,
                                               Standard::discrepancy_log_stddev};

Latent::Range lengthscale_range(const Latent& latent, const Protocol& protocol) {
  const bool is_paper = protocol.name == Protocol::Name::paper;
  return filled(latent.lengthscale, is_paper ? paper_lengthscale : standard_lengthscale, protocol);
}

Hyperparameter kernel_hyperparameter(const Latent& latent, std::size_t owner, std::size_t index, const Scales& scales,
                                     const Protocol& protocol) {
  const Kernel::Parameter& parameter = latent.kernel.parameters()[index];
  const auto feature = static_cast<std::size_t>(parameter.feature);
  Hyperparameter h = Hyperparameter::of(Kind::kernel, owner, index);
  h.unit = std::string("1");
  Latent::Range range = {1, 1e-3, 1e3, 1, Standard::shape_log_stddev};
  switch (parameter.kind) {
    case Kernel::ParameterKind::lengthscale:
      h.unit = unit_of(latent.feature_names[feature]);
      range = scaled(lengthscale_range(latent, protocol), scales.feature_stddev[owner][parameter.feature]);
      if (!latent.feature_lengthscales.empty()) range = filled(latent.feature_lengthscales[feature], range, protocol);
      break;
    case Kernel::ParameterKind::periodic_lengthscale:
      range = lengthscale_range(latent, protocol);
      break;
    case Kernel::ParameterKind::period:
      h.unit = unit_of(latent.feature_names[feature]);
      range = scaled({0.5, 0.02, 20, 0.5, Standard::shape_log_stddev}, scales.feature_range[owner][parameter.feature]);
      break;
    case Kernel::ParameterKind::shape:
    case Kernel::ParameterKind::amplitude:
      break;
  }
  set_range(h, range, protocol);
  return h;
}

// one factor for all columns of a latent
Hyperparameter shared_signal(std::size_t owner, std::string name, std::string unit, VectorXd column_scale,
                             const Latent::Range& range, const Protocol& protocol) {
  Hyperparameter h = Hyperparameter::of(Kind::shared_signal_stddev, owner, 0);
  h.name = std::move(name);
  h.unit = std::move(unit);
  h.column_scale = std::move(column_scale);
  set_range(h, range, protocol);
  return h;
}

void add_latent(const Latent& latent, std::size_t owner, const std::string& prefix, const Scales& scales,
                const Protocol& protocol, std::vector<Hyperparameter>& out) {
  for (std::size_t p = 0; p < latent.kernel.parameters().size(); ++p) {
    out.push_back(kernel_hyperparameter(latent, owner, p, scales, protocol));
    out.back().name = prefix + latent.kernel.parameters()[p].name;
  }
  const VectorXd& scale = scales.signal_stddev[owner];
  if (protocol.name == Protocol::Name::paper) {
    out.push_back(shared_signal(owner, prefix + "signal_stddev", "default scale of each column", scale,
                                filled(latent.signal_stddev, paper_signal, protocol), protocol));
    return;
  }
  const Latent::Range range = filled(latent.signal_stddev, latent.is_positive ? positive_signal : standard_signal, protocol);
  if (latent.is_potential) {
    // that of the potential itself, for all the columns of its gradient
    out.push_back(shared_signal(owner, prefix + "signal_stddev(potential)", "unit of energy", VectorXd::Ones(latent.size()),
                                scaled(range, scale[0]), protocol));
    return;
  }
  for (std::size_t l = 0; l < latent.column_names.size(); ++l) {
    Hyperparameter& h = out.emplace_back(Hyperparameter::of(Kind::signal_stddev, owner, l));
    h.name = fmt::format("{}signal_stddev({})", prefix, latent.column_names[l]);
    h.unit = unit_of(latent.column_names[l]);
    set_range(h, scaled(range, scale[static_cast<Index>(l)]), protocol);
  }
}

// What the data say of a feature in one direction is expected in the others and in every term of the kernel: they are of one machine.
void make_families(const Latent& latent, std::vector<Hyperparameter>::iterator first,
                   std::vector<Hyperparameter>::iterator last) {
  if (latent.direction.empty()) return;
  for (; first != last; ++first) {
    if (first->kind != Kind::kernel || first->is_fixed()) continue;
    const Kernel::Parameter& parameter = latent.kernel.parameters()[static_cast<std::size_t>(first->index)];
    if (parameter.kind != Kernel::ParameterKind::lengthscale) continue;
    first->hyperprior.family = latent.name + "." + latent.feature_names[static_cast<std::size_t>(parameter.feature)];
    first->hyperprior.correlation = Standard::lengthscale_correlation;
  }
}

void add_latents(const Prior& prior, const Scales& scales, const Protocol& protocol, std::vector<Hyperparameter>& out) {
  std::set<std::string> tuned;
  for (const Latent& latent : prior.latents) {
    if (!latent.has_one_signal) tuned.insert(latent.name);
  }
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.has_one_signal) {
      // in units of what its directions are: of the noise as measured
      out.push_back(
          shared_signal(a, latent.name + ".size", "noise", VectorXd::Ones(latent.size()), size_of_discrepancy, protocol));
      continue;
    }
    const std::string name = tuned.size() == 1 ? "" : latent.name + ".";
    const std::ptrdiff_t first = std::ssize(out);
    add_latent(latent, a, latent.direction.empty() ? name : name + latent.direction + ".", scales, protocol, out);
    if (has_hyperpriors(protocol)) make_families(latent, out.begin() + first, out.end());
  }
}

// σ of one row, or the factor of the deviations that a log states for it
Hyperparameter noise_hyperparameter(const Observations& observations, std::size_t group, std::size_t row, const std::string& name,
                                    double spread, const Protocol& protocol) {
  const auto k = static_cast<Index>(row);
  Hyperparameter h = Hyperparameter::of(Kind::noise_stddev, group, row);
  h.name = fmt::format("noise_stddev({})", name);
  if (group > 0) h.name += fmt::format("#{}", group + 1);  // of the second log, the third, …
  h.unit = unit_of(name);
  h.lower = Standard::noise_lower * spread;
  h.upper = Standard::noise_upper * spread;
  if (observations.noise().has_scale()) {
    // the smallest of the stated deviations stays above the lower bound, the usual one below the upper
    const std::vector<double> scale = observations.measured_scales(k);
    if (!scale.empty()) h.lower /= *std::min_element(scale.begin(), scale.end());
    h.upper = std::max(h.upper / observations.usual_noise(VectorXd::Ones(observations.view().size()))[k], 2 * h.lower);
  }
  // Who states deviations knows them to a factor of some size. Errors that go on from row to row, as smoothing leaves them, would
  // have the factor collapse: neighbours agree, and the latents follow them.
  constexpr double stated_lower = 0.2, stated_log_stddev = 0.5, stated_correlation = 0.8;
  const bool is_stated = observations.states_noise(k);
  if (is_stated) {
    h.unit = fmt::format("stated deviation of {}", name);
    h.lower = std::max(h.lower, stated_lower * observations.noise().stddev()[k]);
    h.upper = std::max(h.upper, 2 * h.lower);
  }
  h.value = std::clamp(observations.noise().stddev()[k], h.lower, h.upper);
  if (has_hyperpriors(protocol)) {
    // a start that is wrong is mostly wrong for all accelerations alike, and so are stated deviations
    h.hyperprior = {HyperPrior::Form::log_normal, h.value, is_stated ? stated_log_stddev : Standard::noise_log_stddev,
                    fmt::format("{}noise#{}", is_stated ? "stated " : "", group + 1),
                    is_stated ? stated_correlation : Standard::noise_correlation};
  }
  return h;
}

void add_noise(const Prior& prior, const std::vector<Observations>& observations, const Scales& scales, const Protocol& protocol,
               std::vector<Hyperparameter>& out) {
  for (std::size_t g = 0; g < observations.size(); ++g) {
    if (!observations[g].noise().is_estimated()) continue;
    const std::vector<std::string> names = observations[g].view().names(*prior_of(prior, observations[g].view()).system);
    for (std::size_t k = 0; k < names.size(); ++k) {
      const double spread = scales.output_stddev[g][static_cast<Index>(k)];
      out.push_back(noise_hyperparameter(observations[g], g, k, names[k], spread, protocol));
    }
  }
}

int estimable_parameter(const Prior& prior, const std::string& name) {
  const System& system = *prior.system;
  const int index = system.parameter_index(name);
  if (index < 0) {
    std::string known;
    for (const Parameter& parameter : system.parameters()) known += (known.empty() ? "" : ", ") + parameter.name;
    throw InputError(fmt::format("`estimate`: the model '{}' has no parameter '{}'; it has: {}", system.name(), name,
                                 known.empty() ? "none" : known));
  }
  for (const Latent& latent : prior.latents) {
    const std::vector<int>& used = latent.feature_parameters;
    if (std::find(used.begin(), used.end(), index) == used.end()) continue;
    throw InputError(fmt::format(
        "{}: parameter '{}' stands in a feature of the latent '{}', and features hold no estimated "
        "parameters; write the feature without it, or leave it out",
        system.parameters()[static_cast<std::size_t>(index)].estimate ? fmt::format("[parameters] {}: estimate = true", name)
                                                                      : "`estimate`",
        name, latent.name));
  }
  return index;
}

// its own, or half to twice its value; under the paper's protocol ± 0.02, within its own
std::pair<double, double> bounds_of(const Parameter& parameter, const Protocol& protocol) {
  const double value = parameter.value;
  if (protocol.name == Protocol::Name::paper) {
    constexpr double distance = 0.02;
    if (!parameter.bounds) return {value - distance, value + distance};
    return {std::max(value - distance, parameter.bounds->first), std::min(value + distance, parameter.bounds->second)};
  }
  if (parameter.bounds) return *parameter.bounds;
  if (value != 0) return {std::min(0.5 * value, 2 * value), std::max(0.5 * value, 2 * value)};
  throw InputError(fmt::format("parameter '{}' is 0 and has no bounds: write {} = {{ value = 0, bounds = [lower, upper] }}",
                               parameter.name, parameter.name));
}

Hyperparameter parameter_hyperparameter(const Prior& prior, const std::string& name, const Protocol& protocol) {
  const auto index = static_cast<std::size_t>(estimable_parameter(prior, name));
  const Parameter& parameter = prior.system->parameters()[index];
  Hyperparameter h = Hyperparameter::of(Kind::parameter, 0, index);
  h.name = name;
  h.unit = unit_of(name);
  h.value = parameter.value;
  std::tie(h.lower, h.upper) = bounds_of(parameter, protocol);
  if (!parameter.prior || !has_hyperpriors(protocol)) return h;
  if (parameter.prior->of_logarithm && !(h.lower > 0)) {
    throw InputError(
        fmt::format("parameter '{}': a prior of the logarithm needs bounds above 0, got [{}, {}]; write "
                    "bounds = [lower, upper], or prior = {{ mean = …, stddev = … }}",
                    name, h.lower, h.upper));
  }
  h.hyperprior = {parameter.prior->of_logarithm ? HyperPrior::Form::log_normal : HyperPrior::Form::normal,
                  parameter.prior->median, parameter.prior->stddev};
  return h;
}

}  // namespace

void require_estimable(const Prior& prior, const std::string& name) {
  bounds_of(prior.system->parameters()[static_cast<std::size_t>(estimable_parameter(prior, name))], Protocol{});
}

std::vector<Hyperparameter> default_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                                                    const std::vector<std::string>& estimated, const Protocol& protocol) {
  const Scales scales = default_scales(prior, observations);
  std::vector<Hyperparameter> out;
  add_latents(prior, scales, protocol, out);
  add_noise(prior, observations, scales, protocol, out);
  for (const std::string& name : estimated) out.push_back(parameter_hyperparameter(prior, name, protocol));
  if (protocol.name != Protocol::Name::paper) weigh_by_residuals(prior, observations, out);
  return out;
}

}  // namespace gp2
