#include "gp2/mechanics/quantity.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

int QuantityKind::n_rows(int nq, int /*nc*/) const { return nq; }
std::optional<int> QuantityKind::added_entry(const StateLayout& /*layout*/, int /*row*/) const { return std::nullopt; }

namespace {

const Coordinate& coordinate(const System& system, int row) { return system.coordinates()[static_cast<std::size_t>(row)]; }

// A quantity that is one part of the motion, as it stands there.
template <MotionColumns::Columns MotionColumns::*part>
class PartOfMotion : public QuantityKind {
 public:
  void evaluate(const StateMechanics& /*at*/, const MotionColumns& motion, Ref<MatrixXd> out, Workspace& /*w*/) const override {
    out = motion.*part;
  }
  void differentiate(const StateMechanics& /*at*/, const MotionColumns& /*motion*/, const MotionColumns& dmotion,
                     const ConstraintChange& /*dA*/, Ref<MatrixXd> out, Workspace& /*w*/) const override {
    out = dmotion.*part;
  }

 protected:
  constexpr PartOfMotion() = default;
  constexpr ~PartOfMotion() = default;
  PartOfMotion(const PartOfMotion&) = default;
  PartOfMotion& operator=(const PartOfMotion&) = default;
};

// ddq
class ConstrainedAcceleration final : public PartOfMotion<&MotionColumns::constrained_acceleration> {
 public:
  [[nodiscard]] std::string word() const override { return "constrained"; }
  [[nodiscard]] std::string name(const System& system, int row) const override { return coordinate(system, row).acceleration(); }
  [[nodiscard]] MotionParts parts() const override { return {.constrained_acceleration = true}; }
  [[nodiscard]] bool is_acceleration() const override { return true; }
};

// ā
class UnconstrainedAcceleration final : public PartOfMotion<&MotionColumns::unconstrained_acceleration> {
 public:
  [[nodiscard]] std::string word() const override { return "unconstrained"; }
  [[nodiscard]] std::string name(const System& system, int row) const override { return "abar_" + coordinate(system, row).name; }
  [[nodiscard]] MotionParts parts() const override { return {.unconstrained_acceleration = true}; }
  [[nodiscard]] bool is_acceleration() const override { return true; }
};

// Aᵀλ
class ConstraintForce final : public PartOfMotion<&MotionColumns::constraint_force> {
 public:
  [[nodiscard]] std::string word() const override { return "constraint-force"; }
  [[nodiscard]] std::string name(const System& system, int row) const override { return "fc_" + coordinate(system, row).name; }
  [[nodiscard]] MotionParts parts() const override { return {.constraint_force = true}; }
  [[nodiscard]] double per_acceleration(double mass, double /*time_step*/) const override { return mass; }
};

// λ = K Aᵀλ with K = (Aᵀ)⁺, of minimum norm where rows are redundant
class Multipliers final : public QuantityKind {
 public:
  [[nodiscard]] std::string word() const override { return "multipliers"; }
  [[nodiscard]] int n_rows(int /*nq*/, int nc) const override { return nc; }
  [[nodiscard]] std::string name(const System& /*system*/, int row) const override { return fmt::format("lambda{}", row + 1); }
  [[nodiscard]] MotionParts parts() const override { return {.constraint_force = true}; }
  [[nodiscard]] bool is_per_coordinate() const override { return false; }
  void require_parameter_derivatives(const StateMechanics& at) const override {
    if (at.projection.rank() + at.projection.n_zero_rows() == at.A.rows()) return;
    throw InputError(
        "multipliers of redundant constraints cannot be observed while parameters are estimated: leave out the rows "
        "that follow from others");
  }

  void evaluate(const StateMechanics& at, const MotionColumns& motion, Ref<MatrixXd> out, Workspace& w) const override {
    at.projection.write_multipliers_of_force(w.K, w.projection);
    out.noalias() = w.K * motion.constraint_force;
  }

  // Where the rank of A stays the same, with f = Aᵀλ (Golub & Pereyra 1973, of (Aᵀ)⁺f; f stays in the range of Aᵀ),
  //
  //     dλ = K (df − dAᵀλ) + (I − K Aᵀ) dA Kᵀλ,
  //
  // and K Aᵀ = I of rows that are independent.
  void differentiate(const StateMechanics& at, const MotionColumns& motion, const MotionColumns& dmotion,
                     const ConstraintChange& dA, Ref<MatrixXd> out, Workspace& w) const override {
    at.projection.write_multipliers_of_force(w.K, w.projection);
    w.lambda.noalias() = w.K * motion.constraint_force;
    w.force = dmotion.constraint_force;
    dA.subtract_transposed_product(w.lambda, w.force);
    out.noalias() = w.K * w.force;
    if (at.projection.rank() == at.A.rows()) return;

    w.acceleration.noalias() = w.K.transpose() * w.lambda;
    w.of_rows.setZero(out.rows(), out.cols());
    dA.add_product(w.acceleration, w.of_rows);
    w.force.noalias() = at.A.transpose() * w.of_rows;
    out += w.of_rows;
    out.noalias() -= w.K * w.force;
  }
};

// dq + Δt ddq
class NextVelocity final : public QuantityKind {
 public:
  [[nodiscard]] std::string word() const override { return "next-velocity"; }
  [[nodiscard]] std::string name(const System& system, int row) const override {
    return coordinate(system, row).velocity() + "_next";
  }
  [[nodiscard]] MotionParts parts() const override { return {.constrained_acceleration = true}; }
  [[nodiscard]] bool needs_time_step() const override { return true; }
  [[nodiscard]] double per_acceleration(double /*mass*/, double time_step) const override { return time_step; }
  [[nodiscard]] std::optional<int> added_entry(const StateLayout& layout, int row) const override { return layout.dq(row); }

