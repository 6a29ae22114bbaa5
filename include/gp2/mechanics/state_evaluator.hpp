#pragma once

#include <span>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/symbolic/expression.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// M, A, b, F at one state after another, with fixed parameters, and their derivatives in the state x = [q; dq; t; u]
/// (StateLayout): what a control loop needs. Made by System::make_evaluator; it must not outlive its system, and each thread has
/// its own.
///
/// An entry of the state that no expression reads may be NaN. Where |v| has no derivative (v = 0) the one here is that of the
/// parameter derivatives, 0, not NaN.
///
/// SymbolicSystem's is exact and allocates nothing after construction. That of any other System evaluates batches, which may
/// allocate, and takes central differences over h = (ε max(1, |x_k|))^(1/3), of every entry that System::reads says may depend on
/// x_k: their error is about h², 4e-11 where |x_k| ≤ 1, relative to the size of the quantity and of its third derivative.
class StateEvaluator {
 public:
  using ConstMatrix = Eigen::Map<const Eigen::MatrixXd>;
  using ConstVector = Eigen::Map<const Eigen::VectorXd>;

  enum class Quantity { mass /* M */, constraint_matrix /* A */, constraint_vector /* b */, force /* F */ };
  /// ∂M_ij/∂x_k, ∂A_ij/∂x_k, ∂b_i/∂x_k or ∂F_i/∂x_k (then j = 0).
  struct Derivative {
    Quantity quantity = Quantity::mass;
    int row = 0;          // i
    int column = 0;       // j
    int state_index = 0;  // k
  };

  virtual ~StateEvaluator() = default;
  StateEvaluator(const StateEvaluator&) = delete;
  StateEvaluator& operator=(const StateEvaluator&) = delete;

  /// Everything below at another state.
  /// @param state  (layout().size())
  /// @throws InputError when it has another size.
  void evaluate(const Eigen::Ref<const Eigen::VectorXd>& state);

  [[nodiscard]] ConstMatrix M() const { return {values_.data(), nq_, nq_}; }                       // (nq × nq)
  [[nodiscard]] ConstMatrix A() const { return {values_.data() + nq_ * nq_, nc_, nq_}; }           // (nc × nq)
  [[nodiscard]] ConstVector b() const { return {values_.data() + nq_ * (nq_ + nc_), nc_}; }        // (nc)
  [[nodiscard]] ConstVector F() const { return {values_.data() + nq_ * (nq_ + nc_) + nc_, nq_}; }  // (nq) [N or N m]

  /// Every derivative that does not vanish identically, sorted by state_index; none where they were not asked for.
  [[nodiscard]] const std::vector<Derivative>& derivatives() const { return derivatives_; }
  /// The values of the derivatives, in their order.
  [[nodiscard]] ConstVector derivative_values() const {
    return {values_.data() + n_values(), static_cast<Eigen::Index>(derivatives_.size())};
  }

  /// The program from [state; parameters] to M, A, b, F and the derivatives, as long as the evaluator lives; null where they are
  /// not expressions.
  [[nodiscard]] virtual const Tape* tape() const { return nullptr; }

 protected:
  /// @param entries  the derivatives: `output` counts the numbers of M, A, b, F, each column-major; sorted by state_index
  /// @throws InputError when `parameters` has the wrong size.
  StateEvaluator(const System& system, const Eigen::Ref<const Eigen::VectorXd>& parameters,
                 std::span<const StateDerivatives::Entry> entries);

  /// Fills all_values().
  virtual void evaluate_all(const Eigen::Ref<const Eigen::VectorXd>& state) = 0;

  /// M, A, b, F, each column-major, then the values of the derivatives.
  [[nodiscard]] Eigen::VectorXd& all_values() { return values_; }
  [[nodiscard]] Eigen::Index n_values() const { return nq_ * (nq_ + nc_) + nc_ + nq_; }  // of M, A, b, F

 private:
  Eigen::Index nq_, nc_, n_state_;
  std::vector<Derivative> derivatives_;
  Eigen::VectorXd values_;
};

}  // namespace gp2
