#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <Eigen/SVD>

#include "base/decompositions.hpp"
#include "base/parallel.hpp"
#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "mechanics/describe_fault.hpp"
#include "mechanics/dot.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

constexpr double smallest_row = std::numeric_limits<double>::min();  // of which there is an inverse

// M = C Cᵀ, from the lower triangle of M to C in its place. Returns the smallest squared pivot, as a fraction of its diagonal
// entry; 0 where one is lost to rounding, or negative
double factorise(MatrixXd& M) {
  const Index n = M.rows();
  double smallest = 1;
  for (Index k = 0; k < n; ++k) {
    double* const pivot = M.col(k).data() + k;
    double square = *pivot;
    for (Index j = 0; j < k; ++j) square -= M(k, j) * M(k, j);
    if (!(square > 1e-14 * std::abs(*pivot))) return 0;
    smallest = std::min(smallest, square / *pivot);
    *pivot = std::sqrt(square);
    const double scale = 1 / *pivot;
    for (Index j = 0; j < k; ++j) {
      const double factor = M(k, j);
      for (Index i = 1; i < n - k; ++i) pivot[i] -= factor * M(k + i, j);
    }
    for (Index i = 1; i < n - k; ++i) pivot[i] *= scale;
  }
  return smallest;
}

// Whether M ⪰ 0 to rounding. Each coordinate in units of its diagonal entry, the largest pivot is eliminated next; what is left
// of a semidefinite matrix where none is above rounding is itself rounding.
bool is_semidefinite(const Ref<const MatrixXd>& M, MatrixXd& rest) {
  constexpr double rounding = 1e-13;
  const Index n = M.rows();
  rest = M;
  for (Index step = 0; step < n; ++step) {
    Index pivot = -1;
    double largest = rounding;
    for (Index j = 0; j < n; ++j) {
      if (!(rest(j, j) > largest * M(j, j))) continue;
      largest = rest(j, j) / M(j, j);
      pivot = j;
    }
    if (pivot < 0) break;
    for (Index j = 0; j < n; ++j) {
      if (j == pivot) continue;
      const double factor = rest(pivot, j) / rest(pivot, pivot);
      for (Index i = 0; i < n; ++i) {
        if (i != pivot) rest(i, j) -= rest(i, pivot) * factor;
      }
    }
    rest.row(pivot).setZero();
    rest.col(pivot).setZero();
  }
  // no root where a diagonal entry is negative
  for (Index j = 0; j < n; ++j) {
    for (Index i = 0; i < n; ++i) {
      if (!(std::abs(rest(i, j)) <= rounding * std::sqrt(M(i, i)) * std::sqrt(M(j, j)))) return false;
    }
  }
  return true;
}

