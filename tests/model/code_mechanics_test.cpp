#include <algorithm>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <nlohmann/json.hpp>

#include "callable_surface.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/inference/likelihood.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/generate.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

// Model files whose mechanics are code: everything else is that of the same model as text.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using Json = nlohmann::ordered_json;
using test::input_error_of;
using test::TemporaryFolder;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;

constexpr std::uint64_t code_mechanics_seed = 60601;

const Model& text_model() { return test::model("models/surface.toml"); }

Model code_model(const MechanicsSource& mechanics = test::callable_surface) {
  return Model::parse(test::surface_without_mechanics(), "surface.toml", {mechanics});
}

/// The surface's own functions under another definition.
template <class Change>
MechanicsSource changed_surface(Change change) {
  return [change](const SystemDeclaration& declaration) -> std::shared_ptr<const System> {
    CallableSystem::Definition definition = test::surface_definition(declaration);
    change(definition);
    return std::make_shared<const CallableSystem>(definition);
  };
}

void expect_close(const MatrixXd& got, const MatrixXd& expected, double tolerance) {
  ASSERT_EQ(got.rows(), expected.rows());
  ASSERT_EQ(got.cols(), expected.cols());
  ASSERT_EQ(got.array().isNaN().matrix(), expected.array().isNaN().matrix());
  const auto known = [](const MatrixXd& m) -> MatrixXd { return m.array().isNaN().select(0, m); };
  EXPECT_LE((known(got) - known(expected)).cwiseAbs().maxCoeff(), tolerance * (1 + known(expected).cwiseAbs().maxCoeff()));
}

// ---- the model

TEST(CodeMechanics, LeaveTheRestOfTheFileAsItIs) {
  const Model code = code_model();
  EXPECT_TRUE(code.code);
  EXPECT_FALSE(text_model().code);
  EXPECT_EQ(code.system->name(), "particle on a surface");
  EXPECT_EQ(code.system->parameter_values(), text_model().system->parameter_values());
  EXPECT_EQ(code.latents.size(), text_model().latents.size());
  EXPECT_EQ(code.latents[0].features, text_model().latents[0].features);
  EXPECT_EQ(code.noise.stddev, text_model().noise.stddev);
  ASSERT_EQ(code.truth.size(), 3U);
  EXPECT_EQ(to_string(code.truth[0]), to_string(text_model().truth[0]));
  EXPECT_EQ(to_string(code.expression("2*speed")), "2*sqrt(dq1^2 + dq2^2 + dq3^2)");
  EXPECT_EQ(make_prior(code).reads(), make_prior(text_model()).reads());
  EXPECT_FALSE(code.potential);
}

TEST(CodeMechanics, AreReadFromAFileToo) {
  const TemporaryFolder folder;
  const auto path = folder.write("m.toml", test::surface_without_mechanics());
  EXPECT_EQ(Model::read(path, {test::callable_surface}).name, path.string());
  EXPECT_THAT(input_error_of([&] { Model::read(path); }), HasSubstr("mechanics: missing; a model needs [mechanics]"));
}

TEST(CodeMechanics, HaveNoExpressionsToShow) {
  EXPECT_EQ(text_model().symbolic_system(), text_model().system.get());
  EXPECT_EQ(&require_symbolic_system(text_model()), text_model().system.get());
  const Model code = code_model();
  EXPECT_EQ(code.symbolic_system(), nullptr);
  EXPECT_EQ(input_error_of([&] { require_symbolic_system(code); }),
            "surface.toml: the mechanics of 'particle on a surface' are code: there are no expressions of M, A, b and F; only a "
            "model file with [mechanics] has them");
  // a system of expressions that code made is code all the same
  EXPECT_EQ(code_model([](const SystemDeclaration&) { return text_model().system; }).symbolic_system(), nullptr);
}

TEST(CodeMechanics, DoNotStandBesideMechanicsInTheText) {
  const std::string text = test::surface_without_mechanics();
  const auto refused = [](const std::string& with) {
    return input_error_of([&] { Model::parse(with, "m.toml", {test::callable_surface}); });
  };
  const auto last_line = std::count(text.begin(), text.end(), '\n') + 2;
  EXPECT_EQ(refused(text + "\n[mechanics]\nmass = [[1]]\n"),
            fmt::format("m.toml:{}: mechanics: the mechanics of this model are given as code: remove [mechanics], or read the "
                        "file without that code",
                        last_line));
  EXPECT_EQ(refused(text + "\n[constraints]\nposition = []\n"),
            fmt::format("m.toml:{}: constraints: the mechanics of this model are given as code: remove [constraints], or read "
                        "the file without that code",
                        last_line));
  EXPECT_THAT(refused(text + "\n[other]\n"), HasSubstr("other"));
}

