#include "gp2/posterior.hpp"

#include <numeric>
#include <utility>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "inference/assemble.hpp"
#include "inference/data_distance.hpp"
#include "inference/dense_gram.hpp"
#include "inference/latent_sums.hpp"
#include "inference/query.hpp"
#include "inference/requirements.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

void throw_not_definite() {
  throw NumericalError(
      "the covariance of the observations cannot be factored in double precision: the noise is too small for the "
      "signal; use a larger noise standard deviation");
}

void Posterior::Implementation::add_samples(const std::vector<Observations>& groups, const std::vector<VectorXd>& noise_stddev,
                                            int first_group) {
  Reduction reduction;
  reduce(prior, groups, require_models(prior, groups, values.parameters, about.get()), noise_stddev, reduction);
  const RowBlock block{latent_rows(prior, groups, reduction, values)};
  if (!latents) latents = std::make_shared<DensePosterior>(block.rows);
  if (!latents->append(WholeRows(block))) throw_not_definite();

  std::vector<std::int64_t> number{next_number};  // of the first sample of each group
  for (const Observations& group : groups) number.push_back(number.back() + group.n_data());
  next_number = number.back();
  for (const Reduction::Sample& sample : reduction.samples) {
    const std::size_t group = static_cast<std::size_t>(sample.group);
    samples.push_back({first_group + sample.group, number[group] + sample.index, sample.constant});
  }
}

Posterior::Implementation::Implementation(Prior of, std::vector<Observations> observed, ModelValues under)
    : prior(std::move(of)), observations(std::move(observed)), values(std::move(under)), n_given_groups(observations.size()) {
  require_observations(prior, observations);
  require_values(prior, observations, values);
  require_learnable(prior, observations);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) C.push_back(values.loading(a));
}

void Posterior::Implementation::condition(const Workers& workers) {
  const lapack::SingleThread single_thread;
  if (values.inducing) {
    condition_through_points(workers);
  } else if (prior.is_nonlinear() && !observations.empty()) {
    condition_nonlinear();
  } else {
    add_samples(observations, values.noise_stddev, 0);
  }
}

Posterior::Posterior(Prior prior, std::vector<Observations> observations, ModelValues values, const Workers& workers) {
  auto self = std::make_shared<Implementation>(std::move(prior), std::move(observations), std::move(values));
  self->condition(workers);
  components_ = {std::move(self)};
}

Posterior Posterior::lazy(Prior prior, std::vector<Observations> observations, ModelValues values) {
  if (values.inducing) return Posterior(std::move(prior), std::move(observations), std::move(values));
  auto self = std::make_shared<Implementation>(std::move(prior), std::move(observations), std::move(values));
  self->conditioning = std::make_shared<std::once_flag>();
  return Posterior(Components{std::move(self)});
}

Posterior Posterior::mixture(const Prior& prior, const std::vector<Observations>& observations,
                             const std::vector<ModelValues>& values, const Workers& workers) {
  if (values.empty()) throw InputError("Posterior::mixture: there are no values");
  Components components;
  for (const ModelValues& of_one : values) {
    components.push_back(Posterior(prior, observations, of_one, workers).components_.front());
  }
  return Posterior(std::move(components));
}

int Posterior::n_components() const { return static_cast<int>(held().size()); }

Posterior Posterior::component(int k) const {
  if (k < 0 || k >= n_components()) {
    throw InputError(fmt::format("Posterior: component {}: there are {}, 0 is the first", k, n_components()));
  }
  return Posterior(Components{components_[static_cast<std::size_t>(k)]});
}

Posterior Posterior::components(const std::vector<int>& which) const {
  if (which.empty()) throw InputError("Posterior::components: there are none");
  Components chosen;
  for (const int k : which) chosen.push_back(component(k).components_.front());
  return Posterior(std::move(chosen));
}

