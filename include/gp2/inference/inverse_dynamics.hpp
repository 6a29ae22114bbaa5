#pragma once

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// The inputs that produce wanted accelerations, at N states.
struct InverseDynamics {
  Eigen::MatrixXd inputs;      // u: what acts       (nu × N)
  Eigen::MatrixXd covariance;  // of u at each state  (nu² × N), column-major blocks
  Eigen::MatrixXd missed;      // wanted − E[ddq] under these inputs  (d × N), rounding where the wanted can be produced

  [[nodiscard]] Eigen::MatrixXd stddev() const;  // (nu × N)
};

/// Inverse dynamics under the constraints: with v the viewed rows of E[ddq], and M' of UdwadiaKalaba in these rows and columns,
///
///     u = argmin (w − v(u))ᵀ M' (w − v(u)),
///
/// the inputs of which w comes where it can be produced, and else what is nearest to it in the sense of Gauss' principle. Where several inputs do
/// the same, the least change of them from where they start, each weighed by the acceleration that it makes. One solve where v is affine in
/// u; else Newton's method (Gauss–Newton where w cannot be produced), with steps halved until they help.
///
/// The covariance is J⁺ Σ J⁺ᵀ, Σ that of v, and J⁺ the inverse of J = ∂v/∂u in the same metric: exact where u enters no latent, of first
/// order in Σ else.
///
/// @param view           rows of ddq, of another system too
/// @param states         (layout size × N); their inputs are where the search begins, 0 where they are NaN
/// @param accelerations  w (d × N)
/// @throws InputError when the view is of something else, or the system has no inputs; and as Posterior::mean.
/// @throws NumericalError naming a state at which no inputs are found.
[[nodiscard]] InverseDynamics inverse_dynamics(const Posterior& posterior, const View& view,
                                               const Eigen::Ref<const Eigen::MatrixXd>& states,
                                               const Eigen::Ref<const Eigen::MatrixXd>& accelerations);

}  // namespace gp2
