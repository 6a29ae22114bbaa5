#include "gp2/jobs/predict_job.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "inference/cross_validation.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/reading_notes.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;

// Text that is the same is the same system if the robot that it names is too; functions cannot be compared, but the system that they
// made can.
bool is_same(const Model& a, const Model& b) {
  const auto robot_of = [](const Model& model) { return model.robot ? to_json(*model.robot) : ""; };
  return a.system == b.system || (!a.code && !b.code && a.text == b.text && robot_of(a) == robot_of(b));
}

void set_time_step(View& view, const std::optional<double>& time_step) {
  const bool needs_step = view.quantity->needs_time_step();
  if (needs_step != time_step.has_value()) {
    throw InputError(needs_step ? "`view=next-velocity` needs the time step: `dt=SECONDS`"
                                : "`dt` goes with `view=next-velocity`");
  }
  if (!needs_step) return;
  if (!(*time_step > 0) || std::isinf(*time_step)) throw InputError(fmt::format("`dt`: must be positive, got {}", *time_step));
  view.time_step = *time_step;
}

// Adds NAME_std of each of d names, and cov_NAME1_NAME2 where that is asked for: of which rows of a covariance (d² × N) is returned.
std::vector<Index> add_deviation_names(PredictRequest::Covariance covariance, std::vector<std::string>& names) {
  const std::size_t d = names.size();
  for (std::size_t k = 0; k < d; ++k) names.push_back(names[k] + "_std");
  std::vector<Index> upper;
  for (std::size_t j = 0; covariance == PredictRequest::Covariance::full && j < d; ++j) {
    for (std::size_t k = j; k < d; ++k) {
      names.push_back(fmt::format("cov_{}_{}", names[j], names[k]));
      upper.push_back(static_cast<Index>(k * d + j));
    }
  }
  return upper;
}

void predict_marginals(const Posterior& posterior, const View& view, const MatrixXd& states,
                       PredictRequest::Covariance covariance, PredictOutcome& out) {
  const Index d = view.size();
  if (covariance == PredictRequest::Covariance::none) {
    out.values = posterior.mean(view, states, /*n_threads=*/0);
    return;
  }
  const std::vector<Index> upper = add_deviation_names(covariance, out.names);
  out.values.resize(2 * d + std::ssize(upper), states.cols());
  int n_clipped = 0;
  posterior.for_each_marginal(view, states, /*n_threads=*/0, [&](Index first, const Posterior::Marginal& prediction) {
    auto values = out.values.middleCols(first, prediction.mean.cols());
    values.topRows(d) = prediction.mean;
    values.middleRows(d, d) = prediction.stddev();
    values.bottomRows(std::ssize(upper)) = prediction.covariance(upper, Eigen::all);
    n_clipped += prediction.n_clipped;
  });
  if (n_clipped > 0) out.notes.push_back(fmt::format("{} variances were negative by rounding and set to 0", n_clipped));
}

// NAME_sample1 … of every name, then NAME_sample2 …: draws of the view at all states together.
void add_samples(const Posterior& posterior, const View& view, const MatrixXd& states, int n_samples, std::uint64_t seed,
                 PredictOutcome& out) {
  const MatrixXd samples = posterior.sample({{view, states}}, n_samples, seed);
  const Index d = view.size(), first = out.values.rows();
  const std::vector<std::string> names(out.names.begin(), out.names.begin() + d);
  out.values.conservativeResize(first + d * n_samples, Eigen::NoChange);
  for (int s = 0; s < n_samples; ++s) {
    for (const std::string& name : names) out.names.push_back(fmt::format("{}_sample{}", name, s + 1));
    out.values.middleRows(first + d * s, d) = samples.col(s).reshaped(d, states.cols());
  }
}

void add_distance(const Posterior& posterior, const View& view, const MatrixXd& states, PredictOutcome& out) {
  const Eigen::VectorXd distance = posterior.distance_from_data(view, states, /*n_threads=*/0);
  out.names.emplace_back("distance_from_data");
  out.values.conservativeResize(out.values.rows() + 1, Eigen::NoChange);
  out.values.bottomRows(1) = distance.transpose();
  if (auto note = note_of_distance(distance)) out.notes.push_back(std::move(*note));
}

