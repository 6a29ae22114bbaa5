#include <functional>
#include <limits>
#include <map>
#include <string>

#include <gmock/gmock.h>

#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "gp2/training/laplace.hpp"
#include "gp2/training/robust.hpp"
#include "input_error.hpp"
#include "observations_testing.hpp"
#include "test_models.hpp"

// What the public functions say of arguments that do not fit, in Release too.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::AllOf;
using testing::HasSubstr;
using testing::Not;
using Quantity = View::Quantity;
using Kind = Hyperparameter::Kind;

constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();

/// The surface model with seven observed states, and all that is made of them.
struct Surface {
  const Model& model = test::model("models/surface.toml");
  GeneratedData data = test::draw(model, 7, 3);
  Prior prior = make_prior(model);
  View ddq = View::constrained_acceleration(*model.system);
  std::vector<Observations> observations = {{data.states, ddq, data.accelerations, VectorXd::Constant(3, 0.01), true}};
  std::vector<Hyperparameter> hyperparameters = default_hyperparameters(prior, observations, {}, {});
  ModelValues values = model_values(prior, observations, hyperparameters);
  Posterior posterior{prior, observations, values};

  [[nodiscard]] Observations observed(const View& view) const {
    return {data.states, view, MatrixXd::Ones(view.size(), 7), VectorXd::Ones(view.size())};
  }
};

using Doors = std::map<std::string, std::function<void()>>;

void expect_refusal(const Doors& doors, const std::string& text) {
  for (const auto& [name, door] : doors) EXPECT_THAT(input_error_of(door), HasSubstr(text)) << name;
}

Doors doors_of_prediction(const Surface& s, const View& view, const MatrixXd& states) {
  return {{"mean", [&] { static_cast<void>(s.posterior.mean(view, states)); }},
          {"marginal", [&] { static_cast<void>(s.posterior.marginal(view, states)); }},
          {"joint", [&] { static_cast<void>(s.posterior.joint(view, states)); }},
          {"sample",
           [&] {
             static_cast<void>(s.posterior.sample({{view, states}}, 1, 0));
           }},
          {"paths", [&] {
             static_cast<void>(sample_paths(s.posterior, 1, {20, 0}).evaluate(0, view, states));
           }}};
}

Doors doors_of_learning(const Surface& s, const std::vector<Observations>& observations) {
  return {{"default_scales", [&] { default_scales(s.prior, observations); }},
          {"default_hyperparameters", [&] { default_hyperparameters(s.prior, observations, {}, {}); }},
          {"Likelihood", [&] { Likelihood(s.prior, observations, s.values, {}); }},
          {"Posterior", [&] { Posterior(s.prior, observations, s.values); }},
          {"update", [&] { static_cast<void>(update(Posterior(s.posterior), observations.front())); }},
          {"laplace_uncertainty", [&] { laplace_uncertainty(s.prior, observations, s.hyperparameters); }},
          {"fit_robust", [&] { fit_robust(s.prior, observations, s.hyperparameters); }},
          {"fit", [&] { fit(s.prior, observations, s.hyperparameters); }}};
}

TEST(Requirements, AViewHasTheRowsTheLatentAndTheTimeStepThatItNames) {
  const Surface s;
  View view = s.ddq;
  const auto expect = [&](const std::string& text) {
    expect_refusal(doors_of_prediction(s, view, s.data.states), text);
    expect_refusal(doors_of_learning(s, {s.observed(view)}), text);
    expect_refusal({{"Predictor", [&] { Predictor(s.posterior, view); }}}, text);
  };
  view.rows = {0, 5};
  expect("view 'constrained': there are the rows 0 … 2, got 5");
  EXPECT_THAT(input_error_of([&] { static_cast<void>(view.names(*s.model.system)); }), HasSubstr("rows 0 … 2, got 5"));
  view.rows = {-1};
  expect("view 'constrained': there are the rows 0 … 2, got -1");
  view.rows = {};
  expect("view 'constrained' is of no rows; View::all has every one");
  view = s.ddq;
  view.latent = 9;
  expect("view 'constrained': the prior has 1 latents, numbered from 0, got the latent 9");
  view = View::all(Quantity::next_velocity, *s.model.system);
  expect("view 'next-velocity' needs a time step");
  view.time_step = -0.1;
  expect("view 'next-velocity': the time step must be positive, got -0.1");
  view.time_step = not_a_number;
  expect("view 'next-velocity': the time step must be positive, got nan");
}

