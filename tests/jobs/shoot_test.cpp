#include "gp2/jobs/shoot_job.hpp"

#include <cmath>
#include <functional>
#include <numbers>
#include <numeric>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/simulate.hpp"
#include "input_error.hpp"
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

/// A bob on a rod, in the plane: a constraint, a drive, friction to be learned, and a mass and a length that are not known.
Model swing(const std::string& mass, const std::string& load) {
  return Model::parse(fmt::format(R"toml(
name = "swing"
coordinates = ["x", "y", {{ name = "q", angle = true }}]
inputs = ["u"]
[parameters]
m = {}
J = {}
[mechanics]
mass = [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "J"]]
force = ["0", "-9.81*m", "u"]
[constraints]
position = ["x - 0.5*sin(q)", "y + 0.5*cos(q)"]
[[latent]]
name = "bearing"
kernel = "se"
features = ["dq"]
directions = {{ force = [["0"], ["0"], ["1"]] }}
[noise]
ddq = [0.02, 0.02, 0.02]
[truth]
force = ["0", "0", "-0.05*tanh(3*dq) - 0.02*dq"]
)toml",
                                  mass, load),
                      "swing.toml");
}

const Model& truth() {
  static const Model model = swing("0.3", "0.05");
  return model;
}

/// Rows of a motion under a sum of sines, the same for each seed: q and dq with noise, q̈ with its own.
CsvTable motion(double noise_stddev, std::uint64_t seed, Index n = 1500) {
  const System& system = *truth().system;
  const StateLayout layout = system.layout();
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1) / 100);
  options.relative_tolerance = 1e-10;
  options.absolute_tolerance = 1e-12;
  RandomStream random(seed);
  const double phase = 6 * random.uniform();
  const VectorXd t = options.times;
  options.inputs = {t, (0.8 * (2.1 * t.array() + phase).sin() + 0.9 * (0.7 * t.array() + 2 * phase).cos()).matrix().transpose()};
  VectorXd start = VectorXd::Zero(layout.size());
  start[layout.q(2)] = 0.3;
  start = project_onto_constraints(system, system.parameter_values(), start, {});
  const Trajectory out = simulate(system, system.parameter_values(), model_acceleration(truth()), start, options);
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& name, const VectorXd& values, double stddev = 0) {
    std::vector<double> numbers(values.begin(), values.end());
    for (double& one : numbers) one += stddev * random.normal();
    columns.push_back({name, std::move(numbers)});
  };
  add("t", t);
  for (int j = 0; j < 3; ++j) {
    const std::string name = system.coordinates()[static_cast<std::size_t>(j)].name;
    add(name, out.states.row(layout.q(j)), j == 2 ? noise_stddev : 0);
    add("d" + name, out.states.row(layout.dq(j)), j == 2 ? 3 * noise_stddev : 0);
    add("dd" + name, out.accelerations.row(j), 0.02);
  }
  add("u", out.states.row(layout.u(0)));
  add("q_std", VectorXd::Constant(n, std::max(noise_stddev, 1e-6)));
  return CsvTable::from_columns("motion.csv", std::move(columns));
}

/// A log of which one column is wrong.
CsvTable with_column_off(const CsvTable& log, const std::string& name, double factor, double offset) {
  std::vector<CsvTable::Column> columns;
  for (int c = 0; c < static_cast<int>(log.header().size()); ++c) {
    const std::string& here = log.header()[static_cast<std::size_t>(c)];
    std::vector<double> values;
    for (int i = 0; i < log.n_rows(); ++i) values.push_back(here == name ? factor * log.number(i, c) + offset : log.number(i, c));
    columns.push_back({here, std::move(values)});
  }
  return CsvTable::from_columns("wrong.csv", std::move(columns));
}

/// A fit to some rows, in which θ is then put off by a share.
/// @param inducing  variables that it goes through
FitFile fit_of(double off, std::uint64_t seed = 1, std::optional<double> inducing = {}) {
  FitRequest request;
  request.model =
      swing("{ value = 0.25, estimate = true, bounds = [0.05, 2] }", "{ value = 0.08, estimate = true, bounds = [0.005, 1] }");
  request.logs = {{motion(0, seed)}};
  request.problem.observe = {"ddq"};
  request.problem.mean = Prior::Mean::force;
  request.problem.max_points = 150;
  request.inducing = inducing;
  request.hyperparameters = HyperparameterChoice::optimise;
  request.thin = false;
  FitFile file = run_fit(prepare_fit(std::move(request))).file;
  for (Hyperparameter& one : file.report.hyperparameters) {
    if (one.is_system_parameter()) one.value *= 1 + off;
  }
  return file;
}

