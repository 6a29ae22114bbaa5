#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/mechanics.hpp"

namespace gp2 {

/// A quantity that is affine in the unconstrained acceleration ā at a state: G(x) ā(x) + d(x).
struct View {
  enum class Quantity {
    constrained_acceleration,    // ddq = T ā + L b   G = T, d = L b   [ddq]
    unconstrained_acceleration,  // ā                 G = I, d = 0     [ddq]
  };

  Quantity quantity = Quantity::constrained_acceleration;
  std::vector<int> rows;  // of the quantity, in this order

  /// Every row of a quantity.
  static View all(Quantity quantity, const System& system);

  [[nodiscard]] int size() const { return static_cast<int>(rows.size()); }
  /// ddq1 … (constrained), abar_q1 … (unconstrained).
  [[nodiscard]] std::vector<std::string> names(const System& system) const;
};

/// G and d of a view, or their derivatives in one parameter, at N states.
struct ViewValues {
  Eigen::MatrixXd matrix;  // G  (d·nq × N), column-major blocks
  Eigen::MatrixXd offset;  // d  (d × N)

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> G(int i) const {
    return {matrix.col(i).data(), offset.rows(), offset.rows() == 0 ? 0 : matrix.rows() / offset.rows()};
  }
};

ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics);

/// ∂G/∂p and ∂d/∂p, given ∂M/∂p, ∂A/∂p, ∂b/∂p.
ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative);

}  // namespace gp2