TEST(CodeMechanics, MustBeASystemAsTheFileDeclaresIt) {
  const auto refused = [](const MechanicsSource& mechanics) { return input_error_of([&] { code_model(mechanics); }); };
  EXPECT_THAT(refused({}), HasSubstr("mechanics: missing; a model needs [mechanics]"));
  EXPECT_EQ(refused([](const SystemDeclaration&) { return nullptr; }),
            "surface.toml: the code that is to give the mechanics returned no system");
  EXPECT_EQ(refused(changed_surface([](auto& d) {
              d.declaration.coordinates[1] = {"q2", true};
            })),
            "surface.toml: the system that code returned has the coordinates q1, q2 (an angle), q3, but this file declares q1, "
            "q2, q3; give it those of the declaration");
  EXPECT_THAT(refused(changed_surface([](auto& d) {
                d.declaration.inputs.clear();
                d.force_reads.reset();
              })),
              HasSubstr("has the inputs (none), but this file declares u1, u2, u3"));
  EXPECT_THAT(refused(changed_surface([](auto& d) { d.declaration.parameters.pop_back(); })),
              HasSubstr("p4 = 0.1 in [0.05, 0.2], but this file declares"));
  EXPECT_THAT(refused(changed_surface([](auto& d) { d.declaration.parameters[0].value = 3.5; })), HasSubstr("m = 3.5"));
  EXPECT_THAT(refused(changed_surface([](auto& d) { d.declaration.parameters[0].estimate = true; })),
              HasSubstr("m = 3 (estimated)"));
  // what the system itself refuses carries the file's name
  EXPECT_EQ(refused(changed_surface([](auto& d) { d.evaluate = nullptr; })),
            "surface.toml: system 'particle on a surface': evaluate is an empty function");
}

// ---- data

TEST(CodeMechanics, GenerateTheDataOfTheText) {
  const auto drawn = [](const Model& model) { return generate(model, {30, code_mechanics_seed, VectorXd::Constant(3, 0.1)}); };
  const GeneratedData code = drawn(code_model()), text = drawn(text_model());
  EXPECT_EQ(code.known, text.known);
  expect_close(code.states, text.states, 1e-14);
  expect_close(code.accelerations, text.accelerations, 1e-13);
}

TEST(CodeMechanics, WithoutResidualsLeaveNothingToSolveFor) {
  const Model code = code_model(changed_surface([](auto& d) {
    d.residuals = nullptr;
    d.mechanics_reads->push_back("q3");
  }));
  EXPECT_EQ(
      input_error_of([&] { test::draw(code, 3, code_mechanics_seed); }),
      "surface.toml: [sampling] says nothing of 'q3', which the model reads, and no constraint decides it: add q3 = [lower, "
      "upper]");
}

TEST(CodeMechanics, SolveOnlyForWhatTheResidualsDecide) {
  // a system that is silent about what it reads
  const Model code = code_model(changed_surface([](auto& d) {
    d.mechanics_reads.reset();
    d.force_reads.reset();
    d.residuals_read.reset();
  }));
  EXPECT_THAT(input_error_of([&] { test::draw(code, 3, code_mechanics_seed); }),
              HasSubstr("[sampling] says nothing of 't', which the model reads"));
  std::string text = test::surface_without_mechanics() + "t = \"0\"\n";
  const Model timed =
      Model::parse(text, "surface.toml", {changed_surface([](auto& d) { d.mechanics_reads = d.force_reads = std::nullopt; })});
  expect_close(test::draw(timed, 5, code_mechanics_seed).accelerations,
               test::draw(text_model(), 5, code_mechanics_seed).accelerations, 1e-13);

  const std::string q2 = "q2  = [-2, 2]\n";
  text.erase(text.find(q2), q2.size());
  const Model open = Model::parse(text, "surface.toml", {test::callable_surface});
  EXPECT_THAT(input_error_of([&] { test::draw(open, 3, code_mechanics_seed); }),
              HasSubstr("decide only 1 of the 2 unknowns q2, q3"));
  text += "q2 = [-2, 2]\nq3 = [5, 6]\n";
  const Model off = Model::parse(text, "surface.toml", {test::callable_surface});
  EXPECT_THAT(input_error_of([&] { test::draw(off, 3, code_mechanics_seed); }),
              HasSubstr("is off the constraint \"the surface\" by"));
}

