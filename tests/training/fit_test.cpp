#include <algorithm>
#include <atomic>
#include <chrono>
#include <memory>
#include <set>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/mechanics/callable_system.hpp"
#include "gp2/training/robust.hpp"
#include "test_models.hpp"
#include "thread_ranks.hpp"
#include "training/objective.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::ThreadRanks;
using testing::HasSubstr;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t fit_seed = 50502;

struct Problem {
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
};

Problem problem(const std::string& file, int n, const std::vector<std::string>& estimated = {}, const Protocol& protocol = {},
                bool estimate_noise = false, double noise_stddev = 0.05) {
  const Model& model = test::model(file);
  GenerateOptions options{n, fit_seed, {}};
  options.noise_stddev = VectorXd::Constant(model.system->nq(), noise_stddev);
  const GeneratedData data = generate(model, options);
  Problem p{make_prior(model), {}, {}};
  p.observations.push_back({data.states, View::all(View::Quantity::constrained_acceleration, *model.system), data.accelerations,
                            options.noise_stddev, estimate_noise});
  p.hyperparameters = default_hyperparameters(p.prior, p.observations, estimated, protocol);
  return p;
}

FitOptions quick() {
  FitOptions options;
  options.n_restarts = 3;
  options.max_iterations = 15;
  options.n_threads = 1;
  options.seed = 5;
  return options;
}

std::vector<double> values_of(const std::vector<Hyperparameter>& hyperparameters) {
  std::vector<double> values;
  for (const Hyperparameter& h : hyperparameters) values.push_back(h.value);
  return values;
}

// the objective by its definition: likelihood plus hyper-priors
double objective(const Problem& p, const std::vector<Hyperparameter>& hyperparameters) {
  const ModelValues values = model_values(p.prior, p.observations, hyperparameters);
  return Posterior(p.prior, p.observations, values).negative_log_likelihood() +
         negative_log_hyperpriors(hyperparameters, nullptr);
}

TEST(FitTest, GivesTheSameBitsForAnyNumberOfThreads) {
  const Problem p = problem("models/unicycle.toml", 25, {"R"}, {}, true);
  std::vector<std::vector<double>> values;
  std::vector<MatrixXd> means;
  std::vector<std::vector<double>> objectives;
  for (int n_threads : {1, 2, 3}) {
    FitOptions options = quick();
    options.n_threads = n_threads;
    const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
    values.push_back(values_of(result.report.hyperparameters));
    means.push_back(result.posterior.mean(p.observations[0].view(), p.observations[0].states()));
    objectives.emplace_back();
    for (const RestartReport& restart : result.report.restarts) objectives.back().push_back(restart.objective);
  }
  EXPECT_EQ(values[0], values[1]);
  EXPECT_EQ(values[0], values[2]);
  EXPECT_EQ(means[0], means[1]);
  EXPECT_EQ(means[0], means[2]);
  EXPECT_EQ(objectives[0], objectives[1]);
  EXPECT_EQ(objectives[0], objectives[2]);
}

