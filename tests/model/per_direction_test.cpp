// Latents whose directions have hyperparameters of their own, and the prior of a latent that says nothing of its kernel.
#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/base/statistics.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/posterior.hpp"
#include "gp2/simulation/generate.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::DoubleEq;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Pair;

Model sledge(const std::string& latents) {
  return Model::parse(R"toml(
name        = "sledge"
coordinates = ["x", "y"]
[parameters]
m = { value = 2.0, bounds = [1, 4] }
[mechanics]
mass  = [["m", "0.3"], ["0.3", "1 + x^2"]]
[constraints]
velocity = ["dy - 0.4*x*dx"]
[truth]
acceleration = ["-0.4*dx", "-x"]
[sampling]
x  = [-1, 1]
y  = [-1, 1]
dx = [-1, 1]
[noise]
ddq = 0.05
)toml" + latents,
                      "sledge.toml");
}

FitProblem problem_of(const Model& model) {
  const System& system = *model.system;
  const GeneratedData data = generate(model, {15, 4, VectorXd::Constant(system.nq(), 0.05), {}});
  FitProblemOptions options;
  options.estimate = std::vector<std::string>{"m"};
  options.discrepancy = false;
  return make_fit_problem(model, as_table(data, system, "log.csv"), options);
}

std::vector<std::string> names_of(const FitProblem& problem) {
  std::vector<std::string> names;
  for (const Hyperparameter& h : problem.hyperparameters) names.push_back(h.name);
  return names;
}

struct Value {
  double nll = 0;
  ModelGradient gradient;
};
Value value_of(const FitProblem& problem, const std::vector<double>& values) {
  std::vector<Hyperparameter> at = problem.hyperparameters;
  for (std::size_t k = 0; k < at.size(); ++k) at[k].value = values[k];
  const ModelValues model = model_values(problem.prior, problem.observations, at);
  Likelihood::Options options;
  if (!problem.prior.system->parameters().empty()) options.gradient_parameters = {0};
  const Likelihood likelihood(problem.prior, problem.observations, model, options);
  Likelihood::Workspace workspace;
  Value value;
  value.nll = likelihood.evaluate(model, &value.gradient, workspace);
  return value;
}

std::vector<double> some_values(const FitProblem& problem) {
  std::vector<double> values;
  for (std::size_t k = 0; k < problem.hyperparameters.size(); ++k)
    values.push_back(problem.hyperparameters[k].value * (0.8 + 0.1 * static_cast<double>(k % 5)));
  return values;
}

TEST(PerDirection, IsTheSameAsLatentsWrittenOneByOne) {
  const std::string rest = "kernel = \"se + linear\"\nfeatures = [\"x\", \"dx\"]\n";
  const std::pair<std::string, std::vector<std::string>> cases[] = {
      {"\"acceleration\"", {"[[\"1\"], [\"0\"]]", "[[\"0\"], [\"1\"]]"}},
      {"\"force\"", {"{ force = [[\"1\"], [\"0\"]] }", "{ force = [[\"0\"], [\"1\"]] }"}},
      {"{ force = [[\"m*x\", \"1\"], [\"0\", \"dx\"]] }",
       {"{ force = [[\"m*x\"], [\"0\"]] }", "{ force = [[\"1\"], [\"dx\"]] }"}}};
  for (const auto& [whole, parts] : cases) {
    SCOPED_TRACE(whole);
    const FitProblem together =
        problem_of(sledge("[[latent]]\n" + rest + "lengthscales = \"per direction\"\ndirections = " + whole + "\n"));
    std::string written;
    for (const std::string& part : parts) written += "[[latent]]\n" + rest + "directions = " + part + "\n";
    const FitProblem apart = problem_of(sledge(written));
    ASSERT_EQ(together.hyperparameters.size(), apart.hyperparameters.size());
    const Value expected = value_of(apart, some_values(together)), got = value_of(together, some_values(together));
    EXPECT_DOUBLE_EQ(got.nll, expected.nll);
    ASSERT_EQ(got.gradient.log_kernel.size(), 2U);
    for (std::size_t a = 0; a < 2; ++a) {
      EXPECT_LE((got.gradient.log_kernel[a] - expected.gradient.log_kernel[a]).norm(),
                1e-12 * expected.gradient.log_kernel[a].norm());
    }
    EXPECT_NEAR(got.gradient.parameters[0], expected.gradient.parameters[0], 1e-12 * std::abs(expected.gradient.parameters[0]));
  }
}