namespace {

// cov(v(x_i), v'(x_j)) of the prior from ℓ_aᵀ of both and k_a, per latent: added to (d × d')
void add_prior_covariance(double k, const double* left, const double* right, Index n_functions, Ref<MatrixXd> covariance) {
  const Map<const MatrixXd> l(left, n_functions, covariance.rows()), r(right, n_functions, covariance.cols());
  covariance.noalias() += k * l.transpose().lazyProduct(r);
}

MatrixXd mean_of(const Posterior::Implementation& self, const View& view, const Ref<const MatrixXd>& states, int n_threads) {
  require_query(self, view, states);
  constexpr Index block_size = 256;
  n_threads = thread_count(n_threads);
  std::vector<Query> queries(static_cast<std::size_t>(n_threads));
  std::vector<LatentSums> sums(static_cast<std::size_t>(n_threads), LatentSums(*self.latents));
  MatrixXd mean(view.size(), states.cols());
  for_each_block(states.cols(), block_size, n_threads, [&](Index first, Index n, int thread) {
    Query& query = queries[static_cast<std::size_t>(thread)];
    LatentSums& sum = sums[static_cast<std::size_t>(thread)];
    query.evaluate(self, view, states, first, n);
    sum.evaluate(query.features, query.needed);
    query.linearise(self, sum.mean());
    query.view_of(self, sum.mean(), mean.middleCols(first, n));
  });
  require_finite(*prior_of(self.prior, view).system, states, mean);
  return mean;
}

}  // namespace

MatrixXd Posterior::mean(const View& view, const Ref<const MatrixXd>& states, int n_threads) const {
  const Components& components = conditioned();
  MatrixXd mean = mean_of(*components.front(), view, states, n_threads);
  for (std::size_t k = 1; k < components.size(); ++k) mean += mean_of(*components[k], view, states, n_threads);
  if (components.size() > 1) mean /= static_cast<double>(components.size());
  return mean;
}

namespace {

// The marginals of a block of states, and the memory for it, of one thread.
class MarginalBlock {
 public:
  explicit MarginalBlock(const Posterior::Implementation& posterior) : posterior_(posterior), sums_(*posterior.latents) {}

  // Of the states first … first + n − 1, to the columns of `marginal` from `column` on. Returns how many variances it set to 0.
  int evaluate(const View& view, const Ref<const MatrixXd>& states, Index first, Index n, Posterior::Marginal& marginal,
               Index column) {
    query_.evaluate(posterior_, view, states, first, n);
    query_.linearise_at_mean(posterior_);
    const Query::Fewer fewer = query_.fewer_loadings(posterior_);
    const Index d = view.size(), r = fewer.n_rows;
    cross_.resize(posterior_.latents->size(), r * n);
    sums_.evaluate(query_.features, query_.needed, &fewer.loadings, &cross_);
    query_.view_of(posterior_, sums_.mean(), marginal.mean.middleCols(column, n));
    posterior_.latents->whiten(cross_);

    // of w (Query::Fewer): the prior's covariance at each state, less what the data explain
    MatrixXd covariances = MatrixXd::Zero(r * r, n);
    const auto covariance_at = [&](Index i) { return Map<MatrixXd>(covariances.col(i).data(), r, r); };
    for (std::size_t a = 0; a < fewer.loadings.size(); ++a) {
      if (!query_.needs(a)) continue;
      const MatrixXd& loadings = fewer.loadings[a];
      if (posterior_.prior.latents[a].is_potential) {
        const VectorXd variance = GradientColumns(posterior_.latents->latents()[a].kernel).variance();
        for (Index i = 0; i < n; ++i) {
          const Map<const MatrixXd> loading(loadings.col(i).data(), variance.size(), r);
          covariance_at(i).noalias() += loading.transpose() * variance.asDiagonal() * loading;
        }
        continue;
      }
      const VectorXd variances = prior_variances(a);
      for (Index i = 0; i < n; ++i) {
        const double* const loading = loadings.col(i).data();
        add_prior_covariance(variances[i], loading, loading, posterior_.C[a].cols(), covariance_at(i));
      }
    }
    int n_clipped = 0;
    for (Index i = 0; i < n; ++i) {
      const Map<const MatrixXd> U(fewer.U.col(i).data(), d, r);
      Map<MatrixXd> covariance(marginal.covariance.col(column + i).data(), d, d);
      covariance_at(i) -= cross_.middleCols(r * i, r).transpose().lazyProduct(cross_.middleCols(r * i, r));
      covariance = U.lazyProduct(covariance_at(i)).eval().lazyProduct(U.transpose());
      covariance.triangularView<Eigen::StrictlyLower>() = covariance.transpose();
      for (double& variance : covariance.diagonal()) {
        if (variance < 0) {
          variance = 0;
          ++n_clipped;
        }
      }
    }
    return n_clipped;
  }

