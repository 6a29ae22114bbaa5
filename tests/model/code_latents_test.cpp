#include <gmock/gmock.h>
#include <nlohmann/json.hpp>

#include "gp2/files/fit_file.hpp"
#include "gp2/inference/likelihood.hpp"
#include "gp2/predictor.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

// Priors without a model file, of words and of code: everything is that of the same prior as text.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using test::TemporaryFolder;
using testing::HasSubstr;

constexpr std::uint64_t code_latents_seed = 60602;

// A bead on a parabola that a force along a direction of its own pushes: B = [h x, 1 + h dx²].
constexpr const char* bead_text = R"(
name = "bead"
coordinates = ["x", "z"]
[parameters]
h = { value = 0.5, bounds = [0.1, 2.0], estimate = true }
[mechanics]
mass = [["2", "0"], ["0", "2"]]
force = ["0", "-9.81*2"]
[constraints]
position = ["z - h*x^2"]
[noise]
ddq = 0.05
[truth]
acceleration = ["-0.8*dx", "0"]
[sampling]
x = [-1.0, 1.0]
dx = [-2.0, 2.0]
[[latent]]
name = "contact"
)";
constexpr const char* words = R"toml(features = ["x", "sin(dx)"]
directions = { force = [["h*x"], ["1 + h*dx^2"]] }
)toml";
constexpr const char* left_to_code = R"toml(features = { code = ["x", "sin(dx)"] }
directions = { force = { code = ["normal"] } }
)toml";

MatrixXd features(const StateCode::States& states, const StateCode::Parameters& parameters) {
  EXPECT_EQ(parameters.size(), 0);
  MatrixXd out(2, states.cols());
  out << states.row(0), states.row(2).array().sin().matrix();
  return out;
}

MatrixXd directions(const StateCode::States& states, const StateCode::Parameters& parameters) {
  const double h = parameters[0];
  MatrixXd out(2, states.cols());
  out << h * states.row(0), (1 + h * states.row(2).array().square()).matrix();
  return out;
}

MatrixXd directions_derivative(const StateCode::States& states, const StateCode::Parameters& parameters, int index) {
  EXPECT_EQ(parameters.size(), 1);
  EXPECT_EQ(index, 0);
  MatrixXd out(2, states.cols());
  out << states.row(0), states.row(2).array().square().matrix();
  return out;
}

const std::vector<std::string> read_names = {"x", "dx"};

ModelCode::OfLatent code(bool with_derivative = true) {
  return {{features, nullptr, read_names},
          {directions, with_derivative ? decltype(StateCode::differentiate)(directions_derivative) : nullptr, read_names}};
}

const Model& text_bead() {
  static const Model model = Model::parse(std::string(bead_text) + words, "bead.toml");
  return model;
}

Model code_bead(const ModelCode::OfLatent& latent = code()) {
  return Model::parse(std::string(bead_text) + left_to_code, "bead.toml", ModelCode{{}, {{"contact", latent}}});
}

LatentSpec words_of_spec() {
  LatentSpec spec;
  spec.name = "contact";
  spec.features = {"x", "sin(dx)"};
  spec.base = Latent::Base::force;
  spec.directions = {{"h*x"}, {"1 + h*dx^2"}};
  return spec;
}

LatentSpec code_of_spec() {
  LatentSpec spec = words_of_spec();
  spec.directions.clear();
  spec.feature_code = code().features;
  spec.direction_names = {"normal"};
  spec.direction_code = code().directions;
  return spec;
}

std::vector<Observations> observations() {
  const GeneratedData data = test::draw(text_bead(), 30, code_latents_seed);
  return {{data.states, View::constrained_acceleration(*text_bead().system), data.accelerations, VectorXd::Constant(2, 0.05)}};
}

struct EvaluatedPrior {
  double value = 0;
  ModelGradient gradient;
};

