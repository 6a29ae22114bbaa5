#include "smoothing/constrained_states.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Cholesky>
#include <Eigen/QR>

#include "base/decompositions.hpp"
#include "base/not_a_number.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double rank_tolerance = 1e-10;
// Rows that depend on each other where the constraints are met do no longer where they are not: what is then left of their gradients is
// small, as is what is left of their residuals, and says nothing.
constexpr double dependent = 0.1;

Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition_of(const MatrixXd& A, double tolerance = rank_tolerance) {
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
  decomposition.setThreshold(tolerance);
  decomposition.compute(A);
  return decomposition;
}

Index rank_of(const MatrixXd& A) { return A.size() == 0 ? 0 : decomposition_of(A).rank(); }

// orthonormal columns that span {x: A x = 0}
MatrixXd null_space(const MatrixXd& A) {
  const Index n = A.cols();
  if (A.rows() == 0 || n == 0) return MatrixXd::Identity(n, n);
  Eigen::ColPivHouseholderQR<MatrixXd> qr;
  qr.setThreshold(rank_tolerance);
  qr.compute(A.transpose());
  return (qr.householderQ() * MatrixXd::Identity(n, n)).rightCols(n - qr.rank());
}

// entries of a state that stay as they are while the others are solved for
std::vector<bool> held_entries(const System& system, const std::vector<int>& measured, const std::vector<int>& blind) {
  const StateLayout layout = system.layout();
  std::vector<bool> held(static_cast<std::size_t>(layout.size()), false);
  for (const int j : measured) held[static_cast<std::size_t>(layout.q(j))] = held[static_cast<std::size_t>(layout.dq(j))] = true;
  for (const int j : blind) held[static_cast<std::size_t>(layout.q(j))] = true;
  for (int k = layout.t(); k < layout.size(); ++k) held[static_cast<std::size_t>(k)] = true;
  return held;
}

std::vector<int> others(int n, const std::vector<int>& some) {
  std::vector<int> out;
  for (int j = 0; j < n; ++j) {
    if (std::find(some.begin(), some.end(), j) == some.end()) out.push_back(j);
  }
  return out;
}

std::vector<int> positions_that(bool are_read, const System& system, std::vector<int> among) {
  std::erase_if(among, [&](int j) {
    const auto entry = static_cast<std::size_t>(system.layout().q(j));
    const auto is_read = [&](SystemPart part) -> bool { return system.reads(part)[entry]; };
    return are_read != (is_read(SystemPart::mechanics) || is_read(SystemPart::force) || is_read(SystemPart::residuals));
  });
  return among;
}

// code need not bear a NaN where it reads nothing
VectorXd without_blind(const VectorXd& state) { return state.array().isNaN().select(0, state); }

}  // namespace

ConstrainedStates::ConstrainedStates(const Model& model, std::vector<int> measured)
    : system_(*model.system),
      parameters_(model.system->parameter_values()),
      measured_(std::move(measured)),
      free_(others(system_.nq(), measured_)),
      seen_(positions_that(true, system_, free_)),
      blind_(positions_that(false, system_, free_)),
      held_(held_entries(system_, measured_, blind_)),
      projection_(system_, parameters_, held_) {
  for (std::size_t k = 0; k < system_.residual_labels().size(); ++k) {
    const System::Residual& label = system_.residual_labels()[k];
    (label.velocity ? velocity_rows_ : position_rows_).push_back(label.row);
    (label.velocity ? velocity_residuals_ : position_residuals_).push_back(static_cast<int>(k));
  }
}

VectorXd ConstrainedStates::completed_acceleration(const VectorXd& state, VectorXd acceleration) const {
  const SystemValues values = system_.evaluate(state, parameters_);
  const MatrixXd A = values.A(0);
  const VectorXd rest = values.b(0) - A(Eigen::all, measured_) * acceleration(measured_);
  const VectorXd solved = decomposition_of(A(Eigen::all, free_)).solve(rest);
  acceleration(free_) = solved;
  return acceleration;
}

void ConstrainedStates::complete(VectorXd& state, Eigen::Ref<VectorXd> acceleration) const {
  if (free_.empty()) return;
  state = without_blind(state);
  projection_.apply(state);
  acceleration = completed_acceleration(state, acceleration);
  for (const int j : blind_) state[system_.layout().q(j)] = not_a_number;
}