TEST(Requirements, AnotherSystemHasTheLatentsOfThePrior) {
  const Surface s;
  const auto other = make_other_system(s.model, s.model);
  View view = s.ddq;
  const auto expect = [&](const OtherSystem& changed, const std::string& text) {
    view.other_system = std::make_shared<const OtherSystem>(changed);
    expect_refusal(doors_of_prediction(s, view, s.data.states), text);
    expect_refusal(doors_of_learning(s, {s.observed(view)}), text);
  };
  OtherSystem changed = *other;
  changed.prior.latents.clear();
  expect(changed, "its other system has 0 latents, the fitted one 1");
  changed = *other;
  changed.shared.assign(changed.shared.size(), 99);
  expect(changed, "parameters, numbered from 0, got the number 99");
  changed.shared.clear();
  expect(changed, "shared has 0 numbers");
  changed = *other;
  changed.prior.latents[0].feature_names[3] = "z";
  expect(changed, "view: the latent 'unconstrained acceleration' of its other system has the features q1, q2, q3, z, ");
  changed = *other;
  changed.prior.system = nullptr;
  expect(changed, "prior: it has no system");
}

TEST(Requirements, StatesAreThoseOfTheSystem) {
  const Surface s;
  const System& system = *s.model.system;
  const MatrixXd few = s.data.states.topRows(5);
  const std::string text = "states: a column is a state of 'particle on a surface' and must have 10 rows, q1, q2, q3, dq1,";
  expect_refusal(doors_of_prediction(s, s.ddq, few), text);
  expect_refusal(doors_of_learning(s, {test::with_states(s.observations[0], few)}), text);
  const VectorXd parameters = system.parameter_values();
  expect_refusal({{"evaluate", [&] { static_cast<void>(system.evaluate(few, parameters)); }},
                  {"differentiate", [&] { static_cast<void>(system.differentiate(few, parameters, 0)); }},
                  {"residuals", [&] { static_cast<void>(system.residuals(few, parameters)); }},
                  {"require_mechanics", [&] { static_cast<void>(require_mechanics(system, few, parameters)); }}},
                 text);
  const VectorXd too_many = VectorXd::Ones(parameters.size() + 1);
  expect_refusal({{"evaluate", [&] { static_cast<void>(system.evaluate(s.data.states, too_many)); }},
                  {"residuals", [&] { static_cast<void>(system.residuals(s.data.states, too_many)); }}},
                 "parameters: there must be a number for each of the");
  EXPECT_THAT(input_error_of([&] { static_cast<void>(system.differentiate(s.data.states, parameters, 99)); }),
              HasSubstr("parameters, numbered from 0, got the number 99"));
  EXPECT_THAT(input_error_of([&] { static_cast<void>(evaluate_features(s.prior, 0, few)); }),
              AllOf(HasSubstr("a state of"), Not(HasSubstr("tape"))));
}

TEST(Requirements, StatesRowsLatentsAndHyperparametersAreThoseThatThereAre) {
  const Surface s;
  const Observations& group = s.observations.front();
  const VectorXd stddev = group.noise().stddev();
  EXPECT_EQ(input_error_of([&] { static_cast<void>(evaluate_features(s.prior, 9, s.data.states)); }),
            "evaluate_features: the prior has 1 latents, numbered from 0, got the latent 9");
  for (const int i : {-1, 7}) {
    EXPECT_EQ(input_error_of([&] { static_cast<void>(group.noise_at(stddev, i)); }),
              "observations: 1 states from number " + std::to_string(i) + " on are asked for, of 7");
  }
  for (const int k : {-1, 3}) {
    expect_refusal({{"states_noise", [&] { static_cast<void>(group.states_noise(k)); }},
                    {"measured_scales", [&] { static_cast<void>(group.measured_scales(k)); }}},
                   "observations: there are the rows 0 … 2, got " + std::to_string(k));
  }
  const VectorXd many = VectorXd::Ones(4);
  expect_refusal({{"noise_at", [&] { static_cast<void>(group.noise_at(many, 0)); }},
                  {"noise_of_values", [&] { static_cast<void>(group.noise_of_values(many)); }},
                  {"usual_noise", [&] { static_cast<void>(group.usual_noise(many)); }}},
                 "observations: the noise of each row must be 3 × 1, got 4 × 1");
  FitReport report;
  report.hyperparameters = s.hyperparameters;
  const std::size_t n = report.hyperparameters.size();
  const std::string text =
      "the fit has " + std::to_string(n) + " hyperparameters, numbered from 0, got the number " + std::to_string(n);
  EXPECT_EQ(input_error_of([&] { parameter_uncertainty(report, n); }), "parameter_uncertainty: " + text);
  EXPECT_EQ(input_error_of([&] { parameter_correlation(report, 0, n); }), "parameter_correlation: " + text);
  EXPECT_EQ(input_error_of([&] { parameter_correlation(report, n, 0); }), "parameter_correlation: " + text);
}

