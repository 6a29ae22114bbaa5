#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>

#include "gp2/inference/model_values.hpp"
#include "gp2/prior.hpp"
#include "gp2/view.hpp"

namespace gp2 {

/// A prior that is nonlinear in its latents (Prior::is_nonlinear) at N states. With signals s_a = C_a f_a and c_a = s_a, or exp(s_a)
/// of a positive latent,
///
///     ā = μ + Σ_a E_a(x, λ) c_a,    λ = G_λ ā + d_λ,
///
/// G_λ and d_λ those of the view of the multipliers. To first order in the signals about s_a*, λ* every view v = G ā + d is
///
///     v = G̃ (μ + Σ_a Ẽ_a s_a + o) + d̃,    G̃ = G (I + J D⁻¹G_λ),    d̃ = d + G J D⁻¹(d_λ − λ*),    Ñ = N + G J D⁻¹N_λ,
///
/// with J = Σ_a ∂E_a/∂λ c_a, D = I − G_λ J, Ẽ_a = E_a(x, λ*) diag(c_a'), o = Σ_a E_a(x, λ*)(c_a − c_a' ∘ s_a*): a linear prior (theory.md,
/// T47), and exact at s_a*. As A G = 0 of an acceleration, A G̃ = 0. What some latents S add alone depends on the others through λ:
///
///     v_S = G (Σ_S (Ẽ_a s_a + o_a) + J_S D⁻¹(G_λ (μ + Σ_a Ẽ_a s_a + o) + d_λ − λ*)),    J_S = Σ_S ∂E_a/∂λ c_a.
class NonlinearMotion {
 public:
  /// @param prior          where the states are (prior_of); outlives it
  /// @param mechanics      at the states; outlives it
  /// @param at_known_load  of evaluate_prior there, without a fault
  NonlinearMotion(const Prior& prior, Eigen::MatrixXd states, Eigen::VectorXd parameters, const MechanicsBatch& mechanics,
                  PriorValues at_known_load);

  /// λ under the signals; NaN at the state of a fault, which is returned.
  [[nodiscard]] std::optional<MechanicsBatch::Fault> solve(Linearisation::OfGroup& at) const;

  /// The linear prior and view in the place of those at λ₀.
  /// @param prior  receives it; with a fault where a direction is not finite at λ*
  void linearise(const View& view, const Linearisation::OfGroup& at, ViewValues& viewed, PriorValues& prior) const;

  /// ∂/∂p of what linearise gives for a view of everything, at held s_a* and λ*.
  /// @param viewed, d_viewed  before and after: evaluate_view and differentiate_view
  /// @param d_prior           receives that of the prior
  void differentiate(const Linearisation::OfGroup& at, const SystemValues& derivative, int index, const ViewValues& viewed,
                     ViewValues& d_viewed, PriorValues& d_prior) const;

  [[nodiscard]] const Eigen::MatrixXd& states() const { return states_; }
  [[nodiscard]] int n_states() const { return static_cast<int>(states_.cols()); }
  /// Signals of size 0.
  [[nodiscard]] Linearisation::OfGroup without_signals() const;

 private:
  class Under;
  // of a view of some latents alone; `prior` is that of all at λ*
  void linearise_part(const View& view, const Linearisation::OfGroup& at, const std::vector<Eigen::MatrixXd>& c,
                      PriorValues& prior) const;
  // Ñ = N + G J D⁻¹N_λ
  void add_to_slip(const Linearisation::OfGroup& at, ViewValues& viewed) const;
  void linearise_amplitudes(const Linearisation::OfGroup& at, const std::vector<Eigen::MatrixXd>& c, int i,
                            PriorValues& prior) const;

  const Prior& prior_;
  Eigen::MatrixXd states_;
  Eigen::VectorXd parameters_;
  const MechanicsBatch& mechanics_;
  View of_multipliers_;
  PriorValues at_known_load_;
  ViewValues multipliers_;  // G_λ, d_λ
};

}  // namespace gp2
