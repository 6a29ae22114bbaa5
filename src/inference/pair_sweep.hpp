#pragma once

#include <atomic>
#include <vector>

#include <Eigen/Core>

#include "inference/gram.hpp"

namespace gp2 {

/// The gradient of the dense Gram: sums over all pairs of samples, tile by tile (theory.md, T14).
/// @param P      (K̃ + I)⁻¹ in the lower triangle
/// @param alpha  α̃
/// @param stop   set: leaves out the rest of the pairs
GramGradient sweep_pairs(const LatentRows& rows, const Eigen::Ref<const Eigen::MatrixXd>& P, const Eigen::VectorXd& alpha,
                         const std::vector<GramGradientParts>& parts, int n_threads, const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
