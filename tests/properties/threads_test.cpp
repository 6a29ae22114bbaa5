#include <cmath>
#include <functional>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "gp2/fit.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulate.hpp"
#include "test_models.hpp"

// Everything that is const, from many threads at once: the same bits as from one, and no race (run under the thread sanitizer).
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Quantity = View::Quantity;

constexpr std::uint64_t threads_seed = 20274;
constexpr int n_threads = 6;

void in_parallel(const std::function<void(int)>& work) {
  std::vector<std::thread> threads;
  threads.reserve(n_threads);
  for (int k = 0; k < n_threads; ++k) threads.emplace_back(work, k);
  for (std::thread& thread : threads) thread.join();
}

struct Shared {
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
  MatrixXd queries;
};

Shared shared(const std::string& file) {
  const Model& model = test::model(file);
  const GeneratedData data = generate(model, {24, threads_seed, VectorXd::Constant(model.system->nq(), 0.1)});
  Shared out{make_prior(model), {}, {}, test::draw(model, 10, threads_seed + 1).states};
  out.observations = {{data.states, View::all(Quantity::constrained_acceleration, *model.system), data.accelerations,
                       VectorXd::Constant(model.system->nq(), 0.1), true}};
  out.hyperparameters = default_hyperparameters(out.prior, out.observations, {}, {});
  return out;
}

// all that one thread asks of a posterior, in one vector
VectorXd everything(const Posterior& posterior, const Predictor& predictor, const MatrixXd& queries) {
  std::vector<double> numbers;
  const auto add = [&](const MatrixXd& matrix) { numbers.insert(numbers.end(), matrix.data(), matrix.data() + matrix.size()); };
  const System& system = *posterior.prior().system;
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::constraint_force}) {
    const View view = View::all(quantity, system);
    add(posterior.mean(view, queries, 2));
    add(posterior.marginal(view, queries, 2).covariance);
    add(posterior.joint(view, queries.leftCols(2)).covariance);
    add(posterior.sample({{view, queries.leftCols(2)}}, 2, threads_seed));
  }
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd mean(system.nq()), stddev(system.nq());
  MatrixXd jacobian(system.nq(), queries.rows());
  for (Index i = 0; i < queries.cols(); ++i) {
    EXPECT_EQ(predictor.mean_and_stddev(queries.col(i), mean, stddev, workspace), Predictor::Status::ok);
    add(mean);
    add(stddev);
    EXPECT_EQ(predictor.mean_and_jacobian(queries.col(i), mean, jacobian, workspace), Predictor::Status::ok);
    add(jacobian);
  }
  return Eigen::Map<const VectorXd>(numbers.data(), static_cast<Index>(numbers.size()));
}

class Threads : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Models, Threads, testing::Values("models/surface.toml", "models/slider_crank.toml"),
                         test::model_test_name);

TEST_P(Threads, PredictorsAndPosteriorsAreSharedByMany) {
  const Shared data = shared(GetParam());
  const Posterior posterior(data.prior, data.observations, model_values(data.prior, data.observations, data.hyperparameters));
  const MatrixXd queries = data.queries.array().isNaN().select(0, data.queries);
  // predictors of one posterior, made while others are in use
  const Predictor predictor(posterior);
  std::vector<VectorXd> results(n_threads);
  in_parallel([&](int k) {
    const Predictor own = k % 2 == 0 ? predictor : Predictor(posterior);
    results[static_cast<std::size_t>(k)] = everything(posterior, own, queries);
  });
  const VectorXd alone = everything(posterior, predictor, queries);
  EXPECT_TRUE(alone.allFinite());
  for (const VectorXd& result : results) EXPECT_EQ(result, alone);
}

// The expressions of a model grow with what is made of it.
TEST_P(Threads, PriorsAndSwitchingFunctionsAreMadeOfOneModelSideBySide) {
  const auto numbers = [&](const Model& model, const MatrixXd& states) {
    const Prior prior = make_prior(model);
    const MechanicsBatch mechanics = require_mechanics(*model.system, states, model.system->parameter_values());
    const PriorValues values = evaluate_prior(prior, states, model.system->parameter_values(), mechanics);
    double sum = values.mean.sum() + switching_functions(model, true).size();
    for (const MatrixXd& E : values.directions) sum += E.sum();
    const Coordinate& first = model.system->coordinates().front();
    const Expression more = model.expression("sin(" + first.name + ")*" + first.velocity() + "^3");
    for (const Expression& state : model.symbols().state())
      sum += static_cast<double>(model.graph->differentiate(more, state).operation());
    return sum;
  };
  const Model& known = test::model(GetParam());
  const MatrixXd drawn = test::draw(known, 10, threads_seed).states, states = drawn.array().isNaN().select(0, drawn);
  const double alone = numbers(known, states);
  for (int round = 0; round < 5; ++round) {
    const Model model = Model::parse(known.text, known.name);
    std::vector<double> results(n_threads);
    in_parallel([&](int k) { results[static_cast<std::size_t>(k)] = numbers(model, states); });
    for (const double result : results) EXPECT_EQ(result, alone);
  }
}

TEST_P(Threads, FitsOfOnePriorRunSideBySide) {
  const Shared data = shared(GetParam());
  const auto objective = [&](int k) {
    FitOptions options;
    options.n_restarts = 2;
    options.max_iterations = 4;
    options.max_escapes = 1;
    options.n_threads = 1 + k % 2;
    options.seed = 7;
    return fit(data.prior, data.observations, data.hyperparameters, options).report.objective;
  };
  std::vector<double> results(n_threads);
  in_parallel([&](int k) { results[static_cast<std::size_t>(k)] = objective(k); });
  for (const double result : results) EXPECT_EQ(result, results.front());
  EXPECT_EQ(objective(0), results.front());
}

TEST_P(Threads, SystemsLikelihoodsAndSampledFunctionsAreSharedByMany) {
  const Shared data = shared(GetParam());
  const System& system = *data.prior.system;
  const ModelValues values = model_values(data.prior, data.observations, data.hyperparameters);
  Likelihood::Options options;
  options.noise_gradient = true;
  const Likelihood likelihood(data.prior, data.observations, values, options);
  const Posterior posterior(data.prior, data.observations, values);
  const PathwiseSamples paths = sample_paths(posterior, 2, {});
  const MatrixXd queries = data.queries.array().isNaN().select(0, data.queries);
  const auto numbers = [&] {
    Likelihood::Workspace workspace(2);
    ModelGradient gradient;
    double sum =
        likelihood.evaluate(values, &gradient, workspace) + gradient.log_kernel[0].sum() + gradient.log_noise_stddev[0].sum();
    sum += require_mechanics(system, queries, values.parameters).projections[0].T().sum();
    for (int p = 0; p < static_cast<int>(system.parameters().size()); ++p) {
      sum += system.differentiate(queries, values.parameters, p).mass.sum();
    }
    // the tape of state derivatives is made by whoever asks first
    const auto evaluator = system.make_evaluator(values.parameters, true);
    sum += system.residuals(queries, values.parameters).sum();
    sum += paths.evaluate(0, View::all(Quantity::constrained_acceleration, system), queries).sum();
    return sum;
  };
  std::vector<double> results(n_threads);
  in_parallel([&](int k) { results[static_cast<std::size_t>(k)] = numbers(); });
  const double alone = numbers();
  EXPECT_TRUE(std::isfinite(alone));
  for (const double result : results) EXPECT_EQ(result, alone);
}

}  // namespace
}  // namespace gp2
