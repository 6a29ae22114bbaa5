// Friction μ(v)|λ₀| of two machines: what a direction that knows the load gains, and that it holds beyond the data.
#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "data_of_model.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/report_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "inference/problems.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;

struct Machine {
  std::string file;
  std::vector<std::pair<std::string, std::string>> twice_as_fast;
  std::string features, along;  // of a latent that is the friction itself, along the contact
};

const Machine wire = {"experiments/mechanisms/bead_on_turning_wire.toml",
                      {{"dr = [-1, 1]", "dr = [-2, 2]"}},
                      R"x(["x*cos(w*t) + y*sin(w*t)", "dx*cos(w*t) + dy*sin(w*t)", "fx*sin(w*t) - fy*cos(w*t)", "fz", "v"])x",
                      R"({ force = [["-rx/v"], ["-ry/v"], ["-dz/v"]] })"};
const Machine finger = {"experiments/mechanisms/finger_on_plate.toml",
                        {{"dx = [-0.8, 0.8]", "dx = [-1.6, 1.6]"}, {"dy = [-0.8, 0.8]", "dy = [-1.6, 1.6]"}},
                        R"(["x", "y", "dx", "dy", "fx", "fy", "fz", "v"])",
                        R"({ force = [["-dx/v"], ["-dy/v"], ["-dz/v"]] })"};

// the machine's model with the friction itself as its latent, of the default prior
Model with_latent(const Machine& machine) {
  std::string text = test::model(machine.file).text;
  const std::size_t begin = text.find("[[latent]]"), end = text.find("[noise]");
  text.replace(begin, end - begin, "[[latent]]\nfeatures = " + machine.features + "\ndirections = " + machine.along + "\n");
  return Model::parse(text, machine.file);
}

Posterior fitted(const Model& model, const Machine& machine, int n, std::uint64_t seed) {
  FitRequest request = test::fit_request(model, {test::drawn_log(machine.file, n, seed).table()});
  request.hyperparameters = HyperparameterChoice::optimise;
  request.restarts = 2;
  request.threads = 2;
  return run_fit(prepare_fit(std::move(request))).posterior;
}

struct Scores {
  double nrmse = 0, coverage = 0;
};

Scores scores(const Posterior& posterior, const GeneratedData& test) {
  const auto marginal = posterior.marginal(View::constrained_acceleration(*posterior.prior().system), test.states);
  const MatrixXd error = marginal.mean - test.accelerations, stddev = marginal.stddev();
  const MatrixXd centred = test.accelerations.colwise() - test.accelerations.rowwise().mean();
  const auto inside = (error.array().abs() <= 1.959964 * stddev.array()).cast<double>();
  return {error.norm() / centred.norm(), inside.mean()};
}

class FrictionOfALoad : public testing::TestWithParam<const Machine*> {};
INSTANTIATE_TEST_SUITE_P(Machines, FrictionOfALoad, testing::Values(&wire, &finger),
                         [](const auto& machine) { return test::stem(machine.param->file); });

TEST_P(FrictionOfALoad, IsLearnedFromFewRowsAndHoldsAtTwiceTheVelocities) {
  const Machine& machine = *GetParam();
  const Model& model = test::model(machine.file);
  const Model fast_model = Model::parse(test::changed(model.text, machine.twice_as_fast), machine.file);
  const Model without_load = with_latent(machine);
  double covered = 0, growth = 0, n_fits = 0;
  for (const auto& [n, seed] : std::vector<std::pair<int, std::uint64_t>>{{20, 1}, {20, 2}, {20, 3}, {100, 1}}) {
    SCOPED_TRACE(fmt::format("{}, N = {}, seed {}", machine.file, n, seed));
    const GeneratedData test = test::draw(model, 200, seed + 5000), fast = test::draw(fast_model, 200, seed + 5000);
    const Posterior posterior = fitted(model, machine, n, seed), other = fitted(without_load, machine, n, seed);
    const Scores own = scores(posterior, test), own_fast = scores(posterior, fast);
    EXPECT_LE(own.nrmse, scores(other, test).nrmse / 3);
    EXPECT_LE(own_fast.nrmse, scores(other, fast).nrmse / 3);
    covered += own.coverage;
    growth += std::log(own_fast.nrmse / own.nrmse);
    ++n_fits;
  }
  EXPECT_GE(covered / n_fits, 0.85);
  EXPECT_LE(std::exp(growth / n_fits), 2.5);
}

