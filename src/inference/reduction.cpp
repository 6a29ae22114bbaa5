#include "inference/reduction.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/QR>

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// which parameter of the viewed system the one at home is, −1: none
int index_there(const View& view, int parameter) {
  if (!view.setting) return parameter;
  const std::vector<int>& shared = view.setting->shared;
  const auto found = std::find(shared.begin(), shared.end(), parameter);
  return found == shared.end() ? -1 : static_cast<int>(found - shared.begin());
}

ObservationModel::Values zero_like(ObservationModel::Values values) {
  values.view.matrix.setZero();
  values.view.offset.setZero();
  values.prior.mean.setZero();
  for (MatrixXd& E : values.prior.directions) E.setZero();
  return values;
}

}  // namespace

std::optional<std::vector<ObservationModel>> model_observations(const Prior& prior, const std::vector<Observations>& observations,
                                                                const VectorXd& parameters,
                                                                const std::vector<int>& gradient_parameters) {
  std::vector<ObservationModel> models;
  for (const Observations& group : observations) {
    const Prior& there = prior_of(prior, group.view);
    const VectorXd theta = parameters_of(group.view, parameters);
    const MechanicsBatch mechanics = evaluate_mechanics(*there.system, group.states, theta);
    if (mechanics.fault) return std::nullopt;
    ObservationModel& model = models.emplace_back();
    model.values = {evaluate_view(group.view, mechanics, group.states), evaluate_prior(there, group.states, theta, mechanics)};
    for (int parameter : gradient_parameters) {
      const int index = index_there(group.view, parameter);
      if (index < 0) {
        model.derivatives.push_back(zero_like(model.values));
        continue;
      }
      const SystemValues d = there.system->differentiate(group.states, theta, index);
      model.derivatives.push_back({differentiate_view(group.view, mechanics, d),
                                   differentiate_prior(there, group.states, theta, mechanics, model.values.prior, d, index)});
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
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    bool alike = prior.latents[a].learned_rank.has_value();
    for (std::size_t c = 0; alike && c < reduction.count.size(); ++c) {
      const auto block = reduction.directions[a].middleRows(reduction.offset[c], reduction.count[c]);
      alike = reduction.count[c] == reduction.count.front() && (block.rowwise() - block.row(0)).isZero(0);
    }
    reduction.learned_alike.push_back(alike);
  }
  return reduction;
}

std::vector<std::vector<MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations) {
  std::vector<std::vector<MatrixXd>> features;
  for (const Observations& group : observations) {
    std::vector<MatrixXd>& of_group = features.emplace_back();
    for (const Latent& latent : prior_of(prior, group.view).latents) {
      of_group.push_back(evaluate_features(latent, group.states));
    }
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

std::vector<MatrixXd> sorted_features(const Prior& prior, const std::vector<std::vector<MatrixXd>>& features_by_group,
                                      const Reduction& reduction) {
  std::vector<MatrixXd> sorted;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    MatrixXd& features = sorted.emplace_back(static_cast<Index>(reduction.samples.size()), prior.latents[a].n_features());
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
          const auto k_column = k[a].col(j).segment(first, n);
          if (reduction.learned_alike[a]) {
            const double product = Z[a].row(row).dot(Z[a].row(column));
            if (a == 0) {
              out = product * k_column;
            } else {
              out += product * k_column;
            }
            continue;
          }
          const auto products = Z[a].middleRows(row, n).lazyProduct(Z[a].row(column).transpose());
          if (a == 0) {
            out = k_column.cwiseProduct(products);
          } else {
            out += k_column.cwiseProduct(products);
          }
        }
      }
      K(column, column) += 1;
    }
  }
}

}  // namespace gp2
