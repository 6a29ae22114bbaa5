// What a prior has no number for is refused by state and name at every door; nothing passes for a prediction.
#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/gp2.hpp"
#include "gp2/inference/pathwise.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::HasSubstr;

struct NotFiniteCase {
  std::string name, kernel, feature, direction, force;
  std::string text;  // of the error
};

void PrintTo(const NotFiniteCase& c, std::ostream* out) { *out << c.name; }

// a particle; each case has a root of the negative x in another place
Prior prior_of(const NotFiniteCase& c) {
  const std::string text = fmt::format(R"toml(
name        = "particle"
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "{}"]
[[latent]]
name       = "drag"
kernel     = "{}"
features   = ["{}", "dx"]
directions = {{ force = [["1"], ["{}"]] }}
)toml",
                                       c.force, c.kernel, c.feature, c.direction);
  return make_prior(Model::parse(text, c.name), {Prior::Mean::force, std::nullopt});
}

MatrixXd states_from(const Prior& prior, double first_x) {
  MatrixXd states = MatrixXd::Zero(prior.system->layout().size(), 3);
  states.row(0) << 1, first_x, 2;
  states.row(2) << 0.1, 0.2, 0.3;
  return states;
}

class NotFinite : public testing::TestWithParam<NotFiniteCase> {
 protected:
  NotFinite() : sound_(states_from(prior_, 3)), broken_(states_from(prior_, -1)) {}

  [[nodiscard]] Observations observe(const MatrixXd& states) const {
    return {states, View::constrained_acceleration(*prior_.system), MatrixXd::Random(2, states.cols()),
            VectorXd::Constant(2, 0.1)};
  }

  const Prior prior_ = prior_of(GetParam());
  const MatrixXd sound_, broken_;
};

INSTANTIATE_TEST_SUITE_P(
    Each, NotFinite,
    testing::Values(NotFiniteCase{"FeatureSe", "se", "sqrt(x)", "1", "0", "latent 'drag': the feature 'sqrt(x)'"},
                    NotFiniteCase{"FeatureMatern", "matern32", "sqrt(x)", "1", "0", "latent 'drag': the feature 'sqrt(x)'"},
                    NotFiniteCase{"FeaturePeriodic", "periodic", "sqrt(x)", "1", "0", "latent 'drag': the feature 'sqrt(x)'"},
                    NotFiniteCase{"FeatureRq", "rq + linear", "sqrt(x)", "1", "0", "latent 'drag': the feature 'sqrt(x)'"},
                    NotFiniteCase{"FeatureInfinite", "se", "1/(x + 1)", "1", "0", "latent 'drag': the feature '1/(x + 1)'"},
                    NotFiniteCase{"Direction", "se", "x", "sqrt(x)", "0", "latent 'drag': 'direction 1' along 'y'"},
                    NotFiniteCase{"Force", "se", "x", "1", "sqrt(x)", "the applied force on 'y'"}),
    [](const auto& one) { return one.param.name; });

TEST_P(NotFinite, IsRefusedAtEveryDoorByStateAndName) {
  const std::string expected = fmt::format("system 'particle': {} is not a finite number at state 2 (x = -1", GetParam().text);
  const View view = View::constrained_acceleration(*prior_.system);
  const std::vector<Observations> sound = {observe(sound_)}, broken = {observe(broken_)};
  const std::vector<Hyperparameter> hyperparameters = default_hyperparameters(prior_, sound, {}, Protocol());
  const ModelValues values = model_values(prior_, sound, hyperparameters);
  const Posterior posterior(prior_, sound, values);
  const std::vector<std::pair<std::string, std::function<void()>>> doors = {
      {"default_hyperparameters", [&] { static_cast<void>(default_hyperparameters(prior_, broken, {}, Protocol())); }},
      {"Likelihood", [&] { Likelihood(prior_, broken, values, {}); }},
      {"fit", [&] { static_cast<void>(fit(prior_, broken, hyperparameters)); }},
      {"Posterior", [&] { Posterior(prior_, broken, values); }},
      {"update", [&] { static_cast<void>(update(Posterior(posterior), observe(broken_))); }},
      {"mean", [&] { static_cast<void>(posterior.mean(view, broken_)); }},
      {"mean of the prior", [&] { static_cast<void>(posterior.without_data().mean(view, broken_)); }},
      {"marginal", [&] { static_cast<void>(posterior.marginal(view, broken_)); }},
      {"joint", [&] { static_cast<void>(posterior.joint(view, broken_)); }},
      {"sample",
       [&] {
         static_cast<void>(posterior.sample({{view, broken_}}, 2, 1));
       }},
      {"paths", [&] { static_cast<void>(sample_paths(posterior, 1).evaluate(0, view, broken_)); }},
  };
  for (const auto& [name, use] : doors) EXPECT_THAT(input_error_of(use), HasSubstr(expected)) << name;
}

