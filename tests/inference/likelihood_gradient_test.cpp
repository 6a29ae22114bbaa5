#include <gtest/gtest.h>

#include "gp2/inference/inducing.hpp"
#include "inference/assemble.hpp"
#include "inference/nonlinear_motion.hpp"
#include "inference/problems.hpp"

// The analytic gradient against differences, for every hyperparameter of every problem.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;

constexpr std::uint64_t likelihood_gradient_seed = 40402;

class Gradient {
 public:
  explicit Gradient(const Problem& problem) : problem_(problem), likelihood_(make(problem)) {
    value_ = likelihood_.evaluate(problem.values, &gradient_, workspace_);
  }

  [[nodiscard]] const ModelGradient& analytic() const { return gradient_; }

  // `member` picks the number out of ModelValues; positive ones are differentiated in their logarithm
  template <typename Member>
  void expect_match(const std::string& name, double analytic, const Member& member, bool positive) {
    SCOPED_TRACE(name);
    const double value = member(problem_.values);
    const auto at = [&](double x) -> VectorXd {
      ModelValues moved = problem_.values;
      member(moved) = positive ? std::exp(x) : x;
      return VectorXd::Constant(1, likelihood_.evaluate(moved, nullptr, workspace_));
    };
    const double scale = positive ? 0.5 : 0.05 * (value == 0 ? 1 : std::abs(value));
    // rounding of the value: ε times the condition number (the tests' noise keeps it near a hundred)
    const test::Difference difference =
        test::central_difference(at, positive ? std::log(value) : value, scale, 64 * test::eps * (1 + condition_ / 100));
    EXPECT_TRUE(std::isfinite(analytic));
    EXPECT_TRUE(test::matches(VectorXd::Constant(1, analytic), difference));
    if (std::abs(analytic) > 10 * difference.error[0]) ++n_nonzero_;
    // in units of the value's change over the parameter's own scale
    EXPECT_LE(difference.error[0] * scale, 1e-5 * (1 + std::abs(value_) + std::abs(analytic) * scale))
        << "the quotient is too coarse";
  }

  [[nodiscard]] int n_nonzero() const { return n_nonzero_; }

 private:
  static Likelihood make(const Problem& problem) {
    Likelihood::Options options;
    options.noise_gradient = true;
    for (int p = 0; p < static_cast<int>(problem.values.parameters.size()); ++p) options.gradient_parameters.push_back(p);
    return {problem.prior, problem.observations, problem.values, options};
  }

  const Problem& problem_;
  Likelihood likelihood_;
  Likelihood::Workspace workspace_;
  ModelGradient gradient_;
  double value_ = 0;
  double condition_ = test::condition(problem_);
  int n_nonzero_ = 0;
};

// that of a potential, which is one number for all columns
template <typename Signal>
struct SignalOfAll {
  explicit SignalOfAll(Signal& of) : signal(of) {}
  operator double() const { return signal[0]; }                // NOLINT(google-explicit-constructor)
  void operator=(double value) { signal.setConstant(value); }  // NOLINT(misc-unconventional-assign-operator)
  Signal& signal;
};

bool estimable(const Problem& p, const std::string& parameter) {
  return std::find(p.not_estimable.begin(), p.not_estimable.end(), parameter) == p.not_estimable.end();
}

class LikelihoodGradient : public testing::TestWithParam<std::string> {};

std::vector<std::string> problem_names() {
  std::vector<std::string> names;
  for (const std::string& file : test::library_models()) names.push_back(test::stem(file));
  names.insert(names.end(), {"a row that vanishes", "friction", "a load", "contacts", "a potential"});
  return names;
}

INSTANTIATE_TEST_SUITE_P(EveryModel, LikelihoodGradient, testing::ValuesIn(problem_names()), [](const auto& instance) {
  std::string name = instance.param;
  std::replace(name.begin(), name.end(), ' ', '_');
  return name;
});

