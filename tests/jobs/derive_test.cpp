#include "gp2/jobs/derive.hpp"

#include <cmath>
#include <functional>
#include <numbers>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "input_error.hpp"
#include "smoothing/simulated_logs.hpp"
#include "test_models.hpp"

namespace gp2::test {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::Contains;
using testing::Each;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

const std::vector<std::array<double, 4>> two_starts = {{3.5, 3.6, 0, 0}, {3.0, 2.5, 1, -1}};

const Model& pendulum() { return model("models/double_pendulum.toml"); }

SimulatedLog short_log(const std::vector<std::array<double, 4>>& starts = two_starts) {
  return simulated_log(pendulum(), starts, 0.5, {2e-5, 1e-5, 0, 0}, 1);
}

/// A cart on a rail, driven: nothing constrains it.
const Model& cart() {
  static const Model file = Model::parse(R"(
name = "cart"
coordinates = ["q1"]
inputs = ["u1"]
[mechanics]
mass = [["1"]]
force = ["u1"]
[[latent]]
name = "rest"
kernel = "se"
features = ["q1", "dq1", "u1"]
directions = "force"
)",
                                         "cart.toml");
  return file;
}

/// Header "t,q1" and rows of sin(3t) at 100 Hz, changed by `edit`.
using Row = std::vector<std::string>;
CsvTable cart_log(
    const std::function<void(std::vector<Row>&)>& edit = [](auto&) {}, std::vector<std::string> header = {"t", "q1"},
    int n = 200) {
  std::vector<Row> rows;
  RandomStream random(1);
  for (int k = 0; k < n; ++k) rows.push_back({shortest(k / 100.0), shortest(std::sin(3 * k / 100.0) + 1e-4 * random.normal())});
  edit(rows);
  std::vector<std::string> cells;
  for (const Row& row : rows) cells.insert(cells.end(), row.begin(), row.end());
  return CsvTable::from_cells("log.csv", std::move(header), std::move(cells));
}

TEST(Derive, CompletesDependentCoordinatesFromTheConstraints) {
  const SimulatedLog log = short_log();
  const DerivedData data = derive(pendulum(), log.table);
  const System& system = *pendulum().system;
  EXPECT_THAT(data.measured, ElementsAre(2, 5));
  EXPECT_THAT(data.completed, ElementsAre(0, 1, 3, 4));
  EXPECT_THAT(data.independent, ElementsAre(2, 5));
  EXPECT_THAT(data.notes, Contains(HasSubstr("from the constraints: q1, q2, q4, q5")));
  EXPECT_EQ(data.states.cols(), 500);
  const VectorXd parameters = system.parameter_values();
  EXPECT_LE(test::largest(system.residuals(data.states, parameters)), 1e-12);
  const SystemValues values = system.evaluate(data.states, parameters);
  for (int i = 0; i < data.states.cols(); ++i) {
    EXPECT_LE(test::largest(values.A(i) * data.accelerations.col(i) - values.b(i)), 1e-11);
  }
  // and they are those of the motion
  const Trajectory& truth = log.episodes[1];
  for (Index i = 20; i < 230; ++i) {
    EXPECT_LE(test::largest(data.states.col(250 + i).head(12) - truth.states.col(i).head(12)), 0.01);
    EXPECT_LE(test::largest(data.accelerations.col(250 + i) - truth.accelerations.col(i)), 1.5);
  }
}

TEST(Derive, TableHasADeviationForWhatWasMeasured) {
  const SimulatedLog log = short_log();
  const DerivedData data = derive(pendulum(), log.table);
  const CsvTable table = as_table(data, *pendulum().system, "data.csv");
  EXPECT_THAT(table.header(), ElementsAre("episode", "t", "q1", "q2", "q3", "q4", "q5", "q6", "dq1", "dq2", "dq3", "dq4", "dq5",
                                          "dq6", "ddq1", "ddq2", "ddq3", "ddq4", "ddq5", "ddq6", "q3_std", "q6_std", "dq3_std",
                                          "dq6_std", "ddq3_std", "ddq6_std"));
  EXPECT_EQ(table.cell(250, 0), "1");
  EXPECT_EQ(table.number(3, 1), 0.006);
  EXPECT_EQ(table.number(7, table.find("ddq6")), data.accelerations(5, 7));
  EXPECT_EQ(table.number(7, table.find("dq3_std")), data.stddev(6 + 2, 7));
}

TEST(Derive, APositionThatJumpsAndStaysIsSaid) {
  const auto notes_of = [](const std::function<void(std::vector<Row>&)>& edit) { return derive(cart(), cart_log(edit)).notes; };
  const auto shifted = [](std::vector<Row>& rows, std::size_t from, double by) {
    for (std::size_t k = from; k < rows.size(); ++k) rows[k][1] = shortest(std::stod(rows[k][1]) + by);
  };
  EXPECT_THAT(notes_of([&](auto& rows) { shifted(rows, 120, 0.7); }),
              Contains(HasSubstr("log.csv: q1 jumps by 0.673 at t = 1.2 and stays there: was its encoder set anew?")));
  EXPECT_THAT(notes_of([&](auto& rows) {
                shifted(rows, 120, 0.7);
                for (std::size_t k = 60; k < 120; ++k) rows[k][1] = rows[60][1];
              }),
              Contains(HasSubstr("after 60 equal samples: was its sensor stuck?")));
  // sound: single errors, coarse steps, a gap, a burst of samples close in time
  const std::vector<std::function<void(std::vector<Row>&)>> sound = {
      [](auto&) {}, [](auto& rows) { rows[100][1] = "3"; },
      [](auto& rows) {
        for (Row& row : rows) row[1] = shortest(std::round(std::stod(row[1]) / 0.05) * 0.05);
      },
      [](auto& rows) { rows.erase(rows.begin() + 50, rows.begin() + 90); },
      [](auto& rows) {
        for (std::size_t k = 1; k < rows.size(); k += 20) rows[k][0] = shortest(std::stod(rows[k - 1][0]) + 1e-6);
      }};
  for (const auto& edit : sound) EXPECT_THAT(notes_of(edit), testing::Not(Contains(HasSubstr("jumps by"))));
}

