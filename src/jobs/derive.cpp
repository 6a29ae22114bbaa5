#include "gp2/jobs/derive.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <mutex>
#include <optional>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "base/stop.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "jobs/derived_inputs.hpp"
#include "jobs/derived_states.hpp"
#include "jobs/episode_rows.hpp"
#include "jobs/raw_log.hpp"
#include "jobs/series_checks.hpp"
#include "jobs/smoothed_series.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

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
    add_inputs(system_, raw_, log_.name(), rows_, data_);
    const MatrixXd commands = data_.states.bottomRows(system_.layout().nu);
    let_inputs_act(model_, raw_, rows_, data_.states);
    with_warnings(data_.notes, [&] { apply_constraints(model_, log_.name(), options_, rows_, covariance_, data_); });
    data_.states.bottomRows(system_.layout().nu) = commands;
    take_each();
    return std::move(data_);
  }

  /// The model of each measured coordinate.
  std::map<int, SmootherModel> models() {
    fit_channels();
    std::map<int, SmootherModel> found;
    for (const SmoothedSeries& one : series_) found.emplace(one.coordinate, middle_model(one.coordinate).value_or(one.model));
    return found;
  }

 private:
  void read_channels() {
    for (const int j : data_.measured) {
      for (int e = 0; e < std::ssize(episodes_); ++e) {
        SmoothedSeries& series = series_.emplace_back();
        series.coordinate = j;
        series.episode = e;
        series.channel = raw_.motion(j, episode_of(e));
      }
    }
    data_.notes = std::move(raw_.notes);
    checks_ = check_measured(system_, log_.name(), episodes_, series_, data_);
  }

  [[nodiscard]] const Episode& episode_of(int e) const { return episodes_[static_cast<std::size_t>(e)]; }

  [[nodiscard]] VectorXd times_to_write(const Episode& episode) const {
    if (options_.rate == 0) {
      return Eigen::Map<const VectorXd>(episode.distinct.data(), static_cast<Index>(episode.distinct.size()));
    }
    constexpr double most_rows = 1e7;
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
    if (options_.progress) options_.progress(++n_done_ / (2.0 * static_cast<double>(series_.size())));
  }

  /// The model of the middle lengthscale, of the episodes that are long enough for one of their own; nothing where none is.
  [[nodiscard]] std::optional<SmootherModel> middle_model(int coordinate) const {
    std::vector<SmootherModel> models;
    for (const SmoothedSeries& series : series_) {
      if (series.coordinate == coordinate && !series.is_short()) models.push_back(series.model);
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
      throw InputError(fmt::format("like: {} has no column {}, which {} has", options_.like->name(),
                                   system_.coordinates()[static_cast<std::size_t>(j)].name, log_.name()));
    }
  }

  // each series is fitted, then smoothed
  void fit_channels() {
    read_channels();
    if (options_.like) find_models_to_be_like();
    parallel_for(static_cast<int>(series_.size()), thread_count(options_.n_threads), [&](int k, int) {
      SmoothedSeries& series = series_[static_cast<std::size_t>(k)];
      SmootherFitOptions own;
      own.smoothness = options_.smoothness;
      own.outlier_threshold = options_.outlier_threshold;
      own.stop = options_.stop;
      own.least_noise_stddev = series.channel.resolution / std::sqrt(12.0);  // of rounding
      if (options_.like) own.model = models_.at(series.coordinate);
      std::vector<Measurement>& measurements = series.channel.measurements;
      series.fit_to(learned_ ? measurements : std::move(measurements), own);
      checks_[static_cast<std::size_t>(k)].same_times = same_times_of(series.fit.trusted);
      if (learned_ && !series.is_short()) series.take_learned(learned_of(series), own);
      measurements = std::vector<Measurement>();  // a long log is told once; `= {}` would keep its memory
      tell_progress();
    });
  }

  [[nodiscard]] LearnedSeries learned_of(const SmoothedSeries& series) const {
    Index first = 0;
    for (int e = 0; e < series.episode; ++e) first += static_cast<Index>(episode_of(e).distinct.size());
    VectorXd times = times_to_write(episode_of(series.episode));
    const Index n = times.size();
    return {std::move(times), learned_->mean.row(series.coordinate).segment(first, n),
            learned_->stddev.row(series.coordinate).segment(first, n)};
  }

  void smooth_channels() {
    // few samples do not tell their own smoothness
    for (SmoothedSeries& series : series_) {
      if (options_.like || !series.is_short()) continue;
      if (const std::optional<SmootherModel> middle = middle_model(series.coordinate)) series.share_model(*middle);
    }
    data_.series.resize(series_.size());
    parallel_for(static_cast<int>(series_.size()), thread_count(options_.n_threads), [&](int k, int) {
      require_not_stopped(options_.stop);
      const SmoothedSeries series = std::move(series_[static_cast<std::size_t>(k)]);  // whose memory is then free
      const VectorXd& times = rows_[static_cast<std::size_t>(series.episode)].times;
      write_motion(series, times);
      DerivedSeries& report = data_.series[static_cast<std::size_t>(k)];
      report = series.report();
      report.start = episode_of(series.episode).start;
      if (options_.keep_positions) report.positions = series.positions(times);
      tell_progress();
    });
    check_smoothed(system_, log_.name(), checks_, rows_, data_);
  }

  /// Writes the motion of a series, and its deviations, into the rows of its episode.
  void write_motion(const SmoothedSeries& series, const VectorXd& times) {
    const StateLayout layout = system_.layout();
    const int j = series.coordinate;
    series.smooth_at(times, [&](Index i, const Eigen::Vector3d& motion, const Eigen::Matrix3d& covariance) {
      const Index row = rows_[static_cast<std::size_t>(series.episode)].first + i;
      data_.states(layout.q(j), row) = motion[0];
      data_.states(layout.dq(j), row) = motion[1];
      data_.accelerations(j, row) = motion[2];
      for (int d = 0; d < 3; ++d) data_.stddev(d * layout.nq + j, row) = std::sqrt(std::max(0.0, covariance(d, d)));
      if (options_.hold_constraints) covariance_[static_cast<std::size_t>(j)][static_cast<std::size_t>(row)] = covariance;
    });
  }

  // rows of all episodes, one after another
  void lay_out_rows() {
    std::vector<double> times;
    for (int e = 0; e < std::ssize(episodes_); ++e) {
      const Episode& episode = episode_of(e);
      rows_.push_back({static_cast<Index>(times.size()), times_to_write(episode)});
      for (const double since : rows_.back().times) {
        times.push_back(episode.start + since);
        data_.episode.push_back(e);
      }
      for (std::size_t k = 0; k < episode.rows.size() && options_.rate == 0; ++k) {
        if (k == 0 || episode.times[k] > episode.times[k - 1]) data_.lines.push_back(log_.line(episode.rows[k]));
      }
    }
    const auto n = static_cast<Index>(times.size());
    const StateLayout layout = system_.layout();
    data_.states = MatrixXd::Constant(layout.size(), n, not_a_number);
    data_.accelerations = MatrixXd::Constant(layout.nq, n, not_a_number);
    data_.stddev = MatrixXd::Constant(3 * Index{layout.nq}, n, not_a_number);
    data_.states.row(layout.t()) = Eigen::Map<const VectorXd>(times.data(), n).transpose();
    covariance_.resize(static_cast<std::size_t>(layout.nq));
    for (const int j : data_.measured)
      covariance_[static_cast<std::size_t>(j)].resize(options_.hold_constraints ? times.size() : 0);
  }

  void keep_columns() {
    for (const std::string& name : options_.keep) {
      data_.kept_names.push_back(name);
      std::vector<std::string>& cells = data_.kept.emplace_back();
      const int column = log_.find(name);
      for (const Episode& episode : episodes_) {
        double before = not_a_number;
        for (std::size_t k = 0; k < episode.rows.size(); ++k) {
          if (episode.times[k] != before) cells.emplace_back();
          before = episode.times[k];
          // sensors may write rows of their own
          if (is_missing(cells.back())) cells.back() = log_.cell(episode.rows[k], column);
        }
      }
    }
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
    if (!data_.lines.empty()) thin(data_.lines);
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
  // coordinate by coordinate, episode by episode
  std::vector<SmoothedSeries> series_;  // empty ones once they are smoothed
  std::vector<SeriesChecks> checks_;
  std::vector<EpisodeRows> rows_;                         // of each episode
  std::vector<std::vector<Eigen::Matrix3d>> covariance_;  // of each measured coordinate, at each row, where constraints are held
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
    std::vector<std::string>& labels = columns.emplace_back(CsvTable::Column{"episode", {}}).cells;
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
