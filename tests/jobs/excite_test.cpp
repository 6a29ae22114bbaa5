// The next experiment, on three mechanisms: what it is expected to tell is what a fit then finds; it tells more than a random one.
#include "gp2/jobs/excite_job.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::HasSubstr;

constexpr std::uint64_t excite_seed = 31;

/// A trolley on a rail, pushed, with a bob on a rod below it.
constexpr const char* crane = R"toml(
name        = "crane"
coordinates = ["s", "x", "y"]
inputs      = ["push"]
[parameters]
M = { value = 2.0, bounds = [0.5, 8], estimate = true }
m = { value = 0.5, bounds = [0.1, 2], estimate = true }
c = { value = 0.2, bounds = [0, 2], estimate = true }
l = 0.5
[mechanics]
mass  = [["M", "0", "0"], ["0", "m", "0"], ["0", "0", "m"]]
force = ["push", "-c*dx", "-m*9.81 - c*dy"]
[constraints]
position = ["(x - s)^2 + y^2 - l^2"]
[[latent]]
name       = "rail"
kernel     = "se"
features   = ["ds"]
directions = { force = [["1"], ["0"], ["0"]] }
[noise]
ddq = 0.1
[truth]
acceleration = ["-2*tanh(3*ds)/M", "0", "0"]
[sampling]
s     = [-0.1, 0.1]
ds    = [-1, 1]
x     = "s + 0.2"
dx    = [-1, 1]
push  = [-1, 1]
start = { y = -0.5 }
)toml";

/// A slider-crank with a redundant row.
constexpr const char* slider_crank = R"toml(
name        = "slider-crank"
coordinates = [{ name = "q1", angle = true }, { name = "q2", angle = true }, "q3"]
inputs      = ["u1"]
[parameters]
Jc = { value = 0.004, bounds = [0.001, 0.02], estimate = true }
ms = { value = 0.8, bounds = [0.2, 3], estimate = true }
d  = { value = 0.4, bounds = [0, 4], estimate = true }
Jr = 0.002
mr = 0.3
r  = 0.1
l  = 0.3
[mechanics]
mass  = [["Jc + mr*r^2/2", "0", "0"], ["0", "Jr", "0"], ["0", "0", "ms + mr/2"]]
force = ["u1", "0", "-d*dq3"]
[constraints]
position = ["r*cos(q1) + l*cos(q2) - q3", "r*sin(q1) + l*sin(q2)", "(q3 - r*cos(q1))^2 + (r*sin(q1))^2 - l^2"]
[[latent]]
name       = "friction"
kernel     = "se"
features   = ["dq1"]
directions = { force = [["1"], ["0"], ["0"]] }
[noise]
ddq = [0.5, 0.2, 0.05]
[truth]
force = ["-0.02*tanh(dq1)", "0", "0"]
[sampling]
q1    = [1.2, 1.8]
dq1   = [-4, 4]
u1    = [-0.05, 0.05]
start = { q2 = 0, q3 = 0.3 }
)toml";

/// A driven puck that falls onto a hill.
constexpr const char* puck = R"toml(
name        = "puck"
coordinates = ["x", "z"]
inputs      = ["touch", "f"]
[parameters]
m = { value = 0.2, bounds = [0.1, 0.4], estimate = true }
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["f", "-9.81*m"]
[constraints]
position = [{ expr = "z - 0.3*cos(3*x)", contact = "touch", restitution = 0.4 }]
[[latent]]
name       = "friction"
features   = ["dx", "dz"]
directions = "force"
[noise]
ddq = 0.05
[truth]
force = ["-0.05*dx", "-0.05*dz"]
[sampling]
x     = [-2, 2]
dx    = [-2.5, 2.5]
f     = [-1, 1]
touch = [0.9, 1]
)toml";

FitOutcome fit_to(const Model& model, std::vector<Log> logs, bool estimate = true) {
  FitRequest request;
  request.model = model;
  request.logs = std::move(logs);
  request.problem.mean = Prior::Mean::force;
  if (!estimate) request.problem.estimate = std::vector<std::string>();
  request.restarts = 1;
  request.max_escapes = 0;
  request.thin = false;
  request.threads = 2;
  return run_fit(prepare_fit(std::move(request)));
}

VectorXd noise_stddev(const Model& model) {
  return Eigen::Map<const VectorXd>(model.noise.stddev.data(), std::ssize(model.noise.stddev));
}

/// A mechanism, its first measurements and the fit to them.
struct Bench {
  Model model;
  CsvTable log;
  FitOutcome fit;
  ExciteRequest request;