// States are predicted in blocks, but counted among all.
TEST_P(NotFinite, IsNumberedAmongAllStates) {
  const std::vector<Observations> sound = {observe(sound_)};
  const Posterior posterior(prior_, sound, model_values(prior_, sound, default_hyperparameters(prior_, sound, {}, Protocol())));
  const View view = View::constrained_acceleration(*prior_.system);
  MatrixXd many = sound_.col(0).replicate(1, 400);
  many.col(290) = many.col(399) = broken_.col(1);
  for (const int n_threads : {1, 2}) {
    for (const std::string& error : {input_error_of([&] { static_cast<void>(posterior.mean(view, many, n_threads)); }),
                                     input_error_of([&] { static_cast<void>(posterior.marginal(view, many, n_threads)); })}) {
      EXPECT_THAT(error, HasSubstr("is not a finite number at state 291 (x = -1"));
    }
  }
}

TEST_P(NotFinite, IsAStatusOfThePredictor) {
  const std::vector<Observations> sound = {observe(sound_)};
  const Posterior posterior(prior_, sound, model_values(prior_, sound, default_hyperparameters(prior_, sound, {}, Protocol())));
  for (const Posterior& of : {posterior, posterior.without_data()}) {
    const Predictor predictor(of);
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(2), stddev(2);
    EXPECT_EQ(predictor.mean_and_stddev(broken_.col(0), mean, stddev, workspace), Predictor::Status::ok);
    EXPECT_EQ(predictor.mean_and_stddev(broken_.col(1), mean, stddev, workspace), Predictor::Status::not_finite);
    EXPECT_TRUE(mean.hasNaN() && stddev.hasNaN());
  }
}

// Everything that the model says is a number, but not what is predicted of it.
TEST(Overflow, IsRefusedAtEveryDoorByItsState) {
  const Prior prior = prior_of({"Overflow", "linear", "x", "x", "0", ""});
  const View view = View::constrained_acceleration(*prior.system);
  const MatrixXd sound = states_from(prior, 3), huge = states_from(prior, 1e200);
  const std::vector<Observations> observed = {{sound, view, MatrixXd::Random(2, 3), VectorXd::Constant(2, 0.1)}};
  const Posterior posterior(prior, observed,
                            model_values(prior, observed, default_hyperparameters(prior, observed, {}, Protocol())));
  const std::vector<std::pair<std::string, std::function<void()>>> doors = {
      {"mean", [&] { static_cast<void>(posterior.mean(view, huge)); }},
      {"marginal", [&] { static_cast<void>(posterior.marginal(view, huge)); }},
      {"joint", [&] { static_cast<void>(posterior.joint(view, huge)); }},
      {"sample",
       [&] {
         static_cast<void>(posterior.sample({{view, huge}}, 2, 1));
       }},
      {"paths", [&] { static_cast<void>(sample_paths(posterior, 1).evaluate(0, view, huge)); }},
  };
  for (const auto& [name, use] : doors) {
    EXPECT_THAT(input_error_of(use), HasSubstr("system 'particle': the prediction overflows double precision (correct the state, "
                                               "or leave it out) at state 2 (x = 1e+200"))
        << name;
  }
}

// The variance is a square, and overflows before the mean does.
TEST(Overflow, IsAStatusOfThePredictor) {
  const Prior prior = prior_of({"Overflow", "linear", "x", "1", "0", ""});
  const MatrixXd sound = states_from(prior, 3), huge = states_from(prior, 1e200);
  const std::vector<Observations> observed = {
      {sound, View::constrained_acceleration(*prior.system), MatrixXd::Random(2, 3), VectorXd::Constant(2, 0.1)}};
  const Predictor predictor(
      Posterior(prior, observed, model_values(prior, observed, default_hyperparameters(prior, observed, {}, Protocol()))));
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd mean(2), stddev(2);
  MatrixXd covariance(2, 2);
  EXPECT_EQ(predictor.mean(huge.col(1), mean, workspace), Predictor::Status::ok);
  EXPECT_EQ(predictor.mean_and_stddev(huge.col(1), mean, stddev, workspace), Predictor::Status::not_finite);
  EXPECT_TRUE(mean.array().isNaN().all() && stddev.array().isNaN().all());
  EXPECT_EQ(predictor.mean_and_covariance(huge.col(1), mean, covariance, workspace), Predictor::Status::not_finite);
  EXPECT_TRUE(mean.array().isNaN().all() && covariance.array().isNaN().all());
}

// A denormal velocity, say: the row that it scales has no variance, and the other row keeps its own.
TEST(Underflow, OfADirectionLeavesTheOtherRowAsItIs) {
  const Prior prior = make_prior(Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[[latent]]
kernel     = "se"
features   = ["dy"]
directions = { force = [["x"], ["1"]] }
)toml",
                                              "particle"),
                                 {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*prior.system);
  const std::vector<Observations> observed = {{states_from(prior, 3), view, MatrixXd::Random(2, 3), VectorXd::Constant(2, 0.1)}};
  const Posterior posterior(prior, observed,
                            model_values(prior, observed, default_hyperparameters(prior, observed, {}, Protocol())));
  const MatrixXd at_zero = posterior.marginal(view, states_from(prior, 0)).covariance;
  EXPECT_GT(at_zero(3, 1), 0);
  for (const double tiny : {1e-200, 1e-310}) {
    EXPECT_EQ(posterior.marginal(view, states_from(prior, tiny)).covariance, at_zero) << tiny;
  }
}

}  // namespace
}  // namespace gp2
