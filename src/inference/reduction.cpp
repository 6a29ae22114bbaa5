#include "inference/reduction.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/QR>

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::optional<std::vector<ObservationModel>> model_observations(const Prior& prior, const std::vector<Observations>& observations,
                                                                const VectorXd& parameters,
                                                                const std::vector<int>& gradient_parameters) {
  std::vector<ObservationModel> models;
  for (const Observations& group : observations) {
    const MechanicsBatch mechanics = evaluate_mechanics(*prior.system, group.states, parameters);
    if (mechanics.fault) return std::nullopt;
    ObservationModel& model = models.emplace_back();
    model.values = {evaluate_view(group.view, mechanics, group.states),
                    evaluate_prior(prior, group.states, parameters, mechanics)};
    for (int parameter : gradient_parameters) {
      const SystemValues d = prior.system->differentiate(group.states, parameters, parameter);
      model.derivatives.push_back(
          {differentiate_view(group.view, mechanics, d),
           differentiate_prior(prior, group.states, parameters, mechanics, model.values.prior, d, parameter)});
    }
    if (group.view.latent >= 0) {
      model.values.prior.keep_only(static_cast<std::size_t>(group.view.latent));
      for (ObservationModel::Values& d : model.derivatives) d.prior.keep_only(static_cast<std::size_t>(group.view.latent));
    }
  }
  return models;
}

Reduction reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
                 const std::vector<VectorXd>& noise_stddev) {
  Reduction reduction;
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    const VectorXd whitening = noise_stddev[g].cwiseInverse();
    const double log_det_S_half = noise_stddev[g].array().log().sum();
    for (int i = 0; i < group.n_data(); ++i) {
      // W P = Q R', so R = Qᵀ W
      const MatrixXd G = models[g].values.view.G(i);
      const MatrixXd W = whitening.asDiagonal() * G;
      Eigen::ColPivHouseholderQR<MatrixXd> qr;
      qr.setThreshold(UdwadiaKalaba::rank_tolerance);
      qr.compute(W);
      const Index rank = qr.rank();
      Reduction::Sample sample{static_cast<int>(g), i, {}, {}, {}, {}};
      sample.Q = qr.householderQ() * MatrixXd::Identity(group.view.size(), rank);
      sample.R = sample.Q.transpose() * W;
      sample.e = whitening.cwiseProduct(group.values.col(i) - models[g].values.view.offset.col(i) -
                                        G * models[g].values.prior.mean.col(i));
      sample.e_out = sample.e - sample.Q * (sample.Q.transpose() * sample.e);
      reduction.constant += 0.5 * sample.e_out.squaredNorm() + log_det_S_half +
                            0.5 * static_cast<double>(group.view.size()) * std::log(2 * std::numbers::pi);
      reduction.samples.push_back(std::move(sample));
    }
  }

  // component c belongs to the samples of rank > c: a prefix once they are sorted
  std::stable_sort(reduction.samples.begin(), reduction.samples.end(),
                   [](const Reduction::Sample& a, const Reduction::Sample& b) { return a.R.rows() > b.R.rows(); });
  reduction.offset.push_back(0);
  for (Index c = 0; !reduction.samples.empty() && c < reduction.samples.front().R.rows(); ++c) {
    Index count = 0;
    while (count < static_cast<Index>(reduction.samples.size()) &&
           reduction.samples[static_cast<std::size_t>(count)].R.rows() > c) {
      ++count;
    }
    reduction.count.push_back(count);
    reduction.offset.push_back(reduction.offset.back() + count);
  }

  reduction.y.resize(reduction.size());
  for (const Latent& latent : prior.latents) reduction.directions.emplace_back(reduction.size(), latent.size());
  for (Index k = 0; k < static_cast<Index>(reduction.samples.size()); ++k) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(k)];
    const VectorXd y = sample.Q.transpose() * sample.e;
    for (Index c = 0; c < y.size(); ++c) reduction.y[reduction.offset[static_cast<std::size_t>(c)] + k] = y[c];
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      const MatrixXd RE = sample.R * models[static_cast<std::size_t>(sample.group)].values.prior.E(a, sample.index);
      for (Index c = 0; c < y.size(); ++c) {
        reduction.directions[a].row(reduction.offset[static_cast<std::size_t>(c)] + k) = RE.row(c);
      }
    }
  }
  return reduction;
}

