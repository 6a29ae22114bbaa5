#include <gtest/gtest.h>
#include <Eigen/Eigenvalues>

#include "gp2/inference/evaluation.hpp"
#include "gp2/posterior.hpp"
#include "inference/sampling.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t sample_seed = 60606;

TEST(PosteriorSampleTest, HasTheMeanAndCovarianceOfTheJoint) {
  for (const Problem& p : test::problems(9, sample_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sample_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    std::vector<ViewAt> quantities = test::both_accelerations(*p.prior.system, p.queries);
    quantities.push_back({View::all(Quantity::constraint_force, *p.prior.system), p.queries.leftCols(1)});
    quantities.back().view.latent = static_cast<int>(p.prior.latents.size()) - 1;
    test::expect_moments(posterior.sample(quantities, 2000, sample_seed), posterior.joint(quantities));
  }
}

TEST(PosteriorSampleTest, ObeysGaussPrincipleSampleBySample) {
  for (const Problem& p : test::problems(9, sample_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sample_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    test::expect_gauss_principle(posterior.sample(test::both_accelerations(*p.prior.system, p.queries), 50, sample_seed),
                                 require_mechanics(*p.prior.system, p.queries, p.values.parameters));
  }
}

TEST(PosteriorSampleTest, ObeysTheConstraintAsTheMeanDoes) {
  const Model& surface = test::model("models/surface.toml");
  const System& system = *surface.system;
  const View ddq = View::all(Quantity::constrained_acceleration, system);
  const Posterior posterior = test::surface_posterior(sample_seed);
  const MatrixXd states = test::draw(surface, 100, sample_seed + 1).states;
  const VectorXd parameters = posterior.values().parameters;
  const double of_mean = max_constraint_error(system, states, parameters, posterior.mean(ddq, states));
  const MatrixXd samples = posterior.sample({{ddq, states}}, 1000, sample_seed);
  double of_samples = 0;
  for (const auto& sample : samples.colwise()) {
    of_samples = std::max(of_samples, max_constraint_error(system, states, parameters, sample.reshaped(3, 100)));
  }
  EXPECT_LE(of_samples, 10 * of_mean);
  RecordProperty("of_mean", fmt::format("{:.3g}", of_mean));
  RecordProperty("of_samples", fmt::format("{:.3g}", of_samples));
}

TEST(PosteriorSampleTest, EqualStatesInTwoQuantitiesAreOneDraw) {
  for (const Problem& p : test::problems(9, sample_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sample_seed));
    const View ddq = View::all(Quantity::constrained_acceleration, *p.prior.system);
    MatrixXd twice(p.queries.rows(), 2);
    twice << p.queries.col(1), p.queries.col(0);
    const Posterior posterior(p.prior, p.observations, p.values);
    const MatrixXd samples = posterior.sample({{ddq, p.queries}, {ddq, twice}}, 5, sample_seed);
    const Index d = ddq.size(), second = d * p.queries.cols();
    EXPECT_EQ(samples.middleRows(0, d), samples.middleRows(second + d, d));
    EXPECT_EQ(samples.middleRows(d, d), samples.middleRows(second, d));
  }
}

TEST(PosteriorSampleTest, SameSeedSameBitsAnotherSeedOthers) {
  const Posterior posterior = test::surface_posterior(sample_seed);
  const Model& surface = test::model("models/surface.toml");
  const ViewAt ddq{View::all(Quantity::constrained_acceleration, *surface.system), test::draw(surface, 4, sample_seed).states};
  const MatrixXd samples = posterior.sample({ddq}, 3, 7);
  EXPECT_EQ(samples, posterior.sample({ddq}, 3, 7));
  EXPECT_NE(samples, posterior.sample({ddq}, 3, 8));
}

TEST(PosteriorSampleTest, WithoutDataIsThePrior) {
  for (const Problem& p : test::problems(9, sample_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sample_seed));
    const View ddq = View::all(Quantity::constrained_acceleration, *p.prior.system);
    const Posterior prior = Posterior(p.prior, p.observations, p.values).without_data();
    EXPECT_TRUE(prior.observations().empty());
    EXPECT_EQ(prior.reduced_size(), 0);
    EXPECT_EQ(prior.negative_log_likelihood(), 0);
    const test::DenseView dense = test::dense_view(p.prior, p.values, ddq, p.queries);
    const VectorXd mean = dense.mean.cast<double>();
    const MatrixXd covariance = test::dense_covariance(p.prior, p.values, dense, dense).cast<double>();
    const Posterior::Joint joint = prior.joint(ddq, p.queries);
    const double rounding = 1e5 * test::eps * (1 + largest(mean) + largest(covariance));
    EXPECT_LE(largest(joint.mean - mean), rounding);
    EXPECT_LE(largest(joint.covariance - covariance), rounding);
    EXPECT_EQ(prior.mean(ddq, p.queries).reshaped(), joint.mean);
    test::expect_moments(prior.sample({{ddq, p.queries}}, 1000, sample_seed), joint);
  }
}

