#include "gp2/jobs/command_record.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double pause = 20;  // usual steps

std::string episode_of(const CsvTable& log, int row, int column) { return column < 0 ? "" : log.cell(row, column); }

}  // namespace

CommandRecord::CommandRecord(const System& system, LogReader& reader, std::vector<int> inputs) : inputs_(std::move(inputs)) {
  const CsvTable& log = reader.table();
  std::vector<std::string> names;
  for (const int input : inputs_) names.push_back(system.inputs()[static_cast<std::size_t>(input)]);
  const std::string late = fmt::format("{}: {} {} late", log.name(), fmt::join(names, ", "), names.size() == 1 ? "acts" : "act");
  if (!reader.has("t")) {
    throw InputError(
        fmt::format("{}, which takes the times of the whole log, but it has no column t; it has: {}. Where its inputs "
                    "are what acts, give the model no delay and no lag",
                    late, fmt::join(log.header(), ", ")));
  }
  const VectorXd times = reader.values({"t"}).row(0).transpose();
  const MatrixXd commands = reader.values(names);
  const int episode_column = reader.episode_column();

  // rows of each episode, in the order in which these begin
  std::map<std::string, std::size_t> number;
  std::vector<std::vector<int>> episodes;
  std::vector<double> steps;
  for (int row = 0; row < log.n_rows(); ++row) {
    const auto [found, is_new] = number.emplace(episode_of(log, row, episode_column), episodes.size());
    if (is_new) episodes.emplace_back();
    std::vector<int>& rows = episodes[found->second];
    const double step = rows.empty() ? 0 : times[row] - times[rows.back()];
    if (step < 0) {
      throw InputError(fmt::format("{}, which takes rows in the order of time, but {} has t = {} after {}. Sort the rows{}", late,
                                   log.place(row, reader.column("t")), times[row], times[rows.back()],
                                   episode_column < 0 ? ", or name what belongs together in a column 'episode'" : ""));
    }
    if (step == 0 && !rows.empty()) continue;
    if (step > 0) steps.push_back(step);
    rows.push_back(row);
  }
  if (!steps.empty()) usual_step_ = median(steps);

  for (const std::vector<int>& rows : episodes) {
    for (std::size_t k = 0; k < rows.size(); ++k) {
      if (k == 0 || times[rows[k]] - times[rows[k - 1]] > pause * usual_step_)
        parts_.push_back({episode_of(log, rows[k], episode_column), {}, {}, {}});
      parts_.back().times.push_back(times[rows[k]]);
      parts_.back().rows.push_back(rows[k]);
    }
  }
  for (Part& part : parts_) part.commands = commands(Eigen::all, part.rows);
  constexpr double little = 0.01;
  small_ = little * row_size(commands);
}

std::vector<CommandRecord::Place> CommandRecord::places(LogReader& reader) const {
  const CsvTable& log = reader.table();
  // the parts of an episode, by their starts
  std::map<std::string, std::map<double, int>> parts;
  for (int p = 0; p < static_cast<int>(parts_.size()); ++p) {
    const Part& part = parts_[static_cast<std::size_t>(p)];
    parts[part.episode].emplace(part.times.front(), p);
  }
  const VectorXd times = reader.values({"t"}).row(0).transpose();
  const int episode_column = reader.episode_column();
  std::vector<Place> out(static_cast<std::size_t>(log.n_rows()));
  for (int row = 0; row < log.n_rows(); ++row) {
    const auto episode = parts.find(episode_of(log, row, episode_column));
    if (episode == parts.end()) continue;
    const auto after = episode->second.upper_bound(times[row]);
    if (after == episode->second.begin()) continue;
    const int part = std::prev(after)->second;
    if (times[row] <= parts_[static_cast<std::size_t>(part)].times.back())
      out[static_cast<std::size_t>(row)] = {part, times[row]};
  }
  return out;
}

bool CommandRecord::knows(const Place& place, double reach) const {
  constexpr double rounding = 1e-9;
  return place.part >= 0 && place.time - parts_[static_cast<std::size_t>(place.part)].times.front() >= (1 - rounding) * reach;
}

bool CommandRecord::begins_at_rest(const Place& place, double reach) const {
  if (place.part < 0) return false;
  const Part& part = parts_[static_cast<std::size_t>(place.part)];
  const Index within = std::upper_bound(part.times.begin(), part.times.end(), part.times.front() + reach) - part.times.begin();
  const Index n = std::min(std::max<Index>(within, 2), part.commands.cols());
  for (Index k = 0; k < part.commands.rows(); ++k) {
    const auto command = part.commands.row(k).head(n);
    const bool stays = n > 1 && ((command.array() - command[0]).abs() <= small_[k]).all();
    if (!stays && !(std::abs(command[0]) <= small_[k])) return false;
  }
  return true;
}

double CommandRecord::usual_change() const {
  double most = 0;
  for (Index k = 0; k < std::ssize(inputs_); ++k) {
    std::vector<double> changes, values;
    for (const Part& part : parts_) {
      const auto command = part.commands.row(k);
      values.insert(values.end(), command.begin(), command.end());
      for (Index i = 1; i < command.size(); ++i) changes.push_back(std::abs(command[i] - command[i - 1]));
    }
    const Eigen::Map<const VectorXd> all(values.data(), std::ssize(values));
    const double spread = std::sqrt((all.array() - all.mean()).square().mean());
    if (spread > 0 && !changes.empty()) most = std::max(most, median(std::move(changes)) / spread);
  }
  return most;
}

void CommandRecord::act(const std::vector<Actuator>& actuators, const std::vector<Place>& places, const StateLayout& layout,
                        MatrixXd& states) const {
  std::vector<Actuator> of_inputs;
  for (const int input : inputs_) of_inputs.push_back(actuators[static_cast<std::size_t>(input)]);
  std::vector<std::optional<InputSignal>> signals(parts_.size());
  VectorXd acting(std::ssize(inputs_));
  for (std::size_t i = 0; i < places.size(); ++i) {
    if (places[i].part < 0) continue;
    std::optional<InputSignal>& signal = signals[static_cast<std::size_t>(places[i].part)];
    if (!signal) {
      const Part& part = parts_[static_cast<std::size_t>(places[i].part)];
      signal.emplace(Eigen::Map<const VectorXd>(part.times.data(), std::ssize(part.times)), part.commands, of_inputs);
    }
    signal->evaluate(places[i].time, acting);
    for (Index k = 0; k < acting.size(); ++k)
      states(layout.u(inputs_[static_cast<std::size_t>(k)]), static_cast<Index>(i)) = acting[k];
  }
}

Observations CommandedRows::under(const std::map<std::string, double>& values, const Observations& observations) const {
  std::vector<Actuator> there = actuators;
  for (Actuator& actuator : there) {
    for (Parameter* one : {&actuator.delay, &actuator.lag}) {
      if (one->estimate) one->value = values.at(one->name);
    }
  }
  const auto nu = static_cast<int>(there.size());
  const auto n_entries = static_cast<int>(observations.states().rows());
  MatrixXd states = observations.states();
  record->act(there, places, {(n_entries - 1 - nu) / 2, nu}, states);
  return observations.with_states(std::move(states));
}

}  // namespace gp2
