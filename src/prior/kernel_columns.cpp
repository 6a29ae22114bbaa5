#include "prior/kernel_columns.hpp"

#include <algorithm>
#include <utility>

#include "base/simd.hpp"
#include "prior/padded_rows.hpp"
#include "prior/primitive.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

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
        scales_[column] = feature_scale(factor.primitive, values_.data() + factor.first_parameter, n_features, d);
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

FactorColumn KernelColumns::column_of(const Kernel::Factor& factor, Index first, Index n, const VectorXd& point) const {
  return {factor.primitive,
          n,
          kernel_.n_features(),
          scaled_.rows(),
          scaled_.data() + first + factor.first_column * scaled_.rows(),
          point.data() + factor.first_column,
          values_.data() + factor.first_parameter};
}

namespace {

// where the values of a term's factor stand
double* of_factor(double* memory, Index n, std::size_t f) { return memory + (static_cast<Index>(f) + 2) * n; }

}  // namespace

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
    std::copy_n(k, n, of_factor(memory, n, 0));
    return;
  }
  for (std::size_t f = 0; f < term.factors.size(); ++f) {
    column_of(term.factors[f], first, n, point).evaluate(of_factor(memory, n, f), memory);
  }
}

void KernelColumns::weigh(const Kernel::Term& term, std::size_t f, Index n, const double* w, double* memory) const {
  Map<ArrayXd> weight(memory, n);
  weight = amplitude(term) * Map<const ArrayXd>(w, n);
  for (std::size_t other = 0; other < term.factors.size(); ++other) {
    if (other != f) weight *= Map<const ArrayXd>(of_factor(memory, n, other), n);
  }
}

void KernelColumns::add_gradient(Index first, Index n, const VectorXd& point, const double* k, const double* w, MatrixXd& sums,
                                 Workspace& workspace) const {
  double* const memory = columns(workspace, n);
  for (const Kernel::Term& term : kernel_.terms()) {
    evaluate_factors(term, first, n, point, k, memory);
    for (std::size_t f = 0; f < term.factors.size(); ++f) {
      weigh(term, f, n, w, memory);
      double* const sums_of_factor = sums.data() + term.factors[f].first_parameter * sums.rows();
      column_of(term.factors[f], first, n, point).add_gradient(of_factor(memory, n, f), memory, sums_of_factor, memory + n);
    }
    if (term.amplitude >= 0) {
      weigh(term, term.factors.size(), n, w, memory);  // by all of them
      sums(0, term.amplitude) += 2 * Map<const ArrayXd>(memory, n).sum();
    }
  }
}

void KernelColumns::differentiate(Index first, Index n, const VectorXd& point, const double* k, const double* W, Index ldw,
                                  Index m, double* out, Workspace& workspace) const {
  const Index n_features = kernel_.n_features();
  double* const memory = columns(workspace, n);
  double* const row = memory + n * (max_factors_ + 2);
  std::fill_n(out, n_features * m, 0.0);
  for (const Kernel::Term& term : kernel_.terms()) {
    evaluate_factors(term, first, n, point, k, memory);
    for (Index l = 0; l < m; ++l) {
      for (std::size_t f = 0; f < term.factors.size(); ++f) {
        weigh(term, f, n, W + l * ldw, memory);
        column_of(term.factors[f], first, n, point)
            .add_point_gradient(of_factor(memory, n, f), memory, scales_.data() + term.factors[f].first_column,
                                out + l * n_features, memory + n, row);
      }
    }
  }
}

}  // namespace gp2
