#include "gp2/model.hpp"

#include <chrono>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/data/csv.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using test::input_error_of;
using testing::AllOf;
using testing::ElementsAre;
using testing::EndsWith;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Pair;
using testing::SizeIs;
using testing::StartsWith;

// six lines; what a test adds begins on line 7
const std::string base = R"(coordinates = ["q1", { name = "q2", angle = true }]
inputs = ["u1"]
[parameters]
m = { value = 2.0, bounds = [1, 3] }
[mechanics]
mass = [["m", "0"], ["0", "1"]]
)";

Model parse(const std::string& text) { return Model::parse(text, "m.toml"); }
std::string error_of(const std::string& text) {
  return input_error_of([&] { parse(text); });
}

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

std::string with_coordinates(const std::string& coordinates) {
  return replaced(base, R"(["q1", { name = "q2", angle = true }])", coordinates);
}
std::string with_mass(const std::string& mass) { return replaced(base, R"([["m", "0"], ["0", "1"]])", mass); }
std::string with_parameter(const std::string& m) { return replaced(base, "m = { value = 2.0, bounds = [1, 3] }", m); }

/// `outer` n times around `inner`.
std::string nested(const std::string& left, const std::string& inner, const std::string& right, int n) {
  std::string text;
  for (int k = 0; k < n; ++k) text += left;
  text += inner;
  for (int k = 0; k < n; ++k) text += right;
  return text;
}

// ---- what comes with gp2

class ShippedModel : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Each, ShippedModel, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(ShippedModel, IsReadWhole) {
  const std::filesystem::path path = std::filesystem::path(GP2_SOURCE_DIR) / GetParam();
  const Model model = Model::read(path);
  EXPECT_EQ(model.name, path.string());
  EXPECT_EQ(model.text, read_file(path));
  EXPECT_FALSE(model.system->name().empty());
  EXPECT_GT(model.system->nc(), 0);
  EXPECT_FALSE(model.latents.empty());
  EXPECT_THAT(model.noise.stddev, SizeIs(static_cast<std::size_t>(model.system->nq())));
  EXPECT_THAT(model.truth, SizeIs(static_cast<std::size_t>(model.system->nq())));
  EXPECT_TRUE(!model.sampling.empty() || model.motion);
  for (const bool raw_angles : {false, true}) {
    EXPECT_GE(make_prior(model, {Prior::Mean::force, std::nullopt, raw_angles}).latents.size(), model.latents.size());
  }
}

TEST(Model, AtLeastNineModelsComeWithTheLibrary) { EXPECT_GE(test::every_model().size(), 9U); }

// ---- what a model means

TEST(Model, TheSmallestModelHasNoInputsConstraintsOrForce) {
  const Model model = parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[2]]\n");
  const System& system = *model.system;
  EXPECT_EQ(system.name(), "m.toml");
  EXPECT_THAT(system.state_names(), ElementsAre("x", "dx", "t"));
  EXPECT_EQ(system.nc(), 0);
  const SystemValues values = system.evaluate(Eigen::Vector3d(1, 2, 3), Eigen::VectorXd());
  EXPECT_EQ(values.M(0)(0, 0), 2);
  EXPECT_EQ(values.F(0)[0], 0);
  EXPECT_THAT(model.noise.stddev, IsEmpty());
  EXPECT_THAT(model.truth, IsEmpty());
  EXPECT_THAT(model.sampling, IsEmpty());
}

TEST(Model, WithoutALatentTheAccelerationHasOneOverTheWholeStateButTime) {
  for (const char* added : {"", "latent = []\n"}) {
    const Model model = parse(added + base);
    ASSERT_THAT(model.latents, SizeIs(1));
    EXPECT_EQ(model.latents[0].name, "unconstrained acceleration");
    EXPECT_EQ(model.latents[0].kernel, "");
    EXPECT_EQ(model.latents[0].base, Latent::Base::acceleration);
    EXPECT_THAT(model.latents[0].features, ElementsAre("q1", "q2", "dq1", "dq2", "u1"));
    EXPECT_THAT(make_prior(model).latents[0].feature_names, ElementsAre("q1", "sin(q2)", "cos(q2)", "dq1", "dq2", "u1"));
  }
}

TEST(Model, AnAngleAsAFeatureIsItsSineAndCosineUnlessRawOrInAnExpression) {
  const Model model = parse(base + "[[latent]]\nfeatures = [\"q2\", \"2*q2\", \"dq2\"]\n");
  EXPECT_THAT(make_prior(model).latents[0].feature_names, ElementsAre("sin(q2)", "cos(q2)", "2*q2", "dq2"));
  EXPECT_THAT(make_prior(model, {Prior::Mean::zero, std::nullopt, true}).latents[0].feature_names,
              ElementsAre("q2", "2*q2", "dq2"));
  //                              q1  q2    dq1  dq2 t  u1
  const Eigen::MatrixXd state = (Eigen::VectorXd(6) << 9, 0.5, 9, 7, 9, 9).finished();
  EXPECT_EQ(evaluate_features(make_prior(model), 0, state), Eigen::RowVector4d(std::sin(0.5), std::cos(0.5), 1, 7));
}

TEST(Model, DirectionsHaveFiveForms) {
  struct Form {
    std::string text;
    Latent::Base base;
    int n_columns;  // 0: the identity
  };
  for (const Form& form : {Form{R"("acceleration")", Latent::Base::acceleration, 0}, Form{R"("force")", Latent::Base::force, 0},
                           Form{R"([["-dq1"], [0]])", Latent::Base::acceleration, 1},
                           Form{R"({ acceleration = [["1", "0"], ["0", "q1"]] })", Latent::Base::acceleration, 2},
                           Form{R"({ force = [["-dq1"], ["m"]] })", Latent::Base::force, 1}}) {
    const Model model = parse(base + "[[latent]]\nkernel = \"se\"\nfeatures = [\"q1\"]\ndirections = " + form.text + "\n");
    const Latent latent = make_prior(model).latents[0];
    EXPECT_EQ(latent.base, form.base) << form.text;
    EXPECT_EQ(latent.directions == nullptr, form.n_columns == 0) << form.text;
    EXPECT_EQ(latent.size(), form.n_columns == 0 ? 2 : form.n_columns) << form.text;
  }
}

TEST(Model, DirectionsMayBeReplacedWhereThereIsOneLatent) {
  const std::string latent = "[[latent]]\nkernel = \"se\"\nfeatures = [\"q1\"]\ndirections = [[\"1\"], [\"0\"]]\n";
  const Latent replaced_latent = make_prior(parse(base + latent), {Prior::Mean::zero, Latent::Base::force}).latents[0];
  EXPECT_EQ(replaced_latent.base, Latent::Base::force);
  EXPECT_EQ(replaced_latent.directions, nullptr);
  EXPECT_THAT(replaced_latent.column_names, ElementsAre("force_q1", "force_q2"));
  EXPECT_EQ(input_error_of([&] {
              make_prior(parse(base + latent + latent), {Prior::Mean::zero, Latent::Base::force});
            }),
            "m.toml: `prior` replaces the directions of the one [[latent]], but this model has 2: edit the model file instead");
}

TEST(Model, LatentsKeepWhatIsWritten) {
  const Model model = parse(base + R"([[latent]]
name = "friction"
kernel = "se + linear"
features = ["q1"]
lengthscale = { initial = 2, bounds = [0.1, 10] }
[[latent]]
features = ["dq1"]
signal_stddev = { initial = 0.5 }
)");
  ASSERT_THAT(model.latents, SizeIs(2));
  EXPECT_EQ(model.latents[0].name, "friction");
  EXPECT_EQ(model.latents[0].kernel, "se + linear");
  EXPECT_EQ(model.latents[0].lengthscale.initial, 2);
  EXPECT_EQ(model.latents[0].lengthscale.lower, 0.1);
  EXPECT_EQ(model.latents[0].lengthscale.upper, 10);
  EXPECT_EQ(model.latents[1].name, "latent 2");
  EXPECT_EQ(model.latents[1].signal_stddev.initial, 0.5);
}

