#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "hyperparameter.hpp"
#include "io_testing.hpp"
#include "jobs/fit_notes.hpp"

// What a fit says before it begins and after it has ended.
namespace gp2 {
namespace {

using test::hyperparameter;
using test::input_error_of;
using testing::AllOf;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;
using testing::StartsWith;

Model constrained_cart(const std::string& constraints) {
  return Model::parse("coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\n" + constraints +
                          "[[latent]]\nkernel = 'se'\nfeatures = ['dx']\ndirections = 'acceleration'\n",
                      "cart");
}

FitProblem problem_of(const Model& model, const CsvTable& log) {
  FitProblemOptions options;
  options.project = true;
  options.estimate_noise = true;
  return make_fit_problem(model, log, options);
}

TEST(FitNotes, NameWhatEndedAtABound) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n", "log.csv");
  FitOptions nothing;
  nothing.max_iterations = 0;
  const Posterior free = fit(problem_of(constrained_cart(""), log), nothing).posterior;
  const Posterior bound = fit(problem_of(constrained_cart("[constraints]\nacceleration = ['ddy']\n"), log), nothing).posterior;
  FitReport report;
  report.iterations = 10;
  report.hyperparameters = {hyperparameter(Hyperparameter::Kind::parameter, "m", 2, 0.5, 2),
                            hyperparameter(Hyperparameter::Kind::parameter, "k", 1, 0.5, 2),
                            hyperparameter(Hyperparameter::Kind::noise_stddev, "noise of ddx", 1e-4, 1e-4, 1),
                            hyperparameter(Hyperparameter::Kind::noise_stddev, "noise of ddy", 1e-4, 1e-4, 1)};
  EXPECT_THAT(notes_of(report, bound),
              ElementsAre(HasSubstr("warning: m ended at its bound, 2."),
                          HasSubstr("warning: noise of ddx, noise of ddy ended at the lower bound: the columns may not be")));
  // without a constraint no column follows from another
  EXPECT_THAT(
      notes_of(report, free),
      ElementsAre(HasSubstr("m ended"), StartsWith("noise of ddx, noise of ddy ended at the lower bound: the log has less")));
  // where nothing was optimised nothing ended anywhere
  report.iterations = 0;
  EXPECT_THAT(notes_of(report, free), testing::IsEmpty());
  // but what is likeliest already has
  report.converged = true;
  EXPECT_THAT(notes_of(report, free), testing::SizeIs(2));
}

// One that lies far beyond its bound makes the noise so large that the data hardly tell where within its bounds it is.
TEST(FitNotes, NameABoundBeforeWhatTheDataDoNotDetermine) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n", "log.csv");
  FitOptions nothing;
  nothing.max_iterations = 0;
  const Posterior posterior = fit(problem_of(constrained_cart(""), log), nothing).posterior;
  FitReport report;
  report.iterations = 10;
  report.hyperparameters = {hyperparameter(Hyperparameter::Kind::parameter, "m", 2, 0.5, 2),
                            hyperparameter(Hyperparameter::Kind::parameter, "k", 1, 0.5, 2)};
  constexpr double infinity = std::numeric_limits<double>::infinity();
  LaplaceUncertainty& uncertainty = report.uncertainty.emplace();
  uncertainty.stddev = Eigen::Vector2d(infinity, 0.1);
  uncertainty.correlation = Eigen::Matrix2d::Identity();
  uncertainty.undetermined = Eigen::Vector2d(1, 0);
  const std::vector<std::string> notes = notes_of(report, posterior);
  ASSERT_GE(notes.size(), 2U);
  EXPECT_THAT(notes[0], StartsWith("warning: m ended at its bound, 2."));
  EXPECT_THAT(notes[1], StartsWith("warning: the data do not determine m."));
  // where another makes up for it any value is as good
  uncertainty.stddev[1] = infinity;
  uncertainty.undetermined = Eigen::Vector2d(1, 1).normalized();
  EXPECT_THAT(notes_of(report, posterior), Not(Contains(HasSubstr("ended at its bound"))));
}

