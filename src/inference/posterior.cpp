#include "gp2/posterior.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <numeric>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "base/random.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "inference/posterior_implementation.hpp"
#include "prior/padded_rows.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

void Query::evaluate(const Posterior::Implementation& posterior, const View& viewed, const Ref<const MatrixXd>& states,
                     Index first, Index n) {
  const Prior& there = prior_of(posterior.prior, viewed);
  const VectorXd parameters = parameters_of(viewed, posterior.values.parameters);
  const auto block = states.middleCols(first, n);
  evaluate_mechanics(there, viewed, block, parameters, mechanics);
  // whether constraints contradict each other depends on the largest b of all states, not of a block: throws, or all is well
  if (mechanics.fault) static_cast<void>(require_mechanics(there, viewed, states, parameters));
  view = evaluate_view(viewed, mechanics, block);
  prior = evaluate_prior(there, block, parameters, mechanics);
  latent = viewed.latent;
  if (latent) prior.keep_only(static_cast<std::size_t>(*latent));
  features.resize(there.latents.size());
  for (std::size_t a = 0; a < features.size(); ++a) features[a] = evaluate_features(there.latents[a], block);
}

void Query::view_of(const Posterior::Implementation& posterior, const std::vector<MatrixXd>& f, Ref<MatrixXd> values) const {
  VectorXd a_bar, signal;
  for (int i = 0; i < static_cast<int>(size()); ++i) {
    a_bar = prior.mean.col(i);
    for (std::size_t a = 0; a < f.size(); ++a) {
      if (!needs(a)) continue;
      signal.noalias() = posterior.latents[a].C.lazyProduct(f[a].col(i));
      a_bar.noalias() += prior.E(a, i).lazyProduct(signal);
    }
    values.col(i).noalias() = view.G(i).lazyProduct(a_bar);
    values.col(i) += view.offset.col(i);
  }
}

std::vector<MatrixXd> Query::loadings(const Posterior::Implementation& posterior) const {
  std::vector<MatrixXd> loadings;
  for (std::size_t a = 0; a < posterior.latents.size(); ++a) {
    const MatrixXd& C = posterior.latents[a].C;
    MatrixXd& of_latent = loadings.emplace_back(MatrixXd::Zero(C.cols() * n_rows(), size()));
    for (int i = 0; needs(a) && i < static_cast<int>(size()); ++i) {
      Map<MatrixXd>(of_latent.col(i).data(), C.cols(), n_rows()) = C.transpose() * (view.G(i) * prior.E(a, i)).transpose();
    }
  }
  return loadings;
}

Query make_query(const Posterior::Implementation& posterior, const View& view, const Ref<const MatrixXd>& states) {
  Query query;
  query.evaluate(posterior, view, states, 0, states.cols());
  return query;
}

MatrixXd Posterior::Implementation::latent_weights(std::size_t a, const VectorXd& alpha) const {
  const LatentAtSamples& latent = latents[a];
  const Index n_functions = latent.n_functions();
  MatrixXd weights = MatrixXd::Zero(latent.kernel.n_rows(), n_functions);
  for (std::size_t c = 0; c < row_of.size(); ++c) {
    const auto Z = latent.Z.middleCols(static_cast<Index>(c) * n_functions, n_functions);
    for (std::size_t j = 0; j < samples.size(); ++j) {
      if (row_of[c][j] < 0) continue;
      const Index row = static_cast<Index>(j);
      for (Index l = 0; l < n_functions; ++l) weights(row, l) += Z(row, l) * alpha[row_of[c][j]];
    }
  }
  return weights;
}

void Posterior::Implementation::finish() {
  const VectorXd alpha = factor.solve();
  for (std::size_t a = 0; a < latents.size(); ++a) latents[a].beta = latent_weights(a, alpha);
  negative_log_likelihood = 0.5 * factor.z().squaredNorm() + factor.L().diagonal().array().log().sum();
  for (const Sample& sample : samples) negative_log_likelihood += sample.constant;
}

namespace {

// Sums over the samples at a block of states, and their memory, of one thread.
class SampleSums {
 public:
  explicit SampleSums(const Posterior::Implementation& posterior) : posterior_(posterior), mean_(posterior.latents.size()) {}