  Excitation excite(const ExciteRequest& asked) const {
    return gp2::excite(model, fit.posterior, fit.file.report.hyperparameters, asked);
  }
};

Bench make_bench(const char* text, int n, ExciteRequest request) {
  Model model = Model::parse(text, "bench.toml");
  CsvTable log = as_table(generate(model, {n, excite_seed, noise_stddev(model)}), *model.system, "first.csv");
  FitOutcome fit = fit_to(model, {{log, nullptr}});
  request.threads = 2;
  return {std::move(model), std::move(log), std::move(fit), std::move(request)};
}

const Bench& crane_bench() {
  static const Bench bench = [] {
    ExciteRequest request;
    request.start = std::map<std::string, double>{{"s", 0}, {"x", 0}};
    request.duration = 6;
    request.inputs_within = {{"push", {-5, 5}}};
    request.within = {{"s", {-0.4, 0.4}}};
    request.n_motions = 500;
    return make_bench(crane, 60, request);
  }();
  return bench;
}

const Bench& slider_bench() {
  static const Bench bench = [] {
    ExciteRequest request;
    request.start = std::map<std::string, double>{{"q1", 1.57}};
    request.duration = 3;
    request.inputs_within = {{"u1", {-0.5, 0.5}}};
    request.within = {{"dq1", {-6, 6}}};
    request.n_rows = 64;
    request.n_motions = 200;
    return make_bench(slider_crank, 60, request);
  }();
  return bench;
}

const Excitation& crane_excitation() {
  static const Excitation found = crane_bench().excite(crane_bench().request);
  return found;
}

const Excitation& slider_excitation() {
  static const Excitation found = slider_bench().excite(slider_bench().request);
  return found;
}

/// The planned states, and what the mechanism does there.
CsvTable measured_along(const Model& model, Trajectory motion, std::uint64_t seed) {
  RandomStream random(seed);
  motion.accelerations = true_acceleration(model, motion.states);
  for (auto column : motion.accelerations.colwise()) {
    for (Index j = 0; j < column.size(); ++j) column[j] += noise_stddev(model)[j] * random.normal();
  }
  return as_table(motion, *model.system, "next.csv");
}

/// @param other  on which is measured; null: the mechanism of the bench
void expect_what_a_fit_finds(const Bench& bench, const Excitation& found, const std::shared_ptr<const Model>& other = nullptr) {
  const CsvTable measured = measured_along(other ? *other : bench.model, found.motion, excite_seed + 1);
  const FitOutcome again = fit_to(bench.model, {{bench.log, nullptr}, {measured, other}});
  const FitReport& before = bench.fit.file.report;
  const FitReport& after = again.file.report;
  ASSERT_EQ(found.parameters.size(), 3U);
  for (std::size_t k = 0; k < after.hyperparameters.size(); ++k) {
    const Hyperparameter& h = after.hyperparameters[k];
    const auto known =
        std::find_if(found.parameters.begin(), found.parameters.end(), [&](const auto& one) { return one.name == h.name; });
    if (known == found.parameters.end()) continue;
    const auto at = static_cast<Index>(k);
    EXPECT_NEAR(known->now / before.uncertainty->stddev[at], 1, 0.1) << h.name << ": the fit's own";
    EXPECT_NEAR(after.uncertainty->stddev[at] / known->after, 1, 0.3) << h.name;
    const double truth = bench.model.system->parameter_values()[h.index];
    EXPECT_LT(std::abs(h.value - truth) / after.uncertainty->stddev[at], 4) << h.name << ": what the deviation promises";
  }
}

TEST(Excitation, TellsOfParametersWhatAFitThenFinds) {
  expect_what_a_fit_finds(crane_bench(), crane_excitation());
  expect_what_a_fit_finds(slider_bench(), slider_excitation());
}

// the same load on a longer rod
TEST(Excitation, OfAnotherSystemKeepsItsConstraintAndTellsWhatAFitOfBothThenFinds) {
  const Bench& bench = crane_bench();
  const auto longer = std::make_shared<const Model>(Model::parse(
      test::changed(crane, {{"l = 0.5", "l = 0.7"}, {"start = { y = -0.5 }", "start = { y = -0.7 }"}}), "longer.toml"));
  const FitSystem driven = system_of(bench.fit.file, bench.fit.posterior.prior(), longer);
  ExciteRequest request = bench.request;
  request.n_motions = 100;
  const Excitation found = excite(driven, bench.fit.posterior, bench.fit.file.report.hyperparameters, request);
  for (const auto& state : found.motion.states.colwise()) {
    EXPECT_NEAR(std::hypot(state[1] - state[0], state[2]), 0.7, 1e-9);
  }
  expect_what_a_fit_finds(bench, found, longer);
}

