#include "gp2/posterior.hpp"

#include <algorithm>
#include <cmath>

#include "gp2/error.hpp"
#include "inference/lapack.hpp"
#include "inference/reduction.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

struct Posterior::Implementation {
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  Reduction reduction;
  std::vector<MatrixXd> features;  // per latent (N × D)
  std::vector<MatrixXd> Z;         // per latent: R_i E_a diag(s)
  std::vector<MatrixXd> beta;      // per latent: β_j = Z_jᵀ α̃_j, one row per sample (N × p)
  MatrixXd L;                      // K̃ + I = L Lᵀ
  double negative_log_likelihood = 0;
};

namespace {

// everything a view needs at N states
struct Query {
  ViewValues view;
  PriorValues prior;
  std::vector<MatrixXd> features;

  // G E_a diag(s_a), the loading of the view on latent a at state i (d × p)
  [[nodiscard]] MatrixXd loading(const ModelValues& values, std::size_t a, int i) const {
    return view.G(i) * prior.E(a, i) * values.signal_stddev[a].asDiagonal();
  }
};

Query prepare(const Prior& prior, const ModelValues& values, const View& view, const Ref<const MatrixXd>& states) {
  const MechanicsBatch mechanics = require_mechanics(*prior.system, states, values.parameters);
  Query query{evaluate_view(view, mechanics, states), evaluate_prior(prior, states, values.parameters, mechanics), {}};
  if (view.latent >= 0) query.prior.keep_only(static_cast<std::size_t>(view.latent));
  for (const Latent& latent : prior.latents) query.features.push_back(evaluate_features(latent, states));
  return query;
}

// E[view] at state i: G (μ + Σ_a E_a diag(s) Σ_j k_a(φ, φ_j) β_j) + d
VectorXd mean_at(const Posterior::Implementation& self, const Query& query, int i, Kernel::Workspace& workspace, VectorXd& k) {
  VectorXd a_bar = query.prior.mean.col(i);
  for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
    self.prior.latents[a].kernel.evaluate(self.features[a], query.features[a].row(i).transpose(), self.values.kernel[a], k,
                                          workspace);
    a_bar += query.prior.E(a, i) * self.values.signal_stddev[a].cwiseProduct(self.beta[a].transpose() * k);
  }
  return query.view.G(i) * a_bar + query.view.offset.col(i);
}

// cov(ỹ, view) at state i (reduced size × d)
void cross_covariance(const Posterior::Implementation& self, const Query& query, int i, Kernel::Workspace& workspace, VectorXd& k,
                      Ref<MatrixXd> out) {
  out.setZero();
  for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
    self.prior.latents[a].kernel.evaluate(self.features[a], query.features[a].row(i).transpose(), self.values.kernel[a], k,
                                          workspace);
    const MatrixXd Z_loading = self.Z[a] * query.loading(self.values, a, i).transpose();
    for (int c = 0; c < self.reduction.n_components(); ++c) {
      const Index n = self.reduction.count[static_cast<std::size_t>(c)];
      const Index offset = self.reduction.offset[static_cast<std::size_t>(c)];
      out.middleRows(offset, n) += k.head(n).asDiagonal() * Z_loading.middleRows(offset, n);
    }
  }
}

// prior covariance of the view between states i and j (d × d)
MatrixXd prior_covariance(const Posterior::Implementation& self, const Query& query, int i, int j, Kernel::Workspace& workspace) {
  MatrixXd covariance = MatrixXd::Zero(query.view.offset.rows(), query.view.offset.rows());
  VectorXd k(1);
  for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
    self.prior.latents[a].kernel.evaluate(query.features[a].row(i), query.features[a].row(j).transpose(), self.values.kernel[a],
                                          k, workspace);
    covariance += k[0] * query.loading(self.values, a, i) * query.loading(self.values, a, j).transpose();
  }
  return covariance;
}

}  // namespace

Posterior::Posterior(Prior prior, std::vector<Observations> observations, ModelValues values) {
  auto self = std::make_shared<Implementation>();
  self->prior = std::move(prior);
  self->observations = std::move(observations);
  self->values = std::move(values);
  for (const Observations& group : self->observations) {
    require_mechanics(*self->prior.system, group.states, self->values.parameters);
  }
  const auto models = model_observations(self->prior, self->observations, self->values.parameters, {});
  self->reduction = reduce(self->prior, self->observations, *models, self->values.noise_stddev);
  self->features = sorted_features(features_by_group(self->prior, self->observations), self->reduction);

  const lapack::SingleThread single_thread;
  for (std::size_t a = 0; a < self->prior.latents.size(); ++a) {
    self->Z.emplace_back(self->reduction.directions[a] * self->values.signal_stddev[a].asDiagonal());
  }
  std::vector<MatrixXd> k;
  assemble(self->prior, self->reduction, self->features, self->Z, self->values.kernel, self->L, k);
  if (!lapack::factorise(self->L)) {
    throw NumericalError(
        "the covariance of the observations cannot be factored in double precision: the noise is too small for the "
        "signal; use a larger noise standard deviation");
  }
  VectorXd alpha = self->reduction.y;
  lapack::solve_lower(self->L, false, alpha);
  self->negative_log_likelihood = self->reduction.constant + 0.5 * alpha.squaredNorm() + self->L.diagonal().array().log().sum();
  lapack::solve_lower(self->L, true, alpha);

  for (const MatrixXd& Z : self->Z) self->beta.push_back(latent_weights(self->reduction, Z, alpha));
  implementation_ = std::move(self);
}

