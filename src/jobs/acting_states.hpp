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
  /// Of each latent whose direction is 0 at all of them or, where `accelerations` are all that is measured, that of a constraint
  /// force; of each coordinate's own direction, which nobody wrote, only where no other of the same [[latent]] moves the system.
  [[nodiscard]] std::vector<std::string> idle_texts(bool accelerations = true) const;

 private:
  std::vector<std::string> names_, directions_;  // of each latent; its one direction, empty where it has all
  std::vector<bool> are_of_coordinates_;         // whether that is the one of a coordinate
  std::vector<bool> acts_, moves_;               // at some state; what moves acts
  Eigen::Index n_states_ = 0;
};

}  // namespace gp2
