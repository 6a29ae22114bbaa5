#include "gp2/jobs/raw_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numbers>
#include <set>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/simulation/projected_states.hpp"
#include "inference/inducing_summary.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/series_checks.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// Every fifth piece of a log belongs to one part, so that each part has seen all of the motion.
constexpr int n_parts = 5, n_pieces = 30;
constexpr int first_line = 2;  // of a table, that has its first row

int part_of(Index row, Index n_rows) { return static_cast<int>(row * n_pieces / n_rows) % n_parts; }

// Accelerations at all states, each by what the other parts tell.
// @param lines  of all rows that were fitted to, in the table of all states
LearnedAccelerations left_out_accelerations(const Posterior& posterior, const std::vector<int>& lines, const MatrixXd& states) {
  const View view = View::constrained_acceleration(*posterior.prior().system);
  const int nq = posterior.prior().system->nq();
  LearnedAccelerations out{MatrixXd(nq, states.cols()), MatrixXd(nq, states.cols())};
  const std::shared_ptr<const InducingSummary> summary = posterior.summary();
  const int step = summary ? summary->kept.step : 1;
  for (int part = 0; part < n_parts; ++part) {
    std::vector<int> others;
    std::vector<Index> here;
    for (int i = 0; i < posterior.observations().front().n_data(); ++i) {
      if (part_of(lines[static_cast<std::size_t>(i * step)] - first_line, states.cols()) != part) others.push_back(i);
    }
    for (Index i = 0; i < states.cols(); ++i) {
      if (part_of(i, states.cols()) == part) here.push_back(i);
    }
    std::vector<Observations> seen = posterior.observations();
    seen.front() = seen.front().take(others);
    const Posterior::Marginal seen_from_there =
        Posterior(posterior.prior(), std::move(seen), posterior.values()).marginal(view, states(Eigen::all, here), 0);
    out.mean(Eigen::all, here) = seen_from_there.mean;
    out.stddev(Eigen::all, here) = seen_from_there.stddev();
  }
  return out;
}

// Whether sums over windows say what the options ask to be learned.
bool learns_from_windows(const FitRequest& request, const DerivedData& data) {
  const FitProblemOptions& problem = request.problem;
  if (problem.robust || problem.baseline || problem.noise_stddev || problem.protocol.name == Protocol::Name::paper) return false;
  if (request.model.system->has_constraint_noise()) return false;
  // velocities that are measured say more than the positions alone
  return std::ranges::none_of(data.series, &DerivedSeries::has_velocities);
}

// Windows of a smoothed log, and the states that their sums are over: all of them, or such as lie about some rows.
class WindowChoice {
 public:
  /// @param centres   rows, the most important first
  /// @param n_states  about so many, at most
  WindowChoice(const DerivedData& data, const System& system, const std::vector<int>& centres, int n_states)
      : data_(data), time_(data.states.row(system.layout().t())), episodes_(data.episodes.size()) {
    make_grids();
    double n_all = 0;
    for (const Episode& one : episodes_) n_all += one.end / one.step;
    covers_log_ = n_all <= n_states;
    if (covers_log_) {
      // as near to each other as the number allows: where noise hides it a motion has more than stands out
      for (Episode& one : episodes_) {
        one.step *= n_all / n_states;
        one.choose(0, one.n_windows() - 1);
      }
    } else {
      choose_about(centres, n_states);
    }
    choose_rows();
  }

  [[nodiscard]] bool covers_log() const { return covers_log_; }
  [[nodiscard]] const std::vector<int>& rows() const { return rows_; }

  /// @param sensitivities  as sensitivities_of, at rows(); empty: none
  [[nodiscard]] Windows windows(const std::vector<StateSensitivity>& sensitivities) const {
    Windows out;
    for (const DerivedSeries& one : data_.series) {
      const Episode& episode = episodes_[static_cast<std::size_t>(one.episode)];
      if (episode.chosen.empty()) continue;
      Windows::Series& series = out.series.emplace_back(Windows::Series{
          one.coordinate, one.episode, one.positions, one.model, episode.grid, {episode.chosen.begin(), episode.chosen.end()}});
      if (!sensitivities.empty()) series.grid.sensitivity = sensitivity_of(one, sensitivities);
    }
    for (const int row : rows_) out.states[row + first_line] = {data_.episode[static_cast<std::size_t>(row)], time_of(row)};
    return out;
  }