TEST(Shoot, FindsParametersFromWhichTheMotionComes) {
  const FitFile fit = fit_of(0.2);
  const ShootOutcome out = shoot(fit, motion(0, 1), {.duration = 1});
  EXPECT_TRUE(out.converged);
  EXPECT_EQ(out.n_stretches, 14);
  EXPECT_THAT(out.coordinates, ElementsAre("q"));  // the log has q_std
  ASSERT_EQ(out.parameters.size(), 2U);
  // from a fifth off; the friction is what 150 accelerations tell of it
  EXPECT_NEAR(out.parameters[0].value, 0.3, 0.01 * 0.3);
  EXPECT_NEAR(out.parameters[1].value, 0.05, 0.06 * 0.05);
  EXPECT_LT(out.parameters[0].stddev, 0.015 * 0.3);
  EXPECT_LT(out.rms_after[0], out.rms_before[0] / 20);
  // what is written stands for these parameters
  const FitFile& shot = out.fit;
  EXPECT_EQ(shot.posterior().values().parameters[0], out.parameters[0].value);
  EXPECT_FALSE(shot.report.draws.has_value());
  EXPECT_EQ(shot.report.termination, "parameters by multiple shooting, of a fit that ended so: " + fit.report.termination);
}

TEST(Shoot, WhatIsWrittenOfAFitThroughInducingPointsStandsForTheNewParameters) {
  const FitFile fit = fit_of(0.2, 1, 30);
  ASSERT_TRUE(fit.report.inducing && fit.report.inducing->summary);
  const ShootOutcome out = shoot(fit, motion(0, 1, 400), {.duration = 0.8});
  const Posterior written = out.fit.posterior(), learned = Posterior(fit.prior(), fit.observations, written.values());
  const View view = View::constrained_acceleration(*fit.model.system);
  const MatrixXd states = fit.observations[0].states(), mean = learned.mean(view, states);
  EXPECT_LT((written.mean(view, states) - mean).norm(), 1e-9 * mean.norm());
  EXPECT_NEAR(out.fit.report.negative_log_likelihood, learned.negative_log_likelihood(), 1e-6);
}

TEST(Shoot, DeviationsHoldTheErrors) {
  int held = 0;
  constexpr int n_seeds = 5;
  for (std::uint64_t seed = 1; seed <= n_seeds; ++seed) {
    const ShootOutcome out = shoot(fit_of(0, seed), motion(2e-3, seed), {.duration = 1});
    const double truths[] = {0.3, 0.05};
    for (std::size_t k = 0; k < 2; ++k) {
      const ShotParameter& one = out.parameters[k];
      held += std::abs(one.value - truths[k]) < 2 * one.stddev ? 1 : 0;
    }
    EXPECT_LT(out.rms_after[0], 1.5 * 2e-3);
    EXPECT_THAT(out.notes, Each(Not(HasSubstr("warning: the motion")))) << seed;
  }
  EXPECT_GE(held, 8) << "of 10";
}

TEST(Shoot, DoubtsALogThatContradictsTheFit) {
  const FitFile fit = fit_of(0);
  const CsvTable log = motion(2e-3, 1);
  EXPECT_THAT(shoot(fit, with_column_off(log, "u", 1.3, 0), {.duration = 1}).notes,
              Contains(HasSubstr("warning: the motion gives other values than the accelerations: m, ")));
  EXPECT_THAT(shoot(fit, with_column_off(log, "q", 1, 0.1), {.duration = 1}).notes,
              Contains(HasSubstr("warning: the motion is farther off than errors of the log and of the latents explain: q, ")));
}

TEST(Shoot, FewStretchesTellNoErrors) {
  const FitFile fit = fit_of(0);
  const CsvTable log = motion(1e-3, 2, 400);
  const auto told = Contains(HasSubstr("warning: no standard errors: they need 4 stretches or more"));
  const ShootOutcome few = shoot(fit, log, {.duration = 0.8, .most_stretches = 3});
  EXPECT_THAT(few.notes, told);
  for (const ShotParameter& one : few.parameters) EXPECT_TRUE(std::isnan(one.stddev)) << one.name;
  const ShootOutcome enough = shoot(fit, log, {.duration = 0.8, .most_stretches = 4});
  EXPECT_THAT(enough.notes, Not(told));
  for (const ShotParameter& one : enough.parameters) EXPECT_GT(one.stddev, 0) << one.name;
}

