#include "training/hamiltonian.hpp"

#include <atomic>
#include <cmath>
#include <limits>
#include <vector>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "gp2/training/laplace.hpp"
#include "input_error.hpp"
#include "training/drawn_problem.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::DrawnProblem;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t hamiltonian_seed = 90210;

const Model& sloped_line() {
  static const Model model =
      Model::parse(test::changed(test::line().text, {{"acceleration = [\"0\"]", "acceleration = [\"sin(3*dx)\"]"}}), "line");
  return model;
}

// A bead on a straight slope with drag.
const Model& slope() {
  static const Model model = Model::parse(R"toml(
name        = "slope"
coordinates = ["x", "y"]
[parameters]
c = { value = 0.5, bounds = [0.1, 2] }
s = { value = 0.4, bounds = [0.2, 0.8] }
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["-c*dx", "-c*dy - 9.81"]
[constraints]
position = ["y - s*x"]
[[latent]]
kernel     = "se"
features   = ["dx"]
directions = "acceleration"
[noise]
ddq = 0.05
[truth]
acceleration = ["-sin(2*dx)", "0"]
[sampling]
x  = [-1, 2]
dx = [-1, 1]
)toml",
                                          "slope");
  return model;
}

DrawnProblem make_problem(const Model& model, int n, const std::vector<std::string>& estimated, double noise_stddev = 0.3) {
  return test::drawn_problem(model, n, estimated, hamiltonian_seed, noise_stddev);
}

FitOptions drawing(int n_draws, int n_threads = 2) {
  FitOptions options;
  options.n_restarts = 2;
  options.n_threads = n_threads;
  options.seed = hamiltonian_seed;
  options.n_draws = n_draws;
  return options;
}

Fit fit_of(const DrawnProblem& p, const FitOptions& options) { return fit(p.prior, p.observations, p.hyperparameters, options); }

TEST(HamiltonianTest, DrawsAreOfAGaussianWhereTheLikelihoodIsQuadratic) {
  const DrawnProblem p = only(make_problem(sloped_line(), 30, {"p", "r"}), {Kind::parameter});
  const FitReport report = fit_of(p, drawing(25)).report;
  ASSERT_TRUE(report.draws);
  const HyperparameterDraws& draws = *report.draws;
  const LaplaceUncertainty exact = report.uncertainty.value();
  EXPECT_EQ(draws.size(), 25);
  EXPECT_LE(draws.evaluations, draw_evaluations);
  EXPECT_GT(draws.acceptance, 0.6);
  for (Index k = 0; k < 2; ++k) {
    EXPECT_GT(draws.effective_size[k], 100);
    EXPECT_LT(draws.r_hat[k], 1.05);
    const double error = exact.stddev[k] / std::sqrt(draws.effective_size[k]);
    EXPECT_NEAR(draws.mean[k], report.hyperparameters[static_cast<std::size_t>(k)].value, 4 * error);
    EXPECT_NEAR(draws.stddev[k], exact.stddev[k], 0.2 * exact.stddev[k]);
    EXPECT_NEAR(draws.upper[k] - draws.lower[k], 2 * 1.96 * exact.stddev[k], 0.25 * 3.92 * exact.stddev[k]);
  }
  EXPECT_NEAR(draws.correlation(0, 1), exact.correlation(0, 1), 0.2);
}

// Moments of v by the sum over a grid of the box of two hyperparameters, even in their coordinates.
struct GridMoments {
  VectorXd mean = VectorXd::Zero(2), square = VectorXd::Zero(2);
  explicit GridMoments(const DrawnProblem& p) {
    const Objective objective(p.prior, p.observations, p.hyperparameters);
    constexpr int n = 80;
    MatrixXd J(n, n);
    std::vector<VectorXd> values;
    Likelihood::Workspace workspace;
    const auto at = [&](std::size_t k, int i) {
      const Hyperparameter& h = p.hyperparameters[k];
      return h.lower_coordinate() + (i + 0.5) / n * (h.upper_coordinate() - h.lower_coordinate());
    };
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) J(i, j) = objective(VectorXd{{at(0, i), at(1, j)}}, nullptr, workspace);
    }
    const MatrixXd weight = (J.minCoeff() - J.array()).exp();
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) {
        const VectorXd v{{p.hyperparameters[0].value_at(at(0, i)), p.hyperparameters[1].value_at(at(1, j))}};
        mean += weight(i, j) / weight.sum() * v;
        square += weight(i, j) / weight.sum() * v.cwiseAbs2();
      }
    }
  }
  [[nodiscard]] VectorXd stddev() const { return (square - mean.cwiseAbs2()).cwiseSqrt(); }
};

