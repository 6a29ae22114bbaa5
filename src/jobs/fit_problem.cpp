#include "gp2/jobs/fit_problem.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <optional>
#include <tuple>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/training/laplace.hpp"
#include "gp2/training/robust.hpp"
#include "jobs/acting_states.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/read_observations.hpp"
#include "prior/code_function.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// what a baseline cannot have
void require_baseline_options(const FitProblemOptions& options, const std::vector<Log>& logs,
                              const std::vector<SideInformation>& also) {
  const auto refuse = [&](bool asked, const char* rule, const char* option) {
    if (asked) throw InputError(fmt::format("`baseline={}` {}: leave out {}", Baseline::word(*options.baseline), rule, option));
  };
  refuse(options.mean != Prior::Mean::zero, "has the mean of the training data as prior mean", "`mean`");
  refuse(options.base.has_value(), "has its prior on ddq", "`prior`");
  refuse(options.estimate && !options.estimate->empty(), "knows no parameters of the system", "`estimate`");
  refuse(!options.observe.empty(), "learns every acceleration", "`observe`");
  refuse(options.estimate_noise, "has fixed noise", "`noise_std=estimate`");
  refuse(options.project, "knows no constraints", "`project`");
  refuse(options.robust, "is fitted as published", "`robust`");
  refuse(!also.empty() || options.time_step || options.also_noise_stddev, "knows ddq only", "`also`");
  const bool elsewhere = std::any_of(logs.begin(), logs.end(), [](const Log& log) { return log.model != nullptr; });
  refuse(elsewhere, "knows no system", "@OTHER.toml");
}

std::vector<Parameter*> parameters_of(std::vector<Actuator>& actuators) {
  std::vector<Parameter*> all;
  for (Actuator& actuator : actuators) all.insert(all.end(), {&actuator.delay, &actuator.lag});
  return all;
}

// Those of a model, marked where this fit estimates them.
std::vector<Actuator> fitted_actuators(const Model& model, const FitProblemOptions& options) {
  std::vector<Actuator> actuators = model.actuators;
  for (Parameter* one : parameters_of(actuators)) {
    if (options.estimate) one->estimate = std::ranges::count(*options.estimate, one->name) > 0;
    if (options.baseline) one->estimate = false;
  }
  return actuators;
}

// the same under every protocol
FitProblem make_baseline_problem(const Model& model, const std::vector<Log>& logs, FitProblemOptions options) {
  options.protocol.name = Protocol::Name::paper;  // fixed noise
  FitProblem problem;
  problem.prior_options.raw_angles = true;
  problem.prior_options.baseline = unstandardised(model, *options.baseline);
  problem.prior = make_prior(model, problem.prior_options);
  for (const Log& log : logs) {
    LogRows rows;
    const LoggedSystem logged = logged_system(model, fitted_actuators(model, options), problem.prior, problem.prior_options, log);
    problem.observations.push_back(read_log(logged, log, options, rows, problem.notes));
    problem.lines.push_back(std::move(rows.lines));
    problem.systems.push_back(nullptr);
  }
  for (const Actuator& actuator : model.actuators) {
    for (const Parameter& one : {actuator.delay, actuator.lag}) {
      const bool is_asked_for = options.estimate ? std::ranges::count(*options.estimate, one.name) > 0 : one.estimate;
      if (is_asked_for)
        problem.notes.push_back(
            fmt::format("{} is not estimated by a baseline: it is that of the model, {:.6g} s", one.name, one.value));
    }
  }
  problem.prior_options.baseline = standardised_by(problem.observations, problem.prior, *options.baseline);
  problem.prior = make_prior(model, problem.prior_options);
  problem.hyperparameters = starting_hyperparameters(model, problem, options);
  return problem;
}

// which parameters the systems have in common is decided by other files: worth a word
void note_parameters(const Model& fitted, const LoggedSystem& logged, const std::vector<std::string>& estimated,
                     std::vector<std::string>& notes) {
  if (!logged.other_system) return;
  const std::vector<Parameter>& parameters = logged.system().parameters();
  for (std::size_t k = 0; k < parameters.size(); ++k) {
    const std::string& name = parameters[k].name;
    if (parameters[k].estimate && logged.other_system->shared[k] < 0) {
      notes.push_back(fmt::format("{}: parameter '{}' is marked estimate = true, but '{}' has none of that name: it stays {}",
                                  logged.model.name, name, fitted.name, parameters[k].value));
    }
    const bool tuned = std::find(estimated.begin(), estimated.end(), name) != estimated.end();
    if (tuned && logged.other_system->shared[k] < 0) note_kept_parameter(parameters[k], logged.model, fitted, notes);
  }
}

