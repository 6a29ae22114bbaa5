#include "inference/assemble.hpp"

#include <algorithm>

#include "base/parallel.hpp"
#include "inference/potential_pairs.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// One column of tiles of K̃, and its memory.
class TileColumn {
 public:
  TileColumn(const LatentRows& rows, Index J, Ref<MatrixXd>& K)
      : rows_(rows),
        reduction_(*rows.reduction),
        J_(J),
        nj_(std::min(tile_size, rows.n_samples() - J)),
        K_(K),
        k_(rows.latents.size(), MatrixXd(tile_size, tile_size)),
        k_transposed_(k_),
        out_(tile_size) {
    Index most = 0;
    for (const LatentRows::OfLatent& latent : rows.latents) most = std::max(most, latent.n_functions);
    z_.resize(most);
  }

  void write_tile(Index I) {
    const Index ni = std::min(tile_size, rows_.n_samples() - I);
    evaluate_kernels(I, ni);
    for (int right = 0; right < reduction_.n_components(); ++right) {
      for (int left = right; left < reduction_.n_components(); ++left) {
        write_below(left, right, I, ni);
        if (left != right) write_across(left, right, I, ni);
      }
    }
  }

 private:
  [[nodiscard]] Index count(int component) const { return reduction_.count[static_cast<std::size_t>(component)]; }
  [[nodiscard]] Index offset(int component) const { return reduction_.offset[static_cast<std::size_t>(component)]; }

  void evaluate_kernels(Index I, Index ni) {
    for (std::size_t a = 0; a < rows_.latents.size(); ++a) {
      if (rows_.latents[a].is_potential) continue;
      const KernelColumns& kernel = rows_.latents[a].kernel;
      for (Index j = 0; j < nj_; ++j) {
        const Index skip = I == J_ ? whole_vectors_before(j) : 0;
        kernel.scale(J_ + j, point_);
        kernel.evaluate(I + skip, simd::padded(ni) - skip, point_, k_[a].col(j).data() + skip, workspace_);
      }
      if (reduction_.n_components() > 1) k_transposed_[a].topLeftCorner(nj_, ni) = k_[a].topLeftCorner(ni, nj_).transpose();
    }
  }

  // column `other` of component `right` at rows [first, first + n) of component `left`: Σ_a k_a Σ_l Z_a Z_a
  void add_products(const std::vector<MatrixXd>& k, Index k_column, Index skip, int left, Index first, Index n, int right,
                    Index other) {
    std::fill_n(out_.data() + skip, n - skip, 0.0);
    for (std::size_t a = 0; a < rows_.latents.size(); ++a) {
      if (rows_.latents[a].is_potential) continue;
      const MatrixXd& Z = rows_.latents[a].Z;
      const Index m = rows_.latents[a].n_functions;
      for (Index l = 0; l < m; ++l) z_[l] = Z(other, right * m + l);
      simd::loops().add_scaled_products(n - skip, m, k[a].col(k_column).data() + skip, Z.col(left * m).data() + first + skip,
                                        Z.rows(), z_.data(), out_.data() + skip);
    }
  }

  // rows in I, columns in J
  void write_below(int left, int right, Index I, Index ni) {
    const bool diagonal = I == J_;
    const Index n_rows = std::min(ni, count(left) - I);
    const Index n_columns = std::min(nj_, count(right) - J_);
    for (Index j = 0; j < n_columns; ++j) {
      const Index first = diagonal ? j : 0;
      if (n_rows <= first) break;
      add_products(k_, j, diagonal ? whole_vectors_before(j) : 0, left, I, simd::padded(n_rows), right, J_ + j);
      K_.col(offset(right) + J_ + j).segment(offset(left) + I + first, n_rows - first) = out_.segment(first, n_rows - first);
    }
  }

  // rows in J, columns in I: on the diagonal what stands above that of its block
  void write_across(int left, int right, Index I, Index ni) {
    const bool diagonal = I == J_;
    const Index n_columns = std::min(ni, count(right) - I);
    for (Index i = 0; i < n_columns; ++i) {
      const Index n = std::min(diagonal ? i : nj_, count(left) - J_);
      if (n <= 0) continue;
      add_products(k_transposed_, i, 0, left, J_, simd::padded(n), right, I + i);
      K_.col(offset(right) + I + i).segment(offset(left) + J_, n) = out_.head(n);
    }
  }

  const LatentRows& rows_;
  const Reduction& reduction_;
  Index J_, nj_;
  Ref<MatrixXd>& K_;
  std::vector<MatrixXd> k_, k_transposed_;  // per latent
  VectorXd out_, z_, point_;
  KernelColumns::Workspace workspace_;
};

}  // namespace

void assemble(const LatentRows& rows, int n_threads, Ref<MatrixXd> K, const std::atomic<bool>* stop) {
  for_each_block(rows.n_samples(), tile_size, n_threads, [&](Index J, Index, int) {
    TileColumn tiles(rows, J, K);
    for (Index I = J; I < rows.n_samples() && !is_set(stop); I += tile_size) tiles.write_tile(I);
  });
  add_potentials(rows, n_threads, K, stop);
}

}  // namespace gp2
