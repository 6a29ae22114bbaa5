#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <Eigen/QR>
#include <Eigen/SVD>

#include "gp2/error.hpp"
#include "gp2/mechanics.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// "at state 3 (q1 = 0.1, dq1 = 2): …", with the entries that are known
std::string describe_fault(const System& system, const Ref<const MatrixXd>& states, const MechanicsBatch::Fault& fault) {
  const std::vector<std::string> names = system.state_names();
  std::string where;
  for (Eigen::Index row = 0; row < states.rows(); ++row) {
    const double value = states(row, fault.state);
    if (std::isnan(value)) continue;
    where += fmt::format("{}{} = {:.6g}", where.empty() ? "" : ", ", names[static_cast<std::size_t>(row)], value);
  }
  return fmt::format("system '{}': {} at state {} ({})", system.name(), fault.text, fault.state + 1, where);
}

}  // namespace

UdwadiaKalaba::UdwadiaKalaba(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A, const Ref<const VectorXd>& b)
    : mass_factor_(M) {
  const Eigen::Index nq = M.rows();
  const Eigen::Index nc = A.rows();
  // LLT stops at a pivot ≤ 0; a pivot lost to rounding is as good as none
  const auto pivots = mass_factor_.matrixLLT().diagonal().array();
  if (mass_factor_.info() != Eigen::Success || !M.allFinite() || (pivots.square() <= 1e-14 * M.diagonal().array().abs()).any()) {
    mass_is_positive_definite_ = false;
    return;
  }

  if (nc == 0) {
    A_unit_ = A;
    b_unit_ = b;
    L_unit_.resize(nq, 0);
    ML_unit_.resize(nq, 0);
    T_ = MatrixXd::Identity(nq, nq);
    Lb_ = VectorXd::Zero(nq);
    return;
  }

  // Bᵀ = C⁻¹Aᵀ, its columns (the rows of B) scaled to unit norm; rows of A that vanish are dropped
  MatrixXd Bt = mass_factor_.matrixL().solve(A.transpose());
  row_scale_ = Bt.colwise().norm();
  for (double& scale : row_scale_) {
    if (scale == 0) ++n_zero_rows_;
    scale = scale == 0 ? 0 : 1 / scale;
  }
  Bt = Bt * row_scale_.asDiagonal();
  A_unit_ = row_scale_.asDiagonal() * A;
  b_unit_ = row_scale_.cwiseProduct(b);

  // Bᵀ P = [Y Z] [R; 0]: Y spans range(Bᵀ), Z its complement
  Eigen::ColPivHouseholderQR<MatrixXd> qr;
  qr.setThreshold(rank_tolerance);
  qr.compute(Bt);
  rank_ = static_cast<int>(qr.rank());
  const MatrixXd basis = qr.householderQ();
  const auto Y = basis.leftCols(rank_);
  const auto Z = basis.rightCols(nq - rank_);

  // T = C⁻ᵀ Z Zᵀ Cᵀ
  T_ = mass_factor_.matrixU().solve(Z * (mass_factor_.matrixL() * Z).transpose());

  // L = C⁻ᵀ B⁺ with B⁺ = Y (Rᵀ)⁺ Pᵀ
  L_unit_ = MatrixXd::Zero(nq, nc);
  if (rank_ > 0) {
    const MatrixXd Rt = qr.matrixR().topRows(rank_).triangularView<Eigen::Upper>().toDenseMatrix().transpose();
    const MatrixXd Rt_pinv = rank_ == nc ? MatrixXd(Rt.triangularView<Eigen::Lower>().solve(MatrixXd::Identity(nc, nc)))
                                         : MatrixXd(Rt.householderQr().solve(MatrixXd::Identity(nc, nc)));
    L_unit_ = mass_factor_.matrixU().solve(Y * Rt_pinv * qr.colsPermutation().transpose());
  }
  ML_unit_ = M * L_unit_;
  Lb_ = L_unit_ * b_unit_;

  // b must lie in range(A); a dropped row is 0 = b_k
  VectorXd residual = A_unit_ * Lb_ - b_unit_;
  for (Eigen::Index k = 0; k < nc; ++k) {
    if (row_scale_[k] == 0) residual[k] = b[k];
  }
  inconsistency_ = residual.lpNorm<Eigen::Infinity>();
  size_of_b_ = b_unit_.lpNorm<Eigen::Infinity>();
}

