#include "inference/inducing_latents.hpp"

#include <algorithm>

#include <Eigen/Cholesky>

#include "base/lapack.hpp"
#include "inference/potential_cross.hpp"
#include "prior/gradient_columns.hpp"

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
    const Kernel& kernel = prior.latents[a].kernel;
    lapack::PivotedFactor& factor = factors.emplace_back(
        lapack::factorise_semidefinite(prior.latents[a].is_potential ? covariance_of_gradients(kernel, Z, values.kernel[a])
                                                                     : kernel.evaluate(Z, Z, values.kernel[a]),
                                       smallest_pivot));
    factor.rows.resize(static_cast<std::size_t>(factor.L.cols()));
    factor.L = factor.L.topRows(factor.L.cols()).eval();
  }
  return factors;
}

}  // namespace

InducingLatents::InducingLatents(const Prior& prior, const ModelValues& values)
    : InducingLatents(prior, values, factors_of(prior, values)) {}

InducingLatents::InducingLatents(const Prior& prior, const ModelValues& values, std::vector<lapack::PivotedFactor> factors) {
  std::size_t n_crosses = 0;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& of = prior.latents[a];
    const MatrixXd& given = values.inducing->features[a];
    const MatrixXd Z = of.is_potential ? given : given(factors[a].rows, Eigen::all);
    const OfLatent& latent = latents_.emplace_back(OfLatent{KernelColumns(of.kernel, Z, values.kernel[a]),
                                                            std::move(factors[a].L), std::move(factors[a].rows),
                                                            values.loading(a).cols(), is_local(of), of.is_potential, n_crosses});
    for (Index l = 0; l < latent.n_functions; ++l) {
      functions_.push_back({a, l, size_, n_crosses + (of.is_potential ? static_cast<std::size_t>(l) : 0)});
      if (!of.is_potential) size_ += latent.n_variables();
    }
    if (of.is_potential) size_ += latent.n_variables();
    n_crosses += latent.n_crosses();
  }
}

void InducingLatents::evaluate(std::size_t a, const Ref<const MatrixXd>& features, std::vector<MatrixXd>& k) const {
  const OfLatent& latent = latents_[a];
  const Index n = features.rows();
  VectorXd point;
  if (!latent.is_potential) {
    KernelColumns::Workspace workspace;
    MatrixXd& to = k[latent.first_cross];
    to.resize(latent.kernel.n_rows(), n);
    for (Index i = 0; i < n; ++i) {
      latent.kernel.scale(features.row(i).transpose(), point);
      latent.kernel.evaluate(0, to.rows(), point, to.col(i).data(), workspace);
    }
    return;
  }
  const GradientColumns columns(latent.kernel);
  GradientColumns::Workspace workspace;
  for (Index d = 0; d < latent.n_functions; ++d)
    k[latent.first_cross + static_cast<std::size_t>(d)].resize(latent.n_variables(), n);
  for (Index i = 0; i < n; ++i) {
    latent.kernel.scale(features.row(i).transpose(), point);
    columns.evaluate(0, latent.n_points(), point, workspace);
    for (Index d = 0; d < latent.n_functions; ++d) {
      columns.multiply(VectorXd::Unit(latent.n_functions, d), workspace);
      k[latent.first_cross + static_cast<std::size_t>(d)].col(i) = workspace.out.reshaped()(latent.chosen);
    }
  }
}

void InducingLatents::solve(bool transposed, Ref<MatrixXd> c) const {
  for (const Function& function : functions_) {
    const OfLatent& latent = latent_of(function);
    if (latent.is_potential && function.index > 0) continue;
    lapack::solve_lower(latent.L, transposed, c.middleRows(function.first, latent.n_variables()));
  }
}

std::vector<MatrixXd> InducingLatents::at(const std::vector<MatrixXd>& features, const Ref<const VectorXd>& m) const {
  std::vector<MatrixXd> f, k(n_crosses());
  for (std::size_t a = 0; a < latents_.size(); ++a) {
    const OfLatent& latent = latents_[a];
    evaluate(a, features[a], k);
    f.emplace_back(latent.n_functions, features[a].rows());
    for (std::size_t c = latent.first_cross; c < latent.first_cross + latent.n_crosses(); ++c) {
      k[c].conservativeResize(latent.n_variables(), Eigen::NoChange);
      lapack::solve_lower(latent.L, false, k[c]);
    }
  }
  for (const Function& function : functions_) {
    const MatrixXd& w = k[function.cross];
    f[function.latent].row(function.index) = m.segment(function.first, w.rows()).transpose() * w;
  }
  return f;
}

InducingBlock::InducingBlock(const InducingLatents& latents)
    : latents_(&latents), k_(latents.n_crosses()), w_(k_.size()), variance_(k_.size()), left_(latents.latents().size()) {}

void InducingBlock::move_to(const LatentRows& rows) {
  rows_ = &rows;
  y_ = by_component(*rows.reduction, rows.reduction->y);
  VectorXd point;
  for (std::size_t a = 0; a < left_.size(); ++a) {
    const InducingLatents::OfLatent& latent = latents_->latents()[a];
    const MatrixXd& features = rows.latents[a].kernel.features();
    latents_->evaluate(a, features.topRows(n()), k_);
    const VectorXd of_gradient = latent.is_potential ? GradientColumns(latent.kernel).variance() : VectorXd();
    for (std::size_t c = latent.first_cross; c < latent.first_cross + latent.n_crosses(); ++c) {
      w_[c] = k_[c].topRows(latent.n_variables());
      lapack::solve_lower(latent.L, false, w_[c]);
      variance_[c].resize(n());
      for (Index i = 0; i < n(); ++i) {
        if (latent.is_potential) {
          variance_[c][i] = (1 + smallest_pivot) * of_gradient[static_cast<Index>(c - latent.first_cross)];
          continue;
        }
        latent.kernel.scale(features.row(i).transpose(), point);
        variance_[c][i] = (1 + smallest_pivot) * latent.kernel.variance(point);
      }
    }
  }
  add_noise();
}