// @throws InputError for a parameter that follows from others, or is named twice.
void require_own_parameters(const Model& model, const std::vector<std::string>& names) {
  for (const std::string& name : names) {
    if (std::ranges::count(names, name) > 1) throw InputError(fmt::format("`estimate`: '{}' stands twice", name));
  }
  for (const Model::DerivedParameter& derived : model.derived_parameters) {
    if (std::find(names.begin(), names.end(), derived.name) == names.end()) continue;
    throw InputError(
        fmt::format("`estimate`: the parameter '{}' of '{}' follows from others: {} = {}; estimate those, and it follows them",
                    derived.name, model.name, derived.name, derived.text));
  }
}

// The parameters to estimate: those asked for, else those that the model says.
std::vector<std::string> estimated_parameters(const Model& model, const FitProblemOptions& options) {
  if (options.estimate) {
    require_own_parameters(model, *options.estimate);
    std::vector<std::string> names = *options.estimate;
    std::vector<Actuator> actuators = model.actuators;
    for (const Parameter* one : parameters_of(actuators)) std::erase(names, one->name);
    return names;
  }
  std::vector<std::string> names;
  for (const Parameter& parameter : model.system->parameters()) {
    if (parameter.estimate) names.push_back(parameter.name);
  }
  return names;
}

// so that there is no ā for a discrepancy to act on
bool has_singular_mass(const FitProblem& problem) {
  const VectorXd parameters = problem.prior.system->parameter_values();
  return std::any_of(problem.observations.begin(), problem.observations.end(), [&](const Observations& group) {
    const Prior& there = prior_of(problem.prior, group.view());
    std::atomic<bool> is_singular = false;
    static_cast<void>(for_each_mechanics(*there.system, group.states(), parameters_of(group.view(), parameters), 1,
                                         [&](Eigen::Index, const MechanicsBatch& block) {
                                           if (block.first_singular() >= 0) is_singular = true;
                                         }));
    return is_singular.load();
  });
}

// what scales, starts and bounds are taken from
std::vector<Observations> trusted_observations(const FitProblem& problem) {
  return problem.robust ? without_gross_errors(problem.observations) : problem.observations;
}

bool is_of_accelerations(const Observations& group) { return group.view().quantity == View::Quantity::constrained_acceleration; }

bool has_discrepancy(const Model& model, const FitProblem& problem, const FitProblemOptions& options) {
  const bool standard = options.protocol.name == Protocol::Name::standard && options.protocol.hyperprior;
  const bool acts_everywhere = std::ranges::any_of(model.latents, [&](const LatentSpec& latent) {
    return options.base || (latent.directions.empty() && !latent.direction_code && !latent.is_potential);
  });
  return options.discrepancy && standard && acts_everywhere &&
         std::any_of(problem.observations.begin(), problem.observations.end(), is_of_accelerations) &&
         !has_singular_mass(problem);
}

// σ of values that are all as good as these are in the mean, 1/σ² the mean of theirs: what hardly says anything changes nothing.
double mean_noise(const std::vector<double>& stddevs) {
  const double least = *std::min_element(stddevs.begin(), stddevs.end());
  double sum = 0;
  for (const double one : stddevs) sum += std::pow(least / one, 2);
  return least / std::sqrt(sum / static_cast<double>(stddevs.size()));
}

// As large as the noise that the fit starts with; of an acceleration that is not measured, in proportion to the spreads.
Discrepancy discrepancy_of(const FitProblem& problem) {
  const Scales scales = default_scales(problem.prior, trusted_observations(problem));
  std::vector<std::vector<double>> stddevs(static_cast<std::size_t>(scales.acceleration_stddev.size()));
  for (const Observations& group : problem.observations) {
    if (!is_of_accelerations(group)) continue;
    for (Index k = 0; k < group.view().size(); ++k) {
      const auto row = static_cast<std::size_t>(k);
      for (const double scale : group.measured_scales(k)) {
        stddevs[static_cast<std::size_t>(group.view().rows[row])].push_back(group.noise().stddev()[k] * scale);
      }
    }
  }
  VectorXd noise = VectorXd::Zero(scales.acceleration_stddev.size());
  for (Index j = 0; j < noise.size(); ++j) {
    const std::vector<double>& of = stddevs[static_cast<std::size_t>(j)];
    if (!of.empty()) noise[j] = mean_noise(of);
  }
  const auto measured = noise.array() > 0;
  const double share = noise.cwiseQuotient(scales.acceleration_stddev).sum() / static_cast<double>(measured.count());
  return {.lengthscale = Protocol::Standard::discrepancy_lengthscale * scales.feature_stddev.back(),
          .stddev = measured.select(noise, share * scales.acceleration_stddev),
          .centre = scales.feature_centre.back(),
          .half_range = scales.feature_range.back() / 2};
}

