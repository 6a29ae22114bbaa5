#pragma once

#include <optional>
#include <vector>

#include "base/simd.hpp"
#include "gp2/inference/likelihood.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// What the parameters θ decide about one Observations: G, d of its view and μ, E of the prior, with their derivatives in the
/// parameters asked for.
struct ObservationModel {
  struct Values {
    ViewValues view;
    PriorValues prior;
  };
  Values values;
  std::vector<Values> derivatives;  // one per gradient parameter
  MechanicsBatch mechanics;         // that they come from
};

/// @param models  receives one per Observations; what it held is memory to be used again
/// @returns whether the mechanics hold at every state (no fault of evaluate_mechanics).
bool model_observations(const Prior& prior, const std::vector<Observations>& observations, const Eigen::VectorXd& parameters,
                        const std::vector<int>& gradient_parameters, std::vector<ObservationModel>& models);

/// Observations whitened by their noise and split: W = S^{-1/2}G = Q R, e = S^{-1/2}(y − d − Gμ), ỹ = Qᵀe. A value that is not
/// measured has S = ∞: its rows of W and e are zero, and its log S is no part of the density.
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
};

/// @param reduction  receives the result; what it held is memory to be used again
void reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
            const std::vector<Eigen::VectorXd>& noise_stddev, Reduction& reduction);

/// φ_a at the states of each Observations: [group][latent] (N × D_a).
std::vector<std::vector<Eigen::MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations);

/// φ_a of every sample, in the order of the reduction (N × D_a).
std::vector<Eigen::MatrixXd> sorted_features(const Prior& prior,
                                             const std::vector<std::vector<Eigen::MatrixXd>>& features_by_group,
                                             const Reduction& reduction);

/// Reduced rows laid out for the loops over samples: column c·(columns of `rows`) + l holds entry l of component c of each
/// sample, in the order of the reduction, zero where a sample has no such component, and padded to whole vectors (simd.hpp).
Eigen::MatrixXd by_component(const Reduction& reduction, const Eigen::MatrixXd& rows);

/// Pairs of samples are worked off in square tiles of this size, so that the kernel between them is computed once and stays near.
inline constexpr Eigen::Index tile_size = 64;

/// Rows above the diagonal that a column of a tile on the diagonal may leave out, in whole vectors.
constexpr Eigen::Index whole_vectors_before(Eigen::Index j) { return j / simd::lanes<double> * simd::lanes<double>; }

/// K̃ + I in the lower triangle. What stands above the diagonal is left alone.
///
/// @param kernels  per latent: its kernel between the samples
/// @param Z        per latent: rows R_i E_a(x_i) C_a, by component
/// @param K        (reduction.size() × reduction.size())
void assemble(const Reduction& reduction, const std::vector<KernelColumns>& kernels, const std::vector<Eigen::MatrixXd>& Z,
              int n_threads, Eigen::Ref<Eigen::MatrixXd> K);

}  // namespace gp2
