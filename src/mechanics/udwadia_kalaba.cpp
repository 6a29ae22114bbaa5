#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include <fmt/format.h>
#include <Eigen/QR>
#include <Eigen/SVD>

#include "gp2/error.hpp"
#include "gp2/mechanics.hpp"
#include "mechanics/dot.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
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

constexpr double smallest_row = std::numeric_limits<double>::min();  // of which there is an inverse

// M = C Cᵀ, from the lower triangle of M to C in its place; false where a pivot is lost to rounding, or negative
bool factorise(MatrixXd& M) {
  const Index n = M.rows();
  for (Index k = 0; k < n; ++k) {
    double* const pivot = M.col(k).data() + k;
    double square = *pivot;
    for (Index j = 0; j < k; ++j) square -= M(k, j) * M(k, j);
    if (!(square > 1e-14 * std::abs(*pivot))) return false;
    *pivot = std::sqrt(square);
    const double scale = 1 / *pivot;
    for (Index j = 0; j < k; ++j) {
      const double factor = M(k, j);
      for (Index i = 1; i < n - k; ++i) pivot[i] -= factor * M(k + i, j);
    }
    for (Index i = 1; i < n - k; ++i) pivot[i] *= scale;
  }
  return true;
}

// X := C⁻¹ X. Row by row: the columns do not wait for each other
template <typename Matrix>
void solve_lower(const MatrixXd& C, Matrix& X) {
  const Index n = C.rows();
  for (Index k = 0; k < n; ++k) {
    const double* const below = C.col(k).data() + k + 1;
    const double inverse = 1 / C(k, k);
    for (Index j = 0; j < X.cols(); ++j) {
      double* const x = X.data() + j * X.outerStride() + k;
      const double value = *x * inverse;
      *x = value;
      for (Index i = 0; i < n - k - 1; ++i) x[i + 1] -= below[i] * value;
    }
  }
}

// X := C⁻ᵀ X
template <typename Matrix>
void solve_upper(const MatrixXd& C, Matrix& X) {
  const Index n = C.rows();
  for (Index k = n - 1; k >= 0; --k) {
    const double* const below = C.col(k).data() + k + 1;
    const double inverse = 1 / C(k, k);
    for (Index j = 0; j < X.cols(); ++j) {
      double* const x = X.data() + j * X.outerStride() + k;
      *x = (*x - internal::dot(below, x + 1, n - k - 1)) * inverse;
    }
  }
}

}  // namespace

void UdwadiaKalaba::compute(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A, const Ref<const VectorXd>& b) {
  const Index nq = M.rows();
  const Index nc = A.rows();
  rank_ = n_zero_rows_ = 0;
  inconsistency_ = size_of_b_ = 0;
  mass_factor_ = M;
  mass_is_positive_definite_ = M.allFinite() && factorise(mass_factor_);
  if (!mass_is_positive_definite_) return;

  // Bᵀ = C⁻¹Aᵀ, its columns (the rows of B) scaled to unit norm; rows of A that vanish are dropped
  rows_ = A.transpose();
  A_unit_ = A;
  b_unit_ = b;
  row_scale_.resize(nc);
  solve_lower(mass_factor_, rows_);
  for (Index k = 0; k < nc; ++k) {
    double* const row = rows_.col(k).data();
    double norm = std::sqrt(internal::dot(row, row, nq));
    // squares of tiny and huge entries are no doubles
    if (!(norm > 1e-140 && norm < 1e140)) norm = rows_.col(k).stableNorm();
    const double scale = norm < smallest_row ? 0 : 1 / norm;
    if (scale == 0) ++n_zero_rows_;
    row_scale_[k] = scale;
    b_unit_[k] *= scale;
    for (Index i = 0; i < nq; ++i) {
      row[i] *= scale;
      A_unit_(k, i) *= scale;
    }
  }
  decompose_rows();
  ML_unit_.noalias() = M * L_unit_;

  // b must lie in range(A); a dropped row is 0 = b_k
  Lb_.noalias() = L_unit_ * b_unit_;
  residual_ = b_unit_;
  residual_.noalias() -= A_unit_ * Lb_;
  for (Index k = 0; k < nc; ++k) {
    inconsistency_ = std::max(inconsistency_, std::abs(row_scale_[k] == 0 ? b[k] : residual_[k]));
    size_of_b_ = std::max(size_of_b_, std::abs(b_unit_[k]));
  }
}

