#pragma once

#include <string_view>

// Frames around the exported C, in the form of fill_template.hpp. Conditions: stddev, jacobian, inputs, timed.
namespace gp2::c_export {

// What CasADi looks for by the name of a function.
inline constexpr std::string_view casadi_declarations =
    R"c(int @function@(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem);
casadi_int @function@_n_in(void);
casadi_int @function@_n_out(void);
const char *@function@_name_in(casadi_int i);
const char *@function@_name_out(casadi_int i);
const casadi_int *@function@_sparsity_in(casadi_int i);
const casadi_int *@function@_sparsity_out(casadi_int i);
int @function@_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w);
)c";

inline constexpr std::string_view casadi_template = R"c(/* @name@ as functions of CasADi (3.6 and later):
 *
{jacobian} *     @name@(q, dq, t, u) -> mean, with its exact Jacobian
{!jacobian} *     @name@(q, dq, t, u) -> mean
{stddev} *     @name@_std(q, dq, t, u) -> mean, std: it has no derivatives, and CasADi says so where they are asked for
 *
 *     cc -O2 -fPIC -shared @name@.c @name@_casadi.c -o lib@name@.so -lm
 *     f = casadi.external("@name@", "./lib@name@.so")
 */
#include "@name@.h"

#ifndef casadi_real
#define casadi_real double
#endif
#ifndef casadi_int
#define casadi_int long long int
#endif

enum {
  NQ = @nq@, /* coordinates */
  NU = @nu@, /* inputs */
  NX = @n_state@, /* numbers of a state, [q; dq; t; u] */
  NR = @n_rows@, /* rows of the prediction */
  WORK = sizeof(@name@_workspace) / sizeof(casadi_real) + 1
};

/* Patterns are {rows, columns, where each column begins, row of each entry}. */
static const casadi_int of_coordinates[] = {@pattern_q@};
static const casadi_int of_time[] = {@pattern_t@};
static const casadi_int of_inputs[] = {@pattern_u@};
static const casadi_int of_rows[] = {@pattern_rows@};

static const casadi_int *const patterns_in[] = {of_coordinates, of_coordinates, of_time, of_inputs};
static const char *const names_in[] = {"q", "dq", "t", "u"};

/* A null pointer stands for zeros. */
static void read_state(const casadi_real **arg, casadi_real *state)
{
  for (int i = 0; i < NQ; ++i) {
    state[i] = arg[0] ? arg[0][i] : 0;
    state[NQ + i] = arg[1] ? arg[1][i] : 0;
  }
  state[2 * NQ] = arg[2] ? arg[2][0] : 0;
{inputs}  for (int k = 0; k < NU; ++k) state[2 * NQ + 1 + k] = arg[3] ? arg[3][k] : 0;
}

static int set_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w, casadi_int n_in, casadi_int n_out,
    casadi_int n_w)
{
  if (sz_arg) *sz_arg = n_in;
  if (sz_res) *sz_res = n_out;
  if (sz_iw) *sz_iw = 0;
  if (sz_w) *sz_w = n_w;
  return 0;
}

/* ---------------------------------------------------------------- @name@ */

@declarations@

int @name@(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem)
{
  casadi_real state[NX];
  (void)iw;
  (void)mem;
  if (!res[0]) return 0;
  read_state(arg, state);
  return @name@_mean(state, res[0], (@name@_workspace *)(void *)w) != @name@_OK;
}

casadi_int @name@_n_in(void) { return 4; }
casadi_int @name@_n_out(void) { return 1; }
const char *@name@_name_in(casadi_int i) { return i >= 0 && i < 4 ? names_in[i] : 0; }
const char *@name@_name_out(casadi_int i) { return i == 0 ? "mean" : 0; }
const casadi_int *@name@_sparsity_in(casadi_int i) { return i >= 0 && i < 4 ? patterns_in[i] : 0; }
const casadi_int *@name@_sparsity_out(casadi_int i) { return i == 0 ? of_rows : 0; }
int @name@_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w)
{
  return set_work(sz_arg, sz_res, sz_iw, sz_w, 4, 1, WORK);
}
{if jacobian}

/* ---------------------------------------------------------------- jac_@name@(q, dq, t, u, out_mean) */