 private:
  // k_a(φ_i, φ_i) at each state of the block
  VectorXd prior_variances(std::size_t a) {
    const KernelColumns kernel(posterior_.prior.latents[a].kernel, query_.features[a], posterior_.values.kernel[a]);
    VectorXd variances(query_.size());
    k_.resize(simd::lanes<double>);
    for (Index i = 0; i < variances.size(); ++i) {
      kernel.scale(i, point_);
      kernel.evaluate(whole_vectors_before(i), simd::lanes<double>, point_, k_.data(), workspace_);
      variances[i] = k_[i - whole_vectors_before(i)];
    }
    return variances;
  }

  const Posterior::Implementation& posterior_;
  Query query_;
  LatentSums sums_;
  MatrixXd cross_;  // cov(basis variables, w), then X times it
  VectorXd k_;      // between a state and some of the block
  VectorXd point_;
  KernelColumns::Workspace workspace_;
};

// Mean and covariance of a mixture of equal weights (theory.md, T31); of one component they are its own.
template <typename Gaussian, typename AddSquare>
Gaussian mixed(std::vector<Gaussian> components, const AddSquare& add_square) {
  if (components.size() == 1) return std::move(components.front());
  Gaussian out = components.front();
  for (std::size_t k = 1; k < components.size(); ++k) {
    out.mean += components[k].mean;
    out.covariance += components[k].covariance;
  }
  out.mean /= static_cast<double>(components.size());
  for (const Gaussian& component : components) add_square(out.covariance, component.mean - out.mean);
  out.covariance /= static_cast<double>(components.size());
  return out;
}

// Of the states first … first + n − 1.
Posterior::Marginal marginal_of(const Posterior::Implementation& self, const View& view, const Ref<const MatrixXd>& states,
                                Index first, Index n, int n_threads) {
  require_query(self, view, states);
  constexpr Index block_size = 64;
  n_threads = thread_count(n_threads);
  const Index d = view.size();
  std::vector<MarginalBlock> blocks(static_cast<std::size_t>(n_threads), MarginalBlock(self));
  std::vector<int> n_clipped(static_cast<std::size_t>(n_threads));
  Posterior::Marginal marginal{MatrixXd(d, n), MatrixXd(d * d, n), 0};
  for_each_block(n, block_size, n_threads, [&](Index start, Index size, int thread) {
    const std::size_t own = static_cast<std::size_t>(thread);
    n_clipped[own] += blocks[own].evaluate(view, states, first + start, size, marginal, start);
  });
  marginal.n_clipped = std::accumulate(n_clipped.begin(), n_clipped.end(), 0);
  const System& system = *prior_of(self.prior, view).system;
  require_finite(system, states.middleCols(first, n), marginal.mean, first);
  require_finite(system, states.middleCols(first, n), marginal.covariance, first);
  return marginal;
}

Posterior::Marginal mixed_marginal(const std::vector<std::shared_ptr<const Posterior::Implementation>>& components,
                                   const View& view, const Ref<const MatrixXd>& states, Index first, Index n, int n_threads) {
  const lapack::SingleThread single_thread;
  std::vector<Posterior::Marginal> of_components;
  int n_clipped = 0;
  for (const auto& component : components) {
    n_clipped += of_components.emplace_back(marginal_of(*component, view, states, first, n, n_threads)).n_clipped;
  }
  const Index d = view.size();
  Posterior::Marginal marginal = mixed(std::move(of_components), [d](MatrixXd& covariance, const MatrixXd& deviation) {
    for (Index i = 0; i < deviation.cols(); ++i) {
      Map<MatrixXd>(covariance.col(i).data(), d, d) += deviation.col(i) * deviation.col(i).transpose();
    }
  });
  marginal.n_clipped = n_clipped;
  return marginal;
}

}  // namespace

Posterior::Marginal Posterior::marginal(const View& view, const Ref<const MatrixXd>& states, int n_threads) const {
  return mixed_marginal(conditioned(), view, states, 0, states.cols(), n_threads);
}

void Posterior::for_each_marginal(const View& view, const Ref<const MatrixXd>& states, int n_threads,
                                  const std::function<void(Index, const Marginal&)>& take) const {
  constexpr Index block_size = 1 << 14;  // of whole blocks of marginal_of
  for_each_block(states.cols(), block_size, 1, [&](Index first, Index n, int) {
    take(first, mixed_marginal(conditioned(), view, states, first, n, n_threads));
  });
}