TEST(Shoot, SameBitsForAnyNumberOfThreads) {
  const FitFile fit = fit_of(0.1);
  const CsvTable log = motion(1e-3, 2, 400);
  const ShootOutcome one = shoot(fit, log, {.duration = 0.8, .threads = 1}),
                     two = shoot(fit, log, {.duration = 0.8, .threads = 2});
  for (std::size_t k = 0; k < 2; ++k) {
    EXPECT_EQ(one.parameters[k].value, two.parameters[k].value);
    EXPECT_EQ(one.parameters[k].stddev, two.parameters[k].stddev);
  }
}

TEST(Shoot, StretchesEndWhereTheLogDoes) {
  const FitFile fit = fit_of(0);
  const CsvTable log = motion(1e-3, 2, 400);
  // 4 s without their middle: two times one stretch of 1.5 s, not two of 1.9 s
  std::vector<int> rows;
  for (int i = 0; i < 400; ++i) {
    if (i < 180 || i >= 220) rows.push_back(i);
  }
  EXPECT_EQ(shoot(fit, log.take(rows), {.duration = 1.5}).n_stretches, 2);
  EXPECT_EQ(shoot(fit, log, {.duration = 1.9}).n_stretches, 2);
  EXPECT_EQ(shoot(fit, motion(1e-3, 2, 401), {.duration = 2}).n_stretches, 2) << "one ends where the next starts";
  EXPECT_EQ(shoot(fit, log, {.duration = 0.4, .most_stretches = 3}).n_stretches, 3);
  EXPECT_THAT(input_error_of([&] { shoot(fit, log.take(rows), {.duration = 1.9}); }),
              HasSubstr("motion.csv: no stretch of 1.9 s with at least 8 rows without a break; rows are 0.01 s apart"));
}

TEST(Shoot, StretchesOfAShortOrASparseLogFitIntoIt) {
  const FitFile fit = fit_of(0);
  const CsvTable log = motion(1e-3, 2, 400);
  std::vector<int> first(20), few;
  std::iota(first.begin(), first.end(), 0);
  for (int i = 0; i < 240; i += 20) few.push_back(i);
  EXPECT_NEAR(shoot(fit, log.take(first)).duration, 0.09, 1e-12);  // half of the log
  EXPECT_NEAR(shoot(fit, log.take(few)).duration, 1.4, 1e-12);     // 8 rows
}

// ---- a ball that bounces down a slope through air that brakes it: impacts say what its restitution is

Model ball(const std::string& restitution) {
  return Model::parse(fmt::format(R"toml(
name = "ball"
coordinates = ["x", "z"]
inputs = ["touch"]
[parameters]
e = {}
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[constraints]
position = [{{ expr = "z + 0.2*x", contact = "touch", restitution = "e" }}]
[[latent]]
name = "air"
kernel = "constant"
features = ["1"]
directions = {{ force = [["-dx*sqrt(dx^2 + dz^2)"], ["-dz*sqrt(dx^2 + dz^2)"]] }}
[noise]
ddq = 0.05
[truth]
force = ["-0.1*dx*sqrt(dx^2 + dz^2)", "-0.1*dz*sqrt(dx^2 + dz^2)"]
)toml",
                                  restitution),
                      "ball.toml");
}

/// Two throws of 2.5 s, the second of which comes to roll, measured 100 times a second.
CsvTable throws(double noise_stddev, std::uint64_t seed) {
  const Model model = ball("0.7");
  const System& system = *model.system;
  RandomStream random(seed);
  const std::vector<std::string> names = {"t", "x", "z", "dx", "dz", "ddx", "ddz", "touch", "episode"};
  std::vector<std::vector<double>> values(names.size());
  for (const int episode : {0, 1}) {
    SimulateOptions options;
    options.times = VectorXd::LinSpaced(251, 0, 2.5);
    options.relative_tolerance = 1e-10;
    options.absolute_tolerance = 1e-12;
    options.contacts = contacts_of(model, system.parameter_values());
    VectorXd start = VectorXd::Zero(system.layout().size());
    start.head(4) << 0, (episode == 0 ? 1.0 : 0.2), 0.5, 0;
    const Trajectory out = simulate(system, system.parameter_values(), model_acceleration(model), start, options);
    for (Index i = 0; i < out.times.size(); ++i) {
      std::vector<double> row = {out.times[i]};
      for (Index k = 0; k < 2; ++k) row.push_back(out.states(k, i) + noise_stddev * random.normal());
      for (Index k = 2; k < 4; ++k) row.push_back(out.states(k, i) + 5 * noise_stddev * random.normal());
      for (Index k = 0; k < 2; ++k) row.push_back(out.accelerations(k, i) + 0.05 * random.normal());
      row.push_back(out.states(system.layout().u(0), i));
      row.push_back(episode);
      for (std::size_t c = 0; c < row.size(); ++c) values[c].push_back(row[c]);
    }
  }
  std::vector<CsvTable::Column> columns;
  for (std::size_t c = 0; c < names.size(); ++c) columns.push_back({names[c], std::move(values[c])});
  return CsvTable::from_columns("throws.csv", std::move(columns));
}

