#include "gp2/posterior.hpp"

#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "inference/problems.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t posterior_seed = 40403;

// views of a problem's system to predict: everything, and some rows in another order
std::vector<View> views_of(const Problem& p) {
  const System& system = *p.prior.system;
  std::vector<View> views = {View::all(Quantity::constrained_acceleration, system),
                             View::all(Quantity::unconstrained_acceleration, system),
                             View{Quantity::constrained_acceleration, {system.nq() - 1, 0}},
                             View::all(Quantity::constraint_force, system), View::learned_force(system)};
  if (system.nc() > 0) views.push_back(View::all(Quantity::multipliers, system));
  if (!p.queries.middleRows(system.nq(), system.nq()).hasNaN()) {
    views.push_back(View::all(Quantity::next_velocity, system));
    views.back().time_step = 0.1;
  }
  views.push_back(View::all(Quantity::constrained_acceleration, system));
  views.back().latent = static_cast<int>(p.prior.latents.size()) - 1;
  return views;
}

TEST(PosteriorTest, IsTheTextbookGaussianProcess) {
  for (const Problem& p : test::problems(9, posterior_seed)) {
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const View& view : views_of(p)) {
      SCOPED_TRACE(fmt::format("{}, view {}×{}, seed {}", p.name, view.quantity->word(), view.size(), posterior_seed));
      const auto [mean, covariance] = test::dense_posterior(p, view, p.queries);
      const Posterior::Joint joint = posterior.joint(view, p.queries);
      EXPECT_LE(test::largest(joint.mean - mean), test::rounding(p) * (1 + test::largest(mean)));
      EXPECT_LE(test::largest(joint.covariance - covariance), test::rounding(p) * (1 + test::largest(covariance)));
      EXPECT_LT(test::rounding(p), 1e-6) << "too badly conditioned to test anything";
    }
  }
}

TEST(PosteriorTest, MarginalsComeBlockByBlockToTheBit) {
  const Problem p = test::problems(1, posterior_seed).front();
  const Posterior posterior(p.prior, p.observations, p.values);
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const MatrixXd states = p.queries.replicate(1, 17000 / p.queries.cols());
  const Posterior::Marginal all = posterior.marginal(view, states);
  for (const int n_threads : {1, 2}) {
    Index next = 0;
    int n_blocks = 0;
    posterior.for_each_marginal(view, states, n_threads, [&](Index first, const Posterior::Marginal& block) {
      EXPECT_EQ(first, next);
      next += block.mean.cols();
      EXPECT_EQ(block.mean, all.mean.middleCols(first, block.mean.cols()));
      EXPECT_EQ(block.covariance, all.covariance.middleCols(first, block.mean.cols()));
      ++n_blocks;
    });
    EXPECT_EQ(next, states.cols());
    EXPECT_GT(n_blocks, 1);
  }
}

