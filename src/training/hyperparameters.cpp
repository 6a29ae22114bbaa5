#include <algorithm>
#include <cmath>
#include <optional>

#include <fmt/format.h>

#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/fit.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;
using Standard = Protocol::Standard;

bool Hyperparameter::at_bound() const {
  const double tolerance = 1e-6;
  if (is_positive()) {
    return std::log(value / lower) <= tolerance || std::log(upper / value) <= tolerance;
  }
  return value - lower <= tolerance * (upper - lower) || upper - value <= tolerance * (upper - lower);
}

namespace {

MatrixXd side_by_side(const std::vector<MatrixXd>& parts) {
  Index n = 0;
  for (const MatrixXd& part : parts) n += part.cols();
  MatrixXd all(parts.front().rows(), n);
  Index first = 0;
  for (const MatrixXd& part : parts) {
    all.middleCols(first, part.cols()) = part;
    first += part.cols();
  }
  return all;
}

// a spread that bounds and starting points can be multiples of, even where the data do not vary
double usable(double spread, double fallback) { return spread > 0 && std::isfinite(spread) ? spread : fallback; }

// of what is measured
VectorXd size_of_rows(const Eigen::Ref<const MatrixXd>& values) {
  return values.array().isNaN().select(0, values).cwiseAbs().rowwise().maxCoeff();
}

// standard deviation of each row; 0 where it does not vary but for rounding
VectorXd spread_of_rows(const Eigen::Ref<const MatrixXd>& values) {
  const VectorXd stddev = row_stddev(values);
  return (stddev.array() > 1e-12 * size_of_rows(values).array()).select(stddev, 0);
}

// what a group says of the accelerations' spread, or of their size, per row of its view; nothing where the view is of another
// kind
template <typename OfRows>
std::optional<VectorXd> acceleration_scale(const Observations& group, const VectorXd& mass_diagonal, const OfRows& of_rows) {
  const View& view = group.view();
  if (view.latent || !view.quantity->is_per_coordinate()) return std::nullopt;
  const StateLayout layout{static_cast<int>(mass_diagonal.size()), 0};
  MatrixXd values = group.values();
  VectorXd per_acceleration(view.size());
  for (int k = 0; k < view.size(); ++k) {
    const double mass = mass_diagonal[view.rows[static_cast<std::size_t>(k)]];
    per_acceleration[k] = view.quantity->per_acceleration(mass, view.time_step.value_or(0));
    if (const std::optional<int> entry = view.added_entry(layout, k)) values.row(k) -= group.states().row(*entry);
  }
  return VectorXd(of_rows(values).cwiseQuotient(per_acceleration));
}

// σ_j of every coordinate: where ddq_j is observed its spread, or its size where it does not vary; otherwise by equal kinetic
// scale √(mean M_ii σ_i² / M_jj)
VectorXd coordinate_scales(const System& system, const std::vector<Observations>& observations, const VectorXd& mass_diagonal) {
  VectorXd variance = VectorXd::Constant(system.nq(), -1);
  const auto add = [&](const auto& of_rows) {
    for (const Observations& group : observations) {
      const std::optional<VectorXd> scale = acceleration_scale(group, mass_diagonal, of_rows);
      for (Index k = 0; scale && k < scale->size(); ++k) {
        double& entry = variance[group.view().rows[static_cast<std::size_t>(k)]];
        entry = std::max(entry, (*scale)[k] * (*scale)[k]);
      }
    }
  };
  add(spread_of_rows);
  const VectorXd of_spread = variance;
  add(size_of_rows);
  variance = (of_spread.array() > 0).select(of_spread, variance);
  double kinetic = 0;
  int n_observed = 0;
  for (Index j = 0; j < variance.size(); ++j) {
    if (variance[j] < 0) continue;
    kinetic += mass_diagonal[j] * variance[j];
    ++n_observed;
  }
  kinetic = usable(kinetic / std::max(n_observed, 1), 1);
  VectorXd sigma(system.nq());
  for (Index j = 0; j < sigma.size(); ++j) {
    const double equal_kinetic = std::sqrt(kinetic / mass_diagonal[j]);
    sigma[j] = variance[j] < 0 ? equal_kinetic : usable(std::sqrt(variance[j]), equal_kinetic);
  }
  return sigma;
}

}  // namespace

