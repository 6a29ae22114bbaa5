#include "gp2/jobs/derive.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <mutex>
#include <numbers>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "base/stop.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/simulate.hpp"
#include "jobs/rate_check.hpp"
#include "jobs/raw_log.hpp"
#include "smoothing/constrained_states.hpp"
#include "smoothing/smooth_each.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr std::size_t least_for_own_model = 40;  // samples
constexpr double most_rows = 1e7;

// Frees what a vector holds of a long log; `= {}` keeps its memory.
template <typename T>
void release(std::vector<T>& values) {
  values = std::vector<T>();
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

/// How samples of one time differ, beside how fast the motion passes there: d = δ q̇ + noise. Two measurements of one time have δ = 0;
/// a clock that is coarser than the samples gives one time to samples that are δ apart.
struct SameTimes {
  double n_pairs = 0, n_times = 0, d_d = 0, d_rate = 0, rate_rate = 0;

  SameTimes& operator+=(const SameTimes& more) {
    n_pairs += more.n_pairs, n_times += more.n_times;
    d_d += more.d_d, d_rate += more.d_rate, rate_rate += more.rate_rate;
    return *this;
  }
  [[nodiscard]] double delay() const { return rate_rate > 0 ? d_rate / rate_rate : 0; }
  /// Whether δ is certain, at times that are not few, and makes more of the differences than noise does.
  [[nodiscard]] bool tell_of_a_coarse_clock() const {
    constexpr double least_pairs = 20, share = 0.1, certain = 6, much = 2;
    if (n_pairs < least_pairs || n_pairs < share * n_times || !(delay() > 0)) return false;
    const double noise = std::max(0.0, d_d - delay() * d_rate) / n_pairs;  // variance of a difference
    return d_rate * d_rate > certain * certain * noise * rate_rate && delay() * d_rate / n_pairs > much * much * noise / 2;
  }
};

/// @param used  in order of time, and at one time in that of the log
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

/// The longest run of equal positions.
struct Still {
  int n = 0;
  double first = 0, last = 0;  // times
};

/// @param all  in order of time
Still longest_still(const std::vector<Measurement>& all) {
  Still longest, now;
  double value = not_a_number;
  for (const Measurement& one : all) {
    if (one.velocity) continue;
    if (one.value != value) now = {0, one.time, one.time};
    value = one.value;
    ++now.n, now.last = one.time;
    if (now.n > longest.n) longest = now;
  }
  return longest;
}

/// A coordinate of one episode.
struct Task {
  int coordinate = 0, episode = 0;
  Channel channel;
  SmootherFit fit;
  SmootherModel model;  // of the positions about their mean
  double kurtosis = 0;
  SameTimes same_times;
  Still still;
  bool jumps_after_still = false;           // which was said
  Eigen::Matrix3Xd course;                  // the learned motion that the fit is about; empty: the mean
  double gain = 0;                          // by it, in log likelihood
  std::vector<Eigen::Matrix3d> covariance;  // of the motion smoothed without it; then of the motion, where constraints are held
};

class Deriver {
 public:
  Deriver(const Model& model, const CsvTable& log, const DeriveOptions& options, const LearnedAccelerations* learned)
      : model_(model), system_(*model.system), log_(log), options_(options), learned_(learned), raw_(model, log, options) {
    data_.measured = raw_.measured();
    data_.episode_column = raw_.episode_column();
    for (const Episode& part : episodes_) data_.episodes.push_back(part.label);
  }

  DerivedData run() {
    fit_channels();
    lay_out_rows();
    smooth_channels();
    keep_columns();
    add_inputs();
    const MatrixXd commands = data_.states.bottomRows(system_.layout().nu);
    let_inputs_act();
    put_together();
    data_.states.bottomRows(system_.layout().nu) = commands;
    take_each();
    return std::move(data_);
  }

  /// The model of each measured coordinate.
  std::map<int, SmootherModel> models() {
    fit_channels();
    std::map<int, SmootherModel> found;
    for (const Task& task : tasks_) found.emplace(task.coordinate, middle_model(task.coordinate).value_or(task.model));
    return found;
  }

 private:
  void read_channels() {
    for (const int j : data_.measured) {
      for (int e = 0; e < std::ssize(episodes_); ++e) {
        Task& task = tasks_.emplace_back();
        task.coordinate = j;
        task.episode = e;
        task.channel = raw_.motion(j, episode_of(e));
      }
    }
    data_.notes = std::move(raw_.notes);
    for (Task& task : tasks_) task.still = longest_still(task.channel.measurements);
    leave_out_wrong_velocities();
    warn_of_jumps();
  }

  /// Those that are not the rates of their positions: merged with them they would spoil both.
  void leave_out_wrong_velocities() {
    for (const int j : data_.measured) {
      const Coordinate& coordinate = system_.coordinates()[static_cast<std::size_t>(j)];
      std::string reason;
      int n = 0, n_wrong = 0;
      for (Task& task : tasks_) {
        if (task.coordinate != j) continue;
        ++n;
        const std::string text = better_rate_of(task.channel, coordinate);
        if (text.empty()) continue;
        ++n_wrong;
        if (reason.empty()) reason = text;
      }
      if (n_wrong == 0) continue;
      for (Task& task : tasks_) {
        if (task.coordinate == j) std::erase_if(task.channel.measurements, [](const Measurement& one) { return one.velocity; });
      }
      data_.notes.push_back(fmt::format("warning: {}: {} is not the rate of {} over t{}: {}. It is left out", log_.name(),
                                        coordinate.velocity(), coordinate.name,
                                        n > 1 ? fmt::format(" in {} of {} episodes", n_wrong, n) : "", reason));
    }
  }

  /// What else the velocities of a channel would have to be; empty where they are right, or few.
  static std::string better_rate_of(const Channel& channel, const Coordinate& coordinate) {
    constexpr std::size_t fewest = 30, enough = 300'000;
    std::vector<double> times, values, rates;
    for (const Measurement& one : channel.measurements) {  // at one time positions come first
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

  void warn_of_jumps() {
    for (Task& task : tasks_) {
      const std::optional<Jump> jump = jump_of(task.channel.measurements);
      if (!jump) continue;
      constexpr double turn = 2 * std::numbers::pi, about = 0.05;
      const bool is_angle = system_.coordinates()[static_cast<std::size_t>(task.coordinate)].angle;
      if (!is_angle && std::abs(std::abs(jump->by) / turn - 1) < about) {
        data_.notes.push_back(fmt::format(
            "warning: {}: {} jumps by {:.3g} at t = {:.6g}, about a whole turn: if it is an angle that wraps, write angle = true "
            "in the model",
            log_.name(), name_of(task.coordinate), jump->by, episode_of(task.episode).start + jump->time));
        continue;
      }
      constexpr int many = 20;
      task.jumps_after_still = jump->n_equal >= many;
      data_.notes.push_back(
          fmt::format("warning: {}: {} jumps by {:.3g} at t = {:.6g} and stays there{}", log_.name(), name_of(task.coordinate),
                      jump->by, episode_of(task.episode).start + jump->time,
                      !task.jumps_after_still
                          ? ": was its encoder set anew? Split the log there by a column 'episode'"
                          : fmt::format(", after {} equal samples: was its sensor stuck? Leave these rows out and split the log "
                                        "there by a column 'episode'",
                                        jump->n_equal)));
    }
  }

  [[nodiscard]] const Episode& episode_of(int e) const { return episodes_[static_cast<std::size_t>(e)]; }
  [[nodiscard]] const std::string& name_of(int coordinate) const {
    return system_.coordinates()[static_cast<std::size_t>(coordinate)].name;
  }

  [[nodiscard]] VectorXd times_to_write(const Episode& episode) const {
    if (options_.rate == 0) {
      return Eigen::Map<const VectorXd>(episode.distinct.data(), static_cast<Index>(episode.distinct.size()));
    }
    const double span = episode.distinct.back();
    if (span * options_.rate > most_rows) {
      throw InputError(fmt::format("`rate`: {} rows per second would be {:.3g} rows; at most {:.0e} are written", options_.rate,
                                   span * options_.rate, most_rows));
    }
    const auto n = static_cast<Index>(std::floor(span * options_.rate * (1 + 1e-12) + 1e-9)) + 1;
    return VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1)) / options_.rate;
  }

  void tell_progress() {
    const std::lock_guard lock(progress_lock_);
    if (options_.progress) options_.progress(++n_done_ / (2.0 * static_cast<double>(tasks_.size())));
  }

  static bool is_short(const Task& task) { return task.fit.trusted.size() + task.fit.outliers.size() < least_for_own_model; }

  /// The model of the middle lengthscale, of the episodes that are long enough for one of their own; nothing where none is.
  [[nodiscard]] std::optional<SmootherModel> middle_model(int coordinate) const {
    std::vector<SmootherModel> models;
    for (const Task& task : tasks_) {
      if (task.coordinate == coordinate && !is_short(task)) models.push_back(task.model);
    }
    if (models.empty()) return std::nullopt;
    const auto middle = models.begin() + static_cast<std::ptrdiff_t>(models.size() / 2);
    std::nth_element(models.begin(), middle, models.end(),
                     [](const SmootherModel& a, const SmootherModel& b) { return a.lengthscale < b.lengthscale; });
    return *middle;
  }

  void find_models_to_be_like() {
    DeriveOptions options = options_;
    options.like.reset();
    options.episodes.clear();
    options.keep.clear();
    options.progress = {};
    models_ = Deriver(model_, *options_.like, options, nullptr).models();
    for (const int j : data_.measured) {
      if (models_.contains(j)) continue;
      throw InputError(fmt::format("like: {} has no column {}, which {} has", options_.like->name(), name_of(j), log_.name()));
    }
  }

  // each series is fitted, then smoothed
  void fit_channels() {
    read_channels();
    if (options_.like) find_models_to_be_like();
    parallel_for(static_cast<int>(tasks_.size()), thread_count(options_.n_threads), [&](int k, int) {
      Task& task = tasks_[static_cast<std::size_t>(k)];
      SmootherFitOptions own;
      own.smoothness = options_.smoothness;
      own.outlier_threshold = options_.outlier_threshold;
      own.stop = options_.stop;
      own.least_noise_stddev = task.channel.resolution / std::sqrt(12.0);  // of rounding
      if (options_.like) own.model = models_.at(task.coordinate);
      std::vector<Measurement>& measurements = task.channel.measurements;
      task.fit = fit_smoother(learned_ ? measurements : std::move(measurements), own);
      task.model = task.fit.model;
      task.kurtosis = task.fit.kurtosis;
      task.same_times = same_times_of(task.fit.trusted);
      if (learned_ && !is_short(task)) take_learned(task, own);
      release(measurements);  // a long log is told once
      tell_progress();
    });
  }

  void smooth_channels() {
    // few samples do not tell their own smoothness
    std::vector<bool> shared(tasks_.size(), false);
    for (std::size_t k = 0; k < tasks_.size() && !options_.like; ++k) {
      const std::optional<SmootherModel> middle = is_short(tasks_[k]) ? middle_model(tasks_[k].coordinate) : std::nullopt;
      if (!middle) continue;
      tasks_[k].model = tasks_[k].fit.model = *middle;
      shared[k] = true;
    }
    data_.series.resize(tasks_.size());
    parallel_for(static_cast<int>(tasks_.size()), thread_count(options_.n_threads), [&](int k, int) {
      require_not_stopped(options_.stop);
      Task& task = tasks_[static_cast<std::size_t>(k)];
      const VectorXd times = times_to_write(episode_of(task.episode));
      write_motion(task, times);
      DerivedSeries& series = data_.series[static_cast<std::size_t>(k)];
      series = report_of(task, shared[static_cast<std::size_t>(k)]);
      series.start = episode_of(task.episode).start;
      if (options_.keep_positions) series.positions = positions_of(task, times);
      release(task.fit.trusted);
      task.course.resize(3, 0);
      tell_progress();
    });
    if (!warn_of_a_coarse_clock()) warn_of_fast_motions();
    warn_of_stuck_sensors();
  }

  // noise that no encoder's step hides does not pause
  void warn_of_stuck_sensors() {
    constexpr int many = 20;
    for (std::size_t k = 0; k < tasks_.size(); ++k) {
      const Task& task = tasks_[k];
      const DerivedSeries& series = data_.series[k];
      if (task.still.n < many || series.resolution > 0 || series.noise_unseen || task.jumps_after_still) continue;
      const double start = episode_of(task.episode).start;
      data_.notes.push_back(
          fmt::format("warning: {}: {} is the same in {} samples, from t = {:.6g} to {:.6g}, although it has noise: was its "
                      "sensor stuck? Leave these rows out",
                      log_.name(), name_of(task.coordinate), task.still.n, start + task.still.first, start + task.still.last));
    }
  }

  /// Writes the motion of a series, and its deviations, into the rows of its episode.
  void write_motion(Task& task, const VectorXd& times) {
    const StateLayout layout = system_.layout();
    const int j = task.coordinate;
    const Index first = first_row_[static_cast<std::size_t>(task.episode)];
    const bool has_course = task.course.size() > 0;
    task.covariance.resize(has_course || options_.hold_constraints ? static_cast<std::size_t>(times.size()) : 0);
    smooth_each(task.fit.model, task.fit.trusted, times,
                [&](Index i, const Eigen::Vector3d& smoothed, const Eigen::Matrix3d& covariance) {
                  Eigen::Vector3d motion = smoothed;
                  motion[0] += task.channel.mean;
                  if (has_course) motion += task.course.col(i);
                  data_.states(layout.q(j), first + i) = motion[0];
                  data_.states(layout.dq(j), first + i) = motion[1];
                  data_.accelerations(j, first + i) = motion[2];
                  if (options_.hold_constraints && !has_course) task.covariance[static_cast<std::size_t>(i)] = covariance;
                  const Eigen::Matrix3d& without_course = has_course ? task.covariance[static_cast<std::size_t>(i)] : covariance;
                  for (int d = 0; d < 3; ++d)
                    data_.stddev(d * layout.nq + j, first + i) = std::sqrt(std::max(0.0, without_course(d, d)));
                });
    if (!options_.hold_constraints) release(task.covariance);
  }

  // whether there is one; samples of one time that lie apart by the motion's speed are no noise
  bool warn_of_a_coarse_clock() {
    std::vector<std::string> moved;
    SameTimes largest;
    for (const int j : data_.measured) {
      SameTimes all;
      for (const Task& task : tasks_) {
        if (task.coordinate == j) all += task.same_times;
      }
      if (!all.tell_of_a_coarse_clock()) continue;
      moved.push_back(name_of(j));
      if (all.n_pairs > largest.n_pairs) largest = all;
    }
    if (moved.empty()) return false;
    data_.notes.push_back(
        fmt::format("warning: {}: the clock is coarser than the samples: {:.0f} samples have the time of the one before, "
                    "although {} moved in between, by about {:.2g} s; log times as precisely as positions, or, if samples are "
                    "evenly spaced, an evenly spaced t",
                    log_.name(), largest.n_pairs, fmt::join(moved, ", "), largest.delay()));
    return true;
  }

  /// The positions that are trusted, from what they are about a course and a mean.
  /// @param times  of the samples
  static std::vector<Measurement> positions_of(const Task& task, const VectorXd& times) {
    std::vector<Measurement> positions;
    Index at = 0;
    for (const Measurement& one : task.fit.trusted) {
      if (one.velocity) continue;
      positions.push_back(one);
      positions.back().value += task.channel.mean;
      if (task.course.size() == 0) continue;
      while (times[at] < one.time) ++at;
      positions.back().value += task.course(0, at);
    }
    return positions;
  }

  /// The motion p of a series under the learned acceleration, at the times of its samples; d²q̂/dt² − u is linear between them.
  /// @param plain  the motion q̂ smoothed without it
  /// @param weigh  takes as little of u, beside q̂, as their variances say
  [[nodiscard]] Eigen::Matrix3Xd course_of(const Task& task, const SmoothedMotion& plain, bool weigh) const {
    Index first = 0;
    for (int e = 0; e < task.episode; ++e) first += static_cast<Index>(episode_of(e).distinct.size());
    const VectorXd times = times_to_write(episode_of(task.episode));
    const Index n = times.size();
    Eigen::RowVectorXd misfit = plain.mean.row(2) - learned_->mean.row(task.coordinate).segment(first, n);
    for (Index i = 0; i < n && weigh; ++i) {
      const double known = plain.covariance[static_cast<std::size_t>(i)](2, 2),
                   stddev = learned_->stddev(task.coordinate, first + i);
      misfit[i] *= known / (known + stddev * stddev);
    }
    // as slow as drift needs: what follows the samples below ω has their noise
    constexpr double share = 0.01;
    const double bandwidth = bandwidth_of(task.model, median(spaces_of(task.fit.trusted)));
    const double w = 2 * std::numbers::pi * share * std::max(bandwidth, 1 / times[n - 1]);
    Eigen::Matrix3Xd course = plain.mean;
    course.row(0).array() += task.channel.mean;
    double r = 0, v = 0;
    for (Index i = 0; i < n; ++i) {
      if (i > 0) {
        // a + b t solves it but for its start, which (A + B t) e^(−ωt) makes good
        const double h = times[i] - times[i - 1];
        const double b = (misfit[i] - misfit[i - 1]) / h / (w * w), a = misfit[i - 1] / (w * w) - 2 * b / w;
        const double A = r - a, B = v - b + w * A, decay = std::exp(-w * h);
        r = a + b * h + (A + B * h) * decay;
        v = b + (B - w * (A + B * h)) * decay;
      }
      course.col(i) -= Eigen::Vector3d(r, v, misfit[i] - 2 * w * v - w * w * r);
    }
    return course;
  }

  /// Positions about a course and their own mean there, velocities about its.
  [[nodiscard]] std::pair<std::vector<Measurement>, double> about(const Eigen::Matrix3Xd& course, const Task& task) const {
    const std::vector<double>& times = episode_of(task.episode).distinct;
    std::vector<Measurement> measurements = task.channel.measurements;
    Index at = 0;
    double sum = 0, n = 0;
    for (Measurement& one : measurements) {
      while (times[static_cast<std::size_t>(at)] < one.time) ++at;
      one.value += one.velocity ? -course(1, at) : task.channel.mean - course(0, at);
      if (!one.velocity) sum += one.value, ++n;
    }
    for (Measurement& one : measurements) one.value -= one.velocity ? 0 : sum / n;
    return {std::move(measurements), sum / n};
  }

  /// Smooths a series about the learned motion where that makes its samples likelier, which u as it is tells: a motion that goes by
  /// variances has the noise of the samples wherever little is learned.
  void take_learned(Task& task, const SmootherFitOptions& options) const {
    const VectorXd times = times_to_write(episode_of(task.episode));
    SmoothedMotion plain = smooth(task.fit.model, task.fit.trusted, times);
    const SmootherFit tried = fit_smoother(about(course_of(task, plain, false), task).first, options);
    const double gain = score(tried, options) - score(task.fit, options);
    if (!(gain > 0)) return;
    task.course = course_of(task, plain, true);
    const auto [measurements, mean] = about(task.course, task);
    task.fit = fit_smoother(measurements, options);
    task.channel.mean = mean;
    task.gain = gain;
    task.covariance = std::move(plain.covariance);
  }

  /// Log likelihood, in which an outlier counts as a sample that is just trusted.
  static double score(const SmootherFit& fit, const SmootherFitOptions& options) {
    const double just_trusted = -0.5 * options.outlier_threshold * options.outlier_threshold -
                                std::log(fit.model.noise_stddev * std::sqrt(2 * std::numbers::pi));
    return fit.log_likelihood + static_cast<double>(fit.outliers.size()) * just_trusted;
  }

  // heavy tails, or many that stand out, may be the sensor's; where the motion fills the band that samples can tell they are the motion's
  void warn_of_fast_motions() {
    constexpr double even = 6;  // kurtosis, 3 for a normal distribution; errors beyond 3 × the best had more in simulated logs
    constexpr double many = 0.02;  // of the samples, that are left out
    constexpr double share = 0.5;  // of the Nyquist frequency
    for (const int j : data_.measured) {
      int n = 0, n_fast = 0;
      double rate = 0;
      for (const DerivedSeries& one : data_.series) {
        if (one.coordinate != j || one.noise_unseen) continue;
        ++n;
        const bool stands_out = one.kurtosis > even || one.outliers >= many * (one.used + one.outliers);
        if (!stands_out || !(one.bandwidth > share * one.rate / 2) || !is_smoothed_away(one)) continue;
        ++n_fast;
        rate = one.rate;
      }
      if (n_fast == 0) continue;
      data_.notes.push_back(
          fmt::format("warning: {}: {} moves too fast in places for {:.3g} samples per second{}: there its "
                      "accelerations are smoothed too much; log at a higher rate",
                      log_.name(), name_of(j), rate, n > 1 ? fmt::format(", in {} of {} episodes", n_fast, n) : ""));
    }
  }

  /// Whether the deviations of the accelerations are no small part of these.
  [[nodiscard]] bool is_smoothed_away(const DerivedSeries& series) const {
    constexpr double little = 0.02;
    const Index first = first_row_[static_cast<std::size_t>(series.episode)], n = last_row(series.episode) - first;
    const auto rms = [&](const auto& row) { return std::sqrt(row.segment(first, n).array().square().mean()); };
    return rms(data_.stddev.row(2 * Index{system_.nq()} + series.coordinate)) >
           little * rms(data_.accelerations.row(series.coordinate));
  }

  static std::vector<double> spaces_of(const std::vector<Measurement>& used) {
    std::vector<double> spaces;
    for (std::size_t k = 1; k < used.size(); ++k) {
      if (used[k].time > used[k - 1].time) spaces.push_back(used[k].time - used[k - 1].time);
    }
    return spaces;
  }

  static DerivedSeries report_of(const Task& task, bool shared) {
    const std::vector<Measurement>& used = task.fit.trusted;
    DerivedSeries out;
    out.coordinate = task.coordinate;
    out.episode = task.episode;
    out.model = task.model;
    out.noise_at_least = task.fit.noise_at_least && task.channel.resolution > 0;
    out.noise_unseen = task.fit.noise_at_least && !out.noise_at_least;
    out.shared_model = shared;
    out.kurtosis = task.kurtosis;
    out.gain = task.gain;
    out.resolution = task.channel.resolution;
    out.used = static_cast<int>(used.size());
    out.has_velocities = std::ranges::any_of(used, &Measurement::velocity);
    out.missing = task.channel.missing;
    out.repeated = task.channel.repeated;
    out.outliers = static_cast<int>(task.fit.outliers.size());
    out.wraps = task.channel.wraps;
    const std::vector<double> spaces = spaces_of(used);
    const double usual = median(spaces);
    for (const double space : spaces) {
      if (space <= 3 * usual) continue;
      ++out.gaps;
      out.longest_gap = std::max(out.longest_gap, space);
    }
    out.rate = 1 / usual;
    out.bandwidth = bandwidth_of(task.model, usual);
    return out;
  }

  // rows of all episodes, one after another
  void lay_out_rows() {
    std::vector<double> times;
    for (int e = 0; e < std::ssize(episodes_); ++e) {
      first_row_.push_back(static_cast<Index>(times.size()));
      for (const double since : times_to_write(episode_of(e))) {
        times.push_back(episode_of(e).start + since);
        data_.episode.push_back(e);
      }
    }
    const auto n = static_cast<Index>(times.size());
    const StateLayout layout = system_.layout();
    data_.states = MatrixXd::Constant(layout.size(), n, not_a_number);
    data_.accelerations = MatrixXd::Constant(layout.nq, n, not_a_number);
    data_.stddev = MatrixXd::Constant(3 * Index{layout.nq}, n, not_a_number);
    data_.states.row(layout.t()) = Eigen::Map<const VectorXd>(times.data(), n).transpose();
  }

  void keep_columns() {
    for (const std::string& name : options_.keep) {
      data_.kept_names.push_back(name);
      std::vector<std::string>& cells = data_.kept.emplace_back();
      const int column = log_.find(name);
      for (const Episode& episode : episodes_) {
        double before = not_a_number;
        for (std::size_t k = 0; k < episode.rows.size(); ++k) {
          if (episode.times[k] == before) continue;
          before = episode.times[k];
          cells.push_back(log_.cell(episode.rows[k], column));
        }
      }
    }
  }

  // The coordinates whose applied force reads an input, at states of no special place; all where that is not known.
  [[nodiscard]] std::vector<bool> driven_by(std::size_t input) const {
    constexpr Index n = 3;
    const StateLayout layout = system_.layout();
    MatrixXd states(layout.size(), 2 * n);
    for (Index k = 0; k < states.rows(); ++k) {
      for (Index i = 0; i < n; ++i) states(k, i) = states(k, n + i) = 0.7 * std::sin(1.0 + static_cast<double>(k + 11 * i));
    }
    states.row(layout.u(static_cast<int>(input))).tail(n).array() += 1;
    std::vector<bool> driven(static_cast<std::size_t>(layout.nq), true);
    try {
      const MatrixXd force = system_.evaluate(states, system_.parameter_values()).force;
      const MatrixXd change = force.rightCols(n) - force.leftCols(n);
      if (!change.allFinite()) return driven;
      for (Index j = 0; j < change.rows(); ++j) driven[static_cast<std::size_t>(j)] = !change.row(j).isZero(0);
    } catch (const InputError&) {  // code that is not defined there
    }
    return driven;
  }

  struct Hole {
    double length = 0, start = 0;
  };

  /// The longest time without a value of a channel, where that is many of its usual steps; else 0.
  static Hole longest_hole(const Channel& channel, const Episode& episode) {
    constexpr double many = 10;
    std::vector<double> times = {episode.times.front()}, steps;
    for (const Measurement& one : channel.measurements) {
      if (times.size() > 1 && one.time > times.back()) steps.push_back(one.time - times.back());
      times.push_back(one.time);
    }
    times.push_back(episode.times.back());
    Hole longest;
    for (std::size_t k = 1; k < times.size(); ++k) {
      if (times[k] - times[k - 1] > longest.length) longest = {times[k] - times[k - 1], episode.start + times[k - 1]};
    }
    return !steps.empty() && longest.length <= many * median(steps) ? Hole{} : longest;
  }

  /// Of the log, below its header: the first with a time.
  static int line_of(const Episode& episode, double time) {
    const auto at = std::lower_bound(episode.times.begin(), episode.times.end(), time);
    return episode.rows[static_cast<std::size_t>(at - episode.times.begin())] + 2;
  }

  // each input goes through the filter of the slowest coordinate that it drives: a smoother of the same spectrum and noise is that filter
  void add_inputs() {
    for (std::size_t u = 0; u < system_.inputs().size(); ++u) {
      if (!raw_.has_input(u)) continue;
      const std::vector<bool> driven = driven_by(u);
      std::vector<double> as_logged;
      std::vector<int> lines;
      Hole longest;
      for (int e = 0; e < std::ssize(episodes_); ++e) {
        const Episode& episode = episode_of(e);
        const auto slowest_of = [&](bool those_driven) {
          const DerivedSeries* slowest = nullptr;
          for (const DerivedSeries& series : data_.series) {
            if (series.episode != e || (those_driven && !driven[static_cast<std::size_t>(series.coordinate)])) continue;
            if (!slowest || series.bandwidth < slowest->bandwidth) slowest = &series;
          }
          return slowest;
        };
        const DerivedSeries* slowest = slowest_of(/*those_driven=*/true);
        if (!slowest) slowest = slowest_of(/*those_driven=*/false);
        const Channel channel = raw_.input(u, episode);
        for (const Measurement& one : channel.measurements) {
          as_logged.push_back(one.value + channel.mean);
          lines.push_back(line_of(episode, one.time));
        }
        if (const Hole hole = longest_hole(channel, episode);
            hole.length > longest.length && hole.length * slowest->bandwidth > 1)
          longest = hole;
        const VectorXd times = times_to_write(episode);
        const Index first = first_row_[static_cast<std::size_t>(e)];
        smooth_each(slowest->model, channel.measurements, times,
                    [&](Index i, const Eigen::Vector3d& motion, const Eigen::Matrix3d&) {
                      data_.states(system_.layout().u(static_cast<int>(u)), first + i) = motion[0] + channel.mean;
                    });
      }
      const Eigen::Map<const Eigen::RowVectorXd> commands(as_logged.data(), std::ssize(as_logged));
      const std::string& name = system_.inputs()[u];
      if (auto text = clipped_input(name, commands)) data_.notes.push_back(*std::move(text));
      if (auto text = far_values_text(name, {commands}, {lines}))
        data_.notes.push_back(fmt::format("warning: {}: {}", log_.name(), *text));
      if (longest.length > 0) {
        data_.notes.push_back(fmt::format(
            "warning: {}: the input {} has no value for {:.3g} s, from t = {:.6g} on: what is written there is a guess",
            log_.name(), name, longest.length, longest.start));
      }
    }
  }

  // what acts late, by the model's delays and lags, for constraints that read it
  void let_inputs_act() {
    for (std::size_t u = 0; u < system_.inputs().size(); ++u) {
      if (!raw_.has_input(u) || model_.actuators[u].is_direct()) continue;
      for (int e = 0; e < std::ssize(episodes_); ++e) {
        const VectorXd times = times_to_write(episode_of(e));
        auto acting = data_.states.row(system_.layout().u(static_cast<int>(u)))
                          .segment(first_row_[static_cast<std::size_t>(e)], times.size());
        const InputSignal signal(times, acting, {model_.actuators[u]});
        for (Index i = 0; i < times.size(); ++i) {
          VectorXd now(1);
          signal.evaluate(times[i], now);
          acting[i] = now[0];
        }
      }
    }
  }

  // what was not measured, and what the constraints say of what was
  void put_together() {
    const ConstrainedStates states(model_, data_.measured);
    data_.completed = states.completed();
    data_.independent = data_.measured;
    data_.is_independent = DerivedData::Mask::Constant(system_.nq(), data_.states.cols(), false);
    for (const int j : data_.measured) data_.is_independent.row(j) = true;
    if (data_.states.cols() == 0) return;

    const VectorXd start = start_of_newton();
    const int redundancy = redundancy_of(states, started(0, start));
    std::vector<std::string> completed;
    for (const int j : data_.completed) completed.push_back(name_of(j));
    note_redundancy(redundancy, completed,
                    redundancy > 0 ? contradiction(misfits(states, start), system_.state_names()) : std::nullopt);
    const bool conditioned = options_.hold_constraints && redundancy > 0;
    parallel_for(static_cast<int>(episodes_.size()), thread_count(options_.n_threads),
                 [&](int e, int) { put_episode_together(states, e, conditioned, start); });
    if (!completed.empty()) data_.notes.push_back(fmt::format("from the constraints: {}", fmt::join(completed, ", ")));
    if (!conditioned) {
      leave_out_dependent();
      return;
    }
    std::erase_if(data_.independent, [&](int j) { return !data_.is_independent.row(j).any(); });
  }

  /// Measured accelerations that follow from each other, as those of one sensor that is logged twice, are not all measurements.
  void leave_out_dependent() {
    const int nq = system_.nq();
    const auto independent =
        dependent_columns(system_, data_.states, system_.parameter_values(), data_.accelerations, data_.stddev.bottomRows(nq));
    if (!independent || std::ssize(data_.measured) < nq) return;
    data_.independent = *independent;
    for (int j = 0; j < nq; ++j) data_.is_independent.row(j) = std::ranges::find(*independent, j) != independent->end();
    data_.notes.push_back(
        fmt::format("the derived accelerations satisfy A ddq = b, or part of it, far more closely than noise allows: only {} of "
                    "{} are independent",
                    independent->size(), nq));
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

  /// What the measured coordinates of an episode are off the constraints among them, in the median over its rows.
  struct Misfit {
    double size = 0;  // standard deviations
    VectorXd move;    // to where they meet them, as that of ConstrainedStates::Contradiction (2 nq)
    VectorXd stddev;  // usual, of the same
    int n_constraints = 0;

    /// Beyond what noise does that is twice what was found, and motions that are smoothed a little too much.
    [[nodiscard]] bool is_clear() const {
      constexpr double deviations = 4;
      return size > deviations;
    }
  };

  /// @param stddev  of q, dq (2 nq × N)
  [[nodiscard]] Misfit misfit_of(const ConstrainedStates& states, int e, const VectorXd& start, const MatrixXd& stddev) const {
    const Index first = first_row_[static_cast<std::size_t>(e)], n = last_row(e) - first;
    constexpr Index most_looked_at = 500;
    const Index step = std::max<Index>(1, n / most_looked_at);
    int n_constraints = 0;
    std::vector<double> sizes;
    std::vector<std::vector<double>> moves(static_cast<std::size_t>(stddev.rows()));
    VectorXd from = start;
    for (Index i = 0; i < n; ++i) {
      // what is solved for starts at its predecessor
      const bool looked_at = i % step == 0;
      if (!looked_at && data_.completed.empty()) continue;
      VectorXd state = started(first + i, from), acceleration = data_.accelerations.col(first + i);
      states.approach(state, acceleration);
      from = state.head(2 * Index{system_.nq()});
      if (!looked_at) continue;
      const ConstrainedStates::Contradiction here = states.contradiction(state, acceleration, stddev.col(first + i));
      if (!std::isfinite(here.size) || !here.move.allFinite()) continue;
      n_constraints = std::max(n_constraints, here.n_constraints);
      sizes.push_back(here.size);
      for (std::size_t k = 0; k < moves.size(); ++k) moves[k].push_back(std::abs(here.move[static_cast<Index>(k)]));
    }
    Misfit out{0, VectorXd::Zero(stddev.rows()), stddev.middleCols(first, n).rowwise().mean(), n_constraints};
    if (sizes.empty()) return out;
    out.size = median(sizes);
    for (std::size_t k = 0; k < moves.size(); ++k) out.move[static_cast<Index>(k)] = median(moves[k]);
    return out;
  }

  /// Of q, dq (2 nq × N), where measured; not below what files and models round.
  [[nodiscard]] MatrixXd stddev_of_states() const {
    constexpr double rounding = 1e-4;  // of the spread
    const Index nq = system_.nq();
    MatrixXd stddev = MatrixXd::Zero(2 * nq, data_.states.cols());
    for (const Task& task : tasks_) {
      const Index first = first_row_[static_cast<std::size_t>(task.episode)], n = last_row(task.episode) - first;
      for (const Index row : {Index{task.coordinate}, nq + task.coordinate}) {  // q, dq stand first in a state too
        const Eigen::RowVectorXd course = data_.states.row(row).segment(first, n);
        const double spread = std::sqrt((course.array() - course.mean()).square().mean());
        stddev.row(row).segment(first, n) = data_.stddev.row(row).segment(first, n).cwiseMax(rounding * spread);
      }
    }
    return stddev;
  }

  [[nodiscard]] std::vector<Misfit> misfits(const ConstrainedStates& states, const VectorXd& start) const {
    const MatrixXd stddev = stddev_of_states();
    std::vector<Misfit> out(episodes_.size());
    parallel_for(static_cast<int>(episodes_.size()), thread_count(options_.n_threads),
                 [&](int e, int) { out[static_cast<std::size_t>(e)] = misfit_of(states, e, start, stddev); });
    return out;
  }

  /// Says so where measured coordinates contradict the constraints among them by more than noise does.
  static std::optional<std::string> contradiction(const std::vector<Misfit>& of_episodes, const std::vector<std::string>& names) {
    const auto n_clear = std::count_if(of_episodes.begin(), of_episodes.end(), [](const Misfit& one) { return one.is_clear(); });
    if (n_clear == 0) return std::nullopt;
    const Misfit& worst = *std::max_element(of_episodes.begin(), of_episodes.end(),
                                            [](const Misfit& a, const Misfit& b) { return a.size < b.size; });
    // where all move together some hardly do
    std::vector<std::string> moves;
    for (Index k = 0; k < worst.move.size(); ++k) {
      if (worst.move[k] > worst.stddev[k] && worst.stddev[k] > 0)
        moves.push_back(fmt::format("{} by {:.2g}", names[static_cast<std::size_t>(k)], worst.move[k]));
    }
    const bool alone = worst.n_constraints == 1;
    return fmt::format(
        "measured coordinates contradict the constraints among them, by {:.2g} standard deviations in the median{}; to meet them "
        "{} would have to move, {}: are their units and zeros those of the model?",
        worst.size, of_episodes.size() > 1 ? fmt::format(", in {} of {} episodes", n_clear, of_episodes.size()) : "",
        alone ? "one" : "all", fmt::join(moves, alone ? " or " : ", "));
  }

  /// Says what the constraints mean for measured coordinates alone, and throws where noise would contradict them.
  /// @param contradicted  by what, beyond noise
  void note_redundancy(int redundancy, const std::vector<std::string>& completed,
                       const std::optional<std::string>& contradicted) {
    if (redundancy > 0 && !options_.hold_constraints) {
      const std::string fact = fmt::format("{} of the constraints hold{} among the measured coordinates alone", redundancy,
                                           redundancy == 1 ? "s" : "");
      if (!completed.empty() && contradicted) {
        throw InputError(fmt::format("{}: {} cannot be solved for: {}", log_.name(), fmt::join(completed, ", "), *contradicted));
      }
      if (!completed.empty()) {
        throw InputError(fmt::format(
            "{}: {}, which noise contradicts, so that {} cannot be solved for; hold the constraints (`hold_constraints`)",
            log_.name(), fact, fmt::join(completed, ", ")));
      }
      if (!contradicted) data_.notes.push_back(fact + ": `hold_constraints` makes use of that");
    }
    if (contradicted) data_.notes.push_back(fmt::format("warning: {}: {}", log_.name(), *contradicted));
    // a fit of a raw log holds what there is
    if (options_.hold_constraints && !options_.keep_positions && redundancy == 0 && system_.nc() > 0)
      data_.notes.emplace_back("no constraint holds among the measured coordinates alone: there is nothing to hold");
  }

  [[nodiscard]] Index last_row(int e) const {
    return e + 1 < static_cast<int>(episodes_.size()) ? first_row_[static_cast<std::size_t>(e) + 1] : data_.states.cols();
  }

  // rows of an episode follow one another: each starts at its predecessor
  void put_episode_together(const ConstrainedStates& states, int e, bool conditioned, VectorXd from) {
    const StateLayout layout = system_.layout();
    const Index first = first_row_[static_cast<std::size_t>(e)];
    const Index last = last_row(e);
    std::vector<const Task*> tasks;
    for (const Task& task : tasks_) {
      if (task.episode == e) tasks.push_back(&task);
    }
    for (Index i = first; i < last; ++i) {
      VectorXd state = started(i, from);
      if (conditioned) {
        hold_constraints(states, tasks, i, i - first, state);
      } else {
        complete(states, i, state);
      }
      data_.states.col(i) = state;
      from = state.head(2 * layout.nq);
    }
  }

  /// @throws NumericalError naming the log and what to log, where the constraints do not give what was not measured.
  void complete(const ConstrainedStates& states, Index row, VectorXd& state) {
    try {
      states.complete(state, data_.accelerations.col(row));
    } catch (const NumericalError& error) {
      const auto names_of = [&](const std::vector<int>& coordinates) {
        std::vector<std::string> names;
        for (const int j : coordinates) names.push_back(name_of(j));
        return fmt::format("{}", fmt::join(names, ", "));
      };
      const std::string unknown = names_of(data_.completed);
      throw NumericalError(fmt::format(
          "{}: near t = {:.6g} the constraints do not determine {} from {}: a dead centre, or positions that no posture has "
          "({}). Log {} too, or another coordinate",
          log_.name(), data_.states(system_.layout().t(), row), unknown, names_of(data_.measured), error.what(), unknown));
    }
  }

  /// @param tasks  of the episode
  /// @param row, row_of_episode  the same, among all rows and among those of the episode
  void hold_constraints(const ConstrainedStates& states, const std::vector<const Task*>& tasks, Index row, Index row_of_episode,
                        VectorXd& state) {
    const Index nq = system_.nq();
    std::vector<Eigen::Matrix3d> covariance;
    for (const Task* task : tasks) covariance.push_back(task->covariance[static_cast<std::size_t>(row_of_episode)]);
    states.condition(state, data_.accelerations.col(row), covariance);
    for (std::size_t k = 0; k < tasks.size(); ++k) {
      const Eigen::Vector3d stddev = covariance[k].diagonal().cwiseMax(0).cwiseSqrt();
      for (int d = 0; d < 3; ++d) data_.stddev(d * nq + tasks[k]->coordinate, row) = stddev[d];
    }
    // some accelerations say all others now: which may change along the motion
    VectorXd stddev(static_cast<Index>(data_.measured.size()));
    for (Index k = 0; k < stddev.size(); ++k) {
      stddev[k] =
          std::max(data_.stddev(2 * nq + data_.measured[static_cast<std::size_t>(k)], row), std::numeric_limits<double>::min());
    }
    data_.is_independent.col(row) = false;
    for (const int j : states.independent_accelerations(state, stddev)) data_.is_independent(j, row) = true;
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
    data_.is_independent = data_.is_independent(Eigen::all, rows).eval();
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
  const LearnedAccelerations* learned_;  // may be null
  std::map<int, SmootherModel> models_;  // of the log that this one is to be like
  RawLog raw_;
  const std::vector<Episode>& episodes_ = raw_.episodes();
  DerivedData data_;
  std::vector<Task> tasks_;
  std::vector<Index> first_row_;  // of each episode
  std::mutex progress_lock_;
  int n_done_ = 0;
};

}  // namespace

std::vector<Option> options(DeriveOptions& options) {
  std::vector<std::pair<std::string, std::optional<Smoothness>>> orders = {{"auto", std::nullopt}};
  for (const std::string& word : smoothness_words()) orders.emplace_back(word, smoothness_of(word));
  const Choice time_units = choice(options.time_unit, {{"auto", TimeUnit::automatic},
                                                       {"s", TimeUnit::seconds},
                                                       {"ms", TimeUnit::milliseconds},
                                                       {"us", TimeUnit::microseconds},
                                                       {"ns", TimeUnit::nanoseconds}});
  return {
      {"episode", &options.episode_column, "COLUMN", "column that identifies the episode", "episode, if the log has it"},
      {"episodes", &options.episodes, "0-12,15", "use only these episodes", "all"},
      {"time_unit", time_units, "", "unit of t; auto: the one that gives 2 to 2000 rows per second"},
      {"rate", &options.rate, "HZ", "output rows per second, evenly spaced within an episode, also through gaps",
       "at the samples"},
      {"every", &options.every, "K", "keep every K-th row of an episode"},
      {"hold_constraints", &options.hold_constraints, "",
       "condition each row on the constraints, if more coordinates are measured than are independent"},
      {"outlier_threshold", &options.outlier_threshold, "S",
       "treat a sample as an outlier if it is more than this many standard deviations from its prediction by the others; 0: "
       "never"},
      {"smoothness", choice(options.smoothness, orders), "",
       "order of the Matérn kernel of the motion; auto: 7/2 or 9/2, whichever has the higher likelihood"},
      {"keep", &options.keep, "NAME,…", "further columns of the log to copy to the output"},
      columns_option(options.columns),
  };
}

DerivedData derive(const Model& model, const CsvTable& log, const DeriveOptions& options) {
  return Deriver(model, log, options, nullptr).run();
}

DerivedData derive(const Model& model, const CsvTable& log, const DeriveOptions& options, const LearnedAccelerations& learned) {
  if (options.rate != 0 || options.every != 1) {
    throw InputError("smoothing with the learned dynamics needs all samples: leave out `rate` and `every`");
  }
  return Deriver(model, log, options, &learned).run();
}

CsvTable as_table(const DerivedData& data, const System& system, std::string name) {
  const StateLayout layout = system.layout();
  const std::vector<std::string> state_names = system.state_names(), acceleration_names = system.acceleration_names();
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& column, const auto& values) {
    columns.push_back({column, {values.begin(), values.end()}});
  };
  const auto add_known = [&](const std::string& column, const auto& values) {
    if (!values.array().isNaN().any()) add(column, values);
  };
  if (!data.episode_column.empty()) {
    std::vector<std::string>& labels = columns.emplace_back(CsvTable::Column{data.episode_column, {}}).cells;
    for (const int episode : data.episode) labels.push_back(data.episodes[static_cast<std::size_t>(episode)]);
  }
  add("t", data.states.row(layout.t()));
  for (int k = 0; k < layout.t(); ++k) add_known(state_names[static_cast<std::size_t>(k)], data.states.row(k));
  for (int k = layout.u(0); k < layout.size(); ++k) add_known(state_names[static_cast<std::size_t>(k)], data.states.row(k));
  for (int j = 0; j < layout.nq; ++j) add_known(acceleration_names[static_cast<std::size_t>(j)], data.accelerations.row(j));
  for (int d = 0; d < 2; ++d) {
    for (const int j : data.measured) {
      const int row = d * layout.nq + j;
      add(state_names[static_cast<std::size_t>(row)] + "_std", data.stddev.row(row));
    }
  }
  for (const int j : data.independent) {
    const Eigen::RowVectorXd of_independent =
        data.is_independent.row(j).matrix().select(data.stddev.row(2 * Index{layout.nq} + j), not_a_number);
    add(acceleration_names[static_cast<std::size_t>(j)] + "_std", of_independent);
  }
  for (std::size_t k = 0; k < data.kept.size(); ++k) columns.push_back({data.kept_names[k], {}, data.kept[k]});
  return CsvTable::from_columns(std::move(name), std::move(columns));
}

}  // namespace gp2
