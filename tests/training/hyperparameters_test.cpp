#include <set>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/training/laplace.hpp"
#include "input_error.hpp"
#include "observations_testing.hpp"
#include "test_models.hpp"
#include "training/objective.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::HasSubstr;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t hyperparameters_seed = 50501;

std::vector<Observations> observe_drawn(const Model& model, int n, bool estimate_noise, std::vector<int> rows = {}) {
  const GeneratedData data = test::draw(model, n, hyperparameters_seed);
  View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  if (!rows.empty()) view.rows = rows;
  MatrixXd values(view.size(), n);
  for (int k = 0; k < view.size(); ++k) values.row(k) = data.accelerations.row(view.rows[static_cast<std::size_t>(k)]);
  return {{data.states, view, values, 0.1 * row_stddev(values), estimate_noise}};
}

const Hyperparameter& find(const std::vector<Hyperparameter>& all, const std::string& name) {
  for (const Hyperparameter& h : all) {
    if (h.name == name) return h;
  }
  throw std::runtime_error("no hyperparameter " + name);
}

// the standard deviation by its definition
double stddev(const VectorXd& values) { return std::sqrt((values.array() - values.mean()).square().mean()); }

// a few roundings
void expect_same(double got, double want) { EXPECT_NEAR(got, want, 64 * test::eps * std::abs(want)); }

TEST(HyperparametersTest, ThePaperProtocolHasThePapersBox) {
  const Model& model = test::model("experiments/surface_published.toml");
  const Prior prior = make_prior(model, {Prior::Mean::zero, std::nullopt, true});
  const std::vector<Observations> observations = observe_drawn(model, 60, false);
  const auto all = default_hyperparameters(prior, observations, {"p1", "p4", "p7"}, {Protocol::Name::paper, true});
  ASSERT_EQ(all.size(), 9u + 1u + 3u);
  const MatrixXd features = evaluate_features(prior, 0, observations[0].states());
  for (int d = 0; d < 9; ++d) {
    const Hyperparameter& h = all[static_cast<std::size_t>(d)];
    SCOPED_TRACE(h.name);
    EXPECT_EQ(h.name, "lengthscale(" + prior.latents[0].feature_names[static_cast<std::size_t>(d)] + ")");
    EXPECT_EQ(h.kind, Kind::kernel);
    EXPECT_EQ(h.index, d);
    const double spread = stddev(features.col(d));
    expect_same(h.lower, 0.5 * spread);
    expect_same(h.upper, 20 * spread);
    expect_same(h.value, spread);
    EXPECT_EQ(h.hyperprior.form, HyperPrior::Form::none);
  }
  const Hyperparameter& signal = find(all, "signal_stddev");
  EXPECT_EQ(signal.kind, Kind::shared_signal_stddev);
  EXPECT_EQ(signal.lower, 0.5);
  EXPECT_EQ(signal.upper, 10);
  ASSERT_EQ(signal.column_scale.size(), 3);
  for (int j = 0; j < 3; ++j) expect_same(signal.column_scale[j], stddev(observations[0].values().row(j)));
  EXPECT_EQ(find(all, "p1").lower, 0.08 - 0.02);
  EXPECT_EQ(find(all, "p1").upper, 0.08 + 0.02);
  EXPECT_EQ(find(all, "p4").lower, -0.02) << "a value of zero, too";
  EXPECT_EQ(find(all, "p4").upper, 0.02);
  EXPECT_EQ(find(all, "p7").upper, 3.0 + 0.02);
  EXPECT_EQ(find(all, "p1").hyperprior.form, HyperPrior::Form::none);
}

