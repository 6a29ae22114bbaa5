// The loops of simd.hpp for one instruction set: included once by each simd_*.cpp, which is compiled for that set and says with
// GP2_SIMD_BYTES how wide its vectors are. Nothing of another header may be called here: an inline function compiled for a wide
// set could stand in for the same function elsewhere in the program, and stop it on a narrower processor.

#include <utility>

#include "base/simd.hpp"

#if !defined(GP2_SIMD_BYTES)
#error "GP2_SIMD_BYTES is not set"
#endif

namespace gp2::simd {
namespace {

using Size = std::ptrdiff_t;

// p(r) with e^r ≈ 1 + r + r² p(r) for |r| ≤ ½ log 2, of Chebyshev interpolation; relative error 1.6e-17 and 1.0e-8
template <typename T>
struct Exponential;

template <>
struct Exponential<double> {
  using Integer = unsigned long long;
  static constexpr double coefficients[] = {
      0.5000000000000001,     0.16666666666666669,    0.04166666666662416,    0.008333333333330063,   0.0013888888917199863,
      0.00019841269863042963, 2.4801521317484083e-05, 2.7557268476553695e-06, 2.7620078203806394e-07, 2.5100377619606372e-08};
  static constexpr double lowest = -708;
  static constexpr double log2_e = 1.4426950408889634;
  static constexpr double log_2_high = 0.6931471803691238, log_2_low = 1.9082149292705877e-10;  // the high part has 21 zero bits
  static constexpr double round = 6755399441055744.0;                                           // 1.5 · 2^52
  static constexpr int mantissa_bits = 52;
};

template <>
struct Exponential<float> {
  using Integer = unsigned int;
  static constexpr float coefficients[] = {0.5F, 0.16666577F, 0.041666555F, 0.0083631743F, 0.0013926178F};
  static constexpr float lowest = -87;
  static constexpr float log2_e = 1.44269504F;
  static constexpr float log_2_high = 0.693359375F, log_2_low = -2.12194440e-4F;
  static constexpr float round = 12582912.0F;  // 1.5 · 2^23
  static constexpr int mantissa_bits = 23;
};

template <typename T>
struct Vector {
  static constexpr Size width = GP2_SIMD_BYTES / static_cast<Size>(sizeof(T));
  static_assert(lanes<T> % width == 0);
  using Type __attribute__((vector_size(GP2_SIMD_BYTES))) = T;
  using Bits __attribute__((vector_size(GP2_SIMD_BYTES))) = typename Exponential<T>::Integer;

  static inline Type load(const T* x) {
    Type v;
    __builtin_memcpy(&v, x, sizeof v);
    return v;
  }
  static inline void store(T* x, Type v) { __builtin_memcpy(x, &v, sizeof v); }
  static inline Type all(T x) { return x - Type{}; }

  // Exchanges one bit of the number of a row, a without it and b with it, with that of the number of a column.
  template <Size bit, Size... column>
  static inline void exchange(Type& a, Type& b, std::integer_sequence<Size, column...>) {
    const Type before = a;
    a = __builtin_shufflevector(before, b, ((column & bit) != 0 ? width + column - bit : column)...);
    b = __builtin_shufflevector(before, b, ((column & bit) != 0 ? width + column : column + bit)...);
  }
  // (width × width)
  template <Size bit = width / 2>
  static inline void transpose(Type* rows) {
    for (Size i = 0; i < width; ++i) {
      if ((i & bit) == 0) exchange<bit>(rows[i], rows[i + bit], std::make_integer_sequence<Size, width>());
    }
    if constexpr (bit > 1) transpose<bit / 2>(rows);
  }
  static inline T sum(Type v) {
    T total = 0;
    for (Size i = 0; i < width; ++i) total += v[i];
    return total;
  }

