#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/simulation/generate.hpp"
#include "test_models.hpp"

namespace gp2::test {
namespace {

class Generate : public testing::TestWithParam<std::string> {};

TEST_P(Generate, WithoutNoiseGivesTheTruth) {
  const Desk desk;
  desk.done("gp2 generate " + GetParam() + " --n 15 --noise-std 0 -o truth.csv");
  const Model& model_file = model(GetParam());
  const CsvTable table = desk.table("truth.csv");
  ASSERT_EQ(table.n_rows(), 15);
  LogReader reader(table, *model_file.system);
  std::vector<bool> reads;
  for (const std::string& name : model_file.system->state_names()) reads.push_back(reader.has(name));
  std::vector<std::string> accelerations;
  for (const Coordinate& coordinate : model_file.system->coordinates()) accelerations.push_back(coordinate.acceleration());
  // numbers in shortest round-trip form: the very same doubles
  EXPECT_EQ(reader.values(accelerations), true_acceleration(model_file, reader.states(reads)));
}

INSTANTIATE_TEST_SUITE_P(OfEveryModel, Generate, testing::ValuesIn(every_model()), model_test_name);

TEST(Generate, GivesTheSameFileForTheSameSeedOnly) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 15 --seed 3 -o a.csv");
  desk.done("gp2 generate models/surface.toml --n 15 --seed 3 -o b.csv");
  desk.done("gp2 generate models/surface.toml --n 15 --seed 4 -o c.csv");
  EXPECT_EQ(desk.read("a.csv"), desk.read("b.csv"));
  EXPECT_NE(desk.read("a.csv"), desk.read("c.csv"));
}

TEST(Generate, DrawsTheNoiseAskedFor) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 400 --noise-std 0 -o truth.csv");
  desk.done("gp2 generate models/surface.toml --n 400 -o noisy.csv");
  desk.done("gp2 generate models/surface.toml --n 400 --noise-std 0.5 -o noisier.csv");
  const auto noise = [&](const std::string& name) {
    const CsvTable truth = desk.table("truth.csv"), measured = desk.table(name);
    double sum = 0;
    for (int i = 0; i < truth.n_rows(); ++i) {
      const int column = truth.find("ddq2");
      sum += std::pow(measured.number(i, column) - truth.number(i, column), 2);
    }
    return std::sqrt(sum / truth.n_rows());
  };
  EXPECT_NEAR(noise("noisy.csv"), 0.1, 0.015);  // the model's
  EXPECT_NEAR(noise("noisier.csv"), 0.5, 0.075);
}

// ---- grids

const std::string surface_grid = "q1=3,q2=2,dq1=1,dq2=2,u1=1,u2=1,u3=2";

TEST(GenerateGrid, WritesEveryPointOnceTheLastRangeFastest) {
  const Desk desk;
  const Outcome outcome = desk.done("gp2 generate models/surface.toml --grid " + surface_grid + " --noise-std 0 -o grid.csv");
  EXPECT_TRUE(outcome.said("grid.csv: 24 rows of 'particle on a surface'")) << outcome.err;
  const CsvTable table = desk.table("grid.csv");
  const GeneratedData grid =
      generate(model("models/surface.toml"),
               {1, 1, Eigen::VectorXd::Zero(3), {{"q1", 3}, {"q2", 2}, {"dq1", 1}, {"dq2", 2}, {"u1", 1}, {"u2", 1}, {"u3", 2}}});
  ASSERT_EQ(table.n_rows(), 24);
  for (int i = 0; i < table.n_rows(); ++i) {
    EXPECT_EQ(table.number(i, table.find("q1")), -2 + 2 * (i / 8));
    EXPECT_EQ(table.number(i, table.find("u1")), 0);
    EXPECT_EQ(table.number(i, table.find("u3")), i % 2 == 0 ? -5 : 5);
    for (int j = 0; j < 3; ++j) {
      EXPECT_EQ(table.number(i, table.find("ddq" + std::to_string(j + 1))), grid.accelerations(j, i));
    }
  }
}

TEST(GenerateGrid, IsTestDataForAFit) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 20 -o train.csv");
  desk.done("gp2 generate models/surface.toml --grid " + surface_grid + " --noise-std 0 -o grid.csv");
  desk.done("gp2 fit models/surface.toml --data train.csv --mean force --max-iterations 0 -o fit.json");
  EXPECT_EQ(desk.done("gp2 evaluate fit.json --data grid.csv --json").json()["n"], 24);
}

TEST(GenerateGrid, GoesWithoutN) {
  const Desk desk;
  const auto refused = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 generate models/surface.toml " + options + " -o grid.csv");
    EXPECT_EQ(outcome.status, 2) << options;
    EXPECT_FALSE(desk.has("grid.csv")) << options;
    return outcome.err;
  };
  EXPECT_EQ(refused(""), "gp2: error: give either --n or --grid; see gp2 generate --help\n");
  EXPECT_EQ(refused("--n 5 --grid " + surface_grid), "gp2: error: give either --n or --grid; see gp2 generate --help\n");
  EXPECT_EQ(refused("--n 0"), "gp2: error: --n: must be positive, got 0\n");
}

TEST(GenerateGrid, ThatIsNoneIsRefusedWithTheMend) {
  const Desk desk;
  const auto refused = [&](const std::string& grid) {
    const Outcome outcome = desk.run("gp2 generate models/surface.toml --grid '" + grid + "' -o grid.csv");
    EXPECT_EQ(outcome.status, 2) << grid;
    EXPECT_FALSE(desk.has("grid.csv")) << grid;
    return outcome.err;
  };
  for (const std::string item : {"q1", "=5", "q1=", "q1=x", "q1=2.5", "5", "q1=99999999999"}) {
    EXPECT_EQ(refused(item), "gp2: error: --grid: '" + item + "' is not RANGE=POINTS, say q1=5\n");
  }
  EXPECT_EQ(refused("q1=5,q1=6"), "gp2: error: --grid: 'q1' stands twice\n");
  EXPECT_EQ(refused("q1=5"), "gp2: error: grid: no number of points for 'q2': every range of [sampling] needs one\n");
  EXPECT_EQ(refused(surface_grid + ",q3=5"),
            "gp2: error: grid: 'q3' is not a range of [sampling] in models/surface.toml; ranges: q1, q2, dq1, dq2, u1, u2, u3\n");
  EXPECT_EQ(refused(replaced(surface_grid, "q1=3", "q1=0")), "gp2: error: grid: 'q1' must have at least 1 point, got 0\n");
}

}  // namespace
}  // namespace gp2::test