double gain(const Excitation::Known& one) { return one.after / one.random; }

TEST(Excitation, TellsThreeTimesAsMuchAsARandomMotionAsLargeAsTheLimitsAllow) {
  for (const Excitation::Known& one : crane_excitation().parameters) EXPECT_LT(gain(one), 1.0 / 3) << one.name;
  // of the slider-crank any motion through many turns tells what friction is in proportion to the speed
  const Excitation& slider = slider_excitation();
  EXPECT_LT(slider.factor / slider.random_factor, 0.5);
  for (const Excitation* found : {&crane_excitation(), &slider}) {
    EXPECT_GE(found->n_random, 4);
    // a random motion is no straw man: it is itself worth making
    EXPECT_LT(found->random_factor, 0.9);
  }
}

TEST(Excitation, StaysWithinItsLimitsAndOnTheConstraints) {
  for (const auto& [bench, found] :
       {std::pair(&crane_bench(), &crane_excitation()), std::pair(&slider_bench(), &slider_excitation())}) {
    const System& system = *bench->model.system;
    const CsvTable table = as_table(found->motion, system, "motion");
    Limits limits = bench->request.inputs_within;
    limits.insert(bench->request.within.begin(), bench->request.within.end());
    ASSERT_EQ(found->limits.size(), limits.size());
    for (const Excitation::LimitUse& use : found->limits) {
      const auto [lower, upper] = limits.at(use.name);
      double lowest = upper, highest = lower;
      for (int i = 0; i < table.n_rows(); ++i) {
        lowest = std::min(lowest, table.number(i, table.find(use.name)));
        highest = std::max(highest, table.number(i, table.find(use.name)));
      }
      EXPECT_GE(lowest, lower) << use.name;
      EXPECT_LE(highest, upper) << use.name;
      EXPECT_EQ(lowest, use.lowest);
      EXPECT_EQ(highest, use.highest);
      EXPECT_GT(use.share, 0.5) << use.name << ": limits are there to be used";
    }
    const VectorXd parameters = bench->fit.posterior.values().parameters;
    const MechanicsBatch mechanics = require_mechanics(system, found->motion.states, parameters);
    for (Index i = 0; i < found->motion.states.cols(); ++i) {
      const int at = static_cast<int>(i);
      const VectorXd lack = mechanics.values.A(at) * found->motion.accelerations.col(i) - mechanics.values.b(at);
      const double scale =
          mechanics.values.A(at).cwiseAbs().maxCoeff() * found->motion.accelerations.col(i).cwiseAbs().maxCoeff();
      EXPECT_LE(lack.cwiseAbs().maxCoeff(), 1e-11 * (1 + scale)) << i;
    }
    EXPECT_LE(found->motion.max_position_drift, 1e-11);
  }
}

ExciteRequest short_request() {
  ExciteRequest request = crane_bench().request;
  request.n_motions = 40;
  request.n_rows = 60;
  return request;
}

TEST(Excitation, IsTheSameForAnyNumberOfThreadsAndAnotherForAnotherSeed) {
  ExciteRequest request = short_request();
  request.threads = 1;
  const Excitation one = crane_bench().excite(request);
  request.threads = 2;
  const Excitation two = crane_bench().excite(request);
  EXPECT_EQ(one.motion.states, two.motion.states);
  EXPECT_EQ(one.factor, two.factor);
  EXPECT_EQ(one.random_factor, two.random_factor);
  request.seed = 1;
  EXPECT_NE(crane_bench().excite(request).motion.states, two.motion.states);
}

TEST(Excitation, OfAccelerationsMakesThemKnownWhereMotionsGo) {
  ExciteRequest request = short_request();
  request.n_motions = 150;
  const FitOutcome fit = fit_to(crane_bench().model, {{crane_bench().log, nullptr}}, /*estimate=*/false);
  const Excitation found = excite(crane_bench().model, fit.posterior, fit.file.report.hyperparameters, request);
  EXPECT_EQ(found.target, ExcitationTarget::accelerations);
  EXPECT_TRUE(found.parameters.empty());
  ASSERT_EQ(found.accelerations.size(), 3U);
  for (const Excitation::Known& one : found.accelerations) {
    EXPECT_LT(one.after, one.random) << one.name;
    EXPECT_LT(one.random, one.now) << one.name;
  }
  EXPECT_LT(found.factor, found.random_factor);
  request.target = ExcitationTarget::accelerations;
  const Excitation with_parameters = crane_bench().excite(request);
  EXPECT_EQ(with_parameters.parameters.size(), 3U);
  EXPECT_EQ(with_parameters.accelerations.size(), 3U);
}

