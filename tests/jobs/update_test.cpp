// More data for a fit, as a command and Python ask for it.
#include "gp2/jobs/update_job.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/not_a_number.hpp"
#include "data_of_model.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using test::input_error_of;
using testing::Contains;
using testing::HasSubstr;

constexpr const char* surface = "models/surface.toml";

CsvTable log_of(int n, std::uint64_t seed) { return test::drawn_log(surface, n, seed).table(); }

FitFile fit_of(const CsvTable& log) {
  FitRequest request;
  request.model = test::model(surface);
  request.logs = {{log, nullptr}};
  request.restarts = 1;
  request.max_iterations = 5;
  request.max_escapes = 0;
  return run_fit(prepare_fit(std::move(request))).file;
}

Observations more_of(const FitFile& fit, const CsvTable& log) {
  std::vector<std::string> notes;
  return more_observations(fit, fit.posterior(), log, {}, notes);
}

TEST(UpdateJob, AFitOfMoreIsThatOfAllUnderTheSameHyperparameters) {
  const FitFile fit = fit_of(log_of(30, 1));
  const UpdateOutcome updated = update(fit, {log_of(10, 2), log_of(5, 3)}, {});
  EXPECT_EQ(updated.n_added, 15);
  EXPECT_EQ(updated.n_states, 45);
  const test::TemporaryFolder folder;
  updated.fit.write(folder / "fit.json");
  const Posterior read = FitFile::read(folder / "fit.json").posterior();
  EXPECT_EQ(read.observations().size(), 1u) << "of one noise";
  EXPECT_EQ(read.observations().front().n_data(), 45);
  FitFile of_grown = fit;
  Posterior grown = fit.posterior();
  std::vector<std::string> notes;
  for (const CsvTable& log : {log_of(10, 2), log_of(5, 3)}) {
    Observations more = more_observations(of_grown, grown, log, {}, notes);
    grown = with_more(std::move(grown), of_grown, std::move(more), log, notes);
  }
  const View view = View::constrained_acceleration(*fit.model.system);
  const MatrixXd states = read.observations().front().states(), mean = grown.mean(view, states);
  EXPECT_LE((read.mean(view, states) - mean).cwiseAbs().maxCoeff(), 1e-8 * mean.cwiseAbs().maxCoeff());
}

// T23: outside the data the discrepancy is larger, but rows that are added are data.
TEST(UpdateJob, TheRangeOfTheDiscrepancyBecomesThatOfAllRows) {
  const FitFile fit = fit_of(log_of(30, 1));
  Model fast = test::model(surface);
  for (Model::SamplingRule& rule : fast.sampling) {
    if (rule.name.starts_with("dq")) rule.range = {{-1.5, 1.5}};
  }
  const CsvTable log = test::drawn_log(fast, 20, 2).table();
  const MatrixXd states = more_of(fit, log).states();
  const auto growth = [&](const FitFile& of) {
    return of.prior().latents.back().features->evaluate(states, Eigen::VectorXd()).bottomRows(1).eval();
  };
  ASSERT_GT(growth(fit).maxCoeff(), 1);
  FitFile updated = fit;
  std::vector<std::string> notes;
  const Posterior grown = with_more(fit.posterior(), updated, more_of(fit, log), log, notes);
  EXPECT_EQ(growth(updated).maxCoeff(), 0);

  // as if all were conditioned anew under the prior that the file now has
  updated.take_data(grown);
  const View view = View::constrained_acceleration(*fit.model.system);
  const Posterior::Marginal in_place = grown.marginal(view, states), anew = updated.posterior().marginal(view, states);
  EXPECT_LE((in_place.mean - anew.mean).cwiseAbs().maxCoeff(), 1e-8 * anew.mean.cwiseAbs().maxCoeff());
  EXPECT_LE((in_place.stddev() - anew.stddev()).cwiseAbs().maxCoeff(), 1e-6 * anew.stddev().maxCoeff());
}

TEST(UpdateJob, AWindowLeavesTheNewest) {
  const FitFile fit = fit_of(log_of(30, 1));
  const CsvTable log = log_of(10, 2);
  UpdateRequest request;
  request.window = 8;
  const UpdateOutcome updated = update(fit, {log}, request);
  EXPECT_EQ(updated.n_states, 8);
  EXPECT_EQ(updated.fit.observations.front().values(), more_of(fit, log).values().rightCols(8));
}

