#include <cmath>
#include <map>
#include <regex>

#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "published/acceptance.hpp"

// Figure 3c as `gp2 reproduce` draws it, without the slow method that leaves the surface: how far trajectories stray from it.
namespace gp2::test {
namespace {

class Figure3c : public testing::Test {
 protected:
  void SetUp() override {
    if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
    std::filesystem::copy(std::filesystem::path(GP2_SOURCE_DIR) / "experiments", desk / "short",
                          std::filesystem::copy_options::recursive);
    definition = desk.read("short/fig3c.toml");
    definition = replaced(definition, "[[method]]\nname     = \"SE\"\nbaseline = \"se\"\nproject  = [false]\n\n", "");
  }

  /// Runs the experiment as `text` defines it. Without gnuplot there is no picture, but there are numbers.
  nlohmann::json run(const std::string& text) const {
    desk.write("short/fig3c.toml", text);
    const Outcome outcome =
        desk.run("gp2 reproduce fig3c --protocol default --experiments short --data '" + reference_dir().string() + "' -o out");
    if (!desk.has("out/fig3c_summary.json")) throw std::runtime_error(outcome.err);
    nlohmann::json of_method;
    for (const nlohmann::json& row : desk.json("out/fig3c_summary.json")) of_method[row["method"].get<std::string>()] = row;
    return of_method;
  }

  /// |c| and |dc/dt| at every written time.
  void expect_on_the_surface(int n_times) const {
    const nlohmann::json rows = desk.json("out/fig3c.json");
    ASSERT_EQ(rows.size(), static_cast<std::size_t>(n_times));
    for (const char* method : {"analytic_projected", "GP2_projected"}) {
      for (const char* error : {"_surface_error", "_velocity_error"}) {
        double largest = 0;
        for (const nlohmann::json& row : rows) largest = std::max(largest, row.at(std::string(method) + error).get<double>());
        EXPECT_LE(largest, 1e-12) << method << error;
        RecordProperty(std::string(method) + error, fmt::format("{:.2g}", largest));
      }
    }
  }

  Desk desk;
  std::string definition;
};

TEST_F(Figure3c, ProjectionHoldsTrajectoriesOnTheSurfaceAndWithoutItTheyStrayByLessThanTheTolerance) {
  const nlohmann::json of_method = run(definition);
  expect_on_the_surface(101);
  const double analytic = of_method["analytic"]["max_surface_error"], learned = of_method["GP2"]["max_surface_error"];
  RecordProperty("analytic", fmt::format("{:.3g}", analytic));
  RecordProperty("GP2", fmt::format("{:.3g}", learned));
  constexpr double tolerance = 1e-6;  // of the definition
  for (const double drift : {analytic, learned}) {
    EXPECT_GT(drift, 1e-12);
    EXPECT_LE(drift, tolerance);
  }
}

// How far a trajectory strays is a sum of steps of either sign, so the ratio of two of them scatters, from 0.4 to 5 at tolerances
// that differ by a third: in the mean over all of them it is about 1.
TEST_F(Figure3c, WithoutProjectionTheDriftIsThatOfTheIntegratorAtAnyTolerance) {
  struct Drift {
    double error = 0, steps = 0;
  };
  std::map<std::string, std::vector<Drift>> drifts;
  double sum_of_logs = 0;
  constexpr int n_tolerances = 6;
  for (int digits = 4; digits < 4 + n_tolerances; ++digits) {
    std::string text =
        std::regex_replace(definition, std::regex("relative_tolerance = .*"), fmt::format("relative_tolerance = 1e-{}", digits));
    text = std::regex_replace(text, std::regex("absolute_tolerance = .*"), fmt::format("absolute_tolerance = 1e-{}", digits + 2));
    text = std::regex_replace(text, std::regex("\\[false, true\\]"), "[false]");
    const nlohmann::json of_method = run(text);
    for (const char* method : {"analytic", "GP2"}) {
      drifts[method].push_back({of_method[method]["max_surface_error"], of_method[method]["steps"]});
    }
    const double ratio = drifts["GP2"].back().error / drifts["analytic"].back().error;
    RecordProperty(fmt::format("ratio_1e-{}", digits), fmt::format("{:.2f}", ratio));
    sum_of_logs += std::log(ratio);
  }
  EXPECT_LE(std::exp(sum_of_logs / n_tolerances), 2);
  // of fifth order in the length of a step
  for (const auto& [method, of] : drifts) {
    const double order = std::log(of.front().error / of.back().error) / std::log(of.back().steps / of.front().steps);
    RecordProperty(method + "_order", fmt::format("{:.1f}", order));
    EXPECT_GE(order, 4.5) << method;
  }
}

TEST_F(Figure3c, ProjectionHoldsTrajectoriesOnTheSurfaceForAHundredTimesAsLong) {
  std::string text =
      replaced(definition, "t_end  = 6.0606060606060606\nsteps  = 100\n", "t_end  = 606.06060606060606\nsteps  = 10000\n");
  for (int method = 0; method < 2; ++method) {  // the analytic one and GP²
    const std::size_t place = text.find("[false, true]");
    ASSERT_NE(place, std::string::npos);
    text.replace(place, 13, "[true]");
  }
  run(text);
  expect_on_the_surface(10001);
}

}  // namespace
}  // namespace gp2::test
