#include <algorithm>
#include <utility>

#include <Eigen/QR>

#include "base/lapack.hpp"
#include "inference/inducing_gram.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// A lower triangular T with TᵀT = I − B⁻¹, B = I + S. With S = C Cᵀ that is C (I + CᵀC)⁻¹Cᵀ, of which nothing cancels.
MatrixXd root_of_explained(const MatrixXd& S) {
  const Index M = S.rows();
  const lapack::PivotedFactor factor = lapack::factorise_semidefinite(S, 0);
  const Index rank = factor.L.cols();
  MatrixXd half(rank, M);  // Cᵀ, its columns in reverse order
  for (Index k = 0; k < M; ++k) half.col(M - 1 - factor.rows[static_cast<std::size_t>(k)]) = factor.L.row(k).transpose();
  MatrixXd G = MatrixXd::Identity(rank, rank);
  lapack::add_square(half, G);
  lapack::factorise(G);
  lapack::solve_lower(G, false, half);
  // the triangle of the columns in reverse, in reverse
  const MatrixXd R = half.householderQr().matrixQR().triangularView<Eigen::Upper>();
  MatrixXd T = MatrixXd::Zero(M, M);
  T.bottomRows(rank) = R.reverse();
  return T;
}

}  // namespace

InducingPosterior::InducingPosterior(InducingLatents inducing, std::vector<InducingStatistics> stretches)
    : inducing_(std::move(inducing)), stretches_(std::move(stretches)) {
  Index n_points = 0;
  for (const InducingLatents::OfLatent& latent : inducing_.latents()) n_points = std::max(n_points, latent.n_points());
  for (const InducingLatents::Function& function : inducing_.functions()) {
    std::vector<Index>& rows = row_of_.emplace_back(static_cast<std::size_t>(n_points), -1);
    const InducingLatents::OfLatent& latent = inducing_.latent_of(function);
    for (Index v = 0; v < latent.n_variables(); ++v) {
      const auto [index, j] = latent.is_potential ? latent.derivative_at(v) : std::pair(function.index, v);
      if (index == function.index) rows[static_cast<std::size_t>(j)] = function.first + v;
    }
  }
  for (std::size_t a = 0; a < inducing_.latents().size(); ++a) {
    // all have as many points; those that a latent lacks have no weight
    const InducingLatents::OfLatent& latent = inducing_.latents()[a];
    MatrixXd points = MatrixXd::Zero(n_points, latent.kernel.features().cols());
    points.topRows(latent.n_points()) = latent.kernel.features().topRows(latent.n_points());
    Basis& basis = latents_.emplace_back(Basis{
        KernelColumns(latent.kernel.kernel(), points, latent.kernel.values()), {}, {}, latent.n_functions, latent.is_potential});
    basis.Z.setZero(basis.kernel.n_rows(), std::ssize(inducing_.functions()) * latent.n_functions);
    for (std::size_t f = 0; f < inducing_.functions().size(); ++f) {
      const InducingLatents::Function& function = inducing_.functions()[f];
      if (function.latent != a) continue;
      basis.Z.col(static_cast<Index>(f) * latent.n_functions + function.index).head(latent.n_points()).setOnes();
    }
  }
}

bool InducingPosterior::factorise() {
  InducingStatistics all(inducing_);
  for (const InducingStatistics& stretch : stretches_) all.add(stretch);
  MatrixXd L = all.B;
  L.diagonal().array() += 1;
  if (!lapack::factorise(L)) return false;
  all_ = std::move(all);
  L_ = std::move(L);
  mean_ = all_.c;
  lapack::solve_factored(L_, mean_);
  // X = T L⁻¹, from its transpose
  MatrixXd transposed = root_of_explained(all_.B).transpose();
  inducing_.solve(true, transposed);
  X_ = transposed.transpose();
  VectorXd weights = mean_;
  inducing_.solve(true, weights);
  std::vector<MatrixXd> beta = latent_weights(weights);
  for (std::size_t a = 0; a < latents_.size(); ++a) latents_[a].beta = std::move(beta[a]);
  return true;
}

GramValue InducingPosterior::value() const {
  const double explained = (L_.transpose().triangularView<Eigen::Upper>() * mean_).squaredNorm();  // cᵀB⁻¹c
  return {0.5 * (all_.yy - explained), L_.diagonal().array().log().sum() + 0.5 * all_.trace, all_.constant};
}

void InducingPosterior::whiten(Ref<MatrixXd> c) const { lapack::multiply_lower(X_, c); }

MatrixXd InducingPosterior::triangle_rows(Index first, Index n) const { return X_.block(first, 0, n, first + n); }

// B⁻¹c + L_B⁻ᵀε − L⁻¹f̃(Z): of the whitened variables, those of the function drawn from the posterior less those of f̃
VectorXd InducingPosterior::misfit(const std::vector<MatrixXd>& f, RandomStream& random) const {
  VectorXd drawn(size()), less_prior = VectorXd::Zero(size());
  for (double& entry : drawn) entry = random.normal();
  lapack::solve_lower(L_, true, drawn);
  subtract_functions(f, less_prior);
  inducing_.solve(false, less_prior);
  return mean_ + drawn + less_prior;
}

