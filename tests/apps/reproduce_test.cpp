#include <algorithm>
#include <regex>
#include <set>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/robots/robot.hpp"
#include "test_models.hpp"

// gp2 reproduce on definitions that are cut down to seconds: what it writes, and what it says of what is wrong.
namespace gp2::test {
namespace {

using nlohmann::json;
using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::StartsWith;

/// A TOML text in which every line `key = …` has another value.
std::string with(const std::string& text, const std::string& key, const std::string& value) {
  const std::regex line("(^|\n)" + key + "( *)= [^\n]*");
  if (!std::regex_search(text, line)) throw std::runtime_error("no line '" + key + " = …' in the definition");
  return std::regex_replace(text, line, fmt::format("$1{}$2= {}", key, value));
}

/// A TOML text without those of its [[kind]] whose `name` does not satisfy `keep`.
std::string only(const std::string& text, const std::string& kind, const std::set<std::string>& names) {
  std::string out;
  std::size_t start = 0;
  while (start < text.size()) {
    std::size_t end = text.find("\n[", start);  // the table that starts next
    end = end == std::string::npos ? text.size() : end + 1;
    const std::string table = text.substr(start, end - start);
    std::smatch name;
    const bool is_kind = table.starts_with(fmt::format("[[{}]]", kind));
    const bool kept =
        !is_kind || (std::regex_search(table, name, std::regex("name *= *\"([^\"]*)\"")) && names.contains(name[1]));
    if (kept) out += table;
    start = end;
  }
  return out;
}

class Reproduce : public testing::Test {
 protected:
  void SetUp() override {
    std::filesystem::copy(std::filesystem::path(GP2_SOURCE_DIR) / "experiments", desk / "small",
                          std::filesystem::copy_options::recursive);
    shrink("table1.toml", [](std::string text) {
      text = with(with(with(only(text, "system", {"duffing"}), "runs", "1"), "n", "20"), "restarts", fewest_restarts);
      return with(text, "grid", "{ q1 = 2, dq1 = 3, t = 4 }");
    });
    shrink("learning_curve.toml", [](const std::string& text) {
      return with(with(with(with(text, "runs", "2"), "n", "[8, 12]"), "restarts", fewest_restarts), "train_at_most", "10");
    });
    for (const char* name : {"fig3a.toml", "fig3b.toml"}) {
      shrink(name, [](const std::string& text) {
        return with(with(with(text, "n", "20"), "points", "7"), "restarts", "{ paper = 1, default = 1 }");
      });
    }
    for (const char* name : {"fig3c.toml", "figS7.toml"}) {
      shrink(name, [](const std::string& text) {
        return with(with(with(with(text, "n", "20"), "steps", "10"), "t_end", "0.6"), "restarts", fewest_restarts);
      });
    }
  }

  template <typename Change>
  void shrink(const std::string& name, const Change& change) const {
    desk.write("small/" + name, change(desk.read("small/" + name)));
  }

  [[nodiscard]] bool has_gnuplot() const { return desk.run("command -v gnuplot").status == 0; }

  /// Runs an experiment into out/, where there is no picture without gnuplot.
  Outcome reproduce(const std::string& line, const std::string& output = "out") const {
    Outcome outcome = desk.run("gp2 reproduce " + line + " --experiments small -o " + output);
    const bool no_picture = outcome.status == 2 && outcome.said("gnuplot-nox") && !has_gnuplot();
    if (outcome.status != 0 && !no_picture) throw std::runtime_error(line + ": " + outcome.err);
    return outcome;
  }
  [[nodiscard]] std::string refusal(const std::string& line) const {
    const Outcome outcome = desk.run("gp2 reproduce " + line);
    EXPECT_EQ(outcome.status, 2) << line << outcome.err;
    return outcome.err;
  }