  /// E[f_a] at every state, per latent (F × n); 0 where the latent was not needed.
  [[nodiscard]] const std::vector<MatrixXd>& mean() const { return mean_; }

  /// @param features  per latent (n × D)
  /// @param latent    the one that is needed; not given: all
  /// @param loadings  ℓ_aᵀ as in Query; where not null, `cross` receives cov(ỹ, Σ_a ℓ_aᵀ f_a), d columns per state
  void evaluate(const std::vector<MatrixXd>& features, std::optional<int> latent, const std::vector<MatrixXd>* loadings = nullptr,
                MatrixXd* cross = nullptr) {
    const std::size_t n_latents = posterior_.latents.size();
    const Index n_states = features.front().rows();
    const Index d = cross == nullptr || n_states == 0 ? 0 : cross->cols() / n_states;
    latent_ = latent;
    points_.resize(n_latents);
    for (std::size_t a = 0; a < n_latents; ++a) {
      points_[a].resize(static_cast<std::size_t>(n_states));
      for (Index i = 0; i < n_states; ++i) posterior_.latents[a].kernel.scale(features[a].row(i).transpose(), point(a, i));
      mean_[a].setZero(posterior_.latents[a].n_functions(), n_states);
    }
    const Index n_rows = posterior_.latents.front().kernel.n_rows();
    for (Index first = 0; first < n_rows; first += chunk) {
      const Index n = std::min(chunk, n_rows - first);
      for (Index i = 0; i < n_states; ++i) {
        for (std::size_t a = 0; a < n_latents; ++a) {
          if (needs(a)) add_chunk(a, first, n, i);
        }
        if (cross != nullptr) write_cross(first, n, i, *loadings, cross->middleCols(i * d, d));
      }
    }
  }

 private:
  static constexpr Index chunk = 256;  // samples whose features stay in the L1 cache

  [[nodiscard]] bool needs(std::size_t a) const { return !latent_ || *latent_ == static_cast<int>(a); }
  VectorXd& point(std::size_t a, Index i) { return points_[a][static_cast<std::size_t>(i)]; }

  // the kernel between samples of a chunk and state i, and its part of the mean
  void add_chunk(std::size_t a, Index first, Index n, Index i) {
    const Posterior::Implementation::LatentAtSamples& latent = posterior_.latents[a];
    const Index n_functions = latent.n_functions();
    k_.resize(chunk, static_cast<Index>(posterior_.latents.size()));
    sums_.resize(n_functions);
    double* const k = k_.col(static_cast<Index>(a)).data();
    latent.kernel.evaluate(first, n, point(a, i), k, kernel_);
    simd::loops().weighted_sums(n, n_functions, k, latent.beta.data() + first, latent.beta.rows(), sums_.data());
    for (Index l = 0; l < n_functions; ++l) mean_[a](l, i) += sums_[l];
  }

  // Σ_a k_a Z_a ℓ_a of a chunk, to the rows of its samples (reduced size × d)
  void write_cross(Index first, Index n, Index i, const std::vector<MatrixXd>& loadings, Ref<MatrixXd> cross) {
    const Index n_samples = std::min(n, static_cast<Index>(posterior_.samples.size()) - first);
    for (std::size_t c = 0; c < posterior_.row_of.size(); ++c) {
      const Index* const rows = posterior_.row_of[c].data() + first;
      for (Index e = 0; e < cross.cols(); ++e) {
        products_.setZero(chunk);
        for (std::size_t a = 0; a < posterior_.latents.size(); ++a) {
          if (!needs(a)) continue;
          const Posterior::Implementation::LatentAtSamples& latent = posterior_.latents[a];
          const Index n_functions = latent.n_functions();
          simd::loops().add_scaled_products(n, n_functions, k_.col(static_cast<Index>(a)).data(),
                                            latent.Z.col(static_cast<Index>(c) * n_functions).data() + first, latent.Z.rows(),
                                            loadings[a].col(i).data() + e * n_functions, products_.data());
        }
        double* const column = cross.col(e).data();
        for (Index j = 0; j < n_samples; ++j) {
          if (rows[j] >= 0) column[rows[j]] = products_[j];
        }
      }
    }
  }

