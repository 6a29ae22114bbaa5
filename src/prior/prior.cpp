#include "gp2/prior.hpp"

#include <utility>

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

Map<MatrixXd> block(MatrixXd& matrix, int i, Index rows) { return {matrix.col(i).data(), rows, matrix.rows() / rows}; }

// B(x) at N states
MatrixXd evaluate_base(const Latent& latent, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters, Index nq) {
  if (latent.directions) return latent.directions->evaluate(states, parameters);
  const MatrixXd identity = MatrixXd::Identity(nq, nq);
  return identity.reshaped().replicate(1, states.cols());
}

}  // namespace

std::vector<bool> Prior::reads() const {
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

void PriorValues::keep_only(std::size_t latent) {
  mean.setZero();
  for (std::size_t a = 0; a < directions.size(); ++a) {
    if (a != latent) directions[a].setZero();
  }
}

MatrixXd evaluate_features(const Latent& latent, const Ref<const MatrixXd>& states) {
  return latent.features->evaluate(states, VectorXd()).transpose();
}

PriorValues evaluate_prior(const Prior& prior, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                           const MechanicsBatch& mechanics) {
  const Index nq = prior.system->nq();
  const int n_states = static_cast<int>(states.cols());
  PriorValues values{MatrixXd::Zero(nq, n_states), {}};
  if (prior.mean == Prior::Mean::constant) values.mean = prior.constant_mean.replicate(1, n_states);
  if (prior.mean == Prior::Mean::force) {
    for (int i = 0; i < n_states; ++i) {
      values.mean.col(i) = mechanics.projections[static_cast<std::size_t>(i)].solve_mass(mechanics.values.F(i));
    }
  }
  for (const Latent& latent : prior.latents) {
    MatrixXd E = evaluate_base(latent, states, parameters, nq);
    if (latent.base == Latent::Base::force) {
      for (int i = 0; i < n_states; ++i) {
        block(E, i, nq) = mechanics.projections[static_cast<std::size_t>(i)].solve_mass(block(E, i, nq));
      }
    }
    values.directions.push_back(std::move(E));
  }
  return values;
}

PriorValues differentiate_prior(const Prior& prior, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                const MechanicsBatch& mechanics, const PriorValues& values, const SystemValues& derivative,
                                int index) {
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
    MatrixXd dE = latent.directions ? latent.directions->differentiate(states, parameters, index)
                                    : MatrixXd::Zero(values.directions[a].rows(), n_states);
    // E = M⁻¹B: dE = M⁻¹(dB − dM E)
    if (latent.base == Latent::Base::force) {
      for (int i = 0; i < n_states; ++i) block(dE, i, nq) = solve(i, block(dE, i, nq), values.E(a, i));
    }
    d.directions.push_back(std::move(dE));
  }
  return d;
}

}  // namespace gp2