TEST(HyperparametersTest, ThePaperProtocolKeepsToTheFilesBounds) {
  const Model& model = test::model("models/unicycle.toml");
  const Prior prior = make_prior(model);
  const auto all = default_hyperparameters(prior, observe_drawn(model, 30, false), {"R", "Ic"}, {Protocol::Name::paper, true});
  EXPECT_EQ(find(all, "R").lower, 0.05 - 0.02);
  EXPECT_EQ(find(all, "R").upper, 0.05 + 0.02);
  EXPECT_EQ(find(all, "Ic").lower, 0.005145) << "where M stays positive definite";
  EXPECT_EQ(find(all, "Ic").upper, 0.02 + 0.02);
}

TEST(HyperparametersTest, TheStandardProtocolHasItsOwnBoxAndHyperPriors) {
  const Model& model = test::model("models/unicycle.toml");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 40, true);
  const auto all = default_hyperparameters(prior, observations, {"R"}, {});
  using Standard = Protocol::Standard;
  ASSERT_EQ(all.size(), 7u + 3u + 3u + 1u);
  const double spread = stddev(evaluate_features(prior, 0, observations[0].states()).col(2));
  const Hyperparameter& lengthscale = find(all, "lengthscale(sin(q3))");
  expect_same(lengthscale.value, Standard::lengthscale_initial * spread);
  expect_same(lengthscale.lower, Standard::lengthscale_lower * spread);
  expect_same(lengthscale.upper, Standard::lengthscale_upper * spread);
  expect_same(lengthscale.hyperprior.median, Standard::lengthscale_median * spread);
  EXPECT_EQ(lengthscale.hyperprior.stddev, Standard::lengthscale_log_stddev);
  const double output = stddev(observations[0].values().row(2));
  const Hyperparameter& signal = find(all, "signal_stddev(ddq3)");
  EXPECT_EQ(signal.kind, Kind::signal_stddev);
  expect_same(signal.value, output);
  expect_same(signal.lower, 1e-3 * output);
  const Hyperparameter& noise = find(all, "noise_stddev(ddq3)");
  EXPECT_EQ(noise.kind, Kind::noise_stddev);
  expect_same(noise.value, 0.1 * output);
  expect_same(noise.lower, 1e-6 * output);
  expect_same(noise.upper, 2 * output);
  expect_same(noise.hyperprior.median, 0.1 * output);
  EXPECT_EQ(noise.hyperprior.correlation, Standard::noise_correlation);
  EXPECT_EQ(noise.hyperprior.family, find(all, "noise_stddev(ddq1)").hyperprior.family);
  EXPECT_EQ(find(all, "R").lower, 0.01);
  EXPECT_EQ(find(all, "R").upper, 0.07);
  for (const Hyperparameter& h : default_hyperparameters(prior, observations, {}, {Protocol::Name::standard, false})) {
    EXPECT_EQ(h.hyperprior.form, HyperPrior::Form::none) << h.name;
  }
}

// stated deviations and starts are wrong by factors of their own
TEST(HyperparametersTest, NoiseIsMostlyAsWrongInOneAccelerationAsInAnother) {
  const Prior prior = make_prior(test::model("models/unicycle.toml"));
  std::vector<Observations> observations = observe_drawn(test::model("models/unicycle.toml"), 40, true);
  observations.push_back(observations[0]);
  MatrixXd scale = MatrixXd::Ones(3, 40);
  scale.row(1).setConstant(0.2);
  observations[1] = observations[1].with_noise(Noise(observations[0].noise().stddev(), true, scale));
  const auto all = default_hyperparameters(prior, observations, {}, {});
  const auto family = [&](const std::string& name) { return find(all, "noise_stddev(" + name).hyperprior.family; };
  EXPECT_NE(family("ddq1)"), "");
  EXPECT_EQ(family("ddq1)"), family("ddq2)"));
  EXPECT_EQ(family("ddq1)"), family("ddq3)"));
  EXPECT_EQ(family("ddq1)#2"), family("ddq3)#2"));
  EXPECT_NE(family("ddq1)"), family("ddq1)#2"));
  EXPECT_NE(family("ddq2)#2"), "");
  EXPECT_NE(family("ddq2)#2"), family("ddq1)#2"));
}

