#include "gp2/inference/pathwise.hpp"

#include <algorithm>
#include <span>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "inference/potential_cross.hpp"
#include "inference/query.hpp"
#include "inference/requirements.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/random_features.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// The functions of one latent in one sample: f(φ) = Wᵀψ(φ) + βᵀk(φ). Those of a potential are the gradient of one of these.
struct LatentPath {
  RandomFeatures features;
  MatrixXd weights;  // W (features × functions)
  MatrixXd beta;     // β (rows of the basis × functions)
};

LatentPath draw_prior_path(const Posterior::Implementation& posterior, std::size_t a, int n_features, RandomStream& random) {
  const Latent& latent = posterior.prior.latents[a];
  LatentPath path{RandomFeatures(latent.kernel, posterior.values.kernel[a], n_features, random), {}, {}};
  path.weights.resize(path.features.size(), latent.is_potential ? 1 : latent.n_functions());
  for (double& weight : path.weights.reshaped()) weight = random.normal();
  return path;
}

// a function of the prior at the points of a basis (functions × points)
MatrixXd evaluate_prior_path(const LatentPath& path, const LatentPosterior::Basis& basis) {
  const KernelColumns& kernel = basis.kernel;
  MatrixXd f(basis.n_functions, kernel.n_points());
  VectorXd psi(path.features.size());
  for (Index j = 0; j < kernel.n_points(); ++j) {
    const auto features = kernel.features().row(j).transpose();
    if (basis.is_potential) {
      f.col(j) = path.features.gradient(path.weights.col(0), features);
    } else {
      path.features.evaluate(features, psi);
      f.col(j) = path.weights.transpose() * psi;
    }
  }
  return f;
}

// the gradient of a potential at states (D × states)
MatrixXd evaluate_gradient(const LatentPath& path, const KernelColumns& kernel, const MatrixXd& features) {
  const GradientColumns columns(kernel);
  GradientColumns::Workspace w;
  VectorXd point;
  MatrixXd f(features.cols(), features.rows());
  for (Index i = 0; i < features.rows(); ++i) {
    f.col(i) = path.features.gradient(path.weights.col(0), features.row(i).transpose());
    kernel.scale(features.row(i).transpose(), point);
    columns.evaluate(0, kernel.n_rows(), point, w);
    columns.add_sums(path.beta, f.col(i), w);
  }
  return f;
}

}  // namespace

struct PathwiseSamples::Implementation {
  struct Sample {
    std::shared_ptr<const Posterior::Implementation> posterior;  // the component that it is of
    std::vector<LatentPath> paths;                               // per latent
  };
  std::vector<Sample> samples;

  /// @throws InputError when there is none.
  [[nodiscard]] const Sample& at(int sample) const {
    const int n = static_cast<int>(samples.size());
    if (sample < 0 || sample >= n) throw InputError(fmt::format("sample {}: there are {} samples, 0 is the first", sample, n));
    return samples[static_cast<std::size_t>(sample)];
  }
};

PathwiseSamples::PathwiseSamples(std::shared_ptr<const Implementation> implementation)
    : implementation_(std::move(implementation)) {}

const PathwiseSamples::Implementation& PathwiseSamples::implementation() const {
  return require_held(implementation_, "PathwiseSamples");
}

int PathwiseSamples::n_samples() const { return static_cast<int>(implementation().samples.size()); }

const VectorXd& PathwiseSamples::parameters(int sample) const { return implementation().at(sample).posterior->values.parameters; }

VectorXd PathwiseSamples::potential(int sample, int latent, const Ref<const MatrixXd>& states,
                                    const Ref<const VectorXd>& reference) const {
  const auto& [component, paths] = implementation().at(sample);
  require_potential(component->prior, latent);
  component->prior.system->require_states(states);
  component->prior.system->require_states(reference);
  const auto a = static_cast<std::size_t>(latent);
  const LatentPath& path = paths[a];
  const MatrixXd features = evaluate_features(component->prior, a, states);
  const VectorXd at_reference = evaluate_features(component->prior, a, reference).row(0).transpose();
  PotentialCross cross(component->latents->latents()[a], features, at_reference);
  VectorXd psi(path.features.size()), psi_reference(psi.size()), energy(states.cols());
  path.features.evaluate(at_reference, psi_reference);
  for (Index i = 0; i < energy.size(); ++i) {
    path.features.evaluate(features.row(i).transpose(), psi);
    energy[i] = path.weights.col(0).dot(psi - psi_reference) + cross.column(i).cwiseProduct(path.beta).sum();
  }
  energy *= component->values.signal_stddev[a][0];
  require_finite(*component->prior.system, states, energy.transpose());
  return energy;
}

