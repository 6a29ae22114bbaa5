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

/// @param fitted  the model that is fitted, with its prior
LoggedSystem logged_system(const Model& fitted, const Prior& prior, const FitPriorOptions& options, const Log& log);

/// The accelerations that a log measures.
/// @param lines  receives the line of each state in the log
Observations read_log(const LoggedSystem& logged, const Log& log, const FitProblemOptions& options, std::vector<int>& lines,
                      std::vector<std::string>& notes);

/// What else is measured or known.
/// @param fitted         the prior of the model that is fitted
/// @param signal_stddev  of each latent, by which the noise is judged
/// @param lines          receives the line of each state in the log
Observations read_side_information(const LoggedSystem& logged, const Prior& fitted, const SideInformation& side_information,
                                   const FitProblemOptions& options, const std::vector<Eigen::VectorXd>& signal_stddev,
                                   std::vector<int>& lines, std::vector<std::string>& notes);

/// How many states, with the values measured there, are those of an earlier one to the last bit.
int n_repeated_rows(const Eigen::MatrixXd& states, const Eigen::MatrixXd& values);

/// The accelerations to compare predictions with where none are asked for: those that any observation of the fit has, as far as the
/// log has them.
/// @param notes  receives what is left out
std::vector<std::string> outputs_to_compare(const Posterior& posterior, const Model& model, const CsvTable& log,
                                            const std::map<std::string, std::string>& columns, std::vector<std::string>& notes);

}  // namespace gp2
