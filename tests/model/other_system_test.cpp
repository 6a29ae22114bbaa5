#include <regex>

#include <fmt/ranges.h>
#include <gmock/gmock.h>
#include <nlohmann/json.hpp>

#include "gp2/jobs/fit_problem.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

// Another system in which the latents of a model act: from files to observations, and there and back in a fit file.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using test::TemporaryFolder;
using testing::AllOf;
using testing::Contains;
using testing::HasSubstr;
using Quantity = View::Quantity;

/// A bead on a wire, and what another file may say otherwise.
struct BeadText {
  std::string coordinates = R"("x", "y")", inputs = R"("u")";
  std::string constraint = "y - k*x^2", k = "{ value = 0.7, bounds = [0.1, 2] }";
  std::string mass = "2.0", kernel = "se", features = R"("x", "dx", "u")", directions = "\"acceleration\"", extra;

  [[nodiscard]] Model model(const std::string& name) const {
    return Model::parse(fmt::format(R"toml(
coordinates = [{}]
inputs      = [{}]
[parameters]
m = {}
k = {}
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["u", "-9.81*m"]
[constraints]
position = ["{}"]
[[latent]]
name       = "drag"
kernel     = "{}"
features   = [{}]
directions = {}
{}
[noise]
ddq = [0.1, 0.2]
[truth]
acceleration = ["-0.3*dx", "-0.3*dy"]
[sampling]
x  = [-1, 1]
dx = [-1, 1]
u  = [-2, 2]
)toml",
                                    coordinates, inputs, mass, k, constraint, kernel, features, directions, extra),
                        name);
  }
};

Model home() { return BeadText{}.model("home.toml"); }

std::string refused(const BeadText& text, const PriorOptions& options = {}) {
  return input_error_of([&] { make_other_system(home(), text.model("other.toml"), options); });
}

BeadText with(std::string BeadText::*member, const std::string& value) {
  BeadText text;
  text.*member = value;
  return text;
}

// ---- which systems fit

TEST(MakeSetting, TakesOtherConstraintsMassesAndParameters) {
  EXPECT_EQ(refused({}), "");
  EXPECT_EQ(refused(with(&BeadText::constraint, "y - sin(k*x)")), "");
  EXPECT_EQ(refused(with(&BeadText::mass, "5.0")), "");
  EXPECT_EQ(refused(with(&BeadText::kernel, " se ")), "");
}

TEST(MakeSetting, NamesWhatDiffers) {
  const std::string rule = "other.toml: another system of 'home.toml' must have the same coordinates, inputs and latents, but ";
  const std::string text = std::regex_replace(BeadText{}.model("x").text, std::regex("\\by\\b"), "z");
  const std::string of_z = std::regex_replace(text, std::regex("\\bdy\\b"), "dz");
  EXPECT_EQ(input_error_of([&] { make_other_system(home(), Model::parse(of_z, "other.toml")); }),
            rule + "its coordinates are x, z there, but x, y here");
  EXPECT_EQ(refused(with(&BeadText::inputs, R"("u", "v")")), rule + "its inputs are u, v there, but u here");
  EXPECT_EQ(refused(with(&BeadText::extra, "[[latent]]\nkernel = \"se\"\nfeatures = [\"x\"]")),
            rule + "the number of its latents is 2 there, but 1 here");
  EXPECT_EQ(refused(with(&BeadText::kernel, "se + linear")),
            rule + "the kernel of its latent 1, 'drag', is se+linear there, but se here");
  EXPECT_EQ(refused(with(&BeadText::features, R"("x", "u")")),
            rule + "the features of its latent 1, 'drag', are x, u there, but x, dx, u here");
  EXPECT_EQ(refused(with(&BeadText::directions, R"("force")")),
            rule + "the directions of its latent 1, 'drag', are \"force\" there, but \"acceleration\" here");
  EXPECT_EQ(refused(with(&BeadText::directions, R"([["dx"], ["dy"]])")),
            rule + "the directions of its latent 1, 'drag', are 1 of its own (accelerations) there, but \"acceleration\" here");
  const Model along = with(&BeadText::directions, R"([["dx"], ["dy"]])").model("home.toml");
  const Model by_force = with(&BeadText::directions, R"({ force = [["dx"], ["dy"]] })").model("other.toml");
  EXPECT_EQ(
      input_error_of([&] { make_other_system(along, by_force); }),
      rule + "the directions of its latent 1, 'drag', are 1 of its own (forces) there, but 1 of its own (accelerations) here");
  const Model two = with(&BeadText::extra, "[[latent]]\nname = \"lift\"\nkernel = \"se\"\nfeatures = [\"x\"]").model("home.toml");
  std::string swapped = std::regex_replace(two.text, std::regex("\"drag\""), "\"none\"");
  swapped = std::regex_replace(swapped, std::regex("\"lift\""), "\"drag\"");
  swapped = std::regex_replace(swapped, std::regex("\"none\""), "\"lift\"");
  EXPECT_EQ(input_error_of([&] { make_other_system(two, Model::parse(swapped, "other.toml")); }),
            rule + "its latents are lift, drag there, but drag, lift here");
  // --prior replaces the directions of both
  EXPECT_EQ(refused(with(&BeadText::directions, R"("force")"), {Prior::Mean::zero, Latent::Base::force, false, {}}), "");
}

