#include "jobs/doubts.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <numeric>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "inference/posterior_implementation.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::RowVectorXd;
using Eigen::VectorXd;

namespace {

using Means = std::vector<MatrixXd>;  // of the observations of each log (d × N)

// The prior mean of what is observed, at its states where an input is otherwise (d × N); nothing where that is no number.
std::optional<MatrixXd> mean_of(const Prior& prior, const ModelValues& model, const Observations& group, const MatrixXd& states) {
  const View& view = group.view();
  MatrixXd of_view(view.size(), group.n_data());
  const VectorXd parameters = parameters_of(view, model.parameters);
  MechanicsBatch mechanics;
  evaluate_mechanics(prior, view, states, parameters, mechanics);
  if (mechanics.fault) return std::nullopt;
  PriorValues values = evaluate_prior(prior, states, parameters, mechanics);
  if (values.fault) return std::nullopt;
  keep_viewed(view, values);
  const ViewValues viewed = evaluate_view(view, mechanics, states);
  for (int i = 0; i < group.n_data(); ++i) of_view.col(i) = viewed.G(i) * values.mean.col(i) + viewed.offset.col(i);
  return of_view;
}

double size_of(const Means& of_groups) {
  double squares = 0;
  for (const MatrixXd& one : of_groups) squares += one.squaredNorm();
  return std::sqrt(squares);
}

Means less_means(Means of_groups) {
  for (MatrixXd& one : of_groups) one.colwise() -= VectorXd(one.rowwise().mean());
  return of_groups;
}

// Measured values, and sums over states, times a factor and with something added to each.
Observations transformed(const Observations& group, double factor, const MatrixXd& added) {
  const Observations out = group.with_values(factor * group.values() + added);
  if (!group.has_sums()) return out;
  std::vector<WeightedSum> sums = group.sums();
  for (WeightedSum& sum : sums)
    sum.value = factor * sum.value + added.row(sum.row).segment(sum.first, sum.weights.size()).dot(sum.weights);
  return out.with_sums(std::move(sums));
}

// What is left to explain where an input changes the mean by so much.
std::vector<Observations> without_change(const std::vector<Observations>& observations, const Means& change, double share) {
  std::vector<Observations> out;
  for (std::size_t g = 0; g < observations.size(); ++g) out.push_back(transformed(observations[g], 1, -share * change[g]));
  return out;
}

using Cost = std::function<double(const std::vector<Observations>&)>;

// Infinite where latents that enter nonlinearly have no posterior mean.
Cost cost_under(const Prior& prior, ModelValues values) {
  return [&prior, values = std::move(values)](const std::vector<Observations>& some) {
    try {
      return Posterior(prior, some, values).negative_log_likelihood();
    } catch (const NumericalError&) {
      return std::numeric_limits<double>::infinity();
    }
  };
}

// How many values were measured.
double n_measured(const std::vector<Observations>& observations) {
  Eigen::Index n = 0;
  for (const Observations& group : observations) {
    n += group.values().array().isFinite().count();
    if (group.has_sums()) n += std::ssize(group.sums());
  }
  return static_cast<double>(n);
}

// Half of the squared residuals from the prior mean, in units of their deviations under some values.
std::optional<double> misfit_of(const Prior& prior, const Cost& cost, const ModelValues& values,
                                const std::vector<Observations>& observations) {
  std::vector<Observations> at_mean;
  for (const Observations& group : observations) {
    const auto mean = mean_of(prior, values, group, group.states());
    if (!mean) return std::nullopt;
    at_mean.push_back(transformed(group, 0, *mean));
  }
  return cost(observations) - cost(at_mean);
}

// By which factor an input would have to do more for the data to be most likely.
struct InputFactor {
  double factor = 1, stddev = 0;
  double gain = 0;  // in log likelihood

