#pragma once

#include <memory>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// The inputs that produce wanted accelerations, at N states.
struct InverseDynamics {
  Eigen::MatrixXd inputs;      // u: what acts       (nu × N)
  Eigen::MatrixXd covariance;  // of u at each state  (nu² × N), column-major blocks
  Eigen::MatrixXd missed;      // wanted − E[ddq] under these inputs  (d × N), rounding where the wanted can be produced
  /// Whether w leaves an input open: others do the same, or none is needed  (nu × N). Its covariance says nothing of them.
  Eigen::Array<bool, Eigen::Dynamic, Eigen::Dynamic> open;

  [[nodiscard]] Eigen::MatrixXd stddev() const;  // (nu × N)
};

/// Inverse dynamics under the constraints: with v the viewed rows of E[ddq], and M' of UdwadiaKalaba in these rows and columns,
///
///     u = argmin (w − v(u))ᵀ M' (w − v(u)),
///
/// the inputs of which w comes where it can be produced, and else what is nearest to it in the sense of Gauss' principle. Where several inputs do
/// the same, the least change of them from where they start, each beside its usual size, the root of its mean square in the data; one that
/// is 0 in all data is asked for little but what the others cannot do, and without data each is weighed by the acceleration that it makes. Inputs that
/// say whether a constraint holds, those of contacts and those that a condition reads and no force does, stay. One solve where v is affine in
/// u; else Newton's method from where they start, with steps damped where they do not help: the nearest of those about it.
/// A step may lead beyond the data, to where what latents say of an input has died away and no input changes v: such inputs are given
/// too, and miss more than others may.
///
/// The covariance is J⁺ Σ J⁺ᵀ, Σ that of v, and J⁺ the inverse of J = ∂v/∂u in the same metric: exact where u enters no latent, of first
/// order in Σ else. Where an input turns around what it does J loses rank, and it is immense or NaN.
///
/// @param view           rows of ddq, of another system too
/// @param states         (layout size × N); their inputs are where the search begins: 0 where NaN, beside it where one does nothing
/// @param accelerations  w (d × N)
/// @throws InputError when the view is of something else, or the system has no inputs; and as Posterior::mean.
/// @throws NumericalError naming a state at which no inputs are found.
[[nodiscard]] InverseDynamics inverse_dynamics(const Posterior& posterior, const View& view,
                                               const Eigen::Ref<const Eigen::MatrixXd>& states,
                                               const Eigen::Ref<const Eigen::MatrixXd>& accelerations);

/// The same at one state after another, for control loops: as a Predictor it allocates nothing, takes no locks and calls no BLAS.
/// Which inputs are left open, as InverseDynamics::open says, it does not tell.
/// Where v is affine in u a call costs two to four predictions of v with its Jacobian; their covariance is one more.
///
/// Immutable, cheap to copy, thread-safe. Every member function throws InputError when the object was moved away.
class InverseDynamicsSolver {
 public:
  struct Options {
    bool covariance = true;  // whether inputs_and_covariance is wanted: stores as Predictor::Options::stddev does
    Predictor::Storage storage = Predictor::Storage::double_precision;
  };

  /// For every row of ddq.
  explicit InverseDynamicsSolver(const Posterior& posterior);
  /// @throws InputError as inverse_dynamics.
  InverseDynamicsSolver(const Posterior& posterior, const View& view);
  InverseDynamicsSolver(const Posterior& posterior, const View& view, Options options);

  struct Implementation;

  /// Memory of the functions below; one per thread. It keeps what it needs of its solver alive.
  class Workspace {
   public:
    explicit Workspace(const InverseDynamicsSolver& solver);
    ~Workspace();
    Workspace(Workspace&&) noexcept;
    Workspace& operator=(Workspace&&) noexcept;

    /// Wanted − E[ddq] under the inputs found by the last call  (d); NaN where none were found.
    [[nodiscard]] const Eigen::VectorXd& missed() const;

    struct Implementation;

   private:
    friend class InverseDynamicsSolver;
    std::unique_ptr<Implementation> implementation_;
  };
  [[nodiscard]] Workspace make_workspace() const { return Workspace(*this); }

  /// Where there are no inputs they are NaN, and this says why.
  enum class Status {
    ok,
    no_prediction,  // at the state and the inputs where the search begins: Predictor::mean_and_jacobian says why
    not_finite,     // an acceleration that is wanted
    not_found,      // inputs that produce the accelerations, or come nearest to them
  };

  /// u at a state.
  /// @param state          (layout size), contiguous; its inputs are where the search begins, 0 where they are NaN
  /// @param accelerations  w (d)
  /// @param inputs         u (nu), which may be those of `state`
  /// @throws InputError when a size is wrong or `workspace` is of another solver; so does the function below.
  [[nodiscard]] Status inputs(const Eigen::Ref<const Eigen::VectorXd>& state,
                              const Eigen::Ref<const Eigen::VectorXd>& accelerations, Eigen::Ref<Eigen::VectorXd> inputs,
                              Workspace& workspace) const;

  /// And their covariance (nu × nu).
  /// @throws InputError when options().covariance is false.
  [[nodiscard]] Status inputs_and_covariance(const Eigen::Ref<const Eigen::VectorXd>& state,
                                             const Eigen::Ref<const Eigen::VectorXd>& accelerations,
                                             Eigen::Ref<Eigen::VectorXd> inputs, Eigen::Ref<Eigen::MatrixXd> covariance,
                                             Workspace& workspace) const;

  [[nodiscard]] const View& view() const;
  [[nodiscard]] const Options& options() const;

 private:
  [[nodiscard]] const Implementation& implementation() const;  // throws when it was moved away

  std::shared_ptr<const Implementation> implementation_;
};

}  // namespace gp2