TEST(MakeSetting, SharesTheParametersThatTheOtherFileMarks) {
  BeadText text = with(&BeadText::mass, "{ value = 5.0, estimate = true }");
  text.k = "0.2";
  const auto other_system = make_other_system(home(), text.model("other.toml"));
  EXPECT_EQ(other_system->shared, (std::vector{0, -1}));
  EXPECT_EQ(other_system->parameters(Eigen::Vector2d(3, 0.9)), Eigen::Vector2d(3, 0.2));
}

TEST(MakeSetting, RefusesASharedParameterInAFeature) {
  BeadText text = with(&BeadText::mass, "{ value = 5.0, estimate = true }");
  text.features = R"("x", "dx", "u/m")";
  const Model at_home = with(&BeadText::features, text.features).model("home.toml");
  EXPECT_THAT(
      input_error_of([&] { make_other_system(at_home, text.model("other.toml")); }),
      AllOf(HasSubstr("other.toml: parameter 'm' is marked estimate = true"), HasSubstr("a feature of the latent 'drag'")));
}

// ---- fits of several logs, and of knowledge

CsvTable table(const Model& model, int n, std::uint64_t seed, const std::string& name) {
  const GeneratedData data =
      generate(model, {n, seed, Eigen::Map<const VectorXd>(model.noise.stddev.data(), model.system->nq())});
  std::string csv = "x,y,dx,dy,u,ddx,ddy\n";
  const StateLayout layout = model.system->layout();
  for (int i = 0; i < n; ++i) {
    std::vector<double> numbers(data.states.col(i).begin(), data.states.col(i).begin() + 4);
    numbers.push_back(data.states(layout.u(0), i));
    numbers.insert(numbers.end(), data.accelerations.col(i).begin(), data.accelerations.col(i).end());
    std::vector<std::string> cells;
    for (double number : numbers) cells.push_back(shortest(number));
    csv += fmt::format("{}\n", fmt::join(cells, ","));
  }
  return CsvTable::parse(csv, name);
}

std::shared_ptr<const Model> other_model() {
  BeadText text = with(&BeadText::constraint, "y - sin(k*x)");
  text.k = "{ value = 0.5, bounds = [0.1, 2], estimate = true }";
  text.mass = "3.0";
  return std::make_shared<const Model>(text.model("other.toml"));
}

SideInformation at_rest(const std::string& columns = "abar_x,abar_y", const std::string& values = "0,0") {
  SideInformation knowledge;
  knowledge.log.table = CsvTable::parse("x,dx,u," + columns + "\n0.1,0,0," + values + "\n0.4,0,0," + values + "\n", "rest.csv");
  return knowledge;
}

