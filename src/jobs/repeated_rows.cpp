#include "jobs/repeated_rows.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

#include <fmt/format.h>

#include "data/evenly.hpp"

namespace gp2 {

using Eigen::Index;

int n_repeated_rows(const std::vector<MeasuredRows>& logs) {
  struct Row {
    const MeasuredRows* log;
    Index i;
    std::uint64_t hash = 0;
    // NaN is not equal to itself, and −0 is 0; the last digits may not be those of another program that read and wrote a log
    [[nodiscard]] double entry(Index k) const {
      const double one = k < log->states.rows() ? log->states(k, i) : log->values(k - log->states.rows(), i);
      if (std::isnan(one) || one == 0) return 0;
      constexpr std::uint64_t last = (std::uint64_t{1} << 12) - 1;  // bits, which leaves twelve digits
      return std::bit_cast<double>((std::bit_cast<std::uint64_t>(one) + (last + 1) / 2) & ~last);
    }
    [[nodiscard]] Index size() const { return log->states.rows() + log->values.rows(); }
  };
  // negative, 0 or positive as row a comes before b, repeats it, or comes behind it: rows are sorted by a hash of their bits first
  const auto compare = [](const Row& a, const Row& b) {
    if (a.hash != b.hash) return a.hash < b.hash ? -1 : 1;
    if (a.size() != b.size()) return a.size() < b.size() ? -1 : 1;
    for (Index k = 0; k < a.size(); ++k) {
      if (a.entry(k) != b.entry(k)) return a.entry(k) < b.entry(k) ? -1 : 1;
    }
    return 0;
  };
  std::vector<Row> rows;
  std::ptrdiff_t n_rows = 0;
  for (const MeasuredRows& log : logs) n_rows += log.states.cols();
  rows.reserve(static_cast<std::size_t>(n_rows));
  for (const MeasuredRows& log : logs) {
    for (Index i = 0; i < log.states.cols(); ++i) {
      Row& row = rows.emplace_back(Row{&log, i});
      for (Index k = 0; k < row.size(); ++k) {
        row.hash = (std::rotl(row.hash, 23) ^ std::bit_cast<std::uint64_t>(row.entry(k))) * 0x9e3779b97f4a7c15U;
      }
    }
  }
  std::sort(rows.begin(), rows.end(), [&](const Row& a, const Row& b) { return compare(a, b) < 0; });
  int n = 0;
  for (std::size_t k = 1; k < rows.size(); ++k) n += compare(rows[k - 1], rows[k]) == 0 ? 1 : 0;
  return n;
}

void note_repeated_rows(const MeasuredRows& rows, const std::string& log, std::vector<std::string>& notes) {
  const int n_repeated = n_repeated_rows({rows});
  if (n_repeated * 20 <= rows.states.cols()) return;
  notes.push_back(fmt::format(
      "warning: {}: {} of {} rows repeat another one to twelve digits: standard deviations will be too small; keep each once",
      log, n_repeated, rows.states.cols()));
}

void note_shared_rows(const std::vector<Observations>& known, const std::vector<Observations>& more,
                      std::vector<std::string>& notes) {
  const auto n_shared = [](const std::vector<const Observations*>& groups) {
    std::vector<MeasuredRows> all;
    int n = 0;
    for (const Observations* const group : groups) {
      if (group->has_sums()) continue;
      all.push_back({group->states(), group->values()});
      n -= n_repeated_rows({all.back()});
    }
    return all.size() < 2 ? 0 : n + n_repeated_rows(all);
  };
  if (known.size() + more.size() < 2) return;
  std::vector<const Observations*> groups;
  for (const Observations& group : known) groups.push_back(&group);
  const int n_before = n_shared(groups);
  for (const Observations& group : more) groups.push_back(&group);
  const int n = n_shared(groups) - n_before;
  if (n * 20 <= n_states(more)) return;
  notes.push_back(fmt::format(
      "warning: {} of {} rows are also in another log, to twelve digits: standard deviations will be too small; give each once",
      n, n_states(more)));
}

}  // namespace gp2
