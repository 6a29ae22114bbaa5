#include "prior/kernel_columns.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "base/simd.hpp"
#include "prior/padded_rows.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

// One factor of a kernel between n points and one more, in scaled features: Δ_d = x_d − p_d.
struct KernelColumns::FactorColumn {
  Primitive primitive;
  Index n, n_features, stride;
  const double* x;       // (n × D)
  const double* p;       // (D)
  const double* values;  // of the factor's parameters

  [[nodiscard]] double shape() const { return values[n_features]; }  // α of rq
  [[nodiscard]] auto delta(Index d) const { return Map<const ArrayXd>(x + d * stride, n) - p[d]; }
  [[nodiscard]] bool is_stationary() const;
  void squared_distance(double* r2) const { simd::loops().squared_distance(n, n_features, x, stride, p, r2); }

  void evaluate(double* out, double* distance) const;
  void weighted_slope(const double* k, const double* w, double* slope) const;
  void add_gradient(const double* k, const double* w, double* sums, double* scratch) const;
  void add_point_gradient(const double* k, const double* w, const double* scales, double* out, double* scratch,
                          double* sums) const;
};

bool KernelColumns::FactorColumn::is_stationary() const {
  return primitive == Primitive::se || primitive == Primitive::matern32 || primitive == Primitive::matern52 ||
         primitive == Primitive::rq;
}

