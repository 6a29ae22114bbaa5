#pragma once

#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/prior.hpp"

namespace gp2 {

/// ā(λ) and J = ∂ā/∂λ of latents whose directions read λ (theory.md, T46), at one state after another. Allocates nothing after the
/// constructor.
class MotionUnderLoad {
 public:
  struct OfLatent {
    std::size_t latent = 0;
    bool acts_on_forces = false;
    std::unique_ptr<StateFunction::Evaluator> directions;
    Eigen::VectorXd c;      // amplitudes, given before move_to (p)
    Eigen::VectorXd B, dB;  // directions and their derivatives at [x; λ], as `directions` gives them
  };

  /// @param derivative_in  of directions in a parameter, in the place of directions
  MotionUnderLoad(const Prior& prior, const Eigen::VectorXd& parameters, std::optional<int> derivative_in = std::nullopt);

  /// Those latents, in the order of the prior.
  [[nodiscard]] std::vector<OfLatent>& latents() { return latents_; }

  /// @param projection, without_load  there; both outlive the calls of evaluate. The second is ā without these latents.
  void move_to(const Eigen::Ref<const Eigen::VectorXd>& state, const UdwadiaKalaba& projection,
               const Eigen::VectorXd& without_load);
  /// @param a_bar, slope  receive ā (nq) and J (nq × nc), of this size
  void evaluate(const Eigen::VectorXd& lambda, Eigen::VectorXd& a_bar, Eigen::MatrixXd& slope);
  /// The part of J, where it was evaluated last, that has been multiplied by M⁻¹.
  [[nodiscard]] const Eigen::MatrixXd& forced_slope() const { return forced_slope_; }

 private:
  std::vector<OfLatent> latents_;
  Eigen::Index n_state_;
  Eigen::VectorXd x_;  // [x; λ]
  Eigen::VectorXd force_;
  Eigen::MatrixXd forced_slope_;
  const UdwadiaKalaba* projection_ = nullptr;
  const Eigen::VectorXd* without_load_ = nullptr;
};

}  // namespace gp2
