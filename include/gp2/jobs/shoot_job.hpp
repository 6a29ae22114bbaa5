#pragma once

#include <atomic>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/option.hpp"

namespace gp2 GP2_API {

struct ShootRequest {
  std::optional<double> duration = {};              // of a stretch [s]; none: twice that in which velocities change by their size
  int most_stretches = 50;                          // evenly taken, where the log has more
  std::map<std::string, std::string> columns = {};  // model's name -> log's name, before the model's own [columns]
  int threads = 0;
};
std::vector<Option> options(ShootRequest& request);

/// A parameter of the system by its accelerations one by one, as `fit` estimates it, and by the motion.
struct ShotParameter {
  std::string name, unit;
  double one_step = 0, one_step_stddev = 0;  // NaN where the fit has none
  double value = 0, stddev = 0;              // NaN with fewer than four stretches
};

struct ShootOutcome {
  FitFile fit;  // with the new parameters, the other hyperparameters as they were, without draws of them
  std::vector<ShotParameter> parameters;
  std::vector<std::string> coordinates;   // that were compared
  Eigen::VectorXd rms_before, rms_after;  // of each, between the motion and the log
  double duration = 0;                    // of a stretch [s]
  int n_stretches = 0;
  int iterations = 0;
  bool converged = false;
  std::vector<std::string> notes;
};

/// Estimated parameters θ by multiple shooting: the log is cut into stretches, and the motion that the fit predicts over each of
/// them, from a start x_k of its own, is brought as near to the measured positions as can be,
///
///     min over θ, x_1 … x_K of  Σ_j n_j log Σ_k,i (q_j(t_i; θ, x_k) − q_j,i)²,
///
/// by Gauss–Newton with halved steps; the logarithm weighs coordinates by their errors. Latents are conditioned anew at each θ, under
/// the hyperparameters of the fit. Derivatives of the motion are central differences. Standard deviations allow for errors that
/// last through a stretch, and for what is not known of the latents (theory.md, T35).
///
/// @param log  t, all coordinates and velocities, inputs; stretches end where time does not go on, where rows are missing and
///   where its column `episode` changes. Compared are the coordinates with a NAME_std column, or all where there is none.
/// @param stop  set: ends before long, by throwing
/// @throws InputError when the fit estimates no parameter of the system, the log lacks a column, or no stretch fits in it.
/// @throws NumericalError when no motion can be followed, or the motions do not tell the parameters apart, and when stopped.
ShootOutcome shoot(const FitFile& fit, const CsvTable& log, const ShootRequest& request = {},
                   const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