static const casadi_int of_nothing[] = {@pattern_nothing@};
static const casadi_int rows_by_coordinates[] = {@pattern_rows_q@};
static const casadi_int rows_by_time[] = {@pattern_rows_t@};
static const casadi_int rows_by_inputs[] = {@pattern_rows_u@};

@declarations_jac@

int jac_@name@(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem)
{
  static const int first[] = {0, NQ, 2 * NQ, 2 * NQ + 1, NX}; /* columns of the Jacobian in each block */
  casadi_real state[NX], mean[NR];
  casadi_real *const jacobian = w + WORK;
  (void)iw;
  (void)mem;
  if (!res[0] && !res[1] && !res[2] && !res[3]) return 0;
  read_state(arg, state);
  if (@name@_mean_and_jacobian(state, mean, jacobian, (@name@_workspace *)(void *)w) != @name@_OK) return 1;
  for (int block = 0; block < 4; ++block) {
    if (!res[block]) continue;
    for (int i = NR * first[block]; i < NR * first[block + 1]; ++i) res[block][i - NR * first[block]] = jacobian[i];
  }
  return 0;
}

casadi_int jac_@name@_n_in(void) { return 5; }
casadi_int jac_@name@_n_out(void) { return 4; }
const char *jac_@name@_name_in(casadi_int i) { return i == 4 ? "out_mean" : @name@_name_in(i); }
const char *jac_@name@_name_out(casadi_int i)
{
  static const char *const names[] = {"jac_mean_q", "jac_mean_dq", "jac_mean_t", "jac_mean_u"};
  return i >= 0 && i < 4 ? names[i] : 0;
}
const casadi_int *jac_@name@_sparsity_in(casadi_int i) { return i == 4 ? of_nothing : @name@_sparsity_in(i); }
const casadi_int *jac_@name@_sparsity_out(casadi_int i)
{
  static const casadi_int *const patterns[] = {rows_by_coordinates, rows_by_coordinates, rows_by_time, rows_by_inputs};
  return i >= 0 && i < 4 ? patterns[i] : 0;
}
int jac_@name@_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w)
{
  return set_work(sz_arg, sz_res, sz_iw, sz_w, 5, 4, WORK + NR * NX);
}
{end}
{if stddev}

/* ---------------------------------------------------------------- @name@_std */

@declarations_std@

int @name@_std(const casadi_real **arg, casadi_real **res, casadi_int *iw, casadi_real *w, int mem)
{
  casadi_real state[NX], mean[NR], stddev[NR];
  (void)iw;
  (void)mem;
  if (!res[0] && !res[1]) return 0;
  read_state(arg, state);
  if (@name@_mean_and_stddev(state, mean, stddev, (@name@_workspace *)(void *)w) != @name@_OK) return 1;
  for (int r = 0; r < NR; ++r) {
    if (res[0]) res[0][r] = mean[r];
    if (res[1]) res[1][r] = stddev[r];
  }
  return 0;
}

casadi_int @name@_std_n_in(void) { return 4; }
casadi_int @name@_std_n_out(void) { return 2; }
const char *@name@_std_name_in(casadi_int i) { return @name@_name_in(i); }
const char *@name@_std_name_out(casadi_int i) { return i == 0 ? "mean" : i == 1 ? "std" : 0; }
const casadi_int *@name@_std_sparsity_in(casadi_int i) { return @name@_sparsity_in(i); }
const casadi_int *@name@_std_sparsity_out(casadi_int i) { return i == 0 || i == 1 ? of_rows : 0; }
int @name@_std_work(casadi_int *sz_arg, casadi_int *sz_res, casadi_int *sz_iw, casadi_int *sz_w)
{
  return set_work(sz_arg, sz_res, sz_iw, sz_w, 4, 2, WORK);
}
{end}
)c";

inline constexpr std::string_view acados_template = R"c(
/* ================================================================ acados
 *
 * The discrete dynamics of acados, x = [q; dq] after a step of @time_step@ s by the classical method of Runge and Kutta, u held, and
 * its exact sensitivities:
 *
 *     model.dyn_ext_fun_type = "generic"
 *     model.dyn_generic_source = "@name@_acados.c"
 *     model.dyn_disc_fun = "@name@_disc_fun"
 *     model.dyn_disc_fun_jac = "@name@_disc_fun_jac"
 *     solver_options.integrator_type = "DISCRETE", solver_options.hessian_approx = "GAUSS_NEWTON"
 *
{timed} * The time t at the beginning of a stage is its parameter p[0].
 * Steps of the solver must be of that length. Where a state has no prediction the next one is NaN.
 */
