#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/training/hyperparameter.hpp"

namespace gp2 {

/// −log of the hyper-priors at the hyperparameters' own values, and its derivative in their coordinates added to `gradient`.
double negative_log_hyperpriors(const std::vector<Hyperparameter>& hyperparameters, Eigen::VectorXd* gradient);

/// What stands in for the exact likelihood.
struct Approximation {
  std::shared_ptr<const InducingPoints> points = nullptr;  // null: exact
  std::shared_ptr<const Linearisation> about = nullptr;    // of a nonlinear prior; null: where no latent acts
};

/// Exact, and of a nonlinear prior about the posterior mean of its latents.
/// @throws NumericalError where there is none.
Approximation about_posterior_mean(const Prior& prior, const std::vector<Observations>& observations,
                                   const std::vector<Hyperparameter>& hyperparameters);

/// What training minimises: the negative log likelihood plus hyper-priors. Thread-safe.
class Objective {
 public:
  /// @param prior, observations  outlive it
  /// @param workers  as Likelihood::Options
  Objective(const Prior& prior, const std::vector<Observations>& observations, const std::vector<Hyperparameter>& hyperparameters,
            Approximation approximation = {}, const Workers& workers = {});

  /// @param x         the hyperparameters' coordinates
  /// @param gradient  in x, of the size of x; not computed when null; left as it was when the value is +∞
  double operator()(const Eigen::VectorXd& x, Eigen::VectorXd* gradient, Likelihood::Workspace& workspace) const;

  [[nodiscard]] const std::vector<Hyperparameter>& hyperparameters() const { return hyperparameters_; }
  /// The hyperparameters at x.
  [[nodiscard]] std::vector<Hyperparameter> at(const Eigen::VectorXd& x) const;

 private:
  [[nodiscard]] ModelValues values(const std::vector<Hyperparameter>& hyperparameters) const;

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  std::vector<Hyperparameter> hyperparameters_;
  Approximation approximation_;
  Likelihood likelihood_;
};

/// The threads and processes that evaluate an objective. Several exact evaluations go on at a time, each on one process;
/// through inducing points all processes work on one evaluation. Results do not depend on it.
struct Evaluators {
  Workers side_by_side;  // on so many evaluations at a time
  Workers alone;         // on one that no other goes on beside

  Evaluators(int n_threads = 1) : side_by_side(n_threads), alone(n_threads) {}
  Evaluators(const FitOptions& options, bool through_points);
  /// On each of several.
  [[nodiscard]] Workers within() const { return alone.ranks ? alone : Workers(1); }
};

/// A text, from who works on a part to all.
void share(std::string& text, const Workers& workers, int part, int n_parts);

/// work(task, its numbers) for every task, by whoever works on it; then all have all numbers, as many of each task, one task after
/// the other. Of tasks that fail the first says why, to all.
/// @throws NumericalError as work
template <typename Work>
void share_out(std::span<double> numbers, int n_tasks, const Workers& workers, const Work& work) {
  const std::size_t size = n_tasks > 0 ? numbers.size() / static_cast<std::size_t>(n_tasks) : 0;
  const auto of = [&](int task) { return numbers.subspan(static_cast<std::size_t>(task) * size, size); };
  std::vector<std::string> faults(static_cast<std::size_t>(n_tasks));
  parallel_for(n_tasks, workers.n_threads, [&](int task, int) {
    if (!workers.owns(task, n_tasks)) return;
    try {
      work(task, of(task));
    } catch (const NumericalError& error) {
      faults[static_cast<std::size_t>(task)] = error.what();
    }
  });
  for (int task = 0; task < n_tasks; ++task) {
    workers.share(of(task), task, n_tasks);
    share(faults[static_cast<std::size_t>(task)], workers, task, n_tasks);
  }
  for (const std::string& fault : faults) {
    if (!fault.empty()) throw NumericalError(fault);
  }
}

/// x: where hyperparameters stand, in their coordinates.
Eigen::VectorXd coordinates(const std::vector<Hyperparameter>& hyperparameters);

/// The bounds of x.
struct CoordinateBox {
  Eigen::VectorXd lower, upper;
  explicit CoordinateBox(const std::vector<Hyperparameter>& hyperparameters);
};

}  // namespace gp2