TEST(Requirements, APushAndASlipAreOfTheConstraints) {
  const Surface s;
  const ModelMotion motion(s.model);
  EXPECT_EQ(input_error_of([&] { static_cast<void>(motion.pushed(VectorXd::Ones(2))); }),
            "ModelMotion::pushed: push must be 1 × 1, got 2 × 1");
  EXPECT_EQ(input_error_of([&] { static_cast<void>(motion.acceleration(s.data.states, MatrixXd::Ones(1, 7))); }),
            "ModelMotion::acceleration: slip must be 0 × 7, got 1 × 7");
  EXPECT_EQ(input_error_of([&] { static_cast<void>(pushed(s.prior, s.ddq, VectorXd::Ones(2))); }),
            "pushed: push must be 1 × 1, got 2 × 1");
}

TEST(Requirements, AStateThatIsNotKnownIsNamedByItsEntry) {
  const Surface s;
  MatrixXd states = s.data.states;
  states(0, 2) = not_a_number;
  const std::string text = "of what the equations read q1 is nan at state 3 (q2 = ";
  expect_refusal(doors_of_prediction(s, s.ddq, states), text);
  expect_refusal(doors_of_learning(s, {test::with_states(s.observations[0], states)}), text);
}

TEST(Requirements, ValuesAreOfThePriorAndItsObservations) {
  const Surface s;
  const Likelihood likelihood(s.prior, s.observations, s.values, {});
  ModelValues values;
  const auto expect = [&](const std::string& text) {
    Likelihood::Workspace workspace;
    expect_refusal({{"Likelihood", [&] { Likelihood(s.prior, s.observations, values, {}); }},
                    {"evaluate", [&] { likelihood.evaluate(values, nullptr, workspace); }},
                    {"Posterior", [&] { Posterior(s.prior, s.observations, values); }}},
                   text);
  };
  const auto change = [&](const auto& how) {
    values = s.values;
    how(values);
  };
  expect("values: kernel is of 0 latents, there are 1");
  change([](ModelValues& v) { v.kernel[0].conservativeResize(1); });
  expect("values: kernel of latent '");
  change([](ModelValues& v) { v.kernel[0][0] = not_a_number; });
  expect("must be finite and positive, got nan");
  change([](ModelValues& v) { v.signal_stddev[0][0] = -1; });
  expect("must be finite and not negative, got -1");
  change([](ModelValues& v) { v.noise_stddev.clear(); });
  expect("values: noise_stddev is of 0 observations, there are 1");
  change([](ModelValues& v) { v.noise_stddev[0].resize(0); });
  expect("values: noise_stddev of observations 1 must have 3 numbers, got 0");
  for (const double noise : {not_a_number, 0.0, -1.0}) {
    change([&](ModelValues& v) { v.noise_stddev[0][1] = noise; });
    expect("values: noise_stddev of observations 1 must be finite and positive, got");
  }
  change([](ModelValues& v) { v.parameters.resize(0); });
  expect("values: parameters of 'particle on a surface' must have");
  change([](ModelValues& v) { v.free_loading = {MatrixXd::Ones(3, 2)}; });
  expect("must be 0 × 0, got 3 × 2");
  EXPECT_THAT(input_error_of([&] {
                Likelihood(s.prior, s.observations, s.values, {{99}, false});
              }),
              HasSubstr("parameters, numbered from 0, got the number 99"));
}