// T and L from Bᵀ, of unit columns, in rows_
void UdwadiaKalaba::decompose_rows() {
  const Index nq = rows_.rows();
  const Index nc = rows_.cols();
  reflection_.resize(std::min(nq, nc));
  order_.resize(nc);
  const Index rank = internal::pivoted_qr(rows_, reflection_, order_, rank_tolerance);
  rank_ = static_cast<int>(rank);

  // nothing constrains the motion: T = I to the bit, so that the force of constraints is 0 and not rounding that looks like news
  if (rank == 0) {
    T_.setIdentity(nq, nq);
    L_unit_.setZero(nq, nc);
    return;
  }

  // Bᵀ P = [Y Z] [R; 0]: Y spans range(Bᵀ), Z its complement, and T = C⁻ᵀ Z Zᵀ Cᵀ
  T_ = mass_factor_.transpose();
  for (Index j = 0; j < nq; ++j) T_.col(j).tail(nq - 1 - j).setZero();
  internal::apply_Q_transposed(rows_, reflection_, rank, T_);
  T_.topRows(rank).setZero();
  internal::apply_Q(rows_, reflection_, rank, T_);

  // B⁺ = Y (Rᵀ)⁺ Pᵀ, in the place of L = C⁻ᵀ B⁺
  L_unit_.setZero(nq, nc);
  if (rank == nc) {
    // (Rᵀ)⁻¹, lower triangular, by columns
    for (Index j = 0; j < nc; ++j) {
      double* const x = L_unit_.col(order_[j]).data();
      for (Index i = j; i < nc; ++i) {
        x[i] = ((i == j ? 1 : 0) - internal::dot(rows_.col(i).data() + j, x + j, i - j)) / rows_(i, i);
      }
    }
  } else {
    // Rᵀ P₂ = Q₂ R₂ is (nc × rank), of full rank: (Rᵀ)⁺ = P₂ R₂⁻¹ Q₂ᵀ
    R_transposed_.resize(nc, std::min(nq, nc));
    reflection2_.resize(R_transposed_.cols());
    order2_.resize(R_transposed_.cols());
    auto Rt = R_transposed_.leftCols(rank);
    for (Index i = 0; i < rank; ++i) {
      Rt.col(i).head(i).setZero();
      Rt.col(i).tail(nc - i) = rows_.row(i).tail(nc - i).transpose();
    }
    internal::pivoted_qr(Rt, reflection2_.head(rank), order2_.head(rank), 0);
    for (Index j = 0; j < nc; ++j) {
      // column j of (Rᵀ)⁺, from column j of Q₂ᵀ
      residual_.setZero(nc);
      residual_[j] = 1;
      internal::apply_Q_transposed(Rt, reflection2_, rank, residual_);
      double* const x = L_unit_.col(order_[j]).data();
      for (Index i = rank - 1; i >= 0; --i) {
        const double value = residual_[i] / Rt(i, i);
        residual_.head(i) -= value * Rt.col(i).head(i);
        x[order2_[i]] = value;
      }
    }
  }
  internal::apply_Q(rows_, reflection_, rank, L_unit_);

  solve_upper(mass_factor_, T_);
  solve_upper(mass_factor_, L_unit_);
}

MatrixXd UdwadiaKalaba::solve_mass(const Ref<const MatrixXd>& v) const {
  MatrixXd solution = v;
  solve_mass_in_place(solution);
  return solution;
}

