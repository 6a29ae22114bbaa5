#pragma once

#include <vector>

#include <Eigen/Core>

#include "inference/observation_model.hpp"

namespace gp2 {

/// Observations whitened by their noise and split: W = S^{-1/2}G = Q R, e = S^{-1/2}(y − d − Gμ), ỹ = Qᵀe. A value that is not
/// measured has S = ∞: its rows of W and e are zero, and its log S is no part of the density. S is diagonal, or where constraints
/// are soft diag(σ²) + N Nᵀ = C Cᵀ, C lower triangular, which stands for S^{1/2}.
///
/// Samples are sorted by falling rank and numbers stored component by component: row (c, k) of every reduced vector belongs to
/// component c of sorted sample k and stands at offset[c] + k, for k < count[c]. So each pair of components is one dense block.
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
  std::vector<Sample> samples;              // sorted
  std::vector<Eigen::Index> count, offset;  // per component; offset has one more entry, the reduced size
  Eigen::VectorXd y;                        // ỹ
  std::vector<Eigen::MatrixXd> directions;  // per latent: rows R_i E_a(x_i), without C  (size × p_a)
  std::vector<bool> same_directions;        // per latent: C is free, and R_i E_a(x_i) is the same at every sample
  double constant = 0;                      // Σ of the samples' own

  [[nodiscard]] Eigen::Index size() const { return offset.back(); }
  [[nodiscard]] int n_components() const { return static_cast<int>(count.size()); }
  [[nodiscard]] Eigen::Index n_samples() const { return static_cast<Eigen::Index>(samples.size()); }
};

/// The reduced rows of these samples, sample after sample, each component by component.
std::vector<Eigen::Index> rows_of_samples(const Reduction& reduction, const std::vector<Eigen::Index>& samples);

/// @param reduction  receives the result; what it held is memory to be used again
void reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
            const std::vector<Eigen::VectorXd>& noise_stddev, Reduction& reduction);

}  // namespace gp2
