#pragma once

#include <atomic>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

/// Share of the standardised errors z (N) within the central interval of each probability p (K): erf(|z|/√2) ≤ p. NaN entries of
/// z are left out; NaN where none is left.
Eigen::VectorXd central_coverage(const Eigen::Ref<const Eigen::VectorXd>& z, const Eigen::Ref<const Eigen::VectorXd>& levels);

/// Histogram of the probability integral transform Φ(z), flat for errors as large as predicted: the share of it in each of `n_bins`
/// equal parts of [0, 1]. NaN as central_coverage. @throws InputError when there are no bins.
Eigen::VectorXd pit_histogram(const Eigen::Ref<const Eigen::VectorXd>& z, int n_bins);

/// How errors lie within their predicted Gaussian marginals; NaN where there is nothing to average.
struct Calibration {
  static constexpr int n_bins = 10;
  double coverage50 = 0, coverage80 = 0, coverage95 = 0;                       // of measurements: noise included
  double coverage50_latent = 0, coverage80_latent = 0, coverage95_latent = 0;  // of noise-free targets
  Eigen::VectorXd pit;                                                         // pit_histogram of measurements (n_bins)
};

/// How well a posterior predicts measured constrained accelerations.
struct Evaluation : Calibration {
  std::vector<std::string> outputs;
  Eigen::VectorXd rmse;                    // per output, physical units
  double rmse_normalised = 0;              // mean over outputs of rmse / training std (Geist & Trimpe 2020, table 1); NaN when an
                                           // output was not observed in training
  double nrmse = 0;                        // rms over outputs and points / rms of the test stds
  double max_constraint_error = 0;         // max |A ddq − b| over points and rows, with the parameters as in the model file
  double max_constraint_error_fitted = 0;  // the same with the fitted parameters
  // per-output Gaussian marginals; NaN when there is nothing to average
  double nlpd = 0, nlpd_latent = 0;
  int n_zero_variance = 0;  // outputs that the constraint decides at their state, left out of the latent figures
  /// The points near the data, and those far from them: beyond Posterior::far_from_data.
  struct Part : Calibration {
    int n = 0;
    double nrmse = 0;  // rms error of the part over the rms of all test stds; NaN without values
  };
  Part near, far;
  int n = 0;          // points
  int n_missing = 0;  // targets that are not measured (NaN), left out of all figures
};

/// Rows of ddq that any observation of a posterior has, in order.
std::vector<int> observed_rows(const Posterior& posterior);

/// Noise of measured accelerations as training knows it (rows × N): the stated deviations, times the factor that training found for
/// those stated there; where none is stated the usual noise of the row, NaN where no observations have it. Of several observations
/// the root mean square over their values.
///
/// @param stated  (rows × N); NaN: not stated; empty: none is
Eigen::MatrixXd measurement_noise(const Posterior& posterior, const std::vector<int>& rows, Eigen::Index n_states,
                                  const Eigen::MatrixXd& stated = {});

/// √(σ² + (N Nᵀ)_kk): how far measured values lie from the motion where constraints are soft too; σ itself where all are exact.
/// @param view          of ddq
/// @param noise_stddev  σ of its rows (rows × N)
Eigen::MatrixXd with_slip(const Posterior& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                          Eigen::MatrixXd noise_stddev);

struct EvaluationOptions {
  std::shared_ptr<const OtherSystem> other_system = nullptr;  // under which the targets were measured; null: the prior's own
  Eigen::MatrixXd noise_stddev = {};        // of the targets (rows × N); NaN: not known; empty: measurement_noise. Without slip
  int n_threads = 1;                        // as in Posterior::marginal
  const std::atomic<bool>* stop = nullptr;  // once set it ends with a NumericalError
};

/// @param states   (layout size × N)
/// @param rows     of ddq that are compared
/// @param targets  (rows × N); NaN: not measured
Evaluation evaluate_predictions(const Posterior& posterior, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                const std::vector<int>& rows, const Eigen::Ref<const Eigen::MatrixXd>& targets,
                                const EvaluationOptions& options = {});

