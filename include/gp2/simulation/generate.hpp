#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/model.hpp"

namespace gp2 {

/// States drawn from a model's [sampling] and what its [truth] says of them.
struct GeneratedData {
  Eigen::MatrixXd states;         // (layout size × N); NaN where the model does not read an entry
  Eigen::MatrixXd accelerations;  // ddq = L b + T (M⁻¹F + truth), plus noise (nq × N)
  std::vector<bool> known;        // which entries of a state are drawn or solved for (layout size)
};

struct GenerateOptions {
  int n = 100;
  std::uint64_t seed = 1;
  Eigen::VectorXd noise_stddev;  // (nq), ≥ 0
  /// A grid instead of n draws: the number of points of every range in [sampling], evenly from end to end.
  std::map<std::string, int> grid = {};
};

/// Draws states, solving the constraints for coordinates and velocities that [sampling] leaves open, and measures them. Of a
/// system that gives no residuals there is nothing to solve: [sampling] must give all it reads, on its constraints.
/// @throws InputError when the grid leaves out a range or names another; when [sampling] or [truth] is missing, leaves open what
/// the constraints do not decide, or puts a state off
///   the constraints; when n < 1 or noise_stddev is not of nq finite numbers ≥ 0.
/// @throws NumericalError when Newton's method does not reach the constraints.
GeneratedData generate(const Model& model, const GenerateOptions& options);

/// Columns: the known entries of a state, then the accelerations.
/// @param name  stands for the table in messages
CsvTable as_table(const GeneratedData& data, const System& system, std::string name);

/// The motion of a model as it is written: ddq = L b + T (M⁻¹(F + truth.force) + truth.acceleration), both 0 without [truth].
/// Compiled once, for many calls.
class ModelMotion {
 public:
  explicit ModelMotion(const Model& model);

  /// @param states  (layout size × N)
  /// @return (nq × N), not finite where the truth is not
  /// @throws InputError as require_mechanics, and where M is singular while truth.acceleration is not 0.
  [[nodiscard]] Eigen::MatrixXd acceleration(const Eigen::Ref<const Eigen::MatrixXd>& states) const;

 private:
  std::shared_ptr<const System> system_;
  Eigen::VectorXd parameters_;
  Tape truth_, truth_force_;
};

/// The true acceleration L b + T (M⁻¹F + truth) at given states (nq × N).
/// @throws InputError when there is no [truth], or it is not finite at a state.
Eigen::MatrixXd true_acceleration(const Model& model, const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