TEST(Derive, AnAngleThatWrapsAndIsNotSaidToBeOneIsNamed) {
  const auto notes_of = [](double by) {
    return derive(cart(), cart_log([&](std::vector<Row>& rows) {
                    for (std::size_t k = 120; k < rows.size(); ++k) rows[k][1] = shortest(std::stod(rows[k][1]) + by);
                  }))
        .notes;
  };
  const auto wraps = Contains(HasSubstr("about a whole turn: if it is an angle that wraps, write angle = true in the model"));
  EXPECT_THAT(notes_of(2 * std::numbers::pi), wraps);
  EXPECT_THAT(notes_of(-2 * std::numbers::pi), wraps);
  EXPECT_THAT(notes_of(3), Not(wraps));
}

// Where a slide turns round, two postures of its crank meet.
TEST(Derive, AtADeadCentreSaysWhatToLog) {
  const Model crank = Model::parse(R"toml(
name = "crank"
coordinates = [{ name = "phi", angle = true }, "x"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
position = ["x - cos(phi)"]
[sampling]
start = { phi = 1.0, x = 0.5 }
[[latent]]
name = "rest"
kernel = "se"
features = ["dphi"]
directions = "force"
)toml",
                                   "crank.toml");
  const CsvTable log = cart_log(
      [](std::vector<Row>& rows) {
        for (std::size_t k = 0; k < rows.size(); ++k) rows[k][1] = shortest(1.001 * std::cos(1 + 0.03 * static_cast<double>(k)));
      },
      {"t", "x"});
  try {
    derive(crank, log);
    FAIL() << "phi follows";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(), testing::AllOf(testing::StartsWith("log.csv: near t = "),
                                             HasSubstr(" the constraints do not determine phi from x: a dead centre, or "),
                                             testing::EndsWith("). Log phi too, or another coordinate")));
  }
}

TEST(Derive, SameBitsForAnyNumberOfThreads) {
  const SimulatedLog log = short_log();
  const DerivedData one = derive(pendulum(), log.table, {.n_threads = 1}),
                    three = derive(pendulum(), log.table, {.n_threads = 3});
  EXPECT_EQ(as_table(one, *pendulum().system, "").n_rows(), 500);
  EXPECT_EQ(one.accelerations, three.accelerations);
  EXPECT_EQ(one.states.topRows(13), three.states.topRows(13));
}

TEST(Derive, ConstraintsAmongMeasuredCoordinatesAreHeldAndMakeThemMoreExact) {
  // all six coordinates measured, the positions with 1e-4 m of noise
  const SimulatedLog simulated = short_log();
  const System& system = *pendulum().system;
  RandomStream random(2);
  std::vector<std::string> cells;
  const Trajectory& truth = simulated.episodes[0];
  for (Index i = 0; i < truth.times.size(); ++i) {
    cells.push_back(shortest(truth.times[i]));
    for (int j = 0; j < 6; ++j) cells.push_back(shortest(truth.states(j, i) + 1e-4 * random.normal()));
  }
  const CsvTable log = CsvTable::from_cells("log", {"t", "q1", "q2", "q3", "q4", "q5", "q6"}, cells);
  const DerivedData free = derive(pendulum(), log), held = derive(pendulum(), log, {.hold_constraints = true});
  EXPECT_THAT(free.independent, ElementsAre(0, 1, 2, 3, 4, 5));
  EXPECT_THAT(free.notes,
              Contains(HasSubstr(
                  "4 of the constraints hold among the measured coordinates alone: `hold_constraints` makes use of that")));
  // two in each row, which ones may change
  EXPECT_EQ(held.is_independent.cast<int>().colwise().sum().minCoeff(), 2);
  EXPECT_EQ(held.is_independent.cast<int>().colwise().sum().maxCoeff(), 2);
  const CsvTable table = as_table(held, system, "held.csv");
  for (const int j : held.independent) {
    const std::string name = system.acceleration_names()[static_cast<std::size_t>(j)] + "_std";
    for (const int row : {0, 100, 200}) EXPECT_EQ(table.is_empty(row, table.find(name)), !held.is_independent(j, row));
  }
  // and nobody who learns from them is told to choose two
  for (const Finding& finding : check(pendulum(), &table))
    EXPECT_THAT(finding.text, Not(HasSubstr("are independent measurements")));
  FitRequest request;
  request.model = pendulum();
  request.logs = {{table}};
  EXPECT_THAT(prepare_fit(std::move(request)).problem.notes, Not(Contains(HasSubstr("to rounding"))));

  const VectorXd parameters = system.parameter_values();
  EXPECT_GT(test::largest(system.residuals(free.states, parameters)), 1e-6);
  EXPECT_LE(test::largest(system.residuals(held.states, parameters)), 1e-11);
  const SystemValues values = system.evaluate(held.states, parameters);
  for (int i = 0; i < held.states.cols(); ++i)
    EXPECT_LE(test::largest(values.A(i) * held.accelerations.col(i) - values.b(i)), 1e-8);

  const auto inner = [](const MatrixXd& all) { return all.middleCols(15, all.cols() - 30); };
  EXPECT_LT(inner(held.accelerations - truth.accelerations).norm(), 0.8 * inner(free.accelerations - truth.accelerations).norm());
  // the deviations fell, and still hold the truth
  const MatrixXd stddev = inner(held.stddev.bottomRows(6)), error = inner(held.accelerations - truth.accelerations);
  EXPECT_LT(stddev.sum(), inner(free.stddev.bottomRows(6)).sum());
  EXPECT_GE((error.array().abs() <= 1.96 * stddev.array()).cast<double>().mean(), 0.85);
}