TEST(FitTest, GivesTheSameBitsForAnyNumberOfRanksWhichShareOutItsRuns) {
  const Problem p = problem("models/unicycle.toml", 15, {"R"}, {}, true);
  FitOptions options = quick();
  options.max_iterations = 5;  // so that no run goes on once all are known
  options.n_draws = 3;
  const FitReport alone = fit(p.prior, p.observations, p.hyperparameters, options).report;
  ASSERT_TRUE(alone.draws && alone.uncertainty);
  for (const int n : {2, 5}) {  // some of five have no run
    ThreadRanks::Meeting meeting(n);
    std::vector<FitReport> reports(static_cast<std::size_t>(n));
    std::vector<std::set<int>> runs(reports.size());
    {
      std::vector<std::jthread> threads;
      for (int rank = 0; rank < n; ++rank) {
        threads.emplace_back([&, rank] {
          const auto own = static_cast<std::size_t>(rank);
          FitOptions on_rank = options;
          on_rank.ranks = std::make_shared<ThreadRanks>(meeting, rank);
          on_rank.n_threads = 1 + rank % 2;
          on_rank.progress = [&](const Progress& progress) {
            if (!progress.is_drawing) runs[own].insert(progress.restart);
          };
          reports[own] = fit(p.prior, p.observations, p.hyperparameters, on_rank).report;
        });
      }
    }
    std::set<int> all;
    for (std::size_t rank = 0; rank < reports.size(); ++rank) {
      const FitReport& report = reports[rank];
      EXPECT_EQ(report.objective, alone.objective);
      EXPECT_EQ(report.termination, alone.termination);
      EXPECT_EQ(values_of(report.hyperparameters), values_of(alone.hyperparameters));
      ASSERT_TRUE(report.draws && report.uncertainty);
      EXPECT_EQ(report.draws->values, alone.draws->values);
      EXPECT_EQ(report.draws->evaluations, alone.draws->evaluations);
      EXPECT_EQ(report.uncertainty->stddev, alone.uncertainty->stddev);
      ASSERT_EQ(report.restarts.size(), alone.restarts.size());
      for (std::size_t k = 0; k < report.restarts.size(); ++k) {
        EXPECT_EQ(report.restarts[k].objective, alone.restarts[k].objective);
        EXPECT_EQ(report.restarts[k].evaluations, alone.restarts[k].evaluations);
        EXPECT_EQ(report.restarts[k].termination, alone.restarts[k].termination);
      }
      EXPECT_LT(runs[rank].size(), alone.restarts.size()) << "of rank " << rank;
      all.insert(runs[rank].begin(), runs[rank].end());
    }
    EXPECT_EQ(all.size(), alone.restarts.size());
  }
}

TEST(FitTest, TellsOfTheBestSoFarWhereARunGetsLower) {
  const Problem p = problem("models/unicycle.toml", 25, {"R"});
  FitOptions options = quick();
  std::vector<double> told;
  FitReport last;
  options.improved = [&](const FitReport& so_far, const std::vector<Observations>& observations) {
    EXPECT_EQ(observations.front().n_data(), 25);
    EXPECT_EQ(so_far.termination, FitReport::interrupted);
    EXPECT_NEAR(so_far.objective, objective(p, so_far.hyperparameters), 1e-9 * std::abs(so_far.objective));
    told.push_back(so_far.objective);
    last = so_far;
  };
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  ASSERT_FALSE(told.empty());
  EXPECT_TRUE(std::is_sorted(told.rbegin(), told.rend()));
  EXPECT_EQ(last.objective, report.objective);
  EXPECT_EQ(last.negative_log_likelihood, report.negative_log_likelihood);
  EXPECT_EQ(values_of(last.hyperparameters), values_of(report.hyperparameters));
}

TEST(FitTest, AnotherSeedDrawsOtherStarts) {
  const Problem p = problem("models/duffing.toml", 15);
  FitOptions options = quick();
  options.max_iterations = 1;
  const FitReport one = fit(p.prior, p.observations, p.hyperparameters, options).report;
  options.seed = 6;
  const FitReport other = fit(p.prior, p.observations, p.hyperparameters, options).report;
  EXPECT_NE(one.restarts[1].objective, other.restarts[1].objective);
  EXPECT_NE(one.restarts[1].objective, one.restarts[2].objective);
  // the first restart starts where it is told to, whatever the seed
  options.n_restarts = 1;
  const double alone = fit(p.prior, p.observations, p.hyperparameters, options).report.objective;
  options.seed = 5;
  EXPECT_EQ(fit(p.prior, p.observations, p.hyperparameters, options).report.objective, alone);
}

// twice as many states as tell where the hyperparameters stand
Problem large_problem() { return problem("models/duffing.toml", 800); }

