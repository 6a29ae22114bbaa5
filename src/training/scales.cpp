#include <algorithm>
#include <cmath>
#include <optional>

#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/training/default_hyperparameters.hpp"
#include "inference/requirements.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

void append_columns(const MatrixXd& more, MatrixXd& all) {
  all.conservativeResize(more.rows(), all.cols() + more.cols());
  all.rightCols(more.cols()) = more;
}

// a spread that bounds and starting points can be multiples of, even where the data do not vary; a smaller one has no square, and
// at last no reciprocal, among the doubles
double usable(double spread, double fallback) {
  constexpr double least = 1e-150;
  return spread >= least && std::isfinite(spread) ? spread : fallback;
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
  add(row_spread);
  const VectorXd of_spread = variance;
  add(row_size);
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

// the prior at the states of all observations
struct PooledStates {
  std::vector<MatrixXd> features;    // per latent (D × N)
  std::vector<MatrixXd> directions;  // per latent (nq·p × N)
  VectorXd mass_diagonal;            // M_jj at its median (nq)
};

PooledStates pooled_states(const Prior& prior, const std::vector<Observations>& all) {
  constexpr int enough = 10'000;  // states, evenly taken, for spreads and medians
  const std::vector<Observations> observations = n_states(all) > enough ? evenly(all, enough) : all;
  const System& system = *prior.system;
  PooledStates pooled{std::vector<MatrixXd>(prior.latents.size()), std::vector<MatrixXd>(prior.latents.size()), {}};
  std::vector<std::vector<double>> mass(static_cast<std::size_t>(system.nq()));
  for (const Observations& group : observations) {
    const Prior& there = prior_of(prior, group.view());
    const VectorXd parameters = parameters_of(group.view(), system.parameter_values());
    const MechanicsBatch mechanics = require_mechanics(there, group.view(), group.states(), parameters);
    const PriorValues values = require_prior_values(there, group.states(), parameters, mechanics);
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      append_columns(evaluate_features(there, a, group.states()).transpose(), pooled.features[a]);
      append_columns(values.directions[a], pooled.directions[a]);
    }
    for (std::size_t j = 0; j < mass.size(); ++j) {
      const auto row = static_cast<Index>(j);
      for (const UdwadiaKalaba& projection : mechanics.projections) mass[j].push_back(projection.mass()(row, row));
    }
  }
  pooled.mass_diagonal.resize(system.nq());
  for (std::size_t j = 0; j < mass.size(); ++j) pooled.mass_diagonal[static_cast<Index>(j)] = median(std::move(mass[j]));
  return pooled;
}

bool is_linear(const Kernel& kernel) {
  return std::ranges::any_of(kernel.terms(), [](const Kernel::Term& term) {
    return std::ranges::any_of(term.factors,
                               [](const Kernel::Factor& one) { return one.primitive == Kernel::Primitive::linear; });
  });
}

// A feature that is constant to rounding has no spread of its own, but a magnitude. Where squares of it are summed, half of its digits
// are lost: those of a place are taken about its mean.
VectorXd usable_spreads(VectorXd spreads, const MatrixXd& features, const Latent& latent) {
  constexpr double of_rounding = 1e-12, of_squares = 1e-7;
  const bool sums_squares = is_linear(latent.kernel);
  for (Index d = 0; d < spreads.size(); ++d) {
    const double magnitude = usable(features.row(d).cwiseAbs().maxCoeff(), 1);
    const auto feature = static_cast<std::size_t>(d);
    const bool is_of_place = feature < latent.is_of_place.size() && latent.is_of_place[feature];
    if (!(spreads[d] > (sums_squares && !is_of_place ? of_squares : of_rounding) * magnitude)) spreads[d] = magnitude;
  }
  return spreads;
}

// σ_j, M_jj σ_j, or of a direction of its own the size that moves the coordinates by their σ: 1 / rms |E column / σ|
VectorXd signal_scales(const Latent& latent, const MatrixXd& directions, const VectorXd& mass_diagonal, const VectorXd& sigma) {
  if (!latent.directions && !latent.is_positive) {
    return latent.base == Latent::Base::force ? VectorXd(mass_diagonal.cwiseProduct(sigma)) : sigma;
  }
  VectorXd signal = VectorXd::Ones(latent.size());  // of a positive one: an order of magnitude, nearly
  for (Index l = 0; !latent.is_positive && l < signal.size(); ++l) {
    const auto column = directions.middleRows(l * sigma.size(), sigma.size());
    const double rms = std::sqrt((sigma.cwiseInverse().asDiagonal() * column).squaredNorm() / static_cast<double>(column.cols()));
    signal[l] = 1 / usable(rms, 1 / sigma.mean());
  }
  return signal;
}

// Of a potential the standard deviation under which its force, at the lengthscales that a fit starts with, moves the coordinates
// by their σ.
VectorXd potential_scales(const VectorXd& of_gradient, const VectorXd& feature_stddev, Index nq) {
  const VectorXd lengthscale = Protocol::Standard::lengthscale_initial * feature_stddev;
  const double square = of_gradient.cwiseProduct(lengthscale).array().square().inverse().sum();
  return VectorXd::Constant(of_gradient.size(), std::sqrt(static_cast<double>(nq) / square));
}

// the spread of each row that is observed, or its size, or that of its acceleration
VectorXd output_scales(const Observations& group, const VectorXd& sigma) {
  VectorXd stddev = row_spread(group.values());
  const VectorXd size = row_size(group.values());
  const bool per_coordinate = group.view().quantity->is_per_coordinate();
  for (Index k = 0; k < stddev.size(); ++k) {
    const int row = group.view().rows[static_cast<std::size_t>(k)];
    stddev[k] = usable(stddev[k], usable(size[k], per_coordinate ? sigma[row] : 1));
  }
  return stddev;
}

}  // namespace

Scales default_scales(const Prior& prior, const std::vector<Observations>& observations) {
  require_observations(prior, observations);
  require_measured(observations, "default_scales");
  const PooledStates pooled = pooled_states(prior, observations);
  Scales scales;
  scales.acceleration_stddev = coordinate_scales(*prior.system, observations, pooled.mass_diagonal);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const MatrixXd& features = pooled.features[a];
    scales.feature_mean.push_back(row_mean(features));
    scales.feature_stddev.push_back(usable_spreads(row_stddev(features), features, prior.latents[a]));
    scales.feature_range.push_back(
        usable_spreads(features.rowwise().maxCoeff() - features.rowwise().minCoeff(), features, prior.latents[a]));
    scales.feature_centre.emplace_back(features.rowwise().maxCoeff() / 2 + features.rowwise().minCoeff() / 2);
    scales.signal_stddev.push_back(
        signal_scales(prior.latents[a], pooled.directions[a], pooled.mass_diagonal, scales.acceleration_stddev));
    if (prior.latents[a].is_potential) {
      VectorXd& signal = scales.signal_stddev.back();
      signal = potential_scales(signal, scales.feature_stddev.back(), prior.system->nq());
    }
  }
  for (const Observations& group : observations) {
    scales.output_stddev.push_back(output_scales(group, scales.acceleration_stddev));
  }
  return scales;
}

}  // namespace gp2
