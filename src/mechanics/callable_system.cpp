#include "gp2/mechanics/callable_system.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "mechanics/differences.hpp"
#include "mechanics/largest_rank.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::vector<std::string> labels_of(const std::vector<CallableSystem::Constraint>& constraints) {
  std::vector<std::string> labels;
  for (const CallableSystem::Constraint& constraint : constraints) labels.push_back(constraint.text);
  return labels;
}

VectorXd noise_of(const std::vector<CallableSystem::Constraint>& constraints) {
  VectorXd noise(std::ssize(constraints));
  std::transform(constraints.begin(), constraints.end(), noise.begin(), [](const auto& one) { return one.noise; });
  return noise;
}

}  // namespace

CallableSystem::CallableSystem(Definition definition)
    : System(definition.declaration.name, definition.declaration.coordinates, definition.declaration.inputs,
             definition.declaration.parameters, labels_of(definition.constraints), noise_of(definition.constraints)),
      definition_(std::move(definition)),
      mechanics_reads_(marks_of(definition_.mechanics_reads, "mechanics_reads", *this)),
      force_reads_(marks_of(definition_.force_reads, "force_reads", *this)),
      residuals_read_(marks_of(definition_.residuals_read, "residuals_read", *this)) {
  if (nq() == 0) throw InputError(fmt::format("system '{}': a system needs at least one coordinate", name()));
  if (!definition_.evaluate) throw InputError(fmt::format("system '{}': evaluate is an empty function", name()));
  if (!definition_.residuals) return;
  for (int row = 0; row < nc(); ++row) {
    const Constraint& constraint = definition_.constraints[static_cast<std::size_t>(row)];
    if (constraint.level == ConstraintLevel::acceleration) continue;
    residual_labels_.push_back({row, constraint.level == ConstraintLevel::velocity, constraint.text});
    if (constraint.level == ConstraintLevel::position) residual_labels_.push_back({row, true, "d/dt of " + constraint.text});
  }
  if (residual_labels_.empty()) {
    throw InputError(
        fmt::format("system '{}': residuals are given, but none of its {} constraints is at position or velocity "
                    "level; say the levels, or leave out the residuals",
                    name(), nc()));
  }
}

void CallableSystem::require_shapes(const char* function, const SystemValues& values, Index n_states) const {
  const auto require = [&](const char* what, const char* shape, const MatrixXd& got, Index rows) {
    if (got.rows() == rows && got.cols() == n_states) return;
    throw InputError(
        fmt::format("system '{}': {} returned {} of the shape {} × {}, expected {} × {} ({} × N, with nq = {} coordinates, "
                    "nc = {} constraints, N = {} states)",
                    name(), function, what, got.rows(), got.cols(), rows, n_states, shape, nq(), nc(), n_states));
  };
  require("mass M", "nq·nq", values.mass, Index{nq()} * nq());
  require("constraint_matrix A", "nc·nq", values.constraint_matrix, Index{nc()} * nq());
  require("constraint_vector b", "nc", values.constraint_vector, nc());
  require("force F", "nq", values.force, nq());
}

void CallableSystem::require_finite(const char* function, const SystemValues& values, const States& states) const {
  const auto require = [&](const char* what, const MatrixXd& all, Index i) {
    if (all.col(i).allFinite()) return;
    throw InputError(
        fmt::format("system '{}': {} returned {} with a number that is not finite at state {}, where all that is read is finite",
                    name(), function, what, i + 1));
  };
  for (Index i = 0; i < states.cols(); ++i) {
    if (is_known(states.col(i), force_reads_)) require("force F", values.force, i);
    if (!is_known(states.col(i), mechanics_reads_)) continue;
    require("mass M", values.mass, i);
    require("constraint_matrix A", values.constraint_matrix, i);
    require("constraint_vector b", values.constraint_vector, i);
  }
}

