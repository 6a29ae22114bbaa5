#include "gp2/inference/likelihood.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;

constexpr std::uint64_t likelihood_seed = 40401;
constexpr double infinity = std::numeric_limits<double>::infinity();

double likelihood_of(const Problem& p, const Likelihood::Options& options = {}) {
  const Likelihood likelihood(p.prior, p.observations, p.values, options);
  Likelihood::Workspace workspace;
  return likelihood.evaluate(p.values, nullptr, workspace);
}

// The quadratic form and the log determinant lose ε times the condition number; mechanics with κ(M) of some hundreds come before.
double tolerance(const Problem& p, double value) {
  Index n = 0;
  for (const Observations& group : p.observations) n += group.values().size();
  return 1e3 * test::eps * test::condition(p) * (static_cast<double>(n) + std::abs(value));
}

TEST(LikelihoodTest, ReducedIsTheDenseMultivariateNormalDensity) {
  for (const Problem& p : test::problems(12, likelihood_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, likelihood_seed));
    const double dense = test::dense_negative_log_likelihood(p);
    EXPECT_NEAR(likelihood_of(p), dense, tolerance(p, dense));
    EXPECT_LT(tolerance(p, dense), 1e-6 * std::abs(dense)) << "too badly conditioned to test anything";
    EXPECT_NEAR(Posterior(p.prior, p.observations, p.values).negative_log_likelihood(), dense, tolerance(p, dense));
  }
}

TEST(LikelihoodTest, KeepsNothingBetweenCallsThatMattersToTheNext) {
  for (const Problem& p : test::problems(9, likelihood_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, likelihood_seed));
    Likelihood::Options options;
    options.noise_gradient = true;
    const Likelihood likelihood(p.prior, p.observations, p.values, options);
    Likelihood::Workspace used, fresh;
    ModelGradient gradient;
    ModelValues other = p.values;
    other.kernel[0] *= 1.3;
    other.signal_stddev[0] *= 0.7;
    other.noise_stddev[0] *= 2;
    likelihood.evaluate(other, &gradient, used);
    ModelGradient first, second;
    EXPECT_EQ(likelihood.evaluate(p.values, &first, used), likelihood.evaluate(p.values, &second, fresh));
    EXPECT_EQ(first.log_kernel, second.log_kernel);
    EXPECT_EQ(first.log_noise_stddev, second.log_noise_stddev);
  }
}

// Rows in which a constraint is not active are those of the model without it, and where it is those of the model that has it always.
TEST(LikelihoodTest, OfAConstraintThatComesAndGoesIsThatOfTheModelWithItOrWithout) {
  const std::string text = test::model_with_contacts().text;
  const std::string row = "{ expr = \"z - h*x^2 - 0.2*cos(y)\", when = \"touch > 0.5\" }";
  for (const bool is_active : {false, true}) {
    const Model always = Model::parse(test::changed(text, {{row, "\"z - h*x^2 - 0.2*cos(y)\""}}), "always");
    const Model other = is_active ? always : Model::parse(test::changed(text, {{row, ""}, {"lambda0(1)", "0"}}), "without");
    // the load of a row that is not there is that of none
    const Model switched = test::model_with_contacts();
    RandomStream random(likelihood_seed);
    MatrixXd states = test::random_matrix(switched.system->layout().size(), 12, random);
    states.bottomRows(1).setConstant(is_active ? 1 : 0);
    const auto likelihood = [&](const Model& model) {
      RandomStream draws(likelihood_seed + 1);
      const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt, false});
      const std::vector<Observations> data = {
          test::observe(switched, View::all(View::Quantity::constrained_acceleration, *switched.system), states, draws)};
      const ModelValues values = test::random_values(prior, data, draws);
      ModelGradient gradient;
      Likelihood::Workspace workspace;
      const double value = Likelihood(prior, data, values, {}).evaluate(values, &gradient, workspace);
      VectorXd all(1 + gradient.log_kernel[0].size());
      all << value, gradient.log_kernel[0];
      return all;
    };
    const VectorXd here = likelihood(switched), there = likelihood(other);
    EXPECT_LE((here - there).lpNorm<Eigen::Infinity>(), 1e-12 * there.lpNorm<Eigen::Infinity>()) << is_active;
  }
}

TEST(LikelihoodTest, FactorsOneRowPerFreeDirectionThatIsSeen) {
  const auto reduced_size = [](const std::string& name) {
    for (const Problem& p : test::problems(12, likelihood_seed)) {
      if (p.name == name) return Likelihood(p.prior, p.observations, p.values, {}).reduced_size();
    }
    return -1;
  };
  EXPECT_EQ(reduced_size("surface, every row"), 12 * 2);
  EXPECT_EQ(reduced_size("unicycle, every row"), 12 * 2);
  EXPECT_EQ(reduced_size("duffing, every row"), 12 * 1);
  EXPECT_EQ(reduced_size("duffing, unconstrained acceleration"), 12 * 2);
  EXPECT_EQ(reduced_size("double_pendulum, every row"), 12 * 2);
  EXPECT_EQ(reduced_size("double_pendulum, one row"), 12 * 1);
  EXPECT_EQ(reduced_size("slider_crank, every row"), 12 * 1) << "three rows, one of them redundant";
  EXPECT_EQ(reduced_size("surface, two rows in another order and the unconstrained acceleration"), 6 * 2 + 6 * 3);
  // x = 0 at every other state, where both rows vanish
  EXPECT_EQ(reduced_size("a row that vanishes at some states"), 6 * 3 + 6 * 1);
}

