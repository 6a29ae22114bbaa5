#include "gp2/smoothing/windows.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include <fmt/format.h>
#include <Eigen/Cholesky>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// The cubic B-spline of the knots −2 … 2, and its derivative.
double spline(double x) {
  x = std::abs(x);
  if (x >= 2) return 0;
  return x >= 1 ? std::pow(2 - x, 3) / 6 : 2.0 / 3 - x * x + x * x * x / 2;
}

double spline_slope(double x) {
  const double size = std::abs(x);
  if (size >= 2) return 0;
  return size >= 1 ? -std::copysign(std::pow(2 - size, 2) / 2, x) : -2 * x + 1.5 * x * size;
}

}  // namespace

double WindowGrid::weight(int window, double time) const { return spline((time - begin(window)) / spacing - 2); }

namespace {

// Positions of one time each: several at one time are their mean.
struct Samples {
  std::vector<double> time, value, variance;

  Samples(const std::vector<Measurement>& positions, const SmootherModel& model) {
    std::vector<int> n;
    for (const Measurement& one : positions) {
      if (one.velocity) continue;
      const double own = std::pow(one.noise_factor * model.noise_stddev, 2) + std::pow(model.time_stddev * one.rate, 2);
      if (time.empty() || one.time > time.back()) {
        time.push_back(one.time), value.push_back(0), variance.push_back(0), n.push_back(0);
      }
      value.back() += one.value, variance.back() += own, ++n.back();
    }
    for (std::size_t i = 0; i < time.size(); ++i) value[i] /= n[i], variance[i] /= n[i] * n[i];
  }
  [[nodiscard]] Index size() const { return std::ssize(time); }
};

// What one window makes of samples first, first + 1, …: weights b(t_i) of those inside it.
struct Window {
  Index first = 0;
  VectorXd b;
};

Window make_window(const Samples& samples, const WindowGrid& grid, int window) {
  const auto after = [&](double time) {
    return std::upper_bound(samples.time.begin(), samples.time.end(), time) - samples.time.begin();
  };
  Window out;
  out.first = std::max<Index>(1, after(grid.begin(window)));
  const Index last = std::min(samples.size() - 2, after(grid.end(window)) - 1);
  out.b.resize(std::max<Index>(0, last - out.first + 1));
  for (Index i = 0; i < out.b.size(); ++i) out.b[i] = grid.weight(window, samples.time[static_cast<std::size_t>(out.first + i)]);
  return out;
}

// Whether samples tell what happens in the window, half of it or more, without a pause among those that its sum is of.
bool is_covered(const Samples& samples, const WindowGrid& grid, const Window& window) {
  if (window.b.size() == 0) return false;
  const auto first = static_cast<std::size_t>(window.first - 1), last = first + static_cast<std::size_t>(window.b.size()) + 1;
  for (std::size_t i = first; i < last; ++i) {
    if (samples.time[i + 1] - samples.time[i] > grid.spacing) return false;
  }
  return samples.time[last] - samples.time[first] > 2 * grid.spacing;
}

// Whether states do, of which rows may have been left out: cubics do not reach across more than what the window resolves.
bool has_states(const Samples& samples, const WindowGrid& grid, const Window& window, const VectorXd& times) {
  const double begin = samples.time[static_cast<std::size_t>(window.first - 1)];
  const double end = samples.time[static_cast<std::size_t>(window.first + window.b.size())];
  // from the one before the window to the one after it, where these are near; else it may reach beyond them by a step
  Index first = std::upper_bound(times.begin(), times.end(), begin) - times.begin() - 1;
  Index last = std::lower_bound(times.begin(), times.end(), end) - times.begin();
  const auto is_far = [&](Index i) { return i < 0 || i + 1 >= times.size() || times[i + 1] - times[i] > grid.spacing; };
  if (is_far(first)) ++first;
  if (is_far(last - 1)) --last;
  if (last <= first) return false;
  for (Index i = first; i < last; ++i) {
    if (times[i + 1] - times[i] > grid.spacing) return false;
  }
  return times[first] - begin <= times[first + 1] - times[first] && end - times[last] <= times[last] - times[last - 1];
}

// Σ_i b_i ((q_{i+1} − q_i)/h_i − (q_i − q_{i−1})/h_{i−1}) as weights of the q, from q_{first−1} on
VectorXd weights_of_positions(const Samples& samples, const Window& window) {
  VectorXd c = VectorXd::Zero(window.b.size() + 2);
  for (Index i = 0; i < window.b.size(); ++i) {
    const auto at = static_cast<std::size_t>(window.first + i);
    const double before = 1 / (samples.time[at] - samples.time[at - 1]), after = 1 / (samples.time[at + 1] - samples.time[at]);
    c[i] += window.b[i] * before;
    c[i + 1] -= window.b[i] * (before + after);
    c[i + 2] += window.b[i] * after;
  }
  return c;
}

// Adds weight × the cubic through the values at the four states nearest to a time.
void add_interpolation(const VectorXd& times, double time, double weight, VectorXd& weights) {
  const Index above = std::upper_bound(times.begin(), times.end(), time) - times.begin();
  const Index first = std::clamp<Index>(above - 2, 0, times.size() - 4);
  for (Index a = first; a < first + 4; ++a) {
    double cardinal = weight;
    for (Index b = first; b < first + 4; ++b) {
      if (b != a) cardinal *= (time - times[b]) / (times[a] - times[b]);
    }
    weights[a] += cardinal;
  }
}

// ∫ Λ(t) ℓ(t) dt for the cubics ℓ of the states: by three points of Gauss between samples and states, where it is a polynomial of
// degree 4
VectorXd weights_of_states(const Samples& samples, const Window& window, const VectorXd& times) {
  VectorXd weights = VectorXd::Zero(times.size());
  const std::array<double, 3> place{0.5 - std::sqrt(0.15), 0.5, 0.5 + std::sqrt(0.15)}, share{5.0 / 18, 8.0 / 18, 5.0 / 18};
  for (Index i = -1; i < window.b.size(); ++i) {
    const auto at = static_cast<std::size_t>(window.first + i);
    const double left = samples.time[at], right = samples.time[at + 1];
    const double b_left = i < 0 ? 0 : window.b[i], b_right = i + 1 < window.b.size() ? window.b[i + 1] : 0;
    double from = left;
    auto state = std::upper_bound(times.begin(), times.end(), left);
    while (from < right) {
      const double to = state != times.end() && *state < right ? *state++ : right;
      for (std::size_t g = 0; g < place.size(); ++g) {
        const double time = from + (to - from) * place[g], x = (time - left) / (right - left);
        add_interpolation(times, time, share[g] * (to - from) * ((1 - x) * b_left + x * b_right), weights);
      }
      from = to;
    }
  }
  return weights;
}

// What a sum is off by, as weights of the noise of positions first, first + 1, …: of its own coordinate, and of each other one.
struct NoiseWeights {
  Index first = 0;
  MatrixXd weights;  // (positions × measured)
};

// Σ_i w_i (∂ddq/∂q φ(t_i − t_k) + ∂ddq/∂dq φ'(t_i − t_k)) h_k, what the errors of the states make of a sum: a smoother passes what is
// below its bandwidth, as the spline φ does, whose knots are half a spacing apart.
NoiseWeights weights_of_errors(const Samples& samples, const WindowGrid& grid, const VectorXd& times, const VectorXd& weights) {
  const double knots = grid.spacing / 2;
  const auto range_of = [&](double from, double to) {
    const auto first = std::upper_bound(samples.time.begin(), samples.time.end(), from);
    return std::pair(first - samples.time.begin(), std::lower_bound(first, samples.time.end(), to) - samples.time.begin());
  };
  const auto [begin, end] = range_of(times[0] - 2 * knots, times[times.size() - 1] + 2 * knots);
  NoiseWeights out{begin, MatrixXd::Zero(end - begin, grid.sensitivity.by_position.cols())};
  const StateSensitivity& sensitivity = grid.sensitivity;
  for (Index i = 0; i < times.size(); ++i) {
    const Index row = std::lower_bound(sensitivity.times.begin(), sensitivity.times.end(), times[i]) - sensitivity.times.begin();
    const auto [from, to] = range_of(times[i] - 2 * knots, times[i] + 2 * knots);
    for (Index k = from; k < to; ++k) {
      const auto at = static_cast<std::size_t>(k);
      const double before = samples.time[k > 0 ? at - 1 : at], after = samples.time[k + 1 < samples.size() ? at + 1 : at];
      const double share = weights[i] * std::min((after - before) / 2, knots) / knots, x = (times[i] - samples.time[at]) / knots;
      out.weights.row(k - begin) +=
          share * (spline(x) * sensitivity.by_position.row(row) + spline_slope(x) / knots * sensitivity.by_velocity.row(row));
    }
  }
  return out;
}

// c less what the errors of the states make of the other side
NoiseWeights noise_weights(const Samples& samples, const WindowGrid& grid, const Window& window, const VectorXd& c,
                           const VectorXd& times, const VectorXd& weights) {
  if (grid.sensitivity.by_position.size() == 0) return {window.first - 1, c};
  const NoiseWeights errors = weights_of_errors(samples, grid, times, weights);
  const Index first = std::min(errors.first, window.first - 1);
  const Index end = std::max(errors.first + errors.weights.rows(), window.first - 1 + c.size());
  NoiseWeights out{first, MatrixXd::Zero(end - first, errors.weights.cols())};
  out.weights.middleRows(errors.first - first, errors.weights.rows()) = -errors.weights;
  out.weights.col(0).segment(window.first - 1 - first, c.size()) += c;
  return out;
}

// of sums with such weights  (sums × sums), its lower triangle
MatrixXd covariance_of(const Samples& samples, const std::vector<NoiseWeights>& sums) {
  const Index n = std::ssize(sums);
  const Eigen::Map<const VectorXd> variance(samples.variance.data(), samples.size());
  MatrixXd covariance = MatrixXd::Zero(n, n);
  for (Index r = 0; r < n; ++r) {
    const NoiseWeights& one = sums[static_cast<std::size_t>(r)];
    for (Index s = r; s >= 0; --s) {
      const NoiseWeights& other = sums[static_cast<std::size_t>(s)];
      const Index first = std::max(one.first, other.first);
      const Index common = std::min(one.first + one.weights.rows(), other.first + other.weights.rows()) - first;
      if (common <= 0) break;
      const auto here = one.weights.middleRows(first - one.first, common);
      covariance(r, s) = here.cwiseProduct(other.weights.middleRows(first - other.first, common))
                             .rowwise()
                             .sum()
                             .dot(variance.segment(first, common));
    }
  }
  return covariance;
}

}  // namespace

