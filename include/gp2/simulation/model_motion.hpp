#pragma once

#include <memory>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

/// @throws InputError when a model has no [truth].
void require_truth(const Model& model);

/// The motion of a model as it is written: ddq = L b + T (M⁻¹(F + truth.force) + truth.acceleration), both 0 without [truth].
/// Where the truth reads lambda(i), the multipliers of this very motion, these are found with it (theory.md, T46). Compiled once, for
/// many calls.
class ModelMotion {
 public:
  /// @throws InputError when the model has no system.
  explicit ModelMotion(const Model& model);

  /// Whether the truth reads the load.
  [[nodiscard]] bool reads_load() const { return load_ != Load::none; }
  /// The motion under A ddq = b + push.
  /// @param push  (nc), 0 of rows that are not there
  /// @throws InputError when it is of another size.
  [[nodiscard]] ModelMotion pushed(const Eigen::VectorXd& push) const;

  /// @param states  (layout size × N)
  /// @param slip    ε of the soft constraints, A ddq = b + ς ε, of those of each state (soft rows × N); empty: none slips
  /// @return (nq × N), not finite where the truth is not
  /// @throws InputError when `slip` is of another size, as require_mechanics, where M is singular while truth.acceleration is not 0,
  /// and where the load has no solution.
  [[nodiscard]] Eigen::MatrixXd acceleration(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                             const Eigen::MatrixXd& slip = {}) const;
  /// ā = M⁻¹(F + truth.force) + truth.acceleration, which nothing constrains (nq × N). @throws as acceleration.
  [[nodiscard]] Eigen::MatrixXd unconstrained_acceleration(const Eigen::Ref<const Eigen::MatrixXd>& states) const;
  /// The multipliers λ of that motion (nc × N).
  [[nodiscard]] Eigen::MatrixXd multipliers(const Eigen::Ref<const Eigen::MatrixXd>& states) const;

 private:
  // of states of which the first has that number among all
  [[nodiscard]] Eigen::MatrixXd unconstrained(const Eigen::Ref<const Eigen::MatrixXd>& states, const MechanicsBatch& mechanics,
                                              const Eigen::MatrixXd& slip = {}, Eigen::Index first = 0) const;

  std::shared_ptr<const System> system_;
  Eigen::VectorXd parameters_;
  // what each gives at [states; multipliers], and where they are those of the motion, the multipliers
  [[nodiscard]] Eigen::MatrixXd with_load(const Eigen::Ref<const Eigen::MatrixXd>& states, const MechanicsBatch& mechanics,
                                          const Eigen::MatrixXd& slip, Eigen::Index first) const;

  Tape truth_, truth_force_;
  StateDerivatives truth_slopes_, truth_force_slopes_;  // in [state; λ]
  enum class Load { none, known, of_motion } load_ = Load::none;
};

/// The true acceleration L b + T (M⁻¹F + truth) at given states (nq × N).
/// @param slip  as ModelMotion::acceleration
/// @throws InputError when there is no [truth], or it is not finite at a state.
Eigen::MatrixXd true_acceleration(const Model& model, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                  const Eigen::MatrixXd& slip = {});

}  // namespace gp2
