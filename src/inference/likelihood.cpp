#include "gp2/likelihood.hpp"

#include <cmath>
#include <limits>
#include <numbers>

#include "gp2/error.hpp"
#include "inference/lapack.hpp"
#include "inference/reduction.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

VectorXd row_stddev(const Eigen::Ref<const MatrixXd>& values) {
  const VectorXd mean = values.rowwise().mean();
  return (values.colwise() - mean).rowwise().squaredNorm().array().sqrt() / std::sqrt(static_cast<double>(values.cols()));
}

MatrixXd ModelValues::loading(std::size_t a) const {
  if (is_learned(a)) return mixing[a];
  return signal_stddev[a].asDiagonal();
}

struct Likelihood::Implementation {
  Prior prior;
  std::vector<Observations> observations;
  Options options;
  std::vector<std::vector<MatrixXd>> features;  // [group][latent] (N × D)

  // kept when nothing they depend on can change
  std::optional<std::vector<ObservationModel>> fixed_models;
  std::optional<Reduction> fixed_reduction;
  std::vector<MatrixXd> fixed_features;
  int initial_size = 0;
};

struct Likelihood::Workspace::Implementation {
  MatrixXd K;                // K̃ + I, then its factor, then its inverse
  std::vector<MatrixXd> k;   // per latent (N × N)
  std::vector<MatrixXd> Z;   // per latent: R_i E_a C_a
  std::vector<MatrixXd> V;   // per latent: V_i,a, rows as Z
  MatrixXd H;                // ⟨P_ij − α̃_iα̃_jᵀ, Z_i Z_jᵀ⟩ (N × N)
  VectorXd S;                // a column of P − α̃α̃ᵀ
  VectorXd column_gradient;  // in a factor of each column of Z
  VectorXd alpha;            // α̃
  Kernel::Workspace kernel;
};

Likelihood::Workspace::Workspace() : implementation_(std::make_unique<Implementation>()) {}
Likelihood::Workspace::~Workspace() = default;

Likelihood::Likelihood(Prior prior, std::vector<Observations> observations, const ModelValues& initial, Options options)
    : implementation_(std::make_unique<Implementation>()) {
  Implementation& self = *implementation_;
  self.prior = std::move(prior);
  self.observations = std::move(observations);
  self.options = std::move(options);
  for (const Observations& group : self.observations) {
    require_mechanics(*prior_of(self.prior, group.view).system, group.states, parameters_of(group.view, initial.parameters));
  }
  self.features = features_by_group(self.prior, self.observations);
  auto models = model_observations(self.prior, self.observations, initial.parameters, self.options.gradient_parameters);
  Reduction reduction = reduce(self.prior, self.observations, *models, initial.noise_stddev);
  self.initial_size = static_cast<int>(reduction.size());
  if (!self.options.gradient_parameters.empty()) return;
  if (!self.options.noise_gradient) {
    self.fixed_features = sorted_features(self.prior, self.features, reduction);
    self.fixed_reduction = std::move(reduction);
  }
  self.fixed_models = std::move(models);
}

Likelihood::~Likelihood() = default;
Likelihood::Likelihood(Likelihood&&) noexcept = default;

const Prior& Likelihood::prior() const { return implementation_->prior; }
const std::vector<Observations>& Likelihood::observations() const { return implementation_->observations; }
int Likelihood::reduced_size() const { return implementation_->initial_size; }