  /// Not by chance, and far enough to matter.
  [[nodiscard]] bool is_other_than_one() const {
    constexpr double far = 0.1, sure = 5;  // the latter in deviations
    return std::abs(factor - 1) > std::max(far, sure * stddev);
  }
};

// The log likelihood is quadratic in the factor, of latents that enter nonlinearly as long as their load hardly changes: three values
// tell where it is largest.
InputFactor likeliest_factor(const std::vector<Observations>& observations, const Means& added, double as_logged,
                             const Cost& cost) {
  constexpr double h = 0.5;
  const double less = cost(without_change(observations, added, -h)), more = cost(without_change(observations, added, h));
  const double curvature = (less - 2 * as_logged + more) / (h * h);
  if (!(curvature > 0) || std::isinf(curvature)) return {};
  const double step = 0.5 * (less - more) / (h * curvature);
  return {1 + step, 1 / std::sqrt(curvature), 0.5 * curvature * step * step};
}

constexpr int known_force = -2;  // in the place of an input: the force without inputs

// An input that acts otherwise than logged, or the known force otherwise than modelled.
struct Hypothesis {
  enum class Kind { factor, late, exchanged };
  Kind kind;
  int input;       // or known_force
  Means change;    // of the mean
  Means added;     // what the input adds to the mean then
  int rows = 0;    // by which it is late
  int other = -1;  // input that it is exchanged with
  double factor = 1;
  double gain = 0;  // in log likelihood
  std::string text = {}, cause = {};

  /// The same of an effect that is larger by a factor.
  [[nodiscard]] Hypothesis times(const InputFactor& one) const {
    Hypothesis out = *this;
    out.factor = one.factor;
    out.gain = one.gain;
    const bool is_of_force = input == known_force;
    out.text = fmt::format("it acts {:.2g} ± {:.2g} times as {}", one.factor, one.stddev, is_of_force ? "modelled" : "logged");
    out.cause = is_of_force ? "A sign, a unit or a parameter of it is wrong, or an inertia that it moves"
                            : "A sign or a unit is wrong, or an inertia that it moves, or it acts late";
    for (std::size_t g = 0; g < added.size(); ++g) out.change[g] = (one.factor - 1) * added[g];
    return out;
  }
};

// What is asked of the inputs.
struct Doubted {
  const Posterior& posterior;
  const std::vector<Observations>& some;       // of the posterior's states
  const std::vector<std::vector<int>>& taken;  // which they are, where those follow each other in time; empty: they do not
  const std::vector<std::string>& held;        // parameters
  const FittedValues& fitted_values;
  const int lines_apart;  // in its log, of a state and the next one

  /// What changes where the input rows of the states are others, and what one of them adds then. Nothing where that is no number.
  template <typename StatesOf>
  [[nodiscard]] std::optional<Hypothesis> hypothesis(Hypothesis::Kind kind, int input, const StatesOf& states_of) const {
    Hypothesis out{kind, input, {}, {}};
    const Prior& prior = posterior.prior();
    for (std::size_t g = 0; g < some.size(); ++g) {
      MatrixXd states = states_of(g);
      const auto as_logged = mean_of(prior, posterior.values(), some[g], some[g].states());
      const auto mean = mean_of(prior, posterior.values(), some[g], states);
      states.row(prior.system->layout().u(input)).setZero();
      const auto without = mean_of(prior, posterior.values(), some[g], states);
      if (!as_logged || !mean || !without) return std::nullopt;
      out.change.emplace_back(*mean - *as_logged);
      out.added.emplace_back(*mean - *without);
    }
    return out;
  }

  [[nodiscard]] std::optional<Hypothesis> as_logged(int input) const {
    return hypothesis(Hypothesis::Kind::factor, input, [&](std::size_t g) { return some[g].states(); });
  }

  /// The effect of the known force without inputs.
  [[nodiscard]] std::optional<Hypothesis> force() const {
    Hypothesis out{Hypothesis::Kind::factor, known_force, {}, {}};
    const StateLayout layout = posterior.prior().system->layout();
    Prior unforced = posterior.prior();
    unforced.mean = Prior::Mean::zero;
    for (const Observations& group : some) {
      MatrixXd states = group.states();
      for (int j = 0; j < layout.nu; ++j) states.row(layout.u(j)).setZero();
      const auto with = mean_of(posterior.prior(), posterior.values(), group, states);
      const auto without = mean_of(unforced, posterior.values(), group, states);
      if (!with || !without) return std::nullopt;
      out.added.emplace_back(*with - *without);
      out.change.emplace_back(MatrixXd::Zero(with->rows(), with->cols()));
    }
    return out;
  }

