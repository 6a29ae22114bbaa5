#include "training/expected_information.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Cholesky>

#include "base/lapack.hpp"
#include "gp2/inference/evaluation.hpp"
#include "training/curvature.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::LLT;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

MatrixXd inverse(const MatrixXd& A) { return LLT<MatrixXd>(A).solve(MatrixXd::Identity(A.rows(), A.cols())); }

std::vector<int> estimated_parameters(const std::vector<Hyperparameter>& hyperparameters) {
  std::vector<int> which;
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    if (hyperparameters[k].is_system_parameter() && !hyperparameters[k].is_fixed()) which.push_back(static_cast<int>(k));
  }
  return which;
}

// Γ⁻¹ of θ, the other hyperparameters marginalised: H, and 12/width² for "anywhere in its bounds", which has that variance.
MatrixXd information_of_fit(const Prior& prior, const std::vector<Observations>& observations,
                            const std::vector<Hyperparameter>& hyperparameters, const std::vector<int>& theta, int n_threads,
                            const std::atomic<bool>* stop) {
  if (theta.empty()) return MatrixXd(0, 0);
  const Objective objective(prior, observations, hyperparameters, about_posterior_mean(prior, observations, hyperparameters));
  const Curvature curvature = curvature_at(objective, coordinates(hyperparameters), hyperparameters, n_threads, stop);
  // parameters at a bound are not free, and known by nothing else than their bounds
  std::vector<int> all = curvature.free;
  for (const int k : theta) {
    if (std::find(all.begin(), all.end(), k) == all.end()) all.push_back(k);
  }
  const auto n = static_cast<Index>(all.size()), n_free = std::ssize(curvature.free);
  MatrixXd information = MatrixXd::Zero(n, n);
  if (n_free > 0) information.topLeftCorner(n_free, n_free) = curvature.information();
  for (Index k = 0; k < n; ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(all[static_cast<std::size_t>(k)])];
    information(k, k) += 12 / std::pow(h.upper_coordinate() - h.lower_coordinate(), 2);
  }
  std::vector<Index> places;
  for (const int k : theta) places.push_back(std::find(all.begin(), all.end(), k) - all.begin());
  return inverse(inverse(information)(places, places));
}

}  // namespace

ExpectedInformation::ExpectedInformation(const Prior& prior, const std::vector<Observations>& observations,
                                         const std::vector<Hyperparameter>& hyperparameters,
                                         std::shared_ptr<const OtherSystem> other_system, int n_threads,
                                         const std::atomic<bool>* stop)
    : posterior_(prior, observations, model_values(prior, observations, hyperparameters)),
      view_(View::constrained_acceleration(*prior.system)) {
  const lapack::SingleThread single_thread;
  view_.rows = observed_rows(posterior_);
  view_.other_system = std::move(other_system);
  noise_stddev_ = measurement_noise(posterior_, view_.rows, 1);
  const std::vector<int> theta = estimated_parameters(hyperparameters);
  information_ = information_of_fit(prior, observations, hyperparameters, theta, n_threads, stop);

  // θ̂_k ± a tenth of its deviation, between 1e-6 and 1e-3 of its box and within that
  const VectorXd stddev = inverse(information_).diagonal().cwiseSqrt();
  for (std::size_t k = 0; k < theta.size(); ++k) {
    const Hyperparameter& h = theta_.emplace_back(hyperparameters[static_cast<std::size_t>(theta[k])]);
    const double lower = h.lower_coordinate(), upper = h.upper_coordinate();
    const double step = std::clamp(0.1 * stddev[static_cast<Index>(k)], 1e-6 * (upper - lower), 1e-3 * (upper - lower));
    const double middle = std::clamp(h.coordinate(), lower + step, upper - step);
    const auto posterior_at = [&](double x) {
      ModelValues values = posterior_.values();
      values.parameters[h.index] = h.value_at(x);
      return Posterior(prior, observations, std::move(values));
    };
    neighbours_.push_back({posterior_at(middle - step), posterior_at(middle + step), 2 * step});
  }
}

// J in units of σ, in the coordinates of θ: state after state
MatrixXd ExpectedInformation::slopes(const MatrixXd& states) const {
  MatrixXd J(view_.size() * states.cols(), std::ssize(theta_));
  for (Index k = 0; k < J.cols(); ++k) {
    const Neighbours& at = neighbours_[static_cast<std::size_t>(k)];
    const MatrixXd slope = (at.above.mean(view_, states) - at.below.mean(view_, states)) / at.distance;
    J.col(k) = (noise_stddev_.cwiseInverse().asDiagonal() * slope).reshaped();
  }
  return J;
}

ExpectedInformation::Known ExpectedInformation::after(const MatrixXd& states, const MatrixXd& region) const {
  MatrixXd all(posterior_.prior().system->layout().size(), states.cols() + region.cols());
  all << states, region;
  const Index d = view_.size(), n = d * states.cols(), r = d * region.cols();

  // Σ and J in units of σ; soft constraints slip anew at each measurement
  const MatrixXd J = slopes(all);
  MatrixXd covariance = posterior_.joint(view_, all).covariance;
  const VectorXd scale = noise_stddev_.cwiseInverse().replicate(all.cols(), 1);
  covariance = scale.asDiagonal() * covariance * scale.asDiagonal();
  MatrixXd of_measured = covariance.topLeftCorner(n, n) + MatrixXd::Identity(n, n);
  const Prior& measured = prior_of(posterior_.prior(), view_);
  if (measured.system->has_constraint_noise() && n > 0) {
    const VectorXd parameters = parameters_of(view_, posterior_.values().parameters);
    const ViewValues values = evaluate_view(view_, require_mechanics(measured, view_, states, parameters), states);
    for (Index i = 0; i < states.cols(); ++i) {
      const MatrixXd slip = noise_stddev_.cwiseInverse().asDiagonal() * values.N(static_cast<int>(i));
      of_measured.block(i * d, i * d, d, d) += slip * slip.transpose();
    }
  }

  // with Σ' + S' = L Lᵀ: L⁻¹J, and L⁻¹ of the covariance of measurements and region
  MatrixXd explained(n, J.cols() + r);
  explained << J.topRows(n), covariance.topRightCorner(n, r);
  LLT<MatrixXd>(of_measured).matrixL().solveInPlace(explained);
  const auto of_theta = explained.leftCols(J.cols()), of_region = explained.rightCols(r);

  Known known;
  const LLT<MatrixXd> information(information_ + of_theta.transpose() * of_theta);
  const MatrixXd gamma = information.solve(MatrixXd::Identity(J.cols(), J.cols()));
  known.log_volume = -information.matrixLLT().diagonal().array().log().sum();
  known.stddev = gamma.diagonal().cwiseSqrt();
  for (Index k = 0; k < J.cols(); ++k) known.stddev[k] *= theta_[static_cast<std::size_t>(k)].map().unit;
  const MatrixXd D = J.bottomRows(r) - of_region.transpose() * of_theta;
  known.region = (covariance.diagonal().tail(r) - of_region.colwise().squaredNorm().transpose() +
                  (D * gamma).cwiseProduct(D).rowwise().sum())
                     .reshaped(d, region.cols());
  return known;
}

}  // namespace gp2