// Mean square by which values differ from that at the nearest other state of their log: tells which of two logs has less noise, before
// any is estimated.
double roughness(const Observations& group, Index k) {
  constexpr Index most = 300;
  std::vector<Index> measured;
  for (Index i = 0; i < group.n_data(); ++i) {
    if (!std::isnan(group.values()(k, i))) measured.push_back(i);
  }
  const auto stride = std::max<Index>(1, std::ssize(measured) / most);
  std::vector<Index> some;
  for (Index at = 0; at < std::ssize(measured); at += stride) some.push_back(measured[static_cast<std::size_t>(at)]);
  MatrixXd states = group.states()(Eigen::all, some);
  for (Index r = 0; r < states.rows(); ++r) {
    auto row = states.row(r);
    const double spread = row.hasNaN() ? 0 : (row.array() - row.mean()).matrix().norm();
    if (spread > 0) {
      row /= spread;
    } else {
      row.setZero();  // what does not move, or is not known, tells no states apart
    }
  }
  double sum = 0;
  for (Index i = 0; i < states.cols(); ++i) {
    VectorXd distance = (states.colwise() - states.col(i)).colwise().squaredNorm().transpose();
    distance[i] = std::numeric_limits<double>::infinity();
    Index nearest = 0;
    distance.minCoeff(&nearest);
    const auto value = [&](Index at) { return group.values()(k, some[static_cast<std::size_t>(at)]); };
    sum += std::pow(value(i) - value(nearest), 2);
  }
  return sum / static_cast<double>(std::max<Index>(1, states.cols()));
}

// Where the noise is estimated, the discrepancy is in proportion to it: one of a guess would take its place. An acceleration that no
// estimated noise is of goes with the first. Of logs whose noise starts alike, that of the smoothest leads, whatever their order.
void tie_discrepancy(const FitProblem& problem, std::vector<Hyperparameter>& hyperparameters) {
  const auto latent = static_cast<int>(problem.prior.latents.size()) - 1;
  std::vector<Hyperparameter*> leaders(static_cast<std::size_t>(problem.prior.system->nq()), nullptr);
  std::vector<bool> is_observed(leaders.size(), false);
  std::vector<double> largest(leaders.size(), 0), smoothest(leaders.size(), 0);
  Hyperparameter* first = nullptr;
  for (std::size_t g = 0; g < problem.observations.size(); ++g) {
    const Observations& group = problem.observations[g];
    if (!is_of_accelerations(group)) continue;
    const VectorXd usual = group.usual_noise(group.noise().stddev());
    for (Index k = 0; k < usual.size(); ++k) {
      const auto j = static_cast<std::size_t>(group.view().rows[static_cast<std::size_t>(k)]);
      is_observed[j] = true;
      if (usual[k] < largest[j]) continue;
      const double rough = problem.observations.size() > 1 ? roughness(group, k) : 0;
      if (usual[k] == largest[j] && rough >= smoothest[j]) continue;
      largest[j] = usual[k];
      smoothest[j] = rough;
      const auto h = std::find_if(hyperparameters.begin(), hyperparameters.end(), [&](const Hyperparameter& other) {
        return other.kind == Hyperparameter::Kind::noise_stddev && other.owner == static_cast<int>(g) && other.index == k;
      });
      leaders[j] = h == hyperparameters.end() ? nullptr : &*h;
      if (first == nullptr) first = leaders[j];
    }
  }
  for (std::size_t j = 0; j < leaders.size(); ++j) {
    Hyperparameter* leader = is_observed[j] ? leaders[j] : first;
    if (leader == nullptr) continue;
    const double start = problem.observations[static_cast<std::size_t>(leader->owner)].noise().stddev()[leader->index];
    leader->followers.push_back({latent, static_cast<int>(j), 1 / start});
  }
}

// Whether columns of a group may follow from each other: more are observed than the constraints leave free.
bool may_depend(const Posterior& posterior, const Observations& group) {
  const View& view = group.view();
  const System& system = prior_of(posterior.prior(), view).reference_system();
  return view.size() > system.nq() - system.nc();
}

// What [noise] says of the range of an estimated σ, where the log states no deviations of which it is a factor.
void bound_noise(const Model& model, const FitProblem& problem, Hyperparameter& h) {
  const auto group = static_cast<std::size_t>(h.owner);
  const Observations& observations = problem.observations[group];
  const bool is_of_accelerations = observations.view().quantity->is_acceleration() && !observations.view().latent;
  if (!is_of_accelerations || observations.states_noise(h.index)) return;
  const Model::Noise& noise = (problem.systems[group] ? *problem.systems[group] : model).noise;
  if (noise.bounds.empty() && noise.floor.empty()) return;
  const auto row = static_cast<std::size_t>(observations.view().rows[static_cast<std::size_t>(h.index)]);
  if (!noise.bounds.empty()) std::tie(h.lower, h.upper) = noise.bounds[row];
  if (!noise.floor.empty()) h.lower = std::max(h.lower, noise.floor[row]);
  h.upper = std::max(h.lower, h.upper);
  h.value = std::clamp(observations.noise().stddev()[h.index], h.lower, h.upper);
  if (h.hyperprior.form != HyperPrior::Form::none) h.hyperprior.median = h.value;
}

