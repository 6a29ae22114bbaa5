#include "gp2/prior.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "mechanics/describe_fault.hpp"
#include "prior/admissible_directions.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

Map<MatrixXd> block(MatrixXd& matrix, int i, Index rows) { return {matrix.col(i).data(), rows, matrix.rows() / rows}; }

MatrixXd stacked(const Ref<const MatrixXd>& above, const Ref<const MatrixXd>& below) {
  MatrixXd all(above.rows() + below.rows(), above.cols());
  all << above, below;
  return all;
}

// B(x, λ), where the multipliers are given and it reads them; else null
const StateFunction* of_multipliers(const Latent& latent, const MatrixXd* multipliers) {
  return multipliers && latent.directions ? latent.directions->of_multipliers() : nullptr;
}

// B(x) or B(x, λ) at N states
MatrixXd evaluate_base(const Latent& latent, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters, Index nq,
                       const MatrixXd* multipliers) {
  if (const StateFunction* const B = of_multipliers(latent, multipliers)) {
    return B->evaluate(stacked(states, *multipliers), parameters);
  }
  if (latent.directions) return latent.directions->evaluate(states, parameters);
  const MatrixXd identity = MatrixXd::Identity(nq, nq);
  return identity.reshaped().replicate(1, states.cols());
}

struct Entry {
  int row, state;
};

// the first, state by state, that is not a finite number
std::optional<Entry> first_not_finite(const Ref<const MatrixXd>& values) {
  if (values.allFinite()) return std::nullopt;
  for (Index i = 0; i < values.cols(); ++i) {
    for (Index row = 0; row < values.rows(); ++row) {
      if (!std::isfinite(values(row, i))) return Entry{static_cast<int>(row), static_cast<int>(i)};
    }
  }
  return std::nullopt;
}

const std::string& coordinate_name(const System& system, int j) { return system.coordinates()[static_cast<std::size_t>(j)].name; }

void require_latent(const Latent& latent, Index nq) {
  const auto fail = [&](const std::string& text) {
    throw InputError(fmt::format("prior: the latent '{}' {}; make_prior makes whole ones", latent.name, text));
  };
  if (!latent.features) fail("has no features");
  if (latent.kernel.terms().empty()) fail("has no kernel");
  const int n_features = latent.n_features();
  if (latent.features->size() != n_features || latent.kernel.n_features() != n_features) {
    fail(fmt::format("has {} features of {} names, and a kernel of {}", latent.features->size(), n_features,
                     latent.kernel.n_features()));
  }
  const Index n_directions = latent.directions ? latent.directions->size() : nq * nq;
  if (latent.size() == 0 || n_directions != nq * latent.size()) {
    fail(fmt::format("has {} columns, but directions of {} numbers for {} coordinates", latent.size(), n_directions, nq));
  }
  if (latent.is_potential &&
      (latent.base != Latent::Base::force || latent.size() != n_features || !latent.directions || latent.free_loading)) {
    fail("is a potential without one direction on forces for each feature");
  }
  if (latent.is_potential && !has_gradient(latent.kernel))
    fail("is a potential of a kernel that is no sum of se, matern52, rq and linear");
  if (latent.n_functions() < 1) fail(fmt::format("has {} functions", latent.n_functions()));
}

}  // namespace

void require_prior(const Prior& prior) {
  if (!prior.system) throw InputError("prior: it has no system; make it by make_prior, and use none that was moved away");
  const Index nq = prior.system->nq();
  if (prior.mean == Prior::Mean::constant && prior.constant_mean.size() != nq) {
    throw InputError(fmt::format("prior: its constant mean has {} numbers for {} coordinates", prior.constant_mean.size(), nq));
  }
  for (const Latent& latent : prior.latents) require_latent(latent, nq);
}

bool Prior::is_nonlinear() const {
  return std::ranges::any_of(latents, [](const Latent& latent) { return latent.is_positive || latent.reads_multipliers(); });
}

std::vector<bool> Prior::reads() const {
  require_prior(*this);
  std::vector<bool> reads = system->reads(SystemPart::mechanics);
  if (mean == Mean::force) {
    const std::vector<bool> force = system->reads(SystemPart::force);
    for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || force[k];
  }
  for (const Latent& latent : latents) {
    for (std::size_t k = 0; k < reads.size(); ++k) {
      const int index = static_cast<int>(k);
      reads[k] = reads[k] || latent.features->reads(index) || (latent.directions && latent.directions->reads(index));
    }
  }
  return reads;
}

