#pragma once

#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/prior/kernel.hpp"
#include "gp2/prior/state_function.hpp"

namespace gp2 GP2_API {

/// A group of independent zero-mean scalar Gaussian processes f(φ(x)) that share one kernel and act on ā through the p directions
/// E(x) (nq × p) and a loading C: they add E(x) C f(φ(x)) to ā. C is diag(s), the signal standard deviations s_1 … s_p of p
/// processes, or a free matrix (p × functions): E C CᵀEᵀ is then the coregionalisation matrix of multi-output models.
///
/// Or a potential V ~ GP(s² k): f is the gradient of a process of covariance k, one function for each feature and correlated, E =
/// −M⁻¹Jᵀ with J = ∂φ/∂q, and C = s I; what it adds to the applied force is −Jᵀ∇V(φ(q)).
struct Latent {
  enum class Base {
    acceleration,  // E = B
    force,         // E = M⁻¹B; where M is singular M'⁻¹B, M' as in UdwadiaKalaba
    admissible,    // E = B Π, Π the orthogonal projector onto the null space of A B: A E = 0; B diagonal, constant and positive
  };

  /// How a parameter of the kernel starts and is bounded, relative to its default scale (scales: training/default_hyperparameters.hpp).
  /// Equal bounds hold it at their value.
  struct Range {
    double initial = 0;  // 0: the protocol's default
    double lower = 0;    // 0: the protocol's default
    double upper = 0;    // 0: the protocol's default
    // log-normal hyper-prior; log_stddev 0: the protocol's default
    double median = 0, log_stddev = 0;
  };

  std::string name;
  /// The one direction that this is of a [[latent]] with lengthscales for each; empty where they are shared.
  std::string direction = {};
  Kernel kernel;
  std::vector<std::string> feature_names;         // of φ(x), D of them
  std::shared_ptr<const StateFunction> features;  // φ; parameters in it keep the model's values
  std::vector<bool> is_of_place;                  // per feature: reads coordinates and t alone (D); of code all are or none
  std::vector<int> feature_parameters;            // the system's parameters that φ uses: they cannot be estimated
  Base base = Base::acceleration;
  bool is_potential = false;                        // a potential of its features, with directions −Jᵀ on forces
  std::vector<std::string> column_names;            // p of them, for the names of the signal standard deviations
  std::shared_ptr<const StateFunction> directions;  // B (nq × p), column-major; null: B = I, p = nq
  std::optional<int> free_loading;                  // columns of a free loading C; not given: C = diag(s)
  bool kernel_is_fixed = false;                     // the kernel's parameters are 1, in the units that its features have
  bool has_one_signal = false;                      // s = (c, …, c), in the units that its directions have
  bool is_positive = false;                         // exp(C f) acts along the directions, not C f
  Range lengthscale, signal_stddev;
  std::vector<Range> feature_lengthscales;  // of each feature, in its unit, before `lengthscale` (D); empty: of none

  [[nodiscard]] int size() const { return static_cast<int>(column_names.size()); }  // p
  [[nodiscard]] int n_features() const { return static_cast<int>(feature_names.size()); }
  [[nodiscard]] int n_functions() const { return free_loading.value_or(size()); }  // columns of C
  /// Whether its directions are those of [x; λ].
  [[nodiscard]] bool reads_multipliers() const { return directions && directions->of_multipliers() != nullptr; }
};

/// A Gaussian process prior on the unconstrained acceleration (Geist & Trimpe 2020, sec. 4):
///
///     ā(x) = μ(x) + Σ_a E_a(x) C_a f_a(φ_a(x))
///
/// with exp(C_a f_a) in place of C_a f_a where a latent is positive, and E_a(x, λ) where its directions read the multipliers.
/// Immutable and cheap to copy.
struct Prior {
  enum class Mean {
    zero,      // μ = 0
    force,     // μ = M⁻¹F, the paper's μ_ā = a(x, θ)
    constant,  // μ = constant_mean
  };

  std::shared_ptr<const System> system;
  std::vector<Latent> latents;
  Mean mean = Mean::zero;
  Eigen::VectorXd constant_mean;  // (nq), of Mean::constant
  /// The system whose constraints predictions are held against, where the prior ignores them and `system` lacks them; null:
  /// `system` itself.
  std::shared_ptr<const System> reference = nullptr;

  [[nodiscard]] const System& reference_system() const { return reference ? *reference : *system; }

  /// Whether ā is no linear function of the latents: one acts through the multipliers that it changes, or by its exponential
  /// (theory.md, T46 and T47).
  [[nodiscard]] bool is_nonlinear() const;

  /// Which entries of a state the prior and the mechanics read (size layout().size()): the columns a data set must have.
  [[nodiscard]] std::vector<bool> reads() const;
};

/// @throws InputError when a prior is not whole: without a system, as one that was moved away, or with a latent whose kernel,
/// features, directions and columns do not fit each other.
void require_prior(const Prior& prior);

/// μ and E at N states, or their derivatives in one parameter.
struct PriorValues {
  Eigen::MatrixXd mean;                     // μ    (nq × N)
  std::vector<Eigen::MatrixXd> directions;  // E_a  (nq·p_a × N), column-major blocks, without the loadings C_a
  /// The first state at which the known force or a direction is not a finite number.
  std::optional<MechanicsBatch::Fault> fault = {};

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> E(std::size_t latent, int i) const {
    return {directions[latent].col(i).data(), mean.rows(), directions[latent].rows() / mean.rows()};
  }
};

/// φ_a at N states (N × D_a), one row per state: the layout kernels read.
/// @throws InputError when there is no such latent; and one that names the state where a feature is not a finite number, and the
/// feature.
Eigen::MatrixXd evaluate_features(const Prior& prior, std::size_t latent, const Eigen::Ref<const Eigen::MatrixXd>& states);

/// A number that is not finite is told by the `fault` of what is returned …
/// @param multipliers  λ of the motion at each state, for directions that read it (nc × N); null: λ₀
PriorValues evaluate_prior(const Prior& prior, const Eigen::Ref<const Eigen::MatrixXd>& states,
                           const Eigen::Ref<const Eigen::VectorXd>& parameters, const MechanicsBatch& mechanics,
                           const Eigen::MatrixXd* multipliers = nullptr);

/// … or here by an InputError that names the state.
PriorValues require_prior_values(const Prior& prior, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                 const Eigen::Ref<const Eigen::VectorXd>& parameters, const MechanicsBatch& mechanics,
                                 const Eigen::MatrixXd* multipliers = nullptr);

/// ∂μ/∂p and ∂E_a/∂p for parameter p = system parameters()[index], given the values and the system's derivative there.
PriorValues differentiate_prior(const Prior& prior, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                const Eigen::Ref<const Eigen::VectorXd>& parameters, const MechanicsBatch& mechanics,
                                const PriorValues& values, const SystemValues& derivative, int index,
                                const Eigen::MatrixXd* multipliers = nullptr);

}  // namespace gp2
