#include "jobs/doubts.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "data/evenly.hpp"
#include "inference/posterior_implementation.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

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

}  // namespace gp2
