#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "base/random.hpp"
#include "inference/row_blocks.hpp"

// The seam between reduced observations and all that is inferred from them. How K̃ + I is solved stands behind it and nowhere
// else:
//
//     Reduction ─> LatentRows ─> RowBlocks ─┬─> Gram ─> GramValue, GramGradient ─> Likelihood
//                                           └─> LatentPosterior ─> Posterior, PathwiseSamples, Predictor
namespace gp2 {

/// −log N(ỹ; 0, K̃ + I) = data_fit + complexity + ½ size log 2π.
struct GramValue {
  double data_fit = 0;    // ½ ỹᵀ(K̃ + I)⁻¹ỹ
  double complexity = 0;  // ½ log|K̃ + I|
  double constant = 0;    // of the rows' reductions: what no latent enters, with all log 2π
};

/// Which derivatives of one latent are needed beside those in its columns.
struct GramGradientParts {
  bool kernel = false, V = false, mean = false;
  bool alike = false;  // Z_i is the same at every sample and V not needed: `columns` are sums of pairs of components
};

/// Derivatives of −log N(ỹ; 0, K̃ + I). Those in every hyperparameter and parameter follow from them by the chain rule at single
/// samples (theory.md, T13 and T14), whatever the solver. P = (K̃ + I)⁻¹, S_ij = P_ij − α̃_iα̃_jᵀ. `kernel` and `columns` are of all
/// rows, the rest is of those of one block.
struct GramGradient {
  struct OfLatent {
    Eigen::VectorXd kernel;   // ∂/∂log v: ½ Σ_ij ⟨S_ij, Z_i Z_jᵀ⟩ ∂k_ij/∂log v              (parameters)
    Eigen::VectorXd columns;  // ∂/∂log of a factor of each column of Z                      (functions)
                              // where Z_i is alike: Σ_ij S_ij k_ij                          (components²)
    Eigen::MatrixXd V;        // ∂/∂Z_i = V_i = Σ_j S_ij Z_j k_ij, by component              (N × components·functions)
    Eigen::MatrixXd mean;     // Σ_j k_ij Z_jᵀα̃_j, the posterior mean of f_a at the samples  (N × functions)
  };
  Eigen::VectorXd alpha;      // ∂/∂ỹ = α̃ = Pỹ; where there are sums, of the rows that they are of  (size)
  Eigen::VectorXd log_noise;  // of sums: ∂(−log p)/∂log of the noise of each, that of log|L| among it  (sums)
  std::vector<OfLatent> latents;
};

/// The latents given the observations. They are known through numbers that are linear in the latents at the points of a basis,
/// here called basis variables: ỹ at the samples or sums of its rows (dense), or inducing values. With c = cov(basis variables, ·),
///
///     E[f_a(φ)] = Σ_j k_a(φ, φ_j) β_a,j,    cov = cov of the prior − (X c)ᵀ X c'.
class LatentPosterior {
 public:
  /// One latent at the points of the basis. Rows of points are padded to whole vectors (simd.hpp).
  struct Basis {
    KernelColumns kernel;          // k_a between the points and another
    Eigen::MatrixXd Z;             // column c·F + l: weight of f_l(φ_j) in component c of point j, 0 where there is none
    Eigen::MatrixXd beta;          // β  (n_rows × F)
    Eigen::Index n_functions = 0;  // F
    bool is_potential = false;     // the functions are a gradient: GradientColumns in the place of k_a
  };

  virtual ~LatentPosterior() = default;
  [[nodiscard]] virtual std::unique_ptr<LatentPosterior> clone() const = 0;

  [[nodiscard]] const std::vector<Basis>& latents() const { return latents_; }
  /// Which row is component c of point j: [c][j]; −1: the point has fewer components. Rows are the basis variables, unless there
  /// are sums.
  [[nodiscard]] const std::vector<std::vector<Eigen::Index>>& row_of() const { return row_of_; }
  /// The basis variables as sums of rows; null: each is a row.
  [[nodiscard]] const Sums* sums() const { return sums_ ? &*sums_ : nullptr; }
  [[nodiscard]] Eigen::Index n_rows() const { return sums_ ? sums_->D.cols() : size(); }

  [[nodiscard]] virtual Eigen::Index size() const = 0;  // basis variables
  [[nodiscard]] virtual GramValue value() const = 0;
  /// Σ ‖Z_i,a‖² over the observed samples; of a potential each entry times the deviation of its function.
  [[nodiscard]] virtual double squared_weight(std::size_t latent) const = 0;

