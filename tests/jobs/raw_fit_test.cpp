#include "gp2/jobs/raw_fit.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "smoothing/simulated_logs.hpp"
#include "test_models.hpp"

namespace gp2::test {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::ElementsAre;
using testing::HasSubstr;

const Model& pendulum() {
  static const Model file = model("models/double_pendulum.toml");
  return file;
}

/// Two motions whose encoders are coarse.
const SimulatedLog& noisy_log() {
  static const SimulatedLog log = simulated_log(pendulum(), {{2.4, 2.0, 0, 0}, {3.6, 2.9, 1, -1}}, 2, {2e-3, 1e-5, 0, 0}, 1);
  return log;
}

/// What truly accelerates the pendulum, at the rows of a derive.
LearnedAccelerations true_accelerations(const DerivedData& data, double stddev = 0) {
  MatrixXd out(pendulum().system->nq(), data.states.cols());
  for (Index i = 0; i < out.cols(); ++i) {
    const Trajectory& truth = noisy_log().episodes[static_cast<std::size_t>(data.episode[static_cast<std::size_t>(i)])];
    out.col(i) = truth.accelerations.col(i % truth.times.size());
  }
  return {out, MatrixXd::Constant(out.rows(), out.cols(), stddev)};
}

FitRequest request() {
  FitRequest out;
  out.model = pendulum();
  out.problem.mean = Prior::Mean::force;
  out.problem.max_points = 50;
  out.restarts = 1;
  out.max_escapes = 0;
  return out;
}

TEST(LearnedMotion, WhoKnowsTheAccelerationsSmoothsBetter) {
  const DerivedData plain = derive(pendulum(), noisy_log().table);
  const DerivedData learned = derive(pendulum(), noisy_log().table, {}, true_accelerations(plain));
  const Score before = score_of(plain, noisy_log(), *pendulum().system, 0);
  const Score after = score_of(learned, noisy_log(), *pendulum().system, 0);
  for (int d = 0; d < 3; ++d) EXPECT_LT(after.rms[d], before.rms[d] / 2) << d;
  EXPECT_LT(after.rms[2], before.rms[2] / 10);
  for (const DerivedSeries& one : learned.series) EXPECT_GT(one.gain, 10);
  // deviations are no promise of that
  EXPECT_EQ(learned.stddev.bottomRows(6).array().isNaN().count(), plain.stddev.bottomRows(6).array().isNaN().count());
  EXPECT_TRUE((learned.stddev.array() == plain.stddev.array() || plain.stddev.array().isNaN()).all());
}

TEST(LearnedMotion, VelocityAndAccelerationAreTheDerivativesOfItsPosition) {
  const DerivedData plain = derive(pendulum(), noisy_log().table);
  const DerivedData learned = derive(pendulum(), noisy_log().table, {}, true_accelerations(plain));
  constexpr double step = 1 / 500.0;
  const StateLayout layout = pendulum().system->layout();
  for (const int j : {2, 5}) {
    const VectorXd q = learned.states.row(layout.q(j)), dq = learned.states.row(layout.dq(j)), ddq = learned.accelerations.row(j);
    const double fastest = ddq.cwiseAbs().maxCoeff();
    for (Index i = 1; i < 900; ++i) {
      // central differences are off by h²/6 of the next derivative, which is below 100 times the largest of this one
      EXPECT_NEAR((q[i + 1] - q[i - 1]) / (2 * step), dq[i], step * step / 6 * 100 * fastest) << i;
      EXPECT_NEAR((dq[i + 1] - dq[i - 1]) / (2 * step), ddq[i], step * step / 6 * 1e4 * fastest) << i;
    }
  }
}

TEST(LearnedMotion, WhatDoesNotExplainTheSamplesIsNotTaken) {
  const DerivedData plain = derive(pendulum(), noisy_log().table);
  RandomStream random(1);
  LearnedAccelerations wild = true_accelerations(plain);
  for (double& one : wild.mean.reshaped()) one = 1000 * random.normal();
  const DerivedData learned = derive(pendulum(), noisy_log().table, {}, wild);
  for (const DerivedSeries& one : learned.series) EXPECT_EQ(one.gain, 0);
  EXPECT_EQ(learned.accelerations, plain.accelerations);
}

TEST(LearnedMotion, WhatIsPredictedWithoutKnowledgeChangesNothing) {
  const DerivedData plain = derive(pendulum(), noisy_log().table);
  const DerivedData learned = derive(pendulum(), noisy_log().table, {}, true_accelerations(plain, 1e9));
  // p is q̂, and what samples are off it is noise
  const double spread = std::sqrt(plain.accelerations.row(5).squaredNorm() / static_cast<double>(plain.accelerations.cols()));
  EXPECT_LT(largest(learned.accelerations - plain.accelerations), 0.02 * spread);
}

TEST(LearnedMotion, IsOfTheSamples) {
  const DerivedData plain = derive(pendulum(), noisy_log().table);
  EXPECT_THAT(input_error_of([&] { derive(pendulum(), noisy_log().table, {.every = 2}, true_accelerations(plain)); }),
              HasSubstr("leave out `rate` and `every`"));
}

TEST(LearnAndSmooth, LearnsMoreThanFromOneSmoothing) {
  const auto error_of = [](const LearnedLog& log) {
    FitRequest asked = request();
    asked.hyperparameters = HyperparameterChoice::optimise;
    const Posterior posterior = run_fit(prepare_fit(log.request(std::move(asked), "log"))).posterior;
    double error = 0;
    for (const Trajectory& truth : noisy_log().episodes) {
      const MatrixXd mean = posterior.mean(View::constrained_acceleration(*pendulum().system), truth.states);
      for (const int j : {2, 5}) error += (mean.row(j) - truth.accelerations.row(j)).squaredNorm();
    }
    return std::sqrt(error);
  };
  const LearnedLog once = learn_and_smooth(request(), noisy_log().table, {.most_passes = 0, .windows = false});
  const LearnedLog turns = learn_and_smooth(request(), noisy_log().table, {.windows = false});
  EXPECT_THAT(once.rows, testing::SizeIs(50));
  EXPECT_EQ(once.data.accelerations, derive(pendulum(), noisy_log().table, {.hold_constraints = true}).accelerations);
  EXPECT_TRUE(once.gains.empty());
  ASSERT_FALSE(turns.gains.empty());
  EXPECT_TRUE(std::is_sorted(turns.gains.begin(), turns.gains.end()));
  EXPECT_THAT(turns.notes, ElementsAre(HasSubstr("times with the learned dynamics")));
  EXPECT_LT(error_of(turns), 0.9 * error_of(once));
  const Score before = score_of(once.data, noisy_log(), *pendulum().system, 0);
  EXPECT_LT(score_of(turns.data, noisy_log(), *pendulum().system, 0).rms[2], 0.5 * before.rms[2]);
}

TEST(LearnAndSmooth, TakesRowsWhereFewStatesAreAskedFor) {
  EXPECT_EQ(learn_and_smooth(request(), noisy_log().table, {.most_passes = 0}).windows, nullptr);
}

TEST(LearnedLog, WindowsAreOfAllPositionsWhateverConstraintsHoldAmongThem) {
  LearnedLog log{derive(pendulum(), noisy_log().table), {0, 1, 2, 3}, {}, {}, {}};
  log.data.independent = {2};  // as where one constraint holds among q3 and q6, which both are measured
  const auto says_noise = [&](const char* name) { return log.request(request(), "log").logs.front().table.find(name) >= 0; };
  EXPECT_TRUE(says_noise("ddq3_std"));
  EXPECT_FALSE(says_noise("ddq6_std"));
  log.windows = std::make_shared<const Windows>();
  EXPECT_TRUE(says_noise("ddq3_std"));
  EXPECT_TRUE(says_noise("ddq6_std"));
}

// rows on which a constraint holds depend on each other, but windows are of each position by itself
TEST(LearnAndSmooth, WindowsOfAllCoordinatesAreNotSaidToDepend) {
  FitRequest asked;
  asked.model = Model::parse(R"(
coordinates = ["x", "z"]
[mechanics]
mass = [[1, 0], [0, 1]]
[constraints]
position = ["z - x^2/2"]
[[latent]]
features = ["x", "dx"]
)",
                             "bead");
  asked.restarts = 1;
  asked.max_escapes = asked.max_iterations = 0;
  asked.problem.max_points = 200;
  RandomStream random(1);
  std::vector<CsvTable::Column> columns = {{"t", {}}, {"x", {}}, {"z", {}}};
  for (int i = 0; i < 1000; ++i) {
    const double t = i / 250.0, x = 0.4 * std::sin(3 * t) + 0.1 * std::sin(7 * t);
    columns[0].numbers.push_back(t);
    columns[1].numbers.push_back(x + 5e-4 * random.normal());
    columns[2].numbers.push_back(x * x / 2 + 5e-4 * random.normal());
  }
  const CsvTable log = CsvTable::from_columns("log", std::move(columns));
  for (const bool windows : {true, false}) {
    const LearnedLog learned = learn_and_smooth(asked, log, {.most_passes = 0, .windows = windows});
    ASSERT_EQ(learned.windows != nullptr, windows);
    EXPECT_THAT(prepare_fit(learned.request(asked, "log")).notes, testing::Not(testing::Contains(HasSubstr("to rounding"))));
  }
}

