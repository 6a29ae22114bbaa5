#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 GP2_API {

/// One thing a check looked at.
struct Finding {
  enum class Level { good, warning, error };
  Level level = Level::good;
  std::string text;
};

/// How far a batch of states is off a position- or velocity-level constraint; the root mean square is over those where it is active.
struct ConstraintViolation {
  double relative = 0;  // |c| / Σ_j |A_j| spread(q_j), spread over the batch; velocities for velocity-level rows
  double rms = 0;       // the same, root mean square over the batch
  double value = 0;     // c itself
  int state = 0;
  std::string constraint;
};

/// States that are off the constraint by more than this fraction of its scale are told: mostly it is noise, or a log's last digit.
inline constexpr double constraint_violation_tolerance = 1e-6;
/// By more than this they deserve a warning.
inline constexpr double large_constraint_violation = 1e-2;

/// Of each residual label, in their order; NaN where the states lack what it reads.
std::vector<ConstraintViolation> constraint_violations(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                       const Eigen::Ref<const Eigen::VectorXd>& parameters);
/// The one that is relatively largest.
/// @returns nothing when the system has no such constraint, or the states lack what it reads.
std::optional<ConstraintViolation> largest_violation(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                     const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// The rank of A at a state, rows that their conditions switch off counted as rows that are there.
struct StateRank {
  int rank = 0;
  std::vector<int> inactive = {};  // rows that are switched off, in order
};
std::vector<StateRank> ranks_of(const System& system, const MechanicsBatch& mechanics);

/// States where A has a lower rank than at others with the same active rows, or with more: a constraint lets go there, or follows
/// from the rest. Unknown, and none, after a fault.
struct LowerRank {
  int usual = 0;            // the highest rank, of states with the rows that are active at the lowest
  int lowest = 0;           // of A, where it is farthest below its usual
  std::vector<int> states;  // where it is below its usual, in order
};
/// @param ranks  at each state
LowerRank states_of_lower_rank(const std::vector<StateRank>& ranks);
/// The same of any number of states, in the memory of a few.
LowerRank states_of_lower_rank(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                               const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// Whether measured accelerations obey rows of A ddq = b, or combinations of them, to rounding or to 3 % of their noise: then they
/// were computed from each other, and only nq − rank of these combinations are independent measurements. Treating all as independent
/// makes an estimated noise collapse to zero.
///
/// @param accelerations  (nq × N); states with one that is not measured (NaN) are left out
/// @param stddev         of their noise (nq × N); NaN, or empty: not known
/// @returns the rows of ddq to observe instead (the best-conditioned independent set); nothing when the columns are independent.
/// @throws InputError when a size is wrong; so do those below.
std::optional<std::vector<int>> dependent_columns(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                  const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                                  const Eigen::Ref<const Eigen::MatrixXd>& accelerations,
                                                  const Eigen::Ref<const Eigen::MatrixXd>& stddev = Eigen::MatrixXd());

/// Measured accelerations against one row of A ddq = b: r = A ddq − b is what noise makes of it, if the model and the data are right.
struct ConstraintResidual {
  std::string constraint;
  int n = 0;               // states at which every acceleration that the row reads is measured
  double rms = 0;          // of r
  double mean = 0;         // of r
  double expected = 0;     // of √(A S Aᵀ), root mean square; NaN where the noise S is not known
  double size = 0;         // of |A| |ddq| + |b|, root mean square
  std::vector<int> worst;  // states with the largest r, in units of the expected one where that is known; at most three
  int n_outliers = 0;      // states, at most one in twenty, without which r is noise; 0: r is noise, or too large at many states
  std::vector<int> lines = {};  // in its log of each state, by which the worst are named; empty: they are named as rows, from 1

  /// Whether r is more than noise: more than twice what is expected, beyond what chance does to n values; where the noise is not
  /// known, an offset that stands out of the scatter, or half as large as the terms that should cancel.
  [[nodiscard]] bool is_too_large() const;
  /// Whether r is less than half of what the noise makes, beyond what chance does to n values.
  [[nodiscard]] bool is_too_small() const;
  /// "the residual of 'z - h*x^2' is 9.69, expected 0.2 from the noise: 48 ×, …": what it means, for people.
  [[nodiscard]] std::string text() const;
};

/// One for each row of A, of which a state at least is measured.
/// @param accelerations  (nq × N); NaN: not measured
/// @param stddev         of their noise (nq × N); NaN, or empty: not known
std::vector<ConstraintResidual> constraint_residuals(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                     const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                                     const Eigen::Ref<const Eigen::MatrixXd>& accelerations,
                                                     const Eigen::Ref<const Eigen::MatrixXd>& stddev);

/// Functions of all states at once must give each its own values: not one array for all, nor those of its neighbours.
/// @returns which part of the system does not, as a text; nothing if all do, as expressions do
std::optional<std::string> mixed_states(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                        const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// Is the system well-posed at these states? M symmetric and positive definite or completed by A, A of constant rank, its rows
/// neither nearly zero nor nearly redundant, b in the range of A, derivatives in the parameters equal to finite differences, A
/// and b equal to the second derivative of the constraints along a motion. Of a system without expressions also: does it read no
/// more of a state than it declares (System::reads)?
///
/// @param states     (layout size × N), N ≥ 1, as good as on the constraint
/// @param n_threads  that may work on it; 0: as many as the machine has
std::vector<Finding> check_system(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                  const Eigen::Ref<const Eigen::VectorXd>& parameters, int n_threads = 1);

/// How a log fits the system: states on the constraint, accelerations on A ddq = b, independent columns.
///
/// @param accelerations  (nq × N); NaN where not measured
/// @param stddev         of their noise (nq × N); NaN, or empty: not known
/// @param stated         rows of ddq whose standard deviations the log states: those that a fit observes; empty: all
/// @param estimates_noise  whether deviations that are not stated are only a start, from which a fit finds them
std::vector<Finding> check_data(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                const Eigen::Ref<const Eigen::MatrixXd>& accelerations,
                                const Eigen::Ref<const Eigen::MatrixXd>& stddev, const std::vector<int>& stated = {},
                                bool estimates_noise = false);

}  // namespace gp2
