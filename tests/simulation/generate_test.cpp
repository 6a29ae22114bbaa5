#include "gp2/simulation/generate.hpp"

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/error.hpp"
#include "io_testing.hpp"
#include "reference_data.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::AllOf;
using testing::ElementsAre;
using testing::EndsWith;
using testing::HasSubstr;
using testing::StartsWith;

/// Whether the bits are the same; NaN equals NaN.
bool identical(const MatrixXd& a, const MatrixXd& b) {
  return a.rows() == b.rows() && a.cols() == b.cols() &&
         ((a.array() == b.array()) || (a.array().isNaN() && b.array().isNaN())).all();
}

GeneratedData noise_free(const Model& model, int n = 200, std::uint64_t seed = 1) {
  return generate(model, {n, seed, VectorXd::Zero(model.system->nq())});
}

// ---- every model file

class Generate : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, Generate, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(Generate, TheSameSeedGivesTheSameBitsAndAnotherSeedOthers) {
  const Model& model = test::model(GetParam());
  const VectorXd noise = VectorXd::Constant(model.system->nq(), 0.1);
  const GeneratedData a = generate(model, {20, 5, noise}), b = generate(model, {20, 5, noise}),
                      c = generate(model, {20, 6, noise});
  EXPECT_TRUE(identical(a.states, b.states));
  EXPECT_TRUE(identical(a.accelerations, b.accelerations));
  EXPECT_FALSE(identical(a.states, c.states));
  EXPECT_FALSE(identical(a.accelerations, c.accelerations));
  // noise comes after the states
  EXPECT_TRUE(identical(a.states, noise_free(model, 20, 5).states));
}

TEST_P(Generate, StatesSatisfyTheConstraintsToRounding) {
  const Model& model = test::model(GetParam());
  const MatrixXd states = noise_free(model).states;
  const System& system = *model.system;
  const VectorXd parameters = system.parameter_values();
  const MatrixXd residuals = system.residuals(states, parameters);
  ASSERT_GT(residuals.rows(), 0);
  // what the residuals change by when every entry of the state does by its size
  MatrixXd scale = MatrixXd::Ones(residuals.rows(), residuals.cols());
  for (Eigen::Index k = 0; k < states.rows(); ++k) {
    if (states.row(k).hasNaN()) continue;
    MatrixXd moved = states;
    moved.row(k) *= 1 + 1e-3;
    scale += (system.residuals(moved, parameters) - residuals).cwiseAbs() / 1e-3;
  }
  EXPECT_LT((residuals.array() / scale.array()).abs().maxCoeff(), 20 * test::eps);
}

TEST_P(Generate, NoiseFreeAccelerationsSatisfyTheConstraintsAndAreTheTruth) {
  const Model& model = test::model(GetParam());
  const GeneratedData data = noise_free(model);
  EXPECT_TRUE(identical(data.accelerations, true_acceleration(model, data.states)));
  const SystemValues values = model.system->evaluate(data.states, model.system->parameter_values());
  for (int i = 0; i < data.states.cols(); ++i) {
    const VectorXd ddq = data.accelerations.col(i);
    const VectorXd scale = values.A(i).cwiseAbs() * ddq.cwiseAbs() + values.b(i).cwiseAbs();
    const VectorXd error = values.A(i) * ddq - values.b(i);
    for (Eigen::Index k = 0; k < error.size(); ++k)
      EXPECT_LE(std::abs(error[k]), 50 * test::eps * (scale[k] + 1)) << "state " << i + 1;
  }
}

TEST_P(Generate, WhatIsKnownIsFiniteAndTheRestIsNaN) {
  const Model& model = test::model(GetParam());
  const GeneratedData data = noise_free(model, 10);
  ASSERT_EQ(data.known.size(), static_cast<std::size_t>(model.system->layout().size()));
  for (std::size_t k = 0; k < data.known.size(); ++k) {
    const auto row = data.states.row(static_cast<Eigen::Index>(k)).array();
    EXPECT_TRUE(data.known[k] ? row.isFinite().all() : row.isNaN().all()) << model.system->state_names()[k];
  }
  EXPECT_TRUE(data.accelerations.allFinite());
}