  const Posterior::Implementation& posterior_;
  std::vector<std::vector<VectorXd>> points_;  // per latent and state: scaled features
  MatrixXd k_;                                 // (chunk × latents)
  VectorXd products_, sums_;
  std::vector<MatrixXd> mean_;
  KernelColumns::Workspace kernel_;
  std::optional<int> latent_;
};

// calls work(first state, how many, block, thread) for every block of states
template <typename Work>
void for_each_block(Index n_states, Index block_size, int n_threads, const Work& work) {
  const int n_blocks = static_cast<int>((n_states + block_size - 1) / block_size);
  parallel_for(n_blocks, n_threads, [&](int block, int thread) {
    const Index first = block * block_size;
    work(first, std::min(block_size, n_states - first), block, thread);
  });
}

// covariance − crossᵀ cross, in the lower triangle; with nothing in it Eigen would divide by 0
void subtract_explained(MatrixXd& covariance, const MatrixXd& cross) {
  if (cross.size() > 0) covariance.selfadjointView<Eigen::Lower>().rankUpdate(cross.transpose(), -1);
}

// cov(v(x_i), v'(x_j)) of the prior from ℓ_aᵀ of both and k_a, per latent: added to (d × d')
void add_prior_covariance(double k, const double* left, const double* right, Index n_functions, Ref<MatrixXd> covariance) {
  const Map<const MatrixXd> l(left, n_functions, covariance.rows()), r(right, n_functions, covariance.cols());
  covariance.noalias() += k * l.transpose().lazyProduct(r);
}

}  // namespace

void Posterior::Implementation::add_samples(const std::vector<Observations>& groups, const std::vector<VectorXd>& noise_stddev,
                                            int first_group) {
  std::vector<ObservationModel> models;
  if (!model_observations(prior, groups, values.parameters, {}, models)) {
    for (const Observations& group : groups) {
      static_cast<void>(require_mechanics(prior_of(prior, group.view()), group.view(), group.states(),
                                          parameters_of(group.view(), values.parameters)));
    }
  }
  Reduction reduction;
  reduce(prior, groups, models, noise_stddev, reduction);
  const std::vector<MatrixXd> features = sorted_features(prior, features_by_group(prior, groups), reduction);
  const Index n_old = static_cast<Index>(samples.size()), n_new = static_cast<Index>(reduction.samples.size());
  std::vector<KernelColumns> kernels;
  std::vector<MatrixXd> Z;
  for (std::size_t a = 0; a < latents.size(); ++a) {
    kernels.emplace_back(prior.latents[a].kernel, features[a], values.kernel[a]);
    Z.push_back(by_component(reduction, reduction.directions[a] * latents[a].C));
  }

  // the factor of K̃ + I, of all rows or extended by the new ones
  bool is_positive_definite = false;
  const bool is_first = factor.size() == 0;
  if (is_first) {
    GrowingCholesky first(reduction.size());
    assemble(reduction, kernels, Z, 1, first.lower());
    is_positive_definite = first.factorise(reduction.y);
    if (is_positive_definite) factor = std::move(first);
  } else {
    MatrixXd kappa(reduction.size(), reduction.size());
    assemble(reduction, kernels, Z, 1, kappa);
    // row c of Z at a sample is the loading of its component c
    std::vector<MatrixXd> loadings;
    for (const MatrixXd& rows : Z) loadings.emplace_back(rows.topRows(n_new).transpose());
    const Index n_components = reduction.n_components();
    MatrixXd cross(factor.size(), n_new * n_components), k(factor.size(), reduction.size());
    SampleSums(*this).evaluate(features, -1, &loadings, &cross);
    for (Index c = 0; c < n_components; ++c) {
      for (Index j = 0; j < reduction.count[static_cast<std::size_t>(c)]; ++j) {
        k.col(reduction.offset[static_cast<std::size_t>(c)] + j) = cross.col(j * n_components + c);
      }
    }
    is_positive_definite = factor.append(std::move(k), std::move(kappa), reduction.y);
  }
  if (!is_positive_definite) {
    throw NumericalError(
        "the covariance of the observations cannot be factored in double precision: the noise is too small for the "
        "signal; use a larger noise standard deviation");
  }

  // from here on nothing fails
  const Index first_row = y.size();
  y.conservativeResize(first_row + reduction.size());
  y.tail(reduction.size()) = reduction.y;
  if (row_of.size() < reduction.count.size()) row_of.resize(reduction.count.size(), std::vector<Index>(samples.size(), -1));
  for (std::size_t c = 0; c < row_of.size(); ++c) {
    row_of[c].resize(static_cast<std::size_t>(n_old + n_new), -1);
    if (c >= reduction.count.size()) continue;
    for (Index j = 0; j < reduction.count[c]; ++j) {
      row_of[c][static_cast<std::size_t>(n_old + j)] = first_row + reduction.offset[c] + j;
    }
  }
  for (std::size_t a = 0; a < latents.size(); ++a) {
    latents[a].kernel.append(features[a]);
    MatrixXd& all_Z = latents[a].Z;
    resize_points(all_Z, n_old + n_new);
    const Index n_columns = latents[a].n_functions() * static_cast<Index>(row_of.size());
    if (all_Z.cols() < n_columns) all_Z.conservativeResizeLike(MatrixXd::Zero(all_Z.rows(), n_columns));
    all_Z.block(n_old, 0, n_new, Z[a].cols()) = Z[a].topRows(n_new);
  }
  std::vector<std::int64_t> number{next_number};  // of the first sample of each group
  for (const Observations& group : groups) number.push_back(number.back() + group.n_data());
  next_number = number.back();
  for (const Reduction::Sample& sample : reduction.samples) {
    const std::size_t group = static_cast<std::size_t>(sample.group);
    samples.push_back({first_group + sample.group, number[group] + sample.index, sample.constant});
  }
}

