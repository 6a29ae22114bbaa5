#include "gp2/base/statistics.hpp"

#include <algorithm>
#include <cmath>

#include "base/not_a_number.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// of(the measured entries) for each row, NaN where there are none
template <typename Of>
VectorXd over_measured(const Eigen::Ref<const MatrixXd>& values, const Of& of) {
  VectorXd out(values.rows());
  for (Index k = 0; k < out.size(); ++k) {
    const std::vector<double> some = measured_entries(values, k);
    out[k] = some.empty() ? not_a_number : of(VectorXd(Eigen::Map<const VectorXd>(some.data(), std::ssize(some))));
  }
  return out;
}

}  // namespace

std::vector<double> measured_entries(const Eigen::Ref<const MatrixXd>& values, Index k) {
  std::vector<double> some;
  some.reserve(static_cast<std::size_t>(values.cols()));
  for (const double value : values.row(k)) {
    if (!std::isnan(value)) some.push_back(value);
  }
  return some;
}

VectorXd row_mean(const Eigen::Ref<const MatrixXd>& values) {
  if (!values.hasNaN()) return values.rowwise().mean();
  return over_measured(values, [](const VectorXd& some) { return some.mean(); });
}

VectorXd row_stddev(const Eigen::Ref<const MatrixXd>& values) {
  if (values.hasNaN()) {
    return over_measured(values, [](const VectorXd& some) { return row_stddev(some.transpose())[0]; });
  }
  const VectorXd mean = values.rowwise().mean();
  return (values.colwise() - mean).rowwise().squaredNorm().array().sqrt() / std::sqrt(static_cast<double>(values.cols()));
}

VectorXd row_size(const Eigen::Ref<const MatrixXd>& values) {
  if (values.cols() == 0) return VectorXd::Zero(values.rows());
  return values.array().isNaN().select(0, values).cwiseAbs().rowwise().maxCoeff();
}

VectorXd row_spread(const Eigen::Ref<const MatrixXd>& values) {
  const VectorXd stddev = row_stddev(values);
  return (stddev.array() > 1e-12 * row_size(values).array()).select(stddev, 0);
}

double median(std::vector<double> values) {
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

double usual_step(const Eigen::Ref<const VectorXd>& times) {
  std::vector<double> steps;
  for (Eigen::Index i = 1; i < times.size(); ++i) {
    if (times[i] > times[i - 1]) steps.push_back(times[i] - times[i - 1]);
  }
  return steps.empty() ? 0 : median(std::move(steps));
}

}  // namespace gp2