TEST_P(Generate, RangesAreFilledEvenly) {
  const Model& model = test::model(GetParam());
  const std::vector<std::string> names = model.system->state_names();
  constexpr int n = 4000;
  const MatrixXd states = noise_free(model, n).states;
  for (const Model::SamplingRule& rule : model.sampling) {
    const auto name = std::find(names.begin(), names.end(), rule.name);
    if (!rule.range || name == names.end()) continue;
    const auto [lower, upper] = *rule.range;
    VectorXd u = (states.row(name - names.begin()).transpose().array() - lower) / (upper - lower);
    std::sort(u.begin(), u.end());
    EXPECT_GE(u[0], 0);
    EXPECT_LT(u[n - 1], 1);
    // Kolmogorov and Smirnov: √n · distance exceeds 2.2 once in 8000 times
    double distance = 0;
    for (int i = 0; i < n; ++i) distance = std::max(distance, std::abs(u[i] - (i + 0.5) / n));
    EXPECT_LT(distance * std::sqrt(n), 2.2) << rule.name;
  }
}

// ---- noise

TEST(GenerateNoise, HasTheStatedStandardDeviationInEachOutput) {
  const Model& model = test::model("models/surface.toml");
  constexpr int n = 20000;
  const Eigen::Vector3d stddev(0.1, 0, 3);
  const MatrixXd noise = generate(model, {n, 1, stddev}).accelerations - noise_free(model, n).accelerations;
  EXPECT_TRUE((noise.row(1).array() == 0).all());
  for (const int j : {0, 2}) {
    // five standard errors
    EXPECT_NEAR(noise.row(j).mean(), 0, 5 * stddev[j] / std::sqrt(n));
    EXPECT_NEAR(std::sqrt(noise.row(j).squaredNorm() / n), stddev[j], 5 * stddev[j] / std::sqrt(2.0 * n));
  }
  EXPECT_NEAR(noise.row(0).dot(noise.row(2)) / (n * 0.3), 0, 5 / std::sqrt(n));
}

TEST(GenerateNoise, OfTheWrongSizeOrSignIsRefused) {
  const Model& model = test::model("models/surface.toml");
  const std::string rule = "generate: noise_stddev must hold 3 finite numbers ≥ 0, one per coordinate";
  EXPECT_EQ(input_error_of([&] { generate(model, {5, 1, VectorXd::Zero(2)}); }), rule);
  EXPECT_EQ(input_error_of([&] { generate(model, {5, 1, Eigen::Vector3d(0, -1, 0)}); }), rule);
  EXPECT_EQ(input_error_of([&] { generate(model, {5, 1, Eigen::Vector3d(0, NAN, 0)}); }), rule);
  EXPECT_EQ(input_error_of([&] { generate(model, {5, 1, Eigen::Vector3d(0, INFINITY, 0)}); }), rule);
  EXPECT_EQ(input_error_of([&] { generate(model, {0, 1, VectorXd::Zero(3)}); }), "generate: n must be at least 1, got 0");
}

// ---- rules of [sampling]

// a bead on a circle of radius 2, and a free coordinate that only the truth may read
Model circle(const std::string& sampling, const std::string& truth = "[\"0\", \"0\", \"0\"]") {
  return Model::parse(
      "coordinates = [\"x\", \"y\", \"z\"]\ninputs = [\"u\"]\n[mechanics]\n"
      "mass = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n[constraints]\nposition = [\"x^2 + y^2 - 4\"]\n[truth]\n"
      "acceleration = " +
          truth + "\n[sampling]\n" + sampling,
      "circle.toml");
}
enum Entry { x, y, z, dx, dy, dz, t, u };

