#include "gp2/jobs/command_record.hpp"

#include <algorithm>
#include <cmath>
#include <memory>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/generate_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/report_job.hpp"
#include "gp2/jobs/show_job.hpp"
#include "gp2/simulate.hpp"
#include "input_error.hpp"
#include "jobs/late_cart.hpp"

namespace gp2::test {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

const char* const both = R"({ name = "u", delay = 0.02, lag = 0.04 })";

FitProblemOptions with_force() {
  FitProblemOptions options;
  options.mean = Prior::Mean::force;
  return options;
}

MatrixXd states_read(const Model& model, const CsvTable& log, const FitProblemOptions& options = with_force()) {
  return make_fit_problem(model, log, options).observations.front().states();
}

TEST(CommandRecord, APlainInputHasTheBitsOfTheLog) {
  const CsvTable log = late_cart_log(0, 0, 100, 2, 1);
  EXPECT_EQ(states_read(late_cart(R"({ name = "u", delay = 0, lag = 0 })"), log)(Eigen::all, Eigen::all).row(3),
            states_read(late_cart(R"("u")"), log).row(3));
  EXPECT_EQ(states_read(late_cart(R"("u")"), log)(3, 7), log.number(7, log.find("u")));
}

TEST(CommandRecord, WhatActsIsWhatTheSimulationHad) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1, 0);
  const MatrixXd states = states_read(late_cart(both), log);
  // 0.02 s + 5 · 0.04 s are left out
  EXPECT_EQ(states.cols(), log.n_rows() - 22);
  const int first = log.n_rows() - static_cast<int>(states.cols());
  for (int i = 0; i < states.cols(); ++i) {
    const double dx = states(1, i), ddx = log.number(first + i, log.find("ddx"));
    EXPECT_NEAR(states(3, i) - 2 * dx - std::tanh(5 * dx), 1.5 * ddx, 1e-12);
  }
}

TEST(CommandRecord, RowsOfALogAreToldByTheWholeLog) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1);
  std::vector<int> some = {150, 40, 90};
  FitProblemOptions options = with_force();
  options.commands = log;
  const MatrixXd all = states_read(late_cart(both), log), chosen = states_read(late_cart(both), log.take(some), options);
  ASSERT_EQ(chosen.cols(), 3);
  std::ranges::sort(some);  // rows are taken in the order of time
  for (int k = 0; k < 3; ++k) EXPECT_EQ(chosen(3, k), all(3, some[static_cast<std::size_t>(k)] - 22));
}

TEST(CommandRecord, EpisodesAndWhatFollowsAPauseBeginAtRest) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 3, 1);
  const auto column = [&](const char* name, const std::vector<int>& rows, double shift) {
    std::vector<double> out;
    for (const int row : rows) out.push_back(log.number(row, log.find(name)) + (row >= 150 ? shift : 0));
    return out;
  };
  std::vector<int> rows;
  for (int row = 0; row < log.n_rows(); ++row) rows.push_back(row);
  const auto table = [&](double pause, bool with_episodes) {
    std::vector<CsvTable::Column> columns = {{"t", column("t", rows, pause)}};
    for (const char* name : {"x", "dx", "ddx", "u"}) columns.push_back({name, column(name, rows, 0)});
    if (!with_episodes) return CsvTable::from_columns("log", columns);
    std::vector<double> episode(rows.size(), 1);
    std::fill(episode.begin() + 150, episode.end(), 2);
    columns.push_back({"episode", episode});
    return CsvTable::from_columns("log", columns);
  };
  const Model model = late_cart(both);
  // 0.18 s are no pause at 100 Hz
  EXPECT_EQ(states_read(model, table(0.18, false)).cols(), log.n_rows() - 22);
  const MatrixXd paused = states_read(model, table(5, false)), episodes = states_read(model, table(-1, true));
  EXPECT_EQ(paused.cols(), log.n_rows() - 44);
  ASSERT_EQ(episodes.cols(), log.n_rows() - 44);
  EXPECT_LT((paused.row(3) - episodes.row(3)).cwiseAbs().maxCoeff(), 1e-12);
}

TEST(CommandRecord, SaysWhatIsLeftOutAndWhatIsTooCoarse) {
  const CsvTable log = late_cart_log(0.02, 0.04, 10, 10, 1);
  const FitProblem problem = make_fit_problem(late_cart(both), log, with_force());
  EXPECT_THAT(problem.notes, Contains("late cart: 3 of 101 rows left out: what acts there depends on commands before the log"));
  EXPECT_THAT(problem.notes, Contains(HasSubstr("rows are usually 0.1 s apart, inputs at most 0.06 s late")));
}