// All of these rows together would not fit into memory.
TEST(UpdateJob, AWindowLearnsNoRowsThatItLeavesBehind) {
  const FitFile fit = fit_of(log_of(30, 1));
  const CsvTable log = log_of(20'000, 2);
  UpdateRequest request;
  request.window = 20;
  const UpdateOutcome updated = update(fit, {log_of(5, 3), log}, request);
  EXPECT_EQ(updated.n_added, 20) << "that are there then";
  EXPECT_EQ(updated.n_states, 20);
  ASSERT_EQ(updated.fit.observations.size(), 1U);
  EXPECT_EQ(updated.fit.observations.front().values(), more_of(fit, log).values().rightCols(20));
}

TEST(UpdateJob, MoreRowsThanMemoryHoldsAreRefusedWithThoseThatFit) {
  const FitFile fit = fit_of(log_of(30, 1));
  const Posterior posterior = fit.posterior();
  const Observations more = more_of(fit, log_of(4000, 2));
  const auto refused = [&](std::optional<double> free, bool is_given) {
    return input_error_of([&] {
      require_memory_of_more(
          posterior, more, "more.csv", [&] { return free; }, [&](double, int) { return is_given; });
    });
  };
  EXPECT_EQ(refused(1e12, true), "");
  EXPECT_EQ(refused(std::nullopt, true), "");
  const std::string text = refused(2e8, true);
  EXPECT_THAT(text, testing::StartsWith("more.csv: an exact fit of 4030 rows takes "));
  EXPECT_THAT(text, HasSubstr(" GB more memory, of which 0.2 GB are free; the newest "));
  EXPECT_THAT(text, HasSubstr(" rows would fit: keep these with `window="));
  EXPECT_THAT(text, testing::EndsWith(", or fit all logs, through inducing points"));
  EXPECT_THAT(refused(1e12, false), HasSubstr(" GB more memory in one piece, which the system does not give"));
}

using Cell = std::function<double(int row, const std::string& column, double value)>;

// The log with the numbers of some columns as `cell` has them, 1 before in those that it lacks; NaN: an empty cell.
CsvTable with_cells(const CsvTable& log, std::vector<std::string> names, const Cell& cell) {
  std::vector<CsvTable::Column> columns;
  for (const std::string& name : names) {
    columns.push_back({name, {}});
    const int column = log.find(name);
    for (int row = 0; row < log.n_rows(); ++row)
      columns.back().numbers.push_back(cell(row, name, column < 0 ? 1 : log.number(row, column)));
  }
  return CsvTable::from_columns("more.csv", std::move(columns));
}

TEST(UpdateJob, SaysAndRefusesOfEmptyCellsWhatAFitDoes) {
  const FitFile fit = fit_of(log_of(30, 1));
  const CsvTable log = log_of(10, 2);
  std::vector<std::string> names = log.header();
  names.emplace_back("ddq1_std");
  const auto emptied = [&](const std::function<bool(int row, const std::string& column)>& is_empty) {
    return with_cells(log, names, [&](int row, const std::string& column, double value) {
      if (is_empty(row, column)) return not_a_number;
      return column == "ddq1_std" ? 0.05 : value;
    });
  };
  const auto is_value = [](const std::string& column) { return column.starts_with("ddq") && !column.ends_with("_std"); };
  const UpdateOutcome some = update(fit, {emptied([&](int row, const std::string& column) {
                                      return column == "ddq1_std" ? row < 5 : is_value(column) && row == 9;
                                    })},
                                    {});
  EXPECT_EQ(some.n_added, 9);
  EXPECT_THAT(some.notes,
              Contains("more.csv: values not measured (empty cells): 6 of 10 of ddq1 (5 without a standard deviation), "
                       "1 of 10 of ddq2, 1 of 10 of ddq3"));
  EXPECT_THAT(some.notes, Contains("more.csv: 1 rows left out: they have no measured value"));
  const CsvTable none = emptied([](int, const std::string& column) { return column == "ddq1_std"; });
  EXPECT_EQ(input_error_of([&] { static_cast<void>(update(fit, {none}, {})); }),
            "more.csv: column 'ddq1_std': every cell is empty, so nothing is measured there; leave the column out");
  UpdateRequest told;
  told.noise_stddev = 0.05;
  std::vector<std::string> notes;
  EXPECT_EQ(more_observations(fit, fit.posterior(), none, told, notes).values(), more_of(fit, log).values())
      << "the column is not read then";
  const CsvTable never = emptied([&](int row, const std::string& column) {
    return column == "ddq1_std" ? row > 0 : is_value(column) && (column != "ddq1" || row == 0);
  });
  EXPECT_THAT(input_error_of([&] { static_cast<void>(update(fit, {never}, {})); }),
              HasSubstr("no row has a value and, where the log has a column for it, its standard deviation"));
}

// A stream of rows, some without a value of one column.
TEST(UpdateJob, ARowMayLackAValueOfAColumn) {
  const FitFile fit = fit_of(log_of(30, 1));
  const CsvTable sound = log_of(1, 2);
  const auto without = [&](const std::vector<std::string>& empty) {
    std::string header, row;
    for (const std::string& name : sound.header()) {
      const double value = sound.number_or_empty(0, sound.find(name));
      header += (header.empty() ? "" : ",") + name;
      row += (&name == &sound.header().front() ? "" : ",");
      row += std::isnan(value) || std::ranges::count(empty, name) > 0 ? "" : fmt::format("{}", value);
    }
    return CsvTable::parse(header + "\n" + row + "\n", "row.csv");
  };
  const Eigen::VectorXd all = more_of(fit, sound).values().col(0), some = more_of(fit, without({"ddq2"})).values().col(0);
  ASSERT_EQ(some.size(), 3);
  EXPECT_EQ(some[0], all[0]);
  EXPECT_TRUE(std::isnan(some[1]));
  EXPECT_EQ(some[2], all[2]);
  const UpdateOutcome updated = update(fit, {without({"ddq2"})}, {});
  EXPECT_EQ(updated.n_states, 31);
  EXPECT_THAT(updated.notes, Contains("row.csv: values not measured (empty cells): 1 of 1 of ddq2"));
  const UpdateOutcome nothing = update(fit, {without({"ddq1", "ddq2", "ddq3"})}, {});
  EXPECT_EQ(nothing.n_states, 30);
  EXPECT_THAT(nothing.notes, Contains(HasSubstr("warning: row.csv: nothing is learned from it")));
}

// the file of a fit numbers its states anew, log after log
TEST(UpdateJob, AWindowLeavesTheNewestOfSeveralLogsToo) {
  FitRequest request = test::fit_request(test::model(surface), {log_of(10, 1), log_of(12, 2)});
  request.max_iterations = 0;
  FitFile fit = run_fit(prepare_fit(std::move(request))).file;
  const test::TemporaryFolder folder;
  UpdateRequest newest;
  newest.window = 15;
  for (const std::uint64_t seed : {3U, 4U, 5U}) {
    fit = update(std::move(fit), {log_of(10, seed)}, newest).fit;
    fit.write(folder / "fit.json");
    fit = FitFile::read(folder / "fit.json");
  }
  const MatrixXd before = more_of(fit, log_of(10, 4)).values().rightCols(5), last = more_of(fit, log_of(10, 5)).values();
  MatrixXd wanted(before.rows(), 15), left(before.rows(), 0);
  wanted << before, last;
  for (const Observations& group : fit.observations) {
    left.conservativeResize(Eigen::NoChange, left.cols() + group.n_data());
    left.rightCols(group.n_data()) = group.values();
  }
  ASSERT_EQ(left.cols(), 15);
  EXPECT_EQ(left, wanted);
  EXPECT_EQ(run_fit(prepare_fit_again(fit, 1)).posterior.n_states(), 15);
}

TEST(UpdateJob, AWindowKeepsWhatIsDistrustedAmongTheNewest) {
  FitFile fit = fit_of(log_of(30, 1));
  fit.report.distrusted = {{.group = 0, .row = 0, .state = 3}, {.group = 0, .row = 0, .state = 25}};
  UpdateRequest request;
  request.window = 20;
  const UpdateOutcome updated = update(fit, {log_of(5, 2)}, request);
  ASSERT_EQ(updated.fit.report.distrusted.size(), 1U);
  EXPECT_EQ(updated.fit.report.distrusted.front().state, 10);
}

// of every draw of the hyperparameters, each with a noise of its own
TEST(UpdateJob, AWindowLetsTheFirstRowsGoWhereHyperparametersAreIntegrated) {
  FitRequest request;
  request.model = test::model(surface);
  request.logs = {{log_of(30, 1), nullptr}};
  request.restarts = 1;
  request.hyperparameters = HyperparameterChoice::integrate;
  request.problem.estimate_noise = true;
  const test::TemporaryFolder folder;
  FitFile fit = run_fit(prepare_fit(std::move(request))).file;
  UpdateRequest newest;
  newest.window = 12;
  for (std::uint64_t seed = 2; seed < 4; ++seed) {
    UpdateOutcome updated = update(std::move(fit), {log_of(12, seed)}, newest);
    EXPECT_EQ(updated.n_states, 12);
    ASSERT_EQ(updated.fit.observations.size(), 1U);
    updated.fit.write(folder / "fit.json");
    fit = FitFile::read(folder / "fit.json");
  }
}

// A sign, a unit, a swapped column: a fit is sure that these values are others.
TEST(UpdateJob, SaysWhatTheFitIsSureIsOtherwise) {
  const FitFile fit = fit_of(log_of(60, 1));
  const CsvTable sound = log_of(40, 2);
  const auto notes_under = [&](const std::string& column, double factor, double added = 0) {
    std::vector<CsvTable::Column> columns;
    for (const std::string& name : sound.header()) {
      columns.push_back({name, {}});
      for (int row = 0; row < sound.n_rows(); ++row) {
        const double value = sound.number_or_empty(row, sound.find(name));
        columns.back().numbers.push_back(name == column ? factor * value + added : value);
      }
    }
    return update(fit, {CsvTable::from_columns("next", std::move(columns))}, {}).notes;
  };
  EXPECT_THAT(notes_under("", 1), testing::Not(Contains(HasSubstr("standard deviations explain"))));
  for (const auto& [column, factor] : {std::pair("ddq1", -1.0), std::pair("ddq2", 1000.0), std::pair("ddq1", 0.0)}) {
    EXPECT_THAT(notes_under(column, factor),
                Contains(AllOf(HasSubstr("farther from its predictions than its standard deviations explain: "),
                               HasSubstr(fmt::format("{} (mean ", column)), HasSubstr("`window` or `forget`"))))
        << column;
  }
  // an offset of a few deviations, which no single value tells
  EXPECT_THAT(notes_under("", 1), testing::Not(Contains(HasSubstr("A ddq = b"))));
  EXPECT_THAT(notes_under("ddq3", 1, 1.0), Contains(HasSubstr("warning: next: measured ddq on A ddq = b")));
  EXPECT_THAT(notes_under("ddq3", 1, 1.0), Contains(HasSubstr("ddq3 (mean ")));
}

// One value, or a log of few rows, is enough where no noise makes it.
TEST(UpdateJob, SaysWhichValuesCannotBe) {
  const FitFile fit = fit_of(log_of(60, 1));
  const auto notes_of = [&](int n, const std::string& column, int every, double added, double factor) {
    const CsvTable sound = log_of(n, 2);
    std::vector<CsvTable::Column> columns;
    for (const std::string& name : sound.header()) {
      columns.push_back({name, {}});
      for (int row = 0; row < sound.n_rows(); ++row) {
        const double value = sound.number_or_empty(row, sound.find(name));
        columns.back().numbers.push_back(name == column && row % every == 0 ? factor * value + added : value);
      }
    }
    return update(fit, {CsvTable::from_columns("next", std::move(columns))}, {}).notes;
  };
  constexpr const char *cannot_be = "of the values contradict the fit", *are_far = "rows are far from the fit's data";
  for (const int n : {1, 5, 40}) {
    EXPECT_THAT(notes_of(n, "", 1, 0, 1), testing::Not(Contains(HasSubstr("warning")))) << n;
    EXPECT_THAT(notes_of(n, "ddq3", n, 500, 1), Contains(testing::AllOf(HasSubstr("warning: next: 1 of the values"),
                                                                        HasSubstr(cannot_be), HasSubstr("(ddq3, at row 1)"))))
        << n;
  }
  EXPECT_THAT(notes_of(5, "ddq1", 1, 0, -1), Contains(HasSubstr(cannot_be)));
  EXPECT_THAT(notes_of(40, "ddq1", 8, 100, 1), Contains(HasSubstr("5 of the values")));
  EXPECT_THAT(notes_of(40, "dq1", 1, 0, 1000),
              Contains(testing::AllOf(HasSubstr("warning: next: 40 of 40"), HasSubstr(are_far))));
}

TEST(UpdateJob, NamesRowsOfTheLogWhereSomeAreLeftOut) {
  const FitFile fit = fit_of(log_of(60, 1));
  const CsvTable log = log_of(50, 2);
  const CsvTable wrong = with_cells(log, log.header(), [](int row, const std::string& column, double value) {
    if (!column.starts_with("ddq")) return value;
    return row < 10 ? not_a_number : value + (column == "ddq1" && (row == 30 || row == 40) ? 1000 : 0);
  });
  const auto note_with = [](const std::vector<std::string>& notes, const std::string& text) {
    const auto found = std::ranges::find_if(notes, [&](const std::string& note) { return note.find(text) != std::string::npos; });
    return found == notes.end() ? "" : *found;
  };
  const std::vector<std::string> notes = update(fit, {wrong}, {}).notes;
  const std::string farthest = note_with(notes, "farthest off");
  EXPECT_THAT(farthest, testing::AnyOf(HasSubstr("2 of 40 rows (farthest off: row 41, 31)"),
                                       HasSubstr("2 of 40 rows (farthest off: row 31, 41)")));
  EXPECT_EQ(note_with(evaluate(fit, fit.posterior(), wrong, {}).notes, "farthest off"), farthest);
  EXPECT_THAT(note_with(notes, "contradict the fit"),
              testing::AnyOf(HasSubstr("(ddq1, at row 31)"), HasSubstr("(ddq1, at row 41)")));
}

// A log of many rows, of which the fit took few, has none left when as many as these are newer.
TEST(UpdateJob, AWindowStrikesTheLogsOfWhichNothingIsLeft) {
  const test::TemporaryFolder folder;
  const auto file_of = [&](const std::string& name, int n, std::uint64_t seed) {
    log_of(n, seed).write(folder / name);
    return CsvTable::read(folder / name);
  };
  FitRequest request = test::fit_request(test::model(surface), {file_of("a.csv", 50, 1), file_of("b.csv", 60, 2)});
  request.max_iterations = 0;
  request.problem.max_points = 10;
  FitFile fit = run_fit(prepare_fit(std::move(request))).file;
  const auto names_under = [&](int window, const std::string& name, std::uint64_t seed) {
    UpdateRequest newest;
    newest.window = window;
    fit = update(std::move(fit), {file_of(name, 10, seed)}, newest).fit;
    fit.write(folder / "fit.json");
    fit = FitFile::read(folder / "fit.json");
    std::vector<std::string> names;
    for (const LogFile& log : fit.logs) names.push_back(std::filesystem::path(log.name).filename());
    return names;
  };
  EXPECT_THAT(names_under(25, "c.csv", 3), testing::ElementsAre("a.csv", "b.csv", "c.csv"));
  EXPECT_THAT(names_under(25, "d.csv", 4), testing::ElementsAre("b.csv", "c.csv", "d.csv"));
  EXPECT_THAT(names_under(20, "e.csv", 5), testing::ElementsAre("d.csv", "e.csv"));
  EXPECT_EQ(fit.logs.front().n_learned, 10);
  // files had no such numbers before: a log stays until others have as many rows
  for (LogFile& log : fit.logs) log.n_learned.reset();
  EXPECT_THAT(names_under(15, "f.csv", 6), testing::ElementsAre("d.csv", "e.csv", "f.csv"));
  EXPECT_THAT(names_under(20, "g.csv", 7), testing::ElementsAre("f.csv", "g.csv"));
}

// Rows without a file are not those of the file before them.
TEST(UpdateJob, RowsOfArraysCountOnTheirOwn) {
  const test::TemporaryFolder folder;
  log_of(30, 1).write(folder / "a.csv");
  const CsvTable file = CsvTable::read(folder / "a.csv"), rows = log_of(5, 2);
  UpdateRequest newest;
  newest.window = 10;
  const FitFile fit = update(fit_of(file), {rows, log_of(6, 3)}, newest).fit;
  ASSERT_EQ(fit.logs.size(), 1U);
  EXPECT_EQ(fit.logs[0].name, rows.name());
  EXPECT_EQ(fit.logs[0].n_learned, 10);
  EXPECT_FALSE(fit.has_learned(*file.file()));
}

TEST(UpdateJob, AFitToWindowsOfARawLogTakesNoWindow) {
  FitFile fit = fit_of(log_of(30, 1));
  const Observations& all = fit.observations.front();
  fit.observations = {all.with_sums({{0, 0, Eigen::VectorXd::Ones(1), all.values()(0, 0), Eigen::VectorXd::Ones(1)}})};
  UpdateRequest newest;
  newest.window = 1000;
  EXPECT_EQ(input_error_of([&] { static_cast<void>(update(fit, {log_of(3, 2)}, newest)); }),
            "`window`: the fit learned from windows of a raw log, of which single rows cannot be taken away; fit the newest logs "
            "again, or this one with `windows=none`");
}

TEST(UpdateJob, WhatCannotBeIsAnError) {
  const FitFile fit = fit_of(log_of(30, 1));
  const auto refused = [&](const UpdateRequest& request) {
    return input_error_of([&] { static_cast<void>(update(fit, {log_of(3, 2)}, request)); });
  };
  UpdateRequest none_left, fading, silent, unknown;
  silent.noise_stddev = 0;
  unknown.observe = {"ddq9"};
  EXPECT_EQ(refused(silent), "`noise_std`: must be positive and at most 1e+100, got 0");
  silent.noise_stddev = 1e300;
  EXPECT_EQ(refused(silent), "`noise_std`: must be positive and at most 1e+100, got 1e+300");
  silent.noise_stddev = 1e-12;
  EXPECT_THAT(refused(silent), HasSubstr("the noise standard deviation 1e-12 of ddq1 is too small for double precision"));
  EXPECT_THAT(refused(unknown), HasSubstr("`observe`: 'ddq9' is not an acceleration of "));
  none_left.window = 0;
  fading.forget = 0.5;
  EXPECT_EQ(refused(none_left), "`window`: must be positive, got 0");
  EXPECT_THAT(refused(fading), HasSubstr("the oldest go by `window`"));
  FitRequest of_one;
  of_one.model = test::model(surface);
  of_one.logs = {{log_of(30, 1), nullptr}};
  of_one.problem.observe = {"ddq1"};
  of_one.max_iterations = 0;
  const FitFile one = run_fit(prepare_fit(std::move(of_one))).file;
  UpdateRequest other;
  other.observe = {"ddq1", "ddq2"};
  EXPECT_EQ(input_error_of([&] { static_cast<void>(update(one, {log_of(3, 2)}, other)); }),
            "`noise_std`: ddq2 was not observed in the fit; give its noise standard deviation");
}

// A block that is pushed late and rubs; `noise` is that of [noise].
Model block(const std::string& noise, const std::string& lateness = "") {
  return Model::parse(fmt::format(R"toml(
name = "block"
coordinates = ["x"]
inputs = [{{ name = "push"{} }}]
[mechanics]
mass = [["2"]]
force = ["push"]
[noise]
ddq = {}
[[latent]]
name = "friction"
kernel = "se"
features = ["dx"]
directions = {{ force = [["1"]] }}
)toml",
                                  lateness, noise),
                      "block.toml");
}