TEST(Requirements, HyperparametersAreOfThePriorAndInOrder) {
  const Surface s;
  std::vector<Hyperparameter> hyperparameters = s.hyperparameters;
  const auto expect = [&](const std::string& text) {
    expect_refusal({{"fit", [&] { fit(s.prior, s.observations, hyperparameters); }},
                    {"fit_robust", [&] { fit_robust(s.prior, s.observations, hyperparameters); }},
                    {"laplace_uncertainty", [&] { laplace_uncertainty(s.prior, s.observations, hyperparameters); }}},
                   text);
  };
  const auto expect_everywhere = [&](const std::string& text) {
    expect(text);
    expect_refusal({{"model_values", [&] { model_values(s.prior, s.observations, hyperparameters); }}}, text);
  };
  const auto change = [&](const auto& how) {
    hyperparameters = s.hyperparameters;
    how(hyperparameters[0]);
  };
  const auto of_another = [&](Kind kind, int owner, int index) {
    change([&](Hyperparameter& h) {
      h = Hyperparameter::of(kind, static_cast<std::size_t>(owner), 0);
      h.index = index;
      h.value = 1, h.lower = 0.5, h.upper = 2;
    });
    expect_everywhere("belongs to nothing of this prior and these observations: was it made for others?");
  };
  of_another(Kind::kernel, 3, 0);
  of_another(Kind::kernel, 0, 99);
  of_another(Kind::signal_stddev, 0, -1);
  of_another(Kind::shared_signal_stddev, 0, 0);
  of_another(Kind::loading, 0, 0);
  of_another(Kind::noise_stddev, 1, 0);
  of_another(Kind::parameter, 0, 99);
  change([](Hyperparameter& h) { std::swap(h.lower, h.upper); });
  expect("its bounds must be finite and positive, the lower one below the upper, got [");
  change([](Hyperparameter& h) { h.value = not_a_number; });
  expect_everywhere("its value must be finite and positive, got nan");
  change([](Hyperparameter& h) { h.hyperprior = {HyperPrior::Form::normal, 1, 0}; });
  expect("its hyper-prior has the median 1, the deviation 0 and the correlation 0");
  change([](Hyperparameter& h) { h.hyperprior = {HyperPrior::Form::normal, 1, 1, "all", 1}; });
  expect("its hyper-prior has the median 1, the deviation 1 and the correlation 1");
  change([](Hyperparameter& h) { h.followers.push_back({0, 99, 1}); });
  expect_everywhere("belongs to nothing of this prior and these observations");
  change([](Hyperparameter& h) { h.value = 2 * h.upper; });
  EXPECT_THAT(input_error_of([&] { fit(s.prior, s.observations, hyperparameters); }), HasSubstr("outside its bounds ["));
}

TEST(Requirements, AFitHasSomethingToLearnFromAndOptionsThatMeanSomething) {
  const Surface s;
  for (const bool empty : {true, false}) {
    std::vector<Observations> observations;
    if (!empty) observations = {s.observations[0].with_values(MatrixXd::Constant(3, 7, not_a_number))};
    Doors doors = doors_of_learning(s, observations);
    for (const char* other : {"Likelihood", "Posterior", "update", "laplace_uncertainty"}) doors.erase(other);
    if (empty) doors.erase("fit_robust");  // its hyperparameters are those of observations
    for (const auto& [name, door] : doors) {
      EXPECT_THAT(input_error_of(door), HasSubstr(empty ? "there is nothing to learn from: no observations are given"
                                                        : "there is nothing to learn from: every value is NaN, not measured"))
          << name;
    }
  }
  const auto refusal = [&](const auto& change) {
    FitOptions options;
    change(options);
    return input_error_of([&] { fit(s.prior, s.observations, s.hyperparameters, options); });
  };
  EXPECT_EQ(refusal([](FitOptions& o) { o.n_restarts = 0; }), "fit: n_restarts must be at least 1, got 0");
  EXPECT_EQ(refusal([](FitOptions& o) { o.max_iterations = -1; }), "fit: max_iterations must be at least 0, got -1");
  EXPECT_EQ(refusal([](FitOptions& o) { o.n_threads = -1; }), "fit: n_threads must be at least 0, got -1");
  EXPECT_EQ(refusal([](FitOptions& o) { o.max_side_by_side = -1; }), "fit: max_side_by_side must be at least 0, got -1");
  EXPECT_EQ(refusal([](FitOptions& o) { o.gradient_tolerance = not_a_number; }),
            "fit: gradient_tolerance must be at least 0, got nan");
  EXPECT_EQ(refusal([](FitOptions& o) { o.reduction_tolerance = -1; }), "fit: reduction_tolerance must be at least 0, got -1");
  EXPECT_EQ(refusal([](FitOptions& o) { o.max_escapes = -1; }), "fit: max_escapes must be at least 0, got -1");
  const auto robust = [&](const RobustOptions& options) {
    return input_error_of([&] { fit_robust(s.prior, s.observations, s.hyperparameters, {}, options); });
  };
  EXPECT_EQ(robust({.threshold = 0}), "fit_robust: threshold must be positive, got 0");
  EXPECT_EQ(robust({.max_rounds = 0}), "fit_robust: max_rounds must be at least 1, got 0");
}