TEST(Model, EqualBoundsOrEstimateFalseHoldAHyperparameter) {
  const Model model = parse(base + R"([[latent]]
features = ["q1"]
lengthscale = { bounds = [2, 2] }
signal_stddev = { value = 0.5, estimate = false }
[[latent]]
features = ["q1"]
lengthscale = { value = 3, bounds = [1, 4], estimate = false }
signal_stddev = { value = 0.5, bounds = [0.1, 1], estimate = true }
)");
  const auto bounds = [](const Latent::Range& range) { return std::pair(range.lower, range.upper); };
  EXPECT_EQ(bounds(model.latents[0].lengthscale), std::pair(2.0, 2.0));
  EXPECT_EQ(bounds(model.latents[0].signal_stddev), std::pair(0.5, 0.5));
  EXPECT_EQ(bounds(model.latents[1].lengthscale), std::pair(3.0, 3.0));
  EXPECT_EQ(bounds(model.latents[1].signal_stddev), std::pair(0.1, 1.0));
}

TEST(Model, LengthscalesOfFeaturesAreInTheirUnits) {
  const Model model = parse(base + R"([[latent]]
features = ["q1", "q2", "dq1 - dq2"]
lengthscales = { q1 = 0.5, q2 = { value = 2, bounds = [1, 4] }, "dq1 - dq2" = { prior = { median = 3, log_stddev = 0.2 } } }
)");
  const Latent latent = make_prior(model).latents[0];
  ASSERT_THAT(latent.feature_names, ElementsAre("q1", "sin(q2)", "cos(q2)", "dq1 - dq2"));
  ASSERT_THAT(latent.feature_lengthscales, SizeIs(4));
  EXPECT_EQ(latent.feature_lengthscales[0].lower, 0.5) << "a number by itself is held";
  EXPECT_EQ(latent.feature_lengthscales[0].upper, 0.5);
  for (const std::size_t d : {1u, 2u}) {
    EXPECT_EQ(latent.feature_lengthscales[d].initial, 2);
    EXPECT_EQ(latent.feature_lengthscales[d].upper, 4);
  }
  EXPECT_EQ(latent.feature_lengthscales[3].median, 3);
}

TEST(Model, AParameterMayFollowFromOthers) {
  const std::string text = replaced(with_parameter("I3 = \"I2 + n\"\nm = 2.0\nI2 = \"2*m\"\nn = 0.5"), "\"1\"]]", "\"I3\"]]");
  const Model model = parse(text);
  ASSERT_THAT(model.system->parameters(), SizeIs(2));
  ASSERT_THAT(model.derived_parameters, SizeIs(2));
  EXPECT_EQ(model.derived_parameters[0].name, "I2");
  EXPECT_EQ(model.derived_parameters[0].text, "2*m");
  EXPECT_EQ(model.derived_parameters[0].value, 4);
  EXPECT_EQ(model.derived_parameters[1].value, 4.5);
  // it follows m, and so does the derivative
  const Eigen::VectorXd state = Eigen::VectorXd::Zero(6), moved = Eigen::Vector2d(3, 0.5);
  EXPECT_EQ(model.system->evaluate(state, moved).M(0)(1, 1), 6.5);
  EXPECT_EQ(model.system->differentiate(state, moved, 0).M(0)(1, 1), 2);
  EXPECT_EQ(to_string(model.expression("I3*q1")), "(2*m + n)*q1");
}

TEST(Model, ParametersKeepTheOrderOfTheFile) {
  const Model model = parse(with_parameter("z = 1\nm = { value = 2, bounds = [2, 3], estimate = true }\na = -1"));
  const std::vector<Parameter>& parameters = model.system->parameters();
  ASSERT_THAT(parameters, SizeIs(3));
  EXPECT_EQ(parameters[0].name, "z");
  EXPECT_EQ(parameters[1].name, "m");
  EXPECT_EQ(parameters[1].bounds, std::pair(2.0, 3.0));
  EXPECT_TRUE(parameters[1].estimate);
  EXPECT_EQ(parameters[2].value, -1);
  EXPECT_FALSE(parameters[2].bounds.has_value());
}

TEST(Model, LetNamesMayStandInAnyOrderAndHoldNumbers) {
  const Model model =
      parse(base + "force = [\"a\", \"d\"]\n[let]\na = \"b*c + bb\"\nb = \"c + 1\"\nc = \"2*q1\"\nbb = 5\nd = \"pi\"\n");
  Eigen::VectorXd state = Eigen::VectorXd::Zero(6);
  state[0] = 3;
  const SystemValues values = model.system->evaluate(state, model.system->parameter_values());
  EXPECT_EQ(values.F(0)[0], (6 + 1) * 6 + 5);
  EXPECT_EQ(values.F(0)[1], std::acos(-1.0));
}

TEST(Model, ConstraintsOfAllLevelsStandSideBySide) {
  const Model model =
      parse(base + "[constraints]\nposition = [\"q1 - sin(q2)\"]\nvelocity = [\"dq1 - t\"]\nacceleration = [\"q1*ddq2 - u1\"]\n");
  EXPECT_THAT(model.system->constraint_labels(), ElementsAre("q1 - sin(q2)", "dq1 - t", "q1*ddq2 - u1"));
  Eigen::VectorXd state(6);
  state << 3, 0.5, 2, 7, 1, 11;  // q1 q2 dq1 dq2 t u1
  const SystemValues values = model.system->evaluate(state, model.system->parameter_values());
  EXPECT_TRUE(values.A(0).isApprox((Eigen::Matrix<double, 3, 2>() << 1, -std::cos(0.5), 1, 0, 0, 3).finished(), 1e-15));
  EXPECT_TRUE(values.b(0).isApprox(Eigen::Vector3d(-std::sin(0.5) * 49, 1, 11), 1e-15));
}

TEST(Model, AMassMatrixMayBeWrittenDifferentlyOnItsTwoSides) {
  EXPECT_EQ(error_of(with_mass(R"([["3", "(q1 + 1)^2"], ["q1^2 + 2*q1 + 1", "3"]])")), "");
  EXPECT_EQ(error_of(with_mass(R"([["m", "0"], ["m*sin(q1)^2 + m*cos(q1)^2 - m", 1]])")), "");  // 0 to rounding
}

// of two links, by the textbook: h = m2 l1 l2 sin(q2 − q1)
TEST(Model, CoriolisForcesFollowFromTheMassMatrix) {
  const auto model = [](const std::string& force) {
    return Model::parse(
        "coordinates = ['a', 'b']\n[parameters]\nk = 0.7\n[mechanics]\nmass = [['3 + 0.1*t', 'k*cos(b - a)'], ['k*cos(b - "
        "a)', '1']]\n" +
            force,
        "arm");
  };
  const Model derived = model("force = ['-a', '0']\ncoriolis = true\n");
  const Model written = model("force = ['-a + k*sin(b - a)*db^2 - 0.1*da', '-k*sin(b - a)*da^2']\ncoriolis = false\n");
  const Eigen::MatrixXd states = Eigen::MatrixXd::Random(5, 20);
  const auto force = [&](const Model& of) { return of.system->evaluate(states, of.system->parameter_values()).force; };
  EXPECT_LE(test::largest(force(derived) - force(written)), 1e-14);
}

