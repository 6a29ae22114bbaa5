#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "allocation_count.hpp"
#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "inference/problems.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t data_distance_seed = 40507;

View acceleration_of(const Posterior& posterior) { return View::constrained_acceleration(*posterior.prior().system); }

VectorXd distances(const Posterior& posterior, const MatrixXd& states) {
  return posterior.distance_from_data(acceleration_of(posterior), states);
}

// a particle in the plane whose one force is a latent along x; noise 0.1 of ddx, signal 2
struct Plane {
  Model model;
  ModelValues values;
  Observations at(const MatrixXd& states) const {
    return {states, View{View::Quantity::constrained_acceleration, {0}}, MatrixXd::Zero(1, states.cols()),
            VectorXd::Constant(1, 0.1)};
  }
  Posterior of(const MatrixXd& states) const { return {make_prior(model), {at(states)}, values}; }
};

Plane plane(const std::string& kernel, const VectorXd& kernel_values) {
  const std::string text = fmt::format(R"(
name = "plane"
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[[latent]]
kernel = "{}"
features = ["dx", "dy"]
directions = [["1"], ["0"]]
)",
                                       kernel);
  Plane plane{Model::parse(text, "plane.toml"), {}};
  plane.values.kernel = {kernel_values};
  plane.values.signal_stddev = {VectorXd::Constant(1, 2)};
  plane.values.noise_stddev = {VectorXd::Constant(1, 0.1)};
  return plane;
}

MatrixXd drawn_states(const Plane& plane, Index n, std::uint64_t stream) {
  RandomStream random(data_distance_seed, stream);
  MatrixXd states = MatrixXd::Zero(plane.model.system->layout().size(), n);
  for (Index i = 0; i < n; ++i) states.col(i).segment(2, 2) = test::random_vector(2, random);
  return states;
}

// T30 as it is written, for one latent of one direction
double formula(const MatrixXd& observed, const VectorXd& state, double variance, const auto& squared_distance) {
  const auto nearest = [&](const VectorXd& x, Index without_from, Index without_to) {
    double smallest = std::numeric_limits<double>::infinity();
    for (Index j = 0; j < observed.cols(); ++j) {
      if (j >= without_from && j < without_to) continue;
      smallest = std::min(smallest, squared_distance(VectorXd((x - observed.col(j)).segment(2, 2))));
    }
    return std::sqrt(variance * smallest);
  };
  const Index n = observed.cols(), margin = n / 20;
  std::vector<double> units;
  for (Index i = 0; i < n; ++i) units.push_back(nearest(observed.col(i), i - margin, i + margin + 1));
  std::sort(units.begin(), units.end());
  return nearest(state, 0, 0) / units[static_cast<std::size_t>(0.95 * static_cast<double>(n - 1))];
}

TEST(DataDistance, IsTheFormulaForEveryPrimitive) {
  const double pi = std::numbers::pi;
  const auto scaled = [](const VectorXd& d, double lx, double ly) { return std::pow(d[0] / lx, 2) + std::pow(d[1] / ly, 2); };
  const auto expect = [&](const std::string& kernel, const VectorXd& values, const auto& squared_distance) {
    const Plane p = plane(kernel, values);
    const MatrixXd observed = drawn_states(p, 40, 1), asked = 2 * drawn_states(p, 12, 2);
    const VectorXd got = distances(p.of(observed), asked);
    for (Index i = 0; i < asked.cols(); ++i) {
      const double expected = formula(observed, asked.col(i), std::pow(2 / 0.1, 2), squared_distance);
      EXPECT_NEAR(got[i], expected, 1e-12 * (1 + expected)) << kernel;
    }
  };
  expect("se", Eigen::Vector2d(0.7, 3), [&](const VectorXd& d) { return scaled(d, 0.7, 3); });
  expect("rq", Eigen::Vector3d(0.7, 3, 0.5), [&](const VectorXd& d) { return scaled(d, 0.7, 3); });
  expect("constant + linear", Eigen::Vector3d(1.5, 2, 0.5), [&](const VectorXd& d) { return 0.25 * scaled(d, 1.5, 2); });
  expect("periodic", Eigen::Vector4d(0.7, 2, 1.5, 4), [&](const VectorXd& d) {
    return 4 * std::pow(std::sin(pi * d[0] / 1.5) / 0.7, 2) + 4 * std::pow(std::sin(pi * d[1] / 4) / 2, 2);
  });
  VectorXd values(7);
  values << 0.7, 3, 1.5, 2, 5, 6, 0.3;
  expect("se*matern32 + linear", values,
         [&](const VectorXd& d) { return scaled(d, 0.7, 3) + scaled(d, 1.5, 2) + 0.09 * scaled(d, 5, 6); });
}

