#include "inference/reduction.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// which parameter of the viewed system the one at home is, −1: none
int index_there(const View& view, int parameter) {
  if (!view.other_system) return parameter;
  const std::vector<int>& shared = view.other_system->shared;
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

bool model_observations(const Prior& prior, const std::vector<Observations>& observations, const VectorXd& parameters,
                        const std::vector<int>& gradient_parameters, std::vector<ObservationModel>& models) {
  models.resize(observations.size());
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    ObservationModel& model = models[g];
    const Prior& there = prior_of(prior, group.view());
    const VectorXd theta = parameters_of(group.view(), parameters);
    evaluate_mechanics(there, group.view(), group.states(), theta, model.mechanics);
    if (model.mechanics.fault) return false;
    model.values = {evaluate_view(group.view(), model.mechanics, group.states()),
                    evaluate_prior(there, group.states(), theta, model.mechanics)};
    model.derivatives.clear();
    for (int parameter : gradient_parameters) {
      const int index = index_there(group.view(), parameter);
      if (index < 0) {
        model.derivatives.push_back(zero_like(model.values));
        continue;
      }
      const SystemValues d = there.system->differentiate(group.states(), theta, index);
      model.derivatives.push_back(
          {differentiate_view(group.view(), model.mechanics, d),
           differentiate_prior(there, group.states(), theta, model.mechanics, model.values.prior, d, index)});
    }
    if (group.view().latent) {
      model.values.prior.keep_only(static_cast<std::size_t>(*group.view().latent));
      for (ObservationModel::Values& d : model.derivatives) d.prior.keep_only(static_cast<std::size_t>(*group.view().latent));
    }
  }
  return true;
}

void reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
            const std::vector<VectorXd>& noise_stddev, Reduction& reduction) {
  std::size_t n_samples = 0;
  for (const Observations& group : observations) n_samples += static_cast<std::size_t>(group.n_data());
  reduction.samples.resize(n_samples);
  reduction.constant = 0;
  MatrixXd W, factors;
  VectorXd reflection, noise;
  Eigen::VectorXi order;
  std::size_t k = 0;
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    VectorXd whitening = noise_stddev[g].cwiseInverse();
    double log_det_S_half = noise_stddev[g].array().log().sum();
    const Index d = group.view().size();
    Index n_measured = d;
    const bool is_mixed = group.noise().has_scale() || group.values().hasNaN();
    for (int i = 0; i < group.n_data(); ++i) {
      if (is_mixed) {
        noise = group.noise_at(noise_stddev[g], i);
        whitening = noise.cwiseInverse();
        n_measured = (whitening.array() > 0).count();
        if (n_measured < d) noise = (whitening.array() > 0).select(noise, 1);
        log_det_S_half = noise.array().log().sum();
      }
      // W P = Q R', so R = Qᵀ W
      Reduction::Sample& sample = reduction.samples[k++];
      sample.group = static_cast<int>(g);
      sample.index = i;
      const auto G = models[g].values.view.G(i);
      W.noalias() = whitening.asDiagonal() * G;
      factors = W;
      reflection.resize(std::min(W.rows(), W.cols()));
      order.resize(W.cols());
      const Index rank = internal::pivoted_qr(factors, reflection, order, UdwadiaKalaba::rank_tolerance);
      sample.Q.setIdentity(d, rank);
      internal::apply_Q(factors, reflection, rank, sample.Q);
      sample.R.noalias() = sample.Q.transpose().lazyProduct(W);
      sample.e = group.values().col(i) - models[g].values.view.offset.col(i);
      sample.e.noalias() -= G.lazyProduct(models[g].values.prior.mean.col(i));
      sample.e.array() *= whitening.array();
      if (n_measured < d) sample.e = (whitening.array() > 0).select(sample.e, 0);
      sample.y.noalias() = sample.Q.transpose().lazyProduct(sample.e);
      sample.e_out = sample.e;
      sample.e_out.noalias() -= sample.Q.lazyProduct(sample.y);
      sample.constant = 0.5 * sample.e_out.squaredNorm() + log_det_S_half +
                        0.5 * static_cast<double>(n_measured) * std::log(2 * std::numbers::pi);
      reduction.constant += sample.constant;
    }
  }

  // component c belongs to the samples of rank > c: a prefix once they are sorted
  const auto falls = [](const Reduction::Sample& a, const Reduction::Sample& b) { return a.R.rows() > b.R.rows(); };
  if (!std::is_sorted(reduction.samples.begin(), reduction.samples.end(), falls)) {
    std::stable_sort(reduction.samples.begin(), reduction.samples.end(), falls);
  }
  reduction.count.clear();
  reduction.offset.assign(1, 0);
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
  reduction.directions.resize(prior.latents.size());
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    reduction.directions[a].resize(reduction.size(), prior.latents[a].size());
  }
  MatrixXd RE;
  for (Index s = 0; s < static_cast<Index>(reduction.samples.size()); ++s) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    for (Index c = 0; c < sample.y.size(); ++c) reduction.y[reduction.offset[static_cast<std::size_t>(c)] + s] = sample.y[c];
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      RE.noalias() = sample.R.lazyProduct(models[static_cast<std::size_t>(sample.group)].values.prior.E(a, sample.index));
      for (Index c = 0; c < RE.rows(); ++c) {
        reduction.directions[a].row(reduction.offset[static_cast<std::size_t>(c)] + s) = RE.row(c);
      }
    }
  }
  reduction.same_directions.clear();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    bool alike = prior.latents[a].free_loading.has_value();
    for (std::size_t c = 0; alike && c < reduction.count.size(); ++c) {
      const auto block = reduction.directions[a].middleRows(reduction.offset[c], reduction.count[c]);
      alike = reduction.count[c] == reduction.count.front() && (block.rowwise() - block.row(0)).isZero(0);
    }
    reduction.same_directions.push_back(alike);
  }
}