  /// out/NAME.json, which says the same as out/NAME.csv.
  [[nodiscard]] json table(const std::string& name, const std::string& folder = "out/") const {
    json rows = desk.json(folder + name + ".json");
    const CsvTable csv = desk.table(folder + name + ".csv");
    EXPECT_TRUE(rows.is_array());
    EXPECT_EQ(static_cast<std::size_t>(csv.n_rows()), rows.size());
    for (std::size_t i = 0; i < rows.size(); ++i) {
      EXPECT_EQ(rows[i].size(), csv.header().size());
      for (const auto& [key, value] : rows[i].items()) {
        const int row = static_cast<int>(i), column = csv.find(key);
        if (column < 0) {
          ADD_FAILURE() << name << ".csv has no column " << key;
        } else if (value.is_number()) {
          EXPECT_EQ(csv.number(row, column), value.get<double>()) << name << " " << key;
        } else {
          const std::string text = value.is_string() ? value.get<std::string>() : value.is_null() ? "" : value.dump();
          EXPECT_EQ(csv.cell(row, column), text) << name << " " << key;
        }
      }
    }
    return rows;
  }
  static std::vector<std::string> columns(const json& rows) {
    std::vector<std::string> names;
    for (const auto& [key, value] : rows.at(0).items()) names.push_back(key);  // in alphabetical order
    return names;
  }

  /// Skips what follows where no picture can be drawn.
  void expect_pictures(const std::vector<std::string>& names) const {
    if (!has_gnuplot()) GTEST_SKIP() << "gnuplot is not installed";
    for (const std::string& name : names) {
      const std::string png = desk.read("out/" + name + ".png"), svg = desk.read("out/" + name + ".svg");
      EXPECT_THAT(png, StartsWith("\x89PNG\r\n\x1a\n"));
      EXPECT_GT(png.size(), 5000U) << name;
      EXPECT_THAT(svg, AllOf(StartsWith("<?xml"), HasSubstr("<svg"), HasSubstr("</svg>"))) << name;
      EXPECT_GT(std::count(svg.begin(), svg.end(), '\n'), 50) << name;
    }
  }

  static constexpr const char* fewest_restarts = "{ paper = 1, default = 1, baseline = 1 }";
  const std::vector<std::string> methods = {"analytic",      "SE",          "ICM", "LMC", "GP2_known_mean0", "GP2_known_mean",
                                            "GP2_est_mean0", "GP2_est_mean"};
  Desk desk;
};

json without_seconds(json rows) {
  for (json& row : rows) row.erase("seconds");
  return rows;
}

// ---- table 1

TEST_F(Reproduce, Table1ListsEveryMethodUnderBothProtocols) {
  reproduce("table1");
  const json rows = table("table1");
  EXPECT_THAT(columns(rows),
              ElementsAre("max_constraint_error", "method", "nll", "protocol", "rmse_normalised", "run", "seconds", "system"));
  std::map<std::pair<std::string, std::string>, json> cells;
  for (const json& row : rows) {
    EXPECT_EQ(row["system"], "duffing");
    EXPECT_EQ(row["run"], 0);
    EXPECT_TRUE(cells.emplace(std::pair(row["protocol"].get<std::string>(), row["method"].get<std::string>()), row).second);
    EXPECT_TRUE(row["seconds"].is_number());
    if (row["method"] == "analytic") {
      EXPECT_TRUE(row["rmse_normalised"].is_null());
      EXPECT_TRUE(row["nll"].is_null());
    } else {
      EXPECT_GT(row["rmse_normalised"], 0);
      EXPECT_TRUE(row["nll"].is_number());
    }
  }
  EXPECT_EQ(cells.size(), 2 * methods.size());
  for (const std::string& method : methods) {
    SCOPED_TRACE(method);
    ASSERT_TRUE(cells.contains({"paper", method}) && cells.contains({"default", method}));
    json paper = cells[{"paper", method}], standard = cells[{"default", method}];
    paper.erase("protocol");
    standard.erase("protocol");
    // trained once: even the seconds are the same
    const bool knows_no_protocol = !method.starts_with("GP2");
    EXPECT_EQ(paper == standard, knows_no_protocol);
    // known parameters leave rounding, the others do not
    const bool exact = method == "analytic" || method.starts_with("GP2_known");
    EXPECT_EQ(standard["max_constraint_error"] < 1e-12, exact) << standard["max_constraint_error"];
  }

  const json summary = table("table1_cells");
  ASSERT_EQ(summary.size(), 2 * methods.size());
  for (std::size_t k = 0; k < summary.size(); ++k) {
    const json& row = summary[k];
    EXPECT_EQ(row["method"], methods[k % methods.size()]);
    EXPECT_EQ(row["protocol"], k < methods.size() ? "paper" : "default");
    EXPECT_EQ(row["runs"], 1);
    const std::pair<std::string, std::string> cell = {row["protocol"], row["method"]};
    EXPECT_EQ(row["rmse_mean"], cells[cell]["rmse_normalised"]);
    EXPECT_TRUE(row["published_rmse_mean_same_runs"].is_null()) << "no published data were given";
    EXPECT_EQ(row["printed_rmse_mean"].is_null(), row["method"] == "analytic");
    EXPECT_TRUE(row["printed_max_constraint_error"].is_number());
  }
  expect_pictures({"table1"});
}

TEST_F(Reproduce, Table1ScoresAMethodAsTheLibraryDoes) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"GP2_known_mean"}); });
  reproduce("table1 --protocol default");
  const json rows = table("table1");
  ASSERT_EQ(rows.size(), 1U);
  // by other commands: data of run 0 are those of seed 1
  desk.done("gp2 generate experiments/duffing_published.toml --n 20 --seed 1 -o train.csv");
  desk.done("gp2 generate experiments/duffing_published.toml --grid q1=2,dq1=3,t=4 --noise-std 0 -o grid.csv");
  const json fit = desk.done(
                           "gp2 fit experiments/duffing_published.toml --data train.csv --mean force --estimate none "
                           "--restarts 1 --json -o fit.json")
                       .json();
  const json evaluation = desk.done("gp2 evaluate fit.json --data grid.csv --json").json();
  // the experiment may stop the optimiser earlier
  EXPECT_NEAR(rows[0]["nll"].get<double>(), fit["nll"].get<double>(), 1e-3);
  const double error = evaluation["rmse_normalised"];
  EXPECT_NEAR(rows[0]["rmse_normalised"].get<double>(), error, 0.02 * error);
}

