#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2::internal {

/// "system 'NAME': TEXT at state 3 (q1 = 0.1, dq1 = 2)", with the entries of the state that are known.
/// @param first  number of the first of the states among all, from 0
std::string describe_fault(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                           const MechanicsBatch::Fault& fault, Eigen::Index first = 0);

/// ", and of what the equations read dq1 is nan": the entries of state i that are read and not finite; empty where there are none.
std::string unknown_entries(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states, int i,
                            const std::vector<bool>& reads);

}  // namespace gp2::internal
