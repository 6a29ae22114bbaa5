#pragma once

#include <string>

#include <Eigen/Core>

#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2::internal {

/// "system 'NAME': TEXT at state 3 (q1 = 0.1, dq1 = 2)", with the entries of the state that are known.
std::string describe_fault(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                           const MechanicsBatch::Fault& fault);

}  // namespace gp2::internal