// from as many states as rows
TEST(LearnAndSmooth, LearnsMoreFromWindowsThanFromRows) {
  for (const int n_states : {200, 400}) {
    const auto fit_of = [&](bool windows) {
      FitRequest asked = request();
      asked.problem.max_points = n_states;
      asked.hyperparameters = HyperparameterChoice::optimise;
      const LearnedLog log = learn_and_smooth(asked, noisy_log().table, {.most_passes = 0, .windows = windows});
      EXPECT_EQ(log.windows != nullptr, windows);
      return run_fit(prepare_fit(log.request(std::move(asked), "log")));
    };
    const auto error_of = [&](const FitOutcome& fit) {
      double error = 0;
      for (const Trajectory& truth : noisy_log().episodes) {
        const MatrixXd mean = fit.posterior.mean(View::constrained_acceleration(*pendulum().system), truth.states);
        for (const int j : {2, 5}) error += (mean.row(j) - truth.accelerations.row(j)).squaredNorm();
      }
      return std::sqrt(error);
    };
    const FitOutcome windows = fit_of(true);
    EXPECT_TRUE(windows.posterior.observations().front().has_sums());
    EXPECT_NEAR(windows.posterior.observations().front().n_data(), n_states, 0.4 * n_states);
    EXPECT_LT(error_of(windows), 0.9 * error_of(fit_of(false))) << n_states;
    // the same to the bit from its file
    const TemporaryFolder folder;
    windows.file.write(folder.path() / "fit.json");
    const Posterior again = FitFile::read(folder.path() / "fit.json").posterior();
    EXPECT_EQ(again.negative_log_likelihood(), windows.posterior.negative_log_likelihood());
  }
}