TEST(Derive, OfRedundantAndMissingCoordinatesTheConstraintsAreHeld) {
  const SimulatedLog simulated = short_log();
  std::vector<std::string> cells;
  const Trajectory& truth = simulated.episodes[0];
  RandomStream random(3);
  for (Index i = 0; i < truth.times.size(); ++i) {
    cells.push_back(shortest(truth.times[i]));
    for (const int j : {0, 2, 5}) cells.push_back(shortest(truth.states(j, i) + 1e-5 * random.normal()));
  }
  const CsvTable log = CsvTable::from_cells("log", {"t", "q1", "q3", "q6"}, cells);
  const DerivedData held = derive(pendulum(), log, {.hold_constraints = true});
  EXPECT_LE(test::largest(pendulum().system->residuals(held.states, pendulum().system->parameter_values())), 1e-11);
  EXPECT_LE(test::largest(held.states.col(100).head(12) - truth.states.col(100).head(12)), 0.01);
  EXPECT_THAT([&] { derive(pendulum(), log); },
              testing::ThrowsMessage<InputError>(
                  HasSubstr("1 of the constraints holds among the measured coordinates alone, which noise contradicts, "
                            "so that q2, q4, q5 cannot be solved for; hold the constraints (`hold_constraints`)")));
}

// Its third constraint follows from the two others where these are met, and nowhere else.
TEST(Derive, NoiseDoesNotMakeARedundantConstraintAnother) {
  const Model& crank = model("models/slider_crank.toml");
  for (const double noise : {1e-5, 1e-3, 1e-2}) {
    SCOPED_TRACE(noise);
    RandomStream random(5);
    std::vector<std::string> cells;
    std::vector<Eigen::Vector3d> truth;
    for (int k = 0; k < 200; ++k) {
      const double t = 0.005 * k, q1 = 0.4 + 3 * t, q2 = -std::asin(std::sin(q1) / 3);
      truth.emplace_back(q1, q2, 0.1 * std::cos(q1) + 0.3 * std::cos(q2));
      cells.push_back(shortest(t));
      for (int j = 0; j < 3; ++j) cells.push_back(shortest(truth.back()[j] + (j == 2 ? 0.1 : 1) * noise * random.normal()));
      cells.emplace_back("0");
    }
    const CsvTable log = CsvTable::from_cells("log", {"t", "q1", "q2", "q3", "u1"}, cells);
    const DerivedData held = derive(crank, log, {.hold_constraints = true});
    EXPECT_LE(test::largest(crank.system->residuals(held.states, crank.system->parameter_values())), 1e-11);
    ASSERT_EQ(held.states.cols(), std::ssize(truth));
    for (Index i = 0; i < held.states.cols(); ++i) {
      EXPECT_LE(std::abs(held.states(0, i) - truth[static_cast<std::size_t>(i)][0]), 4 * noise);
      EXPECT_LE(std::abs(held.states(2, i) - truth[static_cast<std::size_t>(i)][2]), 0.4 * noise);
    }
  }
}

/// The first motion of short_log with some of its positions measured, with noise, and of those q1 off by some.
CsvTable log_of_many(const std::vector<int>& measured, double noise_stddev, double off = 0, double unit = 1) {
  static const SimulatedLog simulated = short_log();
  const Trajectory& truth = simulated.episodes[0];
  RandomStream random(7);
  std::vector<std::string> header = {"t"}, cells;
  for (const int j : measured) header.push_back(fmt::format("q{}", j + 1));
  for (Index i = 0; i < truth.times.size(); ++i) {
    cells.push_back(shortest(truth.times[i]));
    for (const int j : measured) {
      const double value = truth.states(j, i) + noise_stddev * random.normal() + (j == 0 ? off : 0);
      cells.push_back(shortest(j == 0 ? unit * value : value));
    }
  }
  return CsvTable::from_cells("log", std::move(header), cells);
}

const auto contradicts = HasSubstr("contradict the constraints");  // NOLINT(cert-err58-cpp)

TEST(Derive, SaysThatMeasuredCoordinatesContradictAConstraint) {
  const std::vector<int> all = {0, 1, 2, 3, 4, 5}, upper = {0, 1, 2};
  constexpr double noise = 1e-4;
  for (const bool hold : {false, true}) {
    for (const double sound : {0.0, 1e-6, noise, 1e-2})
      EXPECT_THAT(derive(pendulum(), log_of_many(all, sound), {.hold_constraints = hold}).notes, Each(Not(contradicts))) << sound;
    // an encoder's zero, and millimetres
    for (const CsvTable& log : {log_of_many(all, noise, 10 * noise), log_of_many(all, noise, 0, 1000)}) {
      DerivedData data;
      try {
        data = derive(pendulum(), log, {.hold_constraints = hold});
      } catch (const NumericalError& error) {
        EXPECT_THAT(error.what(), HasSubstr("do not meet the constraints"));
        continue;
      }
      EXPECT_THAT(data.notes, Contains(contradicts));
      EXPECT_THAT(data.notes, Each(Not(HasSubstr("makes use of that"))));
    }
  }
  const auto fault = [](const CsvTable& log) { return input_error_of([&] { derive(pendulum(), log); }); };
  const std::vector<int> some = {0, 2, 5};
  EXPECT_THAT(fault(log_of_many(some, noise)), HasSubstr("which noise contradicts, so that q2, q4, q5 cannot be solved for"));
  // a warning that may tell why is not lost
  std::vector<std::string> cells;
  const CsvTable whole = log_of_many(some, noise);
  for (int i = 0; i < whole.n_rows(); ++i) {
    for (int k = 0; k < 4; ++k) cells.push_back(whole.cell(k == 1 && i > 100 && i < 140 ? 100 : i, k));
  }
  EXPECT_THAT(fault(CsvTable::from_cells("log", whole.header(), cells)),
              testing::AllOf(HasSubstr("cannot be solved for"), HasSubstr("\nwarning: log: q1 jumps by "),
                             HasSubstr("after 40 equal samples: was its sensor stuck?")));
  // one constraint: how far each alone would have to move
  EXPECT_THAT(fault(log_of_many(some, noise, 100 * noise)),
              testing::AllOf(HasSubstr("log: q2, q4, q5 cannot be solved for: measured coordinates contradict the constraints "
                                       "among them, by "),
                             HasSubstr("; to meet them one would have to move, q1 by 0.01 or q3 by "),
                             HasSubstr(": are their units, signs and zeros, and the lengths, those of the model?")));
}

