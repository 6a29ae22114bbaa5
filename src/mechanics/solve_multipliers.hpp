#pragma once

#include <functional>
#include <optional>

#include <Eigen/Core>

#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

/// ā(λ) (nq) and ∂ā/∂λ (nq × nc): forces that follow from the multipliers of the motion.
using MotionUnderLoad = std::function<void(const Eigen::VectorXd& lambda, Eigen::VectorXd& a_bar, Eigen::MatrixXd& slope)>;

/// The multipliers under forces that they change themselves (theory.md, T46):
///
///     λ = G ā(λ) + d,    G = −(A M⁻¹Aᵀ)⁺A,    d = (A M⁻¹Aᵀ)⁺ b.
///
/// @returns the solution that is reached from forces without load; nothing where det(I − G ∂ā/∂λ) ≤ 0 on the way there: the load
/// grows with the force it causes as fast as that force, so that there is no motion, or more than one (Painlevé's paradox).
std::optional<Eigen::VectorXd> solve_multipliers(const Eigen::Ref<const Eigen::MatrixXd>& G,
                                                 const Eigen::Ref<const Eigen::VectorXd>& d, const MotionUnderLoad& motion);

/// What is wrong with a state that has none.
MechanicsBatch::Fault no_multipliers(int state);

}  // namespace gp2
