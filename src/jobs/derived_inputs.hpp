#pragma once

#include <string>
#include <vector>

#include "gp2/jobs/derive.hpp"
#include "jobs/episode_rows.hpp"
#include "jobs/raw_log.hpp"

namespace gp2 {

/// Writes the inputs of a log into derived states, and notes what is odd about them. Each goes through the filter of the slowest
/// coordinate that it drives: a smoother of the same spectrum and noise is that filter.
/// @param log   its name
/// @param rows  of each episode
/// @param data  has its series
void add_inputs(const System& system, const RawLog& raw, const std::string& log, const std::vector<EpisodeRows>& rows,
                DerivedData& data);

/// Replaces what was commanded by what acts, later, by the model's delays and lags.
/// @param rows    of each episode
/// @param states  [q; dq; t; u] (layout size × N)
void let_inputs_act(const Model& model, const RawLog& raw, const std::vector<EpisodeRows>& rows, Eigen::MatrixXd& states);

}  // namespace gp2