 private:
  struct Episode {
    double start = 0, end = 0;  // what t was at time 0; time of the last position
    double step = 0;            // between states
    WindowGrid grid;
    std::set<int> chosen;

    // from the first that is half inside the episode to the last
    [[nodiscard]] int n_windows() const { return static_cast<int>(std::ceil(end / grid.spacing)) + 1; }
    [[nodiscard]] int last_about(double time) const { return static_cast<int>(std::floor((time - grid.start) / grid.spacing)); }
    void choose(int first, int last) {
      for (int j = std::max(0, first); j <= std::min(last, n_windows() - 1); ++j) chosen.insert(j);
    }
    [[nodiscard]] bool has_one_about(double time) const {
      const int last = last_about(time);
      const auto found = chosen.lower_bound(last - 3);
      return found != chosen.end() && *found <= last;
    }
  };

  [[nodiscard]] const Episode& episode_of(int row) const {
    return episodes_[static_cast<std::size_t>(data_.episode[static_cast<std::size_t>(row)])];
  }
  [[nodiscard]] double time_of(int row) const { return time_[row] - episode_of(row).start; }

  // of one series, from those of its coordinate at the rows of all episodes
  [[nodiscard]] StateSensitivity sensitivity_of(const DerivedSeries& series,
                                                const std::vector<StateSensitivity>& sensitivities) const {
    const auto is_of_episode = [&](int row) { return data_.episode[static_cast<std::size_t>(row)] == series.episode; };
    const auto first = std::ranges::find_if(rows_, is_of_episode) - rows_.begin();
    const Index n = std::ranges::count_if(rows_, is_of_episode);
    VectorXd times(n);
    for (Index i = 0; i < n; ++i) times[i] = time_of(rows_[static_cast<std::size_t>(first + i)]);
    const auto place = std::ranges::find(data_.measured, series.coordinate) - data_.measured.begin();
    const StateSensitivity& all = sensitivities[static_cast<std::size_t>(place)];
    StateSensitivity out{std::move(times), all.by_position.middleRows(first, n), all.by_velocity.middleRows(first, n)};
    for (const DerivedSeries& one : data_.series) {
      if (one.episode != series.episode) continue;
      const auto column = std::ranges::find(data_.measured, one.coordinate) - data_.measured.begin();
      const double noise = one.model.noise_stddev / series.model.noise_stddev;
      out.by_position.col(column) *= noise;
      out.by_velocity.col(column) *= noise;
    }
    // the accelerated coordinate first
    out.by_position.col(0).swap(out.by_position.col(place));
    out.by_velocity.col(0).swap(out.by_velocity.col(place));
    return out;
  }

  // windows and steps of states in periods of the frequency up to which the fastest motion of an episode stands out of the noise
  void make_grids() {
    std::vector<double> bandwidth(episodes_.size(), 0), rate(episodes_.size(), 0);
    for (const DerivedSeries& one : data_.series) {
      const auto e = static_cast<std::size_t>(one.episode);
      bandwidth[e] = std::max(bandwidth[e], one.bandwidth);
      rate[e] = std::max(rate[e], one.rate);
      episodes_[e].start = one.start;
      if (!one.positions.empty()) episodes_[e].end = std::max(episodes_[e].end, one.positions.back().time);
    }
    for (std::size_t e = 0; e < episodes_.size(); ++e) {
      Episode& one = episodes_[e];
      const double sample = 1 / rate[e], period = std::clamp(1 / bandwidth[e], 5 * sample, std::max(5 * sample, one.end / 4));
      one.grid.spacing = windows_apart * period;
      one.grid.start = -2 * one.grid.spacing;
      one.step = states_apart * period;
    }
  }

