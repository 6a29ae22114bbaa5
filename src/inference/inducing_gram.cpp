#include "inference/inducing_gram.hpp"

#include <algorithm>
#include <utility>

#include "base/lapack.hpp"
#include "base/simd.hpp"
#include "inference/dense_gram.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::unique_ptr<Gram> make_gram(const ModelValues& values, int n_threads, const std::atomic<bool>* stop) {
  if (values.inducing) return std::make_unique<InducingGram>(values.inducing, n_threads, stop);
  return std::make_unique<DenseGram>(n_threads, stop);
}

std::optional<GramValue> InducingGram::factorise(const LatentRows& rows) {
  const lapack::SingleThread single_thread;
  latents_ = InducingLatents(*points_, rows);
  InducingStatistics sums(latents_, rows, n_threads_, stop_);
  B_ = std::move(sums.B);
  B_.diagonal().array() += 1;
  L_ = B_;
  if (is_set(stop_) || !lapack::factorise(L_, {.stop = stop_})) return std::nullopt;
  mean_ = std::move(sums.c);
  lapack::solve_lower(L_, false, mean_);
  lapack::solve_lower(L_, true, mean_);
  // ½(ỹᵀỹ − cᵀB⁻¹c) = ½(‖ỹ − ΨB⁻¹c‖² + ‖B⁻¹c‖²), of which nothing cancels
  alpha_ = by_component(*rows.reduction, rows.reduction->y);
  for_each_block(latents_, rows, n_threads_, stop_, [&](std::size_t, const InducingBlock& block) {
    for (std::size_t f = 0; f < latents_.functions().size(); ++f) {
      const InducingLatents::Function& function = latents_.functions()[f];
      const auto w = block.w(function.latent);
      const VectorXd mean = w.transpose() * mean_.segment(function.first, w.rows());
      for (Index c = 0; c < alpha_.cols(); ++c) {
        alpha_.col(c).segment(block.first(), block.n()) -= block.weight(f, c).cwiseProduct(mean);
      }
    }
  });
  if (is_set(stop_)) return std::nullopt;
  return GramValue{0.5 * (alpha_.squaredNorm() + mean_.squaredNorm()), L_.diagonal().array().log().sum() + 0.5 * sums.trace};
}

VectorXd InducingGram::alpha(const Reduction& reduction) const {
  VectorXd alpha(reduction.size());
  for (std::size_t c = 0; c < reduction.count.size(); ++c) {
    alpha.segment(reduction.offset[c], reduction.count[c]) = alpha_.col(static_cast<Index>(c)).head(reduction.count[c]);
  }
  return alpha;
}

