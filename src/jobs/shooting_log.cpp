#include "jobs/shooting_log.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numeric>
#include <optional>
#include <utility>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/simulate.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/rate_check.hpp"
#include "simulation/contacts.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr Index least_rows_of_stretch = 8;

void require_seconds(const System& system, const MatrixXd& states, const std::string& log) {
  double unit_of_time = 1;
  wrong_rates(system, states, MatrixXd::Constant(system.nq(), states.cols(), not_a_number), /*reads_time=*/false, &unit_of_time);
  if (unit_of_time == 1) return;
  throw InputError(fmt::format(
      "{}: the rates of the coordinates say that t counts {:g} s, not seconds, over which motions are followed: convert it", log,
      unit_of_time));
}

void read_columns(const Model& model, const CsvTable& table, const std::map<std::string, std::string>& columns, ShootingLog& log,
                  std::vector<std::string>& notes) {
  const System& system = *model.system;
  LogReader reader = open_log(model, table, columns);
  log.states = reader.states(std::vector<bool>(static_cast<std::size_t>(system.layout().size()), true));
  require_seconds(system, log.states, table.name());
  take_commands(system, without_estimates(model.actuators), reader, std::nullopt, columns, log.states, notes);
  for (int j = 0; j < system.nq(); ++j) {
    const std::string& name = system.coordinates()[static_cast<std::size_t>(j)].name;
    if (reader.stddev_column(name).empty()) continue;
    log.compared.push_back(j);
    const MatrixXd stddevs = reader.stddevs({name});
    std::vector<double> known;
    std::ranges::copy_if(stddevs.reshaped(), std::back_inserter(known), [](double one) { return std::isfinite(one); });
    log.stated.push_back(median(std::move(known)));
  }
  if (log.compared.empty()) {
    log.compared.resize(system.coordinates().size());
    std::iota(log.compared.begin(), log.compared.end(), 0);
  }
  log.spread.resize(2 * Index{system.nq()});
  for (Index e = 0; e < log.spread.size(); ++e) {
    const double spread = row_stddev(log.states.row(e))[0];
    log.spread[e] = spread > 0 ? spread : 1;
  }
}

// 2/ω of the middle coordinate, the best of 1, 2, 4 on simulated logs: rms of its velocity over that of its changes in velocity.
double usual_duration(const ShootingLog& log, const StateLayout& layout, const std::vector<UnbrokenRows>& parts) {
  const auto times = log.states.row(layout.t());
  std::vector<double> durations;
  for (const int j : log.compared) {
    const auto dq = log.states.row(layout.dq(j));
    double velocity = 0, acceleration = 0;
    for (const auto& [first, n] : parts) {
      for (Index i = first + 1; i < first + n; ++i) {
        velocity += dq[i] * dq[i];
        acceleration += std::pow((dq[i] - dq[i - 1]) / (times[i] - times[i - 1]), 2);
      }
    }
    if (acceleration > 0) durations.push_back(std::sqrt(velocity / acceleration));
  }
  constexpr double factor = 2;
  return durations.empty() ? not_a_number : factor * median(std::move(durations));
}

// Whether a motion can start at each row: where each contact is surely closed or open, not at an impact, nor where its gap is lost in
// noise.
std::vector<bool> possible_starts(const Model& model, const MatrixXd& states) {
  const System& system = *model.system;
  const VectorXd parameters = system.parameter_values();
  const std::vector<Contact> contacts = contacts_of(model, parameters);
  const MatrixXd gaps = gaps_of(system, contacts, states, parameters);
  const auto n = static_cast<std::size_t>(states.cols());
  std::vector<bool> possible(n, true);
  for (std::size_t k = 0; k < contacts.size(); ++k) {
    const auto gap = gaps.row(static_cast<Index>(k));
    const auto closed = states.row(system.layout().u(contacts[k].input)).array() > 0.5;
    // how far the gap must be open for the errors of a log not to hide it: twice the largest |gap| of what is closed, or beyond 0
    double clearance = 0;
    for (Index i = 0; i < gap.size(); ++i) clearance = std::max(clearance, 2 * (closed[i] ? std::abs(gap[i]) : -gap[i]));
    for (Index i = 0; i < gap.size(); ++i) {
      const bool changes = i + 1 < gap.size() && closed[i] != closed[i + 1];
      if (changes || !(closed[i] || gap[i] > clearance)) possible[static_cast<std::size_t>(i)] = false;
    }
  }
  return possible;
}