TEST(FitNotes, NameStatedDeviationsThatAreFarTooSmall) {
  const auto notes_for = [](const char* log) {
    FitOptions nothing;
    nothing.max_iterations = 0;
    const Posterior posterior = fit(problem_of(constrained_cart(""), CsvTable::parse(log, "log.csv")), nothing).posterior;
    FitReport report;
    report.iterations = 10;
    report.hyperparameters = {hyperparameter(Hyperparameter::Kind::noise_stddev, "noise of ddx", 7, 0.2, 100)};
    return notes_of(report, posterior);
  };
  EXPECT_THAT(notes_for("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n"), testing::IsEmpty()) << "it is no factor";
  EXPECT_THAT(notes_for("x,y,dx,dy,ddx,ddy,ddx_std\n1,2,3,4,5,0,0.5\n2,3,4,5,6,0,0.5\n"),
              ElementsAre(StartsWith("noise of ddx = 7: the standard deviations in the log are too")));
}

TEST(FitNotes, TellOfFewValuesForWhatIsEstimated) {
  FitReport report;
  report.hyperparameters = {hyperparameter(Hyperparameter::Kind::parameter, "m", 1, 0.5, 2)};
  const auto notes = [&](int n_rows, const std::string& constraints) {
    std::string text = "x,y,dx,dy,ddx,ddy\n";
    for (int i = 0; i < n_rows; ++i) text += fmt::format("{},{},{},{},{},0\n", i, i + 1, i % 3, i % 4, i % 5);
    FitOptions nothing;
    nothing.max_iterations = 0;
    std::vector<std::string> out;
    const FitProblem problem = problem_of(constrained_cart(constraints), CsvTable::parse(text, "log.csv"));
    add_few_values_note(report, fit(problem, nothing).posterior, out);
    return out;
  };
  EXPECT_THAT(notes(4, ""), testing::IsEmpty()) << "no standard errors";
  report.uncertainty.emplace();
  EXPECT_THAT(notes(4, ""),
              ElementsAre(StartsWith("warning: 8 measured values are few for 1 estimated parameters and 2 functions:")));
  EXPECT_THAT(notes(5, ""), testing::IsEmpty());
  // ddy follows from the constraint
  EXPECT_THAT(notes(8, "[constraints]\nacceleration = ['ddy']\n"), ElementsAre(StartsWith("warning: 8 measured values")));
  report.draws.emplace();
  EXPECT_THAT(notes(4, ""), testing::IsEmpty()) << "what is not known of hyperparameters is in the draws";
}

TEST(FitNotes, TellThatThePapersProtocolTakesNoDirections) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n", "log.csv");
  FitProblemOptions options;
  options.protocol.name = Protocol::Name::paper;
  options.noise_stddev = 0.1;
  const Model plain = constrained_cart("");
  std::string text = plain.text;
  text.replace(text.find("'acceleration'"), 14, "{ force = [['-dx'], ['0']] }");
  const testing::Matcher<std::vector<std::string>> told = Contains(HasSubstr("directions of the model's latent are ignored"));
  EXPECT_THAT(make_fit_problem(plain, log, options).notes, testing::Not(told));
  EXPECT_THAT(make_fit_problem(Model::parse(text, "cart"), log, options).notes, told);
  const Model two = Model::parse(plain.text + "[[latent]]\nkernel = 'se'\nfeatures = ['dy']\n", "cart");
  EXPECT_THAT(input_error_of([&] { make_fit_problem(two, log, options); }),
              HasSubstr("`protocol=paper` has one latent, on the acceleration, but 'cart' has 2"));
}

// A force along the normal of a curve changes no acceleration, but the constraint force.
TEST(FitNotes, TellOfALatentThatTheConstraintsTakeUp) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0.5,3,3,5,14\n2,2,1,2,1,3\n0.5,0.125,1,0.5,2,2\n", "log.csv");
  const auto told = [&](const std::string& direction) {
    const Model model = Model::parse(
        "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '2']]\nforce = ['0', '-9.81']\n[constraints]\n"
        "position = ['y - 0.5*x^2']\n[[latent]]\nname = 'drag'\nkernel = 'se'\nfeatures = ['dx']\ndirections = { force = " +
            direction + " }\n",
        "wire");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    return make_fit_problem(model, log, options).notes;
  };
  EXPECT_THAT(told("[['-x'], ['1']]"),
              testing::Contains(HasSubstr("warning: latent 'drag' acts along the constraints, which take "
                                          "it up, at all of 3 states")));
  for (const std::string sound : {"[['1'], ['x']]", "[['0'], ['1']]", "[['-x'], ['1 + 1e-3*dx']]"}) {
    EXPECT_THAT(told(sound), Not(testing::Contains(HasSubstr("take it up")))) << sound;
  }
}

