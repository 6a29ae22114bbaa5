#include "inference/pair_sweep.hpp"

#include <algorithm>
#include <utility>

#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "inference/assemble.hpp"
#include "inference/potential_pairs.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// Sums over pairs of samples i ≥ j, as in GramGradient: the first two by lanes, still to be added up. There is one for each part
// of the work; they are added in a fixed order.
struct PairSums {
  struct OfLatent {
    MatrixXd kernel, columns;  // (lanes × …)
    MatrixXd V, mean;
  };
  std::vector<OfLatent> latents;

  void add(const PairSums& other) {
    for (std::size_t a = 0; a < latents.size(); ++a) {
      latents[a].kernel += other.latents[a].kernel;
      latents[a].columns += other.latents[a].columns;
      latents[a].V += other.latents[a].V;
      latents[a].mean += other.latents[a].mean;
    }
  }
};

// The sweep over the tiles of P.
class PairSweep {
 public:
  PairSweep(const LatentRows& rows, const Ref<const MatrixXd>& P, const VectorXd& alpha,
            const std::vector<GramGradientParts>& parts)
      : rows_(rows), reduction_(*rows.reduction), P_(P), alpha_(by_component(reduction_, alpha)), parts_(parts) {
    for (const LatentRows::OfLatent& latent : rows.latents) {
      // β_i = Z_iᵀ α̃_i
      MatrixXd& beta = beta_.emplace_back(MatrixXd::Zero(latent.Z.rows(), latent.n_functions));
      for (Index c = 0; c < reduction_.n_components(); ++c) {
        beta += alpha_.col(c).asDiagonal() * latent.Z.middleCols(c * latent.n_functions, latent.n_functions);
      }
    }
  }

  PairSums run(int n_threads, const std::atomic<bool>* stop) const {
    const Index n_tiles = (n_samples() + tile_size - 1) / tile_size;
    const int n_tasks = static_cast<int>(std::clamp<Index>(n_tiles, 1, 32));
    std::vector<PairSums> sums(static_cast<std::size_t>(n_tasks), zero());
    parallel_for(n_tasks, n_threads, [&](int task, int) {
      Tile tile(*this);
      // columns of tiles get shorter: dealt out in turn, every task has about as much
      for (Index J = task; J < n_tiles; J += n_tasks) {
        for (Index I = J; I < n_tiles && !is_set(stop); ++I)
          tile.add(I * tile_size, J * tile_size, sums[static_cast<std::size_t>(task)]);
      }
    });
    for (std::size_t task = 1; task < sums.size(); ++task) sums[0].add(sums[task]);
    return std::move(sums[0]);
  }

 private:
  [[nodiscard]] Index n_samples() const { return rows_.n_samples(); }
  [[nodiscard]] const LatentRows::OfLatent& latent(std::size_t a) const { return rows_.latents[a]; }

  [[nodiscard]] PairSums zero() const {
    PairSums sums;
    const Index n_rows = simd::padded(n_samples());
    const Index n_components = reduction_.n_components();
    for (std::size_t a = 0; a < parts_.size(); ++a) {
      const GramGradientParts& parts = parts_[a];
      const Index n_functions = latent(a).n_functions;
      const auto zeros = [](bool is_wanted, Index rows, Index columns) -> MatrixXd {
        return is_wanted ? MatrixXd::Zero(rows, columns) : MatrixXd();
      };
      sums.latents.push_back({zeros(parts.kernel, simd::lanes<double>, latent(a).kernel.values().size()),
                              MatrixXd::Zero(simd::lanes<double>, parts.alike ? n_components * n_components : n_functions),
                              zeros(parts.V, n_rows, latent(a).Z.cols()), zeros(parts.mean, n_rows, n_functions)});
    }
    return sums;
  }

  // memory for the pairs (i in I, j in J) of one tile
  struct Tile {
    const PairSweep& sweep;
    MatrixXd S;                  // of one pair of components; pairs off the diagonal count twice
    MatrixXd Sk;                 // S ∘ k
    MatrixXd together;           // H where C is free and all samples alike, before its factor
    std::vector<MatrixXd> k, H;  // per latent; H_ij = ⟨S_ij, Z_i Z_jᵀ⟩
    VectorXd ones, z, projected, point;
    KernelColumns::Workspace workspace;

