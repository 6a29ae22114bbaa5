#pragma once

#include "export/fill_template.hpp"

// Elementary functions in C that needs no library but for what IEEE 754 defines to the bit: sqrt, fabs, and frexp, ldexp, copysign,
// floor, which are exact. So all compilers and machines compute the same, where sums and products are not contracted. Their
// polynomials are those of Taylor. A function comes after those that it calls.
namespace gp2::c_export {

inline constexpr std::string_view portable_head =
    R"c(/* What is computed is the same to the bit wherever numbers are those of IEEE 754: nothing may be contracted into fused products or
 * kept with more digits, and functions are those below. */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off")
#else
#pragma STDC FP_CONTRACT OFF
#endif
#if defined(__FLT_EVAL_METHOD__) && __FLT_EVAL_METHOD__ != 0 && __FLT_EVAL_METHOD__ != 16
#error "@name@: this machine keeps more digits than a double has (on x86: -msse2 -mfpmath=sse)"
#endif

static int products_are_fused(void)
{
  const volatile double x = 1.0000000009313226; /* 1 + 2^-30, whose square is rounded to 1 + 2^-29 */
  const volatile float a = 1.00012207f;         /* 1 + 2^-13, to 1 + 2^-12 */
  const double y = x, z = x;
  const float b = a, c = a;
  return y * z - 1.0000000018626451 != 0 || b * c - 1.00024414f != 0;
}
)c";