TEST(PooledProblem, HasAGroupPerLogEachUnderItsOwnSystem) {
  const Model model = home();
  const auto other = other_model();
  FitProblemOptions options;
  options.max_points = 5;
  const FitProblem problem =
      make_fit_problem(model, {Log{table(model, 8, 1, "a.csv")}, Log{table(*other, 4, 2, "b.csv"), other}}, {}, options);
  ASSERT_EQ(problem.observations.size(), 2U);
  EXPECT_EQ(problem.observations[0].view().other_system, nullptr);
  EXPECT_EQ(problem.observations[0].n_data(), 5) << "max_points is of each log";
  const Observations& b = problem.observations[1];
  ASSERT_NE(b.view().other_system, nullptr);
  EXPECT_EQ(b.view().other_system->prior.system, other->system);
  EXPECT_EQ(b.view().other_system->shared, (std::vector{-1, 1}));
  EXPECT_EQ(b.n_data(), 4);
  EXPECT_EQ(problem.systems, (std::vector<std::shared_ptr<const Model>>{nullptr, other}));
  EXPECT_THAT(problem.notes, Contains("a.csv: 5 of 8 rows taken, by seed 0"));
}

TEST(PooledProblem, TakesTheNoiseOfEachModelOrOneForAll) {
  const Model model = home();
  BeadText text;
  std::string noisier = text.model("x").text;
  noisier.replace(noisier.find("[0.1, 0.2]"), 10, "0.4");
  const auto other = std::make_shared<const Model>(Model::parse(noisier, "other.toml"));
  const std::vector<Log> logs = {Log{table(model, 8, 1, "a.csv")}, Log{table(model, 8, 2, "b.csv"), other}};
  const FitProblem own = make_fit_problem(model, logs, {}, {});
  EXPECT_EQ(own.observations[0].noise().stddev(), Eigen::Vector2d(0.1, 0.2));
  EXPECT_EQ(own.observations[1].noise().stddev(), Eigen::Vector2d(0.4, 0.4));
  FitProblemOptions options;
  options.noise_stddev = 0.3;
  for (const Observations& group : make_fit_problem(model, logs, {}, options).observations) {
    EXPECT_EQ(group.noise().stddev(), Eigen::Vector2d(0.3, 0.3));
  }
  options.noise_stddev.reset();
  options.estimate_noise = true;
  std::vector<std::string> names;
  for (const Hyperparameter& h : make_fit_problem(model, logs, {}, options).hyperparameters) {
    if (h.kind == Hyperparameter::Kind::noise_stddev) names.push_back(h.name);
  }
  EXPECT_THAT(names,
              testing::ElementsAre("noise_stddev(ddx)", "noise_stddev(ddy)", "noise_stddev(ddx)#2", "noise_stddev(ddy)#2"));
}

TEST(PooledProblem, SaysWhichParametersAreNotOneAndTheSame) {
  const Model model = home();
  FitProblemOptions options;
  options.estimate = {"m", "k"};
  BeadText text = with(&BeadText::k, "{ value = 0.5, estimate = true }");
  text.extra = "[parameters.spare]\nvalue = 4.0\nestimate = true\n";
  const auto other = std::make_shared<const Model>(text.model("other.toml"));
  const FitProblem problem =
      make_fit_problem(model, {Log{table(model, 8, 1, "a.csv")}, Log{table(*other, 8, 1, "b.csv"), other}}, {}, options);
  EXPECT_THAT(problem.notes, Contains("other.toml: parameter 'm' stays 2 there while it is estimated in 'home.toml'; mark it "
                                      "estimate = true there if it is one and the same"));
  EXPECT_THAT(problem.notes, Contains("other.toml: parameter 'spare' is marked estimate = true, but 'home.toml' has none of that "
                                      "name: it stays 4"));
}

TEST(PooledProblem, ARenamingMustBeOfSomeLog) {
  const Model model = home();
  std::string text = "X,dX,u,ddX,ddy\n0,1,0,1,2\n1,0,1,2,2\n";
  const CsvTable renamed = CsvTable::parse(text, "b.csv");
  FitProblemOptions options;
  options.columns = {{"x", "X"}};
  EXPECT_EQ(make_fit_problem(model, {Log{table(model, 8, 1, "a.csv")}, Log{renamed}}, {}, options).observations[1].values()(0, 1),
            2);
  options.columns = {{"x", "Z"}};
  EXPECT_EQ(
      input_error_of([&] {
        make_fit_problem(model, {Log{table(model, 8, 1, "a.csv")}, Log{renamed}}, {}, options);
      }),
      "`map=Z=x`: a.csv has no column 'Z'; it has: x, y, dx, dy, u, ddx, ddy; b.csv has no column 'Z'; it has: X, dX, u, ddX, "
      "ddy");
}