EvaluatedPrior evaluated_prior(const Prior& prior) {
  const std::vector<Observations> data = observations();
  ModelValues values = model_values(prior, data, default_hyperparameters(prior, data, {}, Protocol()));
  values.parameters *= 1.02;
  EvaluatedPrior out;
  Likelihood::Workspace workspace;
  out.value = Likelihood(prior, data, values, {{0}, true}).evaluate(values, &out.gradient, workspace);
  return out;
}

FitFile fitted_bead(const Model& model) {
  FitFile fit;
  fit.model = model;
  fit.data_source = "bead.csv";
  fit.observations = observations();
  FitOptions options;
  options.n_restarts = 1;
  options.max_iterations = 0;
  const Prior prior = fit.prior();
  fit.report =
      gp2::fit(prior, fit.observations, default_hyperparameters(prior, fit.observations, {"h"}, Protocol()), options).report;
  return fit;
}

TEST(CodeLatents, OfWordsAreThoseOfAModelFileToTheBit) {
  const Prior prior = make_prior(text_bead().system, {words_of_spec()});
  const EvaluatedPrior here = evaluated_prior(prior), there = evaluated_prior(make_prior(text_bead()));
  EXPECT_EQ(here.value, there.value);
  EXPECT_EQ(here.gradient.parameters, there.gradient.parameters);
  EXPECT_EQ(prior.reads(), make_prior(text_bead()).reads());
}

TEST(CodeLatents, OfWordsTakeAngles) {
  const Model pendulum = Model::parse(R"(
coordinates = [{ name = "q", angle = true }]
[mechanics]
mass = [["1"]]
)",
                                      "pendulum.toml");
  LatentSpec spec;
  spec.name = "friction";
  spec.features = {"q", "dq"};
  EXPECT_THAT(make_prior(pendulum.system, {spec}).latents[0].feature_names, testing::ElementsAre("sin(q)", "cos(q)", "dq"));
  PriorOptions raw;
  raw.raw_angles = true;
  EXPECT_THAT(make_prior(pendulum.system, {spec}, raw).latents[0].feature_names, testing::ElementsAre("q", "dq"));
}

TEST(CodeLatents, HaveTheLikelihoodAndItsGradient) {
  const EvaluatedPrior text = evaluated_prior(make_prior(text_bead()));
  EXPECT_GT(std::abs(text.gradient.parameters[0]), 1e-3);
  for (const bool with_derivative : {true, false}) {
    const EvaluatedPrior here = evaluated_prior(make_prior(code_bead(code(with_derivative))));
    EXPECT_NEAR(here.value, text.value, 1e-12 * std::abs(text.value));
    // differences are good to ε^(2/3) ≈ 4e-11 of terms that cancel in part
    EXPECT_NEAR(here.gradient.parameters[0], text.gradient.parameters[0],
                (with_derivative ? 1e-12 : 1e-8) * std::abs(text.gradient.parameters[0]));
  }
  const EvaluatedPrior without_file = evaluated_prior(make_prior(text_bead().system, {code_of_spec()}));
  EXPECT_NEAR(without_file.value, text.value, 1e-12 * std::abs(text.value));
  EXPECT_EQ(make_prior(code_bead()).reads(), make_prior(text_bead()).reads());
}