TEST(Derive, TellsAClockThatIsCoarserThanTheSamplesFromSecondMeasurements) {
  const auto coarse = HasSubstr("the clock is coarser than the samples");
  const auto ticks = [](std::vector<Row>& rows) {
    for (std::size_t k = 0; k < rows.size(); ++k) rows[k][0] = shortest(0.02 * static_cast<double>(k / 2));
  };
  const DerivedData late = derive(cart(), cart_log(ticks));
  EXPECT_THAT(late.notes, Contains(HasSubstr("warning: log.csv: the clock is coarser than the samples: 98 samples have the time "
                                             "of the one before, although q1 moved in between, by about 0.01 s; log times")));
  EXPECT_EQ(late.series[0].outliers, 0);
  for (Index i = 10; i < 90; ++i)
    EXPECT_NEAR(late.accelerations(0, i), -9 * std::sin(3 * (0.02 * static_cast<double>(i) + 0.005)), 1);
  RandomStream random(5);
  const DerivedData twice = derive(cart(), cart_log([&](std::vector<Row>& rows) {
                                     std::vector<Row> all;
                                     for (const Row& row : rows) {
                                       all.push_back(row);
                                       all.push_back({row[0], shortest(std::stod(row[1]) + 1e-4 * random.normal())});
                                     }
                                     rows = all;
                                   }));
  EXPECT_THAT(twice.notes, Each(Not(coarse)));
  EXPECT_EQ(twice.series[0].outliers, 0);
  EXPECT_THAT(derive(cart(), cart_log()).notes, Each(Not(coarse)));
}

TEST(Derive, TellsAClockThatIsNotThatOfTheSamples) {
  constexpr double step = 0.02, noise = 2e-4;
  const auto notes_of = [&](double jitter, bool is_true, bool drops, double noise_stddev) {
    RandomStream random(3);
    std::vector<std::string> cells;
    for (int k = 0; k < 300; ++k) {
      const double even = step * k, stamp = even + std::clamp(jitter * random.normal(), -0.4 * step, 0.4 * step);
      const double t = is_true ? stamp : even, q = std::sin(3 * t) + 0.5 * std::sin(7.3 * t) + noise_stddev * random.normal();
      if (drops && k % 50 > 47) continue;
      cells.push_back(shortest(stamp));
      cells.push_back(shortest(q));
    }
    return derive(cart(), CsvTable::from_cells("log.csv", {"t", "q1"}, cells)).notes;
  };
  const auto told =
      Contains(HasSubstr("warning: log.csv: the times are not those of the samples: at times 0.02 s apart, from which"));
  const auto silent = Each(Not(HasSubstr("not those of the samples")));
  EXPECT_THAT(notes_of(0.004, false, false, noise), told);
  EXPECT_THAT(notes_of(0.002, false, true, noise), told) << "samples dropped by whole steps";
  for (const bool drops : {false, true}) {
    for (const double jitter : {0.0, 1e-6, 0.0005, 0.002, 0.005}) {
      for (const double noise_stddev : {0.0, 1e-6, noise, 0.01})
        EXPECT_THAT(notes_of(jitter, true, drops, noise_stddev), silent) << jitter << " " << drops << " " << noise_stddev;
    }
  }
  EXPECT_THAT(notes_of(0.002, false, false, 0.1), silent) << "noise hides it";
}

TEST(Derive, GapsMissingCellsAndRepeatedRowsAreCountedAndBridged) {
  const CsvTable log = cart_log([](std::vector<Row>& rows) {
    rows.erase(rows.begin() + 100, rows.begin() + 110);
    rows[20][1] = "";
    rows[21][1] = "NaN";
    rows.insert(rows.begin() + 50, rows[50]);  // all the same
    rows.insert(rows.begin() + 60, {rows[60][0], "0.9737"});
  });
  const DerivedData data = derive(cart(), log);
  ASSERT_EQ(data.series.size(), 1U);
  const DerivedSeries& series = data.series[0];
  EXPECT_EQ(series.missing, 2);
  EXPECT_EQ(series.repeated, 1);
  EXPECT_EQ(series.gaps, 1);
  EXPECT_NEAR(series.longest_gap, 0.11, 1e-9);
  EXPECT_EQ(data.states.cols(), 190);
  EXPECT_NEAR(data.states(0, 20), std::sin(0.6), 2e-4);
  EXPECT_NEAR(data.states(1, 21), 3 * std::cos(0.63), 0.02);
  // beside the gap less is known
  EXPECT_GT(data.stddev(0, 100), 1.2 * data.stddev(0, 70));
}

TEST(Derive, RowsAtAnEvenRateGoThroughGaps) {
  const CsvTable log = cart_log([](std::vector<Row>& rows) { rows.erase(rows.begin() + 100, rows.begin() + 110); });
  const DerivedData data = derive(cart(), log, {.rate = 50});
  ASSERT_EQ(data.states.cols(), 100);
  EXPECT_EQ(data.states(2, 53), 1.06);
  EXPECT_NEAR(data.states(0, 53), std::sin(3 * 1.06), 1e-3);
  EXPECT_GT(data.stddev(0, 52), data.stddev(0, 40));
  EXPECT_EQ(derive(cart(), log, {.every = 4}).states.cols(), 48);
}

const Model& wheel() {
  static const Model file = Model::parse(R"(
name = "wheel"
coordinates = [{ name = "q1", angle = true }]
[mechanics]
mass = [["1"]]
force = ["0"]
[[latent]]
name = "rest"
kernel = "se"
features = ["dq1"]
directions = "force"
)",
                                         "wheel.toml");
  return file;
}

