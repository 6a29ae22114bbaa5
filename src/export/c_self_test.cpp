#include "export/c_writer.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2::c_export {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr int n_tests = 4;

constexpr double roundoff(bool single_precision) { return single_precision ? 6e-8 : 1.1e-16; }

// The functions of a latent at a state: Σ_j |k_j β_j| of their means, and their largest standard deviation under the prior.
struct FunctionsAt {
  VectorXd sizes;  // (F)
  double prior_stddev = 0;
};
FunctionsAt functions_at(const LatentPosterior& latents, const Term& term, const VectorXd& state) {
  const LatentPosterior::Basis& basis = latents.latents()[term.latent];
  const Index F = basis.n_functions, n = basis.kernel.n_rows();
  VectorXd features(term.D), point;
  term.features->evaluate(state, features);
  basis.kernel.scale(features, point);
  if (basis.is_potential) {
    const GradientColumns gradient(basis.kernel);
    GradientColumns::Workspace memory;
    gradient.evaluate(0, n, point, memory);
    FunctionsAt out{VectorXd(F), std::sqrt(gradient.variance().maxCoeff())};
    for (Index f = 0; f < F; ++f) {
      gradient.multiply(VectorXd::Unit(F, f), memory);
      out.sizes[f] = (memory.out * basis.beta.array()).abs().sum();
    }
    return out;
  }
  VectorXd k(n);
  KernelColumns::Workspace memory;
  basis.kernel.evaluate(0, n, point, k.data(), memory);
  return {basis.beta.cwiseAbs().transpose() * k.cwiseAbs(), std::sqrt(basis.kernel.variance(point))};
}

}  // namespace

// Σ_j |k_j β_j| of each latent at a state, in units of its function's deviation under the prior: the most of all components.
// Weights that cancel leave a function off by rounding of this sum, and a row is at most its own deviation under the prior, in units
// of the function's, times as large.
VectorXd Writer::cancelled_at(const VectorXd& state) const {
  VectorXd most = VectorXd::Zero(std::ssize(terms_));
  for (const Component& component : components_) {
    for (std::size_t a = 0; a < terms_.size(); ++a) {
      const FunctionsAt at = functions_at(*component->latents, terms_[a], state);
      double& of_latent = most[static_cast<Index>(a)];
      if (at.prior_stddev > 0) of_latent = std::max(of_latent, at.sizes.norm() / at.prior_stddev);
    }
  }
  return most;
}

// How much more than the mean its derivatives are rounded.
double Writer::steepest_scale() const {
  double steepest = 1;
  for (const Component& component : components_) {
    for (const Term& term : terms_) {
      const VectorXd scales = scales_of(component->latents->latents()[term.latent].kernel);
      if (scales.size() > 0) steepest = std::max(steepest, scales.maxCoeff());
    }
  }
  return steepest;
}

// What single precision makes of a variance, as a share of the prior's.
double Writer::rounding_of_variance() const {
  return std::sqrt(static_cast<double>(n_variables_)) * roundoff(/*single_precision=*/true);
}

int Writer::rank_at(const VectorXd& state) const {
  if (system().nc() == 0) return 0;
  values_->evaluate(state);
  UdwadiaKalaba projection;
  projection.compute(values_->M(), values_->A(), values_->b(), system().largest_rank_of(values_->A()));
  return projection.rank();
}

