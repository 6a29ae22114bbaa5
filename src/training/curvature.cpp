#include "training/curvature.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <Eigen/Eigenvalues>

#include "base/decompositions.hpp"
#include "base/parallel.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::vector<int> free_ones(const std::vector<Hyperparameter>& hyperparameters, AtBound at_bound) {
  std::vector<int> free;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const Hyperparameter& h = hyperparameters[k];
    const bool is_held = h.at_bound() && !(at_bound == AtBound::free_if_open && h.is_system_parameter());
    if (!is_held && !h.is_fixed()) free.push_back(static_cast<int>(k));
  }
  return free;
}

class Differences {
 public:
  Differences(const Objective& objective, const VectorXd& x, const std::vector<Hyperparameter>& hyperparameters,
              const std::atomic<bool>* stop, AtBound at_bound)
      : objective_(objective),
        x_(x),
        hyperparameters_(hyperparameters),
        stop_(stop),
        free_(free_ones(hyperparameters, at_bound)) {}

  [[nodiscard]] const std::vector<int>& free() const { return free_; }

  // Of an entry between a parameter and another hyperparameter the parameter's column is the better one.
  [[nodiscard]] MatrixXd hessian(const Evaluators& evaluators) const {
    const auto n = static_cast<Index>(free_.size());
    MatrixXd H(n, n);
    share_out({H.data(), static_cast<std::size_t>(H.size())}, static_cast<int>(n), evaluators.side_by_side,
              [&](int k, std::span<double> column) {
                Likelihood::Workspace workspace(evaluators.within(), stop_);
                Eigen::Map<VectorXd>(column.data(), n) =
                    is_parameter(k) ? parameter_column(k, workspace) : central(k, within_box(k, 3e-3, 1), workspace);
              });
    for (Index k = 0; k < n; ++k) {
      for (Index l = 0; l < k; ++l) {
        const bool known_better = is_parameter(k) != is_parameter(l);
        const double both = known_better ? (is_parameter(k) ? H(l, k) : H(k, l)) : (H(k, l) + H(l, k)) / 2;
        H(k, l) = H(l, k) = both;
      }
    }
    return H;
  }

 private:
  [[nodiscard]] const Hyperparameter& at(Index k) const {
    return hyperparameters_[static_cast<std::size_t>(free_[static_cast<std::size_t>(k)])];
  }
  [[nodiscard]] bool is_parameter(Index k) const { return at(k).is_system_parameter(); }

  // at most so long that `times` steps stay in the box, or twice as many away from a bound
  [[nodiscard]] double within_box(Index k, double step, double times) const {
    const Hyperparameter& h = at(k);
    const double x = h.coordinate();
    if (h.at_bound()) return std::min(step, (h.upper_coordinate() - h.lower_coordinate()) / (3 * times));
    return std::min({step, (x - h.lower_coordinate()) / times, (h.upper_coordinate() - x) / times});
  }

  // θ enters M, A and b in any way, within a box that may be much wider than what is known of it: the step is a thousandth of its
  // value or three of the deviations that it would have were all else known, whichever is longer. Where two parameters are
  // known a thousand times better together than each by itself, H is nearly singular: hence four points.
  [[nodiscard]] VectorXd parameter_column(Index k, Likelihood::Workspace& workspace) const {
    constexpr double relative = 1e-3, first = 1e-5, deviations = 3;
    const Hyperparameter& h = at(k);
    const double curvature = central(k, within_box(k, first, 1), workspace)[k];
    const double deviation = deviations / std::sqrt(std::max(std::abs(curvature), 1e-300));
    const double step = within_box(k, std::min(relative, std::max(relative * std::abs(h.value) / h.map().unit, deviation)), 2);
    return (4 * central(k, step, workspace) - central(k, 2 * step, workspace)) / 3;
  }

  [[nodiscard]] VectorXd central(Index k, double step, Likelihood::Workspace& workspace) const {
    if (at(k).at_bound()) {
      // to one side, and of second order too
      const Hyperparameter& h = at(k);
      const bool is_lower = h.coordinate() - h.lower_coordinate() < h.upper_coordinate() - h.coordinate();
      const double inwards = is_lower ? step : -step;
      const VectorXd here = gradient_at(k, 0, workspace), one = gradient_at(k, inwards, workspace);
      return (4 * one - gradient_at(k, 2 * inwards, workspace) - 3 * here) / (2 * inwards);
    }
    return (gradient_at(k, step, workspace) - gradient_at(k, -step, workspace)) / (2 * step);
  }

  [[nodiscard]] VectorXd gradient_at(Index k, double distance, Likelihood::Workspace& workspace) const {
    if (is_set(stop_)) throw NumericalError("stopped on request: no standard errors");
    VectorXd there = x_, gradient(x_.size());
    there[free_[static_cast<std::size_t>(k)]] += distance;
    if (!std::isfinite(objective_(there, &gradient, workspace))) {
      throw NumericalError(
          fmt::format("the likelihood is not finite near the fitted value of '{}': no standard errors", at(k).name));
    }
    return gradient(free_);
  }

