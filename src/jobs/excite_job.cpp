#include "gp2/jobs/excite_job.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/lapack.hpp"
#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "base/random.hpp"
#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "training/evolution.hpp"
#include "training/expected_information.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double boundless = std::numeric_limits<double>::infinity();
constexpr int region_size = 100;
constexpr int most_steps_per_row = 10;  // of the integrator: a motion that takes more is too fast for its rows

// ---------------------------------------------------------------- what is asked

/// A limit and the row of [q; dq; t; u; ddq] that it is of.
struct Limit {
  std::string name;
  double lower = 0, upper = 0;
  Index row = 0;

  [[nodiscard]] double middle() const { return (lower + upper) / 2; }
  [[nodiscard]] double half_width() const { return (upper - lower) / 2; }
  // how far a value is beyond it; negative within
  [[nodiscard]] double excess(double value) const { return std::max(lower - value, value - upper); }
};

void require_options(const ExciteRequest& request) {
  if (!(request.duration > 0) || !std::isfinite(request.duration)) {
    throw InputError(fmt::format("`duration`: must be positive, got {}", request.duration));
  }
  if (request.n_harmonics < 1) throw InputError(fmt::format("`harmonics`: must be at least 1, got {}", request.n_harmonics));
  constexpr int rows_per_harmonic = 4, most_rows = 1'000'000;
  if (request.n_rows / rows_per_harmonic < request.n_harmonics || request.n_rows > most_rows) {
    throw InputError(fmt::format("`rows`: must be at least four for each of the {} harmonics and at most {}, got {}",
                                 request.n_harmonics, most_rows, request.n_rows));
  }
  if (request.n_motions < 1) throw InputError(fmt::format("`motions`: must be at least 1, got {}", request.n_motions));
  require_threads(request.threads);
}

void require_order(const std::string& option, const std::string& name, const std::pair<double, double>& range,
                   bool may_be_equal) {
  const auto [lower, upper] = range;
  if (std::isfinite(lower) && std::isfinite(upper) && (lower < upper || (may_be_equal && lower == upper))) return;
  throw InputError(fmt::format("{}: {} = {}:{} must be finite, the lower limit first", option, name, lower, upper));
}

std::vector<Limit> input_limits(const Model& model, const Limits& given) {
  const System& system = *model.system;
  const std::vector<std::string> inputs = driving_inputs(model);
  if (inputs.empty()) {
    throw InputError(fmt::format("excite: '{}' has no inputs to drive it", system.name()));
  }
  for (const auto& [name, range] : given) {
    if (std::find(inputs.begin(), inputs.end(), name) == inputs.end()) {
      if (std::ranges::count(system.inputs(), name) > 0)
        throw InputError(fmt::format("`inputs_within`: '{}' is a contact, which the motion makes: leave it out", name));
      throw InputError(
          fmt::format("`inputs_within`: '{}' is no input of '{}'; there are: {}", name, system.name(), fmt::join(inputs, ", ")));
    }
    require_order("`inputs_within`", name, range, /*may_be_equal=*/true);
  }
  std::vector<Limit> limits;
  for (const std::string& name : inputs) {
    const auto found = given.find(name);
    const Index input = std::ranges::find(system.inputs(), name) - system.inputs().begin();
    if (found == given.end()) {
      throw InputError(
          fmt::format("`inputs_within`: no limits of '{}'; give its lowest and highest value, 0:0 to leave it out", name));
    }
    limits.push_back({name, found->second.first, found->second.second, system.layout().u(0) + input});
  }
  if (std::all_of(limits.begin(), limits.end(), [](const Limit& one) { return one.half_width() == 0; })) {
    throw InputError("`inputs_within`: all inputs are fixed by their limits");
  }
  return limits;
}

