#include "base/decompositions.hpp"

template class Eigen::JacobiSVD<Eigen::MatrixXd>;
template class Eigen::ColPivHouseholderQR<Eigen::MatrixXd>;
template class Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd>;
template class Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>;
template Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>& Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>::compute<Eigen::MatrixXd>(
    const Eigen::EigenBase<Eigen::MatrixXd>& matrix, int options);

namespace gp2 {

using Eigen::MatrixXd;

MatrixXd least_squares(const MatrixXd& A, const MatrixXd& b) {
  return Eigen::CompleteOrthogonalDecomposition<MatrixXd>(A).solve(b);
}

MatrixXd least_squares(const Eigen::ColPivHouseholderQR<MatrixXd>& A, const MatrixXd& b) { return A.solve(b); }

MatrixXd basis_of_range(const Eigen::ColPivHouseholderQR<MatrixXd>& decomposed) {
  return decomposed.householderQ() * MatrixXd::Identity(decomposed.rows(), decomposed.rank());
}

MatrixXd inverse_of(const MatrixXd& A) { return A.inverse(); }

std::optional<MatrixXd> inverse_of_definite(const MatrixXd& A) {
  const Eigen::LDLT<MatrixXd> decomposed(A);
  if (!decomposed.isPositive() || !(decomposed.rcond() > 1e-12)) return std::nullopt;
  return decomposed.solve(MatrixXd::Identity(A.rows(), A.cols()));
}

MatrixXd cholesky_factor(const MatrixXd& A) { return A.llt().matrixL(); }

}  // namespace gp2
