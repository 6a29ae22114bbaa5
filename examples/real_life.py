#!/usr/bin/env python3
"""The whole road: from a model file to a controller that knows the friction.

crank.toml describes a motor, a crank and a slide; their friction is unknown. The machine itself is simulated here, friction and
all: what it measures is all that gp2 gets to see.

    python3 examples/real_life.py [--plot tracking.png]
"""

import argparse
from pathlib import Path

import numpy as np

import gp2

MACHINE = gp2.System.load(Path(__file__).parent / "crank.toml")  # its [truth] stands in for reality
PHI, DPHI, T, TORQUE = (MACHINE.state_names.index(name) for name in ("phi", "dphi", "t", "torque"))


def drive(seconds: float, tempo: float, seed: int) -> dict[str, np.ndarray]:
    """Drives the machine with a sum of sines, and logs it at 20 Hz with noise in the accelerations."""
    t = np.arange(0, seconds, 0.05)
    fine = np.arange(0, seconds, 0.005)
    torque = 0.30 * np.sin(1.3 * tempo * fine) + 0.25 * np.sin(3.1 * tempo * fine + 1) + 0.15 * np.sin(7.7 * tempo * fine)
    motion = gp2.simulate(MACHINE, {"phi": 0.5}, t, {"t": fine, "torque": torque})
    noise = np.random.default_rng(seed).normal(scale=[1.0, 0.1], size=motion.ddq.shape)
    log = dict(zip(MACHINE.state_names, motion.states.T))
    return log | dict(zip(MACHINE.acceleration_names, (motion.ddq + noise).T))


def reference(t: float) -> tuple[float, float, float]:
    """Angle, velocity and acceleration that the crank shall have: to and fro, through both dead centres."""
    return 2.5 * np.sin(2 * t), 5 * np.cos(2 * t), -10 * np.sin(2 * t)


def track(predictor: gp2.Predictor, seconds: float = 6, step: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    """Lets the crank follow the reference by computed torque. Returns times [s] and tracking errors [rad]."""
    stiffness, damping = 15.0**2, 2 * 15.0  # of the error: critically damped, 15 rad/s
    phi, dphi, _ = reference(0.0)
    q_dq = gp2.simulate(MACHINE, {"phi": phi, "dphi": dphi}, [0.0, step]).states[0, :T]  # x and dx follow
    state = np.concatenate([q_dq, [0.0, 0.0]])
    times = step * np.arange(round(seconds / step))
    errors = np.empty(len(times))
    for k, t in enumerate(times):
        phi, dphi, ddphi = reference(t)
        errors[k] = phi - state[PHI]
        wanted = ddphi + stiffness * errors[k] + damping * (dphi - state[DPHI])

        # the torque that the model says gives this acceleration: it enters ddq linearly, so that one Newton step is exact
        ddq, jacobian = predictor.mean_and_jacobian(state)
        state[TORQUE] = np.clip(state[TORQUE] + (wanted - ddq[0]) / jacobian[0, TORQUE], -1.5, 1.5)

        # the machine moves on under that torque
        held = {"t": [t, t + step], "torque": [state[TORQUE], state[TORQUE]]}
        state[:T] = gp2.simulate(MACHINE, state[:T], [t, t + step], held).states[-1, :T]
        state[T] = t + step
    return times, errors


def plot(path: str, times: np.ndarray, with_friction: np.ndarray, without: np.ndarray) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 3), layout="constrained")
    axes.plot(times, np.degrees(without), label="without friction in the model")
    axes.plot(times, np.degrees(with_friction), label="with the learned friction")
    axes.set(xlabel="time [s]", ylabel="tracking error [°]")
    axes.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description="From a model file to a controller that knows the friction.")
    parser.add_argument("--plot", metavar="FILE.png", help="draw the tracking errors (needs matplotlib)")
    arguments = parser.parse_args()

    log, later = drive(16, tempo=1.0, seed=1), drive(8, tempo=0.8, seed=2)
    print(f"A log of {len(log['t'])} rows. What gp2.check says of model and log:")
    for finding in gp2.check(MACHINE, log):
        print(f"  {finding}")

    posterior = gp2.fit(MACHINE, log, mean="force")
    evaluation = posterior.evaluate(later)
    print(f"Fitted: {posterior.report.termination}.")
    ddphi, ddx = evaluation.rmse
    print("A later drive, rms difference to what was measured:")
    print(f"  ddphi: {ddphi:.2f} rad/s² (noise: 1), ddx: {ddx:.3f} m/s² (noise: 0.1);", end=" ")
    print(f"{evaluation.coverage95:.0%} in the 95 % intervals.")

    # the same prior without data is the model as it is written: no friction
    frictionless = posterior.without_data()
    inputs = {"t": later["t"], "torque": later["torque"]}
    start = {"phi": later["phi"][0], "dphi": later["dphi"][0]}
    truth = gp2.simulate(MACHINE, start, later["t"], inputs).q[:, 0]
    off = [np.abs(model.simulate(start, later["t"], inputs).q[:, 0] - truth)[20] for model in (posterior, frictionless)]
    print(f"Simulated under the later drive's torque, the crank is off by {np.degrees(off[0]):.2f}° after 1 s;", end=" ")
    print(f"without friction by {np.degrees(off[1]):.0f}°.")

    times, with_friction = track(gp2.Predictor(posterior, std=False))
    _, without = track(gp2.Predictor(frictionless, std=False))
    rms = [np.degrees(np.sqrt(np.mean(errors**2))) for errors in (with_friction, without)]
    print("Computed torque at 500 Hz, the crank to and fro by 143°:")
    print(f"  tracking error with the learned friction: {rms[0]:.2f}° rms")
    print(f"  tracking error without friction:          {rms[1]:.2f}° rms")
    if arguments.plot:
        plot(arguments.plot, times, with_friction, without)


if __name__ == "__main__":
    main()
