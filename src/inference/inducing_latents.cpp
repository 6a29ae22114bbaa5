#include "inference/inducing_latents.hpp"

#include <algorithm>

#include "base/lapack.hpp"
#include "base/simd.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

InducingLatents::InducingLatents(const InducingPoints& points, const LatentRows& rows) {
  for (std::size_t a = 0; a < rows.latents.size(); ++a) {
    const KernelColumns& kernel = rows.latents[a].kernel;
    const MatrixXd& Z = points.features[a];
    lapack::PivotedFactor factor =
        lapack::factorise_semidefinite(kernel.kernel().evaluate(Z, Z, kernel.values()), smallest_pivot);
    factor.rows.resize(static_cast<std::size_t>(factor.L.cols()));
    OfLatent& latent = latents_.emplace_back(OfLatent{KernelColumns(kernel.kernel(), Z(factor.rows, Eigen::all), kernel.values()),
                                                      factor.L.topRows(factor.L.cols()), rows.latents[a].n_functions});
    for (Index l = 0; l < latent.n_functions; ++l, size_ += latent.n_points()) functions_.push_back({a, l, size_});
  }
}

void InducingLatents::solve(bool transposed, Ref<MatrixXd> c) const {
  for (const Function& function : functions_) {
    const OfLatent& latent = latent_of(function);
    lapack::solve_lower(latent.L, transposed, c.middleRows(function.first, latent.n_points()));
  }
}

InducingBlock::InducingBlock(const InducingLatents& latents, const LatentRows& rows) : latents_(&latents), rows_(&rows) {
  for (const InducingLatents::OfLatent& latent : latents.latents()) {
    k_.emplace_back(latent.kernel.n_rows(), size);
    w_.emplace_back(latent.n_points(), size);
    variance_.emplace_back(size);
  }
}

void InducingBlock::move_to(Index first) {
  first_ = first;
  n_ = std::min(size, rows_->n_samples() - first);
  for (std::size_t a = 0; a < k_.size(); ++a) {
    const InducingLatents::OfLatent& latent = latents_->latents()[a];
    const MatrixXd& features = rows_->latents[a].kernel.features();
    for (Index i = 0; i < n_; ++i) {
      latent.kernel.scale(features.row(first + i).transpose(), point_);
      latent.kernel.evaluate(0, k_[a].rows(), point_, k_[a].col(i).data(), workspace_);
      variance_[a][i] = (1 + smallest_pivot) * latent.kernel.variance(point_);
    }
    w_[a].leftCols(n_) = k_[a].topLeftCorner(latent.n_points(), n_);
    lapack::solve_lower(latent.L, false, w_[a].leftCols(n_));
  }
}

ArrayXd InducingBlock::weight_product(std::size_t f, std::size_t g) const {
  ArrayXd sum = ArrayXd::Zero(n_);
  for (Index c = 0; c < rows_->reduction->n_components(); ++c) sum += weight(f, c).array() * weight(g, c).array();
  return sum;
}

InducingStatistics::InducingStatistics(const InducingLatents& latents)
    : B(MatrixXd::Zero(latents.size(), latents.size())),
      c(VectorXd::Zero(latents.size())),
      weight(VectorXd::Zero(std::ssize(latents.latents()))) {}

InducingStatistics::InducingStatistics(const InducingLatents& latents, const LatentRows& rows, int n_threads,
                                       const std::atomic<bool>* stop)
    : InducingStatistics(latents) {
  const MatrixXd y = by_component(*rows.reduction, rows.reduction->y);
  std::vector<InducingStatistics> sums(n_block_parts, *this);
  std::vector<MatrixXd> memory(n_block_parts);
  for_each_block(latents, rows, n_threads, stop, [&](std::size_t part, const InducingBlock& block) {
    sums[part].add(latents, block, y, ArrayXd::Ones(block.n()), memory[part]);
  });
  for (const InducingStatistics& one : sums) add(one);
}

void InducingStatistics::add(const InducingStatistics& other) {
  B += other.B;
  c += other.c;
  yy += other.yy;
  trace += other.trace;
  weight += other.weight;
}

void InducingStatistics::add(const InducingLatents& latents, const InducingBlock& block, const MatrixXd& y, const ArrayXd& share,
                             MatrixXd& memory) {
  const std::vector<InducingLatents::Function>& functions = latents.functions();
  const auto y_of_block = y.middleRows(block.first(), block.n());
  for (std::size_t f = 0; f < functions.size(); ++f) {
    const auto w = block.w(functions[f].latent);
    const ArrayXd square = share * block.weight_product(f, f);
    trace += (square * (block.variance(functions[f].latent).array() - w.colwise().squaredNorm().transpose().array())).sum();
    weight[static_cast<Index>(functions[f].latent)] += square.sum();
    if (w.rows() == 0) continue;
    ArrayXd of_y = ArrayXd::Zero(block.n());
    for (Index k = 0; k < y.cols(); ++k) of_y += block.weight(f, k).array() * y_of_block.col(k).array();
    c.segment(functions[f].first, w.rows()).noalias() += w * (share * of_y).matrix();
    for (std::size_t g = 0; g <= f; ++g) {
      const auto v = block.w(functions[g].latent);
      const ArrayXd product = f == g ? ArrayXd(square.sqrt()) : ArrayXd(share * block.weight_product(f, g));
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
  yy += (share * y_of_block.array().square().rowwise().sum()).sum();
}

}  // namespace gp2
