"""A user's code, checked by mypy --strict in test_stub.py. Not run."""

import sys

import numpy as np
import numpy.typing as npt

import gp2


def main(path: str) -> npt.NDArray[np.float64]:
    system = gp2.System.load(path)
    log: gp2.Table = gp2.read_csv("log.csv")
    findings = [finding.text for finding in gp2.check(system, log) if finding.level != "ok"]
    print(findings)

    def tell(progress: gp2.Progress) -> None:
        print(progress.iteration, progress.best)

    posterior = gp2.fit(system, [log, gp2.Log({"q": [1.0]}, system)], mean="force", noise_std="estimate", progress=tell)
    states = system.states(log)
    prediction = posterior.predict(states, view="unconstrained", columns={"q": "angle"})
    width: npt.NDArray[np.float64] = 2 * prediction.std
    motions: list[gp2.Motion] = posterior.simulate({"q": 0.1}, [0, 1, 2], n_samples=3)
    motion: gp2.Motion = posterior.simulate([0.1, 0.0], np.linspace(0, 1))
    posterior.update({"q": states[:, 0]}, noise_std=0.1)
    predictor = gp2.Predictor(posterior, storage="single")
    value: float = posterior.report["m"] + gp2.simulate(system, {}, [0, 1]).max_position_drift
    print(width, motions, motion.std is None, value, gp2.blas_report()["advice"], gp2.__version__)
    posterior.save(path + ".json")
    return predictor.mean(states[0])


def of_strings() -> gp2.System:
    return gp2.System(
        coordinates=["x", {"name": "angle", "angle": True}],
        parameters={"m": 0.2, "h": {"value": 0.5, "estimate": True}},
        mass=[["m", 0], [0, "m"]],
        constraints={"position": ["x - h*cos(angle)"]},
        latents=[{"features": ["x"]}],
        noise=0.1,
    )


def wrong(posterior: gp2.Posterior) -> None:
    posterior.predict([[0.0]], view="position")  # type: ignore[arg-type]
    posterior.predict([[0.0]]).mean = 3  # type: ignore[assignment,misc]
    posterior.fit()  # type: ignore[attr-defined]


if __name__ == "__main__":
    main(sys.argv[1])


def next_experiment(posterior: gp2.Posterior) -> float:
    plan = gp2.excite(posterior, {"q": 0.1}, 5, {"u": (-1, 1)}, within={"dq": (-3, 3)}, target="parameters", n_motions=100)
    motion: gp2.Motion = posterior.simulate({"q": 0.1}, plan.motion.t, inputs=plan.table)
    return plan.parameters["m"]["after"] + plan.limits["u"]["share"] + float(motion.q[-1, 0])
