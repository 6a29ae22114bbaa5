#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/prior.hpp"
#include "gp2/view.hpp"

// States as a log has them, or moved onto the constraints.
namespace gp2 {

/// The states, of the columns that a prior and a view need, and of those that only tell whether a state or a prediction is on the
/// constraint where the log has them.
/// @param needs_residuals  whether what the constraints' residuals read is needed too
Eigen::MatrixXd read_states(const Prior& prior, const View& view, LogReader& reader, bool needs_residuals);

/// Deviations of coordinates and velocities, of columns NAME_std; NaN where there are none. Empty where there is no such column.
Eigen::MatrixXd stated_state_deviations(const System& system, LogReader& reader);

/// The option `project`: the states of a log are moved onto the constraints, and notes say how far.
/// @param stddevs  stated_state_deviations
/// @throws InputError naming the lines of states that have none on the constraints near them.
void move_onto_constraints(const System& system, const Eigen::VectorXd& parameters, const CsvTable& log,
                           const Eigen::MatrixXd& stddevs, Eigen::MatrixXd& states, std::vector<std::string>& notes);

}  // namespace gp2