TEST(Derive, WrappedAnglesAreUnwrapped) {
  const CsvTable log = cart_log([](std::vector<Row>& rows) {
    for (std::size_t k = 0; k < rows.size(); ++k) {
      const double angle = 8 * 0.01 * static_cast<double>(k);
      rows[k][1] = shortest(std::remainder(angle, 2 * std::numbers::pi));
    }
  });
  const DerivedData data = derive(wheel(), log);
  EXPECT_EQ(data.series[0].wraps, 3);
  EXPECT_EQ(data.series[0].outliers, 0);
  for (Index i = 0; i < data.states.cols(); ++i) EXPECT_NEAR(data.states(1, i), 8, 0.01);
}

// all noise is that of the times
TEST(Derive, NoiseOfTheTimesCountsForWhatIsToldOfTheNoise) {
  RandomStream random(4);
  const CsvTable log = cart_log(
      [&](std::vector<Row>& rows) {
        for (std::size_t k = 0; k < rows.size(); ++k) {
          const double t = 0.01 * static_cast<double>(k) + 2e-4 * random.normal();
          rows[k][1] = shortest(8 * t + 5 * std::sin(1.5 * t));
        }
      },
      {"t", "q1"}, 1000);
  const DerivedSeries series = derive(cart(), log).series[0];
  EXPECT_NEAR(series.model.time_stddev, 2e-4, 4e-5);
  EXPECT_FALSE(series.noise_unseen);
  EXPECT_LT(series.bandwidth, 0.7 * bandwidth_of(series.model, 0.01));
}

TEST(Derive, AnAngleThatIsOffByHalfATurnOnceIsAnOutlier) {
  for (const double turn : {std::numbers::pi, -std::numbers::pi}) {
    const DerivedData data =
        derive(wheel(), cart_log([&](std::vector<Row>& rows) { rows[80][1] = shortest(std::stod(rows[80][1]) + turn); }));
    EXPECT_EQ(data.series[0].outliers, 1);
    for (Index i = 0; i < data.states.cols(); ++i) EXPECT_NEAR(data.states(0, i), std::sin(0.03 * static_cast<double>(i)), 1e-3);
  }
  // degrees, and no angle in rad
  const CsvTable degrees = cart_log([](std::vector<Row>& rows) {
    for (std::size_t k = 0; k < rows.size(); ++k) rows[k][1] = shortest(std::fmod(73.0 * static_cast<double>(k), 360));
  });
  EXPECT_THAT(derive(wheel(), degrees).notes,
              Contains(HasSubstr("warning: log.csv: column 'q1' moves by more than half a turn between")));
}

TEST(Derive, AnAngleInDegreesThatIsWrappedIsRefused) {
  const CsvTable log = cart_log([](std::vector<Row>& rows) {
    for (std::size_t k = 0; k < rows.size(); ++k) rows[k][1] = shortest(std::remainder(4.6 * static_cast<double>(k), 360));
  });
  EXPECT_THAT(test::input_error_of([&] { derive(wheel(), log); }),
              HasSubstr("column 'q1' jumps by 360 from sample to sample: it is in degrees"));
}

TEST(Derive, AWrongFirstOrLastSampleIsLeftOut) {
  for (const std::size_t at : {std::size_t{0}, std::size_t{199}}) {
    const DerivedData data = derive(cart(), cart_log([&](std::vector<Row>& rows) { rows[at][1] = "0.4"; }));
    EXPECT_EQ(data.series[0].outliers, 1);
    const DerivedData clean = derive(cart(), cart_log());
    EXPECT_EQ(clean.series[0].outliers, 0);
    EXPECT_LE((data.accelerations - clean.accelerations).cwiseAbs().middleCols(5, 190).maxCoeff(), 0.1);
  }
}

TEST(Derive, TimesMayCountSmallerUnits) {
  const DerivedData seconds = derive(cart(), cart_log());
  for (const auto& [factor, word] :
       {std::pair(1e3, "milliseconds"), std::pair(1e6, "microseconds"), std::pair(1e9, "nanoseconds")}) {
    const CsvTable log = cart_log([&, factor = factor](std::vector<Row>& rows) {
      for (std::size_t k = 0; k < rows.size(); ++k) rows[k][0] = shortest(factor * 0.01 * static_cast<double>(k));
    });
    const DerivedData data = derive(cart(), log);
    EXPECT_THAT(data.notes, Contains(HasSubstr(fmt::format("column 't' is assumed to be in {}", word))));
    EXPECT_LE((data.accelerations - seconds.accelerations).cwiseAbs().maxCoeff(), 1e-5);
    EXPECT_NEAR(derive(cart(), log, {.time_unit = TimeUnit::seconds}).states(2, 199), factor * 1.99, 1e-6 * factor);
  }
}

TEST(Derive, PartsBetweenPausesAreSmoothedByThemselves) {
  const auto paused = [](std::size_t from, double pause) {
    return cart_log([=](std::vector<Row>& rows) {
      for (std::size_t k = from; k < rows.size(); ++k) rows[k][0] = shortest(0.01 * static_cast<double>(k) + pause);
    });
  };
  const DerivedData day = derive(cart(), paused(120, 86400));
  EXPECT_THAT(day.notes, Contains(HasSubstr("warning: log.csv: column 't' pauses once, for 8.64e+04 s at most: each part")));
  ASSERT_EQ(day.series.size(), 2U);
  EXPECT_EQ(day.states.cols(), 200);
  for (Index i = 0; i < 200; ++i) EXPECT_NEAR(day.accelerations(0, i), -9 * std::sin(0.03 * static_cast<double>(i)), 1.5) << i;
  EXPECT_EQ(derive(cart(), paused(120, 86400), {.rate = 100}).states.cols(), 200) << "nothing is written of the pause";
  // a clock that is set after three rows
  const DerivedData late = derive(cart(), paused(3, 1.7e9));
  EXPECT_EQ(late.states.cols(), 197);
  EXPECT_THAT(late.notes, Contains(HasSubstr("; 3 rows of parts that are too short, or where nothing moves, are left out")));
  EXPECT_NEAR(late.accelerations(0, 97), -9 * std::sin(3.0), 0.2);
  // a part at rest, however its one value is written
  const DerivedData rest = derive(cart(), cart_log([](std::vector<Row>& rows) {
                                    for (std::size_t k = 0; k < rows.size(); ++k) {
                                      rows[k][0] = shortest(0.01 * static_cast<double>(k) + (k < 20 ? 0 : 86400));
                                      if (k < 20) rows[k][1] = k % 2 == 0 ? "0.5" : "0.50";
                                    }
                                  }));
  EXPECT_EQ(rest.states.cols(), 180);
  EXPECT_THAT(rest.notes, Contains(HasSubstr("; 20 rows of parts that are too short, or where nothing moves, are left out")));
}

