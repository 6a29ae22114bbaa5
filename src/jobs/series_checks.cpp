#include "jobs/series_checks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <numbers>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/decompositions.hpp"
#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "jobs/rate_check.hpp"

namespace gp2 {

namespace {

const std::string& coordinate_name(const System& system, int coordinate) {
  return system.coordinates()[static_cast<std::size_t>(coordinate)].name;
}

/// A position that jumps and stays there, as that of an encoder which was set anew, or was stuck until then.
struct Jump {
  double time = 0, by = 0;
  int n_equal = 0;  // samples before it
};

/// @param all  in order of time
std::optional<Jump> jump_of(const std::vector<Measurement>& all) {
  constexpr std::size_t fewest = 50, window = 5;
  constexpr double fast = 10, far = 20;  // times the usual step, times the smallest one
  std::vector<double> times, values, steps, rates;
  for (const Measurement& one : all) {
    if (one.velocity || (!times.empty() && !(one.time > times.back()))) continue;
    if (!times.empty()) {
      steps.push_back(std::abs(one.value - values.back()));
      rates.push_back(steps.back() / (one.time - times.back()));
    }
    times.push_back(one.time);
    values.push_back(one.value);
  }
  if (times.size() < fewest) return std::nullopt;
  const auto usual = [](std::vector<double> of) {  // of all but one in a hundred the largest
    const auto at = of.begin() + static_cast<std::ptrdiff_t>(of.size() * 99 / 100);
    std::nth_element(of.begin(), at, of.end());
    return *at;
  };
  const auto middle = [&](std::size_t first) {
    std::array<double, window> some = {};
    std::copy_n(values.begin() + static_cast<std::ptrdiff_t>(first), window, some.begin());
    std::nth_element(some.begin(), some.begin() + window / 2, some.end());
    return some[window / 2];
  };
  double smallest = std::numeric_limits<double>::infinity();
  for (const double step : steps) smallest = step > 0 ? std::min(smallest, step) : smallest;
  const double usual_step = usual(steps), usual_rate = usual(rates);
  for (std::size_t i = window; i + window <= times.size(); ++i) {  // from i − 1 to i
    const double step = steps[i - 1];
    if (!(step > fast * usual_step && rates[i - 1] > fast * usual_rate && step > far * smallest)) continue;
    // all others about it go on as usual, and it does not come back
    bool is_alone = true;
    for (std::size_t k = i - window; k + 1 < i + window; ++k) is_alone = is_alone && (k == i - 1 || fast * steps[k] < step);
    if (!is_alone || std::abs(middle(i) - middle(i - window)) < step / 2) continue;
    Jump found{times[i], values[i] - values[i - 1], 1};
    for (std::size_t k = i - 1; k > 0 && steps[k - 1] == 0; --k) ++found.n_equal;
    return found;
  }
  return std::nullopt;
}

/// @returns whether it was said that the sensor was stuck before
bool warn_of_jump(const Coordinate& coordinate, const std::string& log, double start, const Jump& jump,
                  std::vector<std::string>& notes) {
  constexpr double turn = 2 * std::numbers::pi, about = 0.05;
  if (!coordinate.angle && std::abs(std::abs(jump.by) / turn - 1) < about) {
    notes.push_back(fmt::format(
        "warning: {}: {} jumps by {:.3g} at t = {:.6g}, about a whole turn: if it is an angle that wraps, write angle = true "
        "in the model",
        log, coordinate.name, jump.by, start + jump.time));
    return false;
  }
  constexpr int many = 20;
  const bool was_stuck = jump.n_equal >= many;
  notes.push_back(fmt::format(
      "warning: {}: {} jumps by {:.3g} at t = {:.6g} and stays there{}", log, coordinate.name, jump.by, start + jump.time,
      !was_stuck ? ": was its encoder set anew? Split the log there by a column 'episode'"
                 : fmt::format(", after {} equal samples: was its sensor stuck? Leave these rows out and split "
                               "the log there by a column 'episode'",
                               jump.n_equal)));
  return was_stuck;
}

// Of a series, in order of time, without velocities.
struct Positions {
  std::vector<double> times, values;
};

Positions positions_of(const std::vector<Measurement>& all) {
  Positions out;
  for (const Measurement& one : all) {
    if (!one.velocity) out.times.push_back(one.time), out.values.push_back(one.value);
  }
  return out;
}

Still longest_still(const std::vector<Measurement>& all) {
  const Positions positions = positions_of(all);
  const std::vector<EqualRun> runs = equal_runs(positions.values);
  if (runs.empty()) return {};
  const EqualRun& longest = *std::ranges::max_element(runs, {}, &EqualRun::n);
  return {static_cast<int>(longest.n), positions.times[longest.first], positions.times[longest.first + longest.n - 1]};
}

// Evenly spaced times at which samples may have been taken, and how much better the positions of a coordinate suit them.
struct EvenClock {
  double step = 0, deviation = 0;  // rms of the logged times about the even ones [s]
  double gain = 0;                 // the error of positions predicted from their neighbours at the logged times, in multiples of
                                   // that at even ones
};

// The number of each sample on a clock of constant steps, those that were dropped counted too where there may be some.
std::vector<double> numbers_on_even_clock(const std::vector<double>& times, bool may_drop) {
  constexpr double correction = 0.1;  // of what a sample is off, for a step that is a little different
  std::vector<double> steps;
  for (std::size_t i = 1; i < times.size(); ++i) steps.push_back(times[i] - times[i - 1]);
  const double usual = median(steps);
  double number = 0, tick = times.front();  // the last one, and its time
  std::vector<double> numbers(1, 0);
  for (std::size_t i = 1; i < times.size(); ++i) {
    const double n = may_drop ? std::round((times[i] - tick) / usual) : 1;
    number += n;
    tick += n * usual;
    tick += correction * (times[i] - tick);
    numbers.push_back(std::max(numbers.back() + 1, number));
  }
  return numbers;
}

// The standardised error of the middle one of seven values under a polynomial of the fourth degree through the other six: of values
// that are noise alone it has the deviation of the noise, however the times lie.
double error_of_middle(const std::vector<double>& times, const std::vector<double>& values, std::size_t middle, double step) {
  constexpr int n_beside = 3, n_terms = 5;
  Eigen::MatrixXd powers(n_terms, 2 * n_beside);
  Eigen::VectorXd beside(2 * n_beside);
  int at = 0;
  for (std::size_t k = middle - n_beside; k <= middle + n_beside; ++k) {
    if (k == middle) continue;
    const double x = (times[k] - times[middle]) / (n_beside * step);
    for (int p = 0; p < n_terms; ++p) powers(p, at) = std::pow(x, p);
    beside[at++] = values[k] - values[middle];
  }
  // the value at 0 is linear in the others
  const Eigen::VectorXd weights = least_squares(powers, Eigen::VectorXd::Unit(n_terms, 0));
  return std::abs(weights.dot(beside)) / std::sqrt(1 + weights.squaredNorm());
}

// The evenly spaced times next to the logged ones, of samples whose numbers follow one another or leave out some.
struct EvenTimes {
  std::vector<double> numbers, times;
  double step = 0, deviation = 0;  // of the logged times, rms
};

EvenTimes even_times_of(const std::vector<double>& logged, bool may_drop) {
  EvenTimes out{numbers_on_even_clock(logged, may_drop), {}};
  // the straight line of times over numbers
  const Eigen::Map<const Eigen::ArrayXd> t(logged.data(), std::ssize(logged)), k(out.numbers.data(), std::ssize(logged));
  out.step = ((t - t.mean()) * (k - k.mean())).sum() / (k - k.mean()).square().sum();
  const Eigen::ArrayXd even = t.mean() + out.step * (k - k.mean());
  out.deviation = std::sqrt((t - even).square().mean());
  out.times = {even.begin(), even.end()};
  return out;
}

std::optional<EvenClock> even_clock_of(const std::vector<Measurement>& all, double resolution) {
  constexpr std::size_t fewest = 50, enough = 20'000, n_beside = 3;
  constexpr double least = 0.01, most = 0.3;  // of a step: what is worth a word, and 1/√12, as of times at random
  constexpr double rounding = 1e-8;           // of the range
  const auto [times, values] = positions_of(all);
  if (times.size() < fewest || std::ranges::adjacent_find(times, std::greater_equal<>()) != times.end()) return std::nullopt;
  EvenTimes even = even_times_of(times, false);
  if (EvenTimes with_drops = even_times_of(times, true); with_drops.deviation < even.deviation) even = std::move(with_drops);
  if (!(even.deviation > least * even.step && even.deviation < most * even.step)) return std::nullopt;
  std::vector<double> at_logged, at_even;
  const std::size_t stride = 1 + times.size() / enough;
  for (std::size_t i = n_beside; i + n_beside < times.size(); i += stride) {
    if (even.numbers[i + n_beside] - even.numbers[i - n_beside] != 2 * n_beside) continue;
    at_logged.push_back(error_of_middle(times, values, i, even.step));
    at_even.push_back(error_of_middle(even.times, values, i, even.step));
  }
  const auto [smallest, largest] = std::ranges::minmax(values);
  const double floor = std::max(resolution / std::sqrt(12.0), rounding * (largest - smallest));
  if (at_even.size() < fewest / 2 || !(floor > 0)) return std::nullopt;
  return EvenClock{even.step, even.deviation, std::max(median(at_logged), floor) / std::max(median(at_even), floor)};
}

// Whether, of an episode, evenly spaced times make some coordinate much smoother and none rougher.
void warn_of_a_wrong_clock(const System& system, const std::string& log, const std::vector<Episode>& episodes,
                           const std::vector<SmoothedSeries>& all, DerivedData& data) {
  constexpr double much = 3, little = 1.25;
  std::optional<EvenClock> worst;
  std::vector<std::string> smoother;
  for (int e = 0; e < std::ssize(episodes); ++e) {
    std::optional<EvenClock> here;
    std::vector<std::string> names;
    bool is_rougher = false;
    for (const SmoothedSeries& series : all) {
      if (series.episode != e) continue;
      const std::optional<EvenClock> one = even_clock_of(series.channel.measurements, series.channel.resolution);
      if (!one) continue;
      is_rougher = is_rougher || one->gain * little < 1;
      if (!(one->gain > much)) continue;
      names.push_back(coordinate_name(system, series.coordinate));
      if (!here || one->gain > here->gain) here = one;
    }
    if (is_rougher || !here || (worst && worst->gain >= here->gain)) continue;
    worst = here;
    smoother = std::move(names);
  }
  if (!worst) return;
  data.notes.push_back(fmt::format(
      "warning: {}: the times are not those of the samples: at times {:.4g} s apart, from which they deviate by {:.2g} s rms, {} "
      "would be smoother, by a factor of up to {:.2g}; write an evenly spaced t",
      log, worst->step, worst->deviation, fmt::join(smoother, ", "), worst->gain));
}

// noise that no encoder's step hides does not pause
void warn_of_stuck_sensors(const System& system, const std::string& log, const std::vector<SeriesChecks>& checks,
                           DerivedData& data) {
  constexpr int many = 20;
  for (std::size_t k = 0; k < checks.size(); ++k) {
    const Still& still = checks[k].still;
    const DerivedSeries& series = data.series[k];
    if (still.n < many || series.resolution > 0 || series.noise_unseen || checks[k].jumps_after_still) continue;
    data.notes.push_back(fmt::format(
        "warning: {}: {} is the same in {} samples, from t = {:.6g} to {:.6g}, although it has noise: was its "
        "sensor stuck? Leave these rows out",
        log, coordinate_name(system, series.coordinate), still.n, series.start + still.first, series.start + still.last));
  }
}

/// What else the velocities of a coordinate would have to be; empty where they are right, or few.
std::string better_rate_of(const std::vector<Measurement>& all, const Coordinate& coordinate) {
  constexpr std::size_t fewest = 30, enough = 300'000;
  std::vector<double> times, values, rates;
  for (const Measurement& one : all) {  // at one time positions come first
    if (one.velocity) {
      if (!times.empty() && times.back() == one.time) rates.back() = one.value;
    } else if (times.empty() || one.time > times.back()) {
      if (times.size() == enough) break;
      times.push_back(one.time), values.push_back(one.value), rates.push_back(not_a_number);
    }
  }
  if (std::ranges::count_if(rates, [](double one) { return !std::isnan(one); }) < std::ssize(rates) / 2) return "";
  if (times.size() < fewest) return "";
  const auto row = [](const std::vector<double>& of) -> Eigen::RowVectorXd {
    return Eigen::Map<const Eigen::RowVectorXd>(of.data(), std::ssize(of));
  };
  return better_rate({row(times), coordinate.name, row(values), coordinate.angle, {row(rates)}, {coordinate.velocity()}, 0});
}

/// Velocities that are not the rates of their positions: merged with them they would spoil both.
void leave_out_wrong_velocities(const System& system, const std::string& log, std::vector<SmoothedSeries>& all,
                                DerivedData& data) {
  for (const int j : data.measured) {
    const Coordinate& coordinate = system.coordinates()[static_cast<std::size_t>(j)];
    std::string reason;
    int n = 0, n_wrong = 0;
    for (SmoothedSeries& series : all) {
      if (series.coordinate != j) continue;
      ++n;
      const std::string text = better_rate_of(series.channel.measurements, coordinate);
      if (text.empty()) continue;
      ++n_wrong;
      if (reason.empty()) reason = text;
    }
    if (n_wrong == 0) continue;
    for (SmoothedSeries& series : all) {
      if (series.coordinate == j) std::erase_if(series.channel.measurements, [](const Measurement& one) { return one.velocity; });
    }
    data.notes.push_back(fmt::format("warning: {}: {} is not the rate of {} over t{}: {}. It is left out", log,
                                     coordinate.velocity(), coordinate.name,
                                     n > 1 ? fmt::format(" in {} of {} episodes", n_wrong, n) : "", reason));
  }
}

// whether there is one; samples of one time that lie apart by the motion's speed are no noise
bool warn_of_a_coarse_clock(const System& system, const std::string& log, const std::vector<SeriesChecks>& checks,
                            DerivedData& data) {
  std::vector<std::string> moved;
  SameTimes largest;
  for (const int j : data.measured) {
    SameTimes all;
    for (std::size_t k = 0; k < checks.size(); ++k) {
      if (data.series[k].coordinate == j) all += checks[k].same_times;
    }
    if (!all.tell_of_a_coarse_clock()) continue;
    moved.push_back(coordinate_name(system, j));
    if (all.n_pairs > largest.n_pairs) largest = all;
  }
  if (moved.empty()) return false;
  data.notes.push_back(
      fmt::format("warning: {}: the clock is coarser than the samples: {:.0f} samples have the time of the one before, "
                  "although {} moved in between, by about {:.2g} s; log times as precisely as positions, or, if samples are "
                  "evenly spaced, an evenly spaced t",
                  log, largest.n_pairs, fmt::join(moved, ", "), largest.delay()));
  return true;
}

/// Whether the deviations of the accelerations are no small part of these.
bool is_smoothed_away(const DerivedSeries& series, const EpisodeRows& rows, const DerivedData& data) {
  constexpr double little = 0.02;
  const auto rms = [&](const auto& row) { return std::sqrt(row.segment(rows.first, rows.n()).array().square().mean()); };
  return rms(data.stddev.row(2 * data.accelerations.rows() + series.coordinate)) >
         little * rms(data.accelerations.row(series.coordinate));
}

// heavy tails, or many that stand out, may be the sensor's; where the motion fills the band that samples can tell they are the motion's
void warn_of_fast_motions(const System& system, const std::string& log, const std::vector<EpisodeRows>& rows, DerivedData& data) {
  constexpr double even = 6;     // kurtosis, 3 for a normal distribution; errors beyond 3 × the best had more in simulated logs
  constexpr double many = 0.02;  // of the samples, that are left out
  constexpr double share = 0.5;  // of the Nyquist frequency
  for (const int j : data.measured) {
    int n = 0, n_fast = 0;
    double rate = 0;
    for (const DerivedSeries& one : data.series) {
      if (one.coordinate != j || one.noise_unseen) continue;
      ++n;
      const bool stands_out = one.kurtosis > even || one.outliers >= many * (one.used + one.outliers);
      if (!stands_out || !(one.bandwidth > share * one.rate / 2) ||
          !is_smoothed_away(one, rows[static_cast<std::size_t>(one.episode)], data))
        continue;
      ++n_fast;
      rate = one.rate;
    }
    if (n_fast == 0) continue;
    data.notes.push_back(
        fmt::format("warning: {}: {} moves too fast in places for {:.3g} samples per second{}: there its "
                    "accelerations are smoothed too much; log at a higher rate",
                    log, coordinate_name(system, j), rate, n > 1 ? fmt::format(", in {} of {} episodes", n_fast, n) : ""));
  }
}

}  // namespace

SameTimes& SameTimes::operator+=(const SameTimes& more) {
  n_pairs += more.n_pairs, n_times += more.n_times;
  d_d += more.d_d, d_rate += more.d_rate, rate_rate += more.rate_rate;
  return *this;
}

bool SameTimes::tell_of_a_coarse_clock() const {
  constexpr double least_pairs = 20, share = 0.1, certain = 6, much = 2;
  if (n_pairs < least_pairs || n_pairs < share * n_times || !(delay() > 0)) return false;
  const double noise = std::max(0.0, d_d - delay() * d_rate) / n_pairs;  // variance of a difference
  return d_rate * d_rate > certain * certain * noise * rate_rate && delay() * d_rate / n_pairs > much * much * noise / 2;
}

SameTimes same_times_of(const std::vector<Measurement>& used) {
  struct Instant {
    double time = 0, sum = 0, n = 0;
    [[nodiscard]] double mean() const { return sum / n; }
  };
  std::vector<Instant> instants;
  for (const Measurement& one : used) {
    if (one.velocity) continue;
    if (instants.empty() || one.time > instants.back().time) instants.push_back({one.time, 0, 0});
    instants.back().sum += one.value, ++instants.back().n;
  }
  SameTimes out;
  out.n_times = static_cast<double>(instants.size());
  const Measurement* before = nullptr;
  std::size_t at = 0;
  for (const Measurement& one : used) {
    if (one.velocity) continue;
    while (instants[at].time < one.time) ++at;
    if (before && before->time == one.time && at > 0 && at + 1 < instants.size()) {
      // from the times beside, whose noise is not that of the difference
      const double rate = (instants[at + 1].mean() - instants[at - 1].mean()) / (instants[at + 1].time - instants[at - 1].time);
      const double d = one.value - before->value;
      ++out.n_pairs, out.d_d += d * d, out.d_rate += d * rate, out.rate_rate += rate * rate;
    }
    before = &one;
  }
  return out;
}

std::vector<EqualRun> equal_runs(const std::vector<double>& values) {
  std::vector<EqualRun> runs;
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (std::isnan(values[i])) continue;
    if (i > 0 && values[i] == values[i - 1]) {
      ++runs.back().n;
    } else {
      runs.push_back({i, 1});
    }
  }
  return runs;
}

