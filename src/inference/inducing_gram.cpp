#include "inference/inducing_gram.hpp"

#include <algorithm>
#include <functional>
#include <span>
#include <utility>

#include "base/lapack.hpp"
#include "base/simd.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

/// Gradients of covariances of a potential's variables with its derivatives at a point.
class PotentialGradient {
 public:
  explicit PotentialGradient(const InducingLatents::OfLatent& latent)
      : latent_(latent), columns_(latent.kernel), weights_(latent.n_points(), latent.n_functions) {}

  void move_to(const VectorXd& point) { columns_.evaluate(0, latent_.n_points(), point, workspace_); }
  /// Adds uᵀ ∂cov(variables, ∂_d V)/∂log v.
  void add(Index d, const Eigen::Ref<const VectorXd>& u, MatrixXd& sums) {
    weights_.setZero();
    weights_.reshaped()(latent_.chosen) = u;
    VectorXd sum = VectorXd::Zero(sums.cols());
    columns_.add_gradient(weights_, VectorXd::Unit(latent_.n_functions, d), sum, workspace_);
    sums.row(0) += sum;
  }

 private:
  const InducingLatents::OfLatent& latent_;
  GradientColumns columns_;
  GradientColumns::Workspace workspace_;
  MatrixXd weights_;
};

// Adds `weight` times the derivatives of the variance of ∂_d V, which is the same at every point.
void add_gradient_of_variance(const KernelColumns& kernel, Index d, double weight, MatrixXd& sums) {
  const Index D = kernel.kernel().n_features();
  const GradientColumns columns(kernel);
  GradientColumns::Workspace workspace;
  VectorXd point, sum = VectorXd::Zero(sums.cols());
  kernel.scale(0, point);
  columns.evaluate(0, 1, point, workspace);
  columns.add_gradient(weight * MatrixXd::Identity(D, D).row(d), VectorXd::Unit(D, d), sum, workspace);
  sums.row(0) += sum;
}

/// What the bound's derivatives by covariances of one block of rows with the variables are made of, in memory that the next block
/// uses again.
struct BlockDerivatives {
  MatrixXd alpha;              // the misfit  (n × components)
  std::vector<MatrixXd> U;     // per cross: L_aᵀ ∂NLL/∂k(Z, φ_i)  (variables, padded as k is × n)
  std::vector<MatrixXd> V;     // per function (n × components)
  std::vector<VectorXd> mean;  // per function (n)
  MatrixXd product;

  /// @param mean_of_variables  B⁻¹c
  /// @param explained          in_pairs(I − B⁻¹)
  void move_to(const InducingLatents& latents, const InducingBlock& block, const VectorXd& mean_of_variables,
               const MatrixXd& explained) {
    const std::vector<InducingLatents::Function>& functions = latents.functions();
    const Index n = block.n();
    alpha = block.misfit(mean_of_variables);
    const Index n_components = alpha.cols();
    U.resize(latents.n_crosses());
    V.resize(functions.size());
    mean.resize(functions.size());
    for (std::size_t f = 0; f < functions.size(); ++f) {
      const MatrixXd& w = block.w(f);
      const InducingLatents::OfLatent& latent = latents.latent_of(functions[f]);
      const auto mean_of_f = mean_of_variables.segment(functions[f].first, w.rows());
      mean[f].noalias() = w.transpose() * mean_of_f;
      ArrayXd beta = ArrayXd::Zero(n);
      V[f].resize(n, n_components);
      for (Index c = 0; c < n_components; ++c) {
        const ArrayXd alpha_c = alpha.col(c).array(), weight = block.weight(f, c).array();
        beta += weight * alpha_c;
        V[f].col(c) = weight * block.variance(f).array() - alpha_c * mean[f].array();
      }
      MatrixXd& u = U[functions[f].cross];
      if (f == 0 || functions[f - 1].cross != functions[f].cross)
        u.setZero(latent.is_potential ? w.rows() : latent.kernel.n_rows(), n);
      u.topRows(w.rows()).noalias() -= mean_of_f * beta.matrix().transpose();
    }
    product.resize(latents.size(), n);
    for (std::size_t g = 0; g < functions.size(); ++g) {
      const MatrixXd& w = block.w(g);
      const auto add_rows = [&](Index first, Index end) {
        auto rows = product.middleRows(first, end - first);
        rows.setZero();
        lapack::add_product(explained.block(first, functions[g].first, end - first, w.rows()), false, w, false, rows);
      };
      const auto next_latent = std::ranges::find_if(functions, [&](const auto& f) { return f.latent > functions[g].latent; });
      add_rows(0, functions[g].first + w.rows());
      if (next_latent != functions.end()) add_rows(next_latent->first, latents.size());
      for (std::size_t f = 0; f < functions.size(); ++f) {
        const bool is_pair = f != g && functions[f].cross == functions[g].cross;
        if (is_pair && f > g) continue;
        const MatrixXd& v = block.w(f);
        const auto of_f = product.middleRows(functions[f].first, v.rows());
        U[functions[f].cross].topRows(v.rows()) -= of_f * block.weight_product(f, g).matrix().asDiagonal();
        VectorXd explained_by_g = of_f.cwiseProduct(v).colwise().sum();
        if (is_pair) explained_by_g *= 0.5;
        for (Index c = 0; c < n_components; ++c) {
          V[f].col(c) -= block.weight(g, c).cwiseProduct(explained_by_g);
          if (is_pair) V[g].col(c) -= block.weight(f, c).cwiseProduct(explained_by_g);
        }
      }
    }
  }
};