TEST(GenerateSampling, CoordinatesThatAreSolvedForTakeTheBranchOfTheStart) {
  for (const double sign : {1.0, -1.0}) {
    const Model model = circle(fmt::format("x = [-1, 1]\ndx = [-1, 1]\nstart = {{ y = {} }}\n", sign));
    const GeneratedData data = noise_free(model, 50);
    EXPECT_GT((sign * data.states.row(y)).minCoeff(), 1.7);
    EXPECT_LT((data.states.row(x).array().square() + data.states.row(y).array().square() - 4).abs().maxCoeff(), 1e-14);
    EXPECT_LT(
        (data.states.row(x).array() * data.states.row(dx).array() + data.states.row(y).array() * data.states.row(dy).array())
            .abs()
            .maxCoeff(),
        1e-14);
    EXPECT_EQ(data.known, (std::vector<bool>{true, true, false, true, true, false, false, false}));
  }
}

TEST(GenerateSampling, RulesMayUseAuxiliaryDrawsAndWhatIsSolvedFor) {
  const Model model =
      circle("x = \"r*0.5\"\nr = [-1, 1]\ndx = \"s\"\ns = \"2*y\"\nstart = { y = 1 }\nz = \"dy + 1\"\nt = 3\nu = \"t + s\"\n");
  const MatrixXd states = noise_free(model, 20).states;
  EXPECT_LE(states.row(x).cwiseAbs().maxCoeff(), 0.5);
  EXPECT_TRUE(identical(states.row(dx), 2 * states.row(y)));
  EXPECT_TRUE(identical(states.row(z), (states.row(dy).array() + 1).matrix()));
  EXPECT_TRUE((states.row(t).array() == 3).all());
  EXPECT_TRUE(identical(states.row(u), (states.row(dx).array() + 3).matrix()));
}

TEST(GenerateSampling, RedundantConstraintsAreSolvedTogether) {
  const GeneratedData data = noise_free(test::model("models/slider_crank.toml"), 20);
  EXPECT_TRUE(std::all_of(data.known.begin(), data.known.end() - 2, [](bool known) { return known; }));  // all but t
}

TEST(GenerateSampling, TheUnicycleNeedsNoPosition) {
  const GeneratedData data = noise_free(test::model("models/unicycle.toml"), 5);
  EXPECT_TRUE(data.states.topRows(2).array().isNaN().all());
  EXPECT_FALSE(data.known[0]);
  EXPECT_FALSE(data.known[1]);
  EXPECT_TRUE(data.known[2]);
}

std::string error_of(const Model& model) {
  return input_error_of([&] { noise_free(model, 5); });
}

TEST(GenerateSampling, WithoutSamplingOrTruthThereIsNoData) {
  const std::string text = "coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\n[constraints]\nposition = [\"x - t\"]\n";
  EXPECT_EQ(error_of(Model::parse(text + "[truth]\nacceleration = [0]\n", "m.toml")),
            "m.toml: missing [sampling]: where states are drawn from, say q1 = [-1, 1]; or [motion]: how the system is driven");
  const Model without_truth = Model::parse(text + "[sampling]\nt = [0, 1]\n", "m.toml");
  const std::string missing_truth =
      "m.toml: missing [truth] acceleration = [ … ]: what is added to M⁻¹ force, \"0\" where nothing is";
  EXPECT_EQ(error_of(without_truth), missing_truth);
  EXPECT_EQ(input_error_of([&] { true_acceleration(without_truth, MatrixXd::Zero(3, 1)); }), missing_truth);
}

TEST(GenerateSampling, WhatNeitherRulesNorConstraintsDecideIsNamed) {
  EXPECT_EQ(
      error_of(circle("x = [-1, 1]\ndx = [-1, 1]\nstart = { y = 1 }\n", "[\"0\", \"0\", \"-u\"]")),
      "circle.toml: [sampling] says nothing of 'u', which the model reads, and no constraint decides it: add u = [lower, upper]");
  EXPECT_THAT(
      error_of(circle("dx = [-1, 1]\nstart = { x = 1, y = 1 }\n")),
      StartsWith("circle.toml: [sampling]: at x = 1, y = 1 the constraints decide only 1 of the 2 unknowns x, y: draw some"));
  // a constraint that reads t although A and b do not
  EXPECT_THAT(
      error_of(Model::parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\n[constraints]\nposition = [\"x - t\"]\n[truth]\n"
                            "acceleration = [0]\n[sampling]\na = [0, 1]\n",
                            "m.toml")),
      HasSubstr("says nothing of 't'"));
}

