// Data that deny the model are not believed without a word, and data that do not are.
#include <atomic>
#include <map>
#include <numeric>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "base/random.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/jobs/update_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "inference/problems.hpp"
#include "io_testing.hpp"
#include "jobs/data_of_model.hpp"
#include "jobs/late_cart.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::fit_request;
using testing::Contains;
using testing::HasSubstr;
using testing::Not;

using Data = test::LogData;

Data data_of(const std::string& file, std::uint64_t seed) { return test::drawn_log(file, 60, seed); }

std::vector<std::string> notes_of_fit(const Data& data, Prior::Mean mean = Prior::Mean::force) {
  FitRequest request = fit_request(*data.model, {data.table()});
  request.problem.mean = mean;
  request.max_iterations = 60;
  return run_fit(prepare_fit(std::move(request))).notes;
}

std::vector<std::string> findings_of(const Data& data, Finding::Level level) {
  const CsvTable log = data.table();
  std::vector<std::string> texts;
  for (const Finding& finding : check(*data.model, &log)) {
    if (finding.level == level) texts.push_back(finding.text);
  }
  return texts;
}

std::vector<std::string> notes_of(const std::vector<std::string>& notes, const std::string& about) {
  std::vector<std::string> out;
  std::copy_if(notes.begin(), notes.end(), std::back_inserter(out),
               [&](const std::string& note) { return note.find(about) != std::string::npos; });
  return out;
}

constexpr const char* of_fit = "values differ from their prediction by all others by more than noise";
constexpr const char* of_constraint = "measured ddq on A ddq = b: rms residual";

TEST(Residuals, OfSoundDataAreNoise) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml"}) {
    for (const std::uint64_t seed : {11U, 12U, 13U}) {
      SCOPED_TRACE(fmt::format("{}, seed {}", file, seed));
      const Data data = data_of(file, seed);
      EXPECT_THAT(findings_of(data, Finding::Level::good), Contains(HasSubstr(", expected 0.")));
      EXPECT_THAT(findings_of(data, Finding::Level::warning), Not(Contains(HasSubstr("measured ddq"))));
      EXPECT_THAT(findings_of(data, Finding::Level::error), testing::IsEmpty());
      const std::vector<std::string> notes = notes_of_fit(data);
      EXPECT_THAT(notes, Not(Contains(HasSubstr(of_fit))));
      EXPECT_THAT(notes, Not(Contains(HasSubstr(of_constraint))));
      EXPECT_THAT(notes, Not(Contains(HasSubstr("residuals are correlated from row to row"))));
    }
  }
}

TEST(Residuals, TellOfGravityLeftInASensor) {
  Data data = data_of("models/surface.toml", 14);
  data.accelerations.row(2).array() += 9.81;
  EXPECT_THAT(findings_of(data, Finding::Level::error), Contains(testing::AllOf(HasSubstr(of_constraint), HasSubstr("mean -9.8"),
                                                                                HasSubstr(" ×; "), HasSubstr("gravity"))));
  const std::vector<std::string> notes = notes_of_fit(data);
  EXPECT_THAT(notes, Contains(testing::AllOf(testing::StartsWith("warning: "), HasSubstr(of_constraint), HasSubstr("gravity"))));
  EXPECT_THAT(notes, Contains(testing::AllOf(HasSubstr(of_fit), HasSubstr("ddq3"))));
}

TEST(Residuals, OfATestLogAreTold) {
  FitRequest request;
  request.model = *data_of("models/surface.toml", 16).model;
  request.logs = {{data_of("models/surface.toml", 16).table()}};
  request.restarts = 1;
  request.max_iterations = 5;
  const FitOutcome fit = run_fit(prepare_fit(std::move(request)));
  Data data = data_of("models/surface.toml", 17);
  EXPECT_THAT(evaluate(fit.file, fit.posterior, data.table(), {}).notes, Not(Contains(HasSubstr(of_constraint))));
  data.accelerations.row(2).array() += 9.81;
  EXPECT_THAT(
      evaluate(fit.file, fit.posterior, data.table(), {}).notes,
      Contains(testing::AllOf(testing::StartsWith("warning: log.csv: "), HasSubstr(of_constraint), HasSubstr("gravity"))));
}

TEST(Residuals, TellOfAColumnInAnotherUnit) {
  Data data = data_of("models/unicycle.toml", 15);
  data.accelerations.row(0) *= 10;
  EXPECT_THAT(findings_of(data, Finding::Level::error), Contains(HasSubstr(of_constraint)));
  EXPECT_THAT(notes_of_fit(data), Contains(HasSubstr(of_constraint)));
}

TEST(Residuals, OfAConstraintNameTheLogAndTheLinesOfItsFile) {
  const Data sound = data_of("models/surface.toml", 16);
  Data wrong = data_of("models/surface.toml", 17);
  wrong.accelerations(2, 17) += 100;
  std::string text = wrong.table().text();
  text.insert(text.find('\n') + 1, "\n\n");  // lines that are no rows
  FitRequest request = fit_request(*sound.model, {sound.table(), CsvTable::parse(text, "wrong.csv")});
  request.max_iterations = 60;
  EXPECT_THAT(notes_of(run_fit(prepare_fit(std::move(request))).notes, of_constraint),
              testing::ElementsAre(testing::AllOf(testing::StartsWith("warning: log 2: measured ddq on A ddq = b"),
                                                  HasSubstr("of 60 rows (farthest off: line 21): outliers"))));
}

// a motion whose measured accelerations have errors that last
struct LastingErrors {
  static constexpr double noise = 0.1;
  Data data;
  MatrixXd truth;

