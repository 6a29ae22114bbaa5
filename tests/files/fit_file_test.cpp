#include "gp2/files/fit_file.hpp"

#include <array>
#include <functional>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <nlohmann/json.hpp>

#include "gp2/base/version.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "io_testing.hpp"
#include "observations_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Json = nlohmann::ordered_json;
using test::input_error_of;
using test::TemporaryFolder;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;

struct FitSettings {
  PriorOptions prior;
  Protocol protocol;
  bool estimate_noise = true;
  int n = 6;
};

/// A fit of a model to its own simulated data, conditioned at the start values.
FitFile fit_of(const Model& model, const FitSettings& settings = {}) {
  const int nq = model.system->nq();
  const Eigen::VectorXd noise_stddev = Eigen::Map<const Eigen::VectorXd>(model.noise.stddev.data(), nq);
  const GeneratedData data = generate(model, {settings.n, 3, noise_stddev});
  FitFile fit;
  fit.model = model;
  fit.prior_options = settings.prior;
  fit.data_source = "log.csv";
  fit.observations.push_back({data.states, View::all(View::Quantity::constrained_acceleration, *model.system), data.accelerations,
                              noise_stddev, settings.estimate_noise});
  const auto hyperparameters = default_hyperparameters(fit.prior(), fit.observations, {}, settings.protocol);
  FitOptions options;
  options.max_iterations = 0;
  fit.report = gp2::fit(fit.prior(), fit.observations, hyperparameters, options).report;
  return fit;
}

Json written_json(const FitFile& fit) {
  const TemporaryFolder folder;
  fit.write(folder / "fit.json");
  return Json::parse(read_file(folder / "fit.json"));
}

FitFile written_and_read(const FitFile& fit) {
  const TemporaryFolder folder;
  fit.write(folder / "fit.json");
  return FitFile::read(folder / "fit.json");
}

void expect_same_predictions(const FitFile& a, const FitFile& b) {
  const Posterior first = a.posterior(), second = b.posterior();
  const System& system = *a.model.system;
  const Eigen::MatrixXd states = generate(a.model, {5, 8, Eigen::VectorXd::Zero(system.nq())}).states;
  for (const auto quantity : {View::Quantity::constrained_acceleration, View::Quantity::unconstrained_acceleration}) {
    const View view = View::all(quantity, system);
    EXPECT_EQ(first.mean(view, states), second.mean(view, states));
    EXPECT_EQ(first.marginal(view, states).covariance, second.marginal(view, states).covariance);
    EXPECT_EQ(first.sample({{view, states}}, 2, 7), second.sample({{view, states}}, 2, 7));
    EXPECT_TRUE(first.mean(view, states).allFinite());
  }
  EXPECT_EQ(first.negative_log_likelihood(), second.negative_log_likelihood());
}

// ---- there and back

// ---- from a fit

TEST(FitFileOfAFit, IsHeldAgainstIt) {
  const Model& model = test::model("models/surface.toml");
  const Model& other = test::model("models/duffing.toml");
  FitSettings settings;
  settings.prior.mean = Prior::Mean::force;
  const FitFile by_hand = fit_of(model, settings);
  const Fit fit = {by_hand.posterior(), by_hand.report};
  const FitFile file(model, by_hand.prior_options, fit);
  expect_same_predictions(by_hand, written_and_read(file));

  const auto refusal = [&](const Model& of, const FitPriorOptions& options, const Fit& given) {
    return input_error_of([&] { FitFile(of, options, given); });
  };
  const std::string differ =
      "FitFile: model, prior_options and systems make another prior than that of the fit; what differs at observations 1: ";
  EXPECT_EQ(refusal(model, {}, fit), differ + "the prior mean");
  FitPriorOptions options = by_hand.prior_options;
  options.base = Latent::Base::force;
  EXPECT_THAT(refusal(model, options, fit), StartsWith(differ + "the directions of the latent '"));
  options = by_hand.prior_options;
  options.discrepancy = Discrepancy{Eigen::VectorXd::Ones(std::ssize(model.latents[0].features)), Eigen::VectorXd::Ones(3)};
  EXPECT_EQ(refusal(model, options, fit), differ + "it has 2 latents, the fit 1");
  EXPECT_EQ(refusal(other, by_hand.prior_options, fit), differ + "the coordinates and inputs");
  Fit changed = fit;
  changed.report.hyperparameters[0].value *= 1.5;
  EXPECT_EQ(refusal(model, by_hand.prior_options, changed),
            "FitFile: the hyperparameters of the report are not those of the posterior");
}

TEST(FitFileOfAFit, HasTheModelsOfItsOtherSystems) {
  const auto model = std::make_shared<const Model>(test::model("models/surface.toml"));
  FitFile by_hand = fit_of(*model);
  View view = by_hand.observations[0].view();
  view.other_system = make_other_system(*model, *model);
  by_hand.observations[0] = by_hand.observations[0].with_view(view);
  const Fit fit = {by_hand.posterior(), by_hand.report};
  EXPECT_EQ(input_error_of([&] { FitFile(*model, {}, fit); }),
            "FitFile: the model file of the system of observations 1 is not given");
  const FitFile file(*model, {}, fit, {model});
  EXPECT_EQ(written_and_read(file).posterior().negative_log_likelihood(), fit.posterior.negative_log_likelihood());
}

TEST(FitFileOfAFit, RefusesToWriteHyperparametersOfAnother) {
  FitFile file = fit_of(test::model("models/surface.toml"));
  file.report.hyperparameters[0].owner = 7;
  EXPECT_THAT(input_error_of([&] { written_json(file); }), HasSubstr("belongs to nothing of this prior and these observations"));
}

class FitFileOf : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, FitFileOf, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(FitFileOf, PredictsTheSameBitsAfterItWasWrittenAndRead) {
  const FitFile fit = fit_of(test::model(GetParam()));
  const FitFile read = written_and_read(fit);
  expect_same_predictions(fit, read);
  // computed on another way while training
  const double nll = read.report.negative_log_likelihood;
  EXPECT_NEAR(read.posterior().negative_log_likelihood(), nll, 1e-9 * (1 + std::abs(nll)));
}

const Model& unicycle() { return test::model("models/unicycle.toml"); }

