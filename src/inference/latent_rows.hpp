#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/inference/model_values.hpp"
#include "inference/reduction.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// Reduced observations as the latents see them, under one set of values: K̃_ij = Σ_a k_a(φ_i, φ_j) Z_i,a Z_j,aᵀ (theory.md, T11).
/// What a Gram solver is given.
struct LatentRows {
  struct OfLatent {
    KernelColumns kernel;          // k_a between the samples and a point
    Eigen::MatrixXd Z;             // R_i E_a(x_i) C_a, by component
    Eigen::Index n_functions = 0;  // columns of C_a
    bool is_potential = false;     // the functions are a gradient: see potential_pairs.hpp
  };
  const Reduction* reduction = nullptr;
  std::vector<OfLatent> latents;

  [[nodiscard]] Eigen::Index n_samples() const { return reduction->n_samples(); }
  [[nodiscard]] Eigen::Index size() const { return reduction->size(); }
};

/// @param reduction  of these observations; must outlive the result
LatentRows latent_rows(const Prior& prior, const std::vector<Observations>& observations, const Reduction& reduction,
                       const ModelValues& values);
/// @param features  sorted_features
LatentRows latent_rows(const Prior& prior, const std::vector<Eigen::MatrixXd>& features, const Reduction& reduction,
                       const ModelValues& values);

/// φ_a at the states of each Observations: [group][latent] (N × D_a).
std::vector<std::vector<Eigen::MatrixXd>> features_by_group(const Prior& prior, const std::vector<Observations>& observations);

/// φ_a of every sample, in the order of the reduction (N × D_a).
std::vector<Eigen::MatrixXd> sorted_features(const Prior& prior,
                                             const std::vector<std::vector<Eigen::MatrixXd>>& features_by_group,
                                             const Reduction& reduction);

/// Reduced rows laid out for the loops over samples: column c·(columns of `rows`) + l holds entry l of component c of each
/// sample, in the order of the reduction, zero where a sample has no such component, and padded to whole vectors (simd.hpp).
Eigen::MatrixXd by_component(const Reduction& reduction, const Eigen::MatrixXd& rows);
/// And back, of single numbers (samples × components).
Eigen::VectorXd in_rows(const Reduction& reduction, const Eigen::MatrixXd& by_component);

}  // namespace gp2