namespace {

ModelValues zero_gradient(const ModelValues& values) {
  ModelValues gradient = values;
  for (VectorXd& v : gradient.kernel) v.setZero();
  for (VectorXd& v : gradient.signal_stddev) v.setZero();
  for (MatrixXd& C : gradient.mixing) C.setZero();
  for (VectorXd& v : gradient.noise_stddev) v.setZero();
  gradient.parameters.setZero();
  return gradient;
}

// One sweep over the lower triangle of P − α̃α̃ᵀ for latent a: H (both orders of a pair folded into the lower triangle), the
// gradient ½ Σ_ij k_ij ⟨S_ij, ∂(Z_i Z_jᵀ)/∂log⟩ in a factor of each column of Z, and, where wanted, V_i = Σ_j S_ij Z_j k_ji.
void contract(const Reduction& reduction, const MatrixXd& P, const VectorXd& alpha, const MatrixXd& k, const MatrixXd& Z,
              MatrixXd& H, VectorXd& column_gradient, MatrixXd* V, VectorXd& S) {
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  if (H.rows() != n_samples) H.resize(n_samples, n_samples);
  H.setZero();
  column_gradient.setZero(Z.cols());
  if (V != nullptr) V->setZero(Z.rows(), Z.cols());
  for (int cj = 0; cj < reduction.n_components(); ++cj) {
    for (Index j = 0; j < reduction.count[static_cast<std::size_t>(cj)]; ++j) {
      const Index column = reduction.offset[static_cast<std::size_t>(cj)] + j;
      const auto z = Z.row(column).transpose();
      for (int ci = cj; ci < reduction.n_components(); ++ci) {
        const Index first = ci == cj ? j : 0;
        const Index n = reduction.count[static_cast<std::size_t>(ci)] - first;
        if (n <= 0) continue;
        const Index row = reduction.offset[static_cast<std::size_t>(ci)] + first;
        auto s = S.head(n);
        // each stored entry off the diagonal stands for two
        s = 2 * (P.col(column).segment(row, n) - alpha[column] * alpha.segment(row, n));
        if (ci == cj) s[0] *= 0.5;
        const auto rows = Z.middleRows(row, n);
        H.col(j).segment(first, n) += s.cwiseProduct(rows.lazyProduct(z));
        s = s.cwiseProduct(k.col(j).segment(first, n));
        const VectorXd projected = rows.transpose() * s;
        column_gradient += projected.cwiseProduct(z);
        if (V != nullptr) {
          V->middleRows(row, n).noalias() += 0.5 * s * z.transpose();
          V->row(column) += 0.5 * projected.transpose();
        }
      }
    }
  }
  for (Index j = 0; j < n_samples; ++j) {
    H.col(j).tail(n_samples - j - 1) += H.row(j).tail(n_samples - j - 1).transpose();
  }
}

// The same for a latent whose Z_i is the same at every sample, Z (components × functions): a sum over pairs of samples is then
// one number per pair of components. Returns Σ_ij S_ij k_ij, so that ∂NLL/∂C = DᵀGD C where Z = D C (components × components).
MatrixXd contract_alike(const Reduction& reduction, const MatrixXd& P, const VectorXd& alpha, const MatrixXd& k,
                        const MatrixXd& Z, MatrixXd& H, VectorXd& S) {
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  if (H.rows() != n_samples) H.resize(n_samples, n_samples);
  H.setZero();
  const MatrixXd products = Z * Z.transpose();
  MatrixXd G = MatrixXd::Zero(Z.rows(), Z.rows());
  for (Index cj = 0; cj < Z.rows(); ++cj) {
    for (Index ci = cj; ci < Z.rows(); ++ci) {
      for (Index j = 0; j < n_samples; ++j) {
        const Index column = cj * n_samples + j;
        const Index first = ci == cj ? j : 0;
        const Index n = n_samples - first;
        auto s = S.head(n);
        // each stored entry off the diagonal stands for two
        s = 2 * (P.col(column).segment(ci * n_samples + first, n) - alpha[column] * alpha.segment(ci * n_samples + first, n));
        if (ci == cj) s[0] *= 0.5;
        H.col(j).segment(first, n) += products(ci, cj) * s;
        G(ci, cj) += s.dot(k.col(j).segment(first, n));
      }
      if (ci == cj) continue;
      G(ci, cj) *= 0.5;
      G(cj, ci) = G(ci, cj);
    }
  }
  for (Index j = 0; j < n_samples; ++j) {
    H.col(j).tail(n_samples - j - 1) += H.row(j).tail(n_samples - j - 1).transpose();
  }
  return G;
}

// What θ and the noise change at sample i: ∂NLL/∂e, ∂NLL/∂W and ∂NLL/∂E there, and the chain rule on to σ and θ.
//
// latent_mean: per latent Σ_j k_ij Z_jᵀ α̃_j, one row per sample
void add_sample_gradient(const Likelihood::Options& options, const std::vector<ObservationModel>& models,
                         const Reduction& reduction, const ModelValues& values, Index i, const VectorXd& alpha,
                         const std::vector<MatrixXd>& all_V, const std::vector<MatrixXd>& latent_mean, ModelValues& gradient) {
  const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(i)];
  const std::size_t group = static_cast<std::size_t>(sample.group);
  const ObservationModel& model = models[group];
  const Index rank = sample.R.rows();
  const VectorXd whitening = values.noise_stddev[group].cwiseInverse();
  const auto rows_of = [&](const auto& reduced) {
    MatrixXd rows(rank, reduced.cols());
    for (Index c = 0; c < rank; ++c) rows.row(c) = reduced.row(reduction.offset[static_cast<std::size_t>(c)] + i);
    return rows;
  };