TEST(FitFile, EveryChoiceOfPriorAndProtocolSurvives) {
  for (const Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    for (const auto base :
         {std::optional<Latent::Base>(), std::optional(Latent::Base::acceleration), std::optional(Latent::Base::force)}) {
      for (const auto protocol : {Protocol::Name::standard, Protocol::Name::paper}) {
        const bool paper = protocol == Protocol::Name::paper;
        const FitFile fit = fit_of(unicycle(), {{mean, base, paper}, {protocol, true}, !paper});
        const FitFile read = written_and_read(fit);
        EXPECT_EQ(read.prior_options.mean, mean);
        EXPECT_EQ(read.prior_options.base, base);
        EXPECT_EQ(read.prior_options.raw_angles, paper);
        expect_same_predictions(fit, read);
      }
    }
  }
}

TEST(FitFile, ANoiseOfEachValueSurvivesToTheBit) {
  FitFile fit = fit_of(unicycle());
  EXPECT_FALSE(written_json(fit).at("observations").at(0).contains("noise_scale"));
  Observations& group = fit.observations.front();
  RandomStream random(3);
  Eigen::MatrixXd scale(group.values().rows(), group.values().cols());
  for (double& one : scale.reshaped()) one = 0.3 + random.uniform();
  group = test::with_scale(group, scale);
  const FitFile read = written_and_read(fit);
  EXPECT_EQ(read.observations.front().noise().scale(), group.noise().scale());
  expect_same_predictions(fit, read);
}

TEST(FitFile, TheReportSurvives) {
  FitFile fit = fit_of(unicycle());
  fit.report.converged = true;
  fit.report.termination = "because";
  fit.report.iterations = 12;
  fit.report.best_restart = 1;
  constexpr double infinity = std::numeric_limits<double>::infinity();
  fit.report.restarts = {{infinity, infinity, 0, 1, 1, false, "no finite start"}, {-2.5, -3.5, 12, 20, 2, true, "because"}};
  Hyperparameter& changed = fit.report.hyperparameters.front();
  changed.hyperprior = {HyperPrior::Form::log_normal, 2, 3, "siblings", 0.5};
  changed.followers = {{0, 2, 0.1}};
  const FitFile read = written_and_read(fit);
  EXPECT_EQ(read.data_source, "log.csv");
  EXPECT_EQ(read.model.text, fit.model.text);
  EXPECT_EQ(read.model.name, fit.model.name);
  EXPECT_EQ(read.report.negative_log_likelihood, fit.report.negative_log_likelihood);
  EXPECT_EQ(read.report.objective, fit.report.objective);
  EXPECT_TRUE(read.report.converged);
  EXPECT_EQ(read.report.termination, "because");
  EXPECT_EQ(read.report.iterations, 12);
  EXPECT_EQ(read.report.best_restart, 1);
  ASSERT_EQ(read.report.restarts.size(), 2U);
  EXPECT_EQ(read.report.restarts[0].objective, infinity);
  EXPECT_EQ(read.report.restarts[0].termination, "no finite start");
  EXPECT_EQ(read.report.restarts[1].negative_log_likelihood, -3.5);
  EXPECT_EQ(read.report.restarts[1].evaluations, 20);
  ASSERT_EQ(read.report.hyperparameters.size(), fit.report.hyperparameters.size());
  for (std::size_t k = 0; k < fit.report.hyperparameters.size(); ++k) {
    const Hyperparameter& a = fit.report.hyperparameters[k];
    const Hyperparameter& b = read.report.hyperparameters[k];
    EXPECT_EQ(std::tie(a.kind, a.owner, a.index, a.name, a.unit, a.value, a.lower, a.upper, a.positive, a.size),
              std::tie(b.kind, b.owner, b.index, b.name, b.unit, b.value, b.lower, b.upper, b.positive, b.size));
    EXPECT_EQ(
        std::tie(a.hyperprior.form, a.hyperprior.median, a.hyperprior.stddev, a.hyperprior.family, a.hyperprior.correlation),
        std::tie(b.hyperprior.form, b.hyperprior.median, b.hyperprior.stddev, b.hyperprior.family, b.hyperprior.correlation));
    ASSERT_EQ(a.followers.size(), b.followers.size());
    for (std::size_t f = 0; f < a.followers.size(); ++f) {
      EXPECT_EQ(std::tie(a.followers[f].latent, a.followers[f].column, a.followers[f].share),
                std::tie(b.followers[f].latent, b.followers[f].column, b.followers[f].share));
    }
  }
}

TEST(FitFile, WhatIsKnownOfDelaysSurvives) {
  FitFile fit = fit_of(Model::parse(R"toml(
name        = "cart"
coordinates = ["x"]
inputs      = [{ name = "u", delay = { value = 0.02, estimate = true }, lag = { value = 0.03, estimate = true } }]
[mechanics]
mass  = [["1.5"]]
force = ["u"]
[truth]
force = ["0"]
[noise]
ddq = 0.1
[sampling]
x  = [-1, 1]
dx = [-1, 1]
u  = [-1, 1]
)toml",
                                    "cart"));
  constexpr double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  for (const double stddev : {0.001, infinity, nan}) {
    fit.report.actuators = {{"u.delay", 0.02, stddev, 0, 0.1}, {"u.lag", 0.03, 0.002, 0, 0.2, {{"m", -0.1}}}};
    const std::vector<ActuatorEstimate> read = written_and_read(fit).report.actuators;
    ASSERT_EQ(read.size(), 2U);
    EXPECT_TRUE(read[0].stddev == stddev || (std::isnan(read[0].stddev) && std::isnan(stddev))) << stddev;
    EXPECT_EQ(std::tie(read[0].name, read[0].value, read[0].lower, read[0].upper),
              std::tie(fit.report.actuators[0].name, fit.report.actuators[0].value, fit.report.actuators[0].lower,
                       fit.report.actuators[0].upper));
    EXPECT_EQ(read[1].stddev, 0.002);
    EXPECT_EQ(read[1].moves, fit.report.actuators[1].moves);
  }
}

