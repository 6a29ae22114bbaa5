#include "prior/expression_function.hpp"

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "mechanics/known_multipliers.hpp"
#include "prior/load_function.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

ExpressionFunction::ExpressionFunction(std::span<const Expression> expressions, std::span<const Expression> inputs,
                                       std::size_t n_states, std::size_t n_derivatives)
    : n_states_(static_cast<Eigen::Index>(n_states)),
      values_(expressions, inputs),
      state_derivatives_(expressions, inputs, static_cast<int>(n_derivatives)) {}

std::shared_ptr<const StateFunction> ExpressionFunction::of_state(std::span<const Expression> expressions,
                                                                  const SystemSymbols& symbols,
                                                                  const std::shared_ptr<const System>& system) {
  std::vector<Expression> inputs = symbols.state();
  const Multipliers load = multipliers_in(expressions, *system);
  if (load.are_of_motion) {
    throw InputError("lambda is what the latents make it, so that only directions and [truth] may read it; write lambda0");
  }
  inputs.insert(inputs.end(), load.variables.begin(), load.variables.end());
  std::shared_ptr<const StateFunction> function(new ExpressionFunction(expressions, inputs, inputs.size(), inputs.size()));
  if (load.variables.empty()) return function;
  return std::make_shared<LoadFunction>(std::move(function), system);
}

std::shared_ptr<const StateFunction> ExpressionFunction::of_state_and_parameters(std::span<const Expression> expressions,
                                                                                 const SystemSymbols& symbols,
                                                                                 ExpressionGraph& graph,
                                                                                 const std::shared_ptr<const System>& system) {
  const Multipliers load = multipliers_in(expressions, *system);
  const std::vector<Expression> inputs = symbols.state_and_parameters(load.variables);
  const std::size_t n_states = inputs.size() - symbols.parameters.size();
  std::shared_ptr<ExpressionFunction> function(new ExpressionFunction(expressions, inputs, n_states, n_states));
  for (const Expression parameter : symbols.parameters) {
    std::vector<Expression> derivatives;
    for (const Expression expression : expressions) derivatives.push_back(graph.differentiate(expression, parameter));
    function->parameter_derivatives_.emplace_back(
        new ExpressionFunction(derivatives, inputs, n_states, load.are_of_motion ? n_states : 0));
  }
  if (load.variables.empty()) return function;
  return std::make_shared<LoadFunction>(std::move(function), system, load.are_of_motion);
}

MatrixXd ExpressionFunction::evaluate(const States& states, const Parameters& parameters) const {
  if (states.rows() != n_states_) {
    throw InputError(
        fmt::format("features and directions are functions of a state of {} entries, got {}", n_states_, states.rows()));
  }
  MatrixXd values;
  values_.evaluate(states, parameters, values);
  return values;
}

MatrixXd ExpressionFunction::differentiate(const States& states, const Parameters& parameters, int index) const {
  return parameter_derivatives_[static_cast<std::size_t>(index)]->evaluate(states, parameters);
}

const StateFunction* ExpressionFunction::parameter_derivative(int index) const {
  return parameter_derivatives_[static_cast<std::size_t>(index)].get();
}

class ExpressionFunction::TapeEvaluator final : public Evaluator {
 public:
  TapeEvaluator(const ExpressionFunction& function, const Parameters& parameters)
      : values_(function.values_),
        derivatives_(function.state_derivatives_),
        workspace_(values_.make_workspace(parameters)),
        workspace_of_derivatives_(derivatives_.tape.make_workspace(parameters)) {}

  void evaluate(const Ref<const VectorXd>& state, Ref<VectorXd> values) override {
    values_.evaluate_at(state, workspace_, values);
  }
  [[nodiscard]] const std::vector<StateDerivatives::Entry>& entries() const override { return derivatives_.entries; }
  void differentiate(const Ref<const VectorXd>& state, Ref<VectorXd> derivatives) override {
    derivatives_.tape.evaluate_at(state, workspace_of_derivatives_, derivatives);
  }
  [[nodiscard]] Tapes tapes() const override { return {&values_, &derivatives_.tape, &derivatives_.entries}; }

 private:
  const Tape& values_;
  const StateDerivatives& derivatives_;
  VectorXd workspace_, workspace_of_derivatives_;
};

std::unique_ptr<StateFunction::Evaluator> ExpressionFunction::make_evaluator(const Parameters& parameters) const {
  return std::make_unique<TapeEvaluator>(*this, parameters);
}

}  // namespace gp2