TEST(GenerateSampling, ASingularStartIsNamedWithTheMend) {
  EXPECT_THAT(error_of(circle("x = [-1, 1]\ndx = [-1, 1]\n")),
              AllOf(HasSubstr("y = 0 the constraints decide only 0 of the 1 unknowns y"),
                    EndsWith("or start elsewhere, start = { y = … }")));
}

TEST(GenerateSampling, StatesDrawnOffTheConstraintAreRefused) {
  EXPECT_THAT(
      error_of(circle("x = [-1, 1]\ny = [-1, 1]\ndx = [-1, 1]\n")),
      AllOf(StartsWith("circle.toml: [sampling]: sample 1 (x = "), HasSubstr("is off the constraint \"x^2 + y^2 - 4\" by "),
            EndsWith("leave one more of x, y to be solved from the constraints")));
  EXPECT_THAT(error_of(circle("x = [-1, 1]\ndx = [-1, 1]\ndy = [-1, 1]\nstart = { y = 1 }\n")),
              HasSubstr("is off the constraint \"d/dt of x^2 + y^2 - 4\" by "));
}

TEST(GenerateSampling, AConstraintThatComesAndGoesIsToBeObeyedByAnExpression) {
  const auto model = [](const std::string& rule) {
    return Model::parse(
        "coordinates = [\"x\", \"y\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\n[constraints]\n"
        "velocity = [{ expr = \"dy - 0.1*x\", when = \"x > 0.5\" }]\n[truth]\nacceleration = [0, 0]\n[sampling]\n"
        "x = [-1, 1]\ny = [-1, 1]\ndx = [-1, 1]\n" +
            rule,
        "m.toml");
  };
  for (const std::string rule : {"", "dy = [-1, 1]\n"}) {
    EXPECT_THAT(
        input_error_of([&] { noise_free(model(rule), 50); }),
        AllOf(StartsWith("m.toml: [sampling]: sample "),
              EndsWith(": the constraint \"dy - 0.1*x\" is there at some of the samples only: give dy by an expression that "
                       "satisfies it, dy = \"…\"")))
        << rule;
  }
  EXPECT_EQ(noise_free(model("dy = \"0.1*x\"\n"), 50).states.cols(), 50);
}

TEST(GenerateSampling, ContradictingConstraintsAreRefused) {
  // least squares has a solution, the constraints have none
  EXPECT_THAT(
      error_of(Model::parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[1]]\n[constraints]\nposition = [\"x - 1\", \"x - 2\"]\n"
                            "[truth]\nacceleration = [0]\n[sampling]\nt = [0, 1]\n",
                            "m.toml")),
      HasSubstr("is off the constraint"));
}

TEST(GenerateSampling, AConstraintOutOfReachIsANumericalError) {
  try {
    noise_free(circle("x = [3, 4]\ndx = [-1, 1]\nstart = { y = 1 }\n"), 5);
    FAIL() << "no circle of radius 2 passes there";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(),
                AllOf(StartsWith("circle.toml: [sampling]: Newton's method did not reach the constraints for y at sample 1"),
                      EndsWith("start = { y = … }")));
  }
}

TEST(GenerateSampling, ARuleThatIsNoNumberIsNamedWithItsLine) {
  EXPECT_EQ(error_of(circle("x = \"log(a)\"\na = [-2, -1]\ndx = 0\nstart = { y = 1 }\n")),
            "circle.toml:10: sampling.x: log(a) is not a finite number at sample 1");
}

TEST(GenerateSampling, ATruthThatIsNoNumberIsNamed) {
  EXPECT_EQ(error_of(circle("x = [-1, 1]\ndx = 0\nstart = { y = 1 }\n", "[\"0\", \"0\", \"log(-1 - x^2)\"]")),
            "circle.toml: the true acceleration is not a finite number at sample 1");
}

// ---- grids

GeneratedData grid_of(const Model& model, const std::map<std::string, int>& points, std::uint64_t seed = 1) {
  return generate(model, {1, seed, VectorXd::Zero(model.system->nq()), points});
}