TEST_F(Reproduce, Table1OfOneProtocolHoldsThatOneOnly) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"analytic", "GP2_known_mean0"}); });
  for (const std::string protocol : {"paper", "default"}) {
    reproduce("table1 --protocol " + protocol, protocol);
    const json rows = table("table1", protocol + "/");
    ASSERT_EQ(rows.size(), 2U);
    for (const json& row : rows) EXPECT_EQ(row["protocol"], protocol);
    EXPECT_EQ(table("table1_cells", protocol + "/").size(), 2U);
  }
}

TEST_F(Reproduce, TheSameSeedGivesTheSameNumbersForAnyNumberOfThreads) {
  shrink("table1.toml", [](const std::string& text) {
    return with(only(text, "method", {"SE", "LMC", "GP2_known_mean0", "GP2_est_mean"}), "restarts",
                "{ paper = 2, default = 2, baseline = 2 }");
  });
  reproduce("table1 --threads 1", "one");
  reproduce("table1 --threads 2", "two");
  const json one = table("table1", "one/"), two = table("table1", "two/");
  EXPECT_EQ(one.size(), 8U);
  EXPECT_EQ(without_seconds(one), without_seconds(two));
  EXPECT_EQ(without_seconds(table("table1_cells", "one/")), without_seconds(table("table1_cells", "two/")));
}

TEST_F(Reproduce, RunsAreDrawnAnew) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"GP2_known_mean0"}); });
  reproduce("table1 --protocol default --runs 3");
  const json rows = table("table1"), cells = table("table1_cells");
  ASSERT_EQ(rows.size(), 3U);
  std::set<double> errors;
  for (int run = 0; run < 3; ++run) {
    const json& row = rows[static_cast<std::size_t>(run)];
    EXPECT_EQ(row["run"], run);
    errors.insert(row["rmse_normalised"].get<double>());
  }
  EXPECT_EQ(errors.size(), 3U);
  EXPECT_EQ(cells[0]["runs"], 3);
  EXPECT_EQ(cells[0]["rmse_min"], *errors.begin());
  EXPECT_EQ(cells[0]["rmse_max"], *errors.rbegin());
  double sum = 0;
  for (const double error : errors) sum += error;
  EXPECT_NEAR(cells[0]["rmse_mean"].get<double>(), sum / 3, 8 * eps * sum);
}

