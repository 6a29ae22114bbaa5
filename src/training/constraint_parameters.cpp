#include "training/constraint_parameters.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "base/decompositions.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

VectorXd parameters_under(const Prior& prior, const std::vector<Hyperparameter>& hyperparameters) {
  VectorXd parameters = prior.system->parameter_values();
  for (const Hyperparameter& h : hyperparameters) {
    if (h.is_system_parameter()) parameters[h.index] = h.value;
  }
  return parameters;
}

// The states of the observations of the prior's own system, by group.
std::vector<const Observations*> of_fitted_system(const std::vector<Observations>& observations) {
  std::vector<const Observations*> groups;
  for (const Observations& group : observations) {
    if (!group.view().other_system) groups.push_back(&group);
  }
  return groups;
}

bool moves_the_system(const Prior& prior, const std::vector<const Observations*>& groups, const VectorXd& parameters, int index) {
  return std::any_of(groups.begin(), groups.end(), [&](const Observations* group) {
    const SystemValues d = prior.system->differentiate(group->states(), parameters, index);
    const bool force_is_zero = prior.mean != Prior::Mean::force || d.force.isZero(0);
    const bool is_zero = d.mass.isZero(0) && d.constraint_matrix.isZero(0) && d.constraint_vector.isZero(0) && force_is_zero;
    return !is_zero || std::any_of(prior.latents.begin(), prior.latents.end(), [&](const Latent& latent) {
      return latent.directions && !latent.directions->differentiate(group->states(), parameters, index).isZero(0);
    });
  });
}

// The residuals at all states, one row for each residual of the system; NaN or ∞ where the log lacks what one reads.
MatrixXd residuals_at(const System& system, const std::vector<const Observations*>& groups, const VectorXd& parameters) {
  MatrixXd all(std::ssize(system.residual_labels()), 0);
  for (const Observations* group : groups) {
    const MatrixXd more = system.residuals(group->states(), parameters);
    all.conservativeResize(Eigen::NoChange, all.cols() + more.cols());
    all.rightCols(more.cols()) = more;
  }
  return all;
}

MatrixXd zero_where_unknown(const MatrixXd& values) {
  return values.unaryExpr([](double c) { return std::isfinite(c) ? c : 0.0; });
}

struct LeastSquares {
  VectorXd value, stddev;  // of the parameters; ∞ where the residuals do not determine one
};

// Gauss–Newton: min Σ_k |c_k(θ)|²/σ_k², with σ_k the scatter of residual k under the θ before.
LeastSquares solve(const Prior& prior, const std::vector<const Observations*>& groups, VectorXd parameters,
                   const std::vector<int>& indices) {
  const System& system = *prior.system;
  const auto n = std::ssize(indices);
  LeastSquares out{parameters(indices), VectorXd::Constant(n, std::numeric_limits<double>::infinity())};
  VectorXd scale = out.value.cwiseAbs();
  for (double& one : scale) one = one > 0 ? one : 1;
  constexpr int max_iterations = 30;
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    parameters(indices) = out.value;
    const MatrixXd residuals = residuals_at(system, groups, parameters), c = zero_where_unknown(residuals);
    MatrixXd J(c.size(), n);
    for (Index p = 0; p < n; ++p) {
      VectorXd above = parameters, below = parameters;
      const double step = 6e-6 * scale[p];
      above[indices[static_cast<std::size_t>(p)]] += step;
      below[indices[static_cast<std::size_t>(p)]] -= step;
      const MatrixXd change = residuals_at(system, groups, above) - residuals_at(system, groups, below);
      J.col(p) = zero_where_unknown(change).reshaped() / (2 * step) * scale[p];
    }
    // a residual that is exact still has the rounding of its terms
    VectorXd weight(c.rows());
    for (Index k = 0; k < c.rows(); ++k) {
      const double terms = J.reshaped(c.rows(), c.cols() * n).row(k).cwiseAbs().maxCoeff();
      const Index n_known = residuals.row(k).array().isFinite().count();
      const double scatter = c.row(k).norm() / std::sqrt(static_cast<double>(std::max<Index>(1, n_known - n)));
      weight[k] = terms > 0 ? 1 / std::max(scatter, 1e-9 * terms) : 0;
    }
    const VectorXd weights = weight.replicate(c.cols(), 1);
    const Eigen::JacobiSVD<MatrixXd> svd(weights.asDiagonal() * J, Eigen::ComputeThinU | Eigen::ComputeFullV);
    const VectorXd& singular = svd.singularValues();
    const double smallest = 1e-8 * singular[0];
    VectorXd step = VectorXd::Zero(n), variance = VectorXd::Zero(n);
    for (Index r = 0; r < n; ++r) {
      const VectorXd v = svd.matrixV().col(r);
      if (r < singular.size() && singular[r] > smallest) {
        step -= v * (svd.matrixU().col(r).dot(weights.cwiseProduct(c.reshaped())) / singular[r]);
        variance += v.cwiseAbs2() / (singular[r] * singular[r]);
      } else {
        variance = (v.cwiseAbs().array() > 1e-6).select(std::numeric_limits<double>::infinity(), variance);
      }
    }
    out.stddev = scale.cwiseProduct(variance.cwiseSqrt());
    // far from the solution a whole step may lead farther away, or to where a residual that is known here has no value
    const auto size_of = [&](const MatrixXd& all) {
      return (weight.asDiagonal() * MatrixXd(residuals.array().isFinite().select(all, 0.0))).squaredNorm();
    };
    const auto part = [&](double share) { return VectorXd(out.value + share * scale.cwiseProduct(step)); };
    double share = 1;
    constexpr double least = 1e-8;
    for (; share > least; share /= 2) {
      parameters(indices) = part(share);
      if (size_of(residuals_at(system, groups, parameters)) <= size_of(residuals)) break;
    }
    if (share <= least) break;
    out.value = part(share);
    if (!out.value.allFinite() || step.cwiseAbs().maxCoeff() < 1e-12) break;
  }
  return out;
}

}  // namespace