TEST(CodeMechanics, MoveAsTheText) {
  const VectorXd start = test::draw(text_model(), 1, code_mechanics_seed).states.col(0);
  const auto motion = [&](const Model& model) {
    SimulateOptions options;
    options.times = VectorXd::LinSpaced(11, 0, 2);
    return simulate(*model.system, model.system->parameter_values(), model_acceleration(model), start, options);
  };
  const Trajectory code = motion(code_model()), text = motion(text_model());
  expect_close(code.states, text.states, 1e-11);
  EXPECT_LT(code.max_position_drift, 1e-12);
  EXPECT_EQ(input_error_of([&] { mechanical_energy(code_model(), code_model().system->parameter_values(), code.states); }),
            "surface.toml: no energy without [mechanics] potential = \"…\"");
}

// ---- learning

std::vector<Observations> observations_of(int n) {
  const GeneratedData data = generate(text_model(), {n, code_mechanics_seed, VectorXd::Constant(3, 0.1)});
  return {{data.states, View::all(View::Quantity::constrained_acceleration, *text_model().system), data.accelerations,
           VectorXd::Constant(3, 0.1), true}};
}

struct Evaluated {
  double value = 0;
  ModelGradient gradient;
};

Evaluated evaluated(const Model& model, const PriorOptions& options = {}) {
  const Prior prior = make_prior(model, options);
  const std::vector<Observations> observations = observations_of(25);
  ModelValues values = model_values(prior, observations, default_hyperparameters(prior, observations, {}, Protocol()));
  // off the truth, where the gradient is nowhere near zero
  values.parameters *= 1.02;
  Likelihood::Options likelihood_options{{0, 1, 2, 3, 4, 5, 6}, true};
  Evaluated out;
  Likelihood::Workspace workspace;
  out.value = Likelihood(prior, observations, values, likelihood_options).evaluate(values, &out.gradient, workspace);
  return out;
}

TEST(CodeMechanics, HaveTheLikelihoodAndItsGradient) {
  for (const auto base : {Latent::Base::acceleration, Latent::Base::force}) {
    PriorOptions options{Prior::Mean::force, base};
    const Evaluated text = evaluated(text_model(), options), code = evaluated(code_model(), options),
                    differenced = evaluated(code_model(test::differenced_surface), options);
    EXPECT_NEAR(code.value, text.value, 1e-12 * std::abs(text.value));
    EXPECT_EQ(differenced.value, code.value);
    ASSERT_EQ(text.gradient.parameters.size(), 7);
    for (int p = 0; p < 7; ++p) {
      SCOPED_TRACE(text_model().system->parameters()[static_cast<std::size_t>(p)].name);
      const double expected = text.gradient.parameters[p];
      EXPECT_GT(std::abs(expected), 1e-3);
      EXPECT_NEAR(code.gradient.parameters[p], expected, 1e-12 * text.gradient.parameters.cwiseAbs().maxCoeff());
      // ε^(2/3) ≈ 4e-11 of sums that cancel to a part in a hundred
      EXPECT_NEAR(differenced.gradient.parameters[p], expected, 1e-8 * text.gradient.parameters.cwiseAbs().maxCoeff());
    }
    expect_close(code.gradient.log_kernel[0], text.gradient.log_kernel[0], 1e-11);
    expect_close(code.gradient.log_noise_stddev[0], text.gradient.log_noise_stddev[0], 1e-11);
  }
}

/// A fit of p1 … p5 to data of the text model.
FitFile fitted(const Model& model, int max_iterations = 200) {
  FitFile fit;
  fit.model = model;
  fit.prior_options.mean = Prior::Mean::force;
  fit.data_source = "surface.csv";
  fit.observations = observations_of(40);
  const Prior prior = fit.prior();
  const auto hyperparameters = default_hyperparameters(prior, fit.observations, {"p1", "p2", "p3", "p4", "p5"}, Protocol());
  FitOptions options;
  options.n_restarts = 1;
  options.max_iterations = max_iterations;
  fit.report = gp2::fit(prior, fit.observations, hyperparameters, options).report;
  return fit;
}

