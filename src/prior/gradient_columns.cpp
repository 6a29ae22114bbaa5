#include "prior/gradient_columns.hpp"

#include <algorithm>
#include <cmath>

#include "prior/primitive.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

bool has_gradient(const Kernel& kernel) {
  return std::ranges::all_of(kernel.terms(), [](const Kernel::Term& term) {
    const Primitive primitive = term.factors.front().primitive;
    return term.factors.size() == 1 && (primitive == Primitive::se || primitive == Primitive::matern52 ||
                                        primitive == Primitive::rq || primitive == Primitive::linear);
  });
}

Map<const ArrayXd> GradientColumns::inverse_lengthscales(const Kernel::Term& term) const {
  return {columns_->scales().data() + term.factors.front().first_column, n_features()};
}

void GradientColumns::evaluate(Index first, Index n, const VectorXd& point, Workspace& w) const {
  const std::vector<Kernel::Term>& terms = columns_->kernel().terms();
  const Index D = n_features();
  w.terms.resize(terms.size());
  w.half_square.resize(n);
  for (std::size_t k = 0; k < terms.size(); ++k) {
    const Kernel::Factor& factor = terms[k].factors.front();
    Workspace::Term& term = w.terms[k];
    term.delta.resize(n, D);
    w.half_square.setZero();
    for (Index d = 0; d < D; ++d) {
      term.delta.col(d) =
          columns_->scaled().col(factor.first_column + d).segment(first, n).array() - point[factor.first_column + d];
      w.half_square += 0.5 * term.delta.col(d).square();
    }
    switch (factor.primitive) {
      case Primitive::matern52:  // k₁ = 5/3 (1 + √5 r) exp(−√5 r)
        w.base = (10 * w.half_square).sqrt();
        term.k3 = (-w.base).exp();
        term.k1 = 5.0 / 3.0 * (1 + w.base) * term.k3;
        term.k2 = -25.0 / 3.0 * term.k3;
        // without a value at r = 0, where what it multiplies is 0
        term.k3 = (w.base > 0).select(125.0 / 3.0 * term.k3 / w.base, 0.0);
        break;
      case Primitive::rq: {  // k₁ = (1 + s/α)^(−α−1)
        const double alpha = columns_->values()[factor.first_parameter + D];
        w.base = 1 + w.half_square / alpha;
        w.product = w.base.log();
        term.k1 = (-(alpha + 1) * w.product).exp();
        term.k2 = -(alpha + 1) / alpha * term.k1 / w.base;
        term.k3 = -(alpha + 2) / alpha * term.k2 / w.base;
        term.k1_alpha = term.k1 * ((alpha + 1) / alpha * w.half_square / w.base - alpha * w.product);
        term.k2_alpha = term.k2 * ((alpha + 2) / alpha * w.half_square / w.base - alpha * w.product - 1 / (alpha + 1));
        break;
      }
      case Primitive::linear:
        term.k1.setOnes(n);
        term.k2.setZero(n);
        term.k3.setZero(n);
        break;
      default:  // se
        term.k1 = (-w.half_square).exp();
        term.k2 = -term.k1;
        term.k3 = term.k1;
        break;
    }
    const double square = columns_->amplitude(terms[k]);
    if (square == 1) continue;
    for (ArrayXd* slope : {&term.k1, &term.k2, &term.k3}) *slope *= square;
    if (factor.primitive != Primitive::rq) continue;
    term.k1_alpha *= square;
    term.k2_alpha *= square;
  }
}

template <typename Visit>
void GradientColumns::for_each_term(const Workspace& w, const Visit& visit) const {
  const std::vector<Kernel::Term>& terms = columns_->kernel().terms();
  for (std::size_t k = 0; k < terms.size(); ++k) visit(terms[k], w.terms[k], inverse_lengthscales(terms[k]));
}

void GradientColumns::multiply(const Ref<const VectorXd>& loading, Workspace& w) const {
  const Index n = w.half_square.size(), D = n_features();
  w.out.setZero(n, D);
  for_each_term(w, [&](const Kernel::Term&, const Workspace::Term& term, const Map<const ArrayXd>& inverse) {
    // k₂ δᵀΛ^{1/2}ℓ
    w.along.setZero(n);
    for (Index d = 0; d < D; ++d) w.along += term.delta.col(d) * (inverse[d] * loading[d]);
    w.along *= term.k2;
    for (Index d = 0; d < D; ++d) {
      w.out.col(d) += inverse[d] * (term.k1 * (inverse[d] * loading[d]) + w.along * term.delta.col(d));
    }
  });
}

void GradientColumns::add_sums(const Ref<const MatrixXd>& beta, Ref<VectorXd> sums, Workspace& w) const {
  const Index n = w.half_square.size(), D = n_features();
  for_each_term(w, [&](const Kernel::Term&, const Workspace::Term& term, const Map<const ArrayXd>& inverse) {
    w.along.setZero(n);
    for (Index d = 0; d < D; ++d) w.along += term.delta.col(d) * beta.col(d).array() * inverse[d];
    w.along *= term.k2;
    for (Index d = 0; d < D; ++d) {
      sums[d] += inverse[d] * (term.k1 * beta.col(d).array() * inverse[d] + w.along * term.delta.col(d)).sum();
    }
  });
}