// σ_k = 1/(A_k diag(w)⁻¹A_kᵀ), w_j = M_jj. A massless coordinate has the w_j that rows weighed before it lend, Σ σ_k A_kj²; so
// rows among such coordinates come after those that tie them to a mass.
void weigh_rows(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A, VectorXd& w, VectorXd& sigma) {
  w = M.diagonal();
  sigma.setZero();
  const auto weigh = [&](Index k, bool by_mass) {
    double sum = 0;
    for (Index j = 0; j < w.size(); ++j) {
      if (!by_mass || w[j] > 0) sum += A(k, j) * A(k, j) / (by_mass ? w[j] : 1);
    }
    if (sum > 0) sigma[k] = 1 / sum;
    return sum > 0;
  };
  for (Index pass = 0; pass < A.rows(); ++pass) {
    bool some = false;
    for (Index k = 0; k < A.rows(); ++k) {
      if (sigma[k] == 0) some = weigh(k, true) || some;
    }
    // rows that nothing ties to a mass: one of them sets their scale
    for (Index k = 0; !some && k < A.rows(); ++k) {
      if (sigma[k] == 0) some = weigh(k, false);
    }
    if (!some) return;
    for (Index j = 0; j < w.size(); ++j) {
      if (w[j] > 0) continue;
      for (Index k = 0; k < A.rows(); ++k) w[j] += sigma[k] * A(k, j) * A(k, j);
    }
  }
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

// M or, where it is singular, M' and its factor. Returns the smallest pivot
double UdwadiaKalaba::factorise_mass(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A) {
  mass_ = M;
  mass_factor_ = M;
  row_mass_.setZero(A.rows());
  // here, so that the first singular state allocates no more than others
  weight_.resize(M.rows());
  A_T_.resize(A.rows(), M.cols());
  mass_kind_ = Mass::indefinite;
  if (!M.allFinite()) return 0;
  const double pivot = factorise(mass_factor_);
  mass_kind_ = Mass::positive_definite;
  if (pivot > mass_tolerance) return pivot;

  const bool semidefinite = A.allFinite() && is_semidefinite(M, T_);
  if (semidefinite) {
    complete_mass(M, A);
    mass_factor_ = mass_;
    const double completed = factorise(mass_factor_);
    mass_kind_ = Mass::singular;
    if (completed > mass_tolerance) return completed;
  }
  if (pivot > 0) {
    // ill-conditioned, and A does not help
    mass_ = M;
    mass_factor_ = M;
    row_mass_.setZero();
    mass_kind_ = Mass::positive_definite;
    return factorise(mass_factor_);
  }
  mass_kind_ = semidefinite || !A.allFinite() ? Mass::undetermined : Mass::indefinite;
  return 0;
}

// M' = M + AᵀΣA
void UdwadiaKalaba::complete_mass(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A) {
  weigh_rows(M, A, weight_, row_mass_);
  for (Index k = 0; k < A.rows(); ++k) {
    for (Index j = 0; j < M.cols(); ++j) {
      for (Index i = 0; i < M.rows(); ++i) mass_(i, j) += row_mass_[k] * (A(k, i) * A(k, j));
    }
  }
}

void UdwadiaKalaba::compute(const Ref<const MatrixXd>& M, const Ref<const MatrixXd>& A, const Ref<const VectorXd>& b,
                            int largest_rank) {
  const Index nq = M.rows();
  const Index nc = A.rows();
  require_shape("UdwadiaKalaba: M", M, nq, nq);
  require_shape("UdwadiaKalaba: A", A, nc, nq);
  require_shape("UdwadiaKalaba: b", b, nc, 1);
  rank_ = n_zero_rows_ = 0;
  inconsistency_ = size_of_b_ = 0;
  const double pivot = factorise_mass(M, A);
  if (!motion_is_determined()) return;

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
  decompose_rows(largest_rank);
  constexpr double well_conditioned = 1e-4;
  if (pivot < well_conditioned) {
    // T M⁻¹ rounds at ε κ^1.5 of T as it comes, κ = 1/pivot; with what A still sees of T taken away, at ε κ
    A_T_.noalias() = A_unit_ * T_;
    T_.noalias() -= L_unit_ * A_T_;
  }
  ML_unit_.noalias() = mass_ * L_unit_;

  // b must lie in range(A); a dropped row is 0 = b_k
  Lb_.noalias() = L_unit_ * b_unit_;
  residual_ = b_unit_;
  residual_.noalias() -= A_unit_ * Lb_;
  // redundant rows are off b by the error of the state, which 0 = b_k is not
  const bool may_be_off = rank_ == largest_rank && largest_rank < nc;
  for (Index k = 0; k < nc; ++k) {
    const double off = row_scale_[k] == 0 ? b[k] : may_be_off ? 0 : residual_[k];
    inconsistency_ = std::max(inconsistency_, std::abs(off));
    size_of_b_ = std::max(size_of_b_, std::abs(b_unit_[k]));
  }
}

// T and L from Bᵀ, of unit columns, in rows_
void UdwadiaKalaba::decompose_rows(int largest_rank) {
  const Index nq = rows_.rows();
  const Index nc = rows_.cols();
  reflection_.resize(std::min(nq, nc));
  order_.resize(nc);
  const Index found = internal::pivoted_qr(rows_, reflection_, order_, rank_tolerance),
              rank = std::min<Index>(found, largest_rank);
  is_off_constraints_ = found > rank;
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
  invert_R_transposed();
  internal::apply_Q(rows_, reflection_, rank, L_unit_);

  solve_upper(mass_factor_, T_);
  solve_upper(mass_factor_, L_unit_);
}

// (Rᵀ)⁺ Pᵀ to the first rows of L_unit_, which are zero
void UdwadiaKalaba::invert_R_transposed() {
  const Index nq = rows_.rows();
  const Index nc = rows_.cols();
  const Index rank = rank_;
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
}

bool UdwadiaKalaba::is_contradictory(const Ref<const VectorXd>& F, double rounding) const {
  require_shape("UdwadiaKalaba::is_contradictory: F", F, mass_.rows(), 1);
  if (!(inconsistency_ > std::max(consistency_tolerance * size_of_b_, rounding))) return false;
  // as large as |C⁻¹F| where M is diagonal, and never much larger
  double size_of_force = 0;
  for (Index j = 0; j < F.size(); ++j) {
    if (std::isfinite(F[j])) size_of_force = std::max(size_of_force, std::abs(F[j]) / std::sqrt(mass_(j, j)));
  }
  return inconsistency_ > consistency_tolerance * size_of_force;
}

MatrixXd UdwadiaKalaba::solve_mass(const Ref<const MatrixXd>& v) const {
  MatrixXd solution = v;
  solve_mass_in_place(solution);
  return solution;
}

void UdwadiaKalaba::solve_mass_in_place(Ref<MatrixXd> v) const {
  require_shape("UdwadiaKalaba::solve_mass: v", v, mass_.rows(), v.cols());
  solve_lower(mass_factor_, v);
  solve_upper(mass_factor_, v);
}

void UdwadiaKalaba::write_L(Ref<MatrixXd> L) const {
  require_shape("UdwadiaKalaba::write_L: L", L, L_unit_.rows(), L_unit_.cols());
  L = L_unit_ * row_scale_.asDiagonal();
}

MatrixXd UdwadiaKalaba::L() const { return L_unit_ * row_scale_.asDiagonal(); }

MatrixXd UdwadiaKalaba::multipliers_of_force() const {
  MatrixXd K;
  Workspace workspace;
  write_multipliers_of_force(K, workspace);
  return K;
}

void UdwadiaKalaba::write_multipliers_of_force(MatrixXd& K, Workspace& workspace) const {
  // Lᵀ Aᵀλ = ΛA M⁻¹Aᵀ λ solves Aᵀλ = f
  K.noalias() = row_scale_.asDiagonal() * L_unit_.transpose();
  const Index nc = row_scale_.size();
  // rows that vanish have multipliers 0 and no part in what follows
  const Index n_redundant = nc - n_zero_rows_ - rank_;
  if (n_redundant == 0 || rank_ == 0) return;

  // redundant rows: take away what lies in the null space of Aᵀ. Of the unit rows it is that of Bᵀ P = Y R, spanned by the last
  // columns of Q₂ in Rᵀ P₂ = Q₂ R₂ (invert_R_transposed); D brings it to the rows as written
  workspace.null_space_.setZero(nc, nc);
  workspace.null_rows_.resize(nc, nc);
  workspace.reflection_.resize(nc);
  workspace.order_.resize(nc);
  auto basis = workspace.null_space_.leftCols(nc - rank_);
  auto of_rows = workspace.null_rows_.leftCols(nc - rank_);
  basis.bottomRows(nc - rank_).setIdentity();
  internal::apply_Q(R_transposed_.leftCols(rank_), reflection2_, rank_, basis);
  for (Index i = 0; i < nc; ++i) of_rows.row(order_[i]) = row_scale_[order_[i]] * basis.row(i);
  internal::pivoted_qr(of_rows, workspace.reflection_.head(nc - rank_), workspace.order_.head(nc - rank_), 0);
  internal::apply_Q_transposed(of_rows, workspace.reflection_, n_redundant, K);
  K.topRows(n_redundant).setZero();
  internal::apply_Q(of_rows, workspace.reflection_, n_redundant, K);
}

MatrixXd UdwadiaKalaba::differentiate_mass(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA) const {
  require_shape("UdwadiaKalaba::differentiate_mass: dM", dM, mass_.rows(), mass_.cols());
  require_shape("UdwadiaKalaba::differentiate_mass: dA", dA, row_mass_.size(), mass_.cols());
  if (!mass_is_singular()) return dM;
  MatrixXd d = dM;
  for (Index k = 0; k < row_mass_.size(); ++k) {
    if (row_mass_[k] == 0) continue;
    const MatrixXd half = row_mass_[k] / row_scale_[k] * A_unit_.row(k).transpose() * dA.row(k);
    d += half + half.transpose();
  }
  return d;
}

VectorXd UdwadiaKalaba::constrain(const Ref<const VectorXd>& a_bar) const {
  VectorXd ddq(a_bar.size());
  Workspace workspace;
  constrain(a_bar, ddq, workspace);
  return ddq;
}

void UdwadiaKalaba::constrain(const Ref<const VectorXd>& a_bar, Ref<VectorXd> ddq, Workspace& workspace) const {
  require_shape("UdwadiaKalaba::constrain: a_bar", a_bar, T_.cols(), 1);
  require_shape("UdwadiaKalaba::constrain: ddq", ddq, T_.rows(), 1);
  ddq = Lb_;
  ddq.noalias() += T_ * a_bar;
  if (is_off_constraints_) return;  // the residual is the error of the state
  VectorXd& residual = workspace.rows_;
  residual = b_unit_;
  residual.noalias() -= A_unit_ * ddq;
  ddq.noalias() += L_unit_ * residual;
}

UdwadiaKalaba::Derivative UdwadiaKalaba::differentiate(const Ref<const MatrixXd>& dM, const Ref<const MatrixXd>& dA,
                                                       const Ref<const VectorXd>& db) const {
  require_shape("UdwadiaKalaba::differentiate: dM", dM, mass_.rows(), mass_.cols());
  require_shape("UdwadiaKalaba::differentiate: dA", dA, row_scale_.size(), mass_.cols());
  require_shape("UdwadiaKalaba::differentiate: db", db, row_scale_.size(), 1);
  // any fixed scaling of the rows gives the same T and L b, so the unit rows serve: dA → D dA, db → D db. Since M L = AᵀΛ,
  // ΛA = (M L)ᵀ and Λb = (M L)ᵀ L b
  const MatrixXd dA_unit = row_scale_.asDiagonal() * dA;
  MatrixXd force = dA_unit.transpose() * ML_unit_.transpose();  // dAᵀΛA − dM L A, and L A L b = L b
  if (mass_is_singular() || !dM.isZero(0)) force -= differentiate_mass(dM, dA) * (L_unit_ * A_unit_);
  solve_mass_in_place(force);
  const MatrixXd T_M_inverse_force = T_ * force;
  Derivative d;
  d.Lb = T_M_inverse_force * Lb_ + L_unit_ * (row_scale_.cwiseProduct(db) - dA_unit * Lb_);
  d.T = -T_M_inverse_force - L_unit_ * (dA_unit * T_);
  return d;
}

namespace {

// "0.71 q2 − 0.71 q3": a unit vector v with M v = 0 and A v = 0. Sought where M' has a diagonal of ones
std::string free_direction(const System& system, const UdwadiaKalaba& projection, const MatrixXd& M, const MatrixXd& A) {
  const Index nq = M.rows();
  VectorXd scale = projection.mass().diagonal();
  for (double& entry : scale) entry = entry > 0 ? 1 / std::sqrt(entry) : 1;
  MatrixXd rows(nq + A.rows(), nq);
  rows << scale.asDiagonal() * M, A;
  rows = rows * scale.asDiagonal();
  rows.bottomRows(A.rows()).rowwise().normalize();
  const Eigen::JacobiSVD<MatrixXd> svd(rows, Eigen::ComputeFullV);
  const VectorXd v = (scale.asDiagonal() * svd.matrixV().col(nq - 1)).normalized();

  std::string text;
  double sign = 0;  // that of the first entry shown
  for (Index j = 0; j < nq; ++j) {
    if (std::abs(v[j]) < 0.005) continue;
    if (sign == 0) sign = v[j] < 0 ? -1 : 1;
    const std::string size = fmt::format("{:.2g}", std::abs(v[j]));
    text += text.empty() ? "" : (sign * v[j] < 0 ? " − " : " + ");
    text += (size == "1" ? "" : size + " ") + system.coordinates()[static_cast<std::size_t>(j)].name;
  }
  return text;
}

std::optional<std::string> mass_fault(const System& system, const SystemValues& values, int i, const UdwadiaKalaba& projection) {
  switch (projection.mass_kind()) {
    case UdwadiaKalaba::Mass::positive_definite:
    case UdwadiaKalaba::Mass::singular:
      return std::nullopt;
    case UdwadiaKalaba::Mass::undetermined:
      return fmt::format(
          "the mass matrix M is singular, and {}nothing determines ddq along {}: only a constraint that acts there, or a mass, "
          "does",
          system.nc() == 0 ? "without constraints " : "", free_direction(system, projection, values.M(i), values.A(i)));
    case UdwadiaKalaba::Mass::indefinite:
      return "the mass matrix M is not positive definite";
  }
  return std::nullopt;
}

// of one state by itself
std::optional<std::string> contradiction(bool is_beyond_rounding) {
  if (!is_beyond_rounding) return std::nullopt;
  return "the constraints contradict each other: no acceleration satisfies A ddq = b";
}

// The largest |A L b − b|, of rows of unit length.
double distance_from_b(const Ref<const MatrixXd>& A, const Ref<const VectorXd>& b, const UdwadiaKalaba& projection) {
  double distance = 0;
  for (Index k = 0; k < A.rows(); ++k) {
    const double length = A.row(k).norm();
    if (length > 0) distance = std::max(distance, std::abs(A.row(k).dot(projection.Lb()) - b[k]) / length);
  }
  return distance;
}

// Redundant rows that hold always are off b by the error of the state. What conditional rows add to that is a contradiction.
bool conditional_rows_contradict(const System& system, const SystemValues& values, int i, const UdwadiaKalaba& projection) {
  constexpr double much = 100;
  const auto A = values.A(i);
  const int largest_rank = system.largest_rank_of(A);
  if (!system.has_conditional_constraints() || largest_rank == system.nc() || projection.rank() != largest_rank) return false;
  std::vector<int> always, others;
  for (int row = 0; row < system.nc(); ++row) {
    if (!system.is_conditional(row))
      always.push_back(row);
    else if (!A.row(row).isZero(0))
      others.push_back(row);
  }
  if (others.empty()) return false;
  const MatrixXd A_always = A(always, Eigen::all), A_others = A(others, Eigen::all);
  const VectorXd b_always = values.b(i)(always), b_others = values.b(i)(others);
  UdwadiaKalaba of_always, of_others;
  of_always.compute(values.M(i), A_always, b_always, largest_rank - static_cast<int>(others.size()));
  of_others.compute(values.M(i), A_others, b_others);
  // how far the directions of the redundant rows differ, by which what others accelerate is off too
  double spread = 0;
  const MatrixXd left = A_always * of_always.T();
  for (Index k = 0; k < left.rows(); ++k) {
    const double length = A_always.row(k).norm();
    if (length > 0) spread = std::max(spread, left.row(k).norm() / length);
  }
  const double by_state = distance_from_b(A_always, b_always, of_always) + spread * of_others.Lb().norm();
  const double rounding = UdwadiaKalaba::consistency_tolerance * std::max(projection.size_of_b(), 1.0);
  return distance_from_b(A, values.b(i), projection) > much * by_state + rounding;
}

std::optional<std::string> fault_at(const System& system, const SystemValues& values, const Ref<const MatrixXd>& states, int i,
                                    const UdwadiaKalaba& projection) {
  if (!values.M(i).allFinite())
    return "the mass matrix M is not positive definite: it is not finite" +
           internal::unknown_entries(system, states, i, system.reads(SystemPart::mechanics));
  const bool is_indefinite = projection.mass_kind() == UdwadiaKalaba::Mass::indefinite;
  if (!is_indefinite && (!values.A(i).allFinite() || !values.b(i).allFinite())) {
    return "A or b is not a finite number" + internal::unknown_entries(system, states, i, system.reads(SystemPart::mechanics));
  }
  if (system.has_constraint_noise() && projection.motion_is_determined() &&
      projection.rank() + projection.n_zero_rows() < system.nc()) {
    return "the constraints are redundant, so that none of them may have a noise of its own: leave out rows that follow from "
           "others";
  }
  if (auto text = mass_fault(system, values, i, projection)) return text;
  return contradiction(conditional_rows_contradict(system, values, i, projection));
}

}  // namespace

std::string internal::unknown_entries(const System& system, const Ref<const MatrixXd>& states, int i,
                                      const std::vector<bool>& reads) {
  const std::vector<std::string> names = system.state_names();
  std::string unknown;
  for (Index row = 0; row < states.rows(); ++row) {
    const auto k = static_cast<std::size_t>(row);
    if (!reads[k] || std::isfinite(states(row, i))) continue;
    unknown += fmt::format("{}{} is {}", unknown.empty() ? "" : ", ", names[k], states(row, i));
  }
  return unknown.empty() ? "" : ", and of what the equations read " + unknown;
}

std::string internal::describe_fault(const System& system, const Ref<const MatrixXd>& states, const MechanicsBatch::Fault& fault,
                                     Index first) {
  const std::vector<std::string> names = system.state_names();
  std::string where;
  for (Index row = 0; row < states.rows(); ++row) {
    const double value = states(row, fault.state);
    if (std::isnan(value)) continue;
    where += fmt::format("{}{} = {:.6g}", where.empty() ? "" : ", ", names[static_cast<std::size_t>(row)], value);
  }
  return fmt::format("system '{}': {} at state {} ({})", system.name(), fault.text, first + fault.state + 1, where);
}

int MechanicsBatch::first_singular() const {
  const auto first = std::find_if(projections.begin(), projections.end(), [](const auto& one) { return one.mass_is_singular(); });
  return first == projections.end() ? -1 : static_cast<int>(first - projections.begin());
}

MechanicsBatch evaluate_mechanics(const System& system, const Ref<const MatrixXd>& states,
                                  const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch;
  evaluate_mechanics(system, states, parameters, batch);
  return batch;
}

namespace {

// b is quadratic in the velocities, and where others move those at rest may be 1e-6 of theirs by rounding
double rounding_of(double size_of_b) { return std::max(1e-12 * size_of_b, std::numeric_limits<double>::min()); }

// Each state by itself, up to the first with a fault. Returns the largest |b|.
double evaluate_each(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                     MechanicsBatch& batch) {
  system.evaluate_into(states, parameters, batch.values);
  batch.constraint_noise = system.constraint_noise();
  batch.fault.reset();
  const int n_states = batch.values.n_states();
  batch.projections.resize(static_cast<std::size_t>(n_states));
  double size_of_b = 0;
  for (int i = 0; i < n_states; ++i) {
    UdwadiaKalaba& projection = batch.projections[static_cast<std::size_t>(i)];
    projection.compute(batch.values.M(i), batch.values.A(i), batch.values.b(i), system.largest_rank_of(batch.values.A(i)));
    if (std::optional<std::string> text = fault_at(system, batch.values, states, i, projection)) {
      batch.fault = {i, std::move(*text)};
      break;
    }
    size_of_b = std::max(size_of_b, projection.size_of_b());
  }
  return size_of_b;
}

}  // namespace

void evaluate_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                        MechanicsBatch& batch) {
  const double rounding = rounding_of(std::max(batch.size_of_b_elsewhere, evaluate_each(system, states, parameters, batch)));
  for (int i = 0; i < batch.values.n_states() && !batch.fault; ++i) {
    const UdwadiaKalaba& projection = batch.projections[static_cast<std::size_t>(i)];
    if (const auto text = contradiction(projection.is_contradictory(batch.values.F(i), rounding))) batch.fault = {i, *text};
  }
}