  // α_i = Q_i α̃_i + (I − Q_iQ_iᵀ) e_i
  const VectorXd d_e = sample.Q * rows_of(alpha) + sample.e_out;
  // ∂NLL/∂W_i = Q_i Σ_a V_i,a E_aᵀ − (I − Q_iQ_iᵀ) e_i (posterior mean of ā − μ)ᵀ
  MatrixXd V_E = MatrixXd::Zero(rank, sample.R.cols());
  VectorXd mean = VectorXd::Zero(sample.R.cols());
  std::vector<MatrixXd> V(all_V.size());
  for (std::size_t a = 0; a < all_V.size(); ++a) {
    const MatrixXd E = model.values.prior.E(a, sample.index) * values.loading(a);
    V[a] = rows_of(all_V[a]);
    V_E += V[a] * E.transpose();
    mean += E * latent_mean[a].row(i).transpose();
  }
  const MatrixXd d_W = sample.Q * V_E - sample.e_out * mean.transpose();
  const auto G = model.values.view.G(sample.index);

  // S^{-1/2} scales the rows of W and e
  if (options.noise_gradient) {
    const MatrixXd W = whitening.asDiagonal() * G;
    gradient.noise_stddev[group].array() += 1 - d_e.array() * sample.e.array() - d_W.cwiseProduct(W).rowwise().sum().array();
  }
  if (options.gradient_parameters.empty()) return;

  // e = S^{-1/2}(y − d − Gμ) and W = S^{-1/2}G: ∂NLL/∂d, ∂NLL/∂G, ∂NLL/∂μ and ∂NLL/∂E
  const VectorXd d_offset = -whitening.cwiseProduct(d_e);
  const MatrixXd d_G = whitening.asDiagonal() * d_W + d_offset * model.values.prior.mean.col(sample.index).transpose();
  const VectorXd d_mean = G.transpose() * d_offset;
  std::vector<MatrixXd>& d_E = V;
  for (std::size_t a = 0; a < d_E.size(); ++a) d_E[a] = sample.R.transpose() * V[a] * values.loading(a).transpose();
  for (std::size_t p = 0; p < options.gradient_parameters.size(); ++p) {
    const ObservationModel::Values& d = model.derivatives[p];
    double slope = d_offset.dot(d.view.offset.col(sample.index)) + d_G.cwiseProduct(d.view.G(sample.index)).sum() +
                   d_mean.dot(d.prior.mean.col(sample.index));
    for (std::size_t a = 0; a < d_E.size(); ++a) slope += d_E[a].cwiseProduct(d.prior.E(a, sample.index)).sum();
    gradient.parameters[options.gradient_parameters[p]] += slope;
  }
}

}  // namespace