MatrixXd Posterior::mean(const View& view, const Ref<const MatrixXd>& states) const {
  const Implementation& self = *implementation_;
  const Query query = prepare(self.prior, self.values, view, states);
  Kernel::Workspace workspace;
  VectorXd k(static_cast<Index>(self.reduction.samples.size()));
  MatrixXd mean(view.size(), states.cols());
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) mean.col(i) = mean_at(self, query, i, workspace, k);
  return mean;
}

Posterior::Marginal Posterior::marginal(const View& view, const Ref<const MatrixXd>& states) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  const Query query = prepare(self.prior, self.values, view, states);
  Kernel::Workspace workspace;
  VectorXd k(static_cast<Index>(self.reduction.samples.size()));
  const Index d = view.size();
  Marginal marginal{MatrixXd(d, states.cols()), MatrixXd(d * d, states.cols()), 0};

  // triangular solves on blocks of states
  constexpr Index block_size = 64;
  MatrixXd cross(self.reduction.size(), d * std::min<Index>(block_size, states.cols()));
  for (Index first = 0; first < states.cols(); first += block_size) {
    const Index n = std::min(block_size, states.cols() - first);
    for (Index i = 0; i < n; ++i) {
      cross_covariance(self, query, static_cast<int>(first + i), workspace, k, cross.middleCols(d * i, d));
    }
    lapack::solve_lower(self.L, false, cross.leftCols(d * n));
    for (Index i = 0; i < n; ++i) {
      const int state = static_cast<int>(first + i);
      const auto v = cross.middleCols(d * i, d);
      MatrixXd covariance = prior_covariance(self, query, state, state, workspace) - v.transpose() * v;
      for (double& variance : covariance.diagonal()) {
        if (variance < 0) {
          variance = 0;
          ++marginal.n_clipped;
        }
      }
      marginal.covariance.col(state) = covariance.reshaped();
      marginal.mean.col(state) = mean_at(self, query, state, workspace, k);
    }
  }
  return marginal;
}

MatrixXd Posterior::Marginal::stddev() const {
  const Index d = mean.rows();
  MatrixXd stddev(d, mean.cols());
  for (Index j = 0; j < d; ++j) stddev.row(j) = covariance.row(j * d + j).cwiseSqrt();
  return stddev;
}

Posterior::Joint Posterior::joint(const View& view, const Ref<const MatrixXd>& states) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  const Query query = prepare(self.prior, self.values, view, states);
  Kernel::Workspace workspace;
  VectorXd k(static_cast<Index>(self.reduction.samples.size()));
  const Index d = view.size();
  const Index n = states.cols();
  Joint joint{VectorXd(d * n), MatrixXd(d * n, d * n)};
  MatrixXd cross(self.reduction.size(), d * n);
  for (Index i = 0; i < n; ++i) {
    joint.mean.segment(d * i, d) = mean_at(self, query, static_cast<int>(i), workspace, k);
    cross_covariance(self, query, static_cast<int>(i), workspace, k, cross.middleCols(d * i, d));
    for (Index j = 0; j <= i; ++j) {
      joint.covariance.block(d * i, d * j, d, d) =
          prior_covariance(self, query, static_cast<int>(i), static_cast<int>(j), workspace);
    }
  }
  lapack::solve_lower(self.L, false, cross);
  joint.covariance.selfadjointView<Eigen::Lower>().rankUpdate(cross.transpose(), -1);
  joint.covariance.triangularView<Eigen::StrictlyUpper>() = joint.covariance.transpose();
  return joint;
}

const Prior& Posterior::prior() const { return implementation_->prior; }
const std::vector<Observations>& Posterior::observations() const { return implementation_->observations; }
const ModelValues& Posterior::values() const { return implementation_->values; }
double Posterior::negative_log_likelihood() const { return implementation_->negative_log_likelihood; }
int Posterior::reduced_size() const { return static_cast<int>(implementation_->reduction.size()); }

}  // namespace gp2