TEST(Derive, VelocitiesOfTheLogAreUsed) {
  RandomStream random(4);
  const auto with_velocity = [&](std::vector<Row>& rows) {
    for (std::size_t k = 0; k < rows.size(); ++k)
      rows[k].push_back(shortest(3 * std::cos(0.03 * static_cast<double>(k)) + 1e-4 * random.normal()));
  };
  const DerivedData without = derive(cart(), cart_log());
  const DerivedData with = derive(cart(), cart_log(with_velocity, {"t", "q1", "qd1"}));
  EXPECT_LT(with.stddev.row(2).mean(), 0.5 * without.stddev.row(2).mean());
  EXPECT_NEAR(with.accelerations(0, 50), -9 * std::sin(1.5), 0.05);
  EXPECT_THAT(with.notes, Contains("column 'qd1' taken as dq1"));
}

TEST(Derive, VelocitiesThatAreNoRatesAreLeftOutAndSaid) {
  const DerivedData without = derive(cart(), cart_log());
  for (const double factor : {180 / std::numbers::pi, -1.0}) {
    const DerivedData with =
        derive(cart(), cart_log(
                           [&](std::vector<Row>& rows) {
                             for (std::size_t k = 0; k < rows.size(); ++k)
                               rows[k].push_back(shortest(factor * 3 * std::cos(0.03 * static_cast<double>(k))));
                           },
                           {"t", "q1", "dq1"}));
    EXPECT_THAT(with.notes, Contains(HasSubstr("warning: log.csv: dq1 is not the rate of q1 over t: the rate is ")));
    EXPECT_TRUE(with.accelerations == without.accelerations);
    EXPECT_FALSE(with.series.front().has_velocities);
  }
}

// the root mean square by which derived positions of cart_log are off, in deviations
double error_in_deviations(const DerivedData& data) {
  double sum = 0;
  for (Index i = 0; i < data.states.cols(); ++i)
    sum += std::pow((data.states(0, i) - std::sin(3 * data.states(2, i))) / data.stddev(0, i), 2);
  return std::sqrt(sum / static_cast<double>(data.states.cols()));
}

TEST(Derive, AValueThatIsHeldForSeveralRowsIsOneSample) {
  for (const std::size_t held : {2U, 4U}) {
    const DerivedData data = derive(cart(), cart_log([&](std::vector<Row>& rows) {
                                      for (std::size_t k = 0; k < rows.size(); ++k) rows[k][1] = rows[k - k % held][1];
                                    }));
    EXPECT_THAT(data.notes, Contains(HasSubstr(fmt::format("each value stands in {} rows", held))));
    EXPECT_LT(error_in_deviations(data), 2);
  }
  // an encoder's steps are no such thing
  const DerivedData coarse = derive(cart(), cart_log([](std::vector<Row>& rows) {
                                      for (Row& row : rows) row[1] = shortest(std::round(std::stod(row[1]) / 0.05) * 0.05);
                                    }));
  EXPECT_EQ(coarse.series.front().repeated, 0);
}

TEST(Derive, AStuckSensorIsSaidAlsoWhereItStaysSo) {
  const auto notes = derive(cart(), cart_log([](std::vector<Row>& rows) {
                              for (std::size_t k = 150; k < rows.size(); ++k) rows[k][1] = rows[149][1];
                            }))
                         .notes;
  EXPECT_THAT(notes, Contains(HasSubstr("q1 is the same in 51 samples, from t = 1.49 to 1.99, although it has noise")));
}

TEST(Derive, WrongAndMissingValuesOfAnInputAreSaid) {
  const auto notes_of = [](const std::function<void(std::vector<Row>&)>& edit) {
    return derive(cart(), cart_log(
                              [&](std::vector<Row>& rows) {
                                for (std::size_t k = 0; k < rows.size(); ++k)
                                  rows[k].push_back(shortest(std::sin(0.05 * static_cast<double>(k))));
                                edit(rows);
                              },
                              {"t", "q1", "u1"}))
        .notes;
  };
  EXPECT_THAT(notes_of([](auto&) {}), testing::Not(Contains(HasSubstr("input"))));
  EXPECT_THAT(notes_of([](auto& rows) { rows[77][2] = "500"; }),
              Contains(HasSubstr("single values of the input u1 lie far from all "
                                 "others: 500 at row 78")));
  EXPECT_THAT(notes_of([](auto& rows) {
                rows.insert(rows.begin() + 78, Row{rows[77][0], "", "500"});
                rows[77][2] = "";
              }),
              Contains(HasSubstr("others: 500 at row 79")))
      << "the second row of one time";
  EXPECT_THAT(notes_of([](auto& rows) {
                for (std::size_t k = 120; k < rows.size(); ++k) rows[k][2] = "";
              }),
              Contains(HasSubstr("warning: log.csv: the input u1 has no value for 0.8 s, from t = 1.19 on")));
}

