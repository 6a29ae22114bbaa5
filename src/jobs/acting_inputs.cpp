#include "jobs/acting_inputs.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

double reach_of(const CommandedRows& rows) {
  double reach = 0;
  for (const int k : rows.record->inputs()) reach = std::max(reach, rows.actuators[static_cast<std::size_t>(k)].reach());
  return reach;
}

// Whether what acts is known at a row, not resting on commands before the log.
bool is_known(const CommandedRows& rows, std::size_t row) { return rows.record->knows(rows.places[row], reach_of(rows)); }

std::string unknown_text(const CsvTable& log, std::size_t n, const char* consequence) {
  return fmt::format("{}: {} of {} rows {}: what acts there depends on commands before the log", log.name(), n, log.n_rows(),
                     consequence);
}

}  // namespace

std::optional<CommandedRows> take_commands(const System& system, const std::vector<Actuator>& actuators, LogReader& reader,
                                           const std::optional<CsvTable>& whole,
                                           const std::map<std::string, std::string>& columns, MatrixXd& states,
                                           std::vector<std::string>& notes) {
  std::vector<int> late;
  double lateness = 0;
  for (int k = 0; k < static_cast<int>(actuators.size()); ++k) {
    const Actuator& actuator = actuators[static_cast<std::size_t>(k)];
    if ((actuator.is_direct() && !actuator.is_estimated()) || states.row(system.layout().u(k)).array().isNaN().all()) continue;
    late.push_back(k);
    lateness = std::max(lateness, actuator.largest_delay() + actuator.largest_lag());
  }
  if (late.empty()) return std::nullopt;
  CommandedRows out{nullptr, {}, actuators};
  if (whole) {
    LogReader of_whole(*whole, system, columns);
    out.record = std::make_shared<const CommandRecord>(system, of_whole, late);
  } else {
    out.record = std::make_shared<const CommandRecord>(system, reader, late);
    constexpr double little = 0.01;  // of the spread of what acts
    const double step = out.record->usual_step();
    if (step > lateness && out.record->usual_change() * lateness > little * step) {
      notes.push_back(
          fmt::format("warning: {}: rows are usually {:.3g} s apart, inputs at most {:.3g} s late: what acts in between is not "
                      "known; log faster, or, if these are rows of a longer log, give all of it, to a fit as `commands`",
                      reader.table().name(), out.record->usual_step(), lateness));
    }
  }
  out.places = out.record->places(reader);
  out.record->act(actuators, out.places, system.layout(), states);
  return out;
}

void keep_known(const CommandedRows& commanded, const CsvTable& log, std::vector<int>& rows, std::vector<std::string>& notes) {
  const std::size_t n = std::erase_if(rows, [&](int row) { return !is_known(commanded, static_cast<std::size_t>(row)); });
  if (n == 0) return;
  if (rows.empty()) {
    throw InputError(
        fmt::format("{}: the acting inputs are not known at any row: they all depend on commands before the log; give the whole "
                    "log as `commands`, a longer one, or narrower bounds of delays and lags",
                    log.name()));
  }
  notes.push_back(unknown_text(log, n, "left out"));
}

void clear_unknown(const CommandedRows& commanded, const CsvTable& log, MatrixXd& accelerations,
                   std::vector<std::string>& notes) {
  std::size_t n_unknown = 0;
  bool begins_at_rest = true;
  for (std::size_t i = 0; i < commanded.places.size(); ++i) {
    if (is_known(commanded, i)) continue;
    ++n_unknown;
    begins_at_rest = begins_at_rest && commanded.record->begins_at_rest(commanded.places[i], reach_of(commanded));
    accelerations.col(static_cast<Index>(i)).setConstant(not_a_number);
  }
  if (n_unknown == 0) return;
  const bool is_predicted = accelerations.rows() == 0;
  if (is_predicted && !begins_at_rest) {
    notes.push_back(
        fmt::format("warning: {}: {} of {} rows are predicted as if each input had held its first value before, but the "
                    "log begins neither with constant inputs nor with 0: what acts there depends on commands before the log",
                    log.name(), n_unknown, log.n_rows()));
  } else {
    notes.push_back(unknown_text(log, n_unknown, is_predicted ? "as if each input had held its first value before" : "left out"));
  }
}

std::optional<CommandedRows> estimated_at(std::optional<CommandedRows> commanded, const std::vector<int>& rows) {
  if (!commanded || std::ranges::none_of(commanded->actuators, &Actuator::is_estimated)) return std::nullopt;
  std::vector<CommandRecord::Place> places;
  for (const int row : rows) places.push_back(commanded->places[static_cast<std::size_t>(row)]);
  commanded->places = std::move(places);
  return commanded;
}

std::vector<Actuator> without_estimates(std::vector<Actuator> actuators) {
  for (Actuator& actuator : actuators) actuator.delay.estimate = actuator.lag.estimate = false;
  return actuators;
}

}  // namespace gp2