// With b = Λ^{1/2}β, t = δᵀb and δ = Λ^{1/2}(φ_i − φ'): the sums are Λ^{1/2}Σ(k₁b + k₂ t δ), and dδ = −Λ^{1/2}dφ', ds = −δᵀΛ^{1/2}dφ'.
void GradientColumns::add_derivative(const Ref<const MatrixXd>& beta, Ref<MatrixXd> derivative, Workspace& w) const {
  const Index n = w.half_square.size(), D = n_features();
  for_each_term(w, [&](const Kernel::Term&, const Workspace::Term& term, const Map<const ArrayXd>& inverse) {
    w.along.setZero(n);
    for (Index d = 0; d < D; ++d) w.along += term.delta.col(d) * beta.col(d).array() * inverse[d];
    const double trace = (term.k2 * w.along).sum();
    for (Index e = 0; e < D; ++e) {
      for (Index d = 0; d < D; ++d) {
        const double sum = (term.k2 * (term.delta.col(d) * beta.col(e).array() * inverse[e] +
                                       term.delta.col(e) * beta.col(d).array() * inverse[d]) +
                            term.k3 * w.along * term.delta.col(d) * term.delta.col(e))
                               .sum();
        derivative(d, e) -= inverse[d] * inverse[e] * (sum + (d == e ? trace : 0));
      }
    }
  });
}

// With u and z scaled by Λ^{1/2}: k₁ uᵀz + k₂ (uᵀδ)(zᵀδ). Each of u_d, z_d and δ_d goes with 1/ℓ_d, and ds/dlog ℓ_d = −δ_d².
void GradientColumns::add_gradient(const Ref<const MatrixXd>& u, const Ref<const VectorXd>& loading, Ref<VectorXd> gradient,
                                   Workspace& w) const {
  const Index n = w.half_square.size(), D = n_features();
  w.scaled.resize(n, D);
  for_each_term(w, [&](const Kernel::Term& of_kernel, const Workspace::Term& term, const Map<const ArrayXd>& inverse) {
    const Kernel::Factor& factor = of_kernel.factors.front();
    const ArrayXd z = inverse * loading.array();
    ArrayXd &u_delta = w.along, &z_delta = w.across, &u_z = w.product;
    u_delta.setZero(n);
    z_delta.setZero(n);
    u_z.setZero(n);
    for (Index d = 0; d < D; ++d) {
      w.scaled.col(d) = inverse[d] * u.col(d).array();
      u_delta += w.scaled.col(d) * term.delta.col(d);
      z_delta += z[d] * term.delta.col(d);
      u_z += z[d] * w.scaled.col(d);
    }
    for (Index d = 0; d < D; ++d) {
      const auto delta = term.delta.col(d);
      gradient[factor.first_parameter + d] -=
          (2 * term.k1 * w.scaled.col(d) * z[d] + 2 * term.k2 * delta * (w.scaled.col(d) * z_delta + u_delta * z[d]) +
           delta.square() * (term.k2 * u_z + term.k3 * u_delta * z_delta))
              .sum();
    }
    if (factor.primitive == Primitive::rq) {
      gradient[factor.first_parameter + D] += (term.k1_alpha * u_z + term.k2_alpha * u_delta * z_delta).sum();
    }
    if (of_kernel.amplitude >= 0) gradient[of_kernel.amplitude] += 2 * (term.k1 * u_z + term.k2 * u_delta * z_delta).sum();
  });
}

void GradientColumns::of_function(Workspace& w) const {
  w.out.setZero(w.half_square.size(), n_features());
  for_each_term(w, [&](const Kernel::Term&, const Workspace::Term& term, const Map<const ArrayXd>& inverse) {
    for (Index d = 0; d < n_features(); ++d) w.out.col(d) -= inverse[d] * term.k1 * term.delta.col(d);
  });
}

// 2 (k(0) − k(s))
double GradientColumns::variance_of_difference(const Ref<const VectorXd>& difference) const {
  double variance = 0;
  for (const Kernel::Term& term : columns_->kernel().terms()) {
    const double square = (inverse_lengthscales(term) * difference.array()).square().sum();
    const Kernel::Factor& factor = term.factors.front();
    double of_term = 0;
    switch (factor.primitive) {
      case Primitive::matern52: {
        const double r = std::sqrt(5 * square);
        of_term = -2 * (std::expm1(-r) + (r + square * (5.0 / 3.0)) * std::exp(-r));
        break;
      }
      case Primitive::rq: {
        const double alpha = columns_->values()[factor.first_parameter + n_features()];
        of_term = -2 * std::expm1(-alpha * std::log1p(square / (2 * alpha)));
        break;
      }
      case Primitive::linear:
        of_term = square;
        break;
      default:  // se
        of_term = -2 * std::expm1(-square / 2);
        break;
    }
    variance += columns_->amplitude(term) * of_term;
  }
  return variance;
}

VectorXd GradientColumns::variance() const {
  VectorXd variance = VectorXd::Zero(n_features());
  for (const Kernel::Term& term : columns_->kernel().terms()) {
    const double k1 = term.factors.front().primitive == Primitive::matern52 ? 5.0 / 3.0 : 1;
    variance.array() += columns_->amplitude(term) * k1 * inverse_lengthscales(term).square();
  }
  return variance;
}

}  // namespace gp2