TEST(FitThroughInducingPoints, IsWithinANatOfTheExactOneAtItsHyperparameters) {
  const Problem p = large_problem();
  FitOptions options = quick();
  options.n_inducing = 200;
  const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
  ASSERT_TRUE(result.report.inducing.has_value());
  EXPECT_GT(result.report.inducing->n_start, 0);
  EXPECT_EQ(result.report.inducing->n_starts, options.n_restarts);
  EXPECT_LE(result.report.inducing->n_variables, 200);
  EXPECT_LE(result.report.inducing->left_out.sum(), 1.5);
  const double exact = Posterior(p.prior, p.observations, model_values(p.prior, p.observations, result.report.hyperparameters))
                           .negative_log_likelihood();
  const double bound = result.report.negative_log_likelihood, rounding = 1e-9 * std::abs(exact);
  EXPECT_GE(bound, exact - rounding);
  EXPECT_LE(bound, exact + 1);
  // of sums alone, ỹᵀỹ − cᵀB⁻¹c, which cancels
  EXPECT_NEAR(result.posterior.negative_log_likelihood(), bound, 1e2 * rounding);
  EXPECT_NEAR(result.report.objective, objective(p, result.report.hyperparameters) + bound - exact, rounding);
  // all states tell more than those of the start: the objective falls
  FitOptions at_start = options;
  at_start.max_iterations = 0;
  EXPECT_LT(result.report.objective, fit(p.prior, p.observations, p.hyperparameters, at_start).report.objective);
}

TEST(FitThroughInducingPoints, GivesTheSameBitsForAnyNumberOfThreads) {
  const Problem p = large_problem();
  std::vector<std::vector<double>> values;
  std::vector<MatrixXd> means;
  for (int n_threads : {1, 2, 3}) {
    FitOptions options = quick();
    options.n_inducing = 60;
    options.n_threads = n_threads;
    const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
    values.push_back(values_of(result.report.hyperparameters));
    means.push_back(result.posterior.mean(p.observations[0].view(), p.observations[0].states()));
  }
  EXPECT_EQ(values[0], values[1]);
  EXPECT_EQ(values[0], values[2]);
  EXPECT_EQ(means[0], means[1]);
  EXPECT_EQ(means[0], means[2]);
}

TEST(FitThroughInducingPoints, StoppedAnywhereItHasWhatWasFound) {
  const Problem p = large_problem();
  int n_calls = 0;
  FitOptions options = quick();
  options.n_inducing = 60;
  options.progress = [&](const Progress&) { ++n_calls; };
  const double whole = fit(p.prior, p.observations, p.hyperparameters, options).report.objective;
  for (const int call : {1, n_calls / 2, n_calls - 1}) {
    SCOPED_TRACE(call);
    std::atomic<bool> stop = false;
    int n = 0;
    options.stop = &stop;
    options.progress = [&](const Progress&) { stop = ++n >= call; };
    const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
    EXPECT_EQ(result.report.termination, FitReport::interrupted);
    EXPECT_FALSE(result.report.converged);
    ASSERT_TRUE(result.report.inducing.has_value());
    EXPECT_EQ(result.report.inducing->left_out.size(), std::ssize(p.prior.latents));
    EXPECT_TRUE(result.posterior.mean(p.observations[0].view(), p.observations[0].states()).allFinite());
    EXPECT_GE(objective(p, result.report.hyperparameters), whole - 1) << "the whole one went on from there";
  }
}

TEST(FitThroughInducingPoints, WithoutIterationsConditionsAtTheStart) {
  const Problem p = large_problem();
  FitOptions options = quick();
  options.n_inducing = 60;
  options.max_iterations = 0;
  const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
  EXPECT_EQ(values_of(result.report.hyperparameters), values_of(p.hyperparameters));
  EXPECT_EQ(result.report.inducing->n_start, 0);
  EXPECT_EQ(result.posterior.values().inducing, result.report.inducing->points);
}

TEST(FitThroughInducingPoints, DrawsHyperparametersAsTheExactOneDoes) {
  const Problem p = problem("models/duffing.toml", 15);  // few enough for all to be drawn from
  FitOptions options = quick();
  options.n_draws = 5;
  options.n_inducing = 15;
  const Fit through = fit(p.prior, p.observations, p.hyperparameters, options);
  options.n_inducing = 0;
  const Fit exact = fit(p.prior, p.observations, through.report.hyperparameters, options);
  ASSERT_TRUE(exact.report.draws && through.report.draws);
  EXPECT_EQ(through.report.draws->values, exact.report.draws->values);
  EXPECT_EQ(through.posterior.n_components(), 5);
}

