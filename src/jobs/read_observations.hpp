#pragma once

#include <map>
#include <string>
#include <vector>

#include "gp2/jobs/fit_problem.hpp"
#include "jobs/readings.hpp"

namespace gp2 {

/// @throws InputError for a renaming that finds nothing, which is a slip of the pen: the model's [columns] may name columns that
/// these logs lack, `columns` may not.
void check_columns(const System& system, const std::vector<const CsvTable*>& logs,
                   const std::map<std::string, std::string>& columns);

/// Names of columns for logs that are read together: those given, then the model's own [columns].
/// @throws InputError as check_columns.
std::map<std::string, std::string> checked_columns(const Model& model, const std::vector<const CsvTable*>& logs,
                                                   const std::map<std::string, std::string>& columns);

/// Columns of a log that are not the rates of what they should be over its time, whether or not a prior reads that: wrong_rates.
/// @param columns  as checked
std::vector<std::string> wrong_rates_of(const System& system, const Prior& prior, const CsvTable& log,
                                        const std::map<std::string, std::string>& columns, double* unit = nullptr);

/// As a fit found them: nothing of them is estimated any more.
std::vector<Actuator> found(std::vector<Actuator> actuators);

/// What acts takes the place of what was commanded, in the states of a whole log.
/// @param actuators  of the log's system
/// @param reader     of the log
/// @param whole      the log that this one has rows of; not given: itself
/// @return where commands make a difference
std::optional<CommandedRows> take_commands(const System& system, const std::vector<Actuator>& actuators, LogReader& reader,
                                           const std::optional<CsvTable>& whole,
                                           const std::map<std::string, std::string>& columns, Eigen::MatrixXd& states,
                                           std::vector<std::string>& notes);

/// @param actuators  of the model that is fitted
LoggedSystem logged_system(const Model& fitted, const std::vector<Actuator>& actuators, const Prior& prior,
                           const FitPriorOptions& options, const Log& log);

/// What reading a log leaves beside its observations.
struct LogRows {
  std::vector<int> lines;                  // of each state in the log
  std::optional<CommandedRows> commanded;  // where inputs act late
};

/// The accelerations that a log measures.
Observations read_log(const LoggedSystem& logged, const Log& log, const FitProblemOptions& options, LogRows& rows,
                      std::vector<std::string>& notes);

/// What else is measured or known.
/// @param fitted         the prior of the model that is fitted
/// @param signal_stddev  of each latent, by which the noise is judged
Observations read_side_information(const LoggedSystem& logged, const Prior& fitted, const SideInformation& side_information,
                                   const FitProblemOptions& options, const std::vector<Eigen::VectorXd>& signal_stddev,
                                   LogRows& rows, std::vector<std::string>& notes);

/// Whether no row of a log has something in a column.
bool is_empty_column(const CsvTable& log, int column);

/// States, and the values measured there.
struct MeasuredRows {
  const Eigen::MatrixXd &states, &values;
};

/// How many rows of some logs are those of an earlier one to twelve digits.
int n_repeated_rows(const std::vector<MeasuredRows>& logs);

/// Warns where more than a twentieth of the rows of more logs are those of another of them, or of a log that is known, in whatever order.
void note_shared_rows(const std::vector<Observations>& known, const std::vector<Observations>& more,
                      std::vector<std::string>& notes);

/// What is wrong with rows, if more than a twentieth, that are at rest where dry friction of a model jumps: there and in the row before or
/// behind all velocities are 0 and the coordinates the same, as far as they are known, and measured values a quarter of the largest of
/// their column at most. Empty where nothing is.
std::string text_of_rest(const Model& model, const Eigen::VectorXd& parameters, const Eigen::MatrixXd& states,
                         const Eigen::MatrixXd& values);

/// At how many states the latents of a prior act.
class ActingStates {
 public:
  explicit ActingStates(const Prior& prior);
  /// Adds states of a system whose prior has the same latents.
  void count(const Prior& prior, const Eigen::MatrixXd& states, const Eigen::VectorXd& parameters);
  /// Of each latent whose direction is 0 at all of them or, where `accelerations` are all that is measured, that of a constraint force.
  [[nodiscard]] std::vector<std::string> idle_texts(bool accelerations = true) const;

 private:
  std::vector<std::string> names_;
  std::vector<bool> acts_, moves_;  // at some state; what moves acts
  Eigen::Index n_states_ = 0;
};

/// Of each multiplier that latents of a model read while its constraint follows from others: which share of the load is its own is then
/// a choice.
/// @param mechanics  at some states
std::vector<std::string> shared_load_texts(const Model& model, const System& system, const MechanicsBatch& mechanics);

/// The accelerations to compare predictions with where none are asked for: those that any observation of the fit has, as far as the
/// log has them.
/// @param notes  receives what is left out
std::vector<std::string> outputs_to_compare(const Posterior& posterior, const Model& model, const CsvTable& log,
                                            const std::map<std::string, std::string>& columns, std::vector<std::string>& notes);

}  // namespace gp2
