#include "gp2/inference/evaluation.hpp"

#include <cmath>
#include <numbers>

#include "base/not_a_number.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// mean negative log density and share inside ±1.96 σ of Gaussian marginals
struct Calibration {
  double sum = 0;
  int inside = 0, n = 0;

  void add(double error, double stddev) {
    const double z = error / stddev;
    sum += 0.5 * z * z + std::log(stddev) + 0.5 * std::log(2 * std::numbers::pi);
    constexpr double z95 = 1.959963984540054;
    if (std::abs(z) <= z95) ++inside;
    ++n;
  }
  [[nodiscard]] double nlpd() const { return n == 0 ? not_a_number : sum / n; }
  [[nodiscard]] double coverage() const { return n == 0 ? not_a_number : static_cast<double>(inside) / n; }
};

// where training observed row `row` of ddq: its spread over all such observations and the usual noise of the first, NaN when it
// did not
struct Trained {
  double spread = not_a_number, noise = not_a_number;
};

Trained trained(const Posterior& posterior, int row) {
  Trained trained;
  std::vector<double> values;
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    const Observations& group = posterior.observations()[g];
    if (!group.view().is_of_ddq()) continue;
    for (int k = 0; k < group.view().size(); ++k) {
      if (group.view().rows[static_cast<std::size_t>(k)] != row) continue;
      if (values.empty()) trained.noise = group.usual_noise(posterior.values().noise_stddev[g])[k];
      values.insert(values.end(), group.values().row(k).begin(), group.values().row(k).end());
    }
  }
  if (!values.empty()) trained.spread = row_stddev(Eigen::Map<Eigen::RowVectorXd>(values.data(), std::ssize(values)))[0];
  return trained;
}

}  // namespace

double max_constraint_error(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                            const Ref<const MatrixXd>& accelerations) {
  const SystemValues values = system.evaluate(states, parameters);
  double worst = 0;
  for (int i = 0; i < values.n_states() && system.nc() > 0; ++i) {
    const VectorXd error = values.A(i) * accelerations.col(i) - values.b(i);
    if (error.hasNaN()) return not_a_number;  // a baseline needs no measurement of what only the constraint reads
    worst = std::max(worst, error.cwiseAbs().maxCoeff());
  }
  return worst;
}

Evaluation evaluate_predictions(const Posterior& posterior, const Ref<const MatrixXd>& states, const std::vector<int>& rows,
                                const Ref<const MatrixXd>& targets, const std::shared_ptr<const OtherSystem>& other_system,
                                int n_threads) {
  View all = View::constrained_acceleration(*posterior.prior().system);
  all.other_system = other_system;
  const System& system = prior_of(posterior.prior(), all).reference_system();
  const Posterior::Marginal prediction = posterior.marginal(all, states, n_threads);
  const MatrixXd stddev = prediction.stddev();

  Evaluation e;
  e.n = static_cast<int>(states.cols());
  e.outputs = View{View::Quantity::constrained_acceleration, rows}.names(system);
  e.rmse.resize(static_cast<Index>(rows.size()));
  const VectorXd test_spread = row_stddev(targets);
  Calibration measured, latent;
  double normalised = 0;
  for (std::size_t k = 0; k < rows.size(); ++k) {
    const Index row = rows[k];
    const VectorXd error = (targets.row(static_cast<Index>(k)) - prediction.mean.row(row)).transpose();
    const Eigen::Array<bool, Eigen::Dynamic, 1> is_measured = !targets.row(static_cast<Index>(k)).transpose().array().isNaN();
    const Index n_measured = is_measured.count();
    e.n_missing += e.n - static_cast<int>(n_measured);
    e.rmse[static_cast<Index>(k)] = std::sqrt(is_measured.select(error, 0).squaredNorm() / static_cast<double>(n_measured));
    const Trained training = trained(posterior, rows[k]);
    normalised += e.rmse[static_cast<Index>(k)] / training.spread;
    // what rounding leaves of a variance that is zero
    const double zero = 1e-10 * test_spread[static_cast<Index>(k)];
    for (int i = 0; i < e.n; ++i) {
      if (!is_measured[i]) continue;
      if (std::isfinite(training.noise)) measured.add(error[i], std::hypot(stddev(row, i), training.noise));
      if (stddev(row, i) > zero) {
        latent.add(error[i], stddev(row, i));
      } else {
        ++e.n_zero_variance;
      }
    }
  }
  e.rmse_normalised = normalised / static_cast<double>(rows.size());
  e.nrmse = e.rmse.norm() / test_spread.norm();
  e.max_constraint_error = max_constraint_error(system, states, system.parameter_values(), prediction.mean);
  e.max_constraint_error_fitted =
      max_constraint_error(system, states, parameters_of(all, posterior.values().parameters), prediction.mean);
  e.nlpd = measured.nlpd();
  e.coverage95 = measured.coverage();
  e.nlpd_latent = latent.nlpd();
  e.coverage95_latent = latent.coverage();
  return e;
}

}  // namespace gp2
