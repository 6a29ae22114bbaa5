#include "gp2/baselines/baseline.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "input_error.hpp"
#include "reference_data.hpp"
#include "test_models.hpp"
#include "training/objective.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::Contains;
using testing::HasSubstr;
using testing::Not;

constexpr std::uint64_t seed = 70701;

// a problem as the command makes it, of generated data
FitProblem problem(Baseline::Kind kind, const std::string& file = "models/surface.toml", int n = 20) {
  const Model& model = test::model(file);
  GenerateOptions generated{n, seed, {}};
  generated.noise_stddev = VectorXd::Constant(model.system->nq(), 0.05);
  const GeneratedData data = generate(model, generated);
  std::string csv;
  const std::vector<std::string> states = model.system->state_names();
  for (const std::string& name : states) csv += name + ",";
  for (const Coordinate& coordinate : model.system->coordinates()) csv += coordinate.acceleration() + ",";
  csv += "end\n";
  for (Index i = 0; i < data.states.cols(); ++i) {
    for (const double x : data.states.col(i)) csv += (std::isnan(x) ? "0" : shortest(x)) + ",";
    for (const double y : data.accelerations.col(i)) csv += shortest(y) + ",";
    csv += "0\n";
  }
  FitProblemOptions options;
  options.baseline = kind;
  options.noise_stddev = 0.05;
  return make_fit_problem(model, CsvTable::parse(csv, "log.csv"), options);
}

FitOptions quick() {
  FitOptions options = baseline_fit_options();
  options.n_restarts = 4;
  options.max_iterations = 40;
  options.n_threads = 1;
  return options;
}

Fit fit_of(const FitProblem& p, const FitOptions& options = quick()) {
  return fit_baseline(p.prior_options.baseline->kind, p.prior, p.observations, p.hyperparameters, options);
}

std::vector<std::string> names(const std::vector<Hyperparameter>& hyperparameters) {
  std::vector<std::string> names;
  for (const Hyperparameter& h : hyperparameters) names.push_back(h.name);
  return names;
}

TEST(Baseline, HasWordsForItsKinds) {
  for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::icm, Baseline::Kind::lmc}) {
    EXPECT_EQ(Baseline::kind_of(Baseline::word(kind)), kind);
  }
  EXPECT_EQ(Baseline::kind_of("gp"), std::nullopt);
}

TEST(Baseline, LearnsTheAccelerationOfASystemWithoutConstraintsButIsJudgedByThem) {
  for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::icm, Baseline::Kind::lmc}) {
    const FitProblem p = problem(kind);
    EXPECT_EQ(p.prior.system->nc(), 0);
    EXPECT_EQ(p.prior.reference_system().nc(), 1);
    const Observations& observed = p.observations.front();
    const VectorXd mean = observed.values().rowwise().mean();
    EXPECT_EQ(p.prior.constant_mean, mean);
    const Posterior posterior = fit_of(p).posterior;
    const View ddq = View::all(View::Quantity::constrained_acceleration, *p.prior.system);
    const View a_bar = View::all(View::Quantity::unconstrained_acceleration, *p.prior.system);
    EXPECT_EQ(posterior.mean(ddq, observed.states()), posterior.mean(a_bar, observed.states()));
    const Evaluation e = evaluate_predictions(posterior, observed.states(), ddq.rows, observed.values());
    EXPECT_LT(e.rmse_normalised, 0.5);
    EXPECT_GT(e.max_constraint_error, 1e-6) << "it knows no constraint";
    EXPECT_LT(e.max_constraint_error, 10);
  }
}

TEST(Baseline, StoppedItHasWhatItHasFoundAndWhatFollowsStandsWhereItStarts) {
  const FitProblem p = problem(Baseline::Kind::se, "models/duffing.toml");
  std::atomic<bool> stop = false;
  FitOptions options = quick();
  options.stop = &stop;
  options.progress = [&](const Progress&) { stop = true; };
  const Fit found = fit_of(p, options);
  EXPECT_FALSE(found.report.converged);
  EXPECT_EQ(found.report.termination, FitReport::interrupted);
  ASSERT_EQ(found.report.hyperparameters.size(), p.hyperparameters.size());
  for (std::size_t k = 0; k < p.hyperparameters.size(); ++k) {
    const Hyperparameter &start = p.hyperparameters[k], &end = found.report.hyperparameters[k];
    EXPECT_EQ(end.name, start.name);
    if (start.owner > 0) {
      EXPECT_EQ(end.value, start.value) << start.name;
    }
  }
  EXPECT_NEAR(found.report.negative_log_likelihood, found.posterior.negative_log_likelihood(),
              1e-9 * std::abs(found.report.negative_log_likelihood));
}

