#include "gp2/jobs/fit_time.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "training/objective.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr int timed_size = 2048;  // of the reduced size, from which on OpenBLAS uses threads (DenseGram)
constexpr double worth_telling = 10;

double seconds_of(const auto& work) {
  const auto start = std::chrono::steady_clock::now();
  work();
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// The factor and the inverse of a matrix of the timed size.
double cubic_seconds(int n_threads) {
  const lapack::ManyThreads many_threads(n_threads);
  MatrixXd K = MatrixXd::Constant(timed_size, timed_size, 0.5);
  K.diagonal().array() += timed_size;
  return seconds_of([&] {
    lapack::factorise(K);
    lapack::invert_factored(K);
  });
}

std::string about(double seconds) {
  if (seconds < 100) return fmt::format("{:.0f} s", seconds);
  if (seconds < 6000) return fmt::format("{:.0f} min", seconds / 60);
  return fmt::format("{:.0f} h", seconds / 3600);
}

}  // namespace

double evaluation_seconds(const FitProblem& problem, const FitOptions& options, int reduced_size) {
  const lapack::SingleThread single_thread;
  // a run alone has all threads, runs side by side have one each
  const int n_threads = options.n_restarts == 1 ? thread_count(options.n_threads) : 1;
  const double cubic = cubic_seconds(n_threads);
  const double scale = static_cast<double>(reduced_size) / timed_size;
  const std::vector<Observations> some =
      evenly(problem.observations, static_cast<int>(std::lround(n_states(problem.observations) / scale)));
  const Objective objective(problem.prior, some, problem.hyperparameters);
  Likelihood::Workspace workspace(n_threads);
  VectorXd gradient(static_cast<Index>(problem.hyperparameters.size()));
  const double all = seconds_of([&] { objective(coordinates(problem.hyperparameters), &gradient, workspace); });
  // the outputs of the baseline se are fitted one after the other, and its matrix is made of one block for each
  const std::optional<Baseline>& baseline = problem.prior_options.baseline;
  const double n_parts = baseline && baseline->kind == Baseline::Kind::se ? problem.prior.system->nq() : 1;
  return cubic * std::pow(scale / n_parts, 3) + std::max(0.0, all - cubic) * std::pow(scale / n_parts, 2);
}

void note_time(double seconds, int reduced_size, std::vector<std::string>& notes, bool takes_points) {
  if (!(seconds > worth_telling)) return;
  notes.push_back(fmt::format(
      "one evaluation of the likelihood factors a matrix of size {} and takes about {} here, and a fit takes hundreds: "
      "it can be interrupted at any time; fewer rows (`max_points`) take less, with the cube of their number{}",
      reduced_size, about(seconds), takes_points ? ", and inducing points (`inducing=M`) in proportion to it" : ""));
}

void note_time(const FitProblem& problem, const FitOptions& options, int reduced_size, std::vector<std::string>& notes) {
  // one of twice the timed size takes eight times as long as the piece
  if (reduced_size < 2 * timed_size || options.n_inducing > 0 || has_sums(problem.observations)) return;
  const bool takes_points = !problem.prior_options.baseline;
  note_time(evaluation_seconds(problem, options, reduced_size), reduced_size, notes, takes_points);
}

}  // namespace gp2
