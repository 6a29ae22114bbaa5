#pragma once

#include "simulation/contacts.hpp"

namespace gp2 {

/// A motion as simulate() describes it, its arguments right and its start projected, without what the trajectory says of the start and of
/// drift.
/// @param jump  what impacts with friction make of the velocities; none: they have no friction
/// @throws as simulate
Trajectory integrate_motion(const System& system, const Eigen::VectorXd& parameters, const Acceleration& acceleration,
                            const Eigen::VectorXd& start, const SimulateOptions& options, Contacts::Jump jump);

/// A motion of the velocities alone, at the coordinates, time and inputs of its start, without contacts and projection.
Trajectory integrate_velocities(const System& system, const Eigen::VectorXd& parameters, const Acceleration& acceleration,
                                const Eigen::VectorXd& start, const SimulateOptions& options);

}  // namespace gp2