TEST(FitNotes, TellNothingOfTheCoordinateThatAConstraintHolds) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0,3,0,5,0\n2,0,1,0,1,0\n0.5,0,2,0,2,0\n", "log.csv");
  const auto told = [&](const std::string& directions) {
    const Model model = Model::parse(
        "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '2']]\nforce = ['0', '-9.81']\n[constraints]\n"
        "position = ['y']\n[[latent]]\nname = 'drag'\nfeatures = ['dx']\ndirections = " +
            directions + "\n",
        "rail");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    return make_fit_problem(model, log, options).notes;
  };
  EXPECT_THAT(told("'force'"), Not(Contains(HasSubstr("take it up"))));
  EXPECT_THAT(
      told("{ force = [['1', '0'], ['0', '1']] }"),
      Contains(HasSubstr("warning: latent 'drag', direction 2, acts along the constraints, which take it up, at all of 3")));
}

// What a latent reads of the load of the constraints may be none, or a choice.
TEST(FitNotes, TellOfALatentThatActsNowhereAndOfLoadsThatAreShared) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0,3,0,5,0.1\n2,0,4,0,6,0\n3,0,5,0,6,-0.1\n", "log.csv");
  const auto told = [&](const std::string& constraints, const std::string& load) {
    const Model model = Model::parse(
        "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\nforce = ['0', '-9.81']\n[constraints]\n"
        "position = " +
            constraints +
            "\n[[latent]]\nname = 'mu'\nkernel = 'constant'\nfeatures = ['dx']\ndirections = { force = [['-dx*max(0, " + load +
            ")'], ['0']] }\n",
        "sled");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    std::string all;
    for (const std::string& note : make_fit_problem(model, log, options).notes) all += note + "\n";
    for (const Finding& finding : check(model, &log, {}))
      all += (finding.level == Finding::Level::good ? "ok " : "check: ") + finding.text + "\n";
    return all;
  };
  const std::string sound = told("['y']", "lambda0(1)");
  EXPECT_THAT(sound, Not(HasSubstr("acts at 0")));
  EXPECT_THAT(sound, Not(HasSubstr("follows from others")));
  const std::string idle = told("['y']", "-lambda0(1)");
  EXPECT_THAT(idle, HasSubstr("warning: latent 'mu' acts at 0 of 3 states: its direction is 0, and"));
  EXPECT_THAT(idle, HasSubstr("check: latent 'mu' acts at 0 of 3 states"));
  const std::string shared = told("['y', '2*y']", "lambda0(2)");
  EXPECT_THAT(shared, HasSubstr("warning: log.csv: lambda0(2): the constraint '2*y' follows from others"));
  EXPECT_THAT(shared, HasSubstr("check: lambda0(2): the constraint '2*y' follows from others"));
}

/// A sled whose friction is proportional to its load.
Model sled(const std::string& load) {
  return Model::parse(
      "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\nforce = ['0', '-9.81']\n[constraints]\n"
      "position = ['y']\n[[latent]]\nname = 'mu'\nkernel = 'constant'\nfeatures = ['x']\n"
      "directions = { force = [['-dx*abs(" +
          load + ")'], ['0']] }\n",
      "sled");
}

