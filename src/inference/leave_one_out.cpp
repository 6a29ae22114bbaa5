#include "gp2/inference/leave_one_out.hpp"

#include <cmath>

#include "base/lapack.hpp"
#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "inference/dense_gram.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior) {
  const lapack::SingleThread single_thread;
  const Prior& prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  const ModelValues& values = posterior.values();
  Reduction reduction;
  reduce(prior, observations, require_models(prior, observations, values.parameters, {}), values.noise_stddev, reduction);
  const LatentRows rows = latent_rows(prior, observations, reduction, values);
  DenseGram gram;
  if (!gram.factorise(rows)) throw NumericalError("leave_one_out: the covariance of the observations cannot be factored");
  const Gram::Inverse inverse = gram.invert(rows);

  std::vector<LeaveOneOut> out;
  for (const Observations& group : observations) {
    out.push_back({MatrixXd::Constant(group.values().rows(), group.values().cols(), not_a_number),
                   MatrixXd::Constant(group.values().rows(), group.values().cols(), not_a_number)});
  }
  for (std::size_t s = 0; s < reduction.samples.size(); ++s) {
    const Reduction::Sample& sample = reduction.samples[s];
    const Index rank = sample.R.rows();
    VectorXd alpha(rank);
    for (Index c = 0; c < rank; ++c)
      alpha[c] = inverse.alpha[reduction.offset[static_cast<std::size_t>(c)] + static_cast<Index>(s)];
    // the inverse of the covariance of all whitened values, and what it makes of theirs
    VectorXd alpha_e = sample.Q * alpha + sample.e_out;
    MatrixXd P_e = MatrixXd::Identity(sample.Q.rows(), sample.Q.rows()) +
                   sample.Q * (inverse.blocks[s] - MatrixXd::Identity(rank, rank)) * sample.Q.transpose();
    const auto g = static_cast<std::size_t>(sample.group);
    const VectorXd noise = observations[g].noise_at(values.noise_stddev[g], sample.index);
    if (sample.C.size() > 0) {  // from values whitened by C to those in units of σ
      const MatrixXd to_unit = sample.C.triangularView<Eigen::Lower>().solve(
          MatrixXd(noise.unaryExpr([](double one) { return std::isfinite(one) ? one : 1; }).asDiagonal()));
      alpha_e = to_unit.transpose() * alpha_e;
      P_e = to_unit.transpose() * P_e * to_unit;
    }
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
