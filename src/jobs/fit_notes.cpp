#include "jobs/fit_notes.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "data/evenly.hpp"
#include "gp2/training/robust.hpp"
#include "inference/posterior_implementation.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

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
        fmt::format("warning: the noise of {} is found {:.2g} times as large in log {} as in log {}: what it says may not be "
                    "noise, but contradict the others; see gp2 check",
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
      if (const std::optional<PileUp> found = pile_up(group.states().row(system.layout().u(k)))) {
        notes.push_back(
            fmt::format("the input {}{} is exactly {:.4g}, its extreme, in {:.0f} % of the rows, and else takes many "
                        "values: clipped? The log must have what acts",
                        system.inputs()[static_cast<std::size_t>(k)], of_log, found->value, 100 * found->share));
      }
    }
    const std::vector<std::string> names = view.names(system);
    for (int k = 0; k < view.size(); ++k) {
      if (const std::optional<PileUp> found = pile_up(group.values().row(k))) {
        notes.push_back(
            fmt::format("warning: {}{} is exactly {:.4g}, its extreme, in {:.0f} % of the rows, and else takes many "
                        "values: a sensor at the end of its range?",
                        names[static_cast<std::size_t>(k)], of_log, found->value, 100 * found->share));
      }
    }
  }
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
        const auto state = static_cast<std::size_t>(i);
        const std::string line =
            state < problem.lines[g].size() ? fmt::format("line {}", problem.lines[g][state]) : fmt::format("row {}", i + 1);
        far.push_back(fmt::format("{} = {:.6g} in {}{}", names[static_cast<std::size_t>(k)], group.values()(k, i), line,
                                  problem.observations.size() > 1 ? fmt::format(" of log {}", g + 1) : ""));
      }
    }
  }
  if (far.empty()) return "";
  if (far.size() > most_shown) {
    far.resize(most_shown);
    far.emplace_back("…");
  }
  return fmt::format("single values lie far from all others: {}. Mend or empty these cells, or fit with `robust`",
                     fmt::join(far, ", "));
}

namespace {

// The accelerations of a group against A ddq = b. An estimated noise takes up what denies a constraint: beside it they are judged by
// the terms that should cancel, as where no noise is known. A row of one term alone has nothing to cancel, and a soft one need not.
std::vector<ConstraintResidual> residuals_to_judge(const Posterior& posterior, std::size_t group) {
  const Observations& of = posterior.observations()[group];
  const Prior& prior = prior_of(posterior.prior(), of.view());
  std::vector<ConstraintResidual> residuals = constraint_residuals(posterior, group);
  if (!of.noise().is_estimated() || of.has_sums() || prior.system->has_constraint_noise()) return residuals;
  constexpr double rounding = 1e-9;
  for (ConstraintResidual& one : residuals) {
    if (!one.is_too_large() && one.rms < (1 - rounding) * one.size) one.expected = not_a_number;
  }
  return residuals;
}

// Where measured accelerations, or the velocities beside them, are not the rates of what they should be.
void add_rate_notes(const Posterior& posterior, std::size_t group, std::vector<std::string>& notes) {
  const Observations& of = posterior.observations()[group];
  const System& system = *prior_of(posterior.prior(), of.view()).system;
  MatrixXd accelerations = MatrixXd::Constant(system.nq(), of.n_data(), not_a_number);
  accelerations(of.view().rows, Eigen::all) = of.values();
  for (const std::string& text : wrong_rates(system, of.states(), accelerations)) notes.push_back("warning: " + text);
}

}  // namespace