std::string with_warnings(std::string text, const std::vector<std::string>& notes) {
  for (const std::string& note : notes) {
    if (note.starts_with("warning: ")) text += "\n" + note;
  }
  return text;
}

std::vector<SeriesChecks> check_measured(const System& system, const std::string& log, const std::vector<Episode>& episodes,
                                         std::vector<SmoothedSeries>& all, DerivedData& data) {
  leave_out_wrong_velocities(system, log, all, data);
  std::vector<SeriesChecks> checks(all.size());
  for (std::size_t k = 0; k < all.size(); ++k) {
    const std::vector<Measurement>& measurements = all[k].channel.measurements;
    checks[k].still = longest_still(measurements);
    const std::optional<Jump> jump = jump_of(measurements);
    if (!jump) continue;
    const Coordinate& coordinate = system.coordinates()[static_cast<std::size_t>(all[k].coordinate)];
    const double start = episodes[static_cast<std::size_t>(all[k].episode)].start;
    checks[k].jumps_after_still = warn_of_jump(coordinate, log, start, *jump, data.notes);
  }
  warn_of_a_wrong_clock(system, log, episodes, all, data);
  return checks;
}

void check_smoothed(const System& system, const std::string& log, const std::vector<SeriesChecks>& checks,
                    const std::vector<EpisodeRows>& rows, DerivedData& data) {
  if (!warn_of_a_coarse_clock(system, log, checks, data)) warn_of_fast_motions(system, log, rows, data);
  warn_of_stuck_sensors(system, log, checks, data);
}

}  // namespace gp2
