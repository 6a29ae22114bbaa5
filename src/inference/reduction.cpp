#include "inference/reduction.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/QR>

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
    factors_ = W_;
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

bool has_same_directions(const Latent& latent, const Reduction& reduction, const MatrixXd& directions) {
  bool same = latent.free_loading.has_value();
  for (std::size_t c = 0; same && c < reduction.count.size(); ++c) {
    const auto block = directions.middleRows(reduction.offset[c], reduction.count[c]);
    same = reduction.count[c] == reduction.count.front() && (block.rowwise() - block.row(0)).isZero(0);
  }
  return same;
}

}  // namespace

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
  std::size_t n_samples = 0;
  for (const Observations& group : observations) n_samples += static_cast<std::size_t>(group.n_data());
  reduction.samples.resize(n_samples);
  reduction.constant = 0;
  Split split;
  auto sample = reduction.samples.begin();
  for (std::size_t g = 0; g < observations.size(); ++g) {
    Whitening whitening(observations[g], noise_stddev[g]);
    for (int i = 0; i < observations[g].n_data(); ++i, ++sample) {
      sample->group = static_cast<int>(g);
      sample->index = i;
      whitening.move_to(i);
      split(observations[g], models[g], whitening, *sample);
      reduction.constant += sample->constant;
    }
  }
  sort_by_rank(reduction);
  stack(prior, models, reduction);
  reduction.same_directions.clear();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    reduction.same_directions.push_back(has_same_directions(prior.latents[a], reduction, reduction.directions[a]));
  }
}

}  // namespace gp2
