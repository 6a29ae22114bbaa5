#pragma once

#include <atomic>
#include <memory>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/option.hpp"

namespace gp2 GP2_API {

/// How a log of positions is learned from.
struct RawFitOptions {
  /// How it is smoothed. Of no meaning are `columns`, for which the request has its own, `rate`, `every`, `keep`.
  DeriveOptions derive = {.hold_constraints = true};
  int most_passes = 4;  // of smoothing by what was learned; 0: smooth, then learn
  bool windows = true;  // learn from sums over windows of time where that can be; else from rows
};

/// The table of its options.
std::vector<Option> options(RawFitOptions& options);
/// Those of a fit and these.
std::vector<Option> options(FitRequest& request, RawFitOptions& raw);

/// A log of positions, smoothed, and what to learn from it.
struct LearnedLog {
  DerivedData data;
  std::vector<int> rows;  // of data, to learn from: the states of the windows, or those that cover the motion best
  std::shared_ptr<const Windows> windows;  // null: the rows themselves are learned from
  std::vector<double> gains;  // of each pass that was kept: log likelihood of the positions, beside a smoothing without a model
  std::vector<std::string> notes;
  std::vector<LogFile> files = {};  // the raw log, if it is a file; that which the smoothed one was written to, if any

  /// The request of a fit to it, from that which it was learned for.
  /// @param name  of the log
  [[nodiscard]] FitRequest request(FitRequest asked, const std::string& name) const;
};

/// The fit to it, ready to run: as prepare_fit of LearnedLog::request, but its messages name lines of the raw log, of rows at one time
/// the first, and its file lists `files`.
FitJob prepare_raw_fit(const LearnedLog& log, FitRequest asked, const std::string& name);

/// Rows that are learned from, and states that windows are over, where the request does not say how many
/// (FitProblemOptions::max_points).
inline constexpr int n_raw_rows = 200, n_window_states = 600;

/// Smooths a log of positions and learns from it by turns, then chooses what to fit to: windows of time over which positions tell sums
/// of accelerations without being differentiated (smoothing/windows.hpp), 0.4 of the period apart up to which the fastest motion
/// stands out of the noise; all of them, where their states are not too many, else groups of eight about the rows that cover the
/// motion best. Such rows themselves, where the log has velocities, constraints are soft, or the fit is robust, a baseline, of
/// `noise_std` or of the paper's protocol.
///
/// The first smoothing knows only that a motion is smooth. A later one
/// smooths what the positions are off the motion under the accelerations that a fit to rows of the one before predicts (derive).
/// In each of 30 pieces of the log these come from rows of other pieces, so that no sample is held against itself.
/// The gain in likelihood thus tells how well the fit predicts what it has not seen, and so which smoothing is the best to learn
/// from: the turns go on as long as it rises.
/// @param request  model and options of the fit, without data
/// @param stop     set: ends within a second or so, by throwing
/// @throws InputError      as derive, resample and prepare_fit
/// @throws NumericalError  as derive and run_fit, and when stopped
LearnedLog learn_and_smooth(const FitRequest& request, const CsvTable& log, const RawFitOptions& options,
                            const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
