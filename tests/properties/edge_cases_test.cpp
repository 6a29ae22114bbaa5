#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/QR>

#include "gp2/fit.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/simulation/generate.hpp"
#include "inference/problems.hpp"
#include "properties/chain_of_links.hpp"

// Data at their edges: points that come twice, one point, nothing that varies.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t edge_cases_seed = 20271;

Problem surface_problem(int n) {
  const Model& model = test::model("models/surface.toml");
  RandomStream random(edge_cases_seed);
  Problem p{"surface", make_prior(model), {}, {}, test::draw(model, 5, edge_cases_seed + 1).states, {}};
  p.observations = {test::observe(model, View::all(Quantity::constrained_acceleration, *model.system),
                                  test::draw(model, n, edge_cases_seed).states, random)};
  p.values = test::random_values(p.prior, p.observations, random);
  return p;
}

// y₁ and y₂ of one state say what their mean says at half the variance
TEST(EdgeCaseTest, APointMeasuredTwiceIsOneOfHalfTheVariance) {
  const Problem p = surface_problem(30);
  const Observations& first = p.observations[0];
  MatrixXd again = first.values();
  RandomStream random(edge_cases_seed, 2);
  for (double& y : again.reshaped()) y += 0.1 * random.normal();
  for (const double apart : {0.0, 1e-15, 1e-12}) {
    SCOPED_TRACE(fmt::format("apart {:g}, seed {}", apart, edge_cases_seed));
    MatrixXd moved = first.states();
    for (double& entry : moved.reshaped()) entry *= 1 + apart * random.normal();
    Observations twice = first;
    twice.append(test::with_states(first.with_values(again), moved));
    const Observations once = first.with_values(0.5 * (first.values() + again));
    ModelValues half = p.values;
    half.noise_stddev[0] /= std::sqrt(2.0);
    const Posterior of_twice(p.prior, {twice}, p.values), of_once(p.prior, {once}, half);
    const View view = View::all(Quantity::unconstrained_acceleration, *p.prior.system);
    const Posterior::Joint joint = of_twice.joint(view, p.queries), expected = of_once.joint(view, p.queries);
    // the two differ by the rounding of K̃ + I, and by the distance times the slopes
    const double tolerance = (1e3 * eps * test::condition(p) + 1e2 * apart * test::condition(p));
    EXPECT_LE(test::largest(joint.mean - expected.mean), tolerance * (1 + test::largest(expected.mean)));
    EXPECT_LE(test::largest(joint.covariance - expected.covariance), tolerance * (1 + test::largest(expected.covariance)));
    EXPECT_EQ(of_twice.reduced_size(), 2 * of_once.reduced_size());
  }
}

struct Fitted {
  std::vector<Hyperparameter> start;
  Fit fit;
};

Fitted quick_fit(const Prior& prior, const std::vector<Observations>& observations) {
  std::vector<Hyperparameter> start = default_hyperparameters(prior, observations, {}, {});
  FitOptions options;
  options.n_restarts = 2;
  options.max_iterations = 20;
  options.n_threads = 1;
  return {start, fit(prior, observations, start, options)};
}

void expect_usable(const Fitted& fitted, const Problem& p) {
  for (const Hyperparameter& h : fitted.start) {
    EXPECT_TRUE(std::isfinite(h.value) && h.lower < h.upper && h.lower <= h.value && h.value <= h.upper)
        << h.name << ": " << h.value << " in [" << h.lower << ", " << h.upper << "]";
  }
  EXPECT_TRUE(std::isfinite(fitted.fit.report.objective));
  const View ddq = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const Posterior::Marginal marginal = fitted.fit.posterior.marginal(ddq, p.queries);
  EXPECT_TRUE(marginal.mean.allFinite());
  EXPECT_TRUE(marginal.covariance.allFinite());
}

TEST(EdgeCaseTest, OnePointIsDataEnough) {
  Problem p = surface_problem(1);
  p.observations[0] = test::with_estimated_noise(p.observations[0], false);
  const Fitted fitted = quick_fit(p.prior, p.observations);
  expect_usable(fitted, p);
  // nothing varies, so that scales are those of the values' own size
  const Scales scales = default_scales(p.prior, p.observations);
  EXPECT_EQ(scales.acceleration_stddev, p.observations[0].values().col(0).cwiseAbs());
  p.observations[0] = test::with_estimated_noise(p.observations[0], true);
  expect_usable(quick_fit(p.prior, p.observations), p);
}

TEST(EdgeCaseTest, OutputsThatDoNotVaryHaveTheScaleOfTheirSize) {
  Problem p = surface_problem(12);
  // 0.1 is no binary number: the mean of many rounds, and the spread is 1e-17, not 0
  MatrixXd values = p.observations[0].values();
  values.row(0).setConstant(0.1);
  values.row(1).setConstant(-30);
  p.observations[0] = p.observations[0].with_values(values);
  const Scales scales = default_scales(p.prior, p.observations);
  EXPECT_EQ(scales.acceleration_stddev[0], 0.1);
  EXPECT_EQ(scales.acceleration_stddev[1], 30);
  EXPECT_EQ(scales.output_stddev[0][0], 0.1);
  expect_usable(quick_fit(p.prior, p.observations), p);
}

