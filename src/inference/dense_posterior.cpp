#include <algorithm>
#include <numeric>
#include <utility>

#include "base/lapack.hpp"
#include "gp2/error.hpp"
#include "inference/assemble.hpp"
#include "inference/dense_gram.hpp"
#include "inference/latent_sums.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/padded_rows.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

DensePosterior::DensePosterior(const LatentRows& like) {
  for (const LatentRows::OfLatent& latent : like.latents) {
    const KernelColumns& kernel = latent.kernel;
    latents_.push_back({KernelColumns(kernel.kernel(), MatrixXd(0, kernel.features().cols()), kernel.values()),
                        {},
                        {},
                        latent.n_functions,
                        latent.is_potential});
  }
}

double DensePosterior::squared_weight(std::size_t latent) const {
  const Basis& basis = latents_[latent];
  if (!basis.is_potential) return basis.Z.squaredNorm();
  const VectorXd variance = GradientColumns(basis.kernel).variance();
  double sum = 0;
  for (Index column = 0; column < basis.Z.cols(); ++column) {
    sum += variance[column % variance.size()] * basis.Z.col(column).squaredNorm();
  }
  return sum;
}

std::unique_ptr<LatentPosterior> DensePosterior::clone() const { return std::make_unique<DensePosterior>(*this); }

GramValue DensePosterior::value() const { return {0.5 * factor_.z().squaredNorm(), factor_.log_det_half()}; }

void DensePosterior::whiten(Ref<MatrixXd> c) const {
  if (sums_) sums_->whiten(c);
  lapack::solve_lower(factor_.L(), false, c);
}

MatrixXd DensePosterior::triangle_rows(Index first, Index n) const {
  const auto L = factor_.L();
  MatrixXd rows = L.block(first, 0, n, first + n);
  if (sums_) {
    // (L_D L)⁻¹ = L⁻¹L_D⁻¹
    const MatrixXd of_sums = sums_->L;
    rows = of_sums.block(first, 0, n, first + n) * L.topLeftCorner(first + n, first + n).triangularView<Eigen::Lower>();
  }
  auto diagonal = rows.diagonal(first);
  diagonal = diagonal.cwiseInverse().eval();
  return rows;
}

// ỹ − Σ_a Z_a f̃_a − ε
VectorXd DensePosterior::misfit(const std::vector<MatrixXd>& f, RandomStream& random) const {
  VectorXd misfit = sums_ ? VectorXd(VectorXd::Zero(n_rows())) : y_;
  subtract_functions(f, misfit);
  if (sums_) {
    misfit = (sums_->D * misfit).eval();
    sums_->whiten(misfit);
    misfit += y_;
  }
  for (double& entry : misfit) entry -= random.normal();
  return misfit;
}

std::vector<std::vector<MatrixXd>> DensePosterior::weights(MatrixXd alpha) const {
  lapack::solve_factored(factor_.L(), alpha);
  std::vector<std::vector<MatrixXd>> weights;
  for (const auto& column : alpha.colwise()) weights.push_back(latent_weights(weights_of_rows(column)));
  return weights;
}

VectorXd DensePosterior::weights_of_rows(VectorXd alpha) const {
  return sums_ ? sums_->weights_of_rows(std::move(alpha)) : alpha;
}

void DensePosterior::refresh_weights() {
  std::vector<MatrixXd> beta = latent_weights(weights_of_rows(factor_.solve()));
  for (std::size_t a = 0; a < latents_.size(); ++a) latents_[a].beta = std::move(beta[a]);
}

LatentPosterior::Inverse DensePosterior::invert(const LatentRows& rows, const SampleSets& states, const SampleSets& sets) const {
  DenseGram gram;
  if (!gram.factorise(rows)) throw NumericalError("leave_one_out: the covariance of the observations cannot be factored");
  return gram.invert(rows, states, sets);
}

bool DensePosterior::append(const RowBlocks& more) {
  RowBlocks::Memory memory;
  return append(more.block(0, false, memory)->rows);
}

bool DensePosterior::append(const LatentRows& more) {
  if (!(size() == 0 ? factorise(more) : extend(more))) return false;
  append_basis(more);
  refresh_weights();
  return true;
}

bool DensePosterior::factorise(const LatentRows& rows) {
  GrowingCholesky factor(rows.reduction->n_measured());
  MatrixXd of_rows;
  if (!factorise_covariance(rows, 1, of_rows, factor)) return false;
  factor_ = std::move(factor);
  sums_ = rows.reduction->sums;
  return true;
}