void require_columns(const Model& model, const std::vector<Log>& logs, const std::vector<SideInformation>& also,
                     const FitProblemOptions& options) {
  std::vector<const CsvTable*> tables;
  for (const Log& log : logs) tables.push_back(&log.table);
  for (const SideInformation& side_information : also) tables.push_back(&side_information.log.table);
  check_columns(*model.system, tables, options.columns);
}

// a problem without observations, and its prior
FitProblem start_problem(const Model& model, const FitProblemOptions& options) {
  const bool paper = options.protocol.name == Protocol::Name::paper;
  if (paper && options.estimate_noise) throw InputError("`protocol=paper` has fixed noise: leave out `noise_std=estimate`");
  if (paper && options.base == Latent::Base::force) {
    throw InputError("`protocol=paper` has its prior on the acceleration: leave out `prior=force`");
  }
  if (paper && model.latents.size() > 1) {
    throw InputError(fmt::format("`protocol=paper` has one latent, on the acceleration, but '{}' has {}", model.system->name(),
                                 model.latents.size()));
  }
  FitProblem problem;
  problem.robust = options.robust;
  problem.prior_options.mean = options.mean;
  problem.prior_options.base = paper ? std::optional(Latent::Base::acceleration) : options.base;
  problem.prior_options.raw_angles = paper;
  if (paper) {
    problem.prior_options.kernel = "se";
    problem.prior_options.per_direction = false;
  }
  problem.prior = make_prior(model, problem.prior_options);
  const bool has_directions = std::ranges::any_of(model.latents, [](const LatentSpec& latent) {
    return latent.base != Latent::Base::acceleration || !latent.directions.empty() || latent.direction_code ||
           latent.is_potential;
  });
  if (paper && has_directions) {
    problem.notes.push_back(
        "warning: `protocol=paper` has its prior on the acceleration: the directions of the model's latent are ignored");
  }
  return problem;
}

// the system of a log that is read next
LoggedSystem add_system(const Model& model, const Log& log, const FitProblemOptions& options,
                        const std::vector<std::string>& estimated, FitProblem& problem) {
  LoggedSystem logged = logged_system(model, fitted_actuators(model, options), problem.prior, problem.prior_options, log);
  note_parameters(model, logged, estimated, problem.notes);
  problem.systems.push_back(logged.other);
  return logged;
}

void add_rows(LogRows rows, FitProblem& problem) {
  problem.lines.push_back(std::move(rows.lines));
  problem.commanded.push_back(std::move(rows.commanded));
  problem.has_wrong_rate = problem.has_wrong_rate || rows.has_wrong_rate;
}

// Delays and lags of inputs that some observations read.
void add_late(const Model& model, const FitProblemOptions& options, FitProblem& problem) {
  std::vector<Actuator> actuators = fitted_actuators(model, options);
  for (std::size_t k = 0; k < actuators.size(); ++k) {
    const bool is_read = std::ranges::any_of(problem.commanded, [&](const std::optional<CommandedRows>& rows) {
      return rows && std::ranges::count(rows->record->inputs(), static_cast<int>(k)) > 0;
    });
    for (const Parameter& one : {actuators[k].delay, actuators[k].lag}) {
      if (one.estimate && is_read) problem.late.push_back(one);
      if (one.estimate && !is_read) {
        problem.notes.push_back(
            fmt::format("warning: {} is not estimated: nothing that this fit reads depends on what is commanded; "
                        "see `mean=force`, or make the input a feature",
                        one.name));
      }
    }
  }
}

// what else is known; its noise is judged by the size of the measured signals
void add_side_information(const Model& model, const std::vector<SideInformation>& also, const FitProblemOptions& options,
                          const std::vector<std::string>& estimated, FitProblem& problem) {
  const bool needs_step = std::any_of(also.begin(), also.end(), [](const SideInformation& side_information) {
    return side_information.quantity->needs_time_step();
  });
  if (options.time_step && !needs_step) throw InputError("`dt` goes with `also=next-velocity:FILE.csv`");
  if (options.also_noise_stddev && also.empty()) throw InputError("`also_noise_std` goes with `also=VIEW:FILE.csv`");
  if (also.empty()) return;
  // without a log the size of the signals is that of what is known
  std::vector<VectorXd> signal_stddev;
  if (!problem.observations.empty()) {
    signal_stddev = default_scales(problem.prior, trusted_observations(problem)).signal_stddev;
  }
  for (const SideInformation& side_information : also) {
    const LoggedSystem logged = add_system(model, side_information.log, options, estimated, problem);
    LogRows rows;
    problem.observations.push_back(
        read_side_information(logged, problem.prior, side_information, options, signal_stddev, rows, problem.notes));
    add_rows(std::move(rows), problem);
  }
}

