#include "jobs/raw_log.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <numbers>
#include <string_view>
#include <system_error>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/simulate.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

namespace {

constexpr std::size_t least_rows = 5;

// A whole number, all of the text.
std::optional<int> whole_number(std::string_view text) {
  int number = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
  return error == std::errc() && end == text.data() + text.size() ? std::optional(number) : std::nullopt;
}

// {"0-12", "15"} -> 0 … 12, 15; what is no range of whole numbers is a name.
std::vector<std::string> without_ranges(const std::vector<std::string>& items) {
  std::vector<std::string> episodes;
  for (const std::string& item : items) {
    const std::size_t dash = item.find('-', 1);
    const auto first = whole_number(std::string_view(item).substr(0, dash));
    const auto last = dash == std::string::npos ? std::nullopt : whole_number(std::string_view(item).substr(dash + 1));
    if (!first || !last) {
      episodes.push_back(item);
      continue;
    }
    constexpr int most = 1'000'000;
    if (*last < *first || *last - *first > most)
      throw InputError(fmt::format("`episodes`: '{}' is not a range FIRST-LAST, say 0-12", item));
    for (int k = *first; k <= *last; ++k) episodes.push_back(std::to_string(k));
  }
  return episodes;
}

std::string in_episode(const Episode& episode) {
  return episode.label.empty() ? "" : fmt::format(" in episode {}", episode.label);
}

/// Where the samples before say that an angle is by now: on the line through the last few, whose medians no single one spoils.
class Course {
 public:
  [[nodiscard]] double at(double time) const {
    if (last_.empty()) return not_a_number;
    std::vector<double> rates, values;
    for (std::size_t k = 1; k < last_.size(); ++k)
      rates.push_back((last_[k].second - last_[k - 1].second) / (last_[k].first - last_[k - 1].first));
    // across a pause the rate says little
    constexpr double reach = 20;
    const double step = rates.empty() ? 0 : (last_.back().first - last_.front().first) / static_cast<double>(rates.size());
    const double rate = rates.size() < 2 || time - last_.back().first > reach * step ? 0 : median(rates);
    for (const auto& [before, value] : last_) values.push_back(value + rate * (time - before));
    return last_.size() < 3 ? values.back() : median(values);
  }

  void add(double time, double value) {
    constexpr std::size_t most = 5;
    if (!last_.empty() && !(time > last_.back().first)) return;
    last_.emplace_back(time, value);
    if (last_.size() > most) last_.erase(last_.begin());
  }

 private:
  std::vector<std::pair<double, double>> last_;  // time, value
};

/// Samples that an encoder gave the same value have one error between them, not one each.
void share_out_runs(std::vector<Measurement>& positions) {
  for (std::size_t first = 0, last = 0; first < positions.size(); first = last) {
    while (last < positions.size() && positions[last].value == positions[first].value) ++last;
    const double factor = std::sqrt(static_cast<double>(last - first));
    for (std::size_t k = first; k < last; ++k) positions[k].noise_factor = factor;
  }
}

/// A sensor that is slower than the log holds each value for k rows: of these the first is kept, the others are no samples.
/// @param steady  whether equal values come from a coarse encoder too, and then not always k at a time
/// @return k; 1: where it is not so
int leave_out_held(std::vector<Measurement>& samples, bool steady) {
  constexpr std::size_t fewest = 20;  // values
  constexpr double share = 0.95;
  std::vector<std::size_t> starts;
  for (std::size_t i = 1; i < samples.size(); ++i) {
    if (samples[i].value != samples[i - 1].value) starts.push_back(i);
  }
  if (starts.size() < fewest) return 1;
  std::vector<std::size_t> runs;
  for (std::size_t i = 1; i < starts.size(); ++i) runs.push_back(starts[i] - starts[i - 1]);
  const auto k = static_cast<std::size_t>(median({runs.begin(), runs.end()}));
  const auto n_regular = std::ranges::count_if(runs, [&](std::size_t n) { return steady ? n % k == 0 : n <= k + 1; });
  if (k < 2 || static_cast<double>(n_regular) < share * static_cast<double>(runs.size())) return 1;
  std::vector<Measurement> kept;
  std::size_t next = starts.front() % k;  // before the first change no one knows where a value began
  for (std::size_t i = 0; i < samples.size(); ++i) {
    if (i > 0 && samples[i].value != samples[i - 1].value) next = i;
    if (i != next) continue;
    kept.push_back(samples[i]);
    next += k;
  }
  samples = std::move(kept);
  return static_cast<int>(k);
}

// Its values become those about their mean.
void centre(Channel& channel) {
  const auto n = static_cast<double>(channel.measurements.size());
  for (const Measurement& one : channel.measurements) channel.mean += one.value / n;
  for (Measurement& one : channel.measurements) one.value -= channel.mean;
}

std::vector<double> values_of(const std::vector<Measurement>& measurements) {
  std::vector<double> values;
  for (const Measurement& one : measurements) values.push_back(one.value);
  return values;
}

// Samples whose value differs from that before by more than half a turn.
int jumps_of(const std::vector<Measurement>& angles) {
  int jumps = 0;
  for (std::size_t k = 1; k < angles.size(); ++k) {
    jumps += std::abs(angles[k].value - angles[k - 1].value) > std::numbers::pi ? 1 : 0;
  }
  return jumps;
}

void check_options(const DeriveOptions& options) {
  if (!(options.rate >= 0) || !std::isfinite(options.rate))
    throw InputError(fmt::format("`rate`: must not be negative, got {}", options.rate));
  if (options.every < 1) throw InputError(fmt::format("`every`: must be at least 1, got {}", options.every));
  if (!(options.outlier_threshold >= 0)) {
    throw InputError(fmt::format("`outlier_threshold`: must not be negative, got {}", options.outlier_threshold));
  }
  if (options.rate > 0 && !options.keep.empty()) {
    throw InputError("`keep` copies rows of the log, and those of an even `rate` are others: leave out either");
  }
}

}  // namespace