TEST(FitNotes, TellThatALoadIsReadWithoutTheForceThatCausesIt) {
  const auto notes = [](const std::string& load, Prior::Mean mean) {
    FitRequest request;
    request.model = sled(load);
    request.logs = {{CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0,3,0,-5,0\n2,0,4,0,-6,0\n3,0,5,0,-7,0\n", "log.csv"), nullptr}};
    request.problem.noise_stddev = 0.1;
    request.problem.mean = mean;
    return prepare_fit(std::move(request)).notes;
  };
  for (const std::string load : {"lambda", "lambda0"}) {
    const auto told = Contains(HasSubstr("mu reads constraint forces (" + load + "), but the known force of [mechanics], which"));
    EXPECT_THAT(notes(load + "(1)", Prior::Mean::zero), told);
    EXPECT_THAT(notes(load + "(1)", Prior::Mean::force), Not(told));
  }
}

// damping 0.3 dx, along a direction of either sign
TEST(FitNotes, TellThatAPositiveLatentIsPushedToZero) {
  const auto fit_along = [](const std::string& direction, const std::string& kernel, double steepness) {
    std::string log = "x,dx,ddx\n";
    for (int i = 0; i < 20; ++i) {
      const double x = 0.1 * i - 1, dx = std::sin(3.0 * i);
      log += fmt::format("{},{},{}\n", x, dx, -0.3 * (1 + std::tanh(steepness * x)) * dx);
    }
    const Model model = Model::parse(
        "coordinates = ['x']\n[mechanics]\nmass = [['1']]\n[[latent]]\nname = 'damping'\nfeatures = ['x']\n"
        "kernel = '" +
            kernel + "'\ndirections = { force = [['" + direction + "']] }\npositive = true\n",
        "cart");
    FitProblemOptions options;
    options.noise_stddev = 0.05;
    FitOptions nothing;
    nothing.max_iterations = 0;
    return fit(make_fit_problem(model, CsvTable::parse(log, "log.csv"), options), nothing).posterior;
  };
  FitReport report;
  report.iterations = 10;
  const auto told = Contains(
      "warning: the data push the positive latent 'damping' to 0: is the sign of its direction wrong, or does nothing act along "
      "it?");
  EXPECT_THAT(notes_of(report, fit_along("0.2*dx", "constant", 0)), told);
  EXPECT_THAT(notes_of(report, fit_along("-dx", "se", 8)), Not(told)) << "nearly 0 in half of its range";
  EXPECT_THAT(notes_of(report, fit_along("-100*dx", "se", 8)), Not(told)) << "small beside its direction";
}

TEST(FitNotes, SpeakOfALoadWhereALatentReadsOne) {
  const auto notes = [](const Model& model) {
    const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0,3,0,-5,0\n2,0,4,0,-6,0\n3,0,5,0,-7,0\n", "log.csv");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    options.mean = Prior::Mean::force;
    FitOptions nothing;
    nothing.max_iterations = 0;
    FitReport report;
    report.iterations = 10;
    report.termination = FitReport::unsettled;
    return notes_of(report, fit(make_fit_problem(model, log, options), nothing).posterior);
  };
  const auto told = Contains(HasSubstr("the fit has not converged: "));
  const auto of_load = Contains(HasSubstr("may determine only the product of a load and its coefficient"));
  EXPECT_THAT(notes(sled("lambda0(1)")), AllOf(told, of_load));
  EXPECT_THAT(notes(constrained_cart("")), AllOf(told, Not(of_load)));
}

TEST(FitNotes, TellThatThereIsNothingToProjectOnto) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n", "log.csv");
  for (const char* constraints : {"", "[constraints]\nacceleration = ['ddx - ddy']\n"}) {
    EXPECT_THAT(problem_of(constrained_cart(constraints), log).notes,
                Contains(HasSubstr("log.csv: nothing to project: 'cart' has no position or velocity constraints")));
  }
}

TEST(FitNotes, TellWhichStatesTheConstraintsDoNotKnow) {
  const Model model = constrained_cart("[constraints]\nposition = ['y - sqrt(x)']\n");
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,1,2,1,0,0\n-2,4,6,0,1,1\n", "log.csv");
  EXPECT_THAT(input_error_of([&] { problem_of(model, log); }),
              AllOf(StartsWith("`project`: log.csv: 1 of 2 states have no state on the constraints near them (line 3): "),
                    HasSubstr("the constraint \"y - sqrt(x)\" is not a number there")));
}

// whatever holds a body at rest, a function of its state does not
TEST(FitNotes, TellOfRowsThatDryFrictionHolds) {
  const auto model_of = [](const std::string& friction) {
    return Model::parse(
        "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\nforce = ['3', '0']\n[[latent]]\nkernel = "
        "'se'\nfeatures = ['y']\ndirections = [['" +
            friction + "'], ['0']]\n",
        "cart");
  };
  const auto notes_and_findings = [&](const Model& model, const std::string& rows) {
    const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n" + rows, "log.csv");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    std::vector<std::string> texts = make_fit_problem(model, log, options).notes;
    for (const Finding& one : check(model, &log)) texts.push_back(one.text);
    return texts;
  };
  const std::string at_rest = "3,3,0,0,0.01,0\n3,3,0,0,-0.02,0\n3,3,0,0,0.01,0\n";
  const auto told = [](const std::string& surface) {
    const std::string text = "3 of 5 rows are at rest where dry friction jumps, at " + surface + " = 0: the friction force there";
    return AllOf(Contains(StartsWith("warning: log.csv: " + text)), Contains(StartsWith(text)));
  };
  EXPECT_THAT(notes_and_findings(model_of("sign(dx)"), at_rest), told("dx"));
  EXPECT_THAT(notes_and_findings(model_of("dx/sqrt(dx^2 + dy^2)"), at_rest), told("dx, dy"));
  const Model dry = model_of("sign(dx)");
  const CsvTable test = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n" + at_rest, "test.csv");
  const View view = View::constrained_acceleration(*dry.system);
  EXPECT_THAT(read_log_states(make_prior(dry), view, dry, test, {}, {"ddx", "ddy"}).notes,
              Contains(StartsWith("warning: test.csv: 3 of 5 rows are at rest where dry friction jumps")));
  // neither where a motion turns, nor where friction does not jump
  const auto silent = testing::Not(Contains(HasSubstr("at rest")));
  EXPECT_THAT(notes_and_findings(model_of("sign(dx)"), "3,3,0,0,0.01,0\n3.5,3,0,0,-2,0\n3.25,3,0,1,-2,0\n"), silent);
  EXPECT_THAT(notes_and_findings(model_of("dx/sqrt(dx^2 + dy^2)"), "3,3,0,0,3,0\n3,3,0,0,-2,0\n4,3,0,0,0,0\n3,3,0,1,0,0\n"),
              silent);
  EXPECT_THAT(notes_and_findings(model_of("tanh(9*dx)"), at_rest), silent);
}

// a column that does not vary gives no scale for its noise
TEST(FitNotes, NoiseThatIsEstimatedStartsAtAScaleOfTheColumn) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,7,0\n", "log.csv");
  const FitProblem problem = problem_of(constrained_cart(""), log);
  std::vector<double> noise;
  for (const Hyperparameter& h : problem.hyperparameters) {
    if (h.kind == Hyperparameter::Kind::noise_stddev) noise.push_back(h.value);
  }
  ASSERT_EQ(noise.size(), 2U);
  EXPECT_GT(noise[0], 0.01);
  EXPECT_EQ(noise[1], 0.05);
}

