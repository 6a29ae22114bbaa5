#include "gp2/laplace.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <Eigen/Eigenvalues>

#include "gp2/error.hpp"
#include "inference/lapack.hpp"
#include "inference/parallel.hpp"
#include "training/objective.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

namespace {

// of a difference, as the optimiser sees a hyperparameter: at most
double step_of(const Hyperparameter& h) { return h.kind == Kind::parameter ? 1e-3 : 1e-2; }

// the unit of x in LaplaceUncertainty, as the optimiser sees it
double unit_of(const Hyperparameter& h) {
  if (h.kind == Kind::mixing) return h.scale[0];
  return h.kind == Kind::parameter ? h.upper - h.lower : 1;
}

// hyperparameters that are not at a bound, nor nearer to it than a difference needs
std::vector<int> free_ones(const std::vector<Hyperparameter>& hyperparameters) {
  std::vector<int> free;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    const Hyperparameter& h = hyperparameters[k];
    const double x = to_internal(h, h.value), step = step_of(h);
    if (x - to_internal(h, h.lower) > step && to_internal(h, h.upper) - x > step) free.push_back(static_cast<int>(k));
  }
  return free;
}

class Differences {
 public:
  Differences(const Objective& objective, const VectorXd& x, const std::vector<Hyperparameter>& hyperparameters,
              const std::vector<int>& free)
      : objective_(objective), x_(x), hyperparameters_(hyperparameters), free_(free) {}

  // H of the free ones. Data may know a parameter a thousand times better where the others are known than where they are not:
  // then H is nearly singular, and the steps are short, three such deviations, so that what differences neglect does not matter.
  [[nodiscard]] MatrixXd hessian(int n_threads) const {
    const auto n = static_cast<Index>(free_.size());
    MatrixXd H(n, n);
    parallel_for(static_cast<int>(n), n_threads, [&](int k, int) {
      Likelihood::Workspace workspace;
      const Hyperparameter& h = hyperparameters_[static_cast<std::size_t>(free_[static_cast<std::size_t>(k)])];
      const double step = step_of(h);
      H.col(k) = column(k, step, workspace);
      constexpr double shortest = 1e-8, deviations = 3;
      const double short_step = std::max(deviations / std::sqrt(std::abs(H(k, k))), shortest);
      if (h.kind == Kind::parameter && short_step < step) H.col(k) = column(k, short_step, workspace);
    });
    return (H + H.transpose()) / 2;
  }

 private:
  [[nodiscard]] VectorXd column(int k, double step, Likelihood::Workspace& workspace) const {
    return (gradient_at(k, step, workspace) - gradient_at(k, -step, workspace)) / (2 * step);
  }

  [[nodiscard]] VectorXd gradient_at(int k, double distance, Likelihood::Workspace& workspace) const {
    const int moved = free_[static_cast<std::size_t>(k)];
    VectorXd there = x_, gradient(x_.size());
    there[moved] += distance;
    if (!std::isfinite(objective_(there, &gradient, workspace))) {
      throw NumericalError(fmt::format("the likelihood is not finite near the fitted value of '{}': no standard errors",
                                       hyperparameters_[static_cast<std::size_t>(moved)].name));
    }
    return gradient(free_);
  }

  const Objective& objective_;
  const VectorXd& x_;
  const std::vector<Hyperparameter>& hyperparameters_;
  const std::vector<int>& free_;
};

}  // namespace

LaplaceUncertainty laplace_uncertainty(const Prior& prior, const std::vector<Observations>& observations,
                                       const std::vector<Hyperparameter>& hyperparameters, int n_threads) {
  constexpr double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  const lapack::SingleThread single_thread;
  const Objective objective(prior, observations, hyperparameters);
  const VectorXd x = internal_values(hyperparameters);
  const std::vector<int> free = free_ones(hyperparameters);
  const auto n = static_cast<Index>(hyperparameters.size()), n_free = static_cast<Index>(free.size());
  const MatrixXd H = Differences(objective, x, hyperparameters, free).hessian(thread_count(n_threads));

  // in units of what each would be uncertain by, were the others known: 1 on the diagonal
  VectorXd unit = H.diagonal().array().abs().max(1e-10).rsqrt();
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(unit.asDiagonal() * H * unit.asDiagonal());
  constexpr double smallest = 1e-8;  // what differences of gradients leave of a zero
  const Index n_flat = (eigen.eigenvalues().array() < smallest).count();
  const MatrixXd flat = eigen.eigenvectors().leftCols(n_flat), steep = eigen.eigenvectors().rightCols(n_free - n_flat);
  const VectorXd variance = eigen.eigenvalues().tail(n_free - n_flat).cwiseInverse();
  const MatrixXd covariance = steep * variance.asDiagonal() * steep.transpose();

  LaplaceUncertainty out;
  out.stddev = VectorXd::Zero(n);
  out.correlation = MatrixXd::Identity(n, n);
  out.undetermined = MatrixXd::Zero(n, n_flat);
  for (Index k = 0; k < n; ++k) {
    if (std::find(free.begin(), free.end(), k) == free.end()) out.held.push_back(static_cast<int>(k));
  }
  const auto is_flat = [&](Index k) { return flat.row(k).squaredNorm() > 1e-4; };
  for (Index k = 0; k < n_free; ++k) {
    const double to_unit = unit[k] * unit_of(hyperparameters[static_cast<std::size_t>(free[static_cast<std::size_t>(k)])]);
    const Index at = free[static_cast<std::size_t>(k)];
    out.stddev[at] = is_flat(k) ? infinity : to_unit * std::sqrt(covariance(k, k));
    out.undetermined.row(at) = to_unit * flat.row(k);
    for (Index l = 0; l < k; ++l) {
      const Index other = free[static_cast<std::size_t>(l)];
      const double both = std::sqrt(covariance(k, k) * covariance(l, l));
      out.correlation(at, other) = out.correlation(other, at) = is_flat(k) || is_flat(l) ? nan : covariance(k, l) / both;
    }
  }
  out.undetermined.colwise().normalize();

  Likelihood::Workspace workspace;
  VectorXd gradient = VectorXd::Zero(n);
  objective(x, &gradient, workspace);
  const VectorXd scaled = steep.transpose() * unit.cwiseProduct(gradient(free));
  out.distance_from_optimum = std::sqrt((scaled.array().square() * variance.array()).sum());
  return out;
}

}  // namespace gp2