struct PublishedGrid {
  std::string system;
  std::map<std::string, int> points;
};

class GenerateGrid : public testing::TestWithParam<PublishedGrid> {};
INSTANTIATE_TEST_SUITE_P(
    EverySystem, GenerateGrid,
    testing::Values(PublishedGrid{"surface", {{"q1", 5}, {"q2", 5}, {"dq1", 3}, {"dq2", 3}, {"u1", 3}, {"u2", 3}, {"u3", 3}}},
                    PublishedGrid{"unicycle", {{"v", 5}, {"q3", 8}, {"dq3", 3}, {"u1", 3}, {"u2", 3}}},
                    PublishedGrid{"duffing", {{"q1", 10}, {"dq1", 10}, {"t", 10}}}),
    [](const auto& instance) { return instance.param.system; });

TEST_P(GenerateGrid, IsThePublishedOneRowByRow) {
  if (const auto absent = test::why_reference_is_absent()) GTEST_SKIP() << *absent;
  const Model& model = test::model("experiments/" + GetParam().system + "_published.toml");
  const GeneratedData grid = grid_of(model, GetParam().points);
  const CsvTable published = CsvTable::read(test::reference_file("grid/" + GetParam().system + "_grid.csv"));
  ASSERT_EQ(grid.states.cols(), published.n_rows());
  int n_compared = 0;
  const auto compare = [&](const std::string& name, const auto& row) {
    const int column = published.find(name);
    if (column < 0) return;
    ++n_compared;
    const double scale = std::max(1.0, row.cwiseAbs().maxCoeff());
    for (int i = 0; i < published.n_rows(); ++i) {
      ASSERT_NEAR(row[i], published.number(i, column), 1e-12 * scale) << name << " in row " << i + 1;
    }
  };
  const std::vector<std::string> names = model.system->state_names();
  for (std::size_t k = 0; k < names.size(); ++k) compare(names[k], grid.states.row(static_cast<Eigen::Index>(k)));
  for (int j = 0; j < model.system->nq(); ++j) {
    compare(model.system->coordinates()[static_cast<std::size_t>(j)].acceleration(), grid.accelerations.row(j));
  }
  EXPECT_EQ(n_compared, published.n_columns());
}

TEST(GenerateGrid, RunsTheLastRangeFastestFromEndToEnd) {
  const Model model = circle("x = [-1, 1]\nw = [0, 3]\ndx = \"2*w\"\nz = [5, 7]\nstart = { y = 1 }\n");
  const MatrixXd states = grid_of(model, {{"z", 1}, {"w", 3}, {"x", 2}}).states;
  const auto row = [&](Entry entry) { return std::vector<double>(states.row(entry).begin(), states.row(entry).end()); };
  EXPECT_THAT(row(x), ElementsAre(-1, -1, -1, 1, 1, 1));
  EXPECT_THAT(row(dx), ElementsAre(0, 3, 6, 0, 3, 6));                                  // by an auxiliary range
  EXPECT_THAT(row(z), ElementsAre(6, 6, 6, 6, 6, 6));                                   // one point is the middle
  EXPECT_LT((states.row(y).array() - std::sqrt(3.0)).abs().maxCoeff(), 4 * test::eps);  // solved for, as ever
}

TEST(GenerateGrid, TakesNothingFromTheSeedButTheNoise) {
  const Model& model = test::model("models/surface.toml");
  const std::map<std::string, int> points = {{"q1", 2}, {"q2", 2}, {"dq1", 1}, {"dq2", 1}, {"u1", 1}, {"u2", 1}, {"u3", 2}};
  const GeneratedData a = grid_of(model, points, 1), b = grid_of(model, points, 2);
  EXPECT_TRUE(identical(a.states, b.states));
  EXPECT_TRUE(identical(a.accelerations, b.accelerations));
  EXPECT_TRUE(identical(a.accelerations, true_acceleration(model, a.states)));
  EXPECT_EQ(a.known, noise_free(model, 1).known);
  const VectorXd noise = VectorXd::Constant(3, 0.1);
  const GeneratedData noisy = generate(model, {1, 1, noise, points}), other = generate(model, {1, 2, noise, points});
  EXPECT_TRUE(identical(noisy.states, a.states));
  EXPECT_FALSE(identical(noisy.accelerations, other.accelerations));
}

