#include "observations_testing.hpp"

namespace gp2::test {

Observations with_states(const Observations& group, Eigen::MatrixXd states) {
  return {std::move(states), group.view(), group.values(), group.noise()};
}

Observations with_stddev(const Observations& group, Eigen::VectorXd stddev) {
  return group.with_noise(Noise(std::move(stddev), group.noise().is_estimated(), group.noise().scale()));
}

Observations with_scale(const Observations& group, Eigen::MatrixXd scale) {
  return group.with_noise(Noise(group.noise().stddev(), group.noise().is_estimated(), std::move(scale)));
}

Observations with_estimated_noise(const Observations& group, bool is_estimated) {
  return group.with_noise(Noise(group.noise().stddev(), is_estimated, group.noise().scale()));
}

}  // namespace gp2::test