  [[nodiscard]] std::optional<Hypothesis> late(int input, int rows) const {
    const int row = posterior.prior().system->layout().u(input);
    auto out = hypothesis(Hypothesis::Kind::late, input, [&](std::size_t g) {
      const MatrixXd& all = posterior.observations()[g].states();
      MatrixXd states = some[g].states();
      for (std::size_t k = 0; k < taken[g].size(); ++k) {
        const Eigen::Index from = taken[g][k] - rows;
        if (from >= 0 && from < all.cols()) states(row, static_cast<Eigen::Index>(k)) = all(row, from);
      }
      return states;
    });
    if (!out) return out;
    out->rows = rows;
    const int lines = lines_apart * std::abs(rows);
    out->text = fmt::format("it acts {}{} row{} {} than logged", lines_apart == 1 ? "" : "about ", lines, lines == 1 ? "" : "s",
                            rows > 0 ? "later" : "earlier");
    out->cause =
        rows > 0 ? "It has a delay or a lag that the model lacks, or its column leads" : "Its column lags, or the others lead";
    return out;
  }

  [[nodiscard]] std::optional<Hypothesis> exchanged(int input, int other) const {
    const System& system = *posterior.prior().system;
    auto out = hypothesis(Hypothesis::Kind::exchanged, input, [&](std::size_t g) {
      MatrixXd states = some[g].states();
      states.row(system.layout().u(input)).swap(states.row(system.layout().u(other)));
      return states;
    });
    if (!out) return out;
    out->text = fmt::format("it and {} are exchanged", system.inputs()[static_cast<std::size_t>(other)]);
    out->cause = "Their columns are swapped, in the log or in the model";
    out->other = other;
    return out;
  }
};

// How many lines of its log a state is from the next one, 1 where that is not known; nothing where logs differ in it.
std::optional<int> lines_apart(const std::vector<std::vector<int>>& lines) {
  std::optional<int> apart;
  for (const std::vector<int>& of_log : lines) {
    if (of_log.size() < 2) continue;
    std::vector<int> steps(of_log.size());
    std::adjacent_difference(of_log.begin(), of_log.end(), steps.begin());
    const auto middle = static_cast<int>(median({steps.begin() + 1, steps.end()}));
    // some lines may have been left out, but of lines at random none is a number of rows later
    const auto n_steps = std::ssize(steps) - 1;
    const auto n_equal = std::count(steps.begin() + 1, steps.end(), middle);
    const bool are_even = std::all_of(steps.begin() + 1, steps.end(), [&](int step) { return std::abs(step - middle) <= 1; });
    if (!are_even && n_equal * 10 < n_steps * 9) return std::nullopt;
    if (apart && *apart != middle) return std::nullopt;
    apart = middle;
  }
  return apart.value_or(1);
}

constexpr double least_gain = 10;  // nats
constexpr int most_late = 16;      // by which an input is taken to be late

// An input, in all logs or in one; or the known force without inputs.
struct InputEffect {
  int input;  // or known_force
  std::string name;
  Hypothesis as_logged;
  std::vector<Hypothesis> late = {}, exchanged = {};  // with those before it
  bool is_of_one_log = false;

