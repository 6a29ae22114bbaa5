#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

// Logs with empty cells, outliers, and states off the constraint.
namespace gp2::test {
namespace {

using testing::AllOf;
using testing::HasSubstr;
using testing::Not;

// the log of `desk` with one cell written anew, row from 0
void spoil(const Desk& desk, const std::string& file, int row, const std::string& column, const std::string& text) {
  const CsvTable table = desk.table(file);
  std::vector<std::string> cells;
  for (int i = 0; i < table.n_rows(); ++i) {
    for (const std::string& name : table.header()) {
      cells.push_back(i == row && name == column ? text : table.cell(i, table.find(name)));
    }
  }
  desk.write(file, CsvTable::from_cells(file, table.header(), cells).text());
}

TEST(ImperfectData, EveryCommandCopesWithEmptyCells) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 30 --noise-std 0.1 -o log.csv");
  spoil(desk, "log.csv", 3, "ddq2", "");
  const Outcome check = desk.done("gp2 check models/surface.toml --data log.csv");
  EXPECT_THAT(check.out, HasSubstr("ok       1 of 30 values of ddq2 are not measured: their cells are empty"));
  EXPECT_THAT(check.out, HasSubstr("measured ddq on A ddq = b"));
  const Outcome fit = desk.done("gp2 fit models/surface.toml --data log.csv --max-iterations 3 --restarts 1 -o fit.json");
  EXPECT_TRUE(fit.said("log.csv: values not measured (empty cells): 1 of 30 of ddq2"));
  EXPECT_EQ(desk.done("gp2 evaluate fit.json --data log.csv --json").json()["n_missing"], 1);
  EXPECT_THAT(desk.done("gp2 evaluate fit.json --data log.csv").out, HasSubstr("(1 values not measured or left out)"));
  desk.done("gp2 report fit.json --data log.csv -o report.html");
  desk.done("gp2 resample log.csv --model models/surface.toml -n 30 -o all.csv");
  desk.done("gp2 fit models/surface.toml --data all.csv --max-iterations 0 -o again.json");
}

TEST(ImperfectData, EvaluateSaysWhichFiguresAreNotDefinedAndWhichMeanNothing) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 30 -o log.csv");
  desk.done("gp2 fit models/surface.toml --data log.csv --max-iterations 0 -o fit.json");
  const std::string log = desk.read("log.csv");
  desk.write("row.csv", log.substr(0, log.find('\n', log.find('\n') + 1) + 1));
  const std::string one_row = desk.done("gp2 evaluate fit.json --data row.csv").out;
  EXPECT_THAT(one_row, HasSubstr("nrmse                       not defined"));
  EXPECT_THAT(one_row, AllOf(Not(HasSubstr("nan")), Not(HasSubstr("inf "))));
  EXPECT_THAT(one_row, HasSubstr("(right only for targets without noise)"));
  desk.write("wrong.toml", replaced(desk.read("models/surface.toml"), "u3 - m*g", "u3 + 9*m*g"));
  desk.done("gp2 fit wrong.toml --data log.csv --max-iterations 0 --mean force --max-points 2 -o wrong.json");
  desk.done("gp2 generate models/surface.toml --n 30 --seed 9 -o test.csv");
  EXPECT_THAT(desk.done("gp2 evaluate wrong.json --data test.csv").out, HasSubstr("; above 1 their mean predicts better)"));
}

TEST(ImperfectData, StatesAreOnTheConstraintOrOffItByTheFittedParameters) {
  const Desk desk;
  const std::string surface = desk.read("models/surface.toml");
  desk.write("start.toml",
             replaced(surface, "p1 = { value = 0.08, bounds = [0.04, 0.16] }", "p1 = { value = 0.1, bounds = [0.04, 0.16] }"));
  desk.done("gp2 generate models/surface.toml --n 30 --noise-std 0.01 -o log.csv");
  desk.done("gp2 generate models/surface.toml --n 30 --seed 9 -o test.csv");
  const std::string fit = "gp2 fit start.toml --data log.csv --mean force --restarts 1 --hyperparameters optimise -o fit.json";
  desk.done(fit + " --estimate p1");
  EXPECT_THAT(desk.done("gp2 evaluate fit.json --data test.csv").err, Not(HasSubstr("warning: test.csv: states are off")));
  EXPECT_THAT(desk.done("gp2 predict fit.json --states test.csv -o out.csv").err,
              Not(HasSubstr("warning: test.csv: states are off")));
  desk.done(fit + " --max-iterations 0");
  EXPECT_THAT(desk.done("gp2 evaluate fit.json --data test.csv").err, HasSubstr("warning: test.csv: states are off"));
}

TEST(ImperfectData, ARobustFitNamesTheLinesItDistrusts) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 --noise-std 0.1 -o log.csv");
  spoil(desk, "log.csv", 8, "ddq3", "-70");
  const Outcome fit = desk.done("gp2 fit models/surface.toml --data log.csv --robust --restarts 1 --json -o fit.json");
  EXPECT_THAT(fit.err, HasSubstr("robust: 1 of 180 values distrusted: ddq3 in line 10 ("));
  ASSERT_EQ(fit.json()["distrusted"].size(), 1U);
  EXPECT_EQ(fit.json()["distrusted"][0]["line"], 10);
  EXPECT_EQ(fit.json()["distrusted"][0]["value"], "ddq3");
  EXPECT_EQ(fit.json()["distrusted"][0]["log"], 1);
  EXPECT_GT(fit.json()["distrusted"][0]["distance"], 4);
  EXPECT_EQ(desk.json("fit.json")["observations"][0]["noise_scale"]["ddq3"][8], fit.json()["distrusted"][0]["noise_factor"]);
}

TEST(ImperfectData, StatesOffTheConstraintAreMeasuredByCheckAndMovedByProject) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 30 --noise-std 0.1 -o log.csv");
  const CsvTable table = desk.table("log.csv");
  const double q3 = table.number(4, table.find("q3"));
  spoil(desk, "log.csv", 4, "q3", shortest(q3 + 0.01));
  const std::string check = desk.done("gp2 check models/surface.toml --data log.csv").out;
  EXPECT_THAT(check, HasSubstr("in the median, 0.01 at most (row 5)"));
  EXPECT_THAT(check, HasSubstr("the nearest states on the constraints, to which fit --project moves, differ in q1 by "));
  const Outcome fit = desk.done("gp2 fit models/surface.toml --data log.csv --project --max-iterations 0 -o fit.json");
  EXPECT_TRUE(fit.said("log.csv: states projected onto the constraints: q1 by "));
  EXPECT_TRUE(fit.said("at most (line 6)"));
  EXPECT_FALSE(fit.said("off the constraint"));
}

}  // namespace
}  // namespace gp2::test