TEST(FitTest, NoIterationsConditionsAtTheStart) {
  const Problem p = problem("models/surface.toml", 20, {"p1"});
  FitOptions options = quick();
  options.max_iterations = 0;
  const Fit result = fit(p.prior, p.observations, p.hyperparameters, options);
  EXPECT_EQ(values_of(result.report.hyperparameters), values_of(p.hyperparameters));
  EXPECT_EQ(result.report.restarts.size(), 1u);
  EXPECT_EQ(result.report.iterations, 0);
  EXPECT_FALSE(result.report.converged);
  EXPECT_NEAR(result.report.negative_log_likelihood, result.posterior.negative_log_likelihood(),
              1e-9 * std::abs(result.report.negative_log_likelihood));
  const Posterior there(p.prior, p.observations, model_values(p.prior, p.observations, p.hyperparameters));
  EXPECT_EQ(result.posterior.mean(p.observations[0].view(), p.observations[0].states()),
            there.mean(p.observations[0].view(), p.observations[0].states()));
}

TEST(FitTest, ReportsTheObjectiveAtTheValuesItReturns) {
  for (const char* file : {"models/duffing.toml", "models/unicycle.toml"}) {
    for (const Protocol& protocol :
         {Protocol{}, Protocol{Protocol::Name::paper, true}, Protocol{Protocol::Name::standard, false}}) {
      SCOPED_TRACE(fmt::format("{}, protocol {}, hyper-prior {}, seed {}", file, static_cast<int>(protocol.name),
                               protocol.hyperprior, fit_seed));
      const Problem p = problem(file, 20, {}, protocol, true);
      const FitReport report = fit(p.prior, p.observations, p.hyperparameters, quick()).report;
      const double start = objective(p, p.hyperparameters);
      const double end = objective(p, report.hyperparameters);
      // two evaluations of one likelihood, whose condition number is below 1e7 at this noise
      EXPECT_NEAR(report.objective, end, 1e-7 * (1 + std::abs(end)));
      EXPECT_LT(end, start);
      double best = std::numeric_limits<double>::infinity();
      for (const RestartReport& restart : report.restarts) best = std::min(best, restart.objective);
      EXPECT_EQ(report.objective, best);
      EXPECT_EQ(report.restarts[static_cast<std::size_t>(report.best_restart)].objective, best);
      if (protocol.name == Protocol::Name::paper || !protocol.hyperprior) {
        EXPECT_EQ(report.objective, report.negative_log_likelihood);
      }
      for (const Hyperparameter& h : report.hyperparameters) EXPECT_TRUE(h.lower <= h.value && h.value <= h.upper) << h.name;
    }
  }
}

