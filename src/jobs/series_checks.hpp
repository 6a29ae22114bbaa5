#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "gp2/error.hpp"
#include "gp2/jobs/derive.hpp"
#include "jobs/episode_rows.hpp"
#include "jobs/raw_log.hpp"
#include "jobs/smoothed_series.hpp"

// What is odd about the measurements of each series, and what a person should know of that.
namespace gp2 {

/// Values of a column that are the same in a row.
struct EqualRun {
  std::size_t first = 0, n = 0;
};
/// All runs of a column, of one value at least; values that are not measured (NaN) are in none, and end one.
std::vector<EqualRun> equal_runs(const std::vector<double>& values);

/// The text of an error, and on lines of their own the warnings among notes that were made before it and may tell its cause.
std::string with_warnings(std::string text, const std::vector<std::string>& notes);
/// Runs work; an error that it ends with has that text.
template <typename Work>
void with_warnings(const std::vector<std::string>& notes, const Work& work) {
  try {
    work();
  } catch (const NumericalError& error) {
    throw NumericalError(with_warnings(error.what(), notes));
  } catch (const InputError& error) {
    throw InputError(with_warnings(error.what(), notes));
  }
}

/// The longest run of equal positions.
struct Still {
  int n = 0;
  double first = 0, last = 0;  // times
};

/// How samples of one time differ, beside how fast the motion passes there: d = δ q̇ + noise. Two measurements of one time have δ = 0;
/// a clock that is coarser than the samples gives one time to samples that are δ apart.
struct SameTimes {
  double n_pairs = 0, n_times = 0, d_d = 0, d_rate = 0, rate_rate = 0;

  SameTimes& operator+=(const SameTimes& more);
  [[nodiscard]] double delay() const { return rate_rate > 0 ? d_rate / rate_rate : 0; }
  /// Whether δ is certain, at times that are not few, and makes more of the differences than noise does.
  [[nodiscard]] bool tell_of_a_coarse_clock() const;
};
/// @param used  measurements without outliers, in order of time, and at one time in that of the log
SameTimes same_times_of(const std::vector<Measurement>& used);

/// What a series tells as long as its measurements are at hand.
struct SeriesChecks {
  Still still;
  bool jumps_after_still = false;  // of which a warning tells already
  SameTimes same_times;
};

/// Before anything is fitted: warns of positions that jump and of times that are not those of the samples, and leaves out velocities
/// that are not the rates of their positions.
/// @param log   its name
/// @param all   series, with their measurements
/// @param data  has what is measured; receives notes
/// @returns those of each series, but for same_times, which are not known yet
std::vector<SeriesChecks> check_measured(const System& system, const std::string& log, const std::vector<Episode>& episodes,
                                         std::vector<SmoothedSeries>& all, DerivedData& data);

/// After all are smoothed: warns of a coarse clock or of motions that are too fast for the samples, and of sensors that were stuck.
/// @param log     its name
/// @param checks  of each series
/// @param rows    of each episode
/// @param data    has the series and their motions; receives notes
void check_smoothed(const System& system, const std::string& log, const std::vector<SeriesChecks>& checks,
                    const std::vector<EpisodeRows>& rows, DerivedData& data);

}  // namespace gp2