class FrictionOfAChangedLoad : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Machines, FrictionOfAChangedLoad, testing::Values("rubbing_bead", "dragged_rod", "ladder"),
                         [](const auto& machine) { return machine.param; });

TEST_P(FrictionOfAChangedLoad, IsLearnedTogetherWithIt) {
  Machine machine;
  machine.file = fmt::format("experiments/mechanisms/{}.toml", GetParam());
  const Model& model = test::model(machine.file);
  std::string text = model.text;
  const std::size_t truth = text.find("[truth]");
  for (std::size_t at = text.find("lambda("); at < truth; at = text.find("lambda(", at)) text.replace(at, 6, "lambda0");
  const Model known = Model::parse(text, machine.file);
  double covered = 0;
  const std::vector<std::uint64_t> seeds = {41, 42, 43};
  for (const std::uint64_t seed : seeds) {
    SCOPED_TRACE(fmt::format("{}, seed {}", machine.file, seed));
    const GeneratedData test = test::draw(model, 200, seed + 5000);
    const Scores own = scores(fitted(model, machine, 60, seed), test), other = scores(fitted(known, machine, 60, seed), test);
    EXPECT_LE(own.nrmse, other.nrmse / 4);
    covered += own.coverage;
  }
  EXPECT_GE(covered / static_cast<double>(seeds.size()), 0.8);
}

// 0.15 + 0.25 exp(−(v/0.4)²): at the ends of the speeds what is left of it at speed
TEST(FrictionOfALoadAsACurve, IsItsCoefficient) {
  Machine machine;
  machine.file = "experiments/mechanisms/rubbing_bead.toml";
  const std::vector<LearnedForce> all = learned_forces(fitted(test::model(machine.file), machine, 60, 41));
  const auto curve = std::ranges::find_if(
      all, [](const LearnedForce& one) { return one.names == std::vector<std::string>{"coefficient"} && one.along == "dx"; });
  ASSERT_NE(curve, all.end());
  for (const Eigen::Index end : {Eigen::Index{0}, curve->at.size() - 1}) {
    EXPECT_GT(std::abs(curve->at[end]), 1.2);
    EXPECT_NEAR(curve->mean(0, end), 0.15, 3 * curve->stddev(0, end) + 1e-3);
  }
  EXPECT_GT(curve->mean.minCoeff(), 0.13);
  EXPECT_LT(curve->mean.maxCoeff(), 0.42);
  EXPECT_LT(curve->stddev.maxCoeff(), 0.05);
}

// A rod that is dragged: its friction changes the load that it is the coefficient of, by more where the rod is steeper.
TEST(FrictionOfALoadAsACurve, HasOneBandWhereItIsOneNumberHoweverTheLoadDependsOnIt) {
  const Model rod = Model::parse(
      R"x(coordinates = ["x", "y", "th"]
inputs = ["u"]
[let]
friction = "abs(lambda(1))*sign(dx + 0.5*sin(th)*dth)"
[mechanics]
mass = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.08"]]
force = ["u", "-9.81", "0"]
[constraints]
position = ["y - 0.5*sin(th)"]
[[latent]]
name = "coefficient"
kernel = "se"
features = ["th"]
lengthscale = { value = 1000, estimate = false }
signal_stddev = { value = 2, estimate = false }
directions = { force = [["-friction"], ["0"], ["-friction*0.5*sin(th)"]] }
[noise]
ddq = 0.5
[truth]
force = ["-0.5*friction", "0", "-0.25*friction*sin(th)"]
[sampling]
th = [0.8, 1.2]
dth = [-1, 1]
dx = [1, 3]
u = [-1, 1]
)x",
      "rod.toml");
  FitRequest request = test::fit_request(rod, {test::drawn_log(rod, 20, 1).table()});
  request.restarts = 1;
  const std::vector<LearnedForce> all = learned_forces(run_fit(prepare_fit(std::move(request))).posterior);
  const auto curve = std::ranges::find_if(
      all, [](const LearnedForce& one) { return one.names == std::vector<std::string>{"coefficient"} && one.along == "th"; });
  ASSERT_NE(curve, all.end());
  EXPECT_NEAR(curve->mean.mean(), 0.5, 4 * curve->stddev.mean());
  EXPECT_LT(curve->stddev.maxCoeff(), 1.01 * curve->stddev.minCoeff());
}

}  // namespace
}  // namespace gp2