TEST(PosteriorJointTest, CovarianceOfTheAccelerationIsThatOfTheUnconstrainedOneProjected) {
  for (const Problem& p : test::problems(9, sample_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, sample_seed));
    const System& system = *p.prior.system;
    const Index nq = system.nq(), n = p.queries.cols();
    const MechanicsBatch mechanics = require_mechanics(system, p.queries, p.values.parameters);
    const Posterior::Joint joint =
        Posterior(p.prior, p.observations, p.values).joint(test::both_accelerations(system, p.queries));
    MatrixXd T = MatrixXd::Zero(nq * n, nq * n);
    VectorXd Lb(nq * n);
    for (Index i = 0; i < n; ++i) {
      T.block(i * nq, i * nq, nq, nq) = mechanics.projections[static_cast<std::size_t>(i)].T();
      Lb.segment(i * nq, nq) = mechanics.projections[static_cast<std::size_t>(i)].Lb();
    }
    const auto ddq = joint.covariance.topLeftCorner(nq * n, nq * n);
    const auto cross = joint.covariance.topRightCorner(nq * n, nq * n);
    const auto a_bar = joint.covariance.bottomRightCorner(nq * n, nq * n);
    // each triangular solve of K̃ + I, of condition κ, errs by some ε κ
    const double tolerance = 100 * test::eps * test::condition(p) * (1 + largest(a_bar)) * (1 + T.squaredNorm());
    EXPECT_LT(tolerance, 1e-6 * (1 + largest(a_bar)) * (1 + T.squaredNorm())) << "nothing was tested";
    EXPECT_LE(largest(ddq - T * a_bar * T.transpose()), tolerance);
    EXPECT_LE(largest(cross - T * a_bar), tolerance);
    EXPECT_LE(largest(joint.mean.head(nq * n) - Lb - T * joint.mean.tail(nq * n)),
              100 * test::eps * (1 + largest(joint.mean)) * (1 + T.squaredNorm()));
  }
}

TEST(PosteriorJointTest, IsSymmetricAndHoldsTheJointsOfItsParts) {
  const Posterior posterior = test::surface_posterior(sample_seed);
  const Model& surface = test::model("models/surface.toml");
  const MatrixXd states = test::draw(surface, 5, sample_seed).states;
  const ViewAt force{View{Quantity::constraint_force, {2, 0}}, states.leftCols(3)};
  const ViewAt lambda{View::all(Quantity::multipliers, *surface.system), states.rightCols(2)};
  const Posterior::Joint joint = posterior.joint({force, lambda});
  const Posterior::Joint first = posterior.joint({force}), second = posterior.joint(lambda.view, lambda.states);
  EXPECT_EQ(joint.covariance, MatrixXd(joint.covariance.transpose()));
  const double tolerance = 1e-12 * (1 + largest(joint.covariance));
  EXPECT_LE(largest(joint.covariance.topLeftCorner(6, 6) - first.covariance), tolerance);
  EXPECT_LE(largest(joint.covariance.bottomRightCorner(2, 2) - second.covariance), tolerance);
  EXPECT_LE(largest(joint.mean.head(6) - first.mean), tolerance);
  EXPECT_LE(largest(joint.mean.tail(2) - second.mean), tolerance);
}

TEST(PosteriorJointTest, KnowingThatNothingAcceleratesAtRestNeverRaisesAVariance) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml", "models/double_pendulum.toml"}) {
    SCOPED_TRACE(file);
    const Model& model = test::model(file);
    const System& system = *model.system;
    const StateLayout layout = system.layout();
    const GeneratedData data = generate(model, {40, sample_seed, VectorXd::Constant(system.nq(), 0.1)});
    const View ddq = View::all(Quantity::constrained_acceleration, system);
    const View a_bar = View::all(Quantity::unconstrained_acceleration, system);
    const MatrixXd states = data.states.rightCols(20);
    MatrixXd rest = states.leftCols(6);
    rest.middleRows(layout.dq(0), layout.nq).setZero();

    const Prior prior = make_prior(model);
    std::vector<Observations> observations{
        {data.states.leftCols(20), ddq, data.accelerations.leftCols(20), VectorXd::Constant(system.nq(), 0.1), false}};
    RandomStream random(sample_seed);
    ModelValues values = test::random_values(prior, observations, random);
    const Posterior before(prior, observations, values);
    observations.push_back({rest, a_bar, MatrixXd::Zero(system.nq(), rest.cols()), VectorXd::Constant(system.nq(), 1e-3), false});
    values.noise_stddev.push_back(observations.back().noise().stddev());
    const Posterior after(prior, observations, values);

    // at rest, the variance is at most that of what was said there
    const MatrixXd at_rest_before = before.marginal(a_bar, rest).stddev().cwiseAbs2();
    const MatrixXd at_rest = after.marginal(a_bar, rest).stddev().cwiseAbs2();
    EXPECT_LE(at_rest.maxCoeff(), 1e-6 + 1e-9 * at_rest_before.maxCoeff());
    EXPECT_GT(at_rest_before.minCoeff(), 1e-4) << "known before: nothing was tested";
    EXPECT_LE(largest(after.mean(a_bar, rest)), 0.1);

    // anywhere, the covariance shrinks in the sense of Loewner
    const Posterior::Joint wide = before.joint(test::both_accelerations(system, states));
    const Posterior::Joint narrow = after.joint(test::both_accelerations(system, states));
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(wide.covariance - narrow.covariance, Eigen::EigenvaluesOnly);
    EXPECT_GE(eigen.eigenvalues().minCoeff(), -1e-8 * (1 + wide.covariance.norm()));
    EXPECT_GT(eigen.eigenvalues().maxCoeff(), 1e-3);
    for (const ViewAt& at : test::both_accelerations(system, states)) {
      const MatrixXd was = before.marginal(at.view, at.states).stddev(), is = after.marginal(at.view, at.states).stddev();
      EXPECT_LE((is.cwiseAbs2() - was.cwiseAbs2()).maxCoeff(), 1e-9 * (1 + was.cwiseAbs2().maxCoeff()));
    }
  }
}

}  // namespace
}  // namespace gp2
