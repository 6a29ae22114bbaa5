#include "inference/inducing_gram.hpp"

#include <algorithm>
#include <functional>
#include <utility>

#include "base/lapack.hpp"
#include "base/simd.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

bool InducingGram::factorise(const RowBlocks& rows) {
  std::optional<InducingStatistics> sums = InducingStatistics::of(latents_, rows, workers_, stop_);
  // what points leave out is never less than nothing: where it is, the signal is so far above the noise that rounding decides
  constexpr double tolerance = 0.01;  // nats
  if (!sums || sums->trace < -tolerance) return false;
  B_ = std::move(sums->B);
  B_.diagonal().array() += 1;
  L_ = B_;
  if (is_set(stop_) || !lapack::factorise(L_, {.stop = stop_})) return false;
  mean_ = std::move(sums->c);
  lapack::solve_factored(L_, mean_);
  log_det_half_ = L_.diagonal().array().log().sum();
  trace_ = sums->trace;
  constant_ = sums->constant;
  return true;
}

// ½(ỹᵀỹ − cᵀB⁻¹c) = ½(‖ỹ − ΨB⁻¹c‖² + ‖B⁻¹c‖²), of which nothing cancels
GramValue InducingGram::value_of(double misfit) const {
  return {0.5 * (misfit + mean_.squaredNorm()), log_det_half_ + 0.5 * trace_, constant_};
}

std::optional<GramValue> InducingGram::value(const RowBlocks& rows) {
  const lapack::SingleThread single_thread;
  if (!factorise(rows)) return std::nullopt;
  const std::optional<VectorSum> misfit = sum_over_blocks(
      latents_, rows, false, workers_, stop_, VectorSum{VectorXd::Zero(1)},
      [&](VectorSum& sum, int, const RowBlock&, const InducingBlock& block) { sum.sum[0] += block.misfit(mean_).squaredNorm(); });
  if (!misfit || is_set(stop_)) return std::nullopt;
  return value_of(misfit->sum[0]);
}

