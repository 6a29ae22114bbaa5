"""A puck at an edge and a puck at a cushion: rigid contacts with restitution beside a smooth spring-damper contact.

    PYTHONPATH=build/test/python python3 experiments/contacts.py --seeds 1 10

edge     a puck slides over a table, leaves it at its rounded edge, falls and bounces on the floor. The true contact is rigid.
cushion  a puck slides against a cushion, comes back and sticks. The true cushion is a spring that stiffens, about 10 ms of contact, which gives
         back 0.4 of its energy (hysteresis), or loses more the faster it is hit (Hunt & Crossley); of the latter gp2 has e = 1 − c|ẋ|.

Six training motions at 100 Hz, with noise of 1 mm, 5 mm/s and 0.05 m/s², are given to both. gp2 learns the friction coefficient from their
rows on the table, the restitution by shooting, and simulates with contacts. The smooth model has the friction that gp2 learned, and the
stiffness and damping of a grid, refined once, whose motions are nearest to the training motions. Printed are errors of 20 other motions:
root mean square of the position along a motion, in mm, median and worst of all motions and seeds.
"""

import argparse
import re
import warnings

MASS, GRAVITY, EDGE = 0.2, 9.81, 0.01
EDGE_MODEL = """
coordinates = ["x", "z"]
inputs = ["touch"]
[parameters]
e = 0.6
[let]
h  = "0.8/(1 + exp(x/0.01))"
hx = "-80*exp(x/0.01)/(1 + exp(x/0.01))^2"
v  = "(dx + hx*dz)/sqrt(1 + hx^2)"
press = "abs(lambda(1))*sqrt(1 + hx^2)*h/0.8"
[mechanics]
mass  = [["0.2", "0"], ["0", "0.2"]]
force = ["0", "-0.2*9.81"]
[constraints]
position = [{ expr = "z - h", contact = "touch", restitution = "e" }]
[[latent]]
name = "friction"
kernel = "se"
features = ["abs(v)"]
directions = { force = [["-0.3*press*sign(v)/sqrt(1 + hx^2)"], ["-0.3*press*sign(v)*hx/sqrt(1 + hx^2)"]] }
[noise]
ddq = 0.05
[truth]
force = ["-(0.15 + 0.2*exp(-(v/0.4)^2))*press*sign(v)/sqrt(1 + hx^2)", "-(0.15 + 0.2*exp(-(v/0.4)^2))*press*sign(v)*hx/sqrt(1 + hx^2)"]
"""
CUSHION_MODEL = """
coordinates = ["x", "z"]
inputs = ["touch"]
[parameters]
e = 0.6
[mechanics]
mass  = [["0.2", "0"], ["0", "0.2"]]
force = ["0", "-0.2*9.81"]
[constraints]
position = ["z", { expr = "-x", contact = "touch", restitution = "e" }]
[[latent]]
name = "friction"
kernel = "se"
features = ["abs(dx)"]
directions = { force = [["-0.3*abs(lambda(1))*sign(dx)"], ["0"]] }
[noise]
ddq = 0.05
[truth]
force = ["-(0.15 + 0.2*exp(-(dx/0.4)^2))*abs(lambda(1))*sign(dx)", "0"]
"""


def with_spring(loss):
    """The cushion's model with a spring in the place of the contact."""
    text = re.sub(r', \{ expr = "-x".*?\}', "", CUSHION_MODEL)
    before, truth = text.split("[truth]")
    return before + "[truth]" + truth.replace('", "0"]', f' - max(0, 3e5*max(x, 0)^1.5*{loss})", "0"]')


GROWING = CUSHION_MODEL.replace('restitution = "e"', 'restitution = "max(0, 1 - (1 - e)*abs(dx))"')
CASES = {
    "edge": ({"contact": EDGE_MODEL}, EDGE_MODEL),
    "cushion, hysteresis": ({"contact": CUSHION_MODEL}, with_spring("(0.7 + 0.3*sign(dx))")),
    "cushion, Hunt & Crossley": ({"contact, e": CUSHION_MODEL, "contact, e(v)": GROWING}, with_spring("(1 + 0.3*dx)")),
}
SPEEDS, END = (2.0, 3.0), 1.6


def starts(is_edge, speeds):
    """States on the table, a metre before the edge or the cushion."""
    return [[-1.0, 0.8 if is_edge else 0.0, speed, 0.0] for speed in speeds]


def smooth_motions(is_edge, coefficient, start, stiffness, ratio, times, dt=2e-4):
    """Motions (len(stiffness), len(start), len(times), 2) of a spring-damper contact, by the classical Runge–Kutta method."""
    import numpy as np

    k, damping = (a[:, None] * np.ones(len(start)) for a in (stiffness, 2 * ratio * np.sqrt(stiffness * MASS)))
    y = np.broadcast_to(np.array(start).T[:, None, :], (4, len(stiffness), len(start))).copy()
    speeds, values = coefficient
    if is_edge:
        y[1] -= MASS * GRAVITY / k  # pressed in by its weight

    def rate(y):
        x, z, dx, dz = y
        if not is_edge:
            push = np.maximum(0, k * x + damping * dx) * (x > 0)
            friction = np.interp(np.abs(dx), speeds, values) * MASS * GRAVITY * dx / np.sqrt(dx**2 + 1e-6)
            return np.stack([dx, dz, (-push - friction) / MASS, 0 * dz])
        s = 1 / (1 + np.exp(np.clip(x / EDGE, -60, 60)))
        slope = -0.8 / EDGE * s * (1 - s)
        root = np.sqrt(1 + slope**2)
        # normal to the table and along it
        gap, opening, v = (z - 0.8 * s) / root, (dz - slope * dx) / root, (dx + slope * dz) / root
        push = np.maximum(0, -k * gap - damping * opening) * (gap < 0)
        friction = np.interp(np.abs(v), speeds, values) * push * s * v / np.sqrt(v**2 + 1e-6)
        return np.stack([dx, dz, (-push * slope - friction) / root / MASS, (push - friction * slope) / root / MASS - GRAVITY])

    out = np.empty((len(stiffness), len(start), len(times), 2))
    every = round((times[1] - times[0]) / dt)
    for i in range(len(times)):
        out[:, :, i] = np.moveaxis(y[:2], 0, -1)
        for _ in range(every if i + 1 < len(times) else 0):
            k1 = rate(y)
            k2 = rate(y + dt / 2 * k1)
            k3 = rate(y + dt / 2 * k2)
            y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + dt * k3))
    return out


