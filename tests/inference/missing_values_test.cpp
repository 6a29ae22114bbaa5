#include <algorithm>
#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"
#include "observations_testing.hpp"

// Observations some of whose values are not measured, and what is predicted of a value when it is left out.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Extended;
using test::ExtendedVector;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t missing_values_seed = 40711;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();

// with a third of the values gone, at one state all of them
Problem with_gaps(Problem p, std::uint64_t stream) {
  RandomStream random(missing_values_seed, stream);
  for (Observations& group : p.observations) {
    MatrixXd values = group.values();
    for (double& value : values.reshaped()) {
      if (random.uniform() < 1.0 / 3) value = nan;
    }
    values.col(1).setConstant(nan);
    group = group.with_values(values);
    // of no meaning where nothing is measured, so anything may stand there
    if (group.noise().has_scale()) group = test::with_scale(group, values.array().isNaN().select(-1, group.noise().scale()));
  }
  return p;
}

// plain ones, and some with a noise of its own for each value
std::vector<Problem> gappy_problems() {
  std::vector<Problem> all;
  for (const Problem& p : test::problems(9, missing_values_seed)) {
    const std::uint64_t stream = all.size();
    all.push_back(with_gaps(stream % 2 == 0 ? p : test::with_noise_scale(p, missing_values_seed + stream), stream));
  }
  return all;
}

double gappy_rounding(const Problem& p) {
  Problem whole = p;
  for (Observations& group : whole.observations) {
    const MatrixXd& scale = group.noise().scale();
    if (group.noise().has_scale()) group = test::with_scale(group, (scale.array() > 0).select(scale, 1));
    group = group.with_values(MatrixXd::Zero(group.values().rows(), group.values().cols()));
  }
  return test::rounding(whole);
}

// −log N of the measured values alone
double dense_density_of_measured(const Problem& p) {
  const test::DenseObservations dense = test::dense_observations(p);
  std::vector<Index> rows;
  for (Index k = 0; k < dense.residual.size(); ++k) {
    if (!std::isnan(static_cast<double>(dense.residual[k]))) rows.push_back(k);
  }
  const Eigen::LLT<Extended> factor(Extended(dense.covariance(rows, rows)));
  const ExtendedVector white = factor.matrixL().solve(ExtendedVector(dense.residual(rows)));
  const long double log_det_half = Extended(factor.matrixL()).diagonal().array().log().sum();
  return static_cast<double>(white.squaredNorm() / 2 + log_det_half +
                             static_cast<long double>(rows.size()) * std::log(2 * std::numbers::pi_v<long double>) / 2);
}

// the same data with a group for each state, whose view has the measured rows alone
Problem taken_apart(const Problem& p) {
  Problem apart = p;
  apart.observations.clear();
  apart.values.noise_stddev.clear();
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    const Observations& group = p.observations[g];
    for (Index i = 0; i < group.values().cols(); ++i) {
      std::vector<int> measured;
      for (int k = 0; k < group.view().size(); ++k) {
        if (!std::isnan(group.values()(k, i))) measured.push_back(k);
      }
      if (measured.empty()) continue;
      View view = group.view();
      view.rows.clear();
      for (const int k : measured) view.rows.push_back(group.view().rows[static_cast<std::size_t>(k)]);
      apart.values.noise_stddev.push_back(group.noise_at(p.values.noise_stddev[g], i)(measured));
      apart.observations.emplace_back(group.states().col(i), view, group.values().col(i)(measured),
                                      apart.values.noise_stddev.back());
    }
  }
  return apart;
}

TEST(MissingValuesTest, TheLikelihoodIsTheDenseDensityOfTheMeasuredValuesAlone) {
  int n_well_conditioned = 0;
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const double dense = dense_density_of_measured(p);
    ASSERT_TRUE(std::isfinite(dense));
    EXPECT_NEAR(test::evaluate(p).value, dense, gappy_rounding(p) * (1 + std::abs(dense)));
    EXPECT_NEAR(test::posterior_of(p).negative_log_likelihood(), dense, gappy_rounding(p) * (1 + std::abs(dense)));
    if (gappy_rounding(p) > 1e-9) continue;
    EXPECT_NEAR(test::evaluate(p).value, dense, 1e-12 * (1 + std::abs(dense)));
    ++n_well_conditioned;
  }
  EXPECT_GT(n_well_conditioned, 10);
}