    explicit Tile(const PairSweep& of)
        : sweep(of),
          S(tile_size, tile_size),
          Sk(tile_size, tile_size),
          together(tile_size, tile_size),
          k(of.parts_.size()),
          H(of.parts_.size()),
          ones(VectorXd::Ones(tile_size)) {
      Index n = 1;
      for (std::size_t a = 0; a < k.size(); ++a) {
        k[a].resize(tile_size, tile_size);
        H[a].resize(tile_size, tile_size);
        n = std::max(n, of.latent(a).n_functions);
      }
      z.resize(n);
      projected.resize(n);
    }

    void add(Index I, Index J, PairSums& sums) {
      const bool diagonal = I == J;
      const Index ni = std::min(tile_size, sweep.n_samples() - I);
      const Index nj = std::min(tile_size, sweep.n_samples() - J);
      const Index n = simd::padded(ni);
      const auto skipped = [diagonal](Index j) { return diagonal ? whole_vectors_before(j) : 0; };

      for (std::size_t a = 0; a < k.size(); ++a) {
        if (sweep.latent(a).is_potential) continue;
        H[a].setZero();
        for (Index j = 0; j < nj; ++j) {
          sweep.latent(a).kernel.scale(J + j, point);
          sweep.latent(a).kernel.evaluate(I + skipped(j), n - skipped(j), point, k[a].col(j).data() + skipped(j), workspace);
          if (diagonal) k[a].col(j).head(j).setZero();
        }
        if (sweep.parts_[a].mean) add_mean(a, I, n, J, nj, diagonal, sums.latents[a].mean);
      }

      const int n_components = sweep.reduction_.n_components();
      for (int right = 0; right < n_components; ++right) {
        for (int left = 0; left < n_components; ++left) {
          const Index n_rows = std::min(ni, sweep.reduction_.count[static_cast<std::size_t>(left)] - I);
          const Index n_columns = std::min(nj, sweep.reduction_.count[static_cast<std::size_t>(right)] - J);
          if (n_rows <= 0 || n_columns <= 0) continue;
          load(left, I, n_rows, n, right, J, n_columns, diagonal);
          for (std::size_t a = 0; a < k.size(); ++a) {
            const GramGradientParts& parts = sweep.parts_[a];
            if (sweep.latent(a).is_potential) continue;
            if (parts.alike) {
              contract_alike(a, left, I, n, right, J, n_columns, diagonal,
                             sums.latents[a].columns.col(left * n_components + right));
            } else {
              contract(a, left, I, n, right, J, n_columns, diagonal, sums.latents[a]);
            }
          }
        }
      }

      for (std::size_t a = 0; a < k.size(); ++a) {
        if (!sweep.parts_[a].kernel || sweep.latent(a).is_potential) continue;
        for (Index j = 0; j < nj; ++j) {
          const Index skip = skipped(j);
          sweep.latent(a).kernel.scale(J + j, point);
          sweep.latent(a).kernel.add_gradient(I + skip, n - skip, point, k[a].col(j).data() + skip, H[a].col(j).data() + skip,
                                              sums.latents[a].kernel, workspace);
        }
      }
    }

    // S of a pair of components, from the lower triangle of P; where `left` comes before `right` its block is the transposed one
    void load(int left, Index I, Index n_rows, Index n, int right, Index J, Index n_columns, bool diagonal) {
      const Index row = sweep.reduction_.offset[static_cast<std::size_t>(left)] + I;
      const Index column = sweep.reduction_.offset[static_cast<std::size_t>(right)] + J;
      const auto alpha_I = sweep.alpha_.col(left).segment(I, n_rows);
      const auto alpha_J = sweep.alpha_.col(right).segment(J, n_columns);
      if (left >= right) {
        for (Index j = 0; j < n_columns; ++j) {
          S.col(j).head(n_rows) = 2 * (sweep.P_.col(column + j).segment(row, n_rows) - alpha_J[j] * alpha_I);
        }
      } else {
        for (Index i = 0; i < n_rows; ++i) {
          S.row(i).head(n_columns) = 2 * (sweep.P_.col(row + i).segment(column, n_columns) - alpha_I[i] * alpha_J).transpose();
        }
      }
      S.block(n_rows, 0, n - n_rows, n_columns).setZero();
      if (!diagonal) return;
      for (Index j = 0; j < n_columns; ++j) {
        S.col(j).head(std::min(j, n)).setZero();
        if (j < n_rows) S(j, j) *= 0.5;
      }
    }

