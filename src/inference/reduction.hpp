#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>
#include <Eigen/SparseCore>

#include "inference/observation_model.hpp"

namespace gp2 {

/// What is measured, where some of it is sums over samples: z̃ = L⁻¹(D ŷ + …), D ŷ the sums of the rows ŷ of single samples and L
/// the Cholesky factor of their noise. A row of one sample that is measured itself is a sum of one, and its noise is 1.
struct Sums {
  Eigen::SparseMatrix<double, Eigen::RowMajor> D;  // (sums × reduced rows)
  Eigen::SparseMatrix<double> L;                   // lower triangle (sums × sums)
  struct Of {
    int group = -1, row = 0;  // of its view; −1: of one sample
  };
  std::vector<Of> of;  // whose noise each sum has

  [[nodiscard]] Eigen::Index size() const { return D.rows(); }
  /// c ← L⁻¹c, and c ← L⁻ᵀc.
  void whiten(Eigen::Ref<Eigen::MatrixXd> c) const;
  void whiten_transposed(Eigen::Ref<Eigen::MatrixXd> c) const;
  /// The lower triangle of L⁻¹D K Dᵀ L⁻ᵀ from that of K.
  void of_rows(const Eigen::Ref<const Eigen::MatrixXd>& K, Eigen::Ref<Eigen::MatrixXd> of_sums) const;
  /// Dᵀ L⁻ᵀ P L⁻¹ D from the lower triangle of P.
  [[nodiscard]] Eigen::MatrixXd to_rows(const Eigen::Ref<const Eigen::MatrixXd>& P) const;
  /// Dᵀ L⁻ᵀ α
  [[nodiscard]] Eigen::VectorXd weights_of_rows(Eigen::VectorXd alpha) const;
  /// As many more rows that are measured themselves.
  void append_rows(Eigen::Index n);
};

/// Observations whitened by their noise and split: W = S^{-1/2}G = Q R, e = S^{-1/2}(y − d − Gμ), ỹ = Qᵀe. A value that is not
/// measured has S = ∞: its rows of W and e are zero, and its log S is no part of the density. S is diagonal, or where constraints
/// are soft diag(σ²) + N Nᵀ = C Cᵀ, C lower triangular, which stands for S^{1/2}.
///
/// Samples are sorted by falling rank and numbers stored component by component: row (c, k) of every reduced vector belongs to
/// component c of sorted sample k and stands at offset[c] + k, for k < count[c]. So each pair of components is one dense block.
///
/// Samples of which only sums are measured have S = 1 and Q = 1: R = G.
struct Reduction {
  struct Sample {
    int group, index;       // Observations it is of, column in it
    Eigen::MatrixXd Q, R;   // (d × r), (r × nq)
    Eigen::VectorXd e;      // (d)
    Eigen::VectorXd y;      // Qᵀe (r)
    Eigen::VectorXd e_out;  // (I − QQᵀ) e
    Eigen::MatrixXd C;      // (d × d), with ones on the diagonal where nothing is measured; empty where S is diagonal
    double constant = 0;    // ½ ‖(I − QQᵀ)e‖² + ½ log|S| + ½ dim y log 2π
  };
  std::vector<Sample> samples;              // sorted; may be given up where nothing but rows is wanted
  Eigen::Index n = 0;                       // samples
  std::vector<Eigen::Index> count, offset;  // per component; offset has one more entry, the reduced size
  Eigen::VectorXd y;                        // ỹ: of rows, or where there are sums of these
  std::optional<Sums> sums;                 // none: every row is measured itself
  std::vector<Eigen::MatrixXd> directions;  // per latent: rows R_i E_a(x_i), without C  (size × p_a)
  std::vector<bool> same_directions;        // per latent: C is free, and R_i E_a(x_i) is the same at every sample
  double constant = 0;                      // Σ of the samples' own; that of a group's sums is its first sample's

  [[nodiscard]] Eigen::Index size() const { return offset.back(); }  // rows
  [[nodiscard]] Eigen::Index n_measured() const { return y.size(); }
  [[nodiscard]] int n_components() const { return static_cast<int>(count.size()); }
  [[nodiscard]] Eigen::Index n_samples() const { return n; }
};

/// The reduced rows of these samples, sample after sample, each component by component.
std::vector<Eigen::Index> rows_of_samples(const Reduction& reduction, const std::vector<Eigen::Index>& samples);

/// @param reduction  receives the result; what it held is memory to be used again
void reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
            const std::vector<Eigen::VectorXd>& noise_stddev, Reduction& reduction);

}  // namespace gp2
