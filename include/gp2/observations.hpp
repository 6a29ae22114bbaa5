#pragma once

#include <Eigen/Core>

#include "gp2/view.hpp"

namespace gp2 {

/// N noisy measurements of one view: y_i = G(x_i) ā(x_i) + d(x_i) + ε_i,  ε_i ~ N(0, diag(σ_i²)),  σ_ki = σ_k s_ki.
struct Observations {
  Eigen::MatrixXd states;        // x_i  (layout size × N)
  View view;                     // what was measured, d rows
  Eigen::MatrixXd values;        // y_i  (d × N); NaN: not measured
  Eigen::VectorXd noise_stddev;  // σ    (d), > 0; the starting value where it is estimated
  bool estimate_noise = false;
  /// s  (d × N), > 0, where each value has a noise of its own; empty: s = 1. Of no meaning where a value is not measured.
  Eigen::MatrixXd noise_scale = {};

  [[nodiscard]] int n_data() const { return static_cast<int>(states.cols()); }
  [[nodiscard]] bool has_noise_scale() const { return noise_scale.size() > 0; }

  /// σ_i (d) at state i under a noise σ that may differ from noise_stddev, as an estimate does; ∞ where nothing is measured.
  [[nodiscard]] Eigen::VectorXd noise_at(const Eigen::Ref<const Eigen::VectorXd>& stddev, Eigen::Index i) const;
  /// s of the values of row k that are measured.
  [[nodiscard]] Eigen::VectorXd measured_scales(Eigen::Index k) const;
  /// The noise of a usual value (d): σ times the median of s over the measured values of its row.
  [[nodiscard]] Eigen::VectorXd usual_noise(const Eigen::Ref<const Eigen::VectorXd>& stddev) const;
  /// @throws InputError when noise_scale is not empty and not as large as `values`, or not positive and finite where they are
  /// measured.
  void require_noise_scale() const;
};

/// Mean of each row, over the entries that are measured; NaN where none is.
Eigen::VectorXd row_mean(const Eigen::Ref<const Eigen::MatrixXd>& values);
/// Standard deviation (divided by their number) of each row, likewise.
Eigen::VectorXd row_stddev(const Eigen::Ref<const Eigen::MatrixXd>& values);

}  // namespace gp2