void UdwadiaKalaba::solve_mass_in_place(Ref<MatrixXd> v) const {
  solve_lower(mass_factor_, v);
  solve_upper(mass_factor_, v);
}

MatrixXd UdwadiaKalaba::L() const { return L_unit_ * row_scale_.asDiagonal(); }

MatrixXd UdwadiaKalaba::Lambda() const {
  return row_scale_.asDiagonal() * (L_unit_.transpose() * ML_unit_) * row_scale_.asDiagonal();
}

MatrixXd UdwadiaKalaba::multipliers_of_force() const {
  // Lᵀ Aᵀλ = ΛA M⁻¹Aᵀ λ solves Aᵀλ = f
  MatrixXd solution = row_scale_.asDiagonal() * L_unit_.transpose();
  // rows that vanish have multipliers 0 and no part in what follows
  std::vector<Eigen::Index> rows;
  for (Eigen::Index row = 0; row < row_scale_.size(); ++row) {
    if (row_scale_[row] > 0) rows.push_back(row);
  }
  const Eigen::Index n_redundant = static_cast<Eigen::Index>(rows.size()) - rank_;
  if (n_redundant == 0) return solution;
  // redundant rows: take away what lies in the null space of Aᵀ. Of the unit rows its basis is clear; D brings it to the rows as
  // written
  const Eigen::JacobiSVD<MatrixXd> svd(A_unit_(rows, Eigen::all).transpose(), Eigen::ComputeFullV);
  const MatrixXd null_space = row_scale_(rows).asDiagonal() * svd.matrixV().rightCols(n_redundant);
  const MatrixXd of_rows = solution(rows, Eigen::all);
  solution(rows, Eigen::all) -= null_space * null_space.completeOrthogonalDecomposition().solve(of_rows);
  return solution;
}

MatrixXd UdwadiaKalaba::differentiate_Lambda(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA) const {
  const MatrixXd L = this->L();
  const MatrixXd Lambda_dA_L = Lambda() * (dA * L);
  return L.transpose() * dM * L - Lambda_dA_L - Lambda_dA_L.transpose();
}

VectorXd UdwadiaKalaba::constrain(const Ref<const VectorXd>& a_bar) const {
  VectorXd ddq(a_bar.size());
  Workspace workspace;
  constrain(a_bar, ddq, workspace);
  return ddq;
}

void UdwadiaKalaba::constrain(const Ref<const VectorXd>& a_bar, Ref<VectorXd> ddq, Workspace& workspace) const {
  ddq = Lb_;
  ddq.noalias() += T_ * a_bar;
  VectorXd& residual = workspace.rows_;
  residual = b_unit_;
  residual.noalias() -= A_unit_ * ddq;
  ddq.noalias() += L_unit_ * residual;
}

UdwadiaKalaba::Derivative UdwadiaKalaba::differentiate(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA,
                                                       const Ref<const VectorXd>& db) const {
  // any fixed scaling of the rows gives the same T and L b, so the unit rows serve: dA → D dA, db → D db. Since M L = AᵀΛ,
  // ΛA = (M L)ᵀ and Λb = (M L)ᵀ L b
  const MatrixXd dA_unit = row_scale_.asDiagonal() * dA;
  MatrixXd force = dA_unit.transpose() * ML_unit_.transpose();  // dAᵀΛA − dM L A, and L A L b = L b
  if (!dM.isZero(0)) force -= dM * (L_unit_ * A_unit_);
  solve_mass_in_place(force);
  const MatrixXd T_M_inverse_force = T_ * force;
  Derivative d;
  d.Lb = T_M_inverse_force * Lb_ + L_unit_ * (row_scale_.cwiseProduct(db) - dA_unit * Lb_);
  d.T = -T_M_inverse_force - L_unit_ * (dA_unit * T_);
  return d;
}

