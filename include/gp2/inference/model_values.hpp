#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Points at which latents are known, in the features of each; where there are more observations than K̃ + I can be factored for
/// (theory.md, T37; choose_inducing_points).
struct InducingPoints {
  std::vector<Eigen::MatrixXd> features;  // per latent: φ_a, one row per point (m_a × D_a)
};

/// Where latents that enter nonlinearly are made linear (Prior::is_nonlinear; theory.md, T47).
struct Linearisation {
  struct OfGroup {
    std::vector<Eigen::MatrixXd> signals;  // C_a f_a at each state, per latent (p_a × N)
    Eigen::MatrixXd multipliers;           // λ at each state (nc × N)
    /// Where the noise is taken to which soft constraints give rise; null: here.
    std::shared_ptr<const OfGroup> noise_about = {};
  };
  std::vector<OfGroup> groups;  // one per Observations
};

/// Everything about a prior and its observations that can be tuned, in physical units.
struct ModelValues {
  std::vector<Eigen::VectorXd> kernel;         // per latent: the kernel's parameters
  std::vector<Eigen::VectorXd> signal_stddev;  // per latent: s of C = diag(s) (p); ones where C is free
  std::vector<Eigen::MatrixXd> free_loading;   // per latent: C where it is free (p × functions), else empty; may be left empty
  std::vector<Eigen::VectorXd> noise_stddev;   // per Observations: σ (d), of values with a noise of their own the common factor
  Eigen::VectorXd parameters;                  // of the system: θ
  std::shared_ptr<const InducingPoints> inducing = {};  // null: exact
  /// Of a likelihood, as it is given at first; null: where no latent acts. A posterior finds its own.
  std::shared_ptr<const Linearisation> about = {};

  [[nodiscard]] bool has_free_loading(std::size_t a) const { return a < free_loading.size() && free_loading[a].size() > 0; }
  /// C_a of latent a (p × functions).
  [[nodiscard]] Eigen::MatrixXd loading(std::size_t a) const;
};

/// The gradient of the negative log likelihood: in the logarithm of each number that is positive by nature, a parameter of a
/// kernel or a standard deviation, and in C and θ themselves. Shapes are those of ModelValues.
struct ModelGradient {
  std::vector<Eigen::VectorXd> log_kernel;
  std::vector<Eigen::VectorXd> log_signal_stddev;  // zero where C is free
  std::vector<Eigen::MatrixXd> free_loading;
  std::vector<Eigen::VectorXd> log_noise_stddev;
  Eigen::VectorXd parameters;

  static ModelGradient zero(const ModelValues& values);
  void add(const ModelGradient& other);

  /// Calls work(first number, how many) for every vector and matrix.
  template <typename Work>
  void for_each(const Work& work) {
    for (auto* group : {&log_kernel, &log_signal_stddev, &log_noise_stddev}) {
      for (Eigen::VectorXd& one : *group) work(one.data(), one.size());
    }
    for (Eigen::MatrixXd& one : free_loading) work(one.data(), one.size());
    work(parameters.data(), parameters.size());
  }
};

}  // namespace gp2