TEST(PerDirection, HyperparametersGoByTheDirection) {
  const FitProblem problem =
      problem_of(sledge("[[latent]]\nname = \"f\"\nfeatures = [\"x\"]\ndirections = \"force\"\n"
                        "kernel = \"se\"\nlengthscales = \"per direction\"\n"));
  EXPECT_THAT(names_of(problem), ElementsAre("force_x.lengthscale(x)", "force_x.signal_stddev(force_x)", "force_y.lengthscale(x)",
                                             "force_y.signal_stddev(force_y)", "m"));
}

TEST(PerDirection, IsViewedAsOneLatent) {
  const std::string other = "[[latent]]\nname = \"other\"\nkernel = \"se\"\nfeatures = [\"y\"]\n";
  const FitProblem problem = problem_of(
      sledge(other + "[[latent]]\nname = \"f\"\nkernel = \"se\"\nfeatures = [\"x\"]\nlengthscales = \"per direction\"\n"));
  ASSERT_EQ(problem.prior.latents.size(), 3U);
  const LatentRange f = latents_called(problem.prior, "f", "`latent`");
  EXPECT_EQ(f, LatentRange(1, 2));
  const Posterior posterior(problem.prior, problem.observations,
                            model_values(problem.prior, problem.observations, problem.hyperparameters));
  const MatrixXd states = problem.observations.front().states().leftCols(4);
  View view = View::constrained_acceleration(*problem.prior.system);
  const Posterior::Marginal all = posterior.marginal(view, states);
  view.latent = f;
  const Posterior::Marginal of_f = posterior.marginal(view, states);
  MatrixXd sum = MatrixXd::Zero(2, 4);
  for (const int a : {1, 2}) {
    view.latent = a;
    sum += posterior.marginal(view, states).mean;
  }
  EXPECT_LE((of_f.mean - sum).norm(), 1e-14 * sum.norm());
  EXPECT_TRUE((of_f.covariance.array().isFinite()).all());
  view.latent = 0;
  // what is left of the whole is the offset L b
  const MatrixXd rest = all.mean - of_f.mean - posterior.marginal(view, states).mean;
  const MechanicsBatch mechanics = require_mechanics(*problem.prior.system, states, posterior.values().parameters);
  for (int i = 0; i < 4; ++i) EXPECT_LE((rest.col(i) - mechanics.projections[static_cast<std::size_t>(i)].Lb()).norm(), 1e-13);
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(latents_called(problem.prior, "g", "`latent`")); }),
              HasSubstr("no latent is called 'g'; there are: other, f"));
  view.latent = LatentRange(2, 2);
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(posterior.marginal(view, states)); }), HasSubstr("got the latent 3"));
}

TEST(DefaultPrior, OfALatentWithoutAKernelIsForEachDirection) {
  const Model model = sledge("[[latent]]\nfeatures = [\"x\"]\n");
  const Prior prior = make_prior(model);
  ASSERT_EQ(prior.latents.size(), 2U);
  EXPECT_EQ(prior.latents[0].kernel.text(), PriorOptions().kernel);
  EXPECT_EQ(prior.latents[1].direction, "ddy");
  const Model shared = sledge("[[latent]]\nfeatures = [\"x\"]\nlengthscales = \"shared\"\n");
  EXPECT_EQ(make_prior(shared).latents.size(), 1U);
  const Model stated = sledge("[[latent]]\nfeatures = [\"x\"]\nkernel = \"matern32\"\n");
  EXPECT_EQ(make_prior(stated).latents.size(), 1U);
}

// The zero of a place is a matter of choice, that of a velocity or of an input is not.
TEST(DefaultPrior, DoesNotDependOnWhereACoordinateHasItsZero) {
  const auto rail_from = [](double zero, const std::string& kernel = "") {
    return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y"]
inputs      = ["u"]
[mechanics]
mass  = [["2", "0"], ["0", "1"]]
force = ["u", "0"]
[constraints]
position = ["y - 0.3*(x - {0})^2"]
[[latent]]
features = ["x", "dx", "u"]
{1}[noise]
ddq = 0.05
[sampling]
x  = [{2}, {3}]
dx = [0.5, 2]
u  = [1, 2]
[truth]
acceleration = ["-0.4*dx", "0"]
)toml",
                                    zero, kernel, zero - 1, zero + 0.4),
                        "rail.toml");
  };
  constexpr double zero = 16;
  const Model here = rail_from(0), there = rail_from(zero);
  GeneratedData data = generate(here, {15, 4, VectorXd::Constant(2, 0.05), {}});
  const auto problem_of_data = [&](const Model& model) {
    return make_fit_problem(model, as_table(data, *model.system, "log.csv"), FitProblemOptions());
  };
  const FitProblem near = problem_of_data(here);
  data.states.row(0).array() += zero;
  const FitProblem far = problem_of_data(there);
  EXPECT_THAT(far.prior_options.feature_centres, ElementsAre(Pair("x", DoubleEq(row_mean(data.states)[0]))));
  EXPECT_NEAR(value_of(far, some_values(near)).nll, value_of(near, some_values(near)).nll, 1e-9);
  const Model stated = rail_from(zero, "kernel = \"se + linear\"\n");
  EXPECT_TRUE(problem_of_data(stated).prior_options.feature_centres.empty());
}