TEST(CodeLatents, ServeInALoop) {
  FitFile text = fitted_bead(text_bead()), code = fitted_bead(code_bead());
  code.report = text.report;
  for (Hyperparameter& h : code.report.hyperparameters) {
    if (h.kind == Hyperparameter::Kind::signal_stddev) h.name = "signal_std[contact:normal]";
  }
  const Predictor of_text(text.posterior()), of_code(code.posterior());
  Predictor::Workspace text_memory = of_text.make_workspace(), code_memory = of_code.make_workspace();
  const MatrixXd states = test::draw(text_bead(), 5, code_latents_seed + 1).states;
  for (Index i = 0; i < states.cols(); ++i) {
    VectorXd expected(2), mean(2), stddev(2), expected_stddev(2);
    MatrixXd jacobian(2, 5), expected_jacobian(2, 5);
    ASSERT_EQ(of_text.mean_and_stddev(states.col(i), expected, expected_stddev, text_memory), Predictor::Status::ok);
    ASSERT_EQ(of_code.mean_and_stddev(states.col(i), mean, stddev, code_memory), Predictor::Status::ok);
    EXPECT_TRUE(mean.isApprox(expected, 1e-10));
    EXPECT_TRUE(stddev.isApprox(expected_stddev, 1e-8));
    ASSERT_EQ(of_text.mean_and_jacobian(states.col(i), expected, expected_jacobian, text_memory), Predictor::Status::ok);
    ASSERT_EQ(of_code.mean_and_jacobian(states.col(i), mean, jacobian, code_memory), Predictor::Status::ok);
    EXPECT_TRUE(jacobian.isApprox(expected_jacobian, 1e-8));
  }
}

TEST(CodeLatents, HaveADiscrepancyBesideThem) {
  PriorOptions options;
  options.discrepancy = Discrepancy{VectorXd{{0.3, 0.4}}, VectorXd::Constant(2, 0.01)};
  const double text = evaluated_prior(make_prior(text_bead(), options)).value;
  EXPECT_NEAR(evaluated_prior(make_prior(code_bead(), options)).value, text, 1e-12 * std::abs(text));
  // which grows outside the data
  options.discrepancy->centre = VectorXd{{0.2, -0.1}};
  options.discrepancy->half_range = VectorXd{{0.1, 0.5}};
  const double grown = evaluated_prior(make_prior(text_bead(), options)).value;
  EXPECT_GT(std::abs(grown - text), 1e-6 * std::abs(text));
  EXPECT_NEAR(evaluated_prior(make_prior(code_bead(), options)).value, grown, 1e-12 * std::abs(grown));
}

TEST(CodeLatents, ComeBackFromAFitFileToTheBit) {
  const TemporaryFolder folder;
  const MatrixXd states = test::draw(text_bead(), 5, code_latents_seed + 2).states;
  const View view = View::constrained_acceleration(*text_bead().system);
  // the latent alone is code, or everything is
  for (const Model& model : {code_bead(), Model::from_code(text_bead().system, {code_of_spec()})}) {
    const FitFile fit = fitted_bead(model);
    fit.write(folder / "fit.json");
    EXPECT_EQ(FitFile::read(folder / "fit.json", model.code).posterior().mean(view, states), fit.posterior().mean(view, states));
    EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json"); }), HasSubstr("are code, which a file cannot hold"));
  }
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json", code_bead().code); }),
              HasSubstr("the mechanics of its model 'bead' are code"));
  fitted_bead(text_bead()).write(folder / "fit.json");
  EXPECT_THAT(input_error_of([&] { FitFile::read(folder / "fit.json", code_bead().code); }),
              HasSubstr("code is given, but this fit is all text"));
}

TEST(CodeLatents, WithoutAFileDeclareEverythingThatTheyHave) {
  LatentSpec spec = words_of_spec();
  spec.lengthscale = {1, 0.1, 10, 2, 0.5};
  spec.signal_stddev.initial = 2;
  LatentSpec plain;
  plain.name = R"(a "quoted" name)";
  plain.features = {"x"};
  const Model model = Model::from_code(text_bead().system, {spec, plain});
  ASSERT_EQ(model.latents.size(), 2U);
  EXPECT_EQ(model.latents[0].directions, spec.directions);
  EXPECT_EQ(model.latents[0].lengthscale.upper, 10);
  EXPECT_EQ(model.latents[0].lengthscale.log_stddev, 0.5);
  EXPECT_EQ(model.latents[0].signal_stddev.initial, 2);
  EXPECT_EQ(model.latents[1].name, plain.name);
  EXPECT_EQ(model.system, text_bead().system);
}