TEST(CommandRecord, NeedsTimesInOrderAndRowsLateEnough) {
  const CsvTable log = late_cart_log(0, 0, 100, 1, 1);
  const Model model = late_cart(both);
  const auto error_of = [&](const CsvTable& table) {
    return input_error_of([&] { make_fit_problem(model, table, with_force()); });
  };
  const CsvTable without_time = CsvTable::parse("x,dx,ddx,u\n1,2,3,4\n", "no time");
  EXPECT_EQ(
      error_of(without_time),
      "no time: u acts late, which takes the times of the whole log, but it has no column t; it has: x, dx, ddx, u. Where its "
      "inputs are what acts, give the model no delay and no lag");
  EXPECT_EQ(error_of(log.take({3, 2})),
            "late cart: u acts late, which takes rows in the order of time, but late cart: row 3, column 't' has t = 0.02 after "
            "0.03. Sort the rows, or name what belongs together in a column 'episode'");
  EXPECT_EQ(error_of(log.first_rows(20)),
            "late cart: the acting inputs are not known at any row: they all depend on commands before the log; give the whole "
            "log as `commands`, a longer one, or narrower bounds of delays and lags");
  // where nothing reads u, nothing is needed
  EXPECT_EQ(input_error_of([&] { make_fit_problem(model, without_time, {}); }).find("late"), std::string::npos);
}

TEST(CommandRecord, WhatDependsOnWhatWasBeforeIsPredictedAndNotCompared) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1);
  const Model model = late_cart(both);
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  const LogStates predicted = read_log_states(prior, view, model, log, {}),
                  compared = read_log_states(prior, view, model, log, {}, {"ddx"});
  EXPECT_EQ(predicted.states.cols(), log.n_rows());
  EXPECT_TRUE(predicted.states.row(3).allFinite());
  EXPECT_THAT(predicted.notes,
              Contains(HasSubstr("warning: late cart: 22 of 201 rows are predicted as if each input had held its first value")));
  EXPECT_EQ(compared.accelerations.array().isNaN().count(), 22);
  // one that begins at 0, or is constant at first, may well have held that value before
  const auto notes_from = [&](double first, int n_resting) {
    std::vector<CsvTable::Column> columns;
    for (const std::string& name : log.header()) {
      columns.push_back({name, {}});
      for (int row = 0; row < log.n_rows(); ++row) {
        const bool is_set = name == "u" && row < n_resting;
        columns.back().numbers.push_back(is_set ? first : log.number(row, log.find(name)));
      }
    }
    return read_log_states(prior, view, model, CsvTable::from_columns("log", std::move(columns)), {}).notes;
  };
  const std::string note =
      "log: 22 of 201 rows as if each input had held its first value before: what acts there depends on commands before the log";
  EXPECT_THAT(notes_from(0, 1), Contains(note));
  EXPECT_THAT(notes_from(1e-3, 1), Contains(note));  // as smoothing leaves a 0
  EXPECT_THAT(notes_from(0.7, 30), Contains(note));
  EXPECT_THAT(notes_from(0.7, 5), Contains(HasSubstr("warning: log: 22 of 201 rows are predicted")));
}

TEST(CommandRecord, AnUnknownStartingValueIsRefusedWithTheNamesOfDelays) {
  FitRequest request;
  request.model = late_cart(both);
  request.logs = {{late_cart_log(0.02, 0.04, 100, 2, 1)}};
  request.problem.mean = Prior::Mean::force;
  request.start.values = {{"u.dealy", 0.01}};
  const std::string error = input_error_of([&] { prepare_fit(std::move(request)); });
  EXPECT_THAT(error, HasSubstr("`start`: unknown hyperparameter 'u.dealy'; this fit has: "));
  EXPECT_THAT(error, testing::EndsWith(", u.delay, u.lag"));
}

// A log without noise has the truth's accelerations, by whatever delays a fit has learned from it.
TEST(CommandRecord, ATruthActsByItsOwnDelays) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1, 0);
  FitRequest learn;
  learn.model = late_cart(R"({ name = "u", delay = 0.01 })");
  learn.logs = {{log}};
  learn.problem.mean = Prior::Mean::force;
  learn.hyperparameters = HyperparameterChoice::optimise;
  learn.max_iterations = 0;
  const FitOutcome fit = run_fit(prepare_fit(std::move(learn)));
  ReportRequest request;
  request.data = log;
  request.truth = std::make_shared<const Model>(late_cart(R"({ name = "u", delay = 0.02, lag = 0.04 })"));
  std::vector<std::string> notes;
  const Report report = collect_report(fit.file, fit.posterior, request, notes);
  const ReportData& test = report.data.back();
  int n = 0;
  for (Eigen::Index i = 0; i < test.truth.cols(); ++i) {
    if (std::isnan(test.measured(0, i)) || std::isnan(test.truth(0, i))) continue;
    EXPECT_NEAR(test.truth(0, i), test.measured(0, i), 1e-8) << i;
    ++n;
  }
  EXPECT_GT(n, 150);
  EXPECT_EQ(test.truth.array().isNaN().count(), 22) << "what acts there depends on commands before the log";
  EXPECT_EQ(report.data.front().truth.size(), 0);
  EXPECT_THAT(report.notes, Contains(HasSubstr("the true acceleration at the data of training is not shown")));
  request.data.reset();
  EXPECT_THAT(input_error_of([&] { collect_report(fit.file, fit.posterior, request, notes); }),
              HasSubstr("has other delays or lags than the fit, which keeps no commands"));
}

