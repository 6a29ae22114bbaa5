#include "jobs/chosen_rows.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/random.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<int> measured_rows(Readings& readings, const std::vector<std::string>& names, const std::string& log,
                               std::vector<std::string>& notes) {
  MatrixXd& values = readings.values;
  std::vector<std::string> missing;
  for (Index k = 0; k < values.rows(); ++k) {
    Index n_without = 0;
    if (readings.states_noise(k)) {
      for (Index i = 0; i < values.cols(); ++i) {
        if (std::isnan(values(k, i)) || !std::isnan(readings.stated_stddev(k, i))) continue;
        values(k, i) = not_a_number;
        ++n_without;
      }
    }
    const Index n = values.row(k).array().isNaN().count();
    if (n == 0) continue;
    missing.push_back(fmt::format("{} of {} of {}{}", n, values.cols(), names[static_cast<std::size_t>(k)],
                                  n_without > 0 ? fmt::format(" ({} without a standard deviation)", n_without) : ""));
  }
  std::vector<int> rows(static_cast<std::size_t>(values.cols()));
  std::iota(rows.begin(), rows.end(), 0);
  if (missing.empty()) return rows;
  notes.push_back(fmt::format("{}: values not measured (empty cells): {}", log, fmt::join(missing, ", ")));
  const std::size_t n_left_out = std::erase_if(rows, [&](int row) { return values.col(row).array().isNaN().all(); });
  if (rows.empty()) {
    throw InputError(fmt::format("{}: no row has a value and, where the log has a column for it, its standard deviation: {}", log,
                                 fmt::join(missing, ", ")));
  }
  if (n_left_out > 0) notes.push_back(fmt::format("{}: {} rows left out: they have no measured value", log, n_left_out));
  return rows;
}

std::vector<int> random_rows(const std::vector<int>& rows, const std::optional<int>& most, std::uint64_t seed,
                             const std::string& log, std::vector<std::string>& notes) {
  const int size = static_cast<int>(rows.size());
  if (!most || *most >= size) return rows;
  std::vector<int> chosen;
  for (const int k : RandomStream(seed).permutation(size)) chosen.push_back(rows[static_cast<std::size_t>(k)]);
  chosen.resize(static_cast<std::size_t>(*most));
  std::ranges::sort(chosen);
  notes.push_back(fmt::format("{}: {} of {} rows taken, by seed {}", log, *most, size, seed));
  return chosen;
}

std::vector<int> in_order_of_time(std::vector<int> rows, const System& system, const CsvTable& log,
                                  const std::map<std::string, std::string>& columns) {
  LogReader reader(log, system, columns);
  if (!reader.has("t")) return rows;
  VectorXd times;
  try {
    times = reader.values({"t"}).row(0).transpose();
  } catch (const InputError&) {
    return rows;  // not numbers: a fit that does not read them accepts that
  }
  const int episode_column = reader.episode_column();
  struct Episode {
    std::size_t number;
    double time;  // of its last row
  };
  std::map<std::string, Episode> episodes;
  std::vector<std::size_t> episode_of(static_cast<std::size_t>(log.n_rows()));
  std::size_t n_falls = 0;
  for (const int row : rows) {
    const std::string name = episode_column < 0 ? "" : log.cell(row, episode_column);
    const auto [found, is_new] = episodes.emplace(name, Episode{episodes.size(), times[row]});
    if (times[row] < found->second.time) ++n_falls;
    found->second.time = times[row];
    episode_of[static_cast<std::size_t>(row)] = found->second.number;
  }
  // in a log of several runs without a column for them time falls once per run
  if (n_falls * 10 <= rows.size()) return rows;
  std::ranges::stable_sort(rows, {}, [&](int row) { return std::pair(episode_of[static_cast<std::size_t>(row)], times[row]); });
  return rows;
}

}  // namespace gp2
