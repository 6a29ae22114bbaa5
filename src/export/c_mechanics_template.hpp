#pragma once

#include <string_view>

// The first half of NAME.c: declarations, the system, and its projection onto the constraints. The form is that of
// fill_template.hpp, the conditions are those of c_writer.cpp.
namespace gp2::c_export {

inline constexpr std::string_view mechanics_template = R"c(/* @title@ See @name@.h. */
#include "@name@.h"

#include <math.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "@name@: compile without -ffast-math and -ffinite-math-only, which take NaN and infinity away"
#endif

typedef @name@_real real;
typedef @name@_status status;
typedef @name@_workspace workspace;

@portable@
enum {
  NQ = @nq@, /* coordinates */
{rows}  NC = @nc@, /* constraints */
{rows}  NMIN = @nmin@, /* the smaller of both */
  NX = @n_state@, /* entries of a state */
  NR = @n_rows@, /* rows of the view */
{mixture}  COMPONENTS = @n_components@, /* of the mixture */
{stddev}  VARIABLES = @n_variables@, /* that the observations are known by, rounded up to whole LANES */
{stddev}  COLUMNS = @n_columns@, /* of their covariance with the prediction */
  LANES = 8 /* points that are worked on together */
};

/* ---------------------------------------------------------------- what was learned */

/* A latent function, or several with one kernel, at the points that it is known by. Matrices stand column by column. */
typedef struct {
  int n;               /* points, rounded up to whole LANES */
  const real *points;  /* their features (n x features) */
  const real *scale;   /* what each factor of the kernel multiplies them by */
  const real *kernel;  /* parameters of the kernel */
  const real *weights; /* of the points in the mean (n x directions) */
{stddev}  const real *loading; /* of the functions in the directions (directions x functions) */
{stddev}  const real *rows;    /* of the functions in the observations (n x components functions) */
} latent;

typedef struct {
  const real *parameters; /* of the system: @parameters@ */
  latent latents[@n_latents@];
{stddev}  int n_variables, n_row_components;
{stddev}  const @index@ *row_of;  /* which row is component r of point j: row_of[j + n r], -1: none */
{stddev,factor}  const real *triangle;   /* L, L L' the covariance of the observations, by rows, each in whole LANES; 1/L_ii for L_ii */
{stddev,!factor}  const real *triangle;   /* X, X'X what the observations explain, by rows, each in whole LANES */
{sums}  const int *sum_begin;     /* observations are sums of rows: their entries, */
{sums}  const int *sum_column;
{sums}  const real *sum_value;
} component;

@tables@
/* ---------------------------------------------------------------- expressions of the model */
@helpers@
@expressions@
/* ---------------------------------------------------------------- mechanics */

static int is_finite(int n, const real *x)
{
  real sum = 0; /* 0 x is 0 of a finite number only */
  for (int i = 0; i < n; ++i) sum += 0 * x[i];
  return sum == 0;
}
{if rows}

static real dot(int n, const real *a, const real *b)
{
  real sum = 0;
  for (int i = 0; i < n; ++i) sum += a[i] * b[i];
  return sum;
}
{end}

/* M = C C', from the lower triangle of M to C in its place. Returns the smallest squared pivot as a fraction of its diagonal
 * entry; 0 where one is lost to rounding, or negative. */
static real factorise(real *M)
{
  real smallest = 1;
  for (int k = 0; k < NQ; ++k) {
    const real diagonal = M[k + NQ * k];
    real square = diagonal;
    for (int j = 0; j < k; ++j) square -= M[k + NQ * j] * M[k + NQ * j];
    if (!(square > @lost_pivot@ * fabs(diagonal))) return 0;
    if (square / diagonal < smallest) smallest = square / diagonal;
    const real pivot = sqrt(square), scale = 1 / pivot;
    M[k + NQ * k] = pivot;
    for (int i = k + 1; i < NQ; ++i) {
      real entry = M[i + NQ * k];
      for (int j = 0; j < k; ++j) entry -= M[k + NQ * j] * M[i + NQ * j];
      M[i + NQ * k] = entry * scale;
    }
  }
  return smallest;
}

/* Whether M is positive semidefinite to rounding: each coordinate in units of its diagonal entry, the largest pivot is eliminated
 * next; what is left of a semidefinite matrix where none is above rounding is itself rounding. */
static int is_semidefinite(const real *M, real *rest)
{
  const real rounding = @semidefinite@;
  for (int i = 0; i < NQ * NQ; ++i) rest[i] = M[i];
  for (int step = 0; step < NQ; ++step) {
    int pivot = -1;
    real largest = rounding;
    for (int j = 0; j < NQ; ++j) {
      if (!(rest[j + NQ * j] > largest * M[j + NQ * j])) continue;
      largest = rest[j + NQ * j] / M[j + NQ * j];
      pivot = j;
    }
    if (pivot < 0) break;
    for (int j = 0; j < NQ; ++j) {
      if (j == pivot) continue;
      const real factor = rest[pivot + NQ * j] / rest[pivot + NQ * pivot];
      for (int i = 0; i < NQ; ++i) {
        if (i != pivot) rest[i + NQ * j] -= rest[i + NQ * pivot] * factor;
      }
    }
    for (int j = 0; j < NQ; ++j) {
      rest[pivot + NQ * j] = 0;
      rest[j + NQ * pivot] = 0;
    }
  }
  for (int j = 0; j < NQ; ++j) {
    for (int i = 0; i < NQ; ++i) {
      /* there is no root, and no order, where a diagonal entry is negative */
      if (!(fabs(rest[i + NQ * j]) <= rounding * sqrt(M[i + NQ * i]) * sqrt(M[j + NQ * j]))) return 0;
    }
  }
  return 1;
}
{if rows}

static int weigh_row(const real *A, int k, int by_mass, const real *weight, real *sigma)
{
  real sum = 0;
  for (int j = 0; j < NQ; ++j) {
    const real entry = A[k + NC * j];
    if (!by_mass || weight[j] > 0) sum += entry * entry / (by_mass ? weight[j] : 1);
  }
  if (sum > 0) sigma[k] = 1 / sum;
  return sum > 0;
}

/* sigma_k = 1/(A_k diag(weight)^-1 A_k'), weight_j = M_jj. A massless coordinate has the weight that rows weighed before it lend;
 * rows that nothing ties to a mass come last, one of them to set their scale. */
static void weigh_rows(const real *M, const real *A, real *weight, real *sigma)
{
  for (int j = 0; j < NQ; ++j) weight[j] = M[j + NQ * j];
  for (int k = 0; k < NC; ++k) sigma[k] = 0;
  for (int pass = 0; pass < NC; ++pass) {
    int some = 0;
    for (int k = 0; k < NC; ++k) {
      if (sigma[k] == 0 && weigh_row(A, k, 1, weight, sigma)) some = 1;
    }
    for (int k = 0; !some && k < NC; ++k) {
      if (sigma[k] == 0) some = weigh_row(A, k, 0, weight, sigma);
    }
    if (!some) return;
    for (int j = 0; j < NQ; ++j) {
      if (weight[j] > 0) continue;
      for (int k = 0; k < NC; ++k) weight[j] += sigma[k] * A[k + NC * j] * A[k + NC * j];
    }
  }
}
{end}

/* What M is: positive definite, with its factor C; or singular but completed by the constraints, M + A' Sigma A, which stands for
 * M then (Udwadia & Phohomsiri 2006). M ddq = F + A' lambda and A ddq = b have the same solution ddq. */
static status factorise_mass(workspace *w)
{
  w->pivot = 0;
  w->is_singular = 0;
  for (int i = 0; i < NQ * NQ; ++i) w->mass[i] = w->C[i] = w->M[i];
  const real pivot = factorise(w->C);
  w->pivot = pivot;
  if (pivot > @singular@) return @name@_OK;
  const int semidefinite = is_semidefinite(w->M, w->T);
{if rows}
  if (semidefinite) {
    weigh_rows(w->M, w->A, w->weight, w->sigma);
    for (int k = 0; k < NC; ++k) {
      for (int j = 0; j < NQ; ++j) {
        for (int i = 0; i < NQ; ++i) w->mass[i + NQ * j] += w->sigma[k] * (w->A[k + NC * i] * w->A[k + NC * j]);
      }
    }
    for (int i = 0; i < NQ * NQ; ++i) w->C[i] = w->mass[i];
    w->pivot = factorise(w->C);
    if (w->pivot > @singular@) {
      w->is_singular = 1;
      return @name@_@if_singular@;
    }
  }
{end}
  if (pivot > 0) { /* ill-conditioned, and the constraints do not help */
    for (int i = 0; i < NQ * NQ; ++i) w->mass[i] = w->C[i] = w->M[i];
    w->pivot = factorise(w->C);
    return @name@_OK;
  }
  return semidefinite ? @name@_MOTION_UNDETERMINED : @name@_MASS_NOT_POSITIVE_DEFINITE;
}
{if solves}

/* X := C^-1 X, n columns */
static void solve_lower(const real *C, int n, real *X)
{
  for (int j = 0; j < n; ++j) {
    real *const x = X + NQ * j;
    for (int k = 0; k < NQ; ++k) {
      x[k] *= 1 / C[k + NQ * k];
      for (int i = k + 1; i < NQ; ++i) x[i] -= C[i + NQ * k] * x[k];
    }
  }
}

/* X := C'^-1 X */
static void solve_upper(const real *C, int n, real *X)
{
  for (int j = 0; j < n; ++j) {
    real *const x = X + NQ * j;
    for (int k = NQ - 1; k >= 0; --k) {
      real sum = 0;
      for (int i = k + 1; i < NQ; ++i) sum += C[i + NQ * k] * x[i];
      x[k] = (x[k] - sum) * (1 / C[k + NQ * k]);
    }
  }
}
{end}
{if forced_solves}

/* X := M^-1 X */
static void solve_mass(const real *C, int n, real *X)
{
  solve_lower(C, n, X);
  solve_upper(C, n, X);
}
{end}
{if rows}

/* x := (I - tau v v') x, v = [1; tail] of `size` entries */
static void reflect(const real *tail, real tau, int size, real *x)
{
  const real projection = tau * (x[0] + dot(size - 1, tail, x + 1));
  x[0] -= projection;
  for (int i = 1; i < size; ++i) x[i] -= projection * tail[i - 1];
}

/* W P = Q R by Householder reflections with column pivoting, W (d x n): R on and above the diagonal, the reflectors below, their
 * factors in tau; column k of W P is column order[k] of W. It ends where the longest column that is left is no longer than
 * tolerance times the first. Returns the rank. */
static int pivoted_qr(int d, int n, real *W, real *tau, int *order, real tolerance)
{
  const int most = d < n ? d : n;
  real smallest_pivot = 0;
  for (int j = 0; j < n; ++j) order[j] = j;
  for (int k = 0; k < most; ++k) {
    int longest = k;
    real square = -1;
    for (int j = k; j < n; ++j) {
      const real candidate = dot(d - k, W + d * j + k, W + d * j + k);
      if (candidate > (1 + @tie@) * square) { /* of equal ones the first */
        square = candidate;
        longest = j;
      }
    }
    const real length = square > 0 ? sqrt(square) : 0;
    if (k == 0) smallest_pivot = tolerance * length;
    if (!(length > smallest_pivot)) return k;
    if (longest != k) {
      for (int i = 0; i < d; ++i) {
        const real entry = W[i + d * k];
        W[i + d * k] = W[i + d * longest];
        W[i + d * longest] = entry;
      }
      const int column = order[k];
      order[k] = order[longest];
      order[longest] = column;
    }
    real *const x = W + d * k;
    real below = 0;
    for (int i = k + 1; i < d; ++i) {
      if (fabs(x[i]) > below) below = fabs(x[i]);
    }
    tau[k] = 0;
    if (below == 0) continue;
    const real beta = x[k] > 0 ? -length : length, scale = 1 / (x[k] - beta);
    tau[k] = (beta - x[k]) / beta;
    x[k] = beta;
    for (int i = k + 1; i < d; ++i) x[i] *= scale;
    for (int j = k + 1; j < n; ++j) reflect(x + k + 1, tau[k], d - k, W + d * j + k);
  }
  return most;
}

/* X := Q' X, n columns of d */
static void apply_Q_transposed(int d, const real *W, const real *tau, int rank, int n, real *X)
{
  for (int k = 0; k < rank; ++k) {
    for (int j = 0; j < n; ++j) reflect(W + d * k + k + 1, tau[k], d - k, X + d * j + k);
  }
}

/* X := Q X */
static void apply_Q(int d, const real *W, const real *tau, int rank, int n, real *X)
{
  for (int k = rank - 1; k >= 0; --k) {
    for (int j = 0; j < n; ++j) reflect(W + d * k + k + 1, tau[k], d - k, X + d * j + k);
  }
}

/* B' = C^-1 A', its columns scaled to unit length; rows of A that vanish are dropped */
static void scale_rows(workspace *w)
{
  w->n_zero_rows = 0;
  for (int k = 0; k < NC; ++k) {
    for (int i = 0; i < NQ; ++i) w->B[i + NQ * k] = w->A[k + NC * i];
  }
  solve_lower(w->C, NC, w->B);
  for (int k = 0; k < NC; ++k) {
    real *const row = w->B + NQ * k;
    real norm = sqrt(dot(NQ, row, row));
    if (!(norm > @small_norm@ && norm < @large_norm@)) { /* squares of such entries are no numbers */
      real largest = 0, sum = 0;
      for (int i = 0; i < NQ; ++i) {
        if (fabs(row[i]) > largest) largest = fabs(row[i]);
      }
      for (int i = 0; largest > 0 && i < NQ; ++i) sum += row[i] / largest * (row[i] / largest);
      norm = largest * sqrt(sum);
    }
    const real scale = norm < @smallest_row@ ? 0 : 1 / norm;
    if (scale == 0) ++w->n_zero_rows;
    w->row_scale[k] = scale;
    w->b_unit[k] = w->b[k] * scale;
    for (int i = 0; i < NQ; ++i) {
      row[i] *= scale;
      w->A_unit[k + NC * i] = w->A[k + NC * i] * scale;
    }
  }
}

/* (R')^+ P' to the first rows of L, which are zero */
static void invert_R_transposed(workspace *w)
{
  const int rank = w->rank;
  if (rank == NC) { /* a lower triangle, by columns */
    for (int j = 0; j < NC; ++j) {
      real *const x = w->L + NQ * w->order[j];
      for (int i = j; i < NC; ++i) {
        const real sum = dot(i - j, w->B + NQ * i + j, x + j);
        x[i] = ((i == j ? 1 : 0) - sum) / w->B[i + NQ * i];
      }
    }
    return;
  }
{end}
{if several}
  /* R' P2 = Q2 R2 is (NC x rank), of full rank: (R')^+ = P2 R2^-1 Q2' */
  for (int i = 0; i < rank; ++i) {
    for (int j = 0; j < NC; ++j) w->R[j + NC * i] = j < i ? 0 : w->B[i + NQ * j];
  }
  pivoted_qr(NC, rank, w->R, w->tau2, w->order2, 0);
  for (int j = 0; j < NC; ++j) {
    real *const e = w->residual;
    for (int i = 0; i < NC; ++i) e[i] = i == j;
    apply_Q_transposed(NC, w->R, w->tau2, rank, 1, e);
    for (int i = rank - 1; i >= 0; --i) {
      const real value = e[i] / w->R[i + NC * i];
      for (int l = 0; l < i; ++l) e[l] -= value * w->R[l + NC * i];
      w->L[w->order2[i] + NQ * w->order[j]] = value;
    }
  }
{end}
{if rows}
}

/* T and L of rows of unit length from B' P = [Y Z] [R; 0]: Y spans range(B'), Z its complement, T = C'^-1 Z Z' C',
 * L = C'^-1 Y (R')^+ P'. */
static void decompose_rows(workspace *w)
{
  w->rank = pivoted_qr(NQ, NC, w->B, w->tau, w->order, @rank_tolerance@);
{redundant}  w->is_off_constraints = w->rank > @largest_rank@; /* where redundant rows seem to be independent */
{redundant}  if (w->is_off_constraints) w->rank = @largest_rank@;
  for (int i = 0; i < NQ * NC; ++i) w->L[i] = 0;
  if (w->rank == 0) { /* nothing constrains the motion */
    for (int i = 0; i < NQ * NQ; ++i) w->T[i] = i % (NQ + 1) == 0;
    return;
  }
  for (int j = 0; j < NQ; ++j) {
    for (int i = 0; i < NQ; ++i) w->T[i + NQ * j] = i <= j ? w->C[j + NQ * i] : 0;
  }
  apply_Q_transposed(NQ, w->B, w->tau, w->rank, NQ, w->T);
  for (int j = 0; j < NQ; ++j) {
    for (int i = 0; i < w->rank; ++i) w->T[i + NQ * j] = 0;
  }
  apply_Q(NQ, w->B, w->tau, w->rank, NQ, w->T);
  invert_R_transposed(w);
  apply_Q(NQ, w->B, w->tau, w->rank, NC, w->L);
  solve_upper(w->C, NQ, w->T);
  solve_upper(w->C, NC, w->L);
}

/* Whether no acceleration satisfies A ddq = b: A L b is off b by more than rounding of what accelerates the system, b and F. */
static int is_contradictory(workspace *w)
{
  real inconsistency = 0, size_of_b = 0, size_of_force = 0;
  for (int k = 0; k < NC; ++k) {
    real off = w->b_unit[k];
    for (int i = 0; i < NQ; ++i) off -= w->A_unit[k + NC * i] * w->Lb[i];
{redundant}    if (w->rank == @largest_rank@) off = 0; /* redundant rows are off b by the error of the state */
    off = fabs(w->row_scale[k] == 0 ? w->b[k] : off);
    if (off > inconsistency) inconsistency = off;
    if (fabs(w->b_unit[k]) > size_of_b) size_of_b = fabs(w->b_unit[k]);
  }
  if (!(inconsistency > @consistency@ * size_of_b && inconsistency > @smallest_row@)) return 0;
  for (int i = 0; i < NQ; ++i) {
    const real size = fabs(w->F[i]) / sqrt(w->mass[i + NQ * i]);
    if (is_finite(1, &w->F[i]) && size > size_of_force) size_of_force = size;
  }
  return inconsistency > @consistency@ * size_of_force;
}
{end}

/* The Udwadia-Kalaba equation at a state, ddq = L b + T abar with L = M^-1 A' (A M^-1 A')^+ and T = I - L A. */
static status project(workspace *w)
{
  if (!is_finite(NQ * NQ, w->M)) return @name@_NOT_FINITE;
{rows}  if (!is_finite(NC * NQ, w->A) || !is_finite(NC, w->b)) return @name@_NOT_FINITE;
{!rows}  return factorise_mass(w);
{if rows}
  const status of_mass = factorise_mass(w);
  if (of_mass != @name@_OK) return of_mass;
  scale_rows(w);
  decompose_rows(w);
  if (w->pivot < @well_conditioned@) { /* takes away what A still sees of T */
    for (int j = 0; j < NQ; ++j) {
      for (int k = 0; k < NC; ++k) {
        w->residual[k] = 0;
        for (int i = 0; i < NQ; ++i) w->residual[k] += w->A_unit[k + NC * i] * w->T[i + NQ * j];
      }
      for (int i = 0; i < NQ; ++i) {
        for (int k = 0; k < NC; ++k) w->T[i + NQ * j] -= w->L[i + NQ * k] * w->residual[k];
      }
    }
  }
  for (int i = 0; i < NQ; ++i) {
    w->Lb[i] = 0;
    for (int k = 0; k < NC; ++k) w->Lb[i] += w->L[i + NQ * k] * w->b_unit[k];
  }
  return is_contradictory(w) ? @name@_CONTRADICTING_CONSTRAINTS : @name@_OK;
{end}
}
{if admissible}

/* P = I - W A' (A W A')^+ A with W = diag(@admissible@)^2, and the L of it: what `project` makes of the mass matrix W^-1 */
static void project_admissible(workspace *w)
{
  for (int i = 0; i < NQ * NQ; ++i) {
    w->stated_M[i] = w->M[i];
    w->M[i] = i % (NQ + 1) == 0 ? 1 / (@admissible@[i / NQ] * @admissible@[i / NQ]) : 0;
  }
  (void)project(w); /* it tells of A and b again when M is back */
  for (int i = 0; i < NQ * NQ; ++i) {
    w->P[i] = w->T[i];
    w->M[i] = w->stated_M[i];
  }
  for (int i = 0; i < NQ * NC; ++i) w->L_P[i] = w->L[i] * w->row_scale[i / NQ];
}
{end}
{if rows,moved}

/* ddq = L b + T abar, with one step of refinement onto A ddq = b */
static void constrain(workspace *w)
{
  for (int i = 0; i < NQ; ++i) {
{all}    real sum = @of_whole@w->Lb[i];
{!all}    real sum = 0;
    for (int j = 0; j < NQ; ++j) sum += w->T[i + NQ * j] * w->a_bar[j];
    w->a[i] = sum;
  }
{if all}
{redundant}  if (w->is_off_constraints) return; /* the residual is the error of the state */
  for (int k = 0; k < NC; ++k) {
    real sum = @of_whole@w->b_unit[k];
    for (int i = 0; i < NQ; ++i) sum -= w->A_unit[k + NC * i] * w->a[i];
    w->residual[k] = sum;
  }
  for (int i = 0; i < NQ; ++i) {
    for (int k = 0; k < NC; ++k) w->a[i] += w->L[i + NQ * k] * w->residual[k];
  }
{end}
}
{end}
{if least_norm}

/* K, of which lambda = K A' lambda: of redundant rows the multipliers of least norm */
static void multipliers_of_force(workspace *w)
{
  for (int j = 0; j < NQ; ++j) {
    for (int k = 0; k < NC; ++k) w->K[k + NC * j] = w->row_scale[k] * w->L[j + NQ * k];
  }
{if several}
  const int rank = w->rank, n_redundant = NC - w->n_zero_rows - rank, n = NC - rank;
  if (n_redundant == 0 || rank == 0) return;
  /* takes away what lies in the null space of A': of unit rows it is spanned by the last columns of Q2 */
  for (int i = 0; i < NC * n; ++i) w->null_space[i] = i == rank + i / NC * (NC + 1);
  apply_Q(NC, w->R, w->tau2, rank, n, w->null_space);
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < NC; ++i) {
      w->null_rows[w->order[i] + NC * j] = w->row_scale[w->order[i]] * w->null_space[i + NC * j];
    }
  }
  pivoted_qr(NC, n, w->null_rows, w->null_tau, w->null_order, 0);
  apply_Q_transposed(NC, w->null_rows, w->null_tau, n_redundant, NQ, w->K);
  for (int j = 0; j < NQ; ++j) {
    for (int k = 0; k < n_redundant; ++k) w->K[k + NC * j] = 0;
  }
  apply_Q(NC, w->null_rows, w->null_tau, n_redundant, NQ, w->K);
{end}
}
{end}
{if load}