TEST(PosteriorTest, ALazyOneIsTheSameToTheBitAndConditionedWhenAsked) {
  for (const Problem& p : test::problems(3, posterior_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
    const Posterior eager(p.prior, p.observations, p.values), lazy = Posterior::lazy(p.prior, p.observations, p.values);
    EXPECT_EQ(lazy.observations().size(), p.observations.size());
    const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
    EXPECT_EQ(lazy.mean(view, p.queries), eager.mean(view, p.queries));
    EXPECT_EQ(lazy.negative_log_likelihood(), eager.negative_log_likelihood());
    const Posterior fresh = Posterior::lazy(p.prior, p.observations, p.values);
    const Posterior updated = update(Posterior(fresh), p.observations[0]), same = update(Posterior(eager), p.observations[0]);
    EXPECT_EQ(updated.mean(view, p.queries), same.mean(view, p.queries));
  }
}

TEST(PosteriorTest, TheLatentsAddUpToTheWhole) {
  for (const Problem& p : test::problems(9, posterior_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
    const System& system = *p.prior.system;
    const Posterior posterior(p.prior, p.observations, p.values);
    View view = View::all(Quantity::unconstrained_acceleration, system);
    const MatrixXd whole = posterior.mean(view, p.queries);
    MatrixXd sum =
        evaluate_prior(p.prior, p.queries, p.values.parameters, require_mechanics(system, p.queries, p.values.parameters)).mean;
    for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
      view.latent = static_cast<int>(a);
      sum += posterior.mean(view, p.queries);
    }
    EXPECT_LE(test::largest(sum - whole), 1e-13 * (1 + test::largest(whole) + test::largest(sum)));
  }
}

// M(ā − μ), with its covariance, and the sum of what each latent adds
TEST(PosteriorTest, TheLearnedForceIsMTimesWhatTheLatentsAddToTheAcceleration) {
  for (const Problem& p : test::problems(9, posterior_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
    const System& system = *p.prior.system;
    const Posterior posterior(p.prior, p.observations, p.values);
    const Posterior::Marginal a_bar = posterior.marginal(View::unconstrained_acceleration(system), p.queries);
    const Posterior::Marginal force = posterior.marginal(View::learned_force(system), p.queries);
    const MechanicsBatch mechanics = require_mechanics(system, p.queries, p.values.parameters);
    const MatrixXd mu = evaluate_prior(p.prior, p.queries, p.values.parameters, mechanics).mean;
    MatrixXd sum = MatrixXd::Zero(force.mean.rows(), force.mean.cols());
    for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
      View alone = View::learned_force(system);
      alone.latent = static_cast<int>(a);
      sum += posterior.mean(alone, p.queries);
    }
    const double rounding = 1e-12 * (1 + test::largest(mechanics.values.mass) * (test::largest(a_bar.mean) + test::largest(mu)));
    EXPECT_LE(test::largest(sum - force.mean), rounding + 1e-13 * test::largest(sum));
    const Index nq = system.nq();
    for (int i = 0; i < static_cast<int>(p.queries.cols()); ++i) {
      const auto M = mechanics.values.M(i);
      EXPECT_LE(test::largest(M * (a_bar.mean.col(i) - mu.col(i)) - force.mean.col(i)), rounding);
      const MatrixXd expected = M * a_bar.covariance.col(i).reshaped(nq, nq) * M;
      EXPECT_LE(test::largest(expected - force.covariance.col(i).reshaped(nq, nq)), 1e-11 * (1 + test::largest(expected)));
    }
  }
}

TEST(PosteriorTest, MarginalsAreTheDiagonalBlocksOfTheJoint) {
  for (const Problem& p : test::problems(9, posterior_seed)) {
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const View& view : views_of(p)) {
      SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
      const Posterior::Joint joint = posterior.joint(view, p.queries);
      const Posterior::Marginal marginal = posterior.marginal(view, p.queries);
      const Index d = view.size();
      EXPECT_EQ(posterior.mean(view, p.queries), marginal.mean);
      const double tolerance = test::rounding(p) * (1 + test::largest(joint.covariance));
      for (Index i = 0; i < p.queries.cols(); ++i) {
        EXPECT_LE(test::largest(joint.mean.segment(i * d, d) - marginal.mean.col(i)),
                  test::rounding(p) * (1 + test::largest(marginal.mean)));
        EXPECT_LE(test::largest(joint.covariance.block(i * d, i * d, d, d) - marginal.covariance.col(i).reshaped(d, d)),
                  tolerance);
        for (Index k = 0; k < d; ++k) {
          EXPECT_NEAR(marginal.stddev()(k, i) * marginal.stddev()(k, i), std::max(0.0, joint.covariance(i * d + k, i * d + k)),
                      tolerance);
        }
      }
      EXPECT_EQ(joint.covariance, MatrixXd(joint.covariance.transpose()));
    }
  }
}

TEST(PosteriorTest, MarginalsDoNotDependOnHowManyStatesAreAskedForAtOnce) {
  // more states than one block of triangular solves holds
  const Problem p = test::problems(9, posterior_seed).front();
  const System& system = *p.prior.system;
  const MatrixXd many = test::draw(test::model(test::library_models().front()), 150, posterior_seed + 1).states;
  const View view = View::all(Quantity::constrained_acceleration, system);
  const Posterior posterior(p.prior, p.observations, p.values);
  const Posterior::Marginal at_once = posterior.marginal(view, many);
  for (Index i : {Index{0}, Index{63}, Index{64}, Index{149}}) {
    const Posterior::Marginal alone = posterior.marginal(view, many.col(i));
    EXPECT_LE(test::largest(at_once.mean.col(i) - alone.mean), test::rounding(p) * (1 + test::largest(alone.mean)));
    EXPECT_LE(test::largest(at_once.covariance.col(i) - alone.covariance),
              test::rounding(p) * (1 + test::largest(alone.covariance)));
  }
}