  // e^x = 2^n e^r with n = round(x / log 2): n stands in the low bits of x/log 2 + 1.5 · 2^52 and is added to the exponent of e^r
  static inline Type exponential(Type x) {
    using E = Exponential<T>;
    constexpr int degree = static_cast<int>(sizeof(E::coefficients) / sizeof(T)) - 1;
    const Type shifted = x * all(E::log2_e) + all(E::round);
    const Type n = shifted - all(E::round);
    const Type r = (x - n * all(E::log_2_high)) - n * all(E::log_2_low);
    Type p = all(E::coefficients[degree]);
    for (int k = degree - 1; k >= 0; --k) p = p * r + all(E::coefficients[k]);
    p = (r * r) * p + r + all(T(1));
    const Bits power = reinterpret_cast<Bits>(shifted) << E::mantissa_bits;
    // of NaN neither order holds, and it stays
    const Bits is_zero = reinterpret_cast<Bits>(x < all(E::lowest));
    return reinterpret_cast<Type>((reinterpret_cast<Bits>(p) + power) & ~is_zero);
  }
};

// calls body(i, v) for the vectors v of r² = Σ_d (x_id − p_d)² from row i on,
// several at a time so that they hide each other's latency
template <typename T, typename Body>
inline void for_each_squared_distance(Size n, Size D, const T* x, Size ldx, const T* p, const Body& body) {
  using V = Vector<T>;
  constexpr int unrolled = 4;
  Size i = 0;
  for (; i + unrolled * V::width <= n; i += unrolled * V::width) {
    typename V::Type r2[unrolled] = {};
    for (Size d = 0; d < D; ++d) {
      const typename V::Type pd = V::all(p[d]);
      for (int k = 0; k < unrolled; ++k) {
        const typename V::Type delta = V::load(x + d * ldx + i + k * V::width) - pd;
        r2[k] += delta * delta;
      }
    }
    for (int k = 0; k < unrolled; ++k) body(i + k * V::width, r2[k]);
  }
  for (; i < n; i += V::width) {
    typename V::Type r2 = {};
    for (Size d = 0; d < D; ++d) {
      const typename V::Type delta = V::load(x + d * ldx + i) - V::all(p[d]);
      r2 += delta * delta;
    }
    body(i, r2);
  }
}

template <typename T>
void squared_distance(Size n, Size D, const T* x, Size ldx, const T* p, T* out) {
  for_each_squared_distance<T>(n, D, x, ldx, p, [out](Size i, typename Vector<T>::Type r2) { Vector<T>::store(out + i, r2); });
}

template <typename T>
void squared_exponential(Size n, Size D, const T* x, Size ldx, const T* p, T* out) {
  using V = Vector<T>;
  for_each_squared_distance<T>(n, D, x, ldx, p,
                               [out](Size i, typename V::Type r2) { V::store(out + i, V::exponential(V::all(T(-0.5)) * r2)); });
}

template <typename T>
void exponential(Size n, T* x) {
  using V = Vector<T>;
  for (Size i = 0; i < n; i += V::width) V::store(x + i, V::exponential(V::load(x + i)));
}

// of m columns of B at once, which stay in registers
template <typename T, int m>
inline void weighted_sums(Size n, const T* w, const T* B, Size ldb, T* out) {
  using V = Vector<T>;
  typename V::Type sums[m] = {}, more[m] = {};
  Size i = 0;
  for (; i + 2 * V::width <= n; i += 2 * V::width) {
    const typename V::Type w0 = V::load(w + i), w1 = V::load(w + i + V::width);
    for (int k = 0; k < m; ++k) {
      sums[k] += w0 * V::load(B + k * ldb + i);
      more[k] += w1 * V::load(B + k * ldb + i + V::width);
    }
  }
  for (; i < n; i += V::width) {
    const typename V::Type w0 = V::load(w + i);
    for (int k = 0; k < m; ++k) sums[k] += w0 * V::load(B + k * ldb + i);
  }
  for (int k = 0; k < m; ++k) out[k] = V::sum(sums[k] + more[k]);
}

template <typename T>
void weighted_sums(Size n, Size m, const T* w, const T* B, Size ldb, T* out) {
  Size l = 0;
  for (; l + 3 <= m; l += 3) weighted_sums<T, 3>(n, w, B + l * ldb, ldb, out + l);
  for (; l < m; ++l) weighted_sums<T, 1>(n, w, B + l * ldb, ldb, out + l);
}

template <typename T>
void weighted_differences(Size n, Size D, const T* w, const T* x, Size ldx, const T* p, T* out) {
  using V = Vector<T>;
  for (Size d = 0; d < D; ++d) {
    typename V::Type sums = {}, more = {};
    const typename V::Type pd = V::all(p[d]);
    const T* const xd = x + d * ldx;
    Size i = 0;
    for (; i + 2 * V::width <= n; i += 2 * V::width) {
      sums += V::load(w + i) * (V::load(xd + i) - pd);
      more += V::load(w + i + V::width) * (V::load(xd + i + V::width) - pd);
    }
    for (; i < n; i += V::width) sums += V::load(w + i) * (V::load(xd + i) - pd);
    out[d] = V::sum(sums + more);
  }
}

// of n_x columns of x and n_b of B at once, which stay in registers
template <typename T, int n_x, int n_b>
inline void difference_products(Size n, Size D, const T* k, const T* B, Size ldb, const T* x, Size ldx, const T* p, T* out) {
  using V = Vector<T>;
  typename V::Type sums[n_b][n_x] = {};
  for (Size i = 0; i < n; i += V::width) {
    const typename V::Type ki = V::load(k + i);
    typename V::Type w[n_b];
    for (int l = 0; l < n_b; ++l) w[l] = ki * V::load(B + l * ldb + i);
    for (int d = 0; d < n_x; ++d) {
      const typename V::Type delta = V::load(x + d * ldx + i) - V::all(p[d]);
      for (int l = 0; l < n_b; ++l) sums[l][d] += w[l] * delta;
    }
  }
  for (int l = 0; l < n_b; ++l) {
    for (int d = 0; d < n_x; ++d) out[l * D + d] = V::sum(sums[l][d]);
  }
}

template <typename T>
void difference_products(Size n, Size D, Size m, const T* k, const T* B, Size ldb, const T* x, Size ldx, const T* p, T* out) {
  Size l = 0;
  for (; l + 3 <= m; l += 3) {
    Size d = 0;
    for (; d + 3 <= D; d += 3) {
      difference_products<T, 3, 3>(n, D, k, B + l * ldb, ldb, x + d * ldx, ldx, p + d, out + l * D + d);
    }
    for (; d < D; ++d) difference_products<T, 1, 3>(n, D, k, B + l * ldb, ldb, x + d * ldx, ldx, p + d, out + l * D + d);
  }
  for (; l < m; ++l) {
    Size d = 0;
    for (; d + 3 <= D; d += 3) {
      difference_products<T, 3, 1>(n, D, k, B + l * ldb, ldb, x + d * ldx, ldx, p + d, out + l * D + d);
    }
    for (; d < D; ++d) difference_products<T, 1, 1>(n, D, k, B + l * ldb, ldb, x + d * ldx, ldx, p + d, out + l * D + d);
  }
}

template <typename T>
void add_weighted_squares(Size n, Size D, const T* w, const T* x, Size ldx, const T* p, T* sums) {
  using V = Vector<T>;
  for (Size d = 0; d < D; ++d) {
    typename V::Type total = V::load(sums + d * lanes<T>), more = {};
    const typename V::Type pd = V::all(p[d]);
    const T* const xd = x + d * ldx;
    Size i = 0;
    for (; i + 2 * V::width <= n; i += 2 * V::width) {
      const typename V::Type delta = V::load(xd + i) - pd, delta_more = V::load(xd + i + V::width) - pd;
      total += V::load(w + i) * (delta * delta);
      more += V::load(w + i + V::width) * (delta_more * delta_more);
    }
    for (; i < n; i += V::width) {
      const typename V::Type delta = V::load(xd + i) - pd;
      total += V::load(w + i) * (delta * delta);
    }
    V::store(sums + d * lanes<T>, total + more);
  }
}

template <typename T>
void add_scaled_products(Size n, Size m, const T* k, const T* B, Size ldb, const T* b, T* out) {
  using V = Vector<T>;
  for (Size i = 0; i < n; i += V::width) {
    typename V::Type product = {};
    for (Size l = 0; l < m; ++l) product += V::load(B + l * ldb + i) * V::all(b[l]);
    V::store(out + i, V::load(out + i) + V::load(k + i) * product);
  }
}

template <typename T>
void contract(Size n, Size m, T* s, const T* k, const T* B, Size ldb, const T* b, T* h, T* sums) {
  using V = Vector<T>;
  for (Size i = 0; i < n; i += V::width) {
    typename V::Type product = {};
    for (Size l = 0; l < m; ++l) product += V::load(B + l * ldb + i) * V::all(b[l]);
    const typename V::Type si = V::load(s + i);
    V::store(h + i, V::load(h + i) + si * product);
    V::store(s + i, si * V::load(k + i));
  }
  for (Size l = 0; l < m; ++l) {
    typename V::Type total = {};
    for (Size i = 0; i < n; i += V::width) total += V::load(s + i) * V::load(B + l * ldb + i);
    V::store(sums + l * lanes<T>, V::load(sums + l * lanes<T>) + V::all(b[l]) * total);
  }
}

// Some columns of a matrix by rows, each of whole vectors.
template <typename T>
struct Tile {
  using V = Vector<T>;
  static constexpr Size n_vectors = 4, width = n_vectors * V::width;
  alignas(64) T rows[Loops<T>::most_rows * width];

