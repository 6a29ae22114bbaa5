#pragma once

#include <string_view>

// The exported C as text. @name@ stands for what c_source.cpp fills in; a line behind {a,b} is there where the model has a and b,
// behind {!a} where it has no a:
//
//     rows, several       constraints; more than one
//     forced              something is multiplied by M^-1: mu, or a latent (forced_latent)
//     moved               the view is of ddq or of the force of constraints
//     reaction            it is of the force of constraints, or its multipliers (multipliers)
//     abar                it is of abar
//     applied             it is of the learned force
//     all                 mu and b are part of it: it is not of one latent alone
//     known, constant     mu = M^-1 F; mu is constant
//     load, nonlinear     a latent reads lambda0; lambda. Either: loaded; multipliers or these: least_norm
//     solves              triangular systems of M are solved; of M itself (forced_solves)
//     potential, other    a latent is a potential; one is not
//     stddev, jacobian    these functions are asked for
//     mixture             there are several components
//     by_function         covariances are kept by latent functions, which are fewer than the rows of the view
//     sums                observations are sums of rows
//     portable            functions are its own
namespace gp2::c_export {

inline constexpr std::string_view header_template = R"c(/* @title@
 *
@about@
 *
 * A state is @name@_STATE_SIZE numbers:
@state@
 * The prediction is @name@_ROWS numbers:
@view@
 *
 * The functions allocate nothing and keep nothing: whoever calls from several threads gives each a workspace of its own.
 * They must not be compiled with options that let the compiler assume finite numbers (-ffast-math).
 */
#ifndef @guard@
#define @guard@

#ifdef __cplusplus
extern "C" {
#endif

typedef @real@ @name@_real;

enum {
  @name@_STATE_SIZE = @n_state@,
  @name@_ROWS = @n_rows@
};

/* What a state is like. Where it is not @name@_OK the numbers are NaN. */
typedef enum {
  @name@_OK = 0,
  @name@_MASS_NOT_POSITIVE_DEFINITE,    /* nor semidefinite */
  @name@_MOTION_UNDETERMINED,           /* M is singular, and the constraints leave a direction free in which nothing acts */
  @name@_NO_UNCONSTRAINED_ACCELERATION, /* M is singular, and the prediction is of the acceleration without constraints */
  @name@_CONTRADICTING_CONSTRAINTS,     /* no acceleration satisfies A ddq = b */
  @name@_NOT_FINITE                     /* an entry of the state that is read, or what the model makes of it */
} @name@_status;

/* Scratch memory of the functions below; its contents are theirs alone. */
typedef struct {
@workspace@
} @name@_workspace;

/* The expected value.
 *   state  [@name@_STATE_SIZE]
 *   mean   [@name@_ROWS] */
@name@_status @name@_mean(const @name@_real *state, @name@_real *mean, @name@_workspace *w);
{stddev}
{stddev}/* And the standard deviation of each row, of the true value and not of its next measurement.
{stddev} *   stddev  [@name@_ROWS] */
{stddev}@name@_status @name@_mean_and_stddev(const @name@_real *state, @name@_real *mean, @name@_real *stddev,
{stddev}    @name@_workspace *w);
{jacobian}
{jacobian}/* And the derivative of the mean in the state.
{jacobian} *   jacobian  [@name@_ROWS * @name@_STATE_SIZE], column by column: jacobian[r + @name@_ROWS * k] = d mean[r] / d state[k] */
{jacobian}@name@_status @name@_mean_and_jacobian(const @name@_real *state, @name@_real *mean, @name@_real *jacobian,
{jacobian}    @name@_workspace *w);

/* Predicts at states whose predictions are stored with the model. Returns 0 where they agree, else the number of the first that
 * does not. */
{portable}/* -1: the compiler has fused products, so that the bits are not those of other machines. */
int @name@_self_test(@name@_workspace *w);

#ifdef __cplusplus
}
#endif

#endif
)c";

// declarations, the system, and its projection onto the constraints
inline constexpr std::string_view mechanics_template = R"c(/* @title@ See @name@.h. */
#include "@name@.h"

#include <math.h>

