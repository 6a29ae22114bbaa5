/* Model predictive control at 1 kHz around the C that gp2 exports, for a machine without gp2: a unicycle drives a figure eight
 * by what was learned of its friction, and beside it by its known mechanics alone.
 *
 *     gp2 export fit.json --name unicycle --no-std -o .
 *     cc -std=c99 -O3 main.c unicycle.c -lm -o exported_loop && ./exported_loop
 *
 * fit.json is a fit of models/unicycle.toml. Each cycle takes one step of iLQR, the real-time iteration: the motion over the
 * horizon under the inputs found in the cycle before, its exact linearisation by the exported Jacobian, and the inputs that are
 * best for it by a Riccati recursion. The machine is simulated here; on a real one, read its state instead.
 *
 * The constraint is that the wheel does not slip, so the motion is one of five numbers: x = [q1, q2, q3, v, w] with
 * dq = [v cos q3, v sin q3, w].
 */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "unicycle.h"

enum { Q1, Q2, Q3, V, W, NX };                                          /* the state x */
enum { FORCE, TORQUE, NU };                                             /* the input u: along the heading [N], about the vertical [N m] */
enum { S_Q3 = 2, S_DQ1 = 3, S_DQ2 = 4, S_DQ3 = 5, S_U1 = 7, S_U2 = 8 }; /* entries of the state in unicycle.h */
enum { NODES = 20, CYCLES = 18000 };                                    /* of the horizon; of the loop: one figure eight */

static const double period = 1e-3, step = 0.025; /* of the loop and of the horizon [s] */
static const double m = 1.0, R = 0.05, Ic = 0.02; /* of models/unicycle.toml */
static const double error_weight[NX] = {100, 100, 1, 1, 0.1}, input_weight[NU] = {1e-2, 1e-2}, limit[NU] = {2, 0.5};

static unicycle_workspace memory;

/* The derivative f of x, and its Jacobian J in [x; u]. */
typedef int model(const double *x, const double *u, double f[NX], double J[NX][NX + NU]);

static void kinematics(const double *x, double f[NX], double J[NX][NX + NU])
{
  const double c = cos(x[Q3]), s = sin(x[Q3]);
  for (int i = 0; i < NX; ++i) {
    for (int j = 0; j < NX + NU; ++j) J[i][j] = 0;
  }
  f[Q1] = x[V] * c, f[Q2] = x[V] * s, f[Q3] = x[W];
  J[Q1][Q3] = -x[V] * s, J[Q1][V] = c;
  J[Q2][Q3] = x[V] * c, J[Q2][V] = s;
  J[Q3][W] = 1;
}

/* What is known without a fit: m (dv - R w^2) = u1 and Ic dw + m R v w = u2. */
static int known(const double *x, const double *u, double f[NX], double J[NX][NX + NU])
{
  kinematics(x, f, J);
  f[V] = u[FORCE] / m + R * x[W] * x[W];
  f[W] = (u[TORQUE] - m * R * x[V] * x[W]) / Ic;
  J[V][W] = 2 * R * x[W], J[V][NX + FORCE] = 1 / m;
  J[W][V] = -m * R * x[W] / Ic, J[W][W] = -m * R * x[V] / Ic, J[W][NX + TORQUE] = 1 / Ic;
  return 0;
}

/* What the fit knows: dv = [cos q3, sin q3, 0] ddq and dw = ddq3, by the chain rule through dq(x). */
static int learned(const double *x, const double *u, double f[NX], double J[NX][NX + NU])
{
  const double c = cos(x[Q3]), s = sin(x[Q3]);
  double state[unicycle_STATE_SIZE] = {x[Q1], x[Q2], x[Q3], x[V] * c, x[V] * s, x[W], 0, u[FORCE], u[TORQUE]};
  double ddq[unicycle_ROWS], d[unicycle_STATE_SIZE][unicycle_ROWS]; /* d[k][r]: of ddq[r] in state[k] */
  if (unicycle_mean_and_jacobian(state, ddq, d[0], &memory) != unicycle_OK) return 1;
  kinematics(x, f, J);
  f[V] = c * ddq[0] + s * ddq[1];
  f[W] = ddq[2];
  J[V][Q3] = c * ddq[1] - s * ddq[0]; /* of the heading on which ddq is projected */
  for (int row = V; row <= W; ++row) {
    double by[unicycle_STATE_SIZE];
    for (int k = 0; k < unicycle_STATE_SIZE; ++k) by[k] = row == V ? c * d[k][0] + s * d[k][1] : d[k][2];
    J[row][Q3] += by[S_Q3] + x[V] * (c * by[S_DQ2] - s * by[S_DQ1]);
    J[row][V] = c * by[S_DQ1] + s * by[S_DQ2];
    J[row][W] = by[S_DQ3];
    J[row][NX + FORCE] = by[S_U1], J[row][NX + TORQUE] = by[S_U2];
  }
  return 0;
}

