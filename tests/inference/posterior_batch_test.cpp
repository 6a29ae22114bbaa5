#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "inference/sampling.hpp"

// Predictions at many states, from many samples: in blocks, and on several threads.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t posterior_batch_seed = 40406;

// more samples than one chunk of the sums over them holds
Problem many_samples(const std::string& name) {
  for (const Problem& p : test::problems(300, posterior_batch_seed)) {
    if (p.name == name) return p;
  }
  throw std::runtime_error("no problem " + name);
}

TEST(PosteriorBatchTest, OfManySamplesIsTheTextbookGaussianProcess) {
  const Problem p = many_samples("surface, every row");
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const auto [mean, covariance] = test::dense_posterior(p, view, p.queries);
  const Posterior::Joint joint = Posterior(p.prior, p.observations, p.values).joint(view, p.queries);
  const double tolerance = 1e4 * test::eps * test::condition(p);
  EXPECT_LT(tolerance, 1e-5);
  EXPECT_LE(largest(joint.mean - mean), tolerance * (1 + largest(mean)));
  EXPECT_LE(largest(joint.covariance - covariance), tolerance * (1 + largest(covariance)));
}

TEST(PosteriorBatchTest, AStateHasTheSameBitsInEveryBatchAndOnAnyNumberOfThreads) {
  for (const char* name : {"surface, every row", "friction, two latents, one state at rest"}) {
    SCOPED_TRACE(name);
    const Problem p = many_samples(name);
    const Posterior posterior(p.prior, p.observations, p.values);
    View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
    const MatrixXd& some = p.observations[0].states();
    const MatrixXd states = some.replicate(1, 600 / some.cols() + 1);
    for (const std::optional<int>& latent : {std::optional<int>(), std::optional(0)}) {
      view.latent = latent;
      const MatrixXd mean = posterior.mean(view, states);
      const Posterior::Marginal marginal = posterior.marginal(view, states);
      EXPECT_EQ(marginal.mean, mean);
      for (Index i : {Index{0}, Index{255}, Index{256}, states.cols() - 1}) {
        EXPECT_EQ(posterior.mean(view, states.col(i)), mean.col(i));
      }
      EXPECT_EQ(posterior.mean(view, states.rightCols(299)), mean.rightCols(299));
      for (int n_threads : {0, 2, 5}) {
        EXPECT_EQ(posterior.mean(view, states, n_threads), mean);
        const Posterior::Marginal threaded = posterior.marginal(view, states, n_threads);
        EXPECT_EQ(threaded.mean, mean);
        EXPECT_EQ(threaded.covariance, marginal.covariance);
        EXPECT_EQ(threaded.n_clipped, marginal.n_clipped);
      }
    }
  }
}

TEST(PosteriorBatchTest, NoStatesGiveNoNumbers) {
  const Problem p = test::problems(9, posterior_batch_seed).front();
  const Posterior posterior(p.prior, p.observations, p.values);
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const MatrixXd none(p.queries.rows(), 0);
  EXPECT_EQ(posterior.mean(view, none, 2).cols(), 0);
  EXPECT_EQ(posterior.marginal(view, none, 2).covariance.cols(), 0);
  EXPECT_EQ(posterior.joint(view, none).mean.size(), 0);
  EXPECT_EQ(posterior.sample({{view, none}}, 3, posterior_batch_seed).rows(), 0);
}

TEST(PosteriorBatchTest, JudgesContradictingConstraintsAtEachStateWhateverElseIsAskedFor) {
  // 1e-9 apart: beyond 1e-6 of b where y is small, within it where it is not
  const Model model = Model::parse(R"toml(
name        = "two rods"
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
acceleration = ["ddx - y", "ddx - y - 1e-9"]
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                   "two rods");
  const View view = View::all(Quantity::constrained_acceleration, *model.system);
  const Posterior posterior(make_prior(model), {}, {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {}, VectorXd()});
  MatrixXd states = MatrixXd::Zero(5, 700);
  states.row(1).setConstant(1e-4);
  for (int n_threads : {1, 2}) {
    EXPECT_THROW(static_cast<void>(posterior.mean(view, states, n_threads)), InputError);
    EXPECT_THROW(static_cast<void>(posterior.marginal(view, states, n_threads)), InputError);
  }
  states(1, 699) = 1;
  for (int n_threads : {1, 2}) {
    EXPECT_THROW(static_cast<void>(posterior.mean(view, states, n_threads)), InputError);
  }
  states.row(1).setOnes();
  for (int n_threads : {1, 2}) {
    EXPECT_EQ(posterior.mean(view, states, n_threads), posterior.marginal(view, states, n_threads).mean);
  }
}

}  // namespace
}  // namespace gp2
