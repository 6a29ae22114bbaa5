#pragma once

#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "inference/nonlinear_motion.hpp"
#include "inference/posterior_implementation.hpp"

namespace gp2 {

/// Everything a view needs at n states: v(x_i) = G_i (μ_i + Σ_a E_a,i C_a f_a(φ_a,i)) + d_i.
struct Query {
  MechanicsBatch mechanics;
  ViewValues view;
  PriorValues prior;
  std::vector<Eigen::MatrixXd> features;  // per latent (n × D)
  std::optional<LatentRange> needed;      // those that are viewed; of a nonlinear prior all, as λ takes them

  [[nodiscard]] Eigen::Index size() const { return view.offset.cols(); }    // n
  [[nodiscard]] Eigen::Index n_rows() const { return view.offset.rows(); }  // d
  [[nodiscard]] bool needs(std::size_t a) const { return !needed || needed->has(a); }

  /// Of the states first … first + n − 1, in the memory of what was there.
  /// @throws InputError as require_mechanics of the prior for all states.
  void evaluate(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                Eigen::Index first, Eigen::Index n);

  /// Of a nonlinear prior: takes v to first order about f_a at each state, where it is exact, per latent (F × n). Before each of the two
  /// below; of another prior it does nothing.
  /// @throws InputError where a state has no motion under them
  void linearise(const Posterior::Implementation& posterior, const std::vector<Eigen::MatrixXd>& f);
  /// The same about the posterior mean of f_a.
  void linearise_at_mean(const Posterior::Implementation& posterior);

  /// v at every state, given f_a there, per latent (F × n).
  void view_of(const Posterior::Implementation& posterior, const std::vector<Eigen::MatrixXd>& f,
               Eigen::Ref<Eigen::MatrixXd> values) const;

  /// (G E_a C_a)ᵀ per latent: of v = … + Σ_a ℓ_aᵀ f_a at each state (F·d × n). Zero where the latent is not needed.
  [[nodiscard]] std::vector<Eigen::MatrixXd> loadings(const Posterior::Implementation& posterior) const;

  /// The same of w, some rows of v of which the latents' part of all others is made, v = … + U w: as many at each state as the most at
  /// any of them need, zeros beyond its own. Constraints leave some rows to others.
  struct Fewer {
    Eigen::Index n_rows = 0;                // r
    Eigen::MatrixXd U;                      // (d·r × n), column-major blocks
    std::vector<Eigen::MatrixXd> loadings;  // per latent (F·r × n)
  };
  [[nodiscard]] Fewer fewer_loadings(const Posterior::Implementation& posterior) const;

 private:
  struct Nonlinear {
    MechanicsBatch mechanics;
    std::unique_ptr<NonlinearMotion> motion;
    ViewValues view;  // without latents
    View of;
    Eigen::Index first = 0;  // number of the first state among all, for the message
  };
  std::shared_ptr<const Nonlinear> nonlinear_;  // null of a linear prior
};

/// evaluate_features at the states first … first + n − 1.
/// @throws InputError as it, which counts a state among all.
Eigen::MatrixXd features_of_block(const Prior& prior, std::size_t a, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                  Eigen::Index first, Eigen::Index n);

/// @throws InputError as require_view and System::require_states.
void require_query(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states);

/// What was computed of a view at states: d numbers, or more, of each.
/// @param system  where the states are
/// @param first   number of the first of the states among all, from 0
/// @throws InputError naming the first state at which one of them overflowed.
void require_finite(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                    const Eigen::Ref<const Eigen::MatrixXd>& computed, Eigen::Index first = 0);

/// @throws InputError as require_query and Query::evaluate.
Query make_query(const Posterior::Implementation& posterior, const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states);

}  // namespace gp2