  /// c ← X c.
  virtual void whiten(Eigen::Ref<Eigen::MatrixXd> c) const = 0;
  /// Whether c is whitened by solving with a factor, X = L⁻¹, and not by a product. Where the noise is far below the signal a product
  /// with L⁻¹ would lose the digits in which X c differs from the prior.
  [[nodiscard]] virtual bool whitens_by_factor() const = 0;
  /// Rows first … first + n − 1 of that lower triangle, X, or L with 1/L_ii on its diagonal, so that a loop that solves with it
  /// divides by nothing, up to the last diagonal entry (n × first + n); what stands above the diagonal is undefined.
  [[nodiscard]] virtual Eigen::MatrixXd triangle_rows(Eigen::Index first, Eigen::Index n) const = 0;

  /// Σ − (X c)ᵀ X c in the lower triangle, Σ the prior's covariance and c of the same quantities.
  void subtract_explained(Eigen::MatrixXd c, Eigen::MatrixXd& covariance) const;

  /// What a function drawn from the prior, with noise drawn for it, leaves of the data to explain.
  /// @param f  per latent: the function at the points of its basis (F × points)
  [[nodiscard]] virtual Eigen::VectorXd misfit(const std::vector<Eigen::MatrixXd>& f, RandomStream& random) const = 0;
  /// The weights in place of β that explain such misfits: [column of misfits][latent].
  [[nodiscard]] virtual std::vector<std::vector<Eigen::MatrixXd>> weights(Eigen::MatrixXd misfits) const = 0;

  /// Conditions on more observations. False, and nothing has changed, where the covariance is not positive definite.
  [[nodiscard]] virtual bool append(const RowBlocks& more) = 0;
  /// Takes observed samples away, by rising numbers in the order of adding: of one that knows them one by one.
  virtual void erase(const std::vector<Eigen::Index>& samples) = 0;
  /// Lets the likelihood of all observations count as its power `share`: of one that knows them by their sums.
  virtual void forget(double share) = 0;

  /// What all others say of a set B of samples (leave_one_out.hpp).
  struct WithoutSet {
    std::vector<Eigen::VectorXd> pull;        // of each sample: its rows of P_BB⁻¹α̃_B (r)
    std::vector<Eigen::MatrixXd> covariance;  // its block of P_BB⁻¹ (r × r)
  };
  struct Inverse {
    Eigen::VectorXd alpha;                // α̃
    std::vector<Eigen::MatrixXd> blocks;  // P_BB of each state, the rows of its samples one sample after another
    std::vector<WithoutSet> without;      // per set; empty where double precision cannot tell
    Eigen::VectorXd noise;                // s² of each sample: 1, but where local latents count as noise (theory.md, T38)
  };
  using SampleSets = std::vector<std::vector<Eigen::Index>>;
  /// @param rows    of the observations that it is conditioned on, or of some of them, which are in `sets` as they were then
  /// @param states  the samples of each state
  /// @param sets    of samples: none, or each sample in one of them
  [[nodiscard]] virtual Inverse invert(const LatentRows& rows, const SampleSets& states, const SampleSets& sets) const = 0;

 protected:
  LatentPosterior() = default;
  LatentPosterior(const LatentPosterior&) = default;
  LatentPosterior& operator=(const LatentPosterior&) = delete;

  /// Σ_c Z_jᵀ α_c,j per latent (n_rows × F), α of the rows.
  [[nodiscard]] std::vector<Eigen::MatrixXd> latent_weights(const Eigen::VectorXd& alpha) const;
  /// Takes Σ_a Z_a f_a from the rows, f at the points of the basis, per latent (F × points).
  void subtract_functions(const std::vector<Eigen::MatrixXd>& f, Eigen::VectorXd& rows) const;

  std::vector<Basis> latents_;
  std::vector<std::vector<Eigen::Index>> row_of_;
  std::optional<Sums> sums_;
};

/// A solver of K̃ + I. It has memory that is used again: one per thread.
class Gram {
 public:
  virtual ~Gram() = default;

  /// Nothing where K̃ + I is not positive definite in double precision, or a block has a fault.
  [[nodiscard]] virtual std::optional<GramValue> value(const RowBlocks& blocks) = 0;

  /// Takes what belongs to the rows of a block; those of different pieces (Pieces) at the same time.
  using OfRows = std::function<void(int piece, const RowBlock& block, const GramGradient& of_rows)>;

  /// The value, and `kernel` and `columns` of its gradient.
  /// @param parts  per latent
  [[nodiscard]] virtual std::optional<GramValue> differentiate(const RowBlocks& blocks,
                                                               const std::vector<GramGradientParts>& parts,
                                                               GramGradient& gradient, const OfRows& of_rows) = 0;
};

}  // namespace gp2