TEST(Derive, TheUsualStepIsThatOfThePositionsWhereOtherColumnsHaveRowsOfTheirOwn) {
  const DerivedData data = derive(cart(), cart_log(
                                              [](std::vector<Row>& rows) {
                                                std::vector<Row> joined;
                                                for (const Row& row : rows) {
                                                  joined.push_back({row[0], row[1], ""});
                                                  joined.push_back({shortest(std::stod(row[0]) + 4e-6), "", "1"});
                                                }
                                                rows = joined;
                                              },
                                              {"t", "q1", "u1"}));
  EXPECT_LT(error_in_deviations(data), 2);
  EXPECT_THAT(data.notes, testing::Not(Contains(HasSubstr("warning"))));
}

TEST(Derive, ColumnsThatAreNotReadAreNamed) {
  const DerivedData data = derive(cart(),
                                  cart_log(
                                      [](std::vector<Row>& rows) {
                                        for (Row& row : rows) row.insert(row.end(), {"1", "2"});
                                      },
                                      {"t", "q1", "w1", "mark"}),
                                  {.keep = {"mark"}});
  EXPECT_THAT(data.notes, Contains("log.csv: columns not needed: w1"));
}

TEST(Derive, WhatIsKeptMayStandInRowsOfItsOwn) {
  const DerivedData data = derive(cart(),
                                  cart_log(
                                      [](std::vector<Row>& rows) {
                                        std::vector<Row> joined;
                                        for (const Row& row : rows) {
                                          joined.push_back({row[0], row[1], ""});
                                          joined.push_back({row[0], "", row[0] + " s"});
                                        }
                                        rows = joined;
                                      },
                                      {"t", "q1", "mark"}),
                                  {.keep = {"mark"}});
  ASSERT_EQ(data.kept[0].size(), 200U);
  EXPECT_EQ(data.kept[0][0], "0 s");
  EXPECT_EQ(data.kept[0][150], "1.5 s");
  EXPECT_EQ(data.lines[150], 302);
}

TEST(Derive, InputsGoThroughTheFilterOfThePositions) {
  // where the input is the position itself, so is what the filter makes of it
  const CsvTable log = cart_log(
      [](std::vector<Row>& rows) {
        for (Row& row : rows) row.push_back(row[1]);
      },
      {"t", "q1", "tau1"});
  const DerivedData data = derive(cart(), log);
  for (Index i = 0; i < data.states.cols(); ++i) EXPECT_NEAR(data.states(3, i), data.states(0, i), 1e-9);
  EXPECT_THAT(as_table(data, *cart().system, "").header(),
              ElementsAre("t", "q1", "dq1", "u1", "ddq1", "q1_std", "dq1_std", "ddq1_std"));
  EXPECT_THAT(derive(cart(), cart_log()).notes, Contains("the log has no input u1"));
}

// A heavy slow cart and a light fast one: the filter of the slow one would take away what drives the other.
TEST(Derive, AnInputGoesThroughTheFilterOfWhatItDrives) {
  const Model carts = Model::parse(R"(
name = "two carts"
coordinates = ["x", "y"]
inputs = ["u", "v"]
[mechanics]
mass = [["10", "0"], ["0", "0.8"]]
force = ["u - 10*x", "v - 20*y"]
[[latent]]
features = ["dx"]
directions = "force"
)",
                                   "carts.toml");
  RandomStream random(3);
  std::vector<std::vector<double>> columns(5);
  for (int k = 0; k < 800; ++k) {
    const double t = k / 100.0;
    const std::vector<double> row = {t, std::sin(t) + 3e-4 * random.normal(), 0.1 * std::sin(15 * t) + 3e-5 * random.normal(), 0,
                                     (20 - 0.8 * 225) * 0.1 * std::sin(15 * t)};
    for (std::size_t j = 0; j < 5; ++j) columns[j].push_back(row[j]);
  }
  std::vector<CsvTable::Column> named;
  for (const char* name : {"t", "x", "y", "u", "v"}) named.push_back({name, columns[named.size()]});
  const DerivedData data = derive(carts, CsvTable::from_columns("log.csv", named));
  const auto v = data.states.row(carts.system->layout().u(1));
  const Eigen::Map<const Eigen::RowVectorXd> logged(columns[4].data(), 800);
  EXPECT_LT((v - logged).norm(), 0.01 * logged.norm());
  const auto y = data.states.row(1), ddy = data.accelerations.row(1);
  EXPECT_LT((0.8 * ddy + 20 * y - v).norm(), 0.02 * logged.norm());
}

TEST(Derive, EpisodesAreChosenByWhatTheirColumnSays) {
  const SimulatedLog log = short_log({two_starts[0], two_starts[1], two_starts[0]});
  const DerivedData data = derive(pendulum(), log.table, {.episodes = {"2", "0"}, .keep = {"q6"}, .n_threads = 1});
  EXPECT_THAT(data.episodes, ElementsAre("0", "2"));
  EXPECT_EQ(data.states.cols(), 500);
  EXPECT_EQ(data.kept[0][250], log.table.cell(500, 3));
  EXPECT_EQ(data.states(12, 250), 0);
}

TEST(Derive, AShortEpisodeTakesTheModelOfTheOthers) {
  const CsvTable log = cart_log(
      [](std::vector<Row>& rows) {
        for (std::size_t k = 0; k < rows.size(); ++k) rows[k].push_back(k < 180 ? "long" : "short");
      },
      {"t", "q1", "run"});
  const DerivedData data = derive(cart(), log, {.episode_column = "run"});
  ASSERT_EQ(data.series.size(), 2U);
  EXPECT_FALSE(data.series[0].shared_model);
  EXPECT_TRUE(data.series[1].shared_model);
  EXPECT_EQ(data.series[1].model.lengthscale, data.series[0].model.lengthscale);
  // whatever column names the episodes, other commands read `episode`
  const CsvTable table = as_table(data, *cart().system, "");
  EXPECT_EQ(table.header().front(), "episode");
  EXPECT_EQ(table.cell(180, 0), "short");
}

