#pragma once

#include <atomic>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "gp2/base/workers.hpp"
#include "gp2/inference/model_values.hpp"
#include "inference/gram.hpp"
#include "inference/piece_sums.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// Of k(φ, φ): what is left of it is known to no better in double precision. A point at which the others leave less tells nothing
/// more, and t counts as much more as left out, so that the bound is one and no optimiser gains by rounding.
constexpr double smallest_pivot = 1e-15;

/// Whether what points leave out of a latent counts as noise: they cannot hold what has short, fixed lengthscales (theory.md, T38).
inline bool is_local(const Latent& latent) { return latent.kernel_is_fixed && latent.base == Latent::Base::admissible; }

/// Latents at their inducing points Z_a under one set of values. The inducing variables are f_a,l(Z_j), point after point of
/// function after function of latent after latent; whitened they are L_a⁻¹ times that. The functions of a potential are the
/// derivatives of one function, so that they share their variables: ∂_d V(Z_j), of all those that tell something.
class InducingLatents {
 public:
  struct OfLatent {
    KernelColumns kernel;     // k_a between the points and another
    Eigen::MatrixXd L;        // k_a(Z, Z) = L Lᵀ, of a potential the covariance of its derivatives
    std::vector<int> chosen;  // which of the points that were given Z are, in order; of a potential d·points + j of its variables
    Eigen::Index n_functions = 0;
    bool is_local = false;
    bool is_potential = false;
    std::size_t first_cross = 0;  // of its covariances among those of all latents, of a potential one for each derivative

    [[nodiscard]] Eigen::Index n_points() const { return kernel.n_points(); }
    [[nodiscard]] Eigen::Index n_variables() const { return L.rows(); }  // of each function, of a potential of all together
    [[nodiscard]] std::size_t n_crosses() const { return is_potential ? static_cast<std::size_t>(n_functions) : 1; }
    /// Of a variable of a potential, the derivative and the point.
    [[nodiscard]] std::pair<Eigen::Index, Eigen::Index> derivative_at(Eigen::Index variable) const {
      const Eigen::Index entry = chosen[static_cast<std::size_t>(variable)];
      return {entry / n_points(), entry % n_points()};
    }
  };
  struct Function {
    std::size_t latent = 0;
    Eigen::Index index = 0;  // in its latent
    Eigen::Index first = 0;  // its first variable
    std::size_t cross = 0;   // which of the covariances are its own
  };

  InducingLatents() = default;
  /// Points whose functions the others already tell, to double precision, are left out.
  InducingLatents(const Prior& prior, const ModelValues& values);
  /// @param factors  per latent: of k_a(Z, Z), as they were found before; another processor might choose others
  InducingLatents(const Prior& prior, const ModelValues& values, std::vector<lapack::PivotedFactor> factors);

  [[nodiscard]] Eigen::Index size() const { return size_; }  // M
  [[nodiscard]] const std::vector<OfLatent>& latents() const { return latents_; }
  [[nodiscard]] const std::vector<Function>& functions() const { return functions_; }
  [[nodiscard]] const OfLatent& latent_of(const Function& function) const { return latents_[function.latent]; }
  [[nodiscard]] std::size_t n_crosses() const { return latents_.back().first_cross + latents_.back().n_crosses(); }

  /// k_a between the variables of a function and the functions at n states (variables, padded × n), to k[first_cross], ….
  /// @param features  (n × D)
  void evaluate(std::size_t a, const Eigen::Ref<const Eigen::MatrixXd>& features, std::vector<Eigen::MatrixXd>& k) const;
  /// f_a at n states where the whitened inducing variables are m, per latent (F × n).
  /// @param features  per latent (n × D)
  [[nodiscard]] std::vector<Eigen::MatrixXd> at(const std::vector<Eigen::MatrixXd>& features,
                                                const Eigen::Ref<const Eigen::VectorXd>& m) const;
  /// c ← L⁻¹c, or L⁻ᵀc, of all functions.
  void solve(bool transposed, Eigen::Ref<Eigen::MatrixXd> c) const;

 private:
  std::vector<OfLatent> latents_;
  std::vector<Function> functions_;
  Eigen::Index size_ = 0;
};

/// A block of samples beside inducing variables: Γ_i,f, component c of sample i, is the weight of function f in it (theory.md,
/// T37). Weights and ỹ are in units of a noise that what is left of local latents has enlarged s_i-fold (T38). One per thread.
class InducingBlock {
 public:
  explicit InducingBlock(const InducingLatents& latents);

  /// @param rows  must outlive what is asked
  void move_to(const LatentRows& rows);

