#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/inference/likelihood.hpp"
#include "inference/gram.hpp"

namespace gp2 {

/// What the noise σ and the parameters θ change at one sample: ∂NLL/∂e, ∂NLL/∂W and ∂NLL/∂E there (theory.md, T13), and the chain
/// rule from these on to σ and θ. Everything it is given must outlive it.
class SampleGradient {
 public:
  /// @param of_gram  with V and mean of every latent
  SampleGradient(const Likelihood::Options& options, const RowBlock& block, const ModelValues& values,
                 const GramGradient& of_gram);

  /// Adds what sorted sample i contributes.
  void add(Eigen::Index i, ModelGradient& gradient);

 private:
  // α_i and ∂NLL/∂W_i
  void differentiate_split(Eigen::Index i, const Reduction::Sample& sample, const ObservationModel& model);
  // ∂NLL/∂S where constraints are soft
  void differentiate_noise(const Reduction::Sample& sample);
  void add_noise(const Reduction::Sample& sample, const ObservationModel& model, Eigen::VectorXd& d_noise) const;
  void add_parameters(const Reduction::Sample& sample, const ObservationModel& model, Eigen::VectorXd& d_parameters);

  const Likelihood::Options& options_;
  const std::vector<Observations>& observations_;
  const std::vector<ObservationModel>& models_;
  const Reduction& reduction_;
  std::size_t first_group_;  // of all Observations, that observations_.front() is
  const std::vector<Eigen::VectorXd>& noise_stddev_;
  const GramGradient& of_gram_;
  std::vector<Eigen::MatrixXd> loading_;  // per latent: C_a
  // memory used again at each sample
  std::vector<Eigen::MatrixXd> V_;
  Eigen::MatrixXd V_E_, E_, d_W_, d_G_, d_S_;
  Eigen::VectorXd whitening_;  // S^{-1/2}
  Eigen::VectorXd alpha_i_, d_e_, mean_, d_offset_, d_mean_;
};

}  // namespace gp2