inline constexpr Piece portable_pieces[] = {
    {"portable_exp", R"c(/* 2^m e^r with m = x / log 2 rounded */
static double portable_exp(double x)
{
  if (x != x) return x;
  if (x > 710) return HUGE_VAL;
  if (x < -746) return 0;
  const int m = (int)(x * 1.4426950408889634 + (x < 0 ? -0.5 : 0.5));
  const double high = x - m * 0.6931471804855391, low = m * 7.440617110012397e-11, r = high - low, rest = (high - r) - low;
  double p = 1.0 / 6227020800;
  p = p * r + 1.0 / 479001600;
  p = p * r + 1.0 / 39916800;
  p = p * r + 1.0 / 3628800;
  p = p * r + 1.0 / 362880;
  p = p * r + 1.0 / 40320;
  p = p * r + 1.0 / 5040;
  p = p * r + 1.0 / 720;
  p = p * r + 1.0 / 120;
  p = p * r + 1.0 / 24;
  p = p * r + 1.0 / 6;
  p = p * r + 1.0 / 2;
  return ldexp(1 + (r + (r * r * p + rest)), m);
}
)c"},
    {"mantissa", R"c(/* x = 2^k f with f between sqrt(1/2) and sqrt(2) */
static double mantissa(double x, int *k)
{
  const double f = frexp(x, k);
  if (f >= 0.7071067811865476) return f;
  --*k;
  return 2 * f;
}

/* 2/5 + 2/7 z + 2/9 z^2 + ... of 2 artanh s = 2 s + s^3 (2/3 + z (2/5 + ...)), z = s^2 */
static double artanh_series(double z)
{
  double p = 2.0 / 25;
  p = p * z + 2.0 / 23;
  p = p * z + 2.0 / 21;
  p = p * z + 2.0 / 19;
  p = p * z + 2.0 / 17;
  p = p * z + 2.0 / 15;
  p = p * z + 2.0 / 13;
  p = p * z + 2.0 / 11;
  p = p * z + 2.0 / 9;
  p = p * z + 2.0 / 7;
  p = p * z + 2.0 / 5;
  return p;
}
)c"},
    {"portable_log",
     R"c(/* k log 2 + log(1 + f), f between sqrt(1/2) - 1 and sqrt(2) - 1; log(1 + f) = 2 artanh s with s = f/(2 + f) */
static double portable_log(double x)
{
  int k;
  double f, s, z, p, half;
  if (x != x || x > 1.7976931348623157e308) return x;
  if (x == 0) return -HUGE_VAL;
  if (x < 0) return (x - x) / (x - x);
  f = mantissa(x, &k);
  f -= 1;
  s = f / (2 + f);
  z = s * s;
  p = artanh_series(z) * z + 2.0 / 3;
  half = f * f / 2;
  return k * 0.6931471804855391 + (f - (half - (s * (half + z * p) + k * 7.440617110012397e-11)));
}
)c"},
    {"portable_pow", R"c(/* a + b and a b as a double and what it leaves, both exact */
static double two_sum(double a, double b, double *rest)
{
  const double sum = a + b, of_b = sum - a;
  *rest = (a - (sum - of_b)) + (b - of_b);
  return sum;
}

static double two_product(double a, double b, double *rest)
{
  const double product = a * b, big_a = a * 134217729, big_b = b * 134217729; /* 2^27 + 1 */
  const double a1 = big_a - (big_a - a), a2 = a - a1, b1 = big_b - (big_b - b), b2 = b - b1;
  *rest = ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2;
  return product;
}

/* x^y of x > 0 as e^(y log x), log x = k log 2 + 2 s + 2 s^3/3 + ... with s = (f - 1)/(f + 1), to twice the digits */
static double power_of_positive(double x, double y)
{
  int k;
  double f, s, s_rest, below, below_rest, rest, z, z_rest, cube, cube_rest, sum, sum_rest, p;
  f = mantissa(x, &k);
  below = two_sum(f, 1, &below_rest);
  s = (f - 1) / below;
  z = two_product(s, below, &rest);
  s_rest = (((f - 1) - z) - rest - s * below_rest) / below;
  z = two_product(s, s, &rest);
  z_rest = rest + 2 * s * s_rest;
  p = artanh_series(z) * z; /* to 2/3, which no double is, what follows */
  z = two_sum(z, z_rest, &z_rest);
  cube = two_product(s, z, &rest);
  cube_rest = rest + s * z_rest + s_rest * z;
  p += 3.700743415417189e-17; /* 2/3 less its double */
  below = two_product(cube, 0.6666666666666666, &rest);
  rest += cube_rest * 0.6666666666666666 + cube * p;
  sum = two_sum(k * 0.6931471804855391, 2 * s, &sum_rest); /* that product is exact */
  sum = two_sum(sum, below, &z_rest);
  sum_rest += z_rest + rest + 2 * s_rest + k * 7.440617110012397e-11;
  sum = two_sum(sum, sum_rest, &sum_rest);
  if (!(fabs(y * sum) < 800)) return portable_exp(y * sum);
  p = two_product(y, sum, &rest);
  s = portable_exp(p);
  return s > 1.7976931348623157e308 ? s : s + s * (rest + y * sum_rest);
}

static double portable_pow(double x, double y)
{
  const double a = fabs(x), b = fabs(y), infinity = HUGE_VAL;
  const int is_whole = b >= 9007199254740992 || floor(y) == y, is_odd = is_whole && floor(y / 2) != y / 2;
  double power;
  if (x == 1 || y == 0) return 1;
  if (x != x || y != y) return x + y;
  if (x < 0 && a < infinity && !is_whole) return (x - x) / (x - x);
  if (a == 0 || !(a < infinity)) {
    power = (a == 0) == (y < 0) ? infinity : 0;
  } else if (a == 1) {
    power = 1;
  } else {
    power = power_of_positive(a, y);
  }
  return is_odd ? copysign(power, x) : power;
}
)c"},
    {"turned_by",
     R"c(/* x less a multiple of pi/2, as r + rest with |r| <= pi/4; returns the multiple modulo 4. Of |x| > 1e6 there is none: NaN. */
static int turned_by(double x, double *r, double *rest)
{
  double n, first, second, high, low;
  if (!(fabs(x) <= 1e6)) {
    *r = *rest = (x - x) / (x - x);
    return 0;
  }
  const int turns = (int)(x * 0.6366197723675814 + (x < 0 ? -0.5 : 0.5));
  n = turns;
  first = x - n * 1.5707963267341256; /* these products are exact */
  second = n * 6.077100506303966e-11;
  high = first - second;
  low = (first - high) - second - n * 2.0222662487959506e-21;
  *r = high + low;
  *rest = (high - *r) + low;
  return turns & 3;
}

static double sine_near_0(double r, double rest)
{
  const double z = r * r;
  double p = 1.0 / 355687428096000;
  p = p * z - 1.0 / 1307674368000;
  p = p * z + 1.0 / 6227020800;
  p = p * z - 1.0 / 39916800;
  p = p * z + 1.0 / 362880;
  p = p * z - 1.0 / 5040;
  p = p * z + 1.0 / 120;
  p = p * z - 1.0 / 6;
  return r + (r * z * p + rest * (1 - z / 2));
}

static double cosine_near_0(double r, double rest)
{
  const double z = r * r, one_less = 1 - z / 2;
  double p = 1.0 / 20922789888000;
  p = p * z - 1.0 / 87178291200;
  p = p * z + 1.0 / 479001600;
  p = p * z - 1.0 / 3628800;
  p = p * z + 1.0 / 40320;
  p = p * z - 1.0 / 720;
  p = p * z + 1.0 / 24;
  return one_less + ((1 - one_less - z / 2) + (z * z * p - r * rest));
}
)c"},
    {"portable_sin", R"c(static double portable_sin(double x)
{
  double r, rest;
  if (x == 0) return x; /* with its sign */
  const int turns = turned_by(x, &r, &rest);
  const double value = turns & 1 ? cosine_near_0(r, rest) : sine_near_0(r, rest);
  return turns & 2 ? -value : value;
}
)c"},
    {"portable_cos", R"c(static double portable_cos(double x)
{
  double r, rest;
  const int turns = turned_by(x, &r, &rest);
  const double value = turns & 1 ? sine_near_0(r, rest) : cosine_near_0(r, rest);
  return turns == 1 || turns == 2 ? -value : value;
}
)c"},
    {"portable_tan", R"c(static double portable_tan(double x)
{
  double r, rest;
  if (x == 0) return x; /* with its sign */
  const int turns = turned_by(x, &r, &rest);
  const double sine = sine_near_0(r, rest), cosine = cosine_near_0(r, rest);
  return turns & 1 ? -cosine / sine : sine / cosine;
}
)c"},
    {"portable_atan",
     R"c(/* arctan x = arctan c + arctan((x - c)/(1 + c x)), c the tangent of the nearest multiple of pi/8 */
static double portable_atan(double x)
{
  const double a = fabs(x);
  double angle = 0, rest = 0, t = a, z, p;
  if (a > 5.027339492125846) {
    angle = 1.5707963267948966, rest = 6.123233995736766e-17, t = -1 / a;
  } else if (a > 1.496605762665489) {
    angle = 1.1780972450961724, rest = 2.7563998718653792e-17, t = (a - 2.414213562373095) / (1 + 2.414213562373095 * a);
  } else if (a > 0.6681786379192989) {
    angle = 0.7853981633974483, rest = 3.061616997868383e-17, t = (a - 1) / (1 + a);
  } else if (a > 0.198912367379658) {
    angle = 0.39269908169872414, rest = 3.060132146563891e-18, t = (a - 0.41421356237309503) / (1 + 0.41421356237309503 * a);
  }
  z = t * t;
  p = 1.0 / 25;
  p = p * z - 1.0 / 23;
  p = p * z + 1.0 / 21;
  p = p * z - 1.0 / 19;
  p = p * z + 1.0 / 17;
  p = p * z - 1.0 / 15;
  p = p * z + 1.0 / 13;
  p = p * z - 1.0 / 11;
  p = p * z + 1.0 / 9;
  p = p * z - 1.0 / 7;
  p = p * z + 1.0 / 5;
  p = p * z - 1.0 / 3;
  return copysign(angle + (t + (t * z * p + rest)), x);
}
)c"},
    {"portable_atan2", R"c(static double portable_atan2(double y, double x)
{
  if (x != x || y != y) return x + y;
  const double a = fabs(x), b = fabs(y);
  const int is_diagonal = a == b; /* also of infinity or 0 */
  double angle = is_diagonal ? (a == 0 ? 0 : 0.7853981633974483) : a == 0 ? 1.5707963267948966 : portable_atan(b / a);
  if (copysign(1, x) < 0) angle = 3.141592653589793 - (angle - 1.2246467991473532e-16);
  return copysign(angle, y);
}
)c"},
    {"portable_asin", R"c(static double portable_asin(double x)
{
  return portable_atan2(x, sqrt((1 - x) * (1 + x)));
}
)c"},
    {"portable_acos", R"c(static double portable_acos(double x)
{
  return 2 * portable_atan2(sqrt(1 - x), sqrt(1 + x));
}
)c"},
    {"portable_sinh", R"c(static double portable_sinh(double x)
{
  const double z = x * x, a = fabs(x);
  if (a > 1) {
    const double half = portable_exp(a / 2), e = portable_exp(a);
    return copysign(a > 40 ? half / 2 * half : (e - 1 / e) / 2, x);
  }
  double p = 1.0 / 355687428096000;
  p = p * z + 1.0 / 1307674368000;
  p = p * z + 1.0 / 6227020800;
  p = p * z + 1.0 / 39916800;
  p = p * z + 1.0 / 362880;
  p = p * z + 1.0 / 5040;
  p = p * z + 1.0 / 120;
  p = p * z + 1.0 / 6;
  return x + x * z * p;
}
)c"},
    {"portable_cosh", R"c(static double portable_cosh(double x)
{
  const double half = portable_exp(fabs(x) / 2), e = portable_exp(fabs(x));
  return fabs(x) > 40 ? half / 2 * half : (e + 1 / e) / 2;
}
)c"},
    {"portable_tanh", R"c(static double portable_tanh(double x)
{
  if (fabs(x) <= 1) return portable_sinh(x) / portable_cosh(x);
  return copysign(1 - 2 / (portable_exp(2 * fabs(x)) + 1), x);
}
)c"},
};

}  // namespace gp2::c_export
