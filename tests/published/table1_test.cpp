#include <map>
#include <string>

#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "published/acceptance.hpp"

// The whole of Table 1 from one command, on the published runs.
namespace gp2::test {
namespace {

using Cells = std::map<std::string, nlohmann::json>;  // "system protocol method" -> cell

Cells reproduced(const Desk& desk) {
  static_cast<void>(
      desk.done("gp2 reproduce table1 --data '" + reference_file("table1.json").parent_path().string() + "' -o out"));
  Cells cells;
  for (const nlohmann::json& cell : desk.json("out/table1_cells.json")) {
    cells[fmt::format("{} {} {}", cell["system"].get<std::string>(), cell["protocol"].get<std::string>(),
                      cell["method"].get<std::string>())] = cell;
  }
  return cells;
}

TEST(Table1, HasHonestBaselinesAndIsWonByGp2OnEverySystem) {
  if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  const Desk desk;
  const Cells cells = reproduced(desk);
  for (const char* system : {"surface", "unicycle", "duffing"}) {
    for (const char* protocol : {"paper", "default"}) {
      const auto error = [&](const char* method) {
        return cells.at(fmt::format("{} {} {}", system, protocol, method)).at("rmse_mean").get<double>();
      };
      for (const char* baseline : {"SE", "ICM", "LMC"}) {
        SCOPED_TRACE(fmt::format("{} {} {}", system, protocol, baseline));
        const nlohmann::json& cell = cells.at(fmt::format("{} {} {}", system, protocol, baseline));
        EXPECT_LE(cell["rmse_mean"].get<double>(), 1.15 * cell["published_rmse_mean_same_runs"].get<double>());
        if (std::string(protocol) == "default") {
          EXPECT_LT(error("GP2_known_mean0"), error(baseline));
          EXPECT_LT(error("GP2_known_mean"), error(baseline));
        }
      }
      for (const char* method : {"GP2_known_mean0", "GP2_known_mean"}) {
        const nlohmann::json& cell = cells.at(fmt::format("{} {} {}", system, protocol, method));
        EXPECT_LE(cell["max_constraint_error"].get<double>(), published_system(system).constraint_error) << system << method;
      }
    }
  }
}

}  // namespace
}  // namespace gp2::test
