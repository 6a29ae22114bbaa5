#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "gp2/error.hpp"
#include "gp2/posterior.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/potential_cross.hpp"
#include "inference/query.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

void require_potential(const Prior& prior, int latent) {
  const int n = static_cast<int>(prior.latents.size());
  if (latent < 0 || latent >= n) {
    throw InputError(fmt::format("potential: the prior has {} latents, numbered from 0, got the latent {}", n, latent));
  }
  const Latent& of = prior.latents[static_cast<std::size_t>(latent)];
  if (of.is_potential) return;
  throw InputError(fmt::format("potential: the latent '{}' is none; write directions = \"potential\" in the model", of.name));
}

MatrixXd covariance_of_gradients(const Kernel& kernel, const MatrixXd& features, const VectorXd& values) {
  const KernelColumns points(kernel, features, values);
  const GradientColumns columns(points);
  GradientColumns::Workspace w;
  const Index n = features.rows(), D = features.cols();
  MatrixXd covariance(n * D, n * D);
  VectorXd point;
  for (Index j = 0; j < n; ++j) {
    points.scale(j, point);
    columns.evaluate(0, n, point, w);
    for (Index d = 0; d < D; ++d) {
      columns.multiply(VectorXd::Unit(D, d), w);
      covariance.col(d * n + j) = w.out.reshaped();
    }
  }
  return covariance;
}

PotentialCross::PotentialCross(const LatentPosterior::Basis& basis, const MatrixXd& features, const VectorXd& reference)
    : basis_(basis), features_(features) {
  of_reference_ = at(reference);
}

MatrixXd PotentialCross::at(const VectorXd& features) {
  const GradientColumns columns(basis_.kernel);
  basis_.kernel.scale(features, point_);
  columns.evaluate(0, basis_.kernel.n_rows(), point_, workspace_);
  columns.of_function(workspace_);
  return workspace_.out;
}

MatrixXd PotentialCross::column(Index i) { return at(features_.row(i).transpose()) - of_reference_; }

namespace {

Posterior::Potential energy_of(const Posterior::Implementation& self, std::size_t a, const Ref<const MatrixXd>& states,
                               const Ref<const VectorXd>& reference) {
  const LatentPosterior& latents = *self.latents;
  const LatentPosterior::Basis& basis = latents.latents()[a];
  const MatrixXd features = evaluate_features(self.prior, a, states), at_reference = evaluate_features(self.prior, a, reference);
  const double signal = self.values.signal_stddev[a][0];
  const Index n = features.rows(), D = features.cols();
  PotentialCross cross_of(basis, features, at_reference.row(0).transpose());
  Posterior::Potential energy{VectorXd(n), VectorXd(n)};
  MatrixXd of_rows = MatrixXd::Zero(latents.n_rows(), n);
  for (Index i = 0; i < n; ++i) {
    const MatrixXd with_gradient = cross_of.column(i);
    energy.mean[i] = signal * with_gradient.cwiseProduct(basis.beta).sum();
    for (std::size_t c = 0; c < latents.row_of().size(); ++c) {
      const VectorXd products =
          signal * with_gradient.cwiseProduct(basis.Z.middleCols(static_cast<Index>(c) * D, D)).rowwise().sum();
      const std::vector<Index>& rows = latents.row_of()[c];
      for (std::size_t j = 0; j < rows.size(); ++j) {
        if (rows[j] >= 0) of_rows(rows[j], i) = products[static_cast<Index>(j)];
      }
    }
  }
  MatrixXd cross = latents.sums() == nullptr ? std::move(of_rows) : MatrixXd(latents.sums()->D * of_rows);
  latents.whiten(cross);
  const GradientColumns columns(basis.kernel);
  for (Index i = 0; i < n; ++i) {
    const double prior = signal * signal * columns.variance_of_difference(features.row(i) - at_reference.row(0));
    energy.stddev[i] = std::sqrt(std::max(0.0, prior - cross.col(i).squaredNorm()));
  }
  require_finite(*self.prior.system, states, energy.mean.transpose());
  require_finite(*self.prior.system, states, energy.stddev.transpose());
  return energy;
}

}  // namespace

Posterior::Potential Posterior::potential(int latent, const Ref<const MatrixXd>& states,
                                          const Ref<const VectorXd>& reference) const {
  require_potential(prior(), latent);
  prior().system->require_states(states);
  prior().system->require_states(reference);
  const lapack::SingleThread single_thread;
  // a mixture of equal weights: T31
  std::vector<Potential> energies;
  VectorXd mean = VectorXd::Zero(states.cols()), variance = mean;
  for (const auto& component : conditioned()) {
    energies.push_back(energy_of(*component, static_cast<std::size_t>(latent), states, reference));
    mean += energies.back().mean;
  }
  const double n = static_cast<double>(energies.size());
  mean /= n;
  for (const Potential& energy : energies) variance += energy.stddev.cwiseAbs2() + (energy.mean - mean).cwiseAbs2();
  return {mean, (variance / n).cwiseSqrt()};
}

}  // namespace gp2