TEST(Requirements, APriorIsWhole) {
  const Surface s;
  const std::string no_system = "make_prior: there is no system; a model that was never read, or was moved away, has none";
  EXPECT_EQ(input_error_of([] { make_prior(nullptr, {}); }), no_system);
  EXPECT_EQ(input_error_of([] { make_prior(Model()); }), no_system);
  EXPECT_EQ(input_error_of([] { const ModelMotion motion{Model()}; }), no_system);
  EXPECT_EQ(input_error_of([] { model_acceleration(Model()); }), no_system);
  EXPECT_EQ(input_error_of([] { static_cast<void>(Model::from_code(nullptr, {})); }), no_system);

  Prior prior;
  const auto expect = [&](const std::string& text) {
    expect_refusal({{"reads", [&] { static_cast<void>(prior.reads()); }},
                    {"Posterior", [&] { Posterior(prior, {}, s.values); }},
                    {"Likelihood", [&] { Likelihood(prior, s.observations, s.values, {}); }},
                    {"default_hyperparameters", [&] { default_hyperparameters(prior, s.observations, {}, {}); }},
                    {"model_values", [&] { model_values(prior, s.observations, s.hyperparameters); }},
                    {"fit", [&] { fit(prior, s.observations, s.hyperparameters); }}},
                   text);
  };
  expect("prior: it has no system; make it by make_prior, and use none that was moved away");
  prior = s.prior;
  prior.latents[0].features = nullptr;
  expect("has no features; make_prior makes whole ones");
  prior = s.prior;
  prior.latents[0].kernel = {};
  expect("has no kernel");
  prior = s.prior;
  prior.latents[0].feature_names.pop_back();
  expect("features of");
  prior = s.prior;
  prior.latents[0].column_names.pop_back();
  expect("has 2 columns, but directions of 9 numbers for 3 coordinates");
  prior = s.prior;
  prior.latents[0].free_loading = 0;
  expect("has 0 functions");
  prior = s.prior;
  prior.mean = Prior::Mean::constant;
  expect("its constant mean has 0 numbers for 3 coordinates");
}