void ConstrainedStates::approach(VectorXd& state, Eigen::Ref<VectorXd> acceleration) const {
  if (free_.empty()) return;
  state = without_blind(state);
  const auto residuals = [&](const std::vector<int>& which) -> VectorXd {
    return system_.residuals(state, parameters_)(which, 0);
  };
  constexpr int max_iterations = 50;
  constexpr double close = 1e-12;
  for (int iteration = 0; iteration < max_iterations && !seen_.empty() && !position_rows_.empty(); ++iteration) {
    const MatrixXd A = system_.evaluate(state, parameters_).A(0);
    const VectorXd step = decomposition_of(A(position_rows_, seen_)).solve(residuals(position_residuals_));
    if (!step.allFinite()) break;
    state(seen_) -= step;  // coordinates come first in a state
    if (step.cwiseAbs().maxCoeff() <= close * (1 + state(seen_).cwiseAbs().maxCoeff())) break;
  }
  if (!velocity_rows_.empty()) {
    const MatrixXd A = system_.evaluate(state, parameters_).A(0);
    const VectorXd step = decomposition_of(A(velocity_rows_, free_)).solve(residuals(velocity_residuals_));
    for (std::size_t k = 0; k < free_.size(); ++k) state[system_.layout().dq(free_[k])] -= step[static_cast<Index>(k)];
  }
  acceleration = completed_acceleration(state, acceleration);
  for (const int j : blind_) state[system_.layout().q(j)] = not_a_number;
}

int ConstrainedStates::redundancy(const VectorXd& state) const {
  const MatrixXd A = system_.evaluate(without_blind(state), parameters_).A(0);
  std::vector<std::string> open;
  const auto find_open = [&](const std::vector<int>& rows, const std::vector<int>& unknown, const auto& name) {
    const MatrixXd moves = null_space(A(rows, unknown));
    for (std::size_t j = 0; j < unknown.size(); ++j) {
      if (moves.row(static_cast<Index>(j)).norm() > 1e-8)
        open.push_back(name(system_.coordinates()[static_cast<std::size_t>(unknown[j])]));
    }
  };
  find_open(position_rows_, seen_, [](const Coordinate& coordinate) { return coordinate.name; });
  if (open.empty()) {
    find_open(velocity_rows_, free_, [](const Coordinate& coordinate) { return coordinate.velocity(); });
  }
  if (!open.empty()) {
    throw InputError(fmt::format(
        "the log has no column for {}, and the constraints of '{}' do not decide {} from what it has; log {}{}, or "
        "name {} with `map=LOGNAME={}`",
        fmt::join(open, ", "), system_.name(), open.size() > 1 ? "them" : "it", open.size() > 1 ? "one or more of " : "",
        fmt::join(open, ", "), open.size() > 1 ? "their columns" : "its column", open.front()));
  }
  return static_cast<int>(rank_of(A) - rank_of(A(Eigen::all, free_)));
}

std::vector<int> ConstrainedStates::independent_accelerations(const VectorXd& state, const VectorXd& stddev) const {
  // all accelerations that A allows are Z times n − rank A numbers: rows of Z that are far from singular, by greedy choice, say all
  const MatrixXd A = system_.evaluate(without_blind(state), parameters_).A(0);
  const MatrixXd Z = stddev.cwiseInverse().asDiagonal() * null_space(A)(measured_, Eigen::all);
  const Eigen::ColPivHouseholderQR<MatrixXd> qr(Z.transpose());
  std::vector<int> chosen;
  for (Index k = 0; k < std::min(Z.rows(), Z.cols()); ++k)
    chosen.push_back(measured_[static_cast<std::size_t>(qr.colsPermutation().indices()[k])]);
  return chosen;
}

ConstrainedStates::Linearisation ConstrainedStates::linearise(const VectorXd& state, const VectorXd& acceleration) const {
  const Index nq = system_.nq(), nc = system_.nc();
  const auto n_position = static_cast<Index>(position_rows_.size()), n_velocity = static_cast<Index>(velocity_rows_.size());
  // central differences in q and dq, all in one batch
  const VectorXd steps = (std::numeric_limits<double>::epsilon() * state.head(2 * nq).array().abs().max(1)).pow(1.0 / 3);
  MatrixXd states = state.replicate(1, 1 + 4 * nq);
  for (Index k = 0; k < 2 * nq; ++k) {
    states(k, 1 + 2 * k) += steps[k];
    states(k, 2 + 2 * k) -= steps[k];
  }
  const SystemValues values = system_.evaluate(states, parameters_);
  MatrixXd residuals(n_position + n_velocity + nc, states.cols());
  const MatrixXd off = system_.residuals(states, parameters_);
  residuals.topRows(n_position) = off(position_residuals_, Eigen::all);
  residuals.middleRows(n_position, n_velocity) = off(velocity_residuals_, Eigen::all);
  for (Index i = 0; i < states.cols(); ++i) {
    residuals.col(i).tail(nc) = values.A(static_cast<int>(i)) * acceleration - values.b(static_cast<int>(i));
  }
  Linearisation out{residuals.col(0), MatrixXd::Zero(residuals.rows(), 3 * nq)};
  for (Index k = 0; k < 2 * nq; ++k) {
    out.jacobian.col(k) = (residuals.col(1 + 2 * k) - residuals.col(2 + 2 * k)) / (2 * steps[k]);
  }
  const MatrixXd A = values.A(0);
  out.jacobian.topLeftCorner(n_position, nq) = A(position_rows_, Eigen::all);
  out.jacobian.block(n_position, nq, n_velocity, nq) = A(velocity_rows_, Eigen::all);
  out.jacobian.bottomRightCorner(nc, nq) = A;
  return out;
}

