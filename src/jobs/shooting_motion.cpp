#include "jobs/shooting_motion.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "base/decompositions.hpp"
#include "base/parallel.hpp"
#include "base/stop.hpp"
#include "gp2/error.hpp"
#include "simulation/contacts.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double relative_width = 1e-3;  // of differences: in a logarithm, or in units of a size

}  // namespace

ShootingMotion::ShootingMotion(const FitFile& fit, const ShootingLog& log, int n_threads, const std::atomic<bool>* stop)
    : fit_(fit),
      log_(log),
      prior_(fit.prior()),
      system_(*fit.model.system),
      view_(View::constrained_acceleration(system_)),
      switching_(switching_functions(fit.model, /*of_latents=*/true)),
      n_threads_(n_threads),
      stop_(stop) {}

Posterior ShootingMotion::posterior_at(const std::vector<Hyperparameter>& hyperparameters) const {
  require_not_stopped(stop_);
  ModelValues values = model_values(prior_, fit_.observations, hyperparameters);
  if (fit_.report.inducing) values.inducing = fit_.report.inducing->points;
  return {prior_, fit_.observations, std::move(values)};
}

VectorXd ShootingMotion::residual(const ViewFunction& function, const VectorXd& parameters, const Stretch& stretch) const {
  constexpr int most_steps_per_row = 50;
  const StateLayout layout = system_.layout();
  const auto measured = log_.states.middleCols(stretch.first, stretch.size);
  const Acceleration acceleration = [&](const Eigen::Ref<const VectorXd>& x) -> VectorXd {
    require_not_stopped(stop_);
    return function(view_, x).col(0);
  };
  SimulateOptions options;
  options.times = measured.row(layout.t()).transpose();
  options.relative_tolerance = 1e-8;
  options.absolute_tolerance = 1e-11;
  options.max_steps = most_steps_per_row * static_cast<int>(stretch.size);  // a motion that runs away takes ever more
  options.switching = switching_;
  options.contacts = contacts_of(fit_.model, parameters);
  if (!options.contacts.empty()) options.pushed = pushed_acceleration(prior_, view_, function);
  const MatrixXd gaps = gaps_of(system_, options.contacts, stretch.start, parameters);
  for (std::size_t k = 0; k < options.contacts.size(); ++k) {
    const bool is_closed = stretch.start[layout.u(options.contacts[k].input)] > 0.5;
    if (!is_closed && !(gaps(static_cast<Index>(k), 0) > 0)) return {};
  }
  if (layout.nu > 0) options.inputs = {options.times, measured.middleRows(layout.u(0), layout.nu)};
  MatrixXd off(log_.compared.size(), stretch.size);
  try {
    const Trajectory motion = simulate(system_, parameters, acceleration, stretch.start, options);
    for (std::size_t c = 0; c < log_.compared.size(); ++c) {
      const int j = log_.compared[c];
      for (Index i = 0; i < stretch.size; ++i) {
        const double here = measured(layout.q(j), i) - motion.states(layout.q(j), i);
        off(static_cast<Index>(c), i) =
            system_.coordinates()[static_cast<std::size_t>(j)].angle ? std::remainder(here, 2 * std::numbers::pi) : here;
      }
    }
  } catch (const NumericalError&) {
    require_not_stopped(stop_);
    return {};
  }
  if (!off.allFinite()) return {};
  return off.reshaped();
}

VectorXd ShootingMotion::residual(const Posterior& posterior, const Stretch& stretch) const {
  const auto mean = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return posterior.mean(view, x); };
  return residual(mean, posterior.values().parameters, stretch);
}

std::vector<VectorXd> ShootingMotion::residuals(const Posterior& posterior, const std::vector<Stretch>& stretches) const {
  std::vector<VectorXd> residuals(stretches.size());
  parallel_for(static_cast<int>(stretches.size()), n_threads_, [&](int k, int) {
    const auto at = static_cast<std::size_t>(k);
    residuals[at] = residual(posterior, stretches[at]);
  });
  return residuals;
}

// Changes of a start that keep to the constraints, in units of the spreads in the log: what is left of changes of each entry by itself
// once they are projected.
MatrixXd ShootingMotion::tangents(const VectorXd& parameters, const VectorXd& start) const {
  if (system_.nc() == 0) return log_.spread.asDiagonal();
  const auto n = log_.spread.size();
  const VectorXd at = project_onto_constraints(system_, parameters, start);
  MatrixXd changes(n, n);
  for (Index e = 0; e < n; ++e) {
    VectorXd moved = at;
    moved[e] += relative_width * log_.spread[e];
    changes.col(e) =
        (project_onto_constraints(system_, parameters, moved) - at).head(n).cwiseQuotient(log_.spread) / relative_width;
  }
  Eigen::ColPivHouseholderQR<MatrixXd> qr(changes);
  qr.setThreshold(0.03);  // beyond what curvature leaves of a change that the constraints forbid
  return log_.spread.asDiagonal() * basis_of_range(qr);
}

std::vector<LinearisedMotion> ShootingMotion::linearise(const std::vector<Hyperparameter>& hyperparameters,
                                                        const std::vector<std::size_t>& estimated,
                                                        const std::vector<Stretch>& stretches,
                                                        const std::vector<VectorXd>& residuals) const {
  struct Neighbours {
    Posterior more, less;
    double width;
  };
  const Posterior here = posterior_at(hyperparameters);
  std::vector<Neighbours> beside;
  for (const std::size_t k : estimated) {
    const Hyperparameter& h = hyperparameters[k];
    const double x = h.coordinate();
    const double width = h.map().is_logarithm
                             ? relative_width
                             : relative_width * std::max(std::abs(h.value), relative_width * (h.upper - h.lower)) / h.map().unit;
    // a difference to one side where a bound, as that of a restitution, forbids the other
    const double more = std::min(x + width, h.upper_coordinate()), less = std::max(x - width, h.lower_coordinate());
    const auto moved = [&](double to) {
      std::vector<Hyperparameter> all = hyperparameters;
      all[k].value = h.map().value(to);
      return posterior_at(all);
    };
    beside.push_back({moved(more), moved(less), (more - less) / 2});
  }
  std::vector<LinearisedMotion> all(stretches.size());
  parallel_for(static_cast<int>(stretches.size()), n_threads_, [&](int k, int) {
    const Stretch& stretch = stretches[static_cast<std::size_t>(k)];
    LinearisedMotion& out = all[static_cast<std::size_t>(k)];
    out.residual = residuals[static_cast<std::size_t>(k)];
    const auto slope = [&](const VectorXd& more, const VectorXd& less, double width) -> VectorXd {
      // one that cannot be followed beside here says nothing of its slope
      if (more.size() == 0 || less.size() == 0) return VectorXd::Zero(out.residual.size());
      return (less - more) / (2 * width);
    };
    out.by_theta.resize(out.residual.size(), std::ssize(beside));
    for (Index a = 0; a < std::ssize(beside); ++a) {
      const Neighbours& at = beside[static_cast<std::size_t>(a)];
      out.by_theta.col(a) = slope(residual(at.more, stretch), residual(at.less, stretch), at.width);
    }
    out.basis = tangents(here.values().parameters, stretch.start);
    out.by_start.resize(out.residual.size(), out.basis.cols());
    for (Index e = 0; e < out.basis.cols(); ++e) {
      const auto moved = [&](double by) {
        Stretch other = stretch;
        other.start.head(log_.spread.size()) += by * out.basis.col(e);
        return residual(here, other);
      };
      out.by_start.col(e) = slope(moved(relative_width), moved(-relative_width), relative_width);
    }
  });
  return all;
}

}  // namespace gp2