#ifdef __FAST_MATH__
#error "@name@: compile without -ffast-math, which takes NaN and infinity away"
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
{stddev}  const real *inverse;    /* L^-1, L L' the covariance of the observations: a triangle by rows, each in whole LANES */
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
{rows}
{rows}static real dot(int n, const real *a, const real *b)
{rows}{
{rows}  real sum = 0;
{rows}  for (int i = 0; i < n; ++i) sum += a[i] * b[i];
{rows}  return sum;
{rows}}

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
{rows}
{rows}static int weigh_row(const real *A, int k, int by_mass, const real *weight, real *sigma)
{rows}{
{rows}  real sum = 0;
{rows}  for (int j = 0; j < NQ; ++j) {
{rows}    const real entry = A[k + NC * j];
{rows}    if (!by_mass || weight[j] > 0) sum += entry * entry / (by_mass ? weight[j] : 1);
{rows}  }
{rows}  if (sum > 0) sigma[k] = 1 / sum;
{rows}  return sum > 0;
{rows}}
{rows}
{rows}/* sigma_k = 1/(A_k diag(weight)^-1 A_k'), weight_j = M_jj. A massless coordinate has the weight that rows weighed before it lend;
{rows} * rows that nothing ties to a mass come last, one of them to set their scale. */
{rows}static void weigh_rows(const real *M, const real *A, real *weight, real *sigma)
{rows}{
{rows}  for (int j = 0; j < NQ; ++j) weight[j] = M[j + NQ * j];
{rows}  for (int k = 0; k < NC; ++k) sigma[k] = 0;
{rows}  for (int pass = 0; pass < NC; ++pass) {
{rows}    int some = 0;
{rows}    for (int k = 0; k < NC; ++k) {
{rows}      if (sigma[k] == 0 && weigh_row(A, k, 1, weight, sigma)) some = 1;
{rows}    }
{rows}    for (int k = 0; !some && k < NC; ++k) {
{rows}      if (sigma[k] == 0) some = weigh_row(A, k, 0, weight, sigma);
{rows}    }
{rows}    if (!some) return;
{rows}    for (int j = 0; j < NQ; ++j) {
{rows}      if (weight[j] > 0) continue;
{rows}      for (int k = 0; k < NC; ++k) weight[j] += sigma[k] * A[k + NC * j] * A[k + NC * j];
{rows}    }
{rows}  }
{rows}}

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
{rows}  if (semidefinite) {
{rows}    weigh_rows(w->M, w->A, w->weight, w->sigma);
{rows}    for (int k = 0; k < NC; ++k) {
{rows}      for (int j = 0; j < NQ; ++j) {
{rows}        for (int i = 0; i < NQ; ++i) w->mass[i + NQ * j] += w->sigma[k] * (w->A[k + NC * i] * w->A[k + NC * j]);
{rows}      }
{rows}    }
{rows}    for (int i = 0; i < NQ * NQ; ++i) w->C[i] = w->mass[i];
{rows}    w->pivot = factorise(w->C);
{rows}    if (w->pivot > @singular@) {
{rows}      w->is_singular = 1;
{rows}      return @name@_@if_singular@;
{rows}    }
{rows}  }
  if (pivot > 0) { /* ill-conditioned, and the constraints do not help */
    for (int i = 0; i < NQ * NQ; ++i) w->mass[i] = w->C[i] = w->M[i];
    w->pivot = factorise(w->C);
    return @name@_OK;
  }
  return semidefinite ? @name@_MOTION_UNDETERMINED : @name@_MASS_NOT_POSITIVE_DEFINITE;
}
{solves}
{solves}/* X := C^-1 X, n columns */
{solves}static void solve_lower(const real *C, int n, real *X)
{solves}{
{solves}  for (int j = 0; j < n; ++j) {
{solves}    real *const x = X + NQ * j;
{solves}    for (int k = 0; k < NQ; ++k) {
{solves}      x[k] *= 1 / C[k + NQ * k];
{solves}      for (int i = k + 1; i < NQ; ++i) x[i] -= C[i + NQ * k] * x[k];
{solves}    }
{solves}  }
{solves}}
{solves}
{solves}/* X := C'^-1 X */
{solves}static void solve_upper(const real *C, int n, real *X)
{solves}{
{solves}  for (int j = 0; j < n; ++j) {
{solves}    real *const x = X + NQ * j;
{solves}    for (int k = NQ - 1; k >= 0; --k) {
{solves}      real sum = 0;
{solves}      for (int i = k + 1; i < NQ; ++i) sum += C[i + NQ * k] * x[i];
{solves}      x[k] = (x[k] - sum) * (1 / C[k + NQ * k]);
{solves}    }
{solves}  }
{solves}}
{forced_solves}
{forced_solves}/* X := M^-1 X */
{forced_solves}static void solve_mass(const real *C, int n, real *X)
{forced_solves}{
{forced_solves}  solve_lower(C, n, X);
{forced_solves}  solve_upper(C, n, X);
{forced_solves}}
{rows}
{rows}/* x := (I - tau v v') x, v = [1; tail] of `size` entries */
{rows}static void reflect(const real *tail, real tau, int size, real *x)
{rows}{
{rows}  const real projection = tau * (x[0] + dot(size - 1, tail, x + 1));
{rows}  x[0] -= projection;
{rows}  for (int i = 1; i < size; ++i) x[i] -= projection * tail[i - 1];
{rows}}
{rows}
{rows}/* W P = Q R by Householder reflections with column pivoting, W (d x n): R on and above the diagonal, the reflectors below, their
{rows} * factors in tau; column k of W P is column order[k] of W. It ends where the longest column that is left is no longer than
{rows} * tolerance times the first. Returns the rank. */
{rows}static int pivoted_qr(int d, int n, real *W, real *tau, int *order, real tolerance)
{rows}{
{rows}  const int most = d < n ? d : n;
{rows}  real smallest_pivot = 0;
{rows}  for (int j = 0; j < n; ++j) order[j] = j;
{rows}  for (int k = 0; k < most; ++k) {
{rows}    int longest = k;
{rows}    real square = -1;
{rows}    for (int j = k; j < n; ++j) {
{rows}      const real candidate = dot(d - k, W + d * j + k, W + d * j + k);
{rows}      if (candidate > square) {
{rows}        square = candidate;
{rows}        longest = j;
{rows}      }
{rows}    }
{rows}    const real length = square > 0 ? sqrt(square) : 0;
{rows}    if (k == 0) smallest_pivot = tolerance * length;
{rows}    if (!(length > smallest_pivot)) return k;
{rows}    if (longest != k) {
{rows}      for (int i = 0; i < d; ++i) {
{rows}        const real entry = W[i + d * k];
{rows}        W[i + d * k] = W[i + d * longest];
{rows}        W[i + d * longest] = entry;
{rows}      }
{rows}      const int column = order[k];
{rows}      order[k] = order[longest];
{rows}      order[longest] = column;
{rows}    }
{rows}    real *const x = W + d * k;
{rows}    real below = 0;
{rows}    for (int i = k + 1; i < d; ++i) {
{rows}      if (fabs(x[i]) > below) below = fabs(x[i]);
{rows}    }
{rows}    tau[k] = 0;
{rows}    if (below == 0) continue;
{rows}    const real beta = x[k] > 0 ? -length : length, scale = 1 / (x[k] - beta);
{rows}    tau[k] = (beta - x[k]) / beta;
{rows}    x[k] = beta;
{rows}    for (int i = k + 1; i < d; ++i) x[i] *= scale;
{rows}    for (int j = k + 1; j < n; ++j) reflect(x + k + 1, tau[k], d - k, W + d * j + k);
{rows}  }
{rows}  return most;
{rows}}
{rows}
{rows}/* X := Q' X, n columns of d */
{rows}static void apply_Q_transposed(int d, const real *W, const real *tau, int rank, int n, real *X)
{rows}{
{rows}  for (int k = 0; k < rank; ++k) {
{rows}    for (int j = 0; j < n; ++j) reflect(W + d * k + k + 1, tau[k], d - k, X + d * j + k);
{rows}  }
{rows}}
{rows}
{rows}/* X := Q X */
{rows}static void apply_Q(int d, const real *W, const real *tau, int rank, int n, real *X)
{rows}{
{rows}  for (int k = rank - 1; k >= 0; --k) {
{rows}    for (int j = 0; j < n; ++j) reflect(W + d * k + k + 1, tau[k], d - k, X + d * j + k);
{rows}  }
{rows}}
{rows}
{rows}/* B' = C^-1 A', its columns scaled to unit length; rows of A that vanish are dropped */
{rows}static void scale_rows(workspace *w)
{rows}{
{rows}  w->n_zero_rows = 0;
{rows}  for (int k = 0; k < NC; ++k) {
{rows}    for (int i = 0; i < NQ; ++i) w->B[i + NQ * k] = w->A[k + NC * i];
{rows}  }
{rows}  solve_lower(w->C, NC, w->B);
{rows}  for (int k = 0; k < NC; ++k) {
{rows}    real *const row = w->B + NQ * k;
{rows}    real norm = sqrt(dot(NQ, row, row));
{rows}    if (!(norm > @small_norm@ && norm < @large_norm@)) { /* squares of such entries are no numbers */
{rows}      real largest = 0, sum = 0;
{rows}      for (int i = 0; i < NQ; ++i) {
{rows}        if (fabs(row[i]) > largest) largest = fabs(row[i]);
{rows}      }
{rows}      for (int i = 0; largest > 0 && i < NQ; ++i) sum += row[i] / largest * (row[i] / largest);
{rows}      norm = largest * sqrt(sum);
{rows}    }
{rows}    const real scale = norm < @smallest_row@ ? 0 : 1 / norm;
{rows}    if (scale == 0) ++w->n_zero_rows;
{rows}    w->row_scale[k] = scale;
{rows}    w->b_unit[k] = w->b[k] * scale;
{rows}    for (int i = 0; i < NQ; ++i) {
{rows}      row[i] *= scale;
{rows}      w->A_unit[k + NC * i] = w->A[k + NC * i] * scale;
{rows}    }
{rows}  }
{rows}}
{rows}
{rows}/* (R')^+ P' to the first rows of L, which are zero */
{rows}static void invert_R_transposed(workspace *w)
{rows}{
{rows}  const int rank = w->rank;
{rows}  if (rank == NC) { /* a lower triangle, by columns */
{rows}    for (int j = 0; j < NC; ++j) {
{rows}      real *const x = w->L + NQ * w->order[j];
{rows}      for (int i = j; i < NC; ++i) {
{rows}        const real sum = dot(i - j, w->B + NQ * i + j, x + j);
{rows}        x[i] = ((i == j ? 1 : 0) - sum) / w->B[i + NQ * i];
{rows}      }
{rows}    }
{rows}    return;
{rows}  }
{several}  /* R' P2 = Q2 R2 is (NC x rank), of full rank: (R')^+ = P2 R2^-1 Q2' */
{several}  for (int i = 0; i < rank; ++i) {
{several}    for (int j = 0; j < NC; ++j) w->R[j + NC * i] = j < i ? 0 : w->B[i + NQ * j];
{several}  }
{several}  pivoted_qr(NC, rank, w->R, w->tau2, w->order2, 0);
{several}  for (int j = 0; j < NC; ++j) {
{several}    real *const e = w->residual;
{several}    for (int i = 0; i < NC; ++i) e[i] = i == j;
{several}    apply_Q_transposed(NC, w->R, w->tau2, rank, 1, e);
{several}    for (int i = rank - 1; i >= 0; --i) {
{several}      const real value = e[i] / w->R[i + NC * i];
{several}      for (int l = 0; l < i; ++l) e[l] -= value * w->R[l + NC * i];
{several}      w->L[w->order2[i] + NQ * w->order[j]] = value;
{several}    }
{several}  }
{rows}}
{rows}
{rows}/* T and L of rows of unit length from B' P = [Y Z] [R; 0]: Y spans range(B'), Z its complement, T = C'^-1 Z Z' C',
{rows} * L = C'^-1 Y (R')^+ P'. */
{rows}static void decompose_rows(workspace *w)
{rows}{
{rows}  w->rank = pivoted_qr(NQ, NC, w->B, w->tau, w->order, @rank_tolerance@);
{rows}  for (int i = 0; i < NQ * NC; ++i) w->L[i] = 0;
{rows}  if (w->rank == 0) { /* nothing constrains the motion */
{rows}    for (int i = 0; i < NQ * NQ; ++i) w->T[i] = i % (NQ + 1) == 0;
{rows}    return;
{rows}  }
{rows}  for (int j = 0; j < NQ; ++j) {
{rows}    for (int i = 0; i < NQ; ++i) w->T[i + NQ * j] = i <= j ? w->C[j + NQ * i] : 0;
{rows}  }
{rows}  apply_Q_transposed(NQ, w->B, w->tau, w->rank, NQ, w->T);
{rows}  for (int j = 0; j < NQ; ++j) {
{rows}    for (int i = 0; i < w->rank; ++i) w->T[i + NQ * j] = 0;
{rows}  }
{rows}  apply_Q(NQ, w->B, w->tau, w->rank, NQ, w->T);
{rows}  invert_R_transposed(w);
{rows}  apply_Q(NQ, w->B, w->tau, w->rank, NC, w->L);
{rows}  solve_upper(w->C, NQ, w->T);
{rows}  solve_upper(w->C, NC, w->L);
{rows}}
{rows}
{rows}/* Whether no acceleration satisfies A ddq = b: A L b is off b by more than rounding of what accelerates the system, b and F. */
{rows}static int is_contradictory(workspace *w)
{rows}{
{rows}  real inconsistency = 0, size_of_b = 0, size_of_force = 0;
{rows}  for (int k = 0; k < NC; ++k) {
{rows}    real off = w->b_unit[k];
{rows}    for (int i = 0; i < NQ; ++i) off -= w->A_unit[k + NC * i] * w->Lb[i];
{rows}    off = fabs(w->row_scale[k] == 0 ? w->b[k] : off);
{rows}    if (off > inconsistency) inconsistency = off;
{rows}    if (fabs(w->b_unit[k]) > size_of_b) size_of_b = fabs(w->b_unit[k]);
{rows}  }
{rows}  if (!(inconsistency > @consistency@ * size_of_b && inconsistency > @smallest_row@)) return 0;
{rows}  for (int i = 0; i < NQ; ++i) {
{rows}    const real size = fabs(w->F[i]) / sqrt(w->mass[i + NQ * i]);
{rows}    if (is_finite(1, &w->F[i]) && size > size_of_force) size_of_force = size;
{rows}  }
{rows}  return inconsistency > @consistency@ * size_of_force;
{rows}}