// n rows of velocities from `first` to 3 m/s more, 0.01 s apart; a deviation of ddx where it is not empty
CsvTable block_log(const std::string& name, int n, double first, const std::string& stddev) {
  std::string text = stddev.empty() ? "t,x,dx,push,ddx\n" : "t,x,dx,push,ddx,ddx_std\n";
  for (int i = 0; i < n; ++i) {
    const double dx = first + 3. * i / n;
    text += fmt::format("{},0,{},0.3,{}", 0.01 * i, dx, 0.15 - std::tanh(dx) + 0.05 * std::sin(31.0 * i));
    text += stddev.empty() ? "\n" : fmt::format(",{}\n", i == 1 ? "" : stddev);
  }
  return CsvTable::parse(text, name);
}

FitFile fit_of_block(const Model& model, std::vector<CsvTable> logs, bool estimates_noise = false) {
  FitRequest request = test::fit_request(model, std::move(logs));
  request.max_iterations = 3;
  request.max_escapes = 0;
  request.problem.estimate_noise = estimates_noise;
  return run_fit(prepare_fit(std::move(request))).file;
}

TEST(UpdateJob, TheNoiseOfMoreIsWhatItsLogStatesAsInTheFit) {
  const double stated = 0.02, floor = 0.1;
  for (const bool fit_states : {false, true}) {
    SCOPED_TRACE(fit_states);
    const FitFile fit =
        fit_of_block(block("{ value = 0.3, floor = 0.1 }"), {block_log("first.csv", 30, -1, fit_states ? "0.02" : "")});
    std::vector<std::string> notes;
    const Posterior before = fit.posterior();
    const Observations more = more_observations(fit, before, block_log("more.csv", 5, -1, "0.02"), {}, notes);
    EXPECT_EQ(more.n_data(), 4) << "a value without a deviation is not measured";
    const double factor = fit_states ? before.noise_stddev(0)[0] : 1;
    EXPECT_DOUBLE_EQ(more.noise().at(more.noise().stddev(), 0)[0], factor * std::hypot(stated, floor));
    EXPECT_THAT(notes, Contains(HasSubstr("the noise of each value of ddx is the stated one and the floor of [noise]")));
    UpdateRequest told;
    told.noise_stddev = 0.4;
    const Observations otherwise = more_observations(fit, before, block_log("more.csv", 5, -1, "0.02"), told, notes);
    EXPECT_EQ(otherwise.noise().at(otherwise.noise().stddev(), 0)[0], 0.4);
    EXPECT_THAT(notes, Contains("more.csv: `noise_std=0.4` replaces the standard deviations in ddx"));
  }
  const FitFile factors = fit_of_block(block("0.3"), {block_log("first.csv", 30, -1, "0.02")});
  EXPECT_THAT(input_error_of([&] { static_cast<void>(more_of(factors, block_log("more.csv", 5, -1, ""))); }),
              HasSubstr("has its own noise; give that of the new ones in a column ddx_std"));
}