std::vector<WeightedSum> windowed_accelerations(const std::vector<Measurement>& positions, const SmootherModel& model,
                                                const WindowGrid& grid, const std::vector<int>& windows, const VectorXd& times,
                                                int row, int first_state) {
  const Samples samples(positions, model);
  std::vector<NoiseWeights> noise;
  std::vector<WeightedSum> sums;
  for (const int number : windows) {
    const Window window = make_window(samples, grid, number);
    if (!is_covered(samples, grid, window) || !has_states(samples, grid, window, times)) continue;
    const VectorXd c = weights_of_positions(samples, window) / grid.spacing;
    const VectorXd weights = weights_of_states(samples, window, times) / grid.spacing;
    Index from = 0, to = weights.size();
    while (from < to && weights[from] == 0) ++from;
    while (to > from && weights[to - 1] == 0) --to;
    WeightedSum& sum = sums.emplace_back();
    sum.row = row;
    sum.first = first_state + static_cast<int>(from);
    sum.weights = weights.segment(from, to - from);
    // differences of positions from one of them lose no digits to where zero is
    const double origin = samples.value[static_cast<std::size_t>(window.first)];
    for (Index i = 0; i < c.size(); ++i)
      sum.value += c[i] * (samples.value[static_cast<std::size_t>(window.first - 1 + i)] - origin);
    noise.push_back(noise_weights(samples, grid, window, c, times.segment(from, to - from), sum.weights));
  }
  const MatrixXd covariance = covariance_of(samples, noise);
  const Eigen::LLT<MatrixXd> factor(covariance);
  if (factor.info() != Eigen::Success) {
    throw NumericalError(fmt::format("windows of {:.3g} s have sums that follow from each other: leave them out (`windows=none`)",
                                     4 * grid.spacing));
  }
  const MatrixXd L = factor.matrixL();
  for (Index r = 0; r < std::ssize(sums); ++r) {
    Index from = 0;
    while (from < r && covariance(r, from) == 0) ++from;
    sums[static_cast<std::size_t>(r)].noise = L.row(r).segment(from, r - from + 1).transpose();
  }
  return sums;
}

}  // namespace gp2
