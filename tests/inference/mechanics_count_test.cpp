#include <atomic>

#include <gtest/gtest.h>

#include "callable_surface.hpp"
#include "gp2/inference/likelihood.hpp"
#include "gp2/posterior.hpp"
#include "test_models.hpp"

// How often the mechanics are evaluated, which may cost more than all the rest where they are code.
namespace gp2 {
namespace {

using Eigen::VectorXd;

// The surface as code that counts its calls, observed at some states.
struct Counted {
  std::shared_ptr<std::atomic<int>> calls = std::make_shared<std::atomic<int>>(0);
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;

  Counted() {
    const auto counting_surface = [this](const SystemDeclaration& declaration) -> std::shared_ptr<const System> {
      CallableSystem::Definition definition = test::surface_definition(declaration);
      definition.evaluate = [calls = calls](const CallableSystem::States& states, const CallableSystem::Parameters& parameters) {
        ++*calls;
        return test::surface_values(states, parameters);
      };
      return std::make_shared<const CallableSystem>(definition);
    };
    const Model model = Model::parse(test::surface_without_mechanics(), "surface.toml", {counting_surface});
    prior = make_prior(model);
    const GeneratedData data = generate(model, {20, 1, VectorXd::Constant(3, 0.1)});
    observations.push_back(
        {data.states, View::constrained_acceleration(*model.system), data.accelerations, VectorXd::Constant(3, 0.1)});
    const Latent& latent = prior.latents[0];
    values.kernel = {VectorXd::Ones(static_cast<Eigen::Index>(latent.kernel.parameters().size()))};
    values.signal_stddev = {VectorXd::Ones(latent.size())};
    values.noise_stddev = {VectorXd::Constant(3, 0.1)};
    values.parameters = model.system->parameter_values();
    *calls = 0;
  }

  // since the last time
  int count() const { return calls->exchange(0); }
};

TEST(MechanicsCountTest, ALikelihoodOfKnownParametersEvaluatesThemOnce) {
  const Counted c;
  const Likelihood likelihood(c.prior, c.observations, c.values, {.gradient_parameters = {}, .noise_gradient = true});
  EXPECT_EQ(c.count(), 1);
  Likelihood::Workspace workspace;
  ModelGradient gradient;
  EXPECT_TRUE(std::isfinite(likelihood.evaluate(c.values, &gradient, workspace)));
  EXPECT_EQ(c.count(), 0);
}

TEST(MechanicsCountTest, ALikelihoodOfEstimatedParametersEvaluatesThemOncePerPoint) {
  const Counted c;
  const Likelihood likelihood(c.prior, c.observations, c.values, {.gradient_parameters = {2, 3}, .noise_gradient = true});
  EXPECT_EQ(c.count(), 1);
  Likelihood::Workspace workspace;
  ModelValues values = c.values;
  ModelGradient gradient;
  const double value = likelihood.evaluate(values, &gradient, workspace);
  EXPECT_EQ(c.count(), 1);
  // other hyperparameters, the same parameters; then the first ones again
  values.kernel[0] *= 2;
  values.noise_stddev[0] *= 2;
  EXPECT_NE(likelihood.evaluate(values, &gradient, workspace), value);
  EXPECT_EQ(likelihood.evaluate(c.values, nullptr, workspace), value);
  EXPECT_EQ(c.count(), 0);
  values = c.values;
  values.parameters[2] *= 1.01;
  EXPECT_NE(likelihood.evaluate(values, nullptr, workspace), value);
  EXPECT_EQ(c.count(), 1);
  // the gradient needs derivatives that the value did not
  EXPECT_NE(likelihood.evaluate(values, &gradient, workspace), value);
  EXPECT_EQ(c.count(), 1);
  EXPECT_EQ(likelihood.evaluate(c.values, &gradient, workspace), value);
}

TEST(MechanicsCountTest, APosteriorEvaluatesThemOnceForItsDataAndOnceForEachUpdate) {
  const Counted c;
  Posterior posterior(c.prior, c.observations, c.values);
  EXPECT_EQ(c.count(), 1);
  posterior = update(std::move(posterior), c.observations[0]);
  EXPECT_EQ(c.count(), 1);
  posterior = remove_oldest(std::move(posterior), 3);
  EXPECT_EQ(c.count(), 0);
  // where most go, what is left is conditioned anew, and where all go there is nothing left to evaluate
  posterior = remove_oldest(std::move(posterior), 25);
  EXPECT_EQ(c.count(), 1);
  posterior = remove_oldest(std::move(posterior), 12);
  EXPECT_EQ(c.count(), 0);
}

}  // namespace
}  // namespace gp2
