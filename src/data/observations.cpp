#include "gp2/observations.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// the entries of row k that are measured
VectorXd measured(const Eigen::Ref<const MatrixXd>& values, Index k) {
  VectorXd some(values.cols());
  Index n = 0;
  for (const double value : values.row(k)) {
    if (!std::isnan(value)) some[n++] = value;
  }
  return some.head(n);
}

// of(the measured entries) for each row, NaN where there are none
template <typename Of>
VectorXd over_measured(const Eigen::Ref<const MatrixXd>& values, const Of& of) {
  VectorXd out(values.rows());
  for (Index k = 0; k < out.size(); ++k) {
    const VectorXd some = measured(values, k);
    out[k] = some.size() == 0 ? std::numeric_limits<double>::quiet_NaN() : of(some);
  }
  return out;
}

}  // namespace

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

VectorXd Observations::noise_at(const Eigen::Ref<const VectorXd>& stddev, Index i) const {
  VectorXd noise = stddev;
  if (has_noise_scale()) noise.array() *= noise_scale.col(i).array();
  for (Index k = 0; k < noise.size(); ++k) {
    if (std::isnan(values(k, i))) noise[k] = std::numeric_limits<double>::infinity();
  }
  return noise;
}

VectorXd Observations::measured_scales(Index k) const {
  VectorXd scales(values.cols());
  Index n = 0;
  for (Index i = 0; i < values.cols(); ++i) {
    if (!std::isnan(values(k, i))) scales[n++] = noise_scale(k, i);
  }
  return scales.head(n);
}

VectorXd Observations::usual_noise(const Eigen::Ref<const VectorXd>& stddev) const {
  if (!has_noise_scale()) return stddev;
  VectorXd usual = stddev;
  for (Index k = 0; k < usual.size(); ++k) {
    VectorXd scale = measured_scales(k);
    if (scale.size() == 0) continue;
    const auto middle = scale.begin() + scale.size() / 2;
    std::nth_element(scale.begin(), middle, scale.end());
    usual[k] *= *middle;
  }
  return usual;
}

void Observations::require_noise_scale() const {
  if (!has_noise_scale()) return;
  if (noise_scale.rows() != values.rows() || noise_scale.cols() != values.cols()) {
    throw InputError(
        fmt::format("noise_scale must hold one number for each of the {} × {} values, got {} × {}; leave it empty where "
                    "each row has one noise",
                    values.rows(), values.cols(), noise_scale.rows(), noise_scale.cols()));
  }
  for (Index entry = 0; entry < values.size(); ++entry) {
    const double scale = noise_scale.reshaped()[entry];
    if ((scale > 0 && std::isfinite(scale)) || std::isnan(values.reshaped()[entry])) continue;
    throw InputError(fmt::format(
        "noise_scale must be positive and finite, got {}; a value that is worth nothing is NaN, not measured", scale));
  }
}

}  // namespace gp2