TEST(FitFile, StandardErrorsSurvive) {
  FitFile fit = fit_of(unicycle());
  EXPECT_FALSE(written_json(fit).at("report").contains("uncertainty"));
  EXPECT_FALSE(written_and_read(fit).report.uncertainty.has_value());
  const auto n = static_cast<Eigen::Index>(fit.report.hyperparameters.size());
  LaplaceUncertainty& written = fit.report.uncertainty.emplace();
  written.stddev = Eigen::VectorXd::LinSpaced(n, 0.1, 0.7);
  written.stddev[1] = std::numeric_limits<double>::infinity();
  written.correlation = Eigen::MatrixXd::Identity(n, n);
  written.correlation(0, 2) = written.correlation(2, 0) = -0.3;
  written.held = {3};
  written.undetermined = Eigen::MatrixXd::Zero(n, 1);
  written.undetermined(1, 0) = 1;
  written.distance_from_optimum = 0.01;
  const LaplaceUncertainty read = written_and_read(fit).report.uncertainty.value();
  EXPECT_EQ(read.stddev, written.stddev);
  EXPECT_EQ(read.correlation, written.correlation);
  EXPECT_EQ(read.held, written.held);
  EXPECT_EQ(read.undetermined, written.undetermined);
  EXPECT_EQ(read.distance_from_optimum, written.distance_from_optimum);
}

// three draws about the fitted values
FitFile drawn_fit() {
  FitFile fit = fit_of(unicycle());
  const auto n = static_cast<Eigen::Index>(fit.report.hyperparameters.size());
  HyperparameterDraws& draws = fit.report.draws.emplace();
  draws.values.resize(n, 3);
  for (Eigen::Index h = 0; h < n; ++h) {
    const double value = fit.report.hyperparameters[static_cast<std::size_t>(h)].value;
    draws.values.row(h) << value, 1.1 * value, 0.95 * value;
  }
  draws.mean = draws.values.rowwise().mean();
  draws.stddev = Eigen::VectorXd::LinSpaced(n, 0.1, 0.7);
  draws.lower = draws.mean - draws.stddev;
  draws.upper = draws.mean + 2 * draws.stddev;
  draws.r_hat = Eigen::VectorXd::LinSpaced(n, 1, 1.2);
  draws.effective_size = Eigen::VectorXd::LinSpaced(n, 90, 200);
  draws.correlation = Eigen::MatrixXd::Identity(n, n);
  draws.correlation(0, 2) = draws.correlation(2, 0) = -0.3;
  draws.n_chains = 4;
  draws.evaluations = 3500;
  draws.acceptance = 0.81;
  return fit;
}

TEST(FitFile, DrawsSurviveAndThePosteriorIsTheirMixture) {
  EXPECT_FALSE(written_json(fit_of(unicycle())).at("report").contains("draws"));
  const FitFile fit = drawn_fit(), read = written_and_read(fit);
  const HyperparameterDraws &a = *fit.report.draws, &b = read.report.draws.value();
  EXPECT_EQ(b.values, a.values);
  EXPECT_EQ(b.mean, a.mean);
  EXPECT_EQ(b.stddev, a.stddev);
  EXPECT_EQ(b.lower, a.lower);
  EXPECT_EQ(b.upper, a.upper);
  EXPECT_EQ(b.r_hat, a.r_hat);
  EXPECT_EQ(b.effective_size, a.effective_size);
  EXPECT_EQ(b.correlation, a.correlation);
  EXPECT_EQ(std::tie(b.n_chains, b.evaluations, b.acceptance), std::tie(a.n_chains, a.evaluations, a.acceptance));
  EXPECT_EQ(read.posterior().n_components(), 3);
  expect_same_predictions(fit, read);
  // a file of the fit, and of one whose posterior is another
  const Fit whole{fit.posterior(), fit.report};
  EXPECT_EQ(FitFile(fit.model, fit.prior_options, whole).posterior().n_components(), 3);
  EXPECT_EQ(input_error_of([&] {
              FitFile(fit.model, fit.prior_options, {fit.posterior().component(0), fit.report});
            }),
            "FitFile: the hyperparameters of the report are not those of the posterior");
  FitFile torn = fit;
  torn.report.draws->values.conservativeResize(2, Eigen::NoChange);
  EXPECT_EQ(input_error_of([&] { static_cast<void>(torn.posterior()); }),
            fmt::format("the draws of a fit must hold one number for each of its {} hyperparameters, got 2 × 3",
                        fit.report.hyperparameters.size()));
}

/// A fit through three inducing points of each latent.
FitFile fit_through_points() {
  FitFile fit = fit_of(unicycle());
  InducingReport& inducing = fit.report.inducing.emplace();
  const InducingChoice choice = choose_inducing_points(fit.prior(), fit.observations, fit.posterior().values(), {.most = 9});
  inducing.points = choice.points;
  inducing.n_variables = choice.n_variables;
  inducing.left_out = Eigen::VectorXd::Constant(std::ssize(choice.points->features), 0.25);
  inducing.n_start = 4;
  inducing.n_starts = 3;
  inducing.summary = fit.posterior().summary();
  inducing.stretches.emplace().pit = Eigen::VectorXd::Constant(Calibration::n_bins, 0.1);
  return fit;
}

TEST(FitFile, InducingPointsSurvive) {
  EXPECT_FALSE(written_json(fit_of(unicycle())).at("report").contains("inducing"));
  const FitFile fit = fit_through_points(), read = written_and_read(fit);
  const InducingReport &a = *fit.report.inducing, &b = read.report.inducing.value();
  EXPECT_EQ(b.points->features, a.points->features);
  EXPECT_EQ(std::tie(b.n_variables, b.left_out, b.n_start, b.n_starts),
            std::tie(a.n_variables, a.left_out, a.n_start, a.n_starts));
  expect_same_predictions(fit, read);
  EXPECT_NE(fit.posterior().negative_log_likelihood(), fit_of(unicycle()).posterior().negative_log_likelihood());
  // a posterior without them is another
  const Fit exact{fit_of(unicycle()).posterior(), fit.report};
  EXPECT_EQ(input_error_of([&] { FitFile(fit.model, fit.prior_options, exact); }),
            "FitFile: the hyperparameters of the report are not those of the posterior");
}