  void choose_about(const std::vector<int>& centres, int n_states) {
    constexpr int n_before = 5,
                  n_after = 2;  // windows that begin before a centre, of those that are not over there, and after it
    double n = 0;
    for (const int row : centres) {
      if (n >= n_states) return;
      Episode& one = episodes_[static_cast<std::size_t>(data_.episode[static_cast<std::size_t>(row)])];
      const std::size_t before = one.chosen.size();
      const int last = one.last_about(time_of(row));
      one.choose(last - n_before, last + n_after);
      // a group of windows has the states of three more
      const auto n_new = static_cast<double>(one.chosen.size() - before);
      n += (n_new > 0 ? n_new + 3 * n_new / (n_before + n_after + 1) : 0) * one.grid.spacing / one.step;
    }
  }

  void choose_rows() {
    const Episode* before = nullptr;
    double last = 0;
    for (int row = 0; row < static_cast<int>(data_.episode.size()); ++row) {
      const Episode& one = episode_of(row);
      const double time = time_of(row);
      if (!one.has_one_about(time)) continue;
      constexpr double rounding = 1e-6;
      if (&one == before && time - last < (1 - rounding) * one.step) continue;
      rows_.push_back(row);
      before = &one;
      last = time;
    }
  }

  // Windows twice as far apart lose where noise is large, states at 0.4 everywhere.
  static constexpr double windows_apart = 0.4, states_apart = 0.25;

  const DerivedData& data_;
  Eigen::RowVectorXd time_;
  std::vector<Episode> episodes_;
  bool covers_log_ = false;
  std::vector<int> rows_;
};

// The states of a smoothed log, with what acts for its commands.
MatrixXd acting_states(const Model& model, const DerivedData& data, const CsvTable& table) {
  LogReader reader(table, *model.system);
  MatrixXd states = data.states;
  std::vector<std::string> notes;
  static_cast<void>(take_commands(*model.system, model.actuators, reader, std::nullopt, {}, states, notes));
  return states;
}

// The states with one entry of each changed by a multiple of its usual error, moved back onto the constraints, which do not let
// the coordinates err by themselves.
// @param stddev  as usual_errors
MatrixXd changed_states(const System& system, const VectorXd& parameters, MatrixXd states, const MatrixXd& stddev, Index entry,
                        double change) {
  states.row(entry) += change * stddev.row(entry);
  if (system.residual_labels().empty()) return states;
  return project_states(system, parameters, states, stddev).states;
}

// About what q and dq of smoothed states are off by (2 nq × rows): the noise of the positions, and its velocities below the bandwidth.
// What was not measured follows the rest, however far.
MatrixXd usual_errors(const DerivedData& data, const MatrixXd& states, const std::vector<int>& rows) {
  const Index nq = data.accelerations.rows();
  const auto moving = states.topRows(2 * nq);
  const VectorXd spread =
      (moving.colwise() - moving.rowwise().mean()).rowwise().norm() / std::sqrt(static_cast<double>(rows.size()));
  MatrixXd out = spread.replicate(1, states.cols());
  for (const DerivedSeries& one : data.series) {
    for (Index i = 0; i < out.cols(); ++i) {
      if (data.episode[static_cast<std::size_t>(rows[static_cast<std::size_t>(i)])] != one.episode) continue;
      out(one.coordinate, i) = one.model.noise_stddev;
      out(nq + one.coordinate, i) = one.model.noise_stddev * std::numbers::pi * one.bandwidth;
    }
  }
  return (out.array() > 0).select(out, not_a_number);
}