std::vector<Limit> state_limits(const System& system, const Limits& given) {
  const StateLayout layout = system.layout();
  std::vector<std::string> names = system.state_names();
  names.resize(static_cast<std::size_t>(layout.t()));
  const std::vector<std::string> accelerations = system.acceleration_names();
  names.insert(names.end(), accelerations.begin(), accelerations.end());
  std::vector<Limit> limits;
  for (const auto& [name, range] : given) {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) {
      throw InputError(fmt::format("`within`: '{}' is no coordinate, velocity or acceleration of '{}'; there are: {}", name,
                                   system.name(), fmt::join(names, ", ")));
    }
    require_order("`within`", name, range, /*may_be_equal=*/false);
    const Index row = found - names.begin();
    limits.push_back({name, range.first, range.second, row < layout.t() ? row : row - layout.t() + layout.size()});
  }
  return limits;
}

void require_start_within(const VectorXd& start, const std::vector<Limit>& limits) {
  for (const Limit& limit : limits) {
    if (limit.row >= start.size()) continue;
    const double value = start[limit.row];
    if (limit.excess(value) <= 0) continue;
    throw InputError(fmt::format("`start`: {} = {:.6g} is outside of its limits {}:{} in `within`", limit.name, value,
                                 limit.lower, limit.upper));
  }
}

// ---------------------------------------------------------------- motions

/// Inputs middle + half width tanh(s) at fixed times, s the Fourier series of given coefficients; 0 those without limits.
class InputFamily {
 public:
  InputFamily(std::vector<Limit> limits, StateLayout layout, VectorXd times, int n_harmonics, std::vector<Actuator> actuators)
      : limits_(std::move(limits)),
        layout_(layout),
        times_(std::move(times)),
        actuators_(std::move(actuators)),
        basis_(1 + 2 * n_harmonics, times_.size()) {
    const double duration = times_[times_.size() - 1] - times_[0];
    const Eigen::ArrayXd phase = 2 * std::numbers::pi / duration * (times_.array() - times_[0]);
    basis_.row(0).setOnes();
    for (int k = 1; k <= n_harmonics; ++k) {
      basis_.row(2 * k - 1) = (k * phase).cos();
      basis_.row(2 * k) = (k * phase).sin();
    }
  }

  // of the inputs whose limits differ
  [[nodiscard]] Index n_coefficients() const {
    return basis_.rows() * std::count_if(limits_.begin(), limits_.end(), [](const Limit& one) { return one.half_width() > 0; });
  }
  // coefficients of a size at which the root mean square of s is 1
  [[nodiscard]] double unit() const { return 1 / std::sqrt(static_cast<double>(basis_.rows() + 1) / 2); }

  /// (nu × times)
  [[nodiscard]] MatrixXd commands(const VectorXd& coefficients) const {
    MatrixXd values = MatrixXd::Zero(layout_.nu, times_.size());
    Index first = 0;
    for (const Limit& limit : limits_) {
      const Index j = limit.row - layout_.u(0);
      values.row(j).setConstant(limit.middle());
      if (limit.half_width() == 0) continue;
      const auto s = (coefficients.segment(first, basis_.rows()).transpose() * basis_).array();
      values.row(j) = (limit.middle() + limit.half_width() * s.tanh()).max(limit.lower).min(limit.upper);
      first += basis_.rows();
    }
    return values;
  }
  /// What acts.
  [[nodiscard]] InputSignal at(const VectorXd& coefficients) const { return {times_, commands(coefficients), actuators_}; }

 private:
  std::vector<Limit> limits_;
  StateLayout layout_;
  VectorXd times_;
  std::vector<Actuator> actuators_;
  MatrixXd basis_;
};

/// A motion that was tried.
struct Candidate {
  VectorXd coefficients;
  Trajectory motion = {};    // empty where it could not be integrated
  std::string failure = {};  // why it could not
  double violation = 0;      // by how many half widths it is beyond a limit, at most; ∞ where it could not be integrated
  double merit = 0;          // of one within the limits; less is better
  ExpectedInformation::Known known = {};

  [[nodiscard]] bool is_within() const { return violation == 0; }
};

bool is_better(const Candidate& a, const Candidate& b) {
  return std::pair(a.violation, a.merit) < std::pair(b.violation, b.merit);
}

// q, dq, t, u as commanded, and ddq
MatrixXd quantities(const Trajectory& motion) {
  MatrixXd all(motion.states.rows() + motion.accelerations.rows(), motion.states.cols());
  all << motion.states.topRows(motion.states.rows() - motion.commands.rows()), motion.commands, motion.accelerations;
  return all;
}

