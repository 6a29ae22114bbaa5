#pragma once

#include <atomic>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

/// What becomes of the hyperparameters that data do not determine.
enum class HyperparameterChoice {
  optimise,   // the likeliest are taken as known
  integrate,  // drawn given the data; the posterior is the mixture over the draws
  automatic,  // integrate where that pays: directions have hyperparameters of their own, and rows are few; else optimise
};

/// Draws that `integrate` mixes, through inducing points fewer, each of which has sums of its own; and the largest reduced size
/// (FitMemory) up to which `auto` does: minutes on two cores.
inline constexpr int n_mixed_draws = 25, n_mixed_draws_through_points = 8, largest_integrated_size = 800;

/// The largest reduced size that is solved exactly unless a person says otherwise, and the inducing variables at most beyond it:
/// minutes on two cores.
inline constexpr int largest_exact_size = 1500, most_inducing_variables = 1000;
/// The same of so many rows: fewer beyond 100 000, so that an evaluation of the likelihood of a million takes some ten seconds.
int automatic_inducing_variables(std::int64_t n_rows);

/// What a fit is asked for: a model, its data, and options.
struct FitRequest {
  Model model;
  std::vector<Log> logs;
  std::vector<SideInformation> also;
  std::string data_source;  // where the data came from, for people; empty: the names of the tables

  FitProblemOptions problem;  // what is learned from the data; `seed` is also that of the restarts
  NamedNumbers start;         // starting values of hyperparameters
  std::optional<int> restarts, max_escapes;
  std::optional<double> gradient_tolerance, reduction_tolerance;
  int max_iterations = 1000;
  int threads = 0;
  HyperparameterChoice hyperparameters = HyperparameterChoice::automatic;
  bool standard_errors = true;
  bool thin = true;  // fewer rows where residuals go on from row to row
  /// Inducing variables at most; not given: as largest_exact_size says, and none where `is_exact`.
  std::optional<double> inducing;
  bool is_exact = false, is_exact_where_small = false;
  std::optional<int> train_on;  // states at most that hyperparameters are found from; not given: all
  std::string checkpoint;       // file that the best so far is saved in, while the fit runs; empty: none
};

/// The table of its options.
std::vector<Option> options(FitRequest& request);

/// A fit that is ready to run: its data are read, its options checked.
struct FitJob {
  FitProblem problem;
  FitOptions options;
  FitFile file;  // all but the observations and the report
  std::vector<std::string> notes;
  bool thin = true;
  std::vector<ActuatorEstimate> actuators;  // that were estimated already
  std::filesystem::path checkpoint;         // of the request
  std::string unaffordable;  // why not all of a long log can be fitted, if that is so: what it is worth may be less
};

/// @throws InputError naming an option that is out of its range.
void require_in_range(const FitRequest& request);

/// @throws InputError where `commands` are given while no input of any model acts late: what acts at a row then depends on no
/// commands before, and they tell nothing more.
void require_use_of_commands(const FitRequest& request);

/// @throws InputError for options out of range; as make_fit_problem, read_start and, where rows are not to be left out, within_memory.
FitJob prepare_fit(FitRequest request);

/// The model and the options of a fit as it was asked for, without its data.
/// @throws InputError when the file does not say what was asked: those before format 6 do not.
FitRequest request_of(const FitFile& fit);

/// A fit again, from the data that are in its file: the same bits, on the same machine. Its start values were given for the data that
/// it was asked for; where those of the file give narrower bounds, it starts at the nearest.
/// @param threads  as FitRequest
/// @throws InputError as request_of, for robust fits, whose data are marked by the first one, and where the file has but some of them.
FitJob prepare_fit_again(const FitFile& fit, int threads = 0);
/// The same from logs that are given: as prepare_fit, and its notes say where they are not those that the fit was learned from.
/// @param request  of request_of(), with the logs
FitJob prepare_fit_again(const FitFile& fit, FitRequest request);

/// What a fit gives.
struct FitOutcome {
  FitFile file;                                     // ready to be written
  Posterior posterior;                              // as file.posterior()
  std::vector<std::string> notes;                   // what a person should know
  std::optional<CrossValidation> cross_validation;  // unless the fit was interrupted, or its residuals cannot be told
};

/// cross_validate of the posterior of a fit; what the fit knows and the posterior does not, stretches of many rows, is as it was then.
CrossValidation cross_validate(const FitFile& fit, const Posterior& posterior);

/// Delays and lags of inputs are estimated first (actuator_fit.hpp), and known from then on.
/// Where residuals go on from row to row, rows are fewer measurements than they seem: the fit is then done anew with as many rows of
/// each log as they are worth, evenly taken, unless it is not to `thin`, or robust, or of the paper's protocol.
/// @param progress  called from other threads, one at a time
/// @param stop      set: ends with the best so far, whose termination is FitReport::interrupted
/// @throws InputError      as within_memory, where the rows of a long log are worth too many
/// @throws NumericalError  as fit(), also when stopped before there was anything to give.
FitOutcome run_fit(const FitJob& job, const std::function<void(const Progress&)>& progress = {},
                   const std::atomic<bool>* stop = nullptr);

}  // namespace gp2
