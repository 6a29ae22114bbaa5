#include "inference/inducing_latents.hpp"

#include <algorithm>
#include <functional>

#include <Eigen/Cholesky>

#include "base/lapack.hpp"
#include "base/simd.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

std::vector<lapack::PivotedFactor> factors_of(const Prior& prior, const ModelValues& values) {
  std::vector<lapack::PivotedFactor> factors;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const MatrixXd& Z = values.inducing->features[a];
    lapack::PivotedFactor& factor = factors.emplace_back(
        lapack::factorise_semidefinite(prior.latents[a].kernel.evaluate(Z, Z, values.kernel[a]), smallest_pivot));
    factor.rows.resize(static_cast<std::size_t>(factor.L.cols()));
    factor.L = factor.L.topRows(factor.L.cols()).eval();
  }
  return factors;
}

}  // namespace

InducingLatents::InducingLatents(const Prior& prior, const ModelValues& values)
    : InducingLatents(prior, values, factors_of(prior, values)) {}

InducingLatents::InducingLatents(const Prior& prior, const ModelValues& values, std::vector<lapack::PivotedFactor> factors) {
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const MatrixXd Z = values.inducing->features[a](factors[a].rows, Eigen::all);
    OfLatent& latent = latents_.emplace_back(OfLatent{
        KernelColumns(prior.latents[a].kernel, Z, values.kernel[a]), std::move(factors[a].L), std::move(factors[a].rows),
        values.loading(a).cols(), prior.latents[a].kernel_is_fixed && prior.latents[a].base == Latent::Base::admissible});
    for (Index l = 0; l < latent.n_functions; ++l, size_ += latent.n_points()) functions_.push_back({a, l, size_});
  }
}

void InducingLatents::solve(bool transposed, Ref<MatrixXd> c) const {
  for (const Function& function : functions_) {
    const OfLatent& latent = latent_of(function);
    lapack::solve_lower(latent.L, transposed, c.middleRows(function.first, latent.n_points()));
  }
}

std::vector<MatrixXd> InducingLatents::at(const std::vector<MatrixXd>& features, const Ref<const VectorXd>& m) const {
  std::vector<MatrixXd> f;
  VectorXd point;
  KernelColumns::Workspace workspace;
  Index first = 0;
  for (std::size_t a = 0; a < latents_.size(); ++a) {
    const OfLatent& latent = latents_[a];
    MatrixXd k(latent.kernel.n_rows(), features[a].rows());
    for (Index i = 0; i < k.cols(); ++i) {
      latent.kernel.scale(features[a].row(i).transpose(), point);
      latent.kernel.evaluate(0, k.rows(), point, k.col(i).data(), workspace);
    }
    MatrixXd w = k.topRows(latent.n_points());
    lapack::solve_lower(latent.L, false, w);
    const Index n_variables = latent.n_points() * latent.n_functions;
    f.emplace_back(m.segment(first, n_variables).reshaped(latent.n_points(), latent.n_functions).transpose() * w);
    first += n_variables;
  }
  return f;
}

InducingBlock::InducingBlock(const InducingLatents& latents)
    : latents_(&latents), k_(latents.latents().size()), w_(k_.size()), variance_(k_.size()), left_(k_.size()) {}

void InducingBlock::move_to(const LatentRows& rows) {
  rows_ = &rows;
  y_ = by_component(*rows.reduction, rows.reduction->y);
  for (std::size_t a = 0; a < k_.size(); ++a) {
    const InducingLatents::OfLatent& latent = latents_->latents()[a];
    const MatrixXd& features = rows.latents[a].kernel.features();
    k_[a].resize(latent.kernel.n_rows(), n());
    variance_[a].resize(n());
    for (Index i = 0; i < n(); ++i) {
      latent.kernel.scale(features.row(i).transpose(), point_);
      latent.kernel.evaluate(0, k_[a].rows(), point_, k_[a].col(i).data(), workspace_);
      variance_[a][i] = (1 + smallest_pivot) * latent.kernel.variance(point_);
    }
    w_[a] = k_[a].topRows(latent.n_points());
    lapack::solve_lower(latent.L, false, w_[a]);
  }
  add_noise();
}

// s_i² = 1 + Σ_a (k_a(φ_i, φ_i) − ‖w_i,a‖²) ‖Γ_i,a‖²/r_i over the local latents
void InducingBlock::add_noise() {
  rank_.resize(n());
  for (Index i = 0; i < n(); ++i) rank_[i] = static_cast<double>(rows_->reduction->samples[static_cast<std::size_t>(i)].R.rows());
  noise_.setOnes(n());
  for (std::size_t a = 0; a < left_.size(); ++a) {
    if (!latents_->latents()[a].is_local) continue;
    const VectorXd held = w_[a].colwise().squaredNorm();
    left_[a] = (variance_[a] - held).cwiseMax(0);
    variance_[a] = held;
    noise_.array() += left_[a] * rows_->latents[a].Z.topRows(n()).rowwise().squaredNorm().array() / rank_.array().max(1);
  }
  noise_ = noise_.cwiseSqrt();
  y_.topRows(n()).array().colwise() /= noise_.array();
}

