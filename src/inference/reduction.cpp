#include "inference/reduction.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/QR>

#include "data/evenly.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// S^{-1/2} of the samples of one Observations.
class Whitening {
 public:
  Whitening(const Observations& group, const VectorXd& noise_stddev)
      : group_(group),
        noise_stddev_(noise_stddev),
        is_mixed_(group.noise().has_scale() || group.values().hasNaN()),
        diagonal_(noise_stddev.cwiseInverse()),
        log_det_S_half_(noise_stddev.array().log().sum()),
        n_measured_(noise_stddev.size()) {}

  void move_to(int i) {
    if (!is_mixed_) return;
    noise_ = group_.noise_at(noise_stddev_, i);
    diagonal_ = noise_.cwiseInverse();
    n_measured_ = (diagonal_.array() > 0).count();
    if (n_measured_ < diagonal_.size()) noise_ = (diagonal_.array() > 0).select(noise_, 1);
    log_det_S_half_ = noise_.array().log().sum();
  }

  [[nodiscard]] const VectorXd& diagonal() const { return diagonal_; }     // 0 where nothing is measured
  [[nodiscard]] double log_det_S_half() const { return log_det_S_half_; }  // of what is measured
  [[nodiscard]] Index n_measured() const { return n_measured_; }
  [[nodiscard]] bool is_complete() const { return n_measured_ == diagonal_.size(); }

 private:
  const Observations& group_;
  const VectorXd& noise_stddev_;
  bool is_mixed_;  // the noise differs from sample to sample
  VectorXd diagonal_, noise_;
  double log_det_S_half_;
  Index n_measured_;
};

// C of diag(σ²) + N Nᵀ = C Cᵀ: with Ñ = diag(σ)⁻¹N it is diag(σ) times the R of [I; Ñᵀ] = Q R, transposed, which loses no more than
// rounding of Ñ. A value that is not measured has σ = ∞ and a row of the identity.
MatrixXd noise_factor(const Eigen::Ref<const VectorXd>& whitening, const Eigen::Ref<const MatrixXd>& N) {
  const Index d = N.rows(), m = N.cols();
  MatrixXd stacked(d + m, d);
  stacked << MatrixXd::Identity(d, d), (whitening.asDiagonal() * N).transpose();
  const MatrixXd R = stacked.householderQr().matrixQR().topRows(d);
  MatrixXd C = MatrixXd::Zero(d, d);
  for (Index k = 0; k < d; ++k) C.col(k).tail(d - k) = (R(k, k) < 0 ? -1 : 1) * R.row(k).tail(d - k).transpose();
  return (whitening.array() > 0).select(whitening.cwiseInverse(), VectorXd::Ones(d)).asDiagonal() * C;
}

// W = Q R and e = Q ỹ + e_out of one sample, and the memory for it.
class Split {
 public:
  void operator()(const Observations& group, const ObservationModel& model, const Whitening& whitening,
                  Reduction::Sample& sample) {
    const int i = sample.index;
    const VectorXd& diagonal = whitening.diagonal();
    // W P = Q R', so R = Qᵀ W
    const auto G = model.values.view.G(i);
    double log_det_S_half = whitening.log_det_S_half();
    if (model.values.view.has_slip()) {
      sample.C = noise_factor(diagonal, model.values.view.N(i));
      log_det_S_half = sample.C.diagonal().array().log().sum();
      W_ = sample.C.triangularView<Eigen::Lower>().solve((diagonal.array() > 0).cast<double>().matrix().asDiagonal() * G);
    } else {
      sample.C.resize(0, 0);
      W_.noalias() = diagonal.asDiagonal() * G;
    }
    factors_ = W_ * model.balance.col(i).asDiagonal();
    reflection_.resize(std::min(W_.rows(), W_.cols()));
    order_.resize(W_.cols());
    const Index rank = internal::pivoted_qr(factors_, reflection_, order_, UdwadiaKalaba::rank_tolerance);
    sample.Q.setIdentity(W_.rows(), rank);
    internal::apply_Q(factors_, reflection_, rank, sample.Q);
    sample.R.noalias() = sample.Q.transpose().lazyProduct(W_);
    sample.e = group.values().col(i) - model.values.view.offset.col(i);
    sample.e.noalias() -= G.lazyProduct(model.values.prior.mean.col(i));
    if (!whitening.is_complete()) sample.e = (diagonal.array() > 0).select(sample.e, 0);
    if (sample.C.size() > 0) {
      sample.C.triangularView<Eigen::Lower>().solveInPlace(sample.e);
    } else {
      sample.e.array() *= diagonal.array();
    }
    sample.y.noalias() = sample.Q.transpose().lazyProduct(sample.e);
    sample.e_out = sample.e;
    sample.e_out.noalias() -= sample.Q.lazyProduct(sample.y);
    sample.constant = 0.5 * sample.e_out.squaredNorm() + log_det_S_half +
                      0.5 * static_cast<double>(whitening.n_measured()) * std::log(2 * std::numbers::pi);
  }