GramGradient InducingGram::differentiate(const LatentRows& rows, const std::vector<GramGradientParts>& parts) {
  const lapack::SingleThread single_thread;
  const Reduction& reduction = *rows.reduction;
  const std::vector<InducingLatents::Function>& functions = latents_.functions();
  const Index n_components = reduction.n_components();
  MatrixXd P = std::move(L_);  // B⁻¹
  lapack::invert_factored(P, {.stop = stop_});
  MatrixXd explained = -MatrixXd(P.selfadjointView<Eigen::Lower>());  // I − B⁻¹
  explained.diagonal().array() += 1;

  GramGradient gradient;
  gradient.alpha = alpha(reduction);
  struct Sums {
    std::vector<MatrixXd> kernel;   // (lanes × parameters)
    std::vector<VectorXd> columns;  // (functions)
  };
  Sums zero;
  for (std::size_t a = 0; a < rows.latents.size(); ++a) {
    const InducingLatents::OfLatent& latent = latents_.latents()[a];
    zero.kernel.emplace_back(MatrixXd::Zero(simd::lanes<double>, latent.kernel.values().size()));
    zero.columns.emplace_back(VectorXd::Zero(latent.n_functions));
    const Index n_rows = alpha_.rows();
    gradient.latents.push_back({{},
                                {},
                                MatrixXd::Zero(n_rows, parts[a].V ? n_components * latent.n_functions : 0),
                                MatrixXd::Zero(parts[a].mean ? n_rows : 0, latent.n_functions)});
  }

  std::vector<Sums> sums(n_block_parts, zero);
  for_each_block(latents_, rows, n_threads_, stop_, [&](std::size_t part, const InducingBlock& block) {
    const Index first = block.first(), n = block.n();
    // per function −L_aᵀ ∂NLL/∂k(Z, φ_i), and V by component
    std::vector<MatrixXd> U, V;
    std::vector<VectorXd> mean;
    for (const InducingLatents::Function& f : functions) {
      const auto w = block.w(f.latent);
      const std::size_t at = U.size();
      mean.emplace_back(w.transpose() * mean_.segment(f.first, w.rows()));
      ArrayXd beta = ArrayXd::Zero(n);
      V.emplace_back(n, n_components);
      for (Index c = 0; c < n_components; ++c) {
        const ArrayXd alpha = alpha_.col(c).segment(first, n).array(), weight = block.weight(at, c).array();
        beta += weight * alpha;
        V.back().col(c) = weight * block.variance(f.latent).array() - alpha * mean.back().array();
      }
      U.emplace_back(mean_.segment(f.first, w.rows()) * beta.matrix().transpose());
    }
    MatrixXd product;
    for (std::size_t g = 0; g < functions.size(); ++g) {
      const auto w = block.w(functions[g].latent);
      product.setZero(latents_.size(), n);
      lapack::add_product(explained.middleCols(functions[g].first, w.rows()), false, w, false, product);
      for (std::size_t f = 0; f < functions.size(); ++f) {
        const auto v = block.w(functions[f].latent);
        const auto of_f = product.middleRows(functions[f].first, v.rows());
        U[f] += of_f * block.weight_product(f, g).matrix().asDiagonal();
        const VectorXd explained_by_g = of_f.cwiseProduct(v).colwise().sum();
        for (Index c = 0; c < n_components; ++c) V[f].col(c) -= block.weight(g, c).cwiseProduct(explained_by_g);
      }
    }
    for (std::size_t f = 0; f < functions.size(); ++f) {
      const std::size_t a = functions[f].latent;
      const InducingLatents::OfLatent& latent = latents_.latents()[a];
      const Index l = functions[f].index;
      GramGradient::OfLatent& out = gradient.latents[a];
      for (Index c = 0; c < n_components; ++c) {
        sums[part].columns[a][l] += V[f].col(c).dot(block.weight(f, c));
        if (parts[a].V) out.V.col(c * latent.n_functions + l).segment(first, n) = V[f].col(c);
      }
      if (parts[a].mean) out.mean.col(l).segment(first, n) = mean[f];
      if (l > 0) U[f - static_cast<std::size_t>(l)] += U[f];
    }
    KernelColumns::Workspace workspace;
    VectorXd point;
    for (std::size_t f = 0; f < functions.size(); ++f) {
      const std::size_t a = functions[f].latent;
      if (functions[f].index > 0 || !parts[a].kernel) continue;
      const InducingLatents::OfLatent& latent = latents_.latents()[a];
      lapack::solve_lower(latent.L, true, U[f]);
      MatrixXd H = MatrixXd::Zero(latent.kernel.n_rows(), n);
      H.topRows(latent.n_points()) = -U[f];
      for (Index i = 0; i < n; ++i) {
        latent.kernel.scale(rows.latents[a].kernel.features().row(first + i).transpose(), point);
        latent.kernel.add_gradient(0, H.rows(), point, block.k(a).col(i).data(), H.col(i).data(), sums[part].kernel[a],
                                   workspace);
      }
      add_variance_gradient(rows, a, block, sums[part].kernel[a], workspace);
    }
  });

  for (std::size_t a = 0; a < rows.latents.size(); ++a) {
    for (std::size_t part = 1; part < sums.size(); ++part) {
      sums[0].kernel[a] += sums[part].kernel[a];
      sums[0].columns[a] += sums[part].columns[a];
    }
    gradient.latents[a].columns = sums[0].columns[a];
    if (parts[a].kernel) add_points_gradient(a, P, sums[0].kernel[a]);
    gradient.latents[a].kernel = sums[0].kernel[a].colwise().sum().transpose();
  }
  return gradient;
}

