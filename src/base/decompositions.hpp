#pragma once

#include <optional>

#include <Eigen/Dense>

// Eigen's decompositions of MatrixXd are compiled once, in decompositions.cpp: each costs seconds in every file that uses it.
extern template class Eigen::JacobiSVD<Eigen::MatrixXd>;
extern template class Eigen::ColPivHouseholderQR<Eigen::MatrixXd>;
extern template class Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd>;
extern template class Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>;
extern template Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>&
Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>::compute<Eigen::MatrixXd>(const Eigen::EigenBase<Eigen::MatrixXd>& matrix,
                                                                         int options);

namespace gp2 {

/// The x of least norm of those that make A x − b least, of each column b.
Eigen::MatrixXd least_squares(const Eigen::MatrixXd& A, const Eigen::MatrixXd& b);
/// The same by a decomposition of A that is at hand, of least norm only where A has full rank.
Eigen::MatrixXd least_squares(const Eigen::ColPivHouseholderQR<Eigen::MatrixXd>& A, const Eigen::MatrixXd& b);
/// An orthonormal basis of the range of what was decomposed.
Eigen::MatrixXd basis_of_range(const Eigen::ColPivHouseholderQR<Eigen::MatrixXd>& decomposed);
Eigen::MatrixXd inverse_of(const Eigen::MatrixXd& A);
/// A⁻¹ of a symmetric A; nothing where it is not positive definite, or its condition number is beyond 1e12.
std::optional<Eigen::MatrixXd> inverse_of_definite(const Eigen::MatrixXd& A);
/// L of A = L Lᵀ.
Eigen::MatrixXd cholesky_factor(const Eigen::MatrixXd& A);

}  // namespace gp2
