#pragma once

#include <vector>

#include "base/random.hpp"
#include "gp2/model.hpp"

namespace gp2 {

struct DrivenMotion {
  Eigen::MatrixXd states;         // (layout size × n)
  Eigen::MatrixXd accelerations;  // of its [truth] there; where dry friction holds a body those of rest (nq × n)
};

/// Entries of the state that are the real part, …_qw, of a quaternion of the model's robot: 1 where it is unturned.
std::vector<int> quaternion_real_parts(const Model& model);

/// n consecutive samples of a model's [motion]: its [truth] moves under a controller that knows its F only.
///
/// The task y(q) follows straight lines between random targets. Where a target ends the next begins. At each sample the
/// controller asks for ÿ = ÿ_r + 2 ζ ω (ẏ_r − ẏ) + ω² (y_r − y); the acceleration that gives it on the constraints, and otherwise
/// calls the arm back to its posture at the start, is the Udwadia–Kalaba equation with the rows of the task below those of A:
///
///     ddq* = L b + T ddq₀,   [A; J] ddq = [b; ÿ − J̇ dq],   ddq₀ = −2 ζ ω₀ dq − ω₀² (q − q_start),  ω₀ = ω/10
///
/// and its inputs are the smallest u, with the smallest λ, for which M ddq* = F(u) + Aᵀλ. They are held until the next sample.
///
/// @throws NumericalError when the motion cannot go on.
DrivenMotion generate_motion(const Model& model, int n, RandomStream& random);

}  // namespace gp2
