#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Mean of each row, over the entries that are measured; NaN where none is.
Eigen::VectorXd row_mean(const Eigen::Ref<const Eigen::MatrixXd>& values);
/// Standard deviation (divided by their number) of each row, likewise.
Eigen::VectorXd row_stddev(const Eigen::Ref<const Eigen::MatrixXd>& values);
/// The largest |entry| of each row, likewise; 0 where none is.
Eigen::VectorXd row_size(const Eigen::Ref<const Eigen::MatrixXd>& values);
/// Standard deviation of each row; 0 where it does not vary but for the rounding of its size.
Eigen::VectorXd row_spread(const Eigen::Ref<const Eigen::MatrixXd>& values);
/// The entries of row k that are measured, in their order: those that are not NaN.
std::vector<double> measured_entries(const Eigen::Ref<const Eigen::MatrixXd>& values, Eigen::Index k);
/// The median of |x| under a normal distribution of mean 0 and standard deviation 1.
inline constexpr double median_of_normal = 0.6744897501960817;

/// The median of at least one value; of an even number the larger one of the two in the middle.
double median(std::vector<double> values);

/// Median of the differences of successive times that are positive; 0 where none is.
double usual_step(const Eigen::Ref<const Eigen::VectorXd>& times);

}  // namespace gp2