TEST_F(Reproduce, PublishedObservationsAndResultsAreTakenFromTheirFolder) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"analytic", "GP2_known_mean0"}); });
  std::filesystem::create_directories(desk / "data/train");
  for (const std::string run : {"0", "1"}) {
    desk.done("gp2 generate experiments/duffing_published.toml --n 15 --seed 5" + run + " -o data/train/duffing_run" + run +
              ".csv");
  }
  desk.write("data/table1.json", R"({"duffing": {"GP2_known_mean0": {"recomputed_at_published_hyperparameters":
      {"rmse_per_run": [0.25, 0.75, 7]}}}})");
  reproduce("table1 --protocol default --data data");  // one run is defined
  EXPECT_EQ(table("table1").size(), 2U);
  EXPECT_EQ(table("table1_cells")[1]["published_rmse_mean_same_runs"], 0.25);
  reproduce("table1 --protocol default --data data --runs 2");
  EXPECT_EQ(table("table1").size(), 4U);
  EXPECT_EQ(table("table1_cells")[1]["published_rmse_mean_same_runs"], 0.5);
  EXPECT_TRUE(table("table1_cells")[0]["published_rmse_mean_same_runs"].is_null());
  const json published = table("table1");
  reproduce("table1 --protocol default --runs 2");
  EXPECT_NE(published[1]["rmse_normalised"], table("table1")[1]["rmse_normalised"]) << "not those data";

  EXPECT_THAT(refusal("table1 --experiments small --data data --runs 3 -o no"),
              HasSubstr("--runs 3: data holds only 2 runs of train/duffing_run{}.csv"));
  std::filesystem::create_directory(desk / "empty");
  EXPECT_THAT(refusal("table1 --experiments small --data empty -o no"),
              HasSubstr("--data: there is no empty/train/duffing_run0.csv: expected the folder of the published observations"));
  desk.write("data/table1.json", "{");
  EXPECT_THAT(refusal("table1 --experiments small --data data -o no"), HasSubstr("data/table1.json: not valid JSON"));
  EXPECT_FALSE(desk.has("no/table1.json"));
}

TEST_F(Reproduce, ANoteStandsBesideItsCell) {
  const std::string note = R"(of 20 points, "not 100")";
  shrink("table1.toml", [&](const std::string& text) {
    const std::string without_notes = std::regex_replace(text, std::regex(R"(\[note\.duffing\][^\[]*)"), "");
    return only(without_notes, "method", {"analytic", "GP2_known_mean0"}) + "\n[note.duffing]\nGP2_known_mean0 = '" + note +
           "'\n";
  });
  reproduce("table1 --protocol default");
  const json cells = table("table1_cells");
  EXPECT_EQ(cells[0]["note"], "");
  EXPECT_EQ(cells[1]["note"], note);
}

// ---- figures

TEST_F(Reproduce, QuietWritesTheSameAndSaysNothing) {
  const Outcome loud = reproduce("fig3a");
  EXPECT_TRUE(loud.said("fig3a is done")) << loud.err;
  const json rows = table("fig3a_same_surface");
  const Outcome quiet = reproduce("fig3a -q");
  EXPECT_FALSE(quiet.said("fig3a is done")) << quiet.err;
  EXPECT_EQ(table("fig3a_same_surface"), rows);
}

TEST_F(Reproduce, Figure3aPredictsAlongALineOnBothSurfaces) {
  reproduce("fig3a");
  for (const char* name : {"fig3a_same_surface", "fig3a_other_surface"}) {
    const json rows = table(name);
    ASSERT_EQ(rows.size(), 7U) << name;
    EXPECT_THAT(columns(rows), ElementsAre("ddq1", "ddq1_std", "ddq1_truth", "ddq2", "ddq2_std", "ddq2_truth", "ddq3", "ddq3_std",
                                           "ddq3_truth", "q1"));
    EXPECT_EQ(rows.front()["q1"], -6);
    EXPECT_EQ(rows.back()["q1"], 6);
  }
  EXPECT_NE(table("fig3a_same_surface")[2]["ddq1"], table("fig3a_other_surface")[2]["ddq1"]);
  expect_pictures({"fig3a"});
}

TEST_F(Reproduce, Figure3bDrawsSamplesAndInfersTheUnconstrainedAcceleration) {
  const Outcome outcome = reproduce("fig3b");
  EXPECT_TRUE(outcome.said("fig3b: largest |A ddq − b| of 16 samples: ")) << outcome.err;
  const json samples = table("fig3b_samples");
  ASSERT_EQ(samples.size(), 7U);
  for (const char* column : {"q3", "ddq1", "ddq1_std", "ddq1_truth", "prior_sample1", "prior_sample8", "posterior_sample8"}) {
    EXPECT_TRUE(samples[0].contains(column)) << column;
  }
  const json surface = table("fig3b_abar_surface"), unicycle = table("fig3b_abar_unicycle");
  ASSERT_EQ(surface.size(), 7U);
  for (const json& row : surface) EXPECT_NEAR(row["abar_q3_truth"].get<double>(), -9.81, 1e-12);
  EXPECT_NEAR(unicycle.back()["abar_q1_truth"].get<double>(), -0.5, 1e-12);
  EXPECT_EQ(unicycle.back()["dq1"], 1);
  expect_pictures({"fig3b"});
}