TEST(KnownViews, ObserveTheColumnsThatAreThere) {
  const Model model = home();
  const std::vector<Log> logs = {Log{table(model, 8, 1, "a.csv")}};
  const auto alone = [&](const SideInformation& knowledge) {
    FitProblemOptions options;
    options.also_noise_stddev = 0.01;
    if (knowledge.quantity == Quantity::next_velocity) options.time_step = 0.02;
    return make_fit_problem(model, logs, {knowledge}, options).observations.at(1);
  };
  EXPECT_EQ(alone(at_rest()).view().rows, (std::vector{0, 1}));
  EXPECT_EQ(alone(at_rest("abar_y", "-9.81")).view().rows, std::vector{1});
  EXPECT_EQ(alone(at_rest("abar_y", "-9.81")).values(), (MatrixXd(1, 2) << -9.81, -9.81).finished());
  EXPECT_EQ(alone(at_rest("abar_y", "-9.81")).noise().stddev(), VectorXd::Constant(1, 0.01));
  const auto of = [&](Quantity quantity, const std::string& columns, const std::string& values, const std::string& latent = "") {
    SideInformation knowledge = at_rest(columns, values);
    knowledge.quantity = quantity;
    knowledge.latent = latent;
    return alone(knowledge);
  };
  EXPECT_EQ(of(Quantity::constraint_force, "fc_y,fc_x", "1,0").view().rows, (std::vector{0, 1}));
  EXPECT_EQ(of(Quantity::multipliers, "lambda1", "3").values()(0, 1), 3);
  EXPECT_EQ(of(Quantity::constrained_acceleration, "ddx", "3").view().rows, std::vector{0});
  EXPECT_EQ(of(Quantity::next_velocity, "dx_next,dy_next,dy", "3,0,0").view().time_step, 0.02);
  const Observations drag = of(Quantity::unconstrained_acceleration, "abar_x@drag", "0", "drag");
  EXPECT_EQ(drag.view().latent, 0);
  EXPECT_EQ(drag.view().rows, std::vector{0});
}

TEST(KnownViews, TakeTheModelsNoiseForAccelerationsOnly) {
  const Model model = home();
  const std::vector<Log> logs = {Log{table(model, 8, 1, "a.csv")}};
  EXPECT_EQ(make_fit_problem(model, logs, {at_rest("abar_y", "0")}, {}).observations[1].noise().stddev(),
            VectorXd::Constant(1, 0.2));
  SideInformation force = at_rest("fc_x", "0");
  force.quantity = Quantity::constraint_force;
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, logs, {force}, {}); }),
            "`also=constraint-force`: rest.csv: its noise is not known: give `also_noise_std=S`");
}

TEST(KnownViews, ConstantsAreKnownNoBetterThanDoublesCanHold) {
  const Model model = home();
  const std::vector<Log> logs = {Log{table(model, 8, 1, "a.csv")}};
  FitProblemOptions options;
  const auto refusal = [&](double noise) {
    options.also_noise_stddev = noise;
    return input_error_of([&] { make_fit_problem(model, logs, {at_rest()}, options); });
  };
  EXPECT_EQ(refusal(1e-5), "");
  EXPECT_THAT(refusal(1e-9), AllOf(HasSubstr("`also_noise_std`: the noise standard deviation 1e-09 of abar_x is too small"),
                                   HasSubstr("the smallest usable value is")));
  EXPECT_EQ(refusal(0), "`also_noise_std`: the noise standard deviation of abar_x must be positive, got 0");
}

