// The negative log likelihood and its gradient (likelihood.hpp) beside their lower limit: LAPACK's dpotrf + dpotri of the same
// reduced matrix. One thread. Read the ratio of the two rows of one N, in one run.

#include <benchmark/benchmark.h>
#include <Eigen/Core>

#include "gp2/generate.hpp"
#include "gp2/training.hpp"
#include "inference/lapack.hpp"

namespace {

// the surface model with N observations; nq − nc = 2 numbers remain of each
struct Problem {
  gp2::ModelFile model = gp2::ModelFile::read(GP2_SOURCE_DIR "/models/surface.toml");
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

void likelihood_and_gradient(benchmark::State& state, const std::vector<std::string>& estimated, bool estimate_noise) {
  const gp2::lapack::SingleThread single_thread;
  const Problem problem(static_cast<int>(state.range(0)), estimated, estimate_noise);
  gp2::Likelihood::Options options;
  options.noise_gradient = estimate_noise;
  for (const std::string& name : estimated) options.gradient_parameters.push_back(problem.model.system->parameter_index(name));
  const gp2::ModelValues values = gp2::model_values(problem.prior, problem.observations, problem.hyperparameters);
  const gp2::Likelihood likelihood(problem.prior, problem.observations, values, options);
  gp2::Likelihood::Workspace workspace;
  gp2::ModelValues gradient;
  for (auto _ : state) benchmark::DoNotOptimize(likelihood.evaluate(values, &gradient, workspace));
}

void known_parameters(benchmark::State& state) { likelihood_and_gradient(state, {}, false); }
void estimated_noise(benchmark::State& state) { likelihood_and_gradient(state, {}, true); }
void estimated_parameters(benchmark::State& state) { likelihood_and_gradient(state, {"p1", "p2", "p3", "p4", "p5"}, false); }

// the limit: K̃ + I = L Lᵀ and its inverse
void dpotrf_dpotri(benchmark::State& state) {
  const gp2::lapack::SingleThread single_thread;
  const Eigen::Index size = 2 * state.range(0);
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
    gp2::lapack::invert_factored(work);
    benchmark::DoNotOptimize(work.data());
  }
}

BENCHMARK(dpotrf_dpotri)->Arg(100)->Arg(300)->Arg(1000)->Unit(benchmark::kMillisecond);
BENCHMARK(known_parameters)->Arg(100)->Arg(300)->Arg(1000)->Unit(benchmark::kMillisecond);
BENCHMARK(estimated_noise)->Arg(100)->Unit(benchmark::kMillisecond);
BENCHMARK(estimated_parameters)->Arg(100)->Unit(benchmark::kMillisecond);

}  // namespace

BENCHMARK_MAIN();