// How the accelerations that were learned change with each measured coordinate, from differences over its usual error to either side.
// @param states  of all rows, with what acts
// @returns of each measured coordinate, at the chosen rows
std::vector<StateSensitivity> sensitivities_of(const Posterior& posterior, const DerivedData& data, const MatrixXd& states,
                                               const std::vector<int>& rows) {
  const System& system = *posterior.prior().system;
  const Index nq = system.nq(), n_measured = std::ssize(data.measured);
  const MatrixXd some = states(Eigen::all, rows);
  const MatrixXd stddev = usual_errors(data, some, rows);
  const View view = View::constrained_acceleration(system);
  const VectorXd& parameters = posterior.values().parameters;
  std::vector<StateSensitivity> out(data.measured.size());
  for (StateSensitivity& one : out) one.by_position = one.by_velocity = MatrixXd::Zero(some.cols(), n_measured);
  for (Index k = 0; k < 2 * n_measured; ++k) {
    const bool of_position = k < n_measured;
    const Index column = k % n_measured, entry = data.measured[static_cast<std::size_t>(column)] + (of_position ? 0 : nq);
    const auto mean = [&](double change) {
      return posterior.mean(view, changed_states(system, parameters, some, stddev, entry, change), 0);
    };
    const MatrixXd slope = (mean(1) - mean(-1)) * (0.5 * stddev.row(entry).cwiseInverse()).asDiagonal();
    for (Index j = 0; j < n_measured; ++j) {
      StateSensitivity& of_one = out[static_cast<std::size_t>(j)];
      (of_position ? of_one.by_position : of_one.by_velocity).col(column) = slope.row(data.measured[static_cast<std::size_t>(j)]);
    }
  }
  return out;
}

std::vector<const CsvTable*> tables_of(const std::vector<SideInformation>& also) {
  std::vector<const CsvTable*> tables;
  for (const SideInformation& one : also) tables.push_back(&one.log.table);
  return tables;
}

// The names of columns that the raw log has; the others are of side information.
std::map<std::string, std::string> columns_of_raw(const FitRequest& request, const CsvTable& log) {
  const System& system = *request.model.system;
  std::vector<const CsvTable*> tables = tables_of(request.also);
  tables.push_back(&log);
  check_columns(system, tables, request.problem.columns);
  return columns_in({&log}, system, request.problem.columns);
}

// The inputs that the prior reads must be in the raw log: the smoothed one has other columns to tell of.
void require_inputs(const FitRequest& request, const CsvTable& log, const std::map<std::string, std::string>& columns) {
  const bool paper = request.problem.protocol.name == Protocol::Name::paper;
  // a baseline has another prior; the paper's protocol refuses several latents when the fit is prepared
  if (request.problem.baseline || (paper && request.model.latents.size() > 1)) return;
  const System& system = *request.model.system;
  FitPriorOptions options;
  options.mean = request.problem.mean;
  options.base = paper ? std::optional(Latent::Base::acceleration) : request.problem.base;
  const std::vector<bool> reads = make_prior(request.model, options).reads();
  LogReader reader = open_log(request.model, log, columns);
  for (std::size_t k = 0; k < system.inputs().size(); ++k) {
    const std::string& input = system.inputs()[k];
    const bool is_read = reads[static_cast<std::size_t>(system.layout().u(static_cast<int>(k)))];
    if (is_read && !reader.has(input)) static_cast<void>(reader.values({input}));  // throws, and says what there is
  }
}

double total_gain(const DerivedData& data) {
  double gain = 0;
  for (const DerivedSeries& one : data.series) gain += one.gain;
  return gain;
}

// Smooths a raw log, learns from that, and smooths with what was learned.
class RawLearner {
 public:
  RawLearner(const FitRequest& request, const CsvTable& log, const RawFitOptions& options, const std::atomic<bool>* stop)
      : request_(request), log_(log), options_(options), smoothing_(options.derive), stop_(stop) {
    smoothing_.columns = columns_of_raw(request, log);
    require_inputs(request, log, smoothing_.columns);
    smoothing_.stop = stop;
    smoothing_.keep_positions = true;
  }

  LearnedLog run() {
    LearnedLog once = with_rows(derive(request_.model, log_, smoothing_));
    return with_windows(options_.most_passes == 0 ? std::move(once) : smoothed_again(std::move(once)));
  }