// the factor's value, with √3 r or √5 r of a Matérn kernel left in `distance`
void KernelColumns::FactorColumn::evaluate(double* out, double* distance) const {
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

// −2 dk/d(r²) of a stationary factor of value k, times w
void KernelColumns::FactorColumn::weighted_slope(const double* k, const double* w, double* slope) const {
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

// Adds Σ_i w_i ∂k_i/∂log v for the factor's parameters; column v of `sums` begins at sums + v · lanes.
void KernelColumns::FactorColumn::add_gradient(const double* k, const double* w, double* sums, double* scratch) const {
  constexpr Index lanes = simd::lanes<double>;
  const Map<const ArrayXd> value(k, n), weight(w, n);
  Map<ArrayXd> slope(scratch, n);
  if (is_stationary()) {
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

// out_d += scale_d Σ_i w_i ∂k_i/∂p_d, p the scaled features of the point
void KernelColumns::FactorColumn::add_point_gradient(const double* k, const double* w, const double* scales, double* out,
                                                     double* scratch, double* sums) const {
  const Map<const ArrayXd> value(k, n), weight(w, n);
  if (is_stationary()) {
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

KernelColumns::KernelColumns(Kernel kernel, const Ref<const MatrixXd>& features)
    : kernel_(std::move(kernel)), n_points_(features.rows()) {
  const Index n_rows = simd::padded(n_points_);
  features_ = MatrixXd::Zero(n_rows, features.cols());
  features_.topRows(n_points_) = features;
  scaled_.setZero(n_rows, kernel_.n_scaled_columns());
  scales_.setOnes(kernel_.n_scaled_columns());
  const auto& terms = kernel_.terms();
  is_squared_exponential_ = terms.size() == 1 && terms[0].factors.size() == 1 && terms[0].factors[0].primitive == Primitive::se;
  for (const Kernel::Term& term : terms) max_factors_ = std::max(max_factors_, static_cast<Index>(term.factors.size()));
}

KernelColumns::KernelColumns(Kernel kernel, const Ref<const MatrixXd>& features, const Ref<const VectorXd>& values)
    : KernelColumns(std::move(kernel), features) {
  set_parameters(values);
}

void KernelColumns::set_parameters(const Ref<const VectorXd>& values) {
  values_ = values;
  const Index n_features = kernel_.n_features();
  for (const Kernel::Term& term : kernel_.terms()) {
    for (const Kernel::Factor& factor : term.factors) {
      if (factor.primitive == Primitive::constant) continue;
      for (Index d = 0; d < n_features; ++d) {
        const Index column = factor.first_column + d;
        scales_[column] = factor.primitive == Primitive::periodic
                              ? std::numbers::pi / values_[factor.first_parameter + n_features + d]
                              : 1 / values_[factor.first_parameter + d];
        scaled_.col(column) = scales_[column] * features_.col(d);
      }
    }
  }
}

void KernelColumns::append(const Ref<const MatrixXd>& features) {
  const Index first = n_points_, n = features.rows();
  n_points_ += n;
  resize_points(features_, n_points_);
  resize_points(scaled_, n_points_);
  features_.middleRows(first, n) = features;
  for (Index column = 0; column < n_scaled(); ++column) {
    scaled_.col(column).segment(first, n) = scales_[column] * features.col(column % features.cols());
  }
}

void KernelColumns::erase(const std::vector<Index>& points) {
  erase_points(features_, n_points_, points);
  erase_points(scaled_, n_points_, points);
  n_points_ -= static_cast<Index>(points.size());
}

void KernelColumns::scale(const Ref<const VectorXd>& features, VectorXd& point) const {
  point.resize(n_scaled());
  for (Index first = 0; first < n_scaled(); first += features.size()) {
    point.segment(first, features.size()) = scales_.segment(first, features.size()).cwiseProduct(features);
  }
}

void KernelColumns::scale(Index fixed_point, VectorXd& point) const { point = scaled_.row(fixed_point).transpose(); }

double KernelColumns::amplitude(const Kernel::Term& term) const {
  return term.amplitude < 0 ? 1 : values_[term.amplitude] * values_[term.amplitude];
}

KernelColumns::FactorColumn KernelColumns::column_of(const Kernel::Factor& factor, Index first, Index n,
                                                     const VectorXd& point) const {
  return {factor.primitive,
          n,
          kernel_.n_features(),
          scaled_.rows(),
          scaled_.data() + first + factor.first_column * scaled_.rows(),
          point.data() + factor.first_column,
          values_.data() + factor.first_parameter};
}

double* KernelColumns::columns(Workspace& workspace, Index n) const {
  // one per factor, two more, and a row of features
  const std::size_t size = static_cast<std::size_t>(n * (max_factors_ + 2) + kernel_.n_features());
  if (workspace.columns.size() < size) workspace.columns.resize(size);
  return workspace.columns.data();
}

void KernelColumns::evaluate(Index first, Index n, const VectorXd& point, double* out, Workspace& workspace) const {
  if (is_squared_exponential_) {
    simd::loops().squared_exponential(n, kernel_.n_features(), scaled_.data() + first, scaled_.rows(), point.data(), out);
    return;
  }
  double* const memory = columns(workspace, n);
  Map<ArrayXd> product(memory, n), value(memory + n, n), total(out, n);
  total.setZero();
  for (const Kernel::Term& term : kernel_.terms()) {
    product.setConstant(amplitude(term));
    for (const Kernel::Factor& factor : term.factors) {
      column_of(factor, first, n, point).evaluate(value.data(), memory + 2 * n);
      product *= value;
    }
    total += product;
  }
}

double KernelColumns::variance(const VectorXd& point) const {
  double variance = 0;
  for (const Kernel::Term& term : kernel_.terms()) {
    double product = amplitude(term);
    for (const Kernel::Factor& factor : term.factors) {
      if (factor.primitive != Primitive::linear) continue;
      double square = 0;
      for (Index d = 0; d < kernel_.n_features(); ++d) square += point[factor.first_column + d] * point[factor.first_column + d];
      product *= square;
    }
    variance += product;
  }
  return variance;
}

void KernelColumns::evaluate_factors(const Kernel::Term& term, Index first, Index n, const VectorXd& point, const double* k,
                                     double* memory) const {
  if (is_squared_exponential_) {
    std::copy_n(k, n, memory + 2 * n);
    return;
  }
  for (std::size_t f = 0; f < term.factors.size(); ++f) {
    column_of(term.factors[f], first, n, point).evaluate(memory + (static_cast<Index>(f) + 2) * n, memory);
  }
}

void KernelColumns::add_gradient(Index first, Index n, const VectorXd& point, const double* k, const double* w, MatrixXd& sums,
                                 Workspace& workspace) const {
  double* const memory = columns(workspace, n);
  Map<ArrayXd> weight(memory, n);
  const auto value = [&](std::size_t f) { return Map<ArrayXd>(memory + (static_cast<Index>(f) + 2) * n, n); };
  const Map<const ArrayXd> given(w, n);
  for (const Kernel::Term& term : kernel_.terms()) {
    evaluate_factors(term, first, n, point, k, memory);
    for (std::size_t f = 0; f < term.factors.size(); ++f) {
      // product rule: the weight of one factor carries all the others
      weight = amplitude(term) * given;
      for (std::size_t other = 0; other < term.factors.size(); ++other) {
        if (other != f) weight *= value(other);
      }
      column_of(term.factors[f], first, n, point)
          .add_gradient(value(f).data(), weight.data(), sums.data() + term.factors[f].first_parameter * sums.rows(), memory + n);
    }
    if (term.amplitude >= 0) {
      weight = 2 * amplitude(term) * given;
      for (std::size_t f = 0; f < term.factors.size(); ++f) weight *= value(f);
      sums(0, term.amplitude) += weight.sum();
    }
  }
}

void KernelColumns::differentiate(Index first, Index n, const VectorXd& point, const double* k, const double* W, Index ldw,
                                  Index m, double* out, Workspace& workspace) const {
  const Index n_features = kernel_.n_features();
  double* const memory = columns(workspace, n);
  double* const row = memory + n * (max_factors_ + 2);
  Map<ArrayXd> weight(memory, n);
  const auto value = [&](std::size_t f) { return Map<ArrayXd>(memory + (static_cast<Index>(f) + 2) * n, n); };
  std::fill_n(out, n_features * m, 0.0);
  for (const Kernel::Term& term : kernel_.terms()) {
    evaluate_factors(term, first, n, point, k, memory);
    for (Index l = 0; l < m; ++l) {
      for (std::size_t f = 0; f < term.factors.size(); ++f) {
        weight = amplitude(term) * Map<const ArrayXd>(W + l * ldw, n);
        for (std::size_t other = 0; other < term.factors.size(); ++other) {
          if (other != f) weight *= value(other);
        }
        column_of(term.factors[f], first, n, point)
            .add_point_gradient(value(f).data(), weight.data(), scales_.data() + term.factors[f].first_column,
                                out + l * n_features, memory + n, row);
      }
    }
  }
}

}  // namespace gp2
