#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"
#include "gp2/simulate.hpp"

namespace gp2 GP2_API {

/// Where a motion starts: coordinates and velocities by name, or those of the first row of a log, what is not given following from
/// the constraints; or all of q and dq.
using MotionStart = std::variant<std::map<std::string, double>, CsvTable, Eigen::VectorXd>;

struct SimulateRequest {
  MotionStart start;
  Eigen::VectorXd times;           // at which states are wanted [s]; the first is the start
  std::optional<CsvTable> inputs;  // t and every input as commanded, linear in between; not given: zero

  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
  double relative_tolerance = 1e-6, absolute_tolerance = 1e-9;
  int max_steps = SimulateOptions().max_steps;
  bool project = true;
  std::optional<int> n_samples;  // functions drawn from the posterior, instead of its mean
  std::uint64_t seed = 0;
};
std::vector<Option> options(SimulateRequest& request);

/// Inputs that drive a model: all but those of contacts, which the motion itself tells.
std::vector<std::string> driving_inputs(const Model& model);

/// The time of a log's first row; nothing where it has none.
std::optional<double> start_time(const Model& model, const MotionStart& start, const std::map<std::string, std::string>& columns);

/// Times from a start to an end, both among them.
/// @param time_step  between two; not given: 100 times
/// @throws InputError for an end that is not after the start, or more than 1e7 times.
Eigen::VectorXd motion_times(double t_start, double t_end, const std::optional<double>& time_step);

/// ½ dqᵀM dq + V along a motion (theory.md, T22).
struct MotionEnergy {
  Eigen::VectorXd values;  // (N) [J]
  Eigen::VectorXd stddev;  // of the potential that a fit learned, against the first state; empty where that is not one function
};

/// Motions that are to be integrated.
struct SimulateJob {
  struct Motion {
    Eigen::VectorXd parameters;  // of its constraints and contacts
    Acceleration acceleration = {};
    Acceleration multipliers = {};                                           // λ; none without constraints
    std::function<MotionEnergy(const Eigen::MatrixXd& states)> energy = {};  // none without a potential, known or learned
    std::vector<Contact> contacts = {};
    PushedAcceleration pushed = {};  // of their impacts
  };
  std::shared_ptr<const System> system;
  Eigen::VectorXd start;           // the whole state
  std::vector<Motion> motions;     // of samples each under the parameters that it was drawn with
  SimulateOptions options;         // but for what each motion has of its own
  std::vector<std::string> notes;  // how the start was completed
};

/// The motion of a model by its own equations: its force and [truth].
SimulateJob prepare_simulation(const Model& model, const SimulateRequest& request);
/// The motion of the mean of a posterior, or of samples, as a system of its fit moves.
SimulateJob prepare_simulation(const FitSystem& system, const Posterior& posterior, const SimulateRequest& request);

/// One motion after the other, λ recorded where there are constraints.
/// @param stop  once set the motion ends as one that cannot go on
/// @throws UnfinishedMotion with what was reached of all motions.
std::vector<Trajectory> run_simulation(const SimulateJob& job, const std::atomic<bool>* stop = nullptr);

/// When a multiplier changes its sign: a support that cannot pull would let go there. Linear in between the times written.
/// @return for each multiplier (nc) its times [s]
std::vector<std::vector<double>> multiplier_sign_changes(const Trajectory& trajectory);

/// The uncertainty of ddq along a motion, and where it leaves the region of the data.
struct MotionUncertainty {
  Eigen::MatrixXd stddev;             // (nq × N)
  Eigen::VectorXd distance;           // (N) Posterior::distance_from_data
  std::optional<double> leaves_data;  // first time at which that is beyond Posterior::far_from_data
};
/// @param other_system  that moved; null: the fit's own
MotionUncertainty motion_uncertainty(const Posterior& posterior, const Trajectory& trajectory,
                                     const std::shared_ptr<const OtherSystem>& other_system = nullptr);

/// One motion and what goes with it.
struct SimulatedMotion {
  Trajectory trajectory;
  std::optional<MotionUncertainty> uncertainty = {};  // of a fit
  std::optional<MotionEnergy> energy = {};            // of a model with a potential
};

/// The motion that leaves the region of the data at the earliest time; null where none leaves it.
const SimulatedMotion* first_to_leave(const std::vector<SimulatedMotion>& motions);

/// Warnings of where motions leave the region of the data, of the one that does so earliest, and of where a constraint moves them at
/// once, and where their constraints lose rank, of the first that does.
std::vector<std::string> motion_notes(const std::vector<SimulatedMotion>& motions);

}  // namespace gp2
