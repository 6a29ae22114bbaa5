#include "gp2/observations.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include <fmt/format.h>

#include "base/number_range.hpp"
#include "base/shape.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

void append_columns(MatrixXd& matrix, const MatrixXd& more) {
  matrix.conservativeResize(Eigen::NoChange, matrix.cols() + more.cols());
  matrix.rightCols(more.cols()) = more;
}

void erase_first_columns(MatrixXd& matrix, Index n) {
  std::copy(matrix.data() + n * matrix.rows(), matrix.data() + matrix.size(), matrix.data());
  matrix.conservativeResize(Eigen::NoChange, matrix.cols() - n);
}

}  // namespace

const MatrixXd& SharedMatrix::get() const {
  static const MatrixXd empty;
  return matrix_ ? *matrix_ : empty;
}

MatrixXd& SharedMatrix::change() {
  if (!matrix_ || matrix_.use_count() > 1) {
    matrix_ = std::make_shared<MatrixXd>(get());
  } else {
    // what another thread read through a copy that it has just let go was read before what is written now
    std::shared_ptr<const MatrixXd>(matrix_).reset();
  }
  return *matrix_;
}

Noise::Noise(VectorXd stddev, bool is_estimated, MatrixXd scale)
    : stddev_(std::move(stddev)), is_estimated_(is_estimated), scale_(SharedMatrix(std::move(scale))) {}

VectorXd Noise::at(const Eigen::Ref<const VectorXd>& stddev, Index i) const {
  VectorXd noise = stddev;
  if (has_scale()) noise.array() *= scale().col(i).array();
  return noise;
}

MatrixXd Noise::of_values(const Eigen::Ref<const VectorXd>& stddev, Index n) const {
  MatrixXd noise = stddev.replicate(1, n);
  if (has_scale()) noise.array() *= scale().array();
  return noise;
}

Noise Noise::take(const std::vector<int>& states) const {
  return Noise(stddev_, is_estimated_, has_scale() ? MatrixXd(scale()(Eigen::all, states)) : MatrixXd());
}

Noise Noise::slice(int first, int n) const {
  return Noise(stddev_, is_estimated_, has_scale() ? MatrixXd(scale().middleCols(first, n)) : MatrixXd());
}

void Noise::append(const Noise& more) {
  if (has_scale() != more.has_scale()) {
    throw InputError("observations: some have a noise of each value and some have not; give all of them a noise_scale, or none");
  }
  if (has_scale()) append_columns(scale_.change(), more.scale());
}

void Noise::remove_first(int n) {
  if (has_scale()) erase_first_columns(scale_.change(), n);
}

void Noise::require_noise_of(const MatrixXd& values) const {
  if (stddev_.size() != values.rows()) {
    throw InputError(fmt::format("observations: `noise_stddev` must have one number for each of the view's {} rows, got {}",
                                 values.rows(), stddev_.size()));
  }
  for (const double sigma : stddev_) {
    if (sigma > 0 && sigma <= largest_number) continue;
    throw InputError(
        fmt::format("observations: `noise_stddev` must be positive and at most {:.0e}, got {}", largest_number, sigma));
  }
  if (!has_scale()) return;
  if (scale().rows() != values.rows() || scale().cols() != values.cols()) {
    throw InputError(
        fmt::format("noise_scale must hold one number for each of the {} × {} values, got {} × {}; leave it empty where "
                    "each row has one noise",
                    values.rows(), values.cols(), scale().rows(), scale().cols()));
  }
  for (Index entry = 0; entry < values.size(); ++entry) {
    const double one = scale().reshaped()[entry];
    if ((one > 0 && std::isfinite(one)) || std::isnan(values.reshaped()[entry])) continue;
    throw InputError(
        fmt::format("noise_scale must be positive and finite, got {}; a value that is worth nothing is NaN, not measured", one));
  }
}

Observations::Observations(MatrixXd states, View view, MatrixXd values, Noise noise)
    : Observations(SharedMatrix(std::move(states)), std::move(view), SharedMatrix(std::move(values)), std::move(noise)) {}

Observations::Observations(SharedMatrix states, View view, SharedMatrix values, Noise noise)
    : states_(std::move(states)), view_(std::move(view)), values_(std::move(values)), noise_(std::move(noise)) {
  if (this->values().rows() != view_.size() || this->values().cols() != n_data()) {
    throw InputError(
        fmt::format("observations: `values` must have a row for each of the view's {} and a column for each of the {} "
                    "states, got {} × {}",
                    view_.size(), n_data(), this->values().rows(), this->values().cols()));
  }
  if (this->values().array().isInf().any()) {
    throw InputError("observations: `values` must be finite, or NaN where nothing is measured; got one that is infinite");
  }
  noise_.require_noise_of(this->values());
}

Observations::Observations(MatrixXd states, View view, MatrixXd values, VectorXd noise_stddev, bool estimate_noise,
                           MatrixXd noise_scale)
    : Observations(std::move(states), std::move(view), std::move(values),
                   Noise(std::move(noise_stddev), estimate_noise, std::move(noise_scale))) {}

