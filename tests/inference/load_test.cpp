#include <fmt/format.h>
#include <gtest/gtest.h>

#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "inference/problems.hpp"

// A bead on a turning wire: a model that reads lambda0(1) is the one in which λ₀ is written out by hand.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t load_seed = 60714;
constexpr int n_wire_rows = 25;

Model turning_wire(const std::string& lambda0, double m = 0.3) {
  return Model::parse(fmt::format(R"toml(
name        = "bead on a turning wire"
coordinates = ["x", "y"]
inputs      = ["push"]
[parameters]
m = {}
w = {{ value = 2.0, estimate = true }}
k = 4.0
[let]
s = "sin(w*t)"
c = "cos(w*t)"
load = "{}"
rx = "dx + w*y"
ry = "dy - w*x"
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["push - k*x", "-k*y"]
[constraints]
position = ["x*s - y*c"]
[[latent]]
name       = "friction"
kernel     = "se + constant"
features   = ["dx", "dy"]
directions = {{ force = [["-abs(load)*rx"], ["-abs(load)*ry"]] }}
[[latent]]
name       = "bending"
kernel     = "matern52"
features   = ["x", "y"]
directions = [["load*c", "1"], ["load*s", "0"]]
[sampling]
t    = [0, 3]
r    = [-0.6, 0.6]
dr   = [-0.8, 0.8]
x    = "r*cos(w*t)"
y    = "r*sin(w*t)"
dx   = "dr*cos(w*t) - r*w*sin(w*t)"
dy   = "dr*sin(w*t) + r*w*cos(w*t)"
push = [-2, 2]
[truth]
force = ["-0.3*abs(load)*rx", "-0.3*abs(load)*ry"]
)toml",
                                  m, lambda0),
                      "wire");
}

// m b − (s, −c) F
constexpr const char* by_hand = "m*(w^2*(x*s - y*c) - 2*w*(dx*c + dy*s)) + k*(x*s - y*c) - s*push";

struct Wire {
  explicit Wire(const std::string& lambda0)
      : model(turning_wire(lambda0)), prior(make_prior(model)), other(make_other_system(model, turning_wire(lambda0, 0.5))) {
    RandomStream random(load_seed);
    const MatrixXd states = test::draw(model, n_wire_rows, load_seed).states;
    const View ddq = View::constrained_acceleration(*model.system);
    observations.push_back(test::observe(model, ddq, states.leftCols(n_wire_rows - 5), random));
    observations.push_back(test::observe(model, test::under(ddq, other), states.rightCols(5), random));
    values = test::random_values(prior, observations, random);
  }
  Model model;
  Prior prior;
  std::shared_ptr<const OtherSystem> other;
  std::vector<Observations> observations;
  ModelValues values;
};

void expect_same_numbers(const MatrixXd& one, const MatrixXd& other) {
  ASSERT_EQ(one.cols(), other.cols());
  EXPECT_LE(test::largest(one - other), 1e-11 * (1 + test::largest(other)));
}

TEST(Load, IsTheOneWrittenByHandInLikelihoodPosteriorSamplesAndPredictor) {
  const Wire read("lambda0(1)"), written(by_hand);
  expect_same_numbers(read.observations[0].values(), written.observations[0].values());

  Likelihood::Options options;
  options.noise_gradient = true;
  options.gradient_parameters = {0, 1, 2};
  Likelihood::Workspace workspace;
  ModelGradient gradient, expected_gradient;
  const double value =
      Likelihood(read.prior, read.observations, read.values, options).evaluate(read.values, &gradient, workspace);
  EXPECT_NEAR(value,
              Likelihood(written.prior, written.observations, written.values, options)
                  .evaluate(written.values, &expected_gradient, workspace),
              1e-10 * std::abs(value));
  expect_same_numbers(gradient.parameters, expected_gradient.parameters);
  // k drops out on the constraint
  EXPECT_GT(gradient.parameters.head(2).cwiseAbs().minCoeff(), 1e-3);

  const Posterior posterior(read.prior, read.observations, read.values),
      expected(written.prior, written.observations, written.values);
  const MatrixXd states = test::draw(read.model, 10, load_seed + 1).states;
  for (const bool elsewhere : {false, true}) {
    View view = View::constrained_acceleration(*read.model.system), as_written = view;
    if (elsewhere) {
      view = test::under(view, read.other);
      as_written = test::under(as_written, written.other);
    }
    expect_same_numbers(posterior.joint(view, states).covariance, expected.joint(as_written, states).covariance);
    expect_same_numbers(posterior.mean(view, states), expected.mean(as_written, states));
    expect_same_numbers(posterior.sample({{view, states}}, 2, 7), expected.sample({{as_written, states}}, 2, 7));
    const Predictor predictor(posterior, view), predictor_as_written(expected, as_written);
    auto memory = predictor.make_workspace(), memory_as_written = predictor_as_written.make_workspace();
    VectorXd mean(2), mean_as_written(2);
    MatrixXd jacobian(2, states.rows()), jacobian_as_written = jacobian;
    for (Index i = 0; i < states.cols(); ++i) {
      EXPECT_EQ(predictor.mean_and_jacobian(states.col(i), mean, jacobian, memory), Predictor::Status::ok);
      EXPECT_EQ(predictor_as_written.mean_and_jacobian(states.col(i), mean_as_written, jacobian_as_written, memory_as_written),
                Predictor::Status::ok);
      expect_same_numbers(mean, mean_as_written);
      expect_same_numbers(jacobian, jacobian_as_written);
    }
  }
}

TEST(Load, NeedsWhatTheKnownForceReads) {
  const Model model = turning_wire("lambda0(1)");
  const std::vector<bool> reads = make_prior(model).reads();
  EXPECT_TRUE(reads[static_cast<std::size_t>(model.system->layout().u(0))]) << "push, though the mean of the prior is zero";
  EXPECT_FALSE(make_prior(turning_wire("1")).reads()[static_cast<std::size_t>(model.system->layout().u(0))]);
}

}  // namespace
}  // namespace gp2
