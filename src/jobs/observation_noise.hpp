#pragma once

#include <string>
#include <vector>

#include "gp2/jobs/fit_problem.hpp"
#include "jobs/readings.hpp"

namespace gp2 {

/// Those of the accelerations whose standard deviations the log states, for each value.
std::vector<std::string> stated_accelerations(std::vector<std::string> names, const LogReader& reader);

/// √(floor² + stated²) of these, the floor that of the model's [noise]; NaN where none is stated (accelerations × N).
Eigen::MatrixXd stated_stddevs(const Model& model, const std::vector<std::string>& names, LogReader& reader, Eigen::Index n_rows);

/// Whether a common factor of the stated standard deviations is estimated.
bool estimates_factor(const FitProblemOptions& options);

/// σ of each value where the log states it, NaN elsewhere (d × N); empty when it states none, or the options override them.
Eigen::MatrixXd stated_noise(const Model& model, const std::vector<std::string>& observed, const FitProblemOptions& options,
                             LogReader& reader, const CsvTable& log, std::vector<std::string>& notes);

/// σ of each row or, where the log states it, the factor 1 of it.
/// @throws InputError when it is unknown, not positive, or too small for double precision.
Eigen::VectorXd noise_of(const Model& model, const FitProblemOptions& options, const Readings& readings, bool estimate);

/// s of each value: its stated standard deviation, or 1 where the log states none for the row; empty when it states none at all.
/// @param rows  of the log, of each state
/// @throws InputError naming the row of one too small for double precision.
Eigen::MatrixXd noise_scale_of(const Readings& readings, const std::vector<std::string>& names, const FitProblemOptions& options,
                               const LogReader& reader, const CsvTable& log, const std::vector<int>& rows);

/// @param stddev  of each value of a row whose values spread by `signal`
/// @param rows    of the log, of each value; empty where all have one noise
/// @throws InputError where one is too small for double precision.
void require_noise(const std::string& source, const std::string& name, double signal, const Eigen::RowVectorXd& stddev,
                   const std::vector<int>& rows);

/// σ of each row of side information, held against the size of its signal.
/// @param signal_stddev  of each latent
Eigen::VectorXd noise_of_side_information(const LoggedSystem& logged, const SideInformation& side_information,
                                          const FitProblemOptions& options, const Readings& readings,
                                          const std::vector<Eigen::VectorXd>& signal_stddev);

}  // namespace gp2