std::vector<std::vector<MatrixXd>> InducingPosterior::weights(MatrixXd misfits) const {
  inducing_.solve(true, misfits);
  std::vector<std::vector<MatrixXd>> weights;
  for (const auto& column : misfits.colwise()) weights.push_back(latent_weights(column));
  return weights;
}

bool InducingPosterior::append(const RowBlocks& more) {
  const std::optional<InducingStatistics> of_more = InducingStatistics::of(inducing_, more, 1);
  if (!of_more) return false;
  std::vector<InducingStatistics> before = std::exchange(stretches_, {all_, *of_more});
  if (!factorise()) {
    stretches_ = std::move(before);
    return false;
  }
  stretches_ = {all_};
  return true;
}

void InducingPosterior::forget(double share) {
  for (InducingStatistics& stretch : stretches_) {
    InducingStatistics faded(inducing_);
    faded.add(stretch, share);
    stretch = std::move(faded);
  }
  static_cast<void>(factorise());  // I + share (B − I) is no less definite than B
}

// With P = I − Ψ B⁻¹Ψᵀ the inverse of a set is P_BB⁻¹ = I + Ψ_B B₋⁻¹Ψ_Bᵀ, and P_BB⁻¹α̃_B = ỹ_B − Ψ_B B₋⁻¹c₋, where B₋ and c₋ are of
// all other samples: sums of what each stretch says, so that nothing is taken from anything.
LatentPosterior::Inverse InducingPosterior::invert(const LatentRows& rows, const SampleSets& states,
                                                   const SampleSets& sets) const {
  const lapack::SingleThread single_thread;
  const Reduction& reduction = *rows.reduction;
  InducingBlock block(inducing_);
  block.move_to(rows);
  std::vector<MatrixXd> Psi;
  for (Index c = 0; c < reduction.n_components(); ++c) Psi.push_back(block.loadings(c));
  // I ± Ψ_B(LLᵀ)⁻¹Ψ_Bᵀ from L⁻¹Ψᵀ by component
  const auto halves = [&](const MatrixXd& L) {
    std::vector<MatrixXd> half = Psi;
    for (MatrixXd& one : half) lapack::solve_lower(L, false, one);
    return half;
  };
  const auto rank_of = [&](Index sample) { return reduction.samples[static_cast<std::size_t>(sample)].R.rows(); };
  const auto block_of = [&](const std::vector<MatrixXd>& half, const std::vector<Index>& of, double sign) {
    std::vector<std::pair<Index, Index>> columns;  // component and sample
    for (const Index i : of) {
      for (Index c = 0; c < rank_of(i); ++c) columns.emplace_back(c, i);
    }
    const auto column = [&](Index k) {
      const auto [c, i] = columns[static_cast<std::size_t>(k)];
      return half[static_cast<std::size_t>(c)].col(i);
    };
    MatrixXd square = MatrixXd::Identity(std::ssize(columns), std::ssize(columns));
    for (Index k = 0; k < square.rows(); ++k) {
      for (Index l = 0; l < square.cols(); ++l) square(k, l) += sign * column(k).dot(column(l));
    }
    return square;
  };

  const auto& noise = block.noise();  // s, in units of which all of this is
  Inverse inverse{in_rows(reduction, block.misfit(mean_).array().colwise() / noise.array()), {}, {}, noise.cwiseAbs2()};
  const std::vector<MatrixXd> half = halves(L_);
  for (const std::vector<Index>& state : states) {
    std::vector<double> noise_of_rows;
    for (const Index i : state) noise_of_rows.insert(noise_of_rows.end(), static_cast<std::size_t>(rank_of(i)), noise[i]);
    const auto s = Eigen::Map<const VectorXd>(noise_of_rows.data(), std::ssize(noise_of_rows));
    inverse.blocks.emplace_back(block_of(half, state, -1).array() / (s * s.transpose()).array());
  }
  for (std::size_t k = 0; k < sets.size(); ++k) {
    InducingStatistics others(inducing_);
    for (std::size_t other = 0; other < stretches_.size(); ++other) {
      if (other != k) others.add(stretches_[other]);
    }
    others.B.diagonal().array() += 1;
    if (!lapack::factorise(others.B)) {
      inverse.without.clear();
      return inverse;
    }
    lapack::solve_factored(others.B, others.c);
    const MatrixXd pull = block.misfit(others.c);
    const std::vector<MatrixXd> of_others = halves(others.B);
    WithoutSet& without = inverse.without.emplace_back();
    for (const Index sample : sets[k]) {
      without.pull.emplace_back(noise[sample] * pull.row(sample).head(rank_of(sample)));
      without.covariance.push_back(noise[sample] * noise[sample] * block_of(of_others, {sample}, 1));
    }
  }
  return inverse;
}

}  // namespace gp2