TEST(MissingValuesTest, GapsAreTheSameAsAViewOfItsOwnForEachState) {
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const Problem apart = taken_apart(p);
    const test::Evaluated got = test::evaluate(p), expected = test::evaluate(apart);
    EXPECT_NEAR(got.value, expected.value, gappy_rounding(p) * (1 + std::abs(expected.value)));
    for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
      EXPECT_LE(largest(got.gradient.log_kernel[a] - expected.gradient.log_kernel[a]),
                gappy_rounding(p) * (1 + largest(expected.gradient.log_kernel[a])));
      EXPECT_LE(largest(got.gradient.log_signal_stddev[a] - expected.gradient.log_signal_stddev[a]),
                gappy_rounding(p) * (1 + largest(expected.gradient.log_signal_stddev[a])));
    }
    const MatrixXd mean = test::posterior_of(apart).mean(test::every_acceleration(p), p.queries);
    EXPECT_LE(largest(test::posterior_of(p).mean(test::every_acceleration(p), p.queries) - mean),
              gappy_rounding(p) * (1 + largest(mean)));
  }
}

TEST(MissingValuesTest, TheGradientIsThatOfTheLikelihood) {
  int n_nonzero = 0;
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const Likelihood likelihood(p.prior, p.observations, p.values, test::every_derivative(p));
    Likelihood::Workspace workspace;
    ModelGradient gradient;
    const double value = likelihood.evaluate(p.values, &gradient, workspace);
    const auto expect_match = [&](double analytic, double x, bool positive, const auto& member) {
      const auto at = [&](double moved) -> VectorXd {
        ModelValues values = p.values;
        member(values) = positive ? std::exp(moved) : moved;
        return VectorXd::Constant(1, likelihood.evaluate(values, nullptr, workspace));
      };
      const double scale = positive ? 0.5 : 0.05 * (x == 0 ? 1 : std::abs(x));
      const test::Difference difference =
          test::central_difference(at, positive ? std::log(x) : x, scale, std::max(64 * test::eps, gappy_rounding(p) / 100));
      EXPECT_TRUE(test::matches(VectorXd::Constant(1, analytic), difference)) << "value " << value;
      if (std::abs(analytic) > 10 * difference.error[0]) ++n_nonzero;
    };
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      for (Index k = 0; k < p.values.noise_stddev[g].size(); ++k) {
        SCOPED_TRACE(fmt::format("noise {} of group {}", k, g));
        expect_match(gradient.log_noise_stddev[g][k], p.values.noise_stddev[g][k], true,
                     [&](ModelValues& v) -> double& { return v.noise_stddev[g][k]; });
      }
    }
    const std::vector<Parameter>& parameters = p.prior.system->parameters();
    for (Index k = 0; k < gradient.parameters.size(); ++k) {
      const std::string& name = parameters[static_cast<std::size_t>(k)].name;
      if (std::find(p.not_estimable.begin(), p.not_estimable.end(), name) != p.not_estimable.end()) continue;
      SCOPED_TRACE(name);
      expect_match(gradient.parameters[k], p.values.parameters[k], false,
                   [&](ModelValues& v) -> double& { return v.parameters[k]; });
    }
  }
  EXPECT_GT(n_nonzero, 100) << "the test must not pass empty";
}

TEST(MissingValuesTest, WhatStandsBesideAGapChangesNoBit) {
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    Problem other = p;
    for (Observations& group : other.observations) {
      if (!group.noise().has_scale()) continue;
      group = test::with_scale(group, group.values().array().isNaN().select(nan, group.noise().scale()));
    }
    const test::Evaluated expected = test::evaluate(p), got = test::evaluate(other);
    EXPECT_EQ(got.value, expected.value);
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      EXPECT_EQ(got.gradient.log_noise_stddev[g], expected.gradient.log_noise_stddev[g]);
    }
  }
}

