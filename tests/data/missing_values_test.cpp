#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/check.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

// Logs with empty cells, and with states off the constraint.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;

constexpr std::uint64_t seed = 40741;

const Model& surface() { return test::model("models/surface.toml"); }

// a log of the particle on a surface, whose cells the test changes: column, row from 0, text
struct Change {
  std::string column;
  int row = 0;
  std::string text;
};

CsvTable gappy_log_of(const std::vector<Change>& changes, const std::vector<std::string>& stated = {}, int n = 12) {
  const GeneratedData data = generate(surface(), {n, seed, VectorXd::Constant(3, 0.1)});
  const CsvTable whole = as_table(data, *surface().system, "log.csv");
  std::vector<std::string> header = whole.header();
  header.insert(header.end(), stated.begin(), stated.end());
  std::vector<std::string> cells;
  for (int row = 0; row < n; ++row) {
    for (const std::string& column : header) {
      const int k = whole.find(column);
      std::string cell = k < 0 ? fmt::format("{}", 0.05 + 0.01 * row) : whole.cell(row, k);
      for (const Change& change : changes) {
        if (change.column == column && (change.row == row || change.row < 0)) cell = change.text;
      }
      cells.push_back(cell);
    }
  }
  return CsvTable::from_cells("log.csv", header, cells);
}

FitProblem problem_of(const CsvTable& log, const FitProblemOptions& options = {}) {
  return make_fit_problem(surface(), log, options);
}

FitOptions unoptimised() {
  FitOptions options;
  options.max_iterations = 0;
  return options;
}

TEST(MissingValuesFileTest, AnEmptyCellOfAnAccelerationIsNotMeasured) {
  const FitProblem problem = problem_of(gappy_log_of({{"ddq1", 0, ""}, {"ddq1", 3, "  "}, {"ddq3", 3, ""}}));
  const MatrixXd& values = problem.observations.front().values();
  ASSERT_EQ(values.cols(), 12);
  EXPECT_TRUE(std::isnan(values(0, 0)) && std::isnan(values(0, 3)) && std::isnan(values(2, 3)));
  EXPECT_EQ(values.array().isNaN().count(), 3);
  EXPECT_THAT(problem.notes, Contains("log.csv: values not measured (empty cells): 2 of 12 of ddq1, 1 of 12 of ddq3"));
  EXPECT_TRUE(std::isfinite(fit(problem, unoptimised()).report.negative_log_likelihood));
}

TEST(MissingValuesFileTest, ARowThatMeasuresNothingIsLeftOutAsIfItWereNotThere) {
  const FitProblem problem = problem_of(gappy_log_of({{"ddq1", 2, ""}, {"ddq2", 2, ""}, {"ddq3", 2, ""}}));
  EXPECT_EQ(problem.observations.front().n_data(), 11);
  EXPECT_THAT(problem.lines.front(), ElementsAre(2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13)) << "the header is line 1";
  EXPECT_THAT(problem.notes, Contains("log.csv: 1 rows left out: they have no measured value"));
  const FitProblem without = problem_of(gappy_log_of({}).take({0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11}));
  EXPECT_EQ(fit(problem, unoptimised()).report.negative_log_likelihood,
            fit(without, unoptimised()).report.negative_log_likelihood);
  FitProblemOptions few;
  few.max_points = 5;
  EXPECT_THAT(problem_of(gappy_log_of({{"ddq1", 2, ""}, {"ddq2", 2, ""}, {"ddq3", 2, ""}}), few).notes,
              Contains("log.csv: 5 of 11 rows taken, by seed 0"));
}