TEST(Baseline, RefusesAccelerationsInAnotherOrder) {
  FitProblem p = problem(Baseline::Kind::se);
  View turned = p.observations.front().view();
  std::reverse(turned.rows.begin(), turned.rows.end());
  p.observations.front() = p.observations.front().with_view(turned);
  const auto refusal = AllOf(HasSubstr("all 3 accelerations in their order"), HasSubstr("rows 2, 1, 0 of 'constrained'"));
  EXPECT_THAT(test::input_error_of([&] { fit_of(p); }), refusal);
  EXPECT_THAT(test::input_error_of([&] { standardised_by(p.observations, p.prior, Baseline::Kind::se); }), refusal);
}

TEST(Baseline, AModelThatHasNoSystemIsRefused) {
  EXPECT_THAT(test::input_error_of([] { unstandardised(Model(), Baseline::Kind::se); }), HasSubstr("there is no system"));
}

TEST(Baseline, FarFromDataItReturnsToTheTrainingMean) {
  for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::icm}) {
    const FitProblem p = problem(kind);
    const MatrixXd far = MatrixXd::Constant(p.observations[0].states().rows(), 1, 1e6);
    const VectorXd mean = fit_of(p).posterior.mean(View::all(View::Quantity::constrained_acceleration, *p.prior.system), far);
    EXPECT_EQ(mean, p.prior.constant_mean);
  }
}

// in units of its rounding a constant would be astronomically far from every other value
TEST(Baseline, WhatDoesNotVaryButForRoundingHasTheUnitOne) {
  const FitProblem p = problem(Baseline::Kind::lmc, "models/duffing.toml");
  const Observations& observed = p.observations.front();
  MatrixXd states = observed.states(), values = observed.values();
  for (MatrixXd* one : {&states, &values}) {
    one->row(1).setConstant(0.1);
    (*one)(1, 3) = std::nextafter(0.1, 1);
  }
  ASSERT_GT(row_stddev(states)[1], 0);
  const std::vector<Observations> observations = {{states, observed.view(), values, observed.noise()}};
  EXPECT_EQ(standardised_by(observations, p.prior, Baseline::Kind::lmc).feature_stddev[1], 1);
  const std::vector<Hyperparameter> all = baseline_hyperparameters(p.prior, observations);
  const auto upper_of = [&](const std::string& name) {
    return std::find_if(all.begin(), all.end(), [&](const Hyperparameter& h) { return h.name == name; })->upper;
  };
  EXPECT_EQ(upper_of("se.lengthscale(q2)"), 20);
  EXPECT_EQ(upper_of("se.sqrt_kappa(ddq2)"), 1e4);
}

TEST(Baseline, TunesWhatItsCovarianceIsMadeOf) {
  const auto of = [](Baseline::Kind kind) { return names(problem(kind, "models/duffing.toml").hyperparameters); };
  EXPECT_THAT(
      of(Baseline::Kind::se),
      testing::ElementsAre("ddq1.lengthscale(q1)", "ddq1.lengthscale(q2)", "ddq1.lengthscale(dq1)", "ddq1.lengthscale(dq2)",
                           "ddq1.lengthscale(t)", "ddq1.signal_stddev", "ddq2.lengthscale(q1)", "ddq2.lengthscale(q2)",
                           "ddq2.lengthscale(dq1)", "ddq2.lengthscale(dq2)", "ddq2.lengthscale(t)", "ddq2.signal_stddev"));
  EXPECT_THAT(of(Baseline::Kind::icm),
              testing::ElementsAre("lengthscale(q1)", "lengthscale(q2)", "lengthscale(dq1)", "lengthscale(dq2)", "lengthscale(t)",
                                   "W(ddq1,1)", "W(ddq2,1)", "W(ddq1,2)", "W(ddq2,2)", "sqrt_kappa(ddq1)", "sqrt_kappa(ddq2)"));
  const std::vector<std::string> lmc = of(Baseline::Kind::lmc);
  EXPECT_EQ(lmc.size(), 5 + 3 * 6U);
  EXPECT_THAT(lmc, AllOf(Contains("se.lengthscale(t)"), Contains("bias.W(ddq2,1)"), Contains("linear.sqrt_kappa(ddq1)")));
  EXPECT_THAT(lmc, Not(Contains(HasSubstr("linear.lengthscale"))));
}