void cut(const Model& model, const CsvTable& table, const ShootRequest& request, ShootingLog& log) {
  const StateLayout layout = model.system->layout();
  const VectorXd times = log.states.row(layout.t()).transpose();
  const double usual = usual_step(times);
  if (usual == 0) throw InputError(fmt::format("{}: t never increases from one row to the next", table.name()));
  const std::vector<bool> can_start = possible_starts(model, log.states);
  const int episode = table.find("episode");
  const std::vector<UnbrokenRows> parts = unbroken_parts(times, [&](Index i) {
    return episode < 0 || table.cell(static_cast<int>(i), episode) == table.cell(static_cast<int>(i - 1), episode);
  });
  const Index longest = std::ranges::max(parts, {}, &UnbrokenRows::n).n;
  const auto most_rows = static_cast<double>(std::max(longest / 2, least_rows_of_stretch));
  log.duration = request.duration.value_or(
      std::clamp(usual_duration(log, layout, parts), (least_rows_of_stretch - 1) * usual, (most_rows - 1) * usual));
  if (!(log.duration > 0) || !std::isfinite(log.duration))
    throw InputError(fmt::format("`duration`: must be positive and finite, got {}", log.duration));
  if (request.most_stretches < 1)
    throw InputError(fmt::format("`stretches`: must be at least 1, got {}", request.most_stretches));
  // one that no part holds is as good as any longer one
  const auto size = static_cast<Index>(std::min(std::floor(log.duration / usual + 1e-9), static_cast<double>(longest))) + 1;
  std::vector<Stretch> found;
  for (const auto& [first, n] : parts) {
    for (Index i = first; i + size <= first + n;) {
      const bool starts = can_start[static_cast<std::size_t>(i)];
      if (starts) found.push_back({i, size, log.states.col(i)});
      i += starts ? size - 1 : 1;  // the row where one ends is that where the next starts
    }
  }
  if (size < least_rows_of_stretch || found.empty()) {
    throw InputError(
        fmt::format("{}: no stretch of {:.3g} s with at least {} rows without a break; rows are {:.3g} s apart: "
                    "another `duration`, or a log of all rows in order of time",
                    table.name(), log.duration, least_rows_of_stretch, usual));
  }
  const std::size_t n_taken = std::min(found.size(), static_cast<std::size_t>(request.most_stretches));
  for (std::size_t k = 0; k < n_taken; ++k) log.stretches.push_back(found[k * found.size() / n_taken]);
}

}  // namespace

std::vector<UnbrokenRows> unbroken_parts(const Eigen::Ref<const VectorXd>& times,
                                         const std::function<bool(Index i)>& is_same_episode) {
  constexpr double most_steps = 5;  // usual ones, beyond which a log does not go on
  const double usual = usual_step(times);
  std::vector<UnbrokenRows> parts;
  for (Index i = 0; i < times.size(); ++i) {
    const double step = i == 0 ? 0 : times[i] - times[i - 1];
    if (!(step > 0 && step < most_steps * usual && is_same_episode(i))) parts.push_back({i, 0});
    ++parts.back().n;
  }
  return parts;
}

ShootingLog read_shooting_log(const Model& model, const CsvTable& table, const ShootRequest& request,
                              std::vector<std::string>& notes) {
  ShootingLog log;
  read_columns(model, table, request.columns, log, notes);
  cut(model, table, request, log);
  return log;
}

}  // namespace gp2