TEST(MissingValuesTest, APosteriorGrowsAndShrinksWithThem) {
  const Problem p = gappy_problems().front();
  const Observations& all = p.observations[0];
  Posterior posterior = test::posterior_of(p).without_data();
  const auto part = [&](int first, int last) {
    std::vector<int> states;
    for (int i = first; i <= last; ++i) states.push_back(i);
    return test::with_stddev(all, p.values.noise_stddev[0]).take(states);
  };
  posterior = update(std::move(posterior), part(0, 3));
  posterior = update(std::move(posterior), part(4, all.n_data() - 1));
  const MatrixXd mean = test::posterior_of(p).mean(test::every_acceleration(p), p.queries);
  EXPECT_LE(largest(posterior.mean(test::every_acceleration(p), p.queries) - mean), gappy_rounding(p) * (1 + largest(mean)));
  EXPECT_NEAR(posterior.negative_log_likelihood(), test::posterior_of(p).negative_log_likelihood(),
              gappy_rounding(p) * (1 + std::abs(posterior.negative_log_likelihood())));
  posterior = remove_oldest(std::move(posterior), 2);
  const Posterior expected(p.prior, {part(2, all.n_data() - 1)}, p.values);
  const MatrixXd rest = expected.mean(test::every_acceleration(p), p.queries);
  EXPECT_LE(largest(posterior.mean(test::every_acceleration(p), p.queries) - rest), gappy_rounding(p) * (1 + largest(rest)));
}

TEST(MissingValuesTest, FiguresOfARowAreThoseOfItsMeasuredValues) {
  const MatrixXd values = (MatrixXd(3, 4) << 1, nan, 3, nan, nan, nan, nan, nan, 1, 2, 3, 4).finished();
  EXPECT_EQ(row_mean(values)[0], 2);
  EXPECT_EQ(row_stddev(values)[0], 1);
  EXPECT_TRUE(std::isnan(row_mean(values)[1]) && std::isnan(row_stddev(values)[1]));
  EXPECT_EQ(row_stddev(values)[2], row_stddev(values.bottomRows(1))[0]);
  const Observations group(MatrixXd::Zero(1, 4), {Quantity::constrained_acceleration, {0, 1, 2}}, values, VectorXd::Ones(3),
                           false, (MatrixXd(3, 4) << 1, 90, 3, 90, 1, 1, 1, 1, 5, 6, 7, 8).finished());
  EXPECT_EQ(group.measured_scales(0), (std::vector<double>{1, 3}));
  EXPECT_EQ(group.usual_noise(Eigen::Vector3d(1, 1, 2)), Eigen::Vector3d(3, 1, 14));
  EXPECT_EQ(group.noise_at(Eigen::Vector3d(1, 1, 2), 1),
            Eigen::Vector3d(std::numeric_limits<double>::infinity(), std::numeric_limits<double>::infinity(), 12));
}

TEST(MissingValuesTest, AnEvaluationLeavesThemOut) {
  const Problem p = gappy_problems().front();
  const View every = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const Posterior posterior = test::posterior_of(p);
  const MatrixXd mean = posterior.mean(every, p.queries);
  MatrixXd targets = mean;
  for (Index i = 0; i < targets.cols(); ++i) targets(0, i) += 1 + static_cast<double>(i);
  const Evaluation whole = evaluate_predictions(posterior, p.queries.leftCols(2), every.rows, targets.leftCols(2));
  targets(0, 2) = nan;
  const Evaluation e = evaluate_predictions(posterior, p.queries, every.rows, targets);
  EXPECT_EQ(e.n, p.queries.cols());
  EXPECT_EQ(e.n_missing, 1);
  EXPECT_EQ(whole.n_missing, 0);
  EXPECT_NEAR(e.rmse[0], whole.rmse[0], 1e-12 * whole.rmse[0]);
  EXPECT_TRUE(std::isfinite(e.nlpd) && std::isfinite(e.nrmse));
}

