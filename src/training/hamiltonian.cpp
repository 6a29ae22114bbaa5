#include "training/hamiltonian.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <mutex>
#include <numbers>
#include <span>

#include <Eigen/Eigenvalues>

#include "base/decompositions.hpp"
#include "base/parallel.hpp"
#include "base/random.hpp"
#include "gp2/error.hpp"
#include "training/curvature.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// The length of steps by dual averaging (Hoffman and Gelman 2014, sec. 3.2), towards this rate of acceptance.
class StepLength {
 public:
  [[nodiscard]] double now() const { return std::exp(log_length_); }
  void adapt(double probability) {
    constexpr double wanted = 0.8, gamma = 0.05, t0 = 10, kappa = 0.75;
    ++t_;
    const double t = t_;
    shortfall_ += (wanted - probability - shortfall_) / (t + t0);
    // about 1, the deviation along each direction of the metric
    log_length_ = std::clamp(-std::sqrt(t) / gamma * shortfall_, std::log(1e-4), std::log(1.5));
    log_mean_ += std::pow(t, -kappa) * (log_length_ - log_mean_);
  }
  void settle() {
    if (t_ > 0) log_length_ = log_mean_;
  }

 private:
  int t_ = 0;
  double shortfall_ = 0, log_length_ = std::log(0.25), log_mean_ = 0;
};

class Chain {
 public:
  Chain(const Objective& objective, const HamiltonianStart& start, const VectorXd& lower, const VectorXd& upper,
        RandomStream random, const Workers& workers, const std::atomic<bool>* stop)
      : objective_(objective),
        W_(start.W),
        lower_(lower),
        upper_(upper),
        random_(random),
        workspace_(workers, stop),
        x_(start.x),
        gradient_(VectorXd::Zero(x_.size())) {
    const std::vector<Hyperparameter>& all = objective.hyperparameters();
    for (std::size_t k = 0; k < all.size(); ++k) {
      if (all[k].hyperprior.form == HyperPrior::Form::log_normal && !all[k].map().is_logarithm)
        logarithms_.push_back({static_cast<Index>(k), all[k].map()});
    }
    J_ = energy(x_, gradient_);
  }

  static constexpr int longest = 25;  // leapfrog steps of one step

  /// @return the probability with which the step was accepted
  double step() {
    VectorXd p(x_.size());
    for (double& momentum : p) momentum = random_.normal();
    const double before = J_ + 0.5 * p.squaredNorm();
    // about a quarter of the period of a Gaussian
    const double way = (0.5 + random_.uniform()) * std::numbers::pi / 2;
    const double length = length_.now() * (0.9 + 0.2 * random_.uniform());
    const int n = std::clamp(static_cast<int>(std::ceil(way / length)), 1, longest);
    VectorXd x = x_, gradient = gradient_;
    double J = J_;
    constexpr double hopeless = 1000;
    for (int k = 0; k < n && J < before + hopeless; ++k) {
      p -= 0.5 * length * (W_.transpose() * gradient);
      const bool has_arrived = drift(length, x, p);
      J = has_arrived ? energy(x, gradient) : std::numeric_limits<double>::infinity();
      ++evaluations_;
      p -= 0.5 * length * (W_.transpose() * gradient);
    }
    const double probability = std::isfinite(J) ? std::min(1.0, std::exp(before - J - 0.5 * p.squaredNorm())) : 0;
    if (random_.uniform() < probability) {
      x_ = std::move(x);
      gradient_ = std::move(gradient);
      J_ = J;
    }
    return probability;
  }
  StepLength& length() { return length_; }

  [[nodiscard]] const VectorXd& x() const { return x_; }
  [[nodiscard]] double objective() const { return J_ - log_measure(x_); }
  [[nodiscard]] int evaluations() const { return evaluations_; }

 private:
  /// A value that is sampled itself, though its density is normal in its logarithm: that has 1/v in v.
  struct OfLogarithm {
    Index k;
    CoordinateMap map;
  };

  [[nodiscard]] double log_measure(const VectorXd& x) const {
    double sum = 0;
    for (const OfLogarithm& one : logarithms_) sum += std::log(one.map.value(x[one.k]));
    return sum;
  }

  /// −log of the density of x
  double energy(const VectorXd& x, VectorXd& gradient) {
    const double J = objective_(x, &gradient, workspace_);
    for (const OfLogarithm& one : logarithms_) gradient[one.k] += one.map.logarithm_slope(one.map.value(x[one.k]));
    return J + log_measure(x);
  }

