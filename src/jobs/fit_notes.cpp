#include "jobs/fit_notes.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "data/evenly.hpp"
#include "gp2/training/robust.hpp"
#include "inference/cross_validation.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

void note_kept_parameter(const Parameter& there, const Model& other, const Model& fitted, std::vector<std::string>& notes) {
  notes.push_back(
      fmt::format("{}: parameter '{}' stays {} there while it is estimated in '{}'; mark it estimate = true there if it is one "
                  "and the same",
                  other.name, there.name, there.value, fitted.name));
}

void add_noise_notes(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr double much = 20;
  const std::vector<Observations>& all = posterior.observations();
  struct Found {
    double stddev;
    std::size_t log;
  };
  std::map<std::pair<std::string, bool>, std::vector<Found>> found;  // by what is observed, and whether the log states its noise
  for (std::size_t g = 0; g < all.size(); ++g) {
    if (!all[g].noise().is_estimated() || all[g].has_sums() || !all[g].view().is_of_ddq() || all[g].view().other_system) continue;
    const std::vector<std::string> names = all[g].view().names(*posterior.prior().system);
    const VectorXd stddev = posterior.noise_stddev(g);
    for (Eigen::Index k = 0; k < stddev.size(); ++k) {
      found[{names[static_cast<std::size_t>(k)], all[g].states_noise(k)}].push_back({stddev[k], g});
    }
  }
  for (const auto& [of, ones] : found) {
    const auto [least, most] = std::ranges::minmax_element(ones, {}, &Found::stddev);
    if (!(most->stddev > much * least->stddev)) continue;
    notes.push_back(
        fmt::format("warning: the estimated noise of {} is {:.2g} times as large in log {} as in log {}: the log may contradict "
                    "the others rather than be noisy; see gp2 check",
                    of.first, most->stddev / least->stddev, most->log + 1, least->log + 1));
  }
}

void add_pile_up_notes(const std::vector<Observations>& observations, const System& system, std::vector<std::string>& notes) {
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    const View& view = group.view();
    if (!view.is_of_ddq() || view.other_system) continue;
    const std::string of_log = observations.size() > 1 ? fmt::format(" of log {}", g + 1) : "";
    for (int k = 0; k < system.layout().nu; ++k) {
      const std::string& input = system.inputs()[static_cast<std::size_t>(k)];
      if (auto text = clipped_input(input + of_log, group.states().row(system.layout().u(k)))) notes.push_back(*std::move(text));
    }
    const std::vector<std::string> names = view.names(system);
    for (int k = 0; k < view.size(); ++k) {
      const std::string name = fmt::format("warning: {}{}", names[static_cast<std::size_t>(k)], of_log);
      if (auto text = pile_up_text(name, group.values().row(k), "a sensor at the end of its range?"))
        notes.push_back(*std::move(text));
      const int j = view.rows[static_cast<std::size_t>(k)];
      const std::string velocity = system.coordinates()[static_cast<std::size_t>(j)].velocity();
      if (auto text = clipped_velocity(fmt::format("warning: {}{}", velocity, of_log), group.states().row(system.layout().dq(j)),
                                       group.values().row(k)))
        notes.push_back(*std::move(text));
    }
  }
}

std::string place_of(const std::vector<std::vector<int>>& lines, std::size_t group, std::size_t state, bool has_one_log) {
  const bool has_line = group < lines.size() && state < lines[group].size();
  return fmt::format("{} {}{}", has_line ? "line" : "row", has_line ? lines[group][state] : static_cast<int>(state) + 1,
                     has_one_log ? "" : fmt::format(" of log {}", group + 1));
}

