#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/model.hpp"
#include "gp2/simulation/model_motion.hpp"

namespace gp2 GP2_API {

/// States drawn from a model's [sampling], or met in its [motion], and what its [truth] says of them: where dry friction holds a
/// driven body, that it rests.
struct GeneratedData {
  Eigen::MatrixXd states;         // (layout size × N); NaN where the model does not read an entry
  Eigen::MatrixXd accelerations;  // ddq = L b + T (M⁻¹F + truth), plus noise and slip (nq × N)
  std::vector<bool> known;        // which entries of a state are drawn or solved for (layout size)
};

struct GenerateOptions {
  int n = 100;
  std::uint64_t seed = 1;
  Eigen::VectorXd noise_stddev;  // (nq), ≥ 0; all 0: soft constraints do not slip either
  /// A grid instead of n draws: the number of points of every range in [sampling], evenly from end to end.
  std::map<std::string, int> grid = {};
};

/// Draws states, solving the constraints for coordinates and velocities that [sampling] leaves open, and measures them. Of a
/// system that gives no residuals there is nothing to solve: [sampling] must give all it reads, on its constraints.
/// @throws InputError when the grid leaves out a range or names another; when [sampling] or [truth] is missing, leaves open what
///   the constraints do not decide, or puts a state off the constraints; when a model with [motion] has contacts; when n < 1 or
///   noise_stddev is not of nq finite numbers ≥ 0.
/// @throws NumericalError when Newton's method does not reach the constraints.
GeneratedData generate(const Model& model, const GenerateOptions& options);

/// Columns: the known entries of a state, then the accelerations.
/// @param name  stands for the table in messages
CsvTable as_table(const GeneratedData& data, const System& system, std::string name);

}  // namespace gp2
