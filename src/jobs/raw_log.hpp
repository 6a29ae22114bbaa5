#pragma once

#include <map>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "gp2/data/log_reader.hpp"
#include "gp2/jobs/derive.hpp"

namespace gp2 {

/// Whether a cell is empty, or holds one of the words that loggers write instead of a value.
bool is_missing(const std::string& cell);

/// Rows of one episode in the log, and their times.
struct Episode {
  std::string label;
  std::vector<int> rows;
  std::vector<double> times;  // from its first row on [s]
  double start = 0;
  std::vector<double> distinct;  // the times without repetitions
};

/// A column of the log in one episode.
struct Channel {
  std::vector<Measurement> measurements;  // about `mean`
  double mean = 0;
  int missing = 0, repeated = 0, wraps = 0;
  double resolution = 0;
};

/// Positions as they were logged, by episodes and columns: what can be said of them before anything is smoothed.
class RawLog {
 public:
  /// @throws InputError of options, columns, episodes and times that are not as derive needs them.
  RawLog(const Model& model, const CsvTable& log, const DeriveOptions& options);

  [[nodiscard]] const std::vector<Episode>& episodes() const { return episodes_; }
  [[nodiscard]] const std::string& episode_column() const { return episode_column_; }  // empty without one
  [[nodiscard]] const std::vector<int>& measured() const { return measured_; }         // coordinates
  [[nodiscard]] bool has_input(std::size_t input) const { return input_column_[input] >= 0; }

  /// Positions of a measured coordinate, and velocities where they are logged.
  [[nodiscard]] Channel motion(int coordinate, const Episode& episode);
  [[nodiscard]] Channel input(std::size_t input, const Episode& episode) const;

  std::vector<std::string> notes;  // of what was read so far

 private:
  void find_columns();
  void find_episodes();
  void split_at_pauses();
  double unit_of(double usual_step);
  [[nodiscard]] std::vector<double> steps_between_samples() const;
  [[nodiscard]] bool moves(const Episode& part) const;
  void read_column(const Episode& episode, int column, bool velocity, Channel& channel) const;
  void unwrap(const Episode& episode, int column, Channel& channel);
  void require_motion(const Episode& episode, int column, const Channel& channel) const;
  [[nodiscard]] std::string place_of(int column) const;

  const System& system_;
  const CsvTable& log_;
  const DeriveOptions& options_;
  LogReader reader_;
  int time_column_ = -1;
  std::vector<int> measured_;
  std::map<int, int> position_column_, velocity_column_;  // of measured coordinates; −1: not logged
  std::vector<int> input_column_;                         // −1: not logged
  std::string episode_column_;
  std::vector<Episode> episodes_;
};

}  // namespace gp2
