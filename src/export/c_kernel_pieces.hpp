#pragma once

#include "export/fill_template.hpp"

// What a kernel is made of in the exported C. A piece comes after those that it calls.
namespace gp2::c_export {

inline constexpr Piece kernel_pieces[] = {
    {"total", R"c(static real total(const real *sums)
{
  real sum = 0;
  for (int e = 0; e < LANES; ++e) sum += sums[e];
  return sum;
}
)c"},
    {"exponentials",
     R"c(/* x_i := e^x_i of x_i <= 0, to 1 ulp: 2^m e^r with m = x_i / log 2 rounded, and a polynomial for e^r. Below -708 it is e^-708.
 * It is a loop that compilers turn into vectors, which exp is not; so are those below. */
static void exponentials(int n, double *x)
{
  for (int i = 0; i < n; ++i) x[i] = x[i] > -708 ? x[i] : -708;
  for (int i = 0; i < n; ++i) {
    union {
      double value;
      unsigned long long bits;
    } power; /* 2^m by its bits */
    const int m = (int)(x[i] * 1.4426950408889634 - 0.5);
    const double r = (x[i] - m * 0.6931471803691238) - m * 1.9082149292705877e-10;
    double p = 2.5100377619606372e-08;
    p = p * r + 2.7620078203806394e-07;
    p = p * r + 2.7557268476553695e-06;
    p = p * r + 2.4801521317484083e-05;
    p = p * r + 0.00019841269863042963;
    p = p * r + 0.0013888888917199863;
    p = p * r + 0.008333333333330063;
    p = p * r + 0.04166666666662416;
    p = p * r + 0.16666666666666669;
    p = p * r + 0.5000000000000001;
    power.bits = (unsigned long long)(m + 1023) << 52;
    x[i] = (r * r * p + r + 1) * power.value;
  }
}
)c"},
    {"squared_distance", R"c(/* r2_i = sum of ((x_ij - p_j) scale_j)^2 over d features */
static void squared_distance(int n, int d, const real *x, const real *p, const real *scale, real *r2)
{
  for (int i = 0; i < n; ++i) r2[i] = 0;
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) {
      const real delta = (x[n * j + i] - p[j]) * scale[j];
      r2[i] += delta * delta;
    }
  }
}
)c"},
    {"times_se",
     R"c(/* The functions times_... multiply `value` by a kernel between n points x and the point p, slope_... by -2 dk/d(r^2). */
static void times_se(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) scratch[i] = -scratch[i] / 2;
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"times_matern32",
     R"c(static void times_matern32(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) {
    scratch[i] = -sqrt(3 * scratch[i]);
    value[i] *= 1 - scratch[i];
  }
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"times_matern52",
     R"c(static void times_matern52(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) {
    scratch[i] = -sqrt(5 * scratch[i]);
    value[i] *= 1 - scratch[i] + scratch[i] * scratch[i] / 3;
  }
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"times_rq", R"c(static void times_rq(int n, int d, const real *x, const real *p, const real *scale, const real *parameters,
    real *scratch, real *value)
{
  const real alpha = parameters[d];
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) value[i] *= exp(-alpha * log(1 + scratch[i] / (2 * alpha)));
}
)c"},
    {"times_periodic",
     R"c(static void times_periodic(int n, int d, const real *x, const real *p, const real *scale, const real *parameters,
    real *scratch, real *value)
{
  for (int i = 0; i < n; ++i) scratch[i] = 0;
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) {
      const real s = sin((x[n * j + i] - p[j]) * scale[j]) / parameters[j];
      scratch[i] -= 2 * s * s;
    }
  }
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"times_linear",
     R"c(static void times_linear(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  for (int i = 0; i < n; ++i) scratch[i] = 0;
  for (int j = 0; j < d; ++j) {
    const real factor = p[j] * scale[j] * scale[j];
    for (int i = 0; i < n; ++i) scratch[i] += x[n * j + i] * factor;
  }
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"slope_matern32",
     R"c(static void slope_matern32(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) scratch[i] = -sqrt(3 * scratch[i]);
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= 3 * scratch[i];
}
)c"},
    {"slope_matern52",
     R"c(static void slope_matern52(int n, int d, const real *x, const real *p, const real *scale, real *scratch, real *value)
{
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) {
    scratch[i] = -sqrt(5 * scratch[i]);
    value[i] *= 5 * (1 - scratch[i]) / 3;
  }
  exponentials(n, scratch);
  for (int i = 0; i < n; ++i) value[i] *= scratch[i];
}
)c"},
    {"slope_rq", R"c(static void slope_rq(int n, int d, const real *x, const real *p, const real *scale, const real *parameters,
    real *scratch, real *value)
{
  const real alpha = parameters[d];
  squared_distance(n, d, x, p, scale, scratch);
  for (int i = 0; i < n; ++i) {
    const real base = 1 + scratch[i] / (2 * alpha);
    value[i] *= exp(-alpha * log(base)) / base;
  }
}
)c"},
    {"squared_norm", R"c(static real squared_norm(int d, const real *p, const real *scale)
{
  real sum = 0;
  for (int j = 0; j < d; ++j) sum += p[j] * scale[j] * (p[j] * scale[j]);
  return sum;
}
)c"},
    {"weighted_sum", R"c(/* sum of a_i b_i, in LANES sums that are added up at the end */
static real weighted_sum(int n, const real *a, const real *b)
{
  real sums[LANES] = {0}, more[LANES] = {0};
  int i = 0;
  for (; i + 2 * LANES <= n; i += 2 * LANES) {
    for (int e = 0; e < LANES; ++e) sums[e] += a[i + e] * b[i + e];
    for (int e = 0; e < LANES; ++e) more[e] += a[i + LANES + e] * b[i + LANES + e];
  }
  for (; i < n; i += LANES) {
    for (int e = 0; e < LANES; ++e) sums[e] += a[i + e] * b[i + e];
  }
  for (int e = 0; e < LANES; ++e) sums[e] += more[e];
  return total(sums);
}
)c"},
    {"add_differences", R"c(/* out_jl += sum of slope_i weights_il times the derivative of r^2/-2 in feature j of the state */
static void add_differences(int n, int d, int m, const real *x, const real *p, const real *scale, const real *slope,
    const real *weights, real *out)
{
  for (int l = 0; l < m; ++l) {
    for (int j = 0; j < d; ++j) {
      real sums[LANES] = {0};
      for (int i = 0; i < n; i += LANES) {
        for (int e = 0; e < LANES; ++e) sums[e] += slope[i + e] * weights[n * l + i + e] * (x[n * j + i + e] - p[j]);
      }
      out[d * l + j] += total(sums) * scale[j] * scale[j];
    }
  }
}
)c"},
    {"add_sines", R"c(/* The same of a periodic kernel. */
static void add_sines(int n, int d, int m, const real *x, const real *p, const real *scale, const real *parameters,
    const real *value, const real *weights, real *out)
{
  for (int j = 0; j < d; ++j) {
    const real factor = 2 * scale[j] / (parameters[j] * parameters[j]);
    for (int i = 0; i < n; ++i) {
      const real slope = value[i] * factor * sin(2 * (x[n * j + i] - p[j]) * scale[j]);
      for (int l = 0; l < m; ++l) out[d * l + j] += slope * weights[n * l + i];
    }
  }
}
)c"},
    {"add_features", R"c(/* The same of a linear kernel. */
static void add_features(int n, int d, int m, const real *x, const real *scale, const real *value, const real *weights, real *out)
{
  for (int l = 0; l < m; ++l) {
    for (int j = 0; j < d; ++j) {
      real sums[LANES] = {0};
      for (int i = 0; i < n; i += LANES) {
        for (int e = 0; e < LANES; ++e) sums[e] += value[i + e] * weights[n * l + i + e] * x[n * j + i + e];
      }
      out[d * l + j] += total(sums) * scale[j] * scale[j];
    }
  }
}
)c"},
    {"compare_points",
     R"c(/* Of pairs of points x and p: k1, k2, k3 (n each), which slopes_... make of s = |delta|^2/2 in the place of k1, and delta (n x d).
 * The covariance of the gradients of a potential is scale (k1 I + k2 delta delta') scale, and dk2/ds = k3. */
static void compare_points(int n, int d, const real *x, const real *p, const real *scale, real *pairs)
{
  real *const s = pairs, *const delta = pairs + 3 * n;
  for (int i = 0; i < n; ++i) s[i] = 0;
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) {
      delta[n * j + i] = (x[n * j + i] - p[j]) * scale[j];
      s[i] += delta[n * j + i] * delta[n * j + i] / 2;
    }
  }
}
)c"},
    {"slopes_se", R"c(static void slopes_se(int n, real square, real *pairs)
{
  real *const k1 = pairs, *const k2 = pairs + n, *const k3 = pairs + 2 * n;
  for (int i = 0; i < n; ++i) k1[i] = -k1[i];
  exponentials(n, k1);
  for (int i = 0; i < n; ++i) {
    k1[i] *= square;
    k2[i] = -k1[i];
    k3[i] = k1[i];
  }
}
)c"},
    {"slopes_matern52", R"c(static void slopes_matern52(int n, real square, real *pairs)
{
  real *const k1 = pairs, *const k2 = pairs + n, *const k3 = pairs + 2 * n;
  for (int i = 0; i < n; ++i) k3[i] = -sqrt(10 * k1[i]);
  for (int i = 0; i < n; ++i) k2[i] = -k3[i];
  exponentials(n, k3);
  for (int i = 0; i < n; ++i) {
    const real r = k2[i], e = square * k3[i];
    k1[i] = 5 * (1 + r) * e / 3;
    k2[i] = -25 * e / 3;
    k3[i] = r > 0 ? 125 * e / (3 * r) : 0;
  }
}
)c"},
    {"slopes_rq", R"c(static void slopes_rq(int n, real square, real alpha, real *pairs)
{
  real *const k1 = pairs, *const k2 = pairs + n, *const k3 = pairs + 2 * n;
  for (int i = 0; i < n; ++i) {
    const real base = 1 + k1[i] / alpha;
    k1[i] = square * exp(-(alpha + 1) * log(base));
    k2[i] = -(alpha + 1) / alpha * k1[i] / base;
    k3[i] = -(alpha + 2) / alpha * k2[i] / base;
  }
}
)c"},
    {"slopes_linear", R"c(static void slopes_linear(int n, real square, real *pairs)
{
  for (int i = 0; i < n; ++i) {
    pairs[i] = square;
    pairs[n + i] = pairs[2 * n + i] = 0;
  }
}
)c"},
    {"along_pairs", R"c(/* along_i = delta_i' scale weights_i */
static void along_pairs(int n, int d, const real *delta, const real *scale, const real *weights, real *along)
{
  for (int i = 0; i < n; ++i) along[i] = 0;
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) along[i] += delta[n * j + i] * weights[n * j + i] * scale[j];
  }
}
)c"},
    {"add_gradients", R"c(/* out (d) += the covariances times weights (n x d) */
static void add_gradients(int n, int d, const real *pairs, const real *scale, const real *weights, real *along, real *out)
{
  const real *const k1 = pairs, *const k2 = pairs + n, *const delta = pairs + 3 * n;
  along_pairs(n, d, delta, scale, weights, along);
  for (int j = 0; j < d; ++j) {
    real sums[LANES] = {0};
    for (int i = 0; i < n; i += LANES) {
      for (int e = i; e < i + LANES; ++e) {
        sums[e - i] += k1[e] * weights[n * j + e] * scale[j] + k2[e] * along[e] * delta[n * j + e];
      }
    }
    out[j] += scale[j] * total(sums);
  }
}
)c"},
    {"add_hessians", R"c(/* out (d x d) += the derivative of these sums in the features of the state */
static void add_hessians(int n, int d, const real *pairs, const real *scale, const real *weights, real *along, real *out)
{
  const real *const k2 = pairs + n, *const k3 = pairs + 2 * n, *const delta = pairs + 3 * n;
  along_pairs(n, d, delta, scale, weights, along);
  for (int j = 0; j < d; ++j) {
    for (int l = 0; l < d; ++l) {
      real sums[LANES] = {0};
      for (int i = 0; i < n; i += LANES) {
        for (int e = i; e < i + LANES; ++e) {
          sums[e - i] += k2[e] * (delta[n * j + e] * weights[n * l + e] * scale[l] + delta[n * l + e] * weights[n * j + e] * scale[j] +
              (j == l) * along[e]) + k3[e] * along[e] * delta[n * j + e] * delta[n * l + e];
        }
      }
      out[j + d * l] -= scale[j] * scale[l] * total(sums);
    }
  }
}
)c"},
    {"multiply_pairs", R"c(/* out (n x d) += the covariances times loading (d) */
static void multiply_pairs(int n, int d, const real *pairs, const real *scale, const real *loading, real *along, real *out)
{
  const real *const k1 = pairs, *const k2 = pairs + n, *const delta = pairs + 3 * n;
  for (int i = 0; i < n; ++i) along[i] = 0;
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) along[i] += delta[n * j + i] * (scale[j] * loading[j]);
  }
  for (int j = 0; j < d; ++j) {
    for (int i = 0; i < n; ++i) {
      out[n * j + i] += scale[j] * (k1[i] * scale[j] * loading[j] + k2[i] * along[i] * delta[n * j + i]);
    }
  }
}
)c"},
};

// It stands for the piece of this name in single precision.
inline constexpr Piece float_exponentials = {"exponentials", R"c(static void exponentials(int n, float *x)
{
  for (int i = 0; i < n; ++i) x[i] = expf(x[i]);
}
)c"};

}  // namespace gp2::c_export