std::optional<GramValue> InducingGram::differentiate(const RowBlocks& rows, const std::vector<GramGradientParts>& parts,
                                                     GramGradient& gradient, const OfRows& of_rows) {
  const lapack::SingleThread single_thread;
  if (!factorise(rows)) return std::nullopt;
  const std::vector<InducingLatents::Function>& functions = latents_.functions();
  MatrixXd P = std::move(L_);  // B⁻¹
  lapack::invert_factored(P, {.stop = stop_});
  MatrixXd explained = -MatrixXd(P.selfadjointView<Eigen::Lower>());  // I − B⁻¹
  explained.diagonal().array() += 1;

  struct GradientSums {
    std::vector<MatrixXd> kernel;   // (lanes × parameters)
    std::vector<VectorXd> columns;  // (functions)
    double misfit = 0;

    void add(const GradientSums& other) {
      misfit += other.misfit;
      for (std::size_t a = 0; a < kernel.size(); ++a) {
        kernel[a] += other.kernel[a];
        columns[a] += other.columns[a];
      }
    }
    void for_each(const std::function<void(double*, Index)>& take) {
      take(&misfit, 1);
      for (MatrixXd& one : kernel) take(one.data(), one.size());
      for (VectorXd& one : columns) take(one.data(), one.size());
    }
  };
  GradientSums zero;
  for (const InducingLatents::OfLatent& latent : latents_.latents()) {
    zero.kernel.emplace_back(MatrixXd::Zero(simd::lanes<double>, latent.kernel.values().size()));
    zero.columns.emplace_back(VectorXd::Zero(latent.n_functions));
  }
  std::optional<GradientSums> all = sum_over_blocks(
      latents_, rows, true, workers_, stop_, zero,
      [&](GradientSums& sum, int piece, const RowBlock& row_block, const InducingBlock& block) {
        const Index n = block.n();
        const MatrixXd alpha = block.misfit(mean_);
        const Index n_components = alpha.cols();
        sum.misfit += alpha.squaredNorm();
        // per function −L_aᵀ ∂NLL/∂k(Z, φ_i), and V by component
        std::vector<MatrixXd> U, V;
        std::vector<VectorXd> mean;
        for (const InducingLatents::Function& f : functions) {
          const MatrixXd& w = block.w(f.latent);
          const std::size_t at = U.size();
          mean.emplace_back(w.transpose() * mean_.segment(f.first, w.rows()));
          ArrayXd beta = ArrayXd::Zero(n);
          V.emplace_back(n, n_components);
          for (Index c = 0; c < n_components; ++c) {
            const ArrayXd alpha_c = alpha.col(c).array(), weight = block.weight(at, c).array();
            beta += weight * alpha_c;
            V.back().col(c) = weight * block.variance(f.latent).array() - alpha_c * mean.back().array();
          }
          U.emplace_back(mean_.segment(f.first, w.rows()) * beta.matrix().transpose());
        }
        MatrixXd product;
        for (std::size_t g = 0; g < functions.size(); ++g) {
          const MatrixXd& w = block.w(functions[g].latent);
          product.setZero(latents_.size(), n);
          lapack::add_product(explained.middleCols(functions[g].first, w.rows()), false, w, false, product);
          for (std::size_t f = 0; f < functions.size(); ++f) {
            const MatrixXd& v = block.w(functions[f].latent);
            const auto of_f = product.middleRows(functions[f].first, v.rows());
            U[f] += of_f * block.weight_product(f, g).matrix().asDiagonal();
            const VectorXd explained_by_g = of_f.cwiseProduct(v).colwise().sum();
            for (Index c = 0; c < n_components; ++c) V[f].col(c) -= block.weight(g, c).cwiseProduct(explained_by_g);
          }
        }
        // from the units of the enlarged noise to those without it
        ArrayXd of_noise = block.rank().array() - (alpha.array() * block.y().array()).rowwise().sum();
        for (std::size_t f = 0; f < functions.size(); ++f) {
          for (Index c = 0; c < n_components; ++c) of_noise -= V[f].col(c).array() * block.weight(f, c).array();
        }
        for (std::size_t f = 0; f < functions.size(); ++f) {
          V[f].array().colwise() /= block.noise().array();
          if (!latents_.latent_of(functions[f]).is_local) continue;
          for (Index c = 0; c < n_components; ++c) V[f].col(c).array() += block.of_noise(f, c, of_noise);
        }
        const MatrixXd alpha_before = alpha.array().colwise() / block.noise().array();
        GramGradient of_block;
        of_block.alpha = in_rows(*block.rows().reduction, alpha_before);
        for (std::size_t a = 0; a < parts.size(); ++a) {
          const Index n_functions = latents_.latents()[a].n_functions;
          of_block.latents.push_back(
              {{}, {}, MatrixXd(parts[a].V ? n : 0, n_components * n_functions), MatrixXd(parts[a].mean ? n : 0, n_functions)});
        }
        for (std::size_t f = 0; f < functions.size(); ++f) {
          const std::size_t a = functions[f].latent;
          const InducingLatents::OfLatent& latent = latents_.latents()[a];
          const Index l = functions[f].index;
          GramGradient::OfLatent& out = of_block.latents[a];
          for (Index c = 0; c < n_components; ++c) {
            sum.columns[a][l] += V[f].col(c).dot(block.weight(f, c).cwiseProduct(block.noise()));
            if (parts[a].V) out.V.col(c * latent.n_functions + l) = V[f].col(c);
          }
          if (parts[a].mean) out.mean.col(l) = mean[f];
          if (l > 0) U[f - static_cast<std::size_t>(l)] += U[f];
        }
        for (std::size_t a = 0; a < parts.size(); ++a) {
          if (parts[a].mean && latents_.latents()[a].is_local) block.add_mean_of_noise(a, alpha_before, of_block.latents[a].mean);
        }
        of_rows(piece, row_block, of_block);
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
            latent.kernel.scale(block.rows().latents[a].kernel.features().row(i).transpose(), point);
            latent.kernel.add_gradient(0, H.rows(), point, block.k(a).col(i).data(), H.col(i).data(), sum.kernel[a], workspace);
          }
          add_variance_gradient(a, block, sum.kernel[a], workspace);
        }
      });
  if (!all || is_set(stop_)) return std::nullopt;

  gradient = {};
  for (std::size_t a = 0; a < parts.size(); ++a) {
    if (parts[a].kernel) add_points_gradient(a, P, all->kernel[a]);
    gradient.latents.push_back({all->kernel[a].colwise().sum().transpose(), all->columns[a], {}, {}});
  }
  return value_of(all->misfit);
}

// ½ Σ_i Σ_f ‖Γ_i,f‖² ∂k(φ_i, φ_i)/∂log v of a latent
void InducingGram::add_variance_gradient(std::size_t a, const InducingBlock& block, MatrixXd& sums,
                                         KernelColumns::Workspace& workspace) const {
  ArrayXd weights = ArrayXd::Zero(block.n());
  for (std::size_t f = 0; f < latents_.functions().size(); ++f) {
    if (latents_.functions()[f].latent == a) weights += block.weight_product(f, f);
  }
  const KernelColumns& kernel = block.rows().latents[a].kernel;
  VectorXd point, k(simd::lanes<double>), w = VectorXd::Zero(simd::lanes<double>);
  for (Index i = 0; i < block.n(); ++i) {
    const Index before = i - i % simd::lanes<double>;
    kernel.scale(i, point);
    kernel.evaluate(before, k.size(), point, k.data(), workspace);
    w[i - before] = 0.5 * (1 + smallest_pivot) * weights[i];
    kernel.add_gradient(before, k.size(), point, k.data(), w.data(), sums, workspace);
    w[i - before] = 0;
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

}  // namespace gp2