TEST(FitFile, WhatWasForgottenSurvives) {
  FitFile fit = fit_through_points();
  fit.take_data(forget(fit.posterior(), 0.25));
  EXPECT_FALSE(fit.report.inducing->stretches.has_value()) << "scores of before";
  const FitFile read = written_and_read(fit);
  const auto left_out = [](const FitFile& file) { return leave_one_out(file.posterior()).front().variance; };
  EXPECT_EQ(left_out(read), left_out(fit));
  EXPECT_NE(left_out(read), left_out(fit_through_points()));
}

TEST(FitFile, TheSameFitGivesTheSameBytes) {
  const TemporaryFolder folder;
  fit_of(unicycle()).write(folder / "a.json");
  fit_of(unicycle()).write(folder / "b.json");
  EXPECT_EQ(read_file(folder / "a.json"), read_file(folder / "b.json"));
  FitFile::read(folder / "a.json").write(folder / "c.json");
  EXPECT_EQ(read_file(folder / "a.json"), read_file(folder / "c.json"));
}

TEST(FitFile, KnowsTheLogsItWasLearnedFrom) {
  FitFile fit = fit_of(unicycle());
  EXPECT_TRUE(written_and_read(fit).logs.empty());
  fit.logs = {{"a.csv", 123, 4, "0123456789abcdef"}, {"b.csv", 5'000'000'000, 3'000'000'000, "fedcba9876543210"}};
  const FitFile read = written_and_read(fit);
  ASSERT_EQ(read.logs.size(), 2U);
  EXPECT_EQ(read.logs[1].name, "b.csv");
  EXPECT_EQ(read.logs[1].bytes, 5'000'000'000U);
  EXPECT_EQ(read.logs[1].rows, 3'000'000'000);
  EXPECT_TRUE(read.has_learned({"elsewhere.csv", 123, 4, "0123456789abcdef"})) << "it is the content that counts";
  EXPECT_FALSE(read.has_learned({"a.csv", 123, 4, "0123456789abcdee"}));
}

TEST(FitFile, TellsWhatWasAskedOfTheFit) {
  FitRequest request;
  const std::string text = options_json(options(request));
  FitFile fit = fit_of(unicycle());
  EXPECT_EQ(written_and_read(fit).options, "");
  fit.options = text;
  EXPECT_EQ(written_and_read(fit).options, text);
}

TEST(FitFile, RefusesToWriteOptionsThatAreNoObject) {
  FitFile fit = fit_of(unicycle());
  for (const char* text : {"{", "[1]"}) {
    fit.options = text;
    EXPECT_THAT(input_error_of([&] { written_and_read(fit); }), HasSubstr("the options of a fit must be a JSON object")) << text;
  }
}

class OldFit : public testing::TestWithParam<int> {};
INSTANTIATE_TEST_SUITE_P(OfFormat, OldFit, testing::Values(1, 2, 4, 5, 6, 7, 8, 9, 10, 12));

// written by gp2 when that format was its newest: alone; with a log of another system; with a noise per value; of a robot;
// without draws; without sums over states; without inducing points; of rows where sums over them stand now; with a
// discrepancy in every direction, without the logs; of one kernel for all latents
TEST_P(OldFit, IsReadAndWrittenAsTheNewest) {
  const auto path = std::filesystem::path(GP2_SOURCE_DIR) / "tests/files/old_fits" / fmt::format("version_{}.json", GetParam());
  ASSERT_EQ(Json::parse(read_file(path)).at("version"), GetParam());
  const FitFile old = FitFile::read(path);
  // on another way, and by another machine; that of draws is of the first of these
  const double nll = old.report.negative_log_likelihood;
  if (!old.report.draws) {
    EXPECT_NEAR(old.posterior().negative_log_likelihood(), nll, 1e-9 * (1 + std::abs(nll)));
  }
  EXPECT_EQ(old.options.empty(), GetParam() < 6);
  const Json json = written_json(old);
  EXPECT_EQ(json.at("version"), FitFile::format_version);
  const FitFile again = written_and_read(old);
  const View view = View::all(View::Quantity::constrained_acceleration, *old.model.system);
  const Eigen::MatrixXd& states = old.observations.front().states();
  EXPECT_EQ(old.posterior().mean(view, states), again.posterior().mean(view, states));
  EXPECT_EQ(old.posterior().marginal(view, states).covariance, again.posterior().marginal(view, states).covariance);
}

TEST(FitFile, StatesThatWereNotMeasuredStayUnknown) {
  const FitFile read = written_and_read(fit_of(unicycle()));
  EXPECT_TRUE(read.observations[0].states().topRows(2).array().isNaN().all());  // q1, q2
}

TEST(FitFile, ADataSourceThatIsNoTextIsNoObstacle) {
  FitFile fit = fit_of(unicycle());
  fit.data_source = "log\xff.csv";
  EXPECT_THAT(written_and_read(fit).data_source, StartsWith("log"));
}

TEST(FitFile, AFolderThatIsNotThereIsNamed) {
  EXPECT_EQ(input_error_of([] { fit_of(unicycle()).write("/nonexistent/fit.json"); }),
            "/nonexistent/fit.json: cannot be written: No such file or directory");
}

// ---- what is refused

class DamagedFit : public testing::Test {
 protected:
  /// What reading the fit says after `damage`, without the path.
  std::string error_after(const std::function<void(Json&)>& damage) {
    Json json = whole_;
    damage(json);
    return error_of(json.dump());
  }
  std::string error_of(const std::string& content) {
    const auto path = folder_.write("fit.json", content);
    const std::string error = input_error_of([&] { static_cast<void>(FitFile::read(path).posterior()); });
    const std::string prefix = path.string() + ": ";
    EXPECT_TRUE(error.empty() || error.starts_with(prefix)) << error;
    return error.substr(std::min(prefix.size(), error.size()));
  }
  static Json& hyperparameter(Json& json, const std::string& kind) {
    for (Json& h : json["hyperparameters"]) {
      if (h["kind"] == kind) return h;
    }
    throw std::runtime_error("no hyperparameter of kind " + kind);
  }

  TemporaryFolder folder_;
  const Json whole_ = [this] {
    fit_of(unicycle()).write(folder_ / "whole.json");
    return test::without_checksum(Json::parse(read_file(folder_ / "whole.json")));
  }();
};

TEST_F(DamagedFit, LogsWithoutASizeAreRefused) {
  const Json log = {{"name", "a.csv"}, {"bytes", -1}, {"rows", 4}, {"checksum", "0"}};
  EXPECT_EQ(error_after([&](Json& json) { json["logs"] = Json::array({log}); }), "-1 stands where a whole number must");
}

TEST_F(DamagedFit, TheWholeFitIsRead) {
  EXPECT_EQ(error_after([](Json&) {}), "");
}

TEST_F(DamagedFit, DrawsThatDoNotHoldTogetherAreRefused) {
  const Json draws = written_json(drawn_fit()).at("report").at("draws");
  const auto refused = [&](const std::function<void(Json&)>& damage) {
    return error_after([&](Json& json) { damage(json["report"]["draws"] = draws); });
  };
  EXPECT_EQ(refused([](Json&) {}), "");
  const std::size_t n = whole_.at("hyperparameters").size();
  const auto first = whole_.at("hyperparameters")[0].at("name").get<std::string>();
  EXPECT_EQ(refused([](Json& d) { d["values"] = Json::array(); }), "0 draws of hyperparameters, expected 1 … 1000");
  EXPECT_EQ(refused([](Json& d) { d["values"] = std::vector<int>(1001, 1); }),
            "1001 draws of hyperparameters, expected 1 … 1000");
  EXPECT_EQ(refused([](Json& d) { d["values"][1].erase(0); }), fmt::format("draws of {} of {} hyperparameters", n - 1, n));
  EXPECT_EQ(refused([](Json& d) { d["values"][1][0] = -1; }),
            fmt::format("a draw of hyperparameter '{}' has the impossible value -1", first));
  EXPECT_EQ(refused([](Json& d) { d["values"][1][0] = 1e200; }), "draws hold a number that is too large");
  EXPECT_EQ(refused([](Json& d) { d["values"][1][0] = nullptr; }), "null stands where a number must");
  EXPECT_EQ(refused([](Json& d) { d["correlation"].erase(0); }), "correlations that are not square");
  EXPECT_EQ(refused([](Json& d) { d["n_chains"] = 1.5; }), "1.5 stands where a whole number must");
  EXPECT_THAT(refused([](Json& d) { d.erase("r_hat"); }), StartsWith("not a whole fit file"));
}

TEST_F(DamagedFit, InducingPointsThatDoNotHoldTogetherAreRefused) {
  const Json inducing = written_json(fit_through_points()).at("report").at("inducing");
  const auto refused = [&](const std::function<void(Json&)>& damage) {
    return error_after([&](Json& json) { damage(json["report"]["inducing"] = inducing); });
  };
  EXPECT_EQ(refused([](Json&) {}), "");
  EXPECT_EQ(refused([](Json& i) { i["points"][0][0].erase(0); }), "inducing points whose features differ in number");
  EXPECT_EQ(refused([](Json& i) { i["points"][0][0][0] = 1e200; }), "inducing points hold a number that is too large");
  EXPECT_EQ(refused([](Json& i) { i["stretches"]["pit"].erase(0); }), "scores have 9 pit, expected 10");
  const auto refused_summary = [&](const std::function<void(Json&)>& damage) {
    return refused([&](Json& i) { damage(i["summary"]); });
  };
  EXPECT_EQ(refused_summary([](Json& s) { s["step"] = 0; }), "a step of 0 states is not possible");
  EXPECT_EQ(refused_summary([](Json& s) { s["states"][0] = -1; }), "-1 stands where a number of states must");
  EXPECT_THAT(refused_summary([](Json& s) { s["states"].push_back(1); }), StartsWith("numbers of states of 2 of 1 observations"));
  EXPECT_EQ(refused_summary([](Json& s) { s["shares"] = {std::vector<double>(6, 0.5)}; }), "");
  EXPECT_EQ(refused_summary([](Json& s) { s["shares"] = {std::vector<double>(5, 0.5)}; }), "shares of some states only");
  EXPECT_EQ(refused_summary([](Json& s) { s["shares"] = Json::array(); }), "shares of some states only");
  EXPECT_EQ(refused_summary([](Json& s) { s["shares"] = {std::vector<double>(6, 1.5)}; }),
            "shares of states must be from 0 to 1");
  EXPECT_EQ(refused_summary([](Json& s) { s["components"][0]["c"] = "00"; }),
            fmt::format("2 hexadecimal digits, expected {}", 16 * inducing.at("variables").get<int>()));
  EXPECT_EQ(refused_summary([](Json& s) {
              s["components"][0]["c"] = "7ff0000000000000" + s["components"][0]["c"].get<std::string>().substr(16);
            }),
            "'7ff0000000000000' is not a finite number in hexadecimal digits");
  EXPECT_EQ(refused_summary([](Json& s) { s["components"][0]["factors"].push_back(s["components"][0]["factors"][0]); }),
            "factors of more latents than there are");
  EXPECT_THAT(refused_summary([](Json& s) { s["components"][0]["factors"].clear(); }), StartsWith("factors of 0 of "));
  EXPECT_EQ(refused_summary([](Json& s) { s["components"][0]["factors"][0]["points"][0] = 99; }), "99 is no inducing point");
  EXPECT_EQ(refused_summary([](Json& s) {
              s["components"][0]["factors"][0]["L"] =
                  "8000000000000000" + s["components"][0]["factors"][0]["L"].get<std::string>().substr(16);
            }),
            "a factor of inducing points is not positive");
  EXPECT_EQ(refused_summary([](Json& s) { s["components"][0]["weight"].push_back(1); }), "weights of some latents only");
  EXPECT_EQ(refused_summary([](Json& s) { s["components"].push_back(s["components"][0]); }), "sums of 2 components of 1");
  EXPECT_EQ(refused_summary([](Json& s) { s.update(Json(s["components"][0])), s.erase("components"); }), "")
      << "before version 11";
  EXPECT_EQ(refused([](Json& i) { i["points"][0][0][0] = nullptr; }), "null stands where a number must");
  const std::size_t n_latents = inducing.at("points").size(), n_features = inducing.at("points")[0].size();
  EXPECT_EQ(refused([](Json& i) { i["points"].erase(0); }),
            fmt::format("inducing points of {} of {} latents", n_latents - 1, n_latents));
  EXPECT_EQ(refused([](Json& i) { i["points"][0].erase(0); }),
            fmt::format("inducing points of {} of {} features", n_features - 1, n_features));
  EXPECT_THAT(refused([](Json& i) { i.erase("left_out"); }), StartsWith("not a whole fit file"));
}

/// A fit of some kilobytes, as it is written.
std::string small_fit() {
  const Model model = Model::parse(R"(coordinates = ["x"]
[mechanics]
mass = [[2]]
[constraints]
position = ["x - t"]
[truth]
acceleration = ["-x"]
[sampling]
t = [0, 1]
[noise]
ddq = 0.1
)",
                                   "m.toml");
  FitFile fit = fit_of(model, {{}, {}, false, 2});
  FitRequest request;
  fit.options = options_json(options(request));
  const TemporaryFolder folder;
  fit.write(folder / "small.json");
  return read_file(folder / "small.json");
}

TEST_F(DamagedFit, CutShortAtAnyByteIsRefused) {
  const std::string content = small_fit();
  EXPECT_EQ(error_of(content), "");
  ASSERT_EQ(content.back(), '\n');
  for (std::size_t n = 0; n + 1 < content.size(); ++n) ASSERT_THAT(error_of(content.substr(0, n)), HasSubstr("cut short")) << n;
}

TEST_F(DamagedFit, WithAnyByteChangedIsRefusedOrMeansTheSame) {
  // a line end for a space, or an exponent in capitals, means the same: the checksum is of what is meant
  const std::string content = small_fit();
  const Json meant = Json::parse(content);
  int n_refused = 0, n_same = 0;
  for (std::size_t k = 0; k < content.size(); ++k) {
    std::string changed = content;
    constexpr std::array<char, 5> flips = {'\x01', '\x20', '\x2a', '\x80', '\x04'};  // in turn
    changed[k] = static_cast<char>(changed[k] ^ flips[k % flips.size()]);
    if (error_of(changed).empty()) {
      ASSERT_EQ(Json::parse(changed), meant) << k << " " << changed.substr(k, 20);
      ++n_same;
    } else {
      ++n_refused;
    }
  }
  EXPECT_GT(n_same, 0);
  EXPECT_GT(n_refused, 5 * n_same);
}

TEST_F(DamagedFit, ChangedByHandIsToldHowToMakeItGood) {
  const std::string content = small_fit();
  Json json = Json::parse(content);
  const std::string old = json["checksum"];
  EXPECT_EQ(old.size(), 16U);
  json["data_source"] = "another.csv";
  const std::string error = error_of(json.dump());
  EXPECT_THAT(error, StartsWith("the file was changed after gp2 wrote it: its checksum is \"" + old + "\", its content has \""));
  EXPECT_THAT(error, HasSubstr("If it is damaged, write it again with gp2 fit; if the change is meant, set \"checksum\": \""));

  const std::string before = "set \"checksum\": \"";
  json["checksum"] = error.substr(error.find(before) + before.size(), 16);
  EXPECT_EQ(error_of(json.dump()), "");
  json.erase("checksum");
  EXPECT_THAT(error_of(json.dump()), HasSubstr("its checksum is missing"));
  json["checksum"] = 17;
  EXPECT_THAT(error_of(json.dump()), HasSubstr("its checksum is 17, its content has"));
  json["checksum"] = {{"a", 1}};
  EXPECT_THAT(error_of(json.dump()), HasSubstr("its checksum is object, its content has"));
}

TEST_F(DamagedFit, WrittenAnewByOtherProgramsIsTheSame) {
  // other line ends, another order of keys, other digits of the same numbers
  const nlohmann::json sorted = nlohmann::json::parse(small_fit());
  EXPECT_EQ(error_of(sorted.dump()), "");
  std::string text = small_fit();
  ASSERT_NE(text.find("\"time_step\": 0.0"), std::string::npos);
  text.replace(text.find("\"time_step\": 0.0"), 16, "\"time_step\":0e-1 ");
  EXPECT_EQ(error_of(text), "");
}

TEST_F(DamagedFit, OfAnOlderVersionInNameOnlyIsRefused) {
  std::string text = small_fit();
  const std::string version = fmt::format("\"version\": {}", FitFile::format_version);
  text.replace(text.find(version), version.size(), "\"version\": 5");
  EXPECT_THAT(error_of(text), HasSubstr("changed after gp2 wrote it"));
}

TEST_F(DamagedFit, MadeToTakeAllTimeOrMemoryIsRefused) {
  EXPECT_EQ(error_of(std::string(1000000, '[')), "nested deeper than 64 levels");
  EXPECT_EQ(error_of(std::string(1000000, '[') + std::string(1000000, ']')), "nested deeper than 64 levels");
  std::string keys = R"({"format": "gp2 fit", "version": 5)";
  for (int k = 0; k < 300000; ++k) keys += fmt::format(",\"{}\":0", k);  // minutes, where a key is sought among all others
  EXPECT_THAT(error_of(keys + "}"), StartsWith("not a whole fit file"));
  EXPECT_EQ(error_after([](Json& json) { json["options"] = 3; }), "options must be an object, got 3");
}

TEST_F(DamagedFit, OtherFilesAreRefused) {
  EXPECT_EQ(error_of(""), "not valid JSON: the file is cut short or damaged; write it again with gp2 fit");
  EXPECT_EQ(error_of("{}"), "not a fit written by gp2");
  EXPECT_EQ(error_of("[1, 2]"), "not a fit written by gp2");
  EXPECT_EQ(error_of("3"), "not a fit written by gp2");
  EXPECT_EQ(error_of("{\"format\": \"other\", \"version\": 1}"), "not a fit written by gp2");
  EXPECT_EQ(error_of("{\"format\": \"gp2 fit\"}").substr(0, 20), "not a whole fit file");
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder_ / "none.json"); }), HasSubstr("cannot be read: No such file"));
}