MatrixXd evaluate_features(const Prior& prior, std::size_t latent, const Ref<const MatrixXd>& states) {
  if (latent >= prior.latents.size()) {
    throw InputError(fmt::format("evaluate_features: the prior has {} latents, numbered from 0, got the latent {}",
                                 prior.latents.size(), latent));
  }
  const Latent& of = prior.latents[latent];
  if (!of.features) throw InputError(fmt::format("prior: the latent '{}' has no features", of.name));
  const MatrixXd features = of.features->evaluate(states, VectorXd());
  if (const std::optional<Entry> entry = first_not_finite(features)) {
    const std::string& feature = of.feature_names[static_cast<std::size_t>(entry->row)];
    std::vector<bool> reads;
    for (int k = 0; k < static_cast<int>(states.rows()); ++k) reads.push_back(of.features->reads(k));
    throw InputError(internal::describe_fault(
        *prior.system, states,
        {entry->state, fmt::format("latent '{}': the feature '{}' is not a finite number{}", of.name, feature,
                                   internal::unknown_entries(*prior.system, states, entry->state, reads))}));
  }
  return features.transpose();
}

PriorValues evaluate_prior(const Prior& prior, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                           const MechanicsBatch& mechanics, const MatrixXd* multipliers) {
  const Index nq = prior.system->nq();
  const int n_states = static_cast<int>(states.cols());
  PriorValues values{MatrixXd::Zero(nq, n_states), {}};
  if (prior.mean == Prior::Mean::constant) values.mean = prior.constant_mean.replicate(1, n_states);
  if (prior.mean == Prior::Mean::force) {
    for (int i = 0; i < n_states; ++i) {
      values.mean.col(i) = mechanics.projections[static_cast<std::size_t>(i)].solve_mass(mechanics.values.F(i));
    }
    if (const std::optional<Entry> entry = first_not_finite(mechanics.values.force)) {
      values.fault = {entry->state, fmt::format("the applied force on '{}' is not a finite number",
                                                coordinate_name(*prior.system, entry->row))};
    }
  }
  for (const Latent& latent : prior.latents) {
    MatrixXd E = evaluate_base(latent, states, parameters, nq, multipliers);
    const std::optional<Entry> entry = values.fault ? std::nullopt : first_not_finite(E);
    if (entry) {
      values.fault = {entry->state, fmt::format("latent '{}': '{}' along '{}' is not a finite number", latent.name,
                                                latent.column_names[static_cast<std::size_t>(entry->row / nq)],
                                                coordinate_name(*prior.system, static_cast<int>(entry->row % nq)))};
    }
    if (latent.base == Latent::Base::force) {
      for (int i = 0; i < n_states; ++i) {
        block(E, i, nq) = mechanics.projections[static_cast<std::size_t>(i)].solve_mass(block(E, i, nq));
      }
    } else if (latent.base == Latent::Base::admissible) {
      AdmissibleDirections directions;
      for (int i = 0; i < n_states; ++i) {
        const auto A = mechanics.values.A(i);
        block(E, i, nq) = directions.compute(A, block(E, i, nq), prior.system->largest_rank_of(A));
      }
    }
    values.directions.push_back(std::move(E));
  }
  return values;
}

PriorValues require_prior_values(const Prior& prior, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                 const MechanicsBatch& mechanics, const MatrixXd* multipliers) {
  PriorValues values = evaluate_prior(prior, states, parameters, mechanics, multipliers);
  if (values.fault) throw InputError(internal::describe_fault(*prior.system, states, *values.fault));
  return values;
}

PriorValues differentiate_prior(const Prior& prior, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                const MechanicsBatch& mechanics, const PriorValues& values, const SystemValues& derivative,
                                int index, const MatrixXd* multipliers) {
  const Index nq = prior.system->nq();
  const int n_states = static_cast<int>(states.cols());
  PriorValues d{MatrixXd::Zero(nq, n_states), {}};
  const auto solve = [&](int i, const Ref<const MatrixXd>& change, const Ref<const MatrixXd>& value) -> MatrixXd {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    return projection.solve_mass(change - projection.differentiate_mass(derivative.M(i), derivative.A(i)) * value);
  };
  // dμ = M⁻¹(dF − dM μ)
  if (prior.mean == Prior::Mean::force) {
    for (int i = 0; i < n_states; ++i) d.mean.col(i) = solve(i, derivative.F(i), values.mean.col(i));
  }
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    const StateFunction* const B = of_multipliers(latent, multipliers);
    MatrixXd dE = B != nullptr        ? B->differentiate(stacked(states, *multipliers), parameters, index)
                  : latent.directions ? latent.directions->differentiate(states, parameters, index)
                                      : MatrixXd::Zero(values.directions[a].rows(), n_states);
    // E = M⁻¹B: dE = M⁻¹(dB − dM E)
    if (latent.base == Latent::Base::force) {
      for (int i = 0; i < n_states; ++i) block(dE, i, nq) = solve(i, block(dE, i, nq), values.E(a, i));
    } else if (latent.base == Latent::Base::admissible) {
      MatrixXd all = evaluate_base(latent, states, parameters, nq, nullptr);
      AdmissibleDirections directions;
      for (int i = 0; i < n_states; ++i) {
        const auto A = mechanics.values.A(i);
        directions.compute(A, block(all, i, nq), prior.system->largest_rank_of(A));
        block(dE, i, nq) = directions.differentiate(derivative.A(i));
      }
    }
    d.directions.push_back(std::move(dE));
  }
  return d;
}

}  // namespace gp2
