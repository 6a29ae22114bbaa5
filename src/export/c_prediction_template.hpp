#pragma once

#include <string_view>

// The second half of NAME.c: the mean, its deviation and its Jacobian. The form is that of fill_template.hpp, the conditions are
// those of c_writer.cpp.
namespace gp2::c_export {

inline constexpr std::string_view prediction_template =
    R"c({if nonlinear}
/* ---------------------------------------------------------------- multipliers that forces read which they make
 *
 * lambda = G abar(lambda) + d, G = -(A M^-1 A')^+ A, d = (A M^-1 A')^+ b, by Newton's method; w->y is the state and lambda.
 */

/* abar at this lambda, and J, its slope there */
static void evaluate_load(const component *c, workspace *w)
{
  for (int i = 0; i < NQ; ++i) w->rest_of_load[i] = w->force_of_load[i] = 0;
  for (int i = 0; i < NQ * NC; ++i) w->rest_slope[i] = w->force_slope[i] = 0;
@under_load@
  for (int i = 0; i < NQ; ++i) w->a_under_load[i] = w->force_of_load[i];
  for (int i = 0; i < NQ * NC; ++i) w->slope[i] = w->force_slope[i];
  solve_mass(w->C, 1, w->a_under_load);
  solve_mass(w->C, NC, w->slope);
  for (int i = 0; i < NQ; ++i) w->a_under_load[i] += w->without_load[i] + w->rest_of_load[i];
  for (int i = 0; i < NQ * NC; ++i) w->slope[i] += w->rest_slope[i];
}

/* D = I - share G J to its triangles, rows exchanged by order_lambda. Returns its determinant. */
static real factorise_load(real share, workspace *w)
{
  real *const D = w->D_lambda, determinant = 1;
  for (int j = 0; j < NC; ++j) {
    for (int k = 0; k < NC; ++k) {
      real sum = 0;
      for (int i = 0; i < NQ; ++i) sum += w->G_lambda[k + NC * i] * w->slope[i + NQ * j];
      D[k + NC * j] = (k == j) - share * sum;
    }
  }
  for (int k = 0; k < NC; ++k) {
    int pivot = k;
    for (int i = k + 1; i < NC; ++i) {
      if (fabs(D[i + NC * k]) > fabs(D[pivot + NC * k])) pivot = i;
    }
    w->order_lambda[k] = pivot;
    if (pivot != k) determinant = -determinant;
    for (int j = 0; pivot != k && j < NC; ++j) {
      const real entry = D[k + NC * j];
      D[k + NC * j] = D[pivot + NC * j];
      D[pivot + NC * j] = entry;
    }
    determinant *= D[k + NC * k];
    for (int i = k + 1; i < NC; ++i) {
      D[i + NC * k] /= D[k + NC * k];
      for (int j = k + 1; j < NC; ++j) D[i + NC * j] -= D[i + NC * k] * D[k + NC * j];
    }
  }
  return determinant;
}

/* X := D^-1 X, n columns */
static void solve_load(const workspace *w, int n, real *X)
{
  const real *const D = w->D_lambda;
  for (int column = 0; column < n; ++column) {
    real *const x = X + NC * column;
    for (int k = 0; k < NC; ++k) {
      const real entry = x[w->order_lambda[k]];
      x[w->order_lambda[k]] = x[k];
      x[k] = entry;
    }
    for (int k = 0; k < NC; ++k) {
      for (int i = k + 1; i < NC; ++i) x[i] -= D[i + NC * k] * x[k];
    }
    for (int k = NC - 1; k >= 0; --k) {
      x[k] /= D[k + NC * k];
      for (int i = 0; i < k; ++i) x[i] -= D[i + NC * k] * x[k];
    }
  }
}

/* Newton's method where only a share of what the load adds acts. Returns whether it ended. */
static int reach_load(const component *c, real share, real size, workspace *w)
{
  real *const lambda = w->y + NX;
  real before = 0;
  for (int step = 0; step < 40; ++step) {
    evaluate_load(c, w);
    if (!is_finite(NQ, w->a_under_load) || !is_finite(NQ * NC, w->slope)) return 0;
    if (!(factorise_load(share, w) > 0)) return 0;
    real change[NC];
    for (int k = 0; k < NC; ++k) {
      change[k] = lambda[k] - w->d_lambda[k];
      for (int i = 0; i < NQ; ++i) {
        change[k] -= w->G_lambda[k + NC * i] * (w->a_at_zero[i] + share * (w->a_under_load[i] - w->a_at_zero[i]));
      }
    }
    const real rest = sqrt(dot(NC, change, change));
    solve_load(w, 1, change);
    for (int k = 0; k < NC; ++k) lambda[k] -= change[k];
    const real terms = size + sqrt(dot(NC, lambda, lambda)), enough = @newton@ * terms, moved = sqrt(dot(NC, change, change));
    /* large forces that cancel round more than lambda does: steps then stop getting smaller here */
    const int is_rounding = step > 0 && moved <= @newton_stops@ * terms && 2 * moved >= before;
    if (moved <= enough || rest <= enough / 10 || is_rounding) return is_finite(NC, lambda);
    before = moved;
  }
  return 0;
}

/* The load of the motion, let in at once or bit by bit. Returns 0 where it grows as fast as the force that it causes. */
static int find_load(const component *c, const real *state, workspace *w)
{
  real *const lambda = w->y + NX;
  multipliers_of_force(w);
  for (int j = 0; j <= NQ; ++j) { /* G = K (M T - mass), d = K M L b */
    real column[NQ], *const to = j < NQ ? w->G_lambda + NC * j : w->d_lambda;
    for (int i = 0; i < NQ; ++i) {
      column[i] = j < NQ ? -w->mass[i + NQ * j] : 0;
      for (int l = 0; l < NQ; ++l) column[i] += w->M[i + NQ * l] * (j < NQ ? w->T[l + NQ * j] : w->Lb[l]);
    }
    for (int k = 0; k < NC; ++k) {
      to[k] = 0;
      for (int i = 0; i < NQ; ++i) to[k] += w->K[k + NC * i] * column[i];
    }
  }
  for (int i = 0; i < NX; ++i) w->y[i] = state[i];
  for (int steps = 1; steps <= 16; steps += 15) {
    for (int k = 0; k < NC; ++k) lambda[k] = 0;
    evaluate_load(c, w);
    for (int i = 0; i < NQ; ++i) w->a_at_zero[i] = w->a_under_load[i];
    real size = 0; /* lambda is rounded as its terms are, which may cancel */
    for (int k = 0; k < NC; ++k) {
      lambda[k] = w->d_lambda[k];
      real terms = fabs(w->d_lambda[k]);
      for (int i = 0; i < NQ; ++i) {
        const real term = w->G_lambda[k + NC * i] * w->a_at_zero[i];
        lambda[k] += term;
        terms += fabs(term);
      }
      size += terms * terms;
    }
    size = sqrt(size);
    int step = 1;
    while (step <= steps && reach_load(c, (real)step / (real)steps, size, w)) ++step;
    if (step > steps) return 1;
  }
  return 0;
}

{end}
/* ---------------------------------------------------------------- mean */

/* abar = mu + sum E C f of the latents' means; `force` is what of it is multiplied by M^-1 */
static status evaluate_prior(const component *c, const real *state, workspace *w)
{
{constant}  static const real mu[NQ] = {@mu@};
  for (int i = 0; i < NQ; ++i) {
{constant}    w->a_bar[i] = @of_whole@mu[i];
{!constant}    w->a_bar[i] = 0;
{known}    w->force[i] = @of_whole@w->F[i];
{!known}    w->force[i] = 0;
  }
{load}  known_multipliers(state, w);
@signals@
{if nonlinear}
  for (int i = 0; i < NQ; ++i) w->without_load[i] = w->force[i];
  solve_mass(w->C, 1, w->without_load);
  for (int i = 0; i < NQ; ++i) w->without_load[i] += w->a_bar[i];
{!partial}  if (!find_load(c, state, w)) return @name@_NOT_FINITE;
{partial}  if (!w->is_part && !find_load(c, state, w)) return @name@_NOT_FINITE;
  evaluate_load(c, w);
  for (int i = 0; i < NQ; ++i) {
    w->force[i] += w->force_of_load[i];
    w->a_bar[i] += w->rest_of_load[i];
  }
{end}
  for (int i = 0; i < NQ; ++i) w->a_of_force[i] = w->force[i];
{forced}  solve_mass(w->C, 1, w->a_of_force);
{forced}  for (int i = 0; i < NQ; ++i) w->a_bar[i] += w->a_of_force[i];
  return is_finite(NQ, w->a_bar) ? @name@_OK : @name@_NOT_FINITE;
}
{if applied}

/* the applied force M abar */
static void evaluate_applied_force(workspace *w)
{
  for (int i = 0; i < NQ; ++i) {
    w->applied[i] = w->force[i];
    for (int j = 0; j < NQ; ++j) w->applied[i] += w->M[i + NQ * j] * (w->a_bar[j] - w->a_of_force[j]);
  }
}
{end}
{if moved}

/* ddq, and the force A' lambda = M (ddq - abar) of the constraints */
static void evaluate_motion(workspace *w)
{
{rows}  constrain(w);
{!rows}  for (int i = 0; i < NQ; ++i) w->a[i] = w->a_bar[i];
  for (int i = 0; i < NQ; ++i) w->gap[i] = w->a[i] - w->a_bar[i];
  for (int i = 0; i < NQ; ++i) {
    real sum = -w->force[i];
    for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->gap[j];
    for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->a_of_force[j];
    w->of_constraint[i] = sum;
  }
}
{end}

/* What the mean needs after the mechanics at a state stand in the workspace. */
static status start(@start_parameters@)
{
{admissible}  project_admissible(w);
{!partial}  return project(w);
{if partial}
  status s = project(w);
  w->is_part = 0; /* the load is that of the whole motion */
  if (s == @name@_OK) s = evaluate_prior(c, state, w);
{by_load}  for (int i = 0; i < NQ * NC; ++i) w->whole_slope[i] = w->slope[i];
  return s;
{end}
}

static status evaluate_mean(const component *c, const real *state, real *mean, workspace *w)
{
{partial}  w->is_part = 1;
  status s = evaluate_prior(c, state, w);
  if (s == @name@_OK) {
{moved}    evaluate_motion(w);
{applied}    evaluate_applied_force(w);
{constrained}    for (int r = 0; r < NR; ++r) mean[r] = w->a[@r@];
{unconstrained}    for (int r = 0; r < NR; ++r) mean[r] = w->a_bar[@r@];
{force}    for (int r = 0; r < NR; ++r) mean[r] = w->applied[@r@];
{next-velocity,has_mean}    for (int r = 0; r < NR; ++r) mean[r] = state[NQ + @r@] + @dt@ * w->a[@r@];
{next-velocity,!has_mean}    for (int r = 0; r < NR; ++r) mean[r] = @dt@ * w->a[@r@];
{constraint-force}    for (int r = 0; r < NR; ++r) mean[r] = w->of_constraint[@r@];
{if multipliers}
    multipliers_of_force(w);
    for (int i = 0; i < NC; ++i) {
      w->lambda[i] = 0;
      for (int j = 0; j < NQ; ++j) w->lambda[i] += w->K[i + NC * j] * w->of_constraint[j];
    }
    for (int r = 0; r < NR; ++r) mean[r] = w->lambda[@r@];
{end}
    if (!is_finite(NR, mean)) s = @name@_NOT_FINITE;
  }
  return s;
}

static status evaluate(const component *c, const real *state, real *mean, workspace *w)
{
  evaluate_system(c->parameters, state, w);
  const status s = start(@start_arguments@);
  return s == @name@_OK ? evaluate_mean(c, state, mean, w) : s;
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
{if mixture}
  for (int r = 0; r < NR; ++r) mean[r] = 0;
  for (int k = 0; k < COMPONENTS; ++k) {
    const status s = evaluate(&components[k], state, w->mean, w);
    if (s != @name@_OK) return failed(s, NR, mean);
    for (int r = 0; r < NR; ++r) mean[r] += w->mean[r] / COMPONENTS;
  }
  return @name@_OK;
{end}
}
{if stddev}

/* ---------------------------------------------------------------- standard deviation */

{if potential}
/* products_j += the rows of gradients at point j, times their covariance with what is predicted */
static void add_gradient_products(const latent *a, int d, int row, const real *gradient, real *products)
{
  for (int f = 0; f < d; ++f) {
    const real *const rows = a->rows + a->n * (d * row + f);
    for (int j = 0; j < a->n; ++j) products[j] += gradient[a->n * f + j] * rows[j];
  }
}

{end}
{if !by_function,other}
/* products_j += k_j times the rows of functions at point j, times their loading */
static void add_products(const latent *a, int n_functions, int row, const real *k, const real *loading, real *products)
{
  for (int f = 0; f < n_functions; ++f) {
    const real *const rows = a->rows + a->n * (n_functions * row + f);
    for (int j = 0; j < a->n; ++j) products[j] += k[j] * rows[j] * loading[f];
  }
}

{end}
/* G of the view, transposed (NQ x NR): the prediction is G abar + d */
static void evaluate_view(workspace *w)
{
{!constraint-force,!multipliers}  for (int r = 0; r < NR; ++r) {
{constraint-force}  for (int r = 0; r < NR; ++r) { /* M T - M */
{multipliers}  for (int r = 0; r < NR; ++r) { /* K (M T - M) */
{constrained,rows}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = w->T[@r@ + NQ * j];
{constrained,!rows}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = (@r@ == j);
{unconstrained}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = (@r@ == j);
{force}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = w->mass[@r@ + NQ * j];
{next-velocity,rows}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = @dt@ * w->T[@r@ + NQ * j];
{next-velocity,!rows}    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = @dt@ * (@r@ == j);
{if constraint-force}
    for (int j = 0; j < NQ; ++j) {
      real sum = -w->mass[@r@ + NQ * j];
{rows}      for (int i = 0; i < NQ; ++i) sum += w->M[@r@ + NQ * i] * w->T[i + NQ * j];
{!rows}      for (int i = 0; i < NQ; ++i) sum += w->M[@r@ + NQ * i] * (i == j);
      w->Gt[j + NQ * r] = sum;
    }
{end}
{if multipliers}
    for (int j = 0; j < NQ; ++j) {
      real product = 0;
      for (int l = 0; l < NQ; ++l) {
        real sum = -w->mass[l + NQ * j];
        for (int i = 0; i < NQ; ++i) sum += w->M[l + NQ * i] * w->T[i + NQ * j];
        product += w->K[@r@ + NC * l] * sum;
      }
      w->Gt[j + NQ * r] = product;
    }
{end}
  }
{if answers}
{responds}  /* G (I + J D^-1 G_lambda): lambda answers */
{by_load}  /* G J D^-1 G_lambda of every latent, J of the part and D of the whole: lambda answers */
  real answer[NC * NQ];
  for (int i = 0; i < NC * NQ; ++i) answer[i] = w->G_lambda[i];
{if by_load}
  real of_part[NC * NQ];
  for (int i = 0; i < NC * NQ; ++i) {
    of_part[i] = w->slope[i];
    w->slope[i] = w->whole_slope[i];
  }
{end}
  (void)factorise_load(1, w);
  solve_load(w, NQ, answer);
{by_load}  for (int i = 0; i < NC * NQ; ++i) w->slope[i] = of_part[i];
  for (int r = 0; r < NR; ++r) {
    real through[NC];
    for (int k = 0; k < NC; ++k) through[k] = dot(NQ, w->Gt + NQ * r, w->slope + NQ * k);
    for (int j = 0; j < NQ; ++j) {
{responds}      w->Gt[j + NQ * r] += dot(NC, through, answer + NC * j);
{by_load}      w->Gt_of_others[j + NQ * r] = dot(NC, through, answer + NC * j);
{by_load}      w->Gt[j + NQ * r] += w->Gt_of_others[j + NQ * r];
    }
  }
{end}
}

static void evaluate_stddev(const component *c, real *stddev, workspace *w)
{
  real variance[NR] = {0};
  evaluate_view(w);
{forced_latent}  for (int i = 0; i < NQ * NR; ++i) w->M_inverse_Gt[i] = w->Gt[i];
{forced_latent}  solve_mass(w->C, NR, w->M_inverse_Gt);
{forced_latent,by_load}  for (int i = 0; i < NQ * NR; ++i) w->M_inverse_Gt_of_others[i] = w->Gt_of_others[i];
{forced_latent,by_load}  solve_mass(w->C, NR, w->M_inverse_Gt_of_others);

  /* the variance of the prior, and loadings of the latent functions on each row (FUNCTIONS x NR) */
@loadings@
  /* less what the observations explain */
  const int n = c->latents[0].n;
  for (int row = 0; row < c->n_row_components; ++row) {
    const @index@ *const row_of = c->row_of + n * row;
{if !by_function}
    for (int r = 0; r < NR; ++r) {
      real *const cross = w->@cross@ + @cross_rows@ * r;
      for (int j = 0; j < n; ++j) w->products[j] = 0;
@cross_by_row@
      for (int j = 0; j < n; ++j) {
        if (row_of[j] >= 0) cross[row_of[j]] = w->products[j];
      }
    }
{end}
{by_function}@cross_by_function@
  }
{if sums}
  for (int column = 0; column < COLUMNS; ++column) {
    for (int i = 0; i < c->n_variables; ++i) {
      real sum = 0;
      for (int s = c->sum_begin[i]; s < c->sum_begin[i + 1]; ++s) {
        sum += c->sum_value[s] * w->rows[@cross_rows@ * column + c->sum_column[s]];
      }
      w->cross[VARIABLES * column + i] = sum;
    }
  }
{end}
  for (int column = 0; column < COLUMNS; ++column) {
    for (int i = c->n_variables; i < VARIABLES; ++i) w->cross[VARIABLES * column + i] = 0;
  }
  const real *row = c->triangle;
  for (int i = 0; i < c->n_variables; ++i) {
    real explained[COLUMNS];
    const int length = (i / LANES + 1) * LANES;
{!factor}    for (int k = 0; k < COLUMNS; ++k) explained[k] = weighted_sum(length, row, w->cross + VARIABLES * k);
{if factor}
    const int before = length - LANES;
    for (int k = 0; k < COLUMNS; ++k) {
      real *const v = w->cross + VARIABLES * k;
      real rest = v[i] - weighted_sum(before, row, v);
      for (int j = before; j < i; ++j) rest -= row[j] * v[j];
      explained[k] = v[i] = rest * row[i];
    }
{end}
    row += length;
{!by_function}    for (int r = 0; r < NR; ++r) variance[r] -= explained[r] * explained[r];
{if by_function}
    for (int r = 0; r < NR; ++r) {
      real sum = 0;
      for (int f = 0; f < COLUMNS; ++f) sum += w->loading[COLUMNS * r + f] * explained[f];
      variance[r] -= sum * sum;
    }
{end}
  }
  for (int r = 0; r < NR; ++r) stddev[r] = variance[r] < 0 ? 0 : sqrt(variance[r]);
}

status @name@_mean_and_stddev(const real *state, real *mean, real *stddev, workspace *w)
{
{!mixture}  const status s = evaluate(&components[0], state, mean, w);
{!mixture}  if (s != @name@_OK) return failed(failed(s, NR, mean), NR, stddev);
{!mixture}  evaluate_stddev(&components[0], stddev, w);
{if mixture}
  for (int r = 0; r < NR; ++r) mean[r] = stddev[r] = 0;
  for (int k = 0; k < COMPONENTS; ++k) {
    real *const mean_k = w->means + NR * k, *const stddev_k = w->stddevs + NR * k;
    const status s = evaluate(&components[k], state, mean_k, w);
    if (s != @name@_OK) return failed(failed(s, NR, mean), NR, stddev);
    evaluate_stddev(&components[k], stddev_k, w);
    for (int r = 0; r < NR; ++r) mean[r] += mean_k[r] / COMPONENTS;
  }
  for (int r = 0; r < NR; ++r) {
    for (int k = 0; k < COMPONENTS; ++k) {
      const real off = w->means[NR * k + r] - mean[r], own = w->stddevs[NR * k + r];
      stddev[r] += own * own + off * off;
    }
    stddev[r] = sqrt(stddev[r] / COMPONENTS);
  }
{end}
  if (!is_finite(NR, stddev)) return failed(failed(@name@_NOT_FINITE, NR, mean), NR, stddev);
  return @name@_OK;
}
{end}
{if jacobian}

/* ---------------------------------------------------------------- Jacobian
 *
 * With P and R the changes of what stands without and with M^-1 in abar,
 *
 *     dabar = P + M^-1 (R - dM a_of_force)
 *     dddq  = T (P + M^-1 (R + dM (abar - ddq - a_of_force) + dA' lambda)) + L (db - dA ddq)
 */

{if least_norm}
/* d lambda = K (df - dA' lambda) + (I - K A') dA K' lambda, f = A' lambda, of one entry of the state
 *   df       df - dA' lambda; it is lost
 *   d_along  dA K' lambda; it is lost */
static void change_of_multipliers(real *df, real *d_along, const workspace *w, real *d_lambda)
{
  for (int i = 0; i < NC; ++i) {
    if (w->rank == NC) d_along[i] = 0; /* K A' = I */
    for (int j = 0; j < NQ; ++j) df[j] -= w->A[i + NC * j] * d_along[i];
  }
  for (int i = 0; i < NC; ++i) {
    d_lambda[i] = d_along[i];
    for (int j = 0; j < NQ; ++j) d_lambda[i] += w->K[i + NC * j] * df[j];
  }
}

/* K' lambda */
static void along_multipliers(const real *lambda, const workspace *w, real *along)
{
  for (int j = 0; j < NQ; ++j) {
    along[j] = 0;
    for (int i = 0; i < NC; ++i) along[j] += w->K[i + NC * j] * lambda[i];
  }
}

{end}
{if loaded}
/* The same of M a = F + A' lambda and A a = b: df - dA' lambda = M da - r, da = T M^-1 r + L (db - dA a)
 *   r        dF + dA' lambda - dM a; it is lost
 *   d_rows   db - dA a */
static void change_of_load(real *r, const real *d_rows, real *d_along, const workspace *w, real *d_lambda)
{
  real solved[NQ], da[NQ];
  for (int i = 0; i < NQ; ++i) solved[i] = r[i];
  solve_mass(w->C, 1, solved);
  for (int i = 0; i < NQ; ++i) {
    da[i] = 0;
    for (int j = 0; j < NQ; ++j) da[i] += w->T[i + NQ * j] * solved[j];
    for (int j = 0; j < NC; ++j) da[i] += w->L[i + NQ * j] * w->row_scale[j] * d_rows[j];
  }
  for (int i = 0; i < NQ; ++i) {
    r[i] = -r[i];
    for (int j = 0; j < NQ; ++j) r[i] += w->M[i + NQ * j] * da[j];
  }
  change_of_multipliers(r, d_along, w, d_lambda);
}

{end}
{if load}
/* d lambda0 of M a0 = F + A' lambda0, A a0 = b */
static void differentiate_known_multipliers(workspace *w)
{
  const real *const lambda0 = w->x + NX;
  real along[NQ];
  along_multipliers(lambda0, w, along);
  for (int i = 0; i < NQ * NX; ++i) w->d_forced0[i] = 0;
  for (int i = 0; i < NC * NX; ++i) w->d_rows0[i] = w->d_along[i] = 0;
{if d_M}
  for (int e = 0; e < @n_d_M@; ++e) {
    const int i = of_d_M[e][0], j = of_d_M[e][1], k = of_d_M[e][2];
    w->d_forced0[i + NQ * k] -= w->d_M[e] * w->a0[j];
  }
{end}
{if d_A}
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    w->d_forced0[j + NQ * k] += w->d_A[e] * lambda0[i];
    w->d_rows0[i + NC * k] -= w->d_A[e] * w->a0[j];
    w->d_along[i + NC * k] += w->d_A[e] * along[j];
  }
{end}
{if d_b}
  for (int e = 0; e < @n_d_b@; ++e) {
    const int i = of_d_b[e][0], k = of_d_b[e][2];
    w->d_rows0[i + NC * k] += w->d_b[e];
  }
{end}
{if d_F}
  for (int e = 0; e < @n_d_F@; ++e) {
    const int i = of_d_F[e][0], k = of_d_F[e][2];
    w->d_forced0[i + NQ * k] += w->d_F[e];
  }
{end}
  for (int k = 0; k < NX; ++k) {
    change_of_load(w->d_forced0 + NQ * k, w->d_rows0 + NC * k, w->d_along + NC * k, w, w->d_lambda0 + NC * k);
  }
}

/* sum (NQ x NX) += slope in row i, for entry k of x */
static void add_change(real *sum, int i, int k, real slope, const workspace *w)
{
  if (k < NX) sum[i + NQ * k] += slope;
  for (int j = 0; k >= NX && j < NX; ++j) sum[i + NQ * j] += slope * w->d_lambda0[k - NX + NC * j];
}

{end}
static void differentiate_prior(const component *c, const real *state, workspace *w)
{
{load}  differentiate_known_multipliers(w);
  for (int i = 0; i < NQ * NX; ++i) w->d_of_rest[i] = w->d_force[i] = 0;
@dsignals@
{!dsignals_read_state}  (void)state;
{!dsignals_read_component}  (void)c;
}

/* R - dM a_of_force, dA' lambda, dM (ddq - abar), dM abar, db - dA ddq */
static void differentiate_mechanics(workspace *w)
{
{if moved}
{if rows}
  real lambda[NC];
  for (int k = 0; k < NC; ++k) {
    lambda[k] = 0;
    for (int i = 0; i < NQ; ++i) lambda[k] += w->row_scale[k] * w->L[i + NQ * k] * w->of_constraint[i];
  }
{end}
  for (int i = 0; i < NQ * NX; ++i) w->d_of_constraint[i] = 0;
{end}
{applied}  for (int i = 0; i < NQ * NX; ++i) w->d_applied[i] = 0;
{moved,rows}  for (int i = 0; i < NQ * NX; ++i) w->d_forced[i] = 0;
{moved,rows}  for (int i = 0; i < NC * NX; ++i) w->d_rows[i] = 0;
{if d_M}
  for (int e = 0; e < @n_d_M@; ++e) {
    const int i = of_d_M[e][0], j = of_d_M[e][1], k = of_d_M[e][2];
    w->d_force[i + NQ * k] -= w->d_M[e] * w->a_of_force[j];
{moved}    w->d_of_constraint[i + NQ * k] += w->d_M[e] * w->gap[j];
{applied}    w->d_applied[i + NQ * k] += w->d_M[e] * w->a_bar[j];
  }
{end}
{if moved}
{if d_A}
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    w->d_forced[j + NQ * k] += w->d_A[e] * lambda[i];
    w->d_rows[i + NC * k] -= w->d_A[e] * w->a[j];
  }
{end}
{if all,d_b}
  for (int e = 0; e < @n_d_b@; ++e) {
    const int i = of_d_b[e][0], k = of_d_b[e][2];
    w->d_rows[i + NC * k] += @of_whole@w->d_b[e];
  }
{end}
{end}
{if known,d_F}
  for (int e = 0; e < @n_d_F@; ++e) {
    const int i = of_d_F[e][0], k = of_d_F[e][2];
    w->d_force[i + NQ * k] += @of_whole@w->d_F[e];
  }
{end}
{!moved,!d_M,!d_F}  (void)w;
{!moved,!d_M,d_F,!known}  (void)w;
}

{if nonlinear}
/* The change of lambda with the state, D dlambda = the change of G abar + d at held lambda */
static void differentiate_load(workspace *w)
{
  const real *const lambda = w->y + NX;
  real along[NQ];
  along_multipliers(lambda, w, along);
  for (int i = 0; i < NC * NX; ++i) w->d_along[i] = 0;
{if d_A}
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    w->d_along[i + NC * k] += w->d_A[e] * along[j];
  }
{end}
  (void)factorise_load(1, w);
  for (int k = 0; k < NX; ++k) {
    real r[NQ];
    for (int i = 0; i < NQ; ++i) {
      r[i] = w->d_force[i + NQ * k] + w->d_forced[i + NQ * k] - w->d_of_constraint[i + NQ * k];
      for (int j = 0; j < NQ; ++j) r[i] += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
    }
    change_of_load(r, w->d_rows + NC * k, w->d_along + NC * k, w, w->d_load + NC * k);
    solve_load(w, 1, w->d_load + NC * k);
  }
}