  const Objective& objective_;
  const VectorXd& x_;
  const std::vector<Hyperparameter>& hyperparameters_;
  const std::atomic<bool>* stop_;
  std::vector<int> free_;
};

}  // namespace

double Curvature::distance_from_optimum() const {
  if (free.empty()) return 0;
  if (eigenvalues[0] < -zero) return std::numeric_limits<double>::infinity();
  const VectorXd slopes = eigenvectors.transpose() * unit.cwiseProduct(gradient);
  return std::sqrt((eigenvalues.array() > zero).select(slopes.array().square() / eigenvalues.array().max(zero), 0).sum());
}

MatrixXd Curvature::information() const {
  const VectorXd steep = (eigenvalues.array() > zero).select(eigenvalues, 0);
  const MatrixXd axes = unit.cwiseInverse().asDiagonal() * eigenvectors;
  return axes * steep.asDiagonal() * axes.transpose();
}

namespace {

Curvature curvature_of(std::vector<int> free, VectorXd gradient, const MatrixXd& H) {
  Curvature out;
  out.free = std::move(free);
  out.gradient = std::move(gradient);
  if (out.free.empty()) return out;
  // deviations of ten boxes and of twenty thousand are alike unknown: what rounding makes of nothing is not to be taken for a curvature
  out.unit = H.diagonal().array().abs().max(1e-2).rsqrt();
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(MatrixXd(out.unit.asDiagonal() * H * out.unit.asDiagonal()));
  out.eigenvalues = eigen.eigenvalues();
  out.eigenvectors = eigen.eigenvectors();
  constexpr double of_differences = 1e-7;
  constexpr double bend = 1e-2;  // of a valley over one deviation, for data that know a parameter to a hundredth
  out.zero = std::max(of_differences, bend * out.unit.cwiseProduct(out.gradient).norm());
  return out;
}

}  // namespace

Curvature curvature_at(const Objective& objective, const VectorXd& x, const std::vector<Hyperparameter>& hyperparameters,
                       const Evaluators& evaluators, const std::atomic<bool>* stop, AtBound at_bound) {
  const Differences differences(objective, x, hyperparameters, stop, at_bound);
  Likelihood::Workspace workspace(evaluators.alone, stop);
  VectorXd gradient = VectorXd::Zero(x.size());
  objective(x, &gradient, workspace);
  const std::vector<int>& all = differences.free();
  const MatrixXd H = all.empty() ? MatrixXd() : differences.hessian(evaluators);
  // those at a bound are held where the objective falls towards it, and then where no open direction has a part in them
  const auto without = [&](const Curvature& from, const auto& is_held) {
    std::vector<int> in_all, kept;
    for (std::size_t k = 0; k < all.size(); ++k) {
      const auto place = std::ranges::find(from.free, all[k]);
      if (place == from.free.end()) continue;
      if (hyperparameters[static_cast<std::size_t>(all[k])].at_bound() && is_held(place - from.free.begin())) continue;
      in_all.push_back(static_cast<int>(k));
      kept.push_back(all[k]);
    }
    return kept == from.free ? from : curvature_of(kept, gradient(kept), H(in_all, in_all));
  };
  const Curvature with_all = curvature_of(all, gradient(all), H);
  constexpr double pushed = 0.1;  // deviations
  const Curvature resting =
      without(with_all, [&](Index k) { return !(std::abs(with_all.gradient[k]) * with_all.unit[k] < pushed); });
  const Index n_flat = (resting.eigenvalues.array() <= resting.zero).count();
  return without(resting, [&](Index k) { return !(resting.eigenvectors.row(k).head(n_flat).squaredNorm() > 1e-4); });
}

VectorXd scales_of_parameters(const Objective& objective, const VectorXd& x, const std::vector<Hyperparameter>& hyperparameters,
                              const std::atomic<bool>* stop, Likelihood::Workspace& workspace) {
  VectorXd scales = VectorXd::Ones(x.size());
  VectorXd gradient = VectorXd::Zero(x.size()), gradient_there = gradient;
  if (std::none_of(hyperparameters.begin(), hyperparameters.end(), [](const auto& h) { return h.is_system_parameter(); })) {
    return scales;
  }
  if (is_set(stop) || !std::isfinite(objective(x, &gradient, workspace))) return scales;
  for (Index k = 0; k < x.size() && !is_set(stop); ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(k)];
    if (!h.is_system_parameter() || h.is_fixed()) continue;
    constexpr double step = 1e-5;  // of the box, away from the nearer bound
    VectorXd there = x;
    there[k] += x[k] < 0.5 ? step : -step;
    if (!std::isfinite(objective(there, &gradient_there, workspace))) continue;
    const double curvature = std::abs((gradient_there[k] - gradient[k]) / step);
    if (curvature > 1) scales[k] = 1 / std::sqrt(curvature);
  }
  return scales;
}

}  // namespace gp2
