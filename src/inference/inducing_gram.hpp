#pragma once

#include <atomic>
#include <cassert>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "inference/gram.hpp"
#include "inference/inducing_latents.hpp"

namespace gp2 {

/// Latents known through inducing variables: the bound of Titsias (2009) on −log p, as tight as the points are many (theory.md,
/// T37). O(N M²) operations and O(M²) memory beside the rows. Nothing is added to the diagonal of B = I + ΣΨᵀΨ, whose eigenvalues
/// are ≥ 1.
class InducingGram final : public Gram {
 public:
  /// @param latents  at their points, under the values of the rows
  explicit InducingGram(InducingLatents latents, Workers workers = {}, const std::atomic<bool>* stop = nullptr)
      : latents_(std::move(latents)), workers_(std::move(workers)), stop_(stop) {}

  [[nodiscard]] std::optional<GramValue> value(const RowBlocks& rows) override;
  [[nodiscard]] std::optional<GramValue> differentiate(const RowBlocks& rows, const std::vector<GramGradientParts>& parts,
                                                       GramGradient& gradient, const OfRows& of_rows) override;

 private:
  /// B, L and the mean; false where B is not positive definite, or a block has a fault.
  [[nodiscard]] bool factorise(const RowBlocks& rows);
  /// @param misfit  Σ ‖α̃‖²
  [[nodiscard]] GramValue value_of(double misfit) const;
  /// Adds Σ tr(∂k(Z, φ_i)/∂log v ᵀ L⁻ᵀU) of a latent's covariances with a block.
  /// @param U  of each of them (variables, padded × n); becomes L⁻ᵀU
  void add_cross_gradient(std::size_t a, const InducingBlock& block, std::span<Eigen::MatrixXd> U, Eigen::MatrixXd& sums) const;
  void add_variance_gradient(std::size_t a, const InducingBlock& block, Eigen::MatrixXd& sums) const;
  void add_points_gradient(std::size_t a, const Eigen::MatrixXd& P, Eigen::MatrixXd& sums) const;

  InducingLatents latents_;
  Workers workers_;
  const std::atomic<bool>* stop_;
  Eigen::MatrixXd B_, L_;  // B and its factor
  Eigen::VectorXd mean_;   // of the whitened variables, B⁻¹c
  double trace_ = 0, constant_ = 0, log_det_half_ = 0;
};

/// The latents given observations: whitened inducing variables have mean B⁻¹c and covariance B⁻¹. The points are the basis and the
/// inducing variables the basis variables, so that XᵀX = L⁻ᵀ(I − B⁻¹)L⁻¹.
///
/// What the observations say is kept by stretches of them, so that each can be left out, until more come.
class InducingPosterior final : public LatentPosterior {
 public:
  InducingPosterior(InducingLatents inducing, std::vector<InducingStatistics> stretches);

  /// Whether B is positive definite in double precision.
  [[nodiscard]] bool factorise();
  [[nodiscard]] const InducingLatents& inducing() const { return inducing_; }
  /// B⁻¹c
  [[nodiscard]] const Eigen::VectorXd& mean() const { return mean_; }
  /// What all observations say.
  [[nodiscard]] const InducingStatistics& all() const { return all_; }
  [[nodiscard]] std::unique_ptr<LatentPosterior> clone() const override { return std::make_unique<InducingPosterior>(*this); }

  [[nodiscard]] Eigen::Index size() const override { return inducing_.size(); }
  [[nodiscard]] GramValue value() const override;
  [[nodiscard]] double squared_weight(std::size_t latent) const override {
    return all_.weight[static_cast<Eigen::Index>(latent)];
  }
  void whiten(Eigen::Ref<Eigen::MatrixXd> c) const override;
  [[nodiscard]] bool whitens_by_factor() const override { return false; }
  [[nodiscard]] Eigen::MatrixXd triangle_rows(Eigen::Index first, Eigen::Index n) const override;
  [[nodiscard]] Eigen::VectorXd misfit(const std::vector<Eigen::MatrixXd>& f, RandomStream& random) const override;
  [[nodiscard]] std::vector<std::vector<Eigen::MatrixXd>> weights(Eigen::MatrixXd misfits) const override;
  [[nodiscard]] bool append(const RowBlocks& more) override;
  void erase(const std::vector<Eigen::Index>& /*samples*/) override { assert(false); }
  void forget(double share) override;
  /// @param sets  one for each stretch
  [[nodiscard]] Inverse invert(const LatentRows& rows, const SampleSets& states, const SampleSets& sets) const override;

 private:
  InducingLatents inducing_;
  std::vector<InducingStatistics> stretches_;
  InducingStatistics all_;
  Eigen::MatrixXd L_;     // of B
  Eigen::VectorXd mean_;  // B⁻¹c
  Eigen::MatrixXd X_;     // lower triangle
};

}  // namespace gp2