// A likelihood of functions that mix states would be that of other states.
void require_separate_states(const FitProblem& problem) {
  for (const Observations& group : problem.observations) {
    const Prior& there = prior_of(problem.prior, group.view());
    const VectorXd parameters = parameters_of(group.view(), problem.prior.system->parameter_values());
    auto mixed = mixed_states(*there.system, group.states(), parameters);
    if (!mixed) mixed = mixed_states_text(there, group.states(), parameters);
    if (mixed) throw InputError(fmt::format("'{}': {}", there.system->name(), *mixed));
  }
}

// Latents that act at none of the states of all logs.
void note_idle_latents(FitProblem& problem) {
  ActingStates acting(problem.prior);
  for (const Observations& group : problem.observations) {
    const Prior& there = prior_of(problem.prior, group.view());
    acting.count(there, group.states(), parameters_of(group.view(), problem.prior.system->parameter_values()));
  }
  const bool of_accelerations =
      std::ranges::all_of(problem.observations, [](const Observations& group) { return group.view().is_of_ddq(); });
  for (const std::string& text : acting.idle_texts(of_accelerations)) problem.notes.push_back("warning: " + text);
}

// what the prior is made of anew, on every other system too
void remake_prior(const Model& model, FitProblem& problem) {
  problem.prior = make_prior(model, problem.prior_options);
  for (std::size_t g = 0; g < problem.observations.size(); ++g) {
    const std::shared_ptr<const Model>& other = problem.systems[g];
    if (!other) continue;
    View view = problem.observations[g].view();
    view.other_system = make_other_system(model, *other, problem.prior_options);
    problem.observations[g] = problem.observations[g].with_view(std::move(view));
  }
}

// First in units of its features, to see how they spread.
void add_discrepancy(const Model& model, FitProblem& problem) {
  problem.prior_options.discrepancy = Discrepancy{{}, VectorXd::Ones(model.system->nq())};
  remake_prior(model, problem);
  problem.prior_options.discrepancy = discrepancy_of(problem);
  remake_prior(model, problem);
}

// Where data are far from a coordinate's zero, as an angle about a turn, a force that is constant would seem to be linear in it. The
// zero of a velocity or an input is no matter of choice.
void centre_features(const Model& model, FitProblem& problem) {
  if (std::ranges::none_of(model.latents, [](const LatentSpec& latent) { return latent.kernel.empty(); })) return;
  const Scales scales = default_scales(problem.prior, trusted_observations(problem));
  for (std::size_t a = 0; a < problem.prior.latents.size(); ++a) {
    const Latent& latent = problem.prior.latents[a];
    const auto spec = std::ranges::find(model.latents, latent.name, &LatentSpec::name);
    if (!spec->kernel.empty()) continue;
    for (std::size_t d = 0; d < latent.feature_names.size(); ++d) {
      const auto row = static_cast<Index>(d);
      // one that does not vary has its magnitude for both: centred, it would be rounding and be scaled by that
      const bool varies = scales.feature_stddev[a][row] < scales.feature_range[a][row];
      if (!latent.is_of_place[d] || !varies) continue;
      problem.prior_options.feature_centres.emplace(latent.feature_names[d], scales.feature_mean[a][row]);
    }
  }
  if (!problem.prior_options.feature_centres.empty()) remake_prior(model, problem);
}

// Sums over windows of time, in place of the rows that are only their states.
Observations with_windows(const Observations& rows, const Windows& windows, const std::vector<int>& lines) {
  std::vector<WeightedSum> sums;
  for (const Windows::Series& series : windows.series) {
    const auto row = std::find(rows.view().rows.begin(), rows.view().rows.end(), series.coordinate);
    if (row == rows.view().rows.end()) continue;
    std::vector<double> times;
    int first = 0;
    for (std::size_t i = 0; i < lines.size(); ++i) {
      const Windows::State& state = windows.states.at(lines[i]);
      if (state.episode != series.episode) continue;
      if (times.empty()) first = static_cast<int>(i);
      times.push_back(state.time);
    }
    if (times.size() < 4) continue;
    for (WeightedSum& sum : windowed_accelerations(series.positions, series.model, series.grid, series.windows,
                                                   Eigen::Map<const VectorXd>(times.data(), std::ssize(times)),
                                                   static_cast<int>(row - rows.view().rows.begin()), first)) {
      sums.push_back(std::move(sum));
    }
  }
  return sums.empty() ? rows : rows.with_sums(std::move(sums));
}