 private:
  // Those that cover the motion best.
  [[nodiscard]] std::vector<int> rows_of(const DerivedData& data, int n) const {
    const CsvTable table = as_table(data, *request_.model.system, log_.name());
    return resample(request_.model, table, {.n = std::min(n, table.n_rows())}).rows;
  }

  [[nodiscard]] LearnedLog with_rows(DerivedData data) const {
    LearnedLog out{std::move(data), {}, {}, {}, {}};
    if (log_.file()) out.files = {*log_.file()};
    out.rows = rows_of(out.data, request_.problem.max_points.value_or(n_raw_rows));
    std::ranges::sort(out.rows);
    return out;
  }

  void learn_from(const LearnedLog& before) {
    with_warnings(before.data.notes, [&] {
      FitRequest quick = before.request(request_, log_.name());
      const CsvTable whole = *quick.problem.commands;
      quick.model.actuators = actuators_;
      quick.hyperparameters = HyperparameterChoice::optimise;
      quick.standard_errors = quick.thin = quick.problem.robust = false;
      const FitJob job = prepare_fit(std::move(quick));
      const FitOutcome fit = run_fit(job, {}, stop_);
      if (is_set(stop_)) throw NumericalError("stopped while learning from the raw log");
      actuators_ = fit.file.model.actuators;
      last_ = {fit.posterior, job.problem.lines.front(), acting_states(fit.file.model, before.data, whole)};
    });
  }

  LearnedLog smoothed_by_fit_to(const LearnedLog& before) {
    learn_from(before);
    return with_rows(
        derive(request_.model, log_, smoothing_, left_out_accelerations(last_->posterior, last_->lines, last_->states)));
  }

  // As often as that makes held-out positions likelier.
  LearnedLog smoothed_again(LearnedLog best) {
    constexpr double decisive = 10;  // nats
    LearnedLog next = smoothed_by_fit_to(best);
    const double first = total_gain(next.data);
    std::vector<double> gains;
    while (static_cast<int>(gains.size()) < options_.most_passes) {
      // how good a smoothing is to learn from shows in the one after it
      LearnedLog after = smoothed_by_fit_to(next);
      const double gain = total_gain(after.data);
      if (!(gain > total_gain(next.data) + decisive)) break;
      gains.push_back(gain);
      best = std::exchange(next, std::move(after));
    }
    best.notes.push_back(gains.empty()
                             ? "smoothing with the learned dynamics does not make held-out positions likelier: it is not used"
                             : fmt::format("smoothed {} times with the learned dynamics: log likelihood of held-out positions + "
                                           "{:.4g}, learned from that + {:.4g}",
                                           gains.size(), first, fmt::join(gains, ", + ")));
    best.gains = std::move(gains);
    return best;
  }

  // How the accelerations at some rows change with errors of their states.
  std::vector<StateSensitivity> sensitivities_at(const std::vector<int>& rows, LearnedLog& learned) {
    if (learned.data.independent.empty()) return {};
    if (!last_) {
      const std::size_t step = (learned.rows.size() + n_raw_rows - 1) / n_raw_rows;
      for (std::size_t i = 0; i * step < learned.rows.size(); ++i) learned.rows[i] = learned.rows[i * step];
      learned.rows.resize((learned.rows.size() + step - 1) / step);
      learn_from(learned);
    }
    try {
      return sensitivities_of(last_->posterior, learned.data, last_->states, rows);
    } catch (const InputError& error) {
      learned.notes.push_back(
          fmt::format("warning: errors of the smoothed states are neglected in the noise of windows, since accelerations near "
                      "these states are unknown: {} Standard errors may be too small; compare a fit with `windows=none`",
                      error.what()));
      return {};
    }
  }