/* lambda0, the multipliers under the known force, M a0 = F + A' lambda0 with A a0 = b; x is the state and lambda0 */
static void known_multipliers(const real *state, workspace *w)
{
  real without[NQ], force[NQ];
  for (int i = 0; i < NQ; ++i) without[i] = w->F[i];
  solve_mass(w->C, 1, without);
  for (int i = 0; i < NQ; ++i) {
    w->a0[i] = w->Lb[i];
    for (int j = 0; j < NQ; ++j) w->a0[i] += w->T[i + NQ * j] * without[j];
  }
  for (int k = 0; k < NC; ++k) {
    w->residual[k] = w->b_unit[k];
    for (int i = 0; i < NQ; ++i) w->residual[k] -= w->A_unit[k + NC * i] * w->a0[i];
  }
  for (int i = 0; i < NQ; ++i) {
    for (int k = 0; k < NC; ++k) w->a0[i] += w->L[i + NQ * k] * w->residual[k];
  }
  for (int i = 0; i < NQ; ++i) {
    force[i] = -w->F[i];
    for (int j = 0; j < NQ; ++j) force[i] += w->M[i + NQ * j] * w->a0[j];
  }
  multipliers_of_force(w);
  for (int i = 0; i < NX; ++i) w->x[i] = state[i];
  for (int k = 0; k < NC; ++k) {
    w->x[NX + k] = 0;
    for (int i = 0; i < NQ; ++i) w->x[NX + k] += w->K[k + NC * i] * force[i];
  }
}
{end}

)c";

}  // namespace gp2::c_export
