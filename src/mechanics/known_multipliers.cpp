#include "mechanics/known_multipliers.hpp"

#include <algorithm>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "mechanics/in_blocks.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

void KnownMultipliers::compute(const Matrix& M, const Matrix& A, const Vector& b, const Vector& F, int largest_rank) {
  M_ = M;
  A_ = A;
  lambda_.setConstant(A.rows(), not_a_number);
  if (!M.allFinite() || !A.allFinite() || !b.allFinite() || !F.allFinite()) return;
  projection_.compute(M, A, b, largest_rank);
  if (!projection_.motion_is_determined()) return;

  a_bar_ = F;
  projection_.solve_mass_in_place(a_bar_);
  a_.resize(F.size());
  projection_.constrain(a_bar_, a_, workspace_);
  force_ = -F;
  force_.noalias() += M_ * a_;
  projection_.write_multipliers_of_force(K_, workspace_);
  lambda_.noalias() = K_ * force_;
  along_.noalias() = K_.transpose() * lambda_;
  L_.resize(M.rows(), A.rows());
  projection_.write_L(L_);
}

void KnownMultipliers::start_derivatives(Index n) {
  r_.setZero(M_.rows(), n);
  of_rows_.setZero(A_.rows(), n);
  dA_along_.setZero(A_.rows(), n);
}

void KnownMultipliers::add_derivative(Quantity of, Index row, Index column, Index variable, double value) {
  switch (of) {
    case Quantity::mass:
      r_(row, variable) -= value * a_[column];
      return;
    case Quantity::constraint_matrix:
      r_(column, variable) += value * lambda_[row];
      of_rows_(row, variable) -= value * a_[column];
      dA_along_(row, variable) += value * along_[column];
      return;
    case Quantity::constraint_vector:
      of_rows_(row, variable) += value;
      return;
    case Quantity::force:
      r_(row, variable) += value;
      return;
  }
}

const MatrixXd& KnownMultipliers::derivatives() {
  dlambda_.resize(A_.rows(), r_.cols());
  if (!lambda_.allFinite()) {
    dlambda_.setConstant(not_a_number);
    return dlambda_;
  }
  force_matrix_ = r_;
  projection_.solve_mass_in_place(force_matrix_);
  da_.noalias() = projection_.T() * force_matrix_;
  da_.noalias() += L_ * of_rows_;
  r_ *= -1;
  r_.noalias() += M_ * da_;
  dlambda_.noalias() = K_ * r_;
  if (projection_.rank() == A_.rows()) return dlambda_;  // K Aᵀ = I

  force_matrix_.noalias() = A_.transpose() * dA_along_;
  dlambda_ += dA_along_;
  dlambda_.noalias() -= K_ * force_matrix_;
  return dlambda_;
}

namespace {

constexpr std::string_view known = "lambda0(", of_motion = "lambda(";

std::string name_of(bool is_of_motion, int row) { return fmt::format("{}{})", is_of_motion ? of_motion : known, row + 1); }

}  // namespace

bool is_multiplier(std::string_view variable) { return variable.starts_with(known) || variable.starts_with(of_motion); }

bool is_multiplier_of_motion(std::string_view multiplier) { return multiplier.starts_with(of_motion); }

std::optional<std::string> row_fault(std::string_view multiplier, int nc) {
  for (int row = 0; row < nc; ++row) {
    if (multiplier == name_of(multiplier.starts_with(of_motion), row)) return std::nullopt;
  }
  return fmt::format("{}: there is no such row of the constraints, of which there are {}", multiplier, nc);
}

std::optional<std::string> mixture_fault(std::string_view multiplier, std::string_view other) {
  if (is_multiplier_of_motion(multiplier) == is_multiplier_of_motion(other)) return std::nullopt;
  return "both lambda0 and lambda are read: write lambda for both, the multipliers of the motion itself";
}

Multipliers multipliers_in(std::span<const Expression> expressions, const System& system) {
  std::string first;
  for (const Expression& expression : expressions) {
    for (const std::string& variable : expression.graph().variables_of(expression)) {
      if (!is_multiplier(variable)) continue;
      if (const auto fault = row_fault(variable, system.nc())) throw InputError(*fault);
      if (first.empty()) first = variable;
      if (const auto fault = mixture_fault(first, variable)) throw InputError(*fault);
    }
  }
  Multipliers multipliers;
  multipliers.are_of_motion = is_multiplier_of_motion(first);
  for (int row = 0; !first.empty() && row < system.nc(); ++row) {
    multipliers.variables.push_back(expressions.front().graph().variable(name_of(multipliers.are_of_motion, row)));
  }
  return multipliers;
}

MatrixXd with_known_multipliers(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  MatrixXd out(states.rows() + system.nc(), states.cols());
  out.topRows(states.rows()) = states;
  KnownMultipliers multipliers;
  SystemValues values;
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    system.evaluate_into(block, parameters, values);
    for (int i = 0; i < values.n_states(); ++i) {
      multipliers.compute(values.M(i), values.A(i), values.b(i), values.F(i), system.largest_rank_of(values.A(i)));
      out.col(first + i).tail(system.nc()) = multipliers.values();
    }
  });
  return out;
}

}  // namespace gp2
