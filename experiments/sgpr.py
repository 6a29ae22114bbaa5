"""The bound of inducing points as it is usually written, with a jitter, in NumPy: its time and its failures beside gp2's.

    PYTHONPATH=build/test/python python3 experiments/sgpr.py time build/test/benchmarks/likelihood_benchmark
    PYTHONPATH=build/test/python python3 experiments/sgpr.py noise

Both evaluate the same number: the bound of Titsias (2009) for the particle on a surface, in the reduced space of docs/theory.md, T37,
at the same inducing points. Here all 3m inducing variables stand beside all 2N reduced measurements as one matrix, K(Z, Z) is factored
with a jitter on its diagonal, and the gradient is written by hand. Set OPENBLAS_NUM_THREADS=1: the benchmark takes one thread.
"""

import argparse
import json
import math
import pathlib
import statistics
import subprocess
import tempfile
import time

import numpy as np
from scipy.linalg import cholesky, solve_triangular

import gp2

SURFACE = pathlib.Path(__file__).parent.parent / "models" / "surface.toml"


class Reduced:
    """ỹ_i = R_i ā_i + ε_i with ε_i ~ N(0, I): QR_i = Σ^{-1/2} T_i, which has rank 2. What Q does not see is a constant."""

    def __init__(self, system, states, accelerations, noise):
        mechanics = system.evaluate(states)
        inverse = np.linalg.inv(mechanics.M)
        A, At = mechanics.A, np.swapaxes(mechanics.A, 1, 2)
        L = inverse @ At @ np.linalg.inv(A @ inverse @ At)
        b = mechanics.b[..., None] if mechanics.b.ndim == 2 else mechanics.b
        T = np.eye(3) - L @ A
        residual = (accelerations - (L @ b)[..., 0]) / noise
        U, S, Vt = np.linalg.svd(T / noise)
        self.R = S[:, :2, None] * Vt[:, :2]  # (N, 2, 3)
        self.y = np.einsum("nkc,nk->nc", U[:, :, :2], residual)
        rest = np.sum(residual**2) - np.sum(self.y**2)
        self.constant = 0.5 * rest + residual.size * (math.log(noise) + 0.5 * math.log(2 * math.pi))


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


def system_and_states(n):
    """A motion that is logged often, so that its states are nearly alike."""
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
    return system, states, accelerations, Reduced(system, states, accelerations, noise), states[:, read]


def check_gradient():
    *_, reduced, X = problem(40, 0.1)
    at = np.concatenate([2 + np.arange(9) / 9, [0.5, 1, 2]])
    _, slope = bound(reduced, X, X[:15], at[:9], at[9:], 1e-6)
    for k in range(12):
        step = np.exp(1e-5 * (np.arange(12) == k))
        up, down = (bound(reduced, X, X[:15], v[:9], v[9:], 1e-6, gradient=False) for v in (at * step, at / step))
        assert abs((up - down) / 2e-5 - slope[k]) < 1e-5 * (1 + abs(slope[k])), (k, (up - down) / 2e-5, slope[k])


def compare_time(benchmark, n, rounds):
    *_, reduced, X = problem(n, 0.1)
    spread = X.std(0)
    arguments = [benchmark, f"--benchmark_filter=^inducing_points/{n}/1/", "--benchmark_format=json"]
    pairs = []
    for _ in range(rounds):
        rows = json.loads(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)["benchmarks"]
        ours = rows[0]["real_time"]
        began = time.perf_counter()
        bound(reduced, X, X[:: n // 200][:200], 3 * spread, np.ones(3), 1e-6)
        pairs.append((ours, 1e3 * (time.perf_counter() - began)))
    ratios = [other / ours for ours, other in pairs]
    print(f"N = {n}, M = 600: gp2 {statistics.median(p[0] for p in pairs):.0f} ms, NumPy {statistics.median(p[1] for p in pairs):.0f} ms, "
          f"ratio of pairs {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")


def compare_noise(n, most):
    print("noise/signal | M | exact | gp2 | at its points, jitter 1e-6 | 1e-10 | 0 | at every k-th state, 1e-6 | 1e-10 | 0 [nats above exact]")
    signal = 10.0
    for ratio in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        noise = ratio * signal
        system, *data, reduced, X = problem(n, noise)
        lengthscales = 2 * X.std(0)
        start = {f"lengthscale({name})": value for name, value in zip([s for s in system.state_names if s != "t"], lengthscales)}
        start |= {f"signal_stddev({name})": signal for name in system.acceleration_names}
        options = dict(estimate=[], noise_std=noise, discrepancy=False, hyperprior=False, thin=False, start=start, max_iterations=0,
                       hyperparameters="optimise", threads=1)
        exact = gp2.fit(system, tuple(data), inducing="none", **options).report.negative_log_likelihood
        posterior = gp2.fit(system, tuple(data), inducing=most, **options)
        with tempfile.TemporaryDirectory() as folder:
            posterior.save(f"{folder}/fit.json")
            points = json.loads(pathlib.Path(f"{folder}/fit.json").read_text())["report"]["inducing"]["points"]
        Z = np.array(points[0]).T
        evenly = X[np.linspace(0, n - 1, len(Z)).astype(int)]
        others = []
        for at, jitter in [(Z, 1e-6), (Z, 1e-10), (Z, 0), (evenly, 1e-6), (evenly, 1e-10), (evenly, 0)]:
            try:
                others.append(f"{bound(reduced, X, at, lengthscales, np.full(3, signal), jitter, gradient=False) - exact:.3g}")
            except np.linalg.LinAlgError:
                others.append("fails")
        print(ratio, 3 * len(Z), f"{exact:.6f}", f"{posterior.report.negative_log_likelihood - exact:.3g}", *others, sep=" | ", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    what = parser.add_subparsers(dest="what", required=True)
    timing = what.add_parser("time")
    timing.add_argument("benchmark")
    timing.add_argument("--n", type=int, default=10_000)
    timing.add_argument("--rounds", type=int, default=9)
    noise = what.add_parser("noise")
    noise.add_argument("--n", type=int, default=400)
    noise.add_argument("--inducing", type=int, default=600)
    arguments = parser.parse_args()
    check_gradient()
    if arguments.what == "time":
        compare_time(arguments.benchmark, arguments.n, arguments.rounds)
    else:
        compare_noise(arguments.n, arguments.inducing)


if __name__ == "__main__":
    main()