TEST(LearnAndSmooth, LearnsFromRowsWhereWindowsDoNotSayWhatIsAsked) {
  for (const auto& change : std::vector<std::function<void(FitRequest&)>>{
           [](FitRequest& one) { one.problem.robust = true; },
           [](FitRequest& one) { one.problem.noise_stddev = 0.1; },
           [](FitRequest& one) { one.problem.baseline = Baseline::Kind::se; },
           [](FitRequest& one) { one.problem.protocol.name = Protocol::Name::paper; },
       }) {
    FitRequest asked = request();
    change(asked);
    const LearnedLog log = learn_and_smooth(asked, noisy_log().table, {.most_passes = 0});
    EXPECT_EQ(log.windows, nullptr);
    EXPECT_THAT(log.rows, testing::SizeIs(50));
  }
}

/// A slider whose position is logged, 100 times a second, and `more` columns by the time.
CsvTable slider_log(const std::string& name,
                    const std::vector<std::pair<std::string, std::function<double(double)>>>& more = {}) {
  RandomStream random(1);
  std::vector<CsvTable::Column> columns = {{"t", {}}, {name, {}}};
  for (const auto& one : more) columns.push_back({one.first, {}});
  for (int i = 0; i < 600; ++i) {
    const double t = i / 100.0;
    columns[0].numbers.push_back(t);
    columns[1].numbers.push_back(0.5 * std::sin(2 * t) + 1e-3 * random.normal());
    for (std::size_t k = 0; k < more.size(); ++k) columns[k + 2].numbers.push_back(more[k].second(t));
  }
  return CsvTable::from_columns("log", std::move(columns));
}