TEST(MissingValuesFileTest, WhatIsNoNumberStaysAnError) {
  EXPECT_EQ(input_error_of([] {
              problem_of(gappy_log_of({{"ddq2", 4, "nan"}}));
            }),
            "log.csv: row 5, column 'ddq2': 'nan' is not a finite number; leave the cell empty where nothing is measured");
  EXPECT_EQ(input_error_of([] {
              problem_of(gappy_log_of({{"ddq2", 4, "lost"}}));
            }),
            "log.csv: row 5, column 'ddq2': 'lost' is not a finite number");
  EXPECT_EQ(input_error_of([] {
              problem_of(gappy_log_of({{"ddq2", -1, ""}}));
            }),
            "log.csv: column 'ddq2': every cell is empty, so nothing is measured there; choose others with `observe` of "
            "a fit, `outputs` of an evaluation");
  FitProblemOptions others;
  others.observe = {"ddq1", "ddq3"};
  EXPECT_EQ(problem_of(gappy_log_of({{"ddq2", -1, ""}}), others).observations.front().values().rows(), 2);
  EXPECT_EQ(input_error_of([] {
              problem_of(gappy_log_of({{"dq2", 4, ""}}));
            }),
            "log.csv: row 5, column 'dq2': the cell is empty; a number is needed here");
}

TEST(MissingValuesFileTest, StatedDeviationsGoWithTheirValues) {
  const std::vector<std::string> stated = {"ddq1_std", "ddq2_std", "ddq3_std"};
  const CsvTable log = gappy_log_of({{"ddq1", 0, ""}, {"ddq1_std", 0, ""}, {"ddq2", 1, ""}, {"ddq3_std", 2, ""}}, stated);
  const FitProblem problem = problem_of(log);
  const Observations& group = problem.observations.front();
  EXPECT_TRUE(std::isnan(group.values()(0, 0)) && std::isnan(group.values()(1, 1)) && std::isnan(group.values()(2, 2)));
  EXPECT_EQ(group.noise().scale()(2, 3), 0.08);
  EXPECT_THAT(problem.notes, Contains("log.csv: values not measured (empty cells): 1 of 12 of ddq1, 1 of 12 of ddq2, 1 of 12 of "
                                      "ddq3 (1 without a standard deviation)"));
  EXPECT_TRUE(std::isfinite(fit(problem, unoptimised()).report.negative_log_likelihood));
  for (const char* text : {"0", "-0.1"}) {
    EXPECT_EQ(
        input_error_of([&] {
          problem_of(gappy_log_of({{"ddq1_std", 3, text}}, stated));
        }),
        fmt::format("log.csv: row 4, column 'ddq1_std': the standard deviation of ddq1 must be positive, got {}; leave the cell "
                    "empty where nothing is measured",
                    text));
  }
  // a column without any deviation is not observed, unless that is asked for
  EXPECT_THAT(problem_of(gappy_log_of({{"ddq1_std", -1, ""}}, stated)).notes,
              Contains("log.csv: observes ddq2, ddq3: the log has standard deviations of these only; others with `observe`"));
  FitProblemOptions all;
  all.observe = {"ddq1", "ddq2", "ddq3"};
  EXPECT_EQ(input_error_of([&] {
              problem_of(gappy_log_of({{"ddq1_std", -1, ""}}, stated), all);
            }),
            "log.csv: column 'ddq1_std': every cell is empty, so nothing is measured there; leave the column out");
}

TEST(MissingValuesFileTest, ScalesAreThoseOfTheMeasuredValues) {
  const FitProblem problem = problem_of(gappy_log_of({{"ddq1", 0, ""}, {"ddq1", 5, ""}}));
  const Observations& group = problem.observations.front();
  std::vector<double> measured;
  for (const double value : group.values().row(0)) {
    if (!std::isnan(value)) measured.push_back(value);
  }
  const Scales scales = default_scales(problem.prior, problem.observations);
  EXPECT_EQ(scales.output_stddev.front()[0],
            row_stddev(Eigen::Map<Eigen::RowVectorXd>(measured.data(), std::ssize(measured)))[0]);
  EXPECT_EQ(scales.acceleration_stddev[0], scales.output_stddev.front()[0]);
}