    void contract(std::size_t a, int left, Index I, Index n, int right, Index J, Index n_columns, bool diagonal,
                  PairSums::OfLatent& sums) {
      const simd::Loops<double>& loops = simd::loops();
      const MatrixXd& Z = sweep.latent(a).Z;
      const Index m = sweep.latent(a).n_functions;
      const double* const Z_I = Z.col(left * m).data() + I;
      const bool wants_V = sweep.parts_[a].V;
      for (Index j = 0; j < n_columns; ++j) {
        const Index skip = diagonal && !wants_V ? whole_vectors_before(j) : 0;
        for (Index l = 0; l < m; ++l) z[l] = Z(J + j, right * m + l);
        Sk.col(j).segment(skip, n - skip) = S.col(j).segment(skip, n - skip);
        loops.contract(n - skip, m, Sk.col(j).data() + skip, k[a].col(j).data() + skip, Z_I + skip, Z.rows(), z.data(),
                       H[a].col(j).data() + skip, sums.columns.data());
        if (!wants_V) continue;
        loops.weighted_sums(n, m, Sk.col(j).data(), Z_I, Z.rows(), projected.data());
        for (Index l = 0; l < m; ++l) sums.V(J + j, right * m + l) += 0.5 * projected[l];
      }
      if (!wants_V) return;
      for (Index l = 0; l < m; ++l) {
        const VectorXd half = 0.5 * Z.col(right * m + l).segment(J, n_columns);
        loops.add_scaled_products(n, n_columns, ones.data(), Sk.data(), tile_size, half.data(),
                                  sums.V.col(left * m + l).data() + I);
      }
    }

    // Z_i is the same at every sample: a sum over pairs of samples is one number for each pair of components
    void contract_alike(std::size_t a, int left, Index I, Index n, int right, Index J, Index n_columns, bool diagonal,
                        Eigen::Ref<VectorXd> sums) {
      const MatrixXd& Z = sweep.latent(a).Z;
      const Index m = sweep.latent(a).n_functions;
      const double product = Z.row(I).segment(left * m, m).dot(Z.row(J).segment(right * m, m));
      const double one = 1;
      together.leftCols(n_columns).setZero();
      for (Index j = 0; j < n_columns; ++j) {
        const Index skip = diagonal ? whole_vectors_before(j) : 0;
        Sk.col(j).segment(skip, n - skip) = S.col(j).segment(skip, n - skip);
        simd::loops().contract(n - skip, 1, Sk.col(j).data() + skip, k[a].col(j).data() + skip, ones.data(), tile_size, &one,
                               together.col(j).data() + skip, sums.data());
        H[a].col(j).segment(skip, n - skip) += product * together.col(j).segment(skip, n - skip);
      }
    }

    void add_mean(std::size_t a, Index I, Index n, Index J, Index nj, bool diagonal, MatrixXd& mean) {
      const simd::Loops<double>& loops = simd::loops();
      const MatrixXd& beta = sweep.beta_[a];
      const Index m = sweep.latent(a).n_functions;
      for (Index l = 0; l < m; ++l) {
        loops.add_scaled_products(n, nj, ones.data(), k[a].data(), tile_size, beta.col(l).data() + J, mean.col(l).data() + I);
      }
      for (Index j = 0; j < nj; ++j) {
        loops.weighted_sums(n, m, k[a].col(j).data(), beta.data() + I, beta.rows(), projected.data());
        for (Index l = 0; l < m; ++l) {
          mean(J + j, l) += projected[l] - (diagonal ? k[a](j, j) * beta(J + j, l) : 0);
        }
      }
    }
  };

  const LatentRows& rows_;
  const Reduction& reduction_;
  const Ref<const MatrixXd>& P_;
  MatrixXd alpha_;  // by component
  const std::vector<GramGradientParts>& parts_;
  std::vector<MatrixXd> beta_;
};

}  // namespace

GramGradient sweep_pairs(const LatentRows& rows, const Ref<const MatrixXd>& P, const VectorXd& alpha,
                         const std::vector<GramGradientParts>& parts, int n_threads, const std::atomic<bool>* stop) {
  PairSums sums = PairSweep(rows, P, alpha, parts).run(n_threads, stop);
  GramGradient gradient{alpha, {}, {}};
  for (PairSums::OfLatent& of : sums.latents) {
    gradient.latents.push_back({0.5 * of.kernel.colwise().sum().transpose(), of.columns.colwise().sum().transpose(),
                                std::move(of.V), std::move(of.mean)});
  }
  add_potential_gradients(rows, P, parts, n_threads, gradient, stop);
  return gradient;
}

}  // namespace gp2