/* What follows from it */
static void add_change_of_load(workspace *w)
{
  for (int k = 0; k < NX; ++k) {
    for (int j = 0; j < NC; ++j) {
      for (int i = 0; i < NQ; ++i) {
        w->d_of_rest[i + NQ * k] += w->rest_slope[i + NQ * j] * w->d_load[j + NC * k];
        w->d_force[i + NQ * k] += w->force_slope[i + NQ * j] * w->d_load[j + NC * k];
      }
    }
  }
}

{end}
/* dabar, d(M abar), dddq and d(A' lambda), those that the prediction needs */
static void differentiate_motion(workspace *w)
{
{abar}  for (int i = 0; i < NQ * NX; ++i) w->d_a_bar[i] = w->d_force[i];
{abar,forced}  solve_mass(w->C, NX, w->d_a_bar);
{abar}  for (int i = 0; i < NQ * NX; ++i) w->d_a_bar[i] += w->d_of_rest[i];
{if applied}
  for (int k = 0; k < NX; ++k) {
    for (int i = 0; i < NQ; ++i) {
      w->d_applied[i + NQ * k] += w->d_force[i + NQ * k];
      for (int j = 0; j < NQ; ++j) w->d_applied[i + NQ * k] += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
    }
  }
{end}
{if reaction}
  for (int k = 0; k < NX; ++k) {
    for (int i = 0; i < NQ; ++i) {
      real sum = w->d_force[i + NQ * k];
      for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->d_of_rest[j + NQ * k];
      w->d_mass_a_bar[i + NQ * k] = sum;
    }
  }
{end}
{if moved}
{rows}  for (int i = 0; i < NQ * NX; ++i) w->d_force[i] += w->d_forced[i] - w->d_of_constraint[i];
{!rows}  for (int i = 0; i < NQ * NX; ++i) w->d_force[i] -= w->d_of_constraint[i];
  solve_mass(w->C, NX, w->d_force);
  for (int i = 0; i < NQ * NX; ++i) w->d_of_rest[i] += w->d_force[i];
{!rows}  for (int i = 0; i < NQ * NX; ++i) w->d_a[i] = w->d_of_rest[i];
{if rows}
  for (int k = 0; k < NX; ++k) {
    for (int i = 0; i < NQ; ++i) {
      real sum = 0;
      for (int j = 0; j < NQ; ++j) sum += w->T[i + NQ * j] * w->d_of_rest[j + NQ * k];
      for (int j = 0; j < NC; ++j) sum += w->L[i + NQ * j] * w->row_scale[j] * w->d_rows[j + NC * k];
      w->d_a[i + NQ * k] = sum;
    }
  }
{end}
{end}
{if reaction}
  for (int k = 0; k < NX; ++k) {
    for (int i = 0; i < NQ; ++i) {
      real sum = w->d_of_constraint[i + NQ * k] - w->d_mass_a_bar[i + NQ * k];
      for (int j = 0; j < NQ; ++j) sum += w->M[i + NQ * j] * w->d_a[j + NQ * k];
      w->d_of_constraint[i + NQ * k] = sum;
    }
  }
{end}
}

