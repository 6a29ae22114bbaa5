#pragma once

#include <cmath>
#include <vector>

#include <rapidcheck.h>
#include <Eigen/Dense>

#include "base/random.hpp"
#include "decompositions.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "test_models.hpp"

// M, A, b of random size, rank, conditioning and units, and the equations of motion with multipliers that they must agree with.
namespace gp2::test {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Extended = Eigen::Matrix<long double, Eigen::Dynamic, Eigen::Dynamic>;
using ExtendedVector = Eigen::Matrix<long double, Eigen::Dynamic, 1>;

/// Where the numbers of a case come from. It does not shrink: a smaller one is another case.
inline std::uint64_t random_seed() {
  return *rc::gen::noShrink(rc::gen::resize(rc::kNominalSize, rc::gen::arbitrary<std::uint32_t>())).as("stream");
}

inline MatrixXd random_orthogonal(Index n, RandomStream& random) {
  return random_matrix(n, n, random).householderQr().householderQ();
}

/// 10^(−decades/2) … 10^(decades/2), its ends included.
inline VectorXd logarithmic(Index n, double decades) {
  return VectorXd::LinSpaced(n, -decades / 2, n == 1 ? -decades / 2 : decades / 2).unaryExpr([](double e) {
    return std::pow(10.0, e);
  });
}

inline VectorXd random_scales(Index n, double decades, RandomStream& random) {
  VectorXd scales(n);
  for (double& scale : scales) scale = std::pow(10.0, decades * (random.uniform() - 0.5));
  return scales;
}

struct RandomMechanics {
  MatrixXd M, A;
  VectorXd b;
  std::vector<int> independent;  // rows of A that span the others
  VectorXd x;                    // an acceleration with A x = b
  double condition_of_mass = 1;  // κ of M, its diagonal scaled to 1
  double condition_of_rows = 1;  // κ of the independent rows of B, scaled to unit norm

  [[nodiscard]] Index n() const { return M.rows(); }
  [[nodiscard]] int rank() const { return static_cast<int>(independent.size()); }

  /// What T and L b, in coordinates where M = I, may be off by: a handful of products and triangular solves with the factor of M,
  /// and rows that stand at small angles to each other.
  [[nodiscard]] double rounding() const {
    return 64 * eps * static_cast<double>(M.rows()) * condition_of_mass * condition_of_rows;
  }
};

inline double condition_number(const MatrixXd& matrix) {
  if (matrix.size() == 0) return 1;
  const VectorXd values = Eigen::JacobiSVD<MatrixXd>(matrix).singularValues();
  return values[0] / values[values.size() - 1];
}

/// Call within a property: n ≤ 12, up to 8 rows of any rank, κ(M) ≤ 1e6, κ of the rows ≤ 1e4,
/// units of coordinates and rows over many decades.
inline RandomMechanics random_mechanics(RandomStream& random, int at_least_one_row = 0) {
  const int n = *rc::gen::inRange(1, 13).as("coordinates");
  const int m = *rc::gen::inRange(at_least_one_row, 9).as("rows");
  const int rank = *rc::gen::inRange(std::min(at_least_one_row, 1), std::min(n, m) + 1).as("rank");
  const int mass_decades = *rc::gen::inRange(0, 7).as("decades of the eigenvalues of M");
  const int row_decades = *rc::gen::inRange(0, 5).as("decades of the singular values of the rows");
  const int unit_decades = *rc::gen::element(0, 6, 12).as("decades of the units of coordinates");
  const int scale_decades = *rc::gen::element(0, 6, 200).as("decades of the scales of rows");

  RandomMechanics out;
  const MatrixXd Q = random_orthogonal(n, random);
  MatrixXd M = Q * logarithmic(n, mass_decades).asDiagonal() * Q.transpose();
  const VectorXd units = random_scales(n, unit_decades, random);
  M = units.asDiagonal() * MatrixXd(0.5 * (M + M.transpose())) * units.asDiagonal();
  out.M = M;
  const VectorXd scale = M.diagonal().cwiseSqrt().cwiseInverse();
  out.condition_of_mass = condition_number(scale.asDiagonal() * M * scale.asDiagonal());

  // rows of B = A C⁻ᵀ: some independent, the others combinations of them
  MatrixXd B = MatrixXd(random_orthogonal(std::max(rank, 1), random).topRows(rank).leftCols(rank)) *
               logarithmic(rank, row_decades).asDiagonal() * random_orthogonal(n, random).topRows(rank);
  B.rowwise().normalize();
  out.condition_of_rows = condition_number(B);
  const MatrixXd C = M.llt().matrixL();
  const MatrixXd spanning = B * C.transpose();
  MatrixXd A(m, n);
  A.topRows(rank) = spanning;
  A.bottomRows(m - rank) = random_matrix(m - rank, rank, random) * spanning;
  const VectorXd row_scales = random_scales(m, scale_decades, random);
  const std::vector<int> places = random.permutation(m);
  out.x = C.transpose().triangularView<Eigen::Upper>().solve(random_vector(n, random));
  out.A.resize(m, n);
  for (int row = 0; row < m; ++row) {
    const int place = places[static_cast<std::size_t>(row)];
    out.A.row(place) = row_scales[row] * A.row(row);
    if (row < rank) out.independent.push_back(place);
  }
  out.b = out.A * out.x;
  return out;
}

/// In coordinates w = Cᵀq, M = C Cᵀ, where lengths are those of the metric of M.
class Whitening {
 public:
  explicit Whitening(const MatrixXd& M) : C_(Eigen::LLT<Extended>(M.cast<long double>()).matrixL()) {}
  [[nodiscard]] ExtendedVector acceleration(const ExtendedVector& ddq) const { return C_.transpose() * ddq; }
  [[nodiscard]] Extended map(const Extended& T) const {
    return C_.triangularView<Eigen::Lower>().solve((C_.transpose() * T).transpose().eval()).transpose();
  }
  /// Rows of A C⁻ᵀ, of unit norm; their norms.
  [[nodiscard]] std::pair<Extended, ExtendedVector> rows(const Extended& A) const {
    if (A.rows() == 0) return {A, ExtendedVector()};  // Eigen's solve reads the first of the right sides
    Extended B = C_.triangularView<Eigen::Lower>().solve(A.transpose().eval()).transpose();
    const ExtendedVector norms = B.rowwise().norm();
    for (Index row = 0; row < B.rows(); ++row) {
      if (norms[row] > 0) B.row(row) /= norms[row];
    }
    return {B, norms};
  }

