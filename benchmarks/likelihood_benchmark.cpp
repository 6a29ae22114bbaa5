// The negative log likelihood and its gradient (likelihood.hpp) beside what factoring and inverting the same reduced matrix
// costs: by LAPACK's dpotrf + dpotri, and by ours. Read the ratio of two rows of one N, in one run.

#include <fstream>
#include <string>
#include <thread>

#include <benchmark/benchmark.h>
#include <Eigen/Core>

#include "base/lapack.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/inducing.hpp"
#include "gp2/simulation/generate.hpp"
#include "inference/assemble.hpp"

namespace {

// the largest resident memory of the process since reset_peak()
double peak_megabytes() {
  std::ifstream status("/proc/self/status");
  std::string word;
  while (status >> word && word != "VmHWM:") {
  }
  double kibibytes = 0;
  status >> kibibytes;
  return kibibytes * 1024 / 1e6;
}
void reset_peak() { std::ofstream("/proc/self/clear_refs") << 5; }

// the surface model with N observations; nq − nc = 2 numbers remain of each
struct Problem {
  gp2::Model model = gp2::Model::read(GP2_SOURCE_DIR "/models/surface.toml");
  gp2::Prior prior;
  std::vector<gp2::Observations> observations;
  std::vector<gp2::Hyperparameter> hyperparameters;

