#pragma once

#include <cstddef>

namespace gp2::simd {

/// The loops below run over whole vectors: arrays have this many numbers, or a multiple of it.
template <typename T>
inline constexpr std::ptrdiff_t lanes = 64 / static_cast<std::ptrdiff_t>(sizeof(T));

/// n rounded up to whole vectors.
template <typename T = double>
constexpr std::ptrdiff_t padded(std::ptrdiff_t n) {
  return (n + lanes<T> - 1) / lanes<T> * lanes<T>;
}

/// The hot loops over the points of a kernel, in double or single precision. n is a multiple of lanes<T>; x is column-major (n ×
/// D) with leading dimension ldx, B (n × m) with ldb. Nothing needs alignment.
template <typename T>
struct Loops {
  using Size = std::ptrdiff_t;

  /// out_i = Σ_d (x_id − p_d)²
  void (*squared_distance)(Size n, Size D, const T* x, Size ldx, const T* p, T* out);
  /// out_i = exp(−½ Σ_d (x_id − p_d)²)
  void (*squared_exponential)(Size n, Size D, const T* x, Size ldx, const T* p, T* out);
  /// x_i ← exp(x_i), to 1 ulp for x_i in [−708, 709] ([−87, 88] in single precision); below, 0. NaN stays NaN.
  void (*exponential)(Size n, T* x);
  /// out_l = Σ_i w_i B_il
  void (*weighted_sums)(Size n, Size m, const T* w, const T* B, Size ldb, T* out);
  /// out_d = Σ_i w_i (x_id − p_d)
  void (*weighted_differences)(Size n, Size D, const T* w, const T* x, Size ldx, const T* p, T* out);
  /// out_dl = Σ_i k_i B_il (x_id − p_d) (D × m)
  void (*difference_products)(Size n, Size D, Size m, const T* k, const T* B, Size ldb, const T* x, Size ldx, const T* p, T* out);
  /// sums_d,lane += Σ w_i (x_id − p_d)² over the i of each lane,
  /// so that many calls need one sum over lanes at the end (lanes × D)
  void (*add_weighted_squares)(Size n, Size D, const T* w, const T* x, Size ldx, const T* p, T* sums);
  /// out_i += k_i Σ_l B_il b_l
  void (*add_scaled_products)(Size n, Size m, const T* k, const T* B, Size ldb, const T* b, T* out);
  /// h_i += s_i Σ_l B_il b_l
  /// s_i ← s_i k_i
  /// sums_l,lane += b_l Σ s_i B_il over the i of each lane (lanes × m)
  void (*contract)(Size n, Size m, T* s, const T* k, const T* B, Size ldb, const T* b, T* h, T* sums);
  /// B ← T⁻¹ B, or with B's rows from the last to the first (n × m, any numbers, n at most most_rows). T is lower triangular, by rows
  /// (n × n), with the reciprocals of its diagonal in place of it.
  void (*solve_triangle)(Size n, const T* triangle, bool reversed, Size m, T* B, Size ldb);
  static constexpr Size most_rows = 64;
};

/// The loops of one instruction set.
struct Target {
  const char* name;  // "AVX-512", "AVX2", "baseline"
  Loops<double> loops;
  Loops<float> loops_single;
};

/// The widest that this processor and operating system run; chosen once.
const Target& target();

/// Every one they run, from narrow to wide; for tests. `count` receives how many.
const Target* const* targets(int& count);

inline const Loops<double>& loops() { return target().loops; }

}  // namespace gp2::simd