bool is_missing(const std::string& cell) {
  std::string word = cell;
  for (char& c : word) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return word.empty() || word == "nan" || word == "-nan" || word == "na" || word == "null" || word == "none";
}

RawLog::RawLog(const Model& model, const CsvTable& log, const DeriveOptions& options)
    : system_(*model.system), log_(log), options_(options), reader_(open_log(model, log, options.columns)) {
  if (!contacts_of(model, system_.parameter_values()).empty()) {
    throw InputError(
        fmt::format("{}: '{}' has contacts: velocities jump at impacts, so positions cannot be smoothed across them; give a log "
                    "with velocities and accelerations, or raw logs of stretches without an impact and a model without contacts",
                    log.name(), system_.name()));
  }
  check_options(options);
  find_columns();
  find_episodes();
  split_at_pauses();
}

std::string RawLog::place_of(int column) const {
  return fmt::format("{}: column '{}'", log_.name(), log_.header()[static_cast<std::size_t>(column)]);
}

void RawLog::find_columns() {
  if (!reader_.has("t")) static_cast<void>(reader_.values({"t"}));  // throws, and says what there is
  time_column_ = reader_.column("t");
  for (int j = 0; j < system_.nq(); ++j) {
    const Coordinate& coordinate = system_.coordinates()[static_cast<std::size_t>(j)];
    const int position = reader_.column(coordinate.name);
    if (position >= 0) {
      measured_.push_back(j);
      position_column_[j] = position;
      velocity_column_[j] = reader_.column(coordinate.velocity());
    } else if (reader_.has(coordinate.velocity())) {
      notes.push_back(
          fmt::format("{} is not used: without {} there is no motion to smooth", coordinate.velocity(), coordinate.name));
    }
  }
  if (measured_.empty()) {
    std::vector<std::string> names;
    for (const Coordinate& coordinate : system_.coordinates()) names.push_back(coordinate.name);
    throw InputError(
        fmt::format("{}: no column is a coordinate of '{}' ({}); the file has: {}. Rename them, or give `map=LOGNAME={}`",
                    log_.name(), system_.name(), fmt::join(names, ", "), fmt::join(log_.header(), ", "), names.front()));
  }
  for (const std::string& input : system_.inputs()) {
    input_column_.push_back(reader_.column(input));
    if (input_column_.back() < 0) notes.push_back(fmt::format("the log has no input {}", input));
  }
  std::vector<std::string> unused = reader_.unused_columns();
  std::erase_if(unused, [&](const std::string& name) {
    const std::string episode = options_.episode_column.empty() ? "episode" : options_.episode_column;
    return name == episode || std::ranges::count(options_.keep, name) > 0;
  });
  if (!unused.empty()) notes.push_back(fmt::format("{}: columns not needed: {}", log_.name(), fmt::join(unused, ", ")));
  for (const std::string& name : options_.keep) {
    if (log_.find(name) < 0) {
      throw InputError(
          fmt::format("`keep`: {} has no column '{}'; it has: {}", log_.name(), name, fmt::join(log_.header(), ", ")));
    }
  }
  std::ranges::move(reader_.notes(), std::back_inserter(notes));
}