  explicit LastingErrors(int n, double correlation)
      : data(test::moving_log("models/double_pendulum.toml", n, 0.005, 21)), truth(true_acceleration(*data.model, data.states)) {
    RandomStream random(21);
    VectorXd error = VectorXd::Zero(6);
    for (int i = -100; i < n; ++i) {
      for (double& one : error) one = correlation * one + std::sqrt(1 - correlation * correlation) * noise * random.normal();
      if (i >= 0) data.accelerations.col(i) = truth.col(i) + error;
    }
  }
  [[nodiscard]] FitRequest request(CsvTable table) const {
    FitRequest request = fit_request(*data.model, {std::move(table)});
    request.problem.noise_stddev = noise;
    request.problem.estimate = std::vector<std::string>();
    return request;
  }
  [[nodiscard]] FitOutcome fit(bool thin) const { return fit(data.table(), thin); }
  [[nodiscard]] FitOutcome fit(CsvTable table, bool thin) const {
    FitRequest of_table = request(std::move(table));
    of_table.thin = thin;
    return run_fit(prepare_fit(std::move(of_table)));
  }
  [[nodiscard]] double coverage(const FitOutcome& outcome) const {
    const Posterior::Marginal prediction =
        outcome.posterior.marginal(View::constrained_acceleration(*data.model->system), data.states);
    return ((prediction.mean - truth).array().abs() <= 1.96 * prediction.stddev().array() + 1e-9).cast<double>().mean();
  }
};

int n_rows(const FitOutcome& outcome) { return outcome.posterior.observations().front().n_data(); }

TEST(Residuals, ThatGoOnFromRowToRowAreFittedToAsManyRowsAsTheyAreWorth) {
  const LastingErrors log(300, 0.9);
  const FitOutcome all = log.fit(false), fewer = log.fit(true);
  EXPECT_EQ(n_rows(all), 300);
  EXPECT_THAT(all.notes, Contains(testing::AllOf(testing::StartsWith("warning: residuals are correlated from row to row"),
                                                 testing::EndsWith(": standard deviations are too small"))));
  EXPECT_LE(n_rows(fewer), 75);
  EXPECT_GE(n_rows(fewer), 40);
  EXPECT_THAT(fewer.notes, Contains(HasSubstr(fmt::format("fitted to {} of 300, evenly spaced", n_rows(fewer)))));
  // 300/40 rows apart they are still correlated by about 0.9^7
  EXPECT_THAT(fewer.notes, Contains(testing::AllOf(testing::StartsWith("warning: residuals are correlated from row to row"),
                                                   HasSubstr("their errors are probably still correlated by about 0."))));
  EXPECT_LT(log.coverage(all), 0.8);
  EXPECT_GT(log.coverage(fewer), 0.85);
  // the same fit again, from its own file
  const FitOutcome again = run_fit(prepare_fit_again(fewer.file));
  EXPECT_EQ(n_rows(again), n_rows(fewer));
  EXPECT_EQ(again.file.report.objective, fewer.file.report.objective);
}

TEST(Residuals, OfAFitThatStartsBeyondTheBoundsOfFewerRowsAreFittedToThoseToo) {
  const LastingErrors log(300, 0.9);
  FitRequest request = log.request(log.data.table());
  request.max_iterations = 30;
  request.hyperparameters = HyperparameterChoice::optimise;
  const std::vector<Hyperparameter> of_all = prepare_fit(request).problem.hyperparameters;
  const auto lengthscale =
      std::ranges::find_if(of_all, [](const Hyperparameter& h) { return h.name.starts_with("lengthscale"); });
  // fewer rows spread less or more, so that one of the bounds of all is beyond theirs
  for (const double bound : {lengthscale->lower, lengthscale->upper}) {
    FitRequest started = request;
    started.start.values[lengthscale->name] = bound;
    const FitOutcome fewer = run_fit(prepare_fit(std::move(started)));
    EXPECT_LT(n_rows(fewer), 300);
    EXPECT_THAT(fewer.notes, Not(Contains(HasSubstr("failed"))));
  }
}

TEST(Residuals, OfAllRowsStayWhereTheFitToFewerIsStopped) {
  const LastingErrors log(300, 0.9);
  FitRequest request = log.request(log.data.table());
  request.hyperparameters = HyperparameterChoice::optimise;
  std::atomic<bool> stop = false;
  double seconds = 0;
  const auto stop_second = [&](const Progress& one) {
    if (one.seconds < seconds) stop = true;
    seconds = one.seconds;
  };
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)), stop_second, &stop);
  EXPECT_TRUE(stop);
  EXPECT_EQ(n_rows(outcome), 300);
  EXPECT_EQ(outcome.file.report.termination, FitReport::interrupted);
  EXPECT_FALSE(outcome.file.report.converged);
}

TEST(Residuals, OfAShuffledLogAreTakenInTheOrderOfItsTime) {
  const LastingErrors log(300, 0.9);
  const FitOutcome ordered = log.fit(true), shuffled = log.fit(log.data.table().take(RandomStream(3).permutation(300)), true);
  EXPECT_EQ(n_rows(shuffled), n_rows(ordered));
  // but for t, which is not read
  const auto motion_of = [](const FitOutcome& outcome) -> MatrixXd {
    return outcome.posterior.observations().front().states().topRows(12);
  };
  EXPECT_EQ(motion_of(shuffled), motion_of(ordered));
}

// rows chosen at random stay in the order of the log, so that it shows that they share their errors
TEST(Residuals, OfRowsChosenAtRandomAreTakenInTheOrderOfTheLog) {
  const LastingErrors log(300, 0.95);
  FitRequest request = log.request(log.data.table());
  request.problem.max_points = 200;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_THAT(outcome.notes, Contains(HasSubstr("residuals are correlated from row to row")));
  EXPECT_TRUE(outcome.cross_validation->stretches.has_value());
}