// ½ Σ_i Σ_f ‖Γ_i,f‖² ∂k(φ_i, φ_i)/∂log v of a latent
void InducingGram::add_variance_gradient(const LatentRows& rows, std::size_t a, const InducingBlock& block, MatrixXd& sums,
                                         KernelColumns::Workspace& workspace) const {
  ArrayXd weights = ArrayXd::Zero(block.n());
  for (std::size_t f = 0; f < latents_.functions().size(); ++f) {
    if (latents_.functions()[f].latent == a) weights += block.weight_product(f, f);
  }
  const KernelColumns& kernel = rows.latents[a].kernel;
  VectorXd point, k(simd::lanes<double>), w = VectorXd::Zero(simd::lanes<double>);
  for (Index i = 0; i < block.n(); ++i) {
    const Index sample = block.first() + i, before = sample - sample % simd::lanes<double>;
    kernel.scale(sample, point);
    kernel.evaluate(before, k.size(), point, k.data(), workspace);
    w[sample - before] = 0.5 * (1 + smallest_pivot) * weights[i];
    kernel.add_gradient(before, k.size(), point, k.data(), w.data(), sums, workspace);
    w[sample - before] = 0;
  }
}

// ∂NLL/∂k_a(Z, Z) = −½ Σ_f L⁻ᵀ(2I − B⁻¹ − B − B⁻¹c(B⁻¹c)ᵀ)_ff L⁻¹, to each ∂k/∂log v
void InducingGram::add_points_gradient(std::size_t a, const MatrixXd& P, MatrixXd& sums) const {
  const InducingLatents::OfLatent& latent = latents_.latents()[a];
  const Index m = latent.n_points();
  MatrixXd of_points = MatrixXd::Zero(m, m);
  for (const InducingLatents::Function& f : latents_.functions()) {
    if (f.latent != a) continue;
    const auto mean = mean_.segment(f.first, m);
    MatrixXd block = P.block(f.first, f.first, m, m) + B_.block(f.first, f.first, m, m) + mean * mean.transpose();
    block.diagonal().array() -= 2;
    of_points += 0.5 * MatrixXd(block.selfadjointView<Eigen::Lower>());
  }
  lapack::solve_lower(latent.L, true, of_points);
  of_points.transposeInPlace();
  lapack::solve_lower(latent.L, true, of_points);
  MatrixXd weights = MatrixXd::Zero(latent.kernel.n_rows(), m);
  weights.topRows(m) = of_points;
  KernelColumns::Workspace workspace;
  VectorXd point, k(weights.rows());
  for (Index j = 0; j < m; ++j) {
    latent.kernel.scale(j, point);
    latent.kernel.evaluate(0, k.size(), point, k.data(), workspace);
    latent.kernel.add_gradient(0, k.size(), point, k.data(), weights.col(j).data(), sums, workspace);
  }
}

MatrixXd InducingGram::loadings(const InducingBlock& block, Index component) const {
  MatrixXd Psi(latents_.size(), block.n());
  for (std::size_t f = 0; f < latents_.functions().size(); ++f) {
    const InducingLatents::Function& function = latents_.functions()[f];
    const auto w = block.w(function.latent);
    Psi.middleRows(function.first, w.rows()) = w * block.weight(f, component).asDiagonal();
  }
  return Psi;
}

