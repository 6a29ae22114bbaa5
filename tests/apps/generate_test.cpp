#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/generate.hpp"
#include "gp2/log_reader.hpp"
#include "test_models.hpp"

namespace gp2::test {
namespace {

class Generate : public testing::TestWithParam<std::string> {};

TEST_P(Generate, WithoutNoiseGivesTheTruth) {
  const Desk desk;
  desk.done("gp2 generate " + GetParam() + " --n 15 --noise-std 0 -o truth.csv");
  const ModelFile& model_file = model(GetParam());
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

}  // namespace
}  // namespace gp2::test
