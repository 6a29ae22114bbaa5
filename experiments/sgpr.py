"""The bound of inducing points as it is usually written, with a jitter, in NumPy and in GPyTorch: its time and its failures beside gp2's.

    PYTHONPATH=build/test/python python3 experiments/sgpr.py write problems.npz
    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 python3 experiments/sgpr.py time problems.npz build/release/benchmarks/likelihood_benchmark
    python3 experiments/sgpr.py noise problems.npz

All evaluate the same number: the bound of Titsias (2009) for the particle on a surface, in the reduced space of docs/theory.md, T37,
at the same inducing points. In NumPy all 3m inducing variables stand beside all 2N reduced measurements as one matrix, K(Z, Z) is
factored with a jitter on its diagonal, and the gradient is written by hand. GPyTorch, where it is installed, has the same model: a row
of T37 and a direction of an inducing variable are three columns more, and the kernel is a squared exponential times a scalar product.
"""

import argparse
import importlib.util
import json
import math
import os
import pathlib
import statistics
import subprocess
import tempfile
import time
import warnings

import numpy as np
from scipy.linalg import cholesky, solve_triangular

SURFACE = pathlib.Path(__file__).parent.parent / "models" / "surface.toml"


class Reduced:
    """ỹ_i = R_i ā_i + ε_i with ε_i ~ N(0, I): QR_i = Σ^{-1/2} T_i, which has rank 2. What Q does not see is a constant."""

    def __init__(self, R, y, constant):
        self.R, self.y, self.constant = R, y, float(constant)  # (N, 2, 3), (N, 2)

    @classmethod
    def of(cls, system, states, accelerations, noise):
        mechanics = system.evaluate(states)
        inverse = np.linalg.inv(mechanics.M)
        A, At = mechanics.A, np.swapaxes(mechanics.A, 1, 2)
        L = inverse @ At @ np.linalg.inv(A @ inverse @ At)
        b = mechanics.b[..., None] if mechanics.b.ndim == 2 else mechanics.b
        T = np.eye(3) - L @ A
        residual = (accelerations - (L @ b)[..., 0]) / noise
        U, S, Vt = np.linalg.svd(T / noise)
        y = np.einsum("nkc,nk->nc", U[:, :, :2], residual)
        rest = np.sum(residual**2) - np.sum(y**2)
        return cls(S[:, :2, None] * Vt[:, :2], y, 0.5 * rest + residual.size * (math.log(noise) + 0.5 * math.log(2 * math.pi)))


def bound(reduced, X, Z, lengthscales, signals, jitter, gradient=True):
    """The bound on −log p, and its derivatives in log lengthscales and log signals. A squared exponential of variance 1 for each of
    three functions; jitter is added to its value at the points."""
    N, m = len(X), len(Z)
    x, z = X / lengthscales, Z / lengthscales

    def kernel(a, b):
        return np.exp(a @ b.T - 0.5 * np.sum(a**2, 1)[:, None] - 0.5 * np.sum(b**2, 1))

    Kuu, Kuf = kernel(z, z), kernel(z, x)
    L = cholesky(Kuu + jitter * np.eye(m), lower=True)
    W = solve_triangular(L, Kuf, lower=True)
    Gamma = reduced.R * signals  # (N, 2, 3)
    weights = np.ascontiguousarray(Gamma.transpose(2, 1, 0))  # (3, 2, N)
    Psi = (weights[:, None] * W[None, :, None, :]).reshape(3 * m, 2 * N)
    y = reduced.y.T.reshape(-1)
    B = Psi @ Psi.T
    B[np.diag_indices_from(B)] += 1
    LB = cholesky(B, lower=True)
    mean = solve_triangular(LB, Psi @ y, lower=True)
    mean = solve_triangular(LB, mean, lower=True, trans=1)
    misfit = y - Psi.T @ mean
    trace = np.sum(weights**2) - np.sum(Psi**2)
    value = reduced.constant + np.sum(np.log(np.diag(LB))) + 0.5 * (misfit @ misfit + mean @ mean + trace)
    if not gradient:
        return value
    inverse = solve_triangular(LB, np.eye(3 * m), lower=True)
    inverse = inverse.T @ inverse
    inverse[np.diag_indices_from(inverse)] -= 1
    G = inverse @ Psi - np.outer(mean, misfit)  # ∂/∂Ψ
    G = G.reshape(3, m, 2, N)
    of_signals = np.sum(weights**2, axis=(1, 2)) + np.einsum("ajcn,acn,jn->a", G, weights, W, optimize=True)
    of_W = np.einsum("ajcn,acn->jn", G, weights, optimize=True)
    of_Kuf = solve_triangular(L, of_W, lower=True, trans=1)
    of_L = -np.tril(of_Kuf @ W.T)
    P = np.tril(L.T @ of_L)
    P[np.diag_indices_from(P)] *= 0.5
    of_Kuu = solve_triangular(L, solve_triangular(L, P.T, lower=True, trans=1).T, lower=True, trans=1)
    of_Kuu = 0.5 * (of_Kuu + of_Kuu.T)

    def of_lengthscales(H, a, b):  # Σ H ∘ (a − b)²
        return H.sum(1) @ a**2 + H.sum(0) @ b**2 - 2 * np.sum(a * (H @ b), 0)

    return value, np.concatenate([of_lengthscales(of_Kuf * Kuf, z, x) + of_lengthscales(of_Kuu * Kuu, z, z), of_signals])