  // x + t W p, mirrored in the metric at each wall of the box that is met; false where walls are met without end
  bool drift(double t, VectorXd& x, VectorXd& p) const {
    constexpr int most = 100;
    for (int bounce = 0; bounce < most; ++bounce) {
      const VectorXd v = W_ * p;
      Index wall = -1;
      double until = t;
      for (Index k = 0; k < x.size(); ++k) {
        if (v[k] == 0) continue;
        const double there = ((v[k] > 0 ? upper_[k] : lower_[k]) - x[k]) / v[k];
        if (there < until) {
          until = there;
          wall = k;
        }
      }
      x = (x + until * v).cwiseMax(lower_).cwiseMin(upper_);
      t -= until;
      if (wall < 0) return true;
      const VectorXd normal = W_.row(wall);
      p -= 2 * p.dot(normal) / normal.squaredNorm() * normal;
    }
    return false;
  }

  const Objective& objective_;
  const MatrixXd& W_;
  const VectorXd &lower_, &upper_;
  RandomStream random_;
  Likelihood::Workspace workspace_;
  std::vector<OfLogarithm> logarithms_;
  VectorXd x_, gradient_;
  double J_ = 0;
  StepLength length_;
  int evaluations_ = 1;
};

// each half of every chain (steps/2 × halves) of one coordinate
MatrixXd halves_of(const std::vector<MatrixXd>& chains, Index coordinate) {
  const Index n = chains.front().cols() / 2;
  MatrixXd halves(n, 2 * std::ssize(chains));
  for (std::size_t c = 0; c < chains.size(); ++c) {
    const auto row = chains[c].row(coordinate);
    halves.col(2 * static_cast<Index>(c)) = row.head(n).transpose();
    halves.col(2 * static_cast<Index>(c) + 1) = row.tail(n).transpose();
  }
  return halves;
}

struct Variances {
  double within = 0, total = 0;
  explicit Variances(const MatrixXd& halves) {
    const double n = static_cast<double>(halves.rows());
    const Eigen::RowVectorXd mean = halves.colwise().mean();
    within = (halves.rowwise() - mean).colwise().squaredNorm().mean() / (n - 1);
    const double between = (mean.array() - mean.mean()).square().sum() / static_cast<double>(halves.cols() - 1);
    total = (n - 1) / n * within + between;
  }
};

}  // namespace

VectorXd HamiltonianDraws::r_hat() const {
  VectorXd out = VectorXd::Ones(chains.front().rows());
  for (Index k = 0; k < out.size(); ++k) {
    const Variances variances(halves_of(chains, k));
    if (variances.within > 0) out[k] = std::max(1.0, std::sqrt(variances.total / variances.within));
  }
  return out;
}

VectorXd HamiltonianDraws::effective_size() const {
  const double n_draws = static_cast<double>(std::ssize(chains) * chains.front().cols());
  VectorXd out = VectorXd::Constant(chains.front().rows(), n_draws);
  for (Index k = 0; k < out.size(); ++k) {
    const MatrixXd halves = halves_of(chains, k);
    const Variances variances(halves);
    if (!(variances.total > 0)) continue;
    const auto correlation = [&](Index lag) {
      const Index n = halves.rows() - lag;
      const double variogram = (halves.bottomRows(n) - halves.topRows(n)).squaredNorm() / static_cast<double>(n * halves.cols());
      return 1 - variogram / (2 * variances.total);
    };
    // pairs of lags, until they are no longer positive (Geyer 1992); of lag 0 the half that is not the draw itself
    double sum = 0;
    for (Index lag = 0; lag + 1 < halves.rows(); lag += 2) {
      const double pair = (lag == 0 ? 1 : correlation(lag)) + correlation(lag + 1);
      if (!(pair > 0)) break;
      sum += pair;
    }
    out[k] = std::min(n_draws, n_draws / std::max(2 * sum - 1, 1e-3));
  }
  return out;
}

namespace {

// what progress(evaluations since) hears of
// @param out  how many steps are kept, the sum of their acceptances, the evaluations, and of each step x and the objective
template <typename Tell>
void run_chain(Chain& chain, int max_evaluations, const std::atomic<bool>* stop, const Tell& progress, std::span<double> out) {
  std::ranges::fill(out, 0.0);
  auto next = out.begin() + 3;
  bool adapting = true;
  while (chain.evaluations() + Chain::longest <= max_evaluations && !is_set(stop)) {
    const int before = chain.evaluations();
    if (adapting && before >= 3 * max_evaluations / 10) {
      adapting = false;
      chain.length().settle();
    }
    const double probability = chain.step();
    if (adapting) {
      chain.length().adapt(probability);
    } else {
      ++out[0];
      out[1] += probability;
      next = std::copy(chain.x().begin(), chain.x().end(), next);
      *next++ = chain.objective();
    }
    progress(chain.evaluations() - before);
  }
  out[2] = chain.evaluations();
}

}  // namespace