TEST(KnownViews, RefuseWhatCannotBeMeant) {
  const Model model = home();
  const std::vector<Log> logs = {Log{table(model, 8, 1, "a.csv")}};
  FitProblemOptions options;
  options.also_noise_stddev = 0.1;
  const auto refusal = [&](SideInformation knowledge, Quantity quantity = Quantity::unconstrained_acceleration) {
    knowledge.quantity = quantity;
    return input_error_of([&] { make_fit_problem(model, logs, {knowledge}, options); });
  };
  EXPECT_EQ(refusal(at_rest("abar_z", "0")),
            "`also=unconstrained`: rest.csv has none of the columns abar_x, abar_y; it has: x, dx, u, abar_z");
  SideInformation unknown = at_rest();
  unknown.latent = "lift";
  EXPECT_EQ(refusal(unknown), "`also=unconstrained`: no latent is called 'lift'; there are: drag");
  EXPECT_EQ(refusal(at_rest("dx_next", "0"), Quantity::next_velocity), "`also=next-velocity` needs the time step: `dt=SECONDS`");
  options.time_step = -1;
  EXPECT_EQ(refusal(at_rest("dx_next", "0"), Quantity::next_velocity), "`dt`: must be positive, got -1");
  EXPECT_EQ(refusal(at_rest()), "`dt` goes with `also=next-velocity:FILE.csv`");
  options.time_step.reset();
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, logs, {}, options); }),
            "`also_noise_std` goes with `also=VIEW:FILE.csv`");
  const Model free = Model::parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[2]]\n[noise]\nddq = 0.1\n", "free.toml");
  SideInformation lambda{Quantity::multipliers, "", Log{CsvTable::parse("x,dx,lambda1\n0,0,1\n", "l.csv")}};
  EXPECT_EQ(input_error_of(
                [&] { make_fit_problem(free, {Log{CsvTable::parse("x,dx,ddx\n0,0,1\n1,2,3\n", "a.csv")}}, {lambda}, options); }),
            "`also=multipliers`: 'free.toml' has no constraints");
}

TEST(Knowledge, AloneIsLearntFrom) {
  const Model model = home();
  SideInformation next = at_rest("dx_next,dy_next,dy", "0.1,0,0"), multiplier = at_rest("lambda1", "2");
  next.quantity = Quantity::next_velocity;
  multiplier.quantity = Quantity::multipliers;
  FitProblemOptions options;
  options.also_noise_stddev = 0.05;
  FitOptions fit_options;
  fit_options.n_restarts = 1;
  for (const SideInformation& one : {at_rest(), next, multiplier}) {
    SCOPED_TRACE(one.quantity->word());
    options.time_step = one.quantity->needs_time_step() ? std::optional(0.1) : std::nullopt;
    const FitProblem problem = make_fit_problem(model, {}, {one}, options);
    ASSERT_EQ(problem.observations.size(), 1U);
    EXPECT_FALSE(problem.prior_options.discrepancy) << "of what is measured there is none";
    const Posterior posterior = fit(problem, fit_options).posterior;
    const Observations& known = problem.observations[0];
    EXPECT_LE(test::largest(posterior.mean(known.view(), known.states()) - known.values()), 0.1);
  }
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, {}, {}, options); }),
            "there is nothing to fit: give logs with `data`, or other knowledge with `also`");
}

// ---- there and back

FitFile fit_of_everything() {
  FitFile file;
  file.model = home();
  const auto other = other_model();
  FitProblemOptions options;
  options.mean = Prior::Mean::force;
  options.estimate = {"k"};
  options.estimate_noise = true;
  options.also_noise_stddev = 0.05;
  options.time_step = 0.1;
  SideInformation next = at_rest("dx_next,dy_next,dy", "0.1,0,0"), force = at_rest("lambda1", "2");
  next.quantity = Quantity::next_velocity;
  force.quantity = Quantity::multipliers;
  force.log.model = other;
  SideInformation drag = at_rest("abar_x@drag", "0");
  drag.latent = "drag";
  FitProblem problem =
      make_fit_problem(file.model, {Log{table(file.model, 9, 1, "a.csv")}, Log{table(*other, 7, 2, "b.csv"), other}},
                       {next, force, drag}, options);
  file.prior_options = problem.prior_options;
  FitOptions fit_options;
  fit_options.n_restarts = 1;
  fit_options.max_iterations = 5;
  fit_options.n_threads = 1;
  file.report = gp2::fit(problem.prior, problem.observations, problem.hyperparameters, fit_options).report;
  file.observations = std::move(problem.observations);
  file.systems = std::move(problem.systems);
  return file;
}

