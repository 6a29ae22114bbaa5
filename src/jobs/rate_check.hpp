#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

namespace gp2 {

/// A column of a log and those of which one should be its rate over t; NaN: not measured.
struct RateColumns {
  const Eigen::RowVectorXd& t;
  const std::string& name;
  const Eigen::RowVectorXd& value;
  bool is_angle = false;  // whose values may be wrapped
  const std::vector<Eigen::RowVectorXd>& rates;
  const std::vector<std::string>& names;
  std::size_t own = 0;  // which of the rates is said to be the column's
};

/// What else the rate would have to be for the values to follow from it: a factor, a lag, another column. Empty where it is right,
/// where nothing explains the values better, or where rows are too far apart to tell.
/// @param columns  t increases
std::string better_rate(const RateColumns& columns);

}  // namespace gp2