void RawLog::find_episodes() {
  const std::string name = options_.episode_column.empty() ? "episode" : options_.episode_column;
  const int column = log_.find(name);
  if (column < 0 && !options_.episode_column.empty()) {
    throw InputError(
        fmt::format("`episode`: {} has no column '{}'; it has: {}", log_.name(), name, fmt::join(log_.header(), ", ")));
  }
  if (column < 0 && !options_.episodes.empty()) {
    throw InputError(fmt::format("`episodes`: {} has no column 'episode' to choose from; name it by `episode`", log_.name()));
  }
  if (column >= 0) episode_column_ = name;
  std::set<std::string> known;
  std::vector<std::string> labels;
  std::optional<int> without;  // a row
  for (int row = 0; row < log_.n_rows(); ++row) {
    const std::string label = column < 0 ? "" : log_.cell(row, column);
    if (known.insert(label).second) labels.push_back(label);
    if (label.empty() && !without) without = row;
  }
  if (without && labels.size() > 1) {
    throw InputError(
        fmt::format("{}: the cell is empty: rows without an episode belong to none; fill it in, or leave the row out",
                    log_.place(*without, column)));
  }
  const std::vector<std::string> all_wanted = without_ranges(options_.episodes);
  for (const std::string& wanted : all_wanted) {
    if (!known.contains(wanted)) {
      throw InputError(
          fmt::format("`episodes`: {} has no episode '{}'; it has: {}", log_.name(), wanted, fmt::join(labels, ", ")));
    }
  }
  const std::set<std::string> taken(all_wanted.begin(), all_wanted.end());
  std::map<std::string, std::size_t> place;
  for (const std::string& label : labels) {
    if (!taken.empty() && !taken.contains(label)) continue;
    place[label] = episodes_.size();
    episodes_.push_back({label, {}, {}, 0, {}});
  }
  for (int row = 0; row < log_.n_rows(); ++row) {
    const auto found = place.find(column < 0 ? "" : log_.cell(row, column));
    if (found == place.end()) continue;
    Episode& episode = episodes_[found->second];
    const double time = log_.number(row, time_column_);
    if (episode.rows.empty()) episode.start = time;
    const double since = time - episode.start;
    if (!episode.times.empty() && since < episode.times.back()) {
      throw InputError(fmt::format("{}: time runs backwards{} at data row {}: {} after {}. Sort the rows{}",
                                   place_of(time_column_), in_episode(episode), row + 1, time,
                                   episode.start + episode.times.back(),
                                   column < 0 ? ", or give the column that numbers the episodes" : ""));
    }
    if (episode.times.empty() || since > episode.times.back()) episode.distinct.push_back(since);
    episode.rows.push_back(row);
    episode.times.push_back(since);
  }
}

/// Seconds in what the times count, by the usual step.
double RawLog::unit_of(double usual_step) {
  struct Unit {
    TimeUnit unit;
    const char* name;
    double seconds, below;
  };
  static constexpr std::array<Unit, 4> units = {{{TimeUnit::seconds, "seconds", 1, 0.5},
                                                 {TimeUnit::milliseconds, "milliseconds", 1e-3, 500},
                                                 {TimeUnit::microseconds, "microseconds", 1e-6, 5e5},
                                                 {TimeUnit::nanoseconds, "nanoseconds", 1e-9, HUGE_VAL}}};
  const bool automatic = options_.time_unit == TimeUnit::automatic;
  const Unit& unit = *std::find_if(units.begin(), units.end(), [&](const Unit& one) {
    return automatic ? usual_step < one.below : one.unit == options_.time_unit;
  });
  if (automatic && unit.unit != TimeUnit::seconds) {
    notes.push_back(fmt::format("{} is assumed to be in {}: its usual step is {:.6g}; give `time_unit=s` if it is in seconds",
                                place_of(time_column_), unit.name, usual_step));
  }
  return unit.seconds;
}