// Some of the same data, where every direction of a latent may be what the largest of them is: a fit makes those small, or smooth, of
// which the data tell nothing, and is sure of them then.
Posterior with_equal_directions(const Posterior& posterior) {
  constexpr int enough = 1500;  // values
  ModelValues values = posterior.component(0).values();
  const std::vector<Latent>& latents = posterior.prior().latents;
  std::map<std::string, std::size_t> largest;
  const auto size_of = [&](std::size_t a) { return values.signal_stddev[a].maxCoeff(); };
  for (std::size_t a = 0; a < latents.size(); ++a) {
    std::size_t& one = largest.emplace(latents[a].name, a).first->second;
    if (size_of(a) > size_of(one)) one = a;
  }
  for (std::size_t a = 0; a < latents.size(); ++a) {
    const std::size_t as = largest[latents[a].name];
    values.signal_stddev[a].setConstant(size_of(as));
    values.kernel[a] = values.kernel[as];
  }
  values.inducing = nullptr;
  return {posterior.prior(), evenly(posterior.observations(), enough / posterior.prior().system->nq()), std::move(values)};
}

PredictOutcome predict_potential(const FitFile& fit, const Posterior& posterior, const CsvTable& table,
                                 const PredictRequest& request) {
  const ViewRequest& view = request.view;
  if (view.quantity != View::Quantity::constrained_acceleration || view.latent || view.time_step || view.system ||
      request.n_samples || request.inverse_dynamics) {
    throw InputError("`potential` replaces a view: leave out `view`, `latent`, `dt`, `system`, `samples` and `inverse_dynamics`");
  }
  if (request.covariance == PredictRequest::Covariance::full) throw InputError("`potential` goes with `cov=none` or `cov=std`");
  const LatentRange range = latents_called(posterior.prior(), *request.potential, "`potential`");
  const PredictedView at = predicted_view(fit, posterior.prior(), view);
  const LogStates log =
      read_log_states(at.prior, at.view, *at.model, table, request.columns, {}, at.actuators, posterior.values().parameters);
  PredictOutcome out{{"potential@" + *request.potential}, {}, log.notes};
  if (log.states.cols() == 0) return out;
  const Posterior::Potential energy = posterior.potential(range.first, log.states, log.states.col(0));
  const bool has_stddev = request.covariance == PredictRequest::Covariance::stddev;
  if (has_stddev) out.names.push_back(out.names.front() + "_std");
  out.values.resize(std::ssize(out.names), log.states.cols());
  out.values.row(0) = energy.mean.transpose();
  if (has_stddev) out.values.row(1) = energy.stddev.transpose();
  return out;
}

PredictOutcome predict_inputs(const FitFile& fit, const Posterior& posterior, const CsvTable& log,
                              const PredictRequest& request) {
  const ViewRequest& view = request.view;
  if (view.quantity != View::Quantity::constrained_acceleration || view.latent || view.time_step || request.n_samples) {
    throw InputError("`inverse_dynamics` replaces a view: leave out `view`, `latent`, `dt` and `samples`");
  }
  const FitSystem at = system_of(fit, posterior.prior(), view.system);
  const Eigen::VectorXd& fitted = posterior.values().parameters;
  WantedMotion wanted = read_wanted_motion(at.prior, *at.model, log, request.columns,
                                           at.other_system ? at.other_system->parameters(fitted) : fitted);
  wanted.view.other_system = at.other_system;
  const InverseDynamics found =
      at_states_of(log.name(), [&] { return inverse_dynamics(posterior, wanted.view, wanted.states, wanted.accelerations); });
  const System& system = *at.model->system;
  PredictOutcome out{system.inputs(), {}, at.notes};
  std::ranges::move(wanted.notes, std::back_inserter(out.notes));
  std::vector<MatrixXd> blocks = {found.inputs};
  if (request.covariance != PredictRequest::Covariance::none) {
    blocks.push_back(found.stddev());
    const std::vector<Index> upper = add_deviation_names(request.covariance, out.names);
    blocks.emplace_back(found.covariance(upper, Eigen::all));
  }
  for (const std::string& name : wanted.view.names(system)) out.names.push_back(name + "_missed");
  blocks.push_back(found.missed);
  out.values.resize(std::ssize(out.names), found.inputs.cols());
  Index row = 0;
  for (const MatrixXd& block : blocks) {
    out.values.middleRows(row, block.rows()) = block;
    row += block.rows();
  }
  // of the size of what is wanted and of what happens without inputs: what is wanted may be 0
  constexpr double produced = 1e-6;
  const MatrixXd idle = posterior.mean(wanted.view, wanted.states, /*n_threads=*/0);
  const auto is_missed =
      found.missed.colwise().norm().array() > produced * (wanted.accelerations.colwise().norm() + idle.colwise().norm()).array();
  wanted.states.bottomRows(system.layout().nu) = found.inputs;
  if (!request.unconditioned) add_distance(posterior, wanted.view, wanted.states, out);
  if (const Index n = is_missed.count(); n > 0) {
    out.notes.push_back(
        fmt::format("warning: {}: no inputs produce the accelerations at {} of {} rows; the nearest are given, with the "
                    "remaining errors in columns {}_missed …",
                    log.name(), n, is_missed.size(), wanted.view.names(system).front()));
  }
  if (auto note = note_of_open_inputs(found, *at.model, log.name())) out.notes.push_back(std::move(*note));
  return out;
}

}  // namespace

