#include "gp2/pathwise.hpp"

#include <algorithm>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "inference/lapack.hpp"
#include "inference/posterior_implementation.hpp"
#include "prior/random_features.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// The functions of one latent in one sample: f(φ) = Wᵀψ(φ) + βᵀk(φ).
struct LatentPath {
  RandomFeatures features;
  MatrixXd weights;  // W (features × functions)
  MatrixXd beta;     // β (N × functions)
};

LatentPath draw_prior_path(const Posterior::Implementation& posterior, std::size_t a, int n_features, RandomStream& random) {
  const Latent& latent = posterior.prior.latents[a];
  LatentPath path{RandomFeatures(latent.kernel, posterior.values.kernel[a], n_features, random), {}, {}};
  path.weights.resize(path.features.size(), latent.n_functions());
  for (double& weight : path.weights.reshaped()) weight = random.normal();
  return path;
}

// ỹ − Σ_a Z_a f̃_a − ε, what is left of the data to explain
VectorXd misfit(const Posterior::Implementation& posterior, const std::vector<LatentPath>& paths, RandomStream& random) {
  VectorXd misfit = posterior.reduction.y;
  for (std::size_t a = 0; a < paths.size(); ++a) {
    const LatentPath& path = paths[a];
    VectorXd psi(path.features.size());
    for (Index k = 0; k < posterior.features[a].rows(); ++k) {
      path.features.evaluate(posterior.features[a].row(k).transpose(), psi);
      const VectorXd f = path.weights.transpose() * psi;
      // the components of this observation: the samples are sorted by falling rank
      for (int c = 0; c < posterior.reduction.n_components(); ++c) {
        if (k >= posterior.reduction.count[static_cast<std::size_t>(c)]) break;
        const Index row = posterior.reduction.offset[static_cast<std::size_t>(c)] + k;
        misfit[row] -= posterior.Z[a].row(row) * f;
      }
    }
  }
  for (double& entry : misfit) entry -= random.normal();
  return misfit;
}

}  // namespace

struct PathwiseSamples::Implementation {
  std::shared_ptr<const Posterior::Implementation> posterior;
  std::vector<std::vector<LatentPath>> samples;  // [sample][latent]
};

PathwiseSamples::PathwiseSamples(std::shared_ptr<const Implementation> implementation)
    : implementation_(std::move(implementation)) {}

int PathwiseSamples::n_samples() const { return static_cast<int>(implementation_->samples.size()); }

MatrixXd PathwiseSamples::evaluate(int sample, const View& view, const Ref<const MatrixXd>& states) const {
  if (sample < 0 || sample >= n_samples()) {
    throw InputError(fmt::format("sample {}: there are {} samples, 0 is the first", sample, n_samples()));
  }
  const Posterior::Implementation& posterior = *implementation_->posterior;
  const std::vector<LatentPath>& paths = implementation_->samples[static_cast<std::size_t>(sample)];
  const Query query = make_query(posterior, view, states);
  Kernel::Workspace workspace;
  VectorXd psi, k;
  MatrixXd a_bar = query.prior.mean;
  for (std::size_t a = 0; a < paths.size(); ++a) {
    if (view.latent >= 0 && view.latent != static_cast<int>(a)) continue;
    const LatentPath& path = paths[a];
    psi.resize(path.features.size());
    VectorXd f(path.weights.cols());
    for (int i = 0; i < query.size(); ++i) {
      const VectorXd point = query.features[a].row(i);
      path.features.evaluate(point, psi);
      f.noalias() = path.weights.transpose() * psi;
      posterior.kernel_at(a, point, k, workspace);
      f.noalias() += path.beta.transpose() * k;
      a_bar.col(i) += query.prior.E(a, i) * (query.C[a] * f);
    }
  }
  MatrixXd values = query.view.offset;
  for (int i = 0; i < query.size(); ++i) values.col(i) += query.view.G(i) * a_bar.col(i);
  return values;
}

PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options) {
  if (n_samples < 1) throw InputError(fmt::format("sample_paths: n_samples must be 1 or more, got {}", n_samples));
  if (options.n_features < 1)
    throw InputError(fmt::format("sample_paths: n_features must be 1 or more, got {}", options.n_features));
  auto self = std::make_shared<PathwiseSamples::Implementation>();
  self->posterior = posterior.implementation_;
  const Posterior::Implementation& conditioned = *self->posterior;
  const lapack::SingleThread single_thread;

  // solved in blocks that are always as wide, so that the bits of a sample do not depend on how many there are
  constexpr int block_size = 8;
  MatrixXd alpha = MatrixXd::Zero(conditioned.reduction.size(), block_size);
  for (int first = 0; first < n_samples; first += block_size) {
    const int end = std::min(first + block_size, n_samples);
    for (int s = first; s < end; ++s) {
      RandomStream random(options.seed, static_cast<std::uint64_t>(s));
      std::vector<LatentPath>& paths = self->samples.emplace_back();
      for (std::size_t a = 0; a < conditioned.prior.latents.size(); ++a) {
        paths.push_back(draw_prior_path(conditioned, a, options.n_features, random));
      }
      alpha.col(s - first) = misfit(conditioned, paths, random);
    }
    lapack::solve_lower(conditioned.L, false, alpha);
    lapack::solve_lower(conditioned.L, true, alpha);
    for (int s = first; s < end; ++s) {
      for (std::size_t a = 0; a < conditioned.prior.latents.size(); ++a) {
        self->samples[static_cast<std::size_t>(s)][a].beta =
            latent_weights(conditioned.reduction, conditioned.Z[a], alpha.col(s - first));
      }
    }
  }
  return PathwiseSamples(std::move(self));
}

}  // namespace gp2