  [[nodiscard]] InputEffect in_log(std::size_t group) const {
    InputEffect one{input, fmt::format("{} of log {}", name, group + 1), as_logged, {}, {}, true};
    for (std::size_t g = 0; g < one.as_logged.added.size(); ++g) {
      if (g != group) one.as_logged.added[g].setZero();
    }
    return one;
  }
};

// Nothing where there is no number without the input.
std::optional<InputEffect> effect_of(const Doubted& doubted, int input) {
  auto as_logged = doubted.as_logged(input);
  if (!as_logged) return std::nullopt;
  const System& system = *doubted.posterior.prior().system;
  InputEffect effect{input, system.inputs()[static_cast<std::size_t>(input)], *std::move(as_logged)};
  for (const int rows : {1, -1, 2, -2, 4, -4, 8, -8, most_late, -most_late}) {
    if (doubted.taken.empty()) break;
    std::optional<Hypothesis> late = doubted.late(input, rows);
    if (!late) break;
    // rows in no order, or too far apart to tell
    if (rows == 1 && !(size_of(late->change) < size_of(less_means(effect.as_logged.added)))) break;
    effect.late.push_back(*std::move(late));
  }
  return effect;
}

// What the data would have an input do, the likeliest first; none where they have nothing against it.
std::vector<Hypothesis> doubts_of(const InputEffect& input, const std::vector<Observations>& observations, double as_logged,
                                  const Cost& cost) {
  std::vector<Hypothesis> doubts;
  const InputFactor one = likeliest_factor(observations, input.as_logged.added, as_logged, cost);
  if (one.is_other_than_one() && one.gain > least_gain) doubts.push_back(input.as_logged.times(one));
  for (const std::vector<Hypothesis>* const some : {&input.late, &input.exchanged}) {
    for (const Hypothesis& other : *some) {
      const double gain = as_logged - cost(without_change(observations, other.change, 1));
      if (gain <= least_gain) continue;
      doubts.push_back(other);
      doubts.back().gain = gain;
    }
  }
  std::ranges::sort(doubts, std::ranges::greater(), &Hypothesis::gain);
  return doubts;
}

// A hypothesis where latents and noise were fitted anew, since they take up what an input does otherwise.
struct Explanation {
  Hypothesis hypothesis;
  double left = 0;  // cost of the data under it
  bool is_sound = false;
};

// The likeliest delay or factor of all, where it is another one than the hypothesis has.
std::optional<Hypothesis> better_one(const Doubted& doubted, const std::vector<Observations>& observations,
                                     const Hypothesis& hypothesis, double left, const Cost& cost) {
  std::optional<Hypothesis> better;
  if (hypothesis.kind == Hypothesis::Kind::factor) {
    const InputFactor one = likeliest_factor(observations, hypothesis.added, cost(observations), cost);
    if (std::abs(one.factor - hypothesis.factor) > one.stddev) better = hypothesis.times(one);
  }
  for (int rows = -most_late; rows <= most_late && hypothesis.kind == Hypothesis::Kind::late; ++rows) {
    if (rows == 0 || rows == hypothesis.rows) continue;
    std::optional<Hypothesis> other = doubted.late(hypothesis.input, rows);
    if (!other) continue;
    other->gain = left - cost(without_change(observations, other->change, 1));
    if (other->gain > (better ? better->gain : 0)) better = std::move(other);
  }
  return better;
}

// Whether data under a hypothesis are as those of a sound model: nearly all that is left of the misfit is what noise gives. Latents
// that follow a wrong model give that too; but then the data as logged are hardly less likely, or others seem wrong beside it.
bool is_sound(const Doubted& doubted, const std::vector<Observations>& observations, const std::vector<Observations>& mended,
              const std::vector<InputEffect>& inputs, const Hypothesis& hypothesis, const ModelValues& values, const Cost& cost) {
  constexpr double half_row = 0.25;  // of the gain, that an input leaves which acts between two rows
  constexpr double others = 0.1;     // of the gain: of several wrong inputs one is mended at a time
  constexpr double near = 0.25;      // from a factor of 1
  constexpr double large = 0.5;      // of a factor less 1: smaller ones mend something of many wrong models
  const double left = cost(mended), gain = cost(observations) - left, by_noise = n_measured(observations) / 2;
  const bool is_factor = hypothesis.kind == Hypothesis::Kind::factor;
  const double rest = hypothesis.input == known_force ? 0 : (is_factor ? others : half_row) * gain;
  const auto misfit = misfit_of(doubted.posterior.prior(), cost, values, mended);
  if (!misfit || !(*misfit < std::max(2 * by_noise, rest))) return false;
  const InputFactor factor = likeliest_factor(mended, hypothesis.added, left, cost);
  if (is_factor) {
    const double much = std::abs(hypothesis.factor - 1) > large ? 1 : 4;
    return InputFactor{hypothesis.factor, factor.stddev}.is_other_than_one() && gain > much * by_noise;
  }
  if (!(std::abs(factor.factor - 1) < near) || std::abs(hypothesis.rows) == most_late) return false;
  if (!(gain > by_noise)) return false;
  return gain > 4 * by_noise || std::ranges::all_of(inputs, [&](const InputEffect& other) {
           return other.input == hypothesis.input || doubts_of(other, mended, left, cost).empty();
         });
}

// The hypothesis of its kind that is the likeliest under what is fitted to it. Nothing where none is.
std::optional<Explanation> fitted_anew(const Doubted& doubted, const std::vector<Observations>& observations,
                                       const std::vector<InputEffect>& inputs, Hypothesis hypothesis) {
  constexpr int most_fits = 4;
  for (int k = 0; k < most_fits; ++k) {
    const std::vector<Observations> mended = without_change(observations, hypothesis.change, 1);
    const ModelValues values = doubted.fitted_values(mended);
    const Cost cost = cost_under(doubted.posterior.prior(), values);
    const double left = cost(mended);
    if (auto better = better_one(doubted, observations, hypothesis, left, cost)) {
      // a factor may change with each fit by more than its deviation
      if (k + 1 < most_fits || hypothesis.kind != Hypothesis::Kind::factor) {
        hypothesis = *std::move(better);
        continue;
      }
    }
    const bool sound = is_sound(doubted, observations, mended, inputs, hypothesis, values, cost);
    return Explanation{std::move(hypothesis), left, sound};
  }
  return std::nullopt;
}

// What explains the data that deny an input: of a delay, a factor, an exchange with another input, and a factor of the known force
// that which leaves the least cost. Nothing where that is not sound.
std::optional<Hypothesis> explanation_of(const Doubted& doubted, const std::vector<Observations>& observations,
                                         const InputEffect& input, std::vector<Hypothesis> doubts,
                                         const std::vector<InputEffect>& others, double as_logged, const Cost& cost) {
  for (const InputEffect& other : others) {
    if (input.is_of_one_log || other.is_of_one_log || other.input == input.input) continue;
    if (input.input == known_force || other.input == known_force) {
      const std::vector<Hypothesis> of_other = doubts_of(other, observations, as_logged, cost);
      if (!of_other.empty()) doubts.push_back(of_other.front());
      continue;
    }
    if (std::ranges::find(doubts, other.input, &Hypothesis::other) != doubts.end()) continue;
    std::optional<Hypothesis> exchanged = doubted.exchanged(input.input, other.input);
    if (!exchanged) continue;
    exchanged->gain = as_logged - cost(without_change(observations, exchanged->change, 1));
    if (exchanged->gain > least_gain) doubts.push_back(*std::move(exchanged));
  }
  std::ranges::sort(doubts, std::ranges::greater(), &Hypothesis::gain);
  std::optional<Explanation> best;
  bool is_late_asked = false;
  for (const Hypothesis& one : doubts) {
    if (one.kind == Hypothesis::Kind::late && std::exchange(is_late_asked, true)) continue;
    try {
      std::optional<Explanation> explanation = fitted_anew(doubted, observations, others, one);
      if (explanation && (!best || explanation->left < best->left)) best = std::move(explanation);
    } catch (const NumericalError&) {
      continue;  // what cannot be fitted explains nothing
    }
  }
  if (!best || !best->is_sound) return std::nullopt;
  best->hypothesis.gain = as_logged - best->left;
  return std::move(best->hypothesis);
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

// A row of the states of each log.
std::vector<RowVectorXd> values_of(const std::vector<Observations>& observations, int row) {
  std::vector<RowVectorXd> values;
  for (const Observations& group : observations) values.emplace_back(group.states().row(row));
  return values;
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
      resting < 0 ? fmt::format("A unit, a sign or a parameter differs {}, or something acts that is not in the model",
                                posterior.observations().size() == 2 ? "in one of the two" : "there")
                  : fmt::format("Its input {} is {:.4g} in every row: was it logged?",
                                posterior.prior().system->inputs()[static_cast<std::size_t>(resting)],
                                posterior.observations()[log].states()(posterior.prior().system->layout().u(resting), 0));
  notes.push_back(fmt::format("warning: log {} contradicts the others: separate functions raise the log likelihood by {:.2g}. {}",
                              log + 1, gain, cause));
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

void note_unexplained(const std::vector<std::string>& inputs, double gain, std::vector<std::string>& notes) {
  if (inputs.empty()) return;
  const bool is_one = inputs.size() == 1;
  notes.push_back(fmt::format(
      "warning: the model does not explain what the input{} {} {}, by {:.2g} in log likelihood, and no delay, factor or exchange "
      "of inputs would. The force, an inertia or a coordinate is wrong, or something acts that is not in the model",
      is_one ? "" : "s", fmt::join(inputs, ", "), is_one ? "does" : "do", gain));
}

// What the data deny most: a log, else an input; neither where nothing stands out.
struct MostDoubtful {
  double gain = least_gain;
  std::optional<std::size_t> input = {}, log = {};
  std::vector<Hypothesis> doubts = {};  // of the input
};

MostDoubtful most_doubtful(const std::vector<InputEffect>& inputs, const std::vector<Observations>& observations, bool asks_logs,
                           double as_logged, const Cost& cost) {
  MostDoubtful most;
  for (std::size_t k = 0; k < inputs.size(); ++k) {
    std::vector<Hypothesis> of_one = doubts_of(inputs[k], observations, as_logged, cost);
    if (!of_one.empty() && of_one.front().gain > most.gain) most = {of_one.front().gain, k, {}, std::move(of_one)};
  }
  for (std::size_t g = 0; g < observations.size() && asks_logs; ++g) {
    if (!can_contradict(observations, g)) continue;
    const double of_one = gain_of_contradiction(observations, g, as_logged, cost);
    if (!(of_one > most.gain)) continue;
    most.gain = of_one;
    most.log = g;
  }
  return most;
}

// What is said of the inputs that the data deny.
struct Claims {
  struct Claim {
    std::string name;
    Hypothesis explanation;
    double gain;  // before latents and noise were fitted anew
  };
  std::vector<Claim> explained = {};
  std::vector<std::string> unexplained = {};
  double unexplained_gain = 0;
  double least = 0;  // gain of a claim: what is wrong elsewhere may be all that speaks for one

  void leave_unexplained(const Claim& claim) {
    if (claim.explanation.input == known_force) return;
    unexplained.push_back(claim.name);
    unexplained_gain = std::max(unexplained_gain, claim.gain);
  }

  Doubts add_notes(const std::vector<std::string>& held, std::vector<std::string>& notes) {
    Doubts noted;
    for (const Claim& claim : explained) {
      if (claim.gain < least) {
        leave_unexplained(claim);
        continue;
      }
      const std::string instead =
          held.empty() ? "" : fmt::format("; or {}, held by a bound or a prior, is wrong", fmt::join(held, ", "));
      notes.push_back(
          fmt::format("warning: the data contradict the {}: they are most likely if {}, by {:.2g} in log likelihood. {}",
                      (claim.explanation.input == known_force ? "" : "input ") + claim.name, claim.explanation.text,
                      claim.explanation.gain, claim.explanation.cause + instead));
      if (claim.explanation.kind == Hypothesis::Kind::late) noted.delays.push_back(notes.back());
    }
    note_unexplained(unexplained, unexplained_gain, notes);
    if (!unexplained.empty()) noted.unexplained = notes.back();
    return noted;
  }
};

// A wrong one makes others seem wrong: the most doubtful first, the others beside it as it should be.
Doubts note_doubts(const Doubted& doubted, std::vector<Observations> observations, std::vector<InputEffect> inputs,
                   bool asks_logs, std::vector<std::string>& notes) {
  const Cost cost = cost_under(doubted.posterior.prior(), doubted.posterior.values());
  constexpr double several = 10;  // times what stays unexplained
  Claims claims;
  for (;;) {
    const double as_logged = cost(observations);
    if (std::isinf(as_logged)) throw NumericalError("some of the rows alone have no posterior mean");
    const MostDoubtful most = most_doubtful(inputs, observations, asks_logs, as_logged, cost);
    if (most.log) {
      note_contradiction(doubted.posterior, *most.log, most.gain, notes);
      observations = with_log(observations, *most.log, /*alone=*/false);
      continue;
    }
    if (!most.input) break;
    const InputEffect input = inputs[*most.input];
    const auto explanation = explanation_of(doubted, observations, input, most.doubts, inputs, as_logged, cost);
    const int about = explanation ? explanation->input : input.input;
    if (explanation) {
      const std::string& name = about == input.input ? input.name : std::ranges::find(inputs, about, &InputEffect::input)->name;
      claims.explained.push_back({name, *explanation, most.gain});
    } else {
      claims.leave_unexplained({input.name, most.doubts.front(), most.gain});
      claims.least = std::max(claims.least, several * most.gain);
    }
    if (explanation || input.input != known_force)
      observations = without_change(observations, explanation ? explanation->change : most.doubts.front().change, 1);
    // what else is said of it is said of an input that acts so
    const auto is_said = [&](int one) { return one == about || (explanation && one == explanation->other); };
    std::erase_if(inputs, [&](const InputEffect& one) { return is_said(one.input); });
    for (InputEffect& one : inputs) std::erase_if(one.exchanged, [&](const Hypothesis& with) { return is_said(with.other); });
  }
  return claims.add_notes(doubted.held, notes);
}

}  // namespace

Doubts add_doubts(const Posterior& posterior, const std::vector<std::vector<int>>& lines, const std::vector<std::string>& held,
                  const FittedValues& fitted_values, bool has_wrong_rate, std::vector<std::string>& notes) {
  constexpr int enough = 1000, fewest = 10;  // values: a sign or a unit needs no more; states
  constexpr std::size_t most_logs = 10;      // each of which is asked by itself
  const Prior& prior = posterior.prior();
  const System& system = *prior.system;
  const StateLayout layout = system.layout();
  const std::vector<Observations>& all = posterior.observations();
  const auto any = [&](const auto& is) { return std::any_of(all.begin(), all.end(), is); };
  if (prior.reference || n_states(all) < fewest || any([](const auto& group) { return bool(group.view().other_system); }))
    return {};
  const bool of_windows = has_sums(all);
  const bool asks = !has_wrong_rate && (!of_windows || (!prior.is_nonlinear() && n_states(all) * system.nq() <= 2 * enough));
  const bool asks_logs = asks && !of_windows && all.size() > 1 && all.size() <= most_logs;
  const int n_some = enough / system.nq();
  const std::vector<Observations> some = of_windows ? all : evenly(all, n_some);
  // of many states some are kept, which do not follow each other
  const bool are_all = posterior.n_states() == n_states(all);
  const std::optional<int> apart = lines_apart(lines);
  const auto taken = are_all && apart && !of_windows ? evenly_taken(all, n_some) : std::vector<std::vector<int>>();
  const std::vector<bool> force = system.reads(SystemPart::force), elsewhere = system.reads(SystemPart::mechanics);
  // a latent that reads an input takes up what it does otherwise
  const auto is_learned = [&](int row) {
    return std::any_of(prior.latents.begin(), prior.latents.end(), [&](const Latent& one) { return one.features->reads(row); });
  };
  const Doubted doubted{posterior, some, taken, held, fitted_values, apart.value_or(1)};
  std::vector<InputEffect> inputs;
  bool has_far_values = false;
  for (int j = 0; j < layout.nu && prior.mean == Prior::Mean::force; ++j) {
    const int row = layout.u(j);
    if (!force[static_cast<std::size_t>(row)]) continue;
    const double first = all.front().n_data() > 0 ? all.front().states()(row, 0) : 0;
    if (!any([&](const auto& group) { return (group.states().row(row).array() != first).any(); })) {
      notes.push_back(fmt::format("the input {} is {:.4g} in every row: was it logged?",
                                  system.inputs()[static_cast<std::size_t>(j)], first));
    } else if (const auto far = far_values_text(system.inputs()[static_cast<std::size_t>(j)], values_of(all, row), lines)) {
      notes.push_back("warning: " + *far);
      has_far_values = true;
    } else if (asks && !elsewhere[static_cast<std::size_t>(row)] && !is_learned(row)) {
      std::optional<InputEffect> effect = effect_of(doubted, j);
      if (!effect) continue;
      for (const InputEffect& before : inputs) {
        if (auto exchanged = doubted.exchanged(j, before.input)) effect->exchanged.push_back(*std::move(exchanged));
      }
      inputs.push_back(*std::move(effect));
    }
  }
  // they make all else look wrong
  if (has_far_values) return {};
  const std::size_t n_inputs = inputs.size();
  for (std::size_t k = 0; k < n_inputs && asks_logs; ++k) {
    for (std::size_t g = 0; g < all.size(); ++g) {
      if (all[g].view().is_of_ddq()) inputs.push_back(inputs[k].in_log(g));
    }
  }
  if (!inputs.empty()) {
    if (auto effect = doubted.force()) inputs.push_back({known_force, "known force without inputs", *std::move(effect)});
  }
  std::vector<Observations> observations = some;
  if (asks_logs) note_lost_inputs(posterior, observations, fitted_values, notes);
  return note_doubts(doubted, std::move(observations), std::move(inputs), asks_logs, notes);
}

}  // namespace gp2
