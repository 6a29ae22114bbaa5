#include "base/lapack.hpp"

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
int threads_before = 1;  // of OpenBLAS, when the first of our objects came
int threads_set = 1;     // by us, last

void set_threads(int n) {
  openblas_set_num_threads(n);
  threads_set = n;
}

// as long as nobody else has chosen another number meanwhile
void set_threads_again(int n) {
  if (openblas_get_num_threads() == threads_set) set_threads(n);
}
}  // namespace

bool factorise(Eigen::Ref<Eigen::MatrixXd> A) {
  const int n = static_cast<int>(A.rows());
  const int lda = static_cast<int>(A.outerStride());
  int info = 0;
  if (n > 0) dpotrf_("L", &n, A.data(), &lda, &info, 1);
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

namespace {

// L ← L⁻¹ column by column from the last, X_jj = 1/L_jj and X_(>j),j = −X_(>j) L_(>j),j X_jj
void invert_small_triangle(int n, double* L, std::ptrdiff_t lda) {
  for (int j = n - 1; j >= 0; --j) {
    double* const column = L + j * lda;
    const double pivot = 1 / column[j];
    for (int k = n - 1; k > j; --k) {
      const double* const x = L + k * lda;
      const double factor = column[k];
      column[k] = factor * x[k];
      for (int i = k + 1; i < n; ++i) column[i] += factor * x[i];
    }
    column[j] = pivot;
    for (int i = j + 1; i < n; ++i) column[i] *= -pivot;
  }
}

// [L11 0; L21 L22]⁻¹ = [X11 0; −X22 L21 X11, X22]
void invert_triangle(int n, double* L, int lda) {
  constexpr int small = 24;
  if (n <= small) {
    invert_small_triangle(n, L, lda);
    return;
  }
  const int first = (n / 2 + 7) / 8 * 8;
  const int second = n - first;
  double* const L21 = L + first;
  double* const L22 = L21 + static_cast<std::ptrdiff_t>(first) * lda;
  invert_triangle(first, L, lda);
  invert_triangle(second, L22, lda);
  const double minus_one = -1, one = 1;
  dtrmm_("R", "L", "N", "N", &second, &first, &minus_one, L, &lda, L21, &lda, 1, 1, 1, 1);
  dtrmm_("L", "L", "N", "N", &second, &first, &one, L22, &lda, L21, &lda, 1, 1, 1, 1);
}

}  // namespace

void invert_factored(Eigen::Ref<Eigen::MatrixXd> L) {
  const int n = static_cast<int>(L.rows());
  const int lda = static_cast<int>(L.outerStride());
  int info = 0;
  if (n == 0) return;
  invert_triangle(n, L.data(), lda);
  dlauum_("L", &n, L.data(), &lda, &info, 1);
}

void solve_lower(const Eigen::Ref<const Eigen::MatrixXd>& L, bool transposed, Eigen::Ref<Eigen::MatrixXd> B) {
  const int n = static_cast<int>(L.rows());
  const int n_columns = static_cast<int>(B.cols());
  const int lda = static_cast<int>(L.outerStride());
  const int ldb = static_cast<int>(B.outerStride());
  const double one = 1;
  const char* const transposition = transposed ? "T" : "N";
  if (n == 0 || n_columns == 0) return;
  if (n_columns == 1) {
    // half the time of dtrsm, which packs L first
    const int step = 1;
    dtrsv_("L", transposition, "N", &n, L.data(), &lda, B.data(), &step, 1, 1, 1);
    return;
  }
  dtrsm_("L", "L", transposition, "N", &n, &n_columns, &one, L.data(), &lda, B.data(), &ldb, 1, 1, 1, 1);
}

SingleThread::SingleThread() {
  const std::scoped_lock lock(thread_mutex);
  if (n_holders++ > 0 || openblas_set_num_threads == nullptr) return;
  threads_before = openblas_get_num_threads();
  set_threads(1);
}

SingleThread::~SingleThread() {
  const std::scoped_lock lock(thread_mutex);
  if (--n_holders == 0 && openblas_set_num_threads != nullptr) set_threads_again(threads_before);
}

ManyThreads::ManyThreads(int n_threads) {
  const std::scoped_lock lock(thread_mutex);
  if (n_threads <= 1 || openblas_set_num_threads == nullptr) return;
  set_threads(n_threads);
  changed_ = true;
}

ManyThreads::~ManyThreads() {
  const std::scoped_lock lock(thread_mutex);
  if (changed_) set_threads_again(n_holders > 0 ? 1 : threads_before);
}

}  // namespace gp2::lapack