FitRequest request_of_slider(const std::string& constraints = "") {
  FitRequest asked;
  asked.model = Model::parse("coordinates = ['x']\n[mechanics]\nmass = [[1]]\n" + constraints +
                                 "[[latent]]\nfeatures = ['x', 'dx']\ndirections = 'force'\n",
                             "slider");
  return asked;
}

// Of each time there are two rows, the first without a position.
TEST(LearnedLog, ItsFitNamesLinesOfTheRawLogAndListsItsFile) {
  const CsvTable log = slider_log("x");
  std::string text = "t,x\n";
  for (int i = 0; i < log.n_rows(); ++i) text += fmt::format("{0},\n{0},{1}\n", log.cell(i, 0), log.cell(i, 1));
  const TemporaryFolder folder;
  const CsvTable raw = CsvTable::read(folder.write("raw.csv", text));
  const FitRequest asked = request_of_slider();
  for (const bool windows : {true, false}) {
    const LearnedLog learned = learn_and_smooth(asked, raw, {.most_passes = 0, .windows = windows});
    const FitJob job = prepare_raw_fit(learned, asked, "raw.csv");
    ASSERT_EQ(job.problem.lines.front().size(), learned.rows.size());
    const auto smoothed = prepare_fit(learned.request(asked, "raw.csv")).problem.lines.front();
    for (std::size_t i = 0; i < smoothed.size(); ++i) EXPECT_EQ(job.problem.lines.front()[i], 2 * smoothed[i] - 2);
    ASSERT_THAT(job.file.logs, testing::SizeIs(1));
    EXPECT_TRUE(job.file.has_learned(*raw.file()));
  }
}

TEST(LearnedLog, IsNotBlamedForRatesThatNobodyMeasured) {
  const FitRequest asked = request_of_slider();
  LearnedLog learned = learn_and_smooth(asked, slider_log("x"), {.most_passes = 0, .windows = false});
  learned.data.accelerations *= -1;  // sensors that contradict the constraints among them make such ones
  EXPECT_THAT(prepare_raw_fit(learned, asked, "log").problem.notes,
              testing::Not(testing::Contains(HasSubstr("is not the rate of"))));
}

TEST(LearnedLog, KeepsNamesOfColumnsOfSideInformation) {
  FitRequest asked = request_of_slider();
  asked.problem.columns = {{"x", "place"}};
  const auto job_of = [&](const CsvTable& log) {
    const LearnedLog learned = learn_and_smooth(asked, log, {.most_passes = 0, .windows = false});
    return prepare_raw_fit(learned, asked, "log");
  };
  EXPECT_NO_THROW(job_of(slider_log("place")));
  asked.problem.also_noise_stddev = 0.1;
  asked.also = {{View::Quantity::unconstrained_acceleration, "", {CsvTable::parse("place,dplace,abar_x\n0.1,0,0\n", "rest")}}};
  for (const char* name : {"place", "x"}) {
    const FitProblem problem = job_of(slider_log(name)).problem;
    ASSERT_THAT(problem.observations, testing::SizeIs(2)) << name;
    EXPECT_EQ(problem.observations.back().states()(0, 0), 0.1) << name;
  }
  asked.problem.columns = {{"x", "nowhere"}};
  EXPECT_THAT(input_error_of([&] { job_of(slider_log("x")); }), HasSubstr("has no column 'nowhere'"));
}

// whose times begin anew, which matters where inputs act late
TEST(LearnAndSmooth, TakesEpisodesOfAColumnOfAnotherName) {
  FitRequest asked;
  asked.model = Model::parse(
      "coordinates = ['x']\ninputs = [{ name = 'u', delay = 0.02 }]\n[mechanics]\nmass = [[1]]\nforce = ['u']\n"
      "[[latent]]\nfeatures = ['dx']\ndirections = 'force'\n",
      "slider");
  asked.problem.mean = Prior::Mean::force;
  const CsvTable one = slider_log("x", {{"u", [](double t) { return -2 * std::sin(2 * (t + 0.02)); }}});
  std::vector<std::string> cells;
  for (const char* run : {"A", "B"}) {
    for (int i = 0; i < one.n_rows(); ++i) cells.insert(cells.end(), {run, one.cell(i, 0), one.cell(i, 1), one.cell(i, 2)});
  }
  RawFitOptions options{.most_passes = 0, .windows = false};
  options.derive.episode_column = "run";
  const LearnedLog learned = learn_and_smooth(asked, CsvTable::from_cells("log", {"run", "t", "x", "u"}, cells), options);
  EXPECT_NO_THROW(prepare_raw_fit(learned, asked, "log"));
}

