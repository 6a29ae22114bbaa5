#pragma once

#include <Eigen/Core>

#include "gp2/view.hpp"

namespace gp2 {

/// N noisy measurements of one view: y_i = G(x_i) ā(x_i) + d(x_i) + ε_i,  ε_i ~ N(0, diag(σ²)).
struct Observations {
  Eigen::MatrixXd states;        // x_i  (layout size × N)
  View view;                     // what was measured, d rows
  Eigen::MatrixXd values;        // y_i  (d × N)
  Eigen::VectorXd noise_stddev;  // σ    (d), > 0; the starting value where it is estimated
  bool estimate_noise = false;

  [[nodiscard]] int n_data() const { return static_cast<int>(states.cols()); }
};

/// Standard deviation (divided by N) of each row.
Eigen::VectorXd row_stddev(const Eigen::Ref<const Eigen::MatrixXd>& values);

}  // namespace gp2