  LearnedLog with_windows(LearnedLog learned) {
    if (!options_.windows || !learns_from_windows(request_, learned.data)) return learned;
    constexpr int n_values = 2 * n_window_states;  // of accelerations, that are no more than can be fitted in a minute or two
    const auto n_independent = static_cast<int>(std::max<Index>(1, std::ssize(learned.data.independent)));
    const int n = request_.problem.max_points.value_or(std::min(n_window_states, n_values / n_independent));
    const WindowChoice choice(learned.data, *request_.model.system, rows_of(learned.data, n), n);
    // a group of eight windows takes eighteen states: of a few groups less is learned than from as many rows, which lie apart
    if (n < n_raw_rows && !choice.covers_log()) return learned;
    const std::vector<StateSensitivity> sensitivities = sensitivities_at(choice.rows(), learned);
    learned.rows = choice.rows();
    learned.windows = std::make_shared<const Windows>(choice.windows(sensitivities));
    for (DerivedSeries& series : learned.data.series) series.positions = std::vector<Measurement>();  // `= {}` keeps the memory
    return learned;
  }

  struct Learned {
    Posterior posterior;
    std::vector<int> lines;
    MatrixXd states;  // of all rows, with what acts
  };

  const FitRequest& request_;
  const CsvTable& log_;
  const RawFitOptions& options_;
  DeriveOptions smoothing_;
  const std::atomic<bool>* stop_;
  std::vector<Actuator> actuators_ = request_.model.actuators;  // estimated anew by each fit, from where the last one found them
  std::optional<Learned> last_;
};

}  // namespace

std::vector<Option> options(RawFitOptions& options) {
  std::vector<Option> table = {{"passes", &options.most_passes, "K",
                                "maximum number of times to smooth the raw log again with the learned dynamics, as long as the "
                                "likelihood of held-out positions increases; 0: smooth once"},
                               {"windows", Switch{&options.windows, "auto", "none"}, "",
                                "data to learn from; auto: if possible, averages of the acceleration over time windows, computed "
                                "from positions without differentiation (docs/theory.md, T36); none: rows of the smoothed log"}};
  static constexpr std::array left_out = {"rate", "every", "hold_constraints", "keep", "map"};
  for (Option& option : gp2::options(options.derive)) {
    if (std::find(left_out.begin(), left_out.end(), option.name) == left_out.end()) table.push_back(std::move(option));
  }
  for (Option& option : table) option.needs = "raw";
  return in_group("Raw logs", std::move(table));
}

std::vector<Option> options(FitRequest& request, RawFitOptions& raw) { return joined({options(request), options(raw)}); }

FitRequest LearnedLog::request(FitRequest asked, const std::string& name) const {
  DerivedData told = data;
  if (windows) {
    // windows are of the positions that were measured, each with its own noise, not of rows on which the constraints hold
    told.independent = told.measured;
    for (const int j : told.measured) told.is_independent.row(j) = true;
  }
  CsvTable whole = as_table(told, *asked.model.system, name);
  asked.logs = {{.table = whole.take(rows), .windows = windows, .is_smoothed = true}};
  // the smoothed log has the names of the model, side information those of its files
  asked.problem.columns = columns_in(tables_of(asked.also), *asked.model.system, std::move(asked.problem.columns));
  std::erase_if(asked.problem.columns, [&](const auto& entry) { return whole.find(entry.second) >= 0; });
  asked.problem.commands = std::move(whole);
  asked.problem.max_points.reset();
  return asked;
}

FitJob prepare_raw_fit(const LearnedLog& log, FitRequest asked, const std::string& name) {
  FitJob job = prepare_fit(log.request(std::move(asked), name));
  if (!log.data.lines.empty()) {
    for (int& line : job.problem.lines.front()) line = log.data.lines[static_cast<std::size_t>(line - first_line)];
  }
  job.file.logs.insert(job.file.logs.begin(), log.files.begin(), log.files.end());
  return job;
}

LearnedLog learn_and_smooth(const FitRequest& request, const CsvTable& log, const RawFitOptions& options,
                            const std::atomic<bool>* stop) {
  require_in_range(request);
  if (options.most_passes < 0) throw InputError(fmt::format("`passes`: must not be negative, got {}", options.most_passes));
  return RawLearner(request, log, options, stop).run();
}

}  // namespace gp2