TEST_F(Reproduce, Figure3cFollowsTrajectoriesAndTheirDistanceFromTheSurface) {
  reproduce("fig3c");
  const json rows = table("fig3c"), summary = table("fig3c_summary");
  ASSERT_EQ(rows.size(), 11U);
  EXPECT_EQ(rows.back()["t"], 0.6);
  std::vector<std::string> names;
  for (const json& row : summary) names.push_back(row["method"]);
  EXPECT_THAT(names, ElementsAre("analytic", "analytic_projected", "SE", "GP2", "GP2_projected"));
  for (const json& row : summary) {
    const std::string method = row["method"];
    double largest = 0;
    for (const json& at : rows) largest = std::max(largest, at.at(method + "_surface_error").get<double>());
    EXPECT_EQ(row["max_surface_error"], largest);
    EXPECT_EQ(method.ends_with("_projected") ? largest < 1e-12 : largest < 1, true) << method << " " << largest;
    EXPECT_EQ(rows[0][method + "_q1"], 0.4);
  }
  // only a method that ignores the surface leaves it
  EXPECT_GT(summary[2]["max_surface_error"], 100 * summary[3]["max_surface_error"].get<double>());
  expect_pictures({"fig3c"});
}

TEST_F(Reproduce, Figure3cStandsBesideThePublishedErrors) {
  desk.done("gp2 generate experiments/surface_published.toml --n 20 -o log.csv");
  std::filesystem::create_directories(desk / "data/train_optim2");
  std::filesystem::rename(desk / "log.csv", desk / "data/train_optim2/surface_n200.csv");
  json published;
  for (int step = 1; step <= 10; ++step) published["published"]["ode_predictions"]["GP2"]["surface_error"].push_back(0.1 * step);
  desk.write("data/fig_c.json", published.dump());
  reproduce("fig3c --data data");
  const json rows = table("fig3c");
  EXPECT_TRUE(rows[0]["published_GP2_surface_error"].is_null());
  EXPECT_EQ(rows[10]["published_GP2_surface_error"], 1.0);
  EXPECT_FALSE(rows[0].contains("published_SE_surface_error"));
}

TEST_F(Reproduce, FigureS7MeasuresAgainstTheTrueAndTheFittedSurface) {
  reproduce("figS7");
  const json rows = table("figS7"), summary = table("figS7_summary");
  ASSERT_EQ(rows.size(), 11U);
  ASSERT_EQ(summary.size(), 3U);
  const json& projected = summary[2];
  EXPECT_EQ(projected["method"], "GP2_est_projected");
  EXPECT_LT(projected["max_fitted_surface_error"], 1e-12);
  EXPECT_GT(projected["max_surface_error"], 1e-6) << "the fitted surface is not the true one";
  EXPECT_TRUE(rows[0].contains("GP2_est_projected_fitted_surface_error"));
  EXPECT_FALSE(rows[0].contains("analytic_fitted_surface_error"));
  expect_pictures({"figS7"});
}

TEST_F(Reproduce, TheLearningCurveTakesTheFirstRowsOfOneDataSetPerRun) {
  const Outcome outcome = reproduce("learning-curve");
  const json rows = table("learning_curve_runs"), summary = table("learning_curve");
  ASSERT_EQ(rows.size(), 3U * 2U * 2U * 4U);  // systems, runs, numbers of observations, methods
  ASSERT_EQ(summary.size(), 3U * 2U * 4U);
  for (const json& row : summary) {
    std::vector<double> errors;
    for (const json& run : rows) {
      const bool same = run["system"] == row["system"] && run["method"] == row["method"] && run["n"] == row["n"];
      if (same) errors.push_back(run["rmse_normalised"]);
    }
    ASSERT_EQ(errors.size(), 2U);
    std::sort(errors.begin(), errors.end());
    EXPECT_EQ(row["rmse_min"], errors[0]);
    EXPECT_EQ(row["rmse_max"], errors[1]);
    EXPECT_NEAR(row["rmse_median"].get<double>(), (errors[0] + errors[1]) / 2, 4 * eps * errors[1]);
    EXPECT_NEAR(row["rmse_quartile1"].get<double>(), 0.75 * errors[0] + 0.25 * errors[1], 4 * eps * errors[1]);
  }
  EXPECT_FALSE(outcome.said("published"));
  expect_pictures({"learning_curve"});
}