// A state as a float holds it must have the same prediction, nearly.
// @param allowed  by how much its mean may differ
// @returns by how much its variances do
double Writer::require_fine_state(const Predictor& predictor, Predictor::Workspace& workspace, const VectorXd& state,
                                  const VectorXd& mean, const VectorXd& variance, double allowed) const {
  const VectorXd rounded = state.cast<float>().cast<double>();
  VectorXd at_rounded(mean.size()), stddev = VectorXd::Zero(mean.size());
  const Predictor::Status status = has("stddev") ? predictor.mean_and_stddev(rounded, at_rounded, stddev, workspace)
                                                 : predictor.mean(rounded, at_rounded, workspace);
  const double moved =
      status == Predictor::Status::ok ? (at_rounded - mean).cwiseAbs().maxCoeff() : std::numeric_limits<double>::infinity();
  if (moved <= allowed) return (stddev.cwiseAbs2() - variance).cwiseAbs().maxCoeff();
  const int rank = rank_at(state), rank_at_rounded = rank_at(rounded);
  if (rank != rank_at_rounded) {
    throw InputError(fmt::format(
        "export to C: in single precision redundant constraints are no longer redundant: rounding a state takes the rank "
        "of A from {} to {}. Leave out rows that follow from others, or leave `float` out",
        rank, rank_at_rounded));
  }
  throw InputError(
      fmt::format("export to C: in single precision the states themselves are too coarse: rounding one of them moves the "
                  "mean by {:.2g}. Let time and coordinates start near 0, or leave `float` out",
                  moved));
}

void Writer::write_tests() {
  const std::vector<Observations>& observations = components_.front()->observations;
  const auto any = std::ranges::find_if(observations, [](const Observations& group) { return group.n_data() > 0; });
  const MatrixXd& observed = (any == observations.end() ? observations.front() : *any).states();
  const Predictor predictor(posterior_, view_, {options_.stddev, options_.jacobian, Predictor::Storage::double_precision});
  const Predictor before(posterior_.without_data(), view_, {true, false, Predictor::Storage::double_precision});
  Predictor::Workspace workspace = predictor.make_workspace(), workspace_before = before.make_workspace();
  const Index nr = view_.size(), nx = layout_.size();
  VectorXd mean(nr), stddev = VectorXd::Zero(nr), at_zero(nr), prior(nr);
  MatrixXd jacobian(nr, nx);
  std::string& tests = text("tests");
  const bool single = options_.single_precision;
  const double epsilon = roundoff(single), steepest = steepest_scale();
  int n = 0;
  // evenly among the observed, those that have a prediction
  for (Index i = 0; i < observed.cols() && n < n_tests; i += std::max<Index>(1, observed.cols() / n_tests)) {
    VectorXd state = observed.col(i).array().isNaN().select(0, observed.col(i));
    Predictor::Status status = predictor.mean(state, mean, workspace);
    if (has("jacobian") && status == Predictor::Status::ok)
      status = predictor.mean_and_jacobian(state, mean, jacobian, workspace);
    if (has("stddev") && status == Predictor::Status::ok) status = predictor.mean_and_stddev(state, mean, stddev, workspace);
    if (status != Predictor::Status::ok) continue;
    ++n;
    static_cast<void>(before.mean_and_stddev(state, at_zero, prior, workspace_before));
    const double size = prior.maxCoeff(), precision = single ? 1e-4 : 1e-9;
    const double rounding = 32 * epsilon * size * cancelled_at(state).sum();
    const VectorXd variance = stddev.array().square();
    tests += fmt::format("    {{{{{}}}, {{{}}},\n", numbers(state.data(), nx), numbers(mean.data(), nr));
    if (has("stddev")) tests += fmt::format("     {{{}}},\n", numbers(variance.data(), nr));
    if (has("jacobian")) tests += fmt::format("     {{{}}},\n", numbers(jacobian.data(), nr * nx));
    const double largest = std::max(1.0, mean.cwiseAbs().maxCoeff());
    std::vector<std::string> errors = {number(precision * largest + rounding)};
    // what double precision leaves of a variance that the observations take from the prior's; single precision also rounds the
    // mechanics and the states
    double of_variance = (single ? 4 * rounding_of_variance() : 1e-11) * size * size;
    if (single) {
      const double moved = require_fine_state(predictor, workspace, state, mean, variance, precision * largest + rounding);
      of_variance += 4 * moved + 1e-3 * variance.maxCoeff();
    }
    // a latent along which nothing of a view acts has a deviation of rounding there
    const double cancelled = 32 * epsilon * largest;
    if (has("stddev")) errors.push_back(number(of_variance + cancelled * cancelled));
    if (has("jacobian"))
      errors.push_back(number(precision * std::max(1.0, jacobian.cwiseAbs().maxCoeff()) + rounding * steepest));
    tests += fmt::format("     {}}},\n", fmt::join(errors, ", "));
  }
  if (n == 0) throw_untestable(observed);
  text("n_tests") = std::to_string(n);
}

