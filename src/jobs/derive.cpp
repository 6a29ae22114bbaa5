#include "gp2/jobs/derive.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <numbers>
#include <numeric>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/parallel.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "smoothing/constrained_states.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr int least_for_own_model = 40;  // samples
constexpr double most_rows = 1e7;

/// An empty cell, or one of the words that loggers write instead.
bool is_missing(const std::string& cell) {
  std::string word = cell;
  for (char& c : word) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return word.empty() || word == "nan" || word == "-nan" || word == "na" || word == "null" || word == "none";
}

/// Rows of one episode in the log, and their times.
struct Episode {
  std::string label;
  std::vector<int> rows;
  std::vector<double> times;  // from its first row on [s]
  double start = 0;
  std::vector<double> distinct;  // the times without repetitions
};

/// A column of the log in one episode.
struct Channel {
  std::vector<Measurement> measurements;  // about `mean`
  double mean = 0;
  int missing = 0, repeated = 0, wraps = 0;
  double resolution = 0;
};

/// A coordinate of one episode: its report, and its motion at the times that are written.
struct Task {
  int coordinate = 0, episode = 0;
  Channel channel;
  SmootherFit fit;
  SmoothedMotion motion;
};

std::string in_episode(const Episode& episode) {
  return episode.label.empty() ? "" : fmt::format(" in episode {}", episode.label);
}

class Deriver {
 public:
  Deriver(const Model& model, const CsvTable& log, const DeriveOptions& options)
      : model_(model), system_(*model.system), log_(log), options_(options), reader_(open_log(model, log, options.columns)) {}

  DerivedData run() {
    check_options();
    find_columns();
    find_episodes();
    read_channels();
    smooth_channels();
    collect_rows();
    add_inputs();
    put_together();
    take_each();
    return std::move(data_);
  }

 private:
  void check_options() const {
    if (!(options_.rate >= 0) || !std::isfinite(options_.rate))
      throw InputError(fmt::format("rate: must be positive, got {}", options_.rate));
    if (options_.every < 1) throw InputError(fmt::format("every: must be at least 1, got {}", options_.every));
    if (!(options_.outlier_threshold >= 0)) {
      throw InputError(fmt::format("outlier threshold: must not be negative, got {}", options_.outlier_threshold));
    }
    if (options_.rate > 0 && !options_.keep.empty()) {
      throw InputError("keep: rows of an even rate are not those of the log; leave out either");
    }
  }

  void find_columns() {
    if (!reader_.has("t")) static_cast<void>(reader_.values({"t"}));  // throws, and says what there is
    time_column_ = reader_.column("t");
    for (int j = 0; j < system_.nq(); ++j) {
      const Coordinate& coordinate = system_.coordinates()[static_cast<std::size_t>(j)];
      const int position = reader_.column(coordinate.name);
      if (position >= 0) {
        data_.measured.push_back(j);
        position_column_[j] = position;
        velocity_column_[j] = reader_.column(coordinate.velocity());
      } else if (reader_.has(coordinate.velocity())) {
        data_.notes.push_back(
            fmt::format("{} is not used: without {} there is no motion to smooth", coordinate.velocity(), coordinate.name));
      }
    }
    if (data_.measured.empty()) {
      std::vector<std::string> names;
      for (const Coordinate& coordinate : system_.coordinates()) names.push_back(coordinate.name);
      throw InputError(
          fmt::format("{}: no column is a coordinate of '{}' ({}); the file has: {}. Rename them, or give `map=LOGNAME={}`",
                      log_.name(), system_.name(), fmt::join(names, ", "), fmt::join(log_.header(), ", "), names.front()));
    }
    for (int k = 0; k < static_cast<int>(system_.inputs().size()); ++k) {
      const std::string& input = system_.inputs()[static_cast<std::size_t>(k)];
      input_column_.push_back(reader_.column(input));
      if (input_column_.back() < 0) data_.notes.push_back(fmt::format("the log has no input {}", input));
    }
    for (const std::string& name : options_.keep) {
      if (log_.find(name) < 0) {
        throw InputError(
            fmt::format("keep: {} has no column '{}'; it has: {}", log_.name(), name, fmt::join(log_.header(), ", ")));
      }
    }
    for (const auto& [name, found] : reader_.aliases_used())
      data_.notes.push_back(fmt::format("{} is the column '{}'", name, found));
  }