TEST(FitFileOfSeveralSystems, PredictsTheSameBitsAfterItWasWrittenAndRead) {
  const TemporaryFolder folder;
  const FitFile fit = fit_of_everything();
  fit.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  ASSERT_EQ(read.observations.size(), 5U);
  for (std::size_t g = 0; g < 5; ++g) {
    const View &a = fit.observations[g].view(), &b = read.observations[g].view();
    EXPECT_EQ(std::tie(a.quantity, a.rows, a.time_step, a.latent), std::tie(b.quantity, b.rows, b.time_step, b.latent));
    EXPECT_EQ(a.other_system == nullptr, b.other_system == nullptr);
    EXPECT_EQ(fit.observations[g].values(), read.observations[g].values());
    if (a.other_system) {
      EXPECT_EQ(a.other_system->shared, b.other_system->shared);
    }
  }
  const Posterior before = fit.posterior(), after = read.posterior();
  EXPECT_EQ(before.negative_log_likelihood(), after.negative_log_likelihood());
  const MatrixXd states = test::draw(fit.model, 5, 9).states;
  const auto third = std::make_shared<const Model>(with(&BeadText::constraint, "y - k*x^3").model("third.toml"));
  for (const Quantity quantity :
       {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration, Quantity::multipliers}) {
    View here = View::all(quantity, *fit.model.system), there = here;
    here.other_system = make_other_system(fit.model, *third, fit.prior_options);
    there.other_system = make_other_system(read.model, *third, read.prior_options);
    EXPECT_EQ(before.mean(here, states), after.mean(there, states));
    EXPECT_EQ(before.marginal(here, states).covariance, after.marginal(there, states).covariance);
    EXPECT_TRUE(before.mean(here, states).allFinite());
  }
  read.write(folder / "again.json");
  EXPECT_EQ(read_file(folder / "fit.json"), read_file(folder / "again.json"));
}

TEST(FitFileOfSeveralSystems, NeedsTheModelFileOfEach) {
  const TemporaryFolder folder;
  FitFile fit = fit_of_everything();
  fit.systems.clear();
  EXPECT_THAT(input_error_of([&] { fit.write(folder / "lost.json"); }),
              HasSubstr("lost.json: the model file of the system of observations 2 is not given"));
  EXPECT_FALSE(std::filesystem::exists(folder / "lost.json"));
  fit.observations.erase(fit.observations.begin() + 1, fit.observations.end());
  std::erase_if(fit.report.hyperparameters,
                [](const Hyperparameter& h) { return h.kind == Hyperparameter::Kind::noise_stddev && h.owner > 0; });
  fit.report.uncertainty.reset();
  fit.write(folder / "home.json");
  EXPECT_EQ(FitFile::read(folder / "home.json").observations.size(), 1U);
}

TEST(FitFileOfSeveralSystems, RefusesASystemThatDoesNotFit) {
  const TemporaryFolder folder;
  fit_of_everything().write(folder / "fit.json");
  std::string text = read_file(folder / "fit.json");
  const std::string kernel = R"(kernel     = \"se\")";
  // the second model is that of the second group
  const std::size_t place = text.find(kernel, text.find(kernel) + 1);
  ASSERT_NE(place, std::string::npos);
  text.replace(place, kernel.size(), R"(kernel     = \"rq\")");
  text = test::without_checksum(nlohmann::ordered_json::parse(text)).dump();
  const auto damaged = folder.write("damaged.json", text);
  EXPECT_THAT(input_error_of([&] { FitFile::read(damaged); }),
              AllOf(HasSubstr("damaged.json: other.toml: another system of 'home.toml'"), HasSubstr("is rq there, but se here")));
}

}  // namespace
}  // namespace gp2