TEST(UpdateJob, NamesTheRowWhoseMechanicsAreNotDefined) {
  const Model model = Model::parse(test::changed(block("0.05").text, {{R"([["2"]])", R"([["2 - x"]])"}}), "block.toml");
  const FitFile fit = fit_of_block(model, {block_log("first.csv", 30, -1, "")});
  const CsvTable log = block_log("more.csv", 10, -1, "");
  const CsvTable wrong = with_cells(log, log.header(), [](int row, const std::string& column, double value) {
    if (column == "ddx" && row == 2) return not_a_number;
    return column == "x" && row == 6 ? 3 : value;
  });
  EXPECT_EQ(
      input_error_of([&] { static_cast<void>(update(fit, {wrong}, {})); }),
      "more.csv: data row 7: the mass matrix M is not positive definite ('block' with the model's parameters; see gp2 check)");
}

TEST(UpdateJob, ProjectsWhereTheFitDid) {
  test::LogData log = test::drawn_log(surface, 20, 1), more = test::drawn_log(surface, 5, 2);
  for (test::LogData* one : {&log, &more}) one->states.row(2).array() += 0.01;
  for (const bool projects : {false, true}) {
    FitRequest request;
    request.model = test::model(surface);
    request.logs = {{log.table(), nullptr}};
    request.problem.project = projects;
    request.max_iterations = 0;
    const FitFile fit = run_fit(prepare_fit(std::move(request))).file;
    std::vector<std::string> notes;
    const Observations added = more_observations(fit, fit.posterior(), more.table(), {}, notes);
    const System& system = *fit.model.system;
    EXPECT_EQ(system.residuals(added.states(), system.parameter_values()).cwiseAbs().maxCoeff() < 1e-9, projects);
  }
}