/// The search of one request.
class Search {
 public:
  using Tell = std::function<void(const ExciteProgress&)>;

  Search(SimulateJob motion, const ExpectedInformation& information, InputFamily inputs, std::vector<Limit> limits,
         ExcitationTarget target, const ExciteRequest& request, const std::atomic<bool>* stop)
      : motion_(std::move(motion)),
        information_(information),
        inputs_(std::move(inputs)),
        limits_(std::move(limits)),
        is_of_parameters_(target == ExcitationTarget::parameters),
        request_(request),
        stop_(stop),
        n_threads_(thread_count(request.threads)) {}

  void run(const Tell& tell) {
    draw();
    require_motion();
    choose_region();
    judge(random_);
    best_ = *std::min_element(random_.begin(), random_.end(), is_better);
    improve(tell);
  }

  [[nodiscard]] const Candidate& best() const { return best_; }
  [[nodiscard]] const std::vector<Candidate>& random() const { return random_; }
  [[nodiscard]] const ExpectedInformation::Known& now() const { return now_; }
  [[nodiscard]] int n_motions() const { return n_motions_; }
  [[nodiscard]] int n_failed() const { return n_failed_; }
  [[nodiscard]] double seconds() const { return std::chrono::duration<double>(Clock::now() - begin_).count(); }

  // by what factor deviations fall
  [[nodiscard]] double factor(const Candidate& one) const {
    if (!one.is_within()) return not_a_number;
    if (!is_of_parameters_) return std::sqrt(one.known.region.sum() / now_.region.sum());
    return std::exp((one.known.log_volume - now_.log_volume) / static_cast<double>(now_.stddev.size()));
  }

 private:
  using Clock = std::chrono::steady_clock;

  [[nodiscard]] Candidate integrated(VectorXd coefficients) const {
    SimulateJob job = motion_;
    job.options.inputs = inputs_.at(coefficients);
    Candidate out{.coefficients = std::move(coefficients), .violation = boundless};
    try {
      out.motion = run_simulation(job, stop_).front();
    } catch (const NumericalError& error) {
      if (stop_ == nullptr || !*stop_) out.failure = error.what();
      return out;
    }
    out.violation = 0;
    const MatrixXd all = quantities(out.motion);
    for (const Limit& limit : limits_) {
      for (const double value : all.row(limit.row)) {
        out.violation = std::max(out.violation, limit.excess(value) / limit.half_width());
      }
    }
    return out;
  }

  void count(const std::vector<Candidate>& tried) {
    n_motions_ += static_cast<int>(tried.size());
    n_failed_ +=
        static_cast<int>(std::count_if(tried.begin(), tried.end(), [](const auto& one) { return !one.failure.empty(); }));
  }

  // Random series, each made smaller and smaller until its motion is within the limits.
  void draw() {
    constexpr double largest = 2, smaller = 0.7;
    constexpr int most_sizes = 20;
    std::vector<std::vector<Candidate>> tried(static_cast<std::size_t>(std::clamp(request_.n_motions / 40, 1, 50)));
    parallel_for(static_cast<int>(tried.size()), n_threads_, [&](int k, int) {
      RandomStream random(request_.seed, static_cast<std::uint64_t>(k) + 1);
      VectorXd coefficients(inputs_.n_coefficients());
      for (double& one : coefficients) one = largest * inputs_.unit() * random.normal();
      std::vector<Candidate>& mine = tried[static_cast<std::size_t>(k)];
      for (int k_size = 0; k_size < most_sizes && !is_set(stop_); ++k_size, coefficients *= smaller) {
        mine.push_back(integrated(coefficients));
        if (mine.back().is_within()) break;
      }
    });
    require_not_stopped();
    for (std::vector<Candidate>& of_one : tried) {
      count(of_one);
      random_.push_back(std::move(*std::min_element(of_one.begin(), of_one.end(), is_better)));
    }
  }

  void require_not_stopped() const {
    if (is_set(stop_)) throw NumericalError("stopped on request before there was a motion");
  }

