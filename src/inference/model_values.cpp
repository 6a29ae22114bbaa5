#include "gp2/inference/model_values.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd ModelValues::loading(std::size_t a) const {
  if (has_free_loading(a)) return free_loading[a];
  return signal_stddev[a].asDiagonal();
}

ModelGradient ModelGradient::zero(const ModelValues& values) {
  ModelGradient gradient{values.kernel, values.signal_stddev, values.free_loading, values.noise_stddev, values.parameters};
  for (VectorXd& v : gradient.log_kernel) v.setZero();
  for (VectorXd& v : gradient.log_signal_stddev) v.setZero();
  for (MatrixXd& C : gradient.free_loading) C.setZero();
  for (VectorXd& v : gradient.log_noise_stddev) v.setZero();
  gradient.parameters.setZero();
  return gradient;
}

void ModelGradient::add(const ModelGradient& other) {
  const auto add_each = [](auto& to, const auto& from) {
    for (std::size_t k = 0; k < to.size(); ++k) to[k] += from[k];
  };
  add_each(log_kernel, other.log_kernel);
  add_each(log_signal_stddev, other.log_signal_stddev);
  add_each(free_loading, other.free_loading);
  add_each(log_noise_stddev, other.log_noise_stddev);
  parameters += other.parameters;
}

}  // namespace gp2
