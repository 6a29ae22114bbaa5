#pragma once

#include <atomic>
#include <vector>

#include <Eigen/Core>

#include "inference/gram.hpp"

// What latents that are potentials add to sums over pairs of samples: K̃_ij = Z_i cov(∇V_i, ∇V_j) Z_jᵀ (theory.md, T44), where
// assemble and sweep_pairs have k_ij Z_i Z_jᵀ.
namespace gp2 {

/// Adds their part of K̃ to the lower triangle.
/// @param stop  set: leaves out the rest
void add_potentials(const LatentRows& rows, int n_threads, Eigen::Ref<Eigen::MatrixXd> K, const std::atomic<bool>* stop);

/// Their gradients, as of sweep_pairs, to those of the others.
/// @param P      (K̃ + I)⁻¹ in the lower triangle
/// @param parts  `alike` of none of them
void add_potential_gradients(const LatentRows& rows, const Eigen::Ref<const Eigen::MatrixXd>& P,
                             const std::vector<GramGradientParts>& parts, int n_threads, GramGradient& gradient,
                             const std::atomic<bool>* stop);

}  // namespace gp2