TEST(CodeLatents, WithoutAFileAreRefusedWhereItsTextWouldSayLess) {
  const auto refused = [](const std::function<void(LatentSpec&)>& change) {
    LatentSpec spec;
    spec.name = "friction";
    spec.kernel = "se";
    spec.features = {"x", "dx"};
    change(spec);
    EXPECT_NO_THROW(make_prior(text_bead().system, {spec}));
    return input_error_of([&] { Model::from_code(text_bead().system, {spec}); });
  };
  EXPECT_EQ(
      refused([](LatentSpec& s) { s.base = Latent::Base::admissible; }),
      "latent 'friction': a model has no word for the base admissible; make the prior alone, by make_prior, or take another "
      "base");
  EXPECT_EQ(refused([](LatentSpec& s) { s.lengthscale.lower = 0.5; }),
            "latent 'friction': a model holds both bounds or none, but lengthscale has the lower one alone; give both");
  EXPECT_THAT(refused([](LatentSpec& s) { s.signal_stddev.upper = 3; }), HasSubstr("signal_stddev has the upper one alone"));
  EXPECT_THAT(refused([](LatentSpec& s) {
                s.lengthscales = {{"dx", {.lower = 0.5}}};
              }),
              HasSubstr("the lengthscale of 'dx' has the lower one alone"));
  const std::string both =
      " beside lengthscales of single features; leave one of them out, or make the prior alone, by make_prior";
  EXPECT_EQ(refused([](LatentSpec& s) {
              s.per_direction = true;
              s.lengthscales = {{"dx", {.initial = 0.5}}};
            }),
            "latent 'friction': a model cannot hold per_direction = true" + both);
  EXPECT_EQ(refused([](LatentSpec& s) {
              s.kernel = "";
              s.per_direction = false;
              s.lengthscales = {{"dx", {.initial = 0.5}}};
            }),
            "latent 'friction': a model cannot hold per_direction = false" + both);
}

TEST(CodeLatents, HaveRangesThatMeanSomething) {
  const auto refused = [](const Latent::Range& range) {
    LatentSpec spec = words_of_spec();
    spec.signal_stddev = range;
    const std::string text = input_error_of([&] { make_prior(text_bead().system, {spec}); });
    spec = words_of_spec();
    spec.lengthscales = {{"x", range}};
    EXPECT_THAT(input_error_of([&] { make_prior(text_bead().system, {spec}); }),
                testing::StartsWith("latent 'contact': the lengthscale of 'x': "));
    return text;
  };
  const std::string numbers = "latent 'contact': signal_stddev: its numbers must be positive, or 0 for the default, got ";
  EXPECT_EQ(refused({.initial = -2}), numbers + "-2");
  EXPECT_EQ(refused({.upper = std::numeric_limits<double>::infinity()}), numbers + "inf");
  EXPECT_EQ(refused({.initial = std::numeric_limits<double>::quiet_NaN()}), numbers + "nan");
  EXPECT_EQ(refused({.lower = 3, .upper = 2}), "latent 'contact': signal_stddev: the lower bound 3 is above the upper one 2");
  EXPECT_EQ(refused({.initial = 1, .lower = 2, .upper = 3}),
            "latent 'contact': signal_stddev: it starts at 1, outside its bounds");
  for (const Latent::Range& half : {Latent::Range{.median = 2}, Latent::Range{.log_stddev = 2}}) {
    EXPECT_EQ(refused(half), "latent 'contact': signal_stddev: median and log_stddev belong together; give both or none");
  }
}

