"""gp2.derive: a raw log of positions, from a table to a fit."""

import logging

import numpy as np
import pandas as pd
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


def test_a_log_like_another_goes_through_its_filter(spring):
    own, other = gp2.derive(spring, log())[1], log(n=200, seed=2)
    assert gp2.derive(spring, other, like=log())[1]["series"][0]["noise_std"] == own["series"][0]["noise_std"]
    assert gp2.derive(spring, other)[1]["series"][0]["noise_std"] != own["series"][0]["noise_std"]


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


def test_notes_are_told_and_name_options_as_keywords(spring, caplog):
    milliseconds = log() | {"t": 10.0 * np.arange(400)}
    with caplog.at_level(logging.INFO, logger="gp2"):
        _, report = gp2.derive(spring, milliseconds)
    (note,) = [note for note in report["notes"] if "time_unit" in note]
    assert note.endswith("give time_unit='s' if it is in seconds") and note in caplog.text


def test_errors_name_what_is_wrong(spring):
    backwards = log()
    backwards["t"][7] = 0
    with pytest.raises(gp2.InputError, match="backwards"):
        gp2.derive(spring, backwards)
    with pytest.raises(gp2.InputError, match="smoothness: expected one of"):
        gp2.derive(spring, log(), smoothness="3/2")


def test_topics_with_times_of_their_own_are_one_log(spring, tmp_path):
    driven = gp2.System(
        coordinates=["x"], inputs=["u"], parameters={"k": 9.0}, mass=[["1"]], force=["u - k*x"], latents=[{"features": ["x", "dx"]}]
    )
    one, other = log(), {"t": 0.003 + 0.02 * np.arange(200), "u": np.sin(0.02 * np.arange(200) + 0.003)}
    both = pd.DataFrame(one).merge(pd.DataFrame(other), on="t", how="outer").sort_values("t")
    table, _ = gp2.derive(driven, both)
    t = np.asarray(table["t"])
    assert len(t) == 600
    inner = (t > 0.2) & (t < 3.7)
    assert np.max(np.abs(np.asarray(table["u"]) - np.sin(t))[inner]) < 0.01
    assert np.max(np.abs(np.asarray(table["ddx"]) + 9 * np.cos(3 * t))[inner]) < 0.5

    np.savez(tmp_path / "log.npz", **one)
    with np.load(tmp_path / "log.npz") as file:
        np.testing.assert_array_equal(gp2.derive(spring, file)[0]["ddx"], gp2.derive(spring, one)[0]["ddx"])


@pytest.mark.parametrize("windows", ["auto", "none"])
def test_a_raw_log_is_fitted_to(spring, windows):
    posterior, smoothed, report = gp2.fit_raw(
        spring, log(noise=1e-2), mean="force", max_points=60, restarts=1, passes=2, windows=windows
    )
    assert len(smoothed) == 400
    assert any("the learned dynamics" in note for note in report["notes"])
    assert report["gains"] == sorted(report["gains"])
    assert abs(posterior.predict(np.array([[0.5, 1.0, 0.0]])).mean[0, 0] + 4.5) < 0.2
    with pytest.raises(gp2.InputError, match="passes: must not be negative"):
        gp2.fit_raw(spring, log(), passes=-1)
