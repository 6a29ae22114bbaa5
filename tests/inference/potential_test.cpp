#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/inference/inducing.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/simulate.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"
#include "prior/gradient_columns.hpp"

// Latents that are potentials. The likelihood, its gradient, posteriors, samples and predictors are held against the kernel's
// derivatives with those of all other problems (problems.cpp); here stands what is true of potentials alone.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using test::Problem;
using testing::AllOf;
using testing::HasSubstr;

constexpr std::uint64_t potential_seed = 50821;

Problem potential_problem() {
  for (Problem& p : test::problems(24, potential_seed)) {
    if (p.name == "a potential, pooled with another swing") return std::move(p);
  }
  throw std::runtime_error("no problem");
}

View force_of(const Problem& p, int latent) {
  View view = View::all(View::Quantity::learned_force, *p.prior.system);
  view.latent = latent;
  return view;
}

// −∂/∂q of a function of the state, by differences
template <typename Energy>
void expect_force(const VectorXd& force, const VectorXd& state, const Energy& energy) {
  for (Index j = 0; j < force.size(); ++j) {
    const auto at = [&](double q) {
      VectorXd moved = state;
      moved[j] = q;
      return VectorXd::Constant(1, -energy(moved));
    };
    const test::Difference difference = test::central_difference(at, state[j], 0.1, 1e4 * test::eps);
    EXPECT_TRUE(test::matches(force.segment(j, 1), difference)) << j;
    EXPECT_LE(difference.error[0], 1e-5 * (1 + std::abs(force[j]))) << "the quotient is too coarse";
  }
}

TEST(Potential, TheLearnedForceIsItsGradientInMeanAndSamples) {
  const Problem p = potential_problem();
  const Posterior posterior = test::posterior_of(p);
  const PathwiseSamples samples = sample_paths(posterior, 2, {.n_features = 200, .seed = 3});
  const VectorXd reference = p.queries.col(0);
  for (const int latent : {0, 2}) {
    for (Index i = 1; i < p.queries.cols(); ++i) {
      SCOPED_TRACE(fmt::format("latent {}, state {}, seed {}", latent, i, potential_seed));
      const VectorXd state = p.queries.col(i);
      expect_force(posterior.mean(force_of(p, latent), state), state,
                   [&](const VectorXd& x) { return posterior.potential(latent, x, reference).mean[0]; });
      for (int s = 0; s < samples.n_samples(); ++s) {
        expect_force(samples.evaluate(s, force_of(p, latent), state), state,
                     [&](const VectorXd& x) { return samples.potential(s, latent, x, reference)[0]; });
      }
    }
  }
}

TEST(Potential, ItsDeviationIsThatOfTheWorkAlongAnyPath) {
  const Problem p = potential_problem();
  const Posterior posterior = test::posterior_of(p);
  // the work −∫ F·dq along a line, by Simpson's rule, of the joint posterior of the force
  constexpr Index n = 201;
  const VectorXd from = p.queries.col(0), to = p.queries.col(1);
  MatrixXd states(from.size(), n);
  for (Index i = 0; i < n; ++i) states.col(i) = from + static_cast<double>(i) / (n - 1) * (to - from);
  states.row(p.prior.system->layout().t()).setConstant(from[p.prior.system->layout().t()]);
  const Index nq = p.prior.system->nq();
  const VectorXd step = (to - from).head(nq) / (n - 1);
  VectorXd weights(nq * n);
  for (Index i = 0; i < n; ++i) {
    const double w = i == 0 || i == n - 1 ? 1 : i % 2 == 1 ? 4 : 2;
    weights.segment(nq * i, nq) = -w / 3 * step;
  }
  const Posterior::Joint joint = posterior.joint(force_of(p, 0), states);
  const Posterior::Potential energy = posterior.potential(0, states.col(n - 1), from);
  EXPECT_NEAR(energy.mean[0], weights.dot(joint.mean), 1e-6 * (1 + std::abs(energy.mean[0])));
  EXPECT_NEAR(energy.stddev[0], std::sqrt(weights.dot(joint.covariance * weights)), 1e-6 * (1 + energy.stddev[0]));
  EXPECT_GT(energy.stddev[0], 1e-3);
  EXPECT_EQ(posterior.potential(0, from, from).mean[0], 0);
  EXPECT_NEAR(posterior.potential(0, from, from).stddev[0], 0, 1e-7);
}

TEST(Potential, SamplesHaveTheDeviationOfThePosterior) {
  const Problem p = potential_problem();
  const Posterior posterior = test::posterior_of(p);
  const Posterior::Potential energy = posterior.potential(2, p.queries.col(1), p.queries.col(0));
  constexpr int n = 2000;
  const PathwiseSamples samples = sample_paths(posterior, n, {.n_features = 40, .seed = 5});
  VectorXd values(n);
  for (int s = 0; s < n; ++s) values[s] = samples.potential(s, 2, p.queries.col(1), p.queries.col(0))[0];
  EXPECT_NEAR(values.mean(), energy.mean[0], 5 * energy.stddev[0] / std::sqrt(n));
  EXPECT_NEAR(std::sqrt((values.array() - values.mean()).square().mean()), energy.stddev[0], 0.1 * energy.stddev[0]);
}

// ---------------------------------------------------------------- conservation of energy