TEST_F(Reproduce, TheLearningCurveSaysThatItTakesNoPublishedData) {
  shrink("learning_curve.toml",
         [](const std::string& text) { return with(with(only(text, "method", {"GP2_known_mean0"}), "runs", "1"), "n", "[8]"); });
  std::filesystem::create_directory(desk / "data");
  EXPECT_TRUE(reproduce("learning-curve --data data").said("learning-curve: the published observations are 100 per run"));
}

// ---- the arm of Rath, Geist & Trimpe

/// The definition of an arm's experiment, cut down to a motion of seconds.
std::string small_arm(const std::string& text) {
  const auto replaced_all = [](const std::string& in, const char* what, const char* by) {
    return std::regex_replace(in, std::regex(what), by);
  };
  std::string small = replaced_all(text, "samples = 54000|samples = 14400", "samples = 1500");
  small = replaced_all(replaced_all(small, "leave   = 1000", "leave   = 100"), "max_iterations += [0-9]+", "max_iterations = 15");
  small = replaced_all(replaced_all(small, "starts  = [^\n]*", "starts  = [600]"), "samples = 3000", "samples = 300");
  return replaced_all(replaced_all(small, "= \\[(10, 6, 4, 3, 2|3, 2, 1, 1, 1)\\]", "= [1]"), "= \\[5, 1, 0, 0, 0\\]", "= [0]");
}

TEST_F(Reproduce, TheArmOnASurfaceObeysItsConstraintWhereAMethodKnowsIt) {
  if (!can_read_robots()) GTEST_SKIP() << "this build reads no robots";
  shrink("arm_on_surface.toml",
         [](const std::string& text) { return small_arm(replaced(text, "[100, 200, 400, 600, 1000]", "[20, 40]")); });
  reproduce("arm-on-surface");
  const json rows = table("arm_on_surface");
  ASSERT_EQ(rows.size(), 10U);
  for (const json& row : rows) {
    SCOPED_TRACE(row.dump());
    const bool knows_mechanics = !row["method"].get<std::string>().starts_with("GP ") && row["method"] != "GP";
    EXPECT_EQ(row["max_constraint_error"] < 1e-12, knows_mechanics);
    EXPECT_GT(row["mae_blocks"], 0.07) << "targets have noise of 0.1, 0.08 of mean size";
    EXPECT_NEAR(row["mae_blocks"].get<double>(), row["truth_mae_blocks"].get<double>(), 0.08);
    EXPECT_EQ(row["published_mae"].is_null(), row["method"] == "GP wide");
    EXPECT_GT(row["ratio_independent"], 0);
  }
  // the plain one is what the others are measured by
  EXPECT_EQ(rows[0]["ratio_blocks"], 1);
  EXPECT_EQ(rows[5]["ratio_independent"], 1);
  expect_pictures({"arm_on_surface"});
}

TEST_F(Reproduce, TheMassOfTheArmsLastLinkHasAnEstimateAndAStandardError) {
  if (!can_read_robots()) GTEST_SKIP() << "this build reads no robots";
  shrink("arm_mass.toml", [](const std::string& text) { return small_arm(replaced(text, "n     = 600", "n     = 30")); });
  reproduce("arm-mass");
  const json rows = table("arm_mass");
  ASSERT_EQ(rows.size(), 4U);
  EXPECT_EQ(rows[3]["parameter"], "m7");
  EXPECT_EQ(rows[3]["start"], 2.5);
  for (const json& row : rows) {
    EXPECT_NEAR(row["error"].get<double>(), row["estimate"].get<double>() - row["truth"].get<double>(), 1e-15);
    EXPECT_TRUE(row["stddev"].is_null() || row["stddev"] >= 0) << row;
  }
  EXPECT_EQ(table("arm_mass_correlation")[1]["c7y"], 1);
}

// ---- without gnuplot

