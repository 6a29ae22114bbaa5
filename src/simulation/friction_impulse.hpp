#pragma once

#include <Eigen/Core>

#include "gp2/simulate.hpp"

namespace gp2 {

/// Δdq of an impact with friction, whose gaps open at rates that change evenly by r: a motion of the velocities alone, within a time so
/// short that no surface moves, under loads so large that no other force counts (theory.md, T49).
/// @param at           a state, as it is before the impact
/// @param r            of the rows of A (nc)
/// @param evaluations  rises by those of the acceleration
/// @throws NumericalError where that motion does not reach its end
Eigen::VectorXd friction_impulse(const System& system, const Eigen::VectorXd& parameters, SimulateOptions options,
                                 const Eigen::VectorXd& at, const Eigen::VectorXd& r, int& evaluations);

}  // namespace gp2
