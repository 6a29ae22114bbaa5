"""How accurate fits of small logs are, and how honest: many mechanisms, priors, seeds and numbers of rows.

    PYTHONPATH=build/test/python python3 experiments/accuracy.py --half report --n 20 50 --seeds 1 2 --out cells.csv
    python3 experiments/accuracy.py --table cells.csv

A cell is one mechanism, one N and one seed. Each prior is fitted to the same N noisy rows with the known force as mean, and scored on
300 fresh states without noise, and on the same with the velocities doubled. With --motions also: the share of the true motion, 5 s from
fresh states under held inputs, that lies between the least and the greatest of 39 sampled motions, which hold 38/40 of what is drawn as they
are. Mechanisms are those of experiments/mechanisms and models,
in the order of their names; every other one belongs to the half to choose on.

With --along a model's one latent is replaced by those of ALONG: curves of a few features along the directions in which the unknown forces
act, as of a user who knows where friction, drag and springs are.
"""

import argparse
import csv
import math
import pathlib
import re
import statistics
import sys
import time

FOLDER = pathlib.Path(__file__).parent
# what a latent is made of, and what its hyperparameters are
PRIORS = {
    "today": ('kernel = "se"\n', {"hyperparameters": "optimise"}),
    "default": ("", {}),
    "no discrepancy": ("", {"discrepancy": False}),
    "default optimised": ("", {"hyperparameters": "optimise"}),
    "and quadratic": ('kernel = "rq + linear + linear*linear"\nlengthscales = "per direction"\n', {}),
    "se + linear": ('kernel = "se + linear"\nlengthscales = "per direction"\n', {}),
    "se + matern32 + linear": ('kernel = "se + matern32 + linear"\nlengthscales = "per direction"\n', {}),
    "rq + linear": ('kernel = "rq + linear"\nlengthscales = "per direction"\n', {}),
    "rq + linear shared": ('kernel = "rq + linear"\n', {"hyperparameters": "integrate", "discrepancy": False}),
    "scikit-learn": ("", None),
}
# features: entries of the force that they act along
ALONG = {
    "cam_follower": {"da": "1, 0", "y": "0, 1"},
    "cogging_screw": {"a, da": "1, 0", "ds": "0, 1"},
    "crane": {"ds": "1, 0, 0", "v": "0, -dx, -dz"},
    "double_pendulum": {"dq3": "0, 0, 1, 0, 0, 0", "dq6 - dq3": "0, 0, 0, 0, 0, 1"},
    "duffing": {"q1 - q2": "1, -1", "q2": "0, 1"},
    "hardening_link": {"sqrt(x1^2 + y1^2)": "-x1, -y1, 0, 0", "sqrt(dx1^2 + dy1^2)": "-dx1, -dy1, 0, 0",
                       "sqrt(dx2^2 + dy2^2)": "0, 0, -dx2, -dy2"},
    "helix_drag": {"v": "-dx, -dy, -dz"},
    "pulley": {"z1": "1, 0, 0", "dz2": "0, 1, 0", "da": "0, 0, 1"},
    "rolling_disk": {"sqrt(dx^2 + dy^2)": "-dx, -dy, 0, 0", "dh": "0, 0, 1, 0", "dr": "0, 0, 0, 1"},
    "saturated_robot": {"u1": "cos(h), sin(h), -b", "u2": "cos(h), sin(h), b", "sqrt(dx^2 + dy^2)": "-dx, -dy, 0", "dh": "0, 0, 1"},
    "scissor_lift": {"ds, u": "1, 0", "dy": "0, 1"},
    "slider_crank": {"dq3": "0, 0, 1"},
    "stribeck_bead": {"v": "-dx/v, -dz/v"},
    "surface": {"speed": "-dq1, -dq2, -dq3"},
    "turntable": {"v": "-rx, -ry"},
    "two_link_tip": {"da": "1, 0", "da, db": "0, 1"},
    "unicycle": {"speed": "-dq1, -dq2, 0"},
}
# no plain latent in every direction
LEFT_OUT = {"massless_rod", "four_bar"}
FIGURES = ["nrmse", "coverage", "nrmse 2x", "coverage 2x", "seconds", "coverage motions"]


def mechanisms(half):
    files = sorted([*FOLDER.glob("mechanisms/*.toml"), *(FOLDER.parent / "models").glob("*.toml")], key=lambda f: f.name)
    files = [f for f in files if f.stem not in LEFT_OUT and len(re.findall(r"^\[\[latent\]\]", f.read_text(), re.M)) == 1
             and not re.search(r"^directions *= *[\[{]", f.read_text(), re.M)]
    return {"choose": files[::2], "report": files[1::2], "all": files}[half]


