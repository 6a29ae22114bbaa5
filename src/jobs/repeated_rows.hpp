#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/observations.hpp"

// Rows that are copies of others are no measurements.
namespace gp2 {

/// States, and the values measured there.
struct MeasuredRows {
  const Eigen::MatrixXd &states, &values;
};

/// How many rows of some logs are those of an earlier one to twelve digits.
int n_repeated_rows(const std::vector<MeasuredRows>& logs);

/// Warns where more than a twentieth of the rows of a log repeat another one.
void note_repeated_rows(const MeasuredRows& rows, const std::string& log, std::vector<std::string>& notes);

/// Warns where more than a twentieth of the rows of more logs are those of another of them, or of a log that is known, in whatever
/// order.
void note_shared_rows(const std::vector<Observations>& known, const std::vector<Observations>& more,
                      std::vector<std::string>& notes);

}  // namespace gp2