TEST(GenerateGrid, ThatIsNoneIsRefused) {
  const Model model = circle("x = [-1, 1]\ndx = [-1, 1]\nz = \"x\"\nstart = { y = 1 }\n");
  const auto refused = [&](const std::map<std::string, int>& points) { return input_error_of([&] { grid_of(model, points); }); };
  EXPECT_EQ(refused({{"x", 2}, {"dx", 2}}), "");
  EXPECT_EQ(refused({{"x", 2}}), "grid: no number of points for 'dx': every range of [sampling] needs one");
  EXPECT_EQ(refused({{"x", 2}, {"dx", 2}, {"q1", 2}}), "grid: 'q1' is not a range of [sampling] in circle.toml; ranges: x, dx");
  EXPECT_EQ(refused({{"x", 2}, {"dx", 2}, {"z", 2}}), "grid: 'z' is not a range of [sampling] in circle.toml; ranges: x, dx");
  EXPECT_EQ(refused({{"x", 0}, {"dx", 2}}), "grid: 'x' must have at least 1 point, got 0");
  EXPECT_EQ(refused({{"x", 2}, {"dx", -3}}), "grid: 'dx' must have at least 1 point, got -3");
  EXPECT_EQ(refused({{"x", 10000}, {"dx", 10000}}), "grid: 1e+08 points are more than 1e+07");
  // beyond what an int counts
  EXPECT_EQ(refused({{"x", 2000000000}, {"dx", 2000000000}}), "grid: 4e+18 points are more than 1e+07");
}

// ---- rules of [motion]

Model driven(const std::string& inputs, const std::string& more) {
  return Model::parse("coordinates = [\"x\"]\ninputs = " + inputs +
                          "\n[mechanics]\nmass = [[1]]\nforce = [\"u\"]\n[motion]\nrate = 50\nsegment = [1, 2]\n"
                          "natural_frequency = 5\ntargets = { x = [-1, 1] }\n" +
                          more,
                      "driven.toml");
}

TEST(GenerateMotion, ABodyThatDryFrictionHoldsIsAtRest) {
  const GeneratedData data = noise_free(driven("[\"u\"]", "[truth]\nforce = [\"-2*sign(dx)\"]\n"), 100);
  int n_held = 0;
  for (Eigen::Index i = 0; i < 100; ++i) {
    const double v = data.states(1, i), force = data.states(3, i);
    if (std::abs(v) > 1e-9) {
      EXPECT_NEAR(data.accelerations(0, i), force - (v > 0 ? 2 : -2), 1e-9) << i;
    } else if (std::abs(force) < 2) {
      EXPECT_NEAR(data.accelerations(0, i), 0, 1e-9) << i;
      ++n_held;
    }
  }
  EXPECT_GT(n_held, 2);
  EXPECT_LT(n_held, 98);
}

TEST(GenerateMotion, ATruthThatIsStiffIsRefusedSoonWithTheMend) {
  const Model model = driven("[\"u\"]", "[truth]\nforce = [\"-1e8*dx\"]\n");
  try {
    noise_free(model, 100);
    FAIL() << "20000 steps per sample were enough";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(),
                AllOf(StartsWith("simulate: 20000 steps reach no further than t = "),
                      EndsWith("choose other targets of [motion], longer segments, a higher rate, or a smoother [truth]")));
  }
}

TEST(GenerateMotion, DoesNotDriveThroughContacts) {
  EXPECT_EQ(
      error_of(driven("[\"u\", \"touch\"]",
                      "[constraints]\nposition = [{ expr = \"x + 0.5\", contact = \"touch\" }]\n"
                      "[truth]\nforce = [0]\n")),
      "driven.toml: [motion] looks for no contact, so that a body would pass through its surface: draw states by [sampling], "
      "or simulate a motion");
}

}  // namespace
}  // namespace gp2