HamiltonianDraws draw_coordinates(const Objective& objective, const std::vector<HamiltonianStart>& starts, const VectorXd& lower,
                                  const VectorXd& upper, const HamiltonianOptions& options) {
  std::mutex mutex;
  double n_done = 0;
  const auto progress = [&](int evaluations) {
    const std::scoped_lock lock(mutex);
    n_done += evaluations;
    if (options.progress) options.progress(std::min(1.0, n_done / options.max_evaluations));
  };
  const int of_chain = options.max_evaluations / static_cast<int>(starts.size());
  const Index n_x = lower.size();
  // a step takes an evaluation or more
  MatrixXd numbers(3 + of_chain * (n_x + 1), std::ssize(starts));
  share_out({numbers.data(), static_cast<std::size_t>(numbers.size())}, static_cast<int>(starts.size()),
            options.evaluators.side_by_side, [&](int c, std::span<double> column) {
              const auto own = static_cast<std::size_t>(c);
              Chain chain(objective, starts[own], lower, upper, RandomStream(options.seed, own), options.evaluators.within(),
                          options.stop);
              run_chain(chain, of_chain, options.stop, progress, column);
            });
  if (is_set(options.stop)) throw NumericalError("stopped before all hyperparameters were drawn");

  // as many of each chain, the last ones
  const auto n = static_cast<Index>(numbers.row(0).minCoeff());
  HamiltonianDraws out;
  for (const auto& column : numbers.colwise()) {
    const auto n_kept = static_cast<Index>(column[0]);
    const MatrixXd steps = column.segment(3, n_kept * (n_x + 1)).reshaped(n_x + 1, n_kept).rightCols(n);
    out.chains.emplace_back(steps.topRows(n_x));
    out.objective.emplace_back(steps.row(n_x).transpose());
    out.acceptance += column[1] / numbers.row(0).sum();
    out.evaluations += static_cast<int>(column[2]);
  }
  return out;
}