void Posterior::Implementation::erase_samples(const std::vector<Index>& gone) {
  const Index n_samples = static_cast<Index>(samples.size());
  // the rows that go, and where those that stay come to stand
  std::vector<Index> rows;
  for (const std::vector<Index>& of_component : row_of) {
    for (const Index sample : gone) {
      if (of_component[static_cast<std::size_t>(sample)] >= 0) rows.push_back(of_component[static_cast<std::size_t>(sample)]);
    }
  }
  std::sort(rows.begin(), rows.end());
  factor.erase(rows);
  std::vector<Index> kept(static_cast<std::size_t>(y.size())), moved(kept.size());
  std::iota(kept.begin(), kept.end(), Index{0});
  kept.resize(static_cast<std::size_t>(close_gaps(kept.data(), y.size(), rows)));
  for (std::size_t row = 0; row < kept.size(); ++row) moved[static_cast<std::size_t>(kept[row])] = static_cast<Index>(row);
  y.conservativeResize(close_gaps(y.data(), y.size(), rows));

  for (std::vector<Index>& of_component : row_of) {
    of_component.resize(static_cast<std::size_t>(close_gaps(of_component.data(), n_samples, gone)));
    for (Index& row : of_component) row = row < 0 ? row : moved[static_cast<std::size_t>(row)];
  }
  for (LatentAtSamples& latent : latents) {
    erase_points(latent.Z, n_samples, gone);
    latent.kernel.erase(gone);
  }
  samples.resize(static_cast<std::size_t>(close_gaps(samples.data(), n_samples, gone)));
}

Posterior::Posterior(Prior prior, std::vector<Observations> observations, ModelValues values) {
  auto self = std::make_shared<Implementation>();
  self->prior = std::move(prior);
  self->observations = std::move(observations);
  self->values = std::move(values);
  for (std::size_t a = 0; a < self->prior.latents.size(); ++a) {
    const Latent& latent = self->prior.latents[a];
    self->latents.push_back({KernelColumns(latent.kernel, MatrixXd(0, latent.n_features()), self->values.kernel[a]),
                             self->values.loading(a),
                             {},
                             {}});
  }
  const lapack::SingleThread single_thread;
  self->add_samples(self->observations, self->values.noise_stddev, 0);
  self->finish();
  implementation_ = std::move(self);
}

MatrixXd Posterior::mean(const View& view, const Ref<const MatrixXd>& states, int n_threads) const {
  const Implementation& self = *implementation_;
  constexpr Index block_size = 256;
  n_threads = thread_count(n_threads);
  std::vector<Query> queries(static_cast<std::size_t>(n_threads));
  std::vector<SampleSums> sums(static_cast<std::size_t>(n_threads), SampleSums(self));
  MatrixXd mean(view.size(), states.cols());
  for_each_block(states.cols(), block_size, n_threads, [&](Index first, Index n, int, int thread) {
    Query& query = queries[static_cast<std::size_t>(thread)];
    SampleSums& sum = sums[static_cast<std::size_t>(thread)];
    query.evaluate(self, view, states, first, n);
    sum.evaluate(query.features, view.latent);
    query.view_of(self, sum.mean(), mean.middleCols(first, n));
  });
  return mean;
}

