#pragma once

#include <string_view>

// What the exported C does for latent @a@, in the form of fill_template.hpp; the conditions and texts are those of c_latents.cpp.
namespace gp2::c_export {

inline constexpr std::string_view signal_template = R"c(
  /* latent @latent@: @kernel@ of @feature_names@ */
  @features@(@state_of_features@, w->phi_@a@);
  if (!is_finite(@D@, w->phi_@a@)) return @name@_NOT_FINITE;
{if is_potential}
  @pairs@(&c->latents[@a@], w->phi_@a@, w->pairs_@a@);
  @sums@(&c->latents[@a@], w->pairs_@a@, w->scratch, w->signal_@a@);
{end}
{if !is_potential}
  @covariance@(&c->latents[@a@], w->phi_@a@, w->k_@a@, w->scratch);
  for (int l = 0; l < @p@; ++l) {
    const latent *const a = &c->latents[@a@];
    w->signal_@a@[l] = weighted_sum(a->n, w->k_@a@, a->weights + a->n * l);
  }
{end}
{is_positive}  for (int l = 0; l < @p@; ++l) w->signal_@a@[l] = exp(w->signal_@a@[l]);
{if !reads_multipliers}
{has_directions}  @directions@(c->parameters, @state_of_directions@, w->B_@a@);
{if is_admissible}
  for (int l = 0; l < NQ; ++l) {
    const real stddev = w->B_@a@[l + NQ * l];
    for (int i = 0; i < NQ; ++i) w->B_@a@[i + NQ * l] = w->P[i + NQ * l] * stddev;
  }
{end}
{has_directions}  for (int l = 0; l < @p@; ++l) {
{has_directions}    for (int i = 0; i < NQ; ++i) w->@to@[i] += w->B_@a@[i + NQ * l] * w->signal_@a@[l];
{has_directions}  }
{!has_directions}  for (int i = 0; i < NQ; ++i) w->@to@[i] += w->signal_@a@[i];
{end}
)c";

// of a latent whose directions read lambda, at w->y
inline constexpr std::string_view under_load_template = R"c({if reads_multipliers}
  @directions@(c->parameters, w->y, w->B_@a@);
  for (int l = 0; l < @p@; ++l) {
    for (int i = 0; i < NQ; ++i) w->@part@_of_load[i] += w->B_@a@[i + NQ * l] * w->signal_@a@[l];
  }
{if directions_vary}
  @d_directions@(c->parameters, w->y, w->derivative);
  for (int e = 0; e < @n_d_directions@; ++e) {
    const int i = @of_directions@[e][0], l = @of_directions@[e][1], k = @of_directions@[e][2] - NX;
    if (k >= 0) w->@part@_slope[i + NQ * k] += w->derivative[e] * w->signal_@a@[l];
  }
{end}
{end}
)c";

inline constexpr std::string_view loading_template = R"c({if is_potential}
  real prior_@a@[@F@];
  @variance@(&c->latents[@a@], prior_@a@);
{end}
{if !is_potential}
  real prior_@a@;
  @variance@(&c->latents[@a@], w->phi_@a@, &prior_@a@);
{end}
  for (int r = 0; r < NR; ++r) {
    for (int f = 0; f < @F@; ++f) {
      real sum = 0;
      for (int l = 0; l < @p@; ++l) {
{has_directions}        real along = 0;
{has_directions}        for (int i = 0; i < NQ; ++i) along += w->B_@a@[i + NQ * l] * w->@G@[i + NQ * r];
{!has_directions}        const real along = w->@G@[l + NQ * r];
{is_positive}        sum += c->latents[@a@].loading[l + @p@ * f] * along * w->signal_@a@[l];
{!is_positive}        sum += c->latents[@a@].loading[l + @p@ * f] * along;
      }
      w->loading[@n_functions@ * r + @first@ + f] = sum;
{is_potential}      variance[r] += prior_@a@[f] * sum * sum;
{!is_potential}      variance[r] += prior_@a@ * sum * sum;
    }
  }
)c";

inline constexpr std::string_view cross_by_row_template = R"c({if is_potential}
      @products@(&c->latents[@a@], w->pairs_@a@, w->loading + @n_functions@ * r + @first@, w->scratch, w->gradient_@a@);
      add_gradient_products(&c->latents[@a@], @F@, row, w->gradient_@a@, w->products);
{end}
{if !is_potential}
      add_products(&c->latents[@a@], @F@, row, w->k_@a@, w->loading + @n_functions@ * r + @first@, w->products);
{end}
)c";