TEST_F(DamagedFit, ANewerFormatIsRefusedWithBothVersions) {
  EXPECT_EQ(error_after([](Json& json) { json["version"] = FitFile::format_version + 1; }),
            fmt::format("of format {}, but this gp2 ({}) reads up to {}: use a newer gp2", FitFile::format_version + 1, version(),
                        FitFile::format_version));
  EXPECT_EQ(error_after([](Json& json) {
              // whatever else a newer format changes
              json = Json{{"format", "gp2 fit"}, {"version", 99}};
            }).substr(0, 12),
            "of format 99");
  EXPECT_EQ(error_after([](Json& json) { json["version"] = 0; }), "format 0 does not exist");
  EXPECT_EQ(error_after([](Json& json) { json["version"] = 4294967297; }), "4294967297 is too large");
  EXPECT_EQ(error_after([](Json& json) { json["version"] = 1.5; }), "1.5 stands where a whole number must");
}

TEST_F(DamagedFit, EveryPartThatIsMissingIsMissed) {
  for (const auto& [key, value] : whole_.items()) {
    if (key == "library") continue;  // for people only
    EXPECT_NE(error_after([&key = key](Json& json) { json.erase(key); }), "") << key;
  }
  for (const char* key : {"view", "rows", "n", "noise_stddev", "estimate_noise", "states", "values"}) {
    EXPECT_THAT(error_after([&](Json& json) { json["observations"][0].erase(key); }), HasSubstr(key));
  }
  for (const char* key : {"name", "value", "lower", "upper", "unit", "kind", "owner", "index"}) {
    EXPECT_THAT(error_after([&](Json& json) { json["hyperparameters"][0].erase(key); }), HasSubstr(key));
  }
  EXPECT_EQ(error_after([](Json& json) { json["observations"] = Json::array(); }), "no observations");
  EXPECT_EQ(error_after([](Json& json) { json["observations"][0]["states"].erase("dq1"); }), "the values of 'dq1' are missing");
  EXPECT_EQ(error_after([](Json& json) { json["observations"][0]["values"].erase("ddq3"); }), "the values of 'ddq3' are missing");
}