Posterior::Marginal Posterior::marginal(const View& view, const Ref<const MatrixXd>& states, int n_threads) const {
  const Implementation& self = *implementation_;
  const lapack::SingleThread single_thread;
  constexpr Index block_size = 64;
  n_threads = thread_count(n_threads);
  const Index d = view.size();
  struct Memory {
    Query query;
    SampleSums sums;
    MatrixXd cross;  // cov(ỹ, v), then L⁻¹ times it
    VectorXd k;      // between a state and the block
    VectorXd point;
    KernelColumns::Workspace kernel;
  };
  std::vector<Memory> memory(static_cast<std::size_t>(n_threads), Memory{{}, SampleSums(self), {}, {}, {}, {}});
  Marginal marginal{MatrixXd(d, states.cols()), MatrixXd(d * d, states.cols()), 0};
  std::vector<int> n_clipped(static_cast<std::size_t>((states.cols() + block_size - 1) / block_size));
  for_each_block(states.cols(), block_size, n_threads, [&](Index first, Index n, int block, int thread) {
    Memory& own = memory[static_cast<std::size_t>(thread)];
    own.query.evaluate(self, view, states, first, n);
    const std::vector<MatrixXd> loadings = own.query.loadings(self);
    own.cross.resize(self.factor.size(), d * n);
    own.sums.evaluate(own.query.features, view.latent, &loadings, &own.cross);
    own.query.view_of(self, own.sums.mean(), marginal.mean.middleCols(first, n));
    lapack::solve_lower(self.factor.L(), false, own.cross);

    // the prior's covariance at each state, less what the data explain
    auto covariance_at = [&](Index i) { return Map<MatrixXd>(marginal.covariance.col(first + i).data(), d, d); };
    marginal.covariance.middleCols(first, n).setZero();
    for (std::size_t a = 0; a < self.latents.size(); ++a) {
      if (!own.query.needs(a)) continue;
      const KernelColumns kernel(self.prior.latents[a].kernel, own.query.features[a], self.values.kernel[a]);
      own.k.resize(simd::lanes<double>);
      for (Index i = 0; i < n; ++i) {
        const double* const loading = loadings[a].col(i).data();
        kernel.scale(i, own.point);
        kernel.evaluate(whole_vectors_before(i), simd::lanes<double>, own.point, own.k.data(), own.kernel);
        add_prior_covariance(own.k[i - whole_vectors_before(i)], loading, loading, self.latents[a].n_functions(),
                             covariance_at(i));
      }
    }
    for (Index i = 0; i < n; ++i) {
      const auto v = own.cross.middleCols(d * i, d);
      auto covariance = covariance_at(i);
      covariance -= v.transpose() * v;
      for (double& variance : covariance.diagonal()) {
        if (variance < 0) {
          variance = 0;
          ++n_clipped[static_cast<std::size_t>(block)];
        }
      }
    }
  });
  marginal.n_clipped = std::accumulate(n_clipped.begin(), n_clipped.end(), 0);
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
  std::vector<Query> queries;
  std::vector<std::vector<MatrixXd>> loadings;
  std::vector<Index> first;  // row of each query
  Index size = 0;
  for (const ViewAt& quantity : quantities) {
    const Query& query = queries.emplace_back(make_query(self, quantity.view, quantity.states));
    loadings.push_back(query.loadings(self));
    first.push_back(size);
    size += query.n_rows() * query.size();
  }
  Joint joint{VectorXd(size), MatrixXd::Zero(size, size)};
  MatrixXd cross(self.factor.size(), size), cross_of_query;
  SampleSums sums(self);
  for (std::size_t q = 0; q < queries.size(); ++q) {
    const Query& query = queries[q];
    const Index d = query.n_rows(), n = query.size();
    if (d * n == 0) continue;
    cross_of_query.resize(cross.rows(), d * n);
    sums.evaluate(query.features, query.latent, &loadings[q], &cross_of_query);
    cross.middleCols(first[q], d * n) = cross_of_query;
    query.view_of(self, sums.mean(), Map<MatrixXd>(joint.mean.data() + first[q], d, n));
    for (std::size_t r = 0; r <= q; ++r) {
      const Index e = queries[r].n_rows();
      for (std::size_t a = 0; a < self.latents.size(); ++a) {
        if (!query.needs(a) || !queries[r].needs(a)) continue;
        const MatrixXd k =
            self.prior.latents[a].kernel.evaluate(query.features[a], queries[r].features[a], self.values.kernel[a]);
        for (Index i = 0; i < n; ++i) {
          const Index end = r == q ? i + 1 : queries[r].size();
          for (Index j = 0; j < end; ++j) {
            add_prior_covariance(k(i, j), loadings[q][a].col(i).data(), loadings[r][a].col(j).data(),
                                 self.latents[a].n_functions(), joint.covariance.block(first[q] + d * i, first[r] + e * j, d, e));
          }
        }
      }
    }
  }
  lapack::solve_lower(self.factor.L(), false, cross);
  subtract_explained(joint.covariance, cross);
  joint.covariance.triangularView<Eigen::StrictlyUpper>() = joint.covariance.transpose();
  return joint;
}

