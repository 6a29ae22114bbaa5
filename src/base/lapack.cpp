#include "base/lapack.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <mutex>

#include <fmt/format.h>

#include "base/mapped_memory.hpp"
#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"

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

// A thread that calls OpenBLAS. There are as many buffers as there ever were of these at a time; before there is one more the system
// is asked for it.
class BufferInUse {
 public:
  BufferInUse() {
    const int n = ++n_in_use_;
    if (n <= n_buffers_) return;
    const std::scoped_lock lock(thread_mutex);
    if (n <= n_buffers_) return;
    // and for as much again, since other threads take memory of their own meanwhile
    if (!maps(blas_buffer, 2)) {
      --n_in_use_;
      throw InputError(fmt::format(
          "OpenBLAS needs a buffer of {:.0f} MB, which the system does not give: raise the limit on memory (ulimit -v)",
          blas_buffer / 1e6));
    }
    n_buffers_ = n;
  }
  ~BufferInUse() { --n_in_use_; }
  BufferInUse(const BufferInUse&) = delete;
  BufferInUse& operator=(const BufferInUse&) = delete;

 private:
  static inline std::atomic<int> n_in_use_ = 0, n_buffers_ = 0;
};

// A matrix in memory, by its first entry.
struct Block {
  double* data;
  int stride;

  [[nodiscard]] Block at(int row, int column) const {
    return {data + row + column * static_cast<std::ptrdiff_t>(stride), stride};
  }
};

// Of what is const it is only read: Block is one type for both.
Block block_of(const Eigen::Ref<const Eigen::MatrixXd>& A) {
  return {const_cast<double*>(A.data()), static_cast<int>(A.outerStride())};  // NOLINT(cppcoreguidelines-pro-type-const-cast)
}

// Calls work(first, how many) for pieces of n rows or columns, each of which takes so many operations; false when stopped.
template <typename Work>
bool in_pieces(int n, double per_row, const Pieces& pieces, const Work& work) {
  constexpr int multiple = 64;  // that OpenBLAS works fast with
  const int most = std::max(1, static_cast<int>(std::min(pieces.operations / std::max(per_row, 1.0), 1e9)) / multiple) * multiple;
  for (int first = 0; first < n; first += most) {
    if (is_set(pieces.stop)) return false;
    work(first, std::min(most, n - first));
  }
  return true;
}

// Where a triangle of n rows is cut in two.
int first_half(int n) { return (n / 2 + 7) / 8 * 8; }
bool is_one_piece(int n, const Pieces& pieces) { return static_cast<double>(n) * n * n / 3 <= pieces.operations; }

// The lower triangle of C (n × n) plus sign times B Bᵀ, B (n × k), or Bᵀ B, B (k × n).
bool add_square(bool transposed, int n, int k, double sign, Block B, Block C, const Pieces& pieces) {
  const double one = 1;
  return in_pieces(n, 2. * n * k, pieces, [&](int first, int columns) {
    const int below = n - first - columns;
    const auto rows_of_B = [&](int row) { return transposed ? B.at(0, row) : B.at(row, 0); };
    const Block left = rows_of_B(first), rest = rows_of_B(first + columns);
    dsyrk_("L", transposed ? "T" : "N", &columns, &k, &sign, left.data, &left.stride, &one, C.at(first, first).data, &C.stride, 1,
           1);
    if (below == 0) return;
    dgemm_(transposed ? "T" : "N", transposed ? "N" : "T", &below, &columns, &k, &sign, rest.data, &rest.stride, left.data,
           &left.stride, &one, C.at(first + columns, first).data, &C.stride, 1, 1);
  });
}

// [A11 ·; A21 A22] = [L11 0; L21 L22][L11 0; L21 L22]ᵀ: L21 = A21 L11⁻ᵀ, L22 L22ᵀ = A22 − L21 L21ᵀ
bool factorise(int n, Block A, const Pieces& pieces) {
  if (is_set(pieces.stop)) return false;
  if (is_one_piece(n, pieces)) {
    int info = 0;
    if (n > 0) dpotrf_("L", &n, A.data, &A.stride, &info, 1);
    return info == 0;
  }
  const int first = first_half(n), second = n - first;
  const Block A21 = A.at(first, 0), A22 = A.at(first, first);
  const double one = 1;
  return factorise(first, A, pieces) &&
         in_pieces(second, static_cast<double>(first) * first, pieces,
                   [&](int row, int rows) {
                     dtrsm_("R", "L", "T", "N", &rows, &first, &one, A.data, &A.stride, A21.at(row, 0).data, &A.stride, 1, 1, 1,
                            1);
                   }) &&
         add_square(false, second, first, -1, A21, A22, pieces) && factorise(second, A22, pieces);
}

}  // namespace

