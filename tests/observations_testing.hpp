#pragma once

#include <utility>

#include "gp2/observations.hpp"

namespace gp2::test {

/// Observations with other states.
Observations with_states(const Observations& group, Eigen::MatrixXd states);

/// Observations with another σ.
Observations with_stddev(const Observations& group, Eigen::VectorXd stddev);

/// Observations with another scale s of each value; empty: s = 1.
Observations with_scale(const Observations& group, Eigen::MatrixXd scale);

/// Observations whose σ is estimated or not.
Observations with_estimated_noise(const Observations& group, bool is_estimated);

}  // namespace gp2::test
