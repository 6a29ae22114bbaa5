#pragma once

#include <atomic>
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
};

/// The table of its options.
std::vector<Option> options(RawFitOptions& options);
/// Those of a fit and these.
std::vector<Option> options(FitRequest& request, RawFitOptions& raw);

/// A log of positions, smoothed, and what to learn from it.
struct LearnedLog {
  DerivedData data;
  std::vector<int> rows;      // of data, to learn from: those that cover the motion best
  std::vector<double> gains;  // of each pass that was kept: log likelihood of the positions, beside a smoothing without a model
  std::vector<std::string> notes;

  /// These rows, as a fit reads them.
  [[nodiscard]] CsvTable table(const System& system, std::string name) const;
};

/// Rows that are learned from where the request does not say how many (FitProblemOptions::max_points).
inline constexpr int n_raw_rows = 200;

/// Smooths a log of positions and learns from it by turns. The first smoothing knows only that a motion is smooth. A later one
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
