/* A controller at 1 kHz around the C that gp2 exports, for a machine without gp2:
 *
 *     gp2 export fit.json --name bead -o .
 *     cc -std=c99 -O3 main.c bead.c -lm -o exported_loop && ./exported_loop
 *
 * fit.json is that of the bead on a wire in docs/guide.md. The controller pulls the bead to x = 0 like a damped spring: in each
 * cycle the push that gives x the acceleration asked for, by one Newton step on what the fit predicts. The fit stands in for the
 * machine too, in semi-implicit Euler steps; on a machine, read its state instead.
 */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "bead.h"

enum { X, Z, DX, DZ, T, PUSH }; /* entries of the state, as bead.h lists them */
enum { CYCLES = 5000 };

static bead_workspace memory;

/* The push that gives x the acceleration of a damped spring; none where the fit cannot say. */
static double push_of(const double *state)
{
  const double omega = 6, limit = 3; /* rad/s, N */
  double ddq[bead_ROWS], jacobian[bead_ROWS * bead_STATE_SIZE];
  if (bead_mean_and_jacobian(state, ddq, jacobian, &memory) != bead_OK) return 0;
  const double wanted = -omega * omega * state[X] - 2 * omega * state[DX];
  const double push = state[PUSH] + (wanted - ddq[X]) / jacobian[X + bead_ROWS * PUSH];
  return fmin(fmax(push, -limit), limit);
}

int main(void)
{
  const double period = 1e-3;
  double state[bead_STATE_SIZE] = {0.5}, busy = 0, largest = 0;
  state[Z] = 0.5 * state[X] * state[X]; /* on the wire */
  if (bead_self_test(&memory) != 0) {
    fprintf(stderr, "exported_loop: the compiled model does not predict what gp2 did\n");
    return 1;
  }
  for (int cycle = 0; cycle < CYCLES; ++cycle) {
    const clock_t start = clock();
    state[PUSH] = push_of(state);
    busy += (double)(clock() - start) / CLOCKS_PER_SEC;
    largest = fmax(largest, fabs(state[PUSH]));

    double ddq[bead_ROWS];
    if (bead_mean(state, ddq, &memory) != bead_OK) return 1;
    for (int j = 0; j < bead_ROWS; ++j) {
      state[DX + j] += period * ddq[j];
      state[X + j] += period * state[DX + j];
    }
    state[T] += period;
  }
  printf("%d cycles, %.2f us each; after %.1f s x = %.4f m, |push| <= %.2f N\n", CYCLES, 1e6 * busy / CYCLES, state[T], state[X],
         largest);
  return 0;
}
