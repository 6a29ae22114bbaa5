"""gp2.derive: a raw log of positions, from a table to a fit."""

import numpy as np
import pytest

import gp2


@pytest.fixture
def spring():
    return gp2.System(
        coordinates=["x"],
        parameters={"k": 9.0},
        mass=[["1"]],
        force=["-k*x"],
        latents=[{"features": ["x", "dx"]}],
    )


def log(n=400, noise=1e-4, seed=1):
    t = 0.01 * np.arange(n)
    x = np.cos(3 * t) + noise * np.random.default_rng(seed).standard_normal(n)
    return {"t": t, "x": x}


def test_derivatives_and_their_deviations_are_those_of_the_motion(spring):
    table, report = gp2.derive(spring, log())
    t = np.asarray(table["t"], float)
    for name, truth in {"x": np.cos(3 * t), "dx": -3 * np.sin(3 * t), "ddx": -9 * np.cos(3 * t)}.items():
        error = np.abs(np.asarray(table[name], float) - truth) / np.asarray(table[name + "_std"], float)
        assert np.mean(error < 1.96) > 0.8
        assert np.max(error) < 8
    (series,) = report["series"]
    assert series["coordinate"] == "x"
    assert series["used"] == 400
    assert 0.5e-4 < series["noise_std"] < 2e-4
    assert report["independent"] == ["x"]


def test_what_is_derived_is_fitted_by_its_own_noise(spring):
    table, _ = gp2.derive(spring, log(), every=10)
    posterior = gp2.fit(spring, table, restarts=1)
    states = np.array([[0.5, 1.0, 0.0]])
    assert abs(posterior.predict(states).mean[0, 0] + 4.5) < 0.2


def test_errors_name_what_is_wrong(spring):
    backwards = log()
    backwards["t"][7] = 0
    with pytest.raises(gp2.InputError, match="backwards"):
        gp2.derive(spring, backwards)
    with pytest.raises(gp2.InputError, match="smoothness: expected one of"):
        gp2.derive(spring, log(), smoothness="3/2")