TEST(EdgeCaseTest, OutputsThatAreZeroHaveTheScaleOfTheOthersKineticEnergy) {
  Problem p = surface_problem(12);
  const VectorXd spread = row_stddev(p.observations[0].values());
  MatrixXd values = p.observations[0].values();
  values.row(0).setZero();
  p.observations[0] = p.observations[0].with_values(values);
  const Scales scales = default_scales(p.prior, p.observations);
  // the three masses are equal
  const double kinetic = (spread[1] * spread[1] + spread[2] * spread[2]) / 3;
  EXPECT_NEAR(scales.acceleration_stddev[0], std::sqrt(kinetic), 8 * eps * std::sqrt(kinetic));
  expect_usable(quick_fit(p.prior, p.observations), p);
  p.observations[0] = p.observations[0].with_values(MatrixXd::Zero(3, 12));
  expect_usable(quick_fit(p.prior, p.observations), p);
}

TEST(EdgeCaseTest, FeaturesThatDoNotVarySayNothing) {
  Problem p = surface_problem(12);
  MatrixXd states = p.observations[0].states();
  states.row(6 + 1).setConstant(0.1);  // u1
  p.observations[0] = test::with_states(p.observations[0], states);
  expect_usable(quick_fit(p.prior, p.observations), p);
  // a constant feature under any lengthscale: the same likelihood
  Likelihood::Workspace workspace;
  const Likelihood likelihood(p.prior, p.observations, p.values, {});
  const double value = likelihood.evaluate(p.values, nullptr, workspace);
  ModelValues other = p.values;
  other.kernel[0][6] *= 1e-3;
  EXPECT_EQ(likelihood.evaluate(other, nullptr, workspace), value);
  // all of them: every sample at one and the same state
  p.observations[0] = test::with_states(p.observations[0], states.col(0).replicate(1, states.cols()));
  expect_usable(quick_fit(p.prior, p.observations), p);
}

// 15 coordinates of which 5 are free: too many choices to try them all
TEST(EdgeCaseTest, OfManyCoordinatesThoseAreFoundThatDetermineTheOthers) {
  const Model chain = Model::parse(test::chain_of_links(5), "chain");
  const System& system = *chain.system;
  const GeneratedData data = generate(chain, {8, edge_cases_seed, VectorXd::Zero(system.nq())});
  const auto rows = dependent_columns(system, data.states, system.parameter_values(), data.accelerations);
  ASSERT_TRUE(rows.has_value());
  ASSERT_EQ(rows->size(), 5U);
  for (const UdwadiaKalaba& projection : require_mechanics(system, data.states, system.parameter_values()).projections) {
    EXPECT_EQ(Eigen::ColPivHouseholderQR<MatrixXd>(projection.T()(*rows, Eigen::all)).rank(), 5);
  }
}

// n − 1 constraints leave one direction; n leave none, and there is nothing to learn
TEST(EdgeCaseTest, AsManyConstraintsAsCoordinatesLeaveNothingToLearn) {
  const auto model = [](const std::string& constraints) {
    return Model::parse(R"toml(
name = "linkage"
coordinates = ["x", "y", "z"]
[mechanics]
mass  = [["2", "0", "0"], ["0", "1", "0.5"], ["0", "0.5", "1"]]
force = ["0", "0", "-9.81"]
[constraints]
position = [)toml" + constraints +
                            R"toml(]
[[latent]]
kernel     = "se"
features   = ["x", "dx"]
directions = "acceleration"
)toml",
                        "linkage");
  };
  RandomStream random(edge_cases_seed);
  const MatrixXd states = test::random_matrix(7, 15, random);
  for (const auto& [constraints, freedom] : std::vector<std::pair<std::string, int>>{
           {R"-("x - sin(y)", "z - x*y")-", 1}, {R"-("x - sin(y)", "z - x*y", "x + 2*y + 3*z - 1")-", 0}}) {
    SCOPED_TRACE(constraints);
    const Model linkage = model(constraints);
    Problem p{"linkage", make_prior(linkage), {}, {}, states.leftCols(4), {}};
    p.observations = {test::observe(linkage, View::all(Quantity::constrained_acceleration, *linkage.system), states, random)};
    const Fitted fitted = quick_fit(p.prior, p.observations);
    expect_usable(fitted, p);
    EXPECT_EQ(fitted.fit.posterior.reduced_size(), 15 * freedom);
    const MechanicsBatch mechanics = require_mechanics(*linkage.system, p.queries, VectorXd());
    const Posterior::Marginal marginal = fitted.fit.posterior.marginal(p.observations[0].view(), p.queries);
    for (int i = 0; i < 4; ++i) {
      const MatrixXd A = mechanics.values.A(i);
      const VectorXd ddq = marginal.mean.col(i);
      EXPECT_LE(test::largest(A * ddq - mechanics.values.b(i)), 1e3 * eps * (1 + test::largest(A) * test::largest(ddq)));
    }
    if (freedom > 0) continue;
    EXPECT_LE(test::largest(marginal.covariance), 1e-20 * (1 + test::largest(p.observations[0].values())));
  }
}

}  // namespace
}  // namespace gp2
