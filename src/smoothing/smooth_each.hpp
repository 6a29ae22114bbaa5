#pragma once

#include <functional>
#include <vector>

#include <Eigen/Core>

#include "gp2/smoothing/smoother.hpp"

namespace gp2 {

/// Takes mean and covariance of (q, dq, ddq) at the k-th time.
using WriteMotion = std::function<void(Eigen::Index k, const Eigen::Vector3d& mean, const Eigen::Matrix3d& covariance)>;

/// smooth() that keeps nothing: `write` is called for each time, from the last to the first.
/// @returns log_likelihood
double smooth_each(const SmootherModel& model, const std::vector<Measurement>& measurements,
                   const Eigen::Ref<const Eigen::VectorXd>& times, const WriteMotion& write);

/// @param caller  that they were given to
/// @throws InputError as log_likelihood.
void check_measurements(const SmootherModel& model, const std::vector<Measurement>& measurements, const char* caller);

}  // namespace gp2