  void find_episodes() {
    const std::string name = options_.episode_column.empty() ? "episode" : options_.episode_column;
    const int column = log_.find(name);
    if (column < 0 && !options_.episode_column.empty()) {
      throw InputError(
          fmt::format("episode column: {} has no column '{}'; it has: {}", log_.name(), name, fmt::join(log_.header(), ", ")));
    }
    if (column < 0 && !options_.episodes.empty()) {
      throw InputError(fmt::format("episodes: {} has no column 'episode' to choose from; name it", log_.name()));
    }
    if (column >= 0) data_.episode_column = name;
    std::map<std::string, std::size_t> number;
    std::vector<std::string> labels;
    for (int row = 0; row < log_.n_rows(); ++row) {
      const std::string label = column < 0 ? "" : log_.cell(row, column);
      if (number.emplace(label, number.size()).second) labels.push_back(label);
    }
    for (const std::string& wanted : options_.episodes) {
      if (!number.contains(wanted)) {
        throw InputError(
            fmt::format("episodes: {} has no episode '{}'; it has: {}", log_.name(), wanted, fmt::join(labels, ", ")));
      }
    }
    const std::set<std::string> taken(options_.episodes.begin(), options_.episodes.end());
    std::map<std::string, std::size_t> place;
    for (const std::string& label : labels) {
      if (!taken.empty() && !taken.contains(label)) continue;
      place[label] = episodes_.size();
      episodes_.push_back({label, {}, {}, 0, {}});
      data_.episodes.push_back(label);
    }
    for (int row = 0; row < log_.n_rows(); ++row) {
      const auto found = place.find(column < 0 ? "" : log_.cell(row, column));
      if (found == place.end()) continue;
      Episode& episode = episodes_[found->second];
      const double time = log_.number(row, time_column_);
      if (episode.rows.empty()) episode.start = time;
      const double since = time - episode.start;
      if (!episode.times.empty() && since < episode.times.back()) {
        throw InputError(fmt::format("{}: column '{}': time runs backwards{} at data row {}: {} after {}. Sort the rows{}",
                                     log_.name(), log_.header()[static_cast<std::size_t>(time_column_)], in_episode(episode),
                                     row + 1, time, episode.start + episode.times.back(),
                                     column < 0 ? ", or give the column that numbers the episodes" : ""));
      }
      if (episode.times.empty() || since > episode.times.back()) episode.distinct.push_back(since);
      episode.rows.push_back(row);
      episode.times.push_back(since);
    }
  }

  /// Values of a column at the times of an episode, in the order of the log.
  void read_column(const Episode& episode, int column, bool velocity, bool angle, Channel& channel) const {
    double offset = 0, before = nan;
    std::vector<double> at_one_time;
    double time = nan;
    for (std::size_t k = 0; k < episode.rows.size(); ++k) {
      if (is_missing(log_.cell(episode.rows[k], column))) {
        ++channel.missing;
        continue;
      }
      double value = log_.number(episode.rows[k], column) + offset;
      if (angle && std::abs(value - before) > std::numbers::pi) {
        const double turn = -2 * std::numbers::pi * std::round((value - before) / (2 * std::numbers::pi));
        offset += turn;
        value += turn;
        ++channel.wraps;
      }
      before = value;
      if (episode.times[k] != time) at_one_time.clear();
      time = episode.times[k];
      if (std::find(at_one_time.begin(), at_one_time.end(), value) != at_one_time.end()) {
        ++channel.repeated;
        continue;
      }
      at_one_time.push_back(value);
      channel.measurements.push_back({time, value, velocity, 1});
    }
  }