namespace {

// (q, dq, ddq) of a coordinate, in z
auto entries_of(int coordinate, Index nq) { return Eigen::seqN(coordinate, 3, nq); }

// W, so that measured entries of z are ẑ + W w, w ~ N(0, I)
MatrixXd root_of(const std::vector<Eigen::Matrix3d>& covariance, const std::vector<int>& measured, Index nq) {
  const Index n_measured = static_cast<Index>(measured.size());
  MatrixXd W = MatrixXd::Zero(3 * nq, 3 * n_measured);
  for (Index k = 0; k < n_measured; ++k) {
    const Eigen::Matrix3d root = covariance[static_cast<std::size_t>(k)].llt().matrixL();
    W(entries_of(measured[static_cast<std::size_t>(k)], nq), Eigen::seqN(3 * k, 3)) = root;
  }
  return W;
}

// entries of z that are solved for: free coordinates, of whose positions only those that are read
std::vector<Index> unknown_entries(const std::vector<int>& free, const std::vector<int>& seen, Index nq) {
  std::vector<Index> unknown;
  for (Index a = 0; a < 3; ++a) {
    for (const int j : free) {
      if (a > 0 || std::find(seen.begin(), seen.end(), j) != seen.end()) unknown.push_back(a * nq + j);
    }
  }
  return unknown;
}

// how far measured entries of z are from their estimate; 0 elsewhere
VectorXd offset_of_measured(const std::vector<int>& measured, const VectorXd& estimate, const VectorXd& z) {
  const Index nq = z.size() / 3;
  VectorXd known_off = VectorXd::Zero(3 * nq);
  for (const int j : measured) known_off(entries_of(j, nq)) = (estimate - z)(entries_of(j, nq));
  return known_off;
}

// factors that bring rows to the units of what was measured, so that rank is a matter of directions
VectorXd row_scale_of(const MatrixXd& J_measured, const MatrixXd& jacobian) {
  VectorXd scale = J_measured.rowwise().norm();
  for (Index i = 0; i < scale.size(); ++i) {
    if (!(scale[i] > 0)) scale[i] = jacobian.row(i).norm();
    scale[i] = scale[i] > 0 ? 1 / scale[i] : 0;
  }
  return scale;
}

// A step to the most likely z that meets the linearised constraints, and what they say of w: B w is given.
struct ConditionedStep {
  VectorXd step;
  VectorXd known;  // w
  MatrixXd B;
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> constraints;  // of B
};

ConditionedStep conditioned_step(const VectorXd& residual, const MatrixXd& jacobian, const MatrixXd& W,
                                 const std::vector<Index>& unknown, const VectorXd& known_off, double tolerance) {
  MatrixXd J_measured = jacobian * W;
  const VectorXd scale = row_scale_of(J_measured, jacobian);
  J_measured = scale.asDiagonal() * J_measured;
  const MatrixXd J_unknown = scale.asDiagonal() * jacobian(Eigen::all, unknown);
  const MatrixXd U = null_space(J_unknown.transpose());  // combinations of constraints that no unknown enters
  ConditionedStep out;
  out.B = U.transpose() * J_measured;
  const VectorXd wanted = -scale.cwiseProduct(residual + jacobian * known_off);
  out.constraints = decomposition_of(out.B, tolerance);
  out.known = out.B.rows() > 0 ? VectorXd(out.constraints.solve(U.transpose() * wanted)) : VectorXd::Zero(W.cols());
  out.step = known_off + W * out.known;
  if (!unknown.empty()) {
    const VectorXd left = wanted - J_measured * out.known;
    const VectorXd solved = decomposition_of(J_unknown).solve(left);
    out.step(unknown) = solved;
  }
  return out;
}

// what the constraints leave of the covariance of each measured coordinate
void condition_covariance(const ConditionedStep& at, const MatrixXd& W, const std::vector<int>& measured,
                          std::vector<Eigen::Matrix3d>& covariance) {
  const Index nq = W.rows() / 3;
  MatrixXd kept = MatrixXd::Identity(W.cols(), W.cols());
  if (at.B.rows() > 0) kept -= at.constraints.pseudoInverse() * at.B;
  const MatrixXd all = W * kept * W.transpose();
  for (std::size_t k = 0; k < measured.size(); ++k) covariance[k] = all(entries_of(measured[k], nq), entries_of(measured[k], nq));
}

}  // namespace