bool DensePosterior::extend(const LatentRows& more) {
  const Reduction& reduction = *more.reduction;
  const Index n_new = more.n_samples(), n_components = reduction.n_components();
  MatrixXd kappa(more.size(), more.size());
  assemble(more, 1, kappa);
  kappa.diagonal().array() += 1;
  // row c of Z at a sample is the loading of its component c
  std::vector<MatrixXd> features, loadings;
  for (const LatentRows::OfLatent& latent : more.latents) {
    features.emplace_back(latent.kernel.features().topRows(n_new));
    loadings.emplace_back(latent.Z.topRows(n_new).transpose());
  }
  MatrixXd cross(size(), n_new * n_components), k(size(), more.size());
  LatentSums(*this).evaluate(features, std::nullopt, &loadings, &cross);
  for (Index c = 0; c < n_components; ++c) {
    for (Index j = 0; j < reduction.count[static_cast<std::size_t>(c)]; ++j) {
      k.col(reduction.offset[static_cast<std::size_t>(c)] + j) = cross.col(j * n_components + c);
    }
  }
  if (sums_) sums_->whiten(k);
  if (!factor_.append(std::move(k), std::move(kappa), reduction.y)) return false;
  if (sums_) sums_->append_rows(more.size());
  return true;
}

void DensePosterior::append_basis(const LatentRows& more) {
  const Reduction& reduction = *more.reduction;
  const Index n_old = n_samples_, n_new = more.n_samples(), first_row = n_rows() - more.size();
  y_.conservativeResize(size());
  y_.tail(reduction.n_measured()) = reduction.y;
  if (row_of_.size() < reduction.count.size()) {
    row_of_.resize(reduction.count.size(), std::vector<Index>(static_cast<std::size_t>(n_old), -1));
  }
  for (std::size_t c = 0; c < row_of_.size(); ++c) {
    row_of_[c].resize(static_cast<std::size_t>(n_old + n_new), -1);
    if (c >= reduction.count.size()) continue;
    for (Index j = 0; j < reduction.count[c]; ++j) {
      row_of_[c][static_cast<std::size_t>(n_old + j)] = first_row + reduction.offset[c] + j;
    }
  }
  for (std::size_t a = 0; a < latents_.size(); ++a) {
    const LatentRows::OfLatent& rows = more.latents[a];
    latents_[a].kernel.append(rows.kernel.features().topRows(n_new));
    MatrixXd& Z = latents_[a].Z;
    resize_points(Z, n_old + n_new);
    const Index n_columns = latents_[a].n_functions * static_cast<Index>(row_of_.size());
    if (Z.cols() < n_columns) Z.conservativeResizeLike(MatrixXd::Zero(Z.rows(), n_columns));
    Z.block(n_old, 0, n_new, rows.Z.cols()) = rows.Z.topRows(n_new);
  }
  n_samples_ = n_old + n_new;
}

void DensePosterior::erase(const std::vector<Index>& samples) {
  const Index n = n_samples_;
  // the rows that go, and where those that stay come to stand
  std::vector<Index> rows;
  for (const std::vector<Index>& of_component : row_of_) {
    for (const Index sample : samples) {
      if (of_component[static_cast<std::size_t>(sample)] >= 0) rows.push_back(of_component[static_cast<std::size_t>(sample)]);
    }
  }
  std::sort(rows.begin(), rows.end());
  factor_.erase(rows);
  std::vector<Index> kept(static_cast<std::size_t>(y_.size())), moved(kept.size());
  std::iota(kept.begin(), kept.end(), Index{0});
  kept.resize(static_cast<std::size_t>(close_gaps(kept.data(), y_.size(), rows)));
  for (std::size_t row = 0; row < kept.size(); ++row) moved[static_cast<std::size_t>(kept[row])] = static_cast<Index>(row);
  y_.conservativeResize(close_gaps(y_.data(), y_.size(), rows));

  for (std::vector<Index>& of_component : row_of_) {
    of_component.resize(static_cast<std::size_t>(close_gaps(of_component.data(), n, samples)));
    for (Index& row : of_component) row = row < 0 ? row : moved[static_cast<std::size_t>(row)];
  }
  for (Basis& latent : latents_) {
    erase_points(latent.Z, n, samples);
    latent.kernel.erase(samples);
  }
  n_samples_ = n - static_cast<Index>(samples.size());
  refresh_weights();
}

}  // namespace gp2