  void read_channels() {
    for (const int j : data_.measured) {
      for (int e = 0; e < static_cast<int>(episodes_.size()); ++e) {
        const Episode& episode = episodes_[static_cast<std::size_t>(e)];
        Task& task = tasks_.emplace_back();
        task.coordinate = j;
        task.episode = e;
        Channel& channel = task.channel;
        read_column(episode, position_column_.at(j), false, system_.coordinates()[static_cast<std::size_t>(j)].angle, channel);
        require_motion(episode, position_column_.at(j), channel);
        std::vector<double> values;
        for (const Measurement& one : channel.measurements) values.push_back(one.value);
        channel.mean = std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size());
        channel.resolution = resolution_of(values);
        for (Measurement& one : channel.measurements) one.value -= channel.mean;
        if (velocity_column_.at(j) >= 0) {
          read_column(episode, velocity_column_.at(j), true, false, channel);
          std::stable_sort(channel.measurements.begin(), channel.measurements.end(),
                           [](const Measurement& a, const Measurement& b) { return a.time < b.time; });
        }
      }
    }
  }

  void require_motion(const Episode& episode, int column, const Channel& channel) const {
    const std::string where =
        fmt::format("{}: column '{}'{}", log_.name(), log_.header()[static_cast<std::size_t>(column)], in_episode(episode));
    const std::string way_out = episode.label.empty() ? "" : "; leave that episode out";
    constexpr std::size_t least = 5;
    if (channel.measurements.size() < least) {
      throw InputError(fmt::format("{}: {} samples are too few to find a motion in; {} are needed{}", where,
                                   channel.measurements.size(), least, way_out));
    }
    const double first = channel.measurements.front().value;
    if (std::all_of(channel.measurements.begin(), channel.measurements.end(),
                    [&](const Measurement& one) { return one.value == first; })) {
      throw InputError(fmt::format("{}: all {} values are {}: nothing moves, which tells neither velocity nor noise{}", where,
                                   channel.measurements.size(), first, way_out));
    }
  }

  [[nodiscard]] VectorXd times_to_write(const Episode& episode) const {
    if (options_.rate == 0) {
      return Eigen::Map<const VectorXd>(episode.distinct.data(), static_cast<Index>(episode.distinct.size()));
    }
    const double span = episode.distinct.back();
    if (span * options_.rate > most_rows) {
      throw InputError(fmt::format("rate: {} rows per second would be {:.3g} rows; at most {:.0e} are written", options_.rate,
                                   span * options_.rate, most_rows));
    }
    const auto n = static_cast<Index>(std::floor(span * options_.rate * (1 + 1e-12) + 1e-9)) + 1;
    return VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1)) / options_.rate;
  }

  void smooth_channels() {
    SmootherFitOptions options;
    options.smoothness = options_.smoothness;
    options.outlier_threshold = options_.outlier_threshold;
    const int n_threads = thread_count(options_.n_threads);
    const auto is_short = [](const Task& task) { return task.channel.measurements.size() < least_for_own_model; };
    parallel_for(static_cast<int>(tasks_.size()), n_threads, [&](int k, int) {
      Task& task = tasks_[static_cast<std::size_t>(k)];
      SmootherFitOptions own = options;
      own.least_noise_stddev = task.channel.resolution / std::sqrt(12.0);  // of rounding
      task.fit = fit_smoother(task.channel.measurements, own);
    });
    // few samples do not tell their own smoothness
    std::vector<bool> shared(tasks_.size(), false);
    for (std::size_t k = 0; k < tasks_.size(); ++k) {
      if (!is_short(tasks_[k])) continue;
      std::array<std::vector<double>, SmootherModel::n_parameters> others;
      for (const Task& other : tasks_) {
        if (other.coordinate != tasks_[k].coordinate || is_short(other)) continue;
        const SmootherModel& model = other.fit.model;
        others[0].push_back(model.lengthscale);
        others[1].push_back(model.signal_stddev);
        others[2].push_back(model.noise_stddev);
        others[3].push_back(model.velocity_noise_stddev);
        others[4].push_back(model.time_stddev);
      }
      if (others[0].empty()) continue;
      tasks_[k].fit.model = {options_.smoothness, median(others[0]), median(others[1]),
                             median(others[2]),   median(others[3]), median(others[4])};
      shared[k] = true;
    }
    parallel_for(static_cast<int>(tasks_.size()), n_threads, [&](int k, int) {
      Task& task = tasks_[static_cast<std::size_t>(k)];
      const VectorXd times = times_to_write(episodes_[static_cast<std::size_t>(task.episode)]);
      task.motion = smooth(task.fit.model, task.fit.trusted, times);
      task.motion.mean.row(0).array() += task.channel.mean;
    });
    for (std::size_t k = 0; k < tasks_.size(); ++k) data_.series.push_back(report_of(tasks_[k], shared[k]));
  }

  static DerivedSeries report_of(const Task& task, bool shared) {
    const std::vector<Measurement>& used = task.fit.trusted;
    DerivedSeries out;
    out.coordinate = task.coordinate;
    out.episode = task.episode;
    out.model = task.fit.model;
    out.noise_at_least = task.fit.noise_at_least && task.channel.resolution > 0;
    out.shared_model = shared;
    out.resolution = task.channel.resolution;
    out.used = static_cast<int>(used.size());
    out.missing = task.channel.missing;
    out.repeated = task.channel.repeated;
    out.outliers = static_cast<int>(task.fit.outliers.size());
    out.wraps = task.channel.wraps;
    std::vector<double> spaces;
    for (std::size_t k = 1; k < used.size(); ++k) {
      if (used[k].time > used[k - 1].time) spaces.push_back(used[k].time - used[k - 1].time);
    }
    const double usual = median(spaces);
    for (const double space : spaces) {
      if (space <= 3 * usual) continue;
      ++out.gaps;
      out.longest_gap = std::max(out.longest_gap, space);
    }
    out.bandwidth = bandwidth_of(task.fit.model, usual);
    return out;
  }

  /// Where the spectrum of the motion, s² c/λ / (1 + (ω/λ)²)^D, sinks into that of the noise, σ² Δt [Hz].
  static double bandwidth_of(const SmootherModel& model, double time_step) {
    const int D = static_cast<int>(model.smoothness) + 1;
    const double rate = std::sqrt(2.0 * D - 1) / model.lengthscale;
    double intensity = 2;
    for (int k = 1; k < D; ++k) intensity *= 4.0 * k * k / ((2.0 * k) * (2.0 * k - 1));
    const double ratio = std::pow(model.signal_stddev / model.noise_stddev, 2) * intensity / (rate * time_step);
    return ratio > 1 ? rate * std::sqrt(std::pow(ratio, 1.0 / D) - 1) / (2 * std::numbers::pi) : 0;
  }

  // rows of all episodes, one after another
  void collect_rows() {
    std::vector<double> times;
    for (int e = 0; e < static_cast<int>(episodes_.size()); ++e) {
      first_row_.push_back(static_cast<Index>(times.size()));
      for (const double since : times_to_write(episodes_[static_cast<std::size_t>(e)])) {
        times.push_back(episodes_[static_cast<std::size_t>(e)].start + since);
        data_.episode.push_back(e);
      }
    }
    const auto n = static_cast<Index>(times.size());
    const StateLayout layout = system_.layout();
    data_.states = MatrixXd::Constant(layout.size(), n, nan);
    data_.accelerations = MatrixXd::Constant(layout.nq, n, nan);
    data_.stddev = MatrixXd::Constant(3 * Index{layout.nq}, n, nan);
    data_.states.row(layout.t()) = Eigen::Map<const VectorXd>(times.data(), n).transpose();
    for (const Task& task : tasks_) {
      const Index first = first_row_[static_cast<std::size_t>(task.episode)];
      for (Index i = 0; i < task.motion.mean.cols(); ++i) {
        data_.states(layout.q(task.coordinate), first + i) = task.motion.mean(0, i);
        data_.states(layout.dq(task.coordinate), first + i) = task.motion.mean(1, i);
        data_.accelerations(task.coordinate, first + i) = task.motion.mean(2, i);
      }
    }
    for (const std::string& name : options_.keep) {
      data_.kept_names.push_back(name);
      std::vector<std::string>& cells = data_.kept.emplace_back();
      for (const Episode& episode : episodes_) {
        double before = nan;
        for (std::size_t k = 0; k < episode.rows.size(); ++k) {
          if (episode.times[k] == before) continue;
          before = episode.times[k];
          cells.push_back(log_.cell(episode.rows[k], log_.find(name)));
        }
      }
    }
  }

  // each input goes through the filter of the slowest coordinate: a smoother of the same spectrum and noise is that filter
  void add_inputs() {
    for (std::size_t u = 0; u < input_column_.size(); ++u) {
      if (input_column_[u] < 0) continue;
      for (int e = 0; e < static_cast<int>(episodes_.size()); ++e) {
        const Episode& episode = episodes_[static_cast<std::size_t>(e)];
        const DerivedSeries* slowest = nullptr;
        for (const DerivedSeries& series : data_.series) {
          if (series.episode == e && (!slowest || series.bandwidth < slowest->bandwidth)) slowest = &series;
        }
        Channel channel;
        read_column(episode, input_column_[u], false, false, channel);
        if (channel.measurements.empty()) {
          throw InputError(fmt::format("{}: column '{}'{}: there is no value", log_.name(),
                                       log_.header()[static_cast<std::size_t>(input_column_[u])], in_episode(episode)));
        }
        for (const Measurement& one : channel.measurements)
          channel.mean += one.value / static_cast<double>(channel.measurements.size());
        for (Measurement& one : channel.measurements) one.value -= channel.mean;
        const VectorXd times = times_to_write(episode);
        const SmoothedMotion motion = smooth(slowest->model, channel.measurements, times);
        data_.states.row(system_.layout().u(static_cast<int>(u))).segment(first_row_[static_cast<std::size_t>(e)], times.size()) =
            motion.mean.row(0).array() + channel.mean;
      }
    }
  }

  // what was not measured, and what the constraints say of what was
  void put_together() {
    const ConstrainedStates states(model_, data_.measured);
    data_.completed = states.completed();
    data_.independent = data_.measured;
    if (data_.states.cols() == 0) return;

    const VectorXd start = start_of_newton();
    const int redundancy = redundancy_of(states, started(0, start));
    std::vector<std::string> completed;
    for (const int j : data_.completed) completed.push_back(system_.coordinates()[static_cast<std::size_t>(j)].name);
    note_redundancy(redundancy, completed);
    const bool conditioned = options_.hold_constraints && redundancy > 0;
    parallel_for(static_cast<int>(episodes_.size()), thread_count(options_.n_threads),
                 [&](int e, int) { put_episode_together(states, e, conditioned, start); });
    if (!completed.empty()) data_.notes.push_back(fmt::format("from the constraints: {}", fmt::join(completed, ", ")));
    if (conditioned) data_.independent = independent_accelerations(states);
  }

  /// Where the model file wants the coordinates that are not measured to be sought: q, dq.
  [[nodiscard]] VectorXd start_of_newton() const {
    VectorXd start = VectorXd::Zero(2 * Index{system_.nq()});
    const std::vector<std::string> names = system_.state_names();
    for (Index k = 0; k < start.size(); ++k) {
      const auto given = model_.newton_start.find(names[static_cast<std::size_t>(k)]);
      if (given != model_.newton_start.end()) start[k] = given->second;
    }
    return start;
  }

  /// A row with what is not measured taken from elsewhere.
  [[nodiscard]] VectorXd started(Index i, const VectorXd& from) const {
    const StateLayout layout = system_.layout();
    VectorXd state = data_.states.col(i);
    for (const int j : data_.completed) {
      state[layout.q(j)] = from[j];
      state[layout.dq(j)] = from[layout.nq + j];
    }
    return state;
  }

  /// Says what the constraints mean for measured coordinates alone, and throws where noise would contradict them.
  void note_redundancy(int redundancy, const std::vector<std::string>& completed) {
    if (redundancy > 0 && !options_.hold_constraints) {
      const std::string fact = fmt::format("{} of the constraints hold{} among the measured coordinates alone", redundancy,
                                           redundancy == 1 ? "s" : "");
      if (!completed.empty()) {
        throw InputError(fmt::format(
            "{}: {}, which noise contradicts, so that {} cannot be solved for; hold the constraints (`hold_constraints`)",
            log_.name(), fact, fmt::join(completed, ", ")));
      }
      data_.notes.push_back(fact + ": `hold_constraints` makes use of that");
    }
    if (options_.hold_constraints && redundancy == 0)
      data_.notes.emplace_back("no constraint holds among the measured coordinates alone: there is nothing to hold");
  }

  // rows of an episode follow one another: each starts at its predecessor
  void put_episode_together(const ConstrainedStates& states, int e, bool conditioned, VectorXd from) {
    const StateLayout layout = system_.layout();
    const Index first = first_row_[static_cast<std::size_t>(e)];
    const Index last =
        e + 1 < static_cast<int>(episodes_.size()) ? first_row_[static_cast<std::size_t>(e) + 1] : data_.states.cols();
    std::vector<const Task*> tasks;
    for (const Task& task : tasks_) {
      if (task.episode == e) tasks.push_back(&task);
    }
    for (Index i = first; i < last; ++i) {
      VectorXd state = started(i, from);
      std::vector<Eigen::Matrix3d> covariance;
      for (const Task* task : tasks) covariance.push_back(task->motion.covariance[static_cast<std::size_t>(i - first)]);
      if (conditioned) {
        states.condition(state, data_.accelerations.col(i), covariance);
      } else {
        states.complete(state, data_.accelerations.col(i));
      }
      data_.states.col(i) = state;
      from = state.head(2 * layout.nq);
      for (std::size_t k = 0; k < tasks.size(); ++k) {
        for (int d = 0; d < 3; ++d) {
          data_.stddev(d * layout.nq + tasks[k]->coordinate, i) = std::sqrt(std::max(covariance[k](d, d), 0.0));
        }
      }
    }
  }

  /// Accelerations that say all others once the constraints hold, by their usual deviations.
  [[nodiscard]] std::vector<int> independent_accelerations(const ConstrainedStates& states) const {
    VectorXd stddev(static_cast<Index>(data_.measured.size()));
    for (Index k = 0; k < stddev.size(); ++k) {
      const auto row = data_.stddev.row(2 * system_.nq() + data_.measured[static_cast<std::size_t>(k)]);
      stddev[k] = std::max(median({row.begin(), row.end()}), std::numeric_limits<double>::min());
    }
    return states.independent_accelerations(data_.states, stddev);
  }

  // a first row that is solved as well as it can be, to look at
  [[nodiscard]] int redundancy_of(const ConstrainedStates& states, VectorXd state) const {
    VectorXd acceleration = data_.accelerations.col(0);
    states.approach(state, acceleration);
    return states.redundancy(state);
  }

  void take_each() {
    if (options_.every == 1) return;
    std::vector<Index> rows;
    Index since = 0;
    for (Index i = 0; i < data_.states.cols(); ++i, ++since) {
      if (i > 0 && data_.episode[static_cast<std::size_t>(i)] != data_.episode[static_cast<std::size_t>(i - 1)]) since = 0;
      if (since % options_.every == 0) rows.push_back(i);
    }
    data_.states = data_.states(Eigen::all, rows).eval();
    data_.accelerations = data_.accelerations(Eigen::all, rows).eval();
    data_.stddev = data_.stddev(Eigen::all, rows).eval();
    const auto thin = [&](auto& values) {
      for (std::size_t k = 0; k < rows.size(); ++k) values[k] = values[static_cast<std::size_t>(rows[k])];
      values.resize(rows.size());
    };
    thin(data_.episode);
    for (auto& cells : data_.kept) thin(cells);
  }

  const Model& model_;
  const System& system_;
  const CsvTable& log_;
  const DeriveOptions& options_;
  LogReader reader_;
  DerivedData data_;
  int time_column_ = -1;
  std::map<int, int> position_column_, velocity_column_;  // of measured coordinates; −1: not logged
  std::vector<int> input_column_;                         // −1: not logged
  std::vector<Episode> episodes_;
  std::vector<Task> tasks_;
  std::vector<Index> first_row_;  // of each episode
};

}  // namespace

