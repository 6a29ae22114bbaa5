#include "jobs/fit_notes.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

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
      "warning: of stretches of the log that it has not seen the fit says little: nrmse {:.2g}, of which the noise makes "
      "{:.2g}. An input, a mass or a constraint is wrong or missing, or the rows are too few for what the model leaves "
      "open",
      cross_validation.stretches->nrmse, cross_validation.nrmse_of_noise));
}

namespace {

// By which factor an input would act under which the data are most likely.
struct InputFactor {
  int input = -1;
  double factor = 1, stddev = 0;
  double gain = 0;  // in log likelihood
};

// What factors of the inputs change of the prior mean of observations (d × N).
MatrixXd change_of_mean(const Posterior& posterior, const Observations& group, const VectorXd& factors) {
  const Prior& prior = posterior.prior();
  const StateLayout layout = prior.system->layout();
  const View& view = group.view();
  const VectorXd parameters = parameters_of(view, posterior.values().parameters);
  const auto mechanics_of = [&](const MatrixXd& states) { return require_mechanics(prior, view, states, parameters); };
  MatrixXd states = group.states();
  const MechanicsBatch mechanics = mechanics_of(states);
  const ViewValues viewed = evaluate_view(view, mechanics, states);
  const MatrixXd as_logged = require_prior_values(prior, states, parameters, mechanics).mean;
  states.middleRows(layout.u(0), layout.nu).array().colwise() *= factors.array();
  const MatrixXd change = require_prior_values(prior, states, parameters, mechanics_of(states)).mean - as_logged;
  MatrixXd of_view(view.size(), group.n_data());
  for (int i = 0; i < group.n_data(); ++i) of_view.col(i) = viewed.G(i) * change.col(i);
  return of_view;
}

Observations less(const Observations& group, const MatrixXd& values) {
  const Observations out = group.with_values(group.values() - values);
  if (!group.has_sums()) return out;
  std::vector<WeightedSum> sums = group.sums();
  for (WeightedSum& sum : sums) sum.value -= values.row(sum.row).segment(sum.first, sum.weights.size()).dot(sum.weights);
  return out.with_sums(std::move(sums));
}

// The mean is affine in each factor, so that three values of the log likelihood tell where it is largest.
// @param cost  negative log likelihood under factors of all inputs
InputFactor likeliest_factor(const std::function<double(const VectorXd&)>& cost, VectorXd factors, int input) {
  const auto at = [&](double factor) {
    factors[input] = factor;
    return cost(factors);
  };
  const double without = at(0), as_logged = at(1), twice = at(2), curvature = without - 2 * as_logged + twice;
  if (!(curvature > 0)) return {};
  const double factor = 1 - 0.5 * (twice - without) / curvature;
  return {input, factor, 1 / std::sqrt(curvature), as_logged - at(factor)};
}

}  // namespace

void add_input_notes(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr int enough = 1500;                       // values: a sign or a unit needs no more
  constexpr double far = 0.5, sure = 5, least = 10;  // from a factor of 1; deviations; nats
  const Prior& prior = posterior.prior();
  const System& system = *prior.system;
  const StateLayout layout = system.layout();
  const std::vector<Observations>& all = posterior.observations();
  const auto any = [&](const auto& is) { return std::any_of(all.begin(), all.end(), is); };
  if (prior.mean != Prior::Mean::force || prior.reference ||
      any([](const auto& group) { return bool(group.view().other_system); }))
    return;
  const std::vector<bool> force = system.reads(SystemPart::force), elsewhere = system.reads(SystemPart::mechanics);
  std::vector<int> in_mean;
  for (int j = 0; j < layout.nu; ++j) {
    const auto row = static_cast<std::size_t>(layout.u(j));
    if (!force[row]) continue;
    const double first = all.front().states()(layout.u(j), 0);
    if (!any([&](const auto& group) { return (group.states().row(layout.u(j)).array() != first).any(); })) {
      notes.push_back(fmt::format("the input {} is {:.4g} in every row: was it logged?",
                                  system.inputs()[static_cast<std::size_t>(j)], first));
    } else if (!elsewhere[row]) {
      in_mean.push_back(j);
    }
  }
  if (prior.is_nonlinear()) return;
  const bool has_sums = any([](const auto& group) { return group.has_sums(); });
  const std::vector<Observations> some = has_sums ? all : evenly(all, enough / system.nq());
  const auto cost = [&](const VectorXd& factors) {
    std::vector<Observations> moved;
    for (const Observations& group : some) moved.push_back(less(group, change_of_mean(posterior, group, factors)));
    return Posterior(prior, moved, posterior.values()).negative_log_likelihood();
  };
  // a wrong one makes others seem wrong: the most doubtful first, the others beside it as it should be
  VectorXd factors = VectorXd::Ones(layout.nu);
  while (!in_mean.empty()) {
    InputFactor worst;
    for (const int j : in_mean) {
      const InputFactor one = likeliest_factor(cost, factors, j);
      if (std::abs(one.factor - 1) > std::max(far, sure * one.stddev) && one.gain > std::max(least, worst.gain)) worst = one;
    }
    if (worst.input < 0) return;
    factors[worst.input] = worst.factor;
    std::erase(in_mean, worst.input);
    notes.push_back(
        fmt::format("warning: the data deny the input {}: they are most likely where it acts {:.2g} ± {:.2g} times as logged, "
                    "by {:.2g} in log likelihood. A sign or a unit is wrong, or an inertia that it moves, or it acts late",
                    system.inputs()[static_cast<std::size_t>(worst.input)], worst.factor, worst.stddev, worst.gain));
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