TEST(MissingValuesFileTest, AFileKeepsThemToTheBit) {
  const test::TemporaryFolder folder;
  for (const std::vector<std::string>& stated : {std::vector<std::string>{}, {"ddq1_std", "ddq2_std", "ddq3_std"}}) {
    const FitProblem problem = problem_of(gappy_log_of({{"ddq1", 0, ""}, {"ddq3", 4, ""}}, stated));
    const Fit fitted = fit(problem, unoptimised());
    FitFile file;
    file.model = surface();
    file.prior_options = problem.prior_options;
    file.observations = fitted.posterior.observations();
    file.report = fitted.report;
    file.write(folder / "fit.json");
    const FitFile read = FitFile::read(folder / "fit.json");
    const MatrixXd &expected = file.observations.front().values(), &got = read.observations.front().values();
    EXPECT_TRUE(((got.array() == expected.array()) || (got.array().isNaN() && expected.array().isNaN())).all());
    EXPECT_EQ(read.posterior().negative_log_likelihood(), fitted.posterior.negative_log_likelihood());
    const View view = View::all(View::Quantity::constrained_acceleration, *surface().system);
    EXPECT_EQ(read.posterior().mean(view, problem.observations.front().states()),
              fitted.posterior.mean(view, problem.observations.front().states()));
  }
}

TEST(MissingValuesFileTest, AKnowledgeMayHaveThemToo) {
  const GeneratedData data = generate(surface(), {3, seed + 1, VectorXd::Zero(3)});
  std::vector<std::string> header = {"q1", "q2", "q3", "dq1", "dq2", "dq3", "u1", "u2", "u3", "abar_q1", "abar_q2"}, cells;
  for (int i = 0; i < 3; ++i) {
    for (const int k : {0, 1, 2, 3, 4, 5, 7, 8, 9}) cells.push_back(shortest(data.states(k, i)));
    cells.emplace_back(i == 1 ? "" : "0.5");
    cells.emplace_back(i == 0 ? "0.1" : "");
  }
  FitProblemOptions options;
  options.also_noise_stddev = 0.1;
  const SideInformation knowledge{
      View::Quantity::unconstrained_acceleration, "", {CsvTable::from_cells("rest.csv", header, cells), nullptr}};
  const FitProblem problem = make_fit_problem(surface(), {Log{gappy_log_of({})}}, {knowledge}, options);
  EXPECT_EQ(problem.observations[1].n_data(), 2);
  EXPECT_THAT(problem.lines[1], ElementsAre(2, 4));
  EXPECT_TRUE(std::isnan(problem.observations[1].values()(1, 1)));
  EXPECT_THAT(problem.notes, Contains("rest.csv: 1 rows left out: they have no measured value"));
}

TEST(MissingValuesFileTest, ACheckLooksAtTheRowsWhereAllIsMeasured) {
  const CsvTable log = gappy_log_of({{"ddq1", 0, ""}});
  LogReader reader = open_log(surface(), log, {});
  const WholeLog whole = read_whole_log(surface(), reader);
  const VectorXd parameters = surface().system->parameter_values();
  const std::vector<Finding> findings =
      check_data(*surface().system, whole.states, parameters, whole.accelerations, whole.stddev);
  const std::vector<Finding> rest = check_data(*surface().system, whole.states.rightCols(11), parameters,
                                               whole.accelerations.rightCols(11), whole.stddev.rightCols(11));
  ASSERT_EQ(findings.size(), rest.size());
  EXPECT_THAT(findings[1].text, HasSubstr("measured ddq on A ddq = b"));
  EXPECT_EQ(findings[1].text, rest[1].text);
}

// ---------------------------------------------------------------- --project

