#include "jobs/fit_notes.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "inference/posterior_implementation.hpp"

namespace gp2 {

using Eigen::MatrixXd;

void add_residual_notes(const Posterior& posterior, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes) {
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    if (!posterior.observations()[g].view().is_of_ddq()) continue;
    for (const ConstraintResidual& one : constraint_residuals(posterior, g)) {
      if (one.is_too_large()) notes.push_back("warning: " + one.text());
    }
  }
  std::vector<std::string> large;
  for (const TrainingResidual& one : residuals) {
    if (!one.is_too_large()) continue;
    large.push_back(fmt::format("{} (z rms {:.2g}, {:.0f} % within 95 %)", one.output, one.rms, 100 * one.coverage95));
  }
  if (!large.empty()) {
    notes.push_back(
        fmt::format("warning: values lie farther than noise from what all others predict: {}: the noise is stated too small, a "
                    "column is wrong or lags, or the constraints or features miss something; see gp2 check and gp2 report",
                    fmt::join(large, ", ")));
  }
}

std::string correlated_text(const std::vector<TrainingResidual>& residuals) {
  std::vector<std::string> correlated;
  for (const TrainingResidual& one : residuals) {
    if (one.is_correlated()) correlated.push_back(fmt::format("{} ({:.2g})", one.output, one.serial_correlation));
  }
  if (correlated.empty()) return {};
  return fmt::format(
      "residuals go on from row to row, correlation {}: something that lasts longer than a sample is missing, and "
      "the rows are fewer measurements than they seem",
      fmt::join(correlated, ", "));
}

void add_draw_notes(const FitReport& report, std::vector<std::string>& notes) {
  if (!report.draws) {
    notes.push_back(
        "warning: no hyperparameters were drawn: none is free, or the likelihood is not finite near the optimum; the "
        "fit is that of the optimum");
    return;
  }
  if (report.draws->n_impossible > 0) {
    notes.push_back(fmt::format("warning: {} of {} draws of the hyperparameters are left out: there is no posterior under them",
                                report.draws->n_impossible, report.draws->n_impossible + report.draws->size()));
  }
  Eigen::Index k = 0;
  const double worst = report.draws->r_hat.maxCoeff(&k);
  if (!(worst > HyperparameterDraws::largest_r_hat)) return;
  notes.push_back(
      fmt::format("the chains that draw hyperparameters have not mixed (R̂ {:.2f} of {}, near 1 where they have): they stay with "
                  "explanations of "
                  "their own, whose shares rest on Laplace's approximation; the same fit with another `seed` tells what it means "
                  "for predictions",
                  worst, report.hyperparameters[static_cast<std::size_t>(k)].name));
}

void add_constraint_note(const Posterior& posterior, std::vector<std::string>& notes) {
  if (posterior.prior().mean != Prior::Mean::zero || posterior.prior().reference) return;
  constexpr double far = 3;
  std::vector<std::string> large;
  for (const Observations& group : posterior.observations()) {
    const View& view = group.view();
    if (!view.is_of_ddq() || view.other_system || group.has_sums()) continue;
    const MechanicsBatch mechanics =
        require_mechanics(posterior.prior(), view, group.states(), parameters_of(view, posterior.values().parameters));
    const MatrixXd of_constraint = evaluate_view(view, mechanics, group.states()).offset;
    const std::vector<std::string> names = view.names(*posterior.prior().system);
    for (int k = 0; k < view.size(); ++k) {
      const auto is_measured = group.values().row(k).array().isFinite();
      const double n = static_cast<double>(is_measured.count());
      const double measured = std::sqrt(is_measured.select(group.values().row(k), 0).squaredNorm() / n);
      const double constraint = std::sqrt(is_measured.select(of_constraint.row(k), 0).squaredNorm() / n);
      if (constraint > far * measured)
        large.push_back(
            fmt::format("{} ({:.2g} rms, measured {:.2g})", names[static_cast<std::size_t>(k)], constraint, measured));
    }
  }
  if (large.empty()) return;
  notes.push_back(
      fmt::format("warning: under a prior mean of zero the constraint alone makes far more than was measured: {}. It acts by the "
                  "inertias, and "
                  "on the smallest most; fit with `mean=force`, or see that the masses are right",
                  fmt::join(large, ", ")));
}

void add_inducing_note(const InducingReport& inducing, std::vector<std::string>& notes) {
  constexpr double much = 3;  // nats
  const double left_out = 0.5 * inducing.left_out.cwiseMax(0).sum();
  notes.push_back(fmt::format("learned through {} inducing variables: what they leave out is worth about {:.2g} nats{}",
                              inducing.n_variables, left_out, left_out > much ? "; more may tell more (`inducing=M`)" : ""));
}

void add_window_note(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr double large = 2;  // in simulated logs it was 0.8 to 1.3
  double factor = 0;
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    if (posterior.observations()[g].has_sums()) factor = std::max(factor, posterior.noise_stddev(g).maxCoeff());
  }
  if (!(factor > large)) return;
  notes.push_back(fmt::format(
      "warning: over windows of time the log deviates by {:.2g} times what the noise of its positions makes: the machine "
      "does what the model cannot; compare a fit with `windows=none`",
      factor));
}

void add_force_note(const Posterior& posterior, std::vector<std::string>& notes) {
  Prior prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  const bool is_elsewhere =
      std::any_of(observations.begin(), observations.end(), [](const auto& group) { return group.view().other_system; });
  if (prior.mean != Prior::Mean::zero || prior.reference || is_elsewhere) return;
  const std::vector<bool> known = prior.reads(), force = prior.system->reads(SystemPart::force);
  const std::vector<std::string> names = prior.system->state_names();
  std::vector<std::string> unknown;
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (force[k] && !known[k]) unknown.push_back(names[k]);
  }
  if (!unknown.empty()) {
    notes.push_back(
        fmt::format("warning: the known force of [mechanics] is not used, and no feature reads {}, on which it depends: fit "
                    "with `mean=force`",
                    fmt::join(unknown, ", ")));
    return;
  }
  bool is_zero = true;
  for (const Observations& group : observations) {
    const MatrixXd F = prior.system->evaluate(group.states(), posterior.values().parameters).force;
    if (!F.allFinite()) return;
    is_zero = is_zero && F.isZero(0);
  }
  if (is_zero) return;
  // of the rows that are still here, if not of all
  const double without = Posterior(prior, observations, posterior.values()).negative_log_likelihood();
  prior.mean = Prior::Mean::force;
  const double gain = without - Posterior(prior, observations, posterior.values()).negative_log_likelihood();
  if (gain <= 10) return;
  notes.push_back(fmt::format(
      "the known force of [mechanics] is not used: with `mean=force` the log likelihood of these data is {:.3g} higher, "
      "under the same hyperparameters",
      gain));
}

}  // namespace gp2