TEST(FitTest, ConvergesToAPointWhoseProjectedGradientIsBelowTheTolerance) {
  for (const Protocol& protocol : {Protocol{}, Protocol{Protocol::Name::paper, true}}) {
    // noise of a tenth of the signal, so that the objective's rounding does not hide a gradient of 1e-3
    Problem p = problem("models/duffing.toml", 20, {"A0"}, protocol, true, 5);
    for (Hyperparameter& h : p.hyperparameters) {
      // a box far from width one
      if (h.kind == Kind::parameter) std::tie(h.lower, h.upper) = std::pair(-20.0, 30.0);
      // room for the shared factor, which would otherwise end at its bound
      if (h.kind == Kind::shared_signal_stddev) std::tie(h.lower, h.upper) = std::pair(1e-3, 1e3);
    }
    FitOptions options = quick();
    options.n_restarts = 1;
    options.max_iterations = 2000;
    options.gradient_tolerance = 1e-3;
    options.reduction_tolerance = 0;
    const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
    ASSERT_TRUE(report.converged) << report.termination;
    EXPECT_THAT(report.termination, HasSubstr("gradient"));
    int n_inside = 0;
    for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
      const Hyperparameter& h = report.hyperparameters[k];
      if (h.at_bound()) continue;
      ++n_inside;
      // on the scale the optimiser works on: the logarithm, or the width of the box
      const auto at = [&](double x) -> VectorXd {
        std::vector<Hyperparameter> moved = report.hyperparameters;
        moved[k].value = h.positive ? std::exp(x) : h.lower + x * (h.upper - h.lower);
        return VectorXd::Constant(1, objective(p, moved));
      };
      const double x = h.positive ? std::log(h.value) : (h.value - h.lower) / (h.upper - h.lower);
      // the likelihood at this noise is rounded at some 1e-12 of itself
      const test::Difference slope = test::central_difference(at, x, h.positive ? 0.5 : 0.01, 1e-12);
      // of a parameter, over what it is known by were the rest known; at the start that was within a factor of two of here
      double unit = 1;
      if (h.kind == Kind::parameter) {
        constexpr double step = 1e-4;
        const double bend = (at(x + step)[0] - 2 * at(x)[0] + at(x - step)[0]) / (step * step);
        unit = 2 / std::sqrt(bend);
      }
      EXPECT_LE(unit * std::abs(slope.value[0]), options.gradient_tolerance + unit * slope.error[0]) << h.name;
      EXPECT_LE(slope.error[0], 1e-2) << h.name;
    }
    EXPECT_GE(n_inside, 3);
  }
}

TEST(FitTest, FindsTheParametersOfTheConstraintThatMadeTheData) {
  const Model& model = test::model("models/duffing.toml");
  Problem p = problem("models/duffing.toml", 40, {"A0", "omega"});
  const int A0 = model.system->parameter_index("A0"), omega = model.system->parameter_index("omega");
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::parameter && h.index == A0) h.value = 1.15;
    if (h.kind == Kind::parameter && h.index == omega) h.value = 6.35;
  }
  FitOptions options = quick();
  options.n_restarts = 1;
  options.max_iterations = 300;
  const ModelValues fitted = fit(p.prior, p.observations, p.hyperparameters, options).posterior.values();
  // forty measurements of b, of noise 0.05·√2 on an amplitude of some 40: five standard errors and more
  EXPECT_NEAR(fitted.parameters[A0], 1.0, 5e-3);
  EXPECT_NEAR(fitted.parameters[omega], 6.283185307179586, 2e-2);
}

TEST(FitTest, FindsTheMinimumInASharedSignalStandardDeviation) {
  Problem p = problem("models/surface.toml", 20, {}, {Protocol::Name::paper, false});
  // by itself, with a wide box: the minimum is inside
  p.hyperparameters = {p.hyperparameters.back()};
  ASSERT_EQ(p.hyperparameters[0].kind, Kind::shared_signal_stddev);
  p.hyperparameters[0].lower = 1e-2;
  p.hyperparameters[0].upper = 1e3;
  const Fit result = fit(p.prior, p.observations, p.hyperparameters, quick());
  const double lowest = objective(p, result.report.hyperparameters);
  for (double factor : {0.98, 1.02}) {
    std::vector<Hyperparameter> beside = result.report.hyperparameters;
    beside[0].value *= factor;
    EXPECT_GT(objective(p, beside), lowest) << "at " << factor << " of the fitted value";
  }
}