TEST(FitNotes, AParameterThatFollowsFromOthersIsNotEstimated) {
  const Model model = Model::parse(
      "coordinates = ['x']\n[parameters]\nm = 2\nw = '2*m'\n[mechanics]\nmass = [['w']]\n[[latent]]\nfeatures = ['dx']\n",
      "cart");
  FitProblemOptions options;
  options.noise_stddev = 0.1;
  options.estimate = {"w"};
  const CsvTable log = CsvTable::parse("x,dx,ddx\n1,2,3\n2,3,4\n", "log.csv");
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, log, options); }),
            "`estimate`: the parameter 'w' of 'cart' follows from others: w = 2*m; estimate those, and it follows them");
  options.estimate = {"m", "m"};
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, log, options); }), "`estimate`: 'm' stands twice");
}

// what check finds well is not worth a word, and of parameters that are estimated the fit itself finds the value
TEST(FitNotes, TellOfStatesOffAConstraintThatIsKnown) {
  const auto notes_of_log = [](const std::string& parameter, const std::string& y,
                               const std::vector<std::string>& estimate = {}) {
    const Model model = Model::parse("coordinates = ['x', 'y']\n[parameters]\nh = " + parameter +
                                         "\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\n[constraints]\nposition = ['y - h*x']\n"
                                         "[[latent]]\nkernel = 'se'\nfeatures = ['dx']\ndirections = 'acceleration'\n",
                                     "ramp");
    FitProblemOptions options;
    options.noise_stddev = 0.1;
    if (!estimate.empty()) options.estimate = estimate;
    return make_fit_problem(model, CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,0.5,2,1,0,0\n3," + y + ",6,3,1,0.5\n", "log.csv"),
                            options)
        .notes;
  };
  const auto told = Contains(StartsWith("warning: log.csv: states are off the constraint: 'y - h*x' is 0.1 at data row 2"));
  const auto silent = testing::Not(Contains(HasSubstr("off the constraint")));
  EXPECT_THAT(notes_of_log("0.5", "1.6"), told);
  EXPECT_THAT(notes_of_log("0.5", "1.505"), silent);
  EXPECT_THAT(notes_of_log("{ value = 0.5, bounds = [0, 2], estimate = true }", "1.6"), silent);
  EXPECT_THAT(notes_of_log("0.5", "1.6", {"h"}), silent);
}

