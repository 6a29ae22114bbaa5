#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/symbolic/expression.hpp"

namespace gp2 GP2_API {

/// Numbers that follow from a state: the features φ(x) of a latent, or its directions B(x), which may depend on the parameters of
/// the system too. Immutable; every member function may be called from several threads at once.
class StateFunction {
 public:
  using States = Eigen::Ref<const Eigen::MatrixXd>;      // (layout().size() × N)
  using Parameters = Eigen::Ref<const Eigen::VectorXd>;  // (parameters().size()); of features none

  /// The numbers at one state after another, with fixed parameters: what a control loop needs. Each thread has its own.
  class Evaluator {
   public:
    virtual ~Evaluator() = default;

    /// @param values  (size())
    virtual void evaluate(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> values) = 0;

    /// The derivatives in the state that do not vanish identically, sorted by state_index …
    [[nodiscard]] virtual const std::vector<StateDerivatives::Entry>& entries() const = 0;
    /// … and their values, in this order.
    virtual void differentiate(const Eigen::Ref<const Eigen::VectorXd>& state, Eigen::Ref<Eigen::VectorXd> derivatives) = 0;

    /// The programs from [state; λ₀; parameters] to the numbers and to the derivatives, as long as the evaluator lives; null where
    /// they are not expressions. λ₀ are the multipliers under the known force, of every row where any is read.
    struct Tapes {
      const Tape* values = nullptr;
      const Tape* derivatives = nullptr;
      const std::vector<StateDerivatives::Entry>* entries = nullptr;  // of the derivatives, in [state; λ₀]
      int n_loads = 0;                                                // of λ₀
    };
    [[nodiscard]] virtual Tapes tapes() const { return {}; }
  };

  StateFunction() = default;
  virtual ~StateFunction() = default;
  StateFunction(const StateFunction&) = delete;
  StateFunction& operator=(const StateFunction&) = delete;

  /// How many numbers there are.
  [[nodiscard]] virtual int size() const = 0;

  /// The numbers at N states (size() × N).
  [[nodiscard]] virtual Eigen::MatrixXd evaluate(const States& states, const Parameters& parameters) const = 0;

  /// Their derivatives in one parameter of the system (size() × N).
  [[nodiscard]] virtual Eigen::MatrixXd differentiate(const States& states, const Parameters& parameters, int index) const = 0;

  /// Where the numbers read the multipliers λ of the motion that they help to make: the function of [x; λ], whose evaluator is
  /// exact. All else here is then at λ₀, the multipliers under the known force. Null elsewhere.
  [[nodiscard]] virtual const StateFunction* of_multipliers() const { return nullptr; }

  /// Of a function of [x; λ]: its derivative in one parameter of the system, as such a function itself. Null elsewhere.
  [[nodiscard]] virtual const StateFunction* parameter_derivative(int /*index*/) const { return nullptr; }

  /// Whether they depend on an entry of the state, which a log must have then.
  [[nodiscard]] virtual bool reads(int state_index) const = 0;

  /// Of expressions it is exact and allocates nothing; of code its derivatives are central differences. It must not outlive the
  /// function.
  [[nodiscard]] virtual std::unique_ptr<Evaluator> make_evaluator(const Parameters& parameters) const = 0;
};

}  // namespace gp2