TEST(DefaultPrior, HasARoughTermAlongDirectionsThatAreGiven) {
  const auto kernel_of = [](const std::string& latent, const PriorOptions& options = {}) {
    return make_prior(sledge("[[latent]]\nfeatures = [\"dx\"]\n" + latent), options).latents.front().kernel.text();
  };
  const std::string along = "directions = { force = [[\"1\"], [\"0\"]] }\n";
  EXPECT_EQ(kernel_of(along), "se + matern32 + linear");
  EXPECT_EQ(kernel_of(along + "kernel = \"rq\"\n"), "rq");
  EXPECT_EQ(kernel_of("directions = \"force\"\n"), "se + linear");
  PriorOptions everywhere;
  everywhere.base = Latent::Base::force;
  EXPECT_EQ(kernel_of(along, everywhere), "se + linear");
}

// Where its mean is rounded it is not 0 about it, and a spread of rounding would be its lengthscale.
TEST(DefaultPrior, OfAFeatureThatDoesNotVaryIsScaledByItsSize) {
  const Model model = Model::parse(R"toml(
coordinates = ["a", "b"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[[latent]]
features = ["a", "b", "da"]
[noise]
ddq = 0.05
[sampling]
a  = [-1, 1]
b  = [-1, 1]
da = [-1, 1]
[truth]
acceleration = ["-sin(a) - 0.3*da", "0"]
)toml",
                                   "locked.toml");
  for (const double locked : {0.7, -0.9, 0.1, 1e-3}) {
    for (const int n : {20, 59, 60}) {
      GeneratedData data = generate(model, {n, 4, VectorXd::Constant(2, 0.05), {}});
      data.states.row(1).setConstant(locked);
      const FitProblem problem = make_fit_problem(model, as_table(data, *model.system, "log.csv"), FitProblemOptions());
      EXPECT_THAT(problem.prior_options.feature_centres, ElementsAre(Pair("a", testing::_)));
      const Scales scales = default_scales(problem.prior, problem.observations);
      EXPECT_NEAR(scales.feature_stddev[0][1], std::abs(locked), 1e-12) << locked << ", " << n;
    }
  }
  // of a velocity, whose zero is one, squares are summed
  GeneratedData data = generate(model, {20, 4, VectorXd::Constant(2, 0.05), {}});
  for (Index i = 0; i < 20; ++i) data.states(2, i) = 0.7 * (1 + 1e-10 * std::sin(static_cast<double>(i)));
  const FitProblem problem = make_fit_problem(model, as_table(data, *model.system, "log.csv"), FitProblemOptions());
  EXPECT_NEAR(default_scales(problem.prior, problem.observations).feature_stddev[0][2], 0.7, 1e-9);
  const Posterior start(problem.prior, problem.observations,
                        model_values(problem.prior, problem.observations, problem.hyperparameters));
  EXPECT_TRUE(std::isfinite(start.negative_log_likelihood()));
}

TEST(DefaultPrior, OfThePapersProtocolIsOneSquaredExponential) {
  const Model model = sledge("[[latent]]\nfeatures = [\"x\"]\n");
  const GeneratedData data = generate(model, {15, 4, VectorXd::Constant(2, 0.05), {}});
  FitProblemOptions options;
  options.protocol.name = Protocol::Name::paper;
  const FitProblem problem = make_fit_problem(model, as_table(data, *model.system, "log.csv"), options);
  ASSERT_EQ(problem.prior.latents.size(), 1U);
  EXPECT_EQ(problem.prior.latents[0].kernel.text(), "se");
}

TEST(PerDirection, OfAnotherWordIsRefused) {
  EXPECT_THAT(
      test::input_error_of([&] { static_cast<void>(sledge("[[latent]]\nfeatures = [\"x\"]\nlengthscales = \"own\"\n")); }),
      HasSubstr(R"(expected "shared", "per direction" or a table)"));
}

}  // namespace
}  // namespace gp2
