#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// Predictions of one view at one state after another, for control loops: mean, standard deviation, and the mean's Jacobian in
/// the state. They allocate nothing, take no locks and call no BLAS, as long as the system is a SymbolicSystem (which every
/// [mechanics] of a model file is); any other may allocate where it evaluates M, A, b, F, and so do
/// products of matrices of more than a hundred coordinates.
///
/// With β of posterior.hpp and the factored matrix L Lᵀ = K̃ + I,
///
///     mean     = G (μ + Σ_a E_a C_a Σ_j k_a(φ, φ_j) β_j,a) + d
///     variance = Σ_a ℓ_aᵀ ℓ_a k_a(φ, φ) − |L⁻¹c|²,    ℓ_a = (G E_a C_a)ᵀ,  c = Σ_a k̃_a ℓ_a the covariance with ỹ.
///
/// A ddq = b of a constrained mean, and dA ddq + A dddq = db of its Jacobian, hold to rounding.
///
/// L is solved with, by whole vectors of entries that are known: n²/2 multiplications per row of the view, as many as a product with an
/// explicit inverse, which would be off by κ(L) times as much. What the solution finds is |L⁻¹c|² of an L Lᵀ that is off by rounding
/// (Higham 2002, ch. 8): by n ε αᵀ|L||Lᵀ|α, α = (L Lᵀ)⁻¹c, little where the data are near and the noise far below the signal, so that the
/// variance is a small difference. Through inducing points |X c|² stands in its place (theory.md, T37). A variance that rounding makes
/// negative is 0.
///
/// Of a mixture they are its moments, at the cost of one prediction for each of its components.
///
/// Immutable, cheap to copy, thread-safe; it holds its own copy of what it needs of the posterior. Every member function throws
/// InputError when the predictor was moved away.
class Predictor {
 public:
  enum class Storage {
    double_precision,
    /// The features, β and L of the observations in single precision, and the sums over them too: half the memory, and faster
    /// where the observations are many. Mechanics and constraints stay in double precision: A ddq = b holds as before. Kernels
    /// other than `se` are evaluated in double precision, then rounded. With e = 6e-8, half the spacing of floats at 1, D
    /// features, and r_j the distance of observation j in lengthscales, Σ_j k_j β_j of one latent function is off by at most
    ///
    ///     e Σ_j |k_j β_j| (N/8 + 16 + r_j² (D + 4) + 4 r_j R),    R: the largest distance from their centre, in lengthscales
    ///
    /// which is large against the mean where lengthscales are long and noise is low, since the β_j then cancel. A variance is
    /// off by O(√n e) of the prior's: standard deviations below some 1e-3 of the prior's are not resolved. On the surface model
    /// (benchmarks/predictor_benchmark.cpp) means at 500 states are off by at most 9e-6 of the spread of ddq at N = 100 and
    /// 9e-5 at N = 1000, standard deviations by 2e-6 and 3e-5.
    single_precision,
  };
  struct Options {
    bool stddev = true;    // whether mean_and_stddev or mean_and_covariance is wanted: stores L, n²/2 numbers
    bool jacobian = true;  // whether mean_and_jacobian is wanted
    Storage storage = Storage::double_precision;
  };

  /// Predicts every row of the constrained acceleration ddq.
  explicit Predictor(const Posterior& posterior);
  /// @throws InputError as require_view.
  Predictor(const Posterior& posterior, View view);
  Predictor(const Posterior& posterior, View view, Options options);

  struct Implementation;

  /// Memory of the functions below; one per thread. It keeps what it needs of its predictor alive.
  class Workspace {
   public:
    explicit Workspace(const Predictor& predictor);
    ~Workspace();
    Workspace(Workspace&&) noexcept;
    Workspace& operator=(Workspace&&) noexcept;

    struct Implementation;

   private:
    friend class Predictor;
    std::vector<std::unique_ptr<Implementation>> components_;
  };
  [[nodiscard]] Workspace make_workspace() const { return Workspace(*this); }

  /// What a state is like. A loop has to go on, so a state that has no prediction is no exception: the numbers are NaN, and this
  /// says why.
  enum class Status {
    ok,
    mass_not_positive_definite,     // nor semidefinite
    motion_undetermined,            // M is singular, and the constraints leave a direction in which nothing determines ddq
    no_unconstrained_acceleration,  // M is singular, and the view or a latent is of ā
    contradicting_constraints,      // no acceleration satisfies A ddq = b
    not_finite,                     // an entry of the state that is read, or what an expression or its derivative makes of it
  };

  /// E[view] at a state.
  /// @param state  (layout size), contiguous
  /// @param mean   (d)
  /// @throws InputError when a size is wrong or `workspace` is of another predictor; so do those below.
  [[nodiscard]] Status mean(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> mean,
                            Workspace& workspace) const;

  /// And the standard deviation of each row: of the latent quantity, not of the next measurement.
  /// @param stddev  (d)
  /// @throws InputError when options().stddev is false.
  [[nodiscard]] Status mean_and_stddev(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> mean,
                                       Eigen::Ref<Eigen::VectorXd> stddev, Workspace& workspace) const;

  /// And the covariance of the rows (d × d) in the place of their standard deviations.
  /// @throws InputError as mean_and_stddev.
  [[nodiscard]] Status mean_and_covariance(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> mean,
                                           Eigen::Ref<Eigen::MatrixXd> covariance, Workspace& workspace) const;

  /// And the derivative of the mean in the state, through M, A, b, F, directions and features. With the multipliers λ,
  /// Aᵀλ = M (ddq − ā),
  ///
  ///     dddq = T (dā + M⁻¹(dM (ā − ddq) + dAᵀλ)) + L (db − dA ddq)
  ///
  /// (where M is singular dF̄ − dM ddq + dAᵀλ instead of M dā + dM (ā − ddq) + dAᵀλ), which is exact wherever the rank of A is the
  /// same around the state; so are the multipliers of least norm of redundant rows, and their derivative. As good as the system's
  /// derivatives: see state_evaluator.hpp, also for |v| at v = 0.
  /// @param jacobian  (d × layout size), columns in the order of StateLayout: [q; dq; t; u]
  /// @throws InputError when options().jacobian is false.
  [[nodiscard]] Status mean_and_jacobian(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> mean,
                                         Eigen::Ref<Eigen::MatrixXd> jacobian, Workspace& workspace) const;

  /// As Posterior::distance_from_data at a state, at the cost of a sum over the observed ones; NaN where a feature is not finite.
  /// It says what the standard deviation cannot: that nothing like this state was seen.
  [[nodiscard]] double distance_from_data(const Eigen::Ref<const Eigen::VectorXd>& state, Workspace& workspace) const;

  [[nodiscard]] const View& view() const;
  [[nodiscard]] const Options& options() const;

 private:
  [[nodiscard]] const Implementation& implementation() const;  // of the first component; throws when it was moved away
  Status evaluate_covariance(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd>& mean,
                             Workspace& workspace) const;
  template <typename Evaluate>
  Status for_each_component(Workspace& workspace, Eigen::Ref<Eigen::VectorXd>& mean, const Evaluate& evaluate) const;

  std::vector<std::shared_ptr<const Implementation>> components_;
};

}  // namespace gp2
