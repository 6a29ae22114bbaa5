#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/model.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

/// What was measured of a motion, together with the constraints, one row after another.
class ConstrainedStates {
 public:
  /// @param measured  coordinates, sorted
  ConstrainedStates(const Model& model, std::vector<int> measured);

  [[nodiscard]] const std::vector<int>& completed() const { return free_; }  // coordinates that were not measured

  /// Solves a state and its acceleration for what was not measured, the measured coordinates held: positions and velocities by
  /// Newton's method, the acceleration from A ddq = b. Positions that nothing reads stay NaN.
  /// @param state         [q; dq; t; u], where the entries to be solved for say where Newton's method starts
  /// @param acceleration  (nq)
  /// @throws NumericalError when the constraints are not reached.
  void complete(Eigen::VectorXd& state, Eigen::Ref<Eigen::VectorXd> acceleration) const;

  /// The same in the sense of least squares, as far as Newton's method comes:
  /// where noise contradicts the constraints, close to them.
  void approach(Eigen::VectorXd& state, Eigen::Ref<Eigen::VectorXd> acceleration) const;

  /// How many constraints hold among the measured coordinates alone.
  /// @throws InputError naming what the constraints leave open at that state.
  [[nodiscard]] int redundancy(const Eigen::VectorXd& state) const;

  /// How far what was measured is off the constraints that hold among it alone.
  struct Contradiction {
    int n_constraints = 0;
    double size = 0;  // in standard deviations: the root mean square over these constraints
    /// Of q and dq of all coordinates, to where they would meet the constraints: one alone where there is one constraint, else all
    /// together, as likely as can be (2 nq).
    Eigen::VectorXd move = {};
  };
  /// c = 0 and the constraints of velocities, linearised at a state whose other entries are those of `approach`.
  /// @param stddev  of q and dq of all coordinates, read where they are measured (2 nq)
  [[nodiscard]] Contradiction contradiction(const Eigen::VectorXd& state, const Eigen::VectorXd& acceleration,
                                            const Eigen::VectorXd& stddev) const;

  /// n − rank A accelerations of measured coordinates that are far from depending on each other at that state.
  /// @param stddev  of the measured ones' accelerations
  [[nodiscard]] std::vector<int> independent_accelerations(const Eigen::VectorXd& state, const Eigen::VectorXd& stddev) const;

  /// Conditions z = (q, dq, ddq) of the measured coordinates on c = 0, ċ = 0, A ddq = b, and solves for the others.
  /// @param covariance  of (q, dq, ddq) of each measured coordinate; that of the result takes its place
  /// @throws NumericalError when that does not converge.
  void condition(Eigen::VectorXd& state, Eigen::Ref<Eigen::VectorXd> acceleration,
                 std::vector<Eigen::Matrix3d>& covariance) const;

 private:
  // with what was not measured from A ddq = b
  [[nodiscard]] Eigen::VectorXd completed_acceleration(const Eigen::VectorXd& state, Eigen::VectorXd acceleration) const;
  /// r(z) = (c, ċ, A ddq − b) and J = ∂r/∂z, z = (q, dq, ddq) of all coordinates.
  struct Linearisation {
    Eigen::VectorXd residual;
    Eigen::MatrixXd jacobian;
  };
  [[nodiscard]] Linearisation linearise(const Eigen::VectorXd& state, const Eigen::VectorXd& acceleration) const;

  const System& system_;
  Eigen::VectorXd parameters_;
  std::vector<int> measured_, free_;
  std::vector<int> seen_;                                     // the other free positions
  std::vector<int> blind_;                                    // free positions that nothing reads
  std::vector<int> position_residuals_, velocity_residuals_;  // numbers among the system's residuals
  std::vector<int> position_rows_, velocity_rows_;            // rows of A, of these
  std::vector<bool> held_;                                    // entries of the state
  ConstraintProjection projection_;
};

}  // namespace gp2
