#include "gp2/jobs/actuator_fit.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include <fmt/format.h>

#include "base/decompositions.hpp"
#include "base/lapack.hpp"
#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/training/robust.hpp"
#include "training/curvature.hpp"
#include "training/lbfgsb.hpp"
#include "training/objective.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

/// Rows of observations, evenly taken, and how their inputs are told anew.
class ThinnedProblem {
 public:
  ThinnedProblem(const FitProblem& problem, const FitOptions& options) : problem_(problem) {
    const int size = fit_memory(problem, options).reduced_size;
    const int every = std::max(1, (size + largest_actuator_size - 1) / largest_actuator_size);
    const std::vector<Observations> trusted = problem.robust ? without_gross_errors(problem.observations) : problem.observations;
    for (std::size_t g = 0; g < trusted.size(); ++g) {
      std::vector<int> rows;
      // windows of time count the errors of what was smoothed, which rows share
      const int step = trusted[g].has_sums() ? 1 : every;
      for (int i = step / 2; i < trusted[g].n_data(); i += step) rows.push_back(i);
      observations_.push_back(step == 1 ? trusted[g] : trusted[g].take(rows));
      std::optional<CommandedRows>& commanded = commanded_.emplace_back(problem.commanded[g]);
      if (!commanded) continue;
      for (std::size_t k = 0; k < rows.size(); ++k) commanded->places[k] = commanded->places[static_cast<std::size_t>(rows[k])];
      commanded->places.resize(rows.size());
    }
  }

  /// The rows under delays and lags a.
  [[nodiscard]] std::vector<Observations> under(const VectorXd& a) const {
    std::map<std::string, double> values;
    for (Index k = 0; k < a.size(); ++k) values.emplace(problem_.late[static_cast<std::size_t>(k)].name, a[k]);
    std::vector<Observations> out = observations_;
    for (std::size_t g = 0; g < out.size(); ++g) {
      if (commanded_[g]) out[g] = commanded_[g]->under(values, out[g]);
    }
    return out;
  }

 private:
  const FitProblem& problem_;
  std::vector<Observations> observations_;
  std::vector<std::optional<CommandedRows>> commanded_;
};

HyperPrior hyperprior_of(const Parameter& parameter) {
  if (!parameter.prior) return {};
  return {parameter.prior->of_logarithm ? HyperPrior::Form::log_normal : HyperPrior::Form::normal, parameter.prior->median,
          parameter.prior->stddev};
}

/// The objective J of training as a function of the hyperparameters' coordinates x and of delays and lags a.
class ActuatorTraining {
 public:
  ActuatorTraining(const FitProblem& problem, const FitOptions& options)
      : problem_(problem),
        options_(options),
        rows_(problem, options),
        n_threads_(thread_count(options.n_threads)),
        x_(coordinates(problem.hyperparameters)),
        a_(std::ssize(problem.late)),
        lower_(a_.size()),
        upper_(a_.size()),
        unit_(a_.size()) {
    for (Index k = 0; k < a_.size(); ++k) {
      const Parameter& late = problem.late[static_cast<std::size_t>(k)];
      a_[k] = late.value;
      std::tie(lower_[k], upper_[k]) = Actuator::bounds(late);
    }
  }

  std::vector<ActuatorEstimate> run() {
    const lapack::SingleThread single_thread;
    const VectorXd x_start = x_, a_start = a_;
    // hyperparameters that are fitted first have learned what is late as if it were not; those that are not have learned nothing
    search();
    const VectorXd x = x_, a = a_;
    const double J = value(x_, a_);
    x_ = x_start;
    a_ = a_start;
    optimise(/*hyperparameters_only=*/true);
    search();
    if (!(value(x_, a_) < J)) {
      x_ = x;
      a_ = a;
    }
    if (problem_.prior.is_nonlinear()) follow_posterior_mean();
    return estimates();
  }

 private:
  // The prior is linear about the posterior mean under the delays found, until these stand.
  void follow_posterior_mean() {
    constexpr int most = 5;
    for (int round = 0; round < most && !is_set(options_.stop); ++round) {
      const std::vector<Observations> observations = rows_.under(a_);
      try {
        about_ = about_posterior_mean(problem_.prior, observations, objective_of(observations).at(x_)).about;
      } catch (const NumericalError&) {
        return;  // there is none to follow; the fit that comes after says so if it finds none either
      }
      const VectorXd before = a_;
      search();
      if (((a_ - before).array().abs() <= 0.1 * unit_.array()).all()) return;
    }
  }

  [[nodiscard]] Objective objective_of(const std::vector<Observations>& observations) const {
    return Objective(problem_.prior, observations, problem_.hyperparameters, {.points = nullptr, .about = about_});
  }