TEST(Baseline, TheEntriesOfAFreeLoadingAreWAndTheDiagonalOfRootKappa) {
  Latent latent;
  latent.column_names = {"ddx", "ddy"};
  EXPECT_TRUE(loading_entries(latent).empty());
  latent.free_loading = 5;  // W of three columns
  const std::vector<LoadingEntry> entries = loading_entries(latent);
  ASSERT_EQ(entries.size(), 3 * 2 + 2U);
  // where each stands in C (2 × 5)
  MatrixXd C = MatrixXd::Zero(2, 5);
  for (const LoadingEntry& entry : entries) C.reshaped()[entry.index_in_loading] = 1 + entry.index;
  MatrixXd expected(2, 5);
  expected << 1, 3, 5, 1, 0,  //
      2, 4, 6, 0, 2;
  EXPECT_EQ(C, expected);
}

TEST(Baseline, TheObjectiveHasTheGradientOfDifferences) {
  const FitProblem p = problem(Baseline::Kind::lmc, "models/duffing.toml");
  std::vector<Hyperparameter> start = p.hyperparameters;
  RandomStream random(seed);
  for (Hyperparameter& h : start) h.value = std::clamp(h.value + 0.2 * h.size * random.normal(), h.lower, h.upper);
  const Objective objective(p.prior, p.observations, start);
  const VectorXd x = coordinates(start);
  VectorXd gradient(x.size());
  Likelihood::Workspace workspace;
  objective(x, &gradient, workspace);
  for (Index k = 0; k < x.size(); ++k) {
    SCOPED_TRACE(start[static_cast<std::size_t>(k)].name);
    const auto at = [&](double there) -> VectorXd {
      VectorXd moved = x;
      moved[k] = there;
      return VectorXd::Constant(1, objective(moved, nullptr, workspace));
    };
    EXPECT_TRUE(test::matches(gradient.segment(k, 1), test::central_difference(at, x[k], 0.1, 1e-12)));
  }
}

TEST(Baseline, OfIndependentOutputsIsTrainedOneByOneAsItWouldBeTogether) {
  const FitProblem p = problem(Baseline::Kind::se);
  const Fit one_by_one = fit_of(p);
  // the posterior of all outputs together has the likelihood of the sum
  const double nll = one_by_one.report.negative_log_likelihood;
  EXPECT_NEAR(one_by_one.posterior.negative_log_likelihood(), nll, 1e-9 * (1 + std::abs(nll)));
  EXPECT_EQ(names(one_by_one.report.hyperparameters), names(p.hyperparameters));
  EXPECT_EQ(one_by_one.report.restarts.size(), 4U);
  EXPECT_EQ(one_by_one.report.restarts[0].objective, one_by_one.report.objective);
  // from there the trainer of all at once finds nothing lower
  FitOptions options = quick();
  options.n_restarts = 1;
  options.max_iterations = 200;
  const Fit together = fit(p.prior, p.observations, one_by_one.report.hyperparameters, options);
  FitOptions longer = quick();
  longer.max_iterations = 300;
  EXPECT_LE(fit_of(p, longer).report.negative_log_likelihood, together.report.negative_log_likelihood + 0.01);
}

TEST(Baseline, OfIndependentOutputsTellsTheProgressOfTheWhole) {
  const FitProblem se = problem(Baseline::Kind::se);
  FitOptions options = quick();
  double fraction = 0, seconds = 0;
  int calls = 0;
  options.progress = [&](const Progress& progress) {
    ++calls;
    EXPECT_GE(progress.fraction, fraction);
    EXPECT_LE(progress.fraction, 1);
    EXPECT_GE(progress.seconds, seconds);
    fraction = progress.fraction;
    seconds = progress.seconds;
  };
  fit_of(se, options);
  EXPECT_GT(calls, 3);
  EXPECT_GT(fraction, 0.9);
}