namespace {

// An optimum, and Laplace's approximation there.
struct Mode {
  HamiltonianStart at;
  double objective = 0;
  double log_mass = 0;
};

// How far the density reaches inwards from a bound at which coordinate k of x stands, by its slope and curvature there.
double reach_from_bound(const Objective& objective, const VectorXd& x, Index k, const VectorXd& gradient,
                        const CoordinateBox& box, Likelihood::Workspace& workspace) {
  const double step = std::min(3e-3, (box.upper[k] - box.lower[k]) / 2);
  VectorXd inside = x, gradient_inside = gradient;
  inside[k] += x[k] - box.lower[k] < box.upper[k] - x[k] ? step : -step;
  objective(inside, &gradient_inside, workspace);
  const double curvature = std::abs(gradient_inside[k] - gradient[k]) / step;
  return 1 / std::max({std::abs(gradient[k]), std::sqrt(curvature), 1e-300});
}

// The metric is that of the curvature, no longer than half the box, or `longest` where the data say nothing.
Mode mode_at(const Objective& objective, const std::vector<Hyperparameter>& optimum, const std::vector<bool>& held,
             const CoordinateBox& box, const HamiltonianOptions& options) {
  constexpr double longest = 2;
  Mode mode{{coordinates(optimum), MatrixXd::Zero(box.lower.size(), box.lower.size())}};
  Likelihood::Workspace workspace(options.evaluators.alone, options.stop);
  VectorXd gradient = VectorXd::Zero(mode.at.x.size());
  mode.objective = objective(mode.at.x, &gradient, workspace);
  const Curvature curvature = curvature_at(objective, mode.at.x, optimum, options.evaluators, options.stop);
  const VectorXd most = (0.5 * (box.upper - box.lower)).cwiseMin(longest);
  mode.log_mass = -mode.objective;

  std::vector<int> drawn, in_curvature;
  for (std::size_t k = 0; k < curvature.free.size(); ++k) {
    if (held[static_cast<std::size_t>(curvature.free[k])]) continue;
    drawn.push_back(curvature.free[k]);
    in_curvature.push_back(static_cast<int>(k));
  }
  if (!drawn.empty()) {
    const MatrixXd scaled = curvature.eigenvectors * curvature.eigenvalues.asDiagonal() * curvature.eigenvectors.transpose();
    const VectorXd unit = curvature.unit(in_curvature).cwiseMin(most(drawn));
    const VectorXd shorter = unit.cwiseQuotient(curvature.unit(in_curvature));
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(
        MatrixXd(shorter.asDiagonal() * scaled(in_curvature, in_curvature) * shorter.asDiagonal()));
    mode.log_mass += unit.array().log().sum();
    for (Index j = 0; j < unit.size(); ++j) {
      const VectorXd direction = unit.cwiseProduct(eigen.eigenvectors().col(j));
      const double room = (most(drawn).array() / direction.array().abs().max(1e-300)).minCoeff();
      const double deviation = std::min(room, 1 / std::sqrt(std::max(std::abs(eigen.eigenvalues()[j]), 1e-12)));
      for (std::size_t k = 0; k < drawn.size(); ++k)
        mode.at.W(drawn[k], drawn[static_cast<std::size_t>(j)]) = deviation * direction[static_cast<Index>(k)];
      mode.log_mass += std::log(deviation) + 0.5 * std::log(2 * std::numbers::pi);
    }
  }
  for (std::size_t k = 0; k < optimum.size(); ++k) {
    const Index i = static_cast<Index>(k);
    if (held[k] || optimum[k].is_fixed() || !optimum[k].at_bound()) continue;
    mode.at.W(i, i) = std::min(most[i], reach_from_bound(objective, mode.at.x, i, gradient, box, workspace));
    mode.log_mass += std::log(mode.at.W(i, i));
  }
  return mode;
}

// The optima that are not too unlikely and not one another.
std::vector<Mode> modes_of(const Objective& objective, const std::vector<std::vector<Hyperparameter>>& optima,
                           const std::vector<bool>& held, const CoordinateBox& box, const HamiltonianOptions& options) {
  constexpr double too_unlikely = 12;  // nats: a mode as wide as the best one would have a mass of 6e-6
  constexpr std::size_t most = 4;
  std::vector<Mode> modes{mode_at(objective, optima.front(), held, box, options)};
  for (std::size_t k = 1; k < optima.size() && modes.size() < most; ++k) {
    VectorXd x = coordinates(optima[k]);
    // one that is held stays where it is at the best
    for (Index i = 0; i < x.size(); ++i) {
      if (held[static_cast<std::size_t>(i)]) x[i] = modes.front().at.x[i];
    }
    Likelihood::Workspace workspace(1, options.stop);
    const double J = objective(x, nullptr, workspace);
    if (!(J < modes.front().objective + too_unlikely)) continue;
    const bool is_known = std::any_of(modes.begin(), modes.end(), [&](const Mode& mode) {
      const VectorXd deviation = mode.at.W.rowwise().norm();
      return std::abs(J - mode.objective) < 0.1 && ((x - mode.at.x).array().abs() <= 0.5 * deviation.array()).all();
    });
    if (is_known) continue;
    try {
      modes.push_back(mode_at(objective, objective.at(x), held, box, options));
    } catch (const NumericalError&) {
      if (is_set(options.stop)) throw;  // else an edge of what is possible, where no chain can start
    }
  }
  return modes;
}

std::vector<HamiltonianStart> starts_at(const Objective& objective, const std::vector<Mode>& modes, const CoordinateBox& box,
                                        const HamiltonianOptions& options) {
  constexpr int n_chains = 8;
  double largest = modes.front().log_mass, sum = 0;
  for (const Mode& mode : modes) largest = std::max(largest, mode.log_mass);
  for (const Mode& mode : modes) sum += std::exp(mode.log_mass - largest);
  RandomStream random(~options.seed);
  Likelihood::Workspace workspace(options.evaluators.alone, options.stop);
  std::vector<HamiltonianStart> starts;
  std::size_t m = 0;
  double below = std::exp(modes[0].log_mass - largest) / sum;
  for (int c = 0; c < n_chains; ++c) {
    while (m + 1 < modes.size() && below < (c + 0.5) / n_chains) below += std::exp(modes[++m].log_mass - largest) / sum;
    const Mode& mode = modes[m];
    HamiltonianStart& start = starts.emplace_back(mode.at);
    VectorXd z(start.x.size());
    for (double& entry : z) entry = random.normal();
    // as far as Laplace's approximation goes, unless that is where it fails
    const double likely = mode.objective + static_cast<double>(z.size()) + 10;
    double share = 1;
    do {
      start.x = (mode.at.x + share * (mode.at.W * z)).cwiseMax(box.lower).cwiseMin(box.upper);
      share = share > 0.1 ? share / 2 : 0;
    } while (!(objective(start.x, nullptr, workspace) < likely) && start.x != mode.at.x && !is_set(options.stop));
  }
  return starts;
}

// of sorted numbers
double quantile(const std::vector<double>& sorted, double p) {
  const double place = p * static_cast<double>(sorted.size() - 1);
  const auto below = static_cast<std::size_t>(place);
  const std::size_t above = std::min(below + 1, sorted.size() - 1);
  return sorted[below] + (place - std::floor(place)) * (sorted[above] - sorted[below]);
}

// Moments and quantiles of all steps, in the units of the hyperparameters.
void summarise(const MatrixXd& values, HyperparameterDraws& out) {
  const auto n_steps = static_cast<double>(values.cols());
  out.mean = values.rowwise().mean();
  const MatrixXd deviation = values.colwise() - out.mean;
  const MatrixXd covariance = deviation * deviation.transpose() / n_steps;
  out.stddev = covariance.diagonal().cwiseSqrt();
  out.lower = out.upper = out.mean;
  for (Index k = 0; k < values.rows(); ++k) {
    const Eigen::RowVectorXd row = values.row(k);
    std::vector<double> sorted(row.begin(), row.end());
    std::sort(sorted.begin(), sorted.end());
    if (sorted.front() == sorted.back()) {
      // one that is held: no rounding
      out.mean[k] = sorted.front();
      out.stddev[k] = 0;
    }
    out.lower[k] = quantile(sorted, 0.025);
    out.upper[k] = quantile(sorted, 0.975);
  }
  out.correlation = MatrixXd::Identity(values.rows(), values.rows());
  for (Index k = 0; k < values.rows(); ++k) {
    for (Index l = 0; l < k; ++l) {
      const double both = out.stddev[k] * out.stddev[l];
      out.correlation(k, l) = out.correlation(l, k) = both > 0 ? std::clamp(covariance(k, l) / both, -1.0, 1.0) : 0;
    }
  }
}

}  // namespace

