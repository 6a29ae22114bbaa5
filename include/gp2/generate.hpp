#pragma once

#include <cstdint>

#include <Eigen/Core>

#include "gp2/model_file.hpp"

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
};

/// Draws states, solving the constraints for coordinates and velocities that [sampling] leaves open, and measures them.
/// @throws InputError when [sampling] or [truth] is missing, leaves open what the constraints do not decide, or puts a state off
///   the constraints; when n < 1 or noise_stddev is not of nq finite numbers ≥ 0.
/// @throws NumericalError when Newton's method does not reach the constraints.
GeneratedData generate(const ModelFile& model, const GenerateOptions& options);

/// The true acceleration L b + T (M⁻¹F + truth) at given states (nq × N).
Eigen::MatrixXd true_acceleration(const ModelFile& model, const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