// the surface's model with priors of its own
Model with_priors(const std::string& p1) {
  std::string text = test::model("models/surface.toml").text;
  const std::size_t line = text.find("\np1"), end = text.find('\n', line + 1);
  text.replace(line, end - line, "\np1 = " + p1);
  text.insert(text.find("[[latent]]") + 10,
              "\nlengthscale = { prior = { median = 2, log_stddev = 0.5 } }\nsignal_stddev = { prior = { median = 3, log_stddev "
              "= 0.25 } }\n");
  return Model::parse(text, "with priors");
}

TEST(HyperparametersTest, PriorsOfTheModelReplaceTheWeakOnes) {
  const Model model = with_priors("{ value = 0.08, bounds = [0.01, 1], prior = { median = 0.09, log_stddev = 0.2 } }");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 30, false);
  const auto all = default_hyperparameters(prior, observations, {"p1"}, {});
  const double spread = stddev(evaluate_features(prior, 0, observations[0].states()).col(0));
  expect_same(find(all, "lengthscale(q1)").hyperprior.median, 2 * spread);
  EXPECT_EQ(find(all, "lengthscale(q1)").hyperprior.stddev, 0.5);
  expect_same(find(all, "signal_stddev(ddq1)").hyperprior.median, 3 * stddev(observations[0].values().row(0)));
  EXPECT_EQ(find(all, "signal_stddev(ddq1)").hyperprior.stddev, 0.25);
  EXPECT_EQ(find(all, "p1").hyperprior.median, 0.09);
  EXPECT_EQ(find(all, "p1").hyperprior.stddev, 0.2);
  EXPECT_EQ(find(all, "p1").hyperprior.form, HyperPrior::Form::log_normal);
  for (const Protocol& without : {Protocol{Protocol::Name::standard, false}, Protocol{Protocol::Name::paper, true}}) {
    for (const Hyperparameter& h : default_hyperparameters(prior, observations, {"p1"}, without)) {
      EXPECT_EQ(h.hyperprior.form, HyperPrior::Form::none) << h.name;
    }
  }
  const Model normal = with_priors("{ value = 0.08, bounds = [-1, 1], prior = { mean = 0.09, stddev = 0.02 } }");
  const auto of_normal = default_hyperparameters(make_prior(normal), observations, {"p1"}, {});
  EXPECT_EQ(find(of_normal, "p1").hyperprior.median, 0.09);
  EXPECT_EQ(find(of_normal, "p1").hyperprior.stddev, 0.02);
  EXPECT_EQ(find(of_normal, "p1").hyperprior.form, HyperPrior::Form::normal);
}

// the surface's model with more keys of its latent
Model surface_with_latent_keys(const std::string& keys) {
  std::string text = test::model("models/surface.toml").text;
  text.insert(text.find("[[latent]]") + 10, "\n" + keys + "\n");
  return Model::parse(text, "with keys");
}

TEST(HyperparametersTest, EqualBoundsHoldAValueAndLeaveItNoPrior) {
  const Model model =
      surface_with_latent_keys("lengthscale = { bounds = [2, 2] }\nsignal_stddev = { value = 4, estimate = false }");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 30, true);
  const double spread = stddev(evaluate_features(prior, 0, observations[0].states()).col(0));
  const auto all = default_hyperparameters(prior, observations, {}, {});
  for (const char* name : {"lengthscale(q1)", "signal_stddev(ddq1)"}) {
    const Hyperparameter& h = find(all, name);
    EXPECT_TRUE(h.is_fixed()) << name;
    EXPECT_EQ(h.value, h.lower) << name;
    EXPECT_FALSE(h.at_bound()) << name;
    EXPECT_EQ(h.hyperprior.form, HyperPrior::Form::none) << name;
  }
  expect_same(find(all, "lengthscale(q1)").value, 2 * spread);
  EXPECT_FALSE(find(all, "noise_stddev(ddq1)").is_fixed());
  for (const Hyperparameter& h : default_hyperparameters(prior, observations, {}, {Protocol::Name::paper, true})) {
    EXPECT_TRUE(h.kind != Kind::kernel || h.is_fixed()) << h.name;
  }
}

