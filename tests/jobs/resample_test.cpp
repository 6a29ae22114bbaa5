#include "gp2/jobs/resample.hpp"

#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "base/random.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::ElementsAre;
using testing::HasSubstr;

constexpr std::uint64_t seed = 40601;

MatrixXd random_points(Index rows, Index columns) {
  RandomStream random(seed);
  MatrixXd points(rows, columns);
  for (double& entry : points.reshaped()) entry = random.normal();
  return points;
}

// of every point from the nearest of the first k chosen
VectorXd distances(const MatrixXd& points, const std::vector<int>& chosen, int k) {
  VectorXd nearest = VectorXd::Constant(points.cols(), std::numeric_limits<double>::infinity());
  for (Index i = 0; i < points.cols(); ++i) {
    for (int c = 0; c < k; ++c) {
      nearest[i] = std::min(nearest[i], (points.col(i) - points.col(chosen[static_cast<std::size_t>(c)])).norm());
    }
  }
  return nearest;
}

TEST(FarthestPoints, EachIsTheFarthestFromAllBeforeIt) {
  const MatrixXd points = random_points(3, 80);
  const FarthestPoints farthest = farthest_points(points, 30, 17);
  ASSERT_EQ(farthest.chosen.size(), 30U);
  EXPECT_EQ(farthest.chosen.front(), 17);
  EXPECT_EQ(farthest.distance[0], 0);
  for (int k = 1; k < 30; ++k) {
    const VectorXd nearest = distances(points, farthest.chosen, k);
    EXPECT_EQ(nearest.maxCoeff(), nearest[farthest.chosen[static_cast<std::size_t>(k)]]) << k;
    EXPECT_DOUBLE_EQ(farthest.distance[k], nearest.maxCoeff());
    if (k > 1) {
      EXPECT_LE(farthest.distance[k], farthest.distance[k - 1]);
    }
  }
  EXPECT_DOUBLE_EQ(farthest.radius, distances(points, farthest.chosen, 30).maxCoeff());
}

TEST(FarthestPoints, ASmallerChoiceIsTheBeginningOfALargerOne) {
  const MatrixXd points = random_points(2, 50);
  const FarthestPoints all = farthest_points(points, 50, 3);
  for (int n : {1, 2, 20}) {
    const FarthestPoints some = farthest_points(points, n, 3);
    EXPECT_TRUE(std::equal(some.chosen.begin(), some.chosen.end(), all.chosen.begin()));
    EXPECT_EQ(some.distance, all.distance.head(n));
  }
  EXPECT_EQ(all.radius, 0) << "nothing is left";
  EXPECT_EQ(farthest_points(points.leftCols(1), 1, 0).radius, 0);
}

TEST(FarthestPoints, TakesNoPointTwiceAndDuplicatesLast) {
  MatrixXd points = random_points(2, 30);
  points.rightCols(10) = points.leftCols(10);
  const FarthestPoints farthest = farthest_points(points, 30, 25);
  std::vector<int> sorted = farthest.chosen;
  std::sort(sorted.begin(), sorted.end());
  for (int k = 0; k < 30; ++k) EXPECT_EQ(sorted[static_cast<std::size_t>(k)], k);
  EXPECT_GT(farthest.distance.segment(1, 19).minCoeff(), 0) << "twenty points differ";
  EXPECT_EQ(farthest.distance.tail(10), VectorXd::Zero(10));
}

// two coordinates, one of them an angle, and an input
constexpr const char* arm = R"(
coordinates = ["x", { name = "a", angle = true }]
inputs = ["u"]
[parameters]
l = 2.0
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["u", "0"]
[[latent]]
name       = "f"
kernel     = "se"
features   = ["x", "a"]
directions = "acceleration"
)";

const Model& model() {
  static const Model model = Model::parse(arm, "arm.toml");
  return model;
}

// x in units of `unit`
CsvTable log_in(double unit, int n = 60) {
  std::string csv = "remark,x,a,dx\n";
  RandomStream random(seed, 2);
  for (int i = 0; i < n; ++i) {
    csv += fmt::format("row {},{},{},{}\n", i, unit * random.normal(), 6 * random.uniform(), random.normal());
  }
  return CsvTable::parse(csv, "log.csv");
}

ResampleOptions choose(int n, std::vector<std::string> features = {}) {
  ResampleOptions options;
  options.n = n;
  options.features = std::move(features);
  return options;
}

// the features of a log, each divided by its standard deviation, written out
MatrixXd standardised(const CsvTable& log, const std::vector<std::string>& names) {
  MatrixXd points(static_cast<Index>(names.size()), log.n_rows());
  for (std::size_t d = 0; d < names.size(); ++d) {
    const bool angle = names[d].size() > 1 && names[d].ends_with("(a)");
    for (int i = 0; i < log.n_rows(); ++i) {
      const double value = log.number(i, log.find(angle ? "a" : names[d]));
      points(static_cast<Index>(d), i) = !angle ? value : names[d].starts_with("sin") ? std::sin(value) : std::cos(value);
    }
    auto row = points.row(static_cast<Index>(d));
    row.array() -= row.mean();
    row /= std::sqrt(row.squaredNorm() / log.n_rows());
  }
  return points;
}