/// Steps of the coordinate that is measured most often: rows of other columns may lie a few µs beside its own.
std::vector<double> RawLog::steps_between_samples() const {
  std::vector<double> most;
  for (const int j : measured_) {
    std::vector<double> steps;
    for (const Episode& episode : episodes_) {
      double before = not_a_number;
      for (std::size_t k = 0; k < episode.rows.size(); ++k) {
        if (is_missing(log_.cell(episode.rows[k], position_column_.at(j)))) continue;
        if (episode.times[k] > before) steps.push_back(episode.times[k] - before);
        before = episode.times[k];
      }
    }
    if (steps.size() > most.size()) most = std::move(steps);
  }
  return most;
}

// What comes after a long pause is no continuation: times from one start would lose digits, and nothing bridges it.
void RawLog::split_at_pauses() {
  constexpr double pause = 1000;  // usual steps
  std::vector<double> steps;
  for (const Episode& episode : episodes_) {
    for (std::size_t k = 1; k < episode.distinct.size(); ++k) steps.push_back(episode.distinct[k] - episode.distinct[k - 1]);
    if (episode.rows.size() >= least_rows && episode.distinct.size() == 1) {
      throw InputError(fmt::format("{}: all {} rows{} have the time {}; without times there are no velocities",
                                   place_of(time_column_), episode.rows.size(), in_episode(episode), episode.start));
    }
  }
  if (steps.empty()) return;
  if (std::vector<double> of_samples = steps_between_samples(); !of_samples.empty()) steps = std::move(of_samples);
  const double usual = median(steps), unit = unit_of(usual);
  std::vector<Episode> parts;
  int n_pauses = 0, n_left_out = 0;
  double longest = 0;
  for (const Episode& episode : episodes_) {
    std::vector<Episode> of_this;
    for (std::size_t k = 0; k < episode.rows.size(); ++k) {
      const double since = episode.times[k];
      if (k == 0 || since - episode.times[k - 1] > pause * usual) {
        if (k > 0) longest = std::max(longest, unit * (since - episode.times[k - 1]));
        // the log's own number: a difference from the far start has lost digits
        of_this.push_back({episode.label, {}, {}, log_.number(episode.rows[k], time_column_), {}});
      }
      Episode& part = of_this.back();
      const double here = unit * (log_.number(episode.rows[k], time_column_) - part.start);
      if (part.times.empty() || here > part.times.back()) part.distinct.push_back(here);
      part.rows.push_back(episode.rows[k]);
      part.times.push_back(here);
    }
    n_pauses += static_cast<int>(of_this.size()) - 1;
    for (Episode& part : of_this) {
      part.start *= unit;
      if (of_this.size() > 1 && !moves(part)) {
        n_left_out += static_cast<int>(part.rows.size());
      } else {
        parts.push_back(std::move(part));
      }
    }
  }
  if (n_pauses > 0) {
    notes.push_back(fmt::format(
        "warning: {} pauses {}, for {:.3g} s at most: each part is smoothed separately{}", place_of(time_column_),
        n_pauses == 1 ? "once" : fmt::format("{} times", n_pauses), longest,
        n_left_out > 0 ? fmt::format("; {} rows of parts that are too short, or where nothing moves, are left out", n_left_out)
                       : ""));
  }
  if (parts.empty()) {
    throw InputError(
        fmt::format("{}: in every part between pauses of more than {:g} usual steps there are too few samples, or nothing moves",
                    place_of(time_column_), pause));
  }
  episodes_ = std::move(parts);
}

/// Whether every measured coordinate has enough samples in a part, and two of them differ.
bool RawLog::moves(const Episode& part) const {
  return std::all_of(measured_.begin(), measured_.end(), [&](int j) {
    std::size_t n = 0;
    std::set<double> values;
    for (const int row : part.rows) {
      if (is_missing(log_.cell(row, position_column_.at(j)))) continue;
      ++n;
      if (values.size() < 2) values.insert(log_.number(row, position_column_.at(j)));
    }
    return n >= least_rows && values.size() > 1;
  });
}