TEST(Derive, LikeAnotherLogItGoesThroughTheSameFilter) {
  const CsvTable log = cart_log(), slow = cart_log([](std::vector<Row>&rows) {
                                     for (Row& row : rows) row[0] = std::to_string(2 * std::stod(row[0]));
                                     rows[100][1] = "9";
                                   });
  const DerivedData own = derive(cart(), log), slow_own = derive(cart(), slow), like = derive(cart(), slow, {.like = log});
  ASSERT_EQ(like.series.size(), 1U);
  EXPECT_GT(slow_own.series[0].model.lengthscale, 1.5 * own.series[0].model.lengthscale);
  EXPECT_EQ(like.series[0].model.lengthscale, own.series[0].model.lengthscale);
  EXPECT_EQ(like.series[0].model.noise_stddev, own.series[0].model.noise_stddev);
  EXPECT_EQ(like.series[0].outliers, 1);
  // a log is like itself
  EXPECT_EQ(derive(cart(), log, {.like = log}).accelerations, own.accelerations);
}

TEST(Derive, SaysWhatIsWrongWithALog) {
  const auto fault = [](const CsvTable& log, const DeriveOptions& options = {}, const Model& model = cart()) {
    return test::input_error_of([&] { derive(model, log, options); });
  };
  const auto edit = [](auto change) { return cart_log([=](std::vector<Row>& rows) { change(rows); }); };

  EXPECT_THAT(fault(edit([](auto& rows) { std::swap(rows[10][0], rows[11][0]); })),
              HasSubstr("log.csv: column 't': time runs backwards at data row 12: 0.1 after 0.11. Sort the rows, or give the "
                        "column that numbers the episodes"));
  EXPECT_THAT(fault(edit([](auto& rows) {
                for (Row& row : rows) row[0] = "3";
              })),
              HasSubstr("log.csv: column 't': all 200 rows have the time 3; without times there are no velocities"));
  EXPECT_THAT(fault(edit([](auto& rows) { rows.resize(1); })),
              HasSubstr("column 'q1': 1 samples are too few to find a motion in; 5 are needed"));
  EXPECT_THAT(fault(edit([](auto& rows) {
                for (Row& row : rows) row[1] = "2.5";
              })),
              HasSubstr("column 'q1': all 200 values are 2.5: nothing moves, so there is neither velocity nor noise to find"));
  EXPECT_THAT(fault(edit([](auto& rows) {
                for (Row& row : rows) row[1] = "nan";
              })),
              HasSubstr("0 samples are too few"));
  EXPECT_THAT(fault(edit([](auto& rows) { rows[7][1] = "1,5"; })),
              HasSubstr("log.csv: row 8, column 'q1': '1,5' is not a finite number"));
  EXPECT_THAT(fault(edit([](auto& rows) { rows[7][0] = ""; })), HasSubstr("log.csv: row 8, column 't': the cell is empty"));
  EXPECT_THAT(fault(cart_log([](auto&) {}, {"clock", "q1"})),
              HasSubstr("log.csv: missing column 't' (looked for t, time, timestamp, __time)"));
  EXPECT_THAT(
      fault(cart_log([](auto&) {}, {"t", "angle"})),
      HasSubstr(
          "log.csv: no column is a coordinate of 'cart' (q1); the file has: t, angle. Rename them, or give `map=LOGNAME=q1`"));
  EXPECT_THAT(fault(cart_log(), {.episode_column = "run"}), HasSubstr("`episode`: log.csv has no column 'run'; it has: t, q1"));
  EXPECT_THAT(fault(cart_log(), {.episodes = {"3"}}), HasSubstr("`episodes`: log.csv has no column 'episode' to choose from"));
  const CsvTable without_label = cart_log(
      [](std::vector<Row>& rows) {
        for (std::size_t k = 0; k < rows.size(); ++k) rows[k].push_back(k == 7 ? "" : "one");
      },
      {"t", "q1", "run"});
  EXPECT_THAT(fault(without_label, {.episode_column = "run"}),
              HasSubstr("log.csv: row 8, column 'run': the cell is empty: rows without an episode belong to none"));
  EXPECT_THAT(fault(short_log().table, {.episodes = {"7"}}, pendulum()),
              HasSubstr("`episodes`: simulated log has no episode '7'; it has: 0, 1"));
  EXPECT_THAT(fault(cart_log(), {.keep = {"heat"}}), HasSubstr("`keep`: log.csv has no column 'heat'; it has: t, q1"));
  EXPECT_THAT(fault(cart_log(), {.keep = {"q1"}, .rate = 10}),
              HasSubstr("`keep` copies rows of the log, and those of an even `rate` are others"));
  EXPECT_THAT(fault(cart_log(), {.rate = -1}), HasSubstr("`rate`: must not be negative, got -1"));
  EXPECT_THAT(fault(cart_log(), {.rate = 1e9}), HasSubstr("rows; at most 1e+07 are written"));
  EXPECT_THAT(fault(short_log().table, {.like = cart_log([](auto&) {}, {"t", "q3"})}, pendulum()),
              HasSubstr("like: log.csv has no column q6, which simulated log has"));
  EXPECT_THAT(fault(cart_log(), {.every = 0}), HasSubstr("`every`: must be at least 1, got 0"));
  EXPECT_THAT(fault(cart_log(), {.outlier_threshold = -1}), HasSubstr("`outlier_threshold`: must not be negative, got -1"));
  EXPECT_THAT(fault(cart_log(
                  [](auto& rows) {
                    for (Row& row : rows) row.push_back("");
                  },
                  {"t", "q1", "u1"})),
              HasSubstr("column 'u1': there is no value"));

  // of the pendulum's angles one is not there, and nothing decides it
  std::vector<std::string> cells;
  const SimulatedLog simulated = short_log();
  for (int row = 0; row < 250; ++row) {
    cells.push_back(simulated.table.cell(row, 1));
    cells.push_back(simulated.table.cell(row, 2));
  }
  EXPECT_THAT(
      fault(CsvTable::from_cells("one angle.csv", {"t", "q3"}, cells), {}, pendulum()),
      HasSubstr("has no column for q4, q5, q6, and the constraints of 'double pendulum' do not decide them from what it has"));
}

}  // namespace
}  // namespace gp2::test
