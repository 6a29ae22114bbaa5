#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/jobs/derive.hpp"
#include "jobs/episode_rows.hpp"

namespace gp2 {

/// What constraints say of states and accelerations whose measured coordinates are known, each smoothed by itself: solves for the
/// others, conditions rows where constraints are held, and finds which accelerations are independent; `completed`, `independent` and
/// `is_independent` say what became of them, notes what a person should know.
/// @param log         its name
/// @param options     of which `hold_constraints`, `keep_positions` and `n_threads` count
/// @param rows        of each episode
/// @param covariance  of (q, dq, ddq) of each coordinate that is measured, at each row; where constraints are held
/// @throws InputError where the log leaves coordinates open, or measured coordinates contradict constraints that must solve for others.
/// @throws NumericalError naming the log and what to log, where the constraints do not give what was not measured.
void apply_constraints(const Model& model, const std::string& log, const DeriveOptions& options,
                       const std::vector<EpisodeRows>& rows, const std::vector<std::vector<Eigen::Matrix3d>>& covariance,
                       DerivedData& data);

}  // namespace gp2
