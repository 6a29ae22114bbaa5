"""What a fit to positions gains by windows of time, and by learning and smoothing by turns: simulated encoder logs of many mechanisms.

    python3 experiments/raw_fit.py --gp2 build/test/apps/gp2/gp2 --seeds 21 22 --out cells.csv

A cell is one mechanism, one level of noise (of positions, in parts of their spread) and one seed: `gp2 fit --raw` to rows of a log
smoothed once, to rows of one smoothed by turns, and as it is by default, to windows, scored along the true motion. Errors are those
of the accelerations measured, in parts of their spread.
"""

import argparse
import concurrent.futures
import csv
import json
import math
import os
import pathlib
import random
import statistics
import subprocess
import tempfile
import time

ROOT = pathlib.Path(__file__).parent.parent
MECHANISMS = "experiments/mechanisms/"
# model, start, duration [s], rate [Hz], coordinates measured, inputs: sums of (amplitude, Hz, phase); 0 Hz is constant
LOGS = {
    "crank": ("examples/crank.toml", "phi=0.3,dphi=8", 10, 200, ["phi"], {"torque": [(0.5, 0.4, 0), (0.3, 1.1, 1)]}),
    "crane": (MECHANISMS + "crane.toml", "s=0,x=0.4,z=-1.13", 20, 100, ["s", "x", "z"], {"u": [(8, 0.25, 0), (6, 0.6, 1)]}),
    "hardening_link": (MECHANISMS + "hardening_link.toml", "x1=.25,y1=-.2,x2=.9,y2=.05,dx1=.8,dy1=.5", 8, 200,
                       ["x1", "y1", "x2", "y2"], {}),
    "pulley": (MECHANISMS + "pulley.toml", "a=1", 8, 100, ["a"], {"u": [(-0.39, 0, 0), (0.2, 0.45, 0.5), (0.2, 0.8, 1)]}),
    "surface": ("models/surface.toml", "q1=0.8,q2=-.5,dq1=.6,dq2=.5", 15, 100, ["q1", "q2"],
                {"u1": [(5, 0.2, 0), (3, 0.5, 1)], "u2": [(5, 0.27, 1), (3, 0.6, 2)], "u3": [(2, 0.35, 0)]}),
    "stribeck_bead": (MECHANISMS + "stribeck_bead.toml", "x=.9,z=.405", 20, 100, ["x"], {"push": [(0.8, 0.3, 0), (0.5, 0.7, 1)]}),
    "double_pendulum": ("models/double_pendulum.toml", "q3=2.4,q6=2.0", 10, 200, ["q3", "q6"], {}),
    "cam_follower": (MECHANISMS + "cam_follower.toml", "a=0,y=.07,da=6", 10, 200, ["a"], {"u": [(0.2, 0.4, 0), (0.15, 1, 1)]}),
    "duffing": ("models/duffing.toml", "q1=2,dq1=1", 5, 200, ["q1"], {}),
    "cogging_screw": (MECHANISMS + "cogging_screw.toml", "a=0", 6, 500, ["a"], {"u": [(0.12, 0.5, 0), (0.1, 1.3, 1)]}),
    "saturated_robot": (MECHANISMS + "saturated_robot.toml", "h=0.3", 15, 100, ["x", "y", "h"],
                        {"u1": [(6, 0.2, 0), (5, 0.5, 1)], "u2": [(6, 0.25, 0.5), (5, 0.6, 2)]}),
    "slider_crank": ("models/slider_crank.toml", "q1=0.3,dq1=5", 10, 200, ["q1"], {"u1": [(0.3, 0.4, 0), (0.25, 1, 1)]}),
}
LEVELS = [5e-4, 2.5e-3, 1e-2]
WAYS = {"rows": ["--windows", "none", "--passes", 0], "rows by turns": ["--windows", "none"], "windows": []}