ArrayXd InducingBlock::of_noise(std::size_t f, Index component, const ArrayXd& slope) const {
  // ∂log s/∂Γ = (k − ‖w‖²) Γ/(r s²), Γ in units of the noise without it
  return slope * left_[latents_->functions()[f].latent] * weight(f, component).array() / (rank_.array().max(1) * noise_.array());
}

void InducingBlock::add_mean_of_noise(std::size_t a, const MatrixXd& alpha, MatrixXd& mean) const {
  const LatentRows::OfLatent& latent = rows_->latents[a];
  MatrixXd Gamma;
  for (Index i = 0; i < n(); ++i) {
    const auto rank = static_cast<Index>(rank_[i]);
    if (rank == 0) continue;  // the constraint decides all that is measured
    Gamma.resize(rank, latent.n_functions);
    for (Index c = 0; c < rank; ++c) Gamma.row(c) = latent.Z.row(i).segment(c * latent.n_functions, latent.n_functions);
    const VectorXd of_noise = (noise_[i] * noise_[i] - 1) * alpha.row(i).head(rank);
    mean.row(i).transpose() += Gamma.transpose() * (Gamma * Gamma.transpose()).ldlt().solve(of_noise);
  }
}

ArrayXd InducingBlock::weight_product(std::size_t f, std::size_t g) const {
  ArrayXd sum = ArrayXd::Zero(n());
  for (Index c = 0; c < y_.cols(); ++c) sum += weight(f, c).array() * weight(g, c).array();
  return sum;
}

MatrixXd InducingBlock::loadings(Index component) const {
  MatrixXd Psi(latents_->size(), n());
  for (std::size_t f = 0; f < latents_->functions().size(); ++f) {
    const InducingLatents::Function& function = latents_->functions()[f];
    const MatrixXd& w = w_[function.latent];
    Psi.middleRows(function.first, w.rows()) = w * weight(f, component).asDiagonal();
  }
  return Psi;
}

MatrixXd InducingBlock::misfit(const Ref<const VectorXd>& m) const {
  MatrixXd misfit = y();
  for (std::size_t f = 0; f < latents_->functions().size(); ++f) {
    const InducingLatents::Function& function = latents_->functions()[f];
    const MatrixXd& w = w_[function.latent];
    const VectorXd mean = w.transpose() * m.segment(function.first, w.rows());
    for (Index c = 0; c < misfit.cols(); ++c) misfit.col(c) -= weight(f, c).cwiseProduct(mean);
  }
  return misfit;
}

InducingStatistics::InducingStatistics(const InducingLatents& latents)
    : B(MatrixXd::Zero(latents.size(), latents.size())),
      c(VectorXd::Zero(latents.size())),
      weight(VectorXd::Zero(std::ssize(latents.latents()))) {}

std::optional<InducingStatistics> InducingStatistics::of(const InducingLatents& latents, const RowBlocks& rows,
                                                         const Workers& workers, const std::atomic<bool>* stop) {
  struct Sum {
    InducingStatistics of_blocks;
    MatrixXd memory = {};
    void add(const Sum& other) { of_blocks.add(other.of_blocks); }
    void for_each(const std::function<void(double*, Index)>& take) { of_blocks.for_each(take); }
  };
  std::optional<Sum> sum = sum_over_blocks(latents, rows, false, workers, stop, Sum{InducingStatistics(latents)},
                                           [&](Sum& sum_of_piece, int, const RowBlock&, const InducingBlock& block) {
                                             sum_of_piece.of_blocks.add(latents, block, sum_of_piece.memory);
                                           });
  if (!sum) return std::nullopt;
  return std::move(sum->of_blocks);
}

void InducingStatistics::add(const InducingStatistics& other, double share) {
  B += share * other.B;
  c += share * other.c;
  yy += share * other.yy;
  trace += share * other.trace;
  constant += share * other.constant;
  weight += share * other.weight;
}

void InducingStatistics::add(const InducingLatents& latents, const InducingBlock& block, MatrixXd& memory) {
  const std::vector<InducingLatents::Function>& functions = latents.functions();
  for (std::size_t f = 0; f < functions.size(); ++f) {
    const MatrixXd& w = block.w(functions[f].latent);
    const ArrayXd square = block.weight_product(f, f);
    trace += (square * (block.variance(functions[f].latent).array() - w.colwise().squaredNorm().transpose().array())).sum();
    weight[static_cast<Index>(functions[f].latent)] += square.sum();
    if (w.rows() == 0) continue;
    ArrayXd of_y = ArrayXd::Zero(block.n());
    for (Index k = 0; k < block.y().cols(); ++k) of_y += block.weight(f, k).array() * block.y().col(k).array();
    c.segment(functions[f].first, w.rows()).noalias() += w * of_y.matrix();
    for (std::size_t g = 0; g <= f; ++g) {
      const MatrixXd& v = block.w(functions[g].latent);
      const ArrayXd product = f == g ? ArrayXd(square.sqrt()) : block.weight_product(f, g);
      if (v.rows() == 0 || (product == 0).all()) continue;
      memory = v * product.matrix().asDiagonal();
      auto to = B.block(functions[f].first, functions[g].first, w.rows(), v.rows());
      if (f == g) {
        lapack::add_square(memory, to);
      } else {
        lapack::add_product(w, false, memory, true, to);
      }
    }
  }
  yy += block.y().squaredNorm();
  constant += block.rows().reduction->constant + block.log_noise();
}

}  // namespace gp2