TEST_F(Reproduce, WithoutGnuplotTheNumbersAreWrittenAndTheMendIsSaid) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"analytic"}); });
  std::filesystem::create_directory(desk / "nothing");
  const Outcome outcome = desk.run(
      "command=$(command -v gp2); PATH=$PWD/nothing; \"$command\" reproduce table1 --protocol default --experiments small -o "
      "out");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_EQ(outcome.err,
            "gp2: error: out: the numbers are written, but there is no gnuplot to draw the picture: install the Debian package "
            "gnuplot-nox\n");
  EXPECT_EQ(table("table1").size(), 1U);
  EXPECT_EQ(table("table1_cells").size(), 1U);
  EXPECT_FALSE(desk.has("out/table1.svg"));
}

TEST_F(Reproduce, EverythingRunsToItsEndWithoutGnuplot) {
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"analytic"}); });
  shrink("learning_curve.toml", [](const std::string& text) { return only(text, "method", {"GP2_known_mean0"}); });
  std::filesystem::create_directory(desk / "nothing");
  const Outcome outcome = desk.run(
      "command=$(command -v gp2); PATH=$PWD/nothing; \"$command\" reproduce all --protocol default --experiments small -o out");
  EXPECT_EQ(outcome.status, 2);
  const std::size_t said = outcome.err.find("there is no gnuplot");
  EXPECT_NE(said, std::string::npos) << outcome.err;
  EXPECT_EQ(outcome.err.find("there is no gnuplot", said + 1), std::string::npos) << "once is enough";
  for (const char* name :
       {"table1", "table1_cells", "fig3a_same_surface", "fig3a_other_surface", "fig3b_samples", "fig3b_abar_surface",
        "fig3b_abar_unicycle", "fig3c", "fig3c_summary", "figS7", "figS7_summary", "learning_curve", "learning_curve_runs"}) {
    EXPECT_FALSE(table(name).empty()) << name;
  }
}

TEST_F(Reproduce, AScriptThatGnuplotRefusesIsNamed) {
  if (!has_gnuplot()) GTEST_SKIP() << "gnuplot is not installed";
  shrink("table1.toml", [](const std::string& text) { return only(text, "method", {"analytic"}); });
  desk.write("small/table1.gp", "plot nonsense(\n");
  EXPECT_THAT(refusal("table1 --experiments small -o out"),
              HasSubstr("small/table1.gp: gnuplot failed (exit code 1); its message is above"));
  EXPECT_EQ(table("table1").size(), 2U);
}

// ---- what is refused

TEST_F(Reproduce, WhatIsAskedForMustExist) {
  EXPECT_THAT(refusal("fig9 -o out"), AllOf(HasSubstr("fig9"), HasSubstr("learning-curve")));
  EXPECT_THAT(refusal("table1 --protocol best -o out"), AllOf(HasSubstr("--protocol"), HasSubstr("best")));
  EXPECT_THAT(refusal("table1 --data nowhere -o out"), HasSubstr("--data: there is no folder 'nowhere'"));
  EXPECT_THAT(refusal("table1 --experiments nowhere -o out"), HasSubstr("--experiments: there is no folder 'nowhere'"));
  EXPECT_THAT(refusal("table1 --experiments small --runs 0 -o out"), HasSubstr("--runs: must be positive, got 0"));
  EXPECT_THAT(refusal("table1 --threads -1 -o out"),
              HasSubstr("--threads: must be positive, or 0 for as many as the machine has; got -1"));
  EXPECT_THAT(refusal("table1"), HasSubstr("--output"));
  desk.write("file", "");
  EXPECT_THAT(refusal("table1 --experiments small -o file"), HasSubstr("-o file: the folder cannot be made: "));
  std::filesystem::remove(desk / "small/fig3a.toml");
  EXPECT_THAT(refusal("fig3a --experiments small -o out"), HasSubstr("small/fig3a.toml: cannot be read: No such file"));
  EXPECT_FALSE(desk.has("out/table1.json"));
}