/* The Udwadia-Kalaba equation at a state, ddq = L b + T abar with L = M^-1 A' (A M^-1 A')^+ and T = I - L A. */
static status project(workspace *w)
{
  if (!is_finite(NQ * NQ, w->M)) return @name@_NOT_FINITE;
{rows}  if (!is_finite(NC * NQ, w->A) || !is_finite(NC, w->b)) return @name@_NOT_FINITE;
{!rows}  return factorise_mass(w);
{rows}  const status of_mass = factorise_mass(w);
{rows}  if (of_mass != @name@_OK) return of_mass;
{rows}  scale_rows(w);
{rows}  decompose_rows(w);
{rows}  if (w->pivot < @well_conditioned@) { /* takes away what A still sees of T */
{rows}    for (int j = 0; j < NQ; ++j) {
{rows}      for (int k = 0; k < NC; ++k) {
{rows}        w->residual[k] = 0;
{rows}        for (int i = 0; i < NQ; ++i) w->residual[k] += w->A_unit[k + NC * i] * w->T[i + NQ * j];
{rows}      }
{rows}      for (int i = 0; i < NQ; ++i) {
{rows}        for (int k = 0; k < NC; ++k) w->T[i + NQ * j] -= w->L[i + NQ * k] * w->residual[k];
{rows}      }
{rows}    }
{rows}  }
{rows}  for (int i = 0; i < NQ; ++i) {
{rows}    w->Lb[i] = 0;
{rows}    for (int k = 0; k < NC; ++k) w->Lb[i] += w->L[i + NQ * k] * w->b_unit[k];
{rows}  }
{rows}  return is_contradictory(w) ? @name@_CONTRADICTING_CONSTRAINTS : @name@_OK;
}
{admissible}
{admissible}/* P = I - W A' (A W A')^+ A with W = diag(@admissible@)^2, and the L of it: what `project` makes of the mass matrix W^-1 */
{admissible}static void project_admissible(workspace *w)
{admissible}{
{admissible}  for (int i = 0; i < NQ * NQ; ++i) {
{admissible}    w->stated_M[i] = w->M[i];
{admissible}    w->M[i] = i % (NQ + 1) == 0 ? 1 / (@admissible@[i / NQ] * @admissible@[i / NQ]) : 0;
{admissible}  }
{admissible}  (void)project(w); /* it tells of A and b again when M is back */
{admissible}  for (int i = 0; i < NQ * NQ; ++i) {
{admissible}    w->P[i] = w->T[i];
{admissible}    w->M[i] = w->stated_M[i];
{admissible}  }
{admissible}  for (int i = 0; i < NQ * NC; ++i) w->L_P[i] = w->L[i] * w->row_scale[i / NQ];
{admissible}}
{rows,moved}
{rows,moved}/* ddq = L b + T abar, with one step of refinement onto A ddq = b */
{rows,moved}static void constrain(workspace *w)
{rows,moved}{
{rows,moved}  for (int i = 0; i < NQ; ++i) {
{rows,moved,all}    real sum = w->Lb[i];
{rows,moved,!all}    real sum = 0;
{rows,moved}    for (int j = 0; j < NQ; ++j) sum += w->T[i + NQ * j] * w->a_bar[j];
{rows,moved}    w->a[i] = sum;
{rows,moved}  }
{rows,moved,all}  for (int k = 0; k < NC; ++k) {
{rows,moved,all}    real sum = w->b_unit[k];
{rows,moved,all}    for (int i = 0; i < NQ; ++i) sum -= w->A_unit[k + NC * i] * w->a[i];
{rows,moved,all}    w->residual[k] = sum;
{rows,moved,all}  }
{rows,moved,all}  for (int i = 0; i < NQ; ++i) {
{rows,moved,all}    for (int k = 0; k < NC; ++k) w->a[i] += w->L[i + NQ * k] * w->residual[k];
{rows,moved,all}  }
{rows,moved}}
{least_norm}
{least_norm}/* K, of which lambda = K A' lambda: of redundant rows the multipliers of least norm */
{least_norm}static void multipliers_of_force(workspace *w)
{least_norm}{
{least_norm}  for (int j = 0; j < NQ; ++j) {
{least_norm}    for (int k = 0; k < NC; ++k) w->K[k + NC * j] = w->row_scale[k] * w->L[j + NQ * k];
{least_norm}  }
{least_norm,several}  const int rank = w->rank, n_redundant = NC - w->n_zero_rows - rank, n = NC - rank;
{least_norm,several}  if (n_redundant == 0 || rank == 0) return;
{least_norm,several}  /* takes away what lies in the null space of A': of unit rows it is spanned by the last columns of Q2 */
{least_norm,several}  for (int i = 0; i < NC * n; ++i) w->null_space[i] = i == rank + i / NC * (NC + 1);
{least_norm,several}  apply_Q(NC, w->R, w->tau2, rank, n, w->null_space);
{least_norm,several}  for (int j = 0; j < n; ++j) {
{least_norm,several}    for (int i = 0; i < NC; ++i) {
{least_norm,several}      w->null_rows[w->order[i] + NC * j] = w->row_scale[w->order[i]] * w->null_space[i + NC * j];
{least_norm,several}    }
{least_norm,several}  }
{least_norm,several}  pivoted_qr(NC, n, w->null_rows, w->null_tau, w->null_order, 0);
{least_norm,several}  apply_Q_transposed(NC, w->null_rows, w->null_tau, n_redundant, NQ, w->K);
{least_norm,several}  for (int j = 0; j < NQ; ++j) {
{least_norm,several}    for (int k = 0; k < n_redundant; ++k) w->K[k + NC * j] = 0;
{least_norm,several}  }
{least_norm,several}  apply_Q(NC, w->null_rows, w->null_tau, n_redundant, NQ, w->K);
{least_norm}}
{load}
{load}/* lambda0, the multipliers under the known force, M a0 = F + A' lambda0 with A a0 = b; x is the state and lambda0 */
{load}static void known_multipliers(const real *state, workspace *w)
{load}{
{load}  real without[NQ], force[NQ];
{load}  for (int i = 0; i < NQ; ++i) without[i] = w->F[i];
{load}  solve_mass(w->C, 1, without);
{load}  for (int i = 0; i < NQ; ++i) {
{load}    w->a0[i] = w->Lb[i];
{load}    for (int j = 0; j < NQ; ++j) w->a0[i] += w->T[i + NQ * j] * without[j];
{load}  }
{load}  for (int k = 0; k < NC; ++k) {
{load}    w->residual[k] = w->b_unit[k];
{load}    for (int i = 0; i < NQ; ++i) w->residual[k] -= w->A_unit[k + NC * i] * w->a0[i];
{load}  }
{load}  for (int i = 0; i < NQ; ++i) {
{load}    for (int k = 0; k < NC; ++k) w->a0[i] += w->L[i + NQ * k] * w->residual[k];
{load}  }
{load}  for (int i = 0; i < NQ; ++i) {
{load}    force[i] = -w->F[i];
{load}    for (int j = 0; j < NQ; ++j) force[i] += w->M[i + NQ * j] * w->a0[j];
{load}  }
{load}  multipliers_of_force(w);
{load}  for (int i = 0; i < NX; ++i) w->x[i] = state[i];
{load}  for (int k = 0; k < NC; ++k) {
{load}    w->x[NX + k] = 0;
{load}    for (int i = 0; i < NQ; ++i) w->x[NX + k] += w->K[k + NC * i] * force[i];
{load}  }
{load}}

)c";