std::string gross_errors_text(const FitProblem& problem) {
  constexpr double few = 0.05;  // of a column's values
  constexpr std::size_t most_shown = 6;
  std::vector<std::string> far;
  for (std::size_t g = 0; g < problem.observations.size(); ++g) {
    const Observations& group = problem.observations[g];
    const View& view = group.view();
    const MatrixXd near = without_gross_errors(group.values());
    const std::vector<std::string> names = view.names(*prior_of(problem.prior, view).system);
    for (Eigen::Index k = 0; k < near.rows(); ++k) {
      const auto n = (!group.values().row(k).array().isNaN()).count(), n_near = (!near.row(k).array().isNaN()).count();
      if (static_cast<double>(n - n_near) > few * static_cast<double>(n)) continue;
      for (Eigen::Index i = 0; i < near.cols(); ++i) {
        if (std::isnan(group.values()(k, i)) || !std::isnan(near(k, i))) continue;
        far.push_back(fmt::format("{} = {:.6g} in {}", names[static_cast<std::size_t>(k)], group.values()(k, i),
                                  place_of(problem.lines, g, static_cast<std::size_t>(i), problem.observations.size() == 1)));
      }
    }
  }
  if (far.empty()) return "";
  if (far.size() > most_shown) {
    far.resize(most_shown);
    far.emplace_back("…");
  }
  return fmt::format("single values lie far from all others: {}. Correct or empty these cells, or fit with `robust`",
                     fmt::join(far, ", "));
}

namespace {

// The accelerations of a group against A ddq = b. An estimated noise takes up what denies a constraint: beside it they are judged by
// the terms that should cancel, as where no noise is known. A row of one term alone has nothing to cancel, and a soft one need not.
std::vector<ConstraintResidual> residuals_against_constraints(const Posterior& posterior, const TrustedData& trusted,
                                                              std::size_t group) {
  const Observations& of = trusted.observations[group];
  const Prior& prior = prior_of(posterior.prior(), of.view());
  const MatrixXd noise = of.noise().of_values(posterior.noise_stddev(group), of.n_data());
  std::vector<ConstraintResidual> residuals =
      constraint_residuals(posterior, of.view().other_system, of.states(), of.view().rows, of.values(), noise);
  if (!of.noise().is_estimated() || of.has_sums() || prior.system->has_constraint_noise()) return residuals;
  constexpr double rounding = 1e-9;
  for (ConstraintResidual& one : residuals) {
    if (!one.is_too_large() && one.rms < (1 - rounding) * one.size) one.expected = not_a_number;
  }
  return residuals;
}

// The accelerations of each log against the constraints.
void add_constraint_residual_notes(const Posterior& posterior, const TrustedData& trusted, std::vector<std::string>& notes) {
  for (std::size_t g = 0; g < trusted.observations.size(); ++g) {
    if (!trusted.observations[g].view().is_of_ddq()) continue;
    const std::string of_log = trusted.observations.size() > 1 ? fmt::format("log {}: ", g + 1) : "";
    for (ConstraintResidual& one : residuals_against_constraints(posterior, trusted, g)) {
      if (!one.is_too_large()) continue;
      if (g < trusted.lines.size()) one.lines = trusted.lines[g];
      notes.push_back(fmt::format("warning: {}{}", of_log, one.text()));
    }
  }
}

// Single values that are far off; those of columns of which many are not counted.
void add_far_value_note(const Prior& prior, const TrustedData& trusted, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes) {
  constexpr double much = 3;  // times the noise, or what the fit is sure of
  const TrainingResidual* farthest = nullptr;
  int n_far = 0;
  for (const TrainingResidual& one : residuals) {
    if (one.is_too_large()) continue;
    n_far += one.n_far;
    if (one.n_far > 0 && (farthest == nullptr || one.farthest > farthest->farthest)) farthest = &one;
  }
  if (farthest == nullptr) return;
  const std::string where = farthest->farthest_state < 0 ? ""
                                                         : ", in " + place_of(trusted.lines, farthest->group,
                                                                              static_cast<std::size_t>(farthest->farthest_state),
                                                                              trusted.observations.size() == 1);
  const bool is_open = !prior.reference && farthest->rms_in_noise > much * std::max(1.0, farthest->rms);
  notes.push_back(fmt::format(
      "warning: {} of the values lie six or more standard deviations from their prediction by all others, up to {:.2g} ({}{}): "
      "{}outliers of the log, or rare states at which the fit is overconfident; see `robust`",
      n_far, farthest->farthest, farthest->output, where,
      is_open ? "a mass, a length or a force that is wrong, as all values are predicted far worse than the noise; or " : ""));
}

}  // namespace

