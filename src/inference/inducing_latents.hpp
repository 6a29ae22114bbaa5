#pragma once

#include <atomic>
#include <vector>

#include <Eigen/Core>

#include "base/parallel.hpp"
#include "gp2/inference/model_values.hpp"
#include "inference/latent_rows.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// Of k(φ, φ): what is left of it is known to no better in double precision. A point at which the others leave less tells nothing
/// more, and t counts as much more as left out, so that the bound is one and no optimiser gains by rounding.
constexpr double smallest_pivot = 1e-15;

/// Latents at their inducing points Z_a under one set of values. The inducing variables are f_a,l(Z_j), point after point of
/// function after function of latent after latent; whitened they are L_a⁻¹ times that.
class InducingLatents {
 public:
  struct OfLatent {
    KernelColumns kernel;  // k_a between the points and another
    Eigen::MatrixXd L;     // k_a(Z, Z) = L Lᵀ
    Eigen::Index n_functions = 0;

    [[nodiscard]] Eigen::Index n_points() const { return L.rows(); }
  };
  struct Function {
    std::size_t latent = 0;
    Eigen::Index index = 0;  // in its latent
    Eigen::Index first = 0;  // its first variable
  };

  InducingLatents() = default;
  /// Points whose functions the others already tell, to double precision, are left out.
  InducingLatents(const InducingPoints& points, const LatentRows& rows);

  [[nodiscard]] Eigen::Index size() const { return size_; }  // M
  [[nodiscard]] const std::vector<OfLatent>& latents() const { return latents_; }
  [[nodiscard]] const std::vector<Function>& functions() const { return functions_; }
  [[nodiscard]] const OfLatent& latent_of(const Function& function) const { return latents_[function.latent]; }

  /// c ← L⁻¹c, or L⁻ᵀc, of all functions.
  void solve(bool transposed, Eigen::Ref<Eigen::MatrixXd> c) const;

 private:
  std::vector<OfLatent> latents_;
  std::vector<Function> functions_;
  Eigen::Index size_ = 0;
};

/// A block of samples beside inducing variables: Γ_i,f, component c of sample i, is the weight of function f in it (theory.md,
/// T37). One per thread.
class InducingBlock {
 public:
  static constexpr Eigen::Index size = 256;  // samples

  InducingBlock(const InducingLatents& latents, const LatentRows& rows);

  void move_to(Eigen::Index first);

  [[nodiscard]] Eigen::Index first() const { return first_; }
  [[nodiscard]] Eigen::Index n() const { return n_; }
  /// k_a(Z, φ_i) (points, padded × n), and w = L⁻¹k (points × n).
  [[nodiscard]] const Eigen::MatrixXd& k(std::size_t latent) const { return k_[latent]; }
  [[nodiscard]] auto w(std::size_t latent) const { return w_[latent].leftCols(n_); }
  /// k_a(φ_i, φ_i) at most (n)
  [[nodiscard]] auto variance(std::size_t latent) const { return variance_[latent].head(n_); }
  [[nodiscard]] auto weight(std::size_t f, Eigen::Index component) const {
    const InducingLatents::Function& function = latents_->functions()[f];
    const LatentRows::OfLatent& latent = rows_->latents[function.latent];
    return latent.Z.col(component * latent.n_functions + function.index).segment(first_, n_);
  }
  /// Σ_c Γ_i,f Γ_i,g (n)
  [[nodiscard]] Eigen::ArrayXd weight_product(std::size_t f, std::size_t g) const;

 private:
  const InducingLatents* latents_;
  const LatentRows* rows_;
  Eigen::Index first_ = 0, n_ = 0;
  std::vector<Eigen::MatrixXd> k_, w_;
  std::vector<Eigen::VectorXd> variance_;
  Eigen::VectorXd point_;
  KernelColumns::Workspace workspace_;
};

/// Sums over blocks are of so many parts, each of blocks that follow each other, whatever the number of threads.
constexpr int n_block_parts = 8;

/// Calls work(part, block) for every block of samples.
/// @param stop  set: leaves out the rest
template <typename Work>
void for_each_block(const InducingLatents& latents, const LatentRows& rows, int n_threads, const std::atomic<bool>* stop,
                    const Work& work) {
  const Eigen::Index n_blocks = (rows.n_samples() + InducingBlock::size - 1) / InducingBlock::size;
  parallel_for(n_block_parts, n_threads, [&](int part, int) {
    InducingBlock block(latents, rows);
    for (Eigen::Index b = part * n_blocks / n_block_parts; b < (part + 1) * n_blocks / n_block_parts && !is_set(stop); ++b) {
      block.move_to(b * InducingBlock::size);
      work(static_cast<std::size_t>(part), block);
    }
  });
}

/// What observations say of whitened inducing variables: sums over blocks of samples.
struct InducingStatistics {
  Eigen::MatrixXd B;       // Σ ΨᵀΨ, lower triangle (M × M)
  Eigen::VectorXd c;       // Σ Ψᵀỹ (M)
  double yy = 0;           // Σ ỹᵀỹ
  double trace = 0;        // t
  Eigen::VectorXd weight;  // per latent: Σ ‖Γ‖²

  InducingStatistics() = default;
  /// The same bits for any number of threads.
  InducingStatistics(const InducingLatents& latents, const LatentRows& rows, int n_threads,
                     const std::atomic<bool>* stop = nullptr);
  explicit InducingStatistics(const InducingLatents& latents);  // of no samples
  void add(const InducingStatistics& other);
  /// Adds a block of samples.
  /// @param y       ỹ, by component
  /// @param share   of each sample: 1, or 0 where it is left out (n)
  /// @param memory  that is used again
  void add(const InducingLatents& latents, const InducingBlock& block, const Eigen::MatrixXd& y, const Eigen::ArrayXd& share,
           Eigen::MatrixXd& memory);
};

}  // namespace gp2