  void require_motion() const {
    if (std::any_of(random_.begin(), random_.end(), [](const Candidate& one) { return one.failure.empty(); })) return;
    throw NumericalError(fmt::format("excite: none of {} random motions could be integrated; of the last: {}", n_motions_,
                                     random_.back().failure));
  }

  // Some states of the random motions: where motions within the limits go.
  void choose_region() {
    region_.resize(motion_.start.size(), 0);
    if (!is_of_parameters_) {
      const bool any = std::any_of(random_.begin(), random_.end(), [](const Candidate& one) { return one.is_within(); });
      std::vector<const Trajectory*> motions;
      for (const Candidate& one : random_) {
        if (one.is_within() || (!any && one.failure.empty())) motions.push_back(&one.motion);
      }
      region_.resize(Eigen::NoChange, region_size);
      // evenly over all rows of all of them, one after the other
      const double stride = static_cast<double>(std::ssize(motions)) * request_.n_rows / region_size;
      for (Index k = 0; k < region_size; ++k) {
        const auto at = static_cast<Index>((static_cast<double>(k) + 0.5) * stride);
        region_.col(k) = motions[static_cast<std::size_t>(at / request_.n_rows)]->states.col(at % request_.n_rows);
      }
    }
    now_ = information_.after(MatrixXd(region_.rows(), 0), region_);
  }

  void judge(std::vector<Candidate>& candidates) const {
    parallel_for(static_cast<int>(candidates.size()), n_threads_, [&](int k, int) {
      Candidate& one = candidates[static_cast<std::size_t>(k)];
      if (!one.is_within()) return;
      one.known = information_.after(one.motion.states, region_);
      one.merit = is_of_parameters_ ? one.known.log_volume : one.known.region.sum();
    });
  }

  // From the best random motion on; a motion outside of the limits is worse than any within, and the worse the farther out.
  void improve(const Tell& tell) {
    EvolutionStrategy strategy(best_.coefficients, best_.coefficients.norm() / std::sqrt(best_.coefficients.size()) / 2,
                               request_.seed);
    while (n_motions_ < request_.n_motions) {
      const MatrixXd points = strategy.draw();
      std::vector<Candidate> generation(static_cast<std::size_t>(points.cols()));
      parallel_for(static_cast<int>(generation.size()), n_threads_,
                   [&](int k, int) { generation[static_cast<std::size_t>(k)] = integrated(points.col(k)); });
      judge(generation);
      if (is_set(stop_)) return;  // what was cut short is worth nothing
      count(generation);
      std::vector<int> ranking(generation.size());
      std::iota(ranking.begin(), ranking.end(), 0);
      const auto at = [&](int k) -> Candidate& { return generation[static_cast<std::size_t>(k)]; };
      std::stable_sort(ranking.begin(), ranking.end(), [&](int k, int l) { return is_better(at(k), at(l)); });
      strategy.learn(ranking);
      if (is_better(at(ranking[0]), best_)) best_ = std::move(at(ranking[0]));
      if (tell) tell({n_motions_, request_.n_motions, factor(best_), seconds()});
    }
  }

  SimulateJob motion_;
  const ExpectedInformation& information_;
  InputFamily inputs_;
  std::vector<Limit> limits_;  // of the motion
  bool is_of_parameters_;
  const ExciteRequest& request_;
  const std::atomic<bool>* stop_;
  int n_threads_;
  Clock::time_point begin_ = Clock::now();

  MatrixXd region_;
  ExpectedInformation::Known now_;
  std::vector<Candidate> random_;
  Candidate best_;
  int n_motions_ = 0, n_failed_ = 0;
};

// ---------------------------------------------------------------- what is told

void require_within(const Candidate& best, const std::vector<Limit>& limits, int n_motions) {
  if (best.is_within()) return;
  const MatrixXd all = quantities(best.motion);
  const Limit* worst = nullptr;
  double value = 0, violation = 0;
  for (const Limit& limit : limits) {
    for (const double one : all.row(limit.row)) {
      if (limit.excess(one) <= violation * limit.half_width()) continue;
      violation = limit.excess(one) / limit.half_width();
      value = one;
      worst = &limit;
    }
  }
  throw InputError(fmt::format(
      "`within`: none of {} motions stays within the limits; the nearest takes {} to {:.6g}, {:.3g} beyond {}:{}. Widen "
      "that limit, shorten `duration`, or `start` elsewhere",
      n_motions, worst->name, value, worst->excess(value), worst->lower, worst->upper));
}

