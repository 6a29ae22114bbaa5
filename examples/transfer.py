#!/usr/bin/env python3
"""Transfer: learn on one wire, predict on another.

A bead slides on a bent wire through honey. The honey belongs to the bead, the wire is the constraint. What was learned about the
one holds when the other is exchanged: on a new wire no acceleration has been measured yet.
"""

import numpy as np

import gp2


def bead(wire: str, name: str, fastest: float, latents=({"name": "drag", "features": ["dx", "dz"], "directions": "force"},)):
    """A bead on `wire`, an expression in x and z that is zero, driven with up to `fastest` m/s along x."""
    return gp2.System(
        name=name,
        coordinates=["x", "z"],  # m
        inputs=["push"],  # N, along x
        parameters={"m": 0.2},  # kg
        mass=[["m", "0"], ["0", "m"]],
        force=["push", "-9.81*m"],
        constraints=[wire],
        latents=latents,  # none: an unknown acceleration that may depend on everything
        noise=0.05,  # m/s²
        # for simulated data, which stand in for measurements: what the model does not know, and where the bead was driven
        let={"speed": "sqrt(dx^2 + dz^2)"},
        truth=["-(0.8 + 0.6*speed)*dx", "-(0.8 + 0.6*speed)*dz"],
        sampling={"x": [-1, 1], "dx": [-fastest, fastest], "push": [-1, 1]},
    )


VALLEY, WAVES = "z - 0.5*x^2", "z - 0.15*sin(4*x)"


def main() -> None:
    home, away = bead(VALLEY, "a valley", fastest=1.0), bead(WAVES, "a wavy wire", fastest=1.5)
    home_log = home.generate(80, seed=1)
    home_test, away_test = home.generate(300, seed=2, noise_std=0), away.generate(300, seed=3, noise_std=0)

    learned = gp2.fit(home, home_log, mean="force")
    there = learned.evaluate(away_test, system=away)
    print("Learned in a valley, from 80 measurements with noise of 0.05 m/s²:")
    print(f"  rms error of ddx, ddz in the valley:     {learned.evaluate(home_test).rmse.round(3)} m/s²")
    print(f"  rms error of ddx, ddz on the wavy wire:  {there.rmse.round(3)} m/s², without a measurement there")
    print(f"  |A ddq - b| on the wavy wire:            {there.max_constraint_error:.1e}, its own constraint, to rounding")

    # the wavy wire is faster than the valley was; the standard deviations know
    std = learned.predict(away_test, system=away).std[:, 0]
    fast = np.abs(away_test["dx"]) > 1.2
    slow_std, fast_std = np.median(std[~fast]), np.median(std[fast])
    print(f"  standard deviation of ddx there:         {slow_std:.3f} m/s², {fast_std:.3f} above 1.2 m/s")

    # an ordinary Gaussian process learns the wire along with the drag, and cannot leave it behind
    ordinary = gp2.fit(bead(VALLEY, "a valley", fastest=1.0, latents=()), home_log, baseline="se")
    print("An ordinary Gaussian process, from the same measurements:")
    print(f"  rms error of ddx, ddz in the valley:     {ordinary.evaluate(home_test).rmse.round(3)} m/s²")
    print(f"  rms error of ddx, ddz on the wavy wire:  {ordinary.evaluate(away_test).rmse.round(1)} m/s²")

    # what was learned can be looked at: the drag as a function of the velocity
    velocity = {name: np.array([1.0 if name == "dx" else 0.0]) for name in home.state_names}
    drag = learned.predict(velocity, view="unconstrained", latent="drag")
    print(f"The drag at 1 m/s brakes with {-drag.mean[0, 0]:.2f} ± {drag.std[0, 0]:.2f} m/s² (true: 1.40).")

    # a few measurements on the new wire join those from home
    both = gp2.fit(home, [home_log, gp2.Log(away.generate(20, seed=4), away)], mean="force")
    print("With 20 measurements from the wavy wire added:")
    print(f"  rms error of ddx, ddz on the wavy wire:  {both.evaluate(away_test, system=away).rmse.round(3)} m/s²")


if __name__ == "__main__":
    main()
