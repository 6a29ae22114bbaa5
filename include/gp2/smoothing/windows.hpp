#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/observations.hpp"
#include "gp2/smoothing/smoother.hpp"

namespace gp2 GP2_API {

/// How an acceleration that a model predicts at smoothed states changes with these, one column for each measured coordinate, the
/// accelerated one first. Derivatives are times the standard deviation of that coordinate's positions, in units of that of the first.
struct StateSensitivity {
  Eigen::VectorXd times;        // of the states, rising (N) [s]
  Eigen::MatrixXd by_position;  // ∂ddq/∂q  (N × measured) [1/s²]
  Eigen::MatrixXd by_velocity;  // ∂ddq/∂dq  (N × measured) [1/s]
};

/// Windows of time that overlap: window j is the cubic B-spline of the knots start + (j … j + 4) spacing.
struct WindowGrid {
  double start = 0, spacing = 1;      // [s]
  StateSensitivity sensitivity = {};  // at the states of the sums, or more; empty: errors of the states change nothing

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
/// windows that overlap have in common. States that were smoothed from the same positions have errors too, by which the left side is
/// off. To first order these are linear in the noise of the positions, and count as noise of the sum together with that of the right
/// side (theory.md, T36); noise of other coordinates counts as if it were sampled at the same times.
/// @param positions  at rising times; others than positions are passed over
/// @param model      their noise: of each (noise_factor σ)² + (τ rate)²
/// @param windows    rising
/// @param times      of the states, rising, at least 4 (N)
/// @param row, first_state  as WeightedSum: `first_state` is the number of the first of these states
/// @throws NumericalError where sums follow from each other: the windows are too narrow for the samples.
/// @returns divided by spacing, so that they count as accelerations; without windows that have no samples inside, or none for longer
///   than a spacing, or no states for longer.
std::vector<WeightedSum> windowed_accelerations(const std::vector<Measurement>& positions, const SmootherModel& model,
                                                const WindowGrid& grid, const std::vector<int>& windows,
                                                const Eigen::VectorXd& times, int row, int first_state);

}  // namespace gp2