// what a kernel is made of; c_source.cpp takes those that are used
struct Piece {
  std::string_view name, text;
};
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

// the mean, its deviation and its Jacobian
inline constexpr std::string_view prediction_template =
    R"c({nonlinear}/* ---------------------------------------------------------------- multipliers that forces read which they make
{nonlinear} *
{nonlinear} * lambda = G abar(lambda) + d, G = -(A M^-1 A')^+ A, d = (A M^-1 A')^+ b, by Newton's method; w->y is the state and lambda.
{nonlinear} */
{nonlinear}
{nonlinear}/* abar at this lambda, and J, its slope there */
{nonlinear}static void evaluate_load(const component *c, workspace *w)
{nonlinear}{
{nonlinear}  for (int i = 0; i < NQ; ++i) w->rest_of_load[i] = w->force_of_load[i] = 0;
{nonlinear}  for (int i = 0; i < NQ * NC; ++i) w->rest_slope[i] = w->force_slope[i] = 0;
@under_load@
{nonlinear}  for (int i = 0; i < NQ; ++i) w->a_under_load[i] = w->force_of_load[i];
{nonlinear}  for (int i = 0; i < NQ * NC; ++i) w->slope[i] = w->force_slope[i];
{nonlinear}  solve_mass(w->C, 1, w->a_under_load);
{nonlinear}  solve_mass(w->C, NC, w->slope);
{nonlinear}  for (int i = 0; i < NQ; ++i) w->a_under_load[i] += w->without_load[i] + w->rest_of_load[i];
{nonlinear}  for (int i = 0; i < NQ * NC; ++i) w->slope[i] += w->rest_slope[i];
{nonlinear}}
{nonlinear}
{nonlinear}/* D = I - share G J to its triangles, rows exchanged by order_lambda. Returns its determinant. */
{nonlinear}static real factorise_load(real share, workspace *w)
{nonlinear}{
{nonlinear}  real *const D = w->D_lambda, determinant = 1;
{nonlinear}  for (int j = 0; j < NC; ++j) {
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      real sum = 0;
{nonlinear}      for (int i = 0; i < NQ; ++i) sum += w->G_lambda[k + NC * i] * w->slope[i + NQ * j];
{nonlinear}      D[k + NC * j] = (k == j) - share * sum;
{nonlinear}    }
{nonlinear}  }
{nonlinear}  for (int k = 0; k < NC; ++k) {
{nonlinear}    int pivot = k;
{nonlinear}    for (int i = k + 1; i < NC; ++i) {
{nonlinear}      if (fabs(D[i + NC * k]) > fabs(D[pivot + NC * k])) pivot = i;
{nonlinear}    }
{nonlinear}    w->order_lambda[k] = pivot;
{nonlinear}    if (pivot != k) determinant = -determinant;
{nonlinear}    for (int j = 0; pivot != k && j < NC; ++j) {
{nonlinear}      const real entry = D[k + NC * j];
{nonlinear}      D[k + NC * j] = D[pivot + NC * j];
{nonlinear}      D[pivot + NC * j] = entry;
{nonlinear}    }
{nonlinear}    determinant *= D[k + NC * k];
{nonlinear}    for (int i = k + 1; i < NC; ++i) {
{nonlinear}      D[i + NC * k] /= D[k + NC * k];
{nonlinear}      for (int j = k + 1; j < NC; ++j) D[i + NC * j] -= D[i + NC * k] * D[k + NC * j];
{nonlinear}    }
{nonlinear}  }
{nonlinear}  return determinant;
{nonlinear}}
{nonlinear}
{nonlinear}/* X := D^-1 X, n columns */
{nonlinear}static void solve_load(const workspace *w, int n, real *X)
{nonlinear}{
{nonlinear}  const real *const D = w->D_lambda;
{nonlinear}  for (int column = 0; column < n; ++column) {
{nonlinear}    real *const x = X + NC * column;
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      const real entry = x[w->order_lambda[k]];
{nonlinear}      x[w->order_lambda[k]] = x[k];
{nonlinear}      x[k] = entry;
{nonlinear}    }
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      for (int i = k + 1; i < NC; ++i) x[i] -= D[i + NC * k] * x[k];
{nonlinear}    }
{nonlinear}    for (int k = NC - 1; k >= 0; --k) {
{nonlinear}      x[k] /= D[k + NC * k];
{nonlinear}      for (int i = 0; i < k; ++i) x[i] -= D[i + NC * k] * x[k];
{nonlinear}    }
{nonlinear}  }
{nonlinear}}
{nonlinear}
{nonlinear}/* Newton's method where only a share of what the load adds acts. Returns whether it ended. */
{nonlinear}static int reach_load(const component *c, real share, real size, workspace *w)
{nonlinear}{
{nonlinear}  real *const lambda = w->y + NX;
{nonlinear}  for (int step = 0; step < 40; ++step) {
{nonlinear}    evaluate_load(c, w);
{nonlinear}    if (!is_finite(NQ, w->a_under_load) || !is_finite(NQ * NC, w->slope)) return 0;
{nonlinear}    if (!(factorise_load(share, w) > 0)) return 0;
{nonlinear}    real change[NC];
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      change[k] = lambda[k] - w->d_lambda[k];
{nonlinear}      for (int i = 0; i < NQ; ++i) {
{nonlinear}        change[k] -= w->G_lambda[k + NC * i] * (w->a_at_zero[i] + share * (w->a_under_load[i] - w->a_at_zero[i]));
{nonlinear}      }
{nonlinear}    }
{nonlinear}    const real rest = sqrt(dot(NC, change, change));
{nonlinear}    solve_load(w, 1, change);
{nonlinear}    for (int k = 0; k < NC; ++k) lambda[k] -= change[k];
{nonlinear}    const real enough = @newton@ * (size + sqrt(dot(NC, lambda, lambda)));
{nonlinear}    if (sqrt(dot(NC, change, change)) <= enough || rest <= enough / 10) return is_finite(NC, lambda);
{nonlinear}  }
{nonlinear}  return 0;
{nonlinear}}
{nonlinear}
{nonlinear}/* The load of the motion, let in at once or bit by bit. Returns 0 where it grows as fast as the force that it causes. */
{nonlinear}static int find_load(const component *c, const real *state, workspace *w)
{nonlinear}{
{nonlinear}  real *const lambda = w->y + NX;
{nonlinear}  multipliers_of_force(w);
{nonlinear}  for (int j = 0; j <= NQ; ++j) { /* G = K (M T - mass), d = K M L b */
{nonlinear}    real column[NQ], *const to = j < NQ ? w->G_lambda + NC * j : w->d_lambda;
{nonlinear}    for (int i = 0; i < NQ; ++i) {
{nonlinear}      column[i] = j < NQ ? -w->mass[i + NQ * j] : 0;
{nonlinear}      for (int l = 0; l < NQ; ++l) column[i] += w->M[i + NQ * l] * (j < NQ ? w->T[l + NQ * j] : w->Lb[l]);
{nonlinear}    }
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      to[k] = 0;
{nonlinear}      for (int i = 0; i < NQ; ++i) to[k] += w->K[k + NC * i] * column[i];
{nonlinear}    }
{nonlinear}  }
{nonlinear}  for (int i = 0; i < NX; ++i) w->y[i] = state[i];
{nonlinear}  for (int steps = 1; steps <= 16; steps += 15) {
{nonlinear}    for (int k = 0; k < NC; ++k) lambda[k] = 0;
{nonlinear}    evaluate_load(c, w);
{nonlinear}    for (int i = 0; i < NQ; ++i) w->a_at_zero[i] = w->a_under_load[i];
{nonlinear}    real size = 0; /* lambda is rounded as its terms are, which may cancel */
{nonlinear}    for (int k = 0; k < NC; ++k) {
{nonlinear}      lambda[k] = w->d_lambda[k];
{nonlinear}      real terms = fabs(w->d_lambda[k]);
{nonlinear}      for (int i = 0; i < NQ; ++i) {
{nonlinear}        const real term = w->G_lambda[k + NC * i] * w->a_at_zero[i];
{nonlinear}        lambda[k] += term;
{nonlinear}        terms += fabs(term);
{nonlinear}      }
{nonlinear}      size += terms * terms;
{nonlinear}    }
{nonlinear}    size = sqrt(size);
{nonlinear}    int step = 1;
{nonlinear}    while (step <= steps && reach_load(c, (real)step / (real)steps, size, w)) ++step;
{nonlinear}    if (step > steps) return 1;
{nonlinear}  }
{nonlinear}  return 0;
{nonlinear}}
{nonlinear}
/* ---------------------------------------------------------------- mean */

