#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "jobs/readings.hpp"

// Which rows of a log a fit learns from.
namespace gp2 {

/// The rows of a log with something measured. Values without a stated deviation where others of the column have one
/// become NaN: they count as not measured.
/// @param names  of the values
/// @throws InputError where no row measures anything.
std::vector<int> measured_rows(Readings& readings, const std::vector<std::string>& names, const std::string& log,
                               std::vector<std::string>& notes);

/// So many of some rows, chosen at random, in their order; all when there are no more.
/// @param most  not given: all
std::vector<int> random_rows(const std::vector<int>& rows, const std::optional<int>& most, std::uint64_t seed,
                             const std::string& log, std::vector<std::string>& notes);

/// Rows of a shuffled log in the order of its time, which tells whether they share their errors. Episodes stay together.
std::vector<int> in_order_of_time(std::vector<int> rows, const System& system, const CsvTable& log,
                                  const std::map<std::string, std::string>& columns);

}  // namespace gp2
