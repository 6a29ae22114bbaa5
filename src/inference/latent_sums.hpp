#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>

#include "inference/gram.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

/// Sums over the basis of the latents at a block of states, and their memory, of one thread.
class LatentSums {
 public:
  explicit LatentSums(const LatentPosterior& posterior) : posterior_(posterior), mean_(posterior.latents().size()) {}

  /// E[f_a] at every state, per latent (F × n); 0 where the latent was not needed.
  [[nodiscard]] const std::vector<Eigen::MatrixXd>& mean() const { return mean_; }

  /// @param features  per latent (n × D)
  /// @param latent    those that are needed; not given: all
  /// @param loadings  per latent: ℓ_aᵀ at each state (F·d × n); where not null, `cross` receives cov(basis variables,
  ///                  Σ_a ℓ_aᵀ f_a), d columns per state
  void evaluate(const std::vector<Eigen::MatrixXd>& features, std::optional<LatentRange> latent,
                const std::vector<Eigen::MatrixXd>* loadings = nullptr, Eigen::MatrixXd* cross = nullptr);

 private:
  [[nodiscard]] bool needs(std::size_t a) const { return !latent_ || latent_->has(a); }
  Eigen::VectorXd& point(std::size_t a, Eigen::Index i) { return points_[a][static_cast<std::size_t>(i)]; }
  void add_chunk(std::size_t a, Eigen::Index first, Eigen::Index n, Eigen::Index i);
  void write_cross(Eigen::Index first, Eigen::Index n, Eigen::Index i, const std::vector<Eigen::MatrixXd>& loadings,
                   Eigen::Ref<Eigen::MatrixXd> cross);

  const LatentPosterior& posterior_;
  std::vector<std::vector<Eigen::VectorXd>> points_;  // per latent and state: scaled features
  Eigen::MatrixXd k_;                                 // (chunk × latents)
  Eigen::VectorXd products_, sums_;
  std::vector<Eigen::MatrixXd> mean_;
  KernelColumns::Workspace kernel_;
  std::vector<GradientColumns::Workspace> gradients_;  // per latent: of potentials
  std::optional<LatentRange> latent_;
};

}  // namespace gp2