bool factorise(Eigen::Ref<Eigen::MatrixXd> A, const Pieces& pieces) {
  const BufferInUse buffer;
  return factorise(static_cast<int>(A.rows()), block_of(A), pieces);
}

PivotedFactor factorise_semidefinite(Eigen::MatrixXd A, std::optional<double> smallest) {
  const BufferInUse buffer;
  const int n = static_cast<int>(A.rows());
  PivotedFactor factor{Eigen::MatrixXd(n, 0), std::vector<int>(static_cast<std::size_t>(n))};
  if (n == 0) return factor;
  int rank = 0, info = 0;
  const double tolerance = smallest ? *smallest * A.diagonal().maxCoeff() : -1;  // −1: n ε times the largest of the diagonal
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
bool invert_triangle(int n, Block L, const Pieces& pieces) {
  constexpr int small = 24;
  if (n <= small) {
    invert_small_triangle(n, L.data, L.stride);
    return true;
  }
  const int first = first_half(n), second = n - first;
  const Block L21 = L.at(first, 0), L22 = L.at(first, first);
  const double minus_one = -1, one = 1;
  return invert_triangle(first, L, pieces) && invert_triangle(second, L22, pieces) &&
         in_pieces(second, static_cast<double>(first) * first, pieces,
                   [&](int row, int rows) {
                     dtrmm_("R", "L", "N", "N", &rows, &first, &minus_one, L.data, &L.stride, L21.at(row, 0).data, &L.stride, 1,
                            1, 1, 1);
                   }) &&
         in_pieces(first, static_cast<double>(second) * second, pieces, [&](int column, int columns) {
           dtrmm_("L", "L", "N", "N", &second, &columns, &one, L22.data, &L.stride, L21.at(0, column).data, &L.stride, 1, 1, 1,
                  1);
         });
}

// [X11 0; X21 X22]ᵀ[X11 0; X21 X22] = [X11ᵀX11 + X21ᵀX21, ·; X22ᵀX21, X22ᵀX22]
bool square_triangle(int n, Block X, const Pieces& pieces) {
  if (is_set(pieces.stop)) return false;
  if (is_one_piece(n, pieces)) {
    int info = 0;
    dlauum_("L", &n, X.data, &X.stride, &info, 1);
    return true;
  }
  const int first = first_half(n), second = n - first;
  const Block X21 = X.at(first, 0), X22 = X.at(first, first);
  const double one = 1;
  return square_triangle(first, X, pieces) && add_square(true, first, second, 1, X21, X, pieces) &&
         in_pieces(first, static_cast<double>(second) * second, pieces,
                   [&](int column, int columns) {
                     dtrmm_("L", "L", "T", "N", &second, &columns, &one, X22.data, &X.stride, X21.at(0, column).data, &X.stride,
                            1, 1, 1, 1);
                   }) &&
         square_triangle(second, X22, pieces);
}

}  // namespace

void invert_factored(Eigen::Ref<Eigen::MatrixXd> L, const Pieces& pieces) {
  const BufferInUse buffer;
  const int n = static_cast<int>(L.rows());
  if (n > 0 && invert_triangle(n, block_of(L), pieces)) square_triangle(n, block_of(L), pieces);
}

namespace {

constexpr int most_solved = static_cast<int>(simd::Loops<double>::most_rows);

// Of a small triangle: dtrsm of OpenBLAS' kernels for AVX-512 takes ten times as long.
void solve_small(int n, Block L, bool transposed, int n_columns, Block B) {
  std::array<double, most_solved * most_solved> triangle;
  for (int i = 0; i < n; ++i) {
    double* const row = &triangle[static_cast<std::size_t>(i) * static_cast<std::size_t>(n)];
    // Lᵀ from its last row and column on is a lower triangle too
    for (int k = 0; k <= i; ++k) row[k] = transposed ? *L.at(n - 1 - k, n - 1 - i).data : *L.at(i, k).data;
    row[i] = 1 / row[i];
  }
  simd::loops().solve_triangle(n, triangle.data(), transposed, n_columns, B.data, B.stride);
}

// B ← L⁻¹ B, or L⁻ᵀ B, by halves
void solve_lower(int n, Block L, bool transposed, int n_columns, Block B) {
  const double one = 1, minus_one = -1;
  if (n <= most_solved) return solve_small(n, L, transposed, n_columns, B);
  const int first = first_half(n), second = n - first;
  const Block L21 = L.at(first, 0), L22 = L.at(first, first), B2 = B.at(first, 0);
  if (transposed) {
    solve_lower(second, L22, true, n_columns, B2);
    dgemm_("T", "N", &first, &n_columns, &second, &minus_one, L21.data, &L.stride, B2.data, &B.stride, &one, B.data, &B.stride, 1,
           1);
    solve_lower(first, L, true, n_columns, B);
  } else {
    solve_lower(first, L, false, n_columns, B);
    dgemm_("N", "N", &second, &n_columns, &first, &minus_one, L21.data, &L.stride, B.data, &B.stride, &one, B2.data, &B.stride, 1,
           1);
    solve_lower(second, L22, false, n_columns, B2);
  }
}

}  // namespace

