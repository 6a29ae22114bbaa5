#include "inference/lapack.hpp"

#include <mutex>

// present in OpenBLAS only; another BLAS keeps its own threading
extern "C" {
__attribute__((weak)) void openblas_set_num_threads(int);
__attribute__((weak)) int openblas_get_num_threads();
}

namespace gp2::lapack {

namespace {
std::mutex thread_mutex;
int n_holders = 0;
int threads_before = 1;
}  // namespace

bool factorise(Eigen::MatrixXd& A) {
  const int n = static_cast<int>(A.rows());
  int info = 0;
  if (n > 0) dpotrf_("L", &n, A.data(), &n, &info, 1);
  return info == 0;
}

PivotedFactor factorise_semidefinite(Eigen::MatrixXd A) {
  const int n = static_cast<int>(A.rows());
  PivotedFactor factor{Eigen::MatrixXd(n, 0), std::vector<int>(static_cast<std::size_t>(n))};
  if (n == 0) return factor;
  int rank = 0, info = 0;
  const double tolerance = -1;  // n ε times the largest entry of the diagonal
  Eigen::VectorXd work(2 * n);
  dpstrf_("L", &n, A.data(), &n, factor.rows.data(), &rank, &tolerance, work.data(), &info, 1);
  for (int& row : factor.rows) --row;  // Fortran counts from 1
  factor.L = A.leftCols(rank).triangularView<Eigen::Lower>();
  return factor;
}

void invert_factored(Eigen::MatrixXd& L) {
  const int n = static_cast<int>(L.rows());
  int info = 0;
  if (n > 0) dpotri_("L", &n, L.data(), &n, &info, 1);
}

void solve_lower(const Eigen::MatrixXd& L, bool transposed, Eigen::Ref<Eigen::MatrixXd> B) {
  const int n = static_cast<int>(L.rows());
  const int n_columns = static_cast<int>(B.cols());
  const int ldb = static_cast<int>(B.outerStride());
  const double one = 1;
  if (n > 0 && n_columns > 0)
    dtrsm_("L", "L", transposed ? "T" : "N", "N", &n, &n_columns, &one, L.data(), &n, B.data(), &ldb, 1, 1, 1, 1);
}

SingleThread::SingleThread() {
  const std::scoped_lock lock(thread_mutex);
  if (n_holders++ == 0 && openblas_set_num_threads != nullptr) {
    threads_before = openblas_get_num_threads();
    openblas_set_num_threads(1);
  }
}

SingleThread::~SingleThread() {
  const std::scoped_lock lock(thread_mutex);
  if (--n_holders == 0 && openblas_set_num_threads != nullptr) openblas_set_num_threads(threads_before);
}

}  // namespace gp2::lapack
