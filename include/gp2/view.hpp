#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/quantity.hpp"
#include "gp2/prior.hpp"

namespace gp2 GP2_API {

/// Another system in which the latents of a prior act: other constraints, masses or parameters, with the same coordinates and
/// inputs (Geist & Trimpe 2020, eq. 10).
struct OtherSystem {
  Prior prior;  // as many latents as the fitted prior, with the same kernels, names of features and numbers of directions
  std::vector<int> shared;  // per parameter of its system: which parameter of the fitted system it is; −1: it has its own value

  /// The parameters there, given those of the fitted system.
  [[nodiscard]] Eigen::VectorXd parameters(const Eigen::Ref<const Eigen::VectorXd>& fitted) const;
};

/// Latents of a prior that follow each other: one, or those that one [[latent]] with lengthscales of its own for each direction
/// became.
struct LatentRange {
  int first = 0, n = 1;

  LatentRange(int one) : first(one) {}  // NOLINT(google-explicit-constructor): a latent is a range of one
  LatentRange(int first_of, int n_of) : first(first_of), n(n_of) {}
  [[nodiscard]] bool has(std::size_t a) const { return static_cast<int>(a) >= first && static_cast<int>(a) < first + n; }
  bool operator==(const LatentRange&) const = default;
};

/// Rows of a quantity that is affine in the unconstrained acceleration ā of a prior: v(x) = G(x) ā(x) + d(x). Where M is singular
/// ā stands for M'⁻¹F̄, the M' of UdwadiaKalaba, and cannot be viewed itself; elsewhere M' = M.
struct View {
  using Quantity = gp2::Quantity;

  Quantity quantity = Quantity::constrained_acceleration;
  std::vector<int> rows;                 // of the quantity, in this order
  std::optional<double> time_step = {};  // Δt, of a quantity that needs one: next_velocity [s]
  /// What one latent alone adds: G E_a f_a, without μ and d. Not given: everything, of the learned force what all latents add.
  std::optional<LatentRange> latent = {};
  /// The quantity as it is under another system. Null: the prior's own system.
  std::shared_ptr<const OtherSystem> other_system = nullptr;

  /// Every row of a quantity.
  static View all(Quantity quantity, const System& system);
  static View constrained_acceleration(const System& system) { return all(Quantity::constrained_acceleration, system); }
  static View unconstrained_acceleration(const System& system) { return all(Quantity::unconstrained_acceleration, system); }
  static View constraint_force(const System& system) { return all(Quantity::constraint_force, system); }
  static View multipliers(const System& system) { return all(Quantity::multipliers, system); }
  static View next_velocity(const System& system, double time_step);
  static View learned_force(const System& system) { return all(Quantity::learned_force, system); }

  [[nodiscard]] int size() const { return static_cast<int>(rows.size()); }
  /// Whether it is of measured accelerations: ddq, to which every latent adds.
  [[nodiscard]] bool is_of_ddq() const { return quantity == Quantity::constrained_acceleration && !latent; }
  /// Δt where the quantity depends on it, else 0.
  /// @throws InputError where it is needed and not given.
  [[nodiscard]] double required_time_step() const;
  /// Whether μ, or latent a, is part of it.
  [[nodiscard]] bool has_mean() const { return !latent && quantity->has_mean(); }
  [[nodiscard]] bool has_latent(std::size_t a) const { return !latent || latent->has(a); }
  /// The entry of the state that is added to row k of the view, where there is one.
  [[nodiscard]] std::optional<int> added_entry(const StateLayout& layout, int k) const;
  /// Which entries of a state the view reads beyond those of the mechanics (layout size).
  [[nodiscard]] std::vector<bool> reads(const System& system) const;

  /// The same rows of the same quantity, under the same OtherSystem object.
  bool operator==(const View&) const = default;
  /// ddq1 … (constrained), abar_q1 … (unconstrained), fc_q1 … (constraint force), lambda1 … (multipliers), dq1_next … (next
  /// velocity), force_q1 … (learned force), with `@LATENT` behind where one latent is viewed alone.
  /// @param latent_name  of that latent
  [[nodiscard]] std::vector<std::string> names(const System& system, const std::string& latent_name = "") const;
};

/// Whether what a prior says of ddq depends on the loads of the constraints: features or directions of a latent read λ or λ₀.
bool reads_loads(const Prior& prior);

/// A view as it is under A ddq = b + push.
/// @param push  (nc), 0 of rows that are not there
/// @throws InputError when it is of another size.
View pushed(const Prior& fitted, View view, const Eigen::VectorXd& push);

/// What a view looks at: the prior of its other system, or the fitted one; and the parameters there.
const Prior& prior_of(const Prior& fitted, const View& view);
Eigen::VectorXd parameters_of(const View& view, const Eigen::Ref<const Eigen::VectorXd>& fitted);

/// @throws InputError when a prior cannot be viewed so: there are no such rows or no such latent, none are named, the time step is
/// missing or not positive, or the other system has other latents, coordinates or parameters.
void require_view(const Prior& fitted, const View& view);

/// The mechanics at N states for a view of a prior: as evaluate_mechanics of the system, and a fault also where M is singular, so
/// that there is no ā, while the view is of ā, the prior's mean constant, or a latent not on forces.
///
/// @param prior       prior_of(fitted, view)
/// @param parameters  of its system
void evaluate_mechanics(const Prior& prior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                        const Eigen::Ref<const Eigen::VectorXd>& parameters, MechanicsBatch& batch);

/// The same of any number of states, block after block in order: for_each_mechanics of udwadia_kalaba.hpp.
std::optional<MechanicsBatch::Fault> for_each_mechanics(
    const Prior& prior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
    const Eigen::Ref<const Eigen::VectorXd>& parameters,
    const std::function<void(Eigen::Index first, const MechanicsBatch& mechanics)>& visit);

/// The same, where a fault is an error.
/// @throws InputError naming the state and the rule.
MechanicsBatch require_mechanics(const Prior& prior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                 const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// Leaves of μ and E what a view has: no μ where it is none of it, no latent but those that are viewed.
void keep_viewed(const View& view, PriorValues& values);

/// What of a view of a prior has no meaning where M is singular, as a text; nothing where all has.
std::optional<std::string> what_needs_acceleration(const Prior& prior, const View& view);

/// G, d and N of a view, or their derivatives in one parameter, at N states: what is measured is G ā + d + N ε, ε ~ N(0, I), where
/// m constraints are soft. Column k of N is the change of d as b grows by ς_k e_k.
struct ViewValues {
  Eigen::MatrixXd matrix;  // G  (d·nq × N), column-major blocks
  Eigen::MatrixXd offset;  // d  (d × N)
  Eigen::MatrixXd slip;    // N  (d·m × N); no rows where every constraint is exact, or the view is of one latent

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> G(int i) const {
    return {matrix.col(i).data(), offset.rows(), offset.rows() == 0 ? 0 : matrix.rows() / offset.rows()};
  }
  [[nodiscard]] bool has_slip() const { return slip.rows() > 0; }
  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> N(int i) const {
    return {slip.col(i).data(), offset.rows(), offset.rows() == 0 ? 0 : slip.rows() / offset.rows()};
  }
};

/// @param states  (layout size × N): next_velocity reads dq
ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics, const Eigen::Ref<const Eigen::MatrixXd>& states);

/// ∂G/∂p and ∂d/∂p, given ∂M/∂p, ∂A/∂p, ∂b/∂p.
/// @throws InputError for multipliers of redundant rows, whose number may change with the parameters.
ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative);

}  // namespace gp2