TEST(Excitation, IsWhatSimulateMakesOfItsInputs) {
  const Excitation found = crane_bench().excite(short_request());
  const Bench& bench = crane_bench();
  SimulateRequest request;
  request.inputs = as_table(found.motion, *bench.model.system, "next.csv");
  request.start = *request.inputs;
  request.times = found.motion.times;
  const FitSystem system{&bench.model, bench.model.actuators, nullptr, bench.fit.posterior.prior()};
  const Trajectory motion = run_simulation(prepare_simulation(system, bench.fit.posterior, request)).front();
  EXPECT_LT((motion.states - found.motion.states).cwiseAbs().maxCoeff(), 1e-6);
}

TEST(Excitation, NeedsNoLimitsOfAContact) {
  ExciteRequest request;
  request.start = std::map<std::string, double>{{"x", 0.2}, {"z", 1}};
  request.duration = 1;
  request.n_rows = 60;
  request.n_motions = 40;
  request.inputs_within = {{"f", {-1, 1}}};
  const Bench bench = make_bench(puck, 60, request);
  const Excitation found = bench.excite(bench.request);
  ASSERT_EQ(found.limits.size(), 1U);
  EXPECT_EQ(found.limits[0].name, "f");
  EXPECT_GT(found.limits[0].share, 0.5);
  EXPECT_LE(found.motion.commands.row(1).cwiseAbs().maxCoeff(), 1);
  request.inputs_within["touch"] = {0, 1};
  EXPECT_EQ(test::input_error_of([&] { bench.excite(request); }),
            "`inputs_within`: 'touch' is a contact, which the motion makes: leave it out");
}

TEST(Excitation, AskedToStopEndsWithTheBestSoFar) {
  const Bench& bench = crane_bench();
  std::atomic<bool> stop = false;
  int n_told = 0;
  const auto tell = [&](const ExciteProgress& p) {
    EXPECT_EQ(p.n_all, 40);
    EXPECT_GT(p.best, 0);
    if (++n_told == 2) stop = true;
  };
  const std::vector<Hyperparameter>& hyperparameters = bench.fit.file.report.hyperparameters;
  const Excitation found = excite(bench.model, bench.fit.posterior, hyperparameters, short_request(), tell, &stop);
  EXPECT_TRUE(found.interrupted);
  EXPECT_EQ(n_told, 2);
  EXPECT_LT(found.n_motions, 40);
  EXPECT_EQ(found.motion.states.cols(), 60);
  EXPECT_THROW(excite(bench.model, bench.fit.posterior, hyperparameters, short_request(), {}, &stop), NumericalError);
}

struct ExciteFault {
  std::function<void(ExciteRequest&)> change;
  std::string text;
};