Scales default_scales(const Prior& prior, const std::vector<Observations>& observations) {
  const System& system = *prior.system;
  std::vector<std::vector<MatrixXd>> features(prior.latents.size()), directions(prior.latents.size());
  std::vector<std::vector<double>> mass(static_cast<std::size_t>(system.nq()));
  for (const Observations& group : observations) {
    const Prior& there = prior_of(prior, group.view());
    const VectorXd parameters = parameters_of(group.view(), system.parameter_values());
    const MechanicsBatch mechanics = require_mechanics(there, group.view(), group.states(), parameters);
    PriorValues values = evaluate_prior(there, group.states(), parameters, mechanics);
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      features[a].push_back(evaluate_features(there.latents[a], group.states()).transpose());
      directions[a].push_back(std::move(values.directions[a]));
    }
    for (std::size_t j = 0; j < mass.size(); ++j) {
      const auto row = static_cast<Index>(j);
      for (const UdwadiaKalaba& projection : mechanics.projections) mass[j].push_back(projection.mass()(row, row));
    }
  }
  VectorXd mass_diagonal(system.nq());
  for (std::size_t j = 0; j < mass.size(); ++j) mass_diagonal[static_cast<Index>(j)] = median(std::move(mass[j]));
  const VectorXd sigma = coordinate_scales(system, observations, mass_diagonal);

  Scales scales;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    const MatrixXd features_of = side_by_side(features[a]);
    const MatrixXd directions_of = side_by_side(directions[a]);
    VectorXd stddev = row_stddev(features_of);
    VectorXd range = features_of.rowwise().maxCoeff() - features_of.rowwise().minCoeff();
    for (Index d = 0; d < stddev.size(); ++d) {
      const double magnitude = usable(features_of.row(d).cwiseAbs().maxCoeff(), 1);
      // a feature that is constant to rounding has no spread of its own
      stddev[d] = stddev[d] > 1e-12 * magnitude ? stddev[d] : magnitude;
      range[d] = range[d] > 1e-12 * magnitude ? range[d] : magnitude;
    }
    scales.feature_stddev.push_back(std::move(stddev));
    scales.feature_range.push_back(std::move(range));

    VectorXd signal(latent.size());
    if (latent.directions_are_identity) {
      signal = latent.base == Latent::Base::force ? VectorXd(mass_diagonal.cwiseProduct(sigma)) : sigma;
    } else {
      for (Index l = 0; l < signal.size(); ++l) {
        const auto column = directions_of.middleRows(l * system.nq(), system.nq());
        const double rms = std::sqrt(column.squaredNorm() / static_cast<double>(column.size()));
        signal[l] = sigma.mean() / usable(rms, 1);
      }
    }
    scales.signal_stddev.push_back(std::move(signal));
  }
  for (const Observations& group : observations) {
    VectorXd stddev = spread_of_rows(group.values());
    const VectorXd size = size_of_rows(group.values());
    for (Index k = 0; k < stddev.size(); ++k) {
      const auto row = static_cast<std::size_t>(group.view().rows[static_cast<std::size_t>(k)]);
      const bool per_coordinate = group.view().quantity->is_per_coordinate();
      stddev[k] = usable(stddev[k], usable(size[k], per_coordinate ? sigma[static_cast<Index>(row)] : 1));
    }
    scales.output_stddev.push_back(std::move(stddev));
  }
  scales.acceleration_stddev = sigma;
  return scales;
}