TEST(Model, NoiseIsOneValueOrOnePerCoordinateAndMayBeEstimated) {
  EXPECT_THAT(parse(base + "[noise]\nddq = 0.1\n").noise.stddev, ElementsAre(0.1, 0.1));
  EXPECT_THAT(parse(base + "[noise]\nddq = [0.1, 2]\n").noise.stddev, ElementsAre(0.1, 2));
  const Model::Noise estimated = parse(base + "[noise]\nddq = { estimate = true, initial = [0.1, 2] }\n").noise;
  EXPECT_THAT(estimated.stddev, ElementsAre(0.1, 2));
  EXPECT_TRUE(estimated.estimate);
  EXPECT_THAT(parse(base + "[noise]\n").noise.stddev, IsEmpty());
}

TEST(Model, NoiseMayHaveBoundsAndAFloor) {
  const Model::Noise noise =
      parse(base + "[noise]\nddq = { value = 0.1, estimate = true, bounds = [0.05, 1], floor = [0.01, 0.02] }\n").noise;
  EXPECT_THAT(noise.stddev, ElementsAre(0.1, 0.1));
  EXPECT_THAT(noise.bounds, ElementsAre(Pair(0.05, 1), Pair(0.05, 1)));
  EXPECT_THAT(noise.floor, ElementsAre(0.01, 0.02));
  EXPECT_THAT(parse(base + "[noise]\nddq = { value = 0.1, bounds = [[0.05, 1], [0.1, 3]] }\n").noise.bounds,
              ElementsAre(Pair(0.05, 1), Pair(0.1, 3)));
  const Model::Noise only_floor = parse(base + "[noise]\nddq = { floor = 0.01 }\n").noise;
  EXPECT_THAT(only_floor.stddev, IsEmpty());
  EXPECT_THAT(only_floor.floor, ElementsAre(0.01, 0.01));
}

TEST(Model, SamplingComesInAnOrderInWhichItCanBeDrawn) {
  const Model model = parse(
      base + "[sampling]\nq1 = \"r*cos(a)\"\na = \"2*b\"\nr = [0, 1]\nb = [0, 3]\ndq2 = 4\nstart = { q2 = 0.1, dq1 = 1 }\n");
  std::vector<std::string> names;
  for (const Model::SamplingRule& rule : model.sampling) names.push_back(rule.name);
  EXPECT_THAT(names, ElementsAre("b", "a", "r", "q1", "dq2"));
  EXPECT_EQ(model.sampling[0].range, std::pair(0.0, 3.0));
  EXPECT_FALSE(model.sampling[1].range.has_value());
  EXPECT_EQ(model.sampling[3].line, 8);
  EXPECT_THAT(model.newton_start, ElementsAre(Pair("dq1", 1), Pair("q2", 0.1)));
  // auxiliary draws are no symbols of the model
  EXPECT_THAT(input_error_of([&] { static_cast<void>(model.expression("r")); }), HasSubstr("unknown symbol 'r'"));
}

TEST(Model, ColumnsNameTheLogsColumns) {
  EXPECT_THAT(parse(base + "[columns]\nq2 = \"theta 2\"\nddq1 = \"acc\"\nt = \"s\"\n").columns,
              ElementsAre(Pair("ddq1", "acc"), Pair("q2", "theta 2"), Pair("t", "s")));
}

TEST(Model, ExpressionsOfAModelMayUseItsLetNames) {
  const Model model = parse(base + "[let]\nv = \"dq1 + m\"\n");
  EXPECT_EQ(to_string(model.expression("2*v")), "2*(dq1 + m)");
}

TEST(Model, TheSameTextGivesTheSameSystem) {
  const auto written_out = [](const Model& model) {
    std::string all;
    for (const ConstraintRow& row : model.symbolic_system()->definition().constraints) {
      for (Expression entry : row.A) all += to_string(entry) + "\n";
      all += to_string(row.b) + "\n";
    }
    return all;
  };
  for (const std::string& file : test::every_model()) {
    const auto path = std::filesystem::path(GP2_SOURCE_DIR) / file;
    EXPECT_EQ(written_out(Model::read(path)), written_out(Model::read(path)));
  }
}

// ---- what is refused, where, and with which mend

struct Complaint {
  std::string what;     // the test's name
  std::string text;     // the file
  std::string message;  // without "m.toml:"
};

void PrintTo(const Complaint& complaint, std::ostream* out) { *out << complaint.what; }

class RefusedModel : public testing::TestWithParam<Complaint> {};

TEST_P(RefusedModel, NamesTheLineTheKeyAndTheMend) { EXPECT_EQ(error_of(GetParam().text), "m.toml:" + GetParam().message); }