void solve_lower(const Eigen::Ref<const Eigen::MatrixXd>& L, bool transposed, Eigen::Ref<Eigen::MatrixXd> B) {
  const BufferInUse buffer;
  const int n = static_cast<int>(L.rows()), n_columns = static_cast<int>(B.cols());
  const Block of_L = block_of(L);
  if (n == 0 || n_columns == 0) return;
  if (n_columns > 1) return solve_lower(n, of_L, transposed, n_columns, block_of(B));
  // half the time of dtrsm, which packs L first
  const int step = 1;
  dtrsv_("L", transposed ? "T" : "N", "N", &n, of_L.data, &of_L.stride, B.data(), &step, 1, 1, 1);
}

void solve_factored(const Eigen::Ref<const Eigen::MatrixXd>& L, Eigen::Ref<Eigen::MatrixXd> B) {
  solve_lower(L, false, B);
  solve_lower(L, true, B);
}

void multiply_lower(const Eigen::Ref<const Eigen::MatrixXd>& L, Eigen::Ref<Eigen::MatrixXd> B) {
  const BufferInUse buffer;
  const int n = static_cast<int>(L.rows()), n_columns = static_cast<int>(B.cols());
  const Block of_L = block_of(L), of_B = block_of(B);
  const double one = 1;
  if (n == 0 || n_columns == 0) return;
  dtrmm_("L", "L", "N", "N", &n, &n_columns, &one, of_L.data, &of_L.stride, of_B.data, &of_B.stride, 1, 1, 1, 1);
}

void add_product(const Eigen::Ref<const Eigen::MatrixXd>& A, bool transposed_A, const Eigen::Ref<const Eigen::MatrixXd>& B,
                 bool transposed_B, Eigen::Ref<Eigen::MatrixXd> C) {
  const BufferInUse buffer;
  const int m = static_cast<int>(C.rows()), n = static_cast<int>(C.cols()),
            k = static_cast<int>(transposed_A ? A.rows() : A.cols());
  const Block of_A = block_of(A), of_B = block_of(B), of_C = block_of(C);
  const double one = 1;
  if (m == 0 || n == 0 || k == 0) return;
  dgemm_(transposed_A ? "T" : "N", transposed_B ? "T" : "N", &m, &n, &k, &one, of_A.data, &of_A.stride, of_B.data, &of_B.stride,
         &one, of_C.data, &of_C.stride, 1, 1);
}

void add_symmetric_product(const Eigen::Ref<const Eigen::MatrixXd>& A, const Eigen::Ref<const Eigen::MatrixXd>& B,
                           Eigen::Ref<Eigen::MatrixXd> C) {
  constexpr Eigen::Index strip = 64;  // columns; of fewer a product is slow
  for (Eigen::Index first = 0; first < C.cols(); first += strip) {
    const Eigen::Index n = std::min(strip, C.cols() - first), below = C.rows() - first;
    add_product(A.bottomRows(below), false, B.middleRows(first, n), true, C.block(first, first, below, n));
    const Eigen::Index left = below - n;
    C.block(first, first + n, n, left) = C.block(first + n, first, left, n).transpose();
  }
}

void add_square(const Eigen::Ref<const Eigen::MatrixXd>& A, Eigen::Ref<Eigen::MatrixXd> C) {
  const BufferInUse buffer;
  const int n = static_cast<int>(A.rows()), k = static_cast<int>(A.cols());
  const Block of_A = block_of(A), of_C = block_of(C);
  const double one = 1;
  if (n == 0 || k == 0) return;
  dsyrk_("L", "N", &n, &k, &one, of_A.data, &of_A.stride, &one, of_C.data, &of_C.stride, 1, 1);
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