const Model& double_pendulum() {
  static const Model model = Model::parse(R"toml(
name        = "double pendulum on springs"
coordinates = [{ name = "q1", angle = true }, { name = "q2", angle = true }]
[mechanics]
mass      = [["1.8", "0.56*cos(q1-q2)"], ["0.56*cos(q1-q2)", "0.392"]]
force     = ["-0.56*sin(q1-q2)*dq2^2", "0.56*sin(q1-q2)*dq1^2"]
[[latent]]
name       = "springs"
kernel     = "rq"
features   = ["q1", "q2"]
directions = "potential"
[truth]
force = ["-17*sin(q1) - 4*sin(q1-q2) - 2*sin(2*q1)", "-5*sin(q2) + 4*sin(q1-q2)"]
[sampling]
q1  = [-2, 2]
q2  = [-2, 2]
dq1 = [-2, 2]
dq2 = [-2, 2]
)toml",
                                          "pendulum");
  return model;
}

TEST(Potential, MotionsOfTheMeanAndOfSamplesConserveEnergy) {
  const Model& model = double_pendulum();
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const GeneratedData data = test::draw(model, 40, potential_seed);
  const View view = View::constrained_acceleration(*model.system);
  const std::vector<Observations> observations = {
      Observations(data.states, view, data.accelerations, VectorXd::Constant(2, 0.05), false)};
  RandomStream random(potential_seed);
  ModelValues values = test::random_values(prior, observations, random);
  values.signal_stddev[0].setConstant(60);
  const Posterior posterior(prior, observations, values);
  const PathwiseSamples samples = sample_paths(posterior, 1, {.seed = 7});
  VectorXd start = VectorXd::Zero(model.system->layout().size());
  start << 1.2, -0.7, 0.3, 0.5, 0;
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(101, 0, 20);
  options.relative_tolerance = options.absolute_tolerance = 1e-9;
  for (const bool of_sample : {false, true}) {
    const Trajectory motion = simulate(
        *model.system, values.parameters,
        [&](const auto& x) -> VectorXd { return of_sample ? samples.evaluate(0, view, x) : posterior.mean(view, x); }, start,
        options);
    VectorXd energy =
        of_sample ? samples.potential(0, 0, motion.states, start) : posterior.potential(0, motion.states, start).mean;
    const double depth = energy.maxCoeff() - energy.minCoeff();
    EXPECT_GT(depth, 1);
    for (Index i = 0; i < energy.size(); ++i) {
      const VectorXd dq = motion.states.col(i).segment(2, 2);
      energy[i] += 0.5 * dq.dot(model.system->evaluate(motion.states.col(i), values.parameters).M(0) * dq);
    }
    EXPECT_LE(energy.maxCoeff() - energy.minCoeff(), 1e-6 * depth) << "sample " << of_sample << ", seed " << potential_seed;
  }
}

// ---------------------------------------------------------------- what is refused

std::string error_of(const std::string& from, const std::string& to) {
  return input_error_of([&] {
    static_cast<void>(Model::parse(test::changed(double_pendulum().text, {{from, to}}), "pendulum"));
  });
}

TEST(Potential, TheModelFileSaysWhatItCannotBe) {
  EXPECT_THAT(error_of(R"(["q1", "q2"]
directions)",
                       R"(["q1", "dq2"]
directions)"),
              AllOf(HasSubstr("pendulum:10: latent.features"), HasSubstr("a potential depends on coordinates and t alone")));
  EXPECT_THAT(
      error_of(R"("rq")", R"("matern32")"),
      AllOf(HasSubstr("pendulum:9: latent.kernel"), HasSubstr("is a sum of se, matern52, rq and linear, got \"matern32\"")));
  EXPECT_THAT(error_of(R"("rq")", R"("se*linear")"), HasSubstr("got \"se*linear\""));
  EXPECT_THAT(error_of("\nkernel ", "\nlengthscales = \"per direction\"\nkernel "),
              HasSubstr("pendulum:9: latent.lengthscales: a potential is one function"));
  EXPECT_THAT(error_of(R"("potential")", R"("potentials")"), HasSubstr(R"(expected "acceleration", "force", "potential" or)"));
  EXPECT_THAT(
      input_error_of([] {
        static_cast<void>(make_prior(double_pendulum().system, {{.name = "V", .features = {"dq1"}, .is_potential = true}}));
      }),
      HasSubstr("a potential depends on coordinates and t alone, but the feature 'dq1' reads more"));
  EXPECT_THAT(input_error_of([] {
                static_cast<void>(make_prior(double_pendulum().system,
                                             {{.name = "V", .kernel = "periodic", .features = {"q1"}, .is_potential = true}}));
              }),
              HasSubstr("the kernel of a potential is a sum of se, matern52, rq and linear, got \"periodic\""));
}

TEST(Potential, ItsFeaturesAreTheCoordinatesWhereNoneAreGiven) {
  const Model model = Model::parse(
      test::changed(double_pendulum().text, {{"features   = [\"q1\", \"q2\"]\ndirections", "directions"}}), "pendulum");
  EXPECT_EQ(make_prior(model).latents[0].feature_names, (std::vector<std::string>{"sin(q1)", "cos(q1)", "sin(q2)", "cos(q2)"}));
}

TEST(Potential, HasOneSignal) {
  Problem p = potential_problem();
  EXPECT_THAT(input_error_of([&] { static_cast<void>(test::posterior_of(p).potential(1, p.queries, p.queries.col(0))); }),
              HasSubstr("the latent 'friction' is none"));
  EXPECT_THAT(input_error_of([&] { static_cast<void>(test::posterior_of(p).potential(3, p.queries, p.queries.col(0))); }),
              HasSubstr("the prior has 3 latents"));
  p.values.signal_stddev[0][1] *= 2;
  EXPECT_THAT(input_error_of([&] { static_cast<void>(test::posterior_of(p)); }), HasSubstr("must be one number for all"));
}

}  // namespace
}  // namespace gp2
