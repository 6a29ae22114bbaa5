#include "gp2/inference/inverse_dynamics.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include <Eigen/Cholesky>
#include <Eigen/QR>

#include "gp2/error.hpp"
#include "gp2/predictor.hpp"
#include "inference/requirements.hpp"
#include "mechanics/describe_fault.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

constexpr double rank_tolerance = 1e-10;  // as that of constraints
constexpr double rounding = 1e-13;        // of accelerations, beside their size
constexpr double close_enough = 1e-8;     // where rounding lets no step help any more

// The pseudo-inverse of J whose columns are scaled first, so that units of inputs do not decide the rank.
MatrixXd scaled_pseudo_inverse(const MatrixXd& J) {
  const VectorXd size = J.colwise().norm();
  const VectorXd scale = (size.array() > 0).select(size.cwiseInverse(), 0);
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
  decomposition.setThreshold(rank_tolerance);
  decomposition.compute(J * scale.asDiagonal());
  return scale.asDiagonal() * decomposition.pseudoInverse();
}

/// Finds the inputs at one state after another.
class InputSearch {
 public:
  InputSearch(const Posterior& posterior, const View& view)
      : nu_(posterior.prior().system->layout().nu),
        predictor_(posterior, view, Predictor::Options{.stddev = false, .jacobian = true}),
        workspace_(predictor_.make_workspace()),
        mean_(view.size()),
        jacobian_(view.size(), posterior.prior().system->layout().size()) {}

  /// @param metric  of the rows (d × d)
  /// @param usual   how large accelerations are (d), beside which rounding is judged
  /// @param state   its inputs are where the search begins, and become those found
  /// @returns whether they were found
  [[nodiscard]] bool run(const VectorXd& wanted, const MatrixXd& metric, const VectorXd& usual, VectorXd& state) {
    constexpr int most_steps = 100;
    wanted_ = wanted;
    root_ = metric.llt().matrixU();
    if (!evaluate(state)) return false;
    double size = (root_ * usual).norm() + (root_ * wanted_).norm();
    for (int step = 0; step < most_steps; ++step) {
      const VectorXd rest = root_ * missed();
      const MatrixXd J = root_ * jacobian_.rightCols(nu_);
      pseudo_inverse_ = scaled_pseudo_inverse(J);
      const VectorXd change = pseudo_inverse_ * rest;
      const double gain = (J * change).norm();
      size = std::max(size, (root_ * mean_).norm());
      if (gain <= rounding * size) return true;
      if (!improve(change, rest.norm(), state)) return gain <= close_enough * size;
    }
    return false;
  }

  // of the state that was found
  [[nodiscard]] VectorXd missed() const { return wanted_ - mean_; }
  [[nodiscard]] MatrixXd pseudo_inverse() const { return pseudo_inverse_ * root_; }  // J⁺ (nu × d)

 private:
  [[nodiscard]] bool evaluate(const VectorXd& state) {
    return predictor_.mean_and_jacobian(state, mean_, jacobian_, workspace_) == Predictor::Status::ok;
  }

  // The first of the steps change, change/2, change/4, … that misses less than before. False where none does: the state stays.
  [[nodiscard]] bool improve(const VectorXd& change, double before, VectorXd& state) {
    constexpr int most_halvings = 30;
    const VectorXd inputs = state.tail(nu_);
    for (int k = 0; k < most_halvings; ++k) {
      state.tail(nu_) = inputs + std::ldexp(1.0, -k) * change;
      if (evaluate(state) && (root_ * missed()).norm() < before) return true;
    }
    state.tail(nu_) = inputs;
    static_cast<void>(evaluate(state));
    return false;
  }

  int nu_;
  Predictor predictor_;
  Predictor::Workspace workspace_;
  VectorXd wanted_, mean_;
  MatrixXd jacobian_, root_, pseudo_inverse_;
};

}  // namespace

MatrixXd InverseDynamics::stddev() const {
  MatrixXd stddev(inputs.rows(), inputs.cols());
  for (Index k = 0; k < inputs.rows(); ++k) stddev.row(k) = covariance.row(k * (inputs.rows() + 1)).cwiseMax(0).cwiseSqrt();
  return stddev;
}

InverseDynamics inverse_dynamics(const Posterior& posterior, const View& view, const Ref<const MatrixXd>& states,
                                 const Ref<const MatrixXd>& accelerations) {
  require_view(posterior.prior(), view);
  require_linear(posterior.prior(), "inverse_dynamics");
  if (!view.is_of_ddq()) throw InputError("inverse_dynamics: the view must be of the constrained acceleration ddq");
  const Prior& prior = prior_of(posterior.prior(), view);
  const System& system = *prior.system;
  const Index nu = system.layout().nu, d = view.size(), n = states.cols();
  if (nu == 0) throw InputError(fmt::format("inverse_dynamics: '{}' has no inputs", system.name()));
  if (accelerations.rows() != d || accelerations.cols() != n) {
    throw InputError(fmt::format("inverse_dynamics: expected accelerations of {} rows at {} states, got {} × {}", d, n,
                                 accelerations.rows(), accelerations.cols()));
  }
  system.require_states(states);
  MatrixXd found = states;
  found.bottomRows(nu) = states.bottomRows(nu).array().isNaN().select(0, states.bottomRows(nu));
  static_cast<void>(posterior.mean(view, found));  // names a state without a prediction
  const MechanicsBatch mechanics = require_mechanics(prior, view, found, parameters_of(view, posterior.values().parameters));
  const auto fail = [&](Index i, const char* text) {
    return internal::describe_fault(system, found, {static_cast<int>(i), text});
  };

  InverseDynamics out{MatrixXd(nu, n), MatrixXd(nu * nu, n), MatrixXd(d, n)};
  const MatrixXd usual = posterior.without_data().marginal(view, found).stddev();
  std::vector<MatrixXd> pseudo_inverses;
  InputSearch search(posterior, view);
  for (Index i = 0; i < n; ++i) {
    if (!accelerations.col(i).allFinite()) {
      throw InputError(fail(i, "inverse_dynamics: an acceleration that is wanted is not a finite number"));
    }
    const MatrixXd& mass = mechanics.projections[static_cast<std::size_t>(i)].mass();
    VectorXd state = found.col(i);
    if (!search.run(accelerations.col(i), mass(view.rows, view.rows), usual.col(i), state)) {
      throw NumericalError(
          fail(i, "inverse_dynamics: no inputs are found that produce the accelerations, or come nearest to them"));
    }
    found.col(i) = state;
    out.missed.col(i) = search.missed();
    pseudo_inverses.push_back(search.pseudo_inverse());
  }
  out.inputs = found.bottomRows(nu);
  const Posterior::Marginal marginal = posterior.marginal(view, found);
  for (Index i = 0; i < n; ++i) {
    const MatrixXd& J = pseudo_inverses[static_cast<std::size_t>(i)];
    out.covariance.col(i) = (J * marginal.covariance.col(i).reshaped(d, d) * J.transpose()).reshaped();
  }
  return out;
}

}  // namespace gp2
