#pragma once

#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/symbolic/expression.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// The variables of a constrained mechanical system in an expression graph.
struct SystemSymbols {
  std::vector<Expression> q, dq, ddq, u, parameters;
  Expression t;

  SystemSymbols(ExpressionGraph& graph, const std::vector<Coordinate>& coordinates, const std::vector<std::string>& inputs,
                const std::vector<Parameter>& parameters);
  [[nodiscard]] std::vector<Expression> state() const;  // in the order of StateLayout
  [[nodiscard]] std::vector<Expression> state_and_parameters(
      std::span<const Expression> between = {}) const;  // inputs of most tapes
};

/// One row of A ddq = b, derived from a constraint.
struct ConstraintRow {
  using Level = ConstraintLevel;
  Level level;
  std::string text;           // c as written
  std::vector<Expression> A;  // (nq)
  Expression b;
  std::vector<Expression> residuals;  // position: c and ċ; velocity: c; acceleration: none
  double noise = 0;                   // ς of System::constraint_noise
  std::string condition = {};         // of System::constraint_conditions

  /// Of a unilateral contact c ≥ 0, which holds c = 0 where its input is above ½.
  struct Contact {
    int input = 0;           // of the system's inputs: 1 in contact, 0 apart
    Expression restitution;  // e of the impact, at the state before it
  };
  std::optional<Contact> contact = {};
};

/// Derives a row of A and b from the expression c of a constraint c = 0.
///
/// @throws InputError when c depends on what its level does not allow, has no ddq to act on, or is not linear in ddq.
ConstraintRow derive_constraint(ConstraintRow::Level level, Expression c, std::string text, const SystemSymbols& symbols);

/// Makes a row vanish, with its entry of b and its residuals, wherever `active` is 0; where it is 1 they stay as they are. A
/// constraint is differentiated as if it held always, and only then switched.
/// @param condition  `active` as written
void switch_constraint(ConstraintRow& row, Expression active, std::string condition);

/// A System given by expressions: M(q,t), F(q,dq,t,u) and constraint rows, with exact derivatives in every parameter.
class SymbolicSystem final : public System {
 public:
  struct Definition {
    std::string name;
    std::vector<Coordinate> coordinates;
    std::vector<std::string> inputs;
    std::vector<Parameter> parameters;
    std::shared_ptr<ExpressionGraph> graph;
    std::vector<std::vector<Expression>> mass;  // (nq × nq)
    std::vector<Expression> force;              // (nq)
    std::vector<ConstraintRow> constraints;
  };
  explicit SymbolicSystem(Definition definition);
  ~SymbolicSystem() override;
  SymbolicSystem(const SymbolicSystem&) = delete;
  SymbolicSystem& operator=(const SymbolicSystem&) = delete;

  [[nodiscard]] SystemValues evaluate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                      const Eigen::Ref<const Eigen::VectorXd>& parameters) const override;
  void evaluate_into(const Eigen::Ref<const Eigen::MatrixXd>& states, const Eigen::Ref<const Eigen::VectorXd>& parameters,
                     SystemValues& values) const override;
  /// Its derivatives are exact; it allocates nothing. The first call with `derivatives` takes them, in a graph of the system's
  /// own. Where they would be more than ExpressionGraph::max_nodes, for robots of some 40 joints in a row, it takes differences.
  [[nodiscard]] std::unique_ptr<StateEvaluator> make_evaluator(const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                                               bool derivatives) const override;
  [[nodiscard]] SystemValues differentiate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                           const Eigen::Ref<const Eigen::VectorXd>& parameters, int index) const override;
  [[nodiscard]] Eigen::MatrixXd residuals(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                          const Eigen::Ref<const Eigen::VectorXd>& parameters) const override;
  [[nodiscard]] const std::vector<Residual>& residual_labels() const override { return residual_labels_; }
  [[nodiscard]] std::vector<bool> reads(SystemPart part) const override;
  [[nodiscard]] bool depends_on_parameter(int index) const override { return values_.uses_input(layout().size() + index); }
  /// Found at states where the constraints that hold always hold, if these are all of positions.
  [[nodiscard]] int largest_rank() const override { return largest_rank_; }

  [[nodiscard]] const Definition& definition() const { return definition_; }

 private:
  class Evaluator;
  struct StateTape;  // M, A, b, F and their derivatives in the state
  [[nodiscard]] const StateTape& state_tape() const;
  void run(const Tape& tape, const Eigen::Ref<const Eigen::MatrixXd>& states, const Eigen::Ref<const Eigen::VectorXd>& parameters,
           SystemValues& values) const;

  Definition definition_;
  Tape values_;                    // M, A, b, F
  std::vector<Tape> derivatives_;  // the same, per parameter
  Tape mechanics_, force_, residuals_;
  std::vector<Residual> residual_labels_;
  int largest_rank_ = 0;
  std::unique_ptr<StateTape> state_tape_;  // filled when first asked for, hence
  mutable std::once_flag state_tape_is_filled_;
};

}  // namespace gp2