void expect_gradient(const Problem& p) {
  SCOPED_TRACE(fmt::format("{}, mean {}, seed {}", p.name, static_cast<int>(p.prior.mean), likelihood_gradient_seed));
  Gradient gradient(p);
  int n_expected_nonzero = 0;
  for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
    for (Index k = 0; k < p.values.kernel[a].size(); ++k) {
      gradient.expect_match(
          p.prior.latents[a].name + ": " + p.prior.latents[a].kernel.parameters()[static_cast<std::size_t>(k)].name,
          gradient.analytic().log_kernel[a][k], [&](auto& v) -> auto& { return v.kernel[a][k]; }, true);
    }
    if (p.prior.latents[a].is_potential) {
      gradient.expect_match(
          p.prior.latents[a].name + ": signal", gradient.analytic().log_signal_stddev[a].sum(),
          [&](auto& v) { return SignalOfAll(v.signal_stddev[a]); }, true);
    }
    for (Index l = 0; l < p.values.signal_stddev[a].size() && !p.prior.latents[a].is_potential; ++l) {
      gradient.expect_match(
          fmt::format("{}: signal of {}", p.prior.latents[a].name, p.prior.latents[a].column_names[static_cast<std::size_t>(l)]),
          gradient.analytic().log_signal_stddev[a][l], [&](auto& v) -> auto& { return v.signal_stddev[a][l]; }, true);
    }
    n_expected_nonzero += static_cast<int>(p.values.kernel[a].size());
  }
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    for (Index k = 0; k < p.values.noise_stddev[g].size(); ++k) {
      gradient.expect_match(
          fmt::format("noise {} of group {}", k, g),
          gradient.analytic().log_noise_stddev[g][k], [&](auto& v) -> auto& { return v.noise_stddev[g][k]; }, true);
      ++n_expected_nonzero;
    }
  }
  EXPECT_GE(gradient.n_nonzero(), n_expected_nonzero / 2) << "a gradient that is zero tests nothing";
  const int before = gradient.n_nonzero();
  for (Index k = 0; k < p.values.parameters.size(); ++k) {
    const std::string& name = p.prior.system->parameters()[static_cast<std::size_t>(k)].name;
    if (!estimable(p, name)) continue;
    gradient.expect_match(
        "parameter " + name, gradient.analytic().parameters[k], [&](auto& v) -> auto& { return v.parameters[k]; }, false);
  }
  // ā itself knows nothing of the system unless through μ or the directions
  const bool sees_mechanics =
      p.prior.mean == Prior::Mean::force || p.observations[0].view().quantity == View::Quantity::constrained_acceleration;
  if (sees_mechanics) {
    EXPECT_GT(gradient.n_nonzero(), before);
  }
}

TEST_P(LikelihoodGradient, MatchesDifferencesInEveryHyperparameter) {
  int n_problems = 0;
  for (const Problem& p : test::problems(9, likelihood_gradient_seed)) {
    if (!p.name.starts_with(GetParam())) continue;
    ++n_problems;
    expect_gradient(p);
  }
  EXPECT_GT(n_problems, 0);
}

TEST(LikelihoodGradientTest, MatchesDifferencesWhereEachValueHasItsOwnNoise) {
  std::vector<std::string> seen;
  for (const Problem& p : test::problems(9, likelihood_gradient_seed)) {
    const std::string model = p.name.substr(0, p.name.find(','));
    if (std::find(seen.begin(), seen.end(), model) != seen.end()) continue;
    seen.push_back(model);
    expect_gradient(test::with_noise_scale(p, likelihood_gradient_seed));
  }
  EXPECT_GT(seen.size(), 3U);
}

TEST(LikelihoodGradientTest, MatchesDifferencesWhereSumsAreMeasured) {
  int n_problems = 0;
  for (const Problem& p : test::problems(9, likelihood_gradient_seed)) {
    if (p.prior.system->has_constraint_noise()) continue;
    expect_gradient(test::with_sums(p, ++n_problems % 2 == 0, likelihood_gradient_seed));
  }
  EXPECT_GT(n_problems, 5);
}

TEST(LikelihoodGradientTest, MatchesDifferencesThroughInducingPoints) {
  for (Problem p : test::problems(40, likelihood_gradient_seed)) {
    p.values.inducing = choose_inducing_points(p.prior, p.observations, p.values, {.most = 25, .left_out = 1e-12}).points;
    expect_gradient(p);
  }
}

// every latent acts nonlinearly there, about signals that are not those of a posterior
TEST(LikelihoodGradientTest, MatchesDifferencesWhereAPriorIsMadeLinear) {
  for (const Model& model : {test::model_that_rubs(), test::model_that_rubs_softly()}) {
    Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, {}, {}};
    RandomStream random(likelihood_gradient_seed);
    const MatrixXd states = test::draw(model, 9, likelihood_gradient_seed).states;
    for (const View& view : {View::constrained_acceleration(*model.system), View::constraint_force(*model.system)}) {
      p.observations.push_back(test::observe(model, view, states, random));
    }
    p.values = test::random_values(p.prior, p.observations, random);
    Linearisation about;
    for (const Observations& group : p.observations) {
      const MechanicsBatch mechanics = require_mechanics(*model.system, group.states(), p.values.parameters);
      const NonlinearMotion motion(p.prior, group.states(), p.values.parameters, mechanics,
                                   evaluate_prior(p.prior, group.states(), p.values.parameters, mechanics));
      about.groups.push_back(motion.without_signals());
      for (MatrixXd& signals : about.groups.back().signals) {
        for (double& one : signals.reshaped()) one = 0.1 * random.normal();
      }
      ASSERT_FALSE(motion.solve(about.groups.back()));
    }
    p.values.about = std::make_shared<Linearisation>(about);
    expect_gradient(p);
    if (!model.system->has_constraint_noise()) expect_gradient(test::with_sums(p, true, likelihood_gradient_seed));
  }
}