static status evaluate_with_jacobian(const component *c, const real *state, real *mean, real *jacobian, workspace *w)
{
  @system_and_derivatives@(c->parameters, state, w);
  status s = start(@start_arguments@);
{if partial}
  if (s == @name@_OK) {
    evaluate_motion(w);
    differentiate_prior(c, state, w);
    differentiate_mechanics(w);
    differentiate_load(w);
  }
{end}
  if (s == @name@_OK) s = evaluate_mean(c, state, mean, w);
  if (s != @name@_OK) return s;
  differentiate_prior(c, state, w);
  differentiate_mechanics(w);
{nonlinear,!partial}  differentiate_load(w);
{nonlinear}  add_change_of_load(w);
  differentiate_motion(w);
{if multipliers}
{if d_A}
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    w->d_of_constraint[j + NQ * k] -= w->d_A[e] * w->lambda[i];
  }
{end}
  real along[NQ];
  along_multipliers(w->lambda, w, along);
  for (int i = 0; i < NC * NX; ++i) w->d_along[i] = 0;
{if d_A}
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    w->d_along[i + NC * k] += w->d_A[e] * along[j];
  }
{end}
{end}
  for (int k = 0; k < NX; ++k) {
{constrained}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = w->d_a[@r@ + NQ * k];
{unconstrained}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = w->d_a_bar[@r@ + NQ * k];
{force}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = w->d_applied[@r@ + NQ * k];
{next-velocity,has_mean}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = (k == NQ + @r@) + @dt@ * w->d_a[@r@ + NQ * k];
{next-velocity,!has_mean}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = @dt@ * w->d_a[@r@ + NQ * k];
{constraint-force}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = w->d_of_constraint[@r@ + NQ * k];
{multipliers}    real d_lambda[NC];
{multipliers}    change_of_multipliers(w->d_of_constraint + NQ * k, w->d_along + NC * k, w, d_lambda);
{multipliers}    for (int r = 0; r < NR; ++r) jacobian[r + NR * k] = d_lambda[@r@];
  }
  return is_finite(NR * NX, jacobian) ? @name@_OK : @name@_NOT_FINITE;
}