MatrixXd UdwadiaKalaba::L() const { return L_unit_ * row_scale_.asDiagonal(); }

MatrixXd UdwadiaKalaba::Lambda() const {
  return row_scale_.asDiagonal() * (L_unit_.transpose() * ML_unit_) * row_scale_.asDiagonal();
}

MatrixXd UdwadiaKalaba::multipliers_of_force() const {
  // Lᵀ Aᵀλ = ΛA M⁻¹Aᵀ λ solves Aᵀλ = f
  MatrixXd solution = row_scale_.asDiagonal() * L_unit_.transpose();
  const Eigen::Index nc = row_scale_.size();
  if (rank_ == nc) return solution;
  // redundant rows: take away what lies in the null space of Aᵀ. Of the unit rows its basis is clear; D brings it to the rows as
  // written
  const Eigen::JacobiSVD<MatrixXd> svd(A_unit_.transpose(), Eigen::ComputeFullV);
  const MatrixXd null_space = row_scale_.asDiagonal() * svd.matrixV().rightCols(nc - rank_);
  return solution - null_space * null_space.completeOrthogonalDecomposition().solve(solution);
}

MatrixXd UdwadiaKalaba::differentiate_Lambda(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA) const {
  const MatrixXd L = this->L();
  const MatrixXd Lambda_dA_L = Lambda() * (dA * L);
  return L.transpose() * dM * L - Lambda_dA_L - Lambda_dA_L.transpose();
}

VectorXd UdwadiaKalaba::constrain(const Ref<const VectorXd>& a_bar) const {
  VectorXd ddq = Lb_ + T_ * a_bar;
  ddq += L_unit_ * (b_unit_ - A_unit_ * ddq);
  return ddq;
}

UdwadiaKalaba::Derivative UdwadiaKalaba::differentiate(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA,
                                                       const Ref<const VectorXd>& db) const {
  // any fixed scaling of the rows gives the same T and L b, so the unit rows serve: dA → D dA, db → D db. Since M L = AᵀΛ,
  // ΛA = (M L)ᵀ and Λb = (M L)ᵀ L b
  const MatrixXd dA_unit = row_scale_.asDiagonal() * dA;
  MatrixXd force = dA_unit.transpose() * ML_unit_.transpose();  // dAᵀΛA − dM L A, and L A L b = L b
  if (!dM.isZero(0)) force -= dM * (L_unit_ * A_unit_);
  const MatrixXd T_M_inverse_force = T_ * mass_factor_.solve(force);
  Derivative d;
  d.Lb = T_M_inverse_force * Lb_ + L_unit_ * (row_scale_.cwiseProduct(db) - dA_unit * Lb_);
  d.T = -T_M_inverse_force - L_unit_ * (dA_unit * T_);
  return d;
}

MechanicsBatch evaluate_mechanics(const System& system, const Ref<const MatrixXd>& states,
                                  const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch{system.evaluate(states, parameters), {}, std::nullopt};
  const int n_states = batch.values.n_states();
  batch.projections.reserve(static_cast<std::size_t>(n_states));
  double size_of_b = 0;
  for (int i = 0; i < n_states; ++i) {
    const UdwadiaKalaba& projection = batch.projections.emplace_back(batch.values.M(i), batch.values.A(i), batch.values.b(i));
    if (!projection.mass_is_positive_definite()) {
      batch.fault = {i, "the mass matrix M is not positive definite"};
      return batch;
    }
    if (!batch.values.A(i).allFinite() || !batch.values.b(i).allFinite()) {
      batch.fault = {i, "A or b is not a finite number"};
      return batch;
    }
    size_of_b = std::max(size_of_b, projection.size_of_b());
  }
  for (int i = 0; i < n_states; ++i) {
    if (batch.projections[static_cast<std::size_t>(i)].inconsistency() > MechanicsBatch::consistency_tolerance * size_of_b) {
      batch.fault = {i, "the constraints contradict each other: no acceleration satisfies A ddq = b"};
      return batch;
    }
  }
  return batch;
}

MechanicsBatch require_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch = evaluate_mechanics(system, states, parameters);
  if (batch.fault) throw InputError(describe_fault(system, states, *batch.fault));
  return batch;
}

}  // namespace gp2