// a parameter that the other system has not changes nothing there, nor the noise of its soft constraints
TEST(LikelihoodGradientTest, MatchesDifferencesWhereAnotherSystemSlipsToo) {
  const Model& model = test::model_with_a_slipping_wheel();
  const Model other = Model::parse(
      test::changed(model.text, {{"m = 2.0", "m = 2.6"}, {"e = 0.3", "e = { value = 0.3, estimate = true }"}}), "other wheels");
  int n_problems = 0;
  for (Problem p : test::problems(9, likelihood_gradient_seed)) {
    if (p.name != "slipping wheels") continue;
    ++n_problems;
    const auto elsewhere = make_other_system(model, other, {p.prior.mean, std::nullopt, false});
    p.observations.push_back(p.observations[0].with_view(test::under(p.observations[0].view(), elsewhere)));
    p.values.noise_stddev.push_back(p.values.noise_stddev[0]);
    expect_gradient(p);
  }
  EXPECT_EQ(n_problems, 2);
}

// the sums over pairs of samples go tile by tile: here are several, and samples whose ranks differ
TEST(LikelihoodGradientTest, MatchesDifferencesOverSeveralTiles) {
  int n_problems = 0;
  for (const Problem& p : test::problems(3 + 2 * static_cast<int>(tile_size) + 11, likelihood_gradient_seed)) {
    if (!p.name.starts_with("a row that vanishes")) continue;
    ++n_problems;
    expect_gradient(p);
  }
  EXPECT_GT(n_problems, 0);
}

TEST(LikelihoodGradientTest, IsTheSameToTheBitOnAnyNumberOfThreads) {
  for (const Problem& p : test::problems(3 + 530, likelihood_gradient_seed)) {
    if (!p.name.starts_with("a row that vanishes") && !p.name.starts_with("friction")) continue;
    SCOPED_TRACE(p.name);
    Likelihood::Options options;
    options.noise_gradient = true;
    options.gradient_parameters = {0};
    const Likelihood likelihood(p.prior, p.observations, p.values, options);
    ASSERT_LT(likelihood.reduced_size(), 2000) << "larger matrices are factored on several threads";
    ModelGradient gradient, other;
    Likelihood::Workspace one(1), three(3);
    EXPECT_EQ(likelihood.evaluate(p.values, &gradient, one), likelihood.evaluate(p.values, &other, three));
    for (std::size_t a = 0; a < gradient.log_kernel.size(); ++a) {
      EXPECT_EQ(gradient.log_kernel[a], other.log_kernel[a]);
      EXPECT_EQ(gradient.log_signal_stddev[a], other.log_signal_stddev[a]);
    }
    for (std::size_t g = 0; g < gradient.log_noise_stddev.size(); ++g)
      EXPECT_EQ(gradient.log_noise_stddev[g], other.log_noise_stddev[g]);
    EXPECT_EQ(gradient.parameters, other.parameters);
    break;
  }
}

TEST(LikelihoodGradientTest, IsAllThatWasAskedForAndZeroElsewhere) {
  const Problem p = test::problems(9, likelihood_gradient_seed).front();
  Likelihood::Workspace workspace;
  ModelGradient gradient;
  Likelihood(p.prior, p.observations, p.values, {}).evaluate(p.values, &gradient, workspace);
  EXPECT_TRUE(gradient.parameters.isZero(0));
  EXPECT_TRUE(gradient.log_noise_stddev[0].isZero(0));
  EXPECT_FALSE(gradient.log_kernel[0].isZero(0));
  EXPECT_EQ(gradient.parameters.size(), p.values.parameters.size());

  // the same numbers whether or not the rest is asked for
  Likelihood::Options options;
  options.noise_gradient = true;
  options.gradient_parameters = {1};
  ModelGradient more;
  Likelihood(p.prior, p.observations, p.values, options).evaluate(p.values, &more, workspace);
  EXPECT_EQ(more.log_kernel, gradient.log_kernel);
  EXPECT_EQ(more.log_signal_stddev, gradient.log_signal_stddev);
  EXPECT_EQ(more.parameters[0], 0);
}

TEST(LikelihoodGradientTest, IsFiniteWhenEverySampleIsAtRest) {
  for (Problem p : test::problems(9, likelihood_gradient_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, likelihood_gradient_seed));
    const StateLayout layout = p.prior.system->layout();
    for (Observations& group : p.observations) {
      MatrixXd states = group.states();
      states.middleRows(layout.dq(0), layout.nq).setZero();
      group = test::with_states(group, states);
    }
    Likelihood::Options options;
    options.noise_gradient = true;
    for (int k = 0; k < static_cast<int>(p.values.parameters.size()); ++k) options.gradient_parameters.push_back(k);
    Likelihood::Workspace workspace;
    ModelGradient gradient;
    EXPECT_TRUE(std::isfinite(Likelihood(p.prior, p.observations, p.values, options).evaluate(p.values, &gradient, workspace)));
    for (const VectorXd& g : gradient.log_kernel) EXPECT_TRUE(g.allFinite());
    for (const VectorXd& g : gradient.log_signal_stddev) EXPECT_TRUE(g.allFinite());
    for (const VectorXd& g : gradient.log_noise_stddev) EXPECT_TRUE(g.allFinite());
    EXPECT_TRUE(gradient.parameters.allFinite());
  }
}

}  // namespace
}  // namespace gp2
