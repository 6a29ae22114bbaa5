#pragma once

#include <Eigen/Core>

namespace gp2 {

/// The rows of one episode, which follow one another in DerivedData.
struct EpisodeRows {
  Eigen::Index first = 0;
  Eigen::VectorXd times;  // since the start of the episode [s]

  [[nodiscard]] Eigen::Index n() const { return times.size(); }
};

}  // namespace gp2