TEST(LikelihoodTest, ARowThatSaysNothingNewChangesNothing) {
  const std::string text = test::model("models/surface.toml").text;
  const std::string row = R"("p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1) - q3")";
  const std::string again = row + ",\n  \"10*(p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1) - q3)\"";
  const Model doubled = Model::parse(test::changed(text, {{row, again}}), "surface with a row twice");
  ASSERT_EQ(doubled.system->nc(), 2);
  Likelihood::Options options;
  options.gradient_parameters = {2, 3};
  for (Problem p : test::problems(12, likelihood_seed)) {
    // the multipliers of a row written twice are other numbers: each row carries its share
    if (!p.name.starts_with("surface") || p.name.ends_with("multipliers")) continue;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, likelihood_seed));
    ModelGradient gradient, gradient_doubled;
    Likelihood::Workspace workspace;
    const double value = Likelihood(p.prior, p.observations, p.values, options).evaluate(p.values, &gradient, workspace);
    p.prior.system = doubled.system;
    const double value_doubled =
        Likelihood(p.prior, p.observations, p.values, options).evaluate(p.values, &gradient_doubled, workspace);
    EXPECT_NEAR(value_doubled, value, tolerance(p, value));
    const double slope = gradient.parameters.lpNorm<Eigen::Infinity>();
    EXPECT_LE((gradient_doubled.parameters - gradient.parameters).lpNorm<Eigen::Infinity>(), tolerance(p, value) * (1 + slope));
  }
}

TEST(LikelihoodTest, IsInfiniteWhereAParameterMakesTheMassMatrixIndefinite) {
  const Model& model = test::model("models/unicycle.toml");
  for (Problem p : test::problems(9, likelihood_seed)) {
    if (!p.name.starts_with("unicycle")) continue;
    const int Ic = model.system->parameter_index("Ic");
    Likelihood::Options options;
    options.gradient_parameters = {Ic};
    const Likelihood likelihood(p.prior, p.observations, p.values, options);
    Likelihood::Workspace workspace;
    ModelValues moved = p.values;
    moved.parameters[Ic] = 0.0024;  // m R² = 0.0025
    ModelGradient gradient;
    gradient.parameters = VectorXd::Constant(1, 7);
    EXPECT_EQ(likelihood.evaluate(moved, &gradient, workspace), infinity);
    EXPECT_EQ(gradient.parameters, VectorXd::Constant(1, 7)) << "left as it was";
    EXPECT_TRUE(std::isfinite(likelihood.evaluate(p.values, &gradient, workspace))) << "and nothing is spoilt";
    p.values = moved;
    EXPECT_THROW(Likelihood(p.prior, p.observations, p.values, options), InputError);
    EXPECT_THROW(Posterior(p.prior, p.observations, p.values), InputError);
  }
}

TEST(LikelihoodTest, RefusesANoiseOrParametersThatItReducedOnce) {
  const Problem p = test::problems(9, likelihood_seed).front();
  ModelValues noisier = p.values, moved = p.values;
  noisier.noise_stddev[0] *= 2;
  moved.parameters[0] *= 1.01;
  const auto refusal = [&](const Likelihood::Options& options, const ModelValues& values) {
    Likelihood::Workspace workspace;
    return test::input_error_of(
        [&] { Likelihood(p.prior, p.observations, p.values, options).evaluate(values, nullptr, workspace); });
  };
  EXPECT_THAT(refusal({}, noisier), testing::HasSubstr("values: noise_stddev of a likelihood that gives no derivative in it must "
                                                       "be that which it was made with"));
  EXPECT_THAT(refusal({}, moved),
              testing::HasSubstr("values: parameters of a likelihood that gives no derivative in them must be "
                                 "those that it was made with"));
  EXPECT_THAT(refusal({{}, true}, moved), testing::HasSubstr("values: parameters of a likelihood"));
  // where one asks for them they are those of `values`
  Likelihood::Workspace workspace;
  EXPECT_EQ(Likelihood(p.prior, p.observations, p.values, {{}, true}).evaluate(noisier, nullptr, workspace),
            Likelihood(p.prior, p.observations, noisier, {}).evaluate(noisier, nullptr, workspace));
}

TEST(LikelihoodTest, IsInfiniteWhereTheCovarianceCannotBeFactored) {
  Problem p = test::problems(9, likelihood_seed).front();
  Likelihood::Workspace workspace;
  const Likelihood likelihood(p.prior, p.observations, p.values, {});
  ModelValues absurd = p.values;
  for (VectorXd& s : absurd.signal_stddev) s *= 1e200;
  EXPECT_EQ(likelihood.evaluate(absurd, nullptr, workspace), infinity);
}

TEST(PosteriorTest, RefusesANoiseTooSmallForDoublePrecision) {
  Problem p = test::problems(12, likelihood_seed).front();
  // every state twice: the covariance of the signal alone is singular
  Observations& group = p.observations[0];
  MatrixXd states = group.states();
  const Index n = states.cols();
  states.rightCols(n / 2) = states.leftCols(n / 2);
  group = test::with_states(group, states);
  for (VectorXd& s : p.values.signal_stddev) s *= 1e12;
  EXPECT_THROW(Posterior(p.prior, p.observations, p.values), NumericalError);
}

TEST(RowStddevTest, DividesByTheNumberOfColumns) {
  const MatrixXd values = (MatrixXd(2, 4) << 1, 1, 3, 3, 5, 5, 5, 5).finished();
  EXPECT_EQ(row_stddev(values), Eigen::Vector2d(1, 0));
}

}  // namespace
}  // namespace gp2