  /// J, and where it is asked for ∂J/∂x.
  double value(const VectorXd& x, const VectorXd& a, VectorXd* gradient = nullptr) const {
    // a lag that rounding takes below 0 would be none
    const std::vector<Observations> observations = rows_.under(a.cwiseMax(lower_).cwiseMin(upper_));
    const Objective objective = objective_of(observations);
    Likelihood::Workspace workspace(1, options_.stop);
    double J = objective(x, gradient, workspace);
    for (Index k = 0; k < a.size(); ++k) {
      const HyperPrior prior = hyperprior_of(problem_.late[static_cast<std::size_t>(k)]);
      if (prior.form != HyperPrior::Form::none) J += 0.5 * std::pow(prior.standardised(a[k]), 2);
    }
    return J;
  }

  // By turns over the box and down from the lowest point found, until that is where it stands.
  void search() {
    constexpr int most_scans = 4;
    for (int scans = 0; scans < most_scans && !is_set(options_.stop); ++scans) {
      const bool moved = scan();
      if (scans > 0 && !moved) return;
      find_units();
      optimise(/*hyperparameters_only=*/false);
    }
  }

  [[nodiscard]] VectorXd moved(Index k, double by) const {
    VectorXd there = a_;
    there[k] += by;
    return there;
  }

  // A tenth of the box, or what is known of each a_k were all else known: 1/√(∂²J/∂a_k²).
  void find_units() {
    parallel_for(static_cast<int>(a_.size()), n_threads_, [&](int k, int) {
      constexpr double first = 1e-3;  // of the box
      const double width = upper_[k] - lower_[k], step = first * width;
      const double centre = std::clamp(a_[k], lower_[k] + step, upper_[k] - step) - a_[k];
      const double curvature =
          (value(x_, moved(k, centre + step)) - 2 * value(x_, moved(k, centre)) + value(x_, moved(k, centre - step))) /
          (step * step);
      unit_[k] = 0.1 * width;
      if (curvature > 0 && std::isfinite(curvature)) unit_[k] = std::min(unit_[k], 1 / std::sqrt(curvature));
    });
  }

  // J at (x, a), ∂J/∂x and ∂J/∂a; to one side where the box ends.
  double with_gradient(const VectorXd& x, const VectorXd& a, VectorXd& of_x, VectorXd& of_a) const {
    constexpr double share = 1e-2;  // of a unit
    std::vector<VectorXd> points = {a};
    std::vector<double> sides;
    for (Index k = 0; k < a.size(); ++k) {
      const double h = share * unit_[k];
      const bool at_lower = a[k]<lower_[k] + h, at_upper = a[k]> upper_[k] - h;
      const double first = at_lower ? h : -h, second = at_lower ? 2 * h : at_upper ? -2 * h : h;
      for (const double step : {first, second}) {
        points.push_back(a);
        points.back()[k] += step;
        sides.push_back(step);
      }
    }
    std::vector<double> values(points.size());
    parallel_for(static_cast<int>(points.size()), n_threads_, [&](int p, int) {
      const auto at = static_cast<std::size_t>(p);
      values[at] = value(x, points[at], p == 0 ? &of_x : nullptr);
    });
    for (Index k = 0; k < a.size(); ++k) {
      // the parabola through three points
      const auto at = static_cast<std::size_t>(2 * k);
      const double s = sides[at], l = sides[at + 1], ds = values[at + 1] - values[0], dl = values[at + 2] - values[0];
      of_a[k] = (ds / s * l - dl / l * s) / (l - s);
    }
    return *std::max_element(values.begin(), values.end()) < infinity ? values[0] : infinity;
  }

  // The lowest point of a grid over the delay and lag of each input, which stand for each other when commands are slow; the others
  // and x as they are. Whether one was lower than where it stood.
  bool scan() {
    constexpr int n_points = 11;
    bool any = false;
    double here = value(x_, a_);
    for (Index first = 0, n = 0; first < a_.size() && !is_set(options_.stop); first += n) {
      n = first + 1 < a_.size() && is_of_one_input(first, first + 1) ? 2 : 1;
      const int n_grid = n == 2 ? n_points * n_points : 2 * n_points;
      const auto at = [&](int p) {
        VectorXd there = a_;
        const auto between = [&](Index k, double share) { return lower_[k] + (upper_[k] - lower_[k]) * share; };
        there[first] = between(first, n == 2 ? p % n_points / (n_points - 1.0) : p / (n_grid - 1.0));
        if (n == 2) there[first + 1] = between(first + 1, p / n_points / (n_points - 1.0));
        return there;
      };
      std::vector<double> values(static_cast<std::size_t>(n_grid));
      parallel_for(n_grid, n_threads_, [&](int p, int) { values[static_cast<std::size_t>(p)] = value(x_, at(p)); });
      const auto lowest = std::min_element(values.begin(), values.end());
      constexpr double decisive = 1e-3;  // nats
      if (!(*lowest < here - decisive)) continue;
      a_ = at(static_cast<int>(lowest - values.begin()));
      here = *lowest;
      any = true;
    }
    return any;
  }