TEST(HyperparametersTest, LengthscalesInUnitsOfFeaturesComeBeforeRelativeOnes) {
  const Model model = surface_with_latent_keys(
      "lengthscale = { initial = 2, bounds = [1, 3] }\nlengthscales = { q1 = 0.7, q2 = { value = 1e-6 }, q3 = { bounds = [5, 6] "
      "} }");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 30, false);
  const auto all = default_hyperparameters(prior, observations, {}, {});
  EXPECT_EQ(find(all, "lengthscale(q1)").value, 0.7) << "to the bit";
  EXPECT_TRUE(find(all, "lengthscale(q1)").is_fixed());
  EXPECT_EQ(find(all, "lengthscale(q2)").value, 1e-6);
  EXPECT_EQ(find(all, "lengthscale(q2)").lower, 1e-6) << "bounds that are not its own make room for a start";
  expect_same(find(all, "lengthscale(q2)").upper, 3 * stddev(evaluate_features(prior, 0, observations[0].states()).col(1)));
  EXPECT_EQ(find(all, "lengthscale(q3)").lower, 5);
  EXPECT_EQ(find(all, "lengthscale(q3)").value, 5);
  EXPECT_EQ(find(all, "lengthscale(q3)").upper, 6);
  const double spread = stddev(evaluate_features(prior, 0, observations[0].states()).col(3));
  expect_same(find(all, "lengthscale(dq1)").value, 2 * spread);
}

TEST(HyperparametersTest, AFitLeavesWhatIsHeld) {
  const Model model = surface_with_latent_keys("lengthscales = { q1 = 0.7 }\nsignal_stddev = { value = 2, estimate = false }");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 12, true);
  const auto all = default_hyperparameters(prior, observations, {}, {});
  FitOptions options;
  options.n_restarts = 2;
  options.max_iterations = 15;
  options.n_threads = 1;
  const FitReport report = fit(prior, observations, all, options).report;
  EXPECT_EQ(find(report.hyperparameters, "lengthscale(q1)").value, 0.7);
  EXPECT_EQ(find(report.hyperparameters, "signal_stddev(ddq1)").value, find(all, "signal_stddev(ddq1)").value);
  EXPECT_NE(find(report.hyperparameters, "lengthscale(q2)").value, find(all, "lengthscale(q2)").value);
}

TEST(HyperparametersTest, AFitHoldsAParameterOfEqualBounds) {
  const Model& model = test::model("models/surface.toml");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 12, true);
  const std::string name = model.system->parameters().front().name;
  auto all = default_hyperparameters(prior, observations, {name}, {});
  Hyperparameter& held = all.back();
  held.value *= 1.1;
  held.lower = held.upper = held.value;
  EXPECT_EQ(held.value_at(held.coordinate()), held.value);
  FitOptions options;
  options.n_restarts = 2;
  options.max_iterations = 15;
  options.n_threads = 1;
  const FitReport report = fit(prior, observations, all, options).report;
  EXPECT_EQ(find(report.hyperparameters, name).value, held.value);
  EXPECT_NE(find(report.hyperparameters, "signal_stddev(ddq1)").value, find(all, "signal_stddev(ddq1)").value);
  ASSERT_TRUE(report.uncertainty);
  EXPECT_EQ(parameter_uncertainty(report, all.size() - 1).stddev, 0);
}

TEST(HyperparametersTest, APriorOfALogarithmNeedsBoundsAboveZero) {
  const Model model = with_priors("{ value = 0.08, bounds = [-1, 1], prior = { median = 0.09, log_stddev = 0.2 } }");
  EXPECT_THAT(
      test::input_error_of([&] { default_hyperparameters(make_prior(model), observe_drawn(model, 5, false), {"p1"}, {}); }),
      HasSubstr("parameter 'p1': a prior of the logarithm needs bounds above 0, got [-1, 1]"));
}

