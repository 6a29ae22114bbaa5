/* What was learned of a robot, as a passive force in MuJoCo:
 *
 *     gp2 export rocker_fit.json --to mjcf -o models/four_bar_fitted.xml
 *     gp2 export rocker_fit.json --view force --name rocker -o .
 *     cc -std=c99 -O2 main.c rocker.c -lmujoco -lm -o passive && ./passive models/four_bar_fitted.xml > motion.csv
 *
 * rocker_fit.json is that of docs/export.md. The fitted parameters are in the robot's file; the latents, which no such file can
 * hold, come by the callback. The program writes a motion from rest, and the accelerations that MuJoCo computes from all forces but those
 * that close the loop: gp2 predict --view unconstrained has the same.
 */
#include <mujoco/mujoco.h>
#include <stdio.h>

#include "rocker.h"

enum { N = rocker_ROWS }; /* coordinates: hinges and slides, in the order of the robot's joints */

static rocker_workspace memory; /* one for each thread that simulates */

/* Adds the learned force at the state of `d`, where MuJoCo has put springs and dampers already. */
static void add_learned_force(const mjModel *m, mjData *d)
{
  double state[rocker_STATE_SIZE] = {0}, force[N]; /* [q; dq; t; u], as rocker.h lists it; nothing here reads u */
  (void)m;
  for (int j = 0; j < N; ++j) {
    state[j] = d->qpos[j];
    state[N + j] = d->qvel[j];
  }
  state[2 * N] = d->time;
  if (rocker_mean(state, force, &memory) != rocker_OK) mju_error("passive: the fit has no prediction at this state");
  for (int j = 0; j < N; ++j) d->qfrc_passive[j] += force[j];
}

static void print_row(const mjData *d)
{
  for (int j = 0; j < N; ++j) printf("%.17g,", d->qpos[j]);
  for (int j = 0; j < N; ++j) printf("%.17g,", d->qvel[j]);
  for (int j = 0; j < N; ++j) printf("%.17g,", d->qacc_smooth[j]);
  printf("0,%.17g\n", d->time);
}

int main(int argc, char **argv)
{
  char error[1000] = "";
  mjModel *const m = argc == 2 ? mj_loadXML(argv[1], NULL, error, sizeof error) : NULL;
  if (m == NULL || m->nq != N || m->nv != N || rocker_self_test(&memory) != 0) {
    fprintf(stderr, "usage: passive ROBOT.xml, the robot of rocker.c. %s\n", error);
    return 1;
  }
  mjcb_passive = add_learned_force;
  mjData *const d = mj_makeData(m);
  printf("crank,coupler,rocker,dcrank,dcoupler,drocker,abar_crank,abar_coupler,abar_rocker,u,t\n");
  for (int step = 0; step < 1000; ++step) {
    mj_forward(m, d);
    if (step % 50 == 0) print_row(d);
    mj_step(m, d);
  }
  mj_deleteData(d);
  mj_deleteModel(m);
  return 0;
}