std::vector<Option> options(DeriveOptions& options) {
  std::vector<std::pair<std::string, Smoothness>> orders;
  for (const std::string& word : smoothness_words()) orders.emplace_back(word, *smoothness_of(word));
  return {
      {"episode", &options.episode_column, "COLUMN", "column that tells episodes apart", "episode, where the log has it"},
      {"episodes", &options.episodes, "0-12,15", "only these", "all"},
      {"rate", &options.rate, "HZ", "rows per second, evenly within an episode, through gaps too", "where there are samples"},
      {"every", &options.every, "K", "only each so many rows of an episode"},
      {"hold_constraints", &options.hold_constraints, "",
       "condition each row on the constraints, where more is measured than they leave free"},
      {"outlier_threshold", &options.outlier_threshold, "S",
       "a sample is distrusted that is farther than this many standard deviations from what the others say; 0: none is"},
      {"smoothness", choice(options.smoothness, orders), "", "order of the Matérn kernel of the motion"},
      {"keep", &options.keep, "NAME,…", "further columns of the log to pass on"},
      {"map", &options.columns, "LOGNAME=NAME,…", "columns by other names", "", "columns"},
  };
}

DerivedData derive(const Model& model, const CsvTable& log, const DeriveOptions& options) {
  return Deriver(model, log, options).run();
}

