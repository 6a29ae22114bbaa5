#include "gp2/laplace.hpp"

#include <cmath>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t seed = 60611;

/// ddx = p x + r + friction, two parameters in which the likelihood is quadratic: their covariance is (Zᵀ C⁻¹ Z)⁻¹.
const ModelFile& line() {
  static const ModelFile model = ModelFile::parse(R"toml(
name        = "line"
coordinates = ["x"]
[parameters]
p = { value = 0.7, bounds = [-5, 5] }
r = { value = 0.2, bounds = [-5, 5] }
[mechanics]
mass  = [["1"]]
force = ["p*x + r"]
[[latent]]
kernel   = "se"
features = ["dx"]
[noise]
ddq = 0.3
[truth]
acceleration = ["0"]
[sampling]
x  = [-1, 2]
dx = [-1, 1]
)toml",
                                                  "line");
  return model;
}

struct Problem {
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
};

Problem problem(const ModelFile& model, int n, const std::vector<std::string>& estimated, std::uint64_t of_seed = seed,
                double noise_stddev = 0.3) {
  GenerateOptions options{n, of_seed, VectorXd::Constant(model.system->nq(), noise_stddev)};
  const GeneratedData data = generate(model, options);
  PriorOptions with_force;
  with_force.mean = Prior::Mean::force;
  Problem p{make_prior(model, with_force), {}, {}};
  p.observations.push_back({data.states, View::all(View::Quantity::constrained_acceleration, *model.system), data.accelerations,
                            options.noise_stddev});
  p.hyperparameters = default_hyperparameters(p.prior, p.observations, estimated, {});
  return p;
}

Problem only(Problem p, const std::vector<Kind>& kinds) {
  std::erase_if(p.hyperparameters,
                [&](const Hyperparameter& h) { return std::find(kinds.begin(), kinds.end(), h.kind) == kinds.end(); });
  return p;
}

TEST(LaplaceTest, IsExactWhereTheLikelihoodIsQuadratic) {
  const Problem p = only(problem(line(), 30, {"p", "r"}), {Kind::parameter});
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);

  const Observations& observed = p.observations.front();
  const ModelValues values = model_values(p.prior, p.observations, p.hyperparameters);
  const Index n = observed.states.cols();
  const double s = values.signal_stddev[0][0], lengthscale = values.kernel[0][0];
  MatrixXd C(n, n), Z(n, 2);
  for (Index i = 0; i < n; ++i) {
    for (Index j = 0; j < n; ++j) {
      const double r = (observed.states(1, i) - observed.states(1, j)) / lengthscale;
      C(i, j) = s * s * std::exp(-0.5 * r * r) + (i == j ? 0.09 : 0);
    }
    Z.row(i) << observed.states(0, i), 1;
  }
  const MatrixXd covariance = (Z.transpose() * C.llt().solve(Z)).inverse();
  // gradients are linear here: what differences leave is rounding over the step
  EXPECT_NEAR(uncertainty.stddev[0], std::sqrt(covariance(0, 0)), 1e-8);
  EXPECT_NEAR(uncertainty.stddev[1], std::sqrt(covariance(1, 1)), 1e-8);
  EXPECT_NEAR(uncertainty.correlation(0, 1), covariance(0, 1) / std::sqrt(covariance(0, 0) * covariance(1, 1)), 1e-7);
  EXPECT_TRUE(uncertainty.held.empty());
  EXPECT_EQ(uncertainty.undetermined.cols(), 0);
}

TEST(LaplaceTest, DistanceFromTheOptimumIsMeasuredInStandardDeviations) {
  Problem p = only(problem(line(), 30, {"p"}), {Kind::parameter});
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
  const LaplaceUncertainty at_optimum = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_LT(at_optimum.distance_from_optimum, 1e-3);
  p.hyperparameters[0].value += 2.5 * at_optimum.stddev[0];
  EXPECT_NEAR(laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1).distance_from_optimum, 2.5, 2e-3);
}

TEST(LaplaceTest, TheDeviationOfALogarithmOfNoiseIsThatOfCounting) {
  // noise alone: log σ of n numbers is known to 1/√(2n)
  Problem p = problem(line(), 200, {});
  p.observations[0].estimate_noise = true;
  p.hyperparameters = default_hyperparameters(p.prior, p.observations, {}, Protocol{.hyperprior = false});
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::signal_stddev) h.value = h.lower = 1e-6;
  }
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  std::erase_if(p.hyperparameters, [](const Hyperparameter& h) { return h.kind == Kind::kernel; });
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::signal_stddev) h.upper = 2e-6;
  }
  p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  ASSERT_EQ(p.hyperparameters.back().kind, Kind::noise_stddev);
  EXPECT_NEAR(uncertainty.stddev[static_cast<Index>(p.hyperparameters.size()) - 1], 1 / std::sqrt(400.0), 1e-4);
}

TEST(LaplaceTest, WhatIsAtABoundIsHeld) {
  Problem p = only(problem(line(), 20, {"p", "r"}), {Kind::parameter});
  p.hyperparameters[0].value = p.hyperparameters[0].lower;
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_EQ(uncertainty.held, std::vector<int>{0});
  EXPECT_EQ(uncertainty.stddev[0], 0);
  EXPECT_EQ(uncertainty.correlation(0, 1), 0);
  EXPECT_GT(uncertainty.stddev[1], 0);
}

TEST(LaplaceTest, ParametersThatEnterByTheirSumOnlyAreNamedUndetermined) {
  std::string text = line().text;
  text.replace(text.find("p*x + r"), 7, "p + 2*r");
  const ModelFile model = ModelFile::parse(text, "sum");
  const Problem p = only(problem(model, 20, {"p", "r"}), {Kind::parameter});
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_TRUE(std::isinf(uncertainty.stddev[0]));
  EXPECT_TRUE(std::isinf(uncertainty.stddev[1]));
  EXPECT_TRUE(std::isnan(uncertainty.correlation(0, 1)));
  ASSERT_EQ(uncertainty.undetermined.cols(), 1);
  // p + 2 r stays as it is along (2, −1)
  EXPECT_NEAR(uncertainty.undetermined(0, 0) / uncertainty.undetermined(1, 0), -2, 1e-4);
}

TEST(LaplaceTest, IsTheSameForAnyNumberOfThreads) {
  const Problem p = problem(line(), 20, {"p", "r"});
  const LaplaceUncertainty one = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  const LaplaceUncertainty three = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 3);
  EXPECT_EQ(one.stddev, three.stddev);
}

// the spread of estimates over data sets, and what each data set says of it
TEST(LaplaceTest, StatedDeviationsCoverTheErrorsOfManyFits) {
  constexpr int n_sets = 150;
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  options.max_escapes = 0;
  double sum_of_squares = 0;
  for (int set = 0; set < n_sets; ++set) {
    Problem p = problem(line(), 25, {"p"}, seed + 1 + static_cast<std::uint64_t>(set));
    p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
    const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
    for (std::size_t k = 0; k < p.hyperparameters.size(); ++k) {
      const Hyperparameter& h = p.hyperparameters[k];
      if (h.kind != Kind::parameter) continue;
      sum_of_squares += std::pow((h.value - 0.7) / uncertainty.stddev[static_cast<Index>(k)], 2);
    }
  }
  // χ² of 150 over 150: 1 ± 0.115
  EXPECT_NEAR(sum_of_squares / n_sets, 1, 0.35);
}

}  // namespace
}  // namespace gp2