class GPyTorchBound:
    """The same bound by InducingPointKernel, with derivatives in the same numbers.

    signal  the deviation of each function
    scale   of the measurements, whose noise is 1 without it: as users do, a function is brought to a size of about 1
    """

    def __init__(self, reduced, X, Z, lengthscales, signal, scale, jitter=None):
        import gpytorch
        import torch

        self.settings, self.jitter = gpytorch.settings, jitter
        tensor = torch.as_tensor
        N, m = len(X), len(Z)
        rows = np.concatenate([np.repeat(X, 2, axis=0), scale * signal * reduced.R.reshape(2 * N, 3)], axis=1)
        points = np.concatenate([np.repeat(Z, 3, axis=0), np.tile(np.eye(3), (m, 1))], axis=1)
        y = scale * reduced.y.reshape(-1)
        self.constant = reduced.constant - N * math.log(2 * math.pi) - 2 * N * math.log(scale)

        likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=gpytorch.constraints.GreaterThan(1e-300))

        class GaussKernel(gpytorch.kernels.Kernel):
            def __init__(self):
                super().__init__()
                self.register_parameter("log_lengthscales", torch.nn.Parameter(tensor(np.log(lengthscales))))
                self.register_parameter("log_signals", torch.nn.Parameter(torch.zeros(3)))

            def forward(self, x1, x2, diag=False, **options):
                scale = self.log_lengthscales.exp()
                smooth = self.covar_dist(x1[..., :9] / scale, x2[..., :9] / scale, diag=diag, square_dist=True).div(-2).exp()
                one, other = x1[..., 9:] * self.log_signals.exp(), x2[..., 9:] * self.log_signals.exp()
                return smooth * ((one * other).sum(-1) if diag else one @ other.transpose(-1, -2))

        class Model(gpytorch.models.ExactGP):
            def __init__(self):
                super().__init__(tensor(rows), tensor(y), likelihood)
                self.mean_module = gpytorch.means.ZeroMean()
                self.covar_module = gpytorch.kernels.InducingPointKernel(GaussKernel(), tensor(points), likelihood)

            def forward(self, x):
                return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

        self.model = Model().double()
        likelihood.double()
        likelihood.noise = scale**2
        likelihood.raw_noise.requires_grad_(False)
        self.model.covar_module.inducing_points.requires_grad_(False)
        self.marginal = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, self.model)
        self.rows, self.y = tensor(rows), tensor(y)
        self.model.train()

    def value(self, gradient=True):
        self.model.zero_grad()
        jitter = {} if self.jitter is None else {"double_value": self.jitter}
        with self.settings.cholesky_jitter(**jitter):
            loss = -self.marginal(self.model(self.rows), self.y)
            if gradient:
                loss.backward()
        return self.constant + len(self.y) * loss.item()


