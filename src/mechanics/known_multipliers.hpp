#pragma once

#include <limits>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

/// λ₀ of a state, the multipliers that the constraints need under the known force alone:
///
///     M a = F + Aᵀλ₀,    A a = b.
///
/// Of redundant rows they are those of minimum norm, and 0 of a row that vanishes. With K = (Aᵀ)⁺ and where the rank of A stays,
/// their change is
///
///     dλ₀ = K (M da − r) + (I − K Aᵀ) dA Kᵀλ₀,    da = T M⁻¹r + L (db − dA a),    r = dF + dAᵀλ₀ − dM a.
///
/// M may be singular as in UdwadiaKalaba. One object serves one state after another and allocates nothing where the sizes are those
/// of the call before.
class KnownMultipliers {
 public:
  using Matrix = Eigen::Ref<const Eigen::MatrixXd>;
  using Vector = Eigen::Ref<const Eigen::VectorXd>;
  using Quantity = StateEvaluator::Quantity;

  /// NaN where nothing determines the motion, or a number is not finite.
  /// @param largest_rank  System::largest_rank_of(A)
  void compute(const Matrix& M, const Matrix& A, const Vector& b, const Vector& F,
               int largest_rank = std::numeric_limits<int>::max());
  [[nodiscard]] const Eigen::VectorXd& values() const { return lambda_; }  // λ₀ (nc)

  /// The derivatives of λ₀ at this state in n variables follow from those of M, A, b and F, which are added one by one.
  void start_derivatives(Eigen::Index n);
  void add_derivative(Quantity of, Eigen::Index row, Eigen::Index column, Eigen::Index variable, double value);
  [[nodiscard]] const Eigen::MatrixXd& derivatives();  // (nc × n)

 private:
  UdwadiaKalaba projection_;
  UdwadiaKalaba::Workspace workspace_;
  Eigen::MatrixXd M_, A_, K_, L_;
  Eigen::VectorXd a_, a_bar_, force_, lambda_, along_;  // along: Kᵀλ₀
  Eigen::MatrixXd r_, force_matrix_, da_, of_rows_, dA_along_, dlambda_;
};

/// Whether an expression means a multiplier by this name: λ₀ of row i "lambda0(i)" or λ, that of the motion itself, "lambda(i)".
bool is_multiplier(std::string_view variable);

/// What is wrong with reading such a one where there are nc rows.
std::optional<std::string> row_fault(std::string_view multiplier, int nc);

/// Whether it is λ.
bool is_multiplier_of_motion(std::string_view multiplier);

/// What is wrong with reading both of these multipliers in one function: it knows either λ₀ or λ.
std::optional<std::string> mixture_fault(std::string_view multiplier, std::string_view other);

/// The variables of every row, where an expression reads one of them; none elsewhere.
struct Multipliers {
  std::vector<Expression> variables;
  bool are_of_motion = false;  // λ, not λ₀
};

/// @throws InputError where the system has no such row, or both λ₀ and λ are read.
Multipliers multipliers_in(std::span<const Expression> expressions, const System& system);

/// [states; λ₀] (layout size + nc × N).
Eigen::MatrixXd with_known_multipliers(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                       const Eigen::Ref<const Eigen::VectorXd>& parameters);

}  // namespace gp2
