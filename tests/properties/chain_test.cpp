#include <ctime>
#include <functional>

#include <gtest/gtest.h>

#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/generate.hpp"
#include "properties/chain_of_links.hpp"
#include "test_models.hpp"

// Many coordinates under many constraints: chains of 5, 10 and 20 links, to n = 60 and m = 40.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;

constexpr std::uint64_t chain_seed = 20273;

// of the processor: other programs run beside the tests
double seconds_of(const std::function<void()>& work) {
  const std::clock_t start = std::clock();
  work();
  return static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
}

class Chain : public testing::TestWithParam<int> {};
INSTANTIATE_TEST_SUITE_P(Links, Chain, testing::Values(5, 10, 20),
                         [](const auto& instance) { return fmt::format("{}", instance.param); });

TEST_P(Chain, IsCheckedGeneratedFittedPredictedAndSimulated) {
  const int n_links = GetParam();
  Model model;
  const auto step = [&](const char* name, const std::function<void()>& work) {
    RecordProperty(name, fmt::format("{:.3g} s", seconds_of(work)));
  };
  step("read", [&] { model = Model::parse(test::chain_of_links(n_links), "a chain"); });
  const System& system = *model.system;
  const Index n = system.nq();
  ASSERT_EQ(n, 3 * n_links);
  ASSERT_EQ(system.nc(), 2 * n_links);

  GeneratedData data;
  step("generate", [&] { data = generate(model, {100, chain_seed, VectorXd::Constant(n, 0.05)}); });
  std::vector<Finding> findings;
  step("check", [&] {
    findings = check_system(system, data.states, system.parameter_values());
    const std::vector<Finding> of_data =
        check_data(system, data.states, system.parameter_values(), true_acceleration(model, data.states),
                   MatrixXd::Constant(n, data.states.cols(), 0.05));
    findings.insert(findings.end(), of_data.begin(), of_data.end());
  });
  for (const Finding& finding : findings) {
    // a log of computed accelerations has n − m independent columns, which it should say
    if (finding.text.find("dependent columns") != std::string::npos) continue;
    EXPECT_EQ(finding.level, Finding::Level::good) << finding.text;
  }

  MechanicsBatch mechanics;
  step("mechanics", [&] { mechanics = require_mechanics(system, data.states, system.parameter_values()); });
  double of_laws = 0;
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    const MatrixXd A = mechanics.values.A(i), M = mechanics.values.M(i);
    const MatrixXd& T = projection.T();
    EXPECT_EQ(projection.rank(), 2 * n_links);
    of_laws = std::max({of_laws, test::largest(A * T) / (1 + test::largest(T)), test::largest(T * T - T) / (1 + test::largest(T)),
                        test::largest(M * T - T.transpose() * M) / (test::largest(M) * (1 + test::largest(T)))});
  }
  // masses and moments of inertia differ by (n/links)²·12; entries of T are as large as their ratio's root
  EXPECT_LE(of_laws, 64 * eps * static_cast<double>(n) * 12 * n_links * n_links);

  const CsvTable log = as_table(data, system, "log");
  FitProblem problem;
  step("problem", [&] { problem = make_fit_problem(model, log, {}); });
  FitOptions options;
  options.n_restarts = 1;
  options.max_iterations = 5;
  options.max_escapes = 0;
  options.n_threads = 1;
  std::optional<Fit> fitted;
  step("fit", [&] { fitted = fit(problem, options); });
  EXPECT_EQ(fitted->posterior.reduced_size(), 100 * n_links);
  const double evaluations = fitted->report.restarts.front().evaluations;
  RecordProperty("evaluations", fmt::format("{}", evaluations));

  const MatrixXd queries = test::draw(model, 20, chain_seed + 1).states;
  const View ddq = View::all(View::Quantity::constrained_acceleration, system);
  Posterior::Marginal marginal;
  step("predict", [&] { marginal = fitted->posterior.marginal(ddq, queries); });
  const SystemValues at_queries = system.evaluate(queries, system.parameter_values());
  double worst = 0;
  for (int i = 0; i < 20; ++i) {
    const VectorXd residual = at_queries.A(i) * marginal.mean.col(i) - at_queries.b(i);
    worst = std::max(worst, test::largest(residual) / (1 + test::largest(marginal.mean.col(i)) * test::largest(at_queries.A(i))));
  }
  EXPECT_LE(worst, 64 * eps * static_cast<double>(n));
  // better than knowing nothing but the constraints and gravity
  const MatrixXd truth = true_acceleration(model, queries);
  RecordProperty("error", fmt::format("{:.3g} of {:.3g}", (marginal.mean - truth).norm(), truth.norm()));
  EXPECT_LT((marginal.mean - truth).norm(), truth.norm());

  SimulateOptions run;
  run.times = VectorXd::LinSpaced(11, 0, 1);
  Trajectory motion;
  step("simulate the model",
       [&] { motion = simulate(system, system.parameter_values(), model_acceleration(model), queries.col(0), run); });
  EXPECT_LE(motion.max_position_drift, 1e-12);
  EXPECT_LE(motion.max_velocity_drift, 1e-10);
  RecordProperty(
      "drift", fmt::format("{:.2g} m, {:.2g} m/s, {} steps", motion.max_position_drift, motion.max_velocity_drift, motion.steps));
  step("simulate the fit", [&] {
    const Acceleration learned = [&](const auto& state) -> VectorXd { return fitted->posterior.mean(ddq, state); };
    motion = simulate(system, system.parameter_values(), learned, queries.col(0), run);
  });
  EXPECT_LE(motion.max_position_drift, 1e-12);
  RecordProperty("learned drift", fmt::format("{:.2g} m, {:.2g} m/s, {} steps", motion.max_position_drift,
                                              motion.max_velocity_drift, motion.steps));
}

// Twice the links: 8 times the work per state, for the products of n × n matrices, and no more.
TEST(ChainTest, TheWorkPerStateGrowsAsTheCubeOfTheLinks) {
  std::vector<double> seconds;
  for (const int n_links : {5, 10, 20}) {
    const Model model = Model::parse(test::chain_of_links(n_links), "a chain");
    const MatrixXd states = test::draw(model, 20, chain_seed).states;
    MechanicsBatch batch;
    // a clock that ticks in microseconds
    double best = 1e9;
    for (int repeat = 0; repeat < 10; ++repeat) {
      best =
          std::min(best, seconds_of([&] { evaluate_mechanics(*model.system, states, model.system->parameter_values(), batch); }));
    }
    seconds.push_back(best / 20);
    RecordProperty(fmt::format("mechanics_{}", n_links), fmt::format("{:.3g} µs a state", 1e6 * seconds.back()));
  }
  // generous, since caches are shared with other programs
  EXPECT_LT(seconds[2] / seconds[1], 8 * 3);
  EXPECT_LT(seconds[1] / seconds[0], 8 * 3);
}

}  // namespace
}  // namespace gp2
