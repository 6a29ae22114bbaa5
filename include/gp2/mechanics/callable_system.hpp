#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// A System whose M, A, b and F come from functions over batches of states: another library's mechanics, a simulator, Python.
///
/// What a function returns is checked at every call: shapes, M = Mᵀ (to 1e-10 of √(M_ii M_jj)), and that numbers are finite. The
/// last is not asked at a state where an entry that the part reads is not finite itself ("not measured"), nor of `evaluate` at
/// parameters that are not the model's own: a fit that strays there meets the likelihood +∞, as with a model given as text.
///
/// Derivatives in the state are those of StateEvaluator for any System: central differences over h = (ε max(1, |x_k|))^(1/3), about
/// 6e-6, which suits units in which the x_k are of size one.
class CallableSystem final : public System {
 public:
  using States = Eigen::Ref<const Eigen::MatrixXd>;      // (layout().size() × N)
  using Parameters = Eigen::Ref<const Eigen::VectorXd>;  // (parameters().size())

  /// A row of A ddq = b.
  struct Constraint {
    std::string text;                                       // what it goes by
    ConstraintLevel level = ConstraintLevel::acceleration;  // decides its residuals, where there are any
    double noise = 0;                                       // ς of System::constraint_noise
  };

  /// The functions must give the same for the same arguments and may be called from several threads at once. What they throw goes
  /// to the caller as it is.
  struct Definition {
    SystemDeclaration declaration;
    std::vector<Constraint> constraints;  // one per row of A; none: the motion is free

    /// M, A, b, F, laid out as SystemValues says.
    std::function<SystemValues(const States& states, const Parameters& parameters)> evaluate;

    /// Their derivatives in parameters()[index], exact. Optional: without it they are central differences of `evaluate` over
    /// h = ε^(1/3) s, one-sided of the same order where p ± h leaves the parameter's bounds: rounding ε|f|/h and truncation
    /// h²|f‴|/6 are then both about ε^(2/3) ≈ 4e-11 of |f|/s and s²|f‴|. s is |p|; where the bounds, or their absence, allow
    /// p = 0, it is at least the model's own |p|, and where both are 0 the larger bound, or 1.
    std::function<SystemValues(const States& states, const Parameters& parameters, int index)> differentiate;

    /// How far states are off the constraints, in the order of `constraints`: c and dc/dt of one at position level, c of one at
    /// velocity level, nothing of one at acceleration level (rows × N). Optional: without it `check` holds no state against the
    /// constraints, `simulate` does not project, so that motions drift off, `generate` solves for no coordinate, and redundant rows
    /// are known as such only at states where the constraints hold: leave them out where measured states are used. Redundancy is
    /// looked for at random states, and not where a row vanishes at one of them.
    std::function<Eigen::MatrixXd(const States& states, const Parameters& parameters)> residuals;

    /// Names of the state's entries (q1, dq1, t, u1, …) that M, A and b read, that F reads, that the residuals read: a log needs
    /// these columns. Not given: all.
    std::optional<std::vector<std::string>> mechanics_reads, force_reads, residuals_read;
  };

  /// @throws InputError when there is no coordinate, `evaluate` is empty, a name that is read is none of the state, or there are
  ///   residuals but no constraint at position or velocity level.
  explicit CallableSystem(Definition definition);

  /// @throws InputError naming the function, what was expected and what it returned.
  [[nodiscard]] SystemValues evaluate(const States& states, const Parameters& parameters) const override;
  /// The same, but for numbers that are not finite: a state may have no prediction, of which a control loop is told by a Status.
  void evaluate_into(const States& states, const Parameters& parameters, SystemValues& values) const override;
  [[nodiscard]] SystemValues differentiate(const States& states, const Parameters& parameters, int index) const override;
  [[nodiscard]] Eigen::MatrixXd residuals(const States& states, const Parameters& parameters) const override;

  [[nodiscard]] const std::vector<Residual>& residual_labels() const override { return residual_labels_; }
  [[nodiscard]] std::vector<bool> reads(SystemPart part) const override;
  /// Found at states where the constraints hold, if all are of positions and there are residuals. The first call looks for such
  /// states from random ones, by up to some thousand calls of `evaluate` and `residuals` with one state each; it leaves out states
  /// at which these throw an exception derived from std::exception.
  [[nodiscard]] int largest_rank() const override;

 private:
  void require_shapes(const char* function, const SystemValues& values, Eigen::Index n_states) const;
  void require_finite(const char* function, const SystemValues& values, const States& states) const;
  void require_symmetry(const char* function, const SystemValues& values, int i, bool derivative) const;

  Definition definition_;
  std::vector<Residual> residual_labels_;
  std::vector<bool> mechanics_reads_, force_reads_, residuals_read_;
  mutable std::atomic<int> largest_rank_ = -1;  // −1 before the first call
};

}  // namespace gp2
