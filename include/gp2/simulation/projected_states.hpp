#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// Measured states and the nearest ones that obey the constraints.
struct ProjectedStates {
  struct Failure {
    int state = 0;
    std::string text;
  };
  Eigen::MatrixXd states;         // (layout size × N); as they were where that failed
  Eigen::MatrixXd shift;          // |change| of q and dq (2 nq × N); 0 of what is not measured
  std::vector<Failure> failures;  // states from which Newton's method does not reach the constraints
};

/// Moves every state to the nearest one on the position constraints, then on the velocity constraints, each change in units of the
/// deviation of what was measured. Where that is not stated it is taken as proportional to the spread of the entry over the states.
/// @param states   (layout size × N); NaN: not measured, which stays
/// @param stddevs  of q and dq as measured (2 nq × N); NaN: not stated; empty: none is
/// @throws InputError naming the constraint, when the states lack what it reads.
ProjectedStates project_states(const System& system, const Eigen::Ref<const Eigen::VectorXd>& parameters,
                               const Eigen::Ref<const Eigen::MatrixXd>& states, const Eigen::MatrixXd& stddevs = {});

/// Median, mean and largest of numbers ≥ 0, and where.
struct SizeSummary {
  double median = 0, mean = 0, largest = 0;
  int at = 0;
};
SizeSummary summarise_sizes(const Eigen::Ref<const Eigen::VectorXd>& sizes);

/// How far measured states are off the constraints: each residual, in the constraint's unit, and what the nearest state on the
/// constraints changes in each coordinate and velocity. Nothing where they are on them to constraint_violation_tolerance, or lack
/// what the constraints read.
std::vector<Finding> check_states(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                  const Eigen::Ref<const Eigen::VectorXd>& parameters);

}  // namespace gp2