std::vector<Complaint> complaints() {
  const std::string latent = base + "[[latent]]\n";
  const std::string features = "features = [\"q1\"]\n";
  return {
      // shape of the file
      {"Empty", "", "1: coordinates: missing; write coordinates = [\"q1\", \"q2\"]"},
      {"UnknownTable", base + "[friction]\nc = 1\n",
       "7: friction: unknown key; known here: name, robot, coordinates, inputs, parameters, let, mechanics, constraints, latent, "
       "noise, truth, sampling, motion, columns, units, drawing"},
      {"FirstOfSeveralUnknownKeys", base + "zeta = 1\nalpha = 2\n",
       "7: mechanics.zeta: unknown key; known here: mass, force, coriolis, potential"},
      {"NameIsNoText", "name = 3\n" + base, "1: name: expected a text in quotes, got 3"},
      {"ParametersAreNoTable", "parameters = 3\ncoordinates = [\"q1\"]\n", "1: parameters: expected a table, got 3"},
      // coordinates
      {"CoordinatesAreNoArray", with_coordinates("\"q1\""), "1: coordinates: expected an array [ … ], got 'q1'"},
      {"NoCoordinates", with_coordinates("[]"), "1: coordinates: a system needs at least one coordinate"},
      {"CoordinateIsANumber", with_coordinates("[1]"), "1: coordinates: expected a text in quotes, got 1"},
      {"CoordinateWithoutAName", with_coordinates("[{ angle = true }]"),
       "1: coordinates: expected { name = \"q1\", angle = true }"},
      {"CoordinateWithAnUnknownKey", with_coordinates("[{ name = \"q1\", unit = \"m\" }]"),
       "1: coordinates.unit: unknown key; known here: name, angle"},
      {"AngleIsNoBoolean", with_coordinates("[{ name = \"q1\", angle = 1 }]"),
       "1: coordinates.angle: expected true or false, got 1"},
      {"CoordinateTwice", with_coordinates("[\"q1\", \"q1\"]"), "1: coordinates: the name 'q1' is taken already; choose another"},
      {"CoordinateNamedLikeAVelocity", with_coordinates("[\"q1\", \"dq1\"]"),
       "1: coordinates: the name 'dq1' is taken already; choose another"},
      {"CoordinateNamedLikeTheEnergy", with_coordinates("[\"energy\", \"q2\"]"),
       "1: coordinates: the column energy would be a name of this model and what logs and predictions call a quantity of the "
       "motion; choose another name"},
      {"CoordinateNamedT", with_coordinates("[\"t\"]"), "1: coordinates: the name 't' is taken already; choose another"},
      {"CoordinateNamedLikeAFunction", with_coordinates("[\"sin\"]"),
       "1: coordinates: 'sin' is the name of a function or constant; choose another"},
      {"CoordinateNamedWithASpace", with_coordinates("[\"q 1\"]"),
       "1: coordinates: 'q 1' is not a name: use letters, digits and _, beginning with a letter"},
      {"CoordinateWithoutLetters", with_coordinates("[\"\"]"),
       "1: coordinates: '' is not a name: use letters, digits and _, beginning with a letter"},
      {"InputNamedLikeACoordinate", replaced(base, "\"u1\"", "\"q1\""),
       "2: inputs: the name 'q1' is taken already; choose another"},
      {"InputWithoutAName", replaced(base, "\"u1\"", "{ delay = 0.1 }"),
       "2: inputs: expected { name = \"u\", delay = 0.02, lag = 0.05 }"},
      {"InputWithAnUnknownKey", replaced(base, "\"u1\"", "{ name = \"u1\", gain = 2 }"),
       "2: inputs.gain: unknown key; known here: name, delay, lag"},
      {"DelayIsNegative", replaced(base, "\"u1\"", "{ name = \"u1\", delay = -0.1 }"),
       "2: inputs.delay: a delay [s] must not be negative, got -0.1: nothing acts before it is commanded"},
      {"LagMayBeNegative", replaced(base, "\"u1\"", "{ name = \"u1\", lag = { value = 0, bounds = [-1, 1] } }"),
       "2: inputs.lag: a lag [s] must not be negative, got -1: nothing acts before it is commanded"},
      {"LagOutsideItsBounds", replaced(base, "\"u1\"", "{ name = \"u1\", lag = { value = 3, bounds = [0, 1] } }"),
       "2: inputs.lag: the value 3 is outside its bounds [0, 1]"},
      {"DelayIsNotFinite", replaced(base, "\"u1\"", "{ name = \"u1\", delay = inf }"),
       "2: inputs.delay: expected a finite number, got inf"},
      // parameters
      {"ParameterWithoutAValue", with_parameter("m = { bounds = [1, 2] }"),
       "4: parameters.m: missing value; write { value = 1.0, bounds = [0.5, 2.0], estimate = true }"},
      {"DerivedParameterOfAnUnknownName", with_parameter("m = \"2*n\""),
       "4: parameters.m: \"2*n\", column 3: unknown symbol 'n'; known here: none"},
      {"DerivedParameterOfAState", with_parameter("m = \"2*q1\""),
       "4: parameters.m: a parameter may follow from other parameters only, but this entry depends on 'q1'"},
      {"DerivedParameterOfTime", with_parameter("m = \"2*t\""),
       "4: parameters.m: a parameter may follow from other parameters only, but this entry depends on 't'"},
      {"DerivedParametersInACircle", with_parameter("m = \"n + 1\"\nn = \"2*m\""),
       "4: parameters.m: defined in terms of itself: m uses n uses m"},
      {"DerivedParameterWithoutAValue", with_parameter("m = \"1/n\"\nn = 0"),
       "4: parameters.m: its value is no finite number where the other parameters have theirs"},
      {"DerivedParameterToEstimate", with_parameter("m = { value = \"2*n\", estimate = true }\nn = 1"),
       "4: parameters.m: a parameter that follows from others has no bounds, no prior and no estimate of its own: write m = "
       "\"2*n\", and say of those others what is to be estimated"},
      {"ParameterIsInfinite", with_parameter("m = inf"), "4: parameters.m: expected a finite number, got inf"},
      {"ParameterHasNoSquare", with_parameter("m = -1e300"),
       "4: parameters.m: -1e+300 is too large: at most 1e+100 can be computed with"},
      {"PriorOfAParameterHalfGiven", with_parameter("m = { value = 2, prior = { mean = 2 } }"),
       "4: parameters.m.prior: missing stddev; write { mean = 2.0, stddev = 0.1 }, or, of a positive one, { median = 2.0, "
       "log_stddev = 0.1 }, the second of its logarithm"},
      {"PriorOfAParameterWithoutWidth", with_parameter("m = { value = 2, prior = { mean = 2, stddev = 0 } }"),
       "4: parameters.m.prior: stddev must be positive, got 0"},
      {"PriorOfAParameterOfTwoKinds", with_parameter("m = { value = 2, prior = { mean = 2, log_stddev = 0.1 } }"),
       "4: parameters.m.prior.log_stddev: unknown key; known here: mean, stddev"},
      {"LogarithmicPriorOfANegativeMedian", with_parameter("m = { value = 2, prior = { median = -1, log_stddev = 0.1 } }"),
       "4: parameters.m.prior: median must be positive, got -1"},
      {"ParameterOutsideItsBounds", with_parameter("m = { value = 4, bounds = [1, 3] }"),
       "4: parameters.m: the value 4 is outside its bounds [1, 3]"},
      {"BoundsInTheWrongOrder", with_parameter("m = { value = 2, bounds = [3, 1] }"),
       "4: parameters.m.bounds: the lower end 3 must be below the upper end 1"},
      {"ThreeBounds", with_parameter("m = { value = 2, bounds = [1, 2, 3] }"),
       "4: parameters.m.bounds: expected [lower, upper], got [1, 2, 3]"},
      {"ParameterWithAnUnknownKey", with_parameter("m = { value = 2, bound = [1, 3] }"),
       "4: parameters.m.bound: unknown key; known here: value, bounds, estimate, of, prior"},
      {"ParameterNamedLikeACoordinate", with_parameter("m = 1\nq1 = 2"),
       "5: parameters.q1: the name 'q1' is taken already; choose another"},
      {"EstimateIsNoBoolean", with_parameter("m = { value = 2, estimate = \"yes\" }"),
       "4: parameters.m.estimate: expected true or false, got 'yes'"},
      // let
      {"LetInACircle", base + "[let]\na = \"b + 1\"\nb = \"2*c\"\nc = \"a\"\n",
       "8: let.a: defined in terms of itself: a uses b uses c uses a"},
      {"LetOfItself", base + "[let]\na = \"a + 1\"\n", "8: let.a: defined in terms of itself: a uses a"},
      {"LetNamedLikeAParameter", base + "[let]\nm = \"2\"\n", "8: let.m: the name 'm' is taken already; choose another"},
      {"LetIsATable", base + "[let.a]\nb = 1\n", "7: let.a: expected an expression in quotes, or a number, got a table"},
      {"LetOfAnUnknownSymbol", base + "[let]\na = \"2*dq3\"\n",
       "8: let.a: \"2*dq3\", column 3: unknown symbol 'dq3', did you mean 'dq2'?"},
      // mechanics
      {"NoMechanics", "coordinates = [\"q1\"]\n", "1: mechanics: missing; a model needs [mechanics] with mass = [[…], …]"},
      {"NoMass", "coordinates = [\"q1\"]\n[mechanics]\nforce = [\"0\"]\n", "2: mechanics: missing mass = [[…], …]"},
      {"MassOfTooFewRows", with_mass("[[\"m\", \"0\"]]"), "6: mechanics.mass: expected 2 rows, one per coordinate, got 1"},
      {"MassOfTooFewColumns", with_mass("[[\"m\", \"0\"],\n[\"0\"]]"), "7: mechanics.mass row 2: expected 2 entries, got 1"},
      {"MassRowIsNoArray", with_mass("[\"m\", \"1\"]"), "6: mechanics.mass row 1: expected an array [ … ], got 'm'"},
      {"MassOfAVelocity", with_mass("[[\"m\", \"0\"],\n[\"0\", \"1 + dq1^2\"]]"),
       "7: mechanics.mass row 2 column 2: the mass matrix may depend on coordinates, t and parameters only, but this entry "
       "depends on "
       "'dq1'"},
      {"MassOfAnInput", with_mass("[[\"u1\", \"0\"], [\"0\", \"1\"]]"),
       "6: mechanics.mass row 1 column 1: the mass matrix may depend on coordinates, t and parameters only, but this entry "
       "depends on "
       "'u1'"},
      {"MassNotSymmetric", with_mass("[[\"m\", \"q1\"], [\"-q1\", \"1\"]]"),
       "6: mechanics.mass: not symmetric: row 1 column 2 is 'q1', but row 2 column 1 is '-q1'; write the same on both sides"},
      {"MassEntryIsBroken", with_mass("[[\"m\", \"0\"], [\"0\", \"2m\"]]"),
       "6: mechanics.mass row 2 column 2: \"2m\", column 2: found 'm' right after a number; a product needs its sign, write 2*m"},
      {"MassEntryIsABoolean", with_mass("[[true, \"0\"], [\"0\", \"1\"]]"),
       "6: mechanics.mass row 1 column 1: expected an expression in quotes, or a number, got true"},
      {"PotentialOfAVelocity", base + "potential = \"dq1^2\"\n",
       "7: mechanics.potential: the potential may depend on coordinates, t and parameters only, but this entry depends on 'dq1'"},
      {"ForceOfTheWrongLength", base + "force = [\"0\"]\n", "7: mechanics.force: expected 2 entries, one per coordinate, got 1"},
      {"ForceOfAnAcceleration", base + "force = [\"0\", \"ddq1\"]\n",
       "7: mechanics.force entry 2: a force may not depend on accelerations, but this entry depends on 'ddq1'"},
      // λ₀ follows from M, F and the constraints, whatever name it goes by
      {"MassOfALoad", with_mass("[[\"m\", \"0\"],\n[\"0\", \"1 + lambda0(1)\"]]"),
       "7: mechanics.mass row 2 column 2: lambda0(1) follows from M, F and the constraints, so that it may stand in features, "
       "directions, [truth] and [let] only"},
      {"ForceOfALoad",
       base + "force = [\"0\", \"-load*dq1\"]\n[let]\nload = \"lambda0( 1 )\"\n[constraints]\nposition = [\"q1\"]\n",
       "7: mechanics.force entry 2: lambda0(1) follows from M, F and the constraints, so that it may stand in features, "
       "directions, [truth] and [let] only"},
      {"ConstraintOfALoad", base + "[constraints]\nacceleration = [\"ddq1 - lambda0(1)\"]\n",
       "8: constraints.acceleration entry 1: lambda0(1) follows from M, F and the constraints, so that it may stand in features, "
       "directions, [truth] and [let] only"},
      {"LoadOfNoRow", base + "[constraints]\nposition = [\"q1\"]\n[[latent]]\nfeatures = [\"lambda0(2)\"]\n",
       "10: latent.features: lambda0(2): there is no such row of the constraints, of which there are 1"},
      {"LoadWithoutConstraints", base + "[truth]\nforce = [\"0\", \"lambda0(1)\"]\n",
       "8: truth.force entry 2: lambda0(1): there is no such row of the constraints, of which there are 0"},
      {"LoadWithoutARow", base + "[let]\nload = \"2*lambda0(1.5)\"\n",
       "8: let.load: \"2*lambda0(1.5)\", column 3: lambda0 takes the number of a row of the constraints, counted from 1, or its "
       "name; write lambda0(1)"},
      {"LoadOfARowWithoutName",
       base + "[constraints]\nposition = [{ expr = \"q1\", name = \"wall\" }]\n"
              "[[latent]]\nfeatures = [\"lambda0(wal)\"]\n",
       "10: latent.features: lambda0(wal): there is no such row of the constraints, of which there are 1"},
      {"LoadsOfTwoKindsInTheTruth",
       base + "[constraints]\nposition = [\"q1\"]\n"
              "[truth]\nforce = [\"lambda0(1)\", \"0\"]\nacceleration = [\"0\", \"lambda(1)\"]\n",
       "11: truth.acceleration: both lambda0 and lambda are read: write lambda for both, the multipliers of the motion itself"},
      {"LoadsOfTwoKindsInDirections",
       base + "[constraints]\nposition = [\"q1\"]\n"
              "[[latent]]\nfeatures = [\"q1\"]\ndirections = [[\"lambda0(1)\"],\n[\"lambda(1)\"]]\n",
       "12: latent.directions: both lambda0 and lambda are read: write lambda for both, the multipliers of the motion itself"},
      {"FeatureOfTheLoadOfTheMotion", base + "[constraints]\nposition = [\"q1\"]\n[[latent]]\nfeatures = [\"lambda(1)\"]\n",
       "10: latent.features: lambda is what the latents make it, so that only directions and [truth] may read it; write lambda0"},
      {"NameOfARowTaken", base + "[constraints]\nposition = [{ expr = \"q1\", name = \"q2\" }]\n",
       "8: constraints.position entry 1.name: the name 'q2' is taken already; choose another"},
      {"NameOfTheLoad", base + "[let]\nlambda0 = \"1\"\n",
       "8: let.lambda0: 'lambda0' is the name of a function or constant; choose another"},
      // what may not stand there is not listed as known
      {"ForceOfAnUnknownSymbol", base + "force = [\"0\", \"friction*dq1\"]\n",
       "7: mechanics.force entry 2: \"friction*dq1\", column 1: unknown symbol 'friction'; known here: q1, q2, dq1, dq2, t, u1, "
       "m"},
      {"MassOfAnUnknownSymbol", with_mass("[[\"inertia\", \"0\"], [\"0\", \"1\"]]"),
       "6: mechanics.mass row 1 column 1: \"inertia\", column 1: unknown symbol 'inertia'; known here: q1, q2, t, m"},
      {"ForceOfAnUnknownSymbolBesideALet",
       base + "force = [\"0\", \"friction\"]\n[let]\njerk = \"2*ddq1\"\nspeed = \"abs(dq1)\"\n",
       "7: mechanics.force entry 2: \"friction\", column 1: unknown symbol 'friction'; known here: q1, q2, dq1, dq2, t, u1, m, "
       "speed"},
      {"PositionOfAnUnknownSymbol", base + "[constraints]\nposition = [\"q1 - width\"]\n",
       "8: constraints.position entry 1: \"q1 - width\", column 6: unknown symbol 'width'; known here: q1, q2, t, m"},
      // constraints
      {"ConstraintsWithAnUnknownLevel", base + "[constraints]\nspeed = [\"dq1\"]\n",
       "8: constraints.speed: unknown key; known here: position, velocity, acceleration"},
      {"ConstraintIsNoArray", base + "[constraints]\nposition = \"q1\"\n",
       "8: constraints.position: expected an array [ … ], got 'q1'"},
      {"PositionConstraintOfAVelocity", base + "[constraints]\nposition = [\"q1\",\n\"q2 - dq1\"]\n",
       "9: constraints.position entry 2: a position-level constraint may depend on coordinates, t and parameters only, but this "
       "one "
       "depends on 'dq1'"},
      {"VelocityConstraintOfAnInput", base + "[constraints]\nvelocity = [\"dq1 - u1\"]\n",
       "8: constraints.velocity entry 1: a velocity-level constraint may depend on coordinates, velocities, t and parameters "
       "only, but "
       "this one depends on 'u1'"},
      {"AccelerationConstraintNotLinear", base + "[constraints]\nacceleration = [\"ddq1*ddq2\"]\n",
       "8: constraints.acceleration entry 1: an acceleration-level constraint must be linear in the accelerations, but the "
       "factor of "
       "'ddq1' depends on 'ddq2'"},
      {"PositionConstraintThatCannotAct", base + "[constraints]\nposition = [\"t - m\"]\n",
       "8: constraints.position entry 1: the constraint does not depend on any coordinate: it cannot act on the motion"},
      {"ConstraintIsANumber", base + "[constraints]\nvelocity = [0]\n",
       "8: constraints.velocity entry 1: the constraint does not depend on any velocity: it cannot act on the motion"},
      {"ConstraintAsAnEquation", base + "[constraints]\nposition = [\"q1 = q2\"]\n",
       "8: constraints.position entry 1: \"q1 = q2\", column 4: found '='; write an equation left = right as the expression left "
       "- "
       "(right)"},
      // latents
      {"LatentWithOneBracket", base + "[latent]\n" + features,
       "7: latent: write [[latent]], with two brackets: there may be several"},
      {"LatentIsANumber", "latent = 3\n" + base, "1: latent: expected an array [ … ], got 3"},
      {"LatentWithAnUnknownKey", latent + "lengths = 1\n" + features,
       "8: latent.lengths: unknown key; known here: name, kernel, features, directions, positive, lengthscale, "
       "lengthscales, signal_stddev"},
      {"PositiveWithoutDirections", latent + features + "positive = true\n",
       "9: latent.positive: a positive latent needs directions of its own, which it acts along: directions = { force = [[…], …] "
       "}"},
      {"PositiveIsNoTruth", latent + features + "positive = 1\n", "9: latent.positive: expected true or false, got 1"},
      {"LengthscalesAreNoTable", latent + features + "lengthscales = 1\n", "9: latent.lengthscales: expected a table, got 1"},
      {"LengthscaleOfNoFeature", latent + "features = [\"dq1\"]\nlengthscales = { dq2 = 1 }\n",
       "9: latent.lengthscales.dq2: no feature of this latent is called 'dq2', did you mean 'dq1'?"},
      {"LengthscaleOfNoFeatureAndNoneNear", latent + features + "lengthscales = { speed = 1 }\n",
       "9: latent.lengthscales.speed: no feature of this latent is called 'speed'; its features are q1"},
      {"LengthscaleTwice", latent + "features = [\"q2\"]\nlengthscales = { q2 = 1, 'sin(q2)' = 2 }\n",
       "9: latent.lengthscales.sin(q2): the lengthscale of 'sin(q2)' is given twice; leave out one"},
      {"LengthscaleOfAPeriodicKernel", latent + features + "kernel = \"periodic\"\nlengthscales = { q1 = 1 }\n",
       "10: latent.lengthscales.q1: the kernel \"periodic\" has no lengthscale in the unit of a feature"},
      {"NegativeLengthscale", latent + features + "lengthscales = { q1 = -1 }\n",
       "9: latent.lengthscales.q1: a lengthscale must be positive, got -1"},
      {"HeldWithoutAValue", latent + features + "lengthscale = { estimate = false }\n",
       "9: latent.lengthscale: estimate = false needs the value to hold: { value = 1, estimate = false }"},
      {"HeldAndEstimated", latent + features + "lengthscale = { bounds = [2, 2], estimate = true }\n",
       "9: latent.lengthscale: its bounds [2, 2] hold it: widen them, or leave out estimate = true"},
      {"ValueAndInitial", latent + features + "lengthscale = { value = 2, initial = 2 }\n",
       "9: latent.lengthscale: value and initial are two words for one number: leave out one"},
      {"LatentWithoutFeatures", latent + "kernel = \"se\"\n", "7: latent: missing features = [\"q1\", …]"},
      {"LatentOfNoFeature", latent + "features = []\n", "8: latent.features: a latent needs at least one feature"},
      {"LatentNameTwice", latent + "name = \"a\"\n" + features + "[[latent]]\nname = \"a\"\n" + features,
       "10: latent.name: 'a' is taken already"},
      {"LatentNamedDiscrepancy", latent + "name = \"discrepancy\"\n" + features,
       "7: latent.name: 'discrepancy' is the name of the latent that gp2 adds; take another"},
      {"FeatureOfAnAcceleration", latent + "features = [\"ddq1\"]\n",
       "8: latent.features: a feature may not depend on accelerations, but this entry depends on 'ddq1'"},
      {"FeatureTwice", latent + "features = [\"q1\", \"q1\"]\n", "8: latent.features: 'q1' stands twice; remove one"},
      {"FeatureTwiceOnceAsAnAngle", latent + "features = [\"q2\", \"sin(q2)\"]\n",
       "8: latent.features: 'sin(q2)' stands twice; remove one"},
      {"UnknownKernel", latent + "kernel = \"rbf\"\n" + features,
       "8: latent.kernel: kernel \"rbf\": unknown kernel 'rbf', here called se; use sums and products of se matern32 matern52 rq "
       "periodic linear "
       "constant"},
      {"UnknownDirections", latent + features + "directions = \"forces\"\n",
       "9: latent.directions: expected \"acceleration\", \"force\", \"potential\" or a matrix of expressions [[…], …], got "
       "\"forces\""},
      {"DirectionsOfTooFewRows", latent + features + "directions = [[\"1\"]]\n",
       "9: latent.directions: expected 2 rows, one per coordinate, got 1"},
      {"DirectionsWithRaggedRows", latent + features + "directions = [[\"1\"],\n[\"1\", \"0\"]]\n",
       "10: latent.directions: every row needs the same number of entries, at least one"},
      {"DirectionsWithEmptyRows", latent + features + "directions = [[], []]\n",
       "9: latent.directions: every row needs the same number of entries, at least one"},
      {"DirectionsAreNoMatrix", latent + features + "directions = [1, 2]\n",
       "9: latent.directions: expected an array [ … ], got 1"},
      {"DirectionsOfAnAcceleration", latent + features + "directions = [[\"ddq1\"], [\"0\"]]\n",
       "9: latent.directions: a direction may not depend on accelerations, but this entry depends on 'ddq1'"},
      {"DirectionsOfTwoKinds", latent + features + "directions = { force = [[1], [0]], acceleration = [[1], [0]] }\n",
       "9: latent.directions: expected { force = [[…], …] } or { acceleration = [[…], …] }"},
      {"DirectionsOfAnUnknownKind", latent + features + "directions = { torque = [[1], [0]] }\n",
       "9: latent.directions.torque: unknown key; known here: force, acceleration"},
      {"LengthscaleIsANumber", latent + features + "lengthscale = 3\n",
       "9: latent.lengthscale: expected a table such as { initial = 1, bounds = [0.1, 10] }, got 3"},
      {"LengthscaleBoundOfZero", latent + features + "lengthscale = { bounds = [0, 3] }\n",
       "9: latent.lengthscale.bounds: values are factors of the default scale and must be positive, got 0"},
      {"PriorOfALengthscaleThatMayBeNegative", latent + features + "lengthscale = { prior = { mean = 1, stddev = 1 } }\n",
       "9: latent.lengthscale.prior.mean: unknown key; known here: median, log_stddev"},
      {"SignalOfZero", latent + features + "signal_stddev = { initial = 0 }\n",
       "9: latent.signal_stddev.initial: values are factors of the default scale and must be positive, got 0"},
      {"SignalOutsideItsBounds", latent + features + "signal_stddev = { initial = 5, bounds = [1, 2] }\n",
       "9: latent.signal_stddev: the value 5 is outside its bounds [1, 2]"},
      // noise
      {"NoiseOfAnUnknownQuantity", base + "[noise]\nq1 = 0.1\n", "8: noise.q1: unknown key; known here: ddq"},
      {"NoiseOfZero", base + "[noise]\nddq = 0\n", "8: noise.ddq: a noise standard deviation must be positive, got 0"},
      {"NoiseNegative", base + "[noise]\nddq = [0.1, -1]\n", "8: noise.ddq: a noise standard deviation must be positive, got -1"},
      {"NoiseOfTheWrongLength", base + "[noise]\nddq = [0.1]\n",
       "8: noise.ddq: expected one value or 2, one per coordinate, got 1"},
      {"NoiseWithoutAStart", base + "[noise]\nddq = { estimate = true }\n",
       "8: noise.ddq: missing initial: where the estimate starts"},
      {"NoiseBelowItsFloor", base + "[noise]\nddq = { value = [0.1, 0.02], floor = 0.05 }\n",
       "8: noise.ddq: the value 0.02 is below its floor 0.05"},
      {"NoiseOutsideItsBounds", base + "[noise]\nddq = { value = 0.1, bounds = [[0.01, 1], [0.2, 1]] }\n",
       "8: noise.ddq: the value 0.1 is outside its bounds [0.2, 1]"},
      {"NoiseWithBoundsOfTheWrongLength", base + "[noise]\nddq = { value = 0.1, bounds = [[0.01, 1]] }\n",
       "8: noise.ddq.bounds: expected one range or 2, one per coordinate, got 1"},
      {"NoiseBoundOfZero", base + "[noise]\nddq = { value = 0.1, bounds = [0, 1] }\n",
       "8: noise.ddq.bounds: a noise standard deviation must be positive, got 0"},
      {"NoiseFloorOfZero", base + "[noise]\nddq = { value = 0.1, floor = 0 }\n",
       "8: noise.ddq.floor: a noise standard deviation must be positive, got 0"},
      {"NoiseIsText", base + "[noise]\nddq = \"estimate\"\n", "8: noise.ddq: expected a finite number, got 'estimate'"},
      // truth and sampling
      {"TruthWithoutAcceleration", base + "[truth]\n", "7: truth: missing acceleration = [ … ] or force = [ … ]"},
      {"TruthOfTheWrongLength", base + "[truth]\nacceleration = [\"0\"]\n",
       "8: truth.acceleration: expected 2 entries, one per coordinate, got 1"},
      {"TruthOfAnAcceleration", base + "[truth]\nacceleration = [\"0\", \"ddq1\"]\n",
       "8: truth.acceleration: the true acceleration may not depend on itself, but this entry depends on 'ddq1'"},
      {"SamplingInACircle", base + "[sampling]\nq1 = \"a\"\na = \"2*q1\"\n",
       "8: sampling.q1: drawn in terms of itself: q1 uses a uses q1"},
      {"SamplingOfAParameter", base + "[sampling]\nm = [1, 2]\n", "8: sampling.m: the name 'm' is taken already; choose another"},
      {"SamplingOfAnAcceleration", base + "[sampling]\nq1 = \"ddq1\"\n",
       "8: sampling.q1: a sample may not depend on accelerations, but this entry depends on 'ddq1'"},
      {"SamplingOfAnEmptyRange", base + "[sampling]\nq1 = [1, 1]\n",
       "8: sampling.q1: the lower end 1 must be below the upper end 1"},
      {"SamplingIsABoolean", base + "[sampling]\nq1 = true\n",
       "8: sampling.q1: expected an expression in quotes, or a number, got true"},
      {"StartOfAnInput", base + "[sampling]\nstart = { u1 = 1 }\n",
       "8: sampling.start.u1: 'u1' is neither a coordinate nor a velocity of this model"},
      {"StartIsANumber", base + "[sampling]\nstart = 1\n", "8: sampling.start: expected a table, got 1"},
      // units
      {"UnitOfAVelocity", base + "[units]\ndq1 = \"m/s\"\n",
       "8: units.dq1: not a coordinate, input or parameter of this model; units of velocities and accelerations follow, did you "
       "mean 'q1'?"},
      {"UnitIsANumber", base + "[units]\nq1 = 3\n", "8: units.q1: expected a text in quotes, got 3"},
      {"AngleInDegrees", "coordinates = [{ name = \"a\", angle = true }]\n[mechanics]\nmass = [[\"1\"]]\n[units]\na = \"deg\"\n",
       "5: units.a: this coordinate is an angle, whose sine and cosine are features: it is in rad"},
      {"DrawingWithoutPoints", base + "[drawing]\nlines = []\n",
       "7: drawing: missing points, as in points = { tip = [\"x\", \"y\"] }"},
      {"PointsOfTwoKinds", base + "[drawing.points]\na = [\"q1\", \"0\"]\nb = [\"q1\", \"0\", \"0\"]\n",
       "9: drawing.points.b: expected two coordinates [m], or three, of every point alike, got 3"},
      {"PointThatDependsOnAVelocity", base + "[drawing.points]\na = [\"q1\", \"dq1\"]\n",
       "8: drawing.points.a: a point may depend on coordinates, t and parameters only, but this entry depends on 'dq1'"},
      {"LineThroughNoPoint", base + "[drawing]\npoints = { tip = [\"q1\", \"0\"] }\nlines = [[\"tip\", \"tap\"]]\n",
       "9: drawing.lines: 'tap' is none of drawing.points, did you mean 'tip'?"},
      {"UnitIsNoLabel", base + "[units]\nq1 = \"\"\n", "8: units.q1: expected a short text, as in x = \"m\""},
      // columns
      {"ColumnOfAParameter", base + "[columns]\nm = \"mass\"\n",
       "8: columns.m: not a coordinate, velocity, acceleration, input or t of this model"},
      {"ColumnIsANumber", base + "[columns]\nq1 = 3\n", "8: columns.q1: expected a text in quotes, got 3"},
      {"ColumnTwice", base + "[columns]\nq1 = \"x\"\nq2 = \"x\"\n", "9: columns.q2: the column 'x' is another name's already"},
      {"ColumnOfAnotherName", base + "[columns]\nq1 = \"q1\"\nq2 = \"dq1\"\n",
       "9: columns.q2: the column 'dq1' has the name of another quantity of this model, and in files that gp2 writes it is that "
       "quantity: leave this out"},
      {"ColumnsExchanged", base + "[columns]\nq1 = \"q2\"\nq2 = \"q1\"\n",
       "8: columns.q1: the column 'q2' has the name of another quantity of this model, and in files that gp2 writes it is that "
       "quantity: leave this out, and read logs that are like this with `map=q2=q1,q1=q2`"},
  };
}