// One motion in twelve files is worth as many rows as in one.
TEST(Residuals, OfManyShortLogsAreTakenTogether) {
  const LastingErrors lasting(300, 0.9);
  const CsvTable whole = lasting.data.table();
  FitRequest request = fit_request(*lasting.data.model, {});
  for (int first = 0; first < 300; first += 25) {
    std::vector<int> rows(25);
    std::iota(rows.begin(), rows.end(), first);
    request.logs.push_back({whole.take(rows), nullptr});
  }
  request.problem.noise_stddev = LastingErrors::noise;
  request.problem.estimate = std::vector<std::string>();
  request.thin = false;
  const FitOutcome all = run_fit(prepare_fit(request));
  EXPECT_EQ(all.posterior.n_states(), 300);
  EXPECT_THAT(all.notes, Contains(testing::AllOf(testing::StartsWith("warning: residuals are correlated from row to row"),
                                                 testing::EndsWith(": standard deviations are too small"))));
  request.thin = true;
  const FitOutcome fewer = run_fit(prepare_fit(std::move(request)));
  EXPECT_LE(fewer.posterior.n_states(), 100);
  EXPECT_GE(fewer.posterior.n_states(), 36);
  EXPECT_THAT(fewer.notes, Contains(HasSubstr(fmt::format("fitted to {} of 300, evenly spaced", fewer.posterior.n_states()))));
}

TEST(Residuals, ThatDenyAConstraintAreNotThinned) {
  LastingErrors log(300, 0.9);
  log.data.accelerations.row(2).array() += 9.81;
  const FitOutcome outcome = log.fit(true);
  EXPECT_EQ(n_rows(outcome), 300);
  EXPECT_THAT(outcome.notes, Contains(HasSubstr(of_constraint)));
  EXPECT_THAT(outcome.notes, Not(Contains(HasSubstr("evenly spaced"))));
}

// A sledge of 2 kg on a spring, which its model takes for one of `mass`. Its motion is known, and the force that makes it but for an
// `unlogged` one.
FitOutcome fit_of_sledge(double mass, double unlogged = 0) {
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["y"]
inputs = ["f"]
[mechanics]
mass  = [["{}"]]
force = ["f"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["y", "dy"]
directions = "force"
)toml",
                                               mass),
                                   "sledge.toml");
  std::string log = "t,y,dy,f,ddy\n";
  RandomStream random(54);
  for (int k = 0; k < 200; ++k) {
    const double t = 0.05 * k, y = std::sin(t) + 0.4 * std::sin(2.7 * t), dy = std::cos(t) + 1.08 * std::cos(2.7 * t);
    const double ddy = -std::sin(t) - 2.916 * std::sin(2.7 * t), f = 2 * ddy + 2 * dy + 3 * y - unlogged * std::sin(1.7 * t);
    log += fmt::format("{},{},{},{},{}\n", t, y, dy, f, ddy + 0.05 * random.normal());
  }
  return run_fit(prepare_fit(fit_request(model, {CsvTable::parse(log, "sledge.csv")})));
}

TEST(Residuals, TellOfAMassThatIsWrong) {
  EXPECT_THAT(notes_of(fit_of_sledge(2).notes, "left out"), testing::IsEmpty());
  EXPECT_THAT(notes_of(fit_of_sledge(2).notes, "warning: "), testing::IsEmpty());
  EXPECT_THAT(notes_of(fit_of_sledge(2.1).notes, "warning: "), Contains(HasSubstr(of_fit)));
  EXPECT_THAT(notes_of(fit_of_sledge(2.6).notes, "warning: "), Contains(HasSubstr("a mass, a length")));
}

TEST(Residuals, OfFewerRowsAreSaidOnce) {
  const FitOutcome outcome = fit_of_sledge(2, 0.2);
  EXPECT_LT(n_rows(outcome), 200);
  EXPECT_EQ(notes_of(outcome.notes, of_fit).size(), 1U);
}

TEST(Residuals, OfARowThatStandsAloneHaveNoScale) {
  Data data = test::drawn_log("models/surface.toml", 2, 53);
  data.states = data.states.leftCols(1).eval();
  data.accelerations = data.accelerations.leftCols(1).eval();
  FitRequest request;
  request.model = *data.model;
  request.logs = {{data.table()}};
  request.max_iterations = 0;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_THAT(outcome.cross_validation->text(), testing::StartsWith("left out row by row: 95 % coverage "));
}

TEST(Residuals, OfALongLogAreAskedOfAStretchFirst) {
  const LastingErrors lasting(1500, 0.9);
  const FitOutcome fewer = lasting.fit(true);  // all would take a matrix of 3000
  EXPECT_LE(n_rows(fewer), 375);
  EXPECT_GT(lasting.coverage(fewer), 0.85);
  const LastingErrors white(410, 0);
  EXPECT_EQ(n_rows(white.fit(true)), 410);
}

TEST(Residuals, WithoutANoiseAnOffsetOrNothingLeftOfTheCancellationIsFound) {
  ConstraintResidual one{"row", 50, 1.0, 0.0, std::numeric_limits<double>::quiet_NaN(), 5.0, {}};
  EXPECT_FALSE(one.is_too_large());
  one.mean = 0.95;
  EXPECT_TRUE(one.is_too_large());
  one.mean = 0;
  one.rms = 3;
  EXPECT_TRUE(one.is_too_large());
}

TEST(Residuals, TellOfAKnownForceThatIsNotUsed) {
  // the latent acts along the velocity, and gravity does not
  const Model thrown = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["dx", "dy"]
directions = { force = [["-dx"], ["-dy"]] }
[truth]
force = ["-0.3*dx", "-0.3*dy"]
[sampling]
dx = [-2, 2]
dy = [-2, 2]
)toml",
                                    "thrown.toml");
  Data data = test::drawn_log(thrown, 60, 16);
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero),
              Contains(HasSubstr("the known force of [mechanics] is not used: with `mean=force` the log likelihood")));
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::force), Not(Contains(HasSubstr("known force"))));
  // and these features know nothing of the inputs
  data = data_of("models/surface.toml", 16);
  std::string text = data.model->text;
  const std::size_t first = text.find("features   = ["), last = text.find(']', first);
  text.replace(first, last + 1 - first, R"(features = ["dq1", "dq2", "dq3"])");
  const Model narrow = Model::parse(text, "narrow.toml");
  data.model = &narrow;
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero).at(0),
              HasSubstr("warning: the known force of [mechanics] is not used, and no feature reads u1, u2, u3"));
}