inline constexpr std::string_view cross_by_function_template = R"c(    for (int f = 0; f < @F@; ++f) {
{if is_potential}
      real unit[@F@] = {0};
      unit[f] = 1;
      real *const cross = w->@cross@ + @cross_rows@ * (@first@ + f);
      for (int j = 0; j < n; ++j) w->products[j] = 0;
      @products@(&c->latents[@a@], w->pairs_@a@, unit, w->scratch, w->gradient_@a@);
      add_gradient_products(&c->latents[@a@], @F@, row, w->gradient_@a@, w->products);
      for (int j = 0; j < n; ++j) {
        if (row_of[j] >= 0) cross[row_of[j]] = w->products[j];
      }
{end}
{if !is_potential}
      const real *const rows = c->latents[@a@].rows + n * (@F@ * row + f);
      real *const cross = w->@cross@ + @cross_rows@ * (@first@ + f);
      for (int j = 0; j < n; ++j) {
        if (row_of[j] >= 0) cross[row_of[j]] = w->k_@a@[j] * rows[j];
      }
{end}
    }
)c";

inline constexpr std::string_view dsignal_template = R"c({if features_vary}
{is_potential}  @gradient@(&c->latents[@a@], w->pairs_@a@, w->scratch, w->dsignal);
{!is_potential}  @gradient@(&c->latents[@a@], w->phi_@a@, w->k_@a@, w->scratch, w->dsignal);
{is_positive}  for (int j = 0; j < @Dp@; ++j) w->dsignal[j] *= w->signal_@a@[j / @D@];
  @d_features@(@state_of_features@, w->derivative);
  for (int e = 0; e < @n_d_features@; ++e) {
    const int d = @of_features@[e][0], k = @of_features@[e][1];
    for (int i = 0; i < NQ; ++i) {
{has_directions}      real sum = 0;
{has_directions}      for (int l = 0; l < @p@; ++l) sum += w->B_@a@[i + NQ * l] * w->dsignal[d + @D@ * l];
{features_read_load}      add_change(w->@d_to@, i, k, @slope@ * w->derivative[e], w);
{!features_read_load}      w->@d_to@[i + NQ * k] += @slope@ * w->derivative[e];
    }
  }
{end}
{if is_admissible,d_A}
  real along[NQ], multiplier[NC]; /* dE g = -(L dA E g + E B dA' lambda), lambda = L' B^-1 g */
  for (int i = 0; i < NQ; ++i) {
    along[i] = 0;
    for (int l = 0; l < NQ; ++l) along[i] += w->B_@a@[i + NQ * l] * w->signal_@a@[l];
  }
  for (int k = 0; k < NC; ++k) {
    multiplier[k] = 0;
    for (int i = 0; i < NQ; ++i) multiplier[k] += w->L_P[i + NQ * k] * w->signal_@a@[i] / @admissible@[i];
  }
  for (int e = 0; e < @n_d_A@; ++e) {
    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];
    for (int l = 0; l < NQ; ++l) {
      w->d_of_rest[l + NQ * k] -=
          w->d_A[e] * (along[j] * w->L_P[l + NQ * i] + multiplier[i] * @admissible@[j] * w->B_@a@[l + NQ * j]);
    }
  }
{end}
{if directions_vary}
  @d_directions@(c->parameters, @state_of_directions@, w->derivative);
  for (int e = 0; e < @n_d_directions@; ++e) {
    const int i = @of_directions@[e][0], l = @of_directions@[e][1], k = @of_directions@[e][2];
{reads_multipliers}    if (k >= NX) continue; /* in lambda, which follows the state */
{is_admissible}    for (int j = 0; j < NQ; ++j) {
{is_admissible}      const real change = w->P[j + NQ * i] * w->derivative[e] * w->signal_@a@[l];
{is_admissible,directions_read_load}      add_change(w->@d_to@, j, k, change, w);
{is_admissible,!directions_read_load}      w->@d_to@[j + NQ * k] += change;
{is_admissible}    }
{!is_admissible,directions_read_load}    add_change(w->@d_to@, i, k, w->derivative[e] * w->signal_@a@[l], w);
{!is_admissible,!directions_read_load}    w->@d_to@[i + NQ * k] += w->derivative[e] * w->signal_@a@[l];
  }
{end}
)c";

}  // namespace gp2::c_export
