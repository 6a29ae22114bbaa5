// LAPACK's dpotrf with the kernel that OPENBLAS_CORETYPE names or, where it is not set, that the command gp2 chooses. Compare
// kernels with benchmarks/blas_settings.

#include <cmath>

#include <benchmark/benchmark.h>
#include <Eigen/Core>

#include "base/lapack.hpp"
#include "blas_choice.hpp"
#include "gp2/base/blas.hpp"

namespace {

// K = L Lᵀ (n × n), which takes n³/3 multiplications and as many additions, less by O(n²)
void dpotrf(benchmark::State& state) {
  const Eigen::Index n = state.range(0);
  const int size = static_cast<int>(n);
  Eigen::MatrixXd K = 0.5 * Eigen::MatrixXd::Random(n, n);  // strictly diagonally dominant with what follows
  K.diagonal().setConstant(static_cast<double>(n));
  Eigen::MatrixXd work = K;
  for (auto _ : state) {
    state.PauseTiming();
    work = K;
    state.ResumeTiming();
    int info = 0;
    dpotrf_("L", &size, work.data(), &size, &info, 1);
    if (info != 0) state.SkipWithError("not positive definite");
    benchmark::DoNotOptimize(work.data());
  }
  state.counters["GFLOP/s"] =
      benchmark::Counter(std::pow(static_cast<double>(n), 3) / 3e9, benchmark::Counter::kIsIterationInvariantRate);
}

BENCHMARK(dpotrf)->Arg(200)->Arg(600)->Arg(2000)->Arg(3000)->Arg(6000)->UseRealTime()->Unit(benchmark::kMillisecond);

}  // namespace

int main(int argc, char** argv) {
  gp2::command::choose_blas_kernel(argv);
  const gp2::BlasReport blas = gp2::blas_report();
  benchmark::AddCustomContext("BLAS", blas.library + ", kernel " + blas.kernel + ", chosen by " +
                                          gp2::command::blas_kernel_chosen_by() + ", threads " + std::to_string(blas.n_threads));
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
}