TEST(HamiltonianTest, MomentsAreThoseOfTheDensityWithinItsBox) {
  // lengthscale and signal of ten measurements: no Gaussian, and walls on both sides
  DrawnProblem p = only(make_problem(sloped_line(), 10, {}), {Kind::kernel, Kind::signal_stddev});
  ASSERT_EQ(p.hyperparameters.size(), 2U);
  for (Hyperparameter& h : p.hyperparameters) {
    h.lower = h.value / 3;
    h.upper = h.value * 3;
  }
  const GridMoments exact(p);
  const Objective objective(p.prior, p.observations, p.hyperparameters);
  HamiltonianOptions options;
  options.seed = hamiltonian_seed;
  options.max_evaluations = 10 * draw_evaluations;
  const HyperparameterDraws draws =
      draw_about(objective, {fit_of(p, drawing(0)).report.hyperparameters}, {false, false}, 25, options);
  for (Index k = 0; k < 2; ++k) {
    // a deviation of a kurtosis of 6 is then right to √(5/(4 · 800)) = 0.04
    EXPECT_GT(draws.effective_size[k], 800);
    EXPECT_LT(draws.r_hat[k], 1.1);
    EXPECT_NEAR(draws.mean[k], exact.mean[k], 4 * exact.stddev()[k] / std::sqrt(draws.effective_size[k]));
    EXPECT_NEAR(draws.stddev[k], exact.stddev()[k], 0.2 * exact.stddev()[k]);
    EXPECT_GE(draws.values.row(k).minCoeff(), p.hyperparameters[static_cast<std::size_t>(k)].lower);
    EXPECT_LE(draws.values.row(k).maxCoeff(), p.hyperparameters[static_cast<std::size_t>(k)].upper);
  }
}

TEST(HamiltonianTest, AParameterWhosePriorIsOfItsLogarithmHasThatDensity) {
  // noise so large that the prior alone tells
  DrawnProblem p = only(make_problem(sloped_line(), 10, {"p"}, 1e4), {Kind::parameter});
  ASSERT_EQ(p.hyperparameters.size(), 1U);
  constexpr double median = 0.2, stddev = 0.5;
  Hyperparameter& h = p.hyperparameters.front();
  h.value = median, h.lower = 0.005, h.upper = 8;
  h.hyperprior = {HyperPrior::Form::log_normal, median, stddev};
  const Objective objective(p.prior, p.observations, p.hyperparameters);
  HamiltonianOptions options;
  options.seed = hamiltonian_seed;
  options.max_evaluations = 10 * draw_evaluations;
  const HyperparameterDraws draws = draw_about(objective, {p.hyperparameters}, {false}, 25, options);
  const double mean = median * std::exp(stddev * stddev / 2), spread = mean * std::sqrt(std::expm1(stddev * stddev));
  EXPECT_GT(draws.effective_size[0], 800);
  EXPECT_NEAR(draws.mean[0], mean, 4 * spread / std::sqrt(draws.effective_size[0]));
  EXPECT_NEAR(draws.lower[0], median * std::exp(-1.96 * stddev), 0.015);
}

TEST(HamiltonianTest, SameSeedSameBitsForAnyNumberOfThreads) {
  const DrawnProblem p = make_problem(sloped_line(), 12, {"p"});
  const Fit one = fit_of(p, drawing(5, 1)), three = fit_of(p, drawing(5, 3));
  EXPECT_EQ(one.report.draws->values, three.report.draws->values);
  EXPECT_EQ(one.report.draws->r_hat, three.report.draws->r_hat);
  EXPECT_EQ(one.report.draws->evaluations, three.report.draws->evaluations);
  FitOptions other = drawing(5);
  other.seed = 1;
  EXPECT_NE(fit_of(p, other).report.draws->values, one.report.draws->values);
}

TEST(HamiltonianTest, WhatIsHeldStaysPut) {
  // of the system's parameters none has equal bounds
  DrawnProblem p = make_problem(sloped_line(), 12, {"p"});
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::signal_stddev) h.lower = h.upper = h.value;
  }
  const HyperparameterDraws draws = fit_of(p, drawing(6)).report.draws.value();
  for (std::size_t k = 0; k < p.hyperparameters.size(); ++k) {
    const Hyperparameter& h = p.hyperparameters[k];
    const auto row = draws.values.row(static_cast<Index>(k));
    EXPECT_EQ(draws.is_drawn(static_cast<Index>(k)), !h.is_fixed()) << h.name;
    if (h.is_fixed()) {
      EXPECT_TRUE((row.array() == h.value).all()) << h.name;
    } else {
      EXPECT_GT(row.maxCoeff(), row.minCoeff()) << h.name;
    }
  }
  // nothing to draw: no draws, and the fit is that without
  p = make_problem(sloped_line(), 12, {});
  for (Hyperparameter& h : p.hyperparameters) h.lower = h.upper = h.value;
  EXPECT_FALSE(fit_of(p, drawing(6)).report.draws);
}

