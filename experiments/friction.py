"""Friction as large as the load that it acts on: what is gained by a latent that knows the load.

    PYTHONPATH=build/test/python python3 experiments/friction.py --n 100 --seeds 1 20

Two mechanisms whose load is that under the known force, each with three friction curves, and three whose friction presses on its own
constraint. Each model is fitted to the same N noisy rows with the known force as mean, and scored on 300 fresh states without noise and on
the same at twice the velocities: nRMSE, median and worst seed. Coverage is, for all seeds and for the worst, of the first two that of the accelerations' 95 % bands, also at
twice the velocities; of the three that of the friction coefficient over the speeds of the fresh states: how often the true one is within
two standard deviations.
"""

import argparse
import math
import pathlib
import re
import statistics

FOLDER = pathlib.Path(__file__).parent / "mechanisms"
# Of those whose load is known: what friction along the contact depends on, and where it acts, for a model that does not know the load.
ALONG = {
    "bead_on_turning_wire": ('"x*cos(w*t) + y*sin(w*t)", "dx*cos(w*t) + dy*sin(w*t)", "fx*sin(w*t) - fy*cos(w*t)", "fz", "v"',
                             '["-rx/v"], ["-ry/v"], ["-dz/v"]'),
    "finger_on_plate": ('"x", "y", "dx", "dy", "fx", "fy", "fz", "v"', '["-dx/v"], ["-dy/v"], ["-dz/v"]'),
}
# That of the mechanism's file, and others for the same model.
CURVES = [None, "0.12 + 0.18*exp(-v/0.25)", "0.1 + 0.2*exp(-v/0.1) + 0.05*tanh(v/0.5)"]
MECHANISMS = [*ALONG, "rubbing_bead", "dragged_rod", "ladder"]


def with_latent(text, features, directions):
    """The latents' place taken by another."""
    head, tail = text[: text.index("[[latent]]")], text[text.index("[noise]") :]
    return f'{head}[[latent]]\nname = "friction"\nfeatures = [{features}]\ndirections = {directions}\n{tail}'


def text_of(mechanism, curve):
    text = (FOLDER / f"{mechanism}.toml").read_text()
    return re.sub(r"^mu .*", f'mu = "{curve}"', text, flags=re.M) if curve else text


def models(mechanism, text):
    coordinates, inputs = (re.findall(r'"(\w+)"', re.search(rf"^{key}.*", text, re.M)[0]) for key in ("coordinates", "inputs"))
    features = ", ".join(f'"{name}"' for name in [*coordinates, *("d" + c for c in coordinates), *inputs])
    any_force = with_latent(text, features, '"force"')
    if mechanism in ALONG:
        features, directions = ALONG[mechanism]
        return {"any force": any_force, "along": with_latent(text, features, f"{{ force = [{directions}] }}"), "lambda0": text}
    truth = text.index("[truth]")
    return {"any force": any_force, "lambda0": text[:truth].replace("lambda(", "lambda0(") + text[truth:], "lambda": text}


def scores(posterior, states, truth):
    import numpy as np

    predicted = posterior.predict(states)
    error = predicted.mean - truth
    inside = np.abs(error) <= 1.959964 * predicted.std
    return math.sqrt(np.mean(np.sum(error**2, axis=1)) / np.sum(np.var(truth, axis=0))), float(np.mean(inside))


def coefficients(mechanism, x, load):
    """Each latent, the coordinate whose force it is read from, the direction there and the true coefficient."""
    import numpy as np

    if mechanism == "ladder":
        sin, cos, rate = np.sin(x["a"]), np.cos(x["a"]), x["da"]
        foot, head = 1.6 * cos * rate, -1.6 * sin * rate
        at_foot, at_head = np.sqrt(foot**2 + 1e-4), np.sqrt(head**2 + 1e-4)
        return [("floor", 0, -np.abs(load[:, 0]) * foot / at_foot, 0.15 + 0.2 * np.exp(-((at_foot / 0.5) ** 2))),
                ("wall", 1, -np.abs(load[:, 1]) * head / at_head, 0.1 + 0.05 * at_head)]
    if mechanism == "dragged_rod":
        tip, along = x["x"] - 0.3 * np.sin(x["a"]), x["dx"] - 0.3 * np.cos(x["a"]) * x["da"]
        slope, low, high = 0.6 * tip, 0.1, 0.15
    else:
        along, slope, low, high = x["dx"], x["x"], 0.15, 0.25
    v = np.sqrt(along**2 * (1 + slope**2) + 1e-6)
    press = np.abs(load[:, 0]) * np.sqrt(1 + slope**2)
    return [("friction coefficient", 0, -press * along / v, low + high * np.exp(-((v / 0.4) ** 2)))]


def coverage(posterior, mechanism, states):
    import numpy as np

    x = {name: np.asarray(states[name]) for name in states.columns}
    inside = []
    for latent, row, direction, true in coefficients(mechanism, x, posterior.predict(states, "multipliers").mean):
        force = posterior.predict(states, "force", latent=latent)
        inside.append(np.abs(force.mean[:, row] - true * direction) <= 2 * force.std[:, row])
    return float(np.mean(inside))


def main():
    import gp2
    import numpy as np

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, nargs="+", default=[100])
    parser.add_argument("--seeds", type=int, nargs=2, default=[1, 20], help="first and last")
    parser.add_argument("--mechanisms", nargs="+", default=MECHANISMS)
    arguments = parser.parse_args()
    for mechanism, curve in ((m, c) for m in arguments.mechanisms for c in (CURVES if m in ALONG else [None])):
        own_text = text_of(mechanism, curve)
        systems = {name: gp2.System.parse(text, f"{mechanism}: {name}") for name, text in models(mechanism, own_text).items()}
        own = "lambda0" if mechanism in ALONG else "lambda"
        truth = systems[own]
        fast = re.sub(r"^(d\w+ *= *)\[(.*), (.*)\]", lambda m: f"{m[1]}[{2 * float(m[2])}, {2 * float(m[3])}]",
                      own_text, flags=re.M)
        tests = [system.generate(300, seed=1000, noise_std=0) for system in (truth, gp2.System.parse(fast, "fast"))]
        for n in arguments.n:
            errors, covered = {name: [[], []] for name in systems}, [[], []]
            for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
                data = truth.generate(n, seed=seed)
                for name, system in systems.items():
                    posterior = gp2.fit(system, data, mean="force")
                    for k, test in enumerate(tests):
                        values = np.column_stack([test["dd" + c] for c in system.coordinates])
                        error, share = scores(posterior, test, values)
                        errors[name][k].append(error)
                        if name == own and own == "lambda0":
                            covered[k].append(share)
                    if name == "lambda":
                        covered[0].append(coverage(posterior, mechanism, tests[0]))
            text = " | ".join(" · ".join(f"{statistics.median(e):.2g} ({max(e):.2g})" for e in errors[name]) for name in systems)
            shares = " · ".join(f"{statistics.mean(of):.3f} ({min(of):.2f})" for of in covered if of)
            print(f"| {mechanism} | {curve or 'its own'} | {n} | {text} | {shares} |", flush=True)


if __name__ == "__main__":
    main()