INSTANTIATE_TEST_SUITE_P(For, RefusedModel, testing::ValuesIn(complaints()),
                         [](const auto& complaint) { return complaint.param.what; });

TEST(Model, OnlyTheMultipliersOfItsRowsAreNamesOfColumns) {
  const std::string text = replaced(base, "\"u1\"", "\"lambda2\"") + "[constraints]\nposition = [\"q1 - q2\"";
  EXPECT_EQ(error_of(text + "]\n"), "");
  EXPECT_EQ(error_of(text + ", \"q1\"]\n"),
            "m.toml:2: inputs: the column lambda2 would be a name of this model and what logs and predictions call a quantity of "
            "the constraints; choose another name");
}

TEST(Model, ARowGoesByItsName) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[let]
load = "abs(lambda(wall)) + lambda0( floor )"
[constraints]
acceleration = [{ expr = "ddy", name = "floor" }]
position     = ["x - y", { expr = "x", name = "wall" }]
)toml",
                                   "named");
  EXPECT_EQ(model.expression("load"), model.expression("abs(lambda(2)) + lambda0(3)"));
}

TEST(Model, FeaturesMayReadTheKnownLoadAndDirectionsThatOfTheMotion) {
  EXPECT_EQ(error_of(base + "[constraints]\nposition = [\"q1\"]\n"
                            "[[latent]]\nfeatures = [\"lambda0(1)\"]\ndirections = [[\"lambda(1)\"], [\"0\"]]\n"
                            "[truth]\nforce = [\"lambda0(1)\", \"0\"]\n"),
            "");
}

