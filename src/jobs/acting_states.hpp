#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/prior.hpp"

namespace gp2 {

/// At how many states the latents of a prior act.
class ActingStates {
 public:
  explicit ActingStates(const Prior& prior);
  /// Adds states of a system whose prior has the same latents.
  void count(const Prior& prior, const Eigen::MatrixXd& states, const Eigen::VectorXd& parameters);
  /// Of each latent whose direction is 0 at all of them or, where `accelerations` are all that is measured, that of a constraint force.
  [[nodiscard]] std::vector<std::string> idle_texts(bool accelerations = true) const;

 private:
  std::vector<std::string> names_;
  std::vector<bool> acts_, moves_;  // at some state; what moves acts
  Eigen::Index n_states_ = 0;
};

}  // namespace gp2