CrossValidation scores_of(double noise, double one_by_one, double stretches, double coverage95, int n) {
  CrossValidation scores;
  scores.nrmse_of_noise = noise;
  scores.one_by_one.nrmse = one_by_one;
  scores.one_by_one.n = n;
  scores.one_by_one.coverage95 = 0.95;
  scores.values = scores.one_by_one;
  scores.stretches = scores.one_by_one;
  scores.stretches->nrmse = stretches;
  scores.stretches->coverage95 = coverage95;
  return scores;
}

Prior prior_of_cart(const std::string& inputs, const std::string& directions) {
  const Model model = Model::parse("coordinates = ['x', 'y']\n" + inputs +
                                       "[mechanics]\nmass = [['2', '0'], ['0', '1']]\n[[latent]]\nfeatures = ['x', 'y']\n"
                                       "directions = '" +
                                       directions + "'\n",
                                   "cart");
  return make_prior(model);
}

std::vector<std::string> note_of(const CrossValidation& scores, const Prior& prior = prior_of_cart("inputs = ['u']\n", "force")) {
  std::vector<std::string> notes;
  add_stretch_note(scores, notes, prior);
  return notes;
}

std::vector<std::string> note_of_stretches(double one_by_one, double stretches, double coverage95, int n = 200) {
  return note_of(scores_of(0.01, one_by_one, stretches, coverage95, n));
}

TEST(FitNotes, TellWhereStretchesArePredictedWorseThanRows) {
  const auto told = ElementsAre(AllOf(StartsWith("stretches of the log"), HasSubstr("clipped, late or scaled")));
  EXPECT_THAT(note_of_stretches(0.011, 0.085, 0.925), told);
  EXPECT_THAT(note_of_stretches(0.011, 0.02, 0.8), told) << "too sure of itself";
  EXPECT_THAT(note_of_stretches(0.011, 0.02, 0.8, 50), testing::IsEmpty()) << "too few rows for a coverage";
  EXPECT_THAT(note_of_stretches(0.011, 0.02, 0.95), testing::IsEmpty());
  EXPECT_THAT(note_of(scores_of(0.03, 0.0313, 0.0842, 0.907, 150)), told) << "a mass that a general latent takes up";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0313, 0.0842, 0.951, 150)), testing::IsEmpty()) << "the bands hold";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0313, 0.0842, 0.907, 60)), testing::IsEmpty()) << "few rows";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0304, 0.0486, 0.927, 150)), testing::IsEmpty()) << "sound";
  EXPECT_THAT(note_of(scores_of(0.0068, 0.0058, 0.043, 0.995, 267)), testing::IsEmpty()) << "sound: the bands hold";
  EXPECT_THAT(note_of_stretches(0.08, 0.085, 0.95), testing::IsEmpty()) << "rows are no better";
}