TEST(HyperparametersTest, TheGradientOfPriorsIsThatOfTheirSum) {
  for (const char* p1 : {"{ value = 0.08, bounds = [0.01, 1], prior = { median = 0.2, log_stddev = 0.3 } }",
                         "{ value = 0.08, bounds = [-1, 1], prior = { mean = 0.09, stddev = 0.02 } }"}) {
    const Model model = with_priors(p1);
    const auto all = default_hyperparameters(make_prior(model), observe_drawn(model, 20, false), {"p1"}, {});
    const VectorXd x = coordinates(all);
    const auto sum_at = [&](Eigen::Index k, double step) {
      std::vector<Hyperparameter> moved = all;
      Hyperparameter& h = moved[static_cast<std::size_t>(k)];
      h.value = h.value_at(x[k] + step);
      return negative_log_hyperpriors(moved, nullptr);
    };
    VectorXd gradient = VectorXd::Zero(x.size());
    negative_log_hyperpriors(all, &gradient);
    for (Eigen::Index k = 0; k < x.size(); ++k) {
      // differences of a function of the size of 100 with steps of 1e-5 are right to 1e-16 · 100 / 1e-5
      EXPECT_NEAR(gradient[k], (sum_at(k, 1e-5) - sum_at(k, -1e-5)) / 2e-5, 1e-5 * (1 + std::abs(gradient[k])))
          << all[static_cast<std::size_t>(k)].name;
    }
    EXPECT_GT(std::abs(gradient[x.size() - 1]), 1e-3);
  }
}

TEST(HyperparametersTest, AFixedNoiseIsNoHyperparameter) {
  const Model& model = test::model("models/duffing.toml");
  for (const Hyperparameter& h : default_hyperparameters(make_prior(model), observe_drawn(model, 20, false), {}, {})) {
    EXPECT_NE(h.kind, Kind::noise_stddev);
    EXPECT_NE(h.kind, Kind::parameter);
  }
}

TEST(HyperparametersTest, NamesAreUnique) {
  for (const std::string& file : test::every_model()) {
    const Model& model = test::model(file);
    const Prior prior = make_prior(model);
    std::set<int> in_features;
    for (const Latent& latent : prior.latents)
      in_features.insert(latent.feature_parameters.begin(), latent.feature_parameters.end());
    std::vector<std::string> parameters;
    for (const Parameter& parameter : model.system->parameters()) {
      if (!in_features.contains(model.system->parameter_index(parameter.name))) parameters.push_back(parameter.name);
    }
    std::set<std::string> names;
    for (const Hyperparameter& h : default_hyperparameters(prior, observe_drawn(model, 12, true), parameters, {})) {
      EXPECT_TRUE(names.insert(h.name).second) << file << ": " << h.name;
      EXPECT_TRUE(h.lower <= h.value && h.value <= h.upper) << file << ": " << h.name;
      EXPECT_TRUE(std::isfinite(h.lower) && std::isfinite(h.upper) && h.lower < h.upper) << file << ": " << h.name;
      EXPECT_FALSE(h.unit.empty()) << file << ": " << h.name;
      EXPECT_TRUE(h.lower > 0 || !h.positive) << file << ": " << h.name;
    }
  }
}