/* The path r(t) = [a sin p, a/2 sin 2p], p = 0.35 t, as the state of a unicycle that is on it. */
static void reference(double t, double x[NX])
{
  const double a = 2, rate = 0.35, p = rate * t;
  const double dx = a * rate * cos(p), dy = a * rate * cos(2 * p);
  const double ddx = -a * rate * rate * sin(p), ddy = -2 * a * rate * rate * sin(2 * p);
  x[Q1] = a * sin(p), x[Q2] = a / 2 * sin(2 * p);
  x[Q3] = atan2(dy, dx);
  x[V] = hypot(dx, dy);
  x[W] = (dx * ddy - dy * ddx) / (dx * dx + dy * dy);
}

/* The midpoint rule from x to `next`, with its derivative D in [x; u]. */
static int advance(model *f, const double *x, const double *u, double next[NX], double D[NX][NX + NU])
{
  double rate[NX], J[NX][NX + NU], middle[NX], Jm[NX][NX + NU];
  if (f(x, u, rate, J)) return 1;
  for (int i = 0; i < NX; ++i) middle[i] = x[i] + step / 2 * rate[i];
  if (f(middle, u, rate, Jm)) return 1;
  for (int i = 0; i < NX; ++i) {
    next[i] = x[i] + step * rate[i];
    for (int j = 0; j < NX + NU; ++j) {
      double sum = Jm[i][j];
      for (int k = 0; k < NX; ++k) sum += step / 2 * Jm[i][k] * J[k][j];
      D[i][j] = (i == j) + step * sum;
    }
  }
  return 0;
}