TEST_F(DamagedFit, EveryKindOfValueThatIsWrongIsRefused) {
  // the tree of the file, each leaf and branch replaced by values of other types
  const std::vector<Json> values = {
      nullptr, true, -1, 1e300, 1e18, "text", Json::array(), Json::object(), Json::array({nullptr})};
  std::vector<Json::json_pointer> places;
  const std::function<void(const Json&, const Json::json_pointer&)> visit = [&](const Json& json,
                                                                                const Json::json_pointer& place) {
    if (!place.empty()) places.push_back(place);
    if (json.is_object()) {
      for (const auto& [key, value] : json.items()) visit(value, place / key);
    } else if (json.is_array()) {
      for (std::size_t k = 0; k < std::min<std::size_t>(json.size(), 2); ++k) visit(json[k], place / k);
    }
  };
  visit(whole_, Json::json_pointer());
  // for people only, or null for ∞ or a value that is not measured
  const auto may_be_null = [](const std::string& place) {
    return place == "/library" || place.ends_with("/at_bound") || place.ends_with("/0/objective") || place.ends_with("/0/nll") ||
           place.find("/values/") != std::string::npos;
  };
  for (const auto& place : places) {
    for (const Json& value : values) {
      Json json = whole_;
      json[place] = value;
      const auto path = folder_.write("fit.json", json.dump());
      // an InputError, or a file that is still a fit: never another exception, and never a crash
      EXPECT_NO_THROW({
        try {
          FitFile::read(path);
        } catch (const InputError&) {
        }
      }) << place.to_string()
         << " = " << value.dump();
      if ((value.is_null() || value == Json::array({nullptr})) && !may_be_null(place.to_string())) {
        EXPECT_NE(error_of(json.dump()), "") << place.to_string();
      }
    }
  }
}