MatrixXd PathwiseSamples::evaluate(int sample, const View& view, const Ref<const MatrixXd>& states) const {
  const auto& [component, paths] = implementation().at(sample);
  const Posterior::Implementation& posterior = *component;
  Query query = make_query(posterior, view, states);
  std::vector<MatrixXd> f(paths.size());
  KernelColumns::Workspace workspace;
  VectorXd psi, point, k, sums;
  for (std::size_t a = 0; a < paths.size(); ++a) {
    if (!query.needs(a)) continue;
    const LatentPath& path = paths[a];
    const KernelColumns& kernel = posterior.latents->latents()[a].kernel;
    if (posterior.prior.latents[a].is_potential) {
      f[a] = evaluate_gradient(path, kernel, query.features[a]);
      continue;
    }
    psi.resize(path.features.size());
    k.resize(kernel.n_rows());
    sums.resize(path.weights.cols());
    f[a].resize(path.weights.cols(), query.size());
    for (Index i = 0; i < query.size(); ++i) {
      path.features.evaluate(query.features[a].row(i).transpose(), psi);
      f[a].col(i).noalias() = path.weights.transpose() * psi;
      kernel.scale(query.features[a].row(i).transpose(), point);
      kernel.evaluate(0, k.size(), point, k.data(), workspace);
      simd::loops().weighted_sums(k.size(), sums.size(), k.data(), path.beta.data(), k.size(), sums.data());
      f[a].col(i) += sums;
    }
  }
  MatrixXd values(view.size(), query.size());
  query.linearise(posterior, f);
  query.view_of(posterior, f, values);
  require_finite(*prior_of(posterior.prior, view).system, states, values);
  return values;
}

PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options) {
  if (n_samples < 1) throw InputError(fmt::format("sample_paths: n_samples must be 1 or more, got {}", n_samples));
  if (options.n_features < 1)
    throw InputError(fmt::format("sample_paths: n_features must be 1 or more, got {}", options.n_features));
  const lapack::SingleThread single_thread;
  auto self = std::make_shared<PathwiseSamples::Implementation>();
  self->samples.resize(static_cast<std::size_t>(n_samples));
  const std::vector<std::vector<Index>> samples_of = samples_of_components(posterior.n_components(), n_samples, options.seed);
  for (std::size_t k = 0; k < samples_of.size(); ++k) {
    const auto& component = posterior.conditioned()[k];
    const LatentPosterior& latents = *component->latents;
    // solved in blocks that are always as wide, so that the bits of a sample do not depend on how many there are
    constexpr std::size_t block_size = 8;
    MatrixXd misfits = MatrixXd::Zero(latents.size(), block_size);
    for (std::size_t first = 0; first < samples_of[k].size(); first += block_size) {
      const std::span<const Index> block(samples_of[k].data() + first, std::min(block_size, samples_of[k].size() - first));
      for (std::size_t b = 0; b < block.size(); ++b) {
        RandomStream random(options.seed, static_cast<std::uint64_t>(block[b]));
        PathwiseSamples::Implementation::Sample& sample = self->samples[static_cast<std::size_t>(block[b])];
        sample.posterior = component;
        std::vector<MatrixXd> f;
        for (std::size_t a = 0; a < component->prior.latents.size(); ++a) {
          sample.paths.push_back(draw_prior_path(*component, a, options.n_features, random));
          f.push_back(evaluate_prior_path(sample.paths.back(), latents.latents()[a]));
        }
        misfits.col(static_cast<Index>(b)) = latents.misfit(f, random);
      }
      std::vector<std::vector<MatrixXd>> weights = latents.weights(misfits);
      for (std::size_t b = 0; b < block.size(); ++b) {
        std::vector<LatentPath>& paths = self->samples[static_cast<std::size_t>(block[b])].paths;
        for (std::size_t a = 0; a < paths.size(); ++a) paths[a].beta = std::move(weights[b][a]);
      }
    }
  }
  return PathwiseSamples(std::move(self));
}

}  // namespace gp2