// figures of simulated mechanisms with and without a fault
TEST(FitNotes, WarnWhereLeftOutRowsDenyTheModel) {
  const auto warned = ElementsAre(StartsWith("warning: stretches of the log that were left out are predicted worse"));
  EXPECT_THAT(note_of(scores_of(0.0147, 0.034, 0.196, 0.923, 151)), warned) << "a constraint is missing";
  EXPECT_THAT(note_of(scores_of(0.0147, 0.034, 0.196, 0.923, 60)), ElementsAre(StartsWith("stretches"))) << "few rows";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0542, 0.38, 0.84, 150)), warned) << "a constraint is missing, a general latent";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0542, 0.38, 0.84, 60)), ElementsAre(StartsWith("stretches"))) << "few rows";
  EXPECT_THAT(note_of(scores_of(0.03, 0.0542, 0.708, 0.84, 150)),
              ElementsAre(StartsWith("warning: the fit predicts unseen stretches of the log badly")))
      << "the same, more of it";
  EXPECT_THAT(note_of(scores_of(0.0132, 0.018, 0.276, 0.93, 121)), ElementsAre(StartsWith("stretches")))
      << "sound: one motion, whose ends are unlike its middle";
  EXPECT_THAT(note_of(scores_of(0.0147, 0.0221, 0.0509, 0.909, 151)), ElementsAre(StartsWith("stretches")))
      << "a potential for a force that dissipates";
  EXPECT_THAT(note_of(scores_of(0.0189, 0.024, 0.029, 0.871, 205)), ElementsAre(StartsWith("stretches"))) << "5 % of a mass";
  EXPECT_THAT(note_of(scores_of(0.0222, 0.186, 0.182, 0.92, 201)),
              ElementsAre(StartsWith("rows left out one by one are predicted far worse than the noise: nrmse 0.19")));
  EXPECT_THAT(note_of(scores_of(0.0045, 0.036, 0.036, 0.985, 101)), testing::IsEmpty()) << "sound: friction jumps";
  EXPECT_THAT(note_of(scores_of(0.0222, 0.604, 0.542, 0.928, 201)),
              ElementsAre(StartsWith("warning: the fit predicts unseen stretches of the log badly")));
  EXPECT_THAT(note_of(scores_of(0.01, 5000, 37000, 0.31, 201)),
              ElementsAre(AllOf(StartsWith("warning: the fit predicts unseen stretches"),
                                HasSubstr("badly, worse than their mean would"))));
  EXPECT_THAT(
      note_of(scores_of(0.01, 0.95, 0.97, 0.95, 40)),
      ElementsAre(StartsWith("warning: the fit predicts unseen stretches of the log badly, hardly better than their mean")));
  CrossValidation rows = scores_of(0.01, 1.2, 0, 0, 60);
  rows.stretches.reset();
  EXPECT_THAT(note_of(rows), ElementsAre(StartsWith("warning: the fit predicts rows left out one by one badly, worse than")));
  rows.residuals.emplace_back().n_far = 1;
  EXPECT_THAT(note_of(rows), testing::IsEmpty()) << "single values are told by themselves";
}

TEST(FitNotes, NameCausesThatTheModelCanHave) {
  const auto causes = [](const std::string& inputs, const std::string& directions) {
    return note_of(scores_of(0.01, 0.011, 0.2, 0.9, 100), prior_of_cart(inputs, directions)).at(0);
  };
  EXPECT_THAT(causes("", "force"),
              AllOf(Not(HasSubstr("input")), Not(HasSubstr("potential")), HasSubstr("a constraint that is")));
  EXPECT_THAT(causes("inputs = ['u']\n", "force"), HasSubstr("an input that is clipped"));
  EXPECT_THAT(causes("", "force"), HasSubstr("a clock that is not that of the samples"));
  EXPECT_THAT(causes("", "potential"), HasSubstr("a force that dissipates, which a potential does not"));
  Prior baseline = prior_of_cart("", "acceleration");
  baseline.reference = baseline.system;
  EXPECT_THAT(
      note_of(scores_of(0.01, 0.011, 0.2, 0.9, 100), baseline),
      ElementsAre(AllOf(HasSubstr("(something that acts and is not among the features, a clock"), Not(HasSubstr("mass")))));
}