 private:
  Extended C_;
};

struct ExactProjection {
  Extended T;
  ExtendedVector Lb;
};

/// [M Aᵀ; A 0] [ddq; −λ] = [M ā; b] in extended precision, of independent rows.
inline ExactProjection solve_equations_of_motion(const MatrixXd& M, const MatrixXd& A, const VectorXd& b) {
  const Index n = M.rows(), m = A.rows();
  // coordinates to unit masses, rows to unit norm: what is left is the conditioning of the mechanics
  const ExtendedVector unit = M.diagonal().cast<long double>().cwiseSqrt().cwiseInverse();
  const Extended mass = unit.asDiagonal() * M.cast<long double>() * unit.asDiagonal();
  Extended rows = A.cast<long double>() * unit.asDiagonal();
  ExtendedVector right = b.cast<long double>();
  for (Index row = 0; row < m; ++row) {
    const long double norm = rows.row(row).norm();
    rows.row(row) /= norm;
    right[row] /= norm;
  }
  Extended kkt = Extended::Zero(n + m, n + m);
  kkt << mass, rows.transpose(), rows, Extended::Zero(m, m);
  Extended sides = Extended::Zero(n + m, n + 1);
  sides.topLeftCorner(n, n) = mass;
  sides.bottomRightCorner(m, 1) = right;
  const Extended solution = kkt.fullPivLu().solve(sides).topRows(n);
  return {unit.asDiagonal() * solution.leftCols(n) * unit.cwiseInverse().asDiagonal(),
          unit.asDiagonal() * ExtendedVector(solution.col(n))};
}

/// The same by orthogonal bases in extended precision. Its rounding grows with the rows' conditioning, not its square: for rows
/// that are nearly redundant.
inline ExactProjection project_by_qr(const MatrixXd& M, const MatrixXd& A, const VectorXd& b) {
  const Index n = M.rows(), m = A.rows();
  const Extended C = Eigen::LLT<Extended>(M.cast<long double>()).matrixL();
  Extended B_transposed = C.triangularView<Eigen::Lower>().solve(A.transpose().cast<long double>().eval());
  ExtendedVector right = b.cast<long double>();
  for (Index row = 0; row < m; ++row) {
    const long double norm = B_transposed.col(row).norm();
    B_transposed.col(row) /= norm;
    right[row] /= norm;
  }
  const Eigen::HouseholderQR<Extended> qr(B_transposed);
  const Extended Q = qr.householderQ() * Extended::Identity(n, m);
  const Extended R = qr.matrixQR().topRows(m).triangularView<Eigen::Upper>();
  const ExtendedVector y = Q * R.transpose().triangularView<Eigen::Lower>().solve(right);
  const Extended whitened = (Extended::Identity(n, n) - Q * Q.transpose()) * C.transpose();
  return {C.transpose().triangularView<Eigen::Upper>().solve(whitened), C.transpose().triangularView<Eigen::Upper>().solve(y)};
}

inline double largest_extended(const Extended& matrix) {
  return matrix.size() == 0 ? 0 : static_cast<double>(matrix.cwiseAbs().maxCoeff());
}

}  // namespace gp2::test