std::optional<std::string> note_of_distance(const Eigen::VectorXd& distance) {
  const Index n_far = (distance.array() > Posterior::far_from_data).count();
  if (n_far == 0) return std::nullopt;
  return fmt::format(
      "{} of {} states are far from the data, where standard deviations are usually too small: distance_from_data is above "
      "{:.3g}, up to {:.3g}",
      n_far, distance.size(), Posterior::far_from_data, distance.maxCoeff());
}

std::optional<std::string> note_of_untold(const Posterior& posterior, const PredictedView& at, const MatrixXd& states,
                                          const MatrixXd& mean, const Eigen::VectorXd& distance) {
  constexpr std::size_t enough = 200;  // states
  constexpr double little = 0.5, small = 0.1, exact = 1e-9;
  std::vector<Index> near;
  for (Index i = 0; i < states.cols(); ++i) {
    if (distance(i) <= Posterior::far_from_data) near.push_back(i);
  }
  if (near.empty()) return std::nullopt;
  std::vector<Index> some;
  for (std::size_t k = 0; k < std::min(enough, near.size()); ++k)
    some.push_back(near[k * near.size() / std::min(enough, near.size())]);
  const auto mean_square = [](const MatrixXd& of) -> Eigen::VectorXd { return of.array().square().rowwise().mean(); };
  const Eigen::VectorXd predicted = mean_square(mean(Eigen::all, some));
  // where the deviation is small beside what is predicted, the prior is not asked
  const auto share_left = [&](const Posterior& of) -> Eigen::VectorXd {
    const auto variance = [&](const Posterior& one) {
      return mean_square(one.marginal(at.view, states(Eigen::all, some), /*n_threads=*/0).stddev());
    };
    const Eigen::VectorXd assumed = variance(of.without_data()), of_data = variance(of);
    const auto counts =
        assumed.array() > exact * exact * assumed.maxCoeff() && of_data.array() > small * small * predicted.array();
    return counts.select(of_data.cwiseQuotient(assumed), 0);
  };
  Eigen::VectorXd left = share_left(posterior);
  if (at.view.quantity != View::Quantity::constrained_acceleration && !posterior.prior().is_nonlinear() &&
      !has_sums(posterior.observations()))
    left = left.cwiseMax(share_left(with_equal_directions(posterior)));
  std::vector<std::string> names;
  for (Index k = 0; k < left.size(); ++k) {
    if (left[k] > little) names.push_back(fmt::format("{} ({:.0f} %)", at.names[static_cast<std::size_t>(k)], 100 * left[k]));
  }
  if (names.empty()) return std::nullopt;
  return fmt::format(
      "the data hardly determine {}: this share of the prior variance is left, so standard deviations are no better than the "
      "prior, whose size was learned from what the data do determine",
      fmt::join(names, ", "));
}

