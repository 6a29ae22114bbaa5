#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "gp2/csv.hpp"
#include "gp2/fit_file.hpp"
#include "gp2/log_reader.hpp"
#include "gp2/model_file.hpp"
#include "gp2/training.hpp"

namespace gp2 {

/// What a person asks of a fit beyond the model and the log.
struct FitProblemOptions {
  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
  std::vector<std::string> observe;            // accelerations to observe; empty: all of them
  Prior::Mean mean = Prior::Mean::zero;
  std::optional<Latent::Base> base;                  // replaces the directions of the model's latent
  std::optional<std::vector<std::string>> estimate;  // parameters; not given: those the model wants estimated
  std::optional<double> noise_stddev;                // for every observed row; not given: the model's [noise]
  bool estimate_noise = false;
  Protocol protocol;
  std::optional<int> max_points;  // the first of a shuffle by `seed`
  std::uint64_t seed = 0;
};

/// A fit ready to run.
struct FitProblem {
  PriorOptions prior_options;
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
  std::vector<std::string> notes;  // what a person should know: columns taken by alias, states off the constraint, …
};

/// Reads a log into a fit of a model.
/// @throws InputError for missing columns, bad cells, unknown names, noise that is missing, not positive, or too small for double
///   precision.
FitProblem make_fit_problem(const ModelFile& model, const CsvTable& log, const FitProblemOptions& options);

/// A reader of a log that knows the columns by `columns` (model's name -> log's name), then by the model's own [columns].
/// @throws InputError when `columns` names what the model or the log does not have.
LogReader open_log(const ModelFile& model, const CsvTable& log, const std::map<std::string, std::string>& columns);

/// States of a log for a prior and a view, with the columns that only the constraint residuals read where the log has them.
struct LogStates {
  Eigen::MatrixXd states;
  Eigen::MatrixXd accelerations;  // those asked for (accelerations × N)
  std::vector<std::string> notes;
};
LogStates read_log_states(const Prior& prior, const View& view, const ModelFile& model, const CsvTable& log,
                          const std::map<std::string, std::string>& columns, const std::vector<std::string>& accelerations = {});

/// Indices of named accelerations; all of them when `names` is empty.
/// @throws InputError listing the accelerations there are.
std::vector<int> acceleration_rows(const System& system, const std::vector<std::string>& names, const std::string& option);

}  // namespace gp2