ConstrainedStates::Contradiction ConstrainedStates::contradiction(const VectorXd& state, const VectorXd& acceleration,
                                                                  const VectorXd& stddev) const {
  const Index nq = system_.nq();
  const VectorXd x = without_blind(state);
  const Linearisation at = linearise(x, acceleration);
  // c, and of the constraints of velocities those that are no ċ
  std::vector<Index> rows;
  const auto n_position = static_cast<Index>(position_rows_.size());
  for (Index k = 0; k < n_position; ++k) rows.push_back(k);
  for (std::size_t k = 0; k < velocity_rows_.size(); ++k) {
    if (std::find(position_rows_.begin(), position_rows_.end(), velocity_rows_[k]) == position_rows_.end())
      rows.push_back(n_position + static_cast<Index>(k));
  }
  Contradiction out{.move = VectorXd::Zero(2 * nq)};
  const VectorXd residual = at.residual(rows);
  const MatrixXd jacobian = at.jacobian(rows, Eigen::all);
  if (rows.empty() || !residual.allFinite() || !jacobian.allFinite()) return out;
  MatrixXd W = MatrixXd::Zero(3 * nq, 2 * static_cast<Index>(measured_.size()));
  Index column = 0;
  for (const int j : measured_) {
    for (const Index entry : {Index{j}, nq + j}) W(entry, column++) = stddev[entry];
  }
  const std::vector<Index> unknown = unknown_entries(free_, seen_, nq);
  const ConditionedStep step = conditioned_step(residual, jacobian, W, unknown, VectorXd::Zero(3 * nq), dependent);
  if (step.B.rows() == 0 || step.constraints.rank() == 0) return out;
  out.n_constraints = static_cast<int>(step.constraints.rank());
  out.size = step.known.norm() / std::sqrt(static_cast<double>(out.n_constraints));
  VectorXd w = step.known;
  if (out.n_constraints == 1) {
    // B w = c, of which the likeliest is w = Bᵀ c/(B Bᵀ): entry k alone would be c/B_k = |w|²/w_k
    for (double& one : w) one = one != 0 ? step.known.squaredNorm() / one : 0;
  }
  out.move = (W * w).head(2 * nq);
  return out;
}

void ConstrainedStates::condition(VectorXd& state, Eigen::Ref<VectorXd> acceleration,
                                  std::vector<Eigen::Matrix3d>& covariance) const {
  const Index nq = system_.nq();
  const MatrixXd W = root_of(covariance, measured_, nq);
  const std::vector<Index> unknown = unknown_entries(free_, seen_, nq);
  approach(state, acceleration);
  VectorXd x = without_blind(state);
  VectorXd estimate(3 * nq);
  estimate << x.head(2 * nq), acceleration;
  struct Solution {
    VectorXd z;
    ConditionedStep last;
  };
  const auto solve = [&](double tolerance) -> std::optional<Solution> {
    constexpr int max_iterations = 50;
    constexpr double converged = 1e-9, at_rounding = 1e-14;
    Solution out{estimate, {}};
    double previous = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      x.head(2 * nq) = out.z.head(2 * nq);
      const Linearisation at = linearise(x, out.z.tail(nq));
      if (!at.residual.allFinite() || !at.jacobian.allFinite()) break;
      const VectorXd size_of_z = out.z.cwiseAbs().cwiseMax(1);
      // those that a coarse tolerance takes for dependent and that are not are not met
      const bool are_met = (at.residual.array().abs() <= converged * (at.jacobian.cwiseAbs() * size_of_z).array()).all();
      out.last =
          conditioned_step(at.residual, at.jacobian, W, unknown, offset_of_measured(measured_, estimate, out.z), tolerance);
      out.z += out.last.step;
      const double size = (out.last.step.array() / size_of_z.array()).abs().maxCoeff();
      if (are_met && (size <= at_rounding || (size <= converged && size >= previous / 2))) return out;
      previous = size;
    }
    return std::nullopt;
  };
  std::optional<Solution> found = solve(rank_tolerance);
  if (!found) found = solve(dependent);
  if (!found) {
    throw NumericalError(
        fmt::format("system '{}': the measured positions do not meet the constraints at t = {:.6g}; are their units, signs and "
                    "zeros, and the lengths, those of the model?",
                    system_.name(), state[system_.layout().t()]));
  }
  state.head(2 * nq) = found->z.head(2 * nq);
  acceleration = found->z.tail(nq);
  condition_covariance(found->last, W, measured_, covariance);
  for (const int j : blind_) state[system_.layout().q(j)] = not_a_number;
}

}  // namespace gp2
