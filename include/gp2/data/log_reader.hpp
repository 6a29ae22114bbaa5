#pragma once

#include <map>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// Finds a system's states and accelerations in a log by the names of its columns, in any order. A name is looked up as given by
/// `columns`, then as itself, then under its aliases: for coordinate q1: velocity qd1, v1, qvel1, acceleration qdd1, a1, qacc1;
/// for any coordinate NAME, and the name `columns` gives it: NAME_dot and NAME_ddot; for input u1: tau1; for t: time, timestamp, __time (PlotJuggler).
/// An alias that is a name of the model itself, say of a coordinate v1, is none.
class LogReader {
 public:
  /// @param columns  the model's name -> the log's name. Naming a coordinate also names its velocity dX and acceleration ddX.
  LogReader(const CsvTable& table, const System& system, const std::map<std::string, std::string>& columns = {});

  /// (layout size × N); entries that `reads` leaves out are NaN.
  /// @throws InputError naming a column that is missing, with those there are.
  [[nodiscard]] Eigen::MatrixXd states(const std::vector<bool>& reads);

  /// The same, but a cell that is empty or not finite is NaN.
  [[nodiscard]] Eigen::MatrixXd states_with_gaps(const std::vector<bool>& reads);

  /// Named columns of the model, say t and u1 (names.size() × N). @throws InputError as states.
  [[nodiscard]] Eigen::MatrixXd values(const std::vector<std::string>& names);

  /// Named columns of measurements, say ddq1 and ddq3 (names.size() × N): an empty cell is NaN, not measured.
  /// @throws InputError as states, for other cells that are not finite numbers, and for a column without any number.
  [[nodiscard]] Eigen::MatrixXd measurements(const std::vector<std::string>& names);

  /// The column with the standard deviation of each value of a named column of the model: the log's name of that with _std
  /// behind; empty when there is none.
  [[nodiscard]] std::string stddev_column(const std::string& name) const;
  /// (names.size() × N); an empty cell is NaN.
  /// @throws InputError naming file, line and column of a standard deviation that is not positive and finite, and as
  /// measurements.
  [[nodiscard]] Eigen::MatrixXd stddevs(const std::vector<std::string>& names);

  [[nodiscard]] const CsvTable& table() const { return table_; }
  [[nodiscard]] bool has(const std::string& name) const { return find(name) >= 0; }
  /// Whether there is such a column with something in it.
  [[nodiscard]] bool measures(const std::string& name) const;
  /// Where a name of the model stands in the table; it counts as used then. −1 when it is not there.
  [[nodiscard]] int column(const std::string& name) { return has(name) ? require(name) : -1; }
  /// Where the log says what belongs together; −1 where it does not.
  [[nodiscard]] int episode_column();
  /// After the reading is done: what was read under another name, and a warning of each name of `columns` that the table lacks
  /// though it has others of them.
  [[nodiscard]] std::vector<std::string> notes() const;
  [[nodiscard]] std::vector<std::string> unused_columns() const;  // after the reading is done

 private:
  [[nodiscard]] int find(const std::string& name) const;
  [[nodiscard]] int require(const std::string& name);
  [[nodiscard]] const char* mend_for_missing(const std::string& name) const;
  using Number = double (CsvTable::*)(int row, int column) const;
  [[nodiscard]] Eigen::MatrixXd read_states(const std::vector<bool>& reads, Number number);

  const CsvTable& table_;
  const System& system_;
  std::map<std::string, std::string> given_;    // names of columns as given
  std::map<std::string, std::string> columns_;  // and what these imply for velocities and accelerations
  std::map<std::string, std::vector<std::string>> aliases_;
  std::map<int, std::string> used_;  // column -> what it was read as
};

}  // namespace gp2
