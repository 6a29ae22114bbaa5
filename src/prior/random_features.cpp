#include "prior/random_features.hpp"

#include <cmath>
#include <numbers>

#include "prior/primitive.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

namespace {

bool is_linear(const Kernel::Factor& factor) { return factor.primitive == Primitive::linear; }
bool has_spectrum(const Kernel::Factor& factor) { return !is_linear(factor) && factor.primitive != Primitive::constant; }

// every product of one entry of each φ∘(1/ℓ)
VectorXd monomials_at(const Ref<const VectorXd>& point, const std::vector<VectorXd>& inverse_lengthscale) {
  VectorXd monomials = VectorXd::Ones(1);
  for (const VectorXd& inverse : inverse_lengthscale) {
    monomials = (point.cwiseProduct(inverse) * monomials.transpose()).reshaped().eval();
  }
  return monomials;
}

// cos(2πt) and sin(2πt), to some ε, for the numbers t that stand in `cosines`. The loop vectorises: the C library's functions
// would take most of the time that a sample takes.
void cos_sin_of_turns(Ref<VectorXd> cosines, Ref<VectorXd> sines) {
  if (cosines.lpNorm<Eigen::Infinity>() > 0x1p50) {
    for (double& t : cosines) t = std::remainder(t, 1.0);
  }
  constexpr double nearest = 0x1.8p52;  // (t + nearest) − nearest is the integer nearest to t where |t| < 2⁵¹
  double *cosine = cosines.data(), *sine = sines.data();
  for (Index m = 0; m < cosines.size(); ++m) {
    // whole turns leave without error
    const double t = cosine[m], rest = t - ((t + nearest) - nearest);
    // the series of Taylor at a quarter of the angle, |h| ≤ π/4: the next terms are below ε/10
    const double h = (std::numbers::pi / 2) * rest, z = h * h;
    double c = 1, s = 1;
    for (int k = 16; k > 1; k -= 2) {
      c = 1 - z * (1.0 / (k * (k - 1))) * c;
      s = 1 - z * (1.0 / (k * (k + 1))) * s;
    }
    s *= h;
    // doubled twice
    const double s2 = 2 * s * c, c2 = 1 - 2 * s * s;
    cosine[m] = 1 - 2 * s2 * s2;
    sine[m] = 2 * s2 * c2;
  }
}

}  // namespace

RandomFeatures::RandomFeatures(const Kernel& kernel, const Ref<const VectorXd>& values, int n_features, RandomStream& random) {
  const Index n = kernel.n_features();
  for (const Kernel::Term& of_kernel : kernel.terms()) {
    Term& term = terms_.emplace_back();
    if (of_kernel.amplitude >= 0) term.scale = values[of_kernel.amplitude];
    bool is_exact = true;
    for (const Kernel::Factor& factor : of_kernel.factors) {
      is_exact = is_exact && !has_spectrum(factor);
      if (!is_linear(factor)) continue;
      term.inverse_lengthscale.emplace_back(values.segment(factor.first_parameter, n).cwiseInverse());
      term.n_monomials *= n;
    }
    if (is_exact) {
      size_ += static_cast<int>(term.n_monomials);
      continue;
    }

    // as many frequencies for each monomial, two features for each frequency
    const Index per_monomial = (n_features + 2 * term.n_monomials - 1) / (2 * term.n_monomials);
    term.frequencies.resize(per_monomial * term.n_monomials, n);
    for (Index m = 0; m < term.frequencies.rows(); ++m) {
      VectorXd frequency = VectorXd::Zero(n);
      for (const Kernel::Factor& factor : of_kernel.factors) {
        if (has_spectrum(factor)) add_frequency(factor.primitive, values.data() + factor.first_parameter, random, frequency);
      }
      term.frequencies.row(m) = frequency / (2 * std::numbers::pi);
    }
    term.scale /= std::sqrt(static_cast<double>(per_monomial));
    size_ += static_cast<int>(2 * term.frequencies.rows());
  }
}

void RandomFeatures::evaluate(const Ref<const VectorXd>& point, Ref<VectorXd> out) const {
  Index first = 0;
  for (const Term& term : terms_) {
    const VectorXd monomials = term.scale * monomials_at(point, term.inverse_lengthscale);
    const Index n = term.frequencies.rows();
    if (n == 0) {
      out.segment(first, term.n_monomials) = monomials;
      first += term.n_monomials;
      continue;
    }
    Ref<VectorXd> cosines = out.segment(first, n), sines = out.segment(first + n, n);
    cosines.noalias() = term.frequencies * point;
    const Index per_monomial = n / term.n_monomials;
    cos_sin_of_turns(cosines, sines);
    for (Index j = 0; j < term.n_monomials; ++j) {
      cosines.segment(j * per_monomial, per_monomial) *= monomials[j];
      sines.segment(j * per_monomial, per_monomial) *= monomials[j];
    }
    first += 2 * n;
  }
}

VectorXd RandomFeatures::gradient(const Ref<const VectorXd>& weights, const Ref<const VectorXd>& point) const {
  VectorXd gradient = VectorXd::Zero(point.size());
  Index first = 0;
  for (const Term& term : terms_) {
    const Index n = term.frequencies.rows();
    if (n == 0) {
      // the features of one linear factor are its monomials
      gradient += term.scale * weights.segment(first, term.n_monomials).cwiseProduct(term.inverse_lengthscale.front());
      first += term.n_monomials;
      continue;
    }
    VectorXd cosines = term.frequencies * point, sines(n);
    cos_sin_of_turns(cosines, sines);
    const VectorXd slopes = weights.segment(first + n, n).cwiseProduct(cosines) - weights.segment(first, n).cwiseProduct(sines);
    gradient += 2 * std::numbers::pi * term.scale * (term.frequencies.transpose() * slopes);
    first += 2 * n;
  }
  return gradient;
}

}  // namespace gp2
