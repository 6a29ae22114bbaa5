#pragma once

#include <string_view>

// NAME.h of the exported C, in the form of fill_template.hpp; its conditions are those of c_writer.cpp.
namespace gp2::c_export {

inline constexpr std::string_view header_template = R"c(/* @title@
 *
@about@
{portable} * Its numbers are the same to the bit on every machine (compile with -ffp-contract=off). sin, cos and tan of more than 1e6
{portable} * are NaN.
@obeyed@
 *
 * A state is @name@_STATE_SIZE numbers:
@state@
 * The prediction is @name@_ROWS numbers:
@view@
 *
 * The functions allocate nothing and keep nothing: whoever calls from several threads gives each a workspace of its own.
 * They must not be compiled with options that let the compiler assume finite numbers (-ffast-math,
 * -ffinite-math-only).
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
{if stddev}

/* And the standard deviation of each row, of the true value and not of its next measurement.
 *   stddev  [@name@_ROWS] */
@name@_status @name@_mean_and_stddev(const @name@_real *state, @name@_real *mean, @name@_real *stddev,
    @name@_workspace *w);
{end}
{if jacobian}

/* And the derivative of the mean in the state.
 *   jacobian  [@name@_ROWS * @name@_STATE_SIZE], column by column: jacobian[r + @name@_ROWS * k] = d mean[r] / d state[k] */
@name@_status @name@_mean_and_jacobian(const @name@_real *state, @name@_real *mean, @name@_real *jacobian,
    @name@_workspace *w);
{end}

/* Predicts at states whose predictions are stored with the model. Returns 0 where they agree, else the number of the first that
 * does not. */
{portable}/* -1: the compiler has fused products, so that the bits are not those of other machines. */
int @name@_self_test(@name@_workspace *w);

#ifdef __cplusplus
}
#endif

#endif
)c";

}  // namespace gp2::c_export
