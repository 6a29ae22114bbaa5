#include "prior/primitive.hpp"

#include <array>
#include <cmath>
#include <numbers>

#include "base/simd.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::Map;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;
using Kind = Kernel::ParameterKind;

std::span<const std::string_view> primitive_names() {
  static constexpr std::array<std::string_view, 7> names = {"se", "matern32", "matern52", "rq", "periodic", "linear", "constant"};
  return names;
}

std::span<const Kind> parameter_kinds(Primitive primitive) {
  static constexpr std::array kinds = {Kind::lengthscale, Kind::shape};
  static constexpr std::array periodic = {Kind::periodic_lengthscale, Kind::period};
  switch (primitive) {
    case Primitive::rq:
      return kinds;
    case Primitive::periodic:
      return periodic;
    case Primitive::constant:
      return {};
    default:
      return std::span(kinds).first(1);
  }
}

double feature_scale(Primitive primitive, const double* v, Index n_features, Index d) {
  return primitive == Primitive::periodic ? std::numbers::pi / v[n_features + d] : 1 / v[d];
}

namespace {

// A stationary kernel's frequencies are those of se, times this.
double spectral_spread(Primitive primitive, const double* v, Index n_features, RandomStream& random) {
  switch (primitive) {
    case Primitive::se:
      return 1;
    case Primitive::matern32:
      return std::sqrt(1.5 / random.gamma(1.5));
    case Primitive::matern52:
      return std::sqrt(2.5 / random.gamma(2.5));
    case Primitive::rq:
      return std::sqrt(random.gamma(v[n_features]) / v[n_features]);
    case Primitive::periodic:
    case Primitive::linear:
    case Primitive::constant:
      break;
  }
  return 0;
}

}  // namespace

void add_frequency(Primitive primitive, const double* v, RandomStream& random, VectorXd& frequency) {
  const Index n = frequency.size();
  if (primitive == Primitive::periodic) {
    for (Index d = 0; d < n; ++d) {
      const double mean = 0.5 / (v[d] * v[d]);
      const double up = random.poisson(mean), down = random.poisson(mean);
      frequency[d] += 2 * std::numbers::pi * (up - down) / v[n + d];
    }
    return;
  }
  const double spread = spectral_spread(primitive, v, n, random);
  for (Index d = 0; d < n; ++d) frequency[d] += spread * random.normal() / v[d];
}

namespace {

// whether it depends on r² alone
bool is_stationary(Primitive primitive) {
  return primitive != Primitive::periodic && primitive != Primitive::linear && primitive != Primitive::constant;
}

}  // namespace

void FactorColumn::squared_distance(double* r2) const { simd::loops().squared_distance(n, n_features, x, stride, p, r2); }

void FactorColumn::evaluate(double* out, double* distance) const {
  const simd::Loops<double>& loops = simd::loops();
  Map<ArrayXd> value(out, n);
  Map<ArrayXd> r(distance, n);
  switch (primitive) {
    case Primitive::se:
      loops.squared_exponential(n, n_features, x, stride, p, out);
      break;
    case Primitive::matern32:
      squared_distance(distance);
      r = std::sqrt(3.0) * r.sqrt();
      value = -r;
      loops.exponential(n, out);
      value *= 1 + r;
      break;
    case Primitive::matern52:
      squared_distance(distance);
      r = std::sqrt(5.0) * r.sqrt();
      value = -r;
      loops.exponential(n, out);
      value *= 1 + r + r.square() / 3;
      break;
    case Primitive::rq:
      squared_distance(out);
      value = (-shape() * (1 + value / (2 * shape())).log()).exp();
      break;
    case Primitive::periodic:
      value.setZero();
      for (Index d = 0; d < n_features; ++d) value += (delta(d).sin() / values[d]).square();
      value *= -2;
      loops.exponential(n, out);
      break;
    case Primitive::linear:
      value.setZero();
      for (Index d = 0; d < n_features; ++d) value += Map<const ArrayXd>(x + d * stride, n) * p[d];
      break;
    case Primitive::constant:
      value.setOnes();
      break;
  }
}

void FactorColumn::weighted_slope(const double* k, const double* w, double* slope) const {
  const simd::Loops<double>& loops = simd::loops();
  const Map<const ArrayXd> value(k, n), weight(w, n);
  Map<ArrayXd> out(slope, n);
  switch (primitive) {
    case Primitive::se:
      out = weight * value;
      break;
    case Primitive::matern32:
      squared_distance(slope);
      out = -std::sqrt(3.0) * out.sqrt();
      loops.exponential(n, slope);
      out *= 3 * weight;
      break;
    case Primitive::matern52:  // 5/3 (1 + √5 r) exp(−√5 r) = 5/3 k (1 + √5 r)/(1 + √5 r + 5/3 r²)
      squared_distance(slope);
      out = std::sqrt(5.0) * out.sqrt();
      out = weight * value * (5.0 / 3.0) * (1 + out) / (1 + out + out.square() / 3);
      break;
    case Primitive::rq:
      squared_distance(slope);
      out = weight * value / (1 + out / (2 * shape()));
      break;
    default:
      break;
  }
}

void FactorColumn::add_gradient(const double* k, const double* w, double* sums, double* scratch) const {
  constexpr Index lanes = simd::lanes<double>;
  const Map<const ArrayXd> value(k, n), weight(w, n);
  Map<ArrayXd> slope(scratch, n);
  if (is_stationary(primitive)) {
    // ∂k/∂log ℓ_d = −2 dk/d(r²) Δ_d²
    weighted_slope(k, w, scratch);
    simd::loops().add_weighted_squares(n, n_features, scratch, x, stride, p, sums);
    if (primitive == Primitive::rq) {
      squared_distance(scratch);
      slope = 1 + slope / (2 * shape());
      sums[n_features * lanes] += (weight * value * shape() * (1 - slope.inverse() - slope.log())).sum();
    }
    return;
  }
  if (primitive == Primitive::periodic) {
    for (Index d = 0; d < n_features; ++d) {
      const double inverse_square = 1 / (values[d] * values[d]);
      sums[d * lanes] += 4 * (weight * value * delta(d).sin().square()).sum() * inverse_square;
      sums[(n_features + d) * lanes] += 2 * (weight * value * (2 * delta(d)).sin() * delta(d)).sum() * inverse_square;
    }
    return;
  }
  if (primitive == Primitive::linear) {
    for (Index d = 0; d < n_features; ++d) {
      sums[d * lanes] -= 2 * (weight * Map<const ArrayXd>(x + d * stride, n)).sum() * p[d];
    }
  }
}

void FactorColumn::add_point_gradient(const double* k, const double* w, const double* scales, double* out, double* scratch,
                                      double* sums) const {
  const Map<const ArrayXd> value(k, n), weight(w, n);
  if (is_stationary(primitive)) {
    weighted_slope(k, w, scratch);
    simd::loops().weighted_differences(n, n_features, scratch, x, stride, p, sums);
    for (Index d = 0; d < n_features; ++d) out[d] += scales[d] * sums[d];
    return;
  }
  for (Index d = 0; d < n_features; ++d) {
    if (primitive == Primitive::periodic) {
      out[d] += scales[d] * 2 * (weight * value * (2 * delta(d)).sin()).sum() / (values[d] * values[d]);
    } else if (primitive == Primitive::linear) {
      out[d] += scales[d] * (weight * Map<const ArrayXd>(x + d * stride, n)).sum();
    }
  }
}

}  // namespace gp2