TEST(HyperparametersTest, AParameterThatIsNotThereOrHasNoRangeIsAnError) {
  const Model model = Model::parse(R"toml(
name        = "cart"
coordinates = ["x", "y"]
[parameters]
m = 2.0
tilt = 0.0
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["tilt", "0"]
[constraints]
position = ["y"]
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                   "cart");
  RandomStream random(hyperparameters_seed);
  const MatrixXd states = test::random_matrix(5, 10, random), values = test::random_matrix(2, 10, random);
  const std::vector<Observations> observations{
      {states, View::all(View::Quantity::constrained_acceleration, *model.system), values, VectorXd::Ones(2), false}};
  const Prior prior = make_prior(model);
  const auto message = [&](const std::string& name) {
    return test::input_error_of([&] { default_hyperparameters(prior, observations, {name}, {}); });
  };
  EXPECT_THAT(message("mass"), AllOf(HasSubstr("'mass'"), HasSubstr("m, tilt")));
  EXPECT_THAT(message("tilt"), AllOf(HasSubstr("'tilt'"), HasSubstr("bounds")));
  const auto all = default_hyperparameters(prior, observations, {"m"}, {});
  EXPECT_EQ(find(all, "m").lower, 1.0) << "half";
  EXPECT_EQ(find(all, "m").upper, 4.0) << "to twice the value";
}

// the last would count, but the optimiser would see the slope of both
TEST(HyperparametersTest, ThatStandTwiceAreRefused) {
  const Model& model = test::model("models/surface.toml");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 10, false);
  std::vector<Hyperparameter> all = default_hyperparameters(prior, observations, {}, {});
  const auto message = [&] { return test::input_error_of([&] { fit(prior, observations, all); }); };
  for (const Hyperparameter& h : {all.front(), all.back()}) {
    all.push_back(h);
    EXPECT_EQ(message(), fmt::format("hyperparameter '{}' stands twice; leave out one", h.name));
    all.pop_back();
  }
}

TEST(HyperparametersTest, AParameterThatStandsInAFeatureCannotBeEstimated) {
  const Model& model = test::model("models/arm_on_moving_plane.toml");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 10, false);
  EXPECT_NO_THROW(default_hyperparameters(prior, observations, {"m2"}, {}));
  EXPECT_THAT(test::input_error_of([&] { default_hyperparameters(prior, observations, {"l1"}, {}); }),
              AllOf(HasSubstr("'l1'"), HasSubstr("feature"), HasSubstr("friction of the tip")));
}

TEST(HyperparametersTest, TheScaleOfAnUnobservedAccelerationComesFromEqualKineticScale) {
  const Model& model = test::model("models/double_pendulum.toml");
  const std::vector<Observations> observations = observe_drawn(model, 50, false, {2, 5});
  const Scales scales = default_scales(make_prior(model), observations);
  const VectorXd p = model.system->parameter_values();
  const auto parameter = [&](const char* name) { return p[model.system->parameter_index(name)]; };
  const double s3 = stddev(observations[0].values().row(0)), s6 = stddev(observations[0].values().row(1));
  const double kinetic = (parameter("I1") * s3 * s3 + parameter("I2") * s6 * s6) / 2;
  // force scale of coordinate j: M_jj σ_j
  const VectorXd& force = scales.signal_stddev[0];
  expect_same(force[2], parameter("I1") * s3);
  expect_same(force[5], parameter("I2") * s6);
  expect_same(force[0], parameter("m1") * std::sqrt(kinetic / parameter("m1")));
  expect_same(force[4], parameter("m2") * std::sqrt(kinetic / parameter("m2")));
}

TEST(HyperparametersTest, AFeatureThatDoesNotVaryStillHasAScale) {
  const Model& model = test::model("models/surface.toml");
  std::vector<Observations> observations = observe_drawn(model, 20, false);
  const StateLayout layout = model.system->layout();
  MatrixXd states = observations[0].states();
  states.row(layout.u(0)).setZero();
  states.row(layout.u(1)).setConstant(3);
  observations[0] = test::with_states(observations[0], states);
  const Scales scales = default_scales(make_prior(model), observations);
  EXPECT_EQ(scales.feature_stddev[0][6], 1);
  EXPECT_EQ(scales.feature_stddev[0][7], 3);
}

