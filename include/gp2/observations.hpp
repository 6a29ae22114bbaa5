#pragma once

#include <Eigen/Core>

#include "gp2/view.hpp"

namespace gp2 {

/// N noisy measurements of one view: y_i = G(x_i) ā(x_i) + d(x_i) + ε_i,  ε_i ~ N(0, diag(σ_i²)),  σ_ki = σ_k s_ki.
struct Observations {
  Eigen::MatrixXd states;        // x_i  (layout size × N)
  View view;                     // what was measured, d rows
  Eigen::MatrixXd values;        // y_i  (d × N)
  Eigen::VectorXd noise_stddev;  // σ    (d), > 0; the starting value where it is estimated
  bool estimate_noise = false;
  Eigen::MatrixXd noise_scale = {};  // s  (d × N), > 0, where each value has a noise of its own; empty: s = 1

  [[nodiscard]] int n_data() const { return static_cast<int>(states.cols()); }
  [[nodiscard]] bool has_noise_scale() const { return noise_scale.size() > 0; }

  /// σ_i (d) at state i under a noise σ that may differ from noise_stddev, as an estimate does.
  [[nodiscard]] Eigen::VectorXd noise_at(const Eigen::Ref<const Eigen::VectorXd>& stddev, Eigen::Index i) const;
  /// That of a usual value (d): σ times the median of s over the states.
  [[nodiscard]] Eigen::VectorXd usual_noise(const Eigen::Ref<const Eigen::VectorXd>& stddev) const;
  /// @throws InputError when noise_scale is not empty and not as large as `values`, or not positive and finite.
  void require_noise_scale() const;
};

/// Standard deviation (divided by N) of each row.
Eigen::VectorXd row_stddev(const Eigen::Ref<const Eigen::MatrixXd>& values);

}  // namespace gp2
