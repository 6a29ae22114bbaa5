#include "gp2/inference/leave_one_out.hpp"

#include <cmath>
#include <limits>

#include "base/lapack.hpp"
#include "gp2/error.hpp"
#include "inference/reduction.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior) {
  const lapack::SingleThread single_thread;
  const Prior& prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  const ModelValues& values = posterior.values();
  std::vector<ObservationModel> models;
  model_observations(prior, observations, values.parameters, {}, models);
  Reduction reduction;
  reduce(prior, observations, models, values.noise_stddev, reduction);

  // P = (K̃ + I)⁻¹ and α̃ = P ỹ
  const std::vector<MatrixXd> features = sorted_features(prior, features_by_group(prior, observations), reduction);
  std::vector<KernelColumns> kernels;
  std::vector<MatrixXd> Z;
  for (std::size_t a = 0; a < features.size(); ++a) {
    kernels.emplace_back(prior.latents[a].kernel, features[a], values.kernel[a]);
    Z.push_back(by_component(reduction, reduction.directions[a] * values.loading(a)));
  }
  MatrixXd P(reduction.size(), reduction.size());
  assemble(reduction, kernels, Z, 1, P);
  if (!lapack::factorise(P)) throw NumericalError("leave_one_out: the covariance of the observations cannot be factored");
  VectorXd alpha = reduction.y;
  lapack::solve_lower(P, false, alpha);
  lapack::solve_lower(P, true, alpha);
  lapack::invert_factored(P);

  constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();
  std::vector<LeaveOneOut> out;
  for (const Observations& group : observations) {
    out.push_back({MatrixXd::Constant(group.values().rows(), group.values().cols(), not_a_number),
                   MatrixXd::Constant(group.values().rows(), group.values().cols(), not_a_number)});
  }
  for (std::size_t s = 0; s < reduction.samples.size(); ++s) {
    const Reduction::Sample& sample = reduction.samples[s];
    const Index rank = sample.R.rows();
    std::vector<Index> rows;
    for (std::size_t c = 0; c < static_cast<std::size_t>(rank); ++c) {
      rows.push_back(reduction.offset[c] + static_cast<Index>(s));
    }
    MatrixXd P_here(rank, rank);
    for (std::size_t c = 0; c < rows.size(); ++c) {
      for (std::size_t d = 0; d <= c; ++d) {
        P_here(static_cast<Index>(c), static_cast<Index>(d)) = P_here(static_cast<Index>(d), static_cast<Index>(c)) =
            P(rows[c], rows[d]);
      }
    }
    // the inverse of the covariance of all whitened values, and what it makes of theirs
    const VectorXd alpha_e = sample.Q * VectorXd(alpha(rows)) + sample.e_out;
    const MatrixXd P_e = MatrixXd::Identity(sample.Q.rows(), sample.Q.rows()) +
                         sample.Q * (P_here - MatrixXd::Identity(rank, rank)) * sample.Q.transpose();
    const auto g = static_cast<std::size_t>(sample.group);
    const VectorXd noise = observations[g].noise_at(values.noise_stddev[g], sample.index);
    for (Index k = 0; k < noise.size(); ++k) {
      if (!std::isfinite(noise[k])) continue;  // not measured
      const double p = P_e(k, k);
      out[g].mean(k, sample.index) = observations[g].values()(k, sample.index) - noise[k] * alpha_e[k] / p;
      out[g].variance(k, sample.index) = noise[k] * noise[k] * std::max(0.0, 1 / p - 1);
    }
  }
  return out;
}

}  // namespace gp2