TEST_F(DamagedFit, ValuesOutOfPlaceAreNamed) {
  const auto observation = [](Json& json) -> Json& { return json["observations"][0]; };
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["rows"] = {0, 1, 3}; }), "row 3 of a view is outside 0 … 2");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["rows"] = {-1, 1, 2}; }), "row -1 of a view is outside 0 … 2");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["rows"] = {0, 1, 1}; }), "row 1 of a view stands twice");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["rows"] = Json::array(); }), "a view without rows");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["view"] = "velocity"; }), "'velocity' is no view");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["n"] = -1; }), "-1 observations are not possible");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["n"] = 2000000000; }), "'ddq1' has 6 values, expected 2000000000");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["n"] = 1e18; }), "1e+18 stands where a whole number must");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["states"]["dq1"][3] = nullptr; }), "null stands where a number must");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["states"]["dq1"].erase(3); }), "'dq1' has 5 values, expected 6");
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["states"]["q9"] = {1, 2, 3, 4, 5, 6}; }),
            "'q9' is not of this model");
  const std::string noise_rule = "noise_stddev must hold one positive number per row of the view";
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["noise_stddev"] = {0.1, 0.1}; }), noise_rule);
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["noise_stddev"] = {0.1, 0, 0.1}; }), noise_rule);
  const auto with_scale = [&](double value) {
    return error_after([&](Json& json) {
      observation(json)["noise_scale"] = observation(json)["values"];
      for (auto& [name, row] : observation(json)["noise_scale"].items()) row = std::vector<double>(6, value);
    });
  };
  EXPECT_EQ(with_scale(2), "");
  EXPECT_EQ(with_scale(0), "noise_scale must be positive and finite, got 0; a value that is worth nothing is NaN, not measured");
  for (const char* numbers : {"states", "values"}) {
    EXPECT_THAT(error_after([&](Json& json) { observation(json)[numbers].front()[0] = 1e300; }),
                HasSubstr("holds a number of the size 1e+300; at most 1e+100 can be computed with"));
  }
  EXPECT_EQ(error_after([&](Json& json) { observation(json)["noise_scale"] = Json::object(); }),
            "the values of 'ddq1' are missing");
  EXPECT_EQ(error_after([](Json& json) { json["prior"]["mean"] = "constant"; }), "'constant' is no prior mean");
  EXPECT_EQ(error_after([](Json& json) {
              json["hyperparameters"][0]["hyperprior"] = {{"median", 1}, {"log_stddev", 0}};
            }),
            "the deviation of a prior must be positive, got 0");
  EXPECT_EQ(error_after([](Json& json) { json["prior"]["directions"] = "up"; }), "'up' is no choice of directions");
  EXPECT_THAT(error_after([](Json& json) { json["model"]["text"] = "coordinates = 3"; }),
              HasSubstr("unicycle.toml:1: coordinates: expected an array"));
}