namespace {

std::string unit_of(const std::string& quantity) { return fmt::format("unit of {}", quantity); }

void add_kernel_parameters(const Latent& latent, int owner, const std::string& prefix, const Scales& scales,
                           const Protocol& protocol, std::vector<Hyperparameter>& out) {
  const bool paper = protocol.name == Protocol::Name::paper;
  const auto choose = [](double own, double standard) { return own > 0 ? own : standard; };
  const Latent::Range& range = latent.lengthscale;
  for (std::size_t p = 0; p < latent.kernel.parameters().size(); ++p) {
    const Kernel::Parameter& parameter = latent.kernel.parameters()[p];
    Hyperparameter h;
    h.kind = Kind::kernel;
    h.owner = owner;
    h.index = static_cast<int>(p);
    h.name = prefix + parameter.name;
    double scale = 1, initial = 1, lower = 1e-3, upper = 1e3, median = 1, log_stddev = Standard::shape_log_stddev;
    switch (parameter.kind) {
      case Kernel::ParameterKind::lengthscale:
      case Kernel::ParameterKind::periodic_lengthscale:
        initial = choose(range.initial, paper ? 1 : Standard::lengthscale_initial);
        lower = choose(range.lower, paper ? 0.5 : Standard::lengthscale_lower);
        upper = choose(range.upper, paper ? 20 : Standard::lengthscale_upper);
        median = choose(range.median, Standard::lengthscale_median);
        log_stddev = choose(range.log_stddev, Standard::lengthscale_log_stddev);
        if (parameter.kind == Kernel::ParameterKind::lengthscale) {
          scale = scales.feature_stddev[static_cast<std::size_t>(owner)][parameter.feature];
          h.unit = unit_of(latent.feature_names[static_cast<std::size_t>(parameter.feature)]);
        }
        break;
      case Kernel::ParameterKind::period:
        scale = scales.feature_range[static_cast<std::size_t>(owner)][parameter.feature];
        h.unit = unit_of(latent.feature_names[static_cast<std::size_t>(parameter.feature)]);
        initial = median = 0.5;
        lower = 0.02;
        upper = 20;
        break;
      case Kernel::ParameterKind::shape:
      case Kernel::ParameterKind::amplitude:
        break;
    }
    h.value = std::clamp(initial, lower, upper) * scale;
    h.lower = lower * scale;
    h.upper = upper * scale;
    if (!paper && protocol.hyperprior) {
      h.median = median * scale;
      h.log_stddev = log_stddev;
    }
    if (h.unit.empty()) h.unit = std::string("1");
    out.push_back(std::move(h));
  }
}

void add_signal_stddevs(const Latent& latent, int owner, const std::string& prefix, const Scales& scales,
                        const Protocol& protocol, std::vector<Hyperparameter>& out) {
  const VectorXd& scale = scales.signal_stddev[static_cast<std::size_t>(owner)];
  const Latent::Range& range = latent.signal_stddev;
  const auto choose = [](double own, double standard) { return own > 0 ? own : standard; };
  if (protocol.name == Protocol::Name::paper) {
    Hyperparameter h;
    h.kind = Kind::shared_signal_stddev;
    h.owner = owner;
    h.name = prefix + "signal_stddev";
    h.unit = "default scale of each column";
    h.lower = choose(range.lower, 0.5);
    h.upper = choose(range.upper, 10);
    h.value = std::clamp(choose(range.initial, 1), h.lower, h.upper);
    h.scale = scale;
    out.push_back(std::move(h));
    return;
  }
  for (int l = 0; l < latent.size(); ++l) {
    const std::string& column = latent.column_names[static_cast<std::size_t>(l)];
    Hyperparameter h;
    h.kind = Kind::signal_stddev;
    h.owner = owner;
    h.index = l;
    h.name = fmt::format("{}signal_stddev({})", prefix, column);
    h.unit = unit_of(column);
    h.value = choose(range.initial, Standard::signal_initial) * scale[l];
    h.lower = choose(range.lower, Standard::signal_lower) * scale[l];
    h.upper = choose(range.upper, Standard::signal_upper) * scale[l];
    if (protocol.hyperprior) {
      h.median = choose(range.median, Standard::signal_median) * scale[l];
      h.log_stddev = choose(range.log_stddev, Standard::signal_log_stddev);
    }
    out.push_back(std::move(h));
  }
}

}  // namespace