// How far what a positive latent adds stands out from the noise of each state, with its factors and with factors of 1.
struct PositivePart {
  std::vector<double> sizes, sizes_of_one;
};

PositivePart positive_part(const Posterior& posterior, std::size_t a) {
  PositivePart part;
  const Prior& fitted = posterior.prior();
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    const Observations& group = posterior.observations()[g];
    View view = group.view();
    if (group.has_sums() || !view.has_latent(a)) continue;
    view.latent = static_cast<int>(a);
    const Prior& prior = prior_of(fitted, view);
    const VectorXd parameters = parameters_of(view, posterior.values().parameters);
    const MechanicsBatch mechanics = require_mechanics(prior, view, group.states(), parameters);
    std::optional<MatrixXd> load;
    if (prior.latents[a].reads_multipliers()) {
      View multipliers = View::multipliers(*prior.system);
      multipliers.other_system = view.other_system;
      load = posterior.mean(multipliers, group.states());
    }
    const PriorValues values = require_prior_values(prior, group.states(), parameters, mechanics, load ? &*load : nullptr);
    const ViewValues viewed = evaluate_view(view, mechanics, group.states());
    const MatrixXd added = posterior.mean(view, group.states());
    const MatrixXd noise = group.noise_of_values(posterior.noise_stddev(g));  // infinite where nothing is measured
    for (int i = 0; i < group.n_data(); ++i) {
      part.sizes.push_back(added.col(i).cwiseQuotient(noise.col(i)).norm());
      const MatrixXd of_one = viewed.G(i) * values.E(a, i);
      part.sizes_of_one.push_back((noise.col(i).cwiseInverse().asDiagonal() * of_one).norm());
    }
  }
  return part;
}

// Positive latents that the data push to 0 wherever they act. One that is small in part of its range, or along a direction that is
// written large, stands out from the noise of all rows.
void add_vanishing_notes(const Posterior& posterior, std::vector<std::string>& notes) {
  constexpr double least = 1e-3;       // of the largest direction: elsewhere it does not act
  constexpr double small = 0.05;       // factor
  constexpr double nearly_all = 0.95;  // of the rows
  constexpr double lost = 0.5;         // standard deviations of the noise, over all rows
  const std::vector<Latent>& latents = posterior.prior().latents;
  for (std::size_t a = 0; a < latents.size(); ++a) {
    if (!latents[a].is_positive) continue;
    PositivePart part;
    try {
      part = positive_part(posterior, a);
    } catch (const Error&) {
      continue;  // where a state has no motion, which is told elsewhere, there is nothing to compare
    }
    if (part.sizes.empty()) continue;
    const double acts = least * std::ranges::max(part.sizes_of_one);
    double n_acting = 0, n_small = 0, squares = 0;
    for (std::size_t i = 0; i < part.sizes.size(); ++i) {
      squares += part.sizes[i] * part.sizes[i];
      if (!(part.sizes_of_one[i] > acts)) continue;
      n_acting += 1;
      n_small += part.sizes[i] < small * part.sizes_of_one[i] ? 1 : 0;
    }
    if (n_acting == 0 || n_small < nearly_all * n_acting || std::sqrt(squares) > lost) continue;
    notes.push_back(
        fmt::format("warning: the data push the positive latent '{}'{} to 0: is the sign of its direction wrong, or does nothing "
                    "act along it?",
                    latents[a].name, latents[a].direction.empty() ? "" : fmt::format(", {},", latents[a].direction)));
  }
}

}  // namespace