// a puck on a bent sheet that is pushed and turned, with friction that a latent learns
struct Driven {
  static constexpr const char* toml = R"toml(
coordinates = ["x", "y", "z"]
inputs = ["u", "w"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["u - w*y", "w*x", "-9.81"]
[constraints]
position = ["z - 0.3*x - 0.1*x^2"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["dx", "dy", "dz"]
directions = { force = [["-dx"], ["-dy"], ["-dz"]] }
[truth]
force = ["-0.5*dx - 0.2*dx*abs(dx)", "-0.5*dy - 0.2*dy*abs(dy)", "-0.5*dz"]
[sampling]
x  = [-1, 1]
y  = [-1, 1]
z  = "0.3*x + 0.1*x^2"
dx = [-2, 2]
dy = [-2, 2]
dz = "0.3*dx + 0.2*x*dx"
u  = [-3, 3]
w  = [-3, 3]
)toml";
  Model model;

  // another force by `u`
  explicit Driven(const std::string& of_u = "u") : model(Model::parse(with_force(of_u), "driven.toml")) {}
  static std::string with_force(const std::string& of_u) {
    return test::changed(toml, {{"\"u - w*y\"", "\"" + of_u + " - w*y\""}});
  }

  [[nodiscard]] Data data(std::uint64_t seed) const { return test::drawn_log(model, 60, seed); }
  [[nodiscard]] Eigen::Index row_of(int input) const { return model.system->layout().u(input); }
};

// The force of the constraint beside accelerations of the same states, with a noise of 0.1.
struct WithForces {
  Driven driven;
  MatrixXd states;
  VectorXd ddz, lambda, noise = VectorXd(60);