def with_prior(file, latent, along):
    import gp2

    text = re.sub(r"^(kernel|lengthscales) *=.*\n", "", file.read_text(), flags=re.M)
    if along:
        quoted = lambda names: ", ".join(f'"{name.strip()}"' for name in names.split(","))
        latents = [f'[[latent]]\nname = "{features}"\nfeatures = [{quoted(features)}]\n'
                   f'directions = {{ force = [{", ".join(f"[{quoted(entry)}]" for entry in directions.split(","))}] }}\n\n'
                   for features, directions in ALONG[file.stem].items()]
        text = re.sub(r"^\[\[latent\]\]\n.*?(?=^\[)", lambda _: "".join(latents), text, flags=re.M | re.S)
    return gp2.System.parse(text.replace("[[latent]]\n", "[[latent]]\n" + latent), str(file))


def scores(predict, states, truth):
    import numpy as np

    mean, std = predict(states)
    error = mean - truth
    spread = math.sqrt(np.sum(np.var(truth, axis=0)))
    # what the constraint decides has no deviation but rounding's
    decided = std < 1e-7 * spread
    inside = np.abs(error) <= 1.959964 * std
    return [math.sqrt(np.mean(np.sum(error**2, axis=1))) / spread, float(np.mean(inside[~decided]))]


def motion_coverage(system, posterior, starts, seed):
    import gp2
    import numpy as np

    times, nq = np.linspace(0, 5, 51), len(system.coordinates)
    names = [*system.coordinates, *("d" + c for c in system.coordinates)]
    shares = []
    for start in np.nan_to_num(starts):  # NaN: what nothing reads
        inputs = {name: np.full(2, value) for name, value in zip(system.inputs, start[len(start) - len(system.inputs):])}
        arguments = [dict(zip(names, start)), times, {"t": times[[0, -1]], **inputs} if inputs else None]
        true = gp2.simulate(system, *arguments).states[1:, :nq]
        drawn = np.array([motion.states[1:, :nq] for motion in posterior.simulate(*arguments, n_samples=39, seed=seed)])
        decided = np.ptp(drawn, axis=0) <= 1e-9 * (1 + np.abs(true))
        inside = (true >= drawn.min(axis=0)) & (true <= drawn.max(axis=0))
        shares.append(np.mean(inside[~decided]))
    return float(np.mean(shares)) if shares else math.nan


def cell(file, prior, n, seed, threads, motions=0, along=False):
    import gp2
    import numpy as np

    latent, options = PRIORS[prior]
    system = with_prior(file, latent, along)
    began = time.monotonic()
    if options is None:
        posterior, motions = None, 0
        predict = ordinary_gp(system, n, seed)
    else:
        posterior = gp2.fit(system, system.generate(n, seed=seed), mean="force", estimate=[], threads=threads, **options)

        def predict(states):
            prediction = posterior.predict(states)
            return prediction.mean, prediction.std

    seconds = time.monotonic() - began
    slow = np.array(system.states(system.generate(300, seed=seed + 5000, noise_std=0.0)))
    fast = slow.copy()
    nq = len(system.coordinates)
    fast[:, nq : 2 * nq] *= 2
    starts = np.array(system.states(system.generate(motions, seed=seed + 7000, noise_std=0.0))) if motions else []
    return [*scores(predict, slow, system.true_acceleration(slow)), *scores(predict, fast, system.true_acceleration(fast)), seconds,
            motion_coverage(system, posterior, starts, seed)]