TEST(DataDistance, FreshStatesAreNearAndFastOnesAreFar) {
  for (const Index n : {30, 300}) {
    const Plane p = plane("se", Eigen::Vector2d(20, 20));  // the deviation hardly grows: one lengthscale says all
    const Posterior posterior = p.of(drawn_states(p, n, 3));
    const VectorXd near = distances(posterior, drawn_states(p, 400, 4));
    MatrixXd fast = drawn_states(p, 400, 5);
    for (Index i = 0; i < fast.cols(); ++i) fast.col(i).segment(2, 2) *= 8 / fast.col(i).segment(2, 2).norm();
    const auto share_far = [](const VectorXd& d) {
      return static_cast<double>((d.array() > Posterior::far_from_data).count()) / static_cast<double>(d.size());
    };
    EXPECT_LE(share_far(near), 0.05) << n;
    EXPECT_EQ(share_far(distances(posterior, fast)), 1) << n;
  }
}

TEST(DataDistance, AFeatureThatChangesNothingDoesNotMatter) {
  const Plane p = plane("se", Eigen::Vector2d(1, 1e6));
  const MatrixXd observed = drawn_states(p, 50, 6);
  MatrixXd moved = observed;
  moved.row(3) *= 100;
  EXPECT_LT(distances(p.of(observed), moved).maxCoeff(), 0.01);
}

TEST(DataDistance, NeighboursInTimeAreNoNeighbours) {
  const Plane p = plane("se", Eigen::Vector2d(1, 1));
  MatrixXd line = MatrixXd::Zero(5, 1000);  // one row after the other, 0.001 apart
  line.row(2).setLinSpaced(0, 0.999);
  VectorXd aside = VectorXd::Zero(5);
  aside.segment(2, 2) << 0.5, 0.05;
  // fifty rows before and after do not count
  EXPECT_NEAR(distances(p.of(line), aside)[0], 0.05 / 0.051, 1e-9);
}

TEST(DataDistance, StatesThatAreMeasuredTwiceAreOne) {
  const Plane p = plane("se", Eigen::Vector2d(1, 1));
  const MatrixXd once = drawn_states(p, 15, 10), asked = drawn_states(p, 20, 11);
  MatrixXd twice(once.rows(), 30);
  twice << once, once;
  const VectorXd expected = distances(p.of(once), asked), got = distances(p.of(twice), asked);
  EXPECT_LE((got - expected).cwiseAbs().maxCoeff(), 1e-12 * expected.maxCoeff());
}

TEST(DataDistance, IsSaidWhereThereIsNothingToCompareWith) {
  const Plane p = plane("se", Eigen::Vector2d(1, 1));
  const MatrixXd states = drawn_states(p, 3, 7);
  const Posterior one = p.of(states.leftCols(1));
  EXPECT_EQ(distances(one, states)[0], 0);
  EXPECT_TRUE(std::isnan(distances(one, states)[1]));
  EXPECT_TRUE(std::isinf(distances(p.of(states).without_data(), states)[0]));
  const Plane level = plane("constant", VectorXd());
  EXPECT_EQ(distances(level.of(states), 100 * states).maxCoeff(), 0);
}

TEST(DataDistance, ThePredictorSaysTheSameAndAllocatesNothing) {
  for (const test::Problem& p : test::problems(9, data_distance_seed)) {
    SCOPED_TRACE(p.name);
    const Posterior posterior(p.prior, p.observations, p.values);
    const VectorXd expected = distances(posterior, p.queries);
    const Predictor predictor(posterior);
    Predictor::Workspace workspace = predictor.make_workspace();
    for (Index i = 0; i < expected.size(); ++i) {
      const VectorXd state = p.queries.col(i);
      double got = 0;
      EXPECT_EQ(test::allocations_of([&] { got = predictor.distance_from_data(state, workspace); }), 0);
      EXPECT_NEAR(got, expected[i], 1e-12 * expected[i]);
    }
    EXPECT_EQ(posterior.distance_from_data(acceleration_of(posterior), p.queries, 4), expected);
  }
}

// features hold the values that parameters have where the state is
TEST(DataDistance, UnderAnotherSystemIsThatOfItsFeatures) {
  const Plane p = plane("se", Eigen::Vector2d(1, 1));
  const auto with_factor = [&](const char* c) {
    return Model::parse(test::changed(p.model.text, {{"[mechanics]", fmt::format("[parameters]\nc = {}\n[mechanics]", c)},
                                                     {"\"dx\", \"dy\"", "\"c*dx\", \"dy\""}}),
                        "plane.toml");
  };
  const Model home = with_factor("1.0"), other = with_factor("3.0");
  ModelValues values = p.values;
  values.parameters = VectorXd::Ones(1);
  const Posterior posterior(make_prior(home), {p.at(drawn_states(p, 40, 8))}, values);
  const View there = test::under(acceleration_of(posterior), make_other_system(home, other));
  const MatrixXd states = drawn_states(p, 10, 9);
  MatrixXd faster = states;
  faster.row(2) *= 3;
  const VectorXd expected = distances(posterior, faster), got = posterior.distance_from_data(there, states);
  EXPECT_LE((got - expected).cwiseAbs().maxCoeff(), 1e-12 * expected.maxCoeff());
  const Predictor predictor(posterior, there);
  Predictor::Workspace workspace = predictor.make_workspace();
  for (Index i = 0; i < states.cols(); ++i) {
    EXPECT_NEAR(predictor.distance_from_data(states.col(i), workspace), expected[i], 1e-12 * expected[i]);
  }
}

}  // namespace
}  // namespace gp2