  // friction along the track alone, which the latent can be
  WithForces() {
    driven.model =
        Model::parse(test::changed(driven.model.text, {{" - 0.2*dx*abs(dx)", ""}, {" - 0.2*dy*abs(dy)", ""}}), "driven.toml");
    GeneratedData drawn = generate(driven.model, GenerateOptions{60, 41, VectorXd::Zero(3)});
    RandomStream random(41, 1);
    for (double& one : noise) one = random.normal();
    ddz = drawn.accelerations.row(2).transpose();
    const VectorXd dz = drawn.states.row(driven.model.system->layout().dq(2)).transpose();
    lambda = ddz.array() + 9.81 + 0.5 * dz.array() + 0.1 * noise.array();
    states = std::move(drawn.states);
  }
  [[nodiscard]] FitOutcome fit(const VectorXd& forces, bool has_accelerations = true) const {
    FitRequest request = fit_request(driven.model, {});
    if (has_accelerations) request.logs = {{driven.data(41).table()}};
    request.problem.also_noise_stddev = 0.1;
    SideInformation measured;
    measured.quantity = View::Quantity::multipliers;
    std::vector<CsvTable::Column> columns;
    const std::vector<std::string> names = driven.model.system->state_names();
    for (std::size_t k = 0; k < names.size(); ++k) {
      const auto row = states.row(static_cast<Eigen::Index>(k));
      if (!row.hasNaN()) columns.push_back({names[k], {row.begin(), row.end()}});
    }
    columns.push_back({"lambda1", {forces.begin(), forces.end()}});
    measured.log.table = CsvTable::from_columns("forces.csv", std::move(columns));
    request.also = {measured};
    request.max_iterations = 60;
    return run_fit(prepare_fit(std::move(request)));
  }
};

TEST(Residuals, OfForcesAreJudgedAsThoseOfAccelerations) {
  const WithForces p;
  const auto of_forces = testing::AllOf(testing::StartsWith("warning: "), HasSubstr("lambda1"));
  const FitOutcome sound = p.fit(p.lambda);
  EXPECT_THAT(sound.notes, Not(Contains(HasSubstr("lambda1"))));
  EXPECT_THAT(sound.cross_validation->text(),
              testing::ContainsRegex("row by row: nrmse .*; multipliers: nrmse .*95 % coverage "));
  ASSERT_EQ(sound.cross_validation->other_views.size(), 1U);
  EXPECT_NEAR(sound.cross_validation->other_views.front().one_by_one.coverage95, 0.95, 0.06);
  VectorXd spikes = p.lambda;
  for (const int i : {7, 30, 51}) spikes[i] += 8;
  const std::map<std::string, VectorXd> faults = {{"sign", -p.lambda},
                                                  {"kN", 1e-3 * p.lambda},
                                                  {"20 times the noise", p.lambda + 1.9 * p.noise},
                                                  {"spikes", spikes},
                                                  {"shuffled", p.lambda.reverse()},
                                                  {"without m ddz", p.lambda - p.ddz},
                                                  {"offset", p.lambda.array() + 5}};
  for (const auto& [fault, forces] : faults) EXPECT_THAT(p.fit(forces).notes, Contains(of_forces)) << fault;
}

TEST(Residuals, OfForcesAloneHaveFigures) {
  const WithForces p;
  const FitOutcome outcome = p.fit(p.lambda, false);
  EXPECT_THAT(outcome.cross_validation->text(), testing::StartsWith("left out row by row: multipliers: nrmse "));
  EXPECT_THAT(outcome.cross_validation->text(), Not(HasSubstr("nan")));
  EXPECT_LT(outcome.cross_validation->one_by_one.nrmse, 0.5);
}

TEST(Residuals, TellOfAnInputThatActsOtherwiseThanLogged) {
  const Driven driven;
  constexpr const char* denied = "the data contradict the input";
  constexpr const char* little = "the fit predicts";
  for (const std::uint64_t seed : {31U, 32U}) {
    Data data = driven.data(seed);
    std::vector<std::string> notes = notes_of_fit(data);
    EXPECT_THAT(notes, Not(Contains(HasSubstr("input"))));
    EXPECT_THAT(notes, Not(Contains(HasSubstr(little))));
    // a sign, a unit, and both of them, each with its factor and without the input that is right
    data.states.row(driven.row_of(0)) *= -1;
    EXPECT_THAT(notes_of(notes_of_fit(data), denied),
                testing::ElementsAre(testing::AllOf(testing::StartsWith("warning: "), HasSubstr("input u: "),
                                                    testing::ContainsRegex("acts -(1|0.9)"))));
    data = driven.data(seed);
    data.states.row(driven.row_of(1)) *= 1000;
    EXPECT_THAT(notes_of(notes_of_fit(data), denied),
                testing::ElementsAre(testing::AllOf(HasSubstr("input w: "), testing::ContainsRegex("acts 0.00(1|09)"))));
    data.states.row(driven.row_of(0)) *= -1;
    notes = notes_of_fit(data);
    EXPECT_THAT(notes_of(notes, denied), testing::UnorderedElementsAre(HasSubstr("input u: "), HasSubstr("input w: ")));
    EXPECT_THAT(notes, Contains(HasSubstr(little)));
  }
}

TEST(Residuals, TellOfAFactorThatIsNearOne) {
  const Driven driven;
  for (const std::uint64_t seed : {31U, 32U}) {
    Data data = driven.data(seed);
    data.states.row(driven.row_of(0)) *= 1.3;
    EXPECT_THAT(notes_of(notes_of_fit(data), "the input "),
                testing::ElementsAre(testing::AllOf(HasSubstr("input u: "), testing::ContainsRegex("acts 0.7[5-9]"))));
  }
}

TEST(Residuals, BlameNoInputForAWrongSignOfGravity) {
  const Driven driven;
  Driven turned;
  turned.model = Model::parse(test::changed(driven.model.text, {{"-9.81", "9.81"}}), "driven.toml");
  for (const std::uint64_t seed : {31U, 32U}) {
    Data data = driven.data(seed);
    data.model = &turned.model;
    const std::vector<std::string> notes = notes_of_fit(data);
    EXPECT_THAT(notes, Not(Contains(HasSubstr("the input "))));
    EXPECT_THAT(notes_of(notes, "known force without inputs"),
                testing::ElementsAre(testing::ContainsRegex("acts -(1|0.9[5-9]?|1.0[0-9]?) ± [0-9.]+ times as modelled")));
  }
}

TEST(Residuals, TellOfAnInputThatActsByItsSquareOrItsLogarithm) {
  Driven driven("u*abs(u)");
  Data data = driven.data(36);
  EXPECT_THAT(notes_of_fit(data), Not(Contains(HasSubstr("the input "))));
  data.states.row(driven.row_of(0)) *= -1;
  EXPECT_THAT(notes_of(notes_of_fit(data), "the input "),
              testing::ElementsAre(testing::AllOf(HasSubstr("input u: "), testing::ContainsRegex("acts -(1|0.9)"))));
  // without it there is no force to compare with, and all else is said
  driven = Driven("log(4 + u)/u");
  data = driven.data(36);
  const std::vector<std::string> notes = notes_of_fit(data);
  EXPECT_THAT(notes, Not(Contains(HasSubstr("the input "))));
  EXPECT_THAT(notes, Not(Contains(HasSubstr("were not tested"))));
  data.states.row(driven.row_of(1)) *= -1;
  EXPECT_THAT(notes_of(notes_of_fit(data), "the input "), testing::ElementsAre(HasSubstr("input w: ")));
}

TEST(Residuals, AskInputsThatMakeALoad) {
  for (const std::uint64_t seed : {21U, 22U}) {
    Data data = test::drawn_log("experiments/mechanisms/rubbing_bead.toml", 80, seed);
    EXPECT_THAT(notes_of(notes_of_fit(data), "input push"), testing::IsEmpty());
    data.states.row(data.model->system->layout().u(0)) *= 0.4;
    EXPECT_THAT(
        notes_of(notes_of_fit(data), "input push"),
        testing::ElementsAre(testing::AllOf(HasSubstr("the data contradict"), testing::ContainsRegex("acts (1.[89]|2.[0-9]) "))));
  }
}

TEST(Residuals, AnEstimatedNoiseDoesNotHideAUnit) {
  const Driven driven;
  const auto notes_with = [&](const Data& data) {
    FitRequest request = fit_request(driven.model, {data.table()});
    request.problem.estimate_noise = true;
    return notes_of(run_fit(prepare_fit(std::move(request))).notes, of_constraint);
  };
  Data data = driven.data(51);
  EXPECT_THAT(notes_with(data), testing::IsEmpty());
  data.accelerations.row(2) *= 57.3;
  EXPECT_THAT(notes_with(data), testing::ElementsAre(testing::StartsWith("warning: ")));
}

TEST(Residuals, OfARobustFitLeaveOutWhatItDistrusts) {
  Data data = test::drawn_log("models/surface.toml", 60, 52);
  for (const Eigen::Index row : {5, 31}) data.accelerations(0, row) = -9999;
  FitRequest request = fit_request(*data.model, {data.table()});
  request.problem.robust = true;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_GE(outcome.file.report.distrusted.size(), 2U);
  EXPECT_LT(outcome.cross_validation->one_by_one.nrmse, 0.3);
  EXPECT_EQ(cross_validate(outcome.file, outcome.posterior).one_by_one.nrmse, outcome.cross_validation->one_by_one.nrmse);
  const test::TemporaryFolder folder;
  const std::filesystem::path path = folder / "robust_fit.json";
  outcome.file.write(path);
  const FitFile read = FitFile::read(path);
  EXPECT_EQ(read.report.distrusted.size(), outcome.file.report.distrusted.size());
  EXPECT_NEAR(cross_validate(read, read.posterior()).one_by_one.nrmse, outcome.cross_validation->one_by_one.nrmse, 1e-9);
  EXPECT_THAT(outcome.notes, Not(Contains(HasSubstr(of_constraint))));
}

TEST(Residuals, TellOfNoiseThatIsStatedTooLarge) {
  const Driven driven;
  const Data data = driven.data(46);
  const auto notes_under = [&](double noise, Protocol::Name protocol = Protocol::Name::standard) {
    FitRequest request = fit_request(driven.model, {data.table()});
    request.problem.noise_stddev = noise;
    request.problem.protocol.name = protocol;
    return notes_of(run_fit(prepare_fit(std::move(request))).notes, "than the stated noise");
  };
  EXPECT_THAT(notes_under(0.05), testing::IsEmpty());
  EXPECT_THAT(notes_under(0.05 * 0.2), testing::IsEmpty());
  EXPECT_THAT(notes_under(0.05 * 5),
              testing::ElementsAre(testing::AllOf(testing::ContainsRegex("ddx \\(0.[1-4][0-9]* of the noise\\), ddy"),
                                                  testing::EndsWith("; `noise_std=estimate` finds it"))));
  EXPECT_THAT(notes_under(0.05 * 5, Protocol::Name::paper), testing::ElementsAre(testing::EndsWith("as smoothed ones do")));
}

TEST(Residuals, TellOfAnInputThatIsWrongInOneOfSeveralLogs) {
  const Driven driven;
  const std::vector<Data> sound = {driven.data(41), driven.data(42), driven.data(43)};
  const auto notes_with = [&](const Data& second) {
    const FitRequest request = fit_request(driven.model, {sound[0].table(), second.table(), sound[2].table()});
    return notes_of(run_fit(prepare_fit(request)).notes, "warning: ");
  };
  EXPECT_THAT(notes_with(sound[1]), testing::IsEmpty());
  Data turned = sound[1];
  turned.states.row(driven.row_of(0)) *= -1;
  EXPECT_THAT(notes_of(notes_with(turned), "likelihood"),
              testing::ElementsAre(testing::AllOf(HasSubstr("input u of log 2: "), testing::ContainsRegex("acts -(1|0.9)"))));
  Data lost = sound[1];
  lost.states.row(driven.row_of(0)).setZero();
  EXPECT_THAT(notes_of(notes_with(lost), "likelihood"),
              testing::ElementsAre(testing::AllOf(HasSubstr("log 2 contradicts the others"),
                                                  HasSubstr("Its input u is 0 in every row: was it logged?"))));
  Data heavier = sound[1];  // by a half
  heavier.accelerations /= 1.5;
  EXPECT_THAT(notes_of(notes_with(heavier), "likelihood"), Contains(HasSubstr("log 2 contradicts the others")));
  // nobody turned the motor on
  Driven idle;
  idle.model = Model::parse(test::changed(driven.model.text, {{"u  = [-3, 3]", "u  = \"0\""}}), "driven.toml");
  EXPECT_THAT(notes_with(idle.data(42)), testing::IsEmpty());
}

TEST(Residuals, TellOfSingleValuesThatAreFarOff) {
  for (const std::uint64_t seed : {48U, 49U}) {
    Data data = test::drawn_log("models/surface.toml", 150, seed);
    EXPECT_THAT(notes_of_fit(data), Not(Contains(HasSubstr("of the values lie"))));
    data.accelerations(1, 17) += 20 * 0.1;
    EXPECT_THAT(notes_of(notes_of_fit(data), "of the values lie"),
                testing::ElementsAre(
                    testing::AllOf(testing::StartsWith("warning: "), HasSubstr("(ddq2, in line 19): outliers of the log"))));
  }
}

TEST(Residuals, TellOfAnInputThatActsLate) {
  const auto fit_to = [](CsvTable log) {
    FitRequest request = fit_request(test::late_cart("'u'"), {std::move(log)});
    request.thin = false;
    return request;
  };
  const auto notes_of_fit_to = [](FitRequest request) {
    return notes_of(run_fit(prepare_fit(std::move(request))).notes, "the input ");
  };
  const auto log_of = [](double delay, double lag) { return test::late_cart_log(delay, lag, 100, 2, 47); };
  const auto notes_of_delay = [&](double delay, double lag) { return notes_of_fit_to(fit_to(log_of(delay, lag))); };
  EXPECT_THAT(notes_of_delay(0, 0), testing::IsEmpty());
  EXPECT_THAT(notes_of_delay(0.001, 0), testing::IsEmpty()) << "a tenth of a row";
  EXPECT_THAT(notes_of_delay(0.03, 0), testing::ElementsAre(HasSubstr("it acts 3 rows later than logged")));
  EXPECT_THAT(notes_of_delay(0.04, 0), testing::ElementsAre(HasSubstr("it acts 4 rows later than logged")));
  EXPECT_THAT(notes_of_delay(0.02, 0.02), testing::ElementsAre(HasSubstr("later than logged")));
  EXPECT_THAT(notes_of_delay(0.2, 0), Not(Contains(HasSubstr(" than logged")))) << "20 rows, and 16 are tried";
  FitRequest shuffled = fit_to(log_of(0.04, 0));
  shuffled.problem.max_points = 150;
  EXPECT_THAT(notes_of_fit_to(std::move(shuffled)), Not(Contains(HasSubstr("later than logged")))) << "rows in no order";
  FitRequest thinned = fit_to(test::late_cart_log(0.04, 0, 200, 2, 47));
  thinned.thin = true;  // to every third row
  EXPECT_THAT(notes_of_fit_to(std::move(thinned)),
              testing::ElementsAre(AnyOf(HasSubstr("it acts about 6 rows later than logged"),
                                         HasSubstr("it acts about 9 rows later than logged"))))
      << "8 rows of the log";
}

// Beside what holds a weight, what moves is a small share of an input.
TEST(Residuals, TellOfADelayOfAnInputThatHoldsAWeight) {
  const auto notes_of_delay = [](double delay) {
    const CsvTable log = test::late_cart_log(delay, 0, 100, 1, 47);
    std::vector<CsvTable::Column> columns;
    for (const std::string& name : log.header()) {
      const double held = name == "u" ? 30 : 0;
      std::vector<double> values;
      for (int row = 0; row < log.n_rows(); ++row) values.push_back(held + log.number(row, log.find(name)));
      columns.push_back({name, std::move(values)});
    }
    const Model lift = Model::parse(test::changed(test::late_cart("'u'").text, {{"[\"u\"]", "[\"u - 30\"]"}}), "lift.toml");
    FitRequest request = fit_request(lift, {CsvTable::from_columns("lift", std::move(columns))});
    request.thin = false;
    return notes_of(run_fit(prepare_fit(std::move(request))).notes, "the input ");
  };
  EXPECT_THAT(notes_of_delay(0), testing::IsEmpty());
  EXPECT_THAT(notes_of_delay(0.01), testing::ElementsAre(HasSubstr("it acts 1 row later than logged")));
}

TEST(Residuals, TellOfInputsThatAreSwapped) {
  const Driven driven("2*u");
  for (const std::uint64_t seed : {31U, 32U}) {
    Data data = driven.data(seed);
    data.states.row(driven.row_of(0)).swap(data.states.row(driven.row_of(1)));
    EXPECT_THAT(notes_of(notes_of_fit(data), "the input "), testing::ElementsAre(HasSubstr("are exchanged, by ")));
  }
}

// A delay mends some of the misfit of nearly any wrong model.
TEST(Residuals, BlameNoDelayForAWrongModel) {
  const std::string smooth = "kernel = \"se + linear\"\n";
  const auto two_masses = [](const char* force_of_spring, const std::string& kernel) {
    return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y"]
inputs = ["u"]
[mechanics]
mass = [["1.5", "0"], ["0", "0.7"]]
force = ["u", "0"]
[[latent]]
name = "spring"
{0}features = ["x - y"]
directions = {{ force = [["1"], ["{1}"]] }}
[[latent]]
name = "drag"
{0}features = ["dy"]
directions = {{ force = [["0"], ["1"]] }}
[noise]
ddq = 0.1
[truth]
force = ["-60*(x - y) - 0.5*dx", "60*(x - y) - 0.4*dy"]
)toml",
                                    kernel, force_of_spring),
                        "two_masses.toml");
  };
  SimulateRequest motion;
  motion.times = Eigen::VectorXd::LinSpaced(201, 0, 10);
  motion.start = std::map<std::string, double>{{"x", 0}, {"y", 0.1}, {"dx", 0}, {"dy", 0}};
  const Eigen::VectorXd u = 9 * (5.2 * motion.times.array() + 1).sin() + 6 * (11.3 * motion.times.array()).sin();
  const auto column = [](const auto& row) { return std::vector<double>(row.begin(), row.end()); };
  motion.inputs = CsvTable::from_columns("commands", {{"t", column(motion.times)}, {"u", column(u)}});
  const Model right = two_masses("-1", smooth), wrong = two_masses("1", smooth);
  const Trajectory run = run_simulation(prepare_simulation(right, motion)).front();
  RandomStream random(61);
  Eigen::MatrixXd ddq = run.accelerations;
  for (double& one : ddq.reshaped()) one += 0.1 * random.normal();
  const CsvTable log = CsvTable::from_columns("log", {{"t", column(motion.times)},
                                                      {"x", column(run.states.row(0))},
                                                      {"y", column(run.states.row(1))},
                                                      {"dx", column(run.states.row(2))},
                                                      {"dy", column(run.states.row(3))},
                                                      {"ddx", column(ddq.row(0))},
                                                      {"ddy", column(ddq.row(1))},
                                                      {"u", column(u)}});
  const auto notes_under = [&](const Model& model, const char* about = "the input u") {
    return notes_of(run_fit(prepare_fit(fit_request(model, {log}))).notes, about);
  };
  EXPECT_THAT(notes_under(right), testing::IsEmpty());
  EXPECT_THAT(notes_under(wrong), testing::ElementsAre(HasSubstr("the model does not explain what the input u does")));
  // a rough kernel follows single rows, and is denied by stretches
  EXPECT_THAT(notes_under(two_masses("1", ""), ""),
              testing::AllOf(Contains(HasSubstr("warning: the fit predicts unseen stretches")),
                             Not(Contains(HasSubstr("later than logged")))));
}

