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
/// Compiled once, for many calls.
class ModelMotion {
 public:
  explicit ModelMotion(const Model& model);

  /// @param states  (layout size × N)
  /// @return (nq × N), not finite where the truth is not
  /// @throws InputError as require_mechanics, and where M is singular while truth.acceleration is not 0.
  [[nodiscard]] Eigen::MatrixXd acceleration(const Eigen::Ref<const Eigen::MatrixXd>& states) const;
  /// ā = M⁻¹(F + truth.force) + truth.acceleration, which nothing constrains (nq × N). @throws as acceleration.
  [[nodiscard]] Eigen::MatrixXd unconstrained_acceleration(const Eigen::Ref<const Eigen::MatrixXd>& states) const;
  /// The multipliers λ of that motion (nc × N).
  [[nodiscard]] Eigen::MatrixXd multipliers(const Eigen::Ref<const Eigen::MatrixXd>& states) const;

 private:
  [[nodiscard]] Eigen::MatrixXd unconstrained(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                              const MechanicsBatch& mechanics) const;

  std::shared_ptr<const System> system_;
  Eigen::VectorXd parameters_;
  Tape truth_, truth_force_;
  bool reads_load_ = false;  // one of them has λ₀ among its inputs
};

/// The true acceleration L b + T (M⁻¹F + truth) at given states (nq × N).
/// @throws InputError when there is no [truth], or it is not finite at a state.
Eigen::MatrixXd true_acceleration(const Model& model, const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