// where constraints are soft, the other rows of a state tell of its slip too
TEST(LeaveOneOutTest, EachValueIsPredictedByTheDenseDensityOfTheOthers) {
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const std::vector<LeaveOneOut> left_out = leave_one_out(test::posterior_of(p));
    const test::DenseObservations dense = test::dense_observations(p);
    std::vector<Index> measured;
    VectorXd mean(0), variance(0), y(0), sigma(0);
    const auto append = [](VectorXd& to, const auto& more) {
      to.conservativeResize(to.size() + more.size());
      to.tail(more.size()) = more;
    };
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      append(mean, left_out[g].mean.reshaped());
      append(variance, left_out[g].variance.reshaped());
      append(y, p.observations[g].values().reshaped());
      append(sigma, test::noise_of_values(p, g).reshaped());
    }
    for (Index k = 0; k < y.size(); ++k) {
      EXPECT_EQ(std::isnan(mean[k]), std::isnan(y[k]));
      if (!std::isnan(y[k])) measured.push_back(k);
    }
    // Rasmussen & Williams 2006, eq. 5.12
    const Extended precision = Extended(dense.covariance(measured, measured))
                                   .llt()
                                   .solve(Extended::Identity(std::ssize(measured), std::ssize(measured)));
    const ExtendedVector alpha = precision * dense.residual(measured);
    for (Index n = 0; n < std::ssize(measured); ++n) {
      const Index k = measured[static_cast<std::size_t>(n)];
      const double expected = y[k] - static_cast<double>(alpha[n] / precision(n, n));
      const double total = static_cast<double>(1 / precision(n, n));
      EXPECT_NEAR(mean[k], expected, gappy_rounding(p) * (1 + std::abs(expected) + std::sqrt(total)));
      EXPECT_NEAR(variance[k], total - sigma[k] * sigma[k], gappy_rounding(p) * (1 + total));
    }
  }
}

TEST(LeaveOneOutTest, EachValueIsPredictedAsByAPosteriorThatHasNotSeenIt) {
  for (const Problem& p : gappy_problems()) {
    if (p.prior.system->has_constraint_noise()) continue;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const std::vector<LeaveOneOut> left_out = leave_one_out(test::posterior_of(p));
    ASSERT_EQ(left_out.size(), p.observations.size());
    RandomStream random(missing_values_seed, 99);
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      const Observations& group = p.observations[g];
      int n_compared = 0;
      for (Index i = 0; i < group.values().cols(); ++i) {
        for (Index k = 0; k < group.values().rows(); ++k) {
          if (std::isnan(group.values()(k, i))) {
            EXPECT_TRUE(std::isnan(left_out[g].mean(k, i)) && std::isnan(left_out[g].variance(k, i)));
            continue;
          }
          if (++n_compared > 2) continue;
          Problem without = p;
          MatrixXd values = group.values();
          values(k, i) = nan;
          without.observations[g] = group.with_values(values);
          const Posterior::Marginal expected = test::posterior_of(without).marginal(group.view(), group.states().col(i));
          const double variance = expected.covariance.col(0)[k * group.view().size() + k];
          const double size = largest(expected.mean) + std::sqrt(variance) + group.noise().stddev()[k];
          EXPECT_NEAR(left_out[g].mean(k, i), expected.mean(k, 0), gappy_rounding(p) * (1 + size));
          EXPECT_NEAR(left_out[g].variance(k, i), variance, gappy_rounding(p) * (1 + size * size));
        }
      }
      EXPECT_GT(n_compared, 0);
    }
  }
}

// in order of t where all states have one, else in their own
std::vector<std::vector<int>> stretches_of(const Problem& p, const Observations& group, int n) {
  std::vector<int> order;
  for (int i = 0; i < group.n_data(); ++i) order.push_back(i);
  const VectorXd t = group.states().row(p.prior.system->layout().t()).transpose();
  if (t.allFinite()) std::stable_sort(order.begin(), order.end(), [&](int i, int j) { return t[i] < t[j]; });
  std::vector<std::vector<int>> stretches(static_cast<std::size_t>(n));
  for (std::size_t k = 0; k < order.size(); ++k) stretches[k * static_cast<std::size_t>(n) / order.size()].push_back(order[k]);
  return stretches;
}

