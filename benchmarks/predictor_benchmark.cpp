// One state at a time, as a control loop asks (predictor.hpp), on the surface model. One thread.
//
// Each of 1e5 calls is timed by itself, at some 20 ns for the clock: beside the mean stand their median, in nanoseconds, and the
// 99th percentile as a multiple of it.

#include <algorithm>
#include <chrono>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <benchmark/benchmark.h>
#include <Eigen/Core>

#include "gp2/fit.hpp"
#include "gp2/inference/inducing.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulation/generate.hpp"

namespace {

using gp2::Predictor;

enum class Call { mean, stddev, jacobian };

struct Setup {
  gp2::Model model = gp2::Model::read(GP2_SOURCE_DIR "/models/surface.toml");
  Eigen::MatrixXd states = gp2::generate(model, {1000, 2, Eigen::VectorXd::Zero(3)}).states;
  Eigen::VectorXd mean = Eigen::VectorXd::Zero(3), stddev = mean;
  Eigen::MatrixXd jacobian = Eigen::MatrixXd::Zero(3, states.rows());
  Eigen::Index next = 0;

  // The surface with N observations, at hyperparameters where all of them matter; with or without the latent for what the model
  // leaves out that `gp2 fit` adds by default; through at most so many inducing variables, where 0 is exact.
  [[nodiscard]] gp2::Posterior posterior(int n, bool discrepancy, int n_inducing = 0) const {
    const gp2::View ddq = gp2::View::all(gp2::View::Quantity::constrained_acceleration, *model.system);
    const gp2::GeneratedData data = gp2::generate(model, {n, 1, Eigen::VectorXd::Constant(3, 0.1)});
    const std::vector<gp2::Observations> observations{
        {data.states, ddq, data.accelerations, Eigen::VectorXd::Constant(3, 0.1), false}};
    gp2::Prior prior = gp2::make_prior(model);
    if (discrepancy) {
      using Standard = gp2::Protocol::Standard;
      const gp2::Scales scales = gp2::default_scales(prior, observations);
      gp2::PriorOptions options;
      options.discrepancy = {Standard::discrepancy_lengthscale * scales.feature_stddev[0],
                             Eigen::VectorXd::Constant(3, Standard::discrepancy_median * 0.1)};
      prior = gp2::make_prior(model, options);
    }
    gp2::ModelValues values = gp2::model_values(prior, observations, gp2::default_hyperparameters(prior, observations, {}, {}));
    if (n_inducing > 0) {
      values.inducing = gp2::choose_inducing_points(prior, observations, values, {.most = n_inducing, .left_out = 1e-9}).points;
    }
    return {prior, observations, values};
  }