void weigh_by_residuals(const Prior& prior, const std::vector<Observations>& observations,
                        std::vector<Hyperparameter>& hyperparameters) {
  const std::vector<const Observations*> groups = of_fitted_system(observations);
  const VectorXd parameters = parameters_under(prior, hyperparameters);
  std::vector<Hyperparameter*> silent;  // the accelerations say nothing of them
  std::vector<int> indices;             // of all that are estimated
  for (Hyperparameter& h : hyperparameters) {
    if (!h.is_system_parameter() || h.is_fixed()) continue;
    indices.push_back(h.index);
    if (!moves_the_system(prior, groups, parameters, h.index)) silent.push_back(&h);
  }
  if (silent.empty() || groups.empty()) return;
  const bool has_residuals = !prior.system->residual_labels().empty();
  const std::optional<LeastSquares> found =
      has_residuals ? std::optional(solve(prior, groups, parameters, indices)) : std::nullopt;
  for (Hyperparameter* h : silent) {
    const auto place = std::find(indices.begin(), indices.end(), h->index) - indices.begin();
    const bool is_known = found && std::isfinite(found->stddev[place]) && std::isfinite(found->value[place]);
    const double value = is_known ? std::clamp(found->value[place], h->lower, h->upper) : h->value;
    const double stddev =
        is_known ? std::max(found->stddev[place], 1e-6 * std::max(std::abs(value), h->upper - h->lower)) : h->upper - h->lower;
    if (stddev_of(h->hyperprior) < stddev) continue;
    h->value = value;
    h->hyperprior = {HyperPrior::Form::normal, value, stddev};
  }
}

double stddev_of(const HyperPrior& prior) {
  if (prior.form == HyperPrior::Form::none) return std::numeric_limits<double>::infinity();
  return prior.stddev * (prior.form == HyperPrior::Form::normal ? 1 : prior.median);
}

bool is_known_by_bounds_only(const Hyperparameter& h) {
  return h.is_system_parameter() && stddev_of(h.hyperprior) >= h.upper - h.lower;
}

namespace {

bool are_same(const MatrixXd& a, const MatrixXd& b) { return (a.array() == b.array() || a.array().isNaN()).all(); }

bool has_one_constraint(const System& system, const MatrixXd& states, const VectorXd& here, const VectorXd& there) {
  const SystemValues a = system.evaluate(states, here), b = system.evaluate(states, there);
  return are_same(a.constraint_matrix, b.constraint_matrix) && are_same(a.constraint_vector, b.constraint_vector);
}

}  // namespace

std::vector<bool> held_in_draws(const Prior& prior, const std::vector<Observations>& observations,
                                const std::vector<Hyperparameter>& hyperparameters) {
  const VectorXd parameters = parameters_under(prior, hyperparameters);
  const std::vector<const Observations*> of_fitted = of_fitted_system(observations);
  std::vector<bool> held(hyperparameters.size());
  for (std::size_t k = 0; k < held.size(); ++k) {
    const Hyperparameter& h = hyperparameters[k];
    if (!h.is_system_parameter() || h.is_fixed()) continue;
    VectorXd moved = parameters;
    moved[h.index] += 1e-6 * (h.value < (h.lower + h.upper) / 2 ? 1 : -1) * (h.upper - h.lower);
    const auto moves_the_constraint = [&](const Observations& group) {
      const View& view = group.view();
      return !has_one_constraint(*prior.system, group.states(), parameters, moved) ||
             (view.other_system && !has_one_constraint(*prior_of(prior, view).system, group.states(),
                                                       parameters_of(view, parameters), parameters_of(view, moved)));
    };
    held[k] = std::any_of(observations.begin(), observations.end(), moves_the_constraint) ||
              (of_fitted.size() == observations.size() && !moves_the_system(prior, of_fitted, parameters, h.index));
  }
  return held;
}

}  // namespace gp2