FitFile fit_of_throws(const CsvTable& log) {
  FitRequest request;
  request.model = ball("{ value = 0.5, estimate = true, bounds = [0, 1] }");
  request.logs = {{log}};
  request.problem.mean = Prior::Mean::force;
  request.problem.max_points = 100;
  request.hyperparameters = HyperparameterChoice::optimise;
  return run_fit(prepare_fit(std::move(request))).file;
}

TEST(ShootThroughImpacts, FindsTheRestitution) {
  const CsvTable log = throws(0, 1);
  const ShootOutcome out = shoot(fit_of_throws(log), log, {.duration = 0.5});
  EXPECT_TRUE(out.converged);
  EXPECT_GE(out.n_stretches, 6);
  ASSERT_EQ(out.parameters.size(), 1U);
  // what 100 accelerations of deviation 0.05 say of the air is what is wrong
  EXPECT_NEAR(out.parameters[0].value, 0.7, 1e-3);
  EXPECT_LT(out.parameters[0].stddev, 2e-3);
  EXPECT_LT(out.rms_after[1], out.rms_before[1] / 20);
}

TEST(ShootThroughImpacts, DeviationsHoldTheErrors) {
  int held = 0;
  constexpr int n_seeds = 6;
  for (std::uint64_t seed = 1; seed <= n_seeds; ++seed) {
    const CsvTable log = throws(2e-3, seed);
    const ShootOutcome out = shoot(fit_of_throws(log), log, {.duration = 0.5});
    const ShotParameter& e = out.parameters[0];
    EXPECT_NEAR(e.value, 0.7, 0.01) << seed;
    EXPECT_LT(e.stddev, 0.005) << seed;
    held += std::abs(e.value - 0.7) < 2 * e.stddev ? 1 : 0;
    EXPECT_LT(out.rms_after[1], 1.5 * 2e-3) << seed;
  }
  EXPECT_GE(held, 5);
}

TEST(ShootThroughImpacts, NeedsAnImpactInAStretch) {
  const CsvTable log = throws(0, 1);
  const FitFile fit = fit_of_throws(log);
  std::vector<int> rolls;
  for (int i = log.n_rows() - 60; i < log.n_rows(); ++i) rolls.push_back(i);
  ASSERT_EQ(log.number(rolls.front(), log.find("touch")), 1);
  try {
    static_cast<void>(shoot(fit, log.take(rolls), {.duration = 0.2}));
    FAIL() << "no error";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(), HasSubstr("the motions do not determine separately: e"));
  }
}

TEST(Shoot, SaysWhatIsWrong) {
  const FitFile fit = fit_of(0);
  const CsvTable log = motion(1e-3, 2, 400);
  const auto fault = [&](const ShootRequest& request) { return input_error_of([&] { shoot(fit, log, request); }); };
  EXPECT_THAT(fault({.duration = -1}), HasSubstr("`duration`: must be positive and finite, got -1"));
  EXPECT_THAT(fault({.duration = NAN}), HasSubstr("`duration`: must be positive and finite, got nan"));
  EXPECT_THAT(fault({.duration = 1e300}), HasSubstr("no stretch of 1e+300 s with at least 8 rows"));
  EXPECT_THAT(input_error_of([&] { shoot(fit, log.take({0}), {}); }), HasSubstr("t never increases from one row to the next"));
  EXPECT_THAT(fault({.duration = 0.02}), HasSubstr("no stretch of 0.02 s with at least 8 rows"));
  EXPECT_THAT(fault({.duration = 1, .most_stretches = 0}), HasSubstr("`stretches`: must be at least 1, got 0"));
  EXPECT_THAT(fault({.threads = -1}), HasSubstr("threads"));
  EXPECT_THAT(input_error_of([&] {
                shoot(fit, CsvTable::from_cells("short.csv", {"t", "q"}, {"0", "1"}));
              }),
              HasSubstr("short.csv: missing column"));
  EXPECT_THAT(input_error_of([&] { shoot(fit, with_column_off(log, "t", 1e3, 0)); }),
              HasSubstr("wrong.csv: the rates of the coordinates say that t counts 0.001 s, not seconds"));
  FitFile known = fit;
  std::erase_if(known.report.hyperparameters, [](const Hyperparameter& one) { return one.is_system_parameter(); });
  EXPECT_THAT(input_error_of([&] { shoot(known, log); }), HasSubstr("the fit of 'swing' estimates no parameter of the system"));
}

}  // namespace
}  // namespace gp2::test