def system_and_states(n):
    """A motion that is logged often, so that its states are nearly alike."""
    import gp2

    system = gp2.System.load(str(SURFACE))
    t = np.linspace(0, 12, n)
    p = system.parameters
    q1, q2, dq1, dq2 = 1.5 * np.sin(t), 1.5 * np.cos(0.7 * t), 1.5 * np.cos(t), -1.05 * np.sin(0.7 * t)
    q3 = p["p1"] * q1**2 + p["p2"] * q2**2 + p["p3"] * q1 * q2 + p["p4"] * np.cos(p["p5"] * q1)
    slope1 = 2 * p["p1"] * q1 + p["p3"] * q2 - p["p4"] * p["p5"] * np.sin(p["p5"] * q1)
    dq3 = slope1 * dq1 + (2 * p["p2"] * q2 + p["p3"] * q1) * dq2
    return system, np.column_stack([q1, q2, q3, dq1, dq2, dq3, t, 3 * np.sin(2 * t), 3 * np.cos(1.3 * t), 29 + np.cos(0.5 * t)])


def problem(n, noise):
    system, states = system_and_states(n)
    accelerations = system.true_acceleration(states) + noise * np.random.default_rng(1).standard_normal((n, 3))
    read = [k for k, name in enumerate(system.state_names) if name != "t"]
    return system, states, accelerations, Reduced.of(system, states, accelerations, noise), states[:, read]


SIGNAL = 10.0
RATIOS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


def write(path, sizes, n, most):
    """What the others need: the problems of `time`, and those of `noise` with what gp2 finds for them."""
    import gp2

    arrays = {}

    def keep(name, **values):
        arrays.update({f"{name}/{key}": value for key, value in values.items()})

    for size in sizes:
        *_, reduced, X = problem(size, 0.1)
        keep(f"time/{size}", X=X, **vars(reduced))
    for ratio in RATIOS:
        noise = ratio * SIGNAL
        system, *data, reduced, X = problem(n, noise)
        lengthscales = 2 * X.std(0)
        start = {f"lengthscale({name})": value for name, value in zip([s for s in system.state_names if s != "t"], lengthscales)}
        start |= {f"signal_stddev({name})": SIGNAL for name in system.acceleration_names}
        options = dict(estimate=[], noise_std=noise, discrepancy=False, hyperprior=False, thin=False, start=start, max_iterations=0,
                       hyperparameters="optimise", threads=1)
        exact = gp2.fit(system, tuple(data), inducing="none", **options).report.negative_log_likelihood
        posterior = gp2.fit(system, tuple(data), inducing=most, **options)
        with tempfile.TemporaryDirectory() as folder:
            posterior.save(f"{folder}/fit.json")
            points = json.loads(pathlib.Path(f"{folder}/fit.json").read_text())["report"]["inducing"]["points"]
        keep(f"noise/{ratio}", X=X, Z=np.array(points[0]).T, lengthscales=lengthscales, exact=exact,
             gp2=posterior.report.negative_log_likelihood, **vars(reduced))
    np.savez_compressed(path, **arrays)


def read(file, name):
    """Arrays of one problem by name, and its Reduced."""
    arrays = {key.removeprefix(name + "/"): file[key] for key in file.files if key.startswith(name + "/")}
    return arrays, Reduced(*(arrays.pop(key) for key in ("R", "y", "constant")))


def check_gradient(file):
    arrays, reduced = read(file, f"noise/{RATIOS[0]}")
    X = arrays["X"][::10]
    reduced = Reduced(reduced.R[::10], reduced.y[::10], reduced.constant)
    at = np.concatenate([2 + np.arange(9) / 9, [0.5, 1, 2]])
    _, slope = bound(reduced, X, X[:15], at[:9], at[9:], 1e-6)
    for k in range(12):
        step = np.exp(1e-5 * (np.arange(12) == k))
        up, down = (bound(reduced, X, X[:15], v[:9], v[9:], 1e-6, gradient=False) for v in (at * step, at / step))
        assert abs((up - down) / 2e-5 - slope[k]) < 1e-5 * (1 + abs(slope[k])), (k, (up - down) / 2e-5, slope[k])


def milliseconds(evaluate):
    began = time.perf_counter()
    evaluate()
    return 1e3 * (time.perf_counter() - began)


