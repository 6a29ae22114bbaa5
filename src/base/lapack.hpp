#pragma once

#include <atomic>
#include <optional>
#include <vector>

#include <Eigen/Core>

extern "C" {
void dpotrf_(const char* uplo, const int* n, double* a, const int* lda, int* info, std::size_t);
void dlauum_(const char* uplo, const int* n, double* a, const int* lda, int* info, std::size_t);
void dpstrf_(const char* uplo, const int* n, double* a, const int* lda, int* pivot, int* rank, const double* tolerance,
             double* work, int* info, std::size_t);
void dtrsv_(const char* uplo, const char* trans, const char* diag, const int* n, const double* a, const int* lda, double* x,
            const int* incx, std::size_t, std::size_t, std::size_t);
void dtrsm_(const char* side, const char* uplo, const char* trans, const char* diag, const int* m, const int* n,
            const double* alpha, const double* a, const int* lda, double* b, const int* ldb, std::size_t, std::size_t,
            std::size_t, std::size_t);
void dtrmm_(const char* side, const char* uplo, const char* trans, const char* diag, const int* m, const int* n,
            const double* alpha, const double* a, const int* lda, double* b, const int* ldb, std::size_t, std::size_t,
            std::size_t, std::size_t);
void dsyrk_(const char* uplo, const char* trans, const int* n, const int* k, const double* alpha, const double* a, const int* lda,
            const double* beta, double* c, const int* ldc, std::size_t, std::size_t);
void dgemm_(const char* transa, const char* transb, const int* m, const int* n, const int* k, const double* alpha,
            const double* a, const int* lda, const double* b, const int* ldb, const double* beta, double* c, const int* ldc,
            std::size_t, std::size_t);
}

namespace gp2::lapack {

/// OpenBLAS cannot be interrupted. Of large matrices it is given pieces of about so many multiplications and additions, a second
/// or two of one processor core, and between them a caller may ask for an end. Smaller matrices are one piece.
struct Pieces {
  const std::atomic<bool>* stop = nullptr;
  double operations = 4e10;
};

/// A = L Lᵀ in the lower triangle, in place; false when A is not positive definite, or when stopped.
bool factorise(Eigen::Ref<Eigen::MatrixXd> A, const Pieces& pieces = {});

/// Pᵀ A P = L Lᵀ of a positive semidefinite A, with the largest of what is left as the next pivot, down to its size times ε, or to
/// `smallest` times the largest of the diagonal.
struct PivotedFactor {
  Eigen::MatrixXd L;      // (n × rank), lower triangular
  std::vector<int> rows;  // row k of L is row rows[k] of A
};
PivotedFactor factorise_semidefinite(Eigen::MatrixXd A, std::optional<double> smallest = std::nullopt);

/// The lower triangle of A⁻¹ from that of L, in place: (L⁻¹)ᵀL⁻¹. Faster than dpotri, whose triangular inverse is slow up to a
/// size of some hundred. When stopped what stands there is neither.
void invert_factored(Eigen::Ref<Eigen::MatrixXd> L, const Pieces& pieces = {});

/// B ← L⁻¹ B, or L⁻ᵀ B.
void solve_lower(const Eigen::Ref<const Eigen::MatrixXd>& L, bool transposed, Eigen::Ref<Eigen::MatrixXd> B);

/// B ← (L Lᵀ)⁻¹ B.
void solve_factored(const Eigen::Ref<const Eigen::MatrixXd>& L, Eigen::Ref<Eigen::MatrixXd> B);

/// B ← L B.
void multiply_lower(const Eigen::Ref<const Eigen::MatrixXd>& L, Eigen::Ref<Eigen::MatrixXd> B);

/// C ← C + A B, with A or B transposed where that is said.
void add_product(const Eigen::Ref<const Eigen::MatrixXd>& A, bool transposed_A, const Eigen::Ref<const Eigen::MatrixXd>& B,
                 bool transposed_B, Eigen::Ref<Eigen::MatrixXd> C);

/// C ← C + A Bᵀ where A Bᵀ and C are symmetric, by little more than half the operations.
void add_symmetric_product(const Eigen::Ref<const Eigen::MatrixXd>& A, const Eigen::Ref<const Eigen::MatrixXd>& B,
                           Eigen::Ref<Eigen::MatrixXd> C);

/// The lower triangle of C ← C + A Aᵀ.
void add_square(const Eigen::Ref<const Eigen::MatrixXd>& A, Eigen::Ref<Eigen::MatrixXd> C);

/// While any of these lives, OpenBLAS computes on the calling thread only: our threads and its own do not fight, and sums keep
/// their order. The previous setting returns with the last one, unless somebody has chosen another meanwhile.
class SingleThread {
 public:
  SingleThread();
  ~SingleThread();
  SingleThread(const SingleThread&) = delete;
  SingleThread& operator=(const SingleThread&) = delete;
};

/// While it lives inside a SingleThread, and no other thread uses OpenBLAS, OpenBLAS computes on n threads: for one large matrix.
class ManyThreads {
 public:
  explicit ManyThreads(int n_threads);
  ~ManyThreads();
  ManyThreads(const ManyThreads&) = delete;
  ManyThreads& operator=(const ManyThreads&) = delete;

 private:
  bool changed_ = false;
};

}  // namespace gp2::lapack
