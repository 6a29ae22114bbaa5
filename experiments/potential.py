"""What a potential gains over a force that knows nothing of energy: error, and how well the learned motion conserves its energy.

    python3 experiments/potential.py --gp2 build/test/apps/gp2/gp2 --seeds 11 12 13 14 15 --out cells.csv

A cell is one system, one kernel and one seed: 50 rows, a fit with directions = "potential" and one with directions = "force" on the
coordinates, whose kernel is the default, each direction with its own, integrated. The network of springs is learned once as one potential of
the coordinates, and once as one potential per spring, of its length. The error is that of ddq at 1000 other states, in parts of its spread.
The drift is the largest change of ½ dqᵀM dq + V along 100 s of the mean's motion, in parts of the largest change of V, V the learned energy;
beside it that of the true motion under the true energy, which is the integrator's.
"""

import argparse
import csv
import json
import math
import pathlib
import statistics
import subprocess
import tempfile

ROOT = pathlib.Path(__file__).parent.parent
FOLDER = ROOT / "experiments/potential"
PENDULUM = "q1=1.2,q2=-0.6,dq1=0.4,dq2=0.3"
NETWORK = "x1=-0.9,y1=-0.3,x2=0.9,y2=-0.5,x3=0.1,y3=1.3,dx1=0.3,dy1=-0.2,dx2=0.2,dy2=0.3,dx3=-0.3,dy3=0.2"
# model, the model whose features the forces have, start of the motion
SYSTEMS = {
    "double_pendulum": ("double_pendulum", PENDULUM),
    "double_pendulum_on_springs": ("double_pendulum_on_springs", PENDULUM),
    "spring_network": ("spring_network", NETWORK),
    "spring_network_lengths": ("spring_network", NETWORK),
}