TEST(Model, ARobotsDescriptionIsNoModel) {
  for (const char* text : {"<robot name=\"r\"/>", "\xEF\xBB\xBF<?xml version=\"1.0\"?>\n<!-- 90° -->\n<mujoco/>"}) {
    EXPECT_EQ(input_error_of([&] { Model::parse(text, "robots/arm.urdf"); }),
              "robots/arm.urdf: not valid TOML but XML: name a robot's description in a model file, as robot = \"arm.urdf\"");
  }
}

TEST(Model, BrokenTomlIsRefusedWithItsLine) {
  EXPECT_THAT(error_of(base + "\nforce = [\"0\"\n[let]\n"), StartsWith("m.toml:9: not valid TOML: "));
  EXPECT_THAT(error_of("coordinates = [\"q1]\n"), StartsWith("m.toml:1: not valid TOML: "));
  EXPECT_THAT(error_of(base + "mass = 3\n"), StartsWith("m.toml:7: not valid TOML: "));
  EXPECT_THAT(error_of("name = \"\xff\"\n"), StartsWith("m.toml:1: not valid TOML: "));
}

TEST(Model, UnitsOfWhatFollowsFromACoordinateAreDerived) {
  const Model model = parse(
      "coordinates = ['x', { name = 'phi', angle = true }, 's', 'w']\ninputs = ['f']\n[parameters]\nm = 1\nm2 = '2*m'\n"
      "[mechanics]\nmass = [['m','0','0','0'],['0','m','0','0'],['0','0','m','0'],['0','0','0','m']]\n"
      "[units]\nx = 'm'\ns = 'm/min'\nf = 'N'\nm = 'kg'\nm2 = 'kg'\n");
  const std::pair<const char*, const char*> units[] = {{"x", "m"},         {"dx", "m/s"},       {"ddx", "m/s²"},
                                                       {"abar_x", "m/s²"}, {"dx_next", "m/s"},  {"force_x", "N"},
                                                       {"phi", "rad"},     {"dphi", "rad/s"},   {"force_phi@drag", "N m"},
                                                       {"fc_x", "N"},      {"ds", "(m/min)/s"}, {"force_s", ""},
                                                       {"f", "N"},         {"m", "kg"},         {"m2", "kg"},
                                                       {"t", "s"},         {"w", ""},           {"dw", ""},
                                                       {"lambda1", ""}};
  for (const auto& [quantity, unit] : units) EXPECT_EQ(model.unit_of(quantity), unit) << quantity;
  EXPECT_EQ(model.labelled("ddx"), "ddx [m/s²]");
  EXPECT_EQ(model.labelled("w"), "w");
}