TEST(Baseline, OfMoreTermsHasNoLowerLikelihood) {
  FitOptions options = quick();
  options.max_iterations = 200;
  const double icm = fit_of(problem(Baseline::Kind::icm), options).report.negative_log_likelihood;
  const double lmc = fit_of(problem(Baseline::Kind::lmc), options).report.negative_log_likelihood;
  EXPECT_LE(lmc, icm + 1e-3);
}

TEST(Baseline, GivesTheSameBitsForAnyNumberOfThreads) {
  for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::lmc}) {
    const FitProblem p = problem(kind);
    FitOptions options = quick();
    const Fit one = fit_of(p, options);
    options.n_threads = 3;
    const Fit three = fit_of(p, options);
    for (std::size_t k = 0; k < one.report.hyperparameters.size(); ++k) {
      EXPECT_EQ(one.report.hyperparameters[k].value, three.report.hyperparameters[k].value);
    }
    EXPECT_EQ(one.report.objective, three.report.objective);
  }
}

TEST(Baseline, LetsGoOfMixingMatricesThatEveryRunLeavesAtZero) {
  const FitProblem p = problem(Baseline::Kind::lmc);
  FitOptions options = quick();
  options.max_iterations = 300;
  const FitReport report = fit_of(p, options).report;
  const auto largest = [](const std::vector<Hyperparameter>& hyperparameters, const std::string& prefix) {
    double size = 0;
    for (const Hyperparameter& h : hyperparameters) {
      if (h.name.starts_with(prefix)) size = std::max(size, std::abs(h.value));
    }
    return size;
  };
  EXPECT_EQ(largest(p.hyperparameters, "linear.W"), 0);
  EXPECT_GT(largest(report.hyperparameters, "linear.W"), 0);
  // no worse than with these matrices held at zero
  std::vector<Hyperparameter> held;
  for (const Hyperparameter& h : p.hyperparameters) {
    if (!h.name.starts_with("linear.W") && !h.name.starts_with("bias.W")) held.push_back(h);
  }
  EXPECT_LT(report.objective, fit(p.prior, p.observations, held, options).report.objective);
}

TEST(Baseline, ReachesThePublishedLikelihoodsAndErrors) {
  if (const auto absent = test::why_reference_is_absent()) GTEST_SKIP() << *absent;
  const auto published = nlohmann::json::parse(read_file(test::reference_file("table1.json")));
  for (const std::string system : {"surface", "unicycle"}) {
    for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::icm}) {
      SCOPED_TRACE(system + " " + Baseline::word(kind));
      const Model& model = test::model("experiments/" + system + "_published.toml");
      FitProblemOptions options;
      options.baseline = kind;
      const CsvTable train = CsvTable::read(test::reference_file("train/" + system + "_run0.csv"));
      const CsvTable grid = CsvTable::read(test::reference_file("grid/" + system + "_grid.csv"));
      const FitProblem p = make_fit_problem(model, train, options);
      FitOptions few = baseline_fit_options();
      few.n_restarts = 3;
      const Fit result = fit_of(p, few);
      const Observations& observed = p.observations.front();
      const LogStates at = read_log_states(p.prior, observed.view(), model, grid, {}, observed.view().names(*model.system));
      const Evaluation e = evaluate_predictions(result.posterior, at.states, observed.view().rows, at.accelerations);
      const auto& reference =
          published[system][kind == Baseline::Kind::se ? "SE" : "ICM"]["recomputed_at_published_hyperparameters"];
      const double in_published_units =
          result.report.negative_log_likelihood - observed.n_data() * row_stddev(observed.values()).array().log().sum();
      EXPECT_NEAR(in_published_units, reference["nll_per_run"][0].get<double>(), 0.01);
      const double rmse = reference["rmse_per_run"][0];
      EXPECT_NEAR(e.rmse_normalised, rmse, 0.001 * rmse);
      const double error = reference["max_constraint_error_per_run"][0];
      // the published unicycle row is ours times cos q3
      if (system == "surface") {
        EXPECT_NEAR(e.max_constraint_error, error, 0.01 * error);
      }
    }
  }
}

}  // namespace
}  // namespace gp2
