#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"

// What a person should know of a fit that has ended.
namespace gp2 {

// Says that another system keeps its value of a parameter that is estimated in the fitted one.
void note_kept_parameter(const Parameter& there, const Model& other, const Model& fitted, std::vector<std::string>& notes);

// Logs whose estimated noise is much larger than that of others: a log that contradicts them may be taken for that.
void add_noise_notes(const Posterior& posterior, std::vector<std::string>& notes);

// Input and acceleration columns whose values pile up at an extreme, as clipped ones do.
void add_pile_up_notes(const std::vector<Observations>& observations, const System& system, std::vector<std::string>& notes);

// Where a state stands: "line 9 of log 2", or its row where no line is known.
// @param lines  per Observations: the line in its log of each state; empty where it is not known
std::string place_of(const std::vector<std::vector<int>>& lines, std::size_t group, std::size_t state, bool has_one_log);

// Which measured values lie so far from all others that a fit may fail for them; empty where none do, or many.
std::string gross_errors_text(const FitProblem& problem);

// The observations of a fit without the values that it distrusts, which are no measure of its predictions.
struct TrustedData {
  std::vector<Observations> observations;    // of the posterior, NaN where a robust fit distrusts a value
  std::vector<std::vector<int>> lines = {};  // as place_of
};

// Whether accelerations follow from each other, where all are observed.
bool has_dependent_columns(const Posterior& posterior, const Observations& group);

// What accelerations of a log that the fit has not seen, and their noise, say against the constraints. A baseline knows none.
// @param rows  of ddq, that are measured
std::vector<std::string> constraint_warnings(const Posterior& posterior, const std::shared_ptr<const OtherSystem>& other_system,
                                             const std::string& log, const Eigen::MatrixXd& states, const std::vector<int>& rows,
                                             const Eigen::MatrixXd& measured, const Eigen::MatrixXd& noise_stddev);

// Whether measured accelerations do not obey the constraints.
bool denies_constraints(const Posterior& posterior, const TrustedData& trusted);

// What the residuals say against the data, the constraints or the noise.
// @param has_fixed_noise  whether the options of the fit refuse to estimate its noise, as they do for every baseline
void add_residual_notes(const Posterior& posterior, const TrustedData& trusted, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes, bool has_fixed_noise = false);

// Whether the fit says little of what it has not seen, or less than the noise lets it.
// @param prior  whose possible faults are named
void add_stretch_note(const CrossValidation& cross_validation, std::vector<std::string>& notes, const Prior& prior);

// Whether residuals that go on from row to row are larger than the noise: then it is the model that is wrong, and not the noise that
// lasts.
bool last_beyond_noise(const std::vector<TrainingResidual>& residuals);

// Which residuals go on from row to row; empty where none do.
std::string correlated_text(const std::vector<TrainingResidual>& residuals, bool is_of_baseline = false);

// How many draws are left out, where there is no posterior under them.
void add_impossible_note(int n_impossible, int n_draws, std::vector<std::string>& notes);

// Where few values are measured for each parameter and latent that is estimated from them, and nothing was drawn.
void add_few_values_note(const FitReport& report, const Posterior& posterior, std::vector<std::string>& notes);

// Whether the draws of the hyperparameters can be relied on.
void add_draw_notes(const FitReport& report, std::vector<std::string>& notes);

// Where the constraint turns a prior mean of zero into accelerations far above those measured: it shares out what the prior leaves
// out by the mass matrix, so that where an inertia is small it is nearly all that coordinate's.
void add_constraint_note(const Posterior& posterior, std::vector<std::string>& notes);

// What inducing points leave out makes deviations larger than they need be; of the discrepancy it counts as noise.
void add_inducing_note(const InducingReport& inducing, std::vector<std::string>& notes);

// Where sums over windows of time deviate by far more than the noise of the positions makes them.
void add_window_note(const Posterior& posterior, std::vector<std::string>& notes);

// A known force that is not used, and for which the latents cannot stand.
std::optional<std::string> note_of_unlearnable_force(const Prior& prior);

// Where they could: that the same data are far more likely with it under the same hyperparameters.
void add_force_note(const Posterior& posterior, std::vector<std::string>& notes);

// That a fit is scored on a log which it has learned from.
void add_learned_note(const FitFile& fit, const CsvTable& log, std::vector<std::string>& notes);

}  // namespace gp2
