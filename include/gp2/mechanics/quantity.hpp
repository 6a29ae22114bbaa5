#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// What quantities are made of, at one state: one motion, or m of them in columns, or a change of it in each of m directions.
struct MotionColumns {
  using Columns = Eigen::Map<const Eigen::MatrixXd>;

  Columns constrained_acceleration;    // ddq = T ā + L b       (nq × m)
  Columns unconstrained_acceleration;  // ā                     (nq × m)
  Columns constraint_force;            // Aᵀλ = M ddq − M'ā     (nq × m), the M' of UdwadiaKalaba
  Columns applied_force;               // F̄ = M'ā               (nq × m)
};

/// The columns of a matrix or a vector, which must live as long.
template <typename Matrix>
MotionColumns::Columns columns_of(const Eigen::PlainObjectBase<Matrix>& matrix) {
  return {matrix.data(), matrix.rows(), matrix.cols()};
}

/// Which members of MotionColumns a quantity reads; the others may hold anything.
struct MotionParts {
  bool constrained_acceleration = false;
  bool unconstrained_acceleration = false;
  bool constraint_force = false;
  bool applied_force = false;
};

/// Changes of A in one or several directions, as products.
class ConstraintChange {
 public:
  virtual ~ConstraintChange() = default;
  /// out += dA x.  x (nq × m), or nq × 1 that every one of m directions is applied to; out (nc × m)
  virtual void add_product(const Eigen::Ref<const Eigen::MatrixXd>& x, Eigen::Ref<Eigen::MatrixXd> out) const = 0;
  /// out −= dAᵀy.  y (nc × m), or nc × 1; out (nq × m)
  virtual void subtract_transposed_product(const Eigen::Ref<const Eigen::MatrixXd>& y, Eigen::Ref<Eigen::MatrixXd> out) const = 0;
};

/// The mechanics at a state, as quantities read them.
struct StateMechanics {
  const UdwadiaKalaba& projection;
  Eigen::Map<const Eigen::MatrixXd> A;  // (nc × nq)
  double time_step = 0;                 // Δt, of quantities that have one [s]
};

/// A kind of quantity that is affine in the unconstrained acceleration ā at a state, G(x) ā + d(x). All that gp2 knows of a kind
/// stands in one class of src/mechanics/quantity.cpp; a new one goes there, and into the list at its end.
///
/// `evaluate` is the kind's equation, linear in the motion; G, d and the mean of a prediction follow from it. `differentiate` is
/// its differential; ∂G/∂θ, ∂d/∂θ and the Jacobian in the state follow from that.
class QuantityKind {
 public:
  /// Memory of the functions below: they allocate nothing where the sizes are those of the call before.
  struct Workspace {
    Eigen::MatrixXd K;                    // (nc × nq)
    Eigen::MatrixXd lambda, of_rows;      // (nc × m)
    Eigen::MatrixXd force, acceleration;  // (nq × m)
    UdwadiaKalaba::Workspace projection;
  };

  /// "constrained": the word of commands and files.
  [[nodiscard]] virtual std::string word() const = 0;
  /// How many rows there are, of nq coordinates and nc constraints.
  [[nodiscard]] virtual int n_rows(int nq, int nc) const;
  /// "ddq1": the column of a row in logs and predictions.
  [[nodiscard]] virtual std::string name(const System& system, int row) const = 0;
  /// What `evaluate` and `differentiate` read of a motion.
  [[nodiscard]] virtual MotionParts parts() const = 0;
  /// Whether it depends on a time step Δt.
  [[nodiscard]] virtual bool needs_time_step() const { return false; }
  /// Whether the mean μ of the prior is part of it, beside what the latents add.
  [[nodiscard]] virtual bool has_mean() const { return true; }
  /// Whether row j is ddq_j or ā_j, in their unit.
  [[nodiscard]] virtual bool is_acceleration() const { return false; }
  /// Whether row j is of coordinate j.
  [[nodiscard]] virtual bool is_per_coordinate() const { return true; }
  /// What a unit of acceleration of coordinate j adds to row j, in size, where M is diagonal and rows are of coordinates.
  /// @param mass  M_jj
  [[nodiscard]] virtual double per_acceleration([[maybe_unused]] double mass, double /*time_step*/) const { return 1; }
  /// The entry of the state that is added to a row, where there is one: part of d.
  [[nodiscard]] virtual std::optional<int> added_entry(const StateLayout& layout, int row) const;
  /// @throws InputError where there is no derivative in the parameters at this state.
  virtual void require_parameter_derivatives(const StateMechanics& /*at*/) const {}

