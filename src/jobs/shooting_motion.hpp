#pragma once

#include <atomic>
#include <functional>
#include <vector>

#include <Eigen/Core>

#include "gp2/simulate.hpp"
#include "jobs/shooting_log.hpp"

namespace gp2 {

/// What a view is at states: Posterior::mean, or PathwiseSamples::evaluate of one sample.
using ViewFunction = std::function<Eigen::MatrixXd(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states)>;

/// The motion over a stretch beside the log, and how both change.
struct LinearisedMotion {
  Eigen::VectorXd residual;  // measured − predicted, row after row (compared · rows)
  Eigen::MatrixXd by_theta;  // ∂ predicted / ∂x, x the coordinates of parameters
  Eigen::MatrixXd by_start;  // along `basis`
  Eigen::MatrixXd basis;     // of changes of the start that keep to the constraints (2 nq × r)
};

/// Motions of a fit over stretches of a log. Everything throws NumericalError where a stop was requested.
class ShootingMotion {
 public:
  /// @param n_threads  at least 1
  ShootingMotion(const FitFile& fit, const ShootingLog& log, int n_threads, const std::atomic<bool>* stop);

  /// Of latents conditioned anew, on the data of the fit.
  [[nodiscard]] Posterior posterior_at(const std::vector<Hyperparameter>& hyperparameters) const;

  /// Measured less predicted positions, row after row (compared · rows); empty where the motion does not reach the end.
  [[nodiscard]] Eigen::VectorXd residual(const ViewFunction& function, const Eigen::VectorXd& parameters,
                                         const Stretch& stretch) const;
  /// Of the mean motion over each stretch.
  [[nodiscard]] std::vector<Eigen::VectorXd> residuals(const Posterior& posterior, const std::vector<Stretch>& stretches) const;

  /// By central differences.
  /// @param estimated  the parameters θ among the hyperparameters
  /// @param residuals  of the stretches, all of which reach their ends
  [[nodiscard]] std::vector<LinearisedMotion> linearise(const std::vector<Hyperparameter>& hyperparameters,
                                                        const std::vector<std::size_t>& estimated,
                                                        const std::vector<Stretch>& stretches,
                                                        const std::vector<Eigen::VectorXd>& residuals) const;

 private:
  [[nodiscard]] Eigen::VectorXd residual(const Posterior& posterior, const Stretch& stretch) const;
  [[nodiscard]] Eigen::MatrixXd tangents(const Eigen::VectorXd& parameters, const Eigen::VectorXd& start) const;

  const FitFile& fit_;
  const ShootingLog& log_;
  Prior prior_;
  const System& system_;
  View view_;
  SwitchingFunctions switching_;
  int n_threads_;
  const std::atomic<bool>* stop_;
};

}  // namespace gp2