VectorXd region_stddev(const ExpectedInformation::Known& known, const VectorXd& noise_stddev) {
  return noise_stddev.cwiseProduct(known.region.rowwise().mean().cwiseSqrt());
}

// Deviations of several quantities, which `of` takes from what is known.
template <typename Of>
void add_known(const Search& search, const std::vector<std::string>& names, const Of& of, std::vector<Excitation::Known>& out) {
  const VectorXd now = of(search.now()), after = of(search.best().known);
  for (std::size_t k = 0; k < names.size(); ++k) {
    const auto at = static_cast<Index>(k);
    std::vector<double> random;
    for (const Candidate& one : search.random()) {
      if (one.is_within()) random.push_back(of(one.known)[at]);
    }
    out.push_back({names[k], now[at], after[at], random.empty() ? not_a_number : median(std::move(random))});
  }
}

std::vector<Excitation::LimitUse> limit_uses(const Trajectory& motion, const std::vector<Limit>& limits) {
  const MatrixXd all = quantities(motion);
  std::vector<Excitation::LimitUse> uses;
  for (const Limit& limit : limits) {
    const auto row = all.row(limit.row);
    const double lowest = row.minCoeff(), highest = row.maxCoeff(), half = limit.half_width();
    const double share = half > 0 ? 1 + std::max(limit.excess(lowest), limit.excess(highest)) / half : 0;
    uses.push_back({limit.name, limit.lower, limit.upper, lowest, highest, share});
  }
  return uses;
}

ExcitationTarget target_of(const ExciteRequest& request, const ExpectedInformation& information) {
  const bool any = !information.parameters().empty();
  if (request.target == ExcitationTarget::automatic) {
    return any ? ExcitationTarget::parameters : ExcitationTarget::accelerations;
  }
  if (request.target == ExcitationTarget::parameters && !any) {
    throw InputError(
        "`for=parameters`: the fit estimates no parameters; mark some with estimate = true in the model, or ask "
        "`for=accelerations`");
  }
  return request.target;
}

}  // namespace

std::vector<Option> options(ExciteRequest& request) {
  return {
      {"for",
       choice(request.target, {{"auto", ExcitationTarget::automatic},
                               {"parameters", ExcitationTarget::parameters},
                               {"accelerations", ExcitationTarget::accelerations}}),
       "",
       "what the motion should determine; parameters: those that the fit estimated (D-optimal); accelerations: those along "
       "motions within the limits; auto: parameters if any are estimated",
       "", "target"},
      {"rows", &request.n_rows, "N", "number of measurements along the motion, evenly spaced in time", "", "n_rows"},
      {"harmonics", &request.n_harmonics, "K", "number of frequencies of each input: 1/duration … K/duration [Hz]", "",
       "n_harmonics"},
      {"motions", &request.n_motions, "M", "number of motions to try, rounded up to whole generations", "", "n_motions"},
      {"seed", &request.seed, "S", "random seed of the search"},
      columns_option(request.columns, "columns by other names, if `start` is a log"),
      threads_option(request.threads),
  };
}

Excitation excite(const Model& model, const Posterior& posterior, const std::vector<Hyperparameter>& hyperparameters,
                  const ExciteRequest& request, const std::function<void(const ExciteProgress&)>& progress,
                  const std::atomic<bool>* stop) {
  return excite({&model, model.actuators, nullptr, posterior.prior()}, posterior, hyperparameters, request, progress, stop);
}