void read_start(const NamedNumbers& start, int max_iterations, const std::vector<Actuator>& actuators, FitProblem& problem) {
  const std::string source = start.file.empty() ? "`start`" : start.file;
  std::map<std::string, double> known;  // of the model, which this fit may hold
  for (const Actuator& actuator : actuators) {
    for (const Parameter& one : {actuator.delay, actuator.lag}) known[one.name] = one.value;
  }
  // of an estimated delay or lag; those that are held have the model's
  const auto read_late = [&](const std::string& name, double value) {
    const auto late = std::ranges::find(problem.late, name, &Parameter::name);
    if (late == problem.late.end()) return false;
    const auto [lower, upper] = Actuator::bounds(*late);
    if (!(value >= 0) || (max_iterations > 0 && !(value >= lower && value <= upper))) {
      throw InputError(fmt::format("{}: {} = {} is outside its bounds [{}, {}]", source, name, value, lower, upper));
    }
    late->value = value;
    return true;
  };
  const auto read = [&] {
    std::map<std::string, double> others;
    std::vector<std::string> names;
    for (const auto& [name, value] : known) names.push_back(name);
    if (start.file.empty()) {
      std::map<std::string, double> values = start.values;
      for (const std::string& name : names) {
        if (auto of_actuator = values.extract(name)) others.insert(std::move(of_actuator));
      }
      set_start_values(values, source, problem.hyperparameters, names);
    } else {
      others = read_start_values(start.file, problem.hyperparameters, names);
    }
    const System& system = *problem.prior.system;
    for (int k = 0; k < std::ssize(system.parameters()); ++k)
      known[system.parameters()[static_cast<std::size_t>(k)].name] = system.parameter_values()[k];
    for (const auto& [name, value] : others) {
      if (read_late(name, value) || !known.contains(name) || known.at(name) == value) continue;
      problem.notes.push_back(
          fmt::format("warning: {}: {} = {:.6g} is not taken: this fit does not estimate it and has {:.6g} of "
                      "the model",
                      source, name, value, known.at(name)));
    }
  };
  if (max_iterations > 0) {
    read();
    return;
  }
  const std::vector<Hyperparameter> bounded = problem.hyperparameters;
  for (Hyperparameter& h : problem.hyperparameters) {
    h.lower = h.positive ? std::numeric_limits<double>::min() : std::numeric_limits<double>::lowest();
    h.upper = std::numeric_limits<double>::max();
  }
  read();
  for (std::size_t k = 0; k < bounded.size(); ++k) {
    Hyperparameter& h = problem.hyperparameters[k];
    h.lower = std::min(bounded[k].lower, h.value);
    h.upper = std::max(bounded[k].upper, h.value);
    if (h.lower == bounded[k].lower && h.upper == bounded[k].upper) continue;
    problem.notes.push_back(fmt::format("{}: {} = {} is outside its bounds [{:.6g}, {:.6g}]; used, because nothing is optimised",
                                        source, h.name, h.value, bounded[k].lower, bounded[k].upper));
  }
}

std::vector<std::string> notes_of(const FitReport& report, const Posterior& posterior) {
  std::vector<std::string> dependent, without_noise, notes;
  const bool never_ran = report.iterations == 0 && !report.converged;
  for (const Hyperparameter& h : report.hyperparameters) {
    const bool at_lower = h.at_bound() && h.value < 2 * h.lower;
    if (h.kind != Hyperparameter::Kind::noise_stddev || !at_lower || never_ran) continue;
    const Observations& group = posterior.observations()[static_cast<std::size_t>(h.owner)];
    if (group.states_noise(h.index) && !has_dependent_columns(posterior, group)) {
      notes.push_back(
          fmt::format("{} ended at the lower bound: the standard deviations in the log are {:.2g} times too large, or more",
                      h.name, 1 / h.lower));
    } else {
      (may_depend(posterior, group) ? dependent : without_noise).push_back(h.name);
    }
  }
  for (const Hyperparameter& h : report.hyperparameters) {
    constexpr double far_off = 5;  // the lower bound is as far off in the other direction
    if (never_ran || h.kind != Hyperparameter::Kind::noise_stddev || !(h.value > far_off)) continue;
    const Observations& group = posterior.observations()[static_cast<std::size_t>(h.owner)];
    if (!group.states_noise(h.index) || group.has_sums()) continue;  // of sums: add_window_note
    notes.push_back(
        fmt::format("{} = {:.2g}: the standard deviations in the log are too small by this factor, or the model "
                    "lacks something",
                    h.name, h.value));
  }
  const auto is_open = [&](const Hyperparameter& h) {
    return h.is_system_parameter() && report.uncertainty &&
           std::isinf(report.uncertainty->stddev[&h - report.hyperparameters.data()]);
  };
  const auto n_open = std::ranges::count_if(report.hyperparameters, is_open);
  for (const Hyperparameter& h : report.hyperparameters) {
    if (!h.is_system_parameter() || !h.at_bound() || never_ran) continue;
    if (n_open > 1 && is_open(h)) continue;  // another may make up for it, so that it is there by chance
    notes.push_back(
        fmt::format("warning: {} ended at its bound, {:.6g}. It may lie beyond, or the model lacks something", h.name, h.value));
  }
  for (const UncertaintyNote& note : uncertainty_notes(report)) {
    notes.push_back(fmt::format("{}{}. {}", note.is_warning ? "warning: " : "", note.text, note.mend));
  }
  if (!never_ran) add_few_values_note(report, posterior, notes);
  add_vanishing_notes(posterior, notes);
  if (report.termination == FitReport::unsettled) {
    notes.push_back(fmt::format(
        "warning: the fit has not converged: hyperparameters and the mean of nonlinear latents still changed each other. "
        "Standard deviations may be far too small{}",
        reads_loads(posterior.prior())
            ? ". The data may determine only the product of a load and its coefficient: fix one of them"
            : ""));
  }
  if (!dependent.empty()) {
    notes.push_back(
        fmt::format("warning: {} ended at the lower bound: the columns may not be independent measurements; see gp2 check",
                    fmt::join(dependent, ", ")));
  }
  if (!without_noise.empty()) {
    notes.push_back(fmt::format("{} ended at the lower bound: the log has less noise than the fit can distinguish from none",
                                fmt::join(without_noise, ", ")));
  }
  return notes;
}

