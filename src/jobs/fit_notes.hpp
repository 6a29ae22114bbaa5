#pragma once

#include <string>
#include <vector>

#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"

// What a person should know of a fit that has ended.
namespace gp2 {

// Logs whose estimated noise is much larger than that of others: a log that contradicts them may be taken for that.
void add_noise_notes(const Posterior& posterior, std::vector<std::string>& notes);

// Input and acceleration columns whose values pile up at an extreme, as clipped ones do.
void add_pile_up_notes(const std::vector<Observations>& observations, const System& system, std::vector<std::string>& notes);

// Which measured values lie so far from all others that a fit may fail for them; empty where none do, or many.
std::string gross_errors_text(const FitProblem& problem);

// What a fit is judged by.
struct JudgedData {
  std::vector<Observations> observations;    // of the posterior, NaN where a robust fit distrusts a value
  std::vector<std::vector<int>> lines = {};  // per Observations: the line in its log of each state; empty where it is not known
};

// Whether measured accelerations do not obey the constraints.
bool denies_constraints(const Posterior& posterior, const JudgedData& judged);

// What the residuals say against the data, the constraints or the noise.
void add_residual_notes(const Posterior& posterior, const JudgedData& judged, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes);
inline void add_residual_notes(const Posterior& posterior, const std::vector<TrainingResidual>& residuals,
                               std::vector<std::string>& notes) {
  add_residual_notes(posterior, {posterior.observations()}, residuals, notes);
}

// Whether the fit says little of what it has not seen, or less than the noise lets it.
// @param prior  of which the possible causes are named; null: not known
void add_stretch_note(const CrossValidation& cross_validation, std::vector<std::string>& notes, const Prior& prior);

// Whether residuals that go on from row to row are larger than the noise: then it is the model that is wrong, and not the noise that
// lasts.
bool last_beyond_noise(const std::vector<TrainingResidual>& residuals);

// Which residuals go on from row to row; empty where none do.
std::string correlated_text(const std::vector<TrainingResidual>& residuals);

// How many draws are left out, where there is no posterior under them.
void add_impossible_note(int n_impossible, int n_draws, std::vector<std::string>& notes);

// Whether the draws of the hyperparameters can be relied on.
void add_draw_notes(const FitReport& report, std::vector<std::string>& notes);

// Where the constraint turns a prior mean of zero into accelerations far above those measured: it shares out what the prior leaves
// out by the mass matrix, so that where an inertia is small it is nearly all that coordinate's.
void add_constraint_note(const Posterior& posterior, std::vector<std::string>& notes);

// What inducing points leave out makes deviations larger than they need be; of the discrepancy it counts as noise.
void add_inducing_note(const InducingReport& inducing, std::vector<std::string>& notes);

// Where sums over windows of time deviate by far more than the noise of the positions makes them.
void add_window_note(const Posterior& posterior, std::vector<std::string>& notes);

// What this fit leaves out of the force that its model knows: that the latents cannot stand for it, or that the same data are far
// more likely with it under the same hyperparameters.
void add_force_note(const Posterior& posterior, std::vector<std::string>& notes);

}  // namespace gp2
