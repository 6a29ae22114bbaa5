#pragma once

#include <span>
#include <vector>

#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/prior/state_function.hpp"

namespace gp2 {

/// A StateFunction given by expressions, which may read the multipliers λ₀ of a system too.
class ExpressionFunction final : public StateFunction {
 public:
  /// Features: expressions of the state alone.
  static std::shared_ptr<const StateFunction> of_state(std::span<const Expression> expressions, const SystemSymbols& symbols,
                                                       const std::shared_ptr<const System>& system);
  /// Directions: expressions of the state and the parameters, with their derivatives in each parameter.
  static std::shared_ptr<const StateFunction> of_state_and_parameters(std::span<const Expression> expressions,
                                                                      const SystemSymbols& symbols, ExpressionGraph& graph,
                                                                      const std::shared_ptr<const System>& system);

  [[nodiscard]] int size() const override { return values_.n_outputs(); }
  [[nodiscard]] Eigen::MatrixXd evaluate(const States& states, const Parameters& parameters) const override;
  [[nodiscard]] Eigen::MatrixXd differentiate(const States& states, const Parameters& parameters, int index) const override;
  [[nodiscard]] const StateFunction* parameter_derivative(int index) const override;
  [[nodiscard]] bool reads(int state_index) const override { return values_.uses_input(state_index); }
  [[nodiscard]] std::unique_ptr<Evaluator> make_evaluator(const Parameters& parameters) const override;

 private:
  // @param n_derivatives  of the entries of a state, the first ones, in which there are derivatives
  ExpressionFunction(std::span<const Expression> expressions, std::span<const Expression> inputs, std::size_t n_states,
                     std::size_t n_derivatives);
  class TapeEvaluator;

  Eigen::Index n_states_;  // entries of a state
  Tape values_;
  StateDerivatives state_derivatives_;
  std::vector<std::shared_ptr<const ExpressionFunction>> parameter_derivatives_;  // one per parameter of the system
};

}  // namespace gp2
