#pragma once

#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

struct OtherSystem;

/// A quantity that is affine in the unconstrained acceleration ā at a state: G(x) ā(x) + d(x). Where M is singular ā stands for
/// M'⁻¹F̄, the M' of UdwadiaKalaba, and cannot be viewed itself; elsewhere M' = M.
struct View {
  enum class Quantity {
    constrained_acceleration,    // ddq = T ā + L b    G = T             d = L b           [ddq]
    unconstrained_acceleration,  // ā                  G = I             d = 0             [ddq]
    constraint_force,            // Aᵀλ = M (ddq − ā)  G = M T − M'      d = M L b         [force]
    multipliers,                 // λ                  G = (Aᵀ)⁺(MT − M')  d = (Aᵀ)⁺M L b  [force/row]; nc of them
    next_velocity,               // dq + Δt ddq        G = Δt T          d = dq + Δt L b   [dq]
  };

  Quantity quantity = Quantity::constrained_acceleration;
  std::vector<int> rows;  // of the quantity, in this order
  double time_step = 0;   // Δt of next_velocity [s]
  /// What one latent alone adds: G E_a f_a, without μ and d. −1: everything.
  int latent = -1;
  /// The quantity as it is under another system (Geist & Trimpe 2020, eq. 10): prior.hpp. Null: the prior's own system.
  std::shared_ptr<const OtherSystem> other_system = nullptr;

  /// Every row of a quantity.
  static View all(Quantity quantity, const System& system);

  /// "constrained", "unconstrained", "constraint-force", "multipliers", "next-velocity": the words of commands and files.
  static const std::vector<std::string>& quantity_words();
  static std::string word(Quantity quantity);
  static std::optional<Quantity> quantity_of(std::string_view word);

  /// Which entries of a state the view reads beyond those of the mechanics (layout size): dq for next_velocity.
  [[nodiscard]] std::vector<bool> reads(const System& system) const;

  [[nodiscard]] int size() const { return static_cast<int>(rows.size()); }
  /// The same rows of the same quantity, under the same OtherSystem object.
  bool operator==(const View&) const = default;
  /// ddq1 … (constrained), abar_q1 … (unconstrained), fc_q1 … (constraint force), lambda1 … (multipliers), dq1_next … (next
  /// velocity), with @LATENT behind where one latent is viewed alone.
  /// @param latent_name  of that latent
  [[nodiscard]] std::vector<std::string> names(const System& system, const std::string& latent_name = "") const;
};

/// G and d of a view, or their derivatives in one parameter, at N states.
struct ViewValues {
  Eigen::MatrixXd matrix;  // G  (d·nq × N), column-major blocks
  Eigen::MatrixXd offset;  // d  (d × N)

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> G(int i) const {
    return {matrix.col(i).data(), offset.rows(), offset.rows() == 0 ? 0 : matrix.rows() / offset.rows()};
  }
};

/// @param states  (layout size × N): next_velocity reads dq
ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics, const Eigen::Ref<const Eigen::MatrixXd>& states);

/// ∂G/∂p and ∂d/∂p, given ∂M/∂p, ∂A/∂p, ∂b/∂p.
/// @throws InputError for multipliers of redundant rows, which are not differentiable.
ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative);

}  // namespace gp2