TEST(Requirements, WhatWasMovedAwaySaysSo) {
  const Surface s;
  const VectorXd state = s.data.states.col(0);
  VectorXd mean(3);
  Posterior posterior = s.posterior;
  Predictor predictor(posterior);
  Predictor::Workspace workspace = predictor.make_workspace();
  PathwiseSamples paths = sample_paths(posterior, 1, {20, 0});
  Likelihood likelihood(s.prior, s.observations, s.values, {});
  const Predictor predictor_there = std::move(predictor);
  const PathwiseSamples paths_there = std::move(paths);
  const Likelihood likelihood_there = std::move(likelihood);
  const Posterior posterior_there = std::move(posterior);
  Likelihood::Workspace of_likelihood;
  // NOLINTBEGIN(bugprone-use-after-move)
  expect_refusal({{"mean", [&] { static_cast<void>(posterior.mean(s.ddq, s.data.states)); }},
                  {"marginal", [&] { static_cast<void>(posterior.marginal(s.ddq, s.data.states)); }},
                  {"joint", [&] { static_cast<void>(posterior.joint(s.ddq, s.data.states)); }},
                  {"sample",
                   [&] {
                     static_cast<void>(posterior.sample({{s.ddq, s.data.states}}, 1, 0));
                   }},
                  {"without_data", [&] { static_cast<void>(posterior.without_data()); }},
                  {"prior", [&] { static_cast<void>(posterior.prior()); }},
                  {"observations", [&] { static_cast<void>(posterior.observations()); }},
                  {"values", [&] { static_cast<void>(posterior.values()); }},
                  {"likelihood", [&] { static_cast<void>(posterior.negative_log_likelihood()); }},
                  {"reduced_size", [&] { static_cast<void>(posterior.reduced_size()); }},
                  {"update", [&] { static_cast<void>(update(std::move(posterior), s.observations[0])); }},
                  {"remove_oldest", [&] { static_cast<void>(remove_oldest(std::move(posterior), 1)); }},
                  {"sample_paths", [&] { static_cast<void>(sample_paths(posterior, 1)); }},
                  {"Predictor", [&] { static_cast<void>(Predictor(posterior)); }}},
                 "Posterior: it was moved away; use the one that it was moved to");
  expect_refusal({{"view", [&] { static_cast<void>(predictor.view()); }},
                  {"options", [&] { static_cast<void>(predictor.options()); }},
                  {"make_workspace", [&] { static_cast<void>(predictor.make_workspace()); }},
                  {"mean", [&] { static_cast<void>(predictor.mean(state, mean, workspace)); }}},
                 "Predictor: it was moved away");
  expect_refusal({{"n_samples", [&] { static_cast<void>(paths.n_samples()); }},
                  {"evaluate", [&] { static_cast<void>(paths.evaluate(0, s.ddq, s.data.states)); }}},
                 "PathwiseSamples: it was moved away");
  expect_refusal({{"prior", [&] { static_cast<void>(likelihood.prior()); }},
                  {"observations", [&] { static_cast<void>(likelihood.observations()); }},
                  {"reduced_size", [&] { static_cast<void>(likelihood.reduced_size()); }},
                  {"evaluate", [&] { likelihood.evaluate(s.values, nullptr, of_likelihood); }}},
                 "Likelihood: it was moved away");
  // NOLINTEND(bugprone-use-after-move)
}

TEST(Requirements, ThereAreNoFewerSamplesThanNone) {
  const Surface s;
  EXPECT_EQ(input_error_of([&] {
              static_cast<void>(s.posterior.sample({{s.ddq, s.data.states}}, -1, 0));
            }),
            "Posterior::sample: n_samples must not be negative, got -1");
}

TEST(Requirements, AnEvaluationHasATargetForEachRowAndState) {
  const Surface s;
  const auto refusal = [&](const std::vector<int>& rows, const MatrixXd& targets) {
    return input_error_of([&] { evaluate_predictions(s.posterior, s.data.states, rows, targets); });
  };
  EXPECT_EQ(refusal({0, 1}, s.data.accelerations), "evaluate_predictions: targets must be 2 × 7, got 3 × 7");
  EXPECT_THAT(refusal({0, 7}, MatrixXd::Ones(2, 7)), HasSubstr("there are the rows 0 … 2, got 7"));
  EXPECT_EQ(
      input_error_of([&] {
        evaluate_predictions(s.posterior, s.data.states, {0, 1, 2}, s.data.accelerations, {.noise_stddev = MatrixXd::Ones(3, 1)});
      }),
      "evaluate_predictions: noise_stddev must be 3 × 7, got 3 × 1");
  EXPECT_EQ(input_error_of([&] { pit_histogram(VectorXd::Zero(3), 0); }), "pit_histogram: n_bins must be 1 or more, got 0");
  EXPECT_EQ(input_error_of([&] {
              max_constraint_error(*s.model.system, s.data.states, s.model.system->parameter_values(), MatrixXd::Ones(3, 6));
            }),
            "max_constraint_error: accelerations must be 3 × 7, got 3 × 6");
}

}  // namespace
}  // namespace gp2