std::vector<std::vector<MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations) {
  std::vector<std::vector<MatrixXd>> features;
  for (const Observations& group : observations) {
    std::vector<MatrixXd>& of_group = features.emplace_back();
    for (const Latent& latent : prior_of(prior, group.view()).latents) {
      of_group.push_back(evaluate_features(latent, group.states()));
    }
  }
  return features;
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

MatrixXd by_component(const Reduction& reduction, const MatrixXd& rows) {
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  MatrixXd padded = MatrixXd::Zero(simd::padded(n_samples), reduction.n_components() * rows.cols());
  for (int c = 0; c < reduction.n_components(); ++c) {
    const Index n = reduction.count[static_cast<std::size_t>(c)];
    padded.block(0, c * rows.cols(), n, rows.cols()) = rows.middleRows(reduction.offset[static_cast<std::size_t>(c)], n);
  }
  return padded;
}

void assemble(const Reduction& reduction, const std::vector<KernelColumns>& kernels, const std::vector<MatrixXd>& Z,
              int n_threads, Ref<MatrixXd> K) {
  const simd::Loops<double>& loops = simd::loops();
  const Index n_samples = static_cast<Index>(reduction.samples.size());
  const int n_components = reduction.n_components();
  const int n_tiles = static_cast<int>((n_samples + tile_size - 1) / tile_size);
  std::vector<Index> n_functions;
  for (const MatrixXd& rows : Z) n_functions.push_back(rows.cols() / std::max(n_components, 1));

  parallel_for(n_tiles, n_threads, [&](int column_of_tiles, int) {
    const Index J = column_of_tiles * tile_size;
    const Index nj = std::min(tile_size, n_samples - J);
    std::vector<MatrixXd> k(kernels.size(), MatrixXd(tile_size, tile_size)), k_transposed = k;
    VectorXd out(tile_size), z(n_functions.empty() ? 0 : *std::max_element(n_functions.begin(), n_functions.end())), point;
    KernelColumns::Workspace workspace;

    // column `other` of component `right` at rows [first, first + n) of component `left`: Σ_a k_a Σ_l Z_a Z_a
    const auto products = [&](const std::vector<MatrixXd>& k_of, Index k_column, Index skip, int left, Index first, Index n,
                              int right, Index other) {
      std::fill_n(out.data() + skip, n - skip, 0.0);
      for (std::size_t a = 0; a < Z.size(); ++a) {
        const Index m = n_functions[a];
        for (Index l = 0; l < m; ++l) z[l] = Z[a](other, right * m + l);
        loops.add_scaled_products(n - skip, m, k_of[a].col(k_column).data() + skip, Z[a].col(left * m).data() + first + skip,
                                  Z[a].rows(), z.data(), out.data() + skip);
      }
    };

    for (Index I = J; I < n_samples; I += tile_size) {
      const bool diagonal = I == J;
      const Index ni = std::min(tile_size, n_samples - I);
      for (std::size_t a = 0; a < kernels.size(); ++a) {
        for (Index j = 0; j < nj; ++j) {
          const Index skip = diagonal ? whole_vectors_before(j) : 0;
          kernels[a].scale(J + j, point);
          kernels[a].evaluate(I + skip, simd::padded(ni) - skip, point, k[a].col(j).data() + skip, workspace);
        }
        if (n_components > 1) k_transposed[a].topLeftCorner(nj, ni) = k[a].topLeftCorner(ni, nj).transpose();
      }
      for (int right = 0; right < n_components; ++right) {
        for (int left = right; left < n_components; ++left) {
          const Index row = reduction.offset[static_cast<std::size_t>(left)];
          const Index column = reduction.offset[static_cast<std::size_t>(right)];
          // rows in I, columns in J
          const Index n_rows = std::min(ni, reduction.count[static_cast<std::size_t>(left)] - I);
          const Index n_columns = std::min(nj, reduction.count[static_cast<std::size_t>(right)] - J);
          for (Index j = 0; j < n_columns; ++j) {
            const Index first = diagonal ? j : 0;
            if (n_rows <= first) break;
            products(k, j, diagonal ? whole_vectors_before(j) : 0, left, I, simd::padded(n_rows), right, J + j);
            K.col(column + J + j).segment(row + I + first, n_rows - first) = out.segment(first, n_rows - first);
          }
          if (left == right) continue;
          // rows in J, columns in I: on the diagonal what stands above that of its block
          const Index n_columns_I = std::min(ni, reduction.count[static_cast<std::size_t>(right)] - I);
          for (Index i = 0; i < n_columns_I; ++i) {
            const Index n = std::min(diagonal ? i : nj, reduction.count[static_cast<std::size_t>(left)] - J);
            if (n <= 0) continue;
            products(k_transposed, i, 0, left, J, simd::padded(n), right, I + i);
            K.col(column + I + i).segment(row + J, n) = out.head(n);
          }
        }
      }
    }
  });
  K.diagonal().array() += 1;
}

}  // namespace gp2
