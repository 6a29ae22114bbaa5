#include "gp2/posterior.hpp"

#include <algorithm>
#include <cmath>
#include <map>

#include "gp2/error.hpp"
#include "inference/lapack.hpp"
#include "inference/posterior_implementation.hpp"
#include "prior/random.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

Query make_query(const Posterior::Implementation& posterior, const View& view, const Ref<const MatrixXd>& states) {
  const Prior& prior = prior_of(posterior.prior, view);
  const VectorXd parameters = parameters_of(view, posterior.values.parameters);
  const MechanicsBatch mechanics = require_mechanics(*prior.system, states, parameters);
  Query query{evaluate_view(view, mechanics, states), evaluate_prior(prior, states, parameters, mechanics), {}, {}};
  if (view.latent >= 0) query.prior.keep_only(static_cast<std::size_t>(view.latent));
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    query.features.push_back(evaluate_features(prior.latents[a], states));
    query.C.push_back(posterior.values.loading(a));
  }
  return query;
}

void cross_covariance(const Posterior::Implementation& posterior, const Query& query, int i, Kernel::Workspace& workspace,
                      VectorXd& k, Ref<MatrixXd> out) {
  out.setZero();
  for (std::size_t a = 0; a < posterior.prior.latents.size(); ++a) {
    posterior.kernel_at(a, query.features[a].row(i).transpose(), k, workspace);
    const MatrixXd Z_loading = posterior.Z[a] * query.loading(a, i).transpose();
    for (int c = 0; c < posterior.reduction.n_components(); ++c) {
      const Index n = posterior.reduction.count[static_cast<std::size_t>(c)];
      const Index offset = posterior.reduction.offset[static_cast<std::size_t>(c)];
      out.middleRows(offset, n) += k.head(n).asDiagonal() * Z_loading.middleRows(offset, n);
    }
  }
}

MatrixXd prior_covariance(const Posterior::Implementation& posterior, const Query& left, int i, const Query& right, int j,
                          Kernel::Workspace& workspace) {
  MatrixXd covariance = MatrixXd::Zero(left.n_rows(), right.n_rows());
  VectorXd k(1);
  for (std::size_t a = 0; a < posterior.prior.latents.size(); ++a) {
    posterior.prior.latents[a].kernel.evaluate(left.features[a].row(i), right.features[a].row(j).transpose(),
                                               posterior.values.kernel[a], k, workspace);
    covariance += k[0] * left.loading(a, i) * right.loading(a, j).transpose();
  }
  return covariance;
}

namespace {

// E[view] at state i: G (μ + Σ_a E_a C_a Σ_j k_a(φ, φ_j) β_j) + d
VectorXd mean_at(const Posterior::Implementation& self, const Query& query, int i, Kernel::Workspace& workspace, VectorXd& k) {
  VectorXd a_bar = query.prior.mean.col(i);
  for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
    self.kernel_at(a, query.features[a].row(i).transpose(), k, workspace);
    a_bar += query.prior.E(a, i) * (query.C[a] * (self.beta[a].transpose() * k));
  }
  return query.view.G(i) * a_bar + query.view.offset.col(i);
}

// covariance − crossᵀ cross, in the lower triangle; without observations Eigen would divide by 0
void subtract_explained(MatrixXd& covariance, const MatrixXd& cross) {
  if (cross.rows() > 0) covariance.selfadjointView<Eigen::Lower>().rankUpdate(cross.transpose(), -1);
}

// Every latent function at a set of points, stacked: function l of latent a at point j stands at first[a] + l·points + j.
struct LatentPoints {
  std::vector<MatrixXd> features;          // per latent (points × D), each point once
  std::vector<std::vector<int>> of_state;  // per query: the point of each state
  std::vector<Index> first;                // per latent
  Index size = 0;