 private:
  MatrixXd W_, factors_;
  VectorXd reflection_;
  Eigen::VectorXi order_;
};

// One sample of which only sums are measured.
void keep_whole(const ObservationModel& model, Reduction::Sample& sample) {
  const auto G = model.values.view.G(sample.index);
  sample.Q.setIdentity(G.rows(), G.rows());
  sample.R = G;
  sample.C.resize(0, 0);
  sample.y = -model.values.view.offset.col(sample.index);
  sample.y.noalias() -= G.lazyProduct(model.values.prior.mean.col(sample.index));
  sample.e = sample.y;
  sample.e_out.setZero(G.rows());
  sample.constant = 0;
}

// log|σL| + ½ m log 2π
double constant_of_sums(const Observations& group, const VectorXd& noise_stddev) {
  double constant = 0;
  for (const WeightedSum& sum : group.sums()) {
    constant += std::log(noise_stddev[sum.row] * sum.noise[sum.noise.size() - 1]) + 0.5 * std::log(2 * std::numbers::pi);
  }
  return constant;
}

// Sorts the samples by falling rank: component c belongs to those of rank > c, which are then the first ones.
void sort_by_rank(Reduction& reduction) {
  std::vector<Reduction::Sample>& samples = reduction.samples;
  const auto falls = [](const Reduction::Sample& a, const Reduction::Sample& b) { return a.R.rows() > b.R.rows(); };
  if (!std::is_sorted(samples.begin(), samples.end(), falls)) std::stable_sort(samples.begin(), samples.end(), falls);
  reduction.count.clear();
  reduction.offset.assign(1, 0);
  for (Index c = 0; !samples.empty() && c < samples.front().R.rows(); ++c) {
    Index count = 0;
    while (count < reduction.n_samples() && samples[static_cast<std::size_t>(count)].R.rows() > c) ++count;
    reduction.count.push_back(count);
    reduction.offset.push_back(reduction.offset.back() + count);
  }
}

// ỹ and the rows R_i E_a(x_i) of all samples
void stack(const Prior& prior, const std::vector<ObservationModel>& models, Reduction& reduction) {
  reduction.y.resize(reduction.size());
  reduction.directions.resize(prior.latents.size());
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    reduction.directions[a].resize(reduction.size(), prior.latents[a].size());
  }
  MatrixXd RE;
  for (Index s = 0; s < reduction.n_samples(); ++s) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    for (Index c = 0; c < sample.y.size(); ++c) reduction.y[reduction.offset[static_cast<std::size_t>(c)] + s] = sample.y[c];
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      RE.noalias() = sample.R.lazyProduct(models[static_cast<std::size_t>(sample.group)].values.prior.E(a, sample.index));
      for (Index c = 0; c < RE.rows(); ++c) {
        reduction.directions[a].row(reduction.offset[static_cast<std::size_t>(c)] + s) = RE.row(c);
      }
    }
  }
}

// D and L, and z̃ from the rows of single samples
void sum_up(const std::vector<Observations>& observations, const std::vector<VectorXd>& noise_stddev, Reduction& reduction) {
  std::vector<std::vector<Index>> sample_of;  // by group and state
  for (const Observations& group : observations) sample_of.emplace_back(static_cast<std::size_t>(group.n_data()));
  Sums& sums = reduction.sums.emplace();
  std::vector<Eigen::Triplet<double>> D, L;
  const auto add = [&](Sums::Of of) {
    sums.of.push_back(of);
    return std::ssize(sums.of) - 1;
  };
  for (Index s = 0; s < reduction.n_samples(); ++s) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    sample_of[static_cast<std::size_t>(sample.group)][static_cast<std::size_t>(sample.index)] = s;
    if (observations[static_cast<std::size_t>(sample.group)].has_sums()) continue;
    for (const Index row : rows_of_samples(reduction, {s})) {
      const Index r = add({});
      D.emplace_back(r, row, 1);
      L.emplace_back(r, r, 1);
    }
  }
  const Index n_alone = std::ssize(sums.of);
  std::vector<double> values;
  for (std::size_t g = 0; g < observations.size(); ++g) {
    for (const WeightedSum& sum : observations[g].sums()) {
      const Index r = add({static_cast<int>(g), sum.row});
      values.push_back(sum.value);
      for (Index i = 0; i < sum.weights.size(); ++i) {
        const Index s = sample_of[g][static_cast<std::size_t>(sum.first + i)];
        D.emplace_back(r, reduction.offset[static_cast<std::size_t>(sum.row)] + s, sum.weights[i]);
      }
      for (Index j = 0; j < sum.noise.size(); ++j) {
        L.emplace_back(r, r - sum.noise.size() + 1 + j, noise_stddev[g][sum.row] * sum.noise[j]);
      }
    }
  }
  const Index n = std::ssize(sums.of);
  sums.D.resize(n, reduction.size());
  sums.D.setFromTriplets(D.begin(), D.end());
  sums.L.resize(n, n);
  sums.L.setFromTriplets(L.begin(), L.end());
  VectorXd z = sums.D * reduction.y;
  z.tail(n - n_alone) += Eigen::Map<const VectorXd>(values.data(), std::ssize(values));
  sums.whiten(z);
  reduction.y = std::move(z);
}