std::vector<Hyperparameter> starting_hyperparameters(const Model& model, const FitProblem& problem,
                                                     const FitProblemOptions& options) {
  if (options.baseline) return baseline_hyperparameters(problem.prior, problem.observations);
  std::vector<Hyperparameter> out = default_hyperparameters(problem.prior, trusted_observations(problem),
                                                            estimated_parameters(model, options), options.protocol);
  for (Hyperparameter& h : out) {
    if (h.kind == Hyperparameter::Kind::noise_stddev) bound_noise(model, problem, h);
  }
  if (problem.prior_options.discrepancy) tie_discrepancy(problem, out);
  return out;
}

FitOptions default_fit_options(const FitProblem& problem) {
  return problem.prior_options.baseline ? baseline_fit_options() : FitOptions{};
}

std::vector<std::string> distrust_notes(const FitProblem& problem, const FitReport& report) {
  if (!problem.robust) return {};
  std::ptrdiff_t n_values = 0;
  for (const Observations& group : problem.observations) n_values += (!group.values().array().isNaN()).count();
  constexpr std::size_t max_shown = 12;
  std::vector<std::string> worst;
  for (const DistrustedValue& value : report.distrusted) {
    if (worst.size() == max_shown) break;
    const auto group = static_cast<std::size_t>(value.group);
    const View& view = problem.observations[group].view();
    worst.push_back(fmt::format(
        "{} in {} ({:.3g} σ)", view.names(*prior_of(problem.prior, view).system)[static_cast<std::size_t>(value.row)],
        place_of(problem.lines, group, static_cast<std::size_t>(value.state), problem.observations.size() == 1), value.distance));
  }
  if (worst.size() < report.distrusted.size()) worst.emplace_back("…");
  return {fmt::format("robust: {} of {} values distrusted{}{}", report.distrusted.size(), n_values, worst.empty() ? "" : ": ",
                      fmt::join(worst, ", "))};
}

Fit fit(const FitProblem& problem, const FitOptions& options) {
  if (problem.robust) return fit_robust(problem.prior, problem.observations, problem.hyperparameters, options);
  const std::optional<Baseline>& baseline = problem.prior_options.baseline;
  return baseline ? fit_baseline(baseline->kind, problem.prior, problem.observations, problem.hyperparameters, options)
                  : fit(problem.prior, problem.observations, problem.hyperparameters, options);
}

FitProblem make_fit_problem(const Model& model, const std::vector<Log>& logs, const std::vector<SideInformation>& also,
                            const FitProblemOptions& options) {
  if (logs.empty() && also.empty())
    throw InputError("there is nothing to fit: give logs with `data`, or other knowledge with `also`");
  if (options.baseline) {
    require_baseline_options(options, logs, also);
    require_columns(model, logs, {}, options);
    return make_baseline_problem(model, logs, options);
  }
  FitProblem problem = start_problem(model, options);
  require_columns(model, logs, also, options);
  const std::vector<std::string> estimated = estimated_parameters(model, options);
  for (const Log& log : logs) {
    LogRows rows;
    problem.observations.push_back(
        read_log(add_system(model, log, options, estimated, problem), log, options, rows, problem.notes));
    add_rows(std::move(rows), problem);
  }
  const auto states_noise = [](const Observations& group) { return group.noise().has_scale(); };
  if (options.trust_stated_noise && !logs.empty() && std::ranges::none_of(problem.observations, states_noise)) {
    throw InputError(
        fmt::format("{}: `noise_std=stated`: no measured acceleration has a column NAME_std beside it", logs[0].table.name()));
  }
  add_side_information(model, also, options, estimated, problem);
  add_late(model, options, problem);
  require_separate_states(problem);
  note_idle_latents(problem);
  if (options.protocol.name == Protocol::Name::standard) centre_features(model, problem);
  if (has_discrepancy(model, problem, options)) add_discrepancy(model, problem);
  problem.hyperparameters = starting_hyperparameters(model, problem, options);
  for (std::size_t g = 0; g < logs.size(); ++g) {
    if (logs[g].windows) problem.observations[g] = with_windows(problem.observations[g], *logs[g].windows, problem.lines[g]);
  }
  return problem;
}

FitProblem make_fit_problem(const Model& model, const CsvTable& log, const FitProblemOptions& options) {
  return make_fit_problem(model, {Log{.table = log}}, {}, options);
}

}  // namespace gp2
