#pragma once

#include <atomic>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "gp2/base/workers.hpp"
#include "gp2/export.hpp"
#include "gp2/inference/model_values.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 GP2_API {

/// The negative log marginal likelihood of observations under a prior, in its reduced, jitter-free form, and its exact gradient.
///
/// With W = S^{-1/2}G = Q R (Q orthonormal, r = rank), e = S^{-1/2}(y − d − Gμ) and ỹ = Qᵀe at each observation,
///
///     −log p(y) = −log N(ỹ; 0, K̃ + I) + ½ Σ‖(I − QQᵀ)e‖² + ½ Σ log|S| + ½ Σ (dim y − r) log 2π,
///     K̃_ij      = Σ_a R_i E_a(x_i) C_a k_a,ij C_aᵀE_a(x_j)ᵀ R_jᵀ.
///
/// The factored matrix has Σ r rows and eigenvalues ≥ 1: nothing is ever added to its diagonal. Thread-safe. Every member function
/// throws InputError when the likelihood, or the workspace, was moved away.
class Likelihood {
 public:
  struct Options {
    std::vector<int> gradient_parameters;  // indices of the system's parameters whose derivative `evaluate` gives
    bool noise_gradient = false;           // whether it gives the derivatives in the noise
    Workers workers = {};                  // on what is made once, where it is through inducing points
  };

  /// @param initial  where the options ask for no parameter's derivative `parameters` stay as they are here, and `noise_stddev` too
  ///                 unless they ask for the noise's: observations are reduced once then.
  /// @throws InputError when prior, observations, values and options do not fit each other; and as require_mechanics and
  /// require_prior_values, under `initial`.
  Likelihood(Prior prior, std::vector<Observations> observations, const ModelValues& initial, Options options);
  ~Likelihood();
  Likelihood(Likelihood&&) noexcept;

  /// Memory reused between calls; one per thread that calls.
  class Workspace {
   public:
    /// @param workers  on one evaluation; other processes through inducing points only. Threads are used where there are enough
    ///                 samples for it to pay. The sums keep their order whatever it is; a factorisation of more than 2000 rows
    ///                 on several threads is rounded differently.
    /// @param stop     set: `evaluate` gives up within a second or so and returns +∞
    explicit Workspace(const Workers& workers = {}, const std::atomic<bool>* stop = nullptr);
    ~Workspace();

   private:
    friend class Likelihood;
    struct Implementation;
    std::unique_ptr<Implementation> implementation_;
  };

  /// −log p(y | values): +∞ where the mechanics or the prior have a fault (evaluate_mechanics, evaluate_prior), the factorisation
  /// fails, or the workspace is told to stop.
  ///
  /// @param gradient  when not null, receives the gradient: zero in a fixed kernel, and where the options do not ask for the noise
  ///                  or a parameter. Left as it was when the value is +∞.
  /// @throws InputError when the values do not fit the prior and the observations, or differ from `initial` in what stays as it is
  /// there.
  double evaluate(const ModelValues& values, ModelGradient* gradient, Workspace& workspace) const;

  [[nodiscard]] const Prior& prior() const;
  [[nodiscard]] const std::vector<Observations>& observations() const;
  [[nodiscard]] int reduced_size() const;  // Σ r, under the initial values

 private:
  struct Implementation;
  [[nodiscard]] const Implementation& implementation() const;  // throws when it was moved away
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace gp2