  void call(Call what, const Predictor& predictor, Predictor::Workspace& workspace) {
    const auto state = states.col(next++ % states.cols());
    Predictor::Status status = Predictor::Status::ok;
    switch (what) {
      case Call::mean:
        status = predictor.mean(state, mean, workspace);
        break;
      case Call::stddev:
        status = predictor.mean_and_stddev(state, mean, stddev, workspace);
        break;
      case Call::jacobian:
        status = predictor.mean_and_jacobian(state, mean, jacobian, workspace);
        break;
    }
    benchmark::DoNotOptimize(status);
    benchmark::DoNotOptimize(mean.data());
    benchmark::ClobberMemory();
  }
};

// each call by itself
void time_calls(benchmark::State& state, const std::function<void()>& call) {
  std::vector<double> nanoseconds;
  nanoseconds.reserve(static_cast<std::size_t>(state.max_iterations));
  for (int warm_up = 0; warm_up < 1000; ++warm_up) call();
  for (auto _ : state) {
    const auto start = std::chrono::steady_clock::now();
    call();
    const std::chrono::duration<double> time = std::chrono::steady_clock::now() - start;
    state.SetIterationTime(time.count());
    nanoseconds.push_back(1e9 * time.count());
  }
  std::sort(nanoseconds.begin(), nanoseconds.end());
  const double median = nanoseconds[nanoseconds.size() / 2];
  state.counters["median_ns"] = median;
  state.counters["p99/median"] = nanoseconds[nanoseconds.size() * 99 / 100] / median;
}

void predict(benchmark::State& state, Setup& setup, const gp2::Posterior& posterior, Call what, Predictor::Storage storage) {
  const Predictor predictor(posterior, gp2::View::all(gp2::View::Quantity::constrained_acceleration, *posterior.prior().system),
                            {.stddev = what == Call::stddev, .jacobian = what == Call::jacobian, .storage = storage});
  Predictor::Workspace workspace = predictor.make_workspace();
  time_calls(state, [&] { setup.call(what, predictor, workspace); });
}

// the torques, from 0 on, that produce the accelerations of an arm on its constraint, where the known force is the prior mean
void inverse_dynamics(benchmark::State& state, const char* file, bool covariance) {
  const gp2::Model model = gp2::Model::read(std::string(GP2_SOURCE_DIR) + file);
  const gp2::Prior prior = gp2::make_prior(model, {gp2::Prior::Mean::force, std::nullopt});
  const gp2::View view = gp2::View::constrained_acceleration(*model.system);
  const Eigen::VectorXd noise = Eigen::VectorXd::Constant(view.size(), 0.1);
  const gp2::GeneratedData data = gp2::generate(model, {static_cast<int>(state.range(0)), 1, noise});
  const std::vector<gp2::Observations> observations{{data.states, view, data.accelerations, noise, false}};
  const gp2::Posterior posterior(
      prior, observations, gp2::model_values(prior, observations, gp2::default_hyperparameters(prior, observations, {}, {})));

  const int nu = model.system->layout().nu;
  Eigen::MatrixXd states = gp2::generate(model, {200, 2, 0 * noise}).states;
  const Eigen::MatrixXd wanted = posterior.mean(view, states);
  states.bottomRows(nu).setZero();
  const gp2::InverseDynamicsSolver solver(posterior, view, {.covariance = covariance});
  gp2::InverseDynamicsSolver::Workspace workspace = solver.make_workspace();
  Eigen::VectorXd inputs(nu);
  Eigen::MatrixXd of_inputs(nu, nu);
  Eigen::Index next = 0;
  int n_missing = 0;
  time_calls(state, [&] {
    const Eigen::Index i = next++ % states.cols();
    const auto status = covariance ? solver.inputs_and_covariance(states.col(i), wanted.col(i), inputs, of_inputs, workspace)
                                   : solver.inputs(states.col(i), wanted.col(i), inputs, workspace);
    n_missing += status == gp2::InverseDynamicsSolver::Status::ok ? 0 : 1;
    benchmark::ClobberMemory();
  });
  if (n_missing > 0) state.SkipWithError("no inputs were found");
}

void predict(benchmark::State& state, Call what, bool discrepancy, Predictor::Storage storage) {
  Setup setup;
  predict(state, setup, setup.posterior(static_cast<int>(state.range(0)), discrepancy), what, storage);
}

// of many rows, through inducing variables
void predict_through_points(benchmark::State& state, Call what) {
  Setup setup;
  const int n = static_cast<int>(state.range(0)), n_inducing = static_cast<int>(state.range(1));
  predict(state, setup, setup.posterior(n, false, n_inducing), what, Predictor::Storage::double_precision);
}

constexpr auto in_double = Predictor::Storage::double_precision, in_single = Predictor::Storage::single_precision;

void arguments(benchmark::internal::Benchmark* rows) { rows->Arg(100)->Arg(1000)->UseManualTime()->Iterations(100'000); }

BENCHMARK_CAPTURE(predict, mean, Call::mean, false, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_stddev, Call::stddev, false, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_jacobian, Call::jacobian, false, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_two_latents, Call::mean, true, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_stddev_two_latents, Call::stddev, true, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_jacobian_two_latents, Call::jacobian, true, in_double)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_single, Call::mean, false, in_single)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_stddev_single, Call::stddev, false, in_single)->Apply(arguments);
BENCHMARK_CAPTURE(predict, mean_and_jacobian_single, Call::jacobian, false, in_single)->Apply(arguments);

void few_arguments(benchmark::internal::Benchmark* rows) { rows->Arg(100)->UseManualTime()->Iterations(10'000); }

constexpr const char* two_links = "/models/arm_on_moving_plane.toml";
constexpr const char* seven_joints = "/experiments/arm_on_surface/arm.toml";
BENCHMARK_CAPTURE(inverse_dynamics, two_links, two_links, false)->Apply(few_arguments);
BENCHMARK_CAPTURE(inverse_dynamics, two_links_with_covariance, two_links, true)->Apply(few_arguments);
BENCHMARK_CAPTURE(inverse_dynamics, seven_joints, seven_joints, false)->Apply(few_arguments);
BENCHMARK_CAPTURE(inverse_dynamics, seven_joints_with_covariance, seven_joints, true)->Apply(few_arguments);

void arguments_through_points(benchmark::internal::Benchmark* rows) {
  for (const int n_inducing : {300, 999}) rows->Args({1'000'000, n_inducing})->UseManualTime()->Iterations(100'000);
}

BENCHMARK_CAPTURE(predict_through_points, mean, Call::mean)->Apply(arguments_through_points);
BENCHMARK_CAPTURE(predict_through_points, mean_and_stddev, Call::stddev)->Apply(arguments_through_points);

}  // namespace

BENCHMARK_MAIN();
