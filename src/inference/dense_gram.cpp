#include "inference/dense_gram.hpp"

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "inference/assemble.hpp"
#include "inference/pair_sweep.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;

namespace {
constexpr Index large_size = 2000;   // of a matrix that OpenBLAS works on faster with several threads
constexpr Index many_samples = 512;  // from here on threads pay in the sums over pairs of samples
}  // namespace

int DenseGram::n_threads(const LatentRows& rows) const { return rows.n_samples() >= many_samples ? n_threads_ : 1; }

int DenseGram::n_blas_threads(const LatentRows& rows) const { return rows.size() >= large_size ? n_threads(rows) : 1; }

std::optional<GramValue> DenseGram::factorise(const LatentRows& rows) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  factor_.resize(rows.size());
  assemble(rows, n_threads(rows), factor_.lower(), stop_);
  if (is_set(stop_) || !factor_.factorise(rows.reduction->y, stop_)) return std::nullopt;
  return GramValue{0.5 * factor_.z().squaredNorm(), factor_.log_det_half()};
}

GramGradient DenseGram::differentiate(const LatentRows& rows, const std::vector<GramGradientParts>& parts) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  const Eigen::VectorXd alpha = factor_.solve();
  return sweep_pairs(rows, factor_.invert(stop_), alpha, parts, n_threads(rows), stop_);
}

Gram::Inverse DenseGram::invert(const LatentRows& rows) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  Inverse inverse{factor_.solve(), {}};
  const Ref<const MatrixXd> P = factor_.invert();
  const std::vector<Index>& offset = rows.reduction->offset;
  for (Index sample = 0; sample < rows.n_samples(); ++sample) {
    const Index rank = rows.reduction->samples[static_cast<std::size_t>(sample)].R.rows();
    MatrixXd& block = inverse.blocks.emplace_back(rank, rank);
    for (Index c = 0; c < rank; ++c) {
      for (Index d = 0; d <= c; ++d) {
        block(c, d) = block(d, c) = P(offset[static_cast<std::size_t>(c)] + sample, offset[static_cast<std::size_t>(d)] + sample);
      }
    }
  }
  return inverse;
}

std::unique_ptr<LatentPosterior> DenseGram::condition(const LatentRows& rows) const {
  auto posterior = std::make_unique<DensePosterior>(rows);
  if (!posterior->append(rows)) return nullptr;
  return posterior;
}

}  // namespace gp2