/// How the measured values of a row of a view lie about what all others say of them: z = (y − mean)/√(variance + σ²) of leave_one_out,
/// which in a sound fit is standard normal.
struct TrainingResidual {
  std::size_t group = 0;  // of the observations
  std::string output;
  int n = 0;                      // measured values
  double rms = 0;                 // of z
  double coverage95 = 0;          // share of |z| below 1.96
  double serial_correlation = 0;  // of z of ddq from one state to the next, in the order of the observations
  int n_serial = 0;               // values that it is of: those of all logs together that are too short to tell by themselves
  double rms_in_noise = 0;        // of (y − mean)/σ, of which the noise alone makes 1
  int n_far = 0;                  // values with |z| above six times the larger of 1 and the median |z|/0.6745
  double farthest = 0;            // of |z|
  int farthest_state = -1;        // of the observations; −1 where only some states are kept
  bool is_of_ddq = true;          // else of another view, which may be known and not measured

  /// Whether z is larger than chance and fitted hyperparameters make it.
  [[nodiscard]] bool is_too_large() const;
  /// Whether z goes on from state to state: the states follow each other in time, and something is missing that lasts longer.
  [[nodiscard]] bool is_correlated() const;
  /// Whether the errors of ddq are far smaller than the noise that they have in them is said to be.
  [[nodiscard]] bool is_too_small() const;
};

/// Scores of what is measured of one view, by the spread of each output over all data; no latent figures.
struct LeftOutScores {
  std::string view;                           // multipliers, …, with `@LATENT` where it is of one; empty: ddq
  Evaluation::Part one_by_one;                // each row from all others: between the data
  std::optional<Evaluation::Part> stretches;  // leave_out in CrossValidation::n_stretches: what a motion elsewhere would meet
  Evaluation::Part values;    // each value from all others, those of its row too: by these single values are judged
  double nrmse_of_noise = 0;  // which the noise alone would give all
};

/// How well a fit predicts its own data where it has not seen them, under the hyperparameters that it has from all of them: of ddq,
/// or where none is observed of the first other view.
struct CrossValidation : LeftOutScores {
  static constexpr int n_stretches = LeftOut::n_stretches;
  std::vector<LeftOutScores> other_views = {};
  std::vector<TrainingResidual> residuals = {};  // one for each row of each observation

  [[nodiscard]] std::string text() const;
  /// Whether half of the spread of stretches that were left out, or more, is neither predicted nor noise.
  [[nodiscard]] bool predicts_little() const;
};

/// Costs a factorisation and an inverse, with a tenth of that for the stretches.
/// @param has_time_order  whether the states of observations without t follow each other as they were measured; without time order,
///                        and with less than two states for each stretch, none are left out
CrossValidation cross_validate(const Posterior& posterior, bool has_time_order = true);

/// Measured accelerations against A ddq = b under the fitted parameters.
/// @param rows          of ddq that are measured
/// @param measured      (rows × N); NaN: not measured
/// @param other_system  as EvaluationOptions
/// @param noise_stddev  of what is measured (rows × N); NaN: not known
std::vector<ConstraintResidual> constraint_residuals(const Posterior& posterior,
                                                     const std::shared_ptr<const OtherSystem>& other_system,
                                                     const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                     const std::vector<int>& rows,
                                                     const Eigen::Ref<const Eigen::MatrixXd>& measured,
                                                     const Eigen::Ref<const Eigen::MatrixXd>& noise_stddev);

/// max |A ddq − b| over states and rows of A.
/// @param accelerations  (nq × N)
double max_constraint_error(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                            const Eigen::Ref<const Eigen::VectorXd>& parameters,
                            const Eigen::Ref<const Eigen::MatrixXd>& accelerations);

}  // namespace gp2