TEST(LearnAndSmooth, PaperProtocolRefusesSeveralLatentsByItsOwnName) {
  FitRequest asked = request_of_slider();
  asked.model = Model::parse(
      "coordinates = ['x']\n[mechanics]\nmass = [[1]]\n[[latent]]\nname = 'a'\nfeatures = ['x']\ndirections = 'force'\n"
      "[[latent]]\nname = 'b'\nfeatures = ['dx']\ndirections = 'force'\n",
      "slider");
  asked.problem.protocol.name = Protocol::Name::paper;
  EXPECT_THAT(input_error_of([&] { learn_and_smooth(asked, slider_log("x"), {.most_passes = 1}); }),
              HasSubstr("`protocol=paper` has one latent"));
}

TEST(LearnAndSmooth, LearnsFromRowsWhereVelocitiesAreLoggedUnderAnotherName) {
  const auto velocity = [](double t) { return std::cos(2 * t); };
  FitRequest asked = request_of_slider();
  EXPECT_NE(learn_and_smooth(asked, slider_log("x"), {.most_passes = 0}).windows, nullptr);
  EXPECT_EQ(learn_and_smooth(asked, slider_log("x", {{"dx", velocity}}), {.most_passes = 0}).windows, nullptr);
  asked.problem.columns = {{"x", "s"}};
  EXPECT_EQ(learn_and_smooth(asked, slider_log("s", {{"ds", velocity}}), {.most_passes = 0}).windows, nullptr);
}

// whose columns are those of the raw log, before it is smoothed
TEST(LearnAndSmooth, NamesAnInputThatTheLogLacks) {
  FitRequest asked = request_of_slider();
  asked.model = Model::parse(R"(
coordinates = ["x"]
inputs = ["u"]
[mechanics]
mass = [[1]]
force = ["u"]
[[latent]]
features = ["dx"]
directions = "force"
)",
                             "slider.toml");
  asked.problem.mean = Prior::Mean::force;
  asked.problem.columns = {{"x", "place"}};
  EXPECT_THAT(input_error_of([&] { learn_and_smooth(asked, slider_log("place"), {.most_passes = 0}); }),
              HasSubstr("missing column 'u' (looked for u, tau); the file has: t, place. Rename it, or give `map=LOGNAME=u`"));
  asked.problem.mean = Prior::Mean::zero;
  EXPECT_NO_THROW(learn_and_smooth(asked, slider_log("place"), {.most_passes = 0}));
}

// which may be its cause
TEST(LearnAndSmooth, TellsWarningsOfTheLogBesideAnErrorOfTheFit) {
  const CsvTable sound = slider_log("x");
  std::vector<std::string> cells;
  for (int i = 0; i < sound.n_rows(); ++i) {
    cells.push_back(sound.cell(i, 0));
    cells.push_back(sound.cell(i > 200 && i < 260 ? 200 : i, 1));
  }
  FitRequest asked = request_of_slider();
  asked.problem.observe = {"ddy"};
  EXPECT_THAT(input_error_of([&] {
                learn_and_smooth(asked, CsvTable::from_cells("log", {"t", "x"}, cells), {.most_passes = 1});
              }),
              testing::AllOf(HasSubstr("ddy"), HasSubstr("\nwarning: log: x "), HasSubstr("was its sensor stuck?")));
}

// of which no acceleration says anything
TEST(LearnAndSmooth, TakesAMotionThatConstraintsPrescribe) {
  const FitRequest asked = request_of_slider("[constraints]\nposition = ['x - 0.5*sin(2*t)']\n");
  const LearnedLog learned = learn_and_smooth(asked, slider_log("x"), {.most_passes = 0});
  EXPECT_THAT(learned.data.independent, testing::IsEmpty());
}