Posterior::Joint Posterior::joint(const View& view, const Ref<const MatrixXd>& states) const {
  return joint({ViewAt{view, states}});
}

namespace {

// Every latent function at a set of points, stacked: function l of latent a at point j stands at first[a] + l·points + j.
struct LatentPoints {
  std::vector<MatrixXd> features;          // per latent (points × D), each point once
  std::vector<std::vector<int>> of_state;  // per query: the point of each state
  std::vector<Index> first;                // per latent
  Index size = 0;

  // States of equal features share a point: drawn apart, they would agree to the square root of rounding only.
  LatentPoints(const Posterior::Implementation& posterior, const std::vector<Query>& queries) {
    std::map<std::vector<double>, int> known;
    std::vector<std::pair<std::size_t, Index>> source;  // query and state of each point
    for (std::size_t q = 0; q < queries.size(); ++q) {
      std::vector<int>& points = of_state.emplace_back();
      for (Index i = 0; i < queries[q].size(); ++i) {
        std::vector<double> key;
        for (const MatrixXd& features_of : queries[q].features) {
          for (const double value : features_of.row(i)) key.push_back(value);
        }
        const auto [place, is_new] = known.emplace(std::move(key), static_cast<int>(source.size()));
        if (is_new) source.emplace_back(q, i);
        points.push_back(place->second);
      }
    }
    for (std::size_t a = 0; a < posterior.latents.size(); ++a) {
      MatrixXd& of_latent = features.emplace_back(static_cast<Index>(source.size()), posterior.prior.latents[a].n_features());
      for (std::size_t j = 0; j < source.size(); ++j) {
        of_latent.row(static_cast<Index>(j)) = queries[source[j].first].features[a].row(source[j].second);
      }
      first.push_back(size);
      size += posterior.latents[a].n_functions() * of_latent.rows();
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
  MatrixXd cross = MatrixXd::Zero(self.factor.size(), points.size);
  SampleSums sums(self);
  for (std::size_t a = 0; a < self.latents.size(); ++a) {
    const Index n_points = points.features[a].rows(), n_functions = self.latents[a].n_functions();
    // each function is its own view of the latents
    std::vector<MatrixXd> loadings(self.latents.size());
    loadings[a] = MatrixXd::Identity(n_functions, n_functions).reshaped().replicate(1, n_points);
    MatrixXd cross_of_latent(cross.rows(), n_functions * n_points);
    sums.evaluate(points.features, static_cast<int>(a), &loadings, &cross_of_latent);
    const MatrixXd k = self.prior.latents[a].kernel.evaluate(points.features[a], points.features[a], self.values.kernel[a]);
    for (Index l = 0; l < n_functions; ++l) {
      const Index first = points.first[a] + l * n_points;
      out.covariance.block(first, first, n_points, n_points) = k;
      out.mean.segment(first, n_points) = sums.mean()[a].row(l).transpose();
      for (Index j = 0; j < n_points; ++j) cross.col(first + j) = cross_of_latent.col(j * n_functions + l);
    }
  }
  lapack::solve_lower(self.factor.L(), false, cross);
  subtract_explained(out.covariance, cross);
  return out;
}

}  // namespace

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
    for (int i = 0; i < static_cast<int>(query.size()); ++i, row += query.n_rows()) {
      MatrixXd a_bar = query.prior.mean.col(i).replicate(1, n_samples);
      for (std::size_t a = 0; a < self.latents.size(); ++a) {
        const auto rows = Eigen::seqN(points.first[a] + points.of_state[q][static_cast<std::size_t>(i)],
                                      self.latents[a].n_functions(), points.features[a].rows());
        a_bar += query.prior.E(a, i) * (self.latents[a].C * MatrixXd(f(rows, Eigen::all)));
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

Posterior::Posterior(std::shared_ptr<const Implementation> implementation) : implementation_(std::move(implementation)) {}

std::shared_ptr<Posterior::Implementation> Posterior::own_implementation() const {
  if (implementation_.use_count() > 1) return std::make_shared<Implementation>(*implementation_);
  // What another thread read through a copy that it has just let go was read before what is written now: to count down acquires
  // what it released. A fence would do, but the thread sanitizer does not know them.
  std::shared_ptr<const Implementation>(implementation_).reset();
  return std::const_pointer_cast<Implementation>(implementation_);
}

namespace {

void check_added(const Prior& prior, const Observations& added) {
  const Index n_state = prior_of(prior, added.view()).system->layout().size();
  if (added.states().rows() != n_state) {
    throw InputError(fmt::format("update: a column of `states` is a state of '{}' and must have {} rows (StateLayout), got {}",
                                 prior.system->name(), n_state, added.states().rows()));
  }
}

}  // namespace

Posterior update(Posterior&& posterior, Observations added) {
  check_added(posterior.prior(), added);
  const lapack::SingleThread single_thread;
  const auto self = posterior.own_implementation();

  // the group that has this view and noise, or one of its own
  std::size_t group = 0;
  const auto belongs = [&] {
    const Observations& there = self->observations[group];
    return there.view() == added.view() && self->values.noise_stddev[group] == added.noise().stddev() &&
           there.noise().has_scale() == added.noise().has_scale();
  };
  while (group < self->observations.size() && !belongs()) ++group;
  self->add_samples({added}, {added.noise().stddev()}, static_cast<int>(group));
  if (group < self->observations.size()) {
    self->observations[group].append(added);
  } else {
    self->values.noise_stddev.push_back(added.noise().stddev());
    self->observations.push_back(std::move(added));
  }
  self->finish();
  posterior.implementation_.reset();
  return Posterior(self);
}

Posterior remove_oldest(Posterior&& posterior, int n) {
  const std::size_t n_samples = posterior.implementation_->samples.size();
  if (n < 0 || static_cast<std::size_t>(n) > n_samples) {
    throw InputError(
        fmt::format("remove_oldest: there are {} observed states, so n must be 0 … {}, got {}", n_samples, n_samples, n));
  }
  const lapack::SingleThread single_thread;
  const auto self = posterior.own_implementation();
  std::vector<Index> gone(n_samples);
  std::iota(gone.begin(), gone.end(), Index{0});
  const auto is_older = [&](Index i, Index j) {
    return self->samples[static_cast<std::size_t>(i)].number < self->samples[static_cast<std::size_t>(j)].number;
  };
  std::partial_sort(gone.begin(), gone.begin() + n, gone.end(), is_older);
  gone.resize(static_cast<std::size_t>(n));
  std::sort(gone.begin(), gone.end());

  // in each group the oldest stand first
  std::vector<int> n_gone(self->observations.size());
  for (const Index sample : gone) ++n_gone[static_cast<std::size_t>(self->samples[static_cast<std::size_t>(sample)].group)];
  self->erase_samples(gone);
  for (std::size_t group = 0; group < n_gone.size(); ++group) self->observations[group].remove_first(n_gone[group]);
  self->finish();
  posterior.implementation_.reset();
  return Posterior(self);
}

const Prior& Posterior::prior() const { return implementation_->prior; }
const std::vector<Observations>& Posterior::observations() const { return implementation_->observations; }
const ModelValues& Posterior::values() const { return implementation_->values; }
double Posterior::negative_log_likelihood() const { return implementation_->negative_log_likelihood; }
int Posterior::reduced_size() const { return static_cast<int>(implementation_->factor.size()); }

}  // namespace gp2