  [[nodiscard]] bool is_of_one_input(Index k, Index l) const {
    const auto input = [&](Index i) {
      const std::string& name = problem_.late[static_cast<std::size_t>(i)].name;
      return name.substr(0, name.rfind('.'));
    };
    return input(k) == input(l);
  }

  void optimise(bool hyperparameters_only) {
    const std::vector<Hyperparameter>& hyperparameters = problem_.hyperparameters;
    const Index n = x_.size(), m = hyperparameters_only ? 0 : a_.size();
    const std::vector<Observations> observations = rows_.under(a_);
    const Objective objective = objective_of(observations);
    Likelihood::Workspace workspace(n_threads_, options_.stop);
    VectorXd scales(n + m), lower(n + m), upper(n + m), start(n + m);
    scales << scales_of_parameters(objective, x_, hyperparameters, options_.stop, workspace), unit_.head(m);
    start << x_, a_.head(m);
    for (Index k = 0; k < n; ++k) {
      lower[k] = hyperparameters[static_cast<std::size_t>(k)].lower_coordinate();
      upper[k] = hyperparameters[static_cast<std::size_t>(k)].upper_coordinate();
    }
    lower.tail(m) = lower_.head(m);
    upper.tail(m) = upper_.head(m);
    LbfgsbOptions options;
    options.max_iterations = 150;
    options.gradient_tolerance = 1e-3;
    options.reduction_tolerance = 1e-10;
    options.stop = [&] { return is_set(options_.stop); };
    const LbfgsbResult result = minimise(
        [&](const VectorXd& scaled, VectorXd& gradient) {
          const VectorXd z = scaled.cwiseProduct(scales);
          VectorXd of_x = VectorXd::Zero(n), of_a = VectorXd::Zero(a_.size());
          const double J =
              hyperparameters_only ? objective(z, &of_x, workspace) : with_gradient(z.head(n), z.tail(m), of_x, of_a);
          gradient << of_x, of_a.head(m);
          gradient = gradient.cwiseProduct(scales);
          return J;
        },
        start.cwiseQuotient(scales), lower.cwiseQuotient(scales), upper.cwiseQuotient(scales), options);
    if (!std::isfinite(result.value)) return;
    x_ = result.x.head(n).cwiseProduct(scales.head(n));
    if (m > 0) a_ = result.x.tail(m).cwiseProduct(scales.tail(m)).cwiseMax(lower_).cwiseMin(upper_);
  }

  [[nodiscard]] std::vector<ActuatorEstimate> estimates() {
    find_units();
    settle_at_bounds();
    std::vector<ActuatorEstimate> out;
    std::vector<Index> free;
    for (Index k = 0; k < a_.size(); ++k) {
      out.push_back({problem_.late[static_cast<std::size_t>(k)].name, a_[k], not_a_number, lower_[k], upper_[k]});
      if (!out.back().at_lower() && !out.back().at_upper()) {
        free.push_back(k);
      } else if (is_open(k)) {
        out.back().stddev = infinity;
      }
    }
    if (free.empty() || is_set(options_.stop)) return out;
    std::optional<Peak> peak;
    try {
      peak = peak_over(free);
    } catch (const NumericalError&) {
      return out;  // without deviations: an estimate stands where J is not finite near it
    }
    const std::optional<MatrixXd> covariance = inverse_of_definite(peak->information);
    for (Index f = 0; f < std::ssize(free); ++f) {
      const Index k = free[static_cast<std::size_t>(f)];
      ActuatorEstimate& one = out[static_cast<std::size_t>(k)];
      if (covariance) one.stddev = std::sqrt((*covariance)(f, f));
      // wider than a box that is believed evenly is no peak
      if (one.stddev > (one.upper - one.lower) / std::sqrt(12.0)) one.stddev = not_a_number;
      if (is_open(k)) one.stddev = infinity;
    }
    const auto is_known = [&](Index k) { return std::isfinite(out[static_cast<std::size_t>(k)].stddev); };
    if (!covariance || !std::ranges::all_of(free, is_known)) return out;
    const MatrixXd moves = peak->slopes * cholesky_factor(*covariance);
    for (Index k = 0; k < x_.size(); ++k) {
      const Hyperparameter& h = problem_.hyperparameters[static_cast<std::size_t>(k)];
      if (!h.is_system_parameter()) continue;
      for (Index f = 0; f < std::ssize(free); ++f)
        out[static_cast<std::size_t>(free[static_cast<std::size_t>(f)])].moves.emplace(h.name, h.map().unit * moves(k, f));
    }
    return out;
  }