TEST_F(DamagedFit, HyperparametersThatBelongToNothingAreNamed) {
  const auto refused = [&](const std::string& kind, const char* key, const Json& value) {
    return error_after([&](Json& json) { hyperparameter(json, kind)[key] = value; });
  };
  for (const char* kind : {"kernel", "signal_stddev", "noise_stddev"}) {
    for (const char* key : {"owner", "index"}) {
      for (const int index : {-1, 99, 2147483647}) {
        EXPECT_THAT(refused(kind, key, index), HasSubstr("belongs to nothing in this model, or stands twice"))
            << kind << key << index;
      }
      EXPECT_THAT(refused(kind, key, 4294967296), HasSubstr("too large")) << kind << key;
    }
    EXPECT_THAT(refused(kind, "value", 0), HasSubstr("has the impossible value 0")) << kind;
    EXPECT_THAT(refused(kind, "value", -1), HasSubstr("has the impossible value -1")) << kind;
    EXPECT_THAT(refused(kind, "value", 1e300), HasSubstr("has the impossible value 1e+300")) << kind;
    EXPECT_THAT(refused(kind, "value", 1e-300), HasSubstr("has the impossible value 1e-300")) << kind;
    EXPECT_EQ(refused(kind, "value", nullptr), "null stands where a number must") << kind;
    EXPECT_EQ(refused(kind, "kind", "other"), "'other' is no kind of hyperparameter") << kind;
  }
  // one of them lost, or given twice
  EXPECT_EQ(error_after([](Json& json) { json["hyperparameters"].erase(0); }),
            "kernel 1 of latent 'unconstrained acceleration' has no value");
  EXPECT_THAT(error_after([](Json& json) { json["hyperparameters"].push_back(json["hyperparameters"][0]); }),
              HasSubstr("stands twice"));
}

// ---- start values

class StartValues : public testing::Test {
 protected:
  std::string error_of(const std::string& content) {
    const auto path = folder_.write("start.json", content);
    const std::string error = input_error_of([&] { read_start_values(path, hyperparameters_); });
    const std::string prefix = path.string() + ": ";
    EXPECT_TRUE(error.empty() || error.starts_with(prefix)) << error;
    return error.substr(std::min(prefix.size(), error.size()));
  }
  double& value(const std::string& name) {
    for (Hyperparameter& h : hyperparameters_) {
      if (h.name == name) return h.value;
    }
    throw std::runtime_error("no hyperparameter " + name);
  }
  static Hyperparameter named(const std::string& name, double value, double lower, double upper) {
    Hyperparameter h;
    h.name = name;
    h.value = value;
    h.lower = lower;
    h.upper = upper;
    return h;
  }

  TemporaryFolder folder_;
  std::vector<Hyperparameter> hyperparameters_ = {named("a", 1, 0.5, 2), named("b", 3, 1, 10)};
};

TEST_F(StartValues, AreFoundByNameAndTheOthersKept) {
  EXPECT_EQ(error_of("{\"b\": 7.5}"), "");
  EXPECT_EQ(value("b"), 7.5);
  EXPECT_EQ(value("a"), 1);
}

TEST_F(StartValues, ARoundingOutsideABoundIsTheBound) {
  EXPECT_EQ(error_of("{\"a\": 2.0000000001, \"b\": 0.9999999999}"), "");
  EXPECT_EQ(value("a"), 2);
  EXPECT_EQ(value("b"), 1);
}

TEST_F(StartValues, AnUnknownNameIsRefusedWithThoseThereAre) {
  EXPECT_EQ(error_of("{\"b\": 7.5, \"c\": 1}"), "unknown hyperparameter 'c'; this fit has: a, b");
  EXPECT_EQ(value("b"), 3) << "nothing is changed";
}

TEST_F(StartValues, OutsideTheBoundsAreRefused) {
  EXPECT_EQ(error_of("{\"a\": 2.1}"), "a = 2.1 is outside its bounds [0.5, 2]");
  EXPECT_EQ(error_of("{\"a\": -1}"), "a = -1 is outside its bounds [0.5, 2]");
}

TEST_F(StartValues, ThatAreNoNumbersAreRefused) {
  EXPECT_EQ(error_of("{\"a\": null}"), "'a' is not a number but null");
  EXPECT_EQ(error_of("{\"a\": \"1\"}"), "'a' is not a number but string");
  EXPECT_THAT(error_of("{\"a\": NaN}"), HasSubstr("not valid JSON"));
  EXPECT_THAT(error_of("{\"a\": 1e999}"), HasSubstr("not valid JSON"));
  EXPECT_THAT(error_of("[1]"), HasSubstr("expected {\"name\": value, …} or a file written by gp2 fit"));
  EXPECT_THAT(error_of("{\"a\": 1"), HasSubstr("not valid JSON"));
}

TEST_F(StartValues, MayComeFromAFitEvenOneWithMoreToTune) {
  const FitFile fit = fit_of(unicycle());
  const auto path = folder_ / "fit.json";
  fit.write(path);
  std::vector<Hyperparameter> start = fit.report.hyperparameters;
  start.pop_back();
  for (Hyperparameter& h : start) h.value = h.upper;
  read_start_values(path, start);
  for (std::size_t k = 0; k < start.size(); ++k) EXPECT_EQ(start[k].value, fit.report.hyperparameters[k].value) << start[k].name;
}

TEST_F(StartValues, FromADamagedFitAreRefused) {
  const int newer = FitFile::format_version + 1;
  EXPECT_THAT(error_of(fmt::format("{{\"format\": \"gp2 fit\", \"version\": {}}}", newer)),
              HasSubstr(fmt::format("of format {}", newer)));
  EXPECT_THAT(error_of("{\"format\": \"gp2 fit\", \"version\": 1}"), HasSubstr("not a whole fit file"));
}

}  // namespace
}  // namespace gp2