bool has_dependent_columns(const Posterior& posterior, const Observations& group) {
  const System& system = prior_of(posterior.prior(), group.view()).reference_system();
  if (!group.view().is_of_ddq() || group.view().size() < system.nq() || group.has_sums()) return false;
  MatrixXd accelerations(system.nq(), group.n_data());
  accelerations(group.view().rows, Eigen::all) = group.values();
  return dependent_columns(system, group.states(), parameters_of(group.view(), posterior.values().parameters), accelerations)
      .has_value();
}

std::vector<std::string> constraint_warnings(const Posterior& posterior, const std::shared_ptr<const OtherSystem>& other_system,
                                             const std::string& log, const MatrixXd& states, const std::vector<int>& rows,
                                             const MatrixXd& measured, const MatrixXd& noise_stddev) {
  std::vector<std::string> warnings;
  if (posterior.prior().reference) return warnings;
  for (const ConstraintResidual& one : constraint_residuals(posterior, other_system, states, rows, measured, noise_stddev)) {
    if (one.is_too_large()) warnings.push_back(fmt::format("warning: {}: {}", log, one.text()));
  }
  return warnings;
}

bool denies_constraints(const Posterior& posterior, const TrustedData& trusted) {
  for (std::size_t g = 0; g < trusted.observations.size(); ++g) {
    if (!trusted.observations[g].view().is_of_ddq()) continue;
    if (std::ranges::any_of(residuals_against_constraints(posterior, trusted, g), &ConstraintResidual::is_too_large)) return true;
  }
  return false;
}

void add_residual_notes(const Posterior& posterior, const TrustedData& trusted, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes, bool has_fixed_noise) {
  add_constraint_residual_notes(posterior, trusted, notes);
  const bool is_baseline = posterior.prior().reference != nullptr;
  std::vector<std::string> large, small;
  for (const TrainingResidual& one : residuals) {
    const Observations& group = trusted.observations[one.group];
    if (one.is_too_small() && !group.noise().is_estimated() && !group.has_sums() && !has_dependent_columns(posterior, group))
      small.push_back(fmt::format("{} ({:.2g} of the noise)", one.output, one.rms_in_noise));
    if (one.is_too_large())
      large.push_back(fmt::format("{} (z rms {:.2g}, {:.0f} % within 95 %)", one.output, one.rms, 100 * one.coverage95));
  }
  if (!large.empty()) {
    notes.push_back(
        fmt::format("warning: values differ from their prediction by all others by more than noise: {}: the noise is stated too "
                    "small, a column is wrong or lags, {} miss something; see gp2 check and gp2 report",
                    fmt::join(large, ", "),
                    is_baseline ? "or the features" : "a mass, a length or a force is wrong, or the constraints or features"));
  }
  add_far_value_note(posterior.prior(), trusted, residuals, notes);
  if (small.empty()) return;
  notes.push_back(
      fmt::format("values lie closer to their prediction by all others than the stated noise allows: {}: it is stated too large, "
                  "or rows share their errors, as smoothed ones do{}",
                  fmt::join(small, ", "), is_baseline || has_fixed_noise ? "" : "; `noise_std=estimate` finds it"));
}

