#include "training/evolution.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Eigenvalues>

#include "base/decompositions.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

int EvolutionStrategy::generation_size(Index n) { return 4 + static_cast<int>(3 * std::log(static_cast<double>(n))); }

EvolutionStrategy::EvolutionStrategy(VectorXd mean, double step, std::uint64_t seed)
    : mean_(std::move(mean)), step_(step), random_(seed) {
  const Index n = mean_.size();
  const auto N = static_cast<double>(n);
  const int n_better = generation_size(n) / 2;
  weights_ = VectorXd::NullaryExpr(
      n_better, [&](Index i) { return std::log((generation_size(n) + 1) / 2.0) - std::log(static_cast<double>(i) + 1); });
  weights_ /= weights_.sum();
  n_effective_ = 1 / weights_.squaredNorm();
  step_rate_ = (n_effective_ + 2) / (N + n_effective_ + 5);
  step_damping_ = 1 + 2 * std::max(0.0, std::sqrt((n_effective_ - 1) / (N + 1)) - 1) + step_rate_;
  path_rate_ = (4 + n_effective_ / N) / (N + 4 + 2 * n_effective_ / N);
  rank_one_ = 2 / ((N + 1.3) * (N + 1.3) + n_effective_);
  rank_mu_ = std::min(1 - rank_one_, 2 * (n_effective_ - 2 + 1 / n_effective_) / ((N + 2) * (N + 2) + n_effective_));
  expected_norm_ = std::sqrt(N) * (1 - 1 / (4 * N) + 1 / (21 * N * N));
  covariance_ = axes_ = MatrixXd::Identity(n, n);
  lengths_ = VectorXd::Ones(n);
  step_path_ = path_ = VectorXd::Zero(n);
}

MatrixXd EvolutionStrategy::draw() {
  steps_.resize(mean_.size(), generation_size(mean_.size()));
  for (double& one : steps_.reshaped()) one = random_.normal();
  steps_ = axes_ * lengths_.asDiagonal() * steps_;
  return (step_ * steps_).colwise() + mean_;
}

void EvolutionStrategy::learn(const std::vector<int>& ranking) {
  const std::vector<int> better(ranking.begin(), ranking.begin() + weights_.size());
  const MatrixXd chosen = steps_(Eigen::all, better);
  const VectorXd way = chosen * weights_;
  mean_ += step_ * way;

  // σ grows where one generation goes on in the direction of the last, and falls where it turns back
  const VectorXd sphere = axes_ * (axes_.transpose() * way).cwiseQuotient(lengths_);
  step_path_ = (1 - step_rate_) * step_path_ + std::sqrt(step_rate_ * (2 - step_rate_) * n_effective_) * sphere;
  ++n_generations_;
  const double length = step_path_.norm() / expected_norm_;
  const double at_rest = std::sqrt(1 - std::pow(1 - step_rate_, 2 * n_generations_));
  const bool is_steady = length / at_rest < 1.4 + 2 / (static_cast<double>(mean_.size()) + 1);
  step_ *= std::exp(step_rate_ / step_damping_ * (length - 1));

  // C stretches along the way of all generations, and along the steps of this one
  path_ *= 1 - path_rate_;
  if (is_steady) path_ += std::sqrt(path_rate_ * (2 - path_rate_) * n_effective_) * way;
  covariance_ *= 1 - rank_one_ - rank_mu_ + (is_steady ? 0 : rank_one_ * path_rate_ * (2 - path_rate_));
  covariance_ += rank_one_ * path_ * path_.transpose() + rank_mu_ * chosen * weights_.asDiagonal() * chosen.transpose();
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(covariance_);
  axes_ = eigen.eigenvectors();
  lengths_ = eigen.eigenvalues().cwiseSqrt();
}

}  // namespace gp2
