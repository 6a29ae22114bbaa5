#include "inference/sample_gradient.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

SampleGradient::SampleGradient(const Likelihood::Options& options, const RowBlock& block, const ModelValues& values,
                               const GramGradient& of_gram)
    : options_(options),
      observations_(*block.observations),
      models_(*block.models),
      reduction_(*block.rows.reduction),
      first_group_(block.first_group),
      noise_stddev_(values.noise_stddev),
      of_gram_(of_gram),
      V_(of_gram.latents.size()) {
  for (std::size_t a = 0; a < V_.size(); ++a) loading_.push_back(values.loading(a));
}

void SampleGradient::add(Index i, ModelGradient& gradient) {
  const Reduction::Sample& sample = reduction_.samples[static_cast<std::size_t>(i)];
  const std::size_t group = static_cast<std::size_t>(sample.group);
  const ObservationModel& model = models_[group];
  const bool is_summed = observations_[group].has_sums();
  if (is_summed) {
    whitening_.setOnes(sample.Q.rows());
  } else {
    whitening_ = observations_[group].noise_at(noise_stddev_[first_group_ + group], sample.index).cwiseInverse();
  }
  differentiate_split(i, sample, model);
  if (sample.C.size() > 0) differentiate_noise(sample);
  if (options_.noise_gradient && !is_summed) add_noise(sample, model, gradient.log_noise_stddev[first_group_ + group]);
  if (!options_.gradient_parameters.empty()) add_parameters(sample, model, gradient.parameters);
}

void SampleGradient::differentiate_split(Index i, const Reduction::Sample& sample, const ObservationModel& model) {
  const Index rank = sample.R.rows();
  // α_i = Q_i α̃_i + (I − Q_iQ_iᵀ) e_i
  alpha_i_.resize(rank);
  for (Index c = 0; c < rank; ++c) alpha_i_[c] = of_gram_.alpha[reduction_.offset[static_cast<std::size_t>(c)] + i];
  d_e_ = sample.e_out;
  d_e_.noalias() += sample.Q.lazyProduct(alpha_i_);
  // ∂NLL/∂W_i = Q_i Σ_a V_i,a E_aᵀ − (I − Q_iQ_iᵀ) e_i (posterior mean of ā − μ)ᵀ
  V_E_.setZero(rank, sample.R.cols());
  mean_.setZero(sample.R.cols());
  for (std::size_t a = 0; a < V_.size(); ++a) {
    const GramGradient::OfLatent& of_latent = of_gram_.latents[a];
    E_.noalias() = model.values.prior.E(a, sample.index).lazyProduct(loading_[a]);
    const Index m = of_latent.mean.cols();
    V_[a].resize(rank, m);
    for (Index c = 0; c < rank; ++c) V_[a].row(c) = of_latent.V.row(i).segment(c * m, m);
    V_E_.noalias() += V_[a].lazyProduct(E_.transpose());
    mean_.noalias() += E_.lazyProduct(of_latent.mean.row(i).transpose());
  }
  d_W_.noalias() = sample.Q.lazyProduct(V_E_);
  d_W_.noalias() -= sample.e_out.lazyProduct(mean_.transpose());
}

// NLL is a function of C⁻¹G and C⁻¹r, plus log|C|, and of C only through S = C Cᵀ: with B = (∂NLL/∂W)Wᵀ + (∂NLL/∂e)eᵀ, which is
// symmetric, ∂NLL/∂S = ½C⁻ᵀ(I − B)C⁻¹
void SampleGradient::differentiate_noise(const Reduction::Sample& sample) {
  const auto C = sample.C.triangularView<Eigen::Lower>();
  d_S_ = -(d_W_ * sample.R.transpose()) * sample.Q.transpose() - d_e_ * sample.e.transpose();
  d_S_.diagonal().array() += (whitening_.array() > 0).cast<double>();
  C.transpose().solveInPlace(d_S_);
  d_S_ = 0.25 * C.transpose().solve(MatrixXd(d_S_.transpose()));
  d_S_ += MatrixXd(d_S_.transpose());
}

// S^{-1/2} scales the rows of W and e, and σ_k the whole row k of S^{1/2}
void SampleGradient::add_noise(const Reduction::Sample& sample, const ObservationModel& model, VectorXd& d_noise) const {
  if (sample.C.size() > 0) {
    for (Index k = 0; k < d_noise.size(); ++k) {
      if (whitening_[k] > 0) d_noise[k] += 2 * d_S_(k, k) / (whitening_[k] * whitening_[k]);
    }
    return;
  }
  const auto G = model.values.view.G(sample.index);
  // a value of weight 0, which is not measured, has no log S
  d_noise.array() += (whitening_.array() > 0).cast<double>() - d_e_.array() * sample.e.array() -
                     whitening_.array() * d_W_.cwiseProduct(G).rowwise().sum().array();
}

// e = S^{-1/2}(y − d − Gμ) and W = S^{-1/2}G: ∂NLL/∂d, ∂NLL/∂G, ∂NLL/∂μ and ∂NLL/∂E, then along θ
void SampleGradient::add_parameters(const Reduction::Sample& sample, const ObservationModel& model, VectorXd& d_parameters) {
  const auto G = model.values.view.G(sample.index);
  if (sample.C.size() > 0) {
    d_offset_ = -sample.C.triangularView<Eigen::Lower>().transpose().solve(d_e_);
    d_G_ = sample.C.triangularView<Eigen::Lower>().transpose().solve(d_W_);
  } else {
    d_offset_ = -whitening_.cwiseProduct(d_e_);
    d_G_ = whitening_.asDiagonal() * d_W_;
  }
  d_G_.noalias() += d_offset_.lazyProduct(model.values.prior.mean.col(sample.index).transpose());
  d_mean_.noalias() = G.transpose().lazyProduct(d_offset_);
  for (std::size_t a = 0; a < V_.size(); ++a) {
    E_.noalias() = sample.R.transpose().lazyProduct(V_[a]);
    V_[a].noalias() = E_.lazyProduct(loading_[a].transpose());  // now ∂NLL/∂E_a
  }
  for (std::size_t p = 0; p < options_.gradient_parameters.size(); ++p) {
    const ObservationModel::Values& d = model.derivatives[p];
    double slope = d_offset_.dot(d.view.offset.col(sample.index)) + d_G_.cwiseProduct(d.view.G(sample.index)).sum() +
                   d_mean_.dot(d.prior.mean.col(sample.index));
    for (std::size_t a = 0; a < V_.size(); ++a) slope += V_[a].cwiseProduct(d.prior.E(a, sample.index)).sum();
    if (sample.C.size() > 0) slope += 2 * (d_S_ * model.values.view.N(sample.index)).cwiseProduct(d.view.N(sample.index)).sum();
    d_parameters[options_.gradient_parameters[p]] += slope;
  }
}

}  // namespace gp2
