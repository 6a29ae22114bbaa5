#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/actuator.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/export.hpp"
#include "gp2/model.hpp"
#include "gp2/observations.hpp"

namespace gp2 GP2_API {

/// What inputs were told over a whole log: by episodes, and where one pauses by what lies between pauses. What acts follows from it at
/// any time: before a part, the first command counts as constant.
class CommandRecord {
 public:
  /// Where a row stands.
  struct Place {
    int part = -1;    // −1: in none
    double time = 0;  // [s]
  };

  /// @param inputs  that are read: indices of the system's inputs
  /// @throws InputError for a log without times, or whose times run backwards; as LogReader::values.
  CommandRecord(const System& system, LogReader& reader, std::vector<int> inputs);

  [[nodiscard]] const std::vector<int>& inputs() const { return inputs_; }
  [[nodiscard]] double usual_step() const { return usual_step_; }  // 0 where no part has two rows

  /// Where the rows of a log stand, this or one with rows of it.
  [[nodiscard]] std::vector<Place> places(LogReader& reader) const;

  /// Whether what acts there depends on no command from before its part: `reach` [s] have passed.
  [[nodiscard]] bool knows(const Place& place, double reach) const;
  /// By what share of its spread a command changes from row to row, the median of the input that changes most.
  [[nodiscard]] double usual_change() const;
  /// Whether each input looks as if it had been at rest before the part of a place: it begins at 0, or stays as it is for that time,
  /// to a hundredth of its largest size.
  [[nodiscard]] bool begins_at_rest(const Place& place, double reach) const;

  /// Writes what acts at some places into states; where a place is in no part the command stays.
  /// @param actuators  of every input of the system
  void act(const std::vector<Actuator>& actuators, const std::vector<Place>& places, const StateLayout& layout,
           Eigen::MatrixXd& states) const;

 private:
  struct Part {
    std::string episode;
    std::vector<double> times;
    std::vector<int> rows;
    Eigen::MatrixXd commands;  // (inputs × times)
  };

  std::vector<int> inputs_;
  std::vector<Part> parts_;
  Eigen::VectorXd small_;  // of each input, a hundredth of its largest size
  double usual_step_ = 0;
};

/// The rows of Observations whose inputs were commands, to be told anew what acts.
struct CommandedRows {
  std::shared_ptr<const CommandRecord> record;
  std::vector<CommandRecord::Place> places;
  std::vector<Actuator> actuators;  // of the system that the log is of

  /// The same observations under other values of the delays and lags that are estimated, by name.
  [[nodiscard]] Observations under(const std::map<std::string, double>& values, const Observations& observations) const;
};

}  // namespace gp2