HyperparameterDraws draw_about(const Objective& objective, const std::vector<std::vector<Hyperparameter>>& optima,
                               const std::vector<bool>& held, int n_draws, const HamiltonianOptions& options) {
  const std::vector<Hyperparameter>& best = optima.front();
  const CoordinateBox box(best);
  const std::vector<Mode> modes = modes_of(objective, optima, held, box, options);
  const std::vector<HamiltonianStart> starts = starts_at(objective, modes, box, options);
  const HamiltonianDraws drawn = draw_coordinates(objective, starts, box.lower, box.upper, options);

  const Index of_chain = drawn.chains.front().cols(), n_steps = of_chain * std::ssize(drawn.chains);
  MatrixXd values(std::ssize(best), n_steps);
  VectorXd J(n_steps);
  for (Index s = 0; s < n_steps; ++s) {
    const auto chain = static_cast<std::size_t>(s / of_chain);
    const std::vector<Hyperparameter> at = objective.at(drawn.chains[chain].col(s % of_chain));
    for (std::size_t h = 0; h < at.size(); ++h) {
      values(static_cast<Index>(h), s) = held[h] || at[h].is_fixed() ? best[h].value : at[h].value;
    }
    J[s] = drawn.objective[chain][s % of_chain];
  }
  HyperparameterDraws out;
  summarise(values, out);
  out.r_hat = drawn.r_hat();
  out.effective_size = drawn.effective_size();
  for (Index k = 0; k < values.rows(); ++k) {
    // of equal values they would be rounding
    if (!out.is_drawn(k)) out.r_hat[k] = 1, out.effective_size[k] = static_cast<double>(n_steps);
  }
  out.n_chains = static_cast<int>(starts.size());
  out.evaluations = drawn.evaluations;
  out.acceptance = drawn.acceptance;
  std::vector<Index> kept;
  for (int k = 0; k < n_draws; ++k) kept.push_back((2 * k + 1) * n_steps / (2 * n_draws));
  std::stable_sort(kept.begin(), kept.end(), [&](Index a, Index b) { return J[a] < J[b]; });
  out.values = values(Eigen::all, kept);
  return out;
}

}  // namespace gp2
