#include "export/c_writer.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2::c_export {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr int n_tests = 4;

constexpr double roundoff(bool single_precision) { return single_precision ? 6e-8 : 1.1e-16; }

// The functions of a latent at a state: their standard deviations, that of the prior, and Σ_j |k_j β_j| of their means.
struct FunctionsAt {
  VectorXd stddev, sizes;  // (F)
  double prior_stddev = 0;
};
FunctionsAt functions_at(const LatentPosterior& latents, const Term& term, const VectorXd& state) {
  const LatentPosterior::Basis& basis = latents.latents()[term.latent];
  const Index F = basis.n_functions, n = basis.kernel.n_rows();
  VectorXd features(term.D), point, k(n), variance(F);
  term.features->evaluate(state, features);
  basis.kernel.scale(features, point);
  const GradientColumns gradient(basis.kernel);
  GradientColumns::Workspace of_gradient;
  if (basis.is_potential) {
    gradient.evaluate(0, n, point, of_gradient);
    variance = gradient.variance();
  } else {
    KernelColumns::Workspace memory;
    basis.kernel.evaluate(0, n, point, k.data(), memory);
    variance.setConstant(basis.kernel.variance(point));
  }
  FunctionsAt out{VectorXd(F), VectorXd(F), std::sqrt(variance.maxCoeff())};
  MatrixXd rows = MatrixXd::Zero(latents.n_rows(), F);
  for (Index f = 0; f < F; ++f) {
    MatrixXd K = MatrixXd::Zero(n, F);  // of every function at each point with this one
    if (basis.is_potential) {
      gradient.multiply(VectorXd::Unit(F, f), of_gradient);
      K = of_gradient.out;
    } else {
      K.col(f) = k;
    }
    out.sizes[f] = K.cwiseProduct(basis.beta).cwiseAbs().sum();
    for (std::size_t c = 0; c < latents.row_of().size(); ++c) {
      const std::vector<Index>& row_of = latents.row_of()[c];
      const VectorXd of_points = K.cwiseProduct(basis.Z.middleCols(static_cast<Index>(c) * F, F)).rowwise().sum();
      for (std::size_t j = 0; j < row_of.size(); ++j) {
        if (row_of[j] >= 0) rows(row_of[j], f) = of_points[static_cast<Index>(j)];
      }
    }
  }
  MatrixXd cross = latents.sums() != nullptr ? MatrixXd(latents.sums()->D * rows) : std::move(rows);
  latents.whiten(cross);
  out.stddev = (variance - cross.colwise().squaredNorm().transpose()).cwiseMax(0).cwiseSqrt();
  return out;
}

}  // namespace

// What rounding may make of the mean at a state, and how much more of its derivatives. Weights that cancel leave a function off by
// rounding of Σ_j |k_j β_j|, and a row is at most its deviation under the prior, in units of the function's, times as large.
std::pair<double, double> Writer::rounding_at(const VectorXd& state, double prior_stddev) const {
  double cancelled = 0, steepest = 1;
  for (const Component& component : components_) {
    double of_component = 0;
    for (const Term& term : terms_) {
      const FunctionsAt at = functions_at(*component->latents, term, state);
      if (at.prior_stddev > 0) of_component += at.sizes.norm() / at.prior_stddev;
      const VectorXd scales = scales_of(component->latents->latents()[term.latent].kernel);
      if (scales.size() > 0) steepest = std::max(steepest, scales.maxCoeff());
    }
    cancelled = std::max(cancelled, of_component);
  }
  return {32 * roundoff(options_.single_precision) * prior_stddev * cancelled, steepest};
}

