#include "prior/random_features.hpp"

#include <cmath>
#include <string>
#include <vector>

#include <fmt/core.h>
#include <gtest/gtest.h>

#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t random_features_seed = 50505;
const std::vector<std::string> three_features = {"a", "b", "c"};

struct Case {
  Kernel kernel;
  VectorXd values;
  MatrixXd points;  // (n × D)
  MatrixXd covariance;
};

Case make_case(const std::string& text) {
  RandomStream random(random_features_seed);
  Case c{Kernel::parse(text, three_features), {}, MatrixXd(4, 3), MatrixXd(4, 4)};
  c.values.resize(static_cast<Index>(c.kernel.parameters().size()));
  for (double& value : c.values) value = std::exp2(2 * random.uniform() - 1);
  for (double& entry : c.points.reshaped()) entry = 0.7 * random.normal();
  c.covariance = c.kernel.evaluate(c.points, c.points, c.values);
  return c;
}

MatrixXd covariance_of_features(const Case& c, int n_features, std::uint64_t stream) {
  RandomStream random(random_features_seed, stream);
  const RandomFeatures features(c.kernel, c.values, n_features, random);
  MatrixXd psi(features.size(), c.points.rows());
  for (Index j = 0; j < psi.cols(); ++j) features.evaluate(c.points.row(j).transpose(), psi.col(j));
  return psi.transpose() * psi;
}

// mean over draws of the features, and the standard deviation of one draw
struct Estimate {
  MatrixXd mean, stddev;
};

constexpr int n_draws = 60;

Estimate estimate(const Case& c, int n_features) {
  MatrixXd sum = MatrixXd::Zero(4, 4), squares = MatrixXd::Zero(4, 4);
  for (int draw = 0; draw < n_draws; ++draw) {
    const MatrixXd error = covariance_of_features(c, n_features, static_cast<std::uint64_t>(draw)) - c.covariance;
    sum += error;
    squares += error.cwiseAbs2();
  }
  const MatrixXd mean = sum / n_draws;
  return {mean + c.covariance, (squares / n_draws - mean.cwiseAbs2()).cwiseMax(0).cwiseSqrt()};
}

TEST(RandomFeaturesTest, HaveTheCovarianceOfTheirKernel) {
  for (const char* text : {"se", "matern32", "matern52", "rq", "periodic", "linear", "constant", "se + linear*periodic",
                           "rq*periodic", "constant + matern52*constant", "linear*linear",
                           "se*matern32*linear + linear + constant", "linear*linear*se", "periodic*periodic"}) {
    const Case c = make_case(text);
    const Estimate found = estimate(c, 400);
    for (Index i = 0; i < 4; ++i) {
      for (Index j = 0; j <= i; ++j) {
        // five standard errors of the mean over draws
        EXPECT_NEAR(found.mean(i, j), c.covariance(i, j),
                    5 * found.stddev(i, j) / std::sqrt(n_draws) + 1e-12 * (1 + std::abs(c.covariance(i, j))))
            << text << ", points " << i << " and " << j << ", seed " << random_features_seed;
      }
    }
  }
}

TEST(RandomFeaturesTest, ErrFourTimesLessWithSixteenTimesAsMany) {
  for (const char* text : {"se", "matern32", "periodic", "se*linear"}) {
    const Case c = make_case(text);
    // the spread of a spread over 60 draws is 9 %; over the pairs of points they average
    const double few = estimate(c, 120).stddev.mean(), many = estimate(c, 1920).stddev.mean();
    EXPECT_NEAR(few / many, 4, 1) << text;
    EXPECT_LT(many, 0.05 * c.covariance.cwiseAbs().maxCoeff()) << text;
  }
}

TEST(RandomFeaturesTest, HaveTheExactVarianceOfStationaryKernels) {
  for (const char* text : {"se", "matern32", "matern52", "rq", "periodic", "se*periodic", "se + constant"}) {
    const Case c = make_case(text);
    const MatrixXd found = covariance_of_features(c, 10, 1);
    EXPECT_LE((found - c.covariance).diagonal().cwiseAbs().maxCoeff(), 1e-13 * c.covariance(0, 0)) << text;
    EXPECT_GT((found - c.covariance).cwiseAbs().maxCoeff(), 1e-6) << text << ": nothing was random";
  }
}

TEST(RandomFeaturesTest, AreExactForPolynomialKernels) {
  for (const char* text :
       {"linear", "constant", "linear + constant", "linear*linear", "constant*linear + linear*linear*linear"}) {
    const Case c = make_case(text);
    const MatrixXd found = covariance_of_features(c, 2, 1);
    EXPECT_LE((found - c.covariance).cwiseAbs().maxCoeff(), 1e-13 * (1 + c.covariance.cwiseAbs().maxCoeff())) << text;
  }
}

TEST(RandomFeaturesTest, AreAsManyAsAskedForRoundedUp) {
  const auto size = [](const std::string& text, int n_features) {
    const Case c = make_case(text);
    RandomStream random(random_features_seed);
    return RandomFeatures(c.kernel, c.values, n_features, random).size();
  };
  EXPECT_EQ(size("se", 2000), 2000);
  EXPECT_EQ(size("se", 1), 2);
  EXPECT_EQ(size("se*linear", 7), 12);
  EXPECT_EQ(size("linear", 2000), 3);
  EXPECT_EQ(size("se + linear*linear + constant", 100), 100 + 9 + 1);
}

TEST(RandomFeaturesTest, AreSinesAndCosinesWhateverTheAngle) {
  // one frequency, found from a point where its angle is small; elsewhere the angle is as good as its rounding
  const Kernel kernel = Kernel::parse("se", std::vector<std::string>{"a"});
  RandomStream random(random_features_seed);
  const RandomFeatures features(kernel, VectorXd::Ones(1), 2, random);
  const auto at = [&](double x) {
    VectorXd psi(2);
    features.evaluate(VectorXd::Constant(1, x), psi);
    return psi;
  };
  const double tiny = 1e-3;
  const double frequency = std::asin(at(tiny)[1]) / tiny;
  for (const double x : {0.0, 0.1, -0.4, 1.0, 2.0, -3.0, 17.0, -1e3}) {
    const double angle = frequency * x;
    EXPECT_NEAR(at(x)[0], std::cos(angle), 1e4 * test::eps * (1 + std::abs(angle))) << x;
    EXPECT_NEAR(at(x)[1], std::sin(angle), 1e4 * test::eps * (1 + std::abs(angle))) << x;
  }
  for (const double x : {1e10, -1e15, 1e17, 1e30, 1e300}) EXPECT_NEAR(at(x).norm(), 1, 1e-14) << x;
  EXPECT_TRUE(at(std::nan("")).hasNaN());
}

TEST(RandomFeaturesTest, StayFiniteAtTheEdgesOfTheParameters) {
  for (const char* text : {"rq", "periodic", "matern32"}) {
    for (const double edge : {1e-3, 1e6}) {
      Case c = make_case(text);
      c.values.setConstant(edge);
      EXPECT_TRUE(covariance_of_features(c, 20, 1).allFinite()) << text << " at " << edge;
    }
  }
}

}  // namespace
}  // namespace gp2