Observations Observations::with_states(MatrixXd states) const {
  Observations out(SharedMatrix(std::move(states)), view_, values_, noise_);
  out.sums_ = sums_;
  return out;
}

Observations Observations::with_sums(std::vector<WeightedSum> sums) const {
  for (std::size_t r = 0; r < sums.size(); ++r) {
    const WeightedSum& one = sums[r];
    const Index n_weights = one.weights.size(), n = one.noise.size();
    if (one.row < 0 || one.row >= view_.size() || one.first < 0 || n_weights == 0 || one.first + n_weights > n_data()) {
      throw InputError(fmt::format("observations: sum {} is of row {} and {} states from {} on: there are {} rows and {} states",
                                   r + 1, one.row, n_weights, one.first, view_.size(), n_data()));
    }
    bool is_sound = one.weights.allFinite() && std::isfinite(one.value) && one.noise.allFinite() && n > 0 &&
                    n <= static_cast<Index>(r) + 1 && one.noise[n - 1] > 0;
    for (Index j = 1; is_sound && j < n; ++j) is_sound = sums[r - static_cast<std::size_t>(j)].row == one.row;
    if (is_sound) continue;
    throw InputError(
        fmt::format("observations: sum {}: its numbers must be finite, its own noise positive, and what comes before that "
                    "of sums of the same row before it",
                    r + 1));
  }
  Observations out = *this;
  out.sums_ = std::move(sums);
  return out;
}

void Observations::require_no_sums() const {
  if (has_sums()) throw InputError("observations that have sums over states neither grow nor shrink: condition on others anew");
}

namespace {

void require_states(Index first, Index n, Index n_all) {
  if (first >= 0 && n >= 0 && n <= n_all - first) return;
  throw InputError(fmt::format("observations: {} states from number {} on are asked for, of {}", n, first, n_all));
}

void require_row(Index k, Index n_rows) {
  if (k >= 0 && k < n_rows) return;
  throw InputError(fmt::format("observations: there are the rows 0 … {}, got {}", n_rows - 1, k));
}

void require_stddev(const Eigen::Ref<const VectorXd>& stddev, Index n_rows) {
  require_shape("observations: the noise of each row", stddev, n_rows, 1);
}

}  // namespace

Observations Observations::take(const std::vector<int>& states) const {
  require_no_sums();
  for (const int i : states) require_states(i, 1, n_data());
  return {MatrixXd(this->states()(Eigen::all, states)), view_, MatrixXd(values()(Eigen::all, states)), noise_.take(states)};
}

Observations Observations::slice(int first, int n) const {
  require_no_sums();
  require_states(first, n, n_data());
  return {MatrixXd(states().middleCols(first, n)), view_, MatrixXd(values().middleCols(first, n)), noise_.slice(first, n)};
}

void Observations::append(const Observations& more) {
  require_no_sums();
  more.require_no_sums();
  require_shape("observations: states that are added", more.states(), states().rows(), more.n_data());
  require_shape("observations: values that are added", more.values(), values().rows(), more.n_data());
  noise_.append(more.noise_);
  append_columns(states_.change(), more.states());
  append_columns(values_.change(), more.values());
}

void Observations::remove_first(int n) {
  if (n > 0) require_no_sums();
  require_states(0, n, n_data());
  erase_first_columns(states_.change(), n);
  erase_first_columns(values_.change(), n);
  noise_.remove_first(n);
}

VectorXd Observations::noise_at(const Eigen::Ref<const VectorXd>& stddev, Index i) const {
  require_stddev(stddev, values().rows());
  require_states(i, 1, n_data());
  VectorXd noise = noise_.at(stddev, i);
  for (Index k = 0; k < noise.size(); ++k) {
    if (std::isnan(values()(k, i))) noise[k] = std::numeric_limits<double>::infinity();
  }
  return noise;
}

MatrixXd Observations::noise_of_values(const Eigen::Ref<const VectorXd>& stddev) const {
  require_stddev(stddev, values().rows());
  return values().array().isNaN().select(std::numeric_limits<double>::infinity(), noise_.of_values(stddev, n_data()));
}

bool Observations::states_noise(Index k) const {
  require_row(k, values().rows());
  if (!noise_.has_scale()) return false;
  const std::vector<double> scales = measured_scales(k);
  return !scales.empty() && *std::min_element(scales.begin(), scales.end()) != 1;
}

std::vector<double> Observations::measured_scales(Index k) const {
  require_row(k, values().rows());
  std::vector<double> scales;
  for (Index i = 0; i < values().cols(); ++i) {
    if (!std::isnan(values()(k, i))) scales.push_back(noise_.has_scale() ? noise_.scale()(k, i) : 1);
  }
  return scales;
}

VectorXd Observations::usual_noise(const Eigen::Ref<const VectorXd>& stddev) const {
  require_stddev(stddev, values().rows());
  VectorXd usual = stddev;
  for (Index k = 0; k < usual.size() && noise_.has_scale(); ++k) {
    std::vector<double> scales = measured_scales(k);
    if (!scales.empty()) usual[k] *= median(std::move(scales));
  }
  return usual;
}

}  // namespace gp2