Excitation excite(const FitSystem& driven, const Posterior& posterior, const std::vector<Hyperparameter>& hyperparameters,
                  const ExciteRequest& request, const std::function<void(const ExciteProgress&)>& progress,
                  const std::atomic<bool>* stop) {
  const Model& model = *driven.model;
  const System& system = *model.system;
  require_options(request);
  if (posterior.prior().reference) throw InputError("excite: a baseline knows no constraints, so it has no motion to plan");
  if (observed_rows(posterior).empty()) {
    throw InputError("excite: the fit observed no accelerations, so their noise is unknown");
  }
  const std::vector<Limit> inputs = input_limits(model, request.inputs_within), limits = state_limits(system, request.within);

  const lapack::SingleThread single_thread;
  const ExpectedInformation information(posterior.prior(), posterior.observations(), hyperparameters, driven.other_system,
                                        thread_count(request.threads), stop);
  Excitation out;
  out.target = target_of(request, information);
  SimulateRequest of_motion;
  of_motion.start = request.start;
  of_motion.columns = request.columns;
  const double t_start = start_time(model, request.start, request.columns).value_or(0);
  of_motion.times = VectorXd::LinSpaced(request.n_rows, t_start, t_start + request.duration);
  of_motion.max_steps = most_steps_per_row * request.n_rows;
  SimulateJob motion = prepare_simulation(driven, information.posterior(), of_motion);
  motion.options.max_steps_advice =
      fmt::format("use more `rows` ({} steps of the integrator are allowed per row), or smaller limits", most_steps_per_row);
  motion.motions.front().multipliers = nullptr;
  require_start_within(motion.start, limits);
  out.notes = motion.notes;
  if (posterior.n_states() > n_states(posterior.observations())) {
    out.notes.push_back(fmt::format("present standard deviations are computed from {} of the {} rows of the fit",
                                    n_states(posterior.observations()), posterior.n_states()));
  }
  if (std::ranges::any_of(driven.actuators, &Actuator::is_estimated)) {
    out.notes.emplace_back("delays and lags count as known: what their errors add to those of parameters is left out");
  }

  Search search(std::move(motion), information,
                InputFamily(inputs, system.layout(), of_motion.times, request.n_harmonics, driven.actuators), limits, out.target,
                request, stop);
  search.run(progress);
  require_within(search.best(), limits, search.n_motions());

  out.motion = search.best().motion;
  out.factor = search.factor(search.best());
  std::vector<double> random;
  for (const Candidate& one : search.random()) {
    if (one.is_within()) random.push_back(search.factor(one));
  }
  out.n_random = static_cast<int>(random.size());
  out.random_factor = random.empty() ? not_a_number : median(std::move(random));
  std::vector<std::string> names;
  for (const Hyperparameter& h : information.parameters()) names.push_back(h.name);
  add_known(
      search, names, [](const auto& known) { return known.stddev; }, out.parameters);
  if (out.target == ExcitationTarget::accelerations) {
    add_known(
        search, information.view().names(system),
        [&](const auto& known) { return region_stddev(known, information.noise_stddev()); }, out.accelerations);
  }
  std::vector<Limit> all = inputs;
  all.insert(all.end(), limits.begin(), limits.end());
  out.n_motions = search.n_motions();
  out.n_failed = search.n_failed();
  out.highest_frequency = request.n_harmonics / request.duration;
  out.leaves_data = motion_uncertainty(information.posterior(), out.motion, driven.other_system).leaves_data;
  out.limits = limit_uses(out.motion, all);
  out.interrupted = is_set(stop);
  out.seconds = search.seconds();
  return out;
}

CsvTable as_table(const Trajectory& motion, const System& system, std::string name) {
  const StateLayout layout = system.layout();
  const MatrixXd all = quantities(motion);
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& column, Index row) {
    columns.push_back({column, {all.row(row).begin(), all.row(row).end()}});
  };
  const std::vector<std::string> names = system.state_names(), accelerations = system.acceleration_names();
  add("t", layout.t());
  for (Index k = 0; k < layout.t(); ++k) add(names[static_cast<std::size_t>(k)], k);
  for (Index k = 0; k < layout.nq; ++k) add(accelerations[static_cast<std::size_t>(k)], layout.size() + k);
  for (Index k = layout.t() + 1; k < layout.size(); ++k) add(names[static_cast<std::size_t>(k)], k);
  return CsvTable::from_columns(std::move(name), std::move(columns));
}

}  // namespace gp2