// With P = I − Ψ B⁻¹Ψᵀ the inverse of a set is P_BB⁻¹ = I + Ψ_B B₋⁻¹Ψ_Bᵀ, and P_BB⁻¹α̃_B = ỹ_B − Ψ_B B₋⁻¹c₋, where B₋ and c₋ are of
// all other samples: sums of what each set says, so that nothing is taken from anything.
Gram::Inverse InducingGram::invert(const LatentRows& rows, const std::vector<std::vector<Index>>& sets) {
  const lapack::SingleThread single_thread;
  const Reduction& reduction = *rows.reduction;
  const Index n_samples = rows.n_samples(), n_components = reduction.n_components();
  const MatrixXd y = by_component(reduction, reduction.y);
  const std::size_t n_sets = sets.size();
  std::vector<std::size_t> set_of(static_cast<std::size_t>(n_samples), n_sets), place_of(set_of.size(), 0);
  for (std::size_t k = 0; k < n_sets; ++k) {
    for (std::size_t place = 0; place < sets[k].size(); ++place) {
      set_of[static_cast<std::size_t>(sets[k][place])] = k;
      place_of[static_cast<std::size_t>(sets[k][place])] = place;
    }
  }
  const auto members = [&](const InducingBlock& block, std::size_t set) {
    ArrayXd is_member(block.n());
    for (Index i = 0; i < block.n(); ++i) is_member[i] = set_of[static_cast<std::size_t>(block.first() + i)] == set ? 1 : 0;
    return is_member;
  };

  // the factor of B and the mean without each set
  struct Others {
    MatrixXd L;
    VectorXd mean;
  };
  std::vector<Others> others;
  if (n_sets > 0) {
    std::vector<InducingStatistics> said(n_sets + 1, InducingStatistics(latents_));
    MatrixXd memory;
    for_each_block(latents_, rows, 1, stop_, [&](std::size_t, const InducingBlock& block) {
      for (std::size_t k = 0; k <= n_sets; ++k) {
        const ArrayXd share = members(block, k);
        if ((share > 0).any()) said[k].add(latents_, block, y, share, memory);
      }
    });
    for (std::size_t k = 0; k < n_sets; ++k) {
      InducingStatistics of_others(latents_);
      for (std::size_t other = 0; other <= n_sets; ++other) {
        if (other != k) of_others.add(said[other]);
      }
      of_others.B.diagonal().array() += 1;
      if (!lapack::factorise(of_others.B, {.stop = stop_})) return {alpha(reduction), {}, {}};
      lapack::solve_lower(of_others.B, false, of_others.c);
      lapack::solve_lower(of_others.B, true, of_others.c);
      others.push_back({std::move(of_others.B), std::move(of_others.c)});
    }
  }

  Inverse inverse{alpha(reduction), std::vector<MatrixXd>(set_of.size()), std::vector<WithoutSet>(n_sets)};
  for (std::size_t k = 0; k < n_sets; ++k) {
    inverse.without[k].pull.resize(sets[k].size());
    inverse.without[k].covariance.resize(sets[k].size());
  }
  const auto rank_of = [&](Index sample) { return reduction.samples[static_cast<std::size_t>(sample)].R.rows(); };
  // I ± Ψ_i(LLᵀ)⁻¹Ψ_iᵀ
  const auto block_of = [&](const std::vector<MatrixXd>& half, Index i, Index rank, double sign) {
    MatrixXd square = MatrixXd::Identity(rank, rank);
    for (Index c = 0; c < rank; ++c) {
      for (Index d = 0; d < rank; ++d)
        square(c, d) += sign * half[static_cast<std::size_t>(c)].col(i).dot(half[static_cast<std::size_t>(d)].col(i));
    }
    return square;
  };
  for_each_block(latents_, rows, n_threads_, stop_, [&](std::size_t, const InducingBlock& block) {
    std::vector<MatrixXd> Psi;
    for (Index c = 0; c < n_components; ++c) Psi.push_back(loadings(block, c));
    const auto halves = [&](const MatrixXd& L) {
      std::vector<MatrixXd> half = Psi;
      for (MatrixXd& one : half) lapack::solve_lower(L, false, one);
      return half;
    };
    const std::vector<MatrixXd> half = halves(L_);
    for (Index i = 0; i < block.n(); ++i) {
      const Index sample = block.first() + i;
      inverse.blocks[static_cast<std::size_t>(sample)] = block_of(half, i, rank_of(sample), -1);
    }
    for (std::size_t k = 0; k < n_sets; ++k) {
      const ArrayXd is_member = members(block, k);
      if ((is_member == 0).all()) continue;
      const std::vector<MatrixXd> of_others = halves(others[k].L);
      for (Index i = 0; i < block.n(); ++i) {
        if (is_member[i] == 0) continue;
        const Index sample = block.first() + i, rank = rank_of(sample);
        const std::size_t place = place_of[static_cast<std::size_t>(sample)];
        VectorXd& pull = inverse.without[k].pull[place] = y.row(sample).head(rank);
        for (Index c = 0; c < rank; ++c) pull[c] -= Psi[static_cast<std::size_t>(c)].col(i).dot(others[k].mean);
        inverse.without[k].covariance[place] = block_of(of_others, i, rank, 1);
      }
    }
  });
  return inverse;
}

std::unique_ptr<LatentPosterior> InducingGram::condition(const LatentRows& rows) const {
  const lapack::SingleThread single_thread;
  InducingLatents latents(*points_, rows);
  InducingStatistics statistics(latents, rows, n_threads_, stop_);
  auto posterior = std::make_unique<InducingPosterior>(std::move(latents), std::move(statistics));
  if (!posterior->factorise()) return nullptr;
  return posterior;
}

}  // namespace gp2
