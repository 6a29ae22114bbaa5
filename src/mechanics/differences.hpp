#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/symbolic/expression.hpp"
#include "gp2/system.hpp"

namespace gp2 {

/// Central differences, in the state, of numbers that only batches of states give: steps of h = (ε max(1, |x_k|))^(1/3), so that
/// rounding and truncation are both about h².
class StateDifferences {
 public:
  /// @param entries  the derivatives to take; sorted by state_index
  explicit StateDifferences(std::vector<StateDerivatives::Entry> entries);

  [[nodiscard]] const std::vector<StateDerivatives::Entry>& entries() const { return entries_; }

  /// The states at which the numbers are needed: x itself, then x ± h for each entry of it (size of x × n).
  const Eigen::MatrixXd& states_around(const Eigen::Ref<const Eigen::VectorXd>& state);

  /// @param values       the numbers there (any × n)
  /// @param derivatives  one per entry
  void differentiate(const Eigen::Ref<const Eigen::MatrixXd>& values, Eigen::Ref<Eigen::VectorXd> derivatives) const;

 private:
  std::vector<StateDerivatives::Entry> entries_;
  std::vector<int> moved_;  // entries of the state that anything depends on
  Eigen::MatrixXd states_;
};

/// One step of a difference in a parameter of the value p: central, or one-sided of the same order where p ± h leaves its bounds.
/// CallableSystem::Definition::differentiate says how long it is.
class ParameterStep {
 public:
  ParameterStep(const Parameter& parameter, double p);

  struct Term {
    double value;  // of the parameter
    double weight;
  };
  /// The derivative of f is Σ weight f(value).
  [[nodiscard]] const std::vector<Term>& terms() const { return terms_; }

 private:
  std::vector<Term> terms_;
};

/// ∂M/∂p, ∂A/∂p, ∂b/∂p, ∂F/∂p by differences over such a step, of p = parameters()[index].
SystemValues difference_in_parameter(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                     const Eigen::Ref<const Eigen::VectorXd>& parameters, int index);

/// Which entries of a state have these names; all where none are given.
/// @param what  stands for the list in messages
/// @throws InputError naming one that is none of the state's.
std::vector<bool> marks_of(const std::optional<std::vector<std::string>>& names, const char* what, const System& system);

/// Whether every entry of a state that is read is a finite number.
bool is_known(const Eigen::Ref<const Eigen::VectorXd>& state, const std::vector<bool>& reads);

}  // namespace gp2