TEST(Excitation, SaysWhatIsWrongWithARequest) {
  const std::vector<ExciteFault> faults = {
      {[](auto& r) { r.duration = 0; }, "`duration`: must be positive, got 0"},
      {[](auto& r) { r.duration = std::nan(""); }, "`duration`: must be positive, got nan"},
      {[](auto& r) { r.n_motions = 0; }, "`motions`: must be at least 1, got 0"},
      {[](auto& r) { r.n_harmonics = 0; }, "`harmonics`: must be at least 1, got 0"},
      {[](auto& r) { r.n_rows = 31; }, "`rows`: must be at least four for each of the 8 harmonics and at most 1000000, got 31"},
      {[](auto& r) { r.n_harmonics = 1'000'000'000; },
       "`rows`: must be at least four for each of the 1000000000 harmonics and at most 1000000, got 60"},
      {[](auto& r) { r.inputs_within = {}; },
       "`inputs_within`: no limits of 'push'; give its lowest and highest value, 0:0 to leave it out"},
      {[](auto& r) {
         r.inputs_within["pull"] = {0, 1};
       },
       "`inputs_within`: 'pull' is no input of 'crane'; there are: push"},
      {[](auto& r) {
         r.inputs_within["push"] = {1, -1};
       },
       "`inputs_within`: push = 1:-1 must be finite, the lower limit first"},
      {[](auto& r) {
         r.inputs_within["push"] = {2, 2};
       },
       "`inputs_within`: all inputs are fixed by their limits"},
      {[](auto& r) {
         r.within["dx"] = {3, -3};
       },
       "`within`: dx = 3:-3 must be finite, the lower limit first"},
      {[](auto& r) {
         r.within["dx"] = {0, 0};
       },
       "`within`: dx = 0:0 must be finite, the lower limit first"},
      {[](auto& r) {
         r.within["push"] = {-1, 1};
       },
       "`within`: 'push' is no coordinate, velocity or acceleration of 'crane'; there are: s, x, y, ds, dx, dy, dds, ddx, ddy"},
      {[](auto& r) {
         r.within["s"] = {0.1, 0.3};
       },
       "`start`: s = 0 is outside of its limits 0.1:0.3 in `within`"},
      {[](auto& r) {
         r.start = std::map<std::string, double>{{"z", 1}};
       },
       "`start`: 'z' is no coordinate or velocity of 'crane'; there are: s, x, y, ds, dx, dy"},
  };
  for (const ExciteFault& fault : faults) {
    ExciteRequest request = short_request();
    fault.change(request);
    EXPECT_EQ(test::input_error_of([&] { crane_bench().excite(request); }), fault.text);
  }
}

TEST(Excitation, NamesTheLimitThatNoMotionKeepsAndByHowMuch) {
  ExciteRequest request = short_request();
  request.start = std::map<std::string, double>{{"s", 0}, {"x", 0.1}};  // it swings by itself
  request.within["dx"] = {-0.05, 0.05};
  EXPECT_THAT(
      test::input_error_of([&] { crane_bench().excite(request); }),
      testing::MatchesRegex("`within`: none of [0-9]+ motions stays within the limits; the nearest takes dx to -?0\\.[0-9]+, "
                            "[0-9.]+ beyond -0\\.05:0\\.05\\. Widen that limit, shorten `duration`, or `start` elsewhere"));
}

TEST(Excitation, SaysWhatHelpsWhereNoMotionCouldBeIntegrated) {
  ExciteRequest request = short_request();
  request.duration = 2000;  // of a swing within a second or two, in 600 steps
  try {
    crane_bench().excite(request);
    FAIL() << "ten steps a row do not follow it";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(),
                testing::AllOf(testing::StartsWith("excite: none of "),
                               testing::EndsWith("use more `rows` (10 steps of the integrator are allowed per row), or "
                                                 "smaller limits")));
  }
}

TEST(Excitation, IsRefusedOfFitsThatKnowNothingToAskFor) {
  const Bench& bench = crane_bench();
  ExciteRequest request = short_request();
  request.target = ExcitationTarget::parameters;
  const FitOutcome fit = fit_to(bench.model, {{bench.log, nullptr}}, /*estimate=*/false);
  EXPECT_EQ(test::input_error_of([&] { excite(bench.model, fit.posterior, fit.file.report.hyperparameters, request); }),
            "`for=parameters`: the fit estimates no parameters; mark some with estimate = true in the model, or ask "
            "`for=accelerations`");
  EXPECT_EQ(test::input_error_of([&] { excite(bench.model, fit.posterior.without_data(), {}, request); }),
            "excite: the fit observed no accelerations, so their noise is unknown");

  FitRequest of_baseline;
  of_baseline.model = bench.model;
  of_baseline.logs = {{bench.log, nullptr}};
  of_baseline.problem.baseline = Baseline::Kind::se;
  of_baseline.problem.estimate = std::vector<std::string>();
  of_baseline.restarts = 1;
  of_baseline.max_iterations = 0;
  const FitOutcome baseline = run_fit(prepare_fit(std::move(of_baseline)));
  EXPECT_EQ(test::input_error_of([&] { excite(bench.model, baseline.posterior, baseline.file.report.hyperparameters, request); }),
            "excite: a baseline knows no constraints, so it has no motion to plan");
}

TEST(Excitation, NeedsSomethingToDriveTheSystemBy) {
  const Model free = Model::parse(R"toml(
name        = "weight"
coordinates = ["x"]
[mechanics]
mass  = [["1"]]
force = ["0"]
[[latent]]
kernel   = "se"
features = ["dx"]
[noise]
ddq = 0.1
[truth]
force = ["-dx"]
[sampling]
dx = [-1, 1]
)toml",
                                  "weight.toml");
  const FitOutcome fit =
      fit_to(free, {{as_table(generate(free, {12, excite_seed, noise_stddev(free)}), *free.system, "log.csv"), nullptr}});
  ExciteRequest request;
  request.start = std::map<std::string, double>{{"x", 0}};
  request.duration = 1;
  EXPECT_EQ(test::input_error_of([&] { excite(free, fit.posterior, fit.file.report.hyperparameters, request); }),
            "excite: 'weight' has no inputs to drive it");
}

}  // namespace
}  // namespace gp2