TEST(UpdateJob, OfSeveralLogsTheLargestNoiseIsTakenAndSaid) {
  for (const bool is_first : {false, true}) {
    std::string rough = "t,x,dx,push,ddx\n";
    for (int i = 0; i < 40; ++i) rough += fmt::format("{},0,{},0.3,{}\n", 0.01 * i, 0.05 * i, 2 * std::sin(31.0 * i));
    std::vector<CsvTable> logs = {block_log("fine.csv", 40, -1, "")};
    logs.insert(is_first ? logs.begin() : logs.end(), CsvTable::parse(rough, "rough.csv"));
    const Model model = Model::parse(test::changed(block("0.1").text, {{R"({ force = [["1"]] })", R"("force")"}}), "block.toml");
    const FitFile fit = fit_of_block(model, std::move(logs), true);
    const auto leads =
        std::ranges::find_if(fit.report.hyperparameters, [](const Hyperparameter& h) { return !h.followers.empty(); });
    ASSERT_NE(leads, fit.report.hyperparameters.end());
    EXPECT_EQ(leads->owner, is_first ? 1 : 0) << "the discrepancy goes with the log that has less noise";
    const Posterior before = fit.posterior();
    std::vector<std::string> notes;
    const Observations more = more_observations(fit, before, block_log("more.csv", 5, -1, ""), {}, notes);
    const double a = before.noise_stddev(0)[0], b = before.noise_stddev(1)[0];
    EXPECT_EQ(more.noise().stddev()[0], std::max(a, b));
    EXPECT_NEAR(measurement_noise(before, {0}, 1, {})(0, 0), std::sqrt((a * a + b * b) / 2), 1e-12) << "of as many rows each";
    EXPECT_THAT(notes, Contains(HasSubstr("warning: more.csv: the logs of the fit differ in noise, ddx from ")));
  }
}