#include "acados/utils/external_function_generic.h"
#include "blasfeo_d_aux.h"

enum { NU = @nu@, NV = 2 * NQ, NZ = NU + NV }; /* inputs, numbers of x, of [u; x] */

int @name@_disc_fun(void **in, void **out, void *params);
int @name@_disc_fun_jac(void **in, void **out, void *params);

/* x after a step, to `next`; where S is not null its derivative in [u; x] (NV x NZ), column by column */
static void step(const double *x, const double *u, double t, double *next, double *S)
{
  static const double at[4] = {0, 0.5, 0.5, 1}, weight[4] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
  const double h = @time_step@;
  workspace w;
  double state[NX], rate[NV] = {0}, of_rate[NV * NZ] = {0}, ddq[NQ], jacobian[NQ * NX];
  for (int i = 0; i < NV; ++i) next[i] = x[i];
  for (int i = 0; S && i < NV * NZ; ++i) S[i] = i / NV == NU + i % NV; /* [0 I] */
  for (int stage = 0; stage < 4; ++stage) {
    double of_state[NV * NZ];
    for (int i = 0; i < NV; ++i) state[i] = x[i] + h * at[stage] * rate[i];
    state[NV] = t + h * at[stage];
    for (int k = 0; k < NU; ++k) state[NV + 1 + k] = u[k];
    if (S) {
      @name@_mean_and_jacobian(state, ddq, jacobian, &w);
    } else {
      @name@_mean(state, ddq, &w);
    }
    for (int i = 0; i < NQ; ++i) {
      rate[i] = state[NQ + i];
      rate[NQ + i] = ddq[i];
    }
    for (int i = 0; i < NV; ++i) next[i] += h * weight[stage] * rate[i];
    if (!S) continue;
    for (int k = 0; k < NZ; ++k) {
      for (int i = 0; i < NV; ++i) of_state[i + NV * k] = (k == NU + i) + h * at[stage] * of_rate[i + NV * k];
      for (int i = 0; i < NQ; ++i) {
        double sum = k < NU ? jacobian[i + NQ * (NV + 1 + k)] : 0;
        for (int j = 0; j < NV; ++j) sum += jacobian[i + NQ * j] * of_state[j + NV * k];
        of_rate[i + NV * k] = of_state[NQ + i + NV * k];
        of_rate[NQ + i + NV * k] = sum;
      }
      for (int i = 0; i < NV; ++i) S[i + NV * k] += h * weight[stage] * of_rate[i + NV * k];
    }
  }
}

static void read_arguments(void **in, const void *params, double *x, double *u, double *t)
{
  const struct blasfeo_dvec_args *const x_in = in[0], *const u_in = in[1];
  for (int i = 0; i < NV; ++i) x[i] = BLASFEO_DVECEL(x_in->x, x_in->xi + i);
  for (int k = 0; k < NU; ++k) u[k] = BLASFEO_DVECEL(u_in->x, u_in->xi + k);
{timed}  *t = ((const double *)params)[0];
{!timed}  (void)params;
{!timed}  *t = 0;
}

int @name@_disc_fun(void **in, void **out, void *params)
{
  double x[NV], u[NU + 1], t, next[NV];
  const struct blasfeo_dvec_args *const phi = out[0];
  read_arguments(in, params, x, u, &t);
  step(x, u, t, next, 0);
  blasfeo_pack_dvec(NV, next, 1, phi->x, phi->xi);
  return 0;
}

int @name@_disc_fun_jac(void **in, void **out, void *params)
{
  double x[NV], u[NU + 1], t, next[NV], S[NV * NZ];
  const struct blasfeo_dvec_args *const phi = out[0];
  const struct blasfeo_dmat_args *const of_phi = out[1]; /* rows u, then x */
  read_arguments(in, params, x, u, &t);
  step(x, u, t, next, S);
  blasfeo_pack_dvec(NV, next, 1, phi->x, phi->xi);
  blasfeo_pack_tran_dmat(NV, NZ, S, NV, of_phi->A, of_phi->ai, of_phi->aj);
  return 0;
}
)c";

}  // namespace gp2::c_export
