#pragma once

#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/fit.hpp"
#include "gp2/jobs/command_record.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"
#include "gp2/smoothing/windows.hpp"

namespace gp2 GP2_API {

/// The positions that the rows of a log were smoothed from, and the windows over which their accelerations are to be learned from.
struct Windows {
  struct Series {
    int coordinate = 0, episode = 0;
    std::vector<Measurement> positions;
    SmootherModel model;  // of their noise
    WindowGrid grid;
    std::vector<int> windows;
  };
  struct State {
    int episode = 0;
    double time = 0;  // as the positions count it [s]
  };
  std::vector<Series> series;
  std::map<int, State> states;  // by their lines in the log
};

/// Measurements as a table, and the system they were taken on.
struct Log {
  CsvTable table;
  std::shared_ptr<const Model> model = nullptr;      // of that system; null: the model that is fitted
  bool is_commanded = true;                          // its inputs are commands; else they are what acts
  std::shared_ptr<const Windows> windows = nullptr;  // to learn from instead of the rows
  bool is_smoothed = false;  // its velocities and accelerations are no measurements but follow from positions
};

/// Another quantity that is measured or known at some states: the columns of its rows that the table holds, at least one.
struct SideInformation {
  View::Quantity quantity = View::Quantity::unconstrained_acceleration;
  std::string latent;  // only what this latent adds, by its name; empty: everything
  Log log;
};

/// What a person asks of a fit beyond the model and its logs.
struct FitProblemOptions {
  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
  std::vector<std::string> observe;            // accelerations to observe; empty: those whose deviations the log states, or all
  Prior::Mean mean = Prior::Mean::zero;
  std::optional<Latent::Base> base;                  // replaces the directions of the model's latent
  std::optional<Baseline::Kind> baseline;            // learns ddq without mechanics, instead of the model's latents
  std::optional<std::vector<std::string>> estimate;  // parameters; not given: those the model wants estimated
  std::optional<double> noise_stddev;                // for every observed row; not given: the log's own, or the model's [noise]
  bool estimate_noise = false;
  /// Of deviations that a log states a common factor is estimated, since no smoother knows all errors of a sensor: on real logs
  /// they are too small, and a fit that believes them learns noise. True: they are taken as they are. Under the protocol of the
  /// paper and for baselines they are in any case.
  bool trust_stated_noise = false;
  Protocol protocol;
  /// A discrepancy latent beside the model's, where one of them acts in every direction, under the standard protocol with
  /// hyper-priors.
  bool discrepancy = true;
  std::optional<CsvTable> commands;         // the whole log of inputs over t, where the logs are rows of it
  std::optional<int> max_points;            // of each log: so many at random, by `seed`, in its order
  std::optional<double> also_noise_stddev;  // of every row that is known; not given: [noise], where it is an acceleration
  std::optional<double> time_step;          // Δt of a known next velocity
  bool project = false;                     // states onto the constraints, at the model's parameters, before anything else
  bool robust = false;                      // values that disagree with all others are to be distrusted
  std::uint64_t seed = 0;
};

/// A fit ready to run.
struct FitProblem {
  FitPriorOptions prior_options;
  Prior prior;
  std::vector<Observations> observations;             // of each log, then of each knowledge
  std::vector<std::shared_ptr<const Model>> systems;  // per Observations: its model where that is another; for FitFile
  std::vector<Hyperparameter> hyperparameters;
  std::vector<std::vector<int>> lines;                  // per Observations: the line in its log of each state
  std::vector<Parameter> late;                          // delays and lags to estimate before all else …
  std::vector<std::optional<CommandedRows>> commanded;  // … from these Observations (per Observations, or none)
  bool robust = false;
  bool has_wrong_rate = false;     // a column is not the rate of another over t, or delays are in another unit than t
  std::vector<std::string> notes;  // what a person should know: columns taken by alias, states off the constraint, …
};

/// Reads logs of accelerations, and what else is known, into a fit of a model. A log with a column NAME_std beside an
/// acceleration states the noise of each of its values. An empty cell of what is measured, or of its NAME_std, is a value that
/// is not measured; rows without any are left out, and the notes say how many of each.
/// @throws InputError for missing columns, bad cells, unknown names, a log's model that does not fit (make_other_system), noise
/// that is
///   missing, not positive, or too small for double precision.
FitProblem make_fit_problem(const Model& model, const std::vector<Log>& logs, const std::vector<SideInformation>& also,
                            const FitProblemOptions& options);
FitProblem make_fit_problem(const Model& model, const CsvTable& log, const FitProblemOptions& options);

/// How a problem is fitted unless told otherwise: a baseline has options of its own.
FitOptions default_fit_options(const FitProblem& problem);

/// Where the hyperparameters of a problem start, and their bounds.
std::vector<Hyperparameter> starting_hyperparameters(const Model& model, const FitProblem& problem,
                                                     const FitProblemOptions& options);

/// fit() or, of a baseline, fit_baseline(), or fit_robust() where that is asked for.
Fit fit(const FitProblem& problem, const FitOptions& options);

/// Starting values, as read_start_values, also of the delays and lags that the fit estimates. Bounds are the optimiser's: where it does
/// not run, at max_iterations 0, a start outside of them is taken; they are widened to hold it, and the notes say so.
/// @param actuators  of the model
void read_start(const NamedNumbers& start, int max_iterations, const std::vector<Actuator>& actuators, FitProblem& problem);

/// What a person should know of a fit: parameters at a bound, uncertainty_notes, and noise at its lower bound.
std::vector<std::string> notes_of(const FitReport& report, const Posterior& posterior);

/// What a robust fit distrusts: how many values, and the worst of them with their lines in the log.
std::vector<std::string> distrust_notes(const FitProblem& problem, const FitReport& report);

/// Which latent of a prior has a name. @throws InputError naming `option` and the latents there are.
LatentRange latents_called(const Prior& prior, const std::string& name, const std::string& option);

/// A reader of a log that knows the columns by `columns` (model's name -> log's name), then by the model's own [columns].
/// @throws InputError when `columns` names what the model or the log does not have.
LogReader open_log(const Model& model, const CsvTable& log, const std::map<std::string, std::string>& columns);

/// States of a log for a prior and a view, with the columns that only the constraint residuals read where the log has them. Its
/// inputs are commands; where what acts depends on some before the log, accelerations count as not measured.
/// @param actuators   not given: the model's
/// @param parameters  of the prior's system, by which states lie on the constraints or off them; not given: those of the model file
/// @param projects    whether states are moved onto the constraints, as by a fit with `project`
struct LogStates {
  Eigen::MatrixXd states;
  Eigen::MatrixXd accelerations;  // those asked for (accelerations × N); NaN: not measured
  Eigen::MatrixXd stated_stddev;  // of these, from columns NAME_std (accelerations × N); NaN: not stated; empty: none is
  std::vector<std::string> notes;
};
LogStates read_log_states(const Prior& prior, const View& view, const Model& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations = {},
                          const std::optional<std::vector<Actuator>>& actuators = {},
                          const std::optional<Eigen::VectorXd>& parameters = {}, bool projects = false);

/// States of a log and the accelerations that are wanted there: those of ddq for which it has columns.
struct WantedMotion {
  Eigen::MatrixXd states;         // their inputs are 0, but for those that say whether a constraint holds
  View view;                      // of the accelerations
  Eigen::MatrixXd accelerations;  // (view × N)
  std::vector<std::string> notes;
};
/// @param parameters  as read_log_states
/// @throws InputError as read_log_states, but that other inputs need not be there; and where there is no acceleration.
WantedMotion read_wanted_motion(const Prior& prior, const Model& model, const CsvTable& log,
                                const std::map<std::string, std::string>& columns, const Eigen::VectorXd& parameters);

/// work(), with the log named in what it throws: a posterior knows the number of a state only.
template <typename Work>
auto at_states_of(const std::string& log, const Work& work) {
  try {
    return work();
  } catch (const InputError& error) {
    throw InputError(log + ": " + error.what());
  }
}

/// All that a log has of states, with what acts for its commands, and accelerations.
struct WholeLog {
  Eigen::MatrixXd states;            // NaN where neither the model reads an entry nor the log has it (layout size × N)
  Eigen::MatrixXd accelerations;     // NaN where not measured, or not in the log (nq × N)
  std::vector<std::string> missing;  // accelerations that are not in the log
  Eigen::MatrixXd stddev;            // of their noise, as the log or else [noise] states it; NaN where neither does (nq × N)
  std::vector<int> stated;           // rows of accelerations whose standard deviations the log states
  bool reads_time = false;           // whether the model reads t
};
/// @throws InputError for a missing column that the model's prior reads, and as LogReader::stddevs.
WholeLog read_whole_log(const Model& model, LogReader& reader);

/// Indices of named accelerations; all of them when `names` is empty.
/// @throws InputError listing the accelerations there are.
std::vector<int> acceleration_rows(const System& system, const std::vector<std::string>& names, const std::string& option);

}  // namespace gp2