void add_residual_notes(const Posterior& posterior, const std::vector<TrainingResidual>& residuals,
                        std::vector<std::string>& notes) {
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    if (!posterior.observations()[g].view().is_of_ddq()) continue;
    const std::size_t n_before = notes.size();
    for (const ConstraintResidual& one : residuals_to_judge(posterior, g)) {
      if (one.is_too_large()) notes.push_back("warning: " + one.text());
    }
    if (notes.size() > n_before) add_rate_notes(posterior, g, notes);
  }
  std::vector<std::string> large, small;
  const TrainingResidual* farthest = nullptr;
  int n_far = 0;
  for (const TrainingResidual& one : residuals) {
    const Observations& group = posterior.observations()[one.group];
    if (one.is_too_small() && !group.noise().is_estimated() && !group.has_sums())
      small.push_back(fmt::format("{} ({:.2g} of the noise)", one.output, one.rms_in_noise));
    if (!one.is_too_large()) {
      n_far += one.n_far;
      if (one.n_far > 0 && (farthest == nullptr || one.farthest > farthest->farthest)) farthest = &one;
      continue;
    }
    large.push_back(fmt::format("{} (z rms {:.2g}, {:.0f} % within 95 %)", one.output, one.rms, 100 * one.coverage95));
  }
  if (!large.empty()) {
    notes.push_back(
        fmt::format("warning: values lie farther than noise from what all others predict: {}: the noise is stated too small, a "
                    "column is wrong or lags, or the constraints or features miss something; see gp2 check and gp2 report",
                    fmt::join(large, ", ")));
  }
  if (farthest != nullptr) {
    const std::string where = farthest->farthest_state < 0 ? ""
                                                           : fmt::format(", at row {} of what is learned from log {}",
                                                                         farthest->farthest_state + 1, farthest->group + 1);
    notes.push_back(fmt::format(
        "warning: {} of the values lie six deviations or more from what all others predict, up to {:.2g} ({}{}): outliers of "
        "the log, or rare states of which the others tell nothing while the fit is sure of itself; see `robust`",
        n_far, farthest->farthest, farthest->output, where));
  }
  if (small.empty()) return;
  notes.push_back(fmt::format(
      "values lie closer to what all others predict than the noise that is stated lets them: {}: it is stated too large, and "
      "deviations are, or rows share their errors, as smoothed ones do; `noise_std=estimate` finds it",
      fmt::join(small, ", ")));
}

namespace {

// Whether stretches that were left out are predicted much worse than the noise and rows left out one by one, or somewhat worse while
// the fit is too sure of itself. What the model lacks is taken up between rows that are known, and told by stretches that are not.
bool predicts_stretches_worse(const CrossValidation& of) {
  constexpr double several = 3, worth_a_word = 0.01;  // times the noise or the error of single rows; of the spread
  constexpr double somewhat = 1.3, low_coverage = 0.9;
  constexpr int enough = 100;  // rows, for a coverage
  if (!of.stretches) return false;
  const double usual = std::max(of.nrmse_of_noise, of.one_by_one.nrmse), error = of.stretches->nrmse;
  return (error > several * usual && error > worth_a_word) ||
         (error > somewhat * usual && of.stretches->coverage95 < low_coverage && of.stretches->n >= enough);
}

}  // namespace

void add_stretch_note(const CrossValidation& cross_validation, std::vector<std::string>& notes) {
  if (!cross_validation.predicts_little()) {
    if (!predicts_stretches_worse(cross_validation)) return;
    const Evaluation::Part& stretches = *cross_validation.stretches;
    notes.push_back(fmt::format(
        "stretches of the log that were left out are predicted worse than rows left out one by one: nrmse {:.2g}, not {:.2g}, of "
        "which the noise makes {:.2g}, with {:.0f} % within 95 %. Something acts otherwise than the model has it (an input that "
        "is clipped, late or scaled, an inertia that is off), or the rows are too few, or of one motion, for what the model "
        "leaves open",
        stretches.nrmse, cross_validation.one_by_one.nrmse, cross_validation.nrmse_of_noise, 100 * stretches.coverage95));
    return;
  }
  notes.push_back(fmt::format(
      "{}of stretches of the log that it has not seen the fit says little: nrmse {:.2g}, of which the noise makes {:.2g}. An "
      "input, a mass or a constraint is wrong or missing, or the rows are too few for what the model leaves open",
      cross_validation.predicts_nothing() ? "warning: " : "", cross_validation.stretches->nrmse,
      cross_validation.nrmse_of_noise));
}