TEST(PosteriorTest, ObeysTheConstraintInMeanAndCovariance) {
  for (const Problem& p : test::problems(9, posterior_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
    const System& system = *p.prior.system;
    const View view = View::all(Quantity::constrained_acceleration, system);
    const Posterior posterior(p.prior, p.observations, p.values);
    const MechanicsBatch mechanics = require_mechanics(system, p.queries, p.values.parameters);
    const Posterior::Marginal marginal = posterior.marginal(view, p.queries);
    const Posterior::Joint joint = posterior.joint(view, p.queries);
    const Index nq = system.nq();
    // what T has of rounding: ε κ(M), whatever the condition of the regression
    const double tolerance = 1e5 * test::eps;
    MatrixXd A_all = MatrixXd::Zero(system.nc() * p.queries.cols(), nq * p.queries.cols());
    const MatrixXd a_bar = posterior.mean(View::all(Quantity::unconstrained_acceleration, system), p.queries);
    const MatrixXd a_bar_variance =
        posterior.marginal(View::all(Quantity::unconstrained_acceleration, system), p.queries).covariance;
    for (int i = 0; i < mechanics.values.n_states(); ++i) {
      const MatrixXd A = mechanics.values.A(i);
      const VectorXd b = mechanics.values.b(i);
      // rows count by their own size
      const VectorXd size = A.rowwise().norm().cwiseMax(1e-300);
      const VectorXd error = (A * marginal.mean.col(i) - b).cwiseQuotient(size);
      EXPECT_LE(test::largest(error), tolerance * (1 + test::largest(marginal.mean.col(i)) + test::largest(a_bar.col(i)) +
                                                   test::largest(b.cwiseQuotient(size))));
      const MatrixXd A_unit = size.cwiseInverse().asDiagonal() * A;
      EXPECT_LE(test::largest(A_unit * marginal.covariance.col(i).reshaped(nq, nq) * A_unit.transpose()),
                tolerance * (1 + test::largest(marginal.covariance.col(i)) + test::largest(a_bar_variance.col(i))));
      A_all.block(i * system.nc(), i * nq, system.nc(), nq) = A_unit;
    }
    EXPECT_LE(test::largest(A_all * joint.covariance),
              tolerance * (1 + test::largest(joint.covariance) + test::largest(a_bar_variance)));
  }
}

TEST(PosteriorTest, FarFromTheDataIsThePrior) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml", "models/duffing.toml"}) {
    for (const Problem& p : test::problems(9, posterior_seed)) {
      if (p.prior.system != test::model(file).system) continue;
      SCOPED_TRACE(fmt::format("{}, seed {}", p.name, posterior_seed));
      MatrixXd far = p.queries;
      const StateLayout layout = p.prior.system->layout();
      far.row(layout.dq(0)).array() += 1e4;  // a feature of each
      const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
      const test::DenseView prior = test::dense_view(p.prior, p.values, view, far);
      const VectorXd mean = prior.mean.cast<double>();
      const MatrixXd covariance = test::dense_covariance(p.prior, p.values, prior, prior).cast<double>();
      const Posterior::Joint joint = Posterior(p.prior, p.observations, p.values).joint(view, far);
      EXPECT_LE(test::largest(joint.mean - mean), 1e5 * test::eps * (1 + test::largest(mean)));
      EXPECT_LE(test::largest(joint.covariance - covariance), 1e5 * test::eps * (1 + test::largest(covariance)));
    }
  }
}

TEST(PosteriorTest, MeetsItsDataAsTheNoiseVanishes) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml"}) {
    const Model& model = test::model(file);
    const GeneratedData data = test::draw(model, 15, posterior_seed);
    const View view = View::all(Quantity::constrained_acceleration, *model.system);
    const Prior prior = make_prior(model);
    RandomStream random(posterior_seed);
    double previous = std::numeric_limits<double>::infinity();
    for (double noise : {1e-1, 1e-3, 1e-5}) {
      std::vector<Observations> observations{{data.states, view, data.accelerations, VectorXd::Constant(3, noise), false}};
      RandomStream same(posterior_seed);
      ModelValues values = test::random_values(prior, observations, same);
      const Posterior posterior(prior, observations, values);
      const double error = test::largest(posterior.mean(view, data.states) - data.accelerations);
      // the smoother leaves S (K + S)⁻¹ (y − m); the observations' own covariance stands on some 1e-3 at least
      EXPECT_LT(error, 1e5 * noise * noise + 1e-9) << file << ", noise " << noise;
      EXPECT_LT(error, previous);
      previous = error;
      const Posterior::Marginal marginal = posterior.marginal(view, data.states);
      EXPECT_LE(marginal.stddev().maxCoeff(), 2 * noise) << "no more uncertain than the measurement";
    }
  }
}

TEST(PosteriorTest, LearnsAnAccelerationThatWasNeverMeasured) {
  // ddq1 and ddq2 of the surface fix ddq3: with A and b known, the constraint says the rest
  const Model& model = test::model("models/surface.toml");
  const GeneratedData data = test::draw(model, 15, posterior_seed);
  const Prior prior = make_prior(model);
  const View two{Quantity::constrained_acceleration, {0, 1}};
  std::vector<Observations> observations{{data.states, two, data.accelerations.topRows(2), VectorXd::Constant(2, 1e-5), false}};
  RandomStream random(posterior_seed);
  const Posterior posterior(prior, observations, test::random_values(prior, observations, random));
  const MatrixXd mean = posterior.mean(View::all(Quantity::constrained_acceleration, *model.system), data.states);
  // ddq3 = −(A₁ ddq1 + A₂ ddq2 − b)/A₃ carries their errors, times slopes of the surface below one
  const double measured_error = test::largest((mean - data.accelerations).topRows(2));
  EXPECT_LE(test::largest((mean - data.accelerations).row(2)), 2 * measured_error + 1e-12);
  EXPECT_LE(measured_error, 1e-4);
}