void Writer::write_tests() {
  const std::vector<Observations>& observations = components_.front()->observations;
  const auto any = std::ranges::find_if(observations, [](const Observations& group) { return group.n_data() > 0; });
  const MatrixXd& observed = (any == observations.end() ? observations.front() : *any).states();
  const Predictor predictor(posterior_, view_, {options_.stddev, options_.jacobian, Predictor::Storage::double_precision});
  const Predictor before(posterior_.without_data(), view_, {true, false, Predictor::Storage::double_precision});
  Predictor::Workspace workspace = predictor.make_workspace(), workspace_before = before.make_workspace();
  const Index nr = view_.size(), nx = layout_.size();
  VectorXd mean(nr), at_rounded(nr), stddev = VectorXd::Zero(nr), at_zero(nr), prior(nr);
  MatrixXd jacobian(nr, nx);
  std::string& tests = text("tests");
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
    const double size = prior.maxCoeff(), precision = options_.single_precision ? 1e-4 : 1e-9;
    const auto [rounding, steepest] = rounding_at(state, size);
    const VectorXd variance = stddev.array().square();
    tests += fmt::format("    {{{{{}}}, {{{}}},\n", numbers(state.data(), nx), numbers(mean.data(), nr));
    if (has("stddev")) tests += fmt::format("     {{{}}},\n", numbers(variance.data(), nr));
    if (has("jacobian")) tests += fmt::format("     {{{}}},\n", numbers(jacobian.data(), nr * nx));
    const double largest = std::max(1.0, mean.cwiseAbs().maxCoeff());
    std::vector<std::string> errors = {number(precision * largest + rounding)};
    if (options_.single_precision) {
      const VectorXd rounded = state.cast<float>().cast<double>();
      const bool is_ok = predictor.mean(rounded, at_rounded, workspace) == Predictor::Status::ok;
      const double moved = is_ok ? (at_rounded - mean).cwiseAbs().maxCoeff() : std::numeric_limits<double>::infinity();
      if (!(moved <= precision * largest + rounding)) {
        throw InputError(
            fmt::format("export to C: in single precision the states themselves are too coarse: rounding one of them moves the "
                        "mean by {:.2g}. Let time and coordinates start near 0, or leave `float` out",
                        moved));
      }
    }
    // a latent along which nothing of a view acts has a deviation of rounding there
    const double cancelled = 32 * roundoff(options_.single_precision) * largest;
    // what double precision leaves of a variance that the observations take from the prior's
    const double of_variance = options_.single_precision ? precision : 1e-11;
    if (has("stddev")) errors.push_back(number(of_variance * size * size + cancelled * cancelled));
    if (has("jacobian"))
      errors.push_back(number(precision * std::max(1.0, jacobian.cwiseAbs().maxCoeff()) + rounding * steepest));
    tests += fmt::format("     {}}},\n", fmt::join(errors, ", "));
  }
  if (n == 0)
    throw InputError("export to C: no observed state has a prediction of this view, so that there is nothing to test it by");
  text("n_tests") = std::to_string(n);
}

void Writer::require_single_precision() const {
  constexpr double epsilon = roundoff(/*single_precision=*/true);
  constexpr double largest_share = 0.01;
  constexpr Index most_states = 200;
  double worst = 0;
  std::string where;
  for (const Component& component : components_) {
    for (const Observations& group : component->observations) {
      const MatrixXd& states = group.states();
      for (Index i = 0; i < states.cols(); i += std::max<Index>(1, states.cols() / most_states)) {
        const VectorXd state = states.col(i).array().isNaN().select(0, states.col(i));
        for (const Term& term : terms_) {
          const FunctionsAt at = functions_at(*component->latents, term, state);
          for (Index f = 0; f < term.F; ++f) {
            const double share = epsilon * at.sizes[f] / at.stddev[f];
            if (!(share > worst)) continue;
            worst = share;
            where = term.of->name;
          }
        }
      }
    }
  }
  if (worst <= largest_share) return;
  throw InputError(fmt::format(
      "export to C: in single precision latent '{}' would be off by up to {:.2g} of its standard deviation at an observed state, "
      "where {:.2g} is allowed: its weights cancel. Fewer {} or a larger noise help, or leave `float` out",
      where, worst, largest_share, posterior_.values().inducing ? "inducing points" : "rows"));
}

}  // namespace gp2::c_export