// Two functions f < g with the same w need E_fg w and E_gf w = E_fgᵀ w in the same sums: E_fg + E_fgᵀ in the place of E_fg.
MatrixXd in_pairs(const InducingLatents& latents, MatrixXd E) {
  const std::vector<InducingLatents::Function>& functions = latents.functions();
  for (std::size_t g = 0; g < functions.size(); ++g) {
    const Index m = latents.latent_of(functions[g]).n_variables();
    for (std::size_t f = 0; f < g; ++f) {
      if (functions[f].cross != functions[g].cross) continue;
      auto pair = E.block(functions[f].first, functions[g].first, m, m);
      pair += pair.transpose().eval();
    }
  }
  return E;
}

/// Sums over rows of which the gradient consists.
struct GradientSums {
  std::vector<MatrixXd> kernel;   // (lanes × parameters)
  std::vector<VectorXd> columns;  // (functions)
  double misfit = 0;
  BlockDerivatives memory = {};

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

/// V from the units of the enlarged noise to those without it.
void without_enlarged_noise(const InducingLatents& latents, const InducingBlock& block, BlockDerivatives& of) {
  const Index n_components = of.alpha.cols();
  ArrayXd of_noise = block.rank().array() - (of.alpha.array() * block.y().array()).rowwise().sum();
  for (std::size_t f = 0; f < of.V.size(); ++f) {
    for (Index c = 0; c < n_components; ++c) of_noise -= of.V[f].col(c).array() * block.weight(f, c).array();
  }
  for (std::size_t f = 0; f < of.V.size(); ++f) {
    of.V[f].array().colwise() /= block.noise().array();
    if (!latents.latent_of(latents.functions()[f]).is_local) continue;
    for (Index c = 0; c < n_components; ++c) of.V[f].col(c).array() += block.of_noise(f, c, of_noise);
  }
}

}  // namespace

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
  explained = in_pairs(latents_, std::move(explained));

  GradientSums zero;
  for (const InducingLatents::OfLatent& latent : latents_.latents()) {
    zero.kernel.emplace_back(MatrixXd::Zero(simd::lanes<double>, latent.kernel.values().size()));
    zero.columns.emplace_back(VectorXd::Zero(latent.n_functions));
  }
  std::optional<GradientSums> all = sum_over_blocks(
      latents_, rows, true, workers_, stop_, zero,
      [&](GradientSums& sum, int piece, const RowBlock& row_block, const InducingBlock& block) {
        const Index n = block.n();
        BlockDerivatives& of = sum.memory;
        of.move_to(latents_, block, mean_, explained);
        const Index n_components = of.alpha.cols();
        sum.misfit += of.alpha.squaredNorm();
        without_enlarged_noise(latents_, block, of);
        const MatrixXd alpha_before = of.alpha.array().colwise() / block.noise().array();
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
            sum.columns[a][l] += of.V[f].col(c).dot(block.weight(f, c).cwiseProduct(block.noise()));
            if (parts[a].V) out.V.col(c * latent.n_functions + l) = of.V[f].col(c);
          }
          if (parts[a].mean) out.mean.col(l) = of.mean[f];
        }
        for (std::size_t a = 0; a < parts.size(); ++a) {
          if (parts[a].mean && latents_.latents()[a].is_local) block.add_mean_of_noise(a, alpha_before, of_block.latents[a].mean);
        }
        of_rows(piece, row_block, of_block);
        for (std::size_t a = 0; a < parts.size(); ++a) {
          if (!parts[a].kernel) continue;
          const InducingLatents::OfLatent& latent = latents_.latents()[a];
          add_cross_gradient(a, block, std::span(of.U).subspan(latent.first_cross, latent.n_crosses()), sum.kernel[a]);
          add_variance_gradient(a, block, sum.kernel[a]);
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

void InducingGram::add_cross_gradient(std::size_t a, const InducingBlock& block, std::span<MatrixXd> U, MatrixXd& sums) const {
  const InducingLatents::OfLatent& latent = latents_.latents()[a];
  const MatrixXd& features = block.rows().latents[a].kernel.features();
  for (MatrixXd& of_cross : U) lapack::solve_lower(latent.L, true, of_cross.topRows(latent.n_variables()));
  VectorXd point;
  if (!latent.is_potential) {
    KernelColumns::Workspace workspace;
    for (Index i = 0; i < block.n(); ++i) {
      latent.kernel.scale(features.row(i).transpose(), point);
      latent.kernel.add_gradient(0, U[0].rows(), point, block.k(a).col(i).data(), U[0].col(i).data(), sums, workspace);
    }
    return;
  }
  PotentialGradient gradient(latent);
  for (Index i = 0; i < block.n(); ++i) {
    latent.kernel.scale(features.row(i).transpose(), point);
    gradient.move_to(point);
    for (std::size_t d = 0; d < U.size(); ++d) gradient.add(static_cast<Index>(d), U[d].col(i), sums);
  }
}

// ½ Σ_i Σ_f ‖Γ_i,f‖² ∂k(φ_i, φ_i)/∂log v of a latent
void InducingGram::add_variance_gradient(std::size_t a, const InducingBlock& block, MatrixXd& sums) const {
  const KernelColumns& kernel = block.rows().latents[a].kernel;
  KernelColumns::Workspace workspace;
  ArrayXd weights = ArrayXd::Zero(block.n());
  for (std::size_t f = 0; f < latents_.functions().size(); ++f) {
    if (latents_.functions()[f].latent != a) continue;
    if (latents_.latents()[a].is_potential) {
      const double weight = 0.5 * (1 + smallest_pivot) * block.weight_product(f, f).sum();
      add_gradient_of_variance(kernel, latents_.functions()[f].index, weight, sums);
      continue;
    }
    weights += block.weight_product(f, f);
  }
  if (latents_.latents()[a].is_potential) return;
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
  const Index m = latent.n_variables();
  MatrixXd of_points = MatrixXd::Zero(m, m);
  for (const InducingLatents::Function& f : latents_.functions()) {
    if (f.latent != a || (latent.is_potential && f.index > 0)) continue;
    const auto mean = mean_.segment(f.first, m);
    MatrixXd block = P.block(f.first, f.first, m, m) + B_.block(f.first, f.first, m, m) + mean * mean.transpose();
    block.diagonal().array() -= 2;
    of_points += 0.5 * MatrixXd(block.selfadjointView<Eigen::Lower>());
  }
  lapack::solve_lower(latent.L, true, of_points);
  of_points.transposeInPlace();
  lapack::solve_lower(latent.L, true, of_points);
  VectorXd point;
  if (latent.is_potential) {
    PotentialGradient gradient(latent);
    for (Index j = 0; j < m; ++j) {
      const auto [d, at] = latent.derivative_at(j);
      latent.kernel.scale(at, point);
      gradient.move_to(point);
      gradient.add(d, of_points.col(j), sums);
    }
    return;
  }
  MatrixXd weights = MatrixXd::Zero(latent.kernel.n_rows(), m);
  weights.topRows(m) = of_points;
  KernelColumns::Workspace workspace;
  VectorXd k(weights.rows());
  for (Index j = 0; j < m; ++j) {
    latent.kernel.scale(j, point);
    latent.kernel.evaluate(0, k.size(), point, k.data(), workspace);
    latent.kernel.add_gradient(0, k.size(), point, k.data(), weights.col(j).data(), sums, workspace);
  }
}

}  // namespace gp2
