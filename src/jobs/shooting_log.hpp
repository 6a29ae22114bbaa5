#pragma once

#include <functional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/jobs/shoot_job.hpp"

namespace gp2 {

/// Rows over which a log goes on without a break.
struct UnbrokenRows {
  Eigen::Index first = 0, n = 0;
};
/// All of them, in their order.
/// @param is_same_episode  of row i and the one before
std::vector<UnbrokenRows> unbroken_parts(const Eigen::Ref<const Eigen::VectorXd>& times,
                                         const std::function<bool(Eigen::Index i)>& is_same_episode);

/// Rows of a log that follow one another, and where the motion over them starts.
struct Stretch {
  Eigen::Index first = 0, size = 0;
  Eigen::VectorXd start;
};

/// A log that motions are compared with by multiple shooting.
struct ShootingLog {
  Eigen::MatrixXd states;          // (layout size × rows)
  std::vector<int> compared;       // coordinates
  std::vector<double> stated;      // the median deviation that the log states of each of them; empty where it states none
  Eigen::VectorXd spread;          // of q and dq over it (2 nq)
  double duration = 0;             // of a stretch [s]
  std::vector<Stretch> stretches;  // each starts at its first row
};

/// Reads a log of the model's system, and cuts it into stretches.
/// @throws InputError where the log lacks a column, or no stretch fits in it.
ShootingLog read_shooting_log(const Model& model, const CsvTable& table, const ShootRequest& request,
                              std::vector<std::string>& notes);

}  // namespace gp2