TEST(ProjectOptionTest, StatesAreMovedOntoTheConstraintsBeforeTheFitAndTheNotesSayHowFar) {
  const double height = std::stod(gappy_log_of({}).cell(4, gappy_log_of({}).find("q3")));
  const CsvTable off = gappy_log_of({{"q3", 4, fmt::format("{}", height + 0.02)}});
  FitProblemOptions options;
  EXPECT_THAT(problem_of(off).notes, Contains(HasSubstr("warning: log.csv: states are off the constraint")));
  options.project = true;
  const FitProblem problem = problem_of(off, options);
  EXPECT_THAT(problem.notes, Contains(HasSubstr("log.csv: states projected onto the constraints: q1 by ")));
  EXPECT_THAT(problem.notes, Contains(HasSubstr("q3 by ")));
  EXPECT_THAT(problem.notes, Contains(HasSubstr("at most (line 6)")));
  EXPECT_THAT(problem.notes, testing::Not(Contains(HasSubstr("off the constraint"))));
  const System& system = *surface().system;
  const MatrixXd& states = problem.observations.front().states();
  EXPECT_LT(system.residuals(states, system.parameter_values()).cwiseAbs().maxCoeff(), 1e-13);
  EXPECT_LT((states - problem_of(off).observations.front().states()).cwiseAbs().maxCoeff(), 0.1);
  // where the log says how well q3 is known beside the others, they hardly move
  std::string text = off.text();
  text.insert(text.find('\n'), ",q1_std,q2_std,q3_std");
  for (std::size_t end = text.find('\n', text.find('\n') + 1); end != std::string::npos; end = text.find('\n', end + 1)) {
    text.insert(end, ",1e-6,1e-6,1e-2");
    end = text.find('\n', end);
  }
  const FitProblem stated = problem_of(CsvTable::parse(text, "log.csv"), options);
  EXPECT_LT(
      (stated.observations.front().states() - problem_of(off).observations.front().states()).topRows(2).cwiseAbs().maxCoeff(),
      1e-7);
  EXPECT_THAT(stated.notes, testing::Not(Contains(HasSubstr("q3_std"))));
}

TEST(ProjectOptionTest, WhatCannotBeProjectedIsRefused) {
  const Model circle = Model::parse(R"toml(
coordinates = ["x"]
[mechanics]
mass = [["1"]]
[constraints]
position = ["x^2 + 1"]
[[latent]]
name = "a"
kernel = "se"
features = ["x"]
directions = "acceleration"
[noise]
ddq = 0.1
)toml",
                                    "circle.toml");
  FitProblemOptions options;
  options.project = true;
  EXPECT_THAT(
      input_error_of([&] { make_fit_problem(circle, CsvTable::parse("x,dx,ddx\n0.5,0,1\n0.7,0,2\n", "log.csv"), options); }),
      HasSubstr("`project`: log.csv: 2 of 2 states have no state on the constraints near them (line 2, 3): system"));
  const Model free = Model::parse(test::model("models/duffing.toml").text, "duffing.toml");
  if (free.system->residual_labels().empty()) {
    const CsvTable log = as_table(generate(free, {5, seed, VectorXd::Zero(free.system->nq())}), *free.system, "log.csv");
    EXPECT_THAT(make_fit_problem(free, log, options).notes, Contains(HasSubstr("log.csv: nothing to project: '")));
  }
  options.baseline = Baseline::Kind::se;
  EXPECT_EQ(input_error_of([&] { problem_of(gappy_log_of({}), options); }),
            "`baseline=se` knows no constraints: leave out `project`");
  options.project = false;
  options.robust = true;
  EXPECT_EQ(input_error_of([&] { problem_of(gappy_log_of({}), options); }),
            "`baseline=se` is fitted as published: leave out `robust`");
}

// ---------------------------------------------------------------- --robust

TEST(RobustOptionTest, ScalesDoNotComeFromAGrossErrorAndItsLineIsNamed) {
  FitProblemOptions options;
  options.robust = true;
  const CsvTable wrong = gappy_log_of({{"ddq2", 7, "1e6"}}, {}, 40);
  const FitProblem problem = problem_of(wrong, options);
  for (const Hyperparameter& h : problem.hyperparameters) {
    if (h.kind != Hyperparameter::Kind::signal_stddev) continue;
    EXPECT_LT(h.value, 100) << h.name;
  }
  FitOptions once;
  once.n_restarts = 1;
  const Fit robust = fit(problem, once);
  ASSERT_EQ(robust.report.distrusted.size(), 1U);
  EXPECT_EQ(robust.report.distrusted.front().row, 1);
  EXPECT_EQ(robust.report.distrusted.front().state, 7);
  EXPECT_THAT(distrust_notes(problem, robust.report),
              ElementsAre(HasSubstr("robust: 1 of 120 values distrusted: ddq2 in line 9 (")));
  EXPECT_GT(robust.posterior.observations().front().noise().scale()(1, 7), 1e4);
  EXPECT_THAT(distrust_notes(problem_of(gappy_log_of({})), robust.report), testing::IsEmpty());
}

}  // namespace
}  // namespace gp2