namespace {

constexpr int enough_rows = 100;  // for a verdict on the model

bool has_far_values(const CrossValidation& of) {
  return std::ranges::any_of(of.residuals, [](const TrainingResidual& one) { return one.n_far > 0; });
}

// Whether stretches that were left out are predicted much worse than the noise and single values, or somewhat worse while
// the fit is too sure of itself. What the model lacks is taken up between rows that are known, and told by stretches that are not.
bool predicts_stretches_worse(const CrossValidation& of) {
  constexpr double several = 3, twice = 2;  // times the noise; the error of single values
  constexpr double somewhat = 1.3, low_coverage = 0.9, full_coverage = 0.95;
  if (!of.stretches) return false;
  const Evaluation::Part &values = of.values, &stretches = *of.stretches;
  const double error = stretches.nrmse;
  // of the spread; a fit that knows how far it errs there may err more
  const bool is_sure = stretches.coverage95 < full_coverage;
  const double worth_a_word = is_sure ? 0.01 : 0.1;
  if (error > std::max({several * of.nrmse_of_noise, twice * values.nrmse, worth_a_word})) return true;
  if (is_sure && stretches.n >= enough_rows && error > twice * std::max(of.nrmse_of_noise, values.nrmse)) return true;
  if (error > somewhat * std::max(of.nrmse_of_noise, values.nrmse) && stretches.coverage95 < low_coverage) {
    return stretches.n >= enough_rows;
  }
  return is_coverage_low(stretches.coverage95, stretches.n) && !is_coverage_low(values.coverage95, values.n) &&
         error > values.nrmse;
}

// Whether even between others rows are predicted much worse than the noise, and neither single values nor a column are said to be.
bool predicts_rows_badly(const CrossValidation& of) {
  constexpr double several = 3, worth_a_word = 0.1;  // times the noise; of the spread
  return of.one_by_one.nrmse > std::max(several * of.nrmse_of_noise, worth_a_word) && !has_far_values(of) &&
         std::ranges::none_of(of.residuals, &TrainingResidual::is_too_large);
}

// Whether what the fit leaves open is more than a sound model would of as many rows: it errs even between them, and far more beyond; or
// it errs far beyond the noise where it is too sure of itself.
bool denies_model(const CrossValidation& of, const Evaluation::Part& left_out) {
  constexpr double between = 2, beyond = 5, far_beyond = 10;          // times the noise
  constexpr double worth_a_warning = 0.1, worth_one_by_itself = 0.2;  // of the spread
  constexpr double low_coverage = 0.9;
  if (of.values.n < enough_rows || !(left_out.nrmse > worth_a_warning)) return false;
  return (of.values.nrmse > between * of.nrmse_of_noise && left_out.nrmse > beyond * of.nrmse_of_noise) ||
         (left_out.coverage95 < low_coverage && left_out.nrmse > std::max(worth_one_by_itself, far_beyond * of.nrmse_of_noise));
}

// What a model may have wrong that rows left out are predicted badly.
std::string causes_text(const Prior& prior) {
  std::vector<std::string> causes;
  if (prior.system->layout().nu > 0) causes.emplace_back("an input that is clipped, late or scaled");
  if (prior.reference) {
    causes.emplace_back("something that acts and is not among the features");
  } else {
    causes.emplace_back("a mass, an inertia or a length that is off");
    causes.emplace_back("a constraint that is missing");
    if (std::ranges::any_of(prior.latents, &Latent::is_potential))
      causes.emplace_back("a force that dissipates, which a potential does not");
    causes.emplace_back("a force that no latent stands for");
  }
  causes.emplace_back("a clock that is not that of the samples");
  return fmt::format(
      "Something differs from the model ({}), or the rows are too few, or of one motion, for what the model must learn",
      fmt::join(causes, ", "));
}

// Rows or stretches of which half of what they do, or more, is not predicted.
struct LittlePredicted {
  const Evaluation::Part* part = nullptr;  // null: none
  const char* what = "";
};

LittlePredicted little_predicted(const CrossValidation& of) {
  if (of.predicts_little()) return {&*of.stretches, "unseen stretches of the log"};
  const bool rows = is_little_predicted(of.one_by_one, of.nrmse_of_noise) && std::isfinite(of.one_by_one.nrmse);
  if (rows && !has_far_values(of)) return {&of.one_by_one, "rows left out one by one"};
  return {};
}

}  // namespace