/* abar = mu + sum E C f of the latents' means; `force` is what of it is multiplied by M^-1 */
static status evaluate_prior(const component *c, const real *state, workspace *w)
{
{constant}  static const real mu[NQ] = {@mu@};
  for (int i = 0; i < NQ; ++i) {
{constant}    w->a_bar[i] = mu[i];
{!constant}    w->a_bar[i] = 0;
{known}    w->force[i] = w->F[i];
{!known}    w->force[i] = 0;
  }
{load}  known_multipliers(state, w);
@signals@
{nonlinear}  for (int i = 0; i < NQ; ++i) w->without_load[i] = w->force[i];
{nonlinear}  solve_mass(w->C, 1, w->without_load);
{nonlinear}  for (int i = 0; i < NQ; ++i) w->without_load[i] += w->a_bar[i];
{nonlinear}  if (!find_load(c, state, w)) return @name@_NOT_FINITE;
{nonlinear}  evaluate_load(c, w);
{nonlinear}  for (int i = 0; i < NQ; ++i) {
{nonlinear}    w->force[i] += w->force_of_load[i];
{nonlinear}    w->a_bar[i] += w->rest_of_load[i];
{nonlinear}  }
  for (int i = 0; i < NQ; ++i) w->a_of_force[i] = w->force[i];
{forced}  solve_mass(w->C, 1, w->a_of_force);
{forced}  for (int i = 0; i < NQ; ++i) w->a_bar[i] += w->a_of_force[i];
  return is_finite(NQ, w->a_bar) ? @name@_OK : @name@_NOT_FINITE;
}
{applied}
{applied}/* the applied force M abar */
{applied}static void evaluate_applied_force(workspace *w)
{applied}{
{applied}  for (int i = 0; i < NQ; ++i) {
{applied}    w->applied[i] = w->force[i];
{applied}    for (int j = 0; j < NQ; ++j) w->applied[i] += w->M[i + NQ * j] * (w->a_bar[j] - w->a_of_force[j]);
{applied}  }
{applied}}
{moved}
{moved}/* ddq, and the force A' lambda = M (ddq - abar) of the constraints */
{moved}static void evaluate_motion(workspace *w)
{moved}{
{moved,rows}  constrain(w);
{moved,!rows}  for (int i = 0; i < NQ; ++i) w->a[i] = w->a_bar[i];
{moved}  for (int i = 0; i < NQ; ++i) w->gap[i] = w->a[i] - w->a_bar[i];
{moved}  for (int i = 0; i < NQ; ++i) {
{moved}    real sum = -w->force[i];
{moved}    for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->gap[j];
{moved}    for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->a_of_force[j];
{moved}    w->of_constraint[i] = sum;
{moved}  }
{moved}}

/* The mean after the mechanics at a state stand in the workspace. */
static status evaluate_mean(const component *c, const real *state, real *mean, workspace *w)
{
{admissible}  project_admissible(w);
  status s = project(w);
  if (s == @name@_OK) s = evaluate_prior(c, state, w);
  if (s == @name@_OK) {
{moved}    evaluate_motion(w);
{applied}    evaluate_applied_force(w);
@value@
    if (!is_finite(NR, mean)) s = @name@_NOT_FINITE;
  }
  return s;
}

static status evaluate(const component *c, const real *state, real *mean, workspace *w)
{
  evaluate_system(c->parameters, state, w);
  return evaluate_mean(c, state, mean, w);
}

static status failed(status s, int n, real *numbers)
{
  for (int i = 0; i < n; ++i) numbers[i] = (real)NAN;
  return s;
}