TEST_F(Reproduce, ABrokenDefinitionIsNamedWithItsKeyBeforeAnyFit) {
  const std::string whole = desk.read("small/table1.toml");
  const auto refused = [&](const std::string& definition) {
    desk.write("small/table1.toml", definition);
    const std::string text = refusal("table1 --experiments small -o out");
    EXPECT_FALSE(desk.has("out/table1.json"));
    const std::string prefix = "gp2: error: small/table1.toml";
    EXPECT_THAT(text, StartsWith(prefix));
    return std::regex_replace(text.substr(std::min(prefix.size(), text.size())), std::regex("^:[0-9]+"), ":LINE");
  };
  const auto without = [&](const std::string& key) {
    return std::regex_replace(whole, std::regex("(^|\n)" + key + " *= [^\n]*"), "$1");
  };
  EXPECT_EQ(refused(without("runs")), ":LINE: runs: is missing\n");
  EXPECT_EQ(refused(with(whole, "runs", "\"ten\"")), ":LINE: runs: expected a finite number, got 'ten'\n");
  EXPECT_EQ(refused(without("n")), ":LINE: n: is missing\n");
  EXPECT_EQ(refused(without("restarts")), ":LINE: restarts: is missing\n");
  EXPECT_EQ(refused(with(whole, "restarts", "{ paper = 1, default = 1 }")), ":LINE: restarts.baseline: is missing\n");
  EXPECT_EQ(refused(without("model")), ":LINE: system.model: is missing\n");
  EXPECT_EQ(refused(without("data")), ":LINE: system.data: is missing\n");
  EXPECT_EQ(refused(without("grid")), ":LINE: system.grid: is missing\n");
  EXPECT_EQ(refused(with(whole, "grid", "{ q1 = 2.5, dq1 = 3, t = 4 }")),
            ":LINE: system.grid.q1: expected a whole number, got 2.5\n");
  EXPECT_EQ(refused(without("parameters")), ":LINE: system.parameters: is missing\n");
  EXPECT_EQ(refused(with(whole, "parameters", "{ zero = [\"A0\"] }")), ":LINE: system.parameters.force: is missing\n");
  EXPECT_EQ(refused(only(whole, "system", {})), ":LINE: system: is missing\n");
  EXPECT_EQ(refused(only(whole, "method", {})), ":LINE: method: is missing\n");
  EXPECT_EQ(refused(with(whole, "truth", "\"yes\"")), ":LINE: method.truth: expected true or false, got 'yes'\n");
  EXPECT_EQ(refused(with(whole, "mean", "\"none\"")), ":LINE: method.mean: must be zero or force, got 'none'\n");
  EXPECT_THAT(refused("n = \n" + whole), StartsWith(":LINE: "));
}

TEST_F(Reproduce, APrintedValueThatIsNoneIsNamedWhenTheRunsAreWritten) {
  shrink("table1.toml", [](const std::string& text) {
    return replaced(only(text, "method", {"GP2_known_mean0"}), "rmse = [0.007, 0.001, 0.019]", "rmse = [0.007]");
  });
  EXPECT_THAT(refusal("table1 --experiments small --protocol default -o out"),
              HasSubstr(": printed.duffing.GP2_known_mean0.rmse: must be a list of 3 numbers, got 1"));
  EXPECT_EQ(table("table1").size(), 1U);
}

TEST_F(Reproduce, DefinitionsThatPointNowhereAreNamed) {
  const std::string whole = desk.read("small/table1.toml");
  const auto refused = [&](const std::string& definition) {
    desk.write("small/table1.toml", definition);
    return refusal("table1 --experiments small -o out");
  };
  EXPECT_THAT(refused(with(whole, "model", "\"other.toml\"")), HasSubstr("small/other.toml: cannot be read"));
  EXPECT_THAT(refused(with(whole, "baseline", "\"sv\"")),
              HasSubstr("method SE: there is no baseline 'sv'; there are: se, icm, lmc"));
  EXPECT_THAT(refused(with(whole, "grid", "{ q1 = 2, dq1 = 3 }")), HasSubstr("grid: no number of points for 't'"));
  // a pattern of one file would be found for every run
  desk.write("small/table1.toml", with(whole, "data", "\"train.csv\""));
  desk.write("train.csv", "");
  EXPECT_THAT(refusal("table1 --experiments small --data . -o out"),
              HasSubstr("'train.csv', of published observations, must hold {} for the number of the run"));

  desk.write("small/fig3a.toml", with(desk.read("small/fig3a.toml"), "q1", "[-6.0]"));
  EXPECT_THAT(refusal("fig3a --experiments small -o out"), HasSubstr(": line.q1: must be a list of 2 numbers, got 1"));
}

}  // namespace
}  // namespace gp2::test