TEST(Residuals, NameSingleValuesOfAnInput) {
  const Driven driven;
  Data data = driven.data(38);
  data.states(driven.row_of(0), 17) = 1e6;
  EXPECT_THAT(notes_of(notes_of_fit(data), "the input "),
              testing::ElementsAre(testing::AllOf(testing::StartsWith("warning: single values of the input u lie far"),
                                                  HasSubstr(": 1e+06 at line 19. Correct them"))));
}

TEST(Residuals, TellOfRowsThatStandInTwoLogs) {
  const Driven driven;
  const Data data = driven.data(44), other = driven.data(45);
  const auto notes_with = [&](const Data& second) {
    FitRequest request;
    request.model = driven.model;
    request.logs = {{data.table()}, {second.table()}};
    request.max_iterations = 0;
    return notes_of(prepare_fit(std::move(request)).notes, "are also in another log");
  };
  EXPECT_THAT(notes_with(other), testing::IsEmpty());
  // the second half from its end, as a log of its own
  Data half = data;
  half.states = data.states.rightCols(30).rowwise().reverse();
  half.accelerations = data.accelerations.rightCols(30).rowwise().reverse();
  EXPECT_THAT(notes_with(half), testing::ElementsAre(testing::StartsWith("warning: 30 of 90 rows are also in another log")));
  FitRequest request;
  request.model = driven.model;
  request.logs = {{data.table()}};
  request.max_iterations = 0;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_THAT(update(outcome.file, {half.table()}, {}).notes,
              Contains(testing::StartsWith("warning: 30 of 30 rows are also in another log")));
  EXPECT_THAT(update(outcome.file, {other.table()}, {}).notes, Not(Contains(HasSubstr("are also in another log"))));
}