MatrixXd Posterior::Marginal::stddev() const {
  const Index d = mean.rows();
  MatrixXd stddev(d, mean.cols());
  for (Index j = 0; j < d; ++j) stddev.row(j) = covariance.row(j * d + j).cwiseSqrt();
  return stddev;
}

VectorXd Posterior::distance_from_data(const View& view, const Ref<const MatrixXd>& states, int n_threads) const {
  const Implementation& self = implementation();
  require_query(self, view, states);
  const DataDistance distance(self, view);
  const Prior& there = prior_of(self.prior, view);
  constexpr Index block_size = 64;
  VectorXd distances(states.cols());
  for_each_block(states.cols(), block_size, thread_count(n_threads), [&](Index first, Index n, int) {
    std::vector<MatrixXd> features(there.latents.size());
    for (std::size_t a = 0; a < features.size(); ++a) {
      if (view.has_latent(a)) features[a] = features_of_block(there, a, states, first, n).transpose();
    }
    VectorXd z(distance.n_coordinates());
    for (Index i = 0; i < n; ++i) {
      distance.write_coordinates([&](std::size_t a) { return features[a].col(i); }, z);
      distances[first + i] = distance.at(z);
    }
  });
  return distances;
}

namespace {

// what a potential adds to that, all states
void add_potential_covariance(const Posterior::Implementation& self, std::size_t a, const Query& left,
                              const MatrixXd& left_loadings, const Query& right, const MatrixXd& right_loadings,
                              Ref<MatrixXd> covariance) {
  const Index d = left.n_rows(), e = right.n_rows(), n_functions = self.C[a].cols();
  const KernelColumns points(self.prior.latents[a].kernel, left.features[a], self.values.kernel[a]);
  const GradientColumns columns(points);
  GradientColumns::Workspace w;
  VectorXd point;
  for (Index j = 0; j < right.size(); ++j) {
    points.scale(right.features[a].row(j).transpose(), point);
    columns.evaluate(0, left.size(), point, w);
    for (Index s = 0; s < e; ++s) {
      columns.multiply(right_loadings.col(j).segment(s * n_functions, n_functions), w);
      for (Index i = 0; i < left.size(); ++i) {
        const Map<const MatrixXd> loading(left_loadings.col(i).data(), n_functions, d);
        covariance.col(e * j + s).segment(d * i, d) += loading.transpose() * w.out.row(i).matrix().transpose();
      }
    }
  }
}

// between two queries, to their block; of one with itself the lower triangle of states
void add_prior_covariance(const Posterior::Implementation& self, const Query& left, const std::vector<MatrixXd>& left_loadings,
                          const Query& right, const std::vector<MatrixXd>& right_loadings, Ref<MatrixXd> covariance) {
  const Index d = left.n_rows(), e = right.n_rows();
  for (std::size_t a = 0; a < self.C.size(); ++a) {
    if (!left.needs(a) || !right.needs(a)) continue;
    if (self.prior.latents[a].is_potential) {
      add_potential_covariance(self, a, left, left_loadings[a], right, right_loadings[a], covariance);
      continue;
    }
    const MatrixXd k = self.prior.latents[a].kernel.evaluate(left.features[a], right.features[a], self.values.kernel[a]);
    for (Index i = 0; i < left.size(); ++i) {
      const Index end = &left == &right ? i + 1 : right.size();
      for (Index j = 0; j < end; ++j) {
        add_prior_covariance(k(i, j), left_loadings[a].col(i).data(), right_loadings[a].col(j).data(), self.C[a].cols(),
                             covariance.block(d * i, e * j, d, e));
      }
    }
  }
}

Posterior::Joint joint_of(const Posterior::Implementation& self, const std::vector<ViewAt>& quantities) {
  std::vector<Query> queries;
  std::vector<std::vector<MatrixXd>> loadings;
  std::vector<Index> first;  // row of each query
  Index size = 0;
  for (const ViewAt& quantity : quantities) {
    Query& query = queries.emplace_back(make_query(self, quantity.view, quantity.states));
    query.linearise_at_mean(self);
    loadings.push_back(query.loadings(self));
    first.push_back(size);
    size += query.n_rows() * query.size();
  }
  Posterior::Joint joint{VectorXd(size), MatrixXd::Zero(size, size)};
  MatrixXd cross(self.latents->size(), size), cross_of_query;
  LatentSums sums(*self.latents);
  for (std::size_t q = 0; q < queries.size(); ++q) {
    const Query& query = queries[q];
    const Index d = query.n_rows(), n = query.size();
    if (d * n == 0) continue;
    cross_of_query.resize(cross.rows(), d * n);
    sums.evaluate(query.features, query.needed, &loadings[q], &cross_of_query);
    cross.middleCols(first[q], d * n) = cross_of_query;
    query.view_of(self, sums.mean(), Map<MatrixXd>(joint.mean.data() + first[q], d, n));
    for (std::size_t r = 0; r <= q; ++r) {
      const Index rows = d * n, columns = queries[r].n_rows() * queries[r].size();
      add_prior_covariance(self, query, loadings[q], queries[r], loadings[r],
                           joint.covariance.block(first[q], first[r], rows, columns));
    }
  }
  self.latents->subtract_explained(std::move(cross), joint.covariance);
  joint.covariance.triangularView<Eigen::StrictlyUpper>() = joint.covariance.transpose();
  const VectorXd variances = joint.covariance.diagonal();  // which overflow first
  for (std::size_t q = 0; q < quantities.size(); ++q) {
    const Index d = queries[q].n_rows(), n = queries[q].size();
    const System& system = *prior_of(self.prior, quantities[q].view).system;
    require_finite(system, quantities[q].states, Map<const MatrixXd>(joint.mean.data() + first[q], d, n));
    require_finite(system, quantities[q].states, Map<const MatrixXd>(variances.data() + first[q], d, n));
  }
  return joint;
}

}  // namespace

