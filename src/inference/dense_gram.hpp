#pragma once

#include <atomic>
#include <cassert>
#include <optional>

#include "inference/gram.hpp"
#include "inference/growing_cholesky.hpp"

namespace gp2 {

/// Factors K̃ + I of rows, or of the sums of them that are measured, with y: false where it is not positive definite.
/// @param of_rows  memory for K̃ of rows of which sums are measured
/// @param factor   of the size of what is measured
/// @param stop     set: gives up, and is false
[[nodiscard]] bool factorise_covariance(const LatentRows& rows, int n_threads, Eigen::MatrixXd& of_rows, GrowingCholesky& factor,
                                        const std::atomic<bool>* stop = nullptr);

/// K̃ + I = L Lᵀ, exactly: O(n³) operations and O(n²) memory for n reduced rows.
class DenseGram final : public Gram {
 public:
  /// @param n_threads  that it may use where there are samples enough for it to pay
  /// @param stop       set: factorise() gives nothing and differentiate() anything, within a second or so
  explicit DenseGram(int n_threads = 1, const std::atomic<bool>* stop = nullptr) : n_threads_(n_threads), stop_(stop) {}

  /// Of all rows in one block.
  [[nodiscard]] std::optional<GramValue> value(const RowBlocks& blocks) override;
  [[nodiscard]] std::optional<GramValue> differentiate(const RowBlocks& blocks, const std::vector<GramGradientParts>& parts,
                                                       GramGradient& gradient, const OfRows& of_rows) override;

  [[nodiscard]] std::optional<GramValue> factorise(const LatentRows& rows);
  /// Once after factorise of the same rows; so is invert.
  [[nodiscard]] GramGradient differentiate(const LatentRows& rows, const std::vector<GramGradientParts>& parts);
  [[nodiscard]] LatentPosterior::Inverse invert(const LatentRows& rows, const LatentPosterior::SampleSets& states,
                                                const LatentPosterior::SampleSets& sets);

 private:
  [[nodiscard]] int n_threads(const LatentRows& rows) const;
  [[nodiscard]] int n_blas_threads(const LatentRows& rows) const;

  int n_threads_;
  const std::atomic<bool>* stop_;
  GrowingCholesky factor_;
  Eigen::MatrixXd of_rows_;  // K̃ of the rows, where sums of these are measured
};

/// The latents given the observations by L: the samples are the basis, ỹ, or sums of rows before they are whitened, the basis
/// variables and X = L⁻¹, times the inverse of the Cholesky factor of the sums' noise.
class DensePosterior final : public LatentPosterior {
 public:
  /// Without observations; latents and kernels as those of `like`.
  explicit DensePosterior(const LatentRows& like);
  [[nodiscard]] std::unique_ptr<LatentPosterior> clone() const override;

  [[nodiscard]] Eigen::Index size() const override { return factor_.size(); }
  [[nodiscard]] GramValue value() const override;
  [[nodiscard]] double squared_weight(std::size_t latent) const override;
  void whiten(Eigen::Ref<Eigen::MatrixXd> c) const override;
  [[nodiscard]] bool whitens_by_factor() const override { return true; }
  [[nodiscard]] Eigen::MatrixXd triangle_rows(Eigen::Index first, Eigen::Index n) const override;
  [[nodiscard]] Eigen::VectorXd misfit(const std::vector<Eigen::MatrixXd>& f, RandomStream& random) const override;
  [[nodiscard]] std::vector<std::vector<Eigen::MatrixXd>> weights(Eigen::MatrixXd misfits) const override;
  [[nodiscard]] bool append(const RowBlocks& more) override;
  [[nodiscard]] bool append(const LatentRows& more);
  [[nodiscard]] Inverse invert(const LatentRows& rows, const SampleSets& states, const SampleSets& sets) const override;
  void erase(const std::vector<Eigen::Index>& samples) override;
  void forget(double /*share*/) override { assert(false); }

 private:
  // the factor of K̃ + I, of all rows or extended by more; false where it is not positive definite
  [[nodiscard]] bool factorise(const LatentRows& rows);
  [[nodiscard]] bool extend(const LatentRows& more);
  void append_basis(const LatentRows& more);
  // α̃ of the rows
  [[nodiscard]] Eigen::VectorXd weights_of_rows(Eigen::VectorXd alpha) const;
  void refresh_weights();

  Eigen::Index n_samples_ = 0;
  Eigen::VectorXd y_;       // ỹ
  GrowingCholesky factor_;  // with L⁻¹ỹ
};

}  // namespace gp2
