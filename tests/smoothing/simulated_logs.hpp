#pragma once

#include <array>
#include <cmath>
#include <numbers>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/LU>

#include "base/random.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/simulate.hpp"
#include "test_models.hpp"

// Logs of a double pendulum whose motion is known, with the faults of real ones.
namespace gp2::test {

/// What a logger does to a motion.
struct LogFaults {
  double noise_stddev = 0;
  double step = 1e-5;   // of the encoder
  double dropped = 0;   // fraction of rows that are missing
  double outliers = 0;  // fraction of values that are off by up to ±0.5 rad
};

/// Motions of models/double_pendulum.toml, sampled at 500 Hz.
struct SimulatedLog {
  std::vector<Trajectory> episodes;
  CsvTable table;  // episode, t, q3, q6
};

inline SimulatedLog simulated_log(const Model& model, const std::vector<std::array<double, 4>>& starts, double duration,
                                  const LogFaults& faults, std::uint64_t seed) {
  constexpr double sampling_rate = 500;
  RandomStream random(seed);
  std::vector<Trajectory> episodes;
  std::vector<std::string> cells;
  const StateLayout layout = model.system->layout();
  const auto n = static_cast<Eigen::Index>(std::lround(duration * sampling_rate));
  for (std::size_t e = 0; e < starts.size(); ++e) {
    StartingPoint start{Eigen::VectorXd::Zero(layout.size()), std::vector<bool>(static_cast<std::size_t>(layout.size()), false)};
    const std::array<int, 4> entries = {layout.q(2), layout.q(5), layout.dq(2), layout.dq(5)};
    for (std::size_t k = 0; k < 4; ++k) {
      start.state[entries[k]] = starts[e][k];
      start.given[static_cast<std::size_t>(entries[k])] = true;
    }
    std::vector<std::string> notes;
    SimulateOptions options;
    options.times = Eigen::VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1) / sampling_rate);
    options.relative_tolerance = 1e-10;
    options.absolute_tolerance = 1e-12;
    const Eigen::VectorXd parameters = model.system->parameter_values();
    episodes.push_back(
        simulate(*model.system, parameters, model_acceleration(model), complete_start(model, parameters, start, notes), options));
    const Trajectory& truth = episodes.back();
    for (Eigen::Index i = 0; i < n; ++i) {
      const bool inner = i > 0 && i + 1 < n;
      if (random.uniform() < faults.dropped && inner) continue;
      cells.push_back(std::to_string(e));
      cells.push_back(shortest(truth.times[i]));
      for (const int j : {2, 5}) {
        double value = truth.states(layout.q(j), i) + faults.noise_stddev * random.normal();
        if (random.uniform() < faults.outliers) value += random.uniform() - 0.5;
        cells.push_back(shortest(faults.step * std::round(value / faults.step)));
      }
    }
  }
  return {std::move(episodes), CsvTable::from_cells("simulated log", {"episode", "t", "q3", "q6"}, std::move(cells))};
}

/// rms error and how often a 95 % interval holds the truth, of q, dq and ddq.
struct Score {
  Eigen::Vector3d rms = Eigen::Vector3d::Zero();
  Eigen::Vector3d coverage = Eigen::Vector3d::Zero();
};

/// @param inner  leaves out that many rows at either end; negative: only these
inline Score score_of(const DerivedData& data, const SimulatedLog& log, const System& system, int inner) {
  const StateLayout layout = system.layout();
  Score score;
  double n = 0;
  for (Eigen::Index i = 0; i < data.states.cols(); ++i) {
    const Trajectory& truth = log.episodes[static_cast<std::size_t>(
        std::stoi(data.episodes[static_cast<std::size_t>(data.episode[static_cast<std::size_t>(i)])]))];
    const auto at = static_cast<Eigen::Index>(std::lround(data.states(layout.t(), i) * 500));
    const auto from_end = std::min(at, truth.times.size() - 1 - at);
    if (inner >= 0 ? from_end < inner : from_end >= -inner) continue;
    for (const int j : data.measured) {
      const std::array<double, 3> errors = {data.states(layout.q(j), i) - truth.states(layout.q(j), at),
                                            data.states(layout.dq(j), i) - truth.states(layout.dq(j), at),
                                            data.accelerations(j, i) - truth.accelerations(j, at)};
      for (int d = 0; d < 3; ++d) {
        const double error = errors[static_cast<std::size_t>(d)];
        score.rms[d] += error * error;
        score.coverage[d] += std::abs(error) <= 1.96 * data.stddev(d * layout.nq + j, i) ? 1 : 0;
      }
      ++n;
    }
  }
  score.rms = (score.rms / n).cwiseSqrt();
  score.coverage /= n;
  return score;
}

/// What a Savitzky–Golay filter makes of a log, 31 samples and order 4, missing samples bridged by straight lines.
inline Score savitzky_golay_score(const SimulatedLog& log, const System& system) {
  constexpr int reach = 15, order = 4;
  constexpr double time_step = 1 / 500.0;
  Eigen::MatrixXd powers(2 * reach + 1, order + 1);
  for (int k = -reach; k <= reach; ++k) {
    for (int p = 0; p <= order; ++p) powers(k + reach, p) = std::pow(k, p);
  }
  const Eigen::MatrixXd filter = (powers.transpose() * powers).inverse() * powers.transpose();
  const StateLayout layout = system.layout();
  Score score;
  double n = 0;
  for (std::size_t e = 0; e < log.episodes.size(); ++e) {
    const Trajectory& truth = log.episodes[e];
    for (const int j : {2, 5}) {
      const int column = log.table.find(j == 2 ? "q3" : "q6");
      Eigen::VectorXd values = Eigen::VectorXd::Constant(truth.times.size(), std::nan(""));
      for (int row = 0; row < log.table.n_rows(); ++row) {
        if (log.table.number(row, 0) == static_cast<double>(e))
          values[std::lround(log.table.number(row, 1) * 500)] = log.table.number(row, column);
      }
      Eigen::Index known = 0;
      for (Eigen::Index i = 1; i < values.size(); ++i) {
        if (std::isnan(values[i])) continue;
        for (Eigen::Index k = known + 1; k < i; ++k) {
          values[k] =
              values[known] + (values[i] - values[known]) * static_cast<double>(k - known) / static_cast<double>(i - known);
        }
        known = i;
      }
      for (Eigen::Index i = reach; i + reach < values.size(); ++i) {
        const Eigen::VectorXd fitted = filter * values.segment(i - reach, 2 * reach + 1);
        score.rms[0] += std::pow(fitted[0] - truth.states(layout.q(j), i), 2);
        score.rms[1] += std::pow(fitted[1] / time_step - truth.states(layout.dq(j), i), 2);
        score.rms[2] += std::pow(2 * fitted[2] / (time_step * time_step) - truth.accelerations(j, i), 2);
        ++n;
      }
    }
  }
  score.rms = (score.rms / n).cwiseSqrt();
  return score;
}

}  // namespace gp2::test