namespace {

// Bytes that predictions may take. A small request is never refused, for what is free is not known that well.
double usable_bytes(std::optional<double> free) {
  constexpr double share = 0.9, small = 1e8;
  return free ? std::max(share * *free, small) : HUGE_VAL;
}

}  // namespace

void require_memory_of_samples(const Posterior& posterior, const View& view, Index n_states, int n_samples,
                               std::optional<double> free) {
  constexpr double number = 8, name = 64, gigabyte = 1e9;  // bytes
  const auto n = static_cast<double>(n_states);
  double n_latent = 0;
  for (const Latent& latent : posterior.prior().latents) n_latent += n * latent.size();
  // the covariance of the latents and its factor; then, of each sample, latents twice and the view in four places
  const double all = number * 2 * n_latent * n_latent;
  const double one = number * (2 * n_latent + 4 * n * view.size()) + name * view.size();
  const double bytes = all + n_samples * one, usable = usable_bytes(free);
  if (bytes <= usable) return;
  const double most = std::floor((usable - all) / one);
  throw InputError(fmt::format(
      "`samples`: {} samples of {} rows together take {:.3g} GB of memory, of which {:.1f} GB are free; {}", n_samples, n_states,
      bytes / gigabyte, *free / gigabyte, most >= 1 ? fmt::format("{:.0f} samples would fit", most) : "take fewer rows"));
}

void require_memory_of_joint(const Posterior& posterior, const View& view, Index n_states, std::optional<double> free) {
  constexpr double number = 8, gigabyte = 1e9;  // bytes
  const auto n = static_cast<double>(n_states), size = n * view.size();
  // a covariance of each component and one for the caller; of one component the covariance with the training data, twice, and the
  // kernel between all states
  const double bytes = number * ((posterior.n_components() + 1) * size * size + 2 * posterior.reduced_size() * size + n * n);
  if (bytes <= usable_bytes(free)) return;
  throw InputError(fmt::format(
      "joint: the covariance of all {} rows takes {:.3g} GB of memory, of which {:.1f} GB are free; take fewer rows, or predict "
      "the covariance of each row alone",
      n_states, bytes / gigabyte, *free / gigabyte));
}

std::vector<Option> options(ViewRequest& request) {
  std::vector<std::pair<std::string, View::Quantity>> words;
  for (const View::Quantity& quantity : View::Quantity::all()) words.emplace_back(quantity->word(), quantity);
  return {
      {"view", choice(request.quantity, words), "",
       "quantity and columns; constrained: ddq1 …; unconstrained: abar_q1 …; constraint-force: fc_q1 …; multipliers: lambda1 …; "
       "next-velocity: dq1_next …, with `dt`; force: force_q1 …, the learned applied force"},
      {"dt", &request.time_step, "SECONDS", "time step of next-velocity [s]"},
      {"latent", &request.latent, "NAME",
       "only the contribution of this latent, in columns NAME@LATENT; the latent added by gp2 fit is called discrepancy"},
  };
}

FitSystem system_of(const FitFile& fit, const Prior& prior, const std::shared_ptr<const Model>& system) {
  if (!system || is_same(*system, fit.model)) return {&fit.model, fit.model.actuators, nullptr, prior};
  const auto other_system = make_other_system(fit.model, *system, fit.prior_options);
  FitSystem out{system.get(), shared_actuators(fit.model.actuators, *system), other_system, other_system->prior};
  const std::vector<Parameter>& parameters = other_system->prior.system->parameters();
  for (const Hyperparameter& h : fit.report.hyperparameters) {
    if (!h.is_system_parameter()) continue;
    const int there = other_system->prior.system->parameter_index(h.name);
    if (there < 0 || other_system->shared[static_cast<std::size_t>(there)] >= 0) continue;
    note_kept_parameter(parameters[static_cast<std::size_t>(there)], *system, fit.model, out.notes);
  }
  return out;
}