  // States of equal features share a point: drawn apart, they would agree to the square root of rounding only.
  LatentPoints(const Posterior::Implementation& posterior, const std::vector<Query>& queries) {
    std::map<std::vector<double>, int> known;
    std::vector<std::pair<std::size_t, int>> source;  // query and state of each point
    for (std::size_t q = 0; q < queries.size(); ++q) {
      std::vector<int>& points = of_state.emplace_back();
      for (int i = 0; i < queries[q].size(); ++i) {
        std::vector<double> key;
        for (const MatrixXd& features_of : queries[q].features) {
          for (const double value : features_of.row(i)) key.push_back(value);
        }
        const auto [place, is_new] = known.emplace(std::move(key), static_cast<int>(source.size()));
        if (is_new) source.emplace_back(q, i);
        points.push_back(place->second);
      }
    }
    for (std::size_t a = 0; a < posterior.prior.latents.size(); ++a) {
      MatrixXd& of_latent = features.emplace_back(static_cast<Index>(source.size()), posterior.features[a].cols());
      for (std::size_t j = 0; j < source.size(); ++j) {
        of_latent.row(static_cast<Index>(j)) = queries[source[j].first].features[a].row(source[j].second);
      }
      first.push_back(size);
      size += posterior.prior.latents[a].n_functions() * of_latent.rows();
    }
  }
};

struct LatentGaussian {
  VectorXd mean;
  MatrixXd covariance;
};

// the posterior of every latent function at the points
LatentGaussian latent_posterior(const Posterior::Implementation& self, const LatentPoints& points) {
  LatentGaussian out{VectorXd::Zero(points.size), MatrixXd::Zero(points.size, points.size)};
  MatrixXd cross = MatrixXd::Zero(self.reduction.size(), points.size);
  Kernel::Workspace workspace;
  VectorXd k;
  for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
    const Index n_points = points.features[a].rows();
    const int n_functions = self.prior.latents[a].n_functions();
    for (Index j = 0; j < n_points; ++j) {
      const VectorXd point = points.features[a].row(j).transpose();
      k.resize(n_points);
      self.prior.latents[a].kernel.evaluate(points.features[a], point, self.values.kernel[a], k, workspace);
      for (int l = 0; l < n_functions; ++l) {
        const Index first = points.first[a] + l * n_points;
        out.covariance.col(first + j).segment(first, n_points) = k;
      }
      self.kernel_at(a, point, k, workspace);
      for (int l = 0; l < n_functions; ++l) {
        const Index column = points.first[a] + l * n_points + j;
        out.mean[column] = self.beta[a].col(l).dot(k);
        for (int c = 0; c < self.reduction.n_components(); ++c) {
          const Index n = self.reduction.count[static_cast<std::size_t>(c)];
          const Index offset = self.reduction.offset[static_cast<std::size_t>(c)];
          cross.col(column).segment(offset, n) = k.head(n).cwiseProduct(self.Z[a].col(l).segment(offset, n));
        }
      }
    }
  }
  lapack::solve_lower(self.L, false, cross);
  subtract_explained(out.covariance, cross);
  return out;
}

}  // namespace

Posterior::Posterior(Prior prior, std::vector<Observations> observations, ModelValues values) {
  auto self = std::make_shared<Implementation>();
  self->prior = std::move(prior);
  self->observations = std::move(observations);
  self->values = std::move(values);
  for (const Observations& group : self->observations) {
    require_mechanics(*prior_of(self->prior, group.view).system, group.states,
                      parameters_of(group.view, self->values.parameters));
  }
  const auto models = model_observations(self->prior, self->observations, self->values.parameters, {});
  self->reduction = reduce(self->prior, self->observations, *models, self->values.noise_stddev);
  self->features = sorted_features(self->prior, features_by_group(self->prior, self->observations), self->reduction);

  const lapack::SingleThread single_thread;
  for (std::size_t a = 0; a < self->prior.latents.size(); ++a) {
    self->Z.emplace_back(self->reduction.directions[a] * self->values.loading(a));
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
  const Query query = make_query(self, view, states);
  Kernel::Workspace workspace;
  VectorXd k(static_cast<Index>(self.reduction.samples.size()));
  MatrixXd mean(view.size(), states.cols());
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) mean.col(i) = mean_at(self, query, i, workspace, k);
  return mean;
}

Posterior::Marginal Posterior::marginal(const View& view, const Ref<const MatrixXd>& states) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  const Query query = make_query(self, view, states);
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
      MatrixXd covariance = prior_covariance(self, query, state, query, state, workspace) - v.transpose() * v;
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