TEST(CodeLatents, AreRefusedWhereTheyDoNotFit) {
  const auto spec_refused = [](const std::function<void(LatentSpec&)>& change) {
    LatentSpec spec = code_of_spec();
    change(spec);
    return input_error_of([&] { evaluated_prior(make_prior(text_bead().system, {spec})); });
  };
  EXPECT_EQ(spec_refused([](LatentSpec& s) { s.features.clear(); }),
            "latent 'contact': it needs at least one feature; code needs a name for each of its numbers");
  EXPECT_EQ(spec_refused([](LatentSpec& s) { s.features.emplace_back("third"); }),
            "latent 'contact': features: evaluate returned the shape 2 × 30, expected 3 × 30 for 30 states");
  EXPECT_EQ(spec_refused([](LatentSpec& s) {
              s.directions = {{"1"}, {"0"}};
            }),
            "latent 'contact': its directions are given twice, as expressions and as code; leave out one");
  EXPECT_EQ(spec_refused([](LatentSpec& s) { s.direction_names.clear(); }),
            "latent 'contact': directions that are code need a name for each column");
  // as many numbers as one of the two directions has
  EXPECT_EQ(spec_refused([](LatentSpec& s) { s.direction_names.emplace_back("second"); }),
            "latent 'contact': directions: evaluate returned the shape 2 × 30, expected 4 × 30 for 30 states");
  EXPECT_THAT(spec_refused([](LatentSpec& s) { s.direction_code.reads = {{"q9"}}; }),
              HasSubstr("latent 'contact': directions: 'q9' is no entry of the state, which has x, z, dx, dz, t"));
  EXPECT_EQ(spec_refused([](LatentSpec& s) {
              s.feature_code.evaluate = [](const auto& states, const auto&) -> MatrixXd {
                return MatrixXd::Constant(2, states.cols(), std::numeric_limits<double>::quiet_NaN());
              };
            }),
            "latent 'contact': features: evaluate returned a number that is not finite at state 1, where all that is read is "
            "finite");
  EXPECT_THAT(spec_refused([](LatentSpec& s) {
                s.feature_code = {};
                s.features = {"x", "speed"};
              }),
              HasSubstr("latent 'contact': column 1: unknown symbol 'speed'"));
  EXPECT_THAT(spec_refused([](LatentSpec& s) {
                s.direction_code = {};
                s.directions = {{"1"}};
              }),
              HasSubstr("directions: expected 2 rows, one per coordinate, got 1"));
  EXPECT_THAT(spec_refused([](LatentSpec& s) { s.kernel = "sine"; }), HasSubstr("latent 'contact': "));
}

TEST(CodeLatents, AreGivenForWhatTheFileLeavesToThem) {
  const auto refused = [](const std::string& text, const ModelCode& given) {
    return input_error_of([&] { Model::parse(bead_text + text, "bead.toml", given); });
  };
  const auto given = [](const std::string& name, const ModelCode::OfLatent& latent) { return ModelCode{{}, {{name, latent}}}; };
  EXPECT_THAT(refused(left_to_code, {}), testing::MatchesRegex(".*latent.features: those of 'contact' are code, and none is "
                                                               "given: read the file where that code is"));
  EXPECT_THAT(refused(left_to_code, given("contact", {code().features, {}})),
              HasSubstr("latent.directions: those of 'contact' are code, and none is given"));
  EXPECT_THAT(refused(words, given("contact", code())),
              HasSubstr("code is given for the features of the latent 'contact', but the file has them"));
  EXPECT_THAT(refused(left_to_code + std::string("name2 = 1\n"), given("contact", code())), HasSubstr("name2"));
  EXPECT_THAT(refused(words, given("other", code())), HasSubstr("code is given for the latent 'other', but there is none"));
  EXPECT_THAT(refused("features = { code = [] }\n", given("contact", {code().features, {}})),
              HasSubstr("a latent needs at least one feature"));
  FitPriorOptions baseline;
  baseline.baseline = Baseline{Baseline::Kind::se, VectorXd::Zero(2), VectorXd::Zero(2), VectorXd::Ones(2)};
  EXPECT_THAT(input_error_of([&] { make_prior(code_bead(), baseline); }), HasSubstr("a baseline needs features as expressions"));
}

}  // namespace
}  // namespace gp2
