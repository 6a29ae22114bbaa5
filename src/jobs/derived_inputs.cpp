#include "jobs/derived_inputs.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/simulate.hpp"
#include "jobs/rate_check.hpp"
#include "smoothing/smooth_each.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

/// The coordinates whose applied force reads an input, at states of no special place; all where that is not known.
std::vector<bool> driven_by(const System& system, std::size_t input) {
  constexpr Index n = 3;
  const StateLayout layout = system.layout();
  MatrixXd states(layout.size(), 2 * n);
  for (Index k = 0; k < states.rows(); ++k) {
    for (Index i = 0; i < n; ++i) states(k, i) = states(k, n + i) = 0.7 * std::sin(1.0 + static_cast<double>(k + 11 * i));
  }
  states.row(layout.u(static_cast<int>(input))).tail(n).array() += 1;
  std::vector<bool> driven(static_cast<std::size_t>(layout.nq), true);
  try {
    const MatrixXd force = system.evaluate(states, system.parameter_values()).force;
    const MatrixXd change = force.rightCols(n) - force.leftCols(n);
    if (!change.allFinite()) return driven;
    for (Index j = 0; j < change.rows(); ++j) driven[static_cast<std::size_t>(j)] = !change.row(j).isZero(0);
  } catch (const InputError&) {  // code that is not defined there
  }
  return driven;
}

struct Hole {
  double length = 0, start = 0;
};

/// The longest time without a value of a channel, where that is many of its usual steps; else 0.
Hole longest_hole(const Channel& channel, const Episode& episode) {
  constexpr double many = 10;
  std::vector<double> times = {episode.times.front()}, steps;
  for (const Measurement& one : channel.measurements) {
    if (times.size() > 1 && one.time > times.back()) steps.push_back(one.time - times.back());
    times.push_back(one.time);
  }
  times.push_back(episode.times.back());
  Hole longest;
  for (std::size_t k = 1; k < times.size(); ++k) {
    if (times[k] - times[k - 1] > longest.length) longest = {times[k] - times[k - 1], episode.start + times[k - 1]};
  }
  return !steps.empty() && longest.length <= many * median(steps) ? Hole{} : longest;
}

/// The series of the least bandwidth in an episode, of the coordinates that an input drives; of all where it drives none of them.
const DerivedSeries& slowest_of(const std::vector<DerivedSeries>& all, int episode, const std::vector<bool>& driven) {
  const DerivedSeries *slowest = nullptr, *slowest_driven = nullptr;
  for (const DerivedSeries& series : all) {
    if (series.episode != episode) continue;
    if (!slowest || series.bandwidth < slowest->bandwidth) slowest = &series;
    if (!driven[static_cast<std::size_t>(series.coordinate)]) continue;
    if (!slowest_driven || series.bandwidth < slowest_driven->bandwidth) slowest_driven = &series;
  }
  return slowest_driven ? *slowest_driven : *slowest;
}

}  // namespace

void add_inputs(const System& system, const RawLog& raw, const std::string& log, const std::vector<EpisodeRows>& rows,
                DerivedData& data) {
  for (std::size_t u = 0; u < system.inputs().size(); ++u) {
    if (!raw.has_input(u)) continue;
    const std::vector<bool> driven = driven_by(system, u);
    std::vector<double> as_logged;  // by the rows of the log; NaN: no value
    Hole longest;
    for (std::size_t e = 0; e < rows.size(); ++e) {
      const Episode& episode = raw.episodes()[e];
      const DerivedSeries& slowest = slowest_of(data.series, static_cast<int>(e), driven);
      const Channel channel = raw.input(u, episode);
      Episode by_row = episode;  // with numbers of rows for times, which several rows may share
      by_row.times.assign(episode.rows.begin(), episode.rows.end());
      const Channel written = raw.input(u, by_row);
      for (const Measurement& one : written.measurements) {
        const auto row = static_cast<std::size_t>(one.time);
        as_logged.resize(std::max(as_logged.size(), row + 1), not_a_number);
        as_logged[row] = one.value + written.mean;
      }
      if (const Hole hole = longest_hole(channel, episode); hole.length > longest.length && hole.length * slowest.bandwidth > 1)
        longest = hole;
      smooth_each(slowest.model, channel.measurements, rows[e].times,
                  [&](Index i, const Eigen::Vector3d& motion, const Eigen::Matrix3d&) {
                    data.states(system.layout().u(static_cast<int>(u)), rows[e].first + i) = motion[0] + channel.mean;
                  });
    }
    const Eigen::Map<const Eigen::RowVectorXd> commands(as_logged.data(), std::ssize(as_logged));
    const std::string& name = system.inputs()[u];
    if (auto text = clipped_input(name, commands)) data.notes.push_back(*std::move(text));
    if (auto text = far_values_text(name, {commands})) data.notes.push_back(fmt::format("warning: {}: {}", log, *text));
    if (longest.length > 0) {
      data.notes.push_back(
          fmt::format("warning: {}: the input {} has no value for {:.3g} s, from t = {:.6g} on: what is written there is a guess",
                      log, name, longest.length, longest.start));
    }
  }
}

void let_inputs_act(const Model& model, const RawLog& raw, const std::vector<EpisodeRows>& rows, MatrixXd& states) {
  const StateLayout layout = model.system->layout();
  for (int u = 0; u < layout.nu; ++u) {
    const Actuator& actuator = model.actuators[static_cast<std::size_t>(u)];
    if (!raw.has_input(static_cast<std::size_t>(u)) || actuator.is_direct()) continue;
    for (const EpisodeRows& episode : rows) {
      auto acting = states.row(layout.u(u)).segment(episode.first, episode.n());
      const InputSignal signal(episode.times, acting, {actuator});
      for (Index i = 0; i < episode.n(); ++i) {
        VectorXd now(1);
        signal.evaluate(episode.times[i], now);
        acting[i] = now[0];
      }
    }
  }
}

}  // namespace gp2