TEST(PosteriorTest, AVarianceThatRoundingMadeNegativeIsZeroAndCounted) {
  // at the data, what is left of the variance is 1e-18 of the signal's: less than the rounding of what is taken away
  const Model& model = test::model("models/surface.toml");
  const GeneratedData data = test::draw(model, 15, posterior_seed);
  const Prior prior = make_prior(model);
  const View view = View::all(Quantity::unconstrained_acceleration, *model.system);
  std::vector<Observations> observations{{data.states, view, data.accelerations, VectorXd::Constant(3, 1e-9), false}};
  RandomStream random(posterior_seed);
  const ModelValues values = test::random_values(prior, observations, random);
  const Posterior::Marginal marginal = Posterior(prior, observations, values).marginal(view, data.states);
  const MatrixXd stddev = marginal.stddev();
  EXPECT_TRUE(stddev.allFinite());
  EXPECT_GT(marginal.n_clipped, 0) << "nothing was tested";
  // others came out as exactly zero
  EXPECT_GE((stddev.array() == 0).count(), marginal.n_clipped);
  const Posterior mixture = Posterior::mixture(prior, observations, {values, values});
  EXPECT_EQ(mixture.marginal(view, data.states).n_clipped, 2 * marginal.n_clipped);
}

TEST(PosteriorTest, OfASystemWithoutConstraintsIsAPlainGaussianProcess) {
  const Model model = Model::parse(R"toml(
name        = "free mass"
coordinates = ["x", "y"]
[parameters]
m = 2.0
[mechanics]
mass  = [["m", "0.3"], ["0.3", "1"]]
force = ["-m*x", "0"]
[[latent]]
kernel     = "se"
features   = ["x", "dy"]
directions = "force"
)toml",
                                   "free mass");
  RandomStream random(posterior_seed);
  const MatrixXd states = test::random_matrix(5, 12, random);
  Problem p{"free mass", make_prior(model, {Prior::Mean::force, std::nullopt, false}), {}, {}, states.rightCols(3), {}};
  const View view = View::all(Quantity::constrained_acceleration, *model.system);
  p.observations.push_back(test::observe(model, view, states.leftCols(9), random));
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior(p.prior, p.observations, p.values);
  EXPECT_EQ(posterior.reduced_size(), 9 * 2);
  const double dense = test::dense_negative_log_likelihood(p);
  EXPECT_NEAR(posterior.negative_log_likelihood(), dense, test::rounding(p) * std::abs(dense));
  EXPECT_EQ(posterior.mean(view, p.queries),
            posterior.mean(View::all(Quantity::unconstrained_acceleration, *model.system), p.queries));
}

TEST(PosteriorTest, KnowsWhatItWasMadeOf) {
  const Problem p = test::problems(9, posterior_seed).front();
  const Posterior posterior(p.prior, p.observations, p.values);
  EXPECT_EQ(posterior.observations()[0].values(), p.observations[0].values());
  EXPECT_EQ(posterior.values().kernel, p.values.kernel);
  EXPECT_EQ(posterior.prior().system, p.prior.system);
  EXPECT_EQ(posterior.reduced_size(), Likelihood(p.prior, p.observations, p.values, {}).reduced_size());
}

TEST(PosteriorTest, RefusesToPredictWhereTheMassMatrixIsIndefinite) {
  const Model& model = test::model_of_a_mass_that_may_be_indefinite();
  const Prior prior = make_prior(model);
  const View view = View::all(Quantity::constrained_acceleration, *model.system);
  MatrixXd states = MatrixXd::Zero(5, 2);
  states(0, 0) = 0.5;
  std::vector<Observations> observations{{states, view, MatrixXd::Zero(2, 2), VectorXd::Ones(2), false}};
  const Posterior posterior(prior, observations, {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {VectorXd::Ones(2)}, VectorXd()});
  EXPECT_NO_THROW(static_cast<void>(posterior.mean(view, states)));
  states(0, 1) = 2;
  EXPECT_THROW(static_cast<void>(posterior.mean(view, states)), InputError);
  EXPECT_THROW(static_cast<void>(posterior.marginal(view, states)), InputError);
  EXPECT_THROW(static_cast<void>(posterior.joint(view, states)), InputError);
}

}  // namespace
}  // namespace gp2