void add_stretch_note(const CrossValidation& cross_validation, std::vector<std::string>& notes, const Prior& prior) {
  const Evaluation::Part& rows = cross_validation.one_by_one;
  const double noise = cross_validation.nrmse_of_noise;
  if (const LittlePredicted little = little_predicted(cross_validation); little.part != nullptr) {
    constexpr double useless = 0.9;
    const double error = little.part->nrmse;
    const bool is_warning = error >= useless || denies_model(cross_validation, *little.part);
    const char* const than_mean = error >= 1         ? ", worse than their mean would"
                                  : error >= useless ? ", hardly better than their mean would"
                                                     : "";
    notes.push_back(fmt::format("{}the fit predicts {} badly{}: nrmse {:.2g}, of which noise is {:.2g}. {}",
                                is_warning ? "warning: " : "", little.what, than_mean, error, noise, causes_text(prior)));
  } else if (predicts_stretches_worse(cross_validation)) {
    const Evaluation::Part& stretches = *cross_validation.stretches;
    notes.push_back(fmt::format(
        "{}stretches of the log that were left out are predicted worse than single values: nrmse {:.2g}, not {:.2g}, of which "
        "noise is {:.2g}; the 95 % intervals contain {:.0f} %. {}",
        denies_model(cross_validation, stretches) ? "warning: " : "", stretches.nrmse, cross_validation.values.nrmse, noise,
        100 * stretches.coverage95, causes_text(prior)));
  } else if (predicts_rows_badly(cross_validation)) {
    notes.push_back(
        fmt::format("rows left out one by one are predicted far worse than the noise: nrmse {:.2g}, of which noise is {:.2g}. {}",
                    rows.nrmse, noise, causes_text(prior)));
  }
}

bool last_beyond_noise(const std::vector<TrainingResidual>& residuals) {
  constexpr double beyond = 2;  // times the noise; errors that last are 1
  return std::ranges::any_of(residuals,
                             [](const TrainingResidual& one) { return one.is_correlated() && one.rms_in_noise > beyond; });
}

std::string correlated_text(const std::vector<TrainingResidual>& residuals, bool is_of_baseline) {
  std::vector<std::string> correlated;
  double in_noise = 0;
  for (const TrainingResidual& one : residuals) {
    if (!one.is_correlated()) continue;
    const std::string text = fmt::format("{} ({:.2g})", one.output, one.serial_correlation);
    if (std::ranges::find(correlated, text) == correlated.end()) correlated.push_back(text);  // else of another short log
    in_noise = std::max(in_noise, one.rms_in_noise);
  }
  if (correlated.empty()) return {};
  if (last_beyond_noise(residuals)) {
    return fmt::format("residuals are correlated from row to row, by {}, and {:.2g} times the noise: {}",
                       fmt::join(correlated, ", "), in_noise,
                       is_of_baseline ? "something acts that is not among the features"
                                      : "a mass, a length, a force or a constraint of the model is wrong or missing");
  }
  return fmt::format(
      "residuals are correlated from row to row, by {}: an effect that lasts longer than a sample is missing, and the rows are "
      "fewer independent measurements than they seem",
      fmt::join(correlated, ", "));
}

void add_impossible_note(int n_impossible, int n_draws, std::vector<std::string>& notes) {
  if (n_impossible == 0) return;
  notes.push_back(fmt::format("warning: {} of {} draws of the hyperparameters are left out: there is no posterior under them",
                              n_impossible, n_draws));
}

// What the values of a group measure: of accelerations, no more than the constraints leave free.
std::ptrdiff_t n_independent(const Posterior& posterior, const Observations& group) {
  const auto n_finite = [&](Eigen::Index i) {
    return static_cast<std::ptrdiff_t>(group.values().col(i).array().isFinite().count());
  };
  if (!group.view().is_of_ddq()) return group.values().array().isFinite().count();
  std::ptrdiff_t n = 0;
  const System& system = prior_of(posterior.prior(), group.view()).reference_system();
  for_each_mechanics(system, group.states(), parameters_of(group.view(), posterior.values().parameters), 1,
                     [&](Eigen::Index first, const MechanicsBatch& mechanics) {
                       for (const UdwadiaKalaba& projection : mechanics.projections)
                         n += std::min<std::ptrdiff_t>(n_finite(first++), system.nq() - projection.rank());
                     });
  return n;
}