std::optional<MechanicsBatch::Fault> for_each_mechanics(const System& system, const Ref<const MatrixXd>& states,
                                                        const Ref<const VectorXd>& parameters, int n_threads,
                                                        const std::function<void(Index, const MechanicsBatch&)>& visit) {
  constexpr Index block_size = 256;
  n_threads = thread_count(n_threads);
  std::vector<MechanicsBatch> batches(static_cast<std::size_t>(n_threads));
  std::mutex mutex;
  std::optional<MechanicsBatch::Fault> fault;  // the first of a state by itself
  std::map<int, double> suspects;              // states that contradict themselves unless that is rounding
  double size_of_b = 0;
  try {
    for_each_block(states.cols(), block_size, n_threads, [&](Index first, Index n, int thread) {
      MechanicsBatch& batch = batches[static_cast<std::size_t>(thread)];
      const double size_in_block = evaluate_each(system, states.middleCols(first, n), parameters, batch);
      if (!batch.fault) visit(first, batch);
      const std::scoped_lock lock(mutex);
      size_of_b = std::max(size_of_b, size_in_block);
      if (batch.fault) {
        const int state = static_cast<int>(first) + batch.fault->state;
        if (!fault || state < fault->state) fault = {state, batch.fault->text};
        return;
      }
      for (int i = 0; i < static_cast<int>(n); ++i) {
        const UdwadiaKalaba& projection = batch.projections[static_cast<std::size_t>(i)];
        if (projection.is_contradictory(batch.values.F(i))) suspects[static_cast<int>(first) + i] = projection.inconsistency();
      }
    });
  } catch (const InputError&) {
    static_cast<void>(system.evaluate(states, parameters));  // which names a state by its number among all
    throw;
  }
  for (const auto& [state, inconsistency] : suspects) {
    if (fault) break;
    if (const auto text = contradiction(inconsistency > rounding_of(size_of_b))) fault = {state, *text};
  }
  return fault;
}

MechanicsBatch require_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch = evaluate_mechanics(system, states, parameters);
  if (batch.fault) throw InputError(internal::describe_fault(system, states, *batch.fault));
  return batch;
}

}  // namespace gp2