TEST(FitTest, EscapesFromACornerWhereTheGradientVanishes) {
  // with almost no signal nothing depends on anything: every run that starts there stays
  Problem p = problem("models/surface.toml", 30, {}, {Protocol::Name::standard, false});
  FitOptions options = quick();
  options.n_restarts = 1;
  options.max_iterations = 200;
  const double expected = fit(p.prior, p.observations, p.hyperparameters, options).report.objective;
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind != Kind::signal_stddev) continue;
    h.lower *= 1e-6;
    h.value = h.lower;
  }
  // an escape begins anew, but the share of the work that is done does not fall
  double done = 0;
  options.progress = [&](const Progress& progress) {
    EXPECT_GE(progress.fraction, done);
    EXPECT_LE(progress.fraction, 1);
    done = progress.fraction;
  };
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  EXPECT_GE(report.n_escapes, 1);
  // the way out need not lead to the lowest minimum of all, but to one of its kind
  const double corner = objective(p, p.hyperparameters);
  EXPECT_LT(report.objective - expected, 0.01 * (corner - expected));
  EXPECT_NEAR(report.objective, objective(p, report.hyperparameters), 1e-9 * std::abs(report.objective));

  // the limit of iterations holds for the run and its escapes together
  options.max_iterations = 3;
  EXPECT_LE(fit(p.prior, p.observations, p.hyperparameters, options).report.iterations, 3);
}

TEST(FitTest, StopsWhenAskedAndReturnsTheBestSoFar) {
  const Problem p = problem("models/surface.toml", 20);
  std::atomic<bool> stop = false;
  FitOptions options = quick();
  options.max_iterations = 1000;
  options.n_restarts = 1;
  options.stop = &stop;
  options.progress = [&](const Progress& progress) {
    if (progress.iteration == 4) stop = true;
  };
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  EXPECT_EQ(report.iterations, 4);
  EXPECT_FALSE(report.converged);
  EXPECT_EQ(report.termination, FitReport::interrupted);
  EXPECT_LT(report.objective, objective(p, p.hyperparameters));
}

TEST(FitTest, BeginsNoFurtherRestartOnceItIsAskedToStop) {
  const Problem p = problem("models/surface.toml", 20);
  std::atomic<bool> stop = false;
  FitOptions options = quick();
  options.max_iterations = 1000;
  options.n_restarts = 50;
  options.n_threads = 1;
  options.stop = &stop;
  options.progress = [&](const Progress&) { stop = true; };
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  EXPECT_EQ(report.best_restart, 0);
  EXPECT_EQ(report.iterations, 1);
  ASSERT_EQ(report.restarts.size(), 50U);
  for (std::size_t k = 1; k < report.restarts.size(); ++k) {
    EXPECT_EQ(report.restarts[k].evaluations, 0);
    EXPECT_EQ(report.restarts[k].objective, std::numeric_limits<double>::infinity());
    EXPECT_EQ(report.restarts[k].termination, "not begun: stopped on request");
  }
}

// The surface model as code that counts its evaluations and asks for the end of the fit at one of them.
std::shared_ptr<const System> counting_surface(std::atomic<int>& n_calls, int stop_at, std::atomic<bool>& stop) {
  const std::shared_ptr<const System> system = test::model("models/surface.toml").system;
  CallableSystem::Definition definition;
  definition.declaration = {system->name(), system->coordinates(), system->inputs(), system->parameters()};
  for (const std::string& label : system->constraint_labels()) {
    definition.constraints.push_back({label, ConstraintLevel::acceleration});
  }
  definition.evaluate = [system, &n_calls, stop_at, &stop](const auto& states, const auto& parameters) {
    if (++n_calls == stop_at) stop = true;
    return system->evaluate(states, parameters);
  };
  definition.differentiate = [system](const auto& states, const auto& parameters, int index) {
    return system->differentiate(states, parameters, index);
  };
  return std::make_shared<const CallableSystem>(std::move(definition));
}

TEST(FitTest, EndsWithTheEvaluationUnderWayWhereverItIsAskedToStop) {
  const Problem p = problem("models/surface.toml", 6, {"p1", "p5"});
  const auto n_evaluations = [&](int stop_at, bool robust) {
    std::atomic<int> n_calls = 0;
    std::atomic<bool> stop = false;
    Prior prior = p.prior;
    prior.system = counting_surface(n_calls, stop_at, stop);
    FitOptions options = quick();
    options.stop = &stop;
    constexpr int of_first_evaluation = 8;  // those of the scales of the parameters before it
    try {
      const FitReport report = (robust ? fit_robust(prior, p.observations, p.hyperparameters, options)
                                       : fit(prior, p.observations, p.hyperparameters, options))
                                   .report;
      EXPECT_TRUE(report.termination == FitReport::interrupted || stop_at < 0) << stop_at;
    } catch (const NumericalError& error) {
      EXPECT_LE(stop_at, of_first_evaluation) << error.what();
      EXPECT_STREQ(error.what(), "stopped before the likelihood was evaluated once: there is no fit");
    }
    return n_calls.load();
  };
  for (const bool robust : {false, true}) {
    const int all = n_evaluations(-1, robust);
    for (int stop_at = 1; stop_at < all - 10; stop_at += 1 + all / 40) {
      // at most the start of the first restart, one more, and what conditions the posterior
      EXPECT_LE(n_evaluations(stop_at, robust), stop_at + 3) << stop_at << " of " << all;
    }
  }
}