std::vector<Hyperparameter> default_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                                                    const std::vector<std::string>& estimated, const Protocol& protocol) {
  const Scales scales = default_scales(prior, observations);
  const System& system = *prior.system;
  std::vector<Hyperparameter> out;
  const auto is_fixed = [](const Latent& latent) { return latent.kernel_is_fixed && latent.signal_is_fixed; };
  const auto n_fixed = std::count_if(prior.latents.begin(), prior.latents.end(), is_fixed);
  const bool one_is_tuned = static_cast<std::ptrdiff_t>(prior.latents.size()) - n_fixed == 1;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (is_fixed(prior.latents[a])) continue;
    const std::string prefix = one_is_tuned ? "" : prior.latents[a].name + ".";
    add_kernel_parameters(prior.latents[a], static_cast<int>(a), prefix, scales, protocol, out);
    add_signal_stddevs(prior.latents[a], static_cast<int>(a), prefix, scales, protocol, out);
  }

  for (std::size_t g = 0; g < observations.size(); ++g) {
    if (!observations[g].noise().is_estimated()) continue;
    const std::vector<std::string> names = observations[g].view().names(system);
    for (std::size_t k = 0; k < names.size(); ++k) {
      Hyperparameter h;
      h.kind = Kind::noise_stddev;
      h.owner = static_cast<int>(g);
      h.index = static_cast<int>(k);
      h.name = fmt::format("noise_stddev({})", names[k]);
      if (g > 0) h.name += fmt::format("#{}", g + 1);  // of the second log, the third, …
      h.unit = unit_of(names[k]);
      const double spread = scales.output_stddev[g][static_cast<Index>(k)];
      h.lower = Standard::noise_lower * spread;
      h.upper = Standard::noise_upper * spread;
      if (observations[g].noise().has_scale()) {
        // a factor of stated deviations: the smallest of them stays above the lower bound, the usual one below the upper
        h.unit = fmt::format("stated deviation of {}", names[k]);
        const std::vector<double> scale = observations[g].measured_scales(static_cast<Index>(k));
        if (!scale.empty()) h.lower /= *std::min_element(scale.begin(), scale.end());
        h.upper =
            std::max(h.upper / observations[g].usual_noise(VectorXd::Ones(observations[g].view().size()))[static_cast<Index>(k)],
                     2 * h.lower);
      }
      h.value = std::clamp(observations[g].noise().stddev()[static_cast<Index>(k)], h.lower, h.upper);
      if (protocol.hyperprior && protocol.name == Protocol::Name::standard) {
        h.median = h.value;
        h.log_stddev = Standard::noise_log_stddev;
      }
      out.push_back(std::move(h));
    }
  }

  for (const std::string& name : estimated) {
    const int index = system.parameter_index(name);
    if (index < 0) {
      std::string known;
      for (const Parameter& parameter : system.parameters()) known += (known.empty() ? "" : ", ") + parameter.name;
      throw InputError(fmt::format("--estimate: the model '{}' has no parameter '{}'; it has: {}", system.name(), name,
                                   known.empty() ? "none" : known));
    }
    for (const Latent& latent : prior.latents) {
      const std::vector<int>& used = latent.feature_parameters;
      if (std::find(used.begin(), used.end(), index) != used.end()) {
        throw InputError(
            fmt::format("--estimate: parameter '{}' stands in a feature of the latent '{}', and features hold no estimated "
                        "parameters; write the feature without it, or leave it out",
                        name, latent.name));
      }
    }
    const Parameter& parameter = system.parameters()[static_cast<std::size_t>(index)];
    Hyperparameter h;
    h.kind = Kind::parameter;
    h.index = index;
    h.name = name;
    h.unit = unit_of(name);
    h.value = parameter.value;
    if (protocol.name == Protocol::Name::paper) {
      h.lower = parameter.value - 0.02;
      h.upper = parameter.value + 0.02;
      if (parameter.bounds) {
        h.lower = std::max(h.lower, parameter.bounds->first);
        h.upper = std::min(h.upper, parameter.bounds->second);
      }
    } else if (parameter.bounds) {
      std::tie(h.lower, h.upper) = *parameter.bounds;
    } else if (parameter.value != 0) {
      // half to twice the value
      h.lower = std::min(0.5 * parameter.value, 2 * parameter.value);
      h.upper = std::max(0.5 * parameter.value, 2 * parameter.value);
    } else {
      throw InputError(
          fmt::format("parameter '{}' is 0 and has no bounds: write {} = {{ value = 0, bounds = [lower, upper] }}", name, name));
    }
    if (parameter.prior && protocol.hyperprior && protocol.name == Protocol::Name::standard) {
      if (parameter.prior->of_logarithm && !(h.lower > 0)) {
        throw InputError(
            fmt::format("parameter '{}': a prior of the logarithm needs bounds above 0, got [{}, {}]; write "
                        "bounds = [lower, upper], or prior = {{ mean = …, stddev = … }}",
                        name, h.lower, h.upper));
      }
      h.median = parameter.prior->median;
      (parameter.prior->of_logarithm ? h.log_stddev : h.stddev) = parameter.prior->stddev;
    }
    out.push_back(std::move(h));
  }
  return out;
}

ModelValues model_values(const Prior& prior, const std::vector<Observations>& observations,
                         const std::vector<Hyperparameter>& hyperparameters) {
  ModelValues values;
  for (const Latent& latent : prior.latents) {
    values.kernel.emplace_back(VectorXd::Ones(static_cast<Index>(latent.kernel.parameters().size())));
    values.signal_stddev.emplace_back(VectorXd::Ones(latent.size()));
    values.mixing.emplace_back();
    if (latent.learned_rank) values.mixing.back().setZero(latent.size(), latent.n_functions());
  }
  for (const Observations& group : observations) values.noise_stddev.push_back(group.noise().stddev());
  values.parameters = prior.system->parameter_values();
  for (const Hyperparameter& h : hyperparameters) {
    const auto owner = static_cast<std::size_t>(h.owner);
    switch (h.kind) {
      case Kind::kernel:
        values.kernel[owner][h.index] = h.value;
        break;
      case Kind::signal_stddev:
        values.signal_stddev[owner][h.index] = h.value;
        break;
      case Kind::shared_signal_stddev:
        values.signal_stddev[owner] = h.value * h.scale;
        break;
      case Kind::noise_stddev:
        values.noise_stddev[owner][h.index] = h.value;
        break;
      case Kind::parameter:
        values.parameters[h.index] = h.value;
        break;
      case Kind::mixing:
        values.mixing[owner].reshaped()[h.index] = h.value;
        break;
      case Kind::sqrt_kappa:
        values.mixing[owner].rightCols(values.mixing[owner].rows())(h.index, h.index) = h.value;
        break;
    }
  }
  return values;
}

}  // namespace gp2
