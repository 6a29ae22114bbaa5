#include "inference/latent_sums.hpp"

#include <algorithm>

#include "base/simd.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;

namespace {
constexpr Index chunk = 256;  // points of the basis whose features stay in the L1 cache
}  // namespace

void LatentSums::evaluate(const std::vector<MatrixXd>& features, std::optional<LatentRange> latent,
                          const std::vector<MatrixXd>* loadings, MatrixXd* cross) {
  const std::size_t n_latents = posterior_.latents().size();
  const Index n_states = features.front().rows();
  const Index d = cross == nullptr || n_states == 0 ? 0 : cross->cols() / n_states;
  latent_ = latent;
  points_.resize(n_latents);
  for (std::size_t a = 0; a < n_latents; ++a) {
    const LatentPosterior::Basis& basis = posterior_.latents()[a];
    points_[a].resize(static_cast<std::size_t>(n_states));
    for (Index i = 0; i < n_states; ++i) basis.kernel.scale(features[a].row(i).transpose(), point(a, i));
    mean_[a].setZero(basis.n_functions, n_states);
  }
  MatrixXd of_rows;
  MatrixXd* const to = cross == nullptr || posterior_.sums() == nullptr ? cross : &of_rows;
  if (to == &of_rows) of_rows.resize(posterior_.n_rows(), cross->cols());
  const Index n_rows = posterior_.latents().front().kernel.n_rows();
  for (Index first = 0; first < n_rows; first += chunk) {
    const Index n = std::min(chunk, n_rows - first);
    for (Index i = 0; i < n_states; ++i) {
      for (std::size_t a = 0; a < n_latents; ++a) {
        if (needs(a)) add_chunk(a, first, n, i);
      }
      if (to != nullptr) write_cross(first, n, i, *loadings, to->middleCols(i * d, d));
    }
  }
  if (to == &of_rows) *cross = posterior_.sums()->D * of_rows;
}

// the kernel between points of a chunk and state i, and its part of the mean
void LatentSums::add_chunk(std::size_t a, Index first, Index n, Index i) {
  const LatentPosterior::Basis& basis = posterior_.latents()[a];
  k_.resize(chunk, static_cast<Index>(posterior_.latents().size()));
  sums_.resize(basis.n_functions);
  if (basis.is_potential) {
    gradients_.resize(posterior_.latents().size());
    const GradientColumns gradient(basis.kernel);
    gradient.evaluate(first, n, point(a, i), gradients_[a]);
    gradient.add_sums(basis.beta.middleRows(first, n), mean_[a].col(i), gradients_[a]);
    return;
  }
  double* const k = k_.col(static_cast<Index>(a)).data();
  basis.kernel.evaluate(first, n, point(a, i), k, kernel_);
  simd::loops().weighted_sums(n, basis.n_functions, k, basis.beta.data() + first, basis.beta.rows(), sums_.data());
  for (Index l = 0; l < basis.n_functions; ++l) mean_[a](l, i) += sums_[l];
}

// Σ_a k_a Z_a ℓ_a of a chunk, to the rows of its points (rows × d)
void LatentSums::write_cross(Index first, Index n, Index i, const std::vector<MatrixXd>& loadings, Ref<MatrixXd> cross) {
  for (std::size_t c = 0; c < posterior_.row_of().size(); ++c) {
    const std::vector<Index>& row_of = posterior_.row_of()[c];
    const Index* const rows = row_of.data() + first;
    const Index n_points = std::min(n, static_cast<Index>(row_of.size()) - first);
    for (Index e = 0; e < cross.cols(); ++e) {
      products_.setZero(chunk);
      for (std::size_t a = 0; a < posterior_.latents().size(); ++a) {
        if (!needs(a)) continue;
        const LatentPosterior::Basis& basis = posterior_.latents()[a];
        const Index n_functions = basis.n_functions;
        if (basis.is_potential) {
          GradientColumns(basis.kernel).multiply(loadings[a].col(i).segment(e * n_functions, n_functions), gradients_[a]);
          for (Index l = 0; l < n_functions; ++l) {
            products_.head(n).array() +=
                basis.Z.col(static_cast<Index>(c) * n_functions + l).segment(first, n).array() * gradients_[a].out.col(l);
          }
          continue;
        }
        simd::loops().add_scaled_products(n, n_functions, k_.col(static_cast<Index>(a)).data(),
                                          basis.Z.col(static_cast<Index>(c) * n_functions).data() + first, basis.Z.rows(),
                                          loadings[a].col(i).data() + e * n_functions, products_.data());
      }
      double* const column = cross.col(e).data();
      for (Index j = 0; j < n_points; ++j) {
        if (rows[j] >= 0) column[rows[j]] = products_[j];
      }
    }
  }
}

}  // namespace gp2