def run(gp2, *arguments):
    done = subprocess.run([gp2, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"gp2 {' '.join(map(str, arguments))}\n{done.stderr}")


def read(path):
    with open(path) as file:
        rows = list(csv.reader(file))
    return {name: [float(row[k]) if row[k] else math.nan for row in rows[1:]] for k, name in enumerate(rows[0])}


def write(path, columns):
    with open(path, "w") as file:
        csv.writer(file).writerows([list(columns), *zip(*columns.values())])


def true_motion(gp2, name, folder):
    model, start, duration, rate, _, inputs = LOGS[name]
    arguments = ["simulate", ROOT / model, "--start", start, "--t-end", duration, "--dt", 1 / rate, "--rtol", 1e-9]
    if inputs:
        times = [k / (2 * rate) for k in range(int(2 * rate * duration) + 3)]
        wave = lambda parts, t: sum(a if f == 0 else a * math.sin(2 * math.pi * f * t + phase) for a, f, phase in parts)
        write(folder / "inputs.csv", {"t": times, **{u: [wave(parts, t) for t in times] for u, parts in inputs.items()}})
        arguments += ["--inputs", folder / "inputs.csv"]
    run(gp2, *arguments, "-o", folder / "truth.csv")
    return read(folder / "truth.csv")


def error(columns, truth, names):
    """Of accelerations, in parts of their spread."""
    parts = [sum((a - b) ** 2 for a, b in zip(columns[n], truth[n])) / len(truth[n]) / statistics.pvariance(truth[n]) for n in names]
    return math.sqrt(sum(parts) / len(parts))


def coverage(columns, truth, names):
    """Of what is said to be within 95 %."""
    inside = [abs(x - y) <= 1.96 * d for n in names if n + "_std" in columns
              for x, y, d in zip(columns[n], truth[n], columns[n + "_std"]) if not math.isnan(d)]
    return sum(inside) / len(inside)


def cell(gp2, name, level, seed, options):
    model, _, _, _, measured, inputs = LOGS[name]
    accelerations = ["dd" + q for q in measured]
    row = {"mechanism": name, "noise": level, "seed": seed}
    with tempfile.TemporaryDirectory() as path:
        folder = pathlib.Path(path)
        truth = true_motion(gp2, name, folder)
        noise = random.Random(f"{name} {level} {seed}")
        log = {"t": truth["t"], **{u: truth[u] for u in inputs}}
        for q in measured:
            stddev = level * statistics.pstdev(truth[q])
            log[q] = [value + noise.gauss(0, stddev) for value in truth[q]]
        write(folder / "log.csv", log)
        for way, chosen in WAYS.items():
            start = time.monotonic()
            run(gp2, "fit", ROOT / model, "--raw", folder / "log.csv", "--mean", "force", "--threads", 1, *chosen, *options,
                "--smoothed", folder / "smoothed.csv", "-o", folder / "fit.json")
            row["seconds, " + way] = time.monotonic() - start
            fitted = json.loads((folder / "fit.json").read_text())["hyperparameters"]
            row["noise factor, " + way] = max(h["value"] for h in fitted if h["kind"] == "noise_stddev")
            run(gp2, "predict", folder / "fit.json", "--states", folder / "truth.csv", "--cov", "std", "-o", folder / "prediction.csv")
            for what, file in (("learned", "prediction.csv"), ("smoothed", "smoothed.csv")):
                columns = read(folder / file)
                row[f"{what}, {way}"] = error(columns, truth, accelerations)
                row[f"{what} within, {way}"] = coverage(columns, truth, accelerations)
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gp2", default="gp2")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--mechanisms", nargs="+", default=list(LOGS))
    parser.add_argument("--out", required=True)
    parser.add_argument("options", nargs="*", help="of gp2 fit, after --")
    asked = parser.parse_args()
    rows = []
    with open(asked.out, "w") as file, concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        cells = [pool.submit(cell, asked.gp2, name, level, seed, asked.options)
                 for name in asked.mechanisms for level in LEVELS for seed in asked.seeds]
        for future in cells:
            rows.append(future.result())
            if len(rows) == 1:
                csv.writer(file).writerow(rows[0])
            csv.writer(file).writerow(rows[-1].values())
            file.flush()
    for what, way, base in (("learned", "rows by turns", "rows"), ("learned", "windows", "rows"), ("smoothed", "rows by turns", "rows")):
        ratios = sorted(row[f"{what}, {way}"] / row[f"{what}, {base}"] for row in rows)
        print(f"{what}, {way} beside {base}: geometric mean of errors {statistics.geometric_mean(ratios):.3f}, worst {ratios[-1]:.2f}; "
              f"above 1.02 {sum(r > 1.02 for r in ratios)} of {len(ratios)}")
    for what in ("learned", "smoothed"):
        for way in WAYS:
            inside = [row[f"{what} within, {way}"] for row in rows]
            print(f"{what} within 95 %, {way}: mean {statistics.mean(inside):.3f}, least {min(inside):.3f}")


if __name__ == "__main__":
    main()