Posterior::Joint Posterior::joint(const std::vector<ViewAt>& quantities) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  Kernel::Workspace workspace;
  VectorXd k;
  std::vector<Query> queries;
  std::vector<Index> first;  // row of each query
  Index size = 0;
  for (const ViewAt& quantity : quantities) {
    const Query& query = queries.emplace_back(make_query(self, quantity.view, quantity.states));
    first.push_back(size);
    size += query.n_rows() * query.size();
  }
  Joint joint{VectorXd(size), MatrixXd(size, size)};
  MatrixXd cross(self.reduction.size(), size);
  for (std::size_t q = 0; q < queries.size(); ++q) {
    const Index d = queries[q].n_rows();
    for (int i = 0; i < queries[q].size(); ++i) {
      const Index row = first[q] + d * i;
      joint.mean.segment(row, d) = mean_at(self, queries[q], i, workspace, k);
      cross_covariance(self, queries[q], i, workspace, k, cross.middleCols(row, d));
      for (std::size_t r = 0; r <= q; ++r) {
        const Index e = queries[r].n_rows();
        const int end = r == q ? i + 1 : queries[r].size();
        for (int j = 0; j < end; ++j) {
          joint.covariance.block(row, first[r] + e * j, d, e) = prior_covariance(self, queries[q], i, queries[r], j, workspace);
        }
      }
    }
  }
  lapack::solve_lower(self.L, false, cross);
  subtract_explained(joint.covariance, cross);
  joint.covariance.triangularView<Eigen::StrictlyUpper>() = joint.covariance.transpose();
  return joint;
}

Posterior::Joint Posterior::joint(const View& view, const Ref<const MatrixXd>& states) const {
  return joint({ViewAt{view, states}});
}

MatrixXd Posterior::sample(const std::vector<ViewAt>& quantities, int n_samples, std::uint64_t seed) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  std::vector<Query> queries;
  Index n_rows = 0;
  for (const ViewAt& quantity : quantities) {
    const Query& query = queries.emplace_back(make_query(self, quantity.view, quantity.states));
    n_rows += query.n_rows() * query.size();
  }
  const LatentPoints points(self, queries);
  const LatentGaussian latents = latent_posterior(self, points);

  // f = mean + P L ξ, of a covariance Pᵀ Σ P = L Lᵀ that may be singular
  const lapack::PivotedFactor factor = lapack::factorise_semidefinite(latents.covariance);
  RandomStream random(seed);
  MatrixXd xi(points.size, n_samples);
  for (double& entry : xi.reshaped()) entry = random.normal();
  MatrixXd f(points.size, n_samples);
  f(factor.rows, Eigen::all) = factor.L * xi.topRows(factor.L.cols());
  f.colwise() += latents.mean;

  MatrixXd samples(n_rows, n_samples);
  Index row = 0;
  for (std::size_t q = 0; q < queries.size(); ++q) {
    const Query& query = queries[q];
    for (int i = 0; i < query.size(); ++i, row += query.n_rows()) {
      MatrixXd a_bar = query.prior.mean.col(i).replicate(1, n_samples);
      for (std::size_t a = 0; a < self.prior.latents.size(); ++a) {
        const Index n_points = points.features[a].rows();
        const auto rows = Eigen::seqN(points.first[a] + points.of_state[q][static_cast<std::size_t>(i)],
                                      self.prior.latents[a].n_functions(), n_points);
        a_bar += query.prior.E(a, i) * (query.C[a] * MatrixXd(f(rows, Eigen::all)));
      }
      samples.middleRows(row, query.n_rows()) = (query.view.G(i) * a_bar).colwise() + query.view.offset.col(i);
    }
  }
  return samples;
}

Posterior Posterior::without_data() const {
  const Implementation& self = *implementation_;
  ModelValues values = self.values;
  values.noise_stddev.clear();
  return {self.prior, {}, std::move(values)};
}

const Prior& Posterior::prior() const { return implementation_->prior; }
const std::vector<Observations>& Posterior::observations() const { return implementation_->observations; }
const ModelValues& Posterior::values() const { return implementation_->values; }
double Posterior::negative_log_likelihood() const { return implementation_->negative_log_likelihood; }
int Posterior::reduced_size() const { return static_cast<int>(implementation_->reduction.size()); }

}  // namespace gp2
