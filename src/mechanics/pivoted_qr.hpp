#pragma once

#include <Eigen/Core>

namespace gp2::internal {

/// W P = Q R by Householder reflections with column pivoting, in the caller's memory: nothing is allocated. Made for the small
/// matrices of mechanics, where it is several times faster than a general decomposition.
///
/// @param W           (d × n), overwritten: row i < rank of R in row i from the diagonal on, reflector v_k below the diagonal of
///                    column k < rank, its first entry 1 not stored
/// @param reflection  (min(d, n)): τ_k, Q = H_0 H_1 … with H_k = I − τ_k v_k v_kᵀ
/// @param order       (n): column k of W P is column order[k] of W
/// @param tolerance   the decomposition ends where the largest column that is left is no longer than this times the first pivot
/// @return            the rank
Eigen::Index pivoted_qr(Eigen::Ref<Eigen::MatrixXd> W, Eigen::Ref<Eigen::VectorXd> reflection, Eigen::Ref<Eigen::VectorXi> order,
                        double tolerance);

/// X := Qᵀ X  (d × any).
void apply_Q_transposed(const Eigen::Ref<const Eigen::MatrixXd>& W, const Eigen::Ref<const Eigen::VectorXd>& reflection,
                        Eigen::Index rank, Eigen::Ref<Eigen::MatrixXd> X);

/// X := Q X  (d × any). Of [I; 0] (d × rank) it makes the first columns of Q, an orthonormal basis of range(W).
void apply_Q(const Eigen::Ref<const Eigen::MatrixXd>& W, const Eigen::Ref<const Eigen::VectorXd>& reflection, Eigen::Index rank,
             Eigen::Ref<Eigen::MatrixXd> X);

}  // namespace gp2::internal