TEST(Residuals, TellOfAnInputBesideViewsThatHaveNoMean) {
  const Driven driven;
  Data data = driven.data(37);
  data.states.row(driven.row_of(0)) *= -1;
  FitRequest request = fit_request(driven.model, {data.table()});
  request.problem.also_noise_stddev = 0.05;
  SideInformation known;
  known.quantity = View::Quantity::learned_force;
  known.log.table = CsvTable::parse(
      "x,y,z,dx,dy,dz,u,w,force_x,force_y,force_z\n0,0,0,0,0,0,1,1,0,0,0\n0.5,0,0.175,0,0,0,-2,1,0,0,0\n", "rest.csv");
  request.also = {known};
  EXPECT_THAT(notes_of(run_fit(prepare_fit(std::move(request))).notes, "the input "),
              testing::ElementsAre(testing::AllOf(HasSubstr("input u: "), testing::ContainsRegex("acts -(1|0.9)"))));
}

TEST(Residuals, TellOfAnInputThatNeverMoves) {
  const Driven driven;
  Data data = driven.data(33);
  data.states.row(driven.row_of(1)).setZero();
  const std::vector<std::string> notes = notes_of_fit(data);
  EXPECT_THAT(notes_of(notes, "the input w"), testing::ElementsAre("the input w is 0 in every row: was it logged?"));
  EXPECT_THAT(notes, Contains(HasSubstr("the fit predicts")));
}