PredictedView predicted_view(const FitFile& fit, const Prior& prior, const ViewRequest& request) {
  PredictedView out{system_of(fit, prior, request.system), {}, {}};
  out.view = View::all(request.quantity, *out.prior.system);
  out.view.other_system = out.other_system;
  const View::Quantity& asked = request.quantity;
  const bool is_of_constraints = asked == View::Quantity::multipliers || asked == View::Quantity::constraint_force;
  if (is_of_constraints && out.prior.system->nc() == 0) {
    throw InputError(fmt::format("`view={}`: '{}' has no constraints", request.quantity->word(), out.prior.system->name()));
  }
  if (prior.reference && asked == View::Quantity::learned_force) {
    throw InputError("`view=force`: a baseline learns accelerations, not forces: ask for `view=constrained`");
  }
  set_time_step(out.view, request.time_step);
  if (request.latent) out.view.latent = latents_called(prior, *request.latent, "`latent`");
  out.names = out.view.names(*out.prior.system, request.latent.value_or(""));
  return out;
}

std::vector<Option> options(PredictRequest& request) {
  using Covariance = PredictRequest::Covariance;
  return joined(
      {options(request.view),
       {{"cov", choice(request.covariance, {{"none", Covariance::none}, {"std", Covariance::stddev}, {"full", Covariance::full}}),
         "", "uncertainty, without measurement noise; std: columns NAME_std; full: also cov_NAME1_NAME2, the upper triangle"},
        {"samples", &request.n_samples, "S",
         "number of joint samples over all rows: NAME_sample1 … NAME_sampleS; time grows with the cube of the number of rows", "",
         "n_samples"},
        {"seed", &request.seed, "K", "random seed of the samples", "", "", "", "samples"},
        {"unconditioned", &request.unconditioned, "", "predict from the prior with the fitted hyperparameters, without the data"},
        {"inverse_dynamics", &request.inverse_dynamics, "",
         "instead of a view: the inputs u1 … that produce the accelerations ddq1 … of the CSV, and the remaining errors "
         "ddq1_missed …"},
        {"potential", &request.potential, "NAME",
         "instead of a view: the energy of this potential latent, relative to the first row: potential@NAME [J]"},
        columns_option(request.columns)}});
}

std::optional<std::string> note_of_open_inputs(const InverseDynamics& found, const Model& model, const std::string& states) {
  const System& system = *model.system;
  const auto& open = found.open;
  std::vector<std::string> names;
  for (Index k = 0; k < open.rows(); ++k) {
    if (open.row(k).any()) names.push_back(system.inputs()[static_cast<std::size_t>(k)]);
  }
  if (names.empty()) return std::nullopt;
  return fmt::format(
      "{}: the desired accelerations do not determine {} at {} of {} rows; the smallest change of inputs is given, and its "
      "standard deviations do not cover other inputs with the same effect",
      states, fmt::join(names, ", "), open.colwise().any().count(), open.cols());
}

PredictOutcome predict(const FitFile& fit, CsvTable states, const PredictRequest& request) {
  if (request.n_samples && *request.n_samples < 1) {
    throw InputError(fmt::format("`samples`: must be at least 1, got {}", *request.n_samples));
  }
  const Posterior posterior = request.unconditioned ? fit.posterior().without_data() : fit.posterior();
  if (request.potential) return predict_potential(fit, posterior, states, request);
  if (request.inverse_dynamics) return predict_inputs(fit, posterior, states, request);
  const PredictedView at = predicted_view(fit, posterior.prior(), request.view);
  LogStates log = read_log_states(at.prior, at.view, *at.model, states, request.columns, {}, at.actuators,
                                  parameters_of(at.view, posterior.values().parameters));
  if (!std::ranges::all_of(at.actuators, &Actuator::is_direct)) {
    note_late_inputs(at.prior, states, checked_columns(*at.model, {&states}, request.columns), without_estimates(at.actuators),
                     log.notes);
  }
  const std::string name = states.name();
  states = CsvTable();  // a long log in memory once
  PredictOutcome out{at.names, {}, std::move(log.notes)};
  out.notes.insert(out.notes.begin(), at.notes.begin(), at.notes.end());
  if (request.n_samples) {
    require_memory_of_samples(posterior, at.view, log.states.cols(), *request.n_samples, free_memory());
  }
  at_states_of(name, [&] { predict_marginals(posterior, at.view, log.states, request.covariance, out); });
  if (request.n_samples) add_samples(posterior, at.view, log.states, *request.n_samples, request.seed, out);
  if (request.unconditioned) return out;
  add_distance(posterior, at.view, log.states, out);
  if (request.covariance == PredictRequest::Covariance::none) return out;
  const Eigen::VectorXd distance = out.values.bottomRows(1).transpose();
  if (auto note = note_of_untold(posterior, at, log.states, out.values.topRows(at.view.size()), distance)) {
    out.notes.push_back(std::move(*note));
  }
  return out;
}