/// Values of a column at the times of an episode, in the order of the log.
void RawLog::read_column(const Episode& episode, int column, bool velocity, Channel& channel) const {
  std::vector<double> at_one_time;
  double time = not_a_number;
  for (std::size_t k = 0; k < episode.rows.size(); ++k) {
    if (is_missing(log_.cell(episode.rows[k], column))) {
      ++channel.missing;
      continue;
    }
    const double value = log_.number(episode.rows[k], column);
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

/// Takes the turns out of an angle that is written within one turn.
void RawLog::unwrap(const Episode& episode, int column, Channel& channel) {
  constexpr double turn = 2 * std::numbers::pi;
  int jumps = jumps_of(channel.measurements);
  if (jumps == 0) return;
  std::vector<double> values = values_of(channel.measurements);
  if (is_wrapped_in_degrees(values)) {
    throw InputError(
        fmt::format("{}{} jumps by 360 from sample to sample: it is in degrees, but angles must be in rad. Convert it",
                    place_of(column), in_episode(episode)));
  }
  // single errors do not count
  std::sort(values.begin(), values.end());
  const std::size_t aside = values.size() / 50;
  const double range = values[values.size() - 1 - aside] - values[aside];
  constexpr double little = 0.05;  // of a turn
  if (range <= (1 + little) * turn) {
    Course course;
    double turns = 0;
    for (Measurement& one : channel.measurements) {
      const double expected = course.at(one.time);
      const double here = std::isnan(expected) ? 0 : std::round((expected - one.value) / turn);
      one.value += turn * here;
      channel.wraps += here != turns ? 1 : 0;
      turns = here;
      course.add(one.time, one.value);
    }
    jumps = std::max(jumps_of(channel.measurements), channel.wraps);
  }
  constexpr double often = 0.2;
  if (jumps > often * static_cast<double>(values.size())) {
    notes.push_back(
        fmt::format("warning: {}{} moves by more than half a turn between {} of {} samples, over a range of {:.3g}: is "
                    "it in rad, and sampled often enough?",
                    place_of(column), in_episode(episode), jumps, values.size(), range));
  }
}

void RawLog::require_motion(const Episode& episode, int column, const Channel& channel) const {
  const std::string where = place_of(column) + in_episode(episode);
  const std::string way_out = episode.label.empty() ? "" : "; leave that episode out";
  if (channel.measurements.size() < least_rows) {
    throw InputError(fmt::format("{}: {} samples are too few to find a motion in; {} are needed{}", where,
                                 channel.measurements.size(), least_rows, way_out));
  }
  if (channel.measurements.front().time == channel.measurements.back().time) {
    throw InputError(fmt::format("{}: all {} samples have t = {}{}", where, channel.measurements.size(),
                                 channel.measurements.front().time, way_out));
  }
  const double first = channel.measurements.front().value;
  if (std::all_of(channel.measurements.begin(), channel.measurements.end(),
                  [&](const Measurement& one) { return one.value == first; })) {
    throw InputError(fmt::format("{}: all {} values are {}: nothing moves, so there is neither velocity nor noise to find{}",
                                 where, channel.measurements.size(), first, way_out));
  }
}

Channel RawLog::motion(int coordinate, const Episode& episode) {
  const int column = position_column_.at(coordinate);
  Channel channel;
  read_column(episode, column, false, channel);
  require_motion(episode, column, channel);
  channel.resolution = resolution_of(values_of(channel.measurements));
  const std::size_t n_read = channel.measurements.size();
  if (const int held = leave_out_held(channel.measurements, channel.resolution > 0); held > 1) {
    channel.repeated += static_cast<int>(n_read - channel.measurements.size());
    notes.push_back(fmt::format("{}{}: each value stands in {} rows: only the first of these is a sample", place_of(column),
                                in_episode(episode), held));
  }
  if (system_.coordinates()[static_cast<std::size_t>(coordinate)].angle) unwrap(episode, column, channel);
  centre(channel);
  if (channel.resolution > 0) share_out_runs(channel.measurements);
  if (velocity_column_.at(coordinate) >= 0) {
    read_column(episode, velocity_column_.at(coordinate), true, channel);
    std::stable_sort(channel.measurements.begin(), channel.measurements.end(),
                     [](const Measurement& a, const Measurement& b) { return a.time < b.time; });
  }
  return channel;
}

Channel RawLog::input(std::size_t input, const Episode& episode) const {
  Channel channel;
  read_column(episode, input_column_[input], false, channel);
  if (channel.measurements.empty()) {
    throw InputError(fmt::format("{}{}: there is no value", place_of(input_column_[input]), in_episode(episode)));
  }
  centre(channel);
  return channel;
}

}  // namespace gp2