TEST(Resample, MeasuresByTheFeaturesOfTheModelInTheirStandardDeviations) {
  const CsvTable log = log_in(1e-3);
  const Resample chosen = resample(model(), log, choose(20));
  EXPECT_THAT(chosen.features, ElementsAre("x", "sin(a)", "cos(a)"));
  const MatrixXd points = standardised(log, chosen.features);
  Index nearest_to_mean = -1;
  points.colwise().norm().minCoeff(&nearest_to_mean);
  EXPECT_EQ(chosen.rows.front(), nearest_to_mean);
  EXPECT_EQ(chosen.rows, farthest_points(points, 20, static_cast<int>(nearest_to_mean)).chosen);
  EXPECT_NEAR(chosen.radius, distances(points, chosen.rows, 20).maxCoeff(), 1e-12);
  EXPECT_EQ(chosen.n_skipped, 0);
}

TEST(Resample, MeasuresByTheFeaturesOfAllLatents) {
  const Model two = Model::parse(R"(
name = "two latents"
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[[latent]]
name = "first"
features = ["x", "dx"]
directions = [["1"], ["0"]]
[[latent]]
name = "second"
features = ["dx", "y"]
directions = [["0"], ["1"]]
)",
                                 "two.toml");
  const CsvTable log = CsvTable::parse("x,y,dx\n0,0,0\n0,5,0\n0,0,1\n1,0,0\n0,0.1,0\n", "log.csv");
  const Resample chosen = resample(two, log, choose(4));
  EXPECT_THAT(chosen.features, ElementsAre("x", "dx", "y"));
  EXPECT_THAT(chosen.rows, testing::UnorderedElementsAre(4, 1, 2, 3)) << "the row that differs in y alone is not left out";
}

TEST(Resample, DoesNotDependOnTheUnits) {
  const Resample here = resample(model(), log_in(1), choose(20)), there = resample(model(), log_in(1e6), choose(20));
  EXPECT_EQ(here.rows, there.rows);
  EXPECT_LE((here.distance - there.distance).cwiseAbs().maxCoeff(), 1e-12);
}

TEST(Resample, MeasuresByOtherFeaturesWhereTheyAreAskedFor) {
  const CsvTable log = log_in(1);
  const Resample chosen = resample(model(), log, choose(9, {"dx", "l*x"}));
  EXPECT_THAT(chosen.features, ElementsAre("dx", "l*x"));
  const MatrixXd points = standardised(log, {"dx", "x"});
  EXPECT_EQ(chosen.rows, farthest_points(points, 9, chosen.rows.front()).chosen) << "a factor changes nothing";
}

TEST(Resample, StartsWhereTheSeedSays) {
  const CsvTable log = log_in(1);
  std::vector<int> starts;
  for (std::uint64_t k = 0; k < 5; ++k) {
    ResampleOptions options = choose(4);
    options.seed = k;
    const Resample chosen = resample(model(), log, options);
    EXPECT_EQ(chosen.rows, resample(model(), log, options).rows);
    starts.push_back(chosen.rows.front());
  }
  std::sort(starts.begin(), starts.end());
  EXPECT_NE(starts.front(), starts.back());
}

TEST(Resample, SkipsRowsWithoutANumberInAFeature) {
  const CsvTable log = CsvTable::parse("x,a\n0,0\n,1\n1,nan\n5,-inf\n4,1\n+nan,0\n2,+1\n", "log.csv");
  const Resample chosen = resample(model(), log, choose(3, {"x"}));
  EXPECT_EQ(chosen.n_skipped, 2) << "a is not read";
  const Resample both = resample(model(), log, choose(3));
  EXPECT_EQ(both.n_skipped, 4);
  std::vector<int> sorted = both.rows;
  std::sort(sorted.begin(), sorted.end());
  EXPECT_THAT(sorted, ElementsAre(0, 4, 6));
  // a feature that is no number at some states
  EXPECT_EQ(resample(model(), log, choose(1, {"log(x)"})).n_skipped, 3) << "log 0, and two gaps";
}

TEST(Resample, AFeatureThatDoesNotVaryCountsForNothing) {
  const CsvTable log = CsvTable::parse("x,a\n0,0.1\n1,0.1\n9,0.1\n3,0.1\n", "log.csv");
  EXPECT_THAT(resample(model(), log, choose(4)).rows, ElementsAre(3, 2, 0, 1));
  EXPECT_EQ(resample(model(), CsvTable::parse("x,a\n0.1,0.1\n0.1,0.1\n", "log.csv"), choose(2)).radius, 0);
}

TEST(Resample, SaysWhatItCannotDo) {
  const CsvTable log = CsvTable::parse("x,a\n0,0\n,1\n1,1\n", "log.csv");
  const auto refused = [&](const ResampleOptions& options) { return input_error_of([&] { resample(model(), log, options); }); };
  EXPECT_EQ(refused(choose(0)), "resample: n must be positive, got 0");
  EXPECT_EQ(refused(choose(3)), "log.csv: has 2 rows with a number in every feature, of 3, fewer than the n = 3 asked for");
  EXPECT_EQ(refused(choose(4, {"a"})), "log.csv: has 3 rows, fewer than the n = 4 asked for");
  EXPECT_THAT(refused(choose(1, {"x", "q7"})), HasSubstr("`features`: 'q7': "));
  EXPECT_THAT(refused(choose(1, {"dx"})), HasSubstr("log.csv: missing column 'dx'"));
  EXPECT_EQ(refused(choose(1, {"l"})), "`features`: 'l': is the same at every state, and measures nothing");
  EXPECT_EQ(refused(choose(1, {"ddx"})),
            "`features`: 'ddx': reads ddx, which is no part of the state: measure by coordinates, velocities, t and inputs");
  const CsvTable words = CsvTable::parse("x,a\n0,0\nfar,1\n", "log.csv");
  EXPECT_EQ(input_error_of([&] { resample(model(), words, choose(1)); }), "log.csv:3: column 'x': 'far' is not a finite number");
}

}  // namespace
}  // namespace gp2