// of so many a posterior keeps every other one
TEST(LearnAndSmooth, LearnsFromManyRowsThroughInducingPoints) {
  FitRequest asked = request_of_slider();
  asked.problem.max_points = 5200;
  asked.restarts = asked.max_iterations = 1;
  asked.max_escapes = 0;
  asked.inducing = 8;
  std::vector<CsvTable::Column> columns = {{"t", {}}, {"x", {}}};
  RandomStream random(1);
  for (int i = 0; i < 5400; ++i) {
    columns[0].numbers.push_back(i / 200.0);
    columns[1].numbers.push_back(0.5 * std::sin(0.01 * i) + 1e-3 * random.normal());
  }
  const LearnedLog learned =
      learn_and_smooth(asked, CsvTable::from_columns("log", std::move(columns)), {.most_passes = 1, .windows = false});
  EXPECT_THAT(learned.rows, testing::SizeIs(5200));
}

TEST(LearnAndSmooth, FindsHyperparametersOfWindowsFromAllOfThem) {
  FitRequest asked = request_of_slider();
  const LearnedLog learned = learn_and_smooth(asked, slider_log("x"), {.most_passes = 0});
  ASSERT_NE(learned.windows, nullptr);
  asked.train_on = 50;
  EXPECT_EQ(input_error_of([&] { prepare_fit(learned.request(asked, "log")); }),
            "`train_on` is not for windows of a raw log: `windows=none` learns from its rows");
}

// A slow motion tells a stiffness by its positions, not by its accelerations. They bound the standard error (Cramér and Rao).
TEST(LearnAndSmooth, IsNotSurerOfASpringThanPositionsAllow) {
  constexpr double k = 40, noise = 1e-3, slow = 1.5, fast = 3.1;
  FitRequest asked;
  asked.model = Model::parse(
      "coordinates = ['x']\ninputs = ['u']\n[parameters]\nk = { value = 30, bounds = [5, 100], estimate = true }\n"
      "[mechanics]\nmass = [[1]]\nforce = ['u - k*x']\n[[latent]]\nfeatures = ['dx']\ndirections = 'force'\n",
      "spring");
  asked.problem.mean = Prior::Mean::force;
  asked.problem.max_points = 200;
  asked.hyperparameters = HyperparameterChoice::optimise;
  asked.restarts = 1;
  asked.max_escapes = 0;
  RandomStream random(1);
  std::vector<CsvTable::Column> columns = {{"t", {}}, {"x", {}}, {"u", {}}};
  double information = 0;
  for (int i = 0; i < 800; ++i) {
    const double t = i / 100.0, one = 0.1 * std::sin(slow * t), other = 0.05 * std::sin(fast * t);
    columns[0].numbers.push_back(t);
    columns[1].numbers.push_back(one + other + noise * random.normal());
    columns[2].numbers.push_back((k - slow * slow) * one + (k - fast * fast) * other);
    information += std::pow((one / (k - slow * slow) + other / (k - fast * fast)) / noise, 2);
  }
  const LearnedLog learned = learn_and_smooth(asked, CsvTable::from_columns("log", std::move(columns)), {.most_passes = 0});
  ASSERT_NE(learned.windows, nullptr);
  const FitReport report = run_fit(prepare_fit(learned.request(asked, "log"))).file.report;
  const auto found = std::ranges::find(report.hyperparameters, "k", &Hyperparameter::name);
  ASSERT_NE(found, report.hyperparameters.end());
  const double unit = found->positive ? found->value : 1;
  const double stddev = unit * report.uncertainty.value().stddev[found - report.hyperparameters.begin()];
  EXPECT_GT(stddev, 0.9 / std::sqrt(information));
  EXPECT_LT(stddev, 2 / std::sqrt(information));
  EXPECT_LT(std::abs(found->value - k), 3 * stddev);
  for (const Hyperparameter& one : report.hyperparameters) {
    if (one.kind == Hyperparameter::Kind::noise_stddev) {
      EXPECT_NEAR(one.value, 1, 0.3) << "times the noise of the positions";
    }
  }
}

TEST(LearnAndSmooth, SameBitsForAnyNumberOfThreads) {
  FitRequest one = request(), three = request();
  one.threads = 1, three.threads = 3;
  RawFitOptions options;
  options.most_passes = 1;
  const LearnedLog a = learn_and_smooth(one, noisy_log().table, options);
  options.derive.n_threads = 1;
  const LearnedLog b = learn_and_smooth(three, noisy_log().table, options);
  EXPECT_EQ(a.rows, b.rows);
  EXPECT_EQ(a.data.accelerations, b.data.accelerations);
}

}  // namespace
}  // namespace gp2::test