void UdwadiaKalaba::add_adjoint(const Ref<const MatrixXd>& T_bar, const Ref<const VectorXd>& Lb_bar, Adjoint adjoint,
                                Workspace& workspace) const {
  // in the unit rows, as in `differentiate`: Ā of the rows as written is D times theirs
  MatrixXd& sum = workspace.square_;  // T̄ − v (L b)ᵀ, then T̄ Tᵀ + v (L b)ᵀ
  MatrixXd& X = workspace.force_;
  sum = T_bar;
  sum.noalias() -= Lb_bar * Lb_.transpose();
  X.noalias() = T_.transpose() * sum;
  solve_mass_in_place(X);
  if (row_scale_.size() == 0) return;  // L A = 0

  workspace.tall_.noalias() = X * A_unit_.transpose();
  adjoint.M.noalias() += workspace.tall_ * L_unit_.transpose();

  sum.noalias() = T_bar * T_.transpose();
  sum.noalias() += Lb_bar * Lb_.transpose();
  workspace.wide_.noalias() = ML_unit_.transpose() * X.transpose();
  workspace.wide_.noalias() += L_unit_.transpose() * sum;
  adjoint.A -= row_scale_.asDiagonal() * workspace.wide_;

  workspace.rows_.noalias() = L_unit_.transpose() * Lb_bar;
  adjoint.b += row_scale_.cwiseProduct(workspace.rows_);
}

void UdwadiaKalaba::add_Lambda_adjoint(const Ref<const MatrixXd>& Lambda_bar, Adjoint adjoint, Workspace& workspace) const {
  // in the unit rows: Λ̄ → D Λ̄ D
  MatrixXd& Lambda = workspace.Lambda_;
  MatrixXd& unit_bar = workspace.Lambda_bar_;
  Lambda.noalias() = L_unit_.transpose() * ML_unit_;
  unit_bar = row_scale_.asDiagonal() * Lambda_bar * row_scale_.asDiagonal();
  workspace.tall_.noalias() = L_unit_ * unit_bar;
  adjoint.M.noalias() += workspace.tall_ * L_unit_.transpose();

  workspace.product_ = unit_bar + unit_bar.transpose();
  unit_bar.noalias() = Lambda * workspace.product_;
  workspace.wide_.noalias() = unit_bar * L_unit_.transpose();
  adjoint.A -= row_scale_.asDiagonal() * workspace.wide_;
}

MechanicsBatch evaluate_mechanics(const System& system, const Ref<const MatrixXd>& states,
                                  const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch;
  evaluate_mechanics(system, states, parameters, batch);
  return batch;
}

void evaluate_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                        MechanicsBatch& batch) {
  system.evaluate_into(states, parameters, batch.values);
  batch.fault.reset();
  const int n_states = batch.values.n_states();
  batch.projections.resize(static_cast<std::size_t>(n_states));
  double size_of_b = 0;
  for (int i = 0; i < n_states; ++i) {
    UdwadiaKalaba& projection = batch.projections[static_cast<std::size_t>(i)];
    projection.compute(batch.values.M(i), batch.values.A(i), batch.values.b(i));
    if (!projection.mass_is_positive_definite()) {
      batch.fault = {i, "the mass matrix M is not positive definite"};
      return;
    }
    if (!batch.values.A(i).allFinite() || !batch.values.b(i).allFinite()) {
      batch.fault = {i, "A or b is not a finite number"};
      return;
    }
    size_of_b = std::max(size_of_b, projection.size_of_b());
  }
  for (int i = 0; i < n_states; ++i) {
    if (batch.projections[static_cast<std::size_t>(i)].inconsistency() > MechanicsBatch::consistency_tolerance * size_of_b) {
      batch.fault = {i, "the constraints contradict each other: no acceleration satisfies A ddq = b"};
      return;
    }
  }
}

MechanicsBatch require_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch = evaluate_mechanics(system, states, parameters);
  if (batch.fault) throw InputError(describe_fault(system, states, *batch.fault));
  return batch;
}

}  // namespace gp2
