#!/usr/bin/env python3
"""Quick start: from a log to predictions that obey the constraint.

A particle slides on a curved surface. Its mass, the surface and the forces that push it are known. What slows it down is not.
100 measured accelerations, with noise of 0.1 m/s², are in surface/train.csv; 500 true ones, to compare with, in surface/test.csv.

    python3 examples/quickstart.py
"""

from pathlib import Path

import numpy as np

import gp2

# What is known. Velocities are called dNAME, accelerations ddNAME; a constraint is an expression that is zero.
MODEL = """
name        = "particle on a surface"
coordinates = ["q1", "q2", "q3"]     # m
inputs      = ["u1", "u2", "u3"]     # N

[parameters]
m = 3.0                              # kg

[mechanics]
mass  = [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "m"]]
force = ["u1", "u2", "u3 - 9.81*m"]

[constraints]
position = ["0.08*q1^2 + 0.05*q2^2 + 0.05*q1*q2 + 0.1*cos(3*q1) - q3"]

[[latent]]                           # what is not known: a force that depends on the velocity
features   = ["dq1", "dq2", "dq3"]
directions = "force"

[noise]
ddq = 0.1                            # m/s², of a measured acceleration
"""


def main() -> None:
    data = Path(__file__).parent / "surface"
    system = gp2.System.parse(MODEL)

    # mean="force": the known forces may be relied on
    posterior = gp2.fit(system, data / "train.csv", mean="force")
    print(f"Fitted {posterior.n_data} measurements: {posterior.report.termination}.")

    test = gp2.read_csv(data / "test.csv")
    prediction = posterior.predict(test)
    truth = np.column_stack([test[name] for name in prediction.names])
    rmse = np.sqrt(np.mean((prediction.mean - truth) ** 2, axis=0))
    print(f"Error of {', '.join(prediction.names)}: {rmse.round(4)} m/s² rms; one measurement has 0.1.")

    inside = np.abs(prediction.mean - truth) < 1.96 * prediction.std
    print(f"{np.mean(inside):.0%} of the true values lie in the 95 % intervals.")

    # A ddq = b is the constraint, differentiated twice
    mechanics = system.evaluate(system.states(test))
    error = np.einsum("nij,nj->ni", mechanics.A, prediction.mean) - mechanics.b
    print(f"Constraint: |A ddq - b| is at most {np.abs(error).max():.1e}, rounding.")

    print("At the first test state:")
    for name, value, deviation, true in zip(prediction.names, prediction.mean[0], prediction.std[0], truth[0]):
        print(f"  {name} = {value:6.3f} ± {deviation:.3f} m/s²   (true: {true:6.3f})")
    push = posterior.predict(test, view="constraint-force")
    print(f"There the surface holds the particle with {np.linalg.norm(push.mean[0]):.1f} N.")


if __name__ == "__main__":
    main()