TEST(CodeMechanics, FitAndPredictLikeTheText) {
  const FitFile text = fitted(text_model());
  const MatrixXd states = test::draw(text_model(), 10, code_mechanics_seed + 1).states;
  EXPECT_TRUE(text.report.converged);
  for (const MechanicsSource& mechanics : {MechanicsSource(test::callable_surface), MechanicsSource(test::differenced_surface)}) {
    const FitFile code = fitted(code_model(mechanics));
    EXPECT_TRUE(code.report.converged);
    // both stop at a projected gradient of 1e-5, over a box in which the flattest directions are of size one
    EXPECT_NEAR(code.report.objective, text.report.objective, 1e-5);
    for (const auto quantity : {View::Quantity::constrained_acceleration, View::Quantity::constraint_force}) {
      const View view = View::all(quantity, *text.model.system);
      expect_close(code.posterior().mean(view, states), text.posterior().mean(view, states), 1e-3);
    }
  }
  // under the same hyperparameters: to rounding
  FitFile code = fitted(code_model(), 0);
  code.report = text.report;
  const View view = View::all(View::Quantity::constrained_acceleration, *text.model.system);
  expect_close(code.posterior().mean(view, states), text.posterior().mean(view, states), 1e-10);
  EXPECT_NEAR(code.posterior().negative_log_likelihood(), text.posterior().negative_log_likelihood(), 1e-9);
}

TEST(CodeMechanics, AFitSurvivesParametersWithoutAFiniteNumber) {
  const FitFile code =
      fitted(code_model([](const SystemDeclaration& declaration) -> std::shared_ptr<const System> {
               CallableSystem::Definition definition = test::surface_definition(declaration);
               definition.evaluate = [](const CallableSystem::States& states, const CallableSystem::Parameters& p) {
                 SystemValues values = test::surface_values(states, p);
                 if (p[6] > 3.2) values.constraint_matrix *= std::numeric_limits<double>::infinity();
                 return values;
               };
               return std::make_shared<const CallableSystem>(definition);
             }),
             20);
  EXPECT_TRUE(std::isfinite(code.report.objective));
}

TEST(CodeMechanics, ServeAsABaselineAndWithADiscrepancy) {
  FitPriorOptions baseline, discrepancy;
  baseline.baseline = unstandardised(text_model(), Baseline::Kind::se);
  discrepancy.discrepancy = {VectorXd::Constant(9, 0.5), VectorXd::Constant(3, 0.01)};
  for (const FitPriorOptions& options : {baseline, discrepancy}) {
    const double expected = evaluated(text_model(), options).value;
    EXPECT_NEAR(evaluated(code_model(), options).value, expected, 1e-12 * std::abs(expected));
  }
}

// ---- fit files

FitFile small_fit() { return fitted(code_model(), 0); }

TEST(CodeMechanics, AreToldAFitFileAgain) {
  const FitFile fit = small_fit();
  const TemporaryFolder folder;
  fit.write(folder / "fit.json");
  const Json json = Json::parse(read_file(folder / "fit.json"));
  EXPECT_EQ(json["model"]["mechanics"], "code");
  const FitFile read = FitFile::read(folder / "fit.json", {test::callable_surface});
  EXPECT_TRUE(read.model.code);
  EXPECT_EQ(read.model.text, fit.model.text);
  const MatrixXd states = test::draw(text_model(), 5, code_mechanics_seed + 1).states;
  const View view = View::all(View::Quantity::constrained_acceleration, *fit.model.system);
  EXPECT_EQ(read.posterior().mean(view, states), fit.posterior().mean(view, states));
  EXPECT_EQ(read.posterior().marginal(view, states).covariance, fit.posterior().marginal(view, states).covariance);

  EXPECT_EQ(
      input_error_of([&] { FitFile::read(folder / "fit.json"); }),
      fmt::format("{}: the mechanics of its model 'surface.toml' are code, which a file cannot hold: read it where that code "
                  "is, with FitFile::read(path, code) or gp2.load(path, system=…)",
                  (folder / "fit.json").string()));
}