  // Calls of_block(first row, first column) for whole blocks of V::width × V::width of n × m entries, of_entry(row, column) for others.
  template <typename OfBlock, typename OfEntry>
  static inline void for_each(Size n, Size m, const OfBlock& of_block, const OfEntry& of_entry) {
    for (Size j = 0; j < m; j += V::width) {
      const Size count = m - j < V::width ? m - j : V::width;
      Size i = 0;
      for (; count == V::width && i + V::width <= n; i += V::width) of_block(i, j);
      for (; i < n; ++i) {
        for (Size k = 0; k < count; ++k) of_entry(i, j + k);
      }
    }
  }

  // first: the row of the first one, step: from each to the next
  inline void take(Size n, Size m, const T* B, Size ldb, T* first, Size step) {
    if (m < width) {
      for (Size i = 0; i < n * width; ++i) rows[i] = 0;
    }
    for_each(
        n, m,
        [&](Size i, Size j) {
          typename V::Type block[V::width];
          for (Size k = 0; k < V::width; ++k) block[k] = V::load(B + (j + k) * ldb + i);
          V::transpose(block);
          for (Size k = 0; k < V::width; ++k) V::store(first + (i + k) * step + j, block[k]);
        },
        [&](Size i, Size j) { first[i * step + j] = B[j * ldb + i]; });
  }
  inline void give(Size n, Size m, T* B, Size ldb, const T* first, Size step) const {
    for_each(
        n, m,
        [&](Size i, Size j) {
          typename V::Type block[V::width];
          for (Size k = 0; k < V::width; ++k) block[k] = V::load(first + (i + k) * step + j);
          V::transpose(block);
          for (Size k = 0; k < V::width; ++k) V::store(B + (j + k) * ldb + i, block[k]);
        },
        [&](Size i, Size j) { B[j * ldb + i] = first[i * step + j]; });
  }