bool has_same_directions(const Latent& latent, const Reduction& reduction, const MatrixXd& directions) {
  bool same = latent.free_loading.has_value() && !reduction.sums;
  for (std::size_t c = 0; same && c < reduction.count.size(); ++c) {
    const auto block = directions.middleRows(reduction.offset[c], reduction.count[c]);
    same = reduction.count[c] == reduction.count.front() && (block.rowwise() - block.row(0)).isZero(0);
  }
  return same;
}

}  // namespace

void Sums::whiten(Eigen::Ref<MatrixXd> c) const { L.triangularView<Eigen::Lower>().solveInPlace(c); }

void Sums::whiten_transposed(Eigen::Ref<MatrixXd> c) const { L.transpose().triangularView<Eigen::Upper>().solveInPlace(c); }

void Sums::of_rows(const Eigen::Ref<const MatrixXd>& K, Eigen::Ref<MatrixXd> of_sums) const {
  MatrixXd whole = K.selfadjointView<Eigen::Lower>();
  MatrixXd half = (D * whole).transpose();
  whole = D * half;
  whiten(whole);
  half = whole.transpose();
  whiten(half);
  of_sums.triangularView<Eigen::Lower>() = half;
}

MatrixXd Sums::to_rows(const Eigen::Ref<const MatrixXd>& P) const {
  MatrixXd half = P.selfadjointView<Eigen::Lower>();
  whiten_transposed(half);
  half.transposeInPlace();
  whiten_transposed(half);
  half = (D.transpose() * half).transpose().eval();
  return D.transpose() * half;
}

VectorXd Sums::weights_of_rows(VectorXd alpha) const {
  whiten_transposed(alpha);
  return D.transpose() * alpha;
}

void Sums::append_rows(Index n) {
  const auto extended = [n](const auto& matrix) {
    std::vector<Eigen::Triplet<double>> entries;
    using Matrix = std::decay_t<decltype(matrix)>;
    for (Index k = 0; k < matrix.outerSize(); ++k) {
      for (typename Matrix::InnerIterator entry(matrix, k); entry; ++entry)
        entries.emplace_back(entry.row(), entry.col(), entry.value());
    }
    for (Index k = 0; k < n; ++k) entries.emplace_back(matrix.rows() + k, matrix.cols() + k, 1);
    Matrix out(matrix.rows() + n, matrix.cols() + n);
    out.setFromTriplets(entries.begin(), entries.end());
    return out;
  };
  of.resize(of.size() + static_cast<std::size_t>(n));
  D = extended(D);
  L = extended(L);
}

std::vector<Index> rows_of_samples(const Reduction& reduction, const std::vector<Index>& samples) {
  std::vector<Index> rows;
  for (const Index sample : samples) {
    const Index rank = reduction.samples[static_cast<std::size_t>(sample)].R.rows();
    for (Index c = 0; c < rank; ++c) rows.push_back(reduction.offset[static_cast<std::size_t>(c)] + sample);
  }
  return rows;
}

void reduce(const Prior& prior, const std::vector<Observations>& observations, const std::vector<ObservationModel>& models,
            const std::vector<VectorXd>& noise_stddev, Reduction& reduction) {
  reduction.samples.resize(static_cast<std::size_t>(n_states(observations)));
  reduction.n = std::ssize(reduction.samples);
  reduction.constant = 0;
  Split split;
  auto sample = reduction.samples.begin();
  for (std::size_t g = 0; g < observations.size(); ++g) {
    Whitening whitening(observations[g], noise_stddev[g]);
    for (int i = 0; i < observations[g].n_data(); ++i, ++sample) {
      sample->group = static_cast<int>(g);
      sample->index = i;
      if (observations[g].has_sums()) {
        keep_whole(models[g], *sample);
        if (i == 0) sample->constant = constant_of_sums(observations[g], noise_stddev[g]);
      } else {
        whitening.move_to(i);
        split(observations[g], models[g], whitening, *sample);
      }
      reduction.constant += sample->constant;
    }
  }
  sort_by_rank(reduction);
  stack(prior, models, reduction);
  reduction.sums.reset();
  if (has_sums(observations)) sum_up(observations, noise_stddev, reduction);
  reduction.same_directions.clear();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    reduction.same_directions.push_back(has_same_directions(prior.latents[a], reduction, reduction.directions[a]));
  }
}

}  // namespace gp2