  // What is nearer to a bound than data tell, and fits as well there, is there.
  void settle_at_bounds() {
    for (Index k = 0; k < a_.size(); ++k) {
      for (const double bound : {lower_[k], upper_[k]}) {
        constexpr double as_well = 0.5;  // nats
        const double distance = bound - a_[k];
        if (distance != 0 && std::abs(distance) < 2 * unit_[k] && value(x_, moved(k, distance)) < value(x_, a_) + as_well)
          a_[k] = bound;
      }
    }
  }

  // Whether all of its box explains the data about as well.
  [[nodiscard]] bool is_open(Index k) const {
    constexpr double little = 2;  // nats
    const double most = value(x_, a_) + little;
    return value(x_, moved(k, (lower_[k] + upper_[k]) / 2 - a_[k])) < most && value(x_, moved(k, lower_[k] - a_[k])) < most &&
           value(x_, moved(k, upper_[k] - a_[k])) < most;
  }

  // J about its lowest point, over those of a that are free.
  struct Peak {
    MatrixXd information;  // J_aa − J_ax J_xx⁻¹ J_xa: the curvature where x is the likeliest there
    MatrixXd slopes;       // −J_xx⁻¹ J_xa: of that x
  };

  [[nodiscard]] Peak peak_over(const std::vector<Index>& free) const {
    const std::vector<Observations> observations = rows_.under(a_);
    const Objective objective = objective_of(observations);
    const Curvature of_x = curvature_at(objective, x_, objective.at(x_), n_threads_, options_.stop);
    const auto m = std::ssize(free);
    MatrixXd of_a(m, m), mixed(x_.size(), m);
    for (Index f = 0; f < m; ++f) {
      const Index k = free[static_cast<std::size_t>(f)];
      // as far as data tell, so that kinks of linear interpolation are of no account
      const double step = std::min({0.5 * unit_[k], (a_[k] - lower_[k]) / 2, (upper_[k] - a_[k]) / 2});
      VectorXd x_plus = VectorXd::Zero(x_.size()), x_minus = x_plus, a_plus(a_.size()), a_minus(a_.size());
      with_gradient(x_, moved(k, step), x_plus, a_plus);
      with_gradient(x_, moved(k, -step), x_minus, a_minus);
      mixed.col(f) = (x_plus - x_minus) / (2 * step);
      of_a.col(f) = ((a_plus - a_minus) / (2 * step))(free);
    }
    const MatrixXd seen = of_x.eigenvectors.transpose() * of_x.unit.asDiagonal() * mixed(of_x.free, Eigen::all);
    const VectorXd known = (of_x.eigenvalues.array() > of_x.zero).select(of_x.eigenvalues.cwiseInverse(), 0);
    Peak peak{(of_a + of_a.transpose()) / 2 - seen.transpose() * known.asDiagonal() * seen, MatrixXd::Zero(x_.size(), m)};
    peak.slopes(of_x.free, Eigen::all) = of_x.unit.asDiagonal() * of_x.eigenvectors * -(known.asDiagonal() * seen);
    return peak;
  }

  const FitProblem& problem_;
  const FitOptions& options_;
  ThinnedProblem rows_;
  int n_threads_;
  VectorXd x_, a_;                              // where the search stands
  std::shared_ptr<const Linearisation> about_;  // of a nonlinear prior; null: where no latent acts
  VectorXd lower_, upper_;                      // of a
  VectorXd unit_;                               // of a: what the optimiser sees it in
};

}  // namespace

std::vector<ActuatorEstimate> estimate_actuators(const FitProblem& problem, const FitOptions& options) {
  if (problem.late.empty()) return {};
  return ActuatorTraining(problem, options).run();
}

std::vector<std::string> actuator_notes(const std::vector<ActuatorEstimate>& estimates) {
  std::vector<std::string> notes;
  for (const ActuatorEstimate& one : estimates) {
    if (std::isinf(one.stddev)) {
      notes.push_back(
          fmt::format("warning: the data do not determine {}: the input hardly changes, or hardly acts. Hold it at a "
                      "known value, or give it a prior",
                      one.name));
    } else if (one.at_upper()) {
      notes.push_back(
          fmt::format("warning: {} ended at its bound, {:.6g} s. It may lie beyond: give it wider bounds", one.name, one.value));
    }
  }
  return notes;
}

}  // namespace gp2
