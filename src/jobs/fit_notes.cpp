#include "jobs/fit_notes.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "data/evenly.hpp"
#include "inference/posterior_implementation.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

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

void add_stretch_note(const CrossValidation& cross_validation, std::vector<std::string>& notes) {
  if (!cross_validation.predicts_little()) return;
  notes.push_back(fmt::format(
      "{}of stretches of the log that it has not seen the fit says little: nrmse {:.2g}, of which the noise makes {:.2g}. An "
      "input, a mass or a constraint is wrong or missing, or the rows are too few for what the model leaves open",
      cross_validation.predicts_nothing() ? "warning: " : "", cross_validation.stretches->nrmse,
      cross_validation.nrmse_of_noise));
}

namespace {

// The prior mean of observations, or where an input is 0 (d × N); nothing where that is no number.
std::optional<MatrixXd> mean_of(const Posterior& posterior, const Observations& group, std::optional<int> without = {}) {
  const Prior& prior = posterior.prior();
  const View& view = group.view();
  MatrixXd states = group.states(), of_view(view.size(), group.n_data());
  if (without) states.row(*without).setZero();
  const VectorXd parameters = parameters_of(view, posterior.values().parameters);
  MechanicsBatch mechanics;
  evaluate_mechanics(prior, view, states, parameters, mechanics);
  if (mechanics.fault) return std::nullopt;
  PriorValues values = evaluate_prior(prior, states, parameters, mechanics);
  if (values.fault) return std::nullopt;
  keep_viewed(view, values);
  const ViewValues viewed = evaluate_view(view, mechanics, states);
  for (int i = 0; i < group.n_data(); ++i) of_view.col(i) = viewed.G(i) * values.mean.col(i);
  return of_view;
}

// What an input adds to the prior mean of each of some observations.
struct InputEffect {
  std::string name;
  std::vector<MatrixXd> added;  // (d × N)
};

// @returns nothing where there is no number without the input
std::optional<InputEffect> effect_of(const Posterior& posterior, const std::vector<Observations>& observations, int input) {
  const System& system = *posterior.prior().system;
  InputEffect effect{system.inputs()[static_cast<std::size_t>(input)], {}};
  for (const Observations& group : observations) {
    const auto as_logged = mean_of(posterior, group), without = mean_of(posterior, group, system.layout().u(input));
    if (!as_logged || !without) return std::nullopt;
    effect.added.emplace_back(*as_logged - *without);
  }
  return effect;
}

Observations less(const Observations& group, const MatrixXd& values) {
  const Observations out = group.with_values(group.values() - values);
  if (!group.has_sums()) return out;
  std::vector<WeightedSum> sums = group.sums();
  for (WeightedSum& sum : sums) sum.value -= values.row(sum.row).segment(sum.first, sum.weights.size()).dot(sum.weights);
  return out.with_sums(std::move(sums));
}

// What is left to explain where an input does `factor` times as much.
std::vector<Observations> with_factor(const std::vector<Observations>& observations, const InputEffect& effect, double factor) {
  std::vector<Observations> out;
  for (std::size_t g = 0; g < observations.size(); ++g) out.push_back(less(observations[g], (factor - 1) * effect.added[g]));
  return out;
}

// By which factor an input would have to do more for the data to be most likely.
struct InputFactor {
  double factor = 1, stddev = 0;
  double gain = 0;  // in log likelihood
};

// The log likelihood is quadratic in the factor: three values tell where it is largest.
InputFactor likeliest_factor(double cost_without, double cost_as_logged, double cost_twice) {
  const double curvature = cost_without - 2 * cost_as_logged + cost_twice;
  if (!(curvature > 0)) return {};
  const double step = 0.5 * (cost_without - cost_twice) / curvature;
  return {1 + step, 1 / std::sqrt(curvature), 0.5 * curvature * step * step};
}

// A wrong one makes others seem wrong: the most doubtful first, the others beside it as it should be.
void note_denied_inputs(const Posterior& posterior, std::vector<Observations> observations, std::vector<InputEffect> inputs,
                        std::vector<std::string>& notes) {
  constexpr double far = 0.5, sure = 5, least = 10;  // from a factor of 1; deviations; nats
  const auto cost = [&](const std::vector<Observations>& some) {
    return Posterior(posterior.prior(), some, posterior.values()).negative_log_likelihood();
  };
  while (!inputs.empty()) {
    const double as_logged = cost(observations);
    auto worst = inputs.end();
    InputFactor of_worst{.gain = least};
    for (auto input = inputs.begin(); input != inputs.end(); ++input) {
      const InputFactor one =
          likeliest_factor(cost(with_factor(observations, *input, 0)), as_logged, cost(with_factor(observations, *input, 2)));
      if (!(std::abs(one.factor - 1) > std::max(far, sure * one.stddev) && one.gain > of_worst.gain)) continue;
      worst = input;
      of_worst = one;
    }
    if (worst == inputs.end()) return;
    notes.push_back(
        fmt::format("warning: the data deny the input {}: they are most likely where it acts {:.2g} ± {:.2g} times as logged, "
                    "by {:.2g} in log likelihood. A sign or a unit is wrong, or an inertia that it moves, or it acts late",
                    worst->name, of_worst.factor, of_worst.stddev, of_worst.gain));
    observations = with_factor(observations, *worst, of_worst.factor);
    inputs.erase(worst);
  }
}

}  // namespace

void add_input_notes(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr int enough = 1500, fewest = 10;  // values: a sign or a unit needs no more; states
  const Prior& prior = posterior.prior();
  const System& system = *prior.system;
  const StateLayout layout = system.layout();
  const std::vector<Observations>& all = posterior.observations();
  const auto any = [&](const auto& is) { return std::any_of(all.begin(), all.end(), is); };
  if (prior.mean != Prior::Mean::force || prior.reference || n_states(all) < fewest ||
      any([](const auto& group) { return bool(group.view().other_system); }))
    return;
  const bool has_sums = any([](const auto& group) { return group.has_sums(); });
  const bool asks = !prior.is_nonlinear() && !(has_sums && n_states(all) * system.nq() > 2 * enough);
  const std::vector<Observations> some = has_sums ? all : evenly(all, enough / system.nq());
  const std::vector<bool> force = system.reads(SystemPart::force), elsewhere = system.reads(SystemPart::mechanics);
  // a latent that reads an input takes up what it does otherwise
  const auto is_learned = [&](int row) {
    return std::any_of(prior.latents.begin(), prior.latents.end(), [&](const Latent& one) { return one.features->reads(row); });
  };
  std::vector<InputEffect> inputs;
  for (int j = 0; j < layout.nu; ++j) {
    const int row = layout.u(j);
    if (!force[static_cast<std::size_t>(row)]) continue;
    const double first = all.front().states()(row, 0);
    if (!any([&](const auto& group) { return (group.states().row(row).array() != first).any(); })) {
      notes.push_back(fmt::format("the input {} is {:.4g} in every row: was it logged?",
                                  system.inputs()[static_cast<std::size_t>(j)], first));
    } else if (asks && !elsewhere[static_cast<std::size_t>(row)] && !is_learned(row)) {
      if (std::optional<InputEffect> effect = effect_of(posterior, some, j)) inputs.push_back(*std::move(effect));
    }
  }
  note_denied_inputs(posterior, some, std::move(inputs), notes);
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
  if (prior.mean != Prior::Mean::zero || prior.reference) return;
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

}  // namespace gp2
