#include "smoothing/simulated_logs.hpp"

#include <fmt/format.h>
#include <gtest/gtest.h>

namespace gp2::test {
namespace {

// q3, q6, dq3, dq6 at the start
const std::vector<std::array<double, 4>> slow = {{3.5, 3.6, 0, 0}, {3.0, 2.5, 1, -1}, {2.8, 3.9, 0, 2}};
const std::vector<std::array<double, 4>> fast = {{2.0, 1.5, 3, -4}, {3.2, 3.1, 11, -7}, {4.4, 1.0, 0, 5}};

struct Case {
  const char* name;
  LogFaults faults;
};

const double twelve_bits = 2 * std::numbers::pi / 4096;
const std::vector<Case> cases = {
    {"noise 2e-5 rad, written to 1e-5 rad", {2e-5, 1e-5, 0, 0}},
    {"noise 6e-5 rad, written to 1e-5 rad", {6e-5, 1e-5, 0, 0}},
    {"noise 5e-4 rad", {5e-4, 1e-12, 0, 0}},
    {"12-bit encoder", {0, twelve_bits, 0, 0}},
    {"12-bit encoder, 5 % dropped", {0, twelve_bits, 0.05, 0}},
    {"12-bit encoder, 5 % dropped, 1 % outliers", {0, twelve_bits, 0.05, 0.01}},
};

// The table of docs/raw-logs.md. GP2_PRINT_TABLES=1 prints it.
TEST(SimulatedLogs, DerivativesAreNoWorseThanSavitzkyGolaysAndTheirDeviationsHoldTheTruth) {
  const Model& model = test::model("models/double_pendulum.toml");
  std::string table;
  for (const auto& [motion, starts] : {std::pair("slow", slow), std::pair("fast", fast)}) {
    for (const Case& one : cases) {
      const SimulatedLog log = simulated_log(model, starts, 2.6, one.faults, 1);
      const DerivedData data = derive(model, log.table);
      const Score inner = score_of(data, log, *model.system, 15), ends = score_of(data, log, *model.system, -15);
      const Score theirs = savitzky_golay_score(log, *model.system);
      int outliers = 0;
      for (const DerivedSeries& series : data.series) outliers += series.outliers;
      table += fmt::format("| {} | {} | {:.1e} / {:.1e} | {:.1e} / {:.1e} | {:.3g} / {:.3g} |", motion, one.name, inner.rms[0],
                           theirs.rms[0], inner.rms[1], theirs.rms[1], inner.rms[2], theirs.rms[2]);
      for (int d = 0; d < 3; ++d) table += fmt::format(" {:.1f} ({:.1f}) |", 100 * inner.coverage[d], 100 * ends.coverage[d]);
      table += fmt::format(" {} |\n", outliers);
      SCOPED_TRACE(fmt::format("{}, {}", motion, one.name));
      EXPECT_LE(inner.rms[2], theirs.rms[2]);
      for (int d = 0; d < 3; ++d) {
        EXPECT_GE(inner.coverage[d], 0.90) << d;
        EXPECT_LE(inner.coverage[d], 0.995) << d;
        EXPECT_GE(ends.coverage[d], 0.85) << d;
      }
    }
  }
  if (std::getenv("GP2_PRINT_TABLES") != nullptr) fmt::print("{}", table);
}

}  // namespace
}  // namespace gp2::test