def ordinary_gp(system, n, seed):
    """What scikit-learn predicts from the whole state: for each acceleration the most likely of five kernels, with own lengthscales and the
    true noise. It learns what the known force under the constraint does not explain, as the others do by their prior mean."""
    import warnings

    import numpy as np
    from sklearn.gaussian_process import GaussianProcessRegressor, kernels

    def known(states):
        mechanics = system.evaluate(states)
        accelerations = []
        for M, A, b, F in zip(mechanics.M, mechanics.A, mechanics.b, mechanics.F):
            zero = np.zeros((len(b), len(b)))
            accelerations.append(np.linalg.lstsq(np.block([[M, A.T], [A, zero]]), np.concatenate([F, b]), rcond=None)[0][: len(F)])
        return np.array(accelerations)

    train, exact = system.generate(n, seed=seed), system.generate(n, seed=seed, noise_std=0.0)
    measured = np.column_stack([train[name] for name in system.acceleration_names])
    noise = np.std(measured - np.column_stack([exact[name] for name in system.acceleration_names]), axis=0)
    states = np.array(system.states(train))
    varies = np.ptp(np.nan_to_num(states), axis=0) > 0  # NaN: what nothing reads
    centre, scale = states[:, varies].mean(axis=0), states[:, varies].std(axis=0)
    unknown = measured - known(states)
    own = np.ones(np.count_nonzero(varies))
    forms = [kernels.RBF(own), kernels.Matern(own, nu=1.5), kernels.Matern(own, nu=2.5), kernels.RationalQuadratic(),
             kernels.RBF(own) + kernels.ConstantKernel() * kernels.DotProduct()]
    regressors = []
    for values, deviation in zip(unknown.T, noise):
        size = np.std(values)
        fits = [GaussianProcessRegressor(kernels.ConstantKernel() * form, alpha=(deviation / size) ** 2, n_restarts_optimizer=2,
                                         random_state=seed) for form in forms]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of lengthscales at their bounds, for features that do not matter
            for fit in fits:
                fit.fit((states[:, varies] - centre) / scale, values / size)
        regressors.append((max(fits, key=lambda fit: fit.log_marginal_likelihood_value_), size))

    def predict(states):
        parts = [fit.predict((states[:, varies] - centre) / scale, return_std=True) for fit, _ in regressors]
        means, stds = ([part[k] * size for part, (_, size) in zip(parts, regressors)] for k in (0, 1))
        return known(states) + np.column_stack(means), np.column_stack(stds)

    return predict


def covered(rows, keys, figure):
    """The mean over mechanisms, and the worst of them."""
    shares = {}
    for key in keys:
        shares.setdefault(key[0], []).append(float(rows[key][figure]))
    means = {mechanism: statistics.fmean(of) for mechanism, of in shares.items()}
    worst = min(means, key=means.get)
    return f"{statistics.fmean(means.values()):.3f} ({means[worst]:.2f} {worst})"


def table(path):
    cells = {}
    for row in csv.DictReader(open(path)):
        cells.setdefault(row["prior"], {})[row["mechanism"], int(row["n"]), row["seed"]] = row
    beside = "today" if "today" in cells else next(iter(cells))
    for n in sorted({key[1] for rows in cells.values() for key in rows}):
        print(f"N = {n}: nRMSE beside {beside} (geometric mean, worst cell), coverage (mean, worst mechanism over its seeds)")
        for prior, rows in cells.items():
            keys = [k for k in rows if k[1] == n and k in cells[beside]]
            if not keys:
                continue
            line = f"  {prior:20} {len(keys):3} cells"
            for figure in ("", " 2x"):
                ratio = {k: float(rows[k]["nrmse" + figure]) / float(cells[beside][k]["nrmse" + figure]) for k in keys}
                mean = math.exp(statistics.fmean(math.log(r) for r in ratio.values()))
                worst = max(ratio, key=ratio.get)
                line += f" |{figure} {mean:.2f} ({ratio[worst]:.2f} {worst[0]}), {covered(rows, keys, 'coverage' + figure)}"
            if all(rows[k]["coverage motions"] not in ("", "nan") for k in keys):
                line += f" | motions {covered(rows, keys, 'coverage motions')}"
            print(line + f" | {statistics.median(float(rows[k]['seconds']) for k in keys):.1f} s")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--half", choices=["choose", "report", "all"], default="choose")
    parser.add_argument("--n", type=int, nargs="+", default=[20, 50, 100])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--priors", nargs="+", choices=PRIORS, default=["today", "default"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--motions", type=int, default=0, help="how many of each cell")
    parser.add_argument("--along", action="store_true", help="latents along given directions")
    parser.add_argument("--out", type=pathlib.Path, help="CSV file that cells are added to")
    parser.add_argument("--table", type=pathlib.Path, help="print the table of such a file instead")
    arguments = parser.parse_args()
    if arguments.table:
        table(arguments.table)
        return
    is_new = not arguments.out or not arguments.out.exists()
    with open(arguments.out, "a") if arguments.out else sys.stdout as out:
        writer = csv.writer(out)
        if is_new:
            writer.writerow(["mechanism", "prior", "n", "seed", *FIGURES])
        for n in arguments.n:
            for seed in arguments.seeds:
                for file in mechanisms(arguments.half):
                    for prior in arguments.priors:
                        figures = cell(file, prior, n, seed, arguments.threads, arguments.motions, arguments.along)
                        writer.writerow([file.stem, prior, n, seed, *(f"{f:.5g}" for f in figures)])
                        out.flush()


if __name__ == "__main__":
    main()
