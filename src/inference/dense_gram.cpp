#include "inference/dense_gram.hpp"

#include <algorithm>
#include <cassert>

#include <Eigen/Cholesky>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "inference/assemble.hpp"
#include "inference/pair_sweep.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {
constexpr Index large_size = 2000;   // of a matrix that OpenBLAS works on faster with several threads
constexpr Index many_samples = 512;  // from here on threads pay in the sums over pairs of samples
}  // namespace

int DenseGram::n_threads(const LatentRows& rows) const { return rows.n_samples() >= many_samples ? n_threads_ : 1; }

int DenseGram::n_blas_threads(const LatentRows& rows) const { return rows.size() >= large_size ? n_threads(rows) : 1; }

namespace {

// all rows in one block; null where it has a fault
const RowBlock* whole(const RowBlocks& blocks, RowBlocks::Memory& memory) {
  assert(blocks.n_blocks() == 1);
  return blocks.block(0, true, memory);
}

}  // namespace

std::optional<GramValue> DenseGram::value(const RowBlocks& blocks) {
  RowBlocks::Memory memory;
  const RowBlock* const block = whole(blocks, memory);
  return block == nullptr ? std::nullopt : factorise(block->rows);
}

std::optional<GramValue> DenseGram::differentiate(const RowBlocks& blocks, const std::vector<GramGradientParts>& parts,
                                                  GramGradient& gradient, const OfRows& of_rows) {
  RowBlocks::Memory memory;
  const RowBlock* const block = whole(blocks, memory);
  const std::optional<GramValue> value = block == nullptr ? std::nullopt : factorise(block->rows);
  if (!value) return std::nullopt;
  gradient = differentiate(block->rows, parts);
  of_rows(0, *block, gradient);
  return value;
}

bool factorise_covariance(const LatentRows& rows, int n_threads, MatrixXd& of_rows, GrowingCholesky& factor,
                          const std::atomic<bool>* stop) {
  const std::optional<Sums>& sums = rows.reduction->sums;
  if (sums) {
    of_rows.resize(rows.size(), rows.size());
    assemble(rows, n_threads, of_rows, stop);
    sums->of_rows(of_rows, factor.lower());
  } else {
    assemble(rows, n_threads, factor.lower(), stop);
  }
  factor.lower().diagonal().array() += 1;
  return !is_set(stop) && factor.factorise(rows.reduction->y, stop);
}

std::optional<GramValue> DenseGram::factorise(const LatentRows& rows) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  factor_.resize(rows.reduction->n_measured());
  if (!factorise_covariance(rows, n_threads(rows), of_rows_, factor_, stop_)) return std::nullopt;
  return GramValue{0.5 * factor_.z().squaredNorm(), factor_.log_det_half(), rows.reduction->constant};
}

GramGradient DenseGram::differentiate(const LatentRows& rows, const std::vector<GramGradientParts>& parts) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  const Eigen::VectorXd alpha = factor_.solve();
  const Ref<const MatrixXd> P = factor_.invert(stop_);
  const std::optional<Sums>& sums = rows.reduction->sums;
  if (!sums) return sweep_pairs(rows, P, alpha, parts, n_threads(rows), stop_);
  GramGradient gradient = sweep_pairs(rows, sums->to_rows(P), sums->weights_of_rows(alpha), parts, n_threads(rows), stop_);
  gradient.log_noise = P.diagonal() - alpha.cwiseAbs2();
  return gradient;
}

LatentPosterior::Inverse DenseGram::invert(const LatentRows& rows, const LatentPosterior::SampleSets& states,
                                           const LatentPosterior::SampleSets& sets) {
  const lapack::ManyThreads many_threads(n_blas_threads(rows));
  LatentPosterior::Inverse inverse{factor_.solve(), {}, {}, VectorXd::Ones(rows.n_samples())};
  const Ref<const MatrixXd> P = factor_.invert();
  const Reduction& reduction = *rows.reduction;
  const auto block = [&](const std::vector<Index>& of) {
    MatrixXd P_of(std::ssize(of), std::ssize(of));
    for (Index j = 0; j < P_of.cols(); ++j) {
      for (Index i = j; i < P_of.rows(); ++i) {
        const auto [low, high] = std::minmax(of[static_cast<std::size_t>(i)], of[static_cast<std::size_t>(j)]);
        P_of(i, j) = P_of(j, i) = P(high, low);
      }
    }
    return P_of;
  };
  for (const std::vector<Index>& state : states) inverse.blocks.push_back(block(rows_of_samples(reduction, state)));
  for (const std::vector<Index>& set : sets) {
    const std::vector<Index> of = rows_of_samples(reduction, set);
    const Eigen::LLT<MatrixXd> factor(block(of));
    if (factor.info() != Eigen::Success) {
      inverse.without.clear();
      return inverse;
    }
    const VectorXd pull = factor.solve(inverse.alpha(of));
    const MatrixXd root = factor.matrixL().solve(MatrixXd::Identity(pull.size(), pull.size()));
    LatentPosterior::WithoutSet& without = inverse.without.emplace_back();
    Index first = 0;
    for (const Index sample : set) {
      const Index rank = reduction.samples[static_cast<std::size_t>(sample)].R.rows();
      const auto columns = root.bottomRows(root.rows() - first).middleCols(first, rank);  // root is a lower triangle
      without.pull.emplace_back(pull.segment(first, rank));
      without.covariance.emplace_back(columns.transpose() * columns);
      first += rank;
    }
  }
  return inverse;
}

}  // namespace gp2