  void evaluate(const StateMechanics& at, const MotionColumns& motion, Ref<MatrixXd> out, Workspace& /*w*/) const override {
    out = at.time_step * motion.constrained_acceleration;
  }
  void differentiate(const StateMechanics& at, const MotionColumns& /*motion*/, const MotionColumns& dmotion,
                     const ConstraintChange& /*dA*/, Ref<MatrixXd> out, Workspace& /*w*/) const override {
    out = at.time_step * dmotion.constrained_acceleration;
  }
};

// M'(ā − μ): the applied force that the latents add
class LearnedForce final : public PartOfMotion<&MotionColumns::applied_force> {
 public:
  [[nodiscard]] std::string word() const override { return "force"; }
  [[nodiscard]] std::string name(const System& system, int row) const override { return "force_" + coordinate(system, row).name; }
  [[nodiscard]] MotionParts parts() const override { return {.applied_force = true}; }
  [[nodiscard]] bool has_mean() const override { return false; }
  [[nodiscard]] double per_acceleration(double mass, double /*time_step*/) const override { return mass; }
};

// constant-initialised: objects of other files may hold them before main
constexpr ConstrainedAcceleration constrained_kind;
constexpr UnconstrainedAcceleration unconstrained_kind;
constexpr ConstraintForce force_kind;
constexpr Multipliers multipliers_kind;
constexpr NextVelocity next_velocity_kind;
constexpr LearnedForce learned_force_kind;

}  // namespace

constinit const Quantity Quantity::constrained_acceleration{constrained_kind};
constinit const Quantity Quantity::unconstrained_acceleration{unconstrained_kind};
constinit const Quantity Quantity::constraint_force{force_kind};
constinit const Quantity Quantity::multipliers{multipliers_kind};
constinit const Quantity Quantity::next_velocity{next_velocity_kind};
constinit const Quantity Quantity::learned_force{learned_force_kind};

const std::vector<Quantity>& Quantity::all() {
  static const std::vector<Quantity> all = {
      constrained_acceleration, unconstrained_acceleration, constraint_force, multipliers, next_velocity, learned_force};
  return all;
}

const std::vector<std::string>& Quantity::words() {
  static const std::vector<std::string> words = [] {
    std::vector<std::string> of_all;
    for (const Quantity quantity : all()) of_all.push_back(quantity->word());
    return of_all;
  }();
  return words;
}

std::optional<Quantity> Quantity::of_word(std::string_view word) {
  const auto found = std::find_if(all().begin(), all().end(), [&](Quantity quantity) { return quantity->word() == word; });
  return found == all().end() ? std::nullopt : std::optional(*found);
}

void AffineMotion::evaluate(const UdwadiaKalaba& projection, const Ref<const MatrixXd>& M, const MotionParts& parts) {
  const Index nq = M.rows();
  T_ = projection.T();
  Lb_ = projection.Lb();
  zero_.setZero(nq);
  force_.resize(nq, nq);
  force_at_zero_.resize(nq);
  if (parts.unconstrained_acceleration) identity_.setIdentity(nq, nq);
  if (parts.applied_force) mass_ = projection.mass();
  if (parts.constraint_force) {
    force_.noalias() = M * T_;
    force_ -= projection.mass();
    force_at_zero_.noalias() = M * Lb_;
  }
}

void AffineMotion::differentiate(const UdwadiaKalaba& projection, const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& dM,
                                 const Ref<const MatrixXd>& dA, const Ref<const VectorXd>& db, const MotionParts& parts) {
  const Index nq = M.rows();
  zero_.setZero(nq);
  identity_.setZero(nq, nq);
  force_.setZero(nq, nq);
  force_at_zero_.setZero(nq);
  if (parts.applied_force) mass_ = projection.differentiate_mass(dM, dA);
  if (!parts.constrained_acceleration && !parts.constraint_force) return;
  UdwadiaKalaba::Derivative d = projection.differentiate(dM, dA, db);
  T_ = std::move(d.T);
  Lb_ = std::move(d.Lb);
  if (parts.constraint_force) {
    force_ = dM * projection.T() + M * T_ - projection.differentiate_mass(dM, dA);
    force_at_zero_ = dM * projection.Lb() + M * Lb_;
  }
}

}  // namespace gp2
