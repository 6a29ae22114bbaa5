#include "gp2/training/hyperparameter.hpp"

#include <cmath>

#include <gtest/gtest.h>

#include "test_models.hpp"
#include "training/objective.hpp"

// Where a hyperparameter lives, its map, and its hyper-prior.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

Hyperparameter with(Hyperparameter h, double value, double lower, double upper) {
  h.value = value;
  h.lower = lower;
  h.upper = upper;
  return h;
}

// a positive one, a parameter, an entry of a loading that may be negative and one that may not
std::vector<Hyperparameter> one_of_each_map() {
  Hyperparameter entry = Hyperparameter::of(Kind::loading, 0, 1), positive_entry = Hyperparameter::of(Kind::loading, 0, 2);
  entry.size = 3;
  positive_entry.positive = true;
  return {with(Hyperparameter::of(Kind::kernel, 0, 0), 2, 0.1, 50), with(Hyperparameter::of(Kind::parameter, 0, 0), -0.25, -1, 4),
          with(entry, -0.75, -1e4, 1e4), with(positive_entry, 0.7, 1e-8, 1e4)};
}

TEST(HyperparameterTest, ItsCoordinateIsTheLogarithmTheShareOfItsBoxOrInUnitsOfItsSize) {
  const std::vector<Hyperparameter> all = one_of_each_map();
  EXPECT_EQ(all[0].coordinate(), std::log(2.0));
  EXPECT_EQ(all[1].coordinate(), 0.15);
  EXPECT_EQ(all[2].coordinate(), -0.25);
  EXPECT_EQ(all[3].coordinate(), std::log(0.7));
  for (const Hyperparameter& h : all) EXPECT_NEAR(h.value_at(h.coordinate()), h.value, 4 * test::eps * std::abs(h.value));
}

TEST(HyperparameterTest, ItsValueStaysWithinTheBounds) {
  for (const Hyperparameter& h : one_of_each_map()) {
    EXPECT_EQ(h.value_at(h.lower_coordinate() - 1), h.lower);
    EXPECT_EQ(h.value_at(h.upper_coordinate() + 1), h.upper);
  }
}

TEST(HyperparameterTest, TheSlopesOfAMapAreThoseOfDifferences) {
  for (const Hyperparameter& h : one_of_each_map()) {
    const CoordinateMap map = h.map();
    const double x = h.coordinate();
    const auto value = [&](double at) -> VectorXd { return VectorXd::Constant(1, map.value(at)); };
    const auto logarithm = [&](double at) -> VectorXd { return VectorXd::Constant(1, std::log(std::abs(map.value(at)))); };
    EXPECT_TRUE(test::matches(VectorXd::Constant(1, map.value_slope(h.value)), test::central_difference(value, x, 0.1)));
    EXPECT_TRUE(test::matches(VectorXd::Constant(1, map.logarithm_slope(h.value)), test::central_difference(logarithm, x, 0.1)));
  }
}

TEST(HyperPriorTest, CountsInDeviationsAndItsSlopeIsThatOfDifferencesInEveryMap) {
  for (const HyperPrior& prior :
       {HyperPrior{HyperPrior::Form::normal, 1.5, 0.5}, HyperPrior{HyperPrior::Form::log_normal, 1.5, 0.5}}) {
    const bool normal = prior.form == HyperPrior::Form::normal;
    EXPECT_DOUBLE_EQ(prior.standardised(normal ? 2.5 : 1.5 * std::exp(1.0)), 2);
    EXPECT_EQ(prior.standardised(1.5), 0);
    for (const CoordinateMap& map : {CoordinateMap{}, CoordinateMap{false, 0.5, 2.5}}) {
      const double value = 1.9;
      const auto at = [&](double x) -> VectorXd { return VectorXd::Constant(1, prior.standardised(map.value(x))); };
      EXPECT_TRUE(test::matches(VectorXd::Constant(1, prior.standardised_slope(value, map)),
                                test::central_difference(at, map.coordinate(value), 0.1)));
    }
  }
}