Posterior::Joint Posterior::joint(const std::vector<ViewAt>& quantities) const {
  const lapack::SingleThread single_thread;
  std::vector<Joint> of_components;
  for (const auto& component : conditioned()) of_components.push_back(joint_of(*component, quantities));
  return mixed(std::move(of_components), [](MatrixXd& covariance, const VectorXd& deviation) {
    covariance.noalias() += deviation * deviation.transpose();
  });
}

Posterior::Joint Posterior::joint(const View& view, const Ref<const MatrixXd>& states) const {
  return joint({ViewAt{view, states}});
}

Posterior Posterior::without_data() const {
  std::vector<ModelValues> values;
  for (const auto& component : conditioned()) {
    values.push_back(component->values);
    values.back().noise_stddev.clear();
  }
  return mixture(prior(), {}, values);
}

Posterior::Posterior(Components components) : components_(std::move(components)) {}

const Posterior::Components& Posterior::held() const {
  if (components_.empty()) throw_moved("Posterior");
  return components_;
}
const Posterior::Components& Posterior::conditioned() const {
  for (const auto& component : held()) {
    if (!component->conditioning) continue;
    std::call_once(*component->conditioning, [&] { std::const_pointer_cast<Implementation>(component)->condition(1); });
  }
  return components_;
}
const Posterior::Implementation& Posterior::implementation() const { return *conditioned().front(); }
const Prior& Posterior::prior() const { return held().front()->prior; }
const std::vector<Observations>& Posterior::observations() const { return held().front()->observations; }
const ModelValues& Posterior::values() const { return held().front()->values; }
VectorXd Posterior::noise_stddev(std::size_t g) const {
  const std::size_t n = values().noise_stddev.size();
  if (g >= n) throw InputError(fmt::format("noise_stddev: there is no group {} of observations, of which there are {}", g, n));
  VectorXd out = values().noise_stddev[g];
  if (held().size() == 1) return out;
  out.setZero();
  for (const auto& component : held()) out += component->values.noise_stddev[g].cwiseAbs2();
  return (out / static_cast<double>(held().size())).cwiseSqrt();
}
int Posterior::reduced_size() const { return static_cast<int>(implementation().latents->size()); }

double Posterior::negative_log_likelihood() const {
  const GramValue value = implementation().latents->value();
  double sum = value.data_fit + value.complexity + value.constant;
  for (const Implementation::Sample& sample : implementation().samples) sum += sample.constant;
  return sum;
}

}  // namespace gp2
