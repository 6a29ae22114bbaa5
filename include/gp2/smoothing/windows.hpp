#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/observations.hpp"
#include "gp2/smoothing/smoother.hpp"

namespace gp2 GP2_API {

/// Windows of time that overlap: window j is the cubic B-spline of the knots start + (j … j + 4) spacing.
struct WindowGrid {
  double start = 0, spacing = 1;  // [s]

  [[nodiscard]] double begin(int window) const { return start + window * spacing; }
  [[nodiscard]] double end(int window) const { return start + (window + 4) * spacing; }
  /// The B-spline, at most 2/3.
  [[nodiscard]] double weight(int window, double time) const;
};

/// Accelerations averaged over windows of time, as positions alone measure them (theory.md, T36): with b the spline of a window,
/// h_i = t_{i+1} − t_i and Λ the straight lines between the b(t_i) of the samples between the first and the last,
///
///     ∫ Λ(t) ddq(t) dt = Σ_i b(t_i) ((q_{i+1} − q_i)/h_i − (q_i − q_{i−1})/h_{i−1}),
///
/// exactly. The left side becomes a sum over states by cubic interpolation between these, the right side is measured, with noise that
/// windows that overlap have in common.
/// @param positions  at rising times; others than positions are passed over
/// @param model      their noise: of each (noise_factor σ)² + (τ rate)²
/// @param windows    rising
/// @param times      of the states, rising, at least 4 (N)
/// @param row, first_state  as WeightedSum: `first_state` is the number of the first of these states
/// @returns divided by spacing, so that they count as accelerations; without windows that have no samples inside, or none for longer
///   than a spacing.
std::vector<WeightedSum> windowed_accelerations(const std::vector<Measurement>& positions, const SmootherModel& model,
                                                const WindowGrid& grid, const std::vector<int>& windows,
                                                const Eigen::VectorXd& times, int row, int first_state);

}  // namespace gp2