def tuned(is_edge, coefficient, start, measured, times):
    """Stiffness and damping ratio of the smooth model whose motions are nearest to the measured ones."""
    import numpy as np

    centre, width = np.array([4.5, -0.5]), np.array([1.5, 1.0])
    for _ in range(3):
        grid = np.stack(np.meshgrid(*(np.linspace(c - w, c + w, 9) for c, w in zip(centre, width))), -1).reshape(-1, 2)
        motions = smooth_motions(is_edge, coefficient, start, 10 ** grid[:, 0], 10 ** grid[:, 1], times)
        errors = np.mean((motions - measured) ** 2, axis=(1, 2, 3))
        centre, width = grid[np.nanargmin(errors)], width / 4
    return 10 ** centre[:1], 10 ** centre[1:]


def run(case, seed):
    import gp2
    import numpy as np

    texts, truth_text = CASES[case]
    is_edge = case == "edge"
    truth = gp2.System.parse(truth_text, case)
    times = np.linspace(0, END, 161)
    random = np.random.default_rng(seed)

    def motions(n):
        start = starts(is_edge, random.uniform(*SPEEDS, n))
        return start, [gp2.simulate(truth, one, times, rtol=1e-9, atol=1e-12) for one in start]

    start, training = motions(6)
    columns = {name: [] for name in ["t", "x", "z", "dx", "dz", "ddx", "ddz", "touch", "episode"]}
    for episode, motion in enumerate(training):
        # a cushion that is pressed in is never closed for more than a row or two: its log has no contact
        touch = motion.states[:, 5] if is_edge else np.zeros(len(times))
        noisy = [a + s * random.standard_normal(a.shape) for a, s in ((motion.q, 1e-3), (motion.dq, 5e-3), (motion.ddq, 0.05))]
        if not is_edge:
            noisy[0][:, 1] = noisy[1][:, 1] = noisy[2][:, 1] = 0
        for name, values in zip(columns, [times, *np.hstack(noisy).T, touch, np.full(len(times), episode)]):
            columns[name].extend(values)
    columns = {name: np.array(values) for name, values in columns.items()}
    slides = (columns["x"] < -0.1) & (np.abs(columns["dx"]) > 0.05)
    rows = {name: values[slides] for name, values in columns.items()}
    measured = np.array([np.column_stack([columns[c][columns["episode"] == k] for c in "xz"]) for k in range(len(start))])
    test_start, test = motions(20)
    true = np.array([motion.q for motion in test])
    found, predicted = {}, {}
    for name, text in texts.items():
        model = gp2.System.parse(text.replace("e = 0.6", "e = { value = 0.8, estimate = true, bounds = [0.4, 1] }"), case)
        posterior, report = gp2.fit(model, rows, mean="force", max_points=100).shoot(columns, duration=0.6)
        (found[name],) = (one["value"] for one in report["parameters"].values())
        predicted[name] = np.array([posterior.simulate(one, times).q for one in test_start])
    v = np.linspace(0, SPEEDS[1], 61)
    one = np.ones_like(v)
    at = np.column_stack([-0.5 * one, 0.8 * is_edge * one, np.maximum(v, 1e-9), 0 * v, 0 * v, is_edge * one])
    coefficient = v, -posterior.predict(at, "force", latent="friction", mean_only=True).mean[:, 0] / (MASS * GRAVITY)
    contact = tuned(is_edge, coefficient, start, measured, times)
    found["stiffness"], found["damping ratio"] = (float(one[0]) for one in contact)
    predicted["smooth"] = smooth_motions(is_edge, coefficient, test_start, *contact, times)[0]
    errors = {name: np.sqrt(np.mean(np.sum((one - true) ** 2, axis=2), axis=1)) * 1e3 for name, one in predicted.items()}
    return errors, found


def main():
    import numpy as np

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=[1, 10], help="first and last")
    arguments = parser.parse_args()
    # free fall is not in the rows on the table, from which no restitution can be told either
    warnings.filterwarnings("ignore", "the motion leaves the region of the data|the data do not determine e")
    for case in CASES:
        cells = {}
        for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
            errors, found = run(case, seed)
            for name, error in errors.items():
                cells.setdefault(name, []).append(error)
            text = ", ".join(f"{name} {np.median(error):.3g} ({max(error):.3g}) mm" for name, error in errors.items())
            print(f"{case}, seed {seed}: {text}; " + ", ".join(f"{name} {value:.4g}" for name, value in found.items()), flush=True)
        text = " | ".join(f"{name} {np.median(all_):.2g} ({np.max(all_):.2g})" for name, all_ in cells.items())
        print(f"| {case} | {text} |", flush=True)


if __name__ == "__main__":
    main()
