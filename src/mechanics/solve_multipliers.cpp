#include "mechanics/solve_multipliers.hpp"

#include <limits>

#include <Eigen/LU>

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// Newton's method on r(λ) = λ − G ā_τ(λ) − d, ā_τ(λ) = ā(0) + τ (ā(λ) − ā(0)). One step is exact where forces are proportional to
// |λ| and no multiplier changes its sign.
class Newton {
 public:
  Newton(const Ref<const MatrixXd>& G, const Ref<const VectorXd>& d, const MotionUnderLoad& motion)
      : G_(G), d_(d), motion_(motion), a_bar_(G.cols()), slope_(G.cols(), G.rows()) {
    motion_(VectorXd::Zero(G.rows()), a_bar_, slope_);
    free_ = a_bar_;
    lambda_ = G_ * free_ + d_;
    size_ = lambda_.norm();
  }

  bool run(double tau) {
    constexpr int most = 40;
    constexpr double enough = 64 * std::numeric_limits<double>::epsilon();
    for (int step = 0; step < most; ++step) {
      motion_(lambda_, a_bar_, slope_);
      const Eigen::PartialPivLU<MatrixXd> D(MatrixXd::Identity(G_.rows(), G_.rows()) - tau * (G_ * slope_));
      if (!(D.determinant() > 0)) return false;
      const VectorXd change = D.solve(lambda_ - G_ * (free_ + tau * (a_bar_ - free_)) - d_);
      lambda_ -= change;
      if (change.norm() <= enough * (size_ + lambda_.norm())) return lambda_.allFinite();
    }
    return false;
  }

  [[nodiscard]] const VectorXd& lambda() const { return lambda_; }

 private:
  const Ref<const MatrixXd>& G_;
  const Ref<const VectorXd>& d_;
  const MotionUnderLoad& motion_;
  VectorXd free_, lambda_, a_bar_;
  MatrixXd slope_;
  double size_ = 0;
};

}  // namespace

std::optional<VectorXd> solve_multipliers(const Ref<const MatrixXd>& G, const Ref<const VectorXd>& d,
                                          const MotionUnderLoad& motion) {
  if (Newton at_once(G, d, motion); at_once.run(1)) return at_once.lambda();
  constexpr int n_steps = 16;  // the load is let in bit by bit
  Newton slowly(G, d, motion);
  for (int step = 1; step <= n_steps; ++step) {
    if (!slowly.run(static_cast<double>(step) / n_steps)) return std::nullopt;
  }
  return slowly.lambda();
}

MechanicsBatch::Fault no_multipliers(int state) {
  MechanicsBatch::Fault fault{state, {}};
  fault.text =
      "a force that grows with the load of the constraints makes more load than it needs: there is no motion, or more than one "
      "(Painlevé's paradox); its coefficient is too large here";
  return fault;
}

}  // namespace gp2