TEST(UpdateJob, RowsWhoseCommandsAreNotKnownAreLeftOutAndSaid) {
  const FitFile fit = fit_of_block(block("0.05", ", delay = 0.03"), {block_log("first.csv", 30, -1, "")});
  const UpdateOutcome some = update(fit, {block_log("more.csv", 10, -1, "")}, {});
  EXPECT_EQ(some.n_added, 7);
  EXPECT_THAT(some.notes,
              Contains(HasSubstr("more.csv: 3 of 10 rows left out: what acts there depends on commands before the log")));
  const UpdateOutcome none = update(fit, {block_log("short.csv", 2, -1, "")}, {});
  EXPECT_EQ(none.n_added, 0);
  EXPECT_EQ(none.n_states, fit.posterior().n_states());
  EXPECT_THAT(none.notes, Contains(HasSubstr("warning: short.csv: nothing is learned from it")));
}

TEST(UpdateJob, RowsFarFromAllInducingPointsAreSaid) {
  FitRequest request;
  request.model = block("0.05");
  request.logs = {{block_log("first.csv", 1200, -1, ""), nullptr}};
  request.inducing = 40;
  request.thin = false;
  const FitFile fit = run_fit(prepare_fit(std::move(request))).file;
  ASSERT_TRUE(fit.report.inducing);
  const auto is_said = [](const UpdateOutcome& outcome, const std::string& why) {
    return testing::Matches(Contains(testing::AllOf(HasSubstr("the fit's inducing points lose about"), HasSubstr(why))))(
        outcome.notes);
  };
  const CsvTable near = block_log("near.csv", 50, -0.97, "");
  EXPECT_FALSE(is_said(update(fit, {near}, {}), ""));
  EXPECT_TRUE(
      is_said(update(fit, {block_log("far.csv", 50, 40, "")}, {}), "of its rows, which lie far from those learned before;"));
  UpdateRequest precise;
  precise.noise_stddev = 0.00005;
  EXPECT_TRUE(is_said(update(fit, {near}, precise), "of its rows, since their noise is much smaller than that of the fit"));
  UpdateRequest silent;
  silent.noise_stddev = 1e-160;
  EXPECT_THAT(input_error_of([&] { static_cast<void>(update(fit, {near}, silent)); }),
              HasSubstr("the noise standard deviation 1e-160 of ddx is too small for double precision"));
  // what they stand for has no rows that could go
  UpdateRequest newest;
  newest.window = 5000;
  EXPECT_EQ(input_error_of([&] { static_cast<void>(update(fit, {near}, newest)); }),
            "`window`: what was learned through inducing points cannot be taken away, since the observations themselves are not "
            "kept; `forget` discounts it");
  // rows with deviations of their own are a group of their own
  const UpdateOutcome grown = update(fit, {block_log("stated.csv", 5, -1, "0.02"), block_log("one.csv", 1, -1, "0.02")}, {});
  EXPECT_EQ(grown.n_states, 1200 + 4 + 1);
}

}  // namespace
}  // namespace gp2
