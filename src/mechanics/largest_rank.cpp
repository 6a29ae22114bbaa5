#include "mechanics/largest_rank.hpp"

#include <algorithm>
#include <cmath>
#include <exception>
#include <vector>

#include <Eigen/QR>

#include "base/random.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

namespace {

// Whether each row of A is that of a constraint c = 0 of positions, which holds always, and has the residuals c and ċ.
bool are_of_positions(const System& system) {
  const std::vector<System::Residual>& labels = system.residual_labels();
  if (system.has_conditional_constraints() || std::ssize(labels) != 2 * system.nc()) return false;
  for (int k = 0; k < static_cast<int>(labels.size()); ++k) {
    const System::Residual& label = labels[static_cast<std::size_t>(k)];
    if (label.row != k / 2 || label.velocity != (k % 2 == 1)) return false;
  }
  return true;
}

// Moves a state onto constraints of positions, by Newton's method with the least change. False where this does not converge, or the
// residuals are not those of A.
bool meet_constraints(const System& system, const Eigen::VectorXd& parameters, Eigen::MatrixXd& state) {
  constexpr int max_iterations = 50;
  constexpr double redundant = 1e-8, met = 1e-8;  // of the largest singular value; of the lengths
  const Eigen::Index nq = system.nq();
  auto q = state.col(0).head(nq), dq = state.col(0).segment(nq, nq);
  SystemValues values;
  Eigen::VectorXd c, step;
  // the first of each constraint is c, the second ċ
  const auto find_residual = [&](int level) {
    c = system.residuals(state, parameters).reshaped(2, system.nc()).row(level).transpose();
    return c.allFinite();
  };
  const auto find_step = [&](int level) {
    system.evaluate_into(state, parameters, values);
    if (!find_residual(level) || !values.A(0).allFinite()) return false;
    Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd> decomposition;
    decomposition.setThreshold(redundant);
    step = -decomposition.compute(values.A(0)).solve(c);
    return step.allFinite();
  };
  bool has_converged = false;
  for (int iteration = 0; iteration < max_iterations && !has_converged; ++iteration) {
    if (!find_step(0)) return false;
    q += step;
    has_converged = step.norm() <= 1e-12 * (1 + q.norm());
  }
  // constraints that contradict each other have a nearest state too
  const Eigen::ArrayXd lengths = values.A(0).rowwise().norm();
  if (!has_converged || (c.array().abs() > met * (1 + q.norm()) * lengths).any() || !find_step(1)) return false;
  dq += step;
  // ċ is linear in dq: one step meets it, if A is ∂ċ/∂dq
  return find_residual(1) && c.cwiseAbs().maxCoeff() <= met * (1 + dq.norm()) * lengths.maxCoeff();
}

// A value beside that of a parameter, within its bounds.
double value_beside(const Parameter& parameter, double relative_change) {
  const double change = (parameter.value == 0 ? 1 : parameter.value) * relative_change;
  if (!parameter.bounds) return parameter.value + change;
  const double below = parameter.value - parameter.bounds->first, above = parameter.bounds->second - parameter.value;
  if (above >= below) return parameter.value + std::min(std::abs(change), above / 2);
  return parameter.value - std::min(std::abs(change), below / 2);
}

}  // namespace

int internal::find_largest_rank(const System& system, bool rows_may_vanish) {
  const int nc = system.nc();
  if (nc < 2 || !are_of_positions(system)) return nc;
  constexpr int n_starts = 16, enough = 4;  // states: a mechanism may be singular at some
  RandomStream random(0);
  int n_found = 0, largest = 0;
  for (int start = 0; start < n_starts && n_found < enough && largest < nc; ++start) {
    Eigen::MatrixXd state(system.layout().size(), 1);
    for (double& entry : state.reshaped()) entry = random.normal();
    // nor may rows follow from others at the model's own parameters alone, as where some are 0
    Eigen::VectorXd parameters = system.parameter_values();
    for (Eigen::Index k = 0; k < parameters.size() && start % 2 == 1; ++k) {
      parameters[k] = value_beside(system.parameters()[static_cast<std::size_t>(k)], 0.1 * random.normal());
    }
    try {
      if (!meet_constraints(system, parameters, state)) continue;
      SystemValues values;
      system.evaluate_into(state, parameters, values);
      const UdwadiaKalaba projection(values.M(0), values.A(0), values.b(0));
      if (!projection.motion_is_determined()) continue;
      if (projection.is_contradictory(values.F(0)) || (rows_may_vanish && projection.n_zero_rows() > 0)) return nc;
      ++n_found;
      largest = std::max(largest, projection.rank());
    } catch (const std::exception&) {
      // code may have no answer at a state of no log
    }
  }
  return n_found < enough || largest == 0 ? nc : largest;
}

}  // namespace gp2
