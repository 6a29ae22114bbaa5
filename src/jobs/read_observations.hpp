#pragma once

#include <optional>
#include <string>
#include <vector>

#include "gp2/jobs/fit_problem.hpp"
#include "jobs/readings.hpp"

namespace gp2 {

/// @param actuators  of the model that is fitted
LoggedSystem logged_system(const Model& fitted, const std::vector<Actuator>& actuators, const Prior& prior,
                           const FitPriorOptions& options, const Log& log);

/// What reading a log leaves beside its observations.
struct LogRows {
  std::vector<int> lines;                  // of each state in the log
  std::optional<CommandedRows> commanded;  // where inputs act late
  bool has_wrong_rate = false;             // a column is not the rate of another over t, or delays are in another unit than t
};

/// The accelerations that a log measures.
Observations read_log(const LoggedSystem& logged, const Log& log, const FitProblemOptions& options, LogRows& rows,
                      std::vector<std::string>& notes);

/// What else is measured or known.
/// @param fitted         the prior of the model that is fitted
/// @param signal_stddev  of each latent, by which the noise is judged
Observations read_side_information(const LoggedSystem& logged, const Prior& fitted, const SideInformation& side_information,
                                   const FitProblemOptions& options, const std::vector<Eigen::VectorXd>& signal_stddev,
                                   LogRows& rows, std::vector<std::string>& notes);

}  // namespace gp2