  [[nodiscard]] const LatentRows& rows() const { return *rows_; }
  [[nodiscard]] Eigen::Index n() const { return rows_->n_samples(); }
  /// ỹ, by component (n × components)
  [[nodiscard]] auto y() const { return y_.topRows(n()); }
  /// k_a(Z, φ_i) (points, padded × n), and of a function w = L⁻¹k (variables × n).
  [[nodiscard]] const Eigen::MatrixXd& k(std::size_t latent) const { return k_[latents_->latents()[latent].first_cross]; }
  [[nodiscard]] const Eigen::MatrixXd& w(std::size_t f) const { return w_[latents_->functions()[f].cross]; }
  /// s (n)
  [[nodiscard]] const Eigen::VectorXd& noise() const { return noise_; }
  /// Σ log s_i over the components of all samples
  [[nodiscard]] double log_noise() const { return rank_.dot(noise_.array().log().matrix()); }
  /// ∂/∂log s_i of a function of Γ and ỹ of samples, and of Σ log s_i, to its part of the gradient in Γ_i,f, component c, of a local
  /// latent (n)
  [[nodiscard]] Eigen::ArrayXd of_noise(std::size_t f, Eigen::Index component, const Eigen::ArrayXd& slope) const;
  [[nodiscard]] const Eigen::VectorXd& rank() const { return rank_; }
  /// Adds to the mean of a local latent's functions at the samples (n × functions) what it has where it counts as noise: m with
  /// Γ_i m = (s_i² − 1) α̃_i, α̃ (n × components) in units of the noise without it.
  void add_mean_of_noise(std::size_t a, const Eigen::MatrixXd& alpha, Eigen::MatrixXd& mean) const;
  /// Variance of a function at most (n); of a local latent what the points hold of it
  [[nodiscard]] const Eigen::VectorXd& variance(std::size_t f) const { return variance_[latents_->functions()[f].cross]; }
  [[nodiscard]] auto weight(std::size_t f, Eigen::Index component) const {
    const InducingLatents::Function& function = latents_->functions()[f];
    const LatentRows::OfLatent& latent = rows_->latents[function.latent];
    return latent.Z.col(component * latent.n_functions + function.index).head(n()).cwiseQuotient(noise_);
  }
  /// Σ_c Γ_i,f Γ_i,g (n)
  [[nodiscard]] Eigen::ArrayXd weight_product(std::size_t f, std::size_t g) const;
  /// What the points leave of the samples' variance: the part of a function, with that of those before it that share its variables.
  [[nodiscard]] double left_out(std::size_t f) const;
  /// Ψᵀ of one component (M × n).
  [[nodiscard]] Eigen::MatrixXd loadings(Eigen::Index component) const;
  /// ỹ − Ψ m, by component (n × components)
  [[nodiscard]] Eigen::MatrixXd misfit(const Eigen::Ref<const Eigen::VectorXd>& m) const;

 private:
  void add_noise();

  const InducingLatents* latents_;
  const LatentRows* rows_ = nullptr;
  Eigen::MatrixXd y_;
  std::vector<Eigen::MatrixXd> k_, w_;     // by cross
  std::vector<Eigen::VectorXd> variance_;  // by cross
  Eigen::VectorXd rank_, noise_;
  std::vector<Eigen::ArrayXd> left_;  // of local latents: k_a(φ_i, φ_i) − ‖w_i‖² (n)
};

/// The sum of what work(sum, piece, RowBlock, InducingBlock) adds for every block of rows, in PieceSums.
/// @param stop  set: leaves out the rest
/// @returns nothing where a block has a fault, of any process
template <typename Sum, typename Work>
std::optional<Sum> sum_over_blocks(const InducingLatents& latents, const RowBlocks& rows, bool with_derivatives,
                                   const Workers& workers, const std::atomic<bool>* stop, const Sum& zero, const Work& work) {
  const Pieces pieces(rows.n_blocks());
  PieceSums<Sum> sums(pieces.n, zero);
  std::atomic<bool> is_sound = true;
  parallel_for(pieces.n, workers.n_threads, [&](int piece, int) {
    if (!workers.owns(piece, pieces.n)) return;
    RowBlocks::Memory memory;
    InducingBlock block(latents);
    Sum sum = zero;
    for (Eigen::Index b = pieces.first(piece); b < pieces.first(piece + 1) && is_sound && !is_set(stop); ++b) {
      const RowBlock* const of_rows = rows.block(b, with_derivatives, memory);
      if (of_rows == nullptr) {
        is_sound = false;
        return;
      }
      block.move_to(of_rows->rows);
      work(sum, piece, *of_rows, block);
    }
    sums.put(piece, std::move(sum));
  });
  if (workers.sum(is_sound ? 0 : 1) > 0) return std::nullopt;
  return sums.total(workers);
}

/// What observations say of whitened inducing variables: sums over blocks of samples.
struct InducingStatistics {
  Eigen::MatrixXd B;       // Σ ΨᵀΨ, lower triangle (M × M)
  Eigen::VectorXd c;       // Σ Ψᵀỹ (M)
  double yy = 0;           // Σ ỹᵀỹ
  double trace = 0;        // t
  double constant = 0;     // of the reductions
  Eigen::VectorXd weight;  // per latent: Σ ‖Γ‖², of a potential times the variances of its derivatives

  InducingStatistics() = default;
  explicit InducingStatistics(const InducingLatents& latents);  // of no samples
  /// Nothing where a block has a fault.
  [[nodiscard]] static std::optional<InducingStatistics> of(const InducingLatents& latents, const RowBlocks& rows,
                                                            const Workers& workers, const std::atomic<bool>* stop = nullptr);
  /// @param share  as which the likelihood of the other counts
  void add(const InducingStatistics& other, double share = 1);
  /// Calls work(first number, how many) for all numbers.
  template <typename Work>
  void for_each(const Work& work) {
    for (double* number : {&yy, &trace, &constant}) work(number, 1);
    work(B.data(), B.size());
    for (Eigen::VectorXd* vector : {&c, &weight}) work(vector->data(), vector->size());
  }
  /// Adds a block of samples.
  void add(const InducingLatents& latents, const InducingBlock& block);
};

}  // namespace gp2
