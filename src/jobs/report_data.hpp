#pragma once

#include <vector>

#include "gp2/jobs/report_job.hpp"

namespace gp2 {

/// What a fit says at the accelerations that it was learned from, of each of its Observations that has some.
std::vector<ReportData> training_data(const FitFile& fit, const Posterior& posterior);

/// Whether commands act alike by both.
bool act_alike(const std::vector<Actuator>& a, const std::vector<Actuator>& b);

}  // namespace gp2