status @name@_mean_and_jacobian(const real *state, real *mean, real *jacobian, workspace *w)
{
{!mixture}  const status s = evaluate_with_jacobian(&components[0], state, mean, jacobian, w);
{!mixture}  return s == @name@_OK ? s : failed(failed(s, NR, mean), NR * NX, jacobian);
{if mixture}
  for (int r = 0; r < NR; ++r) mean[r] = 0;
  for (int i = 0; i < NR * NX; ++i) jacobian[i] = 0;
  for (int k = 0; k < COMPONENTS; ++k) {
    const status s = evaluate_with_jacobian(&components[k], state, w->mean, w->jacobian, w);
    if (s != @name@_OK) return failed(failed(s, NR, mean), NR * NX, jacobian);
    for (int r = 0; r < NR; ++r) mean[r] += w->mean[r] / COMPONENTS;
    for (int i = 0; i < NR * NX; ++i) jacobian[i] += w->jacobian[i] / COMPONENTS;
  }
  return @name@_OK;
{end}
}
{end}

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
{if stddev}
    real stddev[NR];
    if (@name@_mean_and_stddev(tests[k].state, mean, stddev, w) != @name@_OK) return k + 1;
    for (int r = 0; r < NR; ++r) stddev[r] *= stddev[r];
    if (!agree(NR, stddev, tests[k].variance, tests[k].variance_error)) return k + 1;
{end}
{if jacobian}
    real jacobian[NR * NX];
    if (@name@_mean_and_jacobian(tests[k].state, mean, jacobian, w) != @name@_OK ||
        !agree(NR * NX, jacobian, tests[k].jacobian, tests[k].jacobian_error)) {
      return k + 1;
    }
{end}
  }
  return 0;
}
)c";

}  // namespace gp2::c_export