void CallableSystem::require_symmetry(const char* function, const SystemValues& values, int i, bool derivative) const {
  const auto M = values.M(i);
  const double largest = M.cwiseAbs().maxCoeff();
  for (Index row = 0; row < M.rows(); ++row) {
    for (Index column = 0; column < row; ++column) {
      // a positive definite M has M_rc² < M_rr M_cc; its derivative has no such bound
      const double diagonal = std::sqrt(std::abs(M(row, row) * M(column, column)));
      const double size = derivative ? largest : std::max(std::abs(M(row, column)), diagonal);
      if (!(std::abs(M(row, column) - M(column, row)) > 1e-10 * size)) continue;
      throw InputError(
          fmt::format("system '{}': {} returned a mass M that is not symmetric at state {}: row {} column {} is {}, but row {} "
                      "column {} is {}",
                      name(), function, i + 1, column + 1, row + 1, M(column, row), row + 1, column + 1, M(row, column)));
    }
  }
}

void CallableSystem::evaluate_into(const States& states, const Parameters& parameters, SystemValues& values) const {
  require_states(states);
  require_parameters(parameters);
  values = definition_.evaluate(states, parameters);
  require_shapes("evaluate", values, states.cols());
  for (int i = 0; i < values.n_states(); ++i) require_symmetry("evaluate", values, i, false);
}

SystemValues CallableSystem::evaluate(const States& states, const Parameters& parameters) const {
  SystemValues values;
  evaluate_into(states, parameters, values);
  // at other parameters a fit may be on the way through: the likelihood is +∞ there
  if (parameters == parameter_values()) require_finite("evaluate", values, states);
  return values;
}

SystemValues CallableSystem::differentiate(const States& states, const Parameters& parameters, int index) const {
  require_states(states);
  require_parameters(parameters);
  require_parameter(index);
  if (!definition_.differentiate) {
    SystemValues values = difference_in_parameter(*this, states, parameters, index);
    require_finite(
        fmt::format("the difference of evaluate in '{}'", this->parameters()[static_cast<std::size_t>(index)].name).c_str(),
        values, states);
    return values;
  }
  SystemValues values = definition_.differentiate(states, parameters, index);
  require_shapes("differentiate", values, states.cols());
  require_finite("differentiate", values, states);
  for (int i = 0; i < values.n_states(); ++i) require_symmetry("differentiate", values, i, true);
  return values;
}

MatrixXd CallableSystem::residuals(const States& states, const Parameters& parameters) const {
  require_states(states);
  require_parameters(parameters);
  const auto n_rows = static_cast<Index>(residual_labels_.size());
  if (n_rows == 0) return MatrixXd(0, states.cols());
  MatrixXd values = definition_.residuals(states, parameters);
  if (values.rows() != n_rows || values.cols() != states.cols()) {
    std::vector<std::string> rows;
    for (const Residual& label : residual_labels_) rows.push_back(label.text);
    throw InputError(fmt::format(
        "system '{}': residuals returned the shape {} × {}, expected {} × {}: a row for each of {}; a column for each "
        "of the N = {} states",
        name(), values.rows(), values.cols(), n_rows, states.cols(), fmt::join(rows, ", "), states.cols()));
  }
  for (Index i = 0; i < states.cols(); ++i) {
    if (values.col(i).allFinite() || !is_known(states.col(i), residuals_read_)) continue;
    throw InputError(
        fmt::format("system '{}': residuals returned a number that is not finite at state {}, where all that is read is finite",
                    name(), i + 1));
  }
  return values;
}

std::vector<bool> CallableSystem::reads(SystemPart part) const {
  switch (part) {
    case SystemPart::mechanics:
      return mechanics_reads_;
    case SystemPart::force:
      return force_reads_;
    case SystemPart::residuals:
      break;
  }
  // without residuals nothing is read
  return residual_labels_.empty() ? std::vector<bool>(residuals_read_.size(), false) : residuals_read_;
}

int CallableSystem::largest_rank() const {
  // a lock could be held by a thread whose function waits for this one, as for Python's; each thread finds the same
  int rank = largest_rank_;
  if (rank < 0) largest_rank_ = rank = internal::find_largest_rank(*this, /*rows_may_vanish=*/true);
  return rank;
}

}  // namespace gp2