  /// Every row, without added entries, of m motions.
  /// @param out  (size × m)
  virtual void evaluate(const StateMechanics& at, const MotionColumns& motion, Eigen::Ref<Eigen::MatrixXd> out,
                        Workspace& workspace) const = 0;
  /// The change of every row in m directions.
  /// @param motion     m columns, or the only one
  /// @param dmotion    its change
  /// @param dA         the change of A
  /// @param out        (size × m)
  virtual void differentiate(const StateMechanics& at, const MotionColumns& motion, const MotionColumns& dmotion,
                             const ConstraintChange& dA, Eigen::Ref<Eigen::MatrixXd> out, Workspace& workspace) const = 0;

 protected:
  constexpr QuantityKind() = default;
  constexpr ~QuantityKind() = default;
  QuantityKind(const QuantityKind&) = default;
  QuantityKind& operator=(const QuantityKind&) = default;
};

/// One of the kinds, as a value: `quantity->word()`.
class Quantity {
 public:
  static const Quantity constrained_acceleration;    // ddq = T ā + L b    G = T               d = L b         [ddq]
  static const Quantity unconstrained_acceleration;  // ā                  G = I               d = 0           [ddq]
  static const Quantity constraint_force;            // Aᵀλ = M ddq − M'ā  G = M T − M'        d = M L b       [force]
  static const Quantity multipliers;    // λ, of minimum norm G = (Aᵀ)⁺(M T − M') d = (Aᵀ)⁺M L b  [force/row]
  static const Quantity next_velocity;  // dq + Δt ddq        G = Δt T            d = dq + Δt L b [dq]
  static const Quantity learned_force;  // M'(ā − μ)          G = M', without μ   d = 0           [force]

  /// All of them.
  static const std::vector<Quantity>& all();
  /// "constrained", "unconstrained", "constraint-force", "multipliers", "next-velocity", "force".
  static const std::vector<std::string>& words();
  static std::optional<Quantity> of_word(std::string_view word);

  const QuantityKind* operator->() const { return kind_; }
  bool operator==(const Quantity&) const = default;

 private:
  constexpr explicit Quantity(const QuantityKind& kind) : kind_(&kind) {}
  const QuantityKind* kind_;
};

/// How the motion at a state depends on ā: as columns T, I, M T − M', M', and at ā = 0: L b, 0, M L b, 0. Or the derivatives of
/// these in a parameter. Only the parts that are asked for. In memory that is used again.
class AffineMotion {
 public:
  void evaluate(const UdwadiaKalaba& projection, const Eigen::Ref<const Eigen::MatrixXd>& M, const MotionParts& parts);
  /// Given ∂M/∂p, ∂A/∂p, ∂b/∂p.
  void differentiate(const UdwadiaKalaba& projection, const Eigen::Ref<const Eigen::MatrixXd>& M,
                     const Eigen::Ref<const Eigen::MatrixXd>& dM, const Eigen::Ref<const Eigen::MatrixXd>& dA,
                     const Eigen::Ref<const Eigen::VectorXd>& db, const MotionParts& parts);

  [[nodiscard]] MotionColumns linear() const {
    return {columns_of(T_), columns_of(identity_), columns_of(force_), columns_of(mass_)};
  }  // nq columns
  [[nodiscard]] MotionColumns constant() const {
    return {columns_of(Lb_), columns_of(zero_), columns_of(force_at_zero_), columns_of(zero_)};
  }  // one column

 private:
  Eigen::MatrixXd T_, identity_, force_, mass_;  // (nq × nq)
  Eigen::VectorXd Lb_, zero_, force_at_zero_;
};

}  // namespace gp2
