#include "inference/latent_rows.hpp"

#include "base/simd.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;

LatentRows latent_rows(const Prior& prior, const std::vector<Observations>& observations, const Reduction& reduction,
                       const ModelValues& values) {
  return latent_rows(prior, sorted_features(prior, features_by_group(prior, observations), reduction), reduction, values);
}

LatentRows latent_rows(const Prior& prior, const std::vector<MatrixXd>& features, const Reduction& reduction,
                       const ModelValues& values) {
  LatentRows rows{&reduction, {}};
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const MatrixXd C = values.loading(a);
    rows.latents.push_back({KernelColumns(prior.latents[a].kernel, features[a], values.kernel[a]),
                            by_component(reduction, reduction.directions[a] * C), C.cols(), prior.latents[a].is_potential});
  }
  return rows;
}

std::vector<std::vector<MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations) {
  std::vector<std::vector<MatrixXd>> features;
  for (const Observations& group : observations) {
    std::vector<MatrixXd>& of_group = features.emplace_back();
    const Prior& there = prior_of(prior, group.view());
    for (std::size_t a = 0; a < there.latents.size(); ++a) of_group.push_back(evaluate_features(there, a, group.states()));
  }
  return features;
}

std::vector<MatrixXd> sorted_features(const Prior& prior, const std::vector<std::vector<MatrixXd>>& features_by_group,
                                      const Reduction& reduction) {
  std::vector<MatrixXd> sorted;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    MatrixXd& features = sorted.emplace_back(reduction.n_samples(), prior.latents[a].n_features());
    for (Index k = 0; k < features.rows(); ++k) {
      const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(k)];
      features.row(k) = features_by_group[static_cast<std::size_t>(sample.group)][a].row(sample.index);
    }
  }
  return sorted;
}

MatrixXd by_component(const Reduction& reduction, const MatrixXd& rows) {
  MatrixXd padded = MatrixXd::Zero(simd::padded(reduction.n_samples()), reduction.n_components() * rows.cols());
  for (int c = 0; c < reduction.n_components(); ++c) {
    const Index n = reduction.count[static_cast<std::size_t>(c)];
    padded.block(0, c * rows.cols(), n, rows.cols()) = rows.middleRows(reduction.offset[static_cast<std::size_t>(c)], n);
  }
  return padded;
}

Eigen::VectorXd in_rows(const Reduction& reduction, const MatrixXd& by_component) {
  Eigen::VectorXd rows(reduction.size());
  for (std::size_t c = 0; c < reduction.count.size(); ++c) {
    rows.segment(reduction.offset[c], reduction.count[c]) = by_component.col(static_cast<Index>(c)).head(reduction.count[c]);
  }
  return rows;
}

}  // namespace gp2