// s_i² = 1 + Σ_a (k_a(φ_i, φ_i) − ‖w_i,a‖²) ‖Γ_i,a‖²/r_i over the local latents
void InducingBlock::add_noise() {
  rank_.resize(n());
  for (Index i = 0; i < n(); ++i) rank_[i] = static_cast<double>(rows_->reduction->samples[static_cast<std::size_t>(i)].R.rows());
  noise_.setOnes(n());
  for (std::size_t a = 0; a < left_.size(); ++a) {
    const InducingLatents::OfLatent& latent = latents_->latents()[a];
    if (!latent.is_local) continue;
    VectorXd& variance = variance_[latent.first_cross];
    const VectorXd held = w_[latent.first_cross].colwise().squaredNorm();
    left_[a] = (variance - held).cwiseMax(0);
    variance = held;
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

double InducingBlock::left_out(std::size_t f) const {
  const InducingLatents::Function& function = latents_->functions()[f];
  double sum = (weight_product(f, f) * (variance(f).array() - w(f).colwise().squaredNorm().transpose().array())).sum();
  if (!latents_->latent_of(function).is_potential) return sum;
  // derivatives at one point are independent under the prior
  for (std::size_t g = f - static_cast<std::size_t>(function.index); g < f; ++g) {
    sum -= 2 * (weight_product(f, g) * w(f).cwiseProduct(w(g)).colwise().sum().transpose().array()).sum();
  }
  return sum;
}

MatrixXd InducingBlock::loadings(Index component) const {
  MatrixXd Psi = MatrixXd::Zero(latents_->size(), n());
  for (std::size_t f = 0; f < latents_->functions().size(); ++f) {
    Psi.middleRows(latents_->functions()[f].first, w(f).rows()) += w(f) * weight(f, component).asDiagonal();
  }
  return Psi;
}

MatrixXd InducingBlock::misfit(const Ref<const VectorXd>& m) const {
  MatrixXd misfit = y();
  for (std::size_t f = 0; f < latents_->functions().size(); ++f) {
    const VectorXd mean = w(f).transpose() * m.segment(latents_->functions()[f].first, w(f).rows());
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
  return sum_over_blocks(
      latents, rows, false, workers, stop, InducingStatistics(latents),
      [&](InducingStatistics& sum, int, const RowBlock&, const InducingBlock& block) { sum.add(latents, block); });
}

void InducingStatistics::add(const InducingStatistics& other, double share) {
  B += share * other.B;
  c += share * other.c;
  yy += share * other.yy;
  trace += share * other.trace;
  constant += share * other.constant;
  weight += share * other.weight;
}

void InducingStatistics::add(const InducingLatents& latents, const InducingBlock& block) {
  const std::vector<InducingLatents::Function>& functions = latents.functions();
  const auto is_potential = [&](std::size_t f) { return latents.latent_of(functions[f]).is_potential; };
  // each component of a sample sees another combination of a potential's derivatives: its variables have loadings by component
  std::vector<MatrixXd> Psi;
  MatrixXd weighted;
  const bool has_potential = std::ranges::any_of(latents.latents(), &InducingLatents::OfLatent::is_potential);
  for (Index k = 0; has_potential && k < block.y().cols(); ++k) Psi.push_back(block.loadings(k));
  for (std::size_t f = 0; f < functions.size(); ++f) {
    const MatrixXd& w = block.w(f);
    const ArrayXd square = block.weight_product(f, f);
    trace += block.left_out(f);
    weight[static_cast<Index>(functions[f].latent)] += is_potential(f) ? square.matrix().dot(block.variance(f)) : square.sum();
    if (w.rows() == 0) continue;
    ArrayXd of_y = ArrayXd::Zero(block.n());
    for (Index k = 0; k < block.y().cols(); ++k) of_y += block.weight(f, k).array() * block.y().col(k).array();
    c.segment(functions[f].first, w.rows()).noalias() += w * of_y.matrix();
    if (is_potential(f) && functions[f].index > 0) continue;
    for (std::size_t g = 0; g <= f; ++g) {
      const MatrixXd& v = block.w(g);
      if (v.rows() == 0) continue;
      auto to = B.block(functions[f].first, functions[g].first, w.rows(), v.rows());
      if (is_potential(f) || is_potential(g)) {
        if (is_potential(g) && functions[g].index > 0) continue;
        for (const MatrixXd& of_component : Psi) {
          weighted = of_component.middleRows(functions[g].first, v.rows());
          if (f == g) {
            lapack::add_square(weighted, to);
          } else {
            lapack::add_product(of_component.middleRows(functions[f].first, w.rows()), false, weighted, true, to);
          }
        }
        continue;
      }
      const ArrayXd product = f == g ? ArrayXd(square.sqrt()) : block.weight_product(f, g);
      if ((product == 0).all()) continue;
      weighted = v * product.matrix().asDiagonal();
      if (f == g) {
        lapack::add_square(weighted, to);
      } else if (functions[f].cross == functions[g].cross) {
        lapack::add_symmetric_product(w, weighted, to);
      } else {
        lapack::add_product(w, false, weighted, true, to);
      }
    }
  }
  yy += block.y().squaredNorm();
  constant += block.rows().reduction->constant + block.log_noise();
}

}  // namespace gp2
