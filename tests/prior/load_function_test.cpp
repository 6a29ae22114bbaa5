#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/prior/latent_spec.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// Functions of the state that read λ₀: their derivatives, what they read, and which parameters they hold.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;

constexpr std::uint64_t load_function_seed = 20208;

// Its rows go on being independent off the constraint, where differences are taken.
std::vector<std::string> models_with_independent_rows() {
  std::vector<std::string> files;
  for (const std::string& file : test::every_model()) {
    if (!test::has_redundant_rows(test::model(file))) files.push_back(file);
  }
  return files;
}

// along each force: μ √(λ₀² + 1) tanh(dq), of each row in turn
Latent loaded(const std::shared_ptr<const System>& system) {
  LatentSpec spec{.name = "friction", .kernel = "se", .features = {}, .base = Latent::Base::force};
  for (int row = 1; row <= system->nc(); ++row) spec.features.push_back(fmt::format("lambda0({})", row));
  for (int j = 0; j < system->nq(); ++j) {
    const std::string first = system->parameters().front().name,
                      velocity = system->coordinates()[static_cast<std::size_t>(j)].velocity();
    spec.directions.push_back(
        {fmt::format("-{}*sqrt(lambda0({})^2 + 1)*tanh({})", first, 1 + j % system->nc(), velocity), velocity});
  }
  return make_prior(system, {spec}).latents.front();
}

class LoadFunctionOf : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, LoadFunctionOf, testing::ValuesIn(models_with_independent_rows()), test::model_test_name);

TEST_P(LoadFunctionOf, ItsDerivativesMatchDifferences) {
  const std::shared_ptr<const System> system = test::model(GetParam()).system;
  const Latent latent = loaded(system);
  const VectorXd theta = system->parameter_values();
  MatrixXd states = test::draw(test::model(GetParam()), 4, load_function_seed).states;
  states = states.array().isNaN().select(0.1, states);
  double size = 0;
  for (const auto& function : {latent.features, latent.directions}) {
    const VectorXd parameters = function == latent.features ? VectorXd() : theta;
    const auto evaluator = function->make_evaluator(parameters);
    VectorXd derivatives(std::ssize(evaluator->entries())), values(function->size());
    for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
      const VectorXd x = states.col(i);
      evaluator->evaluate(x, values);
      const VectorXd expected = function->evaluate(x, parameters);
      EXPECT_LE(test::largest(values - expected), 1e3 * eps * (1 + test::largest(expected)));
      evaluator->differentiate(x, derivatives);
      for (int k = 0; k < static_cast<int>(x.size()); ++k) {
        SCOPED_TRACE(fmt::format("{}, state {}, entry {}, seed {}", GetParam(), i, k, load_function_seed));
        VectorXd column = VectorXd::Zero(function->size());
        for (std::size_t e = 0; e < evaluator->entries().size(); ++e) {
          const auto [output, state_index] = evaluator->entries()[e];
          if (state_index == k) column[output] = derivatives[static_cast<Index>(e)];
        }
        const auto at = [&](double entry) -> VectorXd {
          VectorXd moved = x;
          moved[k] = entry;
          return function->evaluate(moved, parameters);
        };
        EXPECT_TRUE(matches(column, test::central_difference(at, x[k], 0.05, 1e5 * eps)));
        EXPECT_TRUE(function->reads(k) || test::largest(column) == 0);
        size = std::max(size, test::largest(column));
      }
    }
  }
  EXPECT_GT(size, 1e-3);

  size = 0;
  for (int p = 0; p < static_cast<int>(theta.size()); ++p) {
    const MatrixXd derivatives = latent.directions->differentiate(states, theta, p);
    for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
      SCOPED_TRACE(fmt::format("{}, state {}, parameter {}, seed {}", GetParam(), i,
                               system->parameters()[static_cast<std::size_t>(p)].name, load_function_seed));
      const auto at = [&](double value) -> VectorXd {
        VectorXd moved = theta;
        moved[p] = value;
        return latent.directions->evaluate(states.col(i), moved);
      };
      const double scale = theta[p] == 0 ? 0.01 : 0.05 * std::abs(theta[p]);
      EXPECT_TRUE(matches(derivatives.col(i), test::central_difference(at, theta[p], scale, 1e5 * eps)));
    }
    size = std::max(size, test::largest(derivatives));
  }
  EXPECT_GT(size, 1e-3);
}

TEST_P(LoadFunctionOf, FeaturesHoldEveryParameterThatTheLoadDependsOn) {
  const std::shared_ptr<const System> system = test::model(GetParam()).system;
  const Latent latent = loaded(system);
  for (int p = 0; p < std::ssize(system->parameters()); ++p) {
    EXPECT_EQ(std::ranges::count(latent.feature_parameters, p) > 0, system->depends_on_parameter(p));
  }
}

TEST(LoadFunctionTest, ARowThatIsNotThereIsAnError) {
  const std::shared_ptr<const System> system = test::model("models/surface.toml").system;
  const auto error_of = [&](const std::string& feature) {
    return test::input_error_of([&] { make_prior(system, {LatentSpec{.name = "wear", .features = {feature}}}); });
  };
  EXPECT_EQ(error_of("abs(lambda0(1))"), "");
  EXPECT_THAT(error_of("2*lambda0(2)"), testing::StartsWith("latent 'wear': lambda0(2): there is no such row"));
  EXPECT_THAT(error_of("lambda0"), testing::HasSubstr("write lambda0(1)"));
  EXPECT_THAT(error_of("lambda0(0)"), testing::HasSubstr("counted from 1"));
  EXPECT_THAT(error_of("lambda0(q1)"), testing::HasSubstr("lambda0(q1): there is no such row"));
  EXPECT_THAT(error_of("lambda0(1.5)"), testing::HasSubstr("counted from 1"));
}

}  // namespace
}  // namespace gp2