TEST(FitTest, ALargeOneIsStoppedWithinItsFirstEvaluation) {
  const Problem p = problem("models/surface.toml", 3500);  // 7000 reduced rows: a minute of one core
  std::atomic<bool> stop = false;
  FitOptions options = quick();
  options.n_restarts = 1;
  options.stop = &stop;
  std::chrono::steady_clock::time_point asked;
  std::jthread asking([&] {
    std::this_thread::sleep_for(std::chrono::seconds(3));
    asked = std::chrono::steady_clock::now();
    stop = true;
  });
  try {
    static_cast<void>(fit(p.prior, p.observations, p.hyperparameters, options));
    FAIL() << "it was not stopped";
  } catch (const NumericalError& error) {
    EXPECT_STREQ(error.what(), "stopped before the likelihood was evaluated once: there is no fit");
  }
  asking.join();
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - asked).count();
  EXPECT_LT(seconds, 20) << "a second or two on a core of its own";
}

TEST(FitTest, TellsItsProgressOneCallAtATime) {
  const Problem p = problem("models/duffing.toml", 15);
  FitOptions options = quick();
  options.n_threads = 3;
  std::atomic<int> inside = 0;
  int n_calls = 0;
  double best = std::numeric_limits<double>::infinity();
  options.progress = [&](const Progress& progress) {
    EXPECT_EQ(++inside, 1);
    ++n_calls;
    EXPECT_LE(progress.best, best);
    best = progress.best;
    EXPECT_EQ(progress.n_restarts, 3);
    EXPECT_TRUE(progress.fraction >= 0 && progress.fraction <= 1);
    EXPECT_GE(progress.seconds, 0);
    --inside;
  };
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  int n_iterations = 0;
  for (const RestartReport& restart : report.restarts) n_iterations += restart.iterations;
  EXPECT_EQ(n_calls, n_iterations);
  EXPECT_EQ(best, report.objective);
}

TEST(FitTest, DrawsAStartAgainWhereTheMassMatrixIsIndefinite) {
  Problem p = problem("models/unicycle.toml", 15, {"Ic"});
  for (Hyperparameter& h : p.hyperparameters) {
    // M is positive definite above m R² = 0.0025 only: half of the box
    if (h.kind == Kind::parameter) {
      h.lower = -0.02;
      h.upper = 0.025;
    }
  }
  FitOptions options = quick();
  options.n_restarts = 8;
  options.max_iterations = 2;
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  for (const RestartReport& restart : report.restarts) EXPECT_TRUE(std::isfinite(restart.objective)) << restart.termination;
}

TEST(FitTest, RefusesAStartAtWhichTheMassMatrixIsIndefinite) {
  Problem p = problem("models/unicycle.toml", 15, {"Ic"});
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::parameter) h.value = h.lower = 0.001;
  }
  EXPECT_THROW(fit(p.prior, p.observations, p.hyperparameters, quick()), InputError);
}

TEST(FitTest, WithoutHyperparametersItConditions) {
  const Problem p = problem("models/duffing.toml", 15);
  const Fit result = fit(p.prior, p.observations, {}, quick());
  EXPECT_EQ(result.report.restarts.size(), 1u);
  EXPECT_TRUE(std::isfinite(result.report.negative_log_likelihood));
}

}  // namespace
}  // namespace gp2
