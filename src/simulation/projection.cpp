#include "simulation/projection.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// The metric M of the coordinates that may move. Where M is singular and the constraints of the level leave a massless direction,
// the least change has none of it: the diagonal entries, one where there is none, weigh it.
UdwadiaKalaba step_onto(MatrixXd M, const MatrixXd& A, const VectorXd& c) {
  UdwadiaKalaba step(M, A, c);
  if (step.mass_kind() != UdwadiaKalaba::Mass::undetermined) return step;
  const VectorXd weights = M.diagonal();
  for (Index j = 0; j < M.rows(); ++j) M(j, j) += weights[j] > 0 ? weights[j] : 1;
  step.compute(M, A, c);
  return step;
}

}  // namespace

ConstraintProjection::ConstraintProjection(const System& system, VectorXd parameters, const std::vector<bool>& held)
    : system_(system), parameters_(std::move(parameters)), position_(level_of(false, held)), velocity_(level_of(true, held)) {}

ConstraintProjection::Level ConstraintProjection::level_of(bool velocity, const std::vector<bool>& held) const {
  Level level;
  level.first = velocity ? system_.layout().dq(0) : system_.layout().q(0);
  const std::vector<System::Residual>& labels = system_.residual_labels();
  for (std::size_t k = 0; k < labels.size(); ++k) {
    if (labels[k].velocity != velocity) continue;
    level.residuals.push_back(static_cast<int>(k));
    level.rows.push_back(labels[k].row);
  }
  for (int j = 0; j < system_.nq(); ++j) {
    const int entry = level.first + j;
    if (!held.empty() && held[static_cast<std::size_t>(entry)]) continue;
    level.free.push_back(j);
    level.entries.push_back(entry);
  }
  return level;
}

bool ConstraintProjection::apply(VectorXd& state) const {
  const bool moved = apply(position_, state);
  return apply(velocity_, state) || moved;
}

MatrixXd ConstraintProjection::metric(const Level& level, const MatrixXd& M) const {
  if (weights_.size() == 0) return M(level.free, level.free);
  return VectorXd(weights_(level.entries)).asDiagonal();
}

bool ConstraintProjection::apply(const Level& level, VectorXd& state) const {
  if (level.residuals.empty()) return false;
  const VectorXd before = state;
  if (!newton(level, state)) return false;
  const bool to_nearest = weights_.size() > 0;
  if (level.rows.size() < 2 && !to_nearest) return true;

  // Of redundant rows the rank is right on the constraint only. Off it a row that should say nothing new moves the state along
  // the constraint as well; that part is taken back: x ← x + T (x_before − x). Repeated this leads to the nearest state, where
  // the way back is across the constraint.
  const auto n_rows = static_cast<Index>(level.rows.size());
  constexpr int most_repetitions = 50;
  constexpr double nearest = 1e-10;  // of the way to the constraint
  for (int k = 0; k < (to_nearest ? most_repetitions : 1); ++k) {
    const SystemValues values = system_.evaluate(state, parameters_);
    const UdwadiaKalaba here = step_onto(metric(level, values.M(0)), values.A(0)(level.rows, level.free), VectorXd::Zero(n_rows));
    if (!here.motion_is_determined() || (here.rank() == n_rows && !to_nearest)) return true;
    const VectorXd way = before(level.entries) - state(level.entries), back = here.T() * way;
    state(level.entries) += back;
    newton(level, state);
    if (back.norm() <= nearest * way.norm()) break;
  }
  return true;
}

// Far from a solution a Newton step may turn an angle many times and end at a distant solution. The first step turns no angle by more
// than 1 rad, each later one by at most twice as much as the one before.
double ConstraintProjection::share_of_step(const Level& level, const Ref<const VectorXd>& step, int iteration) const {
  if (level.first != system_.layout().q(0)) return 1;
  double longest = 0;
  for (std::size_t k = 0; k < level.free.size(); ++k) {
    if (system_.coordinates()[static_cast<std::size_t>(level.free[k])].angle)
      longest = std::max(longest, std::abs(step[static_cast<Index>(k)]));
  }
  return 1 / std::max(1.0, std::ldexp(longest, -iteration));
}