  // x_i ← (x_i − Σ_k<i T_ik x_k)/T_ii, two rows at once
  inline void solve(Size n, const T* triangle) {
    typename V::Type a[n_vectors], b[n_vectors];
    for (Size i = 0; i < n; i += 2) {
      const bool is_last = i + 1 == n;
      T* const x = rows + i * width;
      const T *const of_a = triangle + i * n, *const of_b = is_last ? of_a : of_a + n;
      for (Size v = 0; v < n_vectors; ++v) {
        a[v] = V::load(x + v * V::width);
        b[v] = is_last ? a[v] : V::load(x + width + v * V::width);
      }
      for (Size k = 0; k < i; ++k) {
        for (Size v = 0; v < n_vectors; ++v) {
          const typename V::Type known = V::load(rows + k * width + v * V::width);
          a[v] -= V::all(of_a[k]) * known;
          b[v] -= V::all(of_b[k]) * known;
        }
      }
      for (Size v = 0; v < n_vectors; ++v) {
        a[v] *= V::all(of_a[i]);
        V::store(x + v * V::width, a[v]);
        if (!is_last) V::store(x + width + v * V::width, (b[v] - V::all(of_b[i]) * a[v]) * V::all(of_b[i + 1]));
      }
    }
  }
};

template <typename T>
void solve_triangle(Size n, const T* triangle, bool reversed, Size m, T* B, Size ldb) {
  Tile<T> tile;
  const Size step = reversed ? -Tile<T>::width : Tile<T>::width;
  T* const first = reversed ? tile.rows + (n - 1) * Tile<T>::width : tile.rows;
  for (Size j = 0; j < m; j += Tile<T>::width) {
    const Size count = m - j < Tile<T>::width ? m - j : Tile<T>::width;
    tile.take(n, count, B + j * ldb, ldb, first, step);
    tile.solve(n, triangle);
    tile.give(n, count, B + j * ldb, ldb, first, step);
  }
}

template <typename T>
constexpr Loops<T> make_loops() {
  return {squared_distance<T>,    squared_exponential<T>,  exponential<T>,         weighted_sums<T>, weighted_differences<T>,
          difference_products<T>, add_weighted_squares<T>, add_scaled_products<T>, contract<T>,      solve_triangle<T>};
}

}  // namespace
}  // namespace gp2::simd