TEST(HamiltonianTest, TheMixtureObeysOneConstraint) {
  // the slope enters A and b, the drag does not
  const DrawnProblem p = make_problem(slope(), 20, {"c", "s"}, 0.05);
  const Fit fitted = fit_of(p, drawing(6));
  const HyperparameterDraws& draws = fitted.report.draws.value();
  for (std::size_t k = 0; k < p.hyperparameters.size(); ++k) {
    const std::string& name = p.hyperparameters[k].name;
    EXPECT_EQ(draws.is_drawn(static_cast<Index>(k)), name != "s") << name;
    if (name != "s") continue;
    EXPECT_TRUE((draws.values.row(static_cast<Index>(k)).array() == fitted.report.hyperparameters[k].value).all());
  }
  EXPECT_EQ(fitted.posterior.n_components(), 6);
  const System& system = *p.prior.system;
  const View view = View::constrained_acceleration(system);
  const MatrixXd& states = p.observations.front().states();
  const MatrixXd mean = fitted.posterior.mean(view, states);
  const VectorXd& parameters = fitted.posterior.values().parameters;
  EXPECT_LE(max_constraint_error(system, states, parameters, mean), 1e-9 * (1 + mean.cwiseAbs().maxCoeff()));
  const MatrixXd sample = fitted.posterior.sample({{view, states.leftCols(4)}}, 5, 1);
  for (Index s = 0; s < 5; ++s) {
    const MatrixXd one = sample.col(s).reshaped(system.nq(), 4);
    EXPECT_LE(max_constraint_error(system, states.leftCols(4), parameters, one), 1e-9 * (1 + one.cwiseAbs().maxCoeff()));
  }
}

TEST(HamiltonianTest, AFitThatIsStoppedWhileItDrawsIsThatOfTheOptimum) {
  const DrawnProblem p = make_problem(sloped_line(), 12, {});
  const FitReport whole = fit_of(p, drawing(0)).report;
  for (const double from : {0.0, 0.5}) {
    std::atomic<bool> stop = false;
    FitOptions options = drawing(6);
    options.stop = &stop;
    options.progress = [&](const Progress& progress) {
      if (progress.is_drawing && progress.fraction > from) stop = true;
    };
    const Fit stopped = fit_of(p, options);
    EXPECT_EQ(stopped.report.termination, FitReport::interrupted);
    EXPECT_FALSE(stopped.report.converged);
    EXPECT_FALSE(stopped.report.draws);
    EXPECT_EQ(stopped.posterior.n_components(), 1);
    for (std::size_t k = 0; k < whole.hyperparameters.size(); ++k) {
      EXPECT_EQ(stopped.report.hyperparameters[k].value, whole.hyperparameters[k].value);
    }
  }
}

TEST(HamiltonianTest, TheNumberOfDrawsIsChecked) {
  const DrawnProblem p = make_problem(sloped_line(), 5, {});
  EXPECT_EQ(test::input_error_of([&] { fit_of(p, drawing(-1)); }), "fit: n_draws must be at least 0, got -1");
}

TEST(HamiltonianTest, LeftOutValuesAreWeighedByWhatTheyDoToEachDraw) {
  const DrawnProblem p = make_problem(sloped_line(), 8, {});
  const Fit fitted = fit_of(p, drawing(4));
  const LeftOut all_left_out = leave_out(fitted.posterior, 0);
  const LeaveOneOut &left_out = all_left_out.values.front(), &row = all_left_out.rows.front();
  const Observations& all = p.observations.front();
  const View view = View::constrained_acceleration(*p.prior.system);
  for (int i = 0; i < all.n_data(); ++i) {
    std::vector<int> others;
    for (int j = 0; j < all.n_data(); ++j) {
      if (j != i) others.push_back(j);
    }
    VectorXd weight(4), mean(4), variance(4);
    for (int k = 0; k < 4; ++k) {
      const ModelValues values = fitted.posterior.component(k).values();
      const Posterior::Marginal one = Posterior(p.prior, {all.take(others)}, values).marginal(view, all.states().col(i));
      mean[k] = one.mean(0);
      variance[k] = one.covariance(0);
      const double error = all.values()(0, i) - mean[k], total = variance[k] + 0.09;
      weight[k] = std::sqrt(total) * std::exp(0.5 * error * error / total);
    }
    weight /= weight.sum();
    const VectorXd deviation = mean.array() - weight.dot(mean);
    for (const LeaveOneOut* const one : {&left_out, &row}) {
      EXPECT_NEAR(one->mean(0, i), weight.dot(mean), 1e-9);
      EXPECT_NEAR(one->variance(0, i), weight.dot(VectorXd(variance + deviation.cwiseAbs2())), 1e-9);
    }
  }
}

TEST(HamiltonianTest, DrawsWithoutAPosteriorAreLeftOutUnlessAllAreSuch) {
  const DrawnProblem p = only(make_problem(sloped_line(), 12, {"p", "r"}), {Kind::parameter});
  FitReport report = fit_of(p, drawing(3)).report;
  const MatrixXd values = report.draws->values;
  const double largest = std::numeric_limits<double>::max();  // of which p x + r overflows
  report.draws->values.col(1).setConstant(largest);
  const Posterior posterior = possible_posterior(p.prior, p.observations, report, {});
  EXPECT_EQ(posterior.n_components(), 2);
  EXPECT_EQ(report.draws->n_impossible, 1);
  EXPECT_EQ(report.draws->values, MatrixXd(values(Eigen::all, {0, 2})));
  report.draws->values.setConstant(largest);
  EXPECT_THROW(static_cast<void>(possible_posterior(p.prior, p.observations, report, {})), InputError);
}

}  // namespace
}  // namespace gp2