namespace {

// The prior mean of what is observed, at its states where an input is otherwise (d × N); nothing where that is no number.
std::optional<MatrixXd> mean_of(const Posterior& posterior, const Observations& group, const MatrixXd& states) {
  const Prior& prior = posterior.prior();
  const View& view = group.view();
  MatrixXd of_view(view.size(), group.n_data());
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

// What an input adds to the prior mean of each of some observations, and what it would change to act some rows later.
struct InputEffect {
  struct Late {
    int rows;
    std::vector<MatrixXd> changed;  // (d × N)
  };
  int input;
  std::string name;
  std::vector<MatrixXd> added;  // (d × N)
  std::vector<Late> late = {};

  // of one log
  [[nodiscard]] InputEffect in_log(std::size_t group) const {
    InputEffect one{input, fmt::format("{} of log {}", name, group + 1), added};
    for (std::size_t g = 0; g < added.size(); ++g) {
      if (g != group) one.added[g].setZero();
    }
    return one;
  }
};

double size_of(const std::vector<MatrixXd>& of_groups) {
  double squares = 0;
  for (const MatrixXd& one : of_groups) squares += one.squaredNorm();
  return std::sqrt(squares);
}

// @param some   of the posterior's states
// @param taken  which they are, where those follow each other in time; empty: they do not
// @returns nothing where there is no number without the input
std::optional<InputEffect> effect_of(const Posterior& posterior, const std::vector<Observations>& some,
                                     const std::vector<std::vector<int>>& taken, int input) {
  constexpr double large = 0.1;  // of what is added
  const System& system = *posterior.prior().system;
  const int row = system.layout().u(input);
  const std::vector<Observations>& all = posterior.observations();
  InputEffect effect{input, system.inputs()[static_cast<std::size_t>(input)], {}};
  std::vector<MatrixXd> as_logged;
  for (const Observations& group : some) {
    MatrixXd states = group.states();
    const auto mean = mean_of(posterior, group, states);
    states.row(row).setZero();
    const auto without = mean_of(posterior, group, states);
    if (!mean || !without) return std::nullopt;
    as_logged.push_back(*mean);
    effect.added.emplace_back(*mean - *without);
  }
  for (const int rows : {1, -1, 2, -2, 4, -4, 8, -8, 16, -16}) {
    if (taken.empty()) break;
    InputEffect::Late late{rows, {}};
    for (std::size_t g = 0; g < some.size(); ++g) {
      MatrixXd states = some[g].states();
      for (std::size_t k = 0; k < taken[g].size(); ++k) {
        const int from = taken[g][k] - rows;
        if (from >= 0 && from < all[g].n_data()) states(row, static_cast<Eigen::Index>(k)) = all[g].states()(row, from);
      }
      const auto mean = mean_of(posterior, some[g], states);
      if (!mean) return effect;
      late.changed.emplace_back(*mean - as_logged[g]);
    }
    const double share = size_of(late.changed) / size_of(effect.added);
    if (rows == 1 && !(share < 1)) break;  // rows in no order, or too far apart to tell
    if (share > large) effect.late.push_back(std::move(late));
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

// What is left to explain where an input changes the mean by so much.
std::vector<Observations> without_change(const std::vector<Observations>& observations, const std::vector<MatrixXd>& change,
                                         double share) {
  std::vector<Observations> out;
  for (std::size_t g = 0; g < observations.size(); ++g) out.push_back(less(observations[g], share * change[g]));
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

// How an input acts otherwise than logged, as the data have it.
struct Doubt {
  double gain = 0;  // in log likelihood
  std::string how, cause;
  std::vector<Observations> mended;  // what is left to explain then
};

using Cost = std::function<double(const std::vector<Observations>&)>;

// The most that can be said of an input; no gain: nothing.
Doubt doubt_of(const InputEffect& input, const std::vector<Observations>& observations, double as_logged, const Cost& cost) {
  constexpr double far = 0.5, sure = 5;  // from a factor of 1; deviations
  const auto with_factor = [&](double factor) { return without_change(observations, input.added, factor - 1); };
  Doubt doubt;
  const InputFactor one = likeliest_factor(cost(with_factor(0)), as_logged, cost(with_factor(2)));
  if (std::abs(one.factor - 1) > std::max(far, sure * one.stddev)) {
    doubt = {one.gain, fmt::format("{:.2g} ± {:.2g} times as logged", one.factor, one.stddev),
             "A sign or a unit is wrong, or an inertia that it moves, or it acts late", with_factor(one.factor)};
  }
  for (const InputEffect::Late& late : input.late) {
    std::vector<Observations> mended = without_change(observations, late.changed, 1);
    const double gain = as_logged - cost(mended);
    if (gain <= doubt.gain) continue;
    doubt = {gain,
             fmt::format("{} row{} {} than logged", std::abs(late.rows), std::abs(late.rows) == 1 ? "" : "s",
                         late.rows > 0 ? "later" : "earlier"),
             late.rows > 0 ? "It has a delay or a lag that the model lacks, or its column leads"
                           : "Its column lags, or the others lead",
             std::move(mended)};
  }
  return doubt;
}

// The same, of which nothing was measured in one log, or in all others.
std::vector<Observations> with_log(const std::vector<Observations>& observations, std::size_t log, bool alone) {
  std::vector<Observations> out = observations;
  for (std::size_t g = 0; g < out.size(); ++g) {
    if ((g == log) != alone)
      out[g] = out[g].with_values(MatrixXd::Constant(out[g].values().rows(), out[g].n_data(), not_a_number));
  }
  return out;
}

// Whether a log and another one measure something.
bool can_contradict(const std::vector<Observations>& observations, std::size_t log) {
  const auto tells = [](const Observations& group) { return group.view().is_of_ddq() && !group.values().array().isNaN().all(); };
  return tells(observations[log]) && std::ranges::count_if(observations, tells) > 1;
}

// By how much a log and the others are likelier under functions of their own than under one.
double gain_of_contradiction(const std::vector<Observations>& observations, std::size_t log, double together, const Cost& cost) {
  return together - cost(with_log(observations, log, /*alone=*/false)) - cost(with_log(observations, log, /*alone=*/true));
}

// An input of the known force that is the same in all rows of a log and moves in others; none: −1.
int resting_input(const Posterior& posterior, std::size_t log) {
  const System& system = *posterior.prior().system;
  const std::vector<Observations>& all = posterior.observations();
  const std::vector<bool> force = system.reads(SystemPart::force);
  for (int j = 0; j < system.layout().nu; ++j) {
    const int row = system.layout().u(j);
    const auto moves = [&](const Observations& group) {
      const auto u = group.states().row(row);
      return u.size() > 0 && (u.array() != u[0]).any();
    };
    if (force[static_cast<std::size_t>(row)] && !moves(all[log]) && std::any_of(all.begin(), all.end(), moves)) return j;
  }
  return -1;
}

void note_contradiction(const Posterior& posterior, std::size_t log, double gain, std::vector<std::string>& notes) {
  const int resting = resting_input(posterior, log);
  const std::string cause =
      resting < 0 ? fmt::format("A unit, a sign or a parameter is another {}, or something acts that the model does not know",
                                posterior.observations().size() == 2 ? "in one of the two" : "there")
                  : fmt::format("Its input {} is {:.4g} in every row: was it logged?",
                                posterior.prior().system->inputs()[static_cast<std::size_t>(resting)],
                                posterior.observations()[log].states()(posterior.prior().system->layout().u(resting), 0));
  notes.push_back(fmt::format(
      "warning: log {} contradicts the others: each is likelier under a function of its own, by {:.2g} in log likelihood. {}",
      log + 1, gain, cause));
}

constexpr double least_gain = 10;  // nats

Cost cost_under(const Prior& prior, ModelValues values) {
  return [&prior, values = std::move(values)](const std::vector<Observations>& some) {
    return Posterior(prior, some, values).negative_log_likelihood();
  };
}

// A fit takes up what acts in a log whose input was lost, by a function that bends as it must: the others are fitted without it.
void note_lost_inputs(const Posterior& posterior, std::vector<Observations>& observations, const FittedValues& fitted_values,
                      std::vector<std::string>& notes) {
  for (std::size_t g = 0; g < observations.size(); ++g) {
    if (!can_contradict(observations, g) || resting_input(posterior, g) < 0) continue;
    std::vector<Observations> others = with_log(observations, g, /*alone=*/false);
    const Cost cost = cost_under(posterior.prior(), fitted_values(others));
    const double gain = gain_of_contradiction(observations, g, cost(observations), cost);
    if (gain <= least_gain) continue;
    note_contradiction(posterior, g, gain, notes);
    observations = std::move(others);
  }
}

// A wrong one makes others seem wrong: the most doubtful first, the others beside it as it should be.
void note_doubts(const Posterior& posterior, std::vector<Observations> observations, std::vector<InputEffect> inputs,
                 bool asks_logs, std::vector<std::string>& notes) {
  const Cost cost = cost_under(posterior.prior(), posterior.values());
  for (;;) {
    const double as_logged = cost(observations);
    Doubt worst;
    worst.gain = least_gain;
    std::ptrdiff_t of_input = -1, of_log = -1;
    for (std::size_t k = 0; k < inputs.size(); ++k) {
      Doubt doubt = doubt_of(inputs[k], observations, as_logged, cost);
      if (!(doubt.gain > worst.gain)) continue;
      worst = std::move(doubt);
      of_input = static_cast<std::ptrdiff_t>(k);
    }
    for (std::size_t g = 0; g < observations.size() && asks_logs; ++g) {
      if (!can_contradict(observations, g)) continue;
      const double gain = gain_of_contradiction(observations, g, as_logged, cost);
      if (!(gain > worst.gain)) continue;
      worst.gain = gain;
      of_log = static_cast<std::ptrdiff_t>(g);
    }
    if (of_log >= 0) {
      note_contradiction(posterior, static_cast<std::size_t>(of_log), worst.gain, notes);
      observations = with_log(observations, static_cast<std::size_t>(of_log), /*alone=*/false);
    } else if (of_input >= 0) {
      const InputEffect& input = inputs[static_cast<std::size_t>(of_input)];
      notes.push_back(fmt::format(
          "warning: the data deny the input {}: they are most likely where it acts {}, by {:.2g} in log likelihood. {}",
          input.name, worst.how, worst.gain, worst.cause));
      observations = std::move(worst.mended);
      // what else is said of it is said of an input that acts so
      std::erase_if(inputs, [said = input.input](const InputEffect& one) { return one.input == said; });
    } else {
      return;
    }
  }
}

}  // namespace

void add_doubts(const Posterior& posterior, bool has_row_order, const FittedValues& fitted_values,
                std::vector<std::string>& notes) {
  constexpr int enough = 1000, fewest = 10;  // values: a sign or a unit needs no more; states
  constexpr std::size_t most_logs = 10;      // each of which is asked by itself
  const Prior& prior = posterior.prior();
  const System& system = *prior.system;
  const StateLayout layout = system.layout();
  const std::vector<Observations>& all = posterior.observations();
  const auto any = [&](const auto& is) { return std::any_of(all.begin(), all.end(), is); };
  if (prior.reference || n_states(all) < fewest || any([](const auto& group) { return bool(group.view().other_system); })) return;
  const bool of_windows = has_sums(all);
  const bool asks = !prior.is_nonlinear() && !(of_windows && n_states(all) * system.nq() > 2 * enough);
  const bool asks_logs = asks && !of_windows && all.size() > 1 && all.size() <= most_logs;
  const int n_some = enough / system.nq();
  std::vector<Observations> some = of_windows ? all : evenly(all, n_some);
  // of many states some are kept, which do not follow each other
  const bool are_all = posterior.n_states() == n_states(all);
  const auto taken = has_row_order && are_all && !of_windows ? evenly_taken(all, n_some) : std::vector<std::vector<int>>();
  const std::vector<bool> force = system.reads(SystemPart::force), elsewhere = system.reads(SystemPart::mechanics);
  // a latent that reads an input takes up what it does otherwise
  const auto is_learned = [&](int row) {
    return std::any_of(prior.latents.begin(), prior.latents.end(), [&](const Latent& one) { return one.features->reads(row); });
  };
  std::vector<InputEffect> inputs;
  for (int j = 0; j < layout.nu && prior.mean == Prior::Mean::force; ++j) {
    const int row = layout.u(j);
    if (!force[static_cast<std::size_t>(row)]) continue;
    const double first = all.front().n_data() > 0 ? all.front().states()(row, 0) : 0;
    if (!any([&](const auto& group) { return (group.states().row(row).array() != first).any(); })) {
      notes.push_back(fmt::format("the input {} is {:.4g} in every row: was it logged?",
                                  system.inputs()[static_cast<std::size_t>(j)], first));
    } else if (asks && !elsewhere[static_cast<std::size_t>(row)] && !is_learned(row)) {
      if (std::optional<InputEffect> effect = effect_of(posterior, some, taken, j)) inputs.push_back(*std::move(effect));
    }
  }
  const std::size_t n_inputs = inputs.size();
  for (std::size_t k = 0; k < n_inputs && asks_logs; ++k) {
    for (std::size_t g = 0; g < all.size(); ++g) {
      if (all[g].view().is_of_ddq()) inputs.push_back(inputs[k].in_log(g));
    }
  }
  if (asks_logs) note_lost_inputs(posterior, some, fitted_values, notes);
  note_doubts(posterior, std::move(some), std::move(inputs), asks_logs, notes);
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

void add_impossible_note(int n_impossible, int n_draws, std::vector<std::string>& notes) {
  if (n_impossible == 0) return;
  notes.push_back(fmt::format("warning: {} of {} draws of the hyperparameters are left out: there is no posterior under them",
                              n_impossible, n_draws));
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