std::vector<Option> options(EvaluateRequest& request) {
  return {{"outputs", &request.outputs, "ddq3,ddq6", "accelerations to compare", "those observed in training that the log has"},
          columns_option(request.columns),
          threads_option(request.threads)};
}

namespace {

// Logs of one fit may have been measured by other sensors than this one.
void note_differing_noise(const Posterior& posterior, const std::vector<int>& rows, const std::string& log,
                          std::vector<std::string>& notes) {
  constexpr double alike = 1.5;
  const std::vector<std::string> names = posterior.prior().system->acceleration_names();
  for (const int row : rows) {
    double least = std::numeric_limits<double>::infinity(), most = 0;
    for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
      const Observations& group = posterior.observations()[g];
      const auto at = std::ranges::find(group.view().rows, row);
      if (!group.view().is_of_ddq() || group.n_data() == 0 || at == group.view().rows.end()) continue;
      const double noise = group.usual_noise(posterior.noise_stddev(g))[at - group.view().rows.begin()];
      least = std::min(least, noise), most = std::max(most, noise);
    }
    if (!(most > alike * least)) continue;
    const std::string& name = names[static_cast<std::size_t>(row)];
    notes.push_back(fmt::format(
        "warning: {}: the logs of the fit differ in noise, {} from {:.3g} to {:.3g}: their root mean square is taken for "
        "that of this log; a column {}_std states its own",
        log, name, least, most, name));
  }
}

}  // namespace

EvaluateOutcome evaluate(const FitFile& fit, const Posterior& posterior, CsvTable log, const EvaluateRequest& request,
                         const std::atomic<bool>* stop) {
  require_threads(request.threads);
  ViewRequest constrained;
  constrained.system = request.system;
  const PredictedView at = predicted_view(fit, posterior.prior(), constrained);
  EvaluateOutcome out;
  out.notes = at.notes;
  const std::vector<std::string> outputs =
      request.outputs.empty() ? outputs_to_compare(posterior, *at.model, log, request.columns, out.notes) : request.outputs;
  const std::vector<int> rows = acceleration_rows(*fit.model.system, outputs, "`outputs`");
  const LogStates states = read_log_states(at.prior, at.view, *at.model, log, request.columns, outputs, at.actuators,
                                           parameters_of(at.view, posterior.values().parameters));
  out.notes.insert(out.notes.end(), states.notes.begin(), states.notes.end());
  const std::string name = log.name();
  for (const std::string& text : note_late_inputs(at.prior, log, checked_columns(*at.model, {&log}, request.columns),
                                                  without_estimates(at.actuators), out.notes))
    out.notes.push_back(fmt::format("warning: {}: {}", name, text));
  add_learned_note(fit, log, out.notes);
  log = CsvTable();
  EvaluationOptions options{at.view.other_system, {}, request.threads, stop};
  options.noise_stddev = measurement_noise(posterior, rows, states.states.cols(), states.stated_stddev);
  if (states.stated_stddev.size() == 0) note_differing_noise(posterior, rows, name, out.notes);
  out.evaluation =
      at_states_of(name, [&] { return evaluate_predictions(posterior, states.states, rows, states.accelerations, options); });
  for (std::string& text : constraint_warnings(posterior, at.view.other_system, name, states.states, rows, states.accelerations,
                                               options.noise_stddev)) {
    out.notes.push_back(std::move(text));
  }
  if (const Evaluation& e = out.evaluation; is_coverage_low(e.coverage95, e.n)) {
    out.notes.push_back(fmt::format(
        "warning: {}: {:.0f} % of the values lie within their 95 % intervals: they are noisier than the data of the fit, "
        "the log goes where these were not, or the model lacks something; gp2 report shows where",
        name, 100 * e.coverage95));
  }
  return out;
}

}  // namespace gp2
