#include <gtest/gtest.h>

#include "inference/problems.hpp"

// Learned loadings C against the same prior with C written as directions, and ∂/∂C against differences.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t learned_directions_seed = 60611;
constexpr int n_data = 8;

// "acceleration", or a matrix of expressions, in place of the directions
Model sledge(const std::string& constraint, const std::string& directions) {
  return Model::parse(R"toml(
name        = "sledge"
coordinates = ["x", "y"]
[parameters]
m = 2.0
[mechanics]
mass  = [["m", "0.3*cos(x)"], ["0.3*cos(x)", "1"]]
force = ["-x", "0"]
[constraints]
)toml" + constraint + R"toml(
[[latent]]
name       = "first"
kernel     = "se"
features   = ["x", "y"]
directions = )toml" + directions +
                          R"toml(
[[latent]]
name       = "second"
kernel     = "linear"
features   = ["x", "dx"]
directions = )toml" + directions,
                      "sledge");
}

struct Case {
  std::string name, constraint;
  std::vector<View> views;
};

std::vector<Case> cases() {
  using test::Quantity;
  const View ddq{Quantity::constrained_acceleration, {0, 1}}, a_bar{Quantity::unconstrained_acceleration, {1}};
  return {{"without constraints every sample has the same directions", "", {ddq}},
          {"without constraints, some rows more", "", {ddq, a_bar}},
          {"with a constraint", "velocity = [\"dx*cos(y) - dy\"]", {ddq, a_bar}}};
}

struct Learned {
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
};

Learned learned(const Case& c) {
  RandomStream random(learned_directions_seed);
  const Model model = sledge(c.constraint, "\"acceleration\"");
  Learned p{make_prior(model), {}, {}};
  for (Latent& latent : p.prior.latents) latent.free_loading = 1 + latent.size();  // [W, diag √κ] of one column W
  for (const View& view : c.views) {
    const MatrixXd states = test::random_matrix(model.system->layout().size(), n_data, random);
    p.observations.push_back(test::observe(model, view, states, random));
  }
  p.values = test::random_values(p.prior, p.observations, random);
  for (const Latent& latent : p.prior.latents) {
    MatrixXd& C = p.values.free_loading.emplace_back(MatrixXd::Zero(latent.size(), latent.n_functions()));
    C.col(0) = test::random_vector(latent.size(), random);
    for (Index j = 0; j < latent.size(); ++j) C(j, 1 + j) = 0.5 + random.uniform();
  }
  return p;
}

TEST(LearnedDirections, AreThoseOfAPriorThatHasThemWritten) {
  for (const Case& c : cases()) {
    SCOPED_TRACE(c.name);
    const Learned p = learned(c);
    Likelihood::Workspace workspace;
    for (std::size_t a = 0; a < p.values.free_loading.size(); ++a) ASSERT_EQ(p.values.free_loading[a].cols(), 3);
    // both latents need the same text: they are compared with the loading of the first in both
    ModelValues values = p.values;
    values.free_loading[1] = values.free_loading[0];
    const MatrixXd& C = values.free_loading[0];
    std::string text = "[";
    for (Index row = 0; row < C.rows(); ++row) {
      text += fmt::format("{}[\"{}\", \"{}\", \"{}\"]", row > 0 ? ", " : "", shortest(C(row, 0)), shortest(C(row, 1)),
                          shortest(C(row, 2)));
    }
    const Prior written = make_prior(sledge(c.constraint, text + "]"));
    ModelValues as_written = values;
    as_written.free_loading.clear();
    for (VectorXd& s : as_written.signal_stddev) s = VectorXd::Ones(3);
    const double expected = Likelihood(written, p.observations, as_written, {}).evaluate(as_written, nullptr, workspace);
    const double value = Likelihood(p.prior, p.observations, values, {}).evaluate(values, nullptr, workspace);
    EXPECT_NEAR(value, expected, 1e-12 * (1 + std::abs(expected)));

    const MatrixXd states = p.observations[0].states().leftCols(3);
    const Posterior one(p.prior, p.observations, values), other(written, p.observations, as_written);
    const View view = c.views[0];
    EXPECT_TRUE(one.mean(view, states).isApprox(other.mean(view, states), 1e-10));
    EXPECT_TRUE(one.joint(view, states).covariance.isApprox(other.joint(view, states).covariance, 1e-10));
  }
}

TEST(LearnedDirections, HaveTheGradientOfDifferences) {
  for (const Case& c : cases()) {
    for (const bool noise_gradient : {false, true}) {
      SCOPED_TRACE(fmt::format("{}, with noise {}", c.name, noise_gradient));
      const Learned p = learned(c);
      Likelihood::Options options;
      options.noise_gradient = noise_gradient;
      const Likelihood likelihood(p.prior, p.observations, p.values, options);
      Likelihood::Workspace workspace;
      ModelGradient gradient;
      likelihood.evaluate(p.values, &gradient, workspace);
      const auto expect_match = [&](double analytic, const auto& member, bool positive) {
        const double value = member(p.values);
        const auto at = [&](double x) -> VectorXd {
          ModelValues moved = p.values;
          member(moved) = positive ? std::exp(x) : x;
          return VectorXd::Constant(1, likelihood.evaluate(moved, nullptr, workspace));
        };
        const test::Difference difference = test::central_difference(at, positive ? std::log(value) : value, 0.3, 1e-13);
        EXPECT_TRUE(test::matches(VectorXd::Constant(1, analytic), difference));
        EXPECT_GT(std::abs(analytic), 10 * difference.error[0]) << "a gradient that is zero tests nothing";
      };
      for (std::size_t a = 0; a < p.values.free_loading.size(); ++a) {
        for (Index k = 0; k < p.values.free_loading[a].size(); ++k) {
          SCOPED_TRACE(fmt::format("entry {} of the loading of latent {}", k, a));
          expect_match(
              gradient.free_loading[a].reshaped()[k], [&](auto& v) -> auto& { return v.free_loading[a].data()[k]; }, false);
        }
        for (Index k = 0; k < p.values.kernel[a].size(); ++k) {
          SCOPED_TRACE(fmt::format("parameter {} of the kernel of latent {}", k, a));
          expect_match(
              gradient.log_kernel[a][k], [&](auto& v) -> auto& { return v.kernel[a][k]; }, true);
        }
      }
    }
  }
}

TEST(LearnedDirections, AFixedKernelHasNoGradientButTheSameLoadings) {
  Learned p = learned(cases()[0]);
  Likelihood::Workspace workspace;
  ModelGradient free, fixed;
  const double value = Likelihood(p.prior, p.observations, p.values, {}).evaluate(p.values, &free, workspace);
  p.prior.latents[1].kernel_is_fixed = true;
  EXPECT_EQ(Likelihood(p.prior, p.observations, p.values, {}).evaluate(p.values, &fixed, workspace), value);
  EXPECT_TRUE(fixed.log_kernel[1].isZero(0));
  EXPECT_FALSE(free.log_kernel[1].isZero(0));
  EXPECT_EQ(fixed.log_kernel[0], free.log_kernel[0]);
  EXPECT_EQ(fixed.free_loading[1], free.free_loading[1]);
}

}  // namespace
}  // namespace gp2