def compare_time(file, benchmark, size, threads, rounds):
    """Value and gradient of each, one after the other; OPENBLAS_NUM_THREADS and OMP_NUM_THREADS are to be `threads`."""
    if not os.environ.get("OPENBLAS_NUM_THREADS") == os.environ.get("OMP_NUM_THREADS") == str(threads):
        raise SystemExit(f"set OPENBLAS_NUM_THREADS and OMP_NUM_THREADS to {threads}: BLAS reads them when it is loaded")
    arrays, reduced = read(file, f"time/{size}")
    X, Z = arrays["X"], arrays["X"][:: size // 200][:200]
    lengthscales = 3 * X.std(0)
    others = {"NumPy": lambda: bound(reduced, X, Z, lengthscales, np.ones(3), 1e-6)}
    if importlib.util.find_spec("gpytorch"):
        torch_bound = GPyTorchBound(reduced, X, Z, lengthscales, 1.0, 1.0)
        others["GPyTorch"] = torch_bound.value
        print("bound: NumPy", bound(reduced, X, Z, lengthscales, np.ones(3), 1e-8, gradient=False), "GPyTorch", torch_bound.value())
    arguments = [benchmark, f"--benchmark_filter=^inducing_points/{size}/{threads}/", "--benchmark_format=json"]
    ours, theirs = [], {name: [] for name in others}
    for _ in range(rounds):
        rows = json.loads(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)["benchmarks"]
        ours.append(rows[0]["real_time"])
        for name, evaluate in others.items():
            theirs[name].append(milliseconds(evaluate))
    print(f"N = {size}, M = 600, threads {threads}: gp2 {statistics.median(ours):.0f} ms")
    for name, times in theirs.items():
        ratios = [other / own for own, other in zip(ours, times)]
        print(f"  {name} {statistics.median(times):.0f} ms, {statistics.median(ratios):.2f} of gp2's ({min(ratios):.2f} to {max(ratios):.2f})",
              flush=True)


def compare_noise(file):
    """Nats above the exact value, by way and jitter."""
    has_torch = importlib.util.find_spec("gpytorch") is not None
    print("noise/signal | M | gp2 | at its points, jitter 1e-6 | 1e-10 | 0 | at every k-th state, 1e-6 | 1e-10 | 0"
          + (" | GPyTorch at gp2's points, its own jitter | 0" if has_torch else ""))
    for ratio in RATIOS:
        arrays, reduced = read(file, f"noise/{ratio}")
        X, Z, lengthscales, exact = (arrays[key] for key in ("X", "Z", "lengthscales", "exact"))
        evenly = X[np.linspace(0, len(X) - 1, len(Z)).astype(int)]

        def of_numpy(at, jitter):
            return bound(reduced, X, at, lengthscales, np.full(3, SIGNAL), jitter, gradient=False)

        def of_torch(jitter):
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                value = GPyTorchBound(reduced, X, Z, lengthscales, SIGNAL, ratio, jitter).value(gradient=False)
            return value, any("jitter" in str(one.message) for one in told)

        evaluations = [lambda at=at, jitter=jitter: (of_numpy(at, jitter), False) for at in (Z, evenly) for jitter in (1e-6, 1e-10, 0)]
        if has_torch:
            evaluations += [lambda jitter=jitter: of_torch(jitter) for jitter in (None, 0.0)]
        cells = []
        for evaluate in evaluations:
            try:
                value, has_added = evaluate()
                cells.append(f"{value - exact:.3g}" + (" (added jitter)" if has_added else ""))
            except Exception as error:  # each library fails in a way of its own
                cells.append(f"fails ({type(error).__name__})")
        print(ratio, 3 * len(Z), f"{arrays['gp2'] - exact:.3g}", *cells, sep=" | ", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("what", choices=["write", "time", "noise"])
    parser.add_argument("file")
    parser.add_argument("benchmark", nargs="?")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_000])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--n", type=int, default=400)
    parser.add_argument("--inducing", type=int, default=600)
    arguments = parser.parse_args()
    if arguments.what == "write":
        write(arguments.file, arguments.sizes, arguments.n, arguments.inducing)
        return
    file = np.load(arguments.file)
    check_gradient(file)
    if arguments.what == "noise":
        compare_noise(file)
        return
    for size in arguments.sizes:
        compare_time(file, arguments.benchmark, size, arguments.threads, arguments.rounds)


if __name__ == "__main__":
    main()
