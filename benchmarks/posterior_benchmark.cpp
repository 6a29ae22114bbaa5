// Predictions of a posterior, and posteriors that grow (posterior.hpp), on the surface model. One thread but where a row says
// otherwise.

#include <benchmark/benchmark.h>
#include <Eigen/Core>

#include "base/lapack.hpp"
#include "gp2/fit.hpp"
#include "gp2/posterior.hpp"
#include "gp2/simulation/generate.hpp"

namespace {

constexpr int n_states = 6075;

// The surface with N observations, at hyperparameters where all of them matter; two numbers remain of each. With or without the
// latent for what the model leaves out that `gp2 fit` adds by default.
struct Problem {
  gp2::Model model = gp2::Model::read(GP2_SOURCE_DIR "/models/surface.toml");
  gp2::Prior prior;
  std::vector<gp2::Observations> observations;
  gp2::ModelValues values;
  gp2::View ddq = gp2::View::all(gp2::View::Quantity::constrained_acceleration, *model.system);
  Eigen::MatrixXd states = gp2::generate(model, {n_states, 2, Eigen::VectorXd::Zero(3)}).states;

  explicit Problem(int n, bool discrepancy = false) {
    prior = gp2::make_prior(model);
    const gp2::GeneratedData data = gp2::generate(model, {n, 1, Eigen::VectorXd::Constant(3, 0.1)});
    observations.push_back({data.states, ddq, data.accelerations, Eigen::VectorXd::Constant(3, 0.1), false});
    if (discrepancy) {
      using Standard = gp2::Protocol::Standard;
      const gp2::Scales scales = gp2::default_scales(prior, observations);
      gp2::PriorOptions options;
      options.discrepancy = {Standard::discrepancy_lengthscale * scales.feature_stddev[0],
                             Eigen::VectorXd::Constant(3, Standard::discrepancy_median * 0.1)};
      prior = gp2::make_prior(model, options);
    }
    values = gp2::model_values(prior, observations, gp2::default_hyperparameters(prior, observations, {}, {}));
  }
  [[nodiscard]] gp2::Posterior posterior() const { return {prior, observations, values}; }
  [[nodiscard]] gp2::Observations one(int column) const {
    const gp2::Observations& all = observations[0];
    return {all.states().col(column), ddq, all.values().col(column), values.noise_stddev[0], false};
  }
};

void mean(benchmark::State& state, bool discrepancy) {
  const gp2::lapack::SingleThread single_thread;
  const Problem problem(static_cast<int>(state.range(0)), discrepancy);
  const gp2::Posterior posterior = problem.posterior();
  for (auto _ : state) benchmark::DoNotOptimize(posterior.mean(problem.ddq, problem.states, static_cast<int>(state.range(1))));
}
void mean_at_6075_states(benchmark::State& state) { mean(state, false); }
void mean_at_6075_states_two_latents(benchmark::State& state) { mean(state, true); }

void marginal_at_6075_states(benchmark::State& state) {
  const gp2::lapack::SingleThread single_thread;
  const Problem problem(static_cast<int>(state.range(0)));
  const gp2::Posterior posterior = problem.posterior();
  for (auto _ : state) {
    benchmark::DoNotOptimize(posterior.marginal(problem.ddq, problem.states, static_cast<int>(state.range(1))));
  }
}

// K̃ + I = L Lᵀ, β from nothing
void recompute(benchmark::State& state) {
  const gp2::lapack::SingleThread single_thread;
  const Problem problem(static_cast<int>(state.range(0)));
  for (auto _ : state) benchmark::DoNotOptimize(problem.posterior());
}

// The same by a new row of L. The oldest observation goes while the clock stands, so that there are always N.
void update_one(benchmark::State& state) {
  const gp2::lapack::SingleThread single_thread;
  const int n = static_cast<int>(state.range(0));
  const Problem problem(n);
  gp2::Posterior posterior = problem.posterior();
  int oldest = 0;
  for (auto _ : state) {
    state.PauseTiming();
    posterior = remove_oldest(std::move(posterior), 1);
    const gp2::Observations added = problem.one(oldest++ % n);
    state.ResumeTiming();
    posterior = update(std::move(posterior), added);
  }
}

// … and by rotations.
void remove_one(benchmark::State& state) {
  const gp2::lapack::SingleThread single_thread;
  const int n = static_cast<int>(state.range(0));
  const Problem problem(n);
  gp2::Posterior posterior = problem.posterior();
  int oldest = 0;
  for (auto _ : state) {
    posterior = remove_oldest(std::move(posterior), 1);
    state.PauseTiming();
    posterior = update(std::move(posterior), problem.one(oldest++ % n));
    state.ResumeTiming();
  }
}

const std::vector<std::int64_t> sizes = {100, 1000};

BENCHMARK(mean_at_6075_states)
    ->ArgsProduct({sizes, {1, 2}})
    ->ArgNames({"N", "threads"})
    ->UseRealTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(mean_at_6075_states_two_latents)
    ->ArgsProduct({sizes, {1, 2}})
    ->ArgNames({"N", "threads"})
    ->UseRealTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(marginal_at_6075_states)
    ->ArgsProduct({sizes, {1, 2}})
    ->ArgNames({"N", "threads"})
    ->UseRealTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(recompute)->ArgsProduct({sizes})->ArgName("N")->UseRealTime()->Unit(benchmark::kMillisecond);
BENCHMARK(update_one)->ArgsProduct({sizes})->ArgName("N")->UseRealTime()->Unit(benchmark::kMillisecond);
BENCHMARK(remove_one)->ArgsProduct({sizes})->ArgName("N")->UseRealTime()->Unit(benchmark::kMillisecond);

}  // namespace

BENCHMARK_MAIN();
