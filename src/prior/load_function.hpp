#pragma once

#include <memory>
#include <utility>

#include "gp2/prior/state_function.hpp"
#include "gp2/system.hpp"

namespace gp2 {

/// A StateFunction f(x, λ₀(x)) that reads the load of the constraints, their multipliers λ₀ under the known force of a system; or
/// what f(x, λ) of the multipliers λ of the motion itself is there.
class LoadFunction final : public StateFunction {
 public:
  /// @param function  f, whose states are [x; λ₀] and whose evaluator is exact
  /// @param system    λ₀ is its own; where f has no parameters, with the system's own values of them
  /// @param is_of_motion  whether f is meant at λ: of_multipliers
  LoadFunction(std::shared_ptr<const StateFunction> function, std::shared_ptr<const System> system, bool is_of_motion = false);

  [[nodiscard]] int size() const override { return function_->size(); }
  [[nodiscard]] Eigen::MatrixXd evaluate(const States& states, const Parameters& parameters) const override;
  [[nodiscard]] Eigen::MatrixXd differentiate(const States& states, const Parameters& parameters, int index) const override;
  [[nodiscard]] bool reads(int state_index) const override;
  [[nodiscard]] const StateFunction* of_multipliers() const override { return is_of_motion_ ? function_.get() : nullptr; }
  [[nodiscard]] std::unique_ptr<Evaluator> make_evaluator(const Parameters& parameters) const override;
  /// The same function of the load in another system of the same rows.
  [[nodiscard]] std::shared_ptr<const LoadFunction> under(std::shared_ptr<const System> system) const {
    return std::make_shared<const LoadFunction>(function_, std::move(system), is_of_motion_);
  }

 private:
  class ChainEvaluator;

  std::shared_ptr<const StateFunction> function_;
  std::shared_ptr<const System> system_;
  std::vector<bool> lambda0_reads_;
  bool is_of_motion_;
};

}  // namespace gp2