TEST(LeaveOutTest, EachStretchIsPredictedAsByAPosteriorThatHasNotSeenIt) {
  constexpr int n_stretches = 3;
  for (const Problem& p : gappy_problems()) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const LeftOut left_out = leave_out(test::posterior_of(p), n_stretches);
    ASSERT_EQ(left_out.stretches.size(), p.observations.size());
    for (std::size_t b = 0; b < n_stretches; ++b) {
      Problem without = p;
      for (std::size_t g = 0; g < p.observations.size(); ++g) {
        MatrixXd values = p.observations[g].values();
        values(Eigen::all, stretches_of(p, p.observations[g], n_stretches)[b]).setConstant(nan);
        without.observations[g] = p.observations[g].with_values(values);
      }
      const Posterior posterior = test::posterior_of(without);
      for (std::size_t g = 0; g < p.observations.size(); ++g) {
        const Observations& group = p.observations[g];
        const Posterior::Marginal expected = posterior.marginal(group.view(), group.states());
        const MatrixXd slip =
            with_slip(posterior, group.view(), group.states(), MatrixXd::Zero(group.view().size(), group.n_data()));
        const std::vector<int> stretch = stretches_of(p, group, n_stretches)[b];
        for (const int i : stretch) {
          for (Index k = 0; k < group.values().rows(); ++k) {
            EXPECT_EQ(std::isnan(left_out.stretches[g].mean(k, i)), std::isnan(group.values()(k, i)));
            if (std::isnan(group.values()(k, i))) continue;
            const double variance = std::pow(expected.stddev()(k, i), 2) + std::pow(slip(k, i), 2);
            const double size = largest(expected.mean) + std::sqrt(variance) + group.noise().stddev()[k];
            EXPECT_NEAR(left_out.stretches[g].mean(k, i), expected.mean(k, i), gappy_rounding(p) * (1 + size));
            EXPECT_NEAR(left_out.stretches[g].variance(k, i), variance, gappy_rounding(p) * (1 + size * size));
          }
        }
      }
    }
  }
}

// of one log with accelerations what also measures forces, at the same states
std::vector<Problem> with_forces_beside(const std::vector<Problem>& problems) {
  std::vector<Problem> all;
  for (const Problem& p : problems) {
    const Observations& group = p.observations.front();
    const System& system = *p.prior.system;
    if (p.observations.size() > 1 || !group.view().is_of_ddq() || group.view().other_system || system.nc() == 0) continue;
    RandomStream random(missing_values_seed, 77 + all.size());
    const View view = View::constraint_force(system);
    MatrixXd forces(view.size(), group.n_data());
    for (double& one : forces.reshaped()) one = random.normal();
    Problem& both = all.emplace_back(p);
    both.name += ", with forces";
    both.values.noise_stddev.push_back(VectorXd::Constant(view.size(), 0.3));
    both.observations.emplace_back(group.states(), view, forces, both.values.noise_stddev.back());
    if (all.size() == 3) break;
  }
  return all;
}