double Likelihood::evaluate(const ModelValues& values, ModelValues* gradient, Workspace& workspace) const {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Implementation& self = *implementation_;
  Workspace::Implementation& work = *workspace.implementation_;
  const std::size_t n_latents = self.prior.latents.size();

  // observations under these parameters and noise
  std::optional<std::vector<ObservationModel>> own_models;
  if (!self.fixed_models) {
    own_models = model_observations(self.prior, self.observations, values.parameters,
                                    gradient != nullptr ? self.options.gradient_parameters : std::vector<int>{});
    if (!own_models) return infinity;
  }
  const std::vector<ObservationModel>& models = own_models ? *own_models : *self.fixed_models;
  std::optional<Reduction> own_reduction;
  std::vector<MatrixXd> own_features;
  if (!self.fixed_reduction) {
    own_reduction = reduce(self.prior, self.observations, models, values.noise_stddev);
    own_features = sorted_features(self.prior, self.features, *own_reduction);
  }
  const Reduction& reduction = own_reduction ? *own_reduction : *self.fixed_reduction;
  const std::vector<MatrixXd>& features = own_reduction ? own_features : self.fixed_features;

  // K̃ + I = L Lᵀ
  work.Z.resize(n_latents);
  for (std::size_t a = 0; a < n_latents; ++a) work.Z[a] = reduction.directions[a] * values.loading(a);
  assemble(self.prior, reduction, features, work.Z, values.kernel, work.K, work.k);
  if (!lapack::factorise(work.K)) return infinity;

  // −log N(ỹ; 0, K̃ + I)
  work.alpha = reduction.y;
  lapack::solve_lower(work.K, false, work.alpha);
  const double value = reduction.constant + 0.5 * work.alpha.squaredNorm() + work.K.diagonal().array().log().sum();
  if (!std::isfinite(value)) return infinity;
  if (gradient == nullptr) return value;
  lapack::solve_lower(work.K, true, work.alpha);
  lapack::invert_factored(work.K);

  *gradient = zero_gradient(values);
  const bool needs_V = self.options.noise_gradient || !self.options.gradient_parameters.empty();
  work.S.resize(static_cast<Index>(reduction.samples.size()));
  work.V.resize(n_latents);
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  for (std::size_t a = 0; a < n_latents; ++a) {
    const bool learned = values.is_learned(a);
    if (reduction.learned_alike[a] && !needs_V) {
      // the first row of each component
      const auto rows = Eigen::seqN(0, reduction.n_components(), n_samples);
      const MatrixXd D = reduction.directions[a](rows, Eigen::all);
      const MatrixXd G = contract_alike(reduction, work.K, work.alpha, work.k[a], D * values.loading(a), work.H, work.S);
      gradient->mixing[a] = D.transpose() * G * D * values.loading(a);
    } else {
      contract(reduction, work.K, work.alpha, work.k[a], work.Z[a], work.H, work.column_gradient,
               needs_V || learned ? &work.V[a] : nullptr, work.S);
      if (learned) {
        gradient->mixing[a].noalias() = reduction.directions[a].transpose() * work.V[a];
      } else {
        gradient->signal_stddev[a] = work.column_gradient;
      }
    }
    if (self.prior.latents[a].kernel_is_fixed || values.kernel[a].size() == 0) continue;
    for (Index j = 0; j < n_samples; ++j) {
      self.prior.latents[a].kernel.add_gradient(features[a].bottomRows(n_samples - j), features[a].row(j).transpose(),
                                                values.kernel[a], work.H.col(j).tail(n_samples - j), gradient->kernel[a],
                                                work.kernel);
    }
    gradient->kernel[a] *= 0.5;
  }
  if (!needs_V) return value;

  std::vector<MatrixXd> latent_mean(n_latents);
  for (std::size_t a = 0; a < n_latents; ++a) {
    latent_mean[a] = work.k[a] * latent_weights(reduction, work.Z[a], work.alpha);
  }
  for (Index i = 0; i < n_samples; ++i) {
    add_sample_gradient(self.options, models, reduction, values, i, work.alpha, work.V, latent_mean, *gradient);
  }
  return value;
}

}  // namespace gp2
