#pragma once

#include <atomic>
#include <memory>

#include "inference/gram.hpp"
#include "inference/inducing_latents.hpp"

namespace gp2 {

/// Latents known through inducing variables: the bound of Titsias (2009) on −log p, as tight as the points are many (theory.md,
/// T37). O(N M²) operations and O(M²) memory beside the rows. Nothing is added to the diagonal of B = I + ΣΨᵀΨ, whose eigenvalues
/// are ≥ 1.
class InducingGram final : public Gram {
 public:
  /// @param points  of every latent
  explicit InducingGram(std::shared_ptr<const InducingPoints> points, int n_threads = 1, const std::atomic<bool>* stop = nullptr)
      : points_(std::move(points)), n_threads_(n_threads), stop_(stop) {}

  [[nodiscard]] std::optional<GramValue> factorise(const LatentRows& rows) override;
  [[nodiscard]] GramGradient differentiate(const LatentRows& rows, const std::vector<GramGradientParts>& parts) override;
  [[nodiscard]] Inverse invert(const LatentRows& rows, const std::vector<std::vector<Eigen::Index>>& sets) override;
  [[nodiscard]] std::unique_ptr<LatentPosterior> condition(const LatentRows& rows) const override;

 private:
  [[nodiscard]] Eigen::VectorXd alpha(const Reduction& reduction) const;
  /// Ψᵀ of one component of the samples of a block (M × n).
  [[nodiscard]] Eigen::MatrixXd loadings(const InducingBlock& block, Eigen::Index component) const;
  void add_variance_gradient(const LatentRows& rows, std::size_t a, const InducingBlock& block, Eigen::MatrixXd& sums,
                             KernelColumns::Workspace& workspace) const;
  void add_points_gradient(std::size_t a, const Eigen::MatrixXd& P, Eigen::MatrixXd& sums) const;

  std::shared_ptr<const InducingPoints> points_;
  int n_threads_;
  const std::atomic<bool>* stop_;
  InducingLatents latents_;
  Eigen::MatrixXd B_, L_;  // B and its factor
  Eigen::VectorXd mean_;   // of the whitened variables, B⁻¹c
  Eigen::MatrixXd alpha_;  // α̃, by component
};

/// The latents given observations: whitened inducing variables have mean B⁻¹c and covariance B⁻¹. The points are the basis and the
/// inducing variables the basis variables, so that XᵀX = L⁻ᵀ(I − B⁻¹)L⁻¹.
class InducingPosterior final : public LatentPosterior {
 public:
  InducingPosterior(InducingLatents inducing, InducingStatistics statistics);

  /// Whether B is positive definite in double precision.
  [[nodiscard]] bool factorise();
  [[nodiscard]] std::unique_ptr<LatentPosterior> clone() const override { return std::make_unique<InducingPosterior>(*this); }

  [[nodiscard]] Eigen::Index size() const override { return inducing_.size(); }
  [[nodiscard]] GramValue value() const override;
  [[nodiscard]] double squared_weight(std::size_t latent) const override {
    return statistics_.weight[static_cast<Eigen::Index>(latent)];
  }
  void whiten(Eigen::Ref<Eigen::MatrixXd> c) const override;
  [[nodiscard]] Eigen::MatrixXd whitening_columns(Eigen::Index first, Eigen::Index n) const override;
  [[nodiscard]] Eigen::VectorXd misfit(const std::vector<Eigen::MatrixXd>& f, RandomStream& random) const override;
  [[nodiscard]] std::vector<std::vector<Eigen::MatrixXd>> weights(Eigen::MatrixXd misfits) const override;
  [[nodiscard]] bool append(const LatentRows& more) override;
  void erase(const std::vector<Eigen::Index>& samples) override;

 private:
  [[nodiscard]] std::vector<Eigen::MatrixXd> latent_weights(const Eigen::Ref<const Eigen::VectorXd>& of_variables) const;

  InducingLatents inducing_;
  InducingStatistics statistics_;
  Eigen::MatrixXd L_;     // of B
  Eigen::VectorXd mean_;  // B⁻¹c
  Eigen::MatrixXd X_;     // lower triangle
};

/// The solver that values ask for.
std::unique_ptr<Gram> make_gram(const ModelValues& values, int n_threads = 1, const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