void add_few_values_note(const FitReport& report, const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr std::ptrdiff_t enough = 3;  // values for each unknown
  const auto is_estimated = [](const Hyperparameter& h) { return h.is_system_parameter() && !h.is_fixed() && !h.at_bound(); };
  const std::ptrdiff_t n_parameters = std::ranges::count_if(report.hyperparameters, is_estimated);
  if (!report.uncertainty || report.draws || n_parameters == 0) return;
  std::ptrdiff_t n_unknown = n_parameters, n_values = 0;
  for (const Latent& latent : posterior.prior().latents) {
    if (!latent.kernel_is_fixed) n_unknown += latent.size();  // of the discrepancy little is asked
  }
  if (n_states(posterior.observations()) >= enough * n_unknown) return;
  for (const Observations& group : posterior.observations()) n_values += n_independent(posterior, group);
  if (n_values >= enough * n_unknown) return;
  notes.push_back(
      fmt::format("warning: {} measured values are few for {} estimated parameters and {} functions: standard errors may be "
                  "several times too small. Take more rows, or fit with `hyperparameters=integrate`",
                  n_values, n_parameters, n_unknown - n_parameters));
}

void add_draw_notes(const FitReport& report, std::vector<std::string>& notes) {
  if (!report.draws) {
    notes.push_back(
        "warning: no hyperparameters were drawn: none is free, or the likelihood is not finite near the optimum; the "
        "fit is that of the optimum");
    return;
  }
  const int n_impossible = report.draws->n_impossible;
  add_impossible_note(n_impossible, n_impossible + static_cast<int>(report.draws->size()), notes);
  Eigen::Index k = 0;
  const double worst = report.draws->r_hat.maxCoeff(&k);
  if (!(worst > HyperparameterDraws::largest_r_hat)) return;
  notes.push_back(fmt::format(
      "the hyperparameter chains have not mixed (R̂ {:.3g} of {}, near 1 if they have): each stays with its own explanation, and "
      "their weights rest on Laplace's approximation; compare predictions with those of another `seed`",
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
      fmt::format("warning: under a prior mean of zero the constraint alone causes far more than was measured: {}. It acts "
                  "through the inertias, most on the smallest; fit with `mean=force`, or check the masses",
                  fmt::join(large, ", ")));
}

void add_inducing_note(const InducingReport& inducing, std::vector<std::string>& notes) {
  constexpr double much = 3;  // nats
  const double left_out = 0.5 * inducing.left_out.cwiseMax(0).sum();
  notes.push_back(fmt::format("learned with {} inducing variables: they lose about {:.2g} nats{}", inducing.n_variables, left_out,
                              left_out > much ? "; more may help (`inducing=M`)" : ""));
}

void add_window_note(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr double large = 2;  // in simulated logs it was 0.8 to 1.3
  double factor = 0;
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    if (posterior.observations()[g].has_sums()) factor = std::max(factor, posterior.noise_stddev(g).maxCoeff());
  }
  if (!(factor > large)) return;
  notes.push_back(
      fmt::format("warning: over time windows the log deviates by {:.2g} times the noise of its positions: something is missing "
                  "in the model; compare a fit with `windows=none`",
                  factor));
}

std::optional<std::string> note_of_unlearnable_force(const Prior& prior) {
  if (prior.mean != Prior::Mean::zero || prior.reference) return std::nullopt;
  const std::vector<bool> known = prior.reads(), force = prior.system->reads(SystemPart::force);
  const std::vector<std::string> names = prior.system->state_names();
  std::vector<std::string> unknown;
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (force[k] && !known[k]) unknown.push_back(names[k]);
  }
  if (unknown.empty()) return std::nullopt;
  return fmt::format(
      "warning: the known force of [mechanics] is not used, and no feature reads {}, on which it depends: fit with "
      "`mean=force`",
      fmt::join(unknown, ", "));
}

void add_force_note(const Posterior& posterior, std::vector<std::string>& notes) {
  Prior prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  if (prior.mean != Prior::Mean::zero || prior.reference || note_of_unlearnable_force(prior)) return;
  bool is_zero = true;
  for (const Observations& group : observations) {
    if (group.view().other_system) return;
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

void add_learned_note(const FitFile& fit, const CsvTable& log, std::vector<std::string>& notes) {
  if (!log.file() || !fit.has_learned(*log.file())) return;
  notes.push_back(fmt::format("{}: the fit has learned from this log: errors at new data are larger", log.name()));
}

}  // namespace gp2
