#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>

#include "base/random.hpp"

namespace gp2 {

/// Minimises a function that can only be ranked, by the covariance matrix adaptation evolution strategy (Hansen 2016,
/// arXiv:1604.00772, with its default constants): points are drawn from N(m, σ²C), and m, σ and C follow the better half.
class EvolutionStrategy {
 public:
  /// @param mean  m, where it begins  (n)
  /// @param step  σ
  EvolutionStrategy(Eigen::VectorXd mean, double step, std::uint64_t seed);

  /// How many points a generation has.
  [[nodiscard]] static int generation_size(Eigen::Index n);
  /// The points of the next generation (n × generation_size).
  Eigen::MatrixXd draw();
  /// @param ranking  columns of the generation drawn last, the best first
  void learn(const std::vector<int>& ranking);

 private:
  Eigen::VectorXd mean_;
  double step_;
  RandomStream random_;
  Eigen::VectorXd weights_;
  double n_effective_, step_rate_, step_damping_, path_rate_, rank_one_, rank_mu_, expected_norm_;
  Eigen::MatrixXd covariance_, axes_;  // C = axes diag(lengths²) axesᵀ
  Eigen::VectorXd lengths_;
  Eigen::VectorXd step_path_, path_;
  Eigen::MatrixXd steps_;  // (x − m)/σ of the generation
  int n_generations_ = 0;
};

}  // namespace gp2
