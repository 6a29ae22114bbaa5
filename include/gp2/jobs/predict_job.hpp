#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/posterior.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// The system that a fit is asked about: its own, or another one in which its latents act.
struct FitSystem {
  const Model* model = nullptr;                               // the fit's or the other system's, which outlive this
  std::vector<Actuator> actuators;                            // of its inputs
  std::shared_ptr<const OtherSystem> other_system = nullptr;  // null: the fit's own
  Prior prior;                                                // there
  std::vector<std::string> notes = {};                        // parameters that keep their values of there, not those fitted
};

/// @param prior   of the posterior
/// @param system  with the same coordinates, inputs and latents; null, or the same model: the fit's own
/// @throws InputError as make_other_system.
FitSystem system_of(const FitFile& fit, const Prior& prior, const std::shared_ptr<const Model>& system);

/// What a fit is asked for: a quantity, of the fitted system or another one.
struct ViewRequest {
  View::Quantity quantity = View::Quantity::constrained_acceleration;
  std::optional<double> time_step;                // Δt of the next velocity
  std::optional<std::string> latent;              // only what this latent adds
  std::shared_ptr<const Model> system = nullptr;  // with the same coordinates, inputs and latents; null: the fitted one
};
/// view, dt, latent.
std::vector<Option> options(ViewRequest& request);

/// A view, and the system under which it is.
struct PredictedView : FitSystem {
  View view;
  std::vector<std::string> names;
};

/// @param prior  of the posterior
/// @throws InputError when the view needs a time step or constraints, or there is no such latent; and as system_of.
PredictedView predicted_view(const FitFile& fit, const Prior& prior, const ViewRequest& request);

struct PredictRequest {
  enum class Covariance { none, stddev, full };

  ViewRequest view;
  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
  Covariance covariance = Covariance::none;
  std::optional<int> n_samples;  // draws of all rows together
  std::uint64_t seed = 0;
  bool unconditioned = false;  // from the prior, as if there had been no data
  /// Instead of the view: the inputs that produce the accelerations which the states come with (inference/inverse_dynamics.hpp).
  bool inverse_dynamics = false;
  /// Instead of the view: the potential of this latent, less that at the first state (Posterior::potential).
  std::optional<std::string> potential;
};
std::vector<Option> options(PredictRequest& request);

struct PredictOutcome {
  /// NAME of the view or of an input, `potential@LATENT`, NAME_std, cov_NAME1_NAME2, ddqJ_missed of inverse dynamics, NAME_sample1, …, distance_from_data
  std::vector<std::string> names;
  Eigen::MatrixXd values;  // (names × N)
  std::vector<std::string> notes;
};

/// @param free  as free_memory(); nothing: no limit
/// @throws InputError where samples of a view at all states together take more
void require_memory_of_samples(const Posterior& posterior, const View& view, Eigen::Index n_states, int n_samples,
                               std::optional<double> free);
/// @param free  as free_memory(); nothing: no limit
/// @throws InputError where the joint covariance of a view at all states takes more
void require_memory_of_joint(const Posterior& posterior, const View& view, Eigen::Index n_states, std::optional<double> free);

/// A note of states that are far from the data.
/// @param distance  Posterior::distance_from_data
std::optional<std::string> note_of_distance(const Eigen::VectorXd& distance);
/// A note of what the data tell little of, where deviations are no better than what the prior assumes.
/// @param mean      of the view at the states
/// @param distance  of these from the data
std::optional<std::string> note_of_untold(const Posterior& posterior, const PredictedView& at, const Eigen::MatrixXd& states,
                                          const Eigen::MatrixXd& mean, const Eigen::VectorXd& distance);

/// @throws InputError for states that are missing, not finite or contradict the constraints, with the table's name; NumericalError as
///   inverse_dynamics.
PredictOutcome predict(const FitFile& fit, CsvTable states, const PredictRequest& request);

/// A warning where wanted accelerations leave inputs open (InverseDynamics::open), but for those that say whether there is contact.
/// @param model   of the inputs
/// @param states  what the rows are called
std::optional<std::string> note_of_open_inputs(const InverseDynamics& found, const Model& model, const std::string& states);

struct EvaluateRequest {
  std::vector<std::string> outputs;               // accelerations; empty: those observed in the fit
  std::shared_ptr<const Model> system = nullptr;  // as ViewRequest
  std::map<std::string, std::string> columns;
  int threads = 0;
};
std::vector<Option> options(EvaluateRequest& request);

struct EvaluateOutcome {
  Evaluation evaluation;
  std::vector<std::string> notes;
};

/// Compares predictions with measured or true accelerations.
/// @param stop  as in EvaluationOptions
EvaluateOutcome evaluate(const FitFile& fit, const Posterior& posterior, CsvTable log, const EvaluateRequest& request,
                         const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