status @name@_mean(const real *state, real *mean, workspace *w)
{
{!mixture}  const status s = evaluate(&components[0], state, mean, w);
{!mixture}  return s == @name@_OK ? s : failed(s, NR, mean);
{mixture}  for (int r = 0; r < NR; ++r) mean[r] = 0;
{mixture}  for (int k = 0; k < COMPONENTS; ++k) {
{mixture}    const status s = evaluate(&components[k], state, w->mean, w);
{mixture}    if (s != @name@_OK) return failed(s, NR, mean);
{mixture}    for (int r = 0; r < NR; ++r) mean[r] += w->mean[r] / COMPONENTS;
{mixture}  }
{mixture}  return @name@_OK;
}
{stddev}
{stddev}/* ---------------------------------------------------------------- standard deviation */
{stddev}
{stddev,potential}/* products_j += the rows of gradients at point j, times their covariance with what is predicted */
{stddev,potential}static void add_gradient_products(const latent *a, int d, int row, const real *gradient, real *products)
{stddev,potential}{
{stddev,potential}  for (int f = 0; f < d; ++f) {
{stddev,potential}    const real *const rows = a->rows + a->n * (d * row + f);
{stddev,potential}    for (int j = 0; j < a->n; ++j) products[j] += gradient[a->n * f + j] * rows[j];
{stddev,potential}  }
{stddev,potential}}
{stddev,potential}
{stddev,!by_function,other}/* products_j += k_j times the rows of functions at point j, times their loading */
{stddev,!by_function,other}static void add_products(const latent *a, int n_functions, int row, const real *k, const real *loading, real *products)
{stddev,!by_function,other}{
{stddev,!by_function,other}  for (int f = 0; f < n_functions; ++f) {
{stddev,!by_function,other}    const real *const rows = a->rows + a->n * (n_functions * row + f);
{stddev,!by_function,other}    for (int j = 0; j < a->n; ++j) products[j] += k[j] * rows[j] * loading[f];
{stddev,!by_function,other}  }
{stddev,!by_function,other}}
{stddev,!by_function,other}
{stddev}/* G of the view, transposed (NQ x NR): the prediction is G abar + d */
{stddev}static void evaluate_view(workspace *w)
{stddev}{
@view_matrix@
{stddev,nonlinear}  /* G (I + J D^-1 G_lambda): lambda answers */
{stddev,nonlinear}  real answer[NC * NQ];
{stddev,nonlinear}  for (int i = 0; i < NC * NQ; ++i) answer[i] = w->G_lambda[i];
{stddev,nonlinear}  (void)factorise_load(1, w);
{stddev,nonlinear}  solve_load(w, NQ, answer);
{stddev,nonlinear}  for (int r = 0; r < NR; ++r) {
{stddev,nonlinear}    real through[NC];
{stddev,nonlinear}    for (int k = 0; k < NC; ++k) through[k] = dot(NQ, w->Gt + NQ * r, w->slope + NQ * k);
{stddev,nonlinear}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] += dot(NC, through, answer + NC * j);
{stddev,nonlinear}  }
{stddev}}
{stddev}
{stddev}static void evaluate_stddev(const component *c, real *stddev, workspace *w)
{stddev}{
{stddev}  real variance[NR] = {0};
{stddev}  evaluate_view(w);
{stddev,forced_latent}  for (int i = 0; i < NQ * NR; ++i) w->M_inverse_Gt[i] = w->Gt[i];
{stddev,forced_latent}  solve_mass(w->C, NR, w->M_inverse_Gt);
{stddev}
{stddev}  /* the variance of the prior, and loadings of the latent functions on each row (FUNCTIONS x NR) */
@loadings@
{stddev}  /* less what the observations explain */
{stddev}  const int n = c->latents[0].n;
{stddev}  for (int row = 0; row < c->n_row_components; ++row) {
{stddev}    const @index@ *const row_of = c->row_of + n * row;
{stddev,!by_function}    for (int r = 0; r < NR; ++r) {
{stddev,!by_function}      real *const cross = w->@cross@ + @cross_rows@ * r;
{stddev,!by_function}      for (int j = 0; j < n; ++j) w->products[j] = 0;
@cross_by_row@
{stddev,!by_function}      for (int j = 0; j < n; ++j) {
{stddev,!by_function}        if (row_of[j] >= 0) cross[row_of[j]] = w->products[j];
{stddev,!by_function}      }
{stddev,!by_function}    }
@cross_by_function@
{stddev}  }
{stddev,sums}  for (int column = 0; column < COLUMNS; ++column) {
{stddev,sums}    for (int i = 0; i < c->n_variables; ++i) {
{stddev,sums}      real sum = 0;
{stddev,sums}      for (int s = c->sum_begin[i]; s < c->sum_begin[i + 1]; ++s) {
{stddev,sums}        sum += c->sum_value[s] * w->rows[@cross_rows@ * column + c->sum_column[s]];
{stddev,sums}      }
{stddev,sums}      w->cross[VARIABLES * column + i] = sum;
{stddev,sums}    }
{stddev,sums}  }
{stddev}  for (int column = 0; column < COLUMNS; ++column) {
{stddev}    for (int i = c->n_variables; i < VARIABLES; ++i) w->cross[VARIABLES * column + i] = 0;
{stddev}  }
{stddev}  const real *row = c->inverse;
{stddev}  for (int i = 0; i < c->n_variables; ++i) {
{stddev}    real explained[COLUMNS];
{stddev}    const int length = (i / LANES + 1) * LANES;
{stddev}    for (int k = 0; k < COLUMNS; ++k) explained[k] = weighted_sum(length, row, w->cross + VARIABLES * k);
{stddev}    row += length;
{stddev,!by_function}    for (int r = 0; r < NR; ++r) variance[r] -= explained[r] * explained[r];
{stddev,by_function}    for (int r = 0; r < NR; ++r) {
{stddev,by_function}      real sum = 0;
{stddev,by_function}      for (int f = 0; f < COLUMNS; ++f) sum += w->loading[COLUMNS * r + f] * explained[f];
{stddev,by_function}      variance[r] -= sum * sum;
{stddev,by_function}    }
{stddev}  }
{stddev}  for (int r = 0; r < NR; ++r) stddev[r] = variance[r] < 0 ? 0 : sqrt(variance[r]);
{stddev}}
{stddev}
{stddev}status @name@_mean_and_stddev(const real *state, real *mean, real *stddev, workspace *w)
{stddev}{
{stddev,!mixture}  const status s = evaluate(&components[0], state, mean, w);
{stddev,!mixture}  if (s != @name@_OK) return failed(failed(s, NR, mean), NR, stddev);
{stddev,!mixture}  evaluate_stddev(&components[0], stddev, w);
{stddev,mixture}  for (int r = 0; r < NR; ++r) mean[r] = stddev[r] = 0;
{stddev,mixture}  for (int k = 0; k < COMPONENTS; ++k) {
{stddev,mixture}    real *const mean_k = w->means + NR * k, *const stddev_k = w->stddevs + NR * k;
{stddev,mixture}    const status s = evaluate(&components[k], state, mean_k, w);
{stddev,mixture}    if (s != @name@_OK) return failed(failed(s, NR, mean), NR, stddev);
{stddev,mixture}    evaluate_stddev(&components[k], stddev_k, w);
{stddev,mixture}    for (int r = 0; r < NR; ++r) mean[r] += mean_k[r] / COMPONENTS;
{stddev,mixture}  }
{stddev,mixture}  for (int r = 0; r < NR; ++r) {
{stddev,mixture}    for (int k = 0; k < COMPONENTS; ++k) {
{stddev,mixture}      const real off = w->means[NR * k + r] - mean[r], own = w->stddevs[NR * k + r];
{stddev,mixture}      stddev[r] += own * own + off * off;
{stddev,mixture}    }
{stddev,mixture}    stddev[r] = sqrt(stddev[r] / COMPONENTS);
{stddev,mixture}  }
{stddev}  if (!is_finite(NR, stddev)) return failed(failed(@name@_NOT_FINITE, NR, mean), NR, stddev);
{stddev}  return @name@_OK;
{stddev}}
{jacobian}
{jacobian}/* ---------------------------------------------------------------- Jacobian
{jacobian} *
{jacobian} * With P and R the changes of what stands without and with M^-1 in abar,
{jacobian} *
{jacobian} *     dabar = P + M^-1 (R - dM a_of_force)
{jacobian} *     dddq  = T (P + M^-1 (R + dM (abar - ddq - a_of_force) + dA' lambda)) + L (db - dA ddq)
{jacobian} */
{jacobian}
{jacobian,least_norm}/* d lambda = K (df - dA' lambda) + (I - K A') dA K' lambda, f = A' lambda, of one entry of the state
{jacobian,least_norm} *   df       df - dA' lambda; it is lost
{jacobian,least_norm} *   d_along  dA K' lambda; it is lost */
{jacobian,least_norm}static void change_of_multipliers(real *df, real *d_along, const workspace *w, real *d_lambda)
{jacobian,least_norm}{
{jacobian,least_norm}  for (int i = 0; i < NC; ++i) {
{jacobian,least_norm}    if (w->rank == NC) d_along[i] = 0; /* K A' = I */
{jacobian,least_norm}    for (int j = 0; j < NQ; ++j) df[j] -= w->A[i + NC * j] * d_along[i];
{jacobian,least_norm}  }
{jacobian,least_norm}  for (int i = 0; i < NC; ++i) {
{jacobian,least_norm}    d_lambda[i] = d_along[i];
{jacobian,least_norm}    for (int j = 0; j < NQ; ++j) d_lambda[i] += w->K[i + NC * j] * df[j];
{jacobian,least_norm}  }
{jacobian,least_norm}}
{jacobian,least_norm}
{jacobian,least_norm}/* K' lambda */
{jacobian,least_norm}static void along_multipliers(const real *lambda, const workspace *w, real *along)
{jacobian,least_norm}{
{jacobian,least_norm}  for (int j = 0; j < NQ; ++j) {
{jacobian,least_norm}    along[j] = 0;
{jacobian,least_norm}    for (int i = 0; i < NC; ++i) along[j] += w->K[i + NC * j] * lambda[i];
{jacobian,least_norm}  }
{jacobian,least_norm}}
{jacobian,least_norm}
{jacobian,loaded}/* The same of M a = F + A' lambda and A a = b: df - dA' lambda = M da - r, da = T M^-1 r + L (db - dA a)
{jacobian,loaded} *   r        dF + dA' lambda - dM a; it is lost
{jacobian,loaded} *   d_rows   db - dA a */
{jacobian,loaded}static void change_of_load(real *r, const real *d_rows, real *d_along, const workspace *w, real *d_lambda)
{jacobian,loaded}{
{jacobian,loaded}  real solved[NQ], da[NQ];
{jacobian,loaded}  for (int i = 0; i < NQ; ++i) solved[i] = r[i];
{jacobian,loaded}  solve_mass(w->C, 1, solved);
{jacobian,loaded}  for (int i = 0; i < NQ; ++i) {
{jacobian,loaded}    da[i] = 0;
{jacobian,loaded}    for (int j = 0; j < NQ; ++j) da[i] += w->T[i + NQ * j] * solved[j];
{jacobian,loaded}    for (int j = 0; j < NC; ++j) da[i] += w->L[i + NQ * j] * w->row_scale[j] * d_rows[j];
{jacobian,loaded}  }
{jacobian,loaded}  for (int i = 0; i < NQ; ++i) {
{jacobian,loaded}    r[i] = -r[i];
{jacobian,loaded}    for (int j = 0; j < NQ; ++j) r[i] += w->M[i + NQ * j] * da[j];
{jacobian,loaded}  }
{jacobian,loaded}  change_of_multipliers(r, d_along, w, d_lambda);
{jacobian,loaded}}
{jacobian,loaded}
{jacobian,load}/* d lambda0 of M a0 = F + A' lambda0, A a0 = b */
{jacobian,load}static void differentiate_known_multipliers(workspace *w)
{jacobian,load}{
{jacobian,load}  const real *const lambda0 = w->x + NX;
{jacobian,load}  real along[NQ];
{jacobian,load}  along_multipliers(lambda0, w, along);
{jacobian,load}  for (int i = 0; i < NQ * NX; ++i) w->d_forced0[i] = 0;
{jacobian,load}  for (int i = 0; i < NC * NX; ++i) w->d_rows0[i] = w->d_along[i] = 0;
@dload@
{jacobian,load}  for (int k = 0; k < NX; ++k) {
{jacobian,load}    change_of_load(w->d_forced0 + NQ * k, w->d_rows0 + NC * k, w->d_along + NC * k, w, w->d_lambda0 + NC * k);
{jacobian,load}  }
{jacobian,load}}
{jacobian,load}
{jacobian,load}/* sum (NQ x NX) += slope in row i, for entry k of x */
{jacobian,load}static void add_change(real *sum, int i, int k, real slope, const workspace *w)
{jacobian,load}{
{jacobian,load}  if (k < NX) sum[i + NQ * k] += slope;
{jacobian,load}  for (int j = 0; k >= NX && j < NX; ++j) sum[i + NQ * j] += slope * w->d_lambda0[k - NX + NC * j];
{jacobian,load}}
{jacobian,load}
{jacobian}static void differentiate_prior(const component *c, const real *state, workspace *w)
{jacobian}{
{jacobian,load}  differentiate_known_multipliers(w);
{jacobian}  for (int i = 0; i < NQ * NX; ++i) w->d_of_rest[i] = w->d_force[i] = 0;
@dsignals@
{jacobian}}
{jacobian}
{jacobian}/* R - dM a_of_force, dA' lambda, dM (ddq - abar), dM abar, db - dA ddq */
{jacobian}static void differentiate_mechanics(workspace *w)
{jacobian}{
{jacobian,moved,rows}  real lambda[NC];
{jacobian,moved,rows}  for (int k = 0; k < NC; ++k) {
{jacobian,moved,rows}    lambda[k] = 0;
{jacobian,moved,rows}    for (int i = 0; i < NQ; ++i) lambda[k] += w->row_scale[k] * w->L[i + NQ * k] * w->of_constraint[i];
{jacobian,moved,rows}  }
{jacobian,moved}  for (int i = 0; i < NQ * NX; ++i) w->d_of_constraint[i] = 0;
{jacobian,applied}  for (int i = 0; i < NQ * NX; ++i) w->d_applied[i] = 0;
{jacobian,moved,rows}  for (int i = 0; i < NQ * NX; ++i) w->d_forced[i] = 0;
{jacobian,moved,rows}  for (int i = 0; i < NC * NX; ++i) w->d_rows[i] = 0;
@dmechanics@
{jacobian}}
{jacobian}
{jacobian,nonlinear}/* What follows from the change of lambda with the state, D dlambda = the change of G abar + d at held lambda */
{jacobian,nonlinear}static void differentiate_load(workspace *w)
{jacobian,nonlinear}{
{jacobian,nonlinear}  const real *const lambda = w->y + NX;
{jacobian,nonlinear}  real along[NQ];
{jacobian,nonlinear}  along_multipliers(lambda, w, along);
{jacobian,nonlinear}  for (int i = 0; i < NC * NX; ++i) w->d_along[i] = 0;
@dalong@
{jacobian,nonlinear}  (void)factorise_load(1, w);
{jacobian,nonlinear}  for (int k = 0; k < NX; ++k) {
{jacobian,nonlinear}    real r[NQ], d_lambda[NC];
{jacobian,nonlinear}    for (int i = 0; i < NQ; ++i) {
{jacobian,nonlinear}      r[i] = w->d_force[i + NQ * k] + w->d_forced[i + NQ * k] - w->d_of_constraint[i + NQ * k];
{jacobian,nonlinear}      for (int j = 0; j < NQ; ++j) r[i] += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
{jacobian,nonlinear}    }
{jacobian,nonlinear}    change_of_load(r, w->d_rows + NC * k, w->d_along + NC * k, w, d_lambda);
{jacobian,nonlinear}    solve_load(w, 1, d_lambda);
{jacobian,nonlinear}    for (int j = 0; j < NC; ++j) {
{jacobian,nonlinear}      for (int i = 0; i < NQ; ++i) {
{jacobian,nonlinear}        w->d_of_rest[i + NQ * k] += w->rest_slope[i + NQ * j] * d_lambda[j];
{jacobian,nonlinear}        w->d_force[i + NQ * k] += w->force_slope[i + NQ * j] * d_lambda[j];
{jacobian,nonlinear}      }
{jacobian,nonlinear}    }
{jacobian,nonlinear}  }
{jacobian,nonlinear}}
{jacobian,nonlinear}
{jacobian}/* dabar, d(M abar), dddq and d(A' lambda), those that the prediction needs */
{jacobian}static void differentiate_motion(workspace *w)
{jacobian}{
{jacobian,abar}  for (int i = 0; i < NQ * NX; ++i) w->d_a_bar[i] = w->d_force[i];
{jacobian,abar,forced}  solve_mass(w->C, NX, w->d_a_bar);
{jacobian,abar}  for (int i = 0; i < NQ * NX; ++i) w->d_a_bar[i] += w->d_of_rest[i];
{jacobian,applied}  for (int k = 0; k < NX; ++k) {
{jacobian,applied}    for (int i = 0; i < NQ; ++i) {
{jacobian,applied}      w->d_applied[i + NQ * k] += w->d_force[i + NQ * k];
{jacobian,applied}      for (int j = 0; j < NQ; ++j) w->d_applied[i + NQ * k] += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
{jacobian,applied}    }
{jacobian,applied}  }
{jacobian,reaction}  for (int k = 0; k < NX; ++k) {
{jacobian,reaction}    for (int i = 0; i < NQ; ++i) {
{jacobian,reaction}      real sum = w->d_force[i + NQ * k];
{jacobian,reaction}      for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
{jacobian,reaction}      w->d_mass_a_bar[i + NQ * k] = sum;
{jacobian,reaction}    }
{jacobian,reaction}  }
{jacobian,moved,rows}  for (int i = 0; i < NQ * NX; ++i) w->d_force[i] += w->d_forced[i] - w->d_of_constraint[i];
{jacobian,moved,!rows}  for (int i = 0; i < NQ * NX; ++i) w->d_force[i] -= w->d_of_constraint[i];
{jacobian,moved}  solve_mass(w->C, NX, w->d_force);
{jacobian,moved}  for (int i = 0; i < NQ * NX; ++i) w->d_of_rest[i] += w->d_force[i];
{jacobian,moved,!rows}  for (int i = 0; i < NQ * NX; ++i) w->d_a[i] = w->d_of_rest[i];
{jacobian,moved,rows}  for (int k = 0; k < NX; ++k) {
{jacobian,moved,rows}    for (int i = 0; i < NQ; ++i) {
{jacobian,moved,rows}      real sum = 0;
{jacobian,moved,rows}      for (int j = 0; j < NQ; ++j) sum += w->T[i + NQ * j] * w->d_of_rest[j + NQ * k];
{jacobian,moved,rows}      for (int j = 0; j < NC; ++j) sum += w->L[i + NQ * j] * w->row_scale[j] * w->d_rows[j + NC * k];
{jacobian,moved,rows}      w->d_a[i + NQ * k] = sum;
{jacobian,moved,rows}    }
{jacobian,moved,rows}  }
{jacobian,reaction}  for (int k = 0; k < NX; ++k) {
{jacobian,reaction}    for (int i = 0; i < NQ; ++i) {
{jacobian,reaction}      real sum = w->d_of_constraint[i + NQ * k] - w->d_mass_a_bar[i + NQ * k];
{jacobian,reaction}      for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->d_a[j + NQ * k];
{jacobian,reaction}      w->d_of_constraint[i + NQ * k] = sum;
{jacobian,reaction}    }
{jacobian,reaction}  }
{jacobian}}
{jacobian}
{jacobian}static status evaluate_with_jacobian(const component *c, const real *state, real *mean, real *jacobian, workspace *w)
{jacobian}{
{jacobian}  @system_and_derivatives@(c->parameters, state, w);
{jacobian}  const status s = evaluate_mean(c, state, mean, w);
{jacobian}  if (s != @name@_OK) return s;
{jacobian}  differentiate_prior(c, state, w);
{jacobian}  differentiate_mechanics(w);
{jacobian,nonlinear}  differentiate_load(w);
{jacobian}  differentiate_motion(w);
@dvalue@
{jacobian}  return is_finite(NR * NX, jacobian) ? @name@_OK : @name@_NOT_FINITE;
{jacobian}}
{jacobian}
{jacobian}status @name@_mean_and_jacobian(const real *state, real *mean, real *jacobian, workspace *w)
{jacobian}{
{jacobian,!mixture}  const status s = evaluate_with_jacobian(&components[0], state, mean, jacobian, w);
{jacobian,!mixture}  return s == @name@_OK ? s : failed(failed(s, NR, mean), NR * NX, jacobian);
{jacobian,mixture}  for (int r = 0; r < NR; ++r) mean[r] = 0;
{jacobian,mixture}  for (int i = 0; i < NR * NX; ++i) jacobian[i] = 0;
{jacobian,mixture}  for (int k = 0; k < COMPONENTS; ++k) {
{jacobian,mixture}    const status s = evaluate_with_jacobian(&components[k], state, w->mean, w->jacobian, w);
{jacobian,mixture}    if (s != @name@_OK) return failed(failed(s, NR, mean), NR * NX, jacobian);
{jacobian,mixture}    for (int r = 0; r < NR; ++r) mean[r] += w->mean[r] / COMPONENTS;
{jacobian,mixture}    for (int i = 0; i < NR * NX; ++i) jacobian[i] += w->jacobian[i] / COMPONENTS;
{jacobian,mixture}  }
{jacobian,mixture}  return @name@_OK;
{jacobian}}

