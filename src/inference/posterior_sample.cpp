#include <map>
#include <utility>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/posterior.hpp"
#include "inference/latent_sums.hpp"
#include "inference/potential_cross.hpp"
#include "inference/query.hpp"

// Samples of a posterior at given states.
namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// Every latent function at a set of points, stacked: function l of latent a at point j stands at first[a] + l·points + j.
struct LatentPoints {
  std::vector<MatrixXd> features;          // per latent (points × D), each point once
  std::vector<std::vector<int>> of_state;  // per query: the point of each state
  std::vector<Index> first;                // per latent
  Index size = 0;

  /// Where the functions of latent a stand at state i of query q.
  [[nodiscard]] auto rows(std::size_t a, Index n_functions, std::size_t q, Index i) const {
    return Eigen::seqN(first[a] + of_state[q][static_cast<std::size_t>(i)], n_functions, features[a].rows());
  }

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
    for (std::size_t a = 0; a < posterior.C.size(); ++a) {
      MatrixXd& of_latent = features.emplace_back(static_cast<Index>(source.size()), posterior.prior.latents[a].n_features());
      for (std::size_t j = 0; j < source.size(); ++j) {
        of_latent.row(static_cast<Index>(j)) = queries[source[j].first].features[a].row(source[j].second);
      }
      first.push_back(size);
      size += posterior.C[a].cols() * of_latent.rows();
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
  MatrixXd cross = MatrixXd::Zero(self.latents->size(), points.size);
  LatentSums sums(*self.latents);
  for (std::size_t a = 0; a < self.C.size(); ++a) {
    const Index n_points = points.features[a].rows(), n_functions = self.C[a].cols();
    // each function is its own view of the latents
    std::vector<MatrixXd> loadings(self.C.size());
    loadings[a] = MatrixXd::Identity(n_functions, n_functions).reshaped().replicate(1, n_points);
    MatrixXd cross_of_latent(cross.rows(), n_functions * n_points);
    sums.evaluate(points.features, static_cast<int>(a), &loadings, &cross_of_latent);
    MatrixXd k;
    if (self.prior.latents[a].is_potential) {
      const Index all = n_functions * n_points;
      out.covariance.block(points.first[a], points.first[a], all, all) =
          covariance_of_gradients(self.prior.latents[a].kernel, points.features[a], self.values.kernel[a]);
    } else {
      k = self.prior.latents[a].kernel.evaluate(points.features[a], points.features[a], self.values.kernel[a]);
    }
    for (Index l = 0; l < n_functions; ++l) {
      const Index first = points.first[a] + l * n_points;
      if (k.size() > 0) out.covariance.block(first, first, n_points, n_points) = k;
      out.mean.segment(first, n_points) = sums.mean()[a].row(l).transpose();
      for (Index j = 0; j < n_points; ++j) cross.col(first + j) = cross_of_latent.col(j * n_functions + l);
    }
  }
  self.latents->subtract_explained(std::move(cross), out.covariance);
  return out;
}

// One point that overflows would spoil the samples of all.
void require_finite_at(const Posterior::Implementation& self, const LatentPoints& points, const std::vector<ViewAt>& quantities,
                       const LatentGaussian& latents) {
  const VectorXd size = latents.mean.cwiseAbs() + latents.covariance.diagonal();
  for (std::size_t q = 0; q < quantities.size(); ++q) {
    const std::vector<int>& of_state = points.of_state[q];
    MatrixXd sizes = MatrixXd::Zero(1, static_cast<Index>(of_state.size()));
    for (std::size_t a = 0; a < self.C.size(); ++a) {
      const Index n_points = points.features[a].rows();
      for (Index l = 0; l < self.C[a].cols(); ++l) {
        sizes += size.segment(points.first[a] + l * n_points, n_points)(of_state).transpose();
      }
    }
    require_finite(*prior_of(self.prior, quantities[q].view).system, quantities[q].states, sizes);
  }
}

// The views of query q of a nonlinear prior, sample by sample.
// @param numbers  of the samples among all
Index view_samples(const Posterior::Implementation& self, const LatentPoints& points, std::size_t q, const MatrixXd& samples_of_f,
                   const std::vector<Index>& numbers, Query& query, Ref<MatrixXd> out) {
  std::vector<MatrixXd> f(self.C.size());
  for (Index s = 0; s < out.cols(); ++s) {
    for (std::size_t a = 0; a < f.size(); ++a) {
      f[a].resize(self.C[a].cols(), query.size());
      for (Index i = 0; i < query.size(); ++i) f[a].col(i) = samples_of_f(points.rows(a, f[a].rows(), q, i), s);
    }
    try {
      query.linearise(self, f);
    } catch (const InputError& error) {
      throw InputError(fmt::format("sample {} of the {}: {}", numbers[static_cast<std::size_t>(s)] + 1,
                                   self.observations.empty() ? "prior" : "posterior", error.what()));
    }
    query.view_of(self, f, Map<MatrixXd>(out.col(s).data(), query.n_rows(), query.size()));
  }
  return out.rows();
}

MatrixXd sample_of(const Posterior::Implementation& self, const std::vector<ViewAt>& quantities,
                   const std::vector<Index>& numbers, RandomStream random) {
  const Index n_samples = std::ssize(numbers);
  std::vector<Query> queries;
  Index n_rows = 0;
  for (const ViewAt& quantity : quantities) {
    Query& query = queries.emplace_back(make_query(self, quantity.view, quantity.states));
    n_rows += query.n_rows() * query.size();
  }
  const LatentPoints points(self, queries);
  const LatentGaussian latents = latent_posterior(self, points);
  require_finite_at(self, points, quantities, latents);

  // f = mean + P L ξ, of a covariance Pᵀ Σ P = L Lᵀ that may be singular
  const lapack::PivotedFactor factor = lapack::factorise_semidefinite(latents.covariance);
  MatrixXd xi(points.size, n_samples);
  for (double& entry : xi.reshaped()) entry = random.normal();
  MatrixXd f(points.size, n_samples);
  f(factor.rows, Eigen::all) = factor.L * xi.topRows(factor.L.cols());
  f.colwise() += latents.mean;

  MatrixXd samples(n_rows, n_samples);
  Index row = 0;
  for (std::size_t q = 0; q < queries.size(); ++q) {
    Query& query = queries[q];
    if (self.prior.is_nonlinear()) {
      row += view_samples(self, points, q, f, numbers, query, samples.middleRows(row, query.n_rows() * query.size()));
      continue;
    }
    for (int i = 0; i < static_cast<int>(query.size()); ++i, row += query.n_rows()) {
      MatrixXd a_bar = query.prior.mean.col(i).replicate(1, n_samples);
      for (std::size_t a = 0; a < self.C.size(); ++a) {
        a_bar += query.prior.E(a, i) * (self.C[a] * MatrixXd(f(points.rows(a, self.C[a].cols(), q, i), Eigen::all)));
      }
      samples.middleRows(row, query.n_rows()) = (query.view.G(i) * a_bar).colwise() + query.view.offset.col(i);
    }
  }
  row = 0;
  for (std::size_t q = 0; q < queries.size(); ++q) {
    const Index d = queries[q].n_rows(), n = queries[q].size();
    const System& system = *prior_of(self.prior, quantities[q].view).system;
    for (const auto& sample : samples.middleRows(row, d * n).colwise()) {
      require_finite(system, quantities[q].states, sample.reshaped(d, n));
    }
    row += d * n;
  }
  return samples;
}

}  // namespace