TEST(Model, WithoutUnitsThereAreNone) {
  const Model model = parse("coordinates = [{ name = 'phi', angle = true }]\n[mechanics]\nmass = [['1']]\n");
  EXPECT_THAT(model.units, testing::IsEmpty());
}

TEST(Model, AFileThatCannotBeReadIsNamed) {
  const test::TemporaryFolder folder;
  EXPECT_EQ(input_error_of([&] { Model::read(folder / "none.toml"); }),
            (folder / "none.toml").string() + ": cannot be read: No such file or directory");
  EXPECT_EQ(input_error_of([&] { Model::read(folder.path()); }), folder.path().string() + ": cannot be read: Is a directory");
}

// ---- hostile files

TEST(HostileModel, OfTwoMegabytesIsRefused) {
  const test::TemporaryFolder folder;
  const std::string text = base + "# " + std::string(2 << 20, 'x') + "\n";
  const std::string rule = fmt::format(": {} bytes; a model file has at most 1048576", text.size());
  EXPECT_EQ(error_of(text), "m.toml" + rule);
  const auto path = folder.write("large.toml", text);
  EXPECT_EQ(input_error_of([&] { Model::read(path); }), path.string() + rule);
}

TEST(HostileModel, NestedParenthesesAreRefused) {
  EXPECT_THAT(error_of(base + "force = [\"0\", \"" + nested("(", "q1", ")", 20000) + "\"]\n"),
              AllOf(StartsWith("m.toml:7: mechanics.force entry 2: \"((("), HasSubstr("column 201: "),
                    HasSubstr("nested deeper than 200")));
  EXPECT_THAT(error_of(base + "force = [\"0\", \"" + nested("(", "q1", ")", 400000) + "\"]\n"),
              HasSubstr("at most 65536 are allowed"));
  EXPECT_THAT(error_of(base + "force = [\"0\", \"" + nested("(", "q1", ")", 1000000) + "\"]\n"),
              HasSubstr("bytes; a model file has at most"));
}