// all that is measured at a state goes, and one value alone as a value does
TEST(LeaveOutTest, EachRowIsPredictedAsByAPosteriorThatHasNotSeenIt) {
  std::vector<Problem> all = gappy_problems();
  const std::vector<Problem> with_forces = with_forces_beside(all);
  EXPECT_EQ(with_forces.size(), 3U);
  all.insert(all.end(), with_forces.begin(), with_forces.end());
  for (const Problem& p : all) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, missing_values_seed));
    const LeftOut left_out = leave_out(test::posterior_of(p), 0);
    ASSERT_EQ(left_out.rows.size(), p.observations.size());
    const bool has_forces = p.name.ends_with("with forces");
    for (std::size_t g = 0; g < p.observations.size(); ++g) {
      const Observations& group = p.observations[g];
      for (const int i : {0, 1, 3}) {
        if (i >= group.n_data()) continue;
        Problem without = p;
        Index n_measured = 0;
        for (std::size_t h = 0; h < p.observations.size(); ++h) {
          if (h != g && !has_forces) continue;
          MatrixXd values = p.observations[h].values();
          n_measured += values.col(i).array().isFinite().count();
          values.col(i).setConstant(nan);
          without.observations[h] = p.observations[h].with_values(values);
        }
        const Posterior posterior = test::posterior_of(without);
        const Posterior::Marginal expected = posterior.marginal(group.view(), group.states().col(i));
        const MatrixXd slip = with_slip(posterior, group.view(), group.states().col(i), MatrixXd::Zero(group.view().size(), 1));
        const LeaveOneOut &row = left_out.rows[g], &value = left_out.values[g];
        for (Index k = 0; k < group.values().rows(); ++k) {
          EXPECT_EQ(std::isnan(row.mean(k, i)), std::isnan(group.values()(k, i)));
          if (std::isnan(group.values()(k, i))) continue;
          const double variance = std::pow(expected.stddev()(k, 0), 2) + std::pow(slip(k, 0), 2);
          const double size = largest(expected.mean) + std::sqrt(variance) + group.noise().stddev()[k];
          EXPECT_NEAR(row.mean(k, i), expected.mean(k, 0), gappy_rounding(p) * (1 + size));
          EXPECT_NEAR(row.variance(k, i), variance, gappy_rounding(p) * (1 + size * size));
          if (n_measured > 1) continue;
          EXPECT_EQ(row.mean(k, i), value.mean(k, i));
          EXPECT_EQ(row.variance(k, i), value.variance(k, i));
        }
      }
    }
  }
}

TEST(LeaveOutTest, WhatMeasuresAStateAgainIsAnotherRow) {
  std::vector<Problem> all = test::problems(9, missing_values_seed);
  Problem& p = *std::ranges::find(all, "surface, every row", &Problem::name);
  const LeftOut apart = leave_out(test::posterior_of(p), 0);
  const Index n = p.observations.front().n_data();
  p.observations.push_back(p.observations.front());
  p.values.noise_stddev.push_back(p.values.noise_stddev.front());
  const LeftOut twice = leave_out(test::posterior_of(p), 0);
  EXPECT_EQ(twice.rows.front().mean.cols(), n);
  EXPECT_TRUE((twice.rows.front().variance.array() < apart.rows.front().variance.array()).all());
}

TEST(LeaveOutTest, OfALogWithoutTimeOrderHasNoStretchesWhateverAnotherHas) {
  std::vector<Problem> all = test::problems(30, missing_values_seed);
  Problem& p = *std::ranges::find(all, "surface, every row", &Problem::name);
  const Observations group = p.observations.front();
  const int t = p.prior.system->layout().t();
  MatrixXd timed = group.states(), untimed = timed;
  timed.row(t).setLinSpaced(0, 1);
  untimed.row(t).setConstant(nan);
  p.observations = {group.with_states(timed), group.with_states(untimed)};
  p.values.noise_stddev.push_back(p.values.noise_stddev.front());
  EXPECT_FALSE(cross_validate(test::posterior_of(p), false).stretches.has_value());
  EXPECT_TRUE(cross_validate(test::posterior_of(p), true).stretches.has_value());
  p.observations.pop_back();
  p.values.noise_stddev.pop_back();
  EXPECT_TRUE(cross_validate(test::posterior_of(p), false).stretches.has_value());
}

TEST(LeaveOutTest, SaysTheSameOfEachValueWhateverTheStretches) {
  const Problem p = gappy_problems().front();
  const std::vector<LeaveOneOut> values = leave_one_out(test::posterior_of(p));
  const LeftOut left_out = leave_out(test::posterior_of(p), 4);
  for (std::size_t g = 0; g < values.size(); ++g) {
    const auto measured = !p.observations[g].values().array().isNaN();
    EXPECT_TRUE((values[g].mean.array() == left_out.values[g].mean.array() || !measured).all());
    EXPECT_TRUE((values[g].variance.array() == left_out.values[g].variance.array() || !measured).all());
  }
  EXPECT_TRUE(leave_out(test::posterior_of(p), 0).stretches.empty());
  EXPECT_THAT(test::input_error_of([&] { leave_out(test::posterior_of(p), -1); }),
              testing::HasSubstr("n_stretches must not be negative, got -1"));
}

}  // namespace
}  // namespace gp2
