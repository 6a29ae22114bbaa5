#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/jobs/command_record.hpp"
#include "gp2/model.hpp"

// What acts at the rows of a log whose inputs are commands that act late.
namespace gp2 {

/// The same delays and lags, as known ones that nothing estimates.
std::vector<Actuator> without_estimates(std::vector<Actuator> actuators);

/// What acts takes the place of what was commanded, in the states of a whole log.
/// @param actuators  of the log's system
/// @param reader     of the log
/// @param whole      the log that this one has rows of; not given: itself
/// @param columns    of the whole log
/// @return where commands make a difference
std::optional<CommandedRows> take_commands(const System& system, const std::vector<Actuator>& actuators, LogReader& reader,
                                           const std::optional<CsvTable>& whole,
                                           const std::map<std::string, std::string>& columns, Eigen::MatrixXd& states,
                                           std::vector<std::string>& notes);

/// Leaves the rows of a log at which what acts is known, not resting on commands before the log.
/// @throws InputError where none is left.
void keep_known(const CommandedRows& commanded, const CsvTable& log, std::vector<int>& rows, std::vector<std::string>& notes);

/// Accelerations count as not measured where what acts is not known.
/// @param accelerations  (accelerations × N); without rows predictions are made, each input held at its first value before
void clear_unknown(const CommandedRows& commanded, const CsvTable& log, Eigen::MatrixXd& accelerations,
                   std::vector<std::string>& notes);

/// Of chosen rows; nothing where no delay and no lag is estimated, so that what acts need not be known any more.
std::optional<CommandedRows> estimated_at(std::optional<CommandedRows> commanded, const std::vector<int>& rows);

}  // namespace gp2
