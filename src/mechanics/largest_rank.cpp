#include "mechanics/largest_rank.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <optional>
#include <vector>

#include <Eigen/QR>

#include "base/random.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

namespace {

// Constraints c = 0 of positions that hold always.
struct UnconditionalRows {
  std::vector<int> rows;                      // of A
  std::array<std::vector<int>, 2> residuals;  // which of System::residuals are their c, their ċ
};

// Nothing where a constraint that holds always is not of positions, or lacks its residuals.
std::optional<UnconditionalRows> find_unconditional_rows(const System& system) {
  UnconditionalRows found;
  for (int row = 0; row < system.nc(); ++row) {
    if (!system.is_conditional(row)) found.rows.push_back(row);
  }
  std::array<std::vector<int>, 2> rows;  // of the residuals
  const std::vector<System::Residual>& labels = system.residual_labels();
  for (int k = 0; k < static_cast<int>(labels.size()); ++k) {
    const System::Residual& label = labels[static_cast<std::size_t>(k)];
    if (system.is_conditional(label.row)) continue;
    found.residuals[label.velocity ? 1 : 0].push_back(k);
    rows[label.velocity ? 1 : 0].push_back(label.row);
  }
  if (rows[0] != found.rows || rows[1] != found.rows) return std::nullopt;
  return found;
}

// Moves a state onto constraints of positions, by Newton's method with the least change. False where this does not converge, or the
// residuals are not those of A.
bool meet_constraints(const System& system, const UnconditionalRows& unconditional, const Eigen::VectorXd& parameters,
                      Eigen::MatrixXd& state) {
  constexpr int max_iterations = 50;
  constexpr double redundant = 1e-8, met = 1e-8;  // of the largest singular value; of the lengths
  const Eigen::Index nq = system.nq();
  auto q = state.col(0).head(nq), dq = state.col(0).segment(nq, nq);
  SystemValues values;
  Eigen::MatrixXd A;
  Eigen::VectorXd c, step;
  const auto find_residual = [&](std::size_t level) {  // of positions, of velocities
    c = system.residuals(state, parameters).col(0)(unconditional.residuals[level]);
    return c.allFinite();
  };
  const auto find_step = [&](std::size_t level) {
    system.evaluate_into(state, parameters, values);
    A = values.A(0)(unconditional.rows, Eigen::all);
    if (!find_residual(level) || !A.allFinite()) return false;
    Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd> decomposition;
    decomposition.setThreshold(redundant);
    step = -decomposition.compute(A).solve(c);
    return step.allFinite();
  };
  bool has_converged = false;
  for (int iteration = 0; iteration < max_iterations && !has_converged; ++iteration) {
    if (!find_step(0)) return false;
    q += step;
    has_converged = step.norm() <= 1e-12 * (1 + q.norm());
  }
  // constraints that contradict each other have a nearest state too
  const Eigen::ArrayXd lengths = A.rowwise().norm();
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
  const std::optional<UnconditionalRows> unconditional = find_unconditional_rows(system);
  if (!unconditional || unconditional->rows.size() < 2) return nc;
  const auto n_unconditional = static_cast<int>(unconditional->rows.size());
  constexpr int n_starts = 16, enough = 4;  // states: a mechanism may be singular at some
  RandomStream random(0);
  int n_found = 0, largest = 0;
  for (int start = 0; start < n_starts && n_found < enough && largest < n_unconditional; ++start) {
    Eigen::MatrixXd state(system.layout().size(), 1);
    for (double& entry : state.reshaped()) entry = random.normal();
    // nor may rows follow from others at the model's own parameters alone, as where some are 0
    Eigen::VectorXd parameters = system.parameter_values();
    for (Eigen::Index k = 0; k < parameters.size() && start % 2 == 1; ++k) {
      parameters[k] = value_beside(system.parameters()[static_cast<std::size_t>(k)], 0.1 * random.normal());
    }
    try {
      if (!meet_constraints(system, *unconditional, parameters, state)) continue;
      SystemValues values;
      system.evaluate_into(state, parameters, values);
      const UdwadiaKalaba projection(values.M(0), values.A(0)(unconditional->rows, Eigen::all), values.b(0)(unconditional->rows));
      if (!projection.motion_is_determined()) continue;
      if (projection.is_contradictory(values.F(0)) || (rows_may_vanish && projection.n_zero_rows() > 0)) return nc;
      ++n_found;
      largest = std::max(largest, projection.rank());
    } catch (const std::exception&) {
      // code may have no answer at a state of no log
    }
  }
  return n_found < enough || largest == 0 ? nc : largest + nc - n_unconditional;
}

}  // namespace gp2