TEST(HyperparametersTest, AFeatureTooSmallForItsSquareIsFittedLikeOneThatIsZero) {
  const Model& model = test::model("models/surface.toml");
  std::vector<Observations> observations = observe_drawn(model, 12, false);
  MatrixXd states = observations[0].states();
  FitOptions options;
  options.n_restarts = 1;
  options.max_iterations = 3;
  const auto fitted = [&](double constant) {
    states.row(model.system->layout().u(1)).setConstant(constant);
    observations[0] = test::with_states(observations[0], states);
    const Prior prior = make_prior(model);
    return fit(prior, observations, default_hyperparameters(prior, observations, {}, {}), options).report.objective;
  };
  const double of_zero = fitted(0);
  EXPECT_EQ(fitted(1e-310), of_zero);
  EXPECT_EQ(fitted(-3e-200), of_zero);
}

TEST(HyperparametersTest, ModelValuesPutEachNumberInItsPlace) {
  const Model& model = test::model("models/arm_on_moving_plane.toml");
  const Prior prior = make_prior(model);
  const std::vector<Observations> observations = observe_drawn(model, 20, true);
  auto all = default_hyperparameters(prior, observations, {"m2"}, {});
  for (std::size_t k = 0; k < all.size(); ++k) all[k].value = 1 + static_cast<double>(k);
  const ModelValues values = model_values(prior, observations, all);
  for (const Hyperparameter& h : all) {
    const auto owner = static_cast<std::size_t>(h.owner);
    const double stored = h.kind == Kind::kernel          ? values.kernel[owner][h.index]
                          : h.kind == Kind::signal_stddev ? values.signal_stddev[owner][h.index]
                          : h.kind == Kind::noise_stddev  ? values.noise_stddev[owner][h.index]
                                                          : values.parameters[h.index];
    EXPECT_EQ(stored, h.value) << h.name;
  }
  EXPECT_EQ(values.parameters[model.system->parameter_index("m1")], 2.0) << "what is not estimated keeps its value";

  Hyperparameter shared = Hyperparameter::of(Kind::shared_signal_stddev, 1, 0);
  shared.value = 3;
  shared.column_scale = Eigen::Vector2d(1, 0.5);
  EXPECT_EQ(model_values(prior, observations, {shared}).signal_stddev[1], Eigen::Vector2d(3, 1.5));
  EXPECT_EQ(model_values(prior, observations, {shared}).noise_stddev[0], observations[0].noise().stddev());
}

TEST(HyperparametersTest, ABoundIsReportedWhenItIsHit) {
  Hyperparameter positive = Hyperparameter::of(Kind::noise_stddev, 0, 0);
  positive.lower = 1e-3;
  positive.upper = 1e3;
  for (double value : {1e-3, 1e-3 * (1 + 1e-7), 1e3, 1e3 * (1 - 1e-7)}) {
    positive.value = value;
    EXPECT_TRUE(positive.at_bound()) << value;
  }
  for (double value : {1e-3 * (1 + 1e-5), 1.0, 1e3 * (1 - 1e-5)}) {
    positive.value = value;
    EXPECT_FALSE(positive.at_bound()) << value;
  }
  Hyperparameter parameter = Hyperparameter::of(Kind::parameter, 0, 0);
  parameter.lower = -1;
  parameter.upper = 1;
  for (double value : {-1.0, -1 + 1e-6, 1.0}) {
    parameter.value = value;
    EXPECT_TRUE(parameter.at_bound()) << value;
  }
  for (double value : {-1 + 1e-5, 0.0, 1 - 1e-5}) {
    parameter.value = value;
    EXPECT_FALSE(parameter.at_bound()) << value;
  }
  // a mass of 1 kg is not at its bound of 1 mg because it might be 5000 t
  parameter.lower = 1e-6;
  parameter.upper = 5e6;
  parameter.value = 1;
  EXPECT_FALSE(parameter.at_bound());
  parameter.value = 1e-6;
  EXPECT_TRUE(parameter.at_bound());
}

}  // namespace
}  // namespace gp2
