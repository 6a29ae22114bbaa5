#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "gp2/posterior.hpp"
#include "inference/growing_cholesky.hpp"
#include "inference/reduction.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// The factored observations of a posterior, and what is stored for its predictions.
///
/// A sample is one observed state; it has as many components as the rank of what was measured there. Component c of sample j is
/// row row_of[c][j] of the reduced vectors and of the factor; nothing else depends on how these rows are ordered.
struct Posterior::Implementation {
  struct Sample {
    int group = 0;            // Observations it is of
    std::int64_t number = 0;  // rising in the order of adding
    double constant = 0;      // what it adds to −log p(y) beside N(ỹ; 0, K̃ + I)
  };

  /// What is known of one latent at the samples. Rows of samples are padded to whole vectors (simd.hpp).
  struct LatentAtSamples {
    KernelColumns kernel;  // k_a between the samples and a point
    Eigen::MatrixXd C;     // loading (p × F)
    Eigen::MatrixXd Z;     // column c·F + l: entry l of row c of R_j E_a C_a, 0 where there is none (n_rows × components·F)
    Eigen::MatrixXd beta;  // β_j = Z_jᵀ α̃_j (n_rows × F)

    [[nodiscard]] Eigen::Index n_functions() const { return C.cols(); }  // F
  };

  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  std::vector<Sample> samples;
  std::vector<LatentAtSamples> latents;
  std::vector<std::vector<Eigen::Index>> row_of;  // [component][sample]; −1: it has fewer components
  Eigen::VectorXd y;                              // ỹ, by row
  GrowingCholesky factor;                         // of K̃ + I, with L⁻¹ỹ
  std::int64_t next_number = 0;
  double negative_log_likelihood = 0;

  [[nodiscard]] int n_components() const { return static_cast<int>(row_of.size()); }
  /// β of one latent from α̃, by row (n_rows × F).
  [[nodiscard]] Eigen::MatrixXd latent_weights(std::size_t a, const Eigen::VectorXd& alpha) const;
  /// β and the likelihood from the factor.
  void finish();

  /// Samples of more observations; `observations` and β stay as they are. On an error nothing has changed.
  /// @param noise_stddev  per group
  /// @param first_group   the group of `observations` that groups[0] is, or is going to be
  /// @throws as the constructor of Posterior.
  void add_samples(const std::vector<Observations>& groups, const std::vector<Eigen::VectorXd>& noise_stddev, int first_group);
  /// Takes samples away, at rising indices; `observations` and β stay as they are.
  void erase_samples(const std::vector<Eigen::Index>& gone);
};

/// Everything a view needs at n states: v(x_i) = G_i (μ_i + Σ_a E_a,i C_a f_a(φ_a,i)) + d_i.
struct Query {
  MechanicsBatch mechanics;
  ViewValues view;
  PriorValues prior;
  std::vector<Eigen::MatrixXd> features;  // per latent (n × D)
  std::optional<int> latent;              // the one that is viewed alone

  [[nodiscard]] Eigen::Index size() const { return view.offset.cols(); }    // n
  [[nodiscard]] Eigen::Index n_rows() const { return view.offset.rows(); }  // d
  [[nodiscard]] bool needs(std::size_t a) const { return !latent || *latent == static_cast<int>(a); }

  /// Of the states first … first + n − 1, in the memory of what was there.
  /// @throws InputError as require_mechanics of the prior for all states.
  void evaluate(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                Eigen::Index first, Eigen::Index n);

  /// v at every state, given f_a there, per latent (F × n).
  void view_of(const Posterior::Implementation& posterior, const std::vector<Eigen::MatrixXd>& f,
               Eigen::Ref<Eigen::MatrixXd> values) const;

  /// (G E_a C_a)ᵀ per latent: of v = … + Σ_a ℓ_aᵀ f_a at each state (F·d × n). Zero where the latent is not viewed.
  [[nodiscard]] std::vector<Eigen::MatrixXd> loadings(const Posterior::Implementation& posterior) const;
};

Query make_query(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