// x ← x − M⁻¹Aᵀ(A M⁻¹Aᵀ)⁺c, until c is rounding; x is q or dq, A = ∂c/∂q, which is also ∂ċ/∂dq
bool ConstraintProjection::newton(const Level& level, VectorXd& state) const {
  constexpr int max_iterations = 100;
  constexpr double at_rounding = 0.5 * std::numeric_limits<double>::epsilon();
  constexpr double converging = 1e-9;  // Newton's method is quadratic here: where it gains no more, rounding is reached
  const bool are_positions = level.first == system_.layout().q(0);
  double previous = std::numeric_limits<double>::infinity();
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    const SystemValues values = system_.evaluate(state, parameters_);
    const VectorXd c = system_.residuals(state, parameters_)(level.residuals, 0);
    const MatrixXd A = values.A(0)(level.rows, Eigen::all);
    if (!c.allFinite() || !A.allFinite()) fail(level, state);

    // |c| against what a relative change of x makes of it
    const VectorXd x = state.segment(level.first, system_.nq()).cwiseAbs();
    // Velocities are brought to rounding of their own size, since near rest b, quadratic in them, would else contradict itself; one of
    // them may be 0 but for rounding of the others.
    const double least_size = are_positions ? 1 : std::numeric_limits<double>::epsilon() * x.maxCoeff();
    const VectorXd scale = A.cwiseAbs() * x.cwiseMax(least_size);
    if ((c.array().abs() <= at_rounding * scale.array()).all()) return iteration > 0;
    const VectorXd coarse_scale = A.cwiseAbs() * x.cwiseMax(1);
    double off = 0;
    for (Index k = 0; k < c.size(); ++k) {
      off = std::max(off, std::abs(c[k]) / (coarse_scale[k] > 0 ? coarse_scale[k] : 1));
    }
    if (off <= converging && (off >= previous / 2 || level.free.empty())) return iteration > 0;
    if (level.free.empty()) fail(level, state);
    previous = off;

    const UdwadiaKalaba step = step_onto(metric(level, values.M(0)), A(Eigen::all, level.free), c);
    if (!step.motion_is_determined()) fail(level, state);
    state(level.entries) -= share_of_step(level, step.Lb(), iteration) * step.Lb();
  }
  fail(level, state);
}

void ConstraintProjection::fail(const Level& level, const VectorXd& state) const {
  const VectorXd all = system_.residuals(state, parameters_).col(0);
  const auto size = [&](int k) { return std::isfinite(all[k]) ? std::abs(all[k]) : std::numeric_limits<double>::infinity(); };
  const int worst =
      *std::max_element(level.residuals.begin(), level.residuals.end(), [&](int a, int b) { return size(a) < size(b); });
  throw NumericalError(fmt::format(
      "system '{}': the projection onto the constraints did not converge at t = {:.6g}: \"{}\" is off by {:.3g}", system_.name(),
      state[system_.layout().t()], system_.residual_labels()[static_cast<std::size_t>(worst)].text, all[worst]));
}

bool ConstraintProjection::has_redundant_rows(VectorXd state) const {
  if (system_.nc() < 2) return false;
  apply(state);
  const MechanicsBatch mechanics = evaluate_mechanics(system_, state, parameters_);
  return !mechanics.projections.empty() && mechanics.projections[0].motion_is_determined() &&
         ranks_of(system_, mechanics)[0].rank < system_.nc();
}

double ConstraintProjection::largest_residual(const Ref<const MatrixXd>& states, bool velocity) const {
  const std::vector<int>& rows = velocity ? velocity_.residuals : position_.residuals;
  if (rows.empty()) return 0;
  return system_.residuals(states, parameters_)(rows, Eigen::all).cwiseAbs().maxCoeff();
}

VectorXd project_onto_constraints(const System& system, const VectorXd& parameters, const Ref<const VectorXd>& state,
                                  const std::vector<bool>& held) {
  const int size = system.layout().size();
  if (state.size() != size || (!held.empty() && static_cast<int>(held.size()) != size)) {
    throw InputError(fmt::format("project_onto_constraints: a state of '{}' has {} entries, got {}{}", system.name(), size,
                                 state.size(), held.empty() ? "" : fmt::format(" and {} marks of what is held", held.size())));
  }
  VectorXd projected = state;
  ConstraintProjection(system, parameters, held).apply(projected);
  return projected;
}

}  // namespace gp2
