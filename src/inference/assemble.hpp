#pragma once

#include <atomic>

#include <Eigen/Core>

#include "base/simd.hpp"
#include "inference/latent_rows.hpp"

namespace gp2 {

/// Pairs of samples are worked off in square tiles of this size, so that the kernel between them is computed once and stays near.
inline constexpr Eigen::Index tile_size = 64;

/// Rows above the diagonal that a column of a tile on the diagonal may leave out, in whole vectors.
constexpr Eigen::Index whole_vectors_before(Eigen::Index j) { return j / simd::lanes<double> * simd::lanes<double>; }

/// K̃ in the lower triangle. What stands above the diagonal is left alone.
/// @param K     (rows.size() × rows.size())
/// @param stop  set: leaves the rest as it was
void assemble(const LatentRows& rows, int n_threads, Eigen::Ref<Eigen::MatrixXd> K, const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