std::vector<std::vector<MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations) {
  std::vector<std::vector<MatrixXd>> features;
  for (const Observations& group : observations) {
    std::vector<MatrixXd>& of_group = features.emplace_back();
    for (const Latent& latent : prior.latents) of_group.push_back(evaluate_features(latent, group.states));
  }
  return features;
}

MatrixXd latent_weights(const Reduction& reduction, const MatrixXd& Z, const VectorXd& alpha) {
  MatrixXd beta = MatrixXd::Zero(static_cast<Index>(reduction.samples.size()), Z.cols());
  for (int c = 0; c < reduction.n_components(); ++c) {
    const Index n = reduction.count[static_cast<std::size_t>(c)];
    const Index offset = reduction.offset[static_cast<std::size_t>(c)];
    beta.topRows(n) += alpha.segment(offset, n).asDiagonal() * Z.middleRows(offset, n);
  }
  return beta;
}

std::vector<MatrixXd> sorted_features(const std::vector<std::vector<MatrixXd>>& features_by_group, const Reduction& reduction) {
  std::vector<MatrixXd> sorted;
  const std::size_t n_latents = features_by_group.empty() ? 0 : features_by_group.front().size();
  for (std::size_t a = 0; a < n_latents; ++a) {
    MatrixXd& features = sorted.emplace_back(static_cast<Index>(reduction.samples.size()), features_by_group.front()[a].cols());
    for (Index k = 0; k < features.rows(); ++k) {
      const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(k)];
      features.row(k) = features_by_group[static_cast<std::size_t>(sample.group)][a].row(sample.index);
    }
  }
  return sorted;
}

void assemble(const Prior& prior, const Reduction& reduction, const std::vector<MatrixXd>& features,
              const std::vector<MatrixXd>& Z, const std::vector<VectorXd>& kernel, MatrixXd& K, std::vector<MatrixXd>& k) {
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  const Index size = reduction.size();
  if (K.rows() != size || K.cols() != size) K.resize(size, size);
  k.resize(prior.latents.size());
  Kernel::Workspace workspace;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (k[a].rows() != n_samples) k[a].resize(n_samples, n_samples);
    for (Index j = 0; j < n_samples; ++j) {
      prior.latents[a].kernel.evaluate(features[a].bottomRows(n_samples - j), features[a].row(j).transpose(), kernel[a],
                                       k[a].col(j).tail(n_samples - j), workspace);
    }
    k[a].triangularView<Eigen::StrictlyUpper>() = k[a].transpose();
  }

  // K̃[(c,i),(c',j)] = Σ_a k_a,ij Σ_l Z_a[(c,i),l] Z_a[(c',j),l], by columns of the lower triangle
  for (int cj = 0; cj < reduction.n_components(); ++cj) {
    for (Index j = 0; j < reduction.count[static_cast<std::size_t>(cj)]; ++j) {
      const Index column = reduction.offset[static_cast<std::size_t>(cj)] + j;
      for (int ci = cj; ci < reduction.n_components(); ++ci) {
        const Index first = ci == cj ? j : 0;
        const Index n = reduction.count[static_cast<std::size_t>(ci)] - first;
        if (n <= 0) continue;
        const Index row = reduction.offset[static_cast<std::size_t>(ci)] + first;
        auto out = K.col(column).segment(row, n);
        for (std::size_t a = 0; a < prior.latents.size(); ++a) {
          const auto products = Z[a].middleRows(row, n).lazyProduct(Z[a].row(column).transpose());
          if (a == 0) {
            out = k[a].col(j).segment(first, n).cwiseProduct(products);
          } else {
            out += k[a].col(j).segment(first, n).cwiseProduct(products);
          }
        }
      }
      K(column, column) += 1;
    }
  }
}

}  // namespace gp2