std::vector<std::vector<Index>> samples_of_components(int n_components, int n_samples, std::uint64_t seed) {
  std::vector<std::vector<Index>> samples_of(static_cast<std::size_t>(n_components));
  for (int s = 0; s < n_samples; ++s) {
    // a stream of its own, that no sample draws from
    RandomStream random(~seed, static_cast<std::uint64_t>(s));
    samples_of[static_cast<std::size_t>(random.uniform() * n_components)].push_back(s);
  }
  return samples_of;
}

MatrixXd Posterior::sample(const std::vector<ViewAt>& quantities, int n_samples, std::uint64_t seed) const {
  if (n_samples < 0) throw InputError(fmt::format("Posterior::sample: n_samples must not be negative, got {}", n_samples));
  const lapack::SingleThread single_thread;
  const std::vector<std::vector<Index>> samples_of = samples_of_components(n_components(), n_samples, seed);
  MatrixXd samples;
  for (std::size_t k = 0; k < samples_of.size(); ++k) {
    if (samples_of[k].empty() && k > 0) continue;
    const MatrixXd of_one = sample_of(*conditioned()[k], quantities, samples_of[k], RandomStream(seed, k));
    samples.resize(of_one.rows(), n_samples);
    samples(Eigen::all, samples_of[k]) = of_one;
  }
  return samples;
}

}  // namespace gp2
