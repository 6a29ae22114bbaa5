#pragma once

#include <atomic>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"
#include "gp2/smoothing/smoother.hpp"

namespace gp2 GP2_API {

/// What the times of a log count. automatic: by the usual step, as if the log had 2 to 2000 rows per second.
enum class TimeUnit { automatic, seconds, milliseconds, microseconds, nanoseconds };

struct DeriveOptions {
  std::map<std::string, std::string> columns = {};  // model's name -> log's name, before the model's own [columns]
  std::string episode_column = {};                  // empty: "episode" where the log has it
  std::vector<std::string> episodes = {};           // to take, by what the column says, or "0-12"; empty: all
  std::vector<std::string> keep = {};               // further columns of the log to pass on
  TimeUnit time_unit = TimeUnit::automatic;
  double rate = 0;                // rows per second, evenly from the first sample of an episode; 0: where there are samples
  int every = 1;                  // of these rows, the first and then each so many
  bool hold_constraints = false;  // condition each row on the constraints
  std::optional<Smoothness> smoothness = {};           // none: the likelier of 7/2 and 9/2
  std::optional<CsvTable> like = {};                   // a log whose smoothing this one is to have, see below
  double outlier_threshold = 5;                        // as SmootherFitOptions
  bool keep_positions = false;                         // in each series, as they were taken
  int n_threads = 0;                                   // 0: all cores; the numbers do not depend on it
  std::function<void(double fraction)> progress = {};  // of the work done; called from worker threads, one at a time
  const std::atomic<bool>* stop = nullptr;             // set: ends before long, by throwing
};

std::vector<Option> options(DeriveOptions& options);

/// What became of one column of the log in one episode, or in one part of it where it pauses.
struct DerivedSeries {
  int coordinate = 0;           // of the system
  int episode = 0;              // among DerivedData::episodes
  SmootherModel model;          // of the positions about their mean
  bool noise_at_least = false;  // the noise ended at that of rounding to the resolution
  bool noise_unseen = false;    // or, without one, at the least there is: none, or none that the samples tell from the motion
  bool shared_model = false;    // too short for a model of its own: that of the others' middle lengthscale
  double resolution = 0;        // step of the encoder; 0: none found
  double kurtosis = 0;          // as SmootherFit
  double gain = 0;              // in log likelihood by what was learned; 0: smoothed without it
  double rate = 0;              // usual, of its samples [Hz]
  double bandwidth = 0;         // up to which the motion stands out of the noise [Hz]
  int used = 0;                 // measurements
  bool has_velocities = false;  // among them
  int missing = 0;              // empty cells and NaN
  int repeated = 0;             // the same value at the same time
  int outliers = 0;             // distrusted
  int wraps = 0;                // turns taken out
  int gaps = 0;                 // spaces of more than three usual ones
  double longest_gap = 0;       // [s]
  double start = 0;             // what t was when the episode's time was 0
  std::vector<Measurement> positions =
      {};  // that are trusted, at times of the episode, turns taken out; where they were to be kept
};

/// Motions with their derivatives, as a fit wants them.
struct DerivedData {
  using Mask = Eigen::Array<bool, Eigen::Dynamic, Eigen::Dynamic>;

  std::vector<std::string> episodes;  // what the column says, once for each part between pauses; empty texts without a column
  std::vector<int> episode;           // of each row (N)
  std::vector<int> lines;             // in the log, of the first row at the time of each row (N); empty at an even rate
  Eigen::MatrixXd states;             // [q; dq; t; u] (layout size × N), u as commanded, NaN where unknown
  Eigen::MatrixXd accelerations;      // ddq (nq × N), NaN where unknown
  Eigen::MatrixXd stddev;             // of q, dq, ddq (3 nq × N), NaN where not measured
  std::vector<int> measured;          // coordinates the log has
  std::vector<int> completed;         // coordinates that follow from them
  std::vector<int> independent;       // accelerations that are independent measurements somewhere …
  Mask is_independent;                // … and where (nq × N)
  std::vector<DerivedSeries> series;  // coordinate by coordinate, episode by episode
  std::vector<std::string> kept_names;
  std::vector<std::vector<std::string>> kept;  // cells of each kept column (N)
  std::string episode_column;                  // its name in the log; empty without one
  std::vector<std::string> notes;              // what a person should know; what may be wrong begins with "warning: "
};

/// Positions, and velocities where logged, to velocities and accelerations with a standard deviation for each value.
///
/// Each coordinate of each episode is smoothed by itself (smoother.hpp), with a model of its own. Inputs go through the filter
/// that the positions went through. Coordinates that are not in the log are solved for from the constraints, the others held:
/// positions and velocities by Newton's method, accelerations from A ddq = b.
///
/// With `hold_constraints` each row's estimate z = (q, dq, ddq) ~ N(ẑ, Σ) is conditioned on c = 0, ċ = 0 and A ddq = b,
/// linearised where it ends: z ← ẑ + Σ Jᵀ (J Σ Jᵀ)⁺ (−r(z) − J (ẑ − z)), J = ∂r/∂z.
///
/// With `like` each coordinate is smoothed by the model of that log, of its episodes the one of the middle lengthscale: what is
/// learned from one log and tested on another has then gone through one filter.
///
/// @throws InputError naming the log, episode, column and row: no time, no coordinate, time that runs backwards, too few
///   samples, a column that never moves, an unknown episode or column, coordinates that the log leaves open.
/// @throws NumericalError when Newton's method does not reach the constraints, and when stopped.
DerivedData derive(const Model& model, const CsvTable& log, const DeriveOptions& options = {});

/// The accelerations that a fit predicts at the rows of a derive with rate 0 and every 1 (nq × N each).
struct LearnedAccelerations {
  Eigen::MatrixXd mean, stddev;
};

/// The same by what was learned of the motion. The mean of a series is then not constant but the motion p under the accelerations u,
///
///     p = q̂ − r,    r̈ + 2ω ṙ + ω² r = (d²q̂/dt² − u) ŝ² / (ŝ² + s²),
///
/// which follows the motion q̂ that is smoothed without them below ω, a hundredth of the bandwidth; above, it follows u as far as its
/// variance s² is smaller than that of d²q̂/dt², ŝ². A series is smoothed so where that makes its samples likelier, and is not too
/// short for a model of its own. Its deviations stay those of a smoothing without what was learned: what that misses, friction that
/// sets in say, no smooth remainder tells.
/// @throws InputError also for other options `rate` and `every`.
DerivedData derive(const Model& model, const CsvTable& log, const DeriveOptions& options, const LearnedAccelerations& learned);

/// Columns: `episode` where there is one, t, q, dq, u, ddq as far as known, NAME_std of what was measured (of accelerations:
/// of independent ones), what is kept.
/// @param name  stands for the table in messages
CsvTable as_table(const DerivedData& data, const System& system, std::string name);

}  // namespace gp2