  Problem(int n, const std::vector<std::string>& estimated, bool estimate_noise) {
    prior = gp2::make_prior(model);
    const gp2::GeneratedData data = gp2::generate(model, {n, 1, Eigen::VectorXd::Constant(3, 0.1)});
    observations.push_back({data.states, gp2::View::all(gp2::View::Quantity::constrained_acceleration, *model.system),
                            data.accelerations, Eigen::VectorXd::Constant(3, 0.1), estimate_noise});
    hyperparameters = gp2::default_hyperparameters(prior, observations, estimated, {});
  }
};

void likelihood_and_gradient(benchmark::State& state, const std::vector<std::string>& estimated, bool estimate_noise,
                             int n_threads = 1, int n_inducing = 0) {
  const gp2::lapack::SingleThread single_thread;
  const Problem problem(static_cast<int>(state.range(0)), estimated, estimate_noise);
  gp2::Likelihood::Options options;
  options.noise_gradient = estimate_noise;
  for (const std::string& name : estimated) options.gradient_parameters.push_back(problem.model.system->parameter_index(name));
  gp2::ModelValues values = gp2::model_values(problem.prior, problem.observations, problem.hyperparameters);
  const gp2::Likelihood likelihood(problem.prior, problem.observations, values, options);
  if (n_inducing > 0) {
    values.inducing =
        gp2::choose_inducing_points(problem.prior, problem.observations, values, {.most = n_inducing, .left_out = 1e-9}).points;
  }
  gp2::Likelihood::Workspace workspace(n_threads);
  gp2::ModelGradient gradient;
  for (auto _ : state) benchmark::DoNotOptimize(likelihood.evaluate(values, &gradient, workspace));
}

void known_parameters(benchmark::State& state) { likelihood_and_gradient(state, {}, false); }
void known_parameters_two_threads(benchmark::State& state) { likelihood_and_gradient(state, {}, false, 2); }
void estimated_noise(benchmark::State& state) { likelihood_and_gradient(state, {}, true); }
void estimated_parameters(benchmark::State& state) { likelihood_and_gradient(state, {"p1", "p2", "p3", "p4", "p5"}, false); }

// 200 inducing points of three functions; beside it the rate of the matrix products of which B and the gradient consist
void inducing_points(benchmark::State& state) {
  constexpr int n_points = 200, n_functions = 3;
  likelihood_and_gradient(state, {}, false, static_cast<int>(state.range(1)), n_functions * n_points);
  // of each pair of functions, and of one with itself, half a product for B and one for the gradient
  constexpr double n_products = 1.5 * n_functions * (n_functions + 1) / 2;
  state.counters["Gflop/s"] = benchmark::Counter(2e-9 * n_products * n_points * n_points * static_cast<double>(state.range(0)),
                                                 benchmark::Counter::kIsIterationInvariantRate);
}

// K̃ alone, on 1 or 2 threads
void assembly(benchmark::State& state) {
  const Problem problem(static_cast<int>(state.range(0)), {}, false);
  const gp2::ModelValues values = gp2::model_values(problem.prior, problem.observations, problem.hyperparameters);
  gp2::Reduction reduction;
  gp2::reduce(problem.prior, problem.observations,
              gp2::require_models(problem.prior, problem.observations, values.parameters, {}), values.noise_stddev, reduction);
  const gp2::LatentRows rows = gp2::latent_rows(problem.prior, problem.observations, reduction, values);
  Eigen::MatrixXd K(reduction.size(), reduction.size());
  for (auto _ : state) {
    gp2::assemble(rows, static_cast<int>(state.range(1)), K);
    benchmark::DoNotOptimize(K.data());
  }
}

// a fit of eight restarts side by side, stopped after 20 iterations each
void restarts(benchmark::State& state) {
  const Problem problem(static_cast<int>(state.range(0)), {}, false);
  gp2::FitOptions options;
  options.n_restarts = 8;
  options.max_iterations = 20;
  options.n_threads = static_cast<int>(state.range(1));
  for (auto _ : state) {
    benchmark::DoNotOptimize(gp2::fit(problem.prior, problem.observations, problem.hyperparameters, options).report.objective);
  }
}

// what assembly and gradient come on top of: K̃ + I = L Lᵀ and its inverse
void factor_and_inverse(benchmark::State& state, bool by_lapack, int n_threads) {
  const gp2::lapack::SingleThread single_thread;
  const gp2::lapack::ManyThreads many_threads(n_threads);
  const int size = 2 * static_cast<int>(state.range(0));
  const Eigen::MatrixXd points = Eigen::MatrixXd::Random(size, 9);
  Eigen::MatrixXd K(size, size);
  for (Eigen::Index j = 0; j < size; ++j) {
    K.col(j) = (-0.5 * (points.rowwise() - points.row(j)).rowwise().squaredNorm()).array().exp() * 700;
  }
  K.diagonal().array() += 1;
  Eigen::MatrixXd work = K;
  for (auto _ : state) {
    state.PauseTiming();
    work = K;
    state.ResumeTiming();
    gp2::lapack::factorise(work);
    if (by_lapack) {
      int info = 0;
      dpotri_("L", &size, work.data(), &size, &info, 1);
    } else {
      gp2::lapack::invert_factored(work);
    }
    benchmark::DoNotOptimize(work.data());
  }
}

void dpotrf_dpotri(benchmark::State& state) { factor_and_inverse(state, true, 1); }
void dpotrf_and_our_inverse(benchmark::State& state) { factor_and_inverse(state, false, 1); }

// the same from small to large, with the memory it takes beside that of the factored matrix: about half of it where half of its
// pages are never touched
void scaling(benchmark::State& state) {
  const int n_threads = static_cast<int>(state.range(1));
  reset_peak();
  const double before = peak_megabytes();
  likelihood_and_gradient(state, {}, false, n_threads);
  const double factored = 4.0 * static_cast<double>(state.range(0) * state.range(0)) * sizeof(double) / 1e6;
  state.counters["factored_MB"] = factored;
  state.counters["memory_ratio"] = (peak_megabytes() - before) / factored;
}

// one, two, and all cores where there are more
std::vector<int64_t> thread_counts() {
  const int64_t n = std::thread::hardware_concurrency();
  return n > 2 ? std::vector<int64_t>{1, 2, n} : std::vector<int64_t>{1, 2};
}

const std::vector<int64_t> sizes = {100, 300, 1000, 3000};

BENCHMARK(dpotrf_dpotri)->ArgsProduct({sizes})->Unit(benchmark::kMillisecond);
BENCHMARK(dpotrf_and_our_inverse)->ArgsProduct({sizes})->Unit(benchmark::kMillisecond);
BENCHMARK(known_parameters)->ArgsProduct({sizes})->Unit(benchmark::kMillisecond);
BENCHMARK(known_parameters_two_threads)->Arg(1000)->Arg(3000)->UseRealTime()->Unit(benchmark::kMillisecond);
BENCHMARK(estimated_noise)->ArgsProduct({sizes})->Unit(benchmark::kMillisecond);
BENCHMARK(estimated_parameters)->ArgsProduct({sizes})->Unit(benchmark::kMillisecond);
BENCHMARK(inducing_points)
    ->ArgsProduct({{256, 10'000, 100'000, 1'000'000}, thread_counts()})
    ->UseRealTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(assembly)->Args({1000, 1})->Args({1000, 2})->Args({3000, 1})->Args({3000, 2})->UseRealTime()->Unit(
    benchmark::kMillisecond);

BENCHMARK(restarts)->Args({300, 1})->Args({300, 2})->UseRealTime()->Unit(benchmark::kMillisecond);
BENCHMARK(scaling)->ArgsProduct({{100, 200, 500, 1000, 2000, 5000, 10000}, {1, 2}})->UseRealTime()->Unit(benchmark::kMillisecond);

}  // namespace

BENCHMARK_MAIN();
