#pragma once

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "gp2/fit.hpp"
#include "inference/problems.hpp"

// Hyperparameters of a model to fit to data drawn from it.
namespace gp2::test {

/// ddx = p x + r + friction, two parameters in which the likelihood is quadratic: their covariance is (Zᵀ C⁻¹ Z)⁻¹.
inline const Model& line() {
  static const Model model = Model::parse(R"toml(
name        = "line"
coordinates = ["x"]
[parameters]
p = { value = 0.7, bounds = [-5, 5] }
r = { value = 0.2, bounds = [-5, 5] }
[mechanics]
mass  = [["1"]]
force = ["p*x + r"]
[[latent]]
kernel   = "se"
features = ["dx"]
[noise]
ddq = 0.3
[truth]
acceleration = ["0"]
[sampling]
x  = [-1, 2]
dx = [-1, 1]
)toml",
                                          "line");
  return model;
}

struct DrawnProblem {
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
};

/// n accelerations with the same noise of each coordinate, under the known force as mean.
inline DrawnProblem drawn_problem(const Model& model, int n, const std::vector<std::string>& estimated, std::uint64_t seed,
                                  double noise_stddev) {
  const VectorXd noise = VectorXd::Constant(model.system->nq(), noise_stddev);
  const GeneratedData data = generate(model, {n, seed, noise});
  DrawnProblem p{make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}};
  p.observations.push_back({data.states, View::constrained_acceleration(*model.system), data.accelerations, noise});
  p.hyperparameters = default_hyperparameters(p.prior, p.observations, estimated, {});
  return p;
}

/// The problem without hyperparameters of other kinds.
inline DrawnProblem only(DrawnProblem p, const std::vector<Hyperparameter::Kind>& kinds) {
  std::erase_if(p.hyperparameters, [&](const Hyperparameter& h) { return std::ranges::find(kinds, h.kind) == kinds.end(); });
  return p;
}

}  // namespace gp2::test