CsvTable as_table(const DerivedData& data, const System& system, std::string name) {
  const StateLayout layout = system.layout();
  const std::vector<std::string> state_names = system.state_names(), acceleration_names = system.acceleration_names();
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& column, const MatrixXd& values, Index row) {
    columns.push_back({column, {values.row(row).begin(), values.row(row).end()}});
  };
  const auto add_known = [&](const std::string& column, const MatrixXd& values, Index row) {
    if (!values.row(row).array().isNaN().any()) add(column, values, row);
  };
  if (!data.episode_column.empty()) {
    std::vector<std::string>& labels = columns.emplace_back(CsvTable::Column{data.episode_column, {}}).cells;
    for (const int episode : data.episode) labels.push_back(data.episodes[static_cast<std::size_t>(episode)]);
  }
  add("t", data.states, layout.t());
  for (int k = 0; k < layout.t(); ++k) add_known(state_names[static_cast<std::size_t>(k)], data.states, k);
  for (int k = layout.u(0); k < layout.size(); ++k) add_known(state_names[static_cast<std::size_t>(k)], data.states, k);
  for (int j = 0; j < layout.nq; ++j) add_known(acceleration_names[static_cast<std::size_t>(j)], data.accelerations, j);
  for (int d = 0; d < 2; ++d) {
    for (const int j : data.measured) {
      const int row = d * layout.nq + j;
      add(state_names[static_cast<std::size_t>(row)] + "_std", data.stddev, row);
    }
  }
  for (const int j : data.independent)
    add(acceleration_names[static_cast<std::size_t>(j)] + "_std", data.stddev, 2 * layout.nq + j);
  for (std::size_t k = 0; k < data.kept.size(); ++k) columns.push_back({data.kept_names[k], {}, data.kept[k]});
  return CsvTable::from_columns(std::move(name), std::move(columns));
}

}  // namespace gp2