def run(gp2, *arguments):
    done = subprocess.run([gp2, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"gp2 {' '.join(map(str, arguments))}\n{done.stderr}")
    return done.stdout


def read(path):
    with open(path) as file:
        rows = list(csv.reader(file))
    return {name: [float(row[k]) for row in rows[1:]] for k, name in enumerate(rows[0])}


def kinetic(name, row):
    if name.startswith("spring_network"):
        masses = {"1": 1.0, "2": 1.5, "3": 0.7}
        return sum(0.5 * masses[key[-1]] * value**2 for key, value in row.items() if key[:2] in ("dx", "dy"))
    m1, m2, l1, l2 = 1.0, 0.8, 1.0, 0.7
    a, b = row["dq1"], row["dq2"]
    cross = m2 * l1 * l2 * math.cos(row["q1"] - row["q2"])
    return 0.5 * (m1 + m2) * l1**2 * a**2 + cross * a * b + 0.5 * m2 * l2**2 * b**2


def true_potential(name, row):
    if name.startswith("spring_network"):
        def anchor(k, x, y, x0, y0):
            return k / 4 * ((row[x] - x0) ** 2 + (row[y] - y0) ** 2 - 1.2) ** 2

        def between(k, i, j):
            square = (row[f"x{i}"] - row[f"x{j}"]) ** 2 + (row[f"y{i}"] - row[f"y{j}"]) ** 2 + 0.05
            return 2 * k * (square / 2 - 1.1 * math.sqrt(square))

        return (anchor(4, "x1", "y1", -2, -1) + anchor(4, "x2", "y2", 2, -1) + anchor(3, "x3", "y3", 0, 2.4)
                + between(8, 1, 2) + between(6, 2, 3) + between(7, 1, 3))
    gravity = -1.8 * 9.81 * math.cos(row["q1"]) - 0.8 * 9.81 * 0.7 * math.cos(row["q2"])
    if name == "double_pendulum":
        return gravity
    s = math.sin(row["q1"] - row["q2"])
    return (gravity - 5 * math.cos(row["q1"] - row["q2"]) - 1.5 * math.exp(-2 * s**2) - math.cos(3 * row["q2"]))


def drift(name, motion, energy=None):
    rows = [dict(zip(motion, values)) for values in zip(*motion.values())]
    potential = [row["energy"] - kinetic(name, row) if energy is None else energy(name, row) for row in rows]
    total = [kinetic(name, row) + v for row, v in zip(rows, potential)]
    return (max(total) - min(total)) / (max(potential) - min(potential))


def error(gp2, fit, test):
    out = run(gp2, "evaluate", fit, "--data", test, "--json")
    return json.loads(out)["nrmse"]


def cell(gp2, folder, name, kernel, seed, t_end, more):
    rival_of, at = SYSTEMS[name]
    text, forces = ((FOLDER / f"{which}.toml").read_text() for which in (name, rival_of))
    # the same features for both
    features = "" if "features" in forces else 'features   = ["x1", "y1", "x2", "y2", "x3", "y3"]\n'
    model, rival = folder / "potential.toml", folder / "force.toml"
    own = "" if kernel == "default" else f'kernel     = "{kernel}"\n'
    model.write_text(text.replace('directions = "potential"', own + 'directions = "potential"'))
    rival.write_text(forces.replace('directions = "potential"', features + 'directions = "force"'))
    run(gp2, "generate", model, "--n", 50, "--seed", seed, "-o", folder / "train.csv")
    run(gp2, "generate", model, "--n", 1000, "--seed", 1000 + seed, "--noise-std", 0, "-o", folder / "test.csv")
    out = {"system": name, "kernel": kernel, "seed": seed}
    for which, file in (("potential", model), ("force", rival)):
        run(gp2, "fit", file, "--data", folder / "train.csv", "--mean", "force", *more, "-o", folder / f"{which}.json")
        out[f"error_{which}"] = error(gp2, folder / f"{which}.json", folder / "test.csv")
    start = ["--start", at, "--t-end", t_end, "--dt", t_end / 1000]
    motion = folder / "motion.csv"
    run(gp2, "simulate", folder / "potential.json", *start, "-o", motion)
    out["drift_learned"] = drift(name, read(motion))
    run(gp2, "simulate", model, *start, "-o", motion)
    out["drift_true"] = drift(name, read(motion), true_potential)
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gp2", default="gp2", help="the command")
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13, 14, 15])
    parser.add_argument("--kernels", nargs="+", default=["default"])
    parser.add_argument("--t-end", type=float, default=100)
    parser.add_argument("--out", help="CSV of all cells")
    parser.add_argument("--fit", nargs="*", default=[], help="more options of gp2 fit, without their dashes: hyperparameters=optimise")
    arguments = parser.parse_args()
    more = [part for option in arguments.fit for part in ("--" + option).split("=")]
    gp2 = str(pathlib.Path(arguments.gp2).resolve()) if "/" in arguments.gp2 else arguments.gp2
    cells = []
    for name in SYSTEMS:
        for kernel in arguments.kernels:
            for seed in arguments.seeds:
                with tempfile.TemporaryDirectory() as folder:
                    cells.append(cell(gp2, pathlib.Path(folder), name, kernel, seed, arguments.t_end, more))
            own = [c for c in cells if c["system"] == name and c["kernel"] == kernel]

            def median(key):
                return statistics.median(c[key] for c in own)

            ratio = statistics.median(c["error_potential"] / c["error_force"] for c in own)
            print(f"{name:28} {kernel:12} error {median('error_potential'):.4f} and {median('error_force'):.4f}, ratio {ratio:.2f}; "
                  f"drift {max(c['drift_learned'] for c in own):.1e} and {max(c['drift_true'] for c in own):.1e} at most", flush=True)
    if arguments.out:
        with open(arguments.out, "w") as file:
            writer = csv.DictWriter(file, list(cells[0]))
            writer.writeheader()
            writer.writerows(cells)


if __name__ == "__main__":
    main()