/* One step of iLQR: improves the inputs over the horizon that begins at x and at t. */
static int improve(model *f, double t, const double *x, double inputs[NODES][NU])
{
  static double D[NODES][NX][NX + NU], error[NODES + 1][NX], gain[NODES][NU][NX + 1]; /* the best change of u is gain [z; 1] */
  double node[NX], P[NX][NX] = {{0}}, p[NX]; /* the cost to go is z'P z/2 + p'z of a change z of the state */

  /* forwards: the motion, its linearisation and its errors */
  for (int i = 0; i < NX; ++i) node[i] = x[i];
  for (int k = 0; k <= NODES; ++k) {
    double wanted[NX];
    reference(t + k * step, wanted);
    for (int i = 0; i < NX; ++i) error[k][i] = node[i] - wanted[i];
    error[k][Q3] = remainder(error[k][Q3], 2 * acos(-1));
    if (k < NODES && advance(f, node, inputs[k], node, D[k])) return 1;
  }

  /* backwards: H = D'P D + weights, h = D'p + their gradient; its part in u is solved for */
  for (int i = 0; i < NX; ++i) P[i][i] = error_weight[i], p[i] = error_weight[i] * error[NODES][i];
  for (int k = NODES - 1; k >= 0; --k) {
    double PD[NX][NX + NU], H[NX + NU][NX + NU], h[NX + NU];
    for (int i = 0; i < NX; ++i) {
      for (int j = 0; j < NX + NU; ++j) {
        PD[i][j] = 0;
        for (int l = 0; l < NX; ++l) PD[i][j] += P[i][l] * D[k][l][j];
      }
    }
    for (int i = 0; i < NX + NU; ++i) {
      h[i] = i < NX ? error_weight[i] * error[k][i] : input_weight[i - NX] * inputs[k][i - NX];
      for (int l = 0; l < NX; ++l) h[i] += D[k][l][i] * p[l];
      for (int j = 0; j < NX + NU; ++j) {
        H[i][j] = i != j ? 0 : i < NX ? error_weight[i] : input_weight[i - NX];
        for (int l = 0; l < NX; ++l) H[i][j] += D[k][l][i] * PD[l][j];
      }
    }
    const double a = H[NX][NX], b = H[NX][NX + 1], c = H[NX + 1][NX + 1], scale = -1 / (a * c - b * b);
    for (int j = 0; j <= NX; ++j) {
      const double g0 = j < NX ? H[NX][j] : h[NX], g1 = j < NX ? H[NX + 1][j] : h[NX + 1];
      gain[k][0][j] = scale * (c * g0 - b * g1);
      gain[k][1][j] = scale * (a * g1 - b * g0);
    }
    for (int i = 0; i < NX; ++i) {
      p[i] = h[i] + H[i][NX] * gain[k][0][NX] + H[i][NX + 1] * gain[k][1][NX];
      for (int j = 0; j < NX; ++j) P[i][j] = H[i][j] + H[i][NX] * gain[k][0][j] + H[i][NX + 1] * gain[k][1][j];
    }
  }

  /* forwards: the linear motion under the best change of the inputs */
  double z[NX] = {0};
  for (int k = 0; k < NODES; ++k) {
    double du[NU], next[NX] = {0};
    for (int r = 0; r < NU; ++r) {
      du[r] = gain[k][r][NX];
      for (int j = 0; j < NX; ++j) du[r] += gain[k][r][j] * z[j];
      const double u = fmin(fmax(inputs[k][r] + du[r], -limit[r]), limit[r]);
      du[r] = u - inputs[k][r], inputs[k][r] = u;
    }
    for (int i = 0; i < NX; ++i) {
      for (int j = 0; j < NX + NU; ++j) next[i] += D[k][i][j] * (j < NX ? z[j] : du[j - NX]);
    }
    for (int i = 0; i < NX; ++i) z[i] = next[i];
  }
  return 0;
}

/* The machine: its wheel has friction, an acceleration of -v|v|/2 that `known` does not have. */
static void drive(double x[NX], const double *u)
{
  double f[NX], J[NX][NX + NU];
  for (int part = 0; part < 2; ++part) {
    double middle[NX];
    known(x, u, f, J);
    f[V] -= 0.5 * x[V] * fabs(x[V]);
    for (int i = 0; i < NX; ++i) middle[i] = x[i] + period / 4 * f[i];
    known(middle, u, f, J);
    f[V] -= 0.5 * middle[V] * fabs(middle[V]);
    for (int i = 0; i < NX; ++i) x[i] += period / 2 * f[i];
  }
}

/* One figure eight; its root mean square distance from where the unicycle should be [m], -1 where the fit has no prediction. */
static double follow(model *f, const char *name)
{
  double x[NX], inputs[NODES][NU] = {{0}}, squares = 0, largest = 0, busy = 0, longest = 0;
  reference(0, x);
  for (int cycle = 0; cycle < CYCLES; ++cycle) {
    const double t = cycle * period;
    const clock_t start = clock();
    if (improve(f, t, x, inputs)) return -1;
    const double used = (double)(clock() - start) / CLOCKS_PER_SEC;
    busy += used, longest = fmax(longest, used);
    drive(x, inputs[0]);

    double wanted[NX];
    reference(t + period, wanted);
    const double distance = hypot(x[Q1] - wanted[Q1], x[Q2] - wanted[Q2]);
    squares += distance * distance, largest = fmax(largest, distance);
  }
  const double error = sqrt(squares / CYCLES);
  printf("%-8s error %7.3f mm, at most %7.3f mm; %6.1f us a step, at most %6.1f us\n", name, 1e3 * error, 1e3 * largest,
         1e6 * busy / CYCLES, 1e6 * longest);
  return error;
}

int main(void)
{
  if (unicycle_self_test(&memory) != 0) {
    fprintf(stderr, "exported_loop: the compiled model does not predict what gp2 did\n");
    return 1;
  }
  const double without = follow(known, "known"), with = follow(learned, "learned");
  return with >= 0 && with < without ? 0 : 1;
}