TEST(HostileModel, NestedArraysAreRefused) {
  EXPECT_THAT(error_of("coordinates = " + nested("[", "", "]", 100000)),
              StartsWith("m.toml:1: arrays and tables are nested deeper than 32"));
}

TEST(HostileModel, TowersOfPowersAreReadOrRefusedQuickly) {
  const auto start = std::chrono::steady_clock::now();
  EXPECT_EQ(error_of(base + "[constraints]\nposition = [\"((((q1^99)^99)^99)^99) - q2\"]\n"), "");
  EXPECT_EQ(error_of(base + "[constraints]\nposition = [\"q1^99^99 - q2\"]\n"), "");
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(10));
}

TEST(HostileModel, AChainOfTenThousandLetNamesIsReadInEitherOrder) {
  for (const bool forwards : {true, false}) {
    std::string text = base + "force = [\"0\", \"x9999\"]\n[let]\n";
    for (int k = 0; k < 10000; ++k) {
      const int i = forwards ? k : 9999 - k;
      text += i == 0 ? std::string("x0 = \"q1\"\n") : fmt::format("x{} = \"x{} + 1\"\n", i, i - 1);
    }
    const Model model = parse(text);
    EXPECT_EQ(model.system->evaluate(Eigen::VectorXd::Ones(6), model.system->parameter_values()).F(0)[1], 10000);
  }
}

TEST(HostileModel, ACircleOfTenThousandLetNamesIsNamedInShort) {
  std::string text = base + "[let]\n";
  for (int k = 0; k < 10000; ++k) text += fmt::format("x{} = \"x{} + 1\"\n", k, (k + 1) % 10000);
  EXPECT_EQ(
      error_of(text),
      "m.toml:8: let.x0: defined in terms of itself: x0 uses x1 uses x2 uses x3 uses x4 uses x5 uses x6 uses x7 uses … uses x0");
}

TEST(HostileModel, LetNamesThatDoubleEachTimeAreReadOrRefused) {
  // 2^1000 characters when written out, 2000 nodes as a graph
  std::string text = base + "[constraints]\nposition = [\"x999 - q2\"]\n[let]\nx0 = \"q1\"\n";
  for (int k = 1; k < 1000; ++k) text += fmt::format("x{} = \"x{}*x{} + 1\"\n", k, k - 1, k - 1);
  const std::string error = error_of(text);
  EXPECT_TRUE(error.empty() || error.starts_with("m.toml:")) << error;
}

TEST(HostileModel, AGraphThatGrowsTooLargeIsRefused) {
  // the second derivative of a long chain
  std::string text = base + "[constraints]\nposition = [\"x19999\"]\n[let]\nx0 = \"q1\"\nx1 = \"q2\"\n";
  for (int k = 2; k < 20000; ++k) text += fmt::format("x{} = \"sin(x{}*q1 + x{}*q2)\"\n", k, k - 1, k - 2);
  EXPECT_THAT(error_of(text), AllOf(StartsWith("m.toml:8: constraints.position entry 1: "), HasSubstr("1000000")));
}

TEST(HostileModel, LongArraysAreRefusedByTheirLength) {
  std::string mass = "[";
  for (int k = 0; k < 200000; ++k) mass += "[],";
  EXPECT_EQ(error_of(with_mass(mass + "]")), "m.toml:6: mechanics.mass: expected 2 rows, one per coordinate, got 200000");
}

TEST(HostileModel, ManySamplingRulesAreSortedQuickly) {
  std::string text = base + "[sampling]\n";
  for (int k = 0; k < 20000; ++k) text += fmt::format("a{} = [0, 1]\n", k);
  const auto start = std::chrono::steady_clock::now();
  EXPECT_THAT(parse(text).sampling, SizeIs(20000));
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(10));
}

TEST(HostileModel, CutShortAnywhereItIsReadOrRefused) {
  const std::string text = read_file(std::filesystem::path(GP2_SOURCE_DIR) / "models" / "arm_on_moving_plane.toml");
  for (std::size_t n = 0; n < text.size(); n += 7) {
    const std::string error = error_of(text.substr(0, n));
    EXPECT_TRUE(error.empty() || error.starts_with("m.toml:")) << error;
  }
}

}  // namespace
}  // namespace gp2