/* ---------------------------------------------------------------- self test */

static int agree(int n, const real *is, const real *should, real error)
{
  for (int i = 0; i < n; ++i) {
    if (!(fabs(is[i] - should[i]) <= error)) return 0;
  }
  return 1;
}

int @name@_self_test(workspace *w)
{
  enum { TESTS = @n_tests@ };
  static const struct {
    real state[NX], mean[NR];
{stddev}    real variance[NR];
{jacobian}    real jacobian[NR * NX];
    real mean_error; /* what rounding may make of each */
{stddev}    real variance_error;
{jacobian}    real jacobian_error;
  } tests[TESTS] = {
@tests@  };
{portable}  if (products_are_fused()) return -1;
  for (int k = 0; k < TESTS; ++k) {
    real mean[NR];
    if (@name@_mean(tests[k].state, mean, w) != @name@_OK || !agree(NR, mean, tests[k].mean, tests[k].mean_error)) {
      return k + 1;
    }
{stddev}    real stddev[NR];
{stddev}    if (@name@_mean_and_stddev(tests[k].state, mean, stddev, w) != @name@_OK) return k + 1;
{stddev}    for (int r = 0; r < NR; ++r) stddev[r] *= stddev[r];
{stddev}    if (!agree(NR, stddev, tests[k].variance, tests[k].variance_error)) return k + 1;
{jacobian}    real jacobian[NR * NX];
{jacobian}    if (@name@_mean_and_jacobian(tests[k].state, mean, jacobian, w) != @name@_OK ||
{jacobian}        !agree(NR * NX, jacobian, tests[k].jacobian, tests[k].jacobian_error)) {
{jacobian}      return k + 1;
{jacobian}    }
  }
  return 0;
}
)c";

}  // namespace gp2::c_export
