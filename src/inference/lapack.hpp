#pragma once

#include <vector>

#include <Eigen/Core>

extern "C" {
void dpotrf_(const char* uplo, const int* n, double* a, const int* lda, int* info, std::size_t);
void dpotri_(const char* uplo, const int* n, double* a, const int* lda, int* info, std::size_t);
void dpstrf_(const char* uplo, const int* n, double* a, const int* lda, int* pivot, int* rank, const double* tolerance,
             double* work, int* info, std::size_t);
void dtrsm_(const char* side, const char* uplo, const char* trans, const char* diag, const int* m, const int* n,
            const double* alpha, const double* a, const int* lda, double* b, const int* ldb, std::size_t, std::size_t,
            std::size_t, std::size_t);
}

namespace gp2::lapack {

/// A = L Lᵀ in the lower triangle, in place; false when A is not positive definite.
bool factorise(Eigen::MatrixXd& A);

/// Pᵀ A P = L Lᵀ of a positive semidefinite A, with the largest of what is left as the next pivot, down to its size times ε.
struct PivotedFactor {
  Eigen::MatrixXd L;      // (n × rank), lower triangular
  std::vector<int> rows;  // row k of L is row rows[k] of A
};
PivotedFactor factorise_semidefinite(Eigen::MatrixXd A);

/// The lower triangle of A⁻¹ from that of L, in place.
void invert_factored(Eigen::MatrixXd& L);

/// B ← L⁻¹ B, or L⁻ᵀ B.
void solve_lower(const Eigen::MatrixXd& L, bool transposed, Eigen::Ref<Eigen::MatrixXd> B);

/// While any of these lives, OpenBLAS computes on the calling thread only: our threads and its own do not fight, and sums keep
/// their order. The previous setting returns with the last one.
class SingleThread {
 public:
  SingleThread();
  ~SingleThread();
  SingleThread(const SingleThread&) = delete;
  SingleThread& operator=(const SingleThread&) = delete;
};

}  // namespace gp2::lapack
