#pragma once

#include <memory>
#include <vector>

#include "gp2/posterior.hpp"
#include "inference/reduction.hpp"

namespace gp2 {

/// The factored observations of a posterior, and what is stored for its predictions.
struct Posterior::Implementation {
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  Reduction reduction;
  std::vector<Eigen::MatrixXd> features;  // per latent (N × D)
  std::vector<Eigen::MatrixXd> Z;         // per latent: R_i E_a C_a
  std::vector<Eigen::MatrixXd> beta;      // per latent: β_j = Z_jᵀ α̃_j, one row per sample (N × functions)
  Eigen::MatrixXd L;                      // K̃ + I = L Lᵀ
  double negative_log_likelihood = 0;

  /// k_a between the observations and a point (N).
  void kernel_at(std::size_t a, const Eigen::Ref<const Eigen::VectorXd>& point, Eigen::VectorXd& k,
                 Kernel::Workspace& workspace) const {
    k.resize(features[a].rows());
    prior.latents[a].kernel.evaluate(features[a], point, values.kernel[a], k, workspace);
  }
};

/// Everything a view needs at N states: v(x_i) = G_i (μ_i + Σ_a E_a,i C_a f_a(φ_a,i)) + d_i.
struct Query {
  ViewValues view;
  PriorValues prior;
  std::vector<Eigen::MatrixXd> features;  // per latent (N × D)
  std::vector<Eigen::MatrixXd> C;         // per latent

  [[nodiscard]] int size() const { return static_cast<int>(view.offset.cols()); }  // N
  [[nodiscard]] Eigen::Index n_rows() const { return view.offset.rows(); }         // d
  /// G E_a C_a, the loading of the view on the functions of latent a at state i (d × functions).
  [[nodiscard]] Eigen::MatrixXd loading(std::size_t a, int i) const { return view.G(i) * prior.E(a, i) * C[a]; }
};

/// @throws InputError as require_mechanics.
Query make_query(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states);

/// Σ_i k̃(ỹ, view) at state i: cov(ỹ, v(x_i)) (reduced size × d).
void cross_covariance(const Posterior::Implementation& posterior, const Query& query, int i, Kernel::Workspace& workspace,
                      Eigen::VectorXd& k, Eigen::Ref<Eigen::MatrixXd> out);

/// cov(v(x_i), v'(x_j)) of the prior between two queries (d × d').
Eigen::MatrixXd prior_covariance(const Posterior::Implementation& posterior, const Query& left, int i, const Query& right, int j,
                                 Kernel::Workspace& workspace);

}  // namespace gp2
