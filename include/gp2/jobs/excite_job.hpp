#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/fit.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"
#include "gp2/simulate.hpp"

namespace gp2 GP2_API {

/// What the next experiment is to make known.
enum class ExcitationTarget {
  parameters,     // θ: the determinant of its covariance (D-optimal)
  accelerations,  // ddq where motions within the limits go: the mean of its variance (V-optimal)
  automatic,      // parameters where the fit estimates some, else accelerations
};

/// Lowest and highest value by name.
using Limits = std::map<std::string, std::pair<double, double>>;

struct ExciteRequest {
  MotionStart start;
  double duration = 0;   // [s]
  Limits inputs_within;  // of every input that drives the model
  Limits within;         // of coordinates, velocities and accelerations; those that have none may go anywhere

  ExcitationTarget target = ExcitationTarget::automatic;
  int n_rows = 200;     // of the motion, evenly in time: the measurements that it is taken to give
  int n_harmonics = 8;  // sines and cosines of each input: 1/duration … n/duration [Hz]
  int n_motions = 1000;
  std::uint64_t seed = 0;
  std::map<std::string, std::string> columns;  // model's name -> log's name, of a log that `start` is
  int threads = 0;
};
std::vector<Option> options(ExciteRequest& request);

/// What a search tells while it runs.
struct ExciteProgress {
  int n_motions = 0, n_all = 0;
  double best = 0;  // Excitation::factor of the best so far; NaN: none is within the limits
  double seconds = 0;
};

/// A motion to drive a system along, and what measuring it is expected to make known.
struct Excitation {
  ExcitationTarget target = ExcitationTarget::parameters;  // or accelerations
  Trajectory motion;                                       // of the posterior mean

  /// By what factor standard deviations fall: of θ the geometric mean over the axes of its ellipsoid, of accelerations the root mean
  /// square over the region in units of their noise. And the median of that over random motions within the same limits.
  double factor = 0, random_factor = 0;
  /// Standard deviations of one quantity: now, after this motion, after a random one (median).
  struct Known {
    std::string name;
    double now = 0, after = 0, random = 0;
  };
  std::vector<Known> parameters;
  std::vector<Known> accelerations;  // root mean square over the region; of target accelerations

  /// How far a limit is used.
  struct LimitUse {
    std::string name;
    double lower = 0, upper = 0;     // the limit
    double lowest = 0, highest = 0;  // of the motion
    double share = 0;                // of its half width, from its middle: 1 is the limit itself
  };
  std::vector<LimitUse> limits;  // of inputs, then of the rest

  int n_motions = 0;                  // tried
  int n_random = 0;                   // random ones within the limits
  int n_failed = 0;                   // that could not be integrated
  double highest_frequency = 0;       // of the inputs [Hz]
  std::optional<double> leaves_data;  // MotionUncertainty::leaves_data
  bool interrupted = false;
  double seconds = 0;
  std::vector<std::string> notes;
};

/// The motion, within limits, that is expected to make θ or accelerations best known, of all those whose inputs are
///
///     u_j(t) = middle_j + half width_j tanh(s_j(t)),    s_j a Fourier series,
///
/// and which the posterior mean makes of these from the start on. What a motion tells is computed before it is made
/// (theory.md, T33), for accelerations measured at its rows as the fit's data were. First come random series, each as large as
/// the limits allow; from the best of them an evolution strategy goes on. Same seed, same bits, for any number of threads.
///
/// @param system           that is driven, the fit's own or another one (system_of)
/// @param hyperparameters  of the fit that the posterior is of (FitReport); of another system those count that both have
/// @param progress         called between generations
/// @param stop             set: ends with the best so far, as interrupted
/// @throws InputError when the system has no inputs, limits are missing, reversed, or of no input or state; for a start outside of
///   them; when the target is parameters and none is estimated; of a baseline; and when no motion stays within the limits
/// @throws NumericalError when no motion could be integrated; when stopped before there was one within the limits
Excitation excite(const FitSystem& system, const Posterior& posterior, const std::vector<Hyperparameter>& hyperparameters,
                  const ExciteRequest& request, const std::function<void(const ExciteProgress&)>& progress = {},
                  const std::atomic<bool>* stop = nullptr);

/// Of the fit's own system.
Excitation excite(const Model& model, const Posterior& posterior, const std::vector<Hyperparameter>& hyperparameters,
                  const ExciteRequest& request, const std::function<void(const ExciteProgress&)>& progress = {},
                  const std::atomic<bool>* stop = nullptr);

/// Columns t, coordinates, velocities, accelerations and inputs: simulate takes its inputs and its start from them.
CsvTable as_table(const Trajectory& motion, const System& system, std::string name);

}  // namespace gp2