// In a log in milliseconds a delay in seconds is as good as none.
TEST(CommandRecord, ADelayInSecondsIsNotTakenForOneInTheUnitOfTheTime) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1);
  std::vector<CsvTable::Column> columns;
  for (const std::string& name : log.header()) {
    columns.push_back({name, {}});
    for (int row = 0; row < log.n_rows(); ++row)
      columns.back().numbers.push_back((name == "t" ? 1e3 : 1) * log.number(row, log.find(name)));
  }
  const CsvTable in_milliseconds = CsvTable::from_columns("log", std::move(columns));
  const auto told = Contains(
      HasSubstr("t counts 0.001 s, while delays and lags of inputs are in seconds (u.delay, u.lag): inputs act at a wrong time"));
  const Model model = late_cart(both);

  EXPECT_THAT(make_fit_problem(model, in_milliseconds, with_force()).notes, told);
  EXPECT_THAT(make_fit_problem(model, log, with_force()).notes, Not(told));
  EXPECT_THAT(make_fit_problem(model, in_milliseconds, {}).notes, Not(told)) << "nothing reads u";

  FitRequest learn;
  learn.model = model;
  learn.logs = {{log}};
  learn.problem.mean = Prior::Mean::force;
  learn.hyperparameters = HyperparameterChoice::optimise;
  learn.max_iterations = 0;
  const FitOutcome fit = run_fit(prepare_fit(std::move(learn)));
  EXPECT_THAT(evaluate(fit.file, fit.posterior, in_milliseconds, {}).notes, told);
  EXPECT_THAT(evaluate(fit.file, fit.posterior, log, {}).notes, Not(told));
  EXPECT_THAT(predict(fit.file, in_milliseconds, {}).notes, told);
  EXPECT_THAT(predict(fit.file, log, {}).notes, Not(told));

  const auto found_in = [&](const Model& of) {
    std::vector<std::string> texts;
    for (const Finding& one : check(of, &in_milliseconds, {})) texts.push_back(one.text);
    return texts;
  };
  const auto harmless = Contains(HasSubstr("a fit does not mind"));
  EXPECT_THAT(found_in(model), AllOf(told, Not(harmless)));
  EXPECT_THAT(found_in(late_cart(R"("u")")), AllOf(harmless, Not(told)));
}

// A fit has found its delays and lags: what is predicted by it reaches back as far as these do, not as far as they might.
TEST(CommandRecord, OfAFitReachesAsFarAsWhatWasFound) {
  const CsvTable log = late_cart_log(0.02, 0.04, 100, 2, 1);
  const Model model =
      late_cart(R"({ name = "u", delay = { value = 0.02, estimate = true }, lag = { value = 0.04, estimate = true } })");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  EXPECT_EQ(read_log_states(prior, view, model, log, {}, {"ddx"}).accelerations.array().isNaN().count(), 22);
  std::vector<int> tenth;
  for (int row = 0; row < log.n_rows(); row += 10) tenth.push_back(row);
  EXPECT_THAT(read_log_states(prior, view, model, log.take(tenth), {}).notes,
              Contains(testing::AllOf(HasSubstr("rows are usually 0.1 s apart, inputs at most 0.06 s late"),
                                      HasSubstr("give all of it, to a fit as `commands`"))));
}

TEST(CommandRecord, AnotherSystemSharesWhatItMarks) {
  const Model home = late_cart(both);
  const Model marked = late_cart(R"({ name = "u", delay = { value = 0.07, estimate = true }, lag = 0.01 })");
  const std::vector<Actuator> there = shared_actuators(home.actuators, marked);
  EXPECT_EQ(there[0].delay.value, 0.02);
  EXPECT_EQ(there[0].lag.value, 0.01);
}

TEST(CommandRecord, DerivePassesCommandsOn) {
  const CsvTable log = late_cart_log(0.02, 0.04, 200, 2, 1, 0);
  const MatrixXd plain = derive(late_cart(R"("u")"), log).states, late = derive(late_cart(both), log).states;
  EXPECT_EQ(late, plain);
}

TEST(CommandRecord, GenerateDrawsNoMotion) {
  EXPECT_EQ(input_error_of([&] { generate(late_cart(both), GenerateRequest{}); }),
            "generate: late_cart.toml: states are drawn one by one, but with u.delay and u.lag what acts depends on what was "
            "commanded before: simulate a motion, or leave both out");
}

TEST(CommandRecord, ShowPrintsDelaysAndLags) {
  EXPECT_THAT(show(late_cart(R"({ name = "u", delay = { estimate = true }, lag = 0.04 })"), {}),
              HasSubstr("\nactuators\n  u.delay      0   estimated\n  u.lag        0.04\n"));
  EXPECT_EQ(show(late_cart(R"("u")"), {}).find("actuators"), std::string::npos);
}

}  // namespace
}  // namespace gp2::test