TEST(HyperPriorTest, OfAFamilyIsTheGaussianOfAllOfThem) {
  constexpr double rho = 0.9, stddev = 2;
  const VectorXd z{{0.3, -1.2, 2.5, 0.7}};
  const int n_family = 3;
  std::vector<Hyperparameter> all;
  for (int k = 0; k < 4; ++k) {
    Hyperparameter& h = all.emplace_back(Hyperparameter::of(Hyperparameter::Kind::kernel, 0, static_cast<std::size_t>(k)));
    h.value = 5 * std::exp(stddev * z[k]);
    h.hyperprior = {HyperPrior::Form::log_normal, 5, stddev};
    if (k < n_family) h.hyperprior = {HyperPrior::Form::log_normal, 5, stddev, "lengthscale", rho};
  }
  all.push_back(Hyperparameter::of(Hyperparameter::Kind::parameter, 0, 0));  // without a hyper-prior
  MatrixXd covariance = MatrixXd::Identity(5, 5);
  covariance.topLeftCorner(n_family, n_family).setConstant(rho);
  covariance.diagonal().setOnes();
  VectorXd of_all = VectorXd::Zero(5);
  of_all.head(4) = z;
  const VectorXd solved = covariance.inverse() * of_all;
  VectorXd gradient = VectorXd::Zero(5);
  // a condition of 1 + 2ρ over 1 − ρ
  EXPECT_NEAR(negative_log_hyperpriors(all, &gradient), 0.5 * of_all.dot(solved), 1e-13 * of_all.squaredNorm());
  EXPECT_LE((gradient - solved / stddev).norm(), 1e-13 * solved.norm());
}

TEST(HyperparameterTest, TheGradientIsReadWhereTheValueIsWritten) {
  ModelValues values{{VectorXd::Zero(2)}, {VectorXd::Zero(2)}, {MatrixXd::Zero(2, 3)}, {VectorXd::Zero(2)}, VectorXd::Zero(2)};
  ModelGradient gradient = ModelGradient::zero(values);
  const auto expect_written = [&](Hyperparameter h, const double& value, double& slope, double expected) {
    h.value = 0.5;
    h.write(values);
    EXPECT_EQ(value, 0.5);
    slope = 7;
    EXPECT_EQ(h.likelihood_slope(gradient), expected);
  };
  expect_written(Hyperparameter::of(Kind::kernel, 0, 1), values.kernel[0][1], gradient.log_kernel[0][1], 7);
  expect_written(Hyperparameter::of(Kind::signal_stddev, 0, 0), values.signal_stddev[0][0], gradient.log_signal_stddev[0][0], 7);
  expect_written(Hyperparameter::of(Kind::noise_stddev, 0, 1), values.noise_stddev[0][1], gradient.log_noise_stddev[0][1], 7);
  const Hyperparameter parameter = with(Hyperparameter::of(Kind::parameter, 0, 1), 0, -1, 3);
  expect_written(parameter, values.parameters[1], gradient.parameters[1], 7 * 4);
  Hyperparameter entry = Hyperparameter::of(Kind::loading, 0, 3);
  entry.size = 2;
  expect_written(entry, values.free_loading[0](1, 1), gradient.free_loading[0](1, 1), 7 * 2);
  entry.positive = true;
  expect_written(entry, values.free_loading[0](1, 1), gradient.free_loading[0](1, 1), 7 * 0.5);

  Hyperparameter shared = with(Hyperparameter::of(Kind::shared_signal_stddev, 0, 0), 3, 0.5, 10);
  shared.column_scale = Eigen::Vector2d(1, 0.5);
  values.signal_stddev[0].setOnes();
  shared.write(values);
  EXPECT_EQ(values.signal_stddev[0], Eigen::Vector2d(3, 1.5));
  gradient.log_signal_stddev[0] = Eigen::Vector2d(4, 5);
  EXPECT_EQ(shared.likelihood_slope(gradient), 9);
}

TEST(HyperparameterTest, AsksForWhatTheLikelihoodMustDifferentiate) {
  Likelihood::Options options;
  Hyperparameter::of(Kind::kernel, 0, 0).ask_for_gradient(options);
  EXPECT_FALSE(options.noise_gradient);
  EXPECT_TRUE(options.gradient_parameters.empty());
  Hyperparameter::of(Kind::noise_stddev, 0, 0).ask_for_gradient(options);
  Hyperparameter::of(Kind::parameter, 0, 4).ask_for_gradient(options);
  EXPECT_TRUE(options.noise_gradient);
  EXPECT_EQ(options.gradient_parameters, std::vector<int>{4});
}

}  // namespace
}  // namespace gp2