TrainingResidual residual_of(int n, double rms, double coverage95) {
  TrainingResidual one;
  one.n = n;
  one.rms = rms;
  one.coverage95 = coverage95;
  return one;
}

TEST(FitNotes, CountACoverageThatIsTooLowByManyDeviations) {
  EXPECT_TRUE(residual_of(201, 1.66, 0.78).is_too_large());
  EXPECT_TRUE(residual_of(20, 2.6, 0.8).is_too_large());
  EXPECT_FALSE(residual_of(40, 1.8, 0.85).is_too_large()) << "hyperparameters of few rows are that sure of themselves";
  EXPECT_FALSE(residual_of(100, 1.3, 0.87).is_too_large());
  EXPECT_FALSE(residual_of(100000, 1.2, 0.92).is_too_large()) << "noise that is not quite normal";
}

TEST(FitNotes, TellWhereResidualsThatLastAreMoreThanNoise) {
  TrainingResidual one = residual_of(200, 1.1, 0.94);
  one.output = "ddy";
  one.serial_correlation = 0.75;
  one.n_serial = one.n;
  one.rms_in_noise = 1.2;
  EXPECT_THAT(correlated_text({one}), AllOf(HasSubstr("ddy (0.75)"), HasSubstr("an effect that lasts longer than a sample")));
  EXPECT_FALSE(last_beyond_noise({one}));
  EXPECT_EQ(correlated_text({one, one}), correlated_text({one})) << "of two short logs, which tell together";
  one.rms_in_noise = 3.9;
  EXPECT_THAT(correlated_text({one}), AllOf(HasSubstr("ddy (0.75)"), HasSubstr("3.9 times the noise: a mass, a length")));
  EXPECT_THAT(correlated_text({one}, /*is_of_baseline=*/true),
              HasSubstr("3.9 times the noise: something acts that is not among the features"));
  EXPECT_TRUE(last_beyond_noise({one}));
}

TEST(FitNotes, NameWhatMayBeBehindSingleValuesAndWhereTheyStand) {
  const CsvTable log = CsvTable::parse("x,y,dx,dy,ddx,ddy\n1,2,3,4,5,0\n2,3,4,5,6,0\n", "log.csv");
  FitOptions nothing;
  nothing.max_iterations = 0;
  const Posterior posterior = fit(problem_of(constrained_cart(""), log), nothing).posterior;
  TrainingResidual one = residual_of(200, 1.9, 0.9);
  one.output = "ddx";
  one.n_far = 5;
  one.farthest = 9.2;
  one.farthest_state = 1;
  const auto note_under = [&](double rms_in_noise, const std::vector<std::vector<int>>& lines) {
    one.rms_in_noise = rms_in_noise;
    std::vector<std::string> notes;
    add_residual_notes(posterior, {posterior.observations(), lines}, {one}, notes);
    return notes;
  };
  EXPECT_THAT(note_under(2, {{5, 9}}), ElementsAre(HasSubstr("up to 9.2 (ddx, in line 9): outliers of the log")));
  EXPECT_THAT(note_under(2, {}), ElementsAre(HasSubstr("up to 9.2 (ddx, in row 2): outliers")));
  EXPECT_THAT(note_under(12, {{5, 9}}), ElementsAre(HasSubstr("(ddx, in line 9): a mass, a length or a force that is wrong")));
}

TEST(FitNotes, NameGrossErrorsByTheirLines) {
  std::string log = "x,y,dx,dy,ddx,ddy\n";
  for (int k = 0; k < 40; ++k)
    log += k == 7 ? "1,2,3,4,-9999,0.5\n" : "1,2,3," + std::to_string(k) + ",5." + std::to_string(k) + ",0.5\n";
  const FitProblem problem = problem_of(constrained_cart(""), CsvTable::parse(log, "log.csv"));
  EXPECT_THAT(gross_errors_text(problem), AllOf(HasSubstr("ddx = -9999 in line 9."), HasSubstr("`robust`")));
}

}  // namespace
}  // namespace gp2