TEST(Residuals, OfAForceAcrossAConstraintThereAreNone) {
  // each coordinate has a force of its own; the sheet is nearly level, so that the vertical one moves nothing
  Driven driven;
  std::string text = driven.model.text;
  const std::size_t first = text.find("directions = {"), last = text.find('}', first);
  text.replace(first, last + 1 - first, R"(directions = "force")");
  driven.model = Model::parse(text, "driven.toml");
  const Data data = driven.data(35);
  const FitOutcome outcome = run_fit(prepare_fit(fit_request(driven.model, {data.table()})));
  PredictRequest request;
  request.covariance = PredictRequest::Covariance::stddev;
  EXPECT_THAT(predict(outcome.file, data.table(), request).notes, Not(Contains(HasSubstr("the data hardly determine"))));
  request.view.quantity = View::Quantity::learned_force;
  EXPECT_THAT(predict(outcome.file, data.table(), request).notes,
              Contains(testing::AllOf(HasSubstr("the data hardly determine force_z ("), Not(HasSubstr("force_y")))));
  request.unconditioned = true;
  EXPECT_THAT(predict(outcome.file, data.table(), request).notes, Not(Contains(HasSubstr("the data hardly determine"))));
}

TEST(Residuals, OfPureNoiseAreNotHeldAgainstTheModel) {
  // noise that hides all the motion and is stated as such: nothing can be predicted, and nothing is wrong
  Driven driven;
  Data data = driven.data(34);
  RandomStream random(34, 1);
  for (double& one : data.accelerations.reshaped()) one += 50 * random.normal();
  FitRequest request = fit_request(driven.model, {data.table()});
  request.problem.noise_stddev = 50;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_GT(outcome.cross_validation->stretches->nrmse, 0.8);
  EXPECT_FALSE(outcome.cross_validation->predicts_little());
  EXPECT_THAT(outcome.notes, Not(Contains(HasSubstr("input"))));
}

// a car whose axle is behind its centre of mass, driven such that it does not turn faster; its inertia is that of a coin
TEST(Residuals, TellOfAConstraintThatSpinsWhatIsLight) {
  const auto car = [](const char* inertia) {
    return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y", "h"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "{}"]]
force = ["0", "0", "0"]
[constraints]
velocity = ["dx*sin(h) - dy*cos(h) + 0.1*dh"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["dx", "dy", "h", "dh"]
directions = "acceleration"
[truth]
acceleration = ["0", "0", "0"]
[sampling]
v  = [1, 2]
h  = [0, 6]
dh = [-1, 1]
dx = "v*cos(h) - 0.1*dh*sin(h)"
dy = "v*sin(h) + 0.1*dh*cos(h)"
)toml",
                                    inertia),
                        "car.toml");
  };
  for (const bool is_light : {true, false}) {
    const Model model = car(is_light ? "1e-4" : "10");
    Data data = test::drawn_log(model, 60, 16);
    RandomStream random(16, 1);
    for (Eigen::Index i = 0; i < data.states.cols(); ++i) {
      const double h = data.states(2, i), along = data.states(3, i) * std::cos(h) + data.states(4, i) * std::sin(h);
      data.accelerations.col(i) = -data.states(5, i) * along * Eigen::Vector3d(std::sin(h), -std::cos(h), 0);
      for (int k = 0; k < 3; ++k) data.accelerations(k, i) += 0.05 * random.normal();
    }
    const testing::Matcher<std::vector<std::string>> is_told =
        Contains(HasSubstr("the constraint alone causes far more than was measured: ddh"));
    EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero), is_light ? is_told : Not(is_told));
    EXPECT_THAT(notes_of_fit(data, Prior::Mean::force), Not(is_told));
  }
}

}  // namespace
}  // namespace gp2