TEST(CodeMechanics, AreToldAFitFileOfTheFirstFormatThatHadThem) {
  const TemporaryFolder folder;
  const FitFile fit = small_fit();
  fit.write(folder / "fit.json");
  Json json = test::without_checksum(Json::parse(read_file(folder / "fit.json")));
  json["version"] = 3;
  folder.write("old.json", json.dump());
  const FitFile read = FitFile::read(folder / "old.json", {test::callable_surface});
  EXPECT_EQ(read.posterior().negative_log_likelihood(), fit.posterior().negative_log_likelihood());
}

TEST(CodeMechanics, OfAnotherKindAreNotKnown) {
  const TemporaryFolder folder;
  small_fit().write(folder / "fit.json");
  Json json = test::without_checksum(Json::parse(read_file(folder / "fit.json")));
  json["model"]["mechanics"] = "robot";
  folder.write("fit.json", json.dump());
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json", {test::callable_surface}); }),
              HasSubstr("mechanics as \"robot\" are not known"));
}

TEST(CodeMechanics, AreNotForAFitThatHasThemAsText) {
  const TemporaryFolder folder;
  fitted(text_model(), 0).write(folder / "fit.json");
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json", {test::callable_surface}); }),
              HasSubstr("code is given, but this fit is all text: read it without"));
}

TEST(CodeMechanics, AreAskedForEveryModelOfAFitThatNeedsThem) {
  // a fit of the text model that has learned from a log of another system, which is code
  FitFile fit = fitted(text_model(), 0);
  fit.prior_options = {};
  std::string text = test::surface_without_mechanics();
  text.replace(text.find("particle on a surface"), 21, "the other");
  const auto other = std::make_shared<const Model>(Model::parse(text, "other.toml", {test::callable_surface}));
  fit.observations.push_back(fit.observations.front());
  View there = fit.observations.back().view();
  there.other_system = make_other_system(fit.model, *other, fit.prior_options);
  fit.observations.back() = fit.observations.back().with_view(there);
  fit.systems = {nullptr, other};
  const auto hyperparameters = default_hyperparameters(fit.prior(), fit.observations, {}, Protocol());
  FitOptions options;
  options.max_iterations = 0;
  fit.report = gp2::fit(fit.prior(), fit.observations, hyperparameters, options).report;

  const TemporaryFolder folder;
  fit.write(folder / "fit.json");
  std::vector<std::string> asked;
  const FitFile read = FitFile::read(folder / "fit.json", {[&](const SystemDeclaration& declaration) {
                                       asked.push_back(declaration.name);
                                       return test::callable_surface(declaration);
                                     }});
  EXPECT_THAT(asked, testing::ElementsAre("the other"));
  EXPECT_EQ(read.posterior().negative_log_likelihood(), fit.posterior().negative_log_likelihood());
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json"); }), HasSubstr("of its model 'other.toml' are code"));
}

TEST(CodeMechanics, AreNotNeededForStartValues) {
  const FitFile fit = small_fit();
  const TemporaryFolder folder;
  fit.write(folder / "fit.json");
  std::vector<Hyperparameter> hyperparameters = fit.report.hyperparameters;
  for (Hyperparameter& h : hyperparameters) h.value = h.lower;
  read_start_values(folder / "fit.json", hyperparameters);
  for (std::size_t k = 0; k < hyperparameters.size(); ++k) {
    EXPECT_EQ(hyperparameters[k].value, fit.report.hyperparameters[k].value) << hyperparameters[k].name;
  }

  Json json = Json::parse(read_file(folder / "fit.json"));
  const auto refused = [&](const Json& damaged) {
    folder.write("damaged.json", damaged.dump());
    return input_error_of([&] { read_start_values(folder / "damaged.json", hyperparameters); });
  };
  json["hyperparameters"] = 3;
  EXPECT_THAT(refused(json), HasSubstr("damaged.json: the file was changed after gp2 wrote it"));
  json = test::without_checksum(json);
  EXPECT_THAT(refused(json), AllOf(StartsWith((folder / "damaged.json").string()), HasSubstr("3 stands where an array must")));
  json.erase("hyperparameters");
  EXPECT_THAT(refused(json), HasSubstr("damaged.json: not a whole fit file"));
}

}  // namespace
}  // namespace gp2