// The error of a prediction tells why a state has none.
void Writer::throw_untestable(const MatrixXd& observed) const {
  std::string why;
  try {
    static_cast<void>(posterior_.mean(view_, observed.array().isNaN().select(0, observed)));
  } catch (const InputError& error) {
    why = fmt::format(": {}", error.what());
  }
  throw InputError(
      fmt::format("export to C: no observed state has a prediction of this view, so that there is nothing to test it by{}", why));
}

void Writer::require_single_precision() const {
  constexpr double epsilon = roundoff(/*single_precision=*/true);
  constexpr double largest_share = 0.02, largest_share_of_variance = 0.05;
  constexpr Index most_states = 200;
  const Predictor predictor(posterior_, view_, {true, false, Predictor::Storage::double_precision});
  const Predictor before(posterior_.without_data(), view_, {true, false, Predictor::Storage::double_precision});
  Predictor::Workspace workspace = predictor.make_workspace(), workspace_before = before.make_workspace();
  VectorXd mean(view_.size()), stddev(view_.size()), at_zero(view_.size()), prior(view_.size());
  double worst = 0, worst_of_variance = 0;
  std::string where;
  for (const Observations& group : components_.front()->observations) {
    const MatrixXd& states = group.states();
    if (states.rows() != layout_.size()) continue;  // of another system than the view
    for (Index i = 0; i < states.cols(); i += std::max<Index>(1, states.cols() / most_states)) {
      const VectorXd state = states.col(i).array().isNaN().select(0, states.col(i));
      if (predictor.mean_and_stddev(state, mean, stddev, workspace) != Predictor::Status::ok ||
          before.mean_and_stddev(state, at_zero, prior, workspace_before) != Predictor::Status::ok) {
        continue;
      }
      const VectorXd cancelled = cancelled_at(state);
      const double largest = std::max(prior.maxCoeff(), mean.cwiseAbs().maxCoeff());
      for (Index r = 0; r < view_.size(); ++r) {
        // where a constraint decides a row its deviation is rounding beside those of others
        if (!(prior[r] > epsilon * largest)) continue;
        const double ratio = prior[r] / stddev[r];
        if (has("stddev")) worst_of_variance = std::max(worst_of_variance, rounding_of_variance() * ratio * ratio);
        const double share = epsilon * ratio * cancelled.sum();
        if (!(share > worst)) continue;
        worst = share;
        Index latent = 0;
        cancelled.maxCoeff(&latent);
        where = terms_[static_cast<std::size_t>(latent)].of->name;
      }
    }
  }
  const char* const points = posterior_.values().inducing ? "inducing points" : "rows";
  if (worst > largest_share) {
    throw InputError(fmt::format(
        "export to C: in single precision the mean would be off by up to {:.2g} of its standard deviation at an observed "
        "state, where {:.2g} is allowed: the weights of latent '{}' cancel. Fewer {} or a larger noise help, or leave "
        "`float` out",
        worst, largest_share, where, points));
  }
  if (worst_of_variance > largest_share_of_variance) {
    throw InputError(fmt::format(
        "export to C: in single precision the variance would be off by up to {:.2g} of itself at an observed state, where "
        "{:.2g} is allowed: the observations leave little of the prior's. Fewer {} or a larger noise help, or leave the "
        "standard deviation or `float` out",
        worst_of_variance, largest_share_of_variance, points));
  }
}

}  // namespace gp2::c_export
