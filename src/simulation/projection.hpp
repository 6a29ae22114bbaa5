#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/system.hpp"

namespace gp2 {

/// Puts states onto the position constraints, then onto the velocity constraints, by Newton's method in the metric of M, or of
/// measured states' deviations.
class ConstraintProjection {
 public:
  /// @param held  entries of the state that stay as they are (layout size); none when empty
  ConstraintProjection(const System& system, Eigen::VectorXd parameters, const std::vector<bool>& held = {});

  /// From now on states move to the nearest one on the constraints, each change of q or dq in units of its deviation.
  /// @param stddevs  positive (2 nq)
  void weigh_by(const Eigen::VectorXd& stddevs) { weights_ = stddevs.array().square().inverse(); }

  /// @return whether the state changed.
  /// @throws NumericalError, naming the time and the residual, when a residual is not brought to rounding.
  bool apply(Eigen::VectorXd& state) const;

  /// Whether some rows of A follow from the others; they show it on the constraints, which the state is put onto.
  [[nodiscard]] bool has_redundant_rows(Eigen::VectorXd state) const;

  /// The largest |residual| over all position rows, or all velocity rows, at N states; 0 when there is none.
  [[nodiscard]] double largest_residual(const Eigen::Ref<const Eigen::MatrixXd>& states, bool velocity) const;

 private:
  /// The constraints of one level, and what moves to satisfy them.
  struct Level {
    std::vector<int> residuals;  // among the system's
    std::vector<int> rows;       // of A, one per residual
    std::vector<int> free;       // coordinates whose q, or dq, may change
    std::vector<int> entries;    // of the state, of these
    int first = 0;               // entry of the state of the first q, or dq
  };
  [[nodiscard]] Level level_of(bool velocity, const std::vector<bool>& held) const;
  bool apply(const Level& level, Eigen::VectorXd& state) const;
  /// M, or the weights of measured states, between the entries of a level that may change.
  [[nodiscard]] Eigen::MatrixXd metric(const Level& level, const Eigen::MatrixXd& M) const;
  [[nodiscard]] double share_of_step(const Level& level, const Eigen::Ref<const Eigen::VectorXd>& step, int iteration) const;
  bool newton(const Level& level, Eigen::VectorXd& state) const;
  [[noreturn]] void fail(const Level& level, const Eigen::VectorXd& state) const;

  const System& system_;
  Eigen::VectorXd parameters_;
  Eigen::VectorXd weights_;  // of q and dq, in the place of M (2 nq); empty: M
  Level position_, velocity_;
};

}  // namespace gp2
